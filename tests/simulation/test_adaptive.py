"""Steps chosen by error control: against closed forms of every class, at switches, at accumulations, with wrong input."""

import re
from functools import partial

import casadi as ca
import numpy as np
import pytest
from closed_forms import (
    ball_rest,
    friction_free,
    half_line,
    half_plane,
    moving_disc,
    point_past_disc,
    rlc_diode,
    sliding_relay,
    sliding_relay_reach,
    zhuravlev_ivanov,
)
from fuzz_models import some
from scipy.integrate import solve_ivp

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    MonotoneInclusion,
    StepError,
    SweepingProcess,
    Trajectory,
    UsageError,
    ball,
    box,
    check,
    complementarity,
    product,
    relay,
    second_order_cone,
)
from nsmodel.codegen.rollout import Rollout
from nsmodel.event_driven import fallback_steps
from nsmodel.modeling.time_grid import make_grid
from nsmodel.simulation import error_control
from nsmodel.simulation.fixed_grid import make_stepper
from nsmodel.simulation.simulate import prepared_loop as prepare_any
from nsmodel.simulation.simulate import simulate as simulate_any
from nsmodel.study.units import in_units

simulate, prepare = (partial(call, method="time-stepping") for call in (simulate_any, prepare_any))
TIGHT = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-15}
T, X, S = ca.SX.sym("t"), ca.SX.sym("x"), ca.SX.sym("s")
Q, Q2 = ca.SX.sym("q"), ca.SX.sym("q", 2)


def sliding(**weights):
    return LureSystem(
        t=T, A=[[0, 1], [0, 0]], B=[0, 2], C=[[1, 1]], f=[0, ca.sin(T)], law=relay(1), x0=[1, 0], t_end=5, step=0.01, **weights
    )


def turning(t_end=12.0, **weights):
    """x'' = -x + l with l in -Sgn(x'), from 5.3."""
    return LureSystem(A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], law=relay(1), x0=[5.3, 0], t_end=t_end, step=0.01, **weights)


def diode(t_end=5e-3, **weights):
    """The circuit of cases/circuits/rlc_diode.py; the diode conducts until t = 1.6e-4 or so."""
    L, C, R = 1e-2, 1e-6, 1e3
    return LureSystem(
        A=[[0, -1 / C], [1 / L, 0]], B=[-1 / C, 0], C=[-1, 0], D=R, law=complementarity(1), x0=[10, 0], t_end=t_end, step=1e-5,
        names=["v", "i"], **weights,
    )  # fmt: skip


def play():
    """q between u - 1/2 and u + 1/2 for u = 2 sin t exp(-t/10): it stays where u turns, at tan t = 10."""
    u = 2 * ca.sin(T) * ca.exp(-T / 10)
    return SweepingProcess(t=T, q=Q, f=0, constraints={"up": Q - u + 0.5, "down": u + 0.5 - Q}, q0=0, t_end=20, step=0.01)


def play_exact(t):
    def u(s):
        return 2 * np.sin(s) * np.exp(-s / 10)

    q, turns = np.zeros_like(t), np.arctan(10) + np.pi * np.arange(7)
    for k, now in enumerate(t):
        for s in [*turns[turns <= now], now]:
            q[k] = np.clip(q[k], u(s) - 0.5, u(s) + 0.5)
    return q[:, None]


def oscillator():
    return FrictionOscillator(x=X, potential=X**2 / 2, friction=S, s=S, x0=5.3, v0=0, t_end=12)


def past_disc():
    return SweepingProcess(q=Q2, f=[1, 0], constraints={"disc": ca.norm_2(Q2) - 1}, q0=[-1.5, 0.3], t_end=3, step=0.01)


