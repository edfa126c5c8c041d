"""Hypotheses of an inclusion: as it stands where nothing depends on time, else at each time and of how its set moves.

Hypotheses of an inclusion with time: those of the inclusion that stands still, at each t, and how fast its set moves.

x'(t) ∈ F(t, x(t)) - S(t, x(t)) - N_C(t)(x(t))

Inclusions with inputs: what holds at each time and value of them, and how fast they move C.

F and S may be measurable in t, as a perturbation of a set that moves at a finite speed: u in them needs no rate.

How fast an inclusion moves on a box.

x' is the element of F - S - N_C of least length, not longer than F - S; projections on C do not stretch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses import region as uniform
from nsmodel.hypotheses.along_run import PAIR_CONSEQUENCES
from nsmodel.hypotheses.exact_roots import findings_at_roots
from nsmodel.hypotheses.findings import (
    HOLDS,
    UNKNOWN,
    VIOLATED,
    Consequence,
    Finding,
    Hypothesis,
    Scope,
    common_scope,
    make_consequence,
    make_finding,
)
from nsmodel.hypotheses.framework import SpeedBound
from nsmodel.hypotheses.inputs import (
    NO_INPUT_BOUNDS,
    InputBounds,
    InputJump,
    missing_rate_reason,
    scheme_limit_consequence,
    unknown_consequence,
)
from nsmodel.hypotheses.region import Region
from nsmodel.hypotheses.staying import ROUNDED_DOWN, StayTime, stay_in_ball
from nsmodel.modeling.parameters import time_as_parameter
from nsmodel.models.monotone_inclusion import autonomous
from nsmodel.models.monotone_inclusion import parameters as for_all
from nsmodel.models.monotone_inclusion.along_run import scheme_convergence
from nsmodel.models.monotone_inclusion.autonomous import HYPOTHESES
from nsmodel.models.monotone_inclusion.field import constraint_set, decompose_field
from nsmodel.models.monotone_inclusion.growth import velocity_bound
from nsmodel.models.monotone_inclusion.model import MonotoneInclusion
from nsmodel.models.monotone_inclusion.schemes import set_constraints
from nsmodel.proof import extremum, interval_bounds
from nsmodel.proof.convex.sets import INTERIOR_MARGIN, ConvexSet, MovingSet, has_interior_for_all, outer_set
from nsmodel.proof.exact import ROUND_UP_FACTOR
from nsmodel.proof.global_search import quick_searches
from nsmodel.proof.jumps import find_jump
from nsmodel.proof.verdict import HypothesisPart
from nsmodel.simulation.trajectory import Trajectory

SET_MOTION = Hypothesis("M-H", "t -> C(t) is Lipschitz continuous in the Hausdorff distance", "Moreau 1977")
EXISTENCE_SOURCE = "Moreau 1977, Edmond and Thibault 2006 (existence); (24) at each t (uniqueness)"
KAPPA = "kappa"
# Orders of 4 in which a speed is looked for above the least that it may be; beyond 4^5 of it the bound is left open.
SPEED_QUADRUPLINGS = 6
# Of the least c in the box, which is < 0: points with c from there to 0 are just outside of C; farther out c_t is not its edge's.
SHELL_PART = 0.02
# Parts of the time, and of all else that C depends on, on each of which a bound is sought where one on all of it fails,
TIME_PARTS = 64
MAX_BOX_PARTS = 256  # and of both together, each with searches; more are left open.
EMPTY_SET_SAMPLES = 9  # Times, with values of all else, at which C is looked at: one at which it is proved empty is enough.
MAY_BE_EMPTY = HypothesisPart(UNKNOWN, "C(t) is not shown to have a point at all times", {}, {})
JUMP_SAMPLES = 256  # Where a point is looked for that a jump of an input puts outside of C: one that is proved is enough.


class MovingSetRates(NamedTuple):
    """C(t) as its p = (t, u, parameters) passes: the box of z = (p, u', x), and the speed of an expression of p and x."""

    C: MovingSet
    motion: InputBounds

    def speed(self, expression: ca.SX) -> ca.SX:
        """The derivative by time."""
        return self.motion.velocity(expression, self.C.p[0])

    @property
    def slow(self) -> tuple[ca.SX, np.ndarray, np.ndarray]:
        """(p, u'), and their box."""
        return self.box(ca.SX(0, 1), np.zeros(0), np.zeros(0))

    def box(self, x: ca.SX, low: np.ndarray, high: np.ndarray) -> tuple[ca.SX, np.ndarray, np.ndarray]:
        """z, and its box where that of x is given."""
        C, (slowest, fastest) = self.C, self.motion.rates
        z = ca.vertcat(C.p, self.motion.v, x)
        return z, np.concatenate([C.lower, slowest, low]), np.concatenate([C.upper, fastest, high])


class HausdorffBound(NamedTuple):
    """d_H(C(t), C(s)) <= kappa |t - s|, and how that was found."""

    kappa: float
    how: str


def check_moving(
    model: MonotoneInclusion, region: Region, runs: Sequence[Trajectory], quick: bool
) -> tuple[list[Finding], list[Consequence]]:
    """Return one finding a hypothesis, of all t between the ends of the region, and what follows; see `check.check`."""
    frozen, time = time_as_parameter(model), (region.t0, region.t1)
    box = {str(model.t): time}
    at_all = replace(region, parameters=MappingProxyType(box))
    seen = []
    for one in uniform.sample_values(box, for_all.special_values(frozen, box)):
        with quick_searches():
            own = autonomous.check_autonomous(frozen.bind(one), replace(region, parameters={}), (), True)[0]
        seen.append((one, {finding.id: finding for finding in own}))
    flat = replace(region, parameters={})
    with quick_searches():
        seen += findings_at_roots(frozen, box, lambda exact_model: autonomous.check_autonomous(exact_model, flat, (), True)[0])
    proved = {finding.id: finding for finding in for_all.uniform_findings(frozen, at_all, quick)}
    findings = [finding_in_time(finding, str(model.t), time) for finding in uniform.join_findings(box, seen, proved)]
    findings.append(set_motion_finding(model, region, NO_INPUT_BOUNDS, quick))
    return findings, moving_consequences(model, findings, runs)


def finding_in_time(finding: Finding, t: str, time: tuple[float, float]) -> Finding:
    """The finding for all values of the parameter t, as one for all times."""
    scope = finding.scope or Scope()
    others = {name: ends for name, ends in scope.parameters.items() if name != t}
    return replace(finding, scope=Scope(scope.states, time, others))


# -- M-H ---------------------------------------------------------------------------------------------------------------


def set_motion_finding(model: MonotoneInclusion, region: Region, motion: InputBounds, quick: bool) -> Finding:
    """A constant kappa with d_H(C(t), C(s)) <= kappa |t - s|, at all values of the parameters (and inputs) of the model."""
    low, high = region.parameter_bounds()
    slow, ends = ca.vertcat(model.t, model.p), (np.append(region.t0, low), np.append(region.t1, high))
    C = MovingSetRates(MovingSet(model.x, slow, set_constraints(model)[0], *ends), motion)
    part = (
        _fixed_set(C) or _input_jump(model, C, region) or _moving_bound_jump(model, C)
        or (_box_speed(model, C) if not model.constraints else _constraint_speed(C, region, quick))
    )  # fmt: skip
    if part.verdict in (HOLDS, UNKNOWN):
        crossing = _crossing_sides(model, C)
        never_empty = has_interior_for_all(C.C, _a_start(model, C)) is not None if model.constraints else not crossing
        empty = None if never_empty else _empty_set(model, C, crossing)
        part = empty or (part if never_empty or part.verdict == UNKNOWN else MAY_BE_EMPTY)
    scope = region.scope(part.local)
    where = Scope(scope.states if scope is not None else {}, (region.t0, region.t1), region.parameters)
    return make_finding(SET_MOTION, part.verdict, part.how, part.value, part.witness, where)


def _crossing_sides(model: MonotoneInclusion, passing: MovingSetRates) -> list[np.ndarray]:
    """Times, with values of all else that C depends on, at which a lower side is not proved to be below its upper one."""
    C, found = passing.C, list[np.ndarray]()
    for low, up in zip(ca.vertsplit(model.lower), ca.vertsplit(model.upper), strict=True):
        if not any(end.is_constant() and np.isinf(float(end)) for end in (low, up)):
            top = extremum.supremum(low - up, C.p, C.lower, C.upper, bound_to=0.0)
            found += [] if top.bound <= 0 else [C.lower if top.at is None else top.at]
    return found


def _a_start(model: MonotoneInclusion, passing: MovingSetRates) -> np.ndarray:
    """The start, at the first values of the parameters."""
    return np.array(ca.DM(ca.substitute(model.x0, model.p, ca.DM(passing.C.lower[1:])))).ravel()


def _empty_set(model: MonotoneInclusion, passing: MovingSetRates, first: Sequence[np.ndarray]) -> HypothesisPart | None:
    """A time at which C is proved to be empty; it is at no finite distance from C at others."""
    C, names = passing.C, set_constraints(model)[1]
    for p in (*first, C.lower, C.upper, *extremum.samples(C.lower, C.upper, EMPTY_SET_SAMPLES)):
        together = ConvexSet(C.x, ca.substitute(C.rows, C.p, ca.DM(p)), names).empty
        if together:
            at = dict(zip(map(str, ca.vertsplit(C.p)), p.tolist(), strict=True))
            witness = {"t": at.pop(str(model.t)), **at, "constraints": list(together)}
            return HypothesisPart(VIOLATED, "C is empty: no point satisfies these constraints", {"points": 0.0}, witness)
    return None


def _fixed_set(passing: MovingSetRates) -> HypothesisPart | None:
    passes = ca.vertcat(passing.C.p[0], passing.motion.u)
    return None if ca.depends_on(passing.C.rows, passes) else HypothesisPart(HOLDS, "C does not move", {KAPPA: 0.0}, {})


def _input_jump(model: MonotoneInclusion, passing: MovingSetRates, region: Region) -> HypothesisPart | None:
    """Where an input that has no rate moves C: a jump of it that provably moves C."""
    C, motion = passing.C, passing.motion
    loose = motion.jumping_indices(C.rows)
    for edge in motion.edges(loose, region):
        seen = _bound_jump(model, C, edge) if not model.constraints else _point_jump(C, edge, region)
        if seen is not None:
            return HypothesisPart(VIOLATED, f"{edge.text}, and C with it", {"jump": seen[0]}, {**edge.witness, **seen[1]})
    return HypothesisPart(UNKNOWN, missing_rate_reason(motion, loose), {}, {}) if loose else None


def _bound_jump(model: MonotoneInclusion, C: MovingSet, edge: InputJump) -> tuple[float, dict[str, Any]] | None:
    """How far a bound of a box jumps."""
    for word, ends in (("lower", model.lower), ("upper", model.upper)):
        for name, end in zip(model.names, ca.vertsplit(ends), strict=True):
            if ca.depends_on(end, C.p):
                (a, b), (c, d) = (np.ravel(interval_bounds.enclose(end, C.p, side, side)) for side in edge.at(np.zeros(0)))
                if max(c - b, a - d) > 0:
                    return float(max(c - b, a - d)), {"bound": f"{word} {name}", "below": (a + b) / 2, "above": (c + d) / 2}
    return None


def _point_jump(C: MovingSet, edge: InputJump, region: Region) -> tuple[float, dict[str, Any]] | None:
    """A point of C on one side of the jump that is not in C on the other, and by how much."""
    z = ca.vertcat(C.x, C.p)
    for x in extremum.samples(region.lower, region.upper, JUMP_SAMPLES):
        before, after = (interval_bounds.enclose(C.rows, z, side, side) for side in edge.at(x))
        for (inside, _), (_, outside) in ((before, after), (after, before)):
            if (inside >= 0).all() and (outside < 0).any():
                return float(-np.min(outside)), {"x": x}
    return None


def _moving_bound_jump(model: MonotoneInclusion, passing: MovingSetRates) -> HypothesisPart | None:
    """A bound that jumps: C does, where it is a box; where nothing jumps that is for the others to bound."""
    C, of = passing.C, ca.vertcat(model.t, passing.motion.u)
    ends = ca.vertcat(*(end for end in (*ca.vertsplit(model.lower), *ca.vertsplit(model.upper)) if ca.depends_on(end, of)))
    if model.constraints or not ends.numel() or interval_bounds.is_continuous(ends, C.p, C.lower, C.upper):
        return None
    jump = find_jump(ends, C.p, C.lower, C.upper, lambda points: np.ones(len(points), bool))
    if jump is None:
        return HypothesisPart(UNKNOWN, "a bound of C may jump; no jump was seen", {}, {})
    at = dict(zip(map(str, ca.vertsplit(C.p)), jump.at.tolist(), strict=True))
    witness = {"t": at.pop(str(model.t)), **at, "below": jump.below, "above": jump.above}
    return HypothesisPart(VIOLATED, "a bound of C jumps", {"jump": jump.size}, witness)


def _box_speed(model: MonotoneInclusion, passing: MovingSetRates) -> HypothesisPart:
    """Of a box: its sides move with their own speeds."""
    total = 0.0
    for ends in zip(ca.vertsplit(model.lower), ca.vertsplit(model.upper), strict=True):
        total += max(_max_rate(passing.speed(end), *passing.slow) for end in ends) ** 2
    kappa = float(np.sqrt(total)) * ROUND_UP_FACTOR
    if not np.isfinite(kappa):
        return HypothesisPart(UNKNOWN, "the speed of a bound of C has no bound that was found", {}, {})
    return HypothesisPart(HOLDS, "bounds of the speeds of the sides", {KAPPA: kappa}, {})


def _constraint_speed(passing: MovingSetRates, region: Region, quick: bool) -> HypothesisPart:
    """The largest of what is found on parts of the time, and of what else C depends on."""
    C = passing.C
    hull = outer_set(C).bounding_box
    local = not np.isfinite(hull).all()
    box = (np.maximum(hull[0], region.lower), np.minimum(hull[1], region.upper)) if local else hull
    left, bounds, whole, count = [(C.lower, C.upper)], dict[str, float](), np.maximum(C.upper - C.lower, 1e-300), 0
    while left:
        low, high = left.pop()
        count += 1
        bound = _hausdorff_bound(passing._replace(C=C._replace(lower=low, upper=high)), box, quick)
        widest = int(np.argmax((high - low) / whole))
        if bound is not None:
            bounds[bound.how] = max(bounds.get(bound.how, 0.0), bound.kappa)
        elif (high - low)[widest] > whole[widest] / TIME_PARTS and count < MAX_BOX_PARTS:
            middle = low[widest] + (high - low)[widest] / 2
            right, up = low.copy(), high.copy()
            right[widest], up[widest] = middle, middle
            left += [(right, high), (low, up)]
        else:
            return HypothesisPart(UNKNOWN, f"no bound was found for t in [{low[0]:.4g}, {high[0]:.4g}]", {}, {}, local)
    return HypothesisPart(HOLDS, "; ".join(bounds), {KAPPA: max(bounds.values())}, {}, local)


def _hausdorff_bound(passing: MovingSetRates, box: tuple[np.ndarray, np.ndarray], quick: bool) -> HausdorffBound | None:
    """One row: |c_t| / |grad c| where c = 0; several: sup |c_t| times the size of the box, over the depth of an inner point."""
    C, (low, high) = passing.C, box
    z, lower, upper = passing.box(C.x, low, high)
    rates = passing.speed(C.rows)
    if not interval_bounds.is_continuous(ca.vertcat(C.rows, rates), z, lower, upper):
        return None
    fastest = max(_max_rate(rate, z, lower, upper) for rate in ca.vertsplit(rates))
    if C.rows.numel() == 1 and (kappa := _normal_speed(C, rates, z, lower, upper, fastest, quick)) is not None:
        return HausdorffBound(kappa, "bounds of |c_t| / |grad c| beside c = 0")
    interior = has_interior_for_all(C, (low + high) / 2)
    point = interior.part.witness.get("interior point") if interior is not None else None
    if interior is None or point is None:
        return None
    far = float(np.linalg.norm(np.maximum(np.abs(low - point), np.abs(high - point))))
    kappa = fastest * far / interior.part.value[INTERIOR_MARGIN] * ROUND_UP_FACTOR
    how = "bounds of |c_t| |x - z| / c(t, z), z an inner point of C(t) for a while: x stays in C by going towards it"
    return HausdorffBound(kappa, how) if np.isfinite(kappa) else None


def _normal_speed(
    C: MovingSet, rate: ca.SX, z: ca.SX, lower: np.ndarray, upper: np.ndarray, fastest: float, quick: bool
) -> float | None:  # fmt: skip
    """A kappa with c_t^2 <= kappa^2 |grad c|^2 where c = 0, and a little outside, where points can be looked at."""
    rate, steep = rate**2, ca.sumsqr(ca.gradient(C.rows, C.x))
    most = extremum.supremum(steep, z, lower, upper, quick=True).bound
    if not (0 < fastest < np.inf and 0 < most < np.inf):
        return 0.0 if fastest == 0 else None

    shell = SHELL_PART * extremum.supremum(-C.rows, z, lower, upper, quick=True).bound

    def enough(kappa: float) -> bool:
        over = rate - kappa**2 * steep
        shell_rows = ca.vertcat(-C.rows, C.rows + shell)
        return extremum.supremum(over, z, lower, upper, where=shell_rows, bound_to=0.0, quick=quick).bound <= 0

    low = fastest / float(np.sqrt(most)) / 2
    high = next((low * 4**k for k in range(1, SPEED_QUADRUPLINGS) if enough(low * 4**k)), None)
    if high is None:
        return None
    low = max(low, high / 4)
    for _ in range(5):
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high


def _max_rate(rate: ca.SX, z: ca.SX, lower: np.ndarray, upper: np.ndarray) -> float:
    if rate.is_zero():
        return 0.0
    return max(extremum.supremum(sign * rate, z, lower, upper, quick=True).bound for sign in (1, -1))


# -- consequences ------------------------------------------------------------------------------------------------------


def moving_consequences(
    model: MonotoneInclusion, findings: Sequence[Finding], runs: Sequence[Trajectory]
) -> list[Consequence]:  # fmt: skip
    """What follows from the findings at each t."""
    numbers = {finding.id: finding.value for finding in findings}
    base = ["M-T", "M-C", "M-A1", "M-A2", "M-24", SET_MOTION.id]
    scope = common_scope(findings, base)
    local = scope is not None and bool(scope.states)
    starts = "from x0 one and only one solution starts" if local else "one and only one solution for each start in C(0)"
    out = [make_consequence("well posed", starts, findings, base, EXISTENCE_SOURCE)]
    L = numbers["M-24"].get("L", np.nan)
    if np.isfinite(L):
        word, ids = "contraction" if L < 0 else "stability", ("M-T", "M-C", "M-24")
        own = common_scope(findings, ids)
        end = " while both stay inside the box" if own is not None and own.states else ""
        statement = f"|x(t) - y(t)| <= e^({L:.6g} t) |x_0 - y_0|{end}"
        out.append(
            make_consequence(word, statement, findings, ids, f"{autonomous.CATCHING_UP_PAPER}, Theorem 7.3, at each t", {"L": L})
        )
    return [*out, *scheme_convergence(model, findings, base, "", runs)]


__all__ = ["HYPOTHESES", "check"]


def check(
    model: MonotoneInclusion, region: Region, runs: Sequence[Trajectory], quick: bool
) -> tuple[list[Finding], list[Consequence]]:
    """Return one finding a hypothesis, and what follows.

    Args:
        model: bound.
        region: the box in which what is not settled everywhere is looked at.
        runs: of this model; their steps enter the tolerances.
        quick: skip global searches.
    """
    decide = check_moving if model.moves else autonomous.check_autonomous
    return decide(model, region, runs, quick)


def uniform_findings(model: MonotoneInclusion, region: Region, quick: bool) -> list[Finding]:
    """What is decided for all values of the parameters, and where the inclusion moves for all times, of which M-H is one."""
    frozen, at_all = parametric_model_and_region(model, region, ())
    found = for_all.uniform_findings(frozen, at_all, quick)
    if not model.moves:
        return found
    found = [finding_in_time(finding, str(model.t), (region.t0, region.t1)) for finding in found]
    return [*found, set_motion_finding(model, region, NO_INPUT_BOUNDS, quick)]


def uniform_consequences(model: MonotoneInclusion, region: Region, own: Sequence[Finding]) -> list[Consequence]:
    """What follows for all values of the parameters; nothing of a start that is not proved to be in C(0) for all of them."""
    made = moving_consequences(model, own, ()) if model.moves else for_all.uniform_consequences(model, region, own)
    return _about_start_inside(model, region, NO_INPUT_BOUNDS, made)


DRIVEN_FIELDS = {"field": ("field",), "operator": ("operator", "sign_arguments"), "set": ("lower", "upper", "constraints")}
START_CONSEQUENCES = ("well posed", "convergence of the scheme")
START_TOLERANCE = 1e-10  # Of the start, by which it may be outside: runs allow as much.
ALL_DRIVEN_FIELDS = tuple(field for fields in DRIVEN_FIELDS.values() for field in fields)


def parametric_model_and_region(
    model: MonotoneInclusion, region: Region, runs: Sequence[Trajectory]
) -> tuple[MonotoneInclusion, Region]:  # fmt: skip
    """The inclusion that stands still at t, a parameter as all others, and the region with the times among its parameters."""
    if not model.moves:
        return model, region
    boxes = {**region.parameters, str(model.t): (region.t0, region.t1)}
    return time_as_parameter(model), replace(region, parameters=MappingProxyType(boxes))


def driven_findings(
    model: MonotoneInclusion, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory], quick: bool
) -> list[Finding]:  # fmt: skip
    """Those at each time and value of the inputs, and M-H.

    Args:
        model: its inputs are parameters.
        region: with the boxes of parameters and inputs.
        motion: the inputs.
        own: what was found at each time and value.
        runs: with the signals of the model; quick: no searches.
    """
    time = region.t0, region.t1
    timed = [finding_in_time(finding, str(model.t), time) for finding in own] if model.moves else list(own)
    return [*timed, set_motion_finding(model, region, motion, quick)]


