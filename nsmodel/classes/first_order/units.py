"""The class in other units."""

from __future__ import annotations

from typing import Any

import casadi as ca

from nsmodel.classes.first_order.model import FirstOrderSystem
from nsmodel.classes.units import scaled_law, substitute_pairs


def in_units(model: FirstOrderSystem, u: float, tau: float, common: dict[str, Any]) -> FirstOrderSystem:
    """States u times and times tau times as large."""
    t, x, l = (model.t, model.t / tau), (model.x, model.x / u), (model.lam, model.lam / u)
    law = {
        "lam": model.lam, "h": u * substitute_pairs(model.h, t, x, l), "g": u / tau * substitute_pairs(model.g, t, x, l),
        "law": scaled_law(model.law, u, model.t, tau),
        "lam0": u * ca.DM(model.lam0),
    } if model.law.size else {}  # fmt: skip
    return FirstOrderSystem(
        x=model.x, x0=u * ca.DM(model.x0),
        f=u / tau * (substitute_pairs(model.f, t, x) if model.law.size else substitute_pairs(model.f + model.g, t, x)),
        M=model.M, theta=model.theta, gamma=model.gamma, **law, **common,
    )  # fmt: skip
