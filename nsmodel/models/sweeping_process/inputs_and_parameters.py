"""Sweeping processes with inputs: f may be measurable in t, Q(t) must be Lipschitz.

What does not ask for speeds is decided at each time and value of the inputs; A2, A3 and the L_t of S-f for their velocities.

Hypotheses of a sweeping process for all values of parameters in a box.

Parameters enter a constraint as time does, but for the speeds of A2 and A3: shapes are those of all times and values, and what
is bounded over time is bounded over (t, p). Planes and distances are decided so, of other shapes those without parameters.

How fast a sweeping process moves on a box.

q' = f - n with n normal to Q(t), and the set of velocities that stay in Q(t) holds some v_0, |v_0| <= K_L;
q' is the one nearest to f, so that <f - q', v_0 - q'> <= 0, which is |q'|^2 <= |f|^2 + K_L^2. A step of the scheme projects
q + h f on a polyhedron that holds a point within h K_L of q: the same, where rho is above what a constraint can close in it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from nsmodel.hypotheses import region as uniform
from nsmodel.hypotheses.along_run import ROUND_UP_FACTOR
from nsmodel.hypotheses.findings import (
    HOLDS,
    UNKNOWN,
    VIOLATED,
    Consequence,
    Finding,
    Hypothesis,
    IntervalBox,
    Scope,
    intersect_scopes,
    make_finding,
)
from nsmodel.hypotheses.framework import SpeedBound
from nsmodel.hypotheses.inputs import NO_INPUT_BOUNDS, InputBounds, InputJump, missing_rate_reason
from nsmodel.hypotheses.region import ParameterValues, Region, findings_for_box, unaffected_findings
from nsmodel.models.sweeping_process.admissible_points import build_process
from nsmodel.models.sweeping_process.check import (
    A2,
    A3,
    A5,
    A5_ACTIVE,
    CONSTRAINT_HYPOTHESES,
    S_F,
    S_START,
    check,
    joined_finding,
    known_start_point,
    start_finding,
    sweeping_consequences,
)
from nsmodel.models.sweeping_process.constraint_bounds import (
    ON_THE_BOX,
    SUP_ROUNDING_FACTOR,
    AnswersById,
    Constraint,
    HypothesisAnswer,
    time_invariant_answer,
)
from nsmodel.models.sweeping_process.constraint_constants import uniform_shape_answers
from nsmodel.models.sweeping_process.constraint_shapes import ConstraintShape, read_shapes
from nsmodel.models.sweeping_process.model import SweepingProcess
from nsmodel.models.sweeping_process.qualification import RHO_FRACTION, RHO_TRIES
from nsmodel.models.sweeping_process.qualification_bounds import GammaProof, bound_gamma_everywhere
from nsmodel.proof import extremum, interval_bounds
from nsmodel.proof.jumps import jump_nodes
from nsmodel.simulation.trajectory import Trajectory

READS = {hypothesis.id: ("g",) for hypothesis in (*CONSTRAINT_HYPOTHESES, A5, A5_ACTIVE)} | {
    S_F.id: ("f", "g"),
    S_START.id: ("g", "q0"),
}


def special_values(model: SweepingProcess, box: IntervalBox) -> list[ParameterValues]:
    """No values are special."""
    return []


def uniform_findings(model: SweepingProcess, region: Region, quick: bool) -> list[Finding]:
    """What is decided for all values of the parameters, whose boxes are those of ``region``."""
    same = unaffected_findings(check, model, region, quick, READS)
    constraints = constraints_with_parameters(model, region)
    each = [uniform_shape_answers(constraint) if is_smooth_in_time(constraint) else None for constraint in constraints]
    own: list[Finding | None] = [uniform_velocity_finding(model, region), uniform_start_finding(model, region)]
    answers = [answer for answer in each if answer is not None]
    if len(answers) == len(each):
        own += [joined_finding(hypothesis, constraints, answers, region) for hypothesis in CONSTRAINT_HYPOTHESES]
        own += _uniform_mfcq(constraints, answers, region)
    return findings_for_box((item for item in own if item is None or item.verdict == HOLDS), same, region)


def uniform_consequences(model: SweepingProcess, region: Region, own: Sequence[Finding]) -> list[Consequence]:
    """What follows for all values of the parameters; nothing where gamma is not known."""
    known = {finding.id: finding.value for finding in own}
    if not all("gamma" in known[id] for id in (A5.id, A5_ACTIVE.id)):
        return []
    start = next(finding for finding in own if finding.id == S_START.id)
    seen = (build_process(model.bind(values), region, (), 0) for values in uniform.sample_values(region.parameters))
    answers = (known_start_point(model, region, start, process) for process in seen)
    first = next(answers)
    known_point = first if first.verdict == HOLDS else next((answer for answer in answers if answer.verdict == HOLDS), first)
    return sweeping_consequences(model, own, (), model.g.numel(), known_point)


def constraints_with_parameters(
    model: SweepingProcess, region: Region, motion: InputBounds = NO_INPUT_BOUNDS
) -> list[Constraint]:
    """The constraints, with (t, p) in the place of time, and u' behind it where inputs are among p."""
    slow, (low, high), (slowest, fastest) = ca.vertcat(model.t, model.p, motion.v), region.parameter_bounds(), motion.rates
    found = []
    for name, g, shape in zip(
        model.multiplier_names, ca.vertsplit(model.g), read_shapes(model.g, model.q), strict=True
    ) if model.multiplier_names else ():  # fmt: skip
        rows = list(shape.own)
        names = tuple(model.names[i] for i in rows)
        lower, upper = (
            np.concatenate([[t], p, v, x[rows]])
            for t, p, v, x in ((region.t0, low, slowest, region.lower), (region.t1, high, fastest, region.upper))
        )
        found.append(
            Constraint(name, g, _with_time_dependence(shape, g, model), slow, model.q[rows], names, lower, upper, motion)
        )
    return found


