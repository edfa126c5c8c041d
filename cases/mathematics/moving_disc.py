"""A disc moves to the right and pushes a resting point out of its way.

What to see: the point rests until the disc touches it, is pushed ahead and aside, and rests again at the height of the
disc's top. There is no velocity field at all: f = 0, only the set moves.

A wrong answer: a point inside the disc, or one that sticks to it and is carried on; here it slides along the disc to its
top, is left behind at t = 2.42, and rests at (2.42, 1).

Source: Bernicot and Venel, Convergence order of a numerical scheme for sweeping process (2010); closed form.
"""

import casadi as ca
import numpy as np

from nsmodel import SweepingProcess

x0, y0 = 1.5, 0.3  # m; the disc has radius 1 m and moves at 1 m/s


def exact(t):
    """Return the position (N, 2): at rest, then on the disc at the angle phi, then at rest."""
    angle = np.arcsin(y0)
    touch = x0 - np.cos(angle)
    leave = touch - np.log(np.tan(angle / 2))
    during = np.clip(t, touch, leave)
    phi = 2 * np.arctan(np.tan(angle / 2) * np.exp(during - touch))
    return np.column_stack([during + np.cos(phi), np.sin(phi)])


t, q = ca.SX.sym("t"), ca.SX.sym("q", 2)
model = SweepingProcess(
    t=t,
    q=q,
    f=[0, 0],
    constraints={"disc": ca.norm_2(q - ca.vertcat(t, 0)) - 1},
    q0=[x0, y0],
    t_end=4,
    step=1e-2,
    units={"t": "s", "q_0": "m", "q_1": "m"},
    exact=exact,
    title="A moving disc pushes a point",
)
