"""Oscillators whose force or friction has inputs: at each time theta is one function, and a step has one solution."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from nsmodel.classes.oscillator.hypotheses.check import FORCED, PAPER, STEPS, no_order, steps_of_forced
from nsmodel.classes.oscillator.model import FrictionOscillator
from nsmodel.classes.oscillator.schemes.inertial_proximal import at_end
from nsmodel.hypotheses.findings import Consequence, Finding, follows
from nsmodel.hypotheses.inputs import Motion, unsettled
from nsmodel.hypotheses.moving_law import timed
from nsmodel.hypotheses.region import Region
from nsmodel.trajectory import Trajectory

PARTS = {"force": ("force",), "friction": ("elements",)}


def standing(model: FrictionOscillator) -> FrictionOscillator:
    """The oscillator with time in its friction as an input: at each time theta is one function."""
    if not any(ca.depends_on(element.theta, model.t) for element in model.elements):
        return model
    return timed(model, lambda tau: {"elements": at_end(model, tau, model.u)})


def findings(
    model: FrictionOscillator, region: Region, motion: Motion, own: Sequence[Finding], runs: Sequence[Trajectory], quick: bool
) -> list[Finding]:  # fmt: skip
    """Those at each value of the inputs, but for the steps; see the inclusions' module of this name."""
    del model, region, motion, quick
    return [steps_of_forced(runs) if item.id == STEPS.id and runs else item for item in own]


def consequences(
    model: FrictionOscillator, region: Region, motion: Motion, own: Sequence[Finding], runs: Sequence[Trajectory]
) -> list[Consequence]:  # fmt: skip
    """A step has one solution; nothing is said of rest."""
    del model, region, motion, runs
    well = follows("well posed", "each step has one and only one solution", own, ["O-theta", "O-g"], f"{PAPER}, Proposition 2.1")
    rest = follows("convergence", "x_n converges", own, [item.id for item in own], f"{PAPER}, Theorem 4.1")
    return [well, unsettled(rest, FORCED), no_order()]
