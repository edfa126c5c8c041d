"""Known times: at each a piece ends, and what is held is another after it."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

SAME_TIME = 4 * float(np.finfo(float).eps)  # Of a known time: an event that is as near is at it.


@dataclass(frozen=True)
class Known:
    """Times, increasing; ``data``: what the held states of the problem are just after one of them, None where none is held."""

    times: Sequence[float] = ()
    data: Callable[[float], list[float]] | None = None

    def next(self, t: float) -> float:
        """The first of the times after t, infinite where there is none."""
        k = bisect_right(self.times, t)
        return self.times[k] if k < len(self.times) else math.inf

    def after(self, t: float, x: list[float]) -> list[float]:
        """The state x at t with what is held after it, where t is one of the times."""
        if self.data is None or self.next(np.nextafter(t, -math.inf)) != t:
            return x
        held = self.data(t)
        return [*x[: len(x) - len(held)], *held]

    @property
    def table(self) -> tuple[np.ndarray, np.ndarray]:
        """0 and the times after it (K,), and what is held after each (K, held)."""
        times = [0.0, *(t for t in self.times if t > 0)]
        return np.array(times), np.array([[] if self.data is None else self.data(t) for t in times])


def reaches(t: float, known: float) -> bool:
    """Whether t is at a known time, to rounding, or beyond."""
    return known < math.inf and t >= known * (1 - SAME_TIME)
