"""Known times (`switch_times`): edges of the data at which pieces end, and steps under error control."""

import pickle

import casadi as ca
import numpy as np
import pytest

import nsmodel
from nsmodel import (
    Bodies,
    Family,
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    ManyBodies,
    ModelError,
    MonotoneInclusion,
    SweepingProcess,
    complementarity,
    relay,
    simulate,
)  # fmt: skip
from nsmodel.codegen.library import compiler
from nsmodel.event_driven.integrator import Integrator
from nsmodel.event_driven.problem import SwitchTimes
from nsmodel.modeling.fingerprint import fingerprint
from nsmodel.modeling.time_grid import make_grid
from nsmodel.simulation.event_driven import event_driven_problem
from nsmodel.simulation.simulate import explain

WAYS = [False, *([True] if compiler() else [])]
t, x, q, s = ca.SX.sym("t"), ca.SX.sym("x"), ca.SX.sym("q"), ca.SX.sym("s")


def pushed(times=(), rate=0.0):
    """x' = -rate x + u(t) + l, l in -Sgn x, u = 2 on [1, 2], else 0: from stick to 1 at t = 2, and back (rate = 0)."""
    u = ca.if_else(t < 1, 0, ca.if_else(t < 2, 2, 0))
    return LureSystem(t=t, A=[[-rate]], B=[[1]], C=[[1]], f=[u], law=relay(1), x0=[0], t_end=4, switch_times=times)


def by_events(model, rtol, compiled, **more):
    """A run whose pieces are made in the way that is asked for."""
    run = simulate(model, rtol=rtol, method="event-driven", compiled=compiled, **more)
    assert any("pieces in C" in line for line in run.metadata["used"]) == compiled
    return run


def of_each_class(times):
    one = Bodies([[0.5]])
    i = one.member("i")
    common = {"t_end": 1, "step": 0.25, "switch_times": times}
    return [
        FirstOrderSystem(x=x, f=[-x], x0=[1], **common),
        LureSystem(A=[[-1]], B=[[1]], C=[[1]], law=relay(1), x0=[1], **common),
        SweepingProcess(q=q, f=[-1], constraints={"wall": q}, q0=[0.5], **common),
        FrictionOscillator(x=x, potential=x**2 / 2, friction=s, s=s, x0=5, v0=0, **common),
        MonotoneInclusion(x=x, field=-x, x0=1, **common),
        ManyBodies(bodies=one, constraints={"wall": Family(i.q, i)}, f=[-1], **common),
    ]


def test_every_class_takes_them():
    for model in of_each_class(np.array([0.3, 0.7])):
        assert model.switch_times == (0.3, 0.7)
        assert model.bind().switch_times == (0.3, 0.7)
        assert pickle.loads(pickle.dumps(model)).switch_times == (0.3, 0.7)
        assert "switch_times" in explain(model)
    assert of_each_class([0.3])[-1].written_out().switch_times == (0.3,)
    assert [model.switch_times for model in of_each_class(None)] == [()] * 6


def test_other_times_are_another_model():
    marks = {fingerprint(model, make_grid(model, 0.1, None, None)) for model in map(pushed, ((), (1,), (1, 2), (1, 3)))}
    assert len(marks) == 4


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ([1, 1], r"switch_times\[1\] = 1 is not after switch_times\[0\] = 1; give them in order"),
        ([0.5, -1], r"switch_times\[1\] = -1; expected times >= 0: a run begins at 0"),
        ([1, np.inf], r"switch_times\[1\] = inf; expected a finite number"),
        ([True], r"switch_times\[0\] = True is not a number"),
        (["1"], r"switch_times\[0\] = '1' is not a number"),
        (3.0, r"switch_times: expected a list or 1-D array of times, not 3.0"),
        ([[1, 2]], r"switch_times\[0\] = \[1, 2\] is not a number"),
        (np.ones((1, 2)), r"switch_times: expected a list or 1-D array of times"),
    ],
)
def test_what_is_no_list_of_times_is_refused(given, words):
    with pytest.raises(ModelError, match=words):
        pushed(given)


