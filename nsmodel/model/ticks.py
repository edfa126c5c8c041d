"""What blocks set, from what they read."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.errors import BlockError
from nsmodel.model.blocks import ModelBlock
from nsmodel.once import cached_per_object
from nsmodel.proof.buffered import attach_buffers
from nsmodel.signals.signal import just_before


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
