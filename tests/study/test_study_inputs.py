"""Study and stress of models with inputs and blocks: exact maps in other units, the judge at both ends of steps, references."""

import json
import sys
from dataclasses import replace

import block_scenes
import casadi as ca
import input_scenes
import numpy as np
import pytest

from nsmodel import (
    FrictionOscillator,
    MonotoneInclusion,
    SweepingProcess,
    UsageError,
    pwm,
    signal,
    simulate,
    steps,
    stress,
    study,
    table,
)
from nsmodel.cli import main
from nsmodel.modeling.signals.pwm import Pwm
from nsmodel.simulation.simulate import prepared_loop
from nsmodel.solvers.one_step_problem import one_step_problem
from nsmodel.study import methods
from nsmodel.study.reference import RunAtRows, make_row_stepper, nonuniqueness_reason
from nsmodel.study.reference_steps import formula_residuals
from nsmodel.study.stress import RIGHT, STOPPED
from nsmodel.study.units import in_units

T = input_scenes.T
UNITS = pytest.mark.parametrize(("u", "tau"), [(1e-9, 1e9), (3.0, 1e-9), (1.0, 7.0)])
t, q, u = (ca.SX.sym(name) for name in "tqu")


def at(run, times):
    """The rows at these times, which are on the grid."""
    rows = np.array([np.abs(run.t - time).argmin() for time in times])
    np.testing.assert_allclose(run.t[rows], times, rtol=1e-12)
    return run.x[rows]


# -- signals in another unit of time -----------------------------------------------------------------------------------


