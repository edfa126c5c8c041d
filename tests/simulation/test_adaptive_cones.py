"""Steps under error control on second-order cones: closed forms, a judge that integrates the projected field, long runs, C."""

import casadi as ca
import numpy as np
import pytest
from closed_forms import turning_on_a_cone
from fuzz_models import some
from scipy.integrate import solve_ivp

from nsmodel import FirstOrderSystem, LureSystem, StepError, second_order_cone, simulate

T, X, L = ca.SX.sym("t"), ca.SX.sym("x", 3), ca.SX.sym("l", 3)
DRIFT = 0.2


def turning(t_end, push=0.3):
    """X turns about the axis of the cone and is pushed through its surface, out and in: see ``turning_on_a_cone``."""
    p, e = push * (ca.cos(T) + DRIFT), X[1:] / ca.norm_2(X[1:])
    f = ca.vertcat(-p, p * e[0] - X[2], p * e[1] + X[1])
    return FirstOrderSystem(t=T, x=X, lam=L, f=f, g=L, h=X, law=second_order_cone(3), x0=[1, 1, 0], t_end=t_end)


def run_of(model, rtol, compiled=True):
    return simulate(model, rtol=rtol, method="time-stepping", compiled=compiled)


def control(run):
    return run.summary()["error_control"]


def gap(y):
    """How far y (N, m) is inside the cone."""
    return y[:, 0] - np.linalg.norm(y[:, 1:], axis=1)


@pytest.mark.long
@pytest.mark.c
def test_the_tolerance_is_met_on_a_cone_with_steps_of_second_order():
    steps = []
    for rtol in (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8):
        run = run_of(turning(10), rtol)
        assert np.abs(run.x - turning_on_a_cone(run.t, 0.3, DRIFT)).max() <= 2 * rtol
        assert run.residual[1:].max() <= 1e-9
        assert control(run)["at_least_step"] == 0
        assert control(run)["extrapolated"] >= 0.97 * control(run)["accepted"]
        steps.append(control(run)["accepted"])
    assert 5 <= steps[2] / steps[0] <= 14
    assert 5 <= steps[4] / steps[2] <= 14


@pytest.mark.c
@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize(("push", "rtol", "t_end"), [(0.1, 1e-2, 40), (0.15, 1e-2, 40), (0.3, 1e-3, 20)])
@pytest.mark.long
def test_extrapolation_goes_through_no_surface_of_a_cone(push, rtol, t_end, compiled):
    """The push is at most push (1 + DRIFT), and so is l; in contact x leaves the cone by the curvature of its surface alone."""
    run = run_of(turning(t_end, push), rtol, compiled)
    assert run.multipliers[1:].max() <= push * (1 + DRIFT)
    assert gap(run.x).min() >= -(rtol**2)


@pytest.mark.c
@pytest.mark.long
def test_a_long_run_on_a_cone_ends():
    run = run_of(turning(2000), 1e-4)
    error = np.abs(run.x - turning_on_a_cone(run.t, 0.3, DRIFT)).max()
    assert error <= 1e-4 * control(run)["estimate"]
    assert control(run)["at_least_step"] == 0
    assert run.multipliers[1:].max() <= 0.3 * (1 + DRIFT)


def scene(seed):
    """(model, judge): x' = A x + f + P C'l, y = C x, l and y in the cone of R^m; P symmetric and definite."""
    r = np.random.default_rng(seed)
    n = int(r.integers(2, 5))
    m = int(r.integers(2, n + 1))
    C, A, root = r.normal(size=(m, n)), r.normal(size=(n, n)), r.normal(size=(n, n)) * (seed % 2)
    A -= (np.linalg.eigvalsh(A + A.T).max() / 2 + 0.3) * np.eye(n)
    B = (root @ root.T + np.eye(n)) @ C.T
    a, w, up = r.uniform(0.5, 2, n), r.uniform(0.5, 3, n), np.linalg.pinv(C)[:, 0]
    f = ca.DM(a) * ca.sin(ca.DM(w) * T + ca.DM(range(n))) + ca.DM(up)
    model = LureSystem(t=T, A=A, B=B, C=C, f=f, law=second_order_cone(m), x0=up, t_end=2)
    return model, lambda t: judge(lambda t, x: A @ x + a * np.sin(w * t + np.arange(n)) + up, B, C, up, t)


