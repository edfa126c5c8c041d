"""Taylor coefficients with proved bounds: expressions of polynomials in time, over parts of pieces, in interval arithmetic.

About the centre c of a part c + [-r, r], with s = c + u r, an expression e of the polynomials is

    e(s) = e_0 + e_1 (s - c) + ... + e_(N-1) (s - c)^(N-1) + e_N (s - c)^N,

e_0, ..., e_(N-1) its coefficients at c, known to rounding, and e_N in the interval of its coefficients of order N at all points
of the part (Lagrange's remainder; Moore 1966). Both come from the recurrences of `jets`, run on intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from nsmodel.pieces import series
from nsmodel.pieces.bernstein import about
from nsmodel.pieces.expansion import compiled
from nsmodel.pieces.jets import Jets
from nsmodel.pieces.printed import PYTHON
from nsmodel.proof.interval_arithmetic import down, up
from nsmodel.proof.interval_number import ZERO, Interval, exactly, function, of, where

Coefficients = list[Interval]  # Of a power series, order 0 first; each an array of intervals.


class Parts(NamedTuple):
    """Parts of pieces, centre +- radius in the pieces' own s; ``piece``: the number of the piece (B,)."""

    piece: np.ndarray
    centre: np.ndarray
    radius: np.ndarray

    def of(self, chosen: np.ndarray) -> Parts:
        """Those of a mask."""
        return Parts(*(array[chosen] for array in self))


def parts_of(lengths: np.ndarray, counts: np.ndarray) -> Parts:
    """[0, lengths] (K,), each in ``counts`` parts of one length."""
    piece = np.repeat(np.arange(len(lengths)), counts)
    place = np.arange(len(piece)) - np.repeat(np.cumsum(counts) - counts, counts)
    begin, end = (lengths[piece] * k / counts[piece] for k in (place, place + 1))
    end = np.where(place + 1 == counts[piece], lengths[piece], end)
    centre = begin + (end - begin) / 2
    return Parts(piece, centre, up(np.maximum(end - centre, centre - begin)))


def number(value: float) -> Interval:
    """A number of a recurrence; 2/sqrt(pi) lies between two doubles."""
    if value == series.TWO_OVER_ROOT_PI:
        return Interval(down(np.array([value])), up(np.array([value])))
    return of(value)


def _whole(rounding: Any):
    return lambda row: of(row) if not isinstance(row, Interval) else exactly(rounding(row.middle))


_WHOLE = {"floor": np.floor, "ceil": np.ceil, "trunc": np.trunc, "rint": np.rint}
_CHOOSE = {
    "side": lambda row: np.where(of(row).middle < 0, -1.0, 1.0),
    "equal": lambda row: np.where(of(row) == 0, 0.0, np.where(of(row).middle < 0, -1.0, 1.0)),
    **{f"whole_{name}": _whole(rounding) for name, rounding in _WHOLE.items()},
}  # fmt: skip
_KNOWN = series.RECURRENCES | {name: function(name) for name in series.STARTS} | _CHOOSE
_KNOWN |= {"number": number, "where": where, "of": of}
INTERVALS = PYTHON._replace(
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


class Series(NamedTuple):
    """Coefficients of the outputs and of the rows that branches look at, with the sides that these are on."""

    outputs: list[Coefficients]
    branches: list[Coefficients]
    choice: list[Any]


def series_of(jets: Jets, inputs: dict[tuple[int, int], Coefficients], orders: int, choice: list[Any] | None = None) -> Series:
    """Orders 0, ..., ``orders`` from those of the inputs; ``choice``: of the branches, where it is made."""
    rows: list[Coefficients] = [[ZERO] * (orders + 1) for _ in range(jets.count)]
    for place, row in jets.inputs.items():
        rows[row] = inputs[place]
    for row, value in jets.numbers.items():
        rows[row][0] = of(value)
    choice = [None] * len(jets.branches) if choice is None else choice
    start, later = compiled(jets, rows, choice, INTERVALS, _KNOWN)
    start()
    for k in range(1, orders + 1):
        later(k)
    return Series([rows[row] for row in jets.outputs], [rows[branch.row] for branch in jets.branches], choice)


def around(c: Sequence[Interval], radius: np.ndarray) -> Coefficients:
    """The coefficients about all points of [-r, r], r = radius: c_k +- sum_(j > k) comb(j, k) |c_j| r^(j - k)."""
    sizes = [exactly(a.magnitude) for a in c]
    moved = [(m - a).magnitude for m, a in zip(about(sizes, exactly(radius)), sizes, strict=True)]
    return [a + Interval(-m, m) for a, m in zip(c, moved, strict=True)]


def powers(radius: np.ndarray, orders: int) -> list[Interval]:
    """Radius^0, ..., radius^orders."""
    found, r = [of(1.0)], exactly(radius)
    for _ in range(orders):
        found.append(found[-1] * r)
    return found
