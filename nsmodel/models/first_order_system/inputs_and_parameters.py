"""First-order systems with inputs: what is said of a step holds at each value; what is held moves with u in h and g.

Hypotheses of a first-order system for all values of parameters in a box, where f, h and g are affine in x and l.

sym(M) > 0 and sym(M - h G) > 0, G = theta A + gamma K, keep M - s G regular for 0 <= s <= h: convex in (M, G), so that corners
of a multi-affine map decide. Then det W has the sign of det M, and W_mlcp is psd or a P-matrix as det(W) W_mlcp / det M is.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from fractions import Fraction
from itertools import combinations
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import (
    HOLDS,
    SAMPLED,
    UNKNOWN,
    VIOLATED,
    Consequence,
    Finding,
    Hypothesis,
    IntervalBox,
    Scope,
    intersect_scopes,
    make_consequence,
    make_finding,
)
from nsmodel.hypotheses.inputs import InputBounds, InputJump, missing_rate_reason, scheme_limit_consequence
from nsmodel.hypotheses.region import Region, box_middle, depends_on_symbol, findings_for_box, sample_values
from nsmodel.hypotheses.staying import StayTime, multiplier_hull, stay_by_rates
from nsmodel.modeling.laws import Law
from nsmodel.models.first_order_system.check import (
    F_JACOBIANS,
    F_MLCP,
    F_STEP,
    F_UNIQUE,
    F_W,
    check,
    first_order_consequences,
    keep_proofs,
    kink_names,
)
from nsmodel.models.first_order_system.linearisation import linearise_system, step_lengths, system_jacobians
from nsmodel.models.first_order_system.model import FirstOrderSystem
from nsmodel.models.lure_system import domains
from nsmodel.proof import exact, extremum, interval_bounds
from nsmodel.proof.exact import ROUND_UP_FACTOR
from nsmodel.proof.jumps import jump_nodes
from nsmodel.proof.parameter_hull import matrix_corners
from nsmodel.simulation.trajectory import Trajectory

FIELDS_OF_SYSTEM = ("M", "f", "h", "g", "law")
JACOBIAN_IDS = (F_JACOBIANS.id, F_W.id, F_MLCP.id, F_STEP.id)
MAX_INVERSE_STATES = 6  # Up to so many M is inverted in symbols: 700 nodes for 6, and bounds of it are wide for more.
STEP_ROUNDING = 1e-9  # Relative: h |M^-1 G| is below 1 by more than it and its bound are rounded by.
# Step lengths that are decided one by one; of more the whole interval between the least and the largest at once.
MAX_CORNER_STEPS = 5
MAX_MLCP_STATES = 6  # States up to which W_mlcp is written out, by cofactors of M - h G,
MAX_MLCP_ROWS = 6  # and multipliers up to which all principal minors of it are.


StepInterval = tuple[float, float]


class AffineSystem(NamedTuple):
    """The matrices of affine f, h, g as expressions of (p, h, theta, gamma), all exact, with the box of these.

    Attributes:
        M, G, B, C, D: G = theta A + gamma K.
        z, lower, upper: (p, h, theta, gamma) and its box but for h, whose place is ``at_h``.
    """

    M: ca.SX
    G: ca.SX
    B: ca.SX
    C: ca.SX
    D: ca.SX
    z: ca.SX
    lower: np.ndarray
    upper: np.ndarray

    @property
    def h(self) -> ca.SX:
        """The step length."""
        return self.z[-3]

    @property
    def gamma(self) -> ca.SX:
        """The weight of g."""
        return self.z[-1]

    def box(self, steps: StepInterval) -> tuple[np.ndarray, np.ndarray]:
        """The box at step lengths."""
        low, high = self.lower.copy(), self.upper.copy()
        low[-3], high[-3] = steps
        return low, high


def uniform_findings(model: FirstOrderSystem, region: Region, quick: bool) -> list[Finding]:
    """What is decided for all values of the parameters, whose boxes are those of ``region``."""
    if not any(depends_on_symbol(getattr(model, part), model.p) for part in FIELDS_OF_SYSTEM):
        return check(model.bind(sample_values(region.parameters)[0]), replace(region, parameters={}), (), quick)[0]
    steps, parts = step_lengths(model, ()), _affine_system(model, region)
    if parts is None or not steps.size:
        added = _jacobian_findings(model, region, quick)
        return findings_for_box(added or _bounded_findings(model, region, steps, quick), [], region)
    timed = bool(ca.depends_on(ca.vertcat(model.f, model.h, model.g), model.t))
    scope = intersect_scopes(region.scope(timed=timed), Scope(parameters=region.parameters))
    count = {"step lengths": steps.size}
    own = [make_finding(F_JACOBIANS, HOLDS, "f, h and g are affine in x and l: one Newton iteration is exact.", count)]
    step = _step_limit_by_corners(parts, float(steps.max()))
    if step is not None:
        own += [step, make_finding(F_W, HOLDS, f"By F-step: {step.how}", count)]
        own += _mlcp_findings(model, parts, steps, region)
    return [replace(finding, scope=scope) for finding in own]


def uniform_consequences(model: FirstOrderSystem, region: Region, own: Sequence[Finding]) -> list[Consequence]:
    """What follows for all values of the parameters."""
    return first_order_consequences(model, _affine_system(model, region) is not None, own, ())


def _affine_system(model: FirstOrderSystem, region: Region) -> AffineSystem | None:
    """The matrices, where f, h and g are affine in x and l and finite for all times and values; None elsewhere."""
    inner, (low, high) = ca.vertcat(model.x, model.lam), region.parameter_bounds()
    stacked = ca.vertcat(model.f, model.h, model.g)
    A, C, D, K, B = (ca.densify(ca.jacobian(e, s)) for e, s in (
        (model.f, model.x), (model.h, model.x), (model.h, model.lam), (model.g, model.x), (model.g, model.lam),
    ))  # fmt: skip
    entries = ca.veccat(A, B, C, D, K)
    if jump_nodes(stacked, inner) or ca.depends_on(entries, ca.vertcat(model.t, inner)):
        return None
    offset, z = ca.substitute(stacked, inner, ca.DM.zeros(inner.numel())), ca.vertcat(model.t, model.p)
    ends = np.append(region.t0, low), np.append(region.t1, high)
    if not np.isfinite(interval_bounds.enclose(offset, z, *ends)).all():
        return None
    h, theta, gamma = (ca.SX.sym(name) for name in ("h", "theta", "gamma"))
    weights = [np.nan, model.theta, model.gamma]
    z = ca.vertcat(model.p, h, theta, gamma)
    M = ca.densify(model.M)
    return AffineSystem(M, theta * A + gamma * K, B, C, D, z, np.append(low, weights), np.append(high, weights))


def _jacobian_findings(model: FirstOrderSystem, region: Region, quick: bool) -> list[Finding]:
    """What asks for Jacobians alone, where parameters do not change these: they add terms free of x and l."""
    stacked, inner = ca.vertcat(model.f, model.h, model.g), ca.vertcat(model.x, model.lam)
    added, (low, high) = ca.jacobian(stacked, model.p), region.parameter_bounds()
    if (
        ca.depends_on(added, inner)
        or jump_nodes(stacked, model.p)
        or depends_on_symbol(model.M, model.p)
        or depends_on_symbol(model.law, model.p)
    ):
        return []
    ends = np.append(region.t0, low), np.append(region.t1, high)
    if not np.isfinite(interval_bounds.enclose(added, ca.vertcat(model.t, model.p), *ends)).all():
        return []
    found = check(model.bind(box_middle(region.parameters)), replace(region, parameters={}), (), quick)[0]
    return [finding for finding in found if finding.id in JACOBIAN_IDS and finding.verdict == HOLDS]


def _bounded_findings(model: FirstOrderSystem, region: Region, steps: np.ndarray, quick: bool) -> list[Finding]:
    """F-jacobians by their continuity over states, multipliers and parameters together, F-step and F-W by a norm there."""
    known, n = multiplier_hull(model.law, model.p, *region.parameter_bounds()), len(model.names)
    if known is None or n > MAX_INVERSE_STATES:
        return []
    (low_l, high_l), (low, high) = known, region.parameter_bounds()
    h = float(steps.max(initial=0.0))
    z = ca.vertcat(model.t, model.x, model.lam, model.p)
    ends = (
        np.concatenate([[region.t0], region.lower, low_l, low]),
        np.concatenate([[region.t1 + h], region.upper, high_l, high]),
    )
    stacked, J = ca.vertcat(model.f, model.h, model.g), system_jacobians(model)
    if kink_names(model) or not interval_bounds.is_continuous(ca.vertcat(stacked, ca.veccat(*J)), z, *ends):
        return []
    timed = bool(ca.depends_on(stacked, model.t))
    scope = region.scope(True, timed)
    how = "Algorithmic differentiation is exact, and the Jacobians are continuous over states and parameters together."
    found = [make_finding(F_JACOBIANS, HOLDS, how, {"kinks": 0}, scope=scope)]
    G = model.theta * J.A + model.gamma * J.K
    M = ca.densify(model.M)
    if not np.isfinite(interval_bounds.enclose(ca.inv(M), z, *ends)).all():
        return found
    size = extremum.spectral_norm(ca.inv(M) @ G, z, *ends, quick=quick, bound_to=0.99 / h if h else None).bound
    if h and h * size < 1 - STEP_ROUNDING:
        how = f"h |M^-1 (theta A + gamma K)| <= {h * size:.3g} < 1 over states and parameters together (interval arithmetic)."
        value = {"h": h, "h* is at least": 1 / size if size > 0 else np.inf}
        found.append(make_finding(F_STEP, HOLDS, how, value, scope=scope))
        found.append(make_finding(F_W, HOLDS, f"By F-step: {how}", {"step lengths": steps.size}, scope=scope))
    return found


def _is_law_never_empty(law: Law, model: FirstOrderSystem, region: Region) -> bool:
    """Whether K has a point for all values of the parameters."""
    if any(depends_on_symbol(block, model.p) and not block.separable for block in law.blocks):
        return False
    widths = ca.vertsplit(law.upper - law.lower) if law.size else []
    moving = [row for row in widths if ca.depends_on(row, model.p)]
    return all(float(interval_bounds.enclose(row, model.p, *region.parameter_bounds())[0].item()) >= 0 for row in moving)


def _step_intervals(steps: np.ndarray) -> list[StepInterval]:
    """Each step length for itself; of many all between the least and the largest at once."""
    return [(float(h), float(h)) for h in steps] if steps.size <= MAX_CORNER_STEPS else [(float(steps.min()), float(steps.max()))]


def _step_limit_by_corners(parts: AffineSystem, h: float) -> Finding | None:
    """F-step by sym(M - s G) > 0, or by a norm of M^-1 G where M is constant."""
    at = matrix_corners([parts.M, parts.G], parts.z, *parts.box((h, h)))
    if at is None:
        return None
    if all(exact.definiteness(M - s * G).definite for M, G in at for s in (Fraction(0), Fraction(h))):
        how = (
            f"M and M - h (theta A + gamma K) have positive definite symmetric parts at {len(at)} corners of their hull (exact)."
        )
        return make_finding(F_STEP, HOLDS, how, {"h": h, "h* is at least": h})
    if ca.symvar(parts.M):
        return None
    solved = [exact.solve_linear_system(M, G) for M, G in at]
    if any(X is None for X in solved):
        return None
    norms = [min(_max_row_sum(X), _max_row_sum(X.T)) for X in solved if X is not None]
    if not Fraction(h) * max(norms) < 1:
        return None
    least = exact.round_down(1 / max(norms)) if max(norms) else np.inf
    size = exact.round_up(Fraction(h) * max(norms))
    how = f"h |M^-1 (theta A + gamma K)| <= {size:.3g} < 1 at {len(at)} corners of their hull (exact)."
    return make_finding(F_STEP, HOLDS, how, {"h": h, "h* is at least": least})


def _max_row_sum(X: np.ndarray) -> Fraction:
    return max((sum((abs(entry) for entry in row), Fraction(0)) for row in X), default=Fraction(0))


def _mlcp_findings(model: FirstOrderSystem, parts: AffineSystem, steps: np.ndarray, region: Region) -> list[Finding]:
    """F-mlcp and F-unique from det(W) W_mlcp / det M at each step length."""
    n, m = len(model.names), model.law.size
    if not m:
        none = make_finding(F_MLCP, HOLDS, "There are no multipliers: no complementarity problem has to be solved.", {"rows": 0})
        return [none, make_finding(F_UNIQUE, HOLDS, "A linear system with a regular matrix.", {"solutions": 1})]
    if n > MAX_MLCP_STATES or m > MAX_MLCP_ROWS:
        return []
    W = parts.M - parts.h * parts.G
    adjugate = ca.SX(1) if n == 1 else ca.horzcat(*([ca.vertcat(*(_cofactor(W, i, j) for j in range(n))) for i in range(n)]))
    mlcp = ca.det(parts.M) * (ca.det(W) * parts.D + parts.h * parts.gamma * parts.C @ adjugate @ parts.B)
    intervals = _step_intervals(steps)
    each = [_matrix_kind(mlcp, parts, one) for one in intervals]
    if not all(each):
        return []
    kind = next((name for name in ("positive semidefinite", "a P-matrix", "positive definite") if name in each), "")
    every_step = f" and step lengths from {steps.min():.4g} to {steps.max():.4g}" if len(intervals) < steps.size else ""
    solvable = make_finding(
        F_MLCP, HOLDS, f"W_mlcp is {kind} for all values{every_step} (exact, or by bounds).", {"step lengths": steps.size}
    )
    boxes = model.law.is_box
    if "positive semidefinite" in each or ("a P-matrix" in each and not boxes):
        return [solvable]
    if depends_on_symbol(model.law, model.p) and not _is_law_never_empty(model.law, model, region):
        return [solvable]
    try:
        domains.domains_of_law(model.law.at_rest(model.p), np.zeros((m, m)))
    except domains.EmptyDomain:
        return [solvable]
    why = (
        "W_mlcp is positive definite for all values"
        if boxes is False or kind != "a P-matrix"
        else "K is a box, and W_mlcp a P-matrix for all values"
    )
    return [solvable, make_finding(F_UNIQUE, HOLDS, f"{why}{every_step}.", {"solutions": 1})]


def _cofactor(W: ca.SX, i: int, j: int) -> ca.SX:
    rest = [[k for k in range(W.shape[0]) if k != own] for own in (i, j)]
    return (-1) ** (i + j) * ca.det(W[rest[0], rest[1]])


def _matrix_kind(mlcp: ca.SX, parts: AffineSystem, steps: StepInterval) -> str:
    """What the matrix is for all values; '' where it is not known."""
    low, high = parts.box(steps)
    at = matrix_corners([mlcp], parts.z, low, high)
    if at is not None and all(exact.is_psd(S) for (S,) in at):
        return "positive definite" if all(exact.definiteness(S).definite for (S,) in at) else "positive semidefinite"
    if extremum.largest_eigenvalue(-(mlcp + mlcp.T), parts.z, low, high, bound_to=0.0).bound < 0:
        return "positive definite"
    rows = range(mlcp.shape[0])
    sets = [own for size in range(1, len(rows) + 1) for own in combinations(rows, size)]
    minors = (ca.det(mlcp[list(own), list(own)]) for own in sets)
    positive = all(extremum.supremum(-minor, parts.z, low, high, bound_to=0.0).bound < 0 for minor in minors)
    return "a P-matrix" if positive else ""


DRIVEN_FIELDS = {"f": ("f",), "g": ("g",), "h": ("h",), "law": ("law",)}
F_INPUTS = Hypothesis(
    "F-inputs", "h and g are Lipschitz in t along the inputs, at each x and l: no jump of one moves what a row holds",
    "definition of a solution: x is absolutely continuous",
)  # fmt: skip
STEP_DEPENDENT_IDS = (F_MLCP.id, F_UNIQUE.id)
SHORTER_STEPS_TEXT = "Steps that end at an edge of an input may be shorter than the one looked at."
# Of multipliers that neither K nor a run bounds: some values have to be looked at, and the finding says which.
DEFAULT_RANGE = 1.0
INPUT_JUMP_SAMPLES = 64  # Where a jump of h or g is looked for, at the edges of inputs: at nearly any point each of them shows.


def freeze_law(model: FirstOrderSystem) -> FirstOrderSystem:
    """The system with what moves of its law in g and h: l = c + s l' with l' in a set that stays."""
    l = _moving_multipliers(model)
    if l is None:
        return model
    g, h = ca.substitute([model.g, model.h], [model.lam], [l])
    other = copy(model)
    other._set(g=g, h=h, law=model.law.at_rest(ca.vertcat(model.t, model.u)), lam0=ca.SX.zeros(model.lam.numel()))
    return other


def run_of_frozen_law(model: FirstOrderSystem, run: Trajectory) -> Trajectory:
    """A run of the system with l' = (l - c)/s in place of its multipliers; 0 where s = 0."""
    l = _moving_multipliers(model)
    if l is None or "multipliers" not in run.arrays:
        return run
    s, c = ca.diag(ca.jacobian(l, model.lam)), ca.substitute(l, model.lam, ca.SX.zeros(model.lam.numel()))
    f = ca.Function("l", [model.t, model.u, model.lam], [ca.if_else(s == 0, 0, (model.lam - c) / s)])
    inputs = run.arrays.get("inputs", np.zeros((len(run.t), 0)))
    other = np.array(f.map(len(run.t))(run.t[None], inputs.T, run.multipliers.T)).T
    return replace(run, arrays={**run.arrays, "multipliers": other})


