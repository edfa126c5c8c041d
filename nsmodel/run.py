"""One run: a model's scheme stepped over a grid, every step verified, nothing lost when it stops."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from nsmodel import cache_folder
from nsmodel.classes.oscillator.model import FrictionOscillator
from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.errors import CodegenError, StepError, StorageError, UsageError
from nsmodel.grid import Grid
from nsmodel.hypotheses import impacts
from nsmodel.hypotheses.quick import UNIQUENESS, refuse_start, warnings_of
from nsmodel.hypotheses.rest import finite_convergence
from nsmodel.identity import INTERPRETED, WAY, difference, settings, versions
from nsmodel.model.base import Model
from nsmodel.record import Record
from nsmodel.scheme import initial_rows, one_step_problem, shortened
from nsmodel.scheme.problem import OneStepProblem
from nsmodel.solve.build import Stepper, start_state
from nsmodel.solve.choose import Plan
from nsmodel.solve.cost import Cost, building, interpreted
from nsmodel.solve.projection import CatchingUp
from nsmodel.solve.stepper import Step, Warm
from nsmodel.solve.structure import is_monotone
from nsmodel.storage import ChunkStore, unfinished
from nsmodel.trajectory import Trajectory
from nsmodel.version import VERSION

CHUNK_BYTES, CHUNK_SECONDS = 64 << 20, 10.0  # Rows go to the folder when they fill the one or have waited for the other.
IN_C = "steps in C, compiled for this model; a step that C cannot certify is taken as above"
RUNAWAY = 1e100  # A state beyond this has diverged: squares of it, and of what grows with it, soon overflow.
FEW_STEPS = 8  # Different step sizes up to which constant matrices are factored once for each.


def make_stepper(
    problem: OneStepProblem, solver: str, tolerance: float, *, h: float, state: np.ndarray, few_steps: bool = True
) -> Step:
    """Return the stepper of a bound model's problem."""
    if problem.prediction is not None:
        return CatchingUp(problem, problem.prediction, solver, tolerance, h=h, state=state)
    return Stepper(problem, solver, tolerance, h=h, state=state, few_steps=few_steps)


class RunInterrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM during a run; ``trajectory`` holds what was computed, ``signal`` is which of them came."""

    def __init__(self, trajectory: Trajectory, signal: int = signal.SIGINT) -> None:
        super().__init__(trajectory.metadata["message"])
        self.trajectory, self.signal = trajectory, signal

    def __reduce__(self) -> tuple[type[RunInterrupted], tuple[Trajectory]]:
        """Pickle with the trajectory, of which the message is a part."""
        return type(self), (self.trajectory,)


class Loop:
    """What every run is: where it stands (k and what a class adds), what it has counted, the rows not yet written.

    A class sets model, grid, save_every, out, store, k, plan, record, settings, counts, totals and warnings, and says how to
    advance, what it continues from, and what more a trajectory tells.
    """

    model: Any
    grid: Any
    save_every: int
    out: Path | None
    store: ChunkStore | None
    k: int
    problem: Any
    plan: Plan
    record: Any
    settings: dict[str, Any]
    counts: Counter[str]
    totals: dict[str, Any]
    warnings: list[str]

    def go(self, progress: bool = False) -> Trajectory:
        """Run to the end; where that fails, or is interrupted, save what there is and say so.

        Numbers that cannot be computed with end in a StepError, whatever library says so; a fault of the program stays what
        it is.
        """
        bar = self._bar() if progress else None
        # What overflows is for the certificate to judge.
        with _deferred_signals() as signals, np.errstate(all="ignore"):
            start = time.process_time()
            try:
                try:
                    self._advance(bar, signals)
                finally:
                    signals.patient = True
                    self.cpu_seconds = time.process_time() - start
                    if bar is not None:
                        bar.close()
            except StepError as error:
                self._stop(error)
                raise
            except StorageError as error:
                error.trajectory = self._in_memory("failed", str(error))
                raise
            except MemoryError as error:
                raise self._stop(StepError(f"{self._span}: not enough memory ({error})")) from error
            except Exception as error:
                if is_numerical(error) or self._runaway is not None:
                    raise self._stop(unsolvable(self._span, error)) from error
                self._finish("failed", f"{type(error).__name__}: {error}")
                raise
            except KeyboardInterrupt:  # a second signal, in the middle of a step: the step did not happen
                pass
            if not self._ended:
                run = self._finish("interrupted", f"interrupted at t = {self.grid.time(self.k):.10g}")
                raise RunInterrupted(run, signals.number)
            return self._finish("done", "")

    @property
    def _span(self) -> str:
        t = self.grid.time(self.k)
        return f"no verified step from t = {t:.10g} to {t + self.grid.step(self.k):.10g}"

    def _stop(self, error: StepError) -> StepError:
        """Complete what is known of a failed step, and save the run before it."""
        runaway = self._runaway
        grown = "" if runaway is None else f". The run has diverged: {runaway[0]} = {runaway[1]:.3g}"
        error.step, error.time = self.k, self.grid.time(self.k) + self.grid.step(self.k)
        error.args = (f"step {self.k}: {error.args[0]}{grown}",)
        with contextlib.suppress(MemoryError):  # of a run in a folder the chunks are there
            error.trajectory = self._finish("failed", str(error))
        return error

    @property
    def _runaway(self) -> tuple[str, float] | None:
        """Name and value of the largest state, where that has left the range of numbers to compute with."""
        raise NotImplementedError

    def warm_up(self) -> None:
        """Take a step and forget it: what is built at its first use is built."""
        raise NotImplementedError

    def _advance(self, bar: Any, interrupted: Sequence[float]) -> None:
        """Step until the run has ended or is interrupted."""
        raise NotImplementedError

    def _build(self) -> Any:
        """Compile the steps; CodegenError where that cannot be."""
        raise NotImplementedError

    def _cost(self) -> Cost:
        """What an interpreted step takes, and building the compiled one."""
        raise NotImplementedError

    def _columns(self) -> dict[str, np.ndarray]:
        """The rows in memory as the arrays of a trajectory."""
        raise NotImplementedError

    def _standing(self) -> dict[str, Any]:
        """What to continue from, for the checkpoint."""
        raise NotImplementedError

    def _stand(self, saved: dict[str, Any]) -> None:
        """Take up what ``_standing`` gave."""
        raise NotImplementedError

    def _note(self) -> None:
        """Keep of the rows in memory what the end will ask for."""

    def _bar(self) -> Any:
        return progress_bar(total=self.grid.N, initial=self.k, unit="step")

    @property
    def _ended(self) -> bool:
        return self.k >= self.grid.N

    def _start_store(self, resume: bool) -> None:
        """Open the folder of the run, or take a new one; a run that can be continued is not overwritten."""
        if self.out is not None and not resume:
            keep_unfinished(self.out)
        self.store = None if self.out is None else (ChunkStore.open(self.out) if resume else ChunkStore(self.out))

    def _in_c(self, compiled: bool | str, solver: str) -> Any:
        """The steps in C, where they are asked for, or pay, or the run that is resumed had them; None: they are interpreted."""
        there, wanted = self._way_there, compiled is True
        if compiled == "auto":
            pays = solver == "auto" and self._cost().pays(self.grid.N)
            wanted = pays if there is None else there != INTERPRETED
            if solver == "auto" and not (pays or wanted):
                self.plan = replace(self.plan, left_out=(*self.plan.left_out, self._cost().text(self.grid.N)))
        if not wanted:
            return None
        try:
            steps = self._build()
        except CodegenError as error:
            if there not in (None, INTERPRETED):
                raise StorageError(f"{self.out}: the run there is {there}, which it cannot be here: {error}") from error
            self.plan = replace(self.plan, left_out=(*self.plan.left_out, f"steps in C: {error}"))
            if compiled is True:
                self.warnings.append(f"not compiled, the steps are interpreted: {error}")
            return None
        self.plan = replace(self.plan, used=(*self.plan.used, IN_C))
        return steps

    @property
    def _way_there(self) -> str | None:
        """How the run that is resumed was stepped; None for a new one."""
        return self.store.manifest["checkpoint"]["settings"].get(WAY) if self.store and self.store.manifest["chunks"] else None

    def _rows_in_memory(self, row: int, known: int) -> int:
        """Rows of so many bytes kept in memory: all of them, or a chunk where they go to a folder."""
        total = self.grid.N // self.save_every + 1 + known
        if self.out is not None:
            return int(min(total, max(64, CHUNK_BYTES // row)))
        if total * row > _memory():
            raise UsageError(
                f"{self.grid.N} steps do not fit in memory ({total * row / 2**30:.3g} GiB); give out=DIR (--out DIR), "
                "and save_every=N (--save-every N) to keep fewer rows"
            )
        return int(total)

    def _check_exact(self) -> None:
        if self.model.exact is not None:
            try:
                got, expected = np.shape(self.model.exact(np.zeros(2))), (2, len(self.model.names))
            except Exception as error:
                raise UsageError(f"exact: it raised {type(error).__name__} at t = 0: {error}") from error
            if got != expected:
                raise UsageError(f"exact: it returned shape {got} for 2 times; expected {expected}")

    def _distance_to_exact(self, t: np.ndarray, x: np.ndarray) -> float:
        """max |x - exact(t)|; inf where the user's function fails or gives NaN: no reason to lose the run."""
        try:
            distance = float(np.abs(x - np.asarray(self.model.exact(t), float)).max())
        except Exception:
            return np.inf
        return distance if np.isfinite(distance) else np.inf

    @property
    def _due(self) -> bool:
        """Whether rows wait that a killed run should not lose."""
        return self.record.full or (self.record.filled > 0 and time.monotonic() - self._flushed >= CHUNK_SECONDS)

    def _flush(self, status: str, message: str) -> None:
        """Write the rows in memory as a chunk, with the checkpoint to continue from."""
        self._note()
        checkpoint = {
            "k": self.k, "t": self.grid.time(self.k), **self._standing(),
            "counts": dict(self.counts), "totals": self.totals, "settings": self.settings,
        }  # fmt: skip
        self.store.append(self._columns(), checkpoint, self._metadata(status, message))
        self.record.clear()
        self._flushed = time.monotonic()

    def _restore(self) -> None:
        """Take up the checkpoint of the run in ``out``; refuse another model, other settings, other versions, another grid."""
        saved = self.store.manifest["checkpoint"]
        other = difference(saved["settings"], self.settings)
        if other is not None:
            same_way = "leave compiled (--compiled) out to go on as it began, or " if WAY in other else ""
            raise StorageError(f"{self.out}: the run there was made with {other}; {same_way}start afresh without resuming")
        if saved["k"] > self.grid.N:
            raise StorageError(f"{self.out}: the run there has reached t = {saved['t']:g}, past this run's end; give a later end")
        if abs(self.grid.time(saved["k"]) - saved["t"]) > 1e-9 * saved["t"]:
            raise StorageError(
                f"{self.out}: the run there ended at t = {saved['t']:g} with a shortened step, which is no time of this run's "
                "grid; start afresh without resuming"
            )
        self.k = saved["k"]
        self.counts, self.totals = Counter(saved["counts"]), dict(saved["totals"])
        self._stand(saved)

    def _finish(self, status: str, message: str) -> Trajectory:
        """The run so far, in the folder where there is one; where that cannot be written, the StorageError has it."""
        if self.store is None:
            self._note()
            return Trajectory(self._columns(), self._metadata(status, message))
        try:
            if self.record.filled:
                self._flush(status, message)
            path = self.store.directory / "trajectory.npz"
            self.store.join(path, self._metadata(status, message))
        except StorageError as error:
            error.trajectory = self._in_memory(status, message)
            raise
        return Trajectory.load(path)

    def _in_memory(self, status: str, message: str) -> Trajectory | None:
        """The run so far without writing: what is in the folder, if it can be read, and the rows not yet written."""
        parts = []
        with contextlib.suppress(StorageError, MemoryError):
            parts = [self.store.read()] if self.store and self.store.manifest["chunks"] else []
        if self.record.filled:
            parts.append(self._columns())
        if not parts:
            return None
        arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        return Trajectory(arrays, self._metadata(status, message))

    def _overrun(self) -> list[str]:
        if "overrun" not in self.totals:
            return []
        worst = self.totals["overrun"]
        return [
            f"constraint '{worst['constraint']}' was overrun, at worst by {-worst['gap']:.3g} at t = {worst['t']:.6g}: the "
            "scheme keeps a constraint >= 0 only where it is convex"
        ]

    def _metadata(self, status: str, message: str) -> dict[str, Any]:
        model, plan = self.model, self.plan
        data = {
            "title": model.title,
            "model_class": type(model).__name__,
            "paper": model.paper,
            "state_names": list(model.names),
            "stems": {stem: list(at) for stem, at in model.stems.items()},
            "units": dict(model.units),
            "parameters": dict(getattr(model, "bound_parameters", {})),
            "save_every": self.save_every,
            "steps": self.totals["steps"],
            "used": list(plan.used),
            "left_out": list(plan.left_out),
            "solver_counts": dict(sorted(self.counts.items())),
            "totals": dict(self.totals),
            "warnings": list(self.warnings),
            "status": status,
            "message": message,
            "model_hash": self.settings["model"],
            "versions": versions(),
        }
        if getattr(model, "scene", None):
            data["scene"] = {key: value.tolist() for key, value in model.scene.items()}
        return data


