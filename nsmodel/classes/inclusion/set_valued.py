"""The set-valued parts of an inclusion: S with its discontinuities as multipliers, C as rows >= 0."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.modeling.convex_split import DOMAIN_KINDS
from nsmodel.modeling.laws import Law, relay
from nsmodel.solvers.one_step_problem import subdifferential


@dataclass(frozen=True)
class Selection:
    """The velocities G = F - S: ``velocity`` (n) is an expression of t, x and l, where -u(t, x) ∈ N_K(l); ``S`` (n) alone."""

    l: ca.SX
    velocity: ca.SX
    S: ca.SX
    u: ca.SX
    law: Law


def velocity_selection(model: MonotoneInclusion) -> Selection:
    """Return F - S with its discontinuities written as multipliers."""
    if model.potential_split is not None:
        smooth = [term for term in model.potential_split.terms if term.kind not in DOMAIN_KINDS]
        part = subdifferential(model.potential_split.with_terms(smooth), model.x, "phi")
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
