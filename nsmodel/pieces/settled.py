"""Whether a mode is solved: how far l still moves, and whether rows that no multiplier acts on stay at 0 by themselves."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from nsmodel.pieces.multipliers import NOTHING, MultiplierSolver
from nsmodel.pieces.sizes import ROUNDING

if TYPE_CHECKING:
    from nsmodel.pieces.system import ModeSystem

STAYS = 1e-9  # Of what moves: a row that nothing acts on moves by less.


def relative_change(system: ModeSystem, how: MultiplierSolver, direct: list[float], through: list[float]) -> float:
    """The largest share by which l moved of what it is the sum of: of itself, and of the inverse times the terms of h."""
    l, moved = [abs(row[0]) for row in system.l], 0.0
    for inverse, step, k, time in ((how.direct, direct, 0, 1.0), (how.through, through, 1, system.t[1])):
        if inverse is not None:
            x = [abs(row[k]) / time for row in system.x]
            sizes = [system.sum_y_terms(i, x, l) for i in how.active]
            terms = (sum([abs(a) * size for a, size in zip(row, sizes, strict=True)]) for row in inverse)
            shares = (abs(d) / (NOTHING + l[i] + v) for i, d, v in zip(how.active, step, terms, strict=True))
            moved = max([moved, *shares])
    return moved


def remains_zero(system: ModeSystem, how: MultiplierSolver, orders: Iterable[int]) -> bool:
    """Whether the rows that no multiplier acts on stay at 0 by themselves, as redundant ones do; 1: once x has its rate.

    Where x rests its coefficients are rounding of what multipliers push it by, or exactly 0, and y of curved rows is what their
    products are: what is below that rounding in the unit of time is no motion.
    """
    if how.null is None or not how.null.size:
        return True
    pushed, none = system.pushed(), [0.0] * system.m
    rounding = ROUNDING * np.abs(how.null.T) @ [system.sum_y_terms(i, pushed, none) for i in how.active]
    for k in orders:
        y = np.array([system.y[i][k] for i in how.active])
        size = max([float(np.abs(y).max()), *(abs(row[k]) for row in system.x)])
        if not (np.abs(how.null.T @ y) <= np.maximum(STAYS * size, rounding)).all():
            return False
    return True
