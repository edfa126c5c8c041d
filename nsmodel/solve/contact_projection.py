"""The projection on the linearised constraints of many bodies, group by group, and its certificate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from nsmodel.classes.bodies.schemes.prediction_correction import BodiesProblem, ContactRows
from nsmodel.errors import StepError
from nsmodel.proof import conic_program
from nsmodel.solve import mlcp
from nsmodel.solve.certificate import EPS, UNRESOLVED, NumericLaw
from nsmodel.solve.diagnose import opposing_rows

ACTIVE_SET, CLARABEL, PIQP = "active-set", "clarabel", "piqp"
MAX_DENSE_FACTOR_ROWS = 100  # Rows up to which a dense factorisation is faster.
MAX_LEMKE_ROWS = 60  # Rows of a group up to which Lemke's pivoting is the robust way.
MAX_DENSE_SOLVER_ROWS = 3000  # Rows of a group that a solver of dense problems takes.
ACTIVE_SET_PATIENCE = 10  # Changes of the active set without fewer wrong rows, after which it is given up.
MAX_GROUP_PASSES = 100
DIAGONAL_REGULARISATION = 1e-11  # Added to a diagonal of 1, and taken back by refinement.


@dataclass
class ContactForces:
    """m (R,) and d (N, d) = h f + G' m; whether primal-dual has settled; what found it."""

    m: np.ndarray
    d: np.ndarray
    solver: str
    groups: int = 0


