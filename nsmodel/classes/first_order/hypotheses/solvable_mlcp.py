"""F-mlcp: is W_mlcp positive semidefinite or a P-matrix, exactly where it is constant, else along the run."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.first_order.hypotheses.linearised import SystemLinearisation
from nsmodel.classes.first_order.hypotheses.step_matrix import ROUNDING_LABEL, PrincipalMinor, change_at_step, decide_p_matrix
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Finding, Hypothesis, make_finding
from nsmodel.proof import exact
from nsmodel.proof.extremum import largest_eigenvalue
from nsmodel.solvers.structure import is_eigenvalue_nonnegative, least_eigenvalue

MAX_INVERSE_SIZE = 4  # States and multipliers up to which W^{-1} is written out.
MAX_MLCP_STEPS = 5  # Different step lengths that are decided one by one.
MLCP_MARGIN = 1e-9  # A scaled eigenvalue or minor below minus this is no rounding.


def mlcp_solvability(hypothesis: Hypothesis, at: SystemLinearisation, regular: str, quick: bool) -> Finding:
    """Decide F-mlcp; ``regular`` is the verdict about W."""
    m = at.model.law.size
    if not m:
        return make_finding(
            hypothesis, HOLDS, "There are no multipliers: no complementarity problem has to be solved.", {"rows": 0}
        )
    if regular == VIOLATED and at.is_W_constant:
        return make_finding(hypothesis, UNKNOWN, "W is singular (F-W), so that W_mlcp is not defined")
    return _exact_solvability(hypothesis, at) if at.constant else _sampled_solvability(hypothesis, at, quick)


def _mlcp_measures(W: np.ndarray) -> dict[str, float]:
    """Least eigenvalue of the symmetric part in the user's unit, and the condition after scaling rows and columns alike."""
    size = np.sqrt(np.abs(W).max(axis=1)) * np.sqrt(np.abs(W).max(axis=0))
    root = np.sqrt(np.where(size > 0, size, 1.0))
    spectrum = np.linalg.svd(W / root[:, None] / root, compute_uv=False)
    condition = spectrum[0] / spectrum[-1] if spectrum[-1] > 1e-15 * spectrum[0] else np.inf
    return {"least eigenvalue": float(np.linalg.eigvalsh((W + W.T) / 2)[0]), "condition": float(condition)}


def _exact_solvability(hypothesis: Hypothesis, at: SystemLinearisation) -> Finding:
    """Every step length that occurs, in rational arithmetic."""
    value: dict[str, float] = {}
    kinds = set()
    for h in at.steps[-MAX_MLCP_STEPS:]:
        W = at.exact_mlcp(float(h))
        if W is None:
            return make_finding(hypothesis, UNKNOWN, f"W is singular at h = {h:g} (F-W)")
        value = _mlcp_measures(exact.doubles(W))
        if (change := change_at_step(at.M, at.exact_G(), float(h))) >= 1:
            how = "W is regular by rounding only (F-W), and W_mlcp known no better than that."
            return make_finding(hypothesis, SAMPLED, how, value | {ROUNDING_LABEL: change}, {"h": h})
        definite = exact.definiteness(W)
        if definite.psd:
            kinds.add("positive definite" if definite.definite else "positive semidefinite")
            continue
        is_p, minor = decide_p_matrix(W)
        if not is_p and is_eigenvalue_nonnegative(least_eigenvalue(exact.doubles(W)), len(W)):
            how = "Constant; psd up to rounding only (64 eps): exactly, on these doubles, v'W_mlcp v < 0."
            return make_finding(hypothesis, SAMPLED, how, value, {"v": definite.vector, "h": h})
        if is_p is None:
            return make_finding(
                hypothesis, UNKNOWN, f"W_mlcp is not psd, and too large ({len(W)} rows) to look at all minors", value
            )
        if not is_p:
            how = "Exactly: v'W_mlcp v < 0, and the principal minor of these rows is <= 0."
            rows = [at.model.multiplier_names[i] for i in minor.rows]
            value |= {"principal minor": minor.value}
            return make_finding(hypothesis, VIOLATED, how, value, {"rows": rows, "v": definite.vector, "h": h})
        kinds.add("a P-matrix, all its principal minors > 0, and not psd")
        value |= {} if np.isnan(minor.value) else {"least minor with diagonal 1": minor.value}
    which = " and ".join(sorted(kinds))
    if len(at.steps) > MAX_MLCP_STEPS:
        how = f"W_mlcp is {which} at the {MAX_MLCP_STEPS} longest of {len(at.steps)} step lengths (exact)."
        return make_finding(hypothesis, SAMPLED, how, value)
    return make_finding(hypothesis, HOLDS, f"Exactly: W_mlcp is constant and {which}.", value)


