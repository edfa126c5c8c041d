"""The papers' schemes: each turns a model into the nonsmooth problem of one step."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.classes.registry import class_of
from nsmodel.model.base import Model
from nsmodel.model.driven import initial_inputs
from nsmodel.once import cached_per_object
from nsmodel.scheme.problem import OneStepProblem


@cached_per_object
def one_step_problem(model: Model) -> OneStepProblem:
    """Return the one-step problem of the model's scheme."""
    return _scheme_module(model).one_step_problem(model)


def initial_rows(model: Any, h: float) -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Return (state, records) of the rows that are known before the first step; h is the first step."""
    rows = _scheme_module(model).initial_rows(model, h)
    u = initial_inputs(model, rows[0][0][: len(model.names)])
    return [(np.concatenate([state, u, u]), records) for state, records in rows]


def symbolic_initial_rows(model: Any, h: ca.SX) -> list[tuple[ca.SX, dict[str, ca.SX]]]:
    """The same as `initial_rows` as expressions of h and the parameters, the state as far as the model's own names go."""
    own = getattr(_scheme_module(model), "start_rows", None)
    return [(model.start, {})] if own is None else own(model, h)


def symbolic_start_state(model: Any, h: ca.SX) -> ca.SX | None:
    """Return the state that the first step starts from as an expression of h, where the scheme has one of its own."""
    own = getattr(_scheme_module(model), "start_of", None)
    return None if own is None else ca.vertcat(own(model, h), np.tile(initial_inputs(model), 2))


def derived_columns(model: Any, arrays: dict[str, np.ndarray], h_next: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns that follow from others: reactions, energy. ``h_next`` is the step that starts at each row."""
    derive = getattr(_scheme_module(model), "derived_columns", None)
    return {} if derive is None else derive(model, arrays, h_next)


def state_constraints(model: Any) -> ca.SX:
    """Return what the state is kept within, as rows c(t, state) >= 0."""
    kept = getattr(_scheme_module(model), "kept_within", None)
    return ca.vertcat(ca.SX(0, 1), *getattr(model, "constraints", {}).values()) if kept is None else kept(model)


def state_before_short_step(model: Any, state: np.ndarray, ratio: float) -> np.ndarray:
    """Return the state before a last step that is shorter than the others by ``ratio``."""
    shorten, own = getattr(_scheme_module(model), "shortened", None), state.size - 2 * model.u.numel()
    return state if shorten is None else np.concatenate([shorten(model, state[:own], ratio), state[own:]])


def _scheme_module(model: Any) -> ModuleType:
    return class_of(model).scheme(model.scheme)