def driven_consequences(
    model: MonotoneInclusion, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory]
) -> list[Consequence]:  # fmt: skip
    """What follows of solutions for each signal; see `findings`."""
    made = moving_consequences(model, own, runs)
    made = [
        replace(item, statement=f"{item.statement}, of two solutions of one signal") if item.name in PAIR_CONSEQUENCES else item
        for item in made
    ]
    read = motion.indices_read_by(*(getattr(model, name) for name in ALL_DRIVEN_FIELDS))
    made = [scheme_limit_consequence(item, motion, read) if item.name == "convergence of the scheme" else item for item in made]
    return _about_start_inside(model, region, motion, made)


def _about_start_inside(
    model: MonotoneInclusion, region: Region, motion: InputBounds, made: Sequence[Consequence]
) -> list[Consequence]:  # fmt: skip
    """The consequences; what is said of the start is unknown where that may be outside of C(0)."""
    if _starts_inside(model, region, motion):
        return list(made)
    why = "x0 is not seen to be in C(0) for all values"
    return [unknown_consequence(item, why) if item.name in START_CONSEQUENCES else item for item in made]


def _starts_inside(model: MonotoneInclusion, region: Region, motion: InputBounds) -> bool:
    """Whether x0 lies in C(0) for all parameters and u(0+), as nearly as runs ask for."""
    at_start = ca.substitute(set_constraints(model)[0], ca.vertcat(model.t, model.x), ca.vertcat(0, model.x0))
    if not (at_start.numel() and ca.depends_on(at_start, model.p)):
        return True  # a start outside of a set that neither inputs nor parameters move is refused by runs
    low, high = region.parameter_bounds()
    names = list(region.parameters)
    for name, value in motion.start.items():
        low[names.index(name)] = high[names.index(name)] = value
    size = float(np.max(np.abs(interval_bounds.enclose(model.x0, model.p, low, high)), initial=0.0))
    return bool((interval_bounds.enclose(at_start, model.p, low, high)[0] >= -START_TOLERANCE * (1 + size)).all())