class Run(Loop):
    """A run of a scheme that is one nonsmooth problem a step: the stepper, and where it stands (k, state, warm)."""

    def __init__(
        self, model: Model, grid: Grid, solver: str, tolerance: float, save_every: int, out: Path | None, resume: bool,
        compiled: bool | str = False,
    ) -> None:  # fmt: skip
        self.model, self.grid, self.save_every, self.out = model, grid, save_every, out
        refuse_start(model)
        self._check_exact()
        given = getattr(model, "tolerances", None)
        if given is not None and not callable(given) and 1 < np.size(given) < grid.N:
            raise UsageError(f"tolerances: {np.size(given)} values for {grid.N} steps; give one for each, or one for all")
        self.problem = one_step_problem(model)
        known = initial_rows(model, grid.step(0))
        self.k, self.state = len(known) - 1, start_state(self.problem, known[-1][0], grid.step(0), tolerance)
        few = grid.steps is None or np.unique(grid.steps).size <= FEW_STEPS
        self.stepper = make_stepper(self.problem, solver, tolerance, h=grid.step(0), state=self.state, few_steps=few)
        self.warm, self.last_index = self.stepper.cold(), None
        self.warnings = warnings_of(model, self.stepper.plan)
        self.watches = impacts.watched(model)
        self.counts: Counter[str] = Counter()
        self.totals: dict[str, Any] = {
            "worst_residual": 0.0, "worst_residual_t": None, "newton": 0.0, "newton_max": 0.0, "index_set_changes": 0, "steps": 0,
        }  # fmt: skip
        self._start_store(resume)
        self.plan = self.stepper.plan
        self.rollout = self._in_c(compiled, solver)
        way = INTERPRETED if self.rollout is None else self.rollout.way
        self.settings = settings(model, grid, solver, tolerance, save_every, way)
        self._flushed = time.monotonic()
        self.record = Record(model, self.stepper.layout, self.warm.index.size, self._capacity(len(known)))
        if resume:
            self._restore()
        else:
            for k, (state, records) in enumerate(known):
                self.record.known(k, grid.time(k), grid.step(min(k, grid.N - 1)), state, records)

    def _build(self) -> Any:
        from nsmodel.codegen.rollout import Rollout

        return Rollout(self.model, self._grid_in_c(), self.stepper.tolerance)

    def _grid_in_c(self) -> Grid:
        """The grid that the C is written for: one step size, or any."""
        return self.grid

    def _cost(self) -> Cost:
        path, structure, grid = self.plan.path, getattr(self.stepper, "structure", None), self._grid_in_c()
        if path == "sparse" and grid.steps is not None:  # C has it for one time step
            return Cost(interpreted(path, structure), lambda: np.inf)
        return Cost(interpreted(path, structure), lambda: 0.0 if self._is_built() else building(path, structure, self.problem))

    def _is_built(self) -> bool:
        """Whether the compiled steps are in the cache."""
        if cache_folder.is_empty():
            return False
        from nsmodel.codegen import cache, library

        name = library.compiler()
        return name is not None and cache.is_cached(self.model, self._grid_in_c(), self.stepper.tolerance, name)

    def _capacity(self, known: int) -> int:
        """Rows kept in memory."""
        return self._rows_in_memory(8 * (self.stepper.layout.width + 5) + self.warm.index.size, known)

    @property
    def _runaway(self) -> tuple[str, float] | None:
        x = self.state[: len(self.model.names)]
        return runaway(self.model.names, x)

    def warm_up(self) -> None:
        """Take a step and forget it."""
        with contextlib.suppress(StepError):
            self.stepper(0.0, self.grid.step(0), self.state, self.warm)

    def _advance(self, bar: Any, interrupted: Sequence[float]) -> None:
        """Step until the run has ended or is interrupted."""
        if self.rollout is None:
            self._loop(bar, interrupted)
        else:
            self._loop_in_c(bar, interrupted)

    def _loop_in_c(self, bar: Any, interrupted: Sequence[float]) -> None:
        """The loop over compiled steps, a block at a time; a step that C cannot certify, or a shortened one, is interpreted."""
        grid = self.grid
        end = grid.N - 1 if grid.steps is None and grid.last != grid.h else grid.N
        while self.k < grid.N and not interrupted:
            k = self.k
            stuck = k == end or self._block(end)
            if self.store is not None and self._due:
                self._flush("running", "")
            if stuck:
                self._loop(None, interrupted, self.k + 1)
            if bar is not None:
                bar.update(self.k - k)

    def _block(self, end: int) -> bool:
        """Take compiled steps and record them, as many as there is time and room for; whether then one was not certified."""
        grid, every, record, totals, k = self.grid, self.save_every, self.record, self.totals, self.k
        free = slice(record.filled, None)
        room = (len(record.t) - record.filled) * every - k % every
        steps = 1 if self.last_index is None else min(end - k, room)  # the first alone: no index set has changed before it
        counting = self.plan.path == "newton"
        least = min(self.stepper.least_eigenvalue, totals.get("least_eigenvalue", np.inf)) if counting else -np.inf
        done = self.rollout.advance(k, steps, self.state, self.warm, least, every, record.rows[free], record.index[free])
        if done.steps:
            last = k + done.steps
            numbers = np.arange(k - k % every + every, last + 1, every)
            if last == grid.N and last % every:
                numbers = np.append(numbers, last)
            record.extend(numbers, *grid.around(numbers))
            self.counts.update(done.solvers)
            if counting:
                self.stepper.met(done.least_eigenvalue)
            worst_k = done.worst_step if done.worst > totals["worst_residual"] else None
            newton = (done.newton, done.newton_max) if counting else (0.0, 0.0)
            changes = 0 if self.last_index is None else done.changes
            self._put(last, done.state, done.warm, done.warm.index, done.worst, worst_k, *newton, changes)
        return done.stuck

    def _loop(self, bar: Any = None, interrupted: Sequence[float] = (), end: int | None = None) -> None:
        """The hot loop. Attributes are local here and written back when it ends, however it ends."""
        grid, step, every, counts, record = self.grid, self.stepper, self.save_every, self.counts, self.record
        N, end = self.grid.N, self.grid.N if end is None else end
        k, state, warm, last = self.k, self.state, self.warm, self.last_index
        layout, constant, h = self.stepper.layout, grid.steps is None, grid.h
        state_at, residual_at, newton_at = layout.state, layout.residual, layout.newton
        worst, worst_k, newton, newton_max, changes = self.totals["worst_residual"], None, 0.0, 0.0, 0
        counting, seen, saving = step.plan.path == "newton", None, self.store is not None
        try:
            while k < end and not interrupted:
                if constant:
                    t, h_k = k * h, h if k < N - 1 else grid.last
                else:
                    t, h_k = grid.time(k), grid.step(k)
                start = state if h_k == h or not constant or k == 0 else shortened(self.model, state, h_k / h)
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
                    if saving and self._due:
                        self._put(k, state, warm, last, worst, worst_k, newton, newton_max, changes)
                        worst_k, newton, newton_max, changes = None, 0.0, 0.0, 0
                        self._flush("running", "")
                if bar is not None and k % 64 == 0:
                    bar.update(64)
        finally:
            self._put(k, state, warm, last, worst, worst_k, newton, newton_max, changes)

    def _put(
        self, k: int, state: np.ndarray, warm: Warm, last: np.ndarray | None, worst: float, worst_k: int | None, newton: float,
        newton_max: float, changes: int,
    ) -> None:  # fmt: skip
        """Write the loop's variables back."""
        self.k, self.state, self.warm, self.last_index = k, state, warm, last
        totals = self.totals
        if worst_k is not None:
            totals["worst_residual"], totals["worst_residual_t"] = float(worst), self.grid.time(worst_k)
        totals["newton"] += float(newton)
        totals["newton_max"] = max(totals["newton_max"], float(newton_max))
        totals["index_set_changes"] += int(changes)
        totals["steps"] = k

    def _note(self) -> None:
        """Keep of the rows what the end will ask for: the distance to the exact state, when an oscillator last moved."""
        if not self.record.filled:
            return
        t, x = self.record.t[: self.record.filled], self.record.states
        if self.model.exact is not None:
            self.totals["largest_error"] = max(self.totals.get("largest_error", 0.0), self._distance_to_exact(t, x))
        least = min(self.stepper.least_eigenvalue, self.totals.get("least_eigenvalue", np.inf))
        if np.isfinite(least):
            self.totals["least_eigenvalue"] = float(least)
        if isinstance(self.model, SweepingProcess) and self.model.g.numel():
            self._note_overrun(t, x)
        if self.watches:
            names = {"multipliers": "multipliers" if "multipliers" in self.stepper.layout.slices else "l"}
            names |= {"v": "v"} if isinstance(self.model, FrictionOscillator) else {}
            columns = {"t": t, "x": x, **{name: self.record.column(own) for name, own in names.items()}}
            self.totals["impacts"] = impacts.met(self.watches, columns, self.totals.get("impacts", {}))
        if isinstance(self.model, FrictionOscillator):
            v = self.record.column("v")
            moving = np.flatnonzero((v != 0).any(axis=1) & np.isfinite(v).all(axis=1))
            rest = moving[-1] + 1 if moving.size else 0
            if moving.size:
                self.totals["rest_from"] = None
            if self.totals.get("rest_from") is None and rest < len(v):
                self.totals["rest_from"] = [int(self.record.number[rest]), float(t[rest])]
            self.totals["last_x"] = x[-1].tolist()
            self.totals["last_v"] = [*self.totals.get("last_v", []), *v[-2:].tolist()][-2:]

    def _note_overrun(self, t: np.ndarray, x: np.ndarray) -> None:
        """Keep the worst gap below 0, beyond rounding: a linearised constraint can be overrun where it is not convex."""
        gap, model = self.record.column("gap"), self.model
        if not gap.min() < 0:
            return
        slopes = ca.Function("slopes", [model.t, model.q], [ca.densify(ca.jacobian(model.g, model.q))])
        for i, k in enumerate(gap.argmin(axis=0)):
            rounding = 1e-10 * np.linalg.norm(np.array(slopes(t[k], x[k]))[i]) * (1 + np.linalg.norm(x[k]))
            if gap[k, i] < min(-rounding, self.totals.get("overrun", {"gap": 0.0})["gap"]):
                self.totals["overrun"] = {"gap": float(gap[k, i]), "constraint": model.multiplier_names[i], "t": float(t[k])}

    def _lost_monotonicity(self) -> list[str]:
        least = self.totals.get("least_eigenvalue", np.inf)
        if not self.stepper.plan.monotone or is_monotone(least, self.warm.index.size):
            return []
        return [f"the one-step problem was not monotone all the time (least eigenvalue {least:.3g}): {UNIQUENESS}"]

    def _impacts(self) -> list[str]:
        return impacts.told(self.watches, self.totals.get("impacts", {}), self.model)

    def _columns(self) -> dict[str, np.ndarray]:
        return self.record.columns(self.stepper.plan.path == "newton")

    def _standing(self) -> dict[str, Any]:
        last = None if self.last_index is None else self.last_index.tolist()
        return {"state": self.state.tolist(), "l": self.warm.l.tolist(), "index": self.warm.index.tolist(), "last_index": last}

    def _stand(self, saved: dict[str, Any]) -> None:
        self.state = np.array(saved["state"], float)
        self.warm = Warm(np.array(saved["l"], float), np.array(saved["index"], np.int8))
        self.last_index = None if saved["last_index"] is None else np.array(saved["last_index"], np.int8)

    def _metadata(self, status: str, message: str) -> dict[str, Any]:
        model = self.model
        data = super()._metadata(status, message) | {
            "scheme": self.problem.scheme,
            "multiplier_names": list(getattr(model, "multiplier_names", self.problem.rows)),
            "index_names": list(self.problem.rows),
            "law_kinds": self.problem.law.labels,
            "tolerance": self.stepper.tolerance,
            "warnings": [*self.warnings, *self._lost_monotonicity(), *self._overrun(), *self._impacts()],
        }
        if "last_v" in self.totals:
            x, v = (np.array(self.totals[key]) for key in ("last_x", "last_v"))
            data["convergence"] = finite_convergence(model, x, v, self.totals["rest_from"])
        if getattr(model, "scene", None):
            data["constraint_bodies"] = _bodies(model)
        return data


