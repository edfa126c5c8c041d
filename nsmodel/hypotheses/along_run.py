"""The inequalities that must hold along a run, evaluated on its rows from the model's own expressions.

How long solutions, and what a scheme computes, provably stay inside the box of a consequence: by bounds of their speed.

A class that has such a bound has `speed_bound` among its checks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from nsmodel._utils import EPS
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Consequence, Finding, Hypothesis, make_finding
from nsmodel.hypotheses.framework import HYPOTHESIS_CHECKS, SpeedBound
from nsmodel.hypotheses.region import Region
from nsmodel.modeling.base import Model
from nsmodel.proof import interval_bounds
from nsmodel.proof.exact import ROUND_UP_FACTOR
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.solvers import impacts

SUM_ROUNDING = 64 * EPS  # Relative rounding of a sum of some dozen terms: a run that exceeds a bound by less does not violate it.

RESIDUAL_HYPOTHESIS = Hypothesis("run-residual", "every step solves its one-step problem: residual <= tolerance", "definition")
FEASIBILITY_HYPOTHESIS = Hypothesis("run-feasible", "every constraint is >= 0 at every row", "definition of Q(t), of C, of dom g")
QUALIFICATION_HYPOTHESIS = Hypothesis(
    "run-mfcq", "the constraints that one step can close leave a common escape direction: gamma(rho) < inf at every row",
    "Bernicot and Venel 2010, (A5)",
)  # fmt: skip
CONTINUITY_HYPOTHESIS = Hypothesis(
    "run-continuous", "no state jumps: where a multiplier that enters neither y nor y' sets in, y' = 0",
    "definition of a solution: x is absolutely continuous",
)  # fmt: skip


@np.errstate(over="ignore", invalid="ignore")  # a run that diverges is judged like any other
def findings_along_run(
    model: Model, run: Trajectory, findings: Sequence[Finding], twin: Trajectory | None = None, quick: bool = False
) -> list[Finding]:
    """Return one finding for each inequality that this class promises.

    Args:
        model: bound.
        run: a run of it.
        findings: of the hypotheses; their numbers enter the bounds.
        twin: a run of the same model on the same grid from another start.
        quick: of many bodies look at fewer rows.
    """
    along_run = HYPOTHESIS_CHECKS.of(model).along_run
    numbers = {finding.id: finding for finding in findings}
    own = [] if along_run is None else along_run(model, run, numbers, twin, quick)
    return [_residual_finding(run), *own, *_continuity_findings(model, run)]


def _continuity_findings(model: Model, run: Trajectory) -> list[Finding]:
    """Impacts of the rows that may call for an impulse; nothing where there is no such row."""
    watches = impacts.impact_rows(model)
    if not watches:
        return []  # nearly always
    known = impacts.update_impacts(watches, run.arrays, {})
    lines = impacts.describe_impacts(watches, known, model)
    jumps = [(watch, known[watch.name]) for watch in watches if not watch.relay and known[watch.name]["count"]]
    value = {"jumps": sum(found["count"] for _, found in jumps)}
    if jumps:
        watch, worst = max(jumps, key=lambda jump: jump[1]["largest"])
        witness = {"multiplier": watch.name, "t": worst["t"], "y'": worst["rate"], "states": list(watch.moved)}
        return [
            make_finding(CONTINUITY_HYPOTHESIS, VIOLATED, "; ".join(lines), value | {"largest |y'|": worst["largest"]}, witness)
        ]
    if lines:
        return [make_finding(CONTINUITY_HYPOTHESIS, UNKNOWN, "; ".join(lines), value)]
    names = ", ".join(watch.acts for watch in watches if not watch.relay)
    return (
        []
        if not names
        else [make_finding(CONTINUITY_HYPOTHESIS, HOLDS, f"{names}: none set in with y' != 0 at {len(run.t)} rows", value)]
    )


def has_every_row(run: Trajectory) -> bool:
    """Whether a run holds every step, as inequalities from one row to the next ask for."""
    return run.metadata["save_every"] == 1 and len(run.t) > 1


def missing_rows_findings(*hypotheses: Hypothesis) -> list[Finding]:
    """What is said of inequalities where it does not."""
    return [make_finding(hypothesis, UNKNOWN, "the run does not hold every row (save_every)") for hypothesis in hypotheses]


def inputs_at_rows(model: Model, run: Trajectory) -> np.ndarray:
    """u(t-) at each row of a run (N, nu)."""
    return run.arrays["inputs"] if model.u.numel() else np.zeros((len(run.t), 0))


def _residual_finding(run: Trajectory) -> Finding:
    totals = run.metadata["totals"]
    worst, tolerance = float(totals["worst_residual"]), float(run.metadata["tolerance"])
    verdict = HOLDS if worst <= tolerance else VIOLATED
    time = totals["worst_residual_t"]
    how = f"recomputed from the definition of the law at each of {totals['steps']} steps"
    return make_finding(
        RESIDUAL_HYPOTHESIS,
        verdict,
        how,
        {"worst residual": worst, "tolerance": tolerance},
        {"t": "no row" if time is None else time},
    )


def constraint_findings(model: Any, run: Trajectory, c: ca.SX, names: Sequence[str]) -> list[Finding]:
    """The least value of every constraint; what evaluating it in doubles cannot see is no violation."""
    if not c.numel():
        return []
    f = ca.Function("c", [model.t, model.state, model.u], [ca.densify(c), ca.densify(ca.jacobian(c, model.state))])
    k = len(run.t)
    values, gradients = (np.array(v) for v in f.map(k)(run.t[None, :], run.x.T, inputs_at_rows(model, run).T))
    values = values.T
    size = np.linalg.norm(gradients.reshape(c.numel(), k, model.state.numel()), axis=2).T
    values = np.where(np.isfinite(values), values, -np.inf)
    row, i = np.unravel_index(np.argmin(values), values.shape)
    unseen = 1e-10 * np.where(np.isfinite(size), size, 0) * (1 + np.linalg.norm(run.x, axis=1)[:, None])
    broken = values < -unseen
    if broken.any():
        row, i = np.unravel_index(np.argmin(np.where(broken, values, np.inf)), values.shape)
    witness = {"constraint": names[int(i)], "t": run.t[int(row)], "state": run.x[int(row)]}
    how = f"evaluated at {k} rows; a deficit below 1e-10 of the state's size counts as rounding"
    return [
        make_finding(FEASIBILITY_HYPOTHESIS, VIOLATED if broken.any() else HOLDS, how, {"least value": values[row, i]}, witness)
    ]


PAIR_CONSEQUENCES = ("contraction", "stability")  # They speak of any two solutions.


def time_limit_clauses(
    model: Model, region: Region, findings: Sequence[Finding], consequences: Sequence[Consequence]
) -> list[Consequence]:  # fmt: skip
    """The consequences, those with a clause told for how long it is proved; nothing of a start outside of their box."""
    consequences = [about_start(model, region, consequence) for consequence in consequences]
    if not any(consequence.clause and consequence.verdict in (HOLDS, SAMPLED) for consequence in consequences):
        return list(consequences)
    bound = _speed_bound(model, region, findings, {consequence.name: consequence for consequence in consequences})
    until = None if bound is None else _time_limit(model, region, bound)
    if bound is not None and until is not None and until > region.t0:
        until = min(until, region.t1) if region.t1 > region.t0 else until
        text = f"; they do for t <= {until:.5g}, moving at {bound.speed:.5g} at most"
    else:
        until, text = _stay_time(model, region, findings)
    return [replace(item, clause=item.clause + text, until=until) if item.clause else item for item in consequences]


def _stay_time(model: Model, region: Region, findings: Sequence[Finding]) -> tuple[float | None, str]:
    """The longest time until which solutions are proved to stay, and what is said of it."""
    stay_times = HYPOTHESIS_CHECKS.of(model).stay_times
    low, high = (ends.min(axis=0) if k == 0 else ends.max(axis=0) for k, ends in enumerate(_start_points(model, region)))
    known = [] if stay_times is None else stay_times(model, region, findings, (low, high))
    best = max(known, key=lambda item: item.until, default=None)
    if best is None or not best.until > 0:
        return None, "; for how long they do is not proved"
    when = "at all times" if np.isinf(best.until) else f"for t <= {region.t0 + best.until:.5g}"
    return region.t0 + best.until, f"; the solution from the start does {when}, {best.why}"


def _start_points(model: Model, region: Region) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the starts over all parameters, of each body (k, n)."""
    low, high = (
        np.array(ends).reshape(1, -1) for ends in interval_bounds.enclose(model.start, model.p, *region.parameter_bounds())
    )
    return model.points(low), model.points(high)


