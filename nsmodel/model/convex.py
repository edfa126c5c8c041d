"""A convex potential Phi split into a smooth part and terms whose subdifferential is known.

The expression is replayed node by node. A nonsmooth node (fabs, fmax, fmin, the square root of a squared distance, an
``if_else`` with the value inf) becomes a symbol s with a known meaning; what is left is smooth in y and s. A symbol
that enters with a constant weight gives a :class:`Term`; the others are nested and take the epigraph form. Signs: for
l ∈ -dPhi(y), each term has a multiplier l' with -u ∈ N_K(l') and contributes J_u' l' to l (J_u' is the transpose).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError


@dataclass(frozen=True, eq=False)
class Term:
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
class ConvexSplit:
    """Phi(y) = min over tau of smooth(y, tau) + the terms, subject to epigraph[i] <= tau[epigraph_of[i]].

    Attributes:
        smooth: SX (1, 1), differentiable.
        terms: the nonsmooth terms.
        tau: SX (k, 1), one symbol for each nested node; empty when nothing is nested, and then Phi = smooth + terms.
        epigraph: SX (r, 1), expressions of y and tau.
        epigraph_of: for each row of ``epigraph`` the index of its tau.
    """

    smooth: ca.SX
    terms: tuple[Term, ...]
    tau: ca.SX
    epigraph: ca.SX
    epigraph_of: tuple[int, ...]

    def with_terms(self, terms: Iterable[Term]) -> ConvexSplit:
        """Return the same split with other terms."""
        return replace(self, terms=tuple(terms))


@dataclass(frozen=True, eq=False)
class _Node:
    """A symbol and its meaning; ``args`` may hold the symbols of earlier nodes, ``text`` is what the user wrote.

    Kinds: "abs" |args|, "norm" |args|_2, "max" the largest of args, "domain" 0 where the condition args is false and
    inf elsewhere (its text is the domain), "branch" args[1] where the condition args[0] is true and 0 elsewhere.
    """

    kind: str
    symbol: ca.SX
    args: ca.SX
    text: str


@dataclass(frozen=True, eq=False)
class _Parts:
    """Phi = value(y, s) on the domain, a tuple of ("indicator" | "equality" | "cone", expression, its text)."""

    value: ca.SX
    nodes: tuple[_Node, ...]
    domain: tuple[tuple[str, ca.SX, str], ...] = ()


_Rule = Callable[[int, list[ca.SX], ca.SX], ca.SX | None]
_UNSUPPORTED = {
    ca.OP_SIGN: "sign",
    ca.OP_FLOOR: "floor",
    ca.OP_CEIL: "ceil",
    ca.OP_FMOD: "fmod",
    ca.OP_REMAINDER: "remainder",
    ca.OP_COPYSIGN: "copysign",
}
_COMPARISONS = (ca.OP_LE, ca.OP_LT, ca.OP_EQ, ca.OP_NE, ca.OP_NOT, ca.OP_AND, ca.OP_OR)
_ROOTS = (ca.OP_SQRT, ca.OP_HYPOT, ca.OP_CONSTPOW)
_NONSMOOTH = (*_UNSUPPORTED, *_ROOTS, ca.OP_FABS, ca.OP_FMAX, ca.OP_FMIN, ca.OP_IF_ELSE_ZERO)


def split(phi: ca.SX, y: ca.SX, label: str) -> ConvexSplit:
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
    >>> parts = split(3 * ca.fabs(y[0] - 1) + y[1] ** 2, y, "phi")
    >>> parts.smooth, parts.terms
    (SX(sq(y_1)), (Term(kind='abs', weight=SX(3), u=SX((y_0-1))),))
    """
    if phi.shape != (1, 1):
        raise ModelError(f"{label}: shape {phi.shape}; expected one scalar expression, the potential")
    parts = _push_into_domain(_resolve(_read(phi, y, label), label), y, label)
    parts = _live(_flatten(_put_back_smooth(parts, y)))
    symbols = ca.vertcat(y, *(node.symbol for node in parts.nodes))
    for node in parts.nodes:
        if node.kind == "abs" and not _is_affine(node.args, symbols):
            raise ModelError(
                f"{label} is not seen to be convex: {node.text} is the absolute value of a nonlinear expression; "
                "write it with fabs of affine expressions, or with fmax"
            )
    nested = [node for node in parts.nodes if _is_nested(node, parts, symbols)]
    simple = [node for node in parts.nodes if not any(node is other for other in nested)]
    if nested:
        _check_growth(parts, nested, y, label)
    return _assemble(parts, simple, nested, symbols, y, label)


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

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX | None:
        if op != ca.OP_SIGN or not ca.depends_on(old, x):
            return None
        if symbols and ca.depends_on(args[0], ca.vertcat(*symbols)):
            raise ModelError(
                f"{label}: {old} has a sign inside a sign; write {label} with separate sign(u), u continuous"
            )
        for symbol, argument in zip(symbols, arguments, strict=True):
            if _same(argument, args[0]):
                return symbol
        symbols.append(ca.SX.sym(f"{label}_sgn{len(symbols)}"))
        arguments.append(args[0])
        return symbols[-1]

    return _replay(expr, rule, (ca.OP_SIGN,), label), _column(symbols), _column(arguments)


