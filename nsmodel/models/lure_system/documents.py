"""Certificates of Lur'e systems: matrices, the law, P, points in ranges.

The class in LaTeX.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.hypotheses.certificates import verify
from nsmodel.hypotheses.certificates.hints import ROUND_DOWN, StatedNumber, UnprovedFinding, cover_hint, exact_number_text
from nsmodel.hypotheses.certificates.write import (
    CertificateParts,
    CertificateSubject,
    column_text,
    dense_matrix_text,
    entry_text,
    expression_program,
    law_data,
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
from nsmodel.models.lure_system.model import LureSystem
from nsmodel.proof import conic, exact

STATED = {"4.1": (StatedNumber("least eigenvalue", ROUND_DOWN, "least"),), "5.2": (StatedNumber("omega"),)}


def subject(model: LureSystem, findings: Mapping[str, Finding], ranges: IntervalBox) -> CertificateSubject:
    """The model as data."""
    names = [f"y_{i}" for i in range(model.D.shape[0])]
    if model.law is not None:
        law = law_data(model, model.law, ranges)
    else:
        law = [{"kind": "potential", "graph": expression_program(model, model.phi, model.y, names)}]
    data = {
        "A": expression_program(model, model.A, model.x, model.names),
        **{name: dense_matrix_text(model, getattr(model, name)) for name in "BCD"},
        "f": expression_program(model, model.f, model.t, ["t"]), "x0": column_text(model, model.x0),
        "law": law,
    }  # fmt: skip
    e = (
        {}
        if model.e.is_zero()
        else {"e": expression_program(model, model.e, model.t, ["t"]) if _offset_moves(model) else column_text(model, model.e)}
    )
    return CertificateSubject(model, data | e, ranges=ranges)


def _offset_moves(model: LureSystem) -> bool:
    return bool(ca.depends_on(model.e, model.t))


def proofs(
    subject: CertificateSubject, finding: Finding, findings: Mapping[str, Finding], value: dict[str, str], room: Fraction
) -> list[Any]:
    """Hints: P, a cover where A is not linear, points in ranges."""
    return [_proof_hint(subject, finding)]


def _proof_hint(subject: CertificateSubject, finding: Finding) -> Any:
    model: LureSystem = subject.model
    if finding.id in ("5.1", "5.2"):
        name = "P" if finding.id == "5.1" else "P_omega"
        P = finding.witness.get(f"{name} exactly") or finding.witness.get(name)
        if P is None and subject.ranges:
            return _diagonal_energy_hint(subject) | cover_hint(model.A, model.x)
        if P is None:
            raise UnprovedFinding("too large a P to write down")
        P = [[entry if isinstance(entry, str) else exact_number_text(entry) for entry in row] for row in P]
        return {"P": P} | cover_hint(model.A, model.x)
    if finding.id in ("5.4a", "5.4c", "5.x0", "7.1") and not _verifier_range_is_whole(subject):
        _check_constant_boxes(model, finding.id)
        return _point_in_range(
            model, None if finding.id in ("5.4a", "5.4c") else np.array(ca.DM(model.x0)).ravel() * (finding.id == "5.x0")
        )
    return {}


def _diagonal_energy_hint(subject: CertificateSubject) -> dict[str, Any]:
    """d P, a diagonal of functions of the parameters, and d: P(p) B(p) = C(p)' row by row, and from row to row by A."""
    model: LureSystem = subject.model
    A, B, C = ca.densify(ca.jacobian(model.A, model.x)), ca.densify(model.B), ca.densify(model.C)
    n, parts = model.x.numel(), {}
    for i in range(n):
        j = next((j for j in range(B.shape[1]) if not B[i, j].is_zero()), None)
        if j is not None:
            parts[i] = C[j, i], B[i, j]
    while len(parts) < n:
        links = ((i, k) for i in parts for k in range(n) if k not in parts and not (A[i, k].is_zero() or A[k, i].is_zero()))
        i, k = next(links, (None, next(k for k in range(n) if k not in parts)))
        parts[k] = (ca.SX(1), ca.SX(1)) if i is None else (-parts[i][0] * A[i, k], parts[i][1] * A[k, i])
    if any(ca.depends_on(ca.vertcat(*pair), model.x) for pair in parts.values()):
        raise UnprovedFinding("no diagonal P that is free of the states")
    bottoms = {k: bottom for k, (_, bottom) in parts.items() if ca.symvar(bottom)}
    scaled = [
        top * product_of([*(one for k, one in bottoms.items() if k != i)]) / (1 if i in bottoms else bottom)
        for i, (top, bottom) in ((i, parts[i]) for i in range(n))
    ]
    d = product_of([*bottoms.values()])
    at = ca.DM([(low + high) / 2 for low, high in subject.ranges.values()])
    sign = float(np.sign(float(ca.Function("d", [model.p], [d])(at))))
    zero = ca.SX(0)
    P = [[entry_text(model, sign * scaled[i] if i == k else zero) for k in range(n)] for i in range(n)]
    return {"P": P, "d": entry_text(model, sign * d)}


