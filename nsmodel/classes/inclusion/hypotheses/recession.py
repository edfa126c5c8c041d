"""Directions in which a polyhedron C = {N x + h >= 0} is unbounded: {d : N d >= 0}."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction

import numpy as np

from nsmodel.proof import exact
from nsmodel.proof.convex.sets import ConvexSet

RANDOM_DIRECTIONS = 64


def is_recession_direction(C: ConvexSet, d: np.ndarray) -> bool:
    """Whether N d >= 0, exactly, d (n,) of Fractions, not 0."""
    N, _ = C.half_spaces
    return bool(d.any()) and all(number >= 0 for number in exact.matrix_product(N, d[:, None]).ravel())


def recession_directions(C: ConvexSet, more: np.ndarray | None = None) -> Iterator[np.ndarray]:
    """Directions of recession (n,) of Fractions: the axes, the doubles ``more`` (k, n) put into the cone, mixtures of axes."""
    n = C.n
    rng = np.random.default_rng(0)
    given = np.zeros((0, n)) if more is None else np.asarray(more, float).reshape(-1, n)
    random = rng.normal(size=(RANDOM_DIRECTIONS, n))
    axes = np.vstack([np.eye(n), -np.eye(n)])
    for d in np.vstack([axes, given, -given, rng.integers(-2, 3, (RANDOM_DIRECTIONS, n)), random]):
        for candidate in (d, project_on_recession_cone(C, d)):
            exact_d = np.array([Fraction(float(entry)) for entry in candidate], dtype=object)
            if is_recession_direction(C, exact_d):
                yield exact_d
                break


def project_on_recession_cone(C: ConvexSet, d: np.ndarray) -> np.ndarray:
    """The nearest direction of recession in doubles: with only bounds on states, exactly."""
    N = exact.doubles(C.half_spaces[0])
    single = (np.count_nonzero(N, axis=1) == 1).all()
    if single:
        out = d.copy()
        for row in N:
            j = int(np.flatnonzero(row)[0])
            out[j] = max(out[j], 0.0) if row[j] > 0 else min(out[j], 0.0)
        return out
    from scipy.optimize import nnls

    # Moreau: d - P_polar(d), the polar being {-N'm : m >= 0}.
    m, _ = nnls(-N.T, d)
    out = d + N.T @ m
    out[np.abs(out) < 1e-14 * np.abs(d).max(initial=1.0)] = 0.0
    return out
