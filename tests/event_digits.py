"""An event-driven solution again in 64 digits: each mode that the events name integrated by extrapolation, switches as its roots.

Of the run only the order of the modes is taken, and times as first guesses. In each mode l follows from y = 0, and from y' = 0 where
y does not depend on it; that the mode is the law's is looked at by definition at every step.
"""

from __future__ import annotations

import decimal
from decimal import Decimal
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np
from event_models import Scene

from nsmodel import Trajectory
from tests.search.digits import CONTEXT, Exact, exact

Column = list[Decimal]
STAGES, NEAR = 13, Decimal("1e-24")  # Columns of the extrapolation, and what they agree to.
SLACK = Decimal("1e-13")  # Of a sign: derivatives have products of constants, rounded as doubles.


class Mode:
    """x' and l in one mode, with sides of branches given."""

    def __init__(self, scene: Scene, codes: np.ndarray, sides: np.ndarray) -> None:
        self.codes, self.singular = codes, False
        l, t, x = scene.l, scene.t, scene.x
        self.active = a = [int(i) for i in np.flatnonzero(codes == 0)]
        self.start = [exact(0.0 if c == 0 else scene.upper[i] if c > 0 else scene.lower[i]) for i, c in enumerate(codes)]
        rate = ca.substitute(scene.fixed, ca.vertcat(*scene.sides.sides), ca.DM(sides)) if len(sides) else scene.fixed
        E, active = ca.SX(0, 1), ca.vertcat(ca.SX(0, 1), *(l[i] for i in a))
        if a:
            y = ca.vertcat(*(scene.y[i] for i in a))
            speed = ca.jtimes(y, x, rate) + ca.jacobian(y, t)
            D = np.array(ca.DM(ca.jacobian(y, active)))
            rows, null = independent(D)
            E = ca.vertcat(*(y[i] for i in rows), *(sum(float(u) * speed[i] for i, u in enumerate(v)) for v in null))
        self._linear = Exact([t, x, l], [ca.jacobian(E, active).T, E]) if a else None
        self._rate = Exact([t, x, l], [rate])
        self.signs = Exact([t, x, l], [scene.y, ca.vertcat(ca.SX(0, 1), *scene.sides.watched)])

    def multipliers(self, t: Decimal, x: Column) -> Column:
        l = list(self.start)
        if self._linear is not None:
            A, b = self._linear([t], x, l)
            m = len(b)
            found = solved([A[i * m : (i + 1) * m] for i in range(m)], [-v for v in b])
            self.singular = None in found
            for i, v in zip(self.active, found, strict=True):
                l[i] = v or Decimal(0)
        return l

    def rate(self, t: Decimal, x: Column) -> Column:
        return self._rate([t], x, self.multipliers(t, x))[0]


def independent(D: np.ndarray) -> tuple[list[int], list[list[Fraction]]]:
    """Rows of D that are independent, as many as its rank, and a basis of its left null space, exactly."""
    m = len(D)
    work = [[Fraction(float(v)) for v in row] + [Fraction(i == k) for k in range(m)] for i, row in enumerate(D)]
    left, rows = list(range(m)), []
    for column in range(m):
        pivot = next((i for i in left if work[i][column]), None)
        if pivot is None:
            continue
        left.remove(pivot)
        rows.append(pivot)
        for i in left:
            factor = work[i][column] / work[pivot][column]
            work[i] = [a - factor * b for a, b in zip(work[i], work[pivot], strict=True)]
    return rows, [work[i][m:] for i in left]


def solved(A: list[Column], b: Column) -> list[Decimal | None]:
    """A solution of A z = b; None for entries that may be anything."""
    m, rows = len(b), [[*row, v] for row, v in zip(A, b, strict=True)]
    size, pivots = max(abs(v) for row in A for v in row), {}
    for k in range(m):
        left = [i for i in range(m) if i not in pivots.values()]
        p = max(left, key=lambda i: abs(rows[i][k]))
        if abs(rows[p][k]) <= SLACK * size:
            continue
        pivots[k] = p
        for i in range(m):
            if i != p:
                factor = rows[i][k] / rows[p][k]
                rows[i] = [a - factor * c for a, c in zip(rows[i], rows[p], strict=True)]
    return [rows[pivots[k]][m] / rows[pivots[k]][k] if k in pivots else None for k in range(m)]


