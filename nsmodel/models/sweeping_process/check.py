"""The hypotheses of Bernicot and Venel (2010) for a sweeping process, and what follows from them.

What follows from the hypotheses of a sweeping process: prox-regularity, the step bound, the order and its constant.

What a run of a sweeping process shows: no constraint is broken, and a way out at every row.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.along_run import QUALIFICATION_HYPOTHESIS, constraint_findings, inputs_at_rows
from nsmodel.hypotheses.exact_roots import models_at_roots
from nsmodel.hypotheses.findings import (
    HOLDS,
    SAMPLED,
    UNKNOWN,
    VIOLATED,
    Consequence,
    Finding,
    Hypothesis,
    Scope,
    common_scope,
    intersect_scopes,
    make_consequence,
    make_finding,
)
from nsmodel.hypotheses.region import Region
from nsmodel.modeling.base import Model
from nsmodel.modeling.parameters import time_as_parameter
from nsmodel.models.sweeping_process.admissible_points import (
    PartialSweepingProcess,
    admissible_points,
    build_process,
    point_of_start_set,
)
from nsmodel.models.sweeping_process.constraint_bounds import ON_THE_BOX, AnswersById, Constraint
from nsmodel.models.sweeping_process.constraint_constants import decide_constraint
from nsmodel.models.sweeping_process.constraint_shapes import read_shapes
from nsmodel.models.sweeping_process.mfcq_constant import mfcq_constant
from nsmodel.models.sweeping_process.model import SweepingProcess
from nsmodel.models.sweeping_process.qualification import MAX_BOX_STATES, QualificationResult, decide_mfcq
from nsmodel.models.sweeping_process.velocity_field import decide_velocity
from nsmodel.models.sweeping_process.witnesses import ROUNDING_DEFICIT, start_sign
from nsmodel.proof import exact, interval_bounds
from nsmodel.proof.global_search import searches_are_quick
from nsmodel.proof.verdict import HypothesisPart
from nsmodel.simulation.trajectory import Trajectory

BERNICOT_VENEL = "Bernicot and Venel 2010"
REGULARITY_HYPOTHESES = ("S-convex", "A1", "A4", "A5'")
MOTION_HYPOTHESES = ("S-convex", "A0", "A1", "A2", "A5")
SOLVABILITY_HYPOTHESES = ("S-convex", "A0", "A1", "A2", "A4", "A5", "S-f", "S-start")


class _TheoryConstants(NamedTuple):
    """The constants of the theory; ``bend`` is M/(2a), ``eta_on_U`` that with the M of all of U_i."""

    K_L: float
    K_L_paper: float
    c: float
    r: float
    Theta: float
    kappa: float
    bend: float
    eta: float
    eta_on_U: float


def _theory_constants(number: dict[tuple[str, str], float], moves_in_all: bool, p: int) -> _TheoryConstants:
    """``moves_in_all``: A0 may be proved without a number, for U_i is all of space."""
    nothing = (np.inf, 0.0) if not p else (0.0, np.inf)
    a, b = number.get(("A1", "a"), nothing[0]), number.get(("A1", "b"), nothing[1])
    speed = number.get(("A2", "b"), nothing[1])
    c = number.get(("A0", "c"), np.inf if moves_in_all else 0.0)
    M, M_contact = (number.get(("A4", name), nothing[1]) for name in ("M", "M_contact"))
    if not M and np.isfinite(c):  # U_i is not all: beyond c nothing is as straight as there, and |q - q_k| <= |q - q_k|^2 / c.
        M = M_contact = _quotient_or_inf(2 * a, c)
    gamma, gamma_0 = (number.get((id, "gamma"), np.inf) for id in (A5.id, A5_ACTIVE.id))
    rho = number.get((A5.id, "rho"), np.inf)
    Theta = _product_or_zero(2 * gamma, _quotient_or_inf(b, a))
    return _TheoryConstants(
        K_L=_product_or_zero(gamma, _quotient_or_inf(speed, a)),
        K_L_paper=_product_or_zero(gamma, _quotient_or_inf(max(speed, b), a)), c=c,
        r=min(_quotient_or_inf(rho, 6 * b), _quotient_or_inf(a, _product_or_zero(4 * gamma, M))), Theta=Theta,
        kappa=_product_or_zero(Theta * p, _quotient_or_inf(M, 2 * a)),
        bend=_quotient_or_inf(M, 2 * a), eta=_quotient_or_inf(a, _product_or_zero(M_contact, gamma_0)),
        eta_on_U=_quotient_or_inf(a, _product_or_zero(M, gamma_0)),
    )  # fmt: skip


def sweeping_consequences(
    model: Model, findings: Sequence[Finding], runs: Sequence[Trajectory], p: int, known_point: HypothesisPart
) -> list[Consequence]:
    """Return what follows, with the constants of the theory.

    Args:
        model: of these findings; runs: of it.
        p: the number of constraints.
        known_point: whether Q(0) is not empty; of points of an empty set nothing follows.
    """
    number = {(finding.id, name): value for finding in findings for name, value in finding.value.items()}
    verdicts = {finding.id: finding.verdict for finding in findings}
    known = _theory_constants(number, verdicts["A0"] in (HOLDS, SAMPLED), p)
    bound = _quotient_or_inf(known.c, known.K_L)
    h = float(np.max(model.steps)) if model.steps is not None else float(model.step or np.nan)
    met = "" if np.isnan(h) else f"; the model's own step {h:.4g} " + ("meets it" if h < bound else "does not meet it")
    steps = {"h": bound, "h with b": _quotient_or_inf(known.c, known.K_L_paper)} | ({} if np.isnan(h) else {"step": h})
    found = [
        make_consequence(
            "well posed", "one and only one absolutely continuous solution", findings, SOLVABILITY_HYPOTHESES,
            f"{BERNICOT_VENEL}, Theorem 2.5",
        ),
        *_set_consequences(findings, known),
        make_consequence(
            "step bound", f"the scheme is well defined for {'every h' if np.isinf(bound) else 'h < c / K_L'}{met}", findings,
            MOTION_HYPOTHESES, f"{BERNICOT_VENEL}, section 3", steps,
        ),
        *_linearisation_consequences(findings, known, p),
    ]  # fmt: skip
    found.append(_order_consequence(model, findings, runs, number, known.K_L, known.kappa, known.r))
    return found if known_point.verdict == HOLDS else [_weaken_consequence(item, known_point) for item in found]


def _weaken_consequence(item: Consequence, known_point: HypothesisPart) -> Consequence:
    """What follows where no point of Q(0) is proved: no more than is known of such a point."""
    if known_point.verdict == SAMPLED:
        return replace(item, verdict=SAMPLED) if item.verdict == HOLDS else item
    return replace(item, verdict=UNKNOWN, statement=f"{item.statement}; {known_point.how}")


def weaken_findings(findings: Sequence[Finding], known_point: HypothesisPart) -> list[Finding]:
    """The findings where no point of Q(0) is proved: what is said of all points of Q(t) is not known then."""
    if known_point.verdict in (HOLDS, SAMPLED):
        return list(findings)
    empty = known_point.verdict == VIOLATED
    return [
        make_finding(_HYPOTHESES_BY_ID[item.id], UNKNOWN, known_point.how, witness=known_point.witness)
        if item.id in (A5.id, A5_ACTIVE.id) and item.verdict in (HOLDS, SAMPLED)
        else replace(item, how=f"{item.how}; {known_point.how}")
        if item.id == S_START.id and empty
        else item
        for item in findings
    ]


def known_start_point(model: SweepingProcess, region: Region, start: Finding, process: PartialSweepingProcess) -> HypothesisPart:
    """Whether Q(0) is not empty: the start is in it, to rounding at least, or another point."""
    if start.verdict == HOLDS:
        return HypothesisPart(HOLDS, start.how, {}, {})
    found = point_of_start_set(model, region, process)
    return found._replace(verdict=SAMPLED) if start.verdict == SAMPLED and found.verdict == UNKNOWN else found


def _set_consequences(findings: Sequence[Finding], known: _TheoryConstants) -> list[Consequence]:
    """Prox-regularity and speed."""
    local = {
        name: bool((scope := common_scope(findings, ids)) and scope.states)
        for name, ids in (("eta", REGULARITY_HYPOTHESES), ("K_L", MOTION_HYPOTHESES))
    }
    return [
        make_consequence(
            "prox-regular", _regularity_statement(known.eta, local["eta"]), findings, REGULARITY_HYPOTHESES,
            f"{BERNICOT_VENEL}, Proposition 2.3", {"eta": known.eta, "eta on U": known.eta_on_U}, moving=False,
        ),
        make_consequence(
            "K_L", _speed_statement(local["K_L"]), findings, MOTION_HYPOTHESES, f"{BERNICOT_VENEL}, Proposition 2.4",
            {"K_L": known.K_L, "K_L with b": known.K_L_paper}, moving=False,
        ),
    ]  # fmt: skip


def _linearisation_consequences(findings: Sequence[Finding], known: _TheoryConstants, p: int) -> list[Consequence]:
    """How far it is from the set."""
    return [
        make_consequence(
            "linearisation error", "the distance from q in Q(t) to the linearised Q_i(t) at q_k is at most M/(2a) |q - q_k|^2",
            findings, ("S-convex", "A1", "A4"), f"{BERNICOT_VENEL}, Proposition 3.6", {"M/(2a)": known.bend}, moving=False,
        ),
        make_consequence(
            "metric qualification",
            "d(q, linearised Q) <= Theta sum d(q, linearised Q_i) within r/4, r = min(rho/(6b), a/(4 M gamma)), "
            f"Theta = 2 gamma b/a; kappa = Theta p M/(2a) with p = {p}, the number of all constraints",
            findings, ("S-convex", "A1", "A4", "A5"), f"{BERNICOT_VENEL}, Theorem 4.9",
            {"r": known.r, "Theta": known.Theta, "kappa": known.kappa, "p": p}, moving=False,
        ),
    ]  # fmt: skip


def _regularity_statement(eta: float, local: bool) -> str:
    """Prox-regularity in words: of a box it is told of the points there alone, for the set beyond is not known."""
    if local:
        bound = "0" if np.isinf(eta) else "|n| |q' - q|^2 / (2 eta), eta = a/(M gamma(0)) with M at contact,"
        return (
            f"at q in Q(t) inside the box and n normal to Q(t) there, <n, q' - q> <= {bound} for q' in Q(t) near q inside the "
            "box. Q(t) as a whole need not be prox-regular"
        )
    return "Q(t) is convex" if np.isinf(eta) else "Q(t) is eta-prox-regular, eta = a/(M gamma(0)) with M at contact"


def _speed_statement(local: bool) -> str:
    """The speed of the set in words."""
    rate = "K_L = gamma sup|d_t g_i| / a; with the paper's b: gamma b/a"
    if local:
        return (
            "a point of Q(t) inside the box is within K_L |t - s| of Q(s), as long as that is less than its distance from the "
            f"sides of the box; {rate}. Nothing is said of Q(t) beyond"
        )
    return f"d_H(Q(t), Q(s)) <= K_L |t - s|, {rate}"


def _order_consequence(
    model: Model, findings: Sequence[Finding], runs: Sequence[Trajectory], number: dict[tuple[str, str], float],
    K_L: float, kappa: float, r: float,
) -> Consequence:  # fmt: skip
    """max |q_h - q| <= C_0 sqrt(h): C_0 with C bounding |q_h| and K bounding |q_h'| on the runs."""
    statement = "max |q_h(t) - q(t)| <= C_0 sqrt(h): order 1/2 is proved, order 1 is what smooth scenes show"
    value: dict[str, float] = {"order": 0.5}
    T = max((float(run.t[-1]) for run in runs), default=0.0)
    rows = [run for run in runs if len(run.t) > 1 and np.isfinite(run.x).all()]
    K_f, L_f, L_t = (number.get(("S-f", name), np.inf) for name in ("K_f", "L_f", "L_t"))
    if rows:
        C = max(float(np.linalg.norm(run.x, axis=1).max()) for run in rows)
        K = max(float((np.linalg.norm(np.diff(run.x, axis=0), axis=1) / np.diff(run.t)).max()) for run in rows)
        value |= {"log10 C_0": log_error_constant(K, C, T, K_f, L_f, L_t, K_L, kappa, r), "K": K, "C": C}
        h = _quotient_or_inf(r, 16 * K), _quotient_or_inf(r, 8 * K_L)
        value["for h up to"] = min(1.0, *h)
        statement += "; C_0 with K and C of the runs"
    elif np.isfinite(L_t):
        statement += "; C_0 needs a run, for bounds K of |q_h'| and C of |q_h|"
    if not np.isfinite(L_t):
        statement += "; it needs f to be Lipschitz in t, and no L_t is known"
    rests_on = ("S-convex", "A0", "A1", "A2", "A3", "A4", "A5", "A5'", "S-f", "S-start")
    source = f"{BERNICOT_VENEL}, Theorem 3.4, whose proof bounds the square of the error"
    found = make_consequence("order 1/2", statement, findings, rests_on, source, value)
    found = replace(found, scope=intersect_scopes(found.scope, Scope(time=(0.0, T)))) if rows else found  # C_0 grows with T
    return found if np.isfinite(L_t) else replace(found, verdict=UNKNOWN)


