"""Strict feasibility of homogeneous conic systems, decided by a certificate in exact rational arithmetic.

The system: A u = 0 with u_j > 0 for some columns, u_c in the interior of a second-order cone for others, the rest free. It has
no solution if and only if some w gives A'w = 0 on the free columns, A'w in the cone (each is its own dual) on the others, and
A'w != 0: the set {A u} is convex and relatively open, so that 0 is separated from it properly when it is not in it. For
signs alone this is Stiemke's alternative, and the simplex method in whole numbers decides it. With second-order cones, and for
large systems, floating point suggests a point or a w, which counts only after it was made exact.

Conic programs, solved by Clarabel without a word.
"""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from math import gcd
from typing import Any, NamedTuple

import numpy as np

from nsmodel.proof import exact
from nsmodel.proof.verdict import not_none


def zero_cone(size: int) -> Any:
    """Clarabel's cone {0} of a dimension."""
    return _import_clarabel().ZeroConeT(size)


def nonnegative_cone(size: int) -> Any:
    """The cone of vectors >= 0."""
    return _import_clarabel().NonnegativeConeT(size)


def lorentz_cone(size: int) -> Any:
    """The cone of vectors (s, v) with |v| <= s."""
    return _import_clarabel().SecondOrderConeT(size)


def semidefinite_cone(order: int) -> Any:
    """The cone of symmetric matrices >= 0, as the scaled columns of their upper triangles."""
    return _import_clarabel().PSDTriangleConeT(order)


def solve_conic_program(
    cost: np.ndarray, A: Any, b: np.ndarray, cones: list[Any], P: Any = None, tolerance: float | None = None
) -> Any:
    """Return Clarabel's solution of min x'Px/2 + cost'x with b - A x in the cones, in their order; the caller verifies it."""
    from scipy import sparse

    clarabel = _import_clarabel()
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    if tolerance is not None:
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    quadratic = sparse.csc_matrix((cost.size, cost.size)) if P is None else P
    return clarabel.DefaultSolver(quadratic, cost, sparse.csc_matrix(A), b, cones, settings).solve()


def _import_clarabel() -> Any:
    """The module, whose names pyright does not see; loaded where it is used."""
    import clarabel

    return clarabel


SIMPLEX_FIRST_ENTRIES = 1000  # Entries of A up to which the exact simplex method goes first: there both methods take 0.1 s.
# Above this it is not tried at all: 5000 entries of two decimals take 0.2 to 10 s, as the numbers in it grow.
MAX_SIMPLEX_ENTRIES = 20000


class ConicSystem(NamedTuple):
    """A u = 0: A (r, n) of Fractions, columns with u_j > 0, groups of columns in the interior of a second-order cone."""

    A: np.ndarray
    positive: tuple[int, ...]
    cones: tuple[tuple[int, ...], ...] = ()

    @property
    def free(self) -> list[int]:
        """Columns without a condition."""
        bound = {*self.positive, *(j for cone in self.cones for j in cone)}
        return [j for j in range(self.A.shape[1]) if j not in bound]


class FeasibilityDecision(NamedTuple):
    """An exact proof: ``point`` (n,) solves the system, or ``separator`` (r,) shows that nothing does; both None: undecided.

    ``margin`` is how far floating point came inside the cones (columns scaled to norm 1); NaN where it was not asked.
    """

    point: np.ndarray | None
    separator: np.ndarray | None
    margin: float = np.nan


def decide_feasibility(system: ConicSystem) -> FeasibilityDecision:
    """Solve the system strictly, or show that it cannot be solved."""
    if not system.positive and not system.cones:
        return FeasibilityDecision(exact.zeros(system.A.shape[1], 1).ravel(), None)
    if not system.cones and system.A.size <= SIMPLEX_FIRST_ENTRIES:
        return _decide_by_simplex(system)
    answer = _decide_by_interior_point(system)
    decided = answer.point is not None or answer.separator is not None
    return answer if decided or system.cones or system.A.size > MAX_SIMPLEX_ENTRIES else _decide_by_simplex(system)


def is_strict_solution(system: ConicSystem, u: np.ndarray) -> bool:
    """Whether u solves the system, exactly."""
    return (
        not exact.matrix_product(system.A, u[:, None]).any()
        and all(u[j] > 0 for j in system.positive)
        and all(u[cone[0]] > 0 and u[cone[0]] ** 2 > sum(u[j] ** 2 for j in cone[1:]) for cone in system.cones)
    )


