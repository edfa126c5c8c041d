"""Proved bounds on pieces as they are stored: of the defect, of the rows of the law, and of every sign condition of the mode.

What interval arithmetic proves of the pieces of a run, beside what was asked: the certificate of `certify="interval"`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import EPS
from nsmodel.event_driven.bernstein import taylor_shift
from nsmodel.event_driven.interval_series import (
    IntervalCoefficients,
    IntervalSeries,
    PieceParts,
    coefficients_over_interval,
    compute_interval_series,
    polynomial_lower_bounds,
    radius_powers,
    subdivide_pieces,
)
from nsmodel.event_driven.modes import INTEGER_RANGES
from nsmodel.event_driven.problem import ContinuousProblem
from nsmodel.event_driven.recurrences import Branch, TaylorRecurrences, taylor_decompose
from nsmodel.event_driven.step_size import MULTIPLIERS
from nsmodel.proof.interval_arithmetic import next_up
from nsmodel.proof.interval_functions import ZERO_INTERVAL, Interval, point_intervals

DOUBLINGS, SHARE = 4, 0.5  # A piece is cut while remainders are more than this share of its bounds, into 16 parts at most.
SIGNIFICANT_DEPTH = 1e-12  # A depth below this share of a condition is rounding, as TIE: no piece is cut for it. (+)


class StoredPieces(NamedTuple):
    """Pieces as `run.at` evaluates them: [start, end] (K,), unit (K,), x (K, n, p + 1), l, y (K, m, p + 1), codes (K, m)."""

    start: np.ndarray
    end: np.ndarray
    unit: np.ndarray
    x: np.ndarray
    l: np.ndarray
    y: np.ndarray
    codes: np.ndarray

    @property
    def lengths(self) -> np.ndarray:
        """Of the pieces, in their units, and not less."""
        return next_up(self.end - self.start) / self.unit


class PieceBounds(NamedTuple):
    """What is proved of each of K pieces, for all of its times.

    Attributes:
        defect: (K, n) |x' - f - g| is at most this.
        integral: (K, n) the integral of |x' - f - g| over the piece is at most this.
        rows: (K, m) |y - h|, and of a held row |h|, are at most this; inf where l of another row is not its end exactly.
        slopes: (K, m) |dh/dt| of a held row is at most this.
        least: (K, 2, c) each sign condition is at least this, on the first and on the second half of the piece; those of the
            rows, then of the branches; inf where there is none.
        reach: (K, c) and >= 0 further than this, in time, from the ends of the piece.
        size: (c,) the largest that each condition may be.
    """

    defect: np.ndarray
    integral: np.ndarray
    rows: np.ndarray
    slopes: np.ndarray
    least: np.ndarray
    reach: np.ndarray
    size: np.ndarray

    @property
    def depth(self) -> np.ndarray:
        """(K, c) each sign condition is at least minus this."""
        return np.maximum(-self.least.min(axis=1), 0.0)


def prove_piece_bounds(problem: ContinuousProblem, stored: StoredPieces) -> PieceBounds:
    """Prove what can be proved; inf where there is no bound.

    Raises:
        OpaqueExpression: f, g or h calls a Function that cannot be looked into.
    """
    out = ca.vertcat(problem.f + problem.g, problem.h)
    recurrences = taylor_decompose(out, [problem.t, problem.x, problem.l], "f, g or h", rounded=False)
    ends = [np.array(ca.DM(end)).ravel() for end in (problem.law.lower, problem.law.upper)]
    counts = np.ones(len(stored.start), int)
    parts = subdivide_pieces(stored.lengths, counts)
    with np.errstate(all="ignore"):
        found, share = _bounds_on_parts(recurrences, stored, parts, ends)
        for _ in range(DOUBLINGS):
            coarse = np.zeros(len(counts), bool)
            np.logical_or.at(coarse, parts.piece, share > SHARE)
            if not coarse.any():
                break
            finer, kept = subdivide_pieces(stored.lengths, np.where(coarse, 2 * counts, 0)), ~coarse[parts.piece]
            counts = np.where(coarse, 2 * counts, counts)
            new, more = _bounds_on_parts(recurrences, stored, finer, ends)
            parts = PieceParts(*(np.concatenate([a[kept], b]) for a, b in zip(parts, finer, strict=True)))
            found = PieceBounds(*(np.concatenate([a[kept], b]) for a, b in zip(found, new, strict=True)))
            share = np.concatenate([share[kept], more])
    return _merge_parts(found, parts, stored, counts)


def _merge_parts(found: PieceBounds, parts: PieceParts, stored: StoredPieces, counts: np.ndarray) -> PieceBounds:
    """Parts together, as pieces."""
    second = (counts[parts.piece] > 1) & (parts.centre > stored.lengths[parts.piece] / 2)
    first = (counts[parts.piece] > 1) & ~second
    both = found.least.min(axis=1)
    sides = [
        np.where(other[:, None], np.inf, np.where(whole[:, None], both, found.least[:, side]))
        for side, (whole, other) in enumerate([(first, second), (second, first)])
    ]

    def max_over_parts(values: np.ndarray) -> np.ndarray:
        total = np.full((len(counts), *values.shape[1:]), -np.inf)
        np.maximum.at(total, parts.piece, values)
        return total

    integral = np.zeros((len(counts), found.integral.shape[1]))
    np.add.at(integral, parts.piece, found.integral)
    return PieceBounds(
        max_over_parts(found.defect), integral * (1 + 64 * EPS), max_over_parts(found.rows), max_over_parts(found.slopes),
        -max_over_parts(-np.stack(sides, axis=1)), max_over_parts(found.reach), found.size.max(axis=0, initial=0.0),
    )  # fmt: skip


def piece_ranges(stored: StoredPieces, count: int) -> tuple[Interval, Interval]:
    """T (K count,) and x (K count, n) on ``count`` parts of each piece."""
    parts = subdivide_pieces(stored.lengths, np.full(len(stored.start), count))
    start, unit = point_intervals(stored.start[parts.piece]), point_intervals(stored.unit[parts.piece])
    s = point_intervals(parts.centre) + Interval(-parts.radius, parts.radius)
    c = [point_intervals(np.ascontiguousarray(stored.x[parts.piece, :, k].T)) for k in range(stored.x.shape[2])]
    local = [
        a * b
        for a, b in zip(taylor_shift(c, point_intervals(parts.centre)), radius_powers(parts.radius, len(c) - 1), strict=True)
    ]
    spread = _magnitude_bound([ZERO_INTERVAL, *local[1:]])
    x = local[0] + Interval(-spread, spread)
    return start + unit * s, Interval(x.lo.T, x.hi.T)


class _PartPolynomials(NamedTuple):
    """Coefficients on parts in u = (s - centre)/radius, the last an interval over the part: x, l, y, x' - f - g, h, branches."""

    x: list[IntervalCoefficients]
    l: list[IntervalCoefficients]
    y: list[IntervalCoefficients]
    defect: list[IntervalCoefficients]
    h: list[IntervalCoefficients]
    branches: list[IntervalCoefficients]
    choice: list[Any]


