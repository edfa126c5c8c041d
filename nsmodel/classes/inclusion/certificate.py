"""Certificates of inclusions: F, S or Phi, C; covers and squares."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import casadi as ca

from nsmodel.certificate import verify
from nsmodel.certificate.data import CertificateSubject, Data, column_text, expression_program
from nsmodel.certificate.hints import (
    ROUND_DOWN,
    AdaptiveCover,
    StatedNumber,
    UnprovedFinding,
    convexity_hint,
    cover_hint,
    interior_point_hint,
    nonnegativity_hint,
)
from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.inclusion.set_valued import set_constraints
from nsmodel.hypotheses.domain import potential_without_domain
from nsmodel.hypotheses.findings import Finding

STATED = {
    "M-A2": (StatedNumber("a_1"), StatedNumber("a_2")), "M-A3": (StatedNumber("alpha", ROUND_DOWN), StatedNumber("beta")),
    "M-24": (StatedNumber("L"),),
}  # fmt: skip


def subject(model: MonotoneInclusion, findings: Mapping[str, Finding]) -> CertificateSubject:
    """The model as data."""
    rows, _ = set_constraints(model)
    phi = (
        None
        if model.phi is None
        else expression_program(potential_without_domain(model.phi, model.x, "phi"), model.x, model.names)
    )
    signs, sizes = model.sign_symbols, ca.jacobian(model.operator, model.sign_symbols)
    operator = ca.substitute(model.operator, signs, ca.SX.zeros(signs.numel()))
    S = None if model.phi is not None or operator.is_zero() else expression_program(operator, model.x, model.names)
    switches = [
        [column_text(sizes[:, k]), expression_program(argument, model.x, model.names)]
        for k, argument in enumerate(ca.vertsplit(model.sign_arguments)) if signs.numel()
    ]  # fmt: skip
    data = {"F": expression_program(model.field, model.x, model.names), "phi": phi, "S": S,
            "C": expression_program(rows, model.x, model.names), "x0": column_text(model.x0),
            "switches": switches}  # fmt: skip
    return CertificateSubject(model, data)


def proofs(
    model: MonotoneInclusion, data: Data, finding: Finding, findings: Mapping[str, Finding], value: dict[str, str], room: Fraction
) -> list[Any]:
    """Hints: a point inside C, convexity, squares, covers."""
    if finding.id == "M-C":
        return [interior_point_hint(model, finding)]
    V = model.field - (
        model.operator if model.phi is None else ca.gradient(potential_without_domain(model.phi, model.x, "phi"), model.x)
    )
    if finding.id == "M-T":
        if model.phi is None:
            return [cover_hint(model.operator, model.x)]
        atoms = verify.Atoms()
        (phi,) = atoms.read(data["phi"])
        return [convexity_hint(phi, range(model.x.numel()), atoms)]
    if finding.id == "M-A2":
        return [{}]
    if finding.id == "M-A3":
        atoms = verify.Atoms()
        found = nonnegativity_hint(verify.dissipation(data, {"value": value}, atoms), atoms)
        if found is None:
            raise UnprovedFinding("the dissipation is not shown to be >= 0 by squares")
        return [interior_point_hint(model, finding) | found]
    return [cover_hint(V, model.x) if finding.id == "M-24" else {"cover": AdaptiveCover()}]
