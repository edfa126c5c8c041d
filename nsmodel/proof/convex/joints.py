"""Functions of one s >= 0 with kinks and conditions: the intervals on which no case changes, and the jumps at their joints.

At a joint c each max(u, v) that changes its case is written v + k with a new symbol k, which is 0 at c: a function F(s, k) with
continuous slopes has no jump of its value, and one of its slope by dF/dk times that of k. Where dF/dk = 0, as for k^1.5, there
is none, wherever exactly c lies.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from math import isqrt
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import interval, one_variable, polynomial, polynomial_signs
from nsmodel.proof.exact import down, up
from nsmodel.proof.exponential_sums import Place
from nsmodel.proof.graph import applied, column, fold, operations, same
from nsmodel.proof.one_variable import Cases

KINKS = (ca.OP_FABS, ca.OP_FMAX, ca.OP_FMIN)
COMPARED = (ca.OP_LE, ca.OP_LT, ca.OP_EQ, ca.OP_NE)
LOGIC = (ca.OP_AND, ca.OP_OR, ca.OP_NOT)
MOST_PIECES = 50
Terms = Sequence[tuple[Fraction, ca.SX]]  # a sum of factors times terms
Ends = tuple[float, float]


class Unsettled(Exception):
    """A case is not decided."""


class Stretch(NamedTuple):
    """An interval (high None: infinite) with the cases of each term on it."""

    low: Place
    high: Place | None
    cases: tuple[Cases, ...]

    @property
    def spread(self) -> tuple[Fraction, Fraction | None]:
        """Rational ends around it."""
        return self.low[0], None if self.high is None else self.high[1]

    @property
    def outer(self) -> tuple[np.ndarray, np.ndarray]:
        """Doubles around it."""
        return np.array([down(self.low[0])]), np.array([np.inf if self.high is None else up(self.high[1])])


class JointJump(NamedTuple):
    """Bounds of the jumps of a function and of its slope at a joint, and of the slope before it."""

    value: Ends
    slope: Ends
    before: Ends


def split(terms: Terms, s: ca.SX) -> list[Stretch] | None:
    """Return the pieces of [0, inf) on which no case of the terms changes; None where they are not all found."""
    zero = Fraction(0), Fraction(0)
    done, left = [], [(zero, None)]
    try:
        while left:
            low, high = left.pop()
            settled: list[Cases] = []
            for _, term in terms:
                cases, cut = _settled(term, s, low[1], None if high is None else high[0])
                if cut is not None:
                    left += [(low, cut), (cut, high)]
                    break
                settled.append(cases)
            else:
                done.append(Stretch(low, high, tuple(settled)))
            if len(done) + len(left) > MOST_PIECES:
                return None
    except Unsettled:
        return None
    return sorted(done, key=lambda piece: piece.low)


class _Node(NamedTuple):
    p: polynomial.Polynomial | None
    old: ca.SX
    holds: bool  # s
    settled: bool  # holds a node that was settled


def _settled(term: ca.SX, s: ca.SX, low: Fraction, high: Fraction | None) -> tuple[Cases, Place | None]:
    """The cases of a term on (low, high), or a place inside where one of them changes."""
    cases: Cases = {}
    cuts: list[Place] = []
    calls = iter(range(10**9))
    own = s.element_hash()
    middle = low + 1 if high is None else (low + high) / 2

    def symbol(item: ca.SX) -> _Node:
        if item.element_hash() != own:
            raise Unsettled
        return _Node({((0, 1),): Fraction(1)}, item, True, False)

    def apply(op: int, args: list[_Node]) -> _Node:
        if op == ca.OP_CALL:
            raise Unsettled
        call, old = next(calls), applied(op, [arg.old for arg in args])
        holds, settled = any(arg.holds for arg in args), any(arg.settled for arg in args)
        if not holds or op not in (*KINKS, *COMPARED, *LOGIC, ca.OP_SIGN, ca.OP_IF_ELSE_ZERO) or cuts:
            known = [arg.p for arg in args if arg.p is not None]
            return _Node(polynomial.apply(op, known) if len(known) == len(args) else None, old, holds, settled)
        case = _case(op, args)
        if case is None:
            return _Node(None, old, True, True)
        cases[call] = case
        p: polynomial.Polynomial | None = polynomial.constant(float(case[1]))
        for factor, arg in zip(case[0], args, strict=True):
            if factor:
                p = None if p is None or arg.p is None else polynomial.add(p, arg.p, Fraction(factor))
        return _Node(p, old, True, True)

    def _case(op: int, args: list[_Node]) -> tuple[tuple[int, ...], Fraction] | None:
        if op in LOGIC or op == ca.OP_IF_ELSE_ZERO:
            truth = [arg.p == {(): Fraction(1)} if arg.p is not None and polynomial.is_constant(arg.p) else None for arg in args]
            if op == ca.OP_IF_ELSE_ZERO:
                if truth[0] is None and args[0].holds:
                    raise Unsettled
                return (0, int(bool(truth[0]))), Fraction(0)
            if None in truth:
                raise Unsettled
            value = not truth[0] if op == ca.OP_NOT else all(truth) if op == ca.OP_AND else any(truth)
            return (0,) * len(args), Fraction(int(value))
        sign = _sign(op, args)
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

    def _sign(op: int, args: list[_Node]) -> int | None:
        """The sign of the argument, or of the difference of two; None: it changes at the cut that is noted."""
        first, last = args[0].p, args[-1].p if len(args) > 1 else {}
        if first is not None and last is not None:
            c = polynomial.coefficients(polynomial.add(first, last, Fraction(-1)))
            roots = [place for place in polynomial_signs.real_roots(c, low, high) if place[0] > low and place[1] != high]
            if roots:
                cuts.append(roots[0])
                return None
            value = polynomial_signs.at(c, middle)
            return (value > 0) - (value < 0)
        if op not in KINKS or any(arg.settled for arg in args):
            raise Unsettled
        u = args[0].old if len(args) == 1 else args[0].old - args[1].old
        found = one_variable.signs(u, s, low, high)
        if found is None:
            raise Unsettled
        if found.places:
            cuts.append(found.places[0])
            return None
        return found.signs[0]

    fold(term, symbol, lambda value: _Node(polynomial.constant(value), ca.SX(value), False, False), apply)
    return cases, cuts[0] if cuts else None


# -- joints ------------------------------------------------------------------------------------------------------------


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
    symbols: list[ca.SX] = []
    rates: list[_Sides] = []

    def slope_of(node: ca.SX, side: int) -> ca.SX:
        total = ca.gradient(node, s)
        for k, rate in zip(symbols, rates, strict=True):
            total += ca.gradient(node, k) * rate[side]
        return total

    calls = iter(range(10**9))

    def apply(op: int, args: list[_Sides]) -> _Sides:
        call = next(calls)
        if call not in before or call not in after:
            return _Sides(applied(op, [arg.left for arg in args]), applied(op, [arg.right for arg in args]))
        one, other = before[call], after[call]
        if op in KINKS and one != other:
            return kink(one[0], other[0], args)
        return _Sides(*(_chosen(case, [arg[side] for arg in args]) for side, case in enumerate((one, other))))

    def kink(one: tuple[int, ...], other: tuple[int, ...], args: list[_Sides]) -> _Sides:
        base = None if len(args) == 1 else 0 if args[0].left.is_constant() else 1
        k = ca.SX.sym("k")
        parts = []
        for side, factors in enumerate((one, other)):
            difference = ca.SX(0)
            for j, factor in enumerate(factors):
                difference += (factor - (j == base)) * args[j][side]
            parts.append(slope_of(difference, side))
        symbols.append(k)
        rates.append(_Sides(*parts))
        return _Sides(k, k) if base is None else _Sides(args[base].left + k, args[base].right + k)

    (sides,) = fold(term, lambda item: _Sides(item, item), lambda value: _Sides(ca.SX(value), ca.SX(value)), apply)
    k = column(symbols)
    own = [ca.vertcat(side, ca.gradient(side, s), *(ca.gradient(side, symbol) for symbol in symbols)) for side in sides]
    values = [ca.substitute(part, k, ca.DM.zeros(k.numel())) for part in own]
    slopes = [ca.substitute(slope_of(side, i), k, ca.DM.zeros(k.numel())) for i, side in enumerate(sides)]
    if not all(interval.is_continuous(ca.vertcat(value, slope), s, *around) for value, slope in zip(values, slopes, strict=True)):
        return None
    if any(op in (ca.OP_EQ, ca.OP_NE, ca.OP_SIGN) for op in operations(term)):
        return None
    by_value = _difference(values[0][0], values[1][0], s, place)
    by_slope = _difference(slopes[0], slopes[1], s, place)
    first = _bounds(slopes[0], s, place)
    return None if by_value is None or by_slope is None or first is None else (by_value, by_slope, first)


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
