"""(A1): is F continuous on C, and if not, where does it jump."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.inclusion.hypotheses.one_sided import switching_point
from nsmodel.classes.inclusion.hypotheses.switches import remove_continuous_terms
from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.hypotheses.findings import (
    HOLDS,
    UNKNOWN,
    VIOLATED,
)
from nsmodel.proof import interval_bounds
from nsmodel.proof.convex.sets import ConvexSet
from nsmodel.proof.expression_graph import rewrite_nodes
from nsmodel.proof.jumps import SWITCH_OPERATIONS
from nsmodel.proof.verdict import HypothesisPart

FIELD_KINKS = {ca.OP_FABS: "fabs", ca.OP_FMAX: "fmax", ca.OP_FMIN: "fmin"}


def field_continuity(model: MonotoneInclusion, C: ConvexSet, box: tuple[np.ndarray, np.ndarray]) -> HypothesisPart:
    """(A1): F is continuous on C, or on a box of states."""
    F, x, x0 = model.field, model.x, np.array(ca.DM(model.x0)).ravel()
    kinks: list[str] = []
    rewrite_nodes(F, lambda op, args, old: kinks.append(FIELD_KINKS[op]), tuple(FIELD_KINKS), x, "field")
    note = f"; kinks: {', '.join(f'{kinks.count(name)} {name}' for name in dict.fromkeys(kinks))}" if kinks else ""
    value: dict[str, float] = {"kinks": len(kinks)}
    n = x.numel()
    F = remove_continuous_terms(F, C)
    for local, place, (low, high) in (
        (False, "", (np.full(n, -np.inf), np.full(n, np.inf))),
        (False, " on C", C.bounding_box),
        (True, "", (np.maximum(C.bounding_box[0], box[0]), np.minimum(C.bounding_box[1], box[1]))),
    ):
        if interval_bounds.is_continuous(F, x, low, high):
            return HypothesisPart(HOLDS, f"no operation of F jumps or has a pole{place}{note}", value, {}, local)
    jump = _find_field_jump(model.field, C, box, x0)
    if jump is not None:
        return jump
    return HypothesisPart(UNKNOWN, "an operation of F may jump or have a pole on the box; no jump was seen", {}, {})


def _find_field_jump(F: ca.SX, C: ConvexSet, box: tuple[np.ndarray, np.ndarray], x0: np.ndarray) -> HypothesisPart | None:
    """A point of C where F jumps: on both sides of the zero of a switching argument."""
    arguments: list[ca.SX] = []

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> None:
        arguments.append(args[0] if len(args) == 1 else args[0] - args[1])

    rewrite_nodes(F, rule, SWITCH_OPERATIONS, C.x, "field")
    for k, u in enumerate(arguments):
        point = switching_point(C, u, box, x0)
        if point is None:
            continue
        slope = np.array(ca.Function("slope", [C.x], [ca.gradient(u, C.x)])(point)).ravel()
        if not slope.any() or not np.isfinite(slope).all():
            continue
        below, above = (_one_sided_branch(F, C.x, k, side) for side in (-1, 1))
        for size in (1e-12, 1e-9, 1e-7):
            d = size * (1 + np.linalg.norm(point)) * slope / np.linalg.norm(slope)
            ends = point - d, point + d
            cell = np.minimum(*ends), np.maximum(*ends)
            signs = [interval_bounds.enclose(u, C.x, end, end) for end in ends]
            crosses = float(np.max(signs[0][1])) < 0 < float(np.min(signs[1][0]))
            if not crosses or any(C.interior_margin(end) is None for end in ends):
                continue
            left, right = (interval_bounds.enclose(part, C.x, *cell) for part in (below, above))
            gaps = np.maximum(np.maximum(left[0] - right[1], right[0] - left[1]), 0.0)
            if gaps.max() > 0 and np.isfinite([*left, *right]).all():
                how = "F jumps across a switching surface inside C: bounds of both sides around the point do not meet"
                middles = [((part[0] + part[1]) / 2).ravel() for part in (left, right)]
                values = {"jump": float(np.linalg.norm(gaps))}
                return HypothesisPart(
                    VIOLATED, how, values, {"x": point, "switch": str(u), "below": middles[0], "above": middles[1]}
                )
    return None


def _one_sided_branch(F: ca.SX, x: ca.SX, k: int, side: int) -> ca.SX:
    """F with its k-th switch put to what it is on one side of u = 0."""
    count = iter(range(10**6))

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX | None:
        if next(count) != k:
            return None
        up = side > 0
        values = {
            ca.OP_SIGN: side,
            ca.OP_FLOOR: up - 1,
            ca.OP_CEIL: up,
            ca.OP_LT: not up,
            ca.OP_LE: not up,
            ca.OP_EQ: 0,
            ca.OP_NE: 1,
        }
        return ca.SX(float(values[op]))

    return rewrite_nodes(F, rule, SWITCH_OPERATIONS, x, "field")
