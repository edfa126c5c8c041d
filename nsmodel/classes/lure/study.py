"""What a step of a Lur'e system starts from, at any row of a run."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from nsmodel.classes.first_order.study import states_with_input
from nsmodel.classes.lure.model import LureSystem
from nsmodel.simulation.trajectory import Trajectory


def states(model: LureSystem, run: Trajectory, start: np.ndarray) -> Callable[[int, float], np.ndarray]:
    """(row, h) -> x, and B l where gamma < 1."""
    l = ca.SX.sym("l", model.B.shape[1])
    return states_with_input(model, l, model.B @ l, run, start)
