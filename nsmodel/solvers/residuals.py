"""Residuals from the definition of the law, without unit; what counts as rounding.

A row passes if |r| <= tolerance * s + c u E: s is what moves or acts in the step, E the running error bound of evaluating the
row in units of u (`rounding.rounding_error_bound`, and `rounding.solution_errors` for what the unknowns themselves err by),
c = ROUNDING. Terms that cancel enter with u, never with the tolerance. What is reported is |r| / (s + c u E / tolerance), to be
at most the tolerance.

With y = W l + b = b + Y_z (Z l) + Y_l l, w_i = max_j |W_ij| and s_y = |b| + |Y_z| |Z l| + |Y_l| |l|, s_l,i = s_y,i / w_i, the
law's residual is the least max(|l - l^| / s_l, |y - y^| / s_y) over points (l^, y^) of the graph {-y^ ∈ N_K(l^)}; 0/0 = 0. Z l is
how far the multipliers move z: where they oppose one another, what they move counts, not what they cancel. Where W and b are all
that is known (`mlcp`), |W| |l| stands for it. Of a curved block, in norms of its rows, a point within sqrt(2) of the least is
taken (`_curved_residual`). Two limits on these scales:
- s_l stays below the size of l_i, of its bounds, and of 1e-6 of the other multipliers in its unit: where y is far from 0, an
  l off its bound would else be measured against what it takes to move y (4e-3 would pass for the relay oscillator);
- s_y stays below 1000 sqrt(w_i) max_k |b_k| / sqrt(w_k): multipliers that grow without bound, because the step has no
  solution, do not excuse a violation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import EPS, cached_per_object
from nsmodel.modeling.laws import CurvedSet, Law
from nsmodel.modeling.laws.base import safe_norm
from nsmodel.solvers.rounding_errors import INSIDE

# ROUNDING: E is of first order, and of one way to evaluate the row.
ROUNDING = 8  # c: the part of E that a row may err by, in units of u. (~)
# NEGLIGIBLE_MULTIPLIER: less asks for digits that rounding of the others takes, more forgives errors of small ones.
NEGLIGIBLE_MULTIPLIER = 1e-6  # Part of the largest multiplier that another one need not resolve better than to the tolerance. (+)
UNRESOLVED = 1e-280  # Scales below this are lost in denormal numbers: a tolerance of 1e-28 of it is the least normal one.
# REACH: a tenth of it refuses steps of two models of tests.search.constants that are right.
REACH = 1 / 3  # Part of the motion that a constraint may be off its linearisation: a ball's normal turns by 37 degrees.
# GROWTH: more excuses steps that have no solution.
GROWTH = 1e3  # How far the multipliers' terms may raise the scale of y above that of b. (+)
# UNSEEN: 4500 EPS.
UNSEEN = 1e-12  # Part of c s_y from which on the rounding of l counts as a distance from the graph of a curved set. (+)
CLEAR = 1e-2  # Part of the tolerance up to which a residual is told as it is; above, rounding may be excused. (+)
STRICTER = 10  # The affine problem of a step is solved to the tolerance divided by this: E and Y add their own rounding. (~)


@dataclass(frozen=True)
class NumericLaw:
    """K with numbers: the box [lower, upper] (m,), and the rows of each curved block with its set."""

    lower: np.ndarray
    upper: np.ndarray
    curved: tuple[tuple[slice, CurvedSet], ...]

    @property
    def size(self) -> int:
        """Number of rows m."""
        return self.lower.size

    @cached_property
    def is_normal_cone(self) -> bool:
        """Whether the law is -y ∈ N_K(l); else some blocks are -ŷ(y) ∈ N_K(l) (see `CurvedSet`)."""
        return all(K.is_normal_cone for _, K in self.curved)

    @property
    def is_complementarity(self) -> bool:
        """Whether every row is 0 <= l ⟂ y >= 0."""
        return bool((self.lower == 0).all() and np.isposinf(self.upper).all() and not self.curved)


@cached_per_object
def numeric_law(law: Law) -> NumericLaw:
    """Return the law with its bounds evaluated (they must be constants)."""
    lower, upper = np.array(ca.DM(law.lower)).ravel(), np.array(ca.DM(law.upper)).ravel()
    curved = ((rows, block.curved()) for rows, block in law.parts())
    return NumericLaw(lower, upper, tuple((rows, K) for rows, K in curved if K is not None))


class ResidualOperations(NamedTuple):
    """What the residual is computed by: NumPy, of numbers, or CasADi, in symbols; `codegen.laws` writes it as C."""

    abs: Callable
    max: Callable
    min: Callable
    where: Callable
    choose: Callable  # `where` of a mask of numbers: what is not chosen leaves nothing in a graph.
    largest: Callable  # Of the entries that a mask of numbers chooses; 0 where it chooses none.
    lesser: Callable  # (a, b, end): the lesser of two, b where an end of the law is finite alone.
    ratio: Callable  # (a, s): a/s with 0/0 = 0.


def _select_entries(mask: np.ndarray, a: Any, b: Any) -> ca.SX:
    return ca.vertcat(*((a if holds else b)[i] for i, holds in enumerate(mask)))


NUMPY_OPERATIONS = ResidualOperations(
    np.abs, np.maximum, np.minimum, np.where, np.where, lambda mask, a: a.max(where=mask, initial=0.0),
    lambda a, b, end: np.where(np.isfinite(end), np.minimum(a, b), a), lambda a, s: np.where(a == 0, 0, a / s),
)  # fmt: skip
CASADI_OPERATIONS = ResidualOperations(
    ca.fabs, ca.fmax, ca.fmin, ca.if_else, _select_entries,
    lambda mask, a: ca.mmax(ca.vertcat(*(a[int(i)] for i in np.flatnonzero(mask)))) if mask.any() else ca.SX(0),
    lambda a, b, end: _select_entries(np.isfinite(end), ca.fmin(a, b), a), lambda a, s: ca.if_else(a == 0, 0, a / s),
)  # fmt: skip


def output_scale(b: Any, terms: Any, w_max: np.ndarray, op: ResidualOperations = NUMPY_OPERATIONS) -> Any:
    """s_y (m,) from b, the terms of W l, and w_max."""
    size, root, acts = op.abs(b), np.sqrt(w_max), w_max > 0
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        cap = GROWTH * root * op.largest(acts, size / root)
        return op.choose(acts, op.min(size + terms, op.max(cap, size)), size)


def law_residual(
    law: NumericLaw, l: np.ndarray, y: np.ndarray, s_y: np.ndarray, w_max: np.ndarray, unseen: np.ndarray | float = 0.0
) -> np.ndarray:
    """Return the residual of each row (m,): y the output, s_y its scale, w_max = max_j |W_ij|, unseen = c u E / tolerance of y.

    Rounding never excuses an l that is outside K: there is an index set on which it is not.
    """
    s_y = np.maximum(s_y + unseen, UNRESOLVED)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        s_l = multiplier_scale(law, l, s_y, w_max)
        residual = box_residual(law, l, y, s_y, s_l)
        for block in law.curved:
            residual[block[0]] = _curved_residual(block, l, y, s_y, s_l, w_max)
    return np.where(np.isnan(residual) | ~(np.isfinite(l) & np.isfinite(y) & np.isfinite(s_y)), np.inf, residual)


def symbolic_box_residual(law: NumericLaw, rows: list[int], w_max: np.ndarray, l: ca.SX, y: ca.SX, s_y: ca.SX) -> ca.SX:
    """The largest residual of the given rows of a box."""
    if not rows:
        return ca.SX(0)
    best = box_residual(law, l, y, s_y, multiplier_scale(law, l, s_y, w_max, CASADI_OPERATIONS), CASADI_OPERATIONS)
    worst = ca.SX(0)
    for i in rows:
        # fmax and fmin pass over a NaN; comparisons with one are false.
        finite = ca.logic_and(ca.logic_and(ca.fabs(l[i]) < ca.inf, ca.fabs(y[i]) < ca.inf), s_y[i] < ca.inf)
        worst = ca.fmax(worst, ca.if_else(finite, ca.if_else(best[i] < ca.inf, best[i], ca.inf), ca.inf))
    return worst


def box_residual(law: NumericLaw, l: Any, y: Any, s_y: Any, s_l: Any, op: ResidualOperations = NUMPY_OPERATIONS) -> Any:
    """The residual of each row of a box: to where l is between its ends, to its lower and to its upper end."""
    lo, up, size = law.lower, law.upper, op.abs(y)

    def relative_distance(of_l: Any, of_y: Any) -> Any:
        return op.max(op.ratio(of_l, s_l), op.ratio(of_y, s_y))

    best = relative_distance(op.max(op.max(lo - l, l - up), 0), size)
    for end, wrong in ((lo, y < 0), (up, y > 0)):
        best = op.lesser(best, relative_distance(op.abs(l - end), op.where(wrong, size, 0)), end)
    return best


def largest_bound(law: NumericLaw) -> np.ndarray:
    """The largest finite bound of each row, in absolute value (m,); 0 where none is finite."""
    return np.maximum(*(np.where(np.isfinite(bound), np.abs(bound), 0.0) for bound in (law.lower, law.upper)))


def multiplier_scale(law: NumericLaw, l: Any, s_y: Any, w_max: np.ndarray, op: ResidualOperations = NUMPY_OPERATIONS) -> Any:
    """s_l (m,): s_y / w, at most max(|l_i|, its finite bounds, 1e-6 max_j |l_j| sqrt(w_j / w_i)); a radius counts as a bound."""
    size, root, acts = op.abs(l), np.sqrt(w_max), w_max > 0
    others = op.choose(acts, NEGLIGIBLE_MULTIPLIER * op.largest(root >= 0, size * root) / root, np.zeros(w_max.size))
    scale = op.max(op.max(size, largest_bound(law)), others)
    if op is NUMPY_OPERATIONS:
        for rows, K in law.curved:
            scale[rows] = max(safe_norm(size[rows]), K.radius if K.is_bounded else 0.0, others[rows].max())
    return op.choose(acts, op.min(s_y / w_max, scale), scale)


def _curved_residual(block: Any, l: Any, y: Any, s_y: Any, s_l: Any, w_max: Any) -> float:
    """|l - P_K(l - c ŷ)| / (c s_y), ŷ = y where the law is a normal cone.

    By Minty (P_K(u), (P_K(u) - u)/c), u = l - c ŷ, is a point of the graph. In units s_l and s_y (c = s_l / s_y, at most 1 / w)
    that is at most sqrt(2) from the nearest point, as P_K is firmly nonexpansive. With c = 1 / w an l that is small beside
    s_y / w would be judged by the rounding of y / w. Contacts of ŷ != y are judged by 0 <= l_N ⟂ y_N >= 0 too, and by l = 0 where
    y_N > 0: in ŷ_N = y_N + mu |y_T| a large mu hides y_N.
    """
    rows, K = block
    l, y = l[rows], y[rows]
    c = 1 / w_max[rows].max() if w_max[rows].any() else 1.0
    of_l, of_y = s_l[rows].max(), safe_norm(s_y[rows])
    if of_l > UNRESOLVED * of_y:
        c = min(c, of_l / of_y)
    moved = c * K.shifted(y)
    u = l - moved
    nearest = K.project(u)
    distance = safe_norm(moved) if (nearest == u).all() else safe_norm(l - nearest)
    if moved[0] != c * y[0]:
        distance = max(distance, abs(min(l[0], c * y[0])), min(safe_norm(l), c * y[0]))
    if (unseen := EPS * safe_norm(l)) > UNSEEN * c * of_y:  # y is lost in the rounding of l
        distance = max(distance, unseen)
    return float(distance / (c * of_y)) if distance else 0.0


def symbolic_max(items: list[ca.SX]) -> ca.SX:
    """The largest of some sizes; inf where one is not a number."""
    worst = ca.SX(0)
    for item in items:
        # fmax passes over a NaN; comparisons with one are false.
        worst = ca.fmax(worst, ca.if_else(item < ca.inf, item, ca.inf))
    return worst


def symbolic_index_set_check(law: NumericLaw, rows: list[int], l: Any, y: Any, free: Any, round_off: Any) -> Any:
    """1 where (l, y) needs no other index set: free l inside its bounds, y of the right sign at a bound; else 0."""
    good = ca.SX(1)
    for i in rows:
        lo, up = law.lower[i], law.upper[i]
        inside = ca.fmax(ca.fmax(lo - l[i], l[i] - up), 0) <= INSIDE * EPS * ca.fabs(l[i])
        at_lower = ca.logic_and(l[i] == lo, y[i] >= -round_off[i])
        at_upper = ca.logic_and(l[i] == up, y[i] <= round_off[i])
        good = ca.logic_and(good, ca.if_else(free[i], inside, ca.logic_or(at_lower, at_upper)))
    return good
