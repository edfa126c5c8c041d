"""The run with halved steps: what it says of the error, whether it is near the truth, where it is kept and drawn."""

import json
import signal
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    SweepingProcess,
    Trajectory,
    complementarity,
    hysteresis,
    load,
    pwm,
    relay,
    sampled,
    simulate,
    steps,
    sweep,
    table,
)
from nsmodel.cli import main
from nsmodel.errors import StepError, StorageError, UsageError
from nsmodel.modeling.time_grid import make_grid
from nsmodel.plot import overview
from nsmodel.plot.html.run_page import run_document
from nsmodel.plot.time import states
from nsmodel.simulation.fixed_grid import FixedGridPropagator
from nsmodel.simulation.loop import RunInterrupted

T, X, U = ca.SX.sym("t"), ca.SX.sym("x"), ca.SX.sym("u")


def ring(n=5, t_end=20.0, step=1e-2):
    x, s = ca.SX.sym("x", n), ca.SX.sym("s", n)
    return FirstOrderSystem(
        x=x, lam=s, f=2 - x, g=[-2 * s[k - 1] for k in range(n)], h=1 - x, law=relay(n, 0, 1),
        x0=[0.2, 0.3, 0.1, 0.5, 0.4][:n], t_end=t_end, step=step, title="Ring of genes",
    )  # fmt: skip


def rectifier():
    return LureSystem(
        A=[[0, -1.0], [1.0, 0]], B=[-1.0, 0], C=[-1, 0], D=1.0, law=complementarity(1), x0=[1, 0], t_end=10, step=1e-2
    )


def oscillator(**given):
    return FrictionOscillator(x=X, potential=X**2 / 2, friction=0.1 * U, s=U, x0=2, v0=0, t_end=10, step=1e-2, **given)


def driven_relay():
    return LureSystem(A=[[-1.0]], B=[-0.5], C=[1.0], law=relay(1), f=[ca.sin(T)], t=T, x0=[1], t_end=10, step=1e-2)


def random_circuit(seed):
    """A passive circuit: x' = (J - R) x - B l + f sin t, y = B' x + D l with diodes or relays."""
    rng = np.random.default_rng(seed)
    n, m = 4, 2
    J, R, B = rng.normal(size=(n, n)), rng.uniform(0.1, 0.5, n), rng.normal(size=(n, m))
    law = complementarity(m) if seed % 2 else relay(m)
    return LureSystem(
        A=J - J.T - np.diag(R), B=B, C=-B.T, D=rng.uniform(0.5, 1) * np.eye(m), law=law, t=T,
        f=[ca.sin(T) * one for one in rng.normal(size=n)], x0=rng.normal(size=n), t_end=10, step=1e-2,
    )  # fmt: skip


MODELS = {
    "ring": ring, "rectifier": rectifier, "oscillator": oscillator, "driven relay": driven_relay,
    **{f"circuit {seed}": lambda seed=seed: random_circuit(seed) for seed in range(6)},
}  # fmt: skip


@pytest.mark.parametrize("name", MODELS)
def test_difference_from_halved_steps_is_near_the_true_error_and_falls_with_the_step(name):
    model = MODELS[name]()
    truth = simulate(model, rtol=1e-10)
    estimates = []
    for h in (2e-2, 5e-3):
        run = simulate(model, step=h, halve=True)
        error, estimate = np.abs(run.x - truth.at(run.t).x).max(), np.abs(run.halving).max()
        assert error / 3 <= estimate <= 3 * error
        estimates.append(estimate)
    assert estimates[1] < 0.6 * estimates[0]


def test_ring_that_is_off_by_a_quarter_of_its_swing_says_so():
    """At t = 40 with h = 1e-2 it is off by 0.43."""
    run = simulate(ring(t_end=40), halve=True)
    worst = run.summary()["halving"][0]
    assert 0.43 / 3 < worst["largest"] < 3 * 0.43
    assert worst["t"] > 35
    text = run.summary_text()
    assert "an estimate of the error, no bound" in text
    assert f"{worst['name']}  {worst['largest']:.3g} at t = {worst['t']:.6g}" in text
    assert "accuracy" not in text


