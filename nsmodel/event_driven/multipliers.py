"""How the multipliers of held rows follow from y and y': generalised inverses of D = h_l and W = h_x g_l, and uniqueness.

The derivatives g_l, h_l and h_x of a problem: numbers where they are constant, else at a point of it.

What rounding is told beside: how large everything has been so far.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from operator import mul
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import sum_in_order
from nsmodel.event_driven.problem import ContinuousProblem
from nsmodel.modeling.expressions import derivatives
from nsmodel.proof.verdict import BufferedFunction, connected_components
from nsmodel.solvers.residuals import ROUNDING
from nsmodel.solvers.rounding_errors import UNIT_ROUND_OFF

MatrixRows = list[list[float]]
HIDDEN = 1e-9  # Of the largest l now: where rounding leaves more of one, C does not decide modes, see `ModeSystem.rounding`.
# SINGULAR: more takes rows of unlike stiffness for tied ones, less rounding for rank.
SINGULAR = 1e-11  # Singular values below this share of the largest, of matrices in their best units, are 0. (+)
CANCELS = 1e-13  # Of the terms of a sum, or of the length of a vector: what comes to less, 450 EPS, is rounding. (+)
ENTRY_ROUNDING = 1 / 8  # Of an inverse of condition 1: an entry is rounded by u of the largest, 1/8 of TERM_ROUNDING.
MAX_MINOR_ROWS = 8  # Rows of a matrix whose principal minors are all looked at: 255 take 4 ms; of more modes are tried.
BALANCING = 4  # Passes that bring the entries of a matrix near 1: each takes roots, four make 10 of 1e16. (+)
NOTHING = 1e-300  # Beside what may be 0, where it divides: less than any size, and its quotients are numbers.
SHORT = 1e-6  # W counts beside D as in a step of this share of the time in which they are equal, as in TINY_STEP. (+)


@dataclass(frozen=True)
class MultiplierSolver:
    """How the multipliers of the rows ``active`` follow, by the matrices ``direct`` (D^+) and ``through`` (N), lists of rows.

    ``lift`` is the least motion of x by which what is held through y' moves by 1, where that is asked for.
    ``null`` is the left null space of both: of rows that nothing can hold at 0.
    """

    active: tuple[int, ...]
    direct: MatrixRows | None
    through: MatrixRows | None
    null: np.ndarray | None
    feeds: bool = False  # Whether some y depends directly on an l that ``through`` finds.
    lift: MatrixRows | None = None
    entries: tuple[float, ...] = ()  # Of both matrices, as `unrolled` takes them.
    condition: float = 1.0  # Of what was inverted, in its best units.
    rounding: np.ndarray | float = 0.0  # Of the entries of ``direct``.

    @property
    def index(self) -> int:
        """1 where l is found to the order of x, else 2: to one less."""
        return 1 if self.through is None else 2

    @cached_property
    def sizes(self) -> tuple[np.ndarray | None, np.ndarray | None]:
        """|direct| and |through|, each with the rounding of its entries."""
        direct = None if self.direct is None else np.abs(self.direct) + self.rounding
        if self.through is None:
            return direct, None
        through = np.abs(self.through)
        for rows, columns in _blocks(through):
            own = through[np.ix_(rows, columns)]
            through[np.ix_(rows, columns)] += _rounding_of_largest(own, self.condition)
        return direct, through


def _rounding_of_largest(A: np.ndarray, condition: float) -> np.ndarray:
    """What each entry of an inverse errs by: a share of the largest of its row and column."""
    largest = float(A.max(initial=0.0))
    return np.outer(A.max(axis=1), A.max(axis=0)) * (ENTRY_ROUNDING * condition / largest) if largest else np.zeros_like(A)


def _blocks(A: np.ndarray) -> list[tuple[list[int], list[int]]]:
    """Rows and columns of the blocks that a square matrix falls into."""
    m = len(A)
    nonzero = np.zeros((2 * m, 2 * m), bool)
    nonzero[:m, m:], nonzero[m:, :m] = A != 0, A.T != 0
    return [([i for i in group if i < m], [i - m for i in group if i >= m]) for group in connected_components(nonzero)]


class ErrorPropagation(NamedTuple):
    """Sizes of what an order of l_a, and of x', errs by: errors of x, and rounding of y_a, of the rate of x, of the next y_a."""

    l_of_x: np.ndarray
    l_of_rounding: np.ndarray
    l_of_y: np.ndarray
    x_of_x: np.ndarray
    x_of_rounding: np.ndarray


