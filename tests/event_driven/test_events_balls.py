"""Balls and ellipsoids in event-driven runs: stick, slip, stops, releases and turns, against closed forms and other means."""

import casadi as ca
import numpy as np
import pytest
from fuzz_models import COUNT

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    UsageError,
    ball,
    complementarity,
    ellipsoid,
    explain,
    plot,
    product,
    second_order_cone,
    simulate,
)
from nsmodel.codegen.event_driven_spec import piece_spec_of
from nsmodel.codegen.library import compiler
from nsmodel.errors import CodegenError
from nsmodel.simulation.event_driven import event_driven_problem
from tests.ball_models import random_model
from tests.slip_references import Slides

RTOLS = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10)
MANY = COUNT
t, s = ca.SX.sym("t"), ca.SX.sym("s")


def sliding(law, force, x0, v0, t_end, switch_times=()):
    """x'' = force(t, x, v) + l, each l against its velocity."""
    n = len(x0)
    x, l = ca.SX.sym("x", 2 * n), ca.SX.sym("l", n)
    f = [*ca.vertsplit(x[n:]), *ca.vertsplit(ca.SX(force(t, x[:n], x[n:])))]
    return FirstOrderSystem(
        t=t, x=x, lam=l, f=f, g=[0] * n + ca.vertsplit(l), h=ca.vertsplit(x[n:]), law=law, x0=[*x0, *v0], t_end=t_end,
        switch_times=switch_times,
    )  # fmt: skip


def judged(model, rtol, at, reference, events):
    """Assert that states err by at most 10 rtol of their largest values, and events by 10 rtol of the time.

    Events that the reference does not have are turns of blocks as slow as rtol/10.
    """
    run = simulate(model, rtol=rtol, times=at, method="event-driven")
    x = np.hstack([run.x, run.v]) if isinstance(model, FrictionOscillator) else run.x
    largest = np.abs(reference).max(axis=0)
    assert (np.abs(x - reference) / np.where(largest > 0, largest, 1)).max() <= 10 * rtol
    near = [np.abs(np.array(events) - event.t).min(initial=np.inf) <= 10 * rtol * at[-1] for event in run.events]
    assert sum(near) == len(events)
    for passed in (event for event, known in zip(run.events, near, strict=True) if not known):
        stopped = passed.y_after == 0
        assert (passed.before == passed.after).all()
        assert stopped.any()
        assert (np.abs(passed.y_before)[stopped] <= 0.1 * rtol * largest[-len(stopped) :][stopped]).all()
    assert run.residual[1:].max() <= rtol
    return run


@pytest.mark.parametrize("rtol", RTOLS)
def test_straight_stop_and_turn(rtol):
    """A block stops by a ball, and by an ellipsoid along its axis; it turns where the force is too large for stick."""
    at = np.linspace(0, 8, 241)
    run = judged(sliding(ball(2, 1), lambda *_: [0, 0], [0, 0], [3, 4], 8), rtol, at, _straight(at, 5, -1, 0, [0.6, 0.8]), [5.0])
    assert abs(run.events[0].t - 5) <= 1e-14
    assert (run.events[0].before.tolist(), run.events[0].after.tolist()) == ([1, 1], [0, 0])
    Q = np.diag([1 / 0.25, 1 / 4.0])
    judged(sliding(ellipsoid(Q), lambda *_: [0, 0], [0, 0], [0, 4], 8), rtol, at, _straight(at, 4, -2, 0, [0, 1]), [2.0])
    force = [-1.5 * 0.6, -1.5 * 0.8]
    judged(sliding(ball(2, 1), lambda *_: force, [0, 0], [3, 4], 8), rtol, at, _straight(at, 5, -2.5, -0.5, [0.6, 0.8]), [2.0])


