"""Is a convex potential bounded below on its domain: proved term by term, by linear programming duality, or on a box's faces.

A quadratic plus weighted |a'x + c| and max(a'x + c, 0) on a polyhedron {N x + h >= 0} is bounded below if and only if its
stationarity system has a solution (Frank and Wolfe): H y + q + sum l_j a_j - N'n = 0, |l_j| <= w_j or 0 <= l_j <= w_j, n >= 0.
That is decided in rational arithmetic. The logarithm of a sum of exponentials differs from the largest exponent by no more than a
number, and counts as that. Polynomials are bounded by sums of squares. Other terms are left out where they have a lower bound of
their own.
"""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import exact, extremum, interval, one_variable, polynomial, polynomial_signs, sum_of_squares
from nsmodel.proof.convex.convex_sets import ConvexSet
from nsmodel.proof.convex.duality import additive_terms, decompose_potential, descent_direction, is_dual_feasible
from nsmodel.proof.convex.least_value import minimise_potential
from nsmodel.proof.convex.pieces import split_by_cases

UNBOUNDED_LEVEL = 1e12  # A least value below minus this, beside the value at the start, is no minimum.


class LowerBoundResult(NamedTuple):
    """What is known of inf g: ``bounded`` True or False where proved, None where not.

    ``bound`` is a rigorous lower bound where there is one (else -inf), ``value`` the least value met, at ``at``;
    ``direction`` is one of unbounded descent.
    """

    bounded: bool | None
    how: str
    bound: float
    value: float
    at: np.ndarray
    direction: np.ndarray | None = None


def decide_bounded_below(g: ca.SX, C: ConvexSet, start: np.ndarray, *, convex: bool) -> LowerBoundResult:
    """Decide inf g > -inf on C.

    Args:
        g: the potential without its domain, finite on C.
        C: the domain.
        start: a point to begin the search for the minimum at.
        convex: whether g is proved convex on all of C, not on a box only.
    """
    at, value = minimise_potential(g, C, start)
    exactly = _quadratic_minimum(g, C)
    if exactly is not None:
        return LowerBoundResult(True, "the minimum of a quadratic, exactly", exactly, max(value, exactly), at)
    low, _ = interval.enclose(g, C.x, *C.bounding_box)
    bound = float(np.min(low))
    if np.isfinite(bound):
        return LowerBoundResult(True, "bounds of g over its whole domain", bound, max(value, bound), at)
    separate = _separable_polynomial_bound(g, C)
    if separate is not None:
        return LowerBoundResult(
            True, "a sum of polynomials in one state each, bounded exactly", separate, max(value, separate), at
        )
    squares = _sum_of_squares_bound(g, C)
    if squares is not None:
        return LowerBoundResult(True, "a polynomial, bounded by sums of squares (exactly)", squares, max(value, squares), at)
    parts = decompose_potential(g, C)
    if parts is not None:
        P, kinks, largest, rest = parts
        duality = is_dual_feasible(P, kinks, largest, C.outer(at)[0])
        if duality:
            return LowerBoundResult(True, "the stationarity system has an exact solution", bound, value, at)
        if duality is False and not rest and C.is_polyhedron:
            direction = descent_direction(P, kinks, largest, C)
            if direction is not None:
                return LowerBoundResult(
                    False, "a direction of unbounded descent; no multipliers balance it", -np.inf, -np.inf, at, direction
                )
            return LowerBoundResult(None, "bounded below up to rounding only", -np.inf, value, at)
    if convex and np.isfinite(value):
        found = _bound_by_faces(g, C, at, value)
        if found is not None:
            return LowerBoundResult(True, "g is larger on the faces of a box around its minimum, and convex", found, value, at)
    direction = (
        _falling_direction(g, C, at) if value > -UNBOUNDED_LEVEL * (1 + abs(_finite_value(g, C, start))) else _unit_vector(at)
    )
    for ray in (direction, _falling_direction(g, C, start)):
        if ray is not None and _is_unbounded_along_ray(g, C, start, ray):
            return LowerBoundResult(
                False, "g falls without end along a ray (by its leading term there)", -np.inf, -np.inf, at, ray
            )
    if direction is not None:
        return LowerBoundResult(None, "g seems to fall without end", -np.inf, value, at, direction)
    return LowerBoundResult(None, "no lower bound was proved; the least value found is given", -np.inf, value, at)


def _quadratic_minimum(g: ca.SX, C: ConvexSet) -> float | None:
    """The least value of a convex quadratic without constraints, rounded down; None where it is not that."""
    P = polynomial.as_quadratic(polynomial.read_polynomials(g, C.x)[0], C.n)
    if P is None or C.rows.numel() or C.equalities.numel() or not exact.definiteness(P.H).psd:
        return None
    solved = exact.solve_linear_system(P.H, -P.q)
    return None if solved is None else exact.round_down(P.c + exact.matrix_product(P.q.T, solved)[0, 0] / 2)


def _unit_vector(v: np.ndarray) -> np.ndarray:
    """v / |v|, also where |v|^2 overflows."""
    v = v / np.abs(v).max()
    return v / np.linalg.norm(v)


def _finite_value(g: ca.SX, C: ConvexSet, point: np.ndarray) -> float:
    value = float(ca.Function("g", [C.x], [g])(point))
    return value if np.isfinite(value) else 0.0


