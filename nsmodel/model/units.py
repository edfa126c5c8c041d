"""A model rewritten in other units of its state and of time: the same motion, other numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.classes.first_order.model import FirstOrderSystem
from nsmodel.classes.lure.model import LureSystem
from nsmodel.classes.oscillator.model import FrictionOscillator
from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.laws import Law
from nsmodel.model.base import Model
from nsmodel.model.convex import ConvexSplit


def in_units(model: Model, u: float, tau: float) -> Model:
    """Return the bound ``model`` with states, outputs and multipliers u times and times tau times as large.

    Its runs are those of the model with t, x, y, l multiplied; steps and the end of the run too. Names stay; labels of units,
    pictures and the exact solution are left out. Rates become u/tau times, M stays; a potential of forces becomes
    (u/tau)^2 times, theta u^2/tau^3, a potential in l ∈ -dPhi(y) u^2, the phi of an inclusion u^2/tau.
    """
    t, common = (model.t, model.t / tau), {"t": model.t, "names": model.names, "title": model.title, **_grid(model, tau)}
    if isinstance(model, SweepingProcess):
        q = (model.q, model.q / u)
        constraints = {name: u * _at(g, t, q) for name, g in model.constraints.items()}
        return SweepingProcess(
            q=model.q, f=u / tau * _at(model.f, t, q), constraints=constraints, q0=u * ca.DM(model.q0),
            mean_forcing=model.mean_forcing, **common,
        )  # fmt: skip
    x = (model.x, model.x / u)
    common |= {"x": model.x, "x0": u * ca.DM(model.x0)}
    if isinstance(model, FrictionOscillator):
        friction = {e.name: (e.H, u**2 / tau**3 * _at(e.theta, (model.s, model.s * tau / u))) for e in model.elements}
        start = {"v0": u / tau * ca.DM(model.v0)} if model.x1 is None else {"x1": u * ca.DM(model.x1)}
        return FrictionOscillator(
            potential=(u / tau) ** 2 * _at(model.potential, x), friction=friction, s=model.s,
            damping=None if model.damping is None else model.damping / tau,
            constraints={name: u * _at(c, x) for name, c in model.constraints.items()}, **start, **common,
        )  # fmt: skip
    if isinstance(model, FirstOrderSystem):
        l = (model.lam, model.lam / u)
        law = {
            "lam": model.lam, "h": u * _at(model.h, t, x, l), "g": u / tau * _at(model.g, t, x, l), "law": _law(model.law, u),
            "lam0": u * ca.DM(model.lam0),
        } if model.law.size else {}  # fmt: skip
        return FirstOrderSystem(
            f=u / tau * (_at(model.f, t, x) if model.law.size else _at(model.f + model.g, t, x)), M=model.M, theta=model.theta,
            gamma=model.gamma, **law, **common,
        )  # fmt: skip
    if isinstance(model, LureSystem):
        y = (model.y, None if model.y is None else model.y / u)
        law = {"law": _law(model.law, u)} if model.phi is None else {"y": model.y, "phi": u**2 * _at(model.phi, y)}
        n = model.x.numel()
        return LureSystem(
            A=ca.SX.zeros(n, n) if model.A.is_zero() else u / tau * _at(model.A, x), B=model.B / tau, C=model.C, D=model.D,
            f=u / tau * _at(model.f, t), theta=model.theta, gamma=model.gamma, **law, **common,
        )  # fmt: skip
    return _inclusion(model, u, tau, common)


def _inclusion(model: Any, u: float, tau: float, common: dict[str, Any]) -> Model:
    x = (model.x, model.x / u)
    if model.potential_split is None:
        signs = ca.substitute([model.operator], [model.sign_symbols], [ca.sign(model.sign_arguments)])[0]
        nonlinear = {"operator": u / tau * _at(signs if model.sign_symbols.numel() else model.operator, x)}
    else:
        nonlinear = {"phi": u**2 / tau * _at(potential(model.potential_split), x)}
    return type(model)(
        field=u / tau * _at(model.field, x), lower=u * model.lower, upper=u * model.upper,
        constraints={name: u * _at(c, x) for name, c in model.constraints.items()},
        tolerances=_tolerances(model.tolerances, u, tau), **nonlinear, **common,
    )  # fmt: skip


def potential(phi: ConvexSplit) -> ca.SX:
    """The finite part of a split potential as one expression; nothing in it may be nested."""
    sizes = {
        "abs": lambda u: ca.sum1(ca.fabs(u)), "max": lambda u: ca.sum1(ca.fmax(u, 0)), "norm": ca.norm_2,
    }  # fmt: skip
    return phi.smooth + sum((term.weight * sizes[term.kind](term.u) for term in phi.terms if term.kind in sizes), ca.SX(0))


def _at(expression: Any, *pairs: tuple[ca.SX, ca.SX]) -> ca.SX:
    old, new = zip(*pairs, strict=True)
    return ca.substitute([ca.SX(expression)], list(old), list(new))[0]


def _grid(model: Model, tau: float) -> dict[str, Any]:
    if model.steps is not None:
        return {"steps": tau * np.asarray(model.steps)}
    return {"step": None if model.step is None else tau * model.step, "t_end": tau * model.t_end}


def _law(law: Law, u: float) -> Law:
    return Law(tuple(block.scaled(u) for block in law.blocks))


def _tolerances(given: Any, u: float, tau: float) -> Any:
    if given is None:
        return None
    if isinstance(given, Callable):
        return lambda mu: u**2 * given(mu / tau)
    return u**2 * np.asarray(given, float)
