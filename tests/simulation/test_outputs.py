"""Derived quantities of runs, and their integrals, means and spectra: against energies, closed forms and NumPy."""

from itertools import pairwise

import casadi as ca
import input_scenes as scenes
import numpy as np
import pytest
from input_scenes import VIN, T
from scipy.integrate import quad

from nsmodel import (
    Bodies,
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    ManyBodies,
    ModelError,
    MonotoneInclusion,
    PlotError,
    SweepingProcess,
    Trajectory,
    UsageError,
    complementarity,
    plot,
    pwm,
    relay,
    simulate,
    stepper,
    table,
)

i, v, u, l, y, t, x, s = (ca.SX.sym(name) for name in "ivulytxs")
L, C, R = 1e-4, 47e-6, 5.0
POWERS = {"fed": u * VIN * i, "lost": v**2 / R, "diode": l * i, "stored": (L * i**2 + C * v**2) / 2, "both": [i, v]}


def powers(**fields):
    return scenes.buck(**{"outputs": POWERS, "units": {"fed": "W", "stored": "J", "t": "s", "both": "SI"}} | fields)


# -- columns -------------------------------------------------------------------------------------------------------------


def rows_of(run):
    """The outputs from the rows, by NumPy."""
    return {
        "fed": run.u * VIN * run.i, "lost": run.v**2 / R, "diode": run.multipliers[:, 0] * run.i,
        "stored": (L * run.i**2 + C * run.v**2) / 2, "both": run.x,
    }  # fmt: skip


@pytest.mark.parametrize("options", [{}, {"compiled": True}, {"rtol": 1e-6}, {"rtol": 1e-3, "method": "time-stepping"}])
def test_are_columns_of_runs(options, own_cache):
    run = simulate(powers(t_end=3 * T), **options)
    for name, expected in rows_of(run).items():
        assert getattr(run, name) == pytest.approx(expected, rel=1e-14, nan_ok=True)
    assert np.isnan(run.diode[0])  # no step has ended there
    assert run.both.shape == (len(run) + 1, 2)
    assert run.metadata["units"]["fed"] == "W"


def test_are_in_files_tables_and_pictures(tmp_path):
    run = simulate(powers(t_end=3 * T), out=tmp_path / "run", save_every=3)
    loaded = Trajectory.load(tmp_path / "run" / "trajectory.npz")
    assert (loaded.fed == run.fed).all()
    assert loaded.integral("fed") == run.integral("fed")  # a file holds the expression
    run.to_csv(tmp_path / "run.csv")
    with (tmp_path / "run.csv").open() as file:
        header = file.readline().strip().split(",")
    assert header[-6:] == ["fed", "lost", "diode", "stored", "both_0", "both_1"]
    pytest.importorskip("xarray")
    data = run.to_xarray()
    assert data["fed"].attrs["units"] == "W"
    assert data["both"].shape == (len(run) + 1, 2)
    axes = plot.outputs(run)
    assert axes.get_title(loc="left") == "Outputs"
    assert plot.outputs(run, "fed").get_ylabel() == "fed [W]"
    assert "Outputs" in [ax.get_title(loc="left") for ax in run.plot().axes]
    with pytest.raises(PlotError, match="no output is called 'foo'"):
        plot.outputs(run, ["foo"])
    with pytest.raises(PlotError, match="has no outputs"):
        plot.outputs(simulate(scenes.buck(t_end=T)))


def test_a_run_that_is_resumed_has_them(tmp_path):
    whole = simulate(powers(t_end=4 * T), out=tmp_path / "a")
    simulate(powers(t_end=2 * T), out=tmp_path / "b")
    joined = simulate(powers(t_end=4 * T), out=tmp_path / "b", resume=True)
    assert joined.fed == pytest.approx(whole.fed, rel=1e-12)
    assert joined.metadata["outputs"] == whole.metadata["outputs"]


def test_names_of_states_and_symbols_are_the_same():
    q = ca.SX.sym("q", 2)
    model = FirstOrderSystem(
        x=q, f=[q[1], -q[0]], x0=[1, 0], names=["place", "speed"], t_end=1, step=0.1, theta=0.5,
        outputs={"own": q[0] * q[1], "named": ca.SX.sym("place") * ca.SX.sym("speed")},
    )  # fmt: skip
    run = simulate(model)
    assert (run.own == run.x[:, 0] * run.x[:, 1]).all()
    assert (run.named == run.own).all()


