"""C(p) = {x : c(x, p) >= 0} for all p of a box: is each convex, has each interior, and a set that holds them all."""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import extremum, interval
from nsmodel.proof.convex import convexity
from nsmodel.proof.convex.convex_sets import ConvexSet, has_interior, is_convex_set
from nsmodel.proof.graph import stack_column
from nsmodel.proof.mixtures import mixture_corners
from nsmodel.proof.verdict import HOLDS, HypothesisPart

MAX_PARAMETER_CELLS, INTERIOR_MARGIN = 128, "interior margin"


class InteriorProof(NamedTuple):
    """The proof, and a number such that each C(p) has a point no farther from 0."""

    part: HypothesisPart
    reach: float


class MovingSet(NamedTuple):
    """C(p): its rows in x and p, and the box of p."""

    x: ca.SX
    p: ca.SX
    rows: ca.SX
    lower: np.ndarray
    upper: np.ndarray

    @property
    def fixed(self) -> list[int]:
        """The rows that do not depend on p."""
        return [i for i, row in enumerate(ca.vertsplit(self.rows)) if not ca.depends_on(row, self.p)]

    @property
    def moving(self) -> list[int]:
        """The rows that do."""
        return [i for i in range(self.rows.numel()) if i not in self.fixed]

    def at(self, row: int) -> list[ca.SX] | None:
        """Rows free of p, of which this one is a convex combination for each p; None where it is none of such."""
        return mixture_corners(self.rows[row], self.p, self.lower, self.upper)


def set_from_rows(x: ca.SX, rows: ca.SX) -> ConvexSet:
    """{x : rows >= 0}, its rows named by themselves."""
    return ConvexSet(x, rows, [str(row) for row in ca.vertsplit(rows)] if rows.numel() else [])


def outer_set(C: MovingSet) -> ConvexSet:
    """A set that holds C(p) for all p: the rows that do not move, and a box around each of the others.

    Where sum w_k c_k(x) >= 0 some c_k(x) >= 0, so that x lies in the box of one of the {c_k >= 0}.
    """
    rows = [C.rows[i] for i in C.fixed]
    for at in (C.at(i) for i in C.moving):
        hulls = [set_from_rows(C.x, row).bounding_box for row in at or ()]
        for j in range(C.x.numel() if hulls else 0):
            low, high = min(hull[0][j] for hull in hulls), max(hull[1][j] for hull in hulls)
            rows += [C.x[j] - low] * bool(np.isfinite(low)) + [high - C.x[j]] * bool(np.isfinite(high))
    return set_from_rows(C.x, stack_column(rows))


def is_convex_for_all(C: MovingSet, lower: np.ndarray, upper: np.ndarray, *, quick: bool) -> HypothesisPart | None:
    """Whether C(p) is convex for all p: every row is concave in x; None where that is not proved."""
    whole = outer_set(C)
    part = is_convex_set(whole, lower, upper, quick=quick)
    if part.verdict != HOLDS:
        return None
    z, low, high, local = ca.vertcat(C.x, C.p), *whole.bounding_box, part.local
    for i in C.moving:
        at = C.at(i)
        if at is not None and all(shape.concave for shape in convexity.global_curvatures(stack_column(at), C.x)):
            continue
        ends = np.append(low, C.lower), np.append(high, C.upper)
        if convexity.curvatures(C.rows[i], z, *ends, of=C.x)[0].concave:
            continue
        H = ca.hessian(C.rows[i], C.x)[0]
        inside = whole.part(lower, upper)
        for box, own in ((whole.bounding_box, False), (inside, True)):
            ends = np.append(box[0], C.lower), np.append(box[1], C.upper)
            smooth = interval.is_continuous(ca.vertcat(C.rows[i], ca.gradient(C.rows[i], C.x)), z, *ends)
            if smooth and extremum.largest_eigenvalue(H, z, *ends, bound_to=0.0, quick=quick).bound <= 0:
                local = local or own
                break
        else:
            return None
    return HypothesisPart(HOLDS, "every constraint is concave in the states for all values", {}, {}, local)


def has_interior_for_all(C: MovingSet, start: np.ndarray) -> InteriorProof | None:
    """Whether each C(p) has a strictly feasible point: one for each cell of p, by bounds of the rows; None: not proved.

    Args:
        C: the sets.
        start: a point to look from.
    """
    if not C.rows.numel():
        return InteriorProof(HypothesisPart(HOLDS, "the whole space", {}, {}), 0.0)
    if not C.moving:
        part = has_interior(set_from_rows(C.x, C.rows), start)
        return InteriorProof(part, _rounded_up_norm(part.witness["interior point"])) if part.verdict == HOLDS else None
    z = ca.vertcat(C.x, C.p)
    left, points, margin, count = [(C.lower, C.upper)], [np.zeros(C.x.numel()), start], np.inf, 0
    used: list[np.ndarray] = []
    while left:
        low, high = left.pop()
        middle, count = low + (high - low) / 2, count + 1
        found = has_interior(set_from_rows(C.x, ca.substitute(C.rows, C.p, ca.DM(middle))), points[-1])
        if found.verdict != HOLDS or count > MAX_PARAMETER_CELLS:
            return None
        own = [*points, *used[-1:], np.asarray(found.witness["interior point"])]
        least = [float(np.min(interval.enclose(C.rows, z, np.append(x, low), np.append(x, high))[0])) for x in own]
        best = int(np.argmax(least))
        if least[best] > 0:
            margin = min(margin, least[best])
            used.append(own[best])
            continue
        i = int(np.argmax((high - low) / (C.upper - C.lower)))
        if not low[i] < middle[i] < high[i]:
            return None
        cut = np.arange(low.size) == i
        left += [(low, np.where(cut, middle, high)), (np.where(cut, middle, low), high)]
    one = len(used) == 1
    how = f"a strictly feasible point {'for all values' if one else f'in each of {len(used)} cells of the parameters'} (bounds)"
    part = HypothesisPart(HOLDS, how, {INTERIOR_MARGIN: margin}, {"interior point": used[0]} if one else {})
    return InteriorProof(part, max(_rounded_up_norm(point) for point in used))


def _rounded_up_norm(point: np.ndarray) -> float:
    return float(np.linalg.norm(point)) * (1 + 1e-12)
