"""The tangents of recorded pieces: on each part of one, S at its end as an affine function of S at its begin.

S' = 𝒜 S + β on a piece, with 𝒜 = F_x + F_l Λ and β = F_p + F_l λ along its polynomials. Each part of a piece is one step of
Radau IIA, 8 stages, of order 15, and two of half the length: where these differ by more than is allowed of the largest entry of a
column the part is halved. The accuracy of S so is that of S: where x rests its piece says nothing of how fast S moves. All parts
are taken at once, as arrays.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import NamedTuple

import numpy as np

from nsmodel._utils import EPS
from nsmodel.derivatives.tangent_equations import LinearisedEquations, ModeRows, Slopes, TangentEquations, multiplier_slopes
from nsmodel.event_driven.collocation import radau_collocation
from nsmodel.event_driven.dense_output import evaluate_polynomials
from nsmodel.simulation.piece_sources import PieceBuffer

TINY = float(np.finfo(float).tiny)  # The least speed that is divided by.
STAGES = 8  # Of a step of Radau IIA: order 15. With 4 or 16 S differs by 2e-11 at most, at rtol 1e-8.
# JUST_AFTER: well above EPS.
JUST_AFTER = 1e-9  # Of a piece: where it is looked at if a block begins to slip, whose direction is 0/0 at the begin. (+)
# STOP_PART: half of the digits are left there.
STOP_PART = 1e-7  # Of a piece: that near to a stop the slopes of slip, like 1/|y|, are rounding. (+)
# MISSED: a piece with more of it ends before it is lost.
MISSED = 1e-3  # Of |y| at the begin of the piece before a stop: what is left of it at the end is error. (+)
POINTS_AT_ONCE = 4096  # Points at which matrices are in memory together: of 10 states 3 MB.


# TURN_POINTS: the parabola through three of them has a least value to a percent.
TURN_POINTS = 32  # Of a piece, at which it is looked for where conditions come near a switch. (+)
# TURN_ROUNDING: what is nearer to 0 has decayed, or is 0, and does not turn.
TURN_ROUNDING = 1e-12  # Of the largest value of a condition, as TIE. (+)


class Turn(NamedTuple):
    """Where a condition comes near a switch and turns back: its name, time, and least value beside the largest of the run."""

    name: str
    t: float
    distance: float


class TangentMaps(NamedTuple):
    """S -> by_start S + own, of J parts: (J, n, n) and (J, n, q); ``terms`` (J, q): what cancels in ``own``, beside the sizes."""

    by_start: np.ndarray
    own: np.ndarray
    terms: np.ndarray

    def after(self, first: TangentMaps) -> TangentMaps:
        """These after the ``first``, one by one."""
        own = self.by_start @ first.own + self.own
        return TangentMaps(self.by_start @ first.by_start, own, first.terms + self.terms)

    def __getitem__(self, which: np.ndarray) -> TangentMaps:  # pyrefly: ignore[bad-override]
        return TangentMaps(*(part[which] for part in self))


class TangentParts(NamedTuple):
    """Parts of pieces: the number of each one's piece, and where it begins and ends in the unit of that (J,)."""

    piece: np.ndarray
    begin: np.ndarray
    end: np.ndarray

    @property
    def halves(self) -> tuple[TangentParts, TangentParts]:
        """The first and the second half of each."""
        middle = (self.begin + self.end) / 2
        return TangentParts(self.piece, self.begin, middle), TangentParts(self.piece, middle, self.end)

    def __getitem__(self, which: np.ndarray) -> TangentParts:  # pyrefly: ignore[bad-override]
        return TangentParts(self.piece[which], self.begin[which], self.end[which])


def _ends_of_runs(codes: np.ndarray, piece: np.ndarray) -> np.ndarray:
    """Which of the points, of which the last of a piece is its end, are where its code (K,) becomes another."""
    changes = np.append(codes[1:] != codes[:-1], False)
    return changes[piece] & np.append(piece[1:] != piece[:-1], True)


