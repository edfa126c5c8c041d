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
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.domain import domain_rows, without_domain
from nsmodel.laws import Block, Law
from nsmodel.laws.block import Intervals, Round, SecondOrder, Shape
from nsmodel.model.convex import ConvexSplit, Term
from nsmodel.model.expressions import evaluate, points
from nsmodel.proof import exact, feasibility, interval, polynomial
from nsmodel.proof.convex import convexity
from nsmodel.proof.feasibility import System

BOUNDS = ("indicator", "equality", "cone")  # terms of a potential that bound its domain
TAU = [0]  # the column of tau
Part = tuple[list[int], Any]  # columns and the matrix (., columns) that they are multiplied with


class Undecided(Exception):
    """A domain that cannot be written with these cones; the message is the reason."""


class Empty(Undecided):
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
    k: list[Part] = field(default_factory=list)
    y: list[Part] = field(default_factory=list)
    loose: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    across: list[Any] = field(default_factory=list)
    flat: list[Any] = field(default_factory=list)
    kinds: list[str] = field(default_factory=lambda: ["positive"])
    groups: list[tuple[int, ...]] = field(default_factory=list)
    rows: list[list[Part]] = field(default_factory=list)

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
        self.rows.append([(above, [[1.0]]), (below, [[1.0]]), (TAU, [[-Fraction(width)]])])
        column = exact.rational(direction).reshape(-1, 1)
        self.k += [(TAU, Fraction(low) * column), (above, column)]

    def system(self, equation: list[Part], more: int = 0) -> System:
        """The rows of ``equation`` whose y is not loose, and all rows between columns; ``more`` free columns at the end."""
        n = len(self.kinds) + more
        keep = np.flatnonzero(~self.loose)
        blocks = [_assembled([(own, exact.rational(M)[keep]) for own, M in equation], len(keep), n)]
        blocks += [_assembled(parts, len(parts[0][1]), n) for parts in self.rows]
        positive = tuple(j for j, kind in enumerate(self.kinds) if kind == "positive")
        return System(np.vstack(blocks), positive, tuple(self.groups))

    def stacked(self, parts: list[Any]) -> np.ndarray:
        """Matrices (., m) as one."""
        return np.vstack([exact.zeros(0, self.m), *(exact.rational(part) for part in parts)])


def _assembled(parts: list[Part], rows: int, columns: int) -> np.ndarray:
    A = exact.zeros(rows, columns)
    for own, matrix in parts:
        A[:, own] = A[:, own] + exact.rational(matrix)
    return A


# -- laws -----------------------------------------------------------------------------------------------------------------


def of_law(law: Law, D: np.ndarray, changed: Callable[[Shape], Shape] = lambda shape: shape) -> Domains:
    """The domains for -y ∈ N_K(l): dom Xi = K, rint dom Phi = rint K_inf*.

    ``changed`` makes other sets of its blocks. l_i of boxes and balls is left out where it meets no row of D'l whose y is not
    loose: its interval is not empty.

    Raises:
        Empty: K is empty.
        Undecided: a block has no exact shape.
    """
    shapes = [changed(_shape(block)) for block in law.blocks]
    found = Domains(law.size, loose=_loose(law, shapes))
    seen = (D[:, ~found.loose] != 0).any(axis=1)
    for (rows, block), shape in zip(law.parts(), shapes, strict=True):
        unit = np.eye(law.size)[:, rows]
        if isinstance(shape, Intervals):
            for i, low, up in zip(range(rows.start, rows.stop), *shape, strict=True):
                _interval(found, np.eye(law.size)[:, [i]], low, up, bool(seen[i]))
        elif isinstance(shape, Round):
            _round(found, unit, shape, bool(seen[rows].any()), block.label)
        elif isinstance(shape, SecondOrder):
            found.k.append((found.add(block.size, "cone"), unit))
            found.y.append((found.add(block.size, "cone"), unit))
            found.across.append(unit.T)
            found.flat.append(unit.T)
        else:
            _polyhedron(found, unit, shape.H, shape.K)
    return found


