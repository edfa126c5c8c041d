"""Functions of x and p as convex combinations, whose weights depend on p alone, of functions of x.

Where f(x, p) = f_0(x) + sum c_j(p) f_j(x), the point (c_1(p), c_2(p), ...) lies in the hull of corners c^k for all p of a box,
and f(., p) = sum w_k(p) f(., c^k) with w_k >= 0, sum w_k = 1. What is convex in functions (convexity, monotonicity, bounds of
values, of growth, of one-sided Lipschitz constants) and holds for all f(., c^k), holds for all p.
"""

from __future__ import annotations

from fractions import Fraction
from itertools import product
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import exact, interval, polynomial
from nsmodel.proof.graph import applied, column, fold, keys, same
from nsmodel.proof.multiaffine import corners
from nsmodel.proof.straight_line import is_double

MOST = 64
NUMBER, OF_P, FREE, SCALED, AFFINE = range(5)
MONOMIALS = (ca.OP_MUL, ca.OP_DIV, ca.OP_SQ, ca.OP_FABS)  # f(a u, b v) = f(a, b) f(u, v)


class _Node(NamedTuple):
    """A node that is a number, of p alone, free of p, ``factor`` (of p alone) times what is free of p, or affine in the c_j."""

    expr: ca.SX
    kind: int
    factor: ca.SX = ca.SX(1)


def mixture(f: ca.SX, p: ca.SX, lower: np.ndarray, upper: np.ndarray) -> list[ca.SX] | None:
    """Return the columns f(., c^k), as many as there are corners; None where f (m, 1) is not affine in functions of p.

    >>> x, p = ca.SX.sym("x"), ca.SX.sym("p")
    >>> mixture((x - p) ** 2 + ca.sqrt(p) * ca.fabs(x), p, np.array([1.0]), np.array([4.0]))[0]
    SX((((sq(x)+(-2*x))+1)+fabs(x)))
    """
    if not f.numel() or not ca.depends_on(f, p):
        return [f]
    walk = _Walk(p)
    rows = [next((own for own in map(walk.row, (row, _expanded(row, p))) if own is not None), None) for row in ca.vertsplit(f)]
    if any(row is None for row in rows):
        return None
    c, parts = column(symbol for symbol, _ in walk.parts), column(part for _, part in walk.parts)
    ends = corners([parts], p, lower, upper)
    if ends is None:
        return None
    at = {point for (values,) in ends for point in product(*({exact.down(value), exact.up(value)} for value in values.ravel()))}
    if parts.numel() == 1:
        low, high = (float(np.ravel(end)[0]) for end in interval.enclose(parts, p, lower, upper))
        at = {(max(low, min(at)[0]),), (min(high, max(at)[0]),)}
    if len(at) > MOST or not np.isfinite(list(at)).all():
        return None
    whole = column(row for row in rows if row is not None)
    return [ca.substitute(whole, c, ca.SX(ca.DM(point))) for point in sorted(at)]


class _Walk:
    """Goes through graphs; ``parts`` are the symbols c_j with what they stand for, of p alone."""

    def __init__(self, p: ca.SX) -> None:
        self.own, self.parts = keys(p), list[tuple[ca.SX, ca.SX]]()

    def row(self, expr: ca.SX) -> ca.SX | None:
        (node,) = fold(
            expr,
            lambda symbol: _Node(symbol, OF_P, symbol) if symbol.element_hash() in self.own else _Node(symbol, FREE),
            lambda number: _Node(ca.SX(number), NUMBER),
            self._apply,
        )
        return None if node is None else self._closed(node).expr

    def _closed(self, node: _Node) -> _Node:
        """A node with its part of p alone as a symbol."""
        if node.kind not in (OF_P, SCALED):
            return node
        known = next((symbol for symbol, part in self.parts if same(part, node.factor)), None)
        if known is None:
            known = ca.SX.sym(f"c{len(self.parts)}")
            self.parts.append((known, node.factor))
        return _Node(known if node.kind == OF_P else known * node.expr, AFFINE)

    def _apply(self, op: int, args: list[_Node | None]) -> _Node | None:
        given = [arg for arg in args if arg is not None]
        if len(given) < len(args) or op == ca.OP_CALL:
            return None
        kinds = [arg.kind for arg in given]
        if max(kinds) <= OF_P:
            whole = applied(op, [arg.expr for arg in given])
            return _Node(whole, max(kinds), whole if OF_P in kinds else ca.SX(1))
        if op in MONOMIALS and {OF_P, SCALED} & set(kinds) and AFFINE not in kinds:
            free = [ca.SX(1) if arg.kind == OF_P else arg.expr for arg in given]
            return _Node(applied(op, free), SCALED, applied(op, [arg.factor for arg in given]))
        given = [self._closed(arg) for arg in given]
        affine = [arg.kind == AFFINE for arg in given]
        linear = (
            op in (ca.OP_ADD, ca.OP_SUB, ca.OP_NEG, ca.OP_TWICE, ca.OP_ASSIGN)
            or (op == ca.OP_MUL and not all(affine))
            or (op == ca.OP_DIV and not affine[1])
            or (op == ca.OP_IF_ELSE_ZERO and not affine[0])
        )
        if any(affine) and not linear:
            return None
        return _Node(applied(op, [arg.expr for arg in given]), AFFINE if any(affine) else FREE)


def _expanded(expr: ca.SX, p: ca.SX) -> ca.SX:
    """A sum in which polynomials in x and p are sums of monomials in x, with factors of p alone; else as it is."""
    if not expr.is_constant() and not expr.is_symbolic() and expr.op() in (ca.OP_ADD, ca.OP_SUB):
        return applied(expr.op(), [_expanded(expr.dep(k), p) for k in (0, 1)])
    z = column(ca.symvar(expr))
    (found,) = polynomial.read(expr, z)
    if found is None or not all(is_double(number) for number in found.values()):
        return expr
    own = keys(p)
    of_p = [symbol.element_hash() in own for symbol in ca.vertsplit(z)] if z.numel() else []
    factors: dict[polynomial.Monomial, ca.SX] = {}
    for monomial, number in found.items():
        inner = tuple((variable, power) for variable, power in monomial if not of_p[variable])
        outer = tuple((variable, power) for variable, power in monomial if of_p[variable])
        factors[inner] = factors.get(inner, ca.SX(0)) + _monomial(number, outer, z)
    return ca.SX(sum((factor * _monomial(Fraction(1), inner, z) for inner, factor in factors.items()), ca.SX(0)))


def _monomial(number: Fraction, powers: polynomial.Monomial, z: ca.SX) -> ca.SX:
    total = ca.SX(float(number))
    for variable, power in powers:
        total *= z[variable] ** power
    return total
