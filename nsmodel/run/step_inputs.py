"""The inputs of steps that are given one by one: what each is given, signals, and what blocks set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nsmodel.errors import ModelError, UsageError
from nsmodel.grid import SAME_STEP_TOLERANCE, input_schedule
from nsmodel.model.driven import initial_inputs
from nsmodel.model.inputs import signals_by_name
from nsmodel.model.ticks import model_ticks
from nsmodel.signals.drive import InputSchedule
from nsmodel.signals.signal import ConstantSignal, just_after, just_before

LOOK_AHEAD_FACTOR = 2.0  # Times as far as steps have come: signals are looked at up to there.


class FreeInput(ConstantSignal):
    """An input whose values each step is given."""

    @property
    def values_taken(self) -> None:
        """Any."""
        return


class StepInputs:
    """Of a bound model whose ``free`` inputs each step is given.

    Attributes:
        free: their names; at: where they are among all inputs; both: u at both ends of a step, as it is at the start.
        ticks: the model's blocks, or None; driven: whether anything but what steps are given moves.
    """

    def __init__(self, model: Any, free: Sequence[str]) -> None:
        self._model, self.free, self.ticks = model, tuple(free), model_ticks(model)
        self._sizes = {name: len(model.input_groups[name]) for name in free}
        entries = [name for name, names in model.input_groups.items() for _ in names]
        self.at = np.flatnonzero(np.isin(entries, self.free))
        moving = [name for name, signal in model.inputs.items() if signal.moving]
        self._unforeseen = np.flatnonzero(np.isin(entries, [*free, *moving]))  # And of those whose jumps no signal tells.
        self.driven = bool(model.blocks) or any(not isinstance(signal, ConstantSignal) for signal in model.inputs.values())
        self.both = np.tile(initial_inputs(model), 2)
        self._drive: InputSchedule | None = None  # The signals up to a time that is looked ahead to.
        self._ahead = 0.0

    def given(self, values: Any) -> np.ndarray:
        """The values of the free inputs, one after the other.

        Raises:
            UsageError: another number of them, or of a name; no finite numbers.
        """
        sizes = self._sizes
        if isinstance(values, Mapping):
            found = signals_by_name(values, sizes)
            for name in sizes:
                if name not in found:
                    raise UsageError(f"input '{name}' has no value in this step; give it, or a signal to the stepper")
            return np.concatenate([np.zeros(0), *(finite_numbers(name, found[name], size) for name, size in sizes.items())])
        return finite_numbers("u", [] if values is None else values, self.at.size, self.free)

    def kept(self, before: np.ndarray) -> dict[str, Any]:
        """What blocks hold, by name, where the inputs are ``before``."""
        kept = {} if self.ticks is None else self.ticks.kept(before)
        return {name: values[0] if values.size == 1 else values.copy() for name, values in kept.items()}

    def next_tick(self, t: float) -> float:
        """The first tick that is not before a time; infinite where there is none."""
        return min((block.next_tick(t) for block in self._model.blocks), default=np.inf)

    def ends(self, k: int, t: float, h: float, begin: np.ndarray, place: tuple[np.ndarray, ...]) -> list[float]:
        """Where the parts of step k end: at the points of signals within it, at edges that blocks place, and at its end."""
        drive = self._signals_until(k, t + h)
        first, last = np.searchsorted(drive.points, [just_after(np.array(t)), just_before(np.array(t + h))])
        ends = [*drive.points[first:last].tolist(), t + h]
        if drive.moving and self.ticks is not None:
            u = self.limits(k, t, ends[0] - t, begin, begin, place)[0][: drive.size]
            return [*drive.holding(self.ticks.kept(u)).within(t, ends[0])[1:].tolist(), *ends[1:]]
        return ends

    def limits(
        self, k: int, t: float, h: float, begin: np.ndarray, end: np.ndarray, place: tuple[np.ndarray, ...]
    ) -> tuple[np.ndarray, bool]:
        """U at the begin of step k, then at its end; whether it begins with a jump.

        Args:
            k, t, h: its number, time and length.
            begin, end: what it is given.
            place: states, multipliers and inputs of the step before.
        """
        both, nu, jumps = self.both.copy(), self.both.size // 2, False
        x, l, before = place
        drive = self._signals_until(k, t + h) if self.driven else None
        if drive is not None:
            both = self._signal_limits(drive, before, k, t, h)
            jumps = any(k in signal.jump_steps for signal in self._model.inputs.values())
            jumps = jumps or bool((np.abs(drive.jumps - t) <= SAME_STEP_TOLERANCE * t).any())
        both[self.at], both[self.at + nu] = begin, end
        if self.ticks is not None:
            u, at = both[:nu].copy(), self.ticks.at
            u[at] = before[at]
            u = self.ticks.after([*self.ticks.due_blocks(t), *self.ticks.each_step], t, x, l, u)
            if drive is not None and drive.moving:
                both = self._signal_limits(drive, u, k, t, h)
                both[self.at], both[self.at + nu] = begin, end
            both[at] = both[at + nu] = u[at]
            jumps = jumps or bool((u[at] != before[at]).any())
        return both, jumps or bool((before[self._unforeseen] != both[self._unforeseen]).any())

    def _signal_limits(self, drive: InputSchedule, u: np.ndarray, k: int, t: float, h: float) -> np.ndarray:
        """U at both ends of step k by signals alone, with what blocks hold in ``u``."""
        now = drive.holding(self.ticks.kept(u)) if drive.moving and self.ticks is not None else drive
        return now.limits(np.array([t, t + h]), k)[0]

    def _signals_until(self, k: int, end: float) -> InputSchedule:
        """The signals up to the end of a step, and ahead where they let; UsageError where one is none up to there."""
        for name, signal in self._model.inputs.items():
            if signal.count is not None and k >= signal.count:
                raise UsageError(f"input '{name}': steps(...) has {signal.count} rows, and this would be step {k + 1}")
        if self._drive is None or end > self._ahead:
            try:
                self._drive, self._ahead = input_schedule(self._model, LOOK_AHEAD_FACTOR * end), LOOK_AHEAD_FACTOR * end
            except ModelError:
                try:
                    self._drive, self._ahead = input_schedule(self._model, end), end
                except ModelError as error:
                    raise UsageError(str(error)) from error
        return self._drive


def finite_numbers(label: str, values: Any, size: int, names: Sequence[str] = ()) -> np.ndarray:
    """Finite numbers (size,); UsageError, naming ``label`` and what they are of, where a user gave something else."""
    if type(values) is float and size == 1 and -np.inf < values < np.inf:
        return np.array([values])
    try:
        found = np.atleast_1d(np.asarray(values, float)).ravel()
    except (TypeError, ValueError):
        raise UsageError(f"{label} = {values!r:.60}; expected numbers") from None
    if found.size != size:
        of = f" ({', '.join(names)})" if names else ""
        raise UsageError(f"{label}: {found.size} values; expected {size}{of}")
    if not np.isfinite(found).all():
        raise UsageError(f"{label} = {found.tolist()}; expected finite numbers")
    return found
