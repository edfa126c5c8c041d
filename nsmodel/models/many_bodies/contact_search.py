"""Who can meet in a step: pairs of bodies within a cut-off by a search tree, and all members of families that have no reach."""

from __future__ import annotations

from typing import Any

import numpy as np

from nsmodel.models.many_bodies.schemes import BodiesProblem, ContactRows, uses_neighbour_search

FARTHER = 1e-12  # Part of its reach by which a search looks farther: 4500 EPS, so that rounding of distances hides no pair.

MemberPairs = tuple[np.ndarray, np.ndarray]


def near_contact_rows(problem: BodiesProblem, t: float, q: np.ndarray, present: np.ndarray, cutoff: float) -> ContactRows:
    """The rows of bodies that are present: searched pairs with g < ``cutoff``, and all rows of the other families."""
    return candidate_contact_rows(problem, t, q, candidate_members(problem, t, q, present, cutoff), cutoff)


def candidate_members(problem: BodiesProblem, t: float, q: np.ndarray, present: np.ndarray, cutoff: float) -> list[MemberPairs]:
    """For each family, the members to look at: a few too many of the searched pairs."""
    return [
        _near_pairs(problem, family, t, q, present, cutoff)
        if uses_neighbour_search(about)
        else _all_members(problem, family, present)
        for family, about in enumerate(problem.families)
    ]


def candidate_contact_rows(
    problem: BodiesProblem, t: float, q: np.ndarray, members: list[MemberPairs], cutoff: float
) -> ContactRows:
    """The rows of the candidates, searched pairs only where g < ``cutoff``."""
    parts = []
    for family, about in enumerate(problem.families):
        rows = problem.rows(family, t, q, *members[family])
        parts.append(rows.at(~(rows.g >= cutoff)) if uses_neighbour_search(about) else rows)
    if not parts:
        nobody = np.zeros(0, int)
        none = np.zeros((0, problem.d))
        return ContactRows(nobody.astype(np.int8), nobody, nobody, nobody.astype(bool), np.zeros(0), none, none)
    return ContactRows(*(np.concatenate([getattr(part, name) for part in parts]) for name in ContactRows.__dataclass_fields__))


def least_gap(problem: BodiesProblem, t: float, q: np.ndarray, present: np.ndarray) -> float:
    """The least g of all constraints of bodies that are present; inf where there is none."""
    least = np.inf
    bodies = np.flatnonzero(present)
    for family, about in enumerate(problem.families):
        if not uses_neighbour_search(about):
            first, second = _all_members(problem, family, present)
            least = min(least, problem.gap(family, t, q, first, second).min(initial=np.inf))
        elif bodies.size > 1:
            distance, nearest = _search_tree(q[bodies]).query(q[bodies], 2)
            one = int(distance[:, 1].argmin())
            pair = np.sort(bodies[[one, nearest[one, 1] if nearest[one, 1] != one else nearest[one, 0]]])[None, :]
            bound = float(problem.gap(family, t, q, pair[:, 0], pair[:, 1])[0])
            first, second = _near_pairs(problem, family, t, q, present, bound)
            least = min(least, bound, problem.gap(family, t, q, first, second).min(initial=np.inf))
    return float(least)


def _near_pairs(problem: BodiesProblem, family: int, t: float, q: np.ndarray, present: np.ndarray, cutoff: float) -> MemberPairs:
    """The pairs i < j no farther apart than their reach and the cut-off, and a few more, sorted.

    Bodies are searched by classes of their shares of it, each up to twice the one before: a large one costs no more than those
    around it.
    """
    bodies = np.flatnonzero(present)
    size = (problem.halves(family, t)[bodies] + cutoff / 2) * (1 + FARTHER) if bodies.size > 1 else np.zeros(0)
    if not size.size or size.max() <= 0:
        return np.zeros(0, int), np.zeros(0, int)
    size = np.maximum(size, 1e-6 * size.max())
    kind = np.floor(np.log2(size / size.min())).astype(int)
    groups = [(np.flatnonzero(kind == k), float(size[kind == k].max())) for k in np.unique(kind)]
    trees = [_search_tree(q[bodies[own]]) for own, _ in groups]
    found = [np.zeros((0, 2), int)]
    for k, (own, far) in enumerate(groups):
        found.append(bodies[own[trees[k].query_pairs(2 * far, output_type="ndarray")]])
        for m in range(k):
            table = trees[k].sparse_distance_matrix(trees[m], far + groups[m][1], output_type="ndarray")
            found.append(np.column_stack([bodies[own[table["i"]]], bodies[groups[m][0][table["j"]]]]))
    pairs = np.sort(np.concatenate(found), axis=1)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    return pairs[:, 0], pairs[:, 1]


def _search_tree(q: np.ndarray) -> Any:
    from scipy.spatial import KDTree

    return KDTree(q)


def _all_members(problem: BodiesProblem, family: int, present: np.ndarray) -> MemberPairs:
    """All members of a family that are present, sorted."""
    about = problem.families[family]
    bodies = np.flatnonzero(present)
    if about.over is not None:
        first, second = about.over[np.lexsort((about.over[:, 1], about.over[:, 0]))].T
        use = present[first] & (present[second] if about.of_pairs else True)
        return first[use], second[use]
    if about.of_pairs:
        one, other = np.triu_indices(bodies.size, 1)
        return bodies[one], bodies[other]
    if about.second is None:
        return bodies, np.full(bodies.size, -1)
    items = about.second.group.count
    return np.repeat(bodies, items), np.tile(np.arange(items), bodies.size)
