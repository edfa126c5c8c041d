"""A convex potential Phi split into a smooth part and terms whose subdifferential is known.

:mod:`nsmodel.modeling.convex_split` puts a symbol in place of each nonsmooth node (fabs, fmax, fmin, the square root of a
squared distance, an ``if_else`` with the value inf). A symbol that enters with a constant weight gives a :class:`Term`;
the others are nested and take the epigraph form. Signs: for l ∈ -dPhi(y), each term has a multiplier l' with
-u ∈ N_K(l') and contributes J_u' l' to l (J_u' is the transpose).

Reading a potential: each nonsmooth node of the expression becomes a symbol with a known meaning.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError
from nsmodel.modeling.expressions import evaluate_at_samples, is_affine, is_concave, is_constant, sample_points
from nsmodel.modeling.pickling import Picklable
from nsmodel.proof.expression_graph import (
    OpaqueExpression,
    RewriteRule,
    is_same_expression,
    numeric_constants,
    rewrite_nodes,
    stack_column,
    symbol_hashes,
)

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


DOMAIN_KINDS = ("indicator", "cone")  # Terms that bound the domain.


@dataclass(frozen=True, eq=False)
class ConvexTerm(Picklable):
    """One nonsmooth term: a function of u(y), or of u(y, tau).

    Attributes:
        kind: with K the set of the multiplier l',
            "abs" weight |u|, K = [-weight, weight];
            "max" weight max(u, 0), K = [-weight, 0];
            "norm" weight |u|_2, K the ball of radius weight, two or more entries;
            "indicator" of {u >= 0}, K = [0, inf);
            "equality" the indicator of {u = 0}, K = R;
            "cone" the indicator of {|u[1:]|_2 <= u[0]}, K that second-order cone.
        weight: SX (1, 1), a number >= 0 or an expression of parameters and time of unknown sign; 1 for the indicators.
        u: SX (m, 1), affine in y for "abs", "norm", "equality" and "cone"; concave for an "indicator".
    """

    kind: str
    weight: ca.SX
    u: ca.SX


@dataclass(frozen=True, eq=False)
class ConvexSplit(Picklable):
    """Phi(y) = min over tau of smooth(y, tau) + the terms, subject to epigraph[i] <= tau[epigraph_of[i]].

    Attributes:
        smooth: SX (1, 1), differentiable.
        terms: the nonsmooth terms.
        tau: SX (k, 1), one symbol for each nested node; empty when nothing is nested, and then Phi = smooth + terms.
        epigraph: SX (r, 1), expressions of y and tau.
        epigraph_of: for each row of ``epigraph`` the index of its tau.
    """

    smooth: ca.SX
    terms: tuple[ConvexTerm, ...]
    tau: ca.SX
    epigraph: ca.SX
    epigraph_of: tuple[int, ...]

    def with_terms(self, terms: Iterable[ConvexTerm]) -> ConvexSplit:
        """Return the same split with other terms."""
        return replace(self, terms=tuple(terms))

    @property
    def domain(self) -> list[ca.SX]:
        """Columns of expressions of y that are >= 0 where Phi is finite."""
        bounds = [
            term
            for term in self.terms
            if term.kind in DOMAIN_KINDS and not (self.tau.numel() and ca.depends_on(term.u, self.tau))
        ]
        return [term.u if term.kind == "indicator" else term.u[0] - ca.norm_2(term.u[1:]) for term in bounds]


def split_convex(phi: ca.SX, y: ca.SX, label: str) -> ConvexSplit:
    """Split a proper convex function of ``y`` into a smooth part and nonsmooth terms.

    ``phi`` may hold other symbols (parameters, time). Where the split rests on a property that cannot be read off the
    expression (a term grows with its nested terms), it is tested at sample points, with all other symbols positive.
    The convexity of the smooth part is not tested. A strict inequality in a condition stands for its closure.

    Args:
        phi: SX (1, 1).
        y: SX (n, 1) of symbols.
        label: the user's name of ``phi``, for messages.

    Raises:
        ModelError: ``phi`` is not scalar, not seen to be convex, or holds an operation without a known subdifferential.

    >>> y = ca.SX.sym("y", 2)
    >>> parts = split_convex(3 * ca.fabs(y[0] - 1) + y[1] ** 2, y, "phi")
    >>> parts.smooth, parts.terms
    (SX(sq(y_1)), (ConvexTerm(kind='abs', weight=SX(3), u=SX((y_0-1))),))
    """
    if phi.shape != (1, 1):
        raise ModelError(f"{label}: shape {phi.shape}; expected one scalar expression, the potential")
    parts = read_potential_parts(phi, y, label)
    parts = replace(parts, bounds=[simple for bound in parts.bounds for simple in _rewrite_domain_bound(bound, parts, y, label)])
    parts = _prune_nodes(_restore_smooth_nodes(parts, y))
    for node in parts.nodes:
        if node.kind == "abs" and not is_affine(node.args, ca.vertcat(y, parts.symbols)):
            raise ModelError(
                f"{label} is not recognised as convex: {node.text} is the absolute value of a nonlinear expression; "
                "write it with fabs of affine expressions, or with fmax"
            )
    nested = _epigraph_nodes(parts, y)
    _check_growth(parts, nested, y, label)
    return _assemble_split(parts, nested, y, label)


def split_discontinuities(expr: ca.SX, x: ca.SX, label: str) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Replace each sign(u) in ``expr`` by a symbol s that stands for an element of Sgn(u), [-1, 1] where u = 0.

    Args:
        expr: SX (n, 1).
        x: SX (n, 1) of symbols; a sign whose argument does not depend on ``x`` is left.
        label: the user's name of ``expr``, for messages.

    Returns:
        ``expr`` with symbols (n, 1), the symbols s (k, 1), the arguments u (k, 1).

    Raises:
        ModelError: a sign inside another one.

    >>> x = ca.SX.sym("x")
    >>> split_discontinuities(2 * x + 3 * ca.sign(x - 1), x, "operator")
    (SX(((2.*x)+(3*operator_sgn0))), SX(operator_sgn0), SX((x-1)))
    """
    symbols: list[ca.SX] = []
    arguments: list[ca.SX] = []

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX:
        if symbol_hashes(args[0]) & symbol_hashes(stack_column(symbols)):
            raise ModelError(f"{label}: {old} has a sign inside a sign; write {label} with separate sign(u), u continuous")
        for symbol, argument in zip(symbols, arguments, strict=True):
            if is_same_expression(argument, args[0]):
                return symbol
        symbols.append(ca.SX.sym(f"{label}_sgn{len(symbols)}"))
        arguments.append(args[0])
        return symbols[-1]

    return replay_expression(expr, rule, (ca.OP_SIGN,), x, label), stack_column(symbols), stack_column(arguments)