def _sampled_solvability(hypothesis: Hypothesis, at: SystemLinearisation, quick: bool) -> Finding:
    """The points, where a clear violation counts; a proof over the region for small systems."""
    h = float(at.steps.max())
    matrices = at.mlcp_values(h)
    usable = np.all(np.isfinite(matrices), axis=(1, 2))
    if not usable.any():
        return make_finding(hypothesis, UNKNOWN, "W_mlcp is nowhere finite at the points looked at")
    worst, value, minor = 0, {}, PrincipalMinor(np.nan, [])
    least = [least_eigenvalue(W) if good else np.inf for W, good in zip(matrices, usable, strict=True)]
    order = [int(k) for k in np.argsort(least) if usable[k]]
    m, worst, undecided = matrices.shape[1], order[0], False
    value = _mlcp_measures(matrices[worst])
    for k in order:
        if is_eigenvalue_nonnegative(least[k], m):
            break
        is_p, minor = decide_p_matrix(exact.rational(matrices[k]))
        undecided = undecided or is_p is None
        if is_p is False:
            return _violation_at_point(hypothesis, at, matrices[k], least[k], minor, k)
    if undecided:
        return make_finding(hypothesis, UNKNOWN, "W_mlcp is not psd at a point, and too large to look at all minors", value)
    if not quick and least[worst] > MLCP_MARGIN and _is_proved_psd(at, h):
        return make_finding(
            hypothesis, HOLDS, f"Its symmetric part is psd on {at.where} (interval arithmetic).", value, scope=at.scope()
        )
    how = f"Psd or a P-matrix at each of {at.along}; the witness is where it is least." + (
        " Not maximised (quick)." if quick else ""
    )
    return make_finding(hypothesis, SAMPLED if usable.all() else UNKNOWN, how, value, at.at(at.points[worst]), at.scope())


def _violation_at_point(
    hypothesis: Hypothesis, at: SystemLinearisation, W: np.ndarray, least: float, minor: PrincipalMinor, k: int
) -> Finding:
    rows = [at.model.multiplier_names[i] for i in minor.rows]
    value = _mlcp_measures(W) | {"principal minor": minor.value}
    if least > -MLCP_MARGIN:
        return make_finding(hypothesis, UNKNOWN, "W_mlcp is psd only up to rounding at this point", value, at.at(at.points[k]))
    how = f"At this point of {at.along} W_mlcp is not psd, and the principal minor of these rows is <= 0."
    return make_finding(hypothesis, VIOLATED, how, value, {"rows": rows, **at.at(at.points[k])})


def _is_proved_psd(at: SystemLinearisation, h: float) -> bool:
    """Whether the symmetric part of W_mlcp, W^{-1} by minors, is proved to be psd over the region."""
    J, n, m = at.jacobians, len(at.model.names), at.model.law.size
    if n > MAX_INVERSE_SIZE or m > MAX_INVERSE_SIZE or len(at.steps) > 1:
        return False
    W = at.model.M - h * at.G
    matrix = J.D + h * at.model.gamma * J.C @ ca.inv_minor(ca.densify(W)) @ J.B
    sup = largest_eigenvalue(-(matrix + matrix.T) / 2, at.z, at.lower, at.upper, points=at.points, bound_to=0.0)
    return sup.bound <= 0
