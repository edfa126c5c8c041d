"""Derivatives of runs whose own are closed forms, or known to twelve digits from matrix exponentials and 40-digit arithmetic."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    SweepingProcess,
    ball,
    box,
    complementarity,
    pwm,
    relay,
    sensitivity,
)

A, K, D, MU, F, B = (ca.SX.sym(name) for name in ("a", "k", "d", "mu", "F", "b"))
T = ca.SX.sym("t")
INTERPRETED = {"compiled": False}


def friction(t_end=5.0):
    x, s = ca.SX.sym("x"), ca.SX.sym("s")
    return FrictionOscillator(x=x, potential=K * x**2 / 2, s=s, friction=A * ca.fabs(s), x0=[5.3], v0=[0.0],
                              parameters={A: 1.0, K: 1.0}, t_end=t_end, step=0.01)  # fmt: skip


def relay_oscillator():
    matrix = ca.blockcat([[0, 1, 0], [0, 0, 1], [0, -K, -D]])
    return LureSystem(A=matrix, B=[0, 0, 1], C=[1, 0, 0], law=relay(1), x0=[0, 0.6752372371, 0], parameters={K: 3.0, D: 2.0},
                      t_end=10, step=0.01)  # fmt: skip


def buck():
    x, u, Vin, L = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("Vin"), ca.SX.sym("L")
    C, R, period = 47e-6, 5.0, 10e-6
    return LureSystem(x=x, A=ca.blockcat([[0, -1 / L], [1 / C, -1 / (R * C)]]), B=ca.vertcat(1 / L, 0), C=[1, 0],
                      f=ca.vertcat(u * Vin / L, 0), law=complementarity(1), x0=[0, 0], parameters={Vin: 24.0, L: 100e-6},
                      inputs={u: pwm(period, 0.4)}, t_end=10 * period, step=period / 20)  # fmt: skip


SCENES = {
    "friction": (friction(), ["a", "k", "x(0)"], "x", (-1.85098655639, 7.36480113570, 0.283662185463)),
    "friction at rest": (friction(12.0), ["a", "k", "x(0)"], "x", (6.0, -6.0, -1.0)),
    "relay": (relay_oscillator(), ["x_1(0)", "k", "d"], "x_0", (0.3764709968146, -0.3748396289869, 0.2857269715732)),
    "buck, i": (buck(), ["u.duty", "Vin", "L"], "x_0", (16.89595153227, 0.27514628620819, -39324.694442)),
    "buck, v": (buck(), ["u.duty", "Vin", "L"], "x_1", (18.99417668619, 0.3256244290006, -63422.402197)),
}


@pytest.mark.parametrize("rtol", [1e-4, 1e-6, 1e-8, 1e-10, 1e-12])
@pytest.mark.parametrize("name", SCENES)
def test_known_to_twelve_digits(name, rtol):
    model, by, output, exact = SCENES[name]
    found = sensitivity(model, by=by, outputs=output, rtol=rtol, **INTERPRETED).jacobian[0, 0]
    np.testing.assert_allclose(found, exact, rtol=max(rtol, 2e-11))


def test_times_of_switches():
    found = sensitivity(friction(), by=["a", "k", "x(0)"], rtol=1e-10, **INTERPRETED)
    (turn,) = found.switches
    assert turn.name == found.run.metadata["multiplier_names"][0]
    np.testing.assert_allclose(turn.dt, [0, -math.pi / 2, 0], atol=1e-9)
    rest = sensitivity(friction(12.0), by="k", rtol=1e-10, **INTERPRETED).switches
    np.testing.assert_allclose([one.dt[0] for one in rest], [-math.pi / 2 * n for n in (1, 2, 3)], atol=1e-9)


def test_crossing():
    model = LureSystem(A=[[0]], B=[1], C=[1], f=[2], law=relay(1), x0=[-1.0], t_end=2.0, step=0.1)
    found = sensitivity(model, by="x(0)", **INTERPRETED)
    np.testing.assert_allclose(
        [found.value[0, 0], found.jacobian[0, 0, 0], found.switches[0].dt[0]], [5 / 3, 1 / 3, -1 / 3], rtol=1e-12
    )


@pytest.mark.parametrize(("t_end", "exact"), [(2.0, (0.0, 2.0)), (0.3, (1.0, 0.0))])
def test_a_slide_forgets_where_it_came_from(t_end, exact):
    x, y0 = ca.SX.sym("x", 2), 1.0
    l = ca.SX.sym("l")
    model = FirstOrderSystem(x=x, lam=l, f=[1, 0], g=[0, 2 * l], h=x[1] - B * x[0], law=relay(1), x0=[0.0, y0],
                             parameters={B: 0.5}, t_end=t_end, step=0.1)  # fmt: skip
    found = sensitivity(model, by=["x_1(0)", "b"], outputs="x_1", **INTERPRETED)
    np.testing.assert_allclose(found.jacobian[0, 0], exact, atol=1e-12)


def test_leaving_stick_at_a_slow_force():
    x, s = ca.SX.sym("x"), ca.SX.sym("s")
    model = FrictionOscillator(x=x, potential=0 * x, s=s, friction=MU * ca.fabs(s), force=F * T, t=T, x0=[0.0], v0=[0.0],
                               parameters={MU: 1.0, F: 2.0}, t_end=1.5, step=0.01)  # fmt: skip
    found = sensitivity(model, by=["mu", "F"], outputs="x", rtol=1e-10, **INTERPRETED)
    np.testing.assert_allclose(found.jacobian[0, 0], [-1 / 2, 5 / 12], rtol=1e-10)
    np.testing.assert_allclose(found.switches[-1].dt[0], 1 / 2, rtol=1e-10)


def test_play_touches_follows_and_rests():
    q = ca.SX.sym("q")
    model = SweepingProcess(q=q, f=[0], constraints={"floor": q - A * ca.sin(T)}, t=T, q0=[0.4], parameters={A: 1.0}, t_end=2.0,
                            step=0.01)  # fmt: skip
    found = sensitivity(model, by=["a", "q(0)"], at=[0.3, 1.0, 2.0], rtol=1e-10, **INTERPRETED)
    np.testing.assert_allclose(found.of("q"), [[0, 1], [math.sin(1), 0], [1, 0]], atol=1e-10)


def test_a_circuit_with_a_resistor_behind_a_diode():
    """Scaled by the numbers: R dv/dR, C dv/dC, dv/dv0 at 0.9 ms."""
    R, C = ca.SX.sym("R"), ca.SX.sym("C")
    matrix = ca.blockcat([[0, -1 / C], [1 / 10e-3, 0]])
    model = LureSystem(names=["v", "i"], A=matrix, B=ca.vertcat(-1 / C, 0), C=[-1, 0], D=R, law=complementarity(1),
                       x0=[10.0, 0.0], parameters={R: 1000.0, C: 1e-6}, t_end=0.9e-3, step=1e-6)  # fmt: skip
    found = sensitivity(model, by=["R", "C", "v(0)"], outputs="v", rtol=1e-12, **INTERPRETED)
    assert found.value[0, 0] == pytest.approx(-7.3516802, abs=1e-7)
    scaled = found.jacobian[0, 0] * [1000.0, 1e-6, 1.0]
    np.testing.assert_allclose(scaled, [-1.58880733, 12.44206063, -0.73516802], atol=1e-8)


def test_a_run_that_rests_has_derivatives_that_move():
    """x' = -100 (x - 1), x(0) = 1 is one piece for all times."""
    model = LureSystem(A=[[-100, 0], [0, 0]], B=[0, 1], C=[0, 1], f=[100, 0.5], law=relay(1), x0=[1.0, 1.0], t_end=1.5, step=0.01)
    found = sensitivity(model, by="x_0(0)", at=[0.02, 0.1, 1.5], outputs="x_0", **INTERPRETED)
    np.testing.assert_allclose(found.jacobian.ravel(), np.exp([-2.0, -10.0, -150.0]), rtol=1e-7)


