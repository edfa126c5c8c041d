"""Tangent dissipativity (A3): <x, w> <= -alpha |x|^2 + beta for w in P_{T_C(x)}(G(x)), x in C.

With v in G(x), w = P_{T_C(x)} v and n = v - w in N_C(x): <x, w> = <x, v> - <x, n>, and <n, x - c> >= 0 for c in C,
|n| <= |v|, so that

    <x, w> <= <x, v> + d |v|,   d = |c| for the c of C nearest to 0 (0 where C holds 0).

An aligned multiplier adds at most <x, B l_0> + its offset to <x, v>, l_0 its element nearest to 0. So with
<x, rest(x)> <= -k |x|^2 + p |x| + q one has alpha = k/2, beta = p^2/(2 k) + q, as in Example 8.1.
"""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import sum_in_order
from nsmodel.hypotheses.findings import HOLDS, UNKNOWN
from nsmodel.models.monotone_inclusion import growth
from nsmodel.models.monotone_inclusion.cones import copositivity_multipliers
from nsmodel.models.monotone_inclusion.field import SelectedField
from nsmodel.models.monotone_inclusion.growth import nondissipative_curve, require_values, split_box
from nsmodel.models.monotone_inclusion.tangent_form import (
    TangentForm,
    aligned_offset,
    escape_direction,
    exact_tangent_form,
    nearest_point_to_zero,
    sample_quotient,
    sector_tangent_form,
)
from nsmodel.proof import exact, extremum, interval_bounds, polynomial, sum_of_squares
from nsmodel.proof.exact import ROUND_UP_FACTOR
from nsmodel.proof.verdict import HypothesisPart

# Rates k that are tried where terms beyond the quadratic ones fall faster than any: a larger k has a larger constant.
DECAY_RATES = 1.0, 0.125
# Slopes beyond 2^k are tried: with larger k they are nearer to those at infinity, and the constant grows.
SLOPE_EXPONENTS = (4, 8, 14, 20)


class DecayBound(NamedTuple):
    """<x, rest + nearest elements> <= -k |x|^2 + p |x| + q on C, k > 0; ``displaced``: d |v| is counted already."""

    k: float
    p: float
    q: float
    how: str
    displaced: bool = False


def dissipativity(field: SelectedField, a: HypothesisPart, *, quick: bool, reach: float = 0.0) -> HypothesisPart:
    """(A3) on C, and on each convex part of C with a point no farther than ``reach`` from 0.

    ``a`` is the finding of (A2), whose numbers enter where C does not hold 0.
    """
    return require_values(_dissipativity(field, a, quick, reach), field)


def _dissipativity(field: SelectedField, a: HypothesisPart, quick: bool, reach: float) -> HypothesisPart:
    base = nearest_point_to_zero(field.C)
    if base is None:
        return HypothesisPart(UNKNOWN, "no point of C near 0 was verified", {}, {})
    distance = max(float(np.linalg.norm(base)) * (ROUND_UP_FACTOR if base.any() else 1.0), reach)
    form = exact_tangent_form(field)
    bound = _decay_from_form(field, form, distance) or _decay_by_jacobian(field, base)
    tries = [] if bound is not None or field.C.bounded else [(k, merged) for merged in (False, True) for k in SLOPE_EXPONENTS]
    for k, merged in tries:
        first = form is None and k == SLOPE_EXPONENTS[0]
        bound = bound or _decay_from_form(
            field, sector_tangent_form(field, k, merged=merged), distance, cube=first and not distance
        )
    if bound is not None and distance > 0 and not bound.displaced:
        bound = _displaced_decay(bound, distance, a)
    if bound is not None:
        return _dissipativity_part(bound, field)
    if field.C.bounded:
        return _bounded_set_part(field, distance, quick=quick)
    return escape_direction(field, form) or nondissipative_curve(field) or sample_quotient(field)


