"""Catching-up with approximate projections for maximal monotone inclusions (2026 paper, Definition 4.3).

    y_k = x_k + mu_k v_k,   v_k ∈ F(x_k) - S(x_k);     x_{k+1} ∈ C with |x_{k+1} - y_k|^2 < d_C(y_k)^2 + eps_k

Where S is discontinuous its element is free; the one taken minimises |P_{T_C(x)}(F - s)|, which keeps the state still when
it can stay. With T_C's polar, Moreau's decomposition makes that a small bound-constrained least-squares problem:
min |F - S(x, l) + grad c(x)' n|^2 over l in its face and n >= 0 on the active constraints.

What depends on time is taken at t_k in F and S, at t_{k+1} in C, as Moreau's own scheme for moving convex sets does (*Evolution
problem associated with a moving convex set in a Hilbert space*, 1977). Where the switching surfaces or C move, the state stays
on them by moving along: the least |F - S(x, l) - w + grad c' n| is taken, w the least velocity that all that meet at x share.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.inclusion.set_valued import set_constraints, velocity_selection
from nsmodel.modeling.laws import complementarity
from nsmodel.solvers.one_step_problem import OneStepProblem, Prediction, with_carried_inputs


def catching_up_problem(model: MonotoneInclusion) -> OneStepProblem:
    """Return the exact projection of the predictor (here the ``state``) on C: z - y_k - grad c(z)' n = 0, 0 <= n ⟂ c(z) >= 0."""
    h, predictor, z = ca.SX.sym("h"), ca.SX.sym("predictor", model.x.numel()), ca.SX.sym("x_next", model.x.numel())
    c, names = set_constraints(model)
    u_end = ca.SX.sym("u_next", model.u.numel())
    n, chosen = ca.SX.sym("n", c.numel()), velocity_selection(model)
    at_end = c, ca.jacobian(c, model.x)
    Y, J = ca.substitute(at_end, [model.t, model.x, model.u], [model.t + h, z, u_end]) if n.numel() else at_end
    problem = OneStepProblem(
        scheme="catching-up with approximate projections",
        t=model.t, h=h, state=predictor, p=model.p,
        z=z, l=n, y=ca.SX.sym("y", n.numel()),
        E=z - predictor - J.T @ n, Y=Y,
        law=complementarity(n.numel()),
        rows=names,
        guess=predictor,
        next_state=z,
        prediction=Prediction(
            model.x, chosen.l, chosen.velocity, chosen.u, chosen.law, c,
            None if model.constraints else (model.lower, model.upper), model.u, model.tolerances,
        ),
    )  # fmt: skip
    return with_carried_inputs(problem, model.u, u_end)


def initial_rows(model: MonotoneInclusion, h: float) -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """x_0."""
    return [(np.array(ca.DM(model.x0)).ravel(), {})]


def kept_within(model: MonotoneInclusion) -> ca.SX:
    """All that bounds C, boxes and the domain of phi included."""
    return set_constraints(model)[0]
