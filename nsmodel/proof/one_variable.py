"""Functions of one variable with their first two derivatives, as far as these are quotients of exponential sums; their signs.

The derivative of a logarithm or an arctangent is such a quotient where the function itself is none: of each function, its first
and its second derivative what is known is carried along, and 0 times what is not known is 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction

import casadi as ca

from nsmodel.proof.exponential_signs import SignPattern, growth_at_infinity, leading_term, quotient_growth_rank, sign_pattern
from nsmodel.proof.exponential_sums import (
    UNIT_KEY,
    OpenInterval,
    UndecidedSign,
    ball_lower_bound,
    constant_sum,
    flint_polynomial,
    flint_precision,
)
from nsmodel.proof.graph import fold_graph
from nsmodel.proof.jets import ExponentialQuotient, Jet, add_jets, add_quotients, jet_of_operation, scale_quotient

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
