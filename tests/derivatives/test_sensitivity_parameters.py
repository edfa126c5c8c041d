"""Derivatives by parameters that numbers of signals are expressions of, beside those by the numbers and differences of runs."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from conftest import COUNT
from derivative_models import extrapolated, largest_error

from nsmodel import FirstOrderSystem, LureSystem, UsageError, complementarity, pwm, relay, sensitivity, table

A, B, F, U = (ca.SX.sym(name) for name in ("a", "b", "f", "u"))
L, C, R, T = 100e-6, 47e-6, 5.0, 10e-6
BY_DUTY = (16.8959515323, 18.9941766862)  # dx(10 T) of the buck converter, to the digits given.


def buck(signal, parameters=None, load=R):
    return LureSystem(
        A=[[0, -1 / L], [1 / C, -1 / (load * C)]], B=[1 / L, 0], C=[1, 0], f=[24 * U / L, 0], law=complementarity(1), x0=[0, 0],
        names=["i", "v"], inputs={U: signal}, parameters=parameters or {}, t_end=10 * T, step=T / 20,
    )  # fmt: skip


def test_the_duty_of_the_buck_converter():
    found = sensitivity(buck(pwm(T, A), {A: 0.4}), by="a", rtol=1e-12, compiled=False)
    np.testing.assert_allclose(found.jacobian[0, :, 0], BY_DUTY, rtol=1e-11)


def test_the_chain_rule_over_all_numbers():
    """By the numbers themselves, times how these move with the parameters."""
    numbers = sensitivity(buck(pwm(T, 0.4)), by=["u.duty", "u.period", "u.phase", "u.low", "u.high"], rtol=1e-12, compiled=False)
    duty, period, phase, low, high = numbers.jacobian[0].T
    written = pwm(1 / F, A**2 + B, phase=B / F, low=B * A, high=ca.exp(B))
    found = sensitivity(buck(written, {F: 1 / T, A: 0.4**0.5, B: 0.0}), by=["b", "f", "a"], rtol=1e-12, compiled=False)
    by_b, by_f, by_a = found.jacobian[0].T
    for one, wanted in (
        (by_f, -duty * 0 - period * T**2),
        (by_a, duty * 2 * 0.4**0.5),
        (by_b, duty + phase * T + low * 0.4**0.5 + high),
    ):
        np.testing.assert_allclose(one, wanted, rtol=1e-9, atol=1e-12 * np.abs(wanted).max())


def test_the_equations_and_the_edges_together():
    """x' = a u(t), u high in the first half of each period 1/f: x(t) = a (n/2 + min(r, 1/2))/f with n + r = f t."""
    model = FirstOrderSystem(
        x=ca.SX.sym("x"), f=[F * A * U], x0=[0], inputs={U: pwm(1 / F, 0.5)}, parameters={A: 3.0, F: 2.0}, t_end=2.0, step=0.1
    )
    t = np.array([0.1, 0.4, 0.9, 1.1, 1.8])
    found = sensitivity(model, by=["a", "f"], at=t, rtol=1e-12, compiled=False)
    n, r = np.divmod(2.0 * t, 1.0)
    np.testing.assert_allclose(found.jacobian[:, 0, 0], n / 2 + np.minimum(r, 0.5), rtol=1e-12)
    np.testing.assert_allclose(found.jacobian[:, 0, 1], 3.0 * np.where(r < 0.5, t, 0.0), atol=1e-12)
    edge = found.switches[0]
    np.testing.assert_allclose([edge.t, *edge.dt], [0.25, 0.0, -0.125], rtol=1e-12)


def random_model(seed):
    """Two states, a relay or a diode, a PWM that multiplies, all of its numbers of parameters that the equations read too."""
    rng = np.random.default_rng(seed)
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l")
    values = {A: float(rng.uniform(0.5, 1.5)), B: float(rng.uniform(0.2, 0.8)), F: float(rng.uniform(0.7, 1.6))}
    signal = pwm(
        ca.cos(0.3 * A) / F, 0.15 + 0.6 * B * ca.exp(-0.2 * A), phase=A * B, low=ca.sin(B * F) - 1, high=A + F,
        kind=("trailing", "leading", "centre")[seed % 3],
    )  # fmt: skip
    M, law = rng.normal(size=(2, 2)) - 1.5 * np.eye(2), complementarity(1) if seed % 2 else relay(1, -0.3 * B, 0.3 * B)
    f = ca.DM(M) @ x + ca.vertcat(A * U, 0.4 * U * x[0] + F * ca.DM(rng.normal()))
    model = FirstOrderSystem(
        x=x, lam=l, f=f, g=ca.vertcat(0, l), h=[x[1]], law=law, x0=[float(rng.normal()), 0.3], inputs={U: signal},
        parameters=values, t_end=3.3, step=0.01,
    )  # fmt: skip
    return model, ["f", "a", "b", "x_0(0)"]


@pytest.mark.parametrize("seed", range(max(3, COUNT // 4)))
def test_random_models_beside_differences(seed):
    model, by = random_model(seed)
    found = sensitivity(model, by=by, rtol=1e-11, compiled=False)
    error = largest_error(found, extrapolated(model, by))
    if error > 1e-6:  # A switch comes or goes within the width.
        error = min(error, 1e-2 * largest_error(found, extrapolated(model, by, width=2e-6)))
    assert error <= 1e-6 or found.warnings
    np.testing.assert_array_equal(sensitivity(model, by=by[::-1], rtol=1e-11, compiled=False).jacobian, found.jacobian[..., ::-1])


def test_numbers_that_are_left_and_numbers_that_follow():
    model = buck(pwm(1 / F, 0.4), {F: 1 / T})
    found = sensitivity(model, by=["u.duty", "f"], rtol=1e-12, compiled=False)
    np.testing.assert_allclose(found.jacobian[0, :, 0], BY_DUTY, rtol=1e-11)
    with pytest.raises(
        UsageError, match=r"'u.period' is not a parameter, start or number .*there are f, .*u.duty, u.phase, u.low"
    ):
        sensitivity(model, by="u.period")
    run = found.as_function()
    np.testing.assert_allclose(np.array(run([0.3, 1.1 / T])).ravel(), sensitivity(
        buck(pwm(T / 1.1, 0.3)), by="u.duty", rtol=1e-12, compiled=False).run.x[-1], rtol=1e-10)  # fmt: skip


def test_what_moves_and_has_no_derivative_is_refused():
    model = buck(pwm(1 / F, table([0, 5 * T], [0.4, 0.5]), high=A), {F: 1 / T, A: 1.0})
    near = sensitivity(model, by="a", rtol=1e-10, compiled=False).jacobian
    np.testing.assert_allclose(near, extrapolated(model, ["a"]), rtol=1e-7)
    with pytest.raises(UsageError, match=r"by: 'f' moves the period of input 'u', whose duty is not a number; take method='diff"):
        sensitivity(model, by=["f", "a"], compiled=False)
