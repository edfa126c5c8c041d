"""Event-driven solutions in 64 digits, by a code of the tests' own: modes by brute force, series order by order, first roots.

    x' = rate(t, x, l),   y = h(t, x, l),   -y in N_K(l),   K a box

Of l_i at an end, or y_i = 0, and of every side of a branch, all combinations are tried where values leave them open; that mode
is taken in which the first coefficient of every condition that is not 0 has the right sign. All that are valid must have one x.
"""

from __future__ import annotations

import decimal
import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from math import exp, log

import casadi as ca
import numpy as np

from tests.event_held import TINY, Column, expand, set_start
from tests.event_models import Scene
from tests.event_roots import first_root, value
from tests.event_series import ONE, ZERO, Series, Tape
from tests.search.digits import CONTEXT, exact, solve

ORDER, NEAR = 56, 1e-50  # Of the series, and what its last terms come to.
ROUNDING = Decimal("1e-12")  # A condition that stays below may be 0 in doubles: rows that are parallel up to rounding.
SMALL = Decimal("1e-20")  # Of a difference that stands for a derivative.
EVENTS = 300


class NotJudged(Exception):
    """Why a scene has no one solution that is made of modes."""


@dataclass(frozen=True)
class Mode:
    """-1, +1: l at its lower, upper end; 0: y = 0. And the sides of branches."""

    codes: tuple[int, ...]
    sides: tuple[int, ...]


@dataclass(frozen=True)
class Piece:
    """Series about t of states, multipliers and outputs, right for a time h; whether l is the only one, in doubles too."""

    mode: Mode
    t: Decimal
    h: Decimal
    x: list[Series]
    l: list[Series]
    y: list[Series]
    conditions: list[Series]
    alone: bool = True

    def at(self, t: Decimal) -> Column:
        return [value(c, t - self.t) for c in self.x]


@dataclass(frozen=True)
class Change:
    """An event: its time and both modes."""

    t: Decimal
    before: Mode
    after: Mode


