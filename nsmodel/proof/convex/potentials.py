"""Is a potential convex on its domain: exactly where it is quadratic, by the rules of convex functions, else by its Hessian."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import exact, extremum, interval_bounds, polynomial, sum_of_squares, univariate
from nsmodel.proof.convex import rules
from nsmodel.proof.convex.directions import is_convex_by_directions
from nsmodel.proof.convex.piecewise import exact_value
from nsmodel.proof.convex.rules import Ridges, find_ridges
from nsmodel.proof.convex.sets import ConvexSet
from nsmodel.proof.exact import MACHINE_EPSILON
from nsmodel.proof.expression_graph import additive_terms, is_same_expression, rewrite_nodes
from nsmodel.proof.verdict import HOLDS, SAMPLED, VIOLATED, HypothesisPart

# A negative eigenvalue of at most this part of the largest is not told from 0: a formula of some dozen operations loses as much.
EIGENVALUE_ROUNDING = 64 * MACHINE_EPSILON
# Directions of a potential that are looked at together: the box of all of them is cut. Of more, convexity is left open.
MAX_DIRECTIONS = 12
# How far from a kink a witness is taken, beside its place: the largest is the easiest to check, smaller ones fit between kinks.
WITNESS_DISTANCES = 1e-2, 1e-4, 1e-6
MIN_EIGENVALUE_KEY, EIGENVALUE_BOUND_KEY = "least eigenvalue of D2 g", "eigenvalues of D2 g are at least"


class SmoothSplit(NamedTuple):
    """A potential as ``smooth`` plus terms each proved convex for all x."""

    smooth: ca.SX
    convex: bool  # Whether the smooth part is proved convex for all x as well.
    whole: bool  # Whether it is all of the potential.


def is_convex_potential(g: ca.SX, C: ConvexSet, lower: np.ndarray, upper: np.ndarray, *, quick: bool) -> HypothesisPart:
    """Decide whether g, finite on C, is convex there; the value holds the least eigenvalue of the Hessian of its smooth part."""
    P = polynomial.as_quadratic(polynomial.read_polynomials(g, C.x)[0], C.n)
    if P is not None:
        return _check_quadratic(P, C)
    parts = _split_smooth_part(g, C.x)
    P = polynomial.as_quadratic(polynomial.read_polynomials(parts.smooth, C.x)[0], C.n)
    if P is not None:
        found = _check_quadratic(P, C)
        if found.verdict != HOLDS and not parts.whole:
            return _check_whole_potential(g, C, (np.maximum(C.bounding_box[0], lower), np.minimum(C.bounding_box[1], upper)))
        if found.verdict != HOLDS or P.H.any():
            return found._replace(how=f"terms convex by the rules of convex functions, and a quadratic: {found.how}")
        return found._replace(how="by the rules of convex functions")
    H = ca.densify(ca.hessian(parts.smooth, C.x)[0])
    low, high = np.maximum(C.bounding_box[0], lower), np.minimum(C.bounding_box[1], upper)
    if parts.convex or rules.global_curvatures(g, C.x)[0].convex:
        return HypothesisPart(HOLDS, "by the rules of convex functions", {EIGENVALUE_BOUND_KEY: 0.0}, {})
    if _is_separable_convex(parts.smooth, C):
        return HypothesisPart(
            HOLDS, "a sum of polynomials in one state each, their signs decided exactly", {EIGENVALUE_BOUND_KEY: 0.0}, {}
        )
    if is_convex_by_directions(g, C):
        how = "a sum of functions of one direction each, the signs of their second derivatives decided"
        return HypothesisPart(HOLDS, how, {EIGENVALUE_BOUND_KEY: 0.0}, {})
    if _is_sos_convex_part(parts.smooth, C):
        return HypothesisPart(
            HOLDS, "a polynomial, y'D2g(x) y being a sum of squares in x and y (exactly)", {EIGENVALUE_BOUND_KEY: 0.0}, {}
        )
    if _is_composed_convex(g, C):
        return HypothesisPart(
            HOLDS,
            "a convex nondecreasing function of a convex one, by the sign of its second derivative",
            {EIGENVALUE_BOUND_KEY: 0.0},
            {},
        )
    found = _check_hessian(parts.smooth, H, C, (low, high), quick=quick)
    return found if found.verdict == HOLDS or parts.whole else _check_whole_potential(g, C, (low, high))


def _check_quadratic(P: polynomial.Quadratic, C: ConvexSet) -> HypothesisPart:
    decided, H = exact.definiteness(P.H), exact.doubles(P.H)
    values, vectors = np.linalg.eigh(H) if C.n else (np.zeros(0), np.zeros((0, 0)))
    least, size = float(values.min(initial=np.inf)), float(np.abs(values).max(initial=0.0))
    if decided.psd:
        # Its exact sign is known: a double below 0 is rounding.
        return HypothesisPart(
            HOLDS, "the constant Hessian is psd in exact arithmetic", {MIN_EIGENVALUE_KEY: _round_down_eigenvalue(H, least)}, {}
        )
    witness = {"vector": vectors[:, 0], "x": "any"}
    if least >= -EIGENVALUE_ROUNDING * size:
        how = "the constant Hessian is psd up to rounding only"
        return HypothesisPart(SAMPLED, how, {MIN_EIGENVALUE_KEY: least, "rounding bound": EIGENVALUE_ROUNDING * size}, witness)
    return HypothesisPart(VIOLATED, "the constant Hessian has a negative eigenvalue", {MIN_EIGENVALUE_KEY: least}, witness)


def _round_down_eigenvalue(H: np.ndarray, least: float) -> float:
    """The least eigenvalue of a psd matrix, rounded down where it is not read off the diagonal."""
    if not np.any(H - np.diag(np.diag(H))):
        return float(np.diag(H).min(initial=np.inf))
    return max(least - 16 * len(H) * MACHINE_EPSILON * float(np.abs(np.linalg.eigvalsh(H)).max()), 0.0)


def _split_smooth_part(g: ca.SX, x: ca.SX) -> SmoothSplit:
    """Set aside the convex terms with kinks; what is left is to be smooth, quadratic terms included."""
    kept, proved, whole = ca.SX(0), True, True
    terms = additive_terms(g)
    scaled = [product for product in (_scale_exactly(factor, term) for factor, term in terms) if product is not None]
    if len(scaled) < len(terms):
        return SmoothSplit(g, False, True)
    shapes = rules.global_curvatures(ca.vertcat(*scaled), x)
    polynomials = polynomial.read_polynomials(ca.vertcat(*scaled), x)
    for term, shape, p in zip(scaled, shapes, polynomials, strict=True):
        if shape.convex and p is None and not _is_smooth_everywhere(term, x):
            whole = False
            continue
        kept += term
        proved = proved and shape.convex
    return SmoothSplit(kept, proved, whole)


def _scale_exactly(factor: Fraction, term: ca.SX) -> ca.SX | None:
    """The same number as a real one, without rounding; None where doubles do not hold it."""
    top, bottom = float(factor.numerator), float(factor.denominator)
    if Fraction(float(factor)) == factor:
        return float(factor) * term
    return top * term / bottom if (Fraction(top), Fraction(bottom)) == (factor.numerator, factor.denominator) else None


def _is_smooth_everywhere(term: ca.SX, x: ca.SX) -> bool:
    unbounded = np.full(x.numel(), np.inf)
    return interval_bounds.is_continuous(ca.vertcat(term, ca.gradient(term, x)), x, -unbounded, unbounded)


def _is_separable_convex(smooth: ca.SX, C: ConvexSet) -> bool:
    """Whether the smooth part is a sum of convex polynomials in one state each, for all x."""
    (p,) = polynomial.read_polynomials(smooth, C.x)
    if p is None or any(len(monomial) > 1 for monomial in p):
        return False
    for variable in polynomial.variables(p):
        own = {monomial: number for monomial, number in p.items() if monomial and monomial[0][0] == variable}
        second = polynomial.derivative_coefficients(polynomial.derivative_coefficients(polynomial.univariate_coefficients(own)))
        if polynomial.negative_point(second, None, None) is not None:
            return False
    return True


def _is_sos_convex_part(smooth: ca.SX, C: ConvexSet) -> bool:
    """Whether the smooth part is a polynomial proved convex for all x by sums of squares."""
    (p,) = polynomial.read_polynomials(smooth, C.x)
    return p is not None and polynomial.degree(p) > 2 and sum_of_squares.is_sos_convex(p, C.n)


def _is_composed_convex(g: ca.SX, C: ConvexSet) -> bool:
    """Whether g = h(q) with a convex quadratic q >= 0 and an h that is convex and nondecreasing on [0, inf)."""
    squares: list[ca.SX] = []

    def collect(op: int, args: list[ca.SX], old: ca.SX) -> None:
        if not any(is_same_expression(old, other) for other in squares):
            squares.append(old)

    rewrite_nodes(g, collect, (ca.OP_SQ, ca.OP_ADD), C.x, "potential")
    for q in squares:
        (p,) = polynomial.read_polynomials(q, C.x)
        P = polynomial.as_quadratic(p, C.n)
        if (
            P is None
            or not polynomial.degree(p or {}) == 2
            or not exact.definiteness(P.H).psd
            or float(np.min(interval_bounds.enclose(q, C.x, *_unbounded_box(C))[0])) < 0
        ):
            continue
        r = ca.SX.sym("r")
        h = rewrite_nodes(
            g, lambda op, args, old, q=q, r=r: r if is_same_expression(old, q) else None, (ca.OP_SQ, ca.OP_ADD), C.x, "potential"
        )
        if ca.depends_on(h, C.x):
            continue
        terms = additive_terms(h)
        zero, cases = Fraction(0), [{} for _ in terms]
        found = univariate.second_derivative_signs(terms, r, zero, None, cases, zero)
        if found is None or min(found.signs) < 0:
            continue
        slope = ca.gradient(h, r)
        if interval_bounds.is_continuous(ca.vertcat(h, slope), r, np.zeros(1), np.ones(1)):
            number = exact_value(slope, r, zero)
            if number is not None and number >= 0:
                return True
    return False


def _unbounded_box(C: ConvexSet) -> tuple[np.ndarray, np.ndarray]:
    return np.full(C.n, -np.inf), np.full(C.n, np.inf)


def _check_hessian(smooth: ca.SX, H: ca.SX, C: ConvexSet, box: tuple[np.ndarray, np.ndarray], *, quick: bool) -> HypothesisPart:
    """Bounds of the eigenvalues of -D2 g: on the box that holds C, then on the box looked at."""
    gradient = ca.vertcat(smooth, ca.gradient(smooth, C.x))
    where = C.rows if C.rows.numel() else None
    if interval_bounds.is_continuous(gradient, C.x, *C.bounding_box):
        found = extremum.largest_eigenvalue(-H, C.x, *C.bounding_box, where=where, bound_to=0.0, quick=True)
        if found.bound <= 0:
            return HypothesisPart(HOLDS, "bounds of the eigenvalues of the Hessian", {EIGENVALUE_BOUND_KEY: abs(found.bound)}, {})
    split = find_ridges(smooth, C.x)
    if split is not None and _is_convex_in_directions(split, C.x, C.bounding_box, quick=True):
        how = "bounds of the Hessian in the directions that the operations act on"
        return HypothesisPart(HOLDS, how, {EIGENVALUE_BOUND_KEY: 0.0}, {})
    found = extremum.largest_eigenvalue(-H, C.x, *box, where=where, bound_to=0.0, quick=quick)
    value = {} if found.at is None else {MIN_EIGENVALUE_KEY: -found.value}
    down = find_negative_curvature(gradient, H, C, found.at)
    if down:
        return HypothesisPart(VIOLATED, "the Hessian has a negative eigenvalue", value, down)
    proved = found.bound <= 0 and interval_bounds.is_continuous(gradient, C.x, *box)
    if proved or (split is not None and _is_convex_in_directions(split, C.x, box, quick=quick)):
        return HypothesisPart(
            HOLDS,
            "bounds of the eigenvalues of the Hessian",
            {EIGENVALUE_BOUND_KEY: abs(found.bound) if proved else 0.0},
            {},
            True,
        )
    broken = _find_convexity_violation(smooth, C, box)
    if broken is not None:
        return broken
    how = f"no negative eigenvalue of the Hessian at {found.count} points of the box"
    return HypothesisPart(SAMPLED, how, value or {MIN_EIGENVALUE_KEY: np.nan}, {} if found.at is None else {"x": found.at})


def _is_convex_in_directions(split: Ridges, x: ca.SX, box: tuple[np.ndarray, np.ndarray], *, quick: bool) -> bool:
    """Whether the function of the directions is convex on the box that they range over."""
    if not split.s.numel() or split.s.numel() > MAX_DIRECTIONS:
        return not split.s.numel()
    ends = split.box(*box)
    if not interval_bounds.is_continuous(ca.vertcat(split.h, ca.gradient(split.h, split.s)), split.s, *ends):
        return False
    H = ca.densify(ca.hessian(split.h, split.s)[0])
    return bool(extremum.largest_eigenvalue(-H, split.s, *ends, bound_to=0.0, quick=quick).bound <= 0)


def find_negative_curvature(gradient: ca.SX, H: ca.SX, C: ConvexSet, at: np.ndarray | None) -> dict[str, np.ndarray]:
    """A point and a vector v with v'Hv < 0 there, rounding included; empty where there is none.

    H is the Jacobian of ``gradient``, or its symmetric part. Where the gradient jumps, at a kink, a point beside it is taken, if
    there is one in C around which it does not.
    """
    if at is None:
        return {}
    unit = (1 + np.abs(at)) * np.cos(1 + np.arange(len(at)))  # a direction along no axis
    for place, near in [
        (at, WITNESS_DISTANCES[-1]),
        *((at + sign * near * unit, near) for near in WITNESS_DISTANCES for sign in (1, -1)),
    ]:
        room = near / 8 * (1 + np.abs(place))
        if (C.values(place[None]) >= 0).all() and interval_bounds.is_continuous(gradient, C.x, place - room, place + room):
            found = _negative_curvature_at_point(H, C.x, place)
            if found:
                return found
    return _negative_curvature_at_point(H, C.x, at)


def _negative_curvature_at_point(H: ca.SX, x: ca.SX, at: np.ndarray) -> dict[str, np.ndarray]:
    values = np.array(ca.Function("H", [x], [H])(at))
    if not np.isfinite(values).all():
        return {}
    v = np.linalg.eigh((values + values.T) / 2)[1][:, 0]
    _, high = interval_bounds.enclose(ca.DM(v).T @ H @ ca.DM(v), x, at, at)
    return {"x": np.asarray(at), "vector": v} if float(np.max(high)) < 0 else {}


def _check_whole_potential(g: ca.SX, C: ConvexSet, box: tuple[np.ndarray, np.ndarray]) -> HypothesisPart:
    """A potential whose smooth part is not convex by itself: terms with kinks may make up for that, so all of it is looked at."""
    points = extremum.samples(*box, 512)
    points = points[(C.values(points) >= 0).all(axis=1)]
    H = ca.densify(ca.hessian(g, C.x)[0])
    seen = np.inf
    if len(points):
        values = np.array(ca.Function("H", [C.x], [H])(points.T)).reshape(C.n, -1, C.n).transpose(1, 0, 2)
        kept = np.isfinite(values).all(axis=(1, 2))
        points, least = points[kept], np.linalg.eigvalsh(values[kept])[:, 0]
        seen = float(least.min(initial=np.inf))
        down = find_negative_curvature(ca.gradient(g, C.x), H, C, points[int(np.argmin(least))]) if len(points) else {}
        if down:
            return HypothesisPart(VIOLATED, "the Hessian has a negative eigenvalue", {MIN_EIGENVALUE_KEY: seen}, down)
    broken = _find_convexity_violation(g, C, box)
    if broken is not None:
        return broken
    how = f"its terms with kinks are convex, the rest is not; together no violation was seen at {len(points)} points of the box"
    return HypothesisPart(SAMPLED, how, {MIN_EIGENVALUE_KEY: seen if np.isfinite(seen) else np.nan}, {})


def _find_convexity_violation(g: ca.SX, C: ConvexSet, box: tuple[np.ndarray, np.ndarray]) -> HypothesisPart | None:
    """Two points of C where g in the middle is larger than the mean, beyond rounding: kinks that bend downwards."""
    points = extremum.samples(*box, 1024)
    points = points[(C.values(points) >= 0).all(axis=1)]
    half = len(points) // 2
    a, b = points[:half], points[half : 2 * half]
    f = ca.Function("g", [C.x], [g])
    left, right, middle = (np.array(f(part.T)).ravel() for part in (a, b, (a + b) / 2))
    excess = middle - (left + right) / 2
    excess = np.where(np.isfinite(excess), excess - 1e-9 * (1 + np.abs(left) + np.abs(right)), -np.inf)
    if not half or excess.max() <= 0:
        return None
    k = int(np.argmax(excess))
    how = "two points in whose middle the potential is larger than the mean of both"
    return HypothesisPart(VIOLATED, how, {"excess at the middle": float(excess[k])}, {"x": a[k], "y": b[k]})
