"""Where a step has led."""

from __future__ import annotations

import numpy as np

from nsmodel.solve.layout import RowLayout


class Row:
    """Where a step has led: its time, and what is read off the row that it has made."""

    __slots__ = ("_layout", "_packed", "_states", "index_set", "t")

    def __init__(self, t: float, packed: np.ndarray, index_set: np.ndarray, layout: RowLayout, states: int) -> None:
        self.t, self.index_set = t, index_set
        self._packed, self._layout, self._states = packed, layout, states

    @property
    def x(self) -> np.ndarray:
        """The state (n,)."""
        return self._packed[: self._states]

    @property
    def multipliers(self) -> np.ndarray:
        """The multipliers (m,), as they are declared."""
        return self._quantity("multipliers", "l")

    @property
    def y(self) -> np.ndarray:
        """The outputs of the law (m,)."""
        return self._quantity("outputs", "y")

    @property
    def residual(self) -> float:
        """That of the step."""
        return float(self._packed[self._layout.residual])

    @property
    def inputs(self) -> np.ndarray:
        """The inputs (nu,) at the end of the step."""
        both = self._packed[self._layout.inputs]
        return both[both.size // 2 :]

    def _quantity(self, name: str, else_of: str) -> np.ndarray:
        slices = self._layout.slices
        return self._packed[slices.get(name, slices[else_of])]

    def __repr__(self) -> str:
        """The time, the state, the residual."""
        return f"Row(t={self.t:.10g}, x={self.x}, residual={self.residual:.2g})"
