"""The theta-gamma scheme in NumPy.

The class in other units.

What a step of the theta-gamma scheme starts from, at any row of a run.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.modeling.base import Model
from nsmodel.models.first_order_system.model import FirstOrderSystem
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.study.reference_steps import ReferenceStep, StepMagnitudes, StepResiduals, output_law_residual, theta_gamma_residual
from nsmodel.study.units import scaled_law, substitute_pairs


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


def in_units(model: FirstOrderSystem, u: float, tau: float, common: dict[str, Any]) -> FirstOrderSystem:
    """States u times and times tau times as large."""
    t, x, l = (model.t, model.t / tau), (model.x, model.x / u), (model.lam, model.lam / u)
    law: dict[str, Any] = {
        "lam": model.lam, "h": u * substitute_pairs(model.h, t, x, l), "g": u / tau * substitute_pairs(model.g, t, x, l),
        "law": scaled_law(model.law, u, model.t, tau),
        "lam0": u * ca.DM(model.lam0),
    } if model.law.size else {}  # fmt: skip
    return FirstOrderSystem(
        x=model.x, x0=u * ca.DM(model.x0),
        f=u / tau * (substitute_pairs(model.f, t, x) if model.law.size else substitute_pairs(model.f + model.g, t, x)),
        M=model.M, theta=model.theta, gamma=model.gamma, **law, **common,
    )  # fmt: skip


def states(model: FirstOrderSystem, run: Trajectory, start: np.ndarray) -> Callable[[int, float], np.ndarray]:
    """(row, h) -> x, and r = g(t, x, l) where gamma < 1."""
    return states_with_input(model, model.lam, model.g, run, start)


def states_with_input(model: Model, l: ca.SX, r: ca.SX, run: Trajectory, start: np.ndarray) -> Callable[[int, float], np.ndarray]:
    """(row, h) -> x, and r where ``start``, the state at row 0, has it."""
    n = model.state.numel()
    if start.size == n:
        return lambda row, h: run.x[row]
    input = ca.Function("r", [model.t, model.state, l, model.u], [ca.densify(r)])
    u = run.arrays.get("inputs", np.zeros((len(run.t), 0)))

    def state(row: int, h: float) -> np.ndarray:
        here = start[n:] if row == 0 else np.array(input(float(run.t[row]), run.x[row], run.multipliers[row], u[row])).ravel()
        return np.concatenate([run.x[row], here])

    return state


REFERENCE_STEP = ReferenceStep(
    residuals=residuals,
    acting=acting,
    in_units=in_units,
    states_before_step=states,
)
