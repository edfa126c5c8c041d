"""The nearest point of a polyhedron: the dual active set method, on the normals themselves and not on their products.

    minimise |z - p|^2 / 2 over {z : N z >= c}

starts from p, and takes in the row that is violated most, one at a time; a row whose multiplier would turn negative on the way
is let go (Goldfarb and Idnani, Mathematical Programming 27, 1983). It ends after finitely many rows, at the nearest point or with
the proof that there is none. W = N N' would keep only the square of the angle between two rows.

A step that falls into parts which do not touch: each is a one-step problem of its own, of the same t, h and state.

The whole one-step problem as a nonlinear programme for IPOPT: the last resort, and a solver to compare with.

    min sum of gaps   s.t.  E(z, l) = 0,  y = Y(z, l),  l ∈ K

The gap of a box row is (l - lower) y+ + (upper - l) y-, with y = y+ - y-, y+, y- >= 0; of a ball l'y + radius |y|; of a cone
l'y with y ∈ K.
Its value is 0 iff (z, l) solves the step.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from nsmodel._utils import EPS
from nsmodel.modeling.laws import Box, Law
from nsmodel.proof.verdict import suppress_output
from nsmodel.solvers.one_step_problem import OneStepProblem
from nsmodel.solvers.residuals import NumericLaw
from nsmodel.solvers.rounding_errors import SUM_ERROR

PARALLEL_TOLERANCE = 64 * EPS  # Part of a unit normal that is left outside the span of others where it lies in it: round-off. (+)


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
        unseen = SUM_ERROR * EPS * (np.abs(N) @ (np.abs(z) + np.abs(z - p)) + np.abs(c))
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


def connected_parts(problem: OneStepProblem) -> list[tuple[np.ndarray, np.ndarray]]:
    """The numbers of the unknowns z and of the multipliers of each part; one part where everything hangs together."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n, m = problem.z.numel(), problem.l.numel()
    offsets = ((0, 0), (0, n), (n, 0), (n, n))
    triplets = [J.sparsity().get_triplet() for J in problem.jacobians]
    i = [a + row for (a, _), (rows, _) in zip(offsets, triplets, strict=True) for row in rows]
    j = [b + column for (_, b), (_, columns) in zip(offsets, triplets, strict=True) for column in columns]
    at = n
    for block in problem.law.blocks:
        if not block.separable:
            i += [at] * block.size
            j += range(at, at + block.size)
        at += block.size
    count, label = connected_components(coo_array((np.ones(len(i)), (i, j)), shape=(n + m, n + m)), directed=False)
    return [(np.flatnonzero(label[:n] == k), np.flatnonzero(label[n:] == k)) for k in range(count)]


def part_problem(problem: OneStepProblem, z: np.ndarray, l: np.ndarray) -> OneStepProblem:
    """The problem of one part; its row keeps z as the record "z"."""
    others = [int(i) for i in np.setdiff1d(np.arange(problem.l.numel()), l)]
    guess, own, rows = problem.guess, [int(i) for i in z], [int(i) for i in l]
    if others:
        guess = ca.substitute([guess], [problem.l[others]], [ca.SX.zeros(len(others))])[0]
    return replace(
        problem, z=_column_entries(problem.z, own), l=_column_entries(problem.l, rows), y=_column_entries(problem.y, rows),
        E=_column_entries(problem.E, own),
        Y=_column_entries(problem.Y, rows), law=_part_law(problem.law, rows), rows=tuple(problem.rows[i] for i in rows),
        guess=_column_entries(guess, own),
        next_state=problem.state, multipliers=None, outputs=None, records={"z": _column_entries(problem.z, own)}, overreach=None,
        start=None, scale=None if problem.scale is None else problem.scale[rows],
        explicit=tuple(own.index(i) for i in problem.explicit if i in own),
    )  # fmt: skip


def _column_entries(column: ca.SX, rows: list[int]) -> ca.SX:
    """Some entries, none of which are a column, too."""
    return ca.reshape(column[rows], len(rows), 1)


