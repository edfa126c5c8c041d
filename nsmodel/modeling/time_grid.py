"""Time grids of a run.

Times of edges of inputs are exact in a grid; lengths that are the same to SAME_STEP_TOLERANCE are one length, which is a matter
of matrices. A PWM whose duty is held has known periods and edges that move: the grid has a fixed number of steps a period,
whose times are placed when it begins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nsmodel._utils import MIN_TOLERANCE, cached_per_object_and_key
from nsmodel.errors import UsageError
from nsmodel.modeling.base import Model
from nsmodel.modeling.parameters import step_array
from nsmodel.modeling.signals.schedule import InputSchedule

# Relative: a length that is so near to a whole number of steps is that many: users write 0.1 for 1/10, and 0.333333333.
WHOLE_STEPS = 1e-9
HIT_TOLERANCE = 1e-9  # Relative: a step that ends so near to an edge ends there: given steps are sums of decimals.
# Part of a run: rows of two runs that are nearer than this are at one time: 4500 EPS, more than times of a usual run err by.
SAME_TIME_SHARE = 1e-12
# Lengths that differ by less than this part have one matrix, which changes by as little; times stay as they are.
SAME_STEP_TOLERANCE = 1e-12


@dataclass(frozen=True)
class TimeGrid:
    """N steps: t_k = k h with a shorter last step where T/h is not whole within 1e-9, or given steps and their sums.

    ``drive``: the inputs along it; ``asked``: the longest step, where the grid was made for their edges; ``any_step``: steps of
    other lengths are taken too.
    """

    N: int
    h: float
    last: float
    steps: np.ndarray | None = None
    times: np.ndarray | None = None
    requested_step: float | None = None
    drive: InputSchedule | None = None
    any_step: bool = False

    @property
    def lengths(self) -> np.ndarray:
        """The lengths of its steps, each once; a shorter last one counts where steps are given."""
        return np.array([self.h]) if self.steps is None else np.unique(self.steps)

    @property
    def has_varying_steps(self) -> bool:
        """Whether steps have several lengths."""
        return self.any_step or self.lengths.size > 1

    def halved(self) -> TimeGrid:
        """The grid that halves each step, the times of this one among its own; of a shorter last step what is left is last."""
        if self.steps is None or self.times is None:
            h, whole = self.h / 2, self.last > self.h / 2
            last = h if self.last == self.h else self.last - h if whole else self.last
            return replace(self, N=2 * self.N - (not whole), h=h, last=last)
        times = np.repeat(self.times, 2)[:-1]
        times[1::2] += self.steps / 2
        longest = None if self.requested_step is None else self.requested_step / 2
        halves = np.repeat(self.steps / 2, 2)
        return replace(self, N=halves.size, h=self.h / 2, last=self.last / 2, steps=halves, times=times, requested_step=longest)

    def step(self, k: int) -> float:
        """h_k = t_{k+1} - t_k."""
        if self.steps is not None:
            return float(self.steps[k])
        return self.h if k < self.N - 1 else self.last

    def time(self, k: int) -> float:
        """t_k, not accumulated when the step is constant."""
        if self.times is not None:
            return float(self.times[k])
        return k * self.h if k < self.N or self.last == self.h else (self.N - 1) * self.h + self.last

    def between(self, k: int, last: int) -> np.ndarray:
        """t_k, ..., t_last."""
        if self.times is not None:
            return self.times[k : last + 1]
        return np.append(np.arange(k, last) * self.h, self.time(last))

    def around(self, rows: np.ndarray) -> tuple[Any, Any, Any]:
        """The times of these rows, the steps that end there and those that start there; no row is that of a shortened step."""
        if self.steps is None or self.times is None:
            return rows * self.h, self.h, self.h
        return self.times[rows], self.steps[rows - 1], self.steps[np.minimum(rows, self.N - 1)]


EVENT_DRIVEN_GRID = TimeGrid(1, 1.0, 1.0)  # Of runs that have no steps.


def count_equal_steps(lengths: np.ndarray, h: float) -> np.ndarray:
    """How many equal steps, not longer than h, are of these lengths together."""
    return np.maximum(np.ceil(lengths / h * (1 - WHOLE_STEPS)), 1).astype(int)


def subdivide_intervals(ends: np.ndarray, counts: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """When so many equal steps from one end to the next begin, and how long they are: h, where that is nearly so."""
    lengths = np.diff(ends) / counts
    part = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.repeat(ends[:-1], counts) + np.repeat(lengths, counts) * part, np.repeat(_merge_equal_lengths(lengths, h), counts)


def _grid_between_ends(ends: np.ndarray, h: float, more: int) -> TimeGrid:
    """Equal steps, not longer than h, from one end to the next, and so many more; those of nearly one length have one."""
    times, steps = subdivide_intervals(ends, count_equal_steps(np.diff(ends), h) + more, h)
    times = np.append(times, ends[-1])
    return TimeGrid(steps.size, float(steps[0]), float(steps[-1]), steps, times, requested_step=h, any_step=more > 0)


def _merge_equal_lengths(lengths: np.ndarray, h: float) -> np.ndarray:
    """Lengths, each that of the least one that it is nearly the same as; h where it is nearly that."""
    known, where = np.unique(np.where(np.abs(lengths - h) <= SAME_STEP_TOLERANCE * h, h, lengths), return_inverse=True)
    begins = np.append(True, known[1:] > known[:-1] * (1 + SAME_STEP_TOLERANCE))
    return known[begins][np.cumsum(begins) - 1][where]


def make_grid(
    model: Model, step: float | None, steps: Sequence[float] | None, t_end: float | None, *, driven: bool = False
) -> TimeGrid:
    """Return the grid of a run; ``step``, ``steps`` and ``t_end`` override the model's own; ``driven``: by the model's inputs.

    Raises:
        UsageError: not finite, not positive, contradictory, or missing.
    """
    check_times(step=step, t_end=t_end)
    if step is not None and steps is not None:
        raise UsageError("step and steps are both given; keep one")
    steps = model.steps if steps is None and step is None else steps
    if steps is not None:
        array = step_array(steps, UsageError)
        if t_end is not None:
            raise UsageError("t_end is given with steps, which already say where the run ends; leave it out")
        times = np.concatenate([[0.0], np.cumsum(array)])
        drive = input_schedule(model, float(times[-1])) if driven else None
        if drive is not None and drive.moving:
            raise UsageError(
                "steps: a block places edges of a pwm, at times not known in advance, where a step must end; give step= instead"
            )
        if drive is not None:
            _check_edges_hit(times, drive.points)
        return _with_schedule(TimeGrid(array.size, float(array[0]), float(array[-1]), array, times), drive)
    h = model.step if step is None else float(step)
    if h is None:
        raise UsageError("no time step: give the model step=, or the run step=H (--step H)")
    T = float(model.t_end if t_end is None else t_end)
    ratio = T / h
    if ratio < 1 - WHOLE_STEPS:
        raise UsageError(f"step = {h:g} is longer than the run, which ends at t_end = {T:g}; choose a step of at most {T:g}")
    if ratio > 1e12:
        raise UsageError(f"t_end / step = {ratio:.3g} steps; choose a larger step or a shorter run")
    drive = input_schedule(model, T) if driven else None
    if drive is not None and (drive.points.size or drive.moving):
        return _with_schedule(_grid_between_ends(np.concatenate([[0.0], drive.points, [T]]), h, drive.moving), drive)
    N = max(round(ratio), 1)
    if abs(ratio - N) <= WHOLE_STEPS * N:
        return _with_schedule(TimeGrid(N, h, h), drive)
    N = int(np.floor(ratio)) + 1
    return _with_schedule(TimeGrid(N, h, T - (N - 1) * h), drive)


@cached_per_object_and_key(most=4)
def input_schedule(model: Model, t_end: float) -> InputSchedule:
    """What drives a model up to t_end; ModelError where a signal is none up to there."""
    return InputSchedule.of(model.inputs, t_end, [block.ticks(t_end) for block in model.blocks])


def _with_schedule(grid: TimeGrid, drive: InputSchedule | None) -> TimeGrid:
    """The grid with what drives along it, which must have as many steps as that says."""
    if drive is None:
        return grid
    drive.check_step_counts(grid.N)
    return replace(grid, drive=drive)


def _check_edges_hit(times: np.ndarray, points: np.ndarray) -> None:
    """Refuse given steps of which one goes over an edge of an input."""
    k = np.searchsorted(times, points)
    off = np.minimum(np.abs(times[np.minimum(k, len(times) - 1)] - points), np.abs(times[np.maximum(k - 1, 0)] - points))
    for i in np.flatnonzero(off > HIT_TOLERANCE * np.abs(points))[:1]:
        raise UsageError(
            f"steps: step {k[i] - 1} goes over t = {points[i]:.10g}, where an input jumps or bends, or a block ticks; "
            "let a step end there, or give step= instead: its grid ends at each"
        )


def check_times(**times: Any) -> None:
    """Refuse a time, given by its name, that is neither None nor a finite number > 0."""
    for name, value in times.items():
        if value is not None and not (is_number(value) and 0 < value < np.inf):
            raise UsageError(f"{name} = {format_value(value)}; expected a finite number > 0")


def check_tolerance(tolerance: Any) -> None:
    """Refuse what is no largest accepted residual."""
    if not (is_number(tolerance) and MIN_TOLERANCE <= tolerance < 1):
        raise UsageError(
            f"tolerance = {format_value(tolerance)}; expected a number between {MIN_TOLERANCE:g} and 1: "
            "doubles hold no more than 16 digits"
        )


def is_number(value: Any) -> bool:
    """Whether a value is a real number that a double can hold; True and False are not."""
    if isinstance(value, int) and not isinstance(value, bool):
        return abs(value) <= int(np.finfo(float).max)
    return isinstance(value, float | np.floating | np.integer)


def format_value(value: Any) -> str:
    """A value as a message shows it."""
    return f"{value:g}" if is_number(value) else repr(value)[:60]
