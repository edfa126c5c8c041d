"""x' = A(x) + f(t) + B l,   y = C x + D l + e(t),   -y ∈ N_K(l) or l ∈ -dPhi(y)."""

from __future__ import annotations

import casadi as ca

from nsmodel.classes.lure.model import LureSystem
from nsmodel.classes.lure.schemes.theta_gamma import law_rows
from nsmodel.event_driven.problem import ContinuousProblem
from nsmodel.modeling.laws import equality, product


def continuous_problem(model: LureSystem) -> ContinuousProblem:
    """Return the model in continuous time; where Phi is given and D is not 0, y = C x + D l(y) + e are rows too, with y free."""
    law = law_rows(model, model.x, model.e)
    l, names = ca.vertcat(law.l, law.z), (*law.rows, *(f"y_{i}" for i in range(law.z.numel())))
    r = ca.densify(model.B @ law.multipliers)
    at_rest = ca.substitute(r, l, ca.SX.zeros(l.numel()))
    return ContinuousProblem(
        t=model.t, x=model.x, l=l, p=model.p,
        f=model.A + model.f + at_rest, g=r - at_rest, h=ca.vertcat(law.Y, law.E),
        law=product(law.law, equality(law.z.numel())), rows=names, names=tuple(model.names), x0=model.x0,
        states=model.x.numel(), multipliers=law.multipliers if law.rewritten else None,
        outputs=law.outputs if law.rewritten else None, declared=model.multiplier_names, ends=law.ends,
    )  # fmt: skip
