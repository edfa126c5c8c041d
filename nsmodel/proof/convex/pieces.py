"""The intervals of s >= 0 on which no kink or condition of a function changes its case."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import count
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import one_variable, polynomial, polynomial_signs
from nsmodel.proof.exact import down, up
from nsmodel.proof.exponential_sums import Place
from nsmodel.proof.graph import applied, fold
from nsmodel.proof.one_variable import Cases

KINKS = (ca.OP_FABS, ca.OP_FMAX, ca.OP_FMIN)
COMPARED = (ca.OP_LE, ca.OP_LT, ca.OP_EQ, ca.OP_NE)
LOGIC = (ca.OP_AND, ca.OP_OR, ca.OP_NOT)
MOST_PIECES = 50
Terms = Sequence[tuple[Fraction, ca.SX]]  # a sum of factors times terms


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
    walk = _CasesOnInterval(s, low, high)
    fold(term, walk.symbol, lambda value: _Node(polynomial.constant(value), ca.SX(value), False, False), walk.apply)
    return walk.cases, walk.cuts[0] if walk.cuts else None


class _CasesOnInterval:
    """What is decided on (low, high) as the operations of a term are gone through: its cases, and where one of them changes."""

    def __init__(self, s: ca.SX, low: Fraction, high: Fraction | None) -> None:
        self.s, self.low, self.high = s, low, high
        self.cases: Cases = {}
        self.cuts: list[Place] = []
        self._calls = count()

    def symbol(self, item: ca.SX) -> _Node:
        if item.element_hash() != self.s.element_hash():
            raise Unsettled
        return _Node({((0, 1),): Fraction(1)}, item, True, False)

    def apply(self, op: int, args: list[_Node]) -> _Node:
        if op == ca.OP_CALL:
            raise Unsettled
        call, old = next(self._calls), applied(op, [arg.old for arg in args])
        holds, settled = any(arg.holds for arg in args), any(arg.settled for arg in args)
        if not holds or op not in (*KINKS, *COMPARED, *LOGIC, ca.OP_SIGN, ca.OP_IF_ELSE_ZERO) or self.cuts:
            known = [arg.p for arg in args if arg.p is not None]
            return _Node(polynomial.apply(op, known) if len(known) == len(args) else None, old, holds, settled)
        case = self._case(op, args)
        if case is None:
            return _Node(None, old, True, True)
        self.cases[call] = case
        p: polynomial.Polynomial | None = polynomial.constant(float(case[1]))
        for factor, arg in zip(case[0], args, strict=True):
            if factor:
                p = None if p is None or arg.p is None else polynomial.add(p, arg.p, Fraction(factor))
        return _Node(p, old, True, True)

    def _case(self, op: int, args: list[_Node]) -> tuple[tuple[int, ...], Fraction] | None:
        if op in LOGIC or op == ca.OP_IF_ELSE_ZERO:
            return _truth(op, args)
        sign = self._sign(op, args)
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

    def _sign(self, op: int, args: list[_Node]) -> int | None:
        """The sign of the argument, or of the difference of two; None: it changes at the cut that is noted."""
        first, last = args[0].p, args[-1].p if len(args) > 1 else {}
        if first is not None and last is not None:
            return self._sign_of(polynomial.coefficients(polynomial.add(first, last, Fraction(-1))))
        if op not in KINKS or any(arg.settled for arg in args):
            raise Unsettled
        u = args[0].old if len(args) == 1 else args[0].old - args[1].old
        found = one_variable.signs(u, self.s, self.low, self.high)
        if found is None:
            raise Unsettled
        if found.places:
            self.cuts.append(found.places[0])
            return None
        return found.signs[0]

    def _sign_of(self, c: list[Fraction]) -> int | None:
        """The same of a polynomial with these coefficients."""
        low, high = self.low, self.high
        roots = [place for place in polynomial_signs.real_roots(c, low, high) if place[0] > low and place[1] != high]
        if roots:
            self.cuts.append(roots[0])
            return None
        value = polynomial_signs.at(c, low + 1 if high is None else (low + high) / 2)
        return (value > 0) - (value < 0)


def _truth(op: int, args: list[_Node]) -> tuple[tuple[int, ...], Fraction]:
    """The case of a logical operation, or of a condition, whose arguments are known to be true or false."""
    truth = [arg.p == {(): Fraction(1)} if arg.p is not None and polynomial.is_constant(arg.p) else None for arg in args]
    if op == ca.OP_IF_ELSE_ZERO:
        if truth[0] is None and args[0].holds:
            raise Unsettled
        return (0, int(bool(truth[0]))), Fraction(0)
    if None in truth:
        raise Unsettled
    value = not truth[0] if op == ca.OP_NOT else all(truth) if op == ca.OP_AND else any(truth)
    return (0,) * len(args), Fraction(int(value))
