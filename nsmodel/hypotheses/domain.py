"""A potential and its domain apart: where it is finite, and a function that is finite elsewhere too."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.modeling.convex_split import read_potential_parts
from nsmodel.proof.expression_graph import rewrite_nodes


def potential_without_domain(phi: ca.SX, x: ca.SX, label: str) -> ca.SX:
    """The potential without the conditions that make it +inf: a function that is finite where they fail, too."""
    finite = []

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX | None:
        if args[1].is_constant() and np.isinf(float(args[1])):
            return ca.SX(0)
        finite.append(old)
        return None

    direct = rewrite_nodes(phi, rule, (ca.OP_IF_ELSE_ZERO,), x, label)
    if not finite:
        return direct
    parts = read_potential_parts(phi, x, label)
    return ca.substitute(parts.value, parts.symbols, parts.meanings({})) if parts.nodes else parts.value


def domain_rows(phi: ca.SX, x: ca.SX, label: str) -> tuple[list[ca.SX], list[ca.SX]]:
    """The domain of a potential as expressions that are >= 0, and those that are 0, in terms of x alone."""
    parts = read_potential_parts(phi, x, label)
    meanings = parts.meanings({})
    rows, equalities = [], []
    for bound in parts.bounds:
        u = ca.substitute(bound.u, parts.symbols, meanings) if parts.nodes else bound.u
        (equalities if bound.kind == "equality" else rows).append(u)
    return rows, equalities
