"""Cases of friction, hysteresis and moving sets beside closed forms and theorems, and beside what a wrong answer would be."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

from nsmodel import simulate

RTOL = 1e-8
EVENTS = {"rtol": RTOL, "method": "event-driven"}


def off(found, right):
    """The worst error of each state, as a part of its largest value; 1 for one that is 0."""
    return (np.abs(found - right).max(axis=0) / (np.abs(right).max(axis=0) + (right == 0).all(axis=0))).max()


STEPS = {"belt": 1e-4, "elastoplastic": 1e-12, "leash": 3e-3, "sandpile": 1e-12, "tumbler": 1e-2}


@pytest.mark.parametrize("stem", STEPS)
def test_steps_and_pieces_are_near_the_closed_form(stem, load_case, run_case):
    model, run = load_case(stem), run_case(stem)
    assert off(run.x, model.exact(run.t)) <= STEPS[stem]
    exact = simulate(model, **EVENTS)
    assert off(exact.x, model.exact(exact.t)) <= 10 * RTOL


# -- belt --------------------------------------------------------------------------------------------------------------


def test_the_belt_has_a_limit_cycle(load_case, run_case):
    run = simulate(load_case("belt"), **EVENTS)
    torn, caught = [e.t for e in run.events if e.after[0] != 0], [e.t for e in run.events if e.after[0] == 0]
    assert np.diff(torn) == pytest.approx([6.736837] * 4, abs=1e-6)
    assert caught[0] - torn[0] == pytest.approx(5.266719, abs=1e-6)
    steps = run_case("belt")
    assert (steps.v[1:][steps.active[1:, 0]] == 0.5).all()  # it rides
    assert (steps.v[:-1] < 0.5 + 1e-12).all()
    swing = np.linalg.eigvals([[0, 1], [-1, 0.2]])[0]  # without stick
    assert np.exp(2 * np.pi * swing.real / abs(swing.imag)) == pytest.approx(1.88, abs=1e-3)


# -- elastoplastic bar -------------------------------------------------------------------------------------------------


def test_loops_close_and_the_bar_remembers(run_case):
    run = run_case("elastoplastic")
    at = lambda t: run.force[np.argmin(np.abs(run.t - t))]  # noqa: E731
    assert [at(1.0), at(1.8), at(2.6), at(4.1), at(9.1), at(14.1)] == pytest.approx([5, -1, 5, 6, -6, 6], abs=1e-12)
    virgin = lambda u: np.minimum(np.multiply([4, 2, 2, 1], u), [1, 1, 2, 2]).sum()  # noqa: E731
    for s in (0.3, 1.0, 2.2, 4.0):  # Masing
        assert 6 - at(4.1 + s) == pytest.approx(2 * virgin(s / 2), abs=1e-10)


def test_a_smoothed_slider_leaves_the_small_loop_open():
    """s' = k (u' - |u'| s/r), the simplest smooth slider: the force does not come back to what it was."""
    k, r, h, s = np.array([4.0, 2, 2, 1]), np.array([1.0, 1, 2, 2]), 1e-4, np.zeros(4)
    force = []
    for rate, length in ((1, 1.0), (-1, 0.8), (1, 0.8)):
        for _ in range(round(length / h)):
            s = s + h * k * (rate - s / r)
        force.append(s.sum())
    assert abs(force[2] - force[0]) > 0.1


# -- leash -------------------------------------------------------------------------------------------------------------


def test_a_slack_leash_does_not_move_the_stone(load_case, run_case):
    run = run_case("leash")
    for begin, end in ((1.5, 3.411), (5, 6.996)):
        waits = (run.t > begin + 0.01) & (run.t < end - 0.02)
        assert (np.diff(run.x[waits], axis=0) == 0).all()
    exact = simulate(load_case("leash"), **EVENTS)
    assert [e.t for e in exact.events if e.after[0] == 0] == pytest.approx([0.3, 3.41129, 6.99622], abs=1e-5)


