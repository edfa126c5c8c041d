"""Models at values of a parameter that no double is: exactly at the roots of what they are made of.

Where u(p) = 0, each part of the model that reads p through u alone is known without rounding: a polynomial in p is its remainder
by the irreducible polynomial of the root, a number where p drops out; any other function u is 0 where its sign changes. What
fails for the model with these numbers fails at that root.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from fractions import Fraction
from typing import Any, NamedTuple, TypeVar

import casadi as ca
import numpy as np

from nsmodel.errors import NsmodelError
from nsmodel.hypotheses.findings import Finding, IntervalBox
from nsmodel.hypotheses.region import ParameterValues, box_middle
from nsmodel.modeling.base import Model
from nsmodel.modeling.parameters import map_expressions
from nsmodel.proof import interval_bounds, polynomial
from nsmodel.proof.exponential_sums import flint_coefficients, flint_polynomial
from nsmodel.proof.expression_graph import apply_operation, fold_graph, is_double, operation_codes, symbol_hashes

MAX_ROOTS = 4  # Roots of a parameter that are looked at: a model is made and checked at each.
# Points of its interval between which a sign may change: two roots within 1/32 of it may be missed, which proves nothing.
ROOT_GRID = 33

M = TypeVar("M", bound=Model)


class ExactRoot(NamedTuple):
    """A root of ``polynomial`` (of FLINT, irreducible), or of another function u, close to ``near``."""

    near: float
    text: str
    polynomial: Any = None
    u: ca.SX | None = None


class _Node(NamedTuple):
    """A node as it is rebuilt, as it was, as a polynomial in p where it is one; ``alone``: it reads p and nothing else."""

    new: ca.SX
    old: ca.SX
    p: polynomial.Polynomial | None
    alone: bool


def models_at_roots(model: M, box: IntervalBox) -> Iterator[tuple[ParameterValues, str, M]]:
    """Yield (values, the equation, the model) at roots of parts of one parameter, the others in the middle of the box.

    Only models that do not read the parameter any more are exact.
    """
    for name, (low, high) in box.items():
        middle = box_middle(box)
        one = model.bind({**middle, name: None}, partly=True)
        p = one.p[list(one.parameters).index(name)]
        for root in _roots(_expressions(one), p, low, high, name):
            exact_model = map_expressions(one, lambda expression, root=root, p=p: _put_root(expression, p, root))
            if not any(ca.depends_on(part, p) for part in _expressions(exact_model)):
                with suppress(NsmodelError):  # a part has no value at the root
                    yield {**middle, name: root.near}, root.text, exact_model.bind({name: root.near})


def findings_at_roots(
    model: M, box: IntervalBox, check: Callable[[M], Sequence[Finding]]
) -> list[tuple[ParameterValues, dict[str, Finding]]]:
    """What is found at these roots, by id, the equation in the words of each finding."""
    return [
        (values, {finding.id: replace(finding, how=f"exactly where {text}: {finding.how}") for finding in check(exact_model)})
        for values, text, exact_model in models_at_roots(model, box)
    ]


def _expressions(model: Model) -> list[ca.SX]:
    """All expressions of a model."""
    found: list[ca.SX] = []

    def keep(expression: ca.SX) -> ca.SX:
        found.append(ca.densify(expression))
        return expression

    map_expressions(model, keep)
    return found


def _roots(parts: Sequence[ca.SX], p: ca.SX, low: float, high: float, name: str) -> list[ExactRoot]:
    """Roots inside the box: of factors of polynomials in p and of their derivatives, and where other functions change sign."""
    found: dict[tuple[str, float], ExactRoot] = {}
    for part in parts:
        if not ca.depends_on(part, p) or ca.OP_CALL in operation_codes(part):
            continue
        nodes: list[_Node] = []
        _fold(part, p, None, nodes)
        for node in nodes:
            if len(found) >= MAX_ROOTS:
                return list(found.values())
            if node.p is not None:
                found.update(((root.text, root.near), root) for root in _polynomial_roots(node.p, low, high, name))
            elif node.alone:
                found.update(((root.text, root.near), root) for root in _sign_changes(node.old, p, low, high, name))
    return list(found.values())[:MAX_ROOTS]


def _polynomial_roots(q: polynomial.Polynomial, low: float, high: float, name: str) -> Iterator[ExactRoot]:
    whole = flint_polynomial(polynomial.univariate_coefficients(q)) if q else None
    for part in () if whole is None or whole.degree() < 2 else (whole, whole.derivative()):
        for factor, _ in part.numer().factor()[1]:
            c = [Fraction(int(number)) for number in factor.coeffs()]
            if len(c) > 1:
                for a, b in polynomial.real_roots(c, Fraction(low), Fraction(high)):
                    own = flint_polynomial(c)
                    yield ExactRoot(float((a + b) / 2), f"{_equation(c, name)} = 0", own)


def _equation(c: Sequence[Fraction], name: str) -> str:
    """The polynomial in words, the highest power first and its coefficient 1, rounded."""
    parts_of_text = []
    for k, number in reversed(list(enumerate(c))):
        size, power = f"{abs(float(number / c[-1])):.6g}", f"{name}^{k}" if k > 1 else name if k else ""
        if number:
            parts_of_text.append("-" if number / c[-1] < 0 else "+")
            parts_of_text.append(power if k and size == "1" else f"{size} {power}".strip())
    return " ".join(parts_of_text[1:])


def _sign_changes(u: ca.SX, p: ca.SX, low: float, high: float, name: str) -> Iterator[ExactRoot]:
    """Where a continuous function is proved to change its sign, between neighbouring doubles."""
    grid = np.linspace(low, high, ROOT_GRID)
    with np.errstate(all="ignore"):
        values = np.array(ca.Function("u", [p], [u])(grid[None, :])).ravel()
    for k in np.flatnonzero(np.isfinite(values[:-1] * values[1:]) & (values[:-1] * values[1:] < 0)):
        a, b, before = grid[k], grid[k + 1], np.sign(values[k])
        if not interval_bounds.is_continuous(u, p, np.array([a]), np.array([b])):
            continue
        while a < (middle := a + (b - a) / 2) < b and (sign := _proved_sign(u, p, middle)):
            a, b = (middle, b) if sign == before else (a, middle)
        if _proved_sign(u, p, a) * _proved_sign(u, p, b) < 0:
            yield ExactRoot(float(a + (b - a) / 2), f"{ca.substitute(u, p, ca.SX.sym(name))} = 0", None, u)


def _proved_sign(u: ca.SX, p: ca.SX, at: float) -> int:
    low, high = (float(np.ravel(end)[0]) for end in interval_bounds.enclose(u, p, np.array([at]), np.array([at])))
    return int(low > 0) - int(high < 0)


def _put_root(expression: ca.SX, p: ca.SX, root: ExactRoot) -> ca.SX:
    """The expression at the root, as far as that is known without rounding."""
    if not ca.depends_on(expression, p) or ca.OP_CALL in operation_codes(expression):
        return expression
    nodes = _fold(ca.densify(expression), p, root, [])
    return ca.reshape(ca.vertcat(*(node.new for node in nodes)), *expression.shape)


def _fold(expression: ca.SX, p: ca.SX, root: ExactRoot | None, seen: list[_Node]) -> list[_Node]:
    """The outputs, rebuilt at the root; ``seen`` takes all nodes that read p alone."""
    own = symbol_hashes(p)

    def symbol(item: ca.SX) -> _Node:
        mine = item.element_hash() in own
        return finish(_Node(item, item, {((0, 1),): Fraction(1)} if mine else None, mine))

    def number(value: float) -> _Node:
        return _Node(ca.SX(value), ca.SX(value), polynomial.constant_polynomial(value), False)

    def apply(op: int, args: list[_Node]) -> _Node:
        new, old = (apply_operation(op, [getattr(arg, which) for arg in args]) for which in ("new", "old"))
        alone = any(arg.alone for arg in args) and all(arg.alone or arg.old.is_constant() for arg in args)
        return finish(_Node(new, old, polynomial.apply_to_polynomials(op, [arg.p for arg in args]), alone))

    def finish(node: _Node) -> _Node:
        if node.alone:
            seen.append(node)
            value = None if root is None else _value_at_root(node, root)
            return node if value is None else node._replace(new=ca.SX(float(value)))
        return node

    return fold_graph(expression, symbol, number, apply)


def _value_at_root(node: _Node, root: ExactRoot) -> Fraction | None:
    """The value of a node at the root where that is known, and a double."""
    if root.u is not None:
        return Fraction(0) if node.old.is_op(root.u.op()) and ca.is_equal(node.old, root.u, 20) else None
    if node.p is None:
        return None
    rest = flint_coefficients(flint_polynomial(polynomial.univariate_coefficients(node.p)) % root.polynomial)
    value = rest[0] if len(rest) == 1 else Fraction(0) if not rest else None
    return value if value is not None and is_double(value) else None