def speed_bound(
    model: MonotoneInclusion, region: Region, findings: Sequence[Finding], known: Mapping[str, Consequence], h: float
) -> SpeedBound | None:  # fmt: skip
    """The pace on the box, a step ahead of it by its predictor; None where it has no bound, or projections are approximate."""
    if callable(model.tolerances) or (model.tolerances is not None and np.any(np.asarray(model.tolerances, float))):
        return None
    if model.moves or model.p.numel():
        return None  # see `stay_times`
    top = velocity_bound(decompose_field(model, constraint_set(model)), (region.lower, region.upper))
    return None if top is None else SpeedBound(top, h * top)


def stay_times(
    model: MonotoneInclusion, region: Region, findings: Sequence[Finding], start: tuple[np.ndarray, np.ndarray]
) -> list[StayTime]:  # fmt: skip
    """By |x'|^2 <= |F - S|^2 + kappa^2, as of a sweeping process; for C at rest by |x - x0|' <= L |x - x0| + |F - S|(x0)."""
    number = {finding.id: finding.value for finding in findings if finding.verdict == HOLDS}
    if model.phi is not None or "M-T" not in number:
        return []
    (low, high), time = region.parameter_bounds(), (region.t0, region.t1)
    signs, others = np.ones(model.sign_symbols.numel()), ca.vertcat(model.t, model.p, model.sign_symbols)
    size, z = ca.sumsqr(model.field - model.operator), ca.vertcat(model.x, others)
    ends = [np.concatenate([[t], p, sign * signs]) for t, p, sign in zip(time, (low, high), (-1, 1), strict=True)]

    def speed(lower: np.ndarray, upper: np.ndarray) -> float:
        top = extremum.supremum(size, z, np.append(lower, ends[0]), np.append(upper, ends[1]), quick=True).bound
        return float(np.sqrt(max(top, 0.0))) * ROUND_UP_FACTOR

    kappa = number.get(SET_MOTION.id, {}).get(KAPPA, np.inf) if model.moves else 0.0
    room = float(np.min(np.minimum(start[0] - region.lower, region.upper - start[1]), initial=np.inf))
    top, L = float(np.hypot(speed(region.lower, region.upper), kappa)), number.get("M-24", {}).get("L", np.inf)
    found = (
        [StayTime(room / top * ROUNDED_DOWN if top > 0 else np.inf, f"moving at {top:.5g} at most")] if np.isfinite(top) else []
    )
    if kappa == 0:
        drive = speed(*start)
        found.append(StayTime(stay_in_ball(0.0, L, drive, room), f"as |x - x0|' <= {L:.5g} |x - x0| + {drive:.5g}"))
    last = region.t1 if ca.depends_on(size, model.t) or model.moves else np.inf
    return [item._replace(until=min(item.until, last)) for item in found]
