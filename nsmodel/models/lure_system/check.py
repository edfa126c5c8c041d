"""Multivalued Lur'e systems (Brogliato and Goeleven 2013): all hypotheses, what follows from them, two runs compared.

Two runs of a Lur'e system with the same signals stay as near as they should: f cancels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

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
    intersect_scopes,
    make_consequence,
    make_finding,
)
from nsmodel.hypotheses.region import Region
from nsmodel.models.lure_system import large_systems, range_condition
from nsmodel.models.lure_system.hypomonotone import HYPOMONOTONE, P_OMEGA, HypomonotoneBound, hypomonotone
from nsmodel.models.lure_system.model import LureSystem
from nsmodel.models.lure_system.passivity import (
    D_PSD_HYPOTHESIS,
    LURE_PAPER,
    STORAGE_HYPOTHESIS,
    decide_input_output,
    decide_storage,
)
from nsmodel.proof import exact, interval_bounds
from nsmodel.proof.domain import DefinednessResult, check_defined_in_time, is_absolutely_continuous
from nsmodel.proof.exact import MACHINE_EPSILON
from nsmodel.proof.storage_matrix import rational_cholesky
from nsmodel.simulation.trajectory import Trajectory

_HYPOTHESES_BY_ID = {
    hypothesis.id: hypothesis
    for hypothesis in (D_PSD_HYPOTHESIS, STORAGE_HYPOTHESIS, HYPOMONOTONE, *range_condition.RANGE_HYPOTHESES)
}
REPORT_ORDER = ("3.1", "4.1", "5.1", "5.2", "5.4a", "5.4b", "5.4c", "5.x0", "7.1")
HYPOTHESES = tuple(_HYPOTHESES_BY_ID[id] for id in REPORT_ORDER)
CONTRACTION_HYPOTHESIS = Hypothesis(
    "run-contraction", "|x(t) - y(t)|_P <= e^{omega t} |x_0 - y_0|_P for two runs", f"{LURE_PAPER}, (40)"
)
MONOTONE_PREMISES = ("3.1", "4.1", "5.1", "5.2", "5.4a", "5.4b", "5.4c")


def check(model: LureSystem, region: Region, runs: Sequence[Trajectory], quick: bool) -> tuple[list[Finding], list[Consequence]]:
    """Return a finding for each of HYPOTHESES, and what follows.

    Args:
        model: bound.
        region: where A' is bounded, where it is not bounded everywhere.
        runs: where there are two from different starts, their distance is compared with (40).
        quick: no searches, no semidefinite programs.
    """
    if large_systems.is_large(model):
        growth, ordered = large_systems.structural_findings(model)
        return list(ordered), lure_consequences(model, region, growth, ordered)
    B, C, D = (np.array(ca.DM(matrix)).reshape(matrix.shape) for matrix in (model.B, model.C, model.D))
    passivity = decide_storage(B, C)
    growth = hypomonotone(model, passivity, region, quick)
    own = [decide_input_output(D), passivity.finding, growth.finding]
    others = range_condition.range_findings(model, quick)
    findings = {finding.id: finding for finding in [*own, *others]}
    ordered = [findings[id] for id in REPORT_ORDER]
    made = lure_consequences(model, region, growth, ordered)
    if len(runs) > 1 and growth.P is not None and np.isfinite(growth.omega):
        ordered.append(compare_contraction(model, growth.P, growth.omega, *runs[:2]))
    return ordered, made


def lure_consequences(
    model: LureSystem, region: Region, growth: HypomonotoneBound, findings: Sequence[Finding]
) -> list[Consequence]:  # fmt: skip
    """What follows from the findings, the growth that of 5.2."""
    here = "" if growth.everywhere else " while both stay inside the box"
    norm = ", P the P_omega of 5.2" if growth.P is not None else ", P that of 5.1"
    texts = _forcing_regularity_reason(model, region)
    well = make_consequence(
        "well posed",
        f"one and only one solution starts at x0{texts}",
        findings,
        (*MONOTONE_PREMISES, "5.x0"),
        f"{LURE_PAPER}, Corollary 5.7",
    )
    contraction = make_consequence(
        "contraction", f"|x(t) - y(t)|_P <= e^(omega t) |x_0 - y_0|_P for any two solutions{here}{norm}", findings,
        MONOTONE_PREMISES, f"{LURE_PAPER}, (40)", {"omega": growth.omega} if np.isfinite(growth.omega) else {},
    )  # fmt: skip
    timed = region.scope(timed=bool(ca.depends_on(ca.vertcat(model.f, model.e), model.t)))
    well, contraction = (replace(item, scope=intersect_scopes(item.scope, timed)) for item in (well, contraction))
    if ca.depends_on(model.e, ca.vertcat(model.t, model.u)):
        well, contraction = (
            replace(item, statement=f"{item.statement}; {range_condition.MOVING_OFFSET_NOTE}") for item in (well, contraction)
        )
        texts = range_condition.MOVING_OFFSET_NOTE
    if texts:
        well, contraction = replace(well, verdict=UNKNOWN), replace(contraction, verdict=UNKNOWN)
    return [well, contraction, *_stability_consequences(model, region, growth, findings)]


def _forcing_regularity_reason(model: LureSystem, region: Region) -> str:
    """What Theorem 5.6 asks of f beside its assumptions: continuous, f' locally integrable; '' where that is proved."""
    f, t = model.f, model.t
    if not ca.depends_on(f, t):
        return ""
    last = max(region.t1, float(model.t_end or 0.0))  # a run may have stopped before
    z, (low, high) = ca.vertcat(t, model.p), region.parameter_bounds()
    ends = np.append(region.t0, low), np.append(last, high)
    if interval_bounds.is_continuous(f, z, *ends) and np.isfinite(interval_bounds.enclose(ca.jacobian(f, t), z, *ends)).all():
        return ""
    defined = DefinednessResult(UNKNOWN, "") if model.p.numel() else check_defined_in_time(f, t, region.t0, last)
    if defined.verdict == VIOLATED:
        return f"; f has no finite value for all times: {defined.how}"
    if defined.verdict == HOLDS and is_absolutely_continuous(f, t, region.t0, last):
        return ""
    return f"; f is not seen to be absolutely continuous on [{region.t0:g}, {last:g}], which the theorem asks for"


