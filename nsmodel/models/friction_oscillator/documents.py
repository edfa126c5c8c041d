"""Certificates of oscillators: theta, g, dom g; squares, a least point.

The class in LaTeX.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import minimize

from nsmodel.hypotheses.certificates import verify
from nsmodel.hypotheses.certificates.hints import (
    ROUND_DOWN,
    AdaptiveCover,
    StatedNumber,
    UnprovedFinding,
    convexity_hint,
    corner_hints,
    exact_number_text,
    gram_matrix_hint,
    interior_point_hint,
    nonnegativity_hint,
)
from nsmodel.hypotheses.certificates.write import (
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
from nsmodel.hypotheses.region import box_middle, potential_without_domain
from nsmodel.models.friction_oscillator.check import potential_domain
from nsmodel.models.friction_oscillator.model import FrictionOscillator
from nsmodel.proof import exact

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
    """Hints: squares or covers of theta''; of g convexity, and a lower bound in one of two ways."""
    if finding.id == "O-theta":
        return [{"theta": [_friction_hint(subject, program) for program in subject.data["theta"]]}]
    if finding.id != "O-g":
        return [{}]
    model: FrictionOscillator = subject.model
    atoms, n = verify.Atoms(), list(range(model.x.numel()))
    (p,) = atoms.read(verify.VerifierProgram(subject.data["g"], None, None, subject.parameters))
    hint = interior_point_hint(subject, finding) | convexity_hint(p, n, atoms)
    proofs = []
    if "lower bound of g" in value:
        bound = nonnegativity_hint(p + -Fraction(value["lower bound of g"]), atoms)
        proofs += [] if bound is None else [hint | {"bound": bound}]
    least = min(_least_curvature(q, n, atoms) for q in verify.at_corners(p))
    point, number = _potential_minimum(subject)
    if least > 0 and np.isfinite([*point, number]).all():
        value.setdefault("lower bound of g", exact_number_text(number - 1e-6 * (1 + abs(number))))
        proofs.append(hint | {"mu": exact_number_text(0.99 * least), "least": [exact_number_text(x) for x in point]})
    if not proofs:
        raise UnprovedFinding("no lower bound of g that is shown by squares or by strong convexity")
    return proofs


def _least_curvature(p: verify.Poly, n: Sequence[int], atoms: verify.Atoms) -> float:
    """The least eigenvalue of the Hessian of the quadratic in p; 0 where there is more of the polynomial."""
    H = verify.hessian(verify.Poly({m: a for m, a in p.items() if all(v in n for v, _ in m)}), n, atoms)
    return 0.0 if H is None else float(np.linalg.eigvalsh(exact.doubles(np.array(H, dtype=object)))[0])


def _potential_minimum(subject: CertificateSubject) -> tuple[np.ndarray, float]:
    """Where the potential, without its domain and for parameters in the middle, is least, in floating point."""
    model: FrictionOscillator = subject.model
    model = model.bind(box_middle(subject.ranges)) if subject.ranges else model
    g = potential_without_domain(model.potential, model.x, "potential")
    f = ca.Function("g", [model.x], [g, ca.gradient(g, model.x)])
    found = minimize(
        lambda x: (float(f(x)[0]), np.array(f(x)[1]).ravel()), np.array(ca.DM(model.x0)).ravel(), jac=True, tol=1e-12
    )
    return found.x, float(found.fun)


def _friction_hint(subject: CertificateSubject, program: Any) -> dict[str, Any]:
    """What shows that one theta is convex: squares of the second derivative of what the rules leave, else a cover."""
    atoms = verify.Atoms(nonnegative=[0])
    (p,) = atoms.read(verify.VerifierProgram(program, None, None, subject.parameters))
    pairs = [_bend_squares(q, atoms) for q in verify.at_corners(p)]
    return {"slope": AdaptiveCover()} | ({"cover": AdaptiveCover()} if None in pairs else {"squares": corner_hints(pairs)})


def _bend_squares(p: verify.Poly, atoms: verify.Atoms) -> list[Any] | None:
    rest = verify.leftover(p, atoms)
    polynomial = all(v == 0 for m in rest for v, _ in m)
    return _half_line_squares(verify.slope(verify.slope(rest, 0, atoms), 0, atoms)) if polynomial else None


def _half_line_squares(p: verify.Poly) -> list[Any] | None:
    """Squares a and b with p = a + s b: p(u^2) is a sum of squares in u, whose products of odd powers, by u, are b."""
    doubled = verify.Poly({tuple((v, 2 * n) for v, n in m): a for m, a in p.items()})
    found = gram_matrix_hint(doubled)
    if found is None:
        return None
    pair = []
    for odd in (0, 1):
        own = [k for k, m in enumerate(found["monomials"]) if (m[0][1] if m else 0) % 2 == odd]
        monomials = [[[0, m[0][1] // 2]] if m and m[0][1] > 1 else [] for m in (found["monomials"][k] for k in own)]
        pair.append({"monomials": monomials, "G": [[found["G"][i][j] for j in own] for i in own]})
    return pair


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
