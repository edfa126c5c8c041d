"""What a run refuses at its start, a compiled sweep refuses in this cell alone, in every class of models."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import nsmodel
from nsmodel import (
    Contact,
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    MechanicalSystem,
    MonotoneInclusion,
    SweepingProcess,
    box,
    coulomb,
    simulate,
    sweep,
)
from nsmodel.codegen import library
from nsmodel.errors import UsageError
from nsmodel.modeling.parts import MODEL_CLASSES

x, l, p = ca.SX.sym("x"), ca.SX.sym("l"), ca.SX.sym("p")
X, V = ca.SX.sym("q", 2), ca.SX.sym("v", 2)
RUN = {"t_end": 0.1, "step": 0.01, "parameters": {p: 0.5}}


def first_order(law, size=1):
    lam = ca.SX.sym("l", size)
    state = ca.SX.sym("x", size)
    return FirstOrderSystem(x=state, lam=lam, f=-state, g=lam, h=state, law=law, x0=[0.5] * size, **RUN)


MODELS = {  # And a parameter that a run refuses.
    "a point outside its set": (lambda: SweepingProcess(q=x, constraints={"wall": x}, f=-1, q0=p, **RUN), -1.0),
    "an oscillator outside its walls": (lambda: FrictionOscillator(x=x, constraints={"wall": 1 - x}, x0=p, **RUN), 2.0),
    "ends of a law that cross": (lambda: first_order(box(-1, p)), -2.0),
    "friction below 0": (lambda: first_order(coulomb(p), 2), -0.5),
    "a Lur'e law that is empty": (
        lambda: LureSystem(x=x, A=[[-1]], B=[[1]], C=[[1]], D=[[1]], law=box(-1, p), x0=0.5, **RUN), -2.0,
    ),
    "an inclusion outside C": (lambda: MonotoneInclusion(x=x, field=-x, constraints={"wall": 1 - x}, x0=p, **RUN), 2.0),
    "contacts that overlap": (
        lambda: MechanicalSystem(q=X, v=V, M=1, contacts={"floor": Contact(X[1])}, q0=ca.vertcat(0, p), **RUN), -0.5,
    ),
    "restitution above 1": (
        lambda: MechanicalSystem(q=X, v=V, M=1, contacts={"floor": Contact(X[1], e=p)}, q0=[0, 1], **RUN), 1.5,
    ),
}  # fmt: skip


def test_every_class_is_tried():
    tried = {type(model()).__name__ for model, _ in MODELS.values()}
    assert tried == set(MODEL_CLASSES) - {"ManyBodies"}  # whose sweeps are runs one by one


@pytest.mark.skipif(library.compiler() is None, reason="no C compiler")
def test_a_compiled_sweep_refuses_what_a_run_refuses():
    for kind, (made, bad) in MODELS.items():
        model = made()
        with pytest.raises(nsmodel.NsmodelError):
            simulate(model, parameters={"p": bad})
        end = {"end": f"{model.names[0]}[-1]"}
        found = sweep(model, grid={"p": [0.5, bad, 0.25]}, outputs=end, compiled=True)
        assert (found.status != 0).tolist() == [False, True, False], kind
        assert np.isnan(found["end"].values[1])
        assert found.messages[1], kind


ROUTES = [
    {}, {"workers": 1}, {"compiled": True}, {"compiled": False, "workers": 2}, {"rtol": 1e-6}, {"rtol": 1e-6, "compiled": True},
    {"rtol": 1e-6, "method": "time-stepping"},
]  # fmt: skip
UNKNOWN_COLUMNS = [
    ({"keep": ["x", "powr"]}, r"keep: 'powr' is not there; there are t, x, .*power.*\. Did you mean 'power'\?"),
    ({"outputs": {"end": "multiplier[-1]"}}, r"output 'end': 'multiplier' is not there; .*\. Did you mean 'multipliers'\?"),
    ({"outputs": {"end": "mean(powr)"}}, r"output 'end': 'powr' is not there; .*\. Did you mean 'power'\?"),
]


class NoCells(Executor):
    """Workers that must not be asked."""

    def submit(self, *given, **named):
        raise AssertionError("a cell was run")


@pytest.mark.parametrize("route", ROUTES, ids=str)
def test_a_column_that_runs_do_not_have_is_refused_before_cells_are_run(route, tmp_path):
    model = replace(first_order(box(-1, p)), outputs={"power": x * l})
    for asked, message in UNKNOWN_COLUMNS:
        with pytest.raises(UsageError, match=message):
            sweep(model, grid={p: [0.5, 0.7]}, **asked, **{"workers": NoCells()} | route, out=tmp_path / "never")
    assert not (tmp_path / "never").exists()
    found = sweep(model, grid={p: [0.5, 0.7]}, keep=["power", "y"], outputs={"end": "multipliers[-1]"}, **route)
    assert not found.failures


def test_columns_are_those_of_the_first_cell_that_can_begin():
    model = first_order(box(-1, p))
    with pytest.raises(UsageError, match="keep: 'z' is not there"):
        sweep(model, grid={p: [-2.0, 0.5]}, keep="z", workers=NoCells())
    assert sweep(model, grid={p: [-2.0, 0.5]}, keep="y", workers=1).cells["status"].tolist() == [3, 0]


def test_a_derivative_of_no_column_is_refused_before_cells_are_run():
    with pytest.raises(UsageError, match=r"keep: 'z' is not there; there are t, x"):
        sweep(first_order(box(-1, p)), grid={p: [0.5, 0.7]}, keep="z by p", rtol=1e-6, workers=NoCells())
