"""The intervals of s >= 0 on which no kink or condition of a function changes its case.

Functions of one s >= 0 that are a polynomial on each of finitely many intervals, their cases settled in exact arithmetic.

The jumps of a function of one s >= 0, with kinks and conditions, at the joints of its pieces.

At a joint c each max(u, v) that changes its case is written v + k with a new symbol k, which is 0 at c: a function F(s, k) with
continuous slopes has no jump of its value, and one of its slope by dF/dk times that of k. Where dF/dk = 0, as for k^1.5, there
is none, wherever exactly c lies.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import count
from math import isqrt
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import interval_bounds, polynomial, univariate
from nsmodel.proof.exact import round_down, round_up
from nsmodel.proof.exponential_sums import Enclosure
from nsmodel.proof.expression_graph import (
    KINK_OPERATIONS,
    apply_operation,
    fold_graph,
    is_same_expression,
    operation_codes,
    stack_column,
)
from nsmodel.proof.univariate import Cases, WeightedTerms

COMPARISON_OPERATIONS = (ca.OP_LE, ca.OP_LT, ca.OP_EQ, ca.OP_NE)
LOGICAL_OPERATIONS = (ca.OP_AND, ca.OP_OR, ca.OP_NOT)
MAX_CASE_PIECES = 50  # Pieces of a law of one variable; of more the convexity is left open. 45 take 0.6 s.


class UndecidedCase(Exception):
    """A case is not decided."""


class CaseInterval(NamedTuple):
    """An interval (high None: infinite) with the cases of each term on it."""

    low: Enclosure
    high: Enclosure | None
    cases: tuple[Cases, ...]

    @property
    def rational_ends(self) -> tuple[Fraction, Fraction | None]:
        """Rational ends around it."""
        return self.low[0], None if self.high is None else self.high[1]

    @property
    def outer(self) -> tuple[np.ndarray, np.ndarray]:
        """Doubles around it."""
        return np.array([round_down(self.low[0])]), np.array([np.inf if self.high is None else round_up(self.high[1])])


def split_by_cases(terms: WeightedTerms, s: ca.SX) -> list[CaseInterval] | None:
    """Return the pieces of [0, inf) on which no case of the terms changes; None where they are not all found."""
    zero = Fraction(0), Fraction(0)
    done, left = [], [(zero, None)]
    try:
        while left:
            low, high = left.pop()
            decided: list[Cases] = []
            for _, term in terms:
                cases, cut = _resolve_cases(term, s, low[1], None if high is None else high[0])
                if cut is not None:
                    left += [(low, cut), (cut, high)]
                    break
                decided.append(cases)
            else:
                done.append(CaseInterval(low, high, tuple(decided)))
            if len(done) + len(left) > MAX_CASE_PIECES:
                return None
    except UndecidedCase:
        return None
    return sorted(done, key=lambda piece: piece.low)


class _CaseNode(NamedTuple):
    p: polynomial.Polynomial | None
    old: ca.SX
    holds: bool  # s
    resolved: bool  # holds a node that was settled


def _resolve_cases(term: ca.SX, s: ca.SX, low: Fraction, high: Fraction | None) -> tuple[Cases, Enclosure | None]:
    """The cases of a term on (low, high), or a place inside where one of them changes."""
    resolver = _CaseResolver(s, low, high)
    fold_graph(
        term,
        resolver.symbol,
        lambda value: _CaseNode(polynomial.constant_polynomial(value), ca.SX(value), False, False),
        resolver.apply,
    )
    return resolver.cases, resolver.cuts[0] if resolver.cuts else None


class _CaseResolver:
    """What is decided on (low, high) as the operations of a term are gone through: its cases, and where one of them changes."""

    def __init__(self, s: ca.SX, low: Fraction, high: Fraction | None) -> None:
        self.s, self.low, self.high = s, low, high
        self.cases: Cases = {}
        self.cuts: list[Enclosure] = []
        self._calls = count()

    def symbol(self, item: ca.SX) -> _CaseNode:
        if item.element_hash() != self.s.element_hash():
            raise UndecidedCase
        return _CaseNode({((0, 1),): Fraction(1)}, item, True, False)

    def apply(self, op: int, args: list[_CaseNode]) -> _CaseNode:
        if op == ca.OP_CALL:
            raise UndecidedCase
        call, old = next(self._calls), apply_operation(op, [arg.old for arg in args])
        holds, resolved = any(arg.holds for arg in args), any(arg.resolved for arg in args)
        if (
            not holds
            or op not in (*KINK_OPERATIONS, *COMPARISON_OPERATIONS, *LOGICAL_OPERATIONS, ca.OP_SIGN, ca.OP_IF_ELSE_ZERO)
            or self.cuts
        ):
            return _CaseNode(polynomial.apply_to_polynomials(op, [arg.p for arg in args]), old, holds, resolved)
        case = self._operation_case(op, args)
        if case is None:
            return _CaseNode(None, old, True, True)
        self.cases[call] = case
        p: polynomial.Polynomial | None = polynomial.constant_polynomial(float(case[1]))
        for factor, arg in zip(case[0], args, strict=True):
            if factor:
                p = None if p is None or arg.p is None else polynomial.add_multiple(p, arg.p, Fraction(factor))
        return _CaseNode(p, old, True, True)

    def _operation_case(self, op: int, args: list[_CaseNode]) -> tuple[tuple[int, ...], Fraction] | None:
        if op in LOGICAL_OPERATIONS or op == ca.OP_IF_ELSE_ZERO:
            return _logical_case(op, args)
        sign = self._argument_sign(op, args)
        if sign is None:
            return None
        if op == ca.OP_FABS:
            return (sign or 1,), Fraction(0)
        if op in (ca.OP_FMAX, ca.OP_FMIN):
            first = (sign >= 0) == (op == ca.OP_FMAX)
            return (int(first), int(not first)), Fraction(0)
        if op == ca.OP_SIGN:
            return (0,), Fraction(sign)
        true = {ca.OP_LT: sign < 0, ca.OP_LE: sign <= 0, ca.OP_EQ: sign == 0, ca.OP_NE: sign != 0}[op]
        return (0, 0), Fraction(int(true))

    def _argument_sign(self, op: int, args: list[_CaseNode]) -> int | None:
        """The sign of the argument, or of the difference of two; None: it changes at the cut that is noted."""
        first, last = args[0].p, args[-1].p if len(args) > 1 else {}
        if first is not None and last is not None:
            return self._polynomial_sign(polynomial.univariate_coefficients(polynomial.add_multiple(first, last, Fraction(-1))))
        if op not in KINK_OPERATIONS or any(arg.resolved for arg in args):
            raise UndecidedCase
        u = args[0].old if len(args) == 1 else args[0].old - args[1].old
        found = univariate.decide_signs(u, self.s, self.low, self.high)
        if found is None:
            raise UndecidedCase
        if found.places:
            self.cuts.append(found.places[0])
            return None
        return found.signs[0]

    def _polynomial_sign(self, c: list[Fraction]) -> int | None:
        """The same of a polynomial with these coefficients."""
        low, high = self.low, self.high
        roots = [place for place in polynomial.real_roots(c, low, high) if place[0] > low and place[1] != high]
        if roots:
            self.cuts.append(roots[0])
            return None
        value = polynomial.evaluate_at(c, low + 1 if high is None else (low + high) / 2)
        return (value > 0) - (value < 0)


def _logical_case(op: int, args: list[_CaseNode]) -> tuple[tuple[int, ...], Fraction]:
    """The case of a logical operation, or of a condition, whose arguments are known to be true or false."""
    truth = [arg.p == {(): Fraction(1)} if arg.p is not None and polynomial.is_constant(arg.p) else None for arg in args]
    if op == ca.OP_IF_ELSE_ZERO:
        if truth[0] is None and args[0].holds:
            raise UndecidedCase
        return (0, int(bool(truth[0]))), Fraction(0)
    if None in truth:
        raise UndecidedCase
    value = not truth[0] if op == ca.OP_NOT else all(truth) if op == ca.OP_AND else any(truth)
    return (0,) * len(args), Fraction(int(value))


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
        if not interval_bounds.is_continuous(
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
    if not all(
        interval_bounds.is_continuous(ca.vertcat(value, slope), s, *around) for value, slope in zip(values, slopes, strict=True)
    ):
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
        for end in interval_bounds.enclose(expr, s, np.array([round_down(place[0])]), np.array([round_up(place[1])]))
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

    own = s.element_hash()
    return fold_graph(expr, lambda item: at if item.element_hash() == own else None, number, exact_operation)[0]


def exact_operation(op: int, given: Sequence[Fraction | None]) -> Fraction | None:
    """The value of an operation of CasADi on rational numbers where it is known to be one, else None."""
    args = [arg for arg in given if arg is not None]
    if not args or len(args) < len(given):
        return None
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


class PolynomialPiece(NamedTuple):
    """The expression on [low, high] (None: infinite) as a polynomial."""

    low: Fraction
    high: Fraction | None
    c: list[Fraction]


def polynomial_pieces(expr: ca.SX, s: ca.SX) -> list[PolynomialPiece] | None:
    """The expression as a piecewise polynomial, its cases settled exactly; None where that does not work."""
    if any(symbol.element_hash() != s.element_hash() for symbol in ca.symvar(expr)):
        return None
    found = split_by_cases([(Fraction(1), expr)], s)
    if found is None or any(end is not None and end[0] != end[1] for piece in found for end in (piece.low, piece.high)):
        return None
    done = []
    for piece in found:
        p = _piece_polynomial(expr, piece.cases[0])
        if p is None:
            return None
        low, high = piece.rational_ends
        done.append(PolynomialPiece(low, high, polynomial.univariate_coefficients(p)))
    if any(exact_value(expr, s, piece.low) != polynomial.evaluate_at(piece.c, piece.low) for piece in done):
        return None  # the value at the joint itself, where a condition or sign may differ from both sides
    return done


def _piece_polynomial(expr: ca.SX, cases: Cases) -> polynomial.Polynomial | None:
    calls = iter(range(10**9))

    def apply(op: int, args: list[polynomial.Polynomial | None]) -> polynomial.Polynomial | None:
        case = cases.get(next(calls))
        if case is None:
            return polynomial.apply_to_polynomials(op, args)
        total = polynomial.scale_polynomial({(): Fraction(1)}, case[1])
        for factor, arg in zip(case[0], args, strict=True):
            if factor:
                total = None if total is None or arg is None else polynomial.add_multiple(total, arg, Fraction(factor))
        return total

    return fold_graph(expr, lambda symbol: {((0, 1),): Fraction(1)}, polynomial.constant_polynomial, apply)[0]
