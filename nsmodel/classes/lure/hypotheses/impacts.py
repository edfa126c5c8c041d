"""Impacts of Lur'e systems: where D and C B are 0, a multiplier acts too late to hold its row."""

from __future__ import annotations

import casadi as ca

from nsmodel.classes.lure.model import LureSystem
from nsmodel.solvers.impacts import ImpactStructure, impact_structure


def impact_system(model: LureSystem) -> ImpactStructure | None:
    """The model as a system; None where phi stands in for a law."""
    if model.law is None or not model.law.size:
        return None
    l = ca.SX.sym("l", model.law.size)
    F, Y = model.A + model.f + model.B @ l, model.output(model.x, l)
    return impact_structure(model, model.law, l, F, Y, (model.B, model.C, model.D), "y' (C B = 0)")
