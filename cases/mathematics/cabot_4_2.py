"""Dry friction and the potential beta |x|: two nonsmooth terms, with step 1.

What to see: for beta > alpha the only equilibrium is 0, and it is reached in finitely many steps: x_n = 0 from
n = 20 on. With beta < alpha every point is an equilibrium: with --set beta=0.02 the sequence stays where it starts.

A wrong answer: a sequence that hops to and fro about 0 for ever, as it does where the slope of beta |x| is taken at the
last position; and, with beta=0.02, one that slides down to 0.

Source: Cabot, Discretization of a nonlinear oscillator under dry friction (2004), Example 4.2.
"""

import casadi as ca

from nsmodel import FrictionOscillator

x, s, alpha, beta = (ca.SX.sym(name) for name in ("x", "s", "alpha", "beta"))

model = FrictionOscillator(
    x=x,
    potential=beta * ca.fabs(x),
    friction=alpha * s,
    s=s,
    x0=2,
    x1=2,
    step=1,
    t_end=60,
    parameters={alpha: 0.03, beta: 0.1},
    title="Cabot, Example 4.2",
)
