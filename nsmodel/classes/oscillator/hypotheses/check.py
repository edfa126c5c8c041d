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

from nsmodel.classes.oscillator.hypotheses import friction_law, rest_points
from nsmodel.classes.oscillator.hypotheses.radius import radius
from nsmodel.classes.oscillator.model import FrictionOscillator
from nsmodel.hypotheses.domain import domain_rows, without_domain
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Consequence, Finding, Hypothesis, follows, found
from nsmodel.hypotheses.region import Region
from nsmodel.proof import exact
from nsmodel.proof.convex import lower_bound, potentials
from nsmodel.proof.convex.convex_sets import ConvexSet, has_interior, is_convex
from nsmodel.proof.convex.lower_bound import Below
from nsmodel.proof.graph import column
from nsmodel.proof.verdict import Part
from nsmodel.trajectory import Trajectory

PAPER = "Cabot 2004"
THETA = Hypothesis("O-theta", "theta is convex, C1 and nondecreasing on [0, inf)", f"{PAPER}, Proposition 2.2")
G = Hypothesis("O-g", "g is closed and convex, inf g > -inf, int dom g is not empty", f"{PAPER}, Theorem 4.1")
DRY = Hypothesis("O-dry", "dry friction: 0 is interior to A(0), that is theta'(0) > 0", f"{PAPER}, Theorem 4.1, Corollary 4.2")
STEPS = Hypothesis("O-steps", "the steps are positive and nondecreasing", f"{PAPER}, Proposition 4.1")
HYPOTHESES = (THETA, G, DRY, STEPS)
TWIN = False  # No two solutions are compared.
RADIUS = "radius of A(0)"
TIGHT = 1e-7  # A lower bound of g that is attained but for this, beside 1 and its size, is given as inf g.
BOUNDARY = 1e-9  # A margin below this, beside the forces, at the end of a run may be 0.
FORCED = "a force that moves with time does work and does not let it rest: the paper is about oscillators left to themselves"
ORDER = (VIOLATED, UNKNOWN, SAMPLED, HOLDS)  # from the worst


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
    potential = without_domain(model.potential, model.x, "potential")
    domain = domain_of(model)
    g, below = _potential(model, potential, domain, region, quick)
    findings = [_theta(model, quick), g, _dry(model), _steps(model, runs)]
    return findings, consequences_of(model, findings, potential, domain, below, runs)


def domain_of(model: FrictionOscillator) -> ConvexSet:
    """Dom g: the conditions in the potential, and the model's constraints."""
    rows, equalities = domain_rows(model.potential, model.x, "potential")
    c = column([*rows, *model.constraints.values()])
    names = [f"potential: {row} >= 0" for row in rows]
    return ConvexSet(model.x, c, [*names, *model.constraint_names], column(equalities))


# -- O-theta -----------------------------------------------------------------------------------------------------------


def _theta(model: FrictionOscillator, quick: bool) -> Finding:
    parts = [(element.name, friction_law.is_law(element, model.s, quick=quick)) for element in model.elements]
    values: dict[str, float] = {}
    for name, part in parts:
        label = "" if len(parts) == 1 else f" of '{name}'"
        values |= {key + label: number for key, number in part.value.items()}
    if model.damping is not None:
        M = np.array(ca.DM(model.damping))
        part = _monotone(M)
        parts.append(("damping", part))
        values |= part.value
    verdict = _worst([part.verdict for _, part in parts])
    told = [(name, part) for name, part in parts if part.verdict == verdict] if verdict != HOLDS else parts
    how = "; ".join(dict.fromkeys(part.how if len(parts) == 1 else f"'{name}': {part.how}" for name, part in told))
    witness = {} if verdict == HOLDS else {"element": told[0][0], **told[0][1].witness}
    return found(THETA, verdict, how or "no friction: A = 0", values or {"elements": 0}, witness)


def _monotone(M: np.ndarray) -> Part:
    """M + M' psd, exactly: the damping is part of the monotone operator A."""
    decided, values = exact.psd(M), np.linalg.eigvalsh((M + M.T) / 2)
    least, rounding = float(values[0]), potentials.ROUNDING * float(np.abs(values).max(initial=0.0))
    number = {"least eigenvalue of the damping": max(least, 0.0) if decided.psd else least}
    if decided.psd:
        return Part(HOLDS, "M + M' is psd in exact arithmetic", number, {})
    witness = {"vector": np.linalg.eigh((M + M.T) / 2)[1][:, 0]}
    if least >= -rounding:
        return Part(SAMPLED, "M + M' is psd up to rounding only", number | {"rounding bound": rounding}, witness)
    return Part(VIOLATED, "M + M' is not psd: the damping is not monotone", number, witness)


# -- O-g ---------------------------------------------------------------------------------------------------------------


