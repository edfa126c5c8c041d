"""Recurrences of Taylor coefficients: order k of an operation from orders 0, ..., k of what it is applied to.

A row holds the coefficients c_0, c_1, ... of one scalar function of time about the start of a piece. The recurrences are those of
automatic differentiation (Jorba and Zou, Experimental Mathematics 14, 2005, Proposition 2.1): with D = t d/dt, (D c)_k = k c_k,
a differential equation of the function, such as D exp(u) = exp(u) D u, gives c_k by a convolution. The same stand in `series.c`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

Row = np.ndarray
TWO_OVER_ROOT_PI = 2 / math.sqrt(math.pi)


def product(y: Row, a: Row, b: Row, k: int) -> None:
    """y = a b."""
    y[k] = a[: k + 1] @ b[k::-1]


def square(y: Row, a: Row, k: int) -> None:
    """y = a^2."""
    y[k] = a[: k + 1] @ a[k::-1]


def quotient(y: Row, a: Row, b: Row, k: int) -> None:
    """y = a / b, from y b = a."""
    y[k] = (a[k] - y[:k] @ b[k:0:-1]) / b[0]


def root(y: Row, a: Row, k: int) -> None:
    """y = sqrt(a), from y^2 = a; y_0 is given."""
    y[k] = (a[k] - y[1:k] @ y[k - 1 : 0 : -1]) / (2 * y[0])


def power(y: Row, a: Row, p: float, k: int) -> None:
    """y = a^p, from a D y = p y D a; y_0 is given, a_0 != 0."""
    j = np.arange(k)
    y[k] = ((p * (k - j) - j) * a[k:0:-1]) @ y[:k] / (k * a[0])


def along(y: Row, factor: Row, a: Row, k: int, sign: float = 1.0) -> None:
    """D y = sign factor D a: exp, sin and cos, sinh and cosh, tan, tanh, erf with their own factors; y_0 is given."""
    y[k] = sign * (np.arange(1, k + 1) * a[1 : k + 1]) @ factor[k - 1 :: -1][:k] / k


def against(y: Row, divisor: Row, a: Row, k: int, sign: float = 1.0) -> None:
    """divisor D y = sign D a: log and the inverse functions; y_0 is given."""
    y[k] = (sign * a[k] - (np.arange(1, k) * y[1:k]) @ divisor[k - 1 : 0 : -1] / k) / divisor[0]


def angle(y: Row, a: Row, b: Row, size: Row, k: int) -> None:
    """y = atan2(a, b), from (a^2 + b^2) D y = b D a - a D b; ``size`` is a^2 + b^2, y_0 is given."""
    j = np.arange(1, k + 1)
    turned = ((j * a[1 : k + 1]) @ b[k - 1 :: -1][:k] - (j * b[1 : k + 1]) @ a[k - 1 :: -1][:k]) / k
    y[k] = (turned - (np.arange(1, k) * y[1:k]) @ size[k - 1 : 0 : -1] / k) / size[0]


# What a function is at order 0.
STARTS: dict[str, Callable[..., float]] = {
    name: getattr(math, name)
    for name in "acos acosh asin asinh atan atan2 atanh cos cosh erf exp expm1 hypot log log1p pow sin sinh sqrt tan tanh".split()
}
