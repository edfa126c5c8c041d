"""A crumb in a square drum that turns lies in a corner, is lifted with it, and slides down to the next.

    q' in (0, -c) - N_C(t)(q),    C(t) the square of half side a, turned by w t

What to see: in the corner both walls hold the crumb. Once the one that is ahead has nothing to bear (0.533 s) the crumb
slides down along the other to the next corner (1.549 s). Its loop at the bottom of the drum is the same in every quarter
of a turn.

A wrong answer: walls treated one after the other let the crumb out through the corner, |q| > a sqrt(2). A corner that
never lets go lifts it to the top; here it is never above -0.838 m.

Source: Moreau, Evolution problem associated with a moving convex set in a Hilbert space (1977), swept by a polygon;
closed form.
"""

import casadi as ca
import numpy as np

from nsmodel import SweepingProcess

a, c, w = 1.0, 4.0, 1.0  # m, m/s, rad/s
go = np.arccos(w * a / c) - np.pi  # the angle of a wall from which on the crumb slides down along it


def exact(t):
    """Return the position (N, 2): at s along the wall that stands at the angle b, or in its lower corner, s = -a."""
    b = go + (w * np.asarray(t) - 3 * np.pi / 4 - go) % (np.pi / 2)
    s = np.maximum(a - a * (b - go) - c / w * (np.sin(b) - np.sin(go)), -a)
    return np.column_stack([a * np.cos(b) - s * np.sin(b), a * np.sin(b) + s * np.cos(b)])


t, q = ca.SX.sym("t"), ca.SX.sym("q", 2)
walls = [w * t + (2 * k + 1) * np.pi / 4 for k in range(4)]
model = SweepingProcess(
    t=t,
    q=q,
    f=[0, -c],
    constraints={f"wall {k}": a - ca.cos(b) * q[0] - ca.sin(b) * q[1] for k, b in enumerate(walls)},
    q0=[0, -np.sqrt(2) * a],
    t_end=4,
    step=5e-3,
    units={"t": "s", "q_0": "m", "q_1": "m"},
    exact=exact,
    title="A crumb in a turning drum",
)
