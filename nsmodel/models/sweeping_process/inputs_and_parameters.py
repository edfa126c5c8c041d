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

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import casadi as ca
import numpy as np

from nsmodel.hypotheses import region as uniform
from nsmodel.hypotheses.findings import (
    HOLDS,
    SAMPLED,
    UNKNOWN,
    VIOLATED,
    Consequence,
    Finding,
    Hypothesis,
    Scope,
    intersect_scopes,
    make_finding,
)
from nsmodel.hypotheses.framework import SpeedBound
from nsmodel.hypotheses.inputs import NO_INPUT_BOUNDS, InputBounds, InputJump, missing_rate_reason
from nsmodel.hypotheses.region import Region, findings_for_box, unaffected_findings
from nsmodel.models.sweeping_process.admissible_points import build_process, point_of_start_set
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
from nsmodel.models.sweeping_process.constraint_constants import scaled_answer, uniform_answers
from nsmodel.models.sweeping_process.constraint_shapes import ConstraintShape, read_shapes
from nsmodel.models.sweeping_process.model import SweepingProcess
from nsmodel.models.sweeping_process.qualification import RHO_FRACTION, RHO_TRIES
from nsmodel.models.sweeping_process.qualification_bounds import GammaProof, bound_gamma_everywhere
from nsmodel.proof import extremum, interval_bounds
from nsmodel.proof.domain import is_defined_on_box
from nsmodel.proof.exact import ROUND_UP_FACTOR
from nsmodel.proof.expression_graph import is_same_expression, rewrite_nodes, stack_column
from nsmodel.proof.jumps import SWITCH_OPERATIONS
from nsmodel.proof.verdict import HypothesisPart
from nsmodel.simulation.trajectory import Trajectory

READS = {hypothesis.id: ("g",) for hypothesis in (*CONSTRAINT_HYPOTHESES, A5, A5_ACTIVE)} | {
    S_F.id: ("f", "g"),
    S_START.id: ("g", "q0"),
}


def uniform_findings(model: SweepingProcess, region: Region, quick: bool) -> list[Finding]:
    """What is decided for all values of the parameters, whose boxes are those of ``region``."""
    same = unaffected_findings(check, model, region, quick, READS)
    constraints = constraints_with_parameters(model, region)
    made, each = uniform_shape_findings(constraints, region, quick)
    start = uniform_start_finding(model, region)
    own = [uniform_velocity_finding(model, region), start, *made]
    qualified = uniform_mfcq(constraints, each, region, partial(bound_gamma_everywhere, moving=True))
    if qualified and _known_start_point(model, region, start).verdict == HOLDS:
        own += qualified
    return findings_for_box((item for item in own if item is None or item.verdict == HOLDS), same, region)


def uniform_consequences(model: SweepingProcess, region: Region, own: Sequence[Finding]) -> list[Consequence]:
    """What follows for all values of the parameters; nothing where gamma is not known."""
    known = {finding.id: finding.value for finding in own}
    if not all("gamma" in known[id] for id in (A5.id, A5_ACTIVE.id)):
        return []
    start = next(finding for finding in own if finding.id == S_START.id)
    known_point = _known_start_point(model, region, start)
    return sweeping_consequences(model, own, (), model.g.numel(), known_point)


def _known_start_point(model: SweepingProcess, region: Region, start: Finding | None) -> HypothesisPart:
    """Whether Q(0) is known to have a point: the start for all values of the parameters, or another one at some of them."""
    if start is not None and start.verdict == HOLDS:
        return HypothesisPart(HOLDS, start.how, {}, {})
    processes = (build_process(model.bind(one), region, (), 0) for one in uniform.sample_values(region.parameters))
    answers = [point_of_start_set(model, region, next(processes))]
    while answers[-1].verdict != HOLDS and (process := next(processes, None)) is not None:
        answers.append(point_of_start_set(model, region, process))
    found = answers[-1] if answers[-1].verdict == HOLDS else answers[0]
    unsure = start is not None and start.verdict == SAMPLED and found.verdict == UNKNOWN
    return found._replace(verdict=SAMPLED) if unsure else found


def constraints_with_parameters(
    model: SweepingProcess, region: Region, motion: InputBounds = NO_INPUT_BOUNDS
) -> list[Constraint]:
    """The constraints, with (t, p) in the place of time, and u' behind it where inputs are among p."""
    slow, (low, high), (slowest, fastest) = ca.vertcat(model.t, model.p, motion.v), region.parameter_bounds(), motion.rates
    still = stack_column(p for p in ca.vertsplit(model.p) if not ca.depends_on(motion.u, p)) if model.p.numel() else model.p
    ends = np.concatenate([[region.t0], low, slowest]), np.concatenate([[region.t1], high, fastest])
    rows = zip(
        model.multiplier_names, ca.vertsplit(model.g), read_shapes(model.g, model.q, still), read_shapes(model.g, model.q),
        strict=True,
    ) if model.multiplier_names else ()  # fmt: skip
    return [
        parametric_constraint(name, g, shapes, slow, ends, model.q, model.names, (region.lower, region.upper), motion)
        for name, g, *shapes in rows
    ]


