"""y = W l + b, -y ∈ N_K(l) where K has balls or second-order cones: semismooth Newton, with block Gauss-Seidel behind it."""

from __future__ import annotations

import numpy as np

from nsmodel.solve.active_set import row_scale, solve_or_least_squares
from nsmodel.solve.certificate import EPS, NumericLaw, project


def block_scale(W: np.ndarray, law: NumericLaw) -> np.ndarray:
    """The factor c of the natural map l - P_K(l - c y): one value for each row, equal within a curved block."""
    c = row_scale(W)
    for _, rows, _ in law.curved:
        c[rows] = c[rows].min()
    return c


def projection(law: NumericLaw, u: np.ndarray) -> np.ndarray:
    """P_K(u)."""
    l = np.clip(u, law.lower, law.upper)
    for kind, rows, radius in law.curved:
        l[rows] = project(kind, radius, u[rows])
    return l


def projection_jacobian(law: NumericLaw, u: np.ndarray) -> np.ndarray:
    """An element of the generalised Jacobian of P_K at u, (m, m)."""
    J = np.diag(((u > law.lower) & (u < law.upper)).astype(float))
    for kind, rows, radius in law.curved:
        J[rows, rows] = _ball_jacobian(u[rows], radius) if kind == "ball" else _cone_jacobian(u[rows])
    return J


def _ball_jacobian(u: np.ndarray, radius: float) -> np.ndarray:
    size = np.linalg.norm(u)
    if size <= radius:
        return np.eye(u.size)
    e = u / size
    return (radius / size) * (np.eye(u.size) - np.outer(e, e))


def _cone_jacobian(u: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(u[1:])
    if size <= u[0]:
        return np.eye(u.size)
    if size <= -u[0]:
        return np.zeros((u.size, u.size))
    e, J = u[1:] / size, np.empty((u.size, u.size))
    J[0, 0], J[0, 1:], J[1:, 0] = 0.5, e / 2, e / 2
    J[1:, 1:] = ((1 + u[0] / size) * np.eye(e.size) - (u[0] / size) * np.outer(e, e)) / 2
    return J


def index_set(law: NumericLaw, l: np.ndarray, y: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Codes of (l, y): rows of a block share one; 0 where y = 0, -1 where l = 0 (cone), +1 on the curved boundary."""
    u = l - c * y
    code = np.where(u <= law.lower, -1, np.where(u >= law.upper, 1, 0)).astype(np.int8)
    for kind, rows, radius in law.curved:
        head, size = u[rows][0], np.linalg.norm(u[rows] if kind == "ball" else u[rows][1:])
        if kind == "ball":
            code[rows] = 1 if size > radius else 0
        else:
            code[rows] = 0 if size <= head else (-1 if size <= -head else 1)
    return code


def semismooth_newton(W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray, iterations: int = 60) -> np.ndarray | None:
    """Solve l = P_K(l - c (W l + b)) from ``l``; None if it does not converge."""
    c, eye = block_scale(W, law), np.eye(law.size)
    l = projection(law, l)

    def natural(l: np.ndarray) -> np.ndarray:
        return l - projection(law, l - c * (W @ l + b))

    F, best, scale = natural(l), np.inf, np.abs(c * b).max(initial=0.0) + np.abs(l).max(initial=0.0)
    for _ in range(iterations):
        size = np.linalg.norm(F)
        if size <= 4 * EPS * scale or (size <= 1e-13 * scale and size >= best / 2):
            return l
        best = min(best, size)
        P = projection_jacobian(law, l - c * (W @ l + b))
        step = solve_or_least_squares(eye - P @ (eye - c[:, None] * W), -F)
        if not np.isfinite(step).all():
            return None
        t = 1.0
        while np.linalg.norm(natural(l + t * step)) > (1 - 1e-4 * t) * size and t > 1e-4:
            t /= 2
        l = l + t * step
        F, scale = natural(l), max(scale, np.abs(l).max(initial=0.0))
    return l if np.linalg.norm(F) <= 1e-11 * scale else None


def gauss_seidel(W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray, sweeps: int = 400) -> np.ndarray:
    """Projected block gradient sweeps: slow, but convergent for symmetric psd W. Gives Newton a start near the solution."""
    l = projection(law, l)
    blocks = [(rows, kind, radius) for kind, rows, radius in law.curved]
    in_block = np.zeros(law.size, bool)
    for rows, _, _ in blocks:
        in_block[rows] = True
    blocks += [(slice(i, i + 1), "box", np.inf) for i in np.flatnonzero(~in_block)]
    steps = [1 / max(np.linalg.norm(W[rows, rows], 2), np.finfo(float).tiny) for rows, _, _ in blocks]
    for _ in range(sweeps):
        old = l.copy()
        for (rows, kind, radius), step in zip(blocks, steps, strict=True):
            u = l[rows] - step * (W[rows] @ l + b[rows])
            l[rows] = np.clip(u, law.lower[rows], law.upper[rows]) if kind == "box" else project(kind, radius, u)
        if np.abs(l - old).max(initial=0.0) <= 1e-10 * np.abs(l).max(initial=0.0):
            break
    return l


def exact_zeros(W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Polish: keep the curved rows' smooth branch, put l = 0 and l = bound exactly where the index set says so."""
    c = block_scale(W, law)
    code = index_set(law, l, W @ l + b, c)
    l = np.where(code < 0, np.where(np.isfinite(law.lower), law.lower, 0.0), l)
    l = np.where((code > 0) & np.isfinite(law.upper), law.upper, l)
    for kind, rows, radius in law.curved:
        if code[rows][0] == 1:
            l[rows] = project(kind, radius, l[rows] * 2) if kind == "ball" else _onto_boundary(l[rows])
    free, rest = code == 0, code != 0
    if free.any():
        l = l.copy()
        l[free] = solve_or_least_squares(W[np.ix_(free, free)], -(b[free] + W[np.ix_(free, rest)] @ l[rest]))
    return l, code


def _onto_boundary(l: np.ndarray) -> np.ndarray:
    return np.concatenate(([np.linalg.norm(l[1:])], l[1:]))