# -- reading the expression --------------------------------------------------------------------------------------------


def _replay(expr: ca.SX, rule: _Rule, ops: Sequence[int], label: str) -> ca.SX:
    """Rebuild ``expr``; ``rule(op, new arguments, old node)`` is asked at nodes of ``ops``; None leaves the node."""
    symbols = ca.symvar(expr)
    function = ca.Function("replay", [_column(symbols)], [ca.densify(expr)])
    ids = [function.instruction_id(i) for i in range(function.n_instructions())]
    if not set(ids) & set(ops):
        return expr
    if ca.OP_CALL in ids:
        raise ModelError(f"{label} calls a Function that cannot be looked into; write it with elementary operations")
    work: dict[int, tuple[ca.SX, ca.SX]] = {}
    result = ca.SX.zeros(*expr.shape)
    for i, op in enumerate(ids):
        source, target = function.instruction_input(i), function.instruction_output(i)
        if op == ca.OP_OUTPUT:
            result[target[1]] = work[source[0]][0]
        elif op == ca.OP_INPUT:
            work[target[0]] = (symbols[source[1]],) * 2
        elif op == ca.OP_CONST:
            work[target[0]] = (ca.SX(function.instruction_constant(i)),) * 2
        else:
            build = ca.SX.unary if len(source) == 1 else ca.SX.binary
            new = [work[j][0] for j in source]
            old = build(op, *(work[j][1] for j in source))
            put = rule(op, new, old) if op in ops else None
            work[target[0]] = (build(op, *new) if put is None else put, old)
    return result


def _read(phi: ca.SX, y: ca.SX, label: str) -> _Parts:
    """Put a symbol in place of every nonsmooth node that depends on y."""
    nodes: list[_Node] = []

    def add(kind: str, args: ca.SX, old: ca.SX) -> ca.SX:
        for node in nodes:
            if node.kind == kind and _same(node.args, args):
                return node.symbol
        nodes.append(_Node(kind, ca.SX.sym(f"{label}_s{len(nodes)}"), args, str(old)))
        return nodes[-1].symbol

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX | None:
        if not ca.depends_on(old, y):
            return None
        if op in _UNSUPPORTED:
            raise ModelError(
                f"{label}: {_UNSUPPORTED[op]} in {old} has no subdifferential; write {label} with fabs, fmax, norm_2"
            )
        if op == ca.OP_FABS:
            return add("abs", args[0], old)
        if op == ca.OP_FMAX:
            return add("max", _constant_last(args), old)
        if op == ca.OP_FMIN:
            return -add("max", -_constant_last(args), -old)
        if op == ca.OP_IF_ELSE_ZERO:
            return _read_branch(args, old, y, add, label)
        u = _norm_argument(op, args, ca.vertcat(y, *(node.symbol for node in nodes)), old, label)
        if u is None:
            return None
        distance = add("abs" if u.numel() == 1 else "norm", u, old)
        return distance ** (2 * args[1]) if op == ca.OP_CONSTPOW else distance

    value = _replay(phi, rule, _NONSMOOTH, label)
    return _Parts(value, tuple(nodes))