def parametric_constraint(
    name: str, g: ca.SX, shapes: Sequence[ConstraintShape], slow: ca.SX, ends: tuple[np.ndarray, np.ndarray], q: ca.SX,
    names: Sequence[str], box: tuple[np.ndarray, np.ndarray], motion: InputBounds = NO_INPUT_BOUNDS,
) -> Constraint:  # fmt: skip
    """A constraint with (t, p) in the place of time, without a factor that is > 0 for all parameters.

    Args:
        name, g: the constraint.
        shapes: of g with and without a factor.
        slow, ends: t first, parameters, and u'; with bounds.
        q, names, box: the states with bounds.
        motion: the inputs among the parameters.
    """
    read, shape = shapes
    scale = (1.0, 1.0)
    if read.factor is not None:
        least, most = (float(end.item()) for end in interval_bounds.enclose(read.factor, slow, *ends))
        if 0 < least <= most < np.inf:
            factor, shape, scale = read.factor, read, (least, most)
            others = [g.dep(1 - k) for k in (0, 1) if g.op() == ca.OP_MUL and is_same_expression(g.dep(k), factor)]
            g = (others or [g / factor])[0]
    shape, own = replace(shape, time=bool(ca.depends_on(g, slow[0]))), list(shape.own)
    lower, upper = (np.append(end, states[own]) for end, states in zip(ends, box, strict=True))
    return Constraint(name, g, shape, slow, q[own], tuple(names[i] for i in own), lower, upper, motion, scale)


def uniform_shape_findings(
    constraints: Sequence[Constraint], region: Region, quick: bool, count: int | None = None
) -> tuple[list[Finding], list[AnswersById]]:
    """What is proved of the constraints one by one; ``count``: as many as they stand for."""
    each = [uniform_answers(constraint, quick) for constraint in constraints]
    own = [h for h in CONSTRAINT_HYPOTHESES if all(h.id in answers for answers in each)]
    made = [joined_finding(hypothesis, constraints, each, region) for hypothesis in own]
    if count is not None:
        made = [replace(item, how=f"{count} constraints, decided on {len(each)}; {item.how}") for item in made]
    return made, each


