"""A Lur'e system with too many states for exact proofs with dense matrices: what its structure alone decides.

With C = B' the identity is a P of 5.1, and for a linear A 5.2 holds with it and the omega of Gershgorin's discs: no eigenvalue of
A + A' is above 2 omega = max_i (2 A_ii + sum_{j != i} |A_ij + A_ji|). With a bounded K int dom Upsilon* is the whole space. All
else stays unknown here.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
import scipy.sparse as sp

from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Finding, Hypothesis, found
from nsmodel.hypotheses.lure.hypomonotone import HYPOMONOTONE, Growth
from nsmodel.hypotheses.lure.passivity import D_PSD, STORAGE
from nsmodel.hypotheses.lure.range_condition import H_5X0, H_31, H_54A, H_54B, H_54C, H_71
from nsmodel.model.lure import LureSystem
from nsmodel.proof.exact import EPS
from nsmodel.proof.jumps import jumps_in

MOST = 250  # States and multipliers up to which the proofs with dense matrices take seconds.
TIMES = 200  # At which f is looked at.


def is_large(model: LureSystem) -> bool:
    """Whether the structure alone is looked at."""
    return model.x.numel() + model.B.shape[1] > MOST


def findings(model: LureSystem) -> tuple[Growth, Sequence[Finding]]:
    """What 5.2 gives, and all findings; the model is bound."""
    n, m = model.x.numel(), model.B.shape[1]
    D, B, C = (ca.DM(matrix).sparse() for matrix in (model.D, model.B, model.C))
    for matrix in (D, B, C):
        matrix.eliminate_zeros()
    why = f"too large ({n} states, {m} multipliers): the proof needs dense matrices; a smaller model of the kind may be checked"
    paired = (abs(C - B.T)).nnz == 0
    growth = _growth(model, why) if paired else Growth(found(HYPOMONOTONE, UNKNOWN, why))
    low, high = (np.array(ca.DM(end)).ravel() for end in ((model.law.lower, model.law.upper) if model.law else ([], [])))
    boxes = model.law is not None and all(block.kind == "box" for block in model.law.blocks)
    bounded = boxes and bool((np.isfinite(low) & np.isfinite(high)).all())
    everywhere = "K is bounded, so that int dom Upsilon* is the whole space."

    def where_bounded(hypothesis: Hypothesis, how: str, value: dict[str, float]) -> Finding:
        return found(hypothesis, HOLDS, how, value) if bounded and not D.nnz else found(hypothesis, UNKNOWN, why)

    wide = boxes and bool((low < high).all())
    width = {"width": float((high - low).min(initial=np.inf))}
    return growth, [
        found(H_31, HOLDS, "Xi is the indicator of K, a box with an interior.", width) if wide else found(H_31, UNKNOWN, why),
        found(D_PSD, UNKNOWN, why) if D.nnz else found(D_PSD, HOLDS, "D = 0", {"least eigenvalue": 0.0}),
        found(STORAGE, HOLDS, "C = B', entry by entry: P = I", {"cond P": 1.0}) if paired else found(STORAGE, UNKNOWN, why),
        growth.finding,
        where_bounded(H_54A, everywhere, {"restricting rows": 0}),
        where_bounded(H_54B, "dom dXi = K is a box; K is bounded, so that R(dXi) is the whole space.", {"multipliers": m}),
        where_bounded(H_54C, everywhere, {"dimension": m}),
        where_bounded(H_5X0, everywhere, {"restricting rows": 0}),
        _rest(model, bounded and not D.nnz and bool(((low <= 0) & (high >= 0)).all()), why),
    ]  # fmt: skip


def _growth(model: LureSystem, why: str) -> Growth:
    """5.2 for P = I and a linear A."""
    J = ca.jacobian(model.A, model.x)
    if ca.depends_on(ca.vertcat(ca.SX(0, 1), *J.nonzeros()), model.x) or jumps_in(model.A, model.x):
        return Growth(found(HYPOMONOTONE, UNKNOWN, why))
    A = ca.DM(J).sparse().tocsr()
    twice = A + A.T
    diagonal = twice.diagonal()
    radii = np.asarray(abs(twice - sp.diags(diagonal)).sum(axis=1)).ravel()
    rounding = np.where(radii > 0, EPS * np.diff(twice.indptr) * (np.abs(diagonal) + radii), 0.0)
    omega = float(((diagonal + radii) / 2 + rounding).max(initial=-np.inf))
    if not np.isfinite(omega):
        return Growth(found(HYPOMONOTONE, UNKNOWN, "the entries of A are too large for Gershgorin's discs in doubles"))
    how = "A is linear; by Gershgorin's discs of A + A' for P = I; another P may give less"
    return Growth(found(HYPOMONOTONE, HOLDS, how, {"omega": omega, "cond P": 1.0}), None, omega)


def _rest(model: LureSystem, on_graph: bool, why: str) -> Finding:
    """7.1: f = 0, A(0) = 0 and 0 on the graph of the law."""
    if not model.f.is_zero():
        t = np.linspace(0, float(model.t_end or 1.0), TIMES)
        f = np.abs(np.array(ca.Function("f", [model.t], [ca.densify(model.f)]).map(TIMES)(t[None, :])))
        largest = f.max(axis=0)
        if largest.max() > 0:
            k = int(largest.argmax())
            how = "f = 0 fails: Section 7 is about the autonomous system, without f."
            return found(H_71, VIOLATED, how, {"sup |f|": largest[k]}, {"t": t[k], "part": "f = 0"})
        return found(H_71, UNKNOWN, why)
    at_zero = float(np.abs(np.array(ca.Function("A", [model.x], [model.A])(0))).max(initial=0.0))
    if on_graph and at_zero == 0:
        how = "0 is admissible and on the graph of the law, f = 0; A(0) is 0 in floating point"
        return found(H_71, SAMPLED, how, {"|A(0)|": 0.0})
    return found(H_71, UNKNOWN, why)
