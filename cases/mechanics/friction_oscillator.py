"""A mass on a spring with Coulomb friction: x'' + a Sgn(x') + w^2 x = 0 (as an inclusion), released at rest.

What to see: half swings of equal length pi/w, each shorter by 2a/w^2, and a stop in finite time, not at x = 0: here at
t = 3 pi and x = 0.7. The velocity is then exactly 0.

A wrong answer: a mass that ends at x = 0: friction that is smoothed lets the spring pull it there, slowly, from 0.7.
Viscous damping shortens swings by a factor instead of by 2, and never stops.

Source: Cabot, Discretization of a nonlinear oscillator under dry friction (2004), Example 4.1; closed form.
"""

import casadi as ca
import numpy as np

from nsmodel import FrictionOscillator

a, w, x0 = 1.0, 1.0, 5.3  # N/kg, rad/s, m


def exact(t):
    """Return the position (N, 1): a cosine about +-a/w^2 in each half swing k, then rest."""
    c = a / w**2
    n = max(0, np.ceil((x0 / c - 1) / 2))
    k = np.minimum(np.floor(w * np.asarray(t) / np.pi), n)
    sign, top = (-1.0) ** k, x0 - 2 * k * c
    x = np.where(k < n, sign * (c + (top - c) * np.cos(w * t - k * np.pi)), sign * top)
    return x.reshape(-1, 1)


x, s = ca.SX.sym("x"), ca.SX.sym("s")
model = FrictionOscillator(
    x=x,
    potential=w**2 * x**2 / 2,
    friction=a * s,
    s=s,
    x0=x0,
    v0=0,
    t_end=12,
    step=1e-3,
    units={"t": "s", "x": "m"},
    exact=exact,
    title="Oscillator with dry friction",
)