def uniform_mfcq(
    constraints: Sequence[Constraint], each: Sequence[AnswersById], region: Region,
    bound: Callable[[Sequence[Constraint], float], GammaProof | None],
) -> list[Finding]:  # fmt: skip
    """A5 and A5' by the rules that hold for all states and need no point of the set.

    c g <= rho, c >= c_0, has g <= rho / c_0: what is proved within rho of g holds within c_0 rho of c g.
    """
    if not all({"A0", "A1"} <= set(answers) for answers in each):
        return []
    reaches = [2 * answers["A0"].value.get("delta", np.inf) for answers in each]
    across = float(np.max(region.upper - region.lower, initial=0.0))
    reach = min([reach if np.isfinite(reach) else across / 2 for reach in reaches], default=1.0)
    proofs = [bound(constraints, RHO_FRACTION * reach * 4.0**-k) for k in range(RHO_TRIES)]
    near = next((proof for proof in proofs if proof is not None and np.isfinite(proof.gamma)), None)
    timed, least = any(c.shape.time for c in constraints), min((c.scale[0] for c in constraints), default=1.0)
    near = near and near._replace(rho=near.rho * min(least, 1.0))
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
    """S-f by bounds of f and its derivative over (t, p) and all states, else over (t, p) and the box.

    A switch of time and parameters alone has one value at each of these: it is a number between bounds, and f has no L_t.
    """
    n, slow, (low, high) = model.q.numel(), ca.vertcat(model.t, model.p), region.parameter_bounds()
    now = np.append(region.t0, low), np.append(region.t1, high)
    nodes: list[tuple[ca.SX, ca.SX]] = []

    def switch(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX | None:
        if ca.depends_on(old, model.q):
            return None
        nodes.append((ca.SX.sym(f"s{len(nodes)}"), old))
        return nodes[-1][0]

    f = rewrite_nodes(model.f, switch, (*SWITCH_OPERATIONS, ca.OP_IF_ELSE_ZERO), slow, "f")
    s, between = stack_column(one for one, _ in nodes), (np.zeros(0), np.zeros(0))
    if nodes:
        switched = stack_column(old for _, old in nodes)
        if not is_defined_on_box(switched, slow, slow, *now):
            return None
        between = tuple(np.ravel(end) for end in interval_bounds.enclose(switched, slow, *now))
    z, J, timed = ca.vertcat(slow, s, model.q), ca.jacobian(f, model.q), bool(ca.depends_on(model.f, model.t))
    wide = np.full(n, np.inf)
    for lower, upper, local in ((-wide, wide, False), (region.lower, region.upper, True)):
        ends = tuple(np.concatenate(parts) for parts in zip(now, between, (lower, upper), strict=True))
        if not interval_bounds.is_continuous(f, z, *ends):
            continue
        steep = extremum.spectral_norm(J, z, *ends, quick=not local).bound
        about = ca.substitute(f, model.q, ca.DM.zeros(n)) if not local else f
        size = extremum.supremum(ca.sumsqr(about), z, *ends, quick=not local).bound
        rate = np.inf if nodes else _velocity_rate(model, region, motion, lower, upper)
        if np.isfinite(steep) and np.isfinite(size):
            K_f, at_0 = max(steep, 0.0) * SUP_ROUNDING_FACTOR, np.sqrt(max(size, 0.0)) * SUP_ROUNDING_FACTOR
            value = {"K_f": K_f, "L_f": at_0 if local else max(K_f, at_0)}
            value |= {"L_t": np.sqrt(rate) * SUP_ROUNDING_FACTOR} if np.isfinite(rate) else {}
            return make_finding(S_F, HOLDS, "bounds of f and of its derivative", value, scope=region.scope(local, timed))
    return None


def _velocity_rate(
    model: SweepingProcess, region: Region, motion: InputBounds, lower: np.ndarray, upper: np.ndarray
) -> float:  # fmt: skip
    """A bound of |d f/dt|^2 along the inputs, over these states."""
    speed, (slowest, fastest) = ca.sumsqr(motion.velocity(model.f, model.t)), motion.rates
    low, high = region.parameter_bounds()
    ends = np.concatenate([[region.t0], low, lower, slowest]), np.concatenate([[region.t1], high, upper, fastest])
    z = ca.vertcat(model.t, model.p, model.q, motion.v)
    return 0.0 if speed.is_zero() else extremum.supremum(speed, z, *ends, quick=True).bound


def uniform_start_finding(model: SweepingProcess, region: Region) -> Finding | None:
    """S-start: g_i(0, q_0) >= 0 for all values, by bounds."""
    at_start = ca.substitute(model.g, ca.vertcat(model.t, model.q), ca.vertcat(0, model.q0))
    ends = region.parameter_bounds()
    if not is_defined_on_box(at_start, model.p, model.p, *ends):
        return None
    tops = [extremum.supremum(-g, model.p, *ends, bound_to=0.0).bound for g in ca.vertsplit(at_start)] if at_start.numel() else []
    if not all(top <= 0 for top in tops):
        return None
    return make_finding(S_START, HOLDS, "bounds of g_i(0, q_0)", {"min g": min((-top for top in tops), default=0.0)})


DRIVEN_FIELDS = {"f": ("f",), "constraints": ("constraints",)}
JUMP_SAMPLE_POINTS = 64  # Where a jump of a constraint is looked for: one that is proved is enough.


def driven_findings(
    model: SweepingProcess, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory], quick: bool
) -> list[Finding]:  # fmt: skip
    """Those at each time and value of the inputs, but for speeds and the start; see the inclusions' module of this name."""
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
    known = {} if motion.jumping_indices(c.g) else uniform_answers(c, quick)
    made: AnswersById = {}
    for id, part, name in (("A2", c.g, "b"), ("A3", ca.gradient(c.g, c.q), "M")):
        loose = motion.jumping_indices(part)
        if id in known:
            made[id] = known[id]
        elif loose:
            nothing = HypothesisAnswer(UNKNOWN, how=missing_rate_reason(motion, loose), witness={"constraint": c.name})
            made[id] = _edge_jump_answer(c, part, name, model, region, motion.edges(loose, region)) or nothing
        else:
            made[id] = _speed_bound_answer(c, part, name, quick) if ca.depends_on(part, c.t) else time_invariant_answer(name)
            made[id] = scaled_answer(made[id], *c.scale)
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
    z, (start, end) = ca.vertcat(model.t, model.q, model.p), region.bounds_with_time()
    low, high = region.parameter_bounds()
    top = velocity_norm_bound(model.f, z, np.append(start, low), np.append(end, high))
    return sweeping_speed_bound(top, findings, known["K_L"], h) if "K_L" in known else None


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
