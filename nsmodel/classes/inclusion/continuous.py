"""x' = F(t, x) - S(t, x, l) + grad c' n,   -u(t, x) ∈ N_K(l),   0 <= n ⟂ c(t, x) >= 0: T = S + N_C with its elements named."""

from __future__ import annotations

import casadi as ca

from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.inclusion.set_valued import set_constraints, velocity_selection
from nsmodel.event_driven.problem import ContinuousProblem
from nsmodel.modeling.laws import complementarity, product


def continuous_problem(model: MonotoneInclusion) -> ContinuousProblem:
    """Return the model in continuous time; ``v`` is F - S, as in the schemes."""
    chosen, (c, names) = velocity_selection(model), set_constraints(model)
    n = ca.SX.sym("n", c.numel())
    smooth = ca.substitute(chosen.velocity, chosen.l, ca.SX.zeros(chosen.l.numel()))
    return ContinuousProblem(
        t=model.t, x=model.x, l=ca.vertcat(chosen.l, n), p=model.p,
        f=smooth, g=ca.densify(chosen.velocity - smooth + ca.jacobian(c, model.x).T @ n), h=ca.vertcat(chosen.u, c),
        law=product(chosen.law, complementarity(n.numel())),
        rows=(*(f"selection[{i}]" for i in range(chosen.l.numel())), *names), names=tuple(model.names), x0=model.x0,
        states=model.x.numel(), records={"v": chosen.velocity, "selection": chosen.l},
    )  # fmt: skip