class ContactGroup:
    """The projection for some rows of unit gradient."""

    def __init__(self, rows: ContactRows, hf: np.ndarray) -> None:
        self.rows, self.hf, self.other = rows, hf, rows.other
        d = hf.shape[1]
        columns = np.hstack([rows.first[:, None] * d + np.arange(d), self.other[:, None] * d + np.arange(d)])
        is_present = np.hstack([np.ones((len(rows.g), d), bool), np.repeat(rows.pair[:, None], d, axis=1)])
        indptr = np.concatenate([[0], np.cumsum(is_present.sum(axis=1))])
        self.B = sp.csr_matrix((np.hstack([rows.G, rows.H])[is_present], columns[is_present], indptr), (len(rows.g), hf.size))

    def y(self, d: np.ndarray) -> np.ndarray:
        """g + G d (R,)."""
        return self.rows.g + self.B @ d.ravel()

    def d(self, m: np.ndarray) -> np.ndarray:
        """h f + G' m (N, d)."""
        return self.hf + (self.B.T @ m).reshape(self.hf.shape)

    def solve(self, solver: str, last: np.ndarray, tiny: float) -> ContactForces:
        """The answer of a solver, "auto" or a name; ``last``: the m of the last step."""
        violated = self.y(self.hf) < -tiny
        if not violated.any():
            return ContactForces(np.zeros(last.size), self.hf.copy(), "none needed")
        if solver in ("auto", ACTIVE_SET):
            m, converged = self.primal_dual_active_set(last > 0 if last.any() else violated, tiny)
            if converged or solver == ACTIVE_SET:
                return ContactForces(m, self.d(m), ACTIVE_SET)
            violated |= self.rows.g < 2 * _largest_row_norm(self.hf)
        return self._solve_by_groups(solver, violated, tiny)

    def primal_dual_active_set(self, active: np.ndarray, tiny: float) -> tuple[np.ndarray, bool]:
        """Solve on the active set, drop rows with m < 0, take up those with y < 0, until none is wrong: (m, whether so).

        Where that has not made the wrong rows fewer, only those change that are worst on all their bodies; not for long.
        """
        best, least, waited = np.zeros(active.size), np.inf, 0
        while waited < ACTIVE_SET_PATIENCE:
            m = np.zeros(active.size)
            m[active] = self._solve_active_rows(np.flatnonzero(active))
            off = np.where(active, -m, -self.y(self.d(m)))
            wrong = np.flatnonzero(~(off <= tiny))
            waited = 0 if wrong.size < least else waited + 1
            if wrong.size < least:
                least, best = wrong.size, np.maximum(m, 0)
            if not wrong.size:
                return best, True
            active[wrong if not waited else self._worst_rows(wrong, off[wrong])] ^= True
        return best, False

    def _worst_rows(self, wrong: np.ndarray, off: np.ndarray) -> np.ndarray:
        """Those of the wrong rows that are worst on each of their bodies."""
        one, other = self.rows.first[wrong], np.where(self.rows.pair[wrong], self.other[wrong], self.rows.first[wrong])
        most = np.zeros(len(self.hf))
        np.maximum.at(most, one, off)
        np.maximum.at(most, other, off)
        return wrong[~(off < np.maximum(most[one], most[other]))]

    def _solve_active_rows(self, active: np.ndarray) -> np.ndarray:
        """m with y = 0 on the active rows: G G' m = -(g + G h f), refined; a solution where G G' is singular but there is one."""
        B = self.B[active]
        right = -(self.rows.g[active] + B @ self.hf.ravel())
        M = B @ B.T
        if active.size <= MAX_DENSE_FACTOR_ROWS:
            inverse = np.linalg.inv(M.toarray() + DIAGONAL_REGULARISATION * np.eye(active.size))
            solve = inverse.__matmul__
        else:
            M = (M + DIAGONAL_REGULARISATION * sp.eye_array(active.size)).tocsc()
            solve = splu(M, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}).solve
        m = solve(right)
        for _ in range(2):
            m = m + solve(right - B @ (B.T @ m))
        return m

    def _solve_by_groups(self, solver: str, chosen: np.ndarray, tiny: float) -> ContactForces:
        """Solve the chosen rows, each group of bodies that touch apart; rows that are then violated join, until none is."""
        rows, m = self.rows, np.zeros(chosen.size)
        fresh, names = chosen.copy(), set()
        count = 0
        for _ in range(MAX_GROUP_PASSES):
            which = np.flatnonzero(chosen)
            label, count = contact_groups(rows.at(which), len(self.hf))
            for number in np.unique(label[fresh[which]]):
                own = which[label == number]
                m[own], name = ContactGroup(rows.at(own), self.hf).one(solver, tiny)
                names.add(name)
            d = self.d(m)
            fresh = (self.y(d) < -tiny) & ~chosen
            if not fresh.any():
                break
            chosen |= fresh
        return ContactForces(m, self.d(m), "+".join(sorted(names)), count)

    def one(self, solver: str, tiny: float) -> tuple[np.ndarray, str]:
        """m of these rows by one solver, polished; all rows enter."""
        b = self.y(self.hf)
        if solver == "auto":
            solver = mlcp.LEMKE if b.size <= MAX_LEMKE_ROWS else CLARABEL
        raw = self._solve_clarabel() if solver == CLARABEL else self._solve_dense(solver, b)
        if raw is None:
            return np.zeros(b.size), solver
        y = self.y(self.d(raw))
        m, converged = self.primal_dual_active_set(raw > y, tiny)
        return (m if converged else np.maximum(raw, 0)), solver

    def _solve_dense(self, solver: str, b: np.ndarray) -> np.ndarray | None:
        """The answer of a solver of small dense problems."""
        if b.size > MAX_DENSE_SOLVER_ROWS:
            raise StepError(
                f"solver '{solver}': a group has {b.size} rows, more than {MAX_DENSE_SOLVER_ROWS}; use clarabel or active-set"
            )
        W, law = (self.B @ self.B.T).toarray(), NumericLaw(np.zeros(b.size), np.full(b.size, np.inf), ())
        found = mlcp.solve_mlcp(W, b, law, np.zeros(b.size), np.where(b < 0, 0, -1).astype(np.int8), (solver,), True, 1e-13)
        return found.l if np.isfinite(found.l).all() else None

    def _solve_clarabel(self) -> np.ndarray | None:
        """The answer of Clarabel, an interior-point method, in units in which h f is about 1."""
        size = np.abs(self.hf).max() or 1.0
        bodies, inverse = np.unique(self.B.indices, return_inverse=True)
        G = sp.csr_matrix((self.B.data, inverse, self.B.indptr), (len(self.rows.g), bodies.size)).tocsc()
        cones, P = [conic_program.nonnegative_cone(len(self.rows.g))], sp.eye(bodies.size, format="csc")
        found = conic_program.solve_conic_program(
            -self.hf.ravel()[bodies] / size, -G, self.rows.g / size, cones, P, tolerance=1e-11
        )
        m = size * np.array(found.z)
        return m if np.isfinite(m).all() else None