def _decay_from_form(field: SelectedField, form: TangentForm | None, distance: float, *, cube: bool = True) -> DecayBound | None:
    """The bound from <x, rest> as a form; ``cube``: terms beyond the quadratic ones that couple states are looked at too."""
    return (
        _quadratic_decay(field, form)
        or (_decay_on_cone(field, form) if field.C.is_polyhedron and not field.C.bounded else None)
        or _superlinear_decay(field, form)
        or (_decay_by_squares(field, form) if cube and not distance else None)
        or (_homogeneous_decay(field, form, distance) if cube else None)
    )


# -- the bound <x, rest> <= -k |x|^2 + p |x| + q ------------------------------------------------------------------------


def _bounded_terms_text(field: SelectedField) -> str:
    return ", but for bounded terms" if any(row.size for row in growth.read_field_rows(field)) else ""


def _linear_bound(form: TangentForm) -> float:
    """|linear| + the jumps' share."""
    return growth.rounded_norm(exact.doubles(form.linear)) + form.others


def _quadratic_decay(field: SelectedField, form: TangentForm | None) -> DecayBound | None:
    """The form is quadratic and negative definite on the whole space, decided exactly."""
    if form is None or form.higher or not exact.definiteness(-form.Q).definite:
        return None
    k = _verified_rate(-form.Q)
    if k is None:
        return None
    how = "<x, F - S> is quadratic and negative definite (exact)" + _bounded_terms_text(field)
    return DecayBound(k, _linear_bound(form), exact.round_up(form.constant) + aligned_offset(field), how)


def _verified_rate(P: np.ndarray) -> float | None:
    """k in doubles with x'Px/2 >= k |x|^2, verified exactly: half the least eigenvalue of P, lowered by rounding where needed."""
    values = np.linalg.eigvalsh(exact.doubles(P)) / 2
    if len(P) == 1:
        return exact.round_down(Fraction(P[0, 0]) / 2)
    for less in (0.0, 1e-15, 1e-14, 1e-12, 1e-9, 1e-6):
        k = float(values[0]) - less * float(values[-1])
        if k > 0 and exact.definiteness(P - 2 * Fraction(k) * exact.eye(len(P))).psd:
            return k
    return None


def _decay_on_cone(field: SelectedField, form: TangentForm | None) -> DecayBound | None:
    """The form is quadratic and negative on the directions of C only: -Q/2 - k I - N'M N psd with M >= 0 entrywise.

    With y = N x + h >= 0, x'N'M N x = (y - h)'M(y - h) >= -2 h'M y + h'M h = -2 h'M N x - h'M h.
    """
    if form is None or form.higher:
        return None
    N, h = field.C.half_spaces
    found = copositivity_multipliers(-form.Q / 2, N)
    if found is None:
        return None
    k, M = found
    linear = form.linear + 2 * exact.matrix_product(N.T, M, h)
    constant = form.constant + exact.matrix_product(h.T, M, h)[0, 0]
    p = growth.rounded_norm(exact.doubles(linear)) + form.others
    how = "<x, F - S> is quadratic and negative on the directions in which C is unbounded (exact multipliers)"
    return DecayBound(k, p, exact.round_up(constant) + aligned_offset(field), how)


def _superlinear_decay(field: SelectedField, form: TangentForm | None) -> DecayBound | None:
    """Terms beyond the quadratic ones in one state each, falling at both ends of C: they dominate that state's square."""
    if form is None or not form.higher or any(len(monomial) > 1 for monomial in form.higher):
        return None
    n = field.x.numel()
    low, high = field.C.bounding_box
    strong = polynomial.variables(form.higher)
    size = max(1.0, float(np.abs(exact.doubles(form.Q)).max(initial=0.0)))
    for t in (1.0, 10.0, 100.0, 1e4):
        D = exact.zeros(n, n)
        for i in strong:
            D[i, i] = Fraction(t * size)
        P = 2 * D - form.Q  # x'Qx/2 <= x'Dx - k |x|^2
        k = _verified_rate(P) if exact.definiteness(P).definite else None
        if k is None:
            continue
        total = form.constant
        for i in strong:
            own = {monomial: number for monomial, number in form.higher.items() if monomial[0][0] == i}
            top = _polynomial_upper_bound(polynomial.add_multiple(own, {((i, 2),): D[i, i]}), low[i], high[i])
            if top is None:
                return None
            total += top
        how = "beyond the quadratic part, terms in one state each that fall at infinity (exact)"
        return DecayBound(k, _linear_bound(form), exact.round_up(total) + aligned_offset(field), how)
    return None


