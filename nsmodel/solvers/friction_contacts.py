"""Contacts with Coulomb friction in y = W l + b: on given modes, as a complementarity problem in the plane, by all modes.

The modes of a contact are its codes: -1 open (l = 0), 0 stick (y = 0), +1 slip (y_N = 0, P_T = -mu P_N y_T/|y_T|). With the
direction of slip given, a choice of modes is one linear system.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np

from nsmodel.modeling.laws import CoulombSet
from nsmodel.solvers.active_set import lemke, solve_or_least_squares
from nsmodel.solvers.residuals import NumericLaw

MAX_MODES = 5000  # Choices of modes that are tried one by one: 4^6, those of six contacts.


def solve_on_modes(W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray, y: np.ndarray, code: np.ndarray) -> np.ndarray:
    """The l with these codes, directions of slip and what else is curved as (l, y) have them; of least norm if W is singular."""
    fixed = np.where(code < 0, np.where(np.isfinite(law.lower), law.lower, 0.0), l)
    fixed = np.where((code > 0) & np.isfinite(law.upper), law.upper, fixed)
    basis = np.eye(law.size)
    rows = code == 0
    for own, K in law.curved:
        if code[own][0] != 1:
            continue
        ray = K.boundary_ray(l[own], y[own])
        if ray is None:
            fixed[own] = K.onto_boundary(l[own])
        else:
            fixed[own], rows[own.start], basis[own, own.start] = 0.0, True, ray
    fixed[rows] = 0.0
    if not rows.any():
        return fixed
    basis = basis[:, rows]
    return fixed + basis @ solve_or_least_squares(W[rows] @ basis, -(b + W @ fixed)[rows])


def associated_law(law: NumericLaw) -> NumericLaw:
    """The law without ŷ: of a psd W a convex problem, which all that can stick solves by y = 0."""
    sets = tuple((rows, replace(K, shifts=False) if isinstance(K, CoulombSet) else K) for rows, K in law.curved)
    return NumericLaw(law.lower, law.upper, sets)


def is_in_the_plane(law: NumericLaw) -> bool:
    """Whether all curved blocks are contacts with one slip row."""
    return all(isinstance(K, CoulombSet) and rows.stop - rows.start == 2 for rows, K in law.curved)


def mode_count(law: NumericLaw) -> float:
    """How many choices of modes contacts in the plane and rows of a box have, slip either way."""
    rows = np.isfinite(law.lower).astype(float) + np.isfinite(law.upper) + 1
    for own, _ in law.curved:
        rows[own], rows[own.start] = 1.0, 4.0
    return float(rows.prod())


def solve_by_lemke(W: np.ndarray, b: np.ndarray, law: NumericLaw) -> np.ndarray | None:
    """The law of contacts in the plane as a complementarity problem, by Lemke's method (Stewart and Trinkle, IJNME 39, 1996).

    P_T = b+ - b-, and 0 <= (P_N, b+, b-, s) ⟂ (y_N, s + y_T, s - y_T, mu P_N - b+ - b-) >= 0; s is |y_T| where it slips.
    """
    basis, added = [], []
    lower, upper = [], []
    contacts = {rows.start: K for rows, K in law.curved if isinstance(K, CoulombSet)}
    i = 0
    while i < law.size:
        unit = np.eye(law.size)
        if i in contacts:
            first = len(basis)
            basis += [unit[i], unit[i + 1], -unit[i + 1], np.zeros(law.size)]
            added += [(first + 1, first + 3, 1.0), (first + 2, first + 3, 1.0), (first + 3, first, contacts[i].mu)]
            added += [(first + 3, first + 1, -1.0), (first + 3, first + 2, -1.0)]
            lower, upper, i = [*lower, *[0.0] * 4], [*upper, *[np.inf] * 4], i + 2
        else:
            basis.append(unit[i])
            lower, upper, i = [*lower, law.lower[i]], [*upper, law.upper[i]], i + 1
    B = np.array(basis).T
    M = B.T @ W @ B
    for row, column, value in added:
        M[row, column] += value
    z = lemke(M, B.T @ b, NumericLaw(np.array(lower), np.array(upper), ()))
    return None if z is None else B @ z


def solutions_on_all_modes(W: np.ndarray, b: np.ndarray, law: NumericLaw) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(l, codes) on each choice of modes of contacts in the plane, slip either way; nothing where there are too many.

    The first rows change first: of a contact stick, open, slip along +1 and -1, of a row of a box y = 0, then its ends.
    """
    if mode_count(law) > MAX_MODES:
        return
    contacts = {rows.start for rows, _ in law.curved}
    second = {start + 1 for start in contacts}
    choices: list[list[tuple[int, float]]] = []  # (code, y_T) of a contact, (code, 0) of a row of a box
    own = [i for i in range(law.size) if i not in second]
    for i in own:
        ends = [(code, 0.0) for code, end in ((-1, law.lower[i]), (1, law.upper[i])) if np.isfinite(end)]
        choices.append([(0, 0.0), (-1, 0.0), (1, 1.0), (1, -1.0)] if i in contacts else [(0, 0.0), *ends])
    zero, y, code = np.zeros(law.size), np.zeros(law.size), np.zeros(law.size, np.int8)
    for choice in product(*reversed(choices)):
        for i, (mode, slip) in zip(own, reversed(choice), strict=True):
            code[i] = mode
            if i in contacts:
                code[i + 1], y[i + 1] = mode, slip
        l = solve_on_modes(W, b, law, zero, y, code)
        if np.isfinite(l).all():
            yield l, code.copy()
