"""Functions of one variable with their first two derivatives, as far as these are quotients of exponential sums; their signs.

The derivative of a logarithm or an arctangent is such a quotient where the function itself is none: of each function, its first
and its second derivative what is known is carried along, and 0 times what is not known is 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction

import casadi as ca

from nsmodel.proof.exponential_signs import Signs, growth_of, leading, pattern, rank_of_quotient
from nsmodel.proof.exponential_sums import (
    ONE,
    OpenInterval,
    Undecided,
    constant,
    lower_end,
    poly,
    precision,
)
from nsmodel.proof.graph import fold
from nsmodel.proof.jets import Jet, Quotient, jet_of, plus, scaled, sum_of

Cases = dict[int, tuple[tuple[int, ...], Fraction]]  # number of an operation in the graph: factors of its arguments, offset


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
            out = plus(out, scaled(part, factor), 1)
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
                    total = plus(total, scaled(part, factor), 1)
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
            return jet_of(op, args, line)
        out = Jet(Quotient(constant(case[1]), {}), zero, zero)
        for factor, jet in zip(case[0], args, strict=True):
            if factor:
                out = sum_of(out, jet, factor)
        return out

    return fold(expr, symbol, number, apply)[0]
