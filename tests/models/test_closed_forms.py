"""The closed forms themselves, against inclusion residuals, event-driven integration and known numbers."""

from __future__ import annotations

import closed_forms as exact
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import nnls

TIGHT = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}


def derivative(function, t, d=1e-4):
    """Return the fourth-order central difference of ``function`` at the times t."""
    return (8 * (function(t + d) - function(t - d)) - function(t + 2 * d) + function(t - 2 * d)) / (12 * d)


def times_away_from(kinks, t_end, count=200, seed=0):
    """Return random times in (0, t_end), at least 1e-3 from each kink and from the ends."""
    t = np.random.default_rng(seed).uniform(1e-3, t_end - 1e-3, 2 * count)
    return t[np.abs(t[:, None] - np.reshape(kinks, (1, -1))).min(axis=1) > 1e-3][:count]


# ---------------------------------------------------------------------------------------------- sweeping processes

UNIT = np.eye(2)
TOUCH, LEAVE = 0.5460607985830543, 2.419881041110468


def _disc(q, centre):
    d = q - centre
    return np.linalg.norm(d) - 1, d / np.linalg.norm(d)


def _pair(q):
    d = q[2:] - q[:2]
    e = d / np.linalg.norm(d)
    return np.linalg.norm(d) - 0.6, np.concatenate([-e, e])


# name: closed form, its multiplier, f(t, q), (g, grad g)(t, q), d_t g(t, q), q0, t_end, kinks
SWEEPING = {
    "P1": (
        exact.half_plane,
        exact.half_plane_multiplier,
        lambda t, q: UNIT[1],
        lambda t, q: (q[0] - np.sin(2 * t), UNIT[0]),
        lambda t, q: -2 * np.cos(2 * t),
        [0, 0],
        2.0,
        [np.pi / 4],
    ),
    "P2": (
        exact.half_line,
        exact.half_line_multiplier,
        lambda t, q: -q,
        lambda t, q: (q[0] - np.sin(t), np.ones(1)),
        lambda t, q: -np.cos(t),
        [0],
        3.0,
        [3 * np.pi / 4],
    ),
    "P3": (
        exact.point_past_disc,
        exact.point_past_disc_multiplier,
        lambda t, q: UNIT[0],
        lambda t, q: _disc(q, np.zeros(2)),
        lambda t, q: 0.0,
        [-1.5, 0.3],
        4.5,
        [TOUCH, LEAVE],
    ),
    "P4": (
        exact.moving_disc,
        exact.moving_disc_multiplier,
        lambda t, q: np.zeros(2),
        lambda t, q: _disc(q, np.array([t, 0])),
        lambda t, q: -(q[0] - t) / np.hypot(q[0] - t, q[1]),
        [1.5, 0.3],
        4.0,
        [TOUCH, LEAVE],
    ),
    "P5": (
        exact.two_discs,
        exact.two_discs_multiplier,
        lambda t, q: np.array([1, 0, -0.4, 0]),
        lambda t, q: _pair(q),
        lambda t, q: 0.0,
        [-1, 0, 1, 0],
        2.5,
        [1.0],
    ),
}


@pytest.mark.parametrize("name", SWEEPING)
def test_sweeping_closed_forms_solve_the_inclusion(name):
    q, multiplier, f, constraint, _, q0, t_end, kinks = SWEEPING[name]
    np.testing.assert_allclose(q(np.zeros(1))[0], q0, atol=1e-15)
    times = times_away_from(kinks, t_end)
    velocity, places = derivative(q, times), q(times)
    for t, v, place, reaction in zip(times, velocity, places, multiplier(times), strict=True):
        g, gradient = constraint(t, place)
        assert g >= -1e-15
        active = gradient[:, None] if g < 1e-12 else np.zeros((len(place), 1))
        assert nnls(active, v - f(t, place))[1] < 1e-9
        np.testing.assert_allclose(v - f(t, place), reaction * gradient, atol=1e-9)


