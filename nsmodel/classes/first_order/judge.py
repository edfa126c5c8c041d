"""The theta-gamma scheme in NumPy."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.first_order.model import FirstOrderSystem
from nsmodel.stress.measures import Misfits, Sizes, outputs_misfit
from nsmodel.stress.theta_gamma import theta_misfit
from nsmodel.trajectory import Trajectory


def misfits(model: FirstOrderSystem, run: Trajectory) -> Misfits:
    """M (x+ - x) = h (th f+ + (1-th) f) + h (ga r+ + (1-ga) r), r = g(t, x, l), y = h(t, x, l)."""
    equation, sizes = _stepped(model, run)
    law = outputs_misfit(model, run, model.h, model.lam, model.law, sizes) if model.law.size else {}
    return {"equation": equation, **law}


def acting(model: FirstOrderSystem, run: Trajectory) -> np.ndarray:
    """The terms of the equation."""
    return _stepped(model, run)[1].acting


def _stepped(model: FirstOrderSystem, run: Trajectory) -> tuple[float, Sizes]:
    l = run.multipliers if model.law.size else np.zeros((len(run.t), 0))
    return theta_misfit(model, run, model.lam, model.f, model.g, np.array(ca.DM(model.M)), l)
