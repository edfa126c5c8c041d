"""Runs with inputs against exact maps and closed forms; what a step sees at an edge; files, resuming, errors."""

import csv

import casadi as ca
import input_scenes as scenes
import numpy as np
import pytest
from fuzz_models import share

from nsmodel import (
    Bodies,
    Family,
    FirstOrderSystem,
    LureSystem,
    ManyBodies,
    ModelError,
    MonotoneInclusion,
    RunInterrupted,
    StorageError,
    SweepingProcess,
    Trajectory,
    UsageError,
    codegen,
    complementarity,
    explain,
    pwm,
    relay,
    sampled,
    signal,
    simulate,
    table,
)
from nsmodel import steps as held_steps
from nsmodel.cli import main
from nsmodel.errors import CodegenError
from nsmodel.simulation import event_driven, fixed_grid, step_backend

T = scenes.T
WAYS = pytest.mark.parametrize("compiled", [False, True])


@pytest.fixture(autouse=True)
def _compiled_where_that_is_asked_for(monkeypatch):
    """No test of C passes because its steps were interpreted."""
    usual = step_backend.choose_step_backend

    def strict(options, *given):
        found = usual(options, *given)
        assert options.compiled is not True or found.steps is not None, found.warnings
        return found

    for module in (fixed_grid, event_driven):
        monkeypatch.setattr(module, "choose_step_backend", strict)


def at(run, times):
    """The rows at these times, which are on the grid."""
    rows = np.array([np.abs(run.t - time).argmin() for time in times])
    np.testing.assert_allclose(run.t[rows], times, rtol=1e-12)
    return run.x[rows]


# -- converters --------------------------------------------------------------------------------------------------------


@WAYS
@pytest.mark.parametrize(("R", "duty"), [(5.0, 0.4), (100.0, 0.4), (8.0, 0.25)])
def test_buck_against_its_exact_map(R, duty, compiled):
    run = simulate(scenes.buck(R, duty), compiled=compiled)
    right = scenes.exact_buck(200, R, duty)
    off = np.abs(at(run, T * np.arange(201)) - right).max(axis=0) / np.abs(right).max(axis=0)
    assert off.max() <= 1e-3
    if (R, duty) == (100.0, 0.4):
        np.testing.assert_allclose(right[10], [6.300178499492, 8.87919698747], atol=1e-9)
        assert (run.i[-3:] == 0).all()  # the third interval
    if (R, duty) == (5.0, 0.4):
        np.testing.assert_allclose(right[200], [1.638597109816, 9.672420113971], atol=1e-9)


def test_exact_edges_cost_no_accuracy():
    """Of steps that do not fit the period the worst v is off by 0.0026 V; a value held over the step would cost 0.18 V."""
    right = scenes.exact_buck(200)
    off = {}
    for n in (7.3, 10, 20, 100.7):
        run = simulate(scenes.buck(step=T / n))
        off[n] = np.abs(at(run, T * np.arange(201)) - right)[:, 1].max()
        assert np.unique(run.step[1:]).size <= 2  # though doubles give many lengths
    assert off[7.3] <= 0.003
    assert off[100.7] <= 3e-5
    assert off[10] / off[20] > 3.5  # order 2


@WAYS
def test_boost_whose_input_multiplies_unknowns(compiled):
    run = simulate(scenes.boost(), compiled=compiled)
    period = 2e-5
    right = [[1.20296763, 12.00049681], [10.425798933, 16.882649475], [0, 29.682227392], [2.925686972, 22.974239189]]
    np.testing.assert_allclose(at(run, period * np.array([1, 10, 50, 100])), right, atol=0.03)
    assert abs(at(run, [50 * period])[0, 0]) <= 1e-15


@pytest.mark.parametrize("gamma", [1.0, 0.5])
def test_a_reaction_carried_over_an_edge_is_of_the_new_regime(gamma):
    """x' = u - l, x = u_2 kept by l: l = u - u_2' jumps where u does, and gamma < 1 must not average over it."""
    x, l, u = ca.SX.sym("x"), ca.SX.sym("l"), ca.SX.sym("u")
    model = FirstOrderSystem(
        x=x, lam=l, f=[u - x], g=[-l], h=[l - 2 * u], law=relay(1, -1e9, 1e9), x0=[0.5], theta=0.5, gamma=gamma, step=0.05,
        t_end=2, inputs={u: table([0, 0.33, 1.1], [1, -2, 4])},
    )  # fmt: skip
    # -y in N_K(l): l = 2 u inside; x' = -u - x.
    run, right, t = simulate(model), 0.5, 0.0
    for end, value in ((0.33, 1), (1.1, -2), (2.0, 4)):
        right, t = -value + (right + value) * np.exp(-(end - t)), end
        assert abs(at(run, [end])[0, 0] - right) <= 2e-3
    with_c = simulate(model, compiled=True)
    np.testing.assert_allclose(with_c.x, run.x, rtol=1e-11)


# -- tables ------------------------------------------------------------------------------------------------------------