def _moving_multipliers(model: FirstOrderSystem) -> ca.SX | None:
    """c + s l' with the symbols of l for l'; None where the law stays."""
    driven, parts = ca.vertcat(model.t, model.u), [ca.SX(0, 1)]
    for rows, block in model.law.parts():
        l = model.lam[rows.start : rows.stop]
        names = model.multiplier_names[rows]
        other = block.rewritten(ca.SX.sym("y", block.size), names, driven, guarded=False) if any(block.moves(driven)) else None
        parts.append(l if other is None else ca.substitute(other.multipliers, other.l, l))
    return ca.vertcat(*parts) if any(model.law.moves(driven)) else None


def parametric_model_and_region(
    model: FirstOrderSystem, region: Region, runs: Sequence[Trajectory]
) -> tuple[FirstOrderSystem, Region]:  # fmt: skip
    """The system whose inputs are parameters, with the step lengths of the runs: those between edges."""
    other = copy(model)
    if runs:
        other._set(steps=step_lengths(model, runs), step=None)
    return other, region


def driven_findings(
    model: FirstOrderSystem, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory], quick: bool
) -> list[Finding]:  # fmt: skip
    """Those at each value of the inputs, and F-inputs where one stands in h or g; see the inclusions' module of this name."""
    if runs and any(item.verdict in (SAMPLED, UNKNOWN) for item in own):
        own = keep_proofs(own, uniform_findings(model, region, quick))
    if not runs:
        own = [replace(item, how=f"{item.how} {SHORTER_STEPS_TEXT}") if item.id in STEP_DEPENDENT_IDS else item for item in own]
    return (
        [*own, _input_rate_finding(model, region, motion, runs, quick)] if motion.indices_read_by(model.h, model.g) else list(own)
    )


