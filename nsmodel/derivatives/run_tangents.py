"""How derivatives pass a switch: saltation.

At a time t* where a guard G(t, x, l, p) becomes 0, or which is known, x goes on as x+ = J(t, x, p) at another rate:

    dt* = -(dG at fixed t)/(dG/dt along the flow),    S+ = J_x (S- + F- dt*) + J_t dt* + J_p - F+ dt*.

The guard of a row is y_i where it is at an end, l_i - end_i where it is held; that of a branch is what it looks at (Leine and
Nijmeijer, Dynamics and Bifurcations of Non-Smooth Mechanical Systems, 2004, chapter 7). Entering a slide this is the projection
I - B (C B)^-1 C; leaving it nothing jumps.

S = dx/dp along a run: the parts of its pieces and the jumps between them, one after the other.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from nsmodel.codegen.event_driven_spec import TANGENT_AT_ONCE, TANGENT_ROUNDING, TANGENT_SHARE
from nsmodel.derivatives.known_times import KnownTimes, MovedTime
from nsmodel.derivatives.piece_tangents import PieceTangents, TangentMaps, TangentParts
from nsmodel.derivatives.tangent_equations import TRY_DIFFERENCES, LinearisedEquations
from nsmodel.errors import StepError
from nsmodel.event_driven.multipliers import NOTHING, multiplier_solver
from nsmodel.event_driven.problem import SAME_TIME

KNOWN, CROSSING, IMPULSE, START = "known time", "switch", "impulse", "start"


SAME_RATE = 1e-9  # Of a rate: what edges change of it together, beside the sum of what each does: more is a part of its own. (+)
SAME_TIME_ROUNDING = 1e-13  # Of a time, 450 EPS: a guard that is nearer to 0 than that at a known time comes with it. (+)


class Guard(NamedTuple):
    """What becomes 0 at a switch: dG = by_state S + own at fixed t, its rate along the flow, and how far from 0 it is in time."""

    name: str
    by_state: np.ndarray
    own: np.ndarray
    rate: float
    off: float
    value: Callable[[np.ndarray, np.ndarray, np.ndarray], float]  # Of y, l and what branches look at.


@dataclass(frozen=True)
class SwitchJump:
    """How S passes the begin of a piece: S+ = by_state S- + own.

    Attributes:
        piece: the number of the piece that begins; t: its time. kind: see above; name: of the guard, or what acts.
        time_by_state, time_own: dt* = time_by_state S- + time_own, (n,) and (q,).
        transversality: dG/dt along the flow, inf where the time is known; relative_rate: beside what G moves by on the piece
            before over the length of that.
        rivals: further guards that become 0 at the same time, with their dt* in the same form.
    """

    piece: int
    t: float
    kind: str
    name: str
    by_state: np.ndarray
    own: np.ndarray
    time_by_state: np.ndarray
    time_own: np.ndarray
    transversality: float
    relative_rate: float = np.inf
    rivals: tuple[tuple[str, np.ndarray, np.ndarray], ...] = ()


class _Side(NamedTuple):
    """The end or the begin of the piece ``number``: the equations there, L = by_state S + own, x, and the rates of l and y."""

    number: int
    at: LinearisedEquations
    by_state: np.ndarray
    own: np.ndarray
    x: np.ndarray
    l: np.ndarray
    l_rate: np.ndarray
    y_rate: np.ndarray


class SwitchJumps:
    """The jumps of S at the begins of the pieces of a run."""

    def __init__(self, tangents: PieceTangents, known: KnownTimes, q: int) -> None:
        """``q``: columns of S, the first of which are those of the equations."""
        self._tangents, self._known, self._equations, self._q = tangents, known, tangents.equations, q
        n, p = tangents.pieces.layout.n, tangents.equations.problem
        self._held = np.arange(n - p.held, n)

    def all(self) -> dict[int, SwitchJump]:
        """{number of the piece that begins: jump}, of those that begin after an event, or an impulse at the start."""
        pieces = self._tangents.pieces
        begins = [k for k in range(pieces.count) if (pieces.event[k] and k) or pieces.impulse[k].any() or k == 0]
        starts = np.array(begins, int)
        after = self._sides(starts, self._tangents.onsets[starts])
        ended = np.array([k - 1 for k in begins if k], int)
        before = dict(zip(ended.tolist(), self._sides(ended, self._tangents.ends[ended]), strict=True))
        return {
            k: self._start(side) if k == 0 else self._jump(before[k - 1], side) for k, side in zip(begins, after, strict=True)
        }

    def _sides(self, numbers: np.ndarray, s: np.ndarray) -> list[_Side]:
        if not numbers.size:
            return []
        tangents = self._tangents
        at, by_state, own = tangents.linearised(numbers, s)
        _, x, l = tangents.values(numbers, s)
        _, l_rate, y_rate = tangents.rates(numbers, s)
        own = self._widened(own)
        at = LinearisedEquations(*(part._replace(by_p=self._widened(part.by_p)) for part in at))
        each = [LinearisedEquations(*(type(q)(*(part[i] for part in q)) for q in at)) for i in range(len(numbers))]
        return [_Side(*parts) for parts in zip(numbers.tolist(), each, by_state, own, x, l, l_rate, y_rate, strict=True)]

    def _widened(self, columns: np.ndarray) -> np.ndarray:
        """With columns of 0 for what acts at known times alone."""
        missing = self._q - columns.shape[-1]
        return np.concatenate([columns, np.zeros((*columns.shape[:-1], missing))], axis=-1) if missing else columns

    def _start(self, after: _Side) -> SwitchJump:
        n, q = self._equations.n, self._q
        maps, zero = _AffineTangent(np.eye(n), np.zeros((n, q))), _AffineTangent(np.zeros(n), np.zeros(q))
        impulse = self._tangents.pieces.impulse[0]
        if impulse.any():
            maps = self._pass_impulse(impulse, after, maps, zero)
        on_surface = tuple((one.name, one.by_state, one.own) for one in self._start_guards(after))
        maps = self._project(after, maps)
        return SwitchJump(0, 0.0, START, "", maps.by_state, maps.own, zero.by_state, zero.own, np.inf, rivals=on_surface)

    def _start_guards(self, start: _Side) -> list[Guard]:
        """The conditions of the first mode that are 0 at the start: it lies on their surface, and its derivative on one side.

        A row that is held through y' draws states beside it back, on both sides, where its l may have both signs.
        """
        equations, p = self._equations, self._equations.problem
        codes, found = self._tangents.codes[0], []
        y_by_state = start.at.y.by_x + start.at.y.by_l @ start.by_state
        y_own = start.at.y.by_p + start.at.y.by_l @ start.own
        curved = {i for rows in equations.curved.values() for i in range(rows.start, rows.stop)}
        for i in (i for i in range(equations.m) if i not in curved):
            if codes[i]:
                found.append(_guard(p.rows[i], y_by_state[i], y_own[i], start, start.y_rate[i], lambda y, l, w, i=i: y[i]))
            elif self._tangents.mode_rows.held[0][:, i].any():
                if not np.isfinite([equations.ends[0][i], equations.ends[1][i]]).all():
                    found.append(_guard(p.rows[i], y_by_state[i], y_own[i], start, 1.0, lambda y, l, w, i=i: 0.0))
            for end, slope in zip(equations.ends, equations.end_slopes, strict=True):
                if not codes[i] and np.isfinite(end[i]):
                    value = lambda y, l, w, i=i, end=end[i]: l[i] - end  # noqa: E731
                    moved = start.own[i] - self._widened(slope[i])
                    found.append(_guard(p.rows[i], start.by_state[i], moved, start, start.l_rate[i], value))
        found += self._guards_of_branches(start, self._jumping_branches(start))
        length = float(self._tangents.pieces.tau[0] * self._tangents.ends[0])
        return [one for one in found if one.off <= TANGENT_AT_ONCE * length]

    def _jumping_branches(self, side: _Side) -> list[int]:
        """The branches on whose other side the rate is another here; over a kink nothing of S jumps."""
        pieces, found, here = self._tangents.pieces, [], self._tangents.choices[side.number]
        for j in (j for j, branch in enumerate(self._equations.branches) if branch.kind == "side"):
            other = here.copy()
            other[j] = -here[j]
            rate = self._equations(pieces.t[[side.number]], side.x[None], side.l[None], other[None]).rate.value[0]
            if (np.abs(rate - side.at.rate.value) > SAME_RATE * (np.abs(rate) + np.abs(side.at.rate.value))).any():
                found.append(j)
        return found

    def _jump(self, before: _Side, after: _Side) -> SwitchJump:
        pieces, n, q = self._tangents.pieces, self._equations.n, self._q
        k = after.number
        t, impulse, x = float(pieces.t[k]), pieces.impulse[k], pieces.last[k - 1]
        known = self._known.is_known(t, x)
        if known:
            rivals = tuple(
                (one.name, -one.by_state / one.rate, -one.own / one.rate)
                for one in self._row_guards(before, after) if one.rate and one.off <= SAME_TIME_ROUNDING * abs(t)
            )  # fmt: skip
            moved = self._known.moved(t, x, q)
            time = _AffineTangent(np.concatenate([moved.by_state, np.zeros(n - len(x))]), moved.own)
            kind, name, rate, share = KNOWN, ", ".join(moved.names) or "switch_times", np.inf, np.inf
        else:
            first, *others = self._guards(before, after)
            time = _AffineTangent(-first.by_state / first.rate, -first.own / first.rate)
            moved, kind, name, rate = None, IMPULSE if impulse.any() else CROSSING, first.name, first.rate
            share = self._relative_rate(before, first)
            rivals = tuple((one.name, -one.by_state / one.rate, -one.own / one.rate) for one in others)
        maps, passed = _AffineTangent(np.eye(n), np.zeros((n, q))), time
        if moved is not None and moved.edges_differ:
            maps = self._pass_edges(moved, before, after, maps)
            passed = _AffineTangent(np.zeros(n), np.zeros(q))
        maps = maps.moved(before.at.rate.value, passed, 1.0)
        if known:
            self._known.put_held(t, before.x, maps.by_state, maps.own)
        self._put_updates(before, after, maps, passed)
        if impulse.any():
            maps = self._pass_impulse(impulse, after, maps, passed)
        rate_after = after.at.rate.value.copy()
        if known:
            rate_after[self._held] = 0.0  # What is held is data, and has its derivative at a fixed time.
        maps = self._project(after, maps.moved(rate_after, passed, -1.0))
        return SwitchJump(k, t, kind, name, maps.by_state, maps.own, time.by_state, time.own, float(rate), share, rivals)

    def _pass_edges(self, moved: MovedTime, before: _Side, after: _Side, maps: _AffineTangent) -> _AffineTangent:
        """Edges of several inputs at one time that move apart: each moves S by what it alone changes of the rate.

        Raises:
            StepError: together they change it by another amount, or x jumps: each order of the edges has its own derivative.
        """
        n, t, states = self._equations.n, float(self._tangents.pieces.t[after.number]), self._tangents.pieces.layout.n
        flow = before.at.rate.by_x + before.at.rate.by_l @ before.by_state
        flow[self._held] = 0.0
        jump, rates = np.zeros(n), (before.at.rate.value.copy(), after.at.rate.value.copy())
        jump[self._held] = (after.x - before.x)[self._held]
        for rate in rates:
            rate[self._held] = 0.0
        size = np.abs(rates[0]) + np.abs(rates[1]) + np.abs(flow) @ np.abs(jump)
        off = np.abs(rates[1] - rates[0] - flow @ jump)
        if self._tangents.pieces.impulse[after.number].any() or (off > SAME_RATE * size).any():
            raise StepError(
                f"t = {t:.10g}: edges of {', '.join(moved.names)} are at one time and move apart, and their joint effect is not "
                "the sum of their effects: the run has no derivative there"
            )
        for rows, dt in moved.edges:
            own = np.zeros(n)
            own[rows] = jump[rows]
            time = _AffineTangent(np.concatenate([dt[:states], np.zeros(n - states)]), dt[states:])
            maps = maps.moved(flow @ own, time, -1.0)
        return maps

    def _guards(self, before: _Side, after: _Side) -> list[Guard]:
        """What becomes 0 where a piece ends and is on another side after it, the nearest to 0 first.

        Raises:
            StepError: nothing is seen to; or it only touches 0.
        """
        here, then = (self._tangents.choices[side.number] for side in (before, after))
        guards = [*self._row_guards(before, after), *self._guards_of_branches(before, np.flatnonzero(here != then).tolist())]
        guards = guards or self._update_guards(before, after)
        pieces, t = self._tangents.pieces, float(self._tangents.pieces.t[after.number])
        length = float(pieces.tau[before.number] * self._tangents.ends[before.number])
        moving = sorted((one for one in guards if one.rate), key=lambda one: one.off)
        if not moving:
            what = ", ".join(one.name for one in guards) or "what ends the piece"
            raise StepError(f"t = {t:.10g}: {what} touches 0 there, and does not cross it: the run has no derivative")
        least = max(TANGENT_AT_ONCE * max(length, abs(t)), 2 * moving[0].off)
        return [one for one in moving if one.off <= least]

    def _relative_rate(self, before: _Side, guard: Guard) -> float:
        """The rate of a guard beside how far it was from 0 on the piece before, over the length of that."""
        tangents, end = self._tangents, float(self._tangents.ends[before.number])
        where, s = np.full(2, before.number), np.array([0.0, end / 2])
        at, _, _ = tangents.linearised(where, s)
        l = tangents.values(where, s)[2]
        found = np.abs(np.array([guard.value(at.y.value[k], l[k], at.watched.value[k]) for k in range(2)])).max()
        length = float(tangents.pieces.tau[before.number]) * end
        return float(abs(guard.rate) * length / found) if found else np.inf

    def _row_guards(self, before: _Side, after: _Side) -> list[Guard]:
        equations, p = self._equations, self._equations.problem
        codes, then = (self._tangents.codes[side.number] for side in (before, after))
        found = []
        y_by_state = before.at.y.by_x + before.at.y.by_l @ before.by_state
        y_own = before.at.y.by_p + before.at.y.by_l @ before.own
        inner = {i for rows in equations.curved.values() for i in range(rows.start + 1, rows.stop)}
        for i in np.flatnonzero(codes != then).tolist():
            name, rows = p.rows[i], equations.curved.get(i)
            if i in inner:
                continue
            if rows is not None:
                found.append(self._block_guard(name, rows, before, int(codes[i]), y_by_state[rows], y_own[rows]))
            elif codes[i]:
                found.append(_guard(name, y_by_state[i], y_own[i], before, before.y_rate[i], lambda y, l, w, i=i: y[i]))
            else:
                end, slope = (part[int(then[i] > 0)] for part in (equations.ends, equations.end_slopes))
                moved = before.own[i] - self._widened(slope[i])
                value = lambda y, l, w, i=i, end=end[i]: l[i] - end  # noqa: E731
                found.append(_guard(name, before.by_state[i], moved, before, before.l_rate[i], value))
        return found

    def _block_guard(self, name: str, rows: slice, before: _Side, code: int, y_by_state: np.ndarray, y_own: np.ndarray) -> Guard:
        """Of a block: its speed where it slips, along its direction; l'S l - c where it sticks."""
        if code:
            rate = before.y_rate[rows]
            along = rate / np.linalg.norm(rate)
            return _guard(name, along @ y_by_state, along @ y_own, before, along @ rate, lambda y, l, w: along @ y[rows])
        S, c = self._equations.quadric(rows)
        along = 2 * S @ before.l[rows]
        by_state, own, rate = (along @ part[rows] for part in (before.by_state, before.own, before.l_rate))
        return _guard(name, by_state, own, before, rate, lambda y, l, w: l[rows] @ S @ l[rows] - c)

    def _update_guards(self, before: _Side, after: _Side) -> list[Guard]:
        """What a block compares, where what it sets takes the comparison back to the side of before."""
        places, count = list(self._equations.problem.updated), len(self._equations.branches)
        if (before.x[places] == after.x[places]).all():
            return []
        return self._guards_of_branches(before, range(count - self._equations.update_branches, count))

    def _guards_of_branches(self, before: _Side, which: Iterable[int]) -> list[Guard]:
        watched, found = before.at.watched, []
        for j in which:
            rate = watched.by_t[j] + watched.by_x[j] @ before.at.rate.value + watched.by_l[j] @ before.l_rate
            whole = 0.0 if self._equations.branches[j].kind == "side" else float(np.rint(watched.value[j]))
            by_state, own = watched.by_x[j] + watched.by_l[j] @ before.by_state, watched.by_p[j] + watched.by_l[j] @ before.own
            value = lambda y, l, w, j=j, whole=whole: w[j] - whole  # noqa: E731
            found.append(_guard(self._equations.branch_names[j], by_state, own, before, rate, value))
        return found

    def _put_updates(self, before: _Side, after: _Side, maps: _AffineTangent, time: _AffineTangent) -> None:
        """What blocks that act after each step set at the switch, where it is another, or its side is."""
        p = self._equations.problem
        places = list(p.updated)
        if not places:
            return
        count = self._equations.update_branches
        sides = [self._tangents.choices[side.number][len(self._equations.branches) - count :] for side in (before, after)]
        if (sides[0] == sides[1]).all() and (before.x[places] == after.x[places]).all():
            return
        x = after.x.copy()
        x[places] = before.x[places]
        choices = self._tangents.choices[[after.number]]
        at = self._equations(self._tangents.pieces.t[[after.number]], x[None], after.l[None], choices).updates
        maps.by_state[places], maps.own[places] = (
            at.by_x[0] @ maps.by_state + np.outer(at.by_t[0], time.by_state),
            at.by_x[0] @ maps.own + self._widened(at.by_p[0]) + np.outer(at.by_t[0], time.own),
        )

    def _pass_impulse(self, impulse: np.ndarray, after: _Side, maps: _AffineTangent, time: _AffineTangent) -> _AffineTangent:
        """x+ = x + g_l p, with p of the rows that it acts on so that y+ = 0 in these."""
        B, moved = self._equations.push_slopes(impulse)
        moved = self._widened(moved)
        a, y = np.flatnonzero(impulse), after.at.y
        N = np.array(multiplier_solver(tuple(a.tolist()), B, y.by_l, y.by_x).through)
        by_state = y.by_x @ maps.by_state + np.outer(y.by_t, time.by_state)
        own = y.by_x @ (maps.own + moved) + y.by_p + np.outer(y.by_t, time.own)
        push = B[:, a] @ N
        return _AffineTangent(maps.by_state - push @ by_state[a], maps.own + moved - push @ own[a])

    def _project(self, after: _Side, maps: _AffineTangent) -> _AffineTangent:
        """S with y = 0 in the rows that the mode after holds through y' alone, moved as their multipliers push x.

        This is what a short time of the mode does to states beside the surface, as where a run starts on it.
        """
        U = self._tangents.mode_rows.held[after.number]
        a = np.flatnonzero(U.any(axis=0))
        if not a.size:
            return maps
        y, push = after.at.y, after.at.rate.by_l
        through = multiplier_solver(tuple(a.tolist()), push, y.by_l, y.by_x).through
        if through is None:
            return maps
        slope, own = y.by_x + y.by_l @ after.by_state, y.by_p + y.by_l @ after.own
        lift = push[:, a] @ np.array(through)
        return _AffineTangent(maps.by_state - lift @ (slope @ maps.by_state)[a], maps.own - lift @ (slope @ maps.own + own)[a])


