"""A mass on a spring with Coulomb friction, both to be found from its motion: x'' + a Sgn(x') + k x = 0 (as an inclusion).

The friction a and the stiffness k are parameters: sweeps vary them, and `nsmodel sensitivity friction_fit --by
friction,stiffness --at 2,5` differentiates the run by them, through the turn at t = pi/sqrt(k), which moves with k. The
notebook on derivatives fits them.

What to see: before the first turn x depends on a by 1 - cos(sqrt(k) t), at t = 5 by -1.85: friction has pushed back for a
half swing, and forward since. dx/dk is 7.36 there, with a kink at the turn, and the time of the turn moves by -pi/2 dk.

A wrong answer: derivatives of time steps, or by differences of runs a width of 1e-9 apart, which do not see the turn move; a
fit by these ends where it began, or elsewhere at each step size.

Source: Cabot, Discretization of a nonlinear oscillator under dry friction (2004), Example 4.1; closed form.
"""

import casadi as ca
import numpy as np

from nsmodel import FrictionOscillator

x, s = ca.SX.sym("x"), ca.SX.sym("s")
a, k = ca.SX.sym("friction"), ca.SX.sym("stiffness")
start = 5.3  # m


def exact(t):
    """Return the position (N, 1) for a = k = 1 up to the second turn, at 2 pi: a cosine about 1, and then about -1."""
    t = np.asarray(t)
    first, second = 1 + (start - 1) * np.cos(t), -1 + (start - 3) * np.cos(t)
    return np.where(t < np.pi, first, second).reshape(-1, 1)


model = FrictionOscillator(
    x=x,
    potential=k * x**2 / 2,
    friction=a * s,
    s=s,
    x0=start,
    v0=0,
    parameters={a: 1.0, k: 1.0},
    t_end=5,
    step=1e-3,
    units={"t": "s", "x": "m", "friction": "N", "stiffness": "N/m"},
    exact=exact,
    title="Friction and stiffness to be found",
)