@dataclass
class Judged:
    """A solution up to a time."""

    pieces: list[Piece] = field(default_factory=list)
    events: list[Change] = field(default_factory=list)

    @property
    def alone(self) -> bool:
        return all(piece.alone for piece in self.pieces)

    def states(self, t: Decimal) -> Column:
        """At a time, at an event after it."""
        with decimal.localcontext(CONTEXT):
            return self.piece(t).at(t)

    def piece(self, t: Decimal) -> Piece:
        return next(piece for piece in reversed(self.pieces) if piece.t <= t)

    def at(self, t: Sequence[float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """States (k, n), multipliers and outputs (k, m) at times, at an event after it."""
        rows: tuple[list, list, list] = ([], [], [])
        with decimal.localcontext(CONTEXT):
            for moment in map(exact, t):
                piece = self.piece(moment)
                for row, series in zip(rows, (piece.x, piece.l, piece.y), strict=True):
                    row.append([float(value(c, moment - piece.t)) for c in series])
        return np.array(rows[0]), np.array(rows[1]), np.array(rows[2])


class Modes:
    """The modes of a scene and their series."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.rows = scene, scene.l.numel()
        self.ends = {-1: [exact(v) for v in scene.lower], 1: [exact(v) for v in scene.upper]}
        self.direct = np.array(ca.DM(ca.jacobian(scene.y, scene.l).sparsity(), 1)).any(axis=1)
        self.watched = ca.vertcat(ca.SX(0, 1), *scene.sides.watched)
        free = [(scene.l[i], ZERO) for i in range(self.rows)]
        self.signs = Tape([scene.t, scene.x, ca.SX(0, 1)], [scene.y, self.watched], free)
        self._tapes: dict[Mode, Tape] = {}

    def tape(self, mode: Mode) -> Tape:
        """The graph in a mode, with the multipliers of held rows as its last input."""
        if mode not in self._tapes:
            scene, l = self.scene, self.scene.l
            held = ca.vertcat(ca.SX(0, 1), *(l[i] for i, code in enumerate(mode.codes) if code == 0))
            given = [(l[i], self.ends[code][i]) for i, code in enumerate(mode.codes) if code]
            given += [(s, Decimal(v)) for s, v in zip(scene.sides.sides, mode.sides, strict=True)]
            self._tapes[mode] = Tape([scene.t, scene.x, held], [scene.fixed, scene.y, self.watched], given)
        return self._tapes[mode]

    def open_at(self, t: Decimal, x: Column) -> Iterator[Mode]:
        """Every mode that the values at (t, x) leave open."""
        y, watched = self.values(t, x)
        rows = []
        for i in range(self.rows):
            codes = [code for code in (-1, 1) if self.ends[code][i].is_finite()]
            if not self.direct[i] and abs(y[i]) > TINY:
                rows.append([code for code in codes if code * y[i] < 0])
            else:
                rows.append([0, *codes])
        sides = [[1, -1] if abs(w) <= TINY else [1 if w > 0 else -1] for w in watched]
        for codes, of in itertools.product(itertools.product(*rows), itertools.product(*sides)):
            yield Mode(codes, of)

    def jumped(self, x: Column) -> Column:
        """x + g_l p at the start, for the impulse p of rows without an end that brings all y within the law."""
        rows = [i for i in range(self.rows) if not self.direct[i] and not all(self.ends[code][i].is_finite() for code in (-1, 1))]
        wanted = {i: [code for code in (-1, 1) if self.ends[code][i].is_finite()] for i in rows}

        def inside(y: Column) -> bool:
            return all(code * y[i] <= TINY for i in rows for code in wanted[i]) and all(
                abs(y[i]) <= TINY for i in rows if not wanted[i]
            )

        y = self.values(ZERO, x)[0]
        if inside(y):
            return x
        found: list[Column] = []
        push, moved = self.pushes(x, rows)
        for held in itertools.chain.from_iterable(itertools.combinations(rows, k) for k in range(1, len(rows) + 1)):
            matrix, p, to = [[moved[j][i] for j in held] for i in held], [ZERO] * len(held), x
            for _ in range(4):  # A start that misses a curved row by rounding is moved onto it.
                missed = self.values(ZERO, to)[0]
                step = solve(matrix, [-missed[i] for i in held])
                if step is None:
                    break
                p = [a + b for a, b in zip(p, step, strict=True)]
                to = [v + sum((a * push[j][k] for a, j in zip(p, held, strict=True)), ZERO) for k, v in enumerate(x)]
            if any(code * v > 0 for i, v in zip(held, p, strict=True) for code in wanted[i]):
                continue
            if inside(self.values(ZERO, to)[0]):
                found.append(to)
        if not found or any(abs(a - b) > TINY for other in found for a, b in zip(found[0], other, strict=True)):
            raise NotJudged("a start that does not jump to one state")
        return found[0]

    def values(self, t: Decimal, x: Column) -> tuple[Column, Column]:
        """y, where it does not depend on l, and what the sides are signs of."""
        set_start(self.signs, t, x, 1)
        self.signs.run(0)
        return self.signs.order(0, 0), self.signs.order(1, 0)

    def pushes(self, x: Column, rows: list[int]) -> tuple[dict[int, Column], dict[int, Column]]:
        """g_l and h_x g_l at the start, columns of rows."""
        y, watched = self.values(ZERO, x)
        tape = self.tape(Mode((0,) * self.rows, tuple(1 if w >= 0 else -1 for w in watched)))
        set_start(tape, ZERO, x, 1)

        def rate(one: int | None) -> Column:
            for i, series in enumerate(tape.inputs[2]):
                series[:] = [Decimal(i == one)]
            tape.run(0)
            return tape.order(0, 0)

        rest, push, moved = rate(None), {}, {}
        for j in rows:
            push[j] = [a - b for a, b in zip(rate(j), rest, strict=True)]
            there = self.values(ZERO, [u + SMALL * v for u, v in zip(x, push[j], strict=True)])[0]
            moved[j] = [(a - b) / SMALL for a, b in zip(there, y, strict=True)]
        return push, moved

    def piece(self, mode: Mode, t: Decimal, x: Column, order: int, longest: Decimal) -> Piece | None:
        """The series of a mode from (t, x), if it has one there."""
        tape, held = self.tape(mode), [i for i, code in enumerate(mode.codes) if code == 0]
        if not expand(tape, held, t, x, order):
            return None
        l: list[Series] = [[]] * self.rows
        for i, code in enumerate(mode.codes):
            l[i] = [self.ends[code][i], *[ZERO] * order] if code else tape.inputs[2][held.index(i)][: order + 1]
        states = [s[: order + 1] for s in tape.inputs[1]]
        y, watched = ([_padded(s, order) for s in tape.outputs[k]] for k in (1, 2))
        assert all(abs(c) <= TINY for i in held for c in y[i][:1])
        conditions = [[s * w for w in series] for s, series in zip(mode.sides, watched, strict=True)]
        for i, code in enumerate(mode.codes):
            if code:
                conditions.append([-code * v for v in y[i]])
                continue
            for end in (-1, 1):
                if self.ends[end][i].is_finite():
                    conditions.append([end * (self.ends[end][i] - l[i][0]), *(-end * v for v in l[i][1:])])
        h = min(longest, length([*states, *l, *y])) if order == ORDER else ONE
        return Piece(mode, t, h, states, l, y, conditions)

    def chosen(self, t: Decimal, x: Column, longest: Decimal) -> Piece:
        """The piece that follows (t, x)."""
        valid: list[Piece] = []
        for mode in self.open_at(t, x):
            for order in (0, 4, ORDER):
                piece = self.piece(mode, t, x, order, longest)
                if piece is None or any(germ(c, piece.h) < 0 for c in piece.conditions):
                    break
            else:
                valid.append(piece)
        if not valid:
            raise NotJudged("no mode is valid")
        one = valid[0]
        alone = len(valid) == 1 and not any(germ(c, one.h, ROUNDING) == 0 != germ(c, one.h) for c in one.conditions)
        for other in valid[1:]:
            h = min(one.h, other.h)
            if any(germ([a - b for a, b in zip(c, d, strict=True)], h) for c, d in zip(one.x, other.x, strict=True)):
                raise NotJudged("more than one solution")
        return Piece(**(vars(one) | {"alone": alone}))


def _padded(series: Series | Decimal, order: int) -> Series:
    return series[: order + 1] if isinstance(series, list) else [series, *[ZERO] * order]


def germ(series: Series, h: Decimal, zero: Decimal = TINY) -> int:
    """The sign of the first coefficient that is not 0 in a time of h."""
    power = ONE
    for c in series:
        if abs(c) * power > zero:
            return 1 if c > 0 else -1
        power *= h
    return 0


def length(series: list[Series]) -> Decimal:
    """The time in which the last three terms of each come to NEAR."""
    most = log(100.0)
    for c in series:
        size = log(NEAR * (1 + abs(float(c[0]))))
        for k in range(ORDER - 2, ORDER + 1):
            if c[k]:
                most = min(most, (size - float(abs(c[k]).ln())) / k)
    return exact(exp(most))


def judged(scene: Scene, t_end: float, seconds: float = 60.0, x0: Column | None = None) -> Judged:
    """The solution of a scene from its start, or from x0, to a time, in so many seconds at most.

    Raises:
        NotJudged: there is none, or more than one, or it takes too long.
    """
    with decimal.localcontext(CONTEXT):
        return _judged(Modes(scene), exact(t_end), time.process_time() + seconds, x0)


def _judged(modes: Modes, end: Decimal, limit: float, x0: Column | None) -> Judged:
    found, t, x = Judged(), ZERO, x0 or modes.jumped(start(modes.scene))
    piece = modes.chosen(t, x, end)
    while True:
        conditions = [deflated(c, piece.h) for c in piece.conditions]
        roots = [first_root(c, piece.h) for c in conditions if c]
        h = min((s for s in roots if s is not None), default=piece.h)
        found.pieces.append(Piece(**(vars(piece) | {"h": h})))
        event = any(s is not None for s in roots)
        x, t, mode = piece.at(t + h), t + h, piece.mode
        if t >= end:
            return found
        if time.process_time() > limit or len(found.events) > EVENTS:
            raise NotJudged("too long" if len(found.events) <= EVENTS else "too many events")
        if event:
            piece = modes.chosen(t, x, end - t)
            if mode != piece.mode:
                found.events.append(Change(t, mode, piece.mode))
        else:
            goes_on = modes.piece(mode, t, x, ORDER, end - t)
            if goes_on is None:
                raise NotJudged("a mode that ends without an event")
            piece = Piece(**(vars(goes_on) | {"alone": piece.alone}))


def deflated(c: Series, h: Decimal) -> Series | None:
    """Without its root at 0; None where it is 0 throughout."""
    power = ONE
    for k, v in enumerate(c):
        if abs(v) * power > TINY:
            return c[k:]
        power *= h
    return None


def start(scene: Scene) -> Column:
    model = scene.model
    x0 = model.q0 if hasattr(model, "q0") else model.x0
    x0 = ca.vertcat(x0, model.v0) if getattr(model, "v0", None) is not None else x0
    return [exact(v) for v in np.array(ca.DM(x0)).ravel()]
