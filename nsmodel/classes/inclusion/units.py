"""The class in other units."""

from __future__ import annotations

from typing import Any

import casadi as ca

from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.units import at, potential, scaled_tolerances


def in_units(model: MonotoneInclusion, u: float, tau: float, common: dict[str, Any]) -> MonotoneInclusion:
    """States u times and times tau times as large."""
    x = (model.x, model.x / u), (model.t, model.t / tau)
    if model.potential_split is None:
        signs = ca.substitute([model.operator], [model.sign_symbols], [ca.sign(model.sign_arguments)])[0]
        nonlinear = {"operator": u / tau * at(signs if model.sign_symbols.numel() else model.operator, *x)}
    else:
        nonlinear = {"phi": u**2 / tau * at(potential(model.potential_split), *x)}
    return MonotoneInclusion(
        x=model.x, x0=u * ca.DM(model.x0), field=u / tau * at(model.field, *x),
        lower=u * at(model.lower, *x), upper=u * at(model.upper, *x),
        constraints={name: u * at(c, *x) for name, c in model.constraints.items()},
        tolerances=scaled_tolerances(model.tolerances, u, tau), **nonlinear, **common,
    )  # fmt: skip
