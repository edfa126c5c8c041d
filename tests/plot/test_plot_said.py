"""Pictures say what is there: rounding, what switches too often for a line, chains, windows of time; and runs between rows."""

import casadi as ca
import numpy as np
import pytest

from nsmodel import FirstOrderSystem, FrictionOscillator, SweepingProcess, cli, plot, relay, simulate
from nsmodel.errors import PlotError, UsageError
from nsmodel.plot.rounding import is_rounding, output_is_rounding
from nsmodel.plot.time import draw_curve
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.study.lines import Line, Point
from nsmodel.study.result import Study
from nsmodel.sweep import Variable
from tests.models.test_many_bodies import discs
from tests.plot.test_plot import altered, chain, crowd, fabricate, legend, oscillator, panel, title

# ---------------------------------------------------------------- rounding


def held_level(length=1.0, volts=1.0):
    """A mass that a spring pulls, in units of `length`, and a voltage that two equal forces hold at 0 but for rounding."""
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l")
    held = volts / length * (0.1 * x[0] + 0.2 * x[0] - 0.3 * x[0])
    return FirstOrderSystem(
        x=x, lam=l, f=ca.vertcat(-x[0], held), g=ca.vertcat(0.3 * length * l, 0), h=x[0] / length, law=relay(1),
        x0=[length, 0], t_end=1, step=1e-2, names=["a", "w"], units={"a": "m", "w": "V"},
        outputs={"balance": 0.1 * x[0] + 0.2 * x[0] - 0.3 * x[0], "small": 1e-18 * x[0] / length},
    )  # fmt: skip


@pytest.mark.parametrize(("length", "volts"), [(1, 1), (1e9, 1), (1e-9, 1e9), (1e-9, 1e-9)])
def test_rounding_is_told_from_small_states_in_any_units(length, volts):
    model = held_level(length, volts)
    run = simulate(model)
    assert 0 < np.abs(run.w).max() < 1e-15 * volts
    assert is_rounding(run, "x", model).tolist() == [False, True]
    small = altered(run, {"x": run.x * [1, 0] + np.linspace(0, 1e-9 * volts, len(run.t))[:, None] * [0, 1]})
    assert not is_rounding(small, "x", model).any()
    assert output_is_rounding(run, "balance", run.balance[:, None]).tolist() == [True]
    assert output_is_rounding(run, "small", run.small[:, None]).tolist() == [False]


def test_rounding_has_no_axis_of_its_own_and_is_named():
    model = held_level()
    run = simulate(model)
    ax = plot.states(run, model=model)
    assert legend(ax) == ["a [m]", "w = 0 to rounding [V]"]
    assert len(ax.lines) == 2
    assert not ax.lines[1].get_ydata().any()
    ax = plot.outputs(run, "balance")
    assert ax.get_ylabel() == "balance = 0 to rounding"
    assert ax.get_ylim() == (-1, 1)
    assert plot.phase(run, model=model).get_ylabel() == "w [V] = 0 to rounding"
    assert not plot.phase(run, model=model).lines[0].get_ydata().any()


def test_without_the_model_only_what_is_restless_is_called_rounding():
    t = np.linspace(0, 1, 101)
    noise = 1e-17 * np.random.default_rng(0).standard_normal(101)
    run = fabricate(
        t, np.stack([np.cos(t), noise, 1e-17 * np.sin(t), 1e-9 * noise / 1e-17], axis=1), np.zeros((101, 0)), [[]] * 101
    )
    assert is_rounding(run, "x").tolist() == [False, True, False, False]


def test_the_multiplier_of_a_row_that_it_does_not_move_is_rounding():
    model = held_level()
    run = simulate(model)
    assert not is_rounding(run, "multipliers", model).any()
    assert is_rounding(altered(run, {"multipliers": 1e-17 * run.multipliers}), "multipliers", model).all()


def test_what_stands_still_to_rounding_is_flat():
    run = fabricate(np.linspace(0, 1, 50), 5 + 1e-15 * np.arange(50) % 3e-15, np.zeros((50, 0)), [[]] * 50)
    assert plot.states(run).get_ylim() == pytest.approx((4.75, 5.25))


