"""Blocks with memory: ticks, each step, event-driven; the order of reads and writes; what is kept, resumed, refused."""

import casadi as ca
import numpy as np
import pytest
from block_scenes import (
    TS,
    begun,
    exact_friction_pi,
    exact_over_current,
    exact_regulated,
    fired,
    fired_current,
    friction_pi,
    over_current,
    pushed,
    regulated,
    schmitt,
    thermostat,
)
from input_scenes import T, boost

from nsmodel import (
    FirstOrderSystem,
    LureSystem,
    ModelError,
    StepError,
    UsageError,
    complementarity,
    dead_time,
    delay,
    each_step,
    hysteresis,
    latch,
    pid,
    pwm,
    sampled,
    simulate,
    stepper,
    steps,
    table,
)

X, U, Z, Y, D = (ca.SX.sym(name) for name in "xuzwd")
EVENTS = {"rtol": 1e-10}


def plant(*blocks, f=0, **fields):
    """x' = f."""
    given = {"x": X, "x0": [0], "t_end": 1, "step": 0.05, "theta": 0.5} | fields
    return FirstOrderSystem(f=[f], blocks=blocks, **given)


def counter(name="n", period=0.1, symbol=Z, **given):
    return sampled(name, period=period, memory={symbol: 0}, update={symbol: symbol + 1}, **given)


def at(run, times):
    """The rows at these times."""
    rows = np.searchsorted(run.t, np.asarray(times) * (1 - 1e-12))
    np.testing.assert_allclose(run.t[rows], times, rtol=1e-12, atol=1e-15)
    return rows


# -- scenes with exact answers


@pytest.mark.parametrize("compiled", [False, True])
def test_a_sampled_pi_on_dry_friction(compiled):
    run, exact = simulate(friction_pi(), compiled=compiled), exact_friction_pi()
    v = run.v[::20]
    np.testing.assert_allclose(v, exact[:, 0], atol=2e-6)
    assert np.array_equal(v == 0, exact[:, 0] == 0)
    assert run.z[-1] == pytest.approx(exact[-1, 1], abs=1e-5)
    assert (run.inputs[1:] == run.inputs_begin[1:])[:, 1:].all()  # what is held does not move within a step


def test_a_sampled_pi_on_dry_friction_event_driven():
    run, exact = simulate(friction_pi(), rtol=1e-10), exact_friction_pi()
    np.testing.assert_allclose(run.at(np.arange(201) * TS).x[:, 0], exact[:, 0], atol=1e-9)
    assert run.z[-1] == pytest.approx(exact[-1, 1], abs=1e-9)


@pytest.mark.parametrize("kind", ["trailing", "leading", "centre"])
@pytest.mark.parametrize(
    ("options", "atol"),
    [
        ({"compiled": False}, 2e-3),
        ({"compiled": True, "step": T / 80}, 2e-4),
        (EVENTS, 1e-9),
        ({"rtol": 1e-4, "method": "time-stepping", "compiled": True}, 1e-4),
    ],
    ids=["steps", "compiled", "event-driven", "rtol"],
)
def test_a_duty_that_a_block_sets_is_turned_into_edges(kind, options, atol):
    run = simulate(regulated(kind), **options)
    np.testing.assert_allclose(run.x[at(run, np.arange(61) * T)], exact_regulated(kind), atol=atol)
    edges = np.flatnonzero(np.diff(run.u))
    assert edges.size == {"trailing": 119, "leading": 119, "centre": 120}[kind]


def test_time_stepping_with_blocks_has_order_two():
    errors = []
    for n in (10, 40):
        run = simulate(regulated(periods=30, step=T / n), compiled=True)
        errors.append(np.abs(run.x[at(run, np.arange(31) * T)] - exact_regulated(periods=30)).max())
    assert np.log2(errors[0] / errors[1]) / 2 == pytest.approx(2, abs=0.35)


