"""Dry friction, a coupled linear feedback and hard bounds: K is a full matrix.

    x' in b - K x - sum mu_i Sgn(x_i) e_i - N_[lower, upper](x)

What to see: the second state sticks at 0 from t = 0.20 until the others tear it off at 0.73; the first stops at its
upper bound at 1.09. The equilibrium (1.5, 23/60, 17/30) minimises x'Kx/2 - b'x + sum mu_i |x_i| over the box.

A wrong answer: (1.5, 1.5, 1.5), which is the solution of K x = b, (4.9, 4.05, 3.5), moved into the box afterwards: a
bound that acts changes what the others settle at.

Source: Convergence and stability of a catching-up algorithm with maximal monotone operators (2026), Example 8.2.
"""

import casadi as ca
import numpy as np

from nsmodel import MonotoneInclusion

K = np.array([[2.0, -1.0, -0.5], [-1.0, 2.0, -1.0], [-0.5, -1.0, 2.0]])
b, mu = np.array([4.0, -0.3, 0.5]), np.array([0.5, 1.0, 0.5])

x = ca.SX.sym("x", 3)
model = MonotoneInclusion(
    x=x,
    field=b - K @ x,
    phi=ca.dot(mu, ca.fabs(x)),
    lower=-1,
    upper=1.5,
    x0=[-1, 0.5, -0.5],
    t_end=6,
    step=1e-2,
    title="Catching-up, Example 8.2, full K",
)
