"""<x, rest(x)> as a polynomial, with bounded and Lipschitz terms beside it; and the point of C nearest to 0.

Escapes from tangent dissipativity (A3): directions of C along which the state is not drawn back.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import product
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import sum_in_order
from nsmodel.hypotheses.findings import UNKNOWN, VIOLATED
from nsmodel.models.monotone_inclusion import growth
from nsmodel.models.monotone_inclusion.cones import recession_directions
from nsmodel.models.monotone_inclusion.field import SelectedField
from nsmodel.proof import exact, extremum, interval_bounds, polynomial
from nsmodel.proof.asymptotics import asymptotic_orders, polynomial_order, value_interval
from nsmodel.proof.convex import piecewise
from nsmodel.proof.convex.lower_bounds import minimise_potential
from nsmodel.proof.convex.rules import Ridges, find_ridges
from nsmodel.proof.convex.sets import ConvexSet, has_interior
from nsmodel.proof.exact import ROUND_UP_FACTOR
from nsmodel.proof.expression_graph import (
    additive_terms,
    is_double,
    is_same_expression,
    symbol_hashes,
)
from nsmodel.proof.monotone import extract_constant_factor
from nsmodel.proof.sectors import sector
from nsmodel.proof.verdict import HypothesisPart


class TangentForm(NamedTuple):
    """<x, rest(x, l_o) + shift> as a polynomial in x: x'Qx/2 + linear + constant, ``higher`` terms; l_o enters ``others`` only.

    ``others`` bounds the share of the jumps and of bounded terms: at most others |x|; ``degree`` is that of G; the share
    slope |x|^2 of Lipschitz terms is in Q, not in ``whole``.
    """

    Q: np.ndarray
    linear: np.ndarray
    constant: Fraction
    higher: polynomial.Polynomial
    others: float
    whole: polynomial.Polynomial
    degree: int
    slope: float


def exact_tangent_form(field: SelectedField) -> TangentForm | None:
    """<x, rest> exactly, but for terms of ``rest`` that are bounded on C; None where neither works for some term.

    The jumps must enter by constant columns.
    """
    n = field.x.numel()
    whole: polynomial.Polynomial = {}
    degree, rows = 0, growth.read_field_rows(field)
    for i, (p, _, _) in enumerate(rows):
        if p is None:
            return None
        degree = max(degree, polynomial.degree(p))
        own = {monomial: number for monomial, number in p.items() if all(v < n for v, _ in monomial)}
        if any(len(monomial) != 1 or monomial[0][1] != 1 for monomial in p if monomial not in own):
            return None
        term = polynomial.multiply(own, {((i, 1),): Fraction(1)})
        if term is None:
            return None
        whole = polynomial.add_multiple(whole, term)
    others = float(np.linalg.norm([row.size for row in rows])) * (ROUND_UP_FACTOR if n > 1 else 1.0)
    slope = float(np.linalg.norm([row.slope for row in rows])) * (ROUND_UP_FACTOR if n > 1 else 1.0)
    for jump in field.jumps:
        column = np.array([float(entry) for entry in ca.vertsplit(jump.B)]) if jump.B.is_constant() else np.full(n, np.inf)
        others += float(np.linalg.norm(column)) * max(abs(jump.lower), abs(jump.upper)) * ROUND_UP_FACTOR
    for i, number in enumerate(field.shift):
        if number:
            whole = polynomial.add_multiple(whole, {((i, 1),): Fraction(float(number))})
    return _build_tangent_form(whole, n, others, degree, slope)


def sector_tangent_form(field: SelectedField, k: int, *, merged: bool) -> TangentForm | None:
    """The same, with what <x, rest> gains at infinity: the slopes of its terms are those beyond 2^k.

    - (c'x) h(a'x) with c = b a + d: b s h(s) <= b m s^2 + |b| r |s| where h lies between two lines, s = a'x, m the larger slope
      for b > 0 and the smaller one for b < 0; the share of d is that of a term at most |d| (r + |m s|).
    - x_i psi x_i with psi a function of |x|^2: at most m x_i^2 + R^2 max (psi - m), m the largest psi beyond R^2 = 2^k.
    - Other terms of row i: |x_i| (a + b |x|) where their growth is linear.

    ``merged``: polynomials of one direction are taken as such functions too, and may make up for others.
    """
    terms = _TangentTerms(field, k)
    for i, row in enumerate(ca.vertsplit(field.rest)):
        for outer, inner in additive_terms(row):
            number, term = extract_constant_factor(inner)
            if not terms.add(i, outer * number, term, merged):
                return None
    whole, extra, rest_slope = terms.whole, 0.0, 0.0
    for direction, own in terms.ridges.items():
        found = _ridge_sector_bound(field, np.array(direction, dtype=object), own, terms.s, k)
        if found is None:
            return None
        p, size, slope = found
        whole, extra, rest_slope = polynomial.add_multiple(whole, p), extra + size, rest_slope + slope
    others = (float(np.linalg.norm(terms.sizes)) + extra) * ROUND_UP_FACTOR
    slope = (float(np.linalg.norm(terms.slopes)) + rest_slope) * ROUND_UP_FACTOR
    for i, number in enumerate(field.shift):
        if number:
            whole = polynomial.add_multiple(whole, {((i, 1),): Fraction(float(number))})
    whole = polynomial.add_multiple(whole, {(): terms.constant}) if terms.constant else whole
    return _build_tangent_form(whole, field.x.numel(), others, terms.degree, slope)


class _TangentTerms:
    """The terms of <x, rest>, sorted by what bounds them.

    Attributes:
        whole, degree, constant: the polynomial, the degree of what was one, and the constants of radial terms.
        ridges: by direction a, the functions h of s = a'x with their c.
        sizes, slopes: of the other terms of each row.
    """

    def __init__(self, field: SelectedField, k: int) -> None:
        n = field.x.numel()
        self._field, self._k = field, k
        self.whole: polynomial.Polynomial = {}
        self.degree, self.constant = 0, Fraction(0)
        self.ridges: dict[tuple[Fraction, ...], list[tuple[ca.SX, list[Fraction]]]] = {}
        self.s = ca.SX.sym("s")
        self.sizes, self.slopes = np.zeros(n), np.zeros(n)

    def add(self, i: int, factor: Fraction, term: ca.SX, merged: bool) -> bool:
        """Take in factor times a term of row i; False where the polynomial becomes too long."""
        field = self._field
        (p,) = polynomial.read_polynomials(term, field.x)
        linear = p is not None and polynomial.degree(p) <= 1
        split = None if linear or (p is not None and not merged) else find_ridges(term, field.x)
        if split is not None and split.s.numel() == 1:
            self._add_ridge(i, factor, split)
            return True
        if p is not None:
            self.degree = max(self.degree, polynomial.degree(p))
            longer = polynomial.multiply(p, {((i, 1),): factor})
            self.whole = self.whole if longer is None else polynomial.add_multiple(self.whole, longer)
            return longer is not None
        radial = _radial_bound(factor, term, i, field, self._k)
        if radial is not None:
            self.whole = polynomial.add_multiple(self.whole, {((i, 2),): Fraction(radial[0])})
            self.constant += Fraction(radial[1])
            return True
        size, slope = growth.term_bound(term, field, *field.variables, 2.0**self._k)
        self.sizes[i] += float(abs(factor)) * size * ROUND_UP_FACTOR
        self.slopes[i] += float(abs(factor)) * slope * ROUND_UP_FACTOR
        return True

    def _add_ridge(self, i: int, factor: Fraction, split: Ridges) -> None:
        h = ca.substitute(split.h, split.s, self.s)
        own = self.ridges.setdefault(tuple(split.a[0]), [])
        place = next((c for other, c in own if is_same_expression(other, h)), None)
        if place is None:
            place = [Fraction(0)] * self._field.x.numel()
            own.append((h, place))
        place[i] += factor


def _build_tangent_form(whole: polynomial.Polynomial, n: int, others: float, degree: int, slope: float) -> TangentForm | None:
    low = {monomial: number for monomial, number in whole.items() if sum(power for _, power in monomial) <= 2}
    found = polynomial.as_quadratic(low, n)
    if found is None or not np.isfinite(others + slope):
        return None
    higher = {monomial: number for monomial, number in whole.items() if monomial not in low}
    Q = found.H + 2 * Fraction(slope) * exact.eye(n)
    return TangentForm(Q, found.q, found.c, higher, others, whole, degree, slope)


def _ridge_sector_bound(
    field: SelectedField, a: np.ndarray, terms: list[tuple[ca.SX, list[Fraction]]], s: ca.SX, k: int
) -> tuple[polynomial.Polynomial, float, float] | None:
    """(p, r, b) with sum of (c'x) h(a'x) <= p(x) + r |x| + b |x|^2."""
    n = len(a)
    ends = Ridges(s, s, a[None, :]).box(*field.C.bounding_box)
    length = growth.rounded_norm(exact.doubles(a[None, :]))
    j = next(i for i, number in enumerate(a) if number)
    p: polynomial.Polynomial = {}
    size = slope = 0.0
    # What is parallel to a is one function of s, so that its terms may make up for each other.
    along, whole = ca.SX(0), terms[0][1][j] / a[j] if len(terms) == 1 else Fraction(1)
    for h, c in terms:
        b = c[j] / a[j] if len(terms) == 1 else Fraction(float(c[j] / a[j]))
        along += (float((b > 0) - (b < 0)) if len(terms) == 1 else float(b)) * h
        left = [number - b * entry for number, entry in zip(c, a, strict=True)]
        (exactly,) = polynomial.read_polynomials(h, s)
        if any(left) and exactly is not None:
            longer = _compose_ridge(left, exactly, a)
            if longer is None:
                return None
            p = polynomial.add_multiple(p, longer)
        elif any(left):
            found = sector(h, s, ends[0][0], ends[1][0], k)
            if found is None or not found.bounded:
                return None
            middle = found.low + (found.high - found.low) / 2
            width = max(found.high - middle, middle - found.low)
            distance = growth.rounded_norm(exact.doubles(np.array([left], dtype=object)))
            size, slope = size + distance * found.reach * ROUND_UP_FACTOR, slope + distance * width * length * ROUND_UP_FACTOR
            for u, v in product(range(n), range(n)):
                number = left[u] * Fraction(middle) * a[v]
                p = polynomial.add_multiple(p, _quadratic_term(u, v, number))
    found = sector(along, s, ends[0][0], ends[1][0], k)
    if found is None or not np.isfinite(found.high):
        (exactly,) = polynomial.read_polynomials(along, s)
        longer = None if exactly is None else _compose_ridge([abs(whole) * number for number in a], exactly, a)
        return None if longer is None else (polynomial.add_multiple(p, longer), size, slope)
    for u, v in product(range(n), range(n)):
        p = polynomial.add_multiple(p, _quadratic_term(u, v, abs(whole) * Fraction(found.high) * a[u] * a[v]))
    return p, size + exact.round_up(abs(whole)) * found.reach * length * ROUND_UP_FACTOR, slope


def _compose_ridge(c: Sequence[Fraction], h: polynomial.Polynomial, a: np.ndarray) -> polynomial.Polynomial | None:
    """(c'x) h(a'x) as a polynomial in x; None where it is too long."""
    direction: polynomial.Polynomial = {((i, 1),): number for i, number in enumerate(a) if number}
    total: polynomial.Polynomial = {}
    factor: polynomial.Polynomial | None = {((i, 1),): number for i, number in enumerate(c) if number}
    for number in polynomial.univariate_coefficients(h):
        if factor is None:
            return None
        total = polynomial.add_multiple(total, factor, number) if number else total
        factor = polynomial.multiply(factor, direction)
    return total


def _quadratic_term(u: int, v: int, number: Fraction) -> polynomial.Polynomial:
    if not number:
        return {}
    return {((u, 2),): number} if u == v else {((min(u, v), 1), (max(u, v), 1)): number}


def _radial_bound(factor: Fraction, term: ca.SX, i: int, field: SelectedField, k: int) -> tuple[float, float] | None:
    """(m, q) with factor times x_i term <= m x_i^2 + q, where the term is x_i psi: psi of |x|^2, or bounded on the hull of C."""
    psi = _without_factor(term, i, field.x)
    if psi is None:
        return None
    psi = float(factor) * psi if is_double(factor) else None
    if psi is None:
        return None
    square = ca.SX.sym("square")
    radial_function = as_function_of_square(psi, field.x, square)
    if radial_function is not None:
        (order,) = asymptotic_orders(radial_function, square, [polynomial_order([0, 1], k)], k)
        top = np.inf if order is None else float(value_interval(order, k)[1][0])
        if np.isfinite(top):
            inner = extremum.supremum(radial_function, square, np.zeros(1), np.array([2.0**k]), quick=True).bound
            if np.isfinite(inner):
                return top, max(inner - top, 0.0) * 2.0**k * ROUND_UP_FACTOR
    z, low, high = field.variables
    top = float(np.max(interval_bounds.enclose(psi, z, low, high)[1]))
    return (top, 0.0) if np.isfinite(top) else None


def _without_factor(term: ca.SX, i: int, x: ca.SX) -> ca.SX | None:
    """The term without a factor c x_i, c put in; None where it is not seen."""
    (p,) = polynomial.read_polynomials(term, x)
    if p is not None:
        number = p.get(((i, 1),))
        return ca.SX(float(number)) if number is not None and len(p) == 1 and is_double(number) else None
    op = term.op()
    if op == ca.OP_MUL:
        for one, other in ((0, 1), (1, 0)):
            left = _without_factor(term.dep(one), i, x)
            if left is not None:
                return left * term.dep(other)
    if op == ca.OP_DIV:
        left = _without_factor(term.dep(0), i, x)
        return None if left is None else left / term.dep(1)
    if op == ca.OP_NEG:
        left = _without_factor(term.dep(0), i, x)
        return None if left is None else -left
    return None


def as_function_of_square(expr: ca.SX, x: ca.SX, square: ca.SX) -> ca.SX | None:
    """A function of |x|^2 written with the symbol ``square``; None where it is not seen to be one."""
    n = x.numel()
    place = {entry.element_hash(): i for i, entry in enumerate(ca.vertsplit(x))}

    def write(p: polynomial.Polynomial) -> ca.SX:
        (number, *more) = {p.get(((i, 2),)) for i in range(n)}
        offset = p.get((), Fraction(0))
        if (
            more
            or number is None
            or set(p) - {()} != {((i, 2),) for i in range(n)}
            or not (is_double(number) and is_double(offset))
        ):
            raise ValueError("not a function of the square, or a coefficient is no double")
        return float(number) * square + float(offset)

    def variable(entry: ca.SX) -> polynomial.Polynomial | None:
        i = place.get(entry.element_hash())
        return None if i is None else {((i, 1),): Fraction(1)}

    try:
        result = polynomial.rewrite_parts(expr, variable, write, most=2)
    except ValueError:
        return None
    return result if not symbol_hashes(result) - symbol_hashes(square) else None


def aligned_offset(field: SelectedField) -> float:
    """What the aligned multipliers add to <x, v> at most, beside their nearest elements to 0."""
    return sum_in_order(term.offset for term in field.aligned) * (ROUND_UP_FACTOR if len(field.aligned) > 1 else 1.0)


def nearest_point_to_zero(C: ConvexSet) -> np.ndarray | None:
    """A point of C, surely in it, as near to 0 as doubles make it."""
    zero = np.zeros(C.n)
    if is_point_in_set(C, zero):
        return zero
    clipped = np.clip(zero, *C.bounding_box)
    if is_point_in_set(C, clipped):
        return clipped
    inner = has_interior(C, clipped).witness.get("interior point")
    if inner is None:
        return None
    near, _ = minimise_potential(ca.sumsqr(C.x), C, np.asarray(inner))
    for part in (0.0, 1e-9, 1e-6, 1e-3, 1e-1, 1.0):
        point = near + part * (np.asarray(inner) - near)
        if is_point_in_set(C, point):
            return point
    return None


def is_point_in_set(C: ConvexSet, point: np.ndarray) -> bool:
    """Whether a point is in C, exactly where the rows are polynomials, else by intervals."""
    x = [Fraction(float(entry)) for entry in point]
    for i, p in enumerate(C.polynomials):
        if p is not None:
            if polynomial.evaluate_polynomial(p, x) < 0:
                return False
        elif not float(np.min(interval_bounds.enclose(C.rows[i], C.x, point, point)[0])) >= 0:
            return False
    return True


ESCAPE_SIZES = (1e3, 1e6)  # Sizes at which an escape is looked for: far out beside numbers of a usual model; it proves nothing.


def escape_direction(field: SelectedField, form: TangentForm | None) -> HypothesisPart | None:
    """A direction d of a polyhedral C along which <x, w>/|x|^2 does not become negative.

    <x, n> stays below a constant times |v| on a polyhedron, so that the highest power of t in <t d, G(t d)> decides where it is
    above that of |G|: escape with a factor > 0, or, where G is affine, with a power below the second. Without constraints n = 0.
    """
    C = field.C
    if not C.is_polyhedron:
        return None
    if form is None or form.slope:
        return _escape_along_rays(field)
    vectors = np.linalg.eigh(exact.doubles(form.Q))[1].T[::-1]
    kernel = exact.doubles(exact.nullspace(form.Q)).T
    for d in recession_directions(C, np.vstack([vectors, kernel])):
        rates: dict[int, Fraction] = {}
        for monomial, number in form.whole.items():
            k = sum(power for _, power in monomial)
            rates[k] = rates.get(k, Fraction(0)) + polynomial.evaluate_polynomial({monomial: number}, d)
        rates = {k: number for k, number in rates.items() if number}
        power = max(rates, default=0)
        if _is_escape(power, rates.get(power, Fraction(0)), form.degree, not C.rows.numel()):
            return _escape_part(d, power, rates.get(power, Fraction(0)))
    return None


def _is_escape(power: int, rate: Fraction, degree: int, free: bool) -> bool:
    if power >= 2:
        return rate > 0 and (free or power > degree)
    return free or degree <= 1


def _escape_along_rays(field: SelectedField) -> HypothesisPart | None:
    """The same for a G that is a polynomial on pieces of each ray t d in C: the last piece decides."""
    C, t = field.C, ca.SX.sym("t")
    if field.jumps or not is_point_in_set(C, np.zeros(C.n)):
        return None
    shifted = field.rest + ca.DM(field.shift)
    for d in recession_directions(C):
        along = ca.substitute(shifted, field.x, ca.DM(exact.doubles(d)) * t)
        rows = [piecewise.polynomial_pieces(row, t) for row in ca.vertsplit(along)]
        if any(row is None for row in rows):
            return None
        last = [row[-1].c for row in rows if row]
        degree = max(_leading_degree(c) for c in last)
        rates = [sum((d[i] * c[k] for i, c in enumerate(last) if k < len(c)), Fraction(0)) for k in range(degree + 1)]
        power = max((k + 1 for k, rate in enumerate(rates) if rate), default=0)
        rate = rates[power - 1] if power else Fraction(0)
        if _is_escape(power, rate, degree, not C.rows.numel()):
            return _escape_part(d, power, rate)
    return None


def _leading_degree(c: list[Fraction]) -> int:
    return max((k for k, number in enumerate(c) if number), default=0)


def _escape_part(d: np.ndarray, power: int, rate: Fraction) -> HypothesisPart:
    direction = exact.doubles(d)
    size = float(np.linalg.norm(direction))
    direction = direction / size
    how = f"along d, a direction in which C is unbounded, <x, F - S> grows like |x|^{power}: no alpha > 0 bounds it (exact)"
    if power < 2:
        how = "along d, a direction in which C is unbounded, <x, F - S> has no part -alpha |x|^2, alpha > 0 (exact)"
    value: dict[str, float] = {
        "<d, A d>" if power <= 2 else f"rate of |x|^{power}": float(rate) / size**power if power >= 2 else 0.0
    }
    witness: dict[str, Any] = {"direction": direction}
    return HypothesisPart(VIOLATED, how, value, witness)


def sample_quotient(field: SelectedField) -> HypothesisPart:
    """No proof: the quotient <x, v>/|x|^2 far out in C."""
    C = field.C
    rng = np.random.default_rng(0)
    d = rng.normal(size=(256, C.n))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    low, high = C.bounding_box
    points = np.vstack([np.clip(size * d, low, high) for size in ESCAPE_SIZES])
    points = points[(C.values(points) >= 0).all(axis=1) & (np.linalg.norm(points, axis=1) >= ESCAPE_SIZES[0] / 2)]
    z, ends, _ = field.variables
    f = ca.Function("quotient", [z], [ca.dot(field.x, field.rest + ca.DM(field.shift)) / ca.sumsqr(field.x)])
    inputs = np.hstack([points, np.tile(ends[C.n :], (len(points), 1))])
    values = np.array(f(inputs.T)).ravel() if len(points) else np.zeros(0)
    kept = np.isfinite(values)
    if not kept.any():
        return HypothesisPart(UNKNOWN, "C is unbounded, and neither alpha and beta nor an escape were found", {}, {})
    k = int(np.argmax(np.where(kept, values, -np.inf)))
    worst = {"largest <x, v>/|x|^2 far out": float(values[k])}
    if values[k] < 0:
        how = (
            f"<x, v>/|x|^2 < 0 at {int(kept.sum())} points of C with |x| from {ESCAPE_SIZES[0]:g} to {ESCAPE_SIZES[1]:g}, "
            "but no alpha was proved"
        )
        return HypothesisPart(UNKNOWN, how, worst, {"x": points[k]})
    return HypothesisPart(
        UNKNOWN, "C is unbounded, and no alpha and beta were found; far out <x, v> is not negative", worst, {"x": points[k]}
    )
