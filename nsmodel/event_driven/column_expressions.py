"""Columns of event-driven runs as expressions of t, x, l and p: by name, or as expressions of the user's."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from nsmodel._utils import did_you_mean
from nsmodel.errors import UsageError
from nsmodel.event_driven.problem import ContinuousProblem
from nsmodel.modeling.base import Model
from nsmodel.modeling.outputs import SymbolsByName, read_column
from nsmodel.modeling.variants import start_entries


def output_symbols(model: Model, problem: ContinuousProblem, values: Mapping[str, float]) -> dict[str, ca.SX]:
    """{name of a column, or parameter: expression of t, x, l and p} of all that outputs may be of; ``values`` of parameters."""
    p, x = problem, dict(zip(problem.names, ca.vertsplit(problem.x), strict=True))
    found = {"t": p.t, **{name: ca.SX(value) for name, value in values.items()}, **{str(s): s for s in ca.vertsplit(p.p)}}
    for name, record in p.records.items():
        entries = ca.vertsplit(ca.vec(record))
        found |= {name: record} | ({f"{name}_{i}": entry for i, entry in enumerate(entries)} if len(entries) > 1 else {})
    l, y = (one if user is None else user for one, user in ((p.l, p.multipliers), (p.h, p.outputs)))
    named = p.rows if p.multipliers is None else p.declared
    for i, name in enumerate(named):
        found |= {f"l_{i}": l[i], f"y_{i}": y[i]} | ({name: l[i]} if name not in x else {})
    states = dict(zip(model.names, ca.vertsplit(p.x[: p.states]), strict=True))
    inputs = {name: x[name] for name in model.input_names if name in x}
    found |= {"l": l, "y": y} | states | inputs
    for stem, places in model.stems.items():
        found.setdefault(stem, ca.vertcat(*(p.x[i] for i in places)))
    for name, expression in model.outputs.items():
        names = [str(s) for s in ca.symvar(expression)]
        if all(one in found for one in names):
            found[name] = ca.substitute(
                expression, ca.vertcat(*ca.symvar(expression)), ca.vertcat(*(found[one] for one in names))
            )
    return found


def read_outputs(
    model: Model, problem: ContinuousProblem, values: Mapping[str, float], outputs: Any, label: str = "outputs"
) -> dict[str, ca.SX]:
    """{name: expression (1, 1)} of what the user asks for; left out the states, velocities included.

    Raises:
        UsageError: a name that is none, an expression of others.
    """
    known = output_symbols(model, problem, values)
    if outputs is None:
        velocities = [name for name in start_entries(model) if name not in model.names and name in known]
        outputs = [*model.names, *velocities]
    if isinstance(outputs, str | ca.SX):
        outputs = [outputs]
    pairs = outputs.items() if isinstance(outputs, Mapping) else [(str(one), one) for one in outputs]
    found: dict[str, ca.SX] = {}
    for name, value in pairs:
        symbols = SymbolsByName({one: ca.SX.sym(one) for one, own in known.items() if own.numel() == 1})
        if isinstance(value, str) and value in known:
            column = ca.vec(known[value])
        elif isinstance(value, str):
            raise UsageError(_unknown_output(value, known, label))
        else:
            column = read_column(value, f"{label}: '{name}'", symbols, UsageError)
            free = ca.symvar(column)
            for symbol in free:
                if symbol.name() not in known or known[symbol.name()].numel() != 1:
                    raise UsageError(_unknown_output(symbol.name(), known, label))
            if free:
                column = ca.substitute(column, ca.vertcat(*free), ca.vertcat(*(known[symbol.name()] for symbol in free)))
        size = column.numel()
        found |= {name if size == 1 else f"{name}_{i}": column[i] for i in range(size)}
    return found


def _unknown_output(name: str, known: Mapping[str, ca.SX], label: str) -> str:
    return f"{label}: '{name}' is not a column of runs of this model; there are {', '.join(known)}" + did_you_mean(name, known)
