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

A sparse matrix that depends on the step alone, put in an order in which it is a narrow band, and its factors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import scipy.sparse as sp
from scipy.linalg.lapack import dgbtrf, dgbtrs  # pyrefly: ignore[missing-module-attribute]
from scipy.sparse.csgraph import breadth_first_order, connected_components, reverse_cuthill_mckee
from scipy.sparse.linalg import LinearOperator, splu

from nsmodel._utils import EPS, remember
from nsmodel.solvers import active_set, mlcp
from nsmodel.solvers.linearisation import REFINEMENTS, BufferedStepFunction, Iterate
from nsmodel.solvers.one_step_problem import OneStepProblem
from nsmodel.solvers.residuals import CLEAR, ROUNDING, STRICTER, UNRESOLVED, NumericLaw
from nsmodel.solvers.rounding_errors import INSIDE, UNIT_ROUND_OFF, rounding_error_bound, row_maxima, ruiz_scales, solution_errors
from nsmodel.solvers.step import extra_columns
from nsmodel.solvers.structure import MAX_DENSE_UNKNOWNS, MAX_STEP_SIZES, StepStructure

# MAX_BANDWIDTH: of wider ones SuperLU uses the zeros inside.
MAX_BANDWIDTH = 48  # Diagonals above or below the main one up to which a band is factored.
SINGULAR_PIVOT = 1e-13  # Pivots below this, of entries of about 1, are round-off: 450 EPS. (+)
MAX_KEPT_FACTORS = 3  # Index sets whose factors are kept, for each step size: chattering goes to and fro between a few.


@dataclass(frozen=True)
class BandOrdering:
    """Where each unknown and equation stands in the band, and how wide that is: ``below`` and ``above`` the diagonal."""

    place: np.ndarray
    below: int
    above: int

    @property
    def is_band(self) -> bool:
        """Whether the band is narrow enough to be factored as one."""
        return max(self.below, self.above) <= MAX_BANDWIDTH


def band_ordering(J: sp.csr_matrix) -> BandOrdering:
    """The narrower one of two orders: reverse Cuthill and McKee, and by distance from an end of the graph."""
    size = J.indptr.size - 1
    graph = (abs(J) + abs(J.T) + sp.eye(size)).tocsr()
    candidates = [reverse_cuthill_mckee(graph, symmetric_mode=True)]
    if connected_components(graph, directed=False)[0] == 1:
        end = breadth_first_order(graph, candidates[0][0], directed=False, return_predecessors=False)[-1]
        candidates.append(breadth_first_order(graph, end, directed=False, return_predecessors=False)[::-1])
    found = []
    for chosen in candidates:
        place = np.empty(size, int)
        place[chosen] = np.arange(size)
        entries = J.tocoo()
        offset = place[entries.row] - place[entries.col]
        found.append(BandOrdering(place, int(offset.max(initial=0)), int(-offset.min(initial=0))))
    return min(found, key=lambda o: o.below * (o.below + o.above))


class SingularMatrixError(ArithmeticError):
    """The matrix of an index set is singular to rounding."""


