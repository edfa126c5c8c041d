"""The data of a model that its certificate speaks of: graphs, matrices, the law, the start."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.certificate.graph import UnsupportedOperation, exact_matrix_text, exact_number_text, straight_line_program
from nsmodel.certificate.hints import StatedNumber
from nsmodel.hypotheses.findings import Finding
from nsmodel.modeling.base import Model
from nsmodel.modeling.laws import Law
from nsmodel.modeling.parts import Part

Data = dict[str, Any]


class CertificateSubject(NamedTuple):
    """What a certificate speaks of: the model with its constraints one by one, as data; ``box`` of inputs that are no states."""

    model: Model
    data: Data
    box: Mapping[str, Sequence[float]] = MappingProxyType({})


@dataclass(frozen=True)
class CertificateParts:
    """What a class of models brings to certificates.

    Attributes:
        stated: {id of a hypothesis: the numbers that its statement has}.
        subject: (model, findings by id), what a certificate of it speaks of.
        proofs: (model, its data, finding, findings by id, stated values, room for rounding), data of proofs to be tried in turn.
    """

    stated: Mapping[str, tuple[StatedNumber, ...]]
    subject: Callable[[Any, Mapping[str, Finding]], CertificateSubject]
    proofs: Callable[..., Iterable[Data]]


CERTIFICATE = Part[CertificateParts]("certificate_parts")


def certificate_subject(model: Model, findings: Mapping[str, Finding]) -> CertificateSubject:
    """The model as data; its parameters have values, and numbers of findings may be data too.

    Raises:
        Unproved: the model cannot be written down.
    """
    subject = CERTIFICATE.of(model).subject(model, findings)
    named = {"class": type(subject.model).__name__, "title": subject.model.title or "untitled"}
    return subject._replace(data=named | subject.data)


def column_text(column: Any) -> list[str]:
    """A column."""
    return [exact_number_text(entry) for entry in np.array(ca.DM(column)).ravel()]


def expression_program(expr: ca.SX, inputs: ca.SX, names: Sequence[str]) -> Data:
    """The program, or why there is none: not every statement needs it."""
    try:
        return straight_line_program(expr, inputs, names)
    except UnsupportedOperation as why:
        return {"inputs": list(names), "why": str(why)}


def dense_matrix_text(entries: Any) -> list[list[str]]:
    """A matrix, also an empty one."""
    values = np.array(ca.DM(ca.densify(entries))).reshape(entries.shape)
    return exact_matrix_text(values) if values.size else [[] for _ in range(len(values))]


def _array_text(value: Any) -> str | list[str] | list[list[str]]:
    array = np.asarray(value, float)
    if array.ndim > 1:
        return exact_matrix_text(array)
    return [exact_number_text(number) for number in array] if array.ndim else exact_number_text(float(array))


def law_data(law: Law) -> list[Data]:
    """The blocks of a law."""
    return [
        {"kind": block.kind, "size": block.size} | {name: _array_text(value) for name, value in block.data().items()}
        for block in law.blocks
    ]


def step_sizes_text(model: Model) -> list[str]:
    """The model's own steps."""
    steps = [model.step] if model.steps is None else list(np.ravel(model.steps))
    return [exact_number_text(step) for step in steps if step is not None]
