"""The hypotheses of Bernicot and Venel (2010) for a sweeping process, and what follows from them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import casadi as ca
import numpy as np

from nsmodel.classes.sweeping.hypotheses.admissible import PartialSweepingProcess, admissible_points, build_process
from nsmodel.classes.sweeping.hypotheses.consequences import sweeping_consequences
from nsmodel.classes.sweeping.hypotheses.constants import decide_constraint
from nsmodel.classes.sweeping.hypotheses.constraint import ON_THE_BOX, AnswersById, Constraint
from nsmodel.classes.sweeping.hypotheses.qualification import MAX_BOX_STATES, QualificationResult, decide_mfcq
from nsmodel.classes.sweeping.hypotheses.shapes import read_shapes
from nsmodel.classes.sweeping.hypotheses.start import ROUNDING_DEFICIT, start_sign
from nsmodel.classes.sweeping.hypotheses.velocity import decide_velocity
from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Consequence, Finding, Hypothesis, make_finding
from nsmodel.hypotheses.region import Region
from nsmodel.proof import exact, interval_bounds
from nsmodel.proof.global_search import searches_are_quick
from nsmodel.simulation.trajectory import Trajectory

TimedState = tuple[float, np.ndarray]
BERNICOT_VENEL = "Bernicot and Venel 2010"
S_CONVEX = Hypothesis("S-convex", "g_i(t, .) is convex", f"{BERNICOT_VENEL}, section 2")
A0 = Hypothesis("A0", "the boundary of U_i(t) stays at a distance > c from Q_i(t)", f"{BERNICOT_VENEL}, (A0)")
A1 = Hypothesis("A1", "a <= |grad_q g_i| <= b on U_i(t)", f"{BERNICOT_VENEL}, (A1)")
A2 = Hypothesis("A2", "|d_t g_i| <= b", f"{BERNICOT_VENEL}, (A2)")
A3 = Hypothesis("A3", "|d_t grad_q g_i| <= M on U_i(t)", f"{BERNICOT_VENEL}, (A3)")
A4 = Hypothesis("A4", "|D^2_q g_i| <= M on U_i(t)", f"{BERNICOT_VENEL}, (A4)")
A5 = Hypothesis(
    "A5", "sum l_i |grad g_i| <= gamma |sum l_i grad g_i| for all l >= 0, over the i with g_i <= rho, at every q in Q(t)",
    f"{BERNICOT_VENEL}, (A5)",
)  # fmt: skip
A5_ACTIVE = Hypothesis("A5'", "the same over the active constraints, g_i = 0 (quantified MFCQ)", f"{BERNICOT_VENEL}, (A5')")
S_F = Hypothesis("S-f", "|f(t,q) - f(t,q')| <= K_f |q - q'|, |f(t,q)| <= L_f (1 + |q|)", f"{BERNICOT_VENEL}, (7) and (8)")
S_START = Hypothesis("S-start", "q_0 is in Q(0)", f"{BERNICOT_VENEL}, (4)")
HYPOTHESES = (S_CONVEX, A0, A1, A2, A3, A4, A5, A5_ACTIVE, S_F, S_START)

MINIMISED_VALUES = ("a", "c", "least")  # Of these numbers the least over the constraints counts, of the others the largest.
MANY_STATES = 24  # With more states fewer points are looked at.
MANY_UNKNOWN_SHAPES = 40  # From so many constraints without a known shape on, bounds over the box are not refined.


def check(
    model: SweepingProcess, region: Region, runs: Sequence[Trajectory], quick: bool
) -> tuple[list[Finding], list[Consequence]]:
    """Decide the hypotheses of a sweeping process.

    Args:
        model: bound.
        region: a box of states and times; constraints of known shape are decided for all states.
        runs: of this model.
        quick: no searches.

    Returns:
        One finding for each of ``HYPOTHESES``, and the consequences.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # NaN and inf are met on purpose, where gradients do not exist.
        constraints = _constraints_on_region(model, region)
        process = _process_with_points(model, constraints, region, runs)
        unknown = sum(c.shape.kind == "other" for c in constraints)
        each = _answers_of_constraints(constraints, quick or unknown > MANY_UNKNOWN_SHAPES)
        findings = [joined_finding(hypothesis, constraints, each, region) for hypothesis in HYPOTHESES[:6]]
        points = _admissible_sample(process, len(model.names) > MANY_STATES, quick or searches_are_quick())
        near, active = _mfcq_of_constraints(constraints, each, process, points, model, quick or searches_are_quick())
        timed = any(constraint.shape.time for constraint in constraints)
        findings += [gamma_finding(A5, near, region, timed), gamma_finding(A5_ACTIVE, active, region, timed)]
        findings.append(_velocity_finding(model, process, region, points, quick))
        findings.append(_decide_start_signs(model, constraints))
    return findings, sweeping_consequences(model, findings, runs, len(constraints))