def about_start(model: Model, region: Region, item: Consequence) -> Consequence:
    """The consequence; unknown where it speaks of the solution from the start, which is not proved to lie in its box."""
    if not item.clause or item.scope is None or item.name in PAIR_CONSEQUENCES:
        return item
    low, high = _start_points(model, region)
    for column, name in enumerate(region.names):
        lower, upper = item.scope.states.get(name, (-np.inf, np.inf))
        if not (low[:, column] >= lower).all() or not (high[:, column] <= upper).all():
            return replace(item, verdict=UNKNOWN, statement=f"{item.statement}; the start is not inside the box")
    return item


def _speed_bound(model: Model, region: Region, findings: Sequence[Finding], found: dict[str, Consequence]) -> SpeedBound | None:
    steps = model.steps if model.steps is not None else model.step
    h = float(np.max(steps)) if steps is not None else 0.0
    speed_bound = HYPOTHESIS_CHECKS.of(model).speed_bound
    return None if speed_bound is None else speed_bound(model, region, findings, found, h)


def _time_limit(model: Model, region: Region, bound: SpeedBound) -> float | None:
    """When the nearest side of the box can be reached first."""
    low, high = _start_points(model, region)
    room = float(np.min(np.minimum(low - region.lower, region.upper - high))) - bound.ahead
    if not room > 0:
        return None
    return region.t0 + room / bound.speed / ROUND_UP_FACTOR if bound.speed > 0 else np.inf
