"""Passivity of a Lur'e system's linear part: D psd (Assumption 4.1) and P = P' > 0 with P B = C' (Assumption 5.1).

P exists iff C B = (C B)' is psd, ker B lies in ker C' and rank C B = rank B: decided in rational arithmetic on the given
doubles. What fails by no more than rounding of those is told apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from nsmodel.classes.lure.hypotheses.pairing import (
    Pairing,
    condition_number,
    make_pairing,
    matrix_witness,
    pairing_residual,
    power_of_two_scales,
    well_conditioned_block,
)
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Finding, Hypothesis, make_finding
from nsmodel.proof import exact
from nsmodel.proof.exact import MACHINE_EPSILON

LURE_PAPER = "Brogliato and Goeleven 2013"
D_PSD_HYPOTHESIS = Hypothesis("4.1", "D is positive semidefinite: <D z, z> >= 0 for all z", f"{LURE_PAPER}, Assumption 4.1")
STORAGE_HYPOTHESIS = Hypothesis("5.1", "there is P = P' > 0 with P B = C'", f"{LURE_PAPER}, Assumption 5.1")

EXACT_ARITHMETIC_NOTE = "exact rational arithmetic on the given numbers"
ENTRY_RANGE = 1e-75, 1e75  # Sizes of entries from which products of four stay in the range of doubles.
PASSIVITY_ROUNDING = 64 * MACHINE_EPSILON  # relative rounding of a given number, and of one operation with it


class Passivity(NamedTuple):
    """The decision on 5.1, and what the search for the least omega starts from; without P, ``pairing`` is None."""

    finding: Finding
    pairing: Pairing | None


def decide_input_output(D: np.ndarray) -> Finding:
    """Decide 4.1 for numbers D (m, m)."""
    if not D.any():
        return make_finding(D_PSD_HYPOTHESIS, HOLDS, "D = 0", {"least eigenvalue": 0.0})
    definite = exact.definiteness(D)
    how = EXACT_ARITHMETIC_NOTE
    if definite.vector is None:
        symmetric = exact.rational(D) + exact.rational(D).T
        least = max(-exact.eigenvalue_upper_bound(-symmetric) / 2, 0.0) if definite.definite else 0.0
        kind = "positive definite" if definite.definite else f"positive semidefinite, rank of D + D' = {definite.rank}"
        return make_finding(D_PSD_HYPOTHESIS, HOLDS, f"{how}: {kind}", {"least eigenvalue": least})
    spectrum, vectors = np.linalg.eigh((D + D.T) / 2)
    value = {"least eigenvalue": spectrum[0]}
    v, margin = _most_negative_vector(D, np.abs(D), [vectors[:, 0], definite.vector])
    witness = {"v": v, "v'Dv": v @ D @ v}
    if margin <= PASSIVITY_ROUNDING:
        return make_finding(
            D_PSD_HYPOTHESIS, SAMPLED, f"negative by no more than rounding, relative {margin:.1g}", value, witness
        )
    return make_finding(D_PSD_HYPOTHESIS, VIOLATED, how, value, witness)


def decide_storage(B: np.ndarray, C: np.ndarray) -> Passivity:
    """Decide 5.1 for numbers B (n, m), C (m, n)."""
    sizes = np.abs(np.concatenate([B[B != 0], C[C != 0]]))
    if sizes.size and not ENTRY_RANGE[0] <= sizes.min() <= sizes.max() <= ENTRY_RANGE[1]:
        how = f"B and C have entries of size {sizes.min():.1g} to {sizes.max():.1g}, of which P would not fit into doubles: "
        return Passivity(make_finding(STORAGE_HYPOTHESIS, UNKNOWN, how + "choose other units"), None)
    Bq, Cq = exact.rational(B), exact.rational(C)
    faults = broken_conditions(Bq, Cq, np.abs(C) @ np.abs(B))
    if not faults:
        columns = exact.independent_columns(Bq) if B.shape[1] else []
        pairing, margin = make_pairing(Bq[:, columns], Cq[columns]), _definiteness_margin(B[:, columns], C[columns])
        how = f"{EXACT_ARITHMETIC_NOTE}: C B = (C B)' psd, ker B in ker C', rank C B = rank B"
        if margin > 8 * len(B) * PASSIVITY_ROUNDING:
            return Passivity(_storage_finding(pairing, B, C, HOLDS, how), pairing)
        how += f"; but C B is singular up to rounding of its numbers (relative {margin:.1g}), and P next to it"
        return Passivity(_storage_finding(pairing, B, C, SAMPLED, how), pairing)
    clear = [fault for fault in faults if fault.margin > 8 * len(B) * PASSIVITY_ROUNDING]
    if not clear:
        near = _nearby_pairing(B, C)
        if isinstance(near, Pairing):
            texts, margin = "; ".join(fault.text for fault in faults), max(fault.margin for fault in faults)
            how = f"up to rounding of the given numbers (exactly, {texts}; relative {margin:.1g})"
            return Passivity(_storage_finding(near, B, C, SAMPLED, how), near)
        if near is None:
            how = "P exists or not by the last digits of the given numbers: " + "; ".join(fault.text for fault in faults)
            return Passivity(make_finding(STORAGE_HYPOTHESIS, UNKNOWN, how), None)
        clear = [near]
    how = f"{EXACT_ARITHMETIC_NOTE}: " + "; ".join(fault.text for fault in clear)
    witness = {name: item for fault in clear for name, item in fault.witness.items()}
    return Passivity(
        make_finding(STORAGE_HYPOTHESIS, VIOLATED, how, {fault.number: fault.size for fault in clear}, witness), None
    )


def _definiteness_margin(B: np.ndarray, C: np.ndarray) -> float:
    """The least v'CBv beside the size of its terms, for independent columns of B."""
    d, e = power_of_two_scales(B, C)
    B, C = B * d[:, None] * e, C * e[:, None] / d
    G = C @ B
    if not len(G):
        return 1.0
    v = np.linalg.eigh((G + G.T) / 2)[1][:, 0]
    return float(v @ G @ v / (np.abs(v) @ np.abs(C) @ np.abs(B) @ np.abs(v)))


