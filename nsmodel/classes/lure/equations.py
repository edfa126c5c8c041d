"""The class in LaTeX."""

from __future__ import annotations

import casadi as ca

from nsmodel.classes.lure.model import LureSystem
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


def equations(model: LureSystem) -> list[str]:
    """The model, one formula a line."""
    names = symbol_names(model)
    jacobian = ca.jacobian(model.A, model.x)
    linear = not ca.depends_on(jacobian, model.x)
    A = r"A\,x" if linear else "A(x)"
    f = "" if model.f.is_zero() else function_call_latex("f", model.f, model, names)
    D = "" if model.D.is_zero() else r" + D\,\lambda"
    e = "" if model.e.is_zero() else function_call_latex("e", model.e, model, names)
    relation = r"-y \in N_K(\lambda)" if model.law is not None else r"\lambda \in -\partial\Phi(y)"
    rate, output = (rf"{line}{f' + {part}' if part else ''}" for line, part in ((rf"{A} + B\,\lambda", f), (rf"C\,x{D}", e)))
    lines = [rf"\dot{{x}} = {rate},\quad y = {output},\quad {relation}", *state_lines(model)]
    lines += [f"A = {matrix_latex(jacobian, names)}"] if linear else vector_lines("A(x)", model.A, names)
    lines.append(rf"B = {matrix_latex(model.B, names)},\quad C = {matrix_latex(model.C, names)}")
    lines += [f"D = {matrix_latex(model.D, names)}"] if D else []
    lines += [line for name, of in ((f, model.f), (e, model.e)) if name for line in vector_lines(name, of, names)]
    lines.append(law_latex(model.law) if model.law is not None else rf"\Phi(y) = {entry_formulas(model.phi, names)[0]}")
    return [*lines, start_line("x(0)", model.x0, names)]
