"""A model rewritten in other units of its state and of time: the same motion, other numbers."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.modeling.base import Model
from nsmodel.modeling.convex_split import ConvexSplit
from nsmodel.modeling.laws import Law
from nsmodel.study.reference_steps import REFERENCE_STEP


def in_units(model: Model, u: float, tau: float) -> Model:
    """Return the bound ``model`` with states, outputs and multipliers u times and times tau times as large.

    Its runs are those of the model with t, x, y, l multiplied; steps and the end of the run too. Names stay; labels of units,
    pictures and the exact solution are left out. Rates become u/tau times, M stays; a potential of forces becomes
    (u/tau)^2 times, theta u^2/tau^3, a potential in l ∈ -dPhi(y) u^2, the phi of an inclusion u^2/tau. Inputs, and what
    blocks hold, keep their values; edges and ticks move.
    """
    common = {"t": model.t, "names": model.names, "title": model.title, "scheme": model.scheme, **_scaled_time_grid(model, tau)}
    other = REFERENCE_STEP.of(model).in_units(model, u, tau, common | {"inputs": _scaled_signals(model, tau)})
    l = getattr(model, "lam", ca.SX(0, 1))
    own = (model.t, model.t / tau), (model.state, model.state / u), (l, l / u)
    other._set(blocks=tuple(block.in_units(tau, lambda read: substitute_pairs(read, *own)) for block in model.blocks))
    return other


def potential_expression(phi: ConvexSplit) -> ca.SX:
    """The finite part of a split potential as one expression; nothing in it may be nested."""
    sizes = {
        "abs": lambda u: ca.sum1(ca.fabs(u)), "max": lambda u: ca.sum1(ca.fmax(u, 0)), "norm": ca.norm_2,
    }  # fmt: skip
    return phi.smooth + sum((term.weight * sizes[term.kind](term.u) for term in phi.terms if term.kind in sizes), ca.SX(0))


def substitute_pairs(expression: Any, *pairs: tuple[ca.SX, ca.SX]) -> ca.SX:
    """The expression with (symbol, what stands in its place) put in."""
    old, new = zip(*pairs, strict=True)
    return ca.substitute([ca.SX(expression)], list(old), list(new))[0]


def _scaled_time_grid(model: Model, tau: float) -> dict[str, Any]:
    edges = {"switch_times": [tau * time for time in model.switch_times]}
    if model.steps is not None:
        return {"steps": tau * np.asarray(model.steps)} | edges
    return {"step": None if model.step is None else tau * model.step, "t_end": tau * model.t_end} | edges


def _scaled_signals(model: Model, tau: float) -> dict[ca.SX, Any]:
    """What drives the symbols of each input; blocks among them, which follow."""
    ends = np.cumsum([0, *map(len, model.input_groups.values())])
    entries = (model.u[int(a) : int(b)] for a, b in pairwise(ends))
    return {symbols: signal.in_time(tau) for symbols, signal in zip(entries, model.inputs.values(), strict=True)}


def scaled_law(law: Law, u: float, t: ca.SX, tau: float) -> Law:
    """The law of u l at times that are tau times as large."""
    return Law(tuple(block.scaled(u) for block in law.put(t, t / tau).blocks))


def scaled_tolerances(given: Any, u: float, tau: float) -> Any:
    """Tolerances eps_k of squared distances, or a function of the step."""
    if given is None:
        return None
    if isinstance(given, Callable):
        return lambda mu: u**2 * given(mu / tau)
    return u**2 * np.asarray(given, float)
