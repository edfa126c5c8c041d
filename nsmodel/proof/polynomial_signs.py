"""The sign of a polynomial in one variable on an interval, decided exactly: its real roots are isolated by FLINT."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise
from math import lcm
from typing import Any

import numpy as np

from nsmodel.proof.exact import round_down

PolynomialCoefficients = Sequence[Fraction]  # c_0, c_1, ...
INITIAL_PRECISION = 64  # Bits to begin with; doubled until every question about a root is decided.


def negative_point(
    p: PolynomialCoefficients, low: Fraction | None = Fraction(0), high: Fraction | None = None
) -> Fraction | None:
    """Return a point of [low, high] (None: infinite) where p < 0, or None: then p >= 0 on the whole interval.

    >>> negative_point([Fraction(1), Fraction(-2)])  # 1 - 2 s on [0, inf)
    Fraction(3, 2)
    >>> negative_point([Fraction(1), Fraction(-2), Fraction(1)]) is None  # (s - 1)^2
    True
    """
    p = _trim_zeros(p)
    if not p:
        return None
    reach = 1 + max((abs(number / p[-1]) for number in p[:-1]), default=Fraction(0))  # Cauchy: all roots lie within.
    a = -reach if low is None else low
    b = max(reach, a + 1) if high is None else high
    for point in (a, *_points_between_roots(p, a, b), b):
        if evaluate_at(p, point) < 0:
            return point
    return None


def evaluate_at(p: PolynomialCoefficients, x: Fraction) -> Fraction:
    """The exact value at x."""
    total = Fraction(0)
    for number in reversed(p):
        total = total * x + number
    return total


def derivative_coefficients(p: PolynomialCoefficients) -> list[Fraction]:
    """The coefficients of p'."""
    return [k * number for k, number in enumerate(p)][1:]


def approximate_minimum(
    p: PolynomialCoefficients, low: Fraction | None = Fraction(0), high: Fraction | None = None
) -> tuple[float, float]:
    """(least value, where) on [low, high] (None: infinite), in doubles; (-inf, +-inf) where p has no lower bound."""
    p = _trim_zeros(p)
    if len(p) > 1 and high is None and p[-1] < 0:
        return -np.inf, np.inf
    if len(p) > 1 and low is None and (p[-1] > 0) == (len(p) % 2 == 0):
        return -np.inf, -np.inf
    critical = np.roots([float(number) for number in reversed(derivative_coefficients(p))]) if len(p) > 2 else np.zeros(0)
    a, b = (-np.inf if low is None else float(low)), (np.inf if high is None else float(high))
    points = [float(root.real) for root in critical if a < root.real < b]
    points += [end for end in (a, b) if np.isfinite(end)] or [0.0]
    values = [float(evaluate_at(p, Fraction(point))) for point in points]
    best = int(np.argmin(values))
    return values[best], points[best]


def polynomial_lower_bound(p: PolynomialCoefficients, low: Fraction | None = Fraction(0), high: Fraction | None = None) -> float:
    """A double that p nowhere falls below on [low, high] (None: infinite), the largest one but for rounding; -inf: no bound."""
    p = _trim_zeros(p)
    if len(p) > 1 and ((high is None and p[-1] < 0) or (low is None and (p[-1] > 0) == (len(p) % 2 == 0))):
        return -np.inf
    values = [evaluate_at(p, end) for end in (low, high) if end is not None] + (
        [evaluate_at(p, Fraction(0))] if low is None and high is None else []
    )
    slope = derivative_coefficients(p)
    for a, b in real_roots(slope, low, high) if any(slope) else []:
        steepest = evaluate_at([abs(number) for number in slope], max(abs(a), abs(b)))
        values.append(evaluate_at(p, a) - steepest * (b - a))
    return round_down(min(values))


def real_roots(
    p: PolynomialCoefficients, low: Fraction | None = None, high: Fraction | None = None
) -> list[tuple[Fraction, Fraction]]:  # fmt: skip
    """Enclosures (from, to) of the distinct real roots of p != 0 in [low, high] (None: infinite), in order, none meeting another.

    A rational root is given as itself.

    >>> [float(a) for a, b in real_roots([Fraction(-1), Fraction(0), Fraction(4)])]
    [-0.5, 0.5]
    """
    from flint import ctx, fmpz_poly

    p = _trim_zeros(p)
    if len(p) < 2:
        return []
    common = lcm(*(number.denominator for number in p))
    whole, ends = fmpz_poly([int(number * common) for number in p]), [end for end in (low, high) if end is not None]
    linear = [factor for factor, _ in whole.factor()[1] if factor.degree() == 1]
    exact, bits, before = {Fraction(-int(factor[0]), int(factor[1])) for factor in linear}, INITIAL_PRECISION, ctx.prec
    try:
        while True:
            ctx.prec = bits
            roots: Any = whole.complex_roots()
            real = [root.real for root, _ in roots if root.imag.is_zero()]
            found = sorted((_fraction_from_ball(root.lower()), _fraction_from_ball(root.upper())) for root in real)
            found = [next(((end, end) for end in exact if a <= end <= b), (a, b)) for a, b in found]
            if all(a == b or not any(a <= end <= b for end in (*ends, *exact)) for a, b in found):
                return [(a, b) for a, b in found if (low is None or a >= low) and (high is None or b <= high)]
            bits *= 2
    finally:
        ctx.prec = before


def _fraction_from_ball(number: Any) -> Fraction:
    """An exact ball of FLINT."""
    mantissa, exponent = (int(part) for part in number.man_exp())
    return Fraction(mantissa) * Fraction(2) ** exponent


def _trim_zeros(p: PolynomialCoefficients) -> list[Fraction]:
    out = list(p)
    while out and not out[-1]:
        out.pop()
    return out


def _points_between_roots(p: list[Fraction], a: Fraction, b: Fraction) -> list[Fraction]:
    """Points of (a, b) that, with a and b, meet each gap between two distinct roots in [a, b]."""
    return [(left[1] + right[0]) / 2 for left, right in pairwise(real_roots(p, a, b))] if a < b else []
