"""A large step whose matrices depend on h alone and are sparse: one sparse system in z and l for each index set, without W.

With u = (z, l) and J = [E_z E_l; Y_z Y_l], an index set makes of E = 0 and of the law the system

    E_0 + E_z z + E_l l = 0,    Y_0 + Y_z z + Y_l l = 0 on the rows coded 0,    l_i = its end on the others.

Unknowns and equations are put in the order of reverse Cuthill and McKee and the system is factored as a band (LAPACK gbtrf, with
partial pivoting), or by SuperLU where the band is wide: O(n) in memory and time. Rows and columns are scaled by powers of 2, so
that units do not matter. The index set is found by block principal pivoting (Kostreva 1978; Judice and Pires 1994) from the last
one: all rows that contradict their code change it, and one row alone where that has not made them fewer for a while.

The certificate is that of `certificate` in stricter scales, because W is not there: l lies in its box, at its end where the index
set says so, exactly; y is measured against b = Y at l = 0, without the multipliers' terms, or against its round-off; E as in
`newton`; and the round-off of a row counts its own terms, not all unknowns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.scheme.problem import OneStepProblem
from nsmodel.solve import active_set, mlcp
from nsmodel.solve.band import FactoredJacobian, SingularMatrixError, step_jacobian_function
from nsmodel.solve.certificate import CLEAR, EPS, ROUNDING, STRICTER, UNRESOLVED, NumericLaw
from nsmodel.solve.layout import extra_columns
from nsmodel.solve.linearised import BufferedStepFunction, Iterate
from nsmodel.solve.rounding import INSIDE, UNIT_ROUND_OFF, rounding_error_bound, row_maxima, solution_errors
from nsmodel.solve.structure import MAX_DENSE_UNKNOWNS, StepStructure
from nsmodel.solve.whole_system import REFINEMENTS

PIVOTED_SETS = 200  # Index sets that are tried in a step.
PATIENCE = 10  # Changes of all rows that may fail to make the contradictions fewer.
SHIFT = 1e-8  # Added to the diagonal of Y_l where a pivot is round-off; refinement takes its effect away.
MAX_KEPT_STEP_SIZES = 8  # Step sizes whose matrices are kept.


class SparseStepSolver:
    """The step of one problem, for any h; what is kept between steps changes no bit of them."""

    def __init__(self, problem: OneStepProblem, structure: StepStructure, law: NumericLaw, tolerance: float) -> None:
        self.problem, self.structure, self.law, self.tolerance = problem, structure, law, tolerance
        p, n, m = problem, structure.n, structure.m
        self._J = step_jacobian_function(p)
        known, both = [p.t, p.h, p.state], ca.vertcat(p.E, p.Y)
        at_zero = ca.substitute([both, p.guess], [p.z, p.l], [ca.SX.zeros(n), ca.SX.zeros(m)])
        self._constant_part = BufferedStepFunction("constant_part", known, at_zero)
        self._residuals = BufferedStepFunction("residuals", [*known, p.z, p.l], [both])
        self._pack = BufferedStepFunction("pack", [*known, p.z, p.l, p.y], [p.next_state, *extra_columns(p).values()])
        self._error: BufferedStepFunction | None = None
        self._steps: dict[float, FactoredJacobian] = {}
        unit = structure.unit_rows
        self._unit_row, self._unit_column = (np.array([entry[k] for entry in unit], int) for k in (0, 1))
        self._unit_factor = np.array([factor for *_, factor in unit])
        self._follow = np.array([i for i, _ in structure.follow_rows], int)
        needs = [(k, j) for k, (_, needed) in enumerate(structure.follow_rows) for j, _ in needed]
        self._follow_of, self._follow_column = (np.array([entry[k] for entry in needs], int) for k in (0, 1))

    def at(self, h: float) -> FactoredJacobian:
        """The matrices of this h.

        Raises:
            numpy.linalg.LinAlgError: E_z is singular at this h.
        """
        if h not in self._steps:
            if len(self._steps) >= MAX_KEPT_STEP_SIZES:
                self._steps.pop(next(iter(self._steps)))
            self._steps[h] = FactoredJacobian(self._J(h), self.structure.n, next(iter(self._steps.values()), None))
        return self._steps[h]

    def _step_data(self, t: float, h: float, state: np.ndarray) -> _AffineStepData:
        constant, guess = self._constant_part(t, h, state)
        return _AffineStepData(constant, guess, t, h, state)

    def solve(self, t: float, h: float, state: np.ndarray, index: np.ndarray) -> Iterate:
        """Return the step, or the best answer where none was certified (residual above the tolerance)."""
        at, step = self.at(h), self._step_data(t, h, state)
        index = np.where(np.isfinite(self._held_values(index)), index, 0).astype(np.int8)
        best = self._failed_iterate(step, index)
        fewest, patience, first, seen = self.structure.m + 1, PATIENCE, index, set()
        for _ in range(PIVOTED_SETS):
            found, wrong = self._solve_on_index_set(at, step, index)
            if found is None or not wrong.size:
                best = best if found is None else found
                break
            if wrong.size < fewest:
                fewest, patience = wrong.size, PATIENCE
            elif patience:
                patience -= 1
            else:
                wrong = wrong[-1:]
                if index.tobytes() in seen:  # it would come back for ever
                    break
                seen.add(index.tobytes())
            index = index.copy()
            index[wrong] = np.where(index[wrong] != 0, 0, np.where(found.l[wrong] < self.law.lower[wrong], -1, 1))
        best.solver = "none needed" if not index.size else "last index set" if index is first else "index set"
        return best

    def solve_by_parts(
        self, t: float, h: float, state: np.ndarray, l: np.ndarray, index: np.ndarray, chain: Sequence[str]
    ) -> Iterate:
        """The step on the index sets that dense solvers find for the parts that do not touch, where all are small enough."""
        at, step = self.at(h), self._step_data(t, h, state)
        found = index.copy()
        for part in at.parts:
            if part.size > MAX_DENSE_UNKNOWNS:
                return self._failed_iterate(step, index)
            z, rows = part[part < at.n], part[part >= at.n] - at.n
            if not rows.size:
                continue
            J = at.J[part][:, part].toarray()
            E_z, E_l, Y_z, Y_l = J[: z.size, : z.size], J[: z.size, z.size :], J[z.size :, : z.size], J[z.size :, z.size :]
            both = active_set.solve_equilibrated(E_z, np.column_stack([step.constant[z], E_l]))
            W, b = Y_l - Y_z @ both[:, 1:], step.constant[at.n + rows] - Y_z @ both[:, 0]
            law = NumericLaw(self.law.lower[rows], self.law.upper[rows], ())
            found[rows] = mlcp.solve_mlcp(W, b, law, l[rows], index[rows], chain, False, self.tolerance / STRICTER).index
        return self._solve_on_index_set(at, step, found)[0] or self._failed_iterate(step, index)

    def _failed_iterate(self, step: _AffineStepData, index: np.ndarray) -> Iterate:
        m = self.structure.m
        return Iterate(step.guess, np.zeros(m), index, np.zeros(m), np.inf, None, "none", 1)

    def pack(self, t: float, h: float, state: np.ndarray, found: Iterate) -> np.ndarray:
        """The packed row of an answer."""
        parts = self._pack(t, h, state, found.z, found.l, found.y)
        return np.concatenate([parts[0], found.l, found.y, [found.residual, found.iterations], *parts[1:]]) + 0.0

    def _held_values(self, index: np.ndarray) -> np.ndarray:
        """Each multiplier's end, 0 where it is free."""
        return np.where(index < 0, self.law.lower, np.where(index > 0, self.law.upper, 0.0))

    def _solve_on_index_set(
        self, at: FactoredJacobian, step: _AffineStepData, index: np.ndarray
    ) -> tuple[Iterate | None, np.ndarray]:
        """The answer on an index set, judged if no row contradicts its code, and these rows; None where there is no answer."""
        held, n = index != 0, at.n
        rhs = -step.constant
        rhs[n:][held] = self._held_values(index)[held]
        for shift in (0.0, SHIFT):
            try:
                factor = at.factor(held, shift)
                break
            except SingularMatrixError:
                continue
        else:
            return None, np.zeros(0, int)
        u, best = at.solve(factor, rhs, held), None
        for _ in range(1 + REFINEMENTS):
            wrong = self._make_exact(at, u, step, index)
            F = step.constant + at.J @ u
            size = at.sizes @ np.abs(u) + np.abs(step.constant)
            if not np.isfinite(size).all():
                break
            wrong |= index * F[n:] > ROUNDING * UNIT_ROUND_OFF * size[n:]
            if wrong.any() and not shift:
                return Iterate(u[:n], u[n:], index, F[n:], np.inf, None, "", 1), np.flatnonzero(wrong)
            F = self._residuals(step.t, step.h, step.state, u[:n], u[n:])[0]
            found = self._evaluate_residual(at, step, u, F, size, index)
            if best is None or found.residual < best[0].residual:
                best = found, np.flatnonzero(wrong)
            if found.residual <= self.tolerance / STRICTER:
                break
            F[n:][held] = 0.0
            F[n + self._unit_row] = 0.0  # z is exact by these that stand: as near as doubles come
            u = u - at.solve(factor, F, held)
        if best is None:
            return None, np.zeros(0, int)
        if self.tolerance < best[0].residual < np.inf:
            best = self._residual_with_rounding(at, step, best[0], factor, held), best[1]
        return best

    def _make_exact(self, at: FactoredJacobian, u: np.ndarray, step: _AffineStepData, index: np.ndarray) -> np.ndarray:
        """Put l at its ends, z_j where y_i = factor z_j + c is 0, what follows from these, and z = 0 at rest, exactly; which
        free l are outside.
        """
        law, n = self.law, self.structure.n
        z, l = u[:n], u[n:]
        l[index != 0] = self._held_values(index)[index != 0]
        inside = np.clip(l, law.lower, law.upper)
        outside = np.abs(l - inside) > INSIDE * EPS * np.abs(l)
        l[~outside] = inside[~outside]
        free = index[self._unit_row] == 0
        exact = self._unit_column[free]
        z[exact] = -step.constant[n:][self._unit_row[free]] / self._unit_factor[free]
        if self._follow.size:
            unknown = np.ones(n, bool)
            unknown[exact] = False
            follow = self._follow[np.bincount(self._follow_of, unknown[self._follow_column]) == 0]
            known = step.constant[:n] + at.others @ z
            z[follow] = -known[follow] / at.diagonal[follow]
        rest = self.structure.rest_rows
        if rest and not index[list(rest)].any():
            z[:] = 0.0
        return outside

    def certify(self, t: float, h: float, state: np.ndarray, z: np.ndarray, l: np.ndarray, index: np.ndarray) -> Iterate:
        """Any (z, l) on an index set, judged."""
        at, step = self.at(h), self._step_data(t, h, state)
        u, F = np.concatenate([z, l]), self._residuals(t, h, state, z, l)[0]
        return self._evaluate_residual(at, step, u, F, at.sizes @ np.abs(u) + np.abs(step.constant), index)

    def _residual_with_rounding(
        self, at: FactoredJacobian, step: _AffineStepData, found: Iterate, factor: Any, held: np.ndarray
    ) -> Iterate:
        """An answer that fails, judged once more with the rounding of what is given and with what its unknowns err by."""
        if self._error is None:
            p = self.problem
            zero = [ca.SX.zeros(e.shape) for e in (p.z, p.l)]
            constant = ca.substitute([ca.vertcat(p.E, p.Y)], [p.z, p.l], zero)[0]
            self._error = BufferedStepFunction("error", [p.t, p.h, p.state], [rounding_error_bound(constant, ca.SX(0, 1))])
        given = self._error(step.t, step.h, step.state)[0]
        u, F = np.concatenate([found.z, found.l]), self._residuals(step.t, step.h, step.state, found.z, found.l)[0]
        error = at.sizes @ np.abs(u) + np.abs(step.constant) + given
        again = self._evaluate_residual(at, step, u, F, error, found.index)
        if again.residual <= self.tolerance:
            return again
        rows = np.concatenate([np.ones(at.n, bool), ~held])
        of = solution_errors(lambda r: at.solve(factor, np.where(rows, r, 0.0), held), error, at.sizes @ at.columns, at.columns)
        return self._evaluate_residual(at, step, u, F, error + row_maxima(at.J @ of), found.index)

    def _evaluate_residual(
        self, at: FactoredJacobian, step: _AffineStepData, u: np.ndarray, F: np.ndarray, error: np.ndarray, index: np.ndarray
    ) -> Iterate:
        """The certificate: E beside what moves, y beside b, l exactly where it must be; ``error``: of the rows, in units of u."""
        n, law, tolerance = at.n, self.law, self.tolerance
        z, l, E, Y = u[:n], u[n:], F[:n], F[n:]
        unseen = ROUNDING * UNIT_ROUND_OFF / tolerance * error
        guess = np.concatenate([step.guess, np.zeros(l.size)])
        scale = np.abs(step.constant + at.J @ guess) + at.sizes[:, :n] @ np.abs(z - step.guess)
        scale[n:] = 0.0
        off = np.where(index == 0, np.abs(Y), np.maximum(index * Y, 0.0))
        if (off > CLEAR * tolerance * unseen[n:]).any():
            scale[n:] = np.abs(self._offset(at, step))
        ratio = np.concatenate([np.abs(E), off]) / np.maximum(scale + unseen, UNRESOLVED)
        worst = int(np.argmax(ratio)) if ratio.size else 0
        residual = float(ratio.max(initial=0.0)) if np.isfinite(scale + unseen).all() else np.inf
        exact = ((l >= law.lower) & (l <= law.upper) & ((index == 0) | (l == self._held_values(index)))).all()
        y = np.where(index == 0, 0.0, Y)
        return Iterate(z, l, index, y, residual if exact else np.inf, worst - n if worst >= n else None, "", 1)

    def _offset(self, at: FactoredJacobian, step: _AffineStepData) -> np.ndarray:
        """b: y where l = 0."""
        held, n = np.ones(self.structure.m, bool), at.n
        u = at.solve(at.factor(held, 0.0), np.concatenate([-step.constant[:n], np.zeros(held.size)]), held)
        return (step.constant + at.J @ u)[n:]


@dataclass(frozen=True)
class _AffineStepData:
    """What a step is given: E and Y at z = 0, l = 0, the z for which nothing moves, t, h and the state."""

    constant: np.ndarray
    guess: np.ndarray
    t: float
    h: float
    state: np.ndarray
