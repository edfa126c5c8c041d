"""The jumps of a function of one s >= 0, with kinks and conditions, at the joints of its pieces.

At a joint c each max(u, v) that changes its case is written v + k with a new symbol k, which is 0 at c: a function F(s, k) with
continuous slopes has no jump of its value, and one of its slope by dF/dk times that of k. Where dF/dk = 0, as for k^1.5, there
is none, wherever exactly c lies.
"""

from __future__ import annotations

from fractions import Fraction
from itertools import count
from math import isqrt
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import interval, polynomial
from nsmodel.proof.convex.pieces import COMPARED, KINKS, LOGIC, Stretch, Terms
from nsmodel.proof.exact import down, up
from nsmodel.proof.exponential_sums import Place
from nsmodel.proof.graph import applied, column, fold, operations, same
from nsmodel.proof.one_variable import Cases

Ends = tuple[float, float]


class JointJump(NamedTuple):
    """Bounds of the jumps of a function and of its slope at a joint, and of the slope before it."""

    value: Ends
    slope: Ends
    before: Ends


class _Sides(NamedTuple):
    left: ca.SX
    right: ca.SX


def jump(terms: Terms, s: ca.SX, left: Stretch, right: Stretch) -> JointJump | None:
    """Bounds of the jumps at the joint of two pieces; None where there are none, or where there is an isolated value there."""
    place = right.low
    total = [_ZERO, _ZERO, _ZERO]
    for (factor, term), before, after in zip(terms, left.cases, right.cases, strict=True):
        found = _jump(term, s, place, before, after)
        if found is None:
            return None
        total = [_plus(own, _scaled(part, factor)) for own, part in zip(total, found, strict=True)]
    return JointJump(*((down(part[0]), up(part[1])) for part in total))


_Exact = tuple[Fraction, Fraction]
_ZERO: _Exact = (Fraction(0), Fraction(0))


def _plus(a: _Exact, b: _Exact) -> _Exact:
    return a[0] + b[0], a[1] + b[1]


def _scaled(a: _Exact, factor: Fraction) -> _Exact:
    return (a[0] * factor, a[1] * factor) if factor >= 0 else (a[1] * factor, a[0] * factor)


def _jump(term: ca.SX, s: ca.SX, place: Place, before: Cases, after: Cases) -> tuple[_Exact, _Exact, _Exact] | None:
    around = np.array([down(place[0])]), np.array([up(place[1])])
    if before == after:
        slope = ca.gradient(term, s)
        if not interval.is_continuous(
            ca.vertcat(term, slope), s, np.nextafter(around[0], -np.inf), np.nextafter(around[1], np.inf)
        ):
            return None
        bounds = _bounds(slope, s, place)
        return None if bounds is None else (_ZERO, _ZERO, bounds)
    walk = _Kinks(s, before, after)
    (sides,) = fold(term, lambda item: _Sides(item, item), lambda value: _Sides(ca.SX(value), ca.SX(value)), walk.apply)
    k = column(walk.symbols)
    own = [ca.vertcat(side, ca.gradient(side, s), *(ca.gradient(side, symbol) for symbol in walk.symbols)) for side in sides]
    values = [ca.substitute(part, k, ca.DM.zeros(k.numel())) for part in own]
    slopes = [ca.substitute(walk.slope(side, i), k, ca.DM.zeros(k.numel())) for i, side in enumerate(sides)]
    if not all(interval.is_continuous(ca.vertcat(value, slope), s, *around) for value, slope in zip(values, slopes, strict=True)):
        return None
    if any(op in (ca.OP_EQ, ca.OP_NE, ca.OP_SIGN) for op in operations(term)):
        return None
    by_value = _difference(values[0][0], values[1][0], s, place)
    by_slope = _difference(slopes[0], slopes[1], s, place)
    first = _bounds(slopes[0], s, place)
    return None if by_value is None or by_slope is None or first is None else (by_value, by_slope, first)


class _Kinks:
    """A term on both sides of a joint, its kinks written with new symbols, and the slopes of these on each side."""

    def __init__(self, s: ca.SX, before: Cases, after: Cases) -> None:
        self.s, self.before, self.after = s, before, after
        self.symbols: list[ca.SX] = []
        self._rates: list[_Sides] = []
        self._calls = count()

    def slope(self, node: ca.SX, side: int) -> ca.SX:
        total = ca.gradient(node, self.s)
        for k, rate in zip(self.symbols, self._rates, strict=True):
            total += ca.gradient(node, k) * rate[side]
        return total

    def apply(self, op: int, args: list[_Sides]) -> _Sides:
        call = next(self._calls)
        if call not in self.before or call not in self.after:
            return _Sides(applied(op, [arg.left for arg in args]), applied(op, [arg.right for arg in args]))
        one, other = self.before[call], self.after[call]
        if op in KINKS and one != other:
            return self._kink(one[0], other[0], args)
        return _Sides(*(_chosen(case, [arg[side] for arg in args]) for side, case in enumerate((one, other))))

    def _kink(self, one: tuple[int, ...], other: tuple[int, ...], args: list[_Sides]) -> _Sides:
        base = None if len(args) == 1 else 0 if args[0].left.is_constant() else 1
        k = ca.SX.sym("k")
        parts = []
        for side, factors in enumerate((one, other)):
            difference = ca.SX(0)
            for j, factor in enumerate(factors):
                difference += (factor - (j == base)) * args[j][side]
            parts.append(self.slope(difference, side))
        self.symbols.append(k)
        self._rates.append(_Sides(*parts))
        return _Sides(k, k) if base is None else _Sides(args[base].left + k, args[base].right + k)


