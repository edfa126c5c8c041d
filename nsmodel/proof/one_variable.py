"""Functions of one variable with their first two derivatives, as far as these are quotients of exponential sums; their signs.

The derivative of a logarithm or an arctangent is such a quotient where the function itself is none: of each function, its first
and its second derivative what is known is carried along, and 0 times what is not known is 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import casadi as ca

from nsmodel.proof.exponential_sums import (
    MOST_TERMS,
    ONE,
    OpenInterval,
    Signs,
    Sum,
    Undecided,
    added,
    coefficients,
    constant,
    growth_of,
    leading,
    lower_end,
    pattern,
    poly,
    power_of,
    precision,
    rank_of_quotient,
    times,
)  # fmt: skip
from nsmodel.proof.graph import fold

Cases = dict[int, tuple[tuple[int, ...], Fraction]]  # number of an operation in the graph: factors of its arguments, offset


class Quotient(NamedTuple):
    """N over the product of sums, each of them > 0 on the line, to powers: {name: (sum, power)}."""

    top: Sum
    bottom: dict[Any, tuple[Sum, int]]


def signs(expr: ca.SX, s: ca.SX, low: Fraction = Fraction(0), high: Fraction | None = None) -> Signs | None:
    """Return the signs of a scalar on the open interval (low, high), None where they are not decided.

    >>> s = ca.SX.sym("s")
    >>> signs(ca.exp(s) - s - 1, s).signs, signs(s * ca.tanh(s) - s / 2, s).signs
    ([1], [-1, 1])
    """
    return _decided(lambda line: _read(expr, s, line, {}).value, OpenInterval(low, high))


def second_signs(
    terms: Sequence[tuple[Fraction, ca.SX]],
    s: ca.SX,
    low: Fraction,
    high: Fraction | None,
    cases: Sequence[Cases],
    less: Fraction,
) -> Signs | None:
    """Return the signs of f'' - ``less`` for a sum f of factors times terms, None where they are not decided.

    Each fabs, fmax, fmin and condition is replaced by its case on the interval, which ``cases`` holds for each term.
    """

    def total(line: OpenInterval) -> Quotient | None:
        out = Quotient(constant(-less), {})
        for (factor, term), own in zip(terms, cases, strict=True):
            part = _read(term, s, line, own).second
            if part is None:
                return None
            out = _plus(out, _scaled(part, factor), 1)
        return out

    return _decided(total, OpenInterval(low, high))


def is_smooth(term: ca.SX, s: ca.SX, low: Fraction, high: Fraction | None, cases: Cases) -> bool:
    """Whether a term is seen to have two continuous derivatives on the open interval, and these are quotients of sums."""
    with precision():
        try:
            return _read(term, s, OpenInterval(low, high), cases).second is not None
        except (Undecided, ZeroDivisionError, OverflowError):
            return False


def slope_at_start(term: ca.SX, s: ca.SX, low: Fraction, cases: Cases) -> tuple[float, float] | None:
    """Bounds of the limit of the derivative at ``low`` from the right; None where it is not found or infinite."""
    from flint import arb

    high = low + 1
    with precision():
        for _ in range(20):
            try:
                found = _read(term, s, OpenInterval(low, high), cases).first
                if found is None:
                    return None
                order, number = leading(found.top, low, 1)
                for part, power in found.bottom.values():
                    k, lead = leading(part, low, 1)
                    if k or lead.contains(0):
                        return None
                    number /= lead**power
                if order < 0:
                    return None
                number = arb(0) if order > 0 else number
                return lower_end(number), -lower_end(-number) + 0.0
            except Undecided:  # a sign changes too near
                high = low + (high - low) / 8
            except (ZeroDivisionError, OverflowError):
                return None
    return None


def falls_without_end(terms: Sequence[tuple[Fraction, ca.SX]], s: ca.SX, low: Fraction, cases: Sequence[Cases]) -> bool:
    """Whether a sum of factors times terms is proved to tend to -inf: its derivative stays below -c/s, c > 0, for large s."""
    line = OpenInterval(max(low, Fraction(0)) + 1)
    with precision():
        for _ in range(8):
            try:
                total = Quotient({}, {})
                for (factor, term), own in zip(terms, cases, strict=True):
                    part = _read(term, s, line, own).first
                    if part is None:
                        return False
                    total = _plus(total, _scaled(part, factor), 1)
                (rank, order), number = growth_of(total.top)
                for part, power in total.bottom.values():
                    (own_rank, own_order), own_number = growth_of(part)
                    if own_number.contains(0):
                        return False
                    rank, order, number = (
                        rank_of_quotient(rank, own_rank, power),
                        order - own_order * power,
                        number / own_number**power,
                    )
                return bool(number < 0) and (rank > (0, ()) or (rank == (0, ()) and order >= -1))
            except Undecided:  # a sign changes further out
                line = OpenInterval(8 * line.low)
            except (ZeroDivisionError, OverflowError):
                return False
    return False


def _decided(read: Callable[[OpenInterval], Quotient | None], line: OpenInterval) -> Signs | None:
    with precision():
        try:
            found = read(line)
            return None if found is None else pattern(found.top, line)
        except (Undecided, ZeroDivisionError, OverflowError):
            return None


# -- quotients ---------------------------------------------------------------------------------------------------------


class Jet(NamedTuple):
    """A function with its first two derivatives, each None where it is no quotient of sums."""

    value: Quotient | None
    first: Quotient | None
    second: Quotient | None


def _read(expr: ca.SX, s: ca.SX, line: OpenInterval, cases: Cases) -> Jet:
    own = s.element_hash()
    one, zero = Quotient(constant(Fraction(1)), {}), Quotient({}, {})

    calls = iter(range(10**9))

    def symbol(item: ca.SX) -> Jet:
        if item.element_hash() != own:
            return Jet(None, None, None)
        identity = poly([Fraction(0), Fraction(1)]), poly([Fraction(1)])
        return Jet(Quotient({ONE: identity}, {}), one, zero)

    def number(value: float) -> Jet:
        finite = abs(value) < float("inf")
        return Jet(Quotient(constant(Fraction(value)), {}), zero, zero) if finite else Jet(None, None, None)

    def apply(op: int, args: list[Jet]) -> Jet:
        case = cases.get(next(calls))
        if case is None:
            return _jet(op, args, line)
        out = Jet(Quotient(constant(case[1]), {}), zero, zero)
        for factor, jet in zip(case[0], args, strict=True):
            if factor:
                out = _sum(out, jet, factor)
        return out

    return fold(expr, symbol, number, apply)[0]


def _sum(a: Jet, b: Jet, factor: int) -> Jet:
    return Jet(
        *(
            None if x is None or y is None else _plus(x, _scaled(y, abs(factor)), 1 if factor > 0 else -1)
            for x, y in zip(a, b, strict=True)
        )
    )


def _jet(op: int, args: list[Jet], line: OpenInterval) -> Jet:
    """An operation on functions and their derivatives."""
    a, b = args[0], args[-1]
    if op in (ca.OP_ADD, ca.OP_SUB):
        return _sum(a, b, 1 if op == ca.OP_ADD else -1)
    if op in (ca.OP_ASSIGN, ca.OP_NEG, ca.OP_TWICE):
        factor = {ca.OP_ASSIGN: 1, ca.OP_NEG: -1, ca.OP_TWICE: 2}[op]
        return Jet(*(None if part is None else _scaled(part, factor) for part in a))
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
        total = None if total is None or part is None else _plus(total, part, 1)
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
    if op in (ca.OP_EXP, ca.OP_EXPM1):
        e = _exp(x, 1)
        return Jet(e if op == ca.OP_EXP else _plus(e, one, -1), e, e)
    if op in (ca.OP_SINH, ca.OP_COSH):
        both = (
            _scaled(_plus(_exp(x, 1), _exp(x, -1), -1), Fraction(1, 2)),
            _scaled(_plus(_exp(x, 1), _exp(x, -1), 1), Fraction(1, 2)),
        )
        odd, even = both if op == ca.OP_SINH else both[::-1]
        return Jet(odd, even, odd)
    if op == ca.OP_TANH:
        v = _plus(one, _product(_scaled(one, 2), _inverse(_plus(_exp(x, 2), one, 1), line)), -1)
        d = _plus(one, _product(v, v), -1)
        return Jet(v, d, _scaled(_product(v, d), -2))
    if op in (ca.OP_LOG, ca.OP_LOG1P):
        inner = x if op == ca.OP_LOG else _plus(x, one, 1)
        inside = pattern(inner.top, line)
        if inside.touches or min(inside.signs) <= 0:
            return nothing
        d = _inverse(inner, line)
        return Jet(None, d, _scaled(_product(d, d), -1))
    if op in (ca.OP_ATAN, ca.OP_ASINH):
        around = _plus(one, _product(x, x), 1)
        if op == ca.OP_ATAN:
            d = _inverse(around, line)
            return Jet(None, d, _scaled(_product(x, _product(d, d)), -2))
        d = _raised(around, Fraction(-1, 2), line)
        cube = _raised(around, Fraction(-3, 2), line)
        return Jet(None, d, None if cube is None else _scaled(_product(x, cube), -1))
    return nothing


def _scaled(a: Quotient, factor: Fraction | int) -> Quotient:
    return Quotient(times(a.top, constant(Fraction(factor))), a.bottom)


def _product(a: Quotient, b: Quotient) -> Quotient:
    bottom = dict(a.bottom)
    for name, (part, power) in b.bottom.items():
        bottom[name] = part, power + (bottom[name][1] if name in bottom else 0)
    return Quotient(times(a.top, b.top), bottom)


def _plus(a: Quotient, b: Quotient, sign: int) -> Quotient:
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
