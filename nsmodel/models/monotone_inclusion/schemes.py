"""Catching-up with approximate projections for maximal monotone inclusions (2026 paper, Definition 4.3).

    y_k = x_k + mu_k v_k,   v_k ∈ F(x_k) - S(x_k);     x_{k+1} ∈ C with |x_{k+1} - y_k|^2 < d_C(y_k)^2 + eps_k

Where S is discontinuous its element is free; the one taken minimises |P_{T_C(x)}(F - s)|, which keeps the state still when
it can stay. With T_C's polar, Moreau's decomposition makes that a small bound-constrained least-squares problem:
min |F - S(x, l) + grad c(x)' n|^2 over l in its face and n >= 0 on the active constraints.

What depends on time is taken at t_k in F and S, at t_{k+1} in C, as Moreau's own scheme for moving convex sets does (*Evolution
problem associated with a moving convex set in a Hilbert space*, 1977). Where the switching surfaces or C move, the state stays
on them by moving along: the least |F - S(x, l) - w + grad c' n| is taken, w the least velocity that all that meet at x share.

The implicit scheme of a maximal monotone inclusion: x_{k+1} = (I + h T)^{-1}(x_k + h F(x_k)), T = S + N_C.

The resolvent of a maximal monotone operator is defined everywhere and single-valued (Minty's theorem; Bauschke and Combettes,
*Convex Analysis and Monotone Operator Theory in Hilbert Spaces*, 2011, Theorem 21.1, Corollary 23.9). F alone is explicit: a
state that can stay does so at every step, where catching-up goes to and fro about a discontinuity of S. With time, F is taken at
t_k, S and C at t_{k+1}.

    z - x_k - h F(t_k, x_k) + h S(t_{k+1}, z, l) - h grad c(t_{k+1}, z)' n = 0
    -u(t_{k+1}, z) ∈ N_K(l),    0 <= n ⟂ c(t_{k+1}, z) >= 0

Where S has beta Sgn(u) in the direction of grad u, l is beta times the sign: then W is symmetric.

The set-valued parts of an inclusion: S with its discontinuities as multipliers, C as rows >= 0.

x' = F(t, x) - S(t, x, l) + grad c' n,   -u(t, x) ∈ N_K(l),   0 <= n ⟂ c(t, x) >= 0: T = S + N_C with its elements named.

What a run of an inclusion looks at before it starts: its potential, its bounds, x0 in C.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from nsmodel.errors import UsageError
from nsmodel.event_driven.problem import ContinuousProblem
from nsmodel.modeling.convex_split import DOMAIN_KINDS
from nsmodel.modeling.laws import Law, complementarity, product, relay
from nsmodel.models.monotone_inclusion.model import MonotoneInclusion
from nsmodel.proof import polynomial
from nsmodel.proof.expression_graph import stack_column
from nsmodel.solvers.initial_checks import (
    InitialChecks,
    check_start_inside,
    check_term_weights,
    parameter_values_text,
    start_margin,
    symbolic_term_weights,
)
from nsmodel.solvers.one_step_problem import OneStepProblem, Prediction, Scheme, subdifferential, with_carried_inputs


@dataclass(frozen=True)
class Selection:
    """The velocities G = F - S: ``velocity`` (n) is an expression of t, x and l, where -u(t, x) ∈ N_K(l); ``S`` (n) alone."""

    l: ca.SX
    velocity: ca.SX
    S: ca.SX
    u: ca.SX
    law: Law


def velocity_selection(model: MonotoneInclusion, *, guarded: bool = True) -> Selection:
    """Return F - S with its discontinuities written as multipliers; ``guarded``: no number where a potential has no value."""
    if model.potential_split is not None:
        smooth = [term for term in model.potential_split.terms if term.kind not in DOMAIN_KINDS]
        part = subdifferential(model.potential_split.with_terms(smooth), model.x, "phi", guarded=guarded)
        return Selection(part.l, model.field + part.force, -part.force, part.u, part.law)
    m = model.sign_symbols.numel()
    l = ca.SX.sym("l", m)
    S = ca.substitute(model.operator, model.sign_symbols, -l) if m else model.operator
    return Selection(l, model.field - S, S, model.sign_arguments, relay(m))


def set_constraints(model: MonotoneInclusion) -> tuple[ca.SX, tuple[str, ...]]:
    """C as rows c(t, x) >= 0, the finite bounds first, and their names."""
    rows, names = [ca.SX(0, 1)], []
    for i, name in enumerate(model.names):
        for bound, row, word in (
            (model.lower[i], model.x[i] - model.lower[i], "lower"),
            (model.upper[i], model.upper[i] - model.x[i], "upper"),
        ):
            if not (bound.is_constant() and np.isinf(float(bound))):
                rows.append(row)
                names.append(f"{word} {name}")
    return ca.vertcat(*rows, *model.constraints.values()), (*names, *model.constraint_names)


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
    """The row of the start x_0."""
    return [(np.array(ca.DM(model.x0)).ravel(), {})]


def kept_within(model: MonotoneInclusion) -> ca.SX:
    """All that bounds C, boxes and the domain of phi included."""
    return set_constraints(model)[0]


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


def check_start(model: MonotoneInclusion) -> None:
    """Refuse weights < 0 of Phi, lower >= upper, and x0 outside C."""
    if model.potential_split is not None:
        check_term_weights(model.potential_split, "phi", model)
    low, high = (np.array(ca.DM(ca.substitute(bound, model.t, 0))).ravel() for bound in (model.lower, model.upper))
    for i in np.flatnonzero(~(low < high)):
        raise UsageError(
            f"lower[{i}] = {low[i]:g}, upper[{i}] = {high[i]:g}{parameter_values_text(model)}: C needs an interior, lower < upper"
        )
    check_start_inside(*set_constraints(model), model, "x0")


def admitted(model: MonotoneInclusion) -> list[ca.SX]:
    """That, of all values of the parameters."""
    low, high = (ca.substitute(bound, model.t, 0) for bound in (model.lower, model.upper))
    own = [] if model.potential_split is None else [symbolic_term_weights(model.potential_split)]
    return [*own, ca.if_else(low < high, 1, -1), start_margin(set_constraints(model)[0], model, "x0")]


def warnings(model: MonotoneInclusion) -> list[str]:
    """Nothing beside what the step shows."""
    return []


SCHEMES = {
    "catching-up": Scheme(
        one_step_problem=catching_up_problem,
        initial_rows=initial_rows,
        kept_within=kept_within,
    ),
    "implicit": Scheme(one_step_problem=implicit_problem, initial_rows=initial_rows, kept_within=kept_within),
}
INITIAL_CHECKS = InitialChecks(check_start=check_start, warnings=warnings, admitted=admitted)
