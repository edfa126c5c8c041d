"""Pictures of fabricated runs: their words, their lines, their files, and that nothing overlaps or is cut off."""

import functools
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imread

import nsmodel
from nsmodel import LureSystem, plot, simulate
from nsmodel.errors import PlotError
from nsmodel.modeling import laws
from nsmodel.plot import displays, rounding, strips, style
from nsmodel.simulation.trajectory import Trajectory


def fabricate(t, x, multipliers, codes, extra=None, **metadata):
    """A run with the arrays that every class has."""
    rows = len(t)
    multipliers, codes = np.array(multipliers, dtype=float), np.array(codes, dtype=np.int8)
    multipliers[0], codes[0] = np.nan, -2
    residual = np.r_[np.nan, 10.0 ** -(12 + np.arange(rows - 1) % 4)]
    arrays = {
        "t": t, "x": np.array(x, dtype=float).reshape(rows, -1), "multipliers": multipliers, "y": 0 * multipliers,
        "index_set": codes, "residual": residual, "step": np.r_[np.nan, np.diff(t)], **(extra or {}),
    }  # fmt: skip
    return Trajectory(arrays, {"tolerance": 1e-9, "status": "done", **metadata})


def altered(run, arrays=None, **metadata):
    """The run with some arrays and metadata replaced."""
    return Trajectory({**run.arrays, **(arrays or {})}, {**run.metadata, **metadata})


def bridge(steps=400):
    t = np.linspace(0, 5e-3, steps + 1)
    wave = np.exp(-400 * t) * np.array([10 * np.cos(1e4 * t), 0.1 * np.sin(1e4 * t)])
    forward, reverse = np.maximum(wave[0], 0), np.maximum(-wave[0], 0)
    values = np.stack([forward / 1e3, forward / 1e3, reverse, reverse], axis=1)
    names = ["i_DR2", "i_DF2", "v_DF1", "v_DR1"]
    return fabricate(
        t, wave.T, values, np.where(values > 0, 0, -1), title="Diode bridge", model_class="LureSystem",
        state_names=["v_C", "i_L"], stems={"x": [0, 1]}, multiplier_names=names, index_names=names,
        law_kinds=["complementarity"] * 4,
        units={"v_C": "V", "i_L": "A", "t": "s", "i_DR2": "A", "i_DF2": "A", "v_DF1": "V", "v_DR1": "V"},
    )  # fmt: skip


def oscillator(steps=300):
    t = np.linspace(0, 20, steps + 1)
    x, v = np.maximum(4 - t / 4, 0) * np.cos(t), -np.maximum(4 - t / 4, 0) * np.sin(t)
    codes = np.where(t > 16, 0, np.where(v > 0, 1, -1))[:, None]
    return fabricate(
        t, x, 0.5 * codes, codes, {"v": v[:, None], "energy": (x**2 + v**2) / 2}, title="Mass with dry friction",
        model_class="FrictionOscillator", state_names=["x"], stems={"x": [0]}, multiplier_names=["friction"],
        index_names=["friction"], law_kinds=["relay"], units={"x": "m", "t": "s", "friction": "N", "energy": "J"},
    )  # fmt: skip


def chain(masses=20, steps=200):
    t = np.linspace(0, 40, steps + 1)
    x = np.outer(np.maximum(1 - t / 30, 0) * np.cos(t), np.sin(np.pi * (1 + np.arange(masses)) / (masses + 1)))
    codes = np.where(t[:, None] > 30, 0, np.where(np.sin(t)[:, None] * np.ones(masses) > 0, 1, -1))
    names = [f"friction[{k}]" for k in range(masses)]
    return fabricate(
        t, x, 0.2 * codes, codes, {"v": 0 * x, "energy": (x**2).sum(axis=1)}, title="Chain of masses",
        model_class="FrictionOscillator", state_names=[f"x_{k}" for k in range(masses)],
        stems={"x": list(range(masses))}, multiplier_names=names, index_names=names, law_kinds=["relay"] * masses,
        units={"x": "mm", "t": "s", "friction": "N"},
    )  # fmt: skip


def sweeping(t, q, reaction, title):
    """A run of a sweeping process with one constraint."""
    stem = {"q": list(range(np.reshape(q, (len(t), -1)).shape[1]))}
    names = ["q"] if len(stem["q"]) == 1 else [f"q_{k}" for k in stem["q"]]
    reaction = np.reshape(reaction, (-1, 1))
    return fabricate(
        t, q, reaction * t[1], np.where(reaction > 0, 0, -1), {"reactions": reaction}, title=title, stems=stem,
        model_class="SweepingProcess", state_names=names, multiplier_names=["disc"], index_names=["disc"],
        law_kinds=["complementarity"], units={"q": "m", "t": "s", "reactions": "m/s"},
    )  # fmt: skip


