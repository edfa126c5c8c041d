"""Laws whose ends are expressions of time and inputs: closed forms, recursions, the same law written as u l, wrong answers."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import brentq

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    ModelError,
    MonotoneInclusion,
    StepError,
    Trajectory,
    UsageError,
    ball,
    box,
    check,
    codegen,
    complementarity,
    explain,
    product,
    pwm,
    relay,
    simulate,
    stepper,
    stress,
    study,
    table,
    within,
)
from nsmodel.errors import CodegenError, EmptyLawError
from nsmodel.hypotheses.certificates.write import certificate_of
from nsmodel.models.lure_system.documents import equations
from nsmodel.simulation import event_driven, fixed_grid, step_backend
from nsmodel.solvers.one_step_problem import one_step_problem
from nsmodel.solvers.time_stepper import Stepper
from nsmodel.study.reference_steps import formula_residuals as misfits
from nsmodel.study.units import in_units

pytestmark = pytest.mark.usefixtures("own_cache")
t, u, s, x, l = (ca.SX.sym(name) for name in "tusxl")
RAMPS = table([0, 1, 2, 3], [2, 0, 0.5, 1.5], "linear")
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


def mass(law, force, **fields):
    """v' = force + l, -v ∈ N_K(l)."""
    given = {
        "t": t,
        "A": [[0]],
        "B": [1],
        "C": [1],
        "f": [force],
        "law": law,
        "x0": [0],
        "t_end": 4,
        "step": 1e-2,
        "names": ["v"],
    }
    return LureSystem(**given | fields)


def driven(signal, **fields):
    """The mass under friction of the level u, pulled to and fro."""
    return mass(relay(1, -u, u), 3 * ca.sin(t), **{"inputs": {u: signal}} | fields)


# ------------------------------------------------------------------------------------------------------- closed forms


@WAYS
def test_a_mass_whose_normal_force_grows_sticks_until_it_is_pulled_harder_and_again(compiled):
    run = simulate(mass(relay(1, -(1 + t / 2), 1 + t / 2), 2 * t), rtol=1e-10, compiled=compiled)
    assert run.is_event_driven
    assert [event.t for event in run.events] == pytest.approx([2 / 3], rel=1e-12)
    at = np.linspace(0, 4, 41)
    exact = np.where(at > 2 / 3, 0.75 * (at**2 - 4 / 9) - (at - 2 / 3), 0)
    np.testing.assert_allclose(run.at(at).x[:, 0], exact, rtol=1e-12, atol=1e-14)
    stick = at < 0.66
    np.testing.assert_allclose(run.at(at).multipliers[stick, 0], -2 * at[stick], atol=1e-14)
    slows = simulate(mass(relay(1, -(1 + t), 1 + t), 3, t_end=6), rtol=1e-10, compiled=compiled)  # v = 2 t - t^2/2 until t = 4
    assert [event.t for event in slows.events] == pytest.approx([4], rel=1e-9)
    assert abs(slows.at(2.0).x[0] - 2) < 1e-13
    assert abs(slows.x[-1, 0]) < 1e-13


