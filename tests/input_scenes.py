"""Models with inputs, and exact solutions by matrix exponentials: what `tests/modeling/test_inputs.py` compares runs with."""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq

from nsmodel import FirstOrderSystem, LureSystem, complementarity, equality, product, pwm, relay, steps, table

T, VIN = 1e-5, 24.0


def buck(R=5.0, duty=0.4, **fields):
    """x = (i, v): L i' = u Vin - v + l, C v' = i - v/R, 0 <= l ⟂ i >= 0."""
    L, C, u = 1e-4, 47e-6, ca.SX.sym("u")
    given = {"inputs": {u: pwm(T, duty)}, "theta": 0.5, "step": T / 20, "t_end": 200 * T, "x0": [0, 0]} | fields
    return LureSystem(
        A=[[0, -1 / L], [1 / C, -1 / (R * C)]], B=[1 / L, 0], C=[1, 0], f=[u * VIN / L, 0], law=complementarity(1),
        names=["i", "v"], **given,
    )  # fmt: skip


def flow(A, b, t):
    """x(t) = P x(0) + g of x' = A x + b."""
    n = len(b)
    E = expm(np.block([[A, np.reshape(b, (n, 1))], [np.zeros((1, n + 1))]]) * t)
    return E[:n, :n], E[:n, n]


@lru_cache
def exact_buck(periods, R=5.0, duty=0.4):
    """x at 0, T, 2 T, ...: the current held at 0 from where it falls to it until the switch closes again."""
    L, C = 1e-4, 47e-6
    A, b, off = np.array([[0, -1 / L], [1 / C, -1 / (R * C)]]), np.array([VIN / L, 0.0]), np.array([[0, 0], [0, -1 / (R * C)]])
    x, rows = np.zeros(2), [np.zeros(2)]
    for _ in range(periods):
        P, g = flow(A, b, duty * T)
        x, left = P @ x + g, (1 - duty) * T

        def current(t, x=x):
            P, g = flow(A, np.zeros(2), t)
            return (P @ x + g)[0]

        t = np.linspace(0, left, 41)[1:]
        below = [s for s in t if current(s) < 0]
        if below:
            at = brentq(current, below[0] - left / 40, below[0], xtol=1e-20, rtol=1e-15)
            P, _ = flow(A, np.zeros(2), at)
            x = np.array([0.0, (P @ x)[1] * np.exp(off[1, 1] * (left - at))])
        else:
            x = flow(A, np.zeros(2), left)[0] @ x
        rows.append(x)
    return np.array(rows)


def boost(**fields):
    """(s, l): L i' = Vin - s, C v' = l - v/R; u s + (1 - u)(i - l) = 0, 0 <= l ⟂ v - s >= 0; u multiplies unknowns."""
    L, C, R, Vin, period = 1e-4, 1e-4, 20.0, 12.0, 2e-5
    x, lam, u = ca.SX.sym("x", 2), ca.SX.sym("lam", 2), ca.SX.sym("u")
    (i, v), (s, l) = ca.vertsplit(x), ca.vertsplit(lam)
    given = {"inputs": {u: pwm(period, 0.5)}, "theta": 0.5, "gamma": 0.5, "step": period / 20, "t_end": 100 * period}
    given |= {"x0": [0, Vin]} | fields
    return FirstOrderSystem(
        x=x, lam=lam, f=[Vin / L, -v / (R * C)], g=[-s / L, l / C], h=[u * s + (1 - u) * (i - l), v - s],
        law=product(equality(1), complementarity(1)), **given,
    )  # fmt: skip


CYCLE = np.array([
    (0, 0), (2, 3), (4, 3), (5, -2.5), (7, -2.5), (8, 0), (10, 0), (11, -2), (13, -2), (14, 0.5), (16, 0.5), (17, 1.6), (20, 1.6)
])  # fmt: skip


def drive_cycle(signal=None, **fields):
    """m v' = u(t) - F Sgn(v), x' = v, with m = 1.2, F = 1 and a force given as a polyline."""
    u = ca.SX.sym("u")
    given = {"t_end": 20, "step": 1e-3} | fields
    return LureSystem(
        A=[[0, 0], [1, 0]], B=[1 / 1.2, 0], C=[1, 0], f=[u / 1.2, 0], law=relay(1), x0=[0, 0], names=["v", "s"],
        inputs={u: table(*CYCLE.T, "linear") if signal is None else signal}, **given,
    )  # fmt: skip


def follower(signal, **fields):
    """0.3 x' = u - x, x(0) = 0."""
    x, l, u = ca.SX.sym("x"), ca.SX.sym("l"), ca.SX.sym("u")
    return FirstOrderSystem(
        x=x, lam=l, f=[(u - x) / 0.3], g=[0], h=[l], law=equality(1), x0=[0], theta=0.5, inputs={u: signal}, **fields
    )


def double_integrator(values, h):
    """p'' = u, one value a step."""
    u = ca.SX.sym("u")
    return LureSystem(
        A=[[0, 1], [0, 0]], B=[0, 1], C=[0, 0], D=[[1]], f=[0, u], law=equality(1), x0=[0, 0], theta=0.5, names=["p", "v"],
        inputs={u: steps(values)}, t_end=h * len(values), step=h,
    )  # fmt: skip