def test_residuals_that_say_no_more_do_not_stretch_the_axis():
    values = np.r_[np.nan, 0.0, 1e-12, 1e-40, 1e-13]
    ax = plot.residual(Trajectory({"t": np.arange(5.0), "x": np.zeros((5, 1)), "residual": values}, {"tolerance": 1e-9}))
    assert legend(ax) == ["steps", "below 1e-20: 2 of 4, at the bottom", "tolerance 1e-09"]
    assert ax.get_ylim()[0] > 1e-18


# ---------------------------------------------------------------- what switches often


def test_a_signal_that_switches_often_is_a_band_with_its_duty():
    t = np.linspace(0, 1, 40_001)
    duty = 0.25 + 0.5 * t
    values = np.where((2000 * t) % 1 < duty, 3.0, 0.0)
    values[20_000] = 7
    ax = plot.states(Trajectory({"t": t, "x": values[:, None]}, {"units": {"t": "s"}}))
    assert title(ax) == "States: means over 0.0025 s, bands of extremes"
    at, mean = ax.lines[0].get_data()
    inner = slice(2, -2)
    assert mean[inner] == pytest.approx(3 * (0.25 + 0.5 * at[inner]), abs=0.15)
    corners = ax.collections[0].get_paths()[0].vertices
    assert (corners[:, 1].min(), corners[:, 1].max()) == (0, 7)
    assert np.median(corners[:, 1][corners[:, 1] > 0]) == 3


def test_means_count_time_not_rows():
    t = np.concatenate([np.arange(1000)[:, None] + np.array([0.0, 0.9, 0.95])]).ravel()
    values = np.tile([1.0, 0.0, 0.0], 1000)  # 1 holds for a twentieth of the time, from 0.95 to 1
    line, width = draw_curve(plot.states(oscillator()), t, values, color="k", drawstyle="steps-pre")
    assert width is not None
    assert line.get_ydata()[5:-5] == pytest.approx(0.05, abs=0.005)


def test_a_few_periods_are_a_line_and_many_a_thin_portrait():
    t = np.linspace(0, 1, 5001)
    assert draw_curve(plot.states(oscillator()), t, np.sin(300 * t))[1] is None
    wave = Trajectory({"t": t, "x": np.stack([np.sin(3000 * t), np.cos(3000 * t)], axis=1)}, {})
    assert plot.phase(wave).lines[0].get_linewidth() < plot.phase(oscillator()).lines[0].get_linewidth()


# ---------------------------------------------------------------- chains


def test_a_long_chain_is_a_map_with_stick_marked():
    run = altered(chain(60), {"v": np.gradient(chain(60).x, axis=0)})
    still = run.t > 30
    assert still.any()
    run.v[still] = 0
    figure = plot.overview(run)
    names = [title(ax) for ax in figure.axes if title(ax)]
    assert names == [
        "x along the chain",
        "Index set",
        "Multipliers friction",
        "velocity of x along the chain",
        "Energy",
        "Residual",
    ]
    mesh, stuck = panel(figure, "velocity of x").collections
    assert mesh.get_array().shape == (60, 200)
    assert not stuck.get_array().mask[:, still[1:]].any()
    assert stuck.get_array().mask[:, ~still[1:]].all()
    np.testing.assert_array_equal(panel(figure, "x along").collections[0].get_array(), run.x[1:].T)
    assert legend(panel(figure, "velocity of x")) == ["stick (y = 0)"]


def test_maps_keep_spikes_and_name_what_they_lack():
    x = np.zeros((5001, 3))
    x[1234, 1], x[3333, 2] = -7, 5
    run = Trajectory({"t": np.linspace(0, 1, 5001), "x": x}, {"state_names": ["p[4]", "p[5]", "p[6]"]})
    ax = plot.space_time(run)
    cells = ax.collections[0].get_array()
    assert (cells.min(), cells.max()) == (-7, 5)
    assert ax.get_ylim() == (3.5, 6.5)
    with pytest.raises(PlotError, match="no chain is called 'z'; there are p"):
        plot.space_time(run, "z")
    with pytest.raises(PlotError, match="no chain of states; there are none: a map needs names such as x_0, x_1"):
        plot.space_time(oscillator())


