"""Sums of functions of one direction each, h_1(a_1'x) + h_2(a_2'x) + ...: their infimum and their convexity, one by one.

The affine terms of a potential are shared out among the directions: where q = sum m_j a_j, q'x = sum m_j a_j'x.
"""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import exact, interval_bounds, polynomial, univariate
from nsmodel.proof.convex.piecewise import exact_value, split_by_cases
from nsmodel.proof.convex.rules import find_ridges
from nsmodel.proof.convex.sets import ConvexSet
from nsmodel.proof.domain import domain_conditions, satisfies_relation
from nsmodel.proof.exponential_sums import Enclosure
from nsmodel.proof.expression_graph import additive_terms
from nsmodel.proof.univariate import WeightedTerms

# Half the width of the interval around 0 on which slopes are proved continuous, where two halves join: any width proves it.
MIDDLE_WIDTH = 1e-6


class DirectionPart(NamedTuple):
    """A sum of factors times terms in one s, which ranges over [low, high], ends infinite or doubles."""

    terms: WeightedTerms
    s: ca.SX
    low: float
    high: float

    def half_lines(self) -> list[tuple[WeightedTerms, ca.SX, Fraction | None]]:
        """The same as functions of r from 0 to a length (None: infinite), s = end + r, end - r, or r and -r."""
        r = ca.SX.sym("r")
        if np.isfinite(self.low):
            length = Fraction(self.high) - Fraction(self.low) if np.isfinite(self.high) else None
            ways = [(self.low + r, length)]
        else:
            ways = [(self.high - r, None)] if np.isfinite(self.high) else [(r, None), (-r, None)]
        return [([(c, ca.substitute(term, self.s, way)) for c, term in self.terms], r, length) for way, length in ways]


class DirectionSum(NamedTuple):
    """A constant, and the parts of one direction each, a row of Fractions of ``directions``."""

    constant: Fraction
    parts: list[DirectionPart]
    directions: np.ndarray


def split_by_directions(g: ca.SX, C: ConvexSet) -> DirectionSum | None:
    """Return a scalar as a sum of functions of one direction each, on a box that holds C; None where it is not seen as one."""
    affine: polynomial.Polynomial = {}
    own: dict[tuple[Fraction, ...], tuple[ca.SX, float, float, list[tuple[Fraction, ca.SX]]]] = {}
    for factor, term in additive_terms(g):
        (p,) = polynomial.read_polynomials(term, C.x)
        if p is not None and polynomial.degree(p) <= 1:
            affine = polynomial.add_multiple(affine, p, factor)
            continue
        split = find_ridges(term, C.x)
        if split is None or split.s.numel() != 1:
            return None
        (low,), (high,) = split.box(*C.bounding_box)
        s, *_, terms = own.setdefault(tuple(split.a[0]), (ca.SX.sym("s"), float(low), float(high), []))
        terms.append((factor, ca.substitute(split.h, split.s, s)))
    found = polynomial.as_quadratic(affine, C.n)
    if found is None or not own:
        return None
    directions = np.array(list(own), dtype=object)
    shares = exact.solve_linear_system(directions.T, found.q)
    if shares is None:
        return None
    parts = [
        DirectionPart([*terms, *([(m, s)] if m else [])], s, low, high)
        for m, (s, low, high, terms) in zip(shares.ravel(), own.values(), strict=True)
    ]
    return DirectionSum(found.c, parts, directions)


class InfimumBound(NamedTuple):
    """A lower bound; ``tight``: it is the infimum but for rounding."""

    bound: float
    tight: bool


