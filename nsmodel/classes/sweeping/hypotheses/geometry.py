"""Positive combinations of unit normals: the constant gamma of a qualified set of constraints, and bounds of it."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from nsmodel.proof.exact import MACHINE_EPSILON, rational

HULL_TOLERANCE = 1e-13  # A hull of unit vectors that is nearer to 0 than this contains 0, up to rounding.


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
