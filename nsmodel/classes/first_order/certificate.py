"""Certificates of first-order systems: f, g, h, inverses at each step."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.certificate.data import Data, Subject, dense, law_data, numbers, program, steps
from nsmodel.certificate.graph import matrix, text
from nsmodel.certificate.hints import EXACTLY, Grown, Stated, Unproved
from nsmodel.classes.first_order.model import FirstOrderSystem
from nsmodel.hypotheses.findings import Finding
from nsmodel.proof import exact

STATED = {"F-step": (Stated("h", EXACTLY),), "F-W": (Stated("h", EXACTLY),)}


def subject(model: FirstOrderSystem, findings: Mapping[str, Finding]) -> Subject:
    """The model as data; the multipliers lie in K, where it is bounded."""
    z, names = ca.vertcat(model.t, model.x, model.lam), ["t", *(model.names or ()), *model.multiplier_names]
    data = {
        **{name: program(getattr(model, name), z, names) for name in "fgh"},
        "M": dense(model.M), "theta": text(model.theta), "gamma": text(model.gamma), "x0": numbers(model.x0),
        "steps": sorted(set(steps(model)), key=Fraction), "law": law_data(model.law),
    }  # fmt: skip
    ends = np.array(ca.DM(ca.horzcat(model.law.lower, model.law.upper))).reshape(-1, 2)
    box = {name: tuple(end) for name, end in zip(model.multiplier_names, ends, strict=True) if np.isfinite(end).all()}
    return Subject(model, data, box)


def proofs(
    model: FirstOrderSystem, data: Data, finding: Finding, findings: Mapping[str, Finding], value: dict[str, str], room: Fraction
) -> list[Any]:
    """Hints: the inverse of M or of W, covers."""
    return [_hint(model, finding, value)]


def _hint(model: FirstOrderSystem, finding: Finding, value: dict[str, str]) -> Any:
    if finding.id == "F-jacobians":
        return {"cover": Grown()}
    if finding.id in ("F-mlcp", "F-unique"):
        return _complementarity(model)
    steps = model.steps if model.steps is not None else [model.step]
    value["h"] = text(np.max(np.asarray(steps, float)))
    inverse = exact.inverse(exact.rational(np.array(ca.DM(ca.densify(model.M)))))
    if inverse is None:
        raise Unproved("M is singular")
    return {"inverse": matrix(inverse), "cover": Grown()}


def _complementarity(model: FirstOrderSystem) -> Any:
    """W^-1 at each step, and T with T (W_mlcp + W_mlcp') = B where there is one."""
    z = ca.vertcat(model.t, model.x, model.lam)
    J = [ca.jacobian(getattr(model, name), u) for name in "fgh" for u in (model.x, model.lam)]
    if any(ca.depends_on(part, z) for part in J):
        raise Unproved("f, g or h is not affine")
    A, _, K, B, C, D = (exact.rational(np.array(ca.DM(ca.densify(part))).reshape(part.shape)) for part in J)
    M, theta, gamma = exact.rational(np.array(ca.DM(ca.densify(model.M)))), Fraction(model.theta), Fraction(model.gamma)
    found: dict[str, list[Any]] = {"inverses": [], "T": []}
    for h in np.unique(np.asarray(model.step if model.steps is None else model.steps, float)):
        inverse = exact.inverse(M - Fraction(h) * (theta * A + gamma * K))
        if inverse is None:
            raise Unproved("W is singular")
        W = D + Fraction(h) * gamma * exact.product(C, inverse, B)
        T = exact.solve(W + W.T, B.T)
        found["inverses"].append(matrix(inverse))
        found["T"].append(None if T is None else matrix(T.T))
    return found
