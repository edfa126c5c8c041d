"""The operations of CasADi on intervals: bounds, slopes, and where each is continuous."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof.interval_arithmetic import (
    MINUS_ONE,
    ONE,
    UNBOUNDED,
    ZERO,
    Array,
    Pair,
    above,
    add,
    below,
    choose,
    div,
    excludes,
    hull,
    in_domain,
    inv,
    is_point,
    magnitude,
    meet,
    mul,
    neg,
    pair,
    point,
    root,
    square,
    sub,
    up,
)
from nsmodel.proof.interval_library import (
    acos,
    acosh,
    asin,
    asinh,
    atan,
    atan2,
    atanh,
    cos,
    cosh,
    erf_bounds,
    erfinv_bounds,
    exp,
    expm1,
    has_pole,
    hypot,
    hypot_slopes,
    log,
    log1p,
    off_cut,
    sin,
    sinh,
    tan,
    tanh,
)


class Operation(NamedTuple):
    """What is known of an elementary operation f on intervals.

    Attributes:
        bounds: (*args) -> interval of f.
        slopes: (result, *args) -> intervals s with f(u) - f(v) = sum s_i (u_i - v_i) for all u, v in the arguments, where
            f is continuous there.
        continuous: (result, *args) -> whether f is proved defined and continuous on the arguments; None: always.
        jumps: f is piecewise constant: where its value is known it is continuous, whatever the arguments do.
    """

    bounds: Callable[..., Pair]
    slopes: Callable[..., tuple[Pair, ...]]
    continuous: Callable[..., Array] | None = None
    jumps: bool = False


# -- powers ------------------------------------------------------------------------------------------------------------


def _whole_power(x: Pair, n: float) -> Pair:
    """Return x^n for a whole n > 0."""
    x = x if n % 2 else magnitude(x)
    if n <= 64:
        return _product(x[0], int(n))[0], _product(x[1], int(n))[1]
    lo, hi = below(np.power(x[0], n)), above(np.power(x[1], n))
    return pair(np.where(x[0] >= 0, np.maximum(lo, 0), lo), np.where(x[1] <= 0, np.minimum(hi, 0), hi))


def _product(x: Array, n: int) -> Pair:
    """Return x^n for numbers by products, which are exact where they can be."""
    result, factor = ONE, (x, x)
    while n:
        result, factor, n = mul(result, factor) if n % 2 else result, square(factor), n // 2
    return result


def constant_power(x: Pair, c: float) -> Pair:
    """Return x^c for one number c."""
    if np.isnan(c):
        return UNBOUNDED
    if c < 0:
        return inv(constant_power(x, -c))
    if c in (0, 1, 2):
        return (np.ones_like(x[0]), np.ones_like(x[1])) if c == 0 else x if c == 1 else square(x)
    if c == np.floor(c) and c < 2**52:
        return _whole_power(x, c)
    lo, hi = np.maximum(below(np.power(np.maximum(x[0], 0), c)), 0), above(np.power(np.maximum(x[1], 0), c))
    hi = np.where(x[1] <= 0, 0.0, hi)  # 0^c = 0
    return choose(in_domain(x, 0.0, np.inf), pair(lo, hi), UNBOUNDED)


def power(x: Pair, y: Pair) -> Pair:
    """Return x^y; monotone in x and in y where x > 0, so that the corners bound it."""
    base = np.maximum(x[0], 0), np.maximum(x[1], 0)
    corners = [np.power(a, b) for a in base for b in y]
    lo, hi = np.minimum.reduce(np.broadcast_arrays(*corners)), np.maximum.reduce(np.broadcast_arrays(*corners))
    return choose(in_domain(x, 0.0, np.inf), pair(np.maximum(below(lo), 0), above(hi)), UNBOUNDED)


def _fixed_power(x: Pair, y: Pair) -> Pair:
    """Return x^y; x may be negative where y is one whole number."""
    same = y[0].size > 0 and (y[0] == y[0].flat[0]).all() and (y[1] == y[0].flat[0]).all()
    return constant_power(x, float(y[0].flat[0])) if same else power(x, y)


def _power_continuous(_: Pair, x: Pair, y: Pair) -> Array:
    whole = is_point(y) & (y[0] == np.floor(y[0]))
    return (x[0] > 0) | ((x[0] >= 0) & (y[0] > 0)) | (whole & ((y[0] >= 0) | excludes(x)))


def _power_slopes(r: Pair, x: Pair, y: Pair) -> tuple[Pair, Pair]:
    return mul(y, power(x, sub(y, ONE))), choose(x[0] >= 0, mul(r, log(x)), UNBOUNDED)


def _fixed_power_slopes(r: Pair, x: Pair, y: Pair) -> tuple[Pair, Pair]:
    by_base = mul(y, _fixed_power(x, sub(y, ONE)))
    return by_base, ZERO if is_point(y).all() else choose(x[0] >= 0, mul(r, log(x)), UNBOUNDED)


# -- operations with kinks and jumps -----------------------------------------------------------------------------------


def _bits(true: Array, false: Array) -> Pair:
    """Return the interval of a truth value, 1 where proved true, 0 where proved false."""
    return np.where(true, 1.0, 0.0), np.where(false, 0.0, 1.0)


def _is_true(x: Pair) -> Array:
    return excludes(x)


def _is_false(x: Pair) -> Array:
    return (x[0] == 0) & (x[1] == 0)


def _quotient(x: Pair, y: Pair, rounding: Callable[[Array], Array]) -> tuple[Array, Array]:
    """Return rounding(x / y) and whether it is one and the same number."""
    q = div(x, y)
    a, b = rounding(q[0]), rounding(q[1])
    return a, (a == b) & np.isfinite(a) & excludes(y)


def _rest(rounding: Callable[[Array], Array], part: float) -> Callable[[Pair, Pair], Pair]:
    """Bounds of x - rounding(x / y) y; it is at most ``part`` |y|."""

    def bounds(x: Pair, y: Pair) -> Pair:
        number, known = _quotient(x, y, rounding)
        most = up(part * np.maximum(np.abs(y[0]), np.abs(y[1])))
        if rounding is np.trunc:
            ends = np.where(x[0] >= 0, 0.0, np.maximum(-most, x[0])), np.where(x[1] <= 0, 0.0, np.minimum(most, x[1]))
        else:
            ends = -most, most
        number = np.where(known, number, 0.0)
        return choose(known, meet(ends, sub(x, mul((number, number), y))), choose(excludes(y), ends, UNBOUNDED))

    return bounds


def _rest_operation(rounding: Callable[[Array], Array], part: float) -> Operation:
    return Operation(_rest(rounding, part), lambda r, x, y: (ONE, UNBOUNDED), lambda r, x, y: _quotient(x, y, rounding)[1])


def _copysign(x: Pair, y: Pair) -> Pair:
    size = magnitude(x)
    return choose(y[0] > 0, size, choose(y[1] < 0, neg(size), (-size[1], size[1])))


def _if_else_zero(c: Pair, v: Pair) -> Pair:
    return choose(_is_false(c), ZERO, choose(_is_true(c), v, hull(ZERO, v)))


def _sign_slope(x: Pair) -> Pair:
    return np.where(x[0] >= 0, 1.0, -1.0), np.where((x[1] <= 0) & (x[0] < 0), -1.0, 1.0)


def _share(first: Array, second: Array) -> tuple[Pair, Pair]:
    """Slopes of a choice between two arguments, proved to be the first, the second, or neither."""
    return _bits(first, second & ~first), _bits(second & ~first, first)


def _jump(bounds: Callable[..., Pair], arity: int = 1) -> Operation:
    return Operation(bounds, lambda r, *args: (ZERO,) * arity, lambda r, *args: is_point(r), True)


# -- the table ---------------------------------------------------------------------------------------------------------

_TWO = point(2.0)
_ERF_SLOPE = (np.array([1.1283791670955125]), np.array([1.1283791670955128]))  # 2 / sqrt(pi)


def _one_minus_square(x: Pair) -> Pair:
    return sub(ONE, square(x))


def _plain(bounds: Callable[..., Pair], slope: Callable[..., Pair], continuous: Any = None) -> Operation:
    """Return an operation of one argument."""
    return Operation(bounds, lambda r, x: (slope(r, x),), continuous)


OPERATIONS: dict[int, Operation] = {
    ca.OP_ASSIGN: _plain(lambda x: x, lambda r, x: ONE),
    ca.OP_PRINTME: Operation(lambda x, y: x, lambda r, x, y: (ONE, ZERO)),
    ca.OP_LIFT: Operation(lambda x, y: x, lambda r, x, y: (ONE, ZERO)),
    ca.OP_ADD: Operation(add, lambda r, x, y: (ONE, ONE)),
    ca.OP_SUB: Operation(sub, lambda r, x, y: (ONE, MINUS_ONE)),
    ca.OP_MUL: Operation(mul, lambda r, x, y: (y, x)),
    ca.OP_DIV: Operation(div, lambda r, x, y: (inv(y), neg(div(r, y))), lambda r, x, y: excludes(y)),
    ca.OP_NEG: _plain(neg, lambda r, x: MINUS_ONE),
    ca.OP_INV: _plain(inv, lambda r, x: neg(square(r)), lambda r, x: excludes(x)),
    ca.OP_SQ: _plain(square, lambda r, x: mul(_TWO, x)),
    ca.OP_TWICE: _plain(lambda x: mul(_TWO, x), lambda r, x: _TWO),
    ca.OP_SQRT: _plain(root, lambda r, x: inv(mul(_TWO, r)), lambda r, x: in_domain(x, 0.0, np.inf)),
    ca.OP_POW: Operation(power, _power_slopes, _power_continuous),
    ca.OP_CONSTPOW: Operation(_fixed_power, _fixed_power_slopes, _power_continuous),
    ca.OP_EXP: _plain(exp, lambda r, x: r),
    ca.OP_EXPM1: _plain(expm1, lambda r, x: exp(x)),
    ca.OP_LOG: _plain(log, lambda r, x: inv(x), lambda r, x: x[0] > 0),
    ca.OP_LOG1P: _plain(log1p, lambda r, x: inv(add(ONE, x)), lambda r, x: x[0] > -1),
    ca.OP_SIN: _plain(sin, lambda r, x: cos(x)),
    ca.OP_COS: _plain(cos, lambda r, x: neg(sin(x))),
    ca.OP_TAN: _plain(tan, lambda r, x: add(ONE, square(r)), lambda r, x: ~has_pole(x)),
    ca.OP_ASIN: _plain(asin, lambda r, x: inv(root(_one_minus_square(x))), lambda r, x: in_domain(x, -1, 1)),
    ca.OP_ACOS: _plain(acos, lambda r, x: neg(inv(root(_one_minus_square(x)))), lambda r, x: in_domain(x, -1, 1)),
    ca.OP_ATAN: _plain(atan, lambda r, x: inv(add(ONE, square(x)))),
    ca.OP_ATAN2: Operation(
        atan2,
        lambda r, y, x: (div(x, add(square(x), square(y))), neg(div(y, add(square(x), square(y))))),
        lambda r, y, x: off_cut(y, x),
    ),
    ca.OP_SINH: _plain(sinh, lambda r, x: cosh(x)),
    ca.OP_COSH: _plain(cosh, lambda r, x: sinh(x)),
    ca.OP_TANH: _plain(tanh, lambda r, x: _one_minus_square(r)),
    ca.OP_ASINH: _plain(asinh, lambda r, x: inv(root(add(ONE, square(x))))),
    ca.OP_ACOSH: _plain(acosh, lambda r, x: inv(root(sub(square(x), ONE))), lambda r, x: in_domain(x, 1, np.inf)),
    ca.OP_ATANH: _plain(atanh, lambda r, x: inv(_one_minus_square(x)), lambda r, x: (x[0] > -1) & (x[1] < 1)),
    ca.OP_ERF: _plain(erf_bounds, lambda r, x: mul(_ERF_SLOPE, exp(neg(square(x))))),
    ca.OP_ERFINV: _plain(erfinv_bounds, lambda r, x: div(exp(square(r)), _ERF_SLOPE), lambda r, x: (x[0] > -1) & (x[1] < 1)),
    ca.OP_HYPOT: Operation(hypot, hypot_slopes),
    ca.OP_FABS: _plain(magnitude, lambda r, x: _sign_slope(x)),
    ca.OP_FMIN: Operation(
        lambda x, y: (np.minimum(x[0], y[0]), np.minimum(x[1], y[1])), lambda r, x, y: _share(x[1] <= y[0], y[1] <= x[0])
    ),
    ca.OP_FMAX: Operation(
        lambda x, y: (np.maximum(x[0], y[0]), np.maximum(x[1], y[1])), lambda r, x, y: _share(x[0] >= y[1], y[0] >= x[1])
    ),
    ca.OP_SIGN: _jump(lambda x: (np.sign(x[0]), np.sign(x[1]))),
    ca.OP_FLOOR: _jump(lambda x: (np.floor(x[0]), np.floor(x[1]))),
    ca.OP_CEIL: _jump(lambda x: (np.ceil(x[0]), np.ceil(x[1]))),
    ca.OP_FMOD: _rest_operation(np.trunc, 1.0),
    ca.OP_REMAINDER: _rest_operation(np.rint, 0.5),
    ca.OP_COPYSIGN: Operation(
        _copysign, lambda r, x, y: (choose(y[0] > 0, _sign_slope(x), neg(_sign_slope(x))), ZERO), lambda r, x, y: excludes(y)
    ),
    ca.OP_LT: _jump(lambda x, y: _bits(x[1] < y[0], x[0] >= y[1]), 2),
    ca.OP_LE: _jump(lambda x, y: _bits(x[1] <= y[0], x[0] > y[1]), 2),
    ca.OP_EQ: _jump(lambda x, y: _bits(is_point(x) & is_point(y) & (x[0] == y[0]), (x[1] < y[0]) | (x[0] > y[1])), 2),
    ca.OP_NE: _jump(lambda x, y: _bits((x[1] < y[0]) | (x[0] > y[1]), is_point(x) & is_point(y) & (x[0] == y[0])), 2),
    ca.OP_NOT: _jump(lambda x: _bits(_is_false(x), _is_true(x))),
    ca.OP_AND: _jump(lambda x, y: _bits(_is_true(x) & _is_true(y), _is_false(x) | _is_false(y)), 2),
    ca.OP_OR: _jump(lambda x, y: _bits(_is_true(x) | _is_true(y), _is_false(x) & _is_false(y)), 2),
    ca.OP_IF_ELSE_ZERO: Operation(
        _if_else_zero, lambda r, c, v: (ZERO, choose(_is_true(c), ONE, ZERO)), lambda r, c, v: _is_true(c) | _is_false(c)
    ),
}
