"""Which constraints are near 0 where the bodies are: rows of `solve.near`, those that matter to a hypothesis."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.bodies.groups import Family
from nsmodel.classes.bodies.schemes.prediction_correction import BodiesProblem, ContactRows, searched
from nsmodel.proof import interval
from nsmodel.proof.sure import sure
from nsmodel.solve.certificate import EPS
from nsmodel.solve.near import least_gap, near

UNSEEN = 1e-10  # A deficit below this part of the terms of a constraint counts as rounding.
AT_ONCE = 1 << 18  # Constraints that are bounded in one go.
LOOSE = 1e-9  # Constraints above a margin by this part of the positions are looked at too: their value is rounded.


def within(problem: BodiesProblem, t: float, q: np.ndarray, margin: float) -> ContactRows:
    """Return the constraints with g <= margin at the states q (N, d), NaN where a body is absent."""
    rows = near(problem, t, q, _there(q), float(np.nextafter(margin, np.inf)))
    return rows.at(~(rows.g > margin))


def nearest(problem: BodiesProblem, t: float, q: np.ndarray) -> ContactRows:
    """Return the constraints with the least g, and all whose g may be below 0."""
    least = least_gap(problem, t, q, _there(q))
    if not np.isfinite(least):
        return within(problem, t, q, 0.0)
    return within(problem, t, q, _margin(least, q))


def doubtful(problem: BodiesProblem, t: float, q: np.ndarray) -> tuple[ContactRows, np.ndarray, np.ndarray]:
    """Return the constraints with the least g and all whose g may be below 0, rounding included, with rigorous bounds (R,)."""
    least = least_gap(problem, t, q, _there(q))
    margin = _margin(least, q) if np.isfinite(least) else 0.0
    reach = max((_rounding(problem, t, family) for family in problem.families if searched(family)), default=0.0)
    rows = near(problem, t, q, _there(q), float(np.nextafter(margin + reach, np.inf)))
    parts = [bounds(problem, t, q, rows.at(some)) for some in np.array_split(np.arange(len(rows.g)), 1 + len(rows.g) // AT_ONCE)]
    low, high = (np.concatenate(ends) for ends in zip(*parts, strict=True))
    kept = np.flatnonzero(~(rows.g > margin) | ~(low >= 0))
    return rows.at(kept), low[kept], high[kept]


def _margin(least: float, q: np.ndarray) -> float:
    return max(least, 0.0) + LOOSE * (1.0 + float(np.abs(q[_there(q)]).max(initial=0.0)))


def _rounding(problem: BodiesProblem, t: float, family: Family) -> float:
    """How much the reach of a pair is rounded, from that of two bodies with the numbers of each."""
    d, numbers = problem.d, np.unique(problem.numbers, axis=0)
    z = ca.vertcat(problem.model.t, *(member.symbols[d:] for member in family.moving))
    points = np.hstack([np.full((len(numbers), 1), t), numbers, numbers])
    low, high = interval.enclose(sure(family.reach), z, points, points)
    return 4 * float(np.nan_to_num(high - low, posinf=0.0).max(initial=0.0))


def named(problem: BodiesProblem, rows: ContactRows, k: int) -> str:
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


def sizes(problem: BodiesProblem, t: float, q: np.ndarray, rows: ContactRows) -> np.ndarray:
    """Return how large (R,) the terms are that g is added up from: its states, each by its slope, and what its bounds show."""
    low, high = bounds(problem, t, q, rows)
    with np.errstate(all="ignore"):
        moved = np.abs(rows.G * q[rows.first]).sum(axis=1) + np.where(rows.pair, np.abs(rows.H * q[rows.other]).sum(axis=1), 0.0)
        return np.nan_to_num(moved, nan=0.0, posinf=0.0) + np.nan_to_num((high - low) / EPS, nan=0.0, posinf=0.0)


def all_admitted(problem: BodiesProblem, t: float, q: np.ndarray) -> bool:
    """Whether every constraint is >= 0, to the rounding of its own terms."""
    rows = within(problem, t, q, 0.0)
    return bool((rows.g >= -UNSEEN * sizes(problem, t, q, rows)).all())


def bounds(problem: BodiesProblem, t: float, q: np.ndarray, rows: ContactRows) -> tuple[np.ndarray, np.ndarray]:
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
    return np.all(np.isfinite(q), axis=1)