def test_every_class_has_them():
    """Multipliers under their names, y, velocities, reactions, parameters, and arrays of the class."""
    p, heater, q = ca.SX.sym("p"), ca.SX.sym("heater"), ca.SX.sym("q", 2)
    run = simulate(FirstOrderSystem(
        x=x, lam=heater, f=-x, h=x - 1, g=p * heater, law=relay(1, 0, 1), x0=3, t_end=3, step=0.1, parameters={p: 2.0},
        outputs={"heat": p * heater, "off": y},
    ))  # fmt: skip
    assert run.heat[1:] == pytest.approx(2 * run.multipliers[1:, 0])
    assert run.off[1:] == pytest.approx(run.x[1:, 0] - 1)
    run = simulate(FrictionOscillator(
        x=q, s=s, potential=ca.sumsqr(q) / 2, friction=0.3 * s, x0=[1, 0], v0=[0, 1], t_end=1, step=0.1,
        outputs={"rubbed": ca.dot(ca.SX.sym("friction", 2), ca.SX.sym("v", 2)), "share": ca.SX.sym("energy") / 2},
    ))  # fmt: skip
    assert run.rubbed[1:] == pytest.approx((run.multipliers * run.v).sum(axis=1)[1:])
    assert run.share == pytest.approx(run.energy / 2)
    run = simulate(SweepingProcess(
        q=q, f=[-1, 0], constraints={"wall": q[0]}, q0=[0.25, 0], t_end=1, step=0.1,
        outputs={"push": ca.SX.sym("reactions"), "impulse": ca.SX.sym("wall")},
    ))  # fmt: skip
    assert run.push[1:] == pytest.approx(run.reactions[1:, 0])
    assert run.impulse[1:] == pytest.approx(run.multipliers[1:, 0])
    run = simulate(
        MonotoneInclusion(x=q, field=[1, 2], upper=[0.5, 9], x0=[0, 0], t_end=1, step=0.1, outputs={"sum": q[0] + q[1]})
    )
    assert run.sum == pytest.approx(run.x.sum(axis=1))


def test_step_by_step():
    loop = stepper(powers(inputs={u: None}), record=True)
    for value in (1.0, 1.0, 0.0):
        loop.step(value)
    assert loop.trajectory.fed == pytest.approx(rows_of(loop.trajectory)["fed"])


def test_of_a_run_that_is_there():
    run = simulate(scenes.buck(t_end=3 * T))
    assert run.evaluate(u * VIN * i) == pytest.approx(rows_of(run)["fed"])
    assert run.evaluate([i, v]) == pytest.approx(run.x)
    assert run.evaluate("i") == pytest.approx(run.i)
    more = run.evaluate({"fed": u * VIN * i, "twice": 2 * ca.SX.sym("fed")}, units={"fed": "W"})
    assert more.twice == pytest.approx(2 * rows_of(run)["fed"])
    assert more.metadata["units"] == {"fed": "W"}
    assert "fed" not in run.arrays
    assert more.evaluate({"fed": i}).fed == pytest.approx(run.i)  # its own may be given anew


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (ca.SX.sym("voltage"), "'voltage' is not there; there are t, i, v"), (ca.SX(2, 2), "shape"), (object(), "is not an expr"),
        ({"i": v}, "have 'i' already"), ({"integral": v}, "have 'integral' already"), ({"": v}, "expected a name"),
        ({"piece_a": v}, "already"), ("foo", "'foo' is not there"),
    ],
)  # fmt: skip
def test_what_a_run_refuses(given, words):
    with pytest.raises(UsageError, match=words):
        simulate(scenes.buck(t_end=T / 10)).evaluate(given)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"a": ca.SX.sym("w")}, "output 'a' uses the symbol 'w', which is not declared"), ({"i": v}, "have 'i' already"),
        ({"u": v}, "already"), ({"mean": v}, "already"), ({"a": ca.SX(2, 2)}, "shape"), ([v], "expected a dictionary"),
        ({"y": v}, "already"), ({"a": np.nan}, "NaN"), ({1: v}, "expected a name"), ({"l_0": v}, "already"),
    ],
)  # fmt: skip
def test_what_a_model_refuses(given, words):
    with pytest.raises(ModelError, match=words):
        scenes.buck(outputs=given)


