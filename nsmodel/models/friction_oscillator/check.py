"""Hypotheses of the inertial proximal method for oscillators under dry friction (Cabot 2004), and what follows from them.

    x'' + dPhi(x') + M x' + dg(x) ∋ f(t),   Phi(v) = sum_j theta_j(|H_j v|),   A = dPhi + M,   B = dg

A(0) = sum_j H_j' B(0, theta_j'(0)) has the support function sigma(d) = sum_j theta_j'(0) |H_j d|, and 0 is interior to A(0) if
and only if sigma > 0 off 0. The theorems are about f = 0: with a force that moves with time they say that a step is solvable, and
no more. The largest ball in A(0) has the radius min sigma over |d| = 1, of which a lower bound is given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from nsmodel._utils import EPS
from nsmodel.hypotheses.findings import (
    HOLDS,
    SAMPLED,
    UNKNOWN,
    VIOLATED,
    Consequence,
    Finding,
    Hypothesis,
    make_consequence,
    make_finding,
)
from nsmodel.hypotheses.region import Region, domain_rows, potential_without_domain
from nsmodel.models.friction_oscillator import friction_law, rest_points
from nsmodel.models.friction_oscillator.model import FrictionOscillator
from nsmodel.models.friction_oscillator.rest_points import friction_radius
from nsmodel.proof import exact
from nsmodel.proof.convex import lower_bounds, potentials
from nsmodel.proof.convex.lower_bounds import LowerBoundResult
from nsmodel.proof.convex.sets import ConvexSet, has_interior, is_convex_set, natural_domain
from nsmodel.proof.expression_graph import stack_column
from nsmodel.proof.verdict import HypothesisPart
from nsmodel.simulation.trajectory import Trajectory

CABOT_PAPER = "Cabot 2004"
O_THETA = Hypothesis("O-theta", "theta is convex, C1 and nondecreasing on [0, inf)", f"{CABOT_PAPER}, Proposition 2.2")
O_G = Hypothesis("O-g", "g is closed and convex, inf g > -inf, int dom g is not empty", f"{CABOT_PAPER}, Theorem 4.1")
O_DRY = Hypothesis(
    "O-dry", "dry friction: 0 is interior to A(0), that is theta'(0) > 0", f"{CABOT_PAPER}, Theorem 4.1, Corollary 4.2"
)
O_STEPS = Hypothesis("O-steps", "the steps are positive and nondecreasing", f"{CABOT_PAPER}, Proposition 4.1")
HYPOTHESES = (O_THETA, O_G, O_DRY, O_STEPS)
WELL_POSED_IDS = (O_THETA.id, O_G.id)  # What Proposition 2.1 rests on; Theorem 4.1 and Corollary 4.2 on the second.
REST_IDS = (O_THETA.id, O_G.id, O_DRY.id, O_STEPS.id)
RADIUS_LABEL = "radius of A(0)"
# A lower bound of g that is attained but for this, beside 1 and its size, is given as inf g: minima are found to 1e-8 or so.
TIGHT_BOUND = 1e-7
# A margin below this, beside the forces, at the end of a run may be 0: a run that creeps to its rest is not there yet.
BOUNDARY_MARGIN = 1e-9
FORCED_TEXT = "a force that moves with time does work and does not let it rest: the paper is about oscillators left to themselves"
VERDICTS_WORST_FIRST = (VIOLATED, UNKNOWN, SAMPLED, HOLDS)  # from the worst


def check(
    model: FrictionOscillator, region: Region, runs: Sequence[Trajectory], quick: bool
) -> tuple[list[Finding], list[Consequence]]:
    """Return one finding a hypothesis, and what follows.

    Args:
        model: bound.
        region: the box in which a potential that is neither quadratic nor convex by its form is looked at.
        runs: of this model; their own steps are looked at, and whether they came to rest.
        quick: skip global searches.
    """
    potential = potential_without_domain(model.potential, model.x, "potential")
    domain = effective_domain(model, potential)
    g, below = _check_potential(model, potential, domain, region, quick)
    findings = [_check_friction(model, quick), g, _check_dry_friction(model), _check_steps(model, runs)]
    return findings, oscillator_consequences(model, findings, potential, domain, below, runs)


def effective_domain(model: FrictionOscillator, g: ca.SX) -> ConvexSet:
    """Dom g where g counts as +inf where its logarithms and roots have no value."""
    domain, own = potential_domain(model), natural_domain(g, model.x)
    names = [f"{u} has a value in g" for u in ca.vertsplit(own)] if own.numel() else []
    return ConvexSet(model.x, ca.vertcat(domain.rows, own), [*domain.names, *names], domain.equalities)


def potential_domain(model: FrictionOscillator) -> ConvexSet:
    """Dom g: the conditions in the potential, and the model's constraints."""
    rows, equalities = domain_rows(model.potential, model.x, "potential")
    c = stack_column([*rows, *model.constraints.values()])
    names = [f"potential: {row} >= 0" for row in rows]
    return ConvexSet(model.x, c, [*names, *model.constraint_names], stack_column(equalities))


