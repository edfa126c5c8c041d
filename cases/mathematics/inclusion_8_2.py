"""Dry friction, a linear feedback and hard bounds, three states that do not influence each other (K diagonal).

    x' in b - K x - sum mu_i Sgn(x_i) e_i - N_[lower, upper](x)

What to see: the first state crosses 0 and ends at its upper bound, the second sticks at 0 (|b_1| <= mu_1; the scheme is
explicit in the friction and stays within a step's motion of 0), the third crosses 0 and goes to (b_2 + mu_2)/K_22.

A wrong answer: a second state that swings about 0 by as much for smaller steps, a third one at b_2/K_22 = -1 instead of
-0.75 (no friction), or a first one on its way to 2 (no bound).

Source: Convergence and stability of a catching-up algorithm with maximal monotone operators (2026), Example 8.2.
"""

import casadi as ca
import numpy as np

from nsmodel import MonotoneInclusion

K, b, mu = np.array([1.0, 2.0, 4.0]), np.array([3.0, 0.5, -4.0]), np.array([1.0, 1.0, 1.0])
lower, upper, x0 = -2.0, 1.5, np.array([-1.0, 1.5, 1.0])


def exact(t):
    """Return the state (N, 3): up to 0 the friction has one sign, after it the other, or the state sticks."""
    t, side = np.reshape(t, (-1, 1)), np.sign(x0)
    goal = (b - side * mu) / K
    zero = np.where(goal * side < 0, np.log1p(-x0 / goal) / K, np.inf)
    rest = np.sign(b) * np.maximum(abs(b) - mu, 0) / K
    x = np.where(t < zero, goal + (x0 - goal) * np.exp(-K * t), -rest * np.expm1(-K * np.maximum(t - zero, 0)))
    return np.clip(x, lower, upper)


x = ca.SX.sym("x", 3)
model = MonotoneInclusion(
    x=x,
    field=b - K * x,
    phi=ca.dot(mu, ca.fabs(x)),
    lower=lower,
    upper=upper,
    x0=x0,
    t_end=4,
    step=1e-2,
    exact=exact,
    title="Catching-up, Example 8.2, diagonal K",
)
