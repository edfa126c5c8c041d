"""Quotients, roots and logarithms of sums of exponentials, written so that no exponential overflows.

exp(u)/(1 + exp(u)) is 1 for large u, and inf/inf in doubles. A sum D = sum_i r_i exp(s_i) is divided by its largest exponential,
exp(s_p): N/D = sum_j n_j exp(s_j - s_p) / sum_i r_i exp(s_i - s_p), and log D = s_p + log sum_i r_i exp(s_i - s_p). These are the
same function whichever p is: the values at a point choose it, and no switch of the model is there (see `is_positive`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from typing import Any, NamedTuple

import casadi as ca

from nsmodel._utils import sum_in_order
from nsmodel.event_driven.problem import ContinuousProblem
from nsmodel.event_driven.recurrences import SMALLEST_DOUBLE
from nsmodel.proof.expression_graph import apply_operation, fold_graph, numeric_constants, operation_codes

MAX_REWRITTEN_TERMS = 4  # Of a sum; a longer one stays as it is written: each may be the largest, and has its own form.
# The series of d/(e^d - 1), see `_bernoulli`:
SERIES_BELOW = 0.5  # |d| below which it stands for the quotient, whose expansions divide by e^d - 1.
# SERIES_RADIUS: (2/(2 pi))^34 = 1e-17 is what 17 even terms leave.
SERIES_RADIUS = 2.0  # |d| up to which it errs by rounding alone, with
BERNOULLI_TERMS = 17  # so many coefficients.
VANISHING_WEIGHT = 1e-300  # Of a term that is nothing beside 1, but whose root keeps discs within the radius.
GROWING = {ca.OP_EXP, ca.OP_EXPM1, ca.OP_SINH, ca.OP_COSH, ca.OP_POW}
DIVIDING = {ca.OP_DIV, ca.OP_INV, ca.OP_LOG, ca.OP_LOG1P, ca.OP_ATAN, ca.OP_POW, ca.OP_CONSTPOW}
PROBLEM_PARTS = ("f", "g", "h", "updates")

Exponent = tuple[tuple[int, float], ...]  # The sum of factor * base, bases by their numbers; () is 0.


def is_positive(u: ca.SX) -> ca.SX:
    """Whether u > 0 at the point that a piece is expanded about: which of two forms of one function is written, and no switch."""
    return SMALLEST_DOUBLE <= u


def without_overflow(problem: ContinuousProblem) -> ContinuousProblem:
    """The same problem, f, g, h and updates as `rewrite_without_overflow` writes them."""
    parts: dict[str, Any] = {part: rewrite_without_overflow(getattr(problem, part)) for part in PROBLEM_PARTS}
    return replace(problem, **parts)


def rewrite_without_overflow(expr: ca.SX) -> ca.SX:
    """The same function (n, m), where no exponential overflows in a quotient whose value is a number; or ``expr`` itself."""
    present = operation_codes(expr)
    marked = SMALLEST_DOUBLE in numeric_constants(expr)
    if (not (present & GROWING and present & DIVIDING) and not marked) or ca.OP_CALL in present:
        return expr
    writer = _ExponentialRewriter()
    nodes = fold_graph(expr, writer.symbol, writer.number, writer.operation)
    return ca.reshape(ca.vertcat(*(node.new for node in nodes)), *expr.shape) if writer.changed else expr


class ExponentialTerm(NamedTuple):
    """A term r exp(s) of a sum of exponentials."""

    r: ca.SX
    s: Exponent


@dataclass(frozen=True)
class ExponentialNode:
    """An operation of the graph, as it is written now.

    Attributes:
        new: its expression.
        key: the same for the same expressions.
        value: the number that it is; None of others.
        base, factor: it is factor times the base, which is given by its number.
        terms, power: it is the sum of the terms to the power; no terms where it holds no exponential.
    """

    new: ca.SX
    key: int
    value: float | None = None
    base: int = 0
    factor: float = 1.0
    terms: tuple[ExponentialTerm, ...] = ()
    power: float = 1.0

    @property
    def sum(self) -> tuple[ExponentialTerm, ...]:
        """Its terms; itself as one where it is no sum of exponentials."""
        return self.terms if self.terms and self.power == 1 else (ExponentialTerm(self.new, ()),)


class _ExponentialRewriter:
    """Writes a graph anew, node by node."""

    def __init__(self) -> None:
        self.changed = False
        self._keys: dict[tuple, int] = {}
        self._bases: dict[int, ca.SX] = {}

    def symbol(self, symbol: ca.SX) -> ExponentialNode:
        return self._new_node(symbol, ("symbol", symbol.element_hash()))

    def number(self, value: float) -> ExponentialNode:
        if value == SMALLEST_DOUBLE:  # A user's own: twice that is no mark.
            self.changed, value = True, 2 * SMALLEST_DOUBLE
        return self._new_node(ca.SX(value), ("number", value), value=value)

    def operation(self, op: int, args: list[ExponentialNode]) -> ExponentialNode:
        node = self._new_node(apply_operation(op, [arg.new for arg in args]), (op, *(arg.key for arg in args)))
        if all(arg.value is not None for arg in args):
            return replace(node, value=float(ca.DM(node.new)))
        node = self._as_multiple(node, op, args)
        rule = REWRITE_RULES.get(op)
        found = None if rule is None else rule(self, node, *args)
        return node if found is None else found

    def _new_node(self, new: ca.SX, made: tuple, value: float | None = None) -> ExponentialNode:
        key = self._keys.setdefault(made, len(self._keys))
        self._bases.setdefault(key, new)
        return ExponentialNode(new, key, value, base=key)

    def _as_multiple(self, node: ExponentialNode, op: int, args: Sequence[ExponentialNode]) -> ExponentialNode:
        """-u, 2 u, a u, u/a and v - u as multiples of u and of u - v: exponents that are multiples of each other are told so."""
        match op, *args:
            case ca.OP_NEG, u:
                return replace(node, base=u.base, factor=-u.factor)
            case ca.OP_TWICE, u:
                return replace(node, base=u.base, factor=2 * u.factor)
            case ca.OP_DIV, u, a if a.value:
                return replace(node, base=u.base, factor=u.factor / a.value)
            case ca.OP_MUL, u, v:
                for a, b in ((u, v), (v, u)):
                    if a.value is not None:
                        return replace(node, base=b.base, factor=a.value * b.factor)
                if u.factor * v.factor != 1:
                    base = self._new_node(self._bases[u.base] * self._bases[v.base], (op, u.base, v.base))
                    return replace(node, base=base.key, factor=u.factor * v.factor)
            case ca.OP_SUB, u, v if (op, v.key, u.key) in self._keys:
                return replace(node, base=self._keys[op, v.key, u.key], factor=-1.0)
        return node

    # Sums of exponentials.

    def exp(self, node: ExponentialNode, u: ExponentialNode) -> ExponentialNode:
        """Of a sum of exponents with numbers, too."""
        return replace(node, terms=(ExponentialTerm(ca.SX(1), ((u.base, u.factor),)),))

    def general_power(self, node: ExponentialNode, a: ExponentialNode, u: ExponentialNode) -> ExponentialNode | None:
        """Powers in which the exponent, or the base, is constant."""
        if u.value is not None:
            return self.power(node, a, u.value)
        if a.value is None or a.value <= 0 or a.value == 1:
            return None
        return replace(node, terms=(ExponentialTerm(ca.SX(1), ((u.base, u.factor * math.log(a.value)),)),))

    def expm1(self, node: ExponentialNode, u: ExponentialNode) -> ExponentialNode | None:
        return self.sum(node, self.exp(node, u), self.number(-1.0))

    def hyperbolic(self, node: ExponentialNode, u: ExponentialNode, sign: float) -> ExponentialNode:
        """The hyperbolic sine (sign -1) or cosine (sign 1) as a sum of exponentials."""
        terms = (ExponentialTerm(ca.SX(0.5), ((u.base, u.factor),)), ExponentialTerm(ca.SX(sign / 2), ((u.base, -u.factor),)))
        return replace(node, terms=terms)

    def sum(self, node: ExponentialNode, a: ExponentialNode, b: ExponentialNode, sign: float = 1.0) -> ExponentialNode | None:
        if not (_is_sum(a) or _is_sum(b)):
            return None
        return _sum_node(node, [*a.sum, *((ExponentialTerm(sign * r, s) for r, s in b.sum) if sign != 1 else b.sum)])

    def product(self, node: ExponentialNode, a: ExponentialNode, b: ExponentialNode) -> ExponentialNode | None:
        if not (_is_sum(a) or _is_sum(b)):
            return None
        return _sum_node(node, [ExponentialTerm(p.r * q.r, _add_exponents(p.s, q.s)) for p in a.sum for q in b.sum])

    def minus(self, node: ExponentialNode, a: ExponentialNode) -> ExponentialNode | None:
        return _sum_node(node, [ExponentialTerm(-r, s) for r, s in a.terms]) if _is_sum(a) else None

    def power(self, node: ExponentialNode, a: ExponentialNode, p: float) -> ExponentialNode | None:
        """Of a sum; of one term as one term. (S^2)^(1/2) is |S|, and not S."""
        if not a.terms or (a.power != 1 and a.power == int(a.power) and p != int(p)):
            return None
        if p < 0:
            return self.quotient(node, self.number(1.0), self.power(node, a, -p))
        if len(a.terms) == 1 and a.power == 1:
            return _sum_node(node, [ExponentialTerm(a.terms[0].r ** p, _scale_exponent(a.terms[0].s, p))])
        return replace(node, terms=a.terms, power=a.power * p)

    def square(self, node: ExponentialNode, a: ExponentialNode) -> ExponentialNode | None:
        """As a sum, where it has few terms and none of them cancel."""
        product = None if a.power == 1 and _is_difference(a.terms) else self.product(node, a, a)
        return product or self.power(node, a, 2.0)

    # What is written anew.

    def quotient(self, node: ExponentialNode, a: ExponentialNode, b: ExponentialNode | None) -> ExponentialNode | None:
        """a/b by the largest exponential of b; one exponential below stays as it is but below others."""
        if b is None or not b.terms:
            if b is not None and _is_sum(a):
                return _sum_node(node, [ExponentialTerm(r / b.new, s) for r, s in a.terms])
            return None
        if len(b.terms) == 1:
            (r, s), q = b.terms[0], b.power
            if not _is_sum(a):
                return _sum_node(node, [ExponentialTerm(a.new / r**q, _scale_exponent(s, -q))])
            made = _sum_node(node, [ExponentialTerm(n / r**q, _add_exponents(e, s, -q)) for n, e in a.terms])
            return None if made is None else replace(made, new=self._write_sum(made.terms, (), None))

        def side(p: int, here: ca.SX) -> ca.SX:
            times = self._multiple_of_difference(a, b.terms, p) if b.power == 1 else None
            if times is not None:  # 0/0 where the exponents are the same.
                d = self._exponent_expression(_add_exponents(b.terms[1 - p].s, b.terms[p].s, -1.0))
                return (
                    -times
                    / b.terms[p].r
                    * _bernoulli(d, here)
                    * self._write_sum((ExponentialTerm(ca.SX(1), ()),), b.terms[p].s, here)
                )
            above = self._write_sum(a.sum, _scale_exponent(b.terms[p].s, b.power), here)
            return above / self._sum_over_largest(b.terms, p, here) ** b.power

        return replace(node, new=self._select_by_largest(b.terms, side))

    def log(self, node: ExponentialNode, a: ExponentialNode) -> ExponentialNode | None:
        """The exponent of the largest exponential, and the logarithm of what it leaves."""
        if not a.terms or (a.power != 1 and a.power == int(a.power)):  # log S^2 is a number where S < 0.
            return None

        def side(p: int, here: ca.SX) -> ca.SX:
            r, largest = a.terms[p]
            rest = self._write_sum([term for i, term in enumerate(a.terms) if i != p], largest, here)
            if r.is_constant() and float(r) > 0 and not _is_difference(a.terms):
                least = ca.log(r) + ca.log1p(rest / r)
            else:
                least = ca.log(self._sum_over_largest(a.terms, p, here))
            return a.power * (self._exponent_expression(largest) + least)

        return replace(node, new=self._select_by_largest(a.terms, side), terms=())

    def log1p(self, node: ExponentialNode, a: ExponentialNode) -> ExponentialNode | None:
        one = self.sum(node, self.number(1.0), a)
        return None if one is None else self.log(node, one)

    def atan(self, node: ExponentialNode, a: ExponentialNode) -> ExponentialNode | None:
        """Of one exponential, r > 0: where it is large pi/2 less the same of 1 over it."""
        if len(a.terms) != 1 or a.power != 1 or not a.terms[0].r.is_constant() or not float(a.terms[0].r) > 0:
            return None
        both = (ExponentialTerm(ca.SX(1), ()), a.terms[0])

        def side(p: int, here: ca.SX) -> ca.SX:
            small = self._write_sum((both[1 - p],), both[p].s, here) / both[p].r
            return math.pi / 2 - ca.atan(small) if p else ca.atan(small)

        return replace(node, new=self._select_by_largest(both, side), terms=())

    def _select_by_largest(self, terms: Sequence[ExponentialTerm], side: Callable[[int, ca.SX], ca.SX]) -> ca.SX:
        """The ``side`` of the largest exponential, of those that can be it; each is 0 where it is not taken.

        Where all exponents are multiples of one base, the largest has the largest or the least factor.
        """
        self.changed = True
        first, *others = _extreme_terms(terms)
        taken: dict[int, ca.SX] = {first: ca.SX(1)}
        for p in others:
            larger = {q: is_positive(self._exponent_expression(_add_exponents(terms[p].s, terms[q].s, -1.0))) for q in taken}
            won = [ca.logic_and(here, larger[q]) for q, here in taken.items()]
            taken = {q: ca.logic_and(here, ca.logic_not(larger[q])) for q, here in taken.items()}
            taken[p] = ca.SX(0)
            for one in won:
                taken[p] = ca.logic_or(taken[p], one)
        return sum((ca.if_else(here, side(p, here), 0) for p, here in taken.items()), ca.SX(0))

    def _multiple_of_difference(self, a: ExponentialNode, terms: Sequence[ExponentialTerm], p: int) -> float | None:
        """How often d is in a, where the terms are r (exp(s_p) - exp(s_p + d)); None where a is no multiple of d."""
        if not _is_difference(terms) or _is_sum(a):
            return None
        d = _add_exponents(terms[1 - p].s, terms[p].s, -1.0)
        return a.factor / d[0][1] if len(d) == 1 and d[0][0] == a.base and a.value is None else None

    def _sum_over_largest(self, terms: Sequence[ExponentialTerm], p: int, here: ca.SX) -> ca.SX:
        """The sum of the terms over exp(s_p); 1 - e^d, which cancels for small d, is -expm1(d)."""
        if not _is_difference(terms):
            return self._write_sum(terms, terms[p].s, here)
        d = self._exponent_expression(_add_exponents(terms[1 - p].s, terms[p].s, -1.0))
        return -terms[p].r * ca.expm1(ca.if_else(here, d, -1))

    def _write_sum(self, terms: Sequence[ExponentialTerm], largest: Exponent, here: ca.SX | None) -> ca.SX:
        """The sum of the terms over exp(largest); exponents are 0 where another side is taken, that nothing overflows there."""
        total = ca.SX(0)
        for r, s in terms:
            exponent = self._exponent_expression(_add_exponents(s, largest, -1.0))
            total += r * ca.exp(exponent if here is None else ca.if_else(here, exponent, 0))
        return total

    def _exponent_expression(self, s: Exponent) -> ca.SX:
        return sum((factor * self._bases[base] for base, factor in s), ca.SX(0))


def _bernoulli(d: ca.SX, here: ca.SX) -> ca.SX:
    """d/(e^d - 1), 1 at 0, where ``here``: near 0 by its series, sum B_k d^k/k!, |d| < 2 pi.

    The series is cut off where it errs by rounding for |d| < SERIES_RADIUS: the root keeps discs of pieces within.
    """
    near = ca.logic_and(here, is_positive(SERIES_BELOW**2 - d * d))
    u, far = ca.if_else(near, d, 0), ca.if_else(ca.logic_and(here, ca.logic_not(near)), d, -1)
    series = ca.SX(0)
    for coefficient in reversed(_even_bernoulli(BERNOULLI_TERMS)):
        series = series * u**2 + coefficient
    within = VANISHING_WEIGHT * ca.sqrt(SERIES_RADIUS**2 - u * u)
    return ca.if_else(near, series - u / 2 + within, far / ca.expm1(far))


@cache
def _even_bernoulli(count: int) -> tuple[float, ...]:
    """B_0/0!, B_2/2!, B_4/4!, ...: t/(e^t - 1) has sum_(j <= k) b_j/(k + 1 - j)! = 0 for k > 0."""
    b: list[Fraction] = []
    for k in range(2 * count):
        b.append(Fraction(k == 0) - sum((b[j] / math.factorial(k + 1 - j) for j in range(k)), Fraction(0)))
    return tuple(float(one) for one in b[::2])


def _is_difference(terms: Sequence[ExponentialTerm]) -> bool:
    """Whether they are r (exp(s) - exp(s')), r a number."""
    return len(terms) == 2 and all(r.is_constant() for r, _ in terms) and float(terms[0].r) == -float(terms[1].r)


def _is_sum(a: ExponentialNode) -> bool:
    return bool(a.terms) and a.power == 1


def _sum_node(node: ExponentialNode, terms: Sequence[ExponentialTerm]) -> ExponentialNode | None:
    """A sum, terms of the same exponent together; None where it has too many, or no exponential is left."""
    found: dict[Exponent, ca.SX] = {}
    for r, s in terms:
        found[s] = found[s] + r if s in found else r
    if len(found) > MAX_REWRITTEN_TERMS or not any(found):
        return None
    return replace(node, terms=tuple(ExponentialTerm(r, s) for s, r in found.items()), power=1.0)


def _add_exponents(a: Exponent, b: Exponent, times: float = 1.0) -> Exponent:
    """The exponent a + times b."""
    total = dict(a)
    for base, factor in b:
        total[base] = total.get(base, 0.0) + times * factor
    return tuple(sorted((base, factor) for base, factor in total.items() if factor))


def _scale_exponent(s: Exponent, factor: float) -> Exponent:
    return tuple((base, factor * own) for base, own in s)


def _extreme_terms(terms: Sequence[ExponentialTerm]) -> list[int]:
    bases = {base for _, s in terms for base, _ in s}
    if len(bases) > 1:
        return list(range(len(terms)))
    factors = [sum_in_order(factor for _, factor in s) for _, s in terms]
    return list(dict.fromkeys([factors.index(min(factors)), factors.index(max(factors))]))


REWRITE_RULES: dict[int, Callable[..., ExponentialNode | None]] = {
    ca.OP_EXP: _ExponentialRewriter.exp,
    ca.OP_EXPM1: _ExponentialRewriter.expm1,
    ca.OP_SINH: lambda w, node, u: w.hyperbolic(node, u, -1.0),
    ca.OP_COSH: lambda w, node, u: w.hyperbolic(node, u, 1.0),
    ca.OP_ADD: _ExponentialRewriter.sum,
    ca.OP_SUB: lambda w, node, a, b: w.sum(node, a, b, -1.0),
    ca.OP_NEG: _ExponentialRewriter.minus,
    ca.OP_TWICE: lambda w, node, a: w.sum(node, a, a),
    ca.OP_MUL: _ExponentialRewriter.product,
    ca.OP_SQ: _ExponentialRewriter.square,
    ca.OP_POW: _ExponentialRewriter.general_power,
    ca.OP_CONSTPOW: _ExponentialRewriter.general_power,
    ca.OP_SQRT: lambda w, node, a: w.power(node, a, 0.5),
    ca.OP_DIV: _ExponentialRewriter.quotient,
    ca.OP_INV: lambda w, node, a: w.quotient(node, w.number(1.0), a),
    ca.OP_LOG: _ExponentialRewriter.log,
    ca.OP_LOG1P: _ExponentialRewriter.log1p,
    ca.OP_ATAN: _ExponentialRewriter.atan,
}