def _part_law(law: Law, rows: list[int]) -> Law:
    blocks, at = [], 0
    for block in law.blocks:
        own = [i - at for i in rows if at <= i < at + block.size]
        at += block.size
        if own and isinstance(block, Box):
            blocks.append(block.rows(own))
        elif own:
            blocks.append(block)
    return Law(tuple(blocks))


ABS_SMOOTHING = 1e-30  # Keeps the derivative of |y| finite at 0: its root, 1e-15, is below what IPOPT is asked for.
IPOPT_OPTIONS = {
    "print_time": False,
    "error_on_fail": False,
    "show_eval_warnings": False,
    "ipopt": {
        "print_level": 0, "sb": "yes", "tol": 1e-12, "acceptable_tol": 1e-9, "max_iter": 500, "bound_relax_factor": 0.0,
        "mu_strategy": "adaptive", "honor_original_bounds": "yes",
    },
}  # fmt: skip


class NonlinearProgramme:
    """The programme of one problem, built once; a solve is a pure function of its arguments."""

    def __init__(self, problem: OneStepProblem, law: NumericLaw) -> None:
        p, m = problem, problem.l.numel()
        up, down = ca.SX.sym("y_up", m), ca.SX.sym("y_down", m)
        has_lo, has_up = np.isfinite(law.lower), np.isfinite(law.upper)
        curved = np.zeros(m, bool)
        for rows, _ in law.curved:
            curved[rows] = True
        gap, extra, y = ca.SX(0), [], up - down
        for i in np.flatnonzero(~curved).tolist():
            gap += (p.l[i] - law.lower[i]) * up[i] if has_lo[i] else 0
            gap += (law.upper[i] - p.l[i]) * down[i] if has_up[i] else 0
        for rows, K in law.curved:
            own, inequalities = K.complementarity(p.l[rows.start : rows.stop], y[rows.start : rows.stop], ABS_SMOOTHING)
            gap += own
            extra += inequalities
        unknowns = ca.vertcat(p.z, p.l, up, down)
        equations = ca.vertcat(p.E, p.Y - y)
        self._n, self._m, self._equations = p.z.numel(), m, equations.numel()
        self._inequalities = len(extra)
        self._lower = np.concatenate([np.full(self._n, -np.inf), law.lower, np.zeros(2 * m)])
        self._upper = np.concatenate([
            np.full(self._n, np.inf), law.upper,
            np.where(has_lo | curved, np.inf, 0.0), np.where(has_up | curved, np.inf, 0.0),
        ])  # fmt: skip
        nlp = {"x": unknowns, "f": gap, "g": ca.vertcat(equations, *extra), "p": ca.vertcat(p.t, p.h, p.state)}
        self._solver = ca.nlpsol("step", "ipopt", nlp, IPOPT_OPTIONS)
        self._Y = ca.Function("Y", [nlp["p"], p.z, p.l], [ca.densify(p.Y)])

    def solve(
        self, t: float, h: float, state: np.ndarray, z: np.ndarray, l: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Return (z, l, y) as IPOPT leaves them, unverified, from the start (z, l); None where they are not finite."""
        known = np.concatenate([[t, h], state])
        y = np.array(self._Y(known, z, l)).ravel()
        start = np.concatenate([z, l, np.maximum(y, 0), np.maximum(-y, 0)])
        zero = np.zeros(self._equations)
        try:
            with suppress_output():
                found = self._solver(
                    x0=start, p=known, lbx=self._lower, ubx=self._upper,
                    lbg=np.concatenate([zero, np.zeros(self._inequalities)]),
                    ubg=np.concatenate([zero, np.full(self._inequalities, np.inf)]),
                )  # fmt: skip
        except RuntimeError:
            return None
        x = np.array(found["x"]).ravel()
        if not np.isfinite(x).all():
            return None
        z, l = x[: self._n], x[self._n : self._n + self._m]
        return z, l, np.array(self._Y(known, z, l)).ravel()
