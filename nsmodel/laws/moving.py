"""Ends of a law that move, by a law whose ends stay.

-y ∈ N_[a, b](l) with a < b is l = c + s l', -y ∈ N_[a', b'](l') with numbers a', b' and the s > 0 that makes one interval of the
other: the normal cone at a point is that at its image. y stays as it is, in its unit and with its sign, so that a row is judged
as it was declared, and what is 0 is exactly 0; where a = b, s = 0 and l = a exactly, whatever y is, of which l' then has the
sign. A ball of radius r is l = r l' with l' in the unit ball. W = W_0 diag(s), of which diag(s) W has the sign of W_0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np


class LawEnds(NamedTuple):
    """The set of row ``name``: [lower, upper], expressions, none where lower > upper; of a ball [0, radius]."""

    name: str
    lower: ca.SX
    upper: ca.SX

    @property
    def has_infinite_end(self) -> bool:
        """Whether one of them is infinite."""
        return any(_is_constant_number(end, value) for end, value in ((self.lower, -np.inf), (self.upper, np.inf)))


class InvalidLawRow(NamedTuple):
    """A row whose law is no set, and why."""

    name: str
    text: str


NEGATION_DEPTH = 32  # Of the graphs in which an end is seen to be the negative of the other.


def fixed_ends(a: ca.SX, b: ca.SX, moving: ca.SX, *, guarded: bool) -> tuple[ca.SX, ca.SX, float, float]:
    """(c, s, a', b') of the interval [a, b], one end at least an expression of ``moving``.

    l' = 0 where l is 0 if [a, b] is [-b, b] or one end is 0: what counts as small beside multipliers (see `solve.certificate`)
    is then what it was. ``guarded``: where b < a for some values s is NaN, and no step passes.
    """
    zero, one = ca.SX(0), ca.SX(1)
    if _is_constant_number(b, np.inf):
        return a, one, 0.0, np.inf
    if _is_constant_number(a, -np.inf):
        return b, one, -np.inf, 0.0
    if ca.is_equal(a, -b, NEGATION_DEPTH) or ca.is_equal(-a, b, NEGATION_DEPTH):
        return zero, interval_length(zero, b, guarded=guarded), -1.0, 1.0
    s = interval_length(a, b, guarded=guarded)
    if not ca.depends_on(a, moving):
        return a, s, 0.0, 1.0
    if not ca.depends_on(b, moving):
        return b, s, -1.0, 0.0
    return (a + b) / 2, s / 2, -1.0, 1.0


def interval_length(a: ca.SX, b: ca.SX, *, guarded: bool) -> ca.SX:
    """B - a; where that is < 0, if ``guarded``, NaN."""
    return ca.if_else(a <= b, b - a, np.nan) if guarded else b - a


def find_invalid_row(ends: Sequence[LawEnds], symbols: ca.SX, values: np.ndarray, t: float) -> InvalidLawRow | None:
    """The first of the ``ends`` that make no set at time t; None where each makes one.

    ``values``: of the symbols that they are expressions of.
    """
    columns = ca.vertcat(ca.SX(0, 2), *(ca.horzcat(end.lower, end.upper) for end in ends))
    at = np.array(ca.Function("ends", [symbols], [ca.densify(columns)])(values)).reshape(-1, 2)
    for end, (low, high) in zip(ends, at, strict=True):
        where = f"the law of '{end.name}' at t = {t:.10g}"
        for value, own in ((low, end.lower), (high, end.upper)):
            if not (np.isfinite(value) or own.is_constant()):
                return InvalidLawRow(end.name, f"{where}: an end is {value:g}; an end that moves is a finite number")
        if low > high:
            text = f"its lower end, {low:.10g}, is above its upper end, {high:.10g}; keep lower <= upper at all times of the run"
            return InvalidLawRow(end.name, f"{where}: {text}")
    return None


def _is_constant_number(end: ca.SX, value: float) -> bool:
    return end.is_constant() and float(end) == value
