"""Known times: which is the next, and when a run is at it."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence

import numpy as np

SAME_TIME = 4 * float(np.finfo(float).eps)  # Of a known time: an event that is as near is at it.


def next_known(times: Sequence[float], t: float) -> float:
    """The first of the times after t, infinite where there is none."""
    k = bisect_right(times, t)
    return times[k] if k < len(times) else math.inf


def reaches(t: float, known: float) -> bool:
    """Whether t is at a known time, to rounding, or beyond."""
    return known < math.inf and t >= known * (1 - SAME_TIME)
