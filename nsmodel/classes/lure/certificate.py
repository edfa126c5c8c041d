"""Certificates of Lur'e systems: matrices, the law, P, points in ranges."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.certificate import verify
from nsmodel.certificate.data import Data, Subject, dense, law_data, numbers, program
from nsmodel.certificate.graph import text
from nsmodel.certificate.hints import AT_LEAST, Stated, Unproved, cover
from nsmodel.classes.lure.model import LureSystem
from nsmodel.hypotheses.findings import Finding
from nsmodel.proof import exact, feasibility

STATED = {"4.1": (Stated("least eigenvalue", AT_LEAST, "least"),), "5.2": (Stated("omega"),)}


def subject(model: LureSystem, findings: Mapping[str, Finding]) -> Subject:
    """The model as data."""
    y = ca.SX.sym("y", 0) if model.law is not None else model.y
    data = {
        "A": program(model.A, model.x, model.names), "B": dense(model.B), "C": dense(model.C), "D": dense(model.D),
        "f": program(model.f, model.t, ["t"]), "x0": numbers(model.x0),
        "law": [] if model.law is None else law_data(model.law),
        "phi": None if model.law is not None else program(model.phi, y, [f"y_{i}" for i in range(y.numel())]),
    }  # fmt: skip
    e = {} if model.e.is_zero() else {"e": numbers(model.e) if model.e.is_constant() else program(model.e, model.t, ["t"])}
    return Subject(model, data | e)


def proofs(
    model: LureSystem, data: Data, finding: Finding, findings: Mapping[str, Finding], value: dict[str, str], room: Fraction
) -> list[Any]:
    """Hints: P, a cover where A is not linear, points in ranges."""
    return [_hint(model, data, finding)]


def _hint(model: LureSystem, data: Data, finding: Finding) -> Any:
    if finding.id in ("5.1", "5.2"):
        name = "P" if finding.id == "5.1" else "P_omega"
        P = finding.witness.get(f"{name} exactly") or finding.witness.get(name)
        if P is None:
            raise Unproved("too large a P to write down")
        P = [[entry if isinstance(entry, str) else text(entry) for entry in row] for row in P]
        return {"P": P} | cover(model.A, model.x)
    if finding.id in ("5.4a", "5.4c", "5.x0", "7.1") and not _everything(data):
        return _in_range(
            model, None if finding.id in ("5.4a", "5.4c") else np.array(ca.DM(model.x0)).ravel() * (finding.id == "5.x0")
        )
    return {}


def _everything(data: Data) -> bool:
    with suppress(verify.Undefined):
        return bool(verify.everything(data))
    return False


def _refuse_moving_or_curved(model: LureSystem) -> None:
    if not model.e.is_constant():
        raise Unproved("an offset e that moves with time")
    if model.law is None or not model.law.is_box:
        raise Unproved("a law that is no box")


def _in_range(model: LureSystem, x: np.ndarray | None) -> Any:
    """x, k, y, v with C x + e = D'k + y + S v, k and y inside, of a law of boxes; empty where nothing is asked.

    Columns of the homogeneous system: tau > 0, l - low tau > 0 (or high tau - l), where both ends are finite also their sum,
    y > 0 or < 0 where one end is, v, and x where it is not given.
    """
    m, n = model.D.shape[0], model.x.numel()
    C, D = (exact.rational(np.array(ca.DM(part)).reshape(part.shape)) for part in (model.C, model.D))
    _refuse_moving_or_curved(model)
    low, high = (np.concatenate(ends) for ends in zip(*(block.hull() for block in model.law.blocks), strict=True))
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
        A[:m, 0] += exact.product(C, exact.rational(x)[:, None]).ravel()
    found = feasibility.decide(feasibility.System(A, tuple(positive))).point
    if found is None:
        raise Unproved("no point was found")
    found = found / found[0]
    return {
        "x": [text(entry) for entry in (found[1 + 4 * m :] if x is None else exact.rational(x))],
        "k": [text(base + sign * found[1 + i]) for i, (base, sign) in enumerate(k)],
        "y": [text(k[i][1] * found[1 + 2 * m + i]) for i in range(m)],
        "v": [text(entry) for entry in found[1 + 3 * m : 1 + 4 * m]],
    }
