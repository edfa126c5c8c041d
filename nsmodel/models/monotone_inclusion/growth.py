"""Curves x(t) = c + d t + e t^m that stay inside C, and how G behaves along them as t grows: proofs that a growth is too fast.

Inside C the tangent cone is the whole space, so that the velocity of the scheme is G itself.

Linear growth of G = F - S: |G(x)| <= a_1 + a_2 |x| on C (A2).
"""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import sum_in_order
from nsmodel.hypotheses.findings import HOLDS, UNKNOWN, VIOLATED
from nsmodel.models.monotone_inclusion.cones import recession_directions
from nsmodel.models.monotone_inclusion.field import SelectedField
from nsmodel.proof import exact, extremum, interval_bounds, polynomial, univariate
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
from nsmodel.proof.convex.piecewise import split_by_cases
from nsmodel.proof.convex.rules import find_ridges
from nsmodel.proof.convex.sets import ConvexSet, has_interior
from nsmodel.proof.domain import is_defined_on_box
from nsmodel.proof.exact import ROUND_UP_FACTOR
from nsmodel.proof.exponential_sums import ball_lower_bound
from nsmodel.proof.expression_graph import additive_terms, is_double, program
from nsmodel.proof.growth import growth_bound, linear_growth_bound
from nsmodel.proof.leading_terms import LeadingTerm
from nsmodel.proof.sectors import sector
from nsmodel.proof.verdict import HypothesisPart

# Where the growth along a curve is looked at in doubles: up to FAR_TIME a power larger by one grows a thousandfold more,
NEAR_TIME = 2.0**10
FAR_TIME = 2.0**20  # and its fifth power is still far from overflow; what grows is then proved.
MAX_CURVES = 8  # Curves on which a proof is tried, those that grow most.
# Powers of t, and factors of them, by which curves bend that are tried: into sets that narrow, and past terms with large factors.
CURVE_BENDS = ((2, 1.0), (2, 1e4), (4, 1.0), (4, 1e4), (4, 1e12))


class PolynomialCurve(NamedTuple):
    """c + d t + e t^m, coefficients (n, m + 1) of t^0, t^1, ..."""

    coefficients: np.ndarray

    @property
    def power(self) -> int:
        """|x(t)| grows like t to this power."""
        return self.coefficients.shape[1] - 1

    def at(self, t: float) -> np.ndarray:
        """The point of the curve at a time."""
        return self.coefficients @ t ** np.arange(self.power + 1)

    def orders(self, k: int) -> list[AsymptoticOrder]:
        """The order of each state."""
        return [polynomial_order([Fraction(float(number)) for number in row], k) for row in self.coefficients]

    def compose_polynomial(self, p: polynomial.Polynomial, k: int) -> AsymptoticOrder | None:
        """The order of a polynomial in the states, its coefficients in t exact."""
        rows: list[polynomial.Polynomial] = [
            {((0, j),) if j else (): Fraction(float(c)) for j, c in enumerate(row) if c} for row in self.coefficients
        ]
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
        size = sum_in_order(term.size for term in self.field.aligned)
        for own in x:
            total = add_orders(total, multiply_orders(own, constant_order(-size, size)), k) if size else total
        return total

    def exact_growth(self, expr: ca.SX, path: PolynomialCurve) -> LeadingTerm | None:
        """The leading term of a scalar of x, and of no switches, on the curve, in 1/t, however many terms cancel."""
        if self.field.jumps:
            return None
        t = ca.SX.sym("t")
        x = [sum((float(c) * t**j for j, c in enumerate(row) if c), ca.SX(0)) for row in path.coefficients]
        terms = additive_terms(ca.substitute(expr, self.field.x, ca.vertcat(*x)))
        pieces = split_by_cases(terms, t)
        return univariate.growth_far_out(terms, t, pieces[-1].low[1], pieces[-1].cases) if pieces else None

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
            sizes.append(float(np.linalg.norm(v) / np.linalg.norm(x)))
        rise = (
            sizes[1] / sizes[0] if np.isfinite(sizes).all() and sizes[0] else np.inf if sizes[0] or np.isnan(sizes).any() else 0.0
        )
        if rise > 1.2:
            seen.append((rise, path))
    for path, k in _curves_inside(field.C, seen):
        orders = [
            order.p for order in along.velocity(path, k) if order is not None and order.sign and order.rate > (path.power, 0)
        ]
        leads = [] if orders else [along.exact_growth(row, path) for row in ca.vertsplit(field.rest)]
        orders += [-lead.order for lead in leads if lead is not None and (lead.rank[0], -lead.order) > (0, path.power)]
        if orders:
            how = f"|F - S| grows faster than |x| along {_curve_name(path)} (bounds of its order for all t)"
            return HypothesisPart(VIOLATED, how, {"power": float(orders[0]) / path.power}, path.witness)
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
            seen.append((float(np.nan_to_num(ratios[1], nan=0.0)), path))
    for path, k in _curves_inside(field.C, seen):
        limit = _radial_limit(along, path, k)
        if limit is not None:
            how = f"along {_curve_name(path)} <x, F - S> >= 0 or small beside |x|^2: no alpha > 0 bounds it (by its order)"
            return HypothesisPart(VIOLATED, how, {"lim <x, F - S>/|x|^2": limit}, path.witness)
    return None


