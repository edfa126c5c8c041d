"""How far a piece goes: to its first event, and no further than its defect allows."""

from __future__ import annotations

import math

from nsmodel.errors import StepError
from nsmodel.pieces.defect import Equations, coming, defect
from nsmodel.pieces.lengths import LOCAL
from nsmodel.pieces.modes import Place
from nsmodel.pieces.multipliers import Solve
from nsmodel.pieces.roots import first_event
from nsmodel.pieces.switches import Condition
from nsmodel.pieces.system import System

SHORTENINGS, CAUTION = 30, 0.9  # Of a piece, and the share of the length that its error allows.


def ending(
    system: System, place: Place, how: Solve, of: Equations, p: int, s: float, rtol: float, atol: list[float]
) -> tuple[Condition | None, float, float]:
    """What ends a piece of order p and length s at most, where, and its local error in units of rtol, at most 1.

    Raises:
        StepError: its error is above 1, however short it is.
    """
    error, later = math.inf, [0.0] * system.n
    for shortened in range(SHORTENINGS):
        hit, end = first_event(system, place, how, p, s)
        error = LOCAL * defect(system, place, of, end, p, rtol, atol, later)
        if not shortened and not error <= 1:
            later = coming(system, place, of, end)
            error = LOCAL * defect(system, place, of, end, p, rtol, atol, later)
        if error <= 1:
            return hit, end, error
        s = end * min(0.5, CAUTION * error ** (-1 / p))
        if place.t + place.tau * s == place.t:
            break
    raise StepError(f"t = {place.t:.10g}: x' = f + g, y = 0 is missed by {error:.3g} times rtol, however short the piece")
