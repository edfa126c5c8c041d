"""A friction law theta(s), s >= 0: is it convex, C1 and nondecreasing, and what is theta'(0)."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import casadi as ca
import numpy as np

from nsmodel.classes.oscillator.model import Friction
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED
from nsmodel.proof import exact, extremum, interval, one_variable, polynomial_signs
from nsmodel.proof.convex import convexity, joints, piecewise
from nsmodel.proof.convex.duality import additive_terms
from nsmodel.proof.convex.pieces import Stretch, Terms, split
from nsmodel.proof.jumps import find_jump, jumps_in
from nsmodel.proof.verdict import Part

ZERO, INFINITY = np.zeros(1), np.full(1, np.inf)
SLOPE, CURVATURE, LEAST_CURVATURE = "min theta'", "min theta''", "theta'' is at least"
FEW = 100  # A sample of fewer points says nothing.
TINY = 1e-300
SPEEDS = np.concatenate([[0.0], np.logspace(-6, 3, 400)])
ROUNDING = Fraction(1, 2**46)  # 64 eps


def law(element: Friction, s: ca.SX) -> ca.SX:
    """Theta on [0, inf), with fabs, fmax and the like replaced where their case is settled there."""
    return convexity.simplified(element.theta, s, ZERO, INFINITY, f"friction '{element.name}' theta")


def slope_at_zero(element: Friction, s: ca.SX) -> tuple[float, float]:
    """Rigorous bounds of theta'(0), the derivative from the right; infinite ones where it is not proved to exist."""
    theta = law(element, s)
    pieces = piecewise.pieces(theta, s)
    if pieces is not None:
        number = pieces[0].c[1] if len(pieces[0].c) > 1 else Fraction(0)
        return exact.down(number), exact.up(number)
    terms = additive_terms(theta)
    found = split(terms, s)
    return _start(terms, s, found[0]) if found is not None else _by_intervals(theta, s)


def _start(terms: Terms, s: ca.SX, piece: Stretch) -> tuple[float, float]:
    """The slope at 0 of a sum whose cases are settled near 0."""
    low = high = Fraction(0)
    for (factor, term), cases in zip(terms, piece.cases, strict=True):
        found = one_variable.slope_at_start(term, s, Fraction(0), cases) or _by_intervals(term, s)
        if not np.isfinite(found).all():
            return -np.inf, np.inf
        ends = sorted(factor * Fraction(end) for end in found)
        low, high = low + ends[0], high + ends[1]
    return exact.down(low), exact.up(high)


def _by_intervals(theta: ca.SX, s: ca.SX) -> tuple[float, float]:
    first = ca.gradient(theta, s)
    if not interval.is_continuous(ca.vertcat(theta, first), s, ZERO, np.full(1, 1e-6)):
        return -np.inf, np.inf
    number = joints.exact_value(first, s, Fraction(0))
    if number is not None:
        return exact.down(number), exact.up(number)
    low, high = interval.enclose(first, s, ZERO, ZERO)
    return float(np.min(low)), float(np.max(high))


def is_law(element: Friction, s: ca.SX, *, quick: bool) -> Part:
    """Decide whether theta is convex, C1 and nondecreasing, for every s >= 0."""
    theta = law(element, s)
    pieces = piecewise.pieces(theta, s)
    if pieces is not None:
        return _piecewise(pieces)
    terms = additive_terms(theta)
    found = split(terms, s)
    undefined = _undefined(theta, s)
    if undefined is not None:
        return undefined
    jumps = [] if found is None else [joints.jump(terms, s, *both) for both in pairwise(found)]
    for piece, jump in zip(found[1:] if found is not None else [], jumps, strict=True):
        broken = None if jump is None else _broken(jump, piece)
        if broken is not None:
            return broken
    first = ca.gradient(theta, s)
    smooth = all(jump is not None and jump.value == jump.slope == (0, 0) for jump in jumps)
    smooth = smooth and found is not None and all(_is_smooth(terms, s, piece) for piece in found)
    begin = _start(terms, s, found[0]) if found is not None else _by_intervals(theta, s)
    by = _convex(theta, terms, s, found) if smooth and found is not None else None
    if by is not None and begin[0] >= 0 and _begins(theta, s):
        return Part(HOLDS, f"for every s >= 0, by {by[0]}", {SLOPE: begin[0]} | by[1], {})  # theta' grows from there
    return _searched(theta, first, s, smooth, by is not None, quick=quick)


