"""``nsmodel check FILE --certificate DIR``: certificate.json, and the program that verifies it.

The data of a model that its certificate speaks of: graphs, matrices, the law, the start.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.errors import UsageError
from nsmodel.files.storage import make_folder, replace_atomically
from nsmodel.hypotheses.certificates import verify
from nsmodel.hypotheses.certificates.hints import (
    ROUNDING_ALLOWANCES,
    StatedNumber,
    UnprovedFinding,
    UnsupportedOperation,
    exact_matrix_text,
    exact_number_text,
    stated_values,
    straight_line_program,
    verify_with_covers,
)
from nsmodel.hypotheses.findings import HOLDS, RUN_FINDING_PREFIX, Finding, IntervalBox, Scope
from nsmodel.hypotheses.moving_law import freeze_law
from nsmodel.hypotheses.report import Report
from nsmodel.modeling.base import Model
from nsmodel.modeling.laws import Law
from nsmodel.modeling.parts import Part

Data = dict[str, Any]
# Parameters for which hints look at all 2^6 corners of the box; of more an end of an interval is written as its formula.
MAX_HINT_PARAMETERS = 6


class CertificateSubject(NamedTuple):
    """What a certificate speaks of.

    Attributes:
        model: its constraints are one by one, or families.
        data: the model as data.
        box: of inputs that are no states.
        ranges: between which ends each parameter lies.
        stands_for: {name in a scope: names of the states that it stands for}, where these are not the same.
    """

    model: Any
    data: Data
    box: Mapping[str, Sequence[float]] = MappingProxyType({})
    ranges: IntervalBox = MappingProxyType({})
    stands_for: Mapping[str, Sequence[str]] = MappingProxyType({})

    @property
    def parameters(self) -> verify.Parameters:
        """The parameters as ``verify`` has them."""
        ends = {name: (Fraction(low), Fraction(high)) for name, (low, high) in self.ranges.items()}
        return {name: verify.between(k, *pair) for k, (name, pair) in enumerate(ends.items())}


@dataclass(frozen=True)
class CertificateParts:
    """What a class of models brings to certificates.

    Attributes:
        stated: {id of a hypothesis: the numbers that its statement has}.
        subject: (model, findings by id, ends of its parameters), what a certificate of it speaks of.
        proofs: (subject, finding, findings by id, stated values, room for rounding), data of proofs to be tried in turn.
    """

    stated: Mapping[str, tuple[StatedNumber, ...]]
    subject: Callable[[Any, Mapping[str, Finding], IntervalBox], CertificateSubject]
    proofs: Callable[[CertificateSubject, Finding, Mapping[str, Finding], dict[str, str], Fraction], Iterable[Data]]


CERTIFICATE = Part[CertificateParts]("documents.CERTIFICATE")


def certificate_subject(model: Model, findings: Mapping[str, Finding], ranges: IntervalBox) -> CertificateSubject:
    """The model as data; its parameters have values or ends, and numbers of findings may be data too.

    Raises:
        Unproved: the model cannot be written down.
    """
    subject = CERTIFICATE.of(model).subject(model, findings, ranges)
    named = {"class": type(subject.model).__name__, "title": subject.model.title or "untitled"}
    return subject._replace(data=named | subject.data | ({"parameters": list(subject.ranges)} if subject.ranges else {}))


def expression_program(
    model: Model, expr: ca.SX, inputs: ca.SX, names: Sequence[str], values: Mapping[ca.SX, float] = MappingProxyType({})
) -> Data:
    """The program, of the model's parameters too, or why there is none: not every statement needs it.

    Args:
        values: of symbols that are neither inputs nor parameters.
    """
    names = [*names, *model.parameters] if model.p.numel() else names
    try:
        return straight_line_program(expr, ca.vertcat(inputs, model.p), names, values)
    except UnsupportedOperation as why:
        return {"inputs": list(names), "why": str(why)}


def entry_text(model: Model, entry: ca.SX) -> str | Data:
    """A number, or a function of the parameters."""
    if not ca.symvar(entry):
        return exact_number_text(float(entry))
    return expression_program(model, entry, ca.SX(0, 1), ())


def column_text(model: Model, column: Any) -> list[str | Data]:
    """A column of numbers, or functions of the parameters."""
    return [entry_text(model, entry) for entry in ca.vertsplit(ca.densify(ca.vec(ca.SX(column))))] if column.numel() else []


def dense_matrix_text(model: Model, entries: Any) -> list[list[str | Data]]:
    """A matrix, also an empty one."""
    rows, columns = entries.shape
    whole = column_text(model, entries)
    return [[whole[i + rows * j] for j in range(columns)] for i in range(rows)]


def _array_text(model: Model, value: Any, ranges: IntervalBox) -> Any:
    if isinstance(value, ca.SX):
        return [_end_text(model, entry, ranges) for entry in ca.vertsplit(value)]
    array = np.asarray(value, float)
    if array.ndim > 1:
        return exact_matrix_text(array)
    return [exact_number_text(number) for number in array] if array.ndim else exact_number_text(float(array))


def _end_text(model: Model, end: ca.SX, ranges: IntervalBox) -> str | Data:
    """An end of an interval; what is infinite at all corners of the parameters' box is infinite."""
    corners = [ca.DM(corner) for corner in product(*ranges.values())] if len(ranges) <= MAX_HINT_PARAMETERS else []
    value = ca.Function("end", [model.p], [end])
    found = {float(value(corner)) for corner in corners} if model.p.numel() else set()
    return exact_number_text(found.pop()) if found in ({np.inf}, {-np.inf}) else entry_text(model, end)


