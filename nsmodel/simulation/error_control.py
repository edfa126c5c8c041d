"""Steps of a scheme chosen by local error control: each step is taken once with h and again as two steps of h/2.

    e = max_i |d_i| / (atol_i + rtol s_i),    d = (x_fine - x_coarse) / (2^p - 1),    s_i = the largest |x_i| so far

is the error of x_fine in units of what is allowed; an oscillator's velocities count among the x_i. p is the order that the
scheme has in this step (``OneStepProblem.order``), 1 but for theta = 1/2: e falls like h^(p+1) in smooth phases and like h
across a switch; x_fine + d is of order p + 1 in smooth phases. A step is accepted

- with the state x_fine + d where e <= 1, the index sets are equal and every constraint is >= 0 there (a sweeping process is
  projected once more, as its scheme does), and every y that an impulse alone would bring back keeps its sign, or stays in the
  cone whose l is 0. On the surface of a cone it leaves by the curvature, of size |d|^2, which the next step takes back. What the
  scheme carries of the multipliers (gamma < 1) stays that of the step: on a row that is held it may alternate about its mean,
  which d would magnify;
- else as it is where e <= h/T, so that the errors of all steps add up to the tolerance; or where e <= SWITCH_ERROR_SHARE and the
  index set changes: that error falls like h, whatever the order.

The rows of the run are the half steps. Each is verified; its multipliers and outputs are those of its step, and
``correction`` tells how far extrapolation has then moved the state, in units of what is allowed.

Steps are L/2^j, at most T/2^COARSEST_LEVEL, and start at multiples of themselves, L the length of the span between two known
times (``switch_times``, points of inputs, the start, the end T): times are exact, the last step ends there, and the first half of
a refused step is the next trial. At L/2^FINEST_LEVEL every verified step is accepted, and counted: at an accumulation of switches
a run goes on; where walls call for impulses at L/2^IMPACT, as a velocity behind one is known to eps |y|/h alone: shorter steps
would give a point at rest a speed that rtol sees, and follow its hops. Where a state must jump at a cone it does not go on
(`impacts.refusal`): y is certified beside |y|, which is not small on the surface of a cone, and what y may be off is any velocity
over such a step.

What is extrapolated is the state; multipliers stay those of a verified step. States that a cone pushes are measured relative to
a part of the speed (`solvers.step_doubling`), and steps get no looser there. `c/adaptive.c` is the same loop, order of operations
included; of the packed row both know where the state, the multipliers and the index set are.

What whole and half steps do not see: a path that turns back inside a step whose index set stays; both agree, and err alike.

A row that is held, and does not depend on a held l directly, has in l_i the mean of a half step (with a theta, its value
there), where nothing is carried (gamma = 1). On the line through both l_i leaves K before the step ends by a part o of
their difference d: it should have let go. What has bent the path by b, |x_fine - 2 x_half + x| in units of what is
allowed, has moved it o^2 b/2 too far, and so has l_i, too large by o d/2 in the mean for the part o of a half step.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import EPS
from nsmodel.errors import StepError, UnrecoverableStepError, UsageError
from nsmodel.event_driven.fallback_steps import IMPACT, REACHED, STEP_BUDGET, error_relaxation
from nsmodel.event_driven.integrator import checked_atol
from nsmodel.modeling.base import Model
from nsmodel.modeling.blocks import model_ticks
from nsmodel.modeling.expressions import derivatives
from nsmodel.modeling.signals.schedule import InputSchedule
from nsmodel.modeling.time_grid import TimeGrid, check_times, format_value, input_schedule, is_number, make_grid
from nsmodel.modeling.variants import with_initial_inputs
from nsmodel.simulation.fixed_grid import SchemePropagator
from nsmodel.simulation.options import METHODS, Options
from nsmodel.simulation.propagator import PERCENT_PROGRESS, find_runaway_state, plan_with_inputs, plan_with_known_times
from nsmodel.simulation.step_inputs import SpanInputs
from nsmodel.solvers import impacts
from nsmodel.solvers.one_step_problem import OneStepProblem, state_before_short_step, state_constraints
from nsmodel.solvers.residuals import numeric_law
from nsmodel.solvers.rounding_errors import SUM_ERROR
from nsmodel.solvers.step import UNKNOWN_INDEX, RowRecord, StepResult, WarmStart, verified_step
from nsmodel.solvers.step_doubling import (
    STEP_DOUBLING_LIMIT,
    BothWays,
    ErrorNorm,
    controlled_step,
    error_scale_groups,
    extrapolation_error,
)

# COARSEST_LEVEL: no step is longer than 1/16 of a run; the least, as of stretches, is 4096 roundings of it.
COARSEST_LEVEL, FINEST_LEVEL = 4, 40  # Steps are L/2^j with j between these.
FIRST_LEVEL = 7  # j of the first step where none is given: its error tells the next one. (+)
# SWITCH_ERROR_SHARE: less has to halve steps at each switch, more adds up: four switches come to the tolerance.
SWITCH_ERROR_SHARE = 0.25  # Part of the allowed error that a step across a switch may use.
CONTROL_CONSTANTS = {"largest": COARSEST_LEVEL, "crossing": SWITCH_ERROR_SHARE, "grow": STEP_DOUBLING_LIMIT}  # Of C.
OPEN_CONE_CODE = -1  # The index of a cone whose l is 0: y is inside.
UNSOLVED_HALVINGS = 4  # How often a step without an answer is halved at once: to find that out takes every solver. (+)
MAX_ACCEPTED_STEPS = 10_000_000  # Accepted steps after which a run stops, after hours of them: its tolerance is out of reach.
MISSED_TOLERANCE_FACTOR = 10  # Times what rtol allows: where errors add up to more than runs are held to, a warning says so. (+)
LOOSENING_INTERVAL = 500  # Accepted steps after which what is allowed may grow: at once for all that C takes in a call. (+)
INITIAL_ROW_CAPACITY = 4096  # Rows for which there is memory at first; it is doubled where it is full.


class StepState(NamedTuple):
    """Where a step starts: the time in units of L/2^(least + 1), the step L/2^j, the state for it; and what came before.

    ``watched``: the x_i; ``rate``: their change per time in the last half step; ``index_set``: that of the half step; ``d`` and
    j of the last step, nan where it was not extrapolated.
    """

    t: int
    j: int
    state: np.ndarray
    warm: WarmStart
    watched: np.ndarray
    rate: np.ndarray
    index_set: np.ndarray | None
    d: np.ndarray
    least: int
    of_j: int = 0

    @property
    def half(self) -> int:
        """Half a step in units of time."""
        return 2 ** (self.least - self.j)


class StepDoublingTrial(NamedTuple):
    """One step taken ``both`` ways; ``error`` of x_fine in units of what is allowed; ``smooth``: one index set from before it to
    its end; ``order`` of the scheme in this step.
    """

    both: BothWays
    d: np.ndarray
    error: float
    smooth: bool
    order: int


class ErrorControlledPropagator(SchemePropagator):
    """The walk under error control; see `walk.Propagator`. The rows of all half steps stay in memory."""

    N: int = 2 * MAX_ACCEPTED_STEPS

    def __init__(self, model: Model, options: Options) -> None:
        check_times(step=options.step, t_end=options.t_end)
        given: Any = model.t_end if options.t_end is None else options.t_end
        self.T = T = float(given)
        drive = input_schedule(model, T) if model.inputs else None
        self._spans = _known_time_spans(model, T, drive)
        self._start, self._length = self._spans.pop()
        h = (model.step if options.step is None else options.step) or T / 2**FIRST_LEVEL
        make_grid(model, min(h, T), None, options.t_end)  # refuses a step far too small for the run
        self.rtol, atol = _checked_rtol_atol(model, options.rtol, options.atol)
        self._limited = options.method == METHODS[0]
        check_no_fixed_steps(model, "rtol")
        contacts = impacts.impact_rows(with_initial_inputs(model))
        self._finest = IMPACT if any(watch.impulsive for watch in contacts) else FINEST_LEVEL
        j = self._level_of_step(h)
        first = TimeGrid(1, h := self._step_size(j), h)
        of_any_step = TimeGrid(1, h, h, np.array([h]), np.array([0.0, h]), any_step=True)
        constant = replace(options, compiled=options.compiled is True)
        super().__init__(model, constant, first, of_any_step, lambda: None)
        self._driven = None if drive is None else SpanInputs(drive, self.stepper.layout.inputs, self.starter, model_ticks(model))
        if drive is not None and drive.moving:
            self.state = self._state_at_span_start(self.state, self.warm)
            j = self._level_of_step(h)
        self.record, self.times = self.start(first, INITIAL_ROW_CAPACITY), [0.0]
        self.totals |= {
            "accepted": 0, "rejected": 0, "extrapolated": 0, "at_least_step": 0, "least_step": None, "rtol": self.rtol,
            "estimate": 0.0,
        }  # fmt: skip
        n, slices = len(self.model.names), self.stepper.layout.slices
        velocity = slices[self.problem.velocity] if self.problem.velocity else slice(0, 0)
        self._watched = np.r_[0:n, velocity]
        symbols = [np.array(at) + shift for shift in range(0, self._watched.size, n) for at in self.model.stems.values()]
        self._cones = [watch for watch in contacts if watch.cone]
        scales = error_scale_groups(symbols, self._cones, options.tolerance, self.rtol)
        self._norm = ErrorNorm(self.rtol, np.resize(atol, self._watched.size), scales)
        begin = self.record.rows[0, self._watched]
        unknown = np.full(begin.size, np.nan)
        self._size = np.abs(begin)
        self.place = StepState(0, j, self.state, self.warm, begin, unknown, None, unknown, self._finest)
        self._c, self._corrections = _constraint_function(model), [0.0]
        self._law = numeric_law(self.problem.law)
        self._walls = self._wall_rows()
        self.warnings += self._relay_warnings()
        self.plan = plan_with_inputs(plan_with_known_times(self.plan, model, ends=True), drive)

    @property
    def _span_units(self) -> int:
        """A span in its units of time."""
        return 2 ** (self._finest + 1)

    def _step_size(self, j: int) -> float:
        return math.ldexp(self._length, -j)

    def _level_of_step(self, h: float) -> int:
        """The j of the longest step that is not longer than h."""
        return min(max(math.ceil(math.log2(self._length / h)), self._coarsest_level), self._finest)

    @property
    def _coarsest_level(self) -> int:
        """The j of the longest step of a span: of the whole run L/2^COARSEST_LEVEL, of a short span all of it."""
        return max(0, COARSEST_LEVEL + math.ceil(math.log2(self._length / self.T)))

    def _begin_next_span(self) -> None:
        """Begin the next span, where the place is at the end of one: with about the same step."""
        place = self.place
        if place.t < self._span_units or not self._spans:
            return
        h = self._step_size(place.j)
        self._start, self._length = self._spans.pop()
        state = self._state_at_span_start(place.state, place.warm)
        j = self._level_of_step(h)
        self.place = place._replace(t=0, j=j, state=state_before_short_step(self.model, state, self._step_size(j) / h))

    def _state_at_span_start(self, state: np.ndarray, warm: WarmStart) -> np.ndarray:
        """The state with the inputs at the begin of a span, which ends at the first edge that blocks place in it."""
        if self._driven is None:
            return state
        state, ends = self._driven.begin_span(state, self._start, self._length, warm.l)
        self._spans += [(start, end - start) for start, end in itertools.pairwise(ends[1:])][::-1]
        self._length = ends[1] - self._start
        return state

    @property
    def bar(self) -> dict[str, Any]:
        """Progress in per cent of the time."""
        return PERCENT_PROGRESS

    @property
    def progress(self) -> float:
        """Per cent of the time."""
        return 100 * self._time(self.place.t) / self.T

    @property
    def finished(self) -> bool:
        """Whether the end of the time is reached."""
        return self.place.t == self._span_units and not self._spans

    @property
    def time(self) -> float:
        """Where the next step starts."""
        return self.times[self.k]

    @property
    def h(self) -> float:
        """The step that is tried."""
        return self._step_size(self.place.j)

    @property
    def runaway(self) -> tuple[str, float] | None:
        """Name and value of the largest state, where it is beyond what can be computed with."""
        return find_runaway_state(self.model.names, self.place.state[: len(self.model.names)])

    def advance(self, steps: int, stop: Sequence[float]) -> None:
        """Take steps, each at whatever length it is accepted; in C as many as there is time for."""
        for _ in range(steps):
            if self.finished or stop:
                return
            if not self._is_control_loop_in_c or self._advance_in_c():
                self._take_step()
            self._begin_next_span()

    @property
    def _is_control_loop_in_c(self) -> bool:
        """Whether the loop under error control is in C: it knows inputs that are constant within a span."""
        return self.rollout is not None and self.rollout.adaptive and (self._driven is None or self._driven.flat)

    def _take_step(self) -> None:
        """Take one step, at whatever length it is accepted."""
        self.place = controlled_step(self.place, self._try_step, self._accept_trial, self._shorten_step)

    def _shorten_step(self, at: StepState, trial: StepDoublingTrial | None) -> tuple[StepState, StepResult | None]:
        """The place with half the step, which is known then; with a much shorter one where there was no answer."""
        self.totals["rejected"] += 1
        halvings = 1 if trial is not None else min(UNSOLVED_HALVINGS, self._finest - at.j)
        self.place = at._replace(j=at.j + halvings, state=state_before_short_step(self.model, at.state, 0.5**halvings))
        return self.place, None if trial is None else trial.both.half

    def _advance_in_c(self) -> bool:
        """Take steps in C and record them, as many as there is time and room for; whether then one was not certified."""
        record, totals, place = self.record, self.totals, self.place
        if len(record.t) - record.filled < 2:
            record.grow()
        room = len(record.t) - record.filled
        if self._limited:
            room = min(room, 2 * (LOOSENING_INTERVAL - totals["accepted"] % LOOSENING_INTERVAL))
        free, m = slice(record.filled, record.filled + room), place.warm.index.size
        control = self._control_data(place)
        columns = np.empty((3, room))
        done = self.rollout.advance_adaptively(
            control, self.k, self._known_least_eigenvalue(), record.rows[free], record.index[free], columns
        )
        times, lengths, moved = columns[:, : done.steps]
        if done.steps:
            record.extend(np.arange(self.k + 1, self.k + 1 + done.steps), times, lengths, lengths)
            self.times.extend(times.tolist())
            self._corrections.extend(moved.tolist())
            self.last_index = record.index[record.filled - 1].copy()
            worst_t = self.times[done.worst_step] if done.worst > totals["worst_residual"] else None
            self._size, self.counts = control["size"].copy(), self.counts + Counter(done.solvers)
            newton = (done.newton, done.newton_max) if self.counts_iterations else (0.0, 0.0)
            self._update_state(
                self.k + done.steps, self.state, self.warm, self.last_index, done.worst, worst_t, *newton, done.changes
            )
            if self.counts_iterations:
                self.stepper.include_eigenvalue(done.least_eigenvalue)
        for name in ("accepted", "rejected", "extrapolated", "at_least_step"):
            totals[name] += int(control[name])
        totals["estimate"] = float(control["estimate"])
        totals["least_step"] = float(control["least_step"]) if np.isfinite(control["least_step"]) else None
        warm = WarmStart(control["l"][:m].copy(), control["index"][:m].astype(np.int8))
        known = None if control["fresh"] else warm.index.astype(float)
        state, watched, rate, d = (control[name].copy() for name in ("x", "watched", "rate", "d"))
        self.place = StepState(
            int(control["t"]), int(control["j"]), state, warm, watched, rate, known, d, self._finest, int(control["of_j"])
        )
        self._check_step_count()
        return done.stuck

    def _control_data(self, place: StepState) -> np.ndarray:
        """What the loop in C goes on from."""
        m, totals = place.warm.index.size, self.totals
        control = self.rollout.control(place.state.size, m, self._watched.size)
        given = {
            "T": self.T, "start": self._start, "length": self._length, "rtol": self.rtol, **CONTROL_CONSTANTS,
            "largest": self._coarsest_level, "least": self._finest,
            "order": self.problem.order.most, "t": place.t, "j": place.j,
            "fresh": place.index_set is None, "x": place.state, "least_step": totals["least_step"] or np.inf,
            "atol": self._norm.atol,
            "size": self._size, "watched": place.watched, "rate": place.rate, "d": place.d, "of_j": place.of_j,
            "looser": self._tolerance_factor, "estimate": totals["estimate"], "no_jump": bool(self._cones),
        }  # fmt: skip
        for name, value in given.items():
            control[name] = value
        control["l"][:m], control["index"][:m] = place.warm.l, place.warm.index
        control["lowering"][list(self.problem.order.lowered_by)] = 1
        control["wall"][:m] = self._walls
        for number, group in enumerate(self._norm.scales):
            control["group"][group.at], control["part"][group.at], control["unit"][group.at] = number, group.part, group.unit
        return control

    def _try_step(self, at: StepState, coarse: StepResult | None) -> StepDoublingTrial | None:
        """The step from here both ways, None where a step has no answer; ``coarse``: where it is known already."""
        h, t, middle, states = self._step_size(at.j), self._time(at.t), self._time(at.t + at.half), self.stepper.layout.state
        first = whole = at.state
        second: Callable[[np.ndarray], np.ndarray] = lambda state: state  # noqa: E731
        if self._driven is not None:
            first, whole, second = self._driven.halves(at.state, [t, middle, self._time(at.t + 2 * at.half)])
        try:
            first = state_before_short_step(self.model, first, 0.5)
            starts = whole, first, lambda half: second(half.row[states])
            both = BothWays.take(self._step, (t, middle), h, starts, at.warm, coarse)
        except StepError as error:
            if at.j == self._finest or isinstance(error, UnrecoverableStepError):
                raise
            return None
        sets = [self._step_index_set(result) for result in both]
        before = sets[0] if at.index_set is None else at.index_set
        smooth = all(np.array_equal(one, before) for one in sets)
        order = self._step_order(at, both.fine) if smooth else 1
        d = both.difference(self._watched, order)
        off = np.abs(d) if smooth else np.fmax(np.abs(d), both.bend(self._watched, at.watched, h / 2 * at.rate))
        return StepDoublingTrial(both, d, self._norm(off, both.fine.row[self._watched], self._size), smooth, order)

    def _step_order(self, at: StepState, fine: StepResult) -> int:
        """The order of a step on one index set; 1 for the first one where it uses a multiplier of the start."""
        if at.index_set is None and self.problem.start is not None:
            return 1
        most, lowered_by = self.problem.order
        return most if fine.warm.index[list(lowered_by)].all() else 1

    def _step(self, t: float, h: float, state: np.ndarray, warm: WarmStart) -> StepResult:
        found = None if self.rollout is None else self.rollout.step(t, h, state, warm, self.stepper.layout)
        return verified_step(self.stepper, t, h, state, warm, self.k) if found is None else found

    def _time(self, t: int) -> float:
        return self._start + math.ldexp(t, -self._finest - 1) * self._length

    def _step_index_set(self, result: StepResult) -> np.ndarray:
        """The index set of a step; for catching-up also the sides of the selection, which no row of its law tells."""
        selection = self.stepper.layout.slices.get("selection", slice(0, 0))
        return np.concatenate([result.warm.index, np.sign(result.row[selection])])

    def _accept_trial(self, at: StepState, trial: StepDoublingTrial) -> StepState | None:
        """Record the step, and where the next one starts; None where its error is too large."""
        error, both, least, h, more = trial.error, trial.both, at.j == self._finest, self._step_size(at.j), self._tolerance_factor
        state = self._extrapolate(at, trial) if error <= more and trial.smooth else None
        allowed = more * (1.0 if state is not None else h / self.T if trial.smooth else SWITCH_ERROR_SHARE)
        if error > allowed:
            if not least:
                return None
            self._check_no_jump(at, trial)
        row, correction, estimate = both.fine.row, 0.0, 0.0 if least else error
        if state is not None:
            row, correction = self._row_with_state(at, trial, *state), error
            if not least:
                off = extrapolation_error(trial.d, at.d, 2.0 ** (at.of_j - at.j), trial.order)
                estimate = self._norm(off, both.fine.row[self._watched], self._size)
        j, t, watched = at.j, at.t + 2 * at.half, row[self._watched]
        self._record_step(at, both, row, correction, estimate)
        growth, of_double = 2.0 ** (trial.order + trial.smooth), 2.0 if trial.smooth and state is None else 1.0
        if j > self._coarsest_level and error * growth <= STEP_DOUBLING_LIMIT * allowed * of_double and t % (4 * at.half) == 0:
            j -= 1
        after = state_before_short_step(self.model, row[self.stepper.layout.state], self._step_size(j) / (h / 2))
        d = trial.d if state is not None and at.index_set is not None else np.full(watched.size, np.nan)
        index_set, rate = self._step_index_set(both.fine), both.rate(self._watched, h)
        return StepState(t, j, after, both.fine.warm, watched, rate, index_set, d, self._finest, at.j)

    def _record_step(self, at: StepState, both: BothWays, row: np.ndarray, correction: float, estimate: float) -> None:
        """Add its two rows; the second was moved by ``correction``, and errs by ``estimate``, in units of what is allowed."""
        totals, h = self.totals, self._step_size(at.j) / 2
        self._add_row(self._time(at.t) + h, h, both.half.row, both.half, 0.0)
        self._add_row(self._time(at.t + 2 * at.half), h, row, both.fine, correction)
        self._size = np.maximum(self._size, np.abs(row[self._watched]))
        totals["accepted"] += 1
        totals["extrapolated"] += int(correction > 0)
        totals["at_least_step"] += int(at.j == self._finest)
        totals["estimate"] += estimate
        totals["least_step"] = min(totals["least_step"] or np.inf, h)
        self._check_step_count()

    def _check_no_jump(self, at: StepState, trial: StepDoublingTrial) -> None:
        """Refuse what the least step moves by more than is allowed where a cone pushes that calls for impulses."""
        layout = self.stepper.layout
        l = layout.slices.get("multipliers", layout.slices["l"])
        for watch in self._cones:
            if not all(watch.free(result.row[l][watch.column]) for result in trial.both):
                raise StepError(impacts.cone_impact_message(watch, self._time(at.t)))

    def _extrapolate(self, at: StepState, trial: StepDoublingTrial) -> tuple[np.ndarray, np.ndarray | None] | None:
        """The combination, and its gaps; None where a velocity changes its sign, y is past a wall or a constraint is broken."""
        states = self.stepper.layout.state
        fine, coarse = trial.both.fine.row[states], state_before_short_step(self.model, trial.both.coarse.row[states], 0.5)
        state, end = fine + (fine - coarse) / (2**trial.order - 1), at.t + 2 * at.half
        if self.problem.start is not None:
            state[self._watched.size :] = fine[self._watched.size :]
        inputs = self.stepper.layout.inputs
        state[inputs] = fine[inputs]
        if self.problem.velocity:
            n = len(self.model.names)
            if (np.sign(state[n : 2 * n]) != np.sign(fine[n : 2 * n])).any():
                return None
        if self._c is None:
            y, before = (result.row[self.stepper.layout.y] for result in (trial.both.fine, trial.both.coarse))
            past = self._is_beyond_wall(trial.both.fine.warm.index, y + (y - before) / (2**trial.order - 1))
            return None if past else (state, None)
        if not self.problem.gap:
            return (state, None) if self._is_feasible(self._time(end), state) else None
        start = state if self._driven is None else self._driven.state_at_end(state)
        try:
            closing = self._step(self._time(end - 1), self._step_size(self._finest + 1), start, trial.both.fine.warm).row
        except StepError:
            return None
        return closing[states], closing[self.stepper.layout.slices[self.problem.gap]]

    def _is_feasible(self, t: float, state: np.ndarray) -> bool:
        """Whether every constraint is >= 0, to the rounding of evaluating it."""
        x, u = state[: len(self.model.names)], state[self.stepper.layout.inputs][self.problem.inputs :]
        c, J = (np.array(part) for part in self._c(t, x, u))
        return bool((c.ravel() >= -SUM_ERROR * EPS * (np.abs(J) @ np.abs(x))).all())

    def _row_with_state(self, at: StepState, trial: StepDoublingTrial, state: np.ndarray, gaps: np.ndarray | None) -> np.ndarray:
        """The second row with another state, and what follows from the state alone: gaps, velocities."""
        layout, n, row = self.stepper.layout, len(self.model.names), trial.both.fine.row.copy()
        row[layout.state] = state
        if gaps is not None:
            row[layout.slices[self.problem.gap]] = gaps
        if self.problem.velocity:
            unit = self._step_size(at.j) / 2 if self.problem.difference else 1.0
            row[layout.slices[self.problem.velocity]] = state[n : 2 * n] / unit
        return row

    @property
    def _tolerance_factor(self) -> float:
        """How many times what is allowed a step may err by."""
        reached = max(1.0, REACHED / self.rtol) if self._finest == IMPACT and self.rtol else 1.0
        grows = self._limited and not self._cones
        return (
            reached * error_relaxation(self.totals["accepted"] // LOOSENING_INTERVAL * LOOSENING_INTERVAL) if grows else reached
        )

    def _check_step_count(self) -> None:
        most = STEP_BUDGET if self._limited else MAX_ACCEPTED_STEPS
        if self.totals["accepted"] > most:
            other = " or take method='time-stepping', which allows more" if self._limited else ""
            raise StepError(f"{most:,} steps were accepted which are not enough: ask for less accuracy (rtol){other}")

    def _add_row(self, t: float, h: float, row: np.ndarray, result: StepResult, correction: float) -> None:
        """Add the row of a half step."""
        if self.record.full:
            self.record.grow()
        layout, index, k = self.stepper.layout, result.warm.index, self.k + 1
        self.times.append(t)
        self.record.add(k, t, h, h, row, index)
        self._corrections.append(correction)
        self.counts[result.solver] += 1
        worst, newton = float(row[layout.residual]), float(row[layout.newton]) if self.counts_iterations else 0.0
        worst_t = t if worst > self.totals["worst_residual"] else None
        changed = self.last_index is not None and not np.array_equal(index, self.last_index)
        self._update_state(k, self.state, self.warm, index, worst, worst_t, newton, newton, changed)

    def _is_beyond_wall(self, index: np.ndarray, y: np.ndarray) -> bool:
        """Whether y is beyond 0 in a row that is let go, or outside a cone whose l is 0: an impulse alone would bring it back."""
        beyond = index * y * self._walls > 0
        for rows, K in self._law.curved:
            beyond[rows] = self._walls[rows].any() and index[rows.start] == OPEN_CONE_CODE and K.code(-y[rows]) != OPEN_CONE_CODE
        return bool(beyond.any())

    def _wall_rows(self) -> np.ndarray:
        """Which rows (m,) of y are those of the end of a step, of a cone or let go at one end of l alone, with no l in them."""
        implicit = (self.model.weights or (1.0, 1.0))[0] == 1.0
        walls = np.isfinite(self._law.lower) != np.isfinite(self._law.upper)
        for rows, K in self._law.curved:
            walls[rows] = K.is_cone
        walls[list(self.problem.jacobians[3].sparsity().row())] = False
        return walls & implicit

    def _relay_warnings(self) -> list[str]:
        """A warning where theta = 1/2 meets a multiplier with two ends."""
        jumps = np.isfinite(self._law.lower) & np.isfinite(self._law.upper) & (self._law.lower < self._law.upper)
        jumps[[i for rows, K in self._law.curved if K.is_bounded for i in range(rows.start, rows.stop)]] = True
        if (self.model.weights or (1.0, 1.0))[0] != 0.5 or not jumps.any():
            return []
        return [
            f"theta = 1/2 with the relay '{self.problem.rows[jumps.argmax()]}': rtol does not see all of its switches (stick may "
            "end half a step late); compare with theta = 1"
        ]

    def columns(self) -> dict[str, np.ndarray]:
        """The rows as the arrays of a trajectory, and how far extrapolation has moved them."""
        return super().columns() | {"correction": np.array(self._corrections)}

    def metadata(self) -> dict[str, Any]:
        """As of every scheme, with what its steps err by, and what whole and half steps do not see."""
        found = turning_point_warnings(self.problem, self.model, self.record, self._watched, self._norm.allowed)
        estimate = self.totals["estimate"]
        if self._limited and estimate > MISSED_TOLERANCE_FACTOR:
            found.append(f"the errors of the steps are estimated to add up to {estimate:.2g} times what rtol allows")
        self.warnings += [text for text in found if text not in self.warnings]
        return super().metadata()


def _constraint_function(model: Model) -> Any:
    """(t, x, u) -> c, c_x; None where the state is kept within nothing."""
    state, c = model.state, state_constraints(model)
    if not c.numel():
        return None
    return ca.Function("c", [model.t, state, model.u], [ca.densify(c), ca.densify(ca.jacobian(c, state))])


def _known_time_spans(model: Model, T: float, drive: InputSchedule | None) -> list[tuple[float, float]]:
    """Start and length of each span between known times, the first one last."""
    driven = () if drive is None else drive.points.tolist()
    ends = sorted({0.0, *(time for time in (*model.switch_times, *driven) if 0 < time < T), T})
    return [(start, end - start) for start, end in itertools.pairwise(ends)][::-1]


def _checked_rtol_atol(model: Model, rtol: Any, atol: Any) -> tuple[float, np.ndarray]:
    rtol = 0.0 if rtol is None else rtol
    if not (is_number(rtol) and (1e-12 <= rtol < 1 or (rtol == 0 and atol is not None))):
        raise UsageError(f"rtol = {format_value(rtol)}; expected a number between 1e-12 and 1")
    return float(rtol), checked_atol(atol, model.names or ())


def check_no_fixed_steps(model: Any, option: str) -> None:
    """Refuse what is bound to steps that are known beforehand, where an option takes others."""
    if model.tied_to_step:
        raise UsageError(f"x1 is a position one constant step after x0; with {option} give the velocity v0 instead")
    tolerances = getattr(model, "tolerances", None)
    if tolerances is not None and not callable(tolerances) and np.size(tolerances) > 1:
        raise UsageError(f"tolerances is a value a step; with {option} give a function of the step, such as lambda mu: mu**3")


def turning_point_warnings(
    problem: OneStepProblem, model: Model, record: RowRecord, watched: np.ndarray, allowed: Callable[[np.ndarray], np.ndarray]
) -> list[str]:
    """A warning where the state of such a step is off by more than is allowed; ``allowed``: of each x_i, by its largest size."""
    layout, filled, law = record.layout, record.filled, numeric_law(problem.law)
    if problem.start is not None or not law.size or filled < 3:
        return []
    rows, index = record.rows[:filled], record.index[:filled, : law.size]
    start, half, fine = slice(0, -2, 2), slice(1, -1, 2), slice(2, None, 2)
    held = (index[half] == 0) & (index[fine] == 0) & np.isin(index[start], (0, UNKNOWN_INDEX))
    free = held.copy()
    for i, j in zip(*problem.jacobians[3].sparsity().get_triplet(), strict=True):
        free[:, i] &= ~held[:, j]
    step = rows[fine, layout.l] - rows[half, layout.l]
    theta = (model.weights or (0.5, 1.0))[0]
    end = rows[fine, layout.l] + (1 - theta) * step
    outside = np.maximum(law.lower - end, end - law.upper)
    part = np.divide(outside, np.abs(step), out=np.zeros_like(step), where=free & (outside > 0))
    at = np.flatnonzero(part.any(axis=1))
    if not at.size:
        return []
    x = rows[:, watched]
    most = allowed(np.abs(x).max(axis=0))
    off = part[at].max(axis=1, keepdims=True) ** 2 / 2 * np.abs(x[fine] - 2 * x[half] + x[start])[at]
    n, late = len(model.names), part[at] ** 2 / 2 * np.abs(step[at])
    off[:, :n] = np.maximum(off[:, :n], _multiplier_displacement(problem, model, record, 2 * at + 1, late))
    error = np.divide(off, most, out=np.zeros_like(off), where=most > 0).max(axis=1)
    found = np.flatnonzero(error > 1)
    if not found.size:
        return []
    return [
        f"the path turned back inside {found.size} step{'s' if found.size > 1 else ''}, first before "
        f"t = {record.t[2 * at[found[0]] + 2]:.6g}, unseen by whole and half steps: off by about {error.max():.2g} "
        "times what rtol allows; compare with constant steps"
    ]


def _multiplier_displacement(
    problem: OneStepProblem, model: Model, record: RowRecord, at: np.ndarray, l: np.ndarray
) -> np.ndarray:
    """How far multipliers l (k, m) >= 0 move the model's state (k, n) at the end of the step from each of k rows."""
    p, layout, x = problem, record.layout, problem.next_state[: len(model.names)]
    parts = [*p.jacobians[:2], derivatives(x, p.z), derivatives(x, p.l)]
    of = ca.Function("push", [p.t, p.h, p.state, p.l], ca.substitute(parts, [p.z], [p.guess]))
    moved, h = np.zeros((len(at), x.numel())), np.diff(record.t[: record.filled])
    for row, k, own in zip(moved, at, l, strict=True):
        E_z, E_l, x_z, x_l = of(record.t[k], h[k], record.rows[k, layout.state], record.rows[k + 1, layout.l])
        some = np.flatnonzero(own).tolist()
        push = x_l[:, some] - x_z @ ca.solve(E_z, E_l[:, some])
        row[:] = np.abs(np.array(ca.densify(push))) @ own[some]
    return moved