def log_error_constant(
    K: float, C: float, T: float, K_f: float, L_f: float, L_t: float, K_L: float, kappa: float, r: float
) -> float:  # fmt: skip
    """Return log10 of C_0, C_0^2 = C_5 (exp(2 L T) - 1) / L (the proof of Theorem 3.4, its gaps closed); inf if unbounded."""
    C_1 = L_f * (1 + C) + K
    C_2 = C_1 * (K_L + _product_or_zero(2 * kappa, (K + K_L) ** 2)) if np.isfinite(K_L) else np.inf
    C_3 = max(_product_or_zero(2 * C_1, kappa), _quotient_or_inf(32 * C_1, r))
    C_4 = max(C_2, _quotient_or_inf(128 * C_1 * K**2, r))
    C_5 = 2 * C_4 + 4 * K**2 + _product_or_zero(8 * K**2, K_f) + _product_or_zero(L_t, 0.5 + 2 * K)
    L = 2 * C_3 + 2 * K_f + L_t / 2
    if not (np.isfinite(C_5) and np.isfinite(L)):
        return np.inf
    if C_5 == 0:
        return -np.inf
    x = 2 * L * T
    grown = x if x > 50 else np.log(np.expm1(x)) if x > 0 else 0.0
    return float((np.log(C_5) + (grown - np.log(L) if L > 0 else np.log(2 * T))) / (2 * np.log(10)))


