"""Until when solutions provably stay inside a box, whatever the class: by rates between nested boxes, or by a ball that grows.

Between the start and the box lie boxes B_0, ..., B_N, each N-th of the way wider. Who leaves B_k passes, from a side of B_(k-1)
to that of B_k, a slab of it, and no faster than the state moves there: where it moves inwards alone, nobody passes.

Where |x - z|' <= omega |x - z| + g, |x - z| is at most the r of r' = omega r + g; the box holds the ball of radius R about z.
"""

from __future__ import annotations

import math
from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.region import Region, depends_on_symbol
from nsmodel.modeling.laws import Law
from nsmodel.proof import interval_bounds

# Boxes between the start and the whole box, on each of which the speed is bounded by itself: more prove longer times. Where
# rates are constant one is enough; where x' = x, from 0.1 to 1, 16 prove 90 % of the true time, one 39 %.
NESTED_BOXES = 16
# A time is lowered by this factor. The logarithm of a quotient that differs from 1 by 1e-6 loses 2e-10; all else loses less.
ROUNDED_DOWN = 1 - 1e-9

Bounds = tuple[np.ndarray, np.ndarray]


class StayTime(NamedTuple):
    """How long after the start solutions are inside, and why."""

    until: float
    why: str


def stay_by_rates(rate: ca.SX, x: ca.SX, others: ca.SX, ends: Bounds, region: Region, start: Bounds) -> float:
    """A time before which no solution leaves the box of a region.

    Args:
        rate: x' as expressions (n, 1) of x and ``others``, whose bounds are ``ends``.
        x: the states of the region, in its order; others: symbols (k, 1).
        region: the box.
        start: bounds (n,) of the start, inside the box.
    """
    n, (low, high) = x.numel(), start
    room = low - region.lower, region.upper - high
    if not n or not all((part > 0).all() for part in room):
        return 0.0
    slabs: list[Bounds] = []
    for k in range(1, NESTED_BOXES + 1):
        part = k / NESTED_BOXES
        lower, upper = low - part * room[0], high + part * room[1]
        for i in range(n):
            beyond, below = upper.copy(), lower.copy()
            beyond[i] = lower[i] + room[0][i] / NESTED_BOXES
            below[i] = upper[i] - room[1][i] / NESTED_BOXES
            slabs += [(lower, beyond), (below, upper)]
    boxes = [np.array([np.append(slab[k], ends[k]) for slab in slabs]) for k in (0, 1)]
    least, most = (
        np.asarray(end).reshape(NESTED_BOXES, n, 2, n) for end in interval_bounds.enclose(rate, ca.vertcat(x, others), *boxes)
    )
    outwards = np.array([[[-least[k, i, 0, i], most[k, i, 1, i]] for i in range(n)] for k in range(NESTED_BOXES)])
    gaps = np.stack(room, axis=1) / NESTED_BOXES
    with np.errstate(divide="ignore"):
        times = np.where(outwards > 0, gaps / np.where(outwards > 0, outwards, 1.0), np.inf)
    return float(times.min(axis=(1, 2)).sum()) * ROUNDED_DOWN


def stay_in_ball(distance: float, omega: float, drive: float, radius: float) -> float:
    """The time at which r' = omega r + drive, r(0) = distance, comes to the radius; inf where it never does.

    >>> stay_in_ball(1.0, -1.0, 1.0, 2.0), round(stay_in_ball(0.0, 0.0, 2.0, 1.0), 6)
    (inf, 0.5)
    """
    if not (distance < radius and np.isfinite([omega, drive]).all()):
        return 0.0
    if radius == math.inf:
        return math.inf
    speed, end = (float(Fraction(omega) * Fraction(r) + Fraction(drive)) for r in (distance, radius))  # exact: terms may cancel
    if speed <= 0 or (omega < 0 and end <= 0):
        return math.inf
    if abs(omega) * (radius - distance) < 1e-6 * speed:  # r' is at most the largest of the two
        return (radius - distance) / max(speed, end) * ROUNDED_DOWN
    return math.log(end / speed) / omega * ROUNDED_DOWN


def multiplier_hull(law: Law, p: ca.SX, low: np.ndarray, high: np.ndarray) -> Bounds | None:
    """A box that holds K for all values of the parameters p; None where it depends on them and is no product of intervals."""
    lows, highs = [np.zeros(0)], [np.zeros(0)]
    for rows, block in law.parts():
        if not depends_on_symbol(block, p):
            ends = block.bounding_box()
        elif block.separable:
            ends = [_bounds_of_rows(side, p, low, high)[k] for k, side in enumerate((law.lower[rows], law.upper[rows]))]
        else:
            return None
        lows.append(np.asarray(ends[0]))
        highs.append(np.asarray(ends[1]))
    return np.concatenate(lows), np.concatenate(highs)


def _bounds_of_rows(column: ca.SX, p: ca.SX, low: np.ndarray, high: np.ndarray) -> Bounds:
    """Of each row; those that are numbers may be infinite."""
    rows = [
        (float(row), float(row))
        if row.is_constant()
        else tuple(float(end.item()) for end in interval_bounds.enclose(row, p, low, high))
        for row in ca.vertsplit(column)
    ]
    return np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
