"""Sweeps: every cell is the run of its values, failures are data, what is stored depends on the sweep alone."""

import csv
import hashlib
import os
import signal
import subprocess
import sys
import textwrap
import threading

import casadi as ca
import numpy as np
import pytest
from conftest import REPOSITORY
from sweep_models import CLASSES, X0, A, K, crossing, driven, friction, stopped, with_stop

import nsmodel
from nsmodel import (
    LureSystem,
    ModelError,
    StepError,
    StorageError,
    Sweep,
    SweepInterrupted,
    UsageError,
    pwm,
    relay,
    simulate,
    sweep,
)
from nsmodel.modeling.model_files import case_files
from nsmodel.sweep import executor

RNG = np.random.default_rng(5)
SAMPLES = {"a": RNG.uniform(0.3, 0.6, 7), "k": RNG.uniform(0.8, 1.2, 7), "x0": RNG.uniform(0.6, 2, 7)}


def bytes_of(folder):
    return hashlib.sha256((folder / "sweep.npz").read_bytes()).hexdigest()


def at_end(run):
    return float(run.x[-1, 0])


# Cells.


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("name", CLASSES)
def test_a_cell_is_the_run_of_its_values(name, compiled):
    make, keep = CLASSES[name]
    model = make()
    found = sweep(model, samples=SAMPLES, keep=keep, every=7, outputs={"end": f"{keep[0]}[-1]"}, compiled=compiled, workers=1)
    assert (found.status == 0).all()
    assert (found["way"].values == (0 if compiled else 2)).all()
    for i in range(7):
        run = simulate(model, parameters={name: values[i] for name, values in SAMPLES.items()}, save_every=7, compiled=False)
        np.testing.assert_allclose(found.t, run.t, atol=1e-12)
        for kept in keep:
            np.testing.assert_allclose(found[kept].values[i].squeeze(), getattr(run, kept).squeeze(), atol=1e-11, rtol=0)
        assert found["end"].values[i] == found[keep[0]].values[i, -1]
        totals = run.metadata["totals"]
        assert found["steps"].values[i] == totals["steps"]
        assert found["index_set_changes"].values[i] == totals["index_set_changes"]
        assert found["worst_residual"].values[i] <= 1e-9


def test_a_grid_is_a_product_in_the_order_of_its_names():
    found = sweep(
        friction(), grid={K: [0.9, 1.1], "x0": np.linspace(3, 4, 3)}, outputs={"end": "x_1[-1]"}, compiled=True, workers=1
    )
    assert found.dims == ("k", "x0")
    assert found["end"].values.shape == found.shape == (2, 3)
    run = simulate(friction(), parameters={K: 1.1, X0: 3.5}, compiled=False)
    assert found["end"].at(k=1.1, x0=3.5).values == pytest.approx(run.x[-1, 0], abs=1e-11)
    assert found.at(4) == {"k": 1.1, "x0": 3.5}
    assert found["end"].unit == "m"


@pytest.mark.parametrize("options", [{"compiled": True}, {"rtol": 1e-8, "compiled": True}, {"rtol": 1e-8, "compiled": False}])
def test_oscillators_stop_where_the_closed_form_says(options):
    n = 200 if options["compiled"] else 5
    a, k, x0 = RNG.uniform(0.8, 1.5, n), RNG.uniform(0.8, 1.2, n), RNG.uniform(3, 6, n)
    found = sweep(
        friction(t_end=20.0), samples={("a", "k", "x0"): np.column_stack([a, k, x0])}, outputs={"rest": "x_1[-1]"}, **options
    )
    exact, when = stopped(a, k, x0)
    assert (when < 20).all()
    error = np.abs(found["rest"].values - exact)
    assert np.median(error) <= (1e-7 if "rtol" in options else 5e-4)
    if "rtol" in options:
        assert error.max() <= 1e-7
        assert (found["estimate"].values <= 1).all()
        np.testing.assert_array_equal(found["way"].values, 1 if options["compiled"] else 2)


def test_a_cell_can_be_run_again_whole():
    found = sweep(friction(), grid={"k": [0.9, 1.1]}, keep="x_1", compiled=True, workers=1)
    run = found.simulate(1)
    every = len(run) // (len(found.t) - 1)
    np.testing.assert_allclose(run.x[::every, 0], found["x_1"].values[1], atol=1e-11)
    assert len(found.simulate(0, t_end=1.0)) == 100