def _bounds_on_parts(
    recurrences: TaylorRecurrences, stored: StoredPieces, parts: PieceParts, ends: list[np.ndarray]
) -> tuple[PieceBounds, np.ndarray]:
    """The bounds of B parts, sizes (B, c), and the largest share of one that is remainder (B,)."""
    p, codes = _polynomials_on_parts(recurrences, stored, parts), stored.codes[parts.piece]
    held = codes == 0
    residual = [_subtract_series(y, h) for y, h in zip(p.y, p.h, strict=True)]
    at_end = [
        _magnitude_bound([l[0] - point_intervals(np.where(code > 0, ends[1][i], ends[0][i])), *l[1:]])
        for i, (l, code) in enumerate(zip(p.l, codes.T, strict=True))
    ]
    size, moved = (
        _stack_columns([_magnitude_bound(h) for h in p.h], len(held)),
        [[(k + 1) * a for k, a in enumerate(h[1:])] for h in p.h],
    )
    rows = np.maximum(
        _stack_columns([_magnitude_bound(c) for c in residual], len(held)),
        np.where(held, size, np.where(_stack_columns(at_end, len(held)) > 0, np.inf, 0.0)),
    )
    slopes = _stack_columns([_magnitude_bound(c) for c in moved], len(held)) / (parts.radius * stored.unit[parts.piece])[:, None]
    lowest, reach, sizes, loose = _sign_bounds(
        list(_sign_polynomials(p, recurrences.branches, codes, ends)), stored, parts, len(p.h) + len(p.branches)
    )
    remainders = [c[-1].magnitude / np.maximum(_magnitude_bound(c), 1e-300) for c in [*p.defect, *residual]]
    share = np.max([loose, *(np.where(np.isnan(one), 1.0, one) for one in remainders)], axis=0)
    width = 2 * parts.radius * stored.unit[parts.piece] * (1 + 4 * EPS)
    integral = [_magnitude_bound([a / (k + 1) for k, a in enumerate(c)]) * width for c in p.defect]
    defect = _stack_columns([_magnitude_bound(c) for c in p.defect], len(held))
    slopes = np.where(held, next_up(slopes * (1 + 4 * EPS)), 0.0)
    return PieceBounds(defect, _stack_columns(integral, len(held)), rows, slopes, lowest, reach, sizes), share


