"""Two relays that act on each other hold two states at 0: sliding on one surface, then on the intersection of both.

    x1' = 2 l1 + l2 + sin(t)/2,    x2' = l1 + 2 l2 + cos(t)/2,    l1 in -Sgn(x1),    l2 in -Sgn(x2)

What to see: x2 is 0 from t = 0.398 on, x1 from 1.016 on. While x2 alone slides its relay gives way, and x1 falls at half
its speed. On the intersection both relays are inside (-1, 1): together they are the equivalent control, l = -B^-1 d(t).

A wrong answer: each relay switched as if the other were not there. Then x1 goes on falling at 3/s when x2 has arrived,
and reaches 0 at t = 0.707 already. Relays computed from the last state chatter between -1 and 1 at the intersection.

Source: Utkin, Sliding modes in control and optimization (1992); closed form.
"""

import casadi as ca
import numpy as np
from scipy.optimize import brentq

from nsmodel import LureSystem, relay

x1, x2 = 2.0, 1.0  # the start


def falling(t):
    """Return both states while both relays are at -1."""
    return x1 - 3 * t + (1 - np.cos(t)) / 2, x2 - 3 * t + np.sin(t) / 2


def sliding(t):
    """Return x1 after x2 = 0 is reached, where l2 = -(l1 + cos(t)/2)/2, up to a constant."""
    return -1.5 * t - np.cos(t) / 2 - np.sin(t) / 4


first = brentq(lambda t: falling(t)[1], 0, 1, xtol=1e-15)
second = brentq(lambda t: falling(first)[0] + sliding(t) - sliding(first), first, 2, xtol=1e-15)


def exact(t):
    """Return the state (N, 2)."""
    before = falling(np.minimum(t, first))
    after = sliding(np.clip(t, first, second)) - sliding(first)
    return np.column_stack([np.where(t < second, before[0] + after, 0), np.where(t < first, before[1], 0)])


t = ca.SX.sym("t")
model = LureSystem(
    t=t,
    A=[[0, 0], [0, 0]],
    B=[[2, 1], [1, 2]],
    C=[[1, 0], [0, 1]],
    f=[ca.sin(t) / 2, ca.cos(t) / 2],
    law=relay(2),
    x0=[x1, x2],
    t_end=4,
    step=1e-2,
    names=["x1", "x2"],
    units={"t": "s"},
    exact=exact,
    title="Sliding on two surfaces",
)
