"""Many event-driven runs a call, one library for all values: closed forms, single runs bit for bit, any order, failures."""

from __future__ import annotations

import ctypes
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import nsmodel
from nsmodel import FirstOrderSystem, FrictionOscillator, LureSystem, SweepingProcess, ball, box, codegen, relay, simulate
from nsmodel.codegen import event_driven_batch, event_driven_runs
from nsmodel.codegen.event_driven_batch import PieceBatch
from nsmodel.codegen.library import COMPILER_FLAGS, compile_library
from nsmodel.codegen.structs import STATUSES
from nsmodel.errors import CodegenError, UsageError
from tests.event_models import CLASSES
from tests.parametrised import with_parameters

CC = next((name for name in ("gcc", "cc", "clang") if shutil.which(name)), None)
pytestmark = pytest.mark.skipif(CC is None, reason="no C compiler")
RTOL = 1e-8
OK, BAD_PARAMETER, NO_MODE = ([status.name for status in STATUSES].index(name) for name in ("OK", "BAD_PARAMETER", "NO_MODE"))


def symbols(names):
    return [ca.SX.sym(name) for name in names.split()]


def by_input():
    """Friction in the matrix of l."""
    a, k, x0 = symbols("a k x0")
    A = ca.vertcat(ca.horzcat(0, 1), ca.horzcat(-k, 0))
    return LureSystem(A=A, B=ca.vertcat(0, a), C=[[0, 1]], law=relay(1), x0=[x0, 0], parameters={a: 1, k: 1, x0: 4}, t_end=12)


def by_ends():
    """Friction in the ends of the law, which are 0 at first."""
    a, k, x0 = symbols("a k x0")
    A = ca.vertcat(ca.horzcat(0, 1), ca.horzcat(-k, 0))
    law = relay(1, -a, a)
    return LureSystem(A=A, B=[0, 1], C=[[0, 1]], law=law, x0=[x0, 0], parameters={a: 0, k: 1, x0: 4}, t_end=12)


def by_class():
    """Friction of an oscillator."""
    a, k, x0, x, s = symbols("a k x0 x s")
    given = {a: 1, k: 1, x0: 4}
    return FrictionOscillator(x=x, potential=k * x**2 / 2, friction=a * s, s=s, x0=x0, v0=0, parameters=given, t_end=12)


def swings(a, k, x0, t):
    """Position (cells, R), half swings until rest, and when that is."""
    a, k, x0 = (column[:, None] for column in (a, k, x0))
    w, n = np.sqrt(k), np.maximum(0, np.ceil((x0 * k / a - 1) / 2))
    j = np.minimum(np.floor(t * w / np.pi), n)
    sign, top = (-1.0) ** j, x0 - 2 * j * a / k
    x = np.where(j < n, sign * (a / k + (top - a / k) * np.cos(w * t - j * np.pi)), sign * top)
    return x, n[:, 0], (n * np.pi / w)[:, 0]


def draws(count, seed=0):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(0.5, 1.5, count), rng.uniform(0.8, 1.2, count), rng.uniform(3, 6, count)])


@pytest.fixture(scope="module", params=[by_input, by_ends, by_class], ids=lambda make: make.__name__)
def friction(request):
    model = request.param()
    times = np.linspace(0, 12, 49)
    return model, times, PieceBatch(model, None, RTOL, None, times)


def test_friction_oscillators_swing_and_rest_as_they_must(friction):
    """Places of 300 oscillators, their rest to rounding, the number of their half swings."""
    _, times, batch = friction
    values = draws(300)
    cells = batch.run(values, ["x", "y", "index_set", "multipliers"])
    x, n, rest = swings(*values.T, times)
    assert (cells.status == OK).all()
    assert np.isnan(cells.failed_at).all()
    assert np.abs(cells.arrays["x"][:, :, 0] - x).max() < 1e-10
    speed, resting = cells.arrays["y"][:, :, 0], times > rest[:, None] + 1e-9
    assert np.abs(speed[resting]).max() < 1e-13
    assert (cells.arrays["index_set"][:, :, 0][resting] == 0).all()
    assert np.abs(speed[~resting & (times > 0)]).min() > 1e-13
    np.testing.assert_array_equal(cells.index_set_changes, np.where(rest <= 12, n, np.floor(12 / rest * n)))
    assert (cells.steps == 48).all()
    assert (cells.pieces > cells.index_set_changes).all()
    assert (cells.estimate < 1).all()