# -- O-theta -----------------------------------------------------------------------------------------------------------


def _check_friction(model: FrictionOscillator, quick: bool) -> Finding:
    parts = [(element.name, friction_law.check_friction_law(element, model.s, quick=quick)) for element in model.elements]
    values: dict[str, float] = {}
    for name, part in parts:
        label = "" if len(parts) == 1 else f" of '{name}'"
        values |= {key + label: number for key, number in part.value.items()}
    if model.damping is not None:
        M = np.array(ca.DM(model.damping))
        part = _check_damping(M)
        parts.append(("damping", part))
        values |= part.value
    verdict = _worst_verdict([part.verdict for _, part in parts])
    deciding_parts = [(name, part) for name, part in parts if part.verdict == verdict] if verdict != HOLDS else parts
    how = "; ".join(dict.fromkeys(part.how if len(parts) == 1 else f"'{name}': {part.how}" for name, part in deciding_parts))
    witness = {} if verdict == HOLDS else {"element": deciding_parts[0][0], **deciding_parts[0][1].witness}
    return make_finding(O_THETA, verdict, how or "no friction: A = 0", values or {"elements": 0}, witness)


def _check_damping(M: np.ndarray) -> HypothesisPart:
    """M + M' psd, exactly: the damping is part of the monotone operator A."""
    decided, values = exact.definiteness(M), np.linalg.eigvalsh((M + M.T) / 2)
    least, rounding = float(values[0]), potentials.EIGENVALUE_ROUNDING * float(np.abs(values).max(initial=0.0))
    number = {"least eigenvalue of the damping": max(least, 0.0) if decided.psd else least}
    if decided.psd:
        return HypothesisPart(HOLDS, "M + M' is psd in exact arithmetic", number, {})
    witness = {"vector": np.linalg.eigh((M + M.T) / 2)[1][:, 0]}
    if least >= -rounding:
        return HypothesisPart(SAMPLED, "M + M' is psd up to rounding only", number | {"rounding bound": rounding}, witness)
    return HypothesisPart(VIOLATED, "M + M' is not psd: the damping is not monotone", number, witness)


# -- O-g ---------------------------------------------------------------------------------------------------------------


def _check_potential(
    model: FrictionOscillator, g: ca.SX, domain: ConvexSet, region: Region, quick: bool
) -> tuple[Finding, LowerBoundResult | None]:
    x0 = np.array(ca.DM(model.x0)).ravel()
    box = region.lower, region.upper
    interior = has_interior(domain, x0)
    if domain.empty:
        return make_finding(O_G, VIOLATED, f"interior: {interior.how}", interior.value, interior.witness), None
    closed = is_convex_set(domain, *box, quick=quick)
    convex = potentials.is_convex_potential(g, domain, *box, quick=quick)
    below = None
    parts = [("convex", convex), ("domain", closed), ("interior", interior)]
    if interior.verdict != VIOLATED:
        start = np.asarray(interior.witness.get("interior point", x0))
        below = lower_bounds.decide_bounded_below(g, domain, start, convex=convex.verdict == HOLDS and not convex.local)
        parts.insert(1, ("inf g", _lower_bound_part(below)))
    verdict = _worst_verdict([part.verdict for _, part in parts])
    deciding_parts = parts if verdict == HOLDS else [(name, part) for name, part in parts if part.verdict == verdict]
    # What was found on the box alone is not a number of a verdict that speaks of all states.
    values = {name: number for one in parts if one in deciding_parts or not one[1].local for name, number in one[1].value.items()}
    silent = ("no constraint", "the whole space")
    how = "; ".join(f"{name}: {part.how}" for name, part in deciding_parts if part.how not in silent)
    witness = {key: item for name, part in deciding_parts for key, item in part.witness.items()}
    return make_finding(O_G, verdict, how, values, witness, region.scope(any(part.local for _, part in deciding_parts))), below


def _lower_bound_part(below: LowerBoundResult) -> HypothesisPart:
    tight = np.isfinite(below.bound) and below.value - below.bound <= TIGHT_BOUND * (1 + abs(below.value))
    values = {"inf g": below.bound} if tight else {"least g met": below.value}
    values |= {"lower bound of g": below.bound} if np.isfinite(below.bound) else {}
    if below.bounded:
        return HypothesisPart(HOLDS, below.how, values, {})
    if below.bounded is False:
        return HypothesisPart(VIOLATED, below.how, {"inf g": -np.inf}, {"direction": below.direction})
    witness = {"x": below.at} if below.direction is None else {"direction": below.direction}
    verdict = SAMPLED if below.direction is None and np.isfinite(below.value) else UNKNOWN
    return HypothesisPart(verdict, below.how, values, witness)