# -- what is compared --------------------------------------------------------------------------------------------------


def test_difference_is_that_of_a_run_with_half_the_step_at_the_same_times():
    run, half = simulate(rectifier(), halve=True), simulate(rectifier(), step=5e-3)
    assert np.array_equal(run.t, half.t[::2])
    assert np.array_equal(run.halving, half.x[::2] - run.x)
    assert np.array_equal(run.x, simulate(rectifier()).x)
    assert set(run.arrays) == {*simulate(rectifier()).arrays, "halving"}


@pytest.mark.parametrize("t_end", [1.0, 1.003, 1.007, 0.01, 0.013])
def test_halved_grid_has_all_times_of_the_grid(t_end):
    grid = make_grid(rectifier(), 1e-2, None, t_end)
    halved = grid.halved()
    times = [halved.time(k) for k in range(halved.N + 1)]
    own = [grid.time(k) for k in range(grid.N + 1)]
    assert set(own[:-1]) <= set(times)
    assert times[-1] == pytest.approx(own[-1], rel=1e-15)
    lengths = np.diff(times)
    assert lengths.max() <= 0.5e-2 * (1 + 1e-12)
    assert lengths.min() > 0
    assert np.allclose(lengths, [halved.step(k) for k in range(halved.N)], rtol=0, atol=1e-15)
    run = simulate(rectifier(), t_end=t_end, halve=True)
    assert np.abs(run.halving).max() < 2e-3
    assert np.abs(run.halving[-1] - run.halving[-2]).max() < 1e-4


def test_steps_that_are_given_and_edges_of_inputs_are_halved_where_they_are():
    given = [0.01, 0.03, 0.02]
    run = simulate(rectifier(), steps=given, halve=True)
    half = simulate(rectifier(), steps=np.repeat(np.array(given) / 2, 2))
    assert np.abs(run.halving - (half.x[::2] - run.x)).max() < 1e-15
    model = LureSystem(
        A=[[-1.0]], B=[0.0], C=[0.0], law=relay(1), f=[U], inputs={U: table([0, 0.333, 0.77], [1.0, -1.0, 2.0])}, x0=[0], t_end=1,
        step=0.1,
    )  # fmt: skip
    run = simulate(model, halve=True)
    own = {0.0, *simulate(model, step=0.1).t}
    assert {0.333, 0.77} <= own
    exact = simulate(model, rtol=1e-12).at(run.t).x
    assert np.abs(run.halving).max() == pytest.approx(np.abs(run.x - exact).max() / 2, rel=0.1)


def test_rows_that_are_saved_are_those_compared():
    every, some = simulate(rectifier(), halve=True), simulate(rectifier(), halve=True, save_every=7)
    rows = np.searchsorted(every.t, some.t)
    assert np.array_equal(some.t, every.t[rows])
    assert np.array_equal(some.halving, every.halving[rows])


def test_edges_that_a_block_places_lie_elsewhere_and_are_compared_by_time():
    x, d = ca.SX.sym("x"), ca.SX.sym("d")
    duty = sampled("duty", period=0.5, outputs={d: 0.7 - 0.3 * x})
    model = FirstOrderSystem(
        x=x, f=[U - x], x0=[0], t_end=4, step=0.05, inputs={U: pwm(0.5, d)}, blocks=[duty], theta=0.5
    )  # fmt: skip
    run, half = simulate(model, halve=True), simulate(model, step=0.025)
    assert not set(run.t) <= set(half.t)
    assert np.abs(run.halving).max() == pytest.approx(np.abs(half.at(run.t).x - run.x).max(), rel=0.5)
    error = np.abs(run.x - simulate(model, rtol=1e-10).at(run.t).x).max()
    assert error / 3 <= np.abs(run.halving).max() <= 3 * error


def thermostat():
    u = ca.SX.sym("u")
    return FirstOrderSystem(
        x=X, f=[u - X], x0=[0], t_end=4, step=1e-2, blocks=[hysteresis(u, X, low=0.3, high=0.6, start=1)]
    )  # fmt: skip