def is_separator(system: ConicSystem, w: np.ndarray) -> bool:
    """Whether w proves that the system has no solution, exactly."""
    z = exact.matrix_product(w[None, :], system.A).ravel()
    return (
        bool(z.any())
        and not any(z[j] for j in system.free)
        and all(z[j] >= 0 for j in system.positive)
        and all(z[cone[0]] >= 0 and z[cone[0]] ** 2 >= sum(z[j] ** 2 for j in cone[1:]) for cone in system.cones)
    )


def implied_zeros(system: ConicSystem) -> list[int]:
    """Columns u_j > 0 that are 0 at every solution of the closed system.

    Only for systems of signs. From a separator w, 0 = w'A u = sum of (A'w)_j u_j with no term < 0, so that u_j = 0 where
    (A'w)_j > 0; repeated until what is left can be solved strictly.
    """
    zero: list[int] = []
    A = system.A
    while True:
        left = [j for j in range(A.shape[1]) if j not in zero]
        own = {j: i for i, j in enumerate(left)}
        part = ConicSystem(A[:, left], tuple(own[j] for j in system.positive if j in own))
        answer = decide_feasibility(part)
        if answer.separator is None:
            return zero
        z = exact.matrix_product(answer.separator[None, :], part.A).ravel()
        zero += [j for j in system.positive if j in own and z[own[j]] > 0]


# -- signs only: Stiemke's alternative by the simplex method -------------------------------------------------------------


def _decide_by_simplex(system: ConicSystem) -> FeasibilityDecision:
    """Eliminate the free columns, F = N'A_+ with N a basis of {w : A_free' w = 0}; then F s = 0, s > 0."""
    A, positive, free = system.A, list(system.positive), system.free
    N = exact.nullspace(A[:, free].T) if free and len(A) else exact.eye(len(A))
    F = exact.matrix_product(N.T, A[:, positive]) if N.shape[1] else exact.zeros(0, len(positive))
    s, z = _stiemke_alternative(F)
    if s is None:
        return FeasibilityDecision(None, exact.matrix_product(N, not_none(z)[:, None]).ravel())
    u = exact.zeros(A.shape[1], 1).ravel()
    u[positive] = s
    if free and len(A):
        u[free] = not_none(exact.solve_linear_system(A[:, free], -exact.matrix_product(A[:, positive], s[:, None]))).ravel()
    return FeasibilityDecision(u, None)


