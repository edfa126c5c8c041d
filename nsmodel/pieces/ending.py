"""How far a piece goes: to its first event, and no further than is proved of it."""

from __future__ import annotations

import math
from typing import NamedTuple

from nsmodel.errors import StepError
from nsmodel.pieces.defect import coming, defect
from nsmodel.pieces.lengths import LOCAL
from nsmodel.pieces.modes import Place
from nsmodel.pieces.multipliers import Solve
from nsmodel.pieces.roots import Roots
from nsmodel.pieces.schwarz import AS_NOW, Schwarz
from nsmodel.pieces.switches import Condition

SHORTENINGS, CAUTION = 30, 0.9  # Of a piece, and the share of the length that its error allows.


class Ending(NamedTuple):
    """What ends a piece, where; the bound of its local error in units of rtol, at most 1; up to where that holds."""

    hit: Condition | None
    s: float
    error: float
    proved: float


def ending(bound: Schwarz, roots: Roots, place: Place, how: Solve, p: int, s: float, rtol: float, atol: list[float]) -> Ending:
    """The end of a piece of order p and length s at most.

    The bound is of the polynomials as they should be; what rounding, or a fault, has made of them the residual at a point says.

    Raises:
        StepError: its error is above 1, however short it is.
    """
    system, of, goals = bound.system, bound.equations, (rtol / LOCAL, [a / LOCAL for a in atol])
    s, proved = bound.proved(place, how, p, s, *goals)
    whole = s
    error, later, now = math.inf, [0.0] * system.n, AS_NOW * abs(place.t) / place.tau
    for shortened in range(SHORTENINGS):
        hit, end = roots.first(place, how, p, s, bound.margins)
        error = LOCAL * defect(system, place, of, end, p, rtol, atol, later)
        if not shortened and not error <= 1:
            later = coming(system, place, of, end)
            error = LOCAL * defect(system, place, of, end, p, rtol, atol, later)
        # In a time in which nothing moves there is nothing to be missed: time is not known better.
        if error <= 1 or (end <= now and (error < math.inf or bound.rests(place, *goals))):
            return Ending(hit, end, max(min(error, 1.0), proved * (end / whole) ** p if whole else 0.0), s)
        s = max(end * min(0.5, CAUTION * error ** (-1 / p)), now)
        if place.t + place.tau * s == place.t:
            break
    raise bound.pole(place) or StepError(
        f"t = {place.t:.10g}: x' = f + g, y = 0 is missed by {error:.3g} times rtol, however short the piece"
    )
