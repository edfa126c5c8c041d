"""Values that grow like t^p (log t)^l at infinity, between two factors."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import numpy as np

from nsmodel.proof import interval_arithmetic as arithmetic
from nsmodel.proof.interval_arithmetic import Pair
from nsmodel.proof.interval_functions import constant_power
from nsmodel.proof.interval_library import log

FAST = 4  # A power of t above those of polynomials that matter here.
MOST = 60  # Orders beyond this, and factors of exponentials, are not followed.
ROUNDED = 1e-11  # T^p with p rounded to a double is off by less than |p| 2^-53 log T.


class Asymptotic(NamedTuple):
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


ZERO = Asymptotic(Fraction(0), Fraction(0), 0.0, 0.0)


def constant(low: float, high: float | None = None) -> Asymptotic:
    """A value between two numbers."""
    return Asymptotic(Fraction(0), Fraction(0), low, low if high is None else high)


def pair(value: Asymptotic) -> Pair:
    """The interval of c."""
    return np.array([value.low]), np.array([value.high])


def order_of(p: Fraction, l: Fraction, ends: Pair) -> Asymptotic | None:
    """The order with c between two ends; None where powers are too high to be followed."""
    low, high = float(ends[0][0]), float(ends[1][0])
    if max(abs(p), abs(l)) > MOST:
        return None
    return ZERO if low == high == 0 else Asymptotic(p, l, low, high)


def _share(p: Fraction, l: Fraction, k: int) -> Pair | None:
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
    return np.zeros(1), arithmetic.above(arithmetic.mul(power, factor)[1], ROUNDED)


@np.errstate(all="ignore")
def natural(value: Asymptotic, k: int) -> Pair:
    """The interval of the values themselves."""
    share = _share(value.p, value.l, k)
    if share is not None:
        return arithmetic.mul(pair(value), share)
    inverse = _share(-value.p, -value.l, k)
    if inverse is None:
        return (np.array([0.0 if value.low >= 0 else -np.inf]), np.array([0.0 if value.high <= 0 else np.inf]))
    least = arithmetic.inv(inverse)[0]
    return arithmetic.mul(pair(value), (np.maximum(least, 0.0), np.array([np.inf])))


@np.errstate(all="ignore")
def plus(a: Asymptotic | None, b: Asymptotic | None, k: int) -> Asymptotic | None:
    """a + b."""
    both = together(a, b, k)
    return both and order_of(both[0], both[1], arithmetic.add(both[2], both[3]))


@np.errstate(all="ignore")
def times(a: Asymptotic | None, b: Asymptotic | None) -> Asymptotic | None:
    """a b."""
    if a is None or b is None:
        return None
    return order_of(a.p + b.p, a.l + b.l, arithmetic.mul(pair(a), pair(b)))


def together(a: Asymptotic | None, b: Asymptotic | None, k: int) -> tuple[Fraction, Fraction, Pair, Pair] | None:
    """Both with one order, the larger one."""
    if a is None or b is None:
        return None
    if a == ZERO or b == ZERO:
        large = b if a == ZERO else a
        return large.p, large.l, pair(a), pair(b)
    large = max(a, b, key=lambda value: value.rate)
    parts = []
    for value in (a, b):
        share = _share(value.p - large.p, value.l - large.l, k)
        if share is None:
            return None
        parts.append(arithmetic.mul(pair(value), share))
    return large.p, large.l, parts[0], parts[1]