@pytest.mark.parametrize("name", SWEEPING)
def test_sweeping_closed_forms_agree_with_event_driven_integration(name):
    """Free motion until g = 0, motion on the surface until the reaction vanishes, and so on."""
    q, _, f, constraint, g_t, q0, t_end, kinks = SWEEPING[name]

    def reaction(t, x):
        _, gradient = constraint(t, x)
        return -(g_t(t, x) + gradient @ f(t, x)) / (gradient @ gradient)

    def event(function):
        function.terminal, function.direction = True, -1
        return function

    modes = {
        "free": (f, event(lambda t, x: constraint(t, x)[0])),
        "contact": (lambda t, x: f(t, x) + reaction(t, x) * constraint(t, x)[1], event(reaction)),
    }
    time, state = 0.0, np.array(q0, float)
    mode, switches = ("contact" if constraint(0, state)[0] == 0 else "free"), []
    while time < t_end:
        rhs, ends = modes[mode]
        run = solve_ivp(rhs, (time, t_end), state, events=ends, dense_output=True, max_step=0.1, **TIGHT)
        inside = np.linspace(time, run.t[-1], 20)
        np.testing.assert_allclose(run.sol(inside).T, q(inside), atol=1e-9)
        time, state, mode = run.t[-1], run.y[:, -1], "contact" if mode == "free" else "free"
        switches += [time] if time < t_end else []
    np.testing.assert_allclose(switches, kinks, atol=1e-8)


def test_disc_times_and_symmetric_start():
    touch, leave, _ = exact._past_disc(np.zeros(1), 1.0, 1.0, -1.5, 0.3)
    assert touch == pytest.approx(TOUCH, abs=1e-15)
    assert leave == pytest.approx(LEAVE, abs=1e-14)
    np.testing.assert_allclose(exact.moving_disc([4.0])[0], [LEAVE, 1.0])


# ---------------------------------------------------------------------------------------------- dry friction


def integrate_friction(times, x0, v0, w, a, zeta=0.0, force=lambda t: 0.0, stick_end=None):
    """Event-driven integration of x'' + 2 zeta w x' + w^2 x + a Sgn(x') ∋ force(t), independent of the formulas."""
    out, time, x, v = np.empty((len(times), 2)), 0.0, x0, v0
    t_end = times[-1] + 1e-9
    while time < t_end:
        drive = force(time) - w**2 * x
        if abs(v) < 1e-9 and abs(drive) <= a * (1 + 1e-9):

            def leaves(t, _, x=x):
                return abs(force(t) - w**2 * x) - a

            leaves.terminal, leaves.direction = True, 1
            run = solve_ivp(lambda t, _: [0.0], (time, t_end), [0.0], events=leaves, max_step=0.01)
            on = times >= time
            out[on] = (x, 0.0)
            time, v = run.t[-1], 0.0
            if time >= t_end:
                break
            drive = force(time) - w**2 * x
        sign = np.sign(v) if abs(v) > 1e-9 else np.sign(drive)

        def rhs(t, y, sign=sign):
            return [y[1], force(t) - w**2 * y[0] - 2 * zeta * w * y[1] - a * sign]

        def rests(t, y, sign=sign, start=time):
            return sign * y[1] if t > start + 1e-6 else 1.0

        rests.terminal, rests.direction = True, -1
        run = solve_ivp(rhs, (time, t_end), [x, v], events=rests, dense_output=True, max_step=0.2, **TIGHT)
        on = (times >= time) & (times <= run.t[-1])
        out[on] = run.sol(times[on]).T
        time, (x, v) = run.t[-1], run.y[:, -1]
        v = 0.0 if run.t_events[0].size else v
    return out


@pytest.mark.parametrize("seed", range(8))
def test_free_friction_agrees_with_event_driven_integration(seed):
    rng = np.random.default_rng(seed)
    x0, v0, w, a = rng.uniform(-8, 8), rng.uniform(-5, 5) * (seed % 3 > 0), rng.uniform(0.5, 3), rng.uniform(0.3, 2)
    zeta = [0.0, 0.05, 0.3, 0.9][seed % 4]
    times = np.linspace(0, 12, 241)
    expected = integrate_friction(times, x0, v0, w, a, zeta)
    np.testing.assert_allclose(exact.friction_free(times, x0, v0, w, a, zeta), expected, atol=1e-8)


