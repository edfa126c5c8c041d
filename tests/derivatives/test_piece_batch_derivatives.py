"""Derivatives of cells that run together in C: beside closed forms, known digits, and those of single runs."""

from __future__ import annotations

import math
from typing import Any

import casadi as ca
import numpy as np
import pytest
from derivative_models import made
from fuzz_models import COUNT
from test_exact_scenes import friction, relay_oscillator

import nsmodel
from nsmodel import (
    FirstOrderSystem,
    LureSystem,
    NsmodelError,
    SweepingProcess,
    UsageError,
    complementarity,
    pwm,
    relay,
    sensitivity,
)
from nsmodel.codegen.event_driven_batch import PieceBatch
from nsmodel.errors import CodegenError
from nsmodel.sweep.request import ALONE_BACKEND, CELL_BACKENDS, PIECES_BACKEND

SAME = 1e-11
IN_C = CELL_BACKENDS.index(PIECES_BACKEND)
P, Q = ca.SX.sym("p"), ca.SX.sym("q")


def one_cell(model: Any, by: list[str], times: list[float], rtol: float, column: str = "x") -> tuple[Any, np.ndarray]:
    """A sweep of one cell at the declared values, and its derivatives (rows, n, q)."""
    name = next(iter(model.parameters))
    swept = nsmodel.sweep(
        model, samples={name: [float(model.parameters[name])]}, keep=[column, *(f"{column} by {one}" for one in by)],
        times=times, rtol=rtol, compiled=True,
    )  # fmt: skip
    return swept, np.stack([np.asarray(swept.cells[f"{column} by {one}"])[0] for one in by], axis=-1)


@pytest.mark.parametrize("rtol", [1e-4, 1e-8, 1e-12])
def test_known_digits(rtol):
    """The friction oscillator and the relay oscillator, to all digits that the references have."""
    scenes = [
        (friction(), ["a", "k", "x(0)"], (-1.85098655639, 7.36480113570, 0.283662185463)),
        (relay_oscillator(), ["x_1(0)", "k", "d"], (0.3764709968146, -0.3748396289869, 0.2857269715732)),
    ]
    for model, by, exact in scenes:
        swept, found = one_cell(model, by, [model.t_end], rtol)
        assert swept.cells["way"][0] == IN_C
        np.testing.assert_allclose(found[0, 0], exact, rtol=0, atol=max(rtol, 2e-11) * np.abs(exact).max())


