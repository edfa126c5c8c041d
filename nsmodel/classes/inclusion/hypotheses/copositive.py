"""Is x'Px > 0 on the cone {N x >= 0}: multipliers M >= 0 with P - N'M N - k I psd, found in doubles and verified exactly."""

from __future__ import annotations

from fractions import Fraction
from itertools import combinations_with_replacement

import numpy as np

from nsmodel.proof import conic, exact

MAX_CONE_ROWS, MAX_CONE_STATES = 14, 12
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
    """The largest k with S - k I - sum w_ij basis_ij psd, 0 <= w <= CAP |S|, k <= |S|, by Clarabel."""
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