class _AffineTangent(NamedTuple):
    """by_state S + own."""

    by_state: np.ndarray
    own: np.ndarray

    def moved(self, rate: np.ndarray, time: _AffineTangent, sign: float) -> _AffineTangent:
        """And sign rate dt."""
        return _AffineTangent(self.by_state + sign * np.outer(rate, time.by_state), self.own + sign * np.outer(rate, time.own))


def _guard(name: str, by_state: np.ndarray, own: np.ndarray, before: _Side, rate: Any, value: Callable[..., float]) -> Guard:
    off = value(before.at.y.value, before.l, before.at.watched.value)
    return Guard(name, by_state, own, float(rate), float(abs(off / rate)) if rate else (np.inf if off else 0.0), value)


MAX_PARTS = 200_000  # Parts of all pieces of a run together, of 10 states 160 MB; beyond, a run has no derivative.
# STOP_ROUNDING: less halves parts for rounding.
STOP_ROUNDING = 10  # Before the stop of a block, times the rounding of y beside |y|: what one step and two may differ by. (+)
SHORTEST_PART = 1e-12  # Of its piece, 2^-40: a part that would have to be shorter is an error: S has a singularity there. (+)


class Stop(NamedTuple):
    """A time at which S is asked for: in which piece, and where in its unit."""

    t: float
    piece: int
    s: float


