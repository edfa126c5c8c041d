"""Monotone parts of an operator with switches: sums of a h(a'x) with h nondecreasing, and what is left.

x -> a h(a'x) is monotone if and only if h is nondecreasing on the values of a'x, and maximal where the jumps of h are filled in;
a sum of maximal monotone operators that are defined everywhere is maximal monotone.
"""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import extremum, interval_bounds, jumps, polynomial
from nsmodel.proof.convex.lower_bounds import additive_terms
from nsmodel.proof.convex.rules import Ridges, find_ridges
from nsmodel.proof.convex.sets import ConvexSet
from nsmodel.proof.expression_graph import is_double, is_same_expression
from nsmodel.proof.monotone import JumpPoint, decide_monotonicity, extract_constant_factor, is_continuous_by_pieces

SEARCH_SIZE = 1e3  # Pairs of points are looked for up to this distance from 0 where C is not bounded.


class MonotoneSplit(NamedTuple):
    """S = rest + ``ridges`` terms a h(a'x) with h nondecreasing, whose jumps that are not filled in are ``open``."""

    rest: ca.SX
    ridges: int
    open: tuple[JumpPoint, ...]


def monotone_part(S: ca.SX, C: ConvexSet) -> MonotoneSplit:
    """Set aside the nondecreasing functions of one direction."""
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
    count, left_open = 0, []
    for direction, terms in groups.items():
        along = _combined_profile(np.array(direction, dtype=object), terms)
        ends = Ridges(symbol, symbol, np.array([direction], dtype=object)).box(x, *C.bounding_box)
        found = None if along is None else decide_monotonicity(along, symbol, float(ends[0][0]), float(ends[1][0]))
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
            ends = Ridges(symbol, symbol, np.array([direction], dtype=object)).box(C.x, *C.bounding_box)
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
    one, other = np.vstack(x), np.vstack(y)
    inside = (C.values(one) > 0).all(axis=1) & (C.values(other) > 0).all(axis=1)
    one, other = one[inside], other[inside]
    f = ca.Function("S", [C.x], [S])
    gap = (np.array(f(one.T)) - np.array(f(other.T))).T
    with np.errstate(all="ignore"):
        rate = (gap * (one - other)).sum(axis=1) / ((one - other) ** 2).sum(axis=1)
    order = np.argsort(np.where(np.isfinite(rate), rate, np.inf))[:8]
    second = ca.SX.sym("y", C.n)
    product = ca.dot(S - ca.substitute(S, C.x, second), C.x - second)
    for k in order:
        if not rate[k] < 0 or C.interior_margin(one[k]) is None or C.interior_margin(other[k]) is None:
            continue
        both = np.concatenate([one[k], other[k]])
        z = ca.vertcat(C.x, second)
        if (
            interval_bounds.is_continuous(product, z, both, both)
            and float(np.max(interval_bounds.enclose(product, z, both, both)[1])) < 0
        ):
            return {"x": one[k], "y": other[k]}
    return None