def _shape(block: Block) -> Shape:
    shape = block.shape()
    if shape is None:
        raise Undecided(f"the set of '{block.label}' has no exact form")
    return shape


def loose(law: Law) -> np.ndarray:
    """(m,) whether l_i is bounded by its own box or ball, so that y_i may take any value."""
    return _loose(law, [_shape(block) for block in law.blocks])


def _loose(law: Law, shapes: Sequence[Shape]) -> np.ndarray:
    flags = [
        np.isfinite(shape).all(axis=0) if isinstance(shape, Intervals) else np.full(block.size, isinstance(shape, Round))
        for block, shape in zip(law.blocks, shapes, strict=True)
    ]
    return np.concatenate([np.zeros(0, bool), *flags])


def _interval(found: Domains, unit: np.ndarray, low: float, up: float, seen: bool) -> None:
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
            found.k.append((TAU, low * unit))
        return
    sign, end = (1, low) if np.isfinite(low) else (-1, up)
    found.flat.append(unit.T)
    found.y.append((found.add(1, "positive"), sign * unit))
    if seen:
        found.k += [(TAU, end * unit), (found.add(1, "positive"), sign * unit)]


def _round(found: Domains, unit: np.ndarray, shape: Round, seen: bool, label: str) -> None:
    found.across.append(unit.T)
    if shape.radius and seen:
        if shape.A is None:
            raise Undecided(f"the set of '{label}' is no linear image of a ball in fractions")
        own = found.add(unit.shape[1] + 1, "cone")
        found.rows.append([(own[:1], [[1]]), (TAU, [[-shape.radius]])])
        found.k.append((own[1:], exact.product(exact.rational(unit), exact.rational(shape.A))))


def _polyhedron(found: Domains, unit: np.ndarray, H: np.ndarray, K: np.ndarray) -> None:
    """{l : H l >= K}: slacks > 0 but for the rows that are equalities on all of the set; K_inf* = H' R+^r."""
    own = found.add(H.shape[1], "free")
    _slacks(found, own, H, K)
    found.k.append((own, unit))
    found.y.append((found.add(len(K), "positive"), unit @ H.T))
    found.across.append(H @ unit.T)
    receding = exact.nullspace(H[equalities(H, np.zeros(len(K)))])
    found.flat.append(exact.product(receding.T, unit.T))


def _slacks(found: Domains, own: list[int], H: np.ndarray, K: np.ndarray) -> list[int]:
    """Rows H u >= tau K, strict where they can be; returns the indices of those that are equalities on all of the set."""
    implied = equalities(H, K)
    strict = [i for i in range(len(K)) if i not in implied]
    for rows in (implied, strict):
        if rows:
            parts = [(own, H[rows]), (TAU, -K[rows].reshape(-1, 1))]
            found.rows.append(parts if rows is implied else [*parts, (found.add(len(rows), "positive"), -np.eye(len(rows)))])
    return implied


def slack_system(H: np.ndarray, K: np.ndarray) -> System:
    """H l - tau K - s = 0 with tau, s > 0: solvable if and only if some l has H l > K. Columns tau, l, s."""
    r, n = H.shape
    A = np.hstack([exact.rational(-K.reshape(-1, 1)), exact.rational(H), exact.rational(-np.eye(r))])
    return System(A, (0, *range(1 + n, 1 + n + r)))


def equalities(H: np.ndarray, K: np.ndarray) -> list[int]:
    """Rows of H l >= K that are equalities on all of the set.

    Raises:
        Empty: no l has H l >= K.
    """
    zero = feasibility.implied_zeros(slack_system(H, K)) if len(K) else []
    if 0 in zero:
        raise Empty("it is empty: its conditions contradict each other")
    return [j - 1 - H.shape[1] for j in zero]


