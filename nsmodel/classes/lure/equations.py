"""The class in LaTeX."""

from __future__ import annotations

import casadi as ca

from nsmodel.classes.lure.model import LureSystem
from nsmodel.hypotheses.report.typeset import (
    call,
    law_latex,
    matrix_latex,
    names_of,
    start_line,
    state_lines,
    texts,
    vector_lines,
)


def equations(model: LureSystem) -> list[str]:
    """The model, one formula a line."""
    names = names_of(model)
    jacobian = ca.jacobian(model.A, model.x)
    linear = not ca.depends_on(jacobian, model.x)
    A = r"A\,x" if linear else "A(x)"
    f = "" if model.f.is_zero() else call("f", model.f, model, names)
    D = "" if model.D.is_zero() else r" + D\,\lambda"
    relation = r"-y \in N_K(\lambda)" if model.law is not None else r"\lambda \in -\partial\Phi(y)"
    lines = [rf"\dot{{x}} = {A} + B\,\lambda{f' + {f}' if f else ''},\quad y = C\,x{D},\quad {relation}", *state_lines(model)]
    lines += [f"A = {matrix_latex(jacobian, names)}"] if linear else vector_lines("A(x)", model.A, names)
    lines.append(rf"B = {matrix_latex(model.B, names)},\quad C = {matrix_latex(model.C, names)}")
    lines += [f"D = {matrix_latex(model.D, names)}"] if D else []
    lines += vector_lines(f, model.f, names) if f else []
    lines.append(law_latex(model.law) if model.law is not None else rf"\Phi(y) = {texts(model.phi, names)[0]}")
    return [*lines, start_line("x(0)", model.x0, names)]
