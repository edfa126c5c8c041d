"""A piece of a run: polynomials of x, l and y in one mode, and what is known of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class StartEvent(NamedTuple):
    """The event that a piece begins after: the impulse p of its jump, 0 where there is none; how well its time is known.

    ``width``: the time about it in which the sign of what ends there is not known, 0 of a simple root.
    """

    impulse: tuple[float, ...]
    width: float = 0.0


class Piece(NamedTuple):
    """x, l and y on t + tau [0, s], as coefficients of (time - t)/tau: (n, p + 1), (m, p + 1), (m, p + 1); ``codes`` of the rows.

    ``last`` is x at the end, to rounding on what ends the piece; ``event`` is None where the mode goes on as before. ``residual``
    is that of a verified time step where the piece is half of one: x on a straight line or a parabola, l and y constant; else
    None.
    """

    t: float
    tau: float
    s: float
    x: np.ndarray
    l: np.ndarray
    y: np.ndarray
    codes: tuple[int, ...]
    defect: float
    last: list[float]
    event: StartEvent | None
    residual: float | None = None

    @property
    def end(self) -> float:
        """The last time."""
        return self.t + self.tau * self.s

    def moved(self, t: float, x: list[float], error: float) -> Piece:
        """The piece with its end there, where that is one."""
        return self._replace(s=(t - self.t) / self.tau, last=list(x), defect=error) if t > self.t else self
