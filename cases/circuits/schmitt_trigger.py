"""Schmitt-trigger oscillator: a comparator with hysteresis charges a capacitor to and fro.

    R C v' = V s - v,    s falls to -1 at v = V/2, rises to +1 at v = -V/2

What to see: a square wave s and arcs of exponentials v between the thresholds. The period is 2 R C log 3 = 22.0 ms. Steps
see a threshold at most a step late; with --rtol 1e-8 the comparator switches at it.

A wrong answer: v comes to rest at 0. That is what a comparator without memory does. Steps of 1 ms make the half period 12 ms,
not 11.0: a threshold is passed before it is seen.

Source: closed form.
"""

import casadi as ca
import numpy as np

from nsmodel import FirstOrderSystem, hysteresis

R, C, V = 10e3, 1e-6, 5.0  # ohm, F, V
first, half = R * C * np.log(2), R * C * np.log(3)


def exact(t):
    """Return the voltage (N, 1): from 0 to the first threshold, then from one to the other."""
    since = np.asarray(t) - first
    sign = np.where(since // half % 2 == 1, 1, -1)
    arc = sign * V * (1 - 1.5 * np.exp(-(since % half) / (R * C)))
    return np.where(since < 0, V * (1 - np.exp(-np.asarray(t) / (R * C))), arc).reshape(-1, 1)


v, s = ca.SX.sym("v"), ca.SX.sym("s")
model = FirstOrderSystem(
    x=v,
    f=[(V * s - v) / (R * C)],
    x0=[0],
    blocks=[hysteresis(s, v, -V / 2, V / 2, start=1, below=1, above=-1)],
    t_end=0.05,
    step=5e-5,
    theta=0.5,
    units={"t": "s", "v": "V"},
    exact=exact,
    title="Schmitt-trigger oscillator",
)