def _input_rate_finding(
    model: FirstOrderSystem, region: Region, motion: InputBounds, runs: Sequence[Trajectory], quick: bool
) -> Finding:  # fmt: skip
    at = linearise_system(model, region, runs)
    low = np.where(np.isfinite(at.lower), at.lower, np.minimum(-DEFAULT_RANGE, at.upper))
    high = np.where(np.isfinite(at.upper), at.upper, np.maximum(DEFAULT_RANGE, low))
    loose = motion.jumping_indices(model.h, model.g)
    if loose:
        points = extremum.samples(low, high, INPUT_JUMP_SAMPLES)[:, 1:]
        jumped = _output_jump(model, region.parameters, motion.edges(loose, region), points)
        return jumped or make_finding(F_INPUTS, UNKNOWN, missing_rate_reason(motion, loose))
    (p_low, p_high), (slowest, fastest) = region.parameter_bounds(), motion.rates
    z = ca.vertcat(at.z, model.p, motion.v)
    ends = np.concatenate([low, p_low, slowest]), np.concatenate([high, p_high, fastest])
    rates = {name: motion.velocity(part, model.t) for name, part in (("h", model.h), ("g", model.g))}
    if not interval_bounds.is_continuous(ca.vertcat(model.h, model.g, *rates.values()), z, *ends):
        return make_finding(F_INPUTS, UNKNOWN, "h and g are not seen to be continuous along the inputs")
    tops = {name: extremum.supremum(ca.sumsqr(rate), z, *ends, quick=quick).bound for name, rate in rates.items()}
    value = {f"|{name}'| at most": float(np.sqrt(max(top, 0.0))) * ROUND_UP_FACTOR for name, top in tops.items()}
    if not np.isfinite(list(value.values())).all():
        return make_finding(F_INPUTS, UNKNOWN, "no bound was found of how fast h and g move with the inputs")
    box = {name: (float(a), float(b)) for name, a, b in zip(at.names[1:], low[1:], high[1:], strict=True)}
    scope = Scope(box, (float(low[0]), float(high[0])), region.parameters)
    return make_finding(F_INPUTS, HOLDS, "bounds of |h_t + h_u u'| and of |g_t + g_u u'|", value, scope=scope)


