"""M x' = f(t, x) + g(t, x, l),   y = h(t, x, l),   -y ∈ N_K(l), with M divided out."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.first_order.model import FirstOrderSystem
from nsmodel.event_driven.problem import ContinuousProblem, NotEventDriven
from nsmodel.solvers.one_step_problem import rewrite_as_basic_law

SINGULAR_MASS = "M is singular: its rows without x' are equations, which need steps; take method='time-stepping'"


def continuous_problem(model: FirstOrderSystem) -> ContinuousProblem:
    """Return the model in continuous time.

    Raises:
        NotEventDriven: M is singular: a row of it is an algebraic equation.
    """
    basic = rewrite_as_basic_law(
        model.law, model.multiplier_names, y := ca.SX.sym("y", model.law.size), ca.vertcat(model.t, model.u)
    )
    g, h = ca.substitute([model.g, model.h], [model.lam], [basic.multipliers]) if model.law.size else (model.g, model.h)
    at_rest = ca.substitute(g, basic.l, ca.SX.zeros(basic.l.numel()))
    inverse, split = _inverse_mass(model.M), basic.differs
    return ContinuousProblem(
        t=model.t, x=model.x, l=basic.l, p=model.p,
        f=inverse @ (model.f + at_rest), g=inverse @ ca.densify(g - at_rest), h=ca.substitute(basic.y, y, h),
        law=basic.law, rows=basic.rows, names=tuple(model.names), x0=model.x0,
        states=model.x.numel(), multipliers=basic.multipliers if split else None, outputs=h if split else None,
        declared=model.multiplier_names, ends=basic.ends,
    )  # fmt: skip


def _inverse_mass(M: ca.SX) -> ca.SX:
    if (M - ca.SX.eye(M.shape[0])).is_zero():
        return ca.SX.eye(M.shape[0])
    if not M.is_constant():
        if ca.sprank(M) < M.shape[0]:
            raise NotEventDriven(SINGULAR_MASS)
        return ca.inv(ca.densify(M))
    numbers = np.array(ca.DM(M))
    if np.linalg.matrix_rank(numbers) < numbers.shape[0]:
        raise NotEventDriven(SINGULAR_MASS)
    return ca.SX(ca.sparsify(ca.DM(np.linalg.inv(numbers))))
