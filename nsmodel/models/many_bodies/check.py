"""The hypotheses of Bernicot and Venel (2010) for many bodies: each family decided once, never all of its constraints.

How much a check of many bodies computes, and what it says of that.

What a run of many bodies shows: nothing was crossed, a way out at every row, no step longer than the velocity asked for.

S-start of many bodies: the least gap of those that are there at t = 0, by a search, and the sign of each gap near 0.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace

import casadi as ca
import numpy as np

from nsmodel._utils import EPS
from nsmodel.hypotheses.along_run import FEASIBILITY_HYPOTHESIS, QUALIFICATION_HYPOTHESIS
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Consequence, Finding, Hypothesis, make_finding
from nsmodel.hypotheses.region import Region, region_of
from nsmodel.models.many_bodies.contact_network import (
    MAX_BODY_ROWS,
    MAX_RUN_ROWS,
    TimedBodies,
    constraints_within,
    decide_bodies_mfcq,
    nearest_constraints,
    network_gamma,
    opposing_witness,
    row_constraint_name,
    term_sizes,
    undecided_constraints,
)
from nsmodel.models.many_bodies.model import ManyBodies
from nsmodel.models.many_bodies.representatives import (
    ModelRepresentatives,
    is_folded_exactly,
    member_constraint,
    representatives_of,
)
from nsmodel.models.many_bodies.schemes import BodiesProblem, ContactRows
from nsmodel.models.many_bodies.velocity import decide_bodies_velocity
from nsmodel.models.sweeping_process import check as sweeping
from nsmodel.models.sweeping_process.admissible_points import build_process
from nsmodel.models.sweeping_process.check import sweeping_consequences, weaken_findings
from nsmodel.models.sweeping_process.constraint_bounds import EVERYWHERE, ON_THE_BOX, AnswersById, Constraint, HypothesisAnswer
from nsmodel.models.sweeping_process.constraint_constants import decide_constraint
from nsmodel.models.sweeping_process.model import SweepingProcess
from nsmodel.models.sweeping_process.qualification import QualificationResult
from nsmodel.models.sweeping_process.witnesses import ROUNDING_DEFICIT, start_sign
from nsmodel.proof.global_search import searches_are_quick
from nsmodel.proof.verdict import HypothesisPart
from nsmodel.simulation.trajectory import Trajectory

# Bodies times steps of the run that a check makes; up to the second number it makes those with the steps 2h and 4h, too.
MAX_BODY_STEPS = 100_000, 20_000


def most_steps(model: ManyBodies) -> int:
    """Steps of a run that is made."""
    return max(MAX_BODY_STEPS[0] // model.bodies.count, 1)


def is_refined(model: ManyBodies, steps: int) -> bool:
    """Whether a run of so many steps is made with the steps 2h and 4h too."""
    return model.bodies.count * steps <= MAX_BODY_STEPS[1]


def effort_notes(model: ManyBodies, runs: Sequence[Trajectory]) -> list[str]:
    """What the reader of a report on many bodies should know beside."""
    changing = model.leave is not None or model.enter.any()
    found = ["bodies leave or enter: the theory speaks of each interval between such times"] if changing else []
    n, steps = model.bodies.count, len(runs[0].t) - 1 if runs else 0
    if not is_refined(model, steps):
        found.append(f"no runs with the steps 2h and 4h: {n} bodies times {steps} steps are too many")
    return found


# A deficit below this part of the positions counts as rounding: rows are stored, and gaps are formed of them anew.
POSITION_ROUNDING = 1e-10
# Rows of a run that are looked at, at most, and fewer of many bodies: all pairs that are near are formed at each.
MAX_CHECKED_ROWS = 100
MAX_MOTION_ROWS = 4_000_000  # Numbers, 32 MB, of the first rows, of which each step's length is looked at.
RUN_MOTION = Hypothesis(
    "run-motion", "|q_{k+1} - q_k| <= h |f(t_k, q_k)|, over all bodies together: constraints only slow down",
    "projection on a convex set that holds q_k",
)  # fmt: skip


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


# Signs that interval arithmetic leaves open and that are decided in rational numbers, at most; with more the start stays open.
MAX_EXACT_SIGNS = 400


def start_states(model: ManyBodies) -> np.ndarray:
    """The states (N, d) at t = 0, NaN for who enters later."""
    return np.where((model.enter <= 0)[:, None], model.bodies.q0, np.nan)


def start_answer(problem: BodiesProblem) -> HypothesisAnswer:
    """Return whether the start is admissible: signs by intervals, where they touch in rational arithmetic."""
    q = start_states(problem.model)
    rows, low, high = undecided_constraints(problem, 0.0, q)
    if not len(rows.g):
        return HypothesisAnswer(HOLDS, {"min g": np.inf}, EVERYWHERE, "no constraint")
    k = int(np.argmin(np.nan_to_num(rows.g, nan=-np.inf)))
    value = {"min g": float(rows.g[k])}
    bad = (high < -ROUNDING_DEFICIT * term_sizes(problem, 0.0, q, rows)) | np.isnan(rows.g)
    if bad.any():
        k = int(np.argmin(np.where(bad, np.nan_to_num(rows.g, nan=-np.inf), np.inf)))
        bodies = [int(rows.first[k]), *([int(rows.second[k])] if rows.pair[k] else [])]
        witness = {"constraint": row_constraint_name(problem, rows, k), "g": float(rows.g[k])} | {
            f"body {i}": q[i] for i in bodies
        }
        return HypothesisAnswer(
            VIOLATED, value, EVERYWHERE, f"g_i(0, q_0) < 0, rounding included, of {bad.sum()} constraints", witness
        )
    left = np.flatnonzero(low < 0)
    undecided = left if len(left) > MAX_EXACT_SIGNS else [i for i in left if _exact_start_sign(problem, rows, int(i), q) < 0]
    if len(undecided):
        witness = {"constraint": row_constraint_name(problem, rows, int(undecided[0])), "such constraints": len(undecided)}
        return HypothesisAnswer(SAMPLED, value, EVERYWHERE, "to rounding: the sign of g_i(0, q_0) is lost in it", witness)
    how = f"by a search for neighbours; the sign of each of the {len(rows.g)} nearest was decided with rounding included"
    return HypothesisAnswer(HOLDS, value, EVERYWHERE, how, {"constraint": row_constraint_name(problem, rows, k)})


def _exact_start_sign(problem: BodiesProblem, rows: ContactRows, k: int, q: np.ndarray) -> int:
    """The exact sign of one constraint at the start; -1 where it is not known."""
    i, j, number = int(rows.first[k]), int(rows.second[k]), int(rows.family[k])
    family, state = problem.families[number], np.concatenate([q[i], q[j]]) if rows.pair[k] else q[i]
    constraint, numbers = member_constraint(problem.model, problem.names[number], family, (i, j), folded=False)
    sign = start_sign(constraint, np.concatenate([state, numbers]))
    if sign is None and is_folded_exactly(family, numbers):
        sign = start_sign(member_constraint(problem.model, problem.names[number], family, (i, j), folded=True)[0], state)
    return -1 if sign is None else sign


HYPOTHESES = sweeping.HYPOTHESES
# Up to so many constraints (quick, else) A5 is decided on the model written out, with more proofs, which look at pairs of them.
MAX_ONE_BY_ONE = 60, 200


def check(model: ManyBodies, region: Region, runs: Sequence[Trajectory], quick: bool) -> tuple[list[Finding], list[Consequence]]:
    """Decide the hypotheses of a sweeping process of many bodies.

    Args:
        model: bound.
        region: the box of one body, around all of them.
        runs: of this model.
        quick: no searches.

    Returns:
        One finding for each of ``HYPOTHESES``, and the consequences.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # NaN and inf are met on purpose, where gradients do not exist.
        problem, kinds = BodiesProblem(model), representatives_of(model, region, quick)
        easy = quick or sum(kind.worst.shape.kind == "other" for kind in kinds.kinds) > sweeping.MANY_UNKNOWN_SHAPES
        each = [_answers_of_worst(kind.worst, kind.actual, easy) for kind in kinds.kinds]
        constraints = [kind.worst for kind in kinds.kinds]
        count = sum(family.count for family in problem.families)
        findings = [
            _families_finding(
                sweeping.joined_finding(hypothesis, constraints, each, region), kinds, count, len(model.constraints)
            )
            for hypothesis in sweeping.CONSTRAINT_HYPOTHESES
        ]
        points = _bodies_sample(model, runs, quick)
        near, active = _bodies_mfcq(problem, kinds, each, region, runs, points, quick or searches_are_quick())
        timed = any(constraint.shape.time for constraint in constraints)
        findings += [
            sweeping.gamma_finding(sweeping.A5, near, region, timed),
            sweeping.gamma_finding(sweeping.A5_ACTIVE, active, region, timed),
        ]
        answer = decide_bodies_velocity(problem, region, points, quick)
        timed = not isinstance(model.f, ca.SX) or bool(ca.depends_on(model.f, model.t))
        scope = region.scope(answer.where == ON_THE_BOX, timed)
        findings.append(make_finding(sweeping.S_F, answer.verdict, answer.how, answer.value, answer.witness, scope))
        answer = start_answer(problem)
        findings.append(make_finding(sweeping.S_START, answer.verdict, answer.how, answer.value, answer.witness))
        known_point = known_start_point(model, region, findings[-1])
        findings = weaken_findings(findings, known_point)
    return findings, sweeping_consequences(model, findings, runs, count, known_point)