def infimum_by_directions(g: ca.SX, C: ConvexSet) -> InfimumBound | None:
    """A lower bound on C of a sum of functions of one direction each: the sum of their infima; None where one is not found.

    It is the infimum where the functions are independent of each other: of single states on a box, or of independent directions
    on all of space.
    """
    split = split_by_directions(g, C)
    bounds = [part_infimum(part) for part in split.parts] if split is not None else [None]
    known = [Fraction(bound) for bound in bounds if bound is not None and np.isfinite(bound)]
    if split is None or len(known) < len(bounds):
        return None
    is_box = C.is_polyhedron and all(np.count_nonzero(row) == 1 for row in C.half_spaces[0])
    tight = exact.rank(split.directions) == len(known) if not C.rows.numel() else is_box and _are_axes(split.directions)
    return InfimumBound(exact.round_down(split.constant + sum(known)) + 0.0, tight)


def _are_axes(directions: np.ndarray) -> bool:
    return all(np.count_nonzero(a) == 1 for a in directions)


def part_infimum(part: DirectionPart) -> float | None:
    """A lower bound of a part on its range, next to its infimum, -inf where it has none; None where it is not found."""
    bounds: list[float | None] = []
    for terms, r, length in part.half_lines():
        pieces = split_by_cases(terms, r)
        if pieces is None:
            return None
        for piece in pieces:
            low, high = piece.rational_ends
            end = high if length is None else length if high is None else min(high, length)
            if end is None or low < end:
                bounds += [_value_bound(terms, r, piece.low), univariate.infimum_bound(terms, r, low, end, piece.cases)]
        bounds += [_value_bound(terms, r, (length, length))] if length is not None else []
    return None if None in bounds else min(bound for bound in bounds if bound is not None)


def _value_bound(terms: WeightedTerms, r: ca.SX, place: Enclosure) -> float | None:
    """A lower bound of a sum at a joint or an end, infinite where it is proved to have no value there."""
    if place[0] == place[1] and any(_has_no_value(term, r, place[0]) for _, term in terms):
        return float("inf")
    return univariate.lower_bound_on_enclosure(terms, r, place)


def _has_no_value(term: ca.SX, r: ca.SX, at: Fraction) -> bool:
    """Whether an operation is proved to have no value there, exactly."""
    known = ((condition, exact_value(condition.u, r, at)) for condition in domain_conditions(term) if not condition.guards)
    return any(u is not None and not satisfies_relation(u, condition.relation) for condition, u in known)


def is_convex_by_directions(g: ca.SX, C: ConvexSet) -> bool:
    """Whether g is proved convex on C: a sum of functions of one direction with second derivatives >= 0, without kinks.

    At an end of its range such a function is continuous, or grows beyond all bounds and is +inf.
    """
    split = split_by_directions(g, C)
    return split is not None and all(_is_part_convex(part) for part in split.parts)


def _is_part_convex(part: DirectionPart) -> bool:
    halves, no_cases = part.half_lines(), [{} for _ in part.terms]
    for terms, r, length in halves:
        found = univariate.second_derivative_signs(terms, r, Fraction(0), length, no_cases, Fraction(0), strict=True)
        if found is None or min(found.signs) < 0:
            return False
    whole = sum((float(factor) * term for factor, term in part.terms), ca.SX(0))
    if len(halves) == 2:
        near = np.array([-MIDDLE_WIDTH]), np.array([MIDDLE_WIDTH])
        return interval_bounds.is_continuous(ca.vertcat(whole, ca.gradient(whole, part.s)), part.s, *near)
    ends = [end for end in (part.low, part.high) if np.isfinite(end)]
    return all(
        interval_bounds.is_continuous(whole, part.s, np.array([end]), np.array([end])) or _rises_towards(part, end)
        for end in ends
    )


def _rises_towards(part: DirectionPart, end: float) -> bool:
    """Whether a part tends to +inf at an end of its range."""
    way = 1 if end == part.low else -1
    r, length = ca.SX.sym("r"), Fraction(part.high) - Fraction(part.low) if np.isfinite([part.low, part.high]).all() else None
    terms = [(factor, ca.substitute(term, part.s, end + way * r)) for factor, term in part.terms]
    return univariate.limit_at_start(terms, r, length) == np.inf