def is_smooth_in_time(c: Constraint) -> bool:
    """Whether neither g nor its gradient jumps with time or with parameters, where derivatives would not tell."""
    both = ca.vertcat(c.g, ca.gradient(c.g, c.q))
    return not jump_nodes(both, c.t) or interval_bounds.is_continuous(both, c.z, c.lower, c.upper)


def _with_time_dependence(shape: ConstraintShape, g: ca.SX, model: SweepingProcess) -> ConstraintShape:
    """The shape with whether it moves in time, of which parameters are none."""
    return replace(shape, time=bool(ca.depends_on(g, model.t)))


def _uniform_mfcq(constraints: Sequence[Constraint], each: Sequence[AnswersById], region: Region) -> list[Finding]:
    """A5 and A5' by the rules that hold for all states and need no point of the set."""
    reaches = [2 * answers["A0"].value.get("delta", np.inf) for answers in each]
    across = float(np.max(region.upper - region.lower, initial=0.0))
    reach = min([reach if np.isfinite(reach) else across / 2 for reach in reaches], default=1.0)
    proofs = [bound_gamma_everywhere(constraints, RHO_FRACTION * reach * 4.0**-k, moving=True) for k in range(RHO_TRIES)]
    near = next((proof for proof in proofs if proof is not None and np.isfinite(proof.gamma)), None)
    timed = any(constraint.shape.time for constraint in constraints)
    return (
        []
        if near is None
        else [_uniform_gamma_finding(A5, near, region, timed), _uniform_gamma_finding(A5_ACTIVE, near, region, timed)]
    )


def _uniform_gamma_finding(hypothesis: Hypothesis, proof: GammaProof, region: Region, timed: bool) -> Finding:
    value = {"gamma": max(proof.gamma, 1.0)} | ({"rho": proof.rho} if hypothesis is A5 and np.isfinite(proof.rho) else {})
    any_rho = "; for every rho" if hypothesis is A5 and "rho" not in value else ""
    return make_finding(hypothesis, HOLDS, proof.how + any_rho, value, scope=region.scope(timed=timed))


def uniform_velocity_finding(model: SweepingProcess, region: Region, motion: InputBounds = NO_INPUT_BOUNDS) -> Finding | None:
    """S-f by bounds of f and its derivative over (t, p) and all states, else over (t, p) and the box."""
    f, (low, high) = model.f, region.parameter_bounds()
    z, J = ca.vertcat(model.t, model.p, model.q), ca.jacobian(f, model.q)
    n, timed = model.q.numel(), bool(ca.depends_on(f, model.t))
    speed, (slowest, fastest) = ca.sumsqr(motion.velocity(f, model.t)), motion.rates
    wide = np.full(n, np.inf)
    for lower, upper, local in ((-wide, wide, False), (region.lower, region.upper, True)):
        ends = np.concatenate([[region.t0], low, lower]), np.concatenate([[region.t1], high, upper])
        if not interval_bounds.is_continuous(f, z, *ends):
            continue
        steep = extremum.spectral_norm(J, z, *ends, quick=not local).bound
        about = ca.substitute(f, model.q, ca.DM.zeros(n)) if not local else f
        size = extremum.supremum(ca.sumsqr(about), z, *ends, quick=not local).bound
        moving = np.append(ends[0], slowest), np.append(ends[1], fastest)
        rate = 0.0 if speed.is_zero() else extremum.supremum(speed, ca.vertcat(z, motion.v), *moving, quick=True).bound
        if np.isfinite(steep) and np.isfinite(size):
            K_f, at_0 = max(steep, 0.0) * SUP_ROUNDING_FACTOR, np.sqrt(max(size, 0.0)) * SUP_ROUNDING_FACTOR
            value = {"K_f": K_f, "L_f": at_0 if local else max(K_f, at_0)}
            value |= {"L_t": np.sqrt(rate) * SUP_ROUNDING_FACTOR} if np.isfinite(rate) else {}
            return make_finding(S_F, HOLDS, "bounds of f and of its derivative", value, scope=region.scope(local, timed))
    return None