def test_stiff_modes_by_collocation():
    """x_0 follows x_1 within 1e-6: dx_0/dk is that of the slow one, and k/(1e6 + k) beside it."""
    model = LureSystem(A=ca.blockcat([[-1e6, 1e6], [0, -K]]), B=[0, 1], C=[0, 1], law=box(-0.1, 0.1), x0=[1.0, 1.0],
                       parameters={K: 1.0}, t_end=1.0, step=0.01)  # fmt: skip
    found = sensitivity(model, by=["k", "x_1(0)"], rtol=1e-8, **INTERPRETED)
    slow = found.of("x_1")[0]
    np.testing.assert_allclose(found.of("x_0")[0], slow, rtol=1e-5)
    np.testing.assert_allclose(slow[1], math.exp(-1.0), rtol=1e-8)


def test_integrals_and_multipliers():
    """The work of friction over a half swing is 2 a (x0 - a/k), the multiplier's derivative by its own end 1."""
    x, v, push = (ca.SX.sym(name) for name in ("x", "v", "friction"))
    found = sensitivity(friction(math.pi), by=["a", "k", "x(0)"], at=3.0, outputs=["friction", x], integrals={"work": push * v},
                        rtol=1e-10, **INTERPRETED)  # fmt: skip
    assert found.outputs == ("friction", "x", "work")
    t, a, x0 = 3.0, 1.0, 5.3
    moved = (a / 1 - x0) * (1 - math.cos(t))  # x(t) - x0 with k = 1
    assert abs(found.value[0, 2]) == pytest.approx(abs(a * moved), rel=1e-9)
    np.testing.assert_allclose(np.abs(found.jacobian[0, 0]), [1, 0, 0], atol=1e-12)
    sign = np.sign(found.value[0, 2]) / np.sign(moved)
    np.testing.assert_allclose(
        found.jacobian[0, 2, [0, 2]], sign * np.array([moved + a * (1 - math.cos(t)), -a * (1 - math.cos(t))]), rtol=1e-9
    )


