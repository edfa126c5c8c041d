"""The papers' schemes: each turns a model into the nonsmooth problem of one step."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.classes.bodies.schemes import many_bodies
from nsmodel.classes.first_order.model import FirstOrderSystem
from nsmodel.classes.first_order.schemes import theta_gamma
from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.inclusion.schemes import catching_up
from nsmodel.classes.lure.model import LureSystem
from nsmodel.classes.lure.schemes import implicit_euler
from nsmodel.classes.oscillator.model import FrictionOscillator
from nsmodel.classes.oscillator.schemes import inertial_proximal
from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.classes.sweeping.schemes import prediction_correction
from nsmodel.model.base import Model
from nsmodel.scheme.problem import OneStepProblem

SCHEMES: dict[type[Model], ModuleType] = {
    SweepingProcess: prediction_correction,
    FrictionOscillator: inertial_proximal,
    FirstOrderSystem: theta_gamma,
    LureSystem: implicit_euler,
    MonotoneInclusion: catching_up,
    ManyBodies: many_bodies,
}


def one_step_problem(model: Model) -> OneStepProblem:
    """Return the one-step problem of the paper's scheme for the model's class."""
    return SCHEMES[type(model)].one_step_problem(model)


def initial_rows(model: Any, h: float) -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Return (state, records) of the rows that are known before the first step; h is the first step."""
    return SCHEMES[type(model)].initial_rows(model, h)


def derived_columns(model: Any, arrays: dict[str, np.ndarray], h_next: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns that follow from others: reactions, energy. ``h_next`` is the step that starts at each row."""
    derive = getattr(SCHEMES[type(model)], "derived_columns", None)
    return {} if derive is None else derive(model, arrays, h_next)


def constraints(model: Any) -> ca.SX:
    """Return what the state is kept within, as rows c(t, state) >= 0."""
    if isinstance(model, SweepingProcess):
        return model.g
    if isinstance(model, MonotoneInclusion):
        return catching_up.constraints(model)[0]
    return ca.vertcat(ca.SX(0, 1), *getattr(model, "constraints", {}).values())


def shortened(model: Any, state: np.ndarray, ratio: float) -> np.ndarray:
    """Return the state before a last step that is shorter than the others by ``ratio``."""
    shorten = getattr(SCHEMES[type(model)], "shortened", None)
    return state if shorten is None else shorten(state, ratio)
