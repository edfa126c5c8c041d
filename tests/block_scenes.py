"""Models with blocks, and their exact solutions by recursions: what `tests/modeling/test_blocks.py` compares runs with."""

from __future__ import annotations

import casadi as ca
import numpy as np
from input_scenes import VIN, T, flow
from scipy.optimize import brentq

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    complementarity,
    each_step,
    hysteresis,
    latch,
    pwm,
    relay,
    sampled,
    table,
    thyristor,
)

# -- a mass with dry friction and a sampled PI: m v' = w - b v - F Sgn(v)

TS, KP, KI = 0.05, 4.0, 6.0


def friction_pi(**fields):
    v, w, z, r = (ca.SX.sym(name) for name in "vwzr")
    e = r - v
    pi = sampled("pi", period=TS, memory={z: 0}, outputs={w: KP * e + z}, update={z: z + KI * TS * e})
    given = {"t_end": 200 * TS, "step": TS / 20, "theta": 0.5, "names": ["v"]} | fields
    return LureSystem(
        A=[[-0.5]], B=[[1]], C=[[1]], f=[w], law=relay(1, -1, 1), x=v, x0=[0], inputs={r: table([0, 4, 6], [1, 0, -0.5])},
        blocks=[pi], **given,
    )  # fmt: skip


def exact_friction_pi():
    """v and z at the samples: within a sample v is an exponential, passes 0 once at most, or stays there."""
    v, z, rows = 0.0, 0.0, [(0.0, 0.0)]
    for k in range(200):
        e = (1.0 if k * TS < 4 else 0.0 if k * TS < 6 else -0.5) - v
        w, z, t = KP * e + z, z + KI * TS * e, TS
        while t > 0:
            s = np.sign(v) if v else (0.0 if abs(w) <= 1 else np.sign(w))
            if s == 0:
                break
            goal = (w - s) / 0.5
            stop = 2 * np.log((v - goal) / -goal) if v and goal * s < 0 else np.inf
            if stop < t:
                v, t = 0.0, t - stop
            else:
                v, t = goal + (v - goal) * np.exp(-0.5 * t), 0.0
        rows.append((v, z))
    return np.array(rows)


# -- a buck converter whose duty a sampled PI sets


def regulated(kind="trailing", periods=60, duty=None, **fields):
    i, v, u, d, z = (ca.SX.sym(name) for name in "ivudz")
    L, C, R, e = 1e-4, 47e-6, 5.0, 9 - v
    pi = sampled("pi", period=T, memory={z: 0.3}, outputs={d: ca.fmin(ca.fmax(0.02 * e + z, 0), 0.9)}, update={z: z + 0.002 * e})
    given = {"theta": 0.5, "step": T / 20, "t_end": periods * T} | fields
    return LureSystem(
        x=ca.vertcat(i, v), A=[[0, -1 / L], [1 / C, -1 / (R * C)]], B=[1 / L, 0], C=[1, 0], f=[u * VIN / L, 0],
        law=complementarity(1), x0=[0, 0], inputs={u: pwm(T, d if duty is None else duty(d), kind=kind)}, blocks=[pi], **given,
    )  # fmt: skip


PARTS = {
    "trailing": lambda d: [(1, d), (0, 1 - d)],
    "leading": lambda d: [(0, 1 - d), (1, d)],
    "centre": lambda d: [(0, (1 - d) / 2), (1, d), (0, (1 - d) / 2)],
}


def exact_regulated(kind="trailing", periods=60):
    """(i, v) at 0, T, 2 T, ..."""
    L, C, R = 1e-4, 47e-6, 5.0
    A = np.array([[0, -1 / L], [1 / C, -1 / (R * C)]])
    x, z, rows = np.zeros(2), 0.3, [np.zeros(2)]
    for _ in range(periods):
        e = 9 - x[1]
        d, z = min(max(0.02 * e + z, 0), 0.9), z + 0.002 * e
        for u, share in PARTS[kind](d):
            x = _through(A, x, u, share * T)
        rows.append(x)
    return np.array(rows)


def _through(A, x, u, t):
    def at(s):
        P, g = flow(A, np.array([VIN / 1e-4 * u, 0.0]), s)
        return P @ x + g

    if u or at(t)[0] >= 0:
        return at(t)
    stop = brentq(lambda s: at(s)[0], 0, t, xtol=1e-20, rtol=1e-15) if x[0] > 0 else 0.0
    return np.array([0.0, at(stop)[1] * np.exp(A[1, 1] * (t - stop))])


def pushed(kind, gamma):
    """A mass on a rough floor, pushed by a PWM whose duty a PI sets; a block counts the steps that begin in a pulse."""
    v, u, d, z, n = (ca.SX.sym(name) for name in "vudzn")
    pi = sampled(
        "pi", period=0.1, memory={z: 0.3}, outputs={d: ca.fmin(ca.fmax(0.5 * (1 - v) + z, 0), 1)}, update={z: z + 0.05 * (1 - v)}
    )
    return LureSystem(
        x=v, A=[[-0.5]], B=[[1]], C=[[1]], f=[4 * u], law=relay(1), x0=[0], theta=0.5, gamma=gamma, step=0.01, t_end=1,
        inputs={u: pwm(0.1, d, kind=kind)}, blocks=[pi, each_step("count", memory={n: 0}, update={n: n + u})],
    )  # fmt: skip


