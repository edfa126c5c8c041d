"""How far a series goes: the length of a piece from the last two coefficients (Jorba and Zou 2005).

Of x, y and l, and of what switches look at: x may be a line where that turns.
"""

from __future__ import annotations

import math
from itertools import accumulate, repeat
from operator import mul
from typing import NamedTuple

from nsmodel.pieces.multipliers import NOTHING, MultiplierSolver
from nsmodel.pieces.sizes import ROUNDING
from nsmodel.pieces.system import ModeSystem

LARGEST_ORDER = 30
BEYOND = 3  # Orders of a series beyond -ln(rtol)/2.
LOCAL, ROUGHEST = 0.01, 1e-1  # A piece errs by this share of rtol, and of no more than this.
LONGEST = 32.0  # In units of time: a piece that would be longer begins anew in another unit.
MULTIPLIERS = 100.0  # l and y are asked for to so many times rtol.
PASSES = 3  # In which sizes on the piece and its length settle.
FIRST = 0.1  # By which share of their size states may move in the first unit of time.
SMALL = 1e-3  # Rows of y and l below this share of the largest are measured beside that share.


def taylor_order(rtol: float) -> int:
    """The order of the series: one more than where products cost least (Jorba and Zou 2005), as a piece has its own price."""
    return min(math.ceil(-math.log(LOCAL * min(rtol, ROUGHEST)) / 2) + BEYOND, LARGEST_ORDER)


def step_size(system: ModeSystem, codes: list[int], how: MultiplierSolver, p: int, rtol: float, atol: list[float]) -> float:
    """The length of the piece in tau; a row's size is that on the piece too."""
    sizes, known = system.sizes, p if how.index == 1 else p - 1
    y_floor, l_floor = (SMALL * max(of, default=0.0) for of in (sizes.y, sizes.l))
    pushed = (ROUNDING * v + NOTHING for v in system.pushed())
    rows = [_CoefficientRow(*given) for given in zip(system.x, repeat(p), repeat(rtol), sizes.x, atol, pushed)]
    for i, code in enumerate(codes):
        row, orders, size = system.l[i], known, max(sizes.l[i], l_floor)
        if code:
            if i in system.blocks.of:
                rows.append(_CoefficientRow(row, orders, MULTIPLIERS * rtol, size))
            row, orders, size = system.y[i], p, max(sizes.y[i], y_floor)
        rows.append(_CoefficientRow(row, orders, MULTIPLIERS * rtol, size))
    for (name, i), size in zip(system.branches, sizes.switches, strict=True):
        part = system.parts[name]
        rows.append(_CoefficientRow(part.rows[part.jets.branches[i].row], p - 1, MULTIPLIERS * rtol, size))
    return _common_length(rows)


def initial_time_unit(system: ModeSystem, t: float, x: list[float], tau: float) -> float:
    """The time in which f changes the state by its own size, where both are something; else tau."""
    system.t[0], system.t[1] = t, 1.0
    for row, v in zip(system.x, x, strict=True):
        row[0] = v
    rates = [abs(v) / abs(a) for v, a in zip(system.parts["f"].order(0), x, strict=True) if a and math.isfinite(v)]
    return power_of_two_unit(FIRST / max(rates)) if max(rates, default=0.0) > 0 else tau


def power_of_two_unit(tau: float) -> float:
    """The power of two that is not below tau: in this unit a piece is not longer than 1."""
    fraction, exponent = math.frexp(tau)
    return math.ldexp(1.0, exponent - (fraction == 0.5))


class _CoefficientRow(NamedTuple):
    """A row's coefficients, how many are known, what it is asked for, its size so far, and rounding."""

    c: list[float]
    known: int
    rtol: float
    so_far: float
    more: float = 0.0
    rounding: float = 0.0

    def max_length(self, size: float) -> float:
        """How far it goes with this size: |c_p| s^p and |c_(p-1)| s^(p-1) are at most rtol of it.

        Of size 0 it is its first term, and where that is none of the first half later terms are at most that.
        """
        c, p, rtol, _, more, rounding = self
        first, s, goal = 0, LONGEST, rtol * size + more
        if not goal:
            first = next((k for k in range(p) if c[k]), p)
            goal = (rtol if first < p // 2 else 1.0) * abs(c[first]) if first else 0.0
        if goal < rounding:
            goal = rounding
        for k in (p, p - 1):
            if (a := abs(c[k])) and k > first and (most := (goal / a) ** (1 / (k - first))) < s:
                s = most
        return s


def _common_length(rows: list[_CoefficientRow]) -> float:
    """The longest s that all rows let, with the sizes that they have on it.

    With its size so far and at the start a row goes no further than with that on the piece: most need no look at the latter.
    """
    least, given = [], LONGEST
    for number, row in enumerate(rows):
        size, start = row.so_far, abs(row.c[0])
        s = row.max_length(size if size > start else start)
        least.append((s if size or start or row.more else 0.0, number))
        if s < given:
            given = s
    least.sort()
    half = max((row.known for row in rows), default=0) // 2
    for _ in range(PASSES - 1):
        powers, before, given = list(accumulate([given] * half, mul, initial=1.0)), given, LONGEST
        for s, number in least:
            if s >= given:
                break
            row = rows[number]
            size = max(row.so_far, *map(mul, map(abs, row.c[: row.known // 2]), powers))
            given = min(given, row.max_length(size))
        if given == before:
            break
    return given
