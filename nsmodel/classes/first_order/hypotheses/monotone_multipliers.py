"""L, N and Theta of the quadratic form, suggested by a semidefinite program."""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.classes.first_order.hypotheses.linearised import SystemLinearisation
from nsmodel.classes.first_order.hypotheses.monotone_form import (
    MonotoneForm,
    rows_of_blocks,
)
from nsmodel.proof import conic

PROGRAM_POINTS = 24  # at which the program asks for a definite form


class _SampledForm(NamedTuple):
    """W, B, C, D at some points, in units of the box; the sizes of the rows of W, B, and of those of C, D that share a theta."""

    points: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]
    rows: np.ndarray
    blocks: list[list[int]]
    block_size: np.ndarray


def suggest_multipliers(at: SystemLinearisation, form: MonotoneForm) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """L, N and Theta with the form as definite as can be at some points, in units of the box; None where it is not."""
    n, m = form.W.shape[0], form.D.shape[0]
    x, l = form.scale[:n], form.scale[n:]
    seen = _sample_form(at, form)
    if seen is None:
        return None
    answer = _maximise_definiteness(seen, n, m)
    if answer is None:
        return None
    both = answer[: n * (n + m)].reshape(n, n + m) / seen.rows[:, None]
    theta = np.zeros(m)
    for own, weight, unit in zip(seen.blocks, answer[n * (n + m) :], seen.block_size, strict=True):
        theta[own] = weight / unit
    return both[:, :n] / x, both[:, n:] / l, theta


def _sample_form(at: SystemLinearisation, form: MonotoneForm) -> _SampledForm | None:
    """What multiplies the unknowns at corners of the box and at points inside; None where it is not finite."""
    n, m = form.W.shape[0], form.D.shape[0]
    rng = np.random.default_rng(0)
    corners = np.where(rng.random((PROGRAM_POINTS, len(form.lower))) < 0.5, form.lower, form.upper)
    corners[: PROGRAM_POINTS // 3] = rng.uniform(form.lower, form.upper, (PROGRAM_POINTS // 3, len(form.lower)))
    corners[-1, len(at.lower) :] = 1.0
    values = ca.Function("values", [form.z], [ca.densify(part) for part in form[:4]])
    x, l = form.scale[:n], form.scale[n:]
    points = []
    for point in corners:
        W, B, C, D = (
            np.array(part).reshape(shape) for part, shape in zip(values(point), ((n, n), (n, m), (m, n), (m, m)), strict=True)
        )
        if not all(np.isfinite(part).all() for part in (W, B, C, D)):
            return None
        points.append((W * x, B * l, l[:, None] * C * x, l[:, None] * D * l))
    rows = np.max([np.abs(np.hstack([W, B])).max(axis=1) for W, B, _, _ in points], axis=0)
    outs = np.max([np.abs(np.hstack([C, D])).max(axis=1) for _, _, C, D in points], axis=0) if m else np.zeros(0)
    rows, outs = np.where(rows > 0, rows, 1.0), np.where(outs > 0, outs, 1.0)
    blocks = rows_of_blocks(at)
    return _SampledForm(points, rows, blocks, np.array([max(outs[own]) for own in blocks]) if m else np.zeros(0))


def _maximise_definiteness(seen: _SampledForm, n: int, m: int) -> np.ndarray | None:
    """Maximise the least eigenvalue of the forms at all points over the entries of L and N, row by row, and Theta by blocks.

    |unknowns| <= 1e3, Theta >= 1e-3, and the eigenvalue is at most 1.
    """
    unknowns = n * n + n * m + len(seen.blocks)
    data, right, cones = [], [], []
    for point in seen.points:
        columns = _unknown_columns(seen, *point)
        data.append(np.column_stack([*(-column for column in columns), _stack_triangle(np.eye(n + m))]))
        right.append(np.zeros(len(columns[0])))
        cones.append(conic.semidefinite_cone(n + m))
    for sign in (1.0, -1.0):
        data.append(np.hstack([sign * np.eye(unknowns), np.zeros((unknowns, 1))]))
        bound = np.full(unknowns, 1e3)
        if sign < 0:
            bound[n * n + n * m :] = -1e-3
        right.append(bound)
        cones.append(conic.nonnegative_cone(unknowns))
    cost = np.zeros(unknowns + 1)
    cost[-1] = -1.0
    data.append(np.append(np.zeros(unknowns), 1.0)[None, :])
    right.append(np.array([1.0]))
    cones.append(conic.nonnegative_cone(1))
    solution = conic.solve_conic_program(cost, np.vstack(data), np.concatenate(right), cones)
    answer = np.array(solution.x)
    return answer[:-1] if str(solution.status) in ("Solved", "AlmostSolved") and answer[-1] > 1e-7 else None


def _unknown_columns(seen: _SampledForm, W: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray) -> list[np.ndarray]:
    """The form at a point as the sum of these, times the unknowns."""
    n, size, columns = len(W), len(W) + len(D), []
    for i in range(n):  # L[i, j]: dx_j * (row i of W dx - B dl)
        row = np.concatenate([W[i], -B[i]]) / seen.rows[i]
        for j in range(size):
            Q = np.zeros((size, size))
            Q[j] = row
            columns.append(_stack_triangle((Q + Q.T) / 2))
    for own, unit in zip(seen.blocks, seen.block_size, strict=True):
        Q = np.zeros((size, size))
        Q[[n + i for i in own]] = np.hstack([C, D])[own] / unit
        columns.append(_stack_triangle((Q + Q.T) / 2))
    return columns


def _stack_triangle(S: np.ndarray) -> np.ndarray:
    """Upper triangle by columns, off-diagonal entries times sqrt 2."""
    j, i = np.tril_indices(len(S))
    return np.where(i == j, S[i, j], np.sqrt(2) * S[i, j])
