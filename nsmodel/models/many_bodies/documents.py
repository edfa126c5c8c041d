"""Certificates of many bodies: those of the sweeping process that they are, written out.

The class in LaTeX.
"""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.hypotheses.certificates.hints import UnprovedFinding, exact_number_text
from nsmodel.hypotheses.certificates.write import CertificateParts, CertificateSubject
from nsmodel.hypotheses.equations import entry_formulas, function_call_latex, space_latex, vector_lines
from nsmodel.hypotheses.findings import Finding, IntervalBox
from nsmodel.hypotheses.latex import SymbolNames, symbol_latex, text_latex
from nsmodel.models.many_bodies.families import Bodies, GroupMember
from nsmodel.models.many_bodies.model import ManyBodies
from nsmodel.models.sweeping_process import documents as sweeping
from nsmodel.models.sweeping_process.documents import ConstraintRow
from nsmodel.models.sweeping_process.model import SweepingProcess

# Constraints of families that are written down one by one in certificates; of more these say not checkable.
MAX_WRITTEN_CONSTRAINTS = 400
STATED = sweeping.STATED


def subject(model: ManyBodies, findings: Mapping[str, Finding], ranges: IntervalBox) -> CertificateSubject:
    """The sweeping process as data; of many constraints as families."""
    states, d = [str(symbol) for symbol in ca.vertsplit(model.q)], model.bodies.d
    stands_for = {str(symbol): states[axis::d] for axis, symbol in enumerate(ca.vertsplit(model.me.q))}
    if is_small(model):
        return sweeping.subject(model.written_out(), findings, ranges)._replace(stands_for=stands_for)
    f = {"inputs": ["t", *states, *ranges], "why": "the velocities of many bodies are not written down"}
    data = {
        "class": "SweepingProcess", "constraints": sweeping.rows_data(family_rows(model, ranges), findings), "f": f,
        "q0": [exact_number_text(x) for x in model.q0],
    }  # fmt: skip
    return CertificateSubject(model, data, ranges=ranges, stands_for=stands_for)


def is_small(model: ManyBodies) -> bool:
    """Whether its constraints are written down one by one."""
    return isinstance(model.f, ca.SX) and sum(family.count for family in model.constraints.values()) <= MAX_WRITTEN_CONSTRAINTS


def proofs(
    subject: CertificateSubject, finding: Finding, findings: Mapping[str, Finding], value: dict[str, str], room: Fraction
) -> list[Any]:
    """Hints: as of a sweeping process, of families once for all members."""
    if isinstance(subject.model, SweepingProcess):
        return sweeping.proofs(subject, finding, findings, value, room)
    if finding.id in ("A5", "A5'", "S-f"):
        raise UnprovedFinding(
            f"more than {MAX_WRITTEN_CONSTRAINTS} constraints of families, or velocities that are not written down"
        )
    if finding.id == "S-start":
        return [{}]
    return [sweeping.constraint_hints(subject, family_rows(subject.model, subject.ranges), finding)]


def family_rows(model: ManyBodies, ranges: IntervalBox) -> list[ConstraintRow]:
    """The families, a row for each thing around the bodies, whose numbers are then exact."""
    d, states, (_, slow_names, ends) = model.bodies.d, ca.vertsplit(model.q), sweeping.slow_inputs(model, ranges)
    found = []
    for name, family in model.constraints.items():
        moving = family.moving
        q, pairs = ca.vertcat(*(member.q for member in moving)), family.pairs
        own = [
            (k, column, symbol) for k, member in enumerate(moving) for column, symbol in enumerate(ca.vertsplit(member.symbols))
            if column >= d and ca.depends_on(family.g, symbol)
        ]  # fmt: skip
        items = family.second if family.second is not None and not family.of_pairs else None
        for item in [None] if items is None else sorted(set(pairs[:, 1].tolist())):
            chosen = pairs if item is None else pairs[pairs[:, 1] == item]
            numbers = np.array([model.bodies.table[chosen[:, k], column] for k, column, _ in own]).reshape(len(own), len(chosen))
            bodies = chosen[:, : len(moving)].tolist()
            members = [
                ([str(states[i * d + axis]) for i in one for axis in range(d)], numbers[:, row].tolist())
                for row, one in enumerate(bodies)
            ]
            exact = (
                {}
                if items is None or item is None
                else dict(zip(ca.vertsplit(items.symbols), items.group.table[item].tolist(), strict=True))
            )
            found.append(
                ConstraintRow(
                    name if item is None else f"{name} {item}", family.g, q, [str(symbol) for symbol in ca.vertsplit(q)],
                    ca.vertcat(model.t, *(symbol for *_, symbol in own), model.p),
                    [slow_names[0], *(str(symbol) for *_, symbol in own), *slow_names[1:]],
                    np.concatenate([ends[0][:1], numbers.min(axis=1), ends[0][1:]]),
                    np.concatenate([ends[1][:1], numbers.max(axis=1), ends[1][1:]]),
                    exact, members,
                )
            )  # fmt: skip
    return found


def equations(model: ManyBodies) -> list[str]:
    """The equation of one body, and of each family the constraint of any of its members."""
    n, d = model.bodies.q0.shape
    timed = any(ca.depends_on(family.g, model.t) for family in model.constraints.values())
    Q, i = "Q(t)" if timed else "Q", model.me.name
    f = (
        function_call_latex("f", model.f, model, _member_names(model.me), f"q_{i}")
        if isinstance(model.f, ca.SX)
        else f"f_{i}(t, q)"
    )
    lines = [rf"\dot{{q}}_{i} + N_{{{Q}}}(q)_{i} \ni {f},\quad {i} = 0, \ldots, {n - 1},\quad q_{i} \in {space_latex(d)}"]
    lines += vector_lines(f, model.f, _member_names(model.me)) if isinstance(model.f, ca.SX) else []
    rows = []
    for name, family in model.constraints.items():
        members = [member for member in (family.first, family.second) if member is not None]
        states = [f"q_{member.name}" for member in members if isinstance(member.group, Bodies)]
        left = function_call_latex(rf"g_{{{text_latex(name)}}}", family.g, model, _member_names(*members), *states)
        text = entry_formulas(ca.SX(family.g), _member_names(*members))[0]
        rows.append(rf"{left} = {text} \geq 0 \quad {text_latex(f'({family.count} constraints)')}")
    lines.append(rf"{Q} = \left\{{ q : g \geq 0 \right\}}" if rows else rf"{Q} = {space_latex(n * d)}")
    return [*lines, *rows]


def _member_names(*members: GroupMember) -> SymbolNames:
    """The state and the numbers of each member with its name as an index."""
    latex_names = {}
    for member in members:
        for key in member.group.numbers:
            own = [symbol.name() for symbol in ca.vertsplit(getattr(member, key))]
            latex_names |= {name: symbol_latex("_".join([key, member.name, *name.split("_")[1:]])) for name in own}
    return SymbolNames(latex_names, {})


CERTIFICATE = CertificateParts(stated=STATED, subject=subject, proofs=proofs)
