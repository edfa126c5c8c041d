"""A friction law theta(s), s >= 0: is it convex, C1 and nondecreasing, and what is theta'(0)."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED
from nsmodel.models.friction_oscillator.model import Friction
from nsmodel.proof import exact, extremum, interval_bounds, polynomial, univariate
from nsmodel.proof.convex import piecewise, rules
from nsmodel.proof.convex.piecewise import CaseInterval, WeightedTerms, split_by_cases
from nsmodel.proof.expression_graph import additive_terms
from nsmodel.proof.jumps import find_jump, jump_nodes
from nsmodel.proof.verdict import HypothesisPart

ZERO_SPEED, INFINITE_SPEED = np.zeros(1), np.full(1, np.inf)  # Ends of the speeds, as boxes.
MIN_SLOPE, MIN_CURVATURE, MIN_CURVATURE_BOUND = "min theta'", "min theta''", "theta'' is at least"
MIN_SPEED_SAMPLES = 100  # A sample of fewer points, where theta has derivatives, says nothing.
# A speed at which a theta that is continuous at 0 has the value of there: near the least double, and its powers are 0.
SPEED_NEAR_ZERO = 1e-300
SAMPLE_SPEEDS = np.concatenate([[0.0], np.logspace(-6, 3, 400)])  # Where theta is looked at, in its own unit.
LAW_ROUNDING = Fraction(1, 2**46)  # 64 eps, relative: a jump of theta or of its slope below this is rounding.


def simplified_law(element: Friction, s: ca.SX) -> ca.SX:
    """Theta on [0, inf), with fabs, fmax and the like replaced where their case is settled there."""
    return rules.resolve_kinks(element.theta, s, ZERO_SPEED, INFINITE_SPEED, f"friction '{element.name}' theta")


def slope_at_zero_bounds(element: Friction, s: ca.SX) -> tuple[float, float]:
    """Rigorous bounds of theta'(0), the derivative from the right; infinite ones where it is not proved to exist."""
    theta = simplified_law(element, s)
    pieces = piecewise.polynomial_pieces(theta, s)
    if pieces is not None:
        number = pieces[0].c[1] if len(pieces[0].c) > 1 else Fraction(0)
        return exact.round_down(number), exact.round_up(number)
    terms = additive_terms(theta)
    found = split_by_cases(terms, s)
    return _slope_from_terms(terms, s, found[0]) if found is not None else _slope_by_intervals(theta, s)


def _slope_from_terms(terms: WeightedTerms, s: ca.SX, piece: CaseInterval) -> tuple[float, float]:
    """The slope at 0 of a sum whose cases are settled near 0."""
    low = high = Fraction(0)
    for (factor, term), cases in zip(terms, piece.cases, strict=True):
        found = univariate.right_derivative_bounds(term, s, Fraction(0), cases) or _slope_by_intervals(term, s)
        if not np.isfinite(found).all():
            return -np.inf, np.inf
        ends = sorted(factor * Fraction(end) for end in found)
        low, high = low + ends[0], high + ends[1]
    return exact.round_down(low), exact.round_up(high)


def _slope_by_intervals(theta: ca.SX, s: ca.SX) -> tuple[float, float]:
    first = ca.gradient(theta, s)
    if not interval_bounds.is_continuous(ca.vertcat(theta, first), s, ZERO_SPEED, np.full(1, 1e-6)):
        return -np.inf, np.inf
    number = piecewise.exact_value(first, s, Fraction(0))
    if number is not None:
        return exact.round_down(number), exact.round_up(number)
    low, high = interval_bounds.enclose(first, s, ZERO_SPEED, ZERO_SPEED)
    return float(np.min(low)), float(np.max(high))


