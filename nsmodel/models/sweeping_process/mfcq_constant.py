"""Positive combinations of unit normals: the constant gamma of a qualified set of constraints, and bounds of it.

gamma over a box of few states, by parts of the box in which few constraints can be near active: an escape direction each.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.models.sweeping_process.admissible_points import PartialSweepingProcess
from nsmodel.proof.exact import MACHINE_EPSILON, rational
from nsmodel.proof.expression_graph import Program, program
from nsmodel.proof.interval_bounds import bisect_boxes, mean_value_form

# A hull of unit vectors that is nearer to 0 than this contains 0, up to rounding: 450 EPS, of a sum of such vectors.
HULL_TOLERANCE = 1e-13


def mfcq_constant(normals: np.ndarray) -> tuple[float, np.ndarray]:
    """Return gamma with sum l_i |g_i| <= gamma |sum l_i g_i| for all l >= 0, and the weights that attain it.

    With unit normals n_i = g_i / |g_i|, 1/gamma is the distance from 0 to their convex hull: the minimum of |sum u_i n_i| over
    u >= 0, sum u_i = 1, found by Wolfe's method and accurate to 1e-10 as long as gamma < 1e6.

    Args:
        normals: gradients (k, n), not necessarily of length one.

    Returns:
        gamma: 1 where there is no normal, inf where 0 is in the hull: then the gradients are positively dependent.
        weights: the minimiser u (k,).

    >>> mfcq_constant(np.array([[1.0, 0.0], [0.0, 1.0]]))
    (1.414213562373095, array([0.5, 0.5]))
    """
    k = len(normals)
    size = np.linalg.norm(normals, axis=1)
    if k == 0:
        return 1.0, np.zeros(0)
    if not size.all():
        return np.inf, (size == 0) / np.count_nonzero(size == 0)
    N = normals / size[:, None]
    corral, u, z = _initial_corral(N)
    for _ in range(20 * k + 100):
        distance = float(np.linalg.norm(z))
        if distance <= HULL_TOLERANCE:
            break
        products = N @ z
        j = int(np.argmin(products))
        if products[j] >= distance**2 - 32 * MACHINE_EPSILON * distance - 1e-14 * distance**2 or j in corral:
            break
        before = corral, u, z
        corral, u, z = _minor_cycle(N, [*corral, j], np.append(u, 0.0))
        if np.linalg.norm(z) >= distance:
            corral, u, z = before
            break
    weights = np.zeros(k)
    weights[corral] = u
    distance = float(np.linalg.norm(z))
    return (1 / distance if distance > HULL_TOLERANCE else np.inf), weights


def _initial_corral(N: np.ndarray) -> tuple[list[int], np.ndarray, np.ndarray]:
    """A corral to start with: the support of a non-negative least-squares solution, which has 0 nearest for small hulls."""
    from scipy.optimize import nnls

    if len(N) > 2:
        try:
            guess = nnls(np.vstack([N.T, np.ones(len(N))]), np.append(np.zeros(N.shape[1]), 1.0))[0]
        except RuntimeError:  # It did not converge; one vertex is a start too.
            guess = np.zeros(len(N))
        support = [int(i) for i in np.flatnonzero(guess > 1e-12 * guess.max(initial=0.0))]
        if len(support) > 1 and np.linalg.matrix_rank(N[support[1:]] - N[support[0]]) == len(support) - 1:
            return _minor_cycle(N, support, guess[support] / guess[support].sum())
    return [0], np.ones(1), N[0]


def _minor_cycle(N: np.ndarray, corral: list[int], u: np.ndarray) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Go to the point of least norm of the affine hull, dropping what gets a negative weight on the way."""
    while True:
        v, z = _affine_minimum(N[corral])
        if (v > 0).all():
            return corral, v, z
        out = v <= 0
        ratio = np.where(out, u / np.where(out, np.maximum(u - v, 1e-300), 1.0), np.inf)
        u = u + min(1.0, float(ratio.min())) * (v - u)
        keep = np.arange(len(u)) != int(np.argmin(ratio))
        corral, u = [i for i, kept in zip(corral, keep, strict=True) if kept], np.maximum(u[keep], 0.0)


