"""Functions of one direction between two lines: low s^2 - r |s| <= s h(s) <= high s^2 + r |s| for every s.

Beyond |s| = T the orders of h at both ends give the slopes; within, r is at least what h lacks to these lines. Where
terms cancel, the slopes are read off leading terms, and r off the infima of what h lacks.
"""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import interval_bounds, univariate
from nsmodel.proof.asymptotics import asymptotic_orders, multiply_orders, polynomial_order, value_interval
from nsmodel.proof.convex.directions import DirectionPart, part_infimum
from nsmodel.proof.convex.piecewise import split_by_cases
from nsmodel.proof.exact import ROUND_UP_FACTOR
from nsmodel.proof.exponential_sums import ball_lower_bound
from nsmodel.proof.expression_graph import additive_terms, program

# What slopes are enlarged by, beside 1 + |slope|, where h lies beyond the
# line at infinity: first by nothing, then by 1e-6 and 0.4 %.
SECTOR_WIDENINGS = (0.0, 2.0**-20, 2.0**-8)
CELLS_PER_OCTAVE = 16  # Parts of each octave of [-T, T]: each is 4 % of its place wide, however far out, and so are bounds on it.


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


def sector(h: ca.SX, s: ca.SX, low: float, high: float, k: int) -> Sector | None:
    """Return the sector of h for s in [low, high], ends may be infinite, from its orders beyond 2^k; None where there is none."""
    found = _sector_by_orders(h, s, low, high, k)
    other = exact_sector(h, s, low, high) if found is None or not found.bounded else None
    return other if other is not None and (found is None or other.bounded) else found


@np.errstate(all="ignore")
def _sector_by_orders(h: ca.SX, s: ca.SX, low: float, high: float, k: int) -> Sector | None:
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
            right, left = interval_bounds.mean_value_form(program(gap, s), low[:, None], high[:, None]).hi
            out = max(out, float(np.where(low >= 0, right, left).max()), float(right[0] if edges.size == 1 else 0.0))
            out = max(out, float(np.where(high <= 0, left, right).max()))
    return out * ROUND_UP_FACTOR if np.isfinite(out) else None


def exact_sector(h: ca.SX, s: ca.SX, low: float, high: float) -> Sector | None:
    """Return a sector from leading terms at infinity, however many terms cancel, and from infima; None where none is found."""
    slopes = [_slope_at_infinity(h, s, sign) for sign, end in ((1, high), (-1, low)) if not np.isfinite(end)]
    if None in slopes:
        return None
    known = [slope for slope in slopes if slope is not None]
    least, most = min((slope[0] for slope in known), default=0.0), max((slope[1] for slope in known), default=0.0)
    if (least, most) == (-np.inf, np.inf):
        return None
    for wider in SECTOR_WIDENINGS:
        ends = least - wider * (1 + abs(least)), most + wider * (1 + abs(most))
        reach = 0.0
        for sign, (left, right) in ((1, (max(low, 0.0), high)), (-1, (low, min(high, 0.0)))):
            for slope, side in zip(ends, (1, -1), strict=True):  # sign h >= sign least s - reach, sign h <= sign most s + reach
                if left <= right and np.isfinite(slope):
                    terms = [(side * sign * factor, term) for factor, term in additive_terms(h)]
                    line = [(-side * sign * Fraction(slope), s)] if slope else []
                    bound = part_infimum(DirectionPart([*terms, *line], s, left, right))
                    reach = max(reach, np.inf if bound is None else -bound)
        if np.isfinite(reach):
            return Sector(*ends, reach)
    return None


def _slope_at_infinity(h: ca.SX, s: ca.SX, sign: int) -> tuple[float, float] | None:
    """Bounds of h/s where s tends to sign times infinity; None where they are not found."""
    t = ca.SX.sym("t")
    terms = additive_terms(ca.substitute(h, s, sign * t))
    pieces = split_by_cases(terms, t)
    lead = univariate.growth_far_out(terms, t, pieces[-1].low[1], pieces[-1].cases) if pieces else None
    if lead is None:
        return None
    growth = lead.rank[0], -lead.order
    if growth < (0, 1):
        return 0.0, 0.0
    number = lead.number * sign
    if growth > (0, 1):
        return (-np.inf, -1.0) if number < 0 else (1.0, np.inf)
    return ball_lower_bound(number), -ball_lower_bound(-number)