def test_what_a_run_does_not_have_is_refused_before_its_first_step():
    for options in ({}, {"rtol": 1e-6}):
        with pytest.raises(UsageError, match="output 'a': 'gap' is not there"):
            simulate(scenes.buck(outputs={"a": ca.SX.sym("gap")}), **options)
    with pytest.raises(ModelError, match="outputs: many bodies take none"):
        ManyBodies(bodies=Bodies([[0.0, 0.0]], r=[1.0]), f=0, t_end=1, step=0.1, outputs={"a": t})
    with pytest.raises(ModelError, match="units: 'wrong'"):
        powers(units={"wrong": "W"})


# -- windows -------------------------------------------------------------------------------------------------------------


def balance(run):
    """(what the source fed, what is missing with the diode's power, what without), over the whole run."""
    fed, lost, diode = (run.integral(name) for name in ("fed", "lost", "diode"))
    rest = fed - lost - (run.stored[-1] - run.stored[0])
    return fed, abs(rest + diode) / fed, abs(rest) / fed


def test_energy_balances_over_200_periods(own_cache):
    """Fed = lost + stored: exactly as the scheme sees it, with what its diode does in the steps in which it closes."""
    _, whole, plain = balance(simulate(powers(), compiled=True))
    assert whole < 1e-12
    assert plain < 1e-5
    assert balance(simulate(powers(step=T / 100), compiled=True))[2] < 1e-6
    assert balance(simulate(powers(gamma=0.5), compiled=True))[1] < 1e-12
    _, whole, plain = balance(simulate(powers(), rtol=1e-9))
    assert max(whole, plain) < 1e-12


def test_implicit_euler_loses_what_it_is_known_to_lose():
    run = simulate(powers(theta=1.0, t_end=20 * T))
    damped = (np.diff(run.x, axis=0) ** 2 @ [L, C]).sum() / 2
    fed, lost, diode = (run.integral(name) for name in ("fed", "lost", "diode"))
    assert fed + diode - lost - (run.stored[-1] - run.stored[0]) == pytest.approx(damped, rel=1e-10)


@pytest.mark.parametrize(("theta", "gamma"), [(1, 1), (0.5, 1), (0.7, 1), (0.5, 0.5), (0.7, 0.3)])
def test_the_integral_of_the_rate_is_the_change_of_the_state(theta, gamma):
    z = ca.SX.sym("z", 2)
    model = LureSystem(
        x=z, A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], law=relay(1, -0.3, 0.3), x0=[1, 0], t_end=5, step=0.03, f=[0, u / 2],
        inputs={u: pwm(1.1, 0.4)}, outputs={"rate": [z[1], -z[0] + l + u / 2]},
    )  # fmt: skip
    run = simulate(model)
    first, last = (1, -1) if gamma == 1 else (run.t.searchsorted(0.45), run.t.searchsorted(1.1) - 1)  # between two edges
    whole = run.integral("rate", run.t[first], run.t[last])
    assert whole == pytest.approx(run.x[last] - run.x[first], abs=1e-12)


def test_a_window_takes_its_share_of_steps():
    run = simulate(powers(t_end=10 * T))
    cuts = [0, 1.3 * T, 1.4 * T, np.pi * T, 7.2501 * T, 7.2502 * T, 10 * T]
    parts = [run.integral("fed", a, b) for a, b in pairwise(cuts)]
    assert sum(parts) == pytest.approx(run.integral("fed"), rel=1e-13)
    middle = (run.t[7] + run.t[8]) / 2
    assert run.mean(i, run.t[7], middle) == pytest.approx((run.i[7] + run.i[8]) / 2)
    assert run.mean(ca.SX(3)) == pytest.approx(3)
    assert run.mean("u") == pytest.approx(0.4)
    assert run.rms("u") == pytest.approx(np.sqrt(0.4))
    for window in ((0, 11 * T), (-T, T), (T, T), (2 * T, T), (np.nan, T)):
        with pytest.raises(UsageError, match="window from t0"):
            run.integral("fed", *window)


