"""Is {x : f(x) >= c} convex for each c, though f is not concave: rules of quasi-concave functions, or one direction's signs.

Increasing functions of quasi-concave ones are such, decreasing functions of quasi-convex ones, minima, products of log-concave
functions, and quotients of a concave function >= 0 by a convex one > 0 (Boyd and Vandenberghe 2004, Sections 3.4 and 3.5).
A point at which f has no value is in none of these sets.
"""

from __future__ import annotations

from fractions import Fraction

import casadi as ca
import numpy as np

from nsmodel.proof import interval_bounds, univariate
from nsmodel.proof.convex import rules
from nsmodel.proof.convex.rules import Curvature, find_ridges
from nsmodel.proof.expression_graph import operation_codes

INCREASING = {
    ca.OP_EXP, ca.OP_EXPM1, ca.OP_LOG, ca.OP_LOG1P, ca.OP_SQRT, ca.OP_TANH, ca.OP_ATAN, ca.OP_ERF, ca.OP_SINH, ca.OP_ASINH,
}  # fmt: skip
EVEN = {ca.OP_SQ, ca.OP_FABS, ca.OP_COSH}
# Longer expressions are left open: the rules are recursive and look at a part anew each time. 165 nodes take 0.02 s.
MAX_NODES = 200
PARTIAL = {ca.OP_LOG: 0.0, ca.OP_LOG1P: -1.0, ca.OP_SQRT: 0.0}  # Arguments below have no value.


def has_convex_superlevel_set(f: ca.SX, x: ca.SX, lower: np.ndarray, upper: np.ndarray) -> bool:
    """Whether {x in the box : f(x) >= 0} is proved convex; the ends of the box may be infinite."""
    if ca.OP_CALL in operation_codes(f) or ca.n_nodes(f) > MAX_NODES:
        return False
    return _Quasiconcavity(x, lower, upper).holds(f, 1) or _keeps_an_interval(f, x, lower, upper)


