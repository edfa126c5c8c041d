"""The largest value of an expression, of a norm or of an eigenvalue over a box: the best point found, and a bound."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.proof.expression_graph import Program
from nsmodel.proof.global_search import BoxBounds, SearchGoal, SearchSpace, Supremum, bound_without_search, search_supremum
from nsmodel.proof.global_search import samples as samples
from nsmodel.proof.interval_arithmetic import interval_matrix_product, widen_sums
from nsmodel.proof.interval_bounds import enclose, mean_value_form, natural_extension, validated_boxes
from nsmodel.proof.verdict import connected_components

# A matrix of more entries is bounded without slopes, which are a number for each entry and coordinate: 8 x 8.
MAX_SLOPE_ENTRIES = 64


def supremum(
    expr: ca.SX,
    z: ca.SX,
    lower: np.ndarray,
    upper: np.ndarray,
    *,
    where: ca.SX | None = None,
    points: np.ndarray | None = None,
    quick: bool = False,
    bound_to: float | None = None,
) -> Supremum:
    """Return the largest value of a scalar expression over a box: a point that attains it nearly, and a rigorous bound.

    Args:
        expr: scalar, in the symbols z.
        z: (n, 1) symbols.
        lower, upper: (n,); ends may be infinite.
        where: rows that are >= 0 where the expression counts; None: everywhere in the box.
        points: (k, n) to look at first; those outside the box are left out.
        quick: look at these and 256 more points, and bound the box as a whole.
        bound_to: what is to be proved: cutting ends as soon as bound <= bound_to, or value > bound_to.

    Raises:
        ValueError: other symbols than z, or no box.
    """
    return search_supremum(_scalar_goal(expr), _search_space(z, lower, upper, where, points, quick, bound_to), -np.inf)


def _search_space(
    z: ca.SX, lower: np.ndarray, upper: np.ndarray, where: ca.SX | None, points: np.ndarray | None, quick: bool,
    bound_to: float | None, bound_alone: bool = False,
) -> SearchSpace:  # fmt: skip
    (low,), (high,) = validated_boxes(z, lower, upper)
    given = np.zeros((0, low.size)) if points is None else np.asarray(points, float).reshape(-1, low.size)
    rows = ca.SX(0, 1) if where is None else ca.vec(ca.densify(ca.SX(where)))
    limit = np.inf if bound_to is None else float(bound_to)
    inside = given[((given >= low) & (given <= high)).all(axis=1)]
    return SearchSpace(ca.vec(ca.SX(z)), low, high, rows, inside, quick, limit, bound_alone)


def _scalar_goal(expr: ca.SX) -> SearchGoal:
    expr = ca.densify(ca.SX(expr))

    def bounds(code: Program, lower: np.ndarray, upper: np.ndarray) -> BoxBounds:
        found = mean_value_form(code, lower, upper)
        slope_lo, slope_hi = found.slope_lo[0], found.slope_hi[0]
        return BoxBounds(found.hi[0], np.maximum(np.abs(slope_lo), np.abs(slope_hi)), slope_lo >= 0, slope_hi <= 0, found)

    return SearchGoal(expr, lambda entries: entries[:, 0], bounds, 1, (expr, [], lambda entries: np.zeros(0)))


# -- matrices ----------------------------------------------------------------------------------------------------------


def spectral_norm(
    J: ca.SX,
    z: ca.SX,
    lower: np.ndarray,
    upper: np.ndarray,
    *,
    where: ca.SX | None = None,
    points: np.ndarray | None = None,
    quick: bool = False,
    bound_to: float | None = None,
    bound_alone: bool = False,
) -> Supremum:
    """Return the largest singular value of a matrix (m, n) over a box; arguments as for ``supremum``.

    ``bound_alone``: nothing but the bound is asked: quick, no points are looked at.
    """
    J, space = ca.SX(J), _search_space(z, lower, upper, where, points, quick, bound_to, bound_alone)
    return _supremum_over_blocks([_block_norm(J[rows, columns]) for rows, columns in _matrix_blocks(J)], space)


def spectral_norm_bounds(J: ca.SX, z: ca.SX, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return rigorous bounds (k,) of the largest singular value over each of k >= 1 boxes (k, n), no box being cut."""
    J, (low, high) = ca.SX(J), validated_boxes(z, lower, upper)
    goals = [_block_norm(J[rows, columns]) for rows, columns in _matrix_blocks(J)] or [_scalar_goal(ca.SX(0))]
    return np.max([bound_without_search(goal, ca.vec(z), low, high) for goal in goals], axis=0)