def _constant_last(args: list[ca.SX]) -> ca.SX:
    return ca.vertcat(*(reversed(args) if args[0].is_constant() else args))


def _read_branch(
    args: list[ca.SX], old: ca.SX, y: ca.SX, add: Callable[[str, ca.SX, ca.SX], ca.SX], label: str
) -> ca.SX | None:
    condition, value = args
    if value.is_constant() and np.isinf(float(value)):
        if float(value) < 0:
            raise ModelError(
                f"{label} takes the value -inf where {old.dep(0)}; a convex potential is +inf outside its domain"
            )
        return add("domain", condition, ca.logic_not(old.dep(0)))
    return add("branch", ca.vertcat(condition, value), old) if ca.depends_on(old.dep(0), y) else None


def _norm_argument(op: int, args: list[ca.SX], z: ca.SX, old: ca.SX, label: str) -> ca.SX | None:
    """Return u affine in z with ``old`` = |u|_2 (its power 2 args[1] for a power) where |u| has a zero, else None."""
    if op == ca.OP_CONSTPOW and not 0 < float(args[1]) < 1:
        return None
    q = args[0] ** 2 + args[1] ** 2 if op == ca.OP_HYPOT else args[0]
    u = _squares(q, z)
    if u is None:
        u = _quadratic_root(q, z, old, label)
        return None if u is None or _stays_positive(u, z) else u
    fixed = [entry for entry in u if not ca.depends_on(entry, z)]
    column = _column(u)
    if _is_affine(column, z):
        return None if _stays_positive(column, z) else column
    if fixed:
        return None
    raise ModelError(f"{label}: {old} is the norm of a nonlinear expression; write it as norm_2 of an affine one")


def _squares(q: ca.SX, z: ca.SX) -> list[ca.SX] | None:
    """Read q as a sum of squares u_i^2, factors without z taken into the square; None if it is not one."""
    op = q.op()
    if not ca.depends_on(q, z):
        return None if q.is_constant() and float(q) < 0 else [] if q.is_zero() else [ca.sqrt(q)]
    if op == ca.OP_SQ:
        return [q.dep(0)]
    if op == ca.OP_ADD:
        left, right = _squares(q.dep(0), z), _squares(q.dep(1), z)
        return None if left is None or right is None else left + right
    factor = ca.SX(1)
    if op == ca.OP_TWICE:
        factor, inner = ca.SX(2), q.dep(0)
    elif op == ca.OP_MUL and not ca.depends_on(q.dep(0), z):
        factor, inner = q.dep(0), q.dep(1)
    elif op == ca.OP_MUL and not ca.depends_on(q.dep(1), z):
        factor, inner = q.dep(1), q.dep(0)
    elif op == ca.OP_DIV and not ca.depends_on(q.dep(1), z):
        factor, inner = 1 / q.dep(1), q.dep(0)
    else:
        return None
    entries = _squares(inner, z)
    if entries is None or (factor.is_constant() and float(factor) < 0):
        return None
    return [ca.sqrt(factor) * entry for entry in entries]


