"""Functions of one variable with their first two derivatives, as far as these are quotients of exponential sums; their signs.

The derivative of a logarithm or an arctangent is such a quotient where the function itself is none: of each function, its first
and its second derivative what is known is carried along, and 0 times what is not known is 0.

Functions of one s with two derivatives, each a quotient of sums of exponentials times polynomials.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import interval_bounds
from nsmodel.proof.exact import round_down, round_up
from nsmodel.proof.exponential_sums import (
    MAX_SUM_TERMS,
    UNIT_KEY,
    Enclosure,
    ExponentialSum,
    OpenInterval,
    SignPattern,
    UndecidedSign,
    add_sums,
    ball_lower_bound,
    constant_sum,
    flint_coefficients,
    flint_polynomial,
    flint_precision,
    leading_term,
    multiply_sums,
    power_of_term,
    quotient_growth_rank,
    sign_pattern,
)
from nsmodel.proof.expression_graph import fold_graph
from nsmodel.proof.leading_terms import LeadingTerm


class ExponentialQuotient(NamedTuple):
    """N over the product of sums, each of them > 0 on the line, to powers: {name: (sum, power)}."""

    top: ExponentialSum
    bottom: dict[Any, tuple[ExponentialSum, int]]


class Jet(NamedTuple):
    """A function with its first two derivatives, each None where it is no quotient of sums."""

    value: ExponentialQuotient | None
    first: ExponentialQuotient | None
    second: ExponentialQuotient | None


def add_jets(a: Jet, b: Jet, factor: int) -> Jet:
    """The jet a + factor b."""
    return Jet(
        *(
            None if x is None or y is None else add_quotients(x, scale_quotient(y, abs(factor)), 1 if factor > 0 else -1)
            for x, y in zip(a, b, strict=True)
        )
    )


def jet_of_operation(op: int, args: list[Jet], line: OpenInterval) -> Jet:
    """An operation on functions and their derivatives."""
    a, b = args[0], args[-1]
    if op in (ca.OP_ADD, ca.OP_SUB):
        return add_jets(a, b, 1 if op == ca.OP_ADD else -1)
    if op in (ca.OP_ASSIGN, ca.OP_NEG, ca.OP_TWICE):
        factor = {ca.OP_ASSIGN: 1, ca.OP_NEG: -1, ca.OP_TWICE: 2}[op]
        return Jet(*(None if part is None else scale_quotient(part, factor) for part in a))
    if op in (ca.OP_MUL, ca.OP_SQ):
        return _product_jet(a, b)
    if op == ca.OP_DIV:
        return _product_jet(a, _chain_rule(b, _elementary_jet(ca.OP_INV, b, None, line)))
    if op in (ca.OP_POW, ca.OP_CONSTPOW):
        c = None if b.value is None else _polynomial_coefficients(b.value)
        if c is None or len(c) > 1:
            return Jet(None, None, None)
        return _chain_rule(a, _elementary_jet(op, a, c[0] if c else Fraction(0), line))
    return _chain_rule(a, _elementary_jet(op, a, None, line))


def _multiply_known(a: ExponentialQuotient | None, b: ExponentialQuotient | None) -> ExponentialQuotient | None:
    """The product; 0 times what is not known is 0."""
    for one in (a, b):
        if one is not None and not one.top:
            return one
    return None if a is None or b is None else _multiply_quotients(a, b)


def _add_known(*parts: ExponentialQuotient | None) -> ExponentialQuotient | None:
    total: ExponentialQuotient | None = ExponentialQuotient({}, {})
    for part in parts:
        total = None if total is None or part is None else add_quotients(total, part, 1)
    return total


def _product_jet(a: Jet, b: Jet) -> Jet:
    cross = _multiply_known(a.first, b.first)
    return Jet(
        _multiply_known(a.value, b.value), _add_known(_multiply_known(a.value, b.first), _multiply_known(a.first, b.value)),
        _add_known(_multiply_known(a.value, b.second), cross, cross, _multiply_known(a.second, b.value)),
    )  # fmt: skip


def _chain_rule(u: Jet, f: Jet) -> Jet:
    """f(u) from the jet of f at the value of u."""
    return Jet(
        f.value,
        _multiply_known(f.first, u.first),
        _add_known(_multiply_known(f.second, _multiply_known(u.first, u.first)), _multiply_known(f.first, u.second)),
    )


def _elementary_jet(op: int, u: Jet, exponent: Fraction | None, line: OpenInterval) -> Jet:
    """The jet of an elementary function at the value of u."""
    nothing = Jet(None, None, None)
    x = u.value
    if x is None:
        return nothing
    one, zero = ExponentialQuotient(constant_sum(Fraction(1)), {}), ExponentialQuotient({}, {})
    if op in (ca.OP_POW, ca.OP_CONSTPOW, ca.OP_SQRT, ca.OP_INV):
        p = exponent if exponent is not None else Fraction(1, 2) if op == ca.OP_SQRT else Fraction(-1)
        powers = [
            zero
            if not factor
            else _multiply_known(ExponentialQuotient(constant_sum(factor), {}), _raise_quotient(x, p - k, line))
            for k, factor in enumerate((Fraction(1), p, p * (p - 1)))
        ]
        return Jet(*powers)
    if op in (ca.OP_EXP, ca.OP_EXPM1, ca.OP_SINH, ca.OP_COSH, ca.OP_TANH):
        return _exponential_jet(op, x, line)
    if op in (ca.OP_LOG, ca.OP_LOG1P):
        inner = x if op == ca.OP_LOG else add_quotients(x, one, 1)
        inside = sign_pattern(inner.top, line)
        if inside.touches or min(inside.signs) <= 0:
            return nothing
        d = _invert_quotient(inner, line)
        return Jet(None, d, scale_quotient(_multiply_quotients(d, d), -1))
    if op in (ca.OP_ATAN, ca.OP_ASINH):
        around = add_quotients(one, _multiply_quotients(x, x), 1)
        if op == ca.OP_ATAN:
            d = _invert_quotient(around, line)
            return Jet(None, d, scale_quotient(_multiply_quotients(x, _multiply_quotients(d, d)), -2))
        d = _raise_quotient(around, Fraction(-1, 2), line)
        cube = _raise_quotient(around, Fraction(-3, 2), line)
        return Jet(None, d, None if cube is None else scale_quotient(_multiply_quotients(x, cube), -1))
    return nothing


def _exponential_jet(op: int, x: ExponentialQuotient, line: OpenInterval) -> Jet:
    """The jet of exp, or of a function made of it, at x."""
    one = ExponentialQuotient(constant_sum(Fraction(1)), {})
    if op in (ca.OP_EXP, ca.OP_EXPM1):
        e = _exp_of_polynomial(x, 1)
        return Jet(e if op == ca.OP_EXP else add_quotients(e, one, -1), e, e)
    if op == ca.OP_TANH:
        v = add_quotients(
            one,
            _multiply_quotients(scale_quotient(one, 2), _invert_quotient(add_quotients(_exp_of_polynomial(x, 2), one, 1), line)),
            -1,
        )
        d = add_quotients(one, _multiply_quotients(v, v), -1)
        return Jet(v, d, scale_quotient(_multiply_quotients(v, d), -2))
    both = (
        scale_quotient(add_quotients(_exp_of_polynomial(x, 1), _exp_of_polynomial(x, -1), -1), Fraction(1, 2)),
        scale_quotient(add_quotients(_exp_of_polynomial(x, 1), _exp_of_polynomial(x, -1), 1), Fraction(1, 2)),
    )
    odd, even = both if op == ca.OP_SINH else both[::-1]
    return Jet(odd, even, odd)


def scale_quotient(a: ExponentialQuotient, factor: Fraction | int) -> ExponentialQuotient:
    """The quotient times a factor."""
    return ExponentialQuotient(multiply_sums(a.top, constant_sum(Fraction(factor))), a.bottom)


def _multiply_quotients(a: ExponentialQuotient, b: ExponentialQuotient) -> ExponentialQuotient:
    bottom = dict(a.bottom)
    for name, (part, power) in b.bottom.items():
        bottom[name] = part, power + (bottom[name][1] if name in bottom else 0)
    return ExponentialQuotient(multiply_sums(a.top, b.top), bottom)


def add_quotients(a: ExponentialQuotient, b: ExponentialQuotient, sign: int) -> ExponentialQuotient:
    """The quotient a + sign b."""
    bottom = dict(a.bottom)
    for name, (part, power) in b.bottom.items():
        bottom[name] = part, max(power, bottom[name][1] if name in bottom else 0)
    tops = []
    for one in (a, b):
        top = one.top
        for name, (part, power) in bottom.items():
            for _ in range(power - (one.bottom[name][1] if name in one.bottom else 0)):
                top = multiply_sums(top, part)
        tops.append(top)
    return ExponentialQuotient(add_sums(tops[0], tops[1], sign), bottom)


def _invert_quotient(a: ExponentialQuotient, line: OpenInterval) -> ExponentialQuotient:
    if not a.top:
        raise UndecidedSign
    top = constant_sum(Fraction(1))
    for part, power in a.bottom.values():
        for _ in range(power):
            top = multiply_sums(top, part)
    if len(a.top) == 1:
        return ExponentialQuotient(multiply_sums(top, power_of_term(a.top, Fraction(-1), line)), {})
    found = sign_pattern(a.top, line)
    if found.places or found.touches or not found.signs[0]:
        raise UndecidedSign
    part = multiply_sums(a.top, constant_sum(Fraction(found.signs[0])))
    name = frozenset((key, flint_coefficients(n), flint_coefficients(d)) for key, (n, d) in part.items())
    return ExponentialQuotient(multiply_sums(top, constant_sum(Fraction(found.signs[0]))), {name: (part, 1)})


def _raise_quotient(a: ExponentialQuotient, exponent: Fraction, line: OpenInterval) -> ExponentialQuotient | None:
    if exponent.denominator == 1 and abs(exponent) <= MAX_SUM_TERMS:
        base = a if exponent >= 0 else _invert_quotient(a, line)
        out = ExponentialQuotient(constant_sum(Fraction(1)), {})
        for _ in range(abs(int(exponent))):
            out = _multiply_quotients(out, base)
        return out
    if not a.top:
        return a if exponent > 0 else None
    return None if a.bottom or len(a.top) > 1 else ExponentialQuotient(power_of_term(a.top, exponent, line), {})


def _exp_of_polynomial(a: ExponentialQuotient, factor: int) -> ExponentialQuotient:
    """e^(factor a) of a polynomial."""
    c = _polynomial_coefficients(a)
    if c is None:
        raise UndecidedSign
    q = tuple(factor * number for number in c)
    return ExponentialQuotient({((), q): (flint_polynomial([Fraction(1)]),) * 2}, {})


def _polynomial_coefficients(a: ExponentialQuotient) -> tuple[Fraction, ...] | None:
    if a.bottom or set(a.top) - {UNIT_KEY}:
        return None
    if not a.top:
        return ()
    top, bottom = a.top[UNIT_KEY]
    return flint_coefficients(top) if bottom.degree() == 0 else None


WeightedTerms = Sequence[tuple[Fraction, ca.SX]]  # a sum of factors times terms
Cases = dict[int, tuple[tuple[int, ...], Fraction]]  # number of an operation in the graph: factors of its arguments, offset


def decide_signs(
    expr: ca.SX, s: ca.SX, low: Fraction = Fraction(0), high: Fraction | None = None, *, strict: bool = False
) -> SignPattern | None:
    """Return the signs of a scalar on the open interval (low, high), None where they are not decided; ``strict``: see below.

    >>> s = ca.SX.sym("s")
    >>> decide_signs(ca.exp(s) - s - 1, s).signs, decide_signs(s * ca.tanh(s) - s / 2, s).signs
    ([1], [-1, 1])
    """
    return _quotient_signs(lambda line: _expression_jet(expr, s, line, {}, strict).value, OpenInterval(low, high))


def second_derivative_signs(
    terms: WeightedTerms,
    s: ca.SX,
    low: Fraction,
    high: Fraction | None,
    cases: Sequence[Cases],
    less: Fraction,
    *,
    strict: bool = False,
) -> SignPattern | None:
    """Return the signs of f'' - ``less`` for a sum f of factors times terms, None where they are not decided.

    Each fabs, fmax, fmin and condition is replaced by its case on the interval, which ``cases`` holds for each term. ``strict``:
    all operations are to be seen to have derivatives, those of a factor 0 too.
    """

    def total(line: OpenInterval) -> ExponentialQuotient | None:
        found = _sum_of_jets(terms, s, line, cases, "second", strict)
        return None if found is None else add_quotients(found, ExponentialQuotient(constant_sum(less), {}), -1)

    return _quotient_signs(total, OpenInterval(low, high))


def has_two_derivatives(term: ca.SX, s: ca.SX, low: Fraction, high: Fraction | None, cases: Cases) -> bool:
    """Whether a term is seen to have two continuous derivatives on the open interval, and these are quotients of sums."""
    with flint_precision():
        try:
            return _expression_jet(term, s, OpenInterval(low, high), cases).second is not None
        except (UndecidedSign, ZeroDivisionError, OverflowError):
            return False


def right_derivative_bounds(term: ca.SX, s: ca.SX, low: Fraction, cases: Cases) -> tuple[float, float] | None:
    """Bounds of the limit of the derivative at ``low`` from the right; None where it is not found or infinite."""
    from flint import arb

    high = low + 1
    with flint_precision():
        for _ in range(20):
            try:
                found = _expression_jet(term, s, OpenInterval(low, high), cases).first
                if found is None:
                    return None
                lead = _leading_quotient(found, low, 1)
                if lead.order < 0:
                    return None
                number = arb(0) if lead.order > 0 else lead.number
                return ball_lower_bound(number), -ball_lower_bound(-number) + 0.0
            except UndecidedSign:  # a sign changes too near
                high = low + (high - low) / 8
            except (ZeroDivisionError, OverflowError):
                return None
    return None


def tends_to_minus_infinity(terms: WeightedTerms, s: ca.SX, low: Fraction, cases: Sequence[Cases]) -> bool:
    """Whether a sum of factors times terms is proved to tend to -inf: its derivative stays below -c/s, c > 0, for large s."""
    found = _leading_term_far_out(terms, s, low, cases, "first")
    return found is not None and bool(found.number < 0) and (found.rank[0] > 0 or (not found.rank[0] and found.order <= 1))


def growth_far_out(terms: WeightedTerms, s: ca.SX, low: Fraction, cases: Sequence[Cases]) -> LeadingTerm | None:
    """Return the leading term of a sum of factors times terms as s grows, in w = 1/s; None where it is not found."""
    found = _leading_term_far_out(terms, s, low, cases, "value")
    return found if found is not None and not found.number.contains(0) else None


def _leading_term_far_out(
    terms: WeightedTerms, s: ca.SX, low: Fraction, cases: Sequence[Cases], which: str
) -> LeadingTerm | None:
    """The leading term of the value of a sum, or of its first derivative."""
    line = OpenInterval(max(low, Fraction(0)) + 1)
    with flint_precision():
        for _ in range(8):
            try:
                total = _sum_of_jets(terms, s, line, cases, which)
                return None if total is None else _leading_quotient(total, None, -1)
            except UndecidedSign:  # a sign changes further out
                line = OpenInterval(8 * line.low)
            except (ZeroDivisionError, OverflowError):
                return None
    return None


def _sum_of_jets(
    terms: WeightedTerms, s: ca.SX, line: OpenInterval, cases: Sequence[Cases], which: str, strict: bool = False
) -> ExponentialQuotient | None:
    """The value, ``first`` or ``second`` derivative of a sum of factors times terms; None where it is no quotient."""
    total = ExponentialQuotient({}, {})
    for (factor, term), own in zip(terms, cases, strict=True):
        part = getattr(_expression_jet(term, s, line, own, strict), which)
        if part is None:
            return None
        total = add_quotients(total, scale_quotient(part, factor), 1)
    return total


def _leading_quotient(q: ExponentialQuotient, end: Fraction | None, side: int) -> LeadingTerm:
    """The leading term at an end (None: infinity), from its right (side 1) or left (-1)."""
    rank, order, number = leading_term(q.top, end, side)
    for part, power in q.bottom.values():
        own = leading_term(part, end, side)
        if own.number.contains(0):
            raise UndecidedSign
        rank, order = quotient_growth_rank(rank, own.rank, power), order - own.order * power
        number = number / own.number**power
    return LeadingTerm(rank, order, number)


def infimum_bound(terms: WeightedTerms, s: ca.SX, low: Fraction, high: Fraction | None, cases: Sequence[Cases]) -> float | None:
    """Return a lower bound, next to the infimum, of a sum of factors times terms on the open interval (low, high).

    The function is monotone between the places where its derivative changes its sign, so that its infimum is its value at one of
    these, or its limit at an end. None where that is not found, -inf where the sum is proved to be unbounded below.

    >>> s = ca.SX.sym("s")
    >>> infimum_bound([(Fraction(1), ca.sqrt(1 + s**2) - s)], s, Fraction(0), None, [{}])
    0.0
    """
    line = OpenInterval(low, high)
    with flint_precision():
        try:
            slope = _sum_of_jets(terms, s, line, cases, "first", strict=True)
            if slope is None:
                return None
            found = sign_pattern(slope.top, line)
            bounds = [
                lower_bound_on_enclosure(terms, s, place)
                for place, (before, after) in zip(found.places, pairwise(found.signs), strict=True)
                if before < after
            ]
            bounds += [_limit_bound(terms, s, line, low, 1, cases)] if found.signs[0] >= 0 else []
            bounds += [_limit_bound(terms, s, line, high, -1, cases)] if found.signs[-1] < 0 else []
            known = [bound for bound in bounds if bound is not None]
            return min(known) if len(known) == len(bounds) else None
        except (UndecidedSign, ZeroDivisionError, OverflowError):
            return None


def limit_at_start(terms: WeightedTerms, s: ca.SX, high: Fraction | None) -> float | None:
    """Return a lower bound of the limit of a sum of factors times terms at 0 from the right; None where it is not found."""
    with flint_precision():
        try:
            return _limit_bound(terms, s, OpenInterval(Fraction(0), high), Fraction(0), 1, [{} for _ in terms])
        except (UndecidedSign, ZeroDivisionError, OverflowError):
            return None


def lower_bound_on_enclosure(terms: WeightedTerms, s: ca.SX, place: Enclosure) -> float | None:
    """Return a lower bound of a sum of factors times terms on a small interval; None where there is none."""
    total, ends = Fraction(0), (np.array([round_down(place[0])]), np.array([round_up(place[1])]))
    for factor, term in terms:
        low, high = (float(np.ravel(end)[0]) for end in interval_bounds.enclose(term, s, *ends))
        if not np.isfinite([low, high]).all():
            return None
        total += factor * Fraction(low if factor > 0 else high)
    return round_down(total)


def _limit_bound(
    terms: WeightedTerms, s: ca.SX, line: OpenInterval, end: Fraction | None, side: int, cases: Sequence[Cases]
) -> float:
    """A lower bound of the limit of a sum at an end of the line, by the leading terms of quotients and of what logarithms hold.

    A logarithm of c w^k e^q (1 + o(1)) is log c + k log w + q + o(1).
    """
    from flint import arb, fmpq

    smooth, number, powers = ExponentialQuotient({}, {}), arb(0), Fraction(0)
    for (factor, term), own in zip(terms, cases, strict=True):
        part = _expression_jet(term, s, line, own).value
        if part is None:
            inner = None if own else _logarithm_argument(term)
            part = None if inner is None else _expression_jet(inner, s, line, {}).value
            lead = None if part is None else _leading_quotient(part, end, side)
            if lead is None or not lead.number > 0:
                raise UndecidedSign
            q = flint_polynomial([Fraction(0), *reversed(lead.rank[1])])
            number += arb(fmpq(factor.numerator, factor.denominator)) * lead.number.log()
            powers += factor * lead.order
            part = ExponentialQuotient({UNIT_KEY: (q, flint_polynomial([Fraction(1)]))} if q else {}, {})
        smooth = add_quotients(smooth, scale_quotient(part, factor), 1)
    lead = _leading_quotient(smooth, end, side)
    if lead.tends_to == "infinity":
        if lead.number.contains(0):
            raise UndecidedSign
        return float("inf") if lead.number > 0 else -float("inf")
    if powers:
        return float("inf") if powers < 0 else -float("inf")
    return ball_lower_bound(number + (lead.number if lead.tends_to == "number" else 0)) + 0.0


def _logarithm_argument(term: ca.SX) -> ca.SX | None:
    """The w of a term log(w)."""
    op = None if term.is_constant() or term.is_symbolic() else term.op()
    return term.dep(0) if op == ca.OP_LOG else term.dep(0) + 1 if op == ca.OP_LOG1P else None


def _quotient_signs(read: Callable[[OpenInterval], ExponentialQuotient | None], line: OpenInterval) -> SignPattern | None:
    with flint_precision():
        try:
            found = read(line)
            return None if found is None else sign_pattern(found.top, line)
        except (UndecidedSign, ZeroDivisionError, OverflowError):
            return None


def _expression_jet(expr: ca.SX, s: ca.SX, line: OpenInterval, cases: Cases, strict: bool = False) -> Jet:
    """The jet of a scalar; ``strict``: UndecidedSign where an operation, of a factor 0 too, is not seen to have a derivative."""
    own = s.element_hash()
    one, zero = ExponentialQuotient(constant_sum(Fraction(1)), {}), ExponentialQuotient({}, {})

    calls = iter(range(10**9))

    def symbol(item: ca.SX) -> Jet:
        if item.element_hash() != own:
            return Jet(None, None, None)
        identity = flint_polynomial([Fraction(0), Fraction(1)]), flint_polynomial([Fraction(1)])
        return Jet(ExponentialQuotient({UNIT_KEY: identity}, {}), one, zero)

    def number(value: float) -> Jet:
        finite = abs(value) < float("inf")
        return Jet(ExponentialQuotient(constant_sum(Fraction(value)), {}), zero, zero) if finite else Jet(None, None, None)

    def apply(op: int, args: list[Jet]) -> Jet:
        case = cases.get(next(calls))
        if case is None:
            out = jet_of_operation(op, args, line)
            if strict and out.first is None:
                raise UndecidedSign
            return out
        out = Jet(ExponentialQuotient(constant_sum(case[1]), {}), zero, zero)
        for factor, jet in zip(case[0], args, strict=True):
            if factor:
                out = add_jets(out, jet, factor)
        return out

    return fold_graph(expr, symbol, number, apply)[0]
