"""Many bodies with inputs, which stand in f alone: f may be measurable in t, and the constraints do not know of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from nsmodel.classes.bodies.hypotheses import for_all
from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.classes.sweeping.hypotheses.check import S_F
from nsmodel.classes.sweeping.hypotheses.driven import state_for_each_signal
from nsmodel.hypotheses.findings import Consequence, Finding
from nsmodel.hypotheses.inputs import InputBounds
from nsmodel.hypotheses.region import Region
from nsmodel.hypotheses.scope import Scope, intersect_scopes
from nsmodel.simulation.trajectory import Trajectory

DRIVEN_FIELDS = {"f": ("f",)}


def driven_findings(
    model: ManyBodies, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory], quick: bool
) -> list[Finding]:  # fmt: skip
    """Those at each value of the inputs, and S-f with the L_t of their rates; see the inclusions' module of this name."""
    del runs, quick
    made = for_all.velocity_finding(model, region, motion)
    if made is None:
        return list(own)
    made = replace(made, scope=intersect_scopes(made.scope, Scope(parameters=region.parameters)))
    return [made if finding.id == S_F.id else finding for finding in own]


def driven_consequences(
    model: ManyBodies, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory]
) -> list[Consequence]:  # fmt: skip
    """What follows for each signal."""
    del motion, runs
    return state_for_each_signal(for_all.uniform_consequences(model, region, own))
