"""Half-wave rectifier with a coil: one diode on the mains, R and L.

    L i' = Vm sin wt - R i + l,    0 <= l ⟂ i >= 0

What to see: the coil keeps the diode open after the voltage has changed its sign: the current ends at 240.8 degrees, not
at 180, and is exactly 0 from there to the next period.

A wrong answer: the current ends with the voltage, at 180 degrees. Then the mean voltage at the load would be Vm/pi = 103.5 V;
it is 77.0 V.

Source: closed form.
"""

import casadi as ca
import numpy as np
from scipy.optimize import brentq

from nsmodel import LureSystem, complementarity

Vm, R, L, f = 325.0, 10.0, 50e-3, 50.0  # V, ohm, H, Hz
w = 2 * np.pi * f
Z, lag = np.hypot(R, w * L), np.arctan2(w * L, R)


def current(a):
    """Return the current at the angle a after the diode began to conduct, while it does."""
    return Vm / Z * (np.sin(a - lag) + np.sin(lag) * np.exp(-a / np.tan(lag)))


end = brentq(current, np.pi, 2 * np.pi - 1e-9, xtol=1e-14)  # the angle at which the current is 0 again


def exact(t):
    """Return the current (N, 1)."""
    a = (w * np.asarray(t)) % (2 * np.pi)
    return np.where(a < end, current(a), 0).reshape(-1, 1)


t = ca.SX.sym("t")
model = LureSystem(
    t=t,
    A=[[-R / L]],
    B=[1 / L],
    C=[1],
    f=[Vm * ca.sin(w * t) / L],
    law={"diode": complementarity(1)},
    x0=[0],
    outputs={"mains": Vm * ca.sin(w * t)},
    t_end=0.04,
    step=2e-5,
    theta=0.5,
    names=["i"],
    units={"t": "s", "i": "A", "diode": "V", "mains": "V"},
    exact=exact,
    title="Half-wave rectifier",
)