def disc_on_a_slope(pull):
    x, l, pulls = ca.SX.sym("x", 4), ca.SX.sym("l", 2), [ca.SX.sym("F_0"), ca.SX.sym("F_1")]
    return FirstOrderSystem(x=x, lam=l, f=[x[2], x[3], *pulls], g=ca.vertcat(0, 0, l), h=x[2:], law=ball(2, 0.8),
                            x0=[0, 0, 0.6, -0.5], parameters=dict(zip(pulls, pull, strict=True)), t_end=60, step=0.1)  # fmt: skip


def stop_of_the_disc(numbers):
    """When and where it stops, from (r|v| + F v)' = F^2 - r^2, (|v|^2)' = 4 F v - 2 (r|v| + F v) and the same across F."""
    F, v, r = numbers[:2], numbers[2:], 0.8
    across, size, k = ca.vertcat(-F[1], F[0]), ca.norm_2(v), r**2 - ca.sumsqr(F)
    both = r * size + ca.dot(F, v)
    along = (both**2 / k - size**2) / 4
    aside = ca.dot(across, v) * (2 * r * size + ca.dot(F, v)) / (4 * r**2 - ca.sumsqr(F))
    return ca.vertcat(both / k, (along * F + aside * across) / ca.sumsqr(F))


@pytest.mark.parametrize("rtol", [1e-6, 1e-9, 1e-12])
@pytest.mark.parametrize("pull", [(1e-3, 1e-3), (0.01, 0.02), (0.1, -0.05), (-0.3, 0.1), (0.5, 0.5), (0.7, 0.3)])
def test_a_disc_comes_to_rest(pull, rtol):
    """Beside a stop the direction of slip turns like (T - t)^(F/(r - F)), and tangents across it are drawn to 0 like 1/|v|."""
    names = ["F_0", "F_1", "x_2(0)", "x_3(0)"]
    found = sensitivity(disc_on_a_slope(pull), by=names, outputs=["x_0", "x_1"], rtol=rtol, **INTERPRETED)
    numbers = ca.SX.sym("numbers", 4)
    stop = stop_of_the_disc(numbers)
    value, slopes = (np.array(e) for e in ca.Function("stop", [numbers], [stop, ca.jacobian(stop, numbers)])([*pull, 0.6, -0.5]))
    (rest,) = found.switches
    assert rest.t == pytest.approx(value[0, 0], rel=10 * rtol)
    np.testing.assert_allclose(rest.dt, slopes[0], rtol=0, atol=max(30 * rtol, 1e-8) * np.abs(slopes[0]).max())
    np.testing.assert_allclose(found.jacobian[0], slopes[1:], rtol=0, atol=max(10 * rtol, 1e-10) * np.abs(slopes[1:]).max())


def test_two_rows_that_hold_all_states_leave_derivatives_of_rounding_alone():
    """x = 0 is held, by multipliers that cancel all of the push: dx/da is 0, and has no leading digit to resolve."""
    matrix, pull = np.array([[0.4, 1.1], [-0.3, 0.7]]), [ca.sin(T + B), A * ca.cos(1.3 * T)]
    model = LureSystem(A=ca.blockcat([[-A, A], [-A, -0.2]]), B=matrix.T, C=matrix, f=pull, law=relay(2, -9, 9), t=T,
                       x0=[0.3, 0.2], parameters={A: 0.7, B: 0.3}, t_end=4.0, step=0.01)  # fmt: skip
    found = sensitivity(model, by=["a", "b", "x_0(0)"], rtol=1e-11, **INTERPRETED)
    np.testing.assert_allclose(found.jacobian, 0, atol=1e-14)
