"""Which constraints are near 0 where the bodies are: rows of `solve.near`, those that matter to a hypothesis."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.hypotheses.proof import interval
from nsmodel.scheme.many_bodies import BodiesProblem, Rows
from nsmodel.solve.near import least_gap, near

LOOSE = 1e-9  # Constraints above a margin by this part of the positions are looked at too: their value is rounded.


def within(problem: BodiesProblem, t: float, q: np.ndarray, margin: float) -> Rows:
    """Return the constraints with g <= margin at the states q (N, d), NaN where a body is absent."""
    rows = near(problem, t, q, _there(q), float(np.nextafter(margin, np.inf)))
    return rows.at(~(rows.g > margin))


def nearest(problem: BodiesProblem, t: float, q: np.ndarray) -> Rows:
    """Return the constraints with the least g, and all whose g may be below 0."""
    least = least_gap(problem, t, q, _there(q))
    if not np.isfinite(least):
        return within(problem, t, q, 0.0)
    return within(problem, t, q, max(least, 0.0) + LOOSE * (1.0 + float(np.abs(q[_there(q)]).max(initial=0.0))))


def named(problem: BodiesProblem, rows: Rows, k: int) -> str:
    """The constraint of one row."""
    return problem.name(int(rows.family[k]), int(rows.first[k]), int(rows.second[k]))


def admits(problem: BodiesProblem, t: float, q: np.ndarray, body: int) -> bool:
    """Whether every constraint on one body is >= 0."""
    others = np.flatnonzero(_there(q) & (np.arange(len(q)) != body))
    for k, family in enumerate(problem.families):
        if family.over is not None:
            own = (family.over == body).any(axis=1) if family.of_pairs else family.over[:, 0] == body
            first, second = family.over[own].T
        elif family.of_pairs:
            first, second = np.minimum(others, body), np.maximum(others, body)
        else:
            second = np.arange(family.second.group.count) if family.second is not None else np.array([-1])
            first = np.full(second.size, body)
        if not (problem.gap(k, t, q, first, second) >= 0).all():
            return False
    return True


def bounds(problem: BodiesProblem, t: float, q: np.ndarray, rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Return rigorous bounds (R,) of g, rounding included."""
    low, high = np.full(len(rows.g), -np.inf), np.full(len(rows.g), np.inf)
    for k, family in enumerate(problem.families):
        own = np.flatnonzero(rows.family == k)
        if not own.size:
            continue
        first, second = rows.first[own], rows.second[own]
        columns, values = [problem.model.t, family.first.symbols], [np.full((own.size, 1), t), q[first], problem.numbers[first]]
        if family.second is not None:
            columns.append(family.second.symbols)
            values += [q[second], problem.numbers[second]] if family.of_pairs else [family.second.group.table[second]]
        points = np.hstack(values)
        low[own], high[own] = (np.ravel(end) for end in interval.enclose(ca.SX(family.g), ca.vertcat(*columns), points, points))
    return low, high


def _there(q: np.ndarray) -> np.ndarray:
    return np.isfinite(q).all(axis=1)