def _quadratic_root(q: ca.SX, z: ca.SX, old: ca.SX, label: str) -> ca.SX | None:
    """Return u = L z + c with q = |u|^2, from the eigenvectors of the Hessian; None if q is not such a quadratic."""
    hessian = ca.hessian(q, z)[0]
    if not _is_constant(hessian, z):
        return None
    at_zero = ca.substitute(ca.vertcat(ca.vec(ca.densify(hessian)), ca.gradient(q, z), q), z, 0)
    n = z.numel()
    H, g, q0 = at_zero[: n * n], at_zero[n * n : -1], at_zero[-1]
    if not H.is_constant():
        raise ModelError(
            f"{label}: the coefficients of {old} hold {ca.symvar(H)[0]}; write it as norm_2 of an affine expression"
        )
    values, vectors = np.linalg.eigh(np.array(ca.DM(H)).reshape(n, n) / 2)
    tol = 1e-12 * np.abs(values).max()
    if tol == 0 or values.min() < -tol:
        return None
    V, root = vectors[:, values > tol], np.sqrt(values[values > tol])
    L = root[:, None] * V.T
    L[np.abs(L) < 1e-15 * np.abs(L).max()] = 0
    c = ca.SX(ca.DM(V.T / (2 * root[:, None]))) @ g
    flat = ca.vertcat(ca.DM(vectors[:, values <= tol].T) @ g, q0 - ca.sumsqr(c))
    scale = 1 + np.abs(_evaluate(ca.vertcat(g, q0), z, np.zeros((1, n)))).max()
    if np.abs(_evaluate(flat, z, np.zeros((1, n)))).max() > 1e-12 * scale:
        return None
    return ca.SX(ca.DM(L)) @ z + c


def _stays_positive(u: ca.SX, z: ca.SX) -> bool:
    """Whether the affine u(z) has no zero, for generic values of the other symbols."""
    zero = np.zeros((1, z.numel()))
    for seed in range(3):
        A = _evaluate(ca.jacobian(u, z), z, zero, seed).reshape(z.numel(), -1).T
        c = _evaluate(u, z, zero, seed)[0]
        if np.linalg.norm(c - A @ np.linalg.lstsq(A, c, rcond=None)[0]) > 1e-12 * (1 + np.linalg.norm(c)):
            return True
    return False


# -- the domain of Phi -------------------------------------------------------------------------------------------------

_Literal = tuple[str, ca.SX, ca.SX]


def _resolve(parts: _Parts, label: str) -> _Parts:
    """Turn the conditions of the values inf into the domain, and settle the finite branches on it."""
    known: list[_Literal] = []
    domain: list[tuple[str, ca.SX, str]] = []
    for node in parts.nodes:
        if node.kind == "domain":
            literals = _literals(node.args, False)
            if literals is None or any(relation == "!=" for relation, _, _ in literals):
                raise ModelError(
                    f"{label} is not convex: its domain {node.text} is not a conjunction of <=, >=, ==; "
                    "write the domain as such conditions joined by logic_and"
                )
            known += literals
            domain += [
                ("indicator", b - a, node.text) if r == "<=" else ("equality", a - b, node.text) for r, a, b in literals
            ]
    parts = replace(parts, domain=tuple(domain))
    parts = replace(parts, nodes=tuple(replace(n, args=ca.SX(0, 1)) if n.kind == "domain" else n for n in parts.nodes))
    for node in [node for node in parts.nodes if node.kind == "branch"]:
        truth = _truth(node.args[0], known)
        if truth is None:
            raise ModelError(
                f"{label}: {node.text} switches between finite values; write it with fmax, fmin or fabs, "
                "or give the value inf outside the domain"
            )
        current = _node_of(node.symbol, parts)
        parts = _put(parts, current, current.args[1] if truth else ca.SX(0))
    return parts


