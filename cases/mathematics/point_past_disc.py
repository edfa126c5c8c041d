"""A point carried to the right past a fixed disc.

What to see: the point touches the disc, is turned round it while the reaction fades as it nears the top, leaves at the
top and goes on straight. The admissible set is not convex. Start it at height 0 and it stays in front of the disc.

A wrong answer: a point that leaves the disc before its top, and goes on below 1; one that is slowed down by the contact,
which has no friction; one inside the disc, as with a penalty.

Source: Bernicot and Venel, Convergence order of a numerical scheme for sweeping process (2010); closed form.
"""

import casadi as ca
import numpy as np

from nsmodel import SweepingProcess

x0, y0 = -1.5, 0.3  # m; the disc has radius 1 m, the stream 1 m/s


def exact(t):
    """Return the position (N, 2): straight, then along the circle at the angle theta, then straight."""
    angle = np.pi - np.arcsin(y0)
    touch = np.cos(angle) - x0
    leave = touch + np.log(np.tan(angle / 2))
    theta = 2 * np.arctan(np.tan(angle / 2) * np.exp(touch - np.clip(t, touch, leave)))
    x = np.cos(theta) + np.minimum(t - touch, 0) + np.maximum(t - leave, 0)
    return np.column_stack([x, np.sin(theta)])


q = ca.SX.sym("q", 2)
model = SweepingProcess(
    q=q,
    f=[1, 0],
    constraints={"disc": ca.norm_2(q) - 1},
    q0=[x0, y0],
    t_end=4.5,
    step=1e-2,
    units={"t": "s", "q_0": "m", "q_1": "m"},
    exact=exact,
    title="A point carried past a disc",
)
