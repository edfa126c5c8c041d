"""Prediction-correction for sweeping processes (Bernicot and Venel 2010, scheme (10)).

    q_{k+1} = P_{Qt}(q_k + h f(t_k, q_k)),
    Qt = {q : g_i(t_{k+1}, q_k) + <grad g_i(t_{k+1}, q_k), q - q_k> >= 0 for all i}

The projection's optimality conditions are q_{k+1} = q_k + h f + sum m_i grad g_i, 0 <= m_i ⟂ linearised g_i >= 0; m_i / h is
the reaction of constraint i. Each g_i(t, .) is convex, so g_i(t_{k+1}, q_{k+1}) >= 0 holds exactly.

q' = f(t, q) + grad g(t, q) l,   0 <= l ⟂ g(t, q) >= 0: the sweeping process with its reactions l.

What a run of a sweeping process looks at before it starts: q0 in Q(0), gradients and curvature of the constraints there.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.event_driven.problem import ContinuousProblem
from nsmodel.modeling.expressions import derivatives
from nsmodel.modeling.laws import complementarity
from nsmodel.modeling.variants import initial_inputs
from nsmodel.models.sweeping_process.model import SweepingProcess
from nsmodel.solvers.initial_checks import InitialChecks, check_start_inside, start_margin
from nsmodel.solvers.one_step_problem import OneStepProblem, Scheme, with_carried_inputs

QUADRATURE_POINTS = 8  # Of Gauss and Legendre's rule for the mean of f over a step: exact up to degree 15 in t.


def one_step_problem(model: SweepingProcess) -> OneStepProblem:
    """Return the projection as a linear complementarity problem in (q_{k+1}, m)."""
    t, h, q = model.t, ca.SX.sym("h"), model.q
    m = ca.SX.sym("m", model.g.numel())
    y = ca.SX.sym("y", m.numel())
    q_next, u = ca.SX.sym("q_next", q.numel()), ca.SX.sym("u_next", model.u.numel())
    f = _mean_forcing_expression(model, h, u) if model.mean_forcing else model.f
    g = ca.substitute([model.g], [t, model.u], [t + h, u])[0] if m.numel() else m
    G = ca.jacobian(g, q)
    problem = OneStepProblem(
        scheme="prediction-correction" + (", mean of f (Remark 3.2)" if model.mean_forcing else " (10)"),
        t=t, h=h, state=q, p=model.p,
        z=q_next, l=m, y=y,
        E=q_next - q - h * f - G.T @ m,
        Y=g + G @ (q_next - q),
        law=complementarity(m.numel()),
        rows=model.multiplier_names,
        guess=q,
        next_state=q_next,
        records={"gap": ca.substitute(g, q, q_next)} if m.numel() else {},
        gap="gap" if m.numel() else "",
        overreach=_overreach(g, G, q, q_next),
    )  # fmt: skip
    return with_carried_inputs(problem, model.u, u)


def _overreach(g: ca.SX, G: ca.SX, q: ca.SX, q_next: ca.SX) -> ca.SX | None:
    """(g_i(q') - g_i(q) - <grad g_i(q), q' - q>) / (|grad g_i(q)| |q' - q|), the coordinates those that g_i depends on.

    Of a ball of radius r, slid along by s, it is about s / 2r: the tangent of half the angle by which the normal turns. Where it
    is not small, Qt has nothing to do with the set that it stands for. It is 0 where g_i is below its linearisation: such a g_i
    is not convex, the step overruns it, and the run says so.

    What rests moves by rounding alone, and g_i(q') - g_i(q) is noise then. Of a convex g_i the difference is at most
    <grad g_i(q') - grad g_i(q), q' - q>, in which nothing cancels: it is cut off there.
    """
    if not ca.depends_on(G, q):
        return None
    (true, G_next), rows = ca.substitute([g, G], [q], [q_next]), []
    for i in range(g.numel()):
        own = sorted({j for j in G[i, :].sparsity().get_col()})
        d = q_next[own] - q[own]
        size = ca.sqrt(ca.sumsqr(G[i, own]) * ca.sumsqr(d))
        off = ca.fmin(true[i] - g[i] - G[i, own] @ d, (G_next[i, own] - G[i, own]) @ d)
        rows.append(ca.if_else(off > 0, off / size, 0))
    return ca.vertcat(*rows)


def _mean_forcing_expression(model: SweepingProcess, h: ca.SX, u_end: ca.SX) -> ca.SX:
    """(1/h) int_{t_k}^{t_{k+1}} f(s, q_k) ds (Remark 3.2) by Gauss-Legendre quadrature; inputs go from one end to the other."""
    f, t, u, total = model.f, model.t, model.u, 0
    for x, w in zip(*np.polynomial.legendre.leggauss(QUADRATURE_POINTS), strict=True):
        total += w / 2 * ca.substitute([f], [t, u], [t + h * (1 + x) / 2, (1 - x) / 2 * u + (1 + x) / 2 * u_end])[0]
    return ca.SX(total)


def initial_rows(model: SweepingProcess, h: float) -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """q_0 and its gaps g(0, q_0)."""
    q0 = np.array(ca.DM(model.q0)).ravel()
    gap = ca.Function("gap", [model.t, model.q, model.u], [ca.densify(model.g)])
    return [(q0, {"gap": np.array(gap(0, q0, initial_inputs(model))).ravel()} if model.g.numel() else {})]


def start_rows(model: SweepingProcess, h: ca.SX) -> list[tuple[ca.SX, dict[str, ca.SX]]]:
    """The same as expressions of the parameters."""
    at_start = [model.t, model.q, model.u], [ca.SX(0), model.q0, ca.SX(initial_inputs(model))]
    return [(model.q0, {"gap": ca.substitute([ca.densify(model.g)], *at_start)[0]} if model.g.numel() else {})]


def derived_columns(model: SweepingProcess, arrays: dict[str, np.ndarray], h_next: np.ndarray) -> dict[str, np.ndarray]:
    """The reactions m_i / h."""
    return {"reactions": arrays["multipliers"] / arrays["step"][:, None]}


def continuous_problem(model: SweepingProcess) -> ContinuousProblem:
    """Return the model in continuous time; the constraints are the rows themselves."""
    l = ca.SX.sym("l", model.g.numel())
    return ContinuousProblem(
        t=model.t, x=model.q, l=l, p=model.p,
        f=model.f, g=ca.densify(derivatives(model.g, model.q).T @ l), h=model.g,
        law=complementarity(l.numel()), rows=model.multiplier_names, names=tuple(model.names), x0=model.q0,
        states=model.q.numel(), impulses=True,
    )  # fmt: skip


def check_start(model: SweepingProcess) -> None:
    """Refuse q0 outside Q(0)."""
    check_start_inside(model.g, model.multiplier_names, model, "q0")


def admitted(model: SweepingProcess) -> list[ca.SX]:
    """That, of all values of the parameters."""
    return [start_margin(model.g, model, "q0")]


def warnings(model: SweepingProcess) -> list[str]:
    """Constraints that act on nothing at q0, and those that are not convex there."""
    return _zero_gradient_warnings(model) + _nonconvexity_warnings(model)


def _zero_gradient_warnings(model: SweepingProcess) -> list[str]:
    """Constraints without gradient at q0: their linearisation is a number, and the scheme cannot use them."""
    gradient = ca.Function("G", [model.t, model.q], [ca.densify(ca.jacobian(model.g, model.q))])
    G = np.array(gradient(0, np.array(ca.DM(model.q0)).ravel())).reshape(len(model.multiplier_names), len(model.names))
    flat = [name for name, row in zip(model.multiplier_names, G, strict=True) if not row.any()]
    return [f"constraint '{name}' has a zero gradient at q0: near there it acts on nothing" for name in flat[:5]]


def _nonconvexity_warnings(model: SweepingProcess) -> list[str]:
    """Constraints whose Hessian at q0 has a negative eigenvalue: the scheme's feasibility rests on convexity (S-convex)."""
    found, q0, all_g = [], np.array(ca.DM(model.q0)).ravel(), model.g
    rows, columns = map(np.array, ca.jacobian_sparsity(all_g, model.q).get_triplet())
    curved: dict[str, tuple[ca.SX, ca.SX]] = {}
    for k, name in enumerate(model.multiplier_names):
        own = model.q[columns[rows == k].tolist()]
        gradient = ca.gradient(all_g[k], own) if own.numel() else ca.SX(0, 1)
        if own.numel() and ca.depends_on(gradient, own):
            curved[name] = ca.densify(ca.jacobian(gradient, own)), gradient
    outputs = [part for parts in curved.values() for part in parts]
    values = ca.Function("H", [model.t, model.q], outputs)(0, q0) if curved else ()
    for name, H, slope in zip(curved, *(map(np.array, values[first::2]) for first in (0, 1)), strict=True):
        if not np.isfinite(H).all():
            continue
        least, distance = np.linalg.eigvalsh(H)[0], np.linalg.norm(q0)
        # A radius of curvature of 1e9 |q0| and more is round-off: a plane.
        if least < -1e-9 * max(np.abs(H).max(), np.linalg.norm(slope) / distance if distance else 0.0):
            found.append(
                f"constraint '{name}' is not convex at q0 (least eigenvalue of its Hessian {least:.3g}): feasibility may be lost"
            )
        if len(found) == 5:
            break
    return found


SCHEMES = {
    "prediction-correction": Scheme(
        one_step_problem=one_step_problem,
        initial_rows=initial_rows,
        symbolic_initial_rows=start_rows,
        derived_columns=derived_columns,
    ),
}
INITIAL_CHECKS = InitialChecks(check_start=check_start, warnings=warnings, admitted=admitted)