def _literals(condition: ca.SX, holds: bool) -> list[_Literal] | None:
    """Write a condition, or its negation, as a conjunction of ("<=" | "==" | "!=", a, b); None if it is not one."""
    op = condition.op()
    if op == ca.OP_NOT:
        return _literals(condition.dep(0), not holds)
    if op in (ca.OP_AND, ca.OP_OR):
        if holds != (op == ca.OP_AND):
            return None
        left, right = _literals(condition.dep(0), holds), _literals(condition.dep(1), holds)
        return None if left is None or right is None else left + right
    if op in (ca.OP_LE, ca.OP_LT):
        a, b = condition.dep(0), condition.dep(1)
        return [("<=", a, b) if holds else ("<=", b, a)]
    if op in (ca.OP_EQ, ca.OP_NE):
        return [("==" if holds == (op == ca.OP_EQ) else "!=", condition.dep(0), condition.dep(1))]
    return None


def _truth(condition: ca.SX, known: list[_Literal]) -> bool | None:
    """Whether ``condition`` follows from the literals; None if neither it nor its negation does."""
    op = condition.op()
    if op == ca.OP_NOT:
        inner = _truth(condition.dep(0), known)
        return None if inner is None else not inner
    if op in (ca.OP_AND, ca.OP_OR):
        decisive = op == ca.OP_OR
        both = [_truth(condition.dep(i), known) for i in range(2)]
        return decisive if decisive in both else None if None in both else not decisive
    for holds in (True, False):
        literals = _literals(condition, holds)
        if not literals:
            continue
        relation, left, right = literals[0]
        if any(r == relation and _same(a, left) and _same(b, right) for r, a, b in known):
            return holds
    return None


def _push_into_domain(parts: _Parts, y: ca.SX, label: str) -> _Parts:
    """Write r - w |u| >= 0 and the like, w > 0, without the nonsmooth node; drop what always holds."""
    queue, done = list(parts.domain), []
    while queue:
        kind, v, text = queue.pop(0)
        inside = _inside(v, parts.nodes)
        if kind == "equality" and (inside or not _is_affine(v, y)):
            raise ModelError(
                f"{label} is not convex: the equality in its domain {text} is not affine; give an affine one"
            )
        if not inside and v.is_constant():
            if float(v) < 0 or (kind == "equality" and float(v) != 0):
                raise ModelError(f"{label} is +inf everywhere: its domain {text} is empty; correct the condition")
            continue
        weight = ca.jacobian(v, inside[0].symbol) if len(inside) == 1 else ca.SX.sym("several")
        if not weight.is_constant():
            done.append((kind, v, text))
            continue
        if float(weight) > 0:
            raise ModelError(f"{label} is not convex: its domain {text} is not convex; turn the inequality round")
        node = inside[0]
        if node.kind == "norm":
            r = ca.substitute(v, node.symbol, 0)
            done.append(("cone", ca.vertcat(r / -float(weight), node.args), text))
        else:
            queue = [(kind, ca.substitute(v, node.symbol, piece), text) for piece in _pieces(node)] + queue
    return replace(parts, domain=tuple(done))


# -- sorting the nodes -------------------------------------------------------------------------------------------------


def _put_back_smooth(parts: _Parts, y: ca.SX) -> _Parts:
    """Put the node itself back where its kink does not show, as in fabs(y)^1.5 or fmax(y, 0)^2."""
    for symbol in [node.symbol for node in parts.nodes if node.kind in ("abs", "max")]:
        node = _node_of(symbol, parts)
        u = node.args if node.kind == "abs" else node.args[0] - node.args[1]
        if ca.depends_on(u, ca.vertcat(*(n.symbol for n in parts.nodes))) or not _is_affine(u, y):
            continue
        at_kink = ca.SX(0) if node.kind == "abs" else node.args[1]
        users = [parts.value, *(n.args for n in parts.nodes if n is not node), *(v for _, v, _ in parts.domain)]
        slopes = ca.vertcat(*(ca.densify(ca.jacobian(user, symbol)) for user in users if user.numel()))
        slopes = _exact(ca.substitute(slopes, symbol, at_kink), parts.nodes)
        row = ca.jacobian(u, y)
        slopes = ca.substitute(slopes, y, y - row.T * u / ca.sumsqr(row))
        values = _evaluate(slopes, y, _points(y.numel(), 12))
        if np.isfinite(values).all() and np.abs(values).max() <= 1e-9:
            parts = _put(parts, node, _meaning(node))
    return parts


