"""How far a piece goes: to its first event, and no further than is proved of it."""

from __future__ import annotations

import math
from typing import NamedTuple

from nsmodel.errors import StepError
from nsmodel.pieces.defect import estimate_local_error, zero_start_scales
from nsmodel.pieces.lengths import LOCAL
from nsmodel.pieces.modes import PieceStart
from nsmodel.pieces.multipliers import MultiplierSolver
from nsmodel.pieces.roots import EventLocator
from nsmodel.pieces.schwarz import AS_NOW, SchwarzBound
from nsmodel.pieces.switches import SwitchCondition

SHORTENINGS, CAUTION = 30, 0.9  # Of a piece, and the share of the length that its error allows.


class PieceEnd(NamedTuple):
    """What ends a piece, where; the bound of its local error in units of rtol, at most 1; up to where that holds."""

    hit: SwitchCondition | None
    s: float
    error: float
    proved: float


def piece_end(
    bound: SchwarzBound,
    roots: EventLocator,
    place: PieceStart,
    how: MultiplierSolver,
    p: int,
    s: float,
    rtol: float,
    atol: list[float],
) -> PieceEnd:
    """The end of a piece of order p and length s at most.

    The bound is of the polynomials as they should be; what rounding, or a fault, has made of them the residual at a point says.

    Raises:
        StepError: its error is above 1, however short it is.
    """
    system, of, goals = bound.system, bound.equations, (rtol / LOCAL, [a / LOCAL for a in atol])
    s, proved = bound.proved(place, how, p, s, *goals)
    whole = s
    error, start_scales, now = math.inf, [0.0] * system.n, AS_NOW * abs(place.t) / place.tau
    for shortened in range(SHORTENINGS):
        hit, end = roots.first(place, how, p, s, bound.margins)
        error = LOCAL * estimate_local_error(system, place, of, end, p, rtol, atol, start_scales)
        if not shortened and not error <= 1:
            start_scales = zero_start_scales(system, place, of, end)
            error = LOCAL * estimate_local_error(system, place, of, end, p, rtol, atol, start_scales)
        # In a time in which nothing moves there is nothing to be missed: time is not known better.
        if error <= 1 or (end <= now and (error < math.inf or bound.is_at_rest(place, *goals))):
            return PieceEnd(hit, end, max(min(error, 1.0), proved * (end / whole) ** p if whole else 0.0), s)
        s = max(end * min(0.5, CAUTION * error ** (-1 / p)), now)
        if place.t + place.tau * s == place.t:
            break
    raise bound.pole_error(place) or StepError(
        f"t = {place.t:.10g}: x' = f + g, y = 0 is missed by {error:.3g} times rtol, however short the piece"
    )
