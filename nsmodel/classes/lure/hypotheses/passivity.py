"""Passivity of a Lur'e system's linear part: D psd (Assumption 4.1) and P = P' > 0 with P B = C' (Assumption 5.1).

P exists iff C B = (C B)' is psd, ker B lies in ker C' and rank C B = rank B: decided in rational arithmetic on the given
doubles. What fails by no more than rounding of those is told apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from nsmodel.classes.lure.hypotheses.pairing import Pairing, condition, pairing_of, residual, shown, units, well_conditioned
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Finding, Hypothesis, found
from nsmodel.proof import exact
from nsmodel.proof.exact import EPS

PAPER = "Brogliato and Goeleven 2013"
D_PSD = Hypothesis("4.1", "D is positive semidefinite: <D z, z> >= 0 for all z", f"{PAPER}, Assumption 4.1")
STORAGE = Hypothesis("5.1", "there is P = P' > 0 with P B = C'", f"{PAPER}, Assumption 5.1")

EXACTLY = "exact rational arithmetic on the given numbers"
REACH = 1e-75, 1e75  # Sizes of entries from which products of four stay in the range of doubles.
ROUNDING = 64 * EPS  # relative rounding of a given number, and of one operation with it


class Passivity(NamedTuple):
    """The decision on 5.1, and what the search for the least omega starts from; without P, ``pairing`` is None."""

    finding: Finding
    pairing: Pairing | None


def input_output(D: np.ndarray) -> Finding:
    """Decide 4.1 for numbers D (m, m)."""
    if not D.any():
        return found(D_PSD, HOLDS, "D = 0", {"least eigenvalue": 0.0})
    definite = exact.psd(D)
    how = EXACTLY
    if definite.vector is None:
        symmetric = exact.rational(D) + exact.rational(D).T
        least = max(-exact.eigenvalue_above(-symmetric) / 2, 0.0) if definite.definite else 0.0
        kind = "positive definite" if definite.definite else f"positive semidefinite, rank of D + D' = {definite.rank}"
        return found(D_PSD, HOLDS, f"{how}: {kind}", {"least eigenvalue": least})
    spectrum, vectors = np.linalg.eigh((D + D.T) / 2)
    value = {"least eigenvalue": spectrum[0]}
    v, margin = _clearest(D, np.abs(D), [vectors[:, 0], definite.vector])
    witness = {"v": v, "v'Dv": v @ D @ v}
    if margin <= ROUNDING:
        return found(D_PSD, SAMPLED, f"negative by no more than rounding, relative {margin:.1g}", value, witness)
    return found(D_PSD, VIOLATED, how, value, witness)


def storage(B: np.ndarray, C: np.ndarray) -> Passivity:
    """Decide 5.1 for numbers B (n, m), C (m, n)."""
    sizes = np.abs(np.concatenate([B[B != 0], C[C != 0]]))
    if sizes.size and not REACH[0] <= sizes.min() <= sizes.max() <= REACH[1]:
        how = f"B and C have entries of size {sizes.min():.1g} to {sizes.max():.1g}, of which P would not fit into doubles: "
        return Passivity(found(STORAGE, UNKNOWN, how + "choose other units"), None)
    Bq, Cq = exact.rational(B), exact.rational(C)
    faults = broken(Bq, Cq, np.abs(C) @ np.abs(B))
    if not faults:
        columns = exact.independent_columns(Bq) if B.shape[1] else []
        pairing, margin = pairing_of(Bq[:, columns], Cq[columns]), _margin(B[:, columns], C[columns])
        how = f"{EXACTLY}: C B = (C B)' psd, ker B in ker C', rank C B = rank B"
        if margin > 8 * len(B) * ROUNDING:
            return Passivity(_with_storage(pairing, B, C, HOLDS, how), pairing)
        how += f"; but C B is singular up to rounding of its numbers (relative {margin:.1g}), and P next to it"
        return Passivity(_with_storage(pairing, B, C, SAMPLED, how), pairing)
    clear = [fault for fault in faults if fault.margin > 8 * len(B) * ROUNDING]
    if not clear:
        near = _nearby(B, C)
        if isinstance(near, Pairing):
            texts, margin = "; ".join(fault.text for fault in faults), max(fault.margin for fault in faults)
            how = f"up to rounding of the given numbers (exactly, {texts}; relative {margin:.1g})"
            return Passivity(_with_storage(near, B, C, SAMPLED, how), near)
        if near is None:
            how = "P exists or not by the last digits of the given numbers: " + "; ".join(fault.text for fault in faults)
            return Passivity(found(STORAGE, UNKNOWN, how), None)
        clear = [near]
    how = f"{EXACTLY}: " + "; ".join(fault.text for fault in clear)
    witness = {name: item for fault in clear for name, item in fault.witness.items()}
    return Passivity(found(STORAGE, VIOLATED, how, {fault.number: fault.size for fault in clear}, witness), None)


def _margin(B: np.ndarray, C: np.ndarray) -> float:
    """The least v'CBv beside the size of its terms, for independent columns of B."""
    d, e = units(B, C)
    B, C = B * d[:, None] * e, C * e[:, None] / d
    G = C @ B
    if not len(G):
        return 1.0
    v = np.linalg.eigh((G + G.T) / 2)[1][:, 0]
    return float(v @ G @ v / (np.abs(v) @ np.abs(C) @ np.abs(B) @ np.abs(v)))


