"""All P = P' > 0 with P B = C', in coordinates in which they are block diagonal; a well conditioned one of them."""

from __future__ import annotations

from fractions import Fraction
from math import log2
from typing import Any, NamedTuple

import numpy as np

from nsmodel.proof import exact
from nsmodel.proof.exact import MACHINE_EPSILON

MIN_SCALED_EIGENVALUE = 1e-10  # Least eigenvalue of P, scaled to a unit diagonal, that doubles show with some digits.
LARGE_STATE_COUNT = 40  # From this size on the condition number is minimised on a coarser grid.


class Pairing(NamedTuple):
    """All solutions of P B = C', P = P' > 0: P = T^{-T} diag(G, Y) T^{-1} with Y = Y' > 0. Rational entries.

    Attributes:
        T: (n, n), r independent columns of B, then a basis of ker C.
        T_inverse: (n, n).
        G: (r, r), symmetric positive definite.
    """

    T: np.ndarray
    T_inverse: np.ndarray
    G: np.ndarray

    @property
    def free(self) -> int:
        """Size of Y."""
        return len(self.T) - len(self.G)

    def storage_matrix(self, Y: np.ndarray) -> np.ndarray:
        """P (n, n) for a rational Y."""
        return exact.matrix_product(self.T_inverse.T, self.middle(Y), self.T_inverse)

    def middle(self, Y: np.ndarray) -> np.ndarray:
        """diag(G, Y)."""
        r = len(self.G)
        middle = exact.zeros(len(self.T), len(self.T))
        middle[:r, :r], middle[r:, r:] = self.G, Y
        return middle


def make_pairing(B: np.ndarray, C: np.ndarray) -> Pairing:
    """The coordinates for independent columns of B and their rows of C."""
    n, r = B.shape
    G = exact.matrix_product(C, B) if r else exact.zeros(0, 0)
    W = exact.nullspace(C) if r else exact.eye(n)
    left = exact.solve_linear_system(G, C) if r else exact.zeros(0, n)
    if left is None:
        raise ArithmeticError("C B is singular on independent columns of B")
    free = [int(np.flatnonzero(column == 1)[-1]) for column in W.T]  # W has a unit matrix in the free rows
    pivots = _identity_rows(W, free)
    lower = exact.eye(n)[pivots] - exact.matrix_product(B[pivots], left) if r else exact.eye(n)
    return Pairing(np.hstack([B, W]), np.vstack([left, lower]), G)


def _identity_rows(W: np.ndarray, guess: list[int]) -> list[int]:
    """Rows of a null space basis that form its unit matrix."""
    if len(set(guess)) == len(guess) and (W[guess] == exact.eye(W.shape[1])).all():
        return guess
    support = [np.flatnonzero(row) for row in W]
    return [
        next(i for i, nonzero in enumerate(support) if len(nonzero) == 1 and nonzero[0] == k and W[i, k] == 1)
        for k in range(W.shape[1])
    ]


