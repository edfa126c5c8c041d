"""Is a function of one variable nondecreasing: piece by piece between the points where its operations switch.

Where every switching argument is affine these points are rational. Between two of them the function is continuous and its
derivative is not negative, by exact polynomials or by bounds; its values at one lie between those beside it, also at the ends.
"""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import exact, extremum, interval_bounds, polynomial
from nsmodel.proof.expression_graph import (
    KINK_OPERATIONS,
    additive_terms,
    is_double,
    is_same_expression,
    rewrite_nodes,
)

SWITCHING_STEPS = (ca.OP_SIGN, ca.OP_LT, ca.OP_LE)
MAX_MONOTONE_PIECES = 32  # Pieces of a function of one variable; more are left open, as each is bounded by itself.


def extract_constant_factor(term: ca.SX) -> tuple[Fraction, ca.SX]:
    """The term as a number times the rest, the constants of its products taken out."""
    if term.is_constant() or term.is_symbolic():
        return Fraction(1), term
    op = term.op()
    if op in (ca.OP_NEG, ca.OP_TWICE):
        number, rest = extract_constant_factor(term.dep(0))
        return number * (-1 if op == ca.OP_NEG else 2), rest
    if op not in (ca.OP_MUL, ca.OP_DIV):
        return Fraction(1), term
    total, parts = Fraction(1), []
    for i in range(2):
        part = term.dep(i)
        if part.is_constant():
            value = float(part)
            if not np.isfinite(value) or not value:
                return Fraction(1), term
            total = total * Fraction(value) if op == ca.OP_MUL or i == 0 else total / Fraction(value)
            parts.append(None)
        else:
            number, rest = extract_constant_factor(part)
            total = total * number if op == ca.OP_MUL or i == 0 else total / number
            parts.append(rest)
    one, other = parts
    if op == ca.OP_MUL:
        return total, other if one is None else one if other is None else one * other
    return total, 1 / other if one is None else one if other is None else one / other


def is_continuous_by_pieces(h: ca.SX, s: ca.SX, low: float, high: float) -> bool:
    """Whether h is proved to be continuous on [low, high]: on each piece, and with one value from both sides of a switch."""
    moved = _recentre_switch(h, s, low, high)
    if moved is None:
        return False
    h, low, high = moved
    found = _split_at_switches(h, s, None if np.isinf(low) else Fraction(low), None if np.isinf(high) else Fraction(high))
    if found is None:
        return False
    ends, pieces, points = found
    for k, point in enumerate(ends):
        beside = pieces[max(k - 1, 0) : k + 1]
        if point is None or (len(beside) == 1 and not points.get(point)):
            continue
        if Fraction(float(point)) != point:
            return False
        if points.get(point):
            at = np.array([float(point)])
            sides = interval_bounds.enclose(ca.vertcat(*beside, ca.substitute(h, s, float(point))), s, at, at)
            if len(set(np.concatenate([side.ravel() for side in sides]))) > 1:
                return False
    for piece, (a, b) in zip(pieces, pairwise(ends), strict=True):
        bounds = np.array([-np.inf if a is None else float(a)]), np.array([np.inf if b is None else float(b)])
        if not interval_bounds.is_continuous(piece, s, *bounds):
            return False
    return True


class JumpPoint(NamedTuple):
    """A point where the function jumps, at an end of the interval beside the value there; ``filled``: its sign is a set there."""

    at: Fraction
    filled: bool


class Monotonicity(NamedTuple):
    """``nondecreasing`` where it is proved (None: undecided, False: it jumps downwards), and the jumps that are not 0."""

    nondecreasing: bool | None
    jumps: tuple[JumpPoint, ...] = ()


def decide_monotonicity(h: ca.SX, s: ca.SX, low: float, high: float, *, signs_are_sets: bool = True) -> Monotonicity:
    """Decide whether h is nondecreasing on [low, high], ends may be infinite; a sign of 0 is 0, or [-1, 1]."""
    stairs = [(factor, term) for factor, term in additive_terms(h) if _is_rising_staircase(factor, term, s)]
    if stairs:  # floor and ceil of what rises
        h = _remove_terms(h, [term for _, term in stairs])
    moved = _recentre_switch(h, s, low, high)
    if moved is None:
        return Monotonicity(None)
    h, low, high = moved
    found = _split_at_switches(h, s, None if np.isinf(low) else Fraction(low), None if np.isinf(high) else Fraction(high))
    if found is None:
        return Monotonicity(None)
    ends, pieces, points = found
    jumps = []
    for k, point in enumerate(ends):
        if point is None or not points.get(point):
            continue
        if Fraction(float(point)) != point:
            return Monotonicity(None)
        left, right = (pieces[k - 1] if k else None), (pieces[k] if k < len(pieces) else None)
        signs = (-1, 1) if signs_are_sets else (0,)
        values = [_resolve_switches(h, s, point, point, {}, sign_of_zero=sign)[0] for sign in signs]
        below = [_gap(left, value, s, point) for value in values if left is not None]
        above = [_gap(value, right, s, point) for value in values if right is not None]
        if any(gap[1] < 0 for gap in below + above):
            return Monotonicity(False, (JumpPoint(point, filled=False),))
        if any(gap[0] < 0 for gap in below + above):
            return Monotonicity(None)
        reached = all((0.0, 0.0) in gaps for gaps in (below, above) if gaps)
        if not reached or any(gap[1] > 0 for gap in below + above):
            jumps.append(JumpPoint(point, filled=reached))
    if not all(_is_nondecreasing_between(piece, s, a, b) for piece, (a, b) in zip(pieces, pairwise(ends), strict=True)):
        return Monotonicity(None)
    stair_jumps = (JumpPoint(Fraction(0), filled=False),) if stairs else ()
    return Monotonicity(True, (*jumps, *stair_jumps))


