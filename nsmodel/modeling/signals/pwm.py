"""Pulse-width modulation: a value that is high for a part of each period.

Values that blocks set as a run goes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from nsmodel._utils import checks_keywords, short_repr
from nsmodel.errors import ModelError
from nsmodel.modeling.signals.base import (
    NEAR_TOLERANCE,
    ConstantSignal,
    Signal,
    Within,
    check_choice,
    constant_bounds,
    just_after,
    just_before,
    period_numbers,
    read_numbers,
)


@dataclass(frozen=True, eq=False)
class HeldSignal(ConstantSignal):
    """The entry of an input that the block ``by`` sets; until a run says what it is, 0."""

    name: str
    by: str
    few: tuple[float, ...] | None = None

    __repr__ = short_repr

    @property
    def values_taken(self) -> int | None:
        """How many values the block says that it takes."""
        return None if self.few is None else len(self.few)

    def within(self, t_end: float) -> Within | None:
        """Between the least and the largest of these, which ticks keep to; jumps are not known."""
        return None if self.few is None else Within(np.full(1, min(self.few)), np.full(1, max(self.few)), None, None)

    def holding(self, kept: Mapping[str, np.ndarray]) -> Signal:
        """What is held now."""
        return ConstantSignal(kept[self.name])


PWM_KINDS = ("trailing", "leading", "centre")
PWM_NUMBERS = ("period", "duty", "phase", "low", "high")


@dataclass(frozen=True, eq=False)
class Pwm(Signal):
    """A signal by pulse-width modulation, see `pwm`."""

    period: Any  # A number, or an expression, as the phase, low and high may be.
    duty: Any  # A signal, or an expression.
    phase: Any
    low: Any
    high: Any
    kind: str

    __repr__ = short_repr

    @property
    def flat(self) -> bool:
        """True: the signal is constant between edges."""
        return True

    @property
    def values_taken(self) -> int:
        """Two values, low and high."""
        return 2

    @property
    def moving(self) -> int:
        """The edges within a period, whose begin is known, where a block says how long pulses are."""
        return {"centre": 2}.get(self.kind, 1) if isinstance(self.duty, HeldSignal) else 0

    def holding(self, kept: Mapping[str, np.ndarray]) -> Signal:
        """The PWM with the duty that is held now."""
        return replace(self, duty=self.duty.holding(kept)) if isinstance(self.duty, HeldSignal) else self

    def in_time(self, tau: float) -> Pwm:
        """With another period and phase, and its duty in that time."""
        duty = self.duty.in_time(tau) if isinstance(self.duty, Signal) else self.duty
        return replace(self, period=tau * self.period, phase=tau * self.phase, duty=duty)

    @property
    def expressions(self) -> dict[str, Any]:
        """Those among the period, the duty, the phase and the two values."""
        given = {"." + name: getattr(self, name) for name in PWM_NUMBERS}
        return {name: value for name, value in given.items() if not isinstance(value, float | Signal)}

    def wrong_number(self) -> tuple[str, str] | None:
        """A period that is not > 0, a constant duty outside [0, 1], a number that is not finite."""
        duty = float(self.duty.values[0]) if isinstance(self.duty, ConstantSignal) else 0.0
        given = {"." + name: getattr(self, name) for name in PWM_NUMBERS} | {".duty": duty}
        for name, value in given.items():
            if isinstance(value, float) and not np.isfinite(value):
                return name, f"{name[1:]} = {value:g}; expected a finite number"
        if isinstance(self.period, float) and not self.period > 0:
            return ".period", f"period = {self.period:g}; expected a time > 0"
        return None if 0 <= duty <= 1 else (".duty", f"duty = {duty:g}; expected a number from 0 to 1")

    def check_valid(self, label: str, t_end: float) -> None:
        """A duty that leaves [0, 1]."""
        self.duty.check_valid(label, t_end)
        t, duty = self._duties(self._periods(t_end))
        for i in np.flatnonzero(~((duty >= 0) & (duty <= 1)))[:1]:
            raise ModelError(f"{label}: its duty is {duty[i]:g} at t = {t[i]:.10g}; expected a number from 0 to 1")

    def _periods(self, t_end: float) -> np.ndarray:
        """The numbers of the periods that meet [0, t_end], and of the one before."""
        first, last = np.floor(-self.phase / self.period) - 1, np.floor((t_end - self.phase) / self.period)
        return period_numbers(first, last, self.period)

    def _duties(self, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """When periods k begin, or the run where that is later, and the duty there."""
        t = np.maximum(self.phase + k * self.period, 0.0)
        return t, self.duty.after(t)[:, 0]

    def _pulses(self, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """When the pulses of periods k begin and end: products, no sums of periods."""
        _, d = self._duties(k)
        begin = {"trailing": 0 * d, "leading": 1 - d, "centre": (1 - d) / 2}[self.kind]
        end = {"trailing": d, "leading": 0 * d + 1, "centre": (1 + d) / 2}[self.kind]
        return self.phase + (k + begin) * self.period, self.phase + (k + end) * self.period

    def pulse(self, t: float) -> np.ndarray:
        """When the pulse of the period of a time begins and ends."""
        return np.concatenate(self._pulses(np.floor((just_after(np.array([t])) - self.phase) / self.period)))

    def edges(self, t_end: float) -> np.ndarray:
        """Where pulses begin and end, not where one ends as the next begins; where periods begin, if blocks place the pulses."""
        if isinstance(self.duty, HeldSignal):
            begins = self.phase + self._periods(t_end) * self.period
            return begins[(begins >= 0) & (begins <= t_end)]
        begin, end = self._pulses(self._periods(t_end))
        real = end > just_after(begin)
        begin, end = begin[real], end[real]
        separate = begin[1:] > just_after(end[:-1])
        found = np.concatenate([begin[:1], begin[1:][separate], end[:-1][separate], end[-1:]])
        return np.sort(found[(found >= 0) & (found <= t_end)])

    def after(self, t: np.ndarray) -> np.ndarray:
        """High within pulses, their begin included."""
        return self._value(just_after(t))

    def before(self, t: np.ndarray) -> np.ndarray:
        """High within pulses, their end included."""
        return self._value(just_before(t))

    def within(self, t_end: float) -> Within | None:
        """Low and high; one of them where no pulse begins or ends."""
        if self.expressions.keys() & {".low", ".high"}:
            return None
        low, high = np.sort([self.low, self.high])
        if self.moving or self.expressions:
            return Within(np.full(1, low), np.full(1, high), None, None)
        first = self.after(np.zeros(1))[0]
        if self.jump(t_end) is None and t_end > 0:
            return constant_bounds(first)
        return Within(np.full(1, low), np.full(1, high), None, first)

    @property
    def numbers(self) -> dict[str, Any]:
        """Low and high; where the duty is a number it too, the period and the phase."""
        found = {".low": self.low, ".high": self.high}
        if isinstance(self.duty, HeldSignal) or (isinstance(self.duty, Signal) and not isinstance(self.duty, ConstantSignal)):
            return found
        duty = float(self.duty.values[0]) if isinstance(self.duty, ConstantSignal) else self.duty
        return {".duty": duty, ".period": self.period, ".phase": self.phase, **found}

    def with_number(self, number: str, value: Any) -> Pwm:
        """With another value of that."""
        if number == ".duty":
            return replace(self, duty=value if is_expression(value) else ConstantSignal(np.array([value])))
        return replace(self, **{number[1:]: value})

    def joint_slopes(self, t: float) -> dict[str, float]:
        """Of phase + (k + part) period, part moving with the duty."""
        found = self._pulse_edge(t)
        if found is None:
            return {}
        k, part, by_duty = found
        return {".duty": by_duty * self.period, ".period": k + part, ".phase": 1.0}

    def held_duty_slope(self, t: float) -> float:
        """That of an edge that is no begin of a period by the duty, which a block holds."""
        found = self._pulse_edge(t)
        return 0.0 if found is None else found[2] * self.period

    def _pulse_edge(self, t: float) -> tuple[float, float, float] | None:
        """The period k, the part of it, and that part's derivative by the duty, of the edge at t."""
        by_duty = {"trailing": (0.0, 1.0), "leading": (-1.0, 0.0), "centre": (-0.5, 0.5)}[self.kind]
        middle = np.floor((t - self.phase) / self.period)
        for k in (middle, middle - 1, middle + 1):
            for edges, slope in zip(self._pulses(np.array([k])), by_duty, strict=True):
                if abs(edges[0] - t) <= 4 * NEAR_TOLERANCE * abs(t):
                    return float(k), float((edges[0] - self.phase) / self.period - k), slope
        return None

    def derivative_slopes(self, t: float) -> dict[str, np.ndarray]:
        """1 by the value that it has."""
        return {".high" if self._is_high(just_after(np.array([t])))[0] else ".low": np.ones((1, 1))}

    def _is_high(self, t: np.ndarray) -> np.ndarray:
        begin, end = self._pulses(np.floor((t - self.phase) / self.period))
        return (t >= begin) & (t < end)

    def _value(self, t: np.ndarray) -> np.ndarray:
        return np.where(self._is_high(t), self.high, self.low)[:, None]