def error_propagation(how: MultiplierSolver, A: np.ndarray, B: np.ndarray, D: np.ndarray, C: np.ndarray) -> ErrorPropagation:
    """Of l_a = -D^+ y_a - N y_a', with y_a = C x and x' = A x + B l."""
    n, a = len(A), list(how.active)
    B, C, (direct, through) = B[:, a], C[a], how.sizes
    none = np.zeros((len(a), len(a)))
    plus, N = (none if matrix is None else np.array(matrix) for matrix in (how.direct, how.through))
    F, P = A - B @ plus @ C, np.eye(n) - B @ N @ C
    of_y = none if direct is None else direct
    of_l = np.hstack([of_y, N @ C, none if through is None else through])
    of_x = np.hstack([P @ B @ plus, P, B @ N])
    return ErrorPropagation(*map(np.abs, (plus @ C + N @ C @ F, of_l, of_y, P @ F, of_x)))


def multiplier_solver(
    active: tuple[int, ...], B: np.ndarray, D: np.ndarray, C: np.ndarray, *, lifts: bool = False
) -> MultiplierSolver:
    """The matrices of the rows ``active``; ``lifts``: with ``lift``."""
    if not active:
        return MultiplierSolver(active, None, None, None)
    if len(active) == 1 and not lifts:
        return _single_row_solver(active[0], B, D, C)
    a = list(active)
    D_aa, W_aa = D[np.ix_(a, a)], C[a] @ B[:, a]
    plus, U, V, condition, rounding = generalised_inverse(D_aa)
    if not U.shape[1]:
        return MultiplierSolver(active, plus.tolist(), None, None, condition=condition, rounding=rounding)
    moved = U.T @ W_aa @ V
    moved[np.abs(moved) <= CANCELS * (np.abs(U).T @ np.abs(W_aa) @ np.abs(V))] = 0.0
    inner, left, _, further, _ = generalised_inverse(moved)
    through = V @ inner @ U.T
    lift = np.linalg.pinv(U.T @ C[a]) @ U.T if lifts and np.isfinite(C[a]).all() else None
    return MultiplierSolver(
        active, plus.tolist() if D_aa.any() else None, through.tolist(), U @ left, bool(D[:, a].any()),
        None if lift is None else lift.tolist(), condition=max(condition, further),
        rounding=rounding,
    )  # fmt: skip


def _single_row_solver(i: int, B: np.ndarray, D: np.ndarray, C: np.ndarray) -> MultiplierSolver:
    if d := float(D[i, i]):
        return MultiplierSolver((i,), [[1 / d]], None, None)
    w = float(C[i] @ B[:, i])
    null = np.zeros((1, 0)) if w else np.eye(1)
    return MultiplierSolver((i,), None, [[1 / w if w else 0.0]], null, bool(D[:, i].any()))


def clear_rounding(how: MultiplierSolver, x: MatrixRows, y: MatrixRows, k: int) -> None:
    """Take the rounding of held rows out of order k of x: a state that never moves is 0, and not 1e-20 of nothing."""
    off = [y[i][k] for i in how.active]
    if how.lift is not None and any(off):
        for row, d in zip(x, matrix_times_vector(how.lift, off), strict=True):
            row[k] -= d


class GeneralisedInverse(NamedTuple):
    """A^+, least in norm in units in which A is near 1, bases of the left and the right null space, and A's condition there.

    ``rounding``: of the entries of A^+, in `TERM_ROUNDING`; of a regular A by |A^+| (|I - A A^+| + u |A| |A^+|), entry by entry.
    """

    plus: np.ndarray
    left: np.ndarray
    right: np.ndarray
    condition: float = 1.0
    rounding: np.ndarray | float = 0.0


