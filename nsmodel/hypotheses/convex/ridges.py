"""Expressions as functions of directions: f(x) = h(a_1'x, a_2'x, ...), where each nonlinear operation acts on affine arguments.

Where h is convex in its arguments, f is convex in x; a function of one direction is flat in all others, so that the Hessian in
x has no positive least eigenvalue, and only the one in these arguments shows its sign.
"""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.proof import interval, polynomial
from nsmodel.model.expressions import column

ROUNDED = 1e-12  # Part of the terms of a'x by which its bounds are widened, for coefficients rounded to doubles.
Direction = tuple[tuple[int, Fraction], ...]  # (variable, coefficient), the first coefficient 1


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
        return low - ROUNDED * reach, high + ROUNDED * reach


def ridges(expr: ca.SX, x: ca.SX) -> Ridges | None:
    """Return a scalar as a function of as few directions as its graph shows; None where that takes rounding."""
    try:
        return _read(expr, x)
    except ValueError:
        return None


def _read(expr: ca.SX, x: ca.SX) -> Ridges | None:
    symbols = ca.symvar(expr)
    place = {symbol.element_hash(): i for i, symbol in enumerate(ca.vertsplit(x))}
    function = ca.Function("ridges", [column(symbols)], [expr])
    known: dict[Direction, ca.SX] = {}
    work: dict[int, tuple[ca.SX, polynomial.Polynomial | None]] = {}  # new node; the polynomial of an affine one
    result = ca.SX(0)
    for i in range(function.n_instructions()):
        op, source, target = function.instruction_id(i), function.instruction_input(i), function.instruction_output(i)
        if op == ca.OP_OUTPUT:
            result = _shown(*work[source[0]], known)
            continue
        if op == ca.OP_INPUT:
            index = place.get(symbols[source[1]].element_hash())
            if index is None:
                return None
            work[target[0]] = symbols[source[1]], {((index, 1),): Fraction(1)}
            continue
        if op == ca.OP_CONST:
            number = function.instruction_constant(i)
            work[target[0]] = ca.SX(number), polynomial.constant(number)
            continue
        if len(source) > 2:
            return None
        args = [work[j] for j in source]
        p = polynomial.apply(op, [q for _, q in args if q is not None]) if all(q is not None for _, q in args) else None
        build = ca.SX.unary if len(source) == 1 else ca.SX.binary
        if p is not None and polynomial.degree(p) <= 1:
            work[target[0]] = build(op, *(node for node, _ in args)), p
        else:
            work[target[0]] = build(op, *(_shown(node, q, known) for node, q in args)), None
    a = [[dict(direction).get(j, Fraction(0)) for j in range(x.numel())] for direction in known]
    return Ridges(result, column(known.values()), np.array(a, dtype=object).reshape(len(known), x.numel()))


def _shown(node: ca.SX, p: polynomial.Polynomial | None, known: dict[Direction, ca.SX]) -> ca.SX:
    """An affine node written with the symbol of its direction; ValueError where doubles do not hold its coefficients."""
    if p is None or polynomial.is_constant(p):
        return node
    linear = sorted((monomial[0][0], number) for monomial, number in p.items() if monomial)
    first, offset = linear[0][1], p.get((), Fraction(0))
    if Fraction(float(first)) != first or Fraction(float(offset)) != offset:
        raise ValueError("a coefficient is no double")
    direction = tuple((variable, number / first) for variable, number in linear)
    symbol = known.setdefault(direction, ca.SX.sym(f"direction{len(known)}"))
    return float(first) * symbol + float(offset)
