"""Catching-up with approximate projections for maximal monotone inclusions (2026 paper, Definition 4.3).

    y_k = x_k + mu_k v_k,   v_k ∈ F(x_k) - S(x_k);     x_{k+1} ∈ C with |x_{k+1} - y_k|^2 < d_C(y_k)^2 + eps_k

Where S is discontinuous its element is free; the one taken minimises |P_{T_C(x)}(F - s)|, which keeps the state still when
it can stay. With T_C's polar, Moreau's decomposition makes that a small bound-constrained least-squares problem:
min |F - S(x, l) + grad c(x)' n|^2 over l in its face and n >= 0 on the active constraints.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.laws import Law, complementarity, relay
from nsmodel.model.convex import DOMAIN
from nsmodel.scheme.problem import OneStepProblem, subdifferential


@dataclass(frozen=True)
class Selection:
    """The velocities F(x) - S(x): ``velocity`` (n) is an expression of x and l, where -u(x) ∈ N_K(l)."""

    x: ca.SX
    l: ca.SX
    velocity: ca.SX
    u: ca.SX
    law: Law


def selection(model: MonotoneInclusion) -> Selection:
    """Return F - S with its discontinuities written as multipliers."""
    if model.potential_split is not None:
        smooth = [term for term in model.potential_split.terms if term.kind not in DOMAIN]
        part = subdifferential(model.potential_split.with_terms(smooth), model.x, "phi")
        return Selection(model.x, part.l, model.field + part.force, part.u, part.law)
    m = model.sign_symbols.numel()
    l = ca.SX.sym("l", m)
    S = ca.substitute(model.operator, model.sign_symbols, -l) if m else model.operator
    return Selection(model.x, l, model.field - S, model.sign_arguments, relay(m))


def constraints(model: MonotoneInclusion) -> tuple[ca.SX, tuple[str, ...]]:
    """C as rows c(x) >= 0, the finite bounds first, and their names."""
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


def one_step_problem(model: MonotoneInclusion) -> OneStepProblem:
    """Return the exact projection of the predictor (here the ``state``) on C: z - y_k - grad c(z)' n = 0, 0 <= n ⟂ c(z) >= 0."""
    predictor, z = ca.SX.sym("predictor", model.x.numel()), ca.SX.sym("x_next", model.x.numel())
    c, names = constraints(model)
    n = ca.SX.sym("n", c.numel())
    J = ca.jacobian(c, model.x)
    c, J = ca.substitute([c, J], [model.x], [z]) if n.numel() else (c, J)
    return OneStepProblem(
        scheme="catching-up with approximate projections",
        t=model.t, h=ca.SX.sym("h"), state=predictor, p=model.p,
        z=z, l=n, y=ca.SX.sym("y", n.numel()),
        E=z - predictor - J.T @ n, Y=c,
        law=complementarity(n.numel()),
        rows=names,
        guess=predictor,
        next_state=z,
    )  # fmt: skip


def initial_rows(model: MonotoneInclusion, h: float) -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """x_0."""
    return [(np.array(ca.DM(model.x0)).ravel(), {})]


def kept_within(model: MonotoneInclusion) -> ca.SX:
    """All that bounds C, boxes and the domain of phi included."""
    return constraints(model)[0]
