"""Bounds of gamma from pairs: balls and half-spaces about one point, whose normals where both are active are known exactly.

Where a point is at the distances a >= r and b >= s from two centres that are d apart, its unit normals have the product
(a^2 + b^2 - d^2) / (2 a b); where that is < 0 it grows with a and with b, so that the least value is the one at a = r, b = s. To
a half-space whose boundary is the distance d in front of the centre it is (g - d) / b >= -d / s.

Bounds of gamma that hold for all states: independent gradients, discs in free space, planes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import lru_cache
from itertools import combinations, pairwise
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import sum_in_order
from nsmodel.models.sweeping_process.constraint_bounds import Constraint, supremum_over_time
from nsmodel.models.sweeping_process.constraint_shapes import (
    AffineForm,
    ConstraintShape,
    Offset,
    add_offsets,
    offset_expression,
    scale_offset,
    square_offset,
)
from nsmodel.models.sweeping_process.mfcq_constant import (
    disc_row_gamma,
    gram_bound,
    hull_bound,
    mfcq_constant,
    row_space,
    sqrt_above,
)
from nsmodel.proof import exact, interval_bounds
from nsmodel.proof.conic import ConicSystem, decide_feasibility
from nsmodel.proof.exact import ROUND_UP_FACTOR
from nsmodel.proof.expression_graph import program, stack_column
from nsmodel.proof.verdict import not_none

MAX_PAIR_CONSTRAINTS = 60  # Constraints whose pairs are all looked at, 1770; with more this proof is not tried.
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
            return float(np.sqrt(2 / (1 + cosine))) * ROUND_UP_FACTOR, reached, PAIRS_DESCRIPTION
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
    return sum_in_order(rest) + (abs(float(plane.offset)) / size if isinstance(plane.offset, Fraction) else 0.0)


MAX_PLANES = 12  # Planes whose sets that can be active are looked at one by one, 2^12; of more, all of them together.
# Constraints between whose spaces of gradients all angles are looked at, 1770; with more this proof is not tried.
MAX_INDEPENDENT = 60
ORTHONORMAL_ROUNDING = 1e-8  # More than what products of orthonormal vectors err by, half of the digits.
INITIAL_SLICES = 8  # Of the interval of time, where planes move: each is a linear program,
MAX_SLICES = 200  # Slices in all, as these are cut further; beyond, planes count as active together, which is safe,
MIN_SLICE_FRACTION = 1e-9  # and so they do on a slice that is this part of the interval.

OffsetBounds = Callable[[float, float], tuple[np.ndarray, np.ndarray]]


class GammaProof(NamedTuple):
    """gamma(rho) <= gamma for all states and times; ``how`` in words. inf: the constraints ``opposed`` meet at ``at`` (t, q)."""

    gamma: float
    rho: float
    how: str
    opposed: tuple[int, ...] = ()
    weights: tuple[float, ...] = ()
    at: np.ndarray | None = None


def bound_gamma_everywhere(constraints: Sequence[Constraint], rho: float, moving: bool = False) -> GammaProof | None:
    """Return a bound that holds for all states, for the sets of constraints within ``rho`` of active; None if there is none.

    ``moving``: they hold parameters too, so that planes are asked for their normals only.
    """
    if not constraints:
        return GammaProof(1.0, np.inf, "no constraint")
    if len(constraints) == 1:
        return GammaProof(1.0, np.inf, "one constraint")
    for rule in (
        (_independence_proof, _pairs_proof, discs_proof)
        if moving
        else (_planes_proof, _independence_proof, _pairs_proof, discs_proof)
    ):
        proof = rule(constraints, rho)
        if proof is not None:
            return proof
    return None


def _pairs_proof(constraints: Sequence[Constraint], rho: float) -> GammaProof | None:
    found = bound_gamma_by_pairs(constraints, rho)
    return None if found is None else GammaProof(*found)


def _independence_proof(constraints: Sequence[Constraint], rho: float) -> GammaProof | None:
    """|<n_i, n_j>| is at most the cosine of the angle between the spaces of the gradients; planes have fixed normals."""
    if len(constraints) > MAX_INDEPENDENT:
        return None
    states = sorted({i for c in constraints for i in c.shape.own})
    spaces = [space for c in constraints if (space := _gradient_space(c.shape, states)) is not None]
    if len(spaces) < len(constraints):
        return None
    G = np.eye(len(constraints))
    for i, j in combinations(range(len(constraints)), 2):
        if not set(constraints[i].shape.own) & set(constraints[j].shape.own):
            continue
        cosine = spaces[i].T @ spaces[j]
        signed = constraints[i].shape.kind == constraints[j].shape.kind == "plane"
        G[i, j] = G[j, i] = min(
            (float(cosine[0, 0]) if signed else -float(np.linalg.norm(cosine, 2))) - ORTHONORMAL_ROUNDING, 0.0
        )
    gamma = gram_bound(G)
    return GammaProof(gamma, np.inf, "the gradients stay in spaces at bounded angles") if np.isfinite(gamma) else None


def _gradient_space(shape: ConstraintShape, states: Sequence[int]) -> np.ndarray | None:
    """An orthonormal basis of a space that holds the gradient, to ORTHONORMAL_ROUNDING; of a plane the unit normal itself."""
    place = {i: k for k, i in enumerate(states)}
    if shape.kind == "plane":
        normal = np.zeros((len(states), 1))
        for i, value in shape.written.affine.row.items():
            normal[place[i]] = float(value)
        return normal / np.linalg.norm(normal)
    if shape.kind == "distance":
        A = exact.zeros(len(shape.written.norms[0][1]), len(states))
        for row, (_, a) in enumerate(shape.written.norms[0][1]):
            for i, value in a.row.items():
                if i >= 0:
                    A[row, place[i]] = value
        largest = [max(abs(x) for x in row) for row in A]
        space = row_space(exact.doubles(np.array([row / size for row, size in zip(A, largest, strict=True) if size])))
        return space if space.shape[1] == exact.rank(A) else None
    return np.eye(len(states))[:, [place[i] for i in shape.own]]


# -- discs -------------------------------------------------------------------------------------------------------------


def discs_proof(constraints: Sequence[Constraint], rho: float, count: int | None = None) -> GammaProof | None:
    """Distances between bodies, and planes for single bodies whose normals have an escape direction e: <n, e> >= kappa > 0.

    A connected group of k bodies is blown up from its centre and moved along e, v = (q - centre) + s (e, ..., e). With ``l``
    the largest distance in contact and D the least one: pairs gain <n_ij, v> = |q_i - q_j| / sqrt(2) >= D / sqrt(2), and planes
    <n, v> >= s kappa - R, R = l (k - 1)/2; s makes both equal. |q - centre|^2 <= l^2 (k^3 - k)/12 (a row is the worst), so
    gamma^2 <= (l^2 (k^3 - k)/12 + k s^2) / (D^2/2). gamma^2 adds up over groups, and one group of all is the worst.

    ``count``: there are so many bodies, and each constraint is like one of these.
    """
    pairs = [pair for c in constraints if (pair := body_pair_of(c)) is not None]
    planes = [c.shape.written.affine.row for c in constraints if c.shape.kind == "plane"]
    if not pairs or len(pairs) + len(planes) < len(constraints):
        return None
    bodies = {body for pair in pairs for body in (pair.first, pair.second)}
    owner: dict[int, tuple[int, ...]] = {}
    if any(owner.setdefault(i, body) != body for body in bodies for i in body):
        return None
    normals = []
    for row in planes:
        body = {owner.get(i) for i in row}
        (only,) = body if len(body) == 1 else (None,)
        if only is None:
            return None
        normals.append([row.get(i, Fraction(0)) for i in only])
    k, D, l = count or len(bodies), min(pair.low for pair in pairs), max(pair.reach(rho) for pair in pairs)
    if not normals:
        gamma = l / D * disc_row_gamma(k) * ROUND_UP_FACTOR
        return GammaProof(gamma, rho, f"{k} bodies that touch only each other: blown up from the centre they all part")
    if len({len(normal) for normal in normals}) > 1:
        return None
    away = hull_bound(normals)
    if not np.isfinite(away):
        return None
    s = (l * (k - 1) / 2 + D / np.sqrt(2)) * away
    gamma = float(np.sqrt((l**2 * (k**3 - k) / 12 + k * s**2) / (D**2 / 2))) * ROUND_UP_FACTOR
    return GammaProof(
        gamma, rho, f"{k} bodies and planes with a common escape direction: blown up and moved along it they all part"
    )


def has_aligned_pairs(constraints: Sequence[Constraint], d: int) -> bool:
    """Whether all distances are between the same states of two bodies, those of the second d after those of the first."""
    known = set()
    for c in constraints:
        pair = body_pair_of(c)
        if pair is not None:
            first, second = (tuple(i % d for i in states) for states in (pair.first, pair.second))
            known |= {first, second}
            if any(abs(i - j) != d for i, j in zip(pair.first, pair.second, strict=True)):
                return False
    return len(known) <= 1


class BodyPair(NamedTuple):
    """w (|q_i - q_j| - r(t)), or w (|q_i - q_j|^2 - r(t)^2) where ``power`` is 2.

    Attributes:
        first, second: the states of both bodies, in the same order.
        low, high: bounds of r over time.
    """

    first: tuple[int, ...]
    second: tuple[int, ...]
    low: float
    high: float
    w: float
    power: int

    def reach(self, rho: float) -> float:
        """A bound of the distance where the constraint is within rho."""
        return self.high + rho / self.w if self.power == 1 else float(np.sqrt(self.high**2 + rho / self.w))


def body_pair_of(c: Constraint) -> BodyPair | None:
    """Read a constraint between two bodies; None where it is none."""
    form = c.shape.form
    if form is None or c.shape.kind not in ("distance", "quadratic") or c.shape.clips or form.affine.row:
        return None
    w, squares = form.norms[0] if form.norms else (Fraction(1), form.squares)
    scales, first, second = set(), [], []
    for weight, a in squares:
        ends = sorted((value, i) for i, value in a.row.items())
        if not isinstance(a.offset, Fraction) or a.offset or len(ends) != 2 or ends[0][0] != -ends[1][0]:
            return None
        scales.add(weight * ends[1][0] ** 2)
        swap = bool(second) and _is_reversed(first, second, ends)
        first.append(ends[1 if swap else 0][1])
        second.append(ends[0 if swap else 1][1])
    if len(scales) != 1 or len({*first, *second}) != 2 * len(first):
        return None
    (scale,), power = scales, 1 if form.norms else 2
    if scale <= 0:
        return None
    w = float(scale if power == 2 else w * Fraction(float(scale) ** 0.5))
    offset = offset_expression(form.affine.offset)
    low, high = (
        -supremum_over_time(c, offset).bound / w / ROUND_UP_FACTOR,
        supremum_over_time(c, -offset).bound / w * ROUND_UP_FACTOR,
    )
    if not (low > 0 and np.isfinite(high)):
        return None
    low, high = (low, high) if power == 1 else (low**0.5 / ROUND_UP_FACTOR, high**0.5 * ROUND_UP_FACTOR)
    return BodyPair(tuple(first), tuple(second), low, high, w / ROUND_UP_FACTOR, power)


def _is_reversed(first: list[int], second: list[int], ends: list[tuple[Fraction, int]]) -> bool:
    """Whether a difference is written the other way round: bodies have neighbouring states."""
    (_, a), (_, b) = ends
    return abs(a - first[-1]) + abs(b - second[-1]) > abs(b - first[-1]) + abs(a - second[-1])


# -- planes ------------------------------------------------------------------------------------------------------------


def _planes_proof(constraints: Sequence[Constraint], rho: float) -> GammaProof | None:
    """Fixed normals: gamma is the largest over the sets that can be within rho of active together.

    By Caratheodory's theorem sets of at most n + 1 normals are enough. Whether a set can be active is decided exactly, with
    every constraint loosened by 1e-9.
    """
    if any(c.shape.kind != "plane" for c in constraints):
        return None
    states = sorted({i for c in constraints for i in c.shape.own})
    rows = [[c.shape.written.affine.row.get(i, Fraction(0)) for i in states] for c in constraints]
    if not all(any(row) for row in rows):
        return None
    N = np.array([[float(x / size) for x in row] for row in rows for size in [max(abs(x) for x in row)]])
    if len(constraints) > MAX_PLANES:
        full = hull_bound(rows)
        if not np.isfinite(full):
            return None
        return GammaProof(full, np.inf, "planes: even with all of them active the normals have this constant")
    largest = min(len(constraints), len(states) + 1)
    sets = [J for size in range(1, largest + 1) for J in combinations(range(len(constraints)), size)]
    constants = {J: (hull_bound([rows[j] for j in J]) if len(J) > 1 else 1.0, mfcq_constant(N[list(J)])[1]) for J in sets}
    impossible: list[set[int]] = []
    offsets = _offset_bounds(constraints)
    for J in sorted(sets, key=lambda J: (-constants[J][0], len(J))):
        if any(bad <= set(J) for bad in impossible):
            continue
        possible, at = (
            (False, None)
            if _are_planes_separated(constraints, J, rho)
            else _can_be_active_together(constraints, states, J, rho, offsets)
        )
        if possible:
            gamma, weights = constants[J]
            if np.isinf(gamma) and at is None:
                return None
            how = f"planes: the worst of the {len(sets)} sets that can be active together, each decided exactly"
            return GammaProof(gamma, rho, how, J, tuple(float(u) for u in weights), at)
        impossible.append(set(J))
    return GammaProof(1.0, rho, "planes: no set of them can be active")


def _are_planes_separated(constraints: Sequence[Constraint], J: Sequence[int], rho: float) -> bool:
    """Whether opposing planes are always further apart than rho allows: sum u_i g_i, u > 0, is a function of time alone."""
    rows = [constraints[j].shape.written.affine.row for j in J]
    states = sorted({i for row in rows for i in row})
    A = exact.zeros(len(states), len(J))
    for k, row in enumerate(rows):
        for i, value in row.items():
            A[states.index(i), k] = value
    N = exact.nullspace(A)
    if N.shape[1] != 1:
        return False
    u = N[:, 0] * (1 if N[0, 0] > 0 else -1)
    if not all(weight > 0 for weight in u):
        return False
    total = Fraction(0)
    for weight, j in zip(u, J, strict=True):
        total = add_offsets(total, scale_offset(weight, constraints[j].shape.written.affine.offset))
    if isinstance(total, Fraction):
        return total > Fraction(rho) * sum(u, Fraction(0))
    least = -supremum_over_time(constraints[J[0]], -offset_expression(total)).bound
    return bool(least > rho * float(sum(u)) * (1 + 1e-12) and least > 0)


def _offset_bounds(constraints: Sequence[Constraint]) -> OffsetBounds:
    """Return offsets(a, b) -> lower and upper ends (p,) of the planes' offsets over a <= t <= b."""
    code = program(stack_column(offset_expression(c.shape.written.affine.offset) for c in constraints), constraints[0].t)

    def offsets(a: float, b: float) -> tuple[np.ndarray, np.ndarray]:
        low, high = interval_bounds.natural_extension(code, np.array([[a]]), np.array([[b]]))
        return low[:, 0], high[:, 0]

    return offsets