# -- rewriting nodes ---------------------------------------------------------------------------------------------------


def _rewrite_domain_bound(bound: PotentialCondition, parts: PotentialParts, y: ca.SX, label: str) -> list[PotentialCondition]:
    """Write r - w |u| >= 0 and the like, w > 0, without the nonsmooth node; drop what always holds."""
    inside = parts.inside(bound.u)
    if bound.kind == "equality" and (inside or not is_affine(bound.u, y)):
        raise ModelError(f"{label} is not convex: the equality in its domain {bound.text} is not affine; give an affine one")
    if not inside and bound.u.is_constant():
        if float(bound.u) < 0 or (bound.kind == "equality" and float(bound.u) != 0):
            raise ModelError(f"{label} is +inf everywhere: its domain {bound.text} is empty; correct the condition")
        return []
    node, weight = parts.only(bound.u)
    if node is None:
        return [bound]
    if weight > 0:
        raise ModelError(f"{label} is not convex: its domain {bound.text} is not convex; reverse the inequality")
    if node.kind == "norm":
        r = ca.substitute(bound.u, node.symbol, 0)
        return [PotentialCondition("cone", ca.vertcat(r / -weight, node.args), bound.text)]
    cases = [replace(bound, u=ca.substitute(bound.u, node.symbol, piece)) for piece in node.pieces]
    return [simple for case in cases for simple in _rewrite_domain_bound(case, parts, y, label)]


