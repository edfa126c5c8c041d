"""Certificates of oscillators: theta, g, dom g; squares, a least point.

The class in LaTeX.
"""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import casadi as ca

from nsmodel.hypotheses.certificates import verify
from nsmodel.hypotheses.certificates.hints import (
    ROUND_DOWN,
    AdaptiveCover,
    StatedNumber,
    UnprovedFinding,
    convexity_hint,
    interior_point_hint,
    nonnegativity_hint,
)
from nsmodel.hypotheses.certificates.write import (
    CertificateParts,
    CertificateSubject,
    column_text,
    dense_matrix_text,
    expression_program,
    step_sizes_text,
)
from nsmodel.hypotheses.equations import (
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
from nsmodel.hypotheses.findings import Finding, IntervalBox
from nsmodel.hypotheses.latex import text_latex
from nsmodel.hypotheses.region import potential_without_domain
from nsmodel.models.friction_oscillator.check import potential_domain
from nsmodel.models.friction_oscillator.model import FrictionOscillator

STATED = {"O-g": (StatedNumber("lower bound of g", ROUND_DOWN),), "O-dry": (StatedNumber("radius of A(0)", ROUND_DOWN),)}


def subject(model: FrictionOscillator, findings: Mapping[str, Finding], ranges: IntervalBox) -> CertificateSubject:
    """The model as data."""
    domain = potential_domain(model)
    data = {
        "theta": [expression_program(model, element.theta, model.s, ["s"]) for element in model.elements],
        "H": [dense_matrix_text(model, ca.SX(element.H)) for element in model.elements],
        "damping": [] if model.damping is None else dense_matrix_text(model, model.damping),
        "g": expression_program(model, potential_without_domain(model.potential, model.x, "potential"), model.x, model.names),
        "C": expression_program(model, ca.vertcat(domain.rows, domain.equalities, -domain.equalities), model.x, model.names),
        "x0": column_text(model, model.x0),
        "steps": step_sizes_text(model),
    }
    return CertificateSubject(model, data, ranges=ranges)


def proofs(
    subject: CertificateSubject, finding: Finding, findings: Mapping[str, Finding], value: dict[str, str], room: Fraction
) -> list[Any]:
    """Hints: covers of theta' and theta''; of g convexity, and squares for a lower bound."""
    if finding.id == "O-theta":
        return [{"theta": [_friction_hint(subject, program) for program in subject.data["theta"]]}]
    if finding.id != "O-g":
        return [{}]
    model: FrictionOscillator = subject.model
    atoms, n = verify.Atoms(), list(range(model.x.numel()))
    (p,) = atoms.read(verify.VerifierProgram(subject.data["g"], None, None, subject.parameters))
    hint = interior_point_hint(subject, finding) | convexity_hint(p, n, atoms)
    bound = nonnegativity_hint(p + -Fraction(value["lower bound of g"]), atoms) if "lower bound of g" in value else None
    if bound is None:
        raise UnprovedFinding("no lower bound of g that is shown by squares")
    return [hint | {"bound": bound}]


def _friction_hint(subject: CertificateSubject, program: Any) -> dict[str, Any]:
    """What shows that one theta is C1 and convex: the rules, else a cover."""
    atoms = verify.Atoms(nonnegative=[0])
    (p,) = atoms.read(verify.VerifierProgram(program, None, None, subject.parameters))
    return {"slope": AdaptiveCover()} | convexity_hint(p, [0], atoms)


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


CERTIFICATE = CertificateParts(stated=STATED, subject=subject, proofs=proofs)
