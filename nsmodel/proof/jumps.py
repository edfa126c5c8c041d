"""Jumps of an expression: which of its operations switch, and points on both sides of a switch where its value differs.

Jumps that provably are jumps.

Between two points the values of an expression lie in the union of its ranges over the box around them, one for each way in which
its switches can stand there. Where this union falls apart and the two ends lie in different parts, the expression cannot be
continuous on the segment between them: the image of a connected set is connected.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import extremum
from nsmodel.proof.expression_graph import OpaqueExpression, apply_operation, rewrite_nodes, stack_column
from nsmodel.proof.interval_bounds import enclose

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
# Points of the box between pairs of which a switch is bisected: all at once, 0.2 s with the proof of a jump of 3 states.
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
    points, pairs = extremum.samples(lower, upper, count), []
    for node in nodes:
        side = ca.Function("side", [z], [node])
        at = np.array(side(points.T))[0]
        order = np.argsort(at, kind="stable")
        low, high = points[order], points[order[::-1]]
        differs = (at[order] != at[order[::-1]])[: count // 2]
        x, y = low[: count // 2][differs], high[: count // 2][differs]
        if not len(x):
            continue
        start = np.array(side(x.T))[0]
        for _ in range(60):
            middle = (x + y) / 2
            same = (np.array(side(middle.T))[0] == start)[:, None]
            x, y = np.where(same, middle, x), np.where(same, y, middle)
        pairs.append((x, y))
    if not pairs:
        return np.zeros((0, z.numel())), np.zeros((0, z.numel()))
    return np.vstack([x for x, _ in pairs]), np.vstack([y for _, y in pairs])


def find_jump(
    expr: ca.SX, z: ca.SX, lower: np.ndarray, upper: np.ndarray, admissible: Callable[[np.ndarray], np.ndarray],
    count: int = SURFACE_SAMPLES,
) -> ExpressionJump | None:  # fmt: skip
    """Return the largest jump found at points (k, n) of the box that are ``admissible``, from so many samples; None: none.

    A difference counts as a jump when it is far above what the size of the values, there and elsewhere, rounds to.
    """
    x, y = switching_point_pairs(expr, z, lower, upper, count)
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
    size = jump_sizes(below, above, 1e-12 * typical)
    if not size.any():
        return None
    k = int(np.argmax(size))
    return ExpressionJump(x[k], float(size[k]), below[k], above[k])


# Pairs of points at which a jump is to be proved, evenly chosen by size from the largest down to that of a proved jump.
PAIRS_TRIED = 24
# Combinations of values that switches take between two points, each a row of bounds; of more no jump is proved there.
MAX_SWITCH_CASES = 64
# By how many times their distance two points are moved apart, at each end:
# bisected points are an ulp apart, as near as a switch rounds.
SEGMENT_WIDENING = 8.0
# Beside 1 and the points: how far they are moved apart where they show no
# jump as they are. 450 eps: numbers in a formula lose less.
POINT_SEPARATION = 1e-13
_REWRITTEN_OPERATIONS = (ca.OP_FMOD, ca.OP_REMAINDER, ca.OP_COPYSIGN)


def prove_jump(
    expr: ca.SX, z: ca.SX, lower: np.ndarray, upper: np.ndarray, where: ca.SX | None = None
) -> ExpressionJump | None:  # fmt: skip
    """Return a jump of ``expr`` on the box, at points where all rows of ``where`` are >= 0, with a lower bound of its size."""
    x, y = switching_point_pairs(expr, z, lower, upper)
    if not len(x):
        return None
    expr = ca.densify(ca.vec(expr))
    f = ca.Function("f", [z], [expr])
    with np.errstate(all="ignore"):
        size = np.abs(np.array(f(x.T)) - np.array(f(y.T))).max(axis=0)
    size = np.where(np.isfinite(size), size, 0.0)
    best: ExpressionJump | None = None
    order = np.argsort(-size, kind="stable")
    order = order[size[order] > 0]
    for k in order[:: max(1, len(order) // PAIRS_TRIED)][:PAIRS_TRIED]:
        if best is not None and size[k] <= best.size:
            break
        gap = jump_lower_bound(expr, z, x[k], y[k], where, lower, upper)
        if not gap:  # The numbers in the expression may be rounded by more than these two points are apart.
            separation = POINT_SEPARATION * float(np.max(np.abs(np.concatenate([x[k], y[k]])), initial=1.0))
            way = (y[k] - x[k]) / max(np.linalg.norm(y[k] - x[k]), np.finfo(float).tiny) * separation
            gap = jump_lower_bound(expr, z, x[k] - way, y[k] + way, where, lower, upper)
        if gap > 0 and (best is None or gap > best.size):
            best = ExpressionJump(x[k], gap, np.array(f(x[k])).ravel(), np.array(f(y[k])).ravel())
    return best


def jump_lower_bound(
    expr: ca.SX, z: ca.SX, x: np.ndarray, y: np.ndarray, where: ca.SX | None = None, lower: np.ndarray | None = None,
    upper: np.ndarray | None = None,
) -> float:  # fmt: skip
    """Return a lower bound of the jump of ``expr`` (m, 1) between two points close together (the norm); 0 where none is proved.

    Both are first moved apart by a few times their distance, so that neither lies where a switch is in between; ``where``
    must be >= 0 on the whole box around them.
    """
    x, y = x + SEGMENT_WIDENING * (x - y), y + SEGMENT_WIDENING * (y - x)
    low, high = np.minimum(x, y), np.maximum(x, y)
    outside = (lower is not None and (low < lower).any()) or (upper is not None and (high > upper).any())
    if outside:
        return 0.0
    if where is not None and where.numel() and not (enclose(where, z, low, high)[0] >= 0).all():
        return 0.0
    return gap_between(expr, z, x, y)


def gap_between(expr: ca.SX, z: ca.SX, x: np.ndarray, y: np.ndarray) -> float:
    """Return a lower bound of the jump of ``expr`` (m, 1) on the segment between two points; 0 where none is proved."""
    low, high = np.minimum(x, y), np.maximum(x, y)
    try:
        fixed, symbols, nodes = _replace_switches(expr, z)
    except OpaqueExpression:
        return 0.0
    if not nodes:
        return 0.0
    first, last = (np.ravel(end) for end in enclose(stack_column(nodes), z, low, high))
    if not (np.isfinite(first).all() and np.isfinite(last).all()) or np.prod(last - first + 1) > MAX_SWITCH_CASES:
        return 0.0
    ways = np.array(list(product(*(np.arange(np.ceil(a), np.floor(b) + 1) for a, b in zip(first, last, strict=True)))))
    inputs, boxes = ca.vertcat(z, *symbols), (np.hstack([np.tile(end, (len(ways), 1)), ways]) for end in (low, high))
    lo, hi = (end[:, :, 0] for end in enclose(fixed, inputs, *boxes))
    ends = [tuple(np.ravel(end) for end in enclose(expr, z, point, point)) for point in (x, y)]
    gaps = [_gap_between_parts(lo[:, i], hi[:, i], *((a[i], b[i]) for a, b in ends)) for i in range(expr.numel())]
    return float(np.linalg.norm(gaps)) * (1 - 1e-15)


def _replace_switches(expr: ca.SX, z: ca.SX) -> tuple[ca.SX, list[ca.SX], list[ca.SX]]:
    """The expression with symbols in place of its switches, the symbols, and what they stand for (whole numbers)."""
    symbols: list[ca.SX] = []
    nodes: list[ca.SX] = []

    def switch_symbol(node: ca.SX) -> ca.SX:
        for symbol, old in zip(symbols, nodes, strict=True):
            if ca.is_equal(node, old, 4):
                return symbol
        symbols.append(ca.SX.sym(f"s{len(symbols)}"))
        nodes.append(node)
        return symbols[-1]

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX | None:
        if op in (ca.OP_SIGN, ca.OP_FLOOR, ca.OP_CEIL):
            return switch_symbol(old)
        a, b = old.dep(0), old.dep(1)
        if op in SWITCH_OPERATIONS:  # Comparisons of the same two, either way round, are one sign.
            swapped = any(ca.is_equal(ca.sign(b - a), node, 4) for node in nodes)
            side = -switch_symbol(ca.sign(b - a)) if swapped else switch_symbol(ca.sign(a - b))
            return apply_operation(op, [side, ca.SX(0)])
        if op == ca.OP_COPYSIGN:
            return ca.fabs(args[0]) * (2 * switch_symbol(b >= 0) - 1)
        ratio = a / b
        whole = (
            switch_symbol(ca.floor(ratio + 0.5))
            if op == ca.OP_REMAINDER
            else switch_symbol(ca.sign(ratio)) * switch_symbol(ca.floor(ca.fabs(ratio)))
        )
        return args[0] - args[1] * whole

    fixed = rewrite_nodes(expr, rule, (*SWITCH_OPERATIONS, *_REWRITTEN_OPERATIONS), z, "expression")
    return fixed, symbols, nodes


def _gap_between_parts(lo: np.ndarray, hi: np.ndarray, one: tuple[float, float], other: tuple[float, float]) -> float:
    """The gap between the parts of a union of intervals in which two values lie; 0 where it is the same part, or not known."""
    order = np.argsort(lo)
    parts: list[list[float]] = []
    for a, b in zip(lo[order], hi[order], strict=True):
        if parts and a <= parts[-1][1]:
            parts[-1][1] = max(parts[-1][1], b)
        else:
            parts.append([a, b])
    places = [[k for k, (a, b) in enumerate(parts) if a <= end[1] and end[0] <= b] for end in (one, other)]
    if any(len(place) != 1 for place in places) or places[0] == places[1]:
        return 0.0
    (i,), (j,) = sorted(places)
    gap = parts[j][0] - parts[i][1] if j > i else parts[i][0] - parts[j][1]
    return float(gap) * (1 - 1e-15) if np.isfinite(gap) else 0.0


def jump_sizes(below: np.ndarray, above: np.ndarray, least: np.ndarray | float) -> np.ndarray:
    """The size (k,) of the jumps between values (k, r); 0 where rounding explains it: up to ``least``, (k,) or a number."""
    with np.errstate(all="ignore"):
        size = np.linalg.norm(above - below, axis=1)
        scale = np.linalg.norm(below, axis=1) + np.linalg.norm(above, axis=1)
        return np.where(np.isfinite(size) & (size > 1e-7 * scale) & (size > least), size, 0.0)
