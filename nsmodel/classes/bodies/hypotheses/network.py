"""gamma of a network of near constraints: the constant of (A5) from the gradients of one or two bodies each.

With unit normals n_i as the rows of N, gamma = min |v| over N v >= 1: the escape velocity with the least length. Groups without
common bodies are independent and their gamma^2 add up; the dual l >= 0 has N'l = v, 1'l = |v|^2, and any l gives the lower
bound 1'l / |N'l|, any v the upper bound |v| / min N v.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

from nsmodel.classes.bodies.schemes.prediction_correction import ContactRows
from nsmodel.classes.sweeping.hypotheses.geometry import mfcq_constant
from nsmodel.proof.verdict import not_none

MAX_WOLFE_GROUP = 40  # Groups of so many constraints are solved by Wolfe's method, exactly but for rounding.
INTERIOR_ITERATIONS = 60
DUALITY_GAP = 1e-7
MAX_GROUP_SIZE = 20_000, 2_000  # Constraints of a group beyond which its gamma takes too long (quick: the second).
OPPOSING_BOUND = 1e7  # A lower bound above this ends the iteration: whether normals oppose each other is then seen on
CORE_SIZE = 200  # so many constraints, those with the largest weights.


class NetworkGamma(NamedTuple):
    """gamma <= ``gamma``; some weights attain ``attained``: inf where normals oppose each other.

    The group with the largest part: its rows and their weights.
    """

    gamma: float
    attained: float
    rows: np.ndarray
    weights: np.ndarray


def network_gamma(rows: ContactRows, quick: bool = False) -> NetworkGamma | None:
    """Return gamma over some constraints where the bodies are; None where one of their groups is too large."""
    second = np.where(rows.pair, rows.second, -1)
    if len(rows.g) and np.bincount(connected_groups(rows.first, second)).max() > MAX_GROUP_SIZE[quick]:
        return None
    return network_constant((rows.G, rows.H), rows.first, second)


def network_constant(slopes: tuple[np.ndarray, np.ndarray], first: np.ndarray, second: np.ndarray) -> NetworkGamma:
    """Return gamma of constraints on bodies.

    Args:
        slopes: gradients (K, d) by the first and by the second body's state.
        first, second: (K,) numbers of bodies; -1: there is no second.
    """
    size = np.sqrt((slopes[0] ** 2).sum(axis=1) + (slopes[1] ** 2).sum(axis=1))
    if not len(size):
        return NetworkGamma(1.0, 1.0, np.zeros(0, int), np.zeros(0))
    if not (size > 0).all():
        flat = np.flatnonzero(~(size > 0))
        return NetworkGamma(np.inf, np.inf, flat, np.full(flat.size, 1 / flat.size))
    normals = np.hstack(slopes) / size[:, None]
    group = connected_groups(first, second)
    order = np.argsort(group, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(group[order])) + 1)
    low = high = float(sum(len(rows) == 1 for rows in parts))
    worst, rows, weights = (1.0, parts[0][:1], np.ones(1)) if low else (0.0, np.zeros(0, int), np.zeros(0))
    for part in parts:
        if len(part) == 1:
            continue
        N = _normals_matrix(normals[part], first[part], second[part])
        if len(part) <= MAX_WOLFE_GROUP:
            gamma, own = mfcq_constant(N.toarray())
            least = gamma
        else:
            least, gamma, own = interior_gamma_bounds(N)
            if least > OPPOSING_BOUND:
                least, gamma, own = _opposing_bounds(N, least, own)
        if least > worst:
            worst, rows, weights = least, part, own
        low, high = low + least**2, high + gamma**2
    return NetworkGamma(float(np.sqrt(high)), float(np.sqrt(low)), rows, weights)


def connected_groups(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return a number (K,) for each constraint, the same for those that share bodies, directly or through others."""
    count = int(max(first.max(initial=-1), second.max(initial=-1))) + 1
    pairs = second >= 0
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    graph = csr_matrix((np.ones(int(pairs.sum())), (first[pairs], second[pairs])), (count, count))
    return connected_components(graph, directed=False)[1][first]