class RunTangents:
    """S along the pieces of a run, from S(0) on.

    Attributes:
        jumps: {number of the piece that begins: how S passes its begin}.
        parts, maps: the parts of the pieces, in order, and S at the end of each as a function of S at its begin.
        at_begin: S at the begin of each part (J, n, q).
    """

    def __init__(
        self, tangents: PieceTangents, jumps: dict[int, SwitchJump], start: np.ndarray, times: np.ndarray, rtol: float
    ) -> None:
        """``times``: at which parts end, beside the ends of pieces.

        Raises:
            StepError: S moves too fast for any number of parts.
        """
        self.tangents, self.jumps, self.start = tangents, jumps, start
        self._tolerance = max(TANGENT_SHARE * rtol, TANGENT_ROUNDING)
        self._integrate(_first_parts(tangents, [self.stop(t) for t in times.tolist()]))

    def _integrate(self, parts: TangentParts) -> None:
        coarse, halves = self.tangents.maps(parts), self._halves(parts)
        while True:
            maps = halves[1].after(halves[0])
            self.parts, self.maps, self.at_begin = parts, maps, self._chain(parts, maps)
            is_wrong = self._differences(coarse, maps) > self._allowed(parts)
            if not is_wrong.any():
                return
            self._check_resolved(parts, np.flatnonzero(is_wrong))
            new = _joined(*(part[is_wrong] for part in parts.halves))
            parts, coarse = _joined(parts[~is_wrong], new), _joined(coarse[~is_wrong], *(half[is_wrong] for half in halves))
            halves = [_joined(half[~is_wrong], made) for half, made in zip(halves, self._halves(new), strict=True)]
            order = np.lexsort((parts.begin, parts.piece))
            parts, coarse, halves = parts[order], coarse[order], [half[order] for half in halves]

    def _allowed(self, parts: TangentParts) -> np.ndarray:
        """What one step and two may differ by: before the stop of a block the direction of slip is known no better."""
        tangents, k = self.tangents, parts.piece
        left = tangents.ends[k] - np.minimum(parts.end, tangents.frozen[k])
        rounding = tangents.rounding[k] / np.where(left > 0, left, tangents.ends[k])
        return np.maximum(self._tolerance, STOP_ROUNDING * rounding)

    def _halves(self, parts: TangentParts) -> list[TangentMaps]:
        both, count = self.tangents.maps(_joined(*parts.halves)), len(parts.piece)
        return [both[np.arange(count)], both[np.arange(count, 2 * count)]]

    def _chain(self, parts: TangentParts, maps: TangentMaps) -> np.ndarray:
        """S at the begin of each part."""
        out = np.empty((len(parts.piece), *self.start.shape))
        S, last = self.start, -1
        for j, k in enumerate(parts.piece.tolist()):
            if k != last and (jump := self.jumps.get(k)) is not None:
                S = jump.by_state @ S + jump.own
            out[j], last = S, k
            S = _moved(maps.by_start[j], maps.own[j], S)
        self.end = S
        return out

    def _differences(self, coarse: TangentMaps, fine: TangentMaps) -> np.ndarray:
        """The largest difference of both ends of each part, but for rounding of what cancels, beside that of the column."""
        S, sizes = self.at_begin, self.tangents.sizes[:, None]
        ends = fine.by_start @ S
        off = (coarse.by_start - fine.by_start) @ S
        ends[:, :, : fine.own.shape[2]] += fine.own
        off[:, :, : fine.own.shape[2]] += coarse.own - fine.own
        off = (np.abs(off) / sizes).max(axis=1)
        off[:, : fine.own.shape[2]] = np.maximum(off[:, : fine.own.shape[2]] - TANGENT_ROUNDING * fine.terms, 0.0)
        size = np.maximum(np.abs(S) / sizes, np.abs(ends) / sizes).max(axis=1)
        return np.nan_to_num(off / (size + NOTHING), nan=np.inf).max(axis=1)

    def _check_resolved(self, parts: TangentParts, wrong: np.ndarray) -> None:
        length = (parts.end - parts.begin)[wrong] / self.tangents.ends[parts.piece[wrong]]
        if len(parts.piece) + len(wrong) > MAX_PARTS or length.min() < SHORTEST_PART:
            j = wrong[int(length.argmin())]
            pieces = self.tangents.pieces
            t = float(pieces.t[parts.piece[j]] + pieces.tau[parts.piece[j]] * parts.begin[j])
            raise StepError(f"t = {t:.10g}: derivatives change too fast there for {MAX_PARTS:,} steps; {TRY_DIFFERENCES}")

    def stop(self, t: float) -> Stop:
        """Where a time is: at the begin of a piece, or inside."""
        pieces, ends = self.tangents.pieces, self.tangents.ends
        k = int(np.searchsorted(pieces.t, t * (1 + SAME_TIME), side="right")) - 1
        if t <= pieces.t[k] * (1 + SAME_TIME):
            return Stop(t, k, 0.0)
        return Stop(t, k, min((t - float(pieces.t[k])) / float(pieces.tau[k]), float(ends[k])))

    @cached_property
    def _numbers(self) -> dict[tuple[int, float], int]:
        return {place: j for j, place in enumerate(zip(self.parts.piece.tolist(), self.parts.begin.tolist(), strict=True))}

    def number(self, stop: Stop) -> int:
        """Of the part that begins there, or the number of parts at the end of the run."""
        return self._numbers.get((stop.piece, stop.s), len(self.parts.piece))

    def sides(self, stop: Stop) -> tuple[np.ndarray, np.ndarray]:
        """S just before and just after that time (n, q)."""
        j = self.number(stop)
        before = _moved(self.maps.by_start[j - 1], self.maps.own[j - 1], self.at_begin[j - 1]) if j else self.at_begin[0]
        return before, self.end if j == len(self.parts.piece) else self.at_begin[j]


def _moved(by_start: np.ndarray, own: np.ndarray, S: np.ndarray) -> np.ndarray:
    """S at the end of a part, the first columns of which are by parameters, that act in it."""
    moved = by_start @ S
    moved[:, : own.shape[1]] += own
    return moved


def _joined(*several: Any) -> Any:
    """Parts, or maps, one after the other."""
    return type(several[0])(*(np.concatenate(arrays) for arrays in zip(*several, strict=True)))


def _first_parts(tangents: PieceTangents, cuts: Sequence[Stop]) -> TangentParts:
    """Whole pieces, cut where that is asked for, and just before the stops of blocks."""
    inside = {k: {float(tangents.frozen[k])} for k in np.flatnonzero(tangents.frozen < tangents.ends).tolist()}
    for stop in cuts:
        if 0 < stop.s < tangents.ends[stop.piece]:
            inside.setdefault(stop.piece, set()).add(stop.s)
    found = []
    for k, end in enumerate(tangents.ends.tolist()):
        at = [0.0, *sorted(inside.get(k, ())), end]
        found += [(k, a, b) for a, b in itertools.pairwise(at) if b > a]
    piece, begin, end = zip(*found, strict=True)
    return TangentParts(np.array(piece), np.array(begin), np.array(end))
