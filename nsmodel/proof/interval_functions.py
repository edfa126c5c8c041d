"""The operations of CasADi on intervals: bounds, slopes, and where each is continuous.

Intervals with operators, rounded outwards: what is written for numbers runs on them as it stands.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Union

import casadi as ca
import numpy as np

from nsmodel.proof import interval_arithmetic as arithmetic
from nsmodel.proof.interval_arithmetic import (
    MINUS_ONE,
    ONE,
    UNBOUNDED,
    ZERO,
    Array,
    IntervalPair,
    acos,
    acosh,
    add,
    asin,
    asinh,
    atan,
    atan2,
    atanh,
    avoids_angle_cut,
    cos,
    cosh,
    div,
    erf_bounds,
    erfinv_bounds,
    excludes,
    exp,
    expm1,
    has_tangent_pole,
    hull,
    hypot,
    hypot_slopes,
    in_domain,
    intersect,
    inv,
    is_point,
    log,
    log1p,
    magnitude,
    make_interval,
    mul,
    neg,
    next_up,
    point_interval,
    select_interval,
    sin,
    sinh,
    square,
    square_root,
    sub,
    tan,
    tanh,
    widen_down,
    widen_up,
)


class IntervalOperation(NamedTuple):
    """What is known of an elementary operation f on intervals.

    Attributes:
        bounds: (*args) -> interval of f.
        slopes: (result, *args) -> intervals s with f(u) - f(v) = sum s_i (u_i - v_i) for all u, v in the arguments, where
            f is continuous there.
        continuous: (result, *args) -> whether f is proved defined and continuous on the arguments; None: always.
        jumps: f is piecewise constant: where its value is known it is continuous, whatever the arguments do.
        loose: (result, fine, *args) -> interval of what f may be where arguments may be no numbers, those that are not ``fine``:
            fmin(NaN, a) is a, NaN < a is 0. None: f is not a number either.
    """

    bounds: Callable[..., IntervalPair]
    slopes: Callable[..., tuple[IntervalPair, ...]]
    continuous: Callable[..., Array] | None = None
    jumps: bool = False
    loose: Callable[..., IntervalPair] | None = None

    @property
    def total(self) -> bool:
        """Whether f has a value for all numbers; the angle, copysign and cases jump, and have one."""
        return self.continuous is None or self.jumps or self.bounds in _TOTAL_BOUNDS

    def defined(self, result: IntervalPair, *args: IntervalPair) -> Array:
        """Whether f is proved to have a value on the arguments."""
        return np.ones(1, bool) if self.total or self.continuous is None else self.continuous(result, *args)


# -- powers ------------------------------------------------------------------------------------------------------------


def _integer_power(x: IntervalPair, n: float) -> IntervalPair:
    """Return x^n for a whole n > 0."""
    x = x if n % 2 else magnitude(x)
    if n <= 64:
        return _power_by_products(x[0], int(n))[0], _power_by_products(x[1], int(n))[1]
    lo, hi = widen_down(np.power(x[0], n)), widen_up(np.power(x[1], n))
    return make_interval(np.where(x[0] >= 0, np.maximum(lo, 0), lo), np.where(x[1] <= 0, np.minimum(hi, 0), hi))


def _power_by_products(x: Array, n: int) -> IntervalPair:
    """Return x^n for numbers by products, which are exact where they can be."""
    result, factor = ONE, (x, x)
    while n:
        result, factor, n = mul(result, factor) if n % 2 else result, square(factor), n // 2
    return result


def constant_power(x: IntervalPair, c: float) -> IntervalPair:
    """Return x^c for one number c."""
    if np.isnan(c):
        return UNBOUNDED
    if c < 0:
        return inv(constant_power(x, -c))
    if c in (0, 1, 2):
        return (np.ones_like(x[0]), np.ones_like(x[1])) if c == 0 else x if c == 1 else square(x)
    if c == np.floor(c) and c < 2**52:
        return _integer_power(x, c)
    lo, hi = np.maximum(widen_down(np.power(np.maximum(x[0], 0), c)), 0), widen_up(np.power(np.maximum(x[1], 0), c))
    hi = np.where(x[1] <= 0, 0.0, hi)  # 0^c = 0
    return select_interval(in_domain(x, 0.0, np.inf), make_interval(lo, hi), UNBOUNDED)


def interval_power(x: IntervalPair, y: IntervalPair) -> IntervalPair:
    """Return x^y; monotone in x and in y where x > 0, so that the corners bound it."""
    base = np.maximum(x[0], 0), np.maximum(x[1], 0)
    corners = [np.power(a, b) for a in base for b in y]
    lo, hi = np.minimum.reduce(np.broadcast_arrays(*corners)), np.maximum.reduce(np.broadcast_arrays(*corners))
    return select_interval(in_domain(x, 0.0, np.inf), make_interval(np.maximum(widen_down(lo), 0), widen_up(hi)), UNBOUNDED)


def _constant_or_general_power(x: IntervalPair, y: IntervalPair) -> IntervalPair:
    """Return x^y; x may be negative where y is one whole number."""
    same = y[0].size > 0 and (y[0] == y[0].flat[0]).all() and (y[1] == y[0].flat[0]).all()
    return constant_power(x, float(y[0].flat[0])) if same else interval_power(x, y)


def _is_power_continuous(_: IntervalPair, x: IntervalPair, y: IntervalPair) -> Array:
    whole = is_point(y) & (y[0] == np.floor(y[0]))
    return (x[0] > 0) | ((x[0] >= 0) & (y[0] > 0)) | (whole & ((y[0] >= 0) | excludes(x)))


def _power_slopes(r: IntervalPair, x: IntervalPair, y: IntervalPair) -> tuple[IntervalPair, IntervalPair]:
    return mul(y, interval_power(x, sub(y, ONE))), select_interval(x[0] >= 0, mul(r, log(x)), UNBOUNDED)


def _constant_or_general_power_slopes(r: IntervalPair, x: IntervalPair, y: IntervalPair) -> tuple[IntervalPair, IntervalPair]:
    by_base = mul(y, _constant_or_general_power(x, sub(y, ONE)))
    return by_base, ZERO if is_point(y).all() else select_interval(x[0] >= 0, mul(r, log(x)), UNBOUNDED)


# -- operations with kinks and jumps -----------------------------------------------------------------------------------


def _truth_interval(true: Array, false: Array) -> IntervalPair:
    """Return the interval of a truth value, 1 where proved true, 0 where proved false."""
    return np.where(true, 1.0, 0.0), np.where(false, 0.0, 1.0)


def _is_true(x: IntervalPair) -> Array:
    return excludes(x)


def _is_false(x: IntervalPair) -> Array:
    return (x[0] == 0) & (x[1] == 0)


def _rounded_quotient(x: IntervalPair, y: IntervalPair, rounding: Callable[[Array], Array]) -> tuple[Array, Array]:
    """Return rounding(x / y) and whether it is one and the same number."""
    q = div(x, y)
    a, b = rounding(q[0]), rounding(q[1])
    return a, (a == b) & np.isfinite(a) & excludes(y)


def _remainder_bounds(rounding: Callable[[Array], Array], part: float) -> Callable[[IntervalPair, IntervalPair], IntervalPair]:
    """Bounds of x - rounding(x / y) y; it is at most ``part`` |y|."""

    def bounds(x: IntervalPair, y: IntervalPair) -> IntervalPair:
        number, known = _rounded_quotient(x, y, rounding)
        most = next_up(part * np.maximum(np.abs(y[0]), np.abs(y[1])))
        if rounding is np.trunc:
            ends = np.where(x[0] >= 0, 0.0, np.maximum(-most, x[0])), np.where(x[1] <= 0, 0.0, np.minimum(most, x[1]))
        else:
            ends = -most, most
        number = np.where(known, number, 0.0)
        return select_interval(
            known, intersect(ends, sub(x, mul((number, number), y))), select_interval(excludes(y), ends, UNBOUNDED)
        )

    return bounds


def _remainder_operation(rounding: Callable[[Array], Array], part: float) -> IntervalOperation:
    return IntervalOperation(
        _remainder_bounds(rounding, part), lambda r, x, y: (ONE, UNBOUNDED), lambda r, x, y: _rounded_quotient(x, y, rounding)[1]
    )


def _copysign(x: IntervalPair, y: IntervalPair) -> IntervalPair:
    size = magnitude(x)
    return select_interval(y[0] > 0, size, select_interval(y[1] < 0, neg(size), (-size[1], size[1])))


def _if_else_zero(c: IntervalPair, v: IntervalPair) -> IntervalPair:
    return select_interval(_is_false(c), ZERO, select_interval(_is_true(c), v, hull(ZERO, v)))


def _absolute_value_slope(x: IntervalPair) -> IntervalPair:
    return np.where(x[0] >= 0, 1.0, -1.0), np.where((x[1] <= 0) & (x[0] < 0), -1.0, 1.0)


def _choice_slopes(first: Array, second: Array) -> tuple[IntervalPair, IntervalPair]:
    """Slopes of a choice between two arguments, proved to be the first, the second, or neither."""
    return _truth_interval(first, second & ~first), _truth_interval(second & ~first, first)


def _jump_operation(
    bounds: Callable[..., IntervalPair], arity: int = 1, loose: Callable[..., IntervalPair] | None = None
) -> IntervalOperation:
    return IntervalOperation(bounds, lambda r, *args: (ZERO,) * arity, lambda r, *args: is_point(r), True, loose)


_TOTAL_BOUNDS = (atan2, _copysign, _if_else_zero)


def _or_other_argument(r: IntervalPair, fine: list[Array], x: IntervalPair, y: IntervalPair) -> IntervalPair:
    """Fmin and fmax are the other argument where one is not a number."""
    r = select_interval(fine[0], r, hull(r, y))
    return select_interval(fine[1], r, hull(r, x))


def _any_truth(r: IntervalPair, fine: list[Array], *args: IntervalPair) -> IntervalPair:
    known = np.logical_and.reduce(np.broadcast_arrays(*fine))
    return select_interval(known, r, _truth_interval(np.zeros(1, bool), np.zeros(1, bool)))


def _either_sign(r: IntervalPair, fine: list[Array], x: IntervalPair, y: IntervalPair) -> IntervalPair:
    return select_interval(fine[1], r, hull(magnitude(x), neg(magnitude(x))))


def _either_case(r: IntervalPair, fine: list[Array], c: IntervalPair, v: IntervalPair) -> IntervalPair:
    return select_interval(fine[0], r, hull(ZERO, v))


# -- the table ---------------------------------------------------------------------------------------------------------

_TWO = point_interval(2.0)
_ERF_SLOPE = (np.array([1.1283791670955125]), np.array([1.1283791670955128]))  # Doubles below and above 2/sqrt(pi).


def _one_minus_square(x: IntervalPair) -> IntervalPair:
    return sub(ONE, square(x))


def _unary_operation(
    bounds: Callable[..., IntervalPair], slope: Callable[..., IntervalPair], continuous: Any = None
) -> IntervalOperation:
    """Return an operation of one argument."""
    return IntervalOperation(bounds, lambda r, x: (slope(r, x),), continuous)


OPERATIONS: dict[int, IntervalOperation] = {
    ca.OP_ASSIGN: _unary_operation(lambda x: x, lambda r, x: ONE),
    ca.OP_PRINTME: IntervalOperation(lambda x, y: x, lambda r, x, y: (ONE, ZERO)),
    ca.OP_LIFT: IntervalOperation(lambda x, y: x, lambda r, x, y: (ONE, ZERO)),
    ca.OP_ADD: IntervalOperation(add, lambda r, x, y: (ONE, ONE)),
    ca.OP_SUB: IntervalOperation(sub, lambda r, x, y: (ONE, MINUS_ONE)),
    ca.OP_MUL: IntervalOperation(mul, lambda r, x, y: (y, x)),
    ca.OP_DIV: IntervalOperation(div, lambda r, x, y: (inv(y), neg(div(r, y))), lambda r, x, y: excludes(y)),
    ca.OP_NEG: _unary_operation(neg, lambda r, x: MINUS_ONE),
    ca.OP_INV: _unary_operation(inv, lambda r, x: neg(square(r)), lambda r, x: excludes(x)),
    ca.OP_SQ: _unary_operation(square, lambda r, x: mul(_TWO, x)),
    ca.OP_TWICE: _unary_operation(lambda x: mul(_TWO, x), lambda r, x: _TWO),
    ca.OP_SQRT: _unary_operation(square_root, lambda r, x: inv(mul(_TWO, r)), lambda r, x: in_domain(x, 0.0, np.inf)),
    ca.OP_POW: IntervalOperation(interval_power, _power_slopes, _is_power_continuous),
    ca.OP_CONSTPOW: IntervalOperation(_constant_or_general_power, _constant_or_general_power_slopes, _is_power_continuous),
    ca.OP_EXP: _unary_operation(exp, lambda r, x: r),
    ca.OP_EXPM1: _unary_operation(expm1, lambda r, x: exp(x)),
    ca.OP_LOG: _unary_operation(log, lambda r, x: inv(x), lambda r, x: x[0] > 0),
    ca.OP_LOG1P: _unary_operation(log1p, lambda r, x: inv(add(ONE, x)), lambda r, x: x[0] > -1),
    ca.OP_SIN: _unary_operation(sin, lambda r, x: cos(x)),
    ca.OP_COS: _unary_operation(cos, lambda r, x: neg(sin(x))),
    ca.OP_TAN: _unary_operation(tan, lambda r, x: add(ONE, square(r)), lambda r, x: ~has_tangent_pole(x)),
    ca.OP_ASIN: _unary_operation(asin, lambda r, x: inv(square_root(_one_minus_square(x))), lambda r, x: in_domain(x, -1, 1)),
    ca.OP_ACOS: _unary_operation(
        acos, lambda r, x: neg(inv(square_root(_one_minus_square(x)))), lambda r, x: in_domain(x, -1, 1)
    ),
    ca.OP_ATAN: _unary_operation(atan, lambda r, x: inv(add(ONE, square(x)))),
    ca.OP_ATAN2: IntervalOperation(
        atan2,
        lambda r, y, x: (div(x, add(square(x), square(y))), neg(div(y, add(square(x), square(y))))),
        lambda r, y, x: avoids_angle_cut(y, x),
    ),
    ca.OP_SINH: _unary_operation(sinh, lambda r, x: cosh(x)),
    ca.OP_COSH: _unary_operation(cosh, lambda r, x: sinh(x)),
    ca.OP_TANH: _unary_operation(tanh, lambda r, x: _one_minus_square(r)),
    ca.OP_ASINH: _unary_operation(asinh, lambda r, x: inv(square_root(add(ONE, square(x))))),
    ca.OP_ACOSH: _unary_operation(
        acosh, lambda r, x: inv(square_root(sub(square(x), ONE))), lambda r, x: in_domain(x, 1, np.inf)
    ),
    ca.OP_ATANH: _unary_operation(atanh, lambda r, x: inv(_one_minus_square(x)), lambda r, x: (x[0] > -1) & (x[1] < 1)),
    ca.OP_ERF: _unary_operation(erf_bounds, lambda r, x: mul(_ERF_SLOPE, exp(neg(square(x))))),
    ca.OP_ERFINV: _unary_operation(
        erfinv_bounds, lambda r, x: div(exp(square(r)), _ERF_SLOPE), lambda r, x: (x[0] > -1) & (x[1] < 1)
    ),
    ca.OP_HYPOT: IntervalOperation(hypot, hypot_slopes),
    ca.OP_FABS: _unary_operation(magnitude, lambda r, x: _absolute_value_slope(x)),
    ca.OP_FMIN: IntervalOperation(
        lambda x, y: (np.minimum(x[0], y[0]), np.minimum(x[1], y[1])),
        lambda r, x, y: _choice_slopes(x[1] <= y[0], y[1] <= x[0]),
        loose=_or_other_argument,
    ),
    ca.OP_FMAX: IntervalOperation(
        lambda x, y: (np.maximum(x[0], y[0]), np.maximum(x[1], y[1])),
        lambda r, x, y: _choice_slopes(x[0] >= y[1], y[0] >= x[1]),
        loose=_or_other_argument,
    ),
    ca.OP_SIGN: _jump_operation(lambda x: (np.sign(x[0]), np.sign(x[1]))),
    ca.OP_FLOOR: _jump_operation(lambda x: (np.floor(x[0]), np.floor(x[1]))),
    ca.OP_CEIL: _jump_operation(lambda x: (np.ceil(x[0]), np.ceil(x[1]))),
    ca.OP_FMOD: _remainder_operation(np.trunc, 1.0),
    ca.OP_REMAINDER: _remainder_operation(np.rint, 0.5),
    ca.OP_COPYSIGN: IntervalOperation(
        _copysign,
        lambda r, x, y: (select_interval(y[0] > 0, _absolute_value_slope(x), neg(_absolute_value_slope(x))), ZERO),
        lambda r, x, y: excludes(y),
        loose=_either_sign,
    ),
    ca.OP_LT: _jump_operation(lambda x, y: _truth_interval(x[1] < y[0], x[0] >= y[1]), 2, _any_truth),
    ca.OP_LE: _jump_operation(lambda x, y: _truth_interval(x[1] <= y[0], x[0] > y[1]), 2, _any_truth),
    ca.OP_EQ: _jump_operation(
        lambda x, y: _truth_interval(is_point(x) & is_point(y) & (x[0] == y[0]), (x[1] < y[0]) | (x[0] > y[1])), 2, _any_truth
    ),
    ca.OP_NE: _jump_operation(
        lambda x, y: _truth_interval((x[1] < y[0]) | (x[0] > y[1]), is_point(x) & is_point(y) & (x[0] == y[0])), 2, _any_truth
    ),
    ca.OP_NOT: _jump_operation(lambda x: _truth_interval(_is_false(x), _is_true(x)), 1, _any_truth),
    ca.OP_AND: _jump_operation(
        lambda x, y: _truth_interval(_is_true(x) & _is_true(y), _is_false(x) | _is_false(y)), 2, _any_truth
    ),
    ca.OP_OR: _jump_operation(
        lambda x, y: _truth_interval(_is_true(x) | _is_true(y), _is_false(x) & _is_false(y)), 2, _any_truth
    ),
    ca.OP_IF_ELSE_ZERO: IntervalOperation(
        _if_else_zero,
        lambda r, c, v: (ZERO, select_interval(_is_true(c), ONE, ZERO)),
        lambda r, c, v: _is_true(c) | _is_false(c),
        loose=_either_case,
    ),
}


Operand = Union["Interval", float, int]


class Interval:
    """An array of intervals [lo, hi]; a number beside it is exact. What is 0 times anything is ZERO itself, at no cost."""

    __slots__ = ("hi", "lo")
    __hash__ = None

    def __init__(self, lo: np.ndarray, hi: np.ndarray) -> None:
        self.lo, self.hi = lo, hi

    @property
    def magnitude(self) -> np.ndarray:
        """The largest absolute value; inf where there is no bound."""
        size = np.maximum(np.abs(self.lo), np.abs(self.hi))
        return np.where(np.isnan(size), np.inf, size)

    @property
    def middle(self) -> np.ndarray:
        """A number inside, or next to it."""
        return self.lo / 2 + self.hi / 2

    def __neg__(self) -> Interval:
        """Return the exact -x."""
        return Interval(-self.hi, -self.lo)

    def __add__(self, other: Operand) -> Interval:
        """Return an enclosure of x + y."""
        if _is_exact_zero(self):
            return as_interval(other)
        return self if _is_exact_zero(other) else Interval(*arithmetic.add(_as_interval_pair(self), _as_interval_pair(other)))

    __radd__ = __add__

    def __sub__(self, other: Operand) -> Interval:
        """Return an enclosure of x - y."""
        return self if _is_exact_zero(other) else Interval(*arithmetic.sub(_as_interval_pair(self), _as_interval_pair(other)))

    def __rsub__(self, other: Operand) -> Interval:
        """Return an enclosure of y - x."""
        return -self + other

    def __mul__(self, other: Operand) -> Interval:
        """Return an enclosure of x y."""
        return (
            ZERO_INTERVAL
            if _is_exact_zero(self) or _is_exact_zero(other)
            else Interval(*arithmetic.mul(_as_interval_pair(self), _as_interval_pair(other)))
        )

    __rmul__ = __mul__

    def __truediv__(self, other: Operand) -> Interval:
        """Return an enclosure of x / y."""
        return Interval(*arithmetic.div(_as_interval_pair(self), _as_interval_pair(other)))

    def __rtruediv__(self, other: Operand) -> Interval:
        """Return an enclosure of y / x."""
        return (
            ZERO_INTERVAL
            if _is_exact_zero(other)
            else Interval(*arithmetic.div(_as_interval_pair(other), _as_interval_pair(self)))
        )

    def __eq__(self, other: object) -> np.ndarray:  # pyrefly: ignore[bad-override]
        """Where it is this number and no other."""
        return (self.lo == other) & (self.hi == other)

    def __ne__(self, other: object) -> np.ndarray:  # pyrefly: ignore[bad-override]
        """Where it may be another number."""
        return ~(self == other)


ZERO_INTERVAL = Interval(np.zeros(1), np.zeros(1))


def point_intervals(value: np.ndarray) -> Interval:
    """Numbers as intervals."""
    return Interval(value, value)


def as_interval(value: Operand) -> Interval:
    """The value as an interval."""
    if isinstance(value, Interval):
        return value
    return ZERO_INTERVAL if value == 0 else Interval(*arithmetic.point_interval(float(value)))


def interval_where(mask: np.ndarray, a: Operand, b: Operand) -> Interval:
    """``a`` where the mask holds, else ``b``."""
    return Interval(*arithmetic.select_interval(mask, _as_interval_pair(a), _as_interval_pair(b)))


def interval_function(name: str) -> Callable[..., Interval]:
    """An operation of CasADi by its name in small letters, on intervals."""
    bounds = OPERATIONS[getattr(ca, f"OP_{name.upper()}")].bounds

    def evaluate(*args: Operand) -> Interval:
        return Interval(*bounds(*map(_as_interval_pair, args)))

    return evaluate


def _is_exact_zero(value: Operand) -> bool:
    return value is ZERO_INTERVAL or (not isinstance(value, Interval) and value == 0)


def _as_interval_pair(value: Operand) -> IntervalPair:
    return (value.lo, value.hi) if isinstance(value, Interval) else arithmetic.point_interval(float(value))