def generalised_inverse(A: np.ndarray) -> GeneralisedInverse:
    """Of a square matrix, of each of the blocks that it falls into by itself; NaN where it has no numbers."""
    m = len(A)
    if not A.any():
        return GeneralisedInverse(np.zeros((m, m)), np.eye(m), np.eye(m))
    if not (A - np.diag(A.diagonal())).any() and A.diagonal().all():
        return GeneralisedInverse(np.diag(1 / A.diagonal()), np.zeros((m, 0)), np.zeros((m, 0)))
    if not np.isfinite(A).all():
        return GeneralisedInverse(np.full((m, m), np.nan), np.zeros((m, 0)), np.zeros((m, 0)))
    plus, rounding, left, right, condition = np.zeros((m, m)), np.zeros((m, m)), [np.zeros((m, 0))], [np.zeros((m, 0))], 1.0
    for rows, columns in _blocks(A):
        own = _block_inverse(A[np.ix_(rows, columns)])
        plus[np.ix_(columns, rows)], rounding[np.ix_(columns, rows)] = own.plus, own.rounding
        condition = max(condition, own.condition)
        for bases, at, basis in ((left, rows, own.left), (right, columns, own.right)):
            whole = np.zeros((m, basis.shape[1]))
            whole[at] = basis
            bases.append(whole)
    return GeneralisedInverse(plus, np.hstack(left), np.hstack(right), condition, rounding)


def _block_inverse(A: np.ndarray) -> GeneralisedInverse:
    rows, columns = A.shape
    if not A.size:
        return GeneralisedInverse(np.zeros((columns, rows)), np.eye(rows), np.eye(columns))
    r, c = _equilibration_factors(A)
    u, s, vt = np.linalg.svd(A * r[:, None] * c)
    rank = int((s > SINGULAR * s[0]).sum())
    condition = float(s[0] / s[rank - 1])
    if rows == columns and s[-1] > rows * TERM_ROUNDING * s[0] and (own := _regular_inverse(A, rank == rows)) is not None:
        return GeneralisedInverse(own[0], np.zeros((rows, 0)), np.zeros((rows, 0)), float(s[0] / s[-1]), own[1])
    condition *= max([1.0, *(s[rank:] / (TERM_ROUNDING * s[0]))])  # What is left out moves the rest, as rounding does.
    plus = (c[:, None] * vt[:rank].T) @ ((u[:, :rank] / s[:rank]).T * r)
    left, right = (np.where(np.abs(part) > CANCELS, part, 0.0) for part in (u[:, rank:], vt[rank:].T))
    rounding = _rounding_of_largest(np.abs(plus), condition)
    return GeneralisedInverse(plus, r[:, None] * left, c[:, None] * right, condition, rounding)


def _regular_inverse(A: np.ndarray, surely: bool) -> tuple[np.ndarray, np.ndarray] | None:
    """A^-1 and the rounding of its entries; ``surely``: also where it is known to few digits.

    Else None where A A^-1 is far from I: a small D may make A regular, where it stands by itself, and so may rounding.
    """
    plus, one = np.linalg.inv(A), np.eye(len(A))
    plus += plus @ (one - A @ plus)
    size, missed = np.abs(plus), np.abs(one - A @ plus)
    if not surely and not missed.max() <= SINGULAR:
        return None
    return plus, size @ (2 / TERM_ROUNDING * missed + ENTRY_ROUNDING * len(A) * np.abs(A) @ size)


def least_motion(slope: np.ndarray, held: np.ndarray) -> np.ndarray:
    """The d (n,) least in norm with slope d = held, (k, n) and (k,), or next to it."""
    if len(held) == 1 and (squared := slope[0] @ slope[0]) > 0:
        return slope[0] * (held[0] / squared)
    return np.linalg.lstsq(slope, held, rcond=None)[0]


