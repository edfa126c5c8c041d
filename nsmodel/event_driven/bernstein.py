"""The first root of a polynomial on [0, 1]: subdivided in the Bernstein basis until it is isolated, or there is proved none.

The coefficients in the Bernstein basis of [lo, hi] enclose the values there, and the number of roots is that of their changes of
sign, less an even number (Farouki and Rajan, Computer Aided Geometric Design 4, 1987). Halving is de Casteljau's algorithm.

The first coefficients of a polynomial, its germ at 0: which of them is the first that is not rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cache, reduce
from itertools import pairwise
from math import comb
from typing import Any

from nsmodel._utils import sum_in_order

GERM = 1e-9  # Coefficients below this share of the largest are rounding: more hides slow motion, less makes motion of it.
ORDERS = 6  # Highest order of a germ, whose coefficients decide signs just after now; modes that part later are not decided.
HALF_ORDERS = 3  # ORDERS/2: coefficients of higher orders are not to exceed those up to it, by choice of the unit of time.
PACES = 8  # Iterations of that unit of time, at most: each but the last halves it, or more,
HALVED = 0.5  # until one changes it by no smaller factor: later ones change it less.
GERM_DIFFERENCE = 1e-7  # Of their size: coefficients of two modes that differ. More takes modes that part slowly for one.
NO_ERRORS = (0.0,) * (ORDERS + 1)  # Of the coefficients of a germ: exact ones.
NONE = 2.0  # Stands for a root in [0, 1] where there is none: any number above 1.
NARROW = 1e-13  # Two roots that are as near as this are one: 450 EPS, after 44 halvings of [0, 1]. (+)
ITERATIONS = 80  # Of Newton's method for a root, at most: in as many halving alone comes to EXACT of a root at 2^-50.
EXACT = 1e-9  # Of [0, 1]: a step of it after which the next would be rounding, as it squares the error: to 1e-18.


def poly_value(c: list[float], s: float) -> float:
    """c(s) by Horner's rule."""
    return _generated_evaluator(len(c), "value")(c, s)


def poly_slope(c: list[float], s: float) -> float:
    """The derivative of the polynomial at s."""
    return _generated_evaluator(len(c), "slope")(c, s)


def poly_values(rows: Sequence[list[float]], s: float) -> list[float]:
    """``value`` of each of rows of one length."""
    of = _generated_evaluator(len(rows[0]), "value") if rows else poly_value
    return [of(c, s) for c in rows]


def poly_slopes(rows: Sequence[list[float]], s: float) -> list[float]:
    """``slope`` of each of rows of one length."""
    of = _generated_evaluator(len(rows[0]), "slope") if rows else poly_slope
    return [of(c, s) for c in rows]


def taylor_shift(c: Sequence[Any], s: Any) -> list[Any]:
    """The coefficients about s (Ruffini and Horner), of numbers or of what adds and multiplies like them."""
    c = list(c)
    for first in range(len(c) - 1):
        for k in range(len(c) - 2, first - 1, -1):
            c[k] = c[k] + c[k + 1] * s
    return c


def first_root(c: list[float]) -> float:
    """Return the first root in (0, 1] of sum c_k s^k, c_0 >= 0; NONE where it is positive on (0, 1]."""
    if c[0] > sum_in_order(map(abs, c[1:])):
        return NONE
    n = len(c) - 1
    b = _generated_evaluator(n + 1, "bernstein")(c)
    return NONE if min(b) > 0 else _first_root_between(c, b, 0.0, 1.0)


@cache
def _generated_evaluator(count: int, what: str) -> Callable[..., Any]:
    """Of so many coefficients, written out: value and slope at s by Horner's rule; b_j = sum_k comb(j, k)/comb(n, k) c_k."""
    n = count - 1
    if what == "bernstein":
        sums = (" + ".join(f"{comb(j, k) / comb(n, k)!r}*c{k}" for k in range(j + 1)) for j in range(count))
        text = f"[{', '.join(sums)}]"
    else:
        terms = [f"c{k}" for k in range(count)] if what == "value" else [f"{k}*c{k}" for k in range(1, count)]
        text = reduce(lambda total, term: f"({total})*s + {term}", reversed(terms or ["0.0"]))
    made: dict[str, Any] = {}
    exec(f"def of(c, s=0.0):\n    [{', '.join(f'c{k}' for k in range(count))}] = c\n    return {text}", made)
    return made["of"]


