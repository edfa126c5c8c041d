"""Certificates of first-order systems: f, g, h, inverses at each step.

The class in LaTeX.
"""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.hypotheses.certificates import verify
from nsmodel.hypotheses.certificates.hints import (
    KEEP_EXACT,
    AdaptiveCover,
    StatedNumber,
    UnprovedFinding,
    exact_matrix_text,
    exact_number_text,
)
from nsmodel.hypotheses.certificates.write import (
    CertificateParts,
    CertificateSubject,
    column_text,
    dense_matrix_text,
    entry_text,
    expression_program,
    law_data,
    step_sizes_text,
)
from nsmodel.hypotheses.equations import (
    entry_formulas,
    function_call_latex,
    law_latex,
    matrix_latex,
    start_line,
    state_lines,
    symbol_names,
    vector_lines,
)
from nsmodel.hypotheses.findings import Finding, IntervalBox
from nsmodel.hypotheses.latex import vector_latex
from nsmodel.models.first_order_system.model import FirstOrderSystem
from nsmodel.proof import exact, interval_bounds

STATED = {"F-step": (StatedNumber("h", KEEP_EXACT),), "F-W": (StatedNumber("h", KEEP_EXACT),)}


def subject(model: FirstOrderSystem, findings: Mapping[str, Finding], ranges: IntervalBox) -> CertificateSubject:
    """The model as data; the multipliers lie in K, where it is bounded."""
    z, names = ca.vertcat(model.t, model.x, model.lam), ["t", *(model.names or ()), *model.multiplier_names]
    data = {
        **{name: expression_program(model, getattr(model, name), z, names) for name in "fgh"},
        "M": dense_matrix_text(model, model.M), "theta": exact_number_text(model.theta), "gamma": exact_number_text(model.gamma),
        "x0": column_text(model, model.x0), "steps": sorted(set(step_sizes_text(model)), key=Fraction),
        "law": law_data(model, model.law, ranges),
    }  # fmt: skip
    ends = (model.law.lower, model.law.upper)
    bounds = [interval_bounds.enclose(ca.SX(side), model.p, *np.array([*ranges.values()]).reshape(-1, 2).T) for side in ends]
    box = {
        name: (float(low), float(high))
        for name, low, high in zip(model.multiplier_names, bounds[0][0].ravel(), bounds[1][1].ravel(), strict=True)
        if np.isfinite([low, high]).all()
    }
    return CertificateSubject(model, data, box, ranges)


def proofs(
    subject: CertificateSubject, finding: Finding, findings: Mapping[str, Finding], value: dict[str, str], room: Fraction
) -> list[Any]:
    """Hints: the inverse of M or of W, covers."""
    return [_inverse_hint(subject, finding, value)]


def _inverse_hint(subject: CertificateSubject, finding: Finding, value: dict[str, str]) -> Any:
    model: FirstOrderSystem = subject.model
    if finding.id == "F-jacobians":
        return {"cover": AdaptiveCover()}
    if finding.id in ("F-mlcp", "F-unique"):
        return _mlcp_hint(subject)
    steps = model.steps if model.steps is not None else [model.step]
    value["h"] = exact_number_text(np.max(np.asarray(steps, float)))
    at = ca.DM([(low + high) / 2 for low, high in subject.ranges.values()])
    middle = ca.Function("M", [model.p], [ca.densify(model.M)])(at)
    inverse = exact.inverse_matrix(exact.rational(np.array(middle)))
    if inverse is None:
        raise UnprovedFinding("M is singular")
    return {"R": exact_matrix_text(inverse), "cover": AdaptiveCover()}


def _mlcp_hint(subject: CertificateSubject) -> Any:
    """V and d > 0 with W V = d for the matrix W of each step: its inverse and 1, or functions of the parameters."""
    m, atoms = verify.FirstOrderData(subject.data, subject.parameters), verify.Atoms()
    A, K, _ = (verify.affine(atoms.read(program), range(1, m.n + m.m + 1), atoms)[0] for program in m.programs())
    M, A, K = (np.array([row[: m.n] for row in rows], dtype=object).reshape(m.n, m.n) for rows in (m.M, A, K))
    hints = []
    for h in m.steps:
        W = M + -h * (m.theta * A + m.gamma * K)
        if any(isinstance(entry, verify.Poly) for entry in W.ravel()):
            hints.append(_inverse_over_a_box(subject, float(h)))
            continue
        inverse = exact.inverse_matrix(W)
        if inverse is None:
            raise UnprovedFinding("W is singular")
        hints.append({"V": exact_matrix_text(inverse) if m.n else [], "d": "1"})
    return {"inverses": hints, "time": AdaptiveCover()}


def _inverse_over_a_box(subject: CertificateSubject, h: float) -> Any:
    """The adjugate and the determinant of W, with one sign; where CasADi rounds on the way, they are not accepted."""
    model: FirstOrderSystem = subject.model
    slopes = [weight * ca.jacobian(of, model.x) for weight, of in ((model.theta, model.f), (model.gamma, model.g))]
    W = ca.densify(model.M - h * (slopes[0] + slopes[1]))
    at = ca.DM([(low + high) / 2 for low, high in subject.ranges.values()])
    sign = float(np.sign(float(ca.Function("d", [model.p], [ca.det(W)])(at))))
    return {"V": dense_matrix_text(model, sign * ca.adj(W)), "d": entry_text(model, sign * ca.det(W))}


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


CERTIFICATE = CertificateParts(stated=STATED, subject=subject, proofs=proofs)