def _quotient_or_inf(x: float, y: float) -> float:
    """x / y where x/0 and inf/x are inf and 0/0 (a bound on nothing) is inf."""
    return x / y if y and not (np.isinf(x) and np.isinf(y)) else np.inf


def _product_or_zero(x: float, y: float) -> float:
    """x y with 0 inf = 0."""
    return x * y if x and y else 0.0


TimedState = tuple[float, np.ndarray]
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
CONSTRAINT_HYPOTHESES = (S_CONVEX, A0, A1, A2, A3, A4)  # What each constraint is asked for alone.
HYPOTHESES = (*CONSTRAINT_HYPOTHESES, A5, A5_ACTIVE, S_F, S_START)
_HYPOTHESES_BY_ID = {hypothesis.id: hypothesis for hypothesis in HYPOTHESES}

MINIMISED_VALUES = ("a", "c", "least")  # Of these numbers the least over the constraints counts, of the others the largest.
MANY_STATES = 24  # With more states fewer points are looked at: each is a projection on all constraints.
# From so many constraints without a known shape on, bounds over the box are not refined: each takes a search.
MANY_UNKNOWN_SHAPES = 40


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
        each = _answers_of_constraints(constraints, quick)
        findings = [joined_finding(hypothesis, constraints, each, region) for hypothesis in CONSTRAINT_HYPOTHESES]
        points = _admissible_sample(process, len(model.names) > MANY_STATES, quick or searches_are_quick())
        near, active = _mfcq_of_constraints(constraints, each, process, points, model, quick or searches_are_quick())
        timed = any(constraint.shape.time for constraint in constraints)
        if timed and active.verdict in (SAMPLED, UNKNOWN):
            near, active = _opposition_at_root(model, region, runs) or (near, active)
        findings += [gamma_finding(A5, near, region, timed), gamma_finding(A5_ACTIVE, active, region, timed)]
        findings.append(_velocity_finding(model, process, region, points, quick))
        findings.append(_decide_start_signs(model, constraints))
        known_point = known_start_point(model, region, findings[-1], process)
        findings = weaken_findings(findings, known_point)
    return findings, sweeping_consequences(model, findings, runs, len(constraints), known_point)


