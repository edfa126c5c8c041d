"""All P = P' > 0 with P B = C', in coordinates in which they are block diagonal; a well conditioned one of them.

Whether there is P = P' > 0 with P B = C': decided in rational arithmetic on the given doubles.

P exists iff C B = (C B)' is psd, ker B lies in ker C' and rank C B = rank B. What fails by no more than rounding of those is told
apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from math import log2
from typing import Any, NamedTuple

import numpy as np

from nsmodel.proof import exact
from nsmodel.proof.exact import MACHINE_EPSILON
from nsmodel.proof.verdict import HOLDS, SAMPLED, UNKNOWN, VIOLATED

# Least eigenvalue of P, scaled to a unit diagonal, of which doubles show six digits; another Y is tried below it.
MIN_SCALED_EIGENVALUE = 1e-10
# With more states the condition number is minimised on a coarser grid: each point of it solves systems of that size.
LARGE_STATE_COUNT = 40


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
        """The number of rows of the free block Y."""
        return len(self.T) - len(self.G)

    def storage_matrix(self, Y: np.ndarray) -> np.ndarray:
        """P (n, n) for a rational Y."""
        return exact.matrix_product(self.T_inverse.T, self.middle(Y), self.T_inverse)

    def middle(self, Y: np.ndarray) -> np.ndarray:
        """The block-diagonal matrix diag(G, Y)."""
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


EXACT_ARITHMETIC_NOTE = "exact rational arithmetic on the given numbers"
ENTRY_RANGE = 1e-75, 1e75  # Sizes of entries of which products of four stay in the range of doubles, 1e308.
# Relative rounding of a given number and of one operation with it, with room: numbers of a model come from a few operations.
PASSIVITY_ROUNDING = 64 * MACHINE_EPSILON


class StorageDecision(NamedTuple):
    """Whether P exists, and how that is known; ``pairing`` gives all P, ``broken`` are the conditions that fail."""

    verdict: str
    how: str
    pairing: Pairing | None = None
    broken: Sequence[BrokenCondition] = ()


def find_storage_matrix(B: np.ndarray, C: np.ndarray) -> StorageDecision:
    """Decide whether there is P = P' > 0 with P B = C' for numbers B (n, m), C (m, n)."""
    sizes = np.abs(np.concatenate([B[B != 0], C[C != 0]]))
    if sizes.size and not ENTRY_RANGE[0] <= sizes.min() <= sizes.max() <= ENTRY_RANGE[1]:
        how = f"B and C have entries of size {sizes.min():.1g} to {sizes.max():.1g}, of which P would not fit into doubles: "
        return StorageDecision(UNKNOWN, how + "choose other units")
    Bq, Cq = exact.rational(B), exact.rational(C)
    faults = broken_conditions(Bq, Cq, np.abs(C) @ np.abs(B))
    if not faults:
        columns = exact.independent_columns(Bq) if B.shape[1] else []
        pairing, margin = make_pairing(Bq[:, columns], Cq[columns]), _definiteness_margin(B[:, columns], C[columns])
        how = f"{EXACT_ARITHMETIC_NOTE}: C B = (C B)' psd, ker B in ker C', rank C B = rank B"
        if margin > 8 * len(B) * PASSIVITY_ROUNDING:
            return StorageDecision(HOLDS, how, pairing)
        how += f"; but C B is singular up to rounding of its numbers (relative {margin:.1g}), and P next to it"
        return StorageDecision(SAMPLED, how, pairing)
    clear = [fault for fault in faults if fault.margin > 8 * len(B) * PASSIVITY_ROUNDING]
    if not clear:
        near = _nearby_pairing(B, C)
        if isinstance(near, Pairing):
            texts, margin = "; ".join(fault.text for fault in faults), max(fault.margin for fault in faults)
            how = f"up to rounding of the given numbers (exactly, {texts}; relative {margin:.1g})"
            return StorageDecision(SAMPLED, how, near)
        if near is None:
            how = "P exists or not by the last digits of the given numbers: " + "; ".join(fault.text for fault in faults)
            return StorageDecision(UNKNOWN, how)
        clear = [near]
    return StorageDecision(VIOLATED, f"{EXACT_ARITHMETIC_NOTE}: " + "; ".join(fault.text for fault in clear), broken=clear)


def _definiteness_margin(B: np.ndarray, C: np.ndarray) -> float:
    """The least v'CBv beside the size of its terms, for independent columns of B."""
    d, e = power_of_two_scales(B, C)
    B, C = B * d[:, None] * e, C * e[:, None] / d
    G = C @ B
    if not len(G):
        return 1.0
    v = np.linalg.eigh((G + G.T) / 2)[1][:, 0]
    return float(v @ G @ v / (np.abs(v) @ np.abs(C) @ np.abs(B) @ np.abs(v)))


class BrokenCondition(NamedTuple):
    """A condition of 5.1 that fails: in words, its number, how far beyond rounding it fails (relative), the witness."""

    text: str
    number: str
    size: float
    margin: float
    witness: Mapping[str, Any]