def test_a_thermostat_switches_where_its_band_ends():
    first, between = 2 * np.log(20 / 14), 2 * np.log(16 / 14)
    run = simulate(thermostat(), rtol=1e-10)
    turns = run.t[np.flatnonzero(np.diff(run.u))]
    np.testing.assert_allclose(turns, first + between * np.arange(turns.size), rtol=1e-11)
    late = []
    for h in (4e-3, 1e-3):
        steps_ = simulate(thermostat(step=h))
        seen = steps_.t[np.flatnonzero(np.diff(steps_.u))][: turns.size]
        late.append(np.abs(seen - turns[: seen.size]).max())
    assert late[0] < 2 * turns.size * 4e-3
    assert late[1] < late[0] / 2


@pytest.mark.parametrize(("low", "high"), [(1.8, 2.2), (0.1, 2.2), (2.1, 2.2)])
def test_a_current_that_moves_at_constant_rates_stays_in_its_band(low, high):
    """The motion has no time of its own: what a switch is measured beside is not how far a very long piece would go."""
    on, off = (24 - 9) / 1e-4, 9 / 1e-4
    model = plant(hysteresis(U, X, low, high, start=1), f=(24 * U - 9) / 1e-4, t_end=1e-3)
    run = simulate(model, rtol=1e-10)
    turns = run.t[np.flatnonzero(np.diff(run.u) < 0)]
    width = (high - low) * (1 / on + 1 / off)
    np.testing.assert_allclose(turns, high / on + width * np.arange(turns.size), rtol=1e-9)
    assert turns.size == int((1e-3 - high / on) / width) + 1


def test_a_sampled_thermostat_has_the_period_of_its_samples():
    run = simulate(thermostat(period=0.05, t_end=20), rtol=1e-10)
    x, u = 15.0, 1.0
    for _ in range(400):
        u = 1.0 if x <= 19 else 0.0 if x >= 21 else u
        x = 5 + 30 * u + (x - 5 - 30 * u) * np.exp(-0.025)
    assert run.T[-1] == pytest.approx(x, abs=1e-9)
    assert x == pytest.approx(20.72482833, abs=1e-8)


def test_a_schmitt_trigger_oscillates():
    run = simulate(schmitt(), rtol=1e-10)
    half = 1e-2 * np.log(3)
    np.testing.assert_allclose(run.t[1:-1], 1e-2 * np.log(2) + half * np.arange(4), rtol=1e-11)
    np.testing.assert_allclose(np.abs(run.v[1:-1]), 2.5, rtol=1e-11)


def test_an_over_current_latch_trips_at_its_samples():
    run, (i, turns) = simulate(over_current()), exact_over_current()
    np.testing.assert_allclose(run.i[at(run, np.arange(201) * 2e-3)], i, atol=2e-6)
    np.testing.assert_allclose(run.t[np.flatnonzero(np.diff(run.q))], np.array(turns) * 2e-3)
    assert turns == [41, 100, 139]


@pytest.mark.parametrize("alpha", [30, 90, 120])
def test_a_thyristor_conducts_until_its_current_is_zero(alpha):
    run, (i, b) = simulate(fired(alpha), rtol=1e-10), fired_current(alpha)
    out = run.t[np.flatnonzero(np.diff(run.q) < 0)]
    np.testing.assert_allclose(out * 360 / 0.02, [b], rtol=1e-10)
    assert run.at(8e-3).x.item() == pytest.approx(i(144), rel=1e-9)
    assert np.abs(run.i[-1]) < 1e-9
    coarse = simulate(fired(alpha))
    row = np.searchsorted(coarse.t, 8e-3)
    assert coarse.i[row] == pytest.approx(i(coarse.t[row] * 360 / 0.02), rel=1e-5)


# -- ticks: when, in which order


def test_the_first_tick_is_before_the_first_step_and_the_last_before_the_end():
    run = simulate(plant(counter()))
    np.testing.assert_array_equal(run.z, [1, *np.repeat(np.arange(1, 11), 2)])