def test_cells_are_single_runs_bit_for_bit(friction):
    """All columns and totals, though single runs make their rows elsewhere."""
    model, times, batch = friction
    values, names = draws(6, 1), list(batch.columns())
    cells = batch.run(values, names)
    for i, cell in enumerate(values):
        run = simulate(model, parameters=dict(zip(batch.names, cell, strict=True)), rtol=RTOL, times=times, compiled=True)
        same(run, cells, i, names)


def same(run, cells, i, names):
    for name in names:
        if name in run.arrays:
            np.testing.assert_array_equal(cells.arrays[name][i], run.arrays[name], err_msg=name)
    totals = run.metadata["totals"]
    found = cells.steps[i], cells.pieces[i], cells.index_set_changes[i], cells.worst_residual[i], cells.estimate[i]
    assert found == tuple(totals[name] for name in ("steps", "pieces", "events", "worst_residual", "worst_estimate"))


def test_order_batch_and_thread_do_not_matter(friction):
    """Each cell has solver memory of its own kind: nothing of the cells before is seen."""
    _, _, batch = friction
    values, names = draws(200, 2), list(batch.columns())
    whole, order = batch.run(values, names), np.random.default_rng(3).permutation(200)
    with ThreadPoolExecutor(4) as pool:
        parts = list(pool.map(lambda part: batch.run(values[part], names), np.array_split(order, 7)))
    for name in names:
        np.testing.assert_array_equal(np.concatenate([part.arrays[name] for part in parts]), whole.arrays[name][order])
    np.testing.assert_array_equal(np.concatenate([part.pieces for part in parts]), whole.pieces[order])


def test_a_loop_over_values_builds_once(monkeypatch):
    """Runs with other values load the library that is there."""
    built = []
    monkeypatch.setattr(
        event_driven_runs,
        "cached_library",
        lambda *args, kept=event_driven_runs.cached_library: built.append(args[0]) or kept(*args),
    )
    model = by_ends()
    for a, k, x0 in draws(3, 4):
        simulate(model, parameters={"a": a, "k": k, "x0": x0}, rtol=RTOL, compiled=True)
    PieceBatch(model, None, RTOL, None, [1.0])
    assert len(built) == 1


def test_calls_end_in_time_and_go_on(friction, monkeypatch):
    """A batch of many short calls has the bits of one; where it is stopped, the rest has not been reached."""
    _, _, batch = friction
    values = draws(300, 5)
    whole = batch.run(values, ["x"])
    monkeypatch.setattr(event_driven_batch, "CALL_SECONDS", 0.0)
    asked = []
    np.testing.assert_array_equal(batch.run(values, ["x"], lambda: bool(asked.append(0))).arrays["x"], whole.arrays["x"])
    assert len(asked) > 10
    stopped = batch.run(values, ["x"], lambda: True)
    reached = stopped.status == OK
    assert not reached[-1]
    assert (stopped.status[~reached] == -1).all()
    np.testing.assert_array_equal(stopped.arrays["x"][reached], whole.arrays["x"][reached])
    assert np.isnan(stopped.arrays["x"][~reached]).all()
    assert not stopped.pieces[~reached].any()


def test_crossings_are_exact():
    """x' in 2 - Sgn(x): x(2) = 2 + x0/3, whatever x0."""
    (x0,) = symbols("x0")
    model = LureSystem(A=[[0]], B=[1], C=[1], f=[2], law=relay(1), x0=[x0], parameters={x0: -1}, t_end=2)
    values = np.random.default_rng(0).uniform(-1.5, -0.5, (500, 1))
    cells = PieceBatch(model, None, RTOL, None, [2.0]).run(values, ["x"])
    assert np.abs(cells.arrays["x"][:, 0, 0] - (2 + values[:, 0] / 3)).max() < 1e-15
    assert (cells.index_set_changes == 1).all()