def check_friction_law(element: Friction, s: ca.SX, *, quick: bool) -> HypothesisPart:
    """Decide whether theta is convex, C1 and nondecreasing, for every s >= 0."""
    theta = simplified_law(element, s)
    pieces = piecewise.polynomial_pieces(theta, s)
    if pieces is not None:
        return _check_piecewise(pieces)
    terms = additive_terms(theta)
    found = split_by_cases(terms, s)
    undefined = _undefined_part(theta, s)
    if undefined is not None:
        return undefined
    jumps = [] if found is None else [piecewise.joint_jump(terms, s, *both) for both in pairwise(found)]
    for piece, jump in zip(found[1:] if found is not None else [], jumps, strict=True):
        broken = None if jump is None else _joint_violation(jump, piece)
        if broken is not None:
            return broken
    first = ca.gradient(theta, s)
    smooth = all(jump is not None and jump.value == jump.slope == (0, 0) for jump in jumps)
    smooth = smooth and found is not None and all(_is_slope_continuous(terms, s, piece) for piece in found)
    begin = _slope_from_terms(terms, s, found[0]) if found is not None else _slope_by_intervals(theta, s)
    by = _prove_convex(theta, terms, s, found) if smooth and found is not None else None
    if by is not None and begin[0] >= 0 and _is_continuous_at_zero(theta, s):
        return HypothesisPart(
            HOLDS, f"for every s >= 0, by {by[0]}", {MIN_SLOPE: begin[0]} | by[1], {}
        )  # theta' grows from there
    return _search_violation(theta, first, s, smooth, by is not None, quick=quick)


def _search_violation(theta: ca.SX, first: ca.SX, s: ca.SX, smooth: bool, convex: bool, *, quick: bool) -> HypothesisPart:
    """What is not proved: look for a speed at which theta' or theta'' is negative, rounding included."""
    worst: dict[str, extremum.Supremum] = {}
    for name, derivative in ((MIN_SLOPE, first), (MIN_CURVATURE, ca.gradient(first, s))):
        worst[name] = extremum.supremum(
            -derivative, s, ZERO_SPEED, INFINITE_SPEED, points=SAMPLE_SPEEDS[:, None], bound_to=0.0, quick=quick
        )
    values = {name: -seen.value for name, seen in worst.items() if np.isfinite(seen.value)}
    for name, derivative in ((MIN_SLOPE, first), (MIN_CURVATURE, ca.gradient(first, s))):
        at = worst[name].at
        if at is not None and float(np.max(interval_bounds.enclose(derivative, s, at, at)[1])) < 0:
            what = "theta decreases" if name == MIN_SLOPE else "theta is not convex"
            return HypothesisPart(VIOLATED, what, values, {"s": at[0], name.removeprefix("min "): -worst[name].value})
    jump = find_jump(theta, s, ZERO_SPEED, SAMPLE_SPEEDS[-1:], lambda points: points[:, 0] >= 0) if jump_nodes(theta, s) else None
    if jump is not None:
        place = float(jump.at[0])
        return HypothesisPart(VIOLATED, f"theta jumps at s = {place:.6g}", {"jump": jump.size}, {"s": place})
    missing = "C1" if not smooth else "convex" if not convex else "nondecreasing"
    count = max(seen.count for seen in worst.values())
    if count < MIN_SPEED_SAMPLES:
        return HypothesisPart(UNKNOWN, f"not proved {missing}, and theta has derivatives at {count} points only", values, {})
    at = max(worst.values(), key=lambda seen: seen.value).at
    where = float(at[0]) if at is not None else 0.0
    return HypothesisPart(SAMPLED, f"no violation at {count} points s >= 0; not proved {missing}", values, {"s": where})


# -- convexity ---------------------------------------------------------------------------------------------------------


def _prove_convex(
    theta: ca.SX, terms: WeightedTerms, s: ca.SX, pieces: list[CaseInterval]
) -> tuple[str, dict[str, float]] | None:
    """How theta, C1, is proved convex, and a bound of theta'' where there is one."""
    (shape,) = rules.curvatures(theta, s, ZERO_SPEED, INFINITE_SPEED)
    if shape.convex:
        return "the rules of convex functions", {}
    if all(_is_convex_on_piece(terms, s, piece) for piece in pieces):
        return "the sign of theta'' (exactly, and in balls between the roots of its derivatives)", {}
    if len(pieces) == 1:
        curve = extremum.supremum(
            -ca.hessian(theta, s)[0], s, ZERO_SPEED, INFINITE_SPEED, points=SAMPLE_SPEEDS[:, None], bound_to=0.0
        )
        if curve.bound <= 0:
            return "bounds of theta''", {MIN_CURVATURE_BOUND: -curve.bound}
    return None