def _gap(low: ca.SX, high: ca.SX, s: ca.SX, point: Fraction) -> tuple[float, float]:
    """Bounds of high - low at a point; 0 where they are one expression."""
    if is_same_expression(low, high):
        return 0.0, 0.0
    at = np.array([float(point)])
    gap = interval_bounds.enclose(high - low, s, at, at)
    return float(np.min(gap[0])), float(np.max(gap[1]))


def _is_rising_staircase(factor: Fraction, term: ca.SX, s: ca.SX) -> bool:
    """Whether factor times the term is a staircase upwards: floor or ceil of an affine function."""
    if term.is_constant() or term.is_symbolic() or term.op() not in (ca.OP_FLOOR, ca.OP_CEIL):
        return False
    (p,) = polynomial.read_polynomials(term.dep(0), s)
    return p is not None and polynomial.degree(p) <= 1 and factor * p.get(((0, 1),), Fraction(0)) >= 0


def _remove_terms(h: ca.SX, terms: list[ca.SX]) -> ca.SX:
    kept = ca.SX(0)
    for factor, term in additive_terms(h):
        if not any(ca.is_equal(term, other, 5) for other in terms):
            kept += float(factor) * term
    return kept


def _recentre_switch(h: ca.SX, s: ca.SX, low: float, high: float) -> tuple[ca.SX, float, float] | None:
    """h as a function of u = the first switching argument (upwards), so that its switch is at the double 0, and the ends of u.

    None where the other affine arguments are no a u + b with doubles a and b.
    """
    arguments: list[polynomial.Polynomial | None] = []

    def collect(op: int, args: list[ca.SX], old: ca.SX) -> None:
        arguments.extend(polynomial.read_polynomials(args[0] if len(args) == 1 else args[0] - args[1], s))

    rewrite_nodes(h, collect, (*KINK_OPERATIONS, *SWITCHING_STEPS), s, "expression")
    itself: polynomial.Polynomial = {((0, 1),): Fraction(1)}
    first = next((p for p in arguments if p is not None and set(p) - {()} == set(itself)), itself)
    slope, offset = first[((0, 1),)], first.get((), Fraction(0))
    slope, offset = (slope, offset) if slope > 0 else (-slope, -offset)
    if (slope, offset) == (1, 0):
        return h, low, high

    def write(p: polynomial.Polynomial) -> ca.SX:
        a = p[((0, 1),)] / slope
        b = p.get((), Fraction(0)) - a * offset
        if not (is_double(a) and is_double(b)):
            raise ValueError("no double")
        return float(a) * s + float(b)

    try:
        moved = polynomial.rewrite_parts(h, lambda _: itself, write)
    except ValueError:
        return None
    ends = [end if np.isinf(end) else slope * Fraction(end) + offset for end in (low, high)]
    return moved, _round_towards(ends[0], -np.inf), _round_towards(ends[1], np.inf)


def _round_towards(number: Fraction | float, towards: float) -> float:
    if isinstance(number, float):
        return number
    return (exact.round_down if towards < 0 else exact.round_up)(Fraction(number))


def _split_at_switches(
    h: ca.SX, s: ca.SX, low: Fraction | None, high: Fraction | None
) -> tuple[list[Fraction | None], list[ca.SX], dict[Fraction, tuple[int, ...]]] | None:
    """The ends of the pieces, h on each with its cases put in, and what jumps at each end; None where that fails."""
    points: dict[Fraction, tuple[int, ...]] = {}
    done: list[tuple[Fraction | None, Fraction | None, ca.SX]] = []
    left = [(low, high)]
    while left:
        a, b = left.pop()
        resolved, cut, failed = _resolve_switches(h, s, a, b, points)
        if failed or len(left) + len(done) > MAX_MONOTONE_PIECES:
            return None
        if cut is None:
            done.append((a, b, resolved))
        else:
            left += [(cut, b), (a, cut)]
    return [done[0][0], *(b for _, b, _ in done)], [resolved for _, _, resolved in done], points


