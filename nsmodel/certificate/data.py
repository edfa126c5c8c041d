"""The data of a model that its certificate speaks of: graphs, matrices, the law, the start."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.certificate.graph import NoProgram, graph, matrix, text
from nsmodel.classes.registry import class_of
from nsmodel.hypotheses.findings import Finding
from nsmodel.laws import Law
from nsmodel.model.base import Model

Data = dict[str, Any]


class Subject(NamedTuple):
    """What a certificate speaks of: the model with its constraints one by one, as data; ``box`` of inputs that are no states."""

    model: Model
    data: Data
    box: Mapping[str, Sequence[float]] = MappingProxyType({})


def subject_of(model: Model, findings: Mapping[str, Finding]) -> Subject:
    """The model as data; its parameters have values, and numbers of findings may be data too.

    Raises:
        Unproved: the model cannot be written down.
    """
    subject = class_of(model).part("certificate").subject(model, findings)
    named = {"class": type(subject.model).__name__, "title": subject.model.title or "untitled"}
    return subject._replace(data=named | subject.data)


def numbers(column: Any) -> list[str]:
    """A column."""
    return [text(entry) for entry in np.array(ca.DM(column)).ravel()]


def program(expr: ca.SX, inputs: ca.SX, names: Sequence[str]) -> Data:
    """The program, or why there is none: not every statement needs it."""
    try:
        return graph(expr, inputs, names)
    except NoProgram as why:
        return {"inputs": list(names), "why": str(why)}


def dense(entries: Any) -> list[list[str]]:
    """A matrix, also an empty one."""
    values = np.array(ca.DM(ca.densify(entries))).reshape(entries.shape)
    return matrix(values) if values.size else [[] for _ in range(len(values))]


def _numbers_of(value: Any) -> str | list[str] | list[list[str]]:
    array = np.asarray(value, float)
    if array.ndim > 1:
        return matrix(array)
    return [text(number) for number in array] if array.ndim else text(float(array))


def law_data(law: Law) -> list[Data]:
    """The blocks of a law."""
    return [
        {"kind": block.kind, "size": block.size} | {name: _numbers_of(value) for name, value in block.data().items()}
        for block in law.blocks
    ]


def steps(model: Model) -> list[str]:
    """The model's own steps."""
    steps = [model.step] if model.steps is None else list(np.ravel(model.steps))
    return [text(step) for step in steps if step is not None]
