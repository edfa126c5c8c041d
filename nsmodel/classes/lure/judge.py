"""The theta-gamma scheme in NumPy, for matrices; potentials by their subgradients."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.lure.model import LureSystem
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.study.reference_steps import (
    StepMagnitudes,
    StepResiduals,
    output_law_residual,
    output_with_error,
    subgradient_residual,
    theta_gamma_residual,
)


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
