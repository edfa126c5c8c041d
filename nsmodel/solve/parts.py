"""A step that falls into parts which do not touch: each is a one-step problem of its own, of the same t, h and state."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from nsmodel.laws import Box, Law
from nsmodel.scheme.problem import OneStepProblem


def connected_parts(problem: OneStepProblem) -> list[tuple[np.ndarray, np.ndarray]]:
    """The numbers of the unknowns z and of the multipliers of each part; one part where everything hangs together."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n, m = problem.z.numel(), problem.l.numel()
    offsets = ((0, 0), (0, n), (n, 0), (n, n))
    triplets = [J.sparsity().get_triplet() for J in problem.jacobians]
    i = [a + row for (a, _), (rows, _) in zip(offsets, triplets, strict=True) for row in rows]
    j = [b + column for (_, b), (_, columns) in zip(offsets, triplets, strict=True) for column in columns]
    at = n
    for block in problem.law.blocks:
        if not block.separable:
            i += [at] * block.size
            j += range(at, at + block.size)
        at += block.size
    count, label = connected_components(coo_array((np.ones(len(i)), (i, j)), shape=(n + m, n + m)), directed=False)
    return [(np.flatnonzero(label[:n] == k), np.flatnonzero(label[n:] == k)) for k in range(count)]


def part_problem(problem: OneStepProblem, z: np.ndarray, l: np.ndarray) -> OneStepProblem:
    """The problem of one part; its row keeps z as the record "z"."""
    others = [int(i) for i in np.setdiff1d(np.arange(problem.l.numel()), l)]
    guess, own, rows = problem.guess, [int(i) for i in z], [int(i) for i in l]
    if others:
        guess = ca.substitute([guess], [problem.l[others]], [ca.SX.zeros(len(others))])[0]
    return replace(
        problem, z=_column_entries(problem.z, own), l=_column_entries(problem.l, rows), y=_column_entries(problem.y, rows),
        E=_column_entries(problem.E, own),
        Y=_column_entries(problem.Y, rows), law=_part_law(problem.law, rows), rows=tuple(problem.rows[i] for i in rows),
        guess=_column_entries(guess, own),
        next_state=problem.state, multipliers=None, outputs=None, records={"z": _column_entries(problem.z, own)}, overreach=None,
        start=None, scale=None if problem.scale is None else problem.scale[rows],
        explicit=tuple(own.index(i) for i in problem.explicit if i in own),
    )  # fmt: skip


def _column_entries(column: ca.SX, rows: list[int]) -> ca.SX:
    """Some entries, none of which are a column, too."""
    return ca.reshape(column[rows], len(rows), 1)


def _part_law(law: Law, rows: list[int]) -> Law:
    blocks, at = [], 0
    for block in law.blocks:
        own = [i - at for i in rows if at <= i < at + block.size]
        at += block.size
        if own and isinstance(block, Box):
            blocks.append(block.rows(own))
        elif own:
            blocks.append(block)
    return Law(tuple(blocks))
