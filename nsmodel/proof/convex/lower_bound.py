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
from nsmodel.proof.convex.duality import additive_terms, descent, parts_of, solves_dual
from nsmodel.proof.convex.least_value import least_value
from nsmodel.proof.convex.pieces import split

ENDLESS = 1e12  # A least value below minus this, beside the value at the start, is no minimum.


class Below(NamedTuple):
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


def bounded_below(g: ca.SX, C: ConvexSet, start: np.ndarray, *, convex: bool) -> Below:
    """Decide inf g > -inf on C.

    Args:
        g: the potential without its domain, finite on C.
        C: the domain.
        start: a point to begin the search for the minimum at.
        convex: whether g is proved convex on all of C, not on a box only.
    """
    at, value = least_value(g, C, start)
    exactly = _quadratic_minimum(g, C)
    if exactly is not None:
        return Below(True, "the minimum of a quadratic, exactly", exactly, max(value, exactly), at)
    low, _ = interval.enclose(g, C.x, *C.hull)
    bound = float(np.min(low))
    if np.isfinite(bound):
        return Below(True, "bounds of g over its whole domain", bound, max(value, bound), at)
    separate = _separate(g, C)
    if separate is not None:
        return Below(True, "a sum of polynomials in one state each, bounded exactly", separate, max(value, separate), at)
    squares = _by_squares(g, C)
    if squares is not None:
        return Below(True, "a polynomial, bounded by sums of squares (exactly)", squares, max(value, squares), at)
    parts = parts_of(g, C)
    if parts is not None:
        P, kinks, largest, rest = parts
        duality = solves_dual(P, kinks, largest, C.outer(at)[0])
        if duality:
            return Below(True, "the stationarity system has an exact solution", bound, value, at)
        if duality is False and not rest and C.is_polyhedron:
            direction = descent(P, kinks, largest, C)
            if direction is not None:
                return Below(
                    False, "a direction of unbounded descent; no multipliers balance it", -np.inf, -np.inf, at, direction
                )
            return Below(None, "bounded below up to rounding only", -np.inf, value, at)
    if convex and np.isfinite(value):
        found = _well(g, C, at, value)
        if found is not None:
            return Below(True, "g is larger on the faces of a box around its minimum, and convex", found, value, at)
    direction = _falls(g, C, at) if value > -ENDLESS * (1 + abs(_value(g, C, start))) else _unit(at)
    for ray in (direction, _falls(g, C, start)):
        if ray is not None and _falls_for_ever(g, C, start, ray):
            return Below(False, "g falls without end along a ray (by its leading term there)", -np.inf, -np.inf, at, ray)
    if direction is not None:
        return Below(None, "g seems to fall without end", -np.inf, value, at, direction)
    return Below(None, "no lower bound was proved; the least value found is given", -np.inf, value, at)


def _quadratic_minimum(g: ca.SX, C: ConvexSet) -> float | None:
    """The least value of a convex quadratic without constraints, rounded down; None where it is not that."""
    P = polynomial.quadratic(polynomial.read(g, C.x)[0], C.n)
    if P is None or C.rows.numel() or C.equalities.numel() or not exact.psd(P.H).psd:
        return None
    solved = exact.solve(P.H, -P.q)
    return None if solved is None else exact.down(P.c + exact.product(P.q.T, solved)[0, 0] / 2)


def _unit(v: np.ndarray) -> np.ndarray:
    """v / |v|, also where |v|^2 overflows."""
    v = v / np.abs(v).max()
    return v / np.linalg.norm(v)


def _value(g: ca.SX, C: ConvexSet, point: np.ndarray) -> float:
    value = float(ca.Function("g", [C.x], [g])(point))
    return value if np.isfinite(value) else 0.0