def mfcq_results(
    model: SweepingProcess, region: Region, runs: Sequence[Trajectory], quick: bool
) -> tuple[QualificationResult, QualificationResult]:
    """Return A5 and A5' alone."""
    quick = quick or searches_are_quick()
    constraints = _constraints_on_region(model, region)
    process = _process_with_points(model, constraints, region, runs)
    unknown = sum(c.shape.kind == "other" for c in constraints)
    each = _answers_of_constraints(constraints, quick or unknown > MANY_UNKNOWN_SHAPES)
    if not quick and len(model.names) > MAX_BOX_STATES:  # Bounds of so many states need no points.
        known = [(t, q) for t, q in process.known if process.admits(*process.at(t, q))]
        found = _mfcq_of_constraints(constraints, each, process, known, model, True)
        if found[0].verdict == HOLDS:
            return found
    return _mfcq_of_constraints(
        constraints, each, process, _admissible_sample(process, len(model.names) > MANY_STATES, quick), model, quick
    )


def _process_with_points(
    model: SweepingProcess, constraints: Sequence[Constraint], region: Region, runs: Sequence[Trajectory]
) -> PartialSweepingProcess:
    return build_process(model, region, runs, 32 if len(constraints) <= 60 else 12)


def _admissible_sample(process: PartialSweepingProcess, many: bool, quick: bool) -> list[TimedState]:
    """Points of Q(t); with many states the quick check takes what is known."""
    if not process.rows:
        return list(process.known)
    if many and quick:
        return [(t, q) for t, q in process.known if process.admits(*process.at(t, q))]
    return admissible_points(process, 12 if many else 24 if quick else 64)


def _constraints_on_region(model: SweepingProcess, region: Region) -> list[Constraint]:
    lower, upper = region.bounds_with_time()
    found = []
    for name, g, shape in zip(
        model.multiplier_names, ca.vertsplit(model.g), read_shapes(model.g, model.q), strict=True
    ) if model.multiplier_names else ():  # fmt: skip
        ends = [0, *(1 + i for i in shape.own)]
        names = tuple(model.names[i] for i in shape.own)
        found.append(Constraint(name, g, shape, model.t, model.q[list(shape.own)], names, lower[ends], upper[ends]))
    return found


def _answers_of_constraints(constraints: Sequence[Constraint], quick: bool) -> list[AnswersById]:
    """The answers of each constraint."""
    return [decide_constraint(constraint, quick) for constraint in constraints]


def joined_finding(
    hypothesis: Hypothesis, constraints: Sequence[Constraint], each: Sequence[AnswersById], region: Region
) -> Finding:
    """One finding from the answers of all constraints: the weakest verdict, the worst numbers, the smallest scope."""
    own = [item[hypothesis.id] for item in each]
    if not own:
        return make_finding(hypothesis, HOLDS, "no constraint", {"constraints": 0})
    order = (VIOLATED, UNKNOWN, SAMPLED, HOLDS)
    worst = min(range(len(own)), key=lambda k: order.index(own[k].verdict))
    verdict = own[worst].verdict
    value, witness = {}, {}
    for name in dict.fromkeys(name for answer in own for name in answer.value if name not in ("delta", "jump")):
        pick = min if name in MINIMISED_VALUES else max
        k = pick((k for k in range(len(own)) if name in own[k].value), key=lambda k: own[k].value[name])
        if verdict == HOLDS and np.isinf(own[k].value[name]):
            continue  # c of sets whose U_i is all of space: nothing is asked of it.
        value[name] = own[k].value[name]
        if name in ("a", "b", "c", "M") and len(own) > 1:
            witness[f"{name} of"] = constraints[k].name
    if verdict != HOLDS:
        witness = {**own[worst].witness} or {"constraint": constraints[worst].name}
    if verdict == VIOLATED and "jump" in own[worst].value:
        value["jump"] = own[worst].value["jump"]
    reported = range(len(own)) if verdict == HOLDS else [worst]
    states = {name for k in reported if own[k].where == ON_THE_BOX for name in constraints[k].names}
    timed = any(constraints[k].shape.time for k in reported)
    how = "; ".join(dict.fromkeys(own[k].how for k in reported))
    return make_finding(hypothesis, verdict, how, value or {"constraints": len(own)}, witness, region.scope(states, timed))


