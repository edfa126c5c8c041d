"""What a run says about hypotheses before it starts: cheap checks at the start, in words; a start outside the set is refused.

What is looked at is the class's own, its part INITIAL_CHECKS, made of what stands here.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.errors import UsageError
from nsmodel.modeling.base import Model
from nsmodel.modeling.convex_split import ConvexSplit
from nsmodel.modeling.laws import Law
from nsmodel.modeling.parts import Part
from nsmodel.modeling.variants import initial_inputs, with_initial_inputs
from nsmodel.solvers.plan import Plan
from nsmodel.solvers.structure import least_eigenvalue

UNIQUENESS_WARNING = "uniqueness of the solution is not guaranteed"
# What a start written with ten digits is off by, and what 45 roundings of 1 come to.
FEASIBILITY_SLACK, MIN_FEASIBILITY_SLACK = 1e-10, 1e-14  # Of the gradient times the start, and besides: how far below 0.
MAX_EIGENVALUE_ROWS = 1500  # Rows up to which a matrix is looked at with all its eigenvalues, in 0.4 s; else by Lanczos.


@dataclass(frozen=True, kw_only=True)
class InitialChecks:
    """What a class of models looks at before a run.

    Attributes:
        warnings: (model), what the user should know before trusting uniqueness or convergence.
        check_start: (model), raises UsageError for a start outside the set; left out: the class's propagator does.
        admitted: (model), what ``check_start`` asks of a model with parameters, as columns of expressions >= 0.
    """

    warnings: Callable[[Any], list[str]]
    check_start: Callable[[Any], None] | None = None
    admitted: Callable[[Any], list[ca.SX]] | None = None


INITIAL_CHECKS = Part[InitialChecks]("schemes.INITIAL_CHECKS")


def check_start(model: Model) -> None:
    """Refuse a start outside the set that the state must stay in (S-start), and laws that the parameters made empty.

    Raises:
        UsageError: names the constraint, its value and the start; the friction element; the term; the law's component.
    """
    if own := INITIAL_CHECKS.of(model).check_start:
        own(_model_at_start(model))


def admitted(model: Any) -> ca.SX:
    """What `check_start` asks of a model with parameters, as a column of their expressions, each a finite number >= 0."""
    own = INITIAL_CHECKS.of(model).admitted
    rows = ca.vertcat(ca.SX(0, 1), *([] if own is None else own(model)))
    rows = ca.substitute(rows, model.u, ca.SX(initial_inputs(model))) if model.u.numel() else rows
    known = {str(symbol) for symbol in ca.symvar(model.p)}
    symbolic_rows = [row for row in ca.vertsplit(rows) if not row.is_constant() and {str(s) for s in ca.symvar(row)} <= known]
    return ca.vertcat(ca.SX(0, 1), *symbolic_rows)


def symbolic_term_weights(split: ConvexSplit) -> ca.SX:
    """The weights of the terms of a convex potential that are no numbers."""
    return ca.vertcat(ca.SX(0, 1), *(term.weight for term in split.terms if not term.weight.is_constant()))


def start_margin(g: ca.SX, model: Any, label: str) -> ca.SX:
    """By how much a start of the model, by its name, is inside {g >= 0} at t = 0, with what `check_start_inside` forgives."""
    q0 = getattr(model, label)
    value, gradient = ca.substitute([ca.densify(g), ca.densify(ca.jacobian(g, model.state))], [model.t, model.state], [0, q0])
    size = ca.vertcat(ca.SX(0, 1), *(ca.norm_2(row) for row in ca.vertsplit(gradient)))
    return value + FEASIBILITY_SLACK * size * ca.norm_2(q0) + MIN_FEASIBILITY_SLACK


def warnings(model: Model) -> list[str]:
    """What the model itself gives the user to know before trusting uniqueness or convergence."""
    return INITIAL_CHECKS.of(model).warnings(_model_at_start(model))


def _model_at_start(model: Model) -> Model:
    """The model at u(0+); a law that moves is looked at by the steps."""
    law, other = getattr(model, "law", None), with_initial_inputs(model)
    if law is None or not any(law.moves(ca.vertcat(model.t, model.u))):
        return other
    other = copy(other)
    other._set(law=law.at_rest(ca.vertcat(model.t, model.u)))
    return other


def start_warnings(model: Model, plan: Plan) -> list[str]:
    """Return what the user should know before trusting uniqueness or convergence; an empty list where nothing was found."""
    found = warnings(model)
    if plan.monotone:
        return found
    least = f"least eigenvalue of W + W', scaled to 1: {plan.least_eigenvalue:.3g}"
    return [*found, f"the one-step problem is not monotone ({least}): {UNIQUENESS_WARNING}"]


def parameter_values_text(model: Any) -> str:
    """The values of the parameters, as a message ends with them."""
    values = model.bound_parameters
    return " with " + ", ".join(f"{name} = {value:g}" for name, value in values.items()) if values else ""


def check_term_weights(split: ConvexSplit, what: str, model: Model) -> None:
    """Refuse weights of a convex potential that are < 0: with numbers for the parameters each has a sign."""
    for term in split.terms:
        if term.weight.is_constant() and not 0 <= float(term.weight) < np.inf:
            raise UsageError(
                f"{what}: the term '{term.kind}' of {term.u} has the weight "
                f"{float(term.weight):g}{parameter_values_text(model)}; a convex potential needs finite weights >= 0"
            )


def check_law_sets(law: Law, model: Model) -> None:
    """Refuse lower > upper, a radius < 0."""
    for block in law.blocks:
        if why := block.invalidity_reason(parameter_values_text(model)):
            raise UsageError(f"law: {why}")


def check_start_inside(g: ca.SX, names: tuple[str, ...], model: Any, label: str) -> None:
    """Refuse a start of the model, by its name, that is outside {g >= 0} at t = 0."""
    if not g.numel():
        return
    f = ca.Function("g", [model.t, model.state], [ca.densify(g), ca.densify(ca.jacobian(g, model.state))])
    q0 = np.array(ca.DM(getattr(model, label))).ravel()
    value, gradient = (np.array(v) for v in f(0, q0))
    value = value.ravel()
    size = np.linalg.norm(gradient, axis=1)
    for i in range(value.size):
        if not (np.isfinite(value[i]) and np.isfinite(size[i])):
            what = "value" if not np.isfinite(value[i]) else "gradient"
            raise UsageError(
                f"constraint '{names[i]}': its {what} at the start {label} = {_short_vector(q0)} is not a finite number "
                "(a norm at 0, a root or division by 0?); move the start or rewrite the constraint"
            )
        if value[i] < -FEASIBILITY_SLACK * size[i] * np.linalg.norm(q0) - MIN_FEASIBILITY_SLACK:
            raise UsageError(
                f"constraint '{names[i]}' = {value[i]:.6g} < 0 at the start {label} = {_short_vector(q0)}: the start is outside "
                "the set; move it to where every constraint is >= 0"
            )


def psd_warning(name: str, matrix: ca.SX) -> list[str]:
    """A warning where a matrix is not psd: decided without unit, told in the user's own."""
    if matrix.is_zero():
        return []
    if matrix.shape[0] > MAX_EIGENVALUE_ROWS:
        import scipy.sparse as sp
        from scipy.sparse.linalg import aslinearoperator

        M = ca.DM(matrix).sparse().tocsr()
        seen = np.flatnonzero(abs(M + M.T).sum(axis=1))
        M = M[seen][:, seen]
        d = 1 / np.sqrt(abs(M + M.T).max(axis=1).toarray().ravel() / 2)
        least = least_eigenvalue(aslinearoperator(sp.diags(d) @ M @ sp.diags(d)))
        return [f"{name} is not positive semidefinite (an eigenvalue, scaled, is at most {least:.3g})"] if least < 0 else []
    M = np.array(ca.DM(matrix))
    if least_eigenvalue(M) >= -1e-12:
        return []
    return [
        f"{name} is not positive semidefinite (least eigenvalue of its symmetric part {np.linalg.eigvalsh((M + M.T) / 2)[0]:.3g})"
    ]


def convexity_warning(smooth: ca.SX, x: ca.SX, at: np.ndarray, what: str) -> list[str]:
    """A warning where the Hessian of ``smooth`` at a point has a negative eigenvalue."""
    if any(not ca.depends_on(x, symbol) for symbol in ca.symvar(smooth)):
        return []  # It contains the levels of nested terms: not a function of x alone.
    H = np.array(ca.Function("H", [x], [ca.hessian(smooth, x)[0]])(at))
    least = np.linalg.eigvalsh(H)[0] if np.isfinite(H).all() else 0.0
    return [f"{what} (least eigenvalue of its Hessian {least:.3g})"] if least < -1e-12 * np.abs(H).max() else []


def _short_vector(values: np.ndarray) -> str:
    text = ", ".join(f"{v:.6g}" for v in values[:6])
    return f"({text}{', ...' if values.size > 6 else ''})"
