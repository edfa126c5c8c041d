"""A refined run between its rows: a straight line where that is as good as the run itself, else a step from the row before.

Where a state jumps (at the start of a circuit whose capacitors do not agree, at an impact) or bends, the line between two rows is
nothing that the run ever was. There the scheme takes one step from the row before to the very time that is asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nsmodel.classes.registry import class_of
from nsmodel.errors import StepError
from nsmodel.grid import input_schedule
from nsmodel.model.driven import block_input_entries
from nsmodel.run.driven import reinitialised_step_mask
from nsmodel.run.on_grid import FixedGridPropagator
from nsmodel.run.schemes import make_stepper
from nsmodel.trajectory import Trajectory

MAX_SINGLE_STEPS = 300  # Steps that are taken for one question; what is left stays on its line, or is not known.
EQUAL_TIME_TOLERANCE = 1e-12  # Of the run: times that are nearer than this are one.

StateAt = Callable[[int, float], np.ndarray]  # (row, h) -> what a step of h from there starts from
StepFromRow = Callable[
    [int, float], np.ndarray
]  # (row, h) -> the states (n,) a step of h after it; NaN where there is no such step


@dataclass(frozen=True)
class InterpolatedRun:
    """The states of a run at any time: t (N+1,) and x (N+1, n) its rows, ``step`` from a row; ``scale`` (n,) of the states.

    ``good`` is the error that a line may have beside ``scale``.
    """

    t: np.ndarray
    x: np.ndarray
    step: StepFromRow
    scale: np.ndarray
    good: float

    def interpolation_errors(self) -> np.ndarray:
        """How far each line is from the run at most, beside the scale (N,).

        An eighth of the second difference where the run is smooth; where it is not, neighbouring ones differ by the jump itself.
        """
        h = np.diff(self.t)[:, None]
        slope_changes = np.diff(np.diff(self.x, axis=0) / h, axis=0) / self.scale
        if not len(slope_changes):
            return np.zeros(len(h))
        before, after = (
            2 * slope_changes[[i]] - slope_changes[[j]]
            for i, j in ((0, min(1, len(slope_changes) - 1)), (-1, -min(2, len(slope_changes))))
        )
        slope_changes = np.concatenate([before, slope_changes, after])
        size = np.maximum(np.abs(slope_changes[:-1]), np.abs(slope_changes[1:])) / 8 + np.abs(np.diff(slope_changes, axis=0))
        return (h * size).max(axis=1)

    def __call__(self, times: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the states (k, n) at ``times``, and the largest error of the lines that are left."""
        x = np.column_stack([np.interp(times, self.t, column) for column in self.x.T])
        row = np.clip(np.searchsorted(self.t, times, side="right") - 1, 0, len(self.t) - 2)
        ahead = times - self.t[row]
        here = np.minimum(ahead, self.t[row + 1] - times) <= 1e-9 * (self.t[row + 1] - self.t[row])  # a row of the run
        bend = np.where(here, 0.0, self.interpolation_errors()[row])
        for k in np.argsort(-bend, kind="stable")[:MAX_SINGLE_STEPS]:
            if not bend[k] > self.good:
                break
            found = self.step(int(row[k]), float(ahead[k]))
            if np.isfinite(found).all():
                x[k], bend[k] = found, 0.0
        return x, float(bend.max(initial=0.0))


@dataclass(frozen=True)
class RunAtRows:
    """The states of a run with inputs: t (N+1,) and x (N+1, n) its rows, ``step`` from a row.

    At an edge it bends, and no line from row to row tells by how much: at times that are no rows it is known by steps alone.
    """

    t: np.ndarray
    x: np.ndarray
    step: StepFromRow

    def __call__(self, times: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the states (k, n) at ``times``, NaN where they are not known, and what they err by besides the run."""
        near = EQUAL_TIME_TOLERANCE * self.t[-1]
        row = np.searchsorted(self.t, times + near, side="right") - 1
        x, ahead = self.x[row].copy(), times - self.t[row]
        between = np.flatnonzero(ahead > near)
        x[between] = np.nan
        for k in between[np.linspace(0, between.size - 1, min(MAX_SINGLE_STEPS, between.size)).astype(int)]:
            x[k] = self.step(int(row[k]), float(ahead[k]))
        return x, 0.0


def make_row_stepper(run: FixedGridPropagator, start: np.ndarray, made: Trajectory) -> StepFromRow:
    """Return the step from the rows of a run that was ``made`` by ``run``, whose packed state at the start was ``start``."""
    model, n = run.model, len(run.model.names)
    part = class_of(model).optional("study")
    own = start[: start.size - 2 * model.u.numel()]
    state_at = part.states(model, made, own) if part is not None else lambda row, h: made.x[row]
    state_at = _states_with_inputs(run, made, state_at) if model.u.numel() else state_at
    stepper = make_stepper(run.model, "auto", run.stepper.tolerance, h=run.grid.step(0), state=start, few_steps=False)

    def step(row: int, h: float) -> np.ndarray:
        try:
            return stepper(float(made.t[row]), h, state_at(row, h), stepper.cold_start(), row).row[stepper.layout.state][:n]
        except StepError:
            return np.full(n, np.nan)

    return step


def _states_with_inputs(run: FixedGridPropagator, made: Trajectory, state_at: StateAt) -> StateAt:
    """The states with the inputs at both ends of the step behind them; after a jump with the reaction of the law there."""
    model, reinitialised, held = run.model, reinitialised_step_mask(run.model, made), block_input_entries(run.model)
    drive = input_schedule(model, float(made.t[-1]))

    def state(row: int, h: float) -> np.ndarray:
        t, begin = float(made.t[row]), made.inputs_begin[row + 1]
        end = drive.limits(np.array([t, min(t + h, made.t[row + 1])]))[0, begin.size :]
        end[held] = begin[held]
        given = np.concatenate([state_at(row, h), begin, end])
        return given if run.starter is None or not reinitialised[row] else run.starter(t, h, given)

    return state
