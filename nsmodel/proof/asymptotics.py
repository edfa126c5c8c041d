"""How an expression of one symbol t behaves as t grows: bounds that hold for all t >= T, T = 2^k.

Each value of the graph is kept as t^p (log t)^l c with p and l rational and an interval that holds c for all t >= T. Sums are
brought to the larger order, t^q = t^p t^(q-p) with t^(q-p) in (0, T^(q-p)]; products, quotients and powers act on orders and
intervals. What grows or falls faster than all powers is kept as one of them:

    e^u >= u^k / k!  and  e^(-u) <= k! / u^k  for u >= 0.

None stands for what is not proved to be defined for all t >= T, or has no such order.

Values that grow like t^p (log t)^l at infinity, between two factors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from math import factorial
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import interval_arithmetic as arithmetic
from nsmodel.proof.exact import round_down, round_up
from nsmodel.proof.expression_graph import Instruction, Program, program
from nsmodel.proof.interval_arithmetic import IntervalPair, log
from nsmodel.proof.interval_functions import OPERATIONS, constant_power
from nsmodel.proof.verdict import not_none

# exp u >= u^m/m!, with m so large that u^m grows like t^4 at least: faster than a square. A larger m has a larger m!.
FAST_GROWTH_POWER = 4
# Powers of t and of log t; of higher ones nothing is proved. It bounds the m of u^m/m!, too: 60! = 8e81 is far from overflow.
MAX_ORDER = 60
ORDER_ROUNDING = 1e-11  # t^p with p rounded to a double is off by |p| 2^-53 log t, relatively: by 6e-13 for p = 120, t = 2^60.


class AsymptoticOrder(NamedTuple):
    """t^p (log t)^l c, low <= c <= high, for all t >= T."""

    p: Fraction
    l: Fraction
    low: float
    high: float

    @property
    def rate(self) -> tuple[Fraction | int, Fraction | int]:
        """(p, l): orders compare like these."""
        return self.p, self.l

    @property
    def sign(self) -> int:
        """1 or -1 where the value keeps that sign, else 0."""
        return int(self.low > 0) - int(self.high < 0)


ZERO_ORDER = AsymptoticOrder(Fraction(0), Fraction(0), 0.0, 0.0)  # Of what is 0.


def constant_order(low: float, high: float | None = None) -> AsymptoticOrder:
    """A value between two numbers."""
    return AsymptoticOrder(Fraction(0), Fraction(0), low, low if high is None else high)


def coefficient_interval(value: AsymptoticOrder) -> IntervalPair:
    """The interval of c."""
    return np.array([value.low]), np.array([value.high])


def make_order(p: Fraction, l: Fraction, ends: IntervalPair) -> AsymptoticOrder | None:
    """The order with c between two ends; None where powers are too high to be followed."""
    low, high = float(ends[0][0]), float(ends[1][0])
    if max(abs(p), abs(l)) > MAX_ORDER:
        return None
    return ZERO_ORDER if low == high == 0 else AsymptoticOrder(p, l, low, high)


def _decaying_factor_interval(p: Fraction, l: Fraction, k: int) -> IntervalPair | None:
    """The interval of t^p (log t)^l for t >= 2^k where it is bounded: p < 0, or p = 0 and l <= 0; None where it is not known.

    Its logarithm p s + l log s, s = log t, has the derivative p + l/s, which is not above 0 for s >= s_0 if p s_0 + l <= 0.
    """
    T = np.array([2.0**k])
    s = log((T, T))
    if p > 0 or p * Fraction(float(s[0][0])) + l > 0:
        return None
    if not p and not l:
        return arithmetic.ONE
    power = constant_power((T, T), float(p)) if p else arithmetic.ONE
    factor = constant_power(s, float(l)) if l else arithmetic.ONE
    return np.zeros(1), arithmetic.widen_up(arithmetic.mul(power, factor)[1], ORDER_ROUNDING)


@np.errstate(all="ignore")
def value_interval(value: AsymptoticOrder, k: int) -> IntervalPair:
    """The interval of the values themselves."""
    share = _decaying_factor_interval(value.p, value.l, k)
    if share is not None:
        return arithmetic.mul(coefficient_interval(value), share)
    inverse = _decaying_factor_interval(-value.p, -value.l, k)
    if inverse is None:
        return (np.array([0.0 if value.low >= 0 else -np.inf]), np.array([0.0 if value.high <= 0 else np.inf]))
    least = arithmetic.inv(inverse)[0]
    return arithmetic.mul(coefficient_interval(value), (np.maximum(least, 0.0), np.array([np.inf])))


@np.errstate(all="ignore")
def add_orders(a: AsymptoticOrder | None, b: AsymptoticOrder | None, k: int) -> AsymptoticOrder | None:
    """The order of the sum of two terms."""
    both = bring_to_common_order(a, b, k)
    return both and make_order(both[0], both[1], arithmetic.add(both[2], both[3]))


@np.errstate(all="ignore")
def multiply_orders(a: AsymptoticOrder | None, b: AsymptoticOrder | None) -> AsymptoticOrder | None:
    """The order of the product of two terms."""
    if a is None or b is None:
        return None
    return make_order(a.p + b.p, a.l + b.l, arithmetic.mul(coefficient_interval(a), coefficient_interval(b)))


def bring_to_common_order(
    a: AsymptoticOrder | None, b: AsymptoticOrder | None, k: int
) -> tuple[Fraction, Fraction, IntervalPair, IntervalPair] | None:
    """Both with one order, the larger one."""
    if a is None or b is None:
        return None
    if a == ZERO_ORDER or b == ZERO_ORDER:
        large = b if a == ZERO_ORDER else a
        return large.p, large.l, coefficient_interval(a), coefficient_interval(b)
    large = max(a, b, key=lambda value: value.rate)
    parts = []
    for value in (a, b):
        share = _decaying_factor_interval(value.p - large.p, value.l - large.l, k)
        if share is None:
            return None
        parts.append(arithmetic.mul(coefficient_interval(value), share))
    return large.p, large.l, parts[0], parts[1]


# Estimates hold for t >= 2^k with one of these k: a later start proves more where terms that die out have large factors.
START_EXPONENTS = (6, 20, 60)


def asymptotic_orders(expr: ca.SX, z: ca.SX, inputs: Sequence[AsymptoticOrder | None], k: int) -> list[AsymptoticOrder | None]:
    """The order of each entry of ``expr`` for t >= 2^k, where the symbols z (n, 1) have the orders ``inputs``."""
    return propagate_orders(program(expr, z), inputs, k)


def propagate_orders(code: Program, inputs: Sequence[AsymptoticOrder | None], k: int) -> list[AsymptoticOrder | None]:
    """The orders of the outputs of a program."""
    values: list[AsymptoticOrder | None] = []
    with np.errstate(all="ignore"):
        for step in code.steps:
            if step.op == ca.OP_INPUT:
                values.append(inputs[step.slot])
            elif step.op == ca.OP_CONST:
                values.append(constant_order(step.number) if np.isfinite(step.number) else None)
            else:
                softplus = _softplus_order(step, code.steps, values, k)
                values.append(softplus or _operation_order(step.op, [values[j] for j in step.sources], k))
    return [values[j] for j in code.outputs]


@np.errstate(all="ignore")
def polynomial_order(coefficients: Sequence[Fraction | float], k: int) -> AsymptoticOrder:
    """The order of a polynomial in t."""
    total = ZERO_ORDER
    for power, number in enumerate(coefficients):
        if number:
            total = not_none(
                add_orders(
                    total,
                    AsymptoticOrder(Fraction(power), Fraction(0), round_down(Fraction(number)), round_up(Fraction(number))),
                    k,
                )
            )
    return total


# -- operations --------------------------------------------------------------------------------------------------------


def _operation_order(op: int, args: list[AsymptoticOrder | None], k: int) -> AsymptoticOrder | None:
    if op == ca.OP_IF_ELSE_ZERO:
        return _if_else_zero_order(args, k)
    known = [arg for arg in args if arg is not None]
    if len(known) < len(args):
        return None
    rule = _ORDER_RULES.get(op)
    return rule(k, *known) if rule is not None else _order_from_intervals(op, known, k)


def _order_from_intervals(op: int, args: list[AsymptoticOrder], k: int) -> AsymptoticOrder | None:
    """By the intervals of the arguments themselves, where the operation is proved to be defined on them."""
    if op not in OPERATIONS:
        return None
    operation, pairs = OPERATIONS[op], [value_interval(arg, k) for arg in args]
    result = operation.bounds(*pairs)
    defined = operation.jumps or operation.continuous is None or bool(np.all(operation.continuous(result, *pairs)))
    inside = op not in (ca.OP_SQRT, ca.OP_ASIN, ca.OP_ACOS, ca.OP_ACOSH) or _is_in_domain(op, pairs[0])
    return make_order(Fraction(0), Fraction(0), result) if defined and inside else None


def _is_in_domain(op: int, x: IntervalPair) -> bool:
    low, high = {ca.OP_SQRT: (0.0, np.inf), ca.OP_ACOSH: (1.0, np.inf)}.get(op, (-1.0, 1.0))
    return bool(x[0][0] >= low and x[1][0] <= high)


def _negated_order(k: int, a: AsymptoticOrder) -> AsymptoticOrder | None:
    return make_order(a.p, a.l, arithmetic.neg(coefficient_interval(a)))


def _quotient_order(k: int, a: AsymptoticOrder, b: AsymptoticOrder) -> AsymptoticOrder | None:
    if not b.sign:
        return None
    return make_order(a.p - b.p, a.l - b.l, arithmetic.div(coefficient_interval(a), coefficient_interval(b)))


def _power_order(k: int, a: AsymptoticOrder, b: AsymptoticOrder) -> AsymptoticOrder | None:
    if b.low != b.high or b.rate != (0, 0):
        return _order_from_intervals(ca.OP_POW, [a, b], k)
    c = Fraction(b.low)
    if (c.denominator != 1 and a.low < 0) or (c < 0 and not a.sign) or (c.denominator != 1 and c <= 0 and a.low <= 0):
        return None
    return (
        make_order(c * a.p, c * a.l, constant_power(coefficient_interval(a), b.low))
        if a != ZERO_ORDER
        else (ZERO_ORDER if c > 0 else None)
    )


def _square_order(k: int, a: AsymptoticOrder) -> AsymptoticOrder | None:
    return make_order(2 * a.p, 2 * a.l, arithmetic.square(coefficient_interval(a)))


def _sqrt_order(k: int, a: AsymptoticOrder) -> AsymptoticOrder | None:
    return make_order(a.p / 2, a.l / 2, arithmetic.square_root(coefficient_interval(a))) if a.low >= 0 else None


def _hypot_order(k: int, a: AsymptoticOrder, b: AsymptoticOrder) -> AsymptoticOrder | None:
    squares = _square_order(k, a), _square_order(k, b)
    total = add_orders(*squares, k)
    return None if total is None else _sqrt_order(k, total._replace(low=max(total.low, 0.0)))


def _max_order(k: int, a: AsymptoticOrder, b: AsymptoticOrder, smaller: bool = False) -> AsymptoticOrder | None:
    both = bring_to_common_order(a, b, k)
    if both is None:
        return None
    gap = arithmetic.sub(both[2], both[3])
    if gap[0][0] >= 0 or gap[1][0] <= 0:
        return a if (gap[0][0] >= 0) != smaller else b
    pick = np.minimum if smaller else np.maximum
    return make_order(both[0], both[1], (pick(both[2][0], both[3][0]), pick(both[2][1], both[3][1])))


def _rounding_rule(op: int) -> Callable[[int, AsymptoticOrder], AsymptoticOrder | None]:
    """floor and ceil: the argument and a part of a unit, the value itself where that is bounded."""

    def rule(k: int, a: AsymptoticOrder) -> AsymptoticOrder | None:
        if a.rate <= (0, 0):
            return _order_from_intervals(op, [a], k)
        return add_orders(a, constant_order(-1.0, 0.0) if op == ca.OP_FLOOR else constant_order(0.0, 1.0), k)

    return rule


def _tends_to_infinity(a: AsymptoticOrder) -> bool:
    """Whether |a| grows without end like a power of t."""
    return a.p > 0 and a.l >= 0 and bool(a.sign)


def _series_power(a: AsymptoticOrder) -> int:
    return int(np.ceil(FAST_GROWTH_POWER / float(a.p))) if a.p * MAX_ORDER > FAST_GROWTH_POWER else 0


def _exp_order(k: int, a: AsymptoticOrder) -> AsymptoticOrder | None:
    m = _series_power(a) if _tends_to_infinity(a) else 0
    if not m:
        return _order_from_intervals(ca.OP_EXP, [a], k)
    size = a if a.sign > 0 else AsymptoticOrder(a.p, a.l, -a.high, -a.low)
    low = constant_power((np.array([size.low]), np.array([size.low])), float(m))
    least = arithmetic.div(low, arithmetic.point_interval(float(factorial(m))))[0]
    if a.sign > 0:
        return make_order(m * a.p, m * a.l, (least, np.array([np.inf])))
    return make_order(-m * a.p, -m * a.l, (np.zeros(1), arithmetic.inv((least, least))[1])) if least[0] > 0 else None


def _expm1_order(k: int, a: AsymptoticOrder) -> AsymptoticOrder | None:
    return add_orders(_exp_order(k, a), constant_order(-1.0), k)


def _hyperbolic_rule(op: int) -> Callable[[int, AsymptoticOrder], AsymptoticOrder | None]:
    """sinh u >= u^m/m! for u >= 0 and odd m, cosh u >= u^m/m! for even m."""

    def rule(k: int, a: AsymptoticOrder) -> AsymptoticOrder | None:
        m = _series_power(a) if _tends_to_infinity(a) else 0
        if not m:
            return _order_from_intervals(op, [a], k)
        m += (m + (op == ca.OP_SINH)) % 2
        size = a.low if a.sign > 0 else -a.high
        least = arithmetic.div(
            constant_power(arithmetic.point_interval(size), float(m)), arithmetic.point_interval(float(factorial(m)))
        )[0]
        grown = make_order(m * a.p, m * a.l, (least, np.array([np.inf])))
        return grown if grown is None or a.sign > 0 or op == ca.OP_COSH else _negated_order(k, grown)

    return rule


def _log_order(k: int, a: AsymptoticOrder) -> AsymptoticOrder | None:
    """log(t^p s^l c) = s (p + l log(s)/s + log(c)/s), s = log t; log(s)/s falls for s >= e, to 0."""
    if not (a.p > 0 and a.low > 0 and k >= 4):
        return _order_from_intervals(ca.OP_LOG, [a], k)
    T = arithmetic.point_interval(2.0**k)
    s = log(T)
    zero_to = lambda top: (np.zeros(1), np.maximum(top, 0.0))  # noqa: E731
    ratio = arithmetic.div(log(s), s)
    total = arithmetic.add(
        _fraction_interval(a.p),
        arithmetic.add(
            arithmetic.mul(_fraction_interval(a.l), zero_to(ratio[1])),
            arithmetic.mul(log(coefficient_interval(a)), zero_to(arithmetic.inv(s)[1])),
        ),
    )
    return make_order(Fraction(0), Fraction(1), total)


def _fraction_interval(number: Fraction) -> IntervalPair:
    return np.array([np.nextafter(float(number), -np.inf)]), np.array([np.nextafter(float(number), np.inf)])


def _softplus_order(
    step: Instruction, steps: Sequence[Instruction], values: Sequence[AsymptoticOrder | None], k: int
) -> AsymptoticOrder | None:
    """log(c + e^u) = max(u, log c) + a number of [0, log 2], c > 0: no power of t bounds e^u."""
    if step.op == ca.OP_LOG1P:
        c, inner = 1.0, steps[step.sources[0]]
        node = inner if inner.op == ca.OP_EXP else None
    elif step.op == ca.OP_LOG and steps[step.sources[0]].op == ca.OP_ADD:
        parts = [steps[j] for j in steps[step.sources[0]].sources]
        numbers, nodes = [part for part in parts if part.op == ca.OP_CONST], [part for part in parts if part.op == ca.OP_EXP]
        c, node = (numbers[0].number, nodes[0]) if numbers and nodes else (0.0, None)
    else:
        return None
    u = values[node.sources[0]] if node is not None else None
    if u is None or not c > 0 or not _tends_to_infinity(u):
        return None
    least = log(arithmetic.point_interval(c))
    top = _max_order(k, u, constant_order(float(least[0][0]), float(least[1][0])))
    return add_orders(top, constant_order(0.0, 0.6931471805599454), k) if top is not None else None


def _if_else_zero_order(args: list[AsymptoticOrder | None], k: int) -> AsymptoticOrder | None:
    condition, value = args
    if condition is None:
        return None
    low, high = value_interval(condition, k)
    if low[0] == high[0] == 0:
        return ZERO_ORDER
    if value is None or low[0] > 0 or high[0] < 0:
        return value
    return make_order(value.p, value.l, (np.minimum(value.low, 0.0).reshape(1), np.maximum(value.high, 0.0).reshape(1)))


def _comparison_rule(op: int) -> Callable[[int, AsymptoticOrder, AsymptoticOrder], AsymptoticOrder | None]:
    def rule(k: int, a: AsymptoticOrder, b: AsymptoticOrder) -> AsymptoticOrder | None:
        other = _negated_order(k, b)
        gap = add_orders(a, other, k)
        if gap is not None and gap.sign:
            true = {ca.OP_LT: gap.sign < 0, ca.OP_LE: gap.sign < 0, ca.OP_EQ: False, ca.OP_NE: True}[op]
            return constant_order(float(true))
        return _order_from_intervals(op, [a, b], k)

    return rule


_ORDER_RULES: dict[int, Callable[..., AsymptoticOrder | None]] = {
    ca.OP_ASSIGN: lambda k, a: a,
    ca.OP_ADD: lambda k, a, b: add_orders(a, b, k),
    ca.OP_SUB: lambda k, a, b: add_orders(a, _negated_order(k, b), k),
    ca.OP_MUL: lambda k, a, b: multiply_orders(a, b),
    ca.OP_DIV: _quotient_order,
    ca.OP_INV: lambda k, a: _quotient_order(k, constant_order(1.0), a),
    ca.OP_NEG: _negated_order,
    ca.OP_TWICE: lambda k, a: multiply_orders(a, constant_order(2.0)),
    ca.OP_SQ: _square_order,
    ca.OP_SQRT: _sqrt_order,
    ca.OP_POW: _power_order,
    ca.OP_CONSTPOW: _power_order,
    ca.OP_FABS: lambda k, a: make_order(a.p, a.l, arithmetic.magnitude(coefficient_interval(a))),
    ca.OP_SIGN: lambda k, a: constant_order(float(a.sign)) if a.sign or a == ZERO_ORDER else constant_order(-1.0, 1.0),
    ca.OP_HYPOT: _hypot_order,
    ca.OP_FMAX: _max_order,
    ca.OP_FMIN: lambda k, a, b: _max_order(k, a, b, smaller=True),
    ca.OP_FLOOR: _rounding_rule(ca.OP_FLOOR),
    ca.OP_CEIL: _rounding_rule(ca.OP_CEIL),
    ca.OP_EXP: _exp_order,
    ca.OP_EXPM1: _expm1_order,
    ca.OP_SINH: _hyperbolic_rule(ca.OP_SINH),
    ca.OP_COSH: _hyperbolic_rule(ca.OP_COSH),
    ca.OP_LOG: _log_order,
    ca.OP_LOG1P: lambda k, a: (total := add_orders(a, constant_order(1.0), k)) and _log_order(k, total),
    **{op: _comparison_rule(op) for op in (ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE)},
}
