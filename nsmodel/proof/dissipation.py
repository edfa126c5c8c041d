"""The least omega with P J + J'P <= 2 omega P for all J of a set, among the P with P B = C' (Assumption 5.2), proved.

In the coordinates of `Pairing`, P = diag(G, Y). Candidates for Y come from floating
point; each is taken as the rational numbers that its doubles are, and its omega is rounded up until it is proved exactly.

The semidefinite program behind the least omega: P = diag(I, Y) with 2 omega P - P J - J'P >= 0 in balanced coordinates.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from itertools import combinations_with_replacement, pairwise
from typing import NamedTuple

import numpy as np

from nsmodel.proof import conic, exact
from nsmodel.proof.exact import MACHINE_EPSILON
from nsmodel.proof.storage_matrix import Pairing, well_conditioned_block

MAX_STORAGE_SPREAD = 1e3  # 1/SPREAD <= Y <= SPREAD: a smaller omega would cost a worse conditioned P.
# Of balanced numbers, which are about 1: smaller ones are the solver's error. What is chosen by it is proved exactly.
RANK_TOLERANCE = 1e-9


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
        """The number of rows of the free block Y."""
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
        """The block Y in balanced coordinates."""
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


def search_omega(near: BalancedCoordinates, least: float) -> np.ndarray:
    """Return the Y_hat of the least omega, by bisection between what no Y can beat and the best one so far."""
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
    return best


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


# Up to this many states the semidefinite program is solved, 9 s for 20; above, a few candidates for Y are compared.
MAX_SDP_STATES = 20
# omega / |J| below which omega = 0 is tried, which counts where it is proved exactly: so small a rate may be rounding.
ZERO_RATE_TOLERANCE = 1e-9


class ProvedRate(NamedTuple):
    """A proved bound.

    Attributes:
        omega: P J + J'P <= 2 omega P, proved in rational arithmetic.
        Y: rational, of the P that it belongs to.
        least: no P gives less than this (floating point).
        rounding: what omega is 0 up to, by rounding of J.
        accuracy: what omega is 0 up to, by the accuracy of the semidefinite program.
    """

    omega: float
    Y: np.ndarray
    least: float
    rounding: float
    accuracy: float


class _RateProblem(NamedTuple):
    """The matrices J and directions K in the pairing's coordinates, rational and in balanced doubles."""

    pairing: Pairing
    J: list[np.ndarray]
    K: list[np.ndarray]
    near: BalancedCoordinates


def least_rate(
    pairing: Pairing, vertices: Sequence[np.ndarray], cones: Sequence[np.ndarray] = (), *, quick: bool = False
) -> ProvedRate | None:
    """Return the least omega found, proved; None where none is found, which only ``cones`` can cause.

    Args:
        pairing: the P allowed.
        vertices: matrices J (n, n) of doubles; what holds for them holds for their convex hull.
        cones: matrices K (n, n) with P K + K'P <= 0 wanted: directions in which the set is unbounded.
        quick: only closed-form candidates for Y, no semidefinite program.
    """
    J, K = ([exact.matrix_product(pairing.T_inverse, M, pairing.T) for M in matrices] for matrices in (vertices, cones))
    plain = well_conditioned_block(pairing)
    sizes = exact.doubles(pairing.G), exact.doubles(plain)
    near = balance_coordinates(*sizes, [exact.doubles(M) for M in J], [exact.doubles(M) for M in K])
    problem, least = _RateProblem(pairing, J, K, near), omega_lower_bound(near)
    candidates = [plain, exact.rational(near.from_hat(np.eye(pairing.free))), *_energy_candidates(problem)]
    best = _best_proved_rate(problem, candidates, least)
    if quick or not pairing.free or len(pairing.T) > MAX_SDP_STATES:
        return best
    for more in (_lossless_candidates, _sdp_candidates):
        if best is None or best.omega > least + max(best.rounding, ZERO_RATE_TOLERANCE * near.scale):
            best = _best_proved_rate(problem, more(problem), least, best)
    return best


