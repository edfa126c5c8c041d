"""How far a series piece goes: as far as its polynomials are proved to solve the equations, by Schwarz' lemma on a disc.

With z = (t - t0)/tau, the polynomials x~, l~ of order p and F = (f + g)(t0 + tau z, x~, l~), the defect D = x~' - tau F has the
coefficients 0 up to order p - 1, but for rounding. Where every operation of F is analytic on |z| <= R, so is D, and D/z^p is
largest on the rim: |D(z)| <= (|z|/R)^p max_R |D| (Schwarz). One evaluation of the graph, with balls or with forms (see `discs`),
gives max_R |D|; as R stays, the bound falls like s^p, and the length that is proved is known at once. Rows of h and what switches
look at likewise. A pole, a branch point or an overflow on the disc is an infinite bound: R is halved; the piece ends before it.

What is proved is |D|, |y~ - h| and the arguments of switches on the whole piece, up to rounding of the coefficients. What is not:
the state itself, uniqueness, dips of a condition that are smaller than these bounds.

How far a piece goes: to its first event, and no further than is proved of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from nsmodel._utils import EPS
from nsmodel.errors import StepError, UnrecoverableStepError
from nsmodel.event_driven.bernstein import poly_slopes, poly_value, poly_values
from nsmodel.event_driven.disc_arithmetic import (
    DiscBall,
    EquationsOnDisc,
    ball_of_polynomial,
    error_ratio,
    form_of_polynomial,
    linear_combination,
    remainder_radius,
)
from nsmodel.event_driven.event_location import NO_MARGINS, EventLocator, Margins
from nsmodel.event_driven.modes import PieceStart, SwitchCondition
from nsmodel.event_driven.multipliers import MultiplierSolver
from nsmodel.event_driven.step_size import LOCAL, MULTIPLIERS, SMALL, ModelEquations, estimate_local_error, zero_start_scales
from nsmodel.event_driven.system import ModeSystem

# RADIUS_OF_BALL: a bound falls like radius^-p; near a singularity only close discs have one.
RADIUS_OF_BALL, WIDE_RADIUS, CLOSE_RADIUS = 6.0, 2.0, 1.25  # Of the disc, in lengths of the piece: of a ball, of two forms.
PROVED = 0.45  # Of the length that was asked for: with less a disc of half the size may prove more, and 0.5 at most.
NEARLY = 0.97  # Of the length that a bound lets be: what is left is for its rounding.
# SHRINKINGS: 2^-1160 in all, down to the least double.
SHRINKINGS, SLOWLY, QUICKLY = 200, 8, 64.0  # Of the disc: so many, the first ones by half, then by so much at a time.
CAPS, CAP_OCTAVES = 120, 4  # First units of time that are tried, each by so many octaves shorter: 2^-480 in all.
# POLE: less of both calls a steep motion a pole, more comes near one by MAX_STILL_PIECES before it is told.
POLE = 1e6  # How much more than its size a state would move at its rate in the time so far, near a pole, (+)
SUDDEN = 1e3  # and how much more than itself that rate would. (+)
AS_NOW = 2.0**-51  # Of the time, and of the length of a piece, 2 EPS: what a state does in it is rounding. (~)
MAX_STILL_PIECES = 2000  # Pieces, one after the other, that hardly move time: from rest some hundred are needed.
ENTRY_CANCELLED = 2.0**-50  # An entry of P = I - B N C below this, 4 EPS, is rounding of its terms.
# FAR: 1/t is 64 times smaller there, t^-1/2, which has an integral, 8 times.
FAR, GROWS = 64.0, 4.0  # Times in which time stands still, and how much smaller rates are so far from a pole.
AT_REST = 1e-290  # What a state that is exactly 0 may err by: a number whose square roots and shares are numbers.


TIERS = ((False, RADIUS_OF_BALL), (True, WIDE_RADIUS), (True, CLOSE_RADIUS))


class SchwarzBound:
    """The bound of the pieces of a system."""

    def __init__(self, system: ModeSystem, of: ModelEquations) -> None:
        self.system, self.equations = system, of
        self._rounding: list[float] | None = None  # Of tau (f + g), where the piece begins.
        self.margins = self._disc_margins = NO_MARGINS  # Of the piece that is proved; of the disc that was evaluated last.
        self.on = EquationsOnDisc(system)

    def proved(
        self, place: PieceStart, how: MultiplierSolver, p: int, s: float, rtol: float, atol: list[float]
    ) -> tuple[float, float]:
        """The length <= s that is proved, and the bound of the local error there in units of rtol, at most 1.

        Raises:
            StepError: no piece is proved, however short.
        """
        if s <= 0:
            return s, 0.0
        disc, best, bound, still = s, 0.0, 0.0, AS_NOW * abs(place.t) / place.tau
        self._rounding, self.margins = None, NO_MARGINS
        for k in range(SHRINKINGS):
            for of_forms, radius in TIERS:
                w = self.worst(place, how, p, radius * disc, disc, rtol, atol, of_forms=of_forms)
                length = disc if w <= 1 else disc * NEARLY * w ** (-1 / p) if w < math.inf else 0.0
                if length > best:
                    best, bound, self.margins = length, w * (length / disc) ** p, self._disc_margins
                if best >= PROVED * disc:
                    return min(best, s), min(bound, 1.0)
            if disc <= still:
                break
            disc = max(disc / 2 if k < SLOWLY or best > disc / QUICKLY else max(disc / QUICKLY, 2 * best), still)
        if best > 0:
            return min(best, s), min(bound, 1.0)
        if self.is_at_rest(place, rtol, atol):
            return min(still, s), 1.0
        raise self.singularity_error(place)

    def is_at_rest(self, place: PieceStart, rtol: float, atol: list[float]) -> bool:
        """Whether no state moves by more than rtol while time stands still, and no rate grows as near a pole.

        So far a singularity of f is stepped over: a branch point, a corner, or one that is removable.
        """
        still = AS_NOW * abs(place.t) / place.tau
        rows = list(zip(self.system.x, self.system.sizes.x, atol, strict=True))
        moves = any(not abs(row[1]) * still <= rtol * max(size, abs(row[0])) + a + AT_REST for row, size, a in rows)
        return still > 0 and not moves and not self._rate_grows_suddenly(place, FAR * still)

    def _rate_grows_suddenly(self, place: PieceStart, s: float) -> bool:
        """Whether a state moves by more than rounding, at a rate that is much larger than a little before and later."""
        system, l = self.system, [row[0] for row in self.system.push]

        def moved(s: float) -> list[float]:
            rates, _ = self.equations(place.t + place.tau * s, [row[0] + s * row[1] for row in system.x], l)
            return [abs(place.tau * rate * s) for rate in rates]

        here, before, after = ([abs(row[1]) * s for row in system.x], moved(-s), moved(s))
        least = [EPS * FAR * max(size, abs(row[0])) for row, size in zip(system.x, system.sizes.x, strict=True)]
        return any(a > least and a > GROWS * max(b, c) for a, b, c, least in zip(here, before, after, least, strict=True))

    def singularity_error(self, place: PieceStart) -> StepError:
        """Why no piece goes on from here."""
        where = "a division by 0, a root or a logarithm at 0, a corner, or an overflow"
        return self.pole_error(place) or StepError(f"t = {place.t:.10g}: f, g or h is not analytic here: {where}")

    def pole_error(self, place: PieceStart) -> UnrecoverableStepError | None:
        """That no solution goes on, where a state would move by many times its size in the time so far, and its rate, too."""
        system = self.system
        at_pole, _ = self.equations(place.t, [row[0] for row in system.x], [row[0] for row in system.push])
        for name, row, size, rate in zip(system.problem.names, system.x, system.sizes.x, at_pole, strict=True):
            sudden = abs(2 * row[2] * place.t) / place.tau > SUDDEN * abs(row[1]) or not math.isfinite(rate + row[1])
            if sudden and abs(rate * place.t) > POLE * max(size, abs(row[0])):
                grows = f"{name}' = {rate:.3g}, and grows without bound"
                return UnrecoverableStepError(f"t = {place.t:.10g}: {grows}: f has a pole, or another singularity, near here")
        return None

    def unit(self, t: float, x: list[float], rates: list[float], tau: float) -> float:
        """The unit of time, shorter where f has no bound on the disc that x, on its tangent, and t come to in it."""
        for k in range(CAPS):
            shorter = math.ldexp(tau, -CAP_OCTAVES * k)
            moving = [DiscBall(v, abs(rate) * shorter) for v, rate in zip(x, rates, strict=True)]
            if all(
                remainder_radius(one) < math.inf
                for one in self.on.f(DiscBall(t, shorter), moving, [DiscBall(row[0]) for row in self.system.push])
            ):
                return shorter
        return tau

    def worst(
        self, place: PieceStart, how: MultiplierSolver, p: int, R: float, s: float, rtol: float, atol: list[float], *,
        of_forms: bool
    ) -> float:  # fmt: skip
        """The largest bound on a piece of length s, in units of what it may be; inf where the disc holds a singularity."""
        system, tau, q = self.system, place.tau, s / R
        form = partial(form_of_polynomial, R=R, m=p - 1) if of_forms else partial(ball_of_polynomial, R=R)
        x, l = [form(row) for row in system.x], [form(row) for row in system.push]
        found = self.on(form([place.t, tau]), x, l)
        moved = [form([k * c for k, c in enumerate(row[: p + 1])][1:]) for row in system.x]
        end, moves = poly_values(system.x, s), poly_slopes(system.x, s)
        size = [max(a, abs(b), abs(c * s)) for a, b, c in zip(system.sizes.x, end, moves, strict=True)]
        D = [a - tau * b for a, b in zip(moved, found.rate, strict=True)]
        still = AS_NOW * max(abs(place.t) / tau, s)  # In which nothing moves: time is not known better.
        now = min(still / R, 1.0)
        most = [
            ((p + 1) * (rtol * a + b + AT_REST) + now**p * still * remainder_radius(d)) / s
            if remainder_radius(d) < math.inf
            else 0.0
            for a, b, d in zip(size, atol, D, strict=True)
        ]
        worst = _max_remainder_ratio(D, q**p, most)
        if not worst <= 1:
            most = [a + b for a, b in zip(most, self._rounding_noise(place), strict=True)]
            worst = _max_remainder_ratio(D, q**p, most)
        if not worst <= 1 and how.through:
            worst = self._bound_off_held_rows(place, how, D, moved, found.free, most, q, now, p, s, rtol)
        if not worst < math.inf:
            return worst
        of_rows, y = self._row_bounds(place, how, p, found.y, form, end, s, q, now, rtol)
        of_switches, switches = self._switch_bounds(found.looked, p, form, q, now, rtol)
        self._disc_margins = Margins(y, switches)
        return max(worst, of_rows, of_switches)

    def _rounding_noise(self, place: PieceStart) -> list[float]:
        """What rounding does to tau (f + g) where the piece begins: no piece is to be better."""
        found = self._rounding
        if found is None:
            self.equations(place.t, [row[0] for row in self.system.x], [row[0] for row in self.system.push])
            found = self._rounding = [place.tau * v for v in self.equations.rounding().tolist()]
        return found

    def _bound_off_held_rows(
        self, place: PieceStart, how: MultiplierSolver, D: list[Any], moved: list[Any], free: list[Any], most: list[float],
        q: float, now: float, p: int, s: float, rtol: float,
    ) -> float:  # fmt: skip
        """The same with what lies along g_l of held rows as an error of l: the rest of D is P D, P = I - B N C.

        Where g = B l, P B = 0: l is not in it.
        """
        system = self.system
        P, NC = system.cached_from_slopes(("apart", how.active), partial(_held_row_projection, how))
        projected = [a - place.tau * b for a, b in zip(moved, free, strict=True)]
        worst = _max_remainder_ratio([linear_combination(row, projected) for row in P], q**p, most)
        for i, row in zip(how.active, NC, strict=True):
            size = max(system.size_l(i), abs(system.l[i][0]), abs(poly_value(system.l[i], s)))
            worst = max(worst, _row_error_ratio(remainder_radius(linear_combination(row, D)) / place.tau, p, q, now, rtol * size))
        return worst

    def _row_bounds(
        self, place: PieceStart, how: MultiplierSolver, p: int, h: list[Any], form: Any, end: list[float], s: float, q: float,
        now: float, rtol: float,
    ) -> tuple[float, list[float]]:  # fmt: skip
        """Rows of h: y~ - h, of held ones h itself; the worst, and the bounds."""
        system, worst, bounds = self.system, 0.0, []
        if not system.m:
            return worst, bounds
        of_l = poly_values(system.push, s)
        largest = max(system.sizes.y)
        known = (p if how.index == 1 else p - 1) + 1 if how.feeds else p
        for i, one in enumerate(h):
            off = one if place.codes[i] == 0 else form(system.y[i]) - one
            size = max(system.sizes.y[i], system.terms(i, end, of_l), SMALL * largest)
            worst = max(worst, _row_error_ratio(remainder_radius(off), known, q, now, rtol * size))
            bounds.append(remainder_radius(off) * q**known)
        return worst, bounds

    def _switch_bounds(
        self, looked: list[Any], p: int, form: Any, q: float, now: float, rtol: float
    ) -> tuple[float, list[float]]:  # fmt: skip
        """What switches look at, beside its polynomial: the worst, and the bounds."""
        worst, bounds = 0.0, []
        for size, one, row in zip(self.system.sizes.switches, looked, self.on.watched(), strict=True):
            off = one - form(row[:p])
            worst = max(worst, _row_error_ratio(remainder_radius(off), p, q, now, rtol * max(size, abs(row[0]))))
            bounds.append(remainder_radius(off) * q**p)
        return worst, bounds


def _held_row_projection(how: MultiplierSolver, B: np.ndarray, _: np.ndarray, C: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """P = I - B N C and N C of held rows."""
    rows = list(how.active)
    NC = np.array(how.through) @ C[rows]
    P = np.eye(len(B)) - B[:, rows] @ NC
    P[np.abs(P) <= ENTRY_CANCELLED] = 0.0
    return P, NC


def _max_remainder_ratio(of: Sequence[Any], share_at_end: float, most: Sequence[float]) -> float:
    """The largest of what is no coefficient, so much of it, beside what it may be."""
    return max(
        (error_ratio(remainder_radius(one) * share_at_end, least) for one, least in zip(of, most, strict=True)), default=0.0
    )


def _row_error_ratio(bound: float, order: int, q: float, now: float, goal: float) -> float:
    """How much of MULTIPLIERS times ``goal``, or of what it does while time stands still, a row that begins at an order is."""
    if not bound < math.inf:
        return math.inf
    return error_ratio(bound * q**order, MULTIPLIERS * goal + AT_REST + bound * now**order)


# SHORTENINGS: by half or more, 2^-30 in all.
SHORTENINGS, CAUTION = 30, 0.9  # Of a piece, and the share of the length that its error allows.


class PieceEnd(NamedTuple):
    """What ends a piece, where; the bound of its local error in units of rtol, at most 1; up to where that holds."""

    hit: SwitchCondition | None
    s: float
    error: float
    proved: float


def piece_end(
    bound: SchwarzBound,
    roots: EventLocator,
    place: PieceStart,
    how: MultiplierSolver,
    p: int,
    s: float,
    rtol: float,
    atol: list[float],
) -> PieceEnd:
    """The end of a piece of order p and length s at most.

    The bound is of the polynomials as they should be; what rounding, or a fault, has made of them the residual at a point says.

    Raises:
        StepError: its error is above 1, however short it is.
    """
    system, of, goals = bound.system, bound.equations, (rtol / LOCAL, [a / LOCAL for a in atol])
    s, proved = bound.proved(place, how, p, s, *goals)
    whole = s
    error, start_scales, now = math.inf, [0.0] * system.n, AS_NOW * abs(place.t) / place.tau
    for shortened in range(SHORTENINGS):
        hit, end = roots.first(place, how, p, s, bound.margins)
        error = LOCAL * estimate_local_error(system, place, of, end, p, rtol, atol, start_scales)
        if not shortened and not error <= 1:
            start_scales = zero_start_scales(system, place, of, end)
            error = LOCAL * estimate_local_error(system, place, of, end, p, rtol, atol, start_scales)
        # In a time in which nothing moves there is nothing to be missed: time is not known better.
        if error <= 1 or (end <= now and (error < math.inf or bound.is_at_rest(place, *goals))):
            return PieceEnd(hit, end, max(min(error, 1.0), proved * (end / whole) ** p if whole else 0.0), s)
        s = max(end * min(0.5, CAUTION * error ** (-1 / p)), now)
        if place.t + place.tau * s == place.t:
            break
    raise bound.pole_error(place) or StepError(
        f"t = {place.t:.10g}: x' = f + g, y = 0 is off by {error:.3g} times rtol, however short the piece is"
    )