SCENES = {
    "sweeping, a wall that moves": (
        SweepingProcess(t=T, q=Q, f=-Q, constraints={"wall": Q - ca.sin(T)}, q0=0, t_end=3), half_line,
    ),
    "sweeping, a half plane": (
        SweepingProcess(t=T, q=Q2, f=[0, 1], constraints={"wall": Q2[0] - ca.sin(2 * T)}, q0=[0, 0], t_end=2), half_plane,
    ),
    "sweeping, past a disc": (past_disc(), point_past_disc),
    "sweeping, pushed by a disc": (
        SweepingProcess(
            t=T, q=Q2, f=[0, 0], constraints={"disc": ca.norm_2(Q2 - ca.vertcat(T, 0)) - 1}, q0=[1.5, 0.3], t_end=4, step=0.5
        ),
        moving_disc,
    ),
    "oscillator": (oscillator(), lambda t: friction_free(t, 5.3)[:, :1]),
    "Lur'e, a relay that slides": (sliding(), sliding_relay),
    "first order, the same": (
        FirstOrderSystem(
            t=T, x=Q2, lam=X, f=[Q2[1], ca.sin(T)], g=[0, 2 * X], h=Q2[0] + Q2[1], law=relay(1), x0=[1, 0], t_end=5, step=0.01
        ),
        sliding_relay,
    ),
    "first order, theta = gamma = 1/2": (
        FirstOrderSystem(
            t=T, x=Q2, lam=X, f=[Q2[1], ca.sin(T)], g=[0, 2 * X], h=Q2[0] + Q2[1], law=relay(1), x0=[1, 0], t_end=0.4, step=0.01,
            theta=0.5, gamma=0.5,
        ),
        sliding_relay,
    ),
    "Lur'e, a relay that slides, theta = 1/2": (sliding(theta=0.5), sliding_relay),
    "Lur'e, a relay that slides, theta = gamma = 1/2": (sliding(theta=0.5, gamma=0.5), sliding_relay),
    "Lur'e, a relay that jumps, theta = 1/2": (turning(theta=0.5), lambda t: friction_free(t, 5.3)),
    "Lur'e, a diode, theta = gamma = 1/2": (diode(theta=0.5, gamma=0.5), rlc_diode),
    "inclusion": (
        MonotoneInclusion(x=X, field=-1 - X, lower=0, x0=2, t_end=2),
        lambda t: np.maximum(3 * np.exp(-t) - 1, 0)[:, None],
    ),
}  # fmt: skip


def test_atol_alone_has_a_summary():
    assert "rtol 0: " in simulate(sliding(), atol=1e-4).summary_text()


@pytest.mark.c
@pytest.mark.parametrize("compiled", [False, True])
def test_where_pieces_do_not_apply_steps_have_a_budget(monkeypatch, compiled):
    """A cone: the estimate tells what a run that had to end allowed itself; method="time-stepping" goes on in earnest."""
    for of, constant, value in (
        (fallback_steps, "STRICT", 200),
        (fallback_steps, "TENFOLD", 100),
        (error_control, "LOOSENING_INTERVAL", 50),
    ):
        monkeypatch.setattr(of, constant, value)
    one, f = np.eye(3), ca.vertcat(ca.sin(2 * T), 2 * ca.cos(3 * T), 1.5 * ca.sin(T))
    model = LureSystem(t=T, A=-one, B=one, C=one, f=f, law=second_order_cone(3), x0=[1, 0, 0], t_end=2)
    run = simulate_any(model, rtol=1e-6, compiled=compiled)
    assert run.status == "done"
    assert run.summary()["error_control"]["estimate"] > 100
    assert sum("add up to" in text for text in run.metadata["warnings"]) == 1
    earnest = simulate(model, rtol=1e-4, compiled=compiled)
    assert len(earnest) > 1000
    apart = max(np.abs(np.interp(run.t, earnest.t, earnest.x[:, i]) - run.x[:, i]).max() for i in range(3))
    assert apart <= 1e-6 * run.summary()["error_control"]["estimate"]
    monkeypatch.setattr(error_control, "STEP_BUDGET", 220)
    with pytest.raises(StepError, match=r"220 steps were accepted.*time-stepping"):
        simulate_any(model, rtol=1e-6, compiled=compiled)


