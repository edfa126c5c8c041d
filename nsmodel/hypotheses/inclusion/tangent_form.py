"""<x, rest(x)> as a polynomial, with bounded and Lipschitz terms beside it; and the point of C nearest to 0."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.inclusion import growth
from nsmodel.hypotheses.inclusion.growth import UP
from nsmodel.hypotheses.inclusion.selected_field import Field
from nsmodel.proof import exact, interval, polynomial
from nsmodel.proof.convex.convex_sets import ConvexSet, has_interior
from nsmodel.proof.convex.least_value import least_value


class Form(NamedTuple):
    """<x, rest(x, l_o) + shift> as a polynomial in x: x'Qx/2 + linear + constant, ``higher`` terms; l_o enters ``others`` only.

    ``others`` bounds the share of the jumps and of bounded terms: at most others |x|; ``degree`` is that of G; the share
    slope |x|^2 of Lipschitz terms is in Q, not in ``whole``.
    """

    Q: np.ndarray
    linear: np.ndarray
    constant: Fraction
    higher: polynomial.Polynomial
    others: float
    whole: polynomial.Polynomial
    degree: int
    slope: float


def form_of(field: Field) -> Form | None:
    """<x, rest> exactly, but for terms of ``rest`` that are bounded on C; None where neither works for some term.

    The jumps must enter by constant columns.
    """
    n = field.x.numel()
    whole: polynomial.Polynomial = {}
    degree, rows = 0, growth.read_rows(field)
    for i, (p, _, _) in enumerate(rows):
        if p is None:
            return None
        degree = max(degree, polynomial.degree(p))
        own = {monomial: number for monomial, number in p.items() if all(v < n for v, _ in monomial)}
        if any(len(monomial) != 1 or monomial[0][1] != 1 for monomial in p if monomial not in own):
            return None
        term = polynomial.multiply(own, {((i, 1),): Fraction(1)})
        if term is None:
            return None
        whole = polynomial.add(whole, term)
    others = float(np.linalg.norm([row.size for row in rows])) * (UP if n > 1 else 1.0)
    slope = float(np.linalg.norm([row.slope for row in rows])) * (UP if n > 1 else 1.0)
    for jump in field.jumps:
        column = np.array([float(entry) for entry in ca.vertsplit(jump.B)]) if jump.B.is_constant() else np.full(n, np.inf)
        others += float(np.linalg.norm(column)) * max(abs(jump.lower), abs(jump.upper)) * UP
    for i, number in enumerate(field.shift):
        if number:
            whole = polynomial.add(whole, {((i, 1),): Fraction(float(number))})
    low = {monomial: number for monomial, number in whole.items() if sum(power for _, power in monomial) <= 2}
    found = polynomial.quadratic(low, n)
    if found is None or not np.isfinite(others):
        return None
    higher = {monomial: number for monomial, number in whole.items() if monomial not in low}
    Q = found.H + 2 * Fraction(slope) * exact.eye(n)
    return Form(Q, found.q, found.c, higher, others, whole, degree, slope)


def offsets(field: Field) -> float:
    """What the aligned multipliers add to <x, v> at most, beside their nearest elements to 0."""
    return sum(term.offset for term in field.aligned) * (UP if len(field.aligned) > 1 else 1.0)


def nearest(C: ConvexSet) -> np.ndarray | None:
    """A point of C, surely in it, as near to 0 as doubles make it."""
    zero = np.zeros(C.n)
    if holds(C, zero):
        return zero
    clipped = np.clip(zero, *C.hull)
    if holds(C, clipped):
        return clipped
    inner = has_interior(C, clipped).witness.get("interior point")
    if inner is None:
        return None
    near, _ = least_value(ca.sumsqr(C.x), C, np.asarray(inner))
    for part in (0.0, 1e-9, 1e-6, 1e-3, 1e-1, 1.0):
        point = near + part * (np.asarray(inner) - near)
        if holds(C, point):
            return point
    return None


def holds(C: ConvexSet, point: np.ndarray) -> bool:
    """Whether a point is in C, exactly where the rows are polynomials, else by intervals."""
    x = [Fraction(float(entry)) for entry in point]
    for i, p in enumerate(C.polynomials):
        if p is not None:
            if polynomial.value(p, x) < 0:
                return False
        elif not float(np.min(interval.enclose(C.rows[i], C.x, point, point)[0])) >= 0:
            return False
    return True