def _searched(theta: ca.SX, first: ca.SX, s: ca.SX, smooth: bool, convex: bool, *, quick: bool) -> Part:
    """What is not proved: look for a speed at which theta' or theta'' is negative, rounding included."""
    worst: dict[str, extremum.Supremum] = {}
    for name, derivative in ((SLOPE, first), (CURVATURE, ca.gradient(first, s))):
        worst[name] = extremum.supremum(-derivative, s, ZERO, INFINITY, points=SPEEDS[:, None], bound_to=0.0, quick=quick)
    values = {name: -seen.value for name, seen in worst.items() if np.isfinite(seen.value)}
    for name, derivative in ((SLOPE, first), (CURVATURE, ca.gradient(first, s))):
        at = worst[name].at
        if at is not None and float(np.max(interval.enclose(derivative, s, at, at)[1])) < 0:
            what = "theta decreases" if name == SLOPE else "theta is not convex"
            return Part(VIOLATED, what, values, {"s": at[0], name.removeprefix("min "): -worst[name].value})
    jump = find_jump(theta, s, ZERO, SPEEDS[-1:], lambda points: points[:, 0] >= 0) if jumps_in(theta, s) else None
    if jump is not None:
        place = float(jump.at[0])
        return Part(VIOLATED, f"theta jumps at s = {place:.6g}", {"jump": jump.size}, {"s": place})
    missing = "C1" if not smooth else "convex" if not convex else "nondecreasing"
    count = max(seen.count for seen in worst.values())
    if count < FEW:
        return Part(UNKNOWN, f"not proved {missing}, and theta has derivatives at {count} points only", values, {})
    at = max(worst.values(), key=lambda seen: seen.value).at
    where = float(at[0]) if at is not None else 0.0
    return Part(SAMPLED, f"no violation at {count} points s >= 0; not proved {missing}", values, {"s": where})


# -- convexity ---------------------------------------------------------------------------------------------------------


def _convex(theta: ca.SX, terms: Terms, s: ca.SX, pieces: list[Stretch]) -> tuple[str, dict[str, float]] | None:
    """How theta, C1, is proved convex, and a bound of theta'' where there is one."""
    (shape,) = convexity.shapes(theta, s, ZERO, INFINITY)
    if shape.convex:
        return "the rules of convex functions", {}
    if all(_convex_on(terms, s, piece) for piece in pieces):
        return "the sign of theta'' (exactly, and in balls between the roots of its derivatives)", {}
    if len(pieces) == 1:
        curve = extremum.supremum(-ca.hessian(theta, s)[0], s, ZERO, INFINITY, points=SPEEDS[:, None], bound_to=0.0)
        if curve.bound <= 0:
            return "bounds of theta''", {LEAST_CURVATURE: -curve.bound}
    return None


def _convex_on(terms: Terms, s: ca.SX, piece: Stretch) -> bool:
    """Whether the sum is convex on a piece: terms that are quotients of sums together, the others by bounds."""
    low, high = piece.spread
    known, rest = _parted(terms, s, piece)
    less = Fraction(0)
    for factor, term in rest:
        sign = 1 if factor > 0 else -1
        (shape,) = convexity.shapes(sign * term, s, *piece.outer)
        if shape.convex:
            continue
        bound = extremum.supremum(-sign * ca.hessian(term, s)[0], s, *piece.outer, quick=True).bound
        if not np.isfinite(bound):
            return False
        less += abs(factor) * Fraction(bound)
    found = one_variable.second_signs([terms[i] for i in known], s, low, high, [piece.cases[i] for i in known], less)
    return found is not None and min(found.signs) >= 0


def _parted(terms: Terms, s: ca.SX, piece: Stretch) -> tuple[list[int], list[tuple[Fraction, ca.SX]]]:
    """Which terms have second derivatives that are quotients of sums on a piece, and the others."""
    known = [i for i, (_, term) in enumerate(terms) if one_variable.is_smooth(term, s, *piece.spread, piece.cases[i])]
    return known, [term for i, term in enumerate(terms) if i not in known]


# -- C1 ----------------------------------------------------------------------------------------------------------------


def _is_smooth(terms: Terms, s: ca.SX, piece: Stretch) -> bool:
    """Whether theta' is proved continuous within a piece."""
    _, rest = _parted(terms, s, piece)
    return all(interval.is_continuous(ca.vertcat(term, ca.gradient(term, s)), s, *piece.outer) for _, term in rest)


def _begins(theta: ca.SX, s: ca.SX) -> bool:
    """Whether theta is continuous at 0 from the right: a convex function with a finite slope there is then C1."""
    return interval.is_continuous(theta, s, ZERO, np.full(1, 1e-6))