@pytest.mark.parametrize("name", SCENES)
def test_the_tolerance_is_met(name):
    """The error of the whole run stays below 3 rtol of the largest state, and falls with rtol."""
    model, exact = SCENES[name]
    errors = []
    for rtol in (1e-3, 1e-5):
        run = simulate(model, rtol=rtol)
        assert run.t[-1] == model.t_end
        assert run.residual[1:].max() <= 1e-9
        errors.append(np.abs(run.x - exact(run.t)).max() / np.abs(exact(run.t)).max())
        assert errors[-1] <= 3 * rtol
        assert errors[-1] <= 2 * rtol * run.summary()["error_control"]["estimate"]
    assert errors[1] <= max(errors[0] / 10, 1e-5)


@pytest.mark.parametrize("name", ["oscillator", "Lur'e, a relay that slides", "sweeping, past a disc", "inclusion"])
def test_smooth_phases_are_of_second_order(name):
    """For 100 times less error 10 times more steps: the extrapolated value is of second order (a first-order one takes 100)."""
    model, _ = SCENES[name]
    few, many = (simulate(model, rtol=rtol, compiled=True).metadata["totals"] for rtol in (1e-4, 1e-6))
    assert 5 <= many["accepted"] / few["accepted"] <= 14
    assert many["extrapolated"] >= 0.9 * many["accepted"]


@pytest.mark.parametrize("compiled", [False, True])
def test_one_step_of_an_oscillator_is_combined_by_its_order(compiled):
    """x'' = -x + 1 while the velocity is below 0, theta = 1/2: of second order, (4 x_fine - x_coarse)/3 is h^5 4.3/320 off."""
    run = simulate(turning(0.16, theta=0.5), rtol=1e-2, compiled=compiled)
    assert (run.t[2], run.multipliers[1, 0]) == (0.01, 1)
    error = np.abs(run.x - np.column_stack([1 + 4.3 * np.cos(run.t), -4.3 * np.sin(run.t)])).max(axis=1)
    assert 1e-8 < error[1]
    assert error[2] == pytest.approx(0.01**5 * 4.3 / 320, rel=1e-2)


def test_a_diode_that_conducts_is_combined_by_its_order():
    """B l makes it first order for gamma = 1, not for 1/2; the bounds of gamma = 1 are those of 2 x_fine - x_coarse."""
    L, C, R, end = 1e-2, 1e-6, 1e3, 1.4e-4
    values, vectors = np.linalg.eig([[-1 / (R * C), -1 / C], [1 / L, 0]])
    start = np.linalg.solve(vectors, [10.0, 0.0])
    for gamma, known in ((1.0, {1e-4: 0.98, 1e-6: 1.60}), (0.5, {1e-4: 0.07, 1e-6: 0.11})):
        for rtol, bound in known.items():
            run = simulate(diode(end, theta=0.5, gamma=gamma), rtol=rtol)
            assert (run.multipliers[1:, 0] > 0).all()
            exact = (np.exp(np.outer(run.t, values)) @ (vectors * start).T).real
            assert (np.abs(run.x - exact) / np.abs(exact).max(axis=0)).max() <= bound * rtol


WAVE = ca.vertcat(Q2[1] + 0.3 * ca.sin(Q2[0]), -Q2[0] + 0.2 * Q2[1] ** 2)


def at_an_end(draw, **weights):
    B, C, f = draw.uniform(0.5, 1.5, 2), draw.uniform(0.5, 1.5, 2), ca.vertcat(ca.sin(draw.uniform(0.5, 2) * T), 0)
    model = LureSystem(t=T, x=Q2, A=WAVE, B=B, C=[C], f=f, law=relay(1), x0=draw.uniform(2, 3, 2), t_end=1, **weights)
    return model, WAVE + f - B


