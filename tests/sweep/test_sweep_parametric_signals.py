"""Sweeps over parameters that edges of signals move with: each cell has the edges of its own values."""

import shutil

import casadi as ca
import numpy as np
import pytest

from nsmodel import LureSystem, StorageError, complementarity, pwm, sensitivity, simulate, sweep
from nsmodel.codegen.batch import StepBatch
from nsmodel.codegen.event_driven_batch import PieceBatch
from nsmodel.errors import CodegenError
from nsmodel.modeling.time_grid import make_grid

F, G, U = (ca.SX.sym(name) for name in ("f", "g", "u"))
T = 1e-5
FREQUENCIES = np.array([0.7e5, 1e5, 1.3e5])


def buck(signal, parameters):
    return LureSystem(
        A=[[0, -1e4], [1 / 47e-6, -G / 47e-6]], B=[1e4, 0], C=[1, 0], f=[24e4 * U, 0], law=complementarity(1), x0=[0, 0],
        names=["i", "v"], inputs={U: signal}, parameters=parameters, t_end=6 * T, step=T / 20, theta=0.5,
    )  # fmt: skip


def swept(**options):
    return sweep(buck(pwm(1 / F, 0.4), {F: 1e5, G: 0.2}), **options)


@pytest.mark.parametrize("options", [{}, {"rtol": 1e-9}, {"compiled": False}])
@pytest.mark.parametrize("workers", [1, 2])
def test_a_cell_is_the_run_of_its_numbers(options, workers):
    found = swept(grid={"f": FREQUENCIES, "g": [0.1, 0.2]}, outputs={"end": "v[-1]"}, workers=workers, **options)
    assert "the edges of 'u' move with its parameters" in found.metadata["plan"] or options.get("compiled") is False
    for i, f in enumerate(FREQUENCIES):
        for j, g in enumerate((0.1, 0.2)):
            run = simulate(buck(pwm(1 / f, 0.4), {G: g}), **options)
            np.testing.assert_allclose(found.end.values[i, j], run.v[-1], rtol=1e-11)


@pytest.mark.parametrize("options", [{}, {"rtol": 1e-9}])
def test_rows_of_cells_are_at_the_same_times(options):
    found = swept(grid={"f": FREQUENCIES}, keep=["x", "l_0"], **options)
    assert not np.isnan(found.x.values).any()
    for i, f in enumerate(FREQUENCIES):
        run = simulate(buck(pwm(1 / f, 0.4), {G: 0.2}), **options)
        times = np.minimum(np.linspace(0, 6 * T, found.x.values.shape[1]), run.t[-1])
        np.testing.assert_allclose(found.x.values[i], run.at(times).x, rtol=1e-9, atol=1e-9)


def test_derivatives_as_columns():
    found = swept(grid={"f": FREQUENCIES}, keep=["x by f"], outputs={"slope": "v by f[-1]", "other": "v by g[-1]"}, rtol=1e-9)
    for i, f in enumerate(FREQUENCIES):
        alone = sensitivity(buck(pwm(1 / F, 0.4), {F: f, G: 0.2}), by=["f", "g"], rtol=1e-9).jacobian[0]
        np.testing.assert_allclose([found.slope.values[i], found.other.values[i]], alone[1], rtol=1e-11)
        np.testing.assert_allclose(found["x by f"].values[i][-1], alone[:, 0], rtol=1e-11)


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")
def test_what_varies_elsewhere_goes_together():
    """Where the parameter of the signal is the same for all cells, it is a number of the library."""
    found = swept(grid={"g": np.linspace(0.1, 0.3, 5)}, outputs={"end": "v[-1]"}, compiled=True, parameters={"f": 1.3e5})
    assert "one library for all values" in found.metadata["plan"]
    run = simulate(buck(pwm(1 / 1.3e5, 0.4), {G: 0.2}), compiled=False)
    np.testing.assert_allclose(found.end.values[2], run.v[-1], rtol=1e-11)


def test_batches_refuse_what_moves():
    model = buck(pwm(1 / F, 0.4), {F: 1e5, G: 0.2})
    with pytest.raises(CodegenError, match="signal of input 'u' moves with f, and code has no signals"):
        PieceBatch(model, None, 1e-8, None, [T])
    with pytest.raises(CodegenError, match="signal of input 'u' moves with f, and code has no signals"):
        StepBatch(model, make_grid(model, None, None, None), 1e-9)


def test_a_folder_knows_the_expression(tmp_path):
    swept(grid={"f": FREQUENCIES}, outputs={"end": "v[-1]"}, out=tmp_path / "s")
    other = buck(pwm(1 / (2 * F), 0.4), {F: 1e5, G: 0.2})
    with pytest.raises(StorageError, match="differs in inputs"):
        sweep(other, grid={"f": FREQUENCIES}, outputs={"end": "v[-1]"}, out=tmp_path / "s", resume=True)


def test_a_cell_whose_number_is_none_is_refused_alone():
    found = swept(grid={"f": [-1.0, 1e5]}, outputs={"end": "v[-1]"})
    assert np.isnan(found.end.values).tolist() == [True, False]
    assert "period = -1; expected a time > 0" in found.messages[0]


@pytest.mark.parametrize("column", ["newton", "u", "index_set", "residual", "step"])
def test_columns_that_have_no_value_between_rows_are_those_of_the_step(column):
    found = sweep(buck(pwm(1 / F, 0.4), {F: 2.3, G: 0.2}), grid={"f": FREQUENCIES}, keep=[column])
    for i, f in enumerate(FREQUENCIES):
        run = simulate(buck(pwm(1 / F, 0.4), {F: f, G: 0.2}))
        times = np.linspace(0, run.t[-1], found[column].values.shape[1])
        rows = [int(np.flatnonzero(run.t >= t * (1 - 1e-12))[0]) for t in times]
        np.testing.assert_array_equal(np.squeeze(found[column].values[i]), np.squeeze(run[column][rows]))