def _radial_limit(along: FieldAlongCurves, path: PolynomialCurve, k: int) -> float | None:
    """The limit >= 0 of <x, v>/|x|^2, 0 where it is not of that order; None where it is not proved to be >= 0."""
    order, square = along.product(path, k), (2 * path.power, 0)
    if order is not None and np.isfinite(order.low) and (order.low >= 0 or order.rate < square):
        return max(order.low, 0.0) if order.rate == square else 0.0
    lead = along.exact_growth(ca.dot(along.field.x, along.field.rest), path)
    if lead is None or not (lead.number > 0 or (lead.rank[0], -lead.order) < (0, square[0])):
        return None
    return ball_lower_bound(lead.number) if (lead.rank[0], -lead.order) == (0, square[0]) else 0.0


def _curves_inside(C: ConvexSet, seen: list[tuple[float, PolynomialCurve]]) -> Iterator[tuple[PolynomialCurve, int]]:
    """The best curves, and k for which they lie in the interior of C for all t >= 2^k."""
    for _, path in sorted(seen, key=lambda pair: -pair[0])[:MAX_CURVES]:
        yield from ((path, k) for k in START_EXPONENTS if remains_inside(C, path, k))


def _curve_name(path: PolynomialCurve) -> str:
    return "d, a direction in which C is unbounded," if path.power == 1 else "a curve in C"


MAX_MULTIPLIER_CORNERS = 12  # Multipliers whose 2^12 corners are all looked at; else the sum of their sizes is the bound.
SECTOR_START = 8  # Slopes at infinity are those beyond 2^8, and what is nearer goes into the constant;
# powers of |x| below 1 are bounded by their tangents at 64: any place gives a bound, the constant grows with it.
TANGENT_SCALE = 64.0


class AffineField(NamedTuple):
    """rest = A x + b + (columns of the jumps) l + terms of size at most more + slopes |x|.

    A (n, n), b (n, 1) and the columns (n, k) are Fractions.
    """

    A: np.ndarray
    b: np.ndarray
    jumps: np.ndarray
    more: np.ndarray
    slopes: np.ndarray

    @property
    def exact(self) -> bool:
        """Whether there are no terms but the affine ones."""
        return not (self.more.any() or self.slopes.any())


class FieldRowBound(NamedTuple):
    """A row of rest: a polynomial p, plus terms that are at most ``size`` + ``slope`` |x| on C; p is None where some is not."""

    p: polynomial.Polynomial | None
    size: float
    slope: float


