"""Event-driven integration: one smooth piece after another, each ended by the first root of its sign conditions.

Taylor series of the orders that rtol asks for (p = -ln(rtol)/2 + 3, see `lengths`), the step from the last two coefficients
of x, y and l, events by Bernstein's test, polished on the expansion at the event itself, modes by their germs.

What a run under error control is asked for, checked: tolerances and the times of rows; how large a model may be.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from nsmodel._utils import EPS
from nsmodel.errors import StepError, UnrecoverableStepError, UsageError
from nsmodel.event_driven.bernstein import ORDERS, poly_value, poly_values, without_rounding
from nsmodel.event_driven.event_location import NEAR, EventLocator, IsolatedRoot
from nsmodel.event_driven.friction_modes import STOPS
from nsmodel.event_driven.modes import (
    MAX_NUDGES,
    ROW,
    UNDECIDED_FIELDS,
    PieceStart,
    Switch,
    SwitchCondition,
    all_switches,
    condition_scale,
    extrapolate_start,
    germ_rounding,
    is_germ_zero,
    is_same_condition,
    jump_impulse,
    known_to,
    list_switch_names,
    mode_conditions,
    nudge_start,
    select_mode,
    set_initial_codes,
    set_switch,
    uniqueness_verdict,
    update_scales,
)
from nsmodel.event_driven.multipliers import TIE, MultiplierSolver, RowScales
from nsmodel.event_driven.piece import Piece, StartEvent, ZenoDetector, may_leave_0, straight_line, trial_lengths
from nsmodel.event_driven.piece_bounds import MAX_STILL_PIECES, SchwarzBound, piece_end
from nsmodel.event_driven.problem import ContinuousProblem, SwitchTimes, reaches_time
from nsmodel.event_driven.radau import StiffIntegrator
from nsmodel.event_driven.state_updates import (
    AROUND,
    check_what_blocks_set,
    coast_to_stop,
    project_to_held_rows,
    reinitialise,
    reset_branch_choices,
    stick_released_blocks,
    update_blocks,
)
from nsmodel.event_driven.step_size import (
    LOCAL,
    ROUGHEST,
    ModelEquations,
    initial_time_unit,
    power_of_two_unit,
    step_size,
    taylor_order,
)
from nsmodel.event_driven.system import ModeSystem
from nsmodel.modeling.time_grid import format_value, is_number
from nsmodel.proof.verdict import not_none

MIN_RTOL = 1e-14  # 45 EPS: below it there is rounding alone.
JUMPS, UPDATES = 2, 8  # At one time: jumps of the state, and changes of what blocks hold; more of them may have no end.
NO_SWITCH_TIMES = SwitchTimes()
ROOM = 1.3  # By which the next piece may be longer than the last without another unit of time; more makes coefficients grow.
UNITS, OCTAVES = 60, 6  # Units of time that are tried where a series overflows, and how much shorter each is: 2^-360 in all.
LONGER, STUMP = 8, 1e-6  # The unit after an event, in pieces (a long one costs series); of the one before: too short to tell.
HARDLY, STILL = 2.0**-50, 16  # Of the time, 4 EPS: a piece that hardly moves it; so many, and a state may have come to rest.
AFTER = 2.0**-10  # Units of time after which a law without room is looked for: soon, and beyond rounding of the time.
MAX_UNDECIDED_MOTION = 10.0  # In rtol: by how much an event whose time is not known may move a state: as a run may err by.
STARTS, TOO_SHORT = 8, 0.05  # First units of time that are tried, each about 1/20 of the last; a shorter piece asks for one.


class Integrator:
    """A problem as it is integrated: ``advance()`` returns the next piece.

    ``known``: times, each of which ends a piece, and the mode is decided anew for the data after it; ``residuals``: whether
    x' - f - g of stiff pieces is itself to be within rtol, as a proof of the pieces asks.
    ``unique``: how often the mode was shown to be the only one, by verdict; ``touches``: conditions that came to 0 and went back;
    ``redundant``: pieces whose l is one of several; ``undecided``: events and dips that are not known to rtol, see
    `names.undecided`.
    """

    def __init__(
        self, problem: ContinuousProblem, rtol: float, atol: list[float] | None = None, known: SwitchTimes = NO_SWITCH_TIMES,
        *, residuals: bool = False,
    ) -> None:  # fmt: skip
        """See `Integrator`."""
        self.problem, self.rtol, self.known = problem, LOCAL * min(rtol, ROUGHEST), known
        self.order = taylor_order(rtol)
        self.system = ModeSystem(problem, self.order, self.rtol)
        self.atol = [0.0] * self.system.n if atol is None else atol
        system, x0 = self.system, [float(v) for v in np.array(ca.DM(problem.x0)).ravel()]
        self.place, self.sizes = PieceStart(0.0, x0, 1.0, [0] * system.m), system.sizes
        self.bound = SchwarzBound(system, ModelEquations(problem))
        self.roots = EventLocator(system, self.bound.on)
        self.stiff = StiffIntegrator(
            system, self.bound.on, self.roots, self.order, min(rtol, ROUGHEST), self.atol, residuals=residuals
        )
        self.accumulation = ZenoDetector()
        self._acted: list[Any] = [None] * len(system.updates)  # The sides of comparisons as blocks acted last.
        self._still = 0  # Pieces, one after the other, that hardly moved time.
        self.piece_scales: RowScales | None = None  # Along the last piece, before what ends it.
        self._pending_event: StartEvent | None = None  # The event that the next piece begins with.
        self._selected_solver: MultiplierSolver | None = None  # Of the mode just chosen, whose first orders stand.
        self.stopped: str | None = None  # Why no piece follows.
        self._final: UnrecoverableStepError | None = None  # Where steps cannot go on from here either.
        self.unique: Counter[str] = Counter()
        self.touches = self.redundant = 0
        self.undecided = [0.0] * len(UNDECIDED_FIELDS)
        with np.errstate(all="ignore"):
            try:
                self._choose_initial_mode()
            except StepError as error:
                self.stopped = str(error)

    @property
    def t(self) -> float:
        """Where the next piece starts."""
        return self.place.t

    def advance(self) -> Piece:
        """Integrate to the next event, or as far as one expansion goes.

        Raises:
            StepError: no mode is valid, or pieces become too short.
        """
        if self.stopped is not None:
            raise self.final_error or StepError(self.stopped)
        self.piece_scales = None
        if self._still >= STILL and self._try_rest_at_zero():
            self._still = 0
        if self._still >= MAX_STILL_PIECES:
            raise self.bound.singularity_error(self.place)
        try:
            how = self._compute_series()
        except StepError:
            if self._try_rest_at_zero():
                return self.advance()
            if (piece := self._straight_piece()) is None:
                raise
            return piece
        system, place = self.system, self.place
        s, unit = self._series_length(how), place.tau
        if s > 1:  # What is rounding at s = 1 is not at s^p.
            how, s = self._rescale_to_longer_unit(how, s)
        longest, known = s * place.tau, self.known.next(place.t, place.x)
        found = self.stiff.piece(place, how, s, place.time_to(known))
        if found is None:
            s = min(s, place.time_to(known) / place.tau)
            hit, s, error, proved = piece_end(self.bound, self.roots, place, how, self.order, s, self.rtol, self.atol)
            tau, last, until = place.tau, poly_values(system.x, s), min(place.t + place.tau * proved, known)
        else:
            place.tau = power_of_two_unit(ROOM * s * place.tau)  # That of series, and of germs, stays what a series takes.
            tau, s, error, last, hit = found
            until = min(place.t + tau * s + longest, known)
        series, n, m = np.array([*system.x, *system.l, *system.y]), system.n, system.n + system.m
        piece = Piece(place.t, tau, s, series[:n], series[n:m], series[m:], tuple(place.codes), error, last, self._pending_event)
        self._pending_event = self._pending_event if s == 0 else None
        self.redundant += how.null is not None and how.null.shape[1] > 0
        update_scales(system, s, min(longest, tau * s))
        self.piece_scales = system.row_scales()
        self._still = self._still + 1 if 0 < tau * s <= HARDLY * abs(place.t) else 0
        place.x, place.open, place.crossed = last, set(), set()
        place.pass_time(tau * s)
        if hit is None and not reaches_time(place.t, known):
            self._correct_drift(how)
            place.tau = place.tau if found else power_of_two_unit(ROOM * (tau * s))
            return piece
        # In a unit that is longer than a mode's own time coefficients grow.
        place.tau = unit if s == 0 else power_of_two_unit(longest if s <= STUMP else min(longest, LONGER * (tau * s)))
        self.stiff.restart()
        try:
            if hit is None:
                self._pass_switch_time(known)
            elif self.accumulation.pieces_vanish(tau * s, place.t, place.tau):
                raise self._accumulation_error(hit, parts_late=s == 0 and is_germ_zero(system, place, how, hit))
            else:
                self._handle_event(hit, known, until, collocated=found is not None)
        except StepError as why:
            self.stopped, self._final = str(why), why if isinstance(why, UnrecoverableStepError) else None
        off = STOPS * LOCAL if hit is not None and hit.ends_at_stop else 0.0
        return piece.moved(place.t, place.x, max(error, off))

    def _compute_series(self) -> MultiplierSolver:
        """All orders at the place; where they have no number, on the side of switches that rounding has passed."""
        place, tau = self.place, self.place.tau
        try:
            return self._compute_orders()
        except StepError:
            place.tau = tau
            if not self._correct_passed_switches():
                raise
        return self._compute_orders()

    def _compute_orders(self) -> MultiplierSolver:
        """All orders at the place, of which the mode's choice has left some."""
        how, self._selected_solver = self._selected_solver, None
        if how is not None and self.system.extend(how, self.place.codes, ORDERS, self.order):
            if all(math.isfinite(row[self.order]) for row in self.system.x):
                return how
        return self._expand(self.order)

    def _rescale_to_longer_unit(self, how: MultiplierSolver, s: float) -> tuple[MultiplierSolver, float]:
        """The series of a piece of length s > 1 in the unit in which it is at most 1: scaled, or anew where blocks slip."""
        system, place, times = self.system, self.place, power_of_two_unit(s * self.place.tau) / self.place.tau
        place.tau *= times
        if system.blocks.all:
            how = self._expand(self.order)
            return how, min(self._series_length(how), 1.0)
        system.scale(times)
        return how, min(s / times, 1.0)

    def _series_length(self, how: MultiplierSolver) -> float:
        return step_size(self.system, self.place.codes, how, self.order, self.rtol, self.atol)

    def take_up(self, t: float, x: list[float], l: list[float], codes: list[int], tau: float) -> None:
        """Go on from a state that other means have come to; StepError where no mode does."""
        system = self.system
        self.place = PieceStart(t, list(x), power_of_two_unit(tau), list(codes), all_switches(system))
        self.accumulation, self._pending_event = ZenoDetector(), self._event_without_jump
        self.stopped = self._selected_solver = None
        self.stiff.restart()
        for row, guess in zip(system.l, l, strict=True):
            row[0] = guess
        reset_branch_choices(system)
        if (how := select_mode(system, self.place)) is None:
            raise self._no_mode_error("here")
        if project_to_held_rows(system, self.place, how.active):
            self._expand(ORDERS)
        self._check_uniqueness()

    def _choose_initial_mode(self) -> None:
        system, place = self.system, self.place
        self.sizes.x[:] = [abs(x) for x in place.x]
        for row, middle in zip(system.l, system.middle, strict=True):
            row[0] = middle
        place.tau = initial_time_unit(system, place.t, place.x, place.tau)
        place.tau = self.bound.unit(place.t, place.x, [row[0] for row in system.parts["f"].outputs], place.tau)
        for _ in range(STARTS):
            place.open = all_switches(system)
            set_initial_codes(system, place)
            found = select_mode(system, place)
            how = system.expand(place.t, place.x, place.codes, place.tau, self.order)
            s = self._series_length(how) if how is not None else 1.0
            if found is not None and s >= TOO_SHORT:
                update_scales(system, 0.0, 0.0)
                self._acted = [None] * len(system.updates)
                if self._let_blocks_act():
                    self._select_next_mode("at the start")
                    self._pending_event = None
                    return
                self._check_uniqueness()
                return
            if found is None and (p := jump_impulse(system, place)) is not None:
                self._apply_impulse(p)
                continue
            place.tau = power_of_two_unit(min(s, TOO_SHORT) * place.tau)
        if self._has_series():
            raise self._no_mode_error("at the start")

    def _try_rest_at_zero(self) -> bool:
        """Whether states next to 0 were put to 0, where they rest: their rate is 0 there, and leads back from both sides.

        So x' = -sgn(x) sqrt|x| comes to 0 in finite time, where it has no series.
        """
        place, f = self.place, self.bound.equations
        l = [row[0] for row in self.system.push]

        def rates(x: list[float]) -> list[float]:
            return f(place.t, x, l)[0]

        at = [0.0 if abs(x) <= EPS * size else x for x, size in zip(place.x, self.sizes.x, strict=True)]
        still = rates(at)
        at = [a if rate == 0 else x for a, rate, x in zip(at, still, place.x, strict=True)]
        moved = [i for i, (a, x) in enumerate(zip(at, place.x, strict=True)) if a != x]
        for i in moved:
            off = [rates([*at[:i], side * abs(place.x[i]), *at[i + 1 :]])[i] * side for side in (-1, 1)]
            if any(rate > 0 for rate in off) or not any(rate < 0 for rate in off):
                return False
        rests = moved and not any(map(rates(at).__getitem__, moved))
        pending = self._pending_event
        if not (rests and self._try_restart_from(place.t, at, place.tau)):
            return False
        self._pending_event = pending or self._pending_event
        return True

    def _straight_piece(self) -> Piece | None:
        """A straight line past a point without a series, as short as one with a series follows; None where none does."""
        system, place, pending, known = self.system, self.place, self._pending_event, self.known.next(self.place.t, self.place.x)
        if self._has_series():
            return None
        l = [row[0] for row in system.push]
        for h, octaves in trial_lengths(place.t):
            found = straight_line(self.bound.equations, place.t, place.x, l, self.sizes.x, h, octaves, self.rtol, self.atol)
            if found is None or h > known - place.t:
                continue
            v = found.v if place.t or not system.m else 0 * found.v  # At the start l is not known yet.
            last = (np.array(place.x) + h * v).tolist()
            before = self.checkpoint()
            if not self._try_restart_from(place.t + h, last, h):
                place = self.place
                continue
            off = h * np.array([row[1] / self.place.tau - rate for row, rate in zip(system.x, v, strict=True)])
            if not (np.abs(off) <= found.allowed).all():  # l is another than on the line.
                self.restore(before)
                place = self.place
                continue
            series = np.zeros((system.n + 2 * system.m, self.order + 1))
            series[:, 0] = [*place.x, *(row[0] for row in system.l), *(row[0] for row in system.y)]
            series[: system.n, 1] = h * v
            n, m = system.n, system.n + system.m
            codes = tuple(self.place.codes if not place.t else place.codes)
            return Piece(place.t, h, 1.0, series[:n], series[n:m], series[m:], codes, 1.0, last, pending)
        return None

    def _try_restart_from(self, t: float, x: list[float], tau: float) -> bool:
        """Whether a mode with a series goes on from there, which is an event where it is another; where none does all stays."""
        place, before = self.place, self.checkpoint()
        try:
            self.take_up(t, x, [row[0] for row in self.system.l], place.codes, tau)
            self._compute_series()
        except StepError:
            self.restore(before)
            return False
        self._pending_event = self._event_without_jump if place.t and self.place.codes != place.codes else None
        return True

    def _has_series(self) -> bool:
        place = self.place
        how = self.system.expand(place.t, place.x, place.codes, place.tau, self.order)
        return how is None or all(math.isfinite(v) for row in self.system.x for v in row[: self.order + 1])

    def _apply_impulse(self, p: np.ndarray) -> None:
        """x+ = x + g_l p, at one time."""
        system, place = self.system, self.place
        place.x = [float(x + d) for x, d in zip(place.x, not_none(system.B) @ p, strict=True)]
        self.sizes.x[:] = [max(size, abs(x)) for size, x in zip(self.sizes.x, place.x, strict=True)]
        before = self._pending_event or self._event_without_jump
        self._pending_event = before._replace(impulse=tuple(float(a + b) for a, b in zip(before.impulse, p, strict=True)))

    def _expand(self, orders: int) -> MultiplierSolver:
        """The coefficients at the place, in a unit of time in which they are of one size."""
        system, place = self.system, self.place
        for _ in range(UNITS):
            how = system.expand(place.t, place.x, place.codes, place.tau, orders)
            if how is None:
                raise self._no_mode_error("any more")
            if all(map(math.isfinite, [row[orders] for row in system.x])):
                return how
            place.tau = math.ldexp(place.tau, -OCTAVES)
        raise (
            self.final_error
            or self.bound.pole_error(place)
            or StepError(f"t = {place.t:.10g}: f, g or h has no number, or no Taylor series, here")
        )

    def _correct_passed_switches(self) -> bool:
        """Turn the switches that rounding has left on the wrong side, where their side has no number; whether there are any."""
        system, place, switched = self.system, self.place, False
        system.expand(place.t, place.x, place.codes, place.tau, 0)
        for part, i in system.branches:
            branch, choice = system.jets[part].branches[i], system.parts[part].choice[i]
            if branch.kind == "side" and choice * system.parts[part].rows[branch.row][0] < 0:
                place.open.add((part, i))
                set_switch(system, place, (part, i), -choice)
                switched = True
        if switched:
            self._select_next_mode("after a switch")
        return switched

    # -- events

    @property
    def _event_without_jump(self) -> StartEvent:
        return StartEvent((0.0,) * self.system.m)

    def _expand_at_event(self) -> MultiplierSolver:
        """The expansion at an event; where the mode before has no number there, as near before it as time is known."""
        place, tau, t, x = self.place, self.place.tau, self.place.t, self.place.x
        for k in range(MAX_NUDGES):
            try:
                how = self._expand(AROUND)
            except StepError:
                place.tau = tau
                nudge_start(self.system, place, -(2.0**k))
                continue
            if place.t == t:
                return how
            extrapolate_start(self.system, place, t, x)
            break
        return self._expand(AROUND)

    def _locate_event(self, hit: SwitchCondition, until: float, collocated: bool) -> tuple[IsolatedRoot, float, float]:
        """Go to the event to round-off, or over what is none; how far a block that stops has to coast; the unit of time."""
        system, place = self.system, self.place
        how, tau = self._expand_at_event(), place.tau
        if project_to_held_rows(system, place, how.active):  # Afterwards it would move the root that is polished.
            how, tau = self._expand(AROUND), place.tau
        if collocated and self._is_hidden(hit):
            return IsolatedRoot(how, None, 0.0, 0, True, place.t), 0.0, tau
        if not hit.ends_at_stop:
            return self.roots.polish_event(place, hit, AROUND, how, self._expand, self.order, until, self.rtol / LOCAL), 0.0, tau
        self._expand(1)  # No matter of digits; in a longer unit of time coefficients are beyond measure.
        place.tau = power_of_two_unit(min(left := system.blocks.of[hit.of[1]].left, 1.0) * tau)
        return IsolatedRoot(self._expand(AROUND), None, 0.0, 0, True, place.t), left, tau

    def _handle_event(self, hit: SwitchCondition, known: float, until: float, *, collocated: bool) -> None:
        """Go to the event to round-off, but not beyond a known time, and choose the mode after it; or over what is none.

        ``until``: the time up to which the piece that has ended goes on; ``collocated``: whether its polynomials are no series.
        """
        system, place = self.system, self.place
        before = place.t, place.late, list(place.x), place.tau
        try:
            found, left, tau = self._locate_event(hit, until, collocated)
        except StepError:
            place.t, place.late, place.x, place.tau = before
            if not self._correct_passed_switches():
                raise
            return
        how, self.touches = found.how, self.touches + found.touches
        rates = [row[1] / place.tau for row in system.x]
        if reaches_time(place.t, known):
            to_known = place.time_to(known) / place.tau
            place.x = [poly_value(row[: AROUND + 1], to_known) for row in system.x]
            self._pass_switch_time(known)
        if not found.crosses or reaches_time(place.t, known):
            self._pending_event = None if not found.crosses and place.t > before[0] else self._pending_event
            self._record_undecided(hit, found, [])
            return
        if (free := self._is_free_of_multipliers(hit.of)) or (collocated and self._is_hidden(hit)):
            place.crossed.add(hit.of)
        switched: list[SwitchCondition] = []
        for condition in mode_conditions(system, place.codes, how, AROUND):
            c, ends = condition.coefficients(), is_same_condition(condition, hit)
            moves, least = max(map(abs, c[1:]), default=0.0), TIE * condition_scale(system, condition)
            if condition.of not in place.open and (ends or abs(c[0]) <= max(least, TIE * moves)):
                place.open.add(condition.of)
                switched += [condition] if ends or moves > least else []
        if hit.ends_at_stop:
            coast_to_stop(system, place, min(left * tau if left <= NEAR else 0.0, known - place.t))
            place.tau = tau
        opened = (row for kind, i in place.open if kind == ROW for row in system.blocks.rows_of(i))
        project_to_held_rows(system, place, tuple(sorted({*how.active, *opened})))
        stick_released_blocks(system, place)
        for condition in switched:  # On another branch y may be another.
            passed = free and condition.of in place.crossed and condition.of[0] == ROW
            set_switch(system, place, condition.of, -place.codes[hit.of[1]] if passed else condition.after)
        if reaches_time(place.t, known):
            self._pass_switch_time(known)
            return
        before_all, pending = ([place.x[i] for i in self.problem.updated], list(place.codes)), self._pending_event
        self._select_next_mode("after " + list_switch_names([hit.of], self.problem.rows))
        if hit.of[0] in self.problem.block_parts and before_all == ([place.x[i] for i in self.problem.updated], place.codes):
            self._pending_event = pending  # A comparison of a block that sets nothing new, and changes no mode, is no event.
        self._record_undecided(hit, found, rates)
        if self.accumulation.event_rate_grows(place.t):
            raise self._accumulation_error(hit)

    def _is_hidden(self, hit: SwitchCondition) -> bool:
        """Whether rounding hides l or y at the place, as where D is small: the polynomials of a piece know them better."""
        known = known_to(hit, germ_rounding(self.system))
        return bool(known) and not any(without_rounding(hit.coefficients(), known))

    def _is_free_of_multipliers(self, switch: Switch) -> bool:
        """Whether no l, nor another switch, acts on what a switch looks at, nor on the rate of a row, whose l has two ends."""
        kind, i = switch
        if kind != ROW:
            return kind not in self.problem.block_parts and self.system.plain[switch]
        B, D, C = self.system.slopes()
        if self.system.jets["h"].branches:
            return False
        return math.isfinite(self.system.lower[i] + self.system.upper[i]) and not (D[i].any() or (C[i] @ B).any())

    def _record_undecided(self, hit: SwitchCondition, found: IsolatedRoot, before: list[float]) -> None:
        """Keep what is not decided, where it matters at rtol: by the rates ``before``; of a dip by its length alone."""
        place, rtol = self.place, self.rtol / LOCAL
        rows = zip(before, self.system.x, self.sizes.x, strict=False)
        moved = [abs(row[1] / place.tau - rate) * found.width / size for rate, row, size in rows if size]
        if found.crosses:
            self._pending_event = self._pending_event and self._pending_event._replace(
                width=max(self._pending_event.width, found.width)
            )
            matters = max(moved, default=0.0) > MAX_UNDECIDED_MOTION * rtol
        else:
            matters = found.touches > 0 and found.width > MAX_UNDECIDED_MOTION * rtol * abs(place.t)
        if matters and not self.undecided[0]:
            system = self.system
            of = hit.of[1] if hit.of[0] == ROW else system.m + system.branches.index(hit.of)
            self.undecided = [1.0, found.at, found.width, float(of), float(found.crosses)]
        else:
            self.undecided[0] += matters

    def _pass_switch_time(self, known: float) -> None:
        """Stand at a known time, with the branches of the data after it, and choose the mode."""
        system, place = self.system, self.place
        before = place.x
        place.t, place.late = known, 0.0
        place.x = self.known.after(known, place.x)
        for k, reads in enumerate(self.problem.block_reads):  # What a block reads may jump where no comparison changes.
            if any(place.x[i] != before[i] for i in reads):
                self._acted[k] = None
        reinitialise(system, place)
        self._select_next_mode("at a known time")

    def _select_next_mode(self, when: str) -> None:
        """Choose the mode of the open switches, after a jump where x is outside its law; the next piece begins with an event."""
        system, place, acts = self.system, self.place, 0
        for _ in range(JUMPS + UPDATES * bool(self.problem.updated)):
            before = list(place.codes)
            if (how := select_mode(system, place)) is not None:
                if self._let_blocks_act():
                    place.crossed, acts = set(), acts + 1
                    continue
                self._check_uniqueness()
                self._selected_solver = how if system.linear_in_l and not system.blocks.all else None
                self._pending_event = self._pending_event or self._event_without_jump
                return
            place.codes[:] = before
            if (p := jump_impulse(system, place)) is None:
                break
            self._apply_impulse(p)
            place.open, place.crossed = all_switches(system), set()
        if acts >= UPDATES:
            names = ", ".join(self.problem.block_parts)
            raise StepError(f"t = {place.t:.10g}: values that {names} set change their own comparisons without end at this time")
        raise self._no_mode_error(when)

    def _let_blocks_act(self) -> bool:
        """Let the blocks act whose comparisons are others than when they acted last; whether what they hold is another.

        All read what was held before. What they set may change comparisons: these act once more, at the same time.
        """
        system, place = self.system, self.place
        sides = [list(part.choice) for part in system.updates]
        acting = [k for k, (now, before) in enumerate(zip(sides, self._acted, strict=True)) if now != before]
        self._acted = sides
        if acting and update_blocks(system, place, acting):
            return True
        check_what_blocks_set(system, place.t)
        return False

    def _accumulation_error(self, hit: SwitchCondition, *, parts_late: bool = False) -> StepError:
        name = list_switch_names([hit.of], self.problem.rows)
        reason = f"the switches of {name} accumulate; time steps go over them"
        if parts_late:
            orders = f"orders 0 to {ORDERS} of the series"
            reason = f"the mode of {name} cannot be decided: its modes part beyond {orders}; time steps go over that"
        return StepError(f"t = {self.place.t:.10g}: {reason}: method='auto' or 'time-stepping' (--method auto)")

    def _correct_drift(self, how: MultiplierSolver) -> None:
        """Move x back to y = 0 in rows that only y' holds, once their drift is seen: each piece leaves its share of rtol."""
        system, place = self.system, self.place
        if how.through is None:
            return
        _, y = self.bound.equations(place.t, place.x, [row[0] for row in system.l])
        off = [i for i in how.active if abs(y[i]) > self.rtol * self.sizes.y[i] and not system.feedthrough[i]]
        if any(abs(y[i]) > self.rtol * system.size_y(i) for i in off):
            self._expand(1)
            project_to_held_rows(system, place, how.active)

    def checkpoint(self) -> dict[str, Any]:
        """What the next pieces depend on, as lists and numbers."""
        place, system, sizes, pending = self.place, self.system, self.sizes, self._pending_event
        return {
            "t": place.t, "x": list(place.x), "late": place.late, "tau": place.tau,
            "codes": list(place.codes), "open": sorted(place.open),
            "choice": {name: list(part.choice) for name, part in system.parts.items()}, "l": [row[0] for row in system.l],
            "sizes": {name: list(size) for name, size in vars(sizes).items()},
            "begun": pending and [list(pending.impulse), pending.width],
            "accumulation": self.accumulation.checkpoint(), "unique": dict(self.unique), "touches": self.touches,
            "redundant": self.redundant, "stopped": self.stopped, "stiff": self.stiff.checkpoint(),
            "undecided": list(self.undecided), "still": self._still,
        }  # fmt: skip

    def restore(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        system, self._selected_solver = self.system, None
        opened = {(str(kind), int(i)) for kind, i in saved["open"]}
        self.place = PieceStart(saved["t"], list(saved["x"]), saved["tau"], [int(code) for code in saved["codes"]], opened)
        self.place.late = saved["late"]
        for part, choice in saved["choice"].items():
            system.parts[part].choice[:] = choice
        self._acted = [list(part.choice) for part in system.updates]
        for row, l in zip(system.l, saved["l"], strict=True):
            row[0] = l
        for of, sizes in saved["sizes"].items():
            getattr(self.sizes, of)[:] = sizes
        self._pending_event = None if saved["begun"] is None else StartEvent(tuple(saved["begun"][0]), saved["begun"][1])
        self.accumulation.restore(saved["accumulation"])
        self.unique, self.touches, self.redundant = Counter(saved["unique"]), saved["touches"], saved["redundant"]
        self.stopped, self.undecided, self._still = saved["stopped"], list(saved["undecided"]), saved["still"]
        self.stiff.restore(saved["stiff"])

    def _check_uniqueness(self) -> None:
        if name := self._state_leaving_zero():
            rests = f"{name} may stay 0, or leave it, where f grows faster than {name}"
            raise StepError(f"t = {self.place.t:.10g}: the solution may not be unique: {rests}")
        verdict, modes = uniqueness_verdict(self.system, self.place)
        self.unique[verdict] += 1
        if modes:
            raise StepError(
                f"t = {self.place.t:.10g}: the solution is not unique: {self._open_switches_text}modes {modes} are valid, and go "
                "apart"
            )

    def _state_leaving_zero(self) -> str | None:
        """A state on which no l acts, and which rests at 0 but may leave it."""
        place, system = self.place, self.system
        resting = [i for i, row in enumerate(system.x) if row[0] == row[1] == 0]
        if not resting:
            return None
        l, pushed = [row[0] for row in system.push], np.any(system.slopes()[0], axis=1) if system.m else np.zeros(system.n)
        leaves = (i for i in resting if not pushed[i] and may_leave_0(self.bound.equations, place.t, place.x, l, i))
        return next((system.problem.names[i] for i in leaves), None)

    @property
    def _open_switches_text(self) -> str:
        """The open switches, as "of these "; "" where there is none."""
        names = list_switch_names(self.place.open, self.problem.rows)
        return f"of {names} " if names else ""

    def _no_mode_error(self, when: str) -> StepError:
        place, system = self.place, self.system
        rate = self.bound.equations(place.t, place.x, system.middle)[0]
        why = system.why_no_mode(place.t, place.x, rate, self._open_switches_text, when)
        return self.final_error or StepError(f"t = {self.place.t:.10g}: {why}")

    @property
    def final_error(self) -> UnrecoverableStepError | None:
        """Why steps cannot go on from here either: a block, or a law that moves and holds no value; None where they may."""
        return self._final or self.problem.empty(self.place.t, self.place.x, self.place.tau * AFTER)


MAX_EVENT_DRIVEN_OPERATIONS = 10_000  # Of f, g and h, up to which "auto" is event-driven; of 20 400 a piece takes a minute.


def operation_count(p: ContinuousProblem) -> int:
    """The number of operations of f, g and h."""
    return sum(ca.n_nodes(part) for part in (p.f, p.g, p.h))


def checked_tolerances(problem: ContinuousProblem, rtol: Any, atol: Any) -> tuple[float, list[float]]:
    """Rtol, and atol of each state; UsageError for what is none."""
    return checked_rtol(rtol), np.resize(checked_atol(atol, problem.names[: problem.states]), len(problem.names)).tolist()


def checked_rtol(rtol: Any) -> float:
    """Rtol; UsageError for what is none."""
    if not (is_number(rtol) and MIN_RTOL <= rtol < 1):
        raise UsageError(
            f"rtol = {format_value(rtol)}; expected a number between {MIN_RTOL:g} and 1: doubles hold no more than 16 digits"
        )
    return float(rtol)


def checked_atol(atol: Any, names: Sequence[str]) -> np.ndarray:
    """Atol (1,) or of each state (n,); UsageError for what is none."""
    try:
        array = np.asarray(0.0 if atol is None else atol, float)
    except (TypeError, ValueError):
        array = np.full(1, np.nan)
    if array.ndim > 1 or array.size not in (1, len(names)) or not (np.isfinite(array) & (array >= 0)).all():
        raise UsageError(f"atol = {atol!r}; expected a number >= 0, or one for each of {', '.join(names)}")
    return array


def checked_row_times(given: Any, T: float) -> list[float]:
    """The times of the rows after the start; UsageError for what is no increasing list from 0 to T."""
    try:
        found = np.asarray(given, float)
    except (TypeError, ValueError):
        found = np.full(1, np.nan)
    if found.ndim != 1 or not found.size or not np.isfinite(found).all():
        raise UsageError("times: expected a list of finite numbers, the times of the rows")
    wrong = np.flatnonzero(np.diff(found) <= 0)
    if wrong.size:
        i = int(wrong[0])
        raise UsageError(f"times[{i + 1}] = {found[i + 1]:.10g} is not after times[{i}] = {found[i]:.10g}; give them in order")
    outside = np.flatnonzero((found < 0) | (found > T))
    if outside.size:
        i = int(outside[0])
        raise UsageError(f"times[{i}] = {found[i]:.10g} is outside the run, from 0 to t_end = {T:.10g}")
    return found[found > 0].tolist()
