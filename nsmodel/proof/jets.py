"""Functions of one s with two derivatives, each a quotient of sums of exponentials times polynomials."""

from __future__ import annotations

from fractions import Fraction
from typing import Any, NamedTuple

import casadi as ca

from nsmodel.proof.exponential_signs import pattern
from nsmodel.proof.exponential_sums import (
    MOST_TERMS,
    ONE,
    OpenInterval,
    Sum,
    Undecided,
    added,
    coefficients,
    constant,
    poly,
    power_of,
    times,
)


class Quotient(NamedTuple):
    """N over the product of sums, each of them > 0 on the line, to powers: {name: (sum, power)}."""

    top: Sum
    bottom: dict[Any, tuple[Sum, int]]


class Jet(NamedTuple):
    """A function with its first two derivatives, each None where it is no quotient of sums."""

    value: Quotient | None
    first: Quotient | None
    second: Quotient | None


def sum_of(a: Jet, b: Jet, factor: int) -> Jet:
    """a + factor b."""
    return Jet(
        *(
            None if x is None or y is None else plus(x, scaled(y, abs(factor)), 1 if factor > 0 else -1)
            for x, y in zip(a, b, strict=True)
        )
    )


def jet_of(op: int, args: list[Jet], line: OpenInterval) -> Jet:
    """An operation on functions and their derivatives."""
    a, b = args[0], args[-1]
    if op in (ca.OP_ADD, ca.OP_SUB):
        return sum_of(a, b, 1 if op == ca.OP_ADD else -1)
    if op in (ca.OP_ASSIGN, ca.OP_NEG, ca.OP_TWICE):
        factor = {ca.OP_ASSIGN: 1, ca.OP_NEG: -1, ca.OP_TWICE: 2}[op]
        return Jet(*(None if part is None else scaled(part, factor) for part in a))
    if op in (ca.OP_MUL, ca.OP_SQ):
        return _leibniz(a, b)
    if op == ca.OP_DIV:
        return _leibniz(a, _chain(b, _outer(ca.OP_INV, b, None, line)))
    if op in (ca.OP_POW, ca.OP_CONSTPOW):
        c = None if b.value is None else _as_polynomial(b.value)
        if c is None or len(c) > 1:
            return Jet(None, None, None)
        return _chain(a, _outer(op, a, c[0] if c else Fraction(0), line))
    return _chain(a, _outer(op, a, None, line))


def _mul(a: Quotient | None, b: Quotient | None) -> Quotient | None:
    """The product; 0 times what is not known is 0."""
    for one in (a, b):
        if one is not None and not one.top:
            return one
    return None if a is None or b is None else _product(a, b)


def _add(*parts: Quotient | None) -> Quotient | None:
    total: Quotient | None = Quotient({}, {})
    for part in parts:
        total = None if total is None or part is None else plus(total, part, 1)
    return total


def _leibniz(a: Jet, b: Jet) -> Jet:
    cross = _mul(a.first, b.first)
    return Jet(
        _mul(a.value, b.value), _add(_mul(a.value, b.first), _mul(a.first, b.value)),
        _add(_mul(a.value, b.second), cross, cross, _mul(a.second, b.value)),
    )  # fmt: skip


def _chain(u: Jet, f: Jet) -> Jet:
    """f(u) from the jet of f at the value of u."""
    return Jet(f.value, _mul(f.first, u.first), _add(_mul(f.second, _mul(u.first, u.first)), _mul(f.first, u.second)))


def _outer(op: int, u: Jet, exponent: Fraction | None, line: OpenInterval) -> Jet:
    """The jet of an elementary function at the value of u."""
    nothing = Jet(None, None, None)
    x = u.value
    if x is None:
        return nothing
    one, zero = Quotient(constant(Fraction(1)), {}), Quotient({}, {})
    if op in (ca.OP_POW, ca.OP_CONSTPOW, ca.OP_SQRT, ca.OP_INV):
        p = exponent if exponent is not None else Fraction(1, 2) if op == ca.OP_SQRT else Fraction(-1)
        powers = [
            zero if not factor else _mul(Quotient(constant(factor), {}), _raised(x, p - k, line))
            for k, factor in enumerate((Fraction(1), p, p * (p - 1)))
        ]
        return Jet(*powers)
    if op in (ca.OP_EXP, ca.OP_EXPM1, ca.OP_SINH, ca.OP_COSH, ca.OP_TANH):
        return _exponential(op, x, line)
    if op in (ca.OP_LOG, ca.OP_LOG1P):
        inner = x if op == ca.OP_LOG else plus(x, one, 1)
        inside = pattern(inner.top, line)
        if inside.touches or min(inside.signs) <= 0:
            return nothing
        d = _inverse(inner, line)
        return Jet(None, d, scaled(_product(d, d), -1))
    if op in (ca.OP_ATAN, ca.OP_ASINH):
        around = plus(one, _product(x, x), 1)
        if op == ca.OP_ATAN:
            d = _inverse(around, line)
            return Jet(None, d, scaled(_product(x, _product(d, d)), -2))
        d = _raised(around, Fraction(-1, 2), line)
        cube = _raised(around, Fraction(-3, 2), line)
        return Jet(None, d, None if cube is None else scaled(_product(x, cube), -1))
    return nothing


