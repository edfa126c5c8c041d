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
from nsmodel.proof.convex.pieces import COMPARISON_OPERATIONS, KINK_OPERATIONS, LOGICAL_OPERATIONS, CaseInterval, WeightedTerms
from nsmodel.proof.exact import round_down, round_up
from nsmodel.proof.exponential_sums import Enclosure
from nsmodel.proof.graph import apply_operation, fold_graph, is_same_expression, operation_codes, stack_column
from nsmodel.proof.one_variable import Cases

JumpBounds = tuple[float, float]


class JointJump(NamedTuple):
    """Bounds of the jumps of a function and of its slope at a joint, and of the slope before it."""

    value: JumpBounds
    slope: JumpBounds
    before: JumpBounds


class _OneSidedExpressions(NamedTuple):
    left: ca.SX
    right: ca.SX


def joint_jump(terms: WeightedTerms, s: ca.SX, left: CaseInterval, right: CaseInterval) -> JointJump | None:
    """Bounds of the jumps at the joint of two pieces; None where there are none, or where there is an isolated value there."""
    place = right.low
    total = [_ZERO_BOUNDS, _ZERO_BOUNDS, _ZERO_BOUNDS]
    for (factor, term), before, after in zip(terms, left.cases, right.cases, strict=True):
        found = _term_jump(term, s, place, before, after)
        if found is None:
            return None
        total = [_add_bounds(own, _scale_bounds(part, factor)) for own, part in zip(total, found, strict=True)]
    return JointJump(*((round_down(part[0]), round_up(part[1])) for part in total))


_RationalInterval = tuple[Fraction, Fraction]
_ZERO_BOUNDS: _RationalInterval = (Fraction(0), Fraction(0))


def _add_bounds(a: _RationalInterval, b: _RationalInterval) -> _RationalInterval:
    return a[0] + b[0], a[1] + b[1]


def _scale_bounds(a: _RationalInterval, factor: Fraction) -> _RationalInterval:
    return (a[0] * factor, a[1] * factor) if factor >= 0 else (a[1] * factor, a[0] * factor)


def _term_jump(
    term: ca.SX, s: ca.SX, place: Enclosure, before: Cases, after: Cases
) -> tuple[_RationalInterval, _RationalInterval, _RationalInterval] | None:
    around = np.array([round_down(place[0])]), np.array([round_up(place[1])])
    if before == after:
        slope = ca.gradient(term, s)
        if not interval.is_continuous(
            ca.vertcat(term, slope), s, np.nextafter(around[0], -np.inf), np.nextafter(around[1], np.inf)
        ):
            return None
        bounds = _joint_bounds(slope, s, place)
        return None if bounds is None else (_ZERO_BOUNDS, _ZERO_BOUNDS, bounds)
    kinks = _JointKinks(s, before, after)
    (sides,) = fold_graph(
        term,
        lambda item: _OneSidedExpressions(item, item),
        lambda value: _OneSidedExpressions(ca.SX(value), ca.SX(value)),
        kinks.apply,
    )
    k = stack_column(kinks.symbols)
    own = [ca.vertcat(side, ca.gradient(side, s), *(ca.gradient(side, symbol) for symbol in kinks.symbols)) for side in sides]
    values = [ca.substitute(part, k, ca.DM.zeros(k.numel())) for part in own]
    slopes = [ca.substitute(kinks.slope(side, i), k, ca.DM.zeros(k.numel())) for i, side in enumerate(sides)]
    if not all(interval.is_continuous(ca.vertcat(value, slope), s, *around) for value, slope in zip(values, slopes, strict=True)):
        return None
    if any(op in (ca.OP_EQ, ca.OP_NE, ca.OP_SIGN) for op in operation_codes(term)):
        return None
    by_value = _side_difference(values[0][0], values[1][0], s, place)
    by_slope = _side_difference(slopes[0], slopes[1], s, place)
    first = _joint_bounds(slopes[0], s, place)
    return None if by_value is None or by_slope is None or first is None else (by_value, by_slope, first)


