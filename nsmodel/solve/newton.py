"""The general step: Newton's linearisation in (z, l), an affine problem in l for each iterate, until all residuals vanish.

At (z, l): E_z dz + E_l dl + E = 0 gives dz = dz_0 + Z dl with dz_0 = -E_z^{-1} E, Z = -E_z^{-1} E_l, and
y+ = W l+ + b with W = Y_l + Y_z Z, b = Y + Y_z dz_0 - W l. For theta-gamma stepping these are the W_mlcp, x_free, x_p, b of
`scheme.theta_gamma`. An affine problem takes one iteration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.scheme.problem import OneStepProblem
from nsmodel.solve import active_set, mlcp
from nsmodel.solve.certificate import EPS, UNRESOLVED, NumericLaw, law_residual, output_scale
from nsmodel.solve.layout import extras
from nsmodel.solve.structure import Structure, least_eigenvalue

ITERATIONS = 30
HIDDEN = 1e-3  # Part of its terms that round-off may hide of E at most, where E_z is singular to rounding.
WORKING_SET_ABOVE = 24
SHARED_BELOW = 5000  # Inputs up to which looking for common subexpressions pays for the time it takes.
UNKNOWN = object()  # Not computed yet.


def works_on_rows(structure: Structure, law: NumericLaw) -> bool:
    """Whether only the complementarity rows that act enter the affine problem."""
    return law.is_complementarity and structure.symmetric and law.size > WORKING_SET_ABOVE


@dataclass
class Linearisation:
    """E, Y and their Jacobians at one (z, l)."""

    E: np.ndarray
    Y: np.ndarray
    E_z: np.ndarray
    E_l: np.ndarray
    Y_z: np.ndarray
    Y_l: np.ndarray
    eliminated: Any = UNKNOWN

    def offset(self, dz_0: np.ndarray, Z: np.ndarray, l: np.ndarray) -> np.ndarray:
        """The b of y+ = W l+ + b, from the iterate l."""
        return self.Y + self.Y_z @ (dz_0 - Z @ l) - self.Y_l @ l


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


class Newton:
    """Newton's method for one problem; ``solve`` gives the best iterate that a chain of solvers reaches."""

    def __init__(self, problem: OneStepProblem, structure: Structure, law: NumericLaw, tolerance: float) -> None:
        self.problem, self.structure, self.law, self.tolerance = problem, structure, law, tolerance
        p = problem
        known = [p.t, p.h, p.state]
        parts = [p.E, p.Y, *p.jacobians]
        self._linearise = Buffered("linearise", [*known, p.z, p.l], parts, matrices=4)
        guess_0 = ca.substitute([p.guess], [p.l], [ca.SX.zeros(p.l.shape)])[0] if p.l.numel() else p.guess
        E_guess = ca.substitute([p.E], [p.z, p.l], [guess_0, ca.SX.zeros(p.l.shape)])[0] if p.z.numel() else p.E
        unit = [row for row, *_ in structure.unit_rows]
        at_zero = ca.substitute([p.Y], [p.z, p.l], [ca.SX.zeros(p.z.shape), ca.SX.zeros(p.l.shape)])[0] if unit else p.Y
        self._offset = Buffered("offset", known, [at_zero[unit] if unit else ca.SX(0, 1)])
        self._offsets = np.zeros(len(unit))
        self._guess = Buffered("guess", [*known, p.l], [p.guess, guess_0, E_guess])
        self._pack = Buffered("pack", [*known, p.z, p.l, p.y], [p.next_state, *extras(p).values()])
        self.least_eigenvalue = np.inf  # of the W + W' met so far: a monitor, no step depends on it
        self._complementarity = law.is_complementarity
        self._felt: Buffered | None = None
        self._by_rows = works_on_rows(structure, law)

    def linearise(self, t: float, h: float, state: np.ndarray, z: np.ndarray, l: np.ndarray) -> Linearisation:
        """Evaluate E, Y and the exact Jacobians."""
        return Linearisation(*self._linearise(t, h, state, z, l))

    def guess(self, t: float, h: float, state: np.ndarray, l: np.ndarray) -> np.ndarray:
        """The first z."""
        return self._guess(t, h, state, l)[0]

    def matrix_at(self, t: float, h: float, state: np.ndarray, z: np.ndarray, l: np.ndarray) -> np.ndarray | None:
        """W linearised at (z, l); None where it is singular or not finite."""
        at = self.linearise(t, h, state, z, l)
        eliminated = self._eliminate(at)
        W = None if eliminated is None else at.Y_l + at.Y_z @ eliminated[1]
        return W if W is not None and np.isfinite(W).all() else None

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
        z, guess_0, E_guess = self._guess(t, h, state, l)
        guess = (guess_0, np.abs(E_guess))
        best, self._offsets = None, self._offset(t, h, state)[0]
        at = self.linearise(t, h, state, z, l)
        for iteration in range(1, ITERATIONS + 1):
            moved = self._advance(at, z, l, index, chain)
            if moved is None:
                break
            z, l, index, solver = moved
            at = self.linearise(t, h, state, z, l)
            found = self.judge(at, z, l, index, guess, solver, iteration)
            if best is not None and found.residual <= self.tolerance and found.residual > best.residual / 10:
                return min(found, best, key=lambda i: i.residual)
            best = found if best is None or found.residual < best.residual else best
            if found.residual <= 1e-2 * self.tolerance or (self.structure.affine and found.residual <= self.tolerance):
                return found
            if not np.isfinite(found.residual) and not (np.isfinite(z).all() and np.isfinite(l).all()):
                break
        if best is None:
            return Iterate(z, l, index, np.full(l.size, np.nan), np.inf, None, "none", 0)
        return self._with_state(best, t, h, state, guess)

    def _advance(
        self, at: Linearisation, z: np.ndarray, l: np.ndarray, index: np.ndarray, chain: Sequence[str]
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
            found = self._solve_rows(at, Z, b, l, index, chain)
            if not np.isfinite(found.l).all():
                return None
            l_next, index, solver = found.l, found.index, found.solver
        z_next = z + dz_0 + Z @ (l_next - l)
        self._make_exact(z_next, index)
        return z_next, l_next, index, solver

    def _make_exact(self, z: np.ndarray, index: np.ndarray) -> None:
        """Put z_j where y_i = factor z_j + c is exactly 0, for the rows coded 0, and z = 0 at rest: stick is exactly 0."""
        for (row, column, factor), offset in zip(self.structure.unit_rows, self._offsets, strict=True):
            if index[row] == 0:
                z[column] = -offset / factor
        rest = self.structure.rest_rows
        if rest and not index[list(rest)].any():
            z[:] = 0.0

    def _eliminate(self, at: Linearisation) -> tuple[np.ndarray, np.ndarray] | None:
        """dz_0 = -E_z^{-1} E and Z = -E_z^{-1} E_l, computed once; None where E_z is singular or not finite."""
        if at.eliminated is UNKNOWN:
            at.eliminated = self._eliminated(at)
        return at.eliminated

    def _eliminated(self, at: Linearisation) -> tuple[np.ndarray, np.ndarray] | None:
        if not (np.isfinite(at.E).all() and np.isfinite(at.E_z).all() and np.isfinite(at.E_l).all()):
            return None
        if self.structure.identity:
            return -at.E, -at.E_l
        try:
            both = np.linalg.solve(at.E_z, np.column_stack([at.E, at.E_l]))
        except np.linalg.LinAlgError:
            return None
        return -both[:, 0], -both[:, 1:]

    def _solve_rows(
        self, at: Linearisation, Z: np.ndarray, b: np.ndarray, l: np.ndarray, index: np.ndarray, chain: Sequence[str]
    ) -> mlcp.Solution:
        """Solve the affine problem; of many complementarity rows only those that act (violated ones are added until none is)."""
        if not self._by_rows:
            W = at.Y_l + at.Y_z @ Z
            if l.size <= WORKING_SET_ABOVE and not self.structure.gram:
                self.least_eigenvalue = min(self.least_eigenvalue, least_eigenvalue(W))
            return mlcp.solve(W, b, self.law, l, index, chain, self.structure.symmetric, self.tolerance / 10)
        chosen = (b < 0) | (index == 0)
        for _ in range(l.size + 1):
            rows = np.flatnonzero(chosen)
            law = NumericLaw(self.law.lower[rows], self.law.upper[rows], ())
            W = at.Y_z[rows] @ Z[:, rows] + at.Y_l[np.ix_(rows, rows)]
            part = mlcp.solve(W, b[rows], law, l[rows], index[rows], chain, True, self.tolerance / 10)
            if not np.isfinite(part.l).all():
                return mlcp.Solution(np.full(l.size, np.nan), index, np.inf, part.solver)
            full, code = np.zeros(l.size), np.full(l.size, -1, np.int8)
            full[rows], code[rows] = part.l, part.index
            y = b + at.Y_z @ (Z[:, rows] @ part.l) + at.Y_l[:, rows] @ part.l
            scale = np.abs(b) + np.abs(at.Y_z) @ np.abs(Z[:, rows] @ part.l)
            violated = (y < -4 * (Z.shape[0] + 4) * EPS * scale) & ~chosen
            if not violated.any():
                return mlcp.Solution(full, code, part.residual, part.solver if rows.size else "none needed")
            chosen |= violated
        raise AssertionError("unreachable: every pass adds a row")  # pragma: no cover

    def _with_state(
        self, found: Iterate, t: float, h: float, state: np.ndarray, guess: tuple[np.ndarray, np.ndarray]
    ) -> Iterate:  # fmt: skip
        """An iterate that fails, judged once more with the round-off of the state: |E_k| |k| and |Y_k| |k|, k the state."""
        if not self.tolerance < found.residual < np.inf:
            return found
        if self._felt is None:
            p = self.problem
            felt = [ca.fabs(ca.jacobian(e, p.state)) @ ca.fabs(p.state) for e in (p.E, p.Y)]
            self._felt = Buffered("felt", [p.t, p.h, p.state, p.z, p.l], felt)
        z, l = found.z, found.l
        at, felt = self.linearise(t, h, state, z, l), self._felt(t, h, state, z, l)
        again = self.judge(at, z, l, found.index, guess, found.solver, found.iterations, *felt)
        return again if again.residual <= self.tolerance else found

    def judge(
        self, at: Linearisation, z: np.ndarray, l: np.ndarray, index: np.ndarray, guess: tuple[np.ndarray, np.ndarray],
        solver: str, iterations: int, felt_E: np.ndarray | float = 0.0, felt_Y: np.ndarray | float = 0.0,
    ) -> Iterate:  # fmt: skip
        """The certificate at (z, l): E against what moves in the step, and the law at the model's own y.

        ``felt_E``, ``felt_Y``: the round-off of the state in E and Y, in EPS, where it is looked at.
        """
        n, m = z.size, l.size
        if not all(np.isfinite(part).all() for part in (z, l, at.E, at.Y, at.E_z, at.E_l, at.Y_z, at.Y_l)):
            return Iterate(z, l, index, at.Y, np.inf, None, solver, iterations)
        round_off = 4 * (n + m + 4) * EPS
        abs_z, abs_l = np.abs(z), np.abs(l)
        E_z, E_l = np.abs(at.E_z), np.abs(at.E_l)
        E_0 = at.E - at.E_z @ z - at.E_l @ l
        size_E = E_z @ abs_z + E_l @ abs_l + np.abs(E_0) + felt_E
        if not self.structure.identity and n:
            size_E = np.minimum(self._seen(at.E_z, size_E), HIDDEN / round_off * size_E)
        dz = z - guess[0]
        # E where nothing moves counts no more than the linearisation at the answer makes of it: far away, it may be anything.
        unmoved = np.minimum(guess[1], np.abs(at.E - at.E_z @ dz - at.E_l @ l))
        s_E = unmoved + E_z @ np.abs(dz) + E_l @ abs_l
        s_E = np.maximum(np.maximum(s_E, round_off / self.tolerance * size_E), UNRESOLVED)
        with np.errstate(divide="ignore", invalid="ignore"):
            dynamics = np.where(at.E == 0, 0, np.abs(at.E) / s_E).max(initial=0.0)
        sized = np.isfinite(dynamics) and np.isfinite(s_E).all()  # an infinite scale excuses nothing
        worst, row = float(dynamics) if sized else np.inf, None
        y = at.Y
        if m:
            s_y, w_max, floor = self._law_scales(at, z, l, index, round_off / self.tolerance)
            floor = floor + round_off / self.tolerance * felt_Y
            residual = law_residual(self.law, l, at.Y, s_y, w_max, floor)
            if residual.max() >= worst or not np.isfinite(residual).all():
                row = int(np.argmax(np.where(np.isnan(residual), np.inf, residual)))
                worst = float(residual[row])
            if self.structure.projection:
                worst = max(worst, self._gap(at, z, l, dz, guess[1], round_off))
            y = np.where(index == 0, 0.0, at.Y)
        return Iterate(z, l, index, y, worst, row, solver, iterations)

    @staticmethod
    def _gap(
        at: Linearisation, z: np.ndarray, l: np.ndarray, dz: np.ndarray, unmoved: np.ndarray, round_off: float
    ) -> float:  # fmt: skip
        """<l, y>, which bounds the square of the distance to the projection, beside the square of what moves; 0 if rounding."""
        gap = float(np.maximum(l, 0) @ np.maximum(at.Y, 0))
        size = np.abs(at.Y_z) @ np.abs(z) + np.abs(at.Y - at.Y_z @ z)
        return gap / max(float(dz @ dz + unmoved @ unmoved), UNRESOLVED) if gap > round_off * (np.abs(l) @ size) else 0.0

    @staticmethod
    def _seen(E_z: np.ndarray, size: np.ndarray) -> np.ndarray:
        """The round-off of z, which is that of E through E_z^{-1}, as E sees it: |E_z| |E_z^{-1}| size."""
        try:
            return np.abs(E_z) @ (np.abs(np.linalg.inv(E_z)) @ size)
        except np.linalg.LinAlgError:
            return size

    def _law_scales(
        self, at: Linearisation, z: np.ndarray, l: np.ndarray, index: np.ndarray, round_off: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """s_y, max_j |W_ij| and the floor of s_y, computed for the columns with l != 0 and the rows that act."""
        eliminated = self._eliminate(at)
        Z = np.zeros((z.size, l.size)) if eliminated is None else eliminated[1]
        columns = np.flatnonzero(l)
        W_active = at.Y_l[:, columns] + at.Y_z @ Z[:, columns]
        b = at.Y - W_active @ l[columns]
        rows = np.flatnonzero((l != self.law.lower) | (index == 0)) if self._complementarity else np.arange(l.size)
        w_max = np.ones(l.size)
        w_max[rows] = np.abs(at.Y_l[rows] + at.Y_z[rows] @ Z).max(axis=1, initial=0.0)
        s_y = output_scale(b, np.abs(W_active) @ np.abs(l[columns]), w_max)
        Y_0 = at.Y - at.Y_z @ z - at.Y_l @ l
        floor = round_off * (np.abs(at.Y_z) @ np.abs(z) + np.abs(at.Y_l) @ np.abs(l) + np.abs(Y_0))
        return s_y, w_max, floor

    def on_index_set(
        self, t: float, h: float, state: np.ndarray, z: np.ndarray, l: np.ndarray, index: np.ndarray
    ) -> Iterate | None:
        """Damped Newton for the smooth system E = 0, Y_i = 0 (code 0), l_i at its bound (code +-1), from (z, l)."""
        _, guess_0, E_guess = self._guess(t, h, state, l)
        guess = (guess_0, np.abs(E_guess))
        l = np.where(index < 0, self.law.lower, np.where(index > 0, self.law.upper, l))
        if not np.isfinite(l).all():
            return None
        free, n, self._offsets = np.flatnonzero(index == 0), z.size, self._offset(t, h, state)[0]
        at = self.linearise(t, h, state, z, l)
        size, found = np.linalg.norm(np.concatenate([at.E, at.Y[free]])), None
        for iteration in range(1, ITERATIONS + 1):
            J = np.block([[at.E_z, at.E_l[:, free]], [at.Y_z[free], at.Y_l[np.ix_(free, free)]]])
            if not np.isfinite(J).all():
                return None
            step = active_set.solve_or_least_squares(J, -np.concatenate([at.E, at.Y[free]])) if J.size else np.zeros(0)
            t_step = 1.0
            while True:
                z_new, l_new = z + t_step * step[:n], l.copy()
                l_new[free] += t_step * step[n:]
                if t_step == 1.0:
                    self._make_exact(z_new, index)
                at_new = self.linearise(t, h, state, z_new, l_new)
                new = np.linalg.norm(np.concatenate([at_new.E, at_new.Y[free]]))
                if new <= (1 - 1e-4 * t_step) * size or t_step < 1e-6 or size == 0:
                    break
                t_step /= 2
            z, l, at, stalled, size = z_new, l_new, at_new, new >= (1 - 1e-4 * t_step) * size, new
            found = self.judge(at, z, l, index, guess, "newton on the index set", iteration)
            if found.residual <= 1e-2 * self.tolerance or (stalled and iteration > 3):
                break
        return None if found is None else self._with_state(found, t, h, state, guess)

    def pack(self, t: float, h: float, state: np.ndarray, found: Iterate) -> np.ndarray:
        """The packed row of an iterate."""
        parts = self._pack(t, h, state, found.z, found.l, found.y)
        return np.concatenate([parts[0], found.l, found.y, [found.residual, found.iterations], *parts[1:]]) + 0.0


class Buffered:
    """A CasADi function called through buffer(): columns come back as fresh 1-D arrays, the last ``matrices`` outputs as 2-D."""

    def __init__(self, name: str, inputs: list[ca.SX], outputs: list[ca.SX], matrices: int = 0) -> None:
        shared = sum(e.numel() for e in inputs) < SHARED_BELOW
        function = ca.Function(name, inputs, [ca.densify(e) for e in outputs], {"cse": shared})
        self._in = [np.zeros(e.numel()) for e in inputs]
        columns = len(outputs) - matrices
        self._out = [np.zeros(e.numel() if i < columns else e.shape, order="F") for i, e in enumerate(outputs)]
        self._buffer, self._run = function.buffer()
        for i, array in enumerate(self._in):
            self._buffer.set_arg(i, memoryview(array))
        for i, array in enumerate(self._out):
            self._buffer.set_res(i, memoryview(array.reshape(-1, order="F")))

    def __call__(self, *values: float | np.ndarray) -> list[np.ndarray]:
        """The outputs at these inputs."""
        for array, value in zip(self._in, values, strict=True):
            array[:] = value
        self._run()
        return [out.copy(order="F") for out in self._out]