def conducting(draw, **weights):
    B, C, D = draw.uniform(0.5, 1.5, 2), draw.uniform(0.5, 1.5, 2), draw.uniform(0.5, 2)
    x0 = -draw.uniform(2, 3, 2)
    model = LureSystem(t=T, x=Q2, A=WAVE, B=B, C=[C], D=D, law=complementarity(1), x0=x0, t_end=1, **weights)
    return model, WAVE - B * (ca.DM(C).T @ Q2) / D


def held(draw, **weights):
    B, C, f = draw.uniform(0.5, 1.5, 2), draw.uniform(0.5, 1.5, 2), ca.vertcat(ca.sin(draw.uniform(0.5, 2) * T), 0)
    x0 = [C[1], -C[0]]
    model = LureSystem(t=T, x=Q2, A=WAVE, B=B, C=[C], f=f, law=relay(1, -50, 50), x0=x0, t_end=1, **weights)
    return model, WAVE + f - B * (ca.DM(C).T @ (WAVE + f)) / (B @ C)


def input_of(g):
    def build(draw, **weights):
        input, h, a = g(Q2, X), 20 + Q2[0], draw.uniform(0.5, 1.5)
        model = FirstOrderSystem(t=T, x=Q2, lam=X, f=a * WAVE, g=input, h=h, law=relay(1), x0=[a, 0.3], t_end=1, **weights)
        return model, a * WAVE + ca.substitute(input, X, -1)

    return build


def no_law(draw, **weights):
    a = draw.uniform(0.5, 1.5)
    return FirstOrderSystem(t=T, x=Q2, f=WAVE * ca.cos(a * T), x0=[a, 1], t_end=1, **weights), WAVE * ca.cos(a * T)


PHASES = {
    "at an end": (at_an_end, {(1, 1): 1, (0.5, 1): 2, (0.5, 0.5): 2, (0.7, 0.5): 1}),
    "conducting": (conducting, {(1, 1): 1, (0.5, 1): 1, (0.5, 0.5): 2}),
    "held": (held, {(1, 1): 1, (0.5, 1): 2, (0.5, 0.5): 2}),
    "g of x": (input_of(lambda x, l: ca.vertcat(l * x[1], l)), {(0.5, 1): 1, (0.5, 0.5): 2}),
    "g of l": (input_of(lambda x, l: ca.vertcat(l**2, ca.exp(l))), {(0.5, 1): 2, (1, 1): 1}),
    "no law": (no_law, {(0.5, 1): 2, (1, 1): 1}),
}