def test_ticks_begin_at_the_offset():
    run = simulate(plant(counter(offset=0.25)), compiled=False)
    np.testing.assert_array_equal(run.z, np.maximum(0, np.ceil((run.t - 0.25 - 1e-9) / 0.1)))
    assert {0.25, 0.35} <= set(run.t.round(12))


def test_outputs_before_the_first_tick():
    block = sampled("b", period=0.2, offset=0.5, memory={Z: 3}, outputs={U: Z + 1, D: Z}, update={Z: 0}, start={D: -1})
    run = simulate(plant(block))
    assert (run.u[0], run.d[0]) == (4, -1)
    assert (run.u[-1], run.d[-1], run.z[-1]) == (1, 0, 0)
    assert run.u[run.t < 0.55][-1] == 4


def test_outputs_and_update_read_the_old_memory():
    run = simulate(plant(sampled("b", period=0.5, memory={Z: 0}, outputs={U: Z}, update={Z: Z + 1})))
    assert (run.u[-1], run.z[-1]) == (1, 2)


def test_blocks_of_one_tick_read_before_any_writes():
    swap = [
        sampled("a", period=0.25, memory={Y: 1}, update={Y: Z}),
        sampled("b", period=0.25, memory={Z: 2}, update={Z: Y}),
    ]
    for order in (swap, swap[::-1]):
        run = simulate(plant(*order))
        np.testing.assert_array_equal(run.w[[1, 6, 11, 16]], [2, 1, 2, 1])
        np.testing.assert_array_equal(run.z[[1, 6, 11, 16]], [1, 2, 1, 2])


@pytest.mark.parametrize("options", [{}, EVENTS], ids=["steps", "event-driven"])
def test_a_tick_sees_inputs_after_an_edge_and_the_state_before_it(options):
    block = sampled("b", period=0.5, outputs={D: U, Y: X})
    run = simulate(plant(block, f=U, inputs={U: table([0, 0.5], [1, 2])}), **options)
    assert run.d[-1] == 2
    assert run.w[-1] == pytest.approx(0.5)
    assert run.x[-1].item() == pytest.approx(1.5)


def test_steps_end_at_ticks_that_do_not_fit():
    run = simulate(plant(counter(period=0.13), step=0.05))
    assert len(at(run, 0.13 * np.arange(8))) == 8
    assert run.step[1:].max() <= 0.05 * (1 + 1e-9)


def test_two_periods():
    run = simulate(plant(counter(), counter("m", 0.25, Y), step=0.01))
    np.testing.assert_array_equal(run.z, 1 + np.maximum(np.ceil(run.t / 0.1 - 1e-9) - 1, 0))
    np.testing.assert_array_equal(run.w, 1 + np.maximum(np.ceil(run.t / 0.25 - 1e-9) - 1, 0))


def test_each_step_acts_at_the_start_and_after_each_step():
    block = each_step("b", memory={Z: 0, Y: 0}, update={Z: Z + 1, Y: X})
    for compiled in (False, True):
        run = simulate(plant(block, f=1), compiled=compiled)
        np.testing.assert_array_equal(run.z, [1, *range(1, 21)])
        np.testing.assert_allclose(run.w[1:], run.t[:-1], atol=1e-14)


def test_a_duty_is_read_when_a_period_begins_and_moved_into_its_range():
    block = sampled("b", period=0.2, offset=0.1, outputs={D: 2 * ca.SX.sym("x") - 0.25})
    run = simulate(plant(block, f=U, inputs={U: pwm(0.5, D, high=0.8)}, step=0.01, t_end=2), compiled=False)
    duty = run.inputs[:, 2]
    assert duty.min() == 0
    assert set(run.t[np.flatnonzero(np.diff(duty))].round(9)) <= {0.5, 1.0, 1.5}
    for k in range(4):
        inside = (run.t > 0.5 * k + 1e-9) & (run.t <= 0.5 * (k + 1) + 1e-9)
        on = run.step[inside & (run.u > 0)].sum()
        assert on == pytest.approx(0.5 * duty[inside][0], abs=1e-12)