def test_states_in_a_row_have_a_profile(load_case, tmp_path):
    model = load_case("sandpile")
    run = simulate(model, t_end=20)
    ax = plot.profile(run)
    assert legend(ax) == [f"t = {t}" for t in (0, 4, 8, 12, 16, 20)]
    assert (ax.get_xlabel(), ax.get_ylabel(), title(ax)) == ("number of h", "h", "Profile of h")
    for line, t in zip(ax.lines, (0, 4, 8, 12, 16, 20), strict=True):
        np.testing.assert_array_equal(line.get_xdata(), np.arange(12))
        np.testing.assert_allclose(line.get_ydata(), model.exact([t])[0], atol=1e-9)  # the pile itself
    names = [path.name for path in plot.save_all(run, model, tmp_path)]
    assert names == ["states.png", "profile.png", "multipliers.png", "overview.png"]
    assert panel(plot.overview(run, model), "Profile of h")
    with pytest.raises(PlotError, match="no chain is called 'z'; there are h"):
        plot.profile(run, "z")


def test_few_states_and_states_of_two_kinds_have_no_profile(tmp_path):
    row = [f"h_{i}" for i in range(8)]
    for name, states in {"row": row, "few": row[:7], "two": [*row, "v"]}.items():
        x = np.random.default_rng(0).random((11, len(states)))
        run = Trajectory({"t": np.linspace(0, 1, 11), "x": x}, {"state_names": states})
        files = {path.name for path in plot.save_all(run, None, tmp_path / name)}
        assert ("profile.png" in files, "phase.png" in files) == (name == "row", name != "row")


def test_a_map_of_the_index_set_shows_each_row():
    ax = plot.index_map(chain(60))
    codes = ax.collections[0].get_array()
    assert codes.shape == (60, 200)
    assert legend(ax) == ["slip (y > 0)", "stick (y = 0)", "slip (y < 0)"]
    assert (codes[:, -1] == 1).all()  # the colour of stick
    with pytest.raises(PlotError, match="no index set"):
        plot.index_map(Trajectory({"t": np.zeros(2), "x": np.zeros((2, 1))}, {}))


# ---------------------------------------------------------------- windows


def test_a_window_shows_its_rows_alone():
    run = oscillator()
    figure = plot.overview(run, t=(5, 10))
    inside = run.t[(run.t >= 5) & (run.t <= 10)]
    assert panel(figure, "States").get_xlim() == (inside[0], inside[-1])
    assert "shown: t = 5 to 10 s" in figure.get_supxlabel()
    np.testing.assert_array_equal(plot.states(plot.window(run, (None, 5))).lines[0].get_xdata(), run.t[run.t <= 5])
    assert plot.window(run, None) is run


def test_the_window_of_an_event_driven_run_is_read_off_its_pieces():
    x, s = ca.SX.sym("x"), ca.SX.sym("s")
    model = FrictionOscillator(x=x, potential=x**2 / 2, friction=s, s=s, x0=5.3, v0=0, t_end=12, step=1e-2)
    run = simulate(model, rtol=1e-8)
    part = plot.window(run, (1.0, 1.5))
    assert (part.t[0], part.t[-1]) == (1.0, 1.5)
    assert part.x[:, 0] == pytest.approx(1 + 4.3 * np.cos(part.t), abs=1e-7)
    assert "shown: t = 1 to 1.5" in plot.overview(run, model, t=(1, 1.5)).get_supxlabel()
    ax = plot.energy(run, model=model)
    t, energy = ax.lines[0].get_data()
    first = t < 3
    assert energy[first] == pytest.approx((4.3 * np.sin(t[first])) ** 2 / 2 + (1 + 4.3 * np.cos(t[first])) ** 2 / 2, abs=1e-6)
    assert title(plot.energy(run)) == "Energy (on lines between the ends of pieces)"


