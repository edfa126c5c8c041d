"""Hypotheses of many bodies for all values of parameters in a box: those whose parts do not depend on them, and S-f."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from nsmodel.classes.bodies.hypotheses.check import check
from nsmodel.classes.bodies.hypotheses.velocity import velocity_of
from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.classes.sweeping.hypotheses.check import A5, A5_ACTIVE, HYPOTHESES, S_F
from nsmodel.classes.sweeping.hypotheses.consequences import consequences_of
from nsmodel.classes.sweeping.hypotheses.constraint import ON_THE_BOX
from nsmodel.hypotheses.findings import Consequence, Finding, found
from nsmodel.hypotheses.inputs import STILL, Motion
from nsmodel.hypotheses.region import Region
from nsmodel.hypotheses.scope import Box
from nsmodel.hypotheses.uniform import Values, for_the_box, untouched

READS = {hypothesis.id: ("constraints",) for hypothesis in HYPOTHESES} | {S_F.id: ("f", "constraints")}


def values(model: ManyBodies, box: Box) -> list[Values]:
    """No values are special."""
    return []


def findings(model: ManyBodies, region: Region, quick: bool) -> list[Finding]:
    """What is decided for all values of the parameters, whose boxes are those of ``region``."""
    return for_the_box([of_velocity(model, region)], untouched(check, model, region, quick, READS), region)


def of_velocity(model: ManyBodies, region: Region, motion: Motion = STILL) -> Finding | None:
    """S-f for all values; None where it is not proved."""
    answer = velocity_of(model, region, motion)
    if answer is None:
        return None
    scope = region.scope(answer.where == ON_THE_BOX, bool(ca.depends_on(model.f, model.t)))
    return found(S_F, answer.verdict, answer.how, answer.value, scope=scope)


def consequences(model: ManyBodies, region: Region, own: Sequence[Finding]) -> list[Consequence]:
    """What follows for all values of the parameters; nothing where gamma is not known."""
    known = {finding.id: finding.value for finding in own}
    if not all("gamma" in known[id] for id in (A5.id, A5_ACTIVE.id)):
        return []
    return consequences_of(model, own, (), sum(family.count for family in model.constraints.values()))
