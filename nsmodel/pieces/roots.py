"""Where a piece ends: the first root of its conditions, by Bernstein's test, and the same to rounding."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import accumulate
from operator import mul
from typing import NamedTuple

from nsmodel.pieces.bernstein import NONE, about, first_root, simple_root, slope, value
from nsmodel.pieces.disc_equations import EquationsOnDisc
from nsmodel.pieces.isolation import NEAR, Isolated, Isolation, own_condition
from nsmodel.pieces.lengths import unit
from nsmodel.pieces.modes import ORDERS, ULP, Place, leading, lowest, pace, share_of
from nsmodel.pieces.multipliers import Solve
from nsmodel.pieces.switches import ROW, TIE, Condition, conditions, size, tie
from nsmodel.pieces.system import System

POLISHING = 6  # Expansions at the event.
POLISHED, ON_ONE = 1e-3, 3  # Of a tie: what is no more is on the event; steps of Newton's method on one expansion.
TAIL, LOST = 2, 1e-2  # Coefficients that tell a truncation, and the share of the largest that is too much for a root.
DIP = 64 * 2.0**-52  # Of the sum of its terms: what rounding may hide of a polynomial in the Bernstein basis.
LEAST_PART = 2.0**-200  # Of a piece.
INSTANT = 8  # Roundings of the time.
STEEP = 0.5  # Of the slope at a simple root: what it may change by where the sign is not known.


class Margins(NamedTuple):
    """What rows of h and what branches look at may differ from their polynomials by, on a piece."""

    y: list[float]
    switches: list[float]


NO_MARGINS = Margins([], [])


class Roots:
    """Of the conditions of a system."""

    def __init__(self, system: System, on: EquationsOnDisc) -> None:
        self._system, self._isolation = system, Isolation(system, on)

    def first(
        self, place: Place, how: Solve, orders: int, s: float, margins: Margins = NO_MARGINS, but: Condition | None = None
    ) -> tuple[Condition | None, float]:
        """The condition that ends first, and when; (None, s) where none ends before s.

        A condition that is 0 at the start is divided by the power of s that it begins with, the one that its germ was judged
        by; where that sign is wrong all the same, it ends at once. What is rounding all along is none. One that comes to less
        than its margin and goes back ends there too: expanded anew there, it has a smaller one. ``but``: a condition whose
        switch is left out. A root where the last coefficients are not small beside the others is one of what was cut off, where
        nothing bounds that: half of the way to it is gone.
        """
        system, hit, share, powers, whole = self._system, None, None, _powers(s, orders), s
        for condition in conditions(system, place.codes, how, orders):
            if but is not None and condition.of == but.of:
                continue
            row, known = condition.row, condition.orders + 1
            margin = self._margin(condition, margins)
            if margin and s < whole:
                margin *= (s / whole) ** known
            terms = sum(map(abs, map(mul, row[1:known], powers[1:])))
            if condition.sign * row[0] + condition.shift - margin > terms:
                continue
            germ = condition.coefficients()
            c = list(map(mul, germ, powers))
            least, opened = TIE * size(system, condition), condition.of in place.open
            largest = max(map(abs, c))
            if largest <= least:
                least = tie(system, condition)
                if largest <= least:
                    continue
            if c[0] <= (least if opened else 0.0):
                share = pace(system) if share is None else share
                first = leading(germ, least, share) if opened else leading(germ, 0.0, share)
                if opened and first != 1:
                    least = tie(system, condition)
                    first = lowest(germ, least) if least else leading(germ, least, share)
                c = c[ORDERS + 1 if first is None else first :]
                if max(map(abs, c)) <= least:
                    continue
                if c[0] < 0:
                    return condition, 0.0
            part = _seen(c)
            if part < 1:
                c = list(map(mul, c, _powers(part, len(c) - 1)))
            root = _where(c, margin)
            if root > 1 and part == 1:
                continue
            s, hit = s * part * min(root, 1.0), condition if root <= 1 else None
            lost = hit is not None and root > 0 and (condition.acts == "l" or margins is NO_MARGINS)
            if lost and max(map(abs, c[-TAIL:])) > LOST * max(map(abs, c)):
                s, hit = s / 2, None
            powers = _powers(s, orders)
        return hit, s

    def _margin(self, condition: Condition, margins: Margins) -> float:
        kind, i = condition.of
        if condition.acts == "y":
            return margins.y[i] if margins.y and i not in self._system.blocks.of else 0.0
        if kind == ROW or not margins.switches:
            return 0.0
        return margins.switches[self._system.branches.index(condition.of)]

    def polish(
        self, place: Place, hit: Condition, orders: int, how: Solve, expand: Callable[[int], Solve], many: int, end: float,
        rtol: float,
    ) -> Isolated:  # fmt: skip
        """Move the place, whose expansion stands, to where the condition is 0 to rounding, on expansions of ``orders`` there.

        On the piece's own expansion the derivatives at the event would have the sign of what it was cut by. What is no simple
        root is isolated on expansions of ``many`` orders, up to the time ``end``; how wide it is where states are known to rtol
        is told of such a one.
        """
        system = self._system
        for moved in range(POLISHING):
            own = own_condition(system, place, how, hit, orders)
            if own is None:
                return Isolated(how, None, 0.0, 0, True, place.t)
            c, known, instant = own.coefficients(), TIE * size(system, own), INSTANT * ULP * abs(place.t) / place.tau
            if not (is_simple(c, known, instant) or is_simple(c, known := tie(system, own), instant)):
                found = self._isolation.isolate(
                    place, hit, many, expand, end, lambda how, s: self.first(place, how, many, s, but=hit)[1]
                )
                if found.crosses and (there := found.own) is not None:
                    found = found._replace(width=max(found.width, self._isolation.width(place, there, rtol)))
                    c = there.coefficients()
                    share = share_of(c, 1)
                    place.tau = unit(place.tau * share) if abs(c[1]) * share > tie(system, there) else place.tau
                how = expand(orders)
                return found._replace(how=how, own=own_condition(system, place, how, hit, orders))
            d = -c[0] / c[1]
            if (moved and abs(c[0]) <= POLISHED * known) or abs(d) * place.tau <= ULP * abs(place.t):
                break
            for _ in range(ON_ONE):
                e = slope(c, d)
                d -= value(c, d) / e if e and abs(value(c, d) / e) < NEAR else 0.0
            place.x = [value(row[: orders + 1], d) for row in system.x]
            place.t += d * place.tau
            how = expand(orders)
        own, width = own_condition(system, place, how, hit, orders), 0.0
        if own is not None and not is_simple(own.coefficients(), rtol * size(system, own)):
            width = self._isolation.width(place, own, rtol)
        return Isolated(how, own, width, 0, True, place.t)


def _seen(c: list[float]) -> float:
    """The part of [0, 1] on which rounding does not hide c_0 > 0 behind the other terms: all of it, but for octaves."""
    part, terms = 1.0, list(map(abs, c[1:]))
    while part > LEAST_PART and c[0] > 0:
        if DIP * sum(a * part**k for k, a in enumerate(terms, 1)) < c[0] / 4:
            return part
        part /= 4
    return 1.0


def _where(c: list[float], margin: float) -> float:
    """The first root in (0, 1] of c, known to rounding and a margin, of its last order, at 1; NONE where it is above these.

    Where it comes so near to 0 long before its root, or has none, that.
    """
    if not c[0] > 0:
        return first_root(c)
    rounding = DIP * sum(map(abs, c))
    near = first_root([c[0] - rounding, *c[1:-1], c[-1] - margin]) if c[0] > rounding and len(c) > 1 else 0.0
    if near > 1:
        return near
    v, rate = value(c, near), slope(c, near)
    if rate < 0:
        beyond = near - 2 * v / rate
        if value(c, beyond) < 0 and _bend(c, beyond) * (beyond - near) <= STEEP * -rate:
            root = simple_root(c, near, beyond, near - v / rate)
            return root if root <= 1 else NONE
    root = first_root(c)
    return root if root <= 1 and _falls(about(c, root), root - near) else near


def _bend(c: list[float], s: float) -> float:
    """No second derivative on [0, s] is larger."""
    return value([k * (k - 1) * abs(a) for k, a in enumerate(c[2:], 2)], s)


def is_simple(c: list[float], tie: float, instant: float = 0.0) -> bool:
    """Whether c falls to 0 near s = 0, once, where its sign is not known; in an instant, by its first order."""
    width = 2 * (abs(c[0]) + tie) / -c[1] if len(c) > 1 and c[1] < 0 else math.inf
    return width <= instant or (width < NEAR and _falls(c, width))


def _falls(c: list[float], width: float) -> bool:
    """Whether the slope for |s| <= width is about c_1 < 0."""
    return c[1] < 0 and sum(k * abs(a) * width ** (k - 1) for k, a in enumerate(c[2:], 2)) <= STEEP * -c[1]


def _powers(s: float, orders: int) -> list[float]:
    return list(accumulate([s] * orders, mul, initial=1.0))