def test_a_rod_would_push_the_stone(load_case):
    """q' is the part of the hand's velocity along the rod, from where the hand turns round at t = 1.5."""
    start = load_case("leash").exact(np.array([1.5]))[0]
    rod = lambda s, q: (e := q - [1.5 - s, 0]) * (e @ [-1, 0]) / (e @ e)  # noqa: E731
    pushed = solve_ivp(rod, (0, 1.5), start, rtol=1e-9, atol=1e-9).y[:, -1]
    assert np.linalg.norm(pushed) == pytest.approx(1, abs=1e-6)
    assert np.linalg.norm(pushed - start) > 0.5


# -- string on a floor -------------------------------------------------------------------------------------------------


def at_rest(p, n=15, a=1 / 16):
    """The string (n,) and the floor's force (n,): parabolas to the edges of the contact, nodes both."""
    x, s = np.arange(1, n + 1) / (n + 1), np.sqrt(2 * a / p)
    beside = np.minimum(x, 1 - x)
    return p * np.maximum(s - beside, 0) ** 2 / 2, p * np.where(np.isclose(beside, s), 0.5, beside > s)


def test_the_string_rests_on_parabolas(load_case, run_case):
    run, exact = run_case("obstacle"), simulate(load_case("obstacle"), **EVENTS)
    for end, p in ((0.4, 8 / 9), (0.8, 8), (1.2, 2)):
        u, l = at_rest(p)
        row = np.argmin(np.abs(run.t - end))
        np.testing.assert_allclose(run.x[row], u, atol=1e-5)
        np.testing.assert_allclose(exact.at(end - 1e-9).x[0], u, atol=1e-5)
        np.testing.assert_allclose(run.multipliers[row], l, atol=2e-2)


def test_the_string_falls_freely_until_it_lands(load_case):
    n, a, p = 15, 1 / 16, 8 / 9
    K = (n + 1) ** 2 * (np.eye(n, k=1) + np.eye(n, k=-1) - 2 * np.eye(n))
    sunk = lambda t: a - np.linalg.solve(K, (expm(K * t) - np.eye(n)) @ np.full(n, p))  # noqa: E731
    lands = brentq(lambda t: sunk(t)[7], 0, 0.4, xtol=1e-14)
    exact = simulate(load_case("obstacle"), t_end=0.1, **EVENTS)
    assert exact.events[0].t == pytest.approx(lands, abs=1e-8)
    assert off(exact.at(0.08).x, sunk(0.08)[None]) <= 10 * RTOL


def test_a_string_cut_off_at_the_floor_touches_too_much():
    u, x = lambda x: 1 / 16 - x * (1 - x), np.arange(1, 16) / 16
    assert brentq(u, 0, 0.5) == pytest.approx(0.067, abs=1e-3)
    assert (np.maximum(u(x), 0) == 0).sum() > (at_rest(2)[0] == 0).sum()


# -- total variation ---------------------------------------------------------------------------------------------------


def test_the_flow_is_the_minimiser_of_total_variation(load_case):
    """In one dimension u(t) minimises |u - u_0|^2/2 + t TV(u): z = sum of u_0 - u is within t, and +-t where u steps."""
    run = simulate(load_case("total_variation"), **EVENTS)
    for t in (0.01, 0.1, 0.2, 0.3, 0.55, 1.0, 2.8, 4.0, 5.5):
        u = run.at(t).x[0]
        z, step = np.cumsum(run.x[0] - u), np.diff(u)
        assert z[-1] == pytest.approx(0, abs=1e-9)
        assert np.abs(z[:-1]).max() <= t + 1e-7
        np.testing.assert_allclose(z[:-1][np.abs(step) > 1e-6], -t * np.sign(step[np.abs(step) > 1e-6]), atol=1e-7)