def _stack_columns(arrays: Sequence[np.ndarray], count: int) -> np.ndarray:
    return np.stack([np.broadcast_to(a, count) for a in arrays], axis=1) if arrays else np.zeros((count, 0))


def _polynomials_on_parts(recurrences: TaylorRecurrences, stored: StoredPieces, parts: PieceParts) -> _PartPolynomials:
    n, m, N = stored.x.shape[1], stored.l.shape[1], stored.x.shape[2] - 1
    stacked = np.concatenate([stored.x, stored.l, stored.y], axis=1)[parts.piece]
    c = [point_intervals(np.ascontiguousarray(stacked[:, :, k].T)) for k in range(N + 1)]
    local = taylor_shift(c, point_intervals(parts.centre))
    over = coefficients_over_interval(local, np.broadcast_to(parts.radius, stacked.shape[1::-1]))
    at, whole = ([[Interval(a.lo[i], a.hi[i]) for a in rows] for i in range(stacked.shape[1])] for rows in (local, over))
    tau, r = point_intervals(stored.unit[parts.piece]), radius_powers(parts.radius, N)
    low, high = _equation_series(recurrences, stored, parts, (at, whole), n, m)
    f, branches = (
        [[*one[:N], other[N]] for one, other in zip(a, b, strict=True)]
        for a, b in ((low.outputs, high.outputs), (low.branches, high.branches))
    )
    rates = [[*((k + 1) * a / tau for k, a in enumerate(row[1:])), ZERO_INTERVAL] for row in at[:n]]
    defect = [_subtract_series(rate, own) for rate, own in zip(rates, f[:n], strict=True)]
    lists = (at[:n], at[n : n + m], at[n + m :], defect, f[n:], branches)
    x, l, y, defect, h, branches = ([[a * b for a, b in zip(c, r, strict=True)] for c in one] for one in lists)
    return _PartPolynomials(x, l, y, defect, h, branches, low.choice)


def _equation_series(
    recurrences: TaylorRecurrences, stored: StoredPieces, parts: PieceParts, rows: tuple[list, list], n: int, m: int
) -> tuple[IntervalSeries, IntervalSeries]:
    """Of f + g and h about the centres, and about all points of parts."""
    N, tau, start = stored.x.shape[2] - 1, point_intervals(stored.unit[parts.piece]), point_intervals(stored.start[parts.piece])
    off = (tau * point_intervals(parts.radius)).hi
    middle = start + tau * point_intervals(parts.centre)
    found: list[IntervalSeries] = []
    for time, given in zip((middle, middle + Interval(-off, off)), rows, strict=True):
        t: IntervalCoefficients = [time, tau, *[ZERO_INTERVAL] * (N - 1)]
        inputs = {(0, 0): t} | {(1, i): given[i] for i in range(n)} | {(2, i): given[n + i] for i in range(m)}
        found.append(compute_interval_series(recurrences, inputs, N, found[0].choice if found else None))
    return found[0], found[1]


class _SignPolynomial(NamedTuple):
    """A polynomial that is >= 0 as long as switch ``column`` stays, where ``mask`` holds."""

    column: int
    mask: np.ndarray
    c: IntervalCoefficients
    size: np.ndarray