def _best_proved_rate(
    problem: _RateProblem, candidates: Iterable[np.ndarray], least: float, best: ProvedRate | None = None
) -> ProvedRate | None:
    """The least proved rate; the rest of the candidates is left out where one is 0 up to rounding."""
    for Y in candidates:
        rate = _proved_rate(problem, Y, least)
        if rate is not None and (best is None or rate.omega < best.omega - rate.rounding or rate.omega <= 0 < best.omega):
            best = rate
        if best is not None and -best.rounding <= best.omega <= 0 and least > -best.rounding:
            break
    return best


def _is_rate_valid(problem: _RateProblem, Y: np.ndarray, omega: float) -> bool:
    """Whether omega P - P J is psd for all J (its symmetric part is meant): exactly."""
    P = problem.pairing.middle(Y)
    return all(exact.is_psd(exact.matrix_product(P, exact.scalar_minus(omega, J))) for J in problem.J)


def _is_dissipative_on_cones(problem: _RateProblem, Y: np.ndarray) -> bool:
    """Whether P K + K'P <= 0 for all K: exactly."""
    P = problem.pairing.middle(Y)
    return all(exact.is_psd(-exact.matrix_product(P, K)) for K in problem.K)


def _proved_rate(problem: _RateProblem, Y: np.ndarray, least: float) -> ProvedRate | None:
    """The omega of Y, rounded up until it is proved; 0 where the floating-point value is about 0 and that is proved."""
    near = problem.near
    if not exact.definiteness(Y).definite or not _is_dissipative_on_cones(problem, Y):
        return None
    P = near.middle(near.to_hat(exact.doubles(Y)))
    omega = max(growth_rate(P, J) for J in near.J)
    if not np.isfinite(omega):
        return None
    rounding = 64 * MACHINE_EPSILON * len(P) * near.scale
    tries = [omega + lift * near.scale for lift in (8 * MACHINE_EPSILON, 64 * MACHINE_EPSILON, 1e-12, 1e-9, 1e-7, 1e-5, 1e-3)]
    plain = 0.0 if -rounding <= omega <= ZERO_RATE_TOLERANCE * near.scale else float(f"{omega:.9g}")
    tries = [plain, *tries] if abs(plain - omega) <= ZERO_RATE_TOLERANCE * near.scale else tries
    for above in tries:
        if _is_rate_valid(problem, Y, above):
            return ProvedRate(float(above), Y, least, rounding, 10 * ZERO_RATE_TOLERANCE * near.scale)
    return None


def _energy_candidates(problem: _RateProblem) -> list[np.ndarray]:
    """Y for which the coupling of the two blocks is skew, G J12 + J21'Y = 0: the energy of a mechanical system or circuit."""
    G, J = problem.pairing.G, problem.J[0]
    r = len(G)
    Y = exact.solve_linear_system(J[r:, :r].T, -exact.matrix_product(G, J[:r, r:])) if r and problem.pairing.free else None
    return [Y if exact.is_symmetric(Y) else (Y + Y.T) / 2] if Y is not None else []


def _sdp_candidates(problem: _RateProblem) -> Iterator[np.ndarray]:
    """The answer of the semidefinite program, and the same without the entries that are 0 up to its accuracy."""
    Y = search_omega(problem.near, omega_lower_bound(problem.near))
    d = np.sqrt(np.abs(np.diagonal(Y)))
    for kept in (np.where(np.abs(Y) > 1e-6 * np.outer(d, d), Y, 0.0), Y):
        yield exact.rational(problem.near.from_hat(kept))


def _lossless_candidates(problem: _RateProblem) -> Iterator[np.ndarray]:
    """Y with omega = 0: (P J + J'P) v = 0 is imposed exactly, if it can be, on the v for which any such P has it.

    Those are looked for among the coordinates, and the zero dynamics that neither grow nor decay; then among the directions
    for which the semidefinite program finds no slack.
    """
    near, pairing = problem.near, problem.pairing
    neutral = [_neutral_basis(problem, J) for J in problem.J]
    exactly = np.hstack([*neutral, exact.eye(len(pairing.T)), pairing.T_inverse])
    nearly = near.left @ exact.doubles(exactly)
    nearly = nearly / np.linalg.norm(nearly, axis=0)
    ends = np.cumsum([0, *(basis.shape[1] for basis in neutral)])
    chosen = forced_kernels(near, list(nearly.T), [range(a, b) for a, b in pairwise(ends)])
    if chosen is None:
        return
    kernels, back = [exactly[:, own] for own in chosen], exact.doubles(pairing.T) @ near.back
    for accuracy in (1e-6, 1e-5, 1e-4, 1e-3):
        answer = solve_sdp(near, 0.0, [near.left @ exact.doubles(N) for N in kernels])
        if answer is None:
            return
        Y = exact.rational(near.from_hat(answer))
        yield _add_upper_triangle(Y, _solve_exact_or_least_squares(*_kernel_equations(problem, kernels, Y)))
        for k, J in enumerate(near.J):
            size, vectors = np.linalg.eigh(near.slack(answer, J, 0.0))
            span = back @ vectors[:, size < accuracy * max(1.0, size[-1])]
            kernels[k] = exact.matrix_product(pairing.T_inverse, _simple_rational_basis(span, np.abs(back).max(axis=1)))