@WAYS
def test_a_limited_rate_follows_its_reference_as_fast_as_the_limit_that_moves_lets_it(compiled):
    follows = mass(box(-1, 1 + ca.sin(t)), 0, e=[-3])
    run = simulate(follows, rtol=1e-11, compiled=compiled)
    there = brentq(lambda time: time + 1 - np.cos(time) - 3, 1, 3, xtol=1e-15)
    assert [event.t for event in run.events] == pytest.approx([there], rel=1e-12)
    before = there * np.linspace(0, 1, 20)[:-1]
    np.testing.assert_allclose(run.at(before).x[:, 0], before + 1 - np.cos(before), rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(run.at(before).multipliers[:, 0], 1 + np.sin(before), rtol=1e-12)
    steps = simulate(follows, step=1e-3, compiled=compiled)
    assert abs(steps.x[-1, 0] - 3) < 1e-12
    np.testing.assert_allclose(steps.multipliers[1:1000, 0], 1 + np.sin(steps.t[1:1000]), rtol=1e-12)


def soft(z, room):
    return np.sign(z) * max(abs(z) - room, 0)


@WAYS
@pytest.mark.parametrize("signal", [pwm(0.5, 0.4), pwm(0.5, 0.3, low=0.2, high=4), RAMPS, table([0, 1, 2, 3], [2, 0, 0.5, 1.5])])
def test_implicit_euler_is_its_recursion_with_the_level_before_the_end_of_each_step(signal, compiled):
    run = simulate(driven(signal), compiled=compiled)
    before, v = signal.limits(run.t, len(run.t) - 1)[1][:, 0], 0.0
    np.testing.assert_array_equal(run.inputs[1:, 0], before)
    for k, h in enumerate(run.step[1:]):
        z = v + h * 3 * np.sin(run.t[k + 1])
        v = soft(z, h * before[k])
        assert abs(run.v[k + 1] - v) < 1e-13
        assert abs(run.multipliers[k + 1, 0] - (v - z) / h) < 1e-10
        assert v != 0 or run.v[k + 1] == 0  # what sticks is exactly 0
        assert run.index_set[k + 1, 0] == (0 if v == 0 else -np.sign(v))


def braked(period, duty, low, high, t_end):
    """v' = 3 sin t - level sgn v from rest, exactly: (times, v) of the edges and of what happens between them."""
    now, v, found = 0.0, 0.0, [(0.0, 0.0)]
    edges = sorted({k * period for k in range(1, 99)} | {(k + duty) * period for k in range(99)})
    for edge in [e for e in edges if e < t_end] + [t_end]:
        level = high if (now + edge) / 2 % period < duty * period else low
        while now < edge - 1e-12:
            pull = 3 * np.sin(now + 1e-9)
            side = np.sign(v) if v else np.sign(pull) * (abs(pull) > level)

            def speed(time, now=now, v=v, side=side, level=level):
                return v - 3 * (np.cos(time) - np.cos(now)) - side * level * (time - now)

            watched = speed if side else lambda time, level=level: level - abs(3 * np.sin(time))
            grid = np.linspace(now + 1e-7, edge, 400)
            values = np.array([watched(time) for time in grid])
            past = np.flatnonzero(values[1:] * values[:-1] < 0)
            then = brentq(watched, grid[past[0]], grid[past[0] + 1], xtol=1e-15) if past.size else edge
            v, now = (0.0 if past.size or not side else speed(then)), then
            found.append((now, v))
    return np.array(found).T


@WAYS
def test_a_pulsed_brake_from_switch_to_switch(compiled):
    run = simulate(driven(pwm(0.5, 0.4, low=0.5, high=2.5)), rtol=1e-10, compiled=compiled)
    times, v = braked(0.5, 0.4, 0.5, 2.5, 4.0)
    assert run.is_event_driven
    assert len(times) > 17
    np.testing.assert_allclose(run.at(times).x[:, 0], v, atol=2e-11)
    for time in times[1:-1]:
        assert np.abs([event.t - time for event in run.events]).min() < 1e-10


@WAYS
def test_a_reaction_is_found_anew_with_the_law_after_the_edge(compiled):
    """gamma = 1/2 and D = 1: l at the begin of a step is the law's at u(a+), x + l = 0 or l at its end."""
    run = simulate(driven(table([0, 1], [0.5, 2]), gamma=0.5, D=[[1]]), compiled=compiled)
    for k, h in enumerate(run.step[1:]):
        a, b = run.inputs_begin[k + 1, 0], run.inputs[k + 1, 0]
        begin = np.clip(-run.v[k], -a, a)
        z = run.v[k] + h * 3 * np.sin(run.t[k + 1]) + h / 2 * begin
        end = np.clip(-z / (1 + h / 2), -b, b)
        assert abs(run.v[k + 1] - z - h / 2 * end) < 1e-12
        assert abs(run.multipliers[k + 1, 0] - end) < 1e-12
    assert run.inputs_begin[101, 0] == 2 != run.inputs[100, 0]


def test_a_ball_whose_radius_moves_slips_along_its_pull():
    """Pulled along (3, 4)/5 the plane is a line."""
    pull = 3 * ca.sin(t)
    plane = LureSystem(
        t=t, A=np.zeros((2, 2)), B=np.eye(2), C=np.eye(2), f=[0.6 * pull, 0.8 * pull], law=ball(2, u), x0=[0, 0], t_end=4,
        step=1e-2, inputs={u: RAMPS},
    )  # fmt: skip
    for how in ({"compiled": False}, {"compiled": True}, {"rtol": 1e-9, "compiled": False}):
        run, line = simulate(plane, **how), simulate(driven(RAMPS), **how)
        end = run.x[-1] @ [0.6, 0.8], run.x[-1] @ [-0.8, 0.6]
        assert end == pytest.approx((line.x[-1, 0], 0), abs=1e-8)
    assert misfits(plane.bind(), simulate(plane))["law"] < 1


# ---------------------------------------------------------------------------------------- the same law, written otherwise


def pair(seed):
    """A random Lur'e system with three laws that move, and the same with laws that stay."""
    rng = np.random.default_rng(seed)
    n, m = 4, 3
    A, B, D = rng.normal(size=(n, n)), rng.normal(size=(n, m)), np.diag(rng.uniform(0, 1, m)) * (seed % 2)
    X, L, U = ca.SX.sym("x", n), ca.SX.sym("l", m), [ca.SX.sym(f"u{i}") for i in range(m)]
    signals = [pwm(0.4, 0.6, low=0.1 * seed), table([0, 0.7, 1.3], rng.uniform(0, 2, 3), "linear"), 1 + 0.9 * ca.sin(3 * t)]
    a, b = -U[1] - 0.1, 2 * U[1] + 0.2
    moving = product(relay(1, -U[0], U[0]), box(a, b), box(U[2], np.inf) if seed % 2 else box(0, U[2]))
    scaled = ca.vertcat(U[0] * L[0], (a + b) / 2 + (b - a) / 2 * L[1], U[2] + L[2] if seed % 2 else U[2] * L[2])
    still = product(relay(2), complementarity(1) if seed % 2 else box(0, 1))
    pull = ca.DM(rng.normal(size=(n, 1))) * 4 * ca.sin(2 * t)
    f = ca.mtimes(A, X) + pull
    common = {"t": t, "x0": rng.normal(size=n), "t_end": 2, "step": 0.013, "inputs": dict(zip(U, signals, strict=True))}
    lure = LureSystem(A=A, B=B, C=B.T, D=D, f=pull, law=moving, **common)
    own = FirstOrderSystem(x=X, lam=L, f=f, g=ca.mtimes(B, L), h=ca.mtimes(B.T, X) + ca.mtimes(D, L), law=moving, **common)
    other = FirstOrderSystem(
        x=X, lam=L, f=f, g=ca.mtimes(B, scaled), h=ca.mtimes(B.T, X) + ca.mtimes(D, scaled), law=still, **common
    )
    return lure, own, other


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
@pytest.mark.long
def test_the_same_law_written_as_u_l_has_the_same_runs(seed):
    models = pair(seed)
    runs = [simulate(model, compiled=False) for model in models]
    for run in (*runs[1:], simulate(models[0], compiled=True)):
        np.testing.assert_allclose(run.x, runs[0].x, rtol=1e-9, atol=1e-11)
        np.testing.assert_array_equal(run.index_set, runs[0].index_set)
        np.testing.assert_allclose(run.y, runs[0].y, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(runs[1].multipliers, runs[0].multipliers, rtol=1e-8, atol=1e-8)
    assert not runs[0].metadata["warnings"]  # W has the sign of the declared law's
    assert max(misfits(models[0].bind(), runs[0]).values()) < 1
    events = [simulate(model, rtol=1e-9) for model in models]
    assert all(run.is_event_driven for run in events)
    assert {len(run.events) for run in events} == {len(events[0].events)}
    for run in (*events[1:], simulate(models[0], rtol=1e-9, compiled=True)):
        np.testing.assert_allclose(run.x[-1], events[0].x[-1], rtol=1e-7, atol=1e-9)


def test_levels_of_other_sizes_do_not_make_a_monotone_problem_another():
    """Two rows that feel each other, whose levels differ by 1000: W has the sign of the declared law's, without a warning."""
    B = np.array([[1.0, 0.9], [0.0, 0.44]])
    law = product(relay(1, -u, u), relay(1, -1000 * u, 1000 * u))
    pair = LureSystem(
        A=-np.eye(2),
        B=B,
        C=B.T,
        f=[9 * ca.sin(t), 99 * ca.cos(t)],
        law=law,
        x0=[1, 1],
        t=t,
        t_end=1,
        step=0.01,
        inputs={u: RAMPS},
    )
    run = simulate(pair)
    assert run.metadata["warnings"] == []
    np.testing.assert_allclose(simulate(pair, solver="lemke").x, run.x, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("signal", [None, pwm(1, 0.5), RAMPS])
def test_an_oscillator_whose_friction_moves_is_that_lure_system(signal):
    level, inputs = (0.5 + 0.4 * ca.sin(3 * t), {}) if signal is None else (u, {u: signal})
    common = {"t": t, "t_end": 4, "step": 1e-2, "inputs": inputs}
    swing = FrictionOscillator(x=x, potential=x**2 / 2, friction=level * s, s=s, force=[2 * ca.sin(t)], x0=[0], **common)
    law = relay(1, -level, level)
    same = LureSystem(A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], f=[0, 2 * ca.sin(t)], law=law, x0=[0, 0], **common)
    for how in ({"compiled": False}, {"compiled": True}, {"rtol": 1e-9}):
        one, other = simulate(swing, **how), simulate(same, **how)
        np.testing.assert_allclose(one.x[:, 0], other.x[:, 0], rtol=1e-9, atol=1e-11)
        np.testing.assert_array_equal(one.index_set, other.index_set)
    assert one.is_event_driven
    assert all(misfit < 1 for misfit in misfits(swing.bind(), simulate(swing)).values())
    assert other_units(swing) < 1e-9
    beyond_lines = FrictionOscillator(x=x, friction=(1 + t) * (s + ca.exp(-s)), s=s, x0=[1], t=t, t_end=1, step=0.01)
    with pytest.raises(UsageError, match="friction 'friction' moves with time, and theta' is not linear in s"):
        simulate(beyond_lines, rtol=1e-6, method="event-driven")


# ---------------------------------------------------------------------------------------------------- what counts as small


@pytest.mark.parametrize("size", [1e-9, 1e-6, 1e6, 1e9])
def test_wrong_answers_are_refused_in_the_units_of_the_declared_law(size):
    """With a level of any size an error of 1e-7 of the motion or of the level is refused, and the answer is the recursion's."""
    model = mass(relay(1, -size * u, size * u), 3 * size * ca.sin(t), inputs={u: RAMPS})
    run, level, v = simulate(model), RAMPS.limits(np.linspace(0, 4, 401), 400)[1][:, 0], 0.0
    for k in range(400):
        v = soft(v + 0.01 * 3 * size * np.sin(run.t[k + 1]), 0.01 * size * level[k])
        assert abs(run.v[k + 1] - v) < 1e-12 * size
    state = np.array([run.v[149], *run.inputs_begin[150], *run.inputs[150]])
    own = Stepper(one_step_problem(model), "auto", 1e-9, h=0.01, state=state)
    newton, found = own._newton, own(run.t[149], 0.01, state, own.cold_start())
    known, free = newton.known(run.t[149], 0.01, state), found.row[own.layout.l]
    right = newton.polish_on_index_set(run.t[149], 0.01, state, free, found.warm.index)
    assert right.residual <= 1e-12
    for error in (1e-7, -1e-7):
        z = right.z * (1 + error)
        assert (
            newton.evaluate_residual(
                known, newton.linearise(run.t[149], 0.01, state, z, free), free, right.index, "wrong", 1
            ).residual
            > 1e-9
        )
        off = free * (1 + error)
        assert (
            newton.evaluate_residual(
                known, newton.linearise(run.t[149], 0.01, state, right.z, off), off, right.index, "", 1
            ).residual
            > 1e-9
        )


def test_a_far_end_does_not_excuse_what_happens_at_the_other():
    """An l at 0, in [0, 1e9 (1 + t)]: y is certified beside what moves it, not beside the far end."""
    model = mass(box(0, 1e9 * (1 + t)), 1.0)
    own = Stepper(one_step_problem(model), "auto", 1e-9, h=0.01, state=np.zeros(1))
    newton = own._newton
    known, z, lower = newton.known(0.0, 0.01, np.zeros(1)), np.array([0.01]), np.zeros(1)
    index = np.array([-1], np.int8)
    assert (
        newton.evaluate_residual(known, newton.linearise(0.0, 0.01, np.zeros(1), z, lower), lower, index, "right", 1).residual
        < 1e-12
    )
    wrong = np.array([-1e-8])  # y < 0 with l at its lower end
    back = mass(box(0, 1e9 * (1 + t)), -1e-6)
    other = Stepper(one_step_problem(back), "auto", 1e-9, h=0.01, state=np.zeros(1))._newton
    known = other.known(0.0, 0.01, np.zeros(1))
    assert (
        other.evaluate_residual(known, other.linearise(0.0, 0.01, np.zeros(1), wrong, lower), lower, index, "wrong", 1).residual
        > 1e-3
    )


@WAYS
def test_where_both_ends_are_equal_l_is_there_whatever_y_is(compiled):
    """A limiter that closes for a while: l = 0.3 exactly, the index set tells the sign of y."""
    signal = pwm(1, 0.5)
    run = simulate(mass(box(0.3 - u, 0.3 + u), ca.cos(3 * t) - 0.3, inputs={u: signal}), compiled=compiled)
    closed = np.flatnonzero(run.inputs[1:, 0] == 0) + 1
    assert len(closed) > 150
    np.testing.assert_array_equal(run.multipliers[closed, 0], 0.3)
    assert (run.index_set[closed, 0] * run.y[closed, 0] <= 0).all()
    assert np.unique(np.sign(run.v[closed])).tolist() == [-1, 1]
    free = run.v[closed] - run.v[closed - 1] - 1e-2 * np.cos(3 * run.t[closed])
    np.testing.assert_allclose(free, 0, atol=1e-13)
    exact = simulate(mass(box(0.3 - u, 0.3 + u), ca.cos(3 * t) - 0.3, inputs={u: signal}), rtol=1e-10, compiled=compiled)
    assert exact.is_event_driven
    shut = exact.at([0.6, 0.9])
    np.testing.assert_allclose(shut.multipliers[:, 0], 0.3, atol=1e-15)
    assert shut.x[1, 0] - shut.x[0, 0] == pytest.approx((np.sin(2.7) - np.sin(1.8)) / 3, abs=1e-12)


# ------------------------------------------------------------------------------------------------------------ empty laws


@pytest.mark.parametrize(
    "how", [{}, {"compiled": True}, {"rtol": 1e-8}, {"rtol": 1e-8, "compiled": True}, {"rtol": 1e-4, "method": "time-stepping"}]
)
@pytest.mark.parametrize(
    ("law", "signal", "first", "words"),
    [
        (relay(1, -u, u), table([0, 1], [2, -1]), 1.0, "its lower end, 1, is above its upper end, -1"),
        (relay(1, -u, u), table([0, 1, 2], [2, -1, 1], "linear"), 2 / 3, "is above its upper end"),
        (box(0.5, 1 - t), 1.0, 0.5, "its lower end, 0.5, is above its upper end"),
        (relay(1, -u, u), pwm(0.5, 0.4, low=-1), 0.2, "its lower end, 1, is above its upper end, -1"),
        (relay(1, -u, u), -1.0, 0.0, "its lower end, 1, is above its upper end, -1"),
    ],
)  # fmt: skip
def test_a_lower_end_above_the_upper_one_ends_the_run_with_row_time_and_values(law, signal, first, words, how):
    with pytest.raises(StepError, match=rf"the law of 'l_0' at t = .*{words}.*keep lower <= upper") as stopped:
        simulate(mass(law, 3 * ca.sin(t), inputs={u: signal}), **how)
    assert isinstance(stopped.value, EmptyLawError)
    assert stopped.value.component == "l_0"
    if stopped.value.trajectory is not None:
        assert first - 0.011 < stopped.value.trajectory.t[-1] < first + 1e-9


def test_an_oscillator_and_a_ball_name_their_radius():
    swing = FrictionOscillator(x=x, friction=(1 - t / 5) * s, s=s, x0=[1], t=t, t_end=8, step=0.1, potential=x**2)
    with pytest.raises(EmptyLawError, match=r"the law of 'friction' at t = 5\.1"):
        simulate(swing)
    with pytest.raises(UsageError, match=r"theta'\(0\) = -1"):
        simulate(FrictionOscillator(x=x, friction=(t - 1) * s, s=s, x0=[1], t=t, t_end=8, step=0.1))
    plane = {"A": np.zeros((2, 2)), "B": np.eye(2), "C": np.eye(2), "x0": [1, 0], "t": t, "t_end": 2, "step": 0.1}
    with pytest.raises(EmptyLawError, match=r"the law of 'l_0' at t = 1\.1: its lower end, 0, is above its upper end, -0\.1"):
        simulate(LureSystem(law=ball(2, 1 - t), **plane))


def test_a_stepper_and_a_library_stay_as_they_were(tmp_path):
    own = stepper(driven(None))
    before = own.step(1.0).x.copy()
    with pytest.raises(EmptyLawError):
        own.step(-1.0)
    assert own.x == before
    assert abs(own.step(0.5).multipliers[0]) <= 0.5
    codegen.write(driven(RAMPS), tmp_path, name="thing")
    run, solver = simulate(driven(RAMPS), compiled=True), codegen.load(tmp_path).solver()
    rows = []
    for k in range(len(run.t) - 1):
        assert solver.set_inputs_between(run.inputs_begin[k + 1], run.inputs[k + 1]) == 0
        assert solver.set_time(run.t[k]) == solver.set_step(run.step[k + 1]) == solver.step() == 0
        rows.append([*solver.x, *solver.multipliers, solver.residual])
    np.testing.assert_array_equal(rows, np.column_stack([run.x, run.multipliers, run.residual])[1:])
    at, _ = solver.x.copy(), solver.set_inputs([-1.0])
    assert solver.step() != 0
    np.testing.assert_array_equal(solver.x, at)
    assert (solver.set_inputs([1.0]), solver.step()) == (0, 0)


# ------------------------------------------------------------------------------------------------- files, judges, refusals


def test_files_names_and_words(tmp_path):
    law = {"rub": relay(1, -u, u), "stop": box(-1, 1 + 0.5 * ca.sin(t))}
    both = LureSystem(
        t=t, A=[[0, 1], [-1, 0]], B=np.eye(2)[::-1], C=np.eye(2)[::-1], f=[0, 3 * ca.sin(t)], law=law, x0=[0, 0], t_end=4,
        step=1e-2, inputs={u: RAMPS}, outputs={"heat": -ca.SX.sym("rub") * ca.SX.sym("x_1")},
    )  # fmt: skip
    whole = simulate(both)
    simulate(both, t_end=2, out=tmp_path / "run")
    simulate(both, out=tmp_path / "run", resume=True)
    read = Trajectory.load(tmp_path / "run" / "trajectory.npz")
    for name in ("x", "multipliers", "y", "index_set", "residual", "heat"):
        np.testing.assert_array_equal(getattr(read, name), getattr(whole, name))
    assert read.metadata["multiplier_names"] == ["rub", "stop"]
    assert (np.abs(read.multiplier("rub")[1:]) <= read.u[1:] + 1e-15).all()
    stuck = read.index_set[1:, 0] == 0
    assert stuck.any()
    assert (read.y[1:, 0][stuck] == 0).all()
    assert "multipliers" in explain(both)
    K = r"K = \left[-u,\ u\right] \times \left[-1,\ 1 + 0.5\,\sin\left(t\right)\right]"
    assert K in equations(both)


def other_units(model):
    """How far a run in other units of states and of time is from the model's own, beside the largest state."""
    run, other = simulate(model), simulate(in_units(model.bind(), 1e3, 10.0))
    return np.abs(other.x / 1e3 - run.x).max() / np.abs(run.x).max()


def test_judges_know_them_in_all_units():
    shifted = mass(box(-u - 0.1 * t, 2 * u + 0.5), 3 * ca.sin(t), inputs={u: RAMPS})
    run = simulate(shifted)
    assert other_units(shifted) < 1e-9
    assert max(misfits(shifted.bind(), run).values()) < 1
    for wrong in (box(-u - 0.1 * t - 1e-4, 2 * u + 0.5), box(-u - 0.1 * t + 1e-4, 2 * u + 0.5), box(1 - u, -1)):
        assert misfits(mass(wrong, 0, inputs={u: RAMPS}).bind(), run)["law"] > 1e3


@pytest.mark.long
def test_stress_and_study():
    for law in (relay(1, -u, u), box(-u - 0.1 * t, 2 * u + 0.5)):
        cells = stress(mass(law, 3 * ca.sin(t), inputs={u: RAMPS}), steps=6).cells
        assert {cell.verdict for cell in cells} == {"right"}
    lines = study(driven(RAMPS), budget=5)
    assert lines.status == "done"
    assert any(point.errors for line in lines.lines for point in line.points)


def test_what_does_not_go_with_them_is_refused_by_name(tmp_path):
    with pytest.raises(ModelError, match=r"operator: the ends of component 0, \(-u\) and u, move.*sign\(x\)"):
        MonotoneInclusion(x=x, field=[0], operator=relay(1, -u, u), x0=[1], t_end=1, inputs={u: 1.0})
    still = mass(relay(1, -1 - t, 1 + t), 3 * ca.sin(t), A=[[-1]])
    with pytest.raises(UsageError, match="the law moves with time"):
        certificate_of(check(still, quick=True))
    with pytest.raises(CodegenError, match="that of 'l_0' moves"):
        codegen.write(still, tmp_path, event_driven=True)
    with pytest.raises(ModelError, match="law: upper depends on 'x'"):
        FirstOrderSystem(x=x, lam=l, f=[0], g=[l], h=[x], law=relay(1, -1, x), x0=[0], t_end=1)
    proved = simulate(still, rtol=1e-8, certify="interval")
    assert proved.metadata["certificate"]["not_proved"] == 0


def test_nothing_of_it_is_in_the_way_of_laws_that_stay():
    problem = one_step_problem(mass(relay(1), ca.sin(t)))
    assert problem.scale is problem.multipliers is problem.outputs is None
    assert problem.ends == ()


# ---------------------------------------------------------------------------------------------------------------- checks


def test_a_bounded_law_of_a_lure_system_may_be_any_measurable_function():
    report = check(driven(None), bounds={u: within(0.5, 2)}, quick=True)
    assert {id: report[id].verdict for id in ("3.1", "5.4a", "5.x0", "ends")} == dict.fromkeys(
        ("3.1", "5.4a", "5.x0", "ends"), "holds"
    )
    assert report["3.1"].value["width"] == report["ends"].value["width"] == 1
    assert {item.name: item.verdict for item in report.consequences} == {"well posed": "holds", "contraction": "holds"}
    assert report.inputs == ("u: in law; within [0.5, 2], any measurable function (given)",)
    timed = check(mass(relay(1, -1 - t, 1 + t), 1.0), quick=True)
    assert timed["ends"].value["width"] == timed["3.1"].value["width"] == 2
    full = check(driven(pwm(0.5, 0.4, low=0.5)))
    assert {full[id].verdict for id in ("3.1", "ends", "run-contraction", "run-residual")} == {"holds"}


def test_an_end_without_other_end_moves_y_where_d_hands_it_on():
    for D, verdict in (([[0]], "sampled"), ([[1]], "unknown")):
        report = check(mass(box(u, np.inf), 1.0, D=D, inputs={u: pwm(1, 0.5)}), quick=True)
        assert next(item.verdict for item in report.consequences if item.name == "contraction") == verdict
        assert report["ends"].verdict == "holds"


@pytest.mark.parametrize("kind", ["lure", "first order"])
def test_a_law_that_may_be_empty_is_a_violation_with_its_witness(kind):
    law = box(u - 1, 1 + ca.sin(t))
    own = mass(law, 1.0, inputs={u: None})
    if kind == "first order":
        own = FirstOrderSystem(x=x, lam=l, f=[1], g=[l], h=[x], law=law, x0=[0], t=t, t_end=6, step=0.01, inputs={u: None})
    report = check(own, bounds={u: within(0, 2)}, quick=True)
    ends, names = report["ends"], {"lure": "l_0", "first order": "l"}
    assert ends.verdict == "violated"
    seen = ends.witness
    assert seen["row"] == names[kind]
    assert (seen["lower"], seen["upper"]) == pytest.approx((seen["u"] - 1, 1 + np.sin(seen["t"])))
    assert seen["lower"] > seen["upper"]
    assert 0 <= seen["u"] <= 2
    assert not report.consequences
    assert {finding.verdict for finding in report.findings if finding.id != "ends"} == {"unknown"}
    assert check(own, bounds={u: within(0, 0.9)}, quick=True)["ends"].verdict == "holds"


def test_a_first_order_system_asks_how_fast_the_ends_move():
    own = FirstOrderSystem(
        x=x, lam=l, f=[1], g=[l], h=[x], law=relay(1, -u, u), x0=[0], t_end=2, step=0.01, inputs={u: pwm(0.5, 0.4)}
    )
    given = FirstOrderSystem(x=x, lam=l, f=[1], g=[l], h=[x], law=relay(1, -u, u), x0=[0], t_end=2, step=0.01, inputs={u: None})
    moves = {
        "any": check(given, bounds={u: within(0.5, 2)}, quick=True),
        "slow": check(own, bounds={u: within(0.5, 2, rate=3)}, quick=True),
        "pulses": check(own, quick=True),
    }
    assert {name: report["F-inputs"].verdict for name, report in moves.items()} == {
        "any": "unknown",
        "slow": "holds",
        "pulses": "violated",
    }
    assert moves["slow"]["F-inputs"].value["|g'| at most"] == pytest.approx(3)
    seen = moves["pulses"]["F-inputs"].witness
    assert (seen["t"], seen["u-"], seen["u+"]) == (0.2, [1.0], [0.0])
    assert {moves["slow"][id].verdict for id in ("F-unique", "F-step", "ends")} == {"holds"}
    full = check(own, bounds={u: within(0, 2)})
    assert full["run-residual"].verdict == "holds"


def test_an_oscillator_has_one_step_at_each_time_and_says_nothing_of_rest():
    swing = {"x": x, "potential": x**2 / 2, "s": s, "x0": [1], "t": t, "t_end": 2, "step": 0.01}
    report = check(FrictionOscillator(friction=(1 + 0.5 * ca.sin(t)) * s, **swing))
    assert {report[id].verdict for id in ("O-theta", "O-dry", "run-residual")} == {"holds"}
    assert report["O-theta"].value["min theta'"] == pytest.approx(1, abs=1e-9)  # sin t >= 0 up to 2
    assert {item.name: item.verdict for item in report.consequences if item.name in ("well posed", "convergence")} == {
        "well posed": "holds", "convergence": "unknown",
    }  # fmt: skip
    bad = check(FrictionOscillator(friction=u * s, inputs={u: None}, **swing), bounds={u: within(-1, 1)}, quick=True)
    assert bad["O-theta"].verdict == "violated"
    assert bad["O-theta"].witness["u"] == -1
