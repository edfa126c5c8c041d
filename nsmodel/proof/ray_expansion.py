"""How an expression behaves along a short ray: sums of powers of the distance with intervals as coefficients.

On the ray z = p + s d, 0 < s <= h, every operation is carried out on sums c_1 s^p_1 + c_2 s^p_2 + ..., where c_k(s) lies in an
interval C_k for each s. A sum whose first power is negative and whose first coefficient, with all later terms put into it, does
not hold 0 grows without bound as s falls to 0.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction

import casadi as ca
import numpy as np

from nsmodel.proof.expression_graph import fold_graph
from nsmodel.proof.interval_arithmetic import IntervalPair, add, div, excludes, hull, mul, neg, point_interval, square_root
from nsmodel.proof.interval_functions import OPERATIONS, constant_power

# Powers of s that are kept; the last of more goes into the coefficient of the one before: signs near 0 are those of the first.
MAX_GERM_TERMS = 6
ODD_OPERATIONS = {
    ca.OP_SIN,
    ca.OP_TAN,
    ca.OP_ATAN,
    ca.OP_SINH,
    ca.OP_TANH,
    ca.OP_ASINH,
    ca.OP_ASIN,
    ca.OP_ERF,
    ca.OP_EXPM1,
    ca.OP_LOG1P,
}
SMOOTH_OPERATIONS = ODD_OPERATIONS | {
    ca.OP_COS,
    ca.OP_COSH,
    ca.OP_EXP,
    ca.OP_LOG,
    ca.OP_ACOS,
    ca.OP_ATANH,
    ca.OP_ACOSH,
    ca.OP_FLOOR,
    ca.OP_CEIL,
}

GermTerms = dict[Fraction, IntervalPair]


class _UnknownGerm(Exception):
    """Nothing is known of a value."""


def growth_exponent(expr: ca.SX, z: ca.SX, p: np.ndarray, d: np.ndarray, h: float) -> Fraction | None:
    """Return the power < 0 with which a scalar expression grows along p + s d as s falls to 0; None where that is not proved."""
    place = {symbol.element_hash(): k for k, symbol in enumerate(ca.vertsplit(z))}
    ray = _GermAlgebra(h)

    def symbol(entry: ca.SX) -> GermTerms | None:
        k = place[entry.element_hash()]
        return ray.simplify({Fraction(0): point_interval(float(p[k])), Fraction(1): point_interval(float(d[k]))})

    def apply(op: int, args: list[GermTerms | None]) -> GermTerms | None:
        if any(arg is None for arg in args):
            zero = op in (ca.OP_MUL, ca.OP_IF_ELSE_ZERO) and args[0] == {}
            return {} if zero else None
        with np.errstate(all="ignore"):
            try:
                return ray.simplify(ray.apply(op, *(arg for arg in args if arg is not None)))
            except _UnknownGerm:
                return None

    found = fold_graph(
        ca.densify(expr),
        symbol,
        lambda value: ray.simplify({Fraction(0): point_interval(value)}) if np.isfinite(value) else None,
        apply,
    )
    if found[0] is None or not found[0]:
        return None
    power, c = ray.leading_term(found[0])
    return power if power < 0 and bool(excludes(c).all()) else None


class _GermAlgebra:
    """The algebra for 0 < s <= h < 1."""

    def __init__(self, h: float) -> None:
        self.h = h

    def simplify(self, a: GermTerms) -> GermTerms:
        """Without terms that are 0, and with few terms."""
        a = {power: c for power, c in sorted(a.items()) if c[0].any() or c[1].any()}
        while len(a) > MAX_GERM_TERMS:
            last, before = sorted(a)[-1], sorted(a)[-2]
            c = a.pop(last)
            a[before] = add(a[before], mul(c, self._power_interval(last - before)))
        return a

    def _power_interval(self, power: Fraction) -> IntervalPair:
        """s^power for a power >= 0."""
        top = 1.0 if power == 0 else float(np.nextafter(self.h ** float(power), 2))
        return np.array([1.0 if power == 0 else 0.0]), np.array([top])

    def leading_term(self, a: GermTerms) -> tuple[Fraction, IntervalPair]:
        """One term for all."""
        if not a:
            raise _UnknownGerm
        first = min(a)
        total = a[first]
        for power, c in a.items():
            if power != first:
                total = add(total, mul(c, self._power_interval(power - first)))
        return first, total

    def value_interval(self, a: GermTerms) -> IntervalPair:
        """An interval of the values."""
        if not a:
            return point_interval(0.0)
        power, c = self.leading_term(a)
        if power < 0:
            raise _UnknownGerm
        return mul(c, self._power_interval(power))

    def sign(self, a: GermTerms) -> int:
        """The sign on the whole ray."""
        if not a:
            return 0
        _, c = self.leading_term(a)
        if not excludes(c).all():
            raise _UnknownGerm
        return 1 if c[0][0] > 0 else -1

    def apply(self, op: int, a: GermTerms, b: GermTerms | None = None) -> GermTerms:
        """The terms of an operation's result."""
        unary: dict[int, Callable[[], GermTerms]] = {
            ca.OP_ASSIGN: lambda: a,
            ca.OP_NEG: lambda: _scale_germ(a, -1.0),
            ca.OP_TWICE: lambda: _scale_germ(a, 2.0),
            ca.OP_SQ: lambda: _multiply_germs(a, a),
            ca.OP_SQRT: lambda: self._root(a),
            ca.OP_INV: lambda: self._quotient({Fraction(0): point_interval(1.0)}, a),
            ca.OP_FABS: lambda: _scale_germ(a, float(self.sign(a))),
            ca.OP_SIGN: lambda: _constant_germ(self.sign(a)),
            ca.OP_NOT: lambda: _constant_germ(self.sign(a) == 0),
        }
        if op in unary:
            return unary[op]()
        if op in SMOOTH_OPERATIONS:
            return self._smooth_function(op, a)
        if b is None:
            raise _UnknownGerm
        binary: dict[int, Callable[[], GermTerms]] = {
            ca.OP_ADD: lambda: _add_germs(a, b),
            ca.OP_SUB: lambda: _add_germs(a, _scale_germ(b, -1.0)),
            ca.OP_MUL: lambda: _multiply_germs(a, b),
            ca.OP_DIV: lambda: self._quotient(a, b),
            ca.OP_POW: lambda: self._power(a, b),
            ca.OP_CONSTPOW: lambda: self._power(a, b),
            ca.OP_HYPOT: lambda: self._root(_add_germs(_multiply_germs(a, a), _multiply_germs(b, b))),
            ca.OP_FMAX: lambda: a if self.sign(_add_germs(a, _scale_germ(b, -1.0))) >= 0 else b,
            ca.OP_FMIN: lambda: a if self.sign(_add_germs(a, _scale_germ(b, -1.0))) <= 0 else b,
            ca.OP_LT: lambda: _constant_germ(self.sign(_add_germs(a, _scale_germ(b, -1.0))) < 0),
            ca.OP_LE: lambda: _constant_germ(self.sign(_add_germs(a, _scale_germ(b, -1.0))) <= 0),
            ca.OP_EQ: lambda: _constant_germ(self.sign(_add_germs(a, _scale_germ(b, -1.0))) == 0),
            ca.OP_NE: lambda: _constant_germ(self.sign(_add_germs(a, _scale_germ(b, -1.0))) != 0),
            ca.OP_AND: lambda: _constant_germ(self.sign(a) != 0 and self.sign(b) != 0),
            ca.OP_OR: lambda: _constant_germ(self.sign(a) != 0 or self.sign(b) != 0),
            ca.OP_IF_ELSE_ZERO: lambda: b if self.sign(a) else {},
        }
        if op not in binary:
            raise _UnknownGerm
        return binary[op]()

    def _root(self, a: GermTerms) -> GermTerms:
        if not a:
            return {}
        power, c = self.leading_term(a)
        if not c[0][0] > 0:
            raise _UnknownGerm
        return {power / 2: square_root(c)}

    def _quotient(self, a: GermTerms, b: GermTerms) -> GermTerms:
        power, c = self.leading_term(b)
        if not excludes(c).all():
            raise _UnknownGerm
        return _multiply_germs(a, {-power: div(point_interval(1.0), c)})

    def _power(self, a: GermTerms, b: GermTerms) -> GermTerms:
        if set(b) - {Fraction(0)} or not b or b[Fraction(0)][0][0] != b[Fraction(0)][1][0]:
            raise _UnknownGerm
        exponent = Fraction(float(b[Fraction(0)][0][0]))
        if exponent.denominator == 1 and 0 < exponent <= 8:
            total = a
            for _ in range(int(exponent) - 1):
                total = _multiply_germs(total, a)
            return total
        if not a and exponent > 0:
            return {}
        power, c = self.leading_term(a)
        if not c[0][0] > 0:
            raise _UnknownGerm
        return {power * exponent: constant_power(c, float(exponent))}

    def _smooth_function(self, op: int, a: GermTerms) -> GermTerms:
        if op in ODD_OPERATIONS and (not a or min(a) > 0):
            reach = hull(point_interval(0.0), self.value_interval(a))
            operation = OPERATIONS[op]
            (slope,) = operation.slopes(operation.bounds(reach), reach)
            if not (np.isfinite(slope[0]).all() and np.isfinite(slope[1]).all()):
                raise _UnknownGerm
            return _multiply_germs(a, {Fraction(0): slope})
        value = OPERATIONS[op].bounds(self.value_interval(a))
        if not (np.isfinite(value[0]).all() and np.isfinite(value[1]).all()):
            raise _UnknownGerm
        return {Fraction(0): value}


def _constant_germ(value: float) -> GermTerms:
    return {Fraction(0): point_interval(float(value))}


def _scale_germ(a: GermTerms, factor: float) -> GermTerms:
    return {power: neg(c) if factor == -1 else mul(c, point_interval(factor)) for power, c in a.items()}


def _add_germs(a: GermTerms, b: GermTerms) -> GermTerms:
    total = dict(a)
    for power, c in b.items():
        total[power] = add(total[power], c) if power in total else c
    return total


def _multiply_germs(a: GermTerms, b: GermTerms) -> GermTerms:
    total: GermTerms = {}
    for p, c in a.items():
        for r, e in b.items():
            total[p + r] = add(total[p + r], mul(c, e)) if p + r in total else mul(c, e)
    return total