def past_disc(speed=0.0):
    """A point carried past a disc, which may move; contact from t = 1 to 2."""
    t = np.linspace(0, 3, 151)
    angle = np.pi * (1 - (t - 1) / 2)
    contact = (t > 1) & (t <= 2)
    circle, line = np.stack([np.cos(angle), np.sin(angle)], axis=1), np.stack([t - 2, 0 * t + 1], axis=1)
    q = np.where(contact[:, None], circle, line)
    q[t <= 1] = np.stack([t - 2, 0 * t], axis=1)[t <= 1]
    time, point = ca.SX.sym("t"), ca.SX.sym("q", 2)
    constraints = {"disc": ca.norm_2(point - ca.vertcat(speed * time, 0)) - 1, "floor": point[1] + 3}
    model = SimpleNamespace(t=time, q=point, u=ca.SX(0, 1), constraints=constraints)
    return sweeping(t, q, contact * 1.0, "A point past a disc"), model


def half_line():
    t = np.linspace(0, 3, 151)
    time, point = ca.SX.sym("t"), ca.SX.sym("q")
    contact = t <= 3 * np.pi / 4
    q = np.where(contact, np.sin(t), np.sin(3 * np.pi / 4) * np.exp(3 * np.pi / 4 - t))
    model = SimpleNamespace(t=time, q=point, u=ca.SX(0, 1), constraints={"wall": point - ca.sin(time)})
    return sweeping(t, q, contact * (np.cos(t) + np.sin(t)), "A moving half-line"), model


