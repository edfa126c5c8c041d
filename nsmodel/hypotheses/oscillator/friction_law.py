"""A friction law theta(s), s >= 0: is it convex, C1 and nondecreasing, and what is theta'(0)."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from itertools import pairwise

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, SAMPLED, VIOLATED
from nsmodel.model.oscillator import Friction
from nsmodel.proof import extremum, interval, polynomial, polynomial_signs
from nsmodel.proof.convex import convexity, piecewise
from nsmodel.proof.graph import column, replay
from nsmodel.proof.jumps import find_jump, jumps_in
from nsmodel.proof.verdict import Part

ZERO, INFINITY = np.zeros(1), np.full(1, np.inf)
SLOPE, CURVATURE = "min theta'", "min theta''"
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
        near = float(number)
        return (
            (near, near) if Fraction(near) == number else (float(np.nextafter(near, -np.inf)), float(np.nextafter(near, np.inf)))
        )
    first = ca.gradient(theta, s)
    if not interval.is_continuous(ca.vertcat(theta, first), s, ZERO, np.full(1, 1e-6)):
        return -np.inf, np.inf
    low, high = interval.enclose(first, s, ZERO, ZERO)
    return float(np.min(low)), float(np.max(high))


def is_law(element: Friction, s: ca.SX, *, quick: bool) -> Part:
    """Decide whether theta is convex, C1 and nondecreasing, for every s >= 0."""
    theta = law(element, s)
    pieces = piecewise.pieces(theta, s)
    if pieces is not None:
        return _piecewise(pieces)
    first = ca.gradient(theta, s)
    second = ca.gradient(first, s)
    broken = _not_smooth(theta, first, s)
    if broken is not None:
        return broken
    smooth = _is_smooth(theta, first, s)
    slope = extremum.supremum(-first, s, ZERO, INFINITY, points=SPEEDS[:, None], bound_to=0.0, quick=quick)
    curve = extremum.supremum(-second, s, ZERO, INFINITY, points=SPEEDS[:, None], bound_to=0.0, quick=quick)
    values = {SLOPE: -slope.value, CURVATURE: -curve.value}
    for name, derivative, found in ((SLOPE, first, slope), (CURVATURE, second, curve)):
        if found.at is not None and float(np.max(interval.enclose(derivative, s, found.at, found.at)[1])) < 0:
            what = "theta decreases" if name == SLOPE else "theta is not convex"
            return Part(VIOLATED, what, values, {"s": found.at[0], name.removeprefix("min "): -found.value})
    (shape,) = convexity.shapes(theta, s, ZERO, INFINITY)
    quotient = _nonnegative_quotient(second, s)
    convex = smooth and (shape.convex or quotient or curve.bound <= 0)
    nondecreasing = slope.bound <= 0 or (convex and slope_at_zero(element, s)[0] >= 0)
    if convex and nondecreasing:
        by = "the rules of convex functions" if shape.convex else "the exact sign of theta''" if quotient else "bounds of theta''"
        values[SLOPE] = float(np.mean(slope_at_zero(element, s)))  # theta' grows from there
        return Part(HOLDS, f"for every s >= 0, by {by}", values, {})
    missing = "C1" if not smooth else "convex" if not convex else "nondecreasing"
    return Part(
        SAMPLED, f"no violation at {slope.count} points s >= 0; not proved {missing}", values, {"s": _where(slope, curve)}
    )


def _nonnegative_quotient(expr: ca.SX, s: ca.SX) -> bool:
    """Whether an expression is a quotient of polynomials, >= 0 and without a pole for s >= 0."""
    found = polynomial.ratio(expr, s)
    if found is None:
        return False
    product = polynomial.multiply(*found)
    if product is None or polynomial_signs.has_root(polynomial.coefficients(found[1])):
        return False
    return polynomial_signs.negative_point(polynomial.coefficients(product)) is None


def _where(*found: extremum.Supremum) -> float:
    worst = max(found, key=lambda one: one.value)
    return float(worst.at[0]) if worst.at is not None else 0.0


# -- piecewise polynomials ----------------------------------------------------------------------------------------------


def _piecewise(pieces: list[piecewise.Piece]) -> Part:
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
                if abs(after - before) <= ROUNDING * (abs(before) + abs(after)):
                    return Part(SAMPLED, f"theta {what} at s = {float(place):.6g} by rounding only", value, {"s": float(place)})
                how = f"theta {what} at s = {float(place):.6g}: it is not C1"
                return Part(VIOLATED, how, value, {"s": float(place)})
    values = {SLOPE: np.inf, CURVATURE: np.inf}
    broken: list[Part] = []
    for piece in pieces:
        first, second = _derivatives(piece)
        for name, p, what in ((SLOPE, first, "theta decreases"), (CURVATURE, second, "theta is not convex")):
            values[name] = min(values[name], polynomial_signs.minimum(p, piece.low, piece.high)[0])
            point = polynomial_signs.negative_point(p, piece.low, piece.high)
            if point is not None:
                order, start = name.removeprefix("min "), _start(p, piece.low, point)
                how = f"{what}: {order} < 0 from s = {start:.6g} on (decided exactly)"
                broken.append(
                    Part(VIOLATED, how, values, {"s": float(point), order: float(polynomial_signs.at(p, point)), "from": start})
                )
    if broken:
        rounded = [piece._replace(c=_rounded(piece.c)) for piece in pieces]
        if all(
            polynomial_signs.negative_point(p, piece.low, piece.high) is None for piece in rounded for p in _derivatives(piece)
        ):
            return broken[0]._replace(verdict=SAMPLED, how="convex and nondecreasing up to rounding of the coefficients only")
        return broken[0]
    kind = "a polynomial" if len(pieces) == 1 else f"a polynomial on each of {len(pieces)} pieces, C1 at their joints"
    return Part(HOLDS, f"for every s >= 0: theta is {kind}; the signs of its derivatives are decided exactly", values, {})


def _derivatives(piece: piecewise.Piece) -> tuple[list[Fraction], list[Fraction]]:
    first = polynomial_signs.derivative(piece.c)
    return first, polynomial_signs.derivative(first)


def _rounded(p: list[Fraction]) -> list[Fraction]:
    """Without coefficients that are rounding beside the largest one."""
    largest = max(map(abs, p), default=Fraction(0))
    return [number if abs(number) > ROUNDING * largest else Fraction(0) for number in p]


def _start(p: list[Fraction], low: Fraction, point: Fraction) -> float:
    """Where p, negative at a point, becomes negative."""
    roots = np.roots([float(number) for number in reversed(p)]) if len(p) > 1 else np.zeros(0)
    real = [float(root.real) for root in roots if abs(root.imag) <= 1e-9 * (1 + abs(root))]
    return max([root for root in real if float(low) < root <= float(point)], default=float(low))


# -- C1 ----------------------------------------------------------------------------------------------------------------


def _not_smooth(theta: ca.SX, first: ca.SX, s: ca.SX) -> Part | None:
    """A place where theta is undefined, or where its slope is infinite or jumps."""
    f = ca.Function("theta", [s], [theta, first])
    values, slopes = (np.array(part).ravel() for part in f(SPEEDS[None, :]))
    undefined = np.flatnonzero(np.isnan(values))
    if undefined.size:
        return Part(VIOLATED, "theta is not defined for every s >= 0", {"s": SPEEDS[undefined[0]]}, {"s": SPEEDS[undefined[0]]})
    if np.isinf(values[0]) or np.isinf(slopes[0]):
        how = "theta or its slope is infinite at s = 0: it is not C1 on [0, inf)"
        return Part(VIOLATED, how, {"theta'(0)": slopes[0]}, {"s": 0.0})
    if jumps_in(theta, s):
        jump = find_jump(theta, s, ZERO, SPEEDS[-1:], lambda points: points[:, 0] >= 0)
        start = abs(float(f(TINY)[0]) - values[0])
        if jump is not None or start > 1e-7 * (1 + abs(values[0])):
            place, size = (float(jump.at[0]), jump.size) if jump is not None else (0.0, start)
            return Part(VIOLATED, f"theta jumps at s = {place:.6g}", {"jump": size}, {"s": place})
    for place in _switches(theta, s):
        step = 1e-7 * max(place, 1e-3)
        around = place + step * np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
        value, slope = (np.array(part).ravel() for part in f(around[None, :]))
        size = 1 + np.abs(slope[[1, 3]]).max()
        if abs(value[3] - value[1]) > 1e-3 * size and abs(value[3] - value[1]) > 100 * step * size:
            return Part(VIOLATED, f"theta jumps at s = {place:.6g}", {"jump": value[3] - value[1]}, {"s": place})
        if abs(slope[3] - slope[1]) > 1e-4 * size:
            how = f"theta has a kink at s = {place:.6g}: it is not C1"
            return Part(VIOLATED, how, {"slope before": slope[1], "slope after": slope[3]}, {"s": place})
    return None


def _switches(theta: ca.SX, s: ca.SX) -> list[float]:
    """Places s > 0 where an fabs, fmax, fmin, sign or condition in theta changes its case."""
    arguments: list[ca.SX] = []

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> None:
        arguments.append(args[0] if len(args) == 1 else args[0] - args[1])

    replay(
        theta, rule, (ca.OP_FABS, ca.OP_FMAX, ca.OP_FMIN, ca.OP_SIGN, ca.OP_FLOOR, ca.OP_CEIL, *piecewise.CONDITIONS), s, "theta"
    )
    return sorted(place for u in arguments for place in _zeros(u, s))


def _zeros(u: ca.SX, s: ca.SX) -> Iterator[float]:
    f = ca.Function("u", [s], [u])
    values = np.array(f(SPEEDS[None, :])).ravel()
    for k in np.flatnonzero(np.sign(values[1:]) != np.sign(values[:-1])):
        low, high = SPEEDS[k], SPEEDS[k + 1]
        sign = np.sign(values[k]) or -np.sign(values[k + 1])
        for _ in range(200):
            middle = (low + high) / 2
            low, high = (middle, high) if np.sign(float(f(middle))) == sign else (low, middle)
        if high > 1e-12:
            yield float(high)


def _is_smooth(theta: ca.SX, first: ca.SX, s: ca.SX) -> bool:
    """Whether theta' is proved continuous: by intervals, or because theta's slope in each kink vanishes where it bends."""
    if interval.is_continuous(ca.vertcat(theta, first), s, ZERO, INFINITY):
        return True
    symbols: list[ca.SX] = []
    places: list[ca.SX] = []

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX:
        symbols.append(ca.SX.sym(f"kink{len(symbols)}"))
        places.append(ca.SX(0) if op == ca.OP_FABS else args[1])
        return symbols[-1]

    smooth = replay(theta, rule, (ca.OP_FABS, ca.OP_FMAX, ca.OP_FMIN), s, "theta")
    kinks = column(symbols)
    if any(ca.depends_on(place, kinks) for place in places):
        return False
    slopes = ca.gradient(smooth, kinks)
    flat = all(
        ca.simplify(ca.substitute(slope, kink, place)).is_zero()
        for slope, kink, place in zip(ca.vertsplit(slopes), symbols, places, strict=True)
    )
    z = ca.vertcat(s, kinks)
    low, high = np.append(0.0, np.full(len(symbols), -np.inf)), np.full(1 + len(symbols), np.inf)
    inner = column(places)  # the arguments themselves are to be C1
    parts = ca.vertcat(smooth, ca.gradient(smooth, z), inner, ca.vec(ca.jacobian(inner, s)))
    return flat and interval.is_continuous(parts, z, low, high)