def uniform_start_finding(model: SweepingProcess, region: Region) -> Finding | None:
    """S-start: g_i(0, q_0) >= 0 for all values, by bounds."""
    at_start = ca.substitute(model.g, ca.vertcat(model.t, model.q), ca.vertcat(0, model.q0))
    ends = region.parameter_bounds()
    tops = [extremum.supremum(-g, model.p, *ends, bound_to=0.0).bound for g in ca.vertsplit(at_start)] if at_start.numel() else []
    if not all(top <= 0 for top in tops):
        return None
    return make_finding(S_START, HOLDS, "bounds of g_i(0, q_0)", {"min g": min((-top for top in tops), default=0.0)})


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
    return state_for_each_signal(uniform_consequences(model, region, own))


def state_for_each_signal(made: Sequence[Consequence]) -> list[Consequence]:
    """The consequences, that on solutions in the words of a model with inputs."""
    statements = {item.name: f"for each signal {item.statement}" for item in made if item.name == "well posed"}
    return [replace(item, statement=statements.get(item.name, item.statement)) for item in made]


def _speed_findings(model: SweepingProcess, region: Region, motion: InputBounds, quick: bool) -> list[Finding]:
    """A2 and A3 of constraints along the inputs."""
    constraints = constraints_with_parameters(model, region, motion)
    each = [_speed_answers(c, model, region, motion, quick) for c in constraints]
    scope = Scope(parameters=region.parameters)
    made = [joined_finding(hypothesis, constraints, each, region) for hypothesis in (A2, A3)]
    return [replace(finding, scope=intersect_scopes(finding.scope, scope)) for finding in made]


def _speed_answers(c: Constraint, model: SweepingProcess, region: Region, motion: InputBounds, quick: bool) -> AnswersById:
    known = uniform_shape_answers(c) if is_smooth_in_time(c) and not motion.jumping_indices(c.g) else None
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
    made = uniform_velocity_finding(model, region, motion) if own.verdict == HOLDS else None
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
    proof = uniform_start_finding(known, replace(region, parameters=box))
    return uniform.join_findings(box, at, {} if proof is None else {S_START.id: proof})[0]


def speed_bound(
    model: SweepingProcess, region: Region, findings: Sequence[Finding], known: Mapping[str, Consequence], h: float
) -> SpeedBound | None:  # fmt: skip
    """The pace on the box; None where it has no bound."""
    z = ca.vertcat(model.t, model.q)
    return sweeping_speed_bound(velocity_norm_bound(model.f, z, *region.bounds_with_time()), findings, known["K_L"], h)


def sweeping_speed_bound(f: float, findings: Sequence[Finding], moves: Consequence, h: float) -> SpeedBound | None:
    """The pace where |f| is at most ``f``."""
    number = {(finding.id, name): value for finding in findings for name, value in finding.value.items()}
    holds = {finding.id for finding in findings if finding.verdict == HOLDS}
    if not np.isfinite(f) or not {"S-convex", "S-start"} <= holds:
        return None
    rate = number.get(("A2", "b"), 0.0) if "A2" in holds else np.inf
    if not rate:
        return SpeedBound(f, h * f)
    K_L, b, rho = moves.value.get("K_L", np.inf), number.get(("A1", "b"), np.inf), number.get(("A5", "rho"), np.inf)
    if moves.verdict != HOLDS or not h * (rate + b * K_L) <= rho:
        return None
    return SpeedBound(float(np.hypot(f, K_L)) * ROUND_UP_FACTOR, h * f * ROUND_UP_FACTOR)


def velocity_norm_bound(f: ca.SX, z: ca.SX, lower: np.ndarray, upper: np.ndarray, count: int = 1) -> float:
    """A bound of |f| over a box of z, of so many bodies together."""
    top = extremum.supremum(ca.sumsqr(f), z, lower, upper, quick=True).bound
    return float(np.sqrt(count * max(top, 0.0))) * ROUND_UP_FACTOR