def mfcq_results(
    model: SweepingProcess, region: Region, runs: Sequence[Trajectory], quick: bool
) -> tuple[QualificationResult, QualificationResult]:
    """Return A5 and A5' alone."""
    quick = quick or searches_are_quick()
    constraints = _constraints_on_region(model, region)
    process = _process_with_points(model, constraints, region, runs)
    each = _answers_of_constraints(constraints, quick)
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
    easy = quick or sum(c.shape.kind == "other" for c in constraints) > MANY_UNKNOWN_SHAPES
    return [decide_constraint(constraint, easy) for constraint in constraints]


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


def _opposition_at_root(
    model: SweepingProcess, region: Region, runs: Sequence[Trajectory]
) -> tuple[QualificationResult, QualificationResult] | None:
    """The violation of A5 and A5' at one time that no double may be, a root of what the constraints are made of."""
    t = str(model.t)
    for values, text, at_rest in models_at_roots(time_as_parameter(model), {t: (region.t0, region.t1)}):
        instant = replace(region, t0=values[t], t1=values[t])
        constraints = _constraints_on_region(at_rest, instant)
        process = _process_with_points(at_rest, constraints, instant, runs)
        points = _admissible_sample(process, len(model.names) > MANY_STATES, True)
        near, active = _mfcq_of_constraints(
            constraints, _answers_of_constraints(constraints, True), process, points, at_rest, True
        )
        if near.verdict == VIOLATED:
            near, active = (
                part._replace(how=f"exactly where {text}: {part.how}", witness={**part.witness, "t": values[t]})
                for part in (near, active)
            )
            return near, active
    return None


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
    """The finding of S-start, without the others."""
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
    if np.isnan(g).any():
        witness = {"constraint": constraints[int(np.flatnonzero(np.isnan(g))[0])].name, "q": q0}
        return make_finding(S_START, VIOLATED, "g_i(0, q_0) has no value", {"min g": -np.inf}, witness)
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


