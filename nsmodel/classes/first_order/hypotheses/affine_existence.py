"""Whether a step of an affine system with numbers exists from every state, and never two: exact linear programs."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from itertools import product

import numpy as np

from nsmodel.classes.first_order.hypotheses.affine_step import SIGN_MARGIN, AffineStep, solve_affine_index_set
from nsmodel.proof import conic, exact

MAX_SET_PAIRS = 800  # Pairs of index sets, times states, that are all decided.


@dataclass(frozen=True)
class InfeasibleState:
    """From the state x (n, 1) no step exists: v'y < 0 for all l in K, while a solution has v'y >= 0."""

    x: np.ndarray
    v: np.ndarray


def decide_solvability(step: AffineStep) -> InfeasibleState | bool | None:
    """Whether every state has some l in K with y in (K_inf)*; for a psd W that is a solution, as K is a polyhedron.

    If not, some v in K_inf with W'v in -(K_inf)* has v'y <= sup_K v'W l + v'b_0 + v'N x < 0, while v'y >= 0 is asked for. Where
    N'v = 0 for all such v, all states have one or none has. None: undecided.
    """
    m = len(step.W)
    conditions = _recession_rows(step)
    positive = [k for k, (_, strict) in enumerate(conditions) if strict]
    A = np.hstack([np.array([row for row, _ in conditions], dtype=object), exact.zeros(len(conditions), len(positive))])
    for place, k in enumerate(positive):
        A[k, m + place] = Fraction(-1)
    zero = conic.implied_zeros(conic.ConicSystem(A, tuple(range(m, A.shape[1]))))
    left = [j for j in range(A.shape[1]) if j not in zero]
    inner = conic.decide_feasibility(conic.ConicSystem(A[:, left], tuple(range(m, len(left))))).point
    if inner is None:
        return None
    span = exact.nullspace(A[:, left])
    slopes = exact.matrix_product(step.N.T, span[:m])
    if not slopes.any():
        b = step.b(exact.zeros(step.N.shape[1], 1))
        return True if any(solve_affine_index_set(step, b, index).sign > 0 for index in step.sets) else None
    if not exact.matrix_product(step.N.T, inner[:m, None]).any():
        away = span[:, np.flatnonzero(slopes.any(axis=0))[0]]
        small = min((abs(inner[j] / away[j]) for j in range(m, len(left)) if away[j]), default=Fraction(1)) / 2
        inner = inner + small * away
    return _infeasible_state(step, inner[:m, None])


def _recession_rows(step: AffineStep) -> list[tuple[np.ndarray, bool]]:
    """Rows a with a v >= 0 (True) or a v = 0 for v in K_inf with W'v in -(K_inf)*."""
    rows, units = [], exact.eye(len(step.W))
    for unit, column, low, up in zip(units, step.W.T, np.isfinite(step.lower), np.isfinite(step.upper), strict=True):
        if low and up:
            rows.append((unit, False))
        elif low or up:
            rows += [(unit, True), (-column, True)] if low else [(-unit, True), (column, True)]
        else:
            rows.append((column, False))
    return rows


def _infeasible_state(step: AffineStep, v: np.ndarray) -> InfeasibleState | None:
    """A state from which v'y < 0 for all l in K, beyond rounding of W."""
    image, size = exact.matrix_product(step.W.T, v), step.size.T @ np.abs(exact.doubles(v))
    if any(entry and abs(float(entry)) <= SIGN_MARGIN * terms for entry, terms in zip(image.ravel(), size.ravel(), strict=True)):
        return None
    top = exact.matrix_product(v.T, step.b_0)[0, 0]
    for entry, low, up in zip(image.ravel(), step.lower, step.upper, strict=True):
        top += entry * Fraction(float(up if entry > 0 else low)) if entry else 0
    slope = exact.matrix_product(step.N.T, v)
    reach = 2 * (abs(top) + sum(abs(entry) for entry in slope.ravel())) / exact.matrix_product(slope.T, slope)[0, 0]
    x = exact.rational(exact.doubles(-reach * slope))
    return InfeasibleState(x, v) if top + exact.matrix_product(slope.T, x)[0, 0] < 0 else None


def is_solution_unique(step: AffineStep) -> bool:
    """Whether no state has two solutions with different x, by exact linear programs on all pairs of index sets."""
    if not step.is_exact or len(step.sets) ** 2 * len(step.X_l) > MAX_SET_PAIRS:
        return False
    return all(_gives_same_state(step, pair, row) for pair in product(step.sets, repeat=2) for row in step.X_l if row.any())


def _gives_same_state(step: AffineStep, pair: tuple[np.ndarray, ...], row: np.ndarray) -> bool:
    """Whether row (l - l') > 0 for no l, l' of these index sets and one x_k; homogeneous in (tau, x_k, l, l')."""
    m, n = step.N.shape
    places = [range(1 + n, 1 + n + m), range(1 + n + m, 1 + n + 2 * m)]
    columns, total, rows = [0], 1 + n + 2 * m, []

    def equation(entries: dict[int, Fraction], slack: int) -> None:
        rows.append((entries, slack))

    for index, l in zip(pair, places, strict=True):
        for i, code in enumerate(index):
            y = {l[j]: step.W[i, j] for j in range(m)}
            y |= {1 + j: step.N[i, j] for j in range(n)} | {0: step.b_0[i, 0]}
            ends = {sign: Fraction(float(end)) for sign, end in ((1, step.lower[i]), (-1, step.upper[i])) if np.isfinite(end)}
            if code == 0:
                equation(y, 0)
                for sign, end in ends.items():
                    equation({l[i]: Fraction(sign), 0: -sign * end}, 1)
            else:
                equation({l[i]: Fraction(1), 0: -ends[-int(code)]}, 0)
                if step.lower[i] < step.upper[i]:
                    equation({place: -int(code) * entry for place, entry in y.items()}, 1)
    difference = {
        place: sign * entry for l, sign in zip(places, (1, -1), strict=True) for place, entry in zip(l, row, strict=True)
    }
    equation(difference, 1)
    A = exact.zeros(len(rows), total + sum(slack for _, slack in rows))
    for k, (entries, slack) in enumerate(rows):
        for place, entry in entries.items():
            A[k, place] += entry
        if slack:
            A[k, total] = Fraction(-1)
            columns.append(total)
            total += 1
    return columns[-1] in conic.implied_zeros(conic.ConicSystem(A, tuple(columns)))