KINDS = {  # (signal, its edges before 4, u(t+) as a formula)
    "held": (table([0, 0.3, 1.7], [1, 2, 4]), [0.3, 1.7], lambda s: np.where(s < 0.3, 1.0, np.where(s < 1.7, 2.0, 4.0))),
    "periodic": (
        table([0, 0.3], [1, 5], after="periodic", period=0.7), [0.3, 0.7, 1.0, 1.4, 1.7, 2.1, 2.4, 2.8, 3.1, 3.5, 3.8],
        lambda s: np.where((s + 1e-12) % 0.7 < 0.3, 1.0, 5.0),
    ),
    "linear": (table([0, 1, 1, 3], [0, 3, 1, 9], "linear"), [1.0], lambda s: np.where(s < 1, 3 * s, 4 * s - 3)),
    "pwm": (pwm(1.0, 0.3, phase=0.1), [0.1, 0.4, 1.1, 1.4, 2.1, 2.4, 3.1, 3.4], lambda s: 1.0 * ((s - 0.1 + 1e-12) % 1 < 0.3)),
    "function": (signal(lambda s: 1 if s < 0.3 else np.sin(s), edges=[0.3]), [0.3], lambda s: np.where(s < 0.3, 1, np.sin(s))),
    "edges told by a function": (
        signal(lambda s: float(s >= 1.7), edges=lambda a, b: [1.7] if a <= 1.7 <= b else []), [1.7], lambda s: 1.0 * (s >= 1.7)
    ),
    "expression": (signal(ca.if_else(t < 0.3, 1, ca.sin(t)), edges=[0.3]), [0.3], lambda s: np.where(s < 0.3, 1, np.sin(s))),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("tau", [1e-9, 7.0, 1e9, 1 / 3])
def test_a_signal_in_another_unit_of_time(kind, tau):
    own, edges, value = KINDS[kind]
    other, edges = own.in_time(tau), np.array(edges)
    found = other.edges(4 * tau)
    np.testing.assert_allclose(found[found > 0], tau * edges, rtol=1e-14)
    np.testing.assert_allclose(other.after(found[found > 0])[:, 0], value(edges), atol=1e-12)
    np.testing.assert_allclose(other.before(found[found > 0])[:, 0], value(edges - 1e-9), atol=1e-7)
    between = np.array([0.05, 0.25, 1.23, 2.9])
    np.testing.assert_allclose(other.after(tau * between)[:, 0], value(between), atol=1e-12)
    if other.degree is not None and kind != "linear":
        np.testing.assert_allclose(other.kinks(4 * tau), [])


def test_a_duty_that_is_a_signal_and_a_spline_move_too():
    other = pwm(1.0, table([0, 2], [0.25, 0.5]), kind="centre").in_time(1e-6)
    np.testing.assert_allclose(
        other.edges(3.9e-6), 1e-6 * np.array([0.375, 0.625, 1.375, 1.625, 2.25, 2.75, 3.25, 3.75]), rtol=1e-13
    )
    x = np.array([0.0, 0.4, 1.1, 2.0, 2.7])
    spline = table(x, x**2, "cubic")
    between = np.linspace(0, 2.7, 23)
    np.testing.assert_allclose(spline.in_time(1e-6).after(1e-6 * between), spline.after(between), atol=1e-12)


# -- models in other units: exact maps ---------------------------------------------------------------------------------


@UNITS
def test_a_converter_in_other_units_has_its_edges_and_its_answer(u, tau):
    run = simulate(in_units(input_scenes.buck(t_end=20 * T).bind(), u, tau), rtol=1e-10)
    assert run.is_event_driven
    k = np.arange(21) * T
    np.testing.assert_allclose(at(run, tau * k) / u, input_scenes.exact_buck(20), atol=1e-9)
    at(run, tau * (k[:-1] + 0.4 * T))


@UNITS
def test_a_sampled_controller_in_other_units_ticks_as_it_did(u, tau):
    exact = block_scenes.exact_friction_pi()[:101]
    run = simulate(in_units(block_scenes.friction_pi(t_end=100 * block_scenes.TS).bind(), u, tau), rtol=1e-10)
    samples = tau * block_scenes.TS * np.arange(101)
    np.testing.assert_allclose(at(run, samples)[:, 0] / u, exact[:, 0], atol=1e-8)
    rows = np.array([np.abs(run.t - s).argmin() for s in samples])
    np.testing.assert_allclose(run.z[rows[1:]], exact[1:, 1], atol=1e-8)


@UNITS
def test_a_duty_that_a_block_sets_in_other_units(u, tau):
    run = simulate(in_units(block_scenes.regulated("centre", periods=20).bind(), u, tau), rtol=1e-10)
    np.testing.assert_allclose(at(run, tau * np.arange(21) * T) / u, block_scenes.exact_regulated("centre", 20), atol=1e-8)


@UNITS
def test_a_thyristor_fires_and_ends_where_it_did(u, tau):
    current, end = block_scenes.fired_current(60)
    run = simulate(in_units(block_scenes.fired(60).bind(), u, tau), rtol=1e-10)
    degrees = np.array([61.0, 90, 150, 200])
    np.testing.assert_allclose(run.at(tau * degrees / 360 * 0.02).x[:, 0] / u, current(degrees), rtol=1e-8)
    assert run.at(tau * np.array([(end + 1) / 360 * 0.02])).x[0, 0] == pytest.approx(0, abs=1e-8 * u)


# -- the judge, and what it judges -------------------------------------------------------------------------------------


def scenes():
    """One model with inputs for each judge; whether u matters at the begin of a step, and at its end."""
    cycle, rest = table([0, 0.3, 1, 2], [0, 1, 0, 0.5], "linear"), {"t_end": 1.0, "step": 0.05}
    yield "Lur'e", input_scenes.buck(t_end=3 * T), (1, 1)
    yield "Lur'e, gamma", block_scenes.regulated(gamma=0.5, periods=3), (0, 1)
    yield "first order", input_scenes.follower(cycle, **rest), (1, 1)
    yield "first order, gamma", input_scenes.boost(t_end=6e-5), (0, 1)
    yield "a block after each step", block_scenes.thermostat(t_end=0.1), (1, 1)
    yield (
        "sweeping",
        SweepingProcess(q=q, f=[u * q - 1], constraints={"wall": q - 0.3 * u}, q0=[0.3], inputs={u: cycle}, **rest),
        (1, 1),
    )
    mean = {"mean_forcing": True, **rest}
    yield (
        "mean forcing",
        SweepingProcess(q=q, f=[u - 1], constraints={"wall": q + 3}, q0=[0.3], inputs={u: cycle}, **mean),
        (1, 1),
    )
    yield (
        "oscillator",
        FrictionOscillator(
            x=q, potential=2 * q**2, friction=0.3 * t, s=t, force=[u], x0=1, v0=0, inputs={u: pwm(0.7, 0.3)}, **rest
        ),
        (0, 1),
    )
    parts = {
        "x": q,
        "field": [5 * (u - q)],
        "operator": [0.3 * ca.sign(q - 0.1 * u)],
        "upper": 0.2 + 0.2 * u,
        "x0": [0.2],
        **rest,
    }
    beside = {"x": q, "potential": 2 * q**2, "friction": 0.3 * t, "s": t, "x0": 1, "v0": 0, "outputs": {"p": u * q}, **rest}
    yield "oscillator beside its input", FrictionOscillator(inputs={u: pwm(0.7, 0.3)}, **beside), (0, 0)
    yield "catching-up", MonotoneInclusion(inputs={u: cycle}, **parts), (1, 1)
    yield "implicit", MonotoneInclusion(inputs={u: cycle}, scheme="implicit", **parts), (1, 1)


SCENES = {name: given for name, *given in scenes()}


@pytest.mark.parametrize("name", SCENES)
def test_the_judge_sees_what_a_step_saw_at_both_its_ends(name):
    model, matters = SCENES[name]
    model = model.bind()
    run = simulate(model, compiled=False)
    assert max(formula_residuals(model, run).values()) <= 1
    for side, seen in zip(("inputs_begin", "inputs"), matters, strict=True):
        run.arrays[side][5:] += 1e-2
        assert not seen or max(formula_residuals(model, run).values()) > 1, side
        run.arrays[side][5:] -= 1e-2


@pytest.mark.parametrize("name", SCENES)
def test_a_step_from_a_row_leads_to_the_next_row(name):
    run = prepared_loop(SCENES[name][0], compiled=False)
    start = run.propagator.state.copy()
    made = run.go()
    step = make_row_stepper(run.propagator, start, made)
    for row in range(min(20, len(made.t) - 1)):
        np.testing.assert_allclose(step(row, made.step[row + 1]), made.x[row + 1], rtol=1e-9, atol=1e-12)
    assert np.isfinite(step(3, 0.3 * made.step[4])).all()


@pytest.fixture
def few_cells(monkeypatch):
    monkeypatch.setattr(sys.modules["nsmodel.study.stress"], "STEP_FACTORS", (1.0, 10.0))


@pytest.mark.usefixtures("few_cells")
@pytest.mark.parametrize(
    "model",
    [
        input_scenes.buck(), block_scenes.regulated(), block_scenes.thermostat(step=0.02),
        input_scenes.follower(KINDS["function"][0], t_end=1, step=0.02),
    ],
    ids=["buck", "duty of a block", "thermostat", "function"],
)  # fmt: skip
def test_models_with_inputs_are_right_in_every_cell(model):
    found = stress(model)
    assert found.count(RIGHT) == len(found.cells) == 14
    checks = set().union(*(cell.checks for cell in found.cells))
    assert {"formula: equation", "other units", "inputs in other units"} <= checks
    assert all(24 <= cell.steps <= 26 for cell in found.cells)  # edges make no run longer; those of blocks by one a period


@pytest.mark.usefixtures("few_cells")
def test_a_signal_that_moves_with_its_unit_a_little_wrong_is_found(monkeypatch):
    monkeypatch.setattr(Pwm, "in_time", lambda self, tau: replace(self, period=tau * self.period * (1 + 1e-6)))
    found = stress(input_scenes.buck())
    assert {cell.factor for cell in found.wrong} == {1.0, 10.0}
    assert len(found.wrong) == 12
    assert all(cell.checks["inputs in other units"] > 1 for cell in found.wrong)


@pytest.mark.usefixtures("few_cells")
def test_cells_that_go_beyond_a_table_stop_and_say_so():
    """24 steps of 0.05 end after it, 24 of 0.005 do not."""
    found = stress(input_scenes.follower(table([0, 1], [1, 2], "linear", after="error"), t_end=1, step=0.005))
    assert {(cell.factor, cell.verdict) for cell in found.cells} == {(1.0, RIGHT), (10.0, STOPPED)}
    assert all("its table ends at t =" in cell.message for cell in found.cells if cell.verdict == STOPPED)


@pytest.mark.parametrize("of", [stress, study])
def test_signals_that_are_none_at_other_steps_are_refused(of):
    model = input_scenes.follower(1.0, t_end=1, step=0.1)
    with pytest.raises(UsageError, match=rf"{of.__name__}: input 'u' is steps\(\.\.\.\), one row for each step"):
        of(model, inputs={"u": steps(np.ones(10))})
    with pytest.raises(UsageError, match="input 'w' is not declared"):
        of(model, inputs={"w": 1})
    with pytest.raises(UsageError, match="input 'u' has no signal"):
        of(input_scenes.follower(None, t_end=1, step=0.1))


# -- studies -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def quick(monkeypatch):
    """One run a point, nothing compiled."""
    monkeypatch.setattr(methods, "MAX_REPEATS", 1)
    monkeypatch.setattr(methods, "ENOUGH_SECONDS", 0.0)
    monkeypatch.setattr(methods, "STUDY_RTOLS", (1e-3,))
    monkeypatch.setattr(methods, "FINE_RTOLS", ())
    words = ("interpreted", "compiled")
    monkeypatch.setattr(methods, "backend_methods", lambda scheme: [scheme.with_options(word, compiled=False) for word in words])


@pytest.mark.usefixtures("quick")
@pytest.mark.long
def test_errors_of_a_converter_are_those_beside_its_exact_map():
    found = study(input_scenes.buck(t_end=10 * T), steps=[T / 10, T / 20, T / 40], solvers=[])
    assert found.reference.text.startswith("an event-driven run")
    exact = input_scenes.exact_buck(10)
    line = found.line("theta = 1/2, gamma = 1, interpreted")
    for point in line.points:
        run = simulate(input_scenes.buck(t_end=10 * T), step=point.step)
        error = np.abs(run.x[-1] - exact[-1]) / found.reference.scale
        assert point.errors["end"] == pytest.approx(error.max(), rel=1e-5)
        assert point.steps == len(run.t) - 1
    assert 1.5 < line.order().fit < 2.2
    assert found.line("event-driven, interpreted").points[0].errors["end"] < 1e-12


@pytest.mark.usefixtures("quick")
def test_a_refined_run_is_compared_at_any_time_by_steps_from_its_rows():
    """x = 1 - exp(-t/0.3) until 0.37, then it decays: what rows of variable steps are compared with is that."""
    model = input_scenes.follower(signal(lambda s: float(s < 0.37), edges=[0.37], name="gate"), t_end=1, step=0.02)
    found = study(model, steps=[0.04, 0.02, 0.01], solvers=[])
    assert found.reference.text.startswith("a run of")
    assert any("event-driven, interpreted is left out" in note and "(function)" in note for note in found.notes)

    def exact(s):
        return np.where(s < 0.37, 1 - np.exp(-s / 0.3), (1 - np.exp(-0.37 / 0.3)) * np.exp(-(s - 0.37) / 0.3))

    times = np.array([0, 0.1234, 0.3699, 0.37, 0.3701, 0.5, 0.9876, 1])
    np.testing.assert_allclose(found.reference.state(times)[0][:, 0], exact(times), atol=2e-5)
    size = exact(np.array([0.37]))[0]
    for options in ({"step": 0.04}, {"rtol": 1e-3, "method": "time-stepping"}):
        run = simulate(model, **options)
        name = "theta = 1/2, gamma = 1, interpreted" + (", variable steps" if "rtol" in options else "")
        point = found.line(name).points[0]
        assert point.errors["max"] == pytest.approx(np.abs(run.x[:, 0] - exact(run.t)).max() / size, rel=0.1, abs=2e-5)


def test_what_is_asked_beyond_the_steps_that_are_taken_is_not_known():
    rows = np.linspace(0, 1, 11)
    state = RunAtRows(rows, rows[:, None] ** 2, lambda row, h: np.array([(rows[row] + h) ** 2]))
    times = np.unique(np.concatenate([rows, np.linspace(0.001, 0.999, 1500)]))
    found, more = state(times)
    known = np.isfinite(found[:, 0])
    assert known[np.isin(times, rows)].all()
    assert 300 <= known.sum() <= 311
    np.testing.assert_allclose(found[known, 0], times[known] ** 2, rtol=1e-9)
    assert more == 0


def test_multipliers_are_looked_at_with_the_inputs_of_their_steps():
    """With u = 0 in place of them the boost converter's rows would be i - l and v - s: regular only as they are."""
    model = input_scenes.boost(t_end=4e-5).bind()
    assert nonuniqueness_reason(model, one_step_problem(model), simulate(model)) == ""


FILE = """
import casadi as ca
from nsmodel import LureSystem, relay
v, u = ca.SX.sym("v"), ca.SX.sym("u")
model = LureSystem(x=v, A=-1, B=1, C=1, law=relay(1), x0=[2], f=[u], t_end=1, step=0.05, inputs={u: None}, title="Driven")
"""


@pytest.mark.usefixtures("quick", "few_cells")
def test_the_command_line_gives_signals_to_both(tmp_path, capsys):
    file, cycle = tmp_path / "driven.py", tmp_path / "cycle.csv"
    file.write_text(FILE)
    cycle.write_text("t,u\n0,0\n0.5,3\n1,0\n")
    given = ["--input", f"u={cycle},kind=linear", "--json"]
    assert main(["stress", str(file), *given]) == 0
    assert json.loads(capsys.readouterr().out)["right"] == 14
    assert main(["study", str(file), *given, "--solvers", "", "--steps", "0.1,0.05"]) == 0
    assert json.loads(capsys.readouterr().out)["title"] == "Driven"
    assert main(["stress", str(file)]) == 2
    assert "--input u=FILE.csv" in capsys.readouterr().err
