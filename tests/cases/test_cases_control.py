"""Cases of control beside closed forms and matrix exponentials, and beside what a wrong answer would be."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

from nsmodel import LureSystem, relay, simulate

RTOL = 1e-8


def off(found, right):
    """The worst error of each state, as a part of its largest value."""
    return (np.abs(found - right).max(axis=0) / np.abs(right).max(axis=0)).max()


@pytest.mark.parametrize(("stem", "h"), [("twisting", 6e-2), ("two_surfaces", 2e-3)])
def test_steps_and_pieces_are_near_the_closed_form(stem, h, load_case, run_case):
    model, run = load_case(stem), run_case(stem)
    assert off(run.x, model.exact(run.t)) <= h
    exact = simulate(model, rtol=RTOL, method="event-driven")
    assert off(exact.x, model.exact(exact.t)) <= 10 * RTOL


# -- twisting ----------------------------------------------------------------------------------------------------------


def speeds_at_0(model):
    """|v| at the passages of p = 0 in the first 2.5 s."""
    run = simulate(model, t_end=2.5, rtol=RTOL, method="event-driven")
    return [abs(event.x_after[1]) for event in run.events if abs(event.x_after[0]) < 1e-9]


def test_twisting_halves_the_speed_and_stops(load_case, run_case):
    alone = LureSystem(A=[[0, 1], [0, 0]], B=[0, 5], C=[1, 0], law=relay(1), x0=[0, 4], t_end=3, step=1e-2)
    assert speeds_at_0(load_case("twisting")) == pytest.approx([2, 1], abs=1e-7)
    assert speeds_at_0(alone) == pytest.approx([4], abs=1e-7)
    run = run_case("twisting")
    rest = run.t > 3.01
    assert (run.x[rest] == 0).all()
    assert (np.abs(run.multipliers[rest]) < 1).any(axis=1).all()


def test_twisting_by_the_last_state_does_not_stop():
    """Explicit Euler of the same relays, as the case says: what is left grows with the step."""
    left = []
    for h in (1e-3, 1e-2):
        x, late = np.array([0.0, 4.0]), []
        for k in range(int(6 / h)):
            x = x + h * np.array([x[1], -5 * np.sign(x[0]) - 3 * np.sign(x[1])])
            late += [abs(x[1])] if k * h > 5 else []
        left.append(max(late))
    assert 1e-3 < left[0] < left[1] / 2


# -- two surfaces ------------------------------------------------------------------------------------------------------


def test_on_both_surfaces_the_relays_are_the_equivalent_control(load_case, run_case):
    run = run_case("two_surfaces")
    late = run.t > 1.03
    disturbance = np.column_stack([np.sin(run.t[late]), np.cos(run.t[late])]) / 2
    assert (run.x[late] == 0).all()
    np.testing.assert_allclose(run.multipliers[late] @ [[2, 1], [1, 2]], -disturbance, atol=1e-12)
    exact = simulate(load_case("two_surfaces"), rtol=RTOL, method="event-driven")
    assert [event.t for event in exact.events] == pytest.approx([0.397916395, 1.016093621], abs=1e-8)
    alone = brentq(lambda t: 2 - 3 * t + (1 - np.cos(t)) / 2, 0.5, 1)  # as if the other relay had not given way
    assert alone == pytest.approx(0.707, abs=1e-3)


# -- observer ----------------------------------------------------------------------------------------------------------


def mass(t):
    """p and v (N, 2) of the mass alone, phase by phase."""
    free = lambda s, x, l: [x[1], -4 * x[0] - 0.2 * x[1] + 3 * np.sin(s) + l]  # noqa: E731
    turns = lambda s, x, l: x[1]  # noqa: E731
    turns.terminal, turns.direction = True, 0
    begin, x, rows = 0.0, np.array([2.0, -3.0]), np.empty((t.size, 2))
    while begin < t[-1]:
        push = lambda s, p=x[0]: 3 * np.sin(s) - 4 * p  # noqa: E731
        if x[1] == 0 and abs(push(begin)) <= 1.5:
            rows[t >= begin] = x
            grid = begin + np.linspace(0, 3, 3001)
            torn = np.flatnonzero(np.abs(push(grid)) > 1.5)
            if not torn.size or grid[torn[0]] > t[-1]:
                return rows
            begin = brentq(lambda s, push=push: abs(push(s)) - 1.5, grid[torn[0] - 1], grid[torn[0]], xtol=1e-14)
            sign = np.sign(push(begin))
        else:
            sign = np.sign(x[1]) or np.sign(push(begin))
        start = x + 1e-9 * np.array([0, sign]) * (x[1] == 0)  # off the event that it begins at
        found = solve_ivp(
            free,
            (begin, t[-1] + 1),
            start,
            "DOP853",
            rtol=1e-12,
            atol=1e-13,
            events=turns,
            args=(-1.5 * sign,),
            dense_output=True,
        )
        now = (t >= begin) & (t <= found.t[-1])
        rows[now] = found.sol(t[now]).T
        begin, x = found.t[-1], np.array([found.y[0, -1], 0])
    return rows


def test_the_observer_finds_the_mass_and_its_rest(load_case):
    run = simulate(load_case("observer"), rtol=RTOL, method="event-driven")
    t = np.linspace(0, 12, 1201)
    p, v, z, u = run.at(t).x.T
    assert off(np.column_stack([p, v]), mass(t)) <= 1e-7
    assert np.diff(12 * (p - z) ** 2 + (v - u) ** 2).max() <= 1e-12
    assert off(np.column_stack([z, u])[t > 8], np.column_stack([p, v])[t > 8]) <= 1e-7
    stick = (t > 7.93) & (t < 8.82)
    assert np.abs(u[stick]).max() <= 1e-9
    without = simulate(load_case("observer", friction=0), rtol=RTOL, method="event-driven").at(t).x
    assert np.abs(without[t > 6, 1] - without[t > 6, 3]).max() == pytest.approx(0.693, abs=1e-3)


# -- anti-windup -------------------------------------------------------------------------------------------------------


def loop(kb, t):
    """n and z (N, 2) of the PI loop: an exponential in each mode, and the modes end at w = 1 or where the drag changes."""
    T, r, kp, ki = 2.0, 0.5, 4.0, 4.0
    w = lambda x: kp * (r - x[0]) + x[1]  # noqa: E731

    def flow(x, s, full, drag):
        l = [0, 0, 1] if full else [-kp, 1, kp * r]  # l as a row over (n, z, 1)
        M = np.zeros((3, 3))
        M[0] = (np.array(l) - [1, 0, drag]) / T
        M[1] = np.array([-ki, 0, ki * r]) + kb * (np.array(l) - [-kp, 1, kp * r])
        return (expm(M * s) @ [*x, 1])[:2]

    rows, begin, x = np.empty((t.size, 2)), 0.0, np.zeros(2)
    for drag, until in ((0, 6), (0.8, 10), (0, 16)):
        while begin < until:
            full = w(flow(x, 1e-6, w(x) > 1, drag)) > 1
            grid = np.arange(1e-6, until - begin, 2e-2)
            over = [w(flow(x, s, full, drag)) > 1 for s in grid]
            change = over.index(not full) if (not full) in over else None
            gap = lambda s, x=x, full=full, drag=drag: w(flow(x, s, full, drag)) - 1  # noqa: E731
            lasts = until - begin if change is None else brentq(gap, grid[change - 1], grid[change], xtol=1e-14)
            for i in np.flatnonzero((t >= begin) & (t <= begin + lasts)):
                rows[i] = flow(x, t[i] - begin, full, drag)
            x, begin = flow(x, lasts, full, drag), begin + lasts
    return rows


@pytest.mark.parametrize(("kb", "top"), [(1.5, 0.54022), (0.0, 0.83339)])
def test_an_integral_that_is_led_back_does_not_wind_up(kb, top, load_case):
    run = simulate(load_case("anti_windup", kb=kb), rtol=RTOL, method="event-driven")
    t = np.linspace(0, 16, 161)
    right = loop(kb, t)
    assert off(run.at(t).x, right) <= 10 * RTOL
    assert run.at(np.linspace(10, 16, 1201)).x[:, 0].max() == pytest.approx(top, abs=1e-5)
    steps = simulate(load_case("anti_windup", kb=kb))
    assert off(steps.x[::10], right) <= 1e-4
    assert steps.multiplier("motor")[1:].max() <= 1
