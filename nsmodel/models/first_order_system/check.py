"""Hypotheses of theta-gamma stepping with Newton's method and a complementarity problem a step (Siconos developer's notes).

    W = M - h theta A - h gamma K,     W_mlcp = h gamma C W^{-1} B + D,     A = f_x, K = g_x, B = g_l, C = h_x, D = h_l

Where these matrices do not change with t, x and l, all is decided in exact rational arithmetic on their doubles, everywhere.
Otherwise W is bounded over the region, with l in K (or in a box around the run where K is not bounded), and the rest is looked
at along the run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import (
    HOLDS,
    SAMPLED,
    UNKNOWN,
    VIOLATED,
    Consequence,
    Finding,
    Hypothesis,
    make_consequence,
    make_finding,
)
from nsmodel.hypotheses.region import Region
from nsmodel.models.first_order_system import unique_step
from nsmodel.models.first_order_system.linearisation import SystemLinearisation, constant_matrix_values, linearise_system
from nsmodel.models.first_order_system.model import FirstOrderSystem
from nsmodel.models.first_order_system.step_matrix import (
    MATRIX_ROUNDING,
    ROUNDING_LABEL,
    change_at_step,
    change_by_rounding,
    least_singular_step,
    regular_steps,
)
from nsmodel.models.first_order_system.unique_step import mlcp_solvability
from nsmodel.proof import exact, interval_bounds
from nsmodel.proof.exact import MACHINE_EPSILON
from nsmodel.proof.expression_graph import operation_codes
from nsmodel.proof.extremum import distance_to_inverse, spectral_norm
from nsmodel.proof.global_search import searches_are_quick
from nsmodel.simulation.trajectory import Trajectory

SICONOS_NOTES = "Siconos developer's notes"
F_JACOBIANS = Hypothesis(
    "F-jacobians", "the Jacobians A, C, D, K, B are those of f, h and g", f"{SICONOS_NOTES}, Newton's linearization"
)
F_W = Hypothesis("F-W", "W = M - h theta A - h gamma K is regular", f"{SICONOS_NOTES}, linearization of the first line")
F_MLCP = Hypothesis(
    "F-mlcp",
    "W_mlcp = h gamma C W^-1 B + D is positive semidefinite or a P-matrix",
    f"{SICONOS_NOTES}, linearization of the third line",
)
F_UNIQUE = Hypothesis(
    "F-unique", "the one-step problem has one and only one solution x_{k+1}", f"{SICONOS_NOTES}, one-step problem"
)
F_STEP = Hypothesis("F-step", "h < h*, the least step at which W is singular", f"{SICONOS_NOTES}: W is regular for small h")
HYPOTHESES = (F_JACOBIANS, F_W, F_MLCP, F_UNIQUE, F_STEP)
KINK_OPERATION_NAMES = {
    ca.OP_FABS: "fabs", ca.OP_FMAX: "fmax", ca.OP_FMIN: "fmin", ca.OP_SIGN: "sign", ca.OP_IF_ELSE_ZERO: "if_else",
    ca.OP_FLOOR: "floor", ca.OP_CEIL: "ceil",
}  # fmt: skip
BY_ROUNDING = "Regular by rounding only: a change of the entries of M and G by 64 eps of themselves can make W singular."
# A difference quotient further off than this part of the Jacobian's largest entry is no rounding: without kinks 1e-11 is usual.
DIFFERENCE_TOLERANCE = 1e-4
OTHER_STEPS_TEXT = "Of the steps, multipliers and rows of the run it is not proved apart from that."
# Different step lengths that are decided one by one, each by elimination of rational numbers; of more the finding is sampled.
MAX_EXACT_STEPS = 50


def check(
    model: FirstOrderSystem, region: Region, runs: Sequence[Trajectory], quick: bool
) -> tuple[list[Finding], list[Consequence]]:
    """Decide the hypotheses of the class and say what follows; the model is bound.

    Args:
        model: with numbers for its parameters.
        region: states and times of what is not decided everywhere.
        runs: finished runs of this model.
        quick: no search for the worst point of the region, no enumeration of solutions.
    """
    if empty := _empty_law_findings(model):
        return empty, first_order_consequences(model, False, empty, runs)
    at = linearise_system(model, region, runs)
    findings = _decide(at, quick)
    if runs and any(finding.verdict in (SAMPLED, UNKNOWN) for finding in findings):
        findings = keep_proofs(findings, _decide(linearise_system(model, region, ()), quick))
    return findings, first_order_consequences(at.model, at.affine, findings, runs) if at.steps.size else []


def _empty_law_findings(model: FirstOrderSystem) -> list[Finding]:
    """What is said where the ends of an interval of K cross: no step has a solution."""
    ends = [
        np.concatenate([np.zeros(0), *parts]) for parts in zip(*(block.bounding_box() for block in model.law.blocks), strict=True)
    ]
    crossed = [name for name, low, up in zip(model.multiplier_names, *ends, strict=True) if low > up] if ends else []
    if not crossed:
        return []
    k = model.multiplier_names.index(crossed[0])
    witness = {"multiplier": crossed[0], "lower": ends[0][k], "upper": ends[1][k]}
    how = f"K is empty: the ends of {', '.join(crossed)} cross"
    return [
        make_finding(F_UNIQUE, VIOLATED, how, {"solutions": 0}, witness)
        if hypothesis is F_UNIQUE
        else make_finding(hypothesis, UNKNOWN, how)
        for hypothesis in HYPOTHESES
    ]


def _decide(at: SystemLinearisation, quick: bool) -> list[Finding]:
    """One finding a hypothesis."""
    if not at.steps.size:
        why = "no time step: give the model step= or steps="
        return [_check_jacobians(at), *(make_finding(hypothesis, UNKNOWN, why) for hypothesis in (F_W, F_MLCP, F_UNIQUE, F_STEP))]
    step = _check_step_limit(at, quick)
    regular = _check_regularity(at, step, quick)
    mlcp = mlcp_solvability(F_MLCP, at, regular.verdict, quick)
    return [
        _check_jacobians(at),
        regular,
        mlcp,
        unique_step.step_uniqueness(F_UNIQUE, at, regular, mlcp, quick or searches_are_quick()),
        step,
    ]


def keep_proofs(findings: Sequence[Finding], before: Sequence[Finding]) -> list[Finding]:
    """The findings, which runs take part in, but for those that are decided ``before``, without runs, alone."""
    decided = {finding.id: finding for finding in before if finding.verdict in (HOLDS, VIOLATED)}
    return [
        replace(decided[finding.id], how=f"{decided[finding.id].how} {OTHER_STEPS_TEXT}")
        if finding.id in decided and finding.verdict in (SAMPLED, UNKNOWN)
        else finding
        for finding in findings
    ]


# -- F-jacobians ----------------------------------------------------------------------------------------------------------


def _check_jacobians(at: SystemLinearisation) -> Finding:
    """Algorithmic differentiation is exact but at kinks; difference quotients show it."""
    if at.defined.verdict != HOLDS:
        what = "has no finite value for all times" if at.defined.verdict == VIOLATED else "is not seen to have finite values"
        how = f"f, h or g {what}: {at.defined.how}."
        value = {"t": at.defined.at} if at.defined.at is not None else {}
        return make_finding(F_JACOBIANS, at.defined.verdict, how, value, value)
    if at.affine:
        how = "f, h and g are affine in x and l, their Jacobians read off: one Newton iteration is exact."
        return make_finding(
            F_JACOBIANS, HOLDS, how, {"entries": sum(J.numel() for J in at.jacobians)}, scope=at.scope(local=False)
        )
    if at.jump is not None:
        how = "f, h or g jumps at this point and has no Jacobian there; write the jump as a law, such as a relay."
        witness = {**at.at(at.jump.at), "f, h, g on one side": at.jump.below, "on the other": at.jump.above}
        return make_finding(F_JACOBIANS, VIOLATED, how, {"jump": at.jump.size}, witness)
    kinks = kink_names(at.model)
    worst, where = _worst_difference_quotient(at, bool(kinks))
    value = {"relative difference": worst}
    if worst > DIFFERENCE_TOLERANCE and kinks:
        how = f"A difference quotient disagrees: near this point {', '.join(kinks)} has a kink, and Newton's method may stall."
        return make_finding(F_JACOBIANS, VIOLATED, how, value, where, at.scope())
    if worst > DIFFERENCE_TOLERANCE:
        how = "A difference quotient disagrees with algorithmic differentiation, though f, h and g have no kink."
        return make_finding(F_JACOBIANS, UNKNOWN, how, value, where, at.scope())
    how = f"Algorithmic differentiation is exact; difference quotients at {at.along} agree to this part of the largest entry"
    how += f" (at a kink of {', '.join(kinks)} it gives one of the one-sided derivatives)." if kinks else "."
    if not kinks and interval_bounds.is_continuous(ca.veccat(*at.jacobians), at.z, at.lower, at.upper):
        how = how[:-1] + f", and the Jacobians are continuous on {at.where}."
        return make_finding(F_JACOBIANS, HOLDS, how, value, where, at.scope())
    return make_finding(F_JACOBIANS, SAMPLED, how, value, where, at.scope())


def kink_names(model: FirstOrderSystem) -> list[str]:
    """Names of the operations in f, h and g that have kinks or jumps."""
    return sorted(
        KINK_OPERATION_NAMES[op] for op in operation_codes(ca.vertcat(model.f, model.h, model.g)) if op in KINK_OPERATION_NAMES
    )


def _worst_difference_quotient(at: SystemLinearisation, one_sided: bool) -> tuple[float, dict[str, Any]]:
    """The worst difference beside the largest entry of its row, units taken out, and where; a kink shows from one side only."""
    stacked = ca.vertcat(at.model.f, at.model.h, at.model.g)
    values = ca.Function("values", [at.z], [ca.densify(stacked)])
    exactly = ca.Function("exactly", [at.z], [ca.densify(ca.jacobian(stacked, at.z[1:]))])
    span = np.where(np.isfinite(at.upper - at.lower), at.upper - at.lower, 0.0)
    worst, where = 0.0, {}
    sizes = np.maximum(np.abs(at.points), 0.1 * span)[:, 1:]
    deltas = MACHINE_EPSILON ** (1 / 2 if one_sided else 1 / 3) * np.where(sizes > 0, sizes, 1.0)
    slopes = np.abs(np.array([np.array(exactly(point)) * delta for point, delta in zip(at.points, deltas, strict=True)]))
    typical = np.where(np.isfinite(slopes), slopes, 0.0).max(axis=(0, 2))[:, None]  # where a slope is 0 by chance
    for point, delta in zip(at.points, deltas, strict=True):
        moves = np.vstack([np.zeros(len(delta)), np.diag(delta)])
        ahead, here, behind = (np.array(values.map(len(delta))(point[:, None] + k * moves)) for k in (1, 0, -1))
        J = np.array(exactly(point)) * delta
        changes = [ahead - here, here - behind] if one_sided else [(ahead - behind) / 2]
        largest = typical + np.maximum(*map(np.abs, (ahead - here, here - behind))).max(axis=1, keepdims=True)
        for change in changes:
            off = np.maximum(np.abs(change - J) - 8 * MACHINE_EPSILON * np.maximum(np.abs(ahead), np.abs(behind)), 0)
            if not np.isfinite(off).all():
                continue
            part = off / np.where(largest > 0, largest, np.inf)
            i, j = np.unravel_index(int(part.argmax()), part.shape)
            if part[i, j] > worst or not where:
                worst = float(part[i, j])
                where = {**at.at(point), "entry": _entry_name(at, int(i), int(j)), "exact": J[i, j] / delta[j]}
                where["quotient"] = change[i, j] / delta[j]
    return worst, where


def _entry_name(at: SystemLinearisation, row: int, column: int) -> str:
    n, m = len(at.model.names), at.model.lam.numel()
    name = f"f[{row}]" if row < n else f"h[{row - n}]" if row < n + m else f"g[{row - n - m}]"
    return f"d {name} / d {at.names[column + 1]}"


# -- F-step and F-W -------------------------------------------------------------------------------------------------------


def _check_step_limit(at: SystemLinearisation, quick: bool) -> Finding:
    """h < h*: exactly where A and K are constant, else by a bound of the norm over the region."""
    h = float(at.steps.max())
    if not at.is_W_constant:
        return _step_limit_by_norm(at, h, quick)
    steps = regular_steps(at.M, at.exact_G(), h)
    value = {"h": h, "h*": steps.least}
    change = change_by_rounding(at.M, at.exact_G(), h)
    if steps.regular and change >= 1:
        return make_finding(F_STEP, SAMPLED, BY_ROUNDING, value | {ROUNDING_LABEL: change})
    if steps.regular:
        how = "Exactly: A and K are constant, and det(M - s (theta A + gamma K)) has no root 0 < s <= h."
        return make_finding(F_STEP, HOLDS, how, value)
    witness = {"null vector at h*": steps.vector} if steps.vector is not None else {}
    if steps.regular is None:
        why = "M is singular" if exact.rank(at.M) < len(at.M) else "there are too many states to count the roots exactly"
        verdict = SAMPLED if h < 0.99 * steps.least else VIOLATED if h > 1.01 * steps.least else UNKNOWN
        return make_finding(
            F_STEP, verdict, f"A and K are constant, but {why}: h* by eigenvalues in floating point.", value, witness
        )
    if change >= 1 and exact.rank(at.exact_W(h)) == len(at.M):
        before = regular_steps(at.M, at.exact_G(), h * (1 - MATRIX_ROUNDING)).regular
        if before:
            how = "Exactly, on these doubles, h* <= h: by less than rounding (64 eps)."
            return make_finding(F_STEP, SAMPLED, how, value | {ROUNDING_LABEL: change}, witness)
    how = "Exactly: det(M - s (theta A + gamma K)) has a root 0 < s <= h: a growing mode of the system is stepped over."
    return make_finding(F_STEP, VIOLATED, how, value, witness or {"h": h})


def _step_limit_by_norm(at: SystemLinearisation, h: float, quick: bool) -> Finding:
    """h |M^{-1} (theta A + gamma K)| < 1 over the region is enough; else h* at the points."""
    inverse = exact.inverse_matrix(at.M)
    if inverse is None:
        return make_finding(F_STEP, UNKNOWN, "M is singular, and A and K are not constant")
    product = ca.DM(exact.doubles(inverse)) @ at.G
    sup = spectral_norm(product, at.z, at.lower, at.upper, points=at.points, quick=quick, bound_to=0.99 / h, bound_alone=True)
    value = {"h": h, "h* is at least": 1 / sup.bound if sup.bound else np.inf}
    # M^{-1} is rounded: 1e-9 of room is far more than that, unless M is nearly singular.
    if h * sup.bound < 1 - 1e-9 and np.linalg.cond(exact.doubles(at.M)) < 1e6:
        how = f"h |M^-1 (theta A + gamma K)| <= {h * sup.bound:.3g} < 1 on {at.where} (interval arithmetic)."
        return make_finding(F_STEP, HOLDS, how, value, scope=at.scope())
    factor = None if (inverse == exact.eye(len(inverse))).all() else inverse
    local = [_singular_step_at_point(factor, G) for G in at.values(at.G)[:: max(1, len(at.points) // 20)]]
    k = int(np.argmin([least for least, _ in local]))
    least, vector = local[k]
    value["h* at the points"] = least
    how = f"No bound of |M^-1 (theta A + gamma K)| on {at.where} stays below 1/h; h* at {len(local)} points of {at.along}."
    if least <= h * (1 - 1e-9):
        point = at.points[:: max(1, len(at.points) // 20)][k]
        return make_finding(F_STEP, VIOLATED, how, value, {**at.at(point), "null vector at h*": vector})
    return make_finding(F_STEP, SAMPLED, how, value, scope=at.scope())


def _singular_step_at_point(inverse: np.ndarray | None, G: np.ndarray) -> tuple[float, np.ndarray | None]:
    """H* at one point and a null vector, from M^{-1} (None: the unit matrix); 0 where G is not finite."""
    if not np.isfinite(G).all():
        return 0.0, None
    return least_singular_step(G + 0.0 if inverse is None else exact.doubles(exact.matrix_product(inverse, G)))


def _check_regularity(at: SystemLinearisation, step: Finding, quick: bool) -> Finding:
    """W regular: for every step length where all is constant, else over the region."""
    h = float(at.steps.max())
    W = constant_matrix_values(at.model.M) - h * at.values(at.G)
    finite = W[np.isfinite(W).all(axis=(1, 2))]
    spectra = np.linalg.svd(finite, compute_uv=False) if finite.size else np.ones((1, 1))
    relative = np.divide(spectra[:, -1], spectra[:, 0], out=np.zeros(len(spectra)), where=spectra[:, 0] > 0)
    k = int(np.argmin(relative))
    value = {"condition": _condition_number(spectra[k]), "least singular value": spectra[:, -1].min()}
    if step.verdict == HOLDS:
        return make_finding(F_W, HOLDS, f"By F-step: {step.how}", value, scope=step.scope)
    if at.is_W_constant:
        return _regularity_at_each_step(at, value)
    centre = np.median(finite, axis=0)
    inside = ((at.points >= at.lower) & (at.points <= at.upper)).all(axis=1) & np.isfinite(W).all(axis=(1, 2))
    if np.linalg.cond(centre) < 1e6 and len(at.steps) == 1 and _largest_change(centre, W[inside]) < 1:
        bound = _largest_change_bound(at, np.linalg.inv(centre), h, quick)
        if bound < 1 - 1e-9:
            how = f"|W_0^-1 W - I| <= {bound:.3g} < 1 on {at.where}, W_0 its median along the run (interval arithmetic)."
            return make_finding(F_W, HOLDS, how, value, scope=at.scope())
    signs = np.linalg.slogdet(finite)[0]
    clear = relative > 1e-9
    if {-1, 1} <= set(signs[clear]) and len(finite) == len(W) and interval_bounds.is_continuous(at.G, at.z, at.lower, at.upper):
        ends = [at.points[clear][np.flatnonzero(signs[clear] == sign)[0]] for sign in (1, -1)]
        how = f"det W is continuous on {at.where}, > 0 at one of these points and < 0 at the other: it vanishes between them."
        return make_finding(F_W, VIOLATED, how, value, {"names": at.names, "det > 0": ends[0], "det < 0": ends[1]})
    how = f"Smallest at {at.along}; no bound over the region proves it."
    return make_finding(F_W, SAMPLED if len(finite) == len(W) else UNKNOWN, how, value, at.at(at.points[k]), at.scope())


def _largest_change(centre: np.ndarray, W: np.ndarray) -> float:
    """The largest |W_0^-1 W - I| at the points, in floating point: no bound over the region is below it."""
    changes = np.linalg.inv(centre) @ W - np.eye(len(centre))
    return float(np.linalg.norm(changes, 2, axis=(1, 2)).max(initial=0.0))


def _largest_change_bound(at: SystemLinearisation, inverse: np.ndarray, h: float, quick: bool) -> float:
    """A bound of |W_0^-1 W - I| on the region: by the entries of W, and where they are too wide, by those of the product."""
    W = ca.SX(at.model.M - h * at.G)
    bound = distance_to_inverse(inverse, W, at.z, at.lower, at.upper)
    if bound < 1 - 1e-9:
        return bound
    change = ca.DM(inverse) @ W - ca.SX.eye(len(inverse))
    return spectral_norm(change, at.z, at.lower, at.upper, points=at.points, quick=quick, bound_to=0.99, bound_alone=True).bound


def _condition_number(spectrum: np.ndarray) -> float:
    return float(spectrum[0] / spectrum[-1]) if spectrum[-1] else np.inf


def _regularity_at_each_step(at: SystemLinearisation, value: dict[str, float]) -> Finding:
    """Constant W, h past h* or h* not known: rank by exact elimination, one step length after the other."""
    for h in at.steps[:MAX_EXACT_STEPS]:
        W = at.exact_W(float(h))
        null = exact.nullspace(W)
        if null.shape[1]:
            how = "Exactly: W is singular at this step length."
            return make_finding(F_W, VIOLATED, how, value, {"h": h, "null vector": exact.doubles(null[:, 0])})
    G = at.exact_G()
    change, h = max((change_at_step(at.M, G, float(h)), float(h)) for h in at.steps[:MAX_EXACT_STEPS])
    if change >= 1:
        return make_finding(F_W, SAMPLED, BY_ROUNDING, value | {ROUNDING_LABEL: change}, {"h": h})
    if len(at.steps) <= MAX_EXACT_STEPS:
        return make_finding(F_W, HOLDS, "Exactly: W is constant, and regular at each step length that occurs.", value)
    return make_finding(F_W, SAMPLED, f"Regular at {MAX_EXACT_STEPS} of {len(at.steps)} step lengths (exact).", value)


# -- what follows ---------------------------------------------------------------------------------------------------------


def first_order_consequences(
    model: FirstOrderSystem, affine: bool, findings: Sequence[Finding], runs: Sequence[Trajectory]
) -> list[Consequence]:  # fmt: skip
    """What follows from the findings; ``affine``: whether f, h and g are, in x and l."""
    theta, gamma = model.theta, model.gamma
    step = {finding.id: finding for finding in findings}["F-step"].value
    out = [
        make_consequence(
            "one trajectory", "every step is defined, and the scheme gives one trajectory", findings, ["F-unique"], SICONOS_NOTES,
        ),
        make_consequence(
            "W for smaller steps", "W stays regular for every smaller step", findings, ["F-step"], SICONOS_NOTES,
            {name: number for name, number in step.items() if name.startswith("h*")},
        ),
    ]  # fmt: skip
    iterations = _max_newton_iterations(runs)
    if affine:
        statement = "f, h and g are affine in x and l: one Newton iteration is exact"
        out.append(
            make_consequence("one Newton iteration", statement, findings, ["F-jacobians", "F-W"], SICONOS_NOTES, iterations)
        )
    else:
        statement = "Newton's method converges quadratically from near enough, on the right index set"
        out.append(
            make_consequence(
                "Newton's method", statement, findings, ["F-jacobians", "F-W", "F-unique"], SICONOS_NOTES, iterations
            )
        )
    order = 2 if theta == 0.5 and (gamma == 0.5 or not model.law.size) else 1
    where = "in smooth phases" if model.law.size else "everywhere"
    statement = f"order {order} {where} (theta = {theta:g}, gamma = {gamma:g})"
    if theta == 0.5 and gamma != 0.5 and model.law.size:
        statement += ", 2 where r is constant"
    statement += "; at most 1 across switches" if model.law.size else ""
    out.append(
        make_consequence(
            "order",
            statement,
            findings,
            ["F-jacobians", "F-W", "F-unique"],
            "consistency of the theta-gamma scheme",
            {"order": order},
        )
    )
    return out


def _max_newton_iterations(runs: Sequence[Trajectory]) -> dict[str, float]:
    """The most Newton iterations of a step, where the runs tell."""
    counts = [run.arrays["newton"][1:] for run in runs if "newton" in run.arrays and len(run.t) > 1]
    most = max((float(np.nanmax(count)) for count in counts if np.isfinite(count).any()), default=None)
    return {} if most is None else {"most iterations in a run": most}
