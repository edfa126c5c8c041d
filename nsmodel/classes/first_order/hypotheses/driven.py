"""First-order systems with inputs: what is said of a step holds at each value; what is held moves with u in h and g."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import casadi as ca
import numpy as np

from nsmodel.classes.first_order.hypotheses import for_all
from nsmodel.classes.first_order.hypotheses.check import F_MLCP, F_UNIQUE
from nsmodel.classes.first_order.hypotheses.linearised import linearise_system, step_lengths
from nsmodel.classes.first_order.model import FirstOrderSystem
from nsmodel.hypotheses.findings import HOLDS, UNKNOWN, VIOLATED, Consequence, Finding, Hypothesis, make_consequence, make_finding
from nsmodel.hypotheses.inputs import InputBounds, InputJump, missing_rate_reason, scheme_limit_consequence
from nsmodel.hypotheses.region import Region
from nsmodel.hypotheses.scope import IntervalBox, Scope
from nsmodel.proof import extremum, interval_bounds
from nsmodel.simulation.trajectory import Trajectory

DRIVEN_FIELDS = {"f": ("f",), "g": ("g",), "h": ("h",), "law": ("law",)}
F_INPUTS = Hypothesis(
    "F-inputs", "h and g are Lipschitz in t along the inputs, at each x and l: no jump of one moves what a row holds",
    "definition of a solution: x is absolutely continuous",
)  # fmt: skip
STEP_DEPENDENT_IDS = (F_MLCP.id, F_UNIQUE.id)
SHORTER_STEPS_TEXT = "Steps that end at an edge of an input may be shorter than the one looked at."
DEFAULT_RANGE = 1.0  # Of multipliers that neither K nor a run bounds.
RATE_ROUND_UP = 1 + 1e-12
INPUT_JUMP_SAMPLES = 64  # Where a jump of h or g is looked for.


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
    value = {f"|{name}'| at most": float(np.sqrt(max(top, 0.0))) * RATE_ROUND_UP for name, top in tops.items()}
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
    del runs
    moved = [finding.id for finding in own if finding.id == F_INPUTS.id]
    read = motion.indices_read_by(model.f, model.g, model.h)
    made = []
    for item in for_all.uniform_consequences(model, region, own):
        if item.name == "order":
            ids = [*item.rests_on, *moved]
            item = make_consequence(item.name, item.statement, own, ids, item.source, item.value)
            item = scheme_limit_consequence(item, motion, read, smooth=True)
        made.append(item)
    return made
