"""Inputs of a model in continuous time: between known times each is a polynomial of time, and that is a state.

u' = u_1, u_1' = u_2, ..., u_d' = 0 has the polynomials of degree d as its solutions. These states stand behind all others, and
are set at known times to what the signals are after them; expressions of time stand where the inputs stood. So series, pieces,
steps of stretches, checkpoints and C know inputs as states that nothing else acts on.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.model.base import Model
from nsmodel.scheme.continuous import ContinuousProblem, NotEventDriven
from nsmodel.signals.function import Expression
from nsmodel.signals.signal import Signal


def driven(problem: ContinuousProblem, model: Model) -> ContinuousProblem:
    """The problem with the inputs of its model as states, or as what they are as expressions of time.

    Raises:
        NotEventDriven: a signal that is no polynomial between known times, by name.
    """
    if not model.u.numel():
        return problem
    symbols, values, chain, rate, names = [], [], [], [], []
    u = dict(zip(model.input_names, ca.vertsplit(model.u), strict=True))
    for group, signal in model.inputs.items():
        entries = model.input_groups[group]
        symbols += [u[name] for name in entries]
        if isinstance(signal, Expression):
            values += ca.vertsplit(ca.substitute(signal.column, signal.time, problem.t))
            continue
        for name in entries:
            own = [ca.SX.sym(name + "'" * k) for k in range(degree_of(group, signal) + 1)]
            values.append(own[0])
            chain += own
            rate += [*own[1:], ca.SX(0)]
            names += [symbol.name() for symbol in own]
    held = ca.vertcat(ca.SX(0, 1), *chain)
    put = (ca.vertcat(*symbols), ca.vertcat(*values))
    parts = {
        name: ca.substitute(part, *put)
        for name in ("f", "g", "h", "multipliers", "outputs")
        if (part := getattr(problem, name)) is not None and part.numel()
    }
    f, g = (
        ca.vertcat(parts.get(name, getattr(problem, name)), more) for name, more in (("f", ca.vertcat(*rate)), ("g", 0 * held))
    )
    return replace(
        problem, **parts | {"f": f, "g": ca.densify(g)}, x=ca.vertcat(problem.x, held), held=held.numel(),
        names=(*problem.names, *names), x0=ca.vertcat(problem.x0, ca.DM(data(model, 0.0))),
        records={name: ca.substitute(record, *put) for name, record in problem.records.items()},
    )  # fmt: skip


def degree_of(group: str, signal: Any) -> int:
    """The degree of a signal between known times; NotEventDriven where it has none."""
    degree = signal.degree if isinstance(signal, Signal) else None
    if degree is None:
        raise NotEventDriven(f"input '{group}' is no polynomial between known times ({type(signal).__name__.lower()})")
    return degree


def kinds(model: Model) -> list[Any]:
    """What of the signals is in the expressions: degrees, and expressions of time."""
    return [s.column if isinstance(s, Expression) else degree_of(name, s) for name, s in model.inputs.items()]


def data(model: Model, t: float) -> list[float]:
    """What the states of the inputs are just after time t."""
    return [value for column in _columns(model, t) for value in column]


def _columns(model: Model, t: float) -> Iterator[list[float]]:
    for signal in model.inputs.values():
        if isinstance(signal, Signal) and not isinstance(signal, Expression):
            yield from np.asarray(signal.derivatives(t)).T.tolist()