def decay(**fields):
    """x' = u - x - Sgn(x), u = 3 sin 2t as an expression or a table: it sticks at 0 between."""
    return LureSystem(
        A=[[-1]], B=[1], C=[1], f=[u], law=relay(1), x0=[2], names=["x"], t_end=4, inputs={u: 3 * ca.sin(2 * t)}, t=t, **fields
    )


def test_event_driven_runs_are_integrated_between_their_rows():
    run = simulate(decay(), rtol=1e-11)
    for own, f in (
        (u * x, lambda at: 3 * np.sin(2 * at) * run.at(at).x[0, 0]),
        (l**2, lambda at: run.at(at).multipliers[0, 0] ** 2),
    ):
        points = [event.t for event in run.events if 0.5 < event.t < 3.3]
        assert run.integral(own, 0.5, 3.3) == pytest.approx(quad(f, 0.5, 3.3, points=points, limit=200)[0], abs=1e-9)
    power, heat = run.integral(u * x), run.integral(x**2 - l * x)
    assert power - heat == pytest.approx((run.x[-1, 0] ** 2 - 4) / 2, abs=1e-10)
    held = simulate(powers(t_end=20 * T), rtol=1e-9)
    assert held.integral(u) == pytest.approx(8 * T, rel=1e-13)
    with pytest.raises(UsageError, match="between the rows of an event-driven run: 'residual' is not there"):
        run.integral("residual")


def test_impulses_are_in_no_integral():
    wall = LureSystem(  # it jumps onto what falls with speed 1
        A=[[0]], B=[1], C=[1], e=-u, f=[-1], law=complementarity(1), x0=[1], names=["x"], t_end=3,
        inputs={u: table([0, 0.5], [0, 2])},
    )  # fmt: skip
    run = simulate(wall, rtol=1e-9)
    with pytest.raises(UsageError, match=r"at t = 0\.5 a multiplier is an impulse"):
        run.integral("l_0")
    assert run.integral("l_0", 2, 3) == pytest.approx(1)
    assert run.integral("x") == pytest.approx(0.75 / 2 + 5)


# -- spectra ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{}, {"rtol": 1e-8}])
def test_the_harmonics_of_a_pwm_are_exact(options):
    """c_k = 2 sin(pi k D)/(pi k) exp(-i pi k D), though steps have two lengths."""
    run = simulate(powers(t_end=10 * T, step=T / 7.3), **options)
    found = run.spectrum("u", 5 * T, 10 * T, harmonics=40)
    k = np.arange(1, 9)
    assert found.frequency[5::5] == pytest.approx(k / T)
    assert found.coefficient[0] == pytest.approx(0.4)
    assert found.coefficient[5::5] == pytest.approx(2 * np.sin(np.pi * k * 0.4) / (np.pi * k) * np.exp(-1j * np.pi * k * 0.4))
    assert np.delete(found.coefficient, np.s_[::5]) == pytest.approx(0, abs=1e-12)
    assert run.spectrum("both", harmonics=3).coefficient.shape == (4, 2)


def test_a_sine_has_one_line():
    run = simulate(FirstOrderSystem(x=x, f=ca.cos(t), t=t, x0=0, t_end=4 * np.pi, step=np.pi / 500, theta=0.5))
    found = run.spectrum("x", harmonics=10)
    assert np.abs(found.coefficient) == pytest.approx(np.eye(11)[2], abs=2e-5)
    samples = np.fft.rfft(run.x[:-1, 0])[:11] / len(run) * 2
    assert np.abs(found.coefficient[1:]) == pytest.approx(np.abs(samples[1:]), abs=1e-4)
    exact = simulate(FirstOrderSystem(x=x, f=ca.cos(t), t=t, x0=0, t_end=4 * np.pi), rtol=1e-12)
    assert exact.spectrum("x", harmonics=10).coefficient == pytest.approx(-1j * np.eye(11)[2], abs=1e-11)
    with pytest.raises(UsageError, match="harmonics = 0"):
        run.spectrum("x", harmonics=0)
