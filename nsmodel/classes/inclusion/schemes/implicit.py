"""The implicit scheme of a maximal monotone inclusion: x_{k+1} = (I + h T)^{-1}(x_k + h F(x_k)), T = S + N_C.

The resolvent of a maximal monotone operator is defined everywhere and single-valued (Minty's theorem; Bauschke and Combettes,
*Convex Analysis and Monotone Operator Theory in Hilbert Spaces*, 2011, Theorem 21.1, Corollary 23.9). F alone is explicit: a
state that can stay does so at every step, where catching-up goes to and fro about a discontinuity of S. With time, F is taken at
t_k, S and C at t_{k+1}.

    z - x_k - h F(t_k, x_k) + h S(t_{k+1}, z, l) - h grad c(t_{k+1}, z)' n = 0
    -u(t_{k+1}, z) ∈ N_K(l),    0 <= n ⟂ c(t_{k+1}, z) >= 0

Where S has beta Sgn(u) in the direction of grad u, l is beta times the sign: then W is symmetric.
"""

from __future__ import annotations

import casadi as ca

from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.inclusion.schemes.catching_up import initial_rows, kept_within
from nsmodel.classes.inclusion.set_valued import Selection, set_constraints, velocity_selection
from nsmodel.modeling.laws import complementarity, product, relay
from nsmodel.proof import polynomial
from nsmodel.proof.expression_graph import stack_column
from nsmodel.solvers.one_step_problem import OneStepProblem, with_carried_inputs

__all__ = ["implicit_problem", "initial_rows", "kept_within"]


def implicit_problem(model: MonotoneInclusion) -> OneStepProblem:
    """Return the resolvent as (z, l, n): the velocity v = F - S and the reaction grad c' n make x_{k+1} = x_k + h (v + ...)."""
    h, z, chosen = ca.SX.sym("h"), ca.SX.sym("x_next", model.x.numel()), velocity_selection(model)
    u_end = ca.SX.sym("u_next", model.u.numel())
    (c, names), l = set_constraints(model), chosen.l
    n, S, law, scale = ca.SX.sym("n", c.numel()), chosen.S, chosen.law, ca.SX.ones(l.numel())
    if model.sign_symbols.numel():
        scale = ca.vertcat(*(_sign_scale(model, chosen, i) for i in range(l.numel())))
        S, law = ca.substitute(S, l, l / scale), relay(l.numel(), -scale, scale)
    at_end = S, chosen.u, c, ca.jacobian(c, model.x)
    S, u, c, J = ca.substitute(at_end, [model.t, model.x, model.u], [model.t + h, z, u_end])
    v = model.field - S
    problem = OneStepProblem(
        scheme="implicit: the resolvent of T",
        t=model.t, h=h, state=model.x, p=model.p,
        z=z, l=ca.vertcat(l, n), y=ca.SX.sym("y", l.numel() + n.numel()),
        E=z - model.x - h * v - h * (J.T @ n), Y=ca.vertcat(ca.SX(0, 1), u, c),
        law=product(law, complementarity(n.numel())),
        rows=(*(f"selection[{i}]" for i in range(l.numel())), *names),
        guess=model.x,
        next_state=z,
        records={"v": v, "selection": l / scale},
        assumed=ca.vertcat(ca.SX(0, 1), *(own for own in ca.vertsplit(scale) if not own.is_constant())),
    )  # fmt: skip
    return with_carried_inputs(problem, model.u, u_end)


def _sign_scale(model: MonotoneInclusion, chosen: Selection, i: int) -> ca.SX:
    """beta > 0, a number or an expression of the parameters, where row i of S's signs has the direction beta grad u_i; else 1."""
    B, slope = ca.jacobian(chosen.S, chosen.l[i]), ca.jacobian(chosen.u[i], model.x)
    if ca.depends_on(ca.vertcat(B, slope.T), stack_column([model.t, model.x, chosen.l])) or not slope.nnz():
        return ca.SX(1)
    j = slope.sparsity().get_triplet()[1][0]
    beta = -B[j] / slope[j]
    cross = B * slope[j] - slope.T * B[j]
    if any(p != {} for p in polynomial.read_polynomials(cross, model.p)) or (beta.is_constant() and not float(beta) > 0):
        return ca.SX(1)
    return beta
