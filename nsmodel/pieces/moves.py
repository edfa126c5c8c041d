"""How a place is moved where a piece has ended: back to y = 0, and on to where a block stands."""

from __future__ import annotations

from nsmodel.pieces.modes import Place, turn
from nsmodel.pieces.multipliers import least_motion
from nsmodel.pieces.switches import ROW
from nsmodel.pieces.system import System

PROJECTIONS = 3  # Iterations.


def project(system: System, place: Place, rows: tuple[int, ...]) -> None:
    """Move x so that what no l acts on directly is 0 in ``rows``, by Newton's method along the least motion."""
    for _ in range(PROJECTIONS):
        held, slope = system.held(rows)
        if not held.any():
            return
        place.x = [float(x - d) for x, d in zip(place.x, least_motion(slope, held), strict=True)]
        system.expand(place.t, place.x, place.codes, place.tau, 1)


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
