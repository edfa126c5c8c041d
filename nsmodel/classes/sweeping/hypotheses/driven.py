"""Sweeping processes with inputs: f may be measurable in t, Q(t) must be Lipschitz.

What does not ask for speeds is decided at each time and value of the inputs; A2, A3 and the L_t of S-f for their velocities.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from nsmodel.classes.sweeping.hypotheses import for_all
from nsmodel.classes.sweeping.hypotheses.check import A2, A3, S_F, S_START, joined_finding, start_finding
from nsmodel.classes.sweeping.hypotheses.constants import uniform_shape_answers
from nsmodel.classes.sweeping.hypotheses.constraint import (
    ON_THE_BOX,
    AnswersById,
    Constraint,
    HypothesisAnswer,
    time_invariant_answer,
)
from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.hypotheses import uniform
from nsmodel.hypotheses.findings import HOLDS, UNKNOWN, VIOLATED, Consequence, Finding
from nsmodel.hypotheses.inputs import InputBounds, InputJump, missing_rate_reason
from nsmodel.hypotheses.region import Region
from nsmodel.hypotheses.scope import Scope, intersect_scopes
from nsmodel.proof import extremum, interval_bounds
from nsmodel.simulation.trajectory import Trajectory

DRIVEN_FIELDS = {"f": ("f",), "constraints": ("constraints",)}
JUMP_SAMPLE_POINTS = 64  # Where a jump of a constraint is looked for.


def driven_findings(
    model: SweepingProcess, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory], quick: bool
) -> list[Finding]:  # fmt: skip
    """Those at each time and value of the inputs, but for speeds and the start; see the inclusions' module of this name."""
    del runs
    made = {finding.id: finding for finding in own}
    if motion.indices_read_by(model.g):
        made |= {finding.id: finding for finding in _speed_findings(model, region, motion, quick)}
    if motion.indices_read_by(model.f):
        made[S_F.id] = _input_velocity_finding(model, region, motion, made[S_F.id])
    if motion.indices_read_by(model.g) and motion.start:
        made[S_START.id] = _input_start_finding(model, region, motion)
    return list(made.values())


def driven_consequences(
    model: SweepingProcess, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory]
) -> list[Consequence]:  # fmt: skip
    """What follows for each signal: of the set at each time, of solutions, and of the scheme where speeds are known."""
    del motion, runs
    return state_for_each_signal(for_all.uniform_consequences(model, region, own))


def state_for_each_signal(made: Sequence[Consequence]) -> list[Consequence]:
    """The consequences, that on solutions in the words of a model with inputs."""
    statements = {item.name: f"for each signal {item.statement}" for item in made if item.name == "well posed"}
    return [replace(item, statement=statements.get(item.name, item.statement)) for item in made]


def _speed_findings(model: SweepingProcess, region: Region, motion: InputBounds, quick: bool) -> list[Finding]:
    """A2 and A3 of constraints along the inputs."""
    constraints = for_all.constraints_with_parameters(model, region, motion)
    each = [_speed_answers(c, model, region, motion, quick) for c in constraints]
    scope = Scope(parameters=region.parameters)
    made = [joined_finding(hypothesis, constraints, each, region) for hypothesis in (A2, A3)]
    return [replace(finding, scope=intersect_scopes(finding.scope, scope)) for finding in made]


def _speed_answers(c: Constraint, model: SweepingProcess, region: Region, motion: InputBounds, quick: bool) -> AnswersById:
    known = uniform_shape_answers(c) if for_all.is_smooth_in_time(c) and not motion.jumping_indices(c.g) else None
    made: AnswersById = {}
    for id, part, name in (("A2", c.g, "b"), ("A3", ca.gradient(c.g, c.q), "M")):
        loose = motion.jumping_indices(part)
        if known is not None and id in known:
            made[id] = known[id]
        elif loose:
            nothing = HypothesisAnswer(UNKNOWN, how=missing_rate_reason(motion, loose), witness={"constraint": c.name})
            made[id] = _edge_jump_answer(c, part, name, model, region, motion.edges(loose, region)) or nothing
        else:
            made[id] = _speed_bound_answer(c, part, name, quick) if ca.depends_on(part, c.t) else time_invariant_answer(name)
    return made