def _is_convex_on_piece(terms: WeightedTerms, s: ca.SX, piece: CaseInterval) -> bool:
    """Whether the sum is convex on a piece: terms that are quotients of sums together, the others by bounds."""
    low, high = piece.rational_ends
    known, rest = _split_smooth_terms(terms, s, piece)
    less = Fraction(0)
    for factor, term in rest:
        sign = 1 if factor > 0 else -1
        (shape,) = rules.curvatures(sign * term, s, *piece.outer)
        if shape.convex:
            continue
        bound = extremum.supremum(-sign * ca.hessian(term, s)[0], s, *piece.outer, quick=True).bound
        if not np.isfinite(bound):
            return False
        less += abs(factor) * Fraction(bound)
    found = univariate.second_derivative_signs([terms[i] for i in known], s, low, high, [piece.cases[i] for i in known], less)
    return found is not None and min(found.signs) >= 0


def _split_smooth_terms(terms: WeightedTerms, s: ca.SX, piece: CaseInterval) -> tuple[list[int], list[tuple[Fraction, ca.SX]]]:
    """Which terms have second derivatives that are quotients of sums on a piece, and the others."""
    known = [
        i for i, (_, term) in enumerate(terms) if univariate.has_two_derivatives(term, s, *piece.rational_ends, piece.cases[i])
    ]
    return known, [term for i, term in enumerate(terms) if i not in known]


# -- C1 ----------------------------------------------------------------------------------------------------------------


def _is_slope_continuous(terms: WeightedTerms, s: ca.SX, piece: CaseInterval) -> bool:
    """Whether theta' is proved continuous within a piece."""
    _, rest = _split_smooth_terms(terms, s, piece)
    return all(interval_bounds.is_continuous(ca.vertcat(term, ca.gradient(term, s)), s, *piece.outer) for _, term in rest)


def _is_continuous_at_zero(theta: ca.SX, s: ca.SX) -> bool:
    """Whether theta is continuous at 0 from the right: a convex function with a finite slope there is then C1."""
    return interval_bounds.is_continuous(theta, s, ZERO_SPEED, np.full(1, 1e-6))


def _undefined_part(theta: ca.SX, s: ca.SX) -> HypothesisPart | None:
    """A place where theta is undefined, or where its slope is infinite at 0."""
    f = ca.Function("theta", [s], [theta, ca.gradient(theta, s)])
    values, slopes = (np.array(part).ravel() for part in f(SAMPLE_SPEEDS[None, :]))
    undefined = np.flatnonzero(np.isnan(values))
    if undefined.size:
        at = {"s": float(SAMPLE_SPEEDS[undefined[0]])}
        return HypothesisPart(VIOLATED, "theta is not defined for every s >= 0", at, at)
    if np.isinf(values[0]) or np.isinf(slopes[0]):
        how = "theta or its slope is infinite at s = 0: it is not C1 on [0, inf)"
        return HypothesisPart(VIOLATED, how, {"theta'(0)": slopes[0]}, {"s": 0.0})
    start = abs(float(f(SPEED_NEAR_ZERO)[0]) - values[0])
    if start > 1e-7 * (1 + abs(values[0])):
        return HypothesisPart(VIOLATED, "theta jumps at s = 0", {"jump": start}, {"s": 0.0})
    return None


def _joint_violation(jump: piecewise.JointJump, piece: CaseInterval) -> HypothesisPart | None:
    """A jump of theta or of its slope at the beginning of a piece, clear of rounding."""
    place = float(sum(piece.low) / 2)
    for what, (low, high), before in (("jumps", jump.value, None), ("has a kink", jump.slope, jump.before)):
        size = max(abs(low), abs(high)) + (0.0 if before is None else max(map(abs, before)))
        if low > float(LAW_ROUNDING) * size or high < -float(LAW_ROUNDING) * size:
            how = f"theta {what} at s = {place:.6g}: it is not C1"
            if before is None:
                return HypothesisPart(VIOLATED, how, {"jump": (low + high) / 2}, {"s": place})
            slope = (before[0] + before[1]) / 2
            return HypothesisPart(VIOLATED, how, {"slope before": slope, "slope after": slope + (low + high) / 2}, {"s": place})
    return None