def _undefined(theta: ca.SX, s: ca.SX) -> Part | None:
    """A place where theta is undefined, or where its slope is infinite at 0."""
    f = ca.Function("theta", [s], [theta, ca.gradient(theta, s)])
    values, slopes = (np.array(part).ravel() for part in f(SPEEDS[None, :]))
    undefined = np.flatnonzero(np.isnan(values))
    if undefined.size:
        at = {"s": float(SPEEDS[undefined[0]])}
        return Part(VIOLATED, "theta is not defined for every s >= 0", at, at)
    if np.isinf(values[0]) or np.isinf(slopes[0]):
        how = "theta or its slope is infinite at s = 0: it is not C1 on [0, inf)"
        return Part(VIOLATED, how, {"theta'(0)": slopes[0]}, {"s": 0.0})
    start = abs(float(f(TINY)[0]) - values[0])
    if start > 1e-7 * (1 + abs(values[0])):
        return Part(VIOLATED, "theta jumps at s = 0", {"jump": start}, {"s": 0.0})
    return None


def _broken(jump: joints.JointJump, piece: Stretch) -> Part | None:
    """A jump of theta or of its slope at the beginning of a piece, clear of rounding."""
    place = float(sum(piece.low) / 2)
    for what, (low, high), before in (("jumps", jump.value, None), ("has a kink", jump.slope, jump.before)):
        size = max(abs(low), abs(high)) + (0.0 if before is None else max(map(abs, before)))
        if low > float(ROUNDING) * size or high < -float(ROUNDING) * size:
            how = f"theta {what} at s = {place:.6g}: it is not C1"
            if before is None:
                return Part(VIOLATED, how, {"jump": (low + high) / 2}, {"s": place})
            slope = (before[0] + before[1]) / 2
            return Part(VIOLATED, how, {"slope before": slope, "slope after": slope + (low + high) / 2}, {"s": place})
    return None


# -- piecewise polynomials ----------------------------------------------------------------------------------------------


def _piecewise(pieces: list[piecewise.PolynomialPiece]) -> Part:
    """Decide a piecewise polynomial: signs of the derivatives on each piece, values and slopes at the joints."""
    for left, right in pairwise(pieces):
        place = right.low
        for what, p, q in (
            ("jumps", left.c, right.c),
            ("has a kink", polynomial_signs.derivative(left.c), polynomial_signs.derivative(right.c)),
        ):
            before, after = polynomial_signs.at(p, place), polynomial_signs.at(q, place)
            if before != after:
                value = {"before": float(before), "after": float(after)}
                size = sum(polynomial_signs.at([abs(number) for number in part], place) for part in (p, q))
                if abs(after - before) <= ROUNDING * size:
                    return Part(SAMPLED, f"theta {what} at s = {float(place):.6g} by rounding only", value, {"s": float(place)})
                how = f"theta {what} at s = {float(place):.6g}: it is not C1"
                return Part(VIOLATED, how, value, {"s": float(place)})
    values = {SLOPE: np.inf, CURVATURE: np.inf}
    broken: list[Part] = []
    for piece in pieces:
        first, second = _derivatives(piece)
        for name, p, what in ((SLOPE, first, "theta decreases"), (CURVATURE, second, "theta is not convex")):
            values[name] = min(values[name], polynomial_signs.lower_bound(p, piece.low, piece.high))
            point = polynomial_signs.negative_point(p, piece.low, piece.high)
            if point is not None:
                order, start = name.removeprefix("min "), _from(p, piece.low, point)
                how = f"{what}: {order} < 0 from s = {start:.6g} on (decided exactly)"
                broken.append(
                    Part(VIOLATED, how, values, {"s": float(point), order: float(polynomial_signs.at(p, point)), "from": start})
                )
    if broken:
        raised = [(_raised(p), piece) for piece in pieces for p in _derivatives(piece)]
        if all(polynomial_signs.negative_point(p, piece.low, piece.high) is None for p, piece in raised):
            return broken[0]._replace(verdict=SAMPLED, how="convex and nondecreasing up to rounding of the coefficients only")
        return broken[0]
    kind = "a polynomial" if len(pieces) == 1 else f"a polynomial on each of {len(pieces)} pieces, C1 at their joints"
    return Part(HOLDS, f"for every s >= 0: theta is {kind}; the signs of its derivatives are decided exactly", values, {})


def _derivatives(piece: piecewise.PolynomialPiece) -> tuple[list[Fraction], list[Fraction]]:
    first = polynomial_signs.derivative(piece.c)
    return first, polynomial_signs.derivative(first)


def _raised(p: list[Fraction]) -> list[Fraction]:
    """The largest values for s >= 0 that coefficients off by rounding give."""
    return [number + ROUNDING * abs(number) for number in p]


def _from(p: list[Fraction], low: Fraction, point: Fraction) -> float:
    """Where p, negative at a point, becomes negative."""
    roots = np.roots([float(number) for number in reversed(p)]) if len(p) > 1 else np.zeros(0)
    real = [float(root.real) for root in roots if abs(root.imag) <= 1e-9 * (1 + abs(root))]
    return max([root for root in real if float(low) < root <= float(point)], default=float(low))
