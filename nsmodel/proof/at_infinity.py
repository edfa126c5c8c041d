"""How an expression of one symbol t behaves as t grows: bounds that hold for all t >= T, T = 2^k.

Each value of the graph is kept as t^p (log t)^l c with p and l rational and an interval that holds c for all t >= T. Sums are
brought to the larger order, t^q = t^p t^(q-p) with t^(q-p) in (0, T^(q-p)]; products, quotients and powers act on orders and
intervals. What grows or falls faster than all powers is kept as one of them:

    e^u >= u^k / k!  and  e^(-u) <= k! / u^k  for u >= 0.

None stands for what is not proved to be defined for all t >= T, or has no such order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from math import factorial

import casadi as ca
import numpy as np

from nsmodel.proof import interval_arithmetic as arithmetic
from nsmodel.proof.exact import down, up
from nsmodel.proof.interval_arithmetic import Pair
from nsmodel.proof.interval_functions import OPERATIONS, constant_power
from nsmodel.proof.interval_library import log
from nsmodel.proof.orders import FAST, MOST, ZERO, Asymptotic, constant, natural, order_of, pair, plus, times, together
from nsmodel.proof.straight_line import Program, Step, program
from nsmodel.proof.sure import sure

STARTS = (6, 20, 60)  # T = 2^k.


def orders(expr: ca.SX, z: ca.SX, inputs: Sequence[Asymptotic | None], k: int) -> list[Asymptotic | None]:
    """The order of each entry of ``expr`` for t >= 2^k, where the symbols z (n, 1) have the orders ``inputs``."""
    return run(program(expr, z), inputs, k)


def run(code: Program, inputs: Sequence[Asymptotic | None], k: int) -> list[Asymptotic | None]:
    """The orders of the outputs of a program."""
    values: list[Asymptotic | None] = []
    with np.errstate(all="ignore"):
        for step in code.steps:
            if step.op == ca.OP_INPUT:
                values.append(inputs[step.slot])
            elif step.op == ca.OP_CONST:
                values.append(constant(step.number) if np.isfinite(step.number) else None)
            else:
                softplus = _softplus(step, code.steps, values, k)
                values.append(softplus or _applied(step.op, [values[j] for j in step.sources], k))
    return [values[j] for j in code.outputs]


@np.errstate(all="ignore")
def curve(coefficients: Sequence[Fraction | float], k: int) -> Asymptotic:
    """The order of a polynomial in t."""
    total = ZERO
    for power, number in enumerate(coefficients):
        if number:
            total = sure(plus(total, Asymptotic(Fraction(power), Fraction(0), down(Fraction(number)), up(Fraction(number))), k))
    return total


# -- operations --------------------------------------------------------------------------------------------------------


def _applied(op: int, args: list[Asymptotic | None], k: int) -> Asymptotic | None:
    if op == ca.OP_IF_ELSE_ZERO:
        return _chosen(args, k)
    known = [arg for arg in args if arg is not None]
    if len(known) < len(args):
        return None
    rule = _RULES.get(op)
    return rule(k, *known) if rule is not None else _plain(op, known, k)


def _plain(op: int, args: list[Asymptotic], k: int) -> Asymptotic | None:
    """By the intervals of the arguments themselves, where the operation is proved to be defined on them."""
    if op not in OPERATIONS:
        return None
    operation, pairs = OPERATIONS[op], [natural(arg, k) for arg in args]
    result = operation.bounds(*pairs)
    defined = operation.jumps or operation.continuous is None or bool(np.all(operation.continuous(result, *pairs)))
    inside = op not in (ca.OP_SQRT, ca.OP_ASIN, ca.OP_ACOS, ca.OP_ACOSH) or _inside(op, pairs[0])
    return order_of(Fraction(0), Fraction(0), result) if defined and inside else None


def _inside(op: int, x: Pair) -> bool:
    low, high = {ca.OP_SQRT: (0.0, np.inf), ca.OP_ACOSH: (1.0, np.inf)}.get(op, (-1.0, 1.0))
    return bool(x[0][0] >= low and x[1][0] <= high)


def _negated(k: int, a: Asymptotic) -> Asymptotic | None:
    return order_of(a.p, a.l, arithmetic.neg(pair(a)))


def _divided(k: int, a: Asymptotic, b: Asymptotic) -> Asymptotic | None:
    if not b.sign:
        return None
    return order_of(a.p - b.p, a.l - b.l, arithmetic.div(pair(a), pair(b)))


def _power(k: int, a: Asymptotic, b: Asymptotic) -> Asymptotic | None:
    if b.low != b.high or b.rate != (0, 0):
        return _plain(ca.OP_POW, [a, b], k)
    c = Fraction(b.low)
    if (c.denominator != 1 and a.low < 0) or (c < 0 and not a.sign) or (c.denominator != 1 and c <= 0 and a.low <= 0):
        return None
    return order_of(c * a.p, c * a.l, constant_power(pair(a), b.low)) if a != ZERO else (ZERO if c > 0 else None)


def _squared(k: int, a: Asymptotic) -> Asymptotic | None:
    return order_of(2 * a.p, 2 * a.l, arithmetic.square(pair(a)))


def _root(k: int, a: Asymptotic) -> Asymptotic | None:
    return order_of(a.p / 2, a.l / 2, arithmetic.root(pair(a))) if a.low >= 0 else None


def _hypot(k: int, a: Asymptotic, b: Asymptotic) -> Asymptotic | None:
    squares = _squared(k, a), _squared(k, b)
    total = plus(*squares, k)
    return None if total is None else _root(k, total._replace(low=max(total.low, 0.0)))


def _larger(k: int, a: Asymptotic, b: Asymptotic, smaller: bool = False) -> Asymptotic | None:
    both = together(a, b, k)
    if both is None:
        return None
    gap = arithmetic.sub(both[2], both[3])
    if gap[0][0] >= 0 or gap[1][0] <= 0:
        return a if (gap[0][0] >= 0) != smaller else b
    pick = np.minimum if smaller else np.maximum
    return order_of(both[0], both[1], (pick(both[2][0], both[3][0]), pick(both[2][1], both[3][1])))


def _rounded(op: int) -> Callable[[int, Asymptotic], Asymptotic | None]:
    """floor and ceil: the argument and a part of a unit, the value itself where that is bounded."""

    def rule(k: int, a: Asymptotic) -> Asymptotic | None:
        if a.rate <= (0, 0):
            return _plain(op, [a], k)
        return plus(a, constant(-1.0, 0.0) if op == ca.OP_FLOOR else constant(0.0, 1.0), k)

    return rule


def _endless(a: Asymptotic) -> bool:
    """Whether |a| grows without end like a power of t."""
    return a.p > 0 and a.l >= 0 and bool(a.sign)


def _steep(a: Asymptotic) -> int:
    return int(np.ceil(FAST / float(a.p))) if a.p * MOST > FAST else 0


def _exp(k: int, a: Asymptotic) -> Asymptotic | None:
    m = _steep(a) if _endless(a) else 0
    if not m:
        return _plain(ca.OP_EXP, [a], k)
    size = a if a.sign > 0 else Asymptotic(a.p, a.l, -a.high, -a.low)
    low = constant_power((np.array([size.low]), np.array([size.low])), float(m))
    least = arithmetic.div(low, arithmetic.point(float(factorial(m))))[0]
    if a.sign > 0:
        return order_of(m * a.p, m * a.l, (least, np.array([np.inf])))
    return order_of(-m * a.p, -m * a.l, (np.zeros(1), arithmetic.inv((least, least))[1])) if least[0] > 0 else None


def _expm1(k: int, a: Asymptotic) -> Asymptotic | None:
    return plus(_exp(k, a), constant(-1.0), k)


def _hyperbolic(op: int) -> Callable[[int, Asymptotic], Asymptotic | None]:
    """sinh u >= u^m/m! for u >= 0 and odd m, cosh u >= u^m/m! for even m."""

    def rule(k: int, a: Asymptotic) -> Asymptotic | None:
        m = _steep(a) if _endless(a) else 0
        if not m:
            return _plain(op, [a], k)
        m += (m + (op == ca.OP_SINH)) % 2
        size = a.low if a.sign > 0 else -a.high
        least = arithmetic.div(constant_power(arithmetic.point(size), float(m)), arithmetic.point(float(factorial(m))))[0]
        grown = order_of(m * a.p, m * a.l, (least, np.array([np.inf])))
        return grown if grown is None or a.sign > 0 or op == ca.OP_COSH else _negated(k, grown)

    return rule


def _log(k: int, a: Asymptotic) -> Asymptotic | None:
    """log(t^p s^l c) = s (p + l log(s)/s + log(c)/s), s = log t; log(s)/s falls for s >= e, to 0."""
    if not (a.p > 0 and a.low > 0 and k >= 4):
        return _plain(ca.OP_LOG, [a], k)
    T = arithmetic.point(2.0**k)
    s = log(T)
    zero_to = lambda top: (np.zeros(1), np.maximum(top, 0.0))  # noqa: E731
    ratio = arithmetic.div(log(s), s)
    total = arithmetic.add(
        _fraction(a.p),
        arithmetic.add(
            arithmetic.mul(_fraction(a.l), zero_to(ratio[1])), arithmetic.mul(log(pair(a)), zero_to(arithmetic.inv(s)[1]))
        ),
    )
    return order_of(Fraction(0), Fraction(1), total)


def _fraction(number: Fraction) -> Pair:
    return np.array([np.nextafter(float(number), -np.inf)]), np.array([np.nextafter(float(number), np.inf)])


def _softplus(step: Step, steps: Sequence[Step], values: Sequence[Asymptotic | None], k: int) -> Asymptotic | None:
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
    if u is None or not c > 0 or not _endless(u):
        return None
    least = log(arithmetic.point(c))
    top = _larger(k, u, constant(float(least[0][0]), float(least[1][0])))
    return plus(top, constant(0.0, 0.6931471805599454), k) if top is not None else None


def _chosen(args: list[Asymptotic | None], k: int) -> Asymptotic | None:
    condition, value = args
    if condition is None:
        return None
    low, high = natural(condition, k)
    if low[0] == high[0] == 0:
        return ZERO
    if value is None or low[0] > 0 or high[0] < 0:
        return value
    return order_of(value.p, value.l, (np.minimum(value.low, 0.0).reshape(1), np.maximum(value.high, 0.0).reshape(1)))


def _compared(op: int) -> Callable[[int, Asymptotic, Asymptotic], Asymptotic | None]:
    def rule(k: int, a: Asymptotic, b: Asymptotic) -> Asymptotic | None:
        other = _negated(k, b)
        gap = plus(a, other, k)
        if gap is not None and gap.sign:
            true = {ca.OP_LT: gap.sign < 0, ca.OP_LE: gap.sign < 0, ca.OP_EQ: False, ca.OP_NE: True}[op]
            return constant(float(true))
        return _plain(op, [a, b], k)

    return rule


_RULES: dict[int, Callable[..., Asymptotic | None]] = {
    ca.OP_ASSIGN: lambda k, a: a,
    ca.OP_ADD: lambda k, a, b: plus(a, b, k),
    ca.OP_SUB: lambda k, a, b: plus(a, _negated(k, b), k),
    ca.OP_MUL: lambda k, a, b: times(a, b),
    ca.OP_DIV: _divided,
    ca.OP_INV: lambda k, a: _divided(k, constant(1.0), a),
    ca.OP_NEG: _negated,
    ca.OP_TWICE: lambda k, a: times(a, constant(2.0)),
    ca.OP_SQ: _squared,
    ca.OP_SQRT: _root,
    ca.OP_POW: _power,
    ca.OP_CONSTPOW: _power,
    ca.OP_FABS: lambda k, a: order_of(a.p, a.l, arithmetic.magnitude(pair(a))),
    ca.OP_SIGN: lambda k, a: constant(float(a.sign)) if a.sign or a == ZERO else constant(-1.0, 1.0),
    ca.OP_HYPOT: _hypot,
    ca.OP_FMAX: _larger,
    ca.OP_FMIN: lambda k, a, b: _larger(k, a, b, smaller=True),
    ca.OP_FLOOR: _rounded(ca.OP_FLOOR),
    ca.OP_CEIL: _rounded(ca.OP_CEIL),
    ca.OP_EXP: _exp,
    ca.OP_EXPM1: _expm1,
    ca.OP_SINH: _hyperbolic(ca.OP_SINH),
    ca.OP_COSH: _hyperbolic(ca.OP_COSH),
    ca.OP_LOG: _log,
    ca.OP_LOG1P: lambda k, a: (total := plus(a, constant(1.0), k)) and _log(k, total),
    **{op: _compared(op) for op in (ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE)},
}