def _restore_smooth_nodes(parts: PotentialParts, y: ca.SX) -> PotentialParts:
    """Put the node itself back where its kink does not show, as in fabs(y)^1.5 or fmax(y, 0)^2."""
    meanings, smooth, held = parts.meanings({}), [], parts.held
    for node, slope in zip(parts.nodes, parts.slopes, strict=True):
        if node.kind not in ("abs", "max") or slope.is_constant() or node.symbol.element_hash() in held:
            continue
        u, kink = (node.args, ca.SX(0)) if node.kind == "abs" else (node.args[0] - node.args[1], node.args[1])
        if parts.inside(u) or not is_affine(u, y):
            continue
        row = ca.jacobian(u, y)
        at_kink = ca.substitute(ca.substitute(slope, node.symbol, kink), parts.symbols, meanings)
        values = evaluate_at_samples(ca.substitute(at_kink, y, y - row.T * u / ca.sumsqr(row)), y, sample_points(y.numel(), 12))
        if np.isfinite(values).all() and np.abs(values).max() <= 1e-9:
            smooth.append(node)
    symbols, meanings = stack_column(node.symbol for node in smooth), stack_column(node.meaning for node in smooth)
    return replace(parts, value=ca.substitute(parts.value, symbols, meanings))


def _prune_nodes(parts: PotentialParts) -> PotentialParts:
    """Drop the nodes that nothing uses any more, and write a max of kinks as a max of smooth pieces."""
    used, kept = symbol_hashes(stack_column([parts.value, *(bound.u for bound in parts.bounds)])), []
    for node in reversed(parts.nodes):
        if node.symbol.element_hash() in used:
            if node.kind == "max":
                node = replace(node, args=stack_column(flat for piece in node.pieces for flat in _flatten_piece(piece, parts)))
            used |= symbol_hashes(node.args)
            kept.insert(0, node)
    return replace(parts, nodes=kept)


def _flatten_piece(piece: ca.SX, parts: PotentialParts) -> list[ca.SX]:
    """Write a + w |u|, w > 0, as the pieces a + w u, a - w u, and so for a max: one tau for a nested max, not two."""
    node, weight = parts.only(piece)
    if node is None or weight < 0 or node.kind not in ("abs", "max"):
        return [piece]
    return [flat for inner in node.pieces for flat in _flatten_piece(ca.substitute(piece, node.symbol, inner), parts)]


# -- sorting the nodes -------------------------------------------------------------------------------------------------


def _epigraph_nodes(parts: PotentialParts, y: ca.SX) -> list[NonsmoothNode]:
    """Nodes that take a tau: they hold or are held by another, have over two pieces, or a varying weight."""
    z, symbols, held = ca.vertcat(y, parts.symbols), symbol_hashes(parts.symbols), parts.held
    return [
        node
        for node, weight in zip(parts.nodes, parts.slopes, strict=True)
        if symbol_hashes(node.args) & symbols
        or node.symbol.element_hash() in held
        or (node.kind == "max" and node.args.numel() > 2)
        or not is_constant(weight, z)
    ]


def _check_growth(parts: PotentialParts, nested: Sequence[NonsmoothNode], y: ca.SX, label: str) -> None:
    """Check at sample points that Phi grows with each nested node, so that minimising over tau >= node gives Phi.

    The last tau goes first: for fixed tau_1..tau_k, with the later ones at their exact values, the value must not
    decrease in tau_k. This is weaker than growth in all tau at once, and enough for the minimum.
    """
    slack, count, n = ca.SX.sym("slack", len(nested)), 200, y.numel()
    above = parts.meanings(dict(zip(nested, ca.vertsplit(slack), strict=True)))
    gaps = [-b.u if b.kind == "indicator" else ca.norm_2(b.u[1:]) - b.u[0] for b in parts.bounds if b.kind != "equality"]
    watched = ca.substitute(stack_column([parts.value, *gaps]), parts.symbols, above)
    rng, inputs = np.random.default_rng(1), ca.vertcat(y, slack)
    for k, node in enumerate(nested):
        low = np.zeros((count, n + len(nested)))
        low[:, :n] = sample_points(n, count)
        low[:, n : n + k + 1] = rng.exponential(1, (count, k + 1)) * rng.integers(0, 2, (count, k + 1))
        high = low.copy()
        high[:, n + k] += rng.exponential(1, count)
        before, after = np.split(evaluate_at_samples(watched, inputs, np.concatenate([low, high])), 2)
        finite = np.isfinite(before) & np.isfinite(after)
        fall = np.where(finite, before - after - 1e-9 * (1 + np.abs(before)), -1)
        if not finite[:, 0].any() or (fall > 0).any():
            raise ModelError(
                f"{label} is not recognised as convex: it does not grow with the nested term {node.text}; "
                "write it as a sum of fabs, fmax and norm_2 with weights >= 0"
            )