def judge(field, B, C, x0, t):
    """X (N, n) by DOP853, phase by phase: free, or held on the surface by l = s (1, -e) while s >= 0; far from the apex."""

    def normal(x):
        y = C @ x
        return np.r_[-1.0, y[1:] / np.linalg.norm(y[1:])]

    def push(t, x):
        n = normal(x)
        return n @ C @ field(t, x) / (n @ C @ B @ n)

    def held(t, x):
        return field(t, x) - B @ normal(x) * push(t, x)

    def distance(_, x):
        return (C @ x)[0] - np.linalg.norm((C @ x)[1:])

    distance.terminal, distance.direction = True, -1
    push.terminal, push.direction = True, -1
    now, x, on, out = t[0], np.array(x0), False, [x0]
    while now < t[-1]:
        rest = t[t > now]
        found = solve_ivp(
            held if on else field, (now, t[-1]), x, method="DOP853", rtol=1e-11, atol=1e-13, events=push if on else distance,
            t_eval=rest,
        )  # fmt: skip
        out += list(found.y.T)
        if found.status == 0:
            break
        now, x, on = float(found.t_events[0][0]), found.y_events[0][0], not on
    assert (np.array(out) @ C.T)[:, 0].min() > 0.05
    return np.array(out)


@pytest.mark.c
@pytest.mark.parametrize(("seed", "rtol"), [*((s, 1e-6) for s in some(range(22))), (0, 1e-8), (5, 1e-8), (9, 1e-8), (10, 1e-4)])
def test_random_scenes_agree_with_the_projected_field(seed, rtol):
    model, reference = scene(seed)
    run = run_of(model, rtol)
    exact = reference(run.t)
    assert np.abs(run.x - exact).max() <= 2 * rtol * np.abs(exact).max()
    assert run.residual[1:].max() <= 1e-9


@pytest.mark.c
@pytest.mark.parametrize("model", [turning(10), scene(5)[0], scene(9)[0]])
def test_a_run_on_a_cone_in_c_is_the_same_run(model):
    plain, compiled = (run_of(model, 1e-3, how) for how in (False, True))
    np.testing.assert_array_equal(plain.t, compiled.t)
    np.testing.assert_array_equal(plain.index_set, compiled.index_set)
    np.testing.assert_allclose(plain.x, compiled.x, rtol=1e-11, atol=1e-12)


# -- positions that slide along a cone: l acts on accelerations alone ----------------------------------------------------------


def in_a_ball(start, speed, force, t_end=1, units=1.0):
    """A point of mass 1 in the unit ball of R^n, (1, q) in a cone; its velocities in ``units``, each with a name of its own."""
    n = len(start)
    q, v, l, units = ca.SX.sym("q", n), [ca.SX.sym(f"v{i}") for i in range(n)], ca.SX.sym("l", n + 1), np.resize(units, n)
    moved = [vi * u for vi, u in zip(v, units, strict=True)]
    return FirstOrderSystem(
        x=ca.vertcat(q, *v), lam=l, f=[*moved, *(np.array(force) / units)], h=ca.vertcat(1, q), law=second_order_cone(n + 1),
        g=[*[0] * n, *(l[i + 1] / units[i] for i in range(n))], x0=[*start, *(np.array(speed) / units)], t_end=t_end,
    )  # fmt: skip


def on_a_sphere(start, speed, force):
    """(N, 2 n) by DOP853: q'' = a - (a.q + |v|^2) q, which keeps |q| = 1 while the reaction a.q + |v|^2 is not negative."""
    n = len(start)

    def rate(_, s):
        q, v = s[:n], s[n:]
        return np.r_[v, force - (force @ q + v @ v) * q]

    force = np.array(force)
    sol = solve_ivp(rate, (0, 1), [*start, *speed], method="DOP853", rtol=1e-12, atol=1e-13, dense_output=True).sol
    q, v = np.split(sol(np.linspace(0, 1, 1001)), 2)
    assert (force @ q + (v * v).sum(axis=0)).min() > 0.01
    return lambda t: sol(t).T


DOWN, DEEP = (0.0, -9.81), (0.0, 0.0, -9.81)
SLIDES = [
    ((0, -1), (0.5, 0), DOWN),
    ((0, -1), (-3, 0), DOWN),
    ((0, -1), (1, 0), (0.0, 0.0)),
    ((np.sin(0.3), -np.cos(0.3)), (2 * np.cos(0.3), 2 * np.sin(0.3)), DOWN),
    ((0, 0, -1), (1, 0, 0), DEEP),
    ((0, 0.6, -0.8), (1, 0, 0), DEEP),
    ((0, 0.6, -0.8), (1, -0.4, -0.3), DEEP),
]


@pytest.mark.c
@pytest.mark.parametrize("rtol", [1e-2, 1e-3, 1e-4])
@pytest.mark.parametrize(("start", "speed", "force"), SLIDES)
def test_what_starts_along_a_surface_slides(start, speed, force, rtol):
    """Velocities that begin at 0 are off by all that they are, in however short a first step: that was refused as an impact."""
    run = run_of(in_a_ball(start, speed, force), rtol)
    exact = on_a_sphere(start, speed, force)(run.t)
    assert (np.abs(run.x - exact) <= 10 * rtol * np.abs(exact).max(axis=0) + 1e-15).all()
    assert control(run)["at_least_step"] == 0
    assert not run.metadata["warnings"]


