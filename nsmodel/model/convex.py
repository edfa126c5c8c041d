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
from nsmodel.model.convex_read import Bound, Node, column, evaluate, is_affine, is_constant, keys, points, read, replay, same


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
    value, nodes, bounds = read(phi, y, label)
    bounds = [simple for bound in bounds for simple in _pushed(bound, nodes, y, label)]
    value, nodes, bounds = _put_back_smooth(value, nodes, bounds, y)
    nodes = _live(value, nodes, bounds)
    z = ca.vertcat(y, *(node.symbol for node in nodes))
    for node in nodes:
        if node.kind == "abs" and not is_affine(node.args, z):
            raise ModelError(
                f"{label} is not seen to be convex: {node.text} is the absolute value of a nonlinear expression; "
                "write it with fabs of affine expressions, or with fmax"
            )
    weights = _slopes(column([value]), nodes)
    nested = _nested(weights, nodes, bounds, z)
    _check_growth(value, nodes, nested, bounds, y, label)
    simple = {node: ca.substitute(w, z, ca.SX.zeros(z.numel())) for node, w in zip(nodes, weights, strict=True) if node not in nested}
    return _assemble(value, simple, nested, bounds, y, label)
