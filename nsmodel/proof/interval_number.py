"""Intervals with operators, rounded outwards: what is written for numbers runs on them as it stands."""

from __future__ import annotations

from collections.abc import Callable
from typing import Union

import casadi as ca
import numpy as np

from nsmodel.proof import interval_arithmetic as arithmetic
from nsmodel.proof.interval_arithmetic import IntervalPair
from nsmodel.proof.interval_functions import OPERATIONS

Operand = Union["Interval", float, int]


class Interval:
    """An array of intervals [lo, hi]; a number beside it is exact. What is 0 times anything is ZERO itself, at no cost."""

    __slots__ = ("hi", "lo")
    __hash__ = None  # pyright: ignore[reportAssignmentType]

    def __init__(self, lo: np.ndarray, hi: np.ndarray) -> None:
        self.lo, self.hi = lo, hi

    @property
    def magnitude(self) -> np.ndarray:
        """The largest absolute value; inf where there is no bound."""
        size = np.maximum(np.abs(self.lo), np.abs(self.hi))
        return np.where(np.isnan(size), np.inf, size)

    @property
    def middle(self) -> np.ndarray:
        """A number inside, or next to it."""
        return self.lo / 2 + self.hi / 2

    def __neg__(self) -> Interval:
        """Return -x."""
        return Interval(-self.hi, -self.lo)

    def __add__(self, other: Operand) -> Interval:
        """Return x + y."""
        if _is_exact_zero(self):
            return as_interval(other)
        return self if _is_exact_zero(other) else Interval(*arithmetic.add(_as_interval_pair(self), _as_interval_pair(other)))

    __radd__ = __add__

    def __sub__(self, other: Operand) -> Interval:
        """Return x - y."""
        return self if _is_exact_zero(other) else Interval(*arithmetic.sub(_as_interval_pair(self), _as_interval_pair(other)))

    def __rsub__(self, other: Operand) -> Interval:
        """Return y - x."""
        return -self + other

    def __mul__(self, other: Operand) -> Interval:
        """Return x y."""
        return (
            ZERO_INTERVAL
            if _is_exact_zero(self) or _is_exact_zero(other)
            else Interval(*arithmetic.mul(_as_interval_pair(self), _as_interval_pair(other)))
        )

    __rmul__ = __mul__

    def __truediv__(self, other: Operand) -> Interval:
        """Return x / y."""
        return Interval(*arithmetic.div(_as_interval_pair(self), _as_interval_pair(other)))

    def __rtruediv__(self, other: Operand) -> Interval:
        """Return y / x."""
        return (
            ZERO_INTERVAL
            if _is_exact_zero(other)
            else Interval(*arithmetic.div(_as_interval_pair(other), _as_interval_pair(self)))
        )

    def __eq__(self, other: object) -> np.ndarray:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Where it is this number and no other."""
        return (self.lo == other) & (self.hi == other)

    def __ne__(self, other: object) -> np.ndarray:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Where it may be another number."""
        return ~(self == other)


ZERO_INTERVAL = Interval(np.zeros(1), np.zeros(1))


def point_intervals(value: np.ndarray) -> Interval:
    """Numbers as intervals."""
    return Interval(value, value)


def as_interval(value: Operand) -> Interval:
    """The value as an interval."""
    if isinstance(value, Interval):
        return value
    return ZERO_INTERVAL if value == 0 else Interval(*arithmetic.point_interval(float(value)))


def interval_where(mask: np.ndarray, a: Operand, b: Operand) -> Interval:
    """``a`` where the mask holds, else ``b``."""
    return Interval(*arithmetic.select_interval(mask, _as_interval_pair(a), _as_interval_pair(b)))


def interval_function(name: str) -> Callable[..., Interval]:
    """An operation of CasADi by its name in small letters, on intervals."""
    bounds = OPERATIONS[getattr(ca, f"OP_{name.upper()}")].bounds

    def evaluate(*args: Operand) -> Interval:
        return Interval(*bounds(*map(_as_interval_pair, args)))

    return evaluate


def _is_exact_zero(value: Operand) -> bool:
    return value is ZERO_INTERVAL or (not isinstance(value, Interval) and value == 0)


def _as_interval_pair(value: Operand) -> IntervalPair:
    return (value.lo, value.hi) if isinstance(value, Interval) else arithmetic.point_interval(float(value))