def _neutral_basis(problem: _RateProblem, J: np.ndarray) -> np.ndarray:
    """A basis, in the pairing's coordinates, of the zero dynamics with imaginary eigenvalues."""
    r, near = len(problem.pairing.G), problem.near
    hat = near.left[r:, r:] @ exact.doubles(J[r:, r:]) @ near.back[r:, r:]
    values, vectors = np.linalg.eig(hat)
    still = vectors[:, np.abs(np.real(values)) <= ZERO_RATE_TOLERANCE * near.scale]
    U, sizes, _ = np.linalg.svd(np.hstack([np.real(still), np.imag(still)])) if still.size else (hat[:, :0], np.zeros(0), None)
    U = U[:, : int((sizes > 1e-6).sum())]
    basis = exact.zeros(len(J), U.shape[1])
    basis[r:] = _simple_rational_basis(near.back[r:, r:] @ U, np.abs(near.back[r:, r:]).max(axis=1))
    return basis


def _solve_exact_or_least_squares(rows: np.ndarray, right: np.ndarray) -> np.ndarray:
    """A solution, exact where there is one; J may have been rounded, then least squares."""
    change = exact.solve_linear_system(rows, right)
    if change is None:
        near, right = exact.doubles(rows), exact.doubles(right)
        weight = np.abs(near).max(axis=0)
        weight[weight == 0] = 1.0
        change = exact.rational(np.linalg.lstsq(near / weight, right, rcond=1e-12)[0] / weight[:, None])
    return change


def _add_upper_triangle(Y: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Y with the change of its upper triangle, symmetric."""
    Y = Y.copy()
    for (i, j), entry in zip(combinations_with_replacement(range(len(Y)), 2), change.ravel(), strict=True):
        Y[i, j] += entry
        Y[j, i] = Y[i, j]
    return Y


def _kernel_equations(problem: _RateProblem, kernels: Sequence[np.ndarray], Y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and right-hand side of (P J + J'P) N = 0 in the change of the upper triangle of Y."""
    pairing = problem.pairing

    def image(P: np.ndarray) -> np.ndarray:
        parts = [
            exact.matrix_product(exact.matrix_product(P, J) + exact.matrix_product(P, J).T, N)
            for J, N in zip(problem.J, kernels, strict=True)
        ]
        return np.concatenate([part.ravel() for part in parts])

    def change(i: int, j: int) -> np.ndarray:
        P = exact.zeros(len(pairing.T), len(pairing.T))
        r = len(pairing.G)
        P[r + i, r + j] = P[r + j, r + i] = Fraction(1)
        return image(P)

    pairs = combinations_with_replacement(range(pairing.free), 2)
    return np.column_stack([change(i, j) for i, j in pairs]), -image(pairing.middle(Y))[:, None]


def _simple_rational_basis(span: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """A rational basis of the span of columns, in reduced form, of small denominators where those are near."""
    from scipy.linalg import qr

    k = span.shape[1]
    if not k:
        return exact.zeros(len(span), 0)
    pivots = np.asarray(qr((span / sizes[:, None]).T, mode="r", pivoting=True)[-1])[:k]
    basis = span @ np.linalg.inv(span[pivots])
    result = exact.rational(basis)
    for index, entry in np.ndenumerate(basis):
        size = sizes[index[0]] / sizes[pivots[index[1]]]
        near = Fraction(entry).limit_denominator(1000)
        if abs(float(near) - entry) <= 1e-5 * size:
            result[index] = near
    return result
