"""Impacts of first-order systems: where h_l and h_x M^-1 g_l are 0, a multiplier acts too late to hold its row."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.first_order.model import FirstOrderSystem
from nsmodel.solvers.impacts import ImpactStructure, impact_structure
from nsmodel.solvers.rounding_errors import equilibrate_matrix


def impact_system(model: FirstOrderSystem) -> ImpactStructure | None:
    """The model as a system; None where there is no law, or M has no inverse."""
    if not model.law.size or _is_mass_singular(model.M):
        return None
    x, l, Y = model.x, model.lam, model.h
    F = ca.solve(model.M, model.f + model.g) if not _is_identity(model.M) else model.f + model.g
    return impact_structure(model, model.law, l, F, Y, (ca.jacobian(F, l), ca.jacobian(Y, x), ca.jacobian(Y, l)))


def _is_mass_singular(M: ca.SX) -> bool:
    """Whether M, a constant matrix, has no inverse that double precision would know."""
    return M.is_constant() and bool(np.linalg.matrix_rank(equilibrate_matrix(np.array(ca.DM(M)))[0]) < M.shape[0])


def _is_identity(M: ca.SX) -> bool:
    return (M - ca.SX.eye(M.shape[0])).is_zero()