# -- O-dry -------------------------------------------------------------------------------------------------------------


def _check_dry_friction(model: FrictionOscillator) -> Finding:
    n = model.x.numel()
    H = [np.array(ca.DM(element.H)) for element in model.elements]
    bounds = [friction_law.slope_at_zero_bounds(element, model.s) for element in model.elements]
    dry = [(r, matrix) for (r, _), matrix in zip(bounds, H, strict=True) if r > 0]
    maybe = [matrix for (_, r), matrix in zip(bounds, H, strict=True) if r > 0]
    values = {
        "theta'(0)" if len(H) == 1 else f"theta'(0) of '{element.name}'": low
        for element, (low, high) in zip(model.elements, bounds, strict=True)
        if np.isfinite([low, high]).all()
    }
    free = exact.nullspace(np.vstack([np.zeros((1, n)), *maybe]))
    if free.shape[1]:
        direction = exact.doubles(free[:, 0])
        how = "a direction without dry friction: theta_j'(0) H_j d = 0 for every element (exact)"
        return make_finding(
            O_DRY, VIOLATED, how, values | {RADIUS_LABEL: 0.0}, {"direction": direction / np.linalg.norm(direction)}
        )
    stacked = np.vstack([np.zeros((1, n)), *(matrix for _, matrix in dry)])
    if exact.rank(stacked) < n:
        names = [e.name for e, (low, high) in zip(model.elements, bounds, strict=True) if low <= 0 < high]
        how = f"theta'(0) of {', '.join(names)} is not proved positive"
        return make_finding(O_DRY, UNKNOWN, how, values, {"elements": names})
    least = friction_radius(dry, n)
    values |= {RADIUS_LABEL: least.low} | ({"sigma attained": least.value} if least.low < least.value else {})
    how = "theta_j'(0) > 0 and the H_j of these elements have full column rank together (exact)"
    return make_finding(O_DRY, HOLDS, how, values, {"direction of least friction": least.at})


# -- O-steps -----------------------------------------------------------------------------------------------------------


def _check_steps(model: FrictionOscillator, runs: Sequence[Trajectory]) -> Finding:
    if model.is_forced and runs:
        return forced_steps_finding(runs)
    if runs and all("correction" in run.arrays for run in runs):
        how = "error control carries the velocity over from step to step: the proposition then asks for no order of the steps"
        return make_finding(O_STEPS, HOLDS, how, {"least step": min(float(run.step[1:].min()) for run in runs)})
    grids = [("the run's", *_run_steps(model, run)) for run in runs if "correction" not in run.arrays]
    if not grids and model.steps is not None:
        grids = [("the model's", np.asarray(model.steps, float), False)]
    elif not grids and model.step is not None:
        ratio = (model.t_end or model.step) / model.step
        whole = abs(ratio - round(ratio)) <= 1e-9 * ratio
        grids = [("the model's", np.array([model.step]), not whole)]
    if not grids:
        return make_finding(O_STEPS, UNKNOWN, "the model has no step of its own, and no run is given")
    least = min(float(steps.min()) for _, steps, _ in grids)
    for whose, steps, _ in grids:
        # Equal steps recovered from times differ by rounding.
        fall = np.flatnonzero(np.diff(steps) < -64 * EPS * steps[:-1])
        if fall.size:
            n = int(fall[0]) + 1
            how = f"{whose} steps decrease, first at step {n}"
            return make_finding(O_STEPS, VIOLATED, how, {"l_n": steps[n], "l_(n-1)": steps[n - 1]}, {"n": n})
    cut = " (the last step is shorter only because the run ends: the scheme keeps the velocity there)"
    constant = all(np.ptp(steps) <= 1e-12 * steps.max() for _, steps, _ in grids)
    how = ("the step is constant" if constant else "each step was compared with the one before") + (
        cut if any(shortened for _, _, shortened in grids) else ""
    )
    return make_finding(O_STEPS, HOLDS, how, {"least step": least})


def _run_steps(model: FrictionOscillator, run: Trajectory) -> tuple[np.ndarray, bool]:
    """The steps of a run, without a last one that only its end shortens, and whether there is such a one."""
    steps = run.step[np.isfinite(run.step)]
    shortened = model.steps is None and len(steps) > 1 and bool(steps[-1] < steps[-2] * (1 - 1e-9))
    constant = len(steps) > 1 and np.ptp(steps[:-1]) <= 1e-9 * steps[0]
    return (steps[:-1], True) if shortened and constant else (steps, False)


# -- consequences ------------------------------------------------------------------------------------------------------