class _BrokenCondition(NamedTuple):
    """A condition of 5.1 that fails: in words, its number, how far beyond rounding it fails (relative), the witness."""

    text: str
    number: str
    size: float
    margin: float
    witness: Mapping[str, Any]


def broken_conditions(B: np.ndarray, C: np.ndarray, size: np.ndarray) -> list[_BrokenCondition]:
    """Conditions of 5.1 that rational B, C break; ``size`` = |C||B| is what rounding is measured by."""
    CB = exact.matrix_product(C, B)
    product, faults = exact.doubles(CB), []
    if not exact.is_symmetric(CB):
        skew = exact.doubles(CB - CB.T)
        witness = {"C B": product, "skew part": skew / 2}
        faults.append(
            _BrokenCondition(
                "C B is not symmetric", "|C B - (C B)'|", np.abs(skew).max(), _relative_size(skew, size + size.T), witness
            )
        )
    definite = exact.definiteness(CB)
    if definite.vector is not None:
        spectrum, vectors = np.linalg.eigh((product + product.T) / 2)
        v, margin = _most_negative_vector(product, size, [vectors[:, 0], definite.vector])
        witness = {"C B": product, "v": v, "v'CBv": v @ product @ v}
        faults.append(_BrokenCondition("C B is not psd", "least eigenvalue of C B", spectrum[0], margin, witness))
    faults += _kernel_condition("ker B does not lie in ker C'", "B v = 0", "C'v", B, C.T)
    faults += _kernel_condition("rank C B < rank B", "C B v = 0", "B v", CB, B)
    return faults


def _kernel_condition(text: str, zero: str, name: str, M: np.ndarray, K: np.ndarray) -> list[_BrokenCondition]:
    """Find v with M v = 0, K v != 0."""
    kernel = exact.nullspace(M)
    for v in kernel.T:
        image = exact.matrix_product(K, v[:, None])
        if image.any():
            image, v, size = exact.doubles(image).ravel(), exact.doubles(v), np.abs(exact.doubles(K))
            margin = _relative_size(image, size @ np.abs(v))
            return [_BrokenCondition(text, f"|{name}|", float(np.linalg.norm(image)), margin, {f"v with {zero}": v, name: image})]
    return []


def _relative_size(values: np.ndarray, size: np.ndarray) -> float:
    """The largest value beside its own size."""
    return float((np.abs(values) / np.where(size > 0, size, 1)).max(initial=0.0))


def _most_negative_vector(M: np.ndarray, size: np.ndarray, vectors: list[np.ndarray]) -> tuple[np.ndarray, float]:
    """The vector with the most negative v'Mv beside |v|'size|v|, and that ratio (> 0)."""

    def share(v: np.ndarray) -> float:
        return float(-(v @ M @ v) / (np.abs(v) @ size @ np.abs(v) or 1.0))

    d = np.sqrt(np.diagonal(size))
    if (d > 0).all():
        vectors = [*vectors, np.linalg.eigh((M + M.T) / 2 / np.outer(d, d))[1][:, 0] / d]
    best = max(vectors, key=share)
    return best / np.linalg.norm(best), share(best)


def _storage_finding(pairing: Pairing, B: np.ndarray, C: np.ndarray, verdict: str, how: str) -> Finding:
    """The finding with the best conditioned P that was found."""
    P = pairing.storage_matrix(well_conditioned_block(pairing))
    witness = matrix_witness("P", P)
    if len(witness) > 1 and verdict == HOLDS:
        how += "; P is rounded to doubles here, with their |PB - C'|; its fractions, with P B = C', are in the data (P exactly)"
    value = {"cond P": condition_number(witness["P"]), "|PB - C'|/|C|": pairing_residual(witness["P"], B, C)}
    return make_finding(STORAGE_HYPOTHESIS, verdict, f"{how}; cond P in floating point", value, witness)


def _nearby_pairing(B: np.ndarray, C: np.ndarray) -> Pairing | _BrokenCondition | None:
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
            return _BrokenCondition("ker B does not lie in ker C'", "|C'v|", float(np.linalg.norm(image)), share, witness)
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