def _straight(at, speed, slowing, after, direction):
    """Motion along a line with x'' = slowing until it stands, and x'' = after from there."""
    stop = -speed / slowing
    before, later = np.minimum(at, stop), np.maximum(at - stop, 0)
    place = speed * before + slowing * before**2 / 2 + after * later**2 / 2
    return np.outer(np.stack([place, np.where(at < stop, speed + slowing * at, after * later)]).T, direction).reshape(len(at), 4)


@pytest.mark.parametrize("rtol", RTOLS)
def test_release_by_a_growing_force(rtol):
    """|F| = r at t = 1/0.5: x'' = 0.5 t - 1 along the force from there on. One that stays there first is left at a power of 4."""
    at, e = np.linspace(0, 5, 241), np.array([0.6, 0.8])
    later = np.maximum(at - 2, 0)
    exact = np.hstack([np.outer(later**3 / 12, e), np.outer(later**2 / 4, e)])
    judged(sliding(ball(2, 1), lambda t, *_: 0.5 * t * ca.DM(e), [0, 0], [0, 0], 5), rtol, at, exact, [2.0])
    later = np.maximum(at - 1, 0)
    exact = np.hstack([np.outer(later**5 / 20, e), np.outer(later**4 / 4, e)])
    run = judged(sliding(ball(2, 1), lambda t, *_: (1 + (t - 1) ** 3) * ca.DM(e), [0, 0], [0, 0], 5), rtol, at, exact, [1.0])
    assert run.events[0].y_after == pytest.approx(0, abs=1e-15)


@pytest.mark.parametrize("rtol", RTOLS)
def test_skew_force(rtol):
    """A block on a plate, v(0) = (1, -2), force (0.3, 0.5): the closed form, and its stop."""
    times, states, stop = _plate()
    run = simulate(sliding(ball(2, 1), lambda *_: [0.3, 0.5], [0, 0], [1, -2], 3), rtol=rtol, method="event-driven", times=times)
    assert (np.abs(run.x - states) / np.abs(states).max(axis=0)).max() <= 10 * rtol
    assert abs(run.events[0].t - stop) <= 10 * rtol * 3
    assert len(run.arrays["piece_start"]) <= 60


def _plate():
    """Closed form in s with dt = |v| ds: of the angle phi of v to the force a, w = tan(phi/2) falls as exp(-|a| s).

    |v| = k exp(-s) (1 + w^2)/w, and t, v and x are sums of exponentials; the block stands at s = inf.
    """
    force, v0 = np.array([0.3, 0.5]), np.array([1.0, -2.0])
    a, speed = np.hypot(*force), np.hypot(*v0)
    along = force / a
    across = np.array([-along[1], along[0]]) * np.sign(along[0] * v0[1] - along[1] * v0[0])
    w = np.tan(np.arccos(along @ v0 / speed) / 2)
    k = speed * w / (1 + w**2)

    def passed(rate, s):
        return -np.expm1(-rate * s) / rate

    s = np.append(np.linspace(0, 8, 30), 1e3)
    times = k * (passed(1 - a, s) / w + w * passed(1 + a, s))
    x = k**2 * np.outer(passed(2 - 2 * a, s) / w**2 - w**2 * passed(2 + 2 * a, s), along)
    x += 2 * k**2 * np.outer(passed(2 - a, s) / w + w * passed(2 + a, s), across)
    v = k * np.outer(np.exp((a - 1) * s) / w - w * np.exp(-(1 + a) * s), along) + 2 * k * np.outer(np.exp(-s), across)
    stop = times[-1]
    times[-1] = 3
    return times, np.hstack([x, v]), stop


