"""A mechanical system in LaTeX."""

from __future__ import annotations

import casadi as ca

from nsmodel.hypotheses.equations import (
    SymbolNames,
    constraint_lines,
    entry_formulas,
    function_call_latex,
    matrix_latex,
    start_line,
    state_lines,
    symbol_names,
    vector_lines,
)
from nsmodel.hypotheses.latex import text_latex
from nsmodel.models.mechanical_system.model import ContactTerms, MechanicalSystem, applied_forces


def equations(model: MechanicalSystem) -> list[str]:
    """The model, one formula a line."""
    names = symbol_names(model)
    F = function_call_latex("F", applied_forces(model), model, names, "q", "v")
    moves = r"\dot q = v" if model.kinematics is None else rf"\dot q = {matrix_latex(model.kinematics, names)}\, v"
    contacts = {one.name: one.gap for one in model.contact_rows}
    impulses = r" + G(q)^{\mathrm{T}} \mathrm{d}P" if contacts else ""
    held = r" + J(q)^{\mathrm{T}} \mathrm{d}L" if model.joints else ""
    laws = [
        r"0 \leq u_{\mathrm{N}}^+ + e\, u_{\mathrm{N}}^- \perp P_{\mathrm{N}} \geq 0 \quad\text{where } g = 0"
    ] if contacts else []  # fmt: skip
    if any(one.slip.numel() for one in model.contact_rows):
        laws.append(
            r"\Vert P_{\mathrm{T}} \Vert \leq \mu P_{\mathrm{N}},\quad P_{\mathrm{T}} = -\mu P_{\mathrm{N}}\, "
            r"u_{\mathrm{T}}/\Vert u_{\mathrm{T}} \Vert \text{ where } u_{\mathrm{T}} \neq 0"
        )
    return [
        rf"M(q)\, \mathrm{{d}}v = {F}\, \mathrm{{d}}t{impulses}{held},\quad {moves}",
        *state_lines(model),
        f"M = {matrix_latex(model.M, names)}",
        *vector_lines(F, applied_forces(model), names),
        *constraint_lines("g", contacts, model, names, "q"),
        *laws,
        *(_numbers_line(one, names) for one in model.contact_rows),
        *([rf"{ca_text} = 0" for ca_text in (function_call_latex("c", ca.vertcat(*model.joints.values()), model, names, "q"),)]
          if model.joints else []),
        start_line("(q, v)(0)", model.x0, names),
    ]  # fmt: skip


def _numbers_line(one: ContactTerms, names: SymbolNames) -> str:
    """The coefficients of a contact."""
    given = (
        {"e": one.e}
        | ({r"\mu": one.mu} if one.slip.numel() else {})
        | ({} if one.e_t.is_zero() else {r"e_{\mathrm{T}}": one.e_t})
    )
    texts = [rf"{letter} = {entry_formulas(value, names)[0]}" for letter, value in given.items()]
    return rf"\text{{{text_latex(one.name)}}}:\quad " + r",\quad ".join(texts)
