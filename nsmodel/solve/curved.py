"""y = W l + b, -y ∈ N_K(l) where K has curved sets: semismooth Newton, with block Gauss-Seidel behind it."""

from __future__ import annotations

import numpy as np

from nsmodel.laws.curved import CurvedSet, safe_norm
from nsmodel.solve.active_set import row_scale, solve_or_least_squares
from nsmodel.solve.certificate import EPS, NumericLaw
from nsmodel.solve.rounding import SUM_ERROR

SEMISMOOTH_ITERATIONS = 60  # Of Newton's method on curved sets.
GAUSS_SEIDEL_SWEEPS = 400  # Projected gradient sweeps that give Newton's method a start.
SWEPT = 1e-10  # Part of l: changes below this end the sweeps.
CONVERGED = 1e-13  # The natural map, beside what it consists of, from which on an iteration that gains no factor 2 is the last.
ACCEPTED = 1e-11  # The same up to which the last iteration is an answer.
ARMIJO = 1e-4  # Part of the decrease that a step promises which it must bring; else it is halved.
MIN_DAMPED_STEP = 1e-4  # Part of a step on curved sets below which it is not halved any more.


def block_scale(W: np.ndarray, law: NumericLaw) -> np.ndarray:
    """The factor c of the natural map l - P_K(l - c y): one value for each row, equal within a curved block."""
    c = row_scale(W)
    for rows, _ in law.curved:
        c[rows] = c[rows].min()
    return c


def project_on_law(law: NumericLaw, u: np.ndarray) -> np.ndarray:
    """P_K(u)."""
    l = np.clip(u, law.lower, law.upper)
    for rows, K in law.curved:
        l[rows] = K.project(u[rows])
    return l


def law_projection_jacobian(law: NumericLaw, u: np.ndarray) -> np.ndarray:
    """An element of the generalised Jacobian of P_K at u, (m, m)."""
    J = np.diag(((u > law.lower) & (u < law.upper)).astype(float))
    for rows, K in law.curved:
        J[rows, rows] = K.jacobian(u[rows])
    return J


def curved_index_set(law: NumericLaw, l: np.ndarray, y: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Codes of (l, y): rows of a block share one; 0 where y = 0, -1 where l = 0 (cone), +1 on the curved boundary."""
    u = l - c * y
    code = np.where(u <= law.lower, -1, np.where(u >= law.upper, 1, 0)).astype(np.int8)
    for rows, K in law.curved:
        code[rows] = K.code(u[rows])
    return code


def semismooth_newton(W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray) -> np.ndarray | None:
    """Solve l = P_K(l - c (W l + b)) from ``l``; None if it does not converge."""
    c, eye = block_scale(W, law), np.eye(law.size)
    l = project_on_law(law, l)
    if not np.isfinite(l).all():
        return None

    def natural_map(l: np.ndarray) -> np.ndarray:
        return l - project_on_law(law, l - c * (W @ l + b))

    F, best = natural_map(l), np.inf
    for _ in range(SEMISMOOTH_ITERATIONS):
        size, relative = safe_norm(F), _relative_natural_map(F, c, W, b, law, l)
        if relative <= SUM_ERROR * EPS or (relative <= CONVERGED and relative >= best / 2):
            return l
        best = min(best, relative)
        P = law_projection_jacobian(law, l - c * (W @ l + b))
        step = solve_or_least_squares(eye - P @ (eye - c[:, None] * W), -F)
        if not np.isfinite(step).all():
            return None
        t = 1.0
        while safe_norm(natural_map(l + t * step)) > (1 - ARMIJO * t) * size and t > MIN_DAMPED_STEP:
            t /= 2
        l = l + t * step
        F = natural_map(l)
    return l if _relative_natural_map(F, c, W, b, law, l) <= ACCEPTED else None


def _relative_natural_map(F: np.ndarray, c: np.ndarray, W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray) -> float:
    """The largest part of the natural map beside what it consists of: |l|, c |W| |l|, and the radius of a bounded set, or c |b|
    for other rows, which at a bound have F = 0. A row far from its bound, or a ball that slides fast, says nothing about the size
    of the others.
    """
    size, extent = np.abs(F), c * np.abs(b)
    for rows, K in law.curved:
        if K.is_bounded:
            extent[rows] = K.radius
    scale = np.abs(l) + c * (np.abs(W) @ np.abs(l)) + extent
    for rows, _ in law.curved:
        size[rows], scale[rows] = size[rows].max(), scale[rows].max()
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(size == 0, 0.0, size / scale)
    return float(np.where(np.isnan(ratio), np.inf, ratio).max(initial=0.0))


def projected_gauss_seidel(W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray) -> np.ndarray:
    """Projected block gradient sweeps: slow, but convergent for symmetric psd W. Gives Newton a start near the solution."""
    l = project_on_law(law, l)
    start = l.copy()
    blocks: list[tuple[slice, CurvedSet | None]] = list(law.curved)
    in_block = np.zeros(law.size, bool)
    for rows, _ in blocks:
        in_block[rows] = True
    blocks += [(slice(i, i + 1), None) for i in np.flatnonzero(~in_block)]
    steps = [1 / max(np.linalg.norm(W[rows, rows], 2), np.finfo(float).tiny) for rows, _ in blocks]
    for _ in range(GAUSS_SEIDEL_SWEEPS):
        if not np.isfinite(l).all() or np.abs(l).max(initial=0.0) > 1e100:  # it diverges: W is not symmetric psd
            return start
        old = l.copy()
        for (rows, K), step in zip(blocks, steps, strict=True):
            u = l[rows] - step * (W[rows] @ l + b[rows])
            l[rows] = np.clip(u, law.lower[rows], law.upper[rows]) if K is None else K.project(u)
        if np.abs(l - old).max(initial=0.0) <= SWEPT * np.abs(l).max(initial=0.0):
            break
    return l


def polish_curved_solution(W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Polish: keep the curved rows' smooth branch, put l = 0 and l = bound exactly where the index set says so."""
    c = block_scale(W, law)
    code = curved_index_set(law, l, W @ l + b, c)
    l = np.where(code < 0, np.where(np.isfinite(law.lower), law.lower, 0.0), l)
    l = np.where((code > 0) & np.isfinite(law.upper), law.upper, l)
    for rows, K in law.curved:
        if code[rows][0] == 1:
            l[rows] = K.onto_boundary(l[rows])
    free, rest = code == 0, code != 0
    if free.any():
        l = l.copy()
        l[free] = solve_or_least_squares(W[np.ix_(free, free)], -(b[free] + W[np.ix_(free, rest)] @ l[rest]))
    return l, code