def test_starts_are_parameters():
    model = friction(x0=[5.3, 0])
    values = np.linspace(3, 6, 5)
    found = sweep(model, start={"x_1": values}, outputs={"end": "x_1[-1]"}, compiled=True, workers=1)
    other = sweep(friction(), grid={"x0": values}, outputs={"end": "x_1[-1]"}, compiled=True, workers=1)
    assert found.dims == ("x_1(0)",)
    np.testing.assert_allclose(found["end"].values, other["end"].values, atol=1e-12)
    along = sweep(model, samples={"k": np.full(5, 1.0)}, start={"x_1": values}, outputs={"end": "x_1[-1]"}, workers=1)
    np.testing.assert_allclose(along["end"].values, other["end"].values, atol=1e-11)
    assert along.at(2)["x_1(0)"] == values[2]


def test_vectors_of_states_and_of_parameters():
    th = ca.SX.sym("th", 2)
    model = LureSystem(
        names=["x_0", "x_1"], A=-ca.diag(th), B=[[0], [0]], C=[[1, 0]], D=1, law=relay(1), x0=[1, 2], parameters={th: [1, 2]},
        t_end=1, step=1e-3,
    )  # fmt: skip
    values = RNG.uniform(0.5, 2, (4, 2))
    found = sweep(model, samples={"th": values}, keep="x", compiled=True, workers=1)
    np.testing.assert_allclose(found["x"].values[:, -1], [1, 2] * np.exp(-values), atol=2e-3)
    assert found["x"].dims == ("sample", "t", "x_entry")


def test_seeds_go_to_the_models_function():
    def make(seed, k=1.0):
        return friction(x0=[3 + seed, 0], parameters={A: 1, K: k})

    found = sweep(make, seeds=[0, 2], grid={"k": [0.9, 1.1]}, outputs={"end": at_end}, workers=1)
    assert found.dims == ("k", "seed")
    run = simulate(make(2, 0.9))
    assert found["end"].at(k=0.9, seed=2).values == pytest.approx(run.x[-1, 0], abs=1e-11)


def test_random_starts_depend_on_a_cells_place_alone():
    def start(rng):
        return {"x_1": rng.uniform(3, 6)}

    def starts(**options):
        found = sweep(friction(x0=[5, 0]), start=start, keep="x_1", workers=1, compiled=True, **options)
        return found["x_1"].values[..., 0]

    few, more = starts(seeds=5), starts(seeds=9)
    np.testing.assert_array_equal(few, more[:5])
    assert len(set(more.tolist())) == 9
    assert not (starts(seeds=5, entropy=1) == few).any()
    both = starts(seeds=5, grid={"k": [0.9, 1.1]})
    assert len(set(both.ravel().tolist())) == 10


def test_steps_are_a_dimension_whose_rows_are_at_the_same_times():
    found = sweep(friction(), step=[0.04, 0.02, 0.01], keep="x_1", parameters={"x0": 4.0}, workers=1)
    for h, x in zip([0.04, 0.02, 0.01], found["x_1"].values, strict=True):
        run = simulate(friction(), parameters={"x0": 4.0}, step=h)
        at = np.searchsorted(run.t, found.t - h / 2)
        np.testing.assert_allclose(run.t[at], found.t, atol=1e-12)
        np.testing.assert_allclose(x, run.x[at, 0], atol=1e-11)
    with pytest.raises(UsageError, match=r"steps 0\.04 and 0\.03 have no common rows"):
        sweep(friction(), step=[0.04, 0.03], keep="x_1")
    assert (sweep(friction(), step=[0.04, 0.03], outputs={"end": "x_1[-1]"}, workers=1).status == 0).all()


