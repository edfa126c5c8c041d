"""A trajectory gives its arrays under the user's names, in files and as a table."""

import copy
import csv
import dataclasses
import json
import pickle
import sys

import casadi as ca
import numpy as np
import pytest

from nsmodel import Contact, FirstOrderSystem, LureSystem, MechanicalSystem, relay, simulate, sweep
from nsmodel.codegen import library
from nsmodel.errors import MissingExtraError, StorageError, UsageError
from nsmodel.files.archive import write_npz
from nsmodel.plot import displays
from nsmodel.simulation.run_data import multiplier_names, state_names, units_of
from nsmodel.simulation.trajectory import Trajectory


def make_run(n=10, **metadata):
    """Make a sweeping run of n steps: q (2 columns), z (scalar), three constraints; the disc closes at step 4."""
    rows, k = n + 1, np.arange(n + 1)
    residual = np.where(k == 0, np.nan, 1e-12 / (1 + (k - 6.0) ** 2))
    index_set = np.full((rows, 3), -1, dtype=np.int8)
    index_set[4:, 0] = 0
    index_set[0] = -2
    multipliers = np.where(k[:, None] >= 4, [0.5, 0.0, 0.0], 0.0)
    y = np.maximum(4 - k, 0)[:, None] * [1.0, 2.0, 3.0]
    multipliers[0] = y[0] = np.nan
    arrays = {
        "t": k * 0.1,
        "x": np.column_stack([k - 2.0, 0.1 * k, -k]),
        "multipliers": multipliers,
        "y": y,
        "index_set": index_set,
        "residual": residual,
        "step": np.where(k == 0, np.nan, 0.1),
        "gap": y + 0.25,
        "reactions": multipliers / 0.1,
        "energy": 1 / (1.0 + k),
        "newton": np.where(k == 0, 0, 1 + k % 3),
    }
    about = {
        "title": "A point carried past a fixed disc",
        "model_class": "SweepingProcess",
        "scheme": "prediction-correction",
        "status": "done",
        "stems": {"q": [0, 1], "z": [2]},
        "state_names": ["q_0", "q_1", "z"],
        "multiplier_names": ["disc", "wall[0]", "wall[1]"],
        "units": {"t": "s", "q": "m", "z": "rad", "disc": "N s"},
        "solver_counts": {"qpoases": 3, "last index set": 4990},
        "parameters": {"r": 1.5, "limit": float("inf")},
        "warnings": [],
    }
    return Trajectory(arrays, about | metadata)


def make_bare(n=3):
    """Make a run with time and two states alone."""
    return Trajectory({"t": np.arange(n + 1.0), "x": np.ones((n + 1, 2))}, {})


@pytest.fixture(name="run")
def make_run_fixture():
    return make_run()


# attributes


@pytest.mark.parametrize("name", ["t", "x", "multipliers", "y", "index_set", "residual", "step", "energy", "gap"])
def test_arrays_are_attributes(run, name):
    assert getattr(run, name) is run.arrays[name]


def test_states_by_symbol_and_by_name(run):
    np.testing.assert_array_equal(run.q, run.x[:, :2])
    np.testing.assert_array_equal(run.z, run.x[:, 2])
    np.testing.assert_array_equal(run.q_1, run.x[:, 1])
    assert run.q.shape == (11, 2)
    assert run.z.shape == (11,)
    assert {"q", "q_1", "z", "energy", "save"} <= set(dir(run))


def test_status_title_active_length_and_repr(run):
    assert (run.status, run.title, len(run)) == ("done", "A point carried past a fixed disc", 10)
    np.testing.assert_array_equal(run.active[:, 0], np.arange(11) >= 4)
    assert repr(run) == ("Trajectory('A point carried past a fixed disc', SweepingProcess, 10 steps, t = 0 to 1, done)")
    assert repr(make_bare()) == "Trajectory('untitled', model, 3 steps, t = 0 to 3, unknown)"


def test_any_column_by_its_name():
    """States, symbols of several, multipliers with names of words, arrays, outputs; other keys are refused."""
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l")
    model = FirstOrderSystem(x=x, lam=l, f=[x[1], -x[0]], g=[0, l], h=x[1], law=relay(1), x0=[1, 0], t_end=1.0, step=0.1,
                             names=["position", "speed"], outputs={"power": l * x[1]})  # fmt: skip
    run = simulate(model)
    for name, expected in {"position": run.x[:, 0], "x": run.x, "l_0": run.multipliers[:, 0], "residual": run.residual}.items():
        np.testing.assert_array_equal(run[name], expected)
    np.testing.assert_array_equal(run["power"], run.multipliers[:, 0] * run.x[:, 1])
    with pytest.raises(UsageError, match=r"'positon' is not there; .*Did you mean 'position'"):
        run["positon"]
    with pytest.raises(UsageError, match=r"run\[0\]: expected the name of a column"):
        run[0]
    with pytest.raises(TypeError):
        iter(run)


