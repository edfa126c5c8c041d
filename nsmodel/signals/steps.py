"""One value for each step of a constant grid: what an optimiser or a recorded controller gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from nsmodel.brief import short_repr
from nsmodel.signals.bounds import SignalJump, Within
from nsmodel.signals.signal import Signal, constant_bounds, read_numbers


@dataclass(frozen=True, eq=False)
class Steps(Signal):
    """Values (N, nu), a row a step; see `steps`."""

    values: np.ndarray

    __repr__ = short_repr

    @property
    def size(self) -> int:
        """Its columns."""
        return self.values.shape[1]

    @property
    def count(self) -> int:
        """Its rows."""
        return len(self.values)

    @property
    def jump_steps(self) -> np.ndarray:
        """Those whose row is another than the one before."""
        return np.flatnonzero((np.diff(self.values, axis=0) != 0).any(axis=1)) + 1

    def in_time(self, tau: float) -> Self:
        """The same: it knows steps, and no time."""
        del tau
        return self

    def within(self, t_end: float) -> Within:
        """The least and the largest of each column."""
        del t_end
        low, high = self.values.min(axis=0), self.values.max(axis=0)
        return constant_bounds(low) if (low == high).all() else Within(low, high, None, self.values[0])

    def jump(self, t_end: float) -> SignalJump | None:
        """The largest change from a step to the next, of equal steps."""
        size = np.abs(np.diff(self.values, axis=0)).max(axis=1, initial=0.0)
        k = int(size.argmax()) if size.size else 0
        return SignalJump(t_end * (k + 1) / self.count, *self.values[k : k + 2]) if size.any() else None

    def limits(self, t: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
        """The rows of the steps."""
        rows = self.values[number : number + t.size - 1]
        return rows, rows


def steps(values: Any) -> Steps:
    """A signal that is held over each step of the run's grid: values (N,), or (N, nu), a row a step.

    The grid is that of the run's step; edges of other inputs must not add steps to it.

    Raises:
        ModelError: NaN, another shape. When a run begins, UsageError: another number of rows than steps.
    """
    given = read_numbers("steps", "values", values, 1, 2)
    return Steps(given.reshape(len(given), -1))
