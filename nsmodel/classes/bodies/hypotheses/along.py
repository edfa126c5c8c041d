"""What a run of many bodies shows: nothing was crossed, a way out at every row, no step longer than the velocity asked for."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from nsmodel.classes.bodies.hypotheses.near import constraints_within, nearest_constraints, row_constraint_name
from nsmodel.classes.bodies.hypotheses.network import network_gamma
from nsmodel.classes.bodies.hypotheses.qualification import MAX_BODY_ROWS, opposing_witness
from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.classes.bodies.schemes.prediction_correction import BodiesProblem
from nsmodel.classes.sweeping.hypotheses.constraint import HypothesisAnswer
from nsmodel.hypotheses.along import FEASIBILITY_HYPOTHESIS, QUALIFICATION_HYPOTHESIS
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Finding, Hypothesis, make_finding
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.solvers.residuals import EPS

POSITION_ROUNDING = 1e-10  # A deficit below this part of the positions counts as rounding.
MAX_CHECKED_ROWS = 100
MAX_MOTION_ROWS = 4_000_000  # Bodies times rows where each step's length is looked at.
RUN_MOTION = Hypothesis(
    "run-motion", "|q_{k+1} - q_k| <= h |f(t_k, q_k)|, over all bodies together: constraints only slow down",
    "projection on a convex set that holds q_k",
)  # fmt: skip
RUN_HYPOTHESES = (RUN_MOTION,)


def class_findings_along_run(
    model: ManyBodies, run: Trajectory, numbers: Mapping[str, Finding], twin: Trajectory | None, quick: bool
) -> list[Finding]:  # fmt: skip
    """Q(t), (A5), and the length of a step."""
    problem, slope = BodiesProblem(model), numbers["A1"].value.get("b", 1.0)
    answers = {
        FEASIBILITY_HYPOTHESIS: feasibility_answer(problem, run, quick),
        QUALIFICATION_HYPOTHESIS: mfcq_answer(problem, run, slope, quick),
        RUN_MOTION: step_length_answer(problem, run),
    }
    return [
        make_finding(id, item.verdict, item.how, item.value, item.witness) for id, item in answers.items() if item is not None
    ]


def feasibility_answer(problem: BodiesProblem, run: Trajectory, quick: bool) -> HypothesisAnswer | None:
    """The least gap that the run notes at each row, and anew at some rows."""
    if not problem.families:
        return None
    least = np.nan_to_num(run.gap_min, nan=-np.inf)
    rows = _sample_rows(problem, run, int(np.argmin(least)), quick)
    worst, witness, broken = np.inf, {}, False
    for k in rows:
        q = _row_states(problem, run, k)
        near = nearest_constraints(problem, float(run.t[k]), q)
        scale = POSITION_ROUNDING * (1 + np.abs(q[np.isfinite(q)]).max(initial=0.0))
        if least[k] < min(worst, -scale * np.nan_to_num(near.size).max(initial=1.0)):
            worst, witness, broken = float(least[k]), {"t": run.t[k], "noted": float(least[k])}, True
        if not len(near.g):
            continue
        values = np.nan_to_num(near.g, nan=-np.inf)
        broken |= bool((values < -scale * near.size).any())
        i = int(np.argmin(values))
        if values[i] <= worst:
            worst, witness = float(values[i]), {"constraint": row_constraint_name(problem, near, i), "t": run.t[k]}
    how = f"the gap that the run notes at each of {len(run.t)} rows, and anew from the constraints at {len(rows)} of them; "
    how += "a deficit below 1e-10 of the positions counts as rounding"
    return HypothesisAnswer(VIOLATED if broken else HOLDS, {"least value": min(float(least.min()), worst)}, "", how, witness)


def mfcq_answer(problem: BodiesProblem, run: Trajectory, slope: float, quick: bool) -> HypothesisAnswer | None:
    """gamma(rho) of (A5) on the contact graph, rho a bound of what a constraint closes from one row to the next.

    ``slope`` bounds |grad g_i|; the two bodies that moved most bound what any constraint has closed.
    """
    if len(run.t) < 2 or sum(family.count for family in problem.families) < 2:
        return None
    rho = slope * max(_longest_moves_norm(problem, run, k) for k in range(len(run.t) - 1))
    most = np.bincount(run.contact_row, minlength=len(run.t)) if len(run.contact_row) else np.zeros(1)
    rows = _sample_rows(problem, run, int(np.argmax(most)), quick)
    worst, witness, looked, broken = 1.0, {}, 0, False
    for k in rows:
        near = constraints_within(problem, float(run.t[k]), _row_states(problem, run, k), rho)
        network = network_gamma(near, quick)
        looked += network is not None
        if network is not None and (network.gamma > worst or np.isinf(network.attained)):
            worst, witness = network.gamma, opposing_witness(problem, network, near) | {"t": run.t[k]}
            broken = bool(np.isinf(network.attained))
            if broken:
                break
    verdict = VIOLATED if broken else UNKNOWN if np.isinf(worst) or not looked else HOLDS if looked == len(run.t) else SAMPLED
    how = f"the contact graph of {looked} of {len(run.t)} rows, within rho, which the two longest moves of a row bound"
    return HypothesisAnswer(verdict, {"gamma": worst, "rho": rho}, "", how, witness)


def step_length_answer(problem: BodiesProblem, run: Trajectory) -> HypothesisAnswer | None:
    """|q_{k+1} - q_k| <= h |f(t_k, q_k)| over all bodies together: a projection on a convex set that holds q_k."""
    if any(ca.depends_on(ca.SX(family.g), problem.model.t) for family in problem.families):
        return None
    if run.metadata["save_every"] != 1:
        return HypothesisAnswer(UNKNOWN, {}, "", "the run does not hold every row (save_every)")
    count = min(len(run.t) - 1, max(MAX_MOTION_ROWS // run.x.shape[1], 1))
    if count < 1:
        return None
    worst, at, broken = (0.0, 0.0, 0.0), 0, False
    tolerance = float(run.metadata["tolerance"])
    for k in np.unique(np.linspace(0, len(run.t) - 2, count, dtype=int)):
        q, new = _row_states(problem, run, k), _row_states(problem, run, k + 1)
        present = np.all(np.isfinite(new), axis=1)
        both = present & np.all(np.isfinite(q), axis=1)
        if (present & ~both).any():
            continue  # Who enters here took no part in the step, or did so unseen.
        h = float(run.step[k + 1])
        speed = h * float(np.linalg.norm(problem.f(float(run.t[k]), np.where(both[:, None], q, np.nan), both)[both]))
        moved = float(np.linalg.norm((new - q)[both]))
        rounding = 4 * EPS * np.sqrt(both.sum()) * np.abs(q[both]).max(initial=0.0)
        broken |= moved > speed * (1 + 4 * tolerance * np.sqrt(max(both.sum(), 1))) + rounding
        if moved * worst[1] >= worst[0] * speed and moved > 0:
            worst, at = (moved, speed, rounding), k + 1
    value = {"largest |q_{k+1} - q_k| / (h |f|)": worst[0] / worst[1] if worst[1] else 0.0}
    witness = {"t": run.t[at], "moved": worst[0], "h |f|": worst[1]}
    return HypothesisAnswer(VIOLATED if broken else HOLDS, value, "", f"evaluated at {count} of {len(run.t) - 1} steps", witness)


def _row_states(problem: BodiesProblem, run: Trajectory, k: int) -> np.ndarray:
    return run.x[k].reshape(problem.count, problem.d)


def _sample_rows(problem: BodiesProblem, run: Trajectory, also: int, quick: bool) -> np.ndarray:
    """Rows of the run, as many as the number of bodies lets one look at, and one more."""
    count = int(np.clip(MAX_BODY_ROWS[quick] // problem.count, 1, MAX_CHECKED_ROWS))
    rows = np.linspace(0, len(run.t) - 1, min(len(run.t), count), dtype=int)
    return np.unique(np.append(rows, also))


def _longest_moves_norm(problem: BodiesProblem, run: Trajectory, k: int) -> float:
    """The root of the sum of squares of the two longest moves from row k to the next."""
    moved = np.linalg.norm(_row_states(problem, run, k + 1) - _row_states(problem, run, k), axis=1)
    longest = np.sort(moved[np.isfinite(moved)])[-2:]
    return float(np.linalg.norm(longest))
