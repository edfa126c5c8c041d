"""Time grids of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nsmodel.errors import UsageError
from nsmodel.model.arguments import step_array
from nsmodel.model.base import Model


@dataclass(frozen=True)
class Grid:
    """N steps: t_k = k h with a shorter last step where T/h is not whole within 1e-9, or given steps and their sums."""

    N: int
    h: float
    last: float
    steps: np.ndarray | None = None
    times: np.ndarray | None = None

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

    def around(self, rows: np.ndarray) -> tuple[Any, Any, Any]:
        """The times of these rows, the steps that end there and those that start there; no row is that of a shortened step."""
        if self.steps is None or self.times is None:
            return rows * self.h, self.h, self.h
        return self.times[rows], self.steps[rows - 1], self.steps[np.minimum(rows, self.N - 1)]


def make_grid(model: Model, step: float | None, steps: Sequence[float] | None, t_end: float | None) -> Grid:
    """Return the grid of a run; ``step``, ``steps`` and ``t_end`` override the model's own.

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
        return Grid(array.size, float(array[0]), float(array[-1]), array, np.concatenate([[0.0], np.cumsum(array)]))
    h = model.step if step is None else float(step)
    if h is None:
        raise UsageError("no time step: give the model step=, or the run step=H (--step H)")
    T = float(model.t_end if t_end is None else t_end)
    ratio = T / h
    if ratio > 1e12:
        raise UsageError(f"t_end / step = {ratio:.3g} steps; choose a larger step or a shorter run")
    N = max(round(ratio), 1)
    if abs(ratio - N) <= 1e-9 * N:
        return Grid(N, h, h)
    N = int(np.floor(ratio)) + 1
    return Grid(N, h, T - (N - 1) * h)


def check_times(**times: Any) -> None:
    """Refuse a time, given by its name, that is neither None nor a finite number > 0."""
    for name, value in times.items():
        if value is not None and not (is_number(value) and 0 < value < np.inf):
            raise UsageError(f"{name} = {written(value)}; expected a finite number > 0")


def is_number(value: Any) -> bool:
    """Whether a value is a real number that a double can hold; True and False are not."""
    if isinstance(value, int) and not isinstance(value, bool):
        return abs(value) <= int(np.finfo(float).max)
    return isinstance(value, float | np.floating | np.integer)


def written(value: Any) -> str:
    """A value as a message shows it."""
    return f"{value:g}" if is_number(value) else repr(value)[:60]
