"""Residuals from the definition of the law, without unit.

With y = W l + b: s_y,i = |b_i| + sum_j |W_ij l_j|, s_l,i = s_y,i / max_j |W_ij|; the residual is the least
max(|l - l^| / s_l, |y - y^| / s_y) over points (l^, y^) of the graph {-y^ ∈ N_K(l^)}; 0/0 = 0. A row of zeros in W is judged on
y, and on l's distance to K relative to l. s_y is not taken below (round-off of evaluating y) / tolerance: a difference that
double precision cannot see does not fail a step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.model.laws import Law

EPS = np.finfo(float).eps


@dataclass(frozen=True)
class NumericLaw:
    """K with numbers: the box [lower, upper] (m,), and the curved blocks as (kind, slice, radius)."""

    lower: np.ndarray
    upper: np.ndarray
    curved: tuple[tuple[str, slice, float], ...]

    @property
    def size(self) -> int:
        """Number of rows m."""
        return self.lower.size


def numeric_law(law: Law) -> NumericLaw:
    """Return the law with its bounds evaluated (they must be constants)."""
    lower, upper = np.array(ca.DM(law.lower)).ravel(), np.array(ca.DM(law.upper)).ravel()
    curved, at = [], 0
    for block in law.blocks:
        rows = slice(at, at + block.size)
        if block.kind != "box":
            curved.append((block.kind, rows, float(upper[at]) if block.kind == "ball" else np.inf))
            lower[rows], upper[rows] = -np.inf, np.inf
        at += block.size
    return NumericLaw(lower, upper, tuple(curved))


def law_residual(
    law: NumericLaw, l: np.ndarray, y: np.ndarray, s_y: np.ndarray, w_max: np.ndarray, floor: np.ndarray | float = 0.0
) -> np.ndarray:
    """Return the residual of each row (m,): y the output, s_y its scale, not below ``floor``, w_max = max_j |W_ij|."""
    s_y = np.maximum(s_y, floor)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        s_l = np.where(w_max > 0, s_y / w_max, np.inf)
        lo, up = law.lower, law.upper
        outside = np.maximum(np.maximum(lo - l, l - up), 0)
        size = np.abs(y)
        at_lower = np.maximum(_ratio(np.abs(l - lo), s_l), _ratio(np.where(y < 0, size, 0), s_y))
        at_upper = np.maximum(_ratio(np.abs(l - up), s_l), _ratio(np.where(y > 0, size, 0), s_y))
        at_lower[np.isinf(lo)], at_upper[np.isinf(up)] = np.inf, np.inf
        between = np.maximum(_ratio(outside, s_l), _ratio(size, s_y))
        residual = np.minimum(np.minimum(at_lower, at_upper), between)
        residual = np.where(w_max > 0, residual, np.maximum(residual, _ratio(outside, np.abs(l))))
    for block in law.curved:
        residual[block[1]] = _curved_residual(block, l, y, s_y, w_max)
    return np.where(np.isfinite(l) & np.isfinite(y), residual, np.inf)


def _curved_residual(block: Any, l: Any, y: Any, s_y: Any, w_max: Any) -> float:
    """|l - P_K(l - c y)| / s_l, c = s_l / s_y: by Minty the graph point (P_K(u), (P_K(u) - u)/c) is that far in both scales."""
    kind, rows, radius = block
    l, y = l[rows], y[rows]
    c = 1 / w_max[rows].max() if w_max[rows].any() else 1.0
    scale = c * np.linalg.norm(s_y[rows])
    return float(_ratio(np.linalg.norm(l - project(kind, radius, l - c * y)), np.asarray(scale)))


def project(kind: str, radius: float, u: np.ndarray) -> np.ndarray:
    """P_K(u) for a ball of the given radius or the second-order cone."""
    if kind == "ball":
        size = np.linalg.norm(u)
        return u if size <= radius else u * (radius / size)
    head, size = u[0], np.linalg.norm(u[1:])
    if size <= head:
        return u
    if size <= -head:
        return np.zeros_like(u)
    t = (head + size) / 2
    return np.concatenate(([t], u[1:] * (t / size)))


def _ratio(a: Any, s: Any) -> Any:
    """a / s with 0/0 = 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(a == 0, 0.0, a / s)


def box_residual_sx(lo: np.ndarray, up: np.ndarray, w_max: np.ndarray, l: Any, y: Any, s_y: Any) -> Any:
    """Return the largest row residual of a box law as a CasADi expression: `law_residual` in symbols."""

    def ratio(a: Any, s: Any) -> Any:
        return ca.if_else(a == 0, 0, a / s)

    worst = ca.SX(0)
    for i in range(lo.size):
        size = ca.fabs(y[i])

        def distance(e: Any, violation: Any, i: int = i) -> Any:
            part = ratio(violation, s_y[i])
            return ca.fmax(ratio(ca.fabs(e) * w_max[i], s_y[i]), part) if w_max[i] > 0 else part

        outside = ca.fmax(ca.fmax(lo[i] - l[i], l[i] - up[i]), 0)
        best = distance(outside, size)
        if np.isfinite(lo[i]):
            best = ca.fmin(best, distance(l[i] - lo[i], ca.if_else(y[i] < 0, size, 0)))
        if np.isfinite(up[i]):
            best = ca.fmin(best, distance(l[i] - up[i], ca.if_else(y[i] > 0, size, 0)))
        if w_max[i] == 0:
            best = ca.fmax(best, ratio(outside, ca.fabs(l[i])))
        worst = ca.fmax(worst, ca.if_else(best >= 0, best, ca.inf))  # a NaN compares false: it becomes inf
    return worst


def settled_sx(lo: np.ndarray, up: np.ndarray, l: Any, y: Any, free: Any, round_off: Any) -> Any:
    """1 where (l, y) needs no other index set: free l inside its bounds, y of the right sign at a bound; else 0."""
    good = ca.SX(1)
    for i in range(lo.size):
        inside = ca.fmax(ca.fmax(lo[i] - l[i], l[i] - up[i]), 0) <= 8 * EPS * ca.fabs(l[i])
        at_lower = ca.logic_and(l[i] == lo[i], y[i] >= -round_off[i])
        at_upper = ca.logic_and(l[i] == up[i], y[i] <= round_off[i])
        good = ca.logic_and(good, ca.if_else(free[i], inside, ca.logic_or(at_lower, at_upper)))
    return good
