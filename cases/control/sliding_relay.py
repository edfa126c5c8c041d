"""Sliding mode: a relay drives x_0 + x_1 to 0 and keeps it there against a disturbance sin t.

What to see: the switching line is reached at t = 0.46; from then on the state slides along it, x_0 decays like exp(-t),
and the relay's output is strictly inside (-1, 1): it is the equivalent control, -(x_1 + sin t)/2.

A wrong answer: a relay that chatters between -1 and 1 on the line, with x_0 + x_1 as far from 0 as the step is long. A
relay that is smoothed holds x_0 + x_1 beside 0, by as much as sin t asks for.

Source: closed form.
"""

import casadi as ca
import numpy as np

from nsmodel import LureSystem, relay

reach = 0.5  # time at which the sliding starts, by Newton's method on x_0 + x_1 of the first phase
for _ in range(20):
    reach += (2 - reach - reach**2 - np.sin(reach) - np.cos(reach)) / (1 + 2 * reach + np.cos(reach) - np.sin(reach))


def exact(t):
    """Return the state (N, 2): the relay at -1, then the sliding mode."""
    before, after = np.minimum(t, reach), np.exp(-np.maximum(t - reach, 0))
    x = (1 + before - before**2 - np.sin(before)) * after
    return np.column_stack([x, np.where(t < reach, 1 - 2 * before - np.cos(before), -x)])


t = ca.SX.sym("t")
model = LureSystem(
    t=t,
    A=[[0, 1], [0, 0]],
    B=[0, 2],
    C=[1, 1],
    f=[0, ca.sin(t)],
    law=relay(1),
    x0=[1, 0],
    t_end=5,
    step=1e-2,
    units={"t": "s"},
    exact=exact,
    title="Sliding relay",
)