class _JointKinks:
    """A term on both sides of a joint, its kinks written with new symbols, and the slopes of these on each side."""

    def __init__(self, s: ca.SX, before: Cases, after: Cases) -> None:
        self.s, self.before, self.after = s, before, after
        self.symbols: list[ca.SX] = []
        self._rates: list[_OneSidedExpressions] = []
        self._calls = count()

    def slope(self, node: ca.SX, side: int) -> ca.SX:
        total = ca.gradient(node, self.s)
        for k, rate in zip(self.symbols, self._rates, strict=True):
            total += ca.gradient(node, k) * rate[side]
        return total

    def apply(self, op: int, args: list[_OneSidedExpressions]) -> _OneSidedExpressions:
        call = next(self._calls)
        if call not in self.before or call not in self.after:
            return _OneSidedExpressions(
                apply_operation(op, [arg.left for arg in args]), apply_operation(op, [arg.right for arg in args])
            )
        one, other = self.before[call], self.after[call]
        if op in KINK_OPERATIONS and one != other:
            return self._replace_kink(one[0], other[0], args)
        return _OneSidedExpressions(*(_case_value(case, [arg[side] for arg in args]) for side, case in enumerate((one, other))))

    def _replace_kink(
        self, one: tuple[int, ...], other: tuple[int, ...], args: list[_OneSidedExpressions]
    ) -> _OneSidedExpressions:
        base = None if len(args) == 1 else 0 if args[0].left.is_constant() else 1
        k = ca.SX.sym("k")
        parts = []
        for side, factors in enumerate((one, other)):
            difference = ca.SX(0)
            for j, factor in enumerate(factors):
                difference += (factor - (j == base)) * args[j][side]
            parts.append(self.slope(difference, side))
        self.symbols.append(k)
        self._rates.append(_OneSidedExpressions(*parts))
        return _OneSidedExpressions(k, k) if base is None else _OneSidedExpressions(args[base].left + k, args[base].right + k)


def _case_value(case: tuple[tuple[int, ...], Fraction], args: list[ca.SX]) -> ca.SX:
    total = ca.SX(float(case[1]))
    for factor, arg in zip(case[0], args, strict=True):
        if factor:
            total = arg if factor == 1 and total.is_zero() else total + factor * arg
    return total


def _side_difference(left: ca.SX, right: ca.SX, s: ca.SX, place: Enclosure) -> _RationalInterval | None:
    if is_same_expression(left, right):
        return _ZERO_BOUNDS
    a, b = (exact_value(side, s, place[0]) if place[0] == place[1] else None for side in (left, right))
    if a is not None and b is not None:
        return b - a, b - a
    return _joint_bounds(right - left, s, place)


def _joint_bounds(expr: ca.SX, s: ca.SX, place: Enclosure) -> _RationalInterval | None:
    if place[0] == place[1]:
        exact = exact_value(expr, s, place[0])
        if exact is not None:
            return exact, exact
    low, high = (
        float(np.ravel(end)[0])
        for end in interval.enclose(expr, s, np.array([round_down(place[0])]), np.array([round_up(place[1])]))
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
        return _exact_operation(op, known) if len(known) == len(args) and known else None

    own = s.element_hash()
    return fold_graph(expr, lambda item: at if item.element_hash() == own else None, number, apply)[0]


def _exact_operation(op: int, args: list[Fraction]) -> Fraction | None:
    a, b = args[0], args[-1]
    p = polynomial.apply_to_polynomials(op, [{(): arg} if arg else {} for arg in args])
    if p is not None:
        return p.get((), Fraction(0))
    if op == ca.OP_SQRT and a >= 0:
        roots = isqrt(a.numerator), isqrt(a.denominator)
        return Fraction(*roots) if Fraction(*roots) ** 2 == a else None
    if op in (ca.OP_POW, ca.OP_CONSTPOW):
        if a == 1 or (a == 0 and b > 0):
            return a
        return a ** int(b) if b.denominator == 1 and a and abs(b) < 64 else None
    if op in (*COMPARISON_OPERATIONS, *LOGICAL_OPERATIONS, ca.OP_SIGN, ca.OP_IF_ELSE_ZERO):
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
