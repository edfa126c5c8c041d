"""Inertial proximal method for oscillators under dry friction (Cabot 2004, algorithm (A)).

    (x_{n+2} - 2 x_{n+1} + x_n)/l_n^2 + A((x_{n+2} - x_{n+1})/l_n) + B(x_{n+2}) ∋ 0,   A = dPhi, B = dg

The state is the pair (x_n, x_{n+1}), kept as x_{n+1} and the difference x_{n+1} - x_n; the unknown is the next difference
d = x_{n+2} - x_{n+1}, so that stick is d = 0 and nothing else. With h = l_n, times h^2:

    d - (x_{n+1} - x_n) + h^2 ( dPhi(d/h) + dg(x_{n+1} + d) ) ∋ 0

A force f that moves with time is taken at the end of the step. With one, and with inputs whatever reads them, the state has the
velocity (x_{n+1} - x_n)/l_{n-1} in place of the difference: where steps change, as they do around edges, it is the velocity that
goes on,

    d - h v_n + h^2 ( dPhi(d/h) + dg(x_{n+1} + d) - f(t_{n+2}) ) ∋ 0

theta_j splits into theta_j'(0) s, whose subdifferential is a ball, and a rest that is C1 in v with gradient 0 at v = 0
(Proposition 2.2).

x'' + dPhi(x') + M x' + dg(x) ∋ f(t) as a system of first order in (x, v), with the friction as multipliers (Cabot 2004).

What a run of an oscillator looks at before it starts: its laws and where it starts, the convexity of theta and of g.

Impacts of oscillators: constraints of the positions act on accelerations alone.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel._utils import cached_per_object
from nsmodel.errors import UsageError
from nsmodel.event_driven.problem import TINY_SPEED, ContinuousProblem, NotEventDriven, SlipGrowth
from nsmodel.modeling.laws import ball, complementarity, product
from nsmodel.modeling.parameters import numbered_row_names
from nsmodel.models.friction_oscillator.model import Friction, FrictionOscillator
from nsmodel.solvers.impacts import ImpactStructure
from nsmodel.solvers.initial_checks import (
    InitialChecks,
    check_start_inside,
    check_term_weights,
    convexity_warning,
    parameter_values_text,
    psd_warning,
    start_margin,
    symbolic_term_weights,
)
from nsmodel.solvers.one_step_problem import OneStepProblem, Scheme, stationary_parts, subdifferential, with_carried_inputs


def one_step_problem(model: FrictionOscillator) -> OneStepProblem:
    """Return the step as a nonsmooth problem in d, with the friction forces and the reactions of dg as multipliers."""
    h, x, n = ca.SX.sym("h"), model.x, model.x.numel()
    keeps, u = model.keeps_velocity, ca.SX.sym("u_next", model.u.numel())
    old, d = ca.SX.sym("v_old" if keeps else "d_old", n), ca.SX.sym("d", n)
    v, x_next, d_old = d / h, x + d, h * old if keeps else old

    elements, moved = elements_at_end(model, model.t + h, u), ca.vertcat(model.t, u)
    xi = [ca.SX.sym(f"xi_{e.name}", e.H.shape[0]) for e in elements]
    smooth = -ca.substitute([model.force], [model.t, model.u], [model.t + h, u])[0]
    smooth += 0 if model.damping is None else model.damping @ v
    for element, l in zip(elements, xi, strict=True):
        smooth += element.H.T @ (smooth_friction(element, model.s, element.H @ v) - l)

    g = subdifferential(model.potential_split, x, "potential")
    c = ca.vertcat(ca.SX(0, 1), *model.constraints.values())
    n_c = ca.SX.sym("n", c.numel())
    force = substitute_state(g.force, x, x_next) + substitute_state(ca.jacobian(c, x), x, x_next).T @ n_c

    balls = (ball(e.H.shape[0], slope_at_zero(e, model.s, moved)) for e in elements)
    l = ca.vertcat(ca.SX(0, 1), *xi, g.l, n_c)
    rows = tuple(name for e in elements for name in numbered_row_names(e.name, e.H.shape[0])) + g.rows + model.constraint_names
    y, law = ca.SX.sym("y", l.numel()), product(*balls, g.law, complementarity(n_c.numel()))
    Y = ca.vertcat(ca.SX(0, 1), *(e.H @ d for e in elements), substitute_state(g.u, x, x_next), substitute_state(c, x, x_next))
    own = stationary_parts(law, rows, l, moved, [d - d_old + h**2 * (smooth - force), Y])
    E, Y = own.parts
    problem = OneStepProblem(
        scheme="inertial proximal (A)",
        t=model.t, h=h, state=ca.vertcat(x, old), p=model.p,
        z=d, l=own.l, y=y, E=E, Y=Y, law=own.law, rows=rows,
        guess=d_old,
        next_state=ca.vertcat(x_next, v if keeps else d),
        multipliers=own.multipliers, outputs=None if own.multipliers is None else y, declared=rows,
        ends=own.ends, scale=own.scale,
        records={"v": v},
        carried="the velocity" if keeps else "the last difference of positions", velocity="v", difference=not keeps,
    )  # fmt: skip
    return with_carried_inputs(problem, model.u, u)


def elements_at_end(model: FrictionOscillator, t: ca.SX, u: ca.SX) -> tuple[Friction, ...]:
    """The friction elements at a time and inputs; those that stay as they are."""
    old = ca.vertcat(model.t, model.u)
    return tuple(
        e._replace(theta=ca.substitute(e.theta, old, ca.vertcat(t, u))) if model.is_friction_moving(e) else e
        for e in model.elements
    )


def slope_at_zero(element: Friction, s: ca.SX, moved: ca.SX | None = None) -> ca.SX:
    """theta'(0), from the right: the radius of A(0) (Proposition 2.2); ``moved``: the symbols of time and inputs in theta.

    theta is given for s >= 0. Where it is written with a kink at 0 (fabs(s), fmax(s, 0)) the derivative there is taken for
    something else than the slope that it has just beside: equal slopes at two least sizes tell.
    """
    if moved is not None and ca.depends_on(element.theta, moved) and not ca.depends_on(slope := ca.gradient(element.theta, s), s):
        return slope
    at_zero, near_zero, further = (
        ca.substitute(ca.gradient(element.theta, s), s, value) for value in (0, TINY_SPEED, 1e10 * TINY_SPEED)
    )
    return ca.if_else(ca.fabs(further - near_zero) <= 1e-9 * ca.fabs(near_zero), near_zero, at_zero)


def smooth_friction(element: Friction, s: ca.SX, u: ca.SX) -> ca.SX:
    """(theta'(|u|) - theta'(0)) u/|u|, the smooth part of the friction at u = H v: 0 at u = 0, linear for a quadratic theta."""
    slope = ca.gradient(element.theta, s)
    curvature = ca.gradient(slope, s)
    if not ca.depends_on(curvature, s):
        return curvature * u
    # The least size keeps derivatives finite at u = 0, in any unit of length.
    scalar = u.numel() == 1
    size = ca.fmax(ca.fabs(u), TINY_SPEED) if scalar else ca.sqrt(ca.sumsqr(u) + TINY_SPEED**2)
    direction = ca.sign(u) if scalar else u / size
    return (ca.substitute(slope, s, size) - slope_at_zero(element, s)) * direction


@cached_per_object
def energy_function(model: FrictionOscillator) -> ca.Function:
    """E_n = |x_{n+1} - x_n|^2 / (2 l_n^2) + g(x_{n+1}) (14), as a function of (x_{n+1}, (x_{n+1} - x_n)/l_n)."""
    w = ca.SX.sym("w", model.x.numel())
    return ca.Function("energy", [model.x, w], [ca.sumsqr(w) / 2 + model.potential])


def shortened(model: FrictionOscillator, state: np.ndarray, ratio: float) -> np.ndarray:
    """The state before a last step shortened by ``ratio``: the older position is moved so that the velocity is kept.

    The paper divides the older difference by the new step, for steps that do not decrease; a step that only the end of the
    run shortens is not meant to be a kick.
    """
    n = state.size if model.keeps_velocity else state.size // 2
    return np.concatenate([state[:n], state[n:] * ratio])


def substitute_state(expression: ca.SX, x: ca.SX, value: ca.SX) -> ca.SX:
    """The expression with x replaced."""
    return ca.substitute(expression, x, value) if expression.numel() else expression


def initial_rows(model: FrictionOscillator, h: float) -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """(x_0, v_0), where the older position is x_0 - h v_0; or the paper's two positions x_0, x_1 as rows 0 and 1."""
    x0 = np.array(ca.DM(model.x0)).ravel()
    if model.x1 is None:
        v0 = np.array(ca.DM(model.v0)).ravel()
        return [(np.concatenate([x0, v0 if model.keeps_velocity else h * v0]), {"v": v0})]
    x1 = np.array(ca.DM(model.x1)).ravel()
    with np.errstate(over="ignore"):
        d, v = x1 - x0, (x1 - x0) / h
    if not np.isfinite(v).all():
        raise UsageError(
            f"x0 = {x0}, x1 = {x1}: the velocity (x1 - x0)/h overflows at h = {h:g}; take a longer step, or other units"
        )
    return [
        (np.concatenate([x0, np.full(x0.size, np.nan)]), {}),
        (np.concatenate([x1, v if model.keeps_velocity else d]), {"v": v}),
    ]