def contact_residual(
    rows: ContactRows, n: np.ndarray, hf: np.ndarray, d: np.ndarray, m: np.ndarray, q: np.ndarray, tolerance: float
) -> tuple[float, int | None]:
    """The residual of a step without unit, and the row where it is worst (None: the equation for d).

    With S = max_i max(|h f_i|, |d_i|) and the round-off of positions, rows divided by n_i: the largest of |d - h f - G'm| / S,
    (-y_i)+ / S, (-m_i)+ / S, min(m_i, |y_i|) / S, and the duality gap <m, |y|> / (|d|^2 + |h f|^2) where it is above round-off.
    """
    group = ContactGroup(rows, hf)
    floor = 4 * EPS * largest_coordinate(q)
    S = max(_largest_row_norm(hf), _largest_row_norm(d), floor / tolerance, UNRESOLVED)
    y = group.y(d)
    law = np.maximum(np.maximum(-y, -m), np.minimum(m, np.abs(y))) / S
    law = np.where(np.isfinite(law), law, np.inf)
    worst = int(law.argmax()) if law.size else None
    residual = float(law.max(initial=0.0))
    balance = float(np.abs(d - group.d(m)).max(initial=0.0)) / S
    gap = float(np.maximum(m, 0) @ np.abs(y))
    noise = 8 * EPS * float(np.maximum(m, 0) @ (np.abs(rows.g) + abs(group.B) @ np.abs(d).ravel() + largest_coordinate(q)))
    if gap > noise:
        residual = max(residual, gap / max(float((d**2).sum() + (hf**2).sum()), UNRESOLVED))
    if not balance <= residual:
        return (balance if np.isfinite(balance) else np.inf), None
    return residual, worst


def contact_groups(rows: ContactRows, count: int) -> tuple[np.ndarray, int]:
    """The number of the group of each row, and how many groups there are: rows that share bodies, directly or not."""
    bodies, inverse = np.unique(np.concatenate([rows.first, rows.second[rows.pair]]), return_inverse=True)
    links = inverse[: len(rows.g)][rows.pair], inverse[len(rows.g) :]
    graph = sp.coo_matrix((np.ones(len(links[0])), links), (bodies.size, bodies.size))
    count, label = connected_components(graph, directed=False)
    return label[inverse[: len(rows.g)]], count


def opposing_contacts(rows: ContactRows, hf: np.ndarray, worst: int) -> list[tuple[int, float]]:
    """Rows and weights of a proof that no d satisfies them all, looked for around the worst row; empty where there is none."""
    near_by = np.arange(len(rows.g))
    label, _ = contact_groups(rows, len(hf))
    near_by = np.flatnonzero(label == label[worst])
    if near_by.size > 400:
        near_by = near_by[np.argsort(np.abs(near_by - worst), kind="stable")[:400]]
    group = ContactGroup(rows.at(near_by), hf)
    law = NumericLaw(np.zeros(near_by.size), np.full(near_by.size, np.inf), ())
    found = opposing_rows((group.B @ group.B.T).toarray(), group.y(hf), law) or []
    return [(int(near_by[i]), u) for i, u in found]


def scale_contact_rows(rows: ContactRows, problem: BodiesProblem, t: float, q: np.ndarray) -> tuple[ContactRows, np.ndarray]:
    """Rows of unit gradient, and n_i (1 where the gradient is 0).

    Raises:
        StepError: a value or gradient that is not finite, a constraint < 0 without gradient.
    """
    n = rows.size
    bad = np.flatnonzero(~(np.isfinite(rows.g) & np.isfinite(n)) | ((n == 0) & (rows.g < 0)))
    if bad.size:
        i = int(bad[0])
        name = problem.name(int(rows.family[i]), int(rows.first[i]), int(rows.second[i]))
        what = "is < 0 and has no gradient" if n[i] == 0 else "or its gradient is not a finite number"
        raise StepError(
            f"constraint '{name}' {what} at t = {t:.10g}, where body {rows.first[i]} is at {q[rows.first[i]]} "
            "(two bodies in one place, a norm or root at 0?)", component=name
        )  # fmt: skip
    n = np.where(n > 0, n, 1.0)
    return ContactRows(rows.family, rows.first, rows.second, rows.pair, rows.g / n, rows.G / n[:, None], rows.H / n[:, None]), n


def largest_coordinate(q: np.ndarray) -> float:
    """The largest |q_i| of those that are there."""
    size = np.abs(q)
    return float(size[np.isfinite(size)].max(initial=0.0))


def _largest_row_norm(d: np.ndarray) -> float:
    return float(np.sqrt((d**2).sum(axis=1)).max(initial=0.0))