def broken_conditions(B: np.ndarray, C: np.ndarray, size: np.ndarray) -> list[BrokenCondition]:
    """Conditions of 5.1 that rational B, C break; ``size`` = |C||B| is what rounding is measured by."""
    CB = exact.matrix_product(C, B)
    product, faults = exact.doubles(CB), []
    if not exact.is_symmetric(CB):
        skew = exact.doubles(CB - CB.T)
        witness = {"C B": product, "skew part": skew / 2}
        faults.append(
            BrokenCondition(
                "C B is not symmetric", "|C B - (C B)'|", np.abs(skew).max(), _relative_size(skew, size + size.T), witness
            )
        )
    definite = exact.definiteness(CB)
    if definite.vector is not None:
        spectrum, vectors = np.linalg.eigh((product + product.T) / 2)
        v, margin = most_negative_vector(product, size, [vectors[:, 0], definite.vector])
        witness = {"C B": product, "v": v, "v'CBv": v @ product @ v}
        faults.append(BrokenCondition("C B is not psd", "least eigenvalue of C B", spectrum[0], margin, witness))
    faults += _kernel_condition("ker B does not lie in ker C'", "B v = 0", "C'v", B, C.T)
    faults += _kernel_condition("rank C B < rank B", "C B v = 0", "B v", CB, B)
    return faults


def _kernel_condition(text: str, zero: str, name: str, M: np.ndarray, K: np.ndarray) -> list[BrokenCondition]:
    """Find v with M v = 0, K v != 0."""
    kernel = exact.nullspace(M)
    for v in kernel.T:
        image = exact.matrix_product(K, v[:, None])
        if image.any():
            image, v, size = exact.doubles(image).ravel(), exact.doubles(v), np.abs(exact.doubles(K))
            margin = _relative_size(image, size @ np.abs(v))
            return [BrokenCondition(text, f"|{name}|", float(np.linalg.norm(image)), margin, {f"v with {zero}": v, name: image})]
    return []


def _relative_size(values: np.ndarray, size: np.ndarray) -> float:
    """The largest value beside its own size."""
    return float((np.abs(values) / np.where(size > 0, size, 1)).max(initial=0.0))


def most_negative_vector(M: np.ndarray, size: np.ndarray, vectors: list[np.ndarray]) -> tuple[np.ndarray, float]:
    """The vector with the most negative v'Mv beside |v|'size|v|, and that ratio (> 0)."""

    def share(v: np.ndarray) -> float:
        return float(-(v @ M @ v) / (np.abs(v) @ size @ np.abs(v) or 1.0))

    d = np.sqrt(np.diagonal(size))
    if (d > 0).all():
        vectors = [*vectors, np.linalg.eigh((M + M.T) / 2 / np.outer(d, d))[1][:, 0] / d]
    best = max(vectors, key=share)
    return best / np.linalg.norm(best), share(best)


def _nearby_pairing(B: np.ndarray, C: np.ndarray) -> Pairing | BrokenCondition | None:
    """A pairing for numbers within rounding of B, C, where C is replaced by B'P; or what stands in the way of any.

    None where neither is clear.
    """
    from scipy.linalg import qr

    n, (d, e) = len(B), power_of_two_scales(B, C)
    B, C = B * d[:, None] * e, C * e[:, None] / d  # now |P| is about 1
    tolerance = 8 * n * PASSIVITY_ROUNDING
    R, order = map(np.asarray, qr(B, mode="r", pivoting=True)[-2:])
    r = int((np.abs(np.diagonal(R)) > tolerance * np.abs(R).max(initial=0)).sum())
    columns = np.sort(order[:r])
    others = np.setdiff1d(np.arange(B.shape[1]), columns)
    for j in others:
        v = np.zeros(B.shape[1])
        v[j], v[columns] = 1.0, -np.linalg.lstsq(B[:, columns], B[:, j], rcond=None)[0]
        share = float(np.abs(C.T @ v).max() / max((np.abs(C.T) @ np.abs(v)).max(), MACHINE_EPSILON))
        if share > np.sqrt(tolerance):
            image, v = (C.T @ v) * d, v * e
            witness = {"v with B v = 0 up to rounding": v, "C'v": image}
            return BrokenCondition("ker B does not lie in ker C'", "|C'v|", float(np.linalg.norm(image)), share, witness)
    U, sizes, V = np.linalg.svd(B[:, columns], full_matrices=False)
    image = C[columns].T @ V.T / sizes  # P U
    middle = (U.T @ image + image.T @ U) / 2
    spectrum = np.linalg.eigvalsh(middle)
    if not r or spectrum[0] <= tolerance * spectrum[-1]:
        return None
    N = np.linalg.svd(U, full_matrices=True)[0][:, r:]
    off = N @ (N.T @ image)
    P = U @ middle @ U.T + off @ U.T + U @ off.T
    P = P + N @ (N.T @ off @ np.linalg.solve(middle, off.T @ N) + spectrum[-1] * np.eye(n - r)) @ N.T
    P = (P + P.T) / 2
    if (np.abs(P @ B - C.T) > tolerance * (np.abs(P) @ np.abs(B) + np.abs(C.T))).any() or not exact.definiteness(P).definite:
        return None
    D, E = exact.rational(d), exact.rational(e[columns])
    Bq = exact.rational(B[:, columns]) / D[:, None] / E
    return make_pairing(Bq, exact.matrix_product(Bq.T, exact.rational(P) * D[:, None] * D))
