"""Is an expression convex, by the rules of convex functions: a walk through its graph that keeps what is proved of each node.

A node is known as affine, convex or concave on a box from its operation, its arguments' curvature and their bounds: a convex
nondecreasing function of a convex one is convex, and so on; quadratic nodes are decided exactly, in rational arithmetic.

The signs of curvature and slope of functions of one variable on an interval.

Expressions as functions of directions: f(x) = h(a_1'x, a_2'x, ...), where each nonlinear operation acts on affine arguments.

Where h is convex in its arguments, f is convex in x; a function of one direction is flat in all others, so that the Hessian in
x has no positive least eigenvalue, and only the one in these arguments shows its sign.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import exact, interval_bounds, polynomial
from nsmodel.proof.expression_graph import (
    TRUTH_VALUED_OPERATIONS,
    apply_operation,
    fold_graph,
    is_double,
    operation_codes,
    rewrite_nodes,
    stack_column,
)

CurvatureRule = Callable[[float, float], tuple[int, int] | None]  # (curvature, slope) signs on [low, high], None where unknown


def even_curvature(low: float, high: float) -> tuple[int, int] | None:
    """Convex, with its least value at 0."""
    return 1, 1 if low >= 0 else -1 if high <= 0 else 0


def _odd_curvature(sign: int) -> CurvatureRule:
    """Increasing, of curvature ``sign`` on the right and -sign on the left, as x^3 or tanh (sign -1)."""
    return lambda low, high: (sign, 1) if low >= 0 else (-sign, 1) if high <= 0 else None


def _curvature_above(least: float, curvature: int, slope: int, *, strict: bool) -> CurvatureRule:
    """Defined above ``least`` only."""
    return lambda low, high: (curvature, slope) if (low > least if strict else low >= least) else None


UNARY_CURVATURES: dict[int, CurvatureRule] = {
    ca.OP_SQ: even_curvature, ca.OP_FABS: even_curvature, ca.OP_COSH: even_curvature,
    ca.OP_EXP: lambda low, high: (1, 1), ca.OP_EXPM1: lambda low, high: (1, 1),
    ca.OP_LOG: _curvature_above(0, -1, 1, strict=True), ca.OP_LOG1P: _curvature_above(-1, -1, 1, strict=True),
    ca.OP_SQRT: _curvature_above(0, -1, 1, strict=False),
    ca.OP_SINH: _odd_curvature(1), ca.OP_TANH: _odd_curvature(-1), ca.OP_ATAN: _odd_curvature(-1),
    ca.OP_ASINH: _odd_curvature(-1), ca.OP_ERF: _odd_curvature(-1),
}  # fmt: skip


def power_curvature(exponent: float) -> CurvatureRule:
    """x^p, with real values on the range."""

    def rule(low: float, high: float) -> tuple[int, int] | None:
        if exponent in (0, 1):
            return None
        if exponent == int(exponent) and exponent > 1:
            return even_curvature(low, high) if exponent % 2 == 0 else _odd_curvature(1)(low, high)
        if exponent < 0:
            return (1, -1) if low > 0 else None
        return ((1 if exponent > 1 else -1), 1) if low >= 0 else None

    return rule


def inverse_curvature(low: float, high: float) -> tuple[int, int] | None:
    """The signs of the second and of the first derivative of 1/x on an interval; None where 0 may be in it."""
    return (1, -1) if low > 0 else (-1, -1) if high < 0 else None


# Quadratic nodes in more variables are not decided one by one: each takes exact elimination, 0.02 s for 40.
MAX_QUADRATIC_VARIABLES = 40


@dataclass(frozen=True)
class Curvature:
    """What is proved of an expression on a box: both flags for an affine one; ``low`` and ``high`` bound its values."""

    convex: bool
    concave: bool
    low: float
    high: float
    log_convex: bool = False

    @property
    def affine(self) -> bool:
        """Whether it is affine."""
        return self.convex and self.concave


@dataclass(frozen=True)
class _ConvexityNode:
    op: int
    source: tuple[int, ...]
    expr: ca.SX
    constant: bool


def curvatures(expr: ca.SX, z: ca.SX, lower: np.ndarray, upper: np.ndarray, of: ca.SX | None = None) -> list[Curvature]:
    """Return what the rules prove of each entry of ``expr`` on the box (ends may be infinite).

    With ``of``, as functions of these symbols among z alone, for all values of the others in their box.

    >>> x = ca.SX.sym("x")
    >>> [s.convex for s in curvatures(ca.vertcat(ca.exp(x) + ca.fabs(x - 1), x**3), x, np.full(1, -np.inf), np.full(1, np.inf))]
    [True, False]
    """
    if ca.OP_CALL in operation_codes(expr):  # nothing is known of what cannot be looked into
        return [Curvature(False, False, -np.inf, np.inf)] * expr.numel()
    nodes, outputs = _convexity_nodes(expr, z if of is None else of)
    if not nodes:
        return []
    numeric = [k for k, node in enumerate(nodes) if node.op not in TRUTH_VALUED_OPERATIONS]
    low, high = np.full(len(nodes), -np.inf), np.full(len(nodes), np.inf)
    bounds = interval_bounds.enclose(stack_column(nodes[k].expr for k in numeric), z, lower, upper)
    low[numeric], high[numeric] = (np.asarray(end).ravel() for end in bounds)
    analysis = _ConvexityAnalysis(nodes, low, high, z.numel())
    return [analysis.shape(k) for k in outputs]


def global_curvatures(expr: ca.SX, z: ca.SX) -> list[Curvature]:
    """The same for all z."""
    return curvatures(expr, z, np.full(z.numel(), -np.inf), np.full(z.numel(), np.inf))


def resolve_kinks(expr: ca.SX, z: ca.SX, lower: np.ndarray, upper: np.ndarray, label: str) -> ca.SX:
    """``expr`` with each fabs, fmax, fmin and sign whose case is settled on the whole box replaced by that case."""

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX | None:
        u = args[0] if len(args) == 1 else args[0] - args[1]
        if op != ca.OP_FABS and not interval_bounds.is_number(u, z, lower, upper):
            return None  # fmax and fmin are the other argument where one has no value
        (low,), (high,) = (np.asarray(end).ravel() for end in interval_bounds.enclose(u, z, lower, upper))
        if op == ca.OP_SIGN:
            return ca.SX(1) if low > 0 else ca.SX(-1) if high < 0 else None
        case = 0 if low >= 0 else 1 if high <= 0 else None
        if case is None:
            return None
        if op == ca.OP_FABS:
            return (u, -u)[case]
        return args[case] if op == ca.OP_FMAX else args[1 - case]

    return rewrite_nodes(expr, rule, (ca.OP_FABS, ca.OP_FMAX, ca.OP_FMIN, ca.OP_SIGN), z, label)


def _convexity_nodes(expr: ca.SX, z: ca.SX) -> tuple[list[_ConvexityNode], list[int]]:
    """The graph in single assignment form, each node with its expression, and the node of each entry."""
    nodes: list[_ConvexityNode] = []

    def put(node: _ConvexityNode) -> int:
        nodes.append(node)
        return len(nodes) - 1

    def apply(op: int, where: list[int]) -> int:
        args = [nodes[j] for j in where]
        return put(
            _ConvexityNode(op, tuple(where), apply_operation(op, [arg.expr for arg in args]), all(arg.constant for arg in args))
        )

    outputs = fold_graph(
        expr,
        lambda symbol: put(_ConvexityNode(ca.OP_INPUT, (), symbol, not ca.depends_on(symbol, z))),
        lambda number: put(_ConvexityNode(ca.OP_CONST, (), ca.SX(number), True)),
        apply,
    )
    return nodes, outputs


class _ConvexityAnalysis:
    """Shapes of the nodes of a graph, each found once."""

    def __init__(self, nodes: list[_ConvexityNode], low: np.ndarray, high: np.ndarray, n: int) -> None:
        self.nodes, self.low, self.high, self.n = nodes, low, high, n
        self.known: list[Curvature] = []
        self.polynomials: list[polynomial.Polynomial | None] = []
        self.powers: list[tuple[int, bool, float]] = []  # (node u, whether |u|, p): the node is u^p or |u|^p
        for k in range(len(nodes)):
            self._analyse_node(k)

    def shape(self, k: int) -> Curvature:
        """What is known of node k."""
        return self.known[k]

    def _analyse_node(self, k: int) -> None:
        node = self.nodes[k]
        self.polynomials.append(self._node_polynomial(node))
        self.powers.append(self._as_power(k))
        if node.constant:
            self.known.append(Curvature(True, True, self.low[k], self.high[k], self.low[k] > 0))
            return
        if node.op == ca.OP_INPUT:
            self.known.append(Curvature(True, True, self.low[k], self.high[k]))
            return
        up, down = self._is_convex_by_rule(k, 1), self._is_convex_by_rule(k, -1)
        if not (up or down):
            up, down = self._quadratic_curvature(k)
        self.known.append(Curvature(up, down, self.low[k], self.high[k], self._is_log_convex(node)))

    def _node_polynomial(self, node: _ConvexityNode) -> polynomial.Polynomial | None:
        if node.op == ca.OP_INPUT:
            # The symbol itself is the variable's name: only sums and products of few are looked at.
            return None if node.constant else {((node.expr.element_hash(), 1),): Fraction(1)}
        if node.op == ca.OP_CONST:
            return polynomial.constant_polynomial(float(node.expr))
        args = [self.polynomials[j] for j in node.source]
        if any(arg is not None and polynomial.degree(arg) > 2 for arg in args):
            return None
        return polynomial.apply_to_polynomials(node.op, args)

    def _as_power(self, k: int) -> tuple[int, bool, float]:
        """Node k as u^p or |u|^p."""
        node = self.nodes[k]
        args = [self.powers[j] for j in node.source]
        if node.op == ca.OP_FABS:
            return (args[0][0], True, args[0][2]) if args[0][2] == int(args[0][2]) else (k, False, 1.0)
        if node.op == ca.OP_SQ and args[0][2] == int(args[0][2]):
            return args[0][0], args[0][1], 2 * args[0][2]
        if node.op == ca.OP_SQRT and not args[0][1] and self.low[args[0][0]] >= 0:
            return args[0][0], False, args[0][2] / 2
        if node.op == ca.OP_MUL and args[0][0] == args[1][0]:
            (u, one, p), (_, other, q) = args
            whole = p == int(p) and q == int(q)
            if whole and (one == other or (not one and p % 2 == 0) or (not other and q % 2 == 0)):
                return u, one or other, p + q
            if not (one or other) and self.low[u] >= 0:
                return u, False, p + q
        return k, False, 1.0

    # -- rules ---------------------------------------------------------------------------------------------------------

    def _is_convex_by_rule(self, k: int, sign: int) -> bool:
        """Whether sign times node k is proved convex."""
        node = self.nodes[k]
        if node.op == ca.OP_ASSIGN or node.op == ca.OP_TWICE:
            return self._has_curvature(node.source[0], sign)
        if node.op == ca.OP_NEG:
            return self._has_curvature(node.source[0], -sign)
        if node.op in (ca.OP_ADD, ca.OP_SUB):
            return self._has_curvature(node.source[0], sign) and self._has_curvature(
                node.source[1], sign if node.op == ca.OP_ADD else -sign
            )
        if node.op in (ca.OP_FMAX, ca.OP_FMIN):
            return (sign > 0) == (node.op == ca.OP_FMAX) and all(self._has_curvature(j, sign) for j in node.source)
        if node.op in (ca.OP_MUL, ca.OP_DIV):
            return self._is_convex_product(k, sign)
        if node.op == ca.OP_SQRT and sign > 0 and self._is_norm(node.source[0]):
            return True
        if node.op == ca.OP_HYPOT:
            return sign > 0 and all(self._has_convex_modulus(j) for j in node.source)
        if node.op in (ca.OP_LOG, ca.OP_LOG1P) and sign > 0 and self.known[node.source[0]].log_convex:
            return True
        return self._is_convex_composition(k, sign)

    def _has_curvature(self, k: int, sign: int) -> bool:
        return self.known[k].convex if sign > 0 else self.known[k].concave

    def _is_convex_product(self, k: int, sign: int) -> bool:
        node = self.nodes[k]
        left, right = node.source
        if self.nodes[left].constant and node.op == ca.OP_MUL:
            left, right = right, left
        if self.nodes[right].constant:
            low, high = self.low[right], self.high[right]
            if node.op == ca.OP_DIV and low <= 0 <= high:
                return False
            if self.known[left].affine:
                return True
            return (low >= 0 and self._has_curvature(left, sign)) or (high <= 0 and self._has_curvature(left, -sign))
        if self.nodes[left].constant:  # c / u
            low, high = self.low[left], self.high[left]
            factor = 1 if low >= 0 else -1 if high <= 0 else 0
            return bool(factor) and self._satisfies_composition_rule(inverse_curvature, right, sign * factor)
        u, absolute, p = self.powers[k]
        if u == k:
            return False
        return self._is_convex_power(u, absolute, p, sign)

    def _is_convex_composition(self, k: int, sign: int) -> bool:
        node = self.nodes[k]
        u, absolute, p = self.powers[k]
        if u != k and p != 1 and self._is_convex_power(u, absolute, p, sign):
            return True
        if node.op in (ca.OP_POW, ca.OP_CONSTPOW):
            base, exponent = node.source
            if not self.nodes[exponent].constant or self.low[exponent] != self.high[exponent]:
                return False
            return self._satisfies_composition_rule(power_curvature(float(self.low[exponent])), base, sign)
        if node.op == ca.OP_INV:
            return self._satisfies_composition_rule(inverse_curvature, node.source[0], sign)
        return node.op in UNARY_CURVATURES and self._satisfies_composition_rule(UNARY_CURVATURES[node.op], node.source[0], sign)

    def _is_convex_power(self, u: int, absolute: bool, p: float, sign: int) -> bool:
        return self._satisfies_composition_rule(even_curvature if absolute and p >= 1 else power_curvature(p), u, sign)

    def _satisfies_composition_rule(self, rule: CurvatureRule, u: int, sign: int) -> bool:
        """Whether sign f(u) is convex: f of that curvature, and u affine or curved the way that f's slope asks for."""
        found = rule(self.low[u], self.high[u])
        if found is None or found[0] != sign:
            return False
        inner = self.known[u]
        return inner.affine or (found[1] != 0 and self._has_curvature(u, sign * found[1]))

    def _is_norm(self, q: int) -> bool:
        """Whether sqrt(q) is a norm: q a sum of squares, or a quadratic that is one by exact arithmetic."""
        return self._is_sum_of_squares(q) or self._is_nonnegative_quadratic(q)

    def _is_sum_of_squares(self, q: int) -> bool:
        node = self.nodes[q]
        if node.constant:
            return bool(self.low[q] >= 0)
        if node.op == ca.OP_SQ:
            return self._has_convex_modulus(node.source[0])
        if node.op in (ca.OP_ADD, ca.OP_TWICE):
            return all(self._is_sum_of_squares(j) for j in node.source)
        if node.op in (ca.OP_MUL, ca.OP_DIV):
            left, right = node.source
            left, right = (right, left) if self.nodes[left].constant and node.op == ca.OP_MUL else (left, right)
            return self.nodes[right].constant and bool(self.low[right] >= 0) and self._is_sum_of_squares(left)
        return False

    def _has_convex_modulus(self, u: int) -> bool:
        """Whether |u| is convex, and so a norm of several such is."""
        inner = self.known[u]
        return inner.affine or (inner.convex and inner.low >= 0) or (inner.concave and inner.high <= 0)

    def _is_log_convex(self, node: _ConvexityNode) -> bool:
        args = [self.known[j] for j in node.source]
        if node.op == ca.OP_EXP:
            return args[0].convex
        if node.op == ca.OP_COSH:
            return args[0].affine
        if node.op in (ca.OP_ADD, ca.OP_MUL, ca.OP_TWICE):
            return all(arg.log_convex for arg in args)
        if node.op == ca.OP_DIV:
            return args[0].log_convex and self.nodes[node.source[1]].constant and args[1].low > 0
        return False

    # -- quadratic nodes -----------------------------------------------------------------------------------------------

    def _quadratic_curvature(self, k: int) -> tuple[bool, bool]:
        found = self._as_quadratic(k)
        if found is None:
            return False, False
        return exact.definiteness(found.H).psd, exact.definiteness(-found.H).psd

    def _is_nonnegative_quadratic(self, q: int) -> bool:
        """Whether x'Hx/2 + q'x + c is a sum of squares of affine functions: [[H, q], [q', 2c]] psd."""
        found = self._as_quadratic(q)
        if found is None:
            return False
        n = len(found.H)
        whole = exact.zeros(n + 1, n + 1)
        whole[:n, :n], whole[:n, n:], whole[n:, :n], whole[n, n] = found.H, found.q, found.q.T, 2 * found.c
        return exact.definiteness(whole).psd

    def _as_quadratic(self, k: int) -> polynomial.Quadratic | None:
        p = self.polynomials[k]
        if p is None or polynomial.degree(p) > 2:
            return None
        used = polynomial.variables(p)
        if len(used) > MAX_QUADRATIC_VARIABLES:
            return None
        place = {variable: i for i, variable in enumerate(used)}
        short = {tuple(sorted((place[v], power) for v, power in monomial)): number for monomial, number in p.items()}
        return polynomial.as_quadratic(short, len(used))


