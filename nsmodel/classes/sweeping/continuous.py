"""q' = f(t, q) + grad g(t, q) l,   0 <= l ⟂ g(t, q) >= 0: the sweeping process with its reactions l."""

from __future__ import annotations

import casadi as ca

from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.event_driven.problem import ContinuousProblem
from nsmodel.modeling.expressions import derivatives
from nsmodel.modeling.laws import complementarity


def continuous_problem(model: SweepingProcess) -> ContinuousProblem:
    """Return the model in continuous time; the constraints are the rows themselves."""
    l = ca.SX.sym("l", model.g.numel())
    return ContinuousProblem(
        t=model.t, x=model.q, l=l, p=model.p,
        f=model.f, g=ca.densify(derivatives(model.g, model.q).T @ l), h=model.g,
        law=complementarity(l.numel()), rows=model.multiplier_names, names=tuple(model.names), x0=model.q0,
        states=model.q.numel(), impulses=True,
    )  # fmt: skip