@WAYS
def test_drive_cycle_with_dry_friction(compiled):
    right = {
        2: 10 / 9, 4: 40 / 9, 5: 3.819444444444, 7: -0.863095238095, 8: -1.071428571429, 11: -0.208333333333, 13: -1.875,
        14: -5 / 3, 17: 0.136363636364, 20: 1.636363636364,
    }  # fmt: skip
    run = simulate(scenes.drive_cycle(), compiled=compiled)
    np.testing.assert_allclose(at(run, list(right))[:, 0], list(right.values()), atol=2e-3)
    assert (run.v[(run.t > 9.3) & (run.t < 10.4)] == 0).all()


@pytest.mark.long
def test_drive_cycle_under_error_control():
    run = simulate(scenes.drive_cycle(), rtol=1e-4, method="time-stepping")
    assert {2.0, 4.0, 5.0, 7.0, 8.0, 10.0, 11.0, 13.0, 14.0, 16.0, 17.0} <= set(run.t.tolist())
    np.testing.assert_allclose(run.x[-1], [1.636363636364, 8.446749628838], rtol=1e-3)


def test_a_polyline_that_jumps():
    signal = table([0, 1, 1, 2, 3.5], [0, 1, -1, -1, 2], "linear")
    right = [0.710702198004, -0.676890091076, -0.938972421169, 1.40445396879]
    for h, tolerance in ((0.01, 1e-4), (0.001, 1e-6)):
        run = simulate(scenes.follower(signal, t_end=3.5, step=h))
        np.testing.assert_allclose(at(run, [1, 1.5, 2, 3.5])[:, 0], right, atol=tolerance)
    run = simulate(scenes.follower(signal, t_end=3.5), rtol=1e-8, method="time-stepping")
    np.testing.assert_allclose(run.x[-1, 0], right[-1], rtol=3e-7)


def test_a_natural_spline():
    run = simulate(scenes.follower(table([0, 0.5, 1, 2, 3], [0, 1, 0.5, 2, 0], "cubic"), t_end=3, step=1e-3))
    assert abs(run.x[-1, 0] - 0.797115925266) <= 1e-6


def test_one_value_a_step_is_exact_for_a_double_integrator():
    values = np.random.default_rng(7).integers(-3, 4, 50)
    run = simulate(scenes.double_integrator(values, 0.1))
    np.testing.assert_allclose(run.x[[25, 50]], [[1.85, 0.6], [5.18, 1.2]], rtol=1e-13)
    assert (run.inputs[1:, 0] == values).all()
    assert (run.inputs_begin[1:, 0] == values).all()
    with pytest.raises(UsageError, match=r"input 'u': steps\(...\) has 50 rows, and the run 100 steps; give one for each"):
        simulate(scenes.double_integrator(values, 0.1), step=0.05)
    with pytest.raises(UsageError, match=r"input 'u': steps\(...\) has one row for each step, but rtol chooses the steps"):
        simulate(scenes.double_integrator(values, 0.1), rtol=1e-4, method="time-stepping")


def test_a_time_optimal_move_ends_at_rest():
    """Edges at irrational multiples of any step: p is exact, and v is 0 for ever."""
    for F in (0.0, 0.5):
        peak = np.sqrt(2) if F == 0 else np.sqrt(2 * 1.5 * 2.5 / 4)
        first = peak / (2 - F)
        second = first + peak / (2 + F)
        model = LureSystem(
            A=[[0, 0], [1, 0]], B=[1, 0], C=[1, 0], f=[u := ca.SX.sym("u"), 0], law=relay(1, -F, F), x0=[0, 0], theta=0.5,
            inputs={u: table([0, first, second], [2, -2, 0])}, t_end=2, step=0.0137,
        )  # fmt: skip
        run = simulate(model)
        assert abs(run.x[-1, 1] - 1) <= 1e-12
        rest = run.x[run.t > second * (1 + 1e-12), 0]
        assert np.abs(rest).max() <= (1e-14 if F == 0 else 0)


# -- event-driven ------------------------------------------------------------------------------------------------------


@WAYS
def test_pieces_end_at_edges(compiled):
    run = simulate(scenes.buck(), rtol=1e-8, method="event-driven", compiled=compiled)
    right = scenes.exact_buck(200)
    off = np.abs(run.at(T * np.arange(201)).x - right).max(axis=0)
    assert (off <= 1e-11 * np.abs(right).max(axis=0)).all()
    assert {0.4 * T, 1.4 * T, T, 100 * T} <= set(run.t.tolist())
    assert run.inputs[:5, 0].tolist() == [1, 1, 0, 1, 0]
    assert run.inputs_begin[1:5, 0].tolist() == [1, 0, 1, 0]
    assert len(run) < 420