@pytest.mark.parametrize("seed", range(20))
def test_free_friction_solves_the_inclusion(seed):
    rng = np.random.default_rng(seed)
    x0, v0, w, a, zeta = rng.uniform([-8, -5, 0.5, 0.3, 0], [8, 5, 3, 2, 0.95])
    phases, (stop, rest) = exact._friction_phases(x0, v0, w, a, zeta)
    t = times_away_from([phase[0] for phase in phases] + [stop], stop + 1, seed=seed)
    x, v = exact.friction_free(t, x0, v0, w, a, zeta).T
    x_dot, v_dot = derivative(lambda u: exact.friction_free(u, x0, v0, w, a, zeta), t).T
    np.testing.assert_allclose(x_dot, v, atol=1e-8)
    moving = t < stop
    residual = v_dot + 2 * zeta * w * v + w**2 * x + a * np.sign(v)
    np.testing.assert_allclose(residual[moving], 0, atol=1e-7)
    assert np.all(v[~moving] == 0)
    assert abs(w**2 * rest) <= a
    assert (stop, rest) == exact.friction_stop(x0, v0, w, a, zeta)


def test_stop_of_the_case():
    stop, rest = exact.friction_stop(5.3)
    assert stop == pytest.approx(3 * np.pi, abs=1e-14)
    assert rest == pytest.approx(0.7, abs=1e-14)


def test_stop_formula_agrees_with_the_phases():
    rng = np.random.default_rng(0)
    for x0, w, a in rng.uniform([-20, 0.3, 0.2], [20, 3, 3], (500, 3)):
        np.testing.assert_allclose(exact.friction_stop_formula(x0, w, a), exact.friction_stop(x0, 0.0, w, a), atol=1e-9)


def test_tie_changes_the_time_and_not_the_state():
    times = np.linspace(0, 12, 500)
    runs = [exact.friction_free(times, 5 + d) for d in (-1e-9, 1e-9)]
    np.testing.assert_allclose(*runs, atol=1e-8)
    stops = [exact.friction_stop(5 + d)[0] for d in (-1e-9, 1e-9)]
    np.testing.assert_allclose(stops, [2 * np.pi, 3 * np.pi])


@pytest.mark.parametrize(
    ("x0", "v0", "w", "a", "F", "W"),
    [
        (0, 0, 1, 1, 2, 0.7),
        (0, 0, 1, 1, 0.9, 0.7),
        (3, -1, 2, 1, 2.5, 1.3),
        (-1, 2, 1.5, 2, 2.4, 0.4),
        (5, 0, 1, 1, 1.3, 1.7),
    ],
)
def test_forced_friction_agrees_with_event_driven_integration(x0, v0, w, a, F, W):
    times = np.linspace(0, 15, 301)
    expected = integrate_friction(times, float(x0), float(v0), w, a, force=lambda t: F * np.cos(W * t))
    np.testing.assert_allclose(exact.friction_forced(times, x0, v0, w, a, F, W), expected, atol=1e-7)


# ---------------------------------------------------------------------------------------------- relays


def test_sliding_relay_solves_the_inclusion():
    reach = exact.sliding_relay_reach()
    t = times_away_from([reach], 5.0)
    x, slope, relay = exact.sliding_relay(t), derivative(exact.sliding_relay, t), exact.sliding_relay_multiplier(t)
    np.testing.assert_allclose(slope[:, 0], x[:, 1], atol=1e-9)
    np.testing.assert_allclose(slope[:, 1], 2 * relay + np.sin(t), atol=1e-9)
    line = x.sum(axis=1)
    assert np.all(line[t < reach] > 0)
    np.testing.assert_allclose(line[t > reach], 0, atol=1e-15)
    assert np.all(np.abs(relay[t > reach]) < 1)
    np.testing.assert_array_equal(exact.sliding_relay([0.0]), [[1, 0]])