def _flatten(parts: _Parts) -> _Parts:
    """Write max(a + w |u|, b), w > 0, as max(a + w u, a - w u, b), and so for a max in a max: one tau, not two."""
    done: list[_Node] = []
    for node in parts.nodes:
        queue, pieces = ca.vertsplit(node.args) if node.kind == "max" else [], []
        while queue:
            piece = queue.pop(0)
            inside = _inside(piece, done)
            weight = ca.jacobian(piece, inside[0].symbol) if len(inside) == 1 else ca.SX(0)
            if weight.is_constant() and float(weight) > 0 and inside[0].kind in ("abs", "max"):
                queue = [ca.substitute(piece, inside[0].symbol, inner) for inner in _pieces(inside[0])] + queue
            else:
                pieces.append(piece)
        done.append(replace(node, args=_column(pieces)) if pieces else node)
    return replace(parts, nodes=tuple(done))


def _live(parts: _Parts) -> _Parts:
    """Drop the nodes that nothing uses any more, last first."""
    used = [parts.value, *(v for _, v, _ in parts.domain)]
    kept: list[_Node] = []
    for node in reversed(parts.nodes):
        if any(ca.depends_on(expr, node.symbol) for expr in used):
            kept.insert(0, node)
            used.append(node.args)
    return replace(parts, nodes=tuple(kept))


def _is_nested(node: _Node, parts: _Parts, z: ca.SX) -> bool:
    """Whether the node takes a tau: it holds or is held by another, has over two pieces, or a varying weight."""
    symbols = z[z.numel() - len(parts.nodes) :]
    users = [*(other.args for other in parts.nodes), *(v for _, v, _ in parts.domain)]
    return (
        ca.depends_on(node.args, symbols)
        or (node.kind == "max" and node.args.numel() > 2)
        or any(ca.depends_on(user, node.symbol) for user in users)
        or not _is_constant(ca.jacobian(parts.value, node.symbol), z)
    )


def _check_growth(parts: _Parts, nested: list[_Node], y: ca.SX, label: str) -> None:
    """Check at sample points that Phi grows with each nested node, so that minimising over tau >= node gives Phi.

    The last tau goes first: for fixed tau_1..tau_k, with the later ones at their exact values, the value must not
    decrease in tau_k. This is weaker than growth in all tau at once, and enough for the minimum.
    """
    slack = ca.SX.sym("slack", len(nested))
    domain = [(kind, v) for kind, v, _ in parts.domain if kind != "equality"]
    watched = ca.vertcat(parts.value, *(-v if kind == "indicator" else ca.norm_2(v[1:]) - v[0] for kind, v in domain))
    for node in reversed(parts.nodes):
        j = next((j for j, other in enumerate(nested) if other is node), None)
        watched = ca.substitute(watched, node.symbol, _meaning(node) + (0 if j is None else slack[j]))
    rng, count, n = np.random.default_rng(1), 200, y.numel()
    inputs = ca.vertcat(y, slack)
    for k, node in enumerate(nested):
        low = np.zeros((count, n + len(nested)))
        low[:, :n] = _points(n, count)
        low[:, n : n + k + 1] = rng.exponential(1, (count, k + 1)) * rng.integers(0, 2, (count, k + 1))
        high = low.copy()
        high[:, n + k] += rng.exponential(1, count)
        before, after = _evaluate(watched, inputs, low), _evaluate(watched, inputs, high)
        finite = np.isfinite(before) & np.isfinite(after)
        fall = np.where(finite, before - after - 1e-9 * (1 + np.abs(before)), -1)
        if not finite[:, 0].any() or (fall > 0).any():
            raise ModelError(
                f"{label} is not seen to be convex: it does not grow with the nested term {node.text}; "
                "write it as a sum of fabs, fmax and norm_2 with weights >= 0"
            )


