"""The hypotheses of Bernicot and Venel (2010) for many bodies: each family decided once, never all of its constraints."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from nsmodel.classes.bodies.hypotheses.families import ModelRepresentatives, representatives_of
from nsmodel.classes.bodies.hypotheses.qualification import MAX_BODY_ROWS, MAX_RUN_ROWS, TimedBodies, decide_bodies_mfcq
from nsmodel.classes.bodies.hypotheses.start import start_answer, start_states
from nsmodel.classes.bodies.hypotheses.velocity import decide_bodies_velocity
from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.classes.bodies.schemes.prediction_correction import BodiesProblem
from nsmodel.classes.sweeping.hypotheses import check as sweeping
from nsmodel.classes.sweeping.hypotheses.consequences import sweeping_consequences
from nsmodel.classes.sweeping.hypotheses.constants import decide_constraint
from nsmodel.classes.sweeping.hypotheses.constraint import ON_THE_BOX, AnswersById, Constraint
from nsmodel.classes.sweeping.hypotheses.qualification import QualificationResult
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Consequence, Finding, make_finding
from nsmodel.hypotheses.region import Region, region_of
from nsmodel.proof.global_search import searches_are_quick
from nsmodel.simulation.trajectory import Trajectory

HYPOTHESES = sweeping.HYPOTHESES
MAX_ONE_BY_ONE = 60, 200  # Up to so many constraints (quick, else) A5 is decided on the model written out, with more proofs.


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
            for hypothesis in HYPOTHESES[:6]
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
    return findings, sweeping_consequences(model, findings, runs, count)


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
    model = problem.model
    everybody = all(np.isfinite(run.x).all() for run in runs) and not model.enter.any()
    if isinstance(model.f, ca.SX) and everybody and sum(family.count for family in problem.families) <= MAX_ONE_BY_ONE[not quick]:
        one = model.written_out()
        given = {name: (region.lower[k % model.bodies.d], region.upper[k % model.bodies.d]) for k, name in enumerate(one.names)}
        return sweeping.mfcq_results(one, region_of(one, runs, given), runs, quick)
    size = float(np.max(region.upper - region.lower))
    slope = max((item["A1"].value.get("b", 1.0) for item in each), default=1.0)
    depth = [2 * item["A0"].value.get("delta", np.inf) for item in each]
    across = [0.5 * size * item["A1"].value.get("b", 1.0) for item in each]
    reach = min((d if np.isfinite(d) else w for d, w in zip(depth, across, strict=True)), default=1.0)
    return decide_bodies_mfcq(problem, kinds.kinds, not kinds.left_out, points, reach, slope, size, quick)
