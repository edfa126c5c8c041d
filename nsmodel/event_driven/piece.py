"""A piece of a run: polynomials of x, l and y in one mode, and what is known of them.

Pieces that are straight lines: past a point at which f has no Taylor series (sqrt t at 0, asin where it touches 1).

From t to t + h, x + v (time - t) with v = f + g at the end errs by at most sum_i h 2^-i |f(t + h 2^-i) - v|, where what f differs
from v by falls or grows towards the point all the way. That sum is over all doubles between; where its terms do not fall towards
the point, there is a pole.

Whether switches accumulate: pieces that become too short, or events whose number grows exponentially in time.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from nsmodel._utils import EPS
from nsmodel.event_driven.step_size import ModelEquations


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
        """The time at which the piece ends."""
        return self.t + self.tau * self.s

    def moved(self, t: float, x: list[float], error: float) -> Piece:
        """The piece with its end there, where that is one."""
        return self._replace(s=(t - self.t) / self.tau, last=list(x), defect=error) if t > self.t else self


# AT_START: a long one spares pieces, a short one errs less.
AT_START = (100, 50, 30, 26, 24, 22, 200, 400)  # Octaves below 1 of the lengths that are tried at t = 0,
ON_THE_WAY = range(4, 31)  # and of those above a rounding of the time elsewhere.
SMALLEST_DOUBLE_OCTAVES = 1074  # Octaves below 1 of the least double, 2^-1074.
FALLS = 2.0**-0.0625  # By which the terms fall from octave to octave at least: |t|^-0.93 does, and |t|^-1 has no integral.
# NEAR_0: x^0.99 is 10 times as steep there, x ln x twice.
NEAR_0, STEEPER = 1e-100, 4.0  # Where f is looked at, and at its square; how many times as steep it is there.
# COMES_TO: well above h, which is 2^-22 or less: what t^k comes to in h itself would be no size.
COMES_TO = 0.25  # The power of h: the time, in which a state that is 0 at the start comes to what it is measured beside.


def trial_lengths(t: float) -> Iterator[tuple[float, int]]:
    """Lengths h to try at a time, and the octaves from the end of each to the next double."""
    if t:
        yield from ((abs(t) * EPS * 2.0**octaves, octaves) for octaves in ON_THE_WAY)
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
    falls = (terms[-1] <= most * FALLS**octaves) | (most <= EPS * size)
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


TINY_PIECES, TINY = 50, 1e-13  # So many pieces one after the other that are so short, 450 EPS: switches accumulate.
# MANY: FASTER is between 0.7 of a chirp, which goes on, and 0.5 of n that grows exponentially.
MANY, FASTER = 4096, 0.6  # Events from which on they are asked whether they accumulate; see `ZenoDetector.event_rate_grows`.
SPACINGS = 5  # Between events n and n/2, n/2 and n/4, ... that are compared: four ratios, of up to 16 times as many events.


class ZenoDetector:
    """What has been counted: ``events``; times of the events 1, 2, 4, 8, ...; pieces in a row that were too short."""

    def __init__(self) -> None:
        self.events, self._tiny = 0, 0
        self._times: list[float] = []

    def pieces_vanish(self, length: float, t: float, tau: float) -> bool:
        """Whether the piece that an event has ended is the last of many that are next to nothing."""
        self._tiny = self._tiny + 1 if length < TINY * max(abs(t), tau) else 0
        return self._tiny > TINY_PIECES

    def event_rate_grows(self, t: float) -> bool:
        """Whether event n = 2^k comes as fast again as event n/2, to a part, four times over: n grows exponentially in time.

        Of switches at a constant rate the ratio is 1, of a chirp's, n ~ t^2, it is 0.7.
        """
        self.events += 1
        n, times = self.events, self._times
        if n & (n - 1):
            return False
        times.append(t)
        if n < MANY:
            return False
        spacing = [2 * (times[-1 - k] - times[-2 - k]) / (n >> k) for k in range(SPACINGS)]
        return all(late < FASTER * early for late, early in itertools.pairwise(spacing))

    def checkpoint(self) -> dict[str, Any]:
        """What has been counted, as numbers."""
        return {"events": self.events, "times": list(self._times), "tiny": self._tiny}

    def restore(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        self.events, self._times, self._tiny = saved["events"], list(saved["times"]), saved["tiny"]
