"""What the functions of a model of many bodies give: they are known by that."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.modeling.time_grid import TimeGrid


def values_of_functions(model: ManyBodies, grid: TimeGrid) -> list[np.ndarray]:
    """The velocities at the start, where they are a function."""
    return [] if isinstance(model.f, ca.SX) else [np.array(model.f(0.0, model.bodies.q0.copy()), float)]
