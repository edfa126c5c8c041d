"""The hypotheses of Bernicot and Venel (2010) for a sweeping process, and what follows from them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import casadi as ca
import numpy as np

from nsmodel.classes.sweeping.hypotheses.admissible import Process, admissible_points, process_of
from nsmodel.classes.sweeping.hypotheses.consequences import consequences_of
from nsmodel.classes.sweeping.hypotheses.constants import answers
from nsmodel.classes.sweeping.hypotheses.constraint import ON_THE_BOX, Answers, Constraint
from nsmodel.classes.sweeping.hypotheses.qualification import FEW_STATES, Qualified, qualification
from nsmodel.classes.sweeping.hypotheses.shapes import read_shapes
from nsmodel.classes.sweeping.hypotheses.start import ROUNDED, start_value
from nsmodel.classes.sweeping.hypotheses.velocity import velocity
from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Consequence, Finding, Hypothesis, found
from nsmodel.hypotheses.region import Region
from nsmodel.proof import exact, interval
from nsmodel.proof.search import are_quick
from nsmodel.trajectory import Trajectory

Point = tuple[float, np.ndarray]
PAPER = "Bernicot and Venel 2010"
S_CONVEX = Hypothesis("S-convex", "g_i(t, .) is convex", f"{PAPER}, section 2")
A0 = Hypothesis("A0", "the boundary of U_i(t) stays at a distance > c from Q_i(t)", f"{PAPER}, (A0)")
A1 = Hypothesis("A1", "a <= |grad_q g_i| <= b on U_i(t)", f"{PAPER}, (A1)")
A2 = Hypothesis("A2", "|d_t g_i| <= b", f"{PAPER}, (A2)")
A3 = Hypothesis("A3", "|d_t grad_q g_i| <= M on U_i(t)", f"{PAPER}, (A3)")
A4 = Hypothesis("A4", "|D^2_q g_i| <= M on U_i(t)", f"{PAPER}, (A4)")
A5 = Hypothesis(
    "A5", "sum l_i |grad g_i| <= gamma |sum l_i grad g_i| for all l >= 0, over the i with g_i <= rho, at every q in Q(t)",
    f"{PAPER}, (A5)",
)  # fmt: skip
A5_ACTIVE = Hypothesis("A5'", "the same over the active constraints, g_i = 0 (quantified MFCQ)", f"{PAPER}, (A5')")
S_F = Hypothesis("S-f", "|f(t,q) - f(t,q')| <= K_f |q - q'|, |f(t,q)| <= L_f (1 + |q|)", f"{PAPER}, (7) and (8)")
S_START = Hypothesis("S-start", "q_0 is in Q(0)", f"{PAPER}, (4)")
HYPOTHESES = (S_CONVEX, A0, A1, A2, A3, A4, A5, A5_ACTIVE, S_F, S_START)
TWIN = False  # No two solutions are compared.

LEAST = ("a", "c", "least")  # Of these numbers the least over the constraints counts, of the others the largest.
FEW = 24  # With more states fewer points are looked at.
PLENTY = 40  # From so many constraints without a known shape on, bounds over the box are not refined.


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
        constraints = _constraints(model, region)
        process = _process(model, constraints, region, runs)
        unknown = sum(c.shape.kind == "other" for c in constraints)
        each = _grouped(constraints, quick or unknown > PLENTY)
        findings = [joined(hypothesis, constraints, each, region) for hypothesis in HYPOTHESES[:6]]
        points = _points(process, len(model.names) > FEW, quick or are_quick())
        near, active = _qualified(constraints, each, process, points, model, quick or are_quick())
        timed = any(constraint.shape.time for constraint in constraints)
        findings += [gamma(A5, near, region, timed), gamma(A5_ACTIVE, active, region, timed)]
        findings.append(_velocity(model, process, region, points, quick))
        findings.append(_of_start(model, constraints))
    return findings, consequences_of(model, findings, runs, len(constraints))


def qualified(model: SweepingProcess, region: Region, runs: Sequence[Trajectory], quick: bool) -> tuple[Qualified, Qualified]:
    """Return A5 and A5' alone."""
    quick = quick or are_quick()
    constraints = _constraints(model, region)
    process = _process(model, constraints, region, runs)
    unknown = sum(c.shape.kind == "other" for c in constraints)
    each = _grouped(constraints, quick or unknown > PLENTY)
    if not quick and len(model.names) > FEW_STATES:  # Bounds of so many states need no points.
        known = [(t, q) for t, q in process.known if process.admits(*process.at(t, q))]
        found = _qualified(constraints, each, process, known, model, True)
        if found[0].verdict == HOLDS:
            return found
    return _qualified(constraints, each, process, _points(process, len(model.names) > FEW, quick), model, quick)


def _process(model: SweepingProcess, constraints: Sequence[Constraint], region: Region, runs: Sequence[Trajectory]) -> Process:
    return process_of(model, region, runs, 32 if len(constraints) <= 60 else 12)


def _points(process: Process, many: bool, quick: bool) -> list[Point]:
    """Points of Q(t); with many states the quick check takes what is known."""
    if not process.rows:
        return list(process.known)
    if many and quick:
        return [(t, q) for t, q in process.known if process.admits(*process.at(t, q))]
    return admissible_points(process, 12 if many else 24 if quick else 64)


def _constraints(model: SweepingProcess, region: Region) -> list[Constraint]:
    lower, upper = region.with_time()
    found = []
    for name, g, shape in zip(
        model.multiplier_names, ca.vertsplit(model.g), read_shapes(model.g, model.q), strict=True
    ) if model.multiplier_names else ():  # fmt: skip
        ends = [0, *(1 + i for i in shape.own)]
        names = tuple(model.names[i] for i in shape.own)
        found.append(Constraint(name, g, shape, model.t, model.q[list(shape.own)], names, lower[ends], upper[ends]))
    return found


