"""Twisting control: two relays bring a mass to rest at 0 in finite time, by infinitely many switches.

    p' = v,    v' = -a Sgn(p) - b Sgn(v),    a > b > 0

What to see: a spiral. At each passage of p = 0 the speed is half of what it was, r = sqrt((a - b)/(a + b)) = 1/2, and so
is the time to the next one: the switches accumulate at t = 3 s, and the mass is at rest from there on. With --rtol 1e-8
the switches are followed down to rounding.

A wrong answer: a mass that never stops. Relays computed from the last state chatter about 0, more widely the longer the
step; where they are smoothed the mass creeps; with the relay on v left out, b = 0, each passage is as fast as the first,
4 m/s.

Source: Levant, Sliding order and sliding accuracy in sliding mode control (1993); closed form. The relay on p does not
act on p', so no P > 0 has P B = C' (5.1 fails), and the theorem on well-posedness does not apply.
"""

import numpy as np

from nsmodel import LureSystem, relay

a, b, v0 = 5.0, 3.0, 4.0  # m/s^2, m/s^2, m/s
r = np.sqrt((a - b) / (a + b))
first = v0 / (a + b) + r * v0 / (a - b)  # from one passage of p = 0 to the next
stop = first / (1 - r)


def exact(t):
    """Return the state (N, 2): two parabolas of p between its passages of 0, then rest."""
    left = np.maximum(1 - np.asarray(t, float) / stop, 1e-300)
    k = np.floor(np.log(left) / np.log(r))  # passages so far; the k-th is at stop (1 - r^k)
    speed, tau = v0 * r**k, np.asarray(t) - stop * (1 - r**k)
    top = speed / (a + b)
    up, down = np.minimum(tau, top), np.maximum(tau - top, 0)
    p = speed * up - (a + b) * up**2 / 2 - (a - b) * down**2 / 2
    v = speed - (a + b) * up - (a - b) * down
    return np.where(left > 1e-300, (-1) ** k * np.array([p, v]), 0).T


model = LureSystem(
    A=[[0, 1], [0, 0]],
    B=[[0, 0], [a, b]],
    C=[[1, 0], [0, 1]],
    law={"on p": relay(1), "on v": relay(1)},
    x0=[0, v0],
    t_end=3.5,
    step=1e-3,
    names=["p", "v"],
    units={"t": "s", "p": "m", "v": "m/s"},
    exact=exact,
    title="Twisting control",
)
