"""The class in other units."""

from __future__ import annotations

from typing import Any

import casadi as ca

from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.units import potential_expression, scaled_tolerances, substitute_pairs


def in_units(model: MonotoneInclusion, u: float, tau: float, common: dict[str, Any]) -> MonotoneInclusion:
    """States u times and times tau times as large."""
    x = (model.x, model.x / u), (model.t, model.t / tau)
    if model.potential_split is None:
        signs = ca.substitute([model.operator], [model.sign_symbols], [ca.sign(model.sign_arguments)])[0]
        nonlinear = {"operator": u / tau * substitute_pairs(signs if model.sign_symbols.numel() else model.operator, *x)}
    else:
        nonlinear = {"phi": u**2 / tau * substitute_pairs(potential_expression(model.potential_split), *x)}
    return MonotoneInclusion(
        x=model.x, x0=u * ca.DM(model.x0), field=u / tau * substitute_pairs(model.field, *x),
        lower=u * substitute_pairs(model.lower, *x), upper=u * substitute_pairs(model.upper, *x),
        constraints={name: u * substitute_pairs(c, *x) for name, c in model.constraints.items()},
        tolerances=scaled_tolerances(model.tolerances, u, tau), **nonlinear, **common,
    )  # fmt: skip
