"""The intervals of s >= 0 on which no kink or condition of a function changes its case."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import count
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import one_variable, polynomial, polynomial_signs
from nsmodel.proof.exact import round_down, round_up
from nsmodel.proof.exponential_sums import Enclosure
from nsmodel.proof.graph import apply_operation, fold_graph
from nsmodel.proof.one_variable import Cases

KINK_OPERATIONS = (ca.OP_FABS, ca.OP_FMAX, ca.OP_FMIN)
COMPARISON_OPERATIONS = (ca.OP_LE, ca.OP_LT, ca.OP_EQ, ca.OP_NE)
LOGICAL_OPERATIONS = (ca.OP_AND, ca.OP_OR, ca.OP_NOT)
MAX_CASE_PIECES = 50
WeightedTerms = Sequence[tuple[Fraction, ca.SX]]  # a sum of factors times terms


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
            known = [arg.p for arg in args if arg.p is not None]
            return _CaseNode(
                polynomial.apply_to_polynomials(op, known) if len(known) == len(args) else None, old, holds, resolved
            )
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
        found = one_variable.decide_signs(u, self.s, self.low, self.high)
        if found is None:
            raise UndecidedCase
        if found.places:
            self.cuts.append(found.places[0])
            return None
        return found.signs[0]

    def _polynomial_sign(self, c: list[Fraction]) -> int | None:
        """The same of a polynomial with these coefficients."""
        low, high = self.low, self.high
        roots = [place for place in polynomial_signs.real_roots(c, low, high) if place[0] > low and place[1] != high]
        if roots:
            self.cuts.append(roots[0])
            return None
        value = polynomial_signs.evaluate_at(c, low + 1 if high is None else (low + high) / 2)
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
