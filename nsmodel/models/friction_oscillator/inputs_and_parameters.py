"""Oscillators whose force or friction has inputs: at each time theta is one function, and a step has one solution.

Hypotheses of an oscillator under dry friction for all values of parameters in a box.

A convex combination of friction laws is a law, of convex potentials a convex one: where theta, M and g are affine in functions of
the parameters, they are decided at corners, exactly; else by bounds over states and parameters together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, Consequence, Finding, IntervalBox, make_consequence, make_finding
from nsmodel.hypotheses.inputs import InputBounds, unknown_consequence
from nsmodel.hypotheses.moving_law import time_as_input
from nsmodel.hypotheses.region import (
    ParameterValues,
    Region,
    box_middle,
    combine_proofs,
    depends_on_symbol,
    domain_rows,
    findings_for_box,
    parameter_roots,
    potential_without_domain,
    unaffected_findings,
)
from nsmodel.hypotheses.staying import ROUNDED_DOWN, StayTime
from nsmodel.models.friction_oscillator import friction_law, rest_points
from nsmodel.models.friction_oscillator.check import (
    CABOT_PAPER,
    FORCED_TEXT,
    O_DRY,
    O_G,
    O_STEPS,
    O_THETA,
    RADIUS_LABEL,
    REST_IDS,
    WELL_POSED_IDS,
    check,
    forced_steps_finding,
    order_consequence,
    oscillator_consequences,
)
from nsmodel.models.friction_oscillator.model import Friction, FrictionOscillator
from nsmodel.models.friction_oscillator.rest_points import friction_radius
from nsmodel.models.friction_oscillator.schemes import elements_at_end
from nsmodel.proof import exact, extremum, interval_bounds
from nsmodel.proof.convex import lower_bounds, potentials, rules
from nsmodel.proof.convex.sets import MovingSet, has_interior_for_all, is_convex_for_all, outer_set
from nsmodel.proof.expression_graph import stack_column, stored_entries
from nsmodel.proof.parameter_hull import matrix_corners, mixture_corners
from nsmodel.proof.verdict import HypothesisPart
from nsmodel.simulation.trajectory import Trajectory

DRIVEN_FIELDS = {"force": ("force",), "friction": ("elements",)}


def freeze_law(model: FrictionOscillator) -> FrictionOscillator:
    """The oscillator with time in its friction as an input: at each time theta is one function."""
    if not any(ca.depends_on(element.theta, model.t) for element in model.elements):
        return model
    return time_as_input(model, lambda tau: {"elements": elements_at_end(model, tau, model.u)})


def driven_findings(
    model: FrictionOscillator, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory],
    quick: bool
) -> list[Finding]:  # fmt: skip
    """Those at each value of the inputs, but for the steps; see the inclusions' module of this name."""
    return [forced_steps_finding(runs) if item.id == O_STEPS.id and runs else item for item in own]


def driven_consequences(
    model: FrictionOscillator, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory]
) -> list[Consequence]:  # fmt: skip
    """A step has one solution; nothing is said of rest."""
    well = make_consequence(
        "well posed", "each step has one and only one solution", own, WELL_POSED_IDS, f"{CABOT_PAPER}, Proposition 2.1"
    )
    rest = make_consequence("convergence", "x_n converges", own, REST_IDS, f"{CABOT_PAPER}, Theorem 4.1")
    return [well, unknown_consequence(rest, FORCED_TEXT), order_consequence()]


FIELDS_OF_OSCILLATOR = {
    "O-theta": ("elements", "damping"), "O-g": ("potential", "constraints"), "O-dry": ("elements",), "O-steps": (),
}  # fmt: skip
DAMPING_EIGENVALUE = "least eigenvalue of the damping"
POTENTIAL_LOWER_BOUND = "lower bound of g"
# Of E: a bound of g on the sides of the box is sought until it is above E by this part, so that rounding of E does not decide.
ENERGY_ROUNDING = 1e-9
ZERO_ARGUMENT, NEAR_ZERO_ARGUMENT = np.zeros(1), np.full(1, 1e-6)  # Speeds between which theta must be continuous.


def special_values(model: FrictionOscillator, box: IntervalBox) -> list[ParameterValues]:
    """Values of a single parameter at which some theta_j'(0) or an entry of the Hessian of g vanishes."""
    slopes = [ca.substitute(ca.gradient(element.theta, model.s), model.s, 0) for element in model.elements]
    H = ca.hessian(potential_without_domain(model.potential, model.x, "potential"), model.x)[0]
    return parameter_roots([*slopes, *(entry for entry in stored_entries(H) if not ca.depends_on(entry, model.x))], model, box)


