"""A model with the signals of a run, as it is at their start, and at constant values.

Starts as parameters: where runs begin becomes something that they are given.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from types import MappingProxyType
from typing import Any, TypeVar

import casadi as ca
import numpy as np

from nsmodel._utils import cached_per_object_and_key, did_you_mean
from nsmodel.errors import UsageError
from nsmodel.modeling.base import Model
from nsmodel.modeling.blocks import has_held_duty, model_ticks
from nsmodel.modeling.conversion import Converter, declare
from nsmodel.modeling.inputs import Signals, read_parametric_signals, read_signals, signals_by_name
from nsmodel.modeling.parameters import substitute_in_model
from nsmodel.modeling.signals.base import Signal
from nsmodel.modeling.signals.pwm import HeldSignal
from nsmodel.proof.verdict import not_none

T = TypeVar("T", bound=Any)
NO_INPUT_FIELDS = {"u": ca.SX(0, 1), "inputs": MappingProxyType({}), "input_groups": MappingProxyType({}), "blocks": ()}


def with_inputs(model: T, signals: Signals | None = None) -> T:
    """The model with these signals in place of those declared.

    Raises:
        UsageError: a name that is no input; an input that nothing drives; another number of values.
    """
    if signals is None and all(signal is not None for signal in model.inputs.values()):
        return model
    named = signals_by_name(signals, model.input_groups)
    for name in [name for name, signal in named.items() if has_held_duty(signal, model.parameters)]:
        raise UsageError(f"input '{name}': a pwm whose duty is an expression; declare it in the model, whose blocks it reads")
    parametric = read_parametric_signals(named, model.p, UsageError)
    given = read_signals(parametric, model.input_groups, Converter([declare(model.t, "t")]), UsageError)
    for name in given:
        if isinstance(model.inputs[name], HeldSignal):
            raise UsageError(f"input '{name}' is set by the block '{model.inputs[name].by}'; leave it out")
    inputs = {**model.inputs, **given}
    for name, signal in inputs.items():
        if signal is None:
            raise UsageError(f"input '{name}' has no signal; give inputs={{'{name}': ...}} or --input {name}=FILE.csv")
    return with_signals(model, given)


def with_inputs_at_any_step(model: T, what: str, signals: Signals | None = None) -> T:
    """The model with these signals in place of those declared, for ``what`` takes steps of other lengths than its own.

    Raises:
        UsageError: see `with_inputs`; a signal that has a value for each step of one grid.
    """
    driven = with_inputs(model, signals)
    for name, signal in driven.inputs.items():
        if signal.count is not None:
            raise UsageError(
                f"{what}: input '{name}' is steps(...), one row for each step, but the steps have many lengths; give table"
            )
    return driven


def parametric_inputs(model: Any) -> dict[str, tuple[str, ...]]:
    """{name: parameters} of the inputs whose signals need values of these to be functions of time."""
    return {name: signal.parameters for name, signal in model.inputs.items() if signal is not None and signal.parameters}


def with_signals_of(model: T, bound: T) -> T:
    """The model with the signals of ``bound``, which is the same with numbers for parameters, those of signals among them.

    The same object for the same two: what is made of it is made once.
    """
    return _with_bound_signals(model, bound) if parametric_inputs(model) else model


@cached_per_object_and_key(most=4)
def _with_bound_signals(model: Any, bound: Any) -> Any:
    return with_signals(model, bound.inputs)


def with_signals(model: T, signals: Mapping[str, Signal | None]) -> T:
    """The model with these signals, read already, of some of its inputs."""
    return _with_fields(model, inputs=MappingProxyType({**model.inputs, **signals})) if signals else model


def with_initial_inputs(model: T) -> T:
    """The model with its inputs held at u(0+)."""
    if not model.u.numel():
        return model
    held = substitute_in_model(model, model.u, ca.SX(initial_inputs(model)))
    return _with_fields(held, **NO_INPUT_FIELDS)


def freeze_inputs(model: T, held: Mapping[str, float]) -> T:
    """The model at constant values of its inputs: those of ``held`` by their names, the others, behind its own parameters, as
    parameters without value.
    """
    parameters = MappingProxyType(dict.fromkeys([*model.parameters, *model.input_names]))
    other = _with_fields(model, p=ca.vertcat(model.p, model.u), parameters=parameters, **NO_INPUT_FIELDS)
    return other.bind(held, partly=True) if held else other


def inputs_as_parameters(model: T) -> T:
    """The model with its inputs as further parameters without name, behind its own."""
    return _with_fields(model, p=ca.vertcat(model.p, model.u), **NO_INPUT_FIELDS) if model.u.numel() else model


def block_input_entries(model: Any) -> np.ndarray:
    """The entries of the inputs that blocks set, or that a PWM has whose duty they hold."""
    owners = [signal for name, signal in model.inputs.items() for _ in model.input_groups[name]]
    return np.array([i for i, signal in enumerate(owners) if isinstance(signal, HeldSignal) or (signal and signal.moving)], int)


def initial_inputs(model: Any, x: np.ndarray | None = None) -> np.ndarray:
    """u(0+) (nu,) where the state is ``x``, else the model's start; 0 where nothing drives it yet."""
    first = [
        signal.limits(np.zeros(2), 0)[0][0] if isinstance(signal, Signal) else np.zeros(len(model.input_groups[name]))
        for name, signal in model.inputs.items()
    ]
    u = np.concatenate([np.zeros(0), *first])
    ticks = None if model.p.numel() else model_ticks(model)
    if ticks is None:
        return u
    x = np.array(ca.DM(model.start)).ravel() if x is None else x
    u = _set_pulses(model, ticks.before(x, u))
    return _set_pulses(model, ticks.start(x, u))


