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
from nsmodel.proof.graph import apply_operation, fold_graph, is_same_expression, stack_column, symbol_hashes
from nsmodel.proof.multiaffine import matrix_corners
from nsmodel.proof.straight_line import is_double

MAX_MIXTURE_CORNERS = 64
KIND_NUMBER, KIND_PARAMETER, KIND_FREE, KIND_SCALED, KIND_AFFINE = range(5)
MULTIPLICATIVE_OPERATIONS = (ca.OP_MUL, ca.OP_DIV, ca.OP_SQ, ca.OP_FABS)  # f(a u, b v) = f(a, b) f(u, v)


class _MixtureNode(NamedTuple):
    """A node that is a number, of p alone, free of p, ``factor`` (of p alone) times what is free of p, or affine in the c_j."""

    expr: ca.SX
    kind: int
    factor: ca.SX = ca.SX(1)


def mixture_corners(f: ca.SX, p: ca.SX, lower: np.ndarray, upper: np.ndarray) -> list[ca.SX] | None:
    """Return the columns f(., c^k), as many as there are corners; None where f (m, 1) is not affine in functions of p.

    >>> x, p = ca.SX.sym("x"), ca.SX.sym("p")
    >>> mixture_corners((x - p) ** 2 + ca.sqrt(p) * ca.fabs(x), p, np.array([1.0]), np.array([4.0]))[0]
    SX((((sq(x)+(-2*x))+1)+fabs(x)))
    """
    if not f.numel() or not ca.depends_on(f, p):
        return [f]
    rewriter = _MixtureRewriter(p)
    rows = [
        next((own for own in map(rewriter.row, (row, _expand_monomials(row, p))) if own is not None), None)
        for row in ca.vertsplit(f)
    ]
    if any(row is None for row in rows):
        return None
    c, parts = stack_column(symbol for symbol, _ in rewriter.parts), stack_column(part for _, part in rewriter.parts)
    ends = matrix_corners([parts], p, lower, upper)
    if ends is None:
        return None
    at = {
        point
        for (values,) in ends
        for point in product(*({exact.round_down(value), exact.round_up(value)} for value in values.ravel()))
    }
    if parts.numel() == 1:
        low, high = (float(np.ravel(end)[0]) for end in interval.enclose(parts, p, lower, upper))
        at = {(max(low, min(at)[0]),), (min(high, max(at)[0]),)}
    if len(at) > MAX_MIXTURE_CORNERS or not np.isfinite(list(at)).all():
        return None
    whole = stack_column(row for row in rows if row is not None)
    return [ca.substitute(whole, c, ca.SX(ca.DM(point))) for point in sorted(at)]


class _MixtureRewriter:
    """Goes through graphs; ``parts`` are the symbols c_j with what they stand for, of p alone."""

    def __init__(self, p: ca.SX) -> None:
        self.own, self.parts = symbol_hashes(p), list[tuple[ca.SX, ca.SX]]()

    def row(self, expr: ca.SX) -> ca.SX | None:
        (node,) = fold_graph(
            expr,
            lambda symbol: (
                _MixtureNode(symbol, KIND_PARAMETER, symbol)
                if symbol.element_hash() in self.own
                else _MixtureNode(symbol, KIND_FREE)
            ),
            lambda number: _MixtureNode(ca.SX(number), KIND_NUMBER),
            self._apply,
        )
        return None if node is None else self._as_affine_node(node).expr

    def _as_affine_node(self, node: _MixtureNode) -> _MixtureNode:
        """A node with its part of p alone as a symbol."""
        if node.kind not in (KIND_PARAMETER, KIND_SCALED):
            return node
        known = next((symbol for symbol, part in self.parts if is_same_expression(part, node.factor)), None)
        if known is None:
            known = ca.SX.sym(f"c{len(self.parts)}")
            self.parts.append((known, node.factor))
        return _MixtureNode(known if node.kind == KIND_PARAMETER else known * node.expr, KIND_AFFINE)

    def _apply(self, op: int, args: list[_MixtureNode | None]) -> _MixtureNode | None:
        given = [arg for arg in args if arg is not None]
        if len(given) < len(args) or op == ca.OP_CALL:
            return None
        kinds = [arg.kind for arg in given]
        if max(kinds) <= KIND_PARAMETER:
            whole = apply_operation(op, [arg.expr for arg in given])
            return _MixtureNode(whole, max(kinds), whole if KIND_PARAMETER in kinds else ca.SX(1))
        if op in MULTIPLICATIVE_OPERATIONS and {KIND_PARAMETER, KIND_SCALED} & set(kinds) and KIND_AFFINE not in kinds:
            free = [ca.SX(1) if arg.kind == KIND_PARAMETER else arg.expr for arg in given]
            return _MixtureNode(apply_operation(op, free), KIND_SCALED, apply_operation(op, [arg.factor for arg in given]))
        given = [self._as_affine_node(arg) for arg in given]
        affine = [arg.kind == KIND_AFFINE for arg in given]
        linear = (
            op in (ca.OP_ADD, ca.OP_SUB, ca.OP_NEG, ca.OP_TWICE, ca.OP_ASSIGN)
            or (op == ca.OP_MUL and not all(affine))
            or (op == ca.OP_DIV and not affine[1])
            or (op == ca.OP_IF_ELSE_ZERO and not affine[0])
        )
        if any(affine) and not linear:
            return None
        return _MixtureNode(apply_operation(op, [arg.expr for arg in given]), KIND_AFFINE if any(affine) else KIND_FREE)


def _expand_monomials(expr: ca.SX, p: ca.SX) -> ca.SX:
    """A sum in which polynomials in x and p are sums of monomials in x, with factors of p alone; else as it is."""
    if not expr.is_constant() and not expr.is_symbolic() and expr.op() in (ca.OP_ADD, ca.OP_SUB):
        return apply_operation(expr.op(), [_expand_monomials(expr.dep(k), p) for k in (0, 1)])
    z = stack_column(ca.symvar(expr))
    (found,) = polynomial.read_polynomials(expr, z)
    if found is None or not all(is_double(number) for number in found.values()):
        return expr
    own = symbol_hashes(p)
    of_p = [symbol.element_hash() in own for symbol in ca.vertsplit(z)] if z.numel() else []
    factors: dict[polynomial.Monomial, ca.SX] = {}
    for monomial, number in found.items():
        inner = tuple((variable, power) for variable, power in monomial if not of_p[variable])
        outer = tuple((variable, power) for variable, power in monomial if of_p[variable])
        factors[inner] = factors.get(inner, ca.SX(0)) + _monomial_expression(number, outer, z)
    return ca.SX(sum((factor * _monomial_expression(Fraction(1), inner, z) for inner, factor in factors.items()), ca.SX(0)))


def _monomial_expression(number: Fraction, powers: polynomial.Monomial, z: ca.SX) -> ca.SX:
    total = ca.SX(float(number))
    for variable, power in powers:
        total *= z[variable] ** power
    return total
