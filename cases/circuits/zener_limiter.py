"""Zener limiter: a Zener diode holds the capacitor of a low-pass filter between -0.7 and 5.1 V.

    R C u' = Vm sin wt - u - R iz,    -0.7 <= u <= 5.1,    iz >= 0 only at 5.1, iz <= 0 only at -0.7

What to see: u leaves 5.1 V at 8.60 ms, when the source falls through 5.1 V and the Zener current has come to 0: no sooner,
and no later. The same at -0.7 V. Between the ends u is the arc of an exponential and a sine.

A wrong answer: the output of the filter alone, cut off afterwards, leaves 5.1 V at 10.1 ms, for its capacitor went on being
charged.

Source: closed form.
"""

import casadi as ca
import numpy as np
from scipy.optimize import brentq

from nsmodel import MonotoneInclusion

Vm, R, C, f, low, high = 12.0, 1e3, 2e-6, 50.0, -0.7, 5.1  # V, ohm, F, Hz, V
w = 2 * np.pi * f
lag = np.arctan(w * R * C)


def forced(a):
    """Return the voltage of the filter alone at the angle a, once it swings evenly."""
    return Vm * np.cos(lag) * np.sin(a - lag)


def free(a, start, u):
    """Return the voltage at the angle a, without Zener current since it was u at the angle ``start``."""
    return forced(a) + (u - forced(start)) * np.exp(-(a - start) / np.tan(lag))


up, down = -np.arcsin(-low / Vm), np.pi - np.arcsin(high / Vm)  # the angles at which u leaves an end: the source passes it
top = brentq(lambda a: free(a, up, low) - high, up, down, xtol=1e-14)
bottom = brentq(lambda a: free(a, down, high) - low, down, up + 2 * np.pi, xtol=1e-14)


def exact(t):
    """Return the voltage (N, 1)."""
    a = up + (w * np.asarray(t) - up) % (2 * np.pi)
    rises, falls = free(a, up, low), free(a, down, high)
    return np.where(a < top, rises, np.where(a < down, high, np.where(a < bottom, falls, low))).reshape(-1, 1)


t, u = ca.SX.sym("t"), ca.SX.sym("u")
source = Vm * ca.sin(w * t)
model = MonotoneInclusion(
    t=t,
    x=u,
    field=(source - u) / (R * C),
    lower=low,
    upper=high,
    x0=exact(0)[0],
    outputs={"source": source},
    scheme="implicit",
    t_end=0.04,
    step=2e-5,
    units={"t": "s", "u": "V", "source": "V"},
    exact=exact,
    title="Zener limiter",
)
