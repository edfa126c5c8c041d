"""Where a piece ends: the first root of its conditions, by Bernstein's test, and the same to rounding."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import accumulate
from operator import mul
from typing import NamedTuple

from nsmodel.pieces.bernstein import NONE, first_root, poly_slope, poly_value, simple_root, taylor_shift
from nsmodel.pieces.disc_equations import EquationsOnDisc
from nsmodel.pieces.isolation import NEAR, IsolatedRoot, RootIsolation, current_condition
from nsmodel.pieces.lengths import power_of_two_unit
from nsmodel.pieces.modes import ORDERS, ULP, PieceStart, dominant_time_share, germ_time_share, leading_order, lowest_order
from nsmodel.pieces.multipliers import MultiplierSolver
from nsmodel.pieces.switches import ROW, TIE, SwitchCondition, condition_scale, condition_uncertainty, mode_conditions
from nsmodel.pieces.system import ModeSystem

POLISHING = 6  # Expansions at the event.
POLISHED, ON_ONE = 1e-3, 3  # Of a tie: what is no more is on the event; steps of Newton's method on one expansion.
TAIL, LOST = 2, 1e-2  # Coefficients that tell a truncation, and the share of the largest that is too much for a root.
DIP = 64 * 2.0**-52  # Of the sum of its terms: what rounding may hide of a polynomial in the Bernstein basis.
MIN_PART = 2.0**-200  # Of a piece.
INSTANT = 8  # Roundings of the time.
STEEP = 0.5  # Of the slope at a simple root: what it may change by where the sign is not known.


class Margins(NamedTuple):
    """What rows of h and what branches look at may differ from their polynomials by, on a piece."""

    y: list[float]
    switches: list[float]


NO_MARGINS = Margins([], [])


class EventLocator:
    """Of the conditions of a system."""

    def __init__(self, system: ModeSystem, on: EquationsOnDisc) -> None:
        self._system, self._isolation = system, RootIsolation(system, on)

    def first(
        self,
        place: PieceStart,
        how: MultiplierSolver,
        orders: int,
        s: float,
        margins: Margins = NO_MARGINS,
        but: SwitchCondition | None = None,
    ) -> tuple[SwitchCondition | None, float]:
        """The condition that ends first, and when; (None, s) where none ends before s.

        A condition that is 0 at the start is divided by the power of s that it begins with, the one that its germ was judged
        by; where that sign is wrong all the same, it ends at once. What is rounding all along is none. One that comes to less
        than its margin and goes back ends there too: expanded anew there, it has a smaller one. ``but``: a condition whose
        switch is left out. A root where the last coefficients are not small beside the others is one of what was cut off, where
        nothing bounds that: half of the way to it is gone.
        """
        system, hit, share, powers, whole = self._system, None, None, _argument_powers(s, orders), s
        for condition in mode_conditions(system, place.codes, how, orders):
            if but is not None and condition.of == but.of:
                continue
            row, known = condition.row, condition.orders + 1
            margin = self._condition_margin(condition, margins)
            if margin and s < whole:
                margin *= (s / whole) ** known
            terms = sum(map(abs, map(mul, row[1:known], powers[1:])))
            if condition.sign * row[0] + condition.shift - margin > terms:
                continue
            germ = condition.coefficients()
            c = list(map(mul, germ, powers))
            least, opened = TIE * condition_scale(system, condition), condition.of in place.open
            largest = max(map(abs, c))
            if largest <= least:
                least = condition_uncertainty(system, condition)
                if largest <= least:
                    continue
            if c[0] <= (least if opened else 0.0):
                share = germ_time_share(system) if share is None else share
                first = leading_order(germ, least, share) if opened else leading_order(germ, 0.0, share)
                if opened and first != 1:
                    least = condition_uncertainty(system, condition)
                    first = lowest_order(germ, least) if least else leading_order(germ, least, share)
                c = c[ORDERS + 1 if first is None else first :]
                if max(map(abs, c)) <= least:
                    continue
                if c[0] < 0:
                    return condition, 0.0
            part = _resolvable_part(c)
            if part < 1:
                c = list(map(mul, c, _argument_powers(part, len(c) - 1)))
            root = _first_reliable_root(c, margin)
            if root > 1 and part == 1:
                continue
            s, hit = s * part * min(root, 1.0), condition if root <= 1 else None
            lost = hit is not None and root > 0 and (condition.acts == "l" or margins is NO_MARGINS)
            if lost and max(map(abs, c[-TAIL:])) > LOST * max(map(abs, c)):
                s, hit = s / 2, None
            powers = _argument_powers(s, orders)
        return hit, s

    def _condition_margin(self, condition: SwitchCondition, margins: Margins) -> float:
        kind, i = condition.of
        if condition.acts == "y":
            return margins.y[i] if margins.y and i not in self._system.blocks.of else 0.0
        if kind == ROW or not margins.switches:
            return 0.0
        return margins.switches[self._system.branches.index(condition.of)]

    def polish_event(
        self, place: PieceStart, hit: SwitchCondition, orders: int, how: MultiplierSolver,
        expand: Callable[[int], MultiplierSolver], many: int, end: float, rtol: float,
    ) -> IsolatedRoot:  # fmt: skip
        """Move the place, whose expansion stands, to where the condition is 0 to rounding, on expansions of ``orders`` there.

        On the piece's own expansion the derivatives at the event would have the sign of what it was cut by. What is no simple
        root is isolated on expansions of ``many`` orders, up to the time ``end``; how wide it is where states are known to rtol
        is told of such a one.
        """
        system = self._system
        for moved in range(POLISHING):
            own = current_condition(system, place, how, hit, orders)
            if own is None:
                return IsolatedRoot(how, None, 0.0, 0, True, place.t)
            c, known, instant = own.coefficients(), TIE * condition_scale(system, own), INSTANT * ULP * abs(place.t) / place.tau
            if not (is_simple_root(c, known, instant) or is_simple_root(c, known := condition_uncertainty(system, own), instant)):
                found = self._isolation.isolate(
                    place, hit, many, expand, end, lambda how, s: self.first(place, how, many, s, but=hit)[1]
                )
                if found.crosses and (isolated := found.own) is not None:
                    found = found._replace(width=max(found.width, self._isolation.width(place, isolated, rtol)))
                    c = isolated.coefficients()
                    share = dominant_time_share(c, 1)
                    place.tau = (
                        power_of_two_unit(place.tau * share)
                        if abs(c[1]) * share > condition_uncertainty(system, isolated)
                        else place.tau
                    )
                how = expand(orders)
                return found._replace(how=how, own=current_condition(system, place, how, hit, orders))
            d = -c[0] / c[1]
            if (moved and abs(c[0]) <= POLISHED * known) or abs(d) * place.tau <= ULP * abs(place.t):
                break
            for _ in range(ON_ONE):
                e = poly_slope(c, d)
                d -= poly_value(c, d) / e if e and abs(poly_value(c, d) / e) < NEAR else 0.0
            place.x = [poly_value(row[: orders + 1], d) for row in system.x]
            place.t += d * place.tau
            how = expand(orders)
        own, width = current_condition(system, place, how, hit, orders), 0.0
        if own is not None and not is_simple_root(own.coefficients(), rtol * condition_scale(system, own)):
            width = self._isolation.width(place, own, rtol)
        return IsolatedRoot(how, own, width, 0, True, place.t)


def _resolvable_part(c: list[float]) -> float:
    """The part of [0, 1] on which rounding does not hide c_0 > 0 behind the other terms: all of it, but for octaves."""
    part, terms = 1.0, list(map(abs, c[1:]))
    while part > MIN_PART and c[0] > 0:
        if DIP * sum(a * part**k for k, a in enumerate(terms, 1)) < c[0] / 4:
            return part
        part /= 4
    return 1.0


def _first_reliable_root(c: list[float], margin: float) -> float:
    """The first root in (0, 1] of c, known to rounding and a margin, of its last order, at 1; NONE where it is above these.

    Where it comes so near to 0 long before its root, or has none, that.
    """
    if not c[0] > 0:
        return first_root(c)
    rounding = DIP * sum(map(abs, c))
    near = first_root([c[0] - rounding, *c[1:-1], c[-1] - margin]) if c[0] > rounding and len(c) > 1 else 0.0
    if near > 1:
        return near
    v, rate = poly_value(c, near), poly_slope(c, near)
    if rate < 0:
        beyond = near - 2 * v / rate
        if poly_value(c, beyond) < 0 and _max_second_derivative(c, beyond) * (beyond - near) <= STEEP * -rate:
            root = simple_root(c, near, beyond, near - v / rate)
            return root if root <= 1 else NONE
    root = first_root(c)
    return root if root <= 1 and _falls_steadily(taylor_shift(c, root), root - near) else near


def _max_second_derivative(c: list[float], s: float) -> float:
    """No second derivative on [0, s] is larger."""
    return poly_value([k * (k - 1) * abs(a) for k, a in enumerate(c[2:], 2)], s)


def is_simple_root(c: list[float], tie: float, instant: float = 0.0) -> bool:
    """Whether c falls to 0 near s = 0, once, where its sign is not known; in an instant, by its first order."""
    width = 2 * (abs(c[0]) + tie) / -c[1] if len(c) > 1 and c[1] < 0 else math.inf
    return width <= instant or (width < NEAR and _falls_steadily(c, width))


def _falls_steadily(c: list[float], width: float) -> bool:
    """Whether the slope for |s| <= width is about c_1 < 0."""
    return c[1] < 0 and sum(k * abs(a) * width ** (k - 1) for k, a in enumerate(c[2:], 2)) <= STEEP * -c[1]


def _argument_powers(s: float, orders: int) -> list[float]:
    return list(accumulate([s] * orders, mul, initial=1.0))
