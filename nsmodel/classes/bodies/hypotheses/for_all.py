"""Hypotheses of many bodies for all values of parameters in a box: those whose parts do not depend on them, and S-f."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from nsmodel.classes.bodies.hypotheses.check import check
from nsmodel.classes.bodies.hypotheses.velocity import uniform_velocity_answer
from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.classes.sweeping.hypotheses.check import A5, A5_ACTIVE, HYPOTHESES, S_F
from nsmodel.classes.sweeping.hypotheses.consequences import sweeping_consequences
from nsmodel.classes.sweeping.hypotheses.constraint import ON_THE_BOX
from nsmodel.hypotheses.findings import Consequence, Finding, make_finding
from nsmodel.hypotheses.inputs import NO_INPUT_BOUNDS, InputBounds
from nsmodel.hypotheses.region import Region
from nsmodel.hypotheses.scope import IntervalBox
from nsmodel.hypotheses.uniform import ParameterValues, findings_for_box, unaffected_findings

READS = {hypothesis.id: ("constraints",) for hypothesis in HYPOTHESES} | {S_F.id: ("f", "constraints")}


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
    return sweeping_consequences(model, own, (), sum(family.count for family in model.constraints.values()))