Direction = tuple[tuple[int, Fraction], ...]  # (variable, coefficient), the first coefficient 1
_RidgeNode = tuple[ca.SX, polynomial.Polynomial | None]  # a node, and its polynomial where it is affine


class Ridges(NamedTuple):
    """``h`` is an expression of the symbols ``s`` (k, 1), which stand for the directions ``a`` (k, n) of Fractions."""

    h: ca.SX
    s: ca.SX
    a: np.ndarray

    def box(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the symbols where x is in a box: the doubles nearest to them outside, themselves where they are doubles."""
        low, high = (np.array([_least_product(sign * row, lower, upper) for row in self.a]) for sign in (1, -1))
        return low, -high


def _least_product(a: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> float:
    """The least a'x on a box, rounded down."""
    ends = [(number, low if number > 0 else high) for number, low, high in zip(a, lower, upper, strict=True) if number]
    if not all(np.isfinite(end) for _, end in ends):
        return -np.inf
    return exact.round_down(sum((number * Fraction(float(end)) for number, end in ends), Fraction(0)))


def find_ridges(expr: ca.SX, x: ca.SX) -> Ridges | None:
    """Return a scalar as a function of as few directions as its graph shows; None where that takes rounding."""
    try:
        return _build_ridges(expr, x)
    except ValueError:
        return None


def _build_ridges(expr: ca.SX, x: ca.SX) -> Ridges:
    place = {symbol.element_hash(): i for i, symbol in enumerate(ca.vertsplit(x))}
    known: dict[Direction, ca.SX] = {}

    def variable(symbol: ca.SX) -> polynomial.Polynomial:
        if symbol.element_hash() not in place:
            raise ValueError("another symbol than x")
        return {((place[symbol.element_hash()], 1),): Fraction(1)}

    result = polynomial.rewrite_parts(expr, variable, lambda p: _direction_expression(p, known))
    a = [[dict(direction).get(j, Fraction(0)) for j in range(x.numel())] for direction in known]
    return Ridges(result, stack_column(known.values()), np.array(a, dtype=object).reshape(len(known), x.numel()))


def _direction_expression(p: polynomial.Polynomial, known: dict[Direction, ca.SX]) -> ca.SX:
    """An affine function written with the symbol of its direction; ValueError where doubles do not hold its coefficients."""
    linear = sorted((monomial[0][0], number) for monomial, number in p.items() if monomial)
    first, offset = linear[0][1], p.get((), Fraction(0))
    if not (is_double(first) and is_double(offset)):
        raise ValueError("a coefficient is no double")
    direction = tuple((variable, number / first) for variable, number in linear)
    symbol = known.setdefault(direction, ca.SX.sym(f"direction{len(known)}"))
    return float(first) * symbol + float(offset)
