"""The class in other units."""

from __future__ import annotations

from typing import Any

import casadi as ca

from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.classes.units import substitute_pairs


def in_units(model: SweepingProcess, u: float, tau: float, common: dict[str, Any]) -> SweepingProcess:
    """States u times and times tau times as large."""
    t, q = (model.t, model.t / tau), (model.q, model.q / u)
    constraints = {name: u * substitute_pairs(g, t, q) for name, g in model.constraints.items()}
    return SweepingProcess(
        q=model.q, f=u / tau * substitute_pairs(model.f, t, q), constraints=constraints, q0=u * ca.DM(model.q0),
        mean_forcing=model.mean_forcing, **common,
    )  # fmt: skip
