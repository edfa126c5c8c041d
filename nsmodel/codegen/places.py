"""Who sets which entries of a model's inputs in a library: the caller, blocks, or the duty in force of a PWM."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from nsmodel.signals.kept import HeldSignal
from nsmodel.signals.pwm import Pwm


class Pulse(NamedTuple):
    """A PWM whose duty is held: its entry, that of the duty in force, the signal."""

    at: int
    duty: int
    signal: Pwm


@dataclass(frozen=True)
class InputRoles:
    """Entries of the inputs.

    Attributes:
        given: by the caller.
        memory, held: of blocks; held: outputs, then duties in force. They stand behind all others.
        pulses: that the library makes.
    """

    given: tuple[int, ...]
    memory: tuple[int, ...] = ()
    held: tuple[int, ...] = ()
    pulses: tuple[Pulse, ...] = ()

    def names(self, model: Any) -> dict[str, list[str]]:
        """What stands where, by the names of the arrays in C."""
        arrays = {"u": self.given, "z": self.memory, "w": self.held}
        return {name: [model.input_names[i] for i in at] for name, at in arrays.items()}


def input_roles_of(model: Any) -> InputRoles:
    """Those of a model with blocks."""
    first, at = 0, dict[str, int]()
    for name, names in model.input_groups.items():
        at[name], first = first, first + len(names)
    pulses = tuple(
        Pulse(at[name], at[signal.duty.name], signal)
        for name, signal in model.inputs.items()
        if isinstance(signal, Pwm) and isinstance(signal.duty, HeldSignal)
    )
    memory = _concatenate(block.at[: block.memory] for block in model.blocks)
    held = _concatenate(block.at[block.memory :] for block in model.blocks)
    others = {*memory, *held, *(pulse.at for pulse in pulses)}
    return InputRoles(tuple(i for i in range(first) if i not in others), memory, held, pulses)


def _concatenate(parts: Any) -> tuple[int, ...]:
    return tuple(i for part in parts for i in part)
