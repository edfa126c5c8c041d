"""Functions of one variable with their first two derivatives, as far as these are quotients of exponential sums; their signs.

The derivative of a logarithm or an arctangent is such a quotient where the function itself is none: of each function, its first
and its second derivative what is known is carried along, and 0 times what is not known is 0.

Functions of one s with two derivatives, each a quotient of sums of exponentials times polynomials.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import casadi as ca

from nsmodel.proof.exponential_sums import (
    MAX_SUM_TERMS,
    UNIT_KEY,
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
    growth_at_infinity,
    leading_term,
    multiply_sums,
    power_of_term,
    quotient_growth_rank,
    sign_pattern,
)
from nsmodel.proof.expression_graph import fold_graph


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
    """a + factor b."""
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
    """factor a."""
    return ExponentialQuotient(multiply_sums(a.top, constant_sum(Fraction(factor))), a.bottom)


def _multiply_quotients(a: ExponentialQuotient, b: ExponentialQuotient) -> ExponentialQuotient:
    bottom = dict(a.bottom)
    for name, (part, power) in b.bottom.items():
        bottom[name] = part, power + (bottom[name][1] if name in bottom else 0)
    return ExponentialQuotient(multiply_sums(a.top, b.top), bottom)


def add_quotients(a: ExponentialQuotient, b: ExponentialQuotient, sign: int) -> ExponentialQuotient:
    """a + sign b."""
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


Cases = dict[int, tuple[tuple[int, ...], Fraction]]  # number of an operation in the graph: factors of its arguments, offset


def decide_signs(expr: ca.SX, s: ca.SX, low: Fraction = Fraction(0), high: Fraction | None = None) -> SignPattern | None:
    """Return the signs of a scalar on the open interval (low, high), None where they are not decided.

    >>> s = ca.SX.sym("s")
    >>> decide_signs(ca.exp(s) - s - 1, s).signs, decide_signs(s * ca.tanh(s) - s / 2, s).signs
    ([1], [-1, 1])
    """
    return _quotient_signs(lambda line: _expression_jet(expr, s, line, {}).value, OpenInterval(low, high))


def second_derivative_signs(
    terms: Sequence[tuple[Fraction, ca.SX]],
    s: ca.SX,
    low: Fraction,
    high: Fraction | None,
    cases: Sequence[Cases],
    less: Fraction,
) -> SignPattern | None:
    """Return the signs of f'' - ``less`` for a sum f of factors times terms, None where they are not decided.

    Each fabs, fmax, fmin and condition is replaced by its case on the interval, which ``cases`` holds for each term.
    """

    def total(line: OpenInterval) -> ExponentialQuotient | None:
        out = ExponentialQuotient(constant_sum(-less), {})
        for (factor, term), own in zip(terms, cases, strict=True):
            part = _expression_jet(term, s, line, own).second
            if part is None:
                return None
            out = add_quotients(out, scale_quotient(part, factor), 1)
        return out

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
                order, number = leading_term(found.top, low, 1)
                for part, power in found.bottom.values():
                    k, lead = leading_term(part, low, 1)
                    if k or lead.contains(0):
                        return None
                    number /= lead**power
                if order < 0:
                    return None
                number = arb(0) if order > 0 else number
                return ball_lower_bound(number), -ball_lower_bound(-number) + 0.0
            except UndecidedSign:  # a sign changes too near
                high = low + (high - low) / 8
            except (ZeroDivisionError, OverflowError):
                return None
    return None


def tends_to_minus_infinity(terms: Sequence[tuple[Fraction, ca.SX]], s: ca.SX, low: Fraction, cases: Sequence[Cases]) -> bool:
    """Whether a sum of factors times terms is proved to tend to -inf: its derivative stays below -c/s, c > 0, for large s."""
    line = OpenInterval(max(low, Fraction(0)) + 1)
    with flint_precision():
        for _ in range(8):
            try:
                total = ExponentialQuotient({}, {})
                for (factor, term), own in zip(terms, cases, strict=True):
                    part = _expression_jet(term, s, line, own).first
                    if part is None:
                        return False
                    total = add_quotients(total, scale_quotient(part, factor), 1)
                (rank, order), number = growth_at_infinity(total.top)
                for part, power in total.bottom.values():
                    (own_rank, own_order), own_number = growth_at_infinity(part)
                    if own_number.contains(0):
                        return False
                    rank, order, number = (
                        quotient_growth_rank(rank, own_rank, power),
                        order - own_order * power,
                        number / own_number**power,
                    )
                return bool(number < 0) and (rank > (0, ()) or (rank == (0, ()) and order >= -1))
            except UndecidedSign:  # a sign changes further out
                line = OpenInterval(8 * line.low)
            except (ZeroDivisionError, OverflowError):
                return False
    return False


def _quotient_signs(read: Callable[[OpenInterval], ExponentialQuotient | None], line: OpenInterval) -> SignPattern | None:
    with flint_precision():
        try:
            found = read(line)
            return None if found is None else sign_pattern(found.top, line)
        except (UndecidedSign, ZeroDivisionError, OverflowError):
            return None


def _expression_jet(expr: ca.SX, s: ca.SX, line: OpenInterval, cases: Cases) -> Jet:
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
            return jet_of_operation(op, args, line)
        out = Jet(ExponentialQuotient(constant_sum(case[1]), {}), zero, zero)
        for factor, jet in zip(case[0], args, strict=True):
            if factor:
                out = add_jets(out, jet, factor)
        return out

    return fold_graph(expr, symbol, number, apply)[0]
