"""``nsmodel check FILE --certificate DIR``: certificate.json, and the program that verifies it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nsmodel.certificate import verify
from nsmodel.certificate.data import CERTIFICATE, CertificateSubject, certificate_subject
from nsmodel.certificate.graph import UnsupportedOperation, exact_number_text
from nsmodel.certificate.hints import ROUNDING_ALLOWANCES, CoverTooLarge, UnprovedFinding, stated_values, verify_with_covers
from nsmodel.errors import UsageError
from nsmodel.files.storage import replace_atomically
from nsmodel.hypotheses.findings import HOLDS, RUN_FINDING_PREFIX, Finding
from nsmodel.hypotheses.moving_law import freeze_law
from nsmodel.hypotheses.report.report import Report
from nsmodel.hypotheses.scope import Scope

CERTIFICATE_FORMAT = 2


def certificate_of(report: Report) -> dict[str, Any]:
    """The certificate of a report: the model's data and their hash, a statement for each hypothesis that holds.

    A statement without proof says why under "why"; ``verify`` then answers "not checkable". What was measured along runs has
    no statement.

    Raises:
        UsageError: a model with inputs, or with a law that moves.
    """
    report.model.check_allowed("certificate")
    if freeze_law(report.model) is not report.model:
        raise UsageError("certificate: the law moves with time; a certificate says nothing of laws that move")
    found: dict[str, Any] = {"format": CERTIFICATE_FORMAT, "title": report.title, "hash": "", "model": {}, "statements": []}
    findings = {finding.id: finding for finding in report.findings if finding.verdict == HOLDS}
    reason, subject = "", CertificateSubject(report.model, {})
    try:
        subject = certificate_subject(report.model, findings)
    except UnprovedFinding as why:
        reason = str(why)
    found["model"] = subject.data
    found["hash"] = verify.digest(found["model"])
    for finding in report.findings:
        if finding.verdict == HOLDS and not finding.id.startswith(RUN_FINDING_PREFIX):
            found["statements"].append(_prove_statement(subject, finding, findings, reason))
    return found


def _prove_statement(subject: CertificateSubject, finding: Finding, findings: dict[str, Finding], reason: str) -> dict[str, Any]:
    part = CERTIFICATE.of(subject.model)
    stated = part.stated.get(finding.id, ())
    statement: dict[str, Any] = {
        "id": finding.id, "statement": finding.statement, "source": finding.source, "value": stated_values(finding, stated),
        "scope": None if finding.scope is None else _scope_data(finding.scope, subject.box), "proof": None,
    }  # fmt: skip
    for room in ROUNDING_ALLOWANCES if not reason else ():
        value = stated_values(finding, stated, room)
        try:
            proofs = part.proofs(subject.model, subject.data, finding, findings, value, room)
        except (UnprovedFinding, UnsupportedOperation, verify.NotCheckable) as why:
            reason = str(why)
            break
        for proof in proofs:
            proved = statement | {"value": value, "proof": proof}
            try:
                answer = verify_with_covers(subject.data, proved)
            except CoverTooLarge as why:
                reason = str(why)
                continue
            if answer == "yes":
                return proved
            reason = answer.partition(": ")[2]
    return statement | {"why": reason}


def _scope_data(scope: Scope, box: Mapping[str, Sequence[float]]) -> dict[str, Any]:
    """The scope; what lies on a box of states has the box of the other inputs too."""
    states = {**box, **scope.states} if scope.states else {}
    return {
        "states": {name: [exact_number_text(end) for end in ends] for name, ends in states.items()} or None,
        "time": None if scope.time is None else [exact_number_text(end) for end in scope.time],
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
    with replace_atomically(path) as temporary:
        temporary.write_text(json.dumps(certificate, indent=1) + "\n", encoding="utf-8")
    shutil.copyfile(verify.__file__, target / "verify.py")
    left = sum(statement["proof"] is None for statement in certificate["statements"])
    return path, len(certificate["statements"]) - left, left
