"""The nearest point of a polyhedron: the dual active set method, on the normals themselves and not on their products.

    minimise |z - p|^2 / 2 over {z : N z >= c}

starts from p, and takes in the row that is violated most, one at a time; a row whose multiplier would turn negative on the way
is let go (Goldfarb and Idnani, Mathematical Programming 27, 1983). It ends after finitely many rows, at the nearest point or with
the proof that there is none. W = N N' would keep only the square of the angle between two rows.
"""

from __future__ import annotations

import numpy as np

from nsmodel.solve.certificate import EPS

PARALLEL_TOLERANCE = 64 * EPS  # Part of a unit normal that is left outside the span of others where it lies in it.


def nearest_point_of_polyhedron(p: np.ndarray, N: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the nearest point and the rows that hold it, none of which depends on the others; None where there is none.

    Args:
        p: (n,).
        N: (m, n).
        c: (m,).
    """
    size = np.linalg.norm(N, axis=1)
    size[size == 0] = 1.0
    N, c = N / size[:, None], c / size
    z, held, u = p.copy(), [], np.zeros(0)
    for _ in range(10 * len(N) + 50):
        slack = N @ z - c
        unseen = 4 * EPS * (np.abs(N) @ (np.abs(z) + np.abs(z - p)) + np.abs(c))
        slack[held] = 0.0
        worst = int(np.argmin(np.where(slack < -unseen, slack, 0.0)))
        if not slack[worst] < -unseen[worst]:
            return z, np.array(held, int)
        entered = _add_violated_row(N, c, z, held, u, worst)
        if entered is None:
            return None
        z, held, u = entered
    return None


def _add_violated_row(
    N: np.ndarray, c: np.ndarray, z: np.ndarray, held: list[int], u: np.ndarray, row: int
) -> tuple[np.ndarray, list[int], np.ndarray] | None:
    """Take a violated row in: the next point, the rows held there, and their multipliers; None where there is no such point."""
    new, held, u = 0.0, list(held), u.copy()
    while True:
        Q, R = np.linalg.qr(N[held].T)
        along = Q.T @ N[row]
        out = N[row] - Q @ along
        again = Q.T @ out
        out, along = out - Q @ again, along + again  # orthogonal to rounding
        r = np.linalg.solve(R, along) if held else np.zeros(0)
        shrinking = np.flatnonzero(r > 0)
        steps = u[shrinking] / r[shrinking]
        first = int(shrinking[np.argmin(steps)]) if shrinking.size else -1
        most = float(steps.min(initial=np.inf))
        whole = np.inf
        if np.linalg.norm(out) > PARALLEL_TOLERANCE:
            whole = (c[row] - N[row] @ z) / float(out @ out)
        step = min(most, whole)
        if step == np.inf:
            return None
        z = z + step * out if whole < np.inf else z
        u, new = u - step * r, new + step
        if whole <= most:
            held, u = [*held, row], np.append(u, new)
            return z + np.linalg.pinv(N[held]) @ (c[held] - N[held] @ z), held, u
        held.pop(first)
        u = np.delete(u, first)
