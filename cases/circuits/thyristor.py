"""Half-wave rectifier with a thyristor: fired at 60 degrees of each period, it conducts until its current ends.

    L i' = q Vm sin wt - R i + l,    0 <= l ⟂ i >= 0

The latch q is 1 once there is a pulse at the gate, and 0 once the pulse is over and i <= 0. While q = 0 the source is out of
the equation and l = 0: the voltage across the thyristor is (1 - q) Vm sin wt - l.

What to see: nothing flows until the pulse; then the current is that of a diode which begins later and ends earlier. The
later the pulse, the less: the mean voltage is Vm (cos alpha - cos beta)/(2 pi), beta the angle at which i ends.

A wrong answer: the current begins at 0 degrees and ends at 240.8, as that of a diode, or it stays on into the next period. The
latch keeps it on after the pulse is over at 67.2 degrees, and ends it at 237.2.

Source: closed form.
"""

import casadi as ca
import numpy as np
from scipy.optimize import brentq

from nsmodel import LureSystem, complementarity, pwm, thyristor

Vm, R, L, f, alpha = 325.0, 10.0, 50e-3, 50.0, np.pi / 3  # V, ohm, H, Hz, rad
w = 2 * np.pi * f
Z, lag = np.hypot(R, w * L), np.arctan2(w * L, R)


def current(a):
    """Return the current at the angle a while the thyristor conducts."""
    return Vm / Z * (np.sin(a - lag) - np.sin(alpha - lag) * np.exp(-(a - alpha) / np.tan(lag)))


end = brentq(current, np.pi, 2 * np.pi, xtol=1e-14)  # the angle at which the current is 0 again


def exact(t):
    """Return the current (N, 1)."""
    a = (w * np.asarray(t)) % (2 * np.pi)
    return np.where((a > alpha) & (a < end), current(a), 0).reshape(-1, 1)


t, i, q, gate = (ca.SX.sym(name) for name in ("t", "i", "q", "gate"))
model = LureSystem(
    t=t,
    x=i,
    A=[[-R / L]],
    B=[1 / L],
    C=[1],
    f=[q * Vm * ca.sin(w * t) / L],
    law={"blocking": complementarity(1)},
    x0=[0],
    inputs={gate: pwm(period=1 / f, duty=0.02, phase=alpha / w)},
    blocks=[thyristor(q, gate, i)],
    t_end=0.04,
    step=2e-5,
    theta=0.5,
    units={"t": "s", "i": "A", "blocking": "V"},
    exact=exact,
    title="Rectifier with a thyristor",
)
