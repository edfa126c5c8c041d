"""The velocities G(x) = F(x) - S(x) of an inclusion, taken apart: what is monotone by its form, and what is left.

    G(x) = rest(x, l_o) + sum_j B_j l_j,   -u_j(x) ∈ N_{K_j}(l_j)

A multiplier l_j is *aligned* where u_j = J_j x + c_j is affine and B_j = beta_j J_j' with beta_j >= 0, all constant: then
-B_j l_j is the subdifferential of a convex function, and its share of <G(x) - G(y), x - y> is never positive. Others stay in
l_o. Multipliers that cannot switch on C are put in.

Monotone parts of an operator with switches: sums of a h(a'x) with h nondecreasing, and what is left.

x -> a h(a'x) is monotone if and only if h is nondecreasing on the values of a'x, and maximal where the jumps of h are filled in;
a sum of maximal monotone operators that are defined everywhere is maximal monotone.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.models.monotone_inclusion.model import MonotoneInclusion
from nsmodel.models.monotone_inclusion.schemes import set_constraints, velocity_selection
from nsmodel.proof import exact, extremum, interval_bounds, jumps, polynomial
from nsmodel.proof.convex.rules import Ridges, find_ridges
from nsmodel.proof.convex.sets import ConvexSet
from nsmodel.proof.domain import is_defined_on_box
from nsmodel.proof.expression_graph import additive_terms, is_double, is_same_expression
from nsmodel.proof.monotone import JumpPoint, Monotonicity, decide_monotonicity, extract_constant_factor, is_continuous_by_pieces
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


@dataclass(frozen=True, eq=False)
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
    phi, where = model.potential_split, C.rows if C.rows.numel() else None
    defined = phi is not None and is_defined_on_box(phi.smooth, C.x, C.x, *C.bounding_box, where=where)
    chosen = velocity_selection(model, guarded=not defined)
    law = numeric_law(chosen.law)
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


FACE_SAMPLES = 8  # Points of each face of a box, down to corners: with each state there are three times as many,
MAX_FACE_STATES = 4  # so that only faces of the first states are looked at.
EDGE_STEP = 2.0**-44  # Of the way inwards from a boundary: 256 doubles, so that rounding leaves the point inside,
EDGE_JUMPS = 8  # and the largest differences there, which are tried as jumps.
# Pairs of points are looked for up to this distance from 0 where C is not bounded: one that is proved is enough.
SEARCH_SIZE = 1e3


class MonotoneSplit(NamedTuple):
    """S = rest + ``ridges`` terms a h(a'x) with h nondecreasing, whose jumps that are not filled in are ``open``."""

    rest: ca.SX
    ridges: int
    open: tuple[JumpPoint, ...]


def monotone_part(S: ca.SX, C: ConvexSet, *, signs_are_sets: bool = True) -> MonotoneSplit:
    """Set aside the nondecreasing functions of one direction; the sign of 0 is 0, or [-1, 1]."""
    x, n = C.x, C.n
    rest = [ca.SX(0) for _ in range(n)]
    groups: dict[tuple[Fraction, ...], list[tuple[ca.SX, list[Fraction]]]] = {}
    kept: dict[tuple[Fraction, ...], list[tuple[int, ca.SX]]] = {}
    symbol = ca.SX.sym("s")
    for i, row in enumerate(ca.vertsplit(S)):
        for outer, product in additive_terms(row):
            inner, term = extract_constant_factor(product)
            factor = outer * inner
            scaled = (float(factor) if is_double(factor) else _fraction_as_expression(factor)) * term
            (p,) = polynomial.read_polynomials(term, x)
            split = None if p is not None and polynomial.degree(p) <= 1 else find_ridges(term, x)
            if split is None or split.s.numel() != 1:
                rest[i] += scaled
                continue
            h, direction = ca.substitute(split.h, split.s, symbol), tuple(split.a[0])
            own = groups.setdefault(direction, [])
            place = next((c for other, c in own if is_same_expression(other, h)), None)
            if place is None:
                place = [Fraction(0)] * n
                own.append((h, place))
            place[i] += factor
            kept.setdefault(direction, []).append((i, scaled))
    decided: list[tuple[ca.SX, tuple[float, float], Monotonicity]] = []  # chains have one profile in many directions

    def decide(along: ca.SX, low: float, high: float) -> Monotonicity:
        known = (found for h, ends, found in decided if ends == (low, high) and is_same_expression(h, along))
        found = next(known, None) or decide_monotonicity(along, symbol, low, high, signs_are_sets=signs_are_sets)
        decided.append((along, (low, high), found))
        return found

    count, left_open = 0, []
    for direction, terms in groups.items():
        along = _combined_profile(np.array(direction, dtype=object), terms)
        ends = Ridges(symbol, symbol, np.array([direction], dtype=object)).box(*C.bounding_box)
        found = None if along is None else decide(along, float(ends[0][0]), float(ends[1][0]))
        if found is not None and found.nondecreasing:
            count += 1
            left_open += [jump for jump in found.jumps if not jump.filled]
        else:
            for i, term in kept[direction]:
                rest[i] += term
    return MonotoneSplit(ca.vertcat(*rest), count, tuple(left_open))


def remove_continuous_terms(F: ca.SX, C: ConvexSet) -> ca.SX:
    """F without functions of one direction whose switches are proved to be no jumps."""
    symbol = ca.SX.sym("s")
    rows = []
    for row in ca.vertsplit(F):
        kept = ca.SX(0)
        groups: dict[tuple[Fraction, ...], tuple[ca.SX, ca.SX]] = {}
        for factor, term in additive_terms(row):
            scaled = (float(factor) if is_double(factor) else _fraction_as_expression(factor)) * term
            split = find_ridges(term, C.x)
            if split is None or split.s.numel() != 1:
                kept += scaled
                continue
            own = groups.get(tuple(split.a[0]), (ca.SX(0), ca.SX(0)))
            h = (float(factor) if is_double(factor) else _fraction_as_expression(factor)) * ca.substitute(
                split.h, split.s, symbol
            )
            groups[tuple(split.a[0])] = own[0] + h, own[1] + scaled
        for direction, (h, whole) in groups.items():
            ends = Ridges(symbol, symbol, np.array([direction], dtype=object)).box(*C.bounding_box)
            if not jumps.jump_nodes(h, symbol) or not is_continuous_by_pieces(h, symbol, float(ends[0][0]), float(ends[1][0])):
                kept += whole
        rows.append(kept)
    return ca.vertcat(*rows)


def _fraction_as_expression(number: Fraction) -> ca.SX:
    return ca.SX(float(number.numerator)) / ca.SX(float(number.denominator))


def _combined_profile(a: np.ndarray, terms: list[tuple[ca.SX, list[Fraction]]]) -> ca.SX | None:
    """h but for a factor > 0, where sum of c h = a h exactly; None where it is not."""
    j = next(i for i, number in enumerate(a) if number)
    factors = [c[j] / a[j] for _, c in terms]
    if any(number != b * entry for (_, c), b in zip(terms, factors, strict=True) for number, entry in zip(c, a, strict=True)):
        return None
    size = abs(factors[0]) or Fraction(1)
    if not all(is_double(b / size) for b in factors):
        size = Fraction(1)
        if not all(is_double(b) for b in factors):
            return None
    return ca.SX(sum((float(b / size) * h for (h, _), b in zip(terms, factors, strict=True)), ca.SX(0)))


def face_points(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Points (k, n) on all finite faces of a box, and on edges, down to corners."""
    points, n = [extremum.samples(low, high, FACE_SAMPLES)], low.size
    for j in range(min(n, MAX_FACE_STATES)):
        for part in list(points):
            for end in (low[j], high[j]):
                moved = part.copy()
                moved[:, j] = end
                points += [moved] if np.isfinite(end) else []
    return np.vstack(points[1:] or [np.zeros((0, n))])


def boundary_jump(F: ca.SX, C: ConvexSet) -> jumps.ExpressionJump | None:
    """A point of C on a face of the box around it from which an expression provably jumps on the way inwards."""
    low, high = (np.clip(end, -1e3, 1e3) for end in C.bounding_box)
    points = face_points(*C.bounding_box)
    inwards = points + EDGE_STEP * ((low + high) / 2 - points)
    kept = C.contains(points) & C.contains(inwards) if len(points) else []
    if not np.any(kept):
        return None
    points, inwards, f = points[kept], inwards[kept], ca.Function("F", [C.x], [ca.densify(F)])
    below, above = (np.array(f(part.T)).T.reshape(len(points), -1) for part in (points, inwards))
    for k in np.argsort(-np.linalg.norm(above - below, axis=1), kind="stable")[:EDGE_JUMPS]:
        size = jumps.gap_between(ca.densify(F), C.x, points[k], inwards[k])
        if size > 0:
            return jumps.ExpressionJump(points[k], size, below[k], above[k])
    return None


def nonmonotone_pair(S: ca.SX, C: ConvexSet, box: tuple[np.ndarray, np.ndarray]) -> dict[str, np.ndarray] | None:
    """Two points of C with <S(x) - S(y), x - y> < 0, rounding included; None where none were found."""
    low, high = (np.clip(end, -SEARCH_SIZE, SEARCH_SIZE) for end in box)
    rng = np.random.default_rng(0)
    points = extremum.samples(low, high, 256)
    x, y = [points], [rng.permutation(points)]
    near = points + 1e-3 * (1 + np.abs(points)) * rng.normal(size=points.shape)
    x, y = [*x, points], [*y, near]
    below, above = jumps.switching_point_pairs(S, C.x, low, high, 512)
    if len(below):
        middle = (below + above) / 2
        for d in np.vstack([np.eye(C.n), rng.normal(size=(8, C.n))]):
            step = 1e-4 * (1 + np.linalg.norm(middle, axis=1))[:, None] * d
            x, y = [*x, middle + step], [*y, middle - step]
    on_faces = face_points(low, high)
    x, y = [*x, on_faces], [*y, on_faces + 1e-4 * (points[0] - on_faces)]
    one, other = np.vstack(x), np.vstack(y)
    inside = C.contains(one) & C.contains(other)
    one, other = one[inside], other[inside]
    f = ca.Function("S", [C.x], [S])
    gap = (np.array(f(one.T)) - np.array(f(other.T))).T
    with np.errstate(all="ignore"):
        rate = (gap * (one - other)).sum(axis=1) / ((one - other) ** 2).sum(axis=1)
    order = np.argsort(np.where(np.isfinite(rate), rate, np.inf))[:8]
    second = ca.SX.sym("y", C.n)
    product = ca.dot(S - ca.substitute(S, C.x, second), C.x - second)
    for k in order:
        if not rate[k] < 0:
            break
        both = np.concatenate([one[k], other[k]])
        z = ca.vertcat(C.x, second)
        if (
            interval_bounds.is_continuous(product, z, both, both)
            and float(np.max(interval_bounds.enclose(product, z, both, both)[1])) < 0
        ):
            return {"x": one[k], "y": other[k]}
    return None
