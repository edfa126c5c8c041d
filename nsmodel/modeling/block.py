"""What a block is, as a user writes it: what it keeps, what it sets, and when."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nsmodel._utils import checks_keywords, short_repr
from nsmodel.errors import ModelError
from nsmodel.modeling.pickling import Picklable


@dataclass(frozen=True, eq=False)
class Block(Picklable):
    """Symbols that are held between ticks; see `sampled` and `each_step`.

    Attributes:
        name: in messages.
        period, offset: ticks are at offset + k period; period None: the start, and the end of each step.
        memory: {symbol: value at the start}; update: {symbol: expression of its next value}.
        outputs: {symbol: expression that a tick sets it to}; start: {symbol: its value before the first tick}.
        values: {symbol: the few values that it takes}.
    """

    name: str
    period: float | None
    offset: float
    memory: Mapping[Any, Any]
    outputs: Mapping[Any, Any]
    update: Mapping[Any, Any]
    start: Mapping[Any, Any]
    values: Mapping[Any, Sequence[float]]

    __repr__ = short_repr


@checks_keywords
def sampled(
    name: str,
    *,
    period: float,
    offset: float = 0.0,
    memory: Mapping[Any, Any] | None = None,
    outputs: Mapping[Any, Any] | None = None,
    update: Mapping[Any, Any] | None = None,
    start: Mapping[Any, Any] | None = None,
    values: Mapping[Any, Sequence[float]] | None = None,
) -> Block:
    """A block that acts at t = offset, offset + period, ...: no step goes over a tick.

    At a tick it reads the state, the multipliers of the step that ends there, inputs as they are after it, its memory and what
    blocks hold; then its outputs and its memory get their next values, all from what they were before. Blocks that tick at one
    time all read before any of them writes. Between ticks all of it is held.

    Args:
        name: in messages.
        period, offset: times, > 0 and >= 0; the tick at t = 0 comes before the first step.
        memory: {symbol: value at the start}, a number or an expression of parameters.
        outputs: {symbol: expression of t, the state, multipliers, inputs, memory, what blocks hold, parameters}.
        update: {symbol of the memory: expression of the same}; what is left out stays as it is.
        start: {output: value before the first tick}; left out: the output as it would be at t = 0.
        values: {output or memory: the few values that it takes}, where it multiplies unknowns: matrices are kept for each.

    Raises:
        ModelError: a period that is not > 0, an offset < 0; names and shapes once a model is declared.
    """
    if not (_is_time(period) and period > 0):
        raise ModelError(f"block '{name}': period = {period!r:.60}; expected a time > 0")
    if not (_is_time(offset) and offset >= 0):
        raise ModelError(f"block '{name}': offset = {offset!r:.60}; expected a time >= 0")
    return _make_block(name, float(period), float(offset), memory, outputs, update, start, values)


@checks_keywords
def each_step(
    name: str,
    *,
    memory: Mapping[Any, Any],
    update: Mapping[Any, Any],
    values: Mapping[Any, Sequence[float]] | None = None,
) -> Block:
    """A block that acts at the start and after each accepted step, on what the step has led to: late by up to a step.

    In event-driven runs it acts when a condition of its update changes, at that time.

    Args:
        name: in messages.
        memory: {symbol: value before the start}; update: {symbol: expression of its next value}.
        values: {symbol: the few values that it takes}, where it multiplies unknowns: matrices are kept for each.

    Raises:
        ModelError: names and shapes, once a model is declared.
    """
    return _make_block(name, None, 0.0, memory, None, update, None, values)


def _make_block(name: str, period: float | None, offset: float, *parts: Mapping[Any, Any] | None) -> Block:
    labels = ("memory", "outputs", "update", "start", "values")
    for label, part in zip(labels, parts, strict=True):
        if part is not None and not isinstance(part, Mapping):
            raise ModelError(f"block '{name}': {label}: expected a dictionary {{symbol: ...}}, not a {type(part).__name__}")
    return Block(str(name), period, offset, *({} if part is None else part for part in parts))


def _is_time(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool) and bool(np.isfinite(value))
