"""The class in LaTeX."""

from __future__ import annotations

from nsmodel.classes.first_order.model import FirstOrderSystem
from nsmodel.hypotheses.report.notation import vector_latex
from nsmodel.hypotheses.report.typeset import (
    entry_formulas,
    function_call_latex,
    law_latex,
    matrix_latex,
    start_line,
    state_lines,
    symbol_names,
    vector_lines,
)


def equations(model: FirstOrderSystem) -> list[str]:
    """The model, one formula a line."""
    names = symbol_names(model)
    left = r"\dot{x}" if model.M.is_eye() else r"M\,\dot{x}"
    f = function_call_latex("f", model.f, model, names, "x")
    start = start_line("x(0)", model.x0, names)
    mass = [] if model.M.is_eye() else [f"M = {matrix_latex(model.M, names)}"]
    if not model.lam.numel():
        return [f"{left} = {f}", *state_lines(model), *vector_lines(f, model.f, names), *mass, start]
    h, g = (
        function_call_latex("h", model.h, model, names, "x", r"\lambda"),
        function_call_latex("g", model.g, model, names, "x", r"\lambda"),
    )
    symbols = vector_latex(entry_formulas(model.lam, names))
    return [
        rf"{left} = {f} + r,\quad y = {h},\quad r = {g},\quad -y \in N_K(\lambda)",
        *state_lines(model),
        *vector_lines(f, model.f, names),
        *vector_lines(h, model.h, names),
        *vector_lines(g, model.g, names),
        *([] if symbols == r"\lambda" else [rf"\lambda = {symbols}"]),
        *mass,
        law_latex(model.law),
        start,
    ]