def _chosen(case: tuple[tuple[int, ...], Fraction], args: list[ca.SX]) -> ca.SX:
    total = ca.SX(float(case[1]))
    for factor, arg in zip(case[0], args, strict=True):
        if factor:
            total = arg if factor == 1 and total.is_zero() else total + factor * arg
    return total


def _difference(left: ca.SX, right: ca.SX, s: ca.SX, place: Place) -> _Exact | None:
    if same(left, right):
        return _ZERO
    a, b = (exact_value(side, s, place[0]) if place[0] == place[1] else None for side in (left, right))
    if a is not None and b is not None:
        return b - a, b - a
    return _bounds(right - left, s, place)


def _bounds(expr: ca.SX, s: ca.SX, place: Place) -> _Exact | None:
    if place[0] == place[1]:
        exact = exact_value(expr, s, place[0])
        if exact is not None:
            return exact, exact
    low, high = (
        float(np.ravel(end)[0]) for end in interval.enclose(expr, s, np.array([down(place[0])]), np.array([up(place[1])]))
    )
    return (Fraction(low), Fraction(high)) if np.isfinite([low, high]).all() else None


def exact_value(expr: ca.SX, s: ca.SX, at: Fraction) -> Fraction | None:
    """The value of a scalar at a rational s where it is a rational number by its operations, else None.

    >>> s = ca.SX.sym("s")
    >>> exact_value(ca.exp(s - 0.5) * ca.sqrt(s + 1.75), s, Fraction(1, 2))
    Fraction(3, 2)
    """

    def number(value: float) -> Fraction | None:
        return Fraction(value) if np.isfinite(value) else None

    def apply(op: int, args: list[Fraction | None]) -> Fraction | None:
        known = [arg for arg in args if arg is not None]
        return _applied(op, known) if len(known) == len(args) and known else None

    own = s.element_hash()
    return fold(expr, lambda item: at if item.element_hash() == own else None, number, apply)[0]


def _applied(op: int, args: list[Fraction]) -> Fraction | None:
    a, b = args[0], args[-1]
    p = polynomial.apply(op, [{(): arg} if arg else {} for arg in args])
    if p is not None:
        return p.get((), Fraction(0))
    if op == ca.OP_SQRT and a >= 0:
        roots = isqrt(a.numerator), isqrt(a.denominator)
        return Fraction(*roots) if Fraction(*roots) ** 2 == a else None
    if op in (ca.OP_POW, ca.OP_CONSTPOW):
        if a == 1 or (a == 0 and b > 0):
            return a
        return a ** int(b) if b.denominator == 1 and a and abs(b) < 64 else None
    if op in (*COMPARED, *LOGIC, ca.OP_SIGN, ca.OP_IF_ELSE_ZERO):
        value = {
            ca.OP_LE: a <= b, ca.OP_LT: a < b, ca.OP_EQ: a == b, ca.OP_NE: a != b, ca.OP_AND: bool(a and b),
            ca.OP_OR: bool(a or b),
            ca.OP_NOT: not a, ca.OP_SIGN: (a > 0) - (a < 0), ca.OP_IF_ELSE_ZERO: b if a else 0,
        }[op]  # fmt: skip
        return Fraction(value)
    if op in (ca.OP_FABS, ca.OP_FMAX, ca.OP_FMIN):
        return abs(a) if op == ca.OP_FABS else max(a, b) if op == ca.OP_FMAX else min(a, b)
    at_zero = {
        ca.OP_EXP: 1, ca.OP_COS: 1, ca.OP_COSH: 1, ca.OP_EXPM1: 0, ca.OP_SIN: 0, ca.OP_SINH: 0, ca.OP_TAN: 0, ca.OP_TANH: 0,
        ca.OP_ATAN: 0, ca.OP_ASIN: 0, ca.OP_ASINH: 0, ca.OP_ATANH: 0, ca.OP_LOG1P: 0, ca.OP_ERF: 0,
    }  # fmt: skip
    if op in at_zero and a == 0:
        return Fraction(at_zero[op])
    return Fraction(0) if op == ca.OP_LOG and a == 1 else None