def oscillator_consequences(
    model: FrictionOscillator, findings: Sequence[Finding], g: ca.SX, domain: ConvexSet, below: LowerBoundResult | None,
    runs: Sequence[Trajectory],
) -> list[Consequence]:  # fmt: skip
    """What follows from the findings; without ``below`` nothing is said of the rest points."""
    n, one = model.x.numel(), len(model.elements) == 1 and model.damping is None
    isotropic = one and model.elements[0].H.shape == (n, n) and bool((model.elements[0].H - ca.SX.eye(n)).is_zero())
    theorem = f"{CABOT_PAPER}, Corollary 4.2" if isotropic else f"{CABOT_PAPER}, Theorem 4.1"
    limit = "d(0, dg(x_inf)) <= theta'(0)" if isotropic else "0 in A(0) + dg(x_inf)"
    strict = "d(0, dg(x_inf)) < theta'(0)" if isotropic else "0 is interior to A(0) + dg(x_inf)"
    statements = (
        ("well posed", "each step has one and only one solution", WELL_POSED_IDS, f"{CABOT_PAPER}, Proposition 2.1"),
        (
            "energy decay", "E_{n+1} - E_n <= -l_n Phi_A((x_{n+2} - x_{n+1})/l_n)", ["O-theta", "O-g", "O-steps"],
            f"{CABOT_PAPER}, Proposition 4.1",
        ),
        ("convergence", f"sum |x_{{n+1}} - x_n| is finite, x_n -> x_inf, and {limit}", REST_IDS, f"{theorem} (i), (ii)"),
    )  # fmt: skip
    out = [make_consequence(name, statement, findings, rests_on, source) for name, statement, rests_on, source in statements]
    if model.is_forced:
        moved = (replace(item, statement=f"{item.statement}; {FORCED_TEXT}", verdict=UNKNOWN) for item in out[1:])
        return [out[0], *moved, order_consequence()]
    dry = next(finding for finding in findings if finding.id == "O-dry").value.get(RADIUS_LABEL, 0.0) > 0
    if below is not None and below.bounded and dry:
        out += rest_points.rest_point_consequences(model, findings, REST_IDS, g, domain, below, f"{theorem} (ii)")
    seen = [_finite_convergence(run, findings, strict, f"{theorem} (iii)") for run in runs if _has_margin(run)]
    alone = make_consequence("finite convergence", _finite_if(strict), findings, REST_IDS, f"{theorem} (iii)")
    return [*out, *(seen or [alone]), order_consequence()]


def _has_margin(run: Trajectory) -> bool:
    """Whether a run says how far it is from moving; one with a force does not."""
    return (run.metadata.get("convergence") or {}).get("margin") is not None


def forced_steps_finding(runs: Sequence[Trajectory]) -> Finding:
    """O-steps of runs with a force."""
    how = "with a force the velocity goes on from step to step: no order of the steps is asked for"
    return make_finding(O_STEPS, HOLDS, how, {"least step": min(float(np.nanmin(run.step)) for run in runs)})


def order_consequence() -> Consequence:
    """What is not known of the order."""
    statement = "in the step, order 1 is observed; the paper proves none"
    return Consequence("order of convergence", statement, (), UNKNOWN, {}, f"{CABOT_PAPER} (no statement)")


def _finite_convergence(run: Trajectory, findings: Sequence[Finding], strict: str, source: str) -> Consequence:
    """At rest for ever with a margin, as a run showed; else what the theorem says alone, but where its condition may fail."""
    seen = run.metadata["convergence"]
    numbers = {
        label: seen[key]
        for key, label in (
            ("n_0", "n_0"), ("t_0", "t_0"), ("margin", "margin"), ("distance", "d(0, dg(x))"), ("theta_prime_0", "theta'(0)"),
        )
        if seen.get(key) is not None and np.isfinite(seen[key])
    }  # fmt: skip
    if seen["finite"]:
        statement = f"the run is at rest from n_0 on, and {strict}: in finitely many steps"
        return make_consequence("finite convergence", statement, findings, REST_IDS, source, numbers)
    size = max(abs(seen["margin"] - seen["distance"]), abs(seen["distance"])) if np.isfinite(seen["margin"]) else np.inf
    if abs(seen["margin"]) <= BOUNDARY_MARGIN * size < np.inf:
        edge = (
            "0 lies on the boundary of A(0) + dg(x) as far as the run tells: (iii) does not apply, convergence need not be finite"
        )
        return Consequence("finite convergence", edge, REST_IDS, UNKNOWN, numbers, source)
    statement = f"{_finite_if(strict)}; not seen in the run: {seen['reason']}"
    return make_consequence("finite convergence", statement, findings, REST_IDS, source, numbers)


def _finite_if(strict: str) -> str:
    return f"x_n = x_inf from some n_0 on if {strict}"


def _worst_verdict(verdicts: Sequence[str]) -> str:
    return min(verdicts, key=VERDICTS_WORST_FIRST.index, default=HOLDS)
