"""A bouncing ball without impacts: the Zhuravlev-Ivanov change of variables turns restitution into relays.

    x0' = x1 (1 - kappa l0 l1),    x1' = G l0 / (1 - kappa l0 l1),    l0 in -Sgn(x0),    l1 in -Sgn(x1)

|x0| is the height of a ball thrown up from 1 m at 5 m/s, which bounces with restitution (1 - kappa)/(1 + kappa) = 1/3.

What to see: x0 crosses 0 at each impact and its velocity stays bounded; the impacts pile up and the ball lies still
from t = 1.87 s on. The one-step problem is nonlinear and not monotone: uniqueness is not guaranteed.

A wrong answer: tops other than 2.274 m and then 1/9 of the one before; an |x0| that hops on after 1.87 s, because steps
cannot follow impacts that accumulate; an x0 that turns back at 0 instead of crossing it.

Source: the Zhuravlev-Ivanov example of Siconos.
"""

import casadi as ca
import numpy as np

from nsmodel import FirstOrderSystem, relay

kappa, G = 0.5, 9.81  # -, m/s^2


def exact(t):
    """Return the state (N, 2): flights of the ball, mirrored at each impact."""
    e, t1, speed = (1 - kappa) / (1 + kappa), (5 + np.sqrt(25 + 2 * G)) / G, np.sqrt(25 + 2 * G)
    whole = 2 * speed / G * e / (1 - e)  # duration of all bounces together
    left = np.clip(1 - (np.asarray(t, float) - t1) / whole, 1e-300, None)
    k = np.where(left > 1, 0, np.floor(np.log(left) / np.log(e)) + 1)  # number of impacts so far
    tau = np.where(k > 0, t - t1 - whole * (1 - e ** (k - 1)), t)
    v0, y0 = np.where(k > 0, speed * e**k, 5), np.where(k > 0, 0, 1)
    y, v = np.maximum(y0 + v0 * tau - G * tau**2 / 2, 0), v0 - G * tau
    p = v / (1 - kappa * np.sign(v))
    return np.where(left > 1e-300, (-1) ** k * np.array([y, p]), 0).T


x, lam = ca.SX.sym("x", 2), ca.SX.sym("l", 2)
model = FirstOrderSystem(
    x=x,
    lam=lam,
    f=[x[1], 0],
    h=x,
    g=[-kappa * lam[0] * lam[1] * x[1], G * lam[0] / (1 - kappa * lam[0] * lam[1])],
    law=relay(2),
    x0=[1, 10],
    t_end=10,
    step=1e-3,
    units={"t": "s", "x_0": "m", "x_1": "m/s"},
    exact=exact,
    title="Bouncing ball, Zhuravlev-Ivanov form",
)