def known_start_point(model: ManyBodies, region: Region, start: Finding) -> HypothesisPart:
    """Whether Q(0) is not empty: the start is in it; of few constraints written out, whether another point is."""
    few = sum(family.count for family in model.constraints.values()) <= MAX_ONE_BY_ONE[True]
    if start.verdict == HOLDS or not few or model.enter.any() or model.p.numel():
        how = start.how if start.verdict == HOLDS else "the start is not in Q(0), which may be empty"
        return HypothesisPart(start.verdict if start.verdict in (HOLDS, SAMPLED) else UNKNOWN, how, {}, {})
    still = copy(model)
    still._set(f=ca.SX.zeros(model.bodies.d))
    one = still.written_out()
    box = _region_written_out(one, region, ())
    return sweeping.known_start_point(one, box, start, build_process(one, box, (), 0))


def _answers_of_worst(worst: Constraint, actual: Constraint, quick: bool) -> AnswersById:
    """What the worst member says; where it is none of the model's own, a violation is one only if a true member has it."""
    found = decide_constraint(worst, quick)
    if worst is actual or not any(answer.verdict == VIOLATED for answer in found.values()):
        return found
    true = decide_constraint(actual, quick)
    how = "violated at numbers within the ranges of the members, not at the member nearest to them"
    return {
        id: answer if answer.verdict != VIOLATED else true[id] if true[id].verdict == VIOLATED
        else replace(answer, verdict=UNKNOWN, how=how)
        for id, answer in found.items()
    }  # fmt: skip