def _first_root_between(c: list[float], b: list[float], low: float, width: float) -> float:
    if b[0] <= 0 and low > 0:
        return low
    signs = [v > 0 for v in b if v != 0]
    changes = sum(a != z for a, z in pairwise(signs)) + (b[0] == 0 and signs[:1] == [False])
    if not signs or changes == 0:
        return low + width if b[-1] == 0 else NONE
    if changes == 1 and b[0] > 0 and b[-1] <= 0:
        return low + width if b[-1] == 0 else simple_root(c, low, low + width, low + width * _polygon_crossing(b))
    if width < NARROW:
        return low
    left, right = _de_casteljau_halves(b)
    s = _first_root_between(c, left, low, width / 2)
    return s if s <= 1 else _first_root_between(c, right, low + width / 2, width / 2)


def _de_casteljau_halves(b: list[float]) -> tuple[list[float], list[float]]:
    left, right = [], list(b)
    for j in range(len(b)):
        left.append(right[0])
        for k in range(len(b) - 1 - j):
            right[k] = (right[k] + right[k + 1]) / 2
    return left, right


def _polygon_crossing(b: list[float]) -> float:
    """Where the polygon of the coefficients is 0, the share of their interval: near the root."""
    j = next(j for j, v in enumerate(b) if v < 0)
    return (j - 1 + b[j - 1] / (b[j - 1] - b[j])) / (len(b) - 1)


def simple_root(c: list[float], low: float, high: float, s: float) -> float:
    """The root between c(low) > 0 > c(high): Newton's method from s, kept inside by halving."""
    for _ in range(ITERATIONS):
        v, d = poly_value(c, s), poly_slope(c, s)
        if v == 0:
            return s
        low, high = (s, high) if v > 0 else (low, s)
        new = s - v / d if d else low
        if not low < new < high:
            new = (low + high) / 2
        if abs(new - s) <= EXACT * high:
            return new
        s = new
    return s


def without_rounding(c: Sequence[float], known: Sequence[float]) -> list[float]:
    """Coefficients, 0 where they are below what they are known to; of the orders of which that is said."""
    return [0.0 if abs(v) <= least else v for v, least in zip(c, known, strict=False)]


def shrink_time_share(c: list[float], so_far: float, share: float) -> float:
    """A share of the unit of time in which the later half of orders is not larger than the first, or than ``so_far``."""
    for _ in range(PACES):
        own = [abs(a) * share**k for k, a in enumerate(c[1 : ORDERS + 1], 1)]
        largest = max(so_far, *own[:HALF_ORDERS])
        factor = min(
            [(largest / a) ** (1 / k) for k, a in enumerate(own[HALF_ORDERS:], HALF_ORDERS + 1) if a > largest > 0], default=1
        )
        share *= factor
        if factor > HALVED:
            break
    return share


def leading_order(c: list[float], least: float, share: float, known: Sequence[float] = ()) -> int | None:
    """The order of the first coefficient that is not rounding, of those that decide a germ; None where all of them are.

    ``known``: what each coefficient is known to; ``share``: of the unit of time, see `germ_time_share`; where the condition
    itself needs a shorter one, and is no rounding in it, that.
    """
    if known:
        return lowest_order(c, least, known)
    if len(c) > HALF_ORDERS + 1 and max(map(abs, c[HALF_ORDERS + 1 : ORDERS + 1])) > max(map(abs, c[: HALF_ORDERS + 1])):
        own = shrink_time_share(c, abs(c[0]), share)
        if max(abs(a) * own**k for k, a in enumerate(c[: HALF_ORDERS + 1])) > least:
            share = own
    decide = c[: ORDERS + 1] if share == 1 else [a * share**k for k, a in enumerate(c[: ORDERS + 1])]
    least = max(least, GERM * max(map(abs, decide)))
    return next((k for k, a in enumerate(decide) if abs(a) > least), None)


def lowest_order(c: list[float], least: float, known: Sequence[float] = ()) -> int | None:
    """The same by rounding alone: the first order above ``least`` in a unit of time in which later ones are no larger."""
    decide = without_rounding(c, known) if known else c[: ORDERS + 1]
    return next((k for k, a in enumerate(decide) if a and abs(a) * dominant_time_share(decide, k) ** k > least), None)


def dominant_time_share(c: list[float], k: int) -> float:
    """The share of the unit of time, 1 at most, in which no later coefficient is larger than that of order k."""
    size = abs(c[k])
    return min([(size / abs(b)) ** (1 / (j - k)) for j, b in enumerate(c[k + 1 :], k + 1) if abs(b) > size], default=1.0)


def germs_differ(
    a: Sequence[float],
    b: Sequence[float],
    share: float,
    least: float,
    errors: Iterable[float] = NO_ERRORS,
) -> bool:
    """Whether two germs are not the same, in a share of the unit of time; ``errors``: what each order of them errs by."""
    size = max(abs(v) * share**k for row in (a, b) for k, v in enumerate(row))
    difference = max((abs(p - q) - error) * share**k for k, (p, q, error) in enumerate(zip(a, b, errors, strict=True)))
    return bool(difference > GERM_DIFFERENCE * size + least)