class _Fault(NamedTuple):
    """A condition of 5.1 that fails: in words, its number, how far beyond rounding it fails (relative), the witness."""

    text: str
    number: str
    size: float
    margin: float
    witness: Mapping[str, Any]


def broken(B: np.ndarray, C: np.ndarray, size: np.ndarray) -> list[_Fault]:
    """Conditions of 5.1 that rational B, C break; ``size`` = |C||B| is what rounding is measured by."""
    CB = exact.product(C, B)
    product, faults = exact.doubles(CB), []
    if not exact.is_symmetric(CB):
        skew = exact.doubles(CB - CB.T)
        witness = {"C B": product, "skew part": skew / 2}
        faults.append(_Fault("C B is not symmetric", "|C B - (C B)'|", np.abs(skew).max(), _share(skew, size + size.T), witness))
    definite = exact.psd(CB)
    if definite.vector is not None:
        spectrum, vectors = np.linalg.eigh((product + product.T) / 2)
        v, margin = _clearest(product, size, [vectors[:, 0], definite.vector])
        witness = {"C B": product, "v": v, "v'CBv": v @ product @ v}
        faults.append(_Fault("C B is not psd", "least eigenvalue of C B", spectrum[0], margin, witness))
    faults += _kernel("ker B does not lie in ker C'", "B v = 0", "C'v", B, C.T)
    faults += _kernel("rank C B < rank B", "C B v = 0", "B v", CB, B)
    return faults


def _kernel(text: str, zero: str, name: str, M: np.ndarray, K: np.ndarray) -> list[_Fault]:
    """Find v with M v = 0, K v != 0."""
    kernel = exact.nullspace(M)
    for v in kernel.T:
        image = exact.product(K, v[:, None])
        if image.any():
            image, v, size = exact.doubles(image).ravel(), exact.doubles(v), np.abs(exact.doubles(K))
            margin = _share(image, size @ np.abs(v))
            return [_Fault(text, f"|{name}|", float(np.linalg.norm(image)), margin, {f"v with {zero}": v, name: image})]
    return []


def _share(values: np.ndarray, size: np.ndarray) -> float:
    """The largest value beside its own size."""
    return float((np.abs(values) / np.where(size > 0, size, 1)).max(initial=0.0))


def _clearest(M: np.ndarray, size: np.ndarray, vectors: list[np.ndarray]) -> tuple[np.ndarray, float]:
    """The vector with the most negative v'Mv beside |v|'size|v|, and that ratio (> 0)."""

    def share(v: np.ndarray) -> float:
        return float(-(v @ M @ v) / (np.abs(v) @ size @ np.abs(v) or 1.0))

    d = np.sqrt(np.diagonal(size))
    if (d > 0).all():
        vectors = [*vectors, np.linalg.eigh((M + M.T) / 2 / np.outer(d, d))[1][:, 0] / d]
    best = max(vectors, key=share)
    return best / np.linalg.norm(best), share(best)


def _with_storage(pairing: Pairing, B: np.ndarray, C: np.ndarray, verdict: str, how: str) -> Finding:
    """The finding with the best conditioned P that was found."""
    P = pairing.storage(well_conditioned(pairing))
    witness = shown("P", P)
    if len(witness) > 1 and verdict == HOLDS:
        how += "; P is rounded to doubles here, with their |PB - C'|; its fractions, with P B = C', are in the data (P exactly)"
    value = {"cond P": condition(witness["P"]), "|PB - C'|/|C|": residual(witness["P"], B, C)}
    return found(STORAGE, verdict, f"{how}; cond P in floating point", value, witness)


def _nearby(B: np.ndarray, C: np.ndarray) -> Pairing | _Fault | None:
    """A pairing for numbers within rounding of B, C, where C is replaced by B'P; or what stands in the way of any.

    None where neither is clear.
    """
    from scipy.linalg import qr

    n, (d, e) = len(B), units(B, C)
    B, C = B * d[:, None] * e, C * e[:, None] / d  # now |P| is about 1
    tolerance = 8 * n * ROUNDING
    R, order = map(np.asarray, qr(B, mode="r", pivoting=True)[-2:])
    r = int((np.abs(np.diagonal(R)) > tolerance * np.abs(R).max(initial=0)).sum())
    columns = np.sort(order[:r])
    others = np.setdiff1d(np.arange(B.shape[1]), columns)
    for j in others:
        v = np.zeros(B.shape[1])
        v[j], v[columns] = 1.0, -np.linalg.lstsq(B[:, columns], B[:, j], rcond=None)[0]
        share = float(np.abs(C.T @ v).max() / max((np.abs(C.T) @ np.abs(v)).max(), EPS))
        if share > np.sqrt(tolerance):
            image, v = (C.T @ v) * d, v * e
            witness = {"v with B v = 0 up to rounding": v, "C'v": image}
            return _Fault("ker B does not lie in ker C'", "|C'v|", float(np.linalg.norm(image)), share, witness)
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
    if (np.abs(P @ B - C.T) > tolerance * (np.abs(P) @ np.abs(B) + np.abs(C.T))).any() or not exact.psd(P).definite:
        return None
    D, E = exact.rational(d), exact.rational(e[columns])
    Bq = exact.rational(B[:, columns]) / D[:, None] / E
    return pairing_of(Bq, exact.product(Bq.T, exact.rational(P) * D[:, None] * D))
