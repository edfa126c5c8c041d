"""Reading a potential: each nonsmooth node of the expression becomes a symbol with a known meaning."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError
from nsmodel.model.expressions import evaluate_at_samples, is_affine, is_constant
from nsmodel.proof.graph import OpaqueExpression, RewriteRule, is_same_expression, rewrite_nodes, stack_column, symbol_hashes

_UNSUPPORTED = {getattr(ca, f"OP_{name.upper()}"): name for name in "sign floor ceil fmod remainder copysign".split()}
_NONSMOOTH = (*_UNSUPPORTED, ca.OP_SQRT, ca.OP_HYPOT, ca.OP_CONSTPOW, ca.OP_FABS, ca.OP_FMAX, ca.OP_FMIN)


@dataclass(frozen=True, eq=False)
class NonsmoothNode:
    """A symbol and its meaning; ``args`` may hold the symbols of earlier nodes, ``text`` is what the user wrote.

    Kinds: "abs" |args|, "norm" |args|_2, "max" the largest of args, "domain" 0 on the domain ``text``, inf elsewhere.
    """

    kind: str
    symbol: ca.SX
    args: ca.SX
    text: str

    @property
    def pieces(self) -> list[ca.SX]:
        """The expressions whose maximum is an "abs" or "max" node."""
        return [self.args, -self.args] if self.kind == "abs" else ca.vertsplit(self.args)

    @property
    def meaning(self) -> ca.SX:
        """The value of the symbol (0 for the domain)."""
        if self.kind == "max":
            return reduce(ca.fmax, self.pieces)
        return {"abs": ca.fabs, "norm": ca.norm_2, "domain": lambda _: ca.SX(0)}[self.kind](self.args)


@dataclass(frozen=True, eq=False)
class PotentialCondition:
    """A condition of the domain: "indicator" u >= 0, "equality" u = 0 or "cone" |u[1:]| <= u[0]."""

    kind: str
    u: ca.SX
    text: str


@dataclass(frozen=True, eq=False)
class PotentialParts:
    """Phi = ``value``, smooth in y and the symbols of the nodes, on the domain given by the bounds."""

    value: ca.SX
    nodes: list[NonsmoothNode]
    bounds: list[PotentialCondition]

    @property
    def symbols(self) -> ca.SX:
        """The symbols of the nodes."""
        return stack_column(node.symbol for node in self.nodes)

    @property
    def slopes(self) -> list[ca.SX]:
        """The derivative of the value by each symbol."""
        return ca.horzsplit(ca.densify(ca.jacobian(self.value, self.symbols)))

    @property
    def held(self) -> set[int]:
        """The symbols that other nodes or the bounds hold."""
        return symbol_hashes(stack_column([*(node.args for node in self.nodes), *(bound.u for bound in self.bounds)]))

    def inside(self, expr: ca.SX) -> list[NonsmoothNode]:
        """Return the nodes whose symbol ``expr`` holds."""
        held = symbol_hashes(expr)
        return [node for node in self.nodes if node.symbol.element_hash() in held]

    def only(self, expr: ca.SX) -> tuple[NonsmoothNode | None, float]:
        """Return the node inside and its weight, where there is one node and its weight is a number."""
        inside = self.inside(expr)
        weight = ca.jacobian(expr, inside[0].symbol) if len(inside) == 1 else None
        return (None, 0.0) if weight is None or not weight.is_constant() else (inside[0], float(weight))

    def meanings(self, slack: dict[NonsmoothNode, ca.SX]) -> ca.SX:
        """Return what the symbols stand for in terms of y alone, plus the slack of each node that has some."""
        values = ca.SX(0, 1)
        for k, node in enumerate(self.nodes):
            exact = ca.substitute(node.meaning, stack_column(other.symbol for other in self.nodes[:k]), values)
            values = ca.vertcat(values, exact + slack.get(node, 0))
        return values


def read_potential_parts(phi: ca.SX, y: ca.SX, label: str) -> PotentialParts:
    """Put a symbol in place of every nonsmooth node that depends on y."""
    expr, nodes, bounds = _read_domain(phi, y, label)

    def add(kind: str, args: ca.SX, old: ca.SX) -> ca.SX:
        for node in nodes:
            if node.kind == kind and is_same_expression(node.args, args):
                return node.symbol
        nodes.append(NonsmoothNode(kind, ca.SX.sym(f"{label}_s{len(nodes)}"), args, str(old)))
        return nodes[-1].symbol

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX | None:
        if op in _UNSUPPORTED:
            raise ModelError(
                f"{label}: {_UNSUPPORTED[op]} in {old} has no subdifferential; write {label} with fabs, fmax, norm_2"
            )
        if op == ca.OP_FABS:
            return add("abs", args[0], old)
        if op in (ca.OP_FMAX, ca.OP_FMIN):
            sign = 1 if op == ca.OP_FMAX else -1
            return sign * add("max", sign * ca.vertcat(*(args[::-1] if args[0].is_constant() else args)), sign * old)
        u = _norm_argument(op, args, ca.vertcat(y, *(node.symbol for node in nodes)), old, label)
        if u is None:
            return None
        distance = add("abs" if u.numel() == 1 else "norm", u, old)
        return distance ** (2 * args[1]) if op == ca.OP_CONSTPOW else distance

    value, *us = ca.vertsplit(replay_expression(expr, rule, _NONSMOOTH, y, label))
    return PotentialParts(value, nodes, [replace(bound, u=u) for bound, u in zip(bounds, us, strict=True)])


def replay_expression(expr: ca.SX, rule: RewriteRule, ops: Sequence[int], x: ca.SX, label: str) -> ca.SX:
    """``rewrite_nodes`` of what a user wrote.

    Raises:
        ModelError: it calls a Function that cannot be looked into.
    """
    try:
        return rewrite_nodes(expr, rule, ops, x, label)
    except OpaqueExpression as error:
        raise ModelError(str(error)) from None


# -- conditions --------------------------------------------------------------------------------------------------------

_Literal = tuple[str, ca.SX, ca.SX]


def _read_domain(phi: ca.SX, y: ca.SX, label: str) -> tuple[ca.SX, list[NonsmoothNode], list[PotentialCondition]]:
    """Turn the conditions of the values inf into the domain, settle finite branches on it; a column of value and bounds."""
    nodes: list[NonsmoothNode] = []
    known: list[_Literal] = []
    bounds: list[PotentialCondition] = []
    branches: list[tuple[ca.SX, ca.SX, ca.SX, str]] = []

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX | None:
        (condition, value), symbol = args, ca.SX.sym(f"{label}_c{len(nodes) + len(branches)}")
        if not (value.is_constant() and np.isinf(float(value))):
            if not ca.depends_on(old.dep(0), y):
                return None
            branches.append((symbol, condition, value, str(old)))
            return symbol
        if float(value) < 0:
            raise ModelError(f"{label} takes the value -inf where {old.dep(0)}; a convex potential is +inf outside its domain")
        text, literals = str(ca.logic_not(old.dep(0))), _condition_literals(condition, False)
        if literals is None or any(relation == "!=" for relation, _, _ in literals):
            raise ModelError(
                f"{label} is not convex: its domain {text} is not a conjunction of <=, >=, ==; "
                "write the domain as such conditions joined by logic_and"
            )
        new = [literal for literal in literals if not _is_known_literal(literal, known)]
        bounds.extend(
            PotentialCondition("indicator", b - a, text) if r == "<=" else PotentialCondition("equality", a - b, text)
            for r, a, b in new
        )
        known.extend(new)
        nodes.append(NonsmoothNode("domain", symbol, ca.SX(0, 1), text))
        return symbol

    value = replay_expression(phi, rule, (ca.OP_IF_ELSE_ZERO,), y, label)
    expr = ca.vertcat(value, *(bound.u for bound in bounds))
    for symbol, condition, branch, text in reversed(branches):
        cases = [_condition_literals(condition, holds) for holds in (True, False)]
        holds = [case is not None and all(_is_known_literal(literal, known) for literal in case) for case in cases]
        if not any(holds):
            raise ModelError(
                f"{label}: {text} switches between finite values; write it with fmax, fmin or fabs, "
                "or give the value inf outside the domain"
            )
        expr = ca.substitute(expr, symbol, branch if holds[0] else 0)
    return expr, nodes, bounds


def _is_known_literal(literal: _Literal, known: Iterable[_Literal]) -> bool:
    relation, a, b = literal
    return any(relation == other and is_same_expression(a, left) and is_same_expression(b, right) for other, left, right in known)


def _condition_literals(condition: ca.SX, holds: bool) -> list[_Literal] | None:
    """Write a condition, or its negation, as a conjunction of ("<=" | "==" | "!=", a, b); None if it is not one."""
    op = condition.op()
    if op == ca.OP_NOT:
        return _condition_literals(condition.dep(0), not holds)
    if op in (ca.OP_AND, ca.OP_OR):
        if holds != (op == ca.OP_AND):
            return None
        left, right = _condition_literals(condition.dep(0), holds), _condition_literals(condition.dep(1), holds)
        return None if left is None or right is None else left + right
    if op in (ca.OP_LE, ca.OP_LT):
        a, b = condition.dep(0), condition.dep(1)
        return [("<=", a, b) if holds else ("<=", b, a)]
    if op in (ca.OP_EQ, ca.OP_NE):
        return [("==" if holds == (op == ca.OP_EQ) else "!=", condition.dep(0), condition.dep(1))]
    return None


# -- norms -------------------------------------------------------------------------------------------------------------


def _norm_argument(op: int, args: list[ca.SX], z: ca.SX, old: ca.SX, label: str) -> ca.SX | None:
    """Return u affine in z with ``old`` = |u|_2 (its power 2 args[1] for a power) where |u| has a zero, else None."""
    if op == ca.OP_CONSTPOW and not 0 < float(args[1]) < 1:
        return None
    q = args[0] ** 2 + args[1] ** 2 if op == ca.OP_HYPOT else args[0]
    entries = _squared_terms(q, z)
    u = _quadratic_root(q, z, old, label) if entries is None else stack_column(entries)
    if u is None:
        return None
    if is_affine(u, z):
        return None if _has_no_zero(u, z) else u
    if any(not ca.depends_on(entry, z) for entry in ca.vertsplit(u)):
        return None
    raise ModelError(f"{label}: {old} is the norm of a nonlinear expression; write it as norm_2 of an affine one")


def _squared_terms(q: ca.SX, z: ca.SX) -> list[ca.SX] | None:
    """Read q as a sum of squares u_i^2, factors without z taken into the square; None if it is not one."""
    op = q.op()
    if not ca.depends_on(q, z):
        return None if q.is_constant() and float(q) < 0 else [] if q.is_zero() else [ca.sqrt(q)]
    if op == ca.OP_SQ:
        return [q.dep(0)]
    if op == ca.OP_ADD:
        left, right = _squared_terms(q.dep(0), z), _squared_terms(q.dep(1), z)
        return None if left is None or right is None else left + right
    if op == ca.OP_TWICE:
        inner, factor = q.dep(0), ca.SX(2)
    elif op in (ca.OP_MUL, ca.OP_DIV):
        inner, factor = q.dep(0), q.dep(1) if op == ca.OP_MUL else 1 / q.dep(1)
        inner, factor = (inner, factor) if ca.depends_on(inner, z) else (factor, inner)
    else:
        return None
    entries = _squared_terms(inner, z)
    if entries is None or ca.depends_on(factor, z) or (factor.is_constant() and float(factor) < 0):
        return None
    return [ca.sqrt(factor) * entry for entry in entries]


def _quadratic_root(q: ca.SX, z: ca.SX, old: ca.SX, label: str) -> ca.SX | None:
    """Return u = L z + c with q = |u|^2, from the eigenvectors of the Hessian; None if q is not such a quadratic."""
    hessian, gradient = ca.hessian(q, z)
    if not is_constant(hessian, z):
        return None
    H, g = ca.substitute([ca.densify(hessian), gradient], [z], [ca.SX.zeros(z.numel())])
    if not H.is_constant():
        raise ModelError(f"{label}: the coefficients of {old} hold {ca.symvar(H)[0]}; write it as norm_2 of an affine expression")
    values, vectors = np.linalg.eigh(np.array(ca.DM(H)) / 2)
    tol = 1e-12 * np.abs(values).max()
    if tol == 0 or values.min() < -tol:
        return None
    squares = values[values > tol, None]
    L = np.sqrt(squares) * vectors[:, values > tol].T
    L[np.abs(L) < 1e-15 * np.abs(L).max()] = 0
    u = ca.DM(L) @ z + ca.DM(L / squares) @ g / 2
    rest = q - ca.sumsqr(u)
    both = ca.vertcat(rest, ca.gradient(rest, z), q, gradient)
    rest0, scale = np.split(np.abs(evaluate_at_samples(both, z, np.zeros((1, z.numel())))[0]), 2)
    return u if rest0.max() <= 1e-12 * (1 + scale.max()) else None


def _has_no_zero(u: ca.SX, z: ca.SX) -> bool:
    """Whether the affine u(z) has no zero, for generic values of the other symbols."""
    both = evaluate_at_samples(ca.horzcat(u, ca.jacobian(u, z)), z, np.zeros((1, z.numel())))
    c, *A = both.reshape(-1, u.numel())
    rest = c - np.transpose(A) @ np.linalg.lstsq(np.transpose(A), c, rcond=None)[0]
    return bool(np.linalg.norm(rest) > 1e-12 * (1 + np.linalg.norm(c)))