def uniform_findings(model: FrictionOscillator, region: Region, quick: bool) -> list[Finding]:
    """What is decided for all values of the parameters, whose boxes are those of ``region``."""
    same = unaffected_findings(check, model, region, quick, FIELDS_OF_OSCILLATOR)
    known = {finding.id for finding in same}
    makers = {
        "O-theta": partial(_friction_for_all, quick=quick),
        "O-g": partial(_potential_for_all, quick=quick),
        "O-dry": _dry_friction_for_all,
    }
    return findings_for_box([make(model, region) for id, make in makers.items() if id not in known], same, region)


def uniform_consequences(model: FrictionOscillator, region: Region, own: Sequence[Finding]) -> list[Consequence]:
    """What follows for all values of the parameters."""
    C = _moving_domain(model, region)
    made = oscillator_consequences(model, own, ca.SX(0), outer_set(C), None, ())
    premises = [item for item in own if item.id in REST_IDS]
    proved = all(item.verdict == HOLDS and not (item.scope and item.scope.states) for item in premises)
    if model.is_forced or C.x.numel() > 1 or C.moving or not proved:
        return made
    return [
        *made,
        *rest_points.rest_points_for_all(model, region, own, REST_IDS, outer_set(C), f"{CABOT_PAPER}, Theorem 4.1 (ii)"),
    ]


# -- friction ----------------------------------------------------------------------------------------------------------


def _friction_for_all(model: FrictionOscillator, region: Region, quick: bool) -> Finding | None:
    parts = [(element.name, _law_for_all(element, model, region, quick)) for element in model.elements]
    if model.damping is not None:
        parts.append(("damping", _damping_for_all(model, region)))
    if not parts or any(part is None for _, part in parts):
        return None
    proved = [(name, part) for name, part in parts if part is not None]
    one = len(proved) == 1
    how = "; ".join(part.how if one else f"'{name}': {part.how}" for name, part in proved)
    labels = [("" if one or name == "damping" else f" of '{name}'", part.value) for name, part in proved]
    return make_finding(O_THETA, HOLDS, how, {key + label: number for label, value in labels for key, number in value.items()})


def _damping_for_all(model: FrictionOscillator, region: Region) -> HypothesisPart | None:
    """M + M' is psd at all corners of a map in whose hull M lies."""
    at = matrix_corners([model.damping], model.p, *region.parameter_bounds())
    if at is None or not all(exact.is_psd(M) for (M,) in at):
        return None
    least = min(-exact.eigenvalue_upper_bound(-M) for (M,) in at)
    return HypothesisPart(
        HOLDS, f"M + M' is psd, exactly at {len(at)} corners, in whose hull M lies", {DAMPING_EIGENVALUE: max(least, 0.0)}, {}
    )


def _corner_laws(element: Friction, model: FrictionOscillator, region: Region) -> list[Friction] | None:
    """The laws of which those of all values are convex combinations."""
    at = mixture_corners(element.theta, model.p, *region.parameter_bounds())
    return None if at is None else [element._replace(theta=theta) for theta in at]


def _law_for_all(element: Friction, model: FrictionOscillator, region: Region, quick: bool) -> HypothesisPart | None:
    """Theta is convex, C1 and nondecreasing."""
    s, laws = model.s, _corner_laws(element, model, region)
    if laws is not None:
        numbers = friction_law.MIN_SLOPE, friction_law.MIN_CURVATURE, friction_law.MIN_CURVATURE_BOUND
        ends: dict[str, Callable[..., float]] = dict.fromkeys(numbers, min)
        return combine_proofs((friction_law.check_friction_law(one, s, quick=quick) for one in laws), ends)
    low, high = region.parameter_bounds()
    z, low, high = ca.vertcat(s, model.p), np.append(0.0, low), np.append(np.inf, high)
    theta = rules.resolve_kinks(element.theta, z, low, high, f"friction '{element.name}' theta")
    first, second = ca.gradient(theta, s), ca.hessian(theta, s)[0]
    begin = _slope_bounds(element, model, region)[0]
    if begin < 0 or not interval_bounds.is_continuous(ca.vertcat(theta, first), z, low, high):
        return None
    if not rules.curvatures(theta, z, low, high, of=s)[0].convex:
        if not extremum.supremum(-second, z, low, high, bound_to=0.0, quick=quick).bound <= 0:
            return None
    return HypothesisPart(HOLDS, "bounds of theta' and theta'' over s and the parameters", {friction_law.MIN_SLOPE: begin}, {})


