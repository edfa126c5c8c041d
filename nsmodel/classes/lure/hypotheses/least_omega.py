"""The semidefinite program behind the least omega: P = diag(I, Y) with 2 omega P - P J - J'P >= 0 in balanced coordinates."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement

import numpy as np

from nsmodel.proof import conic

MAX_STORAGE_SPREAD = 1e3  # 1/SPREAD <= Y <= SPREAD: a smaller omega would cost a worse conditioned P.
RANK_TOLERANCE = 1e-9  # of balanced numbers, which are about 1


@dataclass(frozen=True)
class BalancedCoordinates:
    """Coordinates z_hat = left z, z = back z_hat, in which G = I and J has rows and columns of like size.

    Attributes:
        J: matrices (n, n).
        cones: directions K of recession (n, n), for which P K + K'P <= 0.
        left, back: (n, n), block diagonal.
        r: size of G.
    """

    J: list[np.ndarray]
    cones: list[np.ndarray]
    left: np.ndarray
    back: np.ndarray
    r: int

    @cached_property
    def scale(self) -> float:
        """The largest |J|_2."""
        return max((float(np.linalg.norm(J, 2)) for J in self.J), default=0.0) or 1.0

    @property
    def free(self) -> int:
        """Size of Y."""
        return len(self.left) - self.r

    def middle(self, Y: np.ndarray) -> np.ndarray:
        """diag(I, Y_hat)."""
        P = np.eye(len(self.left))
        P[self.r :, self.r :] = Y
        return P

    def slack(self, Y: np.ndarray, J: np.ndarray, omega: float) -> np.ndarray:
        """(2 omega P - P J - J'P) / |J|, affine in Y."""
        P = self.middle(Y)
        return (2 * omega * P - P @ J - J.T @ P) / self.scale

    def to_hat(self, Y: np.ndarray) -> np.ndarray:
        """Y_hat of Y."""
        back = self.back[self.r :, self.r :]
        return back.T @ Y @ back

    def from_hat(self, Y: np.ndarray) -> np.ndarray:
        """Y of Y_hat, symmetric to the last bit."""
        left = self.left[self.r :, self.r :]
        Y = left.T @ Y @ left
        return (Y + Y.T) / 2


def balance_coordinates(
    G: np.ndarray, Y: np.ndarray, J: Sequence[np.ndarray], cones: Sequence[np.ndarray]
) -> BalancedCoordinates:
    """Return the coordinates for G (r, r) and matrices (n, n) of doubles; units of the last n - r are powers of two.

    Where nothing couples such a coordinate to the others, its unit is that of Y.
    """
    r, n = len(G), len(J[0])
    left = np.eye(n)
    if r:
        d = np.sqrt(np.diagonal(G))
        left[:r, :r] = np.linalg.cholesky(G / np.outer(d, d)).T * d
    back = np.linalg.inv(left)
    size = np.max([np.abs(left @ matrix @ back) for matrix in [*J, *cones]], axis=0)
    units = np.ones(n)
    units[r:] = 2.0 ** np.round(-np.log2(np.diagonal(Y)) / 2)
    for _ in range(30):
        before = units.copy()
        for j in range(r, n):
            row, column = size[j] * units, size[:, j] / units
            row[j] = column[j] = 0.0
            if row.max() > 0 and column.max() > 0:
                units[j] = 2.0 ** np.round(np.log2(row.max() / column.max()) / 2)
        if (before == units).all():
            break
    left, back = left / units[:, None], back * units
    return BalancedCoordinates([left @ matrix @ back for matrix in J], [left @ matrix @ back for matrix in cones], left, back, r)


def growth_rate(P: np.ndarray, J: np.ndarray) -> float:
    """Largest eigenvalue of sym(R J R^{-1}), R^2 = P; inf where P is not positive definite in doubles."""
    try:
        L = np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        return np.inf
    M = L.T @ np.linalg.solve(L, J.T).T  # R J R^{-1} up to a rotation
    return float(np.linalg.eigvalsh((M + M.T) / 2)[-1])


def omega_lower_bound(near: BalancedCoordinates) -> float:
    """What no Y can beat: the block of G, and the growth of the zero dynamics (where y stays 0)."""
    r, bounds = near.r, []
    for J in near.J:
        first, rest = J[:r, :r], J[r:, r:]
        bounds += [np.linalg.eigvalsh((first + first.T) / 2)[-1]] if r else []
        bounds += [np.linalg.eigvals(rest).real.max()] if len(rest) else []
    return float(max(bounds))


def search_omega(near: BalancedCoordinates, least: float) -> tuple[float, np.ndarray]:
    """Return the least omega and its Y_hat, by bisection between what no Y can beat and the best one so far."""
    best, count = np.eye(near.free), 24 if len(near.left) <= 8 else 14 if len(near.left) <= 14 else 9
    omega = min(max(growth_rate(near.middle(best), J) for J in near.J), MAX_STORAGE_SPREAD * near.scale)
    low = least
    for k in range(count):
        if omega - low <= 1e-8 * near.scale:
            break
        middle = low if k == 0 else (low + omega) / 2
        answer = solve_sdp(near, middle + 1e-9 * near.scale)
        value = np.inf if answer is None else max(growth_rate(near.middle(answer), J) for J in near.J)
        if answer is not None and value < omega:
            omega, best = value, answer
        if value > middle + 1e-8 * near.scale:
            low = max(low, middle)
    return omega, best


def solve_sdp(near: BalancedCoordinates, omega: float, kernels: Sequence[np.ndarray] | None = None) -> np.ndarray | None:
    """Return the Y_hat that maximises t <= 1 with slack(Y, J, omega) >= t for each J.

    With ``kernels``, one basis (n, k) for each J: slack(Y, J, omega) v = 0 on them, and >= t on their complements.
    """
    s, n = near.free, len(near.left)
    parts, zero = symmetric_units(s), np.zeros((s, s))
    blocks, offsets, cones = [], [], []
    held = [np.zeros((n, 0))] * len(near.J) if kernels is None else list(kernels)
    for k, (J, rate_of) in enumerate([*((J, omega) for J in near.J), *((K, 0.0) for K in near.cones)]):
        constant = near.slack(zero, J, rate_of)
        columns = [near.slack(part, J, rate_of) - constant for part in parts]
        level, Q = np.zeros((n, n)), np.eye(n)
        if k < len(held):
            N = held[k]
            Q = np.linalg.svd(N, full_matrices=True)[0][:, np.linalg.matrix_rank(N) :] if N.size else Q
            level = np.eye(n)
            if N.size:
                rows = np.array([(column @ N).ravel() for column in columns]).T
                left, sizes, right = np.linalg.svd(rows, full_matrices=False)
                rank = int((sizes > RANK_TOLERANCE).sum())  # dependent equations would trouble the solver
                blocks.append(np.column_stack([np.zeros(rank), sizes[:rank, None] * right[:rank]]))
                offsets.append(-left[:, :rank].T @ (constant @ N).ravel())
                cones.append(conic.zero_cone(rank))
        blocks.append(
            np.column_stack(
                [_stack_upper_triangle(Q.T @ level @ Q), *(-_stack_upper_triangle(Q.T @ column @ Q) for column in columns)]
            )
        )
        offsets.append(_stack_upper_triangle(Q.T @ constant @ Q))
        cones.append(conic.semidefinite_cone(Q.shape[1]))
    for sign, constant in ((1, -np.eye(s) / MAX_STORAGE_SPREAD), (-1, np.eye(s) * MAX_STORAGE_SPREAD)):
        blocks.append(
            np.column_stack([0 * _stack_upper_triangle(zero), *(-sign * _stack_upper_triangle(part) for part in parts)])
        )
        offsets.append(_stack_upper_triangle(constant))
        cones.append(conic.semidefinite_cone(s))
    blocks.append(np.eye(1, 1 + len(parts)))
    offsets.append(np.array([1.0]))
    cones.append(conic.nonnegative_cone(1))
    solution = conic.solve_conic_program(-np.eye(1, 1 + len(parts))[0], np.vstack(blocks), np.concatenate(offsets), cones)
    if str(solution.status) not in ("Solved", "AlmostSolved"):
        return None
    return np.tensordot(solution.x[1:], parts, 1)


def forced_kernels(
    near: BalancedCoordinates, candidates: Sequence[np.ndarray], certain: Sequence[Collection[int]]
) -> list[list[int]] | None:
    """Return for each J the candidates v (n,) on which slack(Y, J, 0) v = 0 follows from slack(Y, J, 0) >= 0.

    That is so for the indices ``sure``, and where v'slack v = 0 for all Y that are left; then fewer Y are left. None where
    none are.
    """
    s = near.free
    parts, zero = symmetric_units(s), np.zeros((s, s))
    constants = [near.slack(zero, J, 0.0) for J in near.J]
    changes = [np.array([near.slack(part, J, 0.0) for part in parts]) - c for J, c in zip(near.J, constants, strict=True)]
    y, N = np.zeros(len(parts)), np.eye(len(parts))
    chosen: list[list[int]] = [[] for _ in near.J]
    fresh = True
    while fresh:
        fresh = False
        for own, constant, change, known in zip(chosen, constants, changes, certain, strict=True):
            for k in sorted(set(range(len(candidates))) - set(own)):
                v = candidates[k]
                form, size = change @ v @ v, 1 + np.abs(y).max(initial=0.0)
                varies = (
                    np.abs(form @ N).max(initial=0.0) > RANK_TOLERANCE or abs(v @ constant @ v + form @ y) > RANK_TOLERANCE * size
                )
                if varies and k not in known:
                    continue
                rows, right = (change @ v).T, -(constant @ v)
                step, *_ = np.linalg.lstsq(rows @ N, right - rows @ y, rcond=RANK_TOLERANCE)
                y = y + N @ step
                if np.abs(rows @ y - right).max() > 1e3 * RANK_TOLERANCE * size:
                    return None
                sizes, V = np.linalg.svd(rows @ N, full_matrices=True)[1:]
                N = N @ V[int((sizes > RANK_TOLERANCE).sum()) :].T
                own.append(k)
                fresh = True
    return chosen


def symmetric_units(s: int) -> np.ndarray:
    """Symmetric matrices (p, s, s) with a 1 in (i, j) and (j, i), i <= j."""
    return np.array([symmetric_unit(s, i, j) for i, j in combinations_with_replacement(range(s), 2)]).reshape(-1, s, s)


def symmetric_unit(s: int, i: int, j: int) -> np.ndarray:
    """The symmetric matrix with a 1 in (i, j) and (j, i)."""
    matrix = np.zeros((s, s))
    matrix[i, j] = matrix[j, i] = 1.0
    return matrix


def _stack_upper_triangle(S: np.ndarray) -> np.ndarray:
    """Upper triangle by columns, off-diagonal entries times sqrt 2."""
    weighted = np.sqrt(2) * S - (np.sqrt(2) - 1) * np.diag(np.diagonal(S))
    j, i = np.tril_indices(len(S))
    return weighted[i, j]
