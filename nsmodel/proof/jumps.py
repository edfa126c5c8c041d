"""Jumps of an expression: which of its operations switch, and points on both sides of a switch where its value differs."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import extremum
from nsmodel.proof.graph import rewrite_nodes

SWITCH_OPERATIONS = (ca.OP_SIGN, ca.OP_FLOOR, ca.OP_CEIL, ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE)  # Their values are steps.
OTHER_JUMP_OPERATIONS = (
    ca.OP_FMOD,
    ca.OP_REMAINDER,
    ca.OP_COPYSIGN,
    ca.OP_ATAN2,
    ca.OP_IF_ELSE_ZERO,
    ca.OP_NOT,
    ca.OP_AND,
    ca.OP_OR,
)
SURFACE_SAMPLES = 4096


class ExpressionJump(NamedTuple):
    """A point z (n,) where an expression jumps by ``size`` (the norm), and the two values beside it."""

    at: np.ndarray
    size: float
    below: np.ndarray
    above: np.ndarray


def jump_nodes(expr: ca.SX, x: ca.SX) -> list[ca.SX]:
    """Return the nodes of an expression that can jump and whose arguments depend on x."""
    return _operation_nodes(expr, x, (*SWITCH_OPERATIONS, *OTHER_JUMP_OPERATIONS))


def _operation_nodes(expr: ca.SX, x: ca.SX, ops: tuple[int, ...]) -> list[ca.SX]:
    nodes: list[ca.SX] = []

    def collect(op: int, args: list[ca.SX], old: ca.SX) -> None:
        if not any(ca.is_equal(old, other, 3) for other in nodes):
            nodes.append(old)

    rewrite_nodes(ca.densify(ca.vec(expr)), collect, ops, x, "expression")
    return nodes


def _switch_function(node: ca.SX) -> ca.SX:
    """Return a step function that changes wherever the operation can jump."""
    op = node.op()
    if op in (ca.OP_FMOD, ca.OP_REMAINDER):
        ratio = node.dep(0) / node.dep(1)
        return ca.floor(ca.fabs(ratio) if op == ca.OP_FMOD else ratio + 0.5)  # fmod rounds towards 0
    if op in (ca.OP_COPYSIGN, ca.OP_ATAN2):
        return ca.sign(node.dep(1 if op == ca.OP_COPYSIGN else 0))
    return node.dep(0) != 0 if op == ca.OP_IF_ELSE_ZERO else node


def switching_point_pairs(
    expr: ca.SX, z: ca.SX, lower: np.ndarray, upper: np.ndarray, count: int = SURFACE_SAMPLES
) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of points (k, n), an ulp or so apart, between which an operation of ``expr`` switches."""
    nodes = [_switch_function(node) for node in _operation_nodes(expr, z, (*SWITCH_OPERATIONS, *OTHER_JUMP_OPERATIONS))]
    if not nodes:
        return np.zeros((0, z.numel())), np.zeros((0, z.numel()))
    state = ca.Function("state", [z], [ca.vertcat(*nodes)])
    points = extremum.samples(lower, upper, count)
    at = np.array(state(points.T))
    pairs = []
    for k in range(len(nodes)):
        order = np.argsort(at[k], kind="stable")
        low, high = points[order], points[order[::-1]]
        differs = (at[k][order] != at[k][order[::-1]])[: count // 2]
        x, y = low[: count // 2][differs], high[: count // 2][differs]
        if not len(x):
            continue
        start = np.array(state(x.T))[k]
        for _ in range(60):
            middle = (x + y) / 2
            same = (np.array(state(middle.T))[k] == start)[:, None]
            x, y = np.where(same, middle, x), np.where(same, y, middle)
        pairs.append((x, y))
    if not pairs:
        return np.zeros((0, z.numel())), np.zeros((0, z.numel()))
    return np.vstack([x for x, _ in pairs]), np.vstack([y for _, y in pairs])


def find_jump(
    expr: ca.SX, z: ca.SX, lower: np.ndarray, upper: np.ndarray, admissible: Callable[[np.ndarray], np.ndarray]
) -> ExpressionJump | None:
    """Return the largest jump found at points (k, n) of the box that are ``admissible``; None where there was none.

    A difference counts as a jump when it is far above what the size of the values, there and elsewhere, rounds to.
    """
    x, y = switching_point_pairs(expr, z, lower, upper)
    if not len(x):
        return None
    keep = admissible(x) & admissible(y)
    x, y = x[keep], y[keep]
    if not len(x):
        return None
    f = ca.Function("f", [z], [ca.densify(ca.vec(expr))])
    below, above = np.array(f(x.T)).T, np.array(f(y.T)).T
    with np.errstate(all="ignore"):
        sizes = np.linalg.norm(np.array(f(extremum.samples(lower, upper, 256).T)), axis=0)
        typical = np.median(sizes[np.isfinite(sizes)]) if np.isfinite(sizes).any() else 0.0
        size = np.linalg.norm(above - below, axis=1)
        scale = np.linalg.norm(below, axis=1) + np.linalg.norm(above, axis=1)
        size = np.where(np.isfinite(size) & (size > 1e-7 * scale) & (size > 1e-12 * typical), size, 0.0)
    if not size.any():
        return None
    k = int(np.argmax(size))
    return ExpressionJump(x[k], float(size[k]), below[k], above[k])