Q, V = ca.SX.sym("q", 2), ca.SX.sym("v", 2)
CLASSES = {
    "FirstOrderSystem": lambda: ring(t_end=1),
    "LureSystem": rectifier,
    "FrictionOscillator": oscillator,
    "SweepingProcess": lambda: SweepingProcess(
        q=Q, f=[1.0, 0.2], constraints={"disc": 1 - ca.sumsqr(Q)}, q0=[0, 0], t_end=2, step=1e-2
    ),
    "MonotoneInclusion": lambda: load("cases/mathematics/obstacle.py"),
    "MechanicalSystem": lambda: load("cases/mechanics/bouncing_ball.py"),
    "memory": thermostat,
}


@pytest.mark.parametrize("kind", CLASSES)
def test_every_class_and_blocks_with_memory(kind):
    model = CLASSES[kind]()
    run = simulate(model, halve=True)
    assert run.halving.shape == run.x.shape
    assert np.isfinite(run.halving).all()
    assert not run.halving[0].any()
    found = run.summary()["halving"]
    assert sorted(one["name"] for one in found) == sorted(run.metadata["state_names"])
    assert found[0]["largest"] == np.abs(run.halving).max() > 0


# -- what is refused, what fails ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"rtol": 1e-6}, "halve (--halve) and rtol are both given"),
        ({"atol": 1e-6}, "halve (--halve) and rtol are both given"),
    ],
)
def test_error_control_is_refused(options, said):
    with pytest.raises(UsageError) as refused:
        simulate(rectifier(), halve=True, **options)
    assert said in str(refused.value)


def test_what_is_bound_to_its_steps_is_refused_before_the_run(monkeypatch):
    monkeypatch.setattr(FixedGridPropagator, "advance", lambda *_: pytest.fail("a step was taken"))
    x1 = FrictionOscillator(x=X, potential=X**2 / 2, friction=0.1 * U, s=U, x0=2, x1=1.99, t_end=1, step=0.1)
    with pytest.raises(UsageError, match="x1 is a position one constant step after x0; with halve give the velocity v0 instead"):
        simulate(x1, halve=True)
    rows = FirstOrderSystem(x=X, f=[U - X], x0=[0], t_end=1, step=0.5, inputs={U: steps([1.0, 2.0])})
    with pytest.raises(UsageError, match=r"input 'u': steps\(...\) has one row for each step, but halve takes twice as many"):
        simulate(rows, halve=True)
    with pytest.raises(UsageError, match="halve = 1; expected True or False"):
        simulate(rectifier(), halve=1)


def test_sweeps_do_not_take_it():
    with pytest.raises(TypeError, match="sweep\\(\\) got an unexpected keyword argument 'halve'"):
        sweep(rectifier(), halve=True)


def stops_when_halved(monkeypatch, error):
    """Let the run with halved steps stop at t = 0.5."""
    usual = FixedGridPropagator.advance

    def advance(self, number, stop):
        if self.grid.h < 0.9e-2 and self.time >= 0.5:
            raise error
        usual(self, number, stop)

    monkeypatch.setattr(FixedGridPropagator, "advance", advance)


def test_halved_steps_that_stop_leave_the_run_and_say_so(monkeypatch):
    stops_when_halved(monkeypatch, StepError("no step"))
    run = simulate(rectifier(), halve=True)
    assert run.status == "done"
    assert run.t[-1] == 10
    known = np.isfinite(run.halving).all(axis=1)
    assert 0 < known.sum() < len(run.t)
    assert known[: known.sum()].all()
    assert "halve: with halved steps the run stops, and the error is not estimated from there on" in run.metadata["warnings"][-1]
    assert all(one["t"] <= run.t[known][-1] for one in run.summary()["halving"])


def test_halved_steps_that_are_interrupted_leave_the_run(monkeypatch):
    usual = FixedGridPropagator.advance

    def advance(self, number, stop):
        usual(self, number, stop)
        if self.grid.h < 0.9e-2:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(FixedGridPropagator, "advance", advance)
    with pytest.raises(RunInterrupted, match="the run is done; the one with halved steps was interrupted") as stopped:
        simulate(rectifier(), halve=True)
    assert stopped.value.trajectory.t[-1] == 10
    assert stopped.value.trajectory.status == "done"


