"""Recurrences of Taylor coefficients: order k of an operation from orders 0, ..., k of what it is applied to.

A row holds the coefficients c_0, c_1, ... of one scalar function of time about the start of a piece. The recurrences are those of
automatic differentiation (Jorba and Zou, Experimental Mathematics 14, 2005, Proposition 2.1): with D = t d/dt, (D c)_k = k c_k,
a differential equation of the function, such as D exp(u) = exp(u) D u, gives c_k by a convolution. The same stand in `series.c`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from operator import mul

SeriesRow = list[float]
TWO_OVER_ROOT_PI = 2 / math.sqrt(math.pi)


def product(a: SeriesRow, b: SeriesRow, k: int) -> float:
    """y = a b."""
    return sum(map(mul, a[: k + 1], b[k::-1]))


def square(a: SeriesRow, k: int) -> float:
    """y = a^2."""
    return sum(map(mul, a[: k + 1], a[k::-1]))


def quotient(y: SeriesRow, a: SeriesRow, b: SeriesRow, k: int) -> float:
    """y = a / b, from y b = a."""
    return (a[k] - sum(map(mul, y[:k], b[k:0:-1]))) / b[0]


def _quotient_or_zero(above: float, below: float) -> float:
    """A quotient of rows; 0 over 0 is 0: what is 0 throughout stays so. Of symbols and intervals it is any other."""
    return 0.0 if isinstance(above, float) and above == 0 and isinstance(below, float) and below == 0 else above / below


def root(y: SeriesRow, a: SeriesRow, k: int) -> float:
    """y = sqrt(a), from y^2 = a; y_0 is given."""
    above = a[k] - sum(map(mul, y[1:k], y[k - 1 : 0 : -1]))
    return _quotient_or_zero(above, 2 * y[0])


def power(y: SeriesRow, a: SeriesRow, p: float, k: int) -> float:
    """y = a^p, from a D y = p y D a; y_0 is given."""
    if all(isinstance(v, float) and v == 0 for v in a[: k + 1]) and p > 0:
        return 0.0
    return sum((p * (k - j) - j) * a[k - j] * y[j] for j in range(k)) / (k * a[0])


def along(factor: SeriesRow, a: SeriesRow, k: int) -> float:
    """D y = factor D a: exp, sin and cos, sinh and cosh, tan, tanh, erf with their own factors; y_0 is given.

    A factor that is 0 in doubles (exp(-1/u) near u = 0) makes 0 of what overflows.
    """
    if k > 1 and not a[2] and not any(a[3 : k + 1]):  # a is linear in time
        total = a[1] * factor[k - 1]
    else:
        total = sum(map(mul, map(mul, range(1, k + 1), a[1 : k + 1]), factor[k - 1 :: -1]))
    if isinstance(total, float) and total != total:
        total = sum(j * a[j] * factor[k - j] for j in range(1, k + 1) if factor[k - j])
    return total / k


def against(y: SeriesRow, divisor: SeriesRow, sign: float, a: SeriesRow, k: int) -> float:
    """divisor D y = sign D a: log and the inverse functions; y_0 is given."""
    above = sign * a[k] - sum(j * y[j] * divisor[k - j] for j in range(1, k)) / k
    return _quotient_or_zero(above, divisor[0])


def angle(y: SeriesRow, a: SeriesRow, b: SeriesRow, size: SeriesRow, k: int) -> float:
    """y = atan2(a, b), from (a^2 + b^2) D y = b D a - a D b; ``size`` is a^2 + b^2, y_0 is given."""
    rotation = sum(j * (a[j] * b[k - j] - b[j] * a[k - j]) for j in range(1, k + 1))
    return (rotation - sum(j * y[j] * size[k - j] for j in range(1, k))) / k / size[0]


def divided(a: float, b: float) -> float:
    """a / b, infinite where b = 0 alone."""
    try:
        return a / b
    except ZeroDivisionError:
        return math.copysign(math.inf, a) * math.copysign(1.0, b) if a else math.nan


def _nan_outside_domain(function: Callable[..., float]) -> Callable[..., float]:
    """The function, NaN where it has no value: in a branch that is not taken that is no harm."""

    def evaluate(*args: float) -> float:
        try:
            return function(*args)
        except (ValueError, OverflowError, ZeroDivisionError):
            return math.nan

    return evaluate


RECURRENCES: dict[str, Callable[..., float]] = {
    **{f.__name__: f for f in (product, square, along)},
    **{f.__name__: _nan_outside_domain(f) for f in (divided, quotient, root, power, against, angle)},
}
# What a function is at order 0.
ORDER_0_FUNCTIONS: dict[str, Callable[..., float]] = {
    name: _nan_outside_domain(getattr(math, name))
    for name in "acos acosh asin asinh atan atan2 atanh cos cosh erf exp expm1 hypot log log1p pow sin sinh sqrt tan tanh".split()
}
