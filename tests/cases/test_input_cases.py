"""Converters, rectifiers, switches, controllers against closed forms, matrix exponentials, recursions; in steps and by pieces."""

import casadi as ca
import input_scenes as scenes
import numpy as np
import pytest
from block_scenes import exact_over_current, over_current, thermostat
from input_scenes import VIN, T, flow
from scipy.linalg import expm
from scipy.optimize import brentq

from nsmodel import FirstOrderSystem, LureSystem, complementarity, pwm, relay, simulate, steps, thyristor

RTOL = 1e-8
EVENTS = {"rtol": RTOL, "method": "event-driven"}


def off(found, right):
    """The worst error of each column, as a part of its largest value."""
    return (np.abs(found - right).max(axis=0) / np.abs(right).max(axis=0)).max()


# -- affine modes, one after the other ---------------------------------------------------------------------------------


def orbit(*modes):
    """The states at the begin of each mode (A, b, t), and again at the end, of what is periodic."""
    P, g = np.eye(len(modes[0][1])), 0
    for mode in modes:
        more, push = flow(*mode)
        P, g = more @ P, more @ g + push if np.ndim(g) else push
    states = [np.linalg.solve(np.eye(len(P)) - P, g)]
    for mode in modes:
        more, push = flow(*mode)
        states.append(more @ states[-1] + push)
    return states


def integral(A, b, t, x, Q):
    """That of (x, 1)' Q (x, 1) over a mode that begins at x, by Van Loan's exponential."""
    n = len(x)
    M, z = np.zeros((n + 1, n + 1)), np.append(x, 1.0)
    M[:n, :n], M[:n, n] = A, b
    E = expm(np.block([[-M.T, Q], [np.zeros((n + 1, n + 1)), M]]) * t)
    return z @ E[n + 1 :, n + 1 :].T @ E[: n + 1, n + 1 :] @ z


def mean(modes, i):
    """Of the state i along the orbit."""
    Q = np.zeros((3, 3))
    Q[i, 2] = 1
    return sum(integral(*mode, x, Q) for mode, x in zip(modes, orbit(*modes), strict=False)) / sum(t for *_, t in modes)


def buck_modes(R=5.0, duty=0.4, forward=0.0, resistance=0.0):
    """The switch closed, then the diode with its forward voltage and resistance."""
    L, C = 1e-4, 47e-6
    A = np.array([[0, -1 / L], [1 / C, -1 / (R * C)]])
    return (A, np.array([VIN / L, 0]), duty * T), (A - np.diag([resistance / L, 0]), np.array([-forward / L, 0]), (1 - duty) * T)


def test_the_orbit_of_a_buck_converter_is_kept():
    modes = buck_modes()
    begin, turn, end = orbit(*modes)
    np.testing.assert_allclose([begin, turn], [[1.631877637367, 9.597904103757], [2.208122861491, 9.598008509243]], atol=1e-11)
    run = simulate(scenes.buck(t_end=20 * T, x0=begin), **EVENTS)
    assert off(run.at(np.arange(21) * T).x, np.tile(end, (21, 1))) <= 10 * RTOL
    assert run.mean("v") == pytest.approx(0.4 * VIN, rel=10 * RTOL)  # no mean voltage on the coil,
    assert run.mean("i") == pytest.approx(0.4 * VIN / 5, rel=10 * RTOL)  # no mean current in the capacitor
    steps_ = simulate(scenes.buck(t_end=20 * T, x0=begin))
    assert off(steps_.x[::20], np.tile(end, (21, 1))) <= 1e-3


def test_a_light_load_begins_where_the_orbit_touches_zero():
    boundary = brentq(lambda R: orbit(*buck_modes(R))[0][0], 10, 100, xtol=1e-12)
    assert boundary == pytest.approx(33.3191518706, abs=1e-9)
    for part, touches in ((0.99, False), (1.01, True)):
        begin = np.maximum(orbit(*buck_modes(part * boundary))[0], 0)
        run = simulate(scenes.buck(part * boundary, t_end=5 * T, x0=begin), **EVENTS)
        assert any(event.x_after[0] == 0 for event in run.events) == touches


