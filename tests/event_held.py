"""Series of x and l in one mode: l of held rows follows from y = 0, and from y' = 0 where y does not depend on it."""

from __future__ import annotations

from decimal import Decimal

from tests.event_series import ONE, ZERO, Series, Tape
from tests.search.digits import solve

Column = list[Decimal]
TINY = Decimal("1e-35")  # What counts as 0.


def set_start(tape: Tape, t: Decimal, x: Column, order: int) -> None:
    tape.inputs[0][0][:] = [t, ONE, *[ZERO] * order]
    for series, v in zip(tape.inputs[1], x, strict=True):
        series[:] = [v]


class Held:
    """Equations for l of held rows: y_i where it depends on l, and y' of combinations of rows that do not."""

    def __init__(self, tape: Tape, rows: list[int]) -> None:
        """At order 0 of all series: D, and y' by l, from order 1 with one unit of l, or of what it pushes, at a time."""
        self.rows, m = rows, len(rows)
        states, l = tape.inputs[1:]
        f = tape.order(0, 0)

        def first(push: Column, one: int | None) -> tuple[Column, Column]:
            for series, a, b in zip(states, f, push, strict=True):
                series[1:] = [a + b]
            for j, series in enumerate(l):
                series[1:] = [ONE if j == one else ZERO]
            tape.run(1)
            return tape.order(0, 1), [tape.order(1, 1)[i] for i in rows]

        none = [ZERO] * len(states)
        rate, self.speeds = first(none, None)
        D, pushed = [], []
        for j in range(m):
            faster, moved = first(none, j)
            D.append([a - b for a, b in zip(moved, self.speeds, strict=True)])
            moved = first([a - b for a, b in zip(faster, rate, strict=True)], None)[1]
            pushed.append([a - b for a, b in zip(moved, self.speeds, strict=True)])
        self.own, self.null = independent([list(row) for row in zip(*D, strict=True)])
        self.matrix = [[D[j][i] for j in range(m)] for i in self.own]
        self.matrix += [[_along(u, pushed[j]) for j in range(m)] for u in self.null]

    def right(self, y: Column, after: Column) -> Column:
        """What is missed: y of rows, and combinations of their derivatives."""
        return [y[i] for i in self.own] + [_along(u, after) for u in self.null]


def _along(u: Column, v: Column) -> Column:
    return sum((a * b for a, b in zip(u, v, strict=True)), ZERO)


def independent(D: list[Column]) -> tuple[list[int], list[Column]]:
    """Rows of D that are independent, as many as its rank, and a basis of its left null space."""
    m = len(D)
    work = [row + [Decimal(i == k) for k in range(m)] for i, row in enumerate(D)]
    left, rows = list(range(m)), []
    size = max((abs(v) for row in D for v in row), default=ZERO)
    for column in range(m):
        pivot = max(left, key=lambda i: abs(work[i][column]), default=None)
        if pivot is None or abs(work[pivot][column]) <= TINY * size:
            continue
        left.remove(pivot)
        rows.append(pivot)
        for i in left:
            factor = work[i][column] / work[pivot][column]
            work[i] = [a - factor * b for a, b in zip(work[i], work[pivot], strict=True)]
    return rows, [work[i][m:] for i in left]


def expand(tape: Tape, rows: list[int], t: Decimal, x: Column, order: int) -> bool:
    """Series of x and l up to an order, with y = 0 on held rows; False where l does not follow from it."""
    set_start(tape, t, x, order)
    states, l = tape.inputs[1:]
    held = _first(tape, rows)
    if held is None:
        return False
    for k in range(1, order + 1):
        _next(states, tape.order(0, k - 1), k)
        for series in l:
            series[k:] = [ZERO]
        tape.run(k)
        if not rows:
            continue
        after: Column = []
        if held.null:
            _next(states, tape.order(0, k), k + 1)
            for series in l:
                series[k + 1 :] = [ZERO]
            tape.run(k + 1, "rows")
            after = [(k + 1) * tape.order(1, k + 1)[i] for i in rows]
        now = tape.order(1, k)
        found = solve(held.matrix, held.right([-now[i] for i in rows], [-v for v in after]))
        if found is None:
            return False
        for series, v in zip(l, found, strict=True):
            series[k:] = [v]
        tape.run(k, "moving")
        size = 1 + max(map(abs, [*now, *found]))
        assert all(abs(tape.order(1, k)[rows[i]]) <= TINY * size for i in held.own)
    return True


def _next(states: list[Series], rate: Column, k: int) -> None:
    for series, v in zip(states, rate, strict=True):
        series[k:] = [v / k]


def _first(tape: Tape, rows: list[int]) -> Held | None:
    """l at order 0 by Newton's method."""
    l = tape.inputs[2]
    for series in l:
        series[:] = [ZERO]
    for _ in range(60):
        tape.run(0)
        held, y = Held(tape, rows), [tape.order(1, 0)[i] for i in rows]
        step = solve(held.matrix, held.right(y, held.speeds)) if rows else []
        if step is None:
            return None
        for series, v in zip(l, step, strict=True):
            series[:] = [series[0] - v]
        if all(abs(v) <= Decimal("1e-50") * (1 + abs(series[0])) for series, v in zip(l, step, strict=True)):
            tape.run(0)
            return held if all(abs(tape.order(1, 0)[i]) <= TINY for i in rows) else None
    return None