def _assemble(parts: _Parts, simple: list[_Node], nested: list[_Node], z: ca.SX, y: ca.SX, label: str) -> ConvexSplit:
    terms = [term for node in simple for term in _simple_term(node, parts, z, label)]
    smooth = parts.value
    for node in simple:
        smooth = ca.substitute(smooth, node.symbol, node.args[1] if node.kind == "max" else 0)
    levels = [node for node in nested if node.kind != "domain"]
    tau = ca.SX.sym(f"{label}_tau", len(levels)) if levels else ca.SX(0, 1)
    old = _column([node.symbol for node in nested])
    new = ca.vertcat(*(tau[_index(levels, node)] if node.kind != "domain" else ca.SX(0) for node in nested))

    def rename(expr: ca.SX) -> ca.SX:
        return ca.substitute(expr, old, new) if nested else expr

    rows, of = [], []
    for j, node in enumerate(levels):
        if node.kind == "norm":
            terms.append(Term("cone", ca.SX(1), ca.vertcat(tau[j], rename(node.args))))
        else:
            pieces = [rename(piece) for piece in _pieces(node)]
            rows += pieces
            of += [j] * len(pieces)
    for kind, v, text in parts.domain:
        u = rename(v)
        if kind == "indicator" and not _is_concave(u, ca.vertcat(y, tau)):
            raise ModelError(f"{label} is not convex: its domain {text} is not convex; write it as concave >= 0")
        terms.append(Term(kind, ca.SX(1), u))
    result = ConvexSplit(rename(smooth), tuple(terms), tau, _column(rows), tuple(of))
    _refuse_leftovers(ca.vertcat(result.smooth, result.epigraph, *(t.u for t in terms)), ca.vertcat(y, tau), label)
    return result


def _index(nodes: list[_Node], node: _Node) -> int:
    return next(j for j, other in enumerate(nodes) if other is node)


def _simple_term(node: _Node, parts: _Parts, z: ca.SX, label: str) -> list[Term]:
    weight = ca.substitute(ca.densify(ca.jacobian(parts.value, node.symbol)), z, 0)
    if weight.is_constant() and float(weight) < 0 and node.kind == "domain":
        raise ModelError(f"{label} takes the value -inf outside of {node.text}; write + if_else({node.text}, 0, inf)")
    if weight.is_constant() and float(weight) < 0:
        raise ModelError(
            f"{label} is not convex: the term {node.text} enters with the weight {float(weight):g}; "
            "make every weight >= 0"
        )
    if weight.is_zero() or node.kind == "domain":
        return []
    return [Term(node.kind, weight, node.args[0] - node.args[1] if node.kind == "max" else node.args)]


def _refuse_leftovers(expr: ca.SX, z: ca.SX, label: str) -> None:
    """Refuse comparisons used as numbers, and inf outside of an if_else, in what should now be smooth."""
    function = ca.Function("smooth", [_column(ca.symvar(expr))], [expr])
    for i in range(function.n_instructions()):
        if function.instruction_id(i) == ca.OP_CONST and np.isinf(function.instruction_constant(i)):
            raise ModelError(f"{label} holds inf outside of an if_else; write {label} as if_else(domain, value, inf)")

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> None:
        if ca.depends_on(old, z):
            raise ModelError(
                f"{label} uses the comparison {old} as a number; write it with fmax, fmin or fabs "
                "(a piecewise linear function is the fmax of its pieces)"
            )

    _replay(expr, rule, _COMPARISONS, label)


# -- expressions -------------------------------------------------------------------------------------------------------


def _column(items: Sequence[ca.SX]) -> ca.SX:
    return ca.vertcat(ca.SX(0, 1), *items)


def _same(a: ca.SX, b: ca.SX) -> bool:
    return a.shape == b.shape and ca.is_equal(a, b, 20)