def test_a_near_miss_is_a_turn():
    """A block is pushed back past y = 0, a little beside it: it turns round, at any distance, and goes on."""
    at = np.linspace(0, 4, 81)
    force = np.array([-2.0, 0.0])
    for aside in (1e-1, 1e-3, 1e-6, 1e-9, 1e-12, 0.0):
        model = sliding(ball(2, 1), lambda *_: force, [0, 0], [3, aside], 4)
        run = simulate(model, rtol=1e-8, times=at, method="event-driven")
        reference, _ = Slides(lambda *_: force.copy(), [(np.arange(2), np.eye(2))]).run(np.zeros(2), np.array([3, aside]), at)
        assert np.abs(run.x[:, [0, 2]] - reference[:, [0, 2]]).max() <= 1e-7
        assert np.abs(run.x[:, [1, 3]] - reference[:, [1, 3]]).max() <= 1e-7 * max(aside, 1e-3)


def oscillator(theta, n, rtol, growth):
    """x'' + theta'(|v|) v/|v| + K x = 0, against the other integrator."""
    x, K = ca.SX.sym("x", n), np.diag([2.0, 6.0][:n])
    x0, v0 = np.array([3.0, 1.0][:n]), np.array([0.5, -1.0][:n])
    model = FrictionOscillator(x=x, potential=ca.bilin(ca.DM(K), x, x) / 2, friction=theta, s=s, x0=x0, v0=v0, t_end=6)
    at = np.linspace(0, 6, 121)
    reference, events = Slides(lambda _, x, v: -K @ x, [(np.arange(n), np.eye(n))], growth).run(x0, v0, at)
    return judged(model, rtol, at, reference, events)


@pytest.mark.parametrize("n", [1, 2])
def test_friction_that_grows(n):
    """theta = s, s + s^2/2, s + s^3/3, s + s^1.5: the last has no series at rest, and is left and entered in small steps."""
    for theta, growth in (
        (s, lambda v: 1.0), (s + s**2 / 2, lambda v: 1 + v), (s + s**3 / 3, lambda v: 1 + v**2),
        (s + s**1.5, lambda v: 1 + 1.5 * np.sqrt(v)),
    ):  # fmt: skip
        for rtol in (1e-3, 1e-7) if MANY >= 400 else (1e-5,):
            oscillator(theta, n, rtol, growth)


def test_elements_of_their_own():
    """Two elements, one in the plane and one on a line: their codes are those of time stepping."""
    x = ca.SX.sym("x", 3)
    friction = {"plate": ([[1, 0, 0], [0, 1, 0]], 0.4 * s + s**3 / 10), "rail": ([[0, 0, 1]], 0.3 * s)}
    model = FrictionOscillator(
        x=x, potential=(x[0] ** 2 + (x[1] - x[2]) ** 2 + x[2] ** 2 + 0.3 * x[0] * x[2]), friction=friction, s=s, x0=[1, -1, 0.5],
        v0=[0, 0.2, 0], t_end=5,
    )  # fmt: skip
    step = 5e-4 if MANY >= 400 else 2e-3
    way = True if MANY < 400 and compiler() else "auto"
    run, fine = simulate(model, rtol=1e-8, method="event-driven"), simulate(model, step=step, compiled=way)
    assert np.abs(run.at(fine.t[2:]).x - fine.x[2:]).max() <= 10 * step
    assert set(np.unique(run.index_set[1:, :2])) <= {0, 1}
    later = fine.t > 0.05
    number = np.clip(np.searchsorted(run.arrays["piece_start"], fine.t[later], side="right") - 1, 0, None)
    assert (run.arrays["piece_codes"][number] == fine.index_set[later]).mean() >= 0.98


