"""A matrix of functions on a box as a map that is affine in each of a few numbers: its values lie in the hull of its corners.

Sums and products stay as they are; 1/p, p^2, sqrt(p), ... become numbers of their own, between bounds. What holds for the
corners and is convex in the matrix (P M + M'P <= 2 omega P, M + M' >= 0, P M = N), then holds for all values.

Functions of x and p as convex combinations, whose weights depend on p alone, of functions of x.

Where f(x, p) = f_0(x) + sum c_j(p) f_j(x), the point (c_1(p), c_2(p), ...) lies in the hull of corners c^k for all p of a box,
and f(., p) = sum w_k(p) f(., c^k) with w_k >= 0, sum w_k = 1. What is convex in functions (convexity, monotonicity, bounds of
values, of growth, of one-sided Lipschitz constants) and holds for all f(., c^k), holds for all p.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import product
from math import prod
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import exact, interval_bounds, polynomial
from nsmodel.proof.exact import zeros
from nsmodel.proof.expression_graph import apply_operation, fold_graph, is_double, is_same_expression, stack_column, symbol_hashes
from nsmodel.proof.polynomial import Polynomial

# Corners of the box of parameters on which matrices depend, 2^8; where there are more the hull is not formed.
MAX_MATRIX_CORNERS = 256
MAX_MATRIX_ENTRIES = 2000  # Entries of such matrices; more are not formed: 2000 at 256 corners take 6 s, in Fractions.

NodePolynomial = tuple[ca.SX, Polynomial | None]  # A node, and what it is in the numbers.


def matrix_corners(matrices: Sequence[ca.SX], p: ca.SX, lower: np.ndarray, upper: np.ndarray) -> list[list[np.ndarray]] | None:
    """Return the corners [[M_1, M_2, ...], ...] of matrices that depend on p alone, each with entries in Fractions.

    The point (M_1(p), M_2(p), ...) lies in the convex hull of the corners for each p (k,) in the box lower <= p <= upper.

    Returns:
        None where a part is not finite on the box, or where the corners are too many.

    >>> p = ca.SX.sym("p")
    >>> [float(M[0, 0]) for (M,) in matrix_corners([2 / p + 1], p, np.array([1.0]), np.array([4.0]))]
    [1.5, 3.0]
    """
    entries = stack_column(ca.vec(ca.densify(matrix)) for matrix in matrices)
    reader = _MultiaffineReader(p, np.asarray(lower, float), np.asarray(upper, float))
    if entries.numel() > MAX_MATRIX_ENTRIES or not np.isfinite(interval_bounds.enclose(entries, p, lower, upper)).all():
        return None
    read = [reader.quotient(entry) for entry in ca.vertsplit(entries)] if entries.numel() else []
    others = iter(
        fold_graph(
            stack_column(entries[k] for k, part in enumerate(read) if part is None), reader.symbol, reader.number, reader.apply
        )
    )
    parts = [reader.affine(next(others)[1] if part is None else part) for part in read]
    used = sorted({variable for part in parts if part is not None for variable in polynomial.variables(part)})
    if any(part is None for part in parts) or prod(len(set(reader.ends[variable])) for variable in used) > MAX_MATRIX_CORNERS:
        return None
    found = []
    for ends in product(*(sorted(set(reader.ends[variable])) for variable in used)):
        at = dict(zip(used, ends, strict=True))
        found.append(
            _matrices_from_entries([polynomial.evaluate_polynomial(part, at) for part in parts if part is not None], matrices)
        )
    return found


def without_common_factor(
    matrix: ca.SX, p: ca.SX, lower: np.ndarray, upper: np.ndarray
) -> tuple[ca.SX, np.ndarray] | None:  # fmt: skip
    """Return (c, M) with c(p) M the matrix and c > 0 on the box, M in Fractions; None where it is no such product.

    >>> p = ca.SX.sym("p")
    >>> factor, M = without_common_factor(ca.horzcat(-p / 3, 2 * p), p, np.array([1.0]), np.array([4.0]))
    >>> factor, M.tolist()
    (SX((p/3)), [[Fraction(-1, 1), Fraction(6, 1)]])
    """
    M, factor = zeros(*matrix.shape), None
    for i, j in zip(*ca.sparsify(matrix).sparsity().get_triplet(), strict=True):
        entry = matrix[i, j]
        factor = entry if factor is None else factor
        ratio = polynomial.read_quotient(entry / factor, p)
        if ratio is None or not ratio[1]:
            return None
        top, bottom = ratio
        some = next(iter(bottom))
        number = top.get(some, Fraction(0)) / bottom[some]
        if polynomial.scale_polynomial(bottom, number) != top:
            return None
        M[i, j] = number
    if factor is None:
        return None
    low, high = (float(end.item()) for end in interval_bounds.enclose(factor, p, lower, upper))
    if not (0 < low <= high < np.inf or -np.inf < low <= high < 0):
        return None
    return (factor, M) if low > 0 else (-factor, -M)


class _MultiaffineReader:
    """Reads a graph; ``ends[k]`` are the bounds of number k, ``known`` and ``inverses`` say what has one."""

    def __init__(self, p: ca.SX, lower: np.ndarray, upper: np.ndarray) -> None:
        self.p, self.lower, self.upper = p, lower, upper
        self.place = {symbol.element_hash(): k for k, symbol in enumerate(ca.vertsplit(p))}
        self.ends = [(Fraction(a), Fraction(b)) for a, b in zip(lower.tolist(), upper.tolist(), strict=True)]
        self.known: list[tuple[ca.SX, int]] = []
        self.powers: dict[tuple[int, int], int] = {}
        self.inverses: dict[frozenset[tuple[polynomial.Monomial, Fraction]], int] = {}

    def quotient(self, entry: ca.SX) -> Polynomial | None:
        """A quotient of polynomials in p, reduced, as a polynomial and a number for what it is divided by."""
        found = polynomial.read_quotient(entry, self.p)
        if found is None:
            return None
        top, bottom = polynomial.cancel_common_factors(*found, self.p.numel())
        if len(bottom) == 1:
            (powers, size), through_zero = next(iter(bottom.items())), [low <= 0 <= high for low, high in self.ends]
            if any(through_zero[variable] for variable, _ in powers):
                return None
            return {_divide_monomial(monomial, powers): factor / size for monomial, factor in top.items()}
        size = next(iter(bottom.values()))
        key = frozenset(polynomial.scale_polynomial(bottom, 1 / size).items())
        if key not in self.inverses:
            low, high = self._polynomial_bounds(dict(key))
            if low <= 0 <= high:
                return None
            self.inverses[key] = len(self.ends)
            self.ends.append((1 / high, 1 / low))
        return polynomial.multiply(top, {((self.inverses[key], 1),): 1 / size})

    def _polynomial_bounds(self, part: Polynomial) -> tuple[Fraction, Fraction]:
        """Bounds of a polynomial over the box, monomial by monomial."""
        low = high = Fraction(0)
        for monomial, factor in part.items():
            term = (factor, factor)
            for variable, power in monomial:
                term = _product_bounds(term, _power_bounds(self.ends[variable], power))
            low, high = low + min(term), high + max(term)
        return low, high

    def symbol(self, symbol: ca.SX) -> NodePolynomial:
        return symbol, {((self.place[symbol.element_hash()], 1),): Fraction(1)}

    def number(self, value: float) -> NodePolynomial:
        return ca.SX(value), polynomial.constant_polynomial(value)

    def apply(self, op: int, args: list[NodePolynomial]) -> NodePolynomial:
        if op == ca.OP_CALL:
            return ca.SX(0), None
        node, parts = apply_operation(op, [part[0] for part in args]), [part[1] for part in args]
        if any(part is None for part in parts):
            return node, None
        plain = polynomial.apply_to_polynomials(op, parts)
        if plain is None and op == ca.OP_DIV:
            inverse = self._node_variable(apply_operation(ca.OP_INV, [args[1][0]]))
            plain = inverse and polynomial.multiply(parts[0] or {}, inverse)
        return node, self._node_variable(node) if plain is None else plain

    def affine(self, part: Polynomial | None) -> Polynomial | None:
        """The part with powers as numbers of their own."""
        if part is None:
            return None
        found: Polynomial = {}
        for monomial, factor in part.items():
            names = tuple(
                sorted((variable if power == 1 else self._power_variable(variable, power), 1) for variable, power in monomial)
            )
            found[names] = found.get(names, Fraction(0)) + factor
        return found

    def _node_variable(self, node: ca.SX) -> Polynomial | None:
        """A number that stands for a node; None where it has no bounds."""
        for other, variable in self.known:
            if ca.is_equal(node, other, 20):
                return {((variable, 1),): Fraction(1)}
        low, high = (float(end.item()) for end in interval_bounds.enclose(node, self.p, self.lower, self.upper))
        if not (np.isfinite(low) and np.isfinite(high)):
            return None
        self.known.append((node, len(self.ends)))
        self.ends.append((Fraction(low), Fraction(high)))
        return {((self.known[-1][1], 1),): Fraction(1)}

    def _power_variable(self, variable: int, power: int) -> int:
        key = (variable, power)
        if key not in self.powers:
            self.powers[key] = len(self.ends)
            self.ends.append(_power_bounds(self.ends[variable], power))
        return self.powers[key]


def _divide_monomial(monomial: polynomial.Monomial, by: polynomial.Monomial) -> polynomial.Monomial:
    """A monomial whose powers may be negative."""
    powers = dict(monomial)
    for variable, power in by:
        powers[variable] = powers.get(variable, 0) - power
    return tuple(sorted((variable, power) for variable, power in powers.items() if power))


def _power_bounds(ends: tuple[Fraction, Fraction], power: int) -> tuple[Fraction, Fraction]:
    low, high = sorted(end**power for end in ends)
    return (Fraction(0) if power % 2 == 0 and ends[0] < 0 < ends[1] else low), high


def _product_bounds(a: tuple[Fraction, Fraction], b: tuple[Fraction, Fraction]) -> tuple[Fraction, Fraction]:
    products = [x * y for x in a for y in b]
    return min(products), max(products)


def _matrices_from_entries(entries: list[Fraction], matrices: Sequence[ca.SX]) -> list[np.ndarray]:
    """The entries, column by column, as matrices."""
    found, first = [], 0
    for matrix in matrices:
        own = zeros(*matrix.shape)
        for k in range(matrix.numel()):
            own[k % matrix.shape[0], k // matrix.shape[0]] = entries[first + k]
        first += matrix.numel()
        found.append(own)
    return found


# Corners of what multiplies expressions free of p, 2^6; of more none are formed, as each is an expression of its own.
MAX_MIXTURE_CORNERS = 64
KIND_NUMBER, KIND_PARAMETER, KIND_FREE, KIND_SCALED, KIND_AFFINE = range(5)  # What a node is made of, see `_MixtureNode`.
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
        low, high = (float(np.ravel(end)[0]) for end in interval_bounds.enclose(parts, p, lower, upper))
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
