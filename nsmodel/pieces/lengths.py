"""How far a series goes: the length of a piece from the last two coefficients of x, y and l (Jorba and Zou 2005)."""

from __future__ import annotations

import math

from nsmodel.pieces.multipliers import Solve
from nsmodel.pieces.system import System

LONGEST = 32.0  # In units of time: a piece that would be longer begins anew in another unit.
MULTIPLIERS = 100.0  # l and y are asked for to so many times rtol.
SMALL = 1e-3  # Rows of y and l below this share of the largest are measured beside that share.


def length(system: System, codes: list[int], how: Solve, p: int, rtol: float, atol: list[float]) -> float:
    """The length of the piece in tau; a row's size is that on the piece too."""
    sizes, known = system.sizes, p if how.index == 1 else p - 1
    y_floor, l_floor = (SMALL * max(of, default=0.0) for of in (sizes.y, sizes.l))
    rows = [(row, p, rtol, size, more) for row, size, more in zip(system.x, sizes.x, atol, strict=True)]
    for i, code in enumerate(codes):
        row, orders, size = system.l[i], known, max(sizes.l[i], l_floor)
        if code:
            row, orders, size = system.y[i], p, max(sizes.y[i], y_floor)
        rows.append((row, orders, MULTIPLIERS * rtol, size, 0.0))
    s = 0.0
    for _ in range(3):
        s = min((_longest(row, k, tol, _size(row, size, s, k), more) for row, k, tol, size, more in rows), default=LONGEST)
    return s


def unit(tau: float) -> float:
    """The power of two that is not below tau: in this unit a piece is not longer than 1."""
    fraction, exponent = math.frexp(tau)
    return math.ldexp(1.0, exponent - (fraction == 0.5))


def _size(row: list[float], size: float, s: float, orders: int) -> float:
    """The size of a row so far, and on a piece of length s."""
    power = 1.0
    for k in range(orders // 2):
        size = max(size, abs(row[k]) * power)
        power *= s
    return size


def _longest(row: list[float], p: int, rtol: float, size: float, more: float) -> float:
    """The longest s with |c_p| s^p and |c_(p-1)| s^(p-1) at most rtol of the size; of a row of size 0, of its first term."""
    s = LONGEST
    first = next((k for k in range(p - 1) if row[k]), p) if size + more == 0 else 0
    for k in (p, p - 1):
        if row[k] and k > first:
            goal = rtol * abs(row[first]) if first else rtol * size + more
            s = min(s, (goal / abs(row[k])) ** (1 / (k - first)))
    return s