def random_blocks(rng):
    """Blocks under balls and ellipsoids, coupled by springs and dampers, pushed by sines, from rest or not."""
    count = int(rng.integers(1, 4))
    n = 2 * count
    A, damper = rng.normal(size=(n, n)), 0.1 * rng.normal(size=(n, n))
    K = A @ A.T / n + 0.3 * np.eye(n)
    push, w, phase = 1.5 * rng.normal(size=n), rng.uniform(0.5, 2), rng.uniform(0, 6, n)
    blocks, laws = [], []
    for b in range(count):
        R = rng.normal(size=(2, 2))
        inverse = rng.uniform(0.3, 1.2) ** 2 * np.eye(2) if rng.random() < 0.5 else R @ R.T / 2 + 0.2 * np.eye(2)
        r = np.sqrt(inverse[0, 0])
        laws.append(ball(2, r) if not inverse[0, 1] else ellipsoid(np.linalg.inv(inverse)))
        blocks.append((np.arange(2 * b, 2 * b + 2), inverse))
    x0, v0 = rng.normal(size=n), rng.normal(size=n) * (rng.random() < 0.7)
    model = sliding(
        product(*laws), lambda t, x, v: -ca.DM(K) @ x - ca.DM(damper) @ v + ca.DM(push) * ca.sin(w * t + ca.DM(phase)), x0, v0, 5
    )
    return model, Slides(lambda t, x, v: -K @ x - damper @ v + push * np.sin(w * t + phase), blocks), x0, v0


