"""The time loop: a model's scheme stepped over a grid, every step verified, nothing lost when it stops."""

from __future__ import annotations

import hashlib
import platform
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.check.quick import UNIQUENESS, refuse_start, warnings_of
from nsmodel.check.rest import finite_convergence
from nsmodel.errors import StepError, StorageError, UsageError
from nsmodel.grid import Grid, make_grid
from nsmodel.model.base import Model
from nsmodel.model.inclusion import MonotoneInclusion
from nsmodel.model.oscillator import FrictionOscillator
from nsmodel.scheme import derived_columns, initial_rows, one_step_problem, shortened
from nsmodel.scheme.problem import OneStepProblem
from nsmodel.solve.build import Stepper
from nsmodel.solve.projection import CatchingUp
from nsmodel.solve.stepper import Warm
from nsmodel.solve.structure import is_monotone
from nsmodel.storage import ChunkStore
from nsmodel.trajectory import Trajectory

UNSET = -2  # Index-set code of a row that no step has computed.
CHUNK_BYTES = 64 << 20
FEW_STEPS = 8  # Different step sizes up to which constant matrices are factored once for each.


def make_stepper(
    model: Model, problem: OneStepProblem, solver: str, tolerance: float, *, h: float, state: np.ndarray, few_steps: bool = True
) -> Any:
    """Return the stepper of a bound model."""
    if isinstance(model, MonotoneInclusion):
        return CatchingUp(model, problem, solver, tolerance, h=h, state=state)
    return Stepper(problem, solver, tolerance, h=h, state=state, few_steps=few_steps)


def simulate(
    model: Model,
    *,
    step: float | None = None,
    steps: Sequence[float] | None = None,
    t_end: float | None = None,
    parameters: Mapping[str, float] | None = None,
    solver: str = "auto",
    tolerance: float = 1e-9,
    save_every: int = 1,
    out: str | Path | None = None,
    resume: bool = False,
    progress: bool = False,
) -> Trajectory:
    """Run a model and return its trajectory; every step in it was verified.

    Args:
        model: any of the five classes.
        step, steps, t_end: override the model's own grid.
        parameters: values of parameters by name.
        solver: "auto", or one solver to use alone ("qpoases", "qrqp", "daqp", "ipopt", "lemke", ...).
        tolerance: largest accepted residual (relative, without unit).
        save_every: keep every n-th row, and the last.
        out: folder for numbered chunks (constant memory), checkpoints and ``trajectory.npz``.
        resume: continue the run found in ``out``.
        progress: show a progress bar where standard error is a terminal.

    Raises:
        UsageError: a wrong argument, an unknown or inapplicable solver, a start outside the set.
        StepError: a step could not be verified; ``error.trajectory`` holds what was computed, saved in ``out`` if given.
        RunInterrupted: Ctrl-C; ``error.trajectory`` as above.
        StorageError: ``resume`` without a matching run.
    """
    if not 0 < tolerance < 1:
        raise UsageError(f"tolerance = {tolerance:g}; expected a number between 0 and 1")
    if isinstance(save_every, bool) or int(save_every) != save_every or save_every < 1:
        raise UsageError(f"save_every = {save_every!r}; expected a whole number >= 1")
    if resume and out is None:
        raise UsageError("resume needs out=, the folder of the run to continue")
    bound = model.bind(parameters)
    grid = make_grid(bound, step, steps, t_end)
    run = _Run(bound, grid, solver, tolerance, int(save_every), None if out is None else Path(out), resume)
    return run.go(progress)


def explain(
    model: Model, *, step: float | None = None, parameters: Mapping[str, float] | None = None, solver: str = "auto"
) -> str:
    """What a run would use and what it leaves out, and why, as text."""
    bound = model.bind(parameters)
    run = _Run(bound, make_grid(bound, step, None, None), solver, 1e-9, 1, None, False)
    return run.stepper.plan.text(run.problem)