@pytest.mark.parametrize(("phase", "theta", "gamma"), [(name, *at) for name, (_, orders) in PHASES.items() for at in orders])
@pytest.mark.parametrize("seed", range(2))
def test_the_order_of_a_step(phase, theta, gamma, seed):
    """A half step errs by h^(p+1), the combination of its step by h^(p+2) at most, where nothing switches; the same in C."""
    build, orders = PHASES[phase]
    model, motion = build(np.random.default_rng(seed), theta=theta, gamma=gamma)
    p, rate = orders[theta, gamma], ca.Function("rate", [T, Q2], [motion])
    errors = []
    for h in (1 / 64, 1 / 128, 1 / 512, 1 / 1024):
        run = simulate(model, rtol=0.5, step=h)
        start, rows = run.t[2], slice(3, 5)  # in its second step: the first one with gamma < 1 may start with any multiplier
        assert run.t[4] == 2 * h
        assert len(np.unique(run.index_set[1:5], axis=0)) == 1
        exact = solve_ivp(lambda t, x: np.array(rate(t, x)).ravel(), (start, run.t[4]), run.x[2], t_eval=run.t[rows], **TIGHT)
        errors.append(np.linalg.norm(run.x[rows] - exact.y.T, axis=1))
    assert np.log2(errors[2][0] / errors[3][0]) == pytest.approx(p + 1, abs=0.1)
    assert np.log2(errors[0][1] / errors[1][1]) >= p + 1.8
    if (seed, theta, gamma) == (0, 0.5, 1):
        np.testing.assert_allclose(simulate(model, rtol=0.5, step=h, compiled=True).x[:5], run.x[:5], rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("theta", [0.5, 1])
def test_what_is_carried_of_the_multipliers_is_not_magnified(theta, compiled):
    """gamma = 1/2 lets l alternate about its mean where y = 0 is held: from step to step by -1, combined by -3."""
    weights = {"theta": theta, "gamma": 0.5}
    run, plain = simulate(sliding(**weights), rtol=1e-2, compiled=compiled), simulate(sliding(theta=theta), rtol=1e-2)
    assert run.metadata["totals"]["accepted"] <= 1.2 * plain.metadata["totals"]["accepted"]
    assert run.metadata["totals"]["index_set_changes"] == 1
    np.testing.assert_allclose(run.x, sliding_relay(run.t), atol=5e-3)


@pytest.mark.parametrize("compiled", [False, True])
def test_a_turn_that_half_steps_do_not_see_is_told(compiled):
    """The walls take q along until they turn inside a step, which whole and half steps do not see alike."""
    rtol = 1e-4
    run = simulate(play(), rtol=rtol, compiled=compiled)
    [warning] = run.metadata["warnings"]
    assert warning in run.summary()["warnings"]
    assert "turned back inside 5 steps" in " ".join(run.summary_text().split())
    begins, ends = (np.searchsorted(run.t, np.arctan(10)) - 1) // 2 * 2 + np.array([0, 2])
    assert run.t[begins] < np.arctan(10) < run.t[ends]
    assert f"first before t = {run.t[ends]:.6g}" in warning
    told = float(re.search(r"by about (\S+) times", warning)[1])
    assert np.abs(run.x - play_exact(run.t)).max() / (rtol * np.abs(run.x).max()) == pytest.approx(told, rel=0.05)


@pytest.mark.long
@pytest.mark.parametrize(("s", "rtol"), some([(0.77, 1e-6), (0.77, 1e-4), (1.3, 1e-6), (1.3, 1e-4)]))
@pytest.mark.parametrize("theta", [0.5, 1])
def test_a_release_that_half_steps_see_too_late_is_told(s, theta, rtol):
    """x' = s t + l sticks at 0 until t = 1/s: l is a value inside the step."""
    model = LureSystem(t=T, A=[0], B=[1], C=[1], f=[s * T], law=relay(1), x0=[0], t_end=2, step=0.01, theta=theta)
    run = simulate(model, rtol=rtol)
    exact = s * np.maximum(run.t - 1 / s, 0) ** 2 / 2
    error = np.abs(run.x[:, 0] - exact).max() / (rtol * exact.max())
    told = [float(number) for line in run.metadata["warnings"] for number in re.findall(r"by about (\S+) times", line)]
    assert told == pytest.approx([error] if error > 1 else [], rel=0.05)


def test_a_current_that_ends_too_late_between_diodes_is_told():
    """Rows that depend on l, but on none that is free: a rectifier's current, once both of its diodes block."""
    rate = [[-500, 0], [0, -20]]
    model = LureSystem(
        t=T, A=rate, B=[[-1e3, 1e3, 0, 0], [0, 0, 2e3, 2e3]], C=[[-1, 0], [1, 0], [0, 1], [0, 1]],
        D=[[0, 0, 1, 0], [0, 0, 0, 1], [-1, 0, 0, 0], [0, -1, 0, 0]], f=[3e5 * ca.sin(300 * T), 0], law=complementarity(4),
        x0=[0, 0], t_end=0.1, step=1e-5, theta=0.5,
    )  # fmt: skip
    run, exact = simulate(model, rtol=1e-4), simulate_any(model, rtol=1e-11, method="event-driven")
    error = (np.abs(run.x - exact.at(run.t).x) / np.abs(exact.x).max(axis=0)).max() / 1e-4
    told = [float(number) for line in run.metadata["warnings"] for number in re.findall(r"by about (\S+) times", line)]
    assert error > 10
    assert told == pytest.approx([error], rel=2)


@pytest.mark.parametrize("name", [name for name in SCENES if "= 1/2" not in name or "diode" in name])
def test_no_warning_without_reason(name):
    assert simulate(SCENES[name][0], rtol=1e-3).metadata["warnings"] == []


@pytest.mark.parametrize(
    ("law", "name"), [(relay(1), "l_0"), (product(complementarity(1), box(-2, 3)), "l_1"), (ball(2), "l_0")], ids=str
)
def test_a_relay_with_theta_one_half_is_told(law, name):
    for theta, count in ((0.5, 1), (1, 0)):
        m = law.size
        model = LureSystem(A=np.zeros((m, m)), B=np.eye(m), C=np.eye(m), law=law, x0=np.ones(m), t_end=0.1, theta=theta)
        warnings = simulate(model, rtol=1e-2).metadata["warnings"]
        assert len(warnings) == count
        assert all(f"theta = 1/2 with the relay '{name}'" in line for line in warnings)
        assert simulate(model, step=0.01).metadata["warnings"] == []


def test_steps_shrink_at_a_switch_and_grow_after_it():
    run = simulate(sliding(), rtol=1e-4)
    switch = sliding_relay_reach()
    k = int(np.searchsorted(run.t, switch))
    assert run.step[k] <= 1e-3 * run.step[1:].max()
    assert run.step[k - 25 : k].max() >= 50 * run.step[k]
    assert run.step[k : k + 25].max() >= 50 * run.step[k]
    assert (run.multipliers[1:k, 0] == -1).all()


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("seed", [134, 138, 20])
def test_extrapolation_goes_through_no_wall(seed, compiled):
    """x' = -x + a cos wt + l, 0 <= x complementary to l >= 0: l is at most a, an impulse there is none."""
    r, t = np.random.default_rng(seed), ca.SX.sym("t")
    a, w = r.uniform(0.5, 3), r.uniform(0.5, 3)
    model = LureSystem(
        t=t, A=[[-1]], B=[[1]], C=[[1]], f=[a * ca.cos(w * t)], law=complementarity(1), x0=[1], t_end=10, step=1e-2
    )
    run = simulate(model, rtol=1e-3, compiled=compiled)
    assert run.x.min() >= 0
    assert run.multipliers[1:].max() <= a * (1 + 1e-9)


def test_an_accumulation_of_impacts_is_passed():
    """The ball of Zhuravlev and Ivanov bounces infinitely often before it rests."""
    x, l, kappa, G = Q2, ca.SX.sym("l", 2), 0.5, 9.81
    g = [-kappa * l[0] * l[1] * x[1], G * l[0] / (1 - kappa * l[0] * l[1])]
    ball = FirstOrderSystem(x=x, lam=l, f=[x[1], 0], h=x, g=g, law=relay(2), x0=[1, 10], t_end=3, step=1e-3)
    run = simulate(ball, rtol=1e-4, compiled=True)
    _, _, rest = ball_rest(1.0, 5.0, 1 / 3)
    assert rest < 3
    np.testing.assert_allclose(run.x, zhuravlev_ivanov(run.t), atol=3e-3)
    assert len(run) < 5000
    assert run.step[1:].min() > 1e-9


def test_rows_are_verified_steps():
    """Each half step solves the scheme from the row before; only what extrapolation moved starts elsewhere."""
    run = simulate(past_disc(), rtol=1e-3)
    assert len(run.correction) == len(run.t)
    assert run.gap.min() >= -1e-14
    for k in range(1, len(run.t)):
        if run.correction[k]:
            assert run.correction[k] <= 1
            continue
        q, h = run.x[k - 1], run.step[k]
        n = q / np.linalg.norm(q)
        y = q + h * np.array([1.0, 0])
        y += max(0.0, -(np.linalg.norm(q) - 1 + n @ (y - q))) * n
        np.testing.assert_allclose(run.x[k], y, atol=1e-14)
    np.testing.assert_array_equal(run.reactions[1:], run.multipliers[1:] / run.step[1:, None])


def test_stick_is_exact():
    run = simulate(oscillator(), rtol=1e-4)
    still = run.t > 3 * np.pi + 1e-2
    assert (run.v[still] == 0).all()
    assert len(np.unique(run.x[still])) == 1
    assert run.x[-1, 0] == pytest.approx(0.7, abs=1e-3)
    assert run.metadata["convergence"]["finite"]


def test_the_inequalities_of_the_theory_hold_at_the_steps_of_the_scheme():
    """Error control carries the velocity over, so that the energy needs no order of the steps."""
    report = check(oscillator(), [simulate(oscillator(), rtol=1e-3)], quick=True)
    assert report["O-steps"].verdict == report["run-energy"].verdict == "holds"
    inclusion = SCENES["inclusion"][0]
    assert not check(inclusion, [simulate(inclusion, rtol=1e-3)], quick=True).having("violated")


def test_a_run_in_c_is_the_same_run():
    for model in (sliding(), oscillator(), past_disc()):
        plain, compiled = (simulate(model, rtol=1e-3, compiled=how) for how in (False, True))
        np.testing.assert_array_equal(plain.t, compiled.t)
        np.testing.assert_allclose(plain.x, compiled.x, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("units", [(1e-9, 1.0), (1e9, 1e-9)], ids=str)
def test_units_do_not_matter(units):
    u, tau = units
    for model in (oscillator(), past_disc()):
        run, other = simulate(model, rtol=1e-3), simulate(in_units(model, u, tau), rtol=1e-3)
        np.testing.assert_allclose(other.t / tau, run.t, rtol=1e-12)
        np.testing.assert_allclose(other.x / u, run.x, rtol=1e-9, atol=1e-9)


def test_a_jump_of_the_state_is_passed_at_the_least_step():
    """A wall that jumps at t = 0.3 takes the point along at once, whatever the step."""
    wall = Q - ca.if_else(T < 0.3, 0, 1)
    run = simulate(SweepingProcess(t=T, q=Q, f=-1, constraints={"wall": wall}, q0=0.5, t_end=1), rtol=1e-3)
    totals = run.metadata["totals"]
    assert 1 <= totals["at_least_step"] <= 4
    assert totals["least_step"] == pytest.approx(2.0**-41)
    np.testing.assert_allclose(run.x[:, 0], np.where(run.t < 0.3, 0.5 - run.t, 1), atol=1e-11)
    assert "at the least step" in " ".join(run.summary_text().split())
    assert len(run) < 500


def test_what_cannot_go_on_says_where_and_keeps_the_rows(tmp_path):
    walls = {"left": Q + 1 - T, "right": 1 - T - Q}
    with pytest.raises(StepError, match=r"'left'.*'right'") as caught:
        simulate(SweepingProcess(t=T, q=Q, f=1, constraints=walls, q0=0, t_end=2), rtol=1e-3, out=tmp_path)
    run = caught.value.trajectory
    assert run.t[-1] == pytest.approx(1, abs=1e-9)
    np.testing.assert_allclose(run.x[:, 0], np.minimum(run.t, 1 - run.t), atol=1e-9)
    np.testing.assert_array_equal(Trajectory.load(tmp_path / "trajectory.npz").x, run.x)


def test_absolute_tolerances():
    model = LureSystem(A=[[-1, 0], [0, -1000]], x0=[1, 1e-6], t_end=1, step=0.01, B=np.zeros((2, 0)), C=np.zeros((0, 2)),
                       law=complementarity(0))  # fmt: skip
    relative = simulate(model, rtol=1e-4)
    assert len(simulate(model, rtol=1e-4, atol=[0, 1e-6])) < len(relative) / 1.2
    run = simulate(model, atol=1e-5)
    assert np.abs(run.x[:, 0] - np.exp(-run.t)).max() <= 3e-5


def test_a_resting_state_takes_few_steps():
    run = simulate(SweepingProcess(q=Q2, f=[0, 0], constraints={"wall": Q2[0]}, q0=[0, 0], t_end=1), rtol=1e-9)
    assert len(run) <= 300


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rtol": 0}, "rtol = 0; expected"),
        ({"rtol": -1e-3}, "rtol = -0.001"),
        ({"rtol": np.nan}, "rtol = nan"),
        ({"rtol": "1e-3"}, "rtol = '1e-3'"),
        ({"rtol": 1e-3, "atol": [1, 2, 3]}, "atol .* one for each of x_0, x_1"),
        ({"rtol": 1e-3, "atol": -1}, "atol = -1"),
        ({"rtol": 1e-3, "atol": "a"}, "atol = 'a'"),
        ({"rtol": 1e-3, "steps": [0.1]}, "steps and rtol"),
        ({"rtol": 1e-3, "save_every": 2}, "save_every and rtol"),
        ({"rtol": 1e-3, "resume": True, "out": "nowhere"}, "resume and rtol"),
        ({"rtol": 1e-3, "step": 0}, "step = 0"),
        ({"rtol": 1e-3, "t_end": -1}, "t_end = -1"),
        ({"rtol": 1e-3, "t_end": "5"}, "t_end = '5'; expected a finite number"),
        ({"rtol": 1e-3, "t_end": 10**400}, "t_end = 1000"),
    ],
    ids=str,
)
def test_wrong_arguments(options, words):
    with pytest.raises(UsageError, match=words):
        simulate(sliding(), **options)