def crowd(people=30):
    """Discs on a grid that walk to a door on the right; each touches the next."""
    t = np.linspace(0, 1, 51)
    k = np.arange(people)
    start = np.stack([0.4 + 0.5 * (k // 6), 0.4 + 0.5 * (k % 6)], axis=1)
    q = (start[None] + t[:, None, None] * np.array([0.5, 0.0])).reshape(len(t), -1)
    pairs = [[i, i + 1] for i in range(people - 1)]
    reactions = np.outer(t, 1.0 + np.arange(people - 1))
    reactions[:, 0] = 0
    names = [f"disc_{i}-disc_{j}" for i, j in pairs]
    walls = [[[0, 0], [0, 4]], [[0, 0], [4, 0]], [[0, 4], [4, 4]], [[4, 0], [4, 1.4]], [[4, 2.6], [4, 4]]]
    return fabricate(
        t, q, reactions * t[1], np.where(reactions > 0, 0, -1), {"reactions": reactions}, title="People and a door",
        model_class="SweepingProcess", state_names=[f"q_{i}" for i in range(2 * people)],
        stems={"q": list(range(2 * people))}, multiplier_names=names, index_names=names,
        law_kinds=["complementarity"] * len(pairs), units={"q": "m", "t": "s", "reactions": "m/s"},
        scene={"radii": [0.22] * people, "walls": walls}, constraint_bodies=pairs,
    )  # fmt: skip


CASES = {
    "bridge": lambda: (bridge(), None),
    "oscillator": lambda: (oscillator(), None),
    "chain": lambda: (chain(), None),
    "fixed disc": past_disc,
    "moving disc": lambda: past_disc(0.5),
    "half-line": half_line,
    "crowd": lambda: (crowd(), None),
}


def legend(ax):
    return [text.get_text().strip() for text in ax.get_legend().get_texts()]


def title(ax):
    return ax.get_title(loc="left")


def twin_of(ax):
    return next(other for other in ax.figure.axes if other is not ax and other.bbox.bounds == ax.bbox.bounds)


def pixels(figure):
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def panel(figure, words):
    return next(ax for ax in figure.axes if title(ax).startswith(words))


# ---------------------------------------------------------------- states


def test_states_names_units_and_legend():
    ax = plot.states(past_disc()[0])
    assert (ax.get_xlabel(), ax.get_ylabel(), title(ax)) == ("t [s]", "q_0, q_1 [m]", "States")
    assert legend(ax) == ["q_0", "q_1"]
    assert len(ax.lines) == 2


def test_a_single_state_is_named_by_its_axis():
    ax = plot.states(oscillator())
    assert ax.get_ylabel() == "x [m]"
    assert ax.get_legend() is None


def test_two_units_have_two_axes():
    ax = plot.states(bridge())
    assert legend(ax) == ["v_C [V]", "i_L [A] (right axis)"]
    assert (ax.get_ylabel(), twin_of(ax).get_ylabel()) == ("v_C [V]", "i_L [A]")
    assert (len(ax.lines), len(twin_of(ax).lines)) == (1, 1)


def test_two_sizes_without_units_have_two_axes():
    run = altered(bridge(), units={})
    assert legend(plot.states(run)) == ["v_C", "i_L (right axis)"]
    close = altered(run, {"x": run.x * [1, 50]})
    assert legend(plot.states(close)) == ["v_C", "i_L"]


def test_three_units_share_an_axis_and_are_told_apart_in_the_legend():
    units = {"x_0": "V", "x_1": "A", "x_2": "Wb"}
    run = fabricate(np.linspace(0, 1, 5), np.ones((5, 3)), np.zeros((5, 1)), np.zeros((5, 1)), units=units)
    ax = plot.states(run)
    assert legend(ax) == ["x_0 [V]", "x_1 [A]", "x_2 [Wb]"]
    assert ax.get_ylabel() == "x_0, x_1, x_2 [V, A, Wb]"


def test_many_states_are_thinned_and_the_title_says_so():
    ax = plot.states(chain())
    assert title(ax) == "States (12 of 20 shown, evenly spread)"
    assert len(ax.lines) == 12
    assert legend(ax)[0] == "x_0"
    assert legend(ax)[-1] == "x_19"


def test_a_crowd_shows_both_coordinates_of_some_bodies():
    ax = plot.states(crowd())
    assert title(ax) == "States (12 of 60 shown, bodies evenly spread)"
    assert legend(ax)[:2] == ["q_0", "q_1"]
    first, second = ax.lines[:2]
    assert first.get_color() == second.get_color()
    assert (first.get_linestyle(), second.get_linestyle()) == ("-", "--")


def test_names_choose_states_and_stems():
    assert legend(plot.states(chain(), ["x_3", "x_1"])) == ["x_3", "x_1"]
    assert len(plot.states(chain(), ["x"]).lines) == 20
    assert plot.states(chain(), "x_3").get_ylabel() == "x_3 [mm]"


def test_unknown_and_empty_names():
    with pytest.raises(PlotError, match=r"no state is called 'speed'; the states are q_0, q_1, q"):
        plot.states(past_disc()[0], ["speed"])
    with pytest.raises(PlotError, match="names is empty"):
        plot.states(past_disc()[0], [])


def test_a_long_run_keeps_its_extrema():
    rows = 1_000_001
    x = np.sin(np.linspace(0, 50, rows))
    x[123_457], x[777_777], x[55] = 9.0, -9.0, np.nan
    run = Trajectory({"t": np.linspace(0, 1, rows), "x": x[:, None]}, {})
    line = plot.states(run).lines[0]
    assert len(line.get_ydata()) <= style.MAX_POINTS
    assert {9.0, -9.0} <= set(line.get_ydata())
    assert (line.get_xdata()[0], line.get_xdata()[-1]) == (0, 1)
    assert np.all(np.diff(line.get_xdata()) > 0)


def test_a_given_ax_is_drawn_on_and_returned():
    ax = Figure().add_subplot()
    for draw in (plot.states, plot.index_strip, plot.phase, plot.multipliers, plot.residual, plot.energy):
        assert draw(oscillator(), ax=ax) is ax


def test_names_that_matplotlib_would_misread():
    names = ["_hidden", "cost$"]
    run = altered(bridge(), state_names=names, stems={}, units={}, title="10 $ and_more")
    assert legend(plot.states(run)) == ["_hidden", r"cost\$ (right axis)"]
    assert pixels(plot.overview(run)).std() > 5


# ---------------------------------------------------------------- index set


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("complementarity", ["open (l = 0)", "contact (y = 0)"]),
        ("relay", ["l at lower", "stick or sliding mode (y = 0)", "l at upper"]),
        ("box", ["l at lower", "l between its bounds (y = 0)", "l at upper"]),
        ("equality", ["equality (y = 0)"]),
        ("ball", ["l inside the ball (y = 0)", "l on the sphere"]),
        ("cone", ["open (l = 0)", "l inside the cone (y = 0)", "l on the cone"]),
        ("ellipsoid", ["l inside the ellipsoid (y = 0)", "l on the ellipsoid"]),
        ("Coulomb friction", ["open (l = 0)", "stick (y = 0)", "slip (l on the cone)"]),
    ],
)
def test_the_strip_speaks_each_laws_words(kind, words):
    known = {"complementarity", "relay", "box", "equality", "ball", "cone", "ellipsoid", "Coulomb friction"}
    assert set(strips.STATE_LABELS) == known
    run = altered(oscillator(), law_kinds=[kind], model_class="LureSystem")
    assert legend(plot.index_strip(run)) == words


def test_friction_sticks_and_slips():
    words = ["slip (y > 0)", "stick (y = 0)", "slip (y < 0)"]
    assert legend(plot.index_strip(oscillator())) == words
    mixed = altered(bridge(), law_kinds=["relay", "relay", "ball", "ball"], model_class="FrictionOscillator")
    run = altered(mixed, index_names=["friction", "potential term 0", "plane[0]", "plane[1]"])
    assert legend(plot.index_strip(run)) == [
        *(f"friction: {word}" for word in words),
        *(f"relay: {word}" for _, word in strips.STATE_LABELS["relay"].values()),
        "isotropic friction: stick (y = 0)",
        "isotropic friction: slip (l on the sphere)",
    ]


def test_the_strip_knows_the_label_of_every_law():
    blocks = [*laws.equality(1).blocks, *laws.complementarity(1).blocks, *laws.relay(1).blocks, *laws.box(0, 1).blocks]
    blocks += [*laws.ball(2).blocks, *laws.second_order_cone(2).blocks, *laws.ellipsoid([[2, 1], [1, 2]]).blocks]
    for block in blocks:
        plot.index_strip(altered(oscillator(), law_kinds=[block.label]))


def test_the_strip_tells_mixed_laws_apart():
    run = altered(bridge(), law_kinds=["complementarity", "relay", "equality", "relay"])
    assert legend(plot.index_strip(run))[:3] == [
        "complementarity: open (l = 0)",
        "complementarity: contact (y = 0)",
        "relay: l at lower",
    ]


def test_the_strip_names_its_rows():
    ax = plot.index_strip(bridge())
    assert [label.get_text() for label in ax.get_yticklabels()] == ["i_DR2", "i_DF2", "v_DF1", "v_DR1"]
    assert (ax.get_xlabel(), title(ax)) == ("t [s]", "Index set")
    assert ax.get_ylim() == (3.5, -0.5)


def test_the_strip_colours_the_step_that_ends_at_a_row():
    t = np.array([0.0, 1.0, 3.0, 4.0])
    run = fabricate(t, t, np.zeros((4, 1)), [[-2], [-1], [0], [1]], law_kinds=["relay"])
    spans = {}
    for pieces in plot.index_strip(run).collections:
        corners = pieces.get_paths()[0].vertices[:, 0]
        spans[tuple(pieces.get_facecolor()[0][:3])] = (corners.min(), corners.max())
    assert spans == {to_rgb(style.LOWER): (0, 1), to_rgb(style.ZERO): (1, 3), to_rgb(style.UPPER): (3, 4)}


def test_the_strip_shows_the_rows_that_change_most():
    codes = np.full((101, 40), -1)
    codes[1::2, 7] = 0
    codes[50:, 9] = 0
    names = [f"r{k}" for k in range(40)]
    run = fabricate(np.linspace(0, 1, 101), np.zeros(101), np.zeros((101, 40)), codes, index_names=names)
    ax = plot.index_strip(run)
    assert title(ax) == "Index set (30 of 40 shown, those that change most)"
    few = plot.index_strip(run, limit=2)
    assert [label.get_text() for label in few.get_yticklabels()] == ["r7", "r9"]


def test_the_strip_of_a_long_run_loses_no_event_and_hides_no_chatter():
    rows = 100_001
    codes = np.full((rows, 2), -1)
    codes[55_555, 0] = 0
    codes[::2, 1] = 0
    run = fabricate(np.linspace(0, 1, rows), np.zeros(rows), np.zeros((rows, 2)), codes)
    ax = plot.index_strip(run)
    assert legend(ax)[-1] == "split band: changes within a pixel"
    event = next(c for c in ax.collections if tuple(c.get_facecolor()[0][:3]) == to_rgb(style.ZERO)).get_paths()
    assert len(event) == 1
    assert event[0].vertices[:, 0] == pytest.approx(0.55555, abs=1e-3)
    colours = {tuple(pixel) for pixel in pixels(ax.figure)[:, 400, :3]}
    assert {tuple(round(255 * part) for part in to_rgb(colour)) for colour in (style.PALE, style.ZERO)} <= colours


def test_the_strip_of_a_long_run_has_clean_edges():
    rows = 5 * strips.MAX_BUCKETS + 3
    codes = np.where(np.arange(rows) < rows // 3, -1, 0)[:, None]
    codes[-1] = -1
    ax = plot.index_strip(fabricate(np.linspace(0, 1, rows), np.zeros(rows), np.zeros((rows, 1)), codes))
    boxes = [path.vertices for pieces in ax.collections for path in pieces.get_paths()]
    assert all(np.ptp(box[:, 1]) == pytest.approx(0.76) for box in boxes)
    assert sorted(box[:, 0].min() for box in boxes) == pytest.approx([0, 1 / 3, 1], abs=2 / strips.MAX_BUCKETS)


def test_the_strip_refuses_what_it_cannot_draw():
    with pytest.raises(PlotError, match="law_kinds must name one of complementarity, relay"):
        plot.index_strip(altered(oscillator(), law_kinds=["magic"]))
    with pytest.raises(PlotError, match="no index set"):
        plot.index_strip(Trajectory({"t": np.zeros(2), "x": np.zeros((2, 1))}, {}))


# ---------------------------------------------------------------- phase, multipliers, residual, energy


def test_phase_of_two_states():
    ax = plot.phase(bridge())
    assert (ax.get_xlabel(), ax.get_ylabel(), title(ax)) == ("v_C [V]", "i_L [A]", "Phase portrait")
    assert legend(ax) == ["start (t = 0 s)", "end (t = 0.005 s)"]
    np.testing.assert_array_equal(ax.lines[0].get_xydata(), bridge().x)


def test_phase_of_an_oscillator_is_position_against_velocity():
    ax = plot.phase(oscillator())
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [m]", "velocity of x [m/s]")
    np.testing.assert_array_equal(ax.lines[0].get_ydata(), oscillator().v[:, 0])
    assert plot.phase(chain(), 2, 5).get_ylabel() == "x_5 [mm]"


def test_phase_starts_where_the_velocity_is_known():
    run = oscillator()
    v = run.v.copy()
    v[0] = np.nan
    ax = plot.phase(altered(run, {"v": v}))
    assert legend(ax)[0] == f"start (t = {run.t[1]:.4g} s)"
    assert ax.lines[0].get_xdata()[0] == run.x[1, 0]


def test_phase_prefers_a_state_with_another_unit():
    run = altered(chain(), units={"x_0": "m", "x_1": "m", "x_2": "m/s"}, stems={}, model_class="LureSystem")
    assert plot.phase(run).get_ylabel() == "x_2 [m/s]"
    assert plot.phase(altered(run, units={})).get_ylabel() == "x_1"


def test_phase_refuses_what_is_not_there():
    with pytest.raises(PlotError, match="needs two states, or a velocity; this run has only the state q"):
        plot.phase(half_line()[0])
    with pytest.raises(PlotError, match="state 7 does not exist: states are numbered 0 to 1"):
        plot.phase(bridge(), 0, 7)


def test_multipliers_names_units_and_the_step_they_belong_to():
    ax = plot.multipliers(bridge())
    assert legend(ax) == ["i_DR2 [A]", "i_DF2 [A]", "v_DF1 [V] (right axis)", "v_DR1 [V] (right axis)"]
    assert {line.get_drawstyle() for line in ax.lines} == {"steps-pre"}
    assert plot.multipliers(oscillator()).get_ylabel() == "multiplier of friction [N]"


def test_many_multipliers_are_thinned_to_the_largest():
    ax = plot.multipliers(crowd(), which="reactions")
    assert title(ax) == "Reactions (multipliers / step) (12 of 29 shown, the largest)"
    assert legend(ax) == [f"disc_{k}-disc_{k + 1}" for k in range(17, 29)]
    assert ax.get_ylabel() == "reactions [m/s]"
    equal = legend(plot.multipliers(chain(), limit=3))
    assert (equal[0], equal[-1]) == ("friction[0]", "friction[19]")


def test_multipliers_that_are_not_there():
    with pytest.raises(PlotError, match="this run holds no reactions: its arrays are"):
        plot.multipliers(bridge(), which="reactions")
    with pytest.raises(PlotError, match="which is 'forces': give 'multipliers' or 'reactions'"):
        plot.multipliers(bridge(), which="forces")
    with pytest.raises(PlotError, match="no multipliers: its model has no law"):
        plot.multipliers(Trajectory({"t": np.zeros(2), "x": np.zeros((2, 1))}, {}))


def test_residual_scale_and_tolerance():
    ax = plot.residual(bridge())
    assert ax.get_yscale() == "log"
    assert legend(ax) == ["steps", "tolerance 1e-09"]
    assert set(ax.lines[-1].get_ydata()) == {1e-9}
    assert ax.get_ylabel() == "residual, no unit"


def test_residuals_of_zero_and_inf_are_shown_and_counted():
    values = np.r_[np.nan, 0.0, 1e-12, np.inf, 0.0, 1e-13]
    run = Trajectory({"t": np.arange(6.0), "x": np.zeros((6, 1)), "residual": values}, {"tolerance": 1e-9})
    ax = plot.residual(run)
    assert legend(ax) == ["steps", "exactly 0: 2 of 5, at the bottom", "unknown: 1 of 5, at the top", "tolerance 1e-09"]
    low, high = ax.get_ylim()
    zeros, unknown = ax.lines[1].get_xydata(), ax.lines[2].get_xydata()
    assert zeros[:, 0].tolist() == [1, 4]
    assert np.all((zeros[:, 1] > low) & (zeros[:, 1] < 1e-13))
    assert unknown[0, 0] == 3
    assert 1e-9 < unknown[0, 1] < high
    assert np.isnan(run.residual[0])


def test_a_residual_that_is_always_zero():
    run = altered(oscillator(), {"residual": np.zeros(301)})
    assert legend(plot.residual(run)) == ["exactly 0: 300 of 300, at the bottom", "tolerance 1e-09"]


def test_energy():
    ax = plot.energy(oscillator())
    assert (ax.get_ylabel(), len(ax.lines)) == ("energy [J]", 1)
    with pytest.raises(PlotError, match="this run holds no energy: its arrays are"):
        plot.energy(bridge())


# ---------------------------------------------------------------- configuration


def inside(ax, x, y):
    """Whether a point is in the shaded set."""
    shade = next(c for c in ax.collections if np.allclose(c.get_facecolor()[:1, :3], to_rgb(style.FORBIDDEN)))
    return any(path.contains_point((x, y)) for path in shade.get_paths())


def test_configuration_of_one_state():
    run, model = half_line()
    ax = plot.configuration(run, model)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("t [s]", "q [m]")
    assert legend(ax) == ["free", "in contact", "start (t = 0 s)", "end (t = 3 s)", "forbidden (g < 0)"]
    assert inside(ax, 1.5, 0.9)
    assert not inside(ax, 1.5, 1.1)


def test_configuration_of_two_states():
    run, model = past_disc()
    ax = plot.configuration(run, model)
    assert title(ax) == "Configuration at t = 3 s"
    assert legend(ax) == ["free", "in contact", "start (t = 0 s)", "end (t = 3 s)", "forbidden at t = 3 s"]
    assert ax.get_aspect() == 1
    assert inside(ax, 0, 0.9)
    assert not inside(ax, 0, 1.1)
    lines = [c for c in ax.collections if isinstance(c, LineCollection)]
    touching = next(c for c in lines if np.allclose(c.get_color()[:1, :3], to_rgb(style.ZERO)))
    assert len(touching.get_segments()) == (run.reactions > 0).sum()
    assert np.linalg.norm(touching.get_segments()[5], axis=1) == pytest.approx(1)


def test_a_moving_set_leaves_its_earlier_edges():
    run, model = past_disc(0.5)
    ax = plot.configuration(run, model)
    assert legend(ax)[-1] == "its edge at t = 0, 0.76, 1.5, 2.24 s"
    assert inside(ax, 1.5, 0.5)
    assert not inside(ax, 0, 0.5)
    earlier = plot.configuration(run, model, row=0)
    assert legend(earlier)[-2:] == ["now (t = 0 s)", "forbidden at t = 0 s"]
    assert inside(earlier, 0, 0.5)


def test_configuration_of_a_scene():
    run = crowd()
    ax = plot.configuration(run)
    assert legend(ax) == ["paths so far", "starts", "walls"]
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.get_aspect()) == ("x [m]", "y [m]", 1)
    bar = ax.figure.axes[-1]
    assert bar.get_ylabel() == "sum of reactions on a disc [m/s]"
    discs = next(c for c in ax.collections if c.get_array() is not None)
    np.testing.assert_allclose(discs.get_offsets(), run.x[-1].reshape(-1, 2))
    assert discs.get_array()[:3].tolist() == pytest.approx([0, 2, 5])
    walls = [line for line in ax.lines if line.get_label() == "walls"]
    assert len(walls) == 5
    assert ax.get_xlim()[0] < 0
    assert ax.get_xlim()[1] > 4


def test_a_scene_without_pressures_with_people_gone_and_an_exit():
    run = crowd()
    x = run.x.copy()
    x[20:, :2] = np.nan
    x[-1, 2:4] = 100.0
    scene = {**run.metadata["scene"], "exits": [[[4, 1.4], [4, 2.6]]]}
    ax = plot.configuration(altered(run, {"x": x}, constraint_bodies=None, scene=scene))
    assert title(ax) == "Configuration at t = 1 s (1 of 30 discs outside the picture)"
    assert legend(ax) == ["paths so far", "starts", "walls", "exit"]
    assert len(ax.figure.axes) == 1
    assert any(len(c.get_offsets()) == 29 for c in ax.collections)


def test_configuration_refuses_what_it_cannot_draw():
    run, model = past_disc()
    with pytest.raises(PlotError, match="for a SweepingProcess, and this run is of a LureSystem"):
        plot.configuration(bridge())
    with pytest.raises(PlotError, match="row 151 does not exist: this run has rows 0 to 150"):
        plot.configuration(run, model, row=151)
    with pytest.raises(PlotError, match="give the model as well"):
        plot.configuration(run)
    with pytest.raises(PlotError, match="this run has 60 and no scene"):
        plot.configuration(altered(crowd(), scene=None))
    with pytest.raises(PlotError, match="the model has 2 states and the run 1: they do not belong together"):
        plot.configuration(half_line()[0], model)
    with pytest.raises(PlotError, match="the scene has 2 discs and the run 60 states; expected two states for each disc"):
        plot.configuration(altered(crowd(), scene={"radii": [1, 1], "walls": []}))
    free = SimpleNamespace(t=model.t, q=model.q, u=model.u, constraints={"disc": model.q[0] - ca.SX.sym("radius")})
    with pytest.raises(PlotError, match="still hold radius: bind the parameters to numbers first"):
        plot.configuration(run, free)


# ---------------------------------------------------------------- whole figures


PANELS = {
    "bridge": ["States", "Index set", "Multipliers", "Phase portrait", "Residual"],
    "oscillator": ["States", "Index set", "Multipliers", "Phase portrait", "Energy", "Residual"],
    "chain": ["States", "Index set", "Multipliers", "Phase portrait", "Energy", "Residual"],
    "fixed disc": ["States", "Index set", "Multipliers", "Reactions", "Configuration", "Residual"],
    "moving disc": ["States", "Index set", "Multipliers", "Reactions", "Configuration", "Residual"],
    "half-line": ["States", "Index set", "Multipliers", "Reactions", "Configuration", "Residual"],
    "crowd": ["States", "Index set", "Multipliers", "Reactions", "Configuration", "Residual"],
}


@pytest.fixture(scope="module")
def drawn():
    """Return drawn(case) -> (run, overview, its pixels), each drawn once."""

    @functools.cache
    def draw(case):
        run, model = CASES[case]()
        figure = plot.overview(run, model)
        return run, figure, pixels(figure)

    return draw


@pytest.mark.parametrize("case", CASES)
def test_overview_is_composed_for_the_class(case, drawn):
    run, figure, image = drawn(case)
    assert image.shape[:2] == (900, 1400)
    assert figure.get_suptitle() == run.title
    assert [title(ax).split(" (")[0].split(" at ")[0] for ax in figure.axes if title(ax)] == PANELS[case]
    assert f"{len(run.t) - 1} steps" in figure.get_supxlabel()
    assert panel(figure, "States").get_xlim() == panel(figure, "Multipliers").get_xlim() == (run.t[0], run.t[-1])


@pytest.mark.parametrize("case", CASES)
def test_nothing_in_an_overview_overlaps_or_is_cut_off(case, drawn):
    _, figure, _ = drawn(case)
    frames = []
    for ax in figure.axes:
        keys = [*([ax._left_title] if title(ax) else []), *([ax.get_legend()] if ax.get_legend() else [])]
        for box in [ax.get_tightbbox(), *(key.get_window_extent() for key in keys)]:
            assert (box.extents >= 0).all(), title(ax)
            assert (box.extents[2:] <= [1400, 900]).all(), title(ax)
        if len(keys) == 2:
            assert not keys[0].get_window_extent().overlaps(keys[1].get_window_extent()), title(ax)
        frames += [(title(ax), key.get_window_extent(), ax) for key in keys]
    for name, key, own in frames:
        for other in figure.axes:
            same = other.bbox.bounds == own.bbox.bounds
            assert same or not key.overlaps(other.get_window_extent()), f"{name} on {title(other)}"
            assert same or other is own or not other.yaxis.get_tightbbox().overlaps(key), f"{name} on {title(other)}"


def test_the_footer_counts_steps_not_rows():
    run = altered(bridge(), steps=2800, save_every=7)
    words = plot.overview(run).get_supxlabel()
    assert words == "LureSystem, 2800 steps, step 1.25e-05 s, rows kept: one in 7, status: done"


def test_the_footer_leaves_unknown_steps_out():
    run = oscillator()
    step = run.step.copy()
    step[1] = np.nan
    assert "step 0.06667 s" in plot.overview(altered(run, {"step": step})).get_supxlabel()


def test_overview_of_the_barest_run():
    run = Trajectory({"t": np.linspace(0, 1, 5), "x": np.zeros((5, 1))}, {"model_class": "FirstOrderSystem"})
    figure = plot.overview(run)
    assert figure.get_suptitle() == "FirstOrderSystem"
    assert [title(ax) for ax in figure.axes] == ["States"]
    assert pixels(figure).std() > 5


@pytest.mark.parametrize("case", CASES)
def test_overview_of_a_run_without_a_step(case):
    run, model = CASES[case]()
    start = Trajectory({name: array[:1] for name, array in run.arrays.items()}, run.metadata)
    assert pixels(plot.overview(start, model)).std() > 5


FILES = {
    "bridge": ["states", "phase", "multipliers", "overview"],
    "oscillator": ["states", "phase", "multipliers", "energy", "overview"],
    "chain": ["states", "phase", "multipliers", "energy", "overview"],
    "fixed disc": ["states", "phase", "multipliers", "configuration", "overview"],
    "moving disc": ["states", "phase", "multipliers", "configuration", "overview"],
    "half-line": ["states", "multipliers", "configuration", "overview"],
    "crowd": ["states", "phase", "multipliers", "configuration", "overview"],
}


@pytest.mark.long
@pytest.mark.parametrize("case", CASES)
def test_save_all_writes_what_the_run_can_give(case, tmp_path):
    paths = plot.save_all(*CASES[case](), tmp_path / "new" / "folder", prefix="a_")
    assert [path.name for path in paths] == [f"a_{name}.png" for name in FILES[case]]
    assert sorted(paths) == sorted((tmp_path / "new" / "folder").iterdir())
    for path in paths:
        image = imread(path)[:, :, :3]
        assert image.std() > 0.02
        assert min(image.shape[:2]) >= 400
        assert np.all(image[:3] == 1), "something touches the upper edge"


@pytest.mark.parametrize("value", [None, 2.0])
def test_a_picture_knows_the_parameters_of_its_run(value):
    k = ca.SX.sym("k")
    A, B = ca.vertcat(ca.horzcat(0, 1), ca.horzcat(-k, 0)), ca.vertcat(0, 1 / k)
    model = LureSystem(A=A, B=B, C=[0, 1], law=laws.relay(1), x0=[1, 0], parameters={k: value}, t_end=1, step=0.1)
    run = simulate(model, parameters={"k": 3.0})
    known, bound = rounding._rounding_floors(run, model), rounding._rounding_floors(run, model.bind({"k": 3.0}))
    assert known is not None
    assert all(np.array_equal(one, other) for one, other in zip(known, bound, strict=True))


def test_save_all_without_the_model(tmp_path):
    names = [path.name for path in plot.save_all(past_disc()[0], None, tmp_path)]
    assert names == ["states.png", "phase.png", "multipliers.png", "overview.png"]


def test_a_picture_that_fails_leaves_the_old_one(tmp_path, monkeypatch):
    (tmp_path / "states.png").write_text("old")

    def fail(figure, target, **options):
        target.write_text("half")
        raise OSError("no space")

    monkeypatch.setattr(Figure, "savefig", fail)
    with pytest.raises(OSError, match="no space"):
        plot.save_all(bridge(), None, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["states.png"]
    assert (tmp_path / "states.png").read_text() == "old"


def test_matplotlib_is_imported_late_and_pyplot_never():
    code = (
        "import sys, numpy as np, nsmodel, nsmodel.plot as plot\n"
        "from nsmodel.simulation.trajectory import Trajectory\n"
        "print('matplotlib' in sys.modules)\n"
        "plot.overview(Trajectory({'t': np.arange(3.0), 'x': np.zeros((3, 2))}, {}))\n"
        "print('matplotlib.pyplot' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]


def test_results_find_their_displays_and_import_no_picture():
    """Also not inside functions: only the command line and what classes draw know `nsmodel.plot` beside itself."""
    root, named = Path(nsmodel.__file__).parent, set()
    for path in root.rglob("*.py"):
        text, place = path.read_text(), path.relative_to(root).parts
        named |= set(re.findall(r'\b(?:display|html_repr)\("(\w+)"', text))
        if place[0] not in ("plot", "cli") and place[-1] != "plots.py":
            assert not re.search(r"^\s*(?:from|import) nsmodel\.plot\b", text, re.MULTILINE), path
    assert named == {name for names in displays.DISPLAYS.values() for name in names}