@lru_cache(maxsize=4)
def read_field_rows(field: SelectedField) -> tuple[FieldRowBound, ...]:
    """Read the rows of rest, bounding the terms that are no polynomials."""
    z, low, high = field.variables
    return tuple(_read_field_row(row, field, z, low, high) for row in ca.vertsplit(field.rest))


def _read_field_row(row: ca.SX, field: SelectedField, z: ca.SX, low: np.ndarray, high: np.ndarray) -> FieldRowBound:
    (p,) = polynomial.read_polynomials(row, z)
    if p is not None:
        return FieldRowBound(p, 0.0, 0.0)
    terms = additive_terms(row)
    found = _read_field_terms(terms, field, z, low, high)
    if found.p is not None and polynomial.degree(found.p) <= 1:
        return found
    merged = _read_field_terms(_merge_directions(terms, field.x), field, z, low, high)
    return found if merged.p is None or (found.p is not None and polynomial.degree(merged.p) > 1) else merged


def _merge_directions(terms: list[tuple[Fraction, ca.SX]], x: ca.SX) -> list[tuple[Fraction, ca.SX]]:
    """The same sum, what is not affine in one direction merged into one term: its parts may cancel at infinity."""
    merged: dict[tuple[Fraction, ...], ca.SX] = {}
    left = []
    for factor, term in terms:
        (p,) = polynomial.read_polynomials(term, x)
        split = None if p is not None and polynomial.degree(p) <= 1 else find_ridges(term, x)
        if split is None or split.s.numel() != 1 or not is_double(factor):
            left.append((factor, term))
        else:
            key = tuple(split.a[0])
            merged[key] = merged.get(key, ca.SX(0)) + float(factor) * term
    return [*left, *((Fraction(1), term) for term in merged.values())]


def _read_field_terms(
    terms: list[tuple[Fraction, ca.SX]], field: SelectedField, z: ca.SX, low: np.ndarray, high: np.ndarray
) -> FieldRowBound:
    total: polynomial.Polynomial = {}
    size = slope = 0.0
    for factor, term in terms:
        (p,) = polynomial.read_polynomials(term, z)
        if p is not None:
            total = polynomial.add_multiple(total, p, factor)
            continue
        reach, steep = term_bound(term, field, z, low, high, None)
        if not np.isfinite(reach + steep):
            own = _sector_bound(term, field)
            if own is not None:
                total = polynomial.add_multiple(total, own[0], factor)
                reach, steep = own[1:]
            else:
                reach, steep = term_bound(term, field, z, low, high, TANGENT_SCALE)
        if not np.isfinite(reach + steep):
            return FieldRowBound(None, np.inf, np.inf)
        size += exact.round_up(abs(factor) * Fraction(reach)) * ROUND_UP_FACTOR
        slope += exact.round_up(abs(factor) * Fraction(steep)) * ROUND_UP_FACTOR
    return FieldRowBound(total, size, slope)


def term_bound(
    term: ca.SX, field: SelectedField, z: ca.SX, low: np.ndarray, high: np.ndarray, scale: float | None
) -> tuple[float, float]:
    """(a, b) with |term| <= a + b |x|: bounded, Lipschitz, or with a ``scale`` by the growth calculus; else inf."""
    reach = float(np.max(np.abs(interval_bounds.enclose(term, z, low, high))))
    if np.isfinite(reach):
        return reach, 0.0
    found = _lipschitz_term_bound(term, field, z, low, high)
    if scale is None:
        return found
    powers = growth_bound(term, z, low, high, field.x.numel())
    own = None if powers is None else linear_growth_bound(powers, scale)
    return found if own is None or own[1] >= found[1] else own