def start_rows(model: FrictionOscillator, h: ca.SX) -> list[tuple[ca.SX, dict[str, ca.SX]]]:
    """These rows as expressions of h and the parameters."""
    if model.x1 is None:
        return [(model.x0, {"v": model.v0})]
    return [(model.x0, {}), (model.x1, {"v": (model.x1 - model.x0) / h})]


def start_of(model: FrictionOscillator, h: ca.SX) -> ca.SX:
    """The state of the last of these rows as an expression of h."""
    d = h * model.v0 if model.x1 is None else model.x1 - model.x0
    return ca.vertcat(model.x0 if model.x1 is None else model.x1, d / h if model.keeps_velocity else d)


def derived_columns(model: FrictionOscillator, arrays: dict[str, np.ndarray], h_next: np.ndarray) -> dict[str, np.ndarray]:
    """The energy E_n: the last difference over the step that comes next; with a force, of the velocity."""
    if model.keeps_velocity:
        return {"energy": np.array(energy_function(model).map(len(arrays["v"]))(arrays["x"].T, arrays["v"].T)).ravel()}
    d = arrays["v"] * arrays["step"][:, None]
    if not np.isfinite(arrays["step"][0]):
        d[0] = arrays["v"][0] * h_next[0]
        known = np.flatnonzero(~np.isfinite(arrays["step"]) & np.isfinite(arrays["v"]).all(axis=1))
        d[known] = arrays["v"][known] * h_next[known, None]
    w = d / h_next[:, None]
    return {"energy": np.array(energy_function(model).map(len(w))(arrays["x"].T, w.T)).ravel()}


