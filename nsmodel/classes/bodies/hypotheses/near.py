"""Which constraints are near 0 where the bodies are: rows of `solvers.contact_search`, those that matter to a hypothesis."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.bodies.groups import Family
from nsmodel.classes.bodies.schemes.prediction_correction import BodiesProblem, ContactRows, uses_neighbour_search
from nsmodel.proof import interval_bounds
from nsmodel.proof.verdict import not_none
from nsmodel.solvers.contact_search import least_gap, near_contact_rows
from nsmodel.solvers.residuals import EPS

TERM_ROUNDING = 1e-10  # A deficit below this part of the terms of a constraint counts as rounding.
BOUNDS_PER_CALL = 1 << 18  # Constraints that are bounded in one go.
GAP_MARGIN_ROUNDING = 1e-9  # Constraints above a margin by this part of the positions are looked at too: their value is rounded.


def constraints_within(problem: BodiesProblem, t: float, q: np.ndarray, margin: float) -> ContactRows:
    """Return the constraints with g <= margin at the states q (N, d), NaN where a body is absent."""
    rows = near_contact_rows(problem, t, q, _present_mask(q), float(np.nextafter(margin, np.inf)))
    return rows.at(~(rows.g > margin))


def nearest_constraints(problem: BodiesProblem, t: float, q: np.ndarray) -> ContactRows:
    """Return the constraints with the least g, and all whose g may be below 0."""
    least = least_gap(problem, t, q, _present_mask(q))
    if not np.isfinite(least):
        return constraints_within(problem, t, q, 0.0)
    return constraints_within(problem, t, q, _rounded_margin(least, q))


def undecided_constraints(problem: BodiesProblem, t: float, q: np.ndarray) -> tuple[ContactRows, np.ndarray, np.ndarray]:
    """Return the constraints with the least g and all whose g may be below 0, rounding included, with rigorous bounds (R,)."""
    least = least_gap(problem, t, q, _present_mask(q))
    margin = _rounded_margin(least, q) if np.isfinite(least) else 0.0
    reach = max(
        (_reach_rounding(problem, t, family) for family in problem.families if uses_neighbour_search(family)), default=0.0
    )
    rows = near_contact_rows(problem, t, q, _present_mask(q), float(np.nextafter(margin + reach, np.inf)))
    parts = [
        gap_bounds(problem, t, q, rows.at(some))
        for some in np.array_split(np.arange(len(rows.g)), 1 + len(rows.g) // BOUNDS_PER_CALL)
    ]
    low, high = (np.concatenate(ends) for ends in zip(*parts, strict=True))
    kept = np.flatnonzero(~(rows.g > margin) | ~(low >= 0))
    return rows.at(kept), low[kept], high[kept]


def _rounded_margin(least: float, q: np.ndarray) -> float:
    return max(least, 0.0) + GAP_MARGIN_ROUNDING * (1.0 + float(np.abs(q[_present_mask(q)]).max(initial=0.0)))


def _reach_rounding(problem: BodiesProblem, t: float, family: Family) -> float:
    """How much the reach of a pair is rounded, from that of two bodies with the numbers of each."""
    d, numbers = problem.d, np.unique(problem.numbers, axis=0)
    z = ca.vertcat(problem.model.t, *(member.symbols[d:] for member in family.moving))
    points = np.hstack([np.full((len(numbers), 1), t), numbers, numbers])
    low, high = interval_bounds.enclose(not_none(family.reach), z, points, points)
    return 4 * float(np.nan_to_num(high - low, posinf=0.0).max(initial=0.0))


def row_constraint_name(problem: BodiesProblem, rows: ContactRows, k: int) -> str:
    """The constraint of one row."""
    return problem.name(int(rows.family[k]), int(rows.first[k]), int(rows.second[k]))


def is_body_admissible(problem: BodiesProblem, t: float, q: np.ndarray, body: int) -> bool:
    """Whether every constraint on one body is >= 0."""
    others = np.flatnonzero(_present_mask(q) & (np.arange(len(q)) != body))
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


def term_sizes(problem: BodiesProblem, t: float, q: np.ndarray, rows: ContactRows) -> np.ndarray:
    """Return how large (R,) the terms are that g is added up from: its states, each by its slope, and what its bounds show."""
    low, high = gap_bounds(problem, t, q, rows)
    with np.errstate(all="ignore"):
        moved = np.abs(rows.G * q[rows.first]).sum(axis=1) + np.where(rows.pair, np.abs(rows.H * q[rows.other]).sum(axis=1), 0.0)
        return np.nan_to_num(moved, nan=0.0, posinf=0.0) + np.nan_to_num((high - low) / EPS, nan=0.0, posinf=0.0)


def all_admissible(problem: BodiesProblem, t: float, q: np.ndarray) -> bool:
    """Whether every constraint is >= 0, to the rounding of its own terms."""
    rows = constraints_within(problem, t, q, 0.0)
    return bool((rows.g >= -TERM_ROUNDING * term_sizes(problem, t, q, rows)).all())


def gap_bounds(problem: BodiesProblem, t: float, q: np.ndarray, rows: ContactRows) -> tuple[np.ndarray, np.ndarray]:
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
        low[own], high[own] = (
            np.ravel(end) for end in interval_bounds.enclose(ca.SX(family.g), ca.vertcat(*columns), points, points)
        )
    return low, high


def _present_mask(q: np.ndarray) -> np.ndarray:
    return np.all(np.isfinite(q), axis=1)