def _stiemke_alternative(F: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return s > 0 with F s = 0, or z with F'z >= 0 and F'z != 0: phase one for s = 1 + sigma."""
    r, p = F.shape
    if not r:
        return exact.rational(np.ones(p)), None
    right = -F.sum(axis=1)
    sign = np.array([-1 if entry < 0 else 1 for entry in right], dtype=object)
    # Columns: sigma, one artificial a row, the objective's own, the right side. Rows of whole numbers, scaled by numbers > 0.
    table = np.zeros((r + 1, p + r + 2), dtype=object)
    factor = np.empty(r, dtype=object)
    for i in range(r):
        row = [*(sign[i] * entry for entry in F[i]), sign[i] * right[i]]
        factor[i] = np.lcm.reduce(np.array([entry.denominator for entry in row], dtype=object))
        whole = [int(entry * factor[i]) for entry in row]
        table[i, :p], table[i, p + i], table[i, -1] = whole[:-1], 1, whole[-1]
    table[r, :p], table[r, -1], table[r, -2] = -table[:r, :p].sum(axis=0), -table[:r, -1].sum(), 1
    basis = list(range(p, p + r))
    _pivot_to_optimum(table, basis, p)
    if table[r, -1] == 0:
        s = exact.rational(np.ones(p))
        for i, j in enumerate(basis):
            if j < p:
                s[j] += Fraction(table[i, -1], table[i, j])
        return s, None
    scale = table[r, -2]
    y = np.array([1 - Fraction(int(table[r, p + i]), int(scale)) for i in range(r)], dtype=object)
    return None, -(sign * factor * y)


def _pivot_to_optimum(table: np.ndarray, basis: list[int], p: int) -> None:
    """Pivot until no reduced cost is < 0; Bland's rule once pivots stop paying, so that it ends."""
    r, stalled = len(basis), 0
    while True:
        candidates = np.flatnonzero(table[r, :p] < 0)
        if not candidates.size:
            return
        j = int(candidates[0]) if stalled > r else int(min(candidates, key=lambda j: table[r, j]))
        rows = [i for i in range(r) if table[i, j] > 0]
        row = min(rows, key=lambda i: (Fraction(table[i, -1], table[i, j]), basis[i]))
        stalled = stalled + 1 if table[row, -1] == 0 else 0
        for i in range(r + 1):
            if i != row and table[i, j]:
                new = table[row, j] * table[i] - table[i, j] * table[row]
                table[i] = new // (gcd(*new) or 1)
        basis[row] = j


# -- second-order cones and large systems: floating point, then made exact -----------------------------------------------


def _decide_by_interior_point(system: ConicSystem) -> FeasibilityDecision:
    """Maximise how far u lies inside the cones; the solution or its multiplier is the candidate."""
    u, w, margin = _maximise_margin(system)
    if u is not None and margin > 0:
        point = _exact_solution(system, u)
        if point is not None:
            return FeasibilityDecision(point, None, margin)
    if w is not None:
        for candidate in (w, -w):
            for separator in _exact_separators(system, candidate):
                if is_separator(system, separator):
                    return FeasibilityDecision(None, separator, margin)
    return FeasibilityDecision(None, None, margin)


def _maximise_margin(system: ConicSystem) -> tuple[np.ndarray | None, np.ndarray | None, float]:
    """Maximise t subject to A u = 0, u - t inside the cones, sum of the bounded entries <= 1: u, w and t."""
    A, rows, columns = _equilibrate(system)
    r, n = A.shape
    heads = [*system.positive, *(cone[0] for cone in system.cones)]
    G, h, cones = [np.column_stack([A, np.zeros(r)])], [np.zeros(r)], [zero_cone(r)]
    inside = np.zeros((len(system.positive), n + 1))
    inside[range(len(system.positive)), list(system.positive)], inside[:, n] = -1, 1
    total = np.zeros((1, n + 1))
    total[0, heads] = 1
    G += [inside, total]
    h += [np.zeros(len(inside)), np.ones(1)]
    cones.append(nonnegative_cone(len(inside) + 1))
    for cone in system.cones:
        block = np.zeros((len(cone), n + 1))
        block[range(len(cone)), list(cone)], block[0, n] = -1, 1
        G.append(block)
        h.append(np.zeros(len(cone)))
        cones.append(lorentz_cone(len(cone)))
    found = solve_conic_program(np.concatenate([np.zeros(n), [-1.0]]), np.vstack(G), np.concatenate(h), cones)
    x, z = np.array(found.x), np.array(found.z)
    if not (np.isfinite(x).all() and np.isfinite(z).all()):
        return None, None, np.nan
    return x[:n] * columns, z[:r] * rows, float(x[n])


def _equilibrate(system: ConicSystem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A in doubles with rows and columns of size about 1 (one factor a cone): R A C, R, C."""
    A = exact.doubles(system.A)
    rows, columns = np.ones(A.shape[0]), np.ones(A.shape[1])
    for _ in range(4):
        size = np.abs(rows[:, None] * A * columns)
        most = size.max(axis=1, initial=0.0)
        rows = rows / np.sqrt(np.where(most > 0, most, 1.0))
        most = (np.abs(rows[:, None] * A * columns)).max(axis=0, initial=0.0)
        for cone in system.cones:
            most[list(cone)] = most[list(cone)].max()
        columns = columns / np.sqrt(np.where(most > 0, most, 1.0))
    return rows[:, None] * A * columns, rows, columns


def _exact_solution(system: ConicSystem, u: np.ndarray) -> np.ndarray | None:
    """Correct u to A u = 0 exactly, free columns and then the largest ones taking the correction."""
    near = exact.rational(u)
    residual = exact.matrix_product(system.A, near[:, None])
    bound = [j for j in np.argsort(-np.abs(u)) if j not in set(system.free)]
    order = [*system.free, *map(int, bound)]
    correction = exact.solve_linear_system(system.A[:, order], -residual)
    if correction is None:
        return None
    near[order] = near[order] + correction.ravel()
    return near if is_strict_solution(system, near) else None


def _exact_separators(system: ConicSystem, w: np.ndarray) -> Iterator[np.ndarray]:
    """Exact candidates near w: entries of A'w that are nearly 0 are made 0, free entries are rounded to short fractions."""
    A = exact.doubles(system.A)
    z = w @ A
    size = np.abs(w) @ np.abs(A)
    for tight in (1e-9, 1e-7, 1e-5, 1e-3):
        nearly = lambda columns: all(abs(z[j]) <= tight * size[j] for j in columns)  # noqa: B023, E731
        zero = [*system.free, *(j for j in system.positive if nearly([j]))]
        zero += [j for cone in system.cones if nearly(cone) for j in cone]
        N = exact.nullspace(system.A[:, zero].T) if zero else exact.eye(len(w))
        if not N.shape[1]:
            continue
        scale = np.abs(w).max()
        c = np.linalg.lstsq(exact.doubles(N), w / scale, rcond=None)[0] if scale else np.zeros(N.shape[1])
        for digits in (10, 1000, 10**6, 10**12):
            short = np.array([Fraction(entry).limit_denominator(digits) for entry in c], dtype=object)
            yield exact.matrix_product(N, short[:, None]).ravel()