def distance_to_inverse(Y: np.ndarray, W: ca.SX, z: ca.SX, lower: np.ndarray, upper: np.ndarray) -> float:
    """Return a rigorous bound of |Y W - I| over a box, Y and W (n, n), from bounds of the entries of W; below 1, W is regular."""
    bounds, unit = enclose(W, z, lower, upper), np.eye(len(Y))
    if not np.isfinite(bounds).all():
        return np.inf
    low, high = interval_matrix_product(Y, *bounds)
    return float(_spectral_norm_bound(np.nextafter(low - unit, -np.inf)[None], np.nextafter(high - unit, np.inf)[None])[0])


def largest_eigenvalue(
    S: ca.SX,
    z: ca.SX,
    lower: np.ndarray,
    upper: np.ndarray,
    *,
    where: ca.SX | None = None,
    points: np.ndarray | None = None,
    quick: bool = False,
    bound_to: float | None = None,
    bound_alone: bool = False,
) -> Supremum:
    """Return the largest eigenvalue of a symmetric matrix (its symmetric part) over a box; arguments as for ``supremum``.

    ``bound_alone``: nothing but the bound is asked: quick, no points are looked at.
    """
    S, space = ca.SX(S), _search_space(z, lower, upper, where, points, quick, bound_to, bound_alone)
    n = S.shape[0]
    pattern = np.array(ca.DM(S.sparsity(), 1)) != 0 if S.nnz() else np.zeros((n, n), bool)
    groups = connected_components(pattern | pattern.T)
    return _supremum_over_blocks([_block_eigenvalue(S[group, group]) for group in groups], space)


def _supremum_over_blocks(goals: list[SearchGoal], space: SearchSpace) -> Supremum:
    """Return the largest over the goals; one that cannot exceed what was found already is not looked at closely."""
    best = Supremum(-np.inf, None, -np.inf, 0)
    for goal in goals or [_scalar_goal(ca.SX(0))]:
        found = search_supremum(goal, space, best.value)
        value, at = (found.value, found.at) if found.value > best.value or best.at is None else (best.value, best.at)
        best = Supremum(value, at, max(best.bound, found.bound), max(best.count, found.count))
    return best


def _matrix_blocks(J: ca.SX) -> list[tuple[list[int], list[int]]]:
    """Return rows and columns of the blocks that a matrix falls into under permutations."""
    m, n = J.shape
    pattern = np.zeros((m + n, m + n), bool)
    rows, columns = J.sparsity().get_triplet()
    pattern[rows, m + np.array(columns, int)] = True
    groups = connected_components(pattern | pattern.T)
    return [([i for i in g if i < m], [i - m for i in g if i >= m]) for g in groups if min(g) < m <= max(g)]


def _euclidean_norm(entries: list[ca.SX]) -> ca.SX:
    """Return the Euclidean norm, written so that its slopes stay bounded at 0."""
    total = ca.fabs(entries[0])
    for entry in entries[1:]:
        total = ca.hypot(total, entry)
    return total


def _block_norm(J: ca.SX) -> SearchGoal:
    J = ca.densify(J)
    if min(J.shape) == 1:
        return _scalar_goal(_euclidean_norm(ca.vertsplit(ca.vec(J))))
    if J.shape == (2, 2):
        a, c, b, d = ca.vertsplit(ca.vec(J))
        return _scalar_goal((ca.hypot(a + d, b - c) + ca.hypot(a - d, b + c)) / 2)
    return _matrix_goal(J, True)


def _block_eigenvalue(S: ca.SX) -> SearchGoal:
    S = ca.densify(S)
    if S.shape == (1, 1):
        return _scalar_goal(S)
    if S.shape == (2, 2):
        a, c, b, d = ca.vertsplit(ca.vec(S))
        return _scalar_goal((a + d + ca.hypot(a - d, b + c)) / 2)
    return _matrix_goal(S, False)


