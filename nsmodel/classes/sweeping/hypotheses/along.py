"""What a run of a sweeping process shows: no constraint is broken, and a way out at every row."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from nsmodel.classes.sweeping.hypotheses.geometry import mfcq_constant
from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.hypotheses.along import QUALIFICATION_HYPOTHESIS, constraint_findings, inputs_at_rows
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, VIOLATED, Finding, make_finding
from nsmodel.simulation.trajectory import Trajectory

RUN_HYPOTHESES = ()
MAX_GAMMA_ROWS = 2000  # of a run, where gamma is evaluated


def class_findings_along_run(
    model: SweepingProcess, run: Trajectory, numbers: Mapping[str, Finding], twin: Trajectory | None, quick: bool
) -> list[Finding]:  # fmt: skip
    """Q(t), and (A5)."""
    return [*constraint_findings(model, run, model.g, model.multiplier_names), *_qualification_along(model, run)]


def _qualification_along(model: SweepingProcess, run: Trajectory) -> list[Finding]:
    """gamma(rho) of (A5) along the run, rho the most that a constraint closed from one row to the next."""
    gap = run.arrays.get("gap", np.zeros((1, 0)))
    if gap.shape[1] < 2 or len(gap) < 2:
        return []
    rho = max(float(np.max(gap[:-1] - gap[1:])), 0.0)
    near = gap <= rho
    crowded = np.flatnonzero(near.sum(axis=1) > 1)
    rows = crowded[np.unique(np.linspace(0, crowded.size - 1, min(crowded.size, MAX_GAMMA_ROWS), dtype=int))]
    slopes = ca.Function("slopes", [model.t, model.q, model.u], [ca.densify(ca.jacobian(model.g, model.q))])
    u = inputs_at_rows(model, run)
    worst, witness = 1.0, {}
    for k in rows:
        at = np.flatnonzero(near[k])
        gamma, weights = mfcq_constant(np.array(slopes(run.t[k], run.x[k], u[k]))[at])
        if gamma > worst:
            worst = gamma
            opposed = {model.multiplier_names[at[i]]: float(weights[i]) for i in np.argsort(-weights) if weights[i] > 0}
            witness = {"constraints": list(opposed), "weights": list(opposed.values()), "t": run.t[k], "state": run.x[k]}
            if np.isinf(gamma):
                break
    verdict = VIOLATED if np.isinf(worst) else HOLDS if rows.size == crowded.size else SAMPLED
    how = f"evaluated at {rows.size} of {crowded.size} rows with several constraints within rho, the most that one closes"
    return [make_finding(QUALIFICATION_HYPOTHESIS, verdict, how, {"gamma": worst, "rho": rho}, witness)]
