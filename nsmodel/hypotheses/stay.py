"""How long solutions, and what a scheme computes, provably stay inside the box of a consequence: by bounds of their speed.

Sweeping processes: q' = f - n with n normal to Q(t), and the set of velocities that stay in Q(t) holds some v_0, |v_0| <= K_L;
q' is the one nearest to f, so that <f - q', v_0 - q'> <= 0, which is |q'|^2 <= |f|^2 + K_L^2. A step of the scheme projects
q + h f on a polyhedron that holds a point within h K_L of q: the same, where rho is above what a constraint can close in it.
Inclusions: x' is the element of F - S - N_C of least length, not longer than F - S; projections on C do not stretch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.classes.inclusion.hypotheses.growth import on_region
from nsmodel.classes.inclusion.hypotheses.selected_field import field_of, set_of
from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, Consequence, Finding
from nsmodel.hypotheses.region import Region
from nsmodel.model.base import Model
from nsmodel.proof import extremum

UP = 1 + 1e-12


class Pace(NamedTuple):
    """Bounds on the box: how fast the state moves, and how far a predictor reaches ahead of it."""

    speed: float
    ahead: float


def clauses(
    model: Model, region: Region, findings: Sequence[Finding], consequences: Sequence[Consequence]
) -> list[Consequence]:  # fmt: skip
    """The consequences, those with a clause told for how long it is proved."""
    if not any(consequence.clause and consequence.verdict in (HOLDS, SAMPLED) for consequence in consequences):
        return list(consequences)
    pace = _pace(model, region, findings, {consequence.name: consequence for consequence in consequences})
    until = None if pace is None else _until(model, region, pace)
    if until is None or not until > region.t0:
        why = "; for how long they do is not proved"
        return [replace(item, clause=item.clause + why) if item.clause else item for item in consequences]
    until = min(until, region.t1) if region.t1 > region.t0 else until
    text = f"; they do for t <= {until:.5g}, moving at {pace.speed:.5g} at most"
    return [replace(item, clause=item.clause + text, until=until) if item.clause else item for item in consequences]


def _pace(model: Model, region: Region, findings: Sequence[Finding], found: dict[str, Consequence]) -> Pace | None:
    steps = model.steps if model.steps is not None else model.step
    h = float(np.max(steps)) if steps is not None else 0.0
    if isinstance(model, SweepingProcess | ManyBodies):
        return _sweeping(model, region, findings, found["K_L"], h)
    if isinstance(model, MonotoneInclusion) and not model.moves and (model.tolerances is None or not callable(model.tolerances)):
        if model.tolerances is not None and np.any(np.asarray(model.tolerances, float)):
            return None
        field = field_of(model, set_of(model))
        top = on_region(field, (region.lower, region.upper))
        return None if top is None else Pace(top, h * top)
    return None


def _sweeping(
    model: SweepingProcess | ManyBodies, region: Region, findings: Sequence[Finding], moves: Consequence, h: float
) -> Pace | None:  # fmt: skip
    number = {(finding.id, name): value for finding in findings for name, value in finding.value.items()}
    holds = {finding.id for finding in findings if finding.verdict == HOLDS}
    f = _fastest(model, region)
    if not np.isfinite(f) or not {"S-convex", "S-start"} <= holds:
        return None
    rate = number.get(("A2", "b"), 0.0) if "A2" in holds else np.inf
    if not rate:
        return Pace(f, h * f)
    K_L, b, rho = moves.value.get("K_L", np.inf), number.get(("A1", "b"), np.inf), number.get(("A5", "rho"), np.inf)
    if moves.verdict != HOLDS or not h * (rate + b * K_L) <= rho:
        return None
    return Pace(float(np.hypot(f, K_L)) * UP, h * f * UP)


def _fastest(model: SweepingProcess | ManyBodies, region: Region) -> float:
    """A bound of |f| on the box, over all bodies together."""
    lower, upper = region.with_time()
    if isinstance(model, SweepingProcess):
        z, f, count = ca.vertcat(model.t, model.q), model.f, 1
    elif isinstance(model.f, ca.SX):
        numbers, table = model.me.symbols[model.bodies.d :], model.bodies.table[:, model.bodies.d :]
        z, f, count = ca.vertcat(model.t, model.me.q, numbers), model.f, model.bodies.count
        lower, upper = (np.concatenate([end, by(table, axis=0)]) for end, by in ((lower, np.min), (upper, np.max)))
    else:
        return np.inf
    top = extremum.supremum(ca.sumsqr(f), z, lower, upper, quick=True).bound
    return float(np.sqrt(count * max(top, 0.0))) * UP


def _until(model: Model, region: Region, pace: Pace) -> float | None:
    """When the nearest side of the box can be reached first."""
    starts = (
        model.bodies.q0 if isinstance(model, ManyBodies) else np.array(ca.DM(model.q0 if hasattr(model, "q0") else model.x0)).T
    )
    room = float(np.min(np.minimum(starts - region.lower, region.upper - starts))) - pace.ahead
    if not room > 0:
        return None
    return region.t0 + room / pace.speed / UP if pace.speed > 0 else np.inf
