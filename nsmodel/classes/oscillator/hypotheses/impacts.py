"""Impacts of oscillators: constraints of the positions act on accelerations alone."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.oscillator.model import FrictionOscillator
from nsmodel.solvers.impacts import ImpactStructure


def impact_system(model: FrictionOscillator) -> ImpactStructure | None:
    """s = (x, v): what moves an oscillator against its constraints; other forces are bounded, and do not enter y'."""
    if not model.constraint_names:
        return None
    c = ca.vertcat(*model.constraints.values())
    n, v = ca.SX.sym("n", c.numel()), ca.SX.sym("v", model.x.numel())
    s, slopes = ca.vertcat(model.x, v), ca.jacobian(c, model.x)
    F_l = ca.vertcat(ca.SX(v.numel(), c.numel()), slopes.T)
    start = ca.vertcat(model.x0 if model.x1 is None else model.x1, ca.SX.zeros(v.numel()) if model.v0 is None else model.v0)
    names = tuple(model.names or ())
    states = [*names, *(f"v of {name}" for name in names)]
    return ImpactStructure(
        model.t, s, n, ca.vertcat(v, slopes.T @ n), c, F_l, ca.jacobian(c, s), ca.SX(n.numel(), n.numel()), start,
        np.zeros(n.numel()), np.full(n.numel(), np.inf), states, model.constraint_names, -n.numel(),
    )  # fmt: skip
