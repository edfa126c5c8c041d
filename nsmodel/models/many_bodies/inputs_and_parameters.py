"""Many bodies with inputs, which stand in f alone: f may be measurable in t, and the constraints do not know of them.

Hypotheses of many bodies for all values of parameters in a box.

Of a family the numbers that g has as a constant added are parameters too, between the least and the largest of its members; all
its members with the same other numbers are then one constraint.

How fast many bodies together move on the box of one: as a sweeping process does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, Consequence, Finding, Scope, intersect_scopes, make_finding
from nsmodel.hypotheses.framework import SpeedBound
from nsmodel.hypotheses.inputs import NO_INPUT_BOUNDS, InputBounds
from nsmodel.hypotheses.region import Region, findings_for_box, unaffected_findings
from nsmodel.models.many_bodies.check import check, known_start_point
from nsmodel.models.many_bodies.model import ManyBodies
from nsmodel.models.many_bodies.representatives import (
    MAX_COMBINATIONS_QUICK,
    MAX_LISTED_MEMBERS,
    additive_numbers,
    member_name,
    number_symbols,
    number_tables,
    state_symbols,
)
from nsmodel.models.many_bodies.velocity import uniform_velocity_answer
from nsmodel.models.sweeping_process.check import (
    A5,
    A5_ACTIVE,
    CONSTRAINT_HYPOTHESES,
    S_F,
    S_START,
    sweeping_consequences,
)
from nsmodel.models.sweeping_process.constraint_bounds import ON_THE_BOX, Constraint
from nsmodel.models.sweeping_process.constraint_shapes import read_shapes
from nsmodel.models.sweeping_process.inputs_and_parameters import (
    parametric_constraint,
    state_for_each_signal,
    sweeping_speed_bound,
    uniform_mfcq,
    uniform_shape_findings,
    velocity_norm_bound,
)
from nsmodel.models.sweeping_process.qualification_bounds import discs_proof, has_aligned_pairs
from nsmodel.proof import interval_bounds
from nsmodel.proof.domain import is_defined_on_box
from nsmodel.simulation.trajectory import Trajectory

READS = {hypothesis.id: ("constraints",) for hypothesis in (*CONSTRAINT_HYPOTHESES, A5, A5_ACTIVE, S_START)} | {
    S_F.id: ("f", "constraints")
}


def uniform_findings(model: ManyBodies, region: Region, quick: bool) -> list[Finding]:
    """What is decided for all values of the parameters, whose boxes are those of ``region``."""
    same = unaffected_findings(check, model, region, quick, READS)
    start = next((item for item in same if item.id == S_START.id), None) or uniform_start_finding(model, region)
    own = [velocity_finding(model, region), start]
    constraints = None if A5.id in {item.id for item in same} else uniform_constraints(model, region)
    if constraints is not None:
        count, d = sum(family.count for family in model.constraints.values()), model.bodies.d
        made, each = uniform_shape_findings(constraints, region, quick, count)
        own += made
        if start is not None and start.verdict == HOLDS and has_aligned_pairs(constraints, d):
            own += uniform_mfcq(constraints, each, region, partial(discs_proof, count=model.bodies.count))
    return findings_for_box((item for item in own if item is None or item.verdict == HOLDS), same, region)


def uniform_constraints(model: ManyBodies, region: Region) -> list[Constraint] | None:
    """What stands for all constraints, for all values of the parameters; None where that is too many."""
    found = []
    for name, family in model.constraints.items():
        if family.count > MAX_LISTED_MEMBERS:
            return None
        numbers, q, pairs = number_symbols(family), state_symbols(family), family.pairs
        table = np.hstack([own[pairs[:, k]] for k, own in enumerate(number_tables(family))])
        s = additive_numbers(family, numbers, model.p)
        c = [k for k in range(numbers.numel()) if k not in s and ca.depends_on(family.g, numbers[k])]
        kinds, which = np.unique(table[:, c], axis=0, return_inverse=True)
        if len(found) + len(kinds) > MAX_COMBINATIONS_QUICK:
            return None
        slow, (low, high) = ca.vertcat(model.t, model.p, numbers[s]), region.parameter_bounds()
        box = np.tile(region.lower, 1 + family.of_pairs), np.tile(region.upper, 1 + family.of_pairs)
        names = [symbol.name() for symbol in ca.vertsplit(q)]
        for k, values in enumerate(kinds if len(pairs) else ()):
            rows = np.flatnonzero(which.ravel() == k)
            g = ca.substitute(ca.SX(family.g), numbers[c], ca.DM(values)) if c else ca.SX(family.g)
            own = table[rows][:, s]
            ends = np.concatenate([[region.t0], low, own.min(axis=0)]), np.concatenate([[region.t1], high, own.max(axis=0)])
            shapes = [*read_shapes(g, q, model.p), *read_shapes(g, q)]
            called = member_name(name, *pairs[rows[0]].tolist())
            found.append(parametric_constraint(called, g, shapes, slow, ends, q, names, box))
    return found


def uniform_start_finding(model: ManyBodies, region: Region) -> Finding | None:
    """S-start: the gaps of all members at the start, by bounds over the parameters; None where that is not proved."""
    q0, (low, high), least = model.bodies.q0, region.parameter_bounds(), np.inf
    present = model.enter <= 0
    for family in model.constraints.values():
        if family.count > MAX_LISTED_MEMBERS:
            return None
        pairs = family.pairs
        pairs = pairs[present[pairs[:, 0]] & (present[pairs[:, 1]] if family.of_pairs else True)]
        known = [q0[pairs[:, 0]], *([q0[pairs[:, 1]]] if family.of_pairs else [])]
        known += [own[pairs[:, k]] for k, own in enumerate(number_tables(family))]
        z = ca.vertcat(state_symbols(family), number_symbols(family), model.t, model.p)
        ends = [np.hstack([*known, np.zeros((len(pairs), 1)), np.tile(p, (len(pairs), 1))]) for p in (low, high)]
        if len(pairs) and not is_defined_on_box(ca.SX(family.g), model.p, z, ends[0].min(axis=0), ends[1].max(axis=0)):
            return None
        if len(pairs):
            least = min(least, float(interval_bounds.enclose(ca.SX(family.g), z, *ends)[0].min()))
    return make_finding(S_START, HOLDS, "bounds of g_i(0, q_0)", {"min g": least}) if least >= 0 else None


def velocity_finding(model: ManyBodies, region: Region, motion: InputBounds = NO_INPUT_BOUNDS) -> Finding | None:
    """S-f for all values; None where it is not proved."""
    answer = uniform_velocity_answer(model, region, motion)
    if answer is None:
        return None
    scope = region.scope(answer.where == ON_THE_BOX, bool(ca.depends_on(model.f, model.t)))
    return make_finding(S_F, answer.verdict, answer.how, answer.value, scope=scope)


def uniform_consequences(model: ManyBodies, region: Region, own: Sequence[Finding]) -> list[Consequence]:
    """What follows for all values of the parameters; nothing where gamma is not known."""
    known = {finding.id: finding.value for finding in own}
    if not all("gamma" in known[id] for id in (A5.id, A5_ACTIVE.id)):
        return []
    start = next(finding for finding in own if finding.id == S_START.id)
    count = sum(family.count for family in model.constraints.values())
    return sweeping_consequences(model, own, (), count, known_start_point(model, region, start))


DRIVEN_FIELDS = {"f": ("f",)}


def driven_findings(
    model: ManyBodies, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory], quick: bool
) -> list[Finding]:  # fmt: skip
    """Those at each value of the inputs, and S-f with the L_t of their rates; see the inclusions' module of this name."""
    made = velocity_finding(model, region, motion)
    if made is None:
        return list(own)
    made = replace(made, scope=intersect_scopes(made.scope, Scope(parameters=region.parameters)))
    return [made if finding.id == S_F.id else finding for finding in own]


def driven_consequences(
    model: ManyBodies, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory]
) -> list[Consequence]:  # fmt: skip
    """What follows for each signal."""
    return state_for_each_signal(uniform_consequences(model, region, own))


def speed_bound(
    model: ManyBodies, region: Region, findings: Sequence[Finding], known: Mapping[str, Consequence], h: float
) -> SpeedBound | None:  # fmt: skip
    """The pace on the box; None where it has no bound, as of a function of numbers."""
    if not isinstance(model.f, ca.SX):
        return None
    numbers, table = model.me.symbols[model.bodies.d :], model.bodies.table[:, model.bodies.d :]
    z = ca.vertcat(model.t, model.me.q, numbers, model.p)
    (start, end), (low, high) = region.bounds_with_time(), region.parameter_bounds()
    ends = np.concatenate([start, table.min(axis=0), low]), np.concatenate([end, table.max(axis=0), high])
    top = velocity_norm_bound(model.f, z, *ends, model.bodies.count)
    return sweeping_speed_bound(top, findings, known["K_L"], h) if "K_L" in known else None