# Rows of a run, evenly spread, where gamma is evaluated, by Wolfe's method; of more rows the finding is sampled.
MAX_GAMMA_ROWS = 2000


def class_findings_along_run(
    model: SweepingProcess, run: Trajectory, numbers: Mapping[str, Finding], twin: Trajectory | None, quick: bool
) -> list[Finding]:  # fmt: skip
    """Q(t), and (A5)."""
    return [*constraint_findings(model, run, model.g, model.multiplier_names), *_qualification_along(model, run)]


def _qualification_along(model: SweepingProcess, run: Trajectory) -> list[Finding]:
    """gamma(rho) of (A5) along the run, rho the most that a constraint closed from one row to the next."""
    gap = run.arrays.get("gap", np.zeros((1, 0)))
    if gap.shape[1] < 2 or len(gap) < 2:
        return []
    rho = max(float(np.max(gap[:-1] - gap[1:])), 0.0)
    near = gap <= rho
    crowded = np.flatnonzero(near.sum(axis=1) > 1)
    rows = crowded[np.unique(np.linspace(0, crowded.size - 1, min(crowded.size, MAX_GAMMA_ROWS), dtype=int))]
    slopes = ca.Function("slopes", [model.t, model.q, model.u], [ca.densify(ca.jacobian(model.g, model.q))])
    u = inputs_at_rows(model, run)
    worst, witness = 1.0, {}
    for k in rows:
        at = np.flatnonzero(near[k])
        gamma, weights = mfcq_constant(np.array(slopes(run.t[k], run.x[k], u[k]))[at])
        if gamma > worst:
            worst = gamma
            opposed = {model.multiplier_names[at[i]]: float(weights[i]) for i in np.argsort(-weights) if weights[i] > 0}
            witness = {"constraints": list(opposed), "weights": list(opposed.values()), "t": run.t[k], "state": run.x[k]}
            if np.isinf(gamma):
                break
    verdict = VIOLATED if np.isinf(worst) else HOLDS if rows.size == crowded.size else SAMPLED
    how = f"evaluated at {rows.size} of {crowded.size} rows with several constraints within rho, the most that one closes"
    return [make_finding(QUALIFICATION_HYPOTHESIS, verdict, how, {"gamma": worst, "rho": rho}, witness)]