def is_numerical(error: Exception) -> bool:
    """Whether an exception speaks of numbers, and not of a fault in the program: of CasADi, LAPACK, SuperLU, Python's own."""
    return isinstance(error, ArithmeticError | np.linalg.LinAlgError) or type(error) is RuntimeError


def unsolvable(span: str, error: Exception) -> StepError:
    """The error of a step whose numbers a library refuses."""
    return StepError(f"{span}: its numbers cannot be computed with ({type(error).__name__}: {error})")


def runaway(names: Sequence[str], x: np.ndarray) -> tuple[str, float] | None:
    """Name and value of the largest of x (n,), where it is beyond RUNAWAY or no number."""
    i = int(np.argmax(np.nan_to_num(np.abs(x), nan=np.inf)))
    return None if abs(x[i]) <= RUNAWAY else (names[i], float(x[i]))


def keep_unfinished(out: Path) -> None:
    """Refuse to overwrite a run that can be continued."""
    manifest = unfinished(out)
    if manifest is not None:
        by = manifest["metadata"]["versions"]["nsmodel"]
        of, how = ("", "resume=True (--resume)") if by == VERSION else (f" of nsmodel {by}", "that version")
        raise UsageError(
            f"{out} holds an unfinished run{of}, up to t = {manifest['checkpoint']['t']:g}; go on with {how}, "
            "or remove the folder"
        )


