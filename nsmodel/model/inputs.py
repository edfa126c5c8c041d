"""Inputs: symbols that a signal drives, as a model declares them and as a run gives them."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError, NsmodelError, UsageError
from nsmodel.model.arguments import RESERVED_RUN_NAMES
from nsmodel.model.convert import Converter, DeclaredSymbols, declare
from nsmodel.model.symbols import entry_names, is_casadi, is_sympy
from nsmodel.signals.function import expression_signal
from nsmodel.signals.kept import HeldSignal
from nsmodel.signals.signal import ConstantSignal, Signal, read_numbers

Signals = Mapping[Any, Any]  # {symbol or name: signal, number, list of numbers, expression of t, or None}


def declare_inputs(given: Any) -> tuple[list[DeclaredSymbols], dict[str, Any]]:
    """The symbols, and {name of the whole: what drives it}.

    Raises:
        ModelError: no dictionary, a vector of symbols without a common name, a name that repeats.
    """
    if not isinstance(given, Mapping):
        raise ModelError(f"inputs: expected a dictionary {{symbol: signal}}, not a {type(given).__name__}")
    symbols, driven = [], {}
    for key, value in given.items():
        size = getattr(value, "size", np.size(value)) if isinstance(key, str) and value is not None else 1
        symbol = declare(entry_names(key, int(size)) if isinstance(key, str) else key, "inputs")
        if symbol.stem is None:
            raise ModelError(f"inputs: {', '.join(symbol.names)} have no common name; give each its own signal")
        if clash := {symbol.stem, *symbol.names} & RESERVED_RUN_NAMES:
            name = min(clash)
            raise ModelError(f"inputs: '{name}' clashes with run.{name}, an attribute of runs; take another name")
        if symbol.stem in driven:
            raise ModelError(f"inputs: '{symbol.stem}' is declared twice; keep one")
        symbols.append(symbol)
        driven[symbol.stem] = value
    return symbols, driven


def read_signals(
    given: Mapping[str, Any], names: Mapping[str, tuple[str, ...]], converter: Converter, error: type[NsmodelError] = ModelError
) -> dict[str, Signal | None]:
    """What drives each input, as a signal of its size; ``converter``: of expressions of time."""
    return {name: _read_signal(value, f"input '{name}'", len(names[name]), converter, error) for name, value in given.items()}


def _read_signal(value: Any, label: str, size: int, converter: Converter, error: type[NsmodelError]) -> Signal | None:
    if value is None:
        return None
    if isinstance(value, Signal):
        found = value
    elif is_casadi(value) or is_sympy(value):
        column = ca.densify(ca.vec(converter.convert(value, label)))
        constant = column.is_constant()
        found = ConstantSignal(np.array(ca.DM(column)).ravel()) if constant else expression_signal(column, np.zeros(0), label)
    elif callable(value):
        raise error(f"{label}: a function; give signal(function, edges=[...]), with the times at which it jumps")
    else:
        found = ConstantSignal(read_numbers(label, "its value", value, 0, 1).ravel())
    if found.size != size:
        what = "one value" if size == 1 else f"{size} values"
        raise error(f"{label} has {what}, and its {signal_label(found)} has {found.size}; give as many")
    return found


def signal_label(signal: Signal) -> str:
    """What messages call it."""
    if isinstance(signal, HeldSignal):
        return "block"
    return "value" if isinstance(signal, ConstantSignal) else type(signal).__name__.lower()


def signals_by_name(given: Any, names: Mapping[str, Any]) -> dict[str, Any]:
    """Signals of a run by the names of the inputs; UsageError for what is no input of the model, or is given twice."""
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise UsageError(f"inputs: expected a dictionary {{name: signal}}, not a {type(given).__name__}")
    found: dict[str, Any] = {}
    for key, value in given.items():
        name = key if isinstance(key, str) else declare(key, "inputs").stem or ", ".join(declare(key, "inputs").names)
        if name not in names:
            hint = difflib.get_close_matches(name, list(names), 1)
            raise UsageError(
                f"input '{name}' is not declared; the model has {', '.join(names) or 'none'}"
                + (f". Did you mean '{hint[0]}'?" if hint else "")
            )
        if name in found:
            raise UsageError(f"input '{name}' is given twice; keep one")
        found[name] = value
    return found