# -- helpers


def test_delay():
    run = simulate(plant(delay(U, X, samples=3, period=0.1, start=-1), f=1))
    samples = run.u[1::2]
    np.testing.assert_allclose(samples, [-1, -1, -1, *0.1 * np.arange(7)], atol=1e-12)


def test_pid_is_the_recursion_it_says():
    model = plant(pid(U, 1 - X, kp=2, ki=5, kd=0.05, period=0.1, low=-0.5, high=1.5), f=U - X, t_end=4)
    run = simulate(model, rtol=1e-10)
    x, z, last = 0.0, 0.0, None
    for k in range(40):
        e = 1 - x
        free = 2 * e + z + 0.05 * ((e - last) / 0.1 if k else 0)
        u = min(max(free, -0.5), 1.5)
        assert run.at(0.1 * k + 0.05).x.item() == pytest.approx(u + (x - u) * np.exp(-0.05), abs=1e-9)
        z, last, x = z if (free > 1.5 and e > 0) or (free < -0.5 and e < 0) else z + 0.5 * e, e, u + (x - u) * np.exp(-0.1)
    assert x == pytest.approx(1, abs=1e-2)


@pytest.mark.parametrize("options", [{"step": 1e-3}, {"rtol": 1e-8}], ids=["steps", "event-driven"])
def test_switches_of_a_leg_are_never_both_on(options):
    t, on, off, c = (ca.SX.sym(name) for name in ("t", "on", "off", "c"))
    model = FirstOrderSystem(
        t=t, x=X, x0=[0], f=[on - off], t_end=1, step=1e-3,
        inputs={c: pwm(0.5, 0.4)}, blocks=[dead_time(on, off, c, t, delay=0.05)],
    )  # fmt: skip
    run = simulate(model, **options)
    assert not (run.on * run.off).any()
    turns = {name: run.t[np.flatnonzero(np.diff(getattr(run, name)) > 0)] for name in ("on", "off")}
    np.testing.assert_allclose(turns["on"], [0.05, 0.55], atol=2e-3)
    np.testing.assert_allclose(turns["off"], [0.25, 0.75], atol=2e-3)


def test_reset_wins_over_set():
    run = simulate(plant(latch(Z, X - 0.2, X - 0.6), f=1, step=0.1), compiled=False)
    np.testing.assert_array_equal(run.z, [0, 0, 0, 0, 1, 1, 1, 0, 0, 0, 0])


# -- modes


@pytest.mark.parametrize("gamma", [0.5, 1])
def test_matrices_of_a_switch_that_multiplies_unknowns_are_kept_for_each_mode(gamma):
    model = boost(gamma=gamma, t_end=1e-3)
    run = simulate(model, compiled=False)
    assert "matrices are kept for each mode of u" in run.metadata["used"]
    assert set(run.metadata["solver_counts"]) <= {"index set", "last index set"}
    fine = simulate(model, rtol=1e-9)
    np.testing.assert_allclose(run.x[-1], fine.x[-1], atol={0.5: 1e-2, 1: 0.4}[gamma])
    c = simulate(model, compiled=True)
    np.testing.assert_allclose(run.x, c.x, atol=1e-9)


def test_a_held_switch_of_two_values_is_a_mode():
    switch = each_step("b", memory={Z: 1}, update={Z: ca.if_else(X >= 0.5, 0, ca.if_else(X <= 0.2, 1, Z))}, values={Z: (0, 1)})
    model = plant(switch, f=Z * (1 - X) - 2 * (1 - Z) * X, step=0.01, t_end=3)
    run = simulate(model, compiled=False)
    assert "matrices are kept for each mode of z" in run.metadata["used"]
    x, z = 0.0, 1
    for k in range(1, len(run)):
        z = 0 if x >= 0.5 else 1 if x <= 0.2 else z
        x = (x * (1 - 0.005 * (2 - z)) + 0.01 * z) / (1 + 0.005 * (2 - z))
        assert run.x[k, 0] == pytest.approx(x, abs=1e-12)
        assert run.z[k] == z


