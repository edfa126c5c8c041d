"""The theta-gamma scheme in NumPy, for matrices; potentials by their subgradients.

The class in other units.

What a step of a Lur'e system starts from, at any row of a run.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.models.first_order_system.reference_steps import states_with_input
from nsmodel.models.lure_system.model import LureSystem
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.study.reference_steps import (
    ReferenceStep,
    StepMagnitudes,
    StepResiduals,
    output_law_residual,
    output_with_error,
    subgradient_residual,
    theta_gamma_residual,
)
from nsmodel.study.units import scaled_law, substitute_pairs


def residuals(model: LureSystem, run: Trajectory) -> StepResiduals:
    """The theta-gamma scheme with M = I, f = A(x) + f(t), r = B l, y = C x + D l + e."""
    equation, sizes = _equation_residual(model, run)
    l = ca.SX.sym("l", model.B.shape[1])
    y = model.output(model.x, l)
    law = (
        output_law_residual(model, run, y, l, model.law, sizes)
        if model.law is not None
        else _potential_residual(model, run, y, l, sizes)
    )
    return {"equation": equation, **law}


def acting(model: LureSystem, run: Trajectory) -> np.ndarray:
    """The terms of the equation."""
    return _equation_residual(model, run)[1].acting


def _equation_residual(model: LureSystem, run: Trajectory) -> tuple[float, StepMagnitudes]:
    l = ca.SX.sym("l", model.B.shape[1])
    return theta_gamma_residual(
        model, run, l, model.A + model.f, ca.densify(model.B @ l), np.eye(model.x.numel()), run.multipliers
    )


def _potential_residual(model: LureSystem, run: Trajectory, output: ca.SX, l: ca.SX, sizes: StepMagnitudes) -> StepResiduals:
    """l ∈ -dPhi(y): Phi(z) >= Phi(y) - <l, z - y> at probes z."""
    y, s_y = output_with_error(model, run, output, l, sizes)
    size = np.abs(y).max(axis=1, keepdims=True) + np.abs(run.x[1:] - run.x[:-1]).max(axis=1, keepdims=True)
    return {"law": subgradient_residual(model.phi, model.y, y, -run.multipliers[1:], size, s_y)}


def in_units(model: LureSystem, u: float, tau: float, common: dict[str, Any]) -> LureSystem:
    """States u times and times tau times as large."""
    t, x = (model.t, model.t / tau), (model.x, model.x / u)
    law: dict[str, Any] = (
        {"law": scaled_law(model.law, u, model.t, tau)}
        if model.law is not None
        else {"y": model.y, "phi": u**2 * substitute_pairs(model.phi, (model.y, model.y / u))}
    )
    n = model.x.numel()
    other = LureSystem(
        x=model.x, x0=u * ca.DM(model.x0), A=ca.SX.zeros(n, n) if model.A.is_zero() else u / tau * substitute_pairs(model.A, x),
        B=model.B / tau, C=model.C, D=model.D, f=u / tau * substitute_pairs(model.f, t), e=u * substitute_pairs(model.e, t),
        theta=model.theta, gamma=model.gamma, **law, **common,
    )  # fmt: skip
    other._set(multiplier_names=model.multiplier_names)
    return other


def states(model: LureSystem, run: Trajectory, start: np.ndarray) -> Callable[[int, float], np.ndarray]:
    """(row, h) -> x, and B l where gamma < 1."""
    l = ca.SX.sym("l", model.B.shape[1])
    return states_with_input(model, l, model.B @ l, run, start)


REFERENCE_STEP = ReferenceStep(
    residuals=residuals,
    acting=acting,
    in_units=in_units,
    states_before_step=states,
)
