"""The series of a slip that begins at y = 0, where y/|y| is 0/0.

With y + sigma S l = 0 and l'S l = c (see `sliding`), sigma(0) = 0, order j of both leaves, for l_(j-1) of the slipping and the
held rows and for sigma_j,

    [ tau/j W + sigma_1 S    S l_0 ] [ l_(j-1) ]
    [ (S l_0)'               0     ] [ sigma_j ]  =  known,

which is regular where W is definite. Where |l| grows beyond its bound steadily, sigma_1 = 0 and y ~ s^2 (or a higher power), l_0
is that of stick; where l of stick would be outside at once, as in a turn, sigma_1 > 0, and l_0 solves y_1 + sigma_1 S l_0 = 0.
"""

from __future__ import annotations

import numpy as np

from nsmodel.pieces.multipliers import generalised_inverse
from nsmodel.pieces.sliding import FrictionBlock
from nsmodel.solve.certificate import NumericLaw
from nsmodel.solve.curved import projected_gauss_seidel, semismooth_newton

ONSET_ITERATIONS = 20  # Iterations of l and sigma at the first order.
INSIDE_MARGIN = 1e-6  # Of c: where l'S l is less than c by more, the block does not slip.
NOT_SLIPPING = -1e100  # Sigma_1 of such a block: no rounding.


class SlipOnset:
    """Blocks that begin to slip, with the rows ``active`` that are held through y', at the point that order 0 is."""

    def __init__(
        self, active: tuple[int, ...], blocks: list[FrictionBlock], slopes: tuple[np.ndarray, np.ndarray, np.ndarray], tau: float
    ) -> None:
        B, D, C = slopes
        self.tau, self.held = tau, len(active)
        self.rows = [*active, *(i for block in blocks for i in block.at)]
        _, U, V = generalised_inverse(D[np.ix_(active, active)]) if active else (None, np.zeros((0, 0)), np.zeros((0, 0)))
        self.free = U.shape[1]
        self.U, self.V = (_extend_basis(basis, len(self.rows) - self.held) for basis in (U, V))
        self.W = self.U.T @ (C[self.rows] @ B[:, self.rows]) @ self.V
        self.blocks, self.still, self.at = blocks, list[FrictionBlock](), dict[FrictionBlock, slice]()
        start = self.free
        for block in blocks:
            self.at[block] = slice(start, start + len(block.at))
            start += len(block.at)
        self.sigma = {block: [0.0] * len(block.size) for block in blocks}

    def begin(self, rate: np.ndarray, l: np.ndarray) -> np.ndarray | None:
        """l_0 of the rows, and sigma_1, from y' (all rows) with this l; None: there is none."""
        start = np.concatenate([np.zeros(self.free), l[self.held :]])
        b = self.U.T @ rate - self.W @ start
        ends = np.full(len(b), np.inf)
        law = NumericLaw(-ends, ends, tuple((self.at[block], block.curved) for block in self.blocks if block.curved))
        guess = semismooth_newton(self.W, b, law, start)
        if guess is None and (guess := semismooth_newton(self.W, b, law, projected_gauss_seidel(self.W, b, law, start))) is None:
            return None
        z = guess
        for block in self.blocks:
            S, c = block.quadric
            own = z[self.at[block]]
            if own @ S @ own < c * (1 - INSIDE_MARGIN):
                self.still.append(block)
                self.sigma[block][1] = NOT_SLIPPING
            else:
                self.sigma[block][1] = float(max(-own @ (self.W @ z + b)[self.at[block]] / c, 0.0))
        self.blocks = [block for block in self.blocks if block not in self.still]
        for _ in range(ONSET_ITERATIONS):
            move = self._solve_linear_system(
                z, 1.0, self.W @ z + b + self._slip_terms(z), [self._boundary_excess(z, block) for block in self.blocks]
            )
            z = z + move[: len(z)]
            for block, d in zip(self.blocks, move[len(z) :], strict=True):
                self.sigma[block][1] += float(d)
            if not np.isfinite(z).all():
                return None
            if np.abs(move[: len(z)]).max(initial=0.0) <= 1e-15 * np.abs(z).max(initial=0.0):
                break
        self.first = z
        for block in self.blocks:
            self.sigma[block][1] *= self.tau
            block.size[1] = float(self.sigma[block][1] * np.sqrt(block.quadric[1]))
        for block in self.still:
            block.size[1] = NOT_SLIPPING
        return np.where(np.arange(len(l)) < self.held, l, 0.0) + self.V @ z

    def step(self, k: int, y: np.ndarray) -> np.ndarray:
        """l_k of the rows and sigma_(k+1), from y_(k+1) (all rows) as it is with l_k = 0."""
        z = self.first
        rest, norms = self.U.T @ y, []
        for block in self.blocks:
            S, _ = block.quadric
            sigma, l = self.sigma[block], np.array([row[:k] for row in block.l])
            rest[self.at[block]] += S @ sum((sigma[k + 1 - i] * l[:, i] for i in range(1, k)), np.zeros(len(block.at)))
            norms.append(sum(float(l[:, i] @ S @ l[:, k - i]) for i in range(1, k)) / 2)
        found = self._solve_linear_system(z, self.tau / (k + 1), rest, norms)
        for block, v in zip(self.blocks, found[len(z) :], strict=True):
            self.sigma[block][k + 1] = float(v)
            block.size[k + 1] = float(v * np.sqrt(block.quadric[1]))
        return self.V @ found[: len(z)]

    def _solve_linear_system(self, z: np.ndarray, share: float, rest: np.ndarray, norms: list[float]) -> np.ndarray:
        """The system of order j, share = tau/j."""
        n, count = len(z), len(self.blocks)
        A = np.zeros((n + count, n + count))
        A[:n, :n] = share * self.W
        for j, block in enumerate(self.blocks):
            own, S = self.at[block], block.quadric[0]
            A[own, own] += self.sigma[block][1] * S
            A[own, n + j] = A[n + j, own] = S @ z[own]
        r, c = np.abs(A).max(axis=1), np.abs(A).max(axis=0)
        r, c = (1 / np.sqrt(np.where(size > 0, size, 1)) for size in (r, c))
        scaled = A * r[:, None] * c
        right = -np.concatenate([rest, norms]) * r
        with np.errstate(all="ignore"):
            if not np.isfinite(scaled).all() or not np.isfinite(right).all():
                return np.full(n + count, np.nan)
            return c * np.linalg.lstsq(scaled, right, rcond=1e-13)[0]

    def _slip_terms(self, z: np.ndarray) -> np.ndarray:
        total = np.zeros(len(z))
        for block in self.blocks:
            total[self.at[block]] = self.sigma[block][1] * (block.quadric[0] @ z[self.at[block]])
        return total

    def _boundary_excess(self, z: np.ndarray, block: FrictionBlock) -> float:
        S, c = block.quadric
        return float(z[self.at[block]] @ S @ z[self.at[block]] - c) / 2


def _extend_basis(basis: np.ndarray, more: int) -> np.ndarray:
    """The basis with so many rows and columns of their own."""
    whole = np.zeros((basis.shape[0] + more, basis.shape[1] + more))
    whole[: basis.shape[0], : basis.shape[1]] = basis
    whole[basis.shape[0] :, basis.shape[1] :] = np.eye(more)
    return whole