def test_a_buck_converter_with_a_light_load_by_pieces():
    right = scenes.exact_buck(200, 100.0)
    run = simulate(scenes.buck(100.0), **EVENTS)
    assert off(run.at(np.arange(201) * T).x, right) <= 10 * RTOL
    modes = buck_modes(100.0)
    lasts = 2.89806134005e-6

    def again(v):
        """How v changes over a period that begins with no current; and how long the diode conducts."""
        x = flow(*modes[0])[0] @ [0, v] + flow(*modes[0])[1]
        at = brentq(lambda s: (flow(*modes[1][:2], s)[0] @ x)[0], 0, 0.6 * T, xtol=1e-20, rtol=1e-14)
        return (flow(*modes[1][:2], at)[0] @ x)[1] * np.exp(-(0.6 * T - at) / (100 * 47e-6)) - v, at

    v = brentq(lambda v: again(v)[0], 10, 20, xtol=1e-13)
    assert (v, again(v)[1]) == pytest.approx((13.913147125885, lasts), rel=1e-10)
    run = simulate(scenes.buck(100.0, t_end=5 * T, x0=[0, v]), **EVENTS)
    assert run.at(5 * T).x[0] == pytest.approx([0, v], rel=10 * RTOL)
    assert run.mean("v") == pytest.approx(100 * run.mean("i"), rel=10 * RTOL)
    assert run.mean("v") == pytest.approx(13.917197385391, rel=10 * RTOL)
    blocked = [event.t % T for event in run.events if event.x_after[0] == 0]
    assert min(blocked) == pytest.approx(0.4 * T + lasts, rel=10 * RTOL)


def lossy(x0, **fields):
    """A buck converter whose diode takes 0.5 V and 10 mohm."""
    L, C, R = 1e-4, 47e-6, 5.0
    i, v, l, u = (ca.SX.sym(name) for name in "ivlu")
    drop = (1 - u) * (0.5 + 0.01 * i)
    given = {"t_end": 20 * T, "step": T / 20, "theta": 0.5} | fields
    return FirstOrderSystem(
        x=[i, v], lam=l, f=[(u * VIN - drop - v) / L, (i - v / R) / C], g=[l / L, 0], h=i, law=complementarity(1), x0=x0,
        inputs={u: pwm(T, 0.4)}, outputs={"fed": u * VIN * i, "used": v**2 / R, "lost": drop * i}, **given,
    )  # fmt: skip


def test_the_efficiency_of_a_buck_converter_with_losses():
    modes = buck_modes(forward=0.5, resistance=0.01)
    begin, turn, _ = orbit(*modes)
    used, fed, lost = np.diag([0, 1 / 5, 0]), np.zeros((3, 3)), np.diag([0.01, 0, 0])
    fed[0, 2], lost[0, 2] = VIN, 0.5
    powers = [
        sum(integral(*mode, x, used) for mode, x in zip(modes, (begin, turn), strict=True)) / T,
        integral(*modes[0], begin, fed) / T,
        integral(*modes[1], turn, lost) / T,
    ]
    assert powers[0] + powers[2] == pytest.approx(powers[1], rel=1e-12)  # the orbit keeps its energy
    efficiency = powers[0] / powers[1]
    assert 0.9 < efficiency < 0.99
    for options, tolerance in (({}, 1e-4), (EVENTS, 10 * RTOL)):
        run = simulate(lossy(begin), **options)
        assert [run.mean(name) for name in ("used", "fed", "lost")] == pytest.approx(powers, rel=10 * tolerance)
        assert run.mean("used") / run.mean("fed") == pytest.approx(efficiency, rel=tolerance)
    run = simulate(lossy([0, 0], t_end=700 * T), compiled=False)  # from rest
    window = (690 * T, 700 * T)
    assert run.mean("used", *window) / run.mean("fed", *window) == pytest.approx(efficiency, rel=1e-4)


def boost_modes():
    """The switch closed, the diode conducting, neither."""
    L, C, R, half = 1e-4, 1e-4, 20.0, 1e-5
    load, push = np.diag([0, -1 / (R * C)]), np.array([12 / L, 0])
    coil = np.array([[0, -1 / L], [1 / C, 0]])
    return (load, push, half), (load + coil, push, half), (load, np.zeros(2), half)


