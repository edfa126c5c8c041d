"""The data of a model that its certificate speaks of: graphs, matrices, the law, the start."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.certificate.graph import NoProgram, graph, matrix, text
from nsmodel.classes.first_order.model import FirstOrderSystem
from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.inclusion.set_valued import constraints
from nsmodel.classes.lure.model import LureSystem
from nsmodel.classes.oscillator.hypotheses.check import domain_of
from nsmodel.classes.oscillator.model import FrictionOscillator
from nsmodel.classes.sweeping.hypotheses.forms import Shape
from nsmodel.classes.sweeping.hypotheses.shapes import read_shapes
from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.hypotheses.domain import without_domain
from nsmodel.hypotheses.findings import Finding
from nsmodel.laws import Law
from nsmodel.model.base import Model
from nsmodel.proof import extremum

Data = dict[str, Any]


def data_of(model: Model, findings: Mapping[str, Finding]) -> Data:
    """The model as data; its parameters have values. Of a sweeping process the U_i of A0 to A4 are data too."""
    own = _sweeping(model, findings) if isinstance(model, SweepingProcess) else _WRITERS[type(model)](model)
    return {"class": type(model).__name__, "title": model.title or "untitled"} | own


def _numbers(column: Any) -> list[str]:
    return [text(entry) for entry in np.array(ca.DM(column)).ravel()]


def _or_why(expr: ca.SX, inputs: ca.SX, names: Sequence[str]) -> Data:
    """The program, or why there is none: not every statement needs it."""
    try:
        return graph(expr, inputs, names)
    except NoProgram as why:
        return {"inputs": list(names), "why": str(why)}


def _dense(entries: Any) -> list[list[str]]:
    values = np.array(ca.DM(ca.densify(entries))).reshape(entries.shape)
    return matrix(values) if values.size else [[] for _ in range(len(values))]


def _numbers_of(value: Any) -> Data:
    array = np.asarray(value, float)
    return text(float(array)) if not array.ndim else matrix(array) if array.ndim > 1 else [text(number) for number in array]


def _law(law: Law) -> list[Data]:
    return [
        {"kind": block.kind, "size": block.size} | {name: _numbers_of(value) for name, value in block.data().items()}
        for block in law.blocks
    ]


def _steps(model: Model) -> list[str]:
    steps = [model.step] if model.steps is None else list(np.ravel(model.steps))
    return [text(step) for step in steps if step is not None]


def reach_of(shape: Shape, model: SweepingProcess) -> Fraction:
    """Of a distance less r(t) a number that r is not below, at all times; U_i = {g_i > -delta} with half of it."""
    offset = shape.form.affine.offset
    if isinstance(offset, Fraction):
        return -offset
    top = extremum.supremum(offset, model.t, np.zeros(1), np.array([float(model.t_end or 0.0)])).bound
    return Fraction(-top) * (1 - Fraction(1, 2**40)) if top < 0 else Fraction(0)


def _sweeping(model: SweepingProcess, findings: Mapping[str, Finding]) -> Data:
    shapes = read_shapes(model.g, model.q) if model.multiplier_names else []
    own = [list(shape.own) for shape in shapes]
    c, b = (findings[id].value.get(name, 1.0) if id in findings else 1.0 for id, name in (("A0", "c"), ("A1", "b")))
    on_box = Fraction(c) * Fraction(b) if np.isfinite([c, b]).all() else Fraction(1)
    deltas = [
        {} if shape.kind == "plane" else {"delta": text(reach_of(shape, model) / 2 if shape.kind == "distance" else on_box)}
        for shape in shapes
    ]
    rows = zip(model.multiplier_names, ca.vertsplit(model.g), own, deltas, strict=True) if own else []
    return {
        "constraints": [
            {"name": name, "graph": _or_why(g, ca.vertcat(model.t, model.q[own]), ["t", *(model.names[i] for i in own)])} | delta
            for name, g, own, delta in rows
        ],
        "f": _or_why(model.f, ca.vertcat(model.t, model.q), ["t", *(model.names or ())]),
        "q0": _numbers(model.q0),
    }  # fmt: skip


def _oscillator(model: FrictionOscillator) -> Data:
    domain = domain_of(model)
    return {
        "theta": [_or_why(element.theta, model.s, ["s"]) for element in model.elements],
        "H": [_dense(ca.SX(element.H)) for element in model.elements],
        "damping": [] if model.damping is None else _dense(model.damping),
        "g": _or_why(without_domain(model.potential, model.x, "potential"), model.x, model.names),
        "C": _or_why(ca.vertcat(domain.rows, domain.equalities, -domain.equalities), model.x, model.names),
        "x0": _numbers(model.x0),
        "steps": _steps(model),
    }


def _first_order(model: FirstOrderSystem) -> Data:
    z, names = ca.vertcat(model.t, model.x, model.lam), ["t", *(model.names or ()), *model.multiplier_names]
    return {
        **{name: _or_why(getattr(model, name), z, names) for name in "fgh"},
        "M": _dense(model.M), "theta": text(model.theta), "gamma": text(model.gamma), "x0": _numbers(model.x0),
        "steps": sorted(set(_steps(model)), key=Fraction), "law": _law(model.law),
    }  # fmt: skip


def _lure(model: LureSystem) -> Data:
    y = ca.SX.sym("y", 0) if model.law is not None else model.y
    return {
        "A": _or_why(model.A, model.x, model.names), "B": _dense(model.B), "C": _dense(model.C), "D": _dense(model.D),
        "f": _or_why(model.f, model.t, ["t"]), "x0": _numbers(model.x0),
        "law": [] if model.law is None else _law(model.law),
        "phi": None if model.law is not None else _or_why(model.phi, y, [f"y_{i}" for i in range(y.numel())]),
    }  # fmt: skip


def _inclusion(model: MonotoneInclusion) -> Data:
    rows, _ = constraints(model)
    phi = None if model.phi is None else _or_why(without_domain(model.phi, model.x, "phi"), model.x, model.names)
    signs, sizes = model.sign_symbols, ca.jacobian(model.operator, model.sign_symbols)
    operator = ca.substitute(model.operator, signs, ca.SX.zeros(signs.numel()))
    S = None if model.phi is not None or operator.is_zero() else _or_why(operator, model.x, model.names)
    switches = [
        [_numbers(sizes[:, k]), _or_why(argument, model.x, model.names)]
        for k, argument in enumerate(ca.vertsplit(model.sign_arguments)) if signs.numel()
    ]  # fmt: skip
    return {"F": _or_why(model.field, model.x, model.names), "phi": phi, "S": S,
            "C": _or_why(rows, model.x, model.names), "x0": _numbers(model.x0),
            "switches": switches}  # fmt: skip


_WRITERS: dict[type[Model], Any] = {
    FrictionOscillator: _oscillator, FirstOrderSystem: _first_order, LureSystem: _lure,
    MonotoneInclusion: _inclusion,
}  # fmt: skip