def product_of(factors: Sequence[ca.SX]) -> ca.SX:
    """The product of expressions."""
    return math.prod(factors, start=ca.SX(1))


def _verifier_range_is_whole(subject: CertificateSubject) -> bool:
    with suppress(verify.Unproved):
        read = verify.LureData(subject.data, subject.parameters)
        return read.is_wide()
    return False


def _check_constant_boxes(model: LureSystem, id: str) -> None:
    if _offset_moves(model):
        raise UnprovedFinding("an offset e that moves with time")
    parts = (model.C, model.D, model.e, model.x0 if id == "5.x0" else ca.SX(0))
    if any(ca.depends_on(ca.vec(part), model.p) for part in parts):
        raise UnprovedFinding("a point that moves with parameters")
    if model.law is None or not model.law.is_box:
        raise UnprovedFinding("a law that is no box")


def _point_in_range(model: LureSystem, x: np.ndarray | None) -> Any:
    """x, v and k, inside, with C x + e = D'k + y + S v, y inside, of a law of boxes.

    Columns of the homogeneous system: tau > 0, l - low tau > 0 (or high tau - l), where both ends are finite also their sum,
    y > 0 or < 0 where one end is, v, and x where it is not given.
    """
    m, n = model.D.shape[0], model.x.numel()
    C, D = (exact.rational(np.array(ca.DM(part)).reshape(part.shape)) for part in (model.C, model.D))
    low, high = (np.concatenate(ends) for ends in zip(*(block.bounding_box() for block in model.law.blocks), strict=True))
    bounded = np.isfinite(low) & np.isfinite(high)
    S, I = D + D.T, exact.eye(m)
    A = exact.zeros(m + int(bounded.sum()), 1 + 3 * m + m + (n if x is None else 0))
    positive, k = [0], []
    for i in range(m):
        sign = Fraction(1 if np.isfinite(low[i]) else -1)
        base = Fraction(low[i]) if np.isfinite(low[i]) else Fraction(high[i]) if np.isfinite(high[i]) else Fraction(0)
        k.append((base, sign))
        A[:m, 0] -= base * D[i]
        A[:m, 1 + i] = -sign * D[i]
        if np.isfinite([low[i], high[i]]).any():
            positive.append(1 + i)
        if bounded[i]:
            row = m + int(bounded[:i].sum())
            A[row, 1 + i], A[row, 1 + m + i], A[row, 0] = Fraction(1), Fraction(1), -Fraction(high[i] - low[i])
            positive.append(1 + m + i)
        if np.isfinite([low[i], high[i]]).any():
            A[:m, 1 + 2 * m + i] = -I[i] * sign
            positive += [] if bounded[i] else [1 + 2 * m + i]
    A[:m, 1 + 3 * m : 1 + 4 * m] = -S
    A[:m, 0] += exact.rational(np.array(ca.DM(model.e))).ravel()
    if x is None:
        A[:m, 1 + 4 * m :] = C
    else:
        A[:m, 0] += exact.matrix_product(C, exact.rational(x)[:, None]).ravel()
    found = conic.decide_feasibility(conic.ConicSystem(A, tuple(positive))).point
    if found is None:
        raise UnprovedFinding("no point was found")
    found = found / found[0]
    return {
        "x": [exact_number_text(entry) for entry in (found[1 + 4 * m :] if x is None else exact.rational(x))],
        "k": [exact_number_text(base + sign * found[1 + i]) for i, (base, sign) in enumerate(k)],
        "v": [exact_number_text(entry) for entry in found[1 + 3 * m : 1 + 4 * m]],
    }


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


CERTIFICATE = CertificateParts(stated=STATED, subject=subject, proofs=proofs)