def _output_jump(model: FirstOrderSystem, box: IntervalBox, edges: Sequence[InputJump], points: np.ndarray) -> Finding | None:
    """An edge at which a row of h or g provably jumps, the one that does so the most, at the start or another point (x, l)."""
    rows, n, m = ca.vertcat(model.h, model.g), len(model.names), model.h.numel()
    z = ca.vertcat(model.x, model.lam, model.t, model.p)
    middle = ca.DM([low + (high - low) / 2 for low, high in box.values()])
    start = np.array(ca.DM(ca.substitute(ca.vertcat(model.x0, model.lam0), model.p, middle))).ravel()
    for edge in edges:
        for point in (start, *points):
            (a, b), (c, d) = (interval_bounds.enclose(rows, z, one, one) for one in edge.at(point))
            gap = np.maximum(c - b, a - d).ravel()
            i = int(np.argmax(gap))
            if not gap[i] > 0:
                continue
            row = f"h[{i}]" if i < m else f"g[{i - m}]"
            how = f"{edge.text}, and {row} with it"
            if i < m and not ca.depends_on(model.h[i], model.lam):
                how += "; this row has no l: a state that it holds may have to jump"
            witness = {**edge.witness, "row": row, "x": point[:n], "l": point[n:]}
            return make_finding(F_INPUTS, VIOLATED, how, {"jump": float(gap[i])}, witness)
    return None