# -- an oscillator whose first step is known, a chain with sparse matrices


def begun():
    """An integral control of a rubbing oscillator, from two positions on; a block counts steps."""
    x, s, w, z, n = (ca.SX.sym(name) for name in "xswzn")
    control = sampled("control", period=0.1, memory={z: 1}, outputs={w: z - x}, update={z: z + 0.1 * x})
    return FrictionOscillator(
        x=x, potential=x**2, friction=0.3 * s, s=s, force=w, x0=[1], x1=[1.004], t_end=3, step=0.01,
        blocks=[control, each_step("count", memory={n: 0}, update={n: n + 1})],
    )  # fmt: skip


def chain(n=60):
    """Blocks on springs and a rough floor, the first one pushed less and less."""
    u, z, x = ca.SX.sym("u"), ca.SX.sym("z"), ca.SX.sym("x", n)
    return LureSystem(
        x=x, A=-2 * np.eye(n) + np.eye(n, k=1) + np.eye(n, k=-1), B=np.eye(n), C=np.eye(n), f=[u - z] + [0] * (n - 1),
        law=relay(n), x0=[0] * n, t_end=1, step=0.01, inputs={u: 1.5},
        blocks=[sampled("tired", period=0.1, memory={z: 0}, update={z: z + x[0]})],
    )  # fmt: skip


# -- switches


def thermostat(period=None, **fields):
    """T' = (5 + 30 u - T)/2, u on below 19 and off above 21."""
    x, u = ca.SX.sym("T"), ca.SX.sym("u")
    given = {"t_end": 3, "step": 1e-3, "theta": 0.5} | fields
    return FirstOrderSystem(
        x=x, f=[(5 + 30 * u - x) / 2], x0=[15], blocks=[hysteresis(u, x, 19, 21, start=1, period=period)], **given
    )


def schmitt(**fields):
    """RC v' = s V - v, s falls to -1 at v = V/2 and rises to +1 at -V/2."""
    v, s = ca.SX.sym("v"), ca.SX.sym("s")
    given = {"t_end": 0.05, "step": 1e-5, "theta": 0.5} | fields
    switch = hysteresis(s, v, -2.5, 2.5, start=1, below=1, above=-1)
    return FirstOrderSystem(x=v, f=[(5 * s - v) / 1e-2], x0=[0], blocks=[switch], **given)


def over_current(**fields):
    """L i' = 10 q - R i: q falls where i >= 4 is read, every 2 ms, and rises at the reset."""
    i, q, r = ca.SX.sym("i"), ca.SX.sym("q"), ca.SX.sym("reset")
    given = {"t_end": 0.4, "step": 1e-4, "theta": 0.5} | fields
    return FirstOrderSystem(
        x=i, f=[(10 * q - 2 * i) / 0.1], x0=[0], inputs={r: table([0, 0.2, 0.2001], [0, 1, 0])},
        blocks=[latch(q, r, i - 4, start=1, period=2e-3)], **given,
    )  # fmt: skip


def exact_over_current():
    """i at the samples, and the numbers of those at which q changes."""
    i, q, rows, turns = 0.0, 1, [0.0], []
    for k in range(200):
        now = 0 if i >= 4 else 1 if k == 100 else q
        if now != q:
            turns.append(k)
        q = now
        i = 5 * q + (i - 5 * q) * np.exp(-20 * 2e-3)
        rows.append(i)
    return np.array(rows), turns


VM, R, L, W = 325.0, 10.0, 0.05, 100 * np.pi


def fired(alpha, **fields):
    """A thyristor, R and L on sin wt, fired at the angle alpha: q conducts until i = 0."""
    t, i, q, g = (ca.SX.sym(name) for name in ("t", "i", "q", "gate"))
    at = alpha / 360 * 0.02
    given = {"t_end": 0.02, "step": 1e-5, "theta": 0.5} | fields
    return FirstOrderSystem(
        t=t, x=i, f=[q * (VM * ca.sin(W * t) - R * i) / L], x0=[0], inputs={g: table([0, at, at + 2e-4], [0, 1, 0])},
        blocks=[thyristor(q, g, i)], **given,
    )  # fmt: skip


def fired_current(alpha):
    """i as a function of the angle in degrees, and the angle at which it is 0 again."""
    p, a0 = np.arctan2(W * L, R), np.radians(alpha)

    def i(degrees):
        a = np.radians(degrees)
        return VM / np.hypot(R, W * L) * (np.sin(a - p) - np.sin(a0 - p) * np.exp(-(a - a0) / np.tan(p)))

    return i, brentq(i, 181, 330, xtol=1e-12)