# -- runs: resume, save, stepper, bind


def test_a_run_goes_on_as_if_it_had_not_stopped(tmp_path):
    model = regulated(periods=20)
    whole = simulate(model, compiled=False)
    for name, t_end in (("begin", 10 * T), ("middle", 10 * T + 4 * T / 20)):
        part = tmp_path / name
        simulate(model, compiled=False, t_end=t_end, out=part)
        if name == "begin":
            run = simulate(model, compiled=False, out=part, resume=True)
            for column in ("t", "x", "inputs", "step"):
                np.testing.assert_array_equal(run.arrays[column], whole.arrays[column])


def test_an_event_driven_run_goes_on(tmp_path):
    model = regulated(periods=20)
    whole = simulate(model, rtol=1e-8)
    simulate(model, rtol=1e-8, t_end=7.3 * T, out=tmp_path / "a")
    run = simulate(model, rtol=1e-8, out=tmp_path / "a", resume=True)
    for column in ("t", "x", "inputs", "inputs_begin"):
        np.testing.assert_array_equal(run.arrays[column], whole.arrays[column])


def test_the_stepper_has_the_bits_of_simulate():
    model = regulated("centre", periods=20)
    run, s = simulate(model, compiled=False), stepper(model, record=True, compiled=False)
    for h in run.step[1:]:
        s.step(h=float(h))
    np.testing.assert_array_equal(s.trajectory.x, run.x)
    np.testing.assert_array_equal(s.trajectory.inputs, run.inputs)
    assert s.held["z"] == run.z[-1]
    assert s.next_tick == pytest.approx(20 * T)


def test_the_stepper_refuses_to_go_over_a_tick_or_an_edge_of_a_block():
    s = stepper(regulated())
    with pytest.raises(UsageError, match=r"block ticks, at t = 4.8e-06: step at most 4.8e-06"):
        s.step(h=T)
    row = s.step(h=T, split=True)
    assert row.t == pytest.approx(T)
    with pytest.raises(UsageError, match="block ticks"):
        s.step(h=T)


@pytest.mark.parametrize("kind", ["trailing", "leading", "centre"])
def test_parts_of_a_step_end_at_edges_that_a_tick_within_it_places(kind):
    s = stepper(regulated(kind, periods=20, step=T / 40))
    while s.t < 20 * T * (1 - 1e-12):
        s.step(h=min(0.027 * T, 20 * T - s.t), split=True)
    np.testing.assert_allclose(s.x, exact_regulated(kind, periods=20)[-1], atol=2e-3)


def test_free_inputs_are_read_by_the_tick_of_the_step_that_they_are_given_to():
    model = plant(sampled("b", period=0.1, memory={Z: 0}, update={Z: Z + U}), f=Z, inputs={U: None}, step=0.1, theta=1)
    s = stepper(model)
    for k in range(5):
        s.step(k)
    assert s.held == {"z": 10}
    saved = s.checkpoint()
    x = s.step(1).x
    s.restore(saved)
    np.testing.assert_array_equal(s.step(1).x, x)
    s.reset()
    assert s.held == {"z": 0}


def test_start_and_gains_may_be_parameters():
    k = ca.SX.sym("k")
    model = plant(sampled("b", period=0.5, memory={Z: k}, update={Z: k * Z}), f=Z, parameters={k: None})
    for value in (2.0, 3.0):
        run = simulate(model, parameters={"k": value})
        assert run.z[-1] == value**3
        assert run.x[-1].item() == pytest.approx(0.5 * (value**2 + value**3))


def test_multipliers_are_read_as_those_of_the_step_before():
    l = ca.SX.sym("l")
    model = FirstOrderSystem(
        x=X, lam=l, x0=[1], f=[-1], g=[l], h=[X], law=complementarity(1), t_end=2, step=0.125,
        blocks=[sampled("b", period=0.5, outputs={U: l})],
    )  # fmt: skip
    for compiled in (False, True):
        run = simulate(model, compiled=compiled)
        rows = np.searchsorted(run.t, [0.5, 1.0, 1.5]) + 1
        np.testing.assert_allclose(run.u[rows], run.multipliers[rows - 1, 0])
        assert run.u[-1] == pytest.approx(1)


