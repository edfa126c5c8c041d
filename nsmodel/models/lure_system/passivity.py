"""Passivity of a Lur'e system's linear part: D psd (Assumption 4.1) and P = P' > 0 with P B = C' (Assumption 5.1)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nsmodel.hypotheses.findings import HOLDS, SAMPLED, VIOLATED, Finding, Hypothesis, make_finding
from nsmodel.proof import exact
from nsmodel.proof.storage_matrix import (
    EXACT_ARITHMETIC_NOTE,
    PASSIVITY_ROUNDING,
    Pairing,
    condition_number,
    find_storage_matrix,
    matrix_witness,
    most_negative_vector,
    pairing_residual,
    well_conditioned_block,
)

LURE_PAPER = "Brogliato and Goeleven 2013"
D_PSD_HYPOTHESIS = Hypothesis("4.1", "D is positive semidefinite: <D z, z> >= 0 for all z", f"{LURE_PAPER}, Assumption 4.1")
STORAGE_HYPOTHESIS = Hypothesis("5.1", "there is P = P' > 0 with P B = C'", f"{LURE_PAPER}, Assumption 5.1")


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
    v, margin = most_negative_vector(D, np.abs(D), [vectors[:, 0], definite.vector])
    witness = {"v": v, "v'Dv": v @ D @ v}
    if margin <= PASSIVITY_ROUNDING:
        return make_finding(
            D_PSD_HYPOTHESIS, SAMPLED, f"negative by no more than rounding, relative {margin:.1g}", value, witness
        )
    return make_finding(D_PSD_HYPOTHESIS, VIOLATED, how, value, witness)


def decide_storage(B: np.ndarray, C: np.ndarray) -> Passivity:
    """Decide 5.1 for numbers B (n, m), C (m, n)."""
    verdict, how, pairing, broken = find_storage_matrix(B, C)
    if pairing is not None:
        return Passivity(_storage_finding(pairing, B, C, verdict, how), pairing)
    witness = {name: item for fault in broken for name, item in fault.witness.items()}
    sizes = {fault.number: fault.size for fault in broken}
    return Passivity(make_finding(STORAGE_HYPOTHESIS, verdict, how, sizes, witness), None)


def _storage_finding(pairing: Pairing, B: np.ndarray, C: np.ndarray, verdict: str, how: str) -> Finding:
    """The finding with the best conditioned P that was found."""
    P = pairing.storage_matrix(well_conditioned_block(pairing))
    witness = matrix_witness("P", P)
    if len(witness) > 1 and verdict == HOLDS:
        how += "; P is rounded to doubles here, with their |PB - C'|; its fractions, with P B = C', are in the data (P exactly)"
    value = {"cond P": condition_number(witness["P"]), "|PB - C'|/|C|": pairing_residual(witness["P"], B, C)}
    return make_finding(STORAGE_HYPOTHESIS, verdict, f"{how}; cond P in floating point", value, witness)