SAMPLE_VALUE = 0.7  # A value of parameters like any other: formulas that fail at 0, 1 or other whole numbers do not fail here.


def continuous_problem(model: FrictionOscillator) -> ContinuousProblem:
    """Return the model in continuous time: rows H v of the friction elements, then kinks and constraints of the position.

    Raises:
        NotEventDriven: the model starts from two positions.
    """
    if model.v0 is None:
        raise NotEventDriven(
            "x1 starts the recursion of the paper, a step after x0; without a step a start is x0 and v0: give v0"
        )
    x, v, driven = model.x, ca.SX.sym("v", model.x.numel()), ca.vertcat(model.t, model.u)
    xi = [ca.SX.sym(f"xi_{e.name}", e.H.shape[0]) for e in model.elements]
    pushed, growths = _smooth_force(model, v, driven)
    potential = subdifferential(model.potential_split, x, "potential")
    c = ca.vertcat(ca.SX(0, 1), *model.constraints.values())
    n = ca.SX.sym("n", c.numel())
    smooth = ca.substitute(potential.force, potential.l, ca.SX.zeros(potential.l.numel()))
    rubbed = sum((e.H.T @ l for e, l in zip(model.elements, xi, strict=True)), ca.SX.zeros(x.numel()))
    held = potential.force - smooth + ca.jacobian(c, x).T @ n
    l, h = (
        ca.vertcat(ca.SX(0, 1), *xi, potential.l, n),
        ca.vertcat(ca.SX(0, 1), *(e.H @ v for e in model.elements), potential.u, c),
    )
    names = tuple(name for e in model.elements for name in numbered_row_names(e.name, e.H.shape[0]))
    rows, g = names + potential.rows + model.constraint_names, ca.densify(ca.vertcat(ca.SX.zeros(x.numel()), rubbed + held))
    balls = (ball(e.H.shape[0], slope_at_zero(e, model.s, driven)) for e in model.elements)
    own = stationary_parts(product(*balls, potential.law, complementarity(n.numel())), rows, l, driven, [g, h])
    g, h = own.parts
    return ContinuousProblem(
        t=model.t, x=ca.vertcat(x, v), l=own.l, p=model.p,
        f=ca.vertcat(v, pushed + smooth + model.force), g=g, h=h, law=own.law, rows=rows,
        multipliers=own.multipliers, outputs=None if own.multipliers is None else h, declared=rows, ends=own.ends,
        names=(*model.names, *(f"v of {name}" for name in model.names)),
        x0=ca.vertcat(model.x0, model.v0),
        states=x.numel(), growths=growths, records={"v": v, "energy": ca.sumsqr(v) / 2 + model.potential},
    )  # fmt: skip


