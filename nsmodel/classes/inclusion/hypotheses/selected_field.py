"""The velocities G(x) = F(x) - S(x) of an inclusion, taken apart: what is monotone by its form, and what is left.

    G(x) = rest(x, l_o) + sum_j B_j l_j,   -u_j(x) ∈ N_{K_j}(l_j)

A multiplier l_j is *aligned* where u_j = J_j x + c_j is affine and B_j = beta_j J_j' with beta_j >= 0, all constant: then
-B_j l_j is the subdifferential of a convex function, and its share of <G(x) - G(y), x - y> is never positive. Others stay in
l_o. Multipliers that cannot switch on C are put in.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import casadi as ca
import numpy as np

from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.inclusion.set_valued import set_constraints, velocity_selection
from nsmodel.proof import exact, interval_bounds, polynomial
from nsmodel.proof.convex.sets import ConvexSet
from nsmodel.solvers.residuals import numeric_law


@dataclass(frozen=True)
class AlignedMultiplier:
    """B l with B = beta J', u = J x + c: a box lower <= l <= upper (one row), or a ball |l| <= upper (J with several rows).

    ``B`` is (n, m), ``c`` (m,), doubles.
    """

    B: np.ndarray
    c: np.ndarray
    beta: float
    lower: float
    upper: float
    text: str

    @property
    def size(self) -> float:
        """The largest |B l|."""
        return float(np.linalg.norm(self.B, 2)) * max(abs(self.lower), abs(self.upper))

    @property
    def nearest(self) -> float:
        """The element of [lower, upper] nearest to 0."""
        return float(np.clip(0.0, self.lower, self.upper))

    @property
    def offset(self) -> float:
        """The largest -beta c'(l - nearest): <x, B (l - nearest)> = beta (u - c)'(l - nearest), and u'(l - nearest) <= 0."""
        if self.B.shape[1] > 1:
            return self.beta * float(np.linalg.norm(self.c)) * self.upper
        return self.beta * max(-self.c[0] * (end - self.nearest) for end in (self.lower, self.upper))


@dataclass(frozen=True)
class FreeMultiplier:
    """A multiplier that is not aligned: its symbol, u, ends, the direction B (n, 1) in which G jumps."""

    l: ca.SX
    u: ca.SX
    lower: float
    upper: float
    B: ca.SX


@dataclass(frozen=True)
class SelectedField:
    """G on C.

    Attributes:
        x: symbols (n, 1); C: the set.
        G: expression of x and l; l, u: all multipliers and what they switch at; lower, upper: ends of l (balls: -r, r).
        rest: G without the aligned terms' share, an expression of x and the l of ``jumps``.
        aligned, jumps: the multipliers.
    """

    x: ca.SX
    C: ConvexSet
    G: ca.SX
    l: ca.SX
    u: ca.SX
    lower: np.ndarray
    upper: np.ndarray
    rest: ca.SX
    aligned: tuple[AlignedMultiplier, ...]
    jumps: tuple[FreeMultiplier, ...]

    @property
    def variables(self) -> tuple[ca.SX, np.ndarray, np.ndarray]:
        """(x, l of the jumps) and its box on the hull of C."""
        low, high = self.C.bounding_box
        z = ca.vertcat(self.x, *(jump.l for jump in self.jumps))
        ends = np.array([[jump.lower, jump.upper] for jump in self.jumps]).reshape(-1, 2)
        return z, np.concatenate([low, ends[:, 0]]), np.concatenate([high, ends[:, 1]])

    @property
    def shift(self) -> np.ndarray:
        """The sum of B times the nearest element to 0: the constant share of the aligned terms (n,)."""
        total = np.zeros(self.x.numel())
        for term in self.aligned:
            if term.B.shape[1] == 1:
                total += term.B[:, 0] * term.nearest
        return total


def constraint_set(model: MonotoneInclusion) -> ConvexSet:
    """C, the bounds first."""
    rows, names = set_constraints(model)
    return ConvexSet(model.x, rows, names)


