"""Inputs: symbols that a signal drives, as a model declares them and as a run gives them.

What drives a model: the inputs that it is given, and behind them what its blocks set.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Self

import casadi as ca
import numpy as np

from nsmodel._utils import did_you_mean
from nsmodel.errors import ModelError, NsmodelError, UsageError
from nsmodel.modeling.blocks import DeclaredBlock, declare_blocks, has_held_duty, held_signals, latched_pwm, make_model_blocks
from nsmodel.modeling.conversion import Converter, DeclaredSymbols, declare, entry_names, is_casadi, is_sympy, names_read
from nsmodel.modeling.parameters import RESERVED_RUN_NAMES
from nsmodel.modeling.signals.base import ConstantSignal, ParametricSignal, Signal, read_numbers
from nsmodel.modeling.signals.function import expression_signal
from nsmodel.modeling.signals.pwm import HeldSignal

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


def read_parametric_signals(given: Mapping[str, Any], parameters: ca.SX, error: type[NsmodelError]) -> dict[str, Any]:
    """What drives each input, those with expressions for numbers as signals of these parameters (np, 1)."""
    converter = Converter([declare(parameters, "parameters")] if parameters.numel() else [])
    return {
        name: _parametric_signal(value, f"input '{name}'", converter, error)
        if isinstance(value, Signal) and value.expressions and not isinstance(value, ParametricSignal)
        else value
        for name, value in given.items()
    }


def _parametric_signal(signal: Signal, label: str, converter: Converter, error: type[NsmodelError]) -> Signal:
    for number, given in signal.expressions.items():
        if other := next((name for name in sorted(names_read(given)) if name not in converter.symbols), None):
            raise error(
                f"{label}: its {number[1:]} depends on '{other}', but may depend only on parameters "
                f"({', '.join(converter.symbols) or 'there are none'})"
            )
        expression = ca.densify(converter.convert(given, f"{label}: {number[1:]}"))
        if expression.numel() != 1:
            raise error(f"{label}: its {number[1:]} has the shape {expression.shape}; expected one number")
        signal = signal.with_number(number, expression)
    return ParametricSignal(label, signal).with_values(ca.SX(0, 1), ca.SX(0, 1))


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
    if isinstance(signal, ParametricSignal):
        return signal_label(signal.written)
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
            raise UsageError(
                f"input '{name}' is not declared; the model has {', '.join(names) or 'none'}" + did_you_mean(name, names)
            )
        if name in found:
            raise UsageError(f"input '{name}' is given twice; keep one")
        found[name] = value
    return found


@dataclass(frozen=True, eq=False)
class DeclaredInputs:
    """Declared: the symbols of all inputs, what drives each by its name, the blocks, and the inputs whose duty they hold."""

    symbols: Sequence[DeclaredSymbols]
    driven: Mapping[str, Any]
    blocks: Sequence[DeclaredBlock]
    latched: Sequence[str]

    @classmethod
    def of(cls, inputs: Any, blocks: Any, unblocked: str, parameters: Collection[str]) -> Self:
        """Read what a user gives; ``unblocked``: why the class takes no blocks; ``parameters``: the names of their scalars.

        Raises:
            ModelError: what is no input or no block, a name that is taken.
        """
        u, driven = declare_inputs(inputs)
        found = declare_blocks(blocks)
        latched = tuple(name for name, signal in driven.items() if has_held_duty(signal, parameters))
        duties = [declare(f"{name}.duty", "inputs") for name in latched]
        if unblocked and (found or duties):
            raise ModelError(f"blocks: {unblocked}")
        kept = [symbol for block in found for symbol in block.symbols]
        known = {*RESERVED_RUN_NAMES, *(str(other.stem) for other in u)}
        for symbol in kept:
            clash = {str(symbol.stem), *symbol.names} & known
            known |= {str(symbol.stem)}
            if clash:
                raise ModelError(
                    f"blocks: '{min(clash)}' is an input, or what another block sets, or an attribute of runs; take another name"
                )
        signals = {**driven, **held_signals(found), **{str(duty.stem): None for duty in duties}}
        return cls((*u, *kept, *duties), signals, found, latched)

    @property
    def u(self) -> ca.SX:
        """The symbols (nu, 1)."""
        return ca.vertcat(ca.SX(0, 1), *(item.sx for item in self.symbols))

    @property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """{name of an input: names of its entries}."""
        return {str(item.stem): item.names for item in self.symbols}

    def fields(
        self, time: DeclaredSymbols, parameters: ca.SX, converter: Converter, only: Callable[[ca.SX, str], None]
    ) -> dict[str, Any]:
        """``inputs`` and ``blocks`` of a model; ``only`` refuses an expression, by its label, of what blocks do not read."""
        groups, driven = self.groups, dict(self.driven)
        ends = np.cumsum([0, *(len(names) for names in groups.values())])
        places = {name: range(ends[i], ends[i + 1]) for i, name in enumerate(groups)}
        blocks = list(make_model_blocks(self.blocks, places, converter, only))
        for name in self.latched:
            label = f"input '{name}': duty"
            duty = ca.densify(ca.SX(converter.convert(driven[name].duty, label)))
            only(duty, label)
            driven[name], latch = latched_pwm(name, driven[name], places[f"{name}.duty"][0], duty)
            driven[f"{name}.duty"] = driven[name].duty
            blocks.append(latch)
        inputs = read_signals(read_parametric_signals(driven, parameters, ModelError), groups, Converter([time]))
        return {"inputs": MappingProxyType(inputs), "blocks": tuple(blocks)}