def exact_boost(periods):
    """x at 0, T, 2 T, ... from (0, 12): the diode blocks where the current falls to 0."""
    closed, open_, neither = boost_modes()
    x, rows = np.array([0.0, 12.0]), [np.array([0.0, 12.0])]
    for _ in range(periods):
        P, g = flow(*closed)
        x = P @ x + g

        def at(s, x=x):
            P, g = flow(*open_[:2], s)
            return P @ x + g

        if at(open_[2])[0] < 0:
            ends = brentq(lambda s: at(s)[0], 0, open_[2], xtol=1e-20, rtol=1e-14)
            x = np.array([0, at(ends)[1] * np.exp(neither[0][1, 1] * (open_[2] - ends))])
        else:
            x = at(open_[2])
        rows.append(x)
    return np.array(rows)


def test_a_boost_converter_by_pieces():
    right = exact_boost(100)
    np.testing.assert_allclose(right[[50, 100]], [[0, 29.682227392], [2.925686972, 22.974239189]], atol=1e-8)
    run = simulate(scenes.boost(), **EVENTS)
    assert off(run.at(np.arange(101) * 2e-5).x, right) <= 10 * RTOL
    modes = boost_modes()[:2]
    begin = orbit(*modes)[0]
    assert begin == pytest.approx([1.798495256184, 24.049923087413], rel=1e-11)
    run = simulate(scenes.boost(t_end=10 * 2e-5, x0=begin), **EVENTS)
    assert off(run.at(np.arange(11) * 2e-5).x, np.tile(begin, (11, 1))) <= 10 * RTOL
    assert [run.mean("x_0"), run.mean("x_1")] == pytest.approx([mean(modes, 0), mean(modes, 1)], rel=10 * RTOL)
    assert mean(modes, 1) == pytest.approx(23.994949181286, rel=1e-11)


# -- rectifiers --------------------------------------------------------------------------------------------------------


def test_a_half_wave_rectifier(load_case):
    model, mean_i = load_case("half_wave_rectifier"), 7.69229507448
    for options, tolerance in (({}, 1e-5), (EVENTS, 10 * RTOL)):
        run = simulate(model, **options)
        assert off(run.x, model.exact(run.t)) <= tolerance
        assert run.mean("i", 0, 0.02) == pytest.approx(mean_i, rel=tolerance)
    end = next(event.t for event in run.events if event.t > 0)
    assert end == pytest.approx(13.380394068e-3, rel=1e-9)
    assert mean_i == pytest.approx(325 * (1 - np.cos(100 * np.pi * end)) / (2 * np.pi * 10), rel=1e-9)
    assert np.abs(run.at(np.linspace(end * (1 + 1e-9), 0.02, 20)).x).max() <= 1e-14


def exact_full_wave(cycles):
    """v at the ends of half cycles, and from when to when the bridge conducts in the last one."""
    Vm, Rs, C, R, w, half = 17.0, 0.5, 1e-3, 50.0, 100 * np.pi, 0.01
    A = np.array([[-1 / (Rs * C) - 1 / (R * C), Vm / (Rs * C), 0], [0, 0, w], [0, -w, 0]])
    v, rows, on, ends = 0.0, [0.0], 0.0, 0.0
    for _ in range(cycles):
        on = brentq(lambda s, v=v: Vm * np.sin(w * s) - v * np.exp(-s / (R * C)), 0, half / 2, xtol=1e-17) if v else 0.0
        start = np.array([v * np.exp(-on / (R * C)), np.sin(w * on), np.cos(w * on)])

        def at(s, start=start, on=on):
            return expm(A * (s - on)) @ start

        ends = brentq(lambda s: Vm * np.sin(w * s) - at(s)[0], on + 1e-3, half, xtol=1e-17)
        v = at(ends)[0] * np.exp(-(half - ends) / (R * C))
        rows.append(v)
    return np.array(rows), on, ends