@WAYS
@pytest.mark.parametrize("rtol", [1e-4, 1e-8, 1e-11])
def test_drive_cycle_to_its_exact_events(rtol, compiled):
    run = simulate(scenes.drive_cycle(), rtol=rtol, method="event-driven", compiled=compiled)
    np.testing.assert_allclose(run.x[-1], [1.636363636364, 8.446749628838], rtol=10 * rtol)
    found = np.array([event.t for event in run.events])
    for exact in (2 / 3, 6.309523809524, 9.285714285714, 10.5, 15.333333333333, 16.454545454545):
        assert np.abs(found - exact).min() <= 10 * max(rtol, 1e-12) * 20
    rest = run.at(np.linspace(9.3, 10.4, 12))
    assert (rest.v.shape[1], np.abs(rest.x[:, 0]).max()) == (0, 0)


@WAYS
@pytest.mark.parametrize("rtol", [1e-6, 1e-10])
def test_curves_are_polynomials_of_time(rtol, compiled):
    spline = scenes.follower(table([0, 0.5, 1, 2, 3], [0, 1, 0.5, 2, 0], "cubic"), t_end=3)
    run = simulate(spline, rtol=rtol, method="event-driven", compiled=compiled)
    assert abs(run.x[-1, 0] - 0.797115925266) <= 10 * rtol + 1e-12
    polyline = scenes.follower(table([0, 1, 1, 2, 3.5], [0, 1, -1, -1, 2], "linear"), t_end=3.5)
    run = simulate(polyline, rtol=rtol, method="event-driven", compiled=compiled, times=[1, 1.5, 2, 3.5])
    right = [0.710702198004, -0.676890091076, -0.938972421169, 1.40445396879]
    np.testing.assert_allclose(run.x[1:, 0], right, rtol=10 * rtol + 1e-11)
    assert run.inputs[:, 0].tolist() == [0, 1, -1, -1, 2]
    wave = scenes.follower(signal(ca.sin(ca.SX.sym("t"))), t_end=3)
    run = simulate(wave, rtol=rtol, method="event-driven", compiled=compiled)
    a, t = 1 / 0.3, run.t
    exact = a * (a * np.sin(t) - np.cos(t) + np.exp(-a * t)) / (1 + a**2)
    assert np.abs(run.x[:, 0] - exact).max() <= 10 * rtol


def test_boost_and_wall_by_pieces():
    """An input that multiplies unknowns; a wall that jumps pushes the state along, as an impulse does."""
    period, run = 2e-5, simulate(scenes.boost(), rtol=1e-9, method="event-driven")
    right = [[1.20296763, 12.00049681], [10.425798933, 16.882649475], [0, 29.682227392], [2.925686972, 22.974239189]]
    np.testing.assert_allclose(run.at(period * np.array([1, 10, 50, 100])).x, right, atol=2e-8)
    x, l, u = ca.SX.sym("x"), ca.SX.sym("l"), ca.SX.sym("u")
    model = FirstOrderSystem(
        x=x, lam=l, f=[-1], g=[l], h=[x - u], law=complementarity(1), x0=[1], t_end=2, inputs={u: table([0, 0.5, 1], [0, 2, 1])}
    )
    run = simulate(model, rtol=1e-8, method="event-driven")
    np.testing.assert_allclose(run.at([0.25, 0.75, 1.5, 2]).x[:, 0], [0.75, 2, 1.5, 1], atol=1e-12)
    jump = next(event for event in run.events if event.t == 0.5)
    assert (jump.x_before[0], jump.x_after[0], jump.impulse[0]) == pytest.approx((0.5, 2, 1.5), rel=1e-12)


@WAYS
def test_an_event_driven_run_is_resumed_byte_for_byte(tmp_path, compiled):
    model = scenes.drive_cycle()
    simulate(model, rtol=1e-6, out=tmp_path / "parts", t_end=7.7, compiled=compiled)
    simulate(model, rtol=1e-6, out=tmp_path / "parts", resume=True, compiled=compiled)
    simulate(model, rtol=1e-6, out=tmp_path / "whole", compiled=compiled)
    parts, whole = (tmp_path / name / "trajectory.npz" for name in ("parts", "whole"))
    assert parts.read_bytes() == whole.read_bytes()


@pytest.mark.parametrize("made", [lambda: signal(np.sin), lambda: np.sin])
def test_a_function_goes_by_time_stepping(made):
    given = made() if not callable(made()) else signal(made())
    model = scenes.follower(given, t_end=1)
    run = simulate(model, rtol=1e-4)
    assert not run.is_event_driven
    assert any("input 'u' is not a polynomial between known times (function)" in line for line in run.metadata["left_out"])
    with pytest.raises(UsageError, match=r"not event-driven: input 'u' is not a polynomial between known times \(function\)"):
        simulate(model, rtol=1e-4, method="event-driven")