def driven_consequences(
    model: FirstOrderSystem, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory]
) -> list[Consequence]:  # fmt: skip
    """What follows of steps; of the order for signals that are smooth between their edges alone."""
    moved = [finding.id for finding in own if finding.id == F_INPUTS.id]
    read = motion.indices_read_by(model.f, model.g, model.h)
    made = []
    for item in uniform_consequences(model, region, own):
        if item.name == "order":
            ids = [*item.rests_on, *moved]
            item = make_consequence(item.name, item.statement, own, ids, item.source, item.value)
            item = scheme_limit_consequence(item, motion, read, smooth=True)
        made.append(item)
    return made


def stay_times(
    model: FirstOrderSystem, region: Region, findings: Sequence[Finding], start: tuple[np.ndarray, np.ndarray]
) -> list[StayTime]:
    """By the rates of x' = M^-1 (f + g), l anywhere in K, over all parameters."""
    hull, (low, high) = multiplier_hull(model.law, model.p, *region.parameter_bounds()), region.parameter_bounds()
    if hull is None or len(model.names) > MAX_INVERSE_STATES:
        return []
    rate = ca.inv(ca.densify(model.M)) @ (model.f + model.g)
    others = ca.vertcat(model.t, model.lam, model.p)
    ends = tuple(np.concatenate([[time], l, p]) for time, l, p in ((region.t0, hull[0], low), (region.t1, hull[1], high)))
    until = stay_by_rates(rate, model.x, others, (ends[0], ends[1]), region, start)
    until = min(until, region.t1) if ca.depends_on(rate, model.t) else until
    return [StayTime(until, "by bounds of x' between nested boxes")]
