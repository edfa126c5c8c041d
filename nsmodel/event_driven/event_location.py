"""Where a piece ends: the first root of its conditions, by Bernstein's test, and the same to rounding.

Roots that Newton's method does not settle: of high multiplicity, in clusters, and dips that may or may not come to 0.

A condition c >= 0 is known about a place as a form (see `discs`), |c(s) - sum c_k s^k| <= e on [0, R]: e holds what is cut off,
the rounding of its operations, and what rounding has left in the states. Up to the first s with c(s) - e = 0 it is proved to be
positive; expanded anew from there, on a shorter disc, it is the sum of less, and e is smaller. Where that stands still, the other
side is looked for: the first R with c(R) + e < 0 is beyond a crossing, one with c(R) - e > 0 beyond a touch, or beyond a dip that
is not decided.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import accumulate
from operator import mul
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from nsmodel._utils import EPS, sum_in_order
from nsmodel.event_driven.bernstein import (
    GERM,
    NONE,
    ORDERS,
    dominant_time_share,
    first_root,
    leading_order,
    lowest_order,
    poly_slope,
    poly_value,
    poly_values,
    simple_root,
    taylor_shift,
    without_rounding,
)
from nsmodel.event_driven.disc_arithmetic import EquationsOnDisc, TaylorForm, form_of_polynomial
from nsmodel.event_driven.modes import (
    ROW,
    GermRounding,
    PieceStart,
    SwitchCondition,
    condition_argument,
    condition_scale,
    condition_uncertainty,
    germ_rounding,
    germ_time_share,
    has_own_row,
    is_same_condition,
    known_to,
    mode_conditions,
)
from nsmodel.event_driven.multipliers import TIE, MultiplierSolver
from nsmodel.event_driven.step_size import power_of_two_unit
from nsmodel.event_driven.system import ModeSystem

ALMOST = 0.999  # Of the way to where a sign is no longer proved: so far no rounding of that root leads beyond it.
CLOSER = 8.0  # Factor by which discs shrink towards a root: 18 such lead from 1 to EPS.
WIDER = 1.5  # Factor by which they grow beyond it: 89 such lead from EPS to 1; so near is the sign found again.
MAX_DISCS = 400  # Discs on the way to one event, at most; then the run goes on from where they have come to. (+)
MAX_MULTIPLICITY = 8  # Order of a derivative, at most, by whose simple root a multiple root is told; else by its own.
DEGREE = 16  # Of forms at least: a root of high order in t alone is seen so at coarse tolerances, too.
LOOKED = 16  # Values of a polynomial that is rounding alone, at as many points: each costs one Horner's rule. (+)
# NEAR: an expansion of order AROUND errs by about 0.1^5 so far away.
NEAR = 0.1  # In units of time: an event is not sought further from where the piece's polynomials have it.


class IsolatedRoot(NamedTuple):
    """Where the place stands now: how it is expanded there, the condition, and whether that ends there.

    ``width``: of the time in which its sign is not known, at the crossing or in the longest dip, which is ``at`` that time;
    ``touches``: dips that were passed.
    """

    how: MultiplierSolver
    own: SwitchCondition | None
    width: float
    touches: int
    crosses: bool
    at: float


class RootIsolation:
    """Of the conditions of a system."""

    def __init__(self, system: ModeSystem, on: EquationsOnDisc) -> None:
        self._system, self._on = system, on

    def width(self, place: PieceStart, own: SwitchCondition, share: float) -> float:
        """The time about a crossing, whose expansion stands, in which the sign is not known where states are known to a share."""
        system = self._system
        of_disc, _ = self._condition_on_disc(place, own, own.orders, NEAR * place.tau)
        c, e = [a / NEAR**k for k, a in enumerate(of_disc.tolist())], condition_uncertainty(system, own, share)
        before = [-a if k % 2 else a for k, a in enumerate(c)]
        return (_distance_to_level([-a for a in c], e) + _distance_to_level(before, e)) * place.tau

    def isolate(
        self, place: PieceStart, hit: SwitchCondition, orders: int, expand: Callable[[int], MultiplierSolver], end: float,
        others: Callable[[MultiplierSolver, float], float],
    ) -> IsolatedRoot:  # fmt: skip
        """Move the place over what is proved to be positive, and over dips, to the first crossing, or to the time ``end``.

        ``others(how, s)``: where another condition ends, in s from the place and not beyond s; there the way ends too.
        """
        system, R, width, touches, at = self._system, end - place.t, 0.0, 0, place.t
        how = expand(orders)
        for _ in range(MAX_DISCS):
            R = min(R, end - place.t)
            own = current_condition(system, place, how, hit, orders)
            if own is None or not R > 0:
                break
            c, e = self._condition_on_disc(place, own, orders, R)
            s = _positive_until(c, e)
            if s is not None and (s == 0 or place.t + ALMOST * s * R == place.t):
                if R > EPS * abs(place.t):
                    R /= CLOSER
                    continue
                found = self._sign_beyond(place, own, orders, end)
                wide = end - place.t if found is None else found[0]
                width, at = max((width, at), (wide, place.t))
                R, root = (end - place.t, None) if found is None else found
                touches += root is None
                step = R if root is None else root
            else:
                root, step = None, R if s is None else ALMOST * s * R
                R = 2 * R if s is None else max(R / 4, 2 * step) if s < 0.5 else R / 2
            clear = others(how, step / place.tau) * place.tau
            how = self._advance_start(place, min(step, clear), orders, expand)
            if clear < step:
                break
            if root is not None:
                return IsolatedRoot(how, current_condition(system, place, how, hit, orders), R, touches, True, place.t)
        return IsolatedRoot(how, None, width, touches, False, at)

    def _sign_beyond(self, place: PieceStart, own: SwitchCondition, orders: int, end: float) -> tuple[float, float | None] | None:
        """How far on the sign is known again, and where on the way it changes, None where it does not.

        None: not up to the end.
        """
        R = EPS * abs(place.t) or EPS * place.tau
        while R < end - place.t:
            c, e = self._condition_on_disc(place, own, orders, R)
            if abs(v := float(c.sum())) > e:
                return R, None if v > 0 else R * _crossing_point(c.tolist(), e)
            R *= WIDER
        return None

    def _advance_start(
        self, place: PieceStart, time: float, orders: int, expand: Callable[[int], MultiplierSolver]
    ) -> MultiplierSolver:
        s = time / place.tau
        place.x = poly_values([row[: orders + 1] for row in self._system.x], s)
        place.pass_time(time)
        return expand(orders)

    def _condition_on_disc(self, place: PieceStart, own: SwitchCondition, orders: int, R: float) -> tuple[np.ndarray, float]:
        """The coefficients on the disc |s| <= R, R a time, of the condition, in s/R, and e."""
        system, R, degree = self._system, R / place.tau, max(orders, DEGREE)
        if has_own_row(system, own):
            f = form_of_polynomial(own.row[: own.orders + 1], R, own.orders)
        else:
            x, l = ([form_of_polynomial(row[: orders + 1], R, degree) for row in rows] for rows in (system.x, system.push))
            f = condition_argument(system, own, self._on(form_of_polynomial([place.t, place.tau], R, degree), x, l))
        if not isinstance(f, TaylorForm):
            f = form_of_polynomial([float(f)], R, orders)
        c = own.sign * f.c
        c[0] += own.shift
        return c, f.r + condition_uncertainty(system, own) + EPS * float(np.abs(c).sum())


def current_condition(
    system: ModeSystem, place: PieceStart, how: MultiplierSolver, hit: SwitchCondition, orders: int
) -> SwitchCondition | None:
    """The condition that watches the same end as ``hit``, as it stands now."""
    return next((c for c in mode_conditions(system, place.codes, how, orders) if is_same_condition(c, hit)), None)


def _crossing_point(c: list[float], e: float) -> float:
    """Where in [0, 1] a condition known to e, c(1) < -e, is 0.

    A root of order 3, 5, ... of one that is known to e alone is told best by the derivative that has a simple root there.
    """
    for order in range(min(len(c) - 2, MAX_MULTIPLICITY) // 2 * 2, 0, -2):
        d = [math.perm(k, order) * a for k, a in enumerate(c)][order:]
        if d[0] * sum_in_order(d) < 0:
            root = first_root(d if d[0] > 0 else [-a for a in d])
            if max(map(abs, taylor_shift(c, root)[:order])) <= e:
                return root
    return min(first_root(c), 1.0) if c[0] > 0 else 0.0


def _distance_to_level(c: list[float], level: float) -> float:
    """How far c goes until it is above a level, in doubling steps; NEAR where that is further."""
    s = EPS
    while s < NEAR and poly_value(c, s) <= level:
        s *= 2
    return min(s, NEAR)


def _positive_until(c: np.ndarray, e: float) -> float | None:
    """The first s in [0, 1] with sum c_k s^k = e; None where it is more on all of it."""
    row = c.tolist()
    row[0] -= e
    if not row[0] > 0:
        return 0.0
    s = first_root(row)
    return s if s <= 1 else None


# POLISHING: each leaves about the fifth power of the distance (AROUND + 1), so that two do from NEAR.
POLISHING = 6  # Expansions at an event, at most, each nearer to it than the last. (+)
ON_EVENT = 1e-3  # Of a tie: a condition that is no more is on the event; another expansion would find rounding. (+)
STEPS_PER_EXPANSION = 3  # Of Newton's method, before the state is expanded anew: they leave the eighth power of the distance. (+)
TAIL = 2  # Last coefficients of an expansion, which tell what it cuts off: one of two may be 0, as in even and odd functions. (~)
LOST = 1e-2  # Of the largest coefficient: where a truncation errs by more, half of the way to its root is gone first. (~)
# DIP: LARGEST_ORDER + 2 roundings, of EPS/2, come to 16 EPS of that sum; four times as much is taken.
DIP = 64 * EPS  # Of the sum of its terms: what rounding may hide of a polynomial in the Bernstein basis. (~)
# MIN_PART: its sixth power is 0 in doubles.
MIN_PART = 2.0**-200  # Of a piece: a shorter part is not looked at for rounding that hides a root.
T_ROUNDING = 8  # In roundings of the time: an event that is as near is now; less looks for times that are no doubles. (+)
STEEP = 0.5  # Of the slope at a simple root: what it may change by where the sign is not known: below 1 it keeps its sign.


class Margins(NamedTuple):
    """What rows of h and what branches look at may differ from their polynomials by, on a piece."""

    y: list[float]
    switches: list[float]


NO_MARGINS = Margins([], [])
NO_NOISE: Mapping[str, np.ndarray] = MappingProxyType({})


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
        noise: Mapping[str, np.ndarray] = NO_NOISE,
    ) -> tuple[SwitchCondition | None, float]:
        """The condition that ends first, and when; (None, s) where none ends before s.

        A condition that is 0 at the start is divided by the power of s that it begins with, the one that its germ was judged
        by; where that sign is wrong all the same, it ends at once. What is rounding all along is none. One that comes to less
        than its margin and goes back ends there too: expanded anew there, it has a smaller one. A root where the last
        coefficients are not small beside the others is one of what was cut off, where nothing bounds that: half of the way to
        it is gone. ``but``: a condition whose switch is left out. ``noise``: what rounding leaves of l and y (m,) where they
        are polynomials through nodes; a condition that begins within it ends where it is below.
        """
        system, hit, powers, whole = self._system, None, _argument_powers(s, orders), s
        known_germs = _KnownGerms(system, orders)
        for condition in mode_conditions(system, place.codes, how, orders):
            if but is not None and condition.of == but.of:
                continue
            row, known = condition.row, condition.orders + 1
            margin = self._condition_margin(condition, margins)
            if margin and s < whole:
                margin *= (s / whole) ** known
            terms = sum_in_order(map(abs, map(mul, row[1:known], powers[1:])))
            if condition.sign * row[0] + condition.shift - margin > terms:
                continue
            germ = condition.coefficients()
            c = list(map(mul, germ, powers))
            if condition.acts in noise:
                c = _beyond_noise(c, float(noise[condition.acts][condition.of[1]]))
            else:
                c = _beyond_rounding(system, condition, germ, c, known_germs, opened=condition.of in place.open)
            if not c:
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
            c, known, instant = (
                own.coefficients(),
                TIE * condition_scale(system, own),
                T_ROUNDING * EPS * abs(place.t) / place.tau,
            )
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
            if (moved and abs(c[0]) <= ON_EVENT * known) or abs(d) * place.tau <= EPS * abs(place.t):
                break
            for _ in range(STEPS_PER_EXPANSION):
                e = poly_slope(c, d)
                d -= poly_value(c, d) / e if e and abs(poly_value(c, d) / e) < NEAR else 0.0
            place.x = [poly_value(row[: orders + 1], d) for row in system.x]
            place.pass_time(d * place.tau)
            how = expand(orders)
        own, width = current_condition(system, place, how, hit, orders), 0.0
        if own is not None and not is_simple_root(own.coefficients(), rtol * condition_scale(system, own)):
            width = self._isolation.width(place, own, rtol)
        return IsolatedRoot(how, own, width, 0, True, place.t)


class _KnownGerms:
    """What the series of a place are known to, and the share of the unit of time in which their germs are read."""

    def __init__(self, system: ModeSystem, orders: int) -> None:
        self._system, self._orders = system, orders

    @cached_property
    def rounding(self) -> GermRounding:
        """Of `germ_rounding`."""
        return germ_rounding(self._system, self._orders)

    @cached_property
    def share(self) -> float:
        """Of `germ_time_share`."""
        return germ_time_share(self._system, self.rounding)


def _beyond_noise(c: list[float], within: float) -> list[float]:
    """A condition of polynomials through nodes: [] where it stays within its noise, that much higher where it begins there."""
    if _stays_within(c, within):
        return []
    return [c[0] + within, *c[1:]] if abs(c[0]) <= within else c


def _beyond_rounding(
    system: ModeSystem, condition: SwitchCondition, germ: list[float], c: list[float], known: _KnownGerms, *, opened: bool
) -> list[float]:
    """A condition of series, c[k] = germ[k] s^k: [] where it is rounding all along, divided by the power that it begins with."""
    scale = least = TIE * condition_scale(system, condition)
    if _stays_within(c, least):
        least = condition_uncertainty(system, condition)
        if _stays_within(c, least):
            return []
    known_so: Sequence[float] = ()
    if c[0] <= (GERM / TIE) * scale:
        known_so = known_to(condition, known.rounding)
        if known_so and (_stays_within(c, known_so[0]) or not any(without_rounding(germ, known_so))):
            return []
    if c[0] > (least if opened else 0.0):
        return c
    first = leading_order(germ, least if opened else 0.0, known.share, known_so)
    if opened and first != 1:
        least = condition_uncertainty(system, condition)
        first = lowest_order(germ, least, known_so) if least else leading_order(germ, least, known.share, known_so)
        if least and first is not None and germ[first] < 0:  # What ends at once would be chosen again, as it was.
            first = leading_order(germ, least, known.share, known_so)
    c = c[ORDERS + 1 if first is None else first :]
    return [] if max(map(abs, c)) <= least else c


def _stays_within(c: list[float], least: float) -> bool:
    """Whether a polynomial is no larger than that on [0, 1]: by its coefficients, or by values, where rounding has made these."""
    if max(map(abs, c)) <= least:
        return True
    return abs(c[0]) <= least and all(abs(poly_value(c, k / LOOKED)) <= least for k in range(1, LOOKED + 1))


def _resolvable_part(c: list[float]) -> float:
    """The part of [0, 1] on which rounding does not hide c_0 > 0 behind the other terms: all of it, but for octaves."""
    part, terms = 1.0, list(map(abs, c[1:]))
    while part > MIN_PART and c[0] > 0:
        if DIP * sum_in_order(a * part**k for k, a in enumerate(terms, 1)) < c[0] / 4:
            return part
        part /= 4
    return 1.0


def _first_reliable_root(c: list[float], margin: float) -> float:
    """The first root in (0, 1] of c, known to rounding and a margin, of its last order, at 1; NONE where it is above these.

    Where it comes so near to 0 long before its root, or has none, that.
    """
    if not c[0] > 0:
        return first_root(c)
    rounding = DIP * sum_in_order(map(abs, c))
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
    return c[1] < 0 and sum_in_order(k * abs(a) * width ** (k - 1) for k, a in enumerate(c[2:], 2)) <= STEEP * -c[1]


def _argument_powers(s: float, orders: int) -> list[float]:
    return list(accumulate([s] * orders, mul, initial=1.0))
