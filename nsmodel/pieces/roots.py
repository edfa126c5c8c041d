"""Where a piece ends: the first root of its conditions, by Bernstein's test, and the same to rounding."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import accumulate
from operator import mul

from nsmodel.pieces.bernstein import first_root, slope, value
from nsmodel.pieces.modes import ORDERS, Place, leading, pace
from nsmodel.pieces.multipliers import Solve
from nsmodel.pieces.switches import TIE, Condition, conditions, size
from nsmodel.pieces.system import System

POLISHING, NEAR = 6, 0.1  # Expansions at the event, and how far from it in units of time they may go.
POLISHED, ON_ONE = 1e-3, 3  # Of a tie: what is no more is on the event; steps of Newton's method on one expansion.
TOUCH, PAST = 4.0, 3  # How deep a touch may be, in ties; how many of its half lengths lead out of it.
CUBIC, SETTLED = 1e3, 1e-9  # What the third order of a threefold root is beside rounding, and when that root is found.
TAIL, LOST = 2, 1e-2  # Coefficients that tell a truncation, and the share of the largest that is too much for a root.


def first_event(system: System, place: Place, how: Solve, orders: int, s: float) -> tuple[Condition | None, float]:
    """The condition that ends first, and when; (None, s) where none ends before s.

    A condition that is 0 at the start is divided by the power of s that it begins with, the one that its germ was judged by;
    where that sign is wrong all the same, it ends at once. What is rounding all along is none.
    A root where the last coefficients are not small beside the others is one of what was cut off: half of the way to it is gone.
    """
    hit, share, powers = None, None, _powers(s, orders)
    for condition in conditions(system, place.codes, how, orders):
        row, known = condition.row, condition.orders + 1
        if condition.sign * row[0] + condition.shift > sum(map(abs, map(mul, row[1:known], powers[1:]))):
            continue
        germ = condition.coefficients()
        c = list(map(mul, germ, powers))
        least, opened = TIE * size(system, condition), condition.of in place.open
        if max(map(abs, c)) <= least:
            continue
        if opened or c[0] <= 0:
            share = pace(system) if share is None else share
            first = leading(germ, least if opened else 0.0, share)
            c = c[ORDERS + 1 if first is None else first :]
            if max(map(abs, c)) <= least:
                continue
            c[0] = max(c[0], 0.0)
        root = first_root(c)
        if root <= 1:
            s, hit = s * root, condition
            if root > 0 and max(map(abs, c[-TAIL:])) > LOST * max(map(abs, c)):
                s, hit = s / 2, None
            powers = _powers(s, orders)
    return hit, s


def _powers(s: float, orders: int) -> list[float]:
    return list(accumulate([s] * orders, mul, initial=1.0))


def polish(
    system: System, place: Place, hit: Condition, orders: int, how: Solve, expand: Callable[[int], Solve]
) -> tuple[Solve, Condition | None]:
    """Move the place, whose expansion stands, to where the condition is 0 to rounding, on expansions there; and that there.

    On the piece's own expansion the derivatives at the event would have the sign of what it was cut by.
    """
    for _ in range(POLISHING):
        own = next((c for c in conditions(system, place.codes, how, orders) if same(c, hit)), None)
        if own is None:
            return how, None
        c = own.coefficients()
        scale = max(size(system, own), *map(abs, c))
        d = _threefold(c, TIE * scale)
        if d is not None and abs(d) < SETTLED:
            return how, own
        if d is None:
            if abs(c[0]) <= POLISHED * TIE * scale or c[1] == 0 or not abs(c[0] / c[1]) < NEAR:
                return how, own
            d = -c[0] / c[1]
            for _ in range(ON_ONE):
                e = slope(c, d)
                d -= value(c, d) / e if e and abs(value(c, d) / e) < NEAR else 0.0
        place.x = [value(row[: orders + 1], d) for row in system.x]
        place.t += d * place.tau
        how = expand(orders)
    return how, next((c for c in conditions(system, place.codes, how, orders) if same(c, hit)), None)


def _threefold(c: list[float], tie: float) -> float | None:
    """Where c'' is 0, if c and c' are rounding there: c alone tells a threefold root to the cube root of its rounding."""
    if len(c) < 4 or not abs(c[3]) > CUBIC * tie or not abs(c[2] / (3 * c[3])) < NEAR:
        return None
    d = -c[2] / (3 * c[3])
    return d if max(abs(value(c, d)), abs(slope(c, d))) <= tie else None


def beyond_touch(system: System, condition: Condition) -> float | None:
    """Where a condition that comes to 0 and goes back, not deeper than rounding, is past that; None where it does not go back.

    Or not soon: what is rounding for long is no touch.
    """
    c = condition.coefficients()
    tie = TIE * max(size(system, condition), *map(abs, c))
    if len(c) < 3 or not c[2] > 0 or abs(c[0]) > tie or c[1] ** 2 > TOUCH * c[2] * tie:
        return None
    past = PAST * math.sqrt(tie / c[2]) + abs(c[1]) / c[2]
    return past if past < NEAR else None


def same(one: Condition, other: Condition) -> bool:
    """Whether two conditions watch the same end of the same switch."""
    return one.of == other.of and one.after == other.after