@pytest.mark.parametrize("seed", range(max(1, COUNT // 12)))
@pytest.mark.parametrize("kind", ["lure", "oscillator", "first", "sweeping", "inclusion"])
def test_a_cell_has_the_derivatives_of_its_single_run(kind, seed):
    model, by = made(kind, seed)
    times = np.linspace(0, float(model.t_end), 4).tolist()
    swept, found = one_cell(model, by, times, 1e-10)
    alone = sensitivity(model, by=by, at=times[1:], rtol=1e-10)
    own = alone.jacobian[:, : len(model.names)]
    assert np.abs(found[1:] - own).max() <= SAME * np.abs(own).max()
    plain = nsmodel.sweep(
        model, samples={"a": [float(model.parameters["a"])]}, keep=["x"], times=times, rtol=1e-10, compiled=True
    )
    np.testing.assert_array_equal(swept.cells["x"], plain.cells["x"])


def test_a_run_that_rests_has_derivatives_that_move():
    """x' = -100 (x - 1) at x = 1: dx/dx(0) = exp(-150) at t = 1.5, by the one piece of the run."""
    model = LureSystem(A=[[-100]], B=[0], C=[0], D=[1], f=[100], law=relay(1, -P, P), x0=[1.0], parameters={P: 1.0}, t_end=1.5)
    _, found = one_cell(model, ["x(0)"], [1.5], 1e-8)
    np.testing.assert_allclose(found.item(), math.exp(-150), rtol=1e-11)


def test_many_crossings_and_multipliers():
    """x' in 2 - p Sgn x from q: x(2) = (2 - p) (2 + q/(2 + p)), in 500 cells, at a row and by a reduction of it."""
    model = LureSystem(A=[[0]], B=[1], C=[1], f=[2], law=relay(1, -P, P), x0=[Q], parameters={P: 1.0, Q: -1.0}, t_end=2.0)
    rng = np.random.default_rng(0)
    p, q = rng.uniform(0.5, 1.5, 500), rng.uniform(-1.5, -0.5, 500)
    swept = nsmodel.sweep(
        model, samples={"p": p, "q": q}, keep=["x by p", "l_0 by p"], outputs={"dq": "x by q[-1]"}, times=[0, 2.0], rtol=1e-8,
        compiled=True,
    )  # fmt: skip
    assert (swept.cells["way"] == IN_C).all()
    x_by_p = -(2 + q / (2 + p)) - (2 - p) * q / (2 + p) ** 2
    np.testing.assert_allclose(np.asarray(swept.cells["x by p"])[:, 1, 0], x_by_p, rtol=0, atol=1e-13)
    np.testing.assert_allclose(np.asarray(swept.cells["dq"]), (2 - p) / (2 + p), rtol=0, atol=1e-13)
    np.testing.assert_allclose(np.asarray(swept.cells["l_0 by p"])[:, 1], -1.0, rtol=0, atol=1e-13)


def test_a_start_on_a_slide_is_forgotten():
    """x' in p - Sgn(x - y), y' = 0.1 from x = y = 0: the row is held from the start on, and x is y, whatever x(0) is."""
    model = LureSystem(
        A=[[0, 0], [0, 0]], B=[1, 0], C=[1, -1], f=[P, 0.1], law=relay(1), x0=[0, 0], parameters={P: 0.5}, t_end=2.0
    )
    _, found = one_cell(model, ["x_0(0)", "x_1(0)", "p"], [0.0, 2.0], 1e-8)
    np.testing.assert_allclose(found[:, 0], [[0, 1, 0], [0, 1, 0]], atol=1e-14)


def test_circuits_whose_rows_are_held_in_two_ways():
    """Diodes with and without a resistor in series: rows of index 1 and 2 in one mode."""
    t = ca.SX.sym("t")
    model = LureSystem(A=[[-0.1, 0.4], [-0.5, -P]], B=[[1, 0], [0.2, 1]], C=[[1, 0], [0, 1]], D=[[0, 0], [0, Q]],
                       f=[-ca.sin(t), ca.cos(2 * t)], t=t, law=complementarity(2), x0=[0.5, 0.3], parameters={P: 0.2, Q: 0.3},
                       t_end=8.0)  # fmt: skip
    by = ["p", "q", "x_1(0)"]
    swept, found = one_cell(model, by, [3.0, 5.0, 8.0], 1e-10)
    alone = sensitivity(model, by=by, at=[3.0, 5.0, 8.0], rtol=1e-10)
    assert swept.cells["way"][0] == IN_C
    assert len(alone.switches) > 4
    assert np.abs(found - alone.jacobian).max() <= SAME * np.abs(alone.jacobian).max()


def test_edges_of_inputs_and_a_column_of_the_models_own():
    """By a parameter, between edges that stay where they are: an output, a vector, and a start that a parameter gives."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    model = LureSystem(x=x, A=[[0, 1], [-P, -0.2]], B=[0, 1], C=[0, 1], f=[0, u], law=relay(1, -0.3, 0.3), x0=[P, 1],
                       inputs={u: pwm(0.9, 0.4)}, parameters={P: 1.0}, outputs={"square": P * x[0] ** 2}, t_end=4.0)  # fmt: skip
    _, found = one_cell(model, ["p"], [1.0, 2.5, 4.0], 1e-10)
    _, square = one_cell(model, ["p"], [1.0, 2.5, 4.0], 1e-10, "square")
    alone = sensitivity(model, by=["p"], at=[1.0, 2.5, 4.0], outputs=["x_0", "x_1", "square"], rtol=1e-10)
    np.testing.assert_allclose(found, alone.jacobian[:, :2], rtol=0, atol=SAME)
    np.testing.assert_allclose(square[:, 0], alone.jacobian[:, 2, 0], rtol=0, atol=SAME)


def test_cells_that_c_leaves_are_differentiated_alone():
    """A state that jumps at an edge; two switches at one time that move apart; but not a switch that is touched."""
    alone = CELL_BACKENDS.index(ALONE_BACKEND)
    u, q = ca.SX.sym("u"), ca.SX.sym("q")
    pushed = SweepingProcess(q=q, f=[-P], constraints={"wall": q - u}, q0=[1.0], parameters={P: 0.2},
                             inputs={u: nsmodel.table([0, 1.0], [0.0, 1.5])}, t_end=2.0)  # fmt: skip
    swept, found = one_cell(pushed, ["p"], [0.5, 2.0], 1e-8, "q")
    assert (swept.cells["status"][0], swept.cells["way"][0]) == (0, alone)
    np.testing.assert_allclose(found.ravel(), [-0.5, 0.0], atol=1e-12)
    x = ca.SX.sym("x", 3)
    apart = FirstOrderSystem(
        x=x, f=[1, 1, ca.fabs(x[0] - P) + ca.fabs(x[1] - 2 + P)], x0=[0, 0, 0], parameters={P: 1.0}, t_end=2.0
    )
    swept, found = one_cell(apart, ["p"], [2.0], 1e-8)
    assert (swept.cells["status"][0], swept.cells["way"][0]) == (0, alone)
    np.testing.assert_allclose(found.ravel(), [0, 0, 0], atol=1e-12)
    touched = FirstOrderSystem(x=x[:2], f=[1, ca.fabs((x[0] - P) ** 2)], x0=[0, 0], parameters={P: 1.0}, t_end=2.0)
    swept, found = one_cell(touched, ["p"], [2.0], 1e-8)
    assert swept.cells["status"][0] == 0
    np.testing.assert_allclose(found.ravel(), [0, 0], atol=1e-8)


def test_the_same_columns_where_each_runs_alone():
    """Shapes and values of vectors, numbers, starts and numbers of signals do not depend on how cells are run."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    model = LureSystem(x=x, A=[[0, 1], [-P, -0.2]], B=[0, 1], C=[0, 1], f=[0, u], law=relay(1, -0.3, 0.3), x0=[P, 1],
                       inputs={u: pwm(0.9, 0.4)}, parameters={P: 1.0}, t_end=2.0)  # fmt: skip
    names = ["x by p", "x_1 by x_0(0)", "y by p"]
    together, alone = (
        nsmodel.sweep(model, grid={"p": [0.9, 1.1]}, keep=names, times=[0, 1.0, 2.0], rtol=1e-9, compiled=compiled)
        for compiled in (True, False)
    )
    for name in names:
        assert np.asarray(together.cells[name]).shape == np.asarray(alone.cells[name]).shape
        np.testing.assert_allclose(together.cells[name], alone.cells[name], rtol=0, atol=1e-10)
    by_duty = nsmodel.sweep(model, grid={"p": [0.9]}, keep=["x by u.duty"], times=[2.0], rtol=1e-9)
    expected = sensitivity(model, by=["u.duty"], at=[2.0], rtol=1e-9, parameters={"p": 0.9})
    np.testing.assert_allclose(np.asarray(by_duty.cells["x by u.duty"])[0, 0], expected.jacobian[0, :, 0], rtol=1e-12)


def test_sweeps_of_one_model_that_keep_other_derivatives():
    """The library of one is not taken for another."""
    model = LureSystem(A=[[0]], B=[1], C=[1], f=[2], law=relay(1, -P, P), x0=[Q], parameters={P: 1.0, Q: -1.0}, t_end=2.0)
    given: dict[str, Any] = {"samples": {"p": [1.0, 1.2], "q": [-1.0, -1.2]}, "times": [2.0], "rtol": 1e-8, "compiled": True}
    for names in (["x"], ["x by p"], ["x by q"], ["x by q", "x by p"]):
        swept = nsmodel.sweep(model, keep=names, **given)
        assert (swept.cells["way"] == IN_C).all()
        exact = {"x": 5 / 3, "x by p": -14 / 9, "x by q": 1 / 3}
        for name in names:
            np.testing.assert_allclose(np.asarray(swept.cells[name])[0, 0, 0], exact[name], rtol=1e-12)


def test_a_folder_goes_on_with_the_same_fixed_values_alone(tmp_path):
    """What runs are differentiated by and does not vary is a setting: another number, or another start, is refused."""
    given: dict[str, Any] = {"grid": {"p": [1.0, 1.2]}, "keep": ["x by q", "x by x(0)"], "times": [2.0], "rtol": 1e-8}

    def model(start: float) -> LureSystem:
        return LureSystem(A=[[-1]], B=[1], C=[1], f=[Q], law=relay(1, -P, P), x0=[start], parameters={P: 1.0, Q: 2.0}, t_end=2.0)

    nsmodel.sweep(model(1.0), out=tmp_path / "kept", **given)
    nsmodel.sweep(model(1.0), out=tmp_path / "kept", resume=True, **given)
    for other, numbers in ((model(1.0), {"q": 3.0}), (model(1.5), {"q": 2.0})):
        with pytest.raises(NsmodelError, match="fixed values of what derivatives are by"):
            nsmodel.sweep(other, parameters=numbers, out=tmp_path / "kept", resume=True, **given)


def test_rows_on_edges_and_at_the_start_are_the_same_in_both_ways():
    """At an edge a row has the values before it, and so have its derivatives; where a row has no value it has none."""
    u = ca.SX.sym("u")
    model = LureSystem(A=[[0, 1], [-P, -0.2]], B=[0, 1], C=[0, 1], f=[0, u], law=complementarity(1), D=[0.5], x0=[P, 1],
                       inputs={u: pwm(1.0, 0.5)}, parameters={P: 1.0}, t_end=4.0)  # fmt: skip
    names = ["x by p", "y by p", "l_0 by p", "l_0 by x_1(0)"]
    given: dict[str, Any] = {"grid": {"p": [0.9, 1.1]}, "times": [0, 0.5, 1.0, 1.5, 2.25], "rtol": 1e-10}
    together, alone = (nsmodel.sweep(model, keep=names, compiled=compiled, **given) for compiled in (True, False))
    assert (together.cells["way"] == IN_C).all()
    for name in names:
        np.testing.assert_allclose(together.cells[name], alone.cells[name], rtol=0, atol=1e-10, err_msg=name)
    assert np.isnan(together.cells["l_0 by p"][:, 0]).all()


def test_bad_input():
    model = LureSystem(A=[[0]], B=[1], C=[1], f=[2], law=relay(1, -P, P), x0=[Q], parameters={P: 1.0, Q: -1.0}, t_end=2.0)
    given: dict[str, Any] = {"grid": {"p": [1.0, 1.2]}, "times": [2.0], "rtol": 1e-8}
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"keep": ["x by w"]}, "by: 'w' is not a parameter, start or number"),
        ({"keep": ["z by p"]}, "keep: 'z' is not there; there are t, x"),
        ({"keep": ["x by p"], "rtol": None, "times": None}, "'x by p' is a derivative, which event-driven runs have: give rtol"),
        ({"keep": ["x by p"], "method": "time-stepping", "times": None}, "'x by p' is a derivative"),
    ]
    for more, message in wrong:
        with pytest.raises(UsageError, match=message):
            nsmodel.sweep(model, **{**given, **more})
    with pytest.raises(UsageError, match="by: 'w' is not a parameter; there are p, q"):
        PieceBatch(model, None, 1e-8, None, [2.0], by=["w"])
    twice = PieceBatch(model, None, 1e-8, None, [2.0], by=["p", "p"]).run(np.array([[1.0, -1.0]]), ["x by p"])
    np.testing.assert_allclose(twice.arrays["x by p"].item(), -14 / 9, rtol=1e-12)
    wide = LureSystem(A=-np.eye(33), B=np.zeros((33, 1)), C=np.zeros((1, 33)), D=[1], f=[P] * 33, law=relay(1), x0=[1] * 33,
                      parameters={P: 1.0}, t_end=1.0)  # fmt: skip
    with pytest.raises(CodegenError, match="33 states or rows are more than the 32"):
        PieceBatch(wide, None, 1e-8, None, [1.0], by=["p"])
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l", 2)
    ball = FirstOrderSystem(x=x, lam=l, f=[P, 0], g=l, h=x, law=nsmodel.ball(2, 1.0), x0=[1, 1], parameters={P: 1.0}, t_end=1.0)
    with pytest.raises((CodegenError, NsmodelError), match="law"):
        PieceBatch(ball, None, 1e-8, None, [1.0], by=["p"])
    none = PieceBatch(model, None, 1e-8, None, [0.0, 2.0], by=["p"]).run(np.zeros((0, 2)), ["x", "x by p"])
    assert none.arrays["x by p"].shape == (0, 2, 1)
