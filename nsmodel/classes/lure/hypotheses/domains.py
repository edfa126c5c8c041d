"""The domains of Xi and of Phi as rational cones, read off a law or a convex potential.

For a law, Xi is the indicator of K and Phi(y) the supremum of <-y, l> over K; for a potential, Xi(z) = Phi*(-z). Points of both
relative interiors are written as linear images of columns u that are free, > 0 or inside a second-order cone, homogenised by
tau > 0 and subject to linear rows: k = tau times a point of rint dom Xi, y = tau times a point of rint dom Phi. The relative
interior of an image is the image of the relative interior, and rint dom (f + g)* = rint dom f* + rint dom g*.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np

from nsmodel.modeling.laws import Law, LawFactor
from nsmodel.modeling.laws.base import ExactSet, Intervals, RoundSet, SecondOrder
from nsmodel.proof import conic, exact
from nsmodel.proof.conic import ConicSystem

TAU_COLUMN = [0]  # the column of tau
ColumnPart = tuple[list[int], Any]  # columns and the matrix (., columns) that they are multiplied with


class UndecidedDomain(Exception):
    """A domain that cannot be written with these cones; the message is the reason."""


class EmptyDomain(UndecidedDomain):
    """An empty set."""


@dataclass
class Domains:
    """rint dom Xi and rint dom Phi of m multipliers over a list of columns.

    Attributes:
        k, y: parts whose sums are k and y.
        loose: (m,) whether y_i may take any value whatever the other columns are.
        across: matrices (., m) whose common kernel is (dom Phi - dom Phi)^perp.
        flat: matrices (., m) whose common kernel is the lineality space of the dual of dom Xi_inf.
        kinds, groups, rows: of the columns: "free", "positive" or "cone"; the second-order cones; rows that are 0.
    """

    m: int
    k: list[ColumnPart] = field(default_factory=list)
    y: list[ColumnPart] = field(default_factory=list)
    loose: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    across: list[Any] = field(default_factory=list)
    flat: list[Any] = field(default_factory=list)
    kinds: list[str] = field(default_factory=lambda: ["positive"])
    groups: list[tuple[int, ...]] = field(default_factory=list)
    rows: list[list[ColumnPart]] = field(default_factory=list)

    def add(self, size: int, kind: str) -> list[int]:
        """Return the indices of ``size`` new columns; kind "cone" makes one second-order cone of them."""
        own = list(range(len(self.kinds), len(self.kinds) + size))
        self.kinds += [kind] * size
        if kind == "cone":
            self.groups.append(tuple(own))
        return own

    def between(self, direction: Any, low: Any, width: Any) -> None:
        """Add s direction to k, low < s < low + width."""
        above, below = self.add(1, "positive"), self.add(1, "positive")
        self.rows.append([(above, [[1.0]]), (below, [[1.0]]), (TAU_COLUMN, [[-Fraction(width)]])])
        column = exact.rational(direction).reshape(-1, 1)
        self.k += [(TAU_COLUMN, Fraction(low) * column), (above, column)]

    def system(self, equation: list[ColumnPart], more: int = 0) -> ConicSystem:
        """The rows of ``equation`` whose y is not loose, and all rows between columns; ``more`` free columns at the end."""
        n = len(self.kinds) + more
        keep = np.flatnonzero(~self.loose)
        blocks = [_assemble_rows([(own, exact.rational(M)[keep]) for own, M in equation], len(keep), n)]
        blocks += [_assemble_rows(parts, len(parts[0][1]), n) for parts in self.rows]
        positive = tuple(j for j, kind in enumerate(self.kinds) if kind == "positive")
        return ConicSystem(np.vstack(blocks), positive, tuple(self.groups))

    def stack_matrices(self, parts: list[Any]) -> np.ndarray:
        """Matrices (., m) as one."""
        return np.vstack([exact.zeros(0, self.m), *(exact.rational(part) for part in parts)])


def _assemble_rows(parts: list[ColumnPart], rows: int, columns: int) -> np.ndarray:
    A = exact.zeros(rows, columns)
    for own, matrix in parts:
        A[:, own] = A[:, own] + exact.rational(matrix)
    return A


def domains_of_law(law: Law, D: np.ndarray, changed: Callable[[ExactSet], ExactSet] = lambda shape: shape) -> Domains:
    """The domains for -y ∈ N_K(l): dom Xi = K, rint dom Phi = rint K_inf*.

    ``changed`` makes other sets of its blocks. l_i of boxes and balls is left out where it meets no row of D'l whose y is not
    loose: its interval is not empty.

    Raises:
        Empty: K is empty.
        Undecided: a block has no exact shape.
    """
    shapes = [changed(_exact_shape(block)) for block in law.blocks]
    found = Domains(law.size, loose=_unrestricted_flags(law, shapes))
    seen = (D[:, ~found.loose] != 0).any(axis=1)
    for (rows, block), shape in zip(law.parts(), shapes, strict=True):
        unit = np.eye(law.size)[:, rows]
        if isinstance(shape, Intervals):
            for i, low, up in zip(range(rows.start, rows.stop), *shape, strict=True):
                _add_interval_block(found, np.eye(law.size)[:, [i]], low, up, bool(seen[i]))
        elif isinstance(shape, RoundSet):
            _add_ball_block(found, unit, shape, bool(seen[rows].any()), block.label)
        elif isinstance(shape, SecondOrder):
            found.k.append((found.add(block.size, "cone"), unit))
            found.y.append((found.add(block.size, "cone"), unit))
            found.across.append(unit.T)
            found.flat.append(unit.T)
        else:
            _add_polyhedron_block(found, unit, shape.H, shape.K)
    return found


def _exact_shape(block: LawFactor) -> ExactSet:
    shape = block.shape()
    if shape is None:
        raise UndecidedDomain(f"the set of '{block.label}' has no exact form")
    return shape


def unrestricted_outputs(law: Law) -> np.ndarray:
    """(m,) whether l_i is bounded by its own box or ball, so that y_i may take any value."""
    return _unrestricted_flags(law, [_exact_shape(block) for block in law.blocks])


def _unrestricted_flags(law: Law, shapes: Sequence[ExactSet]) -> np.ndarray:
    flags = [
        np.isfinite(shape).all(axis=0) if isinstance(shape, Intervals) else np.full(block.size, isinstance(shape, RoundSet))
        for block, shape in zip(law.blocks, shapes, strict=True)
    ]
    return np.concatenate([np.zeros(0, bool), *flags])


def _add_interval_block(found: Domains, unit: np.ndarray, low: float, up: float, seen: bool) -> None:
    """low <= l_i <= up; K_inf* is R, a half-line or {0}."""
    if np.isinf(low) and np.isinf(up):
        found.flat.append(unit.T)
        if seen:
            found.k.append((found.add(1, "free"), unit))
        return
    found.across.append(unit.T)
    if np.isfinite(low) and np.isfinite(up):
        if seen and low < up:
            found.between(unit, low, Fraction(up) - Fraction(low))
        elif seen:
            found.k.append((TAU_COLUMN, low * unit))
        return
    sign, end = (1, low) if np.isfinite(low) else (-1, up)
    found.flat.append(unit.T)
    found.y.append((found.add(1, "positive"), sign * unit))
    if seen:
        found.k += [(TAU_COLUMN, end * unit), (found.add(1, "positive"), sign * unit)]


def _add_ball_block(found: Domains, unit: np.ndarray, shape: RoundSet, seen: bool, label: str) -> None:
    found.across.append(unit.T)
    if shape.radius and seen:
        if shape.A is None:
            raise UndecidedDomain(f"the set of '{label}' is no linear image of a ball in fractions")
        own = found.add(unit.shape[1] + 1, "cone")
        found.rows.append([(own[:1], [[1]]), (TAU_COLUMN, [[-shape.radius]])])
        found.k.append((own[1:], exact.matrix_product(exact.rational(unit), exact.rational(shape.A))))


def _add_polyhedron_block(found: Domains, unit: np.ndarray, H: np.ndarray, K: np.ndarray) -> None:
    """{l : H l >= K}: slacks > 0 but for the rows that are equalities on all of the set; K_inf* = H' R+^r."""
    own = found.add(H.shape[1], "free")
    add_slack_rows(found, own, H, K)
    found.k.append((own, unit))
    found.y.append((found.add(len(K), "positive"), unit @ H.T))
    found.across.append(H @ unit.T)
    receding = exact.nullspace(H[implicit_equalities(H, np.zeros(len(K)))])
    found.flat.append(exact.matrix_product(receding.T, unit.T))


