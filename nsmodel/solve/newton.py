"""The general step: Newton's linearisation in (z, l), an affine problem in l for each iterate, until all residuals vanish.

At (z, l): E_z dz + E_l dl + E = 0 gives dz = dz_0 + Z dl with dz_0 = -E_z^{-1} E, Z = -E_z^{-1} E_l, and
y+ = W l+ + b with W = Y_l + Y_z Z, b = Y + Y_z dz_0 - W l. For theta-gamma stepping these are the W_mlcp, x_free, x_p, b of
`scheme.theta_gamma`. An affine problem takes one iteration.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from nsmodel.proof.sure import not_none
from nsmodel.scheme.problem import OneStepProblem
from nsmodel.solve import mlcp
from nsmodel.solve.certificate import EPS, STRICTER, NumericLaw
from nsmodel.solve.linearised import Iterate, Linearisation, StepContext
from nsmodel.solve.rounding import SUM_ERROR, is_elimination_fragile
from nsmodel.solve.structure import StepStructure, least_eigenvalue
from nsmodel.solve.whole_system import NEWTON_ITERATIONS, IndexSetNewton

GAIN = 10  # Factor by which an iteration must better the residual for another one to follow.
EXTRA_ROW_OPERATIONS = 4  # Operations of a row beside those with its unknowns.
WORKING_SET_ABOVE = 24


def uses_working_set(structure: StepStructure, law: NumericLaw) -> bool:
    """Whether only the complementarity rows that act enter the affine problem."""
    return law.is_complementarity and structure.symmetric and law.size > WORKING_SET_ABOVE


class NewtonSolver(IndexSetNewton):
    """Newton's method for one problem; ``solve`` gives the best iterate that a chain of solvers reaches."""

    def __init__(self, problem: OneStepProblem, structure: StepStructure, law: NumericLaw, tolerance: float) -> None:
        super().__init__(problem, structure, law, tolerance)
        self.least_eigenvalue = np.inf  # of the W + W' met so far: a monitor, no step depends on it
        self._by_rows = uses_working_set(structure, law)

    def mlcp_matrix(self, t: float, h: float, state: np.ndarray, z: np.ndarray, l: np.ndarray) -> np.ndarray | None:
        """W linearised at (z, l); None where it is singular or not finite."""
        at = self.linearise(t, h, state, z, l)
        eliminated = self._eliminate(at)
        W = None if eliminated is None else at.Y_l + at.Y_z @ eliminated[1]
        return W if W is not None and np.isfinite(W).all() else None

    def scale_to_law(self, W: np.ndarray | None, t: float, h: float, state: np.ndarray) -> np.ndarray | None:
        """W with its rows in the units in which it has the sign of the declared law's."""
        p = self.problem
        if W is None or p.scale is None:
            return W
        found = W * np.array(ca.Function("scale", [p.t, p.h, p.state], [ca.densify(p.scale)])(t, h, state))
        return found if np.isfinite(found).all() else None

    def update_least_eigenvalue(self, W: np.ndarray | None) -> None:
        """Note the least eigenvalue of W + W', where it has one; not of a law that moves, whose units of rows move."""
        if W is not None and self.problem.scale is None:
            self.least_eigenvalue = min(self.least_eigenvalue, least_eigenvalue(W))

    def affine_problem(self, t: float, h: float, state: np.ndarray, l: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
        """(W, b) of the first iterate; (None, None) where the linear system is singular."""
        at = self.linearise(t, h, state, self.guess(t, h, state, l), l)
        eliminated = self._eliminate(at)
        if eliminated is None:
            return None, None
        dz_0, Z = eliminated
        return at.Y_l + at.Y_z @ Z, at.offset(dz_0, Z, l)

    def solve(self, t: float, h: float, state: np.ndarray, l: np.ndarray, index: np.ndarray, chain: Sequence[str]) -> Iterate:
        """Return the accepted iterate, or the best one found (residual above the tolerance)."""
        z, known = self.start(t, h, state, l)
        best, self._offsets = None, self._offset(t, h, state)[0]
        at = at_best = self.linearise(t, h, state, z, l)
        for iteration in range(1, NEWTON_ITERATIONS + 1):
            moved = self._newton_iteration(at, l, index, chain)
            if moved is None:
                break
            z, l, index, solver = moved
            at = self.linearise(t, h, state, z, l)
            found = self.evaluate_residual(known, at, l, index, solver, iteration, thorough=self.structure.affine)
            stalled = best is not None and found.residual <= self.tolerance and found.residual > best.residual / GAIN
            if best is None or found.residual < best.residual:
                best, at_best = found, at
            if stalled or found.residual <= self.enough:
                if self._is_elimination_fragile(at_best, best.index):
                    whole = not_none(self._active_set_method(known, best.z, best.l, best.index, best))
                    whole.solver, whole.iterations = best.solver, best.iterations
                    return whole
                return self._refine_iterate(known, best) if self.structure.affine else best
            if self.structure.affine and found.residual <= self.tolerance:
                break
            if not np.isfinite(found.residual) and not (np.isfinite(z).all() and np.isfinite(l).all()):
                break
        if best is None:
            return Iterate(z, l, index, np.full(l.size, np.nan), np.inf, None, "none", 0)
        return self._refine_iterate(known, best)

    def _refine_iterate(self, known: StepContext, found: Iterate) -> Iterate:
        """The better one of an iterate and the solution on its index set by the whole system, of which W keeps less."""
        if not np.isfinite(found.residual) or found.residual <= self.enough:
            return found
        if self._is_on_curved_boundary(found.index) or not found.l.size:
            if found.residual <= self.tolerance:
                return found
            at = self.linearise(*known[:3], found.z, found.l)
            return self.evaluate_residual(known, at, found.l, found.index, found.solver, found.iterations)
        again = self._newton_on_index_set(known, found.z, found.l, found.index)
        if again is None or not again.residual < found.residual * (2 if found.residual <= self.tolerance / 2 else 1):
            return found  # of two that rounding tells apart, the one by the whole system
        again.solver, again.iterations = found.solver, found.iterations
        return again

    def _newton_iteration(
        self, at: Linearisation, l: np.ndarray, index: np.ndarray, chain: Sequence[str]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, str] | None:
        """One Newton iteration: the next (z, l, index set) and the solver of its affine problem."""
        eliminated = self._eliminate(at)
        if eliminated is None:
            return None
        dz_0, Z = eliminated
        solver = "none needed"
        l_next = l
        if l.size:
            b = at.offset(dz_0, Z, l)
            if not np.isfinite(b).all():
                return None
            found = self._solve_affine_problem(at, Z, b, l, index, chain)
            if not np.isfinite(found.l).all():
                return None
            l_next, index, solver = found.l, found.index, found.solver
        z_next = at.z + dz_0 + Z @ (l_next - l)
        self._make_exact(at, z_next, index)
        return z_next, l_next, index, solver

    def _solve_affine_problem(
        self, at: Linearisation, Z: np.ndarray, b: np.ndarray, l: np.ndarray, index: np.ndarray, chain: Sequence[str]
    ) -> mlcp.MlcpSolution:
        """Solve the affine problem; of many complementarity rows only those that act (violated ones are added until none is)."""
        if not self._by_rows:
            W = at.Y_l + at.Y_z @ Z
            if l.size <= WORKING_SET_ABOVE and not self.structure.gram:
                self.update_least_eigenvalue(W)
            return mlcp.solve_mlcp(W, b, self.law, l, index, chain, self.structure.symmetric, self.tolerance / STRICTER)
        chosen = (b < 0) | (index == 0)
        for _ in range(l.size + 1):
            rows = np.flatnonzero(chosen)
            law = NumericLaw(self.law.lower[rows], self.law.upper[rows], ())
            W = at.Y_z[rows] @ Z[:, rows] + at.Y_l[np.ix_(rows, rows)]
            part = mlcp.solve_mlcp(W, b[rows], law, l[rows], index[rows], chain, True, self.tolerance / STRICTER)
            if not np.isfinite(part.l).all():
                return mlcp.MlcpSolution(np.full(l.size, np.nan), index, np.inf, part.solver)
            full, code = np.zeros(l.size), np.full(l.size, -1, np.int8)
            full[rows], code[rows] = part.l, part.index
            y = b + at.Y_z @ (Z[:, rows] @ part.l) + at.Y_l[:, rows] @ part.l
            scale = np.abs(b) + np.abs(at.Y_z) @ np.abs(Z[:, rows] @ part.l)
            violated = (y < -SUM_ERROR * (Z.shape[0] + EXTRA_ROW_OPERATIONS) * EPS * scale) & ~chosen
            if not violated.any():
                return mlcp.MlcpSolution(full, code, part.residual, part.solver if rows.size else "none needed")
            chosen |= violated
        raise AssertionError("unreachable: every pass adds a row")  # pragma: no cover

    def _is_elimination_fragile(self, at: Linearisation, index: np.ndarray) -> bool:
        """Whether W, eliminated at an iterate, keeps too little of the whole system on its index set."""
        free = np.flatnonzero(index == 0)
        eliminated = self._eliminate(at)
        if free.size < 2 or eliminated is None or self._is_on_curved_boundary(index):
            return False
        W = at.Y_l[np.ix_(free, free)] + at.Y_z[free] @ eliminated[1][:, free]
        try:
            return is_elimination_fragile(W, np.linalg.inv(W))
        except np.linalg.LinAlgError:
            return False
