"""Curves x(t) = c + d t + e t^m that stay inside C, and how G behaves along them as t grows: proofs that a growth is too fast.

Inside C the tangent cone is the whole space, so that the velocity of the scheme is G itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.classes.inclusion.hypotheses.recession import recession_directions
from nsmodel.classes.inclusion.hypotheses.selected_field import SelectedField
from nsmodel.hypotheses.findings import VIOLATED
from nsmodel.proof import polynomial
from nsmodel.proof.asymptotics import (
    START_EXPONENTS,
    AsymptoticOrder,
    add_orders,
    asymptotic_orders,
    constant_order,
    multiply_orders,
    polynomial_order,
    propagate_orders,
)
from nsmodel.proof.convex.lower_bounds import additive_terms
from nsmodel.proof.convex.sets import ConvexSet, has_interior
from nsmodel.proof.expression_graph import program
from nsmodel.proof.verdict import HypothesisPart

NEAR_TIME, FAR_TIME = 2.0**10, 2.0**20  # Where the growth along a curve is looked at first.
MAX_CURVES = 8  # Curves on which a proof is tried.
CURVE_BENDS = ((2, 1.0), (2, 1e4), (4, 1.0), (4, 1e4), (4, 1e12))


class PolynomialCurve(NamedTuple):
    """c + d t + e t^m, coefficients (n, m + 1) of t^0, t^1, ..."""

    coefficients: np.ndarray

    @property
    def power(self) -> int:
        """|x(t)| grows like t to this power."""
        return self.coefficients.shape[1] - 1

    def at(self, t: float) -> np.ndarray:
        """The point."""
        return self.coefficients @ t ** np.arange(self.power + 1)

    def orders(self, k: int) -> list[AsymptoticOrder]:
        """The order of each state."""
        return [polynomial_order([Fraction(float(number)) for number in row], k) for row in self.coefficients]

    def compose_polynomial(self, p: polynomial.Polynomial, k: int) -> AsymptoticOrder | None:
        """The order of a polynomial in the states, its coefficients in t exact."""
        rows = [{((0, j),) if j else (): Fraction(float(c)) for j, c in enumerate(row) if c} for row in self.coefficients]
        total: polynomial.Polynomial = {}
        for monomial, number in p.items():
            term: polynomial.Polynomial | None = {(): number}
            for variable, power in monomial:
                for _ in range(power):
                    term = None if term is None else polynomial.multiply(term, rows[variable])
            if term is None:
                return None
            total = polynomial.add_multiple(total, term)
        return polynomial_order(polynomial.univariate_coefficients(total), k)

    @property
    def witness(self) -> dict[str, Any]:
        """Where it begins and goes."""
        if self.power == 1:
            return {"direction": self.coefficients[:, 1], "from": self.coefficients[:, 0]}
        rows = [" + ".join(f"{c:g} t^{j}" if j else f"{c:g}" for j, c in enumerate(row) if c) or "0" for row in self.coefficients]
        return {"curve, t large": rows}


class FieldAlongCurves:
    """G and C along curves."""

    def __init__(self, field: SelectedField) -> None:
        self.field, self.n = field, field.x.numel()
        z = field.variables[0]
        self.rows: list[tuple[polynomial.Polynomial, list[tuple[Fraction, int]]]] = []
        others: list[ca.SX] = []
        for row in ca.vertsplit(field.rest):
            total: polynomial.Polynomial = {}
            left = []
            for factor, term in additive_terms(row):
                (p,) = polynomial.read_polynomials(term, field.x)
                if p is not None:
                    total = polynomial.add_multiple(total, p, factor)
                else:
                    left.append((factor, len(others)))
                    others.append(term)
            self.rows.append((total, left))
        self.terms = program(ca.vertcat(ca.SX(0, 1), *others), z)
        self.switches = program(ca.vertcat(ca.SX(0, 1), *(jump.u for jump in field.jumps)), field.x)
        self.speed = ca.Function("v", [z], [field.rest])
        self.u = ca.Function("u", [field.x], [ca.vertcat(ca.SX(0, 1), *(jump.u for jump in field.jumps))])

    def velocity(self, path: PolynomialCurve, k: int) -> list[AsymptoticOrder | None]:
        """The rows of ``rest`` on the curve for t >= 2^k, the multipliers that switch put in."""
        out = []
        for (p, _), others in zip(self.rows, self._term_orders(path, k), strict=True):
            total = path.compose_polynomial(p, k)
            for other in others:
                total = add_orders(total, other, k)
            out.append(total)
        return out

    def product(self, path: PolynomialCurve, k: int) -> AsymptoticOrder | None:
        """<x, v> on the curve, v any element of G."""
        exact: polynomial.Polynomial = {}
        for i, (p, _) in enumerate(self.rows):
            part = polynomial.multiply(p, {((i, 1),): Fraction(1)})
            if part is None:
                return None
            exact = polynomial.add_multiple(exact, part)
        total = path.compose_polynomial(exact, k)
        x = path.orders(k)
        for own, others in zip(x, self._term_orders(path, k), strict=True):
            for other in others:
                total = add_orders(total, multiply_orders(own, other), k)
        size = sum(term.size for term in self.field.aligned)
        for own in x:
            total = add_orders(total, multiply_orders(own, constant_order(-size, size)), k) if size else total
        return total

    def _term_orders(self, path: PolynomialCurve, k: int) -> list[list[AsymptoticOrder | None]]:
        """The terms of each row that are no polynomials."""
        x = path.orders(k)
        u = propagate_orders(self.switches, x, k) if self.field.jumps else []
        l = [_switched_order(jump.lower, jump.upper, order) for jump, order in zip(self.field.jumps, u, strict=True)]
        terms = propagate_orders(self.terms, [*x, *l], k) if self.terms.outputs else []
        return [[multiply_orders(terms[i], polynomial_order([factor], k)) for factor, i in left] for _, left in self.rows]

    def values(self, path: PolynomialCurve, t: float) -> tuple[np.ndarray, np.ndarray]:
        """x and rest(x) in doubles."""
        x = path.at(t)
        u = np.array(self.u(x)).ravel()
        l = [jump.lower if entry > 0 else jump.upper for jump, entry in zip(self.field.jumps, u, strict=True)]
        return x, np.array(self.speed(np.concatenate([x, l]))).ravel()


def _switched_order(lower: float, upper: float, u: AsymptoticOrder | None) -> AsymptoticOrder:
    if u is None or not u.sign:
        return constant_order(lower, upper)
    return constant_order(lower if u.sign > 0 else upper)


# -- which curves ------------------------------------------------------------------------------------------------------


def candidate_curves(field: SelectedField, more: np.ndarray | None = None) -> Iterator[PolynomialCurve]:
    """Rays and bent curves whose points far out lie in C, in doubles."""
    C = field.C
    start = _curve_origin(C)
    if start is None:
        return
    rng = np.random.default_rng(1)
    slopes = ca.Function("J", [field.variables[0]], [ca.jacobian(field.rest, field.x)])
    given = [np.zeros((0, C.n)) if more is None else more]
    for point in np.vstack([start[None, :], start + rng.normal(size=(2, C.n))]):
        J = np.array(slopes(np.concatenate([point, np.zeros(len(field.jumps))])))
        given.append(J[np.isfinite(J).all(axis=1) & J.any(axis=1)])
    wanted = np.vstack(given)
    if C.is_polyhedron:
        for d in recession_directions(C, wanted):
            yield PolynomialCurve(np.column_stack([start, _unit_direction(np.array([float(entry) for entry in d]))]))
        return
    axes = np.vstack([np.eye(C.n), -np.eye(C.n)])
    for d in np.vstack([axes, wanted, -wanted, rng.normal(size=(48, C.n))]):
        path = PolynomialCurve(np.column_stack([start, _unit_direction(d)]))
        if _lies_inside(C, path):
            yield path
    for m, size in CURVE_BENDS:
        for e in axes:
            for d in np.vstack([axes, rng.normal(size=(4, C.n))]):
                path = PolynomialCurve(np.column_stack([start, _unit_direction(d), *np.zeros((m - 2, C.n)), size * e]))
                if abs(d @ e) < 1 and _lies_inside(C, path):
                    yield path


def _unit_direction(d: np.ndarray) -> np.ndarray:
    scaled = d / np.abs(d).max()
    return scaled if np.count_nonzero(d) == 1 else scaled / np.linalg.norm(scaled)


def _curve_origin(C: ConvexSet) -> np.ndarray | None:
    zero = np.zeros(C.n)
    if C.interior_margin(zero) is not None:
        return zero
    inner = has_interior(C, np.clip(zero, *C.bounding_box)).witness.get("interior point")
    point = None if inner is None else np.asarray(inner, float)
    return point if point is not None and C.interior_margin(point) is not None else None


def _lies_inside(C: ConvexSet, path: PolynomialCurve) -> bool:
    values = C.values(np.array([path.at(t) for t in (NEAR_TIME, FAR_TIME)]))
    return bool((values > 0).all())


def remains_inside(C: ConvexSet, path: PolynomialCurve, k: int) -> bool:
    """Whether the curve lies in the interior of C for all t >= 2^k."""
    if C.equalities.numel():
        return False
    for i, p in enumerate(C.polynomials):
        order = path.compose_polynomial(p, k) if p is not None else asymptotic_orders(C.rows[i], C.x, path.orders(k), k)[0]
        if order is None or order.sign <= 0:
            return False
    return True


# -- what is too fast --------------------------------------------------------------------------------------------------


def superlinear_curve(field: SelectedField) -> HypothesisPart | None:
    """A curve in C along which a row of F - S grows faster than |x|."""
    along = FieldAlongCurves(field)
    seen = []
    for path in candidate_curves(field):
        sizes = []
        for t in (NEAR_TIME, FAR_TIME):
            x, v = along.values(path, t)
            sizes.append(np.linalg.norm(v) / np.linalg.norm(x))
        rise = (
            sizes[1] / sizes[0] if np.isfinite(sizes).all() and sizes[0] else np.inf if sizes[0] or np.isnan(sizes).any() else 0.0
        )
        if rise > 1.2:
            seen.append((rise, path))
    for _, path in _best_curves(seen):
        for k in START_EXPONENTS:
            if not remains_inside(field.C, path, k):
                continue
            for order in along.velocity(path, k):
                if order is not None and order.sign and order.rate > (path.power, 0):
                    how = f"|F - S| grows faster than |x| along {_curve_name(path)} (bounds of its order for all t)"
                    power = float(order.p) / path.power
                    return HypothesisPart(VIOLATED, how, {"power": power}, path.witness)
    return None


def nondissipative_curve(field: SelectedField) -> HypothesisPart | None:
    """A curve in C along which <x, v> has no part -alpha |x|^2: then no alpha > 0 and beta bound it."""
    along = FieldAlongCurves(field)
    seen = []
    for path in candidate_curves(field):
        ratios = []
        for t in (NEAR_TIME, FAR_TIME):
            x, v = along.values(path, t)
            ratios.append(x @ v / (x @ x))
        if np.isnan(ratios).any() or ratios[1] > min(0.7 * ratios[0], 0.0) or ratios[1] >= 0:
            seen.append((np.nan_to_num(ratios[1], nan=0.0), path))
    for _, path in _best_curves(seen):
        for k in START_EXPONENTS:
            if not remains_inside(field.C, path, k):
                continue
            order = along.product(path, k)
            if order is None or not np.isfinite(order.low):
                continue
            if order.low >= 0 or order.rate < (2 * path.power, 0):
                how = f"along {_curve_name(path)} <x, F - S> >= 0 or small beside |x|^2: no alpha > 0 bounds it (by its order)"
                limit = max(order.low, 0.0) if order.rate == (2 * path.power, 0) else 0.0
                value = {"lim <x, F - S>/|x|^2": limit}
                return HypothesisPart(VIOLATED, how, value, path.witness)
    return None


def _curve_name(path: PolynomialCurve) -> str:
    return "d, a direction in which C is unbounded," if path.power == 1 else "a curve in C"


def _best_curves(seen: list[tuple[float, PolynomialCurve]]) -> list[tuple[float, PolynomialCurve]]:
    return sorted(seen, key=lambda pair: -pair[0])[:MAX_CURVES]