def add_slack_rows(found: Domains, own: list[int], H: np.ndarray, K: np.ndarray) -> list[int]:
    """Rows H u >= tau K, strict where they can be; returns the indices of those that are equalities on all of the set."""
    implied = implicit_equalities(H, K)
    strict = [i for i in range(len(K)) if i not in implied]
    for rows in (implied, strict):
        if rows:
            parts = [(own, H[rows]), (TAU_COLUMN, -K[rows].reshape(-1, 1))]
            found.rows.append(parts if rows is implied else [*parts, (found.add(len(rows), "positive"), -np.eye(len(rows)))])
    return implied


def slack_system(H: np.ndarray, K: np.ndarray) -> ConicSystem:
    """H l - tau K - s = 0 with tau, s > 0: solvable if and only if some l has H l > K. Columns tau, l, s."""
    r, n = H.shape
    A = np.hstack([exact.rational(-K.reshape(-1, 1)), exact.rational(H), exact.rational(-np.eye(r))])
    return ConicSystem(A, (0, *range(1 + n, 1 + n + r)))


def implicit_equalities(H: np.ndarray, K: np.ndarray) -> list[int]:
    """Rows of H l >= K that are equalities on all of the set.

    Raises:
        Empty: no l has H l >= K.
    """
    zero = conic.implied_zeros(slack_system(H, K)) if len(K) else []
    if 0 in zero:
        raise EmptyDomain("it is empty: its conditions contradict each other")
    return [j - 1 - H.shape[1] for j in zero]