def test_random_tables_by_pieces_and_by_steps():
    """Pieces against steps of order 2 between the same edges, two inputs, one of them within h."""
    rng = np.random.default_rng(11)
    for kind in ("hold", "linear", "cubic"):
        for _ in range(share(2)):
            x, l, u, w = ca.SX.sym("x", 2), ca.SX.sym("l"), ca.SX.sym("u"), ca.SX.sym("w")
            times = np.concatenate([[0], np.sort(rng.uniform(0, 4, 6))])
            model = FirstOrderSystem(
                x=x, lam=l, f=[x[1] + w, -x[0] - 0.2 * x[1] + u], g=[0, l], h=[x[1] + 0.3 * l + 0.1 * w], law=complementarity(1),
                x0=[1, 0], t_end=4, theta=0.5, gamma=0.5, step=4e-3,
                inputs={u: table(times, rng.normal(size=7), kind), w: table(times * 0.9, rng.normal(size=7), "linear")},
            )  # fmt: skip
            fine, steps = simulate(model, rtol=1e-10), simulate(model)
            assert fine.is_event_driven
            assert np.abs(fine.at(steps.t).x - steps.x).max() <= 3e-4


# -- other classes -----------------------------------------------------------------------------------------------------


@WAYS
@pytest.mark.parametrize("mean", [False, True])
def test_a_sweeping_set_that_an_input_moves(mean, compiled):
    """q_0 is pushed towards the wall q_0 <= 1 + u, and follows it back; q_1 is the integral of u."""
    q, u = ca.SX.sym("q", 2), ca.SX.sym("u")
    model = SweepingProcess(
        q=q, f=[2, u], constraints={"wall": 1 + u - q[0]}, q0=[0, 0], t_end=3, step=0.01, mean_forcing=mean,
        inputs={u: table([0, 1, 2], [0, 1, 0], "linear")},
    )  # fmt: skip
    run = simulate(model, compiled=compiled)
    t = run.t
    right = np.where(t < 1, np.minimum(2 * t, 1 + t), np.where(t < 2, 3 - t, 1))
    np.testing.assert_allclose(run.x[:, 0], right, atol=1e-12)
    integral = np.where(t < 1, t**2 / 2, np.where(t < 2, 1 - (2 - t) ** 2 / 2, 1))
    np.testing.assert_allclose(run.x[:, 1], integral, atol=1e-12 if mean else 0.0051)
    if not (mean or compiled):
        assert abs(simulate(model, rtol=1e-3, method="time-stepping").x[-1, 0] - 1) <= 1e-12


