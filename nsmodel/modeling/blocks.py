"""Blocks as a model has them: what they keep are inputs of it, each block the expressions that its ticks set these to.

What blocks set, from what they read.

What a block holds is an input that the block sets, in C and event-driven too: rows, checkpoints and pictures know memory as
inputs. Blocks that act after each step are switching functions in continuous time (`ContinuousProblem.updates`), whose branches
end pieces.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from nsmodel._utils import cached_per_object, short_repr
from nsmodel.errors import BlockError, ModelError
from nsmodel.modeling.block import Block
from nsmodel.modeling.conversion import Converter, DeclaredSymbols, declare, names_read
from nsmodel.modeling.pickling import Picklable
from nsmodel.modeling.signals.base import NEAR_TOLERANCE, Signal, just_before, period_numbers
from nsmodel.modeling.signals.pwm import HeldSignal, Pwm
from nsmodel.proof.verdict import attach_buffers


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
        last = max(np.ceil((t_end - self.offset) / self.period), -1.0)
        found = self.offset + period_numbers(0.0, last, self.period) * self.period
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


def has_held_duty(signal: Any, parameters: Collection[str]) -> bool:
    """Whether a signal is a PWM whose duty is an expression, of what blocks hold, and not of these parameters alone."""
    return isinstance(signal, Pwm) and not isinstance(signal.duty, Signal) and not names_read(signal.duty) <= {*parameters}


def latched_pwm(name: str, signal: Pwm, place: int, duty: ca.SX) -> tuple[Pwm, ModelBlock]:
    """A PWM with the duty that its periods begin with, and the block that keeps that."""
    if other := next((number[1:] for number in signal.expressions if number != ".duty"), None):
        raise ModelError(f"input '{name}': its duty changes in the run, and its {other} is an expression; give {other}= a number")
    own, offset = f"{name}.duty", signal.phase % signal.period
    clipped = ca.fmin(ca.fmax(duty, 0), 1)
    block = ModelBlock(own, signal.period, offset, (place,), clipped, clipped, latch=True)
    return replace(signal, duty=HeldSignal(np.zeros(1), own, own)), block


class BlockTicks:
    """The blocks of a bound model.

    Attributes:
        blocks: of the model; at: the entries of its inputs that they set; states, multipliers: how many of these they read.
        reads: whether a block reads multipliers.
        each_step: numbers of those that act after each step.
    """

    def __init__(self, model: Any) -> None:
        self.blocks: tuple[ModelBlock, ...] = model.blocks
        self.states, self.multipliers = model.state.numel(), getattr(model, "lam", ca.SX(0, 1)).numel()
        self.at = np.array([place for block in self.blocks for place in block.at], int)
        self.each_step = tuple(i for i, block in enumerate(self.blocks) if block.period is None)
        ends = np.cumsum([0, *(len(names) for names in model.input_groups.values())])
        own = {name: slice(ends[i], ends[i + 1]) for i, name in enumerate(model.input_groups)}
        self._own = {name: at for name, at in own.items() if at.start in self.at}
        self._names = model.input_names
        few = {name: getattr(signal, "few", None) for name, signal in model.inputs.items()}
        self._few = [(self._own[name], values) for name, values in few.items() if values]
        l = getattr(model, "lam", ca.SX(0, 1))
        self._t, self._x, self._l, self._u = (np.zeros(size) for size in (1, model.state.numel(), l.numel(), model.u.numel()))
        given = [model.t, model.state, l, model.u]
        self.reads = any(bool(l.numel()) and ca.depends_on(block.next, l) for block in self.blocks)
        self._next = [self._attached_function(given, block.next) for block in self.blocks]
        self._start = [self._attached_function(given, block.start) for block in self.blocks]

    def _attached_function(self, given: list[ca.SX], column: ca.SX) -> tuple[Any, Callable[[], None], np.ndarray]:
        out = np.zeros(column.numel())
        buffer, call = attach_buffers(
            ca.Function("tick", given, [ca.densify(column)]), [self._t, self._x, self._l, self._u], [out]
        )
        return buffer, call, out

    def kept(self, u: np.ndarray) -> Mapping[str, np.ndarray]:
        """What blocks hold, by name, among the inputs (nu,)."""
        return {name: u[at] for name, at in self._own.items()}

    def tick_rows(self, t: np.ndarray) -> list[np.ndarray]:
        """Of each block the ticks before the last of these times, as numbers of the times that they are one with."""
        return [np.searchsorted(t, just_before(block.ticks(float(t[-1])))) for block in self.blocks]

    def due_blocks(self, t: float) -> list[int]:
        """The blocks that tick at a time."""
        return [i for i, block in enumerate(self.blocks) if block.has_tick_at(t)]

    def before(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """U (nu,) at the start with what blocks hold before their first ticks; ``u``: of signals."""
        self._x[:], self._l[:], self._t[0], self._u[:] = x, 0.0, 0.0, u
        for _ in range(2):  # Outputs may be expressions of memory.
            for block, (_, call, out) in zip(self.blocks, self._start, strict=True):
                call()
                self._u[list(block.at)] = out
        self._check_allowed_values(0.0, self._u)
        return self._u.copy()

    def start(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """U (nu,) at t = 0 with what blocks hold after their ticks there; ``u``: of signals."""
        u = self.before(x, u)
        return self.after([*self.due_blocks(0.0), *self.each_step], 0.0, x, np.zeros(self.multipliers), u)

    def after(self, due: Sequence[int], t: float, x: np.ndarray, l: np.ndarray, u: np.ndarray) -> np.ndarray:
        """U (nu,) after the ticks of these blocks at t; latches follow the others.

        Raises:
            BlockError: a value that is not finite, or none of those that the block says it takes, by the name of the symbol.
        """
        for latches in (False, True):
            self._t[0], self._x[:], self._u[:] = t, x, u
            if self.reads:
                self._l[:] = l
            for i in due:
                block, (_, call, out) = self.blocks[i], self._next[i]
                if block.latch is latches:
                    call()
                    u[list(block.at)] = out
                    self._check_finite(block, t, out)
        self._check_allowed_values(t, u)
        return u

    def _check_finite(self, block: ModelBlock, t: float, values: np.ndarray) -> None:
        if np.isfinite(values).all():
            return
        i = int(np.flatnonzero(~np.isfinite(values))[0])
        raise BlockError(f"block '{block.name}' sets {self._names[block.at[i]]} = {values[i]:g} at t = {t:.10g}")

    def _check_allowed_values(self, t: float, u: np.ndarray) -> None:
        """Refuse a value that is none of ``values=``: matrices are kept, and a model is checked, for those alone."""
        for at, few in self._few:
            for i in range(at.start, at.stop):
                if u[i] not in few:
                    raise BlockError(
                        f"{self._names[i]} = {u[i]:g} at t = {t:.10g}: its block has values={few}; name all that it takes there"
                    )


@cached_per_object
def model_ticks(model: Any) -> BlockTicks | None:
    """The blocks of a model that has some."""
    return BlockTicks(model) if model.blocks else None
