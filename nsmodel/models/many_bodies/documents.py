"""Certificates of many bodies: those of the sweeping process that they are, written out.

The class in LaTeX.
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from nsmodel.hypotheses.certificates.hints import UnprovedFinding
from nsmodel.hypotheses.certificates.write import CertificateSubject
from nsmodel.hypotheses.equations import entry_formulas, function_call_latex, space_latex, vector_lines
from nsmodel.hypotheses.findings import Finding
from nsmodel.hypotheses.latex import SymbolNames, symbol_latex, text_latex
from nsmodel.models.many_bodies.families import Bodies, GroupMember
from nsmodel.models.many_bodies.model import ManyBodies
from nsmodel.models.sweeping_process import documents as sweeping

MAX_WRITTEN_CONSTRAINTS = 400  # Families of more are not written out.
STATED = sweeping.STATED


def subject(model: ManyBodies, findings: Mapping[str, Finding]) -> CertificateSubject:
    """The sweeping process as data."""
    if sum(family.count for family in model.constraints.values()) > MAX_WRITTEN_CONSTRAINTS:
        raise UnprovedFinding(f"more than {MAX_WRITTEN_CONSTRAINTS} constraints of families")
    if not isinstance(model.f, ca.SX):
        raise UnprovedFinding("a velocity that is a function of numbers")
    return sweeping.subject(model.written_out(), findings)


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