def _reshape_entries(entries: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return matrices (..., m, n) from their entries (..., m n), column by column."""
    return entries.reshape(*entries.shape[:-1], *shape[::-1]).swapaxes(-1, -2)


def _matrix_measures(full: np.ndarray, norm: bool) -> np.ndarray:
    """Return the largest singular value or eigenvalue of each matrix (k, m, n)."""
    return np.linalg.norm(full, 2, axis=(1, 2)) if norm else np.linalg.eigvalsh((full + full.swapaxes(1, 2)) / 2)[:, -1]


def _matrix_goal(A: ca.SX, norm: bool) -> SearchGoal:
    """The largest singular value of a matrix, or eigenvalue of its symmetric part."""
    m, n = A.shape

    def bounds(code: Program, lower: np.ndarray, upper: np.ndarray) -> BoxBounds:
        lo, hi, rate = _entry_bounds(code, lower, upper)
        top = (_spectral_norm_bound if norm else _eigenvalue_bound)(
            _reshape_entries(lo.T, A.shape), _reshape_entries(hi.T, A.shape)
        )
        return BoxBounds(top, rate, rate == 0, rate == 0, None)

    def begin(entries: np.ndarray) -> np.ndarray:
        full = _reshape_entries(entries, A.shape)
        if not norm:
            return np.linalg.eigh((full + full.T) / 2)[1][:, -1]
        left, _, right = np.linalg.svd(full)
        return np.concatenate([left[:, 0], right[0]])

    left, right = ca.SX.sym("u", m), ca.SX.sym("v", n)
    ascent = (ca.bilin(A, left, right), [left, right]) if norm else (ca.bilin(A, right, right), [right])
    return SearchGoal(
        A,
        lambda entries: _matrix_measures(_reshape_entries(entries, A.shape), norm),
        bounds,
        2 * m * n * min(m, n),
        (*ascent, begin),
    )


def _entry_bounds(code: Program, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return bounds (numel, k) of the entries, and of the rate (k, n) of change of the matrix by each coordinate."""
    if len(code.outputs) <= MAX_SLOPE_ENTRIES:
        lo, hi, slope_lo, slope_hi, *_ = mean_value_form(code, lower, upper)
        with np.errstate(all="ignore"):
            return lo, hi, np.sqrt((np.maximum(np.abs(slope_lo), np.abs(slope_hi)) ** 2).sum(axis=0))
    rate = np.zeros(lower.shape)
    rate[:, sorted(frozenset().union(*(code.uses[j] for j in code.outputs)))] = np.inf
    return *natural_extension(code, lower, upper), rate


def _middle_and_radius(lo: np.ndarray, hi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the middle of interval matrices (k, m, n) and a bound of the distance from it, entry by entry."""
    with np.errstate(all="ignore"):
        middle = lo + (hi - lo) / 2
    middle = np.where(np.isfinite(middle), middle, 0.0)
    with np.errstate(all="ignore"):
        return middle, np.nextafter(np.maximum(hi - middle, middle - lo), np.inf)


def _spectral_norm_bound(lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """Bounds (k,) of the largest singular value of interval matrices (k, m, n)."""
    m, n = lo.shape[1:]
    size, (middle, radius) = np.maximum(np.abs(lo), np.abs(hi)), _middle_and_radius(lo, hi)
    with np.errstate(all="ignore"):
        frobenius = widen_sums(np.sqrt((size**2).sum(axis=(1, 2))), m * n)
        by_sums = widen_sums(np.sqrt(size.sum(axis=1).max(axis=1) * size.sum(axis=2).max(axis=1)), m + n)
        scale = np.sqrt((middle**2).sum(axis=(1, 2)))
        spectral = np.linalg.norm(middle, 2, axis=(1, 2)) + 16 * (m + n) * np.finfo(float).eps * scale
        around = widen_sums(spectral + np.sqrt((radius**2).sum(axis=(1, 2))), m * n)
    return _tightest_bound(frobenius, by_sums, around)


def _eigenvalue_bound(lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """Bounds (k,) of the largest eigenvalue of the symmetric parts of interval matrices (k, n, n)."""
    n = lo.shape[1]
    lo, hi = np.nextafter((lo + lo.swapaxes(1, 2)) / 2, -np.inf), np.nextafter((hi + hi.swapaxes(1, 2)) / 2, np.inf)
    size, (middle, radius) = np.maximum(np.abs(lo), np.abs(hi)), _middle_and_radius(lo, hi)
    diagonal = np.arange(n)
    with np.errstate(all="ignore"):
        off = size.copy()
        off[:, diagonal, diagonal] = 0.0
        discs = np.nextafter(hi[:, diagonal, diagonal] + widen_sums(off.sum(axis=2), n), np.inf).max(axis=1)
        scale = np.sqrt((middle**2).sum(axis=(1, 2)))
        slack = 32 * n * np.finfo(float).eps * scale
        radius_norm = np.minimum(
            widen_sums(np.sqrt((radius**2).sum(axis=(1, 2))), n * n), widen_sums(radius.sum(axis=2).max(axis=1), n)
        )
        around = np.nextafter(np.linalg.eigvalsh(middle)[:, -1] + widen_sums(radius_norm + slack, 4), np.inf)
    return _tightest_bound(discs, around)


def _tightest_bound(*bounds: np.ndarray) -> np.ndarray:
    """Return the least of several bounds; NaN is no bound."""
    return np.minimum.reduce([np.where(np.isnan(bound), np.inf, bound) for bound in bounds])