def _speed_bound_answer(c: Constraint, part: ca.SX, name: str, quick: bool) -> HypothesisAnswer:
    """A bound of the speed of g or of its gradient over the box."""
    rate = c.rate(part)
    if not interval_bounds.is_continuous(ca.vertcat(ca.vec(part), rate), c.z, c.lower, c.upper):
        return HypothesisAnswer(UNKNOWN, {}, ON_THE_BOX, "not proved continuous along the inputs", {"constraint": c.name})
    top = extremum.supremum(ca.sumsqr(rate), c.z, c.lower, c.upper, quick=quick)
    if not np.isfinite(top.bound):
        return HypothesisAnswer(UNKNOWN, {}, ON_THE_BOX, "no bound of the speed was found", {"constraint": c.name})
    return HypothesisAnswer(
        HOLDS, {name: float(np.sqrt(max(top.bound, 0.0))) * (1 + 1e-12)}, ON_THE_BOX, "a bound over the whole box"
    )


def _edge_jump_answer(
    c: Constraint, part: ca.SX, name: str, model: SweepingProcess, region: Region, edges: Sequence[InputJump]
) -> HypothesisAnswer | None:  # fmt: skip
    """An edge at which g, or its gradient, provably jumps at a state that is admissible before or after."""
    own, (low, high) = list(c.shape.own), region.parameter_bounds()
    start = np.array(ca.DM(ca.substitute(model.q0, model.p, low + (high - low) / 2))).ravel()[own]
    states = (start, *extremum.samples(region.lower[own], region.upper[own], JUMP_SAMPLE_POINTS))
    column, z = ca.densify(ca.vec(part)), ca.vertcat(c.q, model.t, model.p)
    found = None
    for edge in edges:
        for q in states:
            signs = [interval_bounds.enclose(c.g, z, one, one) for one in edge.at(q)]
            admitted = [bool((low >= 0).all()) for low, _ in signs]
            (a, b), (e, f) = (interval_bounds.enclose(column, z, one, one) for one in edge.at(q))
            size = float(np.linalg.norm(np.maximum(np.maximum(e - b, a - f), 0.0)))
            if not (size > 0 and any(admitted)):
                continue
            left = any(inside and (high < 0).all() for inside, (_, high) in zip(admitted, signs[::-1], strict=True))
            if found is None or left:
                what = "g_i" if name == "b" else "its gradient"
                how = f"{edge.text}, and {what} with it, by at least {size:.3g}"
                how += "; this state is admissible on one side of the edge alone" if left else ""
                witness = {"constraint": c.name, **edge.witness, **dict(zip(c.names, q, strict=True))}
                found = HypothesisAnswer(VIOLATED, {name: np.inf, "jump": size}, how=how, witness=witness)
            if left:
                return found
    return found


def _input_velocity_finding(model: SweepingProcess, region: Region, motion: InputBounds, own: Finding) -> Finding:
    """S-f, its L_t along the inputs."""
    made = for_all.uniform_velocity_finding(model, region, motion) if own.verdict == HOLDS else None
    if made is not None:
        return replace(made, scope=intersect_scopes(made.scope, Scope(parameters=region.parameters)))
    return replace(own, value={name: number for name, number in own.value.items() if name != "L_t"})


def _input_start_finding(model: SweepingProcess, region: Region, motion: InputBounds) -> Finding:
    """S-start at u(0+), where that is known."""
    known = model.bind(motion.start, partly=True)
    box = {name: ends for name, ends in region.parameters.items() if name not in motion.start}
    if not box:
        return start_finding(known)
    at = [(one, {S_START.id: start_finding(known.bind(one))}) for one in uniform.sample_values(box)]
    proof = for_all.uniform_start_finding(known, replace(region, parameters=box))
    return uniform.join_findings(box, at, {} if proof is None else {S_START.id: proof})[0]