def test_play_and_starts_outside():
    """q = max(q0, A sin t) up to its top; a start that the wall refuses is no value of the model."""
    t, q, A, q0 = symbols("t q A q0")
    wall = {"wall": q - A * ca.sin(t)}
    model = SweepingProcess(t=t, q=q, f=[0], constraints=wall, q0=[q0], parameters={A: 1, q0: 0.4}, t_end=3)
    rng = np.random.default_rng(0)
    values = np.column_stack([rng.uniform(0.5, 1.5, 300), rng.uniform(-0.1, 1, 300)])
    times = np.linspace(0, 3, 31)
    batch = PieceBatch(model, None, RTOL, None, times)
    names = list(batch.columns())
    cells, inside = batch.run(values, names), values[:, 1] >= 0
    A, q0 = values.T[:, :, None]
    exact = np.maximum(q0, A * np.sin(np.minimum(times, np.pi / 2)))
    np.testing.assert_array_equal(cells.status, np.where(inside, OK, BAD_PARAMETER))
    assert np.abs(cells.arrays["x"][inside, :, 0] - exact[inside]).max() < 1e-11
    pushed = np.nancumsum(cells.arrays["multipliers"][inside, :, 0], axis=1)
    assert np.abs(pushed - (exact - q0)[inside]).max() < 1e-11
    assert np.isnan(cells.arrays["x"][~inside]).all()
    for i in np.flatnonzero(inside)[:3]:
        given = dict(zip(batch.names, values[i], strict=True))
        same(simulate(model, parameters=given, rtol=RTOL, times=times, compiled=True), cells, i, names)
    with pytest.raises(UsageError, match="outside the set"):
        simulate(model, parameters={"A": 1, "q0": -0.05}, rtol=RTOL, compiled=True)


def cycle(a, low, high, rest, power, x, t):
    """A thermostat with these switches, on at first where x is below; its temperature at t, and how often it has switched."""
    now, on, switched = 0.0, x < high, 0
    while True:
        goal, end = (rest + power / a, high) if on else (rest, low)
        until = now + np.log((goal - x) / (goal - end)) / a
        if until > t:
            return goal + (x - goal) * np.exp(-a * (t - now)), switched
        now, x, on, switched = until, end, not on, switched + 1


def test_thermostats_have_their_period():
    """D < 0: between its switches both ends satisfy the law, and the mode that is there goes on."""
    a, w = symbols("a w")
    f = -a * (20 - 5) + 6
    model = LureSystem(A=-a, B=[6], C=[1], D=-w, f=f, law=relay(1), x0=[-3], parameters={a: 0.5, w: 0.5}, t_end=8)
    rng = np.random.default_rng(0)
    values = np.column_stack([rng.uniform(0.4, 0.6, 100), rng.uniform(0.3, 0.7, 100)])
    cells = PieceBatch(model, None, RTOL, None, [8.0]).run(values, ["x"])
    assert (cells.status == OK).all()
    for i, (a, w) in enumerate(values):
        x, switched = cycle(a, -w, w, -15.0, 12.0, -3.0, 8.0)
        assert cells.index_set_changes[i] == switched
        assert abs(cells.arrays["x"][i, 0, 0] - x) < 1e-8


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("kind", CLASSES)
def test_random_models_are_their_single_runs(kind, seed):
    """Matrices, ends, masses and switches that parameters move; what C does not finish is said, with when."""
    model = with_parameters(CLASSES[kind](seed).model)
    times = np.linspace(0, model.t_end, 21)
    batch = PieceBatch(model, None, RTOL, None, times)
    rng, names = np.random.default_rng(seed), list(batch.columns())
    values = np.vstack([np.ones(len(batch.names)), rng.uniform(0.9, 1.1, (2, len(batch.names)))])
    cells = batch.run(values, names)
    for i, cell in enumerate(values):
        given = dict(zip(batch.names, cell, strict=True))
        run = simulate(model, parameters=given, rtol=RTOL, times=times, compiled=True, method="event-driven")
        if cells.status[i] == OK:
            same(run, cells, i, names)
        else:
            rows = times < cells.failed_at[i]
            np.testing.assert_array_equal(cells.arrays["x"][i, rows], run.x[rows])
            assert np.isnan(cells.arrays["x"][i, ~rows]).all()
    other = simulate(CLASSES[kind](seed).model, rtol=RTOL, times=times, compiled=False, method="event-driven")
    if cells.status[0] == OK:
        assert np.abs(cells.arrays["x"][0] - other.x).max() <= 1e-11 * np.abs(other.x).max()


