"""Implicit Euler for multivalued Lur'e systems (Brogliato and Goeleven 2013), with theta and gamma for comparison.

x_{k+1} = x_k + h th (A(x_{k+1}) + f(t_{k+1})) + h (1-th) (A(x_k) + f(t_k)) + h ga B l_{k+1} + h (1-ga) B l_k
y_{k+1} = C x_{k+1} + D l_{k+1} + e(t_{k+1}),      -y_{k+1} ∈ N_K(l_{k+1})  or  l_{k+1} ∈ -dPhi(y_{k+1})

x' = A(x) + f(t) + B l,   y = C x + D l + e(t),   -y ∈ N_K(l) or l ∈ -dPhi(y).

What a run of a Lur'e system looks at before it starts: its law, D and Phi.

Impacts of Lur'e systems: where D and C B are 0, a multiplier acts too late to hold its row.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.event_driven.problem import ContinuousProblem
from nsmodel.modeling.laws import Law, equality, product
from nsmodel.modeling.laws.base import LawEnds
from nsmodel.models.lure_system.model import LureSystem
from nsmodel.solvers.impacts import ImpactStructure, impact_structure
from nsmodel.solvers.initial_checks import (
    InitialChecks,
    check_law_sets,
    check_term_weights,
    convexity_warning,
    psd_warning,
    symbolic_term_weights,
)
from nsmodel.solvers.one_step_problem import (
    OneStepProblem,
    Scheme,
    SchemeOrder,
    moving_law_outputs,
    rewrite_as_basic_law,
    subdifferential,
    with_carried_inputs,
)


def one_step_problem(model: LureSystem) -> OneStepProblem:
    """Return the step in z = x_{k+1}, or (x_{k+1}, y_{k+1}) where Phi is given and D is not 0."""
    t, h, n, th, ga = model.t, ca.SX.sym("h"), model.x.numel(), model.theta, model.gamma
    x_k, r_k, x, u = model.x, ca.SX.sym("r_k", n), ca.SX.sym("x_next", n), ca.SX.sym("u_next", model.u.numel())
    rate_k = model.A + model.f
    rate, e = ca.substitute([rate_k, model.e], [t, x_k, model.u], [t + h, x, u])
    law = law_rows(model, x, e, ca.vertcat(t + h, u))
    r, y = ca.densify(model.B @ law.multipliers), ca.SX.sym("y", law.l.numel())
    E = x - x_k - h * th * rate - h * (1 - th) * rate_k - h * ga * r - h * (1 - ga) * (r_k if ga < 1 else 0)
    problem = OneStepProblem(
        scheme="implicit Euler" if th == ga == 1 else f"theta-gamma, theta = {th:g}, gamma = {ga:g}",
        t=t, h=h, state=ca.vertcat(x_k, r_k) if ga < 1 else x_k, p=model.p,
        z=ca.vertcat(x, law.z), l=law.l, y=y,
        E=ca.vertcat(E, law.E), Y=law.Y,
        law=law.law,
        rows=law.rows,
        guess=ca.vertcat(x_k, ca.substitute([law.guess], [x], [x_k])[0]),
        next_state=ca.vertcat(x, r) if ga < 1 else x,
        multipliers=law.multipliers if law.rewritten else None,
        declared=model.multiplier_names,
        outputs=moving_law_outputs(law.outputs, y, law.ends) if law.rewritten else None,
        ends=law.ends, scale=law.scale,
        start=_initial_multiplier_problem(model, h, ca.vertcat(x_k, r_k)) if ga < 1 else None,
        carried="the reaction of the last step" if ga < 1 else "",
        order=SchemeOrder.from_weights(th, ga, r, ca.vertcat(t, h, u, x, law.z), law.law, law.Y, ca.vertcat(law.l, law.z)),
    )  # fmt: skip
    return with_carried_inputs(problem, model.u, u)


class _LawRows(NamedTuple):
    """The law of a Lur'e system on (x, l): l in K with rows Y, the user's multipliers and outputs, and y as an unknown."""

    law: Law
    l: ca.SX
    rows: tuple[str, ...]
    Y: ca.SX
    multipliers: ca.SX
    outputs: ca.SX
    rewritten: bool
    ends: tuple[LawEnds, ...] = ()
    scale: ca.SX | None = None
    z: ca.SX = ca.SX(0, 1)
    E: ca.SX = ca.SX(0, 1)
    guess: ca.SX = ca.SX(0, 1)


def law_rows(model: LureSystem, x: ca.SX, e: ca.SX, at: ca.SX | None = None) -> _LawRows:
    """y = C x + D l + e with the declared law, or l ∈ -dPhi(y): there y joins the unknowns unless D = 0.

    ``at``: what stands in place of the time and the inputs in the law.
    """
    y = ca.SX.sym("y_next", model.B.shape[1])
    if model.law is not None:
        basic = rewrite_as_basic_law(model.law, model.multiplier_names, y, ca.vertcat(model.t, model.u), at)
        output = ca.densify(model.C @ x + model.D @ basic.multipliers + e)
        Y = ca.substitute(basic.y, y, output)
        return _LawRows(basic.law, basic.l, basic.rows, Y, basic.multipliers, output, basic.differs, basic.ends, basic.scale)
    part = subdifferential(model.phi_split, model.y, "phi")
    implicit, free = not model.D.is_zero(), ca.densify(model.C @ x + e)
    output = y if implicit else free
    l, Y = ca.substitute([part.force, part.u], [model.y], [output])
    rows = _LawRows(part.law, part.l, part.rows, Y, l, output, True)
    return rows._replace(z=y, E=y - free - model.D @ l, guess=free) if implicit else rows


def _initial_multiplier_problem(model: LureSystem, h: ca.SX, state: ca.SX) -> OneStepProblem:
    """l_0 solves the law at x_0: the first B l_k where gamma < 1."""
    law = law_rows(model, model.x, model.e)
    return OneStepProblem(
        scheme="multiplier at the start",
        t=model.t, h=h, state=state, p=model.p,
        z=law.z, l=law.l, y=ca.SX.sym("y", law.l.numel()),
        E=law.E, Y=law.Y,
        law=law.law,
        rows=law.rows,
        guess=law.guess,
        next_state=ca.vertcat(model.x, ca.densify(model.B @ law.multipliers)),
        ends=law.ends, scale=law.scale,
    )  # fmt: skip


def initial_rows(model: LureSystem, h: float) -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """x_0, and room for r_0 where gamma < 1."""
    x0 = np.array(ca.DM(model.x0)).ravel()
    return [(np.concatenate([x0, np.zeros(x0.size)]) if model.gamma < 1 else x0, {})]


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


def check_start(model: LureSystem) -> None:
    """Refuse weights < 0 of Phi, and a law that the parameters made empty."""
    if model.law is None:
        check_term_weights(model.phi_split, "phi", model)
    else:
        check_law_sets(model.law, model)


def admitted(model: LureSystem) -> list[ca.SX]:
    """The weights, of all values of the parameters; the law says itself whether it is empty."""
    return [symbolic_term_weights(model.phi_split)] if model.law is None else []


def warnings(model: LureSystem) -> list[str]:
    """Where D is not psd, or Phi not convex."""
    found = psd_warning("D", model.D) if model.D.numel() else []
    if model.law is None:
        found += convexity_warning(model.phi_split.smooth, model.y, np.zeros(model.y.numel()), "phi is not convex at y = 0")
    return found


def impact_system(model: LureSystem) -> ImpactStructure | None:
    """The model as a system; None where phi stands in for a law."""
    if model.law is None or not model.law.size:
        return None
    l = ca.SX.sym("l", model.law.size)
    F, Y = model.A + model.f + model.B @ l, model.output(model.x, l)
    return impact_structure(model, model.law, l, F, Y, (model.B, model.C, model.D), "y' (C B = 0)")


SCHEMES = {
    "theta-gamma": Scheme(one_step_problem=one_step_problem, initial_rows=initial_rows),
}
INITIAL_CHECKS = InitialChecks(check_start=check_start, warnings=warnings, admitted=admitted)