@pytest.mark.c
@pytest.mark.parametrize("rtol", [1e-2, 1e-3])
@pytest.mark.parametrize("speed", [1.0, -4.0])
def test_a_free_point_on_a_cone_follows_a_straight_line_of_its_development(speed, rtol):
    """|(q_2, q_3)| <= q_1, no force: in the plane a cone of 45 degrees is a sector, of angle 2 pi / sqrt(2)."""
    q, v, l = ca.SX.sym("q", 3), ca.SX.sym("v", 3), ca.SX.sym("l", 3)
    model = FirstOrderSystem(
        x=ca.vertcat(q, v), lam=l, f=ca.vertcat(v, 0, 0, 0), g=ca.vertcat(0, 0, 0, l), h=q, law=second_order_cone(3),
        x0=[1, 1, 0, 0, 0, speed], t_end=1,
    )  # fmt: skip
    run = run_of(model, rtol)
    way = speed * run.t
    radius, angle = np.sqrt(1 + way**2 / 2), np.sqrt(2) * np.arctan(way / np.sqrt(2))
    exact = np.column_stack([radius, radius * np.cos(angle), radius * np.sin(angle)])
    assert (np.abs(run.x[:, :3] - exact) <= 10 * rtol * np.abs(exact).max(axis=0)).all()
    assert (np.abs(np.linalg.norm(run.x[:, 3:], axis=1) - abs(speed)) <= 10 * rtol * abs(speed)).all()
    assert control(run)["at_least_step"] == 0


@pytest.mark.c
def test_units_of_velocities_behind_a_cone_say_nothing():
    units = np.array([2.0**9, 2.0**-7, 2.0**4])
    plain, other = (run_of(in_a_ball((0, 0, -1), (1, 0, 0), DEEP, 0.2, of), 1e-3) for of in (1.0, units))
    assert np.allclose(plain.t, other.t, rtol=1e-12, atol=0)
    assert np.allclose(plain.x[:, 3:], other.x[:, 3:] * units, rtol=1e-9, atol=1e-12)


@pytest.mark.c
def test_a_slide_in_c_is_the_same_slide():
    """To what a step is verified to: velocities are the positions' differences over half a step."""
    plain, compiled = (run_of(in_a_ball((0, -1), (0.5, 0), DOWN, 0.02), 1e-2, how) for how in (False, True))
    np.testing.assert_array_equal(plain.t, compiled.t)
    assert np.abs(plain.x - compiled.x).max() <= plain.metadata["tolerance"]


@pytest.mark.c
@pytest.mark.long
def test_what_starts_inward_is_right_to_its_impact_which_stops_the_run():
    """A chord of the circle: |q + v t| = 1 at t = 2 inward / (1 + inward^2)."""
    inward = 0.2
    with pytest.raises(StepError, match="must jump, an impact") as stop:
        run_of(in_a_ball((0, -1), (1, inward), (0, 0)), 1e-4)
    run = stop.value.trajectory
    assert run.t[-1] == pytest.approx(2 * inward / (1 + inward**2), abs=1e-4)
    chord = np.column_stack([run.t, inward * run.t - 1, 1 + 0 * run.t, inward + 0 * run.t])
    assert np.abs(run.x - chord).max() <= 1e-4


@pytest.mark.parametrize("options", [{"rtol": 1e-3}, {"step": 1e-3}])
@pytest.mark.parametrize(("outward", "told"), [(0.2, True), (1e-6, True), (0.0, False), (1e-12, False)])
def test_a_start_along_a_surface_is_told_as_an_impact_beyond_rounding_alone(outward, told, options):
    """What points outwards at the start is taken away at once, as of walls; of others rounding leaves 1e-17 of the speed."""
    for angle in (-0.9, 0.3):
        q, e = np.array([np.sin(angle), -np.cos(angle)]), np.array([np.cos(angle), np.sin(angle)])
        run = simulate(in_a_ball(q, 2 * e + outward * q, DOWN, 0.02), compiled=False, **options)
        assert any("an impact" in text for text in run.metadata["warnings"]) == told
        assert np.abs(run.x[-1] - on_a_sphere(q, 2 * e, DOWN)(run.t[-1:])[0]).max() <= 2e-2


@pytest.mark.long
@pytest.mark.c
def test_what_a_cone_cannot_hold_as_exactly_ends_by_name():
    """Steps do not let more pass after a time: velocities behind a cone were any then."""
    with pytest.raises(StepError, match="ask for less accuracy"):
        simulate(in_a_ball((np.sin(0.5), -np.cos(0.5)), (0, 0), DOWN, 10), rtol=1e-5, compiled=True)
