"""The least omega with P J + J'P <= 2 omega P for all J of a set, among the P with P B = C' (Assumption 5.2), proved.

In the coordinates of `Pairing`, P = diag(G, Y). Candidates for Y come from floating
point; each is taken as the rational numbers that its doubles are, and its omega is rounded up until it is proved exactly.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from itertools import combinations_with_replacement, pairwise
from typing import NamedTuple

import numpy as np

from nsmodel.classes.lure.hypotheses import least_omega
from nsmodel.classes.lure.hypotheses.least_omega import BalancedCoordinates
from nsmodel.classes.lure.hypotheses.pairing import Pairing, well_conditioned_block
from nsmodel.proof import exact
from nsmodel.proof.exact import MACHINE_EPSILON

MAX_SDP_STATES = 20  # Up to this many states the semidefinite program is solved; above, a few candidates for Y are compared.
ZERO_RATE_TOLERANCE = 1e-9  # omega / |J| below which omega = 0 is tried.


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
    near = least_omega.balance_coordinates(*sizes, [exact.doubles(M) for M in J], [exact.doubles(M) for M in K])
    problem, least = _RateProblem(pairing, J, K, near), least_omega.omega_lower_bound(near)
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
    for J in problem.J:
        PJ = exact.matrix_product(P, J)
        if not exact.is_psd(Fraction(omega) * P - PJ):
            return False
    return True


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
    omega = max(least_omega.growth_rate(P, J) for J in near.J)
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
    Y = least_omega.search_omega(problem.near, least_omega.omega_lower_bound(problem.near))[1]
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
    chosen = least_omega.forced_kernels(near, list(nearly.T), [range(a, b) for a, b in pairwise(ends)])
    if chosen is None:
        return
    kernels, back = [exactly[:, own] for own in chosen], exact.doubles(pairing.T) @ near.back
    for accuracy in (1e-6, 1e-5, 1e-4, 1e-3):
        answer = least_omega.solve_sdp(near, 0.0, [near.left @ exact.doubles(N) for N in kernels])
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
