"""A step by linear systems in (z, l) as a whole, where W keeps too little: on an index set, or on the sets that follow."""

from __future__ import annotations

import numpy as np

from nsmodel.solve import active_set
from nsmodel.solve.certificate import ROUNDING
from nsmodel.solve.curved import ARMIJO
from nsmodel.solve.dual import nearest_point_of_polyhedron
from nsmodel.solve.linearised import Iterate, Linearisation, LinearisedStep, StepContext
from nsmodel.solve.rounding import UNIT_ROUND_OFF, equilibrate_matrix

MAX_INDEX_SET_CHANGES = 12  # Index sets that are tried on the whole system.
MAX_CUT_LINEARISATIONS = 40  # Linearisations of curved constraints, of all of which the nearest point is found.
REFINEMENTS = 5  # Of an affine step on an index set.
LAST_NEWTON_STEP_SHARE = 1e-6  # Part of the unknowns: the size of a last step of Newton's method.
HALVINGS = 20  # Of a step of Newton's method, at most.
MIN_STEP_FRACTION = 2.0**-HALVINGS  # Its least part.
EARLY = 3  # Iterations up to which Newton's method on an index set goes on where a step brings nothing.
NEWTON_ITERATIONS = 30  # Linearisations in a step.


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
                z[i] = -(offset + sum(at.E_z[i, j] * z[j] for j, _ in needed)) / at.E_z[i, i]
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
            if not (np.isfinite(at.E).all() and np.isfinite(at.E_z).all()):
                return found
            scaled, rows, columns = equilibrate_matrix(at.E_z)
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
            if not (np.isfinite(at.E).all() and np.isfinite(at.Y).all() and np.isfinite(at.Y_z).all()):
                return None
            point = z - at.E if point is None else point
            normals, levels = np.vstack([normals, at.Y_z]), np.concatenate([levels, at.Y_z @ z - at.Y])
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
            unseen = ROUNDING * UNIT_ROUND_OFF * (np.abs(at.Y_z) @ np.abs(z) + np.abs(at.Y_l) @ np.abs(l) + np.abs(at.Y))
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
        J, free = self._index_set_system(at, index)
        size, best, exact = np.linalg.norm(np.concatenate([at.E, at.Y[free]])), None, False
        for iteration in range(1, (REFINEMENTS if self.structure.affine else NEWTON_ITERATIONS) + 1):
            if not np.isfinite(J).all():
                break
            scaled, rows, columns = equilibrate_matrix(J)
            if exact:  # z is so by these rows, as near as doubles come: the others are solved for it
                at.Y[[row for row, *_ in self.structure.unit_rows if index[row] == 0]] = 0.0
            step = columns * active_set.solve_or_least_squares(scaled, -rows * np.concatenate([at.E, at.Y[free]]))
            t_step, old, found, z_new, l_new, at_new = 1.0, size, None, z, l, at
            z = at.z
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
                if size <= (1 - ARMIJO * t_step) * old or t_step in (1.0, MIN_STEP_FRACTION) or self.structure.affine:
                    found = self.evaluate_residual(known, at_new, l_new, index, "newton on the index set", iteration, near)
                    if t_step == 1.0 and found.residual > self.tolerance and not size <= (1 - ARMIJO) * old:
                        found = found if self.structure.affine or old == 0 else None
                t_step /= 2
            z, l, at, stalled = z_new, l_new, at_new, size >= (1 - 2 * ARMIJO * t_step) * old
            best = found if best is None or found.residual <= max(best.residual, self.enough) else best
            if (found.residual <= self.enough and iteration >= least) or (stalled and iteration > EARLY):
                break
            J = self._index_set_system(at, index)[0]
        return best