def test_switches_that_values_turn_or_take_away():
    """|b x| is |x| where b = -1, and no switch where b = 0: single runs are right there, and cells are the same motions."""
    b, x = symbols("b x")
    x = ca.SX.sym("x", 2)
    model = FirstOrderSystem(x=x, f=[x[1], -ca.fabs(b * x[0]) - x[0]], x0=[1, 0.5], parameters={b: 0}, t_end=5)
    batch = PieceBatch(model, None, RTOL, None, [5.0])
    values = np.array([[-1.0], [0.0], [0.5], [2.0]])
    cells = batch.run(values, ["x"])
    assert (cells.status == OK).all()
    for i, (value,) in enumerate(values):
        for compiled in (True, False):
            run = simulate(model, parameters={"b": value}, rtol=RTOL, times=[5.0], compiled=compiled)
            assert np.abs(run.x[-1] - cells.arrays["x"][i, 0]).max() < 1e-12


def test_values_that_the_law_refuses_and_those_without_code():
    """A negative friction is no law; where l does nothing there is no inverse: such a cell is left to a run of its own."""
    cells = PieceBatch(by_ends(), None, RTOL, None, [0.0, 12.0]).run(np.array([[-1.0, 1, 4], [1, 1, 4], [1, 1, np.nan]]), ["x"])
    np.testing.assert_array_equal(cells.status, [BAD_PARAMETER, OK, BAD_PARAMETER])
    assert np.isnan(cells.arrays["x"][0]).all()
    model = by_input()
    cells = PieceBatch(model, None, RTOL, None, [12.0]).run(np.array([[0.0, 1, 4], [1, 1, 4]]), ["x"])
    np.testing.assert_array_equal(cells.status, [NO_MODE, OK])
    run = simulate(model, parameters={"a": 0, "k": 1, "x0": 4}, rtol=RTOL, times=[12.0], compiled=True)
    assert np.abs(run.x[-1] - 4 * np.array([np.cos(12), -np.sin(12)])).max() < 1e-9


def test_cells_that_stop_keep_what_was_there():
    """z' = k z^2 is 1/(1 - k t), which for k = 1 is nowhere at t = 1; a body that meets a wall has no mode there."""
    k, z = symbols("k z")
    model, times = FirstOrderSystem(x=z, f=k * z**2, x0=[1], parameters={k: 1}, t_end=3), np.linspace(0, 3, 31)
    values = np.array([[1.0], [-1.0], [0.2]])
    cells = PieceBatch(model, None, RTOL, None, times).run(values, ["x"])
    x, there = cells.arrays["x"][:, :, 0], ~np.isnan(cells.arrays["x"][:, :, 0])
    assert cells.status[0] not in (OK, BAD_PARAMETER, -1)
    np.testing.assert_array_equal(cells.status[1:], OK)
    assert abs(cells.failed_at[0] - 1) < 1e-3
    np.testing.assert_array_equal(there, [times <= cells.failed_at[0], *np.ones((2, 31), bool)])
    assert np.abs((x * (1 - values * times) - 1)[there & (values * times < 0.95)]).max() < 1e-8
    np.testing.assert_array_equal(cells.steps, there.sum(axis=1) - 1)
    (h0,) = symbols("h0")
    law = nsmodel.complementarity(1)
    model = LureSystem(A=[[0, 1], [0, 0]], B=[0, 1], C=[1, 0], f=[0, -1], law=law, x0=[h0, 0], parameters={h0: 1}, t_end=2)
    cells = PieceBatch(model, None, RTOL, None, [0.5, 2.0]).run(np.array([[0.5], [-1.0]]), ["x", "index_set"])
    np.testing.assert_array_equal(cells.status, NO_MODE)
    assert np.isnan(cells.arrays["x"]).all()
    assert (cells.arrays["index_set"] == -2).all()
    assert (cells.failed_at <= 1).all()
    assert abs(simulate(model, parameters={"h0": 0.5}, rtol=RTOL, compiled=True).x[-1]).max() < 1e-6