def test_sliding_relay_reaches_the_line_when_integration_does():
    def line(t, x):
        return x[0] + x[1]

    line.terminal = True
    run = solve_ivp(lambda t, x: [x[1], -2 + np.sin(t)], (0, 5), [1, 0], events=line, **TIGHT)
    assert run.t[-1] == pytest.approx(exact.sliding_relay_reach(), abs=1e-10)
    np.testing.assert_allclose(exact.sliding_relay(run.t[-1:])[0], run.y[:, -1], atol=1e-10)


def test_zhuravlev_ivanov_agrees_with_integration_of_the_transformed_system():
    """Its right side is discontinuous on x_1 = 0 and x_2 = 0 and crosses both: integrate from crossing to crossing."""
    kappa, G = 0.5, 9.81
    time, x, signs, crossings = 0.0, np.array([1.0, 10.0]), np.array([1.0, 1.0]), 0
    while crossings < 12:
        s, w = signs

        def rhs(t, x, s=s, w=w):
            return [x[1] * (1 - kappa * s * w), -G * s / (1 - kappa * s * w)]

        def crosses_1(t, x, s=s):
            return s * x[0]

        def crosses_2(t, x, w=w):
            return w * x[1]

        for event in (crosses_1, crosses_2):
            event.terminal, event.direction = True, -1
        run = solve_ivp(rhs, (time, time + 5), x, events=(crosses_1, crosses_2), dense_output=True, **TIGHT)
        inside = np.linspace(time, run.t[-1], 12)[1:-1]
        np.testing.assert_allclose(run.sol(inside).T, exact.zhuravlev_ivanov(inside), atol=1e-8)
        which = 0 if run.t_events[0].size else 1
        time, x, crossings = run.t[-1], run.y[:, -1], crossings + 1
        x[which] = 0.0
        signs[which] *= -1
    assert time < exact.ball_rest()[2]
    np.testing.assert_array_equal(exact.zhuravlev_ivanov([2.0, 10.0]), 0)


def test_ball_falls_under_gravity_and_bounces_with_a_third_of_its_speed():
    first, impact, rest = exact.ball_rest()
    t = times_away_from([first, first + 2 * impact / 3 / 9.81], first + 0.5)
    height, velocity, _ = exact.bouncing_ball(t).T
    np.testing.assert_allclose(np.abs(exact.zhuravlev_ivanov(t)[:, 0]), height)
    np.testing.assert_allclose(derivative(lambda u: exact.bouncing_ball(u)[:, 0], t), velocity, atol=1e-9)
    before, after = exact.bouncing_ball(np.array([first - 1e-12, first + 1e-12]))[:, 1]
    assert after / before == pytest.approx(-1 / 3)
    assert rest == pytest.approx(first + impact / 9.81)
    assert rest == pytest.approx(1.87152, abs=1e-5)


# ---------------------------------------------------------------------------------------------- monotone inclusions


@pytest.mark.parametrize("b", [-1.0, 0.0, 1.5])
@pytest.mark.parametrize("a", [0.0, 1.0])
@pytest.mark.parametrize("x0", [0.0, 2.0])
def test_inclusion_8_1_follows_the_projected_field(a, b, x0):
    zero = np.log1p(-(1 + a) * x0 / b) / (1 + a) if b < 0 else 0.0
    t = times_away_from([zero], 5.0)
    x = exact.inclusion_8_1(t, a, b, x0)[:, 0]
    drive = b - (1 + a) * x
    expected = np.where(x > 0, drive, np.maximum(drive, 0))
    np.testing.assert_allclose(derivative(lambda u: exact.inclusion_8_1(u, a, b, x0)[:, 0], t), expected, atol=1e-9)
    assert exact.inclusion_8_1([0.0], a, b, x0)[0, 0] == x0
    assert exact.inclusion_8_1([60.0], a, b, x0)[0, 0] == pytest.approx(max(b, 0) / (1 + a), abs=1e-15)


