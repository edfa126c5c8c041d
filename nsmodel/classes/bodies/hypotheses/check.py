"""The hypotheses of Bernicot and Venel (2010) for many bodies: each family decided once, never all of its constraints."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from nsmodel.classes.bodies.hypotheses.families import Kinds, kinds_of
from nsmodel.classes.bodies.hypotheses.qualification import BODY_ROWS, ROWS, Point, qualification
from nsmodel.classes.bodies.hypotheses.start import start, start_of
from nsmodel.classes.bodies.hypotheses.velocity import velocity
from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.classes.bodies.schemes.prediction_correction import BodiesProblem
from nsmodel.classes.sweeping.hypotheses import check as sweeping
from nsmodel.classes.sweeping.hypotheses.consequences import consequences_of
from nsmodel.classes.sweeping.hypotheses.constants import answers
from nsmodel.classes.sweeping.hypotheses.constraint import ON_THE_BOX, Answers, Constraint
from nsmodel.classes.sweeping.hypotheses.qualification import Qualified
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Consequence, Finding, found
from nsmodel.hypotheses.region import Region, region_of
from nsmodel.proof.search import are_quick
from nsmodel.trajectory import Trajectory

HYPOTHESES = sweeping.HYPOTHESES
TWIN = False  # No two solutions are compared.
ONE_BY_ONE = 60, 200  # Up to so many constraints (quick, else) A5 is decided on the model written out, with more proofs.


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
        problem, kinds = BodiesProblem(model), kinds_of(model, region, quick)
        easy = quick or sum(kind.worst.shape.kind == "other" for kind in kinds.kinds) > sweeping.PLENTY
        each = [_answers(kind.worst, kind.actual, easy) for kind in kinds.kinds]
        constraints = [kind.worst for kind in kinds.kinds]
        count = sum(family.count for family in problem.families)
        findings = [
            _once(sweeping.joined(hypothesis, constraints, each, region), kinds, count, len(model.constraints))
            for hypothesis in HYPOTHESES[:6]
        ]
        points = _points(model, runs, quick)
        near, active = _qualified(problem, kinds, each, region, runs, points, quick or are_quick())
        timed = any(constraint.shape.time for constraint in constraints)
        findings += [sweeping.gamma(sweeping.A5, near, region, timed), sweeping.gamma(sweeping.A5_ACTIVE, active, region, timed)]
        answer = velocity(problem, region, points, quick)
        timed = not isinstance(model.f, ca.SX) or bool(ca.depends_on(model.f, model.t))
        scope = region.scope(answer.where == ON_THE_BOX, timed)
        findings.append(found(sweeping.S_F, answer.verdict, answer.how, answer.value, answer.witness, scope))
        answer = start(problem)
        findings.append(found(sweeping.S_START, answer.verdict, answer.how, answer.value, answer.witness))
    return findings, consequences_of(model, findings, runs, count)


def _answers(worst: Constraint, actual: Constraint, quick: bool) -> Answers:
    """What the worst member says; where it is none of the model's own, a violation is one only if a true member has it."""
    found = answers(worst, quick)
    if worst is actual or not any(answer.verdict == VIOLATED for answer in found.values()):
        return found
    true = answers(actual, quick)
    how = "violated at numbers within the ranges of the members, not at the member nearest to them"
    return {
        id: answer if answer.verdict != VIOLATED else true[id] if true[id].verdict == VIOLATED
        else replace(answer, verdict=UNKNOWN, how=how)
        for id, answer in found.items()
    }  # fmt: skip


def _once(finding: Finding, kinds: Kinds, count: int, families: int) -> Finding:
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


def _points(model: ManyBodies, runs: Sequence[Trajectory], quick: bool) -> list[Point]:
    """(t, q (N, d)) of the start and of some rows of the runs, absent bodies NaN."""
    n, d = model.bodies.q0.shape
    most = int(np.clip(BODY_ROWS[quick] // n, 1, ROWS))
    rows = [(run, k) for run in runs for k in np.unique(np.linspace(0, len(run.t) - 1, most, dtype=int))]
    return [(0.0, start_of(model)), *((float(run.t[k]), run.x[k].reshape(n, d)) for run, k in rows)]


def _qualified(
    problem: BodiesProblem, kinds: Kinds, each: Sequence[Answers], region: Region, runs: Sequence[Trajectory],
    points: list[Point], quick: bool,
) -> tuple[Qualified, Qualified]:  # fmt: skip
    """A5 and A5': of few constraints as of a sweeping process written out."""
    model = problem.model
    everybody = all(np.isfinite(run.x).all() for run in runs) and not model.enter.any()
    if isinstance(model.f, ca.SX) and everybody and sum(family.count for family in problem.families) <= ONE_BY_ONE[not quick]:
        one = model.written_out()
        given = {name: (region.lower[k % model.bodies.d], region.upper[k % model.bodies.d]) for k, name in enumerate(one.names)}
        return sweeping.qualified(one, region_of(one, runs, given), runs, quick)
    size = float(np.max(region.upper - region.lower))
    slope = max((item["A1"].value.get("b", 1.0) for item in each), default=1.0)
    depth = [2 * item["A0"].value.get("delta", np.inf) for item in each]
    across = [0.5 * size * item["A1"].value.get("b", 1.0) for item in each]
    reach = min((d if np.isfinite(d) else w for d, w in zip(depth, across, strict=True)), default=1.0)
    return qualification(problem, kinds.kinds, not kinds.left_out, points, reach, slope, size, quick)
