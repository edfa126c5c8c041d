"""Inputs of a model in continuous time: between known times each is a polynomial of time, and that is a state.

u' = u_1, u_1' = u_2, ..., u_d' = 0 has the polynomials of degree d as its solutions. These states stand behind all others, and
are set at known times to what the signals are after them; expressions of time stand where the inputs stood. So series, pieces,
steps of stretches, checkpoints and C know inputs as states that nothing else acts on.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.laws.moving import LawEnds
from nsmodel.model.base import Model
from nsmodel.model.driven import block_input_entries, initial_inputs
from nsmodel.model.quantity import Quantity
from nsmodel.model.ticks import model_ticks
from nsmodel.once import cached_per_object
from nsmodel.scheme.continuous import ContinuousProblem, NotEventDriven
from nsmodel.signals.function import Expression
from nsmodel.signals.pwm import Pwm
from nsmodel.signals.signal import Signal, just_after


def with_input_states(problem: ContinuousProblem, model: Model) -> ContinuousProblem:
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
            own = [ca.SX.sym(name + "'" * k) for k in range(signal_degree(group, signal) + 1)]
            values.append(own[0])
            chain += own
            rate += [*own[1:], ca.SX(0)]
            names += [symbol.name() for symbol in own]
    held = ca.vertcat(ca.SX(0, 1), *chain)
    updates = [block for block in model.blocks if block.period is None]
    put = (ca.vertcat(*symbols), ca.vertcat(*values))
    parts = {
        name: ca.substitute(part, *put)
        for name in ("f", "g", "h", "multipliers", "outputs")
        if (part := getattr(problem, name)) is not None and part.numel()
    }
    first = {str(symbol): problem.x.numel() + i for i, symbol in enumerate(chain)}
    for block in updates:
        if ca.depends_on(block.next, getattr(model, "lam", ca.SX(0, 1))):
            raise NotEventDriven(f"block '{block.name}' reads multipliers after each step")
    f, g = (
        ca.vertcat(parts.get(name, getattr(problem, name)), more) for name, more in (("f", ca.vertcat(*rate)), ("g", 0 * held))
    )
    return replace(
        problem, **parts | {"f": f, "g": ca.densify(g)}, x=ca.vertcat(problem.x, held), held=held.numel(),
        names=(*problem.names, *names), x0=ca.vertcat(problem.x0, ca.DM(input_states(model, 0.0, None))),
        ends=tuple(LawEnds(end.name, *ca.substitute([end.lower, end.upper], *([part] for part in put))) for end in problem.ends),
        records={name: ca.substitute(record, *put) for name, record in problem.records.items()},
        updates=ca.substitute(ca.vertcat(ca.SX(0, 1), *(block.next for block in updates)), *put),
        updated=tuple(first[model.input_names[place]] for block in updates for place in block.at),
        updaters=tuple(block.name for block in updates for _ in block.at),
    )  # fmt: skip


def signal_degree(group: str, signal: Any) -> int:
    """The degree of a signal between known times; NotEventDriven where it has none."""
    degree = signal.degree if isinstance(signal, Signal) else None
    if degree is None:
        raise NotEventDriven(f"input '{group}' is no polynomial between known times ({type(signal).__name__.lower()})")
    return degree


def signal_kinds(model: Model) -> list[Any]:
    """What of the signals is in the expressions: degrees, and expressions of time."""
    return [s.column if isinstance(s, Expression) else signal_degree(name, s) for name, s in model.inputs.items()]


def input_states(model: Model, t: float, x: Sequence[float] | None) -> list[float]:
    """What the states of the inputs are just after time t, where the state is x; at the start it is None."""
    ticks = model_ticks(model)
    if ticks is None:
        return [value for column in _derivative_columns(model.inputs, t) for value in column]
    if x is None:
        u = initial_inputs(model)
    else:
        u = np.zeros(model.u.numel())
        u[ticks.at] = block_held_values(model, x)
        kept = ticks.kept(u)
        u = np.concatenate([signal.holding(kept).after(np.array([t]))[0] for signal in _plain_signals(model.inputs).values()])
        u = ticks.after(ticks.due_blocks(t), t, np.array(x[: ticks.states]), np.zeros(ticks.multipliers), u)
    kept = ticks.kept(u)
    return [
        v
        for column in _derivative_columns({name: s.holding(kept) for name, s in _plain_signals(model.inputs).items()}, t)
        for v in column
    ]


def block_held_values(model: Model, x: Sequence[float]) -> np.ndarray:
    """What blocks hold, of a state in continuous time, in the order in which they set it."""
    ticks, places = model_ticks(model), _input_places(model)
    return np.array([x[len(x) - places[None] + places[place]] for place in ([] if ticks is None else ticks.at.tolist())])


def block_set_entries(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """The entries of the inputs that blocks set, or whose edges they place, and their places among held states."""
    entries, places = block_input_entries(model), _input_places(model)
    return entries, np.array([places[entry] for entry in entries.tolist()], int)


def next_moving_edge(model: Model, t: float, x: Sequence[float]) -> float:
    """The first edge after t of PWMs whose duty blocks hold, in the periods of t."""
    ticks = model_ticks(model)
    if ticks is None:
        return math.inf
    u = np.zeros(model.u.numel())
    u[ticks.at] = block_held_values(model, x)
    kept = ticks.kept(u)
    pwms = [signal.holding(kept) for signal in _plain_signals(model.inputs).values() if signal.moving]
    found = [pwm.pulse(t) for pwm in pwms if isinstance(pwm, Pwm)]
    times = np.concatenate([np.zeros(0), *found])
    return float(times[times > just_after(np.array(t))].min(initial=math.inf))


def _plain_signals(inputs: Mapping[str, Any]) -> dict[str, Signal]:
    return {name: signal for name, signal in inputs.items() if isinstance(signal, Signal)}


@cached_per_object
def _input_places(model: Model) -> dict[int | None, int]:
    """Where the value of each entry of u stands among the states of the inputs; under None how many there are."""
    found: dict[int | None, int] = {}
    entry = at = 0
    for group, signal in model.inputs.items():
        for _ in model.input_groups[group]:
            if not isinstance(signal, Expression):
                found[entry] = at
                at += signal_degree(group, signal) + 1
            entry += 1
    return {**found, None: at}


def inputs_between_rows(problem: ContinuousProblem, model: Model) -> dict[str, Any]:
    """Of each scalar input what it is within a piece: a column of the pieces' states, or a quantity of t, as JSON can hold it."""
    found: dict[str, Any] = {}
    for group, signal in model.inputs.items():
        for k, name in enumerate(model.input_groups[group]):
            if isinstance(signal, Expression):
                found[name] = Quantity.made(ca.substitute(signal.column[k], signal.time, ca.SX.sym("t"))).text
            else:
                found[name] = problem.x.numel() - problem.held + problem.names[-problem.held :].index(name)
    return found


def _derivative_columns(inputs: Mapping[str, Any], t: float) -> Iterator[list[float]]:
    for signal in inputs.values():
        if isinstance(signal, Signal) and not isinstance(signal, Expression):
            yield from np.asarray(signal.derivatives(t)).T.tolist()