def _smooth_force(model: FrictionOscillator, v: ca.SX, driven: ca.SX) -> tuple[ca.SX, tuple[SlipGrowth, ...]]:
    """What damping and the smooth parts of friction push by, and the factors of the friction where these have no series."""
    pushed = -model.damping @ v if model.damping is not None else ca.SX.zeros(v.numel())
    growths, row = [], 0
    for e in model.elements:
        growth = _friction_growth(e, model.s, row, driven)
        if growth is None:
            pushed -= e.H.T @ smooth_friction(e, model.s, e.H @ v)
        else:
            growths.append(growth)
        row += e.H.shape[0]
    return pushed, tuple(growths)


def _friction_growth(element: Friction, s: ca.SX, first: int, driven: ca.SX) -> SlipGrowth | None:
    """theta'(|Hv|)/theta'(0) as a factor of the friction at the threshold; None where the rest of it has a series at Hv = 0.

    Raises:
        NotEventDriven: theta'(0) = 0, and the rest has none, or moves with time.
    """
    slope = ca.gradient(element.theta, s)
    curvature = ca.gradient(slope, s)
    if not ca.depends_on(curvature, s):
        return None
    if ca.depends_on(element.theta, driven):
        raise NotEventDriven(
            f"friction '{element.name}' moves with time, and theta' is not linear in s: there is no factor of s alone"
        )
    if element.H.shape[0] == 1 and np.isfinite(_expression_value(ca.substitute(curvature, s, 0))):
        return None
    least = slope_at_zero(element, s)
    if not _expression_value(least):
        raise NotEventDriven(
            f"friction '{element.name}': theta'(0) = 0, and theta' is not linear: |Hv| has no series where the motion turns"
        )
    return SlipGrowth(first, s, slope / least)


def _expression_value(expression: ca.SX) -> float:
    """The number that an expression is; of parameters, one that it is at some of them."""
    symbols = ca.veccat(*ca.symvar(expression))
    return float(ca.substitute(expression, symbols, SAMPLE_VALUE + 0 * symbols) if symbols.numel() else expression)


CHECK_SPEEDS = np.concatenate([[0.0], np.logspace(-6, 3, 60)])  # Where theta' and theta'' are sampled.


def check_start(model: FrictionOscillator) -> None:
    """Refuse theta'(0) < 0, weights < 0, and positions outside dom g."""
    for element in _elements_at_start(model):
        slope = float(ca.DM(slope_at_zero(element, model.s)))
        if not 0 <= slope < np.inf:
            raise UsageError(
                f"friction '{element.name}': theta = {element.theta} has theta'(0) = {slope:g}{parameter_values_text(model)}; "
                "the friction force at rest must be a finite number >= 0"
            )
    check_term_weights(model.potential_split, "potential", model)
    c, domain = _position_constraints(model)
    names = (*model.constraint_names, *(f"potential: {row} >= 0" for row in domain))
    for label in _start_labels(model):
        check_start_inside(c, names, model, label)


