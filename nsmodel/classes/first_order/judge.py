"""The theta-gamma scheme in NumPy."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.first_order.model import FirstOrderSystem
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.study.reference_steps import StepMagnitudes, StepResiduals, output_law_residual, theta_gamma_residual


def residuals(model: FirstOrderSystem, run: Trajectory) -> StepResiduals:
    """M (x+ - x) = h (th f+ + (1-th) f) + h (ga r+ + (1-ga) r), r = g(t, x, l), y = h(t, x, l)."""
    equation, sizes = _theta_gamma_residual(model, run)
    law = output_law_residual(model, run, model.h, model.lam, model.law, sizes) if model.law.size else {}
    return {"equation": equation, **law}


def acting(model: FirstOrderSystem, run: Trajectory) -> np.ndarray:
    """The terms of the equation."""
    return _theta_gamma_residual(model, run)[1].acting


def _theta_gamma_residual(model: FirstOrderSystem, run: Trajectory) -> tuple[float, StepMagnitudes]:
    l = run.multipliers if model.law.size else np.zeros((len(run.t), 0))
    return theta_gamma_residual(model, run, model.lam, model.f, model.g, np.array(ca.DM(model.M)), l)