def _stability_consequences(
    model: LureSystem, region: Region, growth: HypomonotoneBound, findings: Sequence[Finding]
) -> list[Consequence]:
    """Proposition 7.3: it needs omega <= 0, or omega < 0, and f = 0 beside its assumptions; without a box, for all states."""
    made, omega = [], growth.omega
    known = {"omega": omega} if np.isfinite(omega) else {}
    size = f"omega = {omega:.4g}" if known else "no omega is known"
    radius = np.inf if growth.everywhere or growth.P is None else _ball_radius_in_box(growth.P, region)
    for name, premise, met in (
        ("Lyapunov stable", "omega <= 0", omega <= 0),
        ("globally asymptotically stable", "omega < 0", omega < 0),
    ):
        rounded = not met and premise == "omega <= 0" and omega <= growth.accuracy
        reasons = ["f is not 0"] if not model.f.is_zero() else []
        if not met and not rounded:
            reasons.append(f"it needs {premise}, and {size}")
        elif not radius > 0:
            reasons.append("omega is known on the box alone, and 0 is not inside it")
        elif np.isfinite(radius) and premise == "omega < 0":
            reasons.append(f"omega is known on the box alone: solutions from |x|_P < {radius:.4g} tend to 0")
        statement = f"the solution 0 is {name}" + (f"; {size} is zero up to the accuracy of the search for P" if rounded else "")
        value = known if not np.isfinite(radius) else {**known, "radius": radius}
        consequence = make_consequence(
            name, "; ".join([statement, *reasons]), findings, (*MONOTONE_PREMISES, "7.1"), f"{LURE_PAPER}, Proposition 7.3", value
        )
        if reasons:
            consequence = replace(consequence, verdict=UNKNOWN)
        elif rounded and consequence.verdict == HOLDS:
            consequence = replace(consequence, verdict=SAMPLED)
        made.append(consequence)
    return made


def _ball_radius_in_box(P: np.ndarray, region: Region) -> float:
    """The largest r with {|x|_P < r} inside the box."""
    inverse = exact.inverse_matrix(P)
    if inverse is None:
        return 0.0
    reach = np.sqrt(exact.doubles(np.diagonal(inverse)))  # max of x_i over |x|_P <= 1
    return float(max(0.0, (np.minimum(-region.lower, region.upper) / reach).min()) * (1 - 8 * MACHINE_EPSILON))