# -- what is refused


def test_no_number_is_held_that_is_none():
    model = plant(sampled("b", period=0.5, outputs={U: 1 / X}), f=1)
    with pytest.raises((StepError, UsageError), match=r"block 'b' sets u = inf at t = 0"):
        simulate(model)


def test_an_update_that_moves_with_time_is_refused_event_driven():
    model = plant(each_step("b", memory={Z: 0}, update={Z: 2 * X}), f=1)
    with pytest.raises(StepError, match=r"block 'b' sets z to what moves with time.*period"):
        simulate(model, rtol=1e-6, method="event-driven")


def test_a_hysteresis_without_a_band_is_refused_event_driven():
    model = plant(hysteresis(U, X, 0.5, 0.5, start=1, below=1, above=-1), f=U)
    with pytest.raises(StepError, match=r"t = 0.5.*"):
        simulate(model, rtol=1e-6)


def test_each_step_is_refused_by_time_stepping_under_error_control():
    with pytest.raises(UsageError, match="block 'hysteresis u' acts after each step, but rtol chooses the steps"):
        simulate(thermostat(), rtol=1e-4, method="time-stepping")


def test_given_steps_do_not_know_edges_of_blocks():
    with pytest.raises(UsageError, match="a block places edges of a pwm"):
        simulate(regulated(), steps=[1e-6] * 10)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: sampled("b", period=0, memory={Z: 0}), r"block 'b': period = 0; expected a time > 0"),
        (lambda: sampled("b", period=1, offset=-1, memory={Z: 0}), r"block 'b': offset = -1"),
        (lambda: sampled("b", period=1, memory=[Z]), r"block 'b': memory: expected a dictionary"),
        (lambda: delay(U, X, samples=0, period=1), r"samples = 0; expected a whole number >= 1"),
        (lambda: hysteresis(2, X, 0, 1, start=0), r"a block sets one SX symbol, not 2"),
        (lambda: plant(3), r"blocks: expected a list of blocks"),
        (lambda: plant(sampled("b", period=1)), r"block 'b': it has neither memory nor outputs"),
        (lambda: plant(counter(), counter("n", 0.2, Y)), r"blocks: 'n' is given twice"),
        (lambda: plant(counter(), counter("m")), r"'z' is an input, or what another block sets"),
        (lambda: plant(counter(symbol=ca.SX.sym("t"))), r"'t' is an input, or what another block sets, or an attribute of runs"),
        (lambda: plant(counter(symbol=U), inputs={U: 1}), r"'u' is an input, or"),
        (lambda: plant(sampled("b", period=1, outputs={U: ca.SX.sym("q")})), r"block 'b': the value of u.*'q'"),
        (lambda: plant(sampled("b", period=1, outputs={U: ca.vertcat(X, X)})), r"the value of u: 2 values; expected 1"),
        (lambda: plant(sampled("b", period=1, memory={Z: 0}, update={Y: 0})), r"update: 'w' is not among its memory \(z\)"),
        (lambda: plant(sampled("b", period=1, memory={Z: 0}, start={Z: 0})), r"start: 'z' is not among its outputs \(none\)"),
        (
            lambda: plant(sampled("b", period=1, memory={Z: 0}, values={Z: "ab"})),
            r"values of z: 'ab'; expected a list of",
        ),
        (lambda: plant(counter(), inputs={U: steps([1, 2])}, f=U), None),
    ],
)
def test_bad_blocks(make, match):
    if match is None:
        make()
        return
    with pytest.raises(ModelError, match=match):
        make()