def _resolve_switches(
    h: ca.SX, s: ca.SX, low: Fraction | None, high: Fraction | None, points: dict[Fraction, tuple[int, ...]],
    *, sign_of_zero: int = 0,
) -> tuple[ca.SX, Fraction | None, bool]:  # fmt: skip
    """h with the cases of (low, high) put in, or a place inside where one of them changes; whether that failed."""
    middle = (low + high) / 2 if low is not None and high is not None else low + 1 if low is not None else (
        high - 1 if high is not None else Fraction(0)
    )  # fmt: skip
    cuts: list[Fraction] = []
    failed = []

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX | None:
        if op == ca.OP_IF_ELSE_ZERO:
            return (args[1] if float(args[0]) else ca.SX(0)) if args[0].is_constant() else None
        (p,) = polynomial.read_polynomials(args[0] if len(args) == 1 else args[0] - args[1], s)
        if p is None or polynomial.degree(p) > 1 or op not in (*KINK_OPERATIONS, *SWITCHING_STEPS):
            failed.extend([] if cuts else [op])
            return None
        slope = p.get(((0, 1),), Fraction(0))
        if slope:
            root = -p.get((), Fraction(0)) / slope
            points[root] = tuple({*points.get(root, ()), *((op,) if op in SWITCHING_STEPS else ())})
            if (low is None or low < root) and (high is None or root < high):
                cuts.append(root)
                return None
        value = polynomial.evaluate_polynomial(p, {0: middle})
        if op == ca.OP_SIGN:
            return ca.SX(float((value > 0) - (value < 0)) if value else float(sign_of_zero))
        if op in SWITCHING_STEPS:
            return ca.SX(float(value < 0 or (op == ca.OP_LE and value == 0)))
        if op == ca.OP_FABS:
            return -args[0] if value < 0 else args[0]
        return args[int((value < 0) == (op == ca.OP_FMAX))]

    others = (ca.OP_FLOOR, ca.OP_CEIL, ca.OP_EQ, ca.OP_NE, ca.OP_FMOD, ca.OP_REMAINDER, ca.OP_COPYSIGN)
    resolved = rewrite_nodes(h, rule, (*KINK_OPERATIONS, *SWITCHING_STEPS, ca.OP_IF_ELSE_ZERO, *others), s, "expression")
    return resolved, (cuts[0] if cuts else None), bool(failed) and not cuts


def _is_nondecreasing_between(h: ca.SX, s: ca.SX, low: Fraction | None, high: Fraction | None) -> bool:
    a, b = (np.array([-np.inf if low is None else float(low)]), np.array([np.inf if high is None else float(high)]))
    if (low is not None and Fraction(a[0]) > low) or (high is not None and Fraction(b[0]) < high):
        return False
    quotient = polynomial.read_quotient(h, s)
    if quotient is not None:
        top, bottom = (polynomial.univariate_coefficients(part) for part in quotient)
        rate = _quotient_derivative_numerator(top, bottom)
        defined = len(bottom) == 1 or not polynomial.real_roots(bottom, low, high)
        if defined:
            return polynomial.negative_point(rate, low, high) is None
    if not interval_bounds.is_continuous(h, s, a, b):
        return False
    if (
        a[0] < 0 < b[0]
        and _is_nondecreasing_between(h, s, low, Fraction(0))
        and _is_nondecreasing_between(h, s, Fraction(0), high)
    ):
        return True
    return bool(extremum.supremum(-ca.gradient(h, s), s, a, b, bound_to=0.0, quick=True).bound <= 0) or bool(
        extremum.supremum(-ca.gradient(h, s), s, a, b, bound_to=0.0).bound <= 0
    )


def _quotient_derivative_numerator(top: list[Fraction], bottom: list[Fraction]) -> list[Fraction]:
    """The numerator N'D - N D' of the derivative of N/D."""
    one, two = (_multiply_coefficients(polynomial.derivative_coefficients(x), y) for x, y in ((top, bottom), (bottom, top)))
    size = max(len(one), len(two))
    return [(one[k] if k < len(one) else Fraction(0)) - (two[k] if k < len(two) else Fraction(0)) for k in range(size)]


def _multiply_coefficients(a: list[Fraction], b: list[Fraction]) -> list[Fraction]:
    out = [Fraction(0)] * max(len(a) + len(b) - 1, 0)
    for i, x in enumerate(a):
        for j, y in enumerate(b):
            out[i + j] += x * y
    return out