def step(mode: Mode, t: Decimal, x: Column, h: Decimal) -> tuple[Column, Decimal]:
    """One step of Gragg's rule, extrapolated in h^2; and how far the last two columns differ."""
    table: list[Column] = []
    first = mode.rate(t, x)
    for j in range(1, STAGES + 1):
        n = 2 * j
        d = h / n
        old, new = x, [a + d * v for a, v in zip(x, first, strict=True)]
        for k in range(1, n):
            slope = mode.rate(t + k * d, new)
            old, new = new, [a + 2 * d * v for a, v in zip(old, slope, strict=True)]
        end = mode.rate(t + h, new)
        row = [(a + b + d * v) / 2 for a, b, v in zip(new, old, end, strict=True)]
        fresh = [row]
        for k, before in enumerate(table, 1):
            factor = (Decimal(j) / (j - k)) ** 2 - 1
            fresh.append([a + (a - b) / factor for a, b in zip(fresh[-1], before, strict=True)])
        previous, table = table, fresh
    return table[-1], max(abs(a - b) for a, b in zip(table[-1], previous[-1], strict=True))


class Digits:
    """The states at times ``at`` and the times of the events."""

    def __init__(self, scene: Scene, run: Trajectory, at: np.ndarray, start: Column | None = None) -> None:
        with decimal.localcontext(CONTEXT):
            self.scene, self.largest = scene, Decimal(1)
            self.t, self.x = Decimal(0), start or [exact(v) for v in np.array(ca.DM(_start(scene))).ravel()]
            self.rows: list[Column] = []
            self.events: list[float] = []
            self._h = exact(float(run.t[-1])) / 50
            codes = run.arrays["piece_codes"][0]
            events = [e for e in run.events if e.t > 0]
            left = [exact(v) for v in at]
            for event in [*events, None]:
                begin, until = float(self.t), float(run.t[-1]) if event is None else event.t
                self.mode = Mode(scene, codes, self._sides(run, begin, until))
                while left and (left[0] < exact(until) or event is None):
                    self._go(left.pop(0))
                    self.rows.append(self.x)
                if event is not None:
                    end = self._root(event, exact(until))
                    self._go(end)
                    self.events.append(float(end))
                    codes = event.after

    def _sides(self, run: Trajectory, begin: float, end: float) -> np.ndarray:
        """Of what the arguments are the sign of, in the middle of the piece."""
        t = (begin + end) / 2
        found = run.at(t)
        x = np.hstack([found.x, found.v])[0]
        watched = ca.Function("w", [self.scene.t, self.scene.x], [ca.vertcat(ca.SX(0, 1), *self.scene.sides.watched)])
        return np.sign(np.array(watched(t, x)).ravel())

    def _go(self, until: Decimal) -> None:
        """Integrate to a time in steps that are as exact as NEAR, and look at the law at each."""
        while self.t < until:
            h = min(self._h, until - self.t)
            x, error = step(self.mode, self.t, self.x, h)
            if error > NEAR * self.largest:
                self._h = h / 2
                continue
            self.t, self.x = (until if h == until - self.t else self.t + h), x
            self.largest = max(self.largest, *map(abs, x))
            self._check()

    def _check(self) -> None:
        l = self.mode.multipliers(self.t, self.x)
        y, _ = self.mode.signs([self.t], self.x, l)
        size = max(1, *map(abs, y), *map(abs, l))
        for i, code in enumerate(self.mode.codes):
            if code == 0:
                assert (
                    self.mode.singular
                    or exact(self.scene.lower[i]) - SLACK * size <= l[i] <= exact(self.scene.upper[i]) + SLACK * size
                )
                assert abs(y[i]) <= SLACK * size
            elif self.scene.lower[i] < self.scene.upper[i]:
                assert int(code) * y[i] <= SLACK * size

    def _root(self, event: Any, guess: Decimal) -> Decimal:
        """The time at which what the event says comes to 0: the secant method on steps from where the piece is near."""
        before, after = event.before, event.after
        changed = [i for i in range(len(before)) if before[i] != after[i]]
        self._go(guess - min(exact(1e-3) * guess, (guess - self.t) / 2))

        def values(t: Decimal) -> Column:
            x, _ = step(self.mode, self.t, self.x, t - self.t) if t > self.t else (self.x, 0)
            l = self.mode.multipliers(t, x)
            y, watched = self.mode.signs([t], x, l)
            ends = [exact(self.scene.upper[i] if after[i] > 0 else self.scene.lower[i]) for i in range(len(l))]
            return [y[i] if before[i] else l[i] - ends[i] for i in changed] + watched

        there = values(guess)
        which = min(range(len(there)), key=lambda k: abs(there[k]))
        a, b = guess - (guess - self.t) / 4, guess
        u, v = values(a)[which], there[which]
        for _ in range(12):
            if v == 0 or u == v or abs(b - a) <= Decimal("1e-30") * guess:
                break
            a, b, u = b, b - v * (b - a) / (v - u), v
            v = values(b)[which]
        return b


def _start(scene: Scene) -> ca.SX:
    model = scene.model
    x0 = model.q0 if hasattr(model, "q0") else model.x0
    return ca.vertcat(x0, model.v0) if getattr(model, "v0", None) is not None else x0