def _lipschitz_term_bound(term: ca.SX, field: SelectedField, z: ca.SX, low: np.ndarray, high: np.ndarray) -> tuple[float, float]:
    """(a, b) with |term| <= a + b |x|, where it is continuous with bounded slopes on the hull of C."""
    n = field.x.numel()
    if field.jumps or not interval_bounds.is_continuous(term, z, low, high):
        return np.inf, np.inf
    base = np.clip(np.zeros(n), low, high)
    code = program(term, z)
    with np.errstate(all="ignore"):
        ends = interval_bounds.reverse_slopes(code, interval_bounds.run_program(code, low[None, :], high[None, :]), (0,), 1)
    gradient = np.maximum(np.abs(ends[0]), np.abs(ends[1])).ravel()
    at = float(np.max(np.abs(interval_bounds.enclose(term, z, base, base))))
    steep = float(np.linalg.norm(gradient)) * ROUND_UP_FACTOR if np.isfinite(gradient).all() else np.inf
    return at + steep * float(np.linalg.norm(base)) * ROUND_UP_FACTOR if np.isfinite(steep) else np.inf, steep


def _sector_bound(term: ca.SX, field: SelectedField) -> tuple[polynomial.Polynomial, float, float] | None:
    """(p, a, b) with |term - p| <= a + b |x| and a linear p, where the term is a function of one direction between two lines."""
    split = find_ridges(term, field.x)
    if split is None or split.s.numel() != 1:
        return None
    low, high = split.box(*field.C.bounding_box)
    found = sector(split.h, split.s, low[0], high[0], SECTOR_START)
    if found is None or not found.bounded:
        return None
    middle = found.low + (found.high - found.low) / 2
    p: polynomial.Polynomial = {((i, 1),): Fraction(middle) * number for i, number in enumerate(split.a[0]) if number}
    width = max(found.high - middle, middle - found.low) * rounded_norm(exact.doubles(split.a))
    return p if middle else {}, found.reach, width * ROUND_UP_FACTOR


def affine_field(field: SelectedField) -> AffineField | None:
    """The rest of G as an affine map but for bounded terms, where it is one."""
    n, z = field.x.numel(), field.variables[0]
    rows, read = [], read_field_rows(field)
    for p, _, _ in read:
        if p is None or polynomial.degree(p) > 1:
            return None
        found = polynomial.as_quadratic(p, z.numel())
        if found is None:
            return None
        rows.append((found.q.T[0], found.c))
    whole = np.array([row for row, _ in rows], dtype=object).reshape(n, z.numel())
    return AffineField(
        whole[:, :n],
        exact.rational([[c] for _, c in rows]),
        whole[:, n:],
        np.array([row.size for row in read]),
        np.array([row.slope for row in read]),
    )


def split_box(
    base: np.ndarray, half: float, low: np.ndarray, high: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], list[tuple[np.ndarray, np.ndarray]]]:
    """The part of a box within ``half`` of a point, and boxes that hold the rest of it (the whole where half is 0)."""
    inner = np.maximum(low, base - half), np.minimum(high, base + half)
    if not half:
        return inner, [(low, high)]
    outside = []
    for i in range(base.size):
        for end, side in ((base[i] + half, 0), (base[i] - half, 1)):
            part = low.copy(), high.copy()
            part[side][i] = end
            if part[0][i] < part[1][i]:
                outside.append(part)
    return inner, outside


def rounded_norm(matrix: np.ndarray) -> float:
    """|A|, enlarged by rounding; exact for one entry."""
    if matrix.size == 1:
        return abs(float(matrix[0, 0]))
    return float(np.linalg.norm(matrix, 2)) * ROUND_UP_FACTOR if matrix.any() else 0.0


