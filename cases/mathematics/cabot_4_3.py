"""The counterexample: friction Sgn(v) + 2 v and potential x^2/2, step 1, start (2, 2).

What to see: x_n = 1 + (1 + n)/2^n converges to 1, and never gets there: 0 lies on the boundary of A(0) + B(1) = [0, 2],
so the theorem on finite convergence does not apply. (In double precision the velocity rounds to 0 near n = 60.)

A wrong answer: rest that is reported in finite time: x_n - 1 is below any tolerance soon, and 0 never. A theorem whose
margin is not looked at says that the sequence stops.

Source: Cabot, Discretization of a nonlinear oscillator under dry friction (2004), Example 4.3.
"""

import casadi as ca

from nsmodel import FrictionOscillator

x, s = ca.SX.sym("x"), ca.SX.sym("s")

model = FrictionOscillator(
    x=x,
    potential=x**2 / 2,
    friction=s + s**2,
    s=s,
    x0=2,
    x1=2,
    step=1,
    t_end=50,
    title="Cabot, Example 4.3",
)
