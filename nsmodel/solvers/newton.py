"""The general step: Newton's linearisation in (z, l), an affine problem in l for each iterate, until all residuals vanish.

At (z, l): E_z dz + E_l dl + E = 0 gives dz = dz_0 + Z dl with dz_0 = -E_z^{-1} E, Z = -E_z^{-1} E_l, and
y+ = W l+ + b with W = Y_l + Y_z Z, b = Y + Y_z dz_0 - W l. For theta-gamma stepping these are the W_mlcp, x_free, x_p, b of
`scheme.theta_gamma`. An affine problem takes one iteration.

A nonlinear step on the index set of the last one: Newton's iteration, its certificate and the packed row in one function.

What `newton.NewtonSolver` does by solvers and NumPy, for the case that nothing switches: with (z, l) an iterate, E_z dz_0 = -E,
E_z Z = -E_l, W = Y_l + Y_z Z, b = Y + Y_z (dz_0 - Z l) - Y_l l,

    l+ = -W_ff^{-1} (b + W l_b)_f on the rows f that are held, l_b at the bounds of the others,     z+ = z + dz_0 + Z (l+ - l)

A step is taken here where each affine problem is solved on the index set, and rounding does not decide that, and the certificate
of `NewtonSolver.judge` passes well below the tolerance: the general way would go the same. All else is left to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from nsmodel._utils import EPS
from nsmodel.proof.expression_graph import stack_column
from nsmodel.proof.verdict import attach_buffers, not_none
from nsmodel.solvers import mlcp
from nsmodel.solvers.linearisation import NEWTON_ITERATIONS, IndexSetNewton, Iterate, Linearisation, StepContext
from nsmodel.solvers.one_step_problem import OneStepProblem
from nsmodel.solvers.residuals import (
    CASADI_OPERATIONS,
    GROWTH,
    NEGLIGIBLE_MULTIPLIER,
    ROUNDING,
    STRICTER,
    UNRESOLVED,
    NumericLaw,
    box_residual,
    largest_bound,
    symbolic_max,
)
from nsmodel.solvers.rounding_errors import FRAGILE, SUM_ERROR, UNIT_ROUND_OFF, is_elimination_fragile
from nsmodel.solvers.step import RowLayout, extra_columns
from nsmodel.solvers.structure import StepStructure, least_eigenvalue, with_exact_unknowns

UNSOLVED = 3  # Affine problems with friction that no solver solves, each by the whole chain, after which a step is given up. (+)
# GAIN: less is no Newton's method: another solver, or rounding, has the say.
GAIN = 10  # Factor by which an iteration must better the residual for another one to follow. (+)
EXTRA_ROW_OPERATIONS = 4  # Operations of a row beside those with its unknowns: of b, and of terms that are no products.
WORKING_SET_ABOVE = 24  # Rows of a symmetric complementarity law from which on only those that act are solved for. (+)


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
        Z = self._multiplier_motion(at)
        W = None if Z is None else at.J.Y_l + at.J.Y_z @ Z
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
        return at.J.Y_l + at.J.Y_z @ Z, at.offset(dz_0, Z, l)

    def solve(self, t: float, h: float, state: np.ndarray, l: np.ndarray, index: np.ndarray, chain: Sequence[str]) -> Iterate:
        """Return the accepted iterate, or the best one found (residual above the tolerance)."""
        z, known = self.start(t, h, state, l)
        best, unsolved, self._offsets = None, 0, self._offset(t, h, state)[0]
        at = at_best = self.linearise(t, h, state, z, l)
        seen: set[bytes] = set()
        for iteration in range(1, NEWTON_ITERATIONS + 1):
            moved = self._newton_iteration(at, l, index, chain)
            if moved is None:
                break
            iterate = b"".join(part.tobytes() for part in moved[:3])
            if iterate in seen and not (best is not None and best.residual <= self.tolerance):
                break  # it goes in circles
            seen.add(iterate)
            z, l, index, solver, is_solved = moved
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
            unsolved += not (is_solved or self.law.is_normal_cone)
            if unsolved == UNSOLVED or not (np.isfinite(found.residual) or (np.isfinite(z).all() and np.isfinite(l).all())):
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
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, str, bool] | None:
        """One Newton iteration: the next (z, l, index set), the solver of its affine problem, and whether that is solved."""
        eliminated = self._eliminate(at)
        if eliminated is None:
            return None
        dz_0, Z = eliminated
        solver, is_solved = "none needed", True
        l_next = l
        if l.size:
            b = at.offset(dz_0, Z, l)
            if not np.isfinite(b).all():
                return None
            found = self._solve_affine_problem(at, Z, b, l, index, chain)
            if not np.isfinite(found.l).all():
                return None
            l_next, index, solver = found.l, found.index, found.solver
            is_solved = found.residual <= self.tolerance
        z_next = at.z + dz_0 + Z @ (l_next - l)
        self._make_exact(at, z_next, index)
        return z_next, l_next, index, solver, is_solved

    def _solve_affine_problem(
        self, at: Linearisation, Z: np.ndarray, b: np.ndarray, l: np.ndarray, index: np.ndarray, chain: Sequence[str]
    ) -> mlcp.MlcpSolution:
        """Solve the affine problem; of many complementarity rows only those that act (violated ones are added until none is)."""
        J = at.J
        if not self._by_rows:
            W = J.Y_l + J.Y_z @ Z
            if l.size <= WORKING_SET_ABOVE and not self.structure.gram:
                self.update_least_eigenvalue(W)
            return mlcp.solve_mlcp(W, b, self.law, l, index, chain, self.structure.symmetric, self.tolerance / STRICTER)
        chosen = (b < 0) | (index == 0)
        while True:  # Every pass adds a row.
            rows = np.flatnonzero(chosen)
            law = NumericLaw(self.law.lower[rows], self.law.upper[rows], ())
            W = J.Y_z[rows] @ Z[:, rows] + J.Y_l[np.ix_(rows, rows)]
            part = mlcp.solve_mlcp(W, b[rows], law, l[rows], index[rows], chain, True, self.tolerance / STRICTER)
            if not np.isfinite(part.l).all():
                return mlcp.MlcpSolution(np.full(l.size, np.nan), index, np.inf, part.solver)
            full, code = np.zeros(l.size), np.full(l.size, -1, np.int8)
            full[rows], code[rows] = part.l, part.index
            moved = Z[:, rows] @ part.l
            y, scale = b + J.Y_z @ moved, np.abs(b) + J.sizes.Y_z @ np.abs(moved)
            y = y + J.Y_l[:, rows] @ part.l if J.feeds else y
            violated = (y < -SUM_ERROR * (Z.shape[0] + EXTRA_ROW_OPERATIONS) * EPS * scale) & ~chosen
            if not violated.any():
                return mlcp.MlcpSolution(full, code, part.residual, part.solver if rows.size else "none needed")
            chosen |= violated

    def _is_elimination_fragile(self, at: Linearisation, index: np.ndarray) -> bool:
        """Whether W, eliminated at an iterate, keeps too little of the whole system on its index set."""
        free = np.flatnonzero(index == 0)
        Z = self._multiplier_motion(at)
        if free.size < 2 or Z is None or self._is_on_curved_boundary(index):
            return False
        W = at.J.Y_l[np.ix_(free, free)] + at.J.Y_z[free] @ Z[:, free]
        try:
            return is_elimination_fragile(W, np.linalg.inv(W))
        except np.linalg.LinAlgError:
            return False


# MAX_GRAPH_UNKNOWNS: its size grows with their cube.
MAX_GRAPH_UNKNOWNS = 20  # Unknowns and multipliers up to which a graph has the linear algebra of a step.
# MAX_GRAPH_OPERATIONS: so many take 50 us an iteration; a step without a graph takes some 350.
MAX_GRAPH_OPERATIONS = 12_000  # Operations of a graph from which on it is of no use.
MAX_GRAPH_ITERATIONS = 6  # Of Newton's method by a graph, at most: then the general way is gone. (+)
ROUNDING_MARGIN = 1e3  # So many times its rounding a row must be on its side: where it is nearer the general way is gone. (+)


@dataclass(frozen=True)
class SymbolicLinearisation:
    """The linearisation at (z, l) in symbols, eliminated: dz_0, Z, W, b."""

    z: ca.SX
    E: ca.SX
    Y: ca.SX
    E_z: ca.SX
    E_l: ca.SX
    Y_z: ca.SX
    Y_l: ca.SX
    dz_0: ca.SX
    Z: ca.SX
    W: ca.SX

    @classmethod
    def of(cls, p: OneStepProblem, structure: StepStructure) -> SymbolicLinearisation:
        """Linearise a problem."""
        z, E = (p.z, p.E) if structure.affine else p.explicit_eliminated
        E_z, E_l, Y_z, Y_l = map(ca.densify, p.jacobians)
        both = ca.horzcat(E, E_l)
        both = -both if structure.identity or not p.z.numel() else -ca.solve(ca.sparsify(E_z), both)
        dz_0, Z = both[:, 0], both[:, 1:]
        return cls(z, E, p.Y, E_z, E_l, Y_z, Y_l, dz_0, Z, Y_l + Y_z @ Z)


class LastIndexSetStep:
    """The step on the last index set; ``law`` has boxes alone. ``call`` returns None where the general way has to be gone."""

    def __init__(self, newton: NewtonSolver, layout: RowLayout) -> None:
        problem, structure, law, tolerance = newton.problem, newton.structure, newton.law, newton.tolerance
        self._newton, self._law, self._layout, m = newton, law, layout, law.size
        self._most = (
            1 if structure.affine else MAX_GRAPH_ITERATIONS
        )  # an affine step that is not there at once is refined elsewhere
        p, at = problem, SymbolicLinearisation.of(problem, structure)
        code, bound = ca.SX.sym("code", m), ca.SX.sym("bound", m)
        free = code == 0
        z_next, l_next, fragility, stays = _newton_iteration(p, at, structure, law, code, bound)
        row = _symbolic_row(p, at, structure, law, tolerance, free)
        over = p.overreach if p.overreach is not None and m else ca.SX(0, 1)
        reach = symbolic_max([ca.if_else(p.l[i] == 0, 0, over[i]) for i in range(over.numel())])
        watched = m > 0 and not structure.gram
        known = [p.t, p.h, p.state, p.l, code, bound, p.z]
        moved = [z_next, l_next, at.W, ca.vertcat(_least_cholesky_pivot(at.W) if watched else 1, stays)]
        first, again = ca.substitute(moved, [p.z], [p.guess]), [*moved, row, ca.vertcat(fragility, reach)]
        self._first = ca.Function("first", known[:-1], [ca.densify(e) for e in first], {"cse": True})
        self._again = ca.Function("again", known, [ca.densify(e) for e in again], {"cse": True})
        self.useful = self._again.n_instructions() <= MAX_GRAPH_OPERATIONS
        self._in = [np.zeros(e.numel()) for e in known]
        self._out = [np.zeros(e.numel()) for e in again]
        self._run = [attach_buffers(f, self._in[: f.n_in()], self._out[: f.n_out()]) for f in (self._first, self._again)]
        self._loaded: np.ndarray | None = None
        self._possible = False

    def call(self, t: float, h: float, state: np.ndarray, l: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, float] | None:
        """Return the packed row and the overreach of the step, on the index set ``index`` from the multipliers ``l``."""
        if index is not self._loaded:
            self._load_index_set(index)
        if not self._possible:
            return None
        given, out = self._in, self._out
        given[0][0], given[1][0], given[2][:], given[3][:] = t, h, state, l
        self._run[0][1]()
        last = np.inf
        for iteration in range(1, self._most + 1):
            if not out[3][0] > 0:
                self._update_least_eigenvalue(t, h, state, given[6] if iteration > 1 else None, given[3])
            if out[3][1] != 1.0:
                return None
            given[6][:], given[3][:] = out[0], out[1]
            self._run[1][1]()
            residual = out[4][self._layout.residual]
            if residual <= self._newton.enough:
                fragility, reach = out[5]
                if not fragility <= FRAGILE * max(self._held, 1):
                    return None
                row = out[4] + 0.0  # a copy without -0
                row[self._layout.newton] = iteration
                return row, reach
            if not residual < last / GAIN:
                return None
            last = residual
        return None

    def _load_index_set(self, index: np.ndarray) -> None:
        held = index == 0
        bound = np.where(index < 0, self._law.lower, np.where(index > 0, self._law.upper, 0.0))
        self._in[4][:], self._in[5][:] = index, bound
        self._held, self._possible, self._loaded = int(held.sum()), bool(np.isfinite(bound).all()), index

    def _update_least_eigenvalue(self, t: float, h: float, state: np.ndarray, z: np.ndarray | None, l: np.ndarray) -> None:
        """Let Newton's method note the least eigenvalue of W + W' where that may be below what it has met."""
        newton, W = self._newton, self._out[2].reshape(self._law.size, -1, order="F")
        if np.isfinite(W).all() and least_eigenvalue(W) < newton.least_eigenvalue:
            newton.update_least_eigenvalue(newton.mlcp_matrix(t, h, state, newton.guess(t, h, state, l) if z is None else z, l))


def _newton_iteration(
    p: OneStepProblem, at: SymbolicLinearisation, structure: StepStructure, law: NumericLaw, code: ca.SX, bound: ca.SX
) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:  # fmt: skip
    """The next (z, l), sum |A^-1| |A| of W in the rows held (`rounding.is_elimination_fragile`), whether it is solved."""
    m, l, free = p.l.numel(), p.l, code == 0
    if not m:
        return at.z + at.dz_0, l, ca.SX(0), ca.SX(1)
    b = at.Y + at.Y_z @ (at.dz_0 - at.Z @ l) - at.Y_l @ l
    A = (free @ free.T) * at.W + ca.diag(1 - free)
    inverse = ca.inv_minor(A) if m <= 3 else ca.solve(A, ca.SX.eye(m))
    l_next = bound - inverse @ (free * (b + at.W @ bound))
    fragility = ca.sum1(ca.sum2(ca.fabs(inverse) * ca.fabs(A.T))) - (m - ca.sum1(free))
    z = ca.densify(at.z + at.dz_0 + at.Z @ (l_next - l))
    zero = [ca.SX.zeros(p.z.shape), ca.SX.zeros(p.l.shape)]
    Y_0, E_0 = ca.substitute([p.Y, p.E], [p.z, p.l], zero)
    z = with_exact_unknowns(structure, free, z, E_0, Y_0, at.E_z)
    y, noise = at.W @ l_next + b, SUM_ERROR * EPS * (ca.fabs(at.W) @ ca.fabs(l_next) + ca.fabs(b))
    multiplier_error, stays = ca.fabs(inverse) @ (free * noise), ca.SX(1)
    for i in range(m):
        off = ROUNDING_MARGIN * multiplier_error[i]
        inside = ca.logic_and(l_next[i] - law.lower[i] >= off, law.upper[i] - l_next[i] >= off)
        clear = ca.logic_or(-code[i] * y[i] > ROUNDING_MARGIN * noise[i], ca.logic_and(y[i] == 0, noise[i] == 0))
        stays = ca.logic_and(stays, ca.if_else(free[i], inside, ca.logic_or(clear, law.lower[i] == law.upper[i])))
    return z, l_next, ca.if_else(ca.sum1(free) > 1, fragility, 0), stays


def _least_cholesky_pivot(W: ca.SX) -> ca.SX:
    """The least pivot of Cholesky's method for (W + W')/2, rows and columns scaled alike: > 0 where it is positive definite."""
    m, S = W.shape[0], (W + W.T) / 2
    d = [ca.sqrt(ca.mmax(ca.fabs(S[i, :]))) for i in range(m)]
    scaled = [[S[i, j] / (d[i] * d[j]) for j in range(i + 1)] for i in range(m)]
    L: list[list[ca.SX]] = []
    least = ca.SX(ca.inf)
    for i in range(m):
        L.append([])
        for j in range(i):
            L[i].append((scaled[i][j] - sum((L[i][k] * L[j][k] for k in range(j)), ca.SX(0))) / L[j][j])
        pivot = scaled[i][i] - sum((x * x for x in L[i]), ca.SX(0)) - 1e-12
        least = ca.if_else(pivot < least, pivot, ca.if_else(pivot > 0, least, -1))
        L[i].append(ca.sqrt(pivot))
    return least


def _symbolic_row(
    p: OneStepProblem, at: SymbolicLinearisation, structure: StepStructure, law: NumericLaw, tolerance: float, free: ca.SX
) -> ca.SX:  # fmt: skip
    """The packed row at (z, l) with its residual: `NewtonSolver.judge` in symbols."""
    m, z, l, Y, rounding = law.size, at.z, p.l, at.Y, ROUNDING * UNIT_ROUND_OFF / tolerance
    zero_l = ca.SX.zeros(l.shape)
    guess = ca.substitute(p.guess, l, zero_l) if m else p.guess
    E_guess = ca.substitute([p.E], [p.z, l], [guess, zero_l])[0] if p.z.numel() else p.E
    dz, unmoved = z - guess, ca.fabs(E_guess)
    here = ca.fabs(at.E - at.E_z @ dz - at.E_l @ l)
    error_E = rounding * (ca.fabs(at.E_z) @ ca.fabs(z) + ca.fabs(at.E_l) @ ca.fabs(l))
    matrices = [entry for J in (at.E_z, at.E_l, at.Y_z, at.Y_l) for entry in ca.vertsplit(ca.vec(J)) if not entry.is_constant()]
    s_E = ca.fmin(unmoved, here) + ca.fabs(at.E_z) @ ca.fabs(dz) + error_E
    worst = symbolic_max([_finite_ratio(ca.fabs(at.E[i]), ca.fmax(s_E[i], UNRESOLVED)) for i in range(z.numel())])
    worst = symbolic_max([worst, *map(_zero_if_finite, matrices)])
    if m:
        error_Y = rounding * (ca.fabs(at.Y_z) @ ca.fabs(z) + ca.fabs(at.Y_l) @ ca.fabs(l))
        s_y, s_l = _symbolic_law_scales(at, law, l, free, error_Y)
        rows = box_residual(law, l, Y, s_y, s_l, CASADI_OPERATIONS)
        worst = symbolic_max([worst, *ca.vertsplit(rows), *map(_zero_if_finite, ca.vertsplit(ca.vertcat(l, Y, s_y, s_l)))])
        if structure.projection:
            gap = ca.dot(ca.fmax(l, 0), ca.fmax(Y, 0))
            reach = ca.fmax(ca.sumsqr(dz) + ca.sumsqr(unmoved), UNRESOLVED)
            unseen = tolerance * ca.dot(ca.fabs(l), error_Y)
            worst = symbolic_max([worst, ca.if_else(gap > unseen, gap / reach, 0)])
    y = ca.if_else(free, 0, Y) if m else Y
    rest = [p.next_state, *extra_columns(p).values()]
    rest = [ca.substitute([e], [p.z, p.y], [z, y])[0] if e.numel() and m else e for e in rest]
    rest = rest if m else [ca.substitute(e, p.z, z) if e.numel() else e for e in rest]
    return ca.vertcat(rest[0], l, y, worst, 0, *map(ca.vec, rest[1:]))


def _symbolic_law_scales(
    at: SymbolicLinearisation, law: NumericLaw, l: ca.SX, free: ca.SX, error_Y: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """s_y and s_l, as in `certificate`, where W is not a number."""
    m, moved = law.size, at.Z @ l
    b = at.Y - at.Y_z @ moved - at.Y_l @ l
    terms = ca.fabs(at.Y_z) @ ca.fabs(moved) + ca.fabs(at.Y_l) @ ca.fabs(l)
    w = [ca.mmax(ca.fabs(at.W[i, :])) for i in range(m)]
    if law.is_complementarity:
        w = [ca.if_else(ca.logic_or(l[i] != 0, free[i]), w[i], 1) for i in range(m)]
    root = [ca.sqrt(w_i) for w_i in w]
    weighed = ca.mmax(stack_column([ca.if_else(root[i] > 0, ca.fabs(b[i]) / root[i], 0) for i in range(m)]))
    most = NEGLIGIBLE_MULTIPLIER * ca.mmax(stack_column([ca.fabs(l[i]) * root[i] for i in range(m)]))
    size, s_y, s_l = largest_bound(law), [], []
    for i in range(m):
        own = ca.fabs(b[i])
        capped = ca.fmin(own + terms[i], ca.fmax(GROWTH * root[i] * weighed, own))
        s_y.append(ca.fmax(ca.if_else(root[i] > 0, capped, own) + error_Y[i], UNRESOLVED))
        large = ca.fmax(ca.fabs(l[i]), size[i])
        s_l.append(ca.if_else(root[i] > 0, ca.fmin(s_y[i] / w[i], ca.fmax(large, most / root[i])), large))
    return stack_column(s_y), stack_column(s_l)


def _zero_if_finite(a: ca.SX) -> ca.SX:
    """0 where it is a finite number, else inf."""
    return ca.if_else(ca.fabs(a) < ca.inf, 0, ca.inf)


def _finite_ratio(a: ca.SX, s: ca.SX) -> ca.SX:
    return ca.if_else(a == 0, 0, ca.if_else(s < ca.inf, a / s, ca.inf))