def _potential(
    model: FrictionOscillator, g: ca.SX, domain: ConvexSet, region: Region, quick: bool
) -> tuple[Finding, Below | None]:
    x0 = np.array(ca.DM(model.x0)).ravel()
    box = region.lower, region.upper
    interior = has_interior(domain, x0)
    if domain.empty:
        return found(G, VIOLATED, f"interior: {interior.how}", interior.value, interior.witness), None
    closed = is_convex(domain, *box, quick=quick)
    convex = potentials.is_convex(g, domain, *box, quick=quick)
    below = None
    parts = [("convex", convex), ("domain", closed), ("interior", interior)]
    if interior.verdict != VIOLATED:
        start = np.asarray(interior.witness.get("interior point", x0))
        below = lower_bound.bounded_below(g, domain, start, convex=convex.verdict == HOLDS and not convex.local)
        parts.insert(1, ("inf g", _bounded(below)))
    verdict = _worst([part.verdict for _, part in parts])
    told = parts if verdict == HOLDS else [(name, part) for name, part in parts if part.verdict == verdict]
    # What was found on the box alone is no number of a verdict that speaks of all states.
    values = {name: number for one in parts if one in told or not one[1].local for name, number in one[1].value.items()}
    silent = ("no constraint", "the whole space")
    how = "; ".join(f"{name}: {part.how}" for name, part in told if part.how not in silent)
    witness = {key: item for name, part in told for key, item in part.witness.items()}
    return found(G, verdict, how, values, witness, region.scope(any(part.local for _, part in told))), below


def _bounded(below: Below) -> Part:
    tight = np.isfinite(below.bound) and below.value - below.bound <= TIGHT * (1 + abs(below.value))
    values = {"inf g": below.bound} if tight else {"least g met": below.value}
    values |= {"lower bound of g": below.bound} if np.isfinite(below.bound) else {}
    if below.bounded:
        return Part(HOLDS, below.how, values, {})
    if below.bounded is False:
        return Part(VIOLATED, below.how, {"inf g": -np.inf}, {"direction": below.direction})
    witness = {"x": below.at} if below.direction is None else {"direction": below.direction}
    verdict = SAMPLED if below.direction is None and np.isfinite(below.value) else UNKNOWN
    return Part(verdict, below.how, values, witness)


# -- O-dry -------------------------------------------------------------------------------------------------------------


def _dry(model: FrictionOscillator) -> Finding:
    n = model.x.numel()
    H = [np.array(ca.DM(element.H)) for element in model.elements]
    bounds = [friction_law.slope_at_zero(element, model.s) for element in model.elements]
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
        return found(DRY, VIOLATED, how, values | {RADIUS: 0.0}, {"direction": direction / np.linalg.norm(direction)})
    stacked = np.vstack([np.zeros((1, n)), *(matrix for _, matrix in dry)])
    if exact.rank(stacked) < n:
        names = [e.name for e, (low, high) in zip(model.elements, bounds, strict=True) if low <= 0 < high]
        how = f"theta'(0) of {', '.join(names)} is not proved positive"
        return found(DRY, UNKNOWN, how, values, {"elements": names})
    least = radius(dry, n)
    values |= {RADIUS: least.low} | ({"sigma attained": least.value} if least.low < least.value else {})
    how = "theta_j'(0) > 0 and the H_j of these elements have full column rank together (exact)"
    return found(DRY, HOLDS, how, values, {"direction of least friction": least.at})


# -- O-steps -----------------------------------------------------------------------------------------------------------


def _steps(model: FrictionOscillator, runs: Sequence[Trajectory]) -> Finding:
    if model.is_forced and runs:
        return steps_of_forced(runs)
    if runs and all("correction" in run.arrays for run in runs):
        how = "error control carries the velocity over from step to step: the proposition then asks for no order of the steps"
        return found(STEPS, HOLDS, how, {"least step": min(float(run.step[1:].min()) for run in runs)})
    grids = [("the run's", *_run_steps(model, run)) for run in runs if "correction" not in run.arrays]
    if not grids and model.steps is not None:
        grids = [("the model's", np.asarray(model.steps, float), False)]
    elif not grids and model.step is not None:
        ratio = (model.t_end or model.step) / model.step
        whole = abs(ratio - round(ratio)) <= 1e-9 * ratio
        grids = [("the model's", np.array([model.step]), not whole)]
    if not grids:
        return found(STEPS, UNKNOWN, "the model has no step of its own, and no run is given")
    least = min(float(steps.min()) for _, steps, _ in grids)
    for whose, steps, _ in grids:
        # Equal steps recovered from times differ by rounding.
        fall = np.flatnonzero(np.diff(steps) < -64 * np.finfo(float).eps * steps[:-1])
        if fall.size:
            n = int(fall[0]) + 1
            how = f"{whose} steps decrease, first at step {n}"
            return found(STEPS, VIOLATED, how, {"l_n": steps[n], "l_(n-1)": steps[n - 1]}, {"n": n})
    cut = " (the last step is shorter only because the run ends: the scheme keeps the velocity there)"
    constant = all(np.ptp(steps) <= 1e-12 * steps.max() for _, steps, _ in grids)
    how = ("the step is constant" if constant else "each step was compared with the one before") + (
        cut if any(shortened for _, _, shortened in grids) else ""
    )
    return found(STEPS, HOLDS, how, {"least step": least})


