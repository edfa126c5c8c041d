"""Whether there is P = P' > 0 with P B = C': decided in rational arithmetic on the given doubles.

P exists iff C B = (C B)' is psd, ker B lies in ker C' and rank C B = rank B. What fails by no more than rounding of those is told
apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from nsmodel.classes.lure.hypotheses.pairing import Pairing, make_pairing, power_of_two_scales
from nsmodel.proof import exact
from nsmodel.proof.exact import MACHINE_EPSILON
from nsmodel.proof.verdict import HOLDS, SAMPLED, UNKNOWN, VIOLATED

EXACT_ARITHMETIC_NOTE = "exact rational arithmetic on the given numbers"
ENTRY_RANGE = 1e-75, 1e75  # Sizes of entries from which products of four stay in the range of doubles.
PASSIVITY_ROUNDING = 64 * MACHINE_EPSILON  # relative rounding of a given number, and of one operation with it


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
