"""What counts say of a probability, and ranks of a quantile, whatever the distribution: by the binomial law."""

from __future__ import annotations

import functools
from bisect import bisect_left, bisect_right

import numpy as np
from scipy.special import bdtr, ndtri


def wilson_interval(holds: np.ndarray, count: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Interval of a probability of which `holds` of `count` independent draws show: (low, high), both in [0, 1].

    The set of p with |holds/count - p| <= z sqrt(p (1 - p) / count) (Wilson 1927). Its coverage is near the level for p away
    from 0 and 1, above and below by turns (Brown, Cai and DasGupta 2001, section 3.1.1). Of no draws: (0, 1).
    """
    holds, n = np.asarray(holds, dtype=float), np.asarray(count, dtype=float)
    z2 = float(ndtri((1 + level) / 2)) ** 2
    centre = (holds + z2 / 2) / (n + z2)
    half = np.sqrt(z2 * (holds * (n - holds) / np.maximum(n, 1) + z2 / 4)) / (n + z2)
    low, high = np.clip(centre - half, 0, 1), np.clip(centre + half, 0, 1)
    return np.where(holds == 0, 0.0, low), np.where(holds == n, 1.0, high)


@functools.lru_cache(maxsize=4096)
def quantile_interval_ranks(count: int, q: float, level: float) -> tuple[int, int, float]:
    """Ranks r, s whose values X_(r) <= X_(s) hold the quantile q of any distribution between them, and how surely.

    With B ~ Bin(count, q): r is the largest with P(B < r) <= (1 - level)/2, s the smallest with P(B >= s) <= (1 - level)/2, and
    P(X_(r) <= x_q <= X_(s)) >= P(r <= B < s), with equality where the distribution is continuous (David and Nagaraja,
    Order Statistics, 2003, section 7.1). r = 0 and s = count + 1 stand for -inf and inf: count is too small for this end.

    >>> low, high, reached = quantile_interval_ranks(20, 0.5, 0.95)
    >>> low, high, round(reached, 4)
    (6, 15, 0.9586)
    >>> quantile_interval_ranks(20, 0.05, 0.95)[:2]
    (0, 4)
    """

    def below(k: int) -> float:
        return float(bdtr(k, count, q))

    if count == 0:
        return 0, 1, 1.0
    tail = (1 - level) / 2
    r = bisect_right(range(count + 1), tail, key=below)
    s = bisect_left(range(count + 1), 1 - tail, key=below) + 1
    return r, s, below(s - 1) - (below(r - 1) if r else 0.0)


def median_ranks(count: int, q: float) -> tuple[int, int]:
    """Ranks whose mean estimates the quantile q: one value, two where q count is whole (Hyndman and Fan 1996, definition 2)."""
    place = q * count
    whole = round(place)
    if abs(place - whole) <= 1e-12 * count:
        return max(whole, 1), min(whole + 1, count)
    return int(np.ceil(place)), int(np.ceil(place))