class FactoredJacobian:
    """J at one h, in scaled and ordered form, with the factors of the index sets met last.

    Raises:
        numpy.linalg.LinAlgError: E_z is singular at this h.
    """

    def __init__(self, J: sp.csr_matrix, n: int, like: FactoredJacobian | None = None) -> None:
        """Prepare J (n unknowns z); ``like``: another h, whose order is that of a J with the same nonzeros."""
        same = like is not None and np.array_equal(J.indptr, like.J.indptr) and np.array_equal(J.indices, like.J.indices)
        self.J, self.n, self.order = J, n, like.order if like is not None and same else band_ordering(J)
        self.sizes, self.diagonal = abs(J), J.diagonal()
        self.others = (J[:n, :n] - sp.diags(self.diagonal[:n])).tocsr()
        size, entries, place = self.diagonal.size, J.tocoo(), self.order.place
        self.rows, self.columns = ruiz_scales(entries.row, entries.col, np.abs(entries.data), size)
        own = entries.row == entries.col  # every diagonal entry is there, once, at the end
        self._row = np.concatenate([entries.row[~own], np.arange(size)])
        self._values = np.concatenate([(entries.data * self.rows[entries.row] * self.columns[entries.col])[~own], np.zeros(size)])
        self._values[(~own).sum() + entries.row[own]] = (entries.data * self.rows[entries.row] * self.columns[entries.col])[own]
        self._own = slice((~own).sum(), None)
        self._at = place[self._row], place[np.concatenate([entries.col[~own], np.arange(size)])]
        self._factors: dict[tuple[bytes, float], Any] = {}
        try:
            self.factor(np.ones(size - n, bool), 0.0)
        except SingularMatrixError:
            raise np.linalg.LinAlgError from None

    def factor(self, held: np.ndarray, shift: float) -> Any:
        """The factors where the multipliers marked in ``held`` (m,) are given and ``shift`` is added to the other rows of Y.

        Raises:
            Singular: a pivot is round-off.
        """
        return remember(self._factors, (held.tobytes(), shift), lambda: self._factorise(held, shift), MAX_KEPT_FACTORS)

    def _factorise(self, held: np.ndarray, shift: float) -> Any:
        rows = np.concatenate([np.zeros(self.n, bool), held])
        values = np.where(rows[self._row], 0.0, self._values)
        values[self._own] += np.where(rows, 1.0, 0.0)
        values[self._own][self.n :] += np.where(held, 0.0, shift)
        i, j = self._at
        below, above = self.order.below, self.order.above
        if self.order.is_band:
            band = np.zeros((2 * below + above + 1, rows.size), order="F")
            band[below + above + i - j, j] = values
            lu, pivots, info = dgbtrf(band, below, above, overwrite_ab=True)
            if info != 0 or not np.abs(lu[below + above]).min(initial=1.0) > SINGULAR_PIVOT:
                raise SingularMatrixError
            return lu, pivots
        try:
            lu = splu(sp.csc_matrix((values, (i, j)), shape=(rows.size, rows.size)))
        except RuntimeError:
            raise SingularMatrixError from None
        if not np.abs(lu.U.diagonal()).min(initial=1.0) > SINGULAR_PIVOT:
            raise SingularMatrixError
        return lu

    def solve(self, factor: Any, rhs: np.ndarray, held: np.ndarray) -> np.ndarray:
        """u from the right-hand sides of E, of the free rows of Y, and the multipliers that are held."""
        v = rhs * self.rows
        ends = self.n + np.flatnonzero(held)
        v[ends] = rhs[ends] / self.columns[ends]
        return self._solve_ordered(factor, v, False) * self.columns

    def _solve_ordered(self, factor: Any, v: np.ndarray, transposed: bool) -> np.ndarray:
        w = np.empty_like(v)
        w[self.order.place] = v
        if self.order.is_band:
            w = dgbtrs(factor[0], self.order.below, self.order.above, w, factor[1], trans=int(transposed), overwrite_b=True)[0]
        else:
            w = factor.solve(w, "T" if transposed else "N")
        return w[self.order.place]

    @cached_property
    def parts(self) -> list[np.ndarray]:
        """The unknowns and rows of each part of J that touches no other."""
        count, label = connected_components(self.sizes + self.sizes.T, directed=False)
        order = np.argsort(label, kind="stable")
        return np.split(order, np.searchsorted(label[order], np.arange(1, count)))

    def W(self) -> LinearOperator:
        """W = Y_l - Y_z E_z^{-1} E_l, rows and columns scaled alike, as an operator."""
        n, m = self.n, self.diagonal.size - self.n
        held = np.ones(m, bool)
        factor = self.factor(held, 0.0)
        Y: Any = self.J[n:]

        def multiply(v: np.ndarray) -> np.ndarray:
            return Y @ self.solve(factor, np.concatenate([np.zeros(n), np.ravel(v)]), held)

        def multiply_transposed(v: np.ndarray) -> np.ndarray:
            w = self._solve_ordered(factor, (Y.T @ np.ravel(v)) * self.columns, True)
            return w[n:] / self.columns[n:]

        signs = np.random.default_rng(0).choice([-1.0, 1.0], (8, m))
        d = np.sqrt(np.mean([np.abs(multiply(v)) for v in signs], axis=0))
        d[d == 0] = 1

        def scaled(product: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
            return lambda v: product(np.ravel(v) / d) / d

        return LinearOperator((m, m), matvec=scaled(multiply), rmatvec=scaled(multiply_transposed))  # pyrefly: ignore[missing-argument, unexpected-keyword]


def step_jacobian_function(p: OneStepProblem) -> Callable[[float], sp.csr_matrix]:
    """J as a function of h, where it depends on nothing else."""
    E_z, E_l, Y_z, Y_l = p.jacobians
    known = ca.vertcat(p.t, p.state, p.z, p.l)
    function = ca.Function("J", [p.h, known], [ca.vertcat(ca.horzcat(E_z, E_l), ca.horzcat(Y_z, Y_l))])

    def jacobian_at(h: float) -> sp.csr_matrix:
        J = function(h, ca.DM.zeros(known.numel())).sparse().tocsr()
        J.eliminate_zeros()
        return J

    return jacobian_at


PIVOTED_SETS = 200  # Index sets that are tried in a step; then solvers of dense parts are, where they are small enough. (+)
PATIENCE = 10  # Changes of all rows that may fail to make the contradictions fewer; then one row changes at a time (Murty). (+)
# SHIFT: root EPS: as far from round-off of a pivot as from what it changes.
SHIFT = 1e-8  # Added to the diagonal of Y_l where a pivot is round-off; refinement takes its effect away. (+)


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

        def make() -> FactoredJacobian:
            return FactoredJacobian(self._J(h), self.structure.n, next(iter(self._steps.values()), None))

        return remember(self._steps, h, make, MAX_STEP_SIZES)

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
            own: Any = at.J[part]
            J = own[:, part].toarray()
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