class _Quasiconcavity:
    """The rules, on a box."""

    def __init__(self, x: ca.SX, lower: np.ndarray, upper: np.ndarray) -> None:
        self._x, self._ends = x, (lower, upper)

    def holds(self, f: ca.SX, sign: int) -> bool:
        """Whether sign f is quasi-concave."""
        own = self._curvature(f)
        if own.concave if sign > 0 else own.convex:
            return True
        op = None if f.is_constant() or f.is_symbolic() else f.op()
        if op is None:
            return False
        args = [f.dep(k) for k in range(f.n_dep())]
        if op in (ca.OP_ASSIGN, ca.OP_NEG, ca.OP_TWICE):
            return self.holds(args[0], -sign if op == ca.OP_NEG else sign)
        if op in (ca.OP_FMIN, ca.OP_FMAX):
            numbers = all(interval_bounds.is_number(arg, self._x, *self._ends) for arg in args)  # fmin(NaN, a) is a
            return numbers and (sign > 0) == (op == ca.OP_FMIN) and all(self.holds(arg, sign) for arg in args)
        if len(args) == 2 and any(arg.is_constant() for arg in args):
            return self._of_one_argument(op, args, sign)
        if op in (ca.OP_MUL, ca.OP_DIV):
            return self._of_product(op, args[0], args[1], sign)
        if len(args) != 1:
            return False
        inner = self._curvature(args[0])
        if op in INCREASING:
            return (sign > 0 or inner.low >= PARTIAL.get(op, -np.inf)) and self.holds(args[0], sign)
        if op in EVEN:
            return self._of_monotone(args[0], inner, sign)
        return op == ca.OP_INV and (inner.low > 0 or inner.high < 0) and self.holds(args[0], -sign)

    def _of_monotone(self, u: ca.SX, inner: Curvature, sign: int) -> bool:
        """An even function of u, where u has one sign."""
        direction = 1 if inner.low >= 0 else -1 if inner.high <= 0 else 0
        return bool(direction) and self.holds(u, sign * direction)

    def _of_one_argument(self, op: int, args: list[ca.SX], sign: int) -> bool:
        """A function of u and a number."""
        place = 0 if args[1].is_constant() else 1
        u, number = args[place], float(args[1 - place])
        inner = self._curvature(u)
        if not np.isfinite(number):
            return False
        if op in (ca.OP_ADD, ca.OP_SUB):
            return self.holds(u, -sign if op == ca.OP_SUB and place == 1 else sign)
        if op == ca.OP_MUL or (op == ca.OP_DIV and place == 0):
            return number != 0 and self.holds(u, sign if number > 0 else -sign)
        if op == ca.OP_DIV:
            falls = number > 0
            return number != 0 and (inner.low > 0 or inner.high < 0) and self.holds(u, -sign if falls else sign)
        if op in (ca.OP_POW, ca.OP_CONSTPOW) and place == 0 and number:
            if number > 0 and number % 2 == 1:
                return self.holds(u, sign)
            if number > 0 and number % 2 == 0:
                return self._of_monotone(u, inner, sign)
            return bool(inner.low > 0 or (number > 0 and inner.low >= 0)) and self.holds(u, sign if number > 0 else -sign)
        return False

    def _of_product(self, op: int, u: ca.SX, v: ca.SX, sign: int) -> bool:
        if op == ca.OP_MUL:
            a, b = ((-part, -1) if self._curvature(part).high <= 0 else (part, 1) for part in (u, v))
            return a[1] * b[1] == sign and self._is_log_concave(a[0]) and self._is_log_concave(b[0])
        top, bottom = self._curvature(u), self._curvature(v)
        if not bottom.low > 0:
            return False
        if top.affine and bottom.affine:
            return True
        return (
            top.low >= 0 and (top.concave and bottom.convex if sign > 0 else top.convex and bottom.concave)
        ) or (sign > 0 and self._is_log_concave(u) and bottom.log_convex)  # fmt: skip

    def _is_log_concave(self, f: ca.SX) -> bool:
        """Whether f >= 0 and log f is concave where f > 0, which is a convex set."""
        own = self._curvature(f)
        if own.low >= 0 and own.concave:
            return True
        op = None if f.is_constant() or f.is_symbolic() else f.op()
        if op == ca.OP_MUL:
            return self._is_log_concave(f.dep(0)) and self._is_log_concave(f.dep(1))
        if op in (ca.OP_SQ, ca.OP_SQRT, ca.OP_TWICE):
            return self._is_log_concave(f.dep(0))
        if op == ca.OP_EXP:
            return self._curvature(f.dep(0)).concave
        if op in (ca.OP_POW, ca.OP_CONSTPOW):
            return f.dep(1).is_constant() and float(f.dep(1)) > 0 and self._is_log_concave(f.dep(0))
        return False

    def _curvature(self, f: ca.SX) -> Curvature:
        return rules.curvatures(f, self._x, *self._ends)[0]


def _keeps_an_interval(f: ca.SX, x: ca.SX, lower: np.ndarray, upper: np.ndarray) -> bool:
    """Whether f is a continuous function of one direction that is >= 0 on one interval."""
    split = find_ridges(f, x)
    if split is None or split.s.numel() != 1:
        return False
    (low,), (high,) = split.box(lower, upper)
    length = Fraction(float(high)) - Fraction(float(low)) if np.isfinite([low, high]).all() else None
    if np.isfinite(low):
        ways = [(float(low), 1)]
    else:
        ways = [(float(high), -1)] if np.isfinite(high) else [(0.0, 1), (0.0, -1)]
    signs = [_sign_at(split.h, split.s, float(high))] if length is not None else []
    r = ca.SX.sym("r")
    for start, way in ways:
        found = univariate.decide_signs(ca.substitute(split.h, split.s, start + way * r), r, high=length, strict=True)
        if found is None or (found.touches and min(found.signs) < 0):
            return False
        own = [_sign_at(split.h, split.s, start), *(1 if sign >= 0 else -1 for sign in found.signs)]
        signs = [*reversed(own), *signs] if way < 0 else [*own, *signs]
    blocks = [sign for k, sign in enumerate(signs) if not k or sign != signs[k - 1]]
    return None not in signs and blocks.count(1) <= 1


def _sign_at(h: ca.SX, s: ca.SX, at: float) -> int | None:
    """1 where h >= 0, -1 where h < 0; None where that is not proved."""
    low, high = (float(np.ravel(bound)[0]) for bound in interval_bounds.enclose(h, s, np.array([at]), np.array([at])))
    return 1 if low >= 0 else -1 if high < 0 else None
