"""Theta-gamma stepping of first-order nonsmooth systems (Siconos developer's notes).

    R(x, r)   = M (x - x_k) - h th f(x, t_{k+1}) - h (1-th) f(x_k, t_k) - h ga r - h (1-ga) r_k = 0
    R_y       = y - h(t_{k+1}, x, l) = 0
    R_r       = r - g(t_{k+1}, x, l) = 0,          -y ∈ N_K(l)

Newton's linearisation in (x, r, l), which `solvers.newton` performs with exact Jacobians A = f_x, C = h_x, D = h_l, K = g_x,
B = g_l, eliminates x and r:

    W      = M - h th A - h ga K
    x_free = x - W^{-1}(R_free - h (1-ga) r_k),     R_free = M (x - x_k) - h th f(x, t_{k+1}) - h (1-th) f(x_k, t_k)
    x_p    = x_free + h ga W^{-1}(g(x, l) - B l),   x_q = x_p - x
    MLCP:    y+ = (h ga C W^{-1} B + D) l+ + b,     b = h(t, x, l) + C x_q - D l,     -y+ ∈ N_K(l+)
    x+     = x_p + h ga W^{-1} B l+,                r+ = g(x, l) + K (x+ - x) + B (l+ - l)

M x' = f(t, x) + g(t, x, l),   y = h(t, x, l),   -y ∈ N_K(l), with M divided out.

What a run of a first-order system looks at before it starts: its law.

Impacts of first-order systems: where h_l and h_x M^-1 g_l are 0, a multiplier acts too late to hold its row.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.event_driven.problem import ContinuousProblem, NotEventDriven
from nsmodel.models.first_order_system.model import FirstOrderSystem
from nsmodel.solvers.impacts import ImpactStructure, impact_structure
from nsmodel.solvers.initial_checks import InitialChecks, check_law_sets
from nsmodel.solvers.one_step_problem import (
    OneStepProblem,
    Scheme,
    SchemeOrder,
    moving_law_outputs,
    rewrite_as_basic_law,
    with_carried_inputs,
)
from nsmodel.solvers.rounding_errors import equilibrate_matrix


def one_step_problem(model: FirstOrderSystem) -> OneStepProblem:
    """Return R = 0, R_r = 0 as E in z = (x, r), and h as Y. r_k is part of the state when gamma < 1."""
    t, h, n, th, ga = model.t, ca.SX.sym("h"), model.x.numel(), model.theta, model.gamma
    x_k, r_k = model.x, ca.SX.sym("r_k", n)
    x, r, u = ca.SX.sym("x_next", n), ca.SX.sym("r", n), ca.SX.sym("u_next", model.u.numel())
    if not model.law.size:
        return with_carried_inputs(_smooth_problem(model, h, x, u), model.u, u)

    def end(expression: ca.SX, l: ca.SX) -> ca.SX:
        return ca.substitute([expression], [t, x_k, model.u, model.lam], [t + h, x, u, l])[0]

    # A polyhedron's rewriting needs y as the user declared it, in terms of the new multipliers.
    y_user = ca.SX.sym("y", model.law.size)
    basic = rewrite_as_basic_law(model.law, model.multiplier_names, y_user, ca.vertcat(model.t, model.u), ca.vertcat(t + h, u))
    l = basic.multipliers
    hx, gx = end(model.h, l), end(model.g, l)
    f_k, f = model.f, end(model.f, l)
    y = ca.SX.sym("y", basic.l.numel())
    Y = ca.substitute(basic.y, y_user, hx)
    R = model.M @ (x - x_k) - h * th * f - h * (1 - th) * f_k - h * ga * r - h * (1 - ga) * (r_k if ga < 1 else 0)
    R_r = r - gx
    problem = OneStepProblem(
        scheme=f"theta-gamma, theta = {th:g}, gamma = {ga:g}",
        t=t, h=h, state=ca.vertcat(x_k, r_k) if ga < 1 else x_k, p=model.p,
        z=ca.vertcat(x, r), l=basic.l, y=y,
        E=ca.vertcat(R, R_r), Y=Y,
        law=basic.law,
        rows=basic.rows,
        guess=ca.vertcat(x_k, r_k if ga < 1 else ca.substitute([model.g], [model.lam], [l])[0]),
        next_state=ca.vertcat(x, r) if ga < 1 else x,
        multipliers=l if basic.differs else None,
        declared=model.multiplier_names,
        outputs=moving_law_outputs(hx, y, basic.ends) if basic.differs else None,
        ends=basic.ends, scale=basic.scale,
        records={"residual_R": ca.norm_inf(R), "residual_Ry": ca.norm_inf(y - Y), "residual_Rr": ca.norm_inf(R_r)},
        start=_start_problem(model, h, ca.vertcat(x_k, r_k)) if ga < 1 else None,
        carried="the reaction of the last step" if ga < 1 else "",
        order=SchemeOrder.from_weights(th, ga, gx, ca.vertcat(t, h, x, u), basic.law, Y, basic.l),
        explicit=tuple(range(n, 2 * n)),
    )  # fmt: skip
    return with_carried_inputs(problem, model.u, u)


def _start_problem(model: FirstOrderSystem, h: ca.SX, state: ca.SX) -> OneStepProblem:
    """l_0 solves the law at (t_0, x_0), and r_0 = g(t_0, x_0, l_0)."""
    y_user = ca.SX.sym("y", model.law.size)
    basic = rewrite_as_basic_law(model.law, model.multiplier_names, y_user, ca.vertcat(model.t, model.u))
    here = [ca.substitute([e], [model.lam], [basic.multipliers])[0] for e in (model.h, model.g)]
    return OneStepProblem(
        scheme="multiplier at the start",
        t=model.t, h=h, state=state, p=model.p,
        z=ca.SX(0, 1), l=basic.l, y=ca.SX.sym("y", basic.l.numel()),
        E=ca.SX(0, 1), Y=ca.substitute(basic.y, y_user, here[0]),
        law=basic.law,
        rows=basic.rows,
        guess=ca.SX(0, 1),
        next_state=ca.vertcat(model.x, here[1]),
        ends=basic.ends, scale=basic.scale,
    )  # fmt: skip


def _smooth_problem(model: FirstOrderSystem, h: ca.SX, x: ca.SX, u: ca.SX) -> OneStepProblem:
    """Without multipliers: the theta-scheme for M x' = f + g(t, x)."""
    t, x_k, th, ga = model.t, model.x, model.theta, model.gamma
    f, g = (ca.substitute([e], [t, x_k, model.u], [t + h, x, u])[0] for e in (model.f, model.g))
    R = model.M @ (x - x_k) - h * th * f - h * (1 - th) * model.f - h * ga * g - h * (1 - ga) * model.g
    empty = ca.SX(0, 1)
    return OneStepProblem(
        scheme=f"theta scheme, theta = {th:g}",
        t=t, h=h, state=x_k, p=model.p,
        z=x, l=empty, y=empty, E=R, Y=empty,
        law=model.law,
        rows=(),
        guess=x_k,
        next_state=x,
        records={"residual_R": ca.norm_inf(R)},
        order=SchemeOrder.from_weights(th, ga, g, ca.vertcat(t, h, x), model.law, empty, empty),
    )  # fmt: skip