def _can_be_active_together(
    constraints: Sequence[Constraint], states: Sequence[int], J: Sequence[int], rho: float, offsets: OffsetBounds
) -> tuple[bool, np.ndarray | None]:
    """Whether {all g_i >= 0, g_j <= rho for j in J} may be met, and a point (t, q) near to which it is, where that was settled.

    The interval of time is halved where a part cannot be excluded, until one is as short as ``SHORT``.
    """
    t0, t1 = float(constraints[0].lower[0]), float(constraints[0].upper[0])
    if not any(c.shape.time for c in constraints) or t1 <= t0:
        at = _feasible_point(constraints, states, J, rho, t0, t0, offsets)
        return at is not None, at
    cuts = np.linspace(t0, t1, INITIAL_SLICES + 1)
    parts = [(float(a), float(b)) for a, b in pairwise(cuts)][::-1]
    for _ in range(MAX_SLICES):
        if not parts:
            return False, None
        a, b = parts.pop()
        at = _feasible_point(constraints, states, J, rho, a, b, offsets)
        if at is not None and b - a <= MIN_SLICE_FRACTION * (t1 - t0):
            return True, at
        if at is not None:
            parts += [((a + b) / 2, b), (a, (a + b) / 2)]
    return bool(parts), None


def _feasible_point(
    constraints: Sequence[Constraint],
    states: Sequence[int],
    J: Sequence[int],
    rho: float,
    a: float,
    b: float,
    offsets: OffsetBounds,
) -> np.ndarray | None:
    """A point of the set, loosened by 1e-9 and by what the offsets change over a <= t <= b; None where it is empty (exact)."""
    low, high = offsets(a, b)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return np.append((a + b) / 2, np.zeros(len(states)))
    place, n, p = {i: k for k, i in enumerate(states)}, len(states), len(constraints)
    loose = 1e-9 * (max(rho, float(np.abs(np.concatenate([low, high])).max())) or 1.0)
    # Columns: q, the homogenising h > 0, a slack > 0 for each row.
    A = exact.zeros(p + len(J), n + 1 + p + len(J))
    for row, (i, sign) in enumerate([*((i, 1) for i in range(p)), *((j, -1) for j in J)]):
        for state, value in constraints[i].shape.written.affine.row.items():
            A[row, place[state]] = sign * value
        A[row, n] = Fraction(float(high[i] + loose if sign > 0 else rho - low[i] + loose))
        A[row, n + 1 + row] = Fraction(-1)
    answer = decide_feasibility(ConicSystem(A, tuple(range(n, A.shape[1]))))
    if answer.separator is not None:
        return None
    q = np.zeros(n) if answer.point is None else np.array([float(x / answer.point[n]) for x in answer.point[:n]])
    return np.append((a + b) / 2, q)
