"""F-unique: does a step have one and only one solution?

Affine steps with constant matrices are decided for every state: W_mlcp a P-matrix and K a box, or W_mlcp definite, gives one l;
W_mlcp psd with ker(W_mlcp + W_mlcp') inside ker B gives at most one x, as two solutions differ by such a d; a solution exists
where K is bounded, or R(W_mlcp + N_K) is the whole space. Otherwise two solutions are looked for, which count when they are
proved.

F-mlcp: is W_mlcp positive semidefinite or a P-matrix, exactly where it is constant, else along the run.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Finding, Hypothesis, make_finding
from nsmodel.models.first_order_system import two_solutions
from nsmodel.models.first_order_system.affine_step import (
    STATE_SAMPLES,
    AffineStep,
    InfeasibleState,
    StepCounterexample,
    affine_step,
    decide_solvability,
    find_counterexample,
    is_solution_unique,
)
from nsmodel.models.first_order_system.linearisation import SystemLinearisation, constant_matrix_values
from nsmodel.models.first_order_system.monotone_step import UniquenessProof, prove_unique_on_region
from nsmodel.models.first_order_system.paired_step import prove_unique_paired
from nsmodel.models.first_order_system.step_matrix import (
    ROUNDING_LABEL,
    PrincipalMinor,
    change_at_step,
    decide_p_matrix,
    is_coherently_oriented,
)
from nsmodel.models.first_order_system.step_modes import substitute_held_rows
from nsmodel.models.lure_system import domains
from nsmodel.models.lure_system.range_condition import is_range_whole_space
from nsmodel.proof import exact
from nsmodel.proof.extremum import largest_eigenvalue
from nsmodel.proof.verdict import not_none
from nsmodel.solvers.structure import is_eigenvalue_nonnegative, least_eigenvalue

# Different step lengths that are decided one by one, in rational numbers; of more, all between 0 and h, or the longest.
MAX_DECIDED_STEPS = 5
NO_NORMAL_CONE = "Coulomb friction is no normal cone, and not monotone: what W_mlcp is says nothing of a step"
JUMP_TEXT = "f, h or g jumps (F-jacobians): a step across the jump may have no solution, or several, whatever W is"


def step_uniqueness(
    hypothesis: Hypothesis, at: SystemLinearisation, regular: Finding, mlcp_finding: Finding, quick: bool
) -> Finding:
    """Decide F-unique from F-W, F-mlcp and, where they do not settle it, by enumeration."""
    if regular.verdict == VIOLATED and at.is_W_constant:
        return make_finding(hypothesis, UNKNOWN, "W is singular (F-W): x_{k+1} is not determined by l")
    if at.defined.verdict != HOLDS:
        return make_finding(hypothesis, UNKNOWN, f"a step needs finite f, h and g: {at.defined.how}")
    if not at.model.law.size:
        return _smooth_uniqueness(hypothesis, at, regular, quick)
    if not at.model.law.is_normal_cone:
        return make_finding(hypothesis, UNKNOWN, NO_NORMAL_CONE)
    exactly = at.constant and at.affine and regular.verdict == HOLDS
    if exactly and (finding := _constant_uniqueness(hypothesis, at, mlcp_finding, quick)) is not None:
        return finding
    if quick:
        return make_finding(hypothesis, UNKNOWN, "not settled by W_mlcp alone; index sets are not enumerated (quick)")
    most = None if exactly or at.jump is not None else _uniqueness_on_region(at, regular.verdict == HOLDS)
    if most is not None and most.exists:
        return make_finding(
            hypothesis, HOLDS, f"{most.how[0].upper()}{most.how[1:]}.", {"solutions": 1}, scope=at.scope(local=most.local)
        )
    finding = _search_finding(hypothesis, at)
    if most is not None and finding.verdict != VIOLATED:
        how = f"At most one in the region: {most.how}. That there is one is not proved."
        return make_finding(hypothesis, UNKNOWN, how, {"solutions": 1}, scope=at.scope(local=most.local))
    if finding.verdict == SAMPLED and at.jump is not None:
        return make_finding(hypothesis, UNKNOWN, JUMP_TEXT, finding.value)
    return finding


def _uniqueness_on_region(at: SystemLinearisation, regular: bool) -> UniquenessProof | None:
    """At most one, or exactly one step in the region, the multipliers with y of one sign there put in."""
    rest = substitute_held_rows(at)
    one = _best_proof(rest, regular)
    if one is not None and len(rest.names) < len(at.names):
        held = [name for name in at.names if name not in rest.names]
        return one._replace(how=f"y has one sign in all steps from the region for {', '.join(held)}; {one.how}", local=True)
    return one


def _best_proof(at: SystemLinearisation, regular: bool) -> UniquenessProof | None:
    """The better answer of two forms."""
    one = prove_unique_paired(at, regular)
    return one if one is not None and one.exists else prove_unique_on_region(at, regular) or one


def _smooth_uniqueness(hypothesis: Hypothesis, at: SystemLinearisation, regular: Finding, quick: bool) -> Finding:
    if at.affine and regular.verdict == HOLDS:
        return make_finding(
            hypothesis, HOLDS, "A linear system with a regular matrix.", {"solutions": 1}, scope=at.scope(local=False)
        )
    if at.jump is not None:
        return make_finding(hypothesis, UNKNOWN, JUMP_TEXT)
    one = None if quick else prove_unique_on_region(at, regular.verdict == HOLDS)
    if one is not None and one.exists:
        return make_finding(
            hypothesis, HOLDS, f"{one.how[0].upper()}{one.how[1:]}.", {"solutions": 1}, scope=at.scope(local=one.local)
        )
    if regular.verdict == HOLDS:
        how = "W is regular over the region: solutions are isolated. That there is just one is seen along the run only."
        return make_finding(hypothesis, SAMPLED, how, {"solutions": 1}, scope=at.scope())
    return make_finding(hypothesis, UNKNOWN, "the step is nonlinear, and W is not proved to be regular")


# -- for every state ------------------------------------------------------------------------------------------------------


def _constant_uniqueness(hypothesis: Hypothesis, at: SystemLinearisation, mlcp_finding: Finding, quick: bool) -> Finding | None:
    """Every state and each step length that occurs, where the Jacobians are constant; None where that settles nothing."""
    try:
        domains.domains_of_law(at.model.law, np.zeros((at.model.law.size,) * 2))
    except domains.EmptyDomain:
        return None
    if len(at.steps) > MAX_DECIDED_STEPS:
        reason = _uniqueness_reason_for_all_steps(at)
        return _unique_finding(hypothesis, at, f"{reason} {_steps_text(at)}") if reason else None
    lengths = [float(h) for h in at.steps]
    reasons = [_uniqueness_reason(at, h) for h in lengths]
    if all(reasons):
        return _unique_finding(hypothesis, at, reasons[0])
    if (one := prove_unique_paired(at, True)) is not None and one.exists:
        return _unique_finding(hypothesis, at, one.how)
    if not at.model.law.is_box:
        return None
    several = [step for step in (affine_step(at, h) for h in lengths) if step is not None]
    if quick or len(several) < len(lengths) or not several[0].few:
        return None
    finding = _exact_uniqueness(hypothesis, at, several)
    if finding is None:
        finding = _search_finding(hypothesis, at)
    if finding.verdict in (HOLDS, VIOLATED):
        return finding
    if most := _at_most_one_reason(at, several[-1]):
        how = f"{most[0].upper()}{most[1:]}; whether one exists for every state is not decided."
        return make_finding(hypothesis, UNKNOWN, how, {"solutions": 1})
    how = f"All index sets tried at {2 * STATE_SAMPLES} states: one solution each, as far as the signs are clear."
    if mlcp_finding.verdict == SAMPLED:
        how += " W_mlcp is psd up to rounding only (F-mlcp)."
    return make_finding(hypothesis, SAMPLED, how, {"solutions": 1}, scope=at.scope(local=False))


def _unique_finding(hypothesis: Hypothesis, at: SystemLinearisation, why: str) -> Finding:
    return make_finding(hypothesis, HOLDS, f"{why[0].upper()}{why[1:]}.", {"solutions": 1}, scope=at.scope(local=False))


def _exact_uniqueness(hypothesis: Hypothesis, at: SystemLinearisation, several: Sequence[AffineStep]) -> Finding | None:
    """What rational arithmetic decides of the steps, of the longest first; None where it does not."""
    reasons = []
    for step in reversed(several):
        most = _at_most_one_reason(at, step)
        counterexample = None if most else find_counterexample(step)
        if counterexample is not None:
            return _counterexample_finding(hypothesis, at, step, counterexample)
        if not most and is_solution_unique(step):
            most = "no two index sets give different x from one state, by linear programs (exact)"
        exists = _existence_reason(step) if most else None
        if isinstance(exists, InfeasibleState):
            return _infeasible_finding(hypothesis, at, step, exists)
        reasons.append(f"{most}; {exists}" if exists else "")
    return _unique_finding(hypothesis, at, reasons[0]) if all(reasons) else None


def _existence_reason(step: AffineStep) -> str | InfeasibleState:
    """Why a step exists for every state of a psd W_mlcp, or one that moves no x; a state without one; '' where undecided."""
    if np.isfinite(step.upper - step.lower).all():
        return "K is bounded"
    answer = decide_solvability(step) if exact.definiteness(step.W).psd else None
    if isinstance(answer, InfeasibleState):
        return answer
    return "every state is feasible, by Farkas' alternative, and W_mlcp psd: one exists (exact)" if answer else ""


def _step_witness(at: SystemLinearisation, step: AffineStep, x: np.ndarray) -> dict[str, object]:
    """The state of a step."""
    near = exact.doubles(x).ravel()
    witness: dict[str, object] = {"t": step.t, "x_k": near}
    if (exact.rational(near) != x.ravel()).any():
        witness["x_k exactly"] = [str(entry) for entry in x.ravel()]
    if step.r is not None:
        witness["r_k"] = exact.doubles(exact.matrix_product(step.r[0], x) + step.r[1]).ravel()
    return {**witness, "h": step.h}


def _counterexample_finding(
    hypothesis: Hypothesis, at: SystemLinearisation, step: AffineStep, counterexample: StepCounterexample
) -> Finding:
    witness = _step_witness(at, step, counterexample.x)
    if not counterexample.pair:
        how = f"No solution of the step from this state: none of the {len(step.sets)} index sets gives one (exact)."
        return make_finding(hypothesis, VIOLATED, how, {"solutions": 0}, witness)
    for name, l in zip(("", "other "), counterexample.pair, strict=True):
        witness |= {f"{name}x": exact.doubles(step.next(counterexample.x, l)).ravel(), f"{name}l": exact.doubles(l).ravel()}
    how = "Two solutions of one step from this state, both verified in rational arithmetic."
    return make_finding(hypothesis, VIOLATED, how, {"solutions": counterexample.count}, witness)


def _infeasible_finding(hypothesis: Hypothesis, at: SystemLinearisation, step: AffineStep, answer: InfeasibleState) -> Finding:
    witness = {**_step_witness(at, step, answer.x), "v": exact.doubles(answer.v).ravel()}
    how = "No solution of the step from this state: v'y < 0 for all l in K, where v'y >= 0 is needed (exact)."
    return make_finding(hypothesis, VIOLATED, how, {"solutions": 0}, witness)


def _uniqueness_reason(at: SystemLinearisation, h: float) -> str:
    if at.definite_mlcp(h) is not None:
        return DEFINITE
    W = at.exact_mlcp(h)
    if W is None:
        return ""
    law, definite = at.model.law, exact.definiteness(W)
    if definite.definite:
        return DEFINITE
    if not definite.psd:
        if law.is_box:
            return "W_mlcp is a P-matrix (exact), and K a box" if decide_p_matrix(W)[0] else ""
        return "W_mlcp has a determinant > 0 on every face of K (exact)" if is_coherently_oriented(law, W) else ""
    if not _is_kernel_contained(W, at):
        return ""
    if is_range_whole_space(law, W):
        return "W_mlcp is psd, its kernel moves no x, and R(W_mlcp + N_K) is the whole space (exact); l may not be unique"
    return ""


def _uniqueness_reason_for_all_steps(at: SystemLinearisation) -> str:
    """The same at all step lengths from the least to the largest."""
    kind, W = at.mlcp_kind, at.exact_mlcp(float(at.steps.max()))
    if kind == "positive definite" or (kind == "a P-matrix" and at.model.law.is_box):
        return f"W_mlcp is {kind}{', and K a box,' if kind == 'a P-matrix' else ''}"
    bounded = bool(domains.unrestricted_outputs(at.model.law).all())
    if kind == "positive semidefinite" and bounded and W is not None and _is_kernel_contained(W, at):
        return "W_mlcp is psd, its kernel moves no x, and K is bounded"
    return ""


def _steps_text(at: SystemLinearisation) -> str:
    return f"at all step lengths from {at.steps.min():.4g} to {at.steps.max():.4g} (exact)"


def _is_kernel_contained(W: np.ndarray, at: SystemLinearisation) -> bool:
    """Whether ker(W + W') lies in ker B: two solutions l have the same B l."""
    S = W + W.T
    return exact.rank(np.vstack([S, exact.rational(constant_matrix_values(at.jacobians.B))])) == exact.rank(S)


def _at_most_one_reason(at: SystemLinearisation, step: AffineStep) -> str:
    """Why there is at most one x for every state; empty where that is not proved."""
    if not step.X_l.any():
        return "l moves no x"
    if exact.definiteness(step.W).psd and _is_kernel_contained(step.W, at):
        return "W_mlcp is psd and its kernel moves no x (exact): at most one solution"
    return ""


# -- at some states -------------------------------------------------------------------------------------------------------


def _search_finding(hypothesis: Hypothesis, at: SystemLinearisation) -> Finding:
    """Two solutions of the longest step that are proved, or that none were found."""
    h = float(at.steps.max())
    searched = two_solutions.search_two_solutions(at, h)
    if searched is None:
        why = f"more than {two_solutions.MAX_STEP_MODES} index sets"
        return make_finding(hypothesis, UNKNOWN, f"W_mlcp does not settle it, and {why}")
    if searched.two is None:
        how = f"All index sets tried at states of {at.along} and on switching surfaces: never two solutions; the step map has "
        how += f"{'both orientations' if searched.orientations_differ else 'one orientation'} at {searched.points} points."
        return make_finding(hypothesis, SAMPLED, how, {"solutions": 1}, scope=at.scope())
    two = searched.two
    witness: dict[str, object] = {"t": two.t, "x_k": two.x_k, **({} if two.r_k is None else {"r_k": two.r_k}), "h": h}
    for name, (x, l) in zip(("", "other "), (two.first, two.other), strict=True):
        witness |= {f"{name}x": x, f"{name}l": l}
    how = "Two solutions of one step from this state, each proved by Krawczyk's operator in interval arithmetic."
    return make_finding(hypothesis, VIOLATED, how, {"solutions": 2}, witness)


# States and multipliers up to which W^{-1} is written out: bounds of what is longer are too wide to show a sign.
MAX_INVERSE_SIZE = 4
DEFINITE = "W_mlcp is positive definite (exact)"
# A scaled eigenvalue or minor below minus this is no rounding: numbers of a model may be rounded by a few EPS.
MLCP_MARGIN = 1e-9


def mlcp_solvability(hypothesis: Hypothesis, at: SystemLinearisation, regular: str, quick: bool) -> Finding:
    """Decide F-mlcp; ``regular`` is the verdict about W."""
    m = at.model.law.size
    if not m:
        return make_finding(
            hypothesis, HOLDS, "There are no multipliers: no complementarity problem has to be solved.", {"rows": 0}
        )
    if not at.model.law.is_normal_cone:
        return make_finding(hypothesis, UNKNOWN, NO_NORMAL_CONE)
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
    for h in at.steps[-MAX_DECIDED_STEPS:]:
        near = at.definite_mlcp(float(h))
        W = at.exact_mlcp(float(h)) if near is None else None
        if near is None and W is None:
            return make_finding(hypothesis, UNKNOWN, f"W is singular at h = {h:g} (F-W)")
        value = _mlcp_measures(not_none(near) if W is None else exact.doubles(W))
        if (change := change_at_step(at.M, at.exact_G(), float(h))) >= 1:
            how = "W is regular by rounding only (F-W), and W_mlcp known no better than that."
            return make_finding(hypothesis, SAMPLED, how, value | {ROUNDING_LABEL: change}, {"h": h})
        if W is None:
            kinds.add("positive definite")
            continue
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
    if len(at.steps) > MAX_DECIDED_STEPS and at.mlcp_kind:
        return make_finding(hypothesis, HOLDS, f"W_mlcp is constant and {at.mlcp_kind} {_steps_text(at)}.", value)
    if len(at.steps) > MAX_DECIDED_STEPS:
        how = f"W_mlcp is {which} at the {MAX_DECIDED_STEPS} longest of {len(at.steps)} step lengths (exact)."
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
