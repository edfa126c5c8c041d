"""Tables of measured or planned values: held, joined by straight lines, or by the natural cubic spline.

One value for each step of a constant grid: what an optimiser or a recorded controller gives.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from nsmodel._utils import cached_per_object, checks_keywords, short_repr
from nsmodel.errors import ModelError
from nsmodel.modeling.signals.base import (
    NEAR_TOLERANCE,
    SLOPE_ROUND_UP,
    Signal,
    SignalJump,
    Within,
    check_choice,
    check_increasing,
    constant_bounds,
    just_after,
    just_before,
    period_numbers,
    read_numbers,
)

TABLE_KINDS = ("hold", "linear", "cubic")
AFTER_RULES = ("hold", "error", "periodic")
MIN_SPLINE_ROWS = 4  # Rows of a cubic table, at least: a cubic has four coefficients.


@dataclass(frozen=True, eq=False)
class Table(Signal):
    """Rows at times t (N,) of values (N, nu), see `table`; ``period``: None where the table is not repeated."""

    t: np.ndarray
    values: np.ndarray
    kind: str
    must_reach: bool
    period: float | None

    __repr__ = short_repr

    @property
    def size(self) -> int:
        """The number of columns of the table."""
        return self.values.shape[1]

    @property
    def flat(self) -> bool:
        """Whether values are held between rows."""
        return self.kind == "hold"

    def in_time(self, tau: float) -> Table:
        """Its rows and its period are later."""
        return replace(self, t=tau * self.t, period=None if self.period is None else tau * self.period)

    def check_valid(self, label: str, t_end: float) -> None:
        """A table that must not end before the run does."""
        if self.must_reach and self.t[-1] < just_before(np.array(t_end)):
            raise ModelError(
                f"{label}: its table ends at t = {self.t[-1]:.10g}, before the run does at {t_end:.10g}; give more rows, or "
                "after='hold' or 'periodic'"
            )

    @property
    def degree(self) -> int:
        """The degree between rows, by the kind of interpolation."""
        return {"hold": 0, "linear": 1, "cubic": 3}[self.kind]

    def joints(self, t_end: float) -> np.ndarray:
        """All of its rows."""
        return self._repeat_times(self.t, t_end)

    def derivatives(self, t: float) -> np.ndarray:
        """Of the part that begins at t, or that t lies in; 0 outside of the table."""
        at = np.array([t])
        seen = just_after(at)
        start = self._period_start(np.floor, seen)
        row, found = int(np.searchsorted(self.t, seen - start, side="right")[0]) - 1, np.zeros((self.degree + 1, self.size))
        found[0] = self.after(at)[0]
        if self.kind == "hold" or not 0 <= row < self.t.size - 1:
            return found
        if self.kind == "linear":
            found[1] = (self.values[row + 1] - self.values[row]) / (self.t[row + 1] - self.t[row])
        else:
            for k in range(1, 4):
                found[k] = _natural_spline(self)((at - start)[0], k)
        return found

    def edges(self, t_end: float) -> np.ndarray:
        """Where a held value changes; where a time stands twice; where a period ends elsewhere than it began."""
        moves = (np.diff(self.values, axis=0) != 0).any(axis=1)
        at = self.t[1:][moves if self.kind == "hold" else moves & (np.diff(self.t) == 0)]
        if self.period is not None and (self.values[0] != self.values[-1]).any():
            at = np.append(at, self.t[0] + self.period)
        return self._repeat_times(at, t_end)

    def kinks(self, t_end: float) -> np.ndarray:
        """The rows of a polyline; the ends of a spline."""
        return self._repeat_times(
            self.t[:0] if self.kind == "hold" else self.t if self.kind == "linear" else self.t[[0, -1]], t_end
        )

    def _repeat_times(self, at: np.ndarray, t_end: float) -> np.ndarray:
        if self.period is not None and at.size:
            first, last = np.floor(-at[-1] / self.period), np.floor((t_end - at[0]) / self.period)
            k = period_numbers(first, last, self.period)
            at = (at + self.period * k[:, None]).ravel()
        return np.unique(at[(at >= 0) & (at <= t_end)])

    def after(self, t: np.ndarray) -> np.ndarray:
        """Of the row, or on the part of the curve, that begins at t."""
        seen = just_after(t)
        start = self._period_start(np.floor, seen)
        return self._values_on_part(np.searchsorted(self.t, seen - start, side="right") - 1, t - start)

    def before(self, t: np.ndarray) -> np.ndarray:
        """Of that which ends there."""
        seen = just_before(t)
        start = self._period_start(lambda share: np.ceil(share) - 1, seen)
        return self._values_on_part(np.searchsorted(self.t, seen - start, side="left") - 1, t - start)

    @property
    def numbers(self) -> dict[str, float]:
        """Its values; but of a spline, the times of its rows that stand once, but the first; of a held one its period."""
        columns = [""] if self.size == 1 else [f",{j}" for j in range(self.size)]
        found = {f"[{i}{c}]": v for i, row in enumerate(self.values.tolist()) for c, v in zip(columns, row, strict=True)}
        if self.kind != "cubic":
            once = [i for i in range(1, self.t.size) if self.t[i] not in (self.t[i - 1], *self.t[i + 1 : i + 2])]
            found |= {f".t[{i}]": float(self.t[i]) for i in once}
        return found if self.period is None or self.kind != "hold" else {**found, ".period": self.period}

    def with_number(self, number: str, value: float) -> Table:
        """With another entry, time of a row, or period."""
        if number == ".period":
            return replace(self, period=value)
        name, array = ("t", self.t.copy()) if number.startswith(".t") else ("values", self.values.copy())
        place = tuple(int(part) for part in number[number.index("[") + 1 : -1].split(","))
        array[place if name == "t" or len(place) == 2 else (place[0], 0)] = value
        return replace(self, **{name: array})

    def joint_slopes(self, t: float) -> dict[str, float]:
        """Of t_i + k period."""
        start = self._period_start(np.floor, just_after(np.array([t])))[0]
        near = np.flatnonzero(np.abs(self.t + start - t) <= 4 * NEAR_TOLERANCE * max(abs(t), abs(start)))
        found = {f".t[{i}]": 1.0 for i in near.tolist()}
        return found if self.period is None or not near.size else {**found, ".period": start / self.period}

    def derivative_slopes(self, t: float) -> dict[str, np.ndarray]:
        """Those of the part that begins at t, or that t lies in."""
        start = float(self._period_start(np.floor, just_after(np.array([t])))[0])
        row = int(np.searchsorted(self.t, just_after(np.array([t - start])), side="right")[0]) - 1
        rows = range(self.t.size) if self.kind == "cubic" else [max(row, 0)]
        if self.kind != "linear" or not 0 <= row < self.t.size - 1:
            return self._entry_slopes({i: self._unit_slopes(i, t) for i in rows})
        length, rise = self.t[row + 1] - self.t[row], self.values[row + 1] - self.values[row]
        share = (t - start - self.t[row]) / length
        both = {row: np.array([1 - share, -1 / length]), row + 1: np.array([share, 1 / length])}
        by_time = {f".t[{i}]": np.outer(slopes, -rise / length) for i, slopes in both.items()}
        return self._entry_slopes(both) | by_time

    def _unit_slopes(self, row: int, t: float) -> np.ndarray:
        """`derivatives` of the table that is 1 in one row, and 0 elsewhere (degree + 1,)."""
        unit = np.zeros((self.t.size, 1))
        unit[row] = 1.0
        return replace(self, values=unit).derivatives(t)[:, 0]

    def _entry_slopes(self, of_rows: dict[int, np.ndarray]) -> dict[str, np.ndarray]:
        columns = [("", 0)] if self.size == 1 else [(f",{j}", j) for j in range(self.size)]
        unit = np.eye(self.size)
        return {f"[{i}{name}]": np.outer(slopes, unit[j]) for i, slopes in of_rows.items() for name, j in columns}

    def within(self, t_end: float) -> Within:
        """Between the least and the largest value of the whole table; the steepest slope."""
        first, smooth = self.after(np.zeros(1))[0], t_end > 0 and self.jump(t_end) is None
        if smooth and self.kind == "hold":
            return constant_bounds(first)
        if self.kind == "cubic":
            low, high, slope = _spline_extremes(self)
        else:
            low, high = self.values.min(axis=0), self.values.max(axis=0)
            run, rise = np.diff(self.t), np.diff(self.values, axis=0)
            slope = np.abs(rise[run > 0] / run[run > 0, None]).max(axis=0, initial=0.0) * SLOPE_ROUND_UP
        if (low == high).all():
            return constant_bounds(low)
        return Within(low, high, slope if smooth else None, first)

    def _period_start(self, whole: Any, seen: np.ndarray) -> np.ndarray:
        """By how much the period that times lie in is later than the table."""
        return np.zeros_like(seen) if self.period is None else self.period * whole((seen - self.t[0]) / self.period)

    def _values_on_part(self, row: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Values at t, which lies in the part that begins with this row; -1: before the first."""
        if self.kind == "hold" or self.t.size == 1:
            return self.values[np.maximum(row, 0)]
        t = np.clip(t, self.t[0], self.t[-1])
        if self.kind == "cubic":
            return _natural_spline(self)(t)
        at = np.clip(row, 0, self.t.size - 2)
        length = self.t[at + 1] - self.t[at]
        share = np.divide(t - self.t[at], length, out=np.where(row < 0, 0.0, 1.0), where=length > 0)[:, None]
        first, last = self.values[at], self.values[at + 1]
        return np.where(share >= 1, last, first + share * (last - first))


