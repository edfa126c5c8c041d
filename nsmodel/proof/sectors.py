"""Functions of one direction between two lines: low s^2 - r |s| <= s h(s) <= high s^2 + r |s| for every s.

Beyond |s| = T the orders of h at both ends give the slopes; within, r is at least what h lacks to these lines.
"""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import interval
from nsmodel.proof.at_infinity import asymptotic_orders, polynomial_order
from nsmodel.proof.orders import multiply_orders, value_interval
from nsmodel.proof.straight_line import program

CELLS_PER_OCTAVE = 16  # Parts of each octave of [-T, T].
REACH_ROUNDING = 1 + 1e-12


class Sector(NamedTuple):
    """low s^2 - reach |s| <= s h(s) <= high s^2 + reach |s|; an end may be infinite where h grows faster.

    Where both are finite |h(s) - m s| <= reach for some m of [low, high], at s = 0 as well.
    """

    low: float
    high: float
    reach: float

    @property
    def bounded(self) -> bool:
        """Whether h grows at most linearly."""
        return bool(np.isfinite([self.low, self.high]).all())


@np.errstate(all="ignore")
def sector(h: ca.SX, s: ca.SX, low: float, high: float, k: int) -> Sector | None:
    """The sector of h for s in [low, high], ends may be infinite, from its orders beyond 2^k; None where there is none."""
    T = 2.0**k
    slopes = []
    for sign, end in ((1, high), (-1, low)):
        if np.isfinite(end):
            continue
        t = ca.SX.sym("t")
        (order,) = asymptotic_orders(ca.substitute(h, s, sign * t), t, [polynomial_order([0, 1], k)], k)
        slope = multiply_orders(order, polynomial_order([0, Fraction(sign)], k))  # sign h / t, but for t^2
        if slope is None:
            return None
        ends = value_interval(slope._replace(p=slope.p - 2), k)
        slopes.append((float(ends[0][0]), float(ends[1][0])))
    least, most = (min(a for a, _ in slopes), max(b for _, b in slopes)) if slopes else (0.0, 0.0)
    if least == np.inf or most == -np.inf or (least, most) == (-np.inf, np.inf):
        return None
    ends = low if np.isfinite(low) else -T, high if np.isfinite(high) else T
    if ends[0] > ends[1]:
        return Sector(least, most, 0.0)
    octaves = 2.0 ** np.arange(-8, np.log2(max(1.0, *np.abs(ends))) + 1, 1 / CELLS_PER_OCTAVE)
    inner = np.concatenate([-octaves, [0.0], octaves])
    edges = np.unique(np.concatenate([inner[(inner > ends[0]) & (inner < ends[1])], ends]))
    reach = _sector_reach(h, s, edges, least, most)
    return None if reach is None else Sector(least, most, reach)


def _sector_reach(h: ca.SX, s: ca.SX, edges: np.ndarray, least: float, most: float) -> float | None:
    """The largest s/|s| (h - most s) and s/|s| (least s - h) between the edges, 0 being one of them or outside; 0 at least."""
    low, high = (edges[:-1], edges[1:]) if edges.size > 1 else (edges, edges)
    out = 0.0
    for slope, sign in ((least, -1.0), (most, 1.0)):
        if np.isfinite(slope):
            gap = ca.vertcat(h - slope * s, slope * s - h) * sign
            right, left = interval.mean_value_form(program(gap, s), low[:, None], high[:, None]).hi
            out = max(out, float(np.where(low >= 0, right, left).max()), float(right[0] if edges.size == 1 else 0.0))
            out = max(out, float(np.where(high <= 0, left, right).max()))
    return out * REACH_ROUNDING if np.isfinite(out) else None