# -- potentials -----------------------------------------------------------------------------------------------------------


class AffineTerm(NamedTuple):
    """A term of a potential with numbers: kind and weight as in :class:`Term`, u = J y + c."""

    kind: str
    weight: float
    J: np.ndarray
    c: np.ndarray


class Potential(NamedTuple):
    """What is known of Phi.

    Attributes:
        Q, b: of the smooth part y'Qy/2 + b'y + ..., rational; None where it is not quadratic, or nested terms hide it.
        terms: those whose argument is affine and holds no nested level; all of them where Q is given.
        finite: whether Phi is finite everywhere.
        unknown: why its domain is not known; empty where it is.
    """

    Q: np.ndarray | None
    b: np.ndarray | None
    terms: tuple[AffineTerm, ...]
    finite: bool
    unknown: str = ""

    @property
    def bounds(self) -> list[AffineTerm]:
        """The terms that bound the domain."""
        return [term for term in self.terms if term.kind in BOUNDS]

    @property
    def piecewise(self) -> bool:
        """Whether Phi is piecewise linear-quadratic."""
        return self.Q is not None and all(term.kind not in ("norm", "cone") for term in self.terms)


def potential(phi: ca.SX, split: ConvexSplit, y: ca.SX) -> Potential:
    """Read a potential.

    Raises:
        Undecided: it is not proved to be convex.
    """
    m, z = y.numel(), ca.vertcat(y, split.tau)
    try:
        terms, unknown = _affine_terms(split, y), ""
    except Undecided as reason:
        terms, unknown = (), str(reason)
    form = None if unknown or split.tau.numel() else polynomial.quadratic(polynomial.read(split.smooth, y)[0], m)
    if form is not None:
        if not exact.psd(form.H).psd:
            raise Undecided("phi is not convex: its smooth part has an indefinite Hessian")
        return Potential(form.H, form.q, terms, not any(term.kind in BOUNDS for term in terms))
    if not convexity.everywhere(without_domain(phi, y, "phi"), y)[0].convex:
        raise Undecided("phi is not proved to be convex")
    finite = interval.is_continuous(phi, y, *_whole(m))
    if not (finite or unknown or interval.is_continuous(ca.vertcat(split.smooth, split.epigraph), z, *_whole(z.numel()))):
        unknown = "the smooth part of phi is not proved to be finite everywhere: its domain is not known"
    if unknown and not finite and not _is_proper(phi, y):
        raise Undecided(f"{unknown}; nor is phi proved to be convex and finite somewhere")
    return Potential(None, None, terms, finite, unknown)


def _is_proper(phi: ca.SX, y: ca.SX) -> bool:
    """Whether the domain is proved to be convex, and phi is finite at a sample point."""
    rows, equal = domain_rows(phi, y, "phi")
    shapes = convexity.everywhere(ca.vertcat(ca.SX(0, 1), *rows, *equal), y)
    bounds_good = all(shape.concave and (i < len(rows) or shape.convex) for i, shape in enumerate(shapes))
    return bounds_good and bool(
        np.isfinite(evaluate(phi, y, np.vstack([np.zeros((1, y.numel())), points(y.numel(), 200)]))).any()
    )


def _whole(n: int) -> tuple[np.ndarray, np.ndarray]:
    return np.full(n, -np.inf), np.full(n, np.inf)


def _affine_terms(split: ConvexSplit, y: ca.SX) -> tuple[AffineTerm, ...]:
    terms = [_affine(term, y) for term in split.terms if not _is_level(term, split.tau)]
    return tuple(term for term in terms if term.weight)


def _is_level(term: Term, tau: ca.SX) -> bool:
    """Whether a term is part of a nested one and bounds no domain."""
    if not tau.numel() or not ca.depends_on(term.u, tau):
        return False
    if term.kind in ("abs", "max", "norm") or (term.kind == "cone" and any(_same(term.u[0], s) for s in ca.vertsplit(tau))):
        return True
    raise Undecided(f"the domain of phi has a nested bound, {term.u}: write it with separate conditions")


