"""Is x'Px > 0 on the cone {N x >= 0}: multipliers M >= 0 with P - N'M N - k I psd, found in doubles and verified exactly.

Directions in which a polyhedron C = {N x + h >= 0} is unbounded: {d : N d >= 0}.
"""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from itertools import combinations_with_replacement

import numpy as np

from nsmodel.proof import conic, exact
from nsmodel.proof.convex.sets import ConvexSet

MAX_CONE_ROWS = 14  # Rows of a cone that is decided: the program has a multiplier for each pair of them,
MAX_CONE_STATES = 12  # and states, the size of its matrix; larger cones are left open.
# Largest multiplier of scaled constraints in the semidefinite program: without one they may run away where no margin needs them.
MULTIPLIER_CAP = 1e4


def copositivity_multipliers(P: np.ndarray, N: np.ndarray) -> tuple[float, np.ndarray] | None:
    """Return k > 0 and M (rows, rows) symmetric, >= 0 entrywise, Fractions, with P - k I - N'M N psd; None where none was found.

    Args:
        P: (n, n) Fractions, its symmetric part counts.
        N: (rows, n) Fractions.
    """
    rows, n = N.shape
    if not rows or rows > MAX_CONE_ROWS or n > MAX_CONE_STATES:
        return None
    S = (P + P.T) / 2
    pairs = list(combinations_with_replacement(range(rows), 2))
    basis = [_symmetric_product(N, i, j) for i, j in pairs]
    found = _largest_copositive_margin(exact.doubles(S), [exact.doubles(matrix) for matrix in basis])
    if found is None:
        return None
    k, weights = found
    for part in (1.0, 0.5, 0.1):
        rate = Fraction(k * part)
        total, M = S - rate * exact.eye(n), exact.zeros(rows, rows)
        for (i, j), weight, matrix in zip(pairs, weights, basis, strict=True):
            number = Fraction(max(float(weight), 0.0))
            total = total - number * matrix
            M[i, j] += number / 2
            M[j, i] += number / 2
        if rate > 0 and exact.definiteness(total).psd:
            return float(rate), M
    return None


def _symmetric_product(N: np.ndarray, i: int, j: int) -> np.ndarray:
    """N'(e_i e_j' + e_j e_i')N / 2."""
    outer = N[i][:, None] * N[j][None, :]
    return (outer + outer.T) / 2


def _largest_copositive_margin(S: np.ndarray, basis: list[np.ndarray]) -> tuple[float, np.ndarray] | None:
    """The largest k with S - k I - sum w_ij basis_ij psd, 0 <= w <= MULTIPLIER_CAP |S|, k <= |S|, by Clarabel."""
    n, m = len(S), len(basis)
    size = float(np.abs(S).max()) or 1.0
    scale = [float(np.abs(matrix).max()) or 1.0 for matrix in basis]
    upper = np.triu_indices(n)
    order = np.lexsort((upper[0], upper[1]))  # Clarabel: upper triangle by columns, off-diagonal entries times sqrt 2.
    i, j = upper[0][order], upper[1][order]
    weight = np.where(i == j, 1.0, np.sqrt(2.0))

    def packed(matrix: np.ndarray) -> np.ndarray:
        return matrix[i, j] * weight

    psd = np.column_stack([packed(np.eye(n)), *(packed(matrix / s) for matrix, s in zip(basis, scale, strict=True))])
    A = np.vstack([psd, np.eye(m + 1), -np.eye(m + 1)[1:]])
    b = np.concatenate([packed(S / size), np.ones(1), np.full(m, MULTIPLIER_CAP), np.zeros(m)])
    cones = [conic.semidefinite_cone(n), conic.nonnegative_cone(2 * m + 1)]
    x = np.array(conic.solve_conic_program(np.append(-1.0, np.full(m, 1e-6)), A, b, cones).x)
    if not np.isfinite(x).all() or x[0] <= 1e-7:
        return None
    return float(x[0]) * size * (1 - 1e-6), x[1:] * size / np.array(scale)


# Directions of recession that are tried, of whole numbers and of normal ones each: one that is proved is enough.
RANDOM_DIRECTIONS = 64


def is_recession_direction(C: ConvexSet, d: np.ndarray) -> bool:
    """Whether N d >= 0, exactly, d (n,) of Fractions, not 0."""
    N, _ = C.half_spaces
    return bool(d.any()) and all(number >= 0 for number in exact.matrix_product(N, d[:, None]).ravel())


def recession_directions(C: ConvexSet, more: np.ndarray | None = None) -> Iterator[np.ndarray]:
    """Directions of recession (n,) of Fractions: the axes, the doubles ``more`` (k, n) put into the cone, mixtures of axes."""
    n = C.n
    rng = np.random.default_rng(0)
    given = np.zeros((0, n)) if more is None else np.asarray(more, float).reshape(-1, n)
    random = rng.normal(size=(RANDOM_DIRECTIONS, n))
    axes = np.vstack([np.eye(n), -np.eye(n)])
    for d in np.vstack([axes, given, -given, rng.integers(-2, 3, (RANDOM_DIRECTIONS, n)), random]):
        for candidate in (d, project_on_recession_cone(C, d)):
            exact_d = np.array([Fraction(float(entry)) for entry in candidate], dtype=object)
            if is_recession_direction(C, exact_d):
                yield exact_d
                break


def project_on_recession_cone(C: ConvexSet, d: np.ndarray) -> np.ndarray:
    """The nearest direction of recession in doubles: with only bounds on states, exactly."""
    N = exact.doubles(C.half_spaces[0])
    single = (np.count_nonzero(N, axis=1) == 1).all()
    if single:
        out = d.copy()
        for row in N:
            j = int(np.flatnonzero(row)[0])
            out[j] = max(out[j], 0.0) if row[j] > 0 else min(out[j], 0.0)
        return out
    from scipy.optimize import nnls

    # Moreau: d - P_polar(d), the polar being {-N'm : m >= 0}.
    m, _ = nnls(-N.T, d)
    out = d + N.T @ m
    out[np.abs(out) < 1e-14 * np.abs(d).max(initial=1.0)] = 0.0
    return out
