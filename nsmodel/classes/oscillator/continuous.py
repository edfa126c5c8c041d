"""x'' + dPhi(x') + M x' + dg(x) ∋ f(t) as a system of first order in (x, v), with the friction as multipliers (Cabot 2004)."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.oscillator.model import Friction, FrictionOscillator
from nsmodel.classes.oscillator.schemes.inertial_proximal import slope_at_zero, smooth_friction
from nsmodel.event_driven.problem import ContinuousProblem, NotEventDriven, SlipGrowth
from nsmodel.modeling.laws import ball, complementarity, product
from nsmodel.modeling.parameters import numbered_row_names
from nsmodel.solvers.one_step_problem import stationary_parts, subdifferential

SAMPLE_VALUE = 0.7  # A value of parameters like any other.


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
