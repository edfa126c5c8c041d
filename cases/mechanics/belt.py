"""A block on a moving belt, held by a spring, sticks and slips, as friction falls with the speed of slip.

    p' = v,    v' = -p + d (v - V) - F Sgn(v - V)

What to see: the block rides on the belt, v = V exactly, until the spring tears it off at p = F; it swings back and is
caught again at p = 0.265. A limit cycle that is reached at once, for each slip begins in the same state: its period is
6.737 s, 5.267 s of it slip.

A wrong answer: without stick each swing would be exp(pi d/w) = 1.88 times as large as the last, without bound; here all
are the same. Where friction is smoothed the block slips back while it should ride: v is below V, the more the nearer p is
to F.

Source: Popp and Stelter, Stick-slip vibrations and chaos (1990), here with a straight characteristic; closed form.
"""

import numpy as np
from scipy.optimize import brentq

from nsmodel import LureSystem, relay

F, d, V = 1.0, 0.2, 0.5  # N/kg, 1/s, m/s; the spring has w = 1 rad/s
w, middle = np.sqrt(1 - d**2 / 4), F - d * V


def slip(tau):
    """Return x and v (2, ...) at the time tau after the spring tore the block off the belt."""
    start, speed = d * V, V
    cos, sin, grow = np.cos(w * tau), np.sin(w * tau), np.exp(d * tau / 2)
    x = grow * (start * cos + (speed - d / 2 * start) / w * sin)
    v = grow * (speed * cos + (d / 2 * speed - start) / w * sin)
    return np.array([middle + x, v])


caught = brentq(lambda tau: slip(tau)[1] - V, np.pi, 2 * np.pi, xtol=1e-14)
period = caught + (F - slip(caught)[0]) / V


def exact(t):
    """Return the state (N, 2): on the belt from x = 0 on, then slip and stick in turn."""
    since = np.asarray(t, float) - F / V
    tau = np.where(since > 0, since % period, since)
    on = (tau < 0) | (tau > caught)
    x = np.where(tau < 0, F + V * tau, F + V * (tau - period))
    return np.where(on, [x, np.full_like(x, V)], slip(tau)).T


model = LureSystem(
    A=[[0, 1], [-1, d]],
    B=[0, F],
    C=[0, 1],
    f=[0, -d * V],
    e=[-V],
    law={"friction": relay(1)},
    x0=[0, V],
    t_end=30,
    step=5e-3,
    theta=0.5,
    names=["p", "v"],
    units={"t": "s", "p": "m", "v": "m/s"},
    exact=exact,
    title="Stick-slip on a belt",
)
