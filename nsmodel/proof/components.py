"""What falls apart: connected parts of a graph, sets that share no members."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def connected_components(pattern: np.ndarray) -> list[list[int]]:
    """Return the connected parts of a graph, given by its symmetric pattern (n, n) of edges.

    >>> connected_components(np.array([[0, 0, 1], [0, 0, 0], [1, 0, 0]]))
    [[0, 2], [1]]
    """
    pattern = np.asarray(pattern, bool)
    left, parts = set(range(len(pattern))), []
    while left:
        part, front = set(), {min(left)}
        while front:
            part |= front
            front = {int(j) for i in front for j in np.flatnonzero(pattern[i])} - part
        parts.append(sorted(part))
        left -= part
    return parts


def overlapping_groups(sets: Sequence[set[int]]) -> list[list[int]]:
    """Return groups of indices of sets that share members, directly or through others.

    >>> overlapping_groups([{1, 2}, {3}, {2, 4}])
    [[1], [0, 2]]
    """
    groups: list[tuple[set[int], list[int]]] = []
    for k, own in enumerate(sets):
        members, rows, separate = set(own), [k], []
        for others, indices in groups:
            if others & own:
                members, rows = members | others, indices + rows
            else:
                separate.append((others, indices))
        groups = [*separate, (members, rows)]
    return [sorted(rows) for _, rows in groups]