def _grouped(constraints: Sequence[Constraint], quick: bool) -> list[Answers]:
    """The answers of each constraint."""
    return [answers(constraint, quick) for constraint in constraints]


def joined(hypothesis: Hypothesis, constraints: Sequence[Constraint], each: Sequence[Answers], region: Region) -> Finding:
    """One finding from the answers of all constraints: the weakest verdict, the worst numbers, the smallest scope."""
    own = [item[hypothesis.id] for item in each]
    if not own:
        return found(hypothesis, HOLDS, "no constraint", {"constraints": 0})
    order = (VIOLATED, UNKNOWN, SAMPLED, HOLDS)
    worst = min(range(len(own)), key=lambda k: order.index(own[k].verdict))
    verdict = own[worst].verdict
    value, witness = {}, {}
    for name in dict.fromkeys(name for answer in own for name in answer.value if name not in ("delta", "jump")):
        pick = min if name in LEAST else max
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
    told = range(len(own)) if verdict == HOLDS else [worst]
    states = {name for k in told if own[k].where == ON_THE_BOX for name in constraints[k].names}
    timed = any(constraints[k].shape.time for k in told)
    how = "; ".join(dict.fromkeys(own[k].how for k in told))
    return found(hypothesis, verdict, how, value or {"constraints": len(own)}, witness, region.scope(states, timed))


def _qualified(
    constraints: Sequence[Constraint], each: Sequence[Answers], process: Process, points: list[Point], model: SweepingProcess,
    quick: bool,
) -> tuple[Qualified, Qualified]:  # fmt: skip
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
    return qualification(constraints, process, np.where(proved, slope, np.inf), reach, points, model.names, quick)


def gamma(hypothesis: Hypothesis, result: Qualified, region: Region, timed: bool) -> Finding:
    """Return the finding on A5 or A5'; ``timed``: whether a constraint depends on time."""
    value = {"gamma": result.gamma, "rho": result.rho, "attained": result.attained}
    if hypothesis is A5_ACTIVE or (result.verdict == HOLDS and np.isinf(result.rho)):
        value.pop("rho")
    witness = result.witness or ({"t": region.t0} if result.verdict == VIOLATED else {})
    any_rho = "; for every rho" if hypothesis is A5 and "rho" not in value else ""
    scope = region.scope(result.where == ON_THE_BOX, timed)
    return found(hypothesis, result.verdict, result.how + any_rho, value, witness, scope)


def _velocity(model: SweepingProcess, process: Process, region: Region, points: list[Point], quick: bool) -> Finding:
    answer = velocity(model.f, process, points, model.names, quick)
    scope = region.scope(answer.where == ON_THE_BOX, bool(ca.depends_on(model.f, model.t)))
    return found(S_F, answer.verdict, answer.how, answer.value, answer.witness, scope)


def start(model: SweepingProcess) -> Finding:
    """S-start alone."""
    nowhere = np.zeros(len(model.names))
    return _of_start(model, _constraints(model, Region(nowhere, nowhere, 0.0, 0.0, tuple(model.names), "the start")))


def _of_start(model: SweepingProcess, constraints: Sequence[Constraint]) -> Finding:
    """The sign of each g_i(0, q_0): by rational arithmetic where the shape allows, else by interval arithmetic."""
    if not constraints:
        return found(S_START, HOLDS, "no constraint", {"constraints": 0})
    q0 = np.array(ca.DM(model.q0)).ravel()
    signs = [start_value(constraint, q0) for constraint in constraints]
    left = [k for k, sign in enumerate(signs) if sign is None or sign < 0]
    low, high = _at_the_start(model, left, q0)
    g = np.array(ca.Function("g", [model.t, model.q], [ca.densify(model.g)])(0.0, q0)).ravel()
    slopes = ca.Function("slopes", [model.t, model.q], [ca.densify(ca.jacobian(model.g[left], model.q))])
    terms = np.nan_to_num(np.abs(np.array(slopes(0.0, q0)).reshape(len(left), q0.size) * q0), posinf=0.0).sum(axis=1)
    size = terms + np.nan_to_num((high[left] - low[left]) / exact.EPS, posinf=0.0)
    undecided = []
    for k, scale in zip(left, size, strict=True):
        if low[k] >= 0:
            continue
        if high[k] < -ROUNDED * scale:
            witness = {"constraint": constraints[k].name, "g": float(g[k])} | dict(
                zip(constraints[k].names, q0[list(constraints[k].shape.own)], strict=True)
            )
            return found(S_START, VIOLATED, "g_i(0, q_0) < 0, rounding included", {"min g": float(g.min())}, witness)
        undecided.append(k)
    k = int(np.argmin(g))
    value, witness = {"min g": float(g[k])}, {"constraint": constraints[k].name}
    if undecided:
        return found(
            S_START,
            SAMPLED,
            "to rounding: the sign of g_i(0, q_0) is lost in it",
            value,
            {"constraint": constraints[undecided[0]].name},
        )
    return found(S_START, HOLDS, "the sign of each g_i(0, q_0) was decided with rounding included", value, witness)


def _at_the_start(model: SweepingProcess, rows: list[int], q0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rigorous bounds (p,) of some g_i(0, q_0); of the others none."""
    low, high = np.full(model.g.numel(), -np.inf), np.full(model.g.numel(), np.inf)
    if rows:
        z0 = np.concatenate([[0.0], q0])
        bounds = interval.enclose(model.g[rows], ca.vertcat(model.t, model.q), z0, z0)
        low[rows], high[rows] = (np.ravel(end) for end in bounds)
    return low, high