def is_expression(value: Any) -> bool:
    """Whether a value is an expression of CasADi or of SymPy."""
    return isinstance(value, ca.SX | ca.MX) or hasattr(value, "free_symbols")


@checks_keywords
def pwm(period: Any, duty: Any, *, phase: Any = 0.0, low: Any = 0.0, high: Any = 1.0, kind: str = "trailing") -> Pwm:
    """A signal that is ``high`` for the part ``duty`` of each ``period``, and ``low`` for the rest; its edges are exact.

    Each number may be an expression of the model's parameters, such as ``period=1/f``: the signal is made of their values.

    Args:
        period: > 0.
        duty: a number from 0 to 1, or a signal, whose value when a period begins is that of the period. 0 and 1 give no edge. Or
            an expression of what blocks hold, and of all that they read: read when a period begins, after the blocks that tick
            then, and moved into [0, 1]; beside it the other numbers are no expressions.
        phase: when a period begins.
        low, high: the two values.
        kind: where the pulse lies: "trailing" begins with the period (its trailing edge is modulated), "leading" ends with it,
            "centre" lies in the middle.

    Raises:
        ModelError: a period that is not > 0, a duty outside [0, 1]. Of expressions a UsageError, once they have values.
    """
    check_choice("pwm", "kind", kind, PWM_KINDS)
    given = {"period": period, "phase": phase, "low": low, "high": high}
    values = {
        name: value if is_expression(value) else float(read_numbers("pwm", name, value, 0)) for name, value in given.items()
    }
    if isinstance(duty, Signal) and duty.size != 1:
        raise ModelError(f"pwm: duty has {duty.size} values; expected one")
    if isinstance(duty, Signal) and duty.expressions:
        raise ModelError("pwm: duty is a signal in which a number is an expression; give that signal numbers")
    if not isinstance(duty, Signal) and not is_expression(duty):
        duty = ConstantSignal(read_numbers("pwm", "duty", duty, 0).reshape(1))
    found = Pwm(duty=duty, kind=kind, **values)
    if (wrong := found.wrong_number()) is not None:
        raise ModelError(f"pwm: {wrong[1]}")
    return found