def test_a_full_wave_rectifier_with_a_capacitor(load_case):
    v, on, ends = exact_full_wave(4)
    np.testing.assert_allclose(v[1:4], [15.228397762098, 15.239130236563, 15.239189527448], rtol=1e-11)
    for options, tolerance in (({}, 1e-3), (EVENTS, 10 * RTOL)):
        run = simulate(load_case("full_wave_rectifier"), **options)
        rows = run.at(np.arange(5) * 0.01).x if options else run.x[:: len(run) // 4]
        assert off(rows, v[:, None]) <= tolerance
    found = np.array([event.t for event in run.events])
    for right in (0.03 + on, 0.03 + ends):
        assert np.abs(found - right).min() <= 10 * RTOL * 0.04


@pytest.mark.parametrize("alpha", [30, 60, 90, 120])
def test_a_thyristor_on_a_coil(alpha, load_case):
    Vm, R, L, w, a = 325.0, 10.0, 0.05, 100 * np.pi, np.radians(alpha)
    steady = Vm / (R + 1j * w * L)

    def current(b):
        return (steady * (np.exp(1j * b) - np.exp(1j * a - (b - a) * R / (w * L)))).imag

    beta = brentq(current, np.pi, 2 * np.pi - 1e-3)
    run = simulate(load_case("thyristor"), inputs={"gate": pwm(0.02, 0.02, phase=a / w)}, t_end=0.02, **EVENTS)
    assert run.at(8e-3).x.item() == pytest.approx(current(w * 8e-3), rel=10 * RTOL)
    assert R * run.mean("i") == pytest.approx(Vm * (np.cos(a) - np.cos(beta)) / (2 * np.pi), rel=10 * RTOL)
    turned = run.t[np.flatnonzero(np.diff(run.q))]
    assert turned * w == pytest.approx([a, beta], rel=10 * RTOL)
    assert run.i[-1] == 0


@pytest.mark.parametrize("alpha", [30, 60, 90])
def test_a_bridge_of_thyristors_on_a_resistor(alpha):
    """Each pair is fired in its half wave, and conducts until the voltage changes its sign."""
    a, w, t = np.radians(alpha), 100 * np.pi, ca.SX.sym("t")
    x, p, n, gp, gn = (ca.SX.sym(name) for name in ("charge", "p", "n", "gate_p", "gate_n"))
    mains = 325 * ca.sin(w * t)
    model = FirstOrderSystem(
        t=t, x=x, f=[(p - n) * mains / 10], x0=[0], t_end=0.04, step=1e-4,
        inputs={gp: pwm(0.02, 0.01, phase=a / w), gn: pwm(0.02, 0.01, phase=a / w + 0.01)},
        blocks=[thyristor(p, gp, mains), thyristor(n, gn, -mains)], outputs={"across": (p - n) * mains},
    )  # fmt: skip
    run = simulate(model, **EVENTS)
    assert run.mean("across") == pytest.approx(325 * (1 + np.cos(a)) / np.pi, rel=10 * RTOL)


def test_a_bridge_of_thyristors_on_a_coil():
    """Continuous current: a pair that is fired takes it over from the other."""
    Vm, R, L, w, a = 325.0, 10.0, 0.2, 100 * np.pi, np.pi / 4
    steady, fades = (Vm / (R + 1j * w * L) * np.exp(1j * a)).imag, np.exp(-np.pi * R / (w * L))
    start = -steady * (1 + fades) / (1 - fades)
    assert start == pytest.approx(12.2466921638, rel=1e-10)
    t, i, s = ca.SX.sym("t"), ca.SX.sym("i"), ca.SX.sym("s")
    v = s * Vm * ca.sin(w * t + a)
    model = LureSystem(
        t=t, x=i, A=[[-R / L]], B=[1 / L], C=[1], f=[v / L], law=complementarity(1), x0=[start], theta=0.5, t_end=0.04,
        step=1e-4, inputs={s: pwm(0.02, 0.5, low=-1)}, outputs={"across": v},
    )  # fmt: skip
    run = simulate(model, **EVENTS)
    assert run.at(np.arange(5) * 0.01).x == pytest.approx(np.full((5, 1), start), rel=10 * RTOL)
    assert run.mean("across") == pytest.approx(2 * Vm * np.cos(a) / np.pi, rel=10 * RTOL)
    assert run.mean("i") == pytest.approx(14.6301401376, rel=10 * RTOL)
    assert off(simulate(model).x[::100], np.full((5, 1), start)) <= 1e-3


# -- switches and controllers ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stem", ["thermostat", "schmitt_trigger", "bang_bang", "thyristor"])
def test_a_case_with_switches_is_its_closed_form_by_pieces(stem, load_case):
    model = load_case(stem)
    run = simulate(model, **EVENTS)
    assert off(run.x, model.exact(run.t)) <= 10 * RTOL


def test_a_sampled_thermostat_has_a_wider_band():
    run = simulate(thermostat(period=0.05, t_end=20), **EVENTS)
    turns = run.t[np.flatnonzero(np.diff(run.u))]
    assert turns[:4] == pytest.approx([0.75, 1.05, 1.35, 1.65])
    x = run.at(np.arange(100, 401) * 0.05).x
    assert [x.min(), x.max()] == pytest.approx([18.877114973128, 21.134808357014], rel=10 * RTOL)


def test_an_over_current_latch_by_pieces():
    run = simulate(over_current(), **EVENTS)
    assert off(run.at(np.arange(201) * 2e-3).x[:, 0], exact_over_current()[0]) <= 10 * RTOL


def sliding(h, implicit):
    """x and w at the samples, the plant exactly."""
    x, rows, held = 1.0, [1.0], []
    for k in range(round(10 / h)):
        w = np.clip(-x / h, -1, 1) if implicit else -np.sign(x)
        x += h * w + 0.5 * (np.cos(k * h) - np.cos((k + 1) * h))
        rows.append(x)
        held.append(w)
    return np.array(rows), np.array(held)


LATE = {  # largest |x| and variation of w on [5, 10]
    (0.1, False): (0.136961241309, 74), (0.05, False): (0.073022289719, 144),
    (0.1, True): (0.049978773101, 1.69150013962), (0.05, True): (0.024991874547, 1.72226761978),
}  # fmt: skip


@pytest.mark.parametrize(("h", "implicit"), LATE)
def test_sampled_sliding_mode(h, implicit, load_case):
    x, w = sliding(h, implicit)
    late = round(5 / h)
    assert (np.abs(x[late:]).max(), np.abs(np.diff(w[late:])).sum()) == pytest.approx(LATE[h, implicit], rel=1e-10)
    model = load_case("sliding_mode", h=h, implicit=implicit)
    run = simulate(model, **EVENTS)
    assert off(run.at(np.arange(x.size) * h).x[:, 0], x) <= 10 * RTOL
    run = simulate(model)
    assert off(run.x[::10, 0], x) <= 1e-3
    if implicit:
        assert np.abs(run.x[late * 10 :: 10]).max() <= h / 2


# -- inputs that are given ---------------------------------------------------------------------------------------------


def test_implicit_euler_errs_on_a_double_integrator_by_what_is_known():
    values, h = np.random.default_rng(7).integers(-3, 4, 50), 0.1
    model = scenes.double_integrator(values, h)
    euler = LureSystem(
        A=[[0, 1], [0, 0]], B=[0, 1], C=[0, 1], f=[0, u := ca.SX.sym("u")], law=relay(1, 0, 0), x0=[0, 0], theta=1,
        inputs={u: steps(values)}, t_end=5, step=h,
    )  # fmt: skip
    more = simulate(euler).x - simulate(model).x
    np.testing.assert_allclose(more[:, 0], np.r_[0, np.cumsum(values)] * h**2 / 2, atol=1e-13)
    np.testing.assert_allclose(more[:, 1], 0, atol=1e-13)


def test_a_drive_cycle_is_pieces_of_parabolas(load_case):
    """Over each stretch of the polyline and each side of friction v is a parabola, which three values tell."""
    run = simulate(load_case("drive_cycle"), **EVENTS)
    for a, b in zip(run.t[:-1], run.t[1:], strict=True):
        t = np.linspace(a, b, 5)[1:-1]
        u = np.interp(t, scenes.CYCLE[:, 0], scenes.CYCLE[:, 1])
        v = run.at(t).x[:, 0]
        force = (u[0] + u[2]) / 2 - np.sign(v[1]) if v[1] else 0
        assert v[2] - v[0] == pytest.approx(force / 1.2 * (t[2] - t[0]), abs=1e-12)
    assert run.x[-1] == pytest.approx([1.636363636364, 8.446749628838], rel=10 * RTOL)
