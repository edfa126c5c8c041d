"""The signals of all inputs of a model over a run: the points that its grid must have, and what each step sees."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nsmodel.errors import UsageError
from nsmodel.modeling.signals.base import Signal, just_after, just_before
from nsmodel.modeling.signals.pwm import Pwm


@dataclass(frozen=True, eq=False)
class InputSchedule:
    """Signals, by input, up to t_end.

    Attributes:
        points: the times within (0, t_end) at which one jumps or bends, or a block ticks, those that are near each other as one;
            jumps: those of them at which one jumps.
    """

    signals: Mapping[str, Signal]
    points: np.ndarray
    jumps: np.ndarray

    @classmethod
    def of(cls, signals: Mapping[str, Signal], t_end: float, ticks: Sequence[np.ndarray] = ()) -> InputSchedule:
        """Look for the points, with ``ticks`` of blocks; ModelError where a signal is none up to there."""
        for name, signal in signals.items():
            signal.check_valid(f"input '{name}'", t_end)
        edges = [signal.edges(t_end) for signal in signals.values()]
        kinks = [signal.kinks(t_end) for signal in signals.values()]
        points = merge_near_times(np.concatenate([*edges, *kinks, *ticks, np.zeros(0)]))
        points = points[points < just_before(np.array(t_end))]
        jumps = np.concatenate([*edges, np.zeros(0)])
        at = np.searchsorted(points, just_before(jumps))
        return cls(signals, points, points[np.unique(at[at < points.size])] if points.size else points)

    @property
    def moving(self) -> int:
        """The most edges between two points that blocks place."""
        return sum(signal.moving for signal in self.signals.values())

    def holding(self, kept: Mapping[str, np.ndarray]) -> InputSchedule:
        """The signals with what blocks hold now."""
        return replace(self, signals={name: signal.holding(kept) for name, signal in self.signals.items()})

    def within(self, a: float, b: float) -> np.ndarray:
        """Both times, and between them the edges of PWMs that blocks have placed."""
        found = [signal.pulse(a) for signal in self.signals.values() if isinstance(signal, Pwm)]
        times = merge_near_times(np.concatenate([*found, np.zeros(0)]))
        return np.concatenate([[a], times[(times > just_after(np.array(a))) & (times < just_before(np.array(b)))], [b]])

    def check_step_counts(self, N: int) -> None:
        """UsageError where a signal is for another number of steps than a run's."""
        for name, signal in self.signals.items():
            if signal.count is not None and signal.count != N:
                raise UsageError(f"input '{name}': steps(...) has {signal.count} rows, and the run {N} steps; give one for each")

    @property
    def size(self) -> int:
        """The number of inputs."""
        return sum(signal.size for signal in self.signals.values())

    def limits(self, t: np.ndarray, number: int = 0) -> np.ndarray:
        """u(a+), u(b-) side by side (K, 2 nu) of the steps between times (K + 1,), the first of which has this number."""
        both = [signal.limits(t, number) for signal in self.signals.values()]
        return np.hstack([part for side in (0, 1) for part in (limits[side] for limits in both)])

    def jump_steps(self, times: np.ndarray | None) -> list[int]:
        """The numbers, in order, of the steps that begin with a jump, of a grid with these times; None: it ends at no edge."""
        at = np.zeros(0, int) if times is None else np.searchsorted(times, self.jumps)
        return np.unique(np.concatenate([at, *(signal.jump_steps for signal in self.signals.values())])).tolist()

    def rows(self, t: np.ndarray, before: np.ndarray) -> dict[str, np.ndarray]:
        """The columns of rows at t (N,), each after a row at another time: u(t-), and u+ at that other time; at 0 u(0+) both."""
        begin = np.hstack([signal.after(before) for signal in self.signals.values()])
        end = np.hstack([signal.before(t) for signal in self.signals.values()])
        return {"inputs": np.where(t[:, None] > 0, end, begin), "inputs_begin": begin}


def merge_near_times(times: np.ndarray) -> np.ndarray:
    """Times after 0, in order; of those that are near each other the first."""
    times = np.sort(times[times > 0])
    return times[np.append(True, times[1:] > just_after(times[:-1]))] if times.size else times