def _separable_polynomial_bound(g: ca.SX, C: ConvexSet) -> float | None:
    """A lower bound of a sum of polynomials of degree > 2 in one state each, verified exactly; None where there is none."""
    (p,) = polynomial.read_polynomials(g, C.x)
    if p is None or polynomial.degree(p) <= 2 or any(len(monomial) > 1 for monomial in p):
        return None
    total = p.get((), Fraction(0))
    for i in polynomial.variables(p):
        c = polynomial.univariate_coefficients(
            {monomial: number for monomial, number in p.items() if monomial and monomial[0][0] == i}
        )
        a, b = (Fraction(float(end[i])) if np.isfinite(end[i]) else None for end in C.bounding_box)
        least = polynomial_signs.approximate_minimum(c, a, b)[0]
        levels = (
            [Fraction(least) - Fraction(less * (1 + abs(least))) for less in (1e-12, 1e-9, 1e-6)] if np.isfinite(least) else []
        )
        proved = [level for level in levels if polynomial_signs.negative_point([c[0] - level, *c[1:]], a, b) is None]
        if not proved:
            return None
        total += proved[0]
    return exact.round_down(total)


def _sum_of_squares_bound(g: ca.SX, C: ConvexSet) -> float | None:
    """A lower bound of a polynomial of degree > 2 plus terms with bounds of their own; None where there is none."""
    total: polynomial.Polynomial | None = {}
    rest = Fraction(0)
    for factor, term in additive_terms(g):
        (p,) = polynomial.read_polynomials(term, C.x)
        if p is not None:
            total = polynomial.add_multiple(total, p, factor)
            continue
        low, high = (float(np.ravel(end)[0]) for end in interval.enclose(term, C.x, *C.bounding_box))
        end = low if factor > 0 else high
        if not np.isfinite(end):
            return None
        rest += factor * Fraction(end)
    if polynomial.degree(total) <= 2:
        return None
    found = sum_of_squares.sos_lower_bound(total, C.n)
    return None if found is None else exact.round_down(found + rest)


# -- other convex functions --------------------------------------------------------------------------------------------


def _bound_by_faces(g: ca.SX, C: ConvexSet, at: np.ndarray, value: float) -> float | None:
    """A lower bound of a convex g on C: its bound on a box around ``at`` on whose faces it is larger than g(at).

    A convex function that is larger at every point of C on the box's boundary than at a point inside grows on along each ray.
    """
    scale = max(1.0, float(np.abs(at).max()))
    slack = float(np.max(interval.enclose(g, C.x, at, at)[1]))
    for size in (1.0, 10.0, 1000.0):
        low, high = np.maximum(at - size * scale, C.bounding_box[0]), np.minimum(at + size * scale, C.bounding_box[1])
        faces = [
            (i, end)
            for i in range(C.n)
            for end, hull in ((low[i], C.bounding_box[0][i]), (high[i], C.bounding_box[1][i]))
            if end != hull or not np.isfinite(hull)
        ]
        if all(_is_above_on_face(g, C, low, high, i, end, slack) for i, end in faces):
            found = extremum.supremum(-g, C.x, low, high, where=C.rows if C.rows.numel() else None, points=at[None, :])
            bound = -found.bound
            if np.isfinite(bound):
                return float(bound)
    return None


def _is_above_on_face(g: ca.SX, C: ConvexSet, low: np.ndarray, high: np.ndarray, i: int, end: float, level: float) -> bool:
    face_low, face_high = low.copy(), high.copy()
    face_low[i] = face_high[i] = end
    bound, _ = interval.enclose(g, C.x, face_low, face_high)
    if float(np.min(bound)) > level:
        return True
    found = extremum.supremum(-g, C.x, face_low, face_high, bound_to=-level)
    return bool(found.bound < -level)


def _falling_direction(g: ca.SX, C: ConvexSet, at: np.ndarray) -> np.ndarray | None:
    """A direction along which g keeps falling at three sizes, of the 2 n along the axes and the gradient's."""
    f = ca.Function("g", [C.x], [g, ca.gradient(g, C.x)])
    slope = np.array(f(at)[1]).ravel()
    directions = [*np.eye(C.n), *-np.eye(C.n)]
    if np.isfinite(slope).all() and np.linalg.norm(slope):
        directions.append(-slope / np.linalg.norm(slope))
    for d in directions:
        points = at + np.array([1.0, 1e3, 1e6])[:, None] * d
        values = np.array(f(points.T)[0]).ravel()
        if (C.values(points) >= 0).all() and np.isfinite(values).all() and (np.diff(values) < -1.0).all():
            return d
    return None


def _is_unbounded_along_ray(g: ca.SX, C: ConvexSet, start: np.ndarray, d: np.ndarray) -> bool:
    """Whether the ray start + t d stays in C, exactly, and g tends to -inf on it, by the leading term of its slope."""
    if C.rows.numel() and not (C.is_polyhedron and C.interior_margin(start) is not None):
        return False
    N, _ = C.half_spaces
    if any(number < 0 for number in exact.matrix_product(N, exact.rational(d[:, None])).ravel()):
        return False
    t = ca.SX.sym("t")
    terms = additive_terms(ca.substitute(g, C.x, ca.DM(start) + t * ca.DM(d)))
    found = split_by_cases(terms, t)
    if not found or not np.isfinite(float(ca.Function("g", [C.x], [g])(start))):
        return False
    return one_variable.tends_to_minus_infinity(terms, t, found[-1].low[1], found[-1].cases)
