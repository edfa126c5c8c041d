"""Jumps that provably are jumps.

Between two points the values of an expression lie in the union of its ranges over the box around them, one for each way in which
its switches can stand there. Where this union falls apart and the two ends lie in different parts, the expression cannot be
continuous on the segment between them: the image of a connected set is connected.
"""

from __future__ import annotations

from itertools import product

import casadi as ca
import numpy as np

from nsmodel.proof.graph import OpaqueExpression, apply_operation, rewrite_nodes, stack_column
from nsmodel.proof.interval import enclose
from nsmodel.proof.jumps import SWITCH_OPERATIONS, ExpressionJump, switching_point_pairs

PAIRS_TRIED, MAX_SWITCH_CASES, SEGMENT_WIDENING, POINT_SEPARATION = 24, 64, 8.0, 1e-13
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