@pytest.mark.parametrize("compiled", WAYS)
@pytest.mark.parametrize("times", [(), (1, 2), (0, 0.1 + 0.2, 1, 2, 9)])
def test_an_edge_and_a_branch_at_one_time_are_one_event(times, compiled):
    run = by_events(pushed(times), 1e-10, compiled)
    inside = sorted({1.0, 2.0, 3.0} | {time for time in times if 0 < time < 4})
    assert [event.t for event in run.events] == pytest.approx(inside, abs=1e-13)
    assert {*times} & {*inside} <= {*run.t.tolist()}
    np.testing.assert_allclose(run.at([0.5, 1.5, 2, 2.5, 3.5]).x[:, 0], [0, 0.5, 1, 0.5, 0], atol=1e-13)
    first = next(event for event in run.events if abs(event.t - 1) < 1e-9)
    np.testing.assert_allclose([first.multipliers_before[0], first.multipliers_after[0]], [0, -1])


@pytest.mark.parametrize("compiled", WAYS)
def test_branches_of_time_are_those_after_the_edge(compiled):
    """x' = fmod(t, 1/10) - x, with the edges where doubles put them: a sawtooth."""
    edges = np.arange(1, 10) / 10
    model = FirstOrderSystem(t=t, x=x, f=[ca.fmod(t, 0.1) - x], x0=[0], t_end=1, switch_times=edges)
    run = by_events(model, 1e-12, compiled)
    assert [event.t for event in run.events] == edges.tolist()
    k = np.arange(10)
    end = np.sum(np.exp(-(1 - k / 10)) * (1 - np.exp(0.1) * (1 - 0.1)))  # e^-1 times the integrals of (s - k/10) e^s
    assert run.x[-1, 0] == pytest.approx(end, rel=1e-12)


@pytest.mark.parametrize("compiled", WAYS)
@pytest.mark.parametrize("edge", [(), (1,)])
def test_a_wall_that_jumps_pushes_with_an_impulse(edge, compiled):
    """q' = -1 + l above a wall that jumps from 0 to 1/2 at t = 1: also where the edge is only a branch."""
    model = SweepingProcess(
        t=t, q=q, f=[-1], constraints={"wall": q - ca.if_else(t < 1, 0, 0.5)}, q0=[0.2], t_end=2, switch_times=edge
    )
    run = by_events(model, 1e-8, compiled)
    touch, jump = run.events
    assert touch.t == pytest.approx(0.2, abs=1e-14)
    assert jump.t == pytest.approx(1, abs=1e-14)
    np.testing.assert_allclose([*jump.x_before, *jump.x_after, *jump.impulse], [0, 0.5, 0.5], atol=1e-14)
    np.testing.assert_allclose(run.at([1 - 1e-9, 1, 1.5]).x[:, 0], [0, 0.5, 0.5], atol=1e-14)
    np.testing.assert_allclose(np.nansum(run.multipliers), 0.8 + 1 + 0.5, atol=1e-13)


@pytest.mark.parametrize("compiled", WAYS)
def test_a_voltage_that_jumps_starts_anew(compiled):
    """A source behind a diode onto a capacitor: v >= u(t), u jumps from 1 to 3 at t = 2 and v with it."""
    u = ca.if_else(t < 2, 1, ca.if_else(t < 3, 3, 0))
    model = FirstOrderSystem(
        t=t, x=x, lam=s, f=[-x], g=[s], h=[x - u], law=complementarity(1), x0=[1], t_end=4, switch_times=[2, 3]
    )
    run = by_events(model, 1e-10, compiled)
    np.testing.assert_allclose(run.at([1, 2, 2.5, 3, 4]).x[:, 0], [1, 3, 3, 3, 3 * np.exp(-1)], rtol=1e-12)
    assert [event.t for event in run.events] == [2, 3]
    np.testing.assert_allclose(run.events[0].impulse, [2])


