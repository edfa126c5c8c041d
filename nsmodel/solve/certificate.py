"""Residuals from the definition of the law, without unit.

With y = W l + b, w_i = max_j |W_ij| and s_y,i = |b_i| + sum_j |W_ij l_j|, s_l,i = s_y,i / w_i, the residual is the least
max(|l - l^| / s_l, |y - y^| / s_y) over points (l^, y^) of the graph {-y^ ∈ N_K(l^)}; 0/0 = 0. Three limits on the scales:
- a row of zeros in W is judged on y, and on l beside the size of l and of its bounds;
- s_y stays below 1000 sqrt(w_i) max_k |b_k| / sqrt(w_k): multipliers that grow without bound, because the step has no
  solution, do not excuse a violation;
- s_y stays above (round-off of evaluating y) / tolerance: what double precision cannot see does not fail a step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.model.laws import Law

EPS = np.finfo(float).eps
GROWTH = 1e3  # How far the multipliers' terms may raise the scale of y above that of b.


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


def output_scale(b: np.ndarray, terms: np.ndarray, w_max: np.ndarray) -> np.ndarray:
    """s_y (m,) from b, terms = |W| |l| and w_max."""
    root = np.sqrt(w_max)
    weighed = np.divide(np.abs(b), root, out=np.zeros_like(root), where=root > 0)
    cap = GROWTH * root * weighed.max(initial=0.0)
    return np.where(root > 0, np.minimum(np.abs(b) + terms, np.maximum(cap, np.abs(b))), np.abs(b))


def law_residual(
    law: NumericLaw, l: np.ndarray, y: np.ndarray, s_y: np.ndarray, w_max: np.ndarray, floor: np.ndarray | float = 0.0
) -> np.ndarray:
    """Return the residual of each row (m,): y the output, s_y its scale, not below ``floor``, w_max = max_j |W_ij|."""
    s_y = np.maximum(s_y, floor)
    lo, up = law.lower, law.upper
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        s_l, size = np.where(w_max > 0, s_y / w_max, np.maximum(np.abs(l), bound_size(law))), np.abs(y)
        outside = np.maximum(np.maximum(lo - l, l - up), 0)
        at_lower = np.maximum(_ratio(np.abs(l - lo), s_l), _ratio(np.where(y < 0, size, 0), s_y))
        at_upper = np.maximum(_ratio(np.abs(l - up), s_l), _ratio(np.where(y > 0, size, 0), s_y))
        at_lower[np.isinf(lo)], at_upper[np.isinf(up)] = np.inf, np.inf
        between = np.maximum(_ratio(outside, s_l), _ratio(size, s_y))
        residual = np.minimum(np.minimum(at_lower, at_upper), between)
        for block in law.curved:
            residual[block[1]] = _curved_residual(block, l, y, s_y, w_max)
    return np.where(np.isfinite(l) & np.isfinite(y), residual, np.inf)


def bound_size(law: NumericLaw) -> np.ndarray:
    """The largest finite bound of each row, in absolute value (m,); 0 where none is finite."""
    return np.maximum(*(np.where(np.isfinite(bound), np.abs(bound), 0.0) for bound in (law.lower, law.upper)))


def _curved_residual(block: Any, l: Any, y: Any, s_y: Any, w_max: Any) -> float:
    """|l - P_K(l - c y)| / s_l, c = s_l / s_y: by Minty the graph point (P_K(u), (P_K(u) - u)/c) is that far in both scales."""
    kind, rows, radius = block
    l, y = l[rows], y[rows]
    c = 1 / w_max[rows].max() if w_max[rows].any() else 1.0
    scale = c * np.linalg.norm(s_y[rows])
    distance = np.linalg.norm(l - project(kind, radius, l - c * y))
    return float(distance / scale) if distance else 0.0


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


def _ratio(a: np.ndarray, s: np.ndarray) -> np.ndarray:
    """a / s with 0/0 = 0; to be called where division by 0 is silenced."""
    return np.divide(a, s, out=np.zeros_like(a), where=a != 0)


def output_scale_sx(b: Any, terms: Any, w_max: np.ndarray) -> Any:
    """`output_scale` in symbols."""
    root = np.sqrt(w_max)
    weighed = [ca.fabs(b[i]) / root[i] for i in np.flatnonzero(root)]
    largest = ca.mmax(ca.vertcat(*weighed)) if weighed else 0
    return ca.vertcat(*(
        ca.fmin(ca.fabs(b[i]) + terms[i], ca.fmax(GROWTH * root[i] * largest, ca.fabs(b[i]))) if root[i] else ca.fabs(b[i])
        for i in range(w_max.size)
    ))  # fmt: skip


def box_residual_sx(law: NumericLaw, rows: list[int], w_max: np.ndarray, l: Any, y: Any, s_y: Any) -> Any:
    """Return the largest residual of the given box rows as a CasADi expression: `law_residual` in symbols."""

    def ratio(a: Any, s: Any) -> Any:
        return ca.if_else(a == 0, 0, a / s)

    worst, bounds = ca.SX(0), bound_size(law)
    for i in rows:
        lo, up, size = law.lower[i], law.upper[i], ca.fabs(y[i])
        s_l = s_y[i] / w_max[i] if w_max[i] > 0 else ca.fmax(ca.fabs(l[i]), bounds[i])
        best = ca.fmax(ratio(ca.fmax(ca.fmax(lo - l[i], l[i] - up), 0), s_l), ratio(size, s_y[i]))
        if np.isfinite(lo):
            at_lower = ca.fmax(ratio(ca.fabs(l[i] - lo), s_l), ratio(ca.if_else(y[i] < 0, size, 0), s_y[i]))
            best = ca.fmin(best, at_lower)
        if np.isfinite(up):
            at_upper = ca.fmax(ratio(ca.fabs(l[i] - up), s_l), ratio(ca.if_else(y[i] > 0, size, 0), s_y[i]))
            best = ca.fmin(best, at_upper)
        worst = ca.fmax(worst, ca.if_else(best >= 0, best, ca.inf))  # a NaN compares false: it becomes inf
    return worst


def settled_sx(law: NumericLaw, rows: list[int], l: Any, y: Any, free: Any, round_off: Any) -> Any:
    """1 where (l, y) needs no other index set: free l inside its bounds, y of the right sign at a bound; else 0."""
    good = ca.SX(1)
    for i in rows:
        lo, up = law.lower[i], law.upper[i]
        inside = ca.fmax(ca.fmax(lo - l[i], l[i] - up), 0) <= 8 * EPS * ca.fabs(l[i])
        at_lower = ca.logic_and(l[i] == lo, y[i] >= -round_off[i])
        at_upper = ca.logic_and(l[i] == up, y[i] <= round_off[i])
        good = ca.logic_and(good, ca.if_else(free[i], inside, ca.logic_or(at_lower, at_upper)))
    return good