def _set_pulses(model: Any, u: np.ndarray) -> np.ndarray:
    """U at t = 0 with the PWMs whose duty it holds."""
    at, ticks = 0, not_none(model_ticks(model))
    for signal, names in zip(model.inputs.values(), model.input_groups.values(), strict=True):
        if signal is not None and signal.moving:
            u[at : at + len(names)] = signal.holding(ticks.kept(u)).after(np.zeros(1))[0]
        at += len(names)
    return u


def _with_fields(model: T, **fields: Any) -> T:
    other = copy(model)
    for name, value in fields.items():
        object.__setattr__(other, name, value)
    return other


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
    symbols = {state: ca.SX.sym(start_name(state)) for state in states}
    other = with_start(model, symbols)
    names = dict.fromkeys(start_name(state) for state in states)
    other._set(p=ca.vertcat(model.p, *symbols.values()), parameters=MappingProxyType({**model.parameters, **names}))
    return other


def with_symbols(model: M, values: Mapping[str, float], kept: Sequence[str]) -> M:
    """The model with these values of its parameters, but for those that are ``kept``, which stay symbols."""
    other = model.__copy__()
    other._set(parameters=MappingProxyType(dict.fromkeys(model.parameters)))
    return other.bind({name: values[name] for name in model.parameters if name not in kept}, partly=True)


def with_start(model: M, starts: Mapping[str, Any]) -> M:
    """The model with other starts, numbers or symbols, of these states.

    Raises:
        UsageError: what the model does not start from.
    """
    known = start_entries(model)
    fields: dict[str, ca.SX] = {}
    for state, value in starts.items():
        if state not in known:
            available = f"there are {', '.join(known)}" if known else f"{type(model).__name__} has its start in its own arguments"
            raise UsageError(f"start: '{state}' is not a state; {available}" + did_you_mean(state, known))
        field, entry = known[state]
        fields.setdefault(field, ca.SX(getattr(model, field)))[entry] = value
    other = model.__copy__()
    other._set(**fields)
    return other