def _bodies(model: Any) -> list[list[int]]:
    """For each constraint of a planar scene, the discs whose coordinates it contains."""
    bodies: list[set[int]] = [set() for _ in range(model.g.numel())]
    for row, column in zip(*ca.jacobian(model.g, model.q).sparsity().get_triplet(), strict=True):
        bodies[row].add(column // 2)
    return [sorted(found) for found in bodies]


def _memory() -> float:
    """Bytes that a run may take: 0.8 of the machine's memory."""
    try:
        return 0.8 * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return 8 * 2**30


class _Signals(list[float]):
    """The times at which signals came, and the number of the last; once ``patient`` no signal raises."""

    number = signal.SIGINT
    patient = False


@contextlib.contextmanager
def _deferred_signals() -> Iterator[_Signals]:
    """Ctrl-C and SIGTERM inside put their time into the list instead of cutting a step in two; one more a second later raises.

    Outside the main thread signals are not for us. Whatever was to be done with them before is so again afterwards.
    """
    signals = _Signals()
    if threading.current_thread() is not threading.main_thread():
        yield signals
        return

    def note(number: int, frame: Any) -> None:
        signals.append(time.monotonic())
        signals.number = signal.Signals(number)
        if signals[-1] - signals[0] > 1 and not signals.patient:
            raise KeyboardInterrupt

    usual = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    if usual[signal.SIGTERM] is signal.SIG_IGN:
        del usual[signal.SIGTERM]
    for number in usual:
        signal.signal(number, note)
    try:
        yield signals
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler or signal.SIG_DFL)


def progress_bar(**options: Any) -> Any:
    """A bar on standard error that leaves nothing behind; None where that is no terminal."""
    if not sys.stderr.isatty():
        return None
    from tqdm import tqdm

    return tqdm(delay=1.0, leave=False, dynamic_ncols=True, **options)
