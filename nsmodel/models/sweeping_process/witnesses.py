"""Witnesses that count: an admissible point where active constraints oppose each other, proved to exist.

Where constraints move, touching with opposing normals is a system of as many equations as unknowns,

    g_i(t, q) = 0 (i in J),     sum u_i grad g_i(t, q) = 0,     sum u_i = 1,

in (t, q, u), and an interval Newton step proves a solution in a small box; the others are shown to be > 0 there. At rest it has
one equation more than unknowns: then it is decided exactly, at points with rational coordinates.

The exact sign and gradient of a constraint at a point, in rational arithmetic on the given doubles.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import sum_in_order
from nsmodel.models.sweeping_process.admissible_points import PartialSweepingProcess
from nsmodel.models.sweeping_process.constraint_bounds import Constraint
from nsmodel.models.sweeping_process.constraint_shapes import AffineForm, Clip, Offset
from nsmodel.proof import exact
from nsmodel.proof.conic import ConicSystem, decide_feasibility
from nsmodel.proof.interval_bounds import enclose
from nsmodel.proof.krawczyk import enclose_zero

# A deficit below this part of the terms of a constraint may be the rounding of the user's own numbers: 4500 EPS.
ROUNDING_DEFICIT = 1e-12


def start_sign(c: Constraint, q0: np.ndarray) -> int | None:
    """Return the sign of g(0, q0), exactly; None where its form does not tell."""
    return sign_at(c, 0.0, {i: Fraction(float(q0[i])) for i in c.shape.own})


def sign_at(c: Constraint, t: float, q: Mapping[int, Fraction]) -> int | None:
    """Return the sign of g(t, q), exactly; None where its form does not tell.

    A distance w |u| - r has the sign of w^2 |u|^2 - r^2 where r >= 0.
    """
    form = c.shape.form
    if form is None or len(form.norms) > 1:
        return None
    rest, squares = _exact_affine_value(form.affine, t, q, c), _exact_squares(form.squares, t, q, c)
    if rest is None or squares is None:
        return None
    total = rest + squares
    if form.norms:
        w, under = form.norms[0]
        u2 = _exact_squares(under, t, q, c)
        if u2 is None or w < 0:
            return None
        return 1 if total >= 0 else _fraction_sign(w * w * u2 - total * total)
    return _fraction_sign(total)


def gradient_direction_at(c: Constraint, t: float, q: Mapping[int, Fraction]) -> dict[int, Fraction] | None:
    """Return a positive multiple of the gradient of g(t, .) at q, {state: entry}, exactly; None where its form does not tell.

    A clipped part minimises the distance that it occurs in: it adds nothing to the gradient.
    """
    form = c.shape.form
    if form is None or c.shape.kind == "other":
        return None
    total: dict[int, Fraction] = {} if form.norms else {i: value for i, value in form.affine.row.items() if i >= 0}
    for w, a in form.norms[0][1] if form.norms else form.squares:
        value = _exact_affine_value(a, t, q, c)
        if value is None:
            return None
        for i, entry in a.row.items():
            if i >= 0:
                total[i] = total.get(i, Fraction(0)) + 2 * w * value * entry
    return total


def _fraction_sign(x: Fraction) -> int:
    return (x > 0) - (x < 0)


def _exact_squares(
    squares: Sequence[tuple[Fraction, AffineForm]], t: float, q: Mapping[int, Fraction], c: Constraint
) -> Fraction | None:
    total = Fraction(0)
    for w, a in squares:
        value = _exact_affine_value(a, t, q, c)
        if value is None:
            return None
        total += w * value * value
    return total


def _exact_affine_value(a: AffineForm, t: float, q: Mapping[int, Fraction], c: Constraint) -> Fraction | None:
    total = _exact_offset(a.offset, t, c)
    for i, coefficient in a.row.items():
        part = q[i] if i >= 0 else _exact_clip_value(c.shape.clips[i], t, q, c)
        if part is None or total is None:
            return None
        total += coefficient * part
    return total


def _exact_clip_value(clip: Clip, t: float, q: Mapping[int, Fraction], c: Constraint) -> Fraction | None:
    value = _exact_affine_value(clip.a, t, q, c)
    if value is None:
        return None
    value = value if clip.low is None else max(value, clip.low)
    return value if clip.high is None else min(value, clip.high)


def _exact_offset(offset: Offset, t: float, c: Constraint) -> Fraction | None:
    """An offset where it folds to a number whose operations are exact: at t = 0 sin t, cos t, exp t."""
    if isinstance(offset, Fraction):
        return offset
    low, high = (float(np.ravel(end)[0]) for end in enclose(offset, c.t, np.full(1, t), np.full(1, t)))
    return Fraction(low) if low == high else None


MIN_WEIGHT = 1e-7  # Of weights whose sum is 1: a smaller one counts as 0, as it may be the error of a search.
# Denominators of rational points that are tried: 1e6 has as many digits as numbers in a model.
DENOMINATORS = (1, 10, 1000, 10**6)
# Parts of the box by which a point is moved off the constraints: the first that is proved counts, the least is the sharpest.
INWARD_FRACTIONS = (1e-3, 1e-6, 1e-9)


class OpposingGradients(NamedTuple):
    """Constraints ``rows`` with weights u > 0, sum u_i grad g_i = 0, active near the point ``at`` (t, q) at an admissible one."""

    rows: tuple[int, ...]
    weights: tuple[float, ...]
    at: np.ndarray
    how: str


def prove_opposition(
    constraints: Sequence[Constraint], process: PartialSweepingProcess, rows: np.ndarray, weights: np.ndarray, at: np.ndarray
) -> OpposingGradients | None:
    """Return a proof that constraints oppose each other in contact near ``at`` (t, q), or None."""
    used = [int(k) for k, u in zip(rows, weights, strict=True) if u > MIN_WEIGHT]
    if len(used) < 2 or not np.isfinite(at).all():
        return None
    start = np.array([u for u in weights if u > MIN_WEIGHT])
    return _prove_exactly(constraints, process, used, at) or _prove_in_motion(constraints, process, used, start / start.sum(), at)


# -- at rest -----------------------------------------------------------------------------------------------------------


def _prove_exactly(
    constraints: Sequence[Constraint], process: PartialSweepingProcess, used: list[int], at: np.ndarray
) -> OpposingGradients | None:
    for t, q in _rational_points(constraints, process, used, at):
        state = dict(zip(process.columns, q, strict=True))
        if any(sign_at(constraints[k], t, state) != 0 for k in used):
            continue
        weights = cancelling_weights([gradient_direction_at(constraints[k], t, state) for k in used])
        if weights is None:
            continue
        rest = [k for k in range(len(constraints)) if k not in used]
        if all((sign := sign_at(constraints[k], t, state)) is not None and sign >= 0 for k in rest):
            point = np.append(t, [float(x) for x in q])
            return OpposingGradients(tuple(used), weights, point, "decided exactly")
    return None


def cancelling_weights(directions: Sequence[dict[int, Fraction] | None]) -> tuple[float, ...] | None:
    """Weights u > 0, sum 1, with which unit normals of these directions cancel (exactly); None where there are none."""
    known = [direction for direction in directions if direction is not None and any(direction.values())]
    if len(known) < len(directions):
        return None
    states = sorted({i for direction in known for i in direction})
    A = exact.zeros(len(states), len(known))
    for k, direction in enumerate(known):
        for i, value in direction.items():
            A[states.index(i), k] = value
    point = decide_feasibility(ConicSystem(A, tuple(range(len(known))))).point
    if point is None:
        return None
    size = [sum_in_order(float(x) ** 2 for x in direction.values()) ** 0.5 for direction in known]
    u = np.array([float(x) * s for x, s in zip(point, size, strict=True)])
    return tuple(float(x) for x in u / u.sum())


def _rational_points(
    constraints: Sequence[Constraint], process: PartialSweepingProcess, used: list[int], at: np.ndarray
) -> Iterator[tuple[float, list[Fraction]]]:
    own = [constraints[k] for k in used]
    moving = any(c.shape.time for c in constraints)
    times = dict.fromkeys(float(t) for t in (at[0], process.lower[0], process.upper[0], round(at[0], 6)) if abs(t - at[0]) < 1e-6)
    if all(c.shape.kind == "plane" for c in own):
        point = _common_plane_point(constraints, process, used)
        if point is not None:
            yield float(at[0]), point
    q = [Fraction(float(x)) for x in at[1:]]
    for t in times if moving else (float(at[0]),):
        yield t, q
        yield from ((t, [x.limit_denominator(number) for x in q]) for number in DENOMINATORS)
        yield from ((t, [Fraction(round(float(x), digits)) for x in q]) for digits in (1, 2, 3, 6, 9))
    touch = _touching_point(own, process)
    if touch is not None:
        yield float(at[0]), touch


def _touching_point(own: Sequence[Constraint], process: PartialSweepingProcess) -> list[Fraction] | None:
    """Where two balls of fixed place and radius touch: on the line between their centres."""
    balls = [ball for c in own if (ball := fixed_ball(c)) is not None]
    if len(own) != 2 or len(balls) != 2 or tuple(sorted(balls[0][0])) != tuple(sorted(process.columns)):
        return None
    (a, r), (b, s) = balls
    if a.keys() != b.keys():
        return None
    return [a[i] + (b[i] - a[i]) * r / (r + s) for i in process.columns]


def fixed_ball(c: Constraint) -> tuple[dict[int, Fraction], Fraction] | None:
    """(centre, radius) where {g >= 0} is the outside of a ball that does not move: w |a (q - centre)| - r."""
    form = c.shape.form
    if c.shape.kind != "distance" or c.shape.clips or form is None or not isinstance(form.affine.offset, Fraction):
        return None
    w, squares = form.norms[0]
    centre: dict[int, Fraction] = {}
    scales = set()
    for v, a in squares:
        if len(a.row) != 1 or not isinstance(a.offset, Fraction):
            return None
        ((i, x),) = a.row.items()
        if i < 0 or i in centre:
            return None
        centre[i] = -a.offset / x
        scales.add(v * x * x)
    if len(scales) != 1 or len(centre) != len(c.shape.own):
        return None
    (square,) = scales
    scale = Fraction(float(square) ** 0.5)
    r = -form.affine.offset
    return (centre, r / (w * scale)) if scale * scale == square and r > 0 else None


def _common_plane_point(
    constraints: Sequence[Constraint], process: PartialSweepingProcess, used: list[int]
) -> list[Fraction] | None:
    """A point on some fixed planes and on the admissible side of all others."""
    if any(c.shape.kind != "plane" or c.shape.time for c in constraints):
        return None
    n, place = len(process.columns), {j: k for k, j in enumerate(process.columns)}
    rest = [k for k in range(len(constraints)) if k not in used]
    A = exact.zeros(len(constraints), n + 1 + len(rest))
    for k, c in enumerate(constraints):
        for i, value in c.shape.written.affine.row.items():
            A[k, place[i]] = value
        A[k, n] = c.shape.written.affine.offset
        if k in rest:
            A[k, n + 1 + rest.index(k)] = Fraction(-1)
    point = decide_feasibility(ConicSystem(A, tuple(range(n, A.shape[1])))).point
    return None if point is None else [x / point[n] for x in point[:n]]


# -- in motion ---------------------------------------------------------------------------------------------------------


def _prove_in_motion(
    constraints: Sequence[Constraint], process: PartialSweepingProcess, used: list[int], weights: np.ndarray, at: np.ndarray
) -> OpposingGradients | None:  # fmt: skip
    g = process.g[used]
    if not process.lower[0] < process.upper[0] or not ca.depends_on(g, process.t):
        return None
    own = [j for j in range(len(process.columns)) if ca.depends_on(g, process.q[j])]
    rest = [j for j in range(len(process.columns)) if j not in own]
    g = ca.substitute(g, process.q[rest], ca.DM(at[1:][rest])) if rest else g
    slopes = ca.jacobian(g, process.q[own])
    u, fixed = ca.SX.sym("u", len(used)), None
    if all(constraints[k].shape.kind == "plane" for k in used):
        fixed = cancelling_weights([dict(constraints[k].shape.written.affine.row) for k in used])
    widths = (process.upper - process.lower)[[0, *(1 + j for j in own)]]
    size, z = np.where(widths > 0, widths, 1.0), ca.vertcat(process.t, process.q[own])
    if fixed is not None:
        F, start = g, at[[0, *(1 + j for j in own)]]
    else:
        lengths = np.linalg.norm(np.array(ca.Function("G", [z], [ca.densify(slopes)])(at[[0, *(1 + j for j in own)]])), axis=1)
        if not (np.isfinite(lengths).all() and lengths.all()):
            return None
        total = sum((u[k] / lengths[k] * slopes[k, :] for k in range(len(used))), ca.SX(1, len(own)))
        F, z = ca.vertcat(g, ca.vec(total), ca.sum1(u) - 1), ca.vertcat(z, u)
        start, size = np.concatenate([at[[0, *(1 + j for j in own)]], weights]), np.concatenate([size, np.ones(len(used))])
    zero = enclose_zero(F, z, start, size)
    if zero is None:
        return None
    lower, upper = at.copy(), at.copy()
    ends = [0, *(1 + j for j in own)]
    lower[ends], upper[ends] = zero.lower[: len(ends)], zero.upper[: len(ends)]
    if (
        (lower < process.lower).any()
        or (upper > process.upper).any()
        or (fixed is None and not (zero.lower[len(ends) :] > 0).all())
    ):
        return None
    if not _others_admit(process, used, lower, upper) or not _gradients_are_nonzero(process, used, lower, upper):
        return None
    how = f"an interval Newton step proves such a point within {float((upper - lower).max()):.1g} of the one shown"
    found = fixed if fixed is not None else tuple(float(x) for x in zero.middle[len(ends) :])
    return OpposingGradients(tuple(used), found, (lower + upper) / 2, how)


def _others_admit(process: PartialSweepingProcess, used: Sequence[int], lower: np.ndarray, upper: np.ndarray) -> bool:
    rest = [k for k in range(len(process.rows)) if k not in used]
    return not rest or bool((enclose(process.g[rest], process.z, lower, upper)[0] >= 0).all())


def _gradients_are_nonzero(process: PartialSweepingProcess, used: Sequence[int], lower: np.ndarray, upper: np.ndarray) -> bool:
    """Whether no gradient of these vanishes in a box."""
    lengths = ca.vertcat(*(ca.sumsqr(ca.jacobian(process.g[k], process.q)) for k in used))
    return bool((enclose(lengths, process.z, lower, upper)[0] > 0).all())


# -- how large gamma is at a point ---------------------------------------------------------------------------------------


def attained_gamma_bound(
    process: PartialSweepingProcess, rows: np.ndarray, weights: np.ndarray, at: np.ndarray, rho: float
) -> float:
    """Return a proved lower bound of gamma(rho) from constraints with weights near a point (t, q); 1 where there is none.

    For rho > 0 the point is moved off the constraints, to where all are > 0 and these still within rho; for rho = 0 a box in
    which it is exactly on them is shown to exist.
    """
    used = [int(k) for k, u in zip(rows, weights, strict=True) if u > MIN_WEIGHT]
    if len(used) < 2 or not np.isfinite(at).all():
        return 1.0
    u = np.array([x for x in weights if x > MIN_WEIGHT])
    hull = ca.SX(1, len(process.columns))
    for k, weight in zip(used, u / u.sum(), strict=True):
        slope = ca.jacobian(process.g[k], process.q)
        hull += float(weight) * slope / ca.norm_2(slope)
    total = ca.sumsqr(hull)
    for lower, upper in _candidate_boxes(process, used, hull, at, rho):
        inside = (lower >= process.lower).all() and (upper <= process.upper).all()
        if inside and _others_admit(process, used, lower, upper):
            high = float(enclose(total, process.z, lower, upper)[1].item())
            if 0 < high < 1:
                return float(1 / np.sqrt(high)) * (1 - 1e-14)
    return 1.0


def _candidate_boxes(
    process: PartialSweepingProcess, used: list[int], hull: ca.SX, at: np.ndarray, rho: float
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    if rho > 0:
        away = np.array(ca.Function("hull", [process.z], [ca.densify(hull)])(at)).ravel()
        size = np.linalg.norm(away)
        for part in INWARD_FRACTIONS if np.isfinite(size) and size > 0 else ():
            point = at.copy()
            point[1:] += part * min(rho, process.size) * away / size
            low, high = (end.ravel() for end in enclose(process.g[used], process.z, point, point))
            if (low >= 0).all() and (high <= rho).all():
                yield point, point
        return
    if len(used) <= len(process.columns):
        g = ca.substitute(process.g[used], process.t, float(at[0]))
        zero = enclose_zero(
            g, process.q, at[1:], np.where(process.upper[1:] > process.lower[1:], (process.upper - process.lower)[1:], 1.0)
        )
        if zero is not None:
            yield np.append(at[0], zero.lower), np.append(at[0], zero.upper)