def test_inputs_are_a_dimension():
    found = sweep(
        driven(), inputs={"short": {"u": pwm(0.5, 0.3)}, "long": {"u": pwm(0.5, 0.7)}}, grid={"k": [1, 2]}, keep=["i_1", "u"],
        compiled=True, workers=1,
    )  # fmt: skip
    assert found.dims == ("k", "inputs")
    for label, duty in (("short", 0.3), ("long", 0.7)):
        run = simulate(driven(), parameters={"k": 2}, inputs={"u": pwm(0.5, duty)}, compiled=False)
        at = found["i_1"].at(k=2, inputs=label)
        assert at.values[-1] == pytest.approx(run.x[-1, 0], abs=1e-11)


def test_many_bodies_are_swept_over_what_makes_them():
    crowd = case_files()["crowd"]
    found = sweep(crowd, grid={"n": [3, 5]}, seeds=2, outputs={"gap": "min(gap_min)"}, t_end=0.3, workers=1)
    assert found.dims == ("n", "seed")
    assert (found.status == 0).all()
    run = simulate(nsmodel.load(crowd, n=5, seed=1), t_end=0.3)
    assert found["gap"].at(n=5, seed=1).values == run.gap_min.min()


# Failures.


@pytest.mark.parametrize("compiled", [True, "auto"])
def test_a_failed_cell_is_data(compiled):
    found = sweep(with_stop(), grid={"a": [0.5, 0.6, 0.8, 0.9]}, keep="q", outputs={"end": "q[-1]"}, compiled=compiled, workers=1)
    np.testing.assert_array_equal(found.status, [0, 0, 1, 1])
    np.testing.assert_allclose(found["failed_at"].values[2:], np.arcsin(0.7 / np.array([0.8, 0.9])), atol=1.001e-3)
    assert np.isnan(found["failed_at"].values[:2]).all()
    np.testing.assert_allclose(found["end"].values[:2], [0.5, 0.6], atol=1e-6)
    assert np.isnan(found["end"].values[2:]).all()
    q = found["q"].values
    for i, a in enumerate([0.5, 0.6, 0.8, 0.9]):
        there = np.isfinite(q[i])
        assert there.all() == (i < 2)
        np.testing.assert_allclose(q[i][there], np.maximum.accumulate(a * np.sin(found.t))[there], atol=1e-6)
    assert "the constraints leave no point" in found.messages[2]
    assert "2 (0.5 of all; 95 % interval 0.15 to 0.85)" in found.summary_text()
    assert "a = 0.8" in found.summary_text()
    with pytest.raises(StepError, match=r"2 of 4 cells are not done; cell 2 \(a = 0\.8\): .*leave no point"):
        found.raise_failed()


def test_values_that_are_refused_are_cells_too():
    radius = ca.SX.sym("radius")
    model = LureSystem(
        names=["x_1"], A=[[-1]], B=[[1]], C=[[1]], D=0, law=relay(1, -radius, radius), x0=[1],
        parameters={radius: 1}, t_end=1, step=1e-2,
    )  # fmt: skip
    for compiled in (True, False):
        found = sweep(model, grid={"radius": [0.5, -0.5, 1]}, outputs={"end": "x_1[-1]"}, compiled=compiled, workers=1)
        np.testing.assert_array_equal(found.status, [0, 3, 0])
        assert "radius" in found.messages[1] or "lower" in found.messages[1]


def test_models_that_cannot_be_made_are_cells_too():
    def make(n):
        if n < 2:
            raise ModelError(f"n = {n}; expected two or more")
        return crossing()

    found = sweep(make, grid={"n": [1, 2]}, outputs={"end": "x_1[-1]"}, workers=1)
    np.testing.assert_array_equal(found.status, [3, 0])
    assert found.messages == {0: "n = 1; expected two or more"}
    with pytest.raises(ModelError, match="expected two or more"):
        sweep(make, grid={"n": [0, 1]}, outputs={"end": "x_1[-1]"}, workers=1)


# What is stored.


def swept(folder=None, **options):
    given = {"grid": {"k": np.linspace(0.8, 1.2, 12)}, "start": {"x_1": [4.0, 5.0, 6.0]}, "keep": ["x_1"], "every": 30}
    given |= {"outputs": {"end": "x_1[-1]", "swing": "max(v_1)"}, "compiled": True, "workers": 1}
    model = options.pop("model", None) or friction(x0=[5, 0], t_end=6.0)
    return sweep(model, **(given | options), out=folder)


