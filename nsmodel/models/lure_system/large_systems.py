"""A Lur'e system with too many states for exact proofs with dense matrices: what its structure alone decides.

Where the rows of B and of C' are positive multiples of each other a diagonal P is one of 5.1, with C = B' the identity, and for a
linear A 5.2 holds with it and the omega of Gershgorin's discs: 2 omega p_i >= 2 p_i A_ii + sum_{j != i} |p_i A_ij + p_j A_ji|.
With a bounded K int dom Upsilon* is the whole space. All else stays unknown here.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise

import casadi as ca
import numpy as np
import scipy.sparse as sp

from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Finding, Hypothesis, make_finding
from nsmodel.models.lure_system.hypomonotone import HYPOMONOTONE, HypomonotoneBound, is_drift_affine
from nsmodel.models.lure_system.model import LureSystem
from nsmodel.models.lure_system.passivity import D_PSD_HYPOTHESIS, STORAGE_HYPOTHESIS
from nsmodel.models.lure_system.range_condition import H_5X0, H_31, H_54A, H_54B, H_54C, H_71
from nsmodel.proof.exact import MACHINE_EPSILON

# States and multipliers together, up to which dense matrices are decided, in seconds; of more the structure alone is looked at.
MAX_DENSE_SIZE = 250
FORCE_SAMPLES = 200  # Times at which f is looked at, to find one at which it is not 0.


def is_large(model: LureSystem) -> bool:
    """Whether the structure alone is looked at."""
    return model.x.numel() + model.B.shape[1] > MAX_DENSE_SIZE


def structural_findings(model: LureSystem) -> tuple[HypomonotoneBound, Sequence[Finding]]:
    """What 5.2 gives, and all findings; the model is bound."""
    n, m = model.x.numel(), model.B.shape[1]
    D, B, C = (ca.DM(matrix).sparse() for matrix in (model.D, model.B, model.C))
    for matrix in (D, B, C):
        matrix.eliminate_zeros()
    why = f"too large ({n} states, {m} multipliers): the proof needs dense matrices; a smaller model of the kind may be checked"
    P = _diagonal_storage(B, C)
    growth = _gershgorin_growth(model, P, why) if P is not None else HypomonotoneBound(make_finding(HYPOMONOTONE, UNKNOWN, why))
    low, high = (np.array(ca.DM(end)).ravel() for end in ((model.law.lower, model.law.upper) if model.law else ([], [])))
    boxes = model.law is not None and model.law.is_box
    bounded = boxes and bool((np.isfinite(low) & np.isfinite(high)).all())
    everywhere = "K is bounded, so that int dom Upsilon* is the whole space."

    def where_bounded(hypothesis: Hypothesis, how: str, value: dict[str, float]) -> Finding:
        return make_finding(hypothesis, HOLDS, how, value) if bounded and not D.nnz else make_finding(hypothesis, UNKNOWN, why)

    wide = boxes and bool((low < high).all())
    width = {"width": float((high - low).min(initial=np.inf))}
    return growth, [
        make_finding(H_31, HOLDS, "Xi is the indicator of K, a box with an interior.", width) if wide
        else make_finding(H_31, UNKNOWN, why),
        make_finding(D_PSD_HYPOTHESIS, UNKNOWN, why) if D.nnz
        else make_finding(D_PSD_HYPOTHESIS, HOLDS, "D = 0", {"least eigenvalue": 0.0}),
        _diagonal_storage_finding(P) if P is not None else make_finding(STORAGE_HYPOTHESIS, UNKNOWN, why),
        growth.finding,
        where_bounded(H_54A, everywhere, {"restricting rows": 0}),
        where_bounded(H_54B, "dom dXi = K is a box; K is bounded, so that R(dXi) is the whole space.", {"multipliers": m}),
        where_bounded(H_54C, everywhere, {"dimension": m}),
        where_bounded(H_5X0, everywhere, {"restricting rows": 0}),
        _structural_rest_finding(model, bounded and not D.nnz and bool(((low <= 0) & (high >= 0)).all()), why),
    ]  # fmt: skip


def _diagonal_storage(B: sp.csr_matrix, C: sp.csr_matrix) -> list[Fraction] | None:
    """P = diag(p_i) > 0 with p_i B_ij = C_ji, entry by entry and exactly; None where there is none."""
    columns, rows = sp.csr_matrix(C.T), sp.csr_matrix(B)
    rows.sort_indices()
    columns.sort_indices()
    if not (np.array_equal(rows.indptr, columns.indptr) and np.array_equal(rows.indices, columns.indices)):
        return None
    P = []
    for a, b in pairwise(rows.indptr):
        ratios = {Fraction(c) / Fraction(e) for c, e in zip(columns.data[a:b].tolist(), rows.data[a:b].tolist(), strict=True)}
        if len(ratios) > 1 or min(ratios, default=1) <= 0:
            return None
        P.append(ratios.pop() if ratios else Fraction(1))
    return P


def _diagonal_storage_finding(P: list[Fraction]) -> Finding:
    one = all(p == 1 for p in P)
    how = "C = B', entry by entry: P = I" if one else "P B = C' with a diagonal P > 0, entry by entry in fractions"
    condition = max(P) / min(P)
    return make_finding(
        STORAGE_HYPOTHESIS, HOLDS, how, {"cond P": float(condition)}, {} if one else {"diagonal of P": [float(p) for p in P]}
    )


def _gershgorin_growth(model: LureSystem, P: list[Fraction], why: str) -> HypomonotoneBound:
    """5.2 for a diagonal P and a linear A: 2 omega P - P A - A'P has a dominant diagonal."""
    J = ca.jacobian(model.A, model.x)
    if ca.depends_on(ca.vertcat(ca.SX(0, 1), *J.nonzeros()), model.x) or not is_drift_affine(model.A, model.x):
        return HypomonotoneBound(make_finding(HYPOMONOTONE, UNKNOWN, why))
    p = np.array([float(entry) for entry in P])
    A = sp.diags(p) @ ca.DM(J).sparse().tocsr()
    twice = (A + A.T).tocsr()
    diagonal = twice.diagonal()
    radii = np.asarray(abs(twice - sp.diags(diagonal)).sum(axis=1)).ravel()
    size = np.asarray((abs(A) + abs(A.T)).sum(axis=1)).ravel()
    plain = all(entry == 1 for entry in P) and not radii.any()
    rounding = np.zeros(len(p)) if plain else MACHINE_EPSILON * (np.diff(twice.indptr) + 8) * size
    omega = float((((diagonal + radii) / 2 + rounding) / p).max(initial=-np.inf))
    if not np.isfinite(omega):
        return HypomonotoneBound(
            make_finding(HYPOMONOTONE, UNKNOWN, "the entries of A are too large for Gershgorin's discs in doubles")
        )
    kind = "P = I" if all(entry == 1 for entry in P) else "the diagonal P of 5.1"
    how = f"A is linear; by Gershgorin's discs of P A + A'P for {kind}; another P may give less"
    return HypomonotoneBound(
        make_finding(HYPOMONOTONE, HOLDS, how, {"omega": omega, "cond P": float(max(P) / min(P))}), None, omega
    )


def _structural_rest_finding(model: LureSystem, on_graph: bool, why: str) -> Finding:
    """7.1: f = 0, A(0) = 0 and 0 on the graph of the law; e = 0."""
    if not model.f.is_zero():
        t = np.linspace(0, float(model.t_end or 1.0), FORCE_SAMPLES)
        f = np.abs(np.array(ca.Function("f", [model.t], [ca.densify(model.f)]).map(FORCE_SAMPLES)(t[None, :])))
        largest = f.max(axis=0)
        if largest.max() > 0:
            k = int(largest.argmax())
            how = "f = 0 fails: Section 7 is about the autonomous system, without f."
            return make_finding(H_71, VIOLATED, how, {"sup |f|": largest[k]}, {"t": t[k], "part": "f = 0"})
        return make_finding(H_71, UNKNOWN, why)
    at_zero = float(np.abs(np.array(ca.Function("A", [model.x], [model.A])(0))).max(initial=0.0))
    if on_graph and at_zero == 0 and model.e.is_zero():
        how = "0 is admissible and on the graph of the law, f = 0; A(0) is 0 in floating point"
        return make_finding(H_71, SAMPLED, how, {"|A(0)|": 0.0})
    return make_finding(H_71, UNKNOWN, why)