class PieceTangents:
    """Recorded pieces with their linearised equations.

    Attributes:
        sizes: of the states (n,), by which what S is measured beside has one unit.
        stops: the rows (K, m) of blocks that slip on a piece and stick from its end on, where |y| comes down to its own error:
            across the direction of slip S is drawn to 0 there. frozen: from where on the slopes of slip stay (K,), in the unit
            of each piece; the end of others. rounding: how long before its stop |y| is as small as the rounding in it (K,).
    """

    def __init__(self, equations: TangentEquations, pieces: PieceBuffer, ends: np.ndarray) -> None:
        """``ends``: of the pieces, in the unit of each (K,); further states of the equations stand behind those of the pieces."""
        self.equations, self.pieces, self.ends = equations, pieces, ends
        n, m, _ = pieces.layout
        self._n, self._m, self.codes = n, m, pieces.codes
        self._series = pieces.series
        every = np.arange(pieces.count)
        middle = self.values(every, ends / 2)
        self.choices = equations.choices(*middle)
        y_by_l = self._at(every, middle).y.by_l
        self.mode_rows = ModeRows(*map(np.array, zip(*self._all_mode_rows(y_by_l), strict=True)))
        moved = (np.abs(self._series[:, :n]) * np.abs(ends)[:, None, None] ** np.arange(self._series.shape[2])).sum(axis=2)
        self.stops = self._stopping_rows()
        self._look_at_stops(moved)
        self.sizes = np.ones(equations.n)
        largest = moved.max(axis=0)
        self.sizes[:n] = np.where(largest > 0, largest, 1.0)

    def _stopping_rows(self) -> np.ndarray:
        found = np.zeros((len(self.codes), self._m), bool)
        for first, rows in self.equations.curved.items():
            found[:-1, rows] = ((self.codes[:-1, first] != 0) & (self.codes[1:, first] == 0))[:, None]
        return found

    def _look_at_stops(self, moved: np.ndarray) -> None:
        """How y comes to 0 at stops.

        A long piece comes down to its own error, where its direction is none: it is led to 0 exactly. Pieces that grow shorter,
        as the direction turns ever faster, end where |y| is still well above their error, and stay as they are.
        """
        self.frozen, self.rounding = self.ends.copy(), np.zeros(len(self.codes))
        self._left = np.zeros((len(self.codes), self._n))
        for k in np.flatnonzero(self.stops.any(axis=1)).tolist():
            both, at, rows = np.array([k, k]), np.array([0.0, self.ends[k]]), self.stops[k]
            x, y = self.values(both, at)[1], self._at(both, self.values(both, at)).y
            begin, end = np.linalg.norm(y.value[:, rows], axis=1)
            speed = max(np.linalg.norm(self.rates(both, at)[2][1, rows]) * self.pieces.tau[k], TINY)
            self.rounding[k] = EPS * np.linalg.norm(np.abs(y.by_x[1, rows, : self._n]) @ moved[k]) / speed
            if end < MISSED * begin:
                self._left[k] = self._series[k + 1, : self._n, 0] - x[1, : self._n]
                self.frozen[k] *= 1 - STOP_PART
            else:
                self.stops[k], self.rounding[k] = False, self.rounding[k] * self.ends[k] * speed / end

    @cached_property
    def onsets(self) -> np.ndarray:
        """Where pieces are looked at as they begin (K,): just after it where a block begins to slip, as its direction is 0/0."""
        firsts = list(self.equations.curved)
        found = np.zeros(len(self.codes))
        slips = (self.codes[1:, firsts] != 0) & (self.codes[:-1, firsts] == 0)
        found[1:] = np.where(slips.any(axis=1), JUST_AFTER * self.ends[1:], 0.0)
        return found

    def _all_mode_rows(self, y_by_l: np.ndarray) -> list[ModeRows]:
        modes = list(zip(self.codes, y_by_l, strict=True))
        keys = [codes.tobytes() + D.tobytes() for codes, D in modes]
        made = {key: self.equations.mode_rows(*mode) for key, mode in dict(zip(keys, modes, strict=True)).items()}
        return [made[key] for key in keys]

    def values(self, piece: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """T, x and l of pieces of these numbers at s (K,) in their units."""
        both = evaluate_polynomials(self._series[:, : self._n + self._m], piece, s)
        more = np.zeros((len(s), self.equations.n - self._n))
        t = self.pieces.t[piece] + self.pieces.tau[piece] * s
        return t, np.hstack([both[:, : self._n], more]), both[:, self._n :]

    def rates(self, piece: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """X', l' and y' of the polynomials."""
        slopes = self._series[:, :, 1:] * np.arange(1, self._series.shape[2])
        both = evaluate_polynomials(slopes, piece, s) / self.pieces.tau[piece, None]
        n, m = self._n, self._m
        return both[:, :n], both[:, n : n + m], both[:, n + m :]

    def _at(self, piece: np.ndarray, values: tuple[np.ndarray, np.ndarray, np.ndarray]) -> LinearisedEquations:
        return self.equations(*values, self.choices[piece])

    def linearised(self, piece: np.ndarray, s: np.ndarray) -> tuple[LinearisedEquations, np.ndarray, np.ndarray]:
        """The equations of pieces at s, and L = Λ S + λ there."""
        at = self._at(piece, self.values(piece, s))
        rows = ModeRows(*(part[piece] for part in self.mode_rows))
        if self.stops[piece].any():
            at = at._replace(slip=self._slip_before_stops(at.slip, piece, s))
        return at, *multiplier_slopes(at, rows, self.equations.end_slopes)

    def _slip_before_stops(self, slip: Slopes, piece: np.ndarray, s: np.ndarray) -> Slopes:
        """Slip where blocks stop at the ends of pieces: y leads to 0 exactly, and from just before it on the slopes stay."""
        near = self.stops[piece].any(axis=1)
        where = piece[near]
        t, x, l = self.values(where, np.minimum(s[near], self.frozen[where]))
        x[:, : self._n] += self._left[where]
        parts = [part.copy() for part in slip]
        for part, own in zip(parts, self._at(where, (t, x, l)).slip, strict=True):
            stops = self.stops[where].reshape(*own.shape[:2], *[1] * (own.ndim - 2))
            part[near] = np.where(stops, own, part[near])
        return Slopes(*parts)

    def flow(self, piece: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """𝒜 and β (K, n, n), (K, n, q) of pieces at s, and the size of the terms of β."""
        at, of_state, own = self.linearised(piece, s)
        by_l, by_p = at.rate.by_l, at.rate.by_p
        return at.rate.by_x + by_l @ of_state, by_p + by_l @ own, np.abs(by_p) + np.abs(by_l) @ np.abs(own)

    def nearest_turn(self) -> Turn | None:
        """The least value, to about a percent, that a condition has inside the run and not at its own switch."""
        piece = np.repeat(np.arange(len(self.ends)), TURN_POINTS)
        s = (self.ends[:, None] * np.arange(1, TURN_POINTS + 1) / TURN_POINTS).ravel()
        t, nearest = self.pieces.t[piece] + self.pieces.tau[piece] * s, None
        for name, values in self._conditions(piece, s):
            before, here, after = values[:-2], values[1:-1], values[2:]
            with np.errstate(invalid="ignore", divide="ignore"):
                minima = np.flatnonzero((here < before) & (here <= after))
                least = here - (after - before) ** 2 / (8 * (before - 2 * here + after))  # Of the parabola through the three.
            minima = minima[here[minima] > TURN_ROUNDING * np.nanmax(values, initial=0.0)]
            if not minima.size:
                continue
            k = minima[int(least[minima].argmin())]
            found = Turn(name, float(t[k + 1]), max(float(least[k]), 0.0) / float(np.nanmax(values)))
            nearest = found if nearest is None or found.distance < nearest.distance else nearest
        return nearest

    def _conditions(self, piece: np.ndarray, s: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
        """Name and values of each, NaN where it is none, and where it becomes 0 as its own switch."""
        n, m, equations = self._n, self._m, self.equations
        both, size = np.empty((len(s), n + 2 * m)), POINTS_AT_ONCE // TURN_POINTS
        for k in range(0, len(self.ends), size):
            here = slice(k * TURN_POINTS, (k + size) * TURN_POINTS)
            both[here] = evaluate_polynomials(self._series[k : k + size], piece[here] - k, s[here])
        curved = {i for rows in equations.curved.values() for i in range(rows.start, rows.stop)}
        for i in (i for i in range(m) if i not in curved):
            l, y, code = both[:, n + i], both[:, n + m + i], self.codes[piece, i]
            own = _ends_of_runs(self.codes[:, i], piece)
            for values, holds in ((np.abs(y), code != 0), *((np.abs(end[i] - l), code == 0) for end in equations.ends)):
                if np.isfinite(values).all():
                    yield equations.problem.rows[i], np.where(holds & ~own, values, np.nan)
        if equations.branches:
            t, more = self.pieces.t[piece] + self.pieces.tau[piece] * s, np.zeros((len(s), equations.n - n))
            watched = equations.watched(t, np.hstack([both[:, :n], more]), both[:, n : n + m], self.choices[piece])
            for b, branch in enumerate(equations.branches):
                own = _ends_of_runs(self.choices[:, b], piece)
                if branch.kind == "side":
                    yield equations.branch_names[b], np.where(own, np.nan, np.abs(watched[:, b]))

    def maps(self, parts: TangentParts) -> TangentMaps:
        """One step of Radau IIA over each part."""
        n, q, count = self.equations.n, self.equations.q, len(parts.piece)
        out = TangentMaps(np.zeros((count, n, n)), np.zeros((count, n, q)), np.zeros((count, q)))
        at_once = max(1, POINTS_AT_ONCE // STAGES)
        for first in range(0, count, at_once):
            chosen = np.arange(first, min(first + at_once, count))
            for part, made in zip(out, self._radau_steps(parts[chosen]), strict=True):
                part[chosen] = made
        return out

    def _radau_steps(self, parts: TangentParts) -> TangentMaps:
        table, n, q, count = radau_collocation(STAGES), self.equations.n, self.equations.q, len(parts.piece)
        s = parts.begin[:, None] + (parts.end - parts.begin)[:, None] * table.nodes
        A, b, terms = self.flow(np.repeat(parts.piece, STAGES), s.ravel())
        h = ((parts.end - parts.begin) * self.pieces.tau[parts.piece])[:, None, None, None]
        A = h * (A * (self.sizes / self.sizes[:, None])).reshape(count, STAGES, n, n)
        b, terms = (h * (part / self.sizes[:, None]).reshape(count, STAGES, n, q) for part in (b, terms))
        terms = terms.max(axis=(1, 2), initial=0.0) / (1 + np.abs(A).sum(axis=3).max(axis=(1, 2)))[:, None]
        system = np.broadcast_to(np.kron(table.inverse, np.eye(n)), (count, STAGES * n, STAGES * n)).copy()
        for j in range(STAGES):
            own = slice(j * n, (j + 1) * n)
            system[:, own, own] -= A[:, j]
        right = np.concatenate([A, b], axis=3).reshape(count, STAGES * n, n + q)
        moved = np.linalg.solve(system, right)[:, -n:]
        by_start = (np.eye(n) + moved[:, :, :n]) * (self.sizes[:, None] / self.sizes)
        return TangentMaps(by_start, moved[:, :, n:] * self.sizes[:, None], terms)