def _decay_by_squares(field: SelectedField, form: TangentForm | None) -> DecayBound | None:
    """The form is -k |x|^2 + c less a sum of squares, in rational arithmetic, with c as small as it can be for some k."""
    if form is None or not form.higher or polynomial.degree(form.higher) % 2 or not np.isfinite(form.others):
        return None
    n = field.x.numel()
    if _leading_maximum(form.higher, polynomial.degree(form.higher), n) > 0:
        return None
    p = polynomial.add_multiple({}, form.higher, Fraction(-1))
    for i in range(n):
        p = polynomial.add_multiple(p, {((i, 1),): -form.linear[i, 0]})
        for j in range(n):
            square = ((i, 2),) if i == j else ((min(i, j), 1), (max(i, j), 1))
            p = polynomial.add_multiple(p, {square: -form.Q[i, j] / 2})
    for k in DECAY_RATES:
        rest = polynomial.add_multiple(p, {((i, 2),): Fraction(1) for i in range(n)}, Fraction(-k))
        least = sum_of_squares.sos_lower_bound(rest, n)
        if least is not None:
            how = "<x, F - S> + k |x|^2 is a constant less a sum of squares (exact)" + _bounded_terms_text(field)
            return DecayBound(k, form.others, exact.round_up(form.constant - least) + aligned_offset(field), how)
    return None


def _homogeneous_decay(field: SelectedField, form: TangentForm | None, distance: float) -> DecayBound | None:
    """Terms beyond the quadratic ones whose highest form is negative: bounds on the faces of a cube, and scaling.

    A form of degree m is at most M r^m, r the largest |x_i|, with M its bound where r = 1; |x|^2 <= n r^2.
    """
    if form is None or not form.higher:
        return None
    n = field.x.numel()
    degree = polynomial.degree(form.higher)
    powers = sorted({sum(power for _, power in monomial) for monomial in form.higher} | {2})
    total: polynomial.Polynomial = {((0, 2),): Fraction(n)} if degree > 2 else {}
    if degree % 2 or not _leading_decay(form.higher, degree, n):
        return None
    for m in powers:
        part = {monomial: number for monomial, number in form.whole.items() if sum(power for _, power in monomial) == m}
        bound = _cube_bound(part, field.x, 0.5 * _leading_decay(form.higher, degree, n) if m == degree else None)
        bound = bound + form.slope * n * ROUND_UP_FACTOR if m == 2 else bound
        if not np.isfinite(bound) or (m == degree and bound >= 0):
            return None
        total = polynomial.add_multiple(total, {((0, m),): Fraction(bound)})
    if distance > 0:
        total = polynomial.add_multiple(total, _speed_polynomial(field, form), Fraction(distance))
    top = _polynomial_upper_bound(total, 0.0, np.inf)
    if top is None:
        return None
    how = "the highest form of <x, F - S> is negative on the faces of a cube (bounds), and dominates"
    return DecayBound(1.0, _linear_bound(form), exact.round_up(top + form.constant) + aligned_offset(field), how, True)