def decompose_field(model: MonotoneInclusion, C: ConvexSet) -> SelectedField:
    """Take G = F - S apart."""
    chosen, law = velocity_selection(model), numeric_law(velocity_selection(model).law)
    G, l, u = chosen.velocity, chosen.l, chosen.u
    lower, upper = np.array(law.lower, float), np.array(law.upper, float)
    balls = {rows.start: (rows, K.radius) for rows, K in law.curved}
    for rows, radius in balls.values():
        lower[rows], upper[rows] = -radius, radius
    G, fixed = _fix_multipliers(G, l, u, lower, upper, C, {i for rows, _ in balls.values() for i in range(rows.start, rows.stop)})
    aligned: list[AlignedMultiplier] = []
    jumps: list[FreeMultiplier] = []
    slopes = ca.jacobian(G, l)
    i, zero = 0, []
    while i < l.numel():
        rows = balls[i][0] if i in balls else slice(i, i + 1)
        i = rows.stop
        if set(range(rows.start, rows.stop)) <= fixed:
            continue
        text = " ,".join(str(entry) for entry in ca.vertsplit(u[rows]))
        term = _align_multiplier(slopes[:, rows], u[rows], C.x, lower[rows.start], upper[rows.start], text)
        if term is None:
            jumps += [FreeMultiplier(l[k], u[k], lower[k], upper[k], slopes[:, k]) for k in range(rows.start, rows.stop)]
        else:
            aligned.append(term)
            zero += list(range(rows.start, rows.stop))
    rest = ca.substitute(G, l[zero], ca.SX.zeros(len(zero))) if zero else G
    return SelectedField(C.x, C, G, l, u, lower, upper, rest, tuple(aligned), tuple(jumps))


def _fix_multipliers(
    G: ca.SX, l: ca.SX, u: ca.SX, lower: np.ndarray, upper: np.ndarray, C: ConvexSet, curved: set[int]
) -> tuple[ca.SX, set[int]]:
    """Put in the multipliers whose u has one sign on the hull of C."""
    fixed: set[int] = set()
    if not l.numel():
        return G, fixed
    low, high = (np.asarray(end).ravel() for end in interval_bounds.enclose(u, C.x, *C.bounding_box))
    for k in range(l.numel()):
        if k not in curved and (low[k] > 0 or high[k] < 0):
            G = ca.substitute(G, l[k], lower[k] if low[k] > 0 else upper[k])
            fixed.add(k)
    return G, fixed


def _align_multiplier(B: ca.SX, u: ca.SX, x: ca.SX, lower: float, upper: float, text: str) -> AlignedMultiplier | None:
    """The term where u = J x + c and B = beta J', beta >= 0, all exactly constant; else None."""
    n, m = B.shape
    if not np.isfinite([lower, upper]).all():
        return None
    rows = [
        polynomial.as_quadratic(p, n) if p is not None and polynomial.degree(p) <= 1 else None
        for p in polynomial.read_polynomials(u, x)
    ]
    entries = polynomial.read_polynomials(B, x)
    if any(row is None for row in rows) or any(p is None or not polynomial.is_constant(p) for p in entries):
        return None
    kept = [row for row in rows if row is not None]
    J = np.hstack([row.q for row in kept]).T
    numbers = [p.get((), Fraction(0)) if p is not None else Fraction(0) for p in entries]
    matrix = exact.rational(np.array(numbers, dtype=object).reshape(m, n)).T
    where = np.argwhere(J.astype(bool))
    if not len(where):
        return None
    i, j = where[0]
    beta = matrix[j, i] / J[i, j]
    if beta < 0 or (matrix != beta * J.T).any():
        return None
    c = np.array([float(row.c) for row in kept])
    return AlignedMultiplier(exact.doubles(matrix), c, float(beta), float(lower), float(upper), text)
