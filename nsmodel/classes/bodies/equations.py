"""The class in LaTeX."""

from __future__ import annotations

import casadi as ca

from nsmodel.classes.bodies.groups import Bodies, Member
from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.hypotheses.report.formula import Names
from nsmodel.hypotheses.report.notation import symbol_latex, words
from nsmodel.hypotheses.report.typeset import call, space, texts, vector_lines


def equations(model: ManyBodies) -> list[str]:
    """The equation of one body, and of each family the constraint of any of its members."""
    n, d = model.bodies.q0.shape
    timed = any(ca.depends_on(family.g, model.t) for family in model.constraints.values())
    Q, i = "Q(t)" if timed else "Q", model.me.name
    f = call("f", model.f, model, _of_members(model.me), f"q_{i}") if isinstance(model.f, ca.SX) else f"f_{i}(t, q)"
    lines = [rf"\dot{{q}}_{i} + N_{{{Q}}}(q)_{i} \ni {f},\quad {i} = 0, \ldots, {n - 1},\quad q_{i} \in {space(d)}"]
    lines += vector_lines(f, model.f, _of_members(model.me)) if isinstance(model.f, ca.SX) else []
    rows = []
    for name, family in model.constraints.items():
        members = [member for member in (family.first, family.second) if member is not None]
        states = [f"q_{member.name}" for member in members if isinstance(member.group, Bodies)]
        left = call(rf"g_{{{words(name)}}}", family.g, model, _of_members(*members), *states)
        text = texts(ca.SX(family.g), _of_members(*members))[0]
        rows.append(rf"{left} = {text} \geq 0 \quad {words(f'({family.count} constraints)')}")
    lines.append(rf"{Q} = \left\{{ q : g \geq 0 \right\}}" if rows else rf"{Q} = {space(n * d)}")
    return [*lines, *rows]


def _of_members(*members: Member) -> Names:
    """The state and the numbers of each member with its name as an index."""
    shown = {}
    for member in members:
        for key in member.group.numbers:
            own = [symbol.name() for symbol in ca.vertsplit(getattr(member, key))]
            shown |= {name: symbol_latex("_".join([key, member.name, *name.split("_")[1:]])) for name in own}
    return Names(shown, {})