class _Run:
    """One run: the stepper, the rows of the chunk being filled, the checkpoint."""

    def __init__(
        self, model: Model, grid: Grid, solver: str, tolerance: float, save_every: int, out: Path | None, resume: bool
    ) -> None:
        self.model, self.grid, self.save_every, self.out = model, grid, save_every, out
        refuse_start(model)
        self.problem = one_step_problem(model)
        known = initial_rows(model, grid.step(0))
        state = known[-1][0]
        if self.problem.start is not None:
            state = _start_state(self.problem.start, state, grid.step(0), tolerance)
        self.k = len(known) - 1
        few = grid.steps is None or np.unique(grid.steps).size <= FEW_STEPS
        self.stepper = make_stepper(model, self.problem, solver, tolerance, h=grid.step(0), state=state, few_steps=few)
        self.warnings = warnings_of(model, self.stepper.plan)
        self.layout = self.stepper.layout
        self.state, self.warm = state, self.stepper.cold()
        self.counts: Counter[str] = Counter()
        self.totals = {
            "worst_residual": 0.0, "worst_residual_t": None, "newton": 0.0, "newton_max": 0.0, "index_set_changes": 0, "steps": 0,
        }  # fmt: skip
        self.settings = {
            "hash": fingerprint(model, grid, solver, tolerance, save_every),
            "versions": versions(),
            "short_last_step": grid.last != grid.h,
        }
        width = 8 * (self.layout.width + 2) + self.stepper.cold().index.size
        total = grid.N // save_every + 2 + len(known)
        self.capacity = total if out is None else int(min(total, max(64, CHUNK_BYTES // max(width, 1))))
        self._chunks: list[dict[str, np.ndarray]] = []
        self._allocate()
        self.store = None if out is None else (ChunkStore.open(out) if resume else ChunkStore(out))
        if resume:
            self._restore()
        else:
            for k, (row_state, records) in enumerate(known):
                self._known_row(k, row_state, records)

    def _allocate(self) -> None:
        m = self.warm.index.size
        self.rows = np.full((self.capacity, self.layout.width), np.nan)
        self.index = np.full((self.capacity, m), UNSET, np.int8)
        self.t, self.h, self.h_next = (np.full(self.capacity, np.nan) for _ in range(3))
        self.number = np.zeros(self.capacity, int)
        self.filled = 0

    def _known_row(self, k: int, state: np.ndarray, records: dict[str, np.ndarray]) -> None:
        r = self.filled
        self.rows[r, : state.size] = state
        for name, value in records.items():
            self.rows[r, self.layout.slices[name]] = value
        self.t[r], self.h_next[r], self.number[r] = self.grid.time(k), self.grid.step(min(k, self.grid.N - 1)), k
        self.filled += 1

    def go(self, progress: bool) -> Trajectory:
        """Run to the end; on failure or Ctrl-C save what there is and say so."""
        bar = _bar(progress, self.k, self.grid.N)
        try:
            self._loop(bar)
        except StepError as error:
            error.step, error.time = self.k, self.grid.time(self.k) + self.grid.step(self.k)
            error.args = (f"step {self.k}: {error.args[0]}",)
            error.trajectory = self._finish("failed", str(error))
            raise
        except KeyboardInterrupt:
            raise RunInterrupted(self._finish("interrupted", f"interrupted at t = {self.grid.time(self.k):.10g}")) from None
        finally:
            if bar is not None:
                bar.close()
        return self._finish("done", "")

    def _loop(self, bar: Any) -> None:
        """The hot loop. Attributes are local here and written back when it ends, however it ends."""
        grid, step, every, N, totals, counts = self.grid, self.stepper, self.save_every, self.grid.N, self.totals, self.counts
        k, state, warm, residual_at, newton_at = self.k, self.state, self.warm, self.layout.residual, self.layout.newton
        state_at, constant, h = self.layout.state, grid.steps is None, grid.h
        worst, worst_k, newton, newton_max, changes, last_index = totals["worst_residual"], None, 0.0, 0.0, 0, warm.index
        by_index = isinstance(step, CatchingUp)
        try:
            while k < N:
                if constant:
                    t, h_k = k * h, h if k < N - 1 else grid.last
                else:
                    t, h_k = grid.time(k), grid.step(k)
                start = state if h_k == h or not constant or k == 0 else shortened(self.model, state, h_k / h)
                result = step(t, h_k, start, warm, k) if by_index else step(t, h_k, start, warm)
                row, warm, solver = result
                state = row[state_at]
                counts[solver] += 1
                if row[residual_at] > worst:
                    worst, worst_k = row[residual_at], k + 1
                if solver != "last index set":
                    newton += row[newton_at]
                    newton_max = max(newton_max, row[newton_at])
                    changes += not np.array_equal(warm.index, last_index)
                    last_index = warm.index
                k += 1
                if k % every == 0 or k == N:
                    r = self.filled
                    self.rows[r] = row
                    self.index[r], self.number[r] = warm.index, k
                    self.t[r], self.h[r] = grid.time(k), h_k
                    self.h_next[r] = h_k if constant or k == N else grid.step(k)
                    self.filled = r + 1
                    if self.filled == self.capacity and self.store is not None:
                        self.k, self.state, self.warm = k, state, warm
                        self._add(worst, worst_k, newton, newton_max, changes)
                        worst_k, newton, newton_max, changes = None, 0.0, 0.0, 0
                        self._flush("running", "")
                if bar is not None and k % 64 == 0:
                    bar.update(64)
        finally:
            self.k, self.state, self.warm = k, state, warm
            self._add(worst, worst_k, newton, newton_max, changes)

    def _add(self, worst: float, worst_k: int | None, newton: float, newton_max: float, changes: int) -> None:
        t = self.totals
        if worst_k is not None:
            t["worst_residual"], t["worst_residual_t"] = float(worst), self.grid.time(worst_k)
        t["newton"] += float(newton)
        t["newton_max"] = max(t["newton_max"], float(newton_max))
        t["index_set_changes"] += int(changes)
        t["steps"] = self.k

    def _columns(self) -> dict[str, np.ndarray]:
        """The filled rows as named arrays."""
        n, r, where = len(self.model.names), slice(0, self.filled), self.layout
        rows = self.rows[r]
        arrays = {"t": self.t[r].copy(), "x": rows[:, :n].copy()}
        s = where.slices
        arrays["multipliers"] = rows[:, s.get("multipliers", where.l)].copy()
        arrays["y"] = rows[:, s.get("outputs", where.y)].copy()
        arrays["index_set"] = self.index[r].copy()
        arrays["residual"], arrays["step"] = rows[:, where.residual].copy(), self.h[r].copy()
        if self.stepper.plan.path == "newton":
            arrays["newton"] = rows[:, where.newton].copy()
        for name, at in s.items():
            if name not in ("state", "l", "y", "residual", "newton", "multipliers", "outputs"):
                scalar = at.stop - at.start == 1 and name not in ("v", "gap", "defect", "selection")
                arrays[name] = rows[:, at.start].copy() if scalar else rows[:, at].copy()
        return arrays | derived_columns(self.model, arrays, self.h_next[r])

    def _note(self) -> None:
        """Keep of the filled rows what the end will ask for: the distance to the exact state, when an oscillator last moved."""
        if self.model.exact is not None:
            x, t = self.rows[: self.filled, : len(self.model.names)], self.t[: self.filled]
            exact = np.asarray(self.model.exact(t), float)
            if exact.shape != x.shape:
                raise UsageError(f"exact: it returned shape {exact.shape} for {t.size} times; expected {x.shape}")
            self.totals["largest_error"] = max(self.totals.get("largest_error", 0.0), float(np.abs(x - exact).max()))
        least = min(self.stepper.least_eigenvalue, self.totals.get("least_eigenvalue", np.inf))
        if np.isfinite(least):
            self.totals["least_eigenvalue"] = float(least)
        if isinstance(self.model, FrictionOscillator):
            rows, n = self.rows[: self.filled], len(self.model.names)
            v = rows[:, self.layout.slices["v"]]
            moving = np.flatnonzero((v != 0).any(axis=1) & np.isfinite(v).all(axis=1))
            if moving.size:
                self.totals["rest_from"] = None
            rest = moving[-1] + 1 if moving.size else 0
            if self.totals.get("rest_from") is None and rest < self.filled:
                self.totals["rest_from"] = [int(self.number[rest]), float(self.t[rest])]
            self.totals["last_x"] = rows[-1, :n].tolist()
            self.totals["last_v"] = [*self.totals.get("last_v", []), *v[-2:].tolist()][-2:]

    def _flush(self, status: str, message: str) -> None:
        """Write the filled rows as a chunk with the checkpoint to continue from, and start a new chunk."""
        self._note()
        checkpoint = {
            "k": self.k, "state": self.state.tolist(), "l": self.warm.l.tolist(), "index": self.warm.index.tolist(),
            "counts": dict(self.counts), "totals": self.totals, "settings": self.settings,
        }  # fmt: skip
        self.store.append(self._columns(), checkpoint, self._metadata(status, message))
        self._allocate()

    def _restore(self) -> None:
        """Take up the checkpoint of the run in ``out``; refuse another model, other settings, other versions."""
        saved = self.store.manifest["checkpoint"]
        for key, now in self.settings.items():
            if saved["settings"][key] != now and key != "short_last_step":
                what = {"hash": "another model, step or setting", "versions": "other versions"}[key]
                raise StorageError(
                    f"{self.out}: the run there was made with {what} ({saved['settings'][key]} != {now}); "
                    "start afresh without resume"
                )
        if saved["settings"]["short_last_step"] and saved["k"] >= self.grid.N:
            raise StorageError(f"{self.out}: the run there ended with a shortened step; it cannot be continued on the same grid")
        self.k = saved["k"]
        self.state = np.array(saved["state"], float)
        self.warm = Warm(np.array(saved["l"], float), np.array(saved["index"], np.int8))
        self.counts, self.totals = Counter(saved["counts"]), dict(saved["totals"])

    def _finish(self, status: str, message: str) -> Trajectory:
        if self.filled:
            self._note()
        metadata = self._metadata(status, message)
        if self.store is None:
            return Trajectory(self._columns(), metadata)
        if self.filled:
            self._flush(status, message)
        path = self.store.directory / "trajectory.npz"
        self.store.join(path, metadata)
        return Trajectory.load(path)

    def _lost_monotonicity(self) -> list[str]:
        least = self.totals.get("least_eigenvalue", np.inf)
        if not self.stepper.plan.monotone or is_monotone(least, self.warm.index.size):
            return []
        return [f"the one-step problem was not monotone all the time (least eigenvalue {least:.3g}): {UNIQUENESS}"]

    def _metadata(self, status: str, message: str) -> dict[str, Any]:
        model, plan = self.model, self.stepper.plan
        labels = [label for block in self.problem.law.blocks for label in [block.label] * block.size]
        data = {
            "title": model.title,
            "model_class": type(model).__name__,
            "scheme": self.problem.scheme,
            "paper": model.paper,
            "state_names": list(model.names),
            "stems": {stem: list(at) for stem, at in model.stems.items()},
            "multiplier_names": list(getattr(model, "multiplier_names", self.problem.rows)),
            "index_names": list(self.problem.rows),
            "law_kinds": labels,
            "units": dict(model.units),
            "parameters": dict(getattr(model, "bound_parameters", {})),
            "tolerance": self.stepper.tolerance,
            "save_every": self.save_every,
            "steps": self.totals["steps"],
            "used": list(plan.used),
            "left_out": list(plan.left_out),
            "solver_counts": dict(sorted(self.counts.items())),
            "totals": dict(self.totals),
            "warnings": [*self.warnings, *self._lost_monotonicity()],
            "status": status,
            "message": message,
            "model_hash": self.settings["hash"],
            "versions": self.settings["versions"],
        }
        if isinstance(model, FrictionOscillator) and "last_v" in self.totals:
            x, v = (np.array(self.totals[key]) for key in ("last_x", "last_v"))
            data["convergence"] = finite_convergence(model, x, v, self.totals["rest_from"])
        if getattr(model, "scene", None):
            data["scene"] = {key: value.tolist() for key, value in model.scene.items()}
            data["constraint_bodies"] = _bodies(model)
        return data


class RunInterrupted(KeyboardInterrupt):
    """Ctrl-C during a run; ``trajectory`` holds what was computed."""

    def __init__(self, trajectory: Trajectory) -> None:
        super().__init__(trajectory.metadata["message"])
        self.trajectory = trajectory


def _start_state(problem: OneStepProblem, state: np.ndarray, h: float, tolerance: float) -> np.ndarray:
    """(x_0, r_0): the multiplier at the start solves the law there."""
    stepper = Stepper(problem, "auto", tolerance, h=h, state=state)
    try:
        return stepper(0.0, h, state, stepper.cold()).row[stepper.layout.state]
    except StepError as error:
        raise UsageError(f"gamma < 1 needs a multiplier at the start, and the law has none there: {error}") from None


def _bodies(model: Any) -> list[list[int]]:
    """For each constraint of a planar scene, the discs whose coordinates it contains."""
    depends = ca.jacobian(model.g, model.q).sparsity()
    pairs = np.array(depends.get_triplet()).T
    return [sorted({int(column) // 2 for row, column in pairs if row == i}) for i in range(model.g.numel())]


def fingerprint(model: Model, grid: Grid, solver: str, tolerance: float, save_every: int) -> str:
    """A hash of all that a run's numbers depend on, t_end excepted: a run may be continued to a later end."""
    digest = hashlib.sha256(type(model).__name__.encode())

    def add(item: Any) -> None:
        if isinstance(item, ca.SX):
            digest.update(ca.Function("e", ca.symvar(item), [item]).serialize().encode())
        elif is_dataclass(item) and not isinstance(item, type):
            for field in fields(item):
                add(getattr(item, field.name))
        elif isinstance(item, Mapping):
            for key, value in item.items():
                digest.update(str(key).encode())
                add(value)
        elif isinstance(item, tuple | list):
            for value in item:
                add(value)
        elif isinstance(item, np.ndarray):
            digest.update(item.tobytes())
        elif isinstance(item, Callable):
            return
        else:
            digest.update(repr(item).encode())

    # What only names or describes the run does not enter, nor do the functions of the model file (exact, tolerances).
    skipped = {"exact", "title", "units", "scene", "t_end", "step", "steps", "t", "p", "parameters"}
    for name, value in sorted(vars(model).items()):
        if name not in skipped:
            digest.update(name.encode())
            add(value)
    add([grid.h, grid.steps if grid.steps is not None else "constant", solver, tolerance, save_every])
    return digest.hexdigest()[:16]


def versions() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    return {"nsmodel": version("nsmodel"), "casadi": ca.__version__, "numpy": np.__version__, "python": platform.python_version()}


def _bar(progress: bool, k: int, N: int) -> Any:
    if not (progress and sys.stderr.isatty()):
        return None
    from tqdm import tqdm

    return tqdm(total=N, initial=k, unit="step", delay=1.0, leave=False, dynamic_ncols=True)