def test_equal_sweeps_are_equal_bytes(tmp_path, monkeypatch):
    whole = swept(tmp_path / "a")
    monkeypatch.setattr(executor, "TARGET_CHUNK_SECONDS", 1e-9)
    swept(tmp_path / "b", workers=3)
    assert bytes_of(tmp_path / "a") == bytes_of(tmp_path / "b")
    monkeypatch.setattr(executor, "TARGET_CHUNK_SECONDS", 1e-3)
    with pytest.raises(SweepInterrupted) as stop:
        interrupted_after(monkeypatch, 2, lambda: swept(tmp_path / "c"))
    assert 0 < (stop.value.result.status == 0).sum() < 36
    assert sorted(path.name for path in (tmp_path / "c").iterdir() if path.name.startswith("part"))
    swept(tmp_path / "c", resume=True)
    assert bytes_of(tmp_path / "a") == bytes_of(tmp_path / "c")
    assert sorted(path.name for path in (tmp_path / "c").iterdir()) == ["design.npz", "manifest.json", "sweep.npz"]
    loaded = Sweep.load(tmp_path / "a")
    for name in loaded.cells:
        np.testing.assert_array_equal(loaded.cells[name], whole.cells[name])
    memory = swept()
    assert list(memory.cells) == list(loaded.cells)
    for name in loaded.cells:
        np.testing.assert_array_equal(loaded.cells[name], memory.cells[name])
    memory.save(tmp_path / "memory.npz")
    assert (tmp_path / "memory.npz").read_bytes() == (tmp_path / "a" / "sweep.npz").read_bytes()


def interrupted_after(monkeypatch, chunks, action):
    """Run an action, and interrupt it when so many chunks are stored."""
    from nsmodel.sweep.store import SweepStore

    put, count = SweepStore.put, []

    def counting(self, cells, found):
        put(self, cells, found)
        count.append(len(cells))
        if len(count) == chunks:
            os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(SweepStore, "put", counting)
        patch.setattr(executor, "TARGET_CHUNK_SECONDS", 1e-9)
        return action()


def test_a_signal_within_a_cell_keeps_the_cells_before(monkeypatch):
    """One process, run by run: the signal meets a run in the middle, and that run alone is lost."""
    from nsmodel.simulation.loop import RunLoop

    advance, runs = RunLoop._advance, []

    def interrupted_in_the_third(loop, bar, signals):
        runs.append(loop)
        if len(runs) == 3:
            os.kill(os.getpid(), signal.SIGINT)
        advance(loop, bar, signals)

    monkeypatch.setattr(RunLoop, "_advance", interrupted_in_the_third)
    monkeypatch.setattr(executor, "TARGET_CHUNK_SECONDS", 1e-9)
    with pytest.raises(SweepInterrupted, match="after 2 of 36 cells") as stop:
        swept(compiled=False)
    assert stop.value.result.summary()["status"] == {"done": 2, "not run": 34}


def test_resuming_a_whole_sweep_runs_nothing(tmp_path, monkeypatch):
    swept(tmp_path / "a")
    before = (tmp_path / "a" / "sweep.npz").read_bytes()
    monkeypatch.setattr(executor, "run_chunk", None)
    found = swept(tmp_path / "a", resume=True)
    assert (found.status == 0).all()
    assert (tmp_path / "a" / "sweep.npz").read_bytes() == before


def test_more_samples_and_seeds_may_be_added(tmp_path):
    def more(n, seeds, folder, **options):
        return sweep(
            lambda seed: friction(x0=[3 + seed, 0], parameters={A: 1, K: 1}), samples={"k": np.linspace(0.8, 1.2, 7)[:n]},
            seeds=seeds, outputs={"end": "x_1[-1]"}, t_end=0.2, workers=1, out=folder, **options,
        )  # fmt: skip

    more(3, 2, tmp_path / "a")
    found = more(7, 4, tmp_path / "a", resume=True)
    fresh = more(7, 4, tmp_path / "b")
    np.testing.assert_array_equal(found["end"].values, fresh["end"].values)
    assert bytes_of(tmp_path / "a") == bytes_of(tmp_path / "b")
    with pytest.raises(StorageError, match="7 values of sample, 3 now"):
        more(3, 4, tmp_path / "a", resume=True)


