"""Starts as parameters: where runs begin becomes something that they are given."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from types import MappingProxyType
from typing import TypeVar

import casadi as ca

from nsmodel.errors import UsageError
from nsmodel.model.base import Model

M = TypeVar("M", bound=Model)


def start_name(state: str) -> str:
    """The name of the parameter that is the start of a state."""
    return f"{state}(0)"


def start_entries(model: Model) -> dict[str, tuple[str, int]]:
    """{name: (field, entry)} of what a model starts from: each state; velocities ``v``, or ``v_0``, ..., where it has some."""
    if not isinstance(vars(model).get(f"{model.letter}0"), ca.SX):
        return {}
    found = {name: (f"{model.letter}0", i) for i, name in enumerate(model.names)}
    velocity = vars(model).get("v0")
    if isinstance(velocity, ca.SX):
        n = velocity.numel()
        found |= {"v" if n == 1 else f"v_{i}": ("v0", i) for i in range(n)}
    return found


def with_start_parameters(model: M, states: Sequence[str]) -> M:
    """The model with the starts of these states as further parameters, called ``start_name``, without a value.

    Raises:
        UsageError: what the model does not start from.
    """
    if not states:
        return model
    known = start_entries(model)
    fields: dict[str, ca.SX] = {}
    symbols = []
    for state in states:
        if state not in known:
            hint = difflib.get_close_matches(state, list(known), 1)
            available = f"there are {', '.join(known)}" if known else f"{type(model).__name__} has its start in its own arguments"
            raise UsageError(f"start: '{state}' is no state; {available}" + (f". Did you mean '{hint[0]}'?" if hint else ""))
        field, entry = known[state]
        symbols.append(ca.SX.sym(start_name(state)))
        fields.setdefault(field, ca.SX(getattr(model, field)))[entry] = symbols[-1]
    other = model.__copy__()
    names = dict.fromkeys(start_name(state) for state in states)
    other._set(**fields, p=ca.vertcat(model.p, *symbols), parameters=MappingProxyType({**model.parameters, **names}))
    return other