def _separate(g: ca.SX, C: ConvexSet) -> float | None:
    """A lower bound of a sum of polynomials of degree > 2 in one state each, verified exactly; None where there is none."""
    (p,) = polynomial.read(g, C.x)
    if p is None or polynomial.degree(p) <= 2 or any(len(monomial) > 1 for monomial in p):
        return None
    total = p.get((), Fraction(0))
    for i in polynomial.variables(p):
        c = polynomial.coefficients({monomial: number for monomial, number in p.items() if monomial and monomial[0][0] == i})
        a, b = (Fraction(float(end[i])) if np.isfinite(end[i]) else None for end in C.hull)
        least = polynomial_signs.minimum(c, a, b)[0]
        levels = (
            [Fraction(least) - Fraction(less * (1 + abs(least))) for less in (1e-12, 1e-9, 1e-6)] if np.isfinite(least) else []
        )
        proved = [level for level in levels if polynomial_signs.negative_point([c[0] - level, *c[1:]], a, b) is None]
        if not proved:
            return None
        total += proved[0]
    return exact.down(total)


def _by_squares(g: ca.SX, C: ConvexSet) -> float | None:
    """A lower bound of a polynomial of degree > 2 plus terms with bounds of their own; None where there is none."""
    total: polynomial.Polynomial | None = {}
    rest = Fraction(0)
    for factor, term in additive_terms(g):
        (p,) = polynomial.read(term, C.x)
        if p is not None:
            total = polynomial.add(total, p, factor)
            continue
        low, high = (float(np.ravel(end)[0]) for end in interval.enclose(term, C.x, *C.hull))
        end = low if factor > 0 else high
        if not np.isfinite(end):
            return None
        rest += factor * Fraction(end)
    if polynomial.degree(total) <= 2:
        return None
    found = sum_of_squares.lower_bound(total, C.n)
    return None if found is None else exact.down(found + rest)


# -- other convex functions --------------------------------------------------------------------------------------------


def _well(g: ca.SX, C: ConvexSet, at: np.ndarray, value: float) -> float | None:
    """A lower bound of a convex g on C: its bound on a box around ``at`` on whose faces it is larger than g(at).

    A convex function that is larger at every point of C on the box's boundary than at a point inside grows on along each ray.
    """
    scale = max(1.0, float(np.abs(at).max()))
    slack = float(np.max(interval.enclose(g, C.x, at, at)[1]))
    for size in (1.0, 10.0, 1000.0):
        low, high = np.maximum(at - size * scale, C.hull[0]), np.minimum(at + size * scale, C.hull[1])
        faces = [
            (i, end)
            for i in range(C.n)
            for end, hull in ((low[i], C.hull[0][i]), (high[i], C.hull[1][i]))
            if end != hull or not np.isfinite(hull)
        ]
        if all(_above_on_face(g, C, low, high, i, end, slack) for i, end in faces):
            found = extremum.supremum(-g, C.x, low, high, where=C.rows if C.rows.numel() else None, points=at[None, :])
            bound = -found.bound
            if np.isfinite(bound):
                return float(bound)
    return None


def _above_on_face(g: ca.SX, C: ConvexSet, low: np.ndarray, high: np.ndarray, i: int, end: float, level: float) -> bool:
    face_low, face_high = low.copy(), high.copy()
    face_low[i] = face_high[i] = end
    bound, _ = interval.enclose(g, C.x, face_low, face_high)
    if float(np.min(bound)) > level:
        return True
    found = extremum.supremum(-g, C.x, face_low, face_high, bound_to=-level)
    return bool(found.bound < -level)


def _falls(g: ca.SX, C: ConvexSet, at: np.ndarray) -> np.ndarray | None:
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


def _falls_for_ever(g: ca.SX, C: ConvexSet, start: np.ndarray, d: np.ndarray) -> bool:
    """Whether the ray start + t d stays in C, exactly, and g tends to -inf on it, by the leading term of its slope."""
    if C.rows.numel() and not (C.is_polyhedron and C.surely_inside(start) is not None):
        return False
    N, _ = C.half_spaces
    if any(number < 0 for number in exact.product(N, exact.rational(d[:, None])).ravel()):
        return False
    t = ca.SX.sym("t")
    terms = additive_terms(ca.substitute(g, C.x, ca.DM(start) + t * ca.DM(d)))
    found = split(terms, t)
    if not found or not np.isfinite(float(ca.Function("g", [C.x], [g])(start))):
        return False
    return one_variable.falls_without_end(terms, t, found[-1].low[1], found[-1].cases)
