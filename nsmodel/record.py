"""The rows of a run that are in memory, and their columns by name."""

from __future__ import annotations

from typing import Any

import numpy as np

from nsmodel.model.base import Model
from nsmodel.scheme import derived_columns
from nsmodel.solve.layout import Layout

UNSET = -2  # Index-set code of a row that no step has computed.
INNER = frozenset({"state", "l", "y", "residual", "newton", "multipliers", "outputs"})
VECTORS = frozenset({"v", "gap", "defect", "selection"})  # Two-dimensional even where they have one column.


class Record:
    """Packed rows (see `solve.layout`), index sets and times; ``capacity`` rows, then it is ``full`` and must be cleared."""

    def __init__(self, model: Model, layout: Layout, m: int, capacity: int) -> None:
        self.model, self.layout = model, layout
        self.rows = np.full((capacity, layout.width), np.nan)
        self.index = np.full((capacity, m), UNSET, np.int8)
        self.t, self.h, self.h_next = (np.full(capacity, np.nan) for _ in range(3))
        self.number = np.zeros(capacity, int)
        self.clear()

    def clear(self) -> None:
        """Forget the rows."""
        self.filled, self.full = 0, False

    def known(self, k: int, t: float, h_next: float, state: np.ndarray, records: dict[str, np.ndarray]) -> None:
        """Add a row that no step computed: the start."""
        r = self.filled
        self.rows[r] = np.nan
        self.rows[r, : state.size] = state
        for name, value in records.items():
            self.rows[r, self.layout.slices[name]] = value
        self._close(k, t, np.nan, h_next)

    def add(self, k: int, t: float, h: float, h_next: float, row: np.ndarray, index: np.ndarray) -> None:
        """Add the row k that the step h has reached at t; ``h_next`` starts there."""
        self.rows[self.filled] = row
        self.index[self.filled] = index
        self._close(k, t, h, h_next)

    def _close(self, k: int, t: float, h: float, h_next: float) -> None:
        r = self.filled
        self.t[r], self.h[r], self.h_next[r], self.number[r] = t, h, h_next, k
        self.filled = r + 1
        self.full = self.filled == len(self.t)

    @property
    def states(self) -> np.ndarray:
        """The model's state in each row (rows, n)."""
        return self.rows[: self.filled, : len(self.model.names)]

    def column(self, name: str) -> np.ndarray:
        """One quantity of the layout in each row (rows, size)."""
        return self.rows[: self.filled, self.layout.slices[name]]

    def columns(self, newton: bool) -> dict[str, np.ndarray]:
        """The rows as the arrays of a trajectory; ``newton``: with the iterations of each step."""
        r, slices = slice(0, self.filled), self.layout.slices
        arrays: dict[str, Any] = {
            "t": self.t[r].copy(),
            "x": self.states.copy(),
            "multipliers": self.column("multipliers" if "multipliers" in slices else "l").copy(),
            "y": self.column("outputs" if "outputs" in slices else "y").copy(),
            "index_set": self.index[r].copy(),
            "residual": self.rows[r, self.layout.residual].copy(),
            "step": self.h[r].copy(),
        }
        if newton:
            arrays["newton"] = self.rows[r, self.layout.newton].copy()
        for name, at in slices.items():
            if name not in INNER:
                values = self.column(name).copy()
                arrays[name] = values[:, 0] if at.stop - at.start == 1 and name not in VECTORS else values
        return arrays | derived_columns(self.model, arrays, self.h_next[r])