def _run_steps(model: FrictionOscillator, run: Trajectory) -> tuple[np.ndarray, bool]:
    """The steps of a run, without a last one that only its end shortens, and whether there is such a one."""
    steps = run.step[np.isfinite(run.step)]
    shortened = model.steps is None and len(steps) > 1 and bool(steps[-1] < steps[-2] * (1 - 1e-9))
    constant = len(steps) > 1 and np.ptp(steps[:-1]) <= 1e-9 * steps[0]
    return (steps[:-1], True) if shortened and constant else (steps, False)


# -- consequences ------------------------------------------------------------------------------------------------------


def consequences_of(
    model: FrictionOscillator, findings: Sequence[Finding], g: ca.SX, domain: ConvexSet, below: Below | None,
    runs: Sequence[Trajectory],
) -> list[Consequence]:  # fmt: skip
    """What follows from the findings; without ``below`` nothing is said of the rest points."""
    n, one = model.x.numel(), len(model.elements) == 1 and model.damping is None
    isotropic = one and model.elements[0].H.shape == (n, n) and bool((model.elements[0].H - ca.SX.eye(n)).is_zero())
    theorem = f"{PAPER}, Corollary 4.2" if isotropic else f"{PAPER}, Theorem 4.1"
    limit = "d(0, dg(x_inf)) <= theta'(0)" if isotropic else "0 in A(0) + dg(x_inf)"
    strict = "d(0, dg(x_inf)) < theta'(0)" if isotropic else "0 is interior to A(0) + dg(x_inf)"
    every = [h.id for h in HYPOTHESES]
    statements = (
        ("well posed", "each step has one and only one solution", every[:2], f"{PAPER}, Proposition 2.1"),
        (
            "energy decay", "E_{n+1} - E_n <= -l_n Phi_A((x_{n+2} - x_{n+1})/l_n)", ["O-theta", "O-g", "O-steps"],
            f"{PAPER}, Proposition 4.1",
        ),
        ("convergence", f"sum |x_{{n+1}} - x_n| is finite, x_n -> x_inf, and {limit}", every, f"{theorem} (i), (ii)"),
    )  # fmt: skip
    out = [follows(name, statement, findings, rests_on, source) for name, statement, rests_on, source in statements]
    if model.is_forced:
        moved = (replace(item, statement=f"{item.statement}; {FORCED}", verdict=UNKNOWN) for item in out[1:])
        return [out[0], *moved, no_order()]
    dry = next(finding for finding in findings if finding.id == "O-dry").value.get(RADIUS, 0.0) > 0
    if below is not None and below.bounded and dry:
        out += rest_points.consequences(model, findings, every, g, domain, below, f"{theorem} (ii)")
    condition = f"x_n = x_inf from some n_0 on if {strict}"
    if not runs:
        out.append(follows("finite convergence", condition, findings, every, f"{theorem} (iii)"))
    out += [_finite(run, findings, every, strict, f"{theorem} (iii)") for run in runs if _told(run)]
    return [*out, no_order()]


def _told(run: Trajectory) -> bool:
    """Whether a run says how far it is from moving; one with a force does not."""
    return (run.metadata.get("convergence") or {}).get("margin") is not None


def steps_of_forced(runs: Sequence[Trajectory]) -> Finding:
    """O-steps of runs with a force."""
    how = "with a force the velocity goes on from step to step: no order of the steps is asked for"
    return found(STEPS, HOLDS, how, {"least step": min(float(np.nanmin(run.step)) for run in runs)})


def no_order() -> Consequence:
    """What is not known of the order."""
    statement = "in the step, order 1 is observed; the paper proves none"
    return Consequence("order of convergence", statement, (), UNKNOWN, {}, f"{PAPER} (no statement)")


def _finite(run: Trajectory, findings: Sequence[Finding], every: Sequence[str], strict: str, source: str) -> Consequence:
    """What a run showed: at rest for ever with a margin, or not told."""
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
        return follows("finite convergence", statement, findings, every, source, numbers)
    size = max(abs(seen["margin"] - seen["distance"]), abs(seen["distance"])) if np.isfinite(seen["margin"]) else np.inf
    if abs(seen["margin"]) <= BOUNDARY * size < np.inf:
        edge = (
            "0 lies on the boundary of A(0) + dg(x) as far as the run tells: (iii) does not apply, convergence need not be finite"
        )
        return Consequence("finite convergence", edge, tuple(every), UNKNOWN, numbers, source)
    statement = f"not shown to be finite: {seen['reason']}"
    return Consequence("finite convergence", statement, tuple(every), UNKNOWN, numbers, source)


def _worst(verdicts: Sequence[str]) -> str:
    return min(verdicts, key=ORDER.index, default=HOLDS)