def _normals_matrix(normals: np.ndarray, first: np.ndarray, second: np.ndarray) -> csr_matrix:
    """The unit normals as rows over the states of the bodies in this group."""
    d, pair = normals.shape[1] // 2, second >= 0
    bodies, place = np.unique(np.concatenate([first, second[pair]]), return_inverse=True)
    rows = np.concatenate([np.arange(len(first)), np.flatnonzero(pair)])
    values = np.vstack([normals[:, :d], normals[pair, d:]])
    columns = place.ravel()[:, None] * d + np.arange(d)
    from scipy.sparse import csr_matrix

    return csr_matrix((values.ravel(), (np.repeat(rows, d), columns.ravel())), (len(first), len(bodies) * d))


def interior_gamma_bounds(N: csr_matrix) -> tuple[float, float, np.ndarray]:
    """Return a lower and an upper bound of gamma and the weights (sum 1) of the lower one, by a primal-dual interior method.

    min |v|^2/2 over N v - s = 1, s >= 0: v = N'l, l >= 0, l s = 0; each step solves (I + N' (l/s) N) dv = r, sparse.
    """
    from scipy.sparse import diags, identity
    from scipy.sparse.linalg import splu

    k, n = map(int, not_none(N.shape))
    v, s, l = np.zeros(n), np.ones(k), np.ones(k)
    low, high, best = 0.0, np.inf, np.full(k, 1 / k)
    for _ in range(INTERIOR_ITERATIONS):
        W = l / s
        try:
            matrix = (identity(n) + N.T @ diags(W) @ N).tocsc()
            solve = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}).solve
        except RuntimeError:  # Singular to rounding: the bounds stand.
            break
        r_d, r_p, mu = v - N.T @ l, N @ v - s - 1, float(s @ l) / k

        rest = -r_d - N.T @ (l + W * r_p)
        dv = solve(rest)
        ds = N @ dv + r_p
        dl = -l - W * ds
        step = min(_max_positive_step(s, ds), _max_positive_step(l, dl))
        centring = (float((s + step * ds) @ (l + step * dl)) / k / mu) ** 3
        target = (centring * mu - ds * dl) / s
        dv = solve(rest + N.T @ target)
        ds = N @ dv + r_p
        dl = target - l - W * ds
        step = 0.995 * min(_max_positive_step(s, ds), _max_positive_step(l, dl))
        v, s, l = v + step * dv, s + step * ds, l + step * dl
        if not (np.isfinite(l).all() and np.isfinite(v).all()):
            break
        attained = float(l.sum() / max(np.linalg.norm(N.T @ l), 1e-300))
        if attained > low:
            low, best = attained, l / l.sum()
        least = float((N @ v).min())
        high = min(high, float(np.linalg.norm(v)) / least) if least > 0 else high
        if high <= low * (1 + DUALITY_GAP) or low > OPPOSING_BOUND:
            break
    return low, max(high, low), best


def _opposing_bounds(N: csr_matrix, least: float, weights: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Bounds of gamma and weights where the iteration ended above ``LOST``: is 0 in the hull of the normals that weigh most."""
    core = np.argsort(-weights, kind="stable")[:CORE_SIZE]
    gamma, own = mfcq_constant(N[core].toarray())
    if not np.isinf(gamma):
        return least, np.inf, weights
    found = np.zeros(len(weights))
    found[core] = own
    return np.inf, np.inf, found


def _max_positive_step(x: np.ndarray, dx: np.ndarray) -> float:
    """The largest step in [0, 1] that keeps x >= 0."""
    falls = dx < 0
    return min(1.0, float(np.min(-x[falls] / dx[falls]))) if falls.any() else 1.0
