"""Bounds of gamma from pairs: balls and half-spaces about one point, whose normals where both are active are known exactly.

Where a point is at the distances a >= r and b >= s from two centres that are d apart, its unit normals have the product
(a^2 + b^2 - d^2) / (2 a b); where that is < 0 it grows with a and with b, so that the least value is the one at a = r, b = s. To
a half-space whose boundary is the distance d in front of the centre it is (g - d) / b >= -d / s.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.classes.sweeping.hypotheses.constraint import Constraint, supremum_over_time
from nsmodel.classes.sweeping.hypotheses.forms import (
    AffineForm,
    Offset,
    add_offsets,
    offset_expression,
    scale_offset,
    square_offset,
)
from nsmodel.classes.sweeping.hypotheses.geometry import gram_bound, sqrt_above
from nsmodel.proof import exact
from nsmodel.proof.verdict import not_none

MAX_PAIR_CONSTRAINTS = 60
PAIR_ROUNDING_FACTOR = 1 + 1e-12
PAIRS_DESCRIPTION = "balls and half-spaces: the angles between their normals where two of them meet"


class BallComplement(NamedTuple):
    """The outside of a ball: centre {state: offset}, radius, and how far beyond it counts as near for each unit of rho.

    ``power`` 1: g = w (|q - centre| - r); 2: g = w (|q - centre|^2 - r^2) with ``square`` r^2 exactly.
    """

    centre: dict[int, Offset]
    square: Offset
    w: Fraction
    power: int


def bound_gamma_by_pairs(constraints: Sequence[Constraint], rho: float) -> tuple[float, float, str] | None:
    """Return (gamma, up to which rho, how) for balls and half-spaces in the same states; None where pairs do not bound it."""
    if not 1 < len(constraints) <= MAX_PAIR_CONSTRAINTS or any(c.shape.kind == "other" for c in constraints):
        return None
    rounds = [ball_complement_of(c) if c.shape.kind != "plane" else None for c in constraints]
    states = {i for c in constraints for i in c.shape.own}
    about_all = all(ball is None or set(ball.centre) == states for ball in rounds)
    read = all(ball is not None or c.shape.kind == "plane" for c, ball in zip(constraints, rounds, strict=True))
    if not (any(rounds) and about_all and read):
        return None
    G, reached = np.eye(len(constraints)), np.inf
    for i, j in combinations(range(len(constraints)), 2):
        cosine = _normals_cosine_bound(constraints[i], constraints[j], rho)
        if cosine is None:
            return None
        if np.isnan(cosine):
            cosine, reached = 0.0, rho
        if len(constraints) == 2 and cosine > 0:
            return float(np.sqrt(2 / (1 + cosine))) * PAIR_ROUNDING_FACTOR, reached, PAIRS_DESCRIPTION
        G[i, j] = G[j, i] = min(cosine, 0.0)
    gamma = gram_bound(G)
    return (gamma, reached, PAIRS_DESCRIPTION) if np.isfinite(gamma) else None


def ball_complement_of(c: Constraint) -> BallComplement | None:
    """The ball that a constraint keeps out of; None where it is none."""
    form = c.shape.form
    if form is None or c.shape.clips:
        return None
    if c.shape.kind == "distance":
        w, squares = form.norms[0]
        offset = form.affine.offset
    else:
        w, squares, offset = Fraction(1), () if form.affine.row else form.squares, form.affine.offset
    centre: dict[int, Offset] = {}
    scales = set()
    for v, a in squares:
        if len(a.row) != 1:
            return None
        ((i, x),) = a.row.items()
        if i < 0 or i in centre:
            return None
        centre[i] = scale_offset(-1 / x, a.offset)
        scales.add(v * x * x)
    if len(scales) != 1 or len(centre) != len(c.shape.own):
        return None
    (scale,) = scales
    if scale <= 0:
        return None
    if c.shape.kind == "quadratic":
        return BallComplement(centre, scale_offset(-1 / scale, offset), scale, 2)
    if not isinstance(offset, Fraction):
        reach = -offset_expression(offset) / float(w)
        return BallComplement(centre, reach * reach / float(scale), w * w * scale, 1)
    return BallComplement(centre, offset * offset / (w * w * scale), w * w * scale, 1) if offset < 0 else None


@lru_cache(maxsize=1024)
def _normals_cosine_bound(a: Constraint, b: Constraint, rho: float) -> float | None:
    """A lower bound of the product of unit normals at admissible points; None where they may oppose each other.

    NaN: they do not, for the two are never within rho together.
    """
    one, other = (ball_complement_of(c) if c.shape.kind != "plane" else None for c in (a, b))
    if one is None and other is None:
        return _planes_cosine(a, b)
    if one is None or other is None:
        return _plane_ball_cosine(a if one is None else b, not_none(other if one is None else one))
    d2: Offset = Fraction(0)
    for i in one.centre:
        difference = add_offsets(one.centre[i], scale_offset(Fraction(-1), other.centre[i]))
        d2 = add_offsets(d2, square_offset(difference))
    if isinstance(d2, Fraction) and isinstance(one.square, Fraction) and isinstance(other.square, Fraction):
        if one.square <= 0 or other.square <= 0:
            return None
        excess = d2 - one.square - other.square
        if excess <= 0:
            return _acute_cosine_bound(excess, one.square, other.square, d2)
        cosine2 = excess**2 / (4 * one.square * other.square)
        if cosine2 < 1:
            return -sqrt_above(cosine2)
        return np.nan if _are_balls_separated(one, other, d2, rho) else None
    r2, s2 = offset_expression(one.square), offset_expression(other.square)
    least = [-supremum_over_time(c, -square).bound for c, square in ((a, r2), (b, s2))]
    if not min(least) > 0:
        return None
    top = supremum_over_time(a, (offset_expression(d2) - r2 - s2) / (2 * ca.sqrt(r2 * s2))).bound + _cosine_rounding(
        a, one, other, d2, least
    )
    if top < 1:
        return -max(float(np.nextafter(top, 2)), 0.0)
    gap = ca.sqrt(offset_expression(d2)) - ca.sqrt(r2) - ca.sqrt(s2)
    return (
        np.nan
        if -supremum_over_time(a, -gap).bound > _near_distance(one, min(least), rho) + _near_distance(other, min(least), rho)
        else None
    )


def _acute_cosine_bound(excess: Fraction, r2: Fraction, s2: Fraction, d2: Fraction) -> float:
    """The least product where that at a = r, b = s is >= 0: there, or where a^2 + d^2 = b^2 (or b^2 + d^2 = a^2) beyond."""
    least = min(excess**2 / (4 * r2 * s2), r2 / (r2 + d2), s2 / (s2 + d2))
    return max(float(least) ** 0.5 * (1 - 1e-14), 0.0)


def _cosine_rounding(a: Constraint, one: BallComplement, other: BallComplement, d2: Offset, least: Sequence[float]) -> float:
    """What the rational numbers in such a quotient lose as doubles: parts of eps of the centres and of d."""
    centre = max((abs(float(x)) for ball in (one, other) for x in ball.centre.values() if isinstance(x, Fraction)), default=0.0)
    d = max(supremum_over_time(a, offset_expression(d2)).bound, 0.0) ** 0.5
    return (
        64 * exact.MACHINE_EPSILON * (d * (centre + d) + centre**2 * exact.MACHINE_EPSILON) / float(np.prod(least)) ** 0.5
        + 64 * exact.MACHINE_EPSILON
    )


def _are_balls_separated(one: BallComplement, other: BallComplement, d2: Fraction, rho: float) -> bool:
    """Whether two balls are too far apart to be near active together, with a margin above all rounding."""
    r, s = (float(ball.square) ** 0.5 for ball in (one, other))
    gap = float(d2) ** 0.5 - r - s
    return gap * (1 - 1e-9) - 1e-14 * (r + s) > _near_distance(one, float(one.square), rho) + _near_distance(
        other, float(other.square), rho
    )


def _near_distance(ball: BallComplement, square: float, rho: float) -> float:
    """By how much a point within rho is further than the radius, widened."""
    if ball.power == 1:
        return rho / float(ball.w) ** 0.5 * (1 + 1e-9)
    return (np.sqrt(square + rho / float(ball.w)) - np.sqrt(square)) * (1 + 1e-9) + 1e-15 * np.sqrt(square)


def _planes_cosine(a: Constraint, b: Constraint) -> float | None:
    """The product of two fixed unit normals, rounded down."""
    one, other = (c.shape.written.affine.row for c in (a, b))
    dot = sum((value * other.get(i, Fraction(0)) for i, value in one.items()), Fraction(0))
    if dot >= 0:
        return 0.0
    cosine2 = dot**2 / (sum(x * x for x in one.values()) * sum(x * x for x in other.values()))
    return -sqrt_above(cosine2) if cosine2 < 1 else None


def _plane_ball_cosine(plane: Constraint, ball: BallComplement) -> float | None:
    """-d / s, d the height of the centre above the boundary, over the time at hand."""
    form = plane.shape.written
    height: Offset = form.affine.offset
    size = sum((x * x for x in form.affine.row.values()), Fraction(0))
    for i, value in form.affine.row.items():
        height = add_offsets(height, scale_offset(value, ball.centre[i]))
    if isinstance(height, Fraction) and isinstance(ball.square, Fraction):
        if height <= 0:
            return 0.0
        cosine2 = height**2 / (size * ball.square)
        return -sqrt_above(cosine2) if cosine2 < 1 else None
    square = offset_expression(ball.square)
    least = -supremum_over_time(plane, -square).bound
    if not least > 0:
        return None
    top = supremum_over_time(plane, offset_expression(height) / ca.sqrt(float(size) * square)).bound
    top += 64 * exact.MACHINE_EPSILON * (1 + _height_scale(ball, form.affine) / least**0.5)
    return -max(float(np.nextafter(top, 2)), 0.0) if top < 1 else None


def _height_scale(ball: BallComplement, plane: AffineForm) -> float:
    """The size of the rational numbers in the height of a centre above a plane, in units of length."""
    rest = [abs(float(x)) for x in ball.centre.values() if isinstance(x, Fraction)]
    size = float(sum((x * x for x in plane.row.values()), Fraction(0))) ** 0.5
    return sum(rest) + (abs(float(plane.offset)) / size if isinstance(plane.offset, Fraction) else 0.0)
