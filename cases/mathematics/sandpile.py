"""Sand is poured on one place, then on another; no slope is steeper than 1.

    h' = source(t) + sand that slides,    |h_{i+1} - h_i| <= 1

What to see: a pile of k layers holds k^2 of sand and grows ever slower. From t = 16 on the source is over cell 8: a
second pile grows, meets the first and climbs over its flank, but leaves its top at 4. Multipliers are the sand that
slides over each edge between two cells in a step, reactions that in a unit of time.

A wrong answer: slopes that a stiff force holds let sand creep, and the top of the first pile, cell 3, sinks below 4.
Slopes that are cut off where they are too steep lose sand: all cells together hold t.

Source: Prigozhin, Variational model of sandpile growth (1996); closed form on cells.
"""

import casadi as ca
import numpy as np

from nsmodel import SweepingProcess

n, first, second, change, end = 12, 3, 8, 16.0, 40.0
cells, heights = np.arange(n), np.arange(12)
old = np.maximum(4 - abs(cells - first), 0)  # the first pile: four layers
new = np.maximum(heights[:, None] - abs(cells - second), old)  # with a second one of each whole height


def exact(t):
    """Return the heights (N, n): cones, whose heights are linear in the volume between whole ones."""
    t = np.asarray(t, float)[:, None]
    alone = np.interp(np.minimum(t, change), heights**2, heights) - abs(cells - first)
    top = np.interp(t, new.sum(axis=1), heights)
    return np.where(t <= change, np.maximum(alone, 0), np.maximum(top - abs(cells - second), old))


t, h = ca.SX.sym("t"), ca.SX.sym("h", n)
left = ca.if_else(t < change, 1, 0)
slope = h[1:] - h[:-1]
model = SweepingProcess(
    t=t,
    q=h,
    f=ca.vertcat(*(left if i == first else 1 - left if i == second else 0 for i in range(n))),
    constraints={"up": 1 - slope, "down": 1 + slope},
    q0=np.zeros(n),
    switch_times=[change],
    t_end=end,
    step=5e-2,
    exact=exact,
    title="Two piles of sand",
)