def _exponential(op: int, x: Quotient, line: OpenInterval) -> Jet:
    """The jet of exp, or of a function made of it, at x."""
    one = Quotient(constant(Fraction(1)), {})
    if op in (ca.OP_EXP, ca.OP_EXPM1):
        e = _exp(x, 1)
        return Jet(e if op == ca.OP_EXP else plus(e, one, -1), e, e)
    if op == ca.OP_TANH:
        v = plus(one, _product(scaled(one, 2), _inverse(plus(_exp(x, 2), one, 1), line)), -1)
        d = plus(one, _product(v, v), -1)
        return Jet(v, d, scaled(_product(v, d), -2))
    both = (
        scaled(plus(_exp(x, 1), _exp(x, -1), -1), Fraction(1, 2)),
        scaled(plus(_exp(x, 1), _exp(x, -1), 1), Fraction(1, 2)),
    )
    odd, even = both if op == ca.OP_SINH else both[::-1]
    return Jet(odd, even, odd)


def scaled(a: Quotient, factor: Fraction | int) -> Quotient:
    """factor a."""
    return Quotient(times(a.top, constant(Fraction(factor))), a.bottom)


def _product(a: Quotient, b: Quotient) -> Quotient:
    bottom = dict(a.bottom)
    for name, (part, power) in b.bottom.items():
        bottom[name] = part, power + (bottom[name][1] if name in bottom else 0)
    return Quotient(times(a.top, b.top), bottom)


def plus(a: Quotient, b: Quotient, sign: int) -> Quotient:
    """a + sign b."""
    bottom = dict(a.bottom)
    for name, (part, power) in b.bottom.items():
        bottom[name] = part, max(power, bottom[name][1] if name in bottom else 0)
    tops = []
    for one in (a, b):
        top = one.top
        for name, (part, power) in bottom.items():
            for _ in range(power - (one.bottom[name][1] if name in one.bottom else 0)):
                top = times(top, part)
        tops.append(top)
    return Quotient(added(tops[0], tops[1], sign), bottom)


def _inverse(a: Quotient, line: OpenInterval) -> Quotient:
    if not a.top:
        raise Undecided
    top = constant(Fraction(1))
    for part, power in a.bottom.values():
        for _ in range(power):
            top = times(top, part)
    if len(a.top) == 1:
        return Quotient(times(top, power_of(a.top, Fraction(-1), line)), {})
    found = pattern(a.top, line)
    if found.places or found.touches or not found.signs[0]:
        raise Undecided
    part = times(a.top, constant(Fraction(found.signs[0])))
    name = frozenset((key, coefficients(n), coefficients(d)) for key, (n, d) in part.items())
    return Quotient(times(top, constant(Fraction(found.signs[0]))), {name: (part, 1)})


def _raised(a: Quotient, exponent: Fraction, line: OpenInterval) -> Quotient | None:
    if exponent.denominator == 1 and abs(exponent) <= MOST_TERMS:
        base = a if exponent >= 0 else _inverse(a, line)
        out = Quotient(constant(Fraction(1)), {})
        for _ in range(abs(int(exponent))):
            out = _product(out, base)
        return out
    if not a.top:
        return a if exponent > 0 else None
    return None if a.bottom or len(a.top) > 1 else Quotient(power_of(a.top, exponent, line), {})


def _exp(a: Quotient, factor: int) -> Quotient:
    """e^(factor a) of a polynomial."""
    c = _as_polynomial(a)
    if c is None:
        raise Undecided
    q = tuple(factor * number for number in c)
    return Quotient({((), q): (poly([Fraction(1)]),) * 2}, {})


def _as_polynomial(a: Quotient) -> tuple[Fraction, ...] | None:
    if a.bottom or set(a.top) - {ONE}:
        return None
    if not a.top:
        return ()
    top, bottom = a.top[ONE]
    return coefficients(top) if bottom.degree() == 0 else None
