"""Residuals from the definition of the law, without unit.

With y = W l + b: s_y,i = |b_i| + sum_j |W_ij l_j|, s_l,i = s_y,i / max_j |W_ij|; the residual is the least
max(|l - l^| / s_l, |y - y^| / s_y) over points (l^, y^) of the graph {-y^ ∈ N_K(l^)}; 0/0 = 0. A row of zeros in W is judged on
y, and on l's distance to K relative to l. What is below the round-off of evaluating y counts as 0.
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
    law: NumericLaw, l: np.ndarray, y: np.ndarray, s_y: np.ndarray, w_max: np.ndarray, slack: np.ndarray | float = 0.0
) -> np.ndarray:
    """Return the residual of each row (m,): y the output, s_y its scale, w_max = max_j |W_ij|, slack the round-off of y."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        s_l = np.where(w_max > 0, s_y / w_max, np.inf)
        lo, up = law.lower, law.upper
        outside = np.maximum(np.maximum(lo - l, l - up), 0)
        beyond = np.maximum(np.abs(y) - slack, 0)
        at_lower = np.maximum(_ratio(np.abs(l - lo), s_l), _ratio(np.where(y < 0, beyond, 0), s_y))
        at_upper = np.maximum(_ratio(np.abs(l - up), s_l), _ratio(np.where(y > 0, beyond, 0), s_y))
        at_lower[np.isinf(lo)], at_upper[np.isinf(up)] = np.inf, np.inf
        between = np.maximum(_ratio(outside, s_l), _ratio(beyond, s_y))
        residual = np.minimum(np.minimum(at_lower, at_upper), between)
        residual = np.where(w_max > 0, residual, np.maximum(residual, _ratio(outside, np.abs(l))))
    for block in law.curved:
        residual[block[1]] = _curved_residual(block, l, y, s_y, w_max, np.broadcast_to(slack, y.shape))
    return np.where(np.isfinite(l) & np.isfinite(y), residual, np.inf)


def _curved_residual(block: Any, l: Any, y: Any, s_y: Any, w_max: Any, slack: Any) -> float:
    """|l - P_K(l - c y)| / s_l, c = s_l / s_y: by Minty the graph point (P_K(u), (P_K(u) - u)/c) is that far in both scales."""
    kind, rows, radius = block
    l, y = l[rows], y[rows].copy()
    size = np.linalg.norm(y)
    y *= max(0.0, 1 - np.linalg.norm(slack[rows]) / size) if size else 0.0
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


def box_residual_sx(lo: np.ndarray, up: np.ndarray, w_max: np.ndarray, l: Any, y: Any, s_y: Any, slack: Any) -> Any:
    """Return the largest row residual of a box law as a CasADi expression: `law_residual` in symbols."""

    def ratio(a: Any, s: Any) -> Any:
        return ca.if_else(a == 0, 0, a / s)

    worst = 0
    for i in range(lo.size):
        s_l = s_y[i] / w_max[i] if w_max[i] > 0 else None
        beyond = ca.fmax(ca.fabs(y[i]) - slack[i], 0)

        def distance(e: Any, violation: Any, i: int = i, s_l: Any = s_l) -> Any:
            part = ratio(violation, s_y[i])
            return part if s_l is None else ca.fmax(ratio(ca.fabs(e), s_l), part)

        outside = ca.fmax(ca.fmax(lo[i] - l[i], l[i] - up[i]), 0)
        best = distance(outside, beyond)
        if np.isfinite(lo[i]):
            best = ca.fmin(best, distance(l[i] - lo[i], ca.if_else(y[i] < 0, beyond, 0)))
        if np.isfinite(up[i]):
            best = ca.fmin(best, distance(l[i] - up[i], ca.if_else(y[i] > 0, beyond, 0)))
        if s_l is None:
            best = ca.fmax(best, ratio(outside, ca.fabs(l[i])))
        worst = ca.fmax(worst, ca.if_else(best >= 0, best, ca.inf))  # a NaN compares false: it becomes inf
    return worst
