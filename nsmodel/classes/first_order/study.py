"""What a step of the theta-gamma scheme starts from, at any row of a run."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from nsmodel.classes.first_order.model import FirstOrderSystem
from nsmodel.modeling.base import Model
from nsmodel.simulation.trajectory import Trajectory


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
