"""y = W l + b, -y ∈ N_[lower, upper](l) by index sets: polish, primal-dual active set, Lemke's pivoting, enumeration.

Codes of an index set: 0 where y_i = 0, -1 where l_i = lower_i, +1 where l_i = upper_i.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, product

import numpy as np

from nsmodel._utils import EPS
from nsmodel.solvers.residuals import NumericLaw
from nsmodel.solvers.rounding_errors import INSIDE, SUM_ERROR, equilibrate_matrix

MAX_INDEX_SETS = 20000  # More are not tried one by one: 3^9 take two seconds.
PRIMAL_DUAL_SWEEPS = 12  # Index sets that the primal-dual method tries; it settles or cycles soon, then others are tried. (+)
# CANCELLED: 12 of 16 digits are lost.
CANCELLED = 1e12  # Terms of a solution, beside its right-hand side, from which on a matrix seems singular.
EQUILIBRATIONS = 8  # Sweeps of Ruiz' iteration before pivoting: each takes roots, so that 1.2 is left of 1e20. (~)
NOUGHT = 8  # Times EPS: entries below this, of about 1, are round-off of the units and of W. (+)
# REGULARISED: less is round-off beside W after some pivots, more suggests another index set.
REGULARISED = 1e-7  # Added to the diagonal of a W of about 1 where round-off makes a ray of it. (+)
# PIVOTS_EACH: its path may be exponential, but is some rows long in practice.
PIVOTS_EACH, PIVOTS_MORE = 20, 50  # The most pivots of Lemke's method: so many for each row, and so many more.
GONE = 1e-13  # Part of the largest |q| from which on Lemke's artificial variable is 0: 450 EPS. (+)
PREFERRED = 1e-13  # Part of the largest step within which it is that variable which leaves: 450 EPS. (+)
PIVOT_ERROR = 64  # Times EPS: the part of its terms by which an entry of a pivot column may err: more of it refuses pivots. (+)
# MIN_PIVOT: ten times as much, and Lemke's method ends without a solution on two models of tests.search.constants.
MIN_PIVOT = 1e-12  # Part of the largest entry of a pivot column below which none is a pivot; less pivots on round-off.
TIED = 1e-12  # Part of the largest value within which two are equal: then the next column decides, so that none cycles. (+)
RANK = 1e-12  # Singular values below this part of the largest, round-off, are 0 where a regularised answer is polished. (+)
POLISHED = 1e-10  # Part of the sizes of the problem to which it then must be solved; the certificate judges it. (+)


def solve_on_index_set(W: np.ndarray, b: np.ndarray, law: NumericLaw, index: np.ndarray) -> np.ndarray | None:
    """Return l with y = 0 on the rows coded 0 and l at its bound elsewhere; None where that has no solution."""
    l = np.where(index < 0, law.lower, np.where(index > 0, law.upper, 0.0))
    if not np.isfinite(l).all():
        return None
    free = np.flatnonzero(index == 0)
    if not free.size:
        return l
    rhs = -(b[free] + W[free] @ l)
    l[free] = solve_or_least_squares(W[free[:, None], free], rhs)
    return l if np.isfinite(l).all() else None


def solve_or_least_squares(A: np.ndarray, rhs: np.ndarray) -> np.ndarray:
    """Solve A x = rhs with one refinement; the least-squares solution of least norm where A is singular in any units."""
    if not A.any():
        return np.zeros(rhs.shape)
    x = _solve_refined(A, rhs)
    if x is not None:
        return x
    if not (np.isfinite(A).all() and np.isfinite(rhs).all()):  # about which LAPACK would print
        return np.full(rhs.shape, np.nan)
    scaled, rows, columns = equilibrate_matrix(A)
    x = _solve_refined(scaled, rows * rhs)
    return np.linalg.lstsq(A, rhs, rcond=None)[0] if x is None else columns * x


def solve_equilibrated(A: np.ndarray, rhs: np.ndarray) -> np.ndarray:
    """A^-1 rhs of a regular matrix, in units in which it is well scaled; ``rhs`` a matrix.

    Raises:
        numpy.linalg.LinAlgError: A is singular.
    """
    scaled, rows, columns = equilibrate_matrix(A)
    return columns[:, None] * np.linalg.solve(scaled, rows[:, None] * rhs)


def _solve_refined(A: np.ndarray, rhs: np.ndarray) -> np.ndarray | None:
    """A^-1 rhs, or None where A seems singular: cancellation by 1e12."""
    try:
        x = np.linalg.solve(A, rhs)
        if np.isfinite(x).all():
            x = x + np.linalg.solve(A, rhs - A @ x)
    except np.linalg.LinAlgError:
        return None
    size = np.abs(A) @ np.abs(x)
    return x if np.isfinite(x).all() and size.max(initial=0.0) <= CANCELLED * np.abs(rhs).max(initial=0.0) else None


def estimate_index_set(l: np.ndarray, y: np.ndarray, law: NumericLaw, c: np.ndarray) -> np.ndarray:
    """Return the index set that (l, y) suggests: -1 where l - c y <= lower, +1 where l - c y >= upper, else 0.

    A tie (l at its bound and y = 0) goes to the bound, unless the box is a point.
    """
    u = l - c * y
    return np.where(u <= law.lower, -1, np.where(u >= law.upper, 1, 0)).astype(np.int8)


def row_scale(W: np.ndarray) -> np.ndarray:
    """c_i = 1 / max_j |W_ij|: makes l and c y comparable; 1 for a row of zeros."""
    w = np.abs(W).max(axis=1, initial=0.0)
    return np.where(w > 0, 1 / np.where(w > 0, w, 1), 1.0)


def equilibrate_problem(W: np.ndarray, b: np.ndarray, law: NumericLaw) -> tuple[np.ndarray, np.ndarray, NumericLaw, np.ndarray]:
    """The problem in units in which the entries of W and b are about 1: (W, b, box, s), l = s l' (Ruiz' iteration)."""
    s = np.ones(law.size)
    for _ in range(EQUILIBRATIONS):
        scaled = np.abs(s[:, None] * W * s)
        most = np.maximum(scaled.max(axis=1, initial=0.0), scaled.max(axis=0, initial=0.0))
        s = s / np.sqrt(np.where(most > 0, most, 1.0))
    size = np.abs(s * b).max(initial=0.0) or 1.0
    return s[:, None] * W * s, s * b / size, NumericLaw(law.lower / (s * size), law.upper / (s * size), ()), s * size


def primal_dual_active_set(
    W: np.ndarray, b: np.ndarray, law: NumericLaw, index: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Iterate polish and classify from ``index`` until the set repeats; None if it cycles or breaks."""
    seen: set[bytes] = set()
    size_of_W, size_of_b = np.abs(W), np.abs(b)
    for _ in range(PRIMAL_DUAL_SWEEPS):
        l = solve_on_index_set(W, b, law, index)
        key = index.tobytes()
        if l is None or key in seen:
            return None
        seen.add(key)
        y, size = W @ l + b, size_of_W @ np.abs(l) + size_of_b
        called_for = np.where(index * y <= SUM_ERROR * EPS * size, index, 0).astype(np.int8)
        if (free := np.flatnonzero(index == 0)).size:
            called_for[free] = _ends_called_for(l[free], y[free], size[free], law.lower[free], law.upper[free])
        if (called_for == index).all():
            return l, index
        index = called_for
    return None


