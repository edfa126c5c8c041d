"""What the walks of schemes with one nonsmooth problem a step share: the stepper, its compiled steps, rows, counts.

A scheme's steps over a grid that is known beforehand: interpreted one by one, or many at once in C.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cache, cached_property
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from nsmodel.errors import CodegenError, StepError, UsageError
from nsmodel.files import cache_folder
from nsmodel.modeling.base import Model
from nsmodel.modeling.blocks import model_ticks
from nsmodel.modeling.fingerprint import ALL_VALUES_SUFFIX, INTERPRETED_BACKEND, run_settings
from nsmodel.modeling.output_columns import OutputColumns
from nsmodel.modeling.parts import Part
from nsmodel.modeling.time_grid import TimeGrid
from nsmodel.simulation import step_inputs
from nsmodel.simulation.options import Options
from nsmodel.simulation.propagator import (
    GridProgress,
    ResumedBackend,
    buffered_row_count,
    check_exact_function,
    find_runaway_state,
    overrun_warnings,
    scene_metadata,
    scheme_metadata,
    update_exact_error,
)
from nsmodel.simulation.step_backend import choose_step_backend
from nsmodel.simulation.step_inputs import GridInputs
from nsmodel.solvers import impacts
from nsmodel.solvers.catching_up import CatchingUpStepper
from nsmodel.solvers.initial_checks import UNIQUENESS_WARNING, check_start, start_warnings
from nsmodel.solvers.one_step_problem import initial_rows, one_step_problem, state_before_short_step, state_constraints
from nsmodel.solvers.plan import REPEATED_PATH, CompilationCost, build_seconds, interpreted_step_seconds, is_fixed_code_faster
from nsmodel.solvers.step import PackedStep, RowRecord, WarmStart
from nsmodel.solvers.structure import MAX_STEP_SIZES, is_eigenvalue_nonnegative
from nsmodel.solvers.time_stepper import ModewiseStepper, ReactionInitialiser, Stepper, completed_start_state, mode_state_indices


def make_stepper(
    model: Model, solver: str, tolerance: float, *, h: float, state: np.ndarray, few_steps: bool = True
) -> PackedStep:
    """Return the stepper of a bound model."""
    problem = one_step_problem(model)
    if problem.prediction is not None:
        return CatchingUpStepper(problem, problem.prediction, solver, tolerance, h=h, state=state)
    if at := mode_state_indices(problem, model.values_taken, state):
        names = dict.fromkeys((model.input_names * 2)[place - problem.state.numel()] for place in at)
        return ModewiseStepper(problem, at, list(names), solver, tolerance, h=h, state=state, few_steps=few_steps)
    return Stepper(problem, solver, tolerance, h=h, state=state, few_steps=few_steps)


class SchemePropagator:
    """The part of a walk that does not depend on how its steps are chosen: it stands at (k, state, warm).

    Attributes beside those of `walk.Propagator`:
        problem, stepper: of the scheme; rollout: the compiled steps, None where they are interpreted.
        state, warm: what the next step starts from; last_index: the index set of the last step.
        watches: multipliers that may call for an impulse.
    """

    record: RowRecord
    rows_lost: bool = False
    defers_reading: bool = False

    def __init__(
        self, model: Model, options: Options, grid: TimeGrid, compiled_grid: TimeGrid, resumed_backend: ResumedBackend,
        symbolic_model: Model | None = None
    ) -> None:  # fmt: skip
        """Prepare steps.

        Args:
            model: bound.
            options: of the run.
            grid: its first step is the one that is prepared.
            in_c: the grid that the C is written for: one step size, or any.
            there: tells how the run that is resumed was stepped; asked once the model is known to run.
            whole: the model with its parameters as symbols, where its library for all values may be taken.
        """
        check_start(model)
        check_exact_function(model)
        given = getattr(model, "tolerances", None)
        if given is not None and not callable(given) and 1 < np.size(given) < grid.N:
            raise UsageError(f"tolerances: {np.size(given)} values for {grid.N} steps; give one for each, or one for all")
        self.model: Any = model
        self.options, self.in_c, tolerance = options, compiled_grid, options.tolerance
        self.problem, h = one_step_problem(model), grid.step(0)
        self._first = h
        self.known = initial_rows(model, h)
        self.k, self.state = len(self.known) - 1, completed_start_state(self.problem, self.known[-1][0], h, tolerance)
        few = grid.steps is None or (np.unique(grid.steps).size <= MAX_STEP_SIZES and not (grid.drive and grid.drive.moving))
        self.stepper: Any = make_stepper(model, options.solver, tolerance, h=h, state=self.state, few_steps=few)
        self.warm = self.stepper.cold_start()
        self.last_index: np.ndarray | None = None
        self.impact_rows = impacts.impact_rows(model)
        self.outputs = OutputColumns.of(model, self.problem.multiplier_names)
        self.counts: Counter[str] = Counter()
        self.totals: dict[str, Any] = {
            "worst_residual": 0.0, "worst_residual_t": None, "newton": 0.0, "newton_max": 0.0, "index_set_changes": 0, "steps": 0,
        }  # fmt: skip
        way = resumed_backend()
        self.whole = symbolic_model if symbolic_model is not None and self._uses_library_for_all(way, grid.N) else None
        steps = choose_step_backend(options, self.stepper.plan, way, grid.N, self._cost, self._build)
        self.rollout, self.plan = steps.steps, steps.plan
        self.warnings = [*start_warnings(model, self.stepper.plan), *steps.warnings]
        self.settings = run_settings(model, grid, options.solver, tolerance, options.save_every, steps.way)

    def start(self, grid: TimeGrid, capacity: int) -> RowRecord:
        """Return the rows of a run that begins: those that are known before the first step."""
        record = RowRecord(self.model, self.stepper.layout, self.warm.index.size, capacity)
        if not self.options.resume:
            for k, (state, records) in enumerate(self.known):
                record.known(k, grid.time(k), grid.step(min(k, grid.N - 1)), state, records)
            self.outputs(record.columns(newton=self.counts_iterations))  # An unknown name is refused before the first step.
        return record

    @property
    def counts_iterations(self) -> bool:
        """Whether Newton iterations are counted."""
        return self.plan.path == "newton"

    @cached_property
    def starter(self) -> step_inputs.StateInitialiser | None:
        """What finds the reaction that a state carries anew, where it carries one."""
        start = self.problem.start
        if start is None:
            return None
        interpreted = ReactionInitialiser(start, self.stepper.tolerance, h=self._first, state=self.state)
        return interpreted if self.rollout is None else self.rollout.starter(interpreted)

    def _uses_library_for_all(self, way: str | None, steps: int) -> bool:
        """Whether compiled steps are those of all values of the parameters: as the run began, else by its model and length."""
        if way not in (None, INTERPRETED_BACKEND):
            return way.endswith(ALL_VALUES_SUFFIX)
        structure = getattr(self.stepper, "structure", None)
        return not is_fixed_code_faster(self.stepper.plan.path, structure, self.problem, steps)

    def _build(self) -> Any:
        """Compile the steps; CodegenError where that cannot be."""
        from nsmodel.codegen.rollout import Rollout

        if self.whole is not None:
            with contextlib.suppress(CodegenError):
                return Rollout(self.model, self.in_c, self.stepper.tolerance, self.whole)
            self.whole = None
        return Rollout(self.model, self.in_c, self.stepper.tolerance)

    def _cost(self) -> CompilationCost:
        """What an interpreted step takes, and building the compiled one."""
        path, structure = self.stepper.plan.path, getattr(self.stepper, "structure", None)
        moving = self.in_c.drive is not None and self.in_c.drive.moving  # Each period has lengths of its own: few steps repeat.
        own = REPEATED_PATH if getattr(self.stepper, "repeats", False) and not moving else path
        if path == "sparse" and self.in_c.steps is not None:  # C has it for one time step
            return CompilationCost(interpreted_step_seconds(own, structure, self.problem.law), lambda: np.inf)
        return CompilationCost(
            interpreted_step_seconds(own, structure, self.problem.law),
            lambda: 0.0 if self._is_built() else build_seconds(path, structure, self.problem),
        )

    def _is_built(self) -> bool:
        """Whether the compiled steps are in the cache."""
        if cache_folder.is_cache_empty():
            return False
        from nsmodel.codegen import library

        name, tolerance = library.compiler(), self.stepper.tolerance
        if name is None:
            return False
        if self.whole is not None:
            return library.has_cached_library(library.steps_key_for_all(self.whole, self.in_c, tolerance, name))
        return library.has_cached_library(library.steps_key(self.model, self.in_c, tolerance, name))

    @property
    def runaway(self) -> tuple[str, float] | None:
        """Name and value of the largest state, where it is beyond what can be computed with."""
        return find_runaway_state(self.model.names, self.state[: len(self.model.names)])

    def warm_up(self) -> None:
        """Take a step and forget it."""
        with contextlib.suppress(StepError):
            self.stepper(0.0, self._first, self.state, self.warm)

    def _known_least_eigenvalue(self) -> float:
        """The least eigenvalue known of W + W'; -inf where none is looked for."""
        if not self.counts_iterations or self.problem.scale is not None:
            return -np.inf
        return min(self.stepper.least_eigenvalue, self.totals.get("least_eigenvalue", np.inf))

    def _update_state(
        self, k: int, state: np.ndarray, warm: WarmStart, last: np.ndarray | None, worst: float, worst_t: float | None,
        newton: float, newton_max: float, changes: int,
    ) -> None:  # fmt: skip
        """Stand after step k; ``worst_t`` is the time of a residual that is worse than those before."""
        self.k, self.state, self.warm, self.last_index = k, state, warm, last
        totals = self.totals
        if worst_t is not None:
            totals["worst_residual"], totals["worst_residual_t"] = float(worst), worst_t
        totals["newton"] += float(newton)
        totals["newton_max"] = max(totals["newton_max"], float(newton_max))
        totals["index_set_changes"] += int(changes)
        totals["steps"] = k

    def note(self) -> None:
        """Keep of the rows what the end will ask for: the distance to the exact state, when an oscillator last moved."""
        if not self.record.filled:
            return
        t, x = self.record.t[: self.record.filled], self.record.states
        update_exact_error(self.model, self.totals, t, x)
        least = min(self.stepper.least_eigenvalue, self.totals.get("least_eigenvalue", np.inf))
        if np.isfinite(least):
            self.totals["least_eigenvalue"] = float(least)
        if self.problem.gap:
            self._accumulate_overrun(t, x)
        if self.impact_rows:
            names = {"multipliers": "multipliers" if "multipliers" in self.stepper.layout.slices else "l"}
            names |= {"v": self.problem.velocity} if self.problem.velocity else {}
            names |= {"inputs": "inputs"} if self.problem.inputs else {}
            columns = {"t": t, "x": x, **{name: self.record.column(own) for name, own in names.items()}}
            self.totals["impacts"] = impacts.update_impacts(self.impact_rows, columns, self.totals.get("impacts", {}))
        if self.problem.velocity:
            self._accumulate_rest(t, x)

    def _accumulate_rest(self, t: np.ndarray, x: np.ndarray) -> None:
        v = self.record.column(self.problem.velocity)
        moving = np.flatnonzero((v != 0).any(axis=1) & np.isfinite(v).all(axis=1))
        rest = moving[-1] + 1 if moving.size else 0
        if moving.size:
            self.totals["rest_from"] = None
        if self.totals.get("rest_from") is None and rest < len(v):
            self.totals["rest_from"] = [int(self.record.number[rest]), float(t[rest])]
        self.totals["last_x"] = x[-1].tolist()
        self.totals["last_v"] = [*self.totals.get("last_v", []), *v[-2:].tolist()][-2:]

    def _accumulate_overrun(self, t: np.ndarray, x: np.ndarray) -> None:
        """Keep the worst gap below 0, beyond rounding: a linearised constraint can be overrun where it is not convex."""
        gap, model = self.record.column(self.problem.gap), self.model
        if not gap.min() < 0:
            return
        given, u = [model.t, model.state, model.u], self.record.column("inputs") if self.problem.inputs else np.zeros((len(t), 0))
        slopes = ca.Function("slopes", given, [ca.densify(ca.jacobian(state_constraints(model), model.state))])
        slopes_at = cache(lambda k: np.array(slopes(t[k], x[k], u[k])))
        for i, k in enumerate(gap.argmin(axis=0)):
            if gap[k, i] >= self.totals.get("overrun", {"gap": 0.0})["gap"]:
                continue
            if gap[k, i] < -1e-10 * np.linalg.norm(slopes_at(k)[i]) * (1 + np.linalg.norm(x[k])):
                self.totals["overrun"] = {"gap": float(gap[k, i]), "constraint": model.multiplier_names[i], "t": float(t[k])}

    def _monotonicity_warnings(self) -> list[str]:
        least = self.totals.get("least_eigenvalue", np.inf)
        if not self.stepper.plan.monotone or is_eigenvalue_nonnegative(least, self.warm.index.size):
            return []
        return [f"the one-step problem was not monotone all the time (least eigenvalue {least:.3g}): {UNIQUENESS_WARNING}"]

    def columns(self) -> dict[str, np.ndarray]:
        """The rows in memory as the arrays of a trajectory."""
        arrays = self.record.columns(self.stepper.plan.path == "newton")
        return arrays | self.outputs(arrays)

    def checkpoint(self) -> dict[str, Any]:
        """What to continue from."""
        last = None if self.last_index is None else self.last_index.tolist()
        return {"state": self.state.tolist(), "l": self.warm.l.tolist(), "index": self.warm.index.tolist(), "last_index": last}

    def restore(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        self.state = np.array(saved["state"], float).reshape(self.state.shape)
        l, index = np.array(saved["l"], float), np.array(saved["index"], np.int8)
        self.warm = WarmStart(l.reshape(self.warm.l.shape), index.reshape(self.warm.index.shape))
        self.last_index = None if saved["last_index"] is None else np.array(saved["last_index"], np.int8)

    def metadata(self) -> dict[str, Any]:
        """The scheme, the names of rows, warnings, when an oscillator rests."""
        model = self.model
        met = impacts.describe_impacts(self.impact_rows, self.totals.get("impacts", {}), model)
        data = scheme_metadata(self.problem, self.stepper.tolerance)
        data["warnings"] = [*self.warnings, *self._monotonicity_warnings(), *overrun_warnings(self.totals), *met]
        if "last_v" in self.totals:
            x, v = (np.array(self.totals[key]) for key in ("last_x", "last_v"))
            data["convergence"] = END_OF_RUN.of(model)(model, x, v, self.totals["rest_from"])
        return data | scene_metadata(model)


EndOfRun: TypeAlias = Callable[[Any, np.ndarray, np.ndarray, tuple[int, float] | None], dict[str, Any]]
# Of a scheme with a velocity: whether and why it has come to rest.
END_OF_RUN = Part[EndOfRun]("finite_convergence.finite_convergence")


class FixedGridPropagator(GridProgress, SchemePropagator):
    """The walk over a grid; see `walk.Propagator`."""

    def __init__(
        self, model: Model, options: Options, grid: TimeGrid, resumed_backend: ResumedBackend, symbolic_model: Model | None = None
    ) -> None:
        super().__init__(model, options, grid, grid, resumed_backend, symbolic_model)
        self.grid, self.N, self.every = grid, grid.N, options.save_every
        self.driven = None if grid.drive is None else GridInputs(grid, grid.drive, self.starter, model_ticks(model))
        row = 8 * (self.stepper.layout.width + 5) + self.warm.index.size
        self.record = self.start(grid, buffered_row_count(grid.N, options, row, len(self.known)))

    def advance(self, steps: int, stop: Sequence[float]) -> None:
        """Go on: a step that C cannot certify, or a shortened one, is interpreted."""
        if self.rollout is None:
            self._advance_interpreted(min(self.k + steps, self.N), stop)
            return
        grid = self.grid
        end = grid.N - 1 if grid.steps is None and grid.last != grid.h else grid.N
        if (self.k == end or self._advance_in_c(end)) and not (self.record.full or stop):
            self._advance_interpreted(self.k + 1, stop)

    def _advance_in_c(self, end: int) -> bool:
        """Take compiled steps and record them, as many as there is time and room for; whether then one was not certified."""
        grid, every, record, totals, k = self.grid, self.every, self.record, self.totals, self.k
        free = slice(record.filled, None)
        room = (len(record.t) - record.filled) * every - k % every
        steps = 1 if self.last_index is None else min(end - k, room)  # the first alone: no index set has changed before it
        state, given = (self.state, None) if self.driven is None else self.driven.block(self.state, k, steps, self.warm.l)
        steps = steps if given is None else len(given)
        done = self.rollout.advance(
            k, steps, state, self.warm, self._known_least_eigenvalue(), every, record.rows[free], record.index[free], given
        )  # fmt: skip
        if done.steps:
            last = k + done.steps
            numbers = np.arange(k - k % every + every, last + 1, every)
            if last == grid.N and last % every:
                numbers = np.append(numbers, last)
            record.extend(numbers, *grid.around(numbers))
            self.counts.update(done.solvers)
            if self.counts_iterations:
                self.stepper.include_eigenvalue(done.least_eigenvalue)
            worst_t = grid.time(done.worst_step) if done.worst > totals["worst_residual"] else None
            newton = (done.newton, done.newton_max) if self.counts_iterations else (0.0, 0.0)
            changes = 0 if self.last_index is None else done.changes
            self._update_state(last, done.state, done.warm, done.warm.index, done.worst, worst_t, *newton, changes)
        return done.stuck

    def _advance_interpreted(self, end: int, stop: Sequence[float]) -> None:
        """Steps up to number ``end``. Attributes are local here and written back when it ends, however it ends."""
        grid, step, every, counts, record = self.grid, self.stepper, self.every, self.counts, self.record
        k, state, warm, last = self.k, self.state, self.warm, self.last_index
        layout, constant, h, N = self.stepper.layout, grid.steps is None, grid.h, grid.N
        state_at, residual_at, newton_at = layout.state, layout.residual, layout.newton
        worst, worst_k, newton, newton_max, changes = self.totals["worst_residual"], None, 0.0, 0.0, 0
        counting, seen, driven = self.counts_iterations, None if last is None else warm, self.driven
        try:
            while k < end and not (stop or record.full):
                start = state if driven is None else driven.state(state, k, warm.l)
                if constant:
                    t, h_k = k * h, h if k < N - 1 else grid.last
                    start = start if h_k == h or k == 0 else state_before_short_step(self.model, start, h_k / h)
                else:
                    t, h_k = grid.time(k), grid.step(k)
                row, warm, solver = step(t, h_k, start, warm, k)
                state = row[state_at]
                counts[solver] += 1
                if row[residual_at] > worst:
                    worst, worst_k = row[residual_at], k + 1
                if warm is not seen:  # the same object as long as the last index set holds
                    changes += last is not None and not np.array_equal(warm.index, last)
                    seen, last = warm, warm.index
                    if counting:
                        newton += row[newton_at]
                        newton_max = max(newton_max, row[newton_at])
                k += 1
                if k % every == 0 or k == N:
                    record.add(k, grid.time(k), h_k, h_k if constant or k == N else grid.step(k), row, warm.index)
        finally:
            worst_t = None if worst_k is None else grid.time(worst_k)
            self._update_state(k, state, warm, last, worst, worst_t, newton, newton_max, changes)

    def restore(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        super().restore(saved)
        if self.driven is not None:
            self.driven.seek(self.state, self.k)

    def metadata(self) -> dict[str, Any]:
        """As of every scheme, and whether its steps are known to have one answer."""
        return super().metadata() | {"monotone": bool(self.plan.monotone) and not self._monotonicity_warnings()}