# -- where it is kept and seen -----------------------------------------------------------------------------------------


def test_folder_holds_it_and_goes_on_without_it_or_with_it(tmp_path):
    run = simulate(rectifier(), halve=True, out=tmp_path / "a", t_end=5)
    saved = Trajectory.load(tmp_path / "a" / "trajectory.npz")
    assert np.array_equal(saved.halving, run.halving)
    assert saved.summary() == run.summary()
    longer = simulate(rectifier(), out=tmp_path / "a", resume=True)
    assert "halving" not in longer.arrays
    assert np.array_equal(longer.x, simulate(rectifier()).x)
    again = simulate(rectifier(), halve=True, out=tmp_path / "a", resume=True)
    assert np.array_equal(again.halving, simulate(rectifier(), halve=True).halving)
    assert np.array_equal(Trajectory.load(tmp_path / "a" / "trajectory.npz").halving, again.halving)


def test_file_with_a_narrower_estimate_is_no_run(tmp_path):
    run = simulate(rectifier(), halve=True, t_end=1)
    replace(run, arrays=run.arrays | {"halving": run.halving[:, :1]}).save(tmp_path / "run.npz")
    with pytest.raises(StorageError, match="halving"):
        Trajectory.load(tmp_path / "run.npz")


def test_tables_name_its_columns_by_the_states():
    run = simulate(thermostat(), halve=True)
    assert "halving:x" in run.to_pandas().columns
    assert run.to_xarray()["halving"].dims == ("time", "state")


def test_pictures_have_a_band_and_the_page_a_panel():
    run = simulate(ring(t_end=5), halve=True)
    ax = states(run)
    assert "bands: the difference from halved steps" in ax.get_title(loc="left")
    assert len(ax.collections) == 5
    off = np.abs(run.halving[:, 0])
    path = ax.collections[0].get_paths()[0].vertices
    widest = off.argmax()
    drawn = path[np.isclose(path[:, 0], run.t[widest]), 1]
    assert np.ptp(drawn) == pytest.approx(2 * off[widest])
    assert not states(simulate(ring(t_end=5))).collections
    titles = [panel["title"] for panel in run_document(run)["panels"]]
    assert titles.count("Difference from halved steps") == 1
    assert dict(run_document(run)["facts"])["halved steps"][0].startswith("an estimate of the error, no bound")
    assert overview(run)


def test_run_that_is_not_monotone_points_to_it_and_to_rtol():
    hint = "the error of these steps is not known; halve=True (--halve) estimates it, rtol (--rtol) controls it"
    run = simulate(ring(t_end=1))
    assert run.summary()["monotone"] is False
    assert hint in " ".join(run.summary_text().split())
    for other in (simulate(ring(t_end=1), halve=True), simulate(ring(t_end=1), rtol=1e-6), simulate(rectifier(), t_end=1)):
        assert "is not known" not in other.summary_text()


def test_command_prints_it_and_its_json(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "circuit.py"
    file.write_text(
        "from nsmodel import LureSystem, complementarity\n"
        "model = LureSystem(A=[[0, -1.0], [1.0, 0]], B=[-1.0, 0], C=[-1, 0], D=1.0, law=complementarity(1), x0=[1, 0],\n"
        "    t_end=1, step=1e-2, names=['v', 'i'], units={'v': 'V', 't': 's'})\n"
    )
    assert main(["run", str(file), "--halve", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["halving"]
    assert {one["name"] for one in found} == {"v", "i"}
    assert found[0]["largest"] >= found[1]["largest"] > 0
    assert main(["run", str(file), "--halve"]) == 0
    printed = capsys.readouterr().out
    assert "halved steps    an estimate of the error, no bound" in printed
    assert " V at t = " in printed
    assert main(["run", str(file), "--halve", "--rtol", "1e-6"]) == 2
    assert "halve (--halve) and rtol are both given" in capsys.readouterr().err