def test_another_sweep_is_refused_and_nothing_is_overwritten(tmp_path):
    swept(tmp_path / "a")
    before = {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()}
    refused = {
        r"k\[3\] = ": {"grid": {"k": [*np.linspace(0.8, 1.2, 12)[:3], 9, *np.linspace(0.8, 1.2, 12)[4:]]}},
        r"12 values of k, 13 now": {"grid": {"k": np.linspace(0.8, 1.2, 13)}},
        r"differs in columns": {"keep": ["v_1"]},
        r"differs in outputs": {"outputs": {"end": "v_1[-1]", "swing": "max(v_1)"}},
        r"differs in step": {"step": 5e-3},
        r"differs in tolerance": {"tolerance": 1e-8},
        r"differs in way": {"compiled": False},
        r"differs in its model": {"start": None},
    }
    for message, options in refused.items():
        with pytest.raises(StorageError, match=message):
            swept(tmp_path / "a", resume=True, **options)
    with pytest.raises(UsageError, match="holds a sweep; go on with it by resume=True"):
        swept(tmp_path / "a")
    with pytest.raises(StorageError, match="differs in its model"):
        swept(tmp_path / "a", model=friction(x0=[5, 0.1], t_end=6.0), resume=True)
    with pytest.raises(StorageError, match="holds no sweep"):
        swept(tmp_path / "none", resume=True)
    assert {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()} == before


def test_failed_cells_are_run_again_where_that_is_asked_for(tmp_path):
    calls = []

    def end(run):
        calls.append(1)
        return run.q[-1]

    def go(**options):
        return sweep(with_stop(), grid={"a": [0.5, 0.8]}, outputs={"end": end}, workers=1, out=tmp_path, **options)

    go()
    assert len(calls) == 1
    assert go(resume=True, retry=True).status.tolist() == [0, 1]
    assert len(calls) == 1
    with pytest.raises(UsageError, match="resume=True"):
        go(retry=True)


@pytest.mark.long
def test_a_killed_sweep_goes_on(tmp_path):
    script = tmp_path / "go.py"
    script.write_text(textwrap.dedent(f"""
        import sys; sys.path.insert(0, {str(REPOSITORY / "tests")!r})
        from sweep_models import friction
        import numpy as np, nsmodel
        from nsmodel.sweep import executor as work
        work.TARGET_CHUNK_SECONDS = 0.01
        if __name__ == "__main__":
            nsmodel.sweep(friction(t_end=1.0), grid={{"k": np.linspace(0.8, 1.2, 60)}}, outputs={{"end": "x_1[-1]"}},
                          compiled=False, workers=2, out=sys.argv[1], resume="--resume" in sys.argv)
    """))  # fmt: skip
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}

    def go(folder, *more, after=None):
        process = subprocess.Popen([sys.executable, script, folder, *more], env=environment)
        if after is not None:
            while process.poll() is None and len(list(folder.glob("part-*"))) < after:
                threading.Event().wait(0.01)
            process.kill()
        return process.wait()

    sweep(
        friction(t_end=1.0), grid={"k": np.linspace(0.8, 1.2, 60)}, outputs={"end": "x_1[-1]"}, compiled=False, workers=1,
        out=tmp_path / "a",
    )  # fmt: skip
    assert go(tmp_path / "b", after=3) == -signal.SIGKILL
    assert not (tmp_path / "b" / "sweep.npz").exists()
    assert go(tmp_path / "b", "--resume") == 0
    assert bytes_of(tmp_path / "a") == bytes_of(tmp_path / "b")


