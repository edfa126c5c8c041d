"""Oscillators whose force or friction has inputs: at each time theta is one function, and a step has one solution."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from nsmodel.classes.oscillator.hypotheses.check import CABOT_PAPER, FORCED_TEXT, O_STEPS, forced_steps_finding, order_consequence
from nsmodel.classes.oscillator.model import FrictionOscillator
from nsmodel.classes.oscillator.schemes.inertial_proximal import elements_at_end
from nsmodel.hypotheses.findings import Consequence, Finding, make_consequence
from nsmodel.hypotheses.inputs import InputBounds, unknown_consequence
from nsmodel.hypotheses.moving_law import time_as_input
from nsmodel.hypotheses.region import Region
from nsmodel.simulation.trajectory import Trajectory

DRIVEN_FIELDS = {"force": ("force",), "friction": ("elements",)}


def freeze_law(model: FrictionOscillator) -> FrictionOscillator:
    """The oscillator with time in its friction as an input: at each time theta is one function."""
    if not any(ca.depends_on(element.theta, model.t) for element in model.elements):
        return model
    return time_as_input(model, lambda tau: {"elements": elements_at_end(model, tau, model.u)})


def driven_findings(
    model: FrictionOscillator, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory],
    quick: bool
) -> list[Finding]:  # fmt: skip
    """Those at each value of the inputs, but for the steps; see the inclusions' module of this name."""
    del model, region, motion, quick
    return [forced_steps_finding(runs) if item.id == O_STEPS.id and runs else item for item in own]


def driven_consequences(
    model: FrictionOscillator, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory]
) -> list[Consequence]:  # fmt: skip
    """A step has one solution; nothing is said of rest."""
    del model, region, motion, runs
    well = make_consequence(
        "well posed", "each step has one and only one solution", own, ["O-theta", "O-g"], f"{CABOT_PAPER}, Proposition 2.1"
    )
    rest = make_consequence("convergence", "x_n converges", own, [item.id for item in own], f"{CABOT_PAPER}, Theorem 4.1")
    return [well, unknown_consequence(rest, FORCED_TEXT), order_consequence()]