def compare_contraction(model: LureSystem, P: np.ndarray, omega: float, run_a: Trajectory, run_b: Trajectory) -> Finding:
    """Compare the distance of two runs on the same grid with (40), row by row.

    With d_k = x_k - y_k, gamma = 1 and l monotone in y, a step obeys |d_{k+1}|_P^2 (1 - 2 h omega - h^2 (1-theta)^2 kappa^2)
    <= |d_k|_P^2, kappa the Lipschitz constant of A between the rows: what is checked. The number beside it is (40) itself.

    Args:
        model: bound.
        P, omega: as found for 5.2.
        run_a, run_b: runs from different starts.
    """
    if run_a.t.shape != run_b.t.shape or not np.array_equal(run_a.t, run_b.t):
        return make_finding(CONTRACTION_HYPOTHESIS, UNKNOWN, "the two runs have different times")
    h = np.diff(run_a.t)
    if any(run.metadata["save_every"] != 1 for run in (run_a, run_b)) or not len(h):
        return make_finding(CONTRACTION_HYPOTHESIS, UNKNOWN, "the runs do not hold every row (save_every)")
    L, d = rational_cholesky(exact.rational(P)), run_a.x - run_b.x
    size = np.linalg.norm(d @ L, axis=1)
    if not size[0] > 0:
        return make_finding(CONTRACTION_HYPOTHESIS, UNKNOWN, "the two runs have the same start")
    t, bound = run_a.t - run_a.t[0], size[0] * np.exp(np.minimum(omega * (run_a.t - run_a.t[0]), 700.0))
    discrete = size[0] * np.exp(np.concatenate([[0.0], np.cumsum(_log_step_growth(model, L, omega, run_a, run_b, h))]))
    tolerance = max(float(run.metadata["tolerance"]) for run in (run_a, run_b))
    rounding = (
        (64 * MACHINE_EPSILON + tolerance) * np.arange(1, len(t) + 1) * np.linalg.norm(run_a.x @ L, axis=1).max(initial=1.0)
    )
    k = int(np.argmax(size / bound))
    value = {"largest ratio to the bound": size[k] / bound[k], "omega": omega}
    witness = {"t": t[k], "distance": size[k], "bound": bound[k]}
    how = f"measured at {len(t)} rows, against (40) with the growth that the step size adds"
    if model.gamma != 1:
        return make_finding(
            CONTRACTION_HYPOTHESIS, SAMPLED, "measured beside (40); for gamma < 1 the scheme promises no bound", value, witness
        )
    over = size > discrete * (1 + 1e-9) + rounding
    if over.any():
        k = int(np.argmax(over))
        witness = {"t": t[k], "distance": size[k], "bound of the scheme": discrete[k]}
        return make_finding(CONTRACTION_HYPOTHESIS, VIOLATED, how, value, witness)
    return make_finding(CONTRACTION_HYPOTHESIS, HOLDS, how, value, witness)


def _log_step_growth(
    model: LureSystem, L: np.ndarray, omega: float, run_a: Trajectory, run_b: Trajectory, h: np.ndarray
) -> np.ndarray:
    """log |d_{k+1}|_P / |d_k|_P at most, (N,), for the scheme with gamma = 1; inf where the step is too long for a bound."""
    A = ca.Function("A", [model.x], [model.A])
    rate = (np.array(A(run_a.x.T)) - np.array(A(run_b.x.T))).T
    change = np.linalg.norm(np.diff(run_a.x - run_b.x, axis=0) @ L, axis=1)
    kappa = np.linalg.norm(np.diff(rate, axis=0) @ L, axis=1) / np.where(change > 0, change, 1.0)
    factor = 1 - 2 * h * omega - (h * (1 - model.theta) * kappa) ** 2
    return np.where(factor > 0, -0.5 * np.log(np.where(factor > 0, factor, 1.0)), np.inf)


def compare_runs(model: LureSystem, findings: Sequence[Finding], runs: Sequence[Trajectory]) -> list[Finding]:
    """(40), with the P and omega of the findings, for two runs from different starts."""
    rate = next(finding for finding in findings if finding.id == HYPOMONOTONE.id)
    if len(runs) < 2 or rate.verdict != HOLDS or P_OMEGA not in rate.witness:
        return []
    return [compare_contraction(model, np.array(rate.witness[P_OMEGA]), rate.value["omega"], *runs[:2])]