def initial_rows(model: FirstOrderSystem, h: float) -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """x_0, and room for r_0 where gamma < 1."""
    x0 = np.array(ca.DM(model.x0)).ravel()
    return [(np.concatenate([x0, np.zeros(x0.size)]) if model.gamma < 1 and model.law.size else x0, {})]


SINGULAR_MASS = "M is singular: its rows without x' are equations, which need steps; take method='time-stepping'"


def continuous_problem(model: FirstOrderSystem) -> ContinuousProblem:
    """Return the model in continuous time.

    Raises:
        NotEventDriven: M is singular: a row of it is an algebraic equation.
    """
    basic = rewrite_as_basic_law(
        model.law, model.multiplier_names, y := ca.SX.sym("y", model.law.size), ca.vertcat(model.t, model.u)
    )
    g, h = ca.substitute([model.g, model.h], [model.lam], [basic.multipliers]) if model.law.size else (model.g, model.h)
    at_rest = ca.substitute(g, basic.l, ca.SX.zeros(basic.l.numel()))
    inverse, split = _inverse_mass(model.M), basic.differs
    return ContinuousProblem(
        t=model.t, x=model.x, l=basic.l, p=model.p,
        f=inverse @ (model.f + at_rest), g=inverse @ ca.densify(g - at_rest), h=ca.substitute(basic.y, y, h),
        law=basic.law, rows=basic.rows, names=tuple(model.names), x0=model.x0,
        states=model.x.numel(), multipliers=basic.multipliers if split else None, outputs=h if split else None,
        declared=model.multiplier_names, ends=basic.ends,
    )  # fmt: skip


def _inverse_mass(M: ca.SX) -> ca.SX:
    if (M - ca.SX.eye(M.shape[0])).is_zero():
        return ca.SX.eye(M.shape[0])
    if not M.is_constant():
        if ca.sprank(M) < M.shape[0]:
            raise NotEventDriven(SINGULAR_MASS)
        return ca.inv(ca.densify(M))
    numbers = np.array(ca.DM(M))
    if np.linalg.matrix_rank(numbers) < numbers.shape[0]:
        raise NotEventDriven(SINGULAR_MASS)
    return ca.SX(ca.sparsify(ca.DM(np.linalg.inv(numbers))))


def check_start(model: FirstOrderSystem) -> None:
    """Refuse a law that the parameters made empty."""
    check_law_sets(model.law, model)


def warnings(model: FirstOrderSystem) -> list[str]:
    """Nothing beside what the step shows."""
    return []


def impact_system(model: FirstOrderSystem) -> ImpactStructure | None:
    """The model as a system; None where there is no law, or M has no inverse."""
    if not model.law.size or _is_mass_singular(model.M):
        return None
    x, l, Y = model.x, model.lam, model.h
    F = ca.solve(model.M, model.f + model.g) if not (model.M - ca.SX.eye(model.M.shape[0])).is_zero() else model.f + model.g
    return impact_structure(model, model.law, l, F, Y, (ca.jacobian(F, l), ca.jacobian(Y, x), ca.jacobian(Y, l)))


def _is_mass_singular(M: ca.SX) -> bool:
    """Whether M, a constant matrix, has no inverse that double precision would know."""
    return M.is_constant() and bool(np.linalg.matrix_rank(equilibrate_matrix(np.array(ca.DM(M)))[0]) < M.shape[0])


SCHEMES = {
    "theta-gamma": Scheme(one_step_problem=one_step_problem, initial_rows=initial_rows),
}
INITIAL_CHECKS = InitialChecks(check_start=check_start, warnings=warnings)