def test_unknown_attribute_lists_what_there_is(run):
    with pytest.raises(AttributeError, match=r"this run has no 'velocity'; it has q, z, q_0, q_1, t, x, multipliers"):
        _ = run.velocity
    with pytest.raises(AttributeError, match=r"this run has no 'residual'; it has t, x"):
        _ = make_bare().residual


def test_trajectory_is_frozen(run):
    with pytest.raises(dataclasses.FrozenInstanceError, match="cannot assign to field 'arrays'"):
        run.arrays = {}


@pytest.mark.parametrize("twin", [copy.copy, copy.deepcopy, lambda run: pickle.loads(pickle.dumps(run))])
def test_copies_work(run, twin):
    other = twin(run)
    np.testing.assert_array_equal(other.q, run.q)
    assert other.metadata == run.metadata


def test_empty_instance_has_no_attributes():
    with pytest.raises(AttributeError, match="arrays"):
        _ = Trajectory.__new__(Trajectory).arrays


def test_multiplier_by_name(run):
    np.testing.assert_array_equal(run.multiplier("disc"), run.multipliers[:, 0])
    np.testing.assert_array_equal(run.multiplier("wall[1]"), run.multipliers[:, 2])
    np.testing.assert_array_equal(run.multiplier("wall"), run.multipliers[:, 1:])
    with pytest.raises(UsageError, match=r"no multiplier is called 'wal'; this run has disc, wall\[0\], wall\[1\]"):
        run.multiplier("wal")
    np.testing.assert_array_equal(run.disc, run.multipliers[:, 0])
    np.testing.assert_array_equal(run.wall, run.multipliers[:, 1:])
    assert {"disc", "wall"} <= set(dir(run))
    with pytest.raises(AttributeError, match=r"has no 'wal'; it has .*, disc, wall. Did you mean 'wall'"):
        run.wal  # noqa: B018
    with pytest.raises(UsageError, match=r"no multiplier is called 'l_0'; this run has none"):
        make_bare().multiplier("l_0")


def test_names_and_units(run):
    assert state_names(run) == ["q_0", "q_1", "z"]
    assert state_names(make_bare()) == ["x_0", "x_1"]
    assert multiplier_names(make_run(multiplier_names=None)) == ["l_0", "l_1", "l_2"]
    assert units_of(run) == {"t": "s", "q": "m", "q_0": "m", "q_1": "m", "z": "rad", "disc": "N s"}
    units = units_of(make_run(units={"wall": "N", "q_0": "mm", "q": "m"}))
    assert (units["wall[1]"], units["q_0"], units["q_1"]) == ("N", "mm", "m")
    assert units_of(make_bare()) == {}


# files