def _sign_polynomials(
    p: _PartPolynomials, kinds: Sequence[Branch], codes: np.ndarray, ends: list[np.ndarray]
) -> Iterator[_SignPolynomial]:
    m = len(p.h)
    for i, (h, l) in enumerate(zip(p.h, p.l, strict=True)):
        code = codes[:, i]
        for sign, end in ((-1, ends[1][i]), (1, ends[0][i])):
            yield _SignPolynomial(i, (code == -sign) & (ends[0][i] < ends[1][i]), _with_sign(h, sign), _magnitude_bound(h))
            if np.isfinite(end):
                yield _SignPolynomial(i, code == 0, _with_sign([l[0] - float(end), *l[1:]], sign), _magnitude_bound(l))
    for k, (branch, c, side) in enumerate(zip(kinds, p.branches, p.choice, strict=True)):
        everywhere = np.ones(len(codes), bool)
        if branch.kind in ("side", "equal"):
            for sign in (-1, 1):
                yield _SignPolynomial(
                    m + k, everywhere & ((side == sign) | (side == 0)), _with_sign(c, sign), _magnitude_bound(c)
                )
            continue
        below, above = INTEGER_RANGES[branch.kind](side.lo)
        yield _SignPolynomial(m + k, everywhere, [c[0] - point_intervals(below), *c[1:]], _magnitude_bound(c))
        yield _SignPolynomial(m + k, everywhere, _with_sign([c[0] - point_intervals(above), *c[1:]], -1), _magnitude_bound(c))


def _sign_bounds(watched: list[_SignPolynomial], stored: StoredPieces, parts: PieceParts, columns: int) -> tuple[np.ndarray, ...]:
    """How deep below 0, where, and the size of each switch, on parts; and the largest share of a depth that is remainder."""
    B, S, tau = len(parts.piece), stored.lengths[parts.piece], stored.unit[parts.piece]
    lowest, reach, size, loose = np.full((B, 2, columns), np.inf), np.zeros((B, columns)), np.zeros((B, columns)), np.zeros(B)
    begin, end = parts.centre - parts.radius, parts.centre + parts.radius
    for one in watched:
        rows = np.flatnonzero(one.mask)
        if not rows.size:
            continue
        c = [Interval(*(np.broadcast_to(limit, B)[rows] for limit in (a.lo, a.hi))) for a in one.c]
        own = np.broadcast_to(one.size, B)[rows]
        low, far = polynomial_lower_bounds(c, len(rows))
        deep = -low.min(axis=0)
        loose[rows] = np.maximum(
            loose[rows], np.where(deep > SIGNIFICANT_DEPTH * own, np.nan_to_num(c[-1].magnitude / deep, nan=1.0), 0.0)
        )
        left, right = far * parts.radius[rows]
        left = np.where(left > 0, np.minimum(begin[rows] + left, S[rows] - begin[rows]), 0.0)
        right = np.where(right > 0, np.minimum(end[rows], S[rows] - end[rows] + right), 0.0)
        lowest[rows, :, one.column] = np.minimum(lowest[rows, :, one.column], low.T)
        reach[rows, one.column] = np.maximum(reach[rows, one.column], np.maximum(left, right) * tau[rows] * (1 + 8 * EPS))
        size[rows, one.column] = np.maximum(size[rows, one.column], own)
    return lowest, reach, size, loose


def _with_sign(c: IntervalCoefficients, sign: int) -> IntervalCoefficients:
    return c if sign > 0 else [-a for a in c]


def _subtract_series(a: IntervalCoefficients, b: IntervalCoefficients) -> IntervalCoefficients:
    return [one - other for one, other in zip(a, b, strict=True)]


def _magnitude_bound(c: IntervalCoefficients) -> np.ndarray:
    """A bound of |sum c_k u^k| on [-1, 1]."""
    total = sum((a.magnitude for a in c), np.zeros(1))
    return np.where(np.isnan(total), np.inf, total * (1 + (len(c) + 1) * EPS))


MAX_REPORTED_FAILURES = 10  # Failures that are told, of many.


@dataclass(frozen=True)
class AllowedErrors:
    """What bounds are measured beside, (n,) and (m,): a jump or the integral of a defect, and what is wrong with a row."""

    state: np.ndarray
    row: np.ndarray
    rtol: float

    @staticmethod
    def of(rtol: float, atol: np.ndarray, x: np.ndarray, y: np.ndarray) -> AllowedErrors:
        """Rtol of the largest x, and MULTIPLIERS rtol of the largest terms of y."""
        return AllowedErrors(rtol * x + atol, MULTIPLIERS * rtol * y, rtol)


