"""Pieces that are straight lines: past a point at which f has no Taylor series (sqrt t at 0, asin where it touches 1).

From t to t + h, x + v (time - t) with v = f + g at the end errs by at most sum_i h 2^-i |f(t + h 2^-i) - v|, where what f differs
from v by falls or grows towards the point all the way. That sum is over all doubles between; where its terms do not fall towards
the point, there is a pole.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from nsmodel.pieces.defect import ModelEquations
from nsmodel.pieces.modes import ULP

AT_START = (100, 50, 30, 26, 24, 22, 200, 400)  # Octaves below 1 of the lengths that are tried at t = 0,
ON_THE_WAY = range(4, 31)  # and of those above a rounding of the time elsewhere.
SMALLEST_DOUBLE_OCTAVES = 1074  # Octaves below 1 of the least double.
FALLS = 2.0**-0.0625  # By which the terms fall from octave to octave at least: |t|^-0.93 does.
NEAR_0, STEEPER = 1e-100, 4.0  # Where f is looked at, and at its square; how many times as steep it is there: x^0.99 is.
COMES_TO = 0.25  # The power of h: the time, in which a state that is 0 at the start comes to what it is measured beside.


def trial_lengths(t: float) -> Iterator[tuple[float, int]]:
    """Lengths h to try at a time, and the octaves from the end of each to the next double."""
    if t:
        yield from ((abs(t) * ULP * 2.0**octaves, octaves) for octaves in ON_THE_WAY)
    else:
        yield from ((2.0**-octaves, SMALLEST_DOUBLE_OCTAVES - octaves) for octaves in AT_START)


class StraightLine(NamedTuple):
    """Its rate (n,), and what x may err by on it."""

    v: np.ndarray
    allowed: np.ndarray


def straight_line(
    of: ModelEquations, t: float, x: list[float], l: list[float], sizes: list[float], h: float, octaves: int, rtol: float,
    atol: list[float],
) -> StraightLine | None:  # fmt: skip
    """The line from x of length h; None where it errs by more than rtol of the sizes, or may, with l as it is."""
    v = np.array(of(t + h, x, l)[0])
    size = np.fmax(np.abs(x), sizes)
    if not t:
        start_time = h**COMES_TO
        size = np.fmax(size, start_time * np.abs(of(start_time, x, l)[0]))
    times = np.ldexp(h, -np.arange(1, octaves + 1))
    terms = np.array([s * np.abs(np.array(of(t + s, (x + s * v).tolist(), l)[0]) - v) for s in times.tolist()])
    most = terms.max(axis=0)
    falls = (terms[-1] <= most * FALLS**octaves) | (most <= ULP * size)
    errs, allowed = terms.sum(axis=0), rtol * size + np.array(atol)
    return StraightLine(v, allowed) if falls.all() and (errs <= allowed).all() and math.isfinite(v.sum()) else None


def may_leave_0(of: ModelEquations, t: float, x: list[float], l: list[float], i: int) -> bool:
    """Whether x_i, which rests at 0, may stay or leave (x' = sqrt x): f - f(0) grows faster than x_i, and does not lead back."""
    still = np.array(of(t, x, l)[0])
    for side in (-1.0, 1.0):
        near, nearer = ((np.array(of(t, [*x[:i], side * off, *x[i + 1 :]], l)[0]) - still) / off for off in (NEAR_0, NEAR_0**2))
        grows = np.abs(nearer) > STEEPER * np.abs(near)
        if grows.any() and not (grows[i] and side * nearer[i] < 0):
            return True
    return False