def _mfcq_of_constraints(
    constraints: Sequence[Constraint], each: Sequence[AnswersById], process: PartialSweepingProcess, points: list[TimedState],
    model: SweepingProcess, quick: bool,
) -> tuple[QualificationResult, QualificationResult]:  # fmt: skip
    acting = [k for k, constraint in enumerate(constraints) if constraint.shape.own]  # A gradient 0 adds nothing to either side.
    if len(acting) < len(constraints):
        process = process.part(acting, range(len(model.names)))
        constraints, each = [constraints[k] for k in acting], [each[k] for k in acting]
    slope = np.array([item["A1"].value.get("b", np.inf) for item in each])
    # Twice delta is the radius or the depth; where there is none, half the way across the box.
    depth = [2 * item["A0"].value.get("delta", np.inf) for item in each]
    across = np.where(np.isfinite(slope) & (slope > 0), slope, 1.0) * 0.5 * process.size
    reach = min((d if np.isfinite(d) else w for d, w in zip(depth, across, strict=True)), default=1.0)
    # A bound of |grad g_i| on U_i that was only sampled is none.
    proved = np.array([item["A1"].verdict == HOLDS for item in each], bool)
    return decide_mfcq(constraints, process, np.where(proved, slope, np.inf), reach, points, model.names, quick)


def gamma_finding(hypothesis: Hypothesis, result: QualificationResult, region: Region, timed: bool) -> Finding:
    """Return the finding on A5 or A5'; ``timed``: whether a constraint depends on time."""
    value = {"gamma": result.gamma, "rho": result.rho, "attained": result.attained}
    if hypothesis is A5_ACTIVE or (result.verdict == HOLDS and np.isinf(result.rho)):
        value.pop("rho")
    witness = result.witness or ({"t": region.t0} if result.verdict == VIOLATED else {})
    any_rho = "; for every rho" if hypothesis is A5 and "rho" not in value else ""
    scope = region.scope(result.where == ON_THE_BOX, timed)
    return make_finding(hypothesis, result.verdict, result.how + any_rho, value, witness, scope)


def _velocity_finding(
    model: SweepingProcess, process: PartialSweepingProcess, region: Region, points: list[TimedState], quick: bool
) -> Finding:
    answer = decide_velocity(model.f, process, points, model.names, quick)
    scope = region.scope(answer.where == ON_THE_BOX, bool(ca.depends_on(model.f, model.t)))
    return make_finding(S_F, answer.verdict, answer.how, answer.value, answer.witness, scope)


def start_finding(model: SweepingProcess) -> Finding:
    """S-start alone."""
    nowhere = np.zeros(len(model.names))
    return _decide_start_signs(
        model, _constraints_on_region(model, Region(nowhere, nowhere, 0.0, 0.0, tuple(model.names), "the start"))
    )


def _decide_start_signs(model: SweepingProcess, constraints: Sequence[Constraint]) -> Finding:
    """The sign of each g_i(0, q_0): by rational arithmetic where the shape allows, else by interval arithmetic."""
    if not constraints:
        return make_finding(S_START, HOLDS, "no constraint", {"constraints": 0})
    q0 = np.array(ca.DM(model.q0)).ravel()
    signs = [start_sign(constraint, q0) for constraint in constraints]
    left = [k for k, sign in enumerate(signs) if sign is None or sign < 0]
    low, high = _start_bounds(model, left, q0)
    g = np.array(ca.Function("g", [model.t, model.q], [ca.densify(model.g)])(0.0, q0)).ravel()
    slopes = ca.Function("slopes", [model.t, model.q], [ca.densify(ca.jacobian(model.g[left], model.q))])
    terms = np.nan_to_num(np.abs(np.array(slopes(0.0, q0)).reshape(len(left), q0.size) * q0), posinf=0.0).sum(axis=1)
    size = terms + np.nan_to_num((high[left] - low[left]) / exact.MACHINE_EPSILON, posinf=0.0)
    undecided = []
    for k, scale in zip(left, size, strict=True):
        if low[k] >= 0:
            continue
        if high[k] < -ROUNDING_DEFICIT * scale:
            witness = {"constraint": constraints[k].name, "g": float(g[k])} | dict(
                zip(constraints[k].names, q0[list(constraints[k].shape.own)], strict=True)
            )
            return make_finding(S_START, VIOLATED, "g_i(0, q_0) < 0, rounding included", {"min g": float(g.min())}, witness)
        undecided.append(k)
    k = int(np.argmin(g))
    value, witness = {"min g": float(g[k])}, {"constraint": constraints[k].name}
    if undecided:
        return make_finding(
            S_START,
            SAMPLED,
            "to rounding: the sign of g_i(0, q_0) is lost in it",
            value,
            {"constraint": constraints[undecided[0]].name},
        )
    return make_finding(S_START, HOLDS, "the sign of each g_i(0, q_0) was decided with rounding included", value, witness)


def _start_bounds(model: SweepingProcess, rows: list[int], q0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rigorous bounds (p,) of some g_i(0, q_0); of the others none."""
    low, high = np.full(model.g.numel(), -np.inf), np.full(model.g.numel(), np.inf)
    if rows:
        z0 = np.concatenate([[0.0], q0])
        bounds = interval_bounds.enclose(model.g[rows], ca.vertcat(model.t, model.q), z0, z0)
        low[rows], high[rows] = (np.ravel(end) for end in bounds)
    return low, high
