"""Blocks as a model has them: what they keep are inputs of it, each block the expressions that its ticks set these to."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.blocks.block import Block
from nsmodel.brief import short_repr
from nsmodel.errors import ModelError
from nsmodel.model.convert import Converter, DeclaredSymbols, declare
from nsmodel.pickled import Picklable
from nsmodel.signals.kept import HeldSignal
from nsmodel.signals.pwm import Pwm
from nsmodel.signals.signal import NEAR_TOLERANCE, Signal


@dataclass(frozen=True, eq=False)
class ModelBlock(Picklable):
    """A block in the symbols of a model.

    Attributes:
        name, period, offset: as in `Block`.
        at: which entries of the model's inputs it sets.
        next: what a tick sets them to (k, 1), expressions of t, the state, multipliers and inputs.
        start: what they are before the first tick, of the same; memory first.
        memory: how many of them are memory.
        latch: whether it follows the other blocks at its ticks, as the duty of a PWM does.
    """

    name: str
    period: float | None
    offset: float
    at: tuple[int, ...]
    next: ca.SX
    start: ca.SX
    memory: int = 0
    latch: bool = False

    __repr__ = short_repr

    def in_units(self, tau: float, put: Callable[[ca.SX], ca.SX]) -> ModelBlock:
        """The block where times are tau times as large; ``put`` writes what it reads in those units."""
        period = None if self.period is None else tau * self.period
        return replace(self, period=period, offset=tau * self.offset, next=put(self.next), start=put(self.start))

    def ticks(self, t_end: float) -> np.ndarray:
        """Its ticks before t_end: products, no sums of periods."""
        if self.period is None:
            return np.zeros(0)
        found = self.offset + np.arange(max(np.ceil((t_end - self.offset) / self.period) + 1, 0)) * self.period
        return found[found < t_end]

    def next_tick(self, t: float) -> float:
        """The first tick that is not before a time; infinite where there is none."""
        if self.period is None:
            return np.inf
        k = max(np.ceil((t * (1 - NEAR_TOLERANCE) - self.offset) / self.period), 0)
        return float(self.offset + k * self.period)

    def has_tick_at(self, t: float) -> bool:
        """Whether a tick is one with a time."""
        if self.period is None:
            return False
        k = max(round((t - self.offset) / self.period), 0)
        return abs(self.offset + k * self.period - t) <= NEAR_TOLERANCE * t


@dataclass(frozen=True, eq=False)
class DeclaredBlock:
    """A block whose symbols are declared and whose expressions are not yet."""

    block: Block
    memory: list[tuple[DeclaredSymbols, Any]]
    outputs: list[tuple[DeclaredSymbols, Any]]

    @property
    def symbols(self) -> list[DeclaredSymbols]:
        """All that it sets, memory first."""
        return [symbol for symbol, _ in (*self.memory, *self.outputs)]


def declare_blocks(given: Any) -> list[DeclaredBlock]:
    """The symbols of blocks; ModelError for what is no block, and names that repeat."""
    if isinstance(given, Block):
        given = [given]
    if not isinstance(given, Sequence) or not all(isinstance(block, Block) for block in given):
        raise ModelError("blocks: expected a list of blocks, such as [sampled(...), hysteresis(...)]")
    if len({block.name for block in given}) < len(given):
        names = [block.name for block in given]
        twice = next(name for name in names if names.count(name) > 1)
        raise ModelError(f"blocks: '{twice}' is given twice; give each block a name of its own")
    found = []
    for block in given:
        label = f"block '{block.name}'"
        memory, outputs = (
            [(declare(symbol, label), value) for symbol, value in part.items()] for part in (block.memory, block.outputs)
        )
        if not memory and not outputs:
            raise ModelError(f"{label}: it has neither memory nor outputs; leave it out")
        for symbol, _ in (*memory, *outputs):
            if symbol.stem is None:
                raise ModelError(f"{label}: {', '.join(symbol.names)} have no common name; give each its own entry")
        found.append(DeclaredBlock(block, memory, outputs))
    return found


def held_signals(blocks: Sequence[DeclaredBlock]) -> dict[str, HeldSignal]:
    """What drives the symbols that blocks set: the blocks."""
    found = {}
    for each in blocks:
        label = f"block '{each.block.name}'"
        few = {
            name: _allowed_values(own, f"{label}: values of {name}")
            for name, own in _by_symbol_name(each.block.values, each, "values", label).items()
        }
        for symbol in each.symbols:
            found[str(symbol.stem)] = HeldSignal(
                np.zeros(len(symbol.names)), str(symbol.stem), each.block.name, few.get(symbol.stem)
            )
    return found


def make_model_blocks(
    blocks: Sequence[DeclaredBlock], places: Mapping[str, range], converter: Converter, only: Any
) -> tuple[ModelBlock, ...]:
    """The blocks of a model.

    Args:
        blocks: declared.
        places: {name: which entries of the inputs it is}.
        converter: of their expressions.
        only: refuses expressions of other symbols than blocks read: (expression, label).
    """
    found = []
    for each in blocks:
        block, label = each.block, f"block '{each.block.name}'"
        update, begin = (
            _by_symbol_name(part, each, where, label) for part, where in ((block.update, "update"), (block.start, "start"))
        )

        def column(value: Any, symbol: DeclaredSymbols, what: str, label: str = label) -> ca.SX:
            size, where = len(symbol.names), f"{label}: {what} {symbol.stem}"
            expression = ca.densify(ca.vec(ca.SX(converter.convert(value, where))))
            if expression.numel() == 1 and size > 1:
                expression = ca.repmat(expression, size, 1)
            if expression.numel() != size:
                raise ModelError(f"{where}: {expression.numel()} values; expected {size}")
            only(expression, where)
            return expression

        following = [column(update.get(symbol.stem, symbol.sx), symbol, "the next value of") for symbol, _ in each.memory]
        following += [column(value, symbol, "the value of") for symbol, value in each.outputs]
        starting = [column(value, symbol, "the start of") for symbol, value in each.memory]
        starting += [column(begin.get(symbol.stem, value), symbol, "the start of") for symbol, value in each.outputs]
        at = tuple(place for symbol in each.symbols for place in places[str(symbol.stem)])
        memory = sum(len(symbol.names) for symbol, _ in each.memory)
        tick, start = ca.vertcat(*following), ca.vertcat(*starting)
        found.append(ModelBlock(block.name, block.period, block.offset, at, tick, start, memory))
    return tuple(found)


def _by_symbol_name(part: Mapping[Any, Any], each: DeclaredBlock, where: str, label: str) -> dict[str | None, Any]:
    """A part of a block by the names of its symbols; ModelError for others."""
    own = [symbol for symbol, _ in each.memory] if where == "update" else each.symbols
    own = [symbol for symbol, _ in each.outputs] if where == "start" else own
    found = {}
    for key, value in part.items():
        name = key if isinstance(key, str) else declare(key, label).stem
        if name not in [symbol.stem for symbol in own]:
            kind = {"update": "memory", "start": "outputs"}.get(where, "memory and outputs")
            names = ", ".join(str(symbol.stem) for symbol in own) or "none"
            raise ModelError(f"{label}: {where}: '{name}' is not among its {kind} ({names})")
        found[name] = value
    return found


def _allowed_values(values: Any, label: str) -> tuple[float, ...]:
    try:
        found = tuple(sorted({float(value) for value in values}))
    except (TypeError, ValueError):
        raise ModelError(f"{label}: {values!r:.60}; expected a list of numbers, such as (0, 1)") from None
    if not found or not np.isfinite(found).all():
        raise ModelError(f"{label}: {values!r:.60}; expected finite numbers")
    return found


def has_held_duty(signal: Any) -> bool:
    """Whether a signal is a PWM whose duty is an expression, of what blocks hold."""
    return isinstance(signal, Pwm) and not isinstance(signal.duty, Signal)


def latched_pwm(name: str, signal: Pwm, place: int, duty: ca.SX) -> tuple[Pwm, ModelBlock]:
    """A PWM with the duty that its periods begin with, and the block that keeps that."""
    own, offset = f"{name}.duty", signal.phase % signal.period
    clipped = ca.fmin(ca.fmax(duty, 0), 1)
    block = ModelBlock(own, signal.period, offset, (place,), clipped, clipped, latch=True)
    return replace(signal, duty=HeldSignal(np.zeros(1), own, own)), block
