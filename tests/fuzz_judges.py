"""Whether the steps of a run are right, decided in NumPy from the definition of each law, with nothing of `nsmodel.solvers`.

Arrays have a row for each step. A misfit is measured beside the terms that the judged sum is made of: ``TOLERANCE`` beside what
moves in the step, ``ROUND_OFF`` beside everything that is added up.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import nnls

EPS = np.finfo(float).eps
TOLERANCE = 2e-9  # Twice that of the runs, whose scales are others.
ROUND_OFF = 64 * EPS
UNRESOLVED = 1e-280  # Doubles lose digits below this.


def ratio(part: np.ndarray, size: Any) -> np.ndarray:
    """|part| / size; what is not a number is infinitely wrong."""
    r = np.abs(part) / np.maximum(size, UNRESOLVED)
    return np.where(np.isnan(r), np.inf, r)


def balance(parts: list[np.ndarray], moved: np.ndarray, terms: np.ndarray) -> float:
    """|sum of parts| in units of what is allowed: <= 1 where the equation holds."""
    return float(ratio(sum(parts), TOLERANCE * moved + ROUND_OFF * terms).max(initial=0.0))


def carried(J: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Round-off of the terms of linear systems with matrices J (N, n, n), as their solution carries it from row to row."""
    with np.errstate(all="ignore"):
        seen = np.abs(J) @ (np.abs(np.linalg.inv(J)) @ terms[..., None])
    return np.maximum(np.nan_to_num(seen[..., 0], nan=np.inf), terms)


def multiplier_size(l: np.ndarray, bound: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Beside what an error of l counts: l itself, its bounds, 1e-6 of the largest multiplier in units in which w is 1."""
    root = np.sqrt(np.where(w > 0, w, 1.0))
    largest = (np.abs(l) * np.where(w > 0, root, 0.0)).max(axis=1, initial=0.0, keepdims=True)
    return np.maximum(np.maximum(np.abs(l), bound), np.where(w > 0, 1e-6 * largest / root, 0.0))


def box_misfit(l: np.ndarray, y: np.ndarray, lower: Any, upper: Any, size_l: np.ndarray, size_y: np.ndarray) -> np.ndarray:
    """-y in N_[lower, upper](l): the distance of each row to the nearest branch."""
    lower, upper = np.broadcast_to(lower, l.shape), np.broadcast_to(upper, l.shape)
    with np.errstate(invalid="ignore"):
        best = np.maximum(ratio(np.maximum(np.maximum(lower - l, l - upper), 0), size_l), ratio(y, size_y))
        for end, wrong in ((lower, np.maximum(-y, 0)), (upper, np.maximum(y, 0))):
            at_end = np.maximum(ratio(l - end, size_l), ratio(wrong, size_y))
            best = np.where(np.isfinite(end), np.minimum(best, at_end), best)
    return best / TOLERANCE


def onto_ball(u: np.ndarray, radius: float) -> np.ndarray:
    length = np.linalg.norm(u, axis=1, keepdims=True)
    return u * np.minimum(1.0, radius / np.maximum(length, UNRESOLVED))


def onto_cone(u: np.ndarray) -> np.ndarray:
    """The nearest point of {|u[1:]| <= u[0]}."""
    head, length = u[:, :1], np.linalg.norm(u[:, 1:], axis=1, keepdims=True)
    middle = (head + length) / 2
    edge = np.hstack([middle, u[:, 1:] * middle / np.maximum(length, UNRESOLVED)])
    return np.where(length <= head, u, np.where(length <= -head, 0.0, edge))


def curved_misfit(
    project: Callable[[np.ndarray], np.ndarray], l: np.ndarray, y: np.ndarray, size_l: np.ndarray, size_y: np.ndarray
) -> np.ndarray:
    """-y in N_K(l): by Minty (P(u), (P(u) - u)/c) with u = l - c y is a point of the graph; c makes its distances equal."""
    size_l, size_y = size_l.max(axis=1), np.maximum(np.linalg.norm(size_y, axis=1), 1e-200)
    distance = np.linalg.norm(l - project(l - (size_l / size_y)[:, None] * y), axis=1)
    return ratio(distance, size_l) / TOLERANCE


def polyhedron_misfit(l: np.ndarray, y: np.ndarray, H: np.ndarray, K: np.ndarray, size_l: Any, size_y: Any) -> np.ndarray:
    """H l >= K, and y = H' n with n >= 0 on the rows that hold with equality: the best n by least squares."""
    size_l, size_y = size_l.max(axis=1), np.linalg.norm(size_y, axis=1)
    misfit = []
    for gap, out, scale, far in zip(l @ H.T - K, y, size_l, size_y, strict=True):
        slack = scale * np.linalg.norm(H, axis=1) + np.abs(K)
        outside = ratio(np.maximum(-gap, 0), slack).max()
        active = np.where(gap <= TOLERANCE * slack, 1.0, 0.0)
        _, left = nnls((H * active[:, None]).T, out / max(far, UNRESOLVED))
        misfit.append(max(outside, left))
    return np.array(misfit) / TOLERANCE