def test_noise_goes_edges_stay_all_ends_flat(load_case, run_case):
    run = simulate(load_case("total_variation"), **EVENTS)
    start, flat = run.x[0], run.events[-1].t
    assert flat == pytest.approx(np.abs(np.cumsum(start - start.mean())).max(), abs=1e-7)
    assert flat == pytest.approx(5, abs=1e-7)
    assert run.x[-1] == pytest.approx(np.full(24, 0.6625), abs=1e-9)
    levels = lambda u: np.unique(np.round(u, 6))  # noqa: E731
    quiet = run.at(0.5501).x[0]
    assert len(levels(quiet)) == 4
    assert quiet[7] == run.at(2.8).x[0, 7] == pytest.approx(0.4, abs=1e-9)
    assert quiet[8] - run.at(1.5501).x[0, 8] == pytest.approx(1 / 4, abs=1e-7)
    D = np.diff(np.eye(24), axis=0)
    assert len(levels(expm(-0.55 * D.T @ D) @ start)) == 24  # diffusion
    steps = run_case("total_variation")
    assert np.ptp(steps.x[-1]) <= 1e-12
    assert steps.x[-1].mean() == pytest.approx(start.mean(), abs=1e-12)


def test_cells_that_met_stay_together(run_case):
    apart = np.abs(np.diff(run_case("total_variation").x, axis=1)) > 1e-9
    assert not (apart[1:] & ~apart[:-1]).any()


# -- sand --------------------------------------------------------------------------------------------------------------


def test_sand_is_kept_and_the_first_pile_stands(run_case):
    run = run_case("sandpile")
    assert run.x.sum(axis=1) == pytest.approx(run.t, abs=1e-11)
    assert np.abs(np.diff(run.x, axis=1)).max() <= 1 + 1e-10
    assert run.x[run.t >= 16, 3] == pytest.approx(4, abs=1e-12)
    assert run.x[run.t == 9, 3] == pytest.approx(3, abs=1e-12)


def test_sand_on_stiff_slopes_creeps():
    """Slopes above 1 are pushed back with a stiffness of 20: the first pile is not what it was at t = 16."""
    h, dt, first = np.zeros(12), 5e-3, None
    for k in range(6_000):
        steep = np.diff(h)
        flow = 20 * np.sign(steep) * np.maximum(np.abs(steep) - 1, 0)
        h = h + dt * (np.diff(flow, prepend=0, append=0) + np.eye(12)[3 if k * dt < 16 else 8])
        first = h[3] if k * dt < 16 else first
    assert first - h[3] > 1e-2


# -- drum --------------------------------------------------------------------------------------------------------------


def test_the_corner_holds_the_crumb_and_lets_it_go(load_case, run_case):
    run, exact = run_case("tumbler"), simulate(load_case("tumbler"), **EVENTS)
    assert [event.t for event in exact.events][:2] == pytest.approx([0.53272, 1.54904], abs=1e-5)
    assert np.linalg.norm(run.x, axis=1).max() <= np.sqrt(2) + 1e-12
    assert (run.active[1:].sum(axis=1) >= 1).all()
    t = np.linspace(1, 2, 101)
    np.testing.assert_allclose(exact.at(t).x, exact.at(t + np.pi / 2).x, atol=1e-8)  # a quarter of a turn
    assert exact.at(np.linspace(0, 4, 2001)).x[:, 1].max() == pytest.approx(-0.8383, abs=1e-4)


def test_one_wall_at_a_time_lets_the_crumb_out():
    """Projected on the wall that is violated most, and on no other, in each step."""
    q, h, out = np.array([0, -np.sqrt(2)]), 5e-3, 0.0
    for k in range(1, 801):
        q = q + h * np.array([0, -4.0])
        angles = k * h + (2 * np.arange(4) + 1) * np.pi / 4
        walls = np.column_stack([np.cos(angles), np.sin(angles)])
        worst = np.argmax(walls @ q)
        q = q - max(walls[worst] @ q - 1, 0) * walls[worst]
        out = max(out, np.linalg.norm(q) - np.sqrt(2))
    assert out > 1e-3
