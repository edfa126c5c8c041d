"""The sign of a polynomial in one variable on an interval, decided exactly: real roots are isolated by Sturm's theorem."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import count, pairwise

import numpy as np

Coefficients = Sequence[Fraction]  # c_0, c_1, ...


def negative_point(p: Coefficients, low: Fraction | None = Fraction(0), high: Fraction | None = None) -> Fraction | None:
    """Return a point of [low, high] (None: infinite) where p < 0, or None: then p >= 0 on the whole interval.

    >>> negative_point([Fraction(1), Fraction(-2)])  # 1 - 2 s on [0, inf)
    Fraction(3, 2)
    >>> negative_point([Fraction(1), Fraction(-2), Fraction(1)]) is None  # (s - 1)^2
    True
    """
    p = _trimmed(p)
    if not p:
        return None
    reach = 1 + max((abs(number / p[-1]) for number in p[:-1]), default=Fraction(0))  # Cauchy: all roots lie within.
    a = -reach if low is None else low
    b = max(reach, a + 1) if high is None else high
    for point in (a, *_between_roots(p, a, b), b):
        if at(p, point) < 0:
            return point
    return None


def at(p: Coefficients, x: Fraction) -> Fraction:
    """The exact value at x."""
    total = Fraction(0)
    for number in reversed(p):
        total = total * x + number
    return total


def derivative(p: Coefficients) -> list[Fraction]:
    """The coefficients of p'."""
    return [k * number for k, number in enumerate(p)][1:]


def minimum(p: Coefficients, low: Fraction | None = Fraction(0), high: Fraction | None = None) -> tuple[float, float]:
    """(least value, where) on [low, high] (None: infinite), in doubles; (-inf, +-inf) where p has no lower bound."""
    p = _trimmed(p)
    if len(p) > 1 and high is None and p[-1] < 0:
        return -np.inf, np.inf
    if len(p) > 1 and low is None and (p[-1] > 0) == (len(p) % 2 == 0):
        return -np.inf, -np.inf
    critical = np.roots([float(number) for number in reversed(derivative(p))]) if len(p) > 2 else np.zeros(0)
    a, b = (-np.inf if low is None else float(low)), (np.inf if high is None else float(high))
    points = [float(root.real) for root in critical if a < root.real < b]
    points += [end for end in (a, b) if np.isfinite(end)] or [0.0]
    values = [float(at(p, Fraction(point))) for point in points]
    best = int(np.argmin(values))
    return values[best], points[best]


def has_root(p: Coefficients, low: Fraction = Fraction(0)) -> bool:
    """Whether p(x) = 0 for some x >= low."""
    p = _trimmed(p)
    if not p or not at(p, low):
        return True
    if len(p) == 1:
        return False
    chain = _sturm(_square_free(p))
    reach = max(low, Fraction(0)) + 1 + max(abs(number / p[-1]) for number in p[:-1])
    return _variations(chain, low) > _variations(chain, reach)


def _trimmed(p: Coefficients) -> list[Fraction]:
    out = list(p)
    while out and not out[-1]:
        out.pop()
    return out


def _remainder(a: list[Fraction], b: list[Fraction]) -> list[Fraction]:
    a = list(a)
    while len(a) >= len(b):
        factor = a[-1] / b[-1]
        for k, number in enumerate(b):
            a[len(a) - len(b) + k] -= factor * number
        a.pop()  # the leading coefficient is now 0
        a = _trimmed(a)
    return a


def _sturm(p: list[Fraction]) -> list[list[Fraction]]:
    """Sturm's chain p, p', and minus the remainders, each up to a factor > 0 that keeps its numbers short."""
    chain = [p, derivative(p)]
    while chain[-1]:
        rest = _remainder(chain[-2], chain[-1])
        scale = abs(rest[-1]) if rest else Fraction(1)
        chain.append([-number / scale for number in rest])
    return chain[:-1]


def _square_free(p: list[Fraction]) -> list[Fraction]:
    """A polynomial with the same roots, all of them simple."""
    common = _sturm(p)[-1]
    quotient, rest = [Fraction(0)] * (len(p) - len(common) + 1), list(p)
    for k in reversed(range(len(quotient))):
        quotient[k] = rest[k + len(common) - 1] / common[-1]
        for j, number in enumerate(common):
            rest[k + j] -= quotient[k] * number
    return quotient


def _variations(chain: list[list[Fraction]], x: Fraction) -> int:
    signs = [value > 0 for value in (at(p, x) for p in chain) if value]
    return sum(one != other for one, other in pairwise(signs))


def _between_roots(p: list[Fraction], a: Fraction, b: Fraction) -> list[Fraction]:
    """Points of (a, b) that, with a and b, meet each gap between two distinct roots in [a, b]."""
    if len(p) < 2 or not a < b:
        return []
    simple = _square_free(p)
    chain, points, left = _sturm(simple), [], [(a, b)]
    while left:
        low, high = left.pop()
        inside = _variations(chain, low) - _variations(chain, high)  # Sturm: roots in (low, high]
        if inside > (1 if at(simple, low) else 0):
            middle = next(m for m in _candidates(low, high) if at(simple, m))
            points.append(middle)
            left += [(low, middle), (middle, high)]
    return sorted(points)


def _candidates(low: Fraction, high: Fraction) -> Iterator[Fraction]:
    """Points inside an interval, more than any polynomial has roots."""
    return (low + (high - low) * Fraction(k + 1, 2 * k + 2 + (k > 0)) for k in count())
