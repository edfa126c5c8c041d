"""``nsmodel check FILE --certificate DIR``: certificate.json, and the program that verifies it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.certificate import verify
from nsmodel.certificate.data import data_of
from nsmodel.certificate.graph import NoProgram, text
from nsmodel.certificate.hints import ROOMS, TooManyParts, Unproved, covered, proofs_of, value_of
from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.classes.first_order.model import FirstOrderSystem
from nsmodel.errors import UsageError
from nsmodel.hypotheses.findings import ALONG_A_RUN, HOLDS, Finding, Report
from nsmodel.hypotheses.scope import Scope
from nsmodel.model.base import Model
from nsmodel.storage import replacing

FORMAT = 2
MOST_CONSTRAINTS = 400  # Families of more are not written out.


def certificate_of(report: Report) -> dict[str, Any]:
    """The certificate of a report: the model's data and their hash, a statement for each hypothesis that holds.

    A statement without proof says why under "why"; ``verify`` then answers "not checkable". What was measured along runs has
    no statement.
    """
    found: dict[str, Any] = {"format": FORMAT, "title": report.title, "hash": "", "model": {}, "statements": []}
    findings = {finding.id: finding for finding in report.findings if finding.verdict == HOLDS}
    reason = ""
    model = report.model
    if isinstance(model, ManyBodies):
        if sum(family.count for family in model.constraints.values()) > MOST_CONSTRAINTS:
            reason = f"more than {MOST_CONSTRAINTS} constraints of families"
        elif not isinstance(model.f, ca.SX):
            reason = "a velocity that is a function of numbers"
        else:
            model = model.written_out()
    found["model"] = {} if reason else data_of(model, findings)
    found["hash"] = verify.digest(found["model"])
    for finding in report.findings:
        if finding.verdict == HOLDS and not finding.id.startswith(ALONG_A_RUN):
            found["statements"].append(_statement(model, found["model"], finding, findings, reason))
    return found


def _statement(model: Model, data: dict[str, Any], finding: Finding, findings: dict[str, Finding], reason: str) -> dict[str, Any]:
    statement: dict[str, Any] = {
        "id": finding.id, "statement": finding.statement, "source": finding.source, "value": value_of(finding),
        "scope": None if finding.scope is None else _scope(finding.scope, model), "proof": None,
    }  # fmt: skip
    for room in ROOMS if not reason else ():
        value = value_of(finding, room)
        try:
            proofs = proofs_of(model, data, finding, findings, value, room)
        except (Unproved, NoProgram, verify.NotCheckable) as why:
            reason = str(why)
            break
        for proof in proofs:
            proved = statement | {"value": value, "proof": proof}
            try:
                answer = covered(data, proved)
            except TooManyParts as why:
                reason = str(why)
                continue
            if answer == "yes":
                return proved
            reason = answer.partition(": ")[2]
    return statement | {"why": reason}


def _scope(scope: Scope, model: Model) -> dict[str, Any]:
    """The scope; of a first-order system on a box the multipliers lie in K, where it is bounded."""
    states = dict(scope.states)
    if states and isinstance(model, FirstOrderSystem):
        ends = np.array(ca.DM(ca.horzcat(model.law.lower, model.law.upper))).reshape(-1, 2)
        states = {
            name: tuple(end) for name, end in zip(model.multiplier_names, ends, strict=True) if np.isfinite(end).all()
        } | states
    return {
        "states": {name: [text(end) for end in ends] for name, ends in states.items()} or None,
        "time": None if scope.time is None else [text(end) for end in scope.time],
    }


def write_certificate(report: Report, folder: str | Path) -> tuple[Path, int, int]:
    """Write certificate.json and verify.py into a folder, which is made.

    Returns:
        the path of the certificate; how many statements are proved in it, and how many are not checkable.

    Raises:
        UsageError: no folder can be made there.
    """
    target = Path(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"certificate: {target} cannot be made a folder ({error.strerror})") from error
    certificate = certificate_of(report)
    path = target / "certificate.json"
    with replacing(path) as beside:
        beside.write_text(json.dumps(certificate, indent=1) + "\n", encoding="utf-8")
    shutil.copyfile(verify.__file__, target / "verify.py")
    left = sum(statement["proof"] is None for statement in certificate["statements"])
    return path, len(certificate["statements"]) - left, left
