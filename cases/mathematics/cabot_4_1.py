"""Dry friction and a quadratic potential, with the paper's own start (x_0, x_1) and step 1.

What to see: the sequence swings, and stops inside the dead zone [-alpha/beta, alpha/beta]: x_n = 0.1766 from n = 32 on.

A wrong answer: a sequence that tends to 0, the minimum of the potential, in ever smaller swings: friction that is
smoothed, or is taken from the last velocity, has no dead zone. Here x_n stays at 0.1766, exactly.

Source: Cabot, Discretization of a nonlinear oscillator under dry friction (2004), Example 4.1.
"""

import casadi as ca

from nsmodel import FrictionOscillator

x, s, alpha, beta = (ca.SX.sym(name) for name in ("x", "s", "alpha", "beta"))

model = FrictionOscillator(
    x=x,
    potential=beta * x**2 / 2,
    friction=alpha * s,
    s=s,
    x0=2,
    x1=2,
    step=1,
    t_end=60,
    parameters={alpha: 0.02, beta: 0.1},
    title="Cabot, Example 4.1",
)
