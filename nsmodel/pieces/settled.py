"""Whether a mode is solved: how far l still moves, and whether rows that no multiplier acts on stay at 0 by themselves."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from nsmodel.pieces.multipliers import NOTHING, Rows, Solve

if TYPE_CHECKING:
    from nsmodel.pieces.system import System

STAYS = 1e-9  # Of what moves: a row that nothing acts on moves by less.


def moved_share(system: System, how: Solve, inverse: Rows, step: list[float], x: list[float]) -> float:
    """The largest share by which l moved of what it is the sum of: of itself, and of ``inverse`` times the terms of h."""
    _, D, C = system.slopes()
    terms = np.abs(inverse) @ (np.abs(C) @ x + np.abs(D) @ [abs(row[0]) for row in system.l])[list(how.active)]
    shares = (abs(d) / (NOTHING + abs(system.l[i][0]) + v) for i, d, v in zip(how.active, step, terms, strict=True))
    return max(shares)


def stays(system: System, how: Solve, orders: Iterable[int]) -> bool:
    """Whether the rows that no multiplier acts on stay at 0 by themselves, as redundant ones do; 1: once x has its rate."""
    if how.null is None or not how.null.size:
        return True
    for k in orders:
        y = np.array([system.y[i][k] for i in how.active])
        size = max([float(np.abs(y).max()), *(abs(row[k]) for row in system.x)])
        if not np.abs(how.null.T @ y).max() <= STAYS * size:
            return False
    return True
