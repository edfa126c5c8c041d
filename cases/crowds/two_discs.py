"""Two discs on a line walk towards each other and push.

What to see: after the contact both move with the mean velocity (u1 - u2)/2, and the reaction is (u1 + u2)/2: here 0.7.
The scheme is exact to rounding on this scene.

A wrong answer: discs that overlap, by as much as their penalty allows; that stop, as if the contact took all velocity; or
that part again, as if it were elastic: there are no impacts in a first-order motion.

Source: Maury and Venel's model of crowds, the smallest scene; closed form.
"""

import casadi as ca
import numpy as np

from nsmodel import SweepingProcess

u1, u2, r = 1.0, 0.4, 0.3  # m/s, m/s, m


def exact(t):
    """Return the positions (N, 4), x and y of each disc."""
    touch = (2 - 2 * r) / (u1 + u2)
    before, after = np.minimum(t, touch), np.maximum(t - touch, 0) * (u1 - u2) / 2
    zero = np.zeros_like(before)
    return np.column_stack([-1 + u1 * before + after, zero, 1 - u2 * before + after, zero])


q = ca.SX.sym("q", 4)
model = SweepingProcess(
    q=q,
    f=[u1, 0, -u2, 0],
    constraints={"pair 0-1": ca.norm_2(q[2:] - q[:2]) - 2 * r},
    q0=[-1, 0, 1, 0],
    t_end=2.5,
    step=1e-2,
    units={"t": "s", **{f"q_{i}": "m" for i in range(4)}},
    exact=exact,
    scene={"radii": [r, r]},
    title="Two discs head-on",
)