def test_masses_ends_without_end_and_outputs():
    """M of parameters, singular for some; an end at infinity for some; columns of the model's own, inputs as states."""
    t, x, l, m, e = symbols("t x l m e")
    u = ca.SX.sym("u")
    model = FirstOrderSystem(
        t=t, x=x, lam=l, M=m, f=u, g=l, h=x, law=box(0, 1 / e), x0=[0.5], parameters={m: 1, e: 1},
        inputs={u: nsmodel.pwm(2, 0.5)}, outputs={"power": m * x * u}, t_end=3,
    )  # fmt: skip
    times = np.linspace(0, 3, 13)
    batch = PieceBatch(model, None, RTOL, None, times)
    names = list(batch.columns())
    values = np.array([[1.0, 0.5], [2.0, 0.0], [0.0, 1.0]])
    cells = batch.run(values, names)
    np.testing.assert_array_equal(cells.status, [OK, OK, NO_MODE])
    for i in (0, 1):
        given = dict(zip(batch.names, values[i], strict=True))
        run = simulate(model, parameters=given, rtol=RTOL, times=times, compiled=True)
        assert {"power", "inputs"} < set(names)
        same(run, cells, i, names)
    assert np.abs(cells.arrays["x"][0, :5, 0] - (0.5 + times[:5])).max() < 1e-12


def test_what_is_asked_wrongly_is_refused():
    """By name, with what is there."""
    batch = PieceBatch(by_ends(), None, RTOL, None, [1.0])
    with pytest.raises(UsageError, match=r"values: shape \(3,\); expected \(cells, 3\)"):
        batch.run(np.ones(3), ["x"])
    with pytest.raises(UsageError, match=r"keep: 'z' is not a column; there are .*x"):
        batch.run(np.ones((1, 3)), ["z"])
    with pytest.raises(UsageError, match="outside the run"):
        PieceBatch(by_ends(), None, RTOL, None, [13.0])
    with pytest.raises(UsageError, match="rtol = 2"):
        PieceBatch(by_ends(), None, 2, None, [1.0])
    with pytest.raises(CodegenError, match="no parameters"):
        PieceBatch(by_ends().bind({"a": 1}), None, RTOL, None, [1.0])
    x, r = ca.SX.sym("x", 2), ca.SX.sym("r")
    curved = FirstOrderSystem(x=x, lam=ca.SX.sym("l", 2), f=-x, g=ca.SX.sym("l", 2), h=x, law=ball(2, r), x0=[1, 0],
                              parameters={r: 1}, t_end=1)  # fmt: skip
    with pytest.raises(CodegenError, match="curved"):
        PieceBatch(curved, None, RTOL, None, [1.0])


@pytest.mark.long
def test_the_library_for_users_sets_ends_and_starts(tmp_path):
    """set_parameters and reset: friction in the ends, a start that is a parameter; ends that cross are refused."""
    codegen.write(by_ends(), tmp_path, name="fr", step=0.01, event_driven=True)
    compile_library(tmp_path / "fr_pieces.c", tmp_path / "fr.so", (*COMPILER_FLAGS, "-Wall", "-Werror", "-Wno-unused-function"))
    c = ctypes.CDLL(str(tmp_path / "fr.so"))
    solver, x = ctypes.create_string_buffer(1 << 20), np.zeros(2)
    assert c.fr_pieces_init(solver, ctypes.c_double(RTOL)) == OK
    values = draws(20, 6)
    for cell in values:
        assert c.fr_pieces_set_parameters(solver, np.ascontiguousarray(cell).ctypes.data_as(ctypes.c_void_p)) == OK
        assert c.fr_pieces_reset(solver) == OK
        assert c.fr_advance(solver, ctypes.c_double(12.0)) == OK
        c.fr_pieces_get_state(solver, x.ctypes.data_as(ctypes.c_void_p))
        assert abs(x[0] - swings(*cell[:, None], np.array([12.0]))[0][0, 0]) < 1e-9
    assert c.fr_pieces_reset(solver) == OK
    wrong = np.array([-1.0, 1, 4])
    assert c.fr_pieces_set_parameters(solver, wrong.ctypes.data_as(ctypes.c_void_p)) == BAD_PARAMETER
    assert c.fr_advance(solver, ctypes.c_double(13.0)) == OK  # what is refused changes nothing
    assert c.fr_pieces_reset(solver) == OK
    assert c.fr_pieces_set_parameters(solver, np.array([1.0, 1, 5.3]).ctypes.data_as(ctypes.c_void_p)) == OK
    assert c.fr_pieces_reset(solver) == OK
    assert c.fr_advance(solver, ctypes.c_double(12.0)) == OK
    c.fr_pieces_get_state(solver, x.ctypes.data_as(ctypes.c_void_p))
    assert np.abs(x - [0.7, 0]).max() < 1e-9
    assert Path(tmp_path / "fr_pieces.h").read_text().count("fr_pieces_reset") == 1
