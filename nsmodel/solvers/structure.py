"""What the expressions of a one-step problem say by themselves: affine, constant, identity, symmetric, unit rows.

A structure that is not recognised costs speed, never correctness: every step is certified whatever was assumed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from nsmodel._utils import EPS, cached_per_object
from nsmodel.proof.expression_graph import stack_column, stored_entries
from nsmodel.solvers.one_step_problem import OneStepProblem

if TYPE_CHECKING:  # SciPy is loaded by who uses it.
    from scipy.sparse.linalg import LinearOperator

MAX_STEP_SIZES = 8  # Step sizes whose matrices are kept: with more, dense steps go without, sparse ones and C drop the oldest.
MAX_DENSE_UNKNOWNS = 1500  # Unknowns and multipliers up to which dense matrices are tried: to invert one takes 0.3 s.
MAX_FULL_SPECTRUM_ROWS = 300  # Rows of an operator up to which all eigenvalues are computed: these take 5 ms.
MONOTONE_ERROR = 64  # Times EPS and the rows: what rounding may take from a least eigenvalue; less calls a psd W indefinite. (+)
LANCZOS_ERROR = 1e-9  # Of an operator scaled to 1: what is nearer to 0 is not told from it; less calls a psd W indefinite.


@dataclass(frozen=True)
class StepStructure:
    """Facts about E and Y.

    Attributes:
        affine: E and Y are affine in (z, l): one linearisation is exact.
        constant: the matrices depend on the step h (and parameters) alone: factor once.
        identity: E_z is the identity: no linear system.
        symmetric: W is symmetric by construction (E_z symmetric, E_l a multiple of -Y_z', Y_l symmetric).
        unit_rows: (row, column, factor) of rows y_i = factor z_j + c(k): z_j is exact where y_i = 0.
        follow_rows: rows E_i = a z_i + sum of a_j z_j + c(k), each z_j that of a unit row, as (i, ((j, its unit rows), ...)): z_i
            is exact where these are.
        rest_rows: rows y = A z with a constant A of full column rank: z = 0 exactly where all of them are 0.
        gram: W = Y_z Y_z' by construction (identity, symmetric, no Y_l): psd.
        nearest: z is the nearest point of {Y >= 0} to a given one: E = z - p - Y_z' l, and complementarity in every row.
        projection: that, with Y affine: W = Y_z Y_z'.
        n, m: numbers of unknowns z and of multipliers.
        nonzeros: structural nonzeros of the matrix [E_z E_l; Y_z Y_l], out of (n + m)^2.
    """

    affine: bool
    constant: bool
    identity: bool
    symmetric: bool
    unit_rows: tuple[tuple[int, int, float], ...]
    follow_rows: tuple[tuple[int, tuple[tuple[int, tuple[int, ...]], ...]], ...]
    rest_rows: tuple[int, ...]
    gram: bool
    nearest: bool
    projection: bool
    n: int
    m: int
    nonzeros: int


@cached_per_object
def read_step_structure(problem: OneStepProblem) -> StepStructure:
    """Read the structure of a problem; what is said of it holds for any value of parameters left symbolic."""
    z, l = problem.z, problem.l
    E_z, E_l, Y_z, Y_l = problem.jacobians
    matrices = stack_column(entry for J in (E_z, E_l, Y_z, Y_l) for entry in stored_entries(J))
    affine = not _depends_on(matrices, ca.vertcat(z, l))
    known = ca.vertcat(problem.t, problem.state)
    identity = E_z.is_constant() and E_z.shape == ca.SX.eye(z.numel()).shape and _is_zero_matrix(E_z - ca.SX.eye(z.numel()))
    factors = _symmetry_factors(E_z, E_l, Y_z, Y_l, problem)
    symmetric = factors is not None
    gram = identity and symmetric and Y_l.nnz() == 0
    constant = affine and not _depends_on(matrices, known)
    nearest = (
        set(problem.law.labels) == {"complementarity"}
        and factors is not None
        and np.allclose(factors, 1, rtol=1e-13, atol=0)
        and Y_l.nnz() == 0
        and _is_shifted_identity(problem)
    )
    return StepStructure(
        affine=affine,
        constant=constant,
        identity=identity,
        symmetric=symmetric,
        unit_rows=tuple(unit := _find_unit_rows(Y_z, Y_l)),
        follow_rows=_find_follow_rows(E_z, E_l, unit) if constant else (),
        rest_rows=() if len({j for _, j, _ in unit}) == z.numel() else _find_rest_rows(problem, Y_z, Y_l),
        gram=gram,
        nearest=nearest,
        projection=nearest and gram,
        n=z.numel(),
        m=l.numel(),
        nonzeros=sum(J.nnz() for J in (E_z, E_l, Y_z, Y_l)),
    )


def with_exact_unknowns(structure: StepStructure, free: ca.SX, z: ca.SX, E_0: ca.SX, Y_0: ca.SX, E_z: ca.SX | ca.DM) -> ca.SX:
    """The unknowns z with those exact that unit, follow and rest rows give where rows are ``free`` (1, else 0): y = 0 there.

    ``E_0``, ``Y_0``: E and Y at z = 0, l = 0.
    """
    z = ca.SX(z)
    for row, j, factor in structure.unit_rows:
        z[j] = ca.if_else(free[row], -Y_0[row] / factor, z[j])
    for i, needed in structure.follow_rows:
        given = [ca.sum1(free[list(rows)]) > 0 for _, rows in needed]
        known = E_0[i] + sum(E_z[i, j] * z[j] for j, _ in needed)
        z[i] = ca.if_else(ca.sum1(stack_column(given)) == len(given), -known / E_z[i, i], z[i])
    if structure.rest_rows:
        z = ca.if_else(ca.sum1(free[list(structure.rest_rows)]) == len(structure.rest_rows), 0, z)
    return z


def _is_shifted_identity(p: OneStepProblem) -> bool:
    """Whether E = z - p without multipliers."""
    J = ca.jacobian(ca.substitute([p.E], [p.l], [ca.SX.zeros(p.l.shape)])[0] - p.z, p.z)
    return _is_zero_matrix(J)


def _depends_on(expression: ca.SX, symbols: ca.SX) -> bool:
    return bool(symbols.numel() and expression.numel() and ca.depends_on(expression, symbols))


def _is_zero_matrix(expression: ca.SX) -> bool:
    return expression.numel() == 0 or bool(ca.simplify(ca.sparsify(expression)).is_zero())


def _symmetry_factors(E_z: ca.SX, E_l: ca.SX, Y_z: ca.SX, Y_l: ca.SX, problem: OneStepProblem) -> list[float] | None:
    """The a >= 0 with E_z = E_z', E_l = -a Y_z', Y_l = Y_l' at three generic points of the unknowns; None where there is none."""
    if not problem.l.numel():
        return []
    if E_z.is_constant() and not Y_l.nnz() and is_negative_transpose(E_l, Y_z) and _equal_to_rounding(ca.DM(E_z), ca.DM(E_z).T):
        return [1.0]
    symbols = ca.vertcat(problem.t, problem.h, problem.state, problem.p, problem.z, problem.l)
    f = ca.Function("matrices", [symbols], [E_z, E_l, Y_z, Y_l])
    rng, factors = np.random.default_rng(0), []
    for _ in range(3):
        Ez, El, Yz, Yl = f(rng.uniform(0.5, 1.5, symbols.numel()))
        if not all(np.isfinite(v.nonzeros()).all() for v in (Ez, El, Yz, Yl)):
            return None
        with np.errstate(over="ignore", invalid="ignore"):
            factor = float(ca.dot(-El.T, Yz)) / max(float(ca.dot(Yz, Yz)), 1e-300)
        if not (
            np.isfinite(factor)
            and _equal_to_rounding(Ez, Ez.T)
            and _equal_to_rounding(-El, factor * Yz.T)
            and _equal_to_rounding(Yl, Yl.T)
            and factor >= 0
        ):
            return None
        factors.append(float(factor))
    return factors


def is_negative_transpose(E_l: ca.SX, Y_z: ca.SX) -> bool:
    """Whether E_l = -Y_z', entry for entry."""
    return E_l.sparsity() == Y_z.T.sparsity() and _is_zero_matrix(ca.SX(E_l.nz[:]) + ca.SX(Y_z.T.nz[:]))


def _equal_to_rounding(a: ca.DM, b: ca.DM) -> bool:
    return bool(np.abs((a - b).nonzeros()).max(initial=0.0) <= 1e-13 * np.abs(a.nonzeros()).max(initial=0.0))


def _find_unit_rows(Y_z: ca.SX, Y_l: ca.SX) -> list[tuple[int, int, float]]:
    by_row: dict[int, list[tuple[int, ca.SX]]] = {}
    for i, j, entry in zip(*Y_z.sparsity().get_triplet(), stored_entries(Y_z), strict=True):
        if not entry.is_zero():
            by_row.setdefault(i, []).append((j, entry))
    coupled = set(Y_l.sparsity().get_triplet()[0])
    single = [(i, *entries[0]) for i, entries in sorted(by_row.items()) if len(entries) == 1 and i not in coupled]
    return [(i, j, float(entry)) for i, j, entry in single if entry.is_constant()]


def _find_follow_rows(E_z: ca.SX, E_l: ca.SX, unit: list[tuple[int, int, float]]) -> tuple:
    columns: dict[int, set[int]] = {}
    for i, j, entry in zip(*E_z.sparsity().get_triplet(), stored_entries(E_z), strict=True):
        if not entry.is_zero():
            columns.setdefault(i, set()).add(j)
    pushed = {i for i, entry in zip(E_l.sparsity().get_triplet()[0], stored_entries(E_l), strict=True) if not entry.is_zero()}
    giving: dict[int, tuple[int, ...]] = {}
    for row, j, _ in unit:
        giving[j] = (*giving.get(j, ()), row)
    return tuple(
        (i, tuple((j, giving[j]) for j in sorted(of - {i})))
        for i, of in sorted(columns.items())
        if i in of and i not in pushed and i not in giving and of - {i} and of - {i} <= giving.keys()
    )


def _find_rest_rows(problem: OneStepProblem, Y_z: ca.SX, Y_l: ca.SX) -> tuple[int, ...]:
    m, n = problem.l.numel(), problem.z.numel()
    if not n or Y_z.nnz() < n or m < n:
        return ()
    at_zero = ca.substitute([problem.Y], [problem.z, problem.l], [ca.SX.zeros(n), ca.SX.zeros(m)])[0]
    rows = [i for i in range(m) if at_zero[i].is_zero() and Y_z[i, :].is_constant() and Y_l[i, :].nnz() == 0]
    A = np.array(ca.DM(Y_z[rows, :])) if rows else np.zeros((0, n))
    return tuple(rows) if np.isfinite(A).all() and np.linalg.matrix_rank(A) == n else ()


def least_eigenvalue(W: np.ndarray | LinearOperator) -> float:
    """Least eigenvalue of (W + W')/2 after scaling rows and columns alike, so that units do not matter; inf for m = 0.

    Of an operator of more than MAX_FULL_SPECTRUM_ROWS rows, scaled already, it is what Lanczos finds: not below the true one.
    """
    if not isinstance(W, np.ndarray):
        if W.shape[0] > MAX_FULL_SPECTRUM_ROWS:
            return _lanczos_least_eigenvalue(W)
        W = np.column_stack([W.matvec(e) for e in np.eye(W.shape[0])]) if W.shape[0] else np.zeros((0, 0))
    if not W.size:
        return np.inf
    S = (W + W.T) / 2
    d = np.sqrt(np.abs(S).max(axis=1))
    d[d == 0] = 1
    least = float(np.linalg.eigvalsh(S / np.outer(d, d))[0])
    # A skew part that is larger by far brings its round-off into S.
    unseen = EPS * np.linalg.norm(np.abs(W) / np.outer(d, d), 2)
    return 0.0 if -unseen <= least < 0 else least


def _lanczos_least_eigenvalue(W: LinearOperator) -> float:
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

    symmetric = LinearOperator(W.shape, matvec=lambda v: (W.matvec(v) + W.rmatvec(v)) / 2)  # pyrefly: ignore[missing-argument, unexpected-keyword]
    start = np.random.default_rng(0).normal(size=W.shape[0])
    how: dict[str, Any] = {"which": "SA", "v0": start, "tol": 1e-3, "maxiter": 20, "return_eigenvectors": False}
    try:
        found: Any = eigsh(symmetric, 1, **how)
    except ArpackNoConvergence as error:
        found = error.eigenvalues
    least = float(found.min(initial=np.inf))
    if not np.isfinite(least):  # no Ritz value has settled: the quotient of the start is above the least eigenvalue too
        least = float(start @ symmetric.matvec(start) / (start @ start))
    return 0.0 if -LANCZOS_ERROR <= least < 0 else least


def is_eigenvalue_nonnegative(least: float, m: int) -> bool:
    """Whether a least eigenvalue of a scaled (m, m) matrix is >= 0 up to round-off."""
    return least >= -MONOTONE_ERROR * EPS * max(m, 1)
