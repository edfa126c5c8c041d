"""Scenes with switches whose solutions are known otherwise: closed forms, matrix exponentials, 113-bit references."""

import casadi as ca
import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq

from nsmodel import FirstOrderSystem, LureSystem, SweepingProcess, complementarity, relay

t = ca.SX.sym("t")
MAINS = {"L": 1e-3, "Rs": 0.5, "C": 470e-6, "R": 100.0}


def release(s):
    """x' = s t + l, l in -Sgn x: stick until s t = 1, then x = s (t - 1/s)^2 / 2."""
    model = LureSystem(t=t, A=[[0]], B=[[1]], C=[[1]], f=[s * t], law=relay(1), x0=[0], t_end=2)
    return model, lambda at: (s * np.maximum(at - 1 / s, 0) ** 2 / 2)[:, None], [1 / s]


def play():
    """q' = 0 with u - 1/2 <= q <= u + 1/2, u = 2 sin t exp(-t/10): between extremes of u, q is clipped."""
    q, u = ca.SX.sym("q"), 2 * ca.sin(t) * ca.exp(-t / 10)
    model = SweepingProcess(t=t, q=q, f=[0], constraints={"low": q - u + 0.5, "high": u + 0.5 - q}, q0=[0], t_end=20)
    turns = np.arctan(10) + np.pi * np.arange(8)

    def exact(at):
        value = lambda s: 2 * np.sin(s) * np.exp(-s / 10)  # noqa: E731
        rows = np.zeros((len(at), 1))
        for k, end in enumerate(at):
            for s in [*turns[turns < end], end]:
                rows[k] = min(max(rows[k, 0], value(s) - 0.5), value(s) + 0.5)
        return rows

    return model, exact, None


def diode():
    """LC oscillator, a resistor behind a diode: two linear arcs, joined where v_C changes its sign."""
    L, C, R = 1e-2, 1e-6, 1e3
    free = np.array([[0, -1 / C], [1 / L, 0]])
    damped = np.array([[-1 / (R * C), -1 / C], [1 / L, 0]])
    model = LureSystem(A=free, B=[-1 / C, 0], C=[-1, 0], D=R, law=complementarity(1), x0=[10, 0], t_end=5e-3)
    start, x, arcs = 0.0, np.array([10.0, 0.0]), []
    while start < 5e-3:
        # l = (y + v_C)/R >= 0 where v_C > 0: y = R l - v_C = 0 there
        A = damped if x[0] > 1e-9 or (abs(x[0]) <= 1e-9 and x[1] < 0) else free
        grid = np.linspace(0, 8e-4, 4001)[1:]

        def voltage(s, A=A, x=x):
            return (expm(A * s) @ x)[0]

        values = [voltage(s) for s in grid[::40]]
        sign = 1 if A is damped else -1
        hit = next((k for k, v in enumerate(values) if sign * v < 0 and k > 0), None)
        length = np.inf if hit is None else brentq(voltage, grid[::40][hit - 1], grid[::40][hit], xtol=1e-19)
        arcs.append((start, A, x))
        start, x = start + length, expm(A * min(length, 1)) @ x

    def exact(at):
        rows = []
        for s in at:
            begin, A, x = next(arc for arc in reversed(arcs) if arc[0] <= s)
            rows.append(expm(A * (s - begin)) @ x)
        return np.array(rows)

    return model, exact, [begin for begin, *_ in arcs[1:]]


def mains_bridge():
    """A bridge with a capacitor behind an inductance, from rest."""
    L, Rs, C, R = MAINS.values()
    return LureSystem(
        t=t, A=[[-Rs / L, 0], [0, -1 / (R * C)]], B=[[-1 / L, 1 / L, 0, 0], [0, 0, 1 / C, 1 / C]],
        C=[[-1, 0], [1, 0], [0, 1], [0, 1]], D=[[0, 0, 1, 0], [0, 0, 0, 1], [-1, 0, 0, 0], [0, -1, 0, 0]],
        f=[325 * ca.sin(100 * np.pi * t) / L, 0], law=complementarity(4), x0=[0, 0], t_end=0.1,
    )  # fmt: skip


def pendulums():
    """Two pendulums with dry friction at their joints, driven."""
    x, l = ca.SX.sym("x", 4), ca.SX.sym("l", 2)
    f = [
        x[2], x[3], -4 * ca.sin(x[0]) - ca.sin(x[0] - x[1]) - 0.1 * x[2] * ca.exp(-(x[2] ** 2)) + 3 * ca.cos(1.3 * t),
        -4 * ca.sin(x[1]) - ca.sin(x[1] - x[0]) + x[0] * x[1] / (1 + x[0] ** 2),
    ]  # fmt: skip
    return FirstOrderSystem(
        t=t, x=x, lam=l, f=f, g=[0, 0, l[0], l[1]], h=[x[2], x[3]], law=relay(2, -0.5, 0.5), x0=[1, -0.5, 0, 0], t_end=30
    )


def stiff_relay(mu):
    """A relay through an actuator with the rate mu."""
    A = [[0, 1, 0, 0], [0, 0, 1, 0], [0, -3, -2, 1], [0, 0, 0, -mu]]
    return LureSystem(A=A, B=[0, 0, 0, mu], C=[1, 0, 0, 0], law=relay(1), x0=[0.3, 0.5, 0, 0], t_end=20)


def twisting():
    """x'' = -2 sgn x - sgn x': the switches accumulate."""
    return LureSystem(A=[[0, 1], [0, 0]], B=[[0, 0], [2, 1]], C=[[1, 0], [0, 1]], law=relay(2), x0=[1, 0], t_end=10)


def relay_of_degree_2(damping, t_end):
    """x'' + damping x' = -sgn x, from (1, 0)."""
    return LureSystem(A=[[0, 1], [0, -damping]], B=[[0], [1]], C=[[1, 0]], law=relay(1), x0=[1, 0], t_end=t_end)


def grazing(depth):
    """x'' = -x beside a soft wall that is touched by ``depth``."""
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l")
    return FirstOrderSystem(
        x=x, lam=l, f=[x[1], -x[0]], g=[0, -l], h=[1 - depth - x[0] + 0.01 * l], law=complementarity(1), x0=[0, 1], t_end=6
    )


def brief_contact(w, start):
    """Two oscillators (1, w) and a soft wall x_4 that the sum of their places touches."""
    x, l = ca.SX.sym("x", 5), ca.SX.sym("l")
    return FirstOrderSystem(
        x=x, lam=l, f=[x[1], -x[0], x[3], -(w**2) * x[2], 0], g=[0, -l, 0, 0, 0], h=[x[4] - x[0] - x[2] + 0.01 * l],
        law=complementarity(1), x0=start, t_end=20,
    )  # fmt: skip


def capacitor_filter():
    """A diode bridge with a capacitor, charged at once at the start: x jumps."""
    L, C, R, Cf = 1e-2, 1e-6, 1e3, 3e-7
    return LureSystem(
        A=[[0, -1 / C, 0], [1 / L, 0, 0], [0, 0, -1 / (R * Cf)]],
        B=[[0, 0, -1 / C, 1 / C], [0, 0, 0, 0], [1 / Cf, 0, 1 / Cf, 0]],
        C=[[0, 0, 1], [0, 0, 0], [-1, 0, 1], [1, 0, 0]],
        D=[[0, -1, 0, 0], [1, 0, 1, -1], [0, -1, 0, 0], [0, 1, 0, 0]],
        law=complementarity(4), x0=[10, 0, 0], t_end=5e-3,
    )  # fmt: skip