def _meaning(node: _Node) -> ca.SX:
    if node.kind == "abs":
        return ca.fabs(node.args)
    if node.kind == "max":
        return reduce(ca.fmax, ca.vertsplit(node.args))
    return ca.norm_2(node.args) if node.kind == "norm" else ca.SX(0)


def _pieces(node: _Node) -> list[ca.SX]:
    """Return the expressions whose maximum is an "abs" or "max" node."""
    return [node.args, -node.args] if node.kind == "abs" else ca.vertsplit(node.args)


def _node_of(symbol: ca.SX, parts: _Parts) -> _Node:
    return next(node for node in parts.nodes if node.symbol.element_hash() == symbol.element_hash())


def _inside(expr: ca.SX, nodes: Sequence[_Node]) -> list[_Node]:
    """Return the nodes whose symbol ``expr`` holds."""
    held = {symbol.element_hash() for symbol in ca.symvar(expr)}
    return [node for node in nodes if node.symbol.element_hash() in held]


def _exact(expr: ca.SX, nodes: Sequence[_Node]) -> ca.SX:
    """Put the meaning of every symbol in its place, last first, since a node may hold earlier symbols."""
    for node in reversed(nodes):
        expr = ca.substitute(expr, node.symbol, _meaning(node))
    return expr


def _put(parts: _Parts, node: _Node, value: ca.SX) -> _Parts:
    """Replace the symbol of ``node`` by an expression everywhere."""
    others = [other for other in parts.nodes if other is not node]
    exprs = [parts.value, *(other.args for other in others), *(v for _, v, _ in parts.domain)]
    new = ca.substitute(exprs, [node.symbol], [value])
    nodes = tuple(replace(other, args=args) for other, args in zip(others, new[1:], strict=False))
    domain = tuple((kind, v, text) for (kind, _, text), v in zip(parts.domain, new[1 + len(others) :], strict=True))
    return _Parts(new[0], nodes, domain)


def _is_constant(expr: ca.SX, z: ca.SX) -> bool:
    """Whether ``expr`` does not change with z: read off, or else (y - y is not simplified) seen at sample points."""
    if not ca.depends_on(expr, z):
        return True
    values = _evaluate(expr, z, _points(z.numel(), 6))
    return bool(np.allclose(values, values[0], rtol=1e-9, atol=1e-12))


def _is_affine(expr: ca.SX, z: ca.SX) -> bool:
    return _is_constant(ca.jacobian(expr, z), z)


def _is_concave(expr: ca.SX, z: ca.SX) -> bool:
    if _is_affine(expr, z):
        return True
    n = z.numel()
    values = _evaluate(ca.hessian(expr, z)[0], z, _points(n, 32))
    spectra = np.linalg.eigvalsh(values[np.isfinite(values).all(axis=1)].reshape(-1, n, n))
    return bool((spectra <= 1e-9 * (1 + np.abs(spectra).max(initial=0))).all())


def _points(n: int, count: int) -> np.ndarray:
    """Sample points (count, n) of sizes from 0.1 to 10."""
    rng = np.random.default_rng(0)
    return rng.normal(size=(count, n)) * 10.0 ** rng.uniform(-1, 1, (count, 1))


def _evaluate(expr: ca.SX, z: ca.SX, points: np.ndarray, seed: int = 0) -> np.ndarray:
    """Values (count, numel) of ``expr`` at points (count, n) of z; each other symbol gets one number in (0.5, 2)."""
    own = {symbol.element_hash() for symbol in ca.vertsplit(z)}
    others = [symbol for symbol in ca.symvar(expr) if symbol.element_hash() not in own]
    numbers = np.random.default_rng(seed).uniform(0.5, 2, len(others))
    column = ca.densify(ca.vec(expr))
    if others:
        column = ca.substitute(column, _column(others), ca.SX(ca.DM(numbers)))
    function = ca.Function("values", [z], [column])
    return np.array(function(points.T)).T