@cached_per_object
def _natural_spline(table: Table) -> Any:
    from scipy.interpolate import CubicSpline

    return CubicSpline(table.t, table.values, bc_type="natural")


def _spline_extremes(table: Table) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The least and the largest value of the spline, and its steepest slope, for each column: at rows, and where the next
    derivative vanishes between them.
    """
    spline, found = _natural_spline(table), []
    for k in range(table.size):
        column = type(spline)(table.t, table.values[:, k], bc_type="natural")
        turning_points = [
            np.append(own[np.isfinite(own)], table.t) for own in (column.derivative(d).roots(extrapolate=False) for d in (1, 2))
        ]
        values, slopes = column(turning_points[0]), column(turning_points[1], 1)
        room = (SLOPE_ROUND_UP - 1) * np.abs(values).max()
        found.append((values.min() - room, values.max() + room, np.abs(slopes).max() * SLOPE_ROUND_UP))
    low, high, slope = np.array(found).T
    return low, high, slope


@checks_keywords
def table(t: Any, values: Any, kind: str = "hold", *, after: str = "hold", period: float | None = None) -> Table:
    """A signal given by rows.

    Args:
        t: times (N,), increasing; of kind "linear" a time that stands twice is a jump.
        values: (N,), or (N, nu) for an input of nu values.
        kind: "hold" keeps each row's value till the next; "linear" joins them by straight lines; "cubic" by the natural cubic
            spline (second derivative 0 at both ends).
        after: what follows the last row: "hold" keeps its value, "error" refuses a run that goes on longer, "periodic" repeats
            the table every ``period``, also before its first row. Else the first row's value holds before it.
        period: of after="periodic"; left out: from the first row to the last. A held table needs it.

    Raises:
        ModelError: shapes that do not fit, times out of order, NaN, fewer than 4 rows of a spline.
    """
    check_choice("table", "kind", kind, TABLE_KINDS)
    check_choice("table", "after", after, AFTER_RULES)
    times, given = read_numbers("table", "t", t, 1), read_numbers("table", "values", values, 1, 2)
    if not times.size or len(given) != times.size:
        raise ModelError(f"table: {times.size} times and {len(given)} rows of values; expected a row for each time, one at least")
    check_increasing("table", "t", times, strictly=kind != "linear")
    for i in np.flatnonzero(times[2:] == times[:-2])[:1]:
        raise ModelError(f"table: t[{i}] = {times[i]:.10g} occurs three times; a jump has two rows, one before and one after")
    if kind == "cubic" and times.size < MIN_SPLINE_ROWS:
        raise ModelError(f"table: kind='cubic' and {times.size} rows; expected {MIN_SPLINE_ROWS} or more, or kind='linear'")
    again = _table_period(times, kind, period) if after == "periodic" else None
    if again is None and period is not None:
        raise ModelError(f"table: period = {period!r} and after={after!r}; give after='periodic', or leave period out")
    return Table(times, given.reshape(times.size, -1), kind, after == "error", again)


def _table_period(t: np.ndarray, kind: str, given: Any) -> float:
    """The period of a table that is repeated; ModelError where there is none."""
    length = float(t[-1] - t[0])
    if given is None and kind == "hold":
        raise ModelError("table: after='periodic' needs period=, since it is not known how long the last row is held")
    period = length if given is None else float(read_numbers("table", "period", given, 0))
    held = kind == "hold"
    if not period > 0 or (period <= length if held else abs(period - length) > 1e-12 * period):
        expected = (
            f"more than {length:.10g}, the time from the first row to the last" if held else f"{length:.10g} = t[-1] - t[0]"
        )
        raise ModelError(f"table: period = {period:.10g}; expected {expected}")
    return period


@dataclass(frozen=True, eq=False)
class Steps(Signal):
    """Values (N, nu), a row a step; see `steps`."""

    values: np.ndarray

    __repr__ = short_repr

    @property
    def size(self) -> int:
        """The number of columns of the table."""
        return self.values.shape[1]

    @property
    def count(self) -> int:
        """The number of rows, one for each step."""
        return len(self.values)

    @property
    def jump_steps(self) -> np.ndarray:
        """Those whose row is another than the one before."""
        return np.flatnonzero((np.diff(self.values, axis=0) != 0).any(axis=1)) + 1

    def in_time(self, tau: float) -> Self:
        """The same: it knows steps, and no time."""
        return self

    def within(self, t_end: float) -> Within:
        """The least and the largest of each column."""
        low, high = self.values.min(axis=0), self.values.max(axis=0)
        return constant_bounds(low) if (low == high).all() else Within(low, high, None, self.values[0])

    def jump(self, t_end: float) -> SignalJump | None:
        """The largest change from a step to the next, of equal steps."""
        size = np.abs(np.diff(self.values, axis=0)).max(axis=1, initial=0.0)
        k = int(size.argmax()) if size.size else 0
        return SignalJump(t_end * (k + 1) / self.count, *self.values[k : k + 2]) if size.any() else None

    def limits(self, t: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
        """The rows of the steps."""
        rows = self.values[number : number + t.size - 1]
        return rows, rows


@checks_keywords
def steps(values: Any) -> Steps:
    """A signal that is held over each step of the run's grid: values (N,), or (N, nu), a row a step.

    The grid is that of the run's step; edges of other inputs must not add steps to it.

    Raises:
        ModelError: NaN, another shape. When a run begins, UsageError: another number of rows than steps.
    """
    given = read_numbers("steps", "values", values, 1, 2)
    return Steps(given.reshape(len(given), -1))
