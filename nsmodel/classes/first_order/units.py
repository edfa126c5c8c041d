"""The class in other units."""

from __future__ import annotations

from typing import Any

import casadi as ca

from nsmodel.classes.first_order.model import FirstOrderSystem
from nsmodel.classes.units import at, scaled_law


def in_units(model: FirstOrderSystem, u: float, tau: float, common: dict[str, Any]) -> FirstOrderSystem:
    """States u times and times tau times as large."""
    t, x, l = (model.t, model.t / tau), (model.x, model.x / u), (model.lam, model.lam / u)
    law = {
        "lam": model.lam, "h": u * at(model.h, t, x, l), "g": u / tau * at(model.g, t, x, l),
        "law": scaled_law(model.law, u, model.t, tau),
        "lam0": u * ca.DM(model.lam0),
    } if model.law.size else {}  # fmt: skip
    return FirstOrderSystem(
        x=model.x, x0=u * ca.DM(model.x0), f=u / tau * (at(model.f, t, x) if model.law.size else at(model.f + model.g, t, x)),
        M=model.M, theta=model.theta, gamma=model.gamma, **law, **common,
    )  # fmt: skip
