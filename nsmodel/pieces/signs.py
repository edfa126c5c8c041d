"""How far below 0 a polynomial with intervals as coefficients can come on [-1, 1], and where it is not proved to be >= 0.

The least coefficient in the Bernstein basis of a cell bounds a polynomial there from below. Cells become shorter towards both
ends, by halves, about which the polynomial is expanded: near a root at an end it is known to the rounding of what it is there.
"""

from __future__ import annotations

from fractions import Fraction
from functools import cache
from math import comb

import numpy as np

from nsmodel.pieces.bernstein import taylor_shift
from nsmodel.pieces.enclosures import IntervalCoefficients
from nsmodel.proof.interval_number import Interval

HALVINGS, CUTS = 48, 4  # Cells [2^-j, 2^(1-j)], each cut so often.
EPS = np.finfo(float).eps


def polynomial_lower_bounds(c: IntervalCoefficients, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Lower bounds (2, count) on [-1, 0] and [0, 1], and how far from -1 and from 1 a sign >= 0 is not proved (0: proved)."""
    c = [Interval(*(np.broadcast_to(end, count) for end in (a.lo, a.hi))) for a in c]
    low = (c[0].lo - (1 + len(c) * EPS) * sum((a.magnitude for a in c[1:]), np.zeros(count))) * (1 - EPS)
    low, reach = np.stack([low, low]), np.zeros((2, count))
    rest = np.flatnonzero(~(low[0] > 0))
    if not rest.size:
        return low, reach
    c = [Interval(a.lo[rest], a.hi[rest]) for a in c]
    for end in (0, 1):
        local = taylor_shift([-a if end and k % 2 else a for k, a in enumerate(c)], -1.0)
        low[end, rest], reach[end, rest] = _lower_bounds_towards_0(local)
    return low, reach


def _lower_bounds_towards_0(c: list[Interval]) -> tuple[np.ndarray, np.ndarray]:
    """The same on [0, 1], with the distance from 0."""
    n = len(c) - 1
    lo, hi = (np.stack([getattr(a, end) for a in c], axis=1) for end in ("lo", "hi"))
    middle = lo / 2 + hi / 2
    radius = np.maximum(hi - middle, middle - lo) * (1 + EPS) + 1e-320
    least, reach = np.full(len(lo), np.inf), np.zeros(len(lo))
    cells = [(2.0**-j, k) for j in range(1, HALVINGS + 1) for k in range(CUTS)] + [(2.0**-HALVINGS, -1)]
    for scale, k in cells:
        matrix = (
            _bernstein_matrix(n, 1 + Fraction(k, CUTS), 1 + Fraction(k + 1, CUTS))
            if k >= 0
            else _bernstein_matrix(n, Fraction(0), Fraction(1))
        )
        size = scale ** np.arange(n + 1)
        value, off = (middle * size) @ matrix, (radius * size) @ matrix
        error = (n + 6) * EPS * ((np.abs(middle) * size) @ matrix + off) + 1e-300
        low = np.where(np.isfinite(value), value - (off + error), -np.inf).min(axis=1)
        low = np.where(np.isnan(low), -np.inf, low)
        exact = ~middle.any(axis=1) & ~(radius > 1e-320).any(axis=1)
        low = np.where(exact, 0.0, low * (1 + EPS))
        least = np.minimum(least, low)
        reach = np.where(low < 0, np.maximum(reach, scale * (1 + (k + 1) / CUTS) if k >= 0 else scale), reach)
    return least, reach


@cache
def _bernstein_matrix(n: int, low: Fraction, high: Fraction) -> np.ndarray:
    """(k, j): coefficient j in the Bernstein basis of [low, high] of s^k; none is negative."""

    def entry(k: int, j: int) -> Fraction:
        ways = range(max(0, k - (n - j)), min(j, k) + 1)
        return sum((comb(j, i) * comb(n - j, k - i) * high**i * low ** (k - i) for i in ways), Fraction(0)) / comb(n, k)

    return np.array([[float(entry(k, j)) for j in range(n + 1)] for k in range(n + 1)])
