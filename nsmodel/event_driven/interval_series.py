"""Taylor coefficients with proved bounds: expressions of polynomials in time, over parts of pieces, in interval arithmetic.

About the centre c of a part c + [-r, r], with s = c + u r, an expression e of the polynomials is

    e(s) = e_0 + e_1 (s - c) + ... + e_(N-1) (s - c)^(N-1) + e_N (s - c)^N,

e_0, ..., e_(N-1) its coefficients at c, known to rounding, and e_N in the interval of its coefficients of order N at all points
of the part (Lagrange's remainder; Moore 1966). Both come from the recurrences of `jets`, run on intervals.

How far below 0 a polynomial with intervals as coefficients can come on [-1, 1], and where it is not proved to be >= 0.

The least coefficient in the Bernstein basis of a cell bounds a polynomial there from below. Cells become shorter towards both
ends, by halves, about which the polynomial is expanded: near a root at an end it is known to the rounding of what it is there.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from functools import cache
from math import comb
from typing import Any, NamedTuple

import numpy as np

from nsmodel._utils import EPS
from nsmodel.event_driven.bernstein import taylor_shift
from nsmodel.event_driven.recurrence_code import PYTHON_DIALECT, compile_recurrences
from nsmodel.event_driven.recurrences import ORDER_0_FUNCTIONS, RECURRENCES, TWO_OVER_ROOT_PI, TaylorRecurrences
from nsmodel.proof.interval_arithmetic import next_down, next_up
from nsmodel.proof.interval_functions import (
    ZERO_INTERVAL,
    Interval,
    as_interval,
    interval_function,
    interval_where,
    point_intervals,
)

IntervalCoefficients = list[Interval]  # Of a power series, order 0 first; each an array of intervals.


class PieceParts(NamedTuple):
    """Parts of pieces, centre +- radius in the pieces' own s; ``piece``: the number of the piece (B,)."""

    piece: np.ndarray
    centre: np.ndarray
    radius: np.ndarray


def subdivide_pieces(lengths: np.ndarray, counts: np.ndarray) -> PieceParts:
    """[0, lengths] (K,), each in ``counts`` parts of one length."""
    piece = np.repeat(np.arange(len(lengths)), counts)
    place = np.arange(len(piece)) - np.repeat(np.cumsum(counts) - counts, counts)
    begin, end = (lengths[piece] * k / counts[piece] for k in (place, place + 1))
    end = np.where(place + 1 == counts[piece], lengths[piece], end)
    centre = begin + (end - begin) / 2
    return PieceParts(piece, centre, next_up(np.maximum(end - centre, centre - begin)))


def number_interval(value: float) -> Interval:
    """A number of a recurrence; 2/sqrt(pi) lies between two doubles."""
    if value == TWO_OVER_ROOT_PI:
        return Interval(next_down(np.array([value])), next_up(np.array([value])))
    return as_interval(value)


def _integer_choice(rounding: Any):
    return lambda row: as_interval(row) if not isinstance(row, Interval) else point_intervals(rounding(row.middle))


_ROUNDING_FUNCTIONS = {"floor": np.floor, "ceil": np.ceil, "trunc": np.trunc, "rint": np.rint}
_CHOICE_FUNCTIONS = {
    "side": lambda row: np.where(as_interval(row).middle < 0, -1.0, 1.0),
    "equal": lambda row: np.where(as_interval(row) == 0, 0.0, np.where(as_interval(row).middle < 0, -1.0, 1.0)),
    **{f"whole_{name}": _integer_choice(rounding) for name, rounding in _ROUNDING_FUNCTIONS.items()},
}  # fmt: skip
_INTERVAL_FUNCTIONS = RECURRENCES | {name: interval_function(name) for name in ORDER_0_FUNCTIONS} | _CHOICE_FUNCTIONS
_INTERVAL_FUNCTIONS |= {"number": number_interval, "where": interval_where, "of": as_interval}
INTERVAL_DIALECT = PYTHON_DIALECT._replace(
    number=lambda value: f"number(float('{value!r}'))",
    either="where({0}, {1}, {2})".format,
    both="({0} != 0.0) & ({1} != 0.0)",
    one="({0} != 0.0) | ({1} != 0.0)",
    positive="of({0}).middle > 0",
    choose="if choice[{i}] is None: choice[{i}] = {value}",
    choices={
        "side": "side({0})", "equal": "equal({0})", "floor": "whole_floor({0})", "ceil": "whole_ceil({0})",
        "toward zero": "whole_trunc({0})", "nearest": "whole_rint({0})",
    },
)  # fmt: skip


