"""Values that grow like t^p (log t)^l at infinity, between two factors."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import numpy as np

from nsmodel.proof import interval_arithmetic as arithmetic
from nsmodel.proof.interval_arithmetic import IntervalPair
from nsmodel.proof.interval_functions import constant_power
from nsmodel.proof.interval_library import log

FAST_GROWTH_POWER = 4  # A power of t above those of polynomials that matter here.
MAX_ORDER = 60  # Orders beyond this, and factors of exponentials, are not followed.
ORDER_ROUNDING = 1e-11  # T^p with p rounded to a double is off by less than |p| 2^-53 log T.


class AsymptoticOrder(NamedTuple):
    """t^p (log t)^l c, low <= c <= high, for all t >= T."""

    p: Fraction
    l: Fraction
    low: float
    high: float

    @property
    def rate(self) -> tuple[Fraction | int, Fraction | int]:
        """(p, l): orders compare like these."""
        return self.p, self.l

    @property
    def sign(self) -> int:
        """1 or -1 where the value keeps that sign, else 0."""
        return int(self.low > 0) - int(self.high < 0)


ZERO_ORDER = AsymptoticOrder(Fraction(0), Fraction(0), 0.0, 0.0)


def constant_order(low: float, high: float | None = None) -> AsymptoticOrder:
    """A value between two numbers."""
    return AsymptoticOrder(Fraction(0), Fraction(0), low, low if high is None else high)


def coefficient_interval(value: AsymptoticOrder) -> IntervalPair:
    """The interval of c."""
    return np.array([value.low]), np.array([value.high])


def make_order(p: Fraction, l: Fraction, ends: IntervalPair) -> AsymptoticOrder | None:
    """The order with c between two ends; None where powers are too high to be followed."""
    low, high = float(ends[0][0]), float(ends[1][0])
    if max(abs(p), abs(l)) > MAX_ORDER:
        return None
    return ZERO_ORDER if low == high == 0 else AsymptoticOrder(p, l, low, high)


def _decaying_factor_interval(p: Fraction, l: Fraction, k: int) -> IntervalPair | None:
    """The interval of t^p (log t)^l for t >= 2^k where it is bounded: p < 0, or p = 0 and l <= 0; None where it is not known.

    Its logarithm p s + l log s, s = log t, has the derivative p + l/s, which is not above 0 for s >= s_0 if p s_0 + l <= 0.
    """
    T = np.array([2.0**k])
    s = log((T, T))
    if p > 0 or p * Fraction(float(s[0][0])) + l > 0:
        return None
    if not p and not l:
        return arithmetic.ONE
    power = constant_power((T, T), float(p)) if p else arithmetic.ONE
    factor = constant_power(s, float(l)) if l else arithmetic.ONE
    return np.zeros(1), arithmetic.widen_up(arithmetic.mul(power, factor)[1], ORDER_ROUNDING)


@np.errstate(all="ignore")
def value_interval(value: AsymptoticOrder, k: int) -> IntervalPair:
    """The interval of the values themselves."""
    share = _decaying_factor_interval(value.p, value.l, k)
    if share is not None:
        return arithmetic.mul(coefficient_interval(value), share)
    inverse = _decaying_factor_interval(-value.p, -value.l, k)
    if inverse is None:
        return (np.array([0.0 if value.low >= 0 else -np.inf]), np.array([0.0 if value.high <= 0 else np.inf]))
    least = arithmetic.inv(inverse)[0]
    return arithmetic.mul(coefficient_interval(value), (np.maximum(least, 0.0), np.array([np.inf])))


@np.errstate(all="ignore")
def add_orders(a: AsymptoticOrder | None, b: AsymptoticOrder | None, k: int) -> AsymptoticOrder | None:
    """a + b."""
    both = bring_to_common_order(a, b, k)
    return both and make_order(both[0], both[1], arithmetic.add(both[2], both[3]))


@np.errstate(all="ignore")
def multiply_orders(a: AsymptoticOrder | None, b: AsymptoticOrder | None) -> AsymptoticOrder | None:
    """a b."""
    if a is None or b is None:
        return None
    return make_order(a.p + b.p, a.l + b.l, arithmetic.mul(coefficient_interval(a), coefficient_interval(b)))


def bring_to_common_order(
    a: AsymptoticOrder | None, b: AsymptoticOrder | None, k: int
) -> tuple[Fraction, Fraction, IntervalPair, IntervalPair] | None:
    """Both with one order, the larger one."""
    if a is None or b is None:
        return None
    if a == ZERO_ORDER or b == ZERO_ORDER:
        large = b if a == ZERO_ORDER else a
        return large.p, large.l, coefficient_interval(a), coefficient_interval(b)
    large = max(a, b, key=lambda value: value.rate)
    parts = []
    for value in (a, b):
        share = _decaying_factor_interval(value.p - large.p, value.l - large.l, k)
        if share is None:
            return None
        parts.append(arithmetic.mul(coefficient_interval(value), share))
    return large.p, large.l, parts[0], parts[1]