@pytest.mark.parametrize("compiled", WAYS)
def test_no_number_of_a_piece_depends_on_the_end(compiled, tmp_path):
    """Whole, in parts, and with ends at, before and after an edge."""
    model = pushed((0.7, 1, 2, 3.3), rate=0.3)

    def go(out, **more):
        return by_events(model, 1e-8, compiled, out=out, **more)

    go(tmp_path / "one")
    for i, end in enumerate([0.35, 0.7, 0.9, 1.0, 2.7, 3.3, 3.7, None]):
        go(tmp_path / "parts", t_end=end, resume=i > 0)
    assert (tmp_path / "one" / "trajectory.npz").read_bytes() == (tmp_path / "parts" / "trajectory.npz").read_bytes()


@pytest.mark.parametrize("compiled", WAYS)
def test_a_piece_ends_exactly_there_whatever_the_numbers(compiled):
    rng = np.random.default_rng(3)
    times = np.sort(rng.uniform(0, 5, 200))
    model = LureSystem(A=[[0, 1], [-9, -0.2]], B=[0, 1], C=[0, 1], law=relay(1), x0=[9, 0], t_end=5, switch_times=times)
    free = simulate(LureSystem(A=[[0, 1], [-9, -0.2]], B=[0, 1], C=[0, 1], law=relay(1), x0=[9, 0], t_end=5), rtol=1e-12)
    run = by_events(model, 1e-12, compiled)
    assert {*times.tolist()} <= {*run.t.tolist()}
    assert (np.diff(run.t) > 0).all()
    np.testing.assert_allclose(run.at(times).x, free.at(times).x, atol=1e-10)


@pytest.mark.parametrize("method", ["auto", "event-driven"])
def test_explain_says_so(method):
    assert "2 known times (switch_times): each ends a piece" in explain(pushed((1, 2)), rtol=1e-6, method=method)
    assert "a step ends at each of 2 known times" in explain(pushed((1, 2)), rtol=1e-6, method="time-stepping")


@pytest.mark.parametrize("compiled", [False, True])
def test_steps_under_error_control_end_there(compiled):
    """Spans of 0.3, 0.7, 1, 2: no multiples of one another."""
    model = pushed((0.3, 1, 2), rate=1.0)
    run = simulate(model, rtol=1e-4, method="time-stepping", compiled=compiled)
    assert {0.3, 1.0, 2.0, 4.0} <= {*run.t.tolist()}
    assert (np.diff(run.t) > 0).all()
    exact = simulate(model, rtol=1e-10).at(run.t).x
    assert np.abs(run.x - exact).max() <= 2e-4 * exact.max()


def test_interpreted_and_compiled_steps_agree():
    model = pushed((0.3, 1, 2), rate=1.0)
    one, other = (simulate(model, rtol=1e-3, method="time-stepping", compiled=way) for way in (False, True))
    np.testing.assert_array_equal(one.t, other.t)
    np.testing.assert_allclose(one.x, other.x, rtol=1e-9, atol=1e-12)


def test_oscillators_carry_their_velocity_over_an_edge():
    """The state of its scheme is a difference of positions, in the length of the step."""
    model = FrictionOscillator(x=x, potential=x**2 / 2, friction=s / 2, s=s, x0=5, v0=0, t_end=5, switch_times=[1, 1.5, 4.1])
    run = simulate(model, rtol=1e-4, method="time-stepping")
    exact = simulate(model, rtol=1e-10)
    assert {1.0, 1.5, 4.1} <= {*run.t.tolist()}
    assert np.abs(run.x - exact.at(run.t).x).max() <= 5 * 1e-4 * 5


def test_known_times_are_for_any_problem():
    """The integrator takes them beside its problem, not from the model."""
    integrator = Integrator(event_driven_problem(pushed((), rate=1.0).bind()), 1e-6, None, SwitchTimes([0.25, 0.5]))
    ends = [integrator.advance().end for _ in range(3)]
    assert ends[:2] == [0.25, 0.5]
    assert integrator.known.times == [0.25, 0.5]
    assert nsmodel.simulate(pushed((0.25, 0.5)), rtol=1e-6).metadata["totals"]["events"] == 5