def test_what_a_block_sets_has_no_other_signal():
    with pytest.raises(UsageError, match=r"input 'u': a pwm whose duty is an expression; declare it in the model"):
        simulate(plant(counter(), f=U, inputs={U: 1}), inputs={"u": pwm(0.1, Z)})
    with pytest.raises(UsageError, match=r"input 'z' is set by the block 'n'; leave it out"):
        simulate(plant(counter()), inputs={"z": 1})


def test_a_lure_system_with_a_block_and_no_input():
    model = LureSystem(
        x=X, A=[[-1]], B=[[1]], C=[[1]], f=[Z], law=complementarity(1), x0=[0], t_end=1, step=0.1, blocks=[counter()]
    )
    assert simulate(model).z[-1] == 10


@pytest.mark.parametrize(("kind", "gamma"), [("trailing", 1.0), ("trailing", 0.5), ("centre", 0.5)])
def test_a_block_reads_a_pulse_whose_duty_another_sets(kind, gamma):
    """The stepper has the bits of `simulate` on its steps, at the edges of pulses too, where a carried reaction is found anew."""
    model = pushed(kind, gamma)
    run, s = simulate(model, compiled=False), stepper(model, compiled=False)
    assert run.n[-1] > 20
    for k in range(len(run.t) - 1):
        row = s.step(h=run.step[k + 1])
        np.testing.assert_array_equal([*row.x, *row.inputs], [*run.x[k + 1], *run.inputs[k + 1]])


def test_a_sampled_block_reads_a_pulse_event_driven():
    x, u, d, n = (ca.SX.sym(name) for name in "xudn")
    count = sampled("count", period=0.1, offset=0.05, memory={n: 0}, outputs={d: 0.3 + 0.06 * n}, update={n: n + u})
    model = FirstOrderSystem(x=x, f=[u - x], x0=[0], step=0.01, t_end=2, inputs={u: pwm(0.1, d)}, blocks=[count])
    run, exact = simulate(model), simulate(model, rtol=1e-8)
    assert run.n[-1] == exact.n[-1] == 0  # a pulse of 0.3 ends before it is looked at
    wide = FirstOrderSystem(x=x, f=[u - x], x0=[0], step=0.01, t_end=2, inputs={u: pwm(0.1, d + 0.25)}, blocks=[count])
    assert simulate(wide).n[-1] == simulate(wide, rtol=1e-8).n[-1] == 20


def test_a_start_with_a_step_behind_it():
    """What ticked at t = 0 read the first of two positions; the stepper begins behind that."""
    run, s = simulate(begun(), compiled=False), stepper(begun(), compiled=False)
    assert run.z[:2].tolist() == [1.1, 1.1]
    assert run.n[-1] == 300
    for k in range(1, 40):
        row = s.step()
        np.testing.assert_array_equal([*row.x, *row.inputs], [*run.x[k + 1], *run.inputs[k + 1]])


def test_a_value_that_a_block_does_not_name_stops_the_run():
    block = sampled("gear", period=0.5, memory={Z: -1}, update={Z: Z + 1}, outputs={Y: Z + 1}, values={Y: (0, 1, 2)})
    model = plant(block, f=Y, step=0.1, t_end=1.4)
    assert len(simulate(model)) == 14
    for options in ({}, {"compiled": True}, {"rtol": 1e-6}):
        with pytest.raises(StepError, match=r"w = 3 at t = 1\.5: its block has values=\(0\.0, 1\.0, 2\.0\)"):
            simulate(model, t_end=2.0, **options)


@pytest.mark.parametrize("options", [{}, {"compiled": True}, {"rtol": 1e-6}, {"rtol": 1e-6, "method": "event-driven"}])
def test_a_value_that_is_none_stops_every_run_at_its_tick(options):
    block = sampled("pole", period=0.5, memory={Z: -1}, update={Z: Z + 1}, outputs={Y: 1 / (2 - Z)})
    with pytest.raises(StepError, match=r"block 'pole' sets w = inf at t = 1\.5"):
        simulate(plant(block, f=Y, step=0.1, t_end=2.0), **options)