@pytest.mark.parametrize("seed", range(max(3, MANY // 40)))
def test_random_blocks_against_another_integrator(seed):
    model, slides, x0, v0 = random_blocks(np.random.default_rng([17, seed]))
    at = np.linspace(0, 5, 101)
    reference, events = slides.run(x0, v0, at)
    for rtol in (1e-2, 1e-4, 1e-6, 1e-8):
        judged(model, rtol, at, reference, events)


@pytest.mark.parametrize("seed", range(max(4, MANY // 10)))
def test_random_models_against_small_steps(seed):
    """Every class with such a law: at another rtol to 10 rtol; small steps, of an order of 0.42 at least where blocks turn."""
    _, model = random_model(seed)
    fine, coarse = simulate(model, step=1e-2), simulate(model, step=2e-2)
    at = fine.t[2:]
    run, rough = (simulate(model, rtol=rtol, method="event-driven").at(at).x for rtol in (1e-8, 1e-4))
    assert (np.abs(rough - run) / np.abs(run).max(axis=0)).max() <= 10 * 1e-4
    off = np.abs(fine.x[2:] - run).max(axis=0)
    both = np.isin(np.round(fine.t, 9), np.round(coarse.t, 9))
    assert (off <= 10 * 1e-8 + 3 * np.abs(fine.x[both] - coarse.x).max(axis=0)).all()


def test_redundant_rows_beside_a_ball():
    """The same velocity under two balls: together they are one of twice the radius."""
    x, l = ca.SX.sym("x", 4), ca.SX.sym("l", 4)
    force = [0.9 * t * 0.6, 0.9 * t * 0.8]
    twice = FirstOrderSystem(
        t=t, x=x, lam=l, f=[x[2], x[3], *force], g=[0, 0, l[0] + l[2], l[1] + l[3]], h=[x[2], x[3], x[2], x[3]],
        law=product(ball(2, 0.5), ball(2, 0.5)), x0=[0, 0, 1, 0.5], t_end=5,
    )  # fmt: skip
    once = sliding(ball(2, 1), lambda t, *_: 0.9 * t * ca.DM([0.6, 0.8]), [0, 0], [1, 0.5], 5)
    at = np.linspace(0, 5, 51)
    two, one = (simulate(model, rtol=1e-8, times=at, method="event-driven") for model in (twice, once))
    np.testing.assert_allclose(two.x, one.x, atol=1e-6)


def test_blocks_that_stop_together():
    """y = 0 of one block is y = 0 of the other: v' = -(0.5 + 2 0.25) v/|v| is one ball of radius 1."""
    x, l = ca.SX.sym("x", 4), ca.SX.sym("l", 4)
    model = FirstOrderSystem(
        x=x, lam=l, f=[x[2], x[3], 0, 0], g=[0, 0, l[0] + 2 * l[2], l[1] + 2 * l[3]], h=[x[2], x[3], 2 * x[2], 2 * x[3]],
        law=product(ball(2, 0.5), ball(2, 0.25)), x0=[0, 0, 3, 4], t_end=8,
    )  # fmt: skip
    at = np.linspace(0, 8, 41)
    run = simulate(model, rtol=1e-8, times=at, method="event-driven")
    np.testing.assert_allclose(run.x, _straight(at, 5, -1, 0, [0.6, 0.8]), atol=1e-8)
    assert [event.after.tolist() for event in run.events] == [[0, 0, 0, 0]]


def test_a_ball_of_radius_0_is_no_force():
    at = np.linspace(0, 2, 21)
    run = simulate(sliding(ball(2, 0), lambda *_: [-1, 0], [0, 0], [1, 0], 2), rtol=1e-8, times=at, method="event-driven")
    np.testing.assert_allclose(run.x[:, 0], at - at**2 / 2, atol=1e-9)


def test_what_has_other_modes_is_refused_by_name():
    cone = sliding(second_order_cone(2), lambda *_: [0, 0], [0, 0], [3, 4], 1)
    with pytest.raises(UsageError, match=r"second-order cone.* other modes than stick and slip"):
        simulate(cone, rtol=1e-6, method="event-driven")
    direct = LureSystem(A=-np.eye(2), B=np.eye(2), C=np.eye(2), D=np.eye(2), law=ball(2), x0=[1, 1], t_end=1)
    with pytest.raises(UsageError, match="in the law 'ball': its y depends on l directly"):
        simulate(direct, rtol=1e-6, method="event-driven")
    plain = sliding(ball(2, 1), lambda *_: [0, 0], [0, 0], [3, 4], 6)
    with pytest.raises(UsageError, match="certify='interval' applies only to boxes"):
        simulate(plain, rtol=1e-6, certify="interval")
    x = ca.SX.sym("x", 2)
    turbulent = FrictionOscillator(x=x, potential=ca.sumsqr(x), friction=s**3 / 3, s=s, x0=[1, 0], v0=[0, 1], t_end=1)
    with pytest.raises(UsageError, match=r"theta'\(0\) = 0"):
        simulate(turbulent, rtol=1e-6, method="event-driven")
    assert "stick and slip are modes of ball" in explain(plain, rtol=1e-6)


@pytest.mark.parametrize("rtol", RTOLS)
def test_known_times(rtol):
    """A force that jumps at a known time: a block is pushed off; one stops then, a little before, and a little later."""
    e, at = np.array([0.6, 0.8]), np.linspace(0, 4, 41)
    step = ca.if_else(t >= 1.5, 1.5, 0.5)
    run = simulate(sliding(ball(2, 1), lambda *_: step * ca.DM(e), [0, 0], [0, 0], 4, [1.5]), rtol=rtol, times=at)
    np.testing.assert_allclose(run.x[:, :2], np.outer(np.maximum(at - 1.5, 0) ** 2 / 4, e), atol=1e-13)
    assert [event.t for event in run.events] == [1.5]
    for late in (0.0, -1e-12, 1e-12, -1e-5, 1e-5, -1e-3):
        force = ca.if_else(t >= 2 + late, -2, -0.5) * ca.DM(e)
        run = simulate(sliding(ball(2, 1), lambda *_, f=force: f, [0, 0], 3 * e, 4, [2 + late]), rtol=rtol, times=at)
        slow, rest = np.clip(at, 0, min(2, 2 + late)), np.maximum(at - 2 - late, 0)
        left = max(-1.5 * late, 0)
        way = 3 * slow - 0.75 * slow**2 + left**2 / 6 * (rest > left / 3) - np.maximum(rest - left / 3, 0) ** 2 / 2
        way += (left * rest - 1.5 * rest**2) * (rest <= left / 3)
        assert np.abs(run.x[:, :2] - np.outer(way, e)).max() <= 3 * rtol


def test_a_stretch_of_steps_beside_a_ball():
    """A mass meets a stop and rests there, which no mode goes on from: the block beside it slides and stops as it would alone."""
    x, l = ca.SX.sym("x", 6), ca.SX.sym("l", 3)
    model = FirstOrderSystem(
        t=t, x=x, lam=l, f=[x[2], x[3], 0, 0, x[5], -1], g=[0, 0, l[0], l[1], 0, l[2]], h=[x[2], x[3], x[4]],
        law=product(ball(2, 1), complementarity(1)), x0=[0, 0, 0.09, 0.12, 0.005, 0], t_end=0.2,
    )  # fmt: skip
    at = np.linspace(0, 0.2, 41)
    run = simulate(model, rtol=1e-2, times=at)
    assert run.is_event_driven
    assert run.stepped.any()
    np.testing.assert_allclose(run.x[:, :4], _straight(at, 0.15, -1, 0, [0.6, 0.8]), atol=3e-3)
    assert run.residual[1:].max() <= 1e-3


def test_steps_have_the_friction_that_grows():
    """What a stretch steps with, beside theta'(|v|) v/|v| for the l of slip."""
    x, rng = ca.SX.sym("x", 2), np.random.default_rng(3)
    model = FrictionOscillator(x=x, potential=ca.sumsqr(x) / 2, friction=0.3 * s + s**3 / 6, s=s, x0=[1, 0], v0=[0, 1], t_end=1)
    problem = event_driven_problem(model)
    rate = ca.Function("rate", [problem.x, problem.l], [problem.rate])
    for v in rng.normal(size=(5, 2)):
        size = np.hypot(*v)
        found = np.array(rate([0.5, 0.2, *v], -0.3 * v / size)).ravel()
        np.testing.assert_allclose(found, [*v, *(-np.array([0.5, 0.2]) - (0.3 + size**2 / 2) * v / size)], rtol=1e-14)


def test_pieces_are_interpreted_and_say_why():
    plain = sliding(ball(2, 1), lambda *_: [0, 0], [0, 0], [3, 4], 1)
    words = "while 'ball' slips, its l is a series of y, which only interpreted pieces have"
    asked = simulate(plain, rtol=1e-6, compiled=True)
    assert any(words in warning for warning in asked.metadata["warnings"])
    assert not any(words in warning for warning in simulate(plain, rtol=1e-6).metadata["warnings"])
    assert words in explain(plain, rtol=1e-6)
    x = ca.SX.sym("x", 2)
    grows = FrictionOscillator(x=x, potential=ca.sumsqr(x), friction=s + s**3, s=s, x0=[1, 0], v0=[0, 1], t_end=1)
    with pytest.raises(CodegenError, match="while 'ball' slips, its l is a series of y"):
        piece_spec_of(grows, {})


def test_resumed_byte_for_byte(tmp_path):
    """To a later end, from stops, slips and releases, in a model whose friction grows too."""
    model, *_ = random_blocks(np.random.default_rng(5))
    x = ca.SX.sym("x", 2)
    grows = FrictionOscillator(
        x=x, potential=ca.sumsqr(x) + x[0] * x[1], friction=0.3 * s + s**3 / 9, s=s, x0=[2, 1], v0=[0, 1], t_end=5
    )
    for number, one in enumerate((model, grows)):
        whole = simulate(one, rtol=1e-6, method="event-driven")
        folder = tmp_path / str(number)
        for end in (1.3, 2.9, 5.0):
            run = simulate(one, rtol=1e-6, method="event-driven", t_end=end, out=folder, resume=end > 1.3)
        for name, column in whole.arrays.items():
            np.testing.assert_array_equal(run.arrays[name], column, err_msg=name)


def test_pictures():
    run = simulate(sliding(ball(2, 1), lambda *_: [0.3, 0.5], [0, 0], [1, -2], 3), rtol=1e-6)
    assert run.is_event_driven
    plot.index_strip(run)
    plot.multipliers(run)