def test_models_bound_to_their_steps_are_refused():
    pair = FrictionOscillator(x=X, potential=X**2, friction=S, s=S, x0=1, x1=1, t_end=1, step=0.1)
    with pytest.raises(UsageError, match=r"x1 .* give the velocity v0"):
        simulate(pair, rtol=1e-3)
    given = MonotoneInclusion(x=X, field=-1, lower=0, x0=1, t_end=1, step=0.1, tolerances=[1e-3] * 10)
    with pytest.raises(UsageError, match="tolerances is a value a step"):
        simulate(given, rtol=1e-3)


def test_prepared_runs_are_the_runs():
    for options in ({}, {"rtol": 1e-3}, {"compiled": True}):
        np.testing.assert_array_equal(prepare(sliding(), **options).go().x, simulate(sliding(), **options).x)


def test_a_step_size_that_comes_back_finds_its_own_matrices():
    """Matrices kept from one call must not serve the first step of the next call, where that has the grid's first size."""
    model = sliding().bind()
    grid = make_grid(model, None, [0.01, 0.3, 0.01, 0.01], None)
    state = np.array([1.0, 0.0])
    step = make_stepper(model, "auto", 1e-9, h=0.01, state=state)
    rollout, warm = Rollout(model, grid, 1e-9), step.cold_start()
    rows, index = np.empty((4, step.layout.width)), np.empty((4, 1), np.int8)
    first = rollout.advance(0, 2, state, warm, -np.inf, 1, rows, index)
    assert first.steps == 2
    second = rollout.advance(2, 1, first.state, first.warm, -np.inf, 1, rows, index)
    expected = step(grid.time(2), 0.01, first.state, first.warm).row
    np.testing.assert_allclose(second.state, expected[step.layout.state], atol=1e-13)
