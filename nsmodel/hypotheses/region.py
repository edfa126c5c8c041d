"""The region over which hypotheses about all states are decided: a box of states and an interval of time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import casadi as ca
import numpy as np

from nsmodel._utils import short_repr
from nsmodel.errors import UsageError
from nsmodel.hypotheses.scope import IntervalBox, Scope
from nsmodel.modeling.base import Model
from nsmodel.modeling.pickling import Picklable
from nsmodel.simulation.trajectory import Trajectory

BOX_GROWTH = 1.5  # The box is this much wider than the runs.


@dataclass(frozen=True)
class Region(Picklable):
    """A box: lower (n,), upper (n,) of the states, t0 <= t <= t1; ``origin`` says where it comes from.

    ``parameters`` are the boxes of parameters that stayed symbols, in the order of the model's ``p``.
    """

    lower: np.ndarray
    upper: np.ndarray
    t0: float
    t1: float
    names: tuple[str, ...]
    origin: str
    parameters: IntervalBox = field(default_factory=lambda: MappingProxyType({}))

    __repr__ = short_repr

    def bounds_with_time(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds (n + 1,) of (t, x)."""
        return np.concatenate([[self.t0], self.lower]), np.concatenate([[self.t1], self.upper])

    def parameter_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds (k,) of the parameters that stayed symbols."""
        ends = np.array(list(self.parameters.values()), float).reshape(-1, 2)
        return ends[:, 0], ends[:, 1]

    def widened(self, factor: float) -> Region:
        """The box with the same middle, that many times as wide."""
        middle, half = (self.lower + self.upper) / 2, factor * (self.upper - self.lower) / 2
        return replace(self, lower=middle - half, upper=middle + half, origin=f"{factor:g} times {self.origin}")

    def scope(self, local: bool | Iterable[str] = False, timed: bool = False) -> Scope | None:
        """The scope of what was decided on the box (of these states, where they are named), or in its interval of time."""
        own = set(self.names if local is True else local or ())
        ends = zip(self.names, self.lower.tolist(), self.upper.tolist(), strict=True)
        states = {name: (low, high) for name, low, high in ends if name in own}
        return Scope(states, (self.t0, self.t1)) if timed else Scope(states) if states else None

    @property
    def text(self) -> str:
        """One line, for reports."""
        n = len(self.names)
        intervals = [f"{name} in [{a:.4g}, {b:.4g}]" for name, a, b in zip(self.names, self.lower, self.upper, strict=True)]
        states = ", ".join(intervals if n <= 6 else [*intervals[:4], f"... ({n} states)"])
        return f"{states}, t in [{self.t0:.4g}, {self.t1:.4g}] ({self.origin})"


def region_of(model: Model, runs: Sequence[Trajectory], given: Mapping[str, Any] | None = None) -> Region:
    """Return the box around the runs, wider by half; states named in ``given`` have their own interval.

    Of many bodies it is the box of one body, around all of them: its states are ``i.q_0``, ``i.q_1``, ..., its stem is ``i.q``.

    Args:
        model: bound.
        runs: trajectories; without any, the box lies around the start.
        given: {state or stem: (low, high)}.

    Raises:
        UsageError: an unknown name, or no interval low < high of finite numbers.
    """
    (names, stems), (low, high) = model.axes, _state_ranges(model, runs)
    centre, half = (high + low) / 2, (high - low) / 2
    widest = half.max(initial=0.0) or np.abs(centre).max(initial=0.0) or 1.0
    half = np.maximum(BOX_GROWTH * half, np.maximum(0.1 * np.abs(centre), 0.25 * widest))
    lower, upper = centre - half, centre + half
    origin = f"{BOX_GROWTH:g} times the box around the run" if runs else "a box around the start"
    for name, interval in (given or {}).items():
        rows = [names.index(name)] if name in names else stems.get(name)
        if rows is None:
            raise UsageError(f"region: '{name}' is no state; the model has {', '.join(names)}")
        try:
            low, high = (float(end) for end in interval)
        except (TypeError, ValueError):
            low = high = np.nan
        if not -np.inf < low < high < np.inf:
            raise UsageError(f"region: {name} = {interval!r}; expected a pair (low, high) of finite numbers, low < high")
        lower[rows], upper[rows] = low, high
        origin = "as given"
    t1 = max([float(model.t_end or 0.0), *(float(run.t[-1]) for run in runs)])
    return Region(lower, upper, 0.0, t1, names, origin)


def enclosing_region(regions: Sequence[Region], parameters: IntervalBox) -> Region:
    """The box around boxes of the same states, for boxes of parameters."""
    lower, upper = (by([getattr(r, end) for r in regions], axis=0) for end, by in (("lower", np.min), ("upper", np.max)))
    t1 = max(region.t1 for region in regions)
    return replace(regions[0], lower=lower, upper=upper, t1=t1, parameters=MappingProxyType(dict(parameters)))


def _state_ranges(model: Model, runs: Sequence[Trajectory]) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest of what the start and the runs go through; rows that are not finite do not count."""
    start = np.array(ca.DM(model.start)).ravel()
    parts = [model.points(rows) for rows in (start[None, :], *(run.smooth().x for run in runs))]
    known = [np.all(np.isfinite(part), axis=1)[:, None] for part in parts]
    low = [np.min(part, axis=0, where=finite, initial=np.inf) for part, finite in zip(parts, known, strict=True)]
    high = [np.max(part, axis=0, where=finite, initial=-np.inf) for part, finite in zip(parts, known, strict=True)]
    return np.min(low, axis=0), np.max(high, axis=0)
