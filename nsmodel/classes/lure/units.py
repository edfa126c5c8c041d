"""The class in other units."""

from __future__ import annotations

from typing import Any

import casadi as ca

from nsmodel.classes.lure.model import LureSystem
from nsmodel.classes.units import scaled_law, substitute_pairs


def in_units(model: LureSystem, u: float, tau: float, common: dict[str, Any]) -> LureSystem:
    """States u times and times tau times as large."""
    t, x = (model.t, model.t / tau), (model.x, model.x / u)
    law = (
        {"law": scaled_law(model.law, u, model.t, tau)}
        if model.law is not None
        else {"y": model.y, "phi": u**2 * substitute_pairs(model.phi, (model.y, model.y / u))}
    )
    n = model.x.numel()
    other = LureSystem(
        x=model.x, x0=u * ca.DM(model.x0), A=ca.SX.zeros(n, n) if model.A.is_zero() else u / tau * substitute_pairs(model.A, x),
        B=model.B / tau, C=model.C, D=model.D, f=u / tau * substitute_pairs(model.f, t), e=u * substitute_pairs(model.e, t),
        theta=model.theta, gamma=model.gamma, **law, **common,
    )  # fmt: skip
    other._set(multiplier_names=model.multiplier_names)
    return other
