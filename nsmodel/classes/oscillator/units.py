"""The class in other units."""

from __future__ import annotations

from typing import Any

import casadi as ca

from nsmodel.classes.oscillator.model import FrictionOscillator
from nsmodel.classes.units import substitute_pairs


def in_units(model: FrictionOscillator, u: float, tau: float, common: dict[str, Any]) -> FrictionOscillator:
    """States u times and times tau times as large."""
    t, x = (model.t, model.t / tau), (model.x, model.x / u)
    friction = {e.name: (e.H, u**2 / tau**3 * substitute_pairs(e.theta, (model.s, model.s * tau / u), t)) for e in model.elements}
    start = {"v0": u / tau * ca.DM(model.v0)} if model.x1 is None else {"x1": u * ca.DM(model.x1)}
    return FrictionOscillator(
        x=model.x, x0=u * ca.DM(model.x0), potential=(u / tau) ** 2 * substitute_pairs(model.potential, x), friction=friction,
        s=model.s,
        damping=None if model.damping is None else model.damping / tau, force=u / tau**2 * substitute_pairs(model.force, t),
        constraints={name: u * substitute_pairs(c, x) for name, c in model.constraints.items()}, **start, **common,
    )  # fmt: skip