def _ends_called_for(l: np.ndarray, y: np.ndarray, size: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Of rows coded 0: the end that l is beyond, else the one that y asks for where no l holds it at 0; 0 where neither is."""
    off = np.abs(l - np.minimum(np.maximum(l, lower), upper))
    outside = np.where(off <= INSIDE * EPS * np.abs(l), 0, np.where(l < lower, -1, 1))
    open_ = np.where(np.abs(y) <= POLISHED * size, 0, -np.sign(y))
    open_ = np.where(np.isfinite(np.where(open_ < 0, lower, upper)), open_, 0)
    return np.where(outside == 0, open_, outside)


def lemke(W: np.ndarray, b: np.ndarray, law: NumericLaw) -> np.ndarray | None:
    """Lemke's complementary pivoting; None where it ends in a ray, for psd W because there is no solution.

    One-sided rows are shifted to 0 <= l' ⟂ y' >= 0; an upper bound beside a lower one adds a slack row; a free row is split
    in two. For psd W the method ends with a solution or proves that there is none (Cottle, Pang and Stone, Theorem 4.4.12);
    where round-off makes a ray of a singular W, W + 1e-7 I suggests the index set.
    """
    W, b, law, s = equilibrate_problem(W, b, law)
    W[np.abs(W) < NOUGHT * EPS] = 0  # A pivot on round-off would be a solution at infinity.
    columns, offset, signs = _standard_form(law)
    M, q = signs[:, None] * W[np.ix_(columns, columns)] * signs, signs * (b + W @ offset)[columns]
    caps = np.flatnonzero(np.isfinite(law.lower) & np.isfinite(law.upper))
    n, k = len(columns), len(caps)
    if k:
        S = np.zeros((n, k))
        S[caps, range(k)] = 1
        M = np.block([[M, S], [-S.T, np.zeros((k, k))]])
        q = np.concatenate([q, (law.upper - law.lower)[caps]])
    for regular in (0.0, REGULARISED):
        z = _lemke_pivoting(M + regular * np.eye(n + k), q, PIVOTS_EACH * (n + k) + PIVOTS_MORE)
        if z is None:
            continue
        l = offset.copy()
        np.add.at(l, columns, signs * z[:n])
        l = np.clip(l, law.lower, law.upper)
        found = _solve_on_suggested_set(W, b, law, l) if regular else l
        if found is not None:
            return found * s
    return None


def _solve_on_suggested_set(W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray) -> np.ndarray | None:
    """The solution on l's index set, if it is one: what a regularised problem suggests is not believed otherwise."""
    index = estimate_index_set(l, W @ l + b, law, row_scale(W))
    free, exact = index == 0, np.where(index < 0, law.lower, np.where(index > 0, law.upper, 0.0))
    if free.any():  # W may be singular: the solution of least norm, which is what the regularised one tends to
        exact[free] = np.linalg.lstsq(W[np.ix_(free, free)], -(b[free] + W[free] @ exact), rcond=RANK)[0]
    y = W @ exact + b
    scale = np.abs(b).max(initial=0.0)
    wrong = np.where(index == 0, np.abs(y), np.maximum(index * y, 0)).max(initial=0.0)
    outside = np.maximum(law.lower - exact, exact - law.upper).max(initial=0.0)
    solves = wrong <= POLISHED * scale and outside <= POLISHED * np.abs(exact).max()
    return np.clip(exact, law.lower, law.upper) if solves else None


def _standard_form(law: NumericLaw) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """l = offset + sum of signs z on ``columns``: every row once, free rows a second time with the other sign."""
    has_lo, has_up = np.isfinite(law.lower), np.isfinite(law.upper)
    free = np.flatnonzero(~has_lo & ~has_up)
    offset = np.where(has_lo, law.lower, np.where(has_up, law.upper, 0.0))
    columns = np.concatenate([np.arange(law.size), free])
    signs = np.concatenate([np.where(has_lo | ~has_up, 1.0, -1.0), -np.ones(free.size)])
    return columns, offset, signs


def _lemke_pivoting(M: np.ndarray, q: np.ndarray, pivots: int) -> np.ndarray | None:
    """Solve 0 <= z ⟂ M z + q >= 0. Columns: w (0..n-1), z (n..2n-1), z0 (2n) of w - M z - z0 = q.

    The basis is factored afresh at every pivot, so that round-off does not grow, and ties are broken lexicographically, so
    that degenerate problems do not cycle.
    """
    n = q.size
    if (q >= 0).all():
        return np.zeros(n)
    A = np.hstack([np.eye(n), -M, -np.ones((n, 1))])
    if not (np.isfinite(A).all() and np.isfinite(q).all()):
        return None
    right = np.column_stack([q, np.eye(n)])
    basis, entering = np.arange(n), 2 * n
    row = _lexicographic_min_row(right, np.arange(n))
    for _ in range(pivots):
        leaving, basis[row] = basis[row], entering
        try:
            inverse = np.linalg.inv(A[:, basis])
        except np.linalg.LinAlgError:
            return None
        value = inverse @ q
        artificial = np.flatnonzero(basis == 2 * n)
        if not artificial.size or value[artificial[0]] <= GONE * np.abs(q).max():
            z = np.zeros(2 * n + 1)
            z[basis] = value
            return np.maximum(z[n : 2 * n], 0)
        entering = leaving + n if leaving < n else leaving - n
        column = inverse @ A[:, entering]
        noise = PIVOT_ERROR * EPS * np.abs(inverse) @ np.abs(A[:, entering])
        usable = np.flatnonzero(column > np.maximum(noise, MIN_PIVOT * np.abs(column).max()))
        if not usable.size:
            return None
        table = (inverse @ right)[usable] / column[usable, None]
        if not np.isfinite(table).all():
            return None
        its_row = np.flatnonzero(basis[usable] == 2 * n)
        if its_row.size and table[its_row[0], 0] <= table[:, 0].min() + PREFERRED * np.abs(table[:, 0]).max():
            row = int(usable[its_row[0]])
        else:
            row = int(usable[_lexicographic_min_row(table, np.arange(usable.size))])
    return None


def _lexicographic_min_row(table: np.ndarray, rows: np.ndarray) -> int:
    """The lexicographically least of the rows of a table."""
    for column in table.T:
        values = column[rows]
        rows = rows[values <= values.min() + TIED * np.abs(values).max()]
        if rows.size == 1:
            break
    return int(rows[0])


def row_code_choices(law: NumericLaw) -> list[list[int]]:
    """The codes that each row of a box can have."""
    return [
        [code for code, bound in ((0, 0.0), (-1, lo), (1, up)) if np.isfinite(bound)]
        for lo, up in zip(law.lower, law.upper, strict=True)
    ]


def enumerate_index_sets(law: NumericLaw, last: np.ndarray) -> Iterator[np.ndarray]:
    """Every index set of a small law, those nearest to ``last`` first; nothing when there are more than MAX_INDEX_SETS."""
    codes_of = row_code_choices(law)
    if np.prod([float(len(c)) for c in codes_of]) > MAX_INDEX_SETS:
        return
    usable = np.array([code if code in c else c[0] for code, c in zip(last, codes_of, strict=True)], np.int8)
    free = [i for i, c in enumerate(codes_of) if len(c) > 1]
    for changes in range(len(free) + 1):
        for rows in combinations(free, changes):
            for codes in product(*([c for c in codes_of[i] if c != usable[i]] for i in rows)):
                index = usable.copy()
                index[list(rows)] = codes
                yield index
