"""A convex potential Phi split into a smooth part and terms whose subdifferential is known.

:mod:`nsmodel.model.convex_read` puts a symbol in place of each nonsmooth node (fabs, fmax, fmin, the square root of a
squared distance, an ``if_else`` with the value inf). A symbol that enters with a constant weight gives a :class:`Term`;
the others are nested and take the epigraph form. Signs: for l ∈ -dPhi(y), each term has a multiplier l' with
-u ∈ N_K(l') and contributes J_u' l' to l (J_u' is the transpose).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError
from nsmodel.later import former_names
from nsmodel.model.convex_read import NonsmoothNode, PotentialCondition, PotentialParts, read_potential_parts, replay_expression
from nsmodel.model.expressions import evaluate_at_samples, is_affine, is_concave, is_constant, sample_points
from nsmodel.pickled import Picklable
from nsmodel.proof.graph import is_same_expression, numeric_constants, stack_column, symbol_hashes

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
                f"{label} is not seen to be convex: {node.text} is the absolute value of a nonlinear expression; "
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
        raise ModelError(f"{label} is not convex: its domain {bound.text} is not convex; turn the inequality round")
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
                f"{label} is not seen to be convex: it does not grow with the nested term {node.text}; "
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


__getattr__ = former_names(__name__, Term="ConvexTerm")
