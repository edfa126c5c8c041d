"""Inclusions with inputs: what holds at each time and value of them, and how fast they move C.

F and S may be measurable in t, as a perturbation of a set that moves at a finite speed: u in them needs no rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType

import casadi as ca
import numpy as np

from nsmodel.classes.inclusion.hypotheses import moving
from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.inclusion.set_valued import set_constraints
from nsmodel.hypotheses.findings import Consequence, Finding
from nsmodel.hypotheses.inputs import InputBounds, scheme_limit_consequence, unknown_consequence
from nsmodel.hypotheses.region import Region
from nsmodel.proof import interval_bounds
from nsmodel.simulation.trajectory import Trajectory

DRIVEN_FIELDS = {"field": ("field",), "operator": ("operator", "sign_arguments"), "set": ("lower", "upper", "constraints")}
START_CONSEQUENCES = ("well posed", "convergence of the scheme")
PAIR_CONSEQUENCES = ("contraction", "stability")
START_TOLERANCE = 1e-10  # Of the start, by which it may be outside.
ALL_DRIVEN_FIELDS = tuple(field for fields in DRIVEN_FIELDS.values() for field in fields)


def parametric_model_and_region(
    model: MonotoneInclusion, region: Region, runs: Sequence[Trajectory]
) -> tuple[MonotoneInclusion, Region]:  # fmt: skip
    """The inclusion that stands still at t, a parameter as all others, and the region with the times among its parameters."""
    del runs
    if not model.moves:
        return model, region
    boxes = {**region.parameters, str(model.t): (region.t0, region.t1)}
    return moving.time_as_parameter(model), replace(region, parameters=MappingProxyType(boxes))


def driven_findings(
    model: MonotoneInclusion, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory], quick: bool
) -> list[Finding]:  # fmt: skip
    """Those at each time and value of the inputs, and M-H.

    Args:
        model: its inputs are parameters.
        region: with the boxes of parameters and inputs.
        motion: the inputs.
        own: what was found at each time and value.
        runs: with the signals of the model; quick: no searches.
    """
    del runs
    time = region.t0, region.t1
    timed = [moving.finding_in_time(finding, str(model.t), time) for finding in own] if model.moves else list(own)
    return [*timed, moving.set_motion_finding(model, region, motion, quick)]


def driven_consequences(
    model: MonotoneInclusion, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory]
) -> list[Consequence]:  # fmt: skip
    """What follows of solutions for each signal; see `findings`."""
    made = moving.moving_consequences(model, own, runs)
    made = [
        replace(item, statement=f"{item.statement}, of two solutions of one signal") if item.name in PAIR_CONSEQUENCES else item
        for item in made
    ]
    read = motion.indices_read_by(*(getattr(model, name) for name in ALL_DRIVEN_FIELDS))
    made = [scheme_limit_consequence(item, motion, read) if item.name == "convergence of the scheme" else item for item in made]
    if not _starts_inside(model, region, motion):
        why = "x0 is not seen to be in C(0) for all u(0)"
        made = [unknown_consequence(item, why) if item.name in START_CONSEQUENCES else item for item in made]
    return made


def _starts_inside(model: MonotoneInclusion, region: Region, motion: InputBounds) -> bool:
    """Whether x0 lies in C(0) for all u(0+), as nearly as runs ask for."""
    at_start = ca.substitute(set_constraints(model)[0], ca.vertcat(model.t, model.x), ca.vertcat(0, model.x0))
    if not (at_start.numel() and ca.depends_on(at_start, motion.u)):
        return True  # a start outside of a set that inputs do not move is refused by runs
    low, high = region.parameter_bounds()
    names = list(region.parameters)
    for name, value in motion.start.items():
        low[names.index(name)] = high[names.index(name)] = value
    size = float(np.max(np.abs(interval_bounds.enclose(model.x0, model.p, low, high)), initial=0.0))
    return bool((interval_bounds.enclose(at_start, model.p, low, high)[0] >= -START_TOLERANCE * (1 + size)).all())
