"""Numbers in place of symbols, wherever these stand in a model."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import fields, is_dataclass, replace
from types import MappingProxyType
from typing import Any, TypeVar

import casadi as ca

UNCHANGED_FIELDS = frozenset({"p", "t", "u", "parameters", "inputs"})  # What is left as it is.

T = TypeVar("T")


def substitute_in_model(model: T, symbols: ca.SX, values: ca.SX) -> T:
    """A copy of the model with values in place of symbols."""

    def put(expression: Any) -> Any:
        if isinstance(expression, ca.SX):
            return ca.substitute(expression, symbols, values) if expression.numel() else expression
        if is_dataclass(expression) and not isinstance(expression, type):
            return replace(expression, **{f.name: put(getattr(expression, f.name)) for f in fields(expression)})
        if isinstance(expression, tuple):
            items = [put(item) for item in expression]
            return type(expression)(*items) if hasattr(expression, "_fields") else tuple(items)
        if isinstance(expression, Mapping):
            return MappingProxyType({key: put(item) for key, item in expression.items()})
        return expression

    other = copy(model)
    for name, value in vars(model).items():
        if name not in UNCHANGED_FIELDS:
            object.__setattr__(other, name, put(value))
    return other
