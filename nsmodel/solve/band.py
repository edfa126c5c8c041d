"""A sparse matrix that depends on the step alone, put in an order in which it is a narrow band, and its factors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import scipy.sparse as sp
from scipy.linalg.lapack import dgbtrf, dgbtrs  # pyright: ignore[reportAttributeAccessIssue]
from scipy.sparse.csgraph import breadth_first_order, connected_components, reverse_cuthill_mckee
from scipy.sparse.linalg import LinearOperator, splu

from nsmodel.scheme.problem import OneStepProblem
from nsmodel.solve.rounding import ruiz_scales

MAX_BANDWIDTH = 48  # Diagonals above or below the main one up to which a band is factored.
SINGULAR_PIVOT = 1e-13  # Pivots below this, of entries of about 1, are round-off.
MAX_KEPT_FACTORS = 3  # Index sets whose factors are kept, for each step size.


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
        key = held.tobytes(), shift
        if key not in self._factors:
            if len(self._factors) >= MAX_KEPT_FACTORS:
                self._factors.pop(next(iter(self._factors)))
            self._factors[key] = self._factorise(held, shift)
        return self._factors[key]

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
        factor, Y = self.factor(held, 0.0), self.J[n:]

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

        return LinearOperator((m, m), matvec=scaled(multiply), rmatvec=scaled(multiply_transposed))  # pyright: ignore[reportCallIssue]


def step_jacobian(problem: OneStepProblem, h: float) -> sp.csr_matrix:
    """J at h, where it depends on nothing else."""
    return step_jacobian_function(problem)(h)


def step_jacobian_function(p: OneStepProblem) -> Callable[[float], sp.csr_matrix]:
    """J as a function of h."""
    E_z, E_l, Y_z, Y_l = p.jacobians
    known = ca.vertcat(p.t, p.state, p.z, p.l)
    function = ca.Function("J", [p.h, known], [ca.vertcat(ca.horzcat(E_z, E_l), ca.horzcat(Y_z, Y_l))])

    def jacobian_at(h: float) -> sp.csr_matrix:
        J = function(h, ca.DM.zeros(known.numel())).sparse().tocsr()
        J.eliminate_zeros()
        return J

    return jacobian_at