def test_what_reads_a_sweep(tmp_path):
    found = swept(tmp_path / "a")
    found.to_csv(tmp_path / "cells.csv")
    with (tmp_path / "cells.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 36
    assert float(rows[4]["k"]) == found.at(4)["k"]
    assert float(rows[4]["end"]) == found.cells["end"][4]
    assert rows[4]["status"] == "done"
    data = found.data
    np.testing.assert_array_equal(data["x_1"].sel({"x_1(0)": 5.0}).values, found["x_1"].values[:, 1])
    assert data["x_1"].dims == ("k", "x_1(0)", "t")
    assert data["x_1"].attrs["units"] == "m"
    assert nsmodel.statistics(data["end"], over="k").mean == pytest.approx(nsmodel.statistics(found["end"], over="k").mean)
    xarray = pytest.importorskip("xarray")
    found.to_netcdf(tmp_path / "cells.nc")
    with xarray.open_dataset(tmp_path / "cells.nc") as read:
        np.testing.assert_array_equal(read["end"].values, found["end"].values)
    swept(tmp_path / "cells.zarr")
    read = xarray.open_zarr(tmp_path / "cells.zarr")
    np.testing.assert_array_equal(read["x_1"].values, found["x_1"].values)


def test_a_file_of_a_sweep_is_told_from_others(tmp_path):
    simulate(friction(t_end=1.0)).save(tmp_path / "run.npz")
    with pytest.raises(StorageError, match=r"holds no sweep; a run's file is read with Trajectory\.load"):
        Sweep.load(tmp_path / "run.npz")
    with pytest.raises(StorageError, match="unfinished one; continue it with resume=True"):
        Sweep.load(tmp_path)
    found = swept(tmp_path / "a")
    with pytest.raises(UsageError, match="read from a file has no model"):
        Sweep.load(tmp_path / "a").simulate(0)
    assert len(found.simulate(0)) == 600


# What is asked for wrongly.


def test_wrong_requests(tmp_path):
    end = {"outputs": {"end": "x_1[-1]"}}
    refused = {
        "nothing varies": {},
        "grid and samples are both given": {"grid": {"k": [1, 2]}, "samples": {"a": [1, 2]}},
        r"grid: 'k': no values": {"grid": {"k": []}},
        r"grid = \{\}": {"grid": {}},
        r"grid: 'k' = 3; expected several": {"grid": {"k": 3}},
        r"grid: 'k': nan is not a finite number": {"grid": {"k": [1, np.nan]}},
        r"'kk' is not declared; the model has .*Did you mean 'k'": {"grid": {"kk": [1, 2]}},
        r"'k' has 3 points and 'a' 2|'a' has 2 points and 'k' 3": {"samples": {"k": [1, 2, 3], "a": [1, 2]}},
        r"start: 'y' is not a state; there are x_1, v_1": {"start": {"y": [1, 2]}},
        "does not take seed=": {"seeds": 3},
        r"seeds = \[1, 1\]": {"seeds": [1, 1]},
        r"every = 0; expected a whole number": {"grid": {"k": [1, 2]}, "every": 0},
        "workers = 0; expected": {"grid": {"k": [1, 2]}, "workers": 0},
        "workers = 'two'; expected": {"grid": {"k": [1, 2]}, "workers": "two"},
        "'t' is the name of a dimension|'t' is not declared": {"grid": {"t": [1, 2]}},
        "solver 'none'": {"grid": {"k": [1, 2]}, "solver": "none", "workers": 1},
        "tolerance = 2": {"grid": {"k": [1, 2]}, "tolerance": 2},
        r"t_end = -1": {"grid": {"k": [1, 2]}, "t_end": -1},
        "parameter 'zeta' is not declared": {"grid": {"k": [1, 2]}, "parameters": {"zeta": 3}},
        r"'k' has 2 numbers in each cell; expected one number": {"samples": {"k": [[1, 2], [3, 4]], "a": [1, 2]}},
        r"samples: 'k' has shape \(3,\); expected \(replicates, points\)": {"samples": {"k": [1, 2, 3]}, "replicates": True},
    }
    for message, options in refused.items():
        with pytest.raises(UsageError, match=message):
            sweep(friction(), **(end | options), out=tmp_path / "never")
        assert not (tmp_path / "never").exists()
    outputs = {
        "nothing is kept": {},
        r"'x_1\(-1\)'; expected NAME\[ROW\]|'x_1' is unknown": {"outputs": {"end": "x_1(-1)"}},
        r"'median' is unknown; there are max": {"outputs": {"end": "median(x_1)"}},
        r"output 'end': 3; expected a function": {"outputs": {"end": 3}},
        r"'status' has its own place": {"outputs": {"status": "x_1[-1]"}},
        r"'x_1' is kept twice": {"keep": ["x_1"], "outputs": {"x_1": "x_1[-1]"}},
        r"'x_2' is not there": {"keep": ["x_2"], "workers": 1},
    }
    for message, options in outputs.items():
        with pytest.raises(UsageError, match=message):
            sweep(friction(), grid={"k": [1, 2]}, **options)
    with pytest.raises(UsageError, match="expected a model, the path of a model file, or a function"):
        sweep(3, grid={"k": [1]}, **end)


def test_a_number_in_a_file_is_told_how_to_become_a_parameter(tmp_path):
    path = tmp_path / "own.py"
    path.write_text(textwrap.dedent("""
        from nsmodel import LureSystem, relay
        stiffness = 2.0
        model = LureSystem(
            names=["y_1"], A=[[-stiffness]], B=[[1]], C=[[1]], D=0, law=relay(1), x0=[1], t_end=1, step=0.1)
    """))  # fmt: skip
    with pytest.raises(UsageError, match=r"stiffness = 2 is a number in this file .*parameters=\{stiffness: 2\}"):
        sweep(path, grid={"stiffness": [1, 2]}, outputs={"end": "y_1[-1]"})


def test_an_output_that_fails_names_itself_and_loses_nothing(tmp_path):
    def wrong(run):
        if run.x[0, 0] > 5:
            raise ZeroDivisionError("none of that")
        return 1.0

    with pytest.raises(UsageError, match="output 'end': ZeroDivisionError: none of that"):
        sweep(friction(), grid={"x0": [3, 4, 6]}, outputs={"end": wrong}, t_end=1.0, workers=1, out=tmp_path / "a")
    assert list((tmp_path / "a").glob("part-*"))
    with pytest.raises(UsageError, match="is not a number; a function of a run returns"):
        sweep(friction(), grid={"x0": [3, 4]}, outputs={"end": lambda run: "three"}, t_end=1.0, workers=1)


def test_what_c_does_not_go_on_with_goes_to_processes_and_is_run_again_where_that_is_asked_for(tmp_path):
    def go(workers, folder, **options):
        return sweep(
            with_stop(), grid={"a": [0.5, 0.6, 0.8, 0.9]}, outputs={"end": "q[-1]"}, compiled=True, workers=workers,
            out=tmp_path / folder, **options,
        )  # fmt: skip

    go(1, "a")
    found = go(2, "b")
    assert bytes_of(tmp_path / "a") == bytes_of(tmp_path / "b")
    np.testing.assert_array_equal(found["way"].values, [0, 0, 2, 2])
    again = go(2, "b", resume=True, retry=True)
    np.testing.assert_array_equal(again.status, [0, 0, 1, 1])
    assert "leave no point" in again.messages[3]
    assert bytes_of(tmp_path / "a") == bytes_of(tmp_path / "b")


def test_a_function_that_fails_refuses_its_cells():
    def make(n):
        return crossing() if n != 2 else {}["none"]

    found = sweep(make, grid={"n": [1, 2, 3]}, outputs={"end": "x_1[-1]"}, t_end=0.1, workers=1)
    np.testing.assert_array_equal(found.status, [0, 3, 0])
    assert found.messages == {1: "make() raised KeyError: 'none'"}
    with pytest.raises(UsageError, match="out is empty"):
        sweep(make, grid={"n": [1, 3]}, outputs={"end": "x_1[-1]"}, out="")


def test_rows_of_runs_by_steps_under_error_control():
    """These have no rows at given times: the rows that are kept are read off the runs."""
    options = {"rtol": 1e-5, "method": "time-stepping", "t_end": 1.0}
    found = sweep(friction(), grid={K: [0.5, 2.0]}, keep=["x"], outputs={"end": "x[-1]"}, **options)
    for i, k in enumerate((0.5, 2.0)):
        run = simulate(friction(), parameters={"k": k}, **options)
        np.testing.assert_array_equal(found.end.values[i].ravel(), run.x[-1])
        times = np.linspace(0, 1, found.x.values.shape[1])
        exact = simulate(friction(), parameters={"k": k}, rtol=1e-10, t_end=1.0).at(times).x
        assert np.abs(found.x.values[i].reshape(exact.shape) - exact).max() < 1e-3