def _speed_polynomial(field: SelectedField, form: TangentForm) -> polynomial.Polynomial:
    """A polynomial in r = max |x_i| that |v| does not exceed."""
    n = field.x.numel()
    total: polynomial.Polynomial = {
        (): Fraction(form.others + sum_in_order(term.size for term in field.aligned) * ROUND_UP_FACTOR)
    }
    for row in growth.read_field_rows(field):
        for monomial, number in (row.p or {}).items():
            if all(v < n for v, _ in monomial):
                power = sum(power for _, power in monomial)
                total = polynomial.add_multiple(total, {((0, power),) if power else (): abs(number)})
    return polynomial.add_multiple(total, {((0, 1),): Fraction(form.slope * n * ROUND_UP_FACTOR)})


def _leading_decay(higher: polynomial.Polynomial, degree: int, n: int) -> float:
    """The largest value of the highest form seen where max |x_i| = 1, 0 where it is not negative at some point."""
    return min(_leading_maximum(higher, degree, n), 0.0)


def _leading_maximum(higher: polynomial.Polynomial, degree: int, n: int) -> float:
    """The largest value of the highest form seen where max |x_i| = 1."""
    rng = np.random.default_rng(0)
    points = np.vstack([np.eye(n), np.ones(n), rng.uniform(-1, 1, (200, n))])
    points /= np.abs(points).max(axis=1, keepdims=True)
    top = [(monomial, float(number)) for monomial, number in higher.items() if sum(power for _, power in monomial) == degree]
    values = sum(number * np.prod([points[:, v] ** power for v, power in monomial], axis=0) for monomial, number in top)
    return float(np.max(values))


def _cube_bound(part: polynomial.Polynomial, x: ca.SX, level: float | None) -> float:
    """A bound of a form where max |x_i| = 1: by cutting the cube's faces down to a ``level`` that will do, else natural."""
    n = x.numel()
    expr = ca.SX(0)
    for monomial, number in part.items():
        term = ca.SX(float(number))
        for variable, power in monomial:
            term *= x[variable] ** power
        expr += term
    # Coefficients rounded to doubles are off by this much at most.
    slack = sum((abs(Fraction(float(number)) - number) for number in part.values()), Fraction(0))
    worst = -np.inf
    for i in range(n):
        for end in (1.0,) if level is not None else (-1.0, 1.0):  # A form of even degree is even.
            low, high = -np.ones(n), np.ones(n)
            low[i] = high[i] = end
            natural = float(np.max(interval_bounds.enclose(expr, x, low, high)[1]))
            if level is not None and natural > level:
                natural = extremum.supremum(expr, x, low, high, bound_to=level).bound
            worst = max(worst, natural)
    return exact.round_up(Fraction(worst) + slack) if np.isfinite(worst) else np.inf


def _polynomial_upper_bound(p: polynomial.Polynomial, low: float, high: float) -> Fraction | None:
    """A number that a polynomial in one variable does not exceed on [low, high], verified exactly."""
    c = [-number for number in polynomial.univariate_coefficients(p)]
    a, b = (Fraction(end) if np.isfinite(end) else None for end in (low, high))
    least = polynomial.approximate_minimum(c, a, b)
    if not np.isfinite(least):
        return None
    for more in (1e-12, 1e-9, 1e-6):
        level = Fraction(float(-least + more * (1 + abs(least))))
        if polynomial.negative_point([c[0] + level, *c[1:]], a, b) is None:
            return max(level, Fraction(0))
    return None