def _families_finding(finding: Finding, kinds: ModelRepresentatives, count: int, families: int) -> Finding:
    """Say how few constraints stand for all; where some combinations of numbers were left out, nothing is proved."""
    if not kinds.kinds:
        return finding
    spread = "1 family" if families == 1 else f"{families} families"
    how = f"{count} constraints of {spread}, decided on {len(kinds.kinds)}; {finding.how}"
    if len(kinds.kinds) == 1 and finding.verdict == HOLDS:
        name = kinds.kinds[0].worst.name
        finding = replace(finding, witness={f"{key} of": name for key in finding.value if key in ("a", "b", "c", "M")})
    if not kinds.left_out:
        return replace(finding, how=how)
    verdict = SAMPLED if finding.verdict == HOLDS else finding.verdict
    return replace(finding, verdict=verdict, how=f"{how}; looked at {kinds.left_out}")


def _bodies_sample(model: ManyBodies, runs: Sequence[Trajectory], quick: bool) -> list[TimedBodies]:
    """(t, q (N, d)) of the start and of some rows of the runs, absent bodies NaN."""
    n, d = model.bodies.q0.shape
    most = int(np.clip(MAX_BODY_ROWS[quick] // n, 1, MAX_RUN_ROWS))
    rows = [(run, k) for run in runs for k in np.unique(np.linspace(0, len(run.t) - 1, most, dtype=int))]
    return [(0.0, start_states(model)), *((float(run.t[k]), run.x[k].reshape(n, d)) for run, k in rows)]


def _bodies_mfcq(
    problem: BodiesProblem, kinds: ModelRepresentatives, each: Sequence[AnswersById], region: Region, runs: Sequence[Trajectory],
    points: list[TimedBodies], quick: bool,
) -> tuple[QualificationResult, QualificationResult]:  # fmt: skip
    """A5 and A5': of few constraints as of a sweeping process written out."""
    few = sum(family.count for family in problem.families) <= MAX_ONE_BY_ONE[not quick]
    if not (isinstance(problem.model.f, ca.SX) and few) or problem.model.enter.any():
        return _network_mfcq(problem, kinds, each, region, points, quick)
    alone = _written_out_mfcq(problem.model, region, runs, quick)
    if all(np.isfinite(run.x).all() for run in runs) or {result.verdict for result in alone} == {HOLDS}:
        return alone
    near, active = (
        one if one.verdict == HOLDS else other
        for one, other in zip(alone, _network_mfcq(problem, kinds, each, region, points, quick), strict=True)
    )
    return near, active


def _written_out_mfcq(
    model: ManyBodies, region: Region, runs: Sequence[Trajectory], quick: bool
) -> tuple[QualificationResult, QualificationResult]:
    """That of all bodies together, which is that of each part of them: where one has left, fewer constraints act."""
    one = model.written_out()
    return sweeping.mfcq_results(one, _region_written_out(one, region, runs), runs, quick)


def _region_written_out(one: SweepingProcess, region: Region, runs: Sequence[Trajectory]) -> Region:
    """The box of one body as that of all of them."""
    d = len(region.lower)
    return region_of(one, runs, {name: (region.lower[k % d], region.upper[k % d]) for k, name in enumerate(one.names)})


def _network_mfcq(
    problem: BodiesProblem, kinds: ModelRepresentatives, each: Sequence[AnswersById], region: Region, points: list[TimedBodies],
    quick: bool,
) -> tuple[QualificationResult, QualificationResult]:  # fmt: skip
    """That of the contact graph at points."""
    size = float(np.max(region.upper - region.lower))
    slope = max((item["A1"].value.get("b", 1.0) for item in each), default=1.0)
    depth = [2 * item["A0"].value.get("delta", np.inf) for item in each]
    across = [0.5 * size * item["A1"].value.get("b", 1.0) for item in each]
    reach = min((d if np.isfinite(d) else w for d, w in zip(depth, across, strict=True)), default=1.0)
    return decide_bodies_mfcq(problem, kinds.kinds, not kinds.left_out, points, reach, slope, size, quick)
