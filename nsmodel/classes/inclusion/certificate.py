"""Certificates of inclusions: F, S or Phi, C; covers and squares."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import casadi as ca

from nsmodel.certificate import verify
from nsmodel.certificate.data import Data, Subject, numbers, program
from nsmodel.certificate.hints import AT_LEAST, Grown, Stated, Unproved, convexity, cover, inside, nowhere_negative
from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.inclusion.set_valued import constraints
from nsmodel.hypotheses.domain import without_domain
from nsmodel.hypotheses.findings import Finding

STATED = {
    "M-A2": (Stated("a_1"), Stated("a_2")), "M-A3": (Stated("alpha", AT_LEAST), Stated("beta")), "M-24": (Stated("L"),),
}  # fmt: skip


def subject(model: MonotoneInclusion, findings: Mapping[str, Finding]) -> Subject:
    """The model as data."""
    rows, _ = constraints(model)
    phi = None if model.phi is None else program(without_domain(model.phi, model.x, "phi"), model.x, model.names)
    signs, sizes = model.sign_symbols, ca.jacobian(model.operator, model.sign_symbols)
    operator = ca.substitute(model.operator, signs, ca.SX.zeros(signs.numel()))
    S = None if model.phi is not None or operator.is_zero() else program(operator, model.x, model.names)
    switches = [
        [numbers(sizes[:, k]), program(argument, model.x, model.names)]
        for k, argument in enumerate(ca.vertsplit(model.sign_arguments)) if signs.numel()
    ]  # fmt: skip
    data = {"F": program(model.field, model.x, model.names), "phi": phi, "S": S,
            "C": program(rows, model.x, model.names), "x0": numbers(model.x0),
            "switches": switches}  # fmt: skip
    return Subject(model, data)


def proofs(
    model: MonotoneInclusion, data: Data, finding: Finding, findings: Mapping[str, Finding], value: dict[str, str], room: Fraction
) -> list[Any]:
    """Hints: a point inside C, convexity, squares, covers."""
    if finding.id == "M-C":
        return [inside(model, finding)]
    V = model.field - (model.operator if model.phi is None else ca.gradient(without_domain(model.phi, model.x, "phi"), model.x))
    if finding.id == "M-T":
        if model.phi is None:
            return [cover(model.operator, model.x)]
        atoms = verify.Atoms()
        (phi,) = atoms.read(data["phi"])
        return [convexity(phi, range(model.x.numel()), atoms)]
    if finding.id == "M-A2":
        return [{}]
    if finding.id == "M-A3":
        atoms = verify.Atoms()
        found = nowhere_negative(verify.dissipation(data, {"value": value}, atoms), atoms)
        if found is None:
            raise Unproved("the dissipation is not shown to be >= 0 by squares")
        return [inside(model, finding) | found]
    return [cover(V, model.x) if finding.id == "M-24" else {"cover": Grown()}]