def _decay_by_jacobian(field: SelectedField, base: np.ndarray) -> DecayBound | None:
    """rest is strongly monotone downwards on the hull of C, or outside a box B around a point c of C: its Jacobian.

    With M the largest |rest| on B, D its radius about c, and L < 0 bounding the symmetric Jacobian outside B: for x outside, y
    where the segment from c leaves B, <x - c, G(x) - G(y)> <= L |x - y| |x - c|, so that
    <x - c, G(x)> <= L |x - c|^2 + (|L| D + M) |x - c|; inside B that holds as well. B = {c} has D = 0, M = |rest(c)|.
    """
    if field.jumps:
        return None
    low, high = field.C.bounding_box
    J = ca.jacobian(field.rest, field.x)
    S = (J + J.T) / 2
    if not interval_bounds.is_continuous(field.rest, field.x, low, high):
        return None
    for half in (0.0, 1.0):
        box, outside = split_box(base, half, low, high)
        bounds = [extremum.largest_eigenvalue(S, field.x, *part, quick=True).bound for part in outside]
        L = max(bounds, default=-np.inf)
        if -np.inf < L < 0:
            at = interval_bounds.enclose(field.rest + ca.DM(field.shift), field.x, *box)
            M = float(np.linalg.norm(np.maximum(np.abs(at[0]), np.abs(at[1])))) * ROUND_UP_FACTOR
            D, d = half * float(np.sqrt(base.size)) * ROUND_UP_FACTOR, float(np.linalg.norm(base)) * ROUND_UP_FACTOR
            if np.isfinite(M):
                # |x - c| <= |x| + d; <c, v(x)> is added with the displacement of C.
                p = -L * D + M
                how = "bounds of the symmetric Jacobian on C, below 0" + (" outside a box" if half else "")
                return DecayBound(-L, 2 * -L * d + p, p * d + aligned_offset(field), how)
    return None


def _displaced_decay(bound: DecayBound, distance: float, a: HypothesisPart) -> DecayBound | None:
    """Add d |v| <= d (a_1 + a_2 |x|), twice where the Jacobian was used: once for the cone, once for its <c, v>."""
    a_1, a_2 = a.value.get("a_1", np.inf), a.value.get("a_2", np.inf)
    if a.verdict != HOLDS or not np.isfinite(a_1 + a_2):
        return None
    times = 2 if "Jacobian" in bound.how else 1
    how = f"{bound.how}; C does not hold 0, its distance {distance:.4g} enters beta"
    return DecayBound(bound.k, bound.p + times * distance * a_2, bound.q + times * distance * a_1, how)


def _dissipativity_part(bound: DecayBound, field: SelectedField) -> HypothesisPart:
    """-k |x|^2 + p |x| + q <= -(k/2) |x|^2 + p^2/(2 k) + q."""
    alpha, beta = bound.k / 2, max(bound.p**2 / (2 * bound.k) + bound.q, 0.0)
    return HypothesisPart(HOLDS, bound.how, {"alpha": alpha, "beta": beta}, {})


def _bounded_set_part(field: SelectedField, distance: float, *, quick: bool) -> HypothesisPart:
    """C is bounded: any alpha will do, here 1."""
    z, low, high = field.variables
    n = field.x.numel()
    reach = float(np.linalg.norm(np.maximum(np.abs(low[:n]), np.abs(high[:n])))) * ROUND_UP_FACTOR
    product = ca.dot(field.x, field.rest + ca.DM(field.shift)) + ca.sumsqr(field.x)
    rows = field.C.rows if field.C.rows.numel() else None
    top = extremum.supremum(product, z, low, high, where=rows, quick=quick)
    beta = top.bound + aligned_offset(field)
    if distance > 0:
        speed = extremum.supremum(ca.sumsqr(field.rest), z, low, high, quick=True)
        beta += distance * (
            float(np.sqrt(max(speed.bound, 0.0))) * ROUND_UP_FACTOR
            + sum_in_order(term.size for term in field.aligned) * ROUND_UP_FACTOR
        )
    if not np.isfinite(beta):
        return HypothesisPart(UNKNOWN, "F - S has no bound on the box that holds C", {}, {})
    how = f"C is bounded (|x| <= {reach:.4g}): with any alpha, here 1, beta is the largest <x, F - S> + |x|^2 on its box"
    return HypothesisPart(HOLDS, how, {"alpha": 1.0, "beta": max(beta, 0.0)}, {"bounded": "C"})