def _affine_minimum(N: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights (sum 1) of the point of least norm of the affine hull of the rows, and that point."""
    if len(N) == 1:
        return np.ones(1), N[0]
    D = (N[1:] - N[0]).T
    y = np.linalg.lstsq(D, -N[0], rcond=None)[0]
    z = N[0] + D @ y
    correction = np.linalg.lstsq(D, -z, rcond=None)[0]  # Once more: z is then orthogonal to D relative to its own size.
    y, z = y + correction, z + D @ correction
    return np.append(1 - y.sum(), y), z


def disc_row_gamma(k: int) -> float:
    """Return gamma of k equal discs in a row, each in contact with the next: sqrt((k^3 - k) / 6), and 1 for k < 2.

    The k - 1 unit normals (-e, e) / sqrt(2) have the Gram matrix tridiag(-1/2, 1, -1/2) =: T/2, all weights of the minimiser are
    positive, and so gamma^2 = 1'(T/2)^{-1} 1 = (k - 1) k (k + 1) / 6.
    """
    return float(np.sqrt((k**3 - k) / 6)) if k > 1 else 1.0


def gram_bound(G: np.ndarray) -> float:
    """Return an upper bound of gamma from lower bounds G (k, k) <= 0 of the scalar products of unit normals; inf: none.

    G has ones on its diagonal. Then |sum u_i n_i|^2 >= u'Gu for u >= 0. A y > 0 with Gy >= 1 shows that G, an M-matrix, is
    positive definite, and 1 <= (u'Gy)^2 <= u'Gu y'Gy where u >= 0, sum u = 1: gamma^2 <= y'Gy. For each subset of the normals
    the same entries of y serve. y is found in floating point and tested exactly.
    """
    try:
        y = np.linalg.solve(G, np.ones(len(G)))
    except np.linalg.LinAlgError:
        return np.inf
    if not (np.isfinite(y).all() and (y > 0).all()):
        return np.inf
    exact_G = rational(G)
    for more in (0.0, 1e-12, 1e-8):
        exact_y = rational(y * (1 + more))
        product = exact_G @ exact_y
        if all(value >= 1 for value in product):
            return sqrt_above(sum(map(operator.mul, exact_y, product), Fraction(0)))
    return np.inf


def hull_bound(rows: Sequence[Sequence[Fraction]]) -> float:
    """Return an upper bound of gamma from gradients, exact: |d| / min <n_i, d> for a good d; inf where d gains nowhere."""
    d = rational(mfcq_direction(np.array([[float(x) for x in row] for row in rows])))
    worst = Fraction(0)
    for row in rows:
        gain = sum((x * y for x, y in zip(row, d, strict=True)), Fraction(0))
        if gain <= 0:
            return np.inf
        worst = max(worst, sum((x * x for x in row), Fraction(0)) / gain**2)
    return max(sqrt_above(worst * sum((x * x for x in d), Fraction(0))), 1.0)


def mfcq_direction(normals: np.ndarray) -> np.ndarray:
    """The point of the hull of the unit normals that is nearest to 0."""
    N = normals / np.linalg.norm(normals, axis=1)[:, None]
    return mfcq_constant(normals)[1] @ N


def sqrt_above(x: Fraction) -> float:
    """A double above the root of x >= 0, next to it but for a few units."""
    r = float(x) ** 0.5 if x < 1e300 else np.inf
    while r < np.inf and Fraction(r) ** 2 < x:
        r = float(np.nextafter(r * (1 + 1e-16), np.inf))
    return r


def sqrt_below(x: Fraction) -> float:
    """A double below the root of x >= 0, next to it but for a few units."""
    r = float(x) ** 0.5
    while Fraction(r) ** 2 > x:
        r = float(np.nextafter(r, 0))
    return r


def row_space(A: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (n, r) of the space of the rows of A (m, n)."""
    _, values, vectors = np.linalg.svd(A, full_matrices=False)
    return vectors[values > 1e-6 * values.max(initial=0.0)].T


CLOSE_RATIO = 1.05  # Cutting ends where the bound is this near to what is attained: constants that follow change by as much.
MAX_SUB_BOXES = 1_500  # Parts of the box looked at; then gamma has the bound found so far,
ENOUGH_SUB_BOXES = 700  # and so many where the bound is within a factor of 2 of what is attained by then.
INSTRUCTION_BUDGET = 250  # With more instructions in the gradients fewer parts are looked at, so that the time stays as it is.
SUB_BOXES_PER_ROUND = 512  # Parts that are cut at once, those with the largest bounds: arrays pay, and few are cut in vain.
MAX_HALVINGS = 12  # Halvings of each coordinate after which a part without bound is not cut any further,
MAX_HALVINGS_ACTIVE = 40  # and the same for rho = 0: there only a tiny part is near to no other constraints than the active ones.
# Where so large a constant is attained, a smaller rho is the better question: what follows from it is useless.
HOPELESS_GAMMA = 1e3


class GammaBound(NamedTuple):
    """gamma(rho) <= ``bound`` on the box; ``value`` is attained at ``at`` (t, q); inf: not bounded after so many parts looked at.

    ``left`` (t, q) is the middle of a part that could not be bounded, with ``rows`` near active there.
    """

    bound: float
    value: float
    at: np.ndarray | None
    looked: int
    left: np.ndarray | None = None
    rows: np.ndarray | None = None


class SubBoxes(NamedTuple):
    """Boxes lower, upper (k, 1 + n): the bound on each (k,), what is near active (k, p), where to cut and how often cut (k,)."""

    lower: np.ndarray
    upper: np.ndarray
    bound: np.ndarray
    near: np.ndarray
    cut: np.ndarray
    depth: np.ndarray

    def take(self, index: np.ndarray) -> SubBoxes:
        """Return some of them."""
        return SubBoxes(*(column[index] for column in self))

    def join(self, other: SubBoxes) -> SubBoxes:
        """Return these and others."""
        return SubBoxes(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


def bound_gamma_on_box(
    process: PartialSweepingProcess, slope: np.ndarray, rho: float, value: float, at: np.ndarray | None,
    known: Callable[[tuple[int, ...]], float], tries: int,
) -> GammaBound:  # fmt: skip
    """Bound gamma(rho) over the box of a process, cutting the parts with the largest bound first.

    On a part J = {j : min g_j <= rho} holds every near-active set, and for each direction d of length 1 the distance from 0 to
    the hull is at least min over J of <n_j, d>; d is the best one at the middle.

    Args:
        process: constraints of few states.
        slope: (p,) upper bounds of |grad g_i|.
        rho: within which a constraint counts.
        value, at: the largest gamma(rho) known, and where; 1 and None if there is none.
        known: bounds for a set J of constraints that hold everywhere; inf where there is none.
        tries: how often larger rho were tried before; then fewer parts are looked at.
    """
    codes = program(process.g, process.z), program(ca.jacobian(process.g, process.q), process.z)
    most = int(MAX_SUB_BOXES * min(1.0, INSTRUCTION_BUDGET / len(codes[1].steps)) / (1 + tries))
    deep = (MAX_HALVINGS if rho else MAX_HALVINGS_ACTIVE) * int(np.count_nonzero(process.upper > process.lower))
    parts = _relevant_sub_boxes(codes, process, process.lower[None], process.upper[None], np.zeros(1, int), slope, rho, known)
    retired, count = 1.0, 1
    while len(parts.bound):
        order = np.lexsort((parts.depth, -parts.bound))
        first = order[0]
        open_end = np.isinf(parts.bound[first])
        stuck = open_end and parts.depth[first] >= deep
        enough = min(ENOUGH_SUB_BOXES, most) if parts.bound[first] <= 2 * value else most
        if count >= enough or (value > HOPELESS_GAMMA and rho > 0) or stuck:
            middle = (parts.lower[first] + parts.upper[first]) / 2
            return GammaBound(
                max(retired, float(parts.bound[first])), value, at, count, middle, np.flatnonzero(parts.near[first])
            )
        chosen, rest = parts.take(order[:SUB_BOXES_PER_ROUND]), parts.take(order[SUB_BOXES_PER_ROUND:])
        lower, upper = bisect_boxes(chosen.lower, chosen.upper, chosen.cut)
        count += len(lower)
        new = _relevant_sub_boxes(codes, process, lower, upper, np.tile(chosen.depth + 1, 2), slope, rho, known)
        best, where = _attained_gamma(process, (new.lower + new.upper) / 2, rho)
        if best > value:
            value, at = best, where
        parts = rest.join(new)
        open_ = parts.bound > CLOSE_RATIO * value
        retired = max(retired, float(parts.bound[~open_].max(initial=1.0)))
        parts = parts.take(open_)
    return GammaBound(retired, value, at, count)


def _relevant_sub_boxes(
    codes: tuple[Program, Program], process: PartialSweepingProcess, lower: np.ndarray, upper: np.ndarray, depth: np.ndarray,
    slope: np.ndarray, rho: float, known: Callable[[tuple[int, ...]], float],
) -> SubBoxes:  # fmt: skip
    """The parts where several constraints may be near active and all may be admissible, with their bounds."""
    lo, hi, slope_lo, slope_hi = mean_value_form(codes[0], lower, upper)[:4]
    near = lo <= rho
    live = (hi >= 0).all(axis=0) & (near.sum(axis=0) > 1)
    lower, upper, near = lower[live], upper[live], near[:, live]
    # Cut the coordinate along which the near constraints vary most; an unbounded one counts by its width.
    rate = np.where(near[:, :, None], np.maximum(np.abs(slope_lo), np.abs(slope_hi))[:, live], 0.0).max(axis=0, initial=0.0)
    width = upper - lower
    reach = np.where(width > 0, np.where(np.isfinite(rate), rate, 1.0), 0.0) * width
    cut = np.argmax(np.where(reach.max(axis=1, keepdims=True) > 0, reach, width), axis=1) if len(lower) else np.zeros(0, int)
    return SubBoxes(lower, upper, _sub_box_bounds(codes[1], process, lower, upper, near, slope, known), near.T, cut, depth[live])


def _sub_box_bounds(
    code: Program, process: PartialSweepingProcess, lower: np.ndarray, upper: np.ndarray, near: np.ndarray, slope: np.ndarray,
    known: Callable[[tuple[int, ...]], float],
) -> np.ndarray:  # fmt: skip
    """Bounds (k,) of gamma(rho) on parts; inf if unknown. Parts with the same J are done together."""
    p, n, k = len(process.rows), len(process.columns), len(lower)
    result = np.ones(k)
    if not k:
        return result
    lo, hi = (end.reshape(n, p, k).transpose(2, 1, 0) for end in mean_value_form(code, lower, upper)[:2])
    middle = (lower + upper) / 2
    G = np.array(process.function.map(k)(middle[:, :1].T, middle[:, 1:].T)[1]).reshape(p, k, n).transpose(1, 0, 2)
    sets, which = np.unique(near, axis=1, return_inverse=True)
    for number in range(sets.shape[1]):
        J, own = np.flatnonzero(sets[:, number]), np.flatnonzero(which.ravel() == number)
        rows = np.ix_(own, J)
        result[own] = np.minimum(_escape_bounds(G[rows], lo[rows], hi[rows], slope[J]), known(tuple(int(j) for j in J)))
    return result


def _escape_bounds(middle: np.ndarray, lo: np.ndarray, hi: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """1 / min_j <n_j, d> (k,) over gradients in [lo, hi] (k, j, n), for the best d at the middle; inf where that is not > 0."""
    with np.errstate(all="ignore"):
        normals = middle / np.linalg.norm(middle, axis=2, keepdims=True)
        if normals.shape[1] == 2:
            d = normals.sum(axis=1)
        else:
            d = np.array([mfcq_constant(N)[1] @ N if np.isfinite(N).all() else N[0] for N in normals])
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        gain = np.minimum(lo * d[:, None], hi * d[:, None]).sum(axis=2)
        longest = np.minimum(slope, np.sqrt((np.maximum(np.abs(lo), np.abs(hi)) ** 2).sum(axis=2)))
        least = (gain / longest).min(axis=1) - 1e-12  # More than what is lost to rounding in these lines.
        return np.where(least > 0, np.maximum(1 / least, 1.0), np.inf)


def _attained_gamma(process: PartialSweepingProcess, points: np.ndarray, rho: float) -> tuple[float, np.ndarray | None]:
    """The largest gamma(rho) at those of the points (k, 1 + n) that are admissible."""
    best, at = 1.0, None
    if not len(points):
        return best, at
    values = np.array(process.function.map(len(points))(points[:, :1].T, points[:, 1:].T)[0])
    for z in points[(values >= 0).all(axis=0) & ((values <= rho).sum(axis=0) > 1)][:200]:
        g, G = process.at(z[0], z[1:])
        if np.isfinite(G).all():
            gamma = mfcq_constant(G[g <= rho])[0]
            if gamma > best:
                best, at = gamma, z
    return best, at
