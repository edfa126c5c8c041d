"""How long solutions, and what a scheme computes, provably stay inside the box of a consequence: by bounds of their speed.

A class that has such a bound has `speed_bound` among its checks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, SAMPLED, Consequence, Finding
from nsmodel.hypotheses.framework import HYPOTHESIS_CHECKS, SpeedBound
from nsmodel.hypotheses.region import Region
from nsmodel.modeling.base import Model

ROUND_UP_FACTOR = 1 + 1e-12


def time_limit_clauses(
    model: Model, region: Region, findings: Sequence[Finding], consequences: Sequence[Consequence]
) -> list[Consequence]:  # fmt: skip
    """The consequences, those with a clause told for how long it is proved."""
    if not any(consequence.clause and consequence.verdict in (HOLDS, SAMPLED) for consequence in consequences):
        return list(consequences)
    bound = _speed_bound(model, region, findings, {consequence.name: consequence for consequence in consequences})
    until = None if bound is None else _time_limit(model, region, bound)
    if bound is None or until is None or not until > region.t0:
        why = "; for how long they do is not proved"
        return [replace(item, clause=item.clause + why) if item.clause else item for item in consequences]
    until = min(until, region.t1) if region.t1 > region.t0 else until
    text = f"; they do for t <= {until:.5g}, moving at {bound.speed:.5g} at most"
    return [replace(item, clause=item.clause + text, until=until) if item.clause else item for item in consequences]


def _speed_bound(model: Model, region: Region, findings: Sequence[Finding], found: dict[str, Consequence]) -> SpeedBound | None:
    steps = model.steps if model.steps is not None else model.step
    h = float(np.max(steps)) if steps is not None else 0.0
    speed_bound = HYPOTHESIS_CHECKS.of(model).speed_bound
    return None if speed_bound is None else speed_bound(model, region, findings, found, h)


def _time_limit(model: Model, region: Region, bound: SpeedBound) -> float | None:
    """When the nearest side of the box can be reached first."""
    starts = model.points(np.array(ca.DM(model.start)).reshape(1, -1))
    room = float(np.min(np.minimum(starts - region.lower, region.upper - starts))) - bound.ahead
    if not room > 0:
        return None
    return region.t0 + room / bound.speed / ROUND_UP_FACTOR if bound.speed > 0 else np.inf