def admitted(model: FrictionOscillator) -> list[ca.SX]:
    """That, of all values of the parameters."""
    slopes = [slope_at_zero(element, model.s) for element in model.elements]
    return [
        *slopes,
        symbolic_term_weights(model.potential_split),
        *(start_margin(_position_constraints(model)[0], model, label) for label in _start_labels(model)),
    ]


def _position_constraints(model: FrictionOscillator) -> tuple[ca.SX, list[ca.SX]]:
    """What positions keep >= 0: constraints, then the domain of the potential; and the latter."""
    domain = [row for rows in model.potential_split.domain for row in ca.vertsplit(rows)]
    return ca.vertcat(ca.SX(0, 1), *model.constraints.values(), *domain), domain


def _start_labels(model: FrictionOscillator) -> tuple[str, ...]:
    return ("x0", "x1") if model.x1 is not None else ("x0",)


def warnings(model: FrictionOscillator) -> list[str]:
    """Where theta, the damping or g is not what the theory asks for."""
    found = []
    for element in _elements_at_start(model):
        slope = ca.gradient(element.theta, model.s)
        f = ca.Function("theta", [model.s], [slope, ca.gradient(slope, model.s)])
        first, second = (np.array(v).ravel() for v in f.map(CHECK_SPEEDS.size)(CHECK_SPEEDS[None, :]))
        if np.nanmin(first) < 0:
            s = CHECK_SPEEDS[int(np.nanargmin(first))]
            found.append(f"theta of '{element.name}' decreases: theta'({s:.3g}) = {np.nanmin(first):.3g} < 0")
        if np.nanmin(second) < -1e-12 * np.nanmax(np.abs(first)):
            s = CHECK_SPEEDS[int(np.nanargmin(second))]
            found.append(f"theta of '{element.name}' is not convex: theta''({s:.3g}) = {np.nanmin(second):.3g} < 0")
    x0 = np.array(ca.DM(model.x0)).ravel()
    if model.damping is not None:
        found += psd_warning("damping", model.damping)
    return found + convexity_warning(model.potential_split.smooth, model.x, x0, "the potential is not convex at x0")


def _elements_at_start(model: FrictionOscillator) -> tuple[Friction, ...]:
    return elements_at_end(model, ca.SX(0), model.u)


def impact_system(model: FrictionOscillator) -> ImpactStructure | None:
    """s = (x, v): what moves an oscillator against its constraints; other forces are bounded, and do not enter y'."""
    if not model.constraint_names:
        return None
    c = ca.vertcat(*model.constraints.values())
    n, v = ca.SX.sym("n", c.numel()), ca.SX.sym("v", model.x.numel())
    s, slopes = ca.vertcat(model.x, v), ca.jacobian(c, model.x)
    F_l = ca.vertcat(ca.SX(v.numel(), c.numel()), slopes.T)
    start = ca.vertcat(model.x0 if model.x1 is None else model.x1, ca.SX.zeros(v.numel()) if model.v0 is None else model.v0)
    names = tuple(model.names or ())
    states = [*names, *(f"v of {name}" for name in names)]
    return ImpactStructure(
        model.t, s, n, ca.vertcat(v, slopes.T @ n), c, F_l, ca.jacobian(c, s), ca.SX(n.numel(), n.numel()), start,
        np.zeros(n.numel()), np.full(n.numel(), np.inf), states, model.constraint_names, -n.numel(),
    )  # fmt: skip


SCHEMES = {
    "inertial proximal": Scheme(
        one_step_problem=one_step_problem,
        initial_rows=initial_rows,
        symbolic_initial_rows=start_rows,
        symbolic_start_state=start_of,
        derived_columns=derived_columns,
        state_before_short_step=shortened,
    ),
}
INITIAL_CHECKS = InitialChecks(check_start=check_start, warnings=warnings, admitted=admitted)
