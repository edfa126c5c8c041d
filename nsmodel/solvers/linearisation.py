"""The functions of a step at (z, l): E, Y and their Jacobians, the unknowns eliminated, the certificate.

With W = Y_l + Y_z Z and Z = -E_z^{-1} E_l, the law is judged at the model's own y, E against what moves in the step.

A step by linear systems in (z, l) as a whole, where W keeps too little: on an index set, or on the sets that follow.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof.expression_graph import stack_column
from nsmodel.proof.verdict import attach_buffers
from nsmodel.solvers import active_set
from nsmodel.solvers.fallbacks import nearest_point_of_polyhedron
from nsmodel.solvers.mlcp import ARMIJO
from nsmodel.solvers.one_step_problem import OneStepProblem
from nsmodel.solvers.residuals import ROUNDING, UNRESOLVED, NumericLaw, law_residual, output_scale
from nsmodel.solvers.rounding_errors import (
    UNIT_ROUND_OFF,
    dense_solution_errors,
    equilibrate_matrix,
    rounding_error_bound,
    row_maxima,
)
from nsmodel.solvers.step import extra_columns
from nsmodel.solvers.structure import StepStructure

ENOUGH = 1e-2  # Part of the tolerance from which on nothing is improved; (~)
SUFFICIENT_IF_AFFINE = 1e-4  # one linear system more takes an affine step to rounding. (~)
MAX_CSE_INPUTS = 5000  # Inputs up to which looking for common subexpressions pays for the time it takes.
MAX_ZEROS = 1000  # Entries without a value up to which a matrix is evaluated with them; else its entries are put in place.
NOT_COMPUTED = object()  # Not computed yet.


@dataclass
class StepJacobians:
    """The Jacobians at (z, l), of an affine step those of all iterates, and what is made of them once.

    ``feeds``: whether y depends on l directly; else Y_l is 0, and no sum has its terms. ``Z``: None until it is known.
    """

    E_z: np.ndarray
    E_l: np.ndarray
    Y_z: np.ndarray
    Y_l: np.ndarray
    feeds: bool
    Z: np.ndarray | None = None

    @cached_property
    def are_finite(self) -> bool:
        """Whether all entries are numbers."""
        return all(np.isfinite(part).all() for part in (self.E_z, self.E_l, self.Y_z, *([self.Y_l] if self.feeds else [])))

    @cached_property
    def sizes(self) -> StepJacobians:
        """The absolute values."""
        E_z, E_l, Y_z = map(np.abs, (self.E_z, self.E_l, self.Y_z))
        return StepJacobians(E_z, E_l, Y_z, np.abs(self.Y_l) if self.feeds else self.Y_l, self.feeds)

    def output_change(self, dz: np.ndarray, dl: np.ndarray) -> np.ndarray:
        """Y_z dz + Y_l dl."""
        moved = self.Y_z @ dz
        return moved + self.Y_l @ dl if self.feeds else moved

    def row_change(self, dz: np.ndarray, dl: np.ndarray) -> np.ndarray:
        """What E and Y change by, in this order."""
        return np.concatenate([self.E_z @ dz + self.E_l @ dl, self.output_change(dz, dl)])


@dataclass
class Linearisation:
    """z, with the explicit unknowns as their rows give them for the others; E, Y and their Jacobians there."""

    z: np.ndarray
    E: np.ndarray
    Y: np.ndarray
    J: StepJacobians
    eliminated: Any = NOT_COMPUTED

    def offset(self, dz_0: np.ndarray, Z: np.ndarray, l: np.ndarray) -> np.ndarray:
        """The b of y+ = W l+ + b, from the iterate l."""
        b = self.Y + self.J.Y_z @ (dz_0 - Z @ l)
        return b - self.J.Y_l @ l if self.J.feeds else b


class StepContext(NamedTuple):
    """What a step is given, and what moves there: t, h, the state; z and |E| where nothing moves."""

    t: float
    h: float
    state: np.ndarray
    guess: np.ndarray
    unmoved: np.ndarray


@dataclass
class Iterate:
    """(z, l), its index set, the certificate with the row that is worst, and how it was found."""

    z: np.ndarray
    l: np.ndarray
    index: np.ndarray
    y: np.ndarray
    residual: float
    worst_row: int | None
    solver: str
    iterations: int


class LinearisedStep:
    """One problem, evaluated at iterates."""

    def __init__(self, problem: OneStepProblem, structure: StepStructure, law: NumericLaw, tolerance: float) -> None:
        self.problem, self.structure, self.law, self.tolerance = problem, structure, law, tolerance
        p = problem
        known = [p.t, p.h, p.state]
        reduced = (p.z, p.E) if structure.affine else p.explicit_eliminated
        self._rows = ca.vertcat(reduced[1], p.Y)
        self._feeds = p.jacobians[3].nnz() > 0
        rows, given = [*reduced, p.Y], [*known, p.z, p.l]
        if structure.affine:
            self._evaluate_rows = BufferedStepFunction("rows", given, rows)
            self._evaluate_jacobians = BufferedStepFunction("matrices", known, list(p.jacobians), matrices=4)
        else:
            self._linearise = BufferedStepFunction("linearise", given, [*rows, *p.jacobians], matrices=4)
        self._jacobians: tuple[Any, StepJacobians] | None = None  # Of the last affine step, and what they depend on.
        guess_0 = ca.substitute([p.guess], [p.l], [ca.SX.zeros(p.l.shape)])[0] if p.l.numel() else p.guess
        E_guess = ca.substitute([p.E], [p.z, p.l], [guess_0, ca.SX.zeros(p.l.shape)])[0] if p.z.numel() else p.E
        unit, follow = [row for row, *_ in structure.unit_rows], [i for i, _ in structure.follow_rows]
        exact = stack_column([*(p.Y[i] for i in unit), *(p.E[i] for i in follow)])
        at_zero = ca.substitute([exact], [p.z, p.l], [ca.SX.zeros(p.z.shape), ca.SX.zeros(p.l.shape)])[0]
        self._offset = BufferedStepFunction("offset", known, [at_zero])
        self._offsets = np.zeros(len(unit) + len(follow))
        self._guess = BufferedStepFunction("guess", [*known, p.l], [p.guess, guess_0, E_guess])
        self._pack = BufferedStepFunction("pack", [*known, p.z, p.l, p.y], [p.next_state, *extra_columns(p).values()])
        self._complementarity = law.is_complementarity
        self._error: BufferedStepFunction | None = None
        self.enough = tolerance * (SUFFICIENT_IF_AFFINE if structure.affine else ENOUGH)

    def linearise(self, t: float, h: float, state: np.ndarray, z: np.ndarray, l: np.ndarray) -> Linearisation:
        """Evaluate E, Y and the exact Jacobians; those of an affine step once."""
        if self.structure.affine:
            z, E, Y = self._evaluate_rows(t, h, state, z, l)
            return Linearisation(z, E, Y, self._affine_jacobians(t, h, state))
        z, E, Y, E_z, E_l, Y_z, Y_l = self._linearise(t, h, state, z, l)
        return Linearisation(z, E, Y, StepJacobians(E_z, E_l, Y_z, Y_l, self._feeds))

    def _affine_jacobians(self, t: float, h: float, state: np.ndarray) -> StepJacobians:
        given = h if self.structure.constant else (t, h, state.tobytes())
        if self._jacobians is None or self._jacobians[0] != given:
            E_z, E_l, Y_z, Y_l = self._evaluate_jacobians(t, h, state)
            self._jacobians = given, StepJacobians(E_z, E_l, Y_z, Y_l, self._feeds)
        return self._jacobians[1]

    def start(self, t: float, h: float, state: np.ndarray, l: np.ndarray) -> tuple[np.ndarray, StepContext]:
        """The first z for these l, and what the step is given."""
        z, guess, E_guess = self._guess(t, h, state, l)
        return z, StepContext(t, h, state, guess, np.abs(E_guess))

    def guess(self, t: float, h: float, state: np.ndarray, l: np.ndarray) -> np.ndarray:
        """The values z that Newton's method starts from."""
        return self.start(t, h, state, l)[0]

    def known(self, t: float, h: float, state: np.ndarray) -> StepContext:
        """What the step is given."""
        return self.start(t, h, state, np.zeros(self.law.size))[1]

    def _eliminate(self, at: Linearisation) -> tuple[np.ndarray, np.ndarray] | None:
        """dz_0 = -E_z^{-1} E and Z = -E_z^{-1} E_l, computed once; None where E_z is singular or not finite."""
        if at.eliminated is NOT_COMPUTED:
            at.eliminated = self._solve_elimination(at)
            if at.eliminated is not None:
                at.J.Z = at.eliminated[1]
        return at.eliminated

    def _multiplier_motion(self, at: Linearisation) -> np.ndarray | None:
        """Z, known already where another iterate has the same matrices; None where E_z is singular or not finite."""
        if at.J.Z is None:
            self._eliminate(at)
        return at.J.Z

    def _solve_elimination(self, at: Linearisation) -> tuple[np.ndarray, np.ndarray] | None:
        E_z, E_l = at.J.E_z, at.J.E_l
        if not (np.isfinite(at.E).all() and np.isfinite(E_z).all() and np.isfinite(E_l).all()):
            return None
        if self.structure.identity:
            return -at.E, -E_l
        try:
            both = np.linalg.solve(E_z, np.column_stack([at.E, E_l]))
        except np.linalg.LinAlgError:
            return None
        return -both[:, 0], -both[:, 1:]

    def evaluate_residual(
        self, known: StepContext, at: Linearisation, l: np.ndarray, index: np.ndarray, solver: str, iterations: int,
        thorough: bool = True,
    ) -> Iterate:  # fmt: skip
        """The certificate at (z, l): E against what moves in the step, and the law at the model's own y.

        Rounding is looked at where it may matter, its parts in the order of what they cost: that of the unknowns in the rows and,
        where ``thorough``, the rows' own and what the unknowns err by.
        """
        z, n = at.z, at.z.size
        if not (all(np.isfinite(part).all() for part in (z, l, at.E, at.Y)) and at.J.are_finite):
            return Iterate(z, l, index, at.Y, np.inf, None, solver, iterations)
        sizes = at.J.sizes.row_change(np.abs(z), np.abs(l))
        scales = self._residual_scales(known, at, z, l, index)
        worst, row = self._largest_residual(known, at, z, l, scales, sizes)
        if thorough and self.tolerance < worst < np.inf:
            error = self._rounding_bounds(known, z, l)
            worst, row = self._largest_residual(known, at, z, l, scales, error)
            if worst > self.tolerance:
                J, free = self._index_set_system(at, index)
                of = dense_solution_errors(J, np.concatenate([error[:n], error[n:][free]]))
                dz, dl = of[:n], np.zeros((l.size, of.shape[1]))
                dl[free] = of[n:]
                error = error + row_maxima(at.J.row_change(dz, dl))
                worst, row = self._largest_residual(known, at, z, l, scales, error)
        y = np.where(index == 0, 0.0, at.Y) if l.size else at.Y
        return Iterate(z, l, index, y, worst, row, solver, iterations)

    def _residual_scales(
        self, known: StepContext, at: Linearisation, z: np.ndarray, l: np.ndarray, index: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
        """What moves or acts: the scales of E and of y, and max_j |W_ij|."""
        dz = z - known.guess
        # E where nothing moves counts no more than the linearisation at the answer makes of it: far away, it may be anything.
        unmoved = np.minimum(known.unmoved, np.abs(at.E - at.J.E_z @ dz - at.J.E_l @ l))
        s_E = unmoved + at.J.sizes.E_z @ np.abs(dz)
        return s_E, *(self._law_scales(at, z, l, index) if l.size else (l, l))

    def _largest_residual(
        self, known: StepContext, at: Linearisation, z: np.ndarray, l: np.ndarray,
        scales: tuple[np.ndarray, np.ndarray, np.ndarray], error: np.ndarray,
    ) -> tuple[float, int | None]:  # fmt: skip
        """The certificate with the rounding ``error`` of the rows, in units of u; the row of y that is worst."""
        n, (s_E, s_y, w_max), c_u = z.size, scales, ROUNDING * UNIT_ROUND_OFF
        if not np.isfinite(error).all():  # an infinite bound excuses nothing
            error = np.where(np.isfinite(error), error, 0.0)
        s_E = np.maximum(s_E + c_u / self.tolerance * error[:n], UNRESOLVED)
        with np.errstate(divide="ignore", invalid="ignore"):
            dynamics = np.where(at.E == 0, 0, np.abs(at.E) / s_E).max(initial=0.0)
        sized = np.isfinite(dynamics) and np.isfinite(s_E).all()  # nor does an infinite scale
        worst, row = float(dynamics) if sized else np.inf, None
        if l.size:
            residual = law_residual(self.law, l, at.Y, s_y, w_max, c_u / self.tolerance * error[n:])
            if residual.max() >= worst or not np.isfinite(residual).all():
                row = int(np.argmax(np.where(np.isnan(residual), np.inf, residual)))
                worst = float(residual[row])
            if self.structure.projection:
                worst = max(worst, self._relative_duality_gap(known, at, z, l, c_u * error[n:]))
        return worst, row

    def _rounding_bounds(self, known: StepContext, z: np.ndarray, l: np.ndarray) -> np.ndarray:
        """The running error bounds of E and Y, in units of u."""
        p = self.problem
        if self._error is None:
            bound = rounding_error_bound(self._rows, ca.vertcat(p.z, p.l))
            self._error = BufferedStepFunction("error", [p.t, p.h, p.state, p.z, p.l], [bound])
        return self._error(known.t, known.h, known.state, z, l)[0]

    def _index_set_system(self, at: Linearisation, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The matrix of E = 0 and of Y = 0 in the rows coded 0, and these rows; other multipliers are taken as given."""
        free, J = np.flatnonzero(index == 0), at.J
        return np.block([[J.E_z, J.E_l[:, free]], [J.Y_z[free], J.Y_l[np.ix_(free, free)]]]), free

    def _scaled_system(self, at: Linearisation, index: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """That matrix, its rows and columns in units in which it is well scaled, and these; None where it is not finite."""
        J, _ = self._index_set_system(at, index)
        return equilibrate_matrix(J) if np.isfinite(J).all() else None

    @staticmethod
    def _relative_duality_gap(known: StepContext, at: Linearisation, z: np.ndarray, l: np.ndarray, unseen: np.ndarray) -> float:
        """<l, y>, which bounds the square of the distance to the projection, beside the square of what moves; 0 if rounding."""
        gap, dz = float(np.maximum(l, 0) @ np.maximum(at.Y, 0)), z - known.guess
        moved = float(dz @ dz + known.unmoved @ known.unmoved)
        return gap / max(moved, UNRESOLVED) if gap > np.abs(l) @ unseen else 0.0

    def _law_scales(
        self, at: Linearisation, z: np.ndarray, l: np.ndarray, index: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """s_y and max_j |W_ij|, computed for the columns with l != 0 and the rows that act."""
        J, Z = at.J, self._multiplier_motion(at)
        Z = np.zeros((z.size, l.size)) if Z is None else Z
        columns = np.flatnonzero(l)
        moved = Z[:, columns] @ l[columns]
        b, terms = at.Y - J.Y_z @ moved, J.sizes.Y_z @ np.abs(moved)
        rows = np.flatnonzero((l != self.law.lower) | (index == 0)) if self._complementarity else np.arange(l.size)
        w_max, W = np.ones(l.size), J.Y_z[rows] @ Z
        if J.feeds:
            pushed = J.Y_l[:, columns] * l[columns]
            b, terms, W = b - pushed.sum(axis=1), terms + np.abs(pushed).sum(axis=1), J.Y_l[rows] + W
        w_max[rows] = np.abs(W).max(axis=1, initial=0.0)
        return output_scale(b, terms, w_max), w_max

    def pack(self, t: float, h: float, state: np.ndarray, found: Iterate) -> np.ndarray:
        """The packed row of an iterate."""
        parts = self._pack(t, h, state, found.z, found.l, found.y)
        return np.concatenate([parts[0], found.l, found.y, [found.residual, found.iterations], *parts[1:]]) + 0.0


class BufferedStepFunction:
    """A CasADi function called through buffer(): columns come back as fresh 1-D arrays, the last ``matrices`` outputs as 2-D."""

    def __init__(self, name: str, inputs: list[ca.SX], outputs: list[ca.SX], matrices: int = 0) -> None:
        shared = sum(e.numel() for e in inputs) < MAX_CSE_INPUTS
        columns = len(outputs) - matrices
        stays_sparse = [i >= columns and (not e.nnz() or e.numel() - e.nnz() > MAX_ZEROS) for i, e in enumerate(outputs)]
        given = [e if sparse else ca.densify(e) for e, sparse in zip(outputs, stays_sparse, strict=True)]
        function = ca.Function(name, inputs, given, {"cse": shared})
        self._in = [np.zeros(e.numel()) for e in inputs]
        self._out = [np.zeros(e.nnz() if i < columns or stays_sparse[i] else e.shape, order="F") for i, e in enumerate(given)]
        self._sparse = [SparseMatrix.of(e) if sparse else None for e, sparse in zip(given, stays_sparse, strict=True)]
        self._buffer, self._run = attach_buffers(function, self._in, self._out)

    def __call__(self, *values: float | np.ndarray) -> list[np.ndarray]:
        """The outputs at these inputs."""
        for array, value in zip(self._in, values, strict=True):
            array[:] = value
        self._run()
        return [
            out.copy(order="F") if sparse is None else sparse.filled(out)
            for out, sparse in zip(self._out, self._sparse, strict=True)
        ]


@dataclass(frozen=True)
class SparseMatrix:
    """Where a matrix has entries, counted by columns; one without entries is made once."""

    shape: tuple[int, int]
    places: np.ndarray
    zero: np.ndarray

    @classmethod
    def of(cls, expression: ca.SX) -> SparseMatrix:
        """Where an expression has entries."""
        zero = np.zeros(expression.shape, order="F")
        zero.flags.writeable = False
        return cls(expression.shape, np.array(expression.sparsity().find(), int), zero)

    def filled(self, entries: np.ndarray) -> np.ndarray:
        """A fresh matrix with these entries."""
        if not entries.size:
            return self.zero
        flat = np.zeros(self.shape[0] * self.shape[1])
        flat[self.places] = entries
        return flat.reshape(self.shape, order="F")


MAX_INDEX_SET_CHANGES = 12  # Index sets that are tried on the whole system, beside two a row; then the best one is taken. (+)
# MAX_CUT_LINEARISATIONS: after them Newton's method goes on with the rows that hold.
MAX_CUT_LINEARISATIONS = 40  # Linearisations of curved constraints, of all of which the nearest point is found.
REFINEMENTS = 5  # Of an affine step on an index set: one solves it, each further one takes away rounding. (~)
LAST_NEWTON_STEP_SHARE = 1e-6  # Part of the unknowns: the size of a last step of Newton's method: what is left is its square. (+)
HALVINGS = 20  # Of a step of Newton's method, at most: a millionth of it is still tried. (+)
MIN_STEP_FRACTION = 2.0**-HALVINGS  # Part of a step that is still tried.
# NEAREST: on the other side sqrt|y| is a mirror image, and steps would go to and fro.
NEAREST = 1e-3  # Part of its way to 0 that y keeps in a step where slopes are infinite there. (+)
EARLY = 3  # Iterations up to which Newton's method on an index set goes on where a step brings nothing, as first ones may. (~)
NEWTON_ITERATIONS = 30  # Linearisations in a step, at most; then the next solver is tried. (+)


class IndexSetNewton(LinearisedStep):
    """Newton's method on the index sets of one problem."""

    def _make_exact(self, at: Linearisation, z: np.ndarray, index: np.ndarray) -> None:
        """Put z_j where y_i = factor z_j + c is exactly 0, for the rows coded 0, what follows from them, and z = 0 at rest."""
        unit, follow = self.structure.unit_rows, self.structure.follow_rows
        for (row, j, factor), offset in zip(unit, self._offsets[: len(unit)], strict=True):
            if index[row] == 0:
                z[j] = -offset / factor
        for (i, needed), offset in zip(follow, self._offsets[len(unit) :], strict=True):
            if all((index[list(rows)] == 0).any() for _, rows in needed):
                E_z = at.J.E_z
                z[i] = -(offset + sum(E_z[i, j] * z[j] for j, _ in needed)) / E_z[i, i]
        rest = self.structure.rest_rows
        if rest and not index[list(rest)].any():
            z[:] = 0.0

    def polish_on_index_set(self, t: float, h: float, state: np.ndarray, l: np.ndarray, index: np.ndarray) -> Iterate | None:
        """The step on an index set by the whole system; with a block on its curved boundary at the l given, z refined."""
        z, known = self.start(t, h, state, l)
        if not self._is_on_curved_boundary(index):
            return self._newton_on_index_set(known, z, l, index)
        at, found = self.linearise(t, h, state, z, l), None
        for iteration in range(1, REFINEMENTS + 1):
            if not (np.isfinite(at.E).all() and np.isfinite(at.J.E_z).all()):
                return found
            scaled, rows, columns = equilibrate_matrix(at.J.E_z)
            z = at.z - columns * active_set.solve_or_least_squares(scaled, rows * at.E) if z.size else z
            at = self.linearise(t, h, state, z, l)
            found = self.evaluate_residual(known, at, l, index, "", iteration)
            if found.residual <= self.enough:
                break
        return found

    def solve_whole_system(self, t: float, h: float, state: np.ndarray, l: np.ndarray, index: np.ndarray) -> Iterate | None:
        """The step by an active set method on the whole system, of which W keeps too little; from an index set without curves."""
        z, known = self.start(t, h, state, l)
        return self._active_set_method(known, z, l, index)

    def solve_nearest_point(self, t: float, h: float, state: np.ndarray) -> Iterate | None:
        """The nearest point of {Y >= 0} by the dual active set method; None where it finds none.

        Where Y is curved, of the polyhedron that its linearisations at all points so far leave: where Y is concave, it holds
        the set, and the points tend to the one that is sought (Kelley, J. SIAM 8, 1960).
        """
        l = np.zeros(self.law.size)
        z, known = self.start(t, h, state, l)
        normals, levels, point, held = np.zeros((0, z.size)), np.zeros(0), None, np.zeros(0, int)
        for _ in range(1 if self.structure.affine else MAX_CUT_LINEARISATIONS):
            at = self.linearise(t, h, state, z, l)
            Y_z = at.J.Y_z
            if not (np.isfinite(at.E).all() and np.isfinite(at.Y).all() and np.isfinite(Y_z).all()):
                return None
            point = z - at.E if point is None else point
            normals, levels = np.vstack([normals, Y_z]), np.concatenate([levels, Y_z @ z - at.Y])
            found = nearest_point_of_polyhedron(point, normals, levels)
            if found is None:
                return None
            last, (z, held) = z, found
            if np.linalg.norm(z - last) <= LAST_NEWTON_STEP_SHARE * np.linalg.norm(z - point):
                break
        index = np.full(l.size, -1, np.int8)
        index[held % l.size] = 0
        if self.structure.affine:
            return self._active_set_method(known, z, l, index)
        lengths = np.linalg.norm(normals[held], axis=1)
        np.add.at(l, held % l.size, np.linalg.lstsq((normals[held] / lengths[:, None]).T, z - point, rcond=None)[0] / lengths)
        return self._newton_on_index_set(known, z, l, index)

    def _active_set_method(
        self, known: StepContext, z: np.ndarray, l: np.ndarray, index: np.ndarray, best: Iterate | None = None
    ) -> Iterate | None:
        """An active set method on the whole system; ``best``: what elimination has found.

        All rows that contradict their codes change at once, until that repeats itself; then one at a time, the last of them,
        which ends for P-matrices (Murty, Linear Algebra and its Applications 7, 1974).
        """
        seen, single = set(), False
        for _ in range(MAX_INDEX_SET_CHANGES + 2 * index.size):
            if index.tobytes() in seen:
                if single:
                    break
                seen, single = set(), True
            seen.add(index.tobytes())
            found = self._newton_on_index_set(known, z, l, index, least=2)
            if found is None:
                break
            best = found if best is None or found.residual <= max(best.residual, self.enough) else best
            z, l = found.z, found.l
            at = self.linearise(*known[:3], z, l)
            unseen = ROUNDING * UNIT_ROUND_OFF * (at.J.sizes.output_change(np.abs(z), np.abs(l)) + np.abs(at.Y))
            outside = np.where(l < self.law.lower, -1, np.where(l > self.law.upper, 1, 0))
            if found.residual > self.enough:  # rows that cannot all be held: one that is left open goes to its bound
                left_open = np.where((at.Y > unseen) & np.isfinite(self.law.lower), -1, 0)
                left_open = np.where((at.Y < -unseen) & np.isfinite(self.law.upper), 1, left_open)
                outside = np.where(outside == 0, left_open, outside)
            called_for = np.where(index == 0, outside, np.where(index * at.Y > unseen, 0, index))
            wrong = np.flatnonzero(called_for != index)
            if not wrong.size and found.residual <= self.tolerance:
                return found
            changed, index = wrong[-1:] if single else wrong, index.copy()
            index[changed] = called_for[changed]
        return best

    def _is_on_curved_boundary(self, index: np.ndarray) -> bool:
        """Whether a curved block is on its boundary: then its index set is no linear system."""
        return any(index[rows][0] > 0 for rows, _ in self.law.curved)

    def solve_on_index_set(
        self, t: float, h: float, state: np.ndarray, z: np.ndarray, l: np.ndarray, index: np.ndarray
    ) -> Iterate | None:
        """Damped Newton for the smooth system E = 0, Y_i = 0 (code 0), l_i at its bound (code +-1), from (z, l)."""
        return self._newton_on_index_set(self.known(t, h, state), z, l, index)

    def _newton_on_index_set(
        self, known: StepContext, z: np.ndarray, l: np.ndarray, index: np.ndarray, least: int = 1
    ) -> Iterate | None:  # fmt: skip
        """`solve_on_index_set`, by ``least`` linear systems or more."""
        t, h, state = known[:3]
        l = np.where(index < 0, self.law.lower, np.where(index > 0, self.law.upper, l))
        for rows, _ in self.law.curved:
            l[rows] = 0.0 if index[rows][0] < 0 else l[rows]
        if not np.isfinite(l).all():
            return None
        n, self._offsets = z.size, self._offset(t, h, state)[0]
        at = self.linearise(t, h, state, z, l)
        if (mirrored := self._mirrored(at, index)) is not None:
            at = self.linearise(t, h, state, mirrored, l)
        free, system = np.flatnonzero(index == 0), None
        size, best, exact = np.linalg.norm(np.concatenate([at.E, at.Y[free]])), None, False
        for iteration in range(1, (REFINEMENTS if self.structure.affine else NEWTON_ITERATIONS) + 1):
            if system is None or not self.structure.affine:
                system = self._scaled_system(at, index)
            if system is None:
                break
            scaled, rows, columns = system
            if exact:  # z is so by these rows, as near as doubles come: the others are solved for it
                at.Y[[row for row, *_ in self.structure.unit_rows if index[row] == 0]] = 0.0
            step = columns * active_set.solve_or_least_squares(scaled, -rows * np.concatenate([at.E, at.Y[free]]))
            z = at.z
            t_step, old, found, z_new, l_new, at_new = self._step_within_sides(at, index, step), size, None, z, l, at
            if not t_step:
                break
            extent = np.abs(np.concatenate([z, l[free]])) / columns
            near = self.structure.affine or np.abs(step / columns).max(initial=0.0) <= LAST_NEWTON_STEP_SHARE * extent.max(
                initial=0.0
            )
            while found is None:
                z_new, l_new = z + t_step * step[:n], l.copy()
                l_new[free] += t_step * step[n:]
                exact = t_step == 1.0
                if exact:
                    self._make_exact(at, z_new, index)
                at_new = self.linearise(t, h, state, z_new, l_new)
                size = np.linalg.norm(np.concatenate([at_new.E, at_new.Y[free]]))
                if size <= (1 - ARMIJO * t_step) * old or t_step == 1 or t_step <= MIN_STEP_FRACTION or self.structure.affine:
                    found = self.evaluate_residual(known, at_new, l_new, index, "newton on the index set", iteration, near)
                    if t_step == 1.0 and found.residual > self.tolerance and not size <= (1 - ARMIJO) * old:
                        found = found if self.structure.affine or old == 0 else None
                t_step /= 2
            z, l, at, stalled = z_new, l_new, at_new, size >= (1 - 2 * ARMIJO * t_step) * old
            best = found if best is None or found.residual <= max(best.residual, self.enough) else best
            if (found.residual <= self.enough and iteration >= least) or (stalled and iteration > EARLY):
                break
        return best

    def _mirrored(self, at: Linearisation, index: np.ndarray) -> np.ndarray | None:
        """A start with y on the side that the index set says, where slopes are infinite; None where y is there."""
        wrong = index * at.Y > 0
        if not self.problem.has_infinite_slopes or not wrong.any() or not np.isfinite(at.J.Y_z).all():
            return None
        sizes = (at.J.Y_z**2).sum(axis=1)
        moved = wrong & (sizes > 0)
        return at.z - 2 * (at.Y[moved] / sizes[moved]) @ at.J.Y_z[moved]

    def _step_within_sides(self, at: Linearisation, index: np.ndarray, step: np.ndarray) -> float:
        """The part of a step up to which each y stays on the side that the index set says, where slopes are infinite; else 1.

        Beyond y = 0 sqrt|y| is the mirror image of what l at this end goes with, and steps would go to and fro.
        """
        if not self.problem.has_infinite_slopes:
            return 1.0
        n, free = at.z.size, index == 0
        room, taken = -index * at.Y, index * (at.J.Y_z @ step[:n] + at.J.Y_l[:, free] @ step[n:])
        crosses = (room >= 0) & (taken > (1 - NEAREST) * room)
        return float(((1 - NEAREST) * room[crosses] / taken[crosses]).min(initial=1.0))
