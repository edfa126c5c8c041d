"""The functions of a step at (z, l): E, Y and their Jacobians, the unknowns eliminated, the certificate.

With W = Y_l + Y_z Z and Z = -E_z^{-1} E_l, the law is judged at the model's own y, E against what moves in the step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof.buffered import attach_buffers
from nsmodel.proof.graph import stack_column
from nsmodel.scheme.problem import OneStepProblem
from nsmodel.solve.certificate import ROUNDING, UNRESOLVED, NumericLaw, law_residual, output_scale
from nsmodel.solve.layout import extra_columns
from nsmodel.solve.rounding import UNIT_ROUND_OFF, dense_solution_errors, rounding_error_bound, row_maxima
from nsmodel.solve.structure import StepStructure

ENOUGH = 1e-2  # Part of the tolerance from which on nothing is improved;
SUFFICIENT_IF_AFFINE = 1e-4  # one linear system more takes an affine step to rounding.
MAX_CSE_INPUTS = 5000  # Inputs up to which looking for common subexpressions pays for the time it takes.
NOT_COMPUTED = object()  # Not computed yet.


@dataclass
class Linearisation:
    """z, with the explicit unknowns as their rows give them for the others; E, Y and their Jacobians there."""

    z: np.ndarray
    E: np.ndarray
    Y: np.ndarray
    E_z: np.ndarray
    E_l: np.ndarray
    Y_z: np.ndarray
    Y_l: np.ndarray
    eliminated: Any = NOT_COMPUTED

    def offset(self, dz_0: np.ndarray, Z: np.ndarray, l: np.ndarray) -> np.ndarray:
        """The b of y+ = W l+ + b, from the iterate l."""
        return self.Y + self.Y_z @ (dz_0 - Z @ l) - self.Y_l @ l


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
        parts = [*reduced, p.Y, *p.jacobians]
        self._linearise = BufferedStepFunction("linearise", [*known, p.z, p.l], parts, matrices=4)
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
        """Evaluate E, Y and the exact Jacobians."""
        return Linearisation(*self._linearise(t, h, state, z, l))

    def start(self, t: float, h: float, state: np.ndarray, l: np.ndarray) -> tuple[np.ndarray, StepContext]:
        """The first z for these l, and what the step is given."""
        z, guess, E_guess = self._guess(t, h, state, l)
        return z, StepContext(t, h, state, guess, np.abs(E_guess))

    def guess(self, t: float, h: float, state: np.ndarray, l: np.ndarray) -> np.ndarray:
        """The first z."""
        return self.start(t, h, state, l)[0]

    def known(self, t: float, h: float, state: np.ndarray) -> StepContext:
        """What the step is given."""
        return self.start(t, h, state, np.zeros(self.law.size))[1]

    def _eliminate(self, at: Linearisation) -> tuple[np.ndarray, np.ndarray] | None:
        """dz_0 = -E_z^{-1} E and Z = -E_z^{-1} E_l, computed once; None where E_z is singular or not finite."""
        if at.eliminated is NOT_COMPUTED:
            at.eliminated = self._solve_elimination(at)
        return at.eliminated

    def _solve_elimination(self, at: Linearisation) -> tuple[np.ndarray, np.ndarray] | None:
        if not (np.isfinite(at.E).all() and np.isfinite(at.E_z).all() and np.isfinite(at.E_l).all()):
            return None
        if self.structure.identity:
            return -at.E, -at.E_l
        try:
            both = np.linalg.solve(at.E_z, np.column_stack([at.E, at.E_l]))
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
        z = at.z
        if not all(np.isfinite(part).all() for part in (z, l, at.E, at.Y, at.E_z, at.E_l, at.Y_z, at.Y_l)):
            return Iterate(z, l, index, at.Y, np.inf, None, solver, iterations)
        n, abs_z, abs_l = z.size, np.abs(z), np.abs(l)
        sizes = np.concatenate([np.abs(at.E_z) @ abs_z + np.abs(at.E_l) @ abs_l, np.abs(at.Y_z) @ abs_z + np.abs(at.Y_l) @ abs_l])
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
                error = error + row_maxima(np.concatenate([at.E_z @ dz + at.E_l @ dl, at.Y_z @ dz + at.Y_l @ dl]))
                worst, row = self._largest_residual(known, at, z, l, scales, error)
        y = np.where(index == 0, 0.0, at.Y) if l.size else at.Y
        return Iterate(z, l, index, y, worst, row, solver, iterations)

    def _residual_scales(
        self, known: StepContext, at: Linearisation, z: np.ndarray, l: np.ndarray, index: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
        """What moves or acts: the scales of E and of y, and max_j |W_ij|."""
        dz = z - known.guess
        # E where nothing moves counts no more than the linearisation at the answer makes of it: far away, it may be anything.
        unmoved = np.minimum(known.unmoved, np.abs(at.E - at.E_z @ dz - at.E_l @ l))
        s_E = unmoved + np.abs(at.E_z) @ np.abs(dz)
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
        free = np.flatnonzero(index == 0)
        return np.block([[at.E_z, at.E_l[:, free]], [at.Y_z[free], at.Y_l[np.ix_(free, free)]]]), free

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
        eliminated = self._eliminate(at)
        Z = np.zeros((z.size, l.size)) if eliminated is None else eliminated[1]
        columns = np.flatnonzero(l)
        moved, pushed = Z[:, columns] @ l[columns], at.Y_l[:, columns] * l[columns]
        b = at.Y - at.Y_z @ moved - pushed.sum(axis=1)
        terms = np.abs(at.Y_z) @ np.abs(moved) + np.abs(pushed).sum(axis=1)
        rows = np.flatnonzero((l != self.law.lower) | (index == 0)) if self._complementarity else np.arange(l.size)
        w_max = np.ones(l.size)
        w_max[rows] = np.abs(at.Y_l[rows] + at.Y_z[rows] @ Z).max(axis=1, initial=0.0)
        return output_scale(b, terms, w_max), w_max

    def pack(self, t: float, h: float, state: np.ndarray, found: Iterate) -> np.ndarray:
        """The packed row of an iterate."""
        parts = self._pack(t, h, state, found.z, found.l, found.y)
        return np.concatenate([parts[0], found.l, found.y, [found.residual, found.iterations], *parts[1:]]) + 0.0


class BufferedStepFunction:
    """A CasADi function called through buffer(): columns come back as fresh 1-D arrays, the last ``matrices`` outputs as 2-D."""

    def __init__(self, name: str, inputs: list[ca.SX], outputs: list[ca.SX], matrices: int = 0) -> None:
        shared = sum(e.numel() for e in inputs) < MAX_CSE_INPUTS
        function = ca.Function(name, inputs, [ca.densify(e) for e in outputs], {"cse": shared})
        self._in = [np.zeros(e.numel()) for e in inputs]
        columns = len(outputs) - matrices
        self._out = [np.zeros(e.numel() if i < columns else e.shape, order="F") for i, e in enumerate(outputs)]
        self._buffer, self._run = attach_buffers(function, self._in, self._out)

    def __call__(self, *values: float | np.ndarray) -> list[np.ndarray]:
        """The outputs at these inputs."""
        for array, value in zip(self._in, values, strict=True):
            array[:] = value
        self._run()
        return [out.copy(order="F") for out in self._out]