def power_of_two_scales(B: np.ndarray, C: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Powers of two d (n,) and e (m,) for which d B e and e C / d have rows and columns of size about 1."""

    def largest(M: np.ndarray) -> np.ndarray:
        return np.abs(M).max(axis=1, initial=0.0)

    def power(ratio: np.ndarray) -> np.ndarray:
        return 2.0 ** np.round(np.log2(np.where(ratio > 0, ratio, 1.0)))

    def ratio(top: np.ndarray, bottom: np.ndarray) -> np.ndarray:
        """The root of top / bottom; where one of them is 0, what makes the other 1."""
        top, bottom = np.where(top > 0, top, np.where(bottom > 0, 1 / np.where(bottom > 0, bottom, 1), 1.0)), bottom
        bottom = np.where(bottom > 0, bottom, 1 / top)
        return np.sqrt(top) / np.sqrt(bottom)

    d, e = np.ones(len(B)), np.ones(B.shape[1])
    for _ in range(20):
        b, c = largest(B * d[:, None] * e), largest((C * e[:, None] / d).T)
        d_step = power(ratio(c, b))
        b, c = largest((B * (d * d_step)[:, None] * e).T), largest(C * e[:, None] / (d * d_step))
        root_b, root_c = np.sqrt(b), np.sqrt(c)
        both = np.where(root_b * root_c > 0, root_b * root_c, np.maximum(b, c))
        e_step = power(1 / np.where(both > 0, both, 1.0))
        d, e = d * d_step, e * e_step
        if (d_step == 1).all() and (e_step == 1).all():
            break
    return d, e


def pairing_residual(P: np.ndarray, B: np.ndarray, C: np.ndarray) -> float:
    """max |P B - C'| / max |C| of doubles, taken as the rational numbers that they are, rounded up."""
    off = exact.matrix_product(P, B) - exact.rational(C).T
    largest = max((abs(entry) for entry in exact.rational(C).ravel()), default=Fraction(0))
    worst = max((abs(entry) for entry in off.ravel()), default=Fraction(0)) / (largest or 1)
    return float(np.nextafter(float(worst), np.inf)) if worst else 0.0


def matrix_witness(name: str, P: np.ndarray) -> dict[str, Any]:
    """A rational P as a witness: its doubles, and beside them its fractions where they are not the same numbers."""
    near = exact.doubles(P)
    fractions = {} if (exact.rational(near) == P).all() else {f"{name} exactly": [[str(entry) for entry in row] for row in P]}
    return {name: near, **fractions}


def rational_cholesky(P: np.ndarray) -> np.ndarray:
    """L (n, n) in doubles with L L' = P, of a rational P > 0 of which the doubles need not be definite."""
    d = np.array([Fraction(2) ** round((log2(p.numerator) - log2(p.denominator)) / 2) for p in np.diagonal(P)], dtype=object)
    S = P / d[:, None] / d
    try:
        factor = np.linalg.cholesky(exact.doubles(S))
    except np.linalg.LinAlgError:
        factor = _cholesky_by_pivots(S)
    return exact.doubles(d)[:, None] * factor


def _cholesky_by_pivots(S: np.ndarray) -> np.ndarray:
    """The Cholesky factor from exact pivots."""
    S, n = S.copy(), len(S)
    factor = np.zeros((n, n))
    for k in range(n):
        column = S[k:, k] / S[k, k]
        factor[k:, k] = exact.doubles(column) * np.sqrt(float(S[k, k]))
        S[k:, k:] = S[k:, k:] - np.outer(column, S[k, k:])
    return factor


def condition_number(P: np.ndarray) -> float:
    """Condition number of a positive definite matrix, in floating point; inf where doubles cannot tell."""
    spectrum = np.linalg.eigvalsh(P)
    if spectrum[0] <= MACHINE_EPSILON * spectrum[-1]:
        return np.inf
    return float(spectrum[-1] / spectrum[0])


def well_conditioned_block(pairing: Pairing) -> np.ndarray:
    """A rational Y with a condition number of P near the least possible one, if P in doubles is then definite.

    Where states are of very different size that may fail; the condition number is then minimised in balanced units.
    """
    r, n = len(pairing.G), len(pairing.T)
    if r in (0, n):
        return exact.eye(n - r)
    T, inverse, G = (exact.doubles(M) for M in (pairing.T, pairing.T_inverse, pairing.G))
    d, _ = power_of_two_scales(T[:, :r], G @ inverse[:r])
    choices = []
    for scale in (np.ones(n), d):
        for Y in map(exact.rational, _well_conditioned_candidates(T * scale[:, None], inverse / scale, G)):
            if not exact.definiteness(Y).definite:
                continue
            P = exact.doubles(pairing.storage_matrix(Y))
            unit = 1 / np.sqrt(np.diagonal(P))
            choices.append((np.linalg.eigvalsh(P * np.outer(unit, unit))[0], Y))
            if choices[-1][0] > MIN_SCALED_EIGENVALUE:
                return Y
            break
    return max(choices, key=lambda choice: choice[0])[1] if choices else exact.eye(n - r)


def _well_conditioned_candidates(T: np.ndarray, inverse: np.ndarray, G: np.ndarray) -> list[np.ndarray]:
    """Candidates for Y with the best conditioned P first.

    In an orthonormal basis [U, N] of range B and its complement, P = [[a, b'], [b, X]] with a, b given. alpha <= P <= beta
    iff alpha + b (a - alpha)^{-1} b' <= X <= beta - b (beta - a)^{-1} b': for each alpha the least beta is bisected.
    """
    r, n = len(G), len(T)
    Q = np.linalg.qr(T[:, :r], mode="complete")[0]
    U, N = Q[:, :r], Q[:, r:]
    image = inverse[:r].T @ (G @ (inverse[:r] @ U))  # P U
    a, b = _symmetrise(U.T @ image), N.T @ image
    W = T[:, r:].T @ N
    low, high = np.linalg.eigvalsh(a)[[0, -1]]
    if not low > 0:
        return []
    if not b.any():
        return [_symmetrise(W @ W.T) * (np.sqrt(low) * np.sqrt(high))]

    def bounds(position: float) -> tuple[float, np.ndarray, np.ndarray]:
        alpha = low / (1 + np.exp(position))
        floor = alpha * np.eye(n - r) + b @ np.linalg.solve(a - alpha * np.eye(r), b.T)
        beta = _least_upper_scale(floor, a, b, high)
        return beta / alpha, floor, (floor + _upper_bound_matrix(beta, a, b)) / 2

    grid = np.linspace(-6, 8, 9 if n > LARGE_STATE_COUNT else 15)
    tries = [(position, bounds(position)) for position in grid]
    for step in (0.5, 0.25, 0.12) if n <= LARGE_STATE_COUNT else ():
        best = min(tries, key=lambda part: part[1][0])[0]
        tries += [(position, bounds(position)) for position in (best - step, best + step)]
    _, floor, middle = min(tries, key=lambda part: part[1][0])[1]
    rest = b @ np.linalg.solve(a, b.T)  # N'P N where Y = 0
    return [_symmetrise(W @ (X - rest) @ W.T) for X in (middle, floor)]


def _upper_bound_matrix(beta: float, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return beta * np.eye(len(b)) - b @ np.linalg.solve(beta * np.eye(len(a)) - a, b.T)


def _least_upper_scale(floor: np.ndarray, a: np.ndarray, b: np.ndarray, high: float) -> float:
    """The least beta with floor <= ceiling(beta), within two hundredths."""
    above = max(high, np.linalg.eigvalsh(floor)[-1]) * (1 + 1e-6)
    below = above
    while np.linalg.eigvalsh(_upper_bound_matrix(above, a, b) - floor)[0] < 0:
        below, above = above, 2 * above
    while above > 1.02 * below:
        middle = np.sqrt(above * below)
        if np.linalg.eigvalsh(_upper_bound_matrix(middle, a, b) - floor)[0] < 0:
            below = middle
        else:
            above = middle
    return float(above)


def _symmetrise(M: np.ndarray) -> np.ndarray:
    return (M + M.T) / 2
