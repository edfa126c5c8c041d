"""Expressions as functions of directions: f(x) = h(a_1'x, a_2'x, ...), where each nonlinear operation acts on affine arguments.

Where h is convex in its arguments, f is convex in x; a function of one direction is flat in all others, so that the Hessian in
x has no positive least eigenvalue, and only the one in these arguments shows its sign.
"""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import interval, polynomial
from nsmodel.proof.graph import apply_operation, fold_graph, stack_column
from nsmodel.proof.straight_line import is_double

COEFFICIENT_ROUNDING = 1e-12  # Part of the terms of a'x by which its bounds are widened, for coefficients rounded to doubles.
Direction = tuple[tuple[int, Fraction], ...]  # (variable, coefficient), the first coefficient 1
_RidgeNode = tuple[ca.SX, polynomial.Polynomial | None]  # a node, and its polynomial where it is affine


class Ridges(NamedTuple):
    """``h`` is an expression of the symbols ``s`` (k, 1), which stand for the directions ``a`` (k, n) of Fractions."""

    h: ca.SX
    s: ca.SX
    a: np.ndarray

    def box(self, x: ca.SX, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the symbols where x is in a box, wider than rounding of the directions."""
        if not self.s.numel():
            return np.zeros(0), np.zeros(0)
        a = np.array([[float(number) for number in row] for row in self.a])
        low, high = (np.asarray(end).ravel() for end in interval.enclose(ca.DM(a) @ x, x, lower, upper))
        far = np.maximum(np.abs(lower), np.abs(upper))
        reach = np.where(np.isfinite(far), np.abs(a) * np.where(np.isfinite(far), far, 0.0), 0.0).sum(axis=1)
        return low - COEFFICIENT_ROUNDING * reach, high + COEFFICIENT_ROUNDING * reach


def find_ridges(expr: ca.SX, x: ca.SX) -> Ridges | None:
    """Return a scalar as a function of as few directions as its graph shows; None where that takes rounding."""
    try:
        return _build_ridges(expr, x)
    except ValueError:
        return None


def _build_ridges(expr: ca.SX, x: ca.SX) -> Ridges:
    place = {symbol.element_hash(): i for i, symbol in enumerate(ca.vertsplit(x))}
    known: dict[Direction, ca.SX] = {}

    def variable(symbol: ca.SX) -> _RidgeNode:
        if symbol.element_hash() not in place:
            raise ValueError("another symbol than x")
        return symbol, {((place[symbol.element_hash()], 1),): Fraction(1)}

    def apply(op: int, args: list[_RidgeNode]) -> _RidgeNode:
        p = (
            polynomial.apply_to_polynomials(op, [q for _, q in args if q is not None])
            if all(q is not None for _, q in args)
            else None
        )
        if p is not None and polynomial.degree(p) <= 1:
            return apply_operation(op, [node for node, _ in args]), p
        return apply_operation(op, [_direction_expression(node, q, known) for node, q in args]), None

    (last,) = fold_graph(expr, variable, lambda number: (ca.SX(number), polynomial.constant_polynomial(number)), apply)
    result = _direction_expression(*last, known)
    a = [[dict(direction).get(j, Fraction(0)) for j in range(x.numel())] for direction in known]
    return Ridges(result, stack_column(known.values()), np.array(a, dtype=object).reshape(len(known), x.numel()))


def _direction_expression(node: ca.SX, p: polynomial.Polynomial | None, known: dict[Direction, ca.SX]) -> ca.SX:
    """An affine node written with the symbol of its direction; ValueError where doubles do not hold its coefficients."""
    if p is None or polynomial.is_constant(p):
        return node
    linear = sorted((monomial[0][0], number) for monomial, number in p.items() if monomial)
    first, offset = linear[0][1], p.get((), Fraction(0))
    if not (is_double(first) and is_double(offset)):
        raise ValueError("a coefficient is no double")
    direction = tuple((variable, number / first) for variable, number in linear)
    symbol = known.setdefault(direction, ca.SX.sym(f"direction{len(known)}"))
    return float(first) * symbol + float(offset)