def test_save_and_load(run, tmp_path):
    run.save(tmp_path / "a.npz")
    other = Trajectory.load(tmp_path / "a.npz")
    assert list(other.arrays) == list(run.arrays)
    for name, array in run.arrays.items():
        np.testing.assert_array_equal(other.arrays[name], array)
    assert other.metadata == run.metadata
    assert other.summary_text() == run.summary_text()
    other.save(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_load_refuses_other_files(tmp_path):
    write_npz(tmp_path / "a.npz", {"t": np.zeros(2)}, {})
    with pytest.raises(StorageError, match=r"a\.npz holds no array 'x': it is not a trajectory"):
        Trajectory.load(tmp_path / "a.npz")
    with pytest.raises(StorageError, match=r"b\.npz does not exist"):
        Trajectory.load(tmp_path / "b.npz")


def read_csv(path):
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    return header, np.array(rows)


def test_csv(run, tmp_path):
    run.to_csv(tmp_path / "a.csv")
    header, rows = read_csv(tmp_path / "a.csv")
    assert header == [
        *("t", "q_0", "q_1", "z", "multiplier:disc", "multiplier:wall[0]", "multiplier:wall[1]"),
        *("y:disc", "y:wall[0]", "y:wall[1]", "residual", "index_set_0", "index_set_1", "index_set_2", "step"),
        *("gap_0", "gap_1", "gap_2", "reactions_0", "reactions_1", "reactions_2", "energy", "newton"),
    ]
    np.testing.assert_array_equal(rows[:, 10].astype(float), run.residual)
    np.testing.assert_array_equal(rows[:, 2].astype(float), run.q_1)
    assert rows[4, 11] == "0"


def test_csv_without_names_and_with_a_clash(tmp_path):
    run = make_bare()
    run.arrays.update(v=np.zeros((4, 2)), cube=np.zeros((4, 1, 2)), multipliers=np.ones((4, 1)), y=np.ones((4, 2)))
    run.metadata["state_names"] = ["a", "v_0"]
    run.to_csv(tmp_path / "a.csv")
    header, _ = read_csv(tmp_path / "a.csv")
    assert header == "t a v_0 multiplier:l_0 y_0 y_1 array:v_0 v_1 cube_0_0 cube_0_1".split()


def test_csv_with_a_law_of_size_zero(tmp_path):
    run = make_bare()
    run.arrays.update(multipliers=np.zeros((4, 0)), y=np.zeros((4, 0)), index_set=np.zeros((4, 0), dtype=np.int8))
    run.to_csv(tmp_path / "a.csv")
    assert read_csv(tmp_path / "a.csv")[0] == ["t", "x_0", "x_1"]
    assert "index set" not in run.summary_text()


def test_xarray(run):
    pytest.importorskip("xarray")
    data = run.to_xarray()
    assert set(data.coords) == {"time", "multiplier"}
    assert data.sizes["time"] == 11
    np.testing.assert_array_equal(data["q_1"], run.q_1)
    np.testing.assert_array_equal(data["multipliers"].sel(multiplier="disc"), run.multiplier("disc"))
    assert data["multipliers"].dims == data["y"].dims == ("time", "multiplier")
    assert data["index_set"].dims == ("time", "index_set_dim_1")
    assert (data["time"].attrs, data["q_0"].attrs, data["y"].attrs) == ({"units": "s"}, {"units": "m"}, {})
    assert data.attrs["title"] == run.title
    assert json.loads(data.attrs["parameters"]) == {"limit": "inf", "r": 1.5}


def test_xarray_of_a_bare_run_and_names_that_clash():
    pytest.importorskip("xarray")
    run = make_bare()
    run.arrays["v"] = np.zeros((4, 2))
    run.metadata.update(state_names=["v", "time"], steps=3, exact=True)
    data = run.to_xarray()
    assert set(data.data_vars) == {"state:v", "state:time", "v"}
    assert data.attrs["steps"] == 3
    assert data.attrs["exact"] == "true"


def test_xarray_missing(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(MissingExtraError, match=r"xarray is not installed; pip install 'nsmodel\[xarray\]'"):
        run.to_xarray()


def test_plot_forwards_to_the_overview(run, monkeypatch):
    monkeypatch.setattr(displays, "overview", lambda trajectory, **options: (trajectory, options))
    assert run.plot(title="a") == (run, {"title": "a"})


# summary


def test_summary_numbers(run):
    summary = run.summary()
    assert json.loads(json.dumps(summary)) == summary
    assert summary["steps"] == 10
    assert summary["t"] == {"start": 0, "end": 1, "unit": "s"}
    assert summary["step"] == {"min": 0.1, "max": 0.1}
    assert summary["residual"] == {"worst": 1e-12, "t": pytest.approx(0.6), "row": 6}
    assert summary["index_set_changes"] == 1
    assert summary["newton"] == {"mean": 2, "max": 3}
    assert summary["gap_min"] == 0.25
    assert summary["energy"] == {"start": 1, "end": pytest.approx(1 / 11)}
    assert summary["final_state"][2] == {"name": "z", "value": -10, "unit": "rad"}


def test_summary_text(run):
    assert run.summary_text() == (
        "A point carried past a fixed disc\n"
        "  model class     SweepingProcess\n"
        "  scheme          prediction-correction\n"
        "  status          done\n"
        "  steps           10, t = 0 to 1 s\n"
        "  step size       0.1 s\n"
        "  worst residual  1e-12 at t = 0.6 s\n"
        "  index set       changed at 1 step\n"
        "  solver calls    last index set      4990\n"
        "                  qpoases                3\n"
        "  newton          2 iterations a step, at most 3\n"
        "  smallest gap    0.25 of 'disc' at t = 0.4 s\n"
        "  energy          1 at the start, 0.0909091 at the end\n"
        "  final state     q_0   8 m\n"
        "                  q_1   1 m\n"
        "                  z    -10 rad"
    )


def test_unknown_residual_is_the_worst():
    for unknown in (np.nan, np.inf):
        run = make_run()
        run.residual[3] = unknown
        assert run.summary()["residual"]["row"] == 3
        assert "worst residual  inf at t = 0.3 s" in run.summary_text()


def test_smallest_gap_without_gap_array_and_for_other_classes():
    run = make_run()
    del run.arrays["gap"]
    assert run.summary()["gap_min"] == 0
    assert make_run(model_class="LureSystem").summary()["gap_min"] is None


def test_variable_steps_are_given_as_a_range():
    run = make_run()
    run.step[5] = 0.05
    assert "step size       0.05 to 0.1 s" in run.summary_text()


def test_summary_of_bare_and_empty_runs():
    assert make_bare().summary_text() == (
        "untitled\n"
        "  status          unknown\n"
        "  steps           3, t = 0 to 3\n"
        "  step size       1\n"
        "  final state     x_0   1\n"
        "                  x_1   1"
    )
    start = make_run(0)
    assert len(start) == 0
    assert start.summary()["residual"] is None
    assert "steps           0, t = 0 to 0 s" in start.summary_text()


@pytest.mark.parametrize(
    ("found", "lines"),
    [
        (
            {
                "finite": True,
                "n_0": 1234567,
                "t_0": 0.5,
                "margin": 0.1,
                "distance": 0.0,
                "theta_prime_0": 1,
                "reason": "r",
            },
            ["in finite time: at rest from t = 0.5 s on, step 1234567", "r", "theta'(0) = 1, d(0, dg(x)) = 0, margin = 0.1"],
        ),
        (
            {"finite": False, "n_0": None, "t_0": None, "reason": "the limit is on the boundary"},
            ["not shown to be finite", "the limit is on the boundary"],
        ),
    ],
)
def test_convergence_says_when_why_and_by_how_much(found, lines):
    text = make_run(convergence=found).summary_text()
    assert "  convergence     " + ("\n" + " " * 18).join(lines) + "\n" in text


def test_table_is_narrow_and_long_states_are_abbreviated():
    n = 40
    run = Trajectory(
        {"t": np.arange(3.0), "x": np.tile(np.arange(n) / 3e5, (3, 1))},
        {
            "title": "A long title " * 20,
            "state_names": [f"name_{'of_a_thing_' * 12}{i}" if i == 3 else f"x_{i}" for i in range(n)],
            "warnings": ["first warning " * 20, "second"],
            "scheme": "s" * 150,
        },
    )
    lines = run.summary_text().splitlines()
    assert max(map(len, lines)) <= 100
    assert sum("33 more" in line for line in lines) == 1
    assert any(line.split()[:1] == ["x_39"] for line in lines)
    assert lines[-1] == " " * 18 + "second"
    assert len(run.summary()["final_state"]) == n


def test_every_run_has_newton_iterations():
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l")
    affine = LureSystem(A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], law=relay(1), x0=[3, 0], t_end=1, step=0.1)
    curved = FirstOrderSystem(x=x, lam=l, f=[x[1], -ca.sin(x[0])], h=x[1], g=[0, l], law=relay(1), x0=[3, 0], t_end=1, step=0.1)
    for model, least in ((affine, 0), (curved, 1)):
        run = simulate(model, compiled=False)
        assert run.newton.shape == run.t.shape
        assert run.newton[0] == 0
        assert (run.newton[1:] >= least).all()
        assert run.newton.max() == (run.summary()["newton"] or {"max": 0})["max"]
        assert run["newton"].tolist() == run.newton.tolist()
    assert not simulate(affine, compiled=False).newton.any()
    assert not simulate(affine, rtol=1e-6).newton.any()


def test_counts_of_a_run_have_a_largest():
    """Multipliers and residuals have none at the start, where there is no step; what is counted is 0 there."""
    q, v = ca.SX.sym("q", 2), ca.SX.sym("v", 2)
    ball = MechanicalSystem(
        q=q, v=v, M=1, F=[0, -9.81], contacts={"floor": Contact(q[1], e=0.5)}, q0=[0, 0.1], v0=[1, 0], t_end=0.5, step=0.01
    )
    for compiled in (False, "auto"):
        run = simulate(ball, compiled=compiled)
        assert run.acting.max() == 1
        assert run.missed.max() == 0
        assert np.isnan(run.residual[0])


def test_newton_iterations_are_kept_by_sweeps_as_by_runs():
    x, k = ca.SX.sym("x", 2), ca.SX.sym("k")
    model = FirstOrderSystem(x=x, f=[x[1], -k * ca.sin(x[0])], x0=[3, 0], t_end=1, step=0.1, parameters={k: 1.0})
    for compiled in (False, True) if library.compiler() else (False,):
        found = sweep(model, grid={k: [1.0, 2.0]}, keep="newton", every=1, compiled=compiled, workers=1)
        expected = [simulate(model, parameters={k: value}, compiled=compiled).newton for value in (1.0, 2.0)]
        np.testing.assert_array_equal(found["newton"].values, expected)
