"""One state kept >= 0: x' in b - a x - T(x), with T(x) = x for x > 0 and T(0) = (-inf, 0].

What to see: inside, x' = b - (1 + a) x. With b < 0 the state reaches 0 in finite time and stays; with b > 0 (try
--set b=1) it goes to b/(1 + a).

A wrong answer: a state below 0: without the projection x goes on from 0, where it is at t = log(5)/2 = 0.805, to b/(1 +
a) = -0.5. A penalty stops it a little below 0.

Source: Convergence and stability of a catching-up algorithm with maximal monotone operators (2026), Example 8.1.
"""

import casadi as ca
import numpy as np

from nsmodel import MonotoneInclusion


def model(a: float = 1.0, b: float = -1.0, x0: float = 2.0) -> MonotoneInclusion:
    """Return the inclusion for a >= 0, any b and a start x0 >= 0."""

    def exact(t):
        rest = b / (1 + a)
        return np.maximum(rest + (x0 - rest) * np.exp(-(1 + a) * np.asarray(t)), 0).reshape(-1, 1)

    x = ca.SX.sym("x")
    return MonotoneInclusion(
        x=x,
        field=b - a * x,
        operator=x,
        lower=0,
        x0=x0,
        t_end=2,
        step=1e-2,
        exact=exact,
        title="Catching-up, Example 8.1",
    )
