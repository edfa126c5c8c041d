"""What drives a model: the inputs that it is given, and behind them what its blocks set."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Self

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError
from nsmodel.model.arguments import RESERVED_RUN_NAMES
from nsmodel.model.blocks import DeclaredBlock, declare_blocks, has_held_duty, held_signals, latched_pwm, make_model_blocks
from nsmodel.model.convert import Converter, DeclaredSymbols, declare
from nsmodel.model.inputs import declare_inputs, read_signals


@dataclass(frozen=True, eq=False)
class DeclaredInputs:
    """Declared: the symbols of all inputs, what drives each by its name, and the blocks."""

    symbols: Sequence[DeclaredSymbols]
    driven: Mapping[str, Any]
    blocks: Sequence[DeclaredBlock]

    @classmethod
    def of(cls, inputs: Any, blocks: Any, unblocked: str) -> Self:
        """Read what a user gives; ``unblocked``: why the class takes no blocks.

        Raises:
            ModelError: what is no input or no block, a name that is taken.
        """
        u, driven = declare_inputs(inputs)
        found = declare_blocks(blocks)
        duties = [declare(f"{name}.duty", "inputs") for name, signal in driven.items() if has_held_duty(signal)]
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
        return cls((*u, *kept, *duties), signals, found)

    @property
    def u(self) -> ca.SX:
        """The symbols (nu, 1)."""
        return ca.vertcat(ca.SX(0, 1), *(item.sx for item in self.symbols))

    @property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """{name of an input: names of its entries}."""
        return {str(item.stem): item.names for item in self.symbols}

    def fields(self, time: DeclaredSymbols, converter: Converter, only: Callable[[ca.SX, str], None]) -> dict[str, Any]:
        """``inputs`` and ``blocks`` of a model; ``only`` refuses an expression, by its label, of what blocks do not read."""
        groups, driven = self.groups, dict(self.driven)
        ends = np.cumsum([0, *(len(names) for names in groups.values())])
        places = {name: range(ends[i], ends[i + 1]) for i, name in enumerate(groups)}
        blocks = list(make_model_blocks(self.blocks, places, converter, only))
        for name in [name for name, signal in driven.items() if has_held_duty(signal)]:
            label = f"input '{name}': duty"
            duty = ca.densify(ca.SX(converter.convert(driven[name].duty, label)))
            only(duty, label)
            driven[name], latch = latched_pwm(name, driven[name], places[f"{name}.duty"][0], duty)
            driven[f"{name}.duty"] = driven[name].duty
            blocks.append(latch)
        inputs = read_signals(driven, groups, Converter([time]))
        return {"inputs": MappingProxyType(inputs), "blocks": tuple(blocks)}