# -- piecewise polynomials ----------------------------------------------------------------------------------------------


def _check_piecewise(pieces: list[piecewise.PolynomialPiece]) -> HypothesisPart:
    """Decide a piecewise polynomial: signs of the derivatives on each piece, values and slopes at the joints."""
    for left, right in pairwise(pieces):
        place = right.low
        for what, p, q in (
            ("jumps", left.c, right.c),
            ("has a kink", polynomial.derivative_coefficients(left.c), polynomial.derivative_coefficients(right.c)),
        ):
            before, after = polynomial.evaluate_at(p, place), polynomial.evaluate_at(q, place)
            if before != after:
                value = {"before": float(before), "after": float(after)}
                size = sum(polynomial.evaluate_at([abs(number) for number in part], place) for part in (p, q))
                if abs(after - before) <= LAW_ROUNDING * size:
                    return HypothesisPart(
                        SAMPLED, f"theta {what} at s = {float(place):.6g} by rounding only", value, {"s": float(place)}
                    )
                how = f"theta {what} at s = {float(place):.6g}: it is not C1"
                return HypothesisPart(VIOLATED, how, value, {"s": float(place)})
    values = {MIN_SLOPE: np.inf, MIN_CURVATURE: np.inf}
    broken: list[HypothesisPart] = []
    for piece in pieces:
        first, second = _piece_derivatives(piece)
        for name, p, what in ((MIN_SLOPE, first, "theta decreases"), (MIN_CURVATURE, second, "theta is not convex")):
            values[name] = min(values[name], polynomial.polynomial_lower_bound(p, piece.low, piece.high))
            point = polynomial.negative_point(p, piece.low, piece.high)
            if point is not None:
                order, start = name.removeprefix("min "), _sign_change(p, piece.low, point)
                how = f"{what}: {order} < 0 from s = {start:.6g} on (decided exactly)"
                broken.append(
                    HypothesisPart(
                        VIOLATED,
                        how,
                        values,
                        {"s": float(point), order: float(polynomial.evaluate_at(p, point)), "from": start},
                    )
                )
    if broken:
        raised = [(_rounded_up_coefficients(p), piece) for piece in pieces for p in _piece_derivatives(piece)]
        if all(polynomial.negative_point(p, piece.low, piece.high) is None for p, piece in raised):
            return broken[0]._replace(verdict=SAMPLED, how="convex and nondecreasing up to rounding of the coefficients only")
        return broken[0]
    kind = "a polynomial" if len(pieces) == 1 else f"a polynomial on each of {len(pieces)} pieces, C1 at their joints"
    return HypothesisPart(
        HOLDS, f"for every s >= 0: theta is {kind}; the signs of its derivatives are decided exactly", values, {}
    )


def _piece_derivatives(piece: piecewise.PolynomialPiece) -> tuple[list[Fraction], list[Fraction]]:
    first = polynomial.derivative_coefficients(piece.c)
    return first, polynomial.derivative_coefficients(first)


def _rounded_up_coefficients(p: list[Fraction]) -> list[Fraction]:
    """The largest values for s >= 0 that coefficients off by rounding give."""
    return [number + LAW_ROUNDING * abs(number) for number in p]


def _sign_change(p: list[Fraction], low: Fraction, point: Fraction) -> float:
    """Where p, negative at a point, becomes negative."""
    roots = np.roots([float(number) for number in reversed(p)]) if len(p) > 1 else np.zeros(0)
    real = [float(root.real) for root in roots if abs(root.imag) <= 1e-9 * (1 + abs(root))]
    return max([root for root in real if float(low) < root <= float(point)], default=float(low))