def _slope_bounds(element: Friction, model: FrictionOscillator, region: Region) -> tuple[float, float]:
    """Bounds of theta'(0) for all values; infinite ones where it is not proved to exist."""
    laws = _corner_laws(element, model, region)
    if laws is not None:
        ends = [friction_law.slope_at_zero_bounds(one, model.s) for one in laws]
        return min(low for low, _ in ends), max(high for _, high in ends)
    z, (low, high) = ca.vertcat(model.s, model.p), region.parameter_bounds()
    first = ca.gradient(element.theta, model.s)
    if not interval_bounds.is_continuous(
        ca.vertcat(element.theta, first), z, np.append(ZERO_ARGUMENT, low), np.append(NEAR_ZERO_ARGUMENT, high)
    ):
        return -np.inf, np.inf
    below, above = interval_bounds.enclose(first, z, np.append(ZERO_ARGUMENT, low), np.append(ZERO_ARGUMENT, high))
    return float(np.min(below)), float(np.max(above))


def _dry_friction_for_all(model: FrictionOscillator, region: Region) -> Finding | None:
    """sigma(d) = sum_j theta_j'(0) |H_j d| with lower bounds of the theta_j'(0): of constant H_j the ball of these."""
    n, p, box = model.x.numel(), model.p, region.parameter_bounds()
    bounds = [(element, *_slope_bounds(element, model, region)) for element in model.elements]
    dry = [(low, element.H) for element, low, _ in bounds if low > 0]
    names = ["" if len(bounds) == 1 else f" of '{element.name}'" for element, *_ in bounds]
    numbers = {f"theta'(0){name}": low for name, (_, low, _) in zip(names, bounds, strict=True) if np.isfinite(low)}
    if not dry:
        return None
    if not any(depends_on_symbol(H, p) for _, H in dry):
        own = [(low, np.array(ca.DM(H))) for low, H in dry]
        if exact.rank(np.vstack([H for _, H in own])) < n:
            return None
        how = "theta_j'(0) > 0 for all values, and the H_j of these elements have full column rank together (exact)"
        return make_finding(O_DRY, HOLDS, how, {**numbers, RADIUS_LABEL: friction_radius(own, n).low})
    gram = sum((low**2 * H.T @ H for low, H in dry), ca.SX(n, n))
    least = -extremum.largest_eigenvalue(-gram, p, *box).bound
    if not least > 0:
        return None
    how = "bounds of the least singular value of the theta_j'(0) H_j over the box"
    return make_finding(O_DRY, HOLDS, how, {**numbers, RADIUS_LABEL: float(np.sqrt(least)) * (1 - 1e-12)})


# -- potential ---------------------------------------------------------------------------------------------------------


def _moving_domain(model: FrictionOscillator, region: Region) -> MovingSet:
    """Dom g; equalities leave no interior, and are not looked at."""
    rows, _ = domain_rows(model.potential, model.x, "potential")
    return MovingSet(model.x, model.p, stack_column([*rows, *model.constraints.values()]), *region.parameter_bounds())


def _potential_for_all(model: FrictionOscillator, region: Region, quick: bool) -> Finding | None:
    """g convex on a set that holds dom g for all values, and bounded below there; dom g convex, with interior."""
    if domain_rows(model.potential, model.x, "potential")[1]:
        return None
    C = _moving_domain(model, region)
    start = np.array(ca.DM(model.bind(box_middle(region.parameters)).x0)).ravel()
    closed, interior = is_convex_for_all(C, region.lower, region.upper, quick=quick), has_interior_for_all(C, start)
    g = potential_without_domain(model.potential, model.x, "potential")
    convex = _convexity_for_all(g, C, region, start, quick) if closed is not None and interior is not None else None
    if closed is None or interior is None or convex is None:
        return None
    silent = ("no constraint", "the whole space")
    parts = [("g", convex), ("domain", closed), ("interior", interior.part)]
    how = "; ".join(f"{name}: {part.how}" for name, part in parts if part.how not in silent)
    value = {key: number for _, part in parts for key, number in part.value.items()}
    return make_finding(O_G, HOLDS, how, value, interior.part.witness, region.scope(any(part.local for _, part in parts)))


