"""Known times: at each a piece ends, and what is held is another after it."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

SAME_TIME = 4 * float(np.finfo(float).eps)  # Of a known time: an event that is as near is at it.


@dataclass(frozen=True)
class SwitchTimes:
    """Times, increasing.

    ``data``: what the held states of the problem are just after one of them, of the state there; None where none is held.
    ``moving``: the first time after t that what is held places, of t and the state.
    """

    times: Sequence[float] = ()
    data: Callable[[float, list[float] | None], list[float]] | None = None
    moving: Callable[[float, list[float]], float] | None = None

    def next(self, t: float, x: list[float]) -> float:
        """The first of the times after t, where the state is x; infinite where there is none."""
        k = bisect_right(self.times, t)
        first = self.times[k] if k < len(self.times) else math.inf
        moved = math.inf if self.moving is None else self.moving(t, x)
        return moved if moved < first * (1 - SAME_TIME) else first

    def after(self, t: float, x: list[float]) -> list[float]:
        """The state x at t with what is held after it, where t is one of the times, or may be."""
        if self.data is None or (self.moving is None and self.next(np.nextafter(t, -math.inf), x) != t):
            return x
        held = self.data(t, x)
        return [*x[: len(x) - len(held)], *held]

    @property
    def table(self) -> tuple[np.ndarray, np.ndarray]:
        """0 and the times after it (K,), and what is held after each (K, held)."""
        times = [0.0, *(t for t in self.times if t > 0)]
        return np.array(times), np.array([[] if self.data is None else self.data(t, None) for t in times])


def reaches_time(t: float, known: float) -> bool:
    """Whether t is at a known time, to rounding, or beyond."""
    return known < math.inf and t >= known * (1 - SAME_TIME)
