"""Many bodies with inputs, which stand in f alone: f may be measurable in t, and the constraints do not know of them.

Hypotheses of many bodies for all values of parameters in a box: those whose parts do not depend on them, and S-f.

How fast many bodies together move on the box of one: as a sweeping process does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import Consequence, Finding, IntervalBox, Scope, intersect_scopes, make_finding
from nsmodel.hypotheses.framework import SpeedBound
from nsmodel.hypotheses.inputs import NO_INPUT_BOUNDS, InputBounds
from nsmodel.hypotheses.region import ParameterValues, Region, findings_for_box, unaffected_findings
from nsmodel.models.many_bodies.check import check, known_start_point
from nsmodel.models.many_bodies.model import ManyBodies
from nsmodel.models.many_bodies.velocity import uniform_velocity_answer
from nsmodel.models.sweeping_process.check import (
    A5,
    A5_ACTIVE,
    CONSTRAINT_HYPOTHESES,
    S_F,
    S_START,
    sweeping_consequences,
)
from nsmodel.models.sweeping_process.constraint_bounds import ON_THE_BOX
from nsmodel.models.sweeping_process.inputs_and_parameters import state_for_each_signal, sweeping_speed_bound, velocity_norm_bound
from nsmodel.simulation.trajectory import Trajectory

READS = {hypothesis.id: ("constraints",) for hypothesis in (*CONSTRAINT_HYPOTHESES, A5, A5_ACTIVE, S_START)} | {
    S_F.id: ("f", "constraints")
}


def special_values(model: ManyBodies, box: IntervalBox) -> list[ParameterValues]:
    """No values are special."""
    return []


def uniform_findings(model: ManyBodies, region: Region, quick: bool) -> list[Finding]:
    """What is decided for all values of the parameters, whose boxes are those of ``region``."""
    return findings_for_box([velocity_finding(model, region)], unaffected_findings(check, model, region, quick, READS), region)


def velocity_finding(model: ManyBodies, region: Region, motion: InputBounds = NO_INPUT_BOUNDS) -> Finding | None:
    """S-f for all values; None where it is not proved."""
    answer = uniform_velocity_answer(model, region, motion)
    if answer is None:
        return None
    scope = region.scope(answer.where == ON_THE_BOX, bool(ca.depends_on(model.f, model.t)))
    return make_finding(S_F, answer.verdict, answer.how, answer.value, scope=scope)


def uniform_consequences(model: ManyBodies, region: Region, own: Sequence[Finding]) -> list[Consequence]:
    """What follows for all values of the parameters; nothing where gamma is not known."""
    known = {finding.id: finding.value for finding in own}
    if not all("gamma" in known[id] for id in (A5.id, A5_ACTIVE.id)):
        return []
    start = next(finding for finding in own if finding.id == S_START.id)
    count = sum(family.count for family in model.constraints.values())
    return sweeping_consequences(model, own, (), count, known_start_point(model, region, start))


DRIVEN_FIELDS = {"f": ("f",)}


def driven_findings(
    model: ManyBodies, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory], quick: bool
) -> list[Finding]:  # fmt: skip
    """Those at each value of the inputs, and S-f with the L_t of their rates; see the inclusions' module of this name."""
    del runs, quick
    made = velocity_finding(model, region, motion)
    if made is None:
        return list(own)
    made = replace(made, scope=intersect_scopes(made.scope, Scope(parameters=region.parameters)))
    return [made if finding.id == S_F.id else finding for finding in own]


def driven_consequences(
    model: ManyBodies, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory]
) -> list[Consequence]:  # fmt: skip
    """What follows for each signal."""
    del motion, runs
    return state_for_each_signal(uniform_consequences(model, region, own))


def speed_bound(
    model: ManyBodies, region: Region, findings: Sequence[Finding], known: Mapping[str, Consequence], h: float
) -> SpeedBound | None:  # fmt: skip
    """The pace on the box; None where it has no bound, as of a function of numbers."""
    if not isinstance(model.f, ca.SX):
        return None
    numbers, table = model.me.symbols[model.bodies.d :], model.bodies.table[:, model.bodies.d :]
    z = ca.vertcat(model.t, model.me.q, numbers)
    start, end = region.bounds_with_time()
    low, high = np.append(start, table.min(axis=0)), np.append(end, table.max(axis=0))
    return sweeping_speed_bound(velocity_norm_bound(model.f, z, low, high, model.bodies.count), findings, known["K_L"], h)