def random_inclusion(seed, n, diagonal):
    rng = np.random.default_rng(seed)
    root = np.diag(rng.uniform(0.7, 1.6, n)) if diagonal else rng.normal(size=(n, n)) + np.eye(n)
    K = root @ root.T + 0.2 * (0 if diagonal else 1) * np.eye(n)
    lower, upper = -rng.uniform(0.3, 2, n), rng.uniform(0.3, 2, n)
    return K, rng.uniform(-4, 4, n), rng.uniform(0, 2, n), lower, upper, rng.uniform(lower, upper)


@pytest.mark.parametrize("seed", range(10))
def test_diagonal_8_2_agrees_with_the_reference_integrator(seed):
    K, b, mu, lower, upper, x0 = random_inclusion(seed, 4, diagonal=True)
    t = np.linspace(0, 8, 400)
    found = exact.inclusion_8_2_diagonal(t, np.diag(K), b, mu, lower, upper, x0)
    np.testing.assert_allclose(found, exact.inclusion_8_2_reference(t, K, b, mu, lower, upper, x0), atol=1e-12)
    np.testing.assert_allclose(found[0], x0, atol=1e-15)


def test_diagonal_8_2_starts_at_zero_and_with_zero_goal():
    t = np.linspace(0, 5, 50)
    rest = exact.inclusion_8_2_diagonal(t, [1, 1, 2], [0.5, 3, 1], 1, -2, 2, [0, 0, 1])
    expected = np.column_stack([0 * t, np.minimum(2 - 2 * np.exp(-t), 2), np.exp(-2 * t)])
    np.testing.assert_allclose(rest, expected, atol=1e-15)


@pytest.mark.parametrize("seed", range(10))
def test_full_8_2_reference_solves_the_inclusion_and_ends_at_the_equilibrium(seed):
    K, b, mu, lower, upper, x0 = random_inclusion(seed, 3, diagonal=False)
    t = np.random.default_rng(seed).uniform(1e-3, 6, 300)
    x = exact.inclusion_8_2_reference(t, K, b, mu, lower, upper, x0)
    slope = derivative(lambda u: exact.inclusion_8_2_reference(u, K, b, mu, lower, upper, x0), t)
    field = np.array([exact.inclusion_8_2_velocity(row, K, b, mu, lower, upper) for row in x])
    defect = np.abs(slope - field).max(axis=1)
    assert np.count_nonzero(defect > 1e-7) <= 4  # differences across an event
    rest = exact.inclusion_8_2_equilibrium(K, b, mu, lower, upper)
    late = exact.inclusion_8_2_reference([0.0, 120.0], K, b, mu, lower, upper, x0)
    np.testing.assert_allclose(late, [x0, rest], atol=1e-9)


def test_the_implicit_scheme_converges_to_the_full_8_2_reference():
    """Proximal Euler steps, solved by coordinate descent: their distance to the reference halves with the step."""
    K = np.array([[2.0, -1.0, -0.5], [-1.0, 2.0, -1.0], [-0.5, -1.0, 2.0]])
    b, mu, lower, upper, x0 = np.array([4.0, -0.3, 0.5]), np.array([0.5, 1, 0.5]), -1.0, 1.5, np.array([-1, 0.5, -0.5])

    def implicit(h, t_end=1.2):
        x = x0.copy()
        for _ in range(round(t_end / h)):
            old = x.copy()
            for _ in range(8):
                for i in range(3):
                    free = old[i] + h * (b[i] - K[i] @ x + K[i, i] * x[i])
                    x[i] = np.clip(np.sign(free) * max(abs(free) - h * mu[i], 0) / (1 + h * K[i, i]), lower, upper)
        return x

    expected = exact.inclusion_8_2_reference([1.2], K, b, mu, lower, upper, x0)[0]
    np.testing.assert_allclose(exact.inclusion_8_2_equilibrium(K, b, mu, lower, upper), [1.5, 23 / 60, 17 / 30])
    steps = np.array([8e-3, 4e-3, 2e-3, 1e-3])
    errors = np.array([np.abs(implicit(h) - expected).max() for h in steps])
    assert abs(np.polyfit(np.log(steps), np.log(errors), 1)[0] - 1) <= 0.15
    assert errors[-1] <= 1e-3
