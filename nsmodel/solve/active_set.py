"""y = W l + b, -y ∈ N_[lower, upper](l) by index sets: polish, primal-dual active set, Lemke's pivoting, enumeration.

Codes of an index set: 0 where y_i = 0, -1 where l_i = lower_i, +1 where l_i = upper_i.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, product

import numpy as np

from nsmodel.solve.certificate import EPS, NumericLaw


def polish(W: np.ndarray, b: np.ndarray, law: NumericLaw, index: np.ndarray) -> np.ndarray | None:
    """Return l with y = 0 on the rows coded 0 and l at its bound elsewhere; None where that has no solution."""
    l = np.where(index < 0, law.lower, np.where(index > 0, law.upper, 0.0))
    if not np.isfinite(l).all():
        return None
    free = np.flatnonzero(index == 0)
    if free.size:
        rhs = -(b[free] + W[free] @ l)
        l[free] = solve_or_least_squares(W[np.ix_(free, free)], rhs)
    return l if np.isfinite(l).all() else None


def solve_or_least_squares(A: np.ndarray, rhs: np.ndarray) -> np.ndarray:
    """Solve A x = rhs with one refinement; the least-squares solution of least norm where A is singular."""
    try:
        x = np.linalg.solve(A, rhs)
        x += np.linalg.solve(A, rhs - A @ x)
    except np.linalg.LinAlgError:
        return np.linalg.lstsq(A, rhs, rcond=None)[0]
    size = np.abs(A) @ np.abs(x)
    # Cancellation by 1e12 means that A is singular to rounding: take the solution of least norm instead.
    if np.isfinite(x).all() and size.max() <= 1e12 * np.abs(rhs).max():
        return x
    return np.linalg.lstsq(A, rhs, rcond=None)[0]


def classify(l: np.ndarray, y: np.ndarray, law: NumericLaw, c: np.ndarray) -> np.ndarray:
    """Return the index set that (l, y) suggests: -1 where l - c y <= lower, +1 where l - c y >= upper, else 0.

    A tie (l at its bound and y = 0) goes to the bound, unless the box is a point.
    """
    u = l - c * y
    return np.where(u <= law.lower, -1, np.where(u >= law.upper, 1, 0)).astype(np.int8)


def row_scale(W: np.ndarray) -> np.ndarray:
    """c_i = 1 / max_j |W_ij|: makes l and c y comparable; 1 for a row of zeros."""
    w = np.abs(W).max(axis=1, initial=0.0)
    return np.where(w > 0, 1 / np.where(w > 0, w, 1), 1.0)


def primal_dual(
    W: np.ndarray, b: np.ndarray, law: NumericLaw, index: np.ndarray, sweeps: int = 12
) -> tuple[np.ndarray, np.ndarray] | None:
    """Iterate polish and classify from ``index`` until the set repeats; None if it cycles or breaks."""
    seen: set[bytes] = set()
    for _ in range(sweeps):
        l = polish(W, b, law, index)
        key = index.tobytes()
        if l is None or key in seen:
            return None
        seen.add(key)
        y = W @ l + b
        y[index == 0] = 0.0
        l_in = np.clip(l, law.lower, law.upper)
        tiny = 8 * EPS * np.abs(l)
        settled = np.where(index == 0, np.abs(l - l_in) <= tiny, index * y <= 0)
        if settled.all():
            return l, index
        index = np.where(settled, index, np.where(index == 0, np.where(l < law.lower, -1, 1), 0)).astype(np.int8)
    return None


def lemke(W: np.ndarray, b: np.ndarray, law: NumericLaw, pivots: int = 20) -> np.ndarray | None:
    """Lemke's complementary pivoting; None where it ends in a ray (for psd W: there is no solution) or does not end.

    One-sided rows are shifted to 0 <= l' ⟂ y' >= 0; an upper bound beside a lower one adds a slack row; a free row is split
    in two. For psd W the method ends with a solution or proves that there is none (Cottle, Pang and Stone, Theorem 4.4.12).
    """
    columns, offset, signs = _standard_form(law)
    M, q = signs[:, None] * W[np.ix_(columns, columns)] * signs, signs * (b + W @ offset)[columns]
    caps = np.flatnonzero(np.isfinite(law.lower) & np.isfinite(law.upper))
    where = [int(np.flatnonzero(columns == i)[0]) for i in caps]
    n, k = len(columns), len(caps)
    if k:
        S = np.zeros((n, k))
        S[where, range(k)] = 1
        M = np.block([[M, S], [-S.T, np.zeros((k, k))]])
        q = np.concatenate([q, (law.upper - law.lower)[caps]])
    z = _lemke_standard(M, q, pivots * (n + k) + 50)
    if z is None:
        return None
    l = offset.copy()
    np.add.at(l, columns, signs * z[:n])
    return l


def _standard_form(law: NumericLaw) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    has_lo, has_up = np.isfinite(law.lower), np.isfinite(law.upper)
    free = np.flatnonzero(~has_lo & ~has_up)
    offset = np.where(has_lo, law.lower, np.where(has_up, law.upper, 0.0))
    columns = np.concatenate([np.arange(law.size), free])
    signs = np.concatenate([np.where(has_lo | ~has_up, 1.0, -1.0), -np.ones(free.size)])
    return columns, offset, signs


def _lemke_standard(M: np.ndarray, q: np.ndarray, pivots: int) -> np.ndarray | None:
    """Solve 0 <= z ⟂ M z + q >= 0 with the covering vector d (rows scaled to 1)."""
    n = q.size
    if (q >= 0).all():
        return np.zeros(n)
    scale = np.maximum(np.abs(M).max(axis=1, initial=0.0), np.abs(q))
    scale[scale == 0] = 1
    # Columns: w (0..n-1), z (n..2n-1), z0 (2n), right-hand side. Tableau of w - M z - d z0 = q.
    T = np.hstack([np.eye(n), -M / scale[:, None], -np.ones((n, 1)), (q / scale)[:, None]])
    basis, entering = list(range(n)), 2 * n
    row = int(np.argmin(T[:, -1]))
    for _ in range(pivots):
        T[row] /= T[row, entering]
        others = np.arange(n) != row
        T[others] -= np.outer(T[others, entering], T[row])
        leaving, basis[row] = basis[row], entering
        if leaving == 2 * n:
            z = np.zeros(2 * n + 1)
            z[basis] = T[:, -1]
            return np.maximum(z[n : 2 * n], 0)
        entering = leaving + n if leaving < n else leaving - n
        column = T[:, entering]
        usable = np.flatnonzero(column > 1e-11 * max(1.0, np.abs(column).max()))
        if not usable.size:
            return None
        ratios = np.maximum(T[usable, -1], 0) / column[usable]
        ties = usable[ratios <= ratios.min() * (1 + 1e-12) + 1e-15]
        artificial = [r for r in ties if basis[r] == 2 * n]
        row = int(artificial[0] if artificial else ties[np.argmax(column[ties])])
    return None


def index_sets(law: NumericLaw, last: np.ndarray, most: int = 20000) -> Iterator[np.ndarray]:
    """Every index set of a small law, those nearest to ``last`` first; nothing when there are more than ``most``."""
    choices = [
        [code for code, bound in ((0, 0.0), (-1, lo), (1, up)) if np.isfinite(bound)]
        for lo, up in zip(law.lower, law.upper, strict=True)
    ]
    if np.prod([float(len(c)) for c in choices]) > most:
        return
    usable = np.array([code if code in c else c[0] for code, c in zip(last, choices, strict=True)], np.int8)
    for changes in range(law.size + 1):
        for rows in combinations(range(law.size), changes):
            for codes in product(*([c for c in choices[i] if c != usable[i]] for i in rows)):
                index = usable.copy()
                index[list(rows)] = codes
                yield index