def _same(a: ca.SX, b: ca.SX) -> bool:
    return bool(ca.is_equal(a, b, 5))


def _affine(term: Term, y: ca.SX) -> AffineTerm:
    m = y.numel()
    forms = [polynomial.quadratic(p, m) for p in polynomial.read(term.u, y)]
    flat = [form for form in forms if form is not None and not form.H.any()]
    if len(flat) < len(forms):
        raise Undecided(f"phi holds {term.kind}({term.u}), which is curved inside: its domain is no polyhedron or cone")
    J = np.array([form.q.ravel() for form in flat], dtype=object).reshape(-1, m)
    weight = 1.0 if term.kind in BOUNDS else float(ca.DM(term.weight))
    return AffineTerm(term.kind, weight, J, np.array([form.c for form in flat], dtype=object))


def of_potential(p: Potential, m: int, coupled: bool) -> Domains:
    """The domains of Xi(z) = Phi*(-z) and of Phi; ``coupled`` says that k is needed (D is not 0).

    Raises:
        Empty: no point is seen inside all the sets that bound the domain of Phi.
        Undecided: that domain is not known; k is needed and the smooth part is not quadratic.
    """
    if p.unknown and not p.finite:
        raise Undecided(p.unknown)
    found = Domains(m, loose=np.full(m, p.finite))
    if p.finite:
        return found
    own = found.add(m, "free")
    found.y.append((own, np.eye(m)))
    normals = _bounds(found, own, p.bounds)
    found.across.append(exact.nullspace(normals).T if len(normals) else exact.eye(m))
    found.flat += [term.J for term in p.bounds]
    if found.groups and feasibility.decide(found.system([])).point is None:
        raise Empty("no point is seen inside all the cones that bound it")
    if coupled:
        if p.Q is None:
            raise Undecided("the smooth part of phi is not quadratic, and D is not 0: the domain of Xi is not known")
        found.k += [(TAU, exact.product(p.b, [[-1]])), (found.add(m, "free"), exact.product(p.Q, -np.eye(m)))]
        for term in p.terms:
            _multiplier(found, term)
    return found


def _bounds(found: Domains, own: list[int], bounds: list[AffineTerm]) -> np.ndarray:
    """Rows for y in rint dom Phi; returns the normals of its affine hull (., m)."""
    m = len(own)
    planes = [(term.J, -term.c) for term in bounds if term.kind == "indicator"]
    planes += [(sign * term.J, -sign * term.c) for term in bounds if term.kind == "equality" for sign in (1, -1)]
    H = np.vstack([exact.zeros(0, m), *(J for J, _ in planes)])
    K = np.concatenate([exact.zeros(0, 1).ravel(), *(c for _, c in planes)])
    implied = _slacks(found, own, H, K)
    for term in bounds:
        if term.kind == "cone":
            inside = found.add(len(term.c), "cone")
            found.rows.append([(own, term.J), (TAU, term.c.reshape(-1, 1)), (inside, -np.eye(len(term.c)))])
    return H[implied]


def _multiplier(found: Domains, term: AffineTerm) -> None:
    """J' l' with l' in the relative interior of the term's own set of multipliers."""
    w = Fraction(term.weight)
    if term.kind in ("abs", "max"):
        for row in term.J:
            found.between(row, -w, w if term.kind == "max" else 2 * w)
    elif term.kind == "norm":
        own = found.add(len(term.J) + 1, "cone")
        found.rows.append([(own[:1], [[1.0]]), (TAU, [[-w]])])
        found.k.append((own[1:], term.J.T))
    else:
        kind = {"indicator": "positive", "equality": "free", "cone": "cone"}[term.kind]
        found.k.append((found.add(len(term.J), kind), term.J.T))