@pytest.mark.parametrize(("scheme", "tolerance"), [("implicit", 1e-12), ("catching-up", 0.021)])
def test_a_monotone_inclusion_that_an_input_drives(scheme, tolerance):
    """x' = u - sgn(x) within x <= 1.5 + u/4."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    model = MonotoneInclusion(
        x=x, field=u, operator=ca.sign(x), x0=1, lower=-2, upper=u / 4 + 1.5, t_end=4, step=0.01, scheme=scheme,
        inputs={u: table([0, 1, 2.5], [0, 2.0, -0.5])},
    )  # fmt: skip
    run = simulate(model)
    right = [[0.5], [0], [0.5], [1.375], [0]]
    np.testing.assert_allclose(at(run, [0.5, 1, 1.5, 2.51, 4]), right, atol=max(tolerance, 0.016))
    assert run.x.max() <= 2 + 1e-12


# -- the grid ----------------------------------------------------------------------------------------------------------


def test_a_step_never_straddles_an_edge():
    rng = np.random.default_rng(5)
    for _ in range(20):
        times = np.sort(rng.uniform(0, 2, 6))
        run = simulate(scenes.follower(table(times, rng.normal(size=6)), t_end=2, step=rng.uniform(0.01, 0.3)))
        assert set(times[times > times[0]]) <= set(run.t)
        np.testing.assert_array_equal(run.inputs_begin[1:], run.inputs[1:])
        np.testing.assert_allclose(np.diff(run.t), run.step[1:], rtol=1e-9)
        assert run.t[-1] == 2


def test_edges_that_hurt():
    """At the ends of the run; twice; 1e-18 after another; a pulse of 1e-12 s; duty 0 and 1."""
    plain = simulate(scenes.follower(1.0, t_end=1, step=0.1))
    same = simulate(scenes.follower(table([0, 1, 2], [1, 3, 4]), t_end=1, step=0.1))
    np.testing.assert_array_equal(plain.t, same.t)
    np.testing.assert_array_equal(plain.x, same.x)
    x, l, u, w = (ca.SX.sym(name) for name in ("x", "l", "u", "w"))
    model = FirstOrderSystem(
        x=x, lam=l, f=[u + w], g=[0], h=[l], law=complementarity(1), x0=[0], t_end=1, step=0.1,
        inputs={u: table([0, 0.3], [1, 0]), w: table([0, 0.1 + 0.2], [0, 1])},
    )  # fmt: skip
    assert len(simulate(model)) == 10
    short = simulate(scenes.buck(duty=1e-7, t_end=3 * T))
    assert short.step[1:].min() == pytest.approx(1e-12, rel=1e-6)
    assert (short.residual[1:] <= 1e-9).all()
    for duty in (0.0, 1.0):
        run = simulate(scenes.buck(duty=duty, t_end=3 * T))
        assert len(run) == 60
        assert (run.inputs == duty).all()


def test_given_steps_must_end_at_edges():
    model = scenes.follower(table([0, 0.25], [1, 2]), t_end=1, step=0.1)
    run = simulate(model, steps=[0.1, 0.15, 0.5, 0.25])
    assert run.inputs[:, 0].tolist() == [1, 1, 1, 2, 2]
    with pytest.raises(
        UsageError, match=r"steps: step 1 goes over t = 0.25, where an input jumps or bends, or a block ticks; let a step end"
    ):
        simulate(model, steps=[0.1, 0.5, 0.4])


# -- what a run holds --------------------------------------------------------------------------------------------------


def two_inputs(**fields):
    x, l, u, w = ca.SX.sym("x"), ca.SX.sym("l"), ca.SX.sym("u"), ca.SX.sym("w", 2)
    return FirstOrderSystem(
        x=x, lam=l, f=[u - x + w[0]], g=[l], h=[x - w[1]], law=complementarity(1), x0=[1], t_end=2, step=0.1, theta=0.5,
        inputs={u: table([0, 1], [1, -3]), w: table([0, 0.5, 2], [[0, 0.1], [1, 0.2], [0, 0.3]], "linear")},
        units={"u": "N", "w": "m"}, **fields,
    )  # fmt: skip


def test_a_residual_can_be_recomputed_from_the_rows():
    run = simulate(two_inputs())
    a, b, h = run.inputs_begin[1:], run.inputs[1:], run.step[1:]
    begin, end = a[:, 0] - run.x[:-1, 0] + a[:, 1], b[:, 0] - run.x[1:, 0] + b[:, 1]
    moved = h * (begin + end) / 2 + h * run.multipliers[1:, 0]
    np.testing.assert_allclose(run.x[1:, 0] - run.x[:-1, 0], moved, atol=1e-14)
    np.testing.assert_allclose(run.y[1:, 0], run.x[1:, 0] - b[:, 2], atol=1e-14)
    np.testing.assert_array_equal(run.u, run.inputs[:, 0])
    np.testing.assert_array_equal(run.w, run.inputs[:, 1:])
    assert run.inputs[0].tolist() == [1, 0, 0.1]


def test_files_pictures_and_tables(tmp_path):
    run = simulate(two_inputs())
    run.save(tmp_path / "run.npz")
    again = Trajectory.load(tmp_path / "run.npz")
    np.testing.assert_array_equal(again.w, run.w)
    run.to_csv(tmp_path / "run.csv")
    with (tmp_path / "run.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert float(rows[-1]["input:u"]) == -3
    assert float(rows[10]["input:w_0"]) == pytest.approx(run.w[10, 0], rel=1e-15)
    assert "input after the row before:w_1" in rows[0]
    from nsmodel import plot

    axes = plot.inputs(run)
    t, u = axes.lines[0].get_data()
    jump = np.flatnonzero(t == 1.0)
    assert u[jump].tolist() == [1, -3]
    assert "[N]" in axes.get_legend().get_texts()[0].get_text()
    names = {path.name for path in plot.save_all(run, None, tmp_path)}
    assert "inputs.png" in names
    xarray = pytest.importorskip("xarray")
    data = run.to_xarray()
    assert isinstance(data, xarray.Dataset)
    assert data["inputs"].dims == ("time", "input")
    assert data["input"].values.tolist() == ["u", "w_0", "w_1"]


@pytest.mark.parametrize("stop", [1, 7, 17])
def test_a_run_that_is_resumed_has_the_same_bytes(tmp_path, stop, monkeypatch):
    model, gamma = two_inputs(gamma=0.5), 0.5
    assert model.gamma == gamma
    whole = simulate(model, out=tmp_path / "whole", compiled=False)
    from nsmodel.simulation import fixed_grid

    usual, calls = fixed_grid.FixedGridPropagator._advance_interpreted, []

    def interrupted(self, end, signals):
        calls.append(self.k)
        if self.k >= stop:
            signals.append(0.0)
        return usual(self, min(end, stop) if self.k < stop else end, signals)

    monkeypatch.setattr(fixed_grid.FixedGridPropagator, "_advance_interpreted", interrupted)
    with pytest.raises(RunInterrupted):
        simulate(model, out=tmp_path / "parts", compiled=False)
    monkeypatch.setattr(fixed_grid.FixedGridPropagator, "_advance_interpreted", usual)
    assert calls
    again = simulate(model, out=tmp_path / "parts", resume=True, compiled=False)
    assert (tmp_path / "whole/trajectory.npz").read_bytes() == (tmp_path / "parts/trajectory.npz").read_bytes()
    assert len(again) == len(whole)


def test_a_run_with_another_signal_is_not_resumed(tmp_path):
    def model(value):
        return scenes.follower(table([0, 0.5], [1, value]), t_end=1, step=0.1)

    simulate(model(2), out=tmp_path)
    with pytest.raises(StorageError, match="the run there was made with another inputs"):
        simulate(model(3), out=tmp_path, resume=True, t_end=2)


def test_a_run_is_resumed_to_a_later_end(tmp_path):
    model = scenes.follower(pwm(0.25, 0.3), t_end=1, step=0.05)
    simulate(model, out=tmp_path, compiled=False)
    longer = simulate(model, out=tmp_path, resume=True, t_end=2, compiled=False)
    np.testing.assert_array_equal(longer.x, simulate(model, t_end=2, compiled=False).x)


# -- how inputs are given ----------------------------------------------------------------------------------------------


def test_signals_are_given_to_the_model_or_to_the_run():
    right = simulate(scenes.follower(table([0, 0.5], [1, 2]), t_end=1, step=0.1)).x
    model = scenes.follower(None, t_end=1, step=0.1)
    given = simulate(model, inputs={"u": table([0, 0.5], [1, 2])})
    np.testing.assert_array_equal(given.x, right)
    with pytest.raises(UsageError, match=r"input 'u' has no signal; give inputs={'u': ...} or --input u=FILE.csv"):
        simulate(model)
    t = ca.SX.sym("t")
    as_number, as_expression = simulate(model, inputs={"u": 3}), simulate(model, inputs={"u": 3 + 0 * t})
    np.testing.assert_array_equal(as_number.x, as_expression.x)
    waves = [simulate(model, inputs={"u": made}).x for made in (ca.sin(t), signal(np.sin), signal(ca.sin(t)))]
    np.testing.assert_allclose(waves[0], waves[1], rtol=1e-13)
    np.testing.assert_array_equal(waves[0], waves[2])


def test_explain_names_inputs_and_edges():
    text = explain(scenes.buck(t_end=10 * T))
    assert "inputs u (pwm): a step ends at each of 19 times at which they jump, bend or tick" in text


@pytest.mark.parametrize(
    ("inputs", "error", "words"),
    [
        ({"u": table([0, 1], [[1, 2], [3, 4]])}, UsageError, "input 'u' has one value, and its table has 2; give as many"),
        ({"u": [1, 2, 3]}, UsageError, "input 'u' has one value, and its value has 3; give as many"),
        ({"uu": 1}, UsageError, "input 'uu' is not declared; the model has u. Did you mean 'u'?"),
        ({"u": np.sin}, UsageError, r"input 'u': a function; give signal\(function, edges=\[...\]\), with the times at which it"),
        ({"u": np.nan}, ModelError, "input 'u': its value = nan; expected finite numbers"),
        ({"u": ca.SX.sym("z")}, ModelError, "input 'u' uses the symbol 'z', which is not declared"),
        ([1], UsageError, r"inputs: expected a dictionary \{name: signal\}, not a list"),
        (
            {"u": table([0, 0.5], [1, 2], after="error")},
            ModelError,
            "input 'u': its table ends at t = 0.5, before the run",
        ),
        ({"u": signal(lambda t: 1 if t < 0.5 else np.inf, name="load")}, ModelError, "signal 'load': its value at t = 0.5 = inf"),
    ],
)
def test_bad_inputs_of_a_run_are_refused(inputs, error, words):
    with pytest.raises(error, match=words):
        simulate(scenes.follower(None, t_end=1, step=0.1), inputs=inputs)


def declared(**fields):
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    given = {"A": [[0]], "B": [1], "C": [1], "f": [u], "x0": [0], "inputs": {u: 1}, "x": x} | fields
    return LureSystem(law=relay(1), t_end=1, step=0.1, **given)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"inputs": [1]}, r"inputs: expected a dictionary \{symbol: signal\}, not a list"),
        ({"inputs": {"x": 1}}, "'x'"),
        ({"inputs": {"multipliers": 1}}, "inputs: 'multipliers' clashes with run.multipliers, an attribute of runs"),
        ({"inputs": {}}, "'u'"),
        ({"C": [ca.SX.sym("u")]}, "C depends on 'u', but may depend only on"),
        ({"x0": [ca.SX.sym("u")]}, "x0 depends on 'u', but may depend only on"),
        ({"exact": [ca.SX.sym("u")]}, "'u'"),
        ({"units": {"w": "V"}}, "units: 'w' is not a state, multiplier or time; the model has t, x, l_0, u"),
    ],
)
def test_bad_declarations_are_refused(fields, words):
    with pytest.raises(ModelError, match=words):
        declared(**fields)


def test_nan_in_the_middle_of_a_run_keeps_what_there_is():
    model = scenes.follower(signal(lambda t: 1.0 if t < 0.72 else np.nan, name="sensor"), t_end=1, step=0.1)
    with pytest.raises(ModelError, match=r"signal 'sensor': its value at t = 0\.8 = nan; expected finite numbers"):
        simulate(model)


def test_what_takes_no_inputs_says_so():
    model = scenes.buck(t_end=2 * T)
    with pytest.raises(UsageError, match=r"has inputs \(u\); certificates do not cover signals"):
        model.check_allowed("certificate")
    with pytest.raises(UsageError, match="not event-driven: certify='interval' applies only to models without inputs"):
        simulate(model, rtol=1e-4, certify="interval")


# -- the command line --------------------------------------------------------------------------------------------------

MODEL = """
import casadi as ca
from nsmodel import LureSystem, relay
u = ca.SX.sym("u")
model = LureSystem(A=[[0]], B=[1], C=[1], f=[u], law=relay(1), x0=[0], inputs={u: None}, t_end=2, step=0.1, title="A mass")
"""


def test_an_input_from_a_file(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mass.py").write_text(MODEL)
    (tmp_path / "cycle.csv").write_text("t,other,u\n0,9,0\n1,9,3\n2,9,3\n")
    assert main(["run", "mass.py", "--input", "u=cycle.csv,kind=linear", "--out", "out", "--explain"]) == 0
    assert "inputs u (table): a step ends at each of 1 times" in capsys.readouterr().out
    run = Trajectory.load("out/trajectory.npz")
    assert run.u[[0, 5, 10, 20]].tolist() == [0, 1.5, 3, 3]
    assert main(["run", "mass.py", "--input", "u=2.5", "--quiet"]) == 0
    (tmp_path / "plain.csv").write_text("0,0\n1,3\n")
    assert main(["run", "mass.py", "--input", "u=plain.csv,after=periodic,period=1.5", "--quiet"]) == 0


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ([], "input 'u' has no signal; give inputs={'u': ...} or --input u=FILE.csv"),
        (["u"], "--input u: expected NAME=FILE.csv or NAME=NUMBER"),
        (["u=missing.csv"], "missing.csv cannot be read"),
        (["u=1", "u=2"], "--input gives 'u' twice; keep one"),
        (["w=1"], "input 'w' is not declared; the model has u"),
        (["u=bad.csv"], "bad.csv, row 2: '1, x' is not a row of numbers"),
        (["u=wide.csv"], "wide.csv has 3 columns; expected t and u, or a first row with these names"),
        (["u=ok.csv,kind=spline"], "table: kind = 'spline'; expected one of hold, linear, cubic"),
        (["u=ok.csv,mode=1"], "'mode=1'; expected kind=..., after=..., period=..., each once at most"),
        (["u=empty.csv"], "empty.csv is empty"),
        (["u=back.csv"], "table: t[1] = 0 is not after t[0] = 1"),
    ],
)
def test_bad_input_options_are_refused(tmp_path, capsys, monkeypatch, given, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mass.py").write_text(MODEL)
    texts = {"bad": "0,0\n1,x\n", "wide": "0,1,2\n", "ok": "0,0\n1,3\n", "empty": "\n", "back": "1,0\n0,0\n"}
    for name, text in texts.items():
        (tmp_path / f"{name}.csv").write_text(text)
    assert main(["run", "mass.py", *(part for one in given for part in ("--input", one))]) == 2
    assert words in capsys.readouterr().err


def test_edges_of_expressions_are_those_of_the_run_in_c_too():
    """One model, other edges: not the library that was built for the first."""
    for edges in ([0.5], [0.25, 0.7]):
        model = scenes.follower(signal(ca.sin(ca.SX.sym("t")), edges=edges), t_end=1)
        assert set(edges) <= set(simulate(model, rtol=1e-6, method="event-driven", compiled=True).t.tolist())


def marbles(signal, **fields):
    """Discs that a wind u(t) pushes from side to side, and that something pulls together."""
    places = 0.6 * np.stack(np.meshgrid(np.arange(4.0), np.arange(3.0)), axis=-1).reshape(-1, 2)
    bodies, u = Bodies(places, r=np.full(12, 0.25)), ca.SX.sym("u")
    i, j = bodies.member("i"), bodies.member("j")
    given = {"f": ca.vertcat(u - i.q[0], -i.q[1]), "inputs": {u: signal}, "t_end": 2, "step": 0.03} | fields
    return ManyBodies(bodies=bodies, constraints={"apart": Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j)}, **given)


@pytest.mark.parametrize("compiled", [False, True])
def test_inputs_drive_many_bodies(compiled):
    model = marbles(pwm(0.5, 0.37, low=-1))
    run = simulate(model, compiled=compiled)
    assert run.metadata["totals"]["most_contacts"] > 10
    edges = np.array([0.185, 0.5, 0.685, 1.0, 1.185, 1.5, 1.685])
    assert np.abs(run.t[:, None] - edges).min(axis=0).max() < 1e-15
    whole = simulate(model.written_out(), compiled=False)
    np.testing.assert_allclose(run.x, whole.x, atol=1e-13)
    np.testing.assert_array_equal(run.inputs, whole.inputs)
    every = simulate(model, compiled=compiled, save_every=5)
    np.testing.assert_array_equal(every.inputs_begin[1:-1], run.inputs_begin[5:-1:5])


def test_many_bodies_with_a_constant_input_are_those_with_a_number():
    number = simulate(marbles(None, f=None), inputs={"u": 0}).x
    np.testing.assert_array_equal(simulate(marbles(None, f=None), inputs={"u": 3}).x, number)
    i = Bodies([[0.0]], r=[1.0])
    u, me = ca.SX.sym("u"), i.member("i")
    model = ManyBodies(bodies=i, f=u - me.q, inputs={u: None}, t_end=1, step=0.1)
    x = simulate(model, inputs={"u": 2}).x[:, 0]
    np.testing.assert_allclose(x, 2 * (1 - 0.9 ** np.arange(11)), rtol=1e-13)


def test_what_many_bodies_do_not_take(tmp_path):
    u, z, bodies = ca.SX.sym("u"), ca.SX.sym("z"), Bodies([[0.0, 0.0]], r=[1.0])
    with pytest.raises(UsageError, match="input 'u': many bodies take no steps"):
        simulate(marbles(held_steps(np.ones(67))))
    with pytest.raises(ModelError, match=r"leave.*'u'"):
        ManyBodies(bodies=bodies, f=0, leave=bodies.member("i").q[0] - u, t_end=1, step=0.1, inputs={u: 1})
    with pytest.raises(ModelError, match="blocks: many bodies take none"):
        ManyBodies(bodies=bodies, f=0, t_end=1, step=0.1, blocks=[sampled("b", period=1, memory={z: 0})])
    with pytest.raises(CodegenError, match=r"many bodies with inputs \(u\) have no C counterpart"):
        codegen.write(marbles(1), tmp_path)


def test_a_constraint_that_is_not_convex_with_an_input():
    """What a step checks of its linearisation is the position, behind which the state has the inputs."""
    q, u, t = ca.SX.sym("q", 2), ca.SX.sym("u"), ca.SX.sym("t")

    def past_disc(wind, **fields):
        force = ca.vertcat(1, 0.3 + wind)
        return SweepingProcess(
            t=t, q=q, f=force, constraints={"disc": ca.norm_2(q) - 1}, q0=[-1.5, 0.1], t_end=3, step=0.01, **fields
        )

    driven = simulate(past_disc(u, inputs={u: 0.2}), compiled=False)
    assert (driven.multipliers[1:] > 0).sum() > 50
    np.testing.assert_allclose(driven.x, simulate(past_disc(0.2), compiled=False).x, atol=1e-14)


def test_columns_of_inputs_have_their_names_in_files_too(tmp_path):
    z, a, v = (ca.SX.sym(name, size) for name, size in (("z", 1), ("a", 1), ("v", 2)))
    x = ca.SX.sym("x")
    model = FirstOrderSystem(x=x, f=[z + a + ca.sum1(v)], x0=[0], inputs={z: 3, v: [5, 7], a: 1}, t_end=1, step=0.5)
    run = simulate(model)
    run.save(tmp_path / "run.npz")
    for one in (run, Trajectory.load(tmp_path / "run.npz"), simulate(model, out=tmp_path / "out")):
        assert (one.z[-1], one.a[-1], one.v[-1].tolist()) == (3, 1, [5, 7])
        one.to_csv(tmp_path / "run.csv")
        with open(tmp_path / "run.csv", newline="") as file:
            last = list(csv.DictReader(file))[-1]
        assert {name: float(last[f"input:{name}"]) for name in ("z", "v_0", "v_1", "a")} == {"z": 3, "v_0": 5, "v_1": 7, "a": 1}
        assert one.evaluate(z - 2 * a)[-1] == 1


def test_impacts_are_seen_with_inputs():
    q, v, l, u = (ca.SX.sym(name) for name in ("q", "v", "l", "u"))

    def dropped(force, **fields):
        return FirstOrderSystem(
            x=ca.vertcat(q, v),
            lam=l,
            f=[v, force],
            g=[0, l],
            h=[q],
            law=complementarity(1),
            x0=[1, 0],
            t_end=2,
            step=0.01,
            **fields,
        )

    said = simulate(dropped(-9.81)).metadata["warnings"]
    assert "where y closes 'v' must jump, here once, at t = 0.45" in said[0]
    for compiled in (False, True):
        assert simulate(dropped(u, inputs={u: -9.81}), compiled=compiled).metadata["warnings"] == said
    chopped = simulate(dropped(u, inputs={u: pwm(0.3, 0.5, low=-15, high=-5)})).metadata["warnings"]
    assert "where y closes 'v' must jump, here once, at t = 0.49" in chopped[0]  # 0.15 at -5, 0.15 at -15, 0.15 at -5, then -15


@pytest.mark.long
def test_a_set_that_an_input_moves_is_drawn(tmp_path):
    from nsmodel import plot

    q, u = ca.SX.sym("q", 2), ca.SX.sym("u")
    given = {u: table([0, 0.5, 1], [0, 0.5, 0], "linear")}
    model = SweepingProcess(q=q, f=[1, 0], constraints={"w": 1 + u - q[0]}, q0=[0, 0], t_end=1, step=0.1, inputs=given)
    for run in (simulate(model), simulate(model, rtol=1e-6)):
        assert {"configuration.png", "inputs.png"} <= {path.name for path in plot.save_all(run, model, tmp_path)}
        drawn = run.smooth()
        np.testing.assert_allclose(drawn.u, np.interp(drawn.t, [0, 0.5, 1], [0, 0.5, 0]), atol=1e-12)