def test_the_window_of_a_crowd_counts_those_who_were_there():
    model = discs([[0, 0], [3, 0], [6, 0]], [0.4, 0.4, 0.4], lambda i: ca.vertcat(1, 0), t_end=1, step=0.1)
    run = simulate(model)
    x = run.x.copy()
    x[3:, 4:] = np.nan
    x[8:, 2:4] = np.nan
    run = altered(run, {"x": x}, scene={"radii": [0.4] * 3})
    assert title(plot.crowd.evacuation(run)) == "2 of 3 bodies left, the last at 0.8"
    assert title(plot.crowd.evacuation(plot.window(run, (0.5, 1)))) == "1 of 2 bodies left after t = 0.5, the last at 0.8"


def test_the_contacts_of_a_window_are_those_of_its_rows():
    model = discs([[0, 0], [1, 0]], [0.4, 0.4], lambda i: -i.q, t_end=1, step=0.1)
    run = simulate(model)
    part = plot.window(run, (0.5, 1))
    assert len(run.contacts(9).first) == 1
    for one, other in zip(run.contacts(9), part.contacts(4), strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(part.arrays["pressure"], run.arrays["pressure"][5:])


def test_discs_know_their_pressure_in_event_driven_runs_too(load_case):
    model = load_case("two_discs")
    run, exact = simulate(model), simulate(model, rtol=1e-6)
    assert exact.metadata["constraint_bodies"] == run.metadata["constraint_bodies"] == [[0, 1]]
    assert len(plot.configuration(exact).figure.axes) == 2


@pytest.mark.parametrize(
    ("t", "error", "message"),
    [
        ((5, 30), UsageError, r"window from t0 = 5 to t1 = 30: expected 0 <= t0 < t1 <= 20"),
        ((5, 2), UsageError, r"window from t0 = 5 to t1 = 2: expected 0 <= t0 < t1 <= 20"),
        ((5, float("nan")), PlotError, r"nan is not a time; give None for an end of the run"),
        (3, PlotError, r"t = 3; expected a window \(t0, t1\)"),
        (("a", 2), PlotError, r"expected a window \(t0, t1\)"),
        ((1.001, 1.002), PlotError, r"window t = 1.001 to 1.002 holds 0 rows, but a picture needs at least 2: the rows next"),
    ],
)  # fmt: skip
def test_windows_that_are_none(t, error, message):
    with pytest.raises(error, match=message):
        plot.overview(oscillator(), t=t)


def test_a_window_from_the_command_line(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "decay.py").write_text(
        "import casadi as ca\nfrom nsmodel import SweepingProcess\nq = ca.SX.sym('q')\n"
        "model = SweepingProcess(t=ca.SX.sym('t'), q=q, f=-q, constraints={'floor': q}, q0=1, t_end=1, step=0.1)\n"
    )
    asked = []
    monkeypatch.setattr(plot, "save_all", lambda run, model, folder, t: asked.append(t) or [])
    assert cli.main(["run", "decay.py", "--plot", "--window", "0.5:", "--quiet"]) == 0
    assert asked == [(0.5, None)]
    for given, message in (
        ("0.5", "--window 0.5: expected T0:T1, two times, of which one may be left out"),
        ("2:1", "--window 2:1: expected T0 < T1"),
        ("9:", "--window begins at t = 9, after the run, which ends at t = 1"),
    ):
        assert cli.main(["run", "decay.py", "--plot", "--window", given, "--quiet"]) == 2
        assert message in capsys.readouterr().err
    assert cli.main(["run", "decay.py", "--window", "0:1"]) == 2
    assert "--window is a window of pictures: give --plot as well" in capsys.readouterr().err


# ---------------------------------------------------------------- the run at any time


def test_between_rows_states_are_on_lines_and_multipliers_those_of_the_step(tmp_path):
    q = ca.SX.sym("q")
    model = SweepingProcess(t=ca.SX.sym("t"), q=q, f=-1, constraints={"floor": q}, q0=0.25, t_end=1, step=0.1)
    run = simulate(model)
    at = run.at(run.t)
    np.testing.assert_array_equal(at.x, run.x)
    np.testing.assert_array_equal(at.multipliers[1:], run.multipliers[1:])
    np.testing.assert_array_equal(at.multipliers[0], run.multipliers[1])
    half = run.at(0.15)
    assert half.x.item() == pytest.approx(0.1, abs=1e-12)  # 0.25 - 0.15
    assert (half.x.shape, half.multipliers.shape, half.y.shape) == ((1, 1), (1, 1), (1, 1))
    assert half.multipliers[0] == run.multipliers[2]
    run.save(tmp_path / "run.npz")
    times = np.random.default_rng(1).uniform(0, 1, 50)
    for one, other in zip(run.at(times), Trajectory.load(tmp_path / "run.npz").at(times), strict=True):
        np.testing.assert_array_equal(one, other)


def test_bodies_are_where_both_rows_have_them():
    run = crowd()
    x = run.x.copy()
    x[20:, :2] = np.nan
    x[:10, 2:4] = np.nan
    at = altered(run, {"x": x}).at([run.t[19], (run.t[19] + run.t[20]) / 2, run.t[9], run.t[10], run.t[0]])
    assert np.isnan(at.x[:, 0]).tolist() == [False, True, False, False, False]
    assert np.isnan(at.x[:, 2]).tolist() == [False, False, True, False, True]
    np.testing.assert_array_equal(at.x[3], x[10])


def test_many_bodies_have_no_columns_of_multipliers():
    model = discs([[0, 0], [3, 0]], [0.4, 0.4], lambda i: ca.vertcat(1, 0), t_end=0.5, step=0.1)
    at = simulate(model).at(0.25)
    assert at.x.ravel() == pytest.approx([0.25, 0, 3.25, 0])
    assert at.multipliers.shape == (1, 0)


def test_an_oscillator_keeps_its_velocity_over_a_step():
    x, s = ca.SX.sym("x"), ca.SX.sym("s")
    run = simulate(FrictionOscillator(x=x, potential=x**2 / 2, friction=s, s=s, x0=5.3, v0=0, t_end=1, step=0.1))
    at = run.at([0.0, 0.52, 0.57])
    assert at.v[1] == at.v[2] == run.v[6]
    assert at.v[0] == run.v[0] == 0
    assert (at.x[2] - at.x[1]).item() == pytest.approx(0.05 * run.v[6].item())


def test_a_run_of_one_row_is_known_there():
    run = oscillator()
    start = Trajectory({name: array[:1] for name, array in run.arrays.items()}, run.metadata)
    assert start.at(0).x == run.x[0]
    with pytest.raises(PlotError, match="holds 1 rows"):
        plot.window(Trajectory({"t": np.array([0.0, 1, 2]), "x": np.zeros((3, 1))}, {}), (0.5, 1.5))


@pytest.mark.parametrize(
    ("t", "message"),
    [
        (21, r"t = 21: the run goes from 0 to 20"),
        ([1, float("nan")], r"t = nan: the run goes from 0 to 20"),
        ("soon", r"t = 'soon'; expected a number, or a list of numbers"),
        ([[1, 2]], r"t has shape \(1, 2\); expected a number, or a list of numbers"),
    ],
)
def test_times_that_are_none(t, message):
    with pytest.raises(UsageError, match=message):
        oscillator().at(t)


# ---------------------------------------------------------------- sweeps, studies


def test_a_sweep_does_not_speak_of_an_only_entry():
    coords = {"k": [1, 2, 3], "t": [0.0, 1.0], "x_entry": [0]}
    x = Variable.of("x", np.arange(6.0).reshape(3, 2, 1), ("k", "t", "x_entry"), coords, cell_dims=("k",))
    assert title(plot.sweep_line(x, x="t", hue="k")) == "x"
    assert title(plot.sweep_line(x, x="k")) == "x at t = 1"


def test_a_study_names_no_line_without_points():
    lines = [
        Line.measured("fast", [("h = 1", 1e-2, 1e-3)]),
        *(Line(name, (Point("h = 1", status="left out"),)) for name in "abc"),
    ]
    study = Study("Some", "LureSystem", 1, 1.0, "s", tuple(lines), None)
    assert legend(plot.work_precision(study)) == ["fast", "3 more without a point: left out or failed"]
