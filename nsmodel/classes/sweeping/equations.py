"""The class in LaTeX."""

from __future__ import annotations

import casadi as ca

from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.hypotheses.report.typeset import (
    constraint_lines,
    function_call_latex,
    space_latex,
    start_line,
    state_lines,
    symbol_names,
    vector_lines,
)


def equations(model: SweepingProcess) -> list[str]:
    """The model, one formula a line."""
    names = symbol_names(model)
    t = "t" if ca.depends_on(model.g, model.t) else ""
    Q, f = "Q(t)" if t else "Q", "" if model.f.is_zero() else function_call_latex("f", model.f, model, names, "q")
    p = model.g.numel()
    lines = [rf"\dot{{q}} + N_{{{Q}}}(q) \ni {f or '0'}", *state_lines(model)]
    if f:
        lines += vector_lines(f, model.f, names)
    g = "g_i(t, q)" if t else "g_i(q)"
    rows = rf"{g} \geq 0,\ i = 1, \ldots, {p}" if p != 1 else rf"{g.replace('_i', '')} \geq 0"
    lines.append(
        rf"{Q} = \left\{{ q \in {space_latex(len(model.names))} : {rows} \right\}}"
        if p
        else f"Q = {space_latex(len(model.names))}"
    )
    return [*lines, *constraint_lines("g", model.constraints, model, names, "q"), start_line("q(0)", model.q0, names)]
