"""What a run of an inclusion looks at before it starts: its potential, its bounds, x0 in C."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.inclusion.set_valued import set_constraints
from nsmodel.errors import UsageError
from nsmodel.solvers.initial_checks import (
    check_start_inside,
    check_term_weights,
    parameter_values_text,
    start_margin,
    symbolic_term_weights,
)


def check_start(model: MonotoneInclusion) -> None:
    """Refuse weights < 0 of Phi, lower >= upper, and x0 outside C."""
    if model.potential_split is not None:
        check_term_weights(model.potential_split, "phi", model)
    low, high = (np.array(ca.DM(ca.substitute(bound, model.t, 0))).ravel() for bound in (model.lower, model.upper))
    for i in np.flatnonzero(~(low < high)):
        raise UsageError(
            f"lower[{i}] = {low[i]:g}, upper[{i}] = {high[i]:g}{parameter_values_text(model)}: C needs an interior, lower < upper"
        )
    check_start_inside(*set_constraints(model), model, "x0")


def admitted(model: MonotoneInclusion) -> list[ca.SX]:
    """That, of all values of the parameters."""
    low, high = (ca.substitute(bound, model.t, 0) for bound in (model.lower, model.upper))
    own = [] if model.potential_split is None else [symbolic_term_weights(model.potential_split)]
    return [*own, ca.if_else(low < high, 1, -1), start_margin(set_constraints(model)[0], model, "x0")]


def warnings(model: MonotoneInclusion) -> list[str]:
    """Nothing beside what the step shows."""
    return []
