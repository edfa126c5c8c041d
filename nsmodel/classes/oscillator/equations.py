"""The class in LaTeX."""

from __future__ import annotations

from nsmodel.classes.oscillator.model import FrictionOscillator
from nsmodel.hypotheses.report.notation import text_latex
from nsmodel.hypotheses.report.typeset import (
    MAX_LISTED_ROWS,
    constraint_lines,
    entry_formulas,
    function_call_latex,
    matrix_latex,
    start_line,
    state_lines,
    symbol_names,
    vector_lines,
)


def equations(model: FrictionOscillator) -> list[str]:
    """The model, one formula a line."""
    names = symbol_names(model)
    damping = r" + M \dot{x}" if model.damping is not None else ""
    force = function_call_latex("f", model.force, model, names) if not model.force.is_zero() else ""
    dry = r" + \partial\Phi(\dot{x})" if model.elements else ""
    lines = [
        rf"\ddot{{x}}{dry}{damping} + \partial g(x) \ni {force or 0}",
        *state_lines(model),
        f"g(x) = {entry_formulas(model.potential, names)[0]}",
        *(vector_lines(force, model.force, names) if force else []),
    ]
    plain = len(model.elements) == 1 and model.elements[0].H.is_eye()
    if model.elements:
        labels = ["" if plain else f"_{{{text_latex(element.name)}}}" for element in model.elements]
        s = entry_formulas(model.s, names)[0]
        H = [rf"\theta{a}\left(\left\Vert {'' if plain else f'H{a} '}v \right\Vert\right)" for a in labels[:MAX_LISTED_ROWS]]
        more = r" + \cdots" if len(labels) > MAX_LISTED_ROWS else ""
        lines.append(r"\Phi(v) = " + " + ".join(H) + more)
        for element, a in list(zip(model.elements, labels, strict=True))[:MAX_LISTED_ROWS]:
            matrix = "" if plain else rf",\quad H{a} = {matrix_latex(element.H, names)}"
            lines.append(rf"\theta{a}({s}) = {entry_formulas(element.theta, names)[0]}{matrix}")
    if model.damping is not None:
        lines.append(f"M = {matrix_latex(model.damping, names)}")
    if model.constraints:
        lines.append(r"\mathrm{dom}\ g = \left\{ x : c_i(x) \geq 0 \right\}")
        lines += constraint_lines("c", model.constraints, model, names, "x")
    pair = [start_line("x_0", model.x0, names), start_line("x_1", model.x1, names)] if model.x1 is not None else None
    pair = pair or [start_line("x(0)", model.x0, names), start_line(r"\dot{x}(0)", model.v0, names)]
    return [*lines, r",\quad ".join(pair)]
