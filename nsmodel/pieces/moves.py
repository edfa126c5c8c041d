"""How a place is moved where a piece has ended: back to y = 0, and on to where a block stands."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from nsmodel.pieces.modes import Place, turn
from nsmodel.pieces.multipliers import generalised_inverse, least_motion
from nsmodel.pieces.sizes import ROUNDING
from nsmodel.pieces.switches import ROW, TIE
from nsmodel.pieces.system import System

PROJECTIONS = 3  # Iterations.


def project(system: System, place: Place, rows: tuple[int, ...]) -> bool:
    """Move x so that what no l acts on directly is 0 in ``rows``, by Newton's method along the least motion; whether it moved.

    Where y is rounding x moves by no more: rows that are nearly parallel would move it by many times that. What stands then is
    order 1 of the expansion there.
    """
    a = list(rows)
    for iteration in range(PROJECTIONS):
        y = [system.y[i][0] for i in a]
        if not any(y):
            return iteration > 0
        _, D, C = system.slopes()
        U = _free(D[np.ix_(a, a)].tobytes(), len(a))
        held = U.T @ y
        if not held.any():
            return iteration > 0
        motion = least_motion(U.T @ C[a], held)
        x, l = (np.abs([row[0] for row in of]) for of in (system.x, system.push))
        terms = np.abs(C[a]) @ x + np.abs(D[a]) @ l
        if (np.abs(y) <= ROUNDING * terms).all() and (np.abs(motion) > TIE * np.maximum(x, system.sizes.x)).any():
            return iteration > 0
        place.x = [x - d for x, d in zip(place.x, motion.tolist(), strict=True)]
        system.expand(place.t, place.x, place.codes, place.tau, 1)
    return True


def coast(system: System, place: Place, time: float) -> None:
    """Go on to where the speed of a block at its threshold would be 0: nothing but its first term means anything so near."""
    d = time / place.tau
    place.x = [row[0] + d * row[1] for row in system.x]
    place.t += time


def stick(system: System, place: Place) -> None:
    """Open the blocks that slip with y = 0, as their rows came to 0 with others, and let them begin with stick."""
    for block in system.blocks.released:
        place.open.add((ROW, block.first))
        turn(system, place, (ROW, block.first), 0)


@lru_cache(maxsize=64)
def _free(D: bytes, rows: int) -> np.ndarray:
    """The left null space of D."""
    return generalised_inverse(np.frombuffer(D).reshape(rows, rows))[1]
