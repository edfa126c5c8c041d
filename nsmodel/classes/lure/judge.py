"""The theta-gamma scheme in NumPy, for matrices; potentials by their subgradients."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.lure.model import LureSystem
from nsmodel.stress.measures import Misfits, Sizes, output_of, outputs_misfit, subgradient_misfit
from nsmodel.stress.theta_gamma import theta_misfit
from nsmodel.trajectory import Trajectory


def misfits(model: LureSystem, run: Trajectory) -> Misfits:
    """The theta-gamma scheme with M = I, f = A(x) + f(t), r = B l, y = C x + D l + e."""
    equation, sizes = _stepped(model, run)
    l = ca.SX.sym("l", model.B.shape[1])
    y = model.output(model.x, l)
    law = outputs_misfit(model, run, y, l, model.law, sizes) if model.law is not None else _potential(model, run, y, l, sizes)
    return {"equation": equation, **law}


def acting(model: LureSystem, run: Trajectory) -> np.ndarray:
    """The terms of the equation."""
    return _stepped(model, run)[1].acting


def _stepped(model: LureSystem, run: Trajectory) -> tuple[float, Sizes]:
    l = ca.SX.sym("l", model.B.shape[1])
    return theta_misfit(model, run, l, model.A + model.f, ca.densify(model.B @ l), np.eye(model.x.numel()), run.multipliers)


def _potential(model: LureSystem, run: Trajectory, output: ca.SX, l: ca.SX, sizes: Sizes) -> Misfits:
    """l ∈ -dPhi(y): Phi(z) >= Phi(y) - <l, z - y> at probes z."""
    y, s_y = output_of(model, run, output, l, sizes)
    size = np.abs(y).max(axis=1, keepdims=True) + np.abs(run.x[1:] - run.x[:-1]).max(axis=1, keepdims=True)
    return {"law": subgradient_misfit(model.phi, model.y, y, -run.multipliers[1:], size, s_y)}
