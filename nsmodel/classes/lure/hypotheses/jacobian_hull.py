"""Matrices whose convex hull, with a cone of directions where an entry is unbounded, holds a Jacobian over a box."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import extremum, interval_bounds, polynomial
from nsmodel.proof.expression_graph import rewrite_nodes

MAX_VARYING_ENTRIES, MAX_HULL_STATES = 6, 12  # Up to so many different varying entries, and so many states.


class JacobianHull(NamedTuple):
    """All J(x) lie in conv(vertices) + cone(cones); ``sure``: proved, not a sample."""

    vertices: list[np.ndarray]
    cones: list[np.ndarray]
    proved: bool


def bounded_hull(J: ca.SX, x: ca.SX, lower: np.ndarray, upper: np.ndarray) -> JacobianHull | None:
    """Return the hull from interval bounds over a box of x of the varying entries of J (n, n), +-equal entries together.

    None where there are more than VARYING of them, or more than STATES states.
    """
    n = J.shape[0]
    constant, groups = np.zeros((n, n)), []
    for i, j in np.ndindex(n, n):
        entry = J[int(i), int(j)]
        if not ca.depends_on(entry, x):
            constant[i, j] = float(entry)
            continue
        for expression, pattern in groups:
            sign = 1 if ca.is_equal(entry, expression, 20) else -1 if ca.is_equal(-entry, expression, 20) else 0
            if sign:
                pattern[i, j] = sign
                break
        else:
            pattern = np.zeros((n, n))
            pattern[i, j] = 1
            groups.append((entry, pattern))
    if len(groups) > MAX_VARYING_ENTRIES or n > MAX_HULL_STATES:
        return None
    ends, cones = [], []
    for entry, pattern in groups:
        low, high = (end.item() for end in interval_bounds.enclose(entry, x, lower, upper))
        finite = sorted({end for end in (low, high) if np.isfinite(end)}) or [0.0]
        ends.append([end * pattern for end in finite])
        cones += [sign * pattern for sign, end in ((-1, low), (1, high)) if not np.isfinite(end)]
    return JacobianHull([constant + sum(choice, start=np.zeros((n, n))) for choice in product(*ends)], cones, True)


def sampled_hull(J: ca.SX, x: ca.SX, lower: np.ndarray, upper: np.ndarray) -> JacobianHull:
    """Return a few values of J in the box: enough to choose a P from."""
    values = ca.Function("J", [x], [J])
    matrices = [np.array(values(point)) for point in extremum.samples(lower, upper, 5)]
    return JacobianHull([M for M in matrices if np.isfinite(M).all()] or [np.zeros(J.shape)], [], False)


def simplify_factors(expr: ca.SX, x: ca.SX) -> ca.SX:
    """Return a scalar expression with fewer repeated factors: x (x + x) as 2 x^2, x sign(x) as |x|; exactly equal to it."""
    if not ca.depends_on(expr, x):
        return expr
    (terms,) = polynomial.read_polynomials(expr, x)
    if terms is not None and all(float(factor) == factor for factor in terms.values()):
        return sum((float(factor) * _monomial(powers, x) for powers, factor in terms.items()), start=ca.SX(0))

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX | None:
        if op == ca.OP_DIV:
            return _half_sign(*args)
        for a, b in (args, args[::-1]):
            if b.op() == ca.OP_SIGN and ca.is_equal(b.dep(0), a, 20):
                return ca.fabs(a)
        return None

    return rewrite_nodes(expr, rule, (ca.OP_MUL, ca.OP_DIV), x, "A")


def _half_sign(top: ca.SX, bottom: ca.SX) -> ca.SX | None:
    """CasADi's derivative of fmax, (a <= b) / ((a <= b) + (b <= a)), as (1 + sign(b - a)) / 2."""
    if top.op() != ca.OP_LE or bottom.op() != ca.OP_ADD:
        return None
    a, b = top.dep(0), top.dep(1)
    for one, other in ((0, 1), (1, 0)):
        if ca.is_equal(bottom.dep(one), top, 20) and ca.is_equal(bottom.dep(other), b <= a, 20):
            return (1 + ca.sign(b - a)) / 2
    return None


def _monomial(powers: polynomial.Monomial, x: ca.SX) -> ca.SX:
    result = ca.SX(1)
    for variable, power in powers:
        result *= (x[variable] ** (power // 2)) ** 2 * (x[variable] if power % 2 else 1)
    return result