def max_constant_part(field: SelectedField, b: np.ndarray, columns: np.ndarray) -> float:
    """The largest |b + sum of multipliers|, rounded up: over the corners of their boxes where these are few."""
    terms = [(term.B, term.lower, term.upper) for term in field.aligned]
    terms += [(columns[:, [k]], jump.lower, jump.upper) for k, jump in enumerate(field.jumps)]
    if not terms:
        return rounded_norm(b[:, None])
    if len(terms) <= MAX_MULTIPLIER_CORNERS and all(B.shape[1] == 1 for B, _, _ in terms):
        B = np.hstack([B for B, _, _ in terms])
        corners = np.array(list(product(*((low, high) for _, low, high in terms))))
        size = float(np.linalg.norm(np.abs(b) + np.abs(B) @ np.abs(corners).max(axis=0)))  # of what may cancel
        largest = float(np.linalg.norm(b + corners @ B.T, axis=1).max())
        return largest * ROUND_UP_FACTOR + (2 + len(terms)) * exact.MACHINE_EPSILON * size
    sizes = [float(np.linalg.norm(B, 2)) * max(abs(low), abs(high)) for B, low, high in terms]
    return float(np.linalg.norm(b) + sum_in_order(sizes)) * ROUND_UP_FACTOR


def require_values(part: HypothesisPart, field: SelectedField) -> HypothesisPart:
    """What holds of F - S on C; unknown where F - S is not seen to have a value on all of C."""
    where = field.C.rows if field.C.rows.numel() else None
    z, low, high = field.variables
    if part.verdict != HOLDS or is_defined_on_box(field.rest, field.x, z, low, high, where=where):
        return part
    return HypothesisPart(UNKNOWN, "F - S is not seen to have a value everywhere on C", {}, {})


def linear_growth(field: SelectedField, region: tuple[np.ndarray, np.ndarray], *, quick: bool) -> HypothesisPart:
    """The finding (A2), linear growth of the field on C."""
    return require_values(_linear_growth(field, region, quick), field)


def _linear_growth(field: SelectedField, region: tuple[np.ndarray, np.ndarray], quick: bool) -> HypothesisPart:
    found = affine_field(field)
    if found is not None:
        share = max_constant_part(field, exact.doubles(found.b).ravel(), exact.doubles(found.jumps))
        values = {
            "a_1": share + rounded_norm(found.more[:, None]),
            "a_2": rounded_norm(exact.doubles(found.A)) + rounded_norm(found.slopes[:, None]),
        }
        parts = ["bounded multipliers"] * bool(field.l.numel()) + ["bounded terms"] * bool(found.more.any())
        parts += ["terms of linear growth"] * bool(found.slopes.any())
        how = "F - S is affine" + (f" but for {' and '.join(parts)}" if parts else "")
        return HypothesisPart(HOLDS, how, values, {})
    z, low, high = field.variables
    square = ca.sumsqr(field.rest)
    others = sum_in_order(term.size for term in field.aligned) * ROUND_UP_FACTOR
    if field.C.bounded:
        sup = extremum.supremum(square, z, low, high, quick=quick)
        if np.isfinite(sup.bound):
            a_1 = float(np.sqrt(max(sup.bound, 0.0))) * ROUND_UP_FACTOR + others
            return HypothesisPart(HOLDS, "C is bounded: the largest |F - S| on its box", {"a_1": a_1, "a_2": 0.0}, {})
    elif interval_bounds.is_continuous(field.rest, z, low, high):
        found_bound = _lipschitz_bound(field, others)
        if found_bound is not None:
            how = "F - S is Lipschitz on C but for a bounded part, by bounds of its Jacobian"
            return HypothesisPart(HOLDS, how, found_bound, {})
    top = velocity_bound(field, region)
    local = {} if top is None else {"largest |F - S| on the box": top}
    fast = _superlinear_direction(field)
    curved = None if fast is not None else superlinear_curve(field)
    if curved is not None:
        witness = {**curved.witness, "power": curved.value["power"]}
        return HypothesisPart(VIOLATED, f"{curved.how}; the number is that of the box", local or {"a_2": np.inf}, witness)
    if fast is not None:
        d, power = fast
        how = f"|F - S| grows like t^{power} along a direction in which C is unbounded (exact); the number is that of the box"
        return HypothesisPart(VIOLATED, how, local or {"a_2": np.inf}, {"direction": d, "power": power})
    reach = "bounded, and no bound of F - S on it" if field.C.bounded else "unbounded, and no linear bound of F - S at infinity"
    how = f"C is {reach} was proved; the number is that of the box looked at"
    return HypothesisPart(UNKNOWN, how, local, {})


