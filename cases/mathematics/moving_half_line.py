"""A wall at sin t pushes a point that would go to 0 by itself. Written with SymPy symbols.

What to see: the point follows the wall until 3 pi/4, later than the wall turns back (pi/2), because the point's own
velocity -q presses it against the wall; then it lets go and decays. The reaction is cos t + sin t.

A wrong answer: a point that lets go at pi/2, where the wall turns back. That is what comes out where contact is judged by
the wall's velocity alone, without that of the point.

Source: Bernicot and Venel, Convergence order of a numerical scheme for sweeping process (2010); closed form.
"""

import numpy as np
import sympy as sp

from nsmodel import SweepingProcess

t, q = sp.symbols("t q", real=True)


def exact(t):
    """Return the position (N, 1)."""
    leave = 3 * np.pi / 4
    return (np.sin(np.minimum(t, leave)) * np.exp(-np.maximum(t - leave, 0))).reshape(-1, 1)


model = SweepingProcess(
    t=t,
    q=q,
    f=-q,
    constraints={"wall": q - sp.sin(t)},
    q0=0,
    t_end=3,
    step=1e-2,
    units={"t": "s", "q": "m"},
    exact=exact,
    title="A moving half-line",
)