class IntervalSeries(NamedTuple):
    """Coefficients of the outputs and of the rows that branches look at, with the sides that these are on."""

    outputs: list[IntervalCoefficients]
    branches: list[IntervalCoefficients]
    choice: list[Any]


def compute_interval_series(
    recurrences: TaylorRecurrences,
    inputs: dict[tuple[int, int], IntervalCoefficients],
    orders: int,
    choice: list[Any] | None = None,
) -> IntervalSeries:
    """Orders 0, ..., ``orders`` from those of the inputs; ``choice``: of the branches, where it is made."""
    rows: list[IntervalCoefficients] = [[ZERO_INTERVAL] * (orders + 1) for _ in range(recurrences.count)]
    for place, row in recurrences.inputs.items():
        rows[row] = inputs[place]
    for row, value in recurrences.numbers.items():
        rows[row][0] = as_interval(value)
    choice = [None] * len(recurrences.branches) if choice is None else choice
    start, compute_order = compile_recurrences(recurrences, rows, choice, INTERVAL_DIALECT, _INTERVAL_FUNCTIONS)
    start()
    for k in range(1, orders + 1):
        compute_order(k)
    return IntervalSeries(
        [rows[row] for row in recurrences.outputs], [rows[branch.row] for branch in recurrences.branches], choice
    )


def coefficients_over_interval(c: Sequence[Interval], radius: np.ndarray) -> IntervalCoefficients:
    """The coefficients about all points of [-r, r], r = radius: c_k +- sum_(j > k) comb(j, k) |c_j| r^(j - k)."""
    sizes = [point_intervals(a.magnitude) for a in c]
    moved = [(m - a).magnitude for m, a in zip(taylor_shift(sizes, point_intervals(radius)), sizes, strict=True)]
    return [a + Interval(-m, m) for a, m in zip(c, moved, strict=True)]


def radius_powers(radius: np.ndarray, orders: int) -> list[Interval]:
    """Radius^0, ..., radius^orders."""
    found, r = [as_interval(1.0)], point_intervals(radius)
    for _ in range(orders):
        found.append(found[-1] * r)
    return found


CELL_OCTAVES, CELL_CUTS = 48, 4  # Cells [2^-j, 2^(1-j)], each cut so often: 192, to 16 EPS from an end of the part.


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
    cells = [(2.0**-j, k) for j in range(1, CELL_OCTAVES + 1) for k in range(CELL_CUTS)] + [(2.0**-CELL_OCTAVES, -1)]
    for scale, k in cells:
        matrix = (
            _bernstein_matrix(n, 1 + Fraction(k, CELL_CUTS), 1 + Fraction(k + 1, CELL_CUTS))
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
        reach = np.where(low < 0, np.maximum(reach, scale * (1 + (k + 1) / CELL_CUTS) if k >= 0 else scale), reach)
    return least, reach


@cache
def _bernstein_matrix(n: int, low: Fraction, high: Fraction) -> np.ndarray:
    """(k, j): coefficient j in the Bernstein basis of [low, high] of s^k; none is negative."""

    def entry(k: int, j: int) -> Fraction:
        ways = range(max(0, k - (n - j)), min(j, k) + 1)
        return sum((comb(j, i) * comb(n - j, k - i) * high**i * low ** (k - i) for i in ways), Fraction(0)) / comb(n, k)

    return np.array([[float(entry(k, j)) for j in range(n + 1)] for k in range(n + 1)])