def _assemble_split(parts: PotentialParts, nested: Sequence[NonsmoothNode], y: ca.SX, label: str) -> ConvexSplit:
    levels = [node for node in nested if node.kind != "domain"]
    tau = ca.SX.sym(f"{label}_tau", len(levels)) if levels else ca.SX(0, 1)
    of_node = dict(zip(levels, ca.vertsplit(tau), strict=True))
    base = [node.args[1] if node.kind == "max" and node not in of_node else ca.SX(0) for node in parts.nodes]
    new = stack_column(of_node.get(node, rest) for node, rest in zip(parts.nodes, base, strict=True))

    def put(expr: ca.SX) -> ca.SX:
        return ca.substitute(expr, parts.symbols, new)

    z = ca.vertcat(y, parts.symbols)
    weights = zip(parts.nodes, ca.substitute(parts.slopes, [z], [ca.SX.zeros(z.numel())]), strict=True)
    terms = [term for node, weight in weights if node not in nested for term in _simple_term(node, weight, label)]
    terms += [ConvexTerm("cone", ca.SX(1), ca.vertcat(of_node[node], put(node.args))) for node in levels if node.kind == "norm"]
    rows = [(j, put(piece)) for j, node in enumerate(levels) if node.kind != "norm" for piece in node.pieces]
    for bound in parts.bounds:
        terms.append(ConvexTerm(bound.kind, ca.SX(1), put(bound.u)))
        if bound.kind == "indicator" and not is_concave(terms[-1].u, ca.vertcat(y, tau)):
            raise ModelError(f"{label} is not convex: its domain {bound.text} is not convex; write it as concave >= 0")
    result = ConvexSplit(put(parts.value), tuple(terms), tau, stack_column(row for _, row in rows), tuple(j for j, _ in rows))
    _check_no_leftovers(stack_column([result.smooth, result.epigraph, *(term.u for term in terms)]), ca.vertcat(y, tau), label)
    return result


def _simple_term(node: NonsmoothNode, weight: ca.SX, label: str) -> list[ConvexTerm]:
    if weight.is_constant() and float(weight) < 0:
        if node.kind == "domain":
            raise ModelError(f"{label} takes the value -inf outside of {node.text}; write + if_else({node.text}, 0, inf)")
        raise ModelError(
            f"{label} is not convex: the term {node.text} enters with the weight {float(weight):g}; make every weight >= 0"
        )
    if weight.is_zero() or node.kind == "domain":
        return []
    return [ConvexTerm(node.kind, weight, node.args[0] - node.args[1] if node.kind == "max" else node.args)]


def _check_no_leftovers(expr: ca.SX, z: ca.SX, label: str) -> None:
    """Refuse comparisons used as numbers, and inf outside of an if_else, in what should now be smooth."""
    if np.isinf(numeric_constants(expr)).any():
        raise ModelError(f"{label} holds inf outside of an if_else; write {label} as if_else(domain, value, inf)")

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> None:
        raise ModelError(
            f"{label} uses the comparison {old} as a number; write it with fmax, fmin or fabs "
            "(a piecewise linear function is the fmax of its pieces)"
        )

    replay_expression(expr, rule, (ca.OP_LE, ca.OP_LT, ca.OP_EQ, ca.OP_NE, ca.OP_NOT, ca.OP_AND, ca.OP_OR), z, label)