def _equilibration_factors(A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Factors of rows and columns that bring the largest entries near 1 (Ruiz)."""
    r, c = np.ones(len(A)), np.ones(A.shape[1])
    for _ in range(BALANCING):
        S = np.abs(A) * r[:, None] * c
        rows, columns = S.max(axis=1), S.max(axis=0)
        r /= np.sqrt(np.where(rows > 0, rows, 1))
        c /= np.sqrt(np.where(columns > 0, columns, 1))
    return r, c


def is_p_matrix(D: np.ndarray, W: np.ndarray, opened: list[int], held: list[int], *, definite: bool) -> bool:
    """Whether D + a little W has a P-matrix (a ``definite`` one) on rows ``opened``, its Schur complement with the ``held``."""
    d, w = (np.abs(A).max(initial=0.0) for A in (D, W))
    K = D + W * (SHORT * d / w if d and w else 1.0)
    S = K[np.ix_(opened, opened)]
    if held:
        plus, U, *_ = generalised_inverse(K[np.ix_(held, held)])
        if U.shape[1]:
            return False
        S = S - K[np.ix_(opened, held)] @ plus @ K[np.ix_(held, opened)]
    if S.size == 1:
        return bool(S[0, 0] > 0)
    if np.linalg.eigvalsh(S + S.T).min(initial=1.0) > SINGULAR * np.abs(S).max(initial=0.0):
        return True
    if definite or len(opened) > MAX_MINOR_ROWS:
        return False
    subsets = itertools.chain.from_iterable(itertools.combinations(range(len(opened)), r + 1) for r in range(len(opened)))
    return all(
        np.linalg.det(part) > SINGULAR * float(np.prod(np.abs(part).max(axis=1)))
        for part in (S[np.ix_(rows, rows)] for rows in map(list, subsets))
    )


def matrix_times_vector(A: MatrixRows, v: list[float]) -> list[float]:
    """The product of a matrix and a vector."""
    return [sum_in_order(map(mul, row, v)) for row in A]


def is_monotone(B: np.ndarray | None, D: np.ndarray | None, C: np.ndarray | None) -> bool:
    """Whether x is unique whatever is open: D + D' >= 0 and P B = C' with a P = P' > 0, exactly; None where a matrix moves.

    Here g = B l, h = C x + D l + e(t). Two solutions with one x part by no more than f lets them (Brogliato and Goeleven 2013);
    l may be one of several. P exists iff C B is symmetric and psd, ker B lies in ker C' and rank C B = rank B.
    """
    from nsmodel.proof import exact

    if B is None or D is None or C is None or not np.isfinite(np.concatenate([B.ravel(), D.ravel(), C.ravel()])).all():
        return False
    W = exact.matrix_product(C, B)
    rank = exact.rank(B)
    return (
        exact.is_symmetric(W) and exact.is_psd(D) and exact.is_psd(W)
        and exact.rank(W) == rank == exact.rank(np.vstack([B, C.T]))
    )  # fmt: skip


def constant_matrix(matrix: ca.SX, moving: ca.SX) -> np.ndarray | None:
    """The matrix, where it depends on nothing that moves."""
    return None if ca.depends_on(matrix, moving) else np.array(ca.DM(ca.densify(ca.cse(matrix)))).reshape(matrix.shape)


TIE = 1e-12  # What rounding has left in a state, 4500 EPS of its size so far; a condition below this share of its own is 0. (~)
NEGLIGIBLE_MOTION = 1e-6  # Of what moves a state on a piece: what moves less is measured beside that. (~)
TERM_ROUNDING = ROUNDING * UNIT_ROUND_OFF  # c u of running error analysis: of what a number is the sum of, that much is rounding.


@dataclass
class StateScales:
    """The largest of each x, y, l and argument of a switch so far; of l in an interval at least its width."""

    x: list[float]
    y: list[float]
    l: list[float]
    switches: list[float]


class RowScales(NamedTuple):
    """What y and l (m,) of rows whose y depends on l, or that are curved, are measured beside; of others 1."""

    y: list[float]
    l: list[float]


class ZeroTest:
    """``of(t, x, l, sizes, time)``: a part of what x of these sizes move each x by in this time, to first order at a point.

    What moves by less is measured beside it: the same in all units of each x. What multipliers move it by says nothing: where
    walls push against each other they are as large as they like.
    """

    def __init__(self, problem: ContinuousProblem) -> None:
        self._problem = problem

    @cached_property
    def _motion(self) -> BufferedFunction:
        symbols, moved = state_motion(self._problem)
        return BufferedFunction(ca.Function("moves", [ca.vertcat(*symbols.values())], [ca.densify(moved)]))

    def __call__(self, t: float, x: list[float], l: list[float], sizes: list[float], time: float) -> list[float]:
        """0 where there is no number."""
        (found,), part = self._motion([t, *x, *l, *sizes]), NEGLIGIBLE_MOTION * time
        return [part * v if math.isfinite(v) else 0.0 for v in found.ravel().tolist()]


def state_motion(problem: ContinuousProblem) -> tuple[dict[str, ca.SX], ca.SX]:
    """t, x, l and sizes of x; by what states of these sizes move each x in the unit of time."""
    p = problem
    of_x = ca.SX.sym("of_x", p.x.numel())
    return {"t": p.t, "x": p.x, "l": p.l, "of_x": of_x}, ca.fabs(derivatives(p.f + p.g, p.x)) @ of_x