def _lipschitz_bound(field: SelectedField, others: float) -> dict[str, float] | None:
    """|rest(x)| <= M + a_2 |x - y| <= M + a_2 (|x| + D): a_2 bounds the Jacobian outside a box B, M bounds |rest| on B.

    y is where the segment from the middle of B to x leaves B, at a distance D from 0 at most: |x - y| <= |x - c| <= |x| + |c|.
    """
    z, low, high = field.variables
    n = field.x.numel()
    base = np.clip(np.zeros(n), *field.C.bounding_box)
    J = ca.jacobian(field.rest, field.x)
    for half in (0.0, 1.0):
        box, outside = split_box(base, half, low[:n], high[:n])
        lower, upper = (np.tile(end, (1 + len(outside), 1)) for end in (low, high))
        lower[:, :n], upper[:, :n] = map(np.array, zip(box, *outside, strict=True))
        slope = float(extremum.spectral_norm_bounds(J, z, lower[1:], upper[1:]).max()) if outside else 0.0
        _, top = interval_bounds.enclose(ca.sumsqr(field.rest), z, lower[0], upper[0])
        M = float(np.max(top))
        if np.isfinite(slope) and np.isfinite(M):
            return {
                "a_1": float(np.sqrt(max(M, 0.0))) * ROUND_UP_FACTOR
                + slope * float(np.linalg.norm(base)) * ROUND_UP_FACTOR
                + others,
                "a_2": slope,
            }
    return None


def velocity_bound(field: SelectedField, region: tuple[np.ndarray, np.ndarray]) -> float | None:
    """A bound of |F - S| on the part of C in a box; None where there is none."""
    z, low, high = field.variables
    n = field.x.numel()
    low[:n], high[:n] = np.maximum(low[:n], region[0]), np.minimum(high[:n], region[1])
    if (low > high).any():
        return None
    _, top = interval_bounds.enclose(ca.sumsqr(field.rest), z, low, high)
    value = float(np.max(top))
    return (
        float(np.sqrt(value)) * ROUND_UP_FACTOR + sum_in_order(term.size for term in field.aligned) * ROUND_UP_FACTOR
        if np.isfinite(value)
        else None
    )


def _superlinear_direction(field: SelectedField) -> tuple[np.ndarray, int] | None:
    """A direction d of C and k >= 2 with |G(c + t d)| growing like t^k, where a row is a polynomial but for slower terms."""
    if not field.C.is_polyhedron:
        return None
    n = field.x.numel()
    parts = [(row.p, {m for m in row.p if any(v >= n for v, _ in m)}) for row in read_field_rows(field) if row.p is not None]
    # The multipliers of jumps are bounded, and slower where they enter by themselves.
    rows = [{m: p[m] for m in p if m not in held} for p, held in parts if all(len(m) == 1 for m in held)]
    for d in recession_directions(field.C):
        power = max((_degree_along(p, d) for p in rows), default=0)
        if power >= 2:
            return exact.doubles(d), power
    return None


def _degree_along(p: polynomial.Polynomial, d: np.ndarray) -> int:
    """The degree of t -> p(t d), by its highest coefficient that is not 0."""
    by_power: dict[int, Fraction] = {}
    for monomial, number in p.items():
        k = sum(power for _, power in monomial)
        by_power[k] = by_power.get(k, Fraction(0)) + polynomial.evaluate_polynomial({monomial: number}, d)
    return max((k for k, number in by_power.items() if number), default=0)
