"""A bound of gamma from one point that convex constraints all forbid.

Where g_i is convex and g_i(t, p) <= -m_i < 0, every admissible q has <grad g_i(t, q), q - p> >= g_i(t, q) - g_i(t, p) >= m_i: the
direction q - p leaves them all, whichever are active, and gamma <= |q - p| max b_i / m_i with |grad g_i| <= b_i. Bodies that
keep apart are blown up from one place by it, and with them what they lean on, if that place lies inside each of these.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.classes.sweeping.hypotheses.constraint import Constraint
from nsmodel.classes.sweeping.hypotheses.qualification_proofs import body_pair_of
from nsmodel.proof import extremum
from nsmodel.proof.convex import rules

TIME_SLICES = (1, 8)  # Parts of the interval of time, each with a point of its own.
AWAY_ROUNDING_FACTOR = 1 + 1e-12
MAX_AWAY_STATES = 60


class ForbiddenPointBound(NamedTuple):
    """gamma <= ``gamma`` on the box, for every rho."""

    gamma: float
    how: str


def bound_by_forbidden_point(
    constraints: Sequence[Constraint], slope: np.ndarray, columns: Sequence[int], lower: np.ndarray, upper: np.ndarray
) -> ForbiddenPointBound | None:
    """Return a bound over the box (1 + n,) of (t, q), q the model's states ``columns``; ``slope`` bounds |grad g_i|."""
    if not np.isfinite(slope).all() or len(columns) > MAX_AWAY_STATES or not all(is_convex_in_state(c) for c in constraints):
        return None
    together = _shared_coordinates(constraints, columns)
    for count in TIME_SLICES if any(c.shape.time for c in constraints) and lower[0] < upper[0] else (1,):
        times = np.linspace(lower[0], upper[0], count + 1)
        worst = 0.0
        for a, b in pairwise(times):
            low, high = lower.copy(), upper.copy()
            low[0], high[0] = a, b
            worst = max(worst, _bound_on_interval(constraints, slope, columns, together, low, high))
            if np.isinf(worst):
                break
        if np.isfinite(worst):
            return ForbiddenPointBound(
                max(worst * AWAY_ROUNDING_FACTOR, 1.0),
                "convex constraints that forbid one and the same point: all of them are left by going away from it",
            )
    return None


def is_convex_in_state(c: Constraint) -> bool:
    """Whether g is convex in q at each time, for all q."""
    return c.shape.convex or (not c.shape.time and rules.global_curvatures(c.g, c.q)[0].convex)


def _shared_coordinates(constraints: Sequence[Constraint], columns: Sequence[int]) -> np.ndarray:
    """(n,) numbers of the coordinates of a point at which all bodies that keep apart are in one place."""
    place = {j: k for k, j in enumerate(columns)}
    name = np.arange(len(columns))
    for c in constraints:
        pair = body_pair_of(c)
        for i, j in zip(pair.first, pair.second, strict=True) if pair is not None else ():
            name[name == name[place[j]]] = name[place[i]]
    return np.unique(name, return_inverse=True)[1].ravel()


def _bound_on_interval(
    constraints: Sequence[Constraint], slope: np.ndarray, columns: Sequence[int], together: np.ndarray, lower: np.ndarray,
    upper: np.ndarray,
) -> float:  # fmt: skip
    """The bound on a part of the interval of time; inf where no point was found."""
    y = ca.SX.sym("y", int(together.max()) + 1)
    place = {j: k for k, j in enumerate(columns)}
    rows, t = [], constraints[0].t
    for c in constraints:
        own = [int(together[place[i]]) for i in c.shape.own]
        rows.append(ca.substitute(c.g, c.q, y[own]))
    shared = [np.flatnonzero(together == k) for k in range(y.numel())]
    start = np.array([0.5 * (lower[1 + own].mean() + upper[1 + own].mean()) for own in shared])
    width = np.array([max(float((upper - lower)[1 + own].max()), 1e-300) for own in shared])
    for point in _forbidden_points(ca.vertcat(*rows), t, y, slope, start, width, (lower[0], (lower[0] + upper[0]) / 2, upper[0])):
        tops = [_row_supremum(ca.substitute(row, y, ca.DM(point)), t, lower[0], upper[0]) for row in rows]
        if max(tops) < 0:
            p = point[together]
            far = np.linalg.norm(np.maximum(np.abs(lower[1:] - p), np.abs(upper[1:] - p)))
            return float(far * max(b / -top for b, top in zip(slope, tops, strict=True)))
    return np.inf


def _row_supremum(row: ca.SX, t: ca.SX, a: float, b: float) -> float:
    return extremum.supremum(row, t, np.array([a]), np.array([b]), quick=True, bound_to=0.0).bound


def _forbidden_points(
    g: ca.SX, t: ca.SX, y: ca.SX, slope: np.ndarray, start: np.ndarray, width: np.ndarray, times: tuple[float, ...]
) -> list[np.ndarray]:  # fmt: skip
    """Points at which the largest g_i / b_i is small, the best first: by descent from several places."""
    scale = ca.DM(1 / np.maximum(slope, 1e-300) / float(width.max()))
    worst = ca.vertcat(*(ca.substitute(g * scale, t, time) for time in dict.fromkeys(times)))
    value = ca.Function("worst", [y], [ca.densify(worst), ca.densify(ca.jacobian(worst, y))])
    found = []
    for shift in np.vstack([np.zeros(width.size), extremum.samples(-np.ones(width.size), np.ones(width.size), 4)[1:]]):
        point, best = start + shift * width, (np.inf, start)
        for k in range(200):
            entries, J = (np.array(part) for part in value(point))
            entries = np.nan_to_num(entries.ravel(), nan=np.inf)
            i = int(np.argmax(entries))
            if entries[i] < best[0]:
                best = float(entries[i]), point
            slopes = np.nan_to_num(J[i]) * width
            size = np.linalg.norm(slopes)
            if not size:
                break
            point = point - width * slopes / size * 0.5 / (1 + 0.2 * k)
        found.append(best)
    found.sort(key=lambda item: item[0])
    return [point for worst_value, point in found[:2] if worst_value < 0]