def _convexity_for_all(g: ca.SX, C: MovingSet, region: Region, start: np.ndarray, quick: bool) -> HypothesisPart | None:
    """g is convex and bounded below, for all values."""
    whole, at = outer_set(C), mixture_corners(g, C.p, C.lower, C.upper)
    z, low, high = ca.vertcat(C.x, C.p), np.append(whole.bounding_box[0], C.lower), np.append(whole.bounding_box[1], C.upper)
    least = float(np.min(interval_bounds.enclose(g, z, low, high)[0]))
    if at is not None:
        ends: dict[str, Callable[..., float]] = dict.fromkeys(
            (potentials.MIN_EIGENVALUE_KEY, potentials.EIGENVALUE_BOUND_KEY, POTENTIAL_LOWER_BOUND), min
        )
        part = combine_proofs((_check_convex_and_bounded(one, whole, region, start, quick) for one in at), ends)
        bound = -np.inf if part is None else max(least, part.value.get(POTENTIAL_LOWER_BOUND, -np.inf))
        return part if part is None or bound == -np.inf else part._replace(value={**part.value, POTENTIAL_LOWER_BOUND: bound})
    if not np.isfinite(least):
        return None
    if rules.curvatures(g, z, low, high, of=C.x)[0].convex:
        return HypothesisPart(
            HOLDS, "by the rules of convex functions, and bounds over states and parameters", {POTENTIAL_LOWER_BOUND: least}, {}
        )
    smooth = interval_bounds.is_continuous(ca.vertcat(g, ca.gradient(g, C.x)), z, low, high)
    top = extremum.largest_eigenvalue(-ca.hessian(g, C.x)[0], z, low, high, bound_to=0.0, quick=quick) if smooth else None
    if top is None or not top.bound <= 0:
        return None
    value = {potentials.EIGENVALUE_BOUND_KEY: abs(top.bound), POTENTIAL_LOWER_BOUND: least}
    return HypothesisPart(HOLDS, "bounds of the eigenvalues of the Hessian, and of g, over states and parameters", value, {})


def _check_convex_and_bounded(
    g: ca.SX, C: lower_bounds.ConvexSet, region: Region, start: np.ndarray, quick: bool
) -> HypothesisPart:
    """One potential on a set."""
    convex = potentials.is_convex_potential(g, C, region.lower, region.upper, quick=quick)
    if convex.verdict != HOLDS:
        return convex
    below = lower_bounds.decide_bounded_below(g, C, start, convex=not convex.local)
    if not below.bounded:
        return convex._replace(verdict="unknown")
    bound = {POTENTIAL_LOWER_BOUND: below.bound} if np.isfinite(below.bound) else {}
    return convex._replace(how=f"{convex.how}; {below.how}", value={**convex.value, **bound})


def stay_times(
    model: FrictionOscillator, region: Region, findings: Sequence[Finding], start: tuple[np.ndarray, np.ndarray]
) -> list[StayTime]:  # fmt: skip
    """By the energy E = |x'|^2 / 2 + g(x), friction takes from it: E' <= <force, x'>; nothing where g has walls.

    |x'| <= w = sqrt(2 (E - b)), g >= b, and w' <= |force|; without a force nobody comes to where g > E(0).
    """
    holds = {finding.id for finding in findings if finding.verdict == HOLDS}
    walls = model.constraint_names or any(domain_rows(model.potential, model.x, "potential"))
    if walls or O_THETA.id not in holds or (model.x1 is not None and model.step is None):
        return []
    v0 = model.v0 if model.x1 is None else (model.x1 - model.x0) / model.step
    (low, high), g, n = region.parameter_bounds(), model.potential, len(model.names)
    energy = ca.sumsqr(v0) / 2 + ca.substitute(g, model.x, model.x0)
    E = float(interval_bounds.enclose(energy, model.p, low, high)[1].item())
    force = extremum.supremum(ca.sumsqr(model.force), ca.vertcat(model.t, model.p), np.append(region.t0, low),
                              np.append(region.t1, high), quick=True).bound  # fmt: skip
    z, F = ca.vertcat(model.x, model.p), float(np.sqrt(max(force, 0.0)))

    def least(lower: np.ndarray, upper: np.ndarray, enough: float | None = None) -> float:
        return -extremum.supremum(
            -g, z, np.append(lower, low), np.append(upper, high), quick=enough is None, bound_to=enough
        ).bound

    room = float(np.min(np.minimum(start[0] - region.lower, region.upper - start[1])))
    below = least(region.lower, region.upper)
    if not (room > 0 and np.isfinite([E, F, below]).all()):
        return []
    faces = []
    for i, side in ((i, side) for i in range(n) for side in (region.lower, region.upper)):
        lower, upper = region.lower.copy(), region.upper.copy()
        lower[i] = upper[i] = side[i]
        faces.append((lower, upper))
    if not F and all(least(*face, enough=-E * (1 + np.sign(E) * ENERGY_ROUNDING)) > E for face in faces):
        return [StayTime(np.inf, f"as g > E(0) = {E:.5g} on the sides of the box")]
    w = float(np.sqrt(2 * max(E - below, 0.0)))
    time = room / w if not F and w else 2 * room / (w + np.sqrt(w * w + 2 * F * room)) if w or F else np.inf
    return [
        StayTime(
            min(float(time) * ROUNDED_DOWN, np.inf if not F else region.t1),
            f"as |x'| <= {w:.5g}" + (f" + {F:.5g} t" if F else ""),
        )
    ]