@dataclass(frozen=True)
class ProofFailure:
    """What is not proved of piece ``piece``, from t to ``until``."""

    piece: int
    t: float
    until: float
    what: str


@dataclass(frozen=True)
class IntervalProof:
    """Proved bounds of K pieces; see `bounds.Bounds`.

    Attributes:
        bounds: of the pieces.
        jump: (K, n) how far x at the start of a piece is at most from the end of the piece before, of the first from x0. Of an
            impulse nothing is proved: a start that jumps is a failure.
        share: (K,) the integral of the defect over the piece, in units of what is allowed.
        proved: (K,) whether all is within what is allowed.
        failures: what is not.
        conditions: names of the sign conditions.
    """

    bounds: PieceBounds
    jump: np.ndarray
    share: np.ndarray
    proved: np.ndarray
    failures: tuple[ProofFailure, ...]
    conditions: tuple[str, ...]


def certify_pieces(problem: ContinuousProblem, stored: StoredPieces, x0: np.ndarray, allowed: AllowedErrors) -> IntervalProof:
    """Prove what can be proved of the pieces as they are stored."""
    found, jump = prove_piece_bounds(problem, stored), jump_bounds(stored, x0)
    with np.errstate(all="ignore"):
        share = np.nan_to_num(found.integral / allowed.state, nan=0.0, posinf=np.inf).max(axis=1, initial=0.0)
    conditions = (*problem.rows, *(f"switch {k} of f, g and h" for k in range(found.depth.shape[1] - len(problem.rows))))
    failures = tuple(_proof_failures(problem, stored, found, jump, allowed, conditions))
    proved = np.ones(len(stored.start), bool)
    proved[[failure.piece for failure in failures]] = False
    return IntervalProof(found, jump, share, proved, failures, conditions)


def state_enclosures(stored: StoredPieces, number: np.ndarray, t: np.ndarray) -> Interval:
    """X (k, n) at times t (k,) on the pieces of these numbers."""
    s = (point_intervals(t) - point_intervals(stored.start[number])) / point_intervals(stored.unit[number])
    s, x = Interval(s.lo[:, None], s.hi[:, None]), point_intervals(stored.x[number, :, -1])
    for k in reversed(range(stored.x.shape[2] - 1)):
        x = x * s + point_intervals(stored.x[number, :, k])
    return x


def jump_bounds(stored: StoredPieces, x0: np.ndarray) -> np.ndarray:
    """(K, n) bounds of |x at the start of a piece - x at the end of the one before|."""
    x = state_enclosures(stored, np.arange(len(stored.start) - 1), stored.end[:-1])
    before = Interval(np.concatenate([x0[None], x.lo]), np.concatenate([x0[None], x.hi]))
    return (point_intervals(stored.x[:, :, 0]) - before).magnitude


def _proof_failures(
    problem: ContinuousProblem,
    stored: StoredPieces,
    found: PieceBounds,
    jump: np.ndarray,
    allowed: AllowedErrors,
    conditions: tuple[str, ...],
) -> Iterator[ProofFailure]:
    """What is beyond what is allowed, in the order of time."""
    low = MULTIPLIERS * allowed.rtol * found.size
    checks = [
        (found.integral, allowed.state, problem.names, "x' = f + g of '{}' is missed by up to {:.3g} in all over the piece"),
        (jump, allowed.state, problem.names, "'{}' jumps by up to {:.3g} where the piece begins"),
        (found.rows, allowed.row, problem.rows, "y = h of '{}' (or l at its end) is missed by up to {:.3g}"),
        (found.depth, low, conditions, "the sign condition of '{}' is only known to be above -{:.3g}"),
    ]
    failed = [
        (k, i, number)
        for number, (bound, limit, *_) in enumerate(checks)
        for k, i in zip(*np.nonzero(~(bound <= limit)), strict=True)
    ]
    for k, i, number in sorted(failed):
        bound, limit, names, template = checks[number]
        what = template.format(names[i], bound[k, i]) + f"; allowed: {limit[i]:.3g}"
        yield ProofFailure(int(k), float(stored.start[k]), float(stored.end[k]), what)