def law_data(model: Model, law: Law, ranges: IntervalBox) -> list[Data]:
    """The blocks of a law."""
    return [
        {"kind": block.kind, "size": block.size}
        | {name: _array_text(model, value, ranges) for name, value in block.data().items()}
        for block in law.blocks
    ]


def step_sizes_text(model: Model) -> list[str]:
    """The model's own steps."""
    steps = [model.step] if model.steps is None else list(np.ravel(model.steps))
    return [exact_number_text(step) for step in steps if step is not None]


def certificate_of(report: Report) -> dict[str, Any]:
    """The certificate of a report: the model's data and their hash, a statement for each hypothesis that holds.

    A statement without proof says why under "why"; ``verify`` then answers "not checkable". What was measured along runs has
    no statement.

    Raises:
        UsageError: a model with inputs, or with a law that moves, or with parameters that have neither a value nor ends.
    """
    report.model.check_allowed("certificate")
    if open_ones := [name for name, value in report.parameters.items() if value is None]:
        raise UsageError(f"certificate: give a value or a box to {', '.join(open_ones)}")
    ranges = {name: report.parameters[name] for name in report.model.parameters if name in report.parameters}
    ranges = {name: ends for name, ends in ranges.items() if isinstance(ends, tuple)}
    if freeze_law(report.model) is not report.model:
        raise UsageError("certificate: the law moves with time; certificates cover only laws that do not move")
    found: dict[str, Any] = {"format": verify.FORMAT, "title": report.title, "hash": "", "model": {}, "statements": []}
    findings = {finding.id: finding for finding in report.findings if finding.verdict == HOLDS}
    reason, subject = "", CertificateSubject(report.model, {})
    try:
        subject = certificate_subject(report.model, findings, ranges)
    except UnprovedFinding as why:
        reason = why.args[0]
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
        "scope": _scope_data(finding.scope, subject), "proof": None,
    }  # fmt: skip
    scopes = [statement["scope"], *_scope_of_run(subject, statement["scope"])]
    for room in ROUNDING_ALLOWANCES if not reason else ():
        value = stated_values(finding, stated, room)
        try:
            proofs = part.proofs(subject, finding, findings, value, room)
        except (verify.Unproved, UnsupportedOperation) as why:
            reason = why.args[0]
            break
        for proof, scope in product(proofs, scopes):
            proved = statement | {"value": value, "scope": scope, "proof": proof}
            kind, reason = verify_with_covers(subject.data, proved)
            if kind == verify.YES:
                return proved
    return statement | {"why": reason}


def _scope_data(scope: Scope | None, subject: CertificateSubject) -> dict[str, Any] | None:
    """The scope; what lies on a box of states has the box of the other inputs too. Time may be one of the parameters."""
    found: dict[str, Any] = {}
    if scope is not None:
        states = {own: ends for name, ends in scope.states.items() for own in subject.stands_for.get(name, (name,))}
        found["states"] = _ends_text({**subject.box, **states} if states else {}) or None
        found["time"] = None if scope.time is None or str(subject.model.t) in subject.ranges else _ends_text({"": scope.time})[""]
    return found | ({"parameters": _ends_text(subject.ranges)} if subject.ranges else {}) or None


def _ends_text(box: Mapping[str, Sequence[float]]) -> dict[str, list[str]]:
    return {name: [exact_number_text(end) for end in ends] for name, ends in box.items()}


def _scope_of_run(subject: CertificateSubject, scope: Data | None) -> list[Data]:
    """The scope restricted to the times of the run, where it holds all times and a function may be undefined at some."""
    end = subject.model.t_end
    if end is None or (scope or {}).get("time") is not None or not _has_partial_function_of_time(subject.data):
        return []
    return [{"states": None, **(scope or {}), "time": [exact_number_text(0.0), exact_number_text(float(end))]}]


def _has_partial_function_of_time(item: Any) -> bool:
    """Whether a program of t has a logarithm or a power that is not defined everywhere."""
    if isinstance(item, dict) and {"steps", "outputs"} <= set(item) and item["inputs"][:1] == ["t"]:
        powers = [Fraction(rest[1]) for op, *rest in item["steps"] if op == "pow"]
        partial = any(n < 0 or n.denominator > 1 for n in powers) or any(op == "log" for op, *_ in item["steps"])
        return partial and ["in", 0] in item["steps"]
    parts = item.values() if isinstance(item, dict) else item if isinstance(item, list) else ()
    return any(_has_partial_function_of_time(part) for part in parts)


def write_certificate(report: Report, folder: str | Path) -> tuple[Path, int, int]:
    """Write certificate.json and verify.py into a folder, which is made.

    Returns:
        the path of the certificate; how many statements are proved in it, and how many are not checkable.

    Raises:
        StorageError: no folder can be made there, or the files cannot be written.
    """
    target = Path(folder)
    make_folder(target, f"the certificate into {target}")
    certificate = certificate_of(report)
    path = target / "certificate.json"
    with replace_atomically(path) as temporary:
        temporary.write_text(json.dumps(certificate, indent=1) + "\n", encoding="utf-8")
    with replace_atomically(target / "verify.py") as temporary:
        shutil.copyfile(verify.__file__, temporary)
    left = sum(statement["proof"] is None for statement in certificate["statements"])
    return path, len(certificate["statements"]) - left, left
