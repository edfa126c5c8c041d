"""A metre in the least time against dry friction: full force ahead, full force back, and nothing any more.

    m v' = u - F Sgn(v),    p' = v,    |u| <= 2

What to see: a triangle of v, and rest at p = 1, exactly: steps end at the edges of u, and friction holds the mass.

A wrong answer: friction that is smoothed lets the mass roll on after the stop, ever more slowly. Where u is switched a
step late, because a step went over its edge, the mass arrives with 0.04 m/s and stops beyond p = 1.

Source: closed form: the peak of v is sqrt(2 a b/(a + b)), a and b the accelerations there and back.
"""

import casadi as ca
import numpy as np

from nsmodel import LureSystem, relay, table

m, F, force = 1.0, 0.5, 2.0  # kg, N, N
a, b = (force - F) / m, (force + F) / m
peak = np.sqrt(2 * a * b / (a + b))
turn, stop = peak / a, peak / a + peak / b


def exact(t):
    """Return the state (N, 2)."""
    up, down = np.clip(t, 0, turn), np.clip(np.asarray(t) - turn, 0, stop - turn)
    v = a * up - b * down
    p = a * up**2 / 2 + peak * down - b * down**2 / 2
    return np.column_stack([np.where(np.asarray(t) < stop, v, 0), p])


u = ca.SX.sym("u")
model = LureSystem(
    A=[[0, 0], [1, 0]],
    B=[1 / m, 0],
    C=[1, 0],
    f=[u / m, 0],
    law={"friction": relay(1, -F, F)},
    x0=[0, 0],
    inputs={u: table([0, turn, stop], [force, -force, 0])},
    t_end=2,
    step=0.01,
    theta=0.5,
    names=["v", "p"],
    units={"t": "s", "v": "m/s", "p": "m", "friction": "N", "u": "N"},
    exact=exact,
    title="Time-optimal move",
)
