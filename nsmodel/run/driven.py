"""What steps are given of the inputs: their limits at both ends; after a jump a carried reaction of the new regime."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable

import numpy as np

from nsmodel.errors import UsageError
from nsmodel.grid import SAME, Grid
from nsmodel.signals.drive import Drive

BLOCK, MOST = 4096, 65536  # Steps whose inputs are computed at a time: one by one, and in C at most.

Put = Callable[[np.ndarray], np.ndarray]
Starter = Callable[[float, float, np.ndarray], np.ndarray]  # (t, h, state) -> the state whose carried reaction is that at t.


class OnSteps:
    """The inputs of the steps of a grid; ``starter``: None where no reaction is carried."""

    def __init__(self, grid: Grid, drive: Drive, starter: Starter | None) -> None:
        self._grid, self._drive, self._starter = grid, drive, starter
        self._first, self._limits = 0, np.zeros((0, 2 * drive.size))
        at = np.zeros(0, int) if grid.times is None else np.searchsorted(grid.times, drive.jumps)
        turns = [signal.turns for signal in drive.signals.values()]
        self._jumps = [] if starter is None else np.unique(np.concatenate([at, *turns])).tolist()  # Numbers of steps.

    def state(self, state: np.ndarray, k: int) -> np.ndarray:
        """The state that step k starts from."""
        limits = self._of(k, 1)[0]
        started = np.concatenate([state[: state.size - limits.size], limits])
        jumps = self._next_jump(k - 1) == k
        return self._starter(self._grid.time(k), self._grid.step(k), started) if self._starter is not None and jumps else started

    def block(self, state: np.ndarray, k: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
        """The state that step k starts from, and the limits (K, 2 nu) of at most so many steps that need no other start."""
        return self.state(state, k), self._of(k, min(steps, MOST, self._next_jump(k) - k))

    def _next_jump(self, k: int) -> int:
        """The number of the first step after step k that begins with a jump; that of all where there is none."""
        at = bisect_right(self._jumps, k)
        return self._jumps[at] if at < len(self._jumps) else self._grid.N

    def _of(self, k: int, steps: int) -> np.ndarray:
        """u(a+), u(b-) side by side (K, 2 nu) of ``steps`` steps from number k."""
        first, count = self._first, len(self._limits)
        if not first <= k <= k + steps <= first + count:
            count = min(max(steps, BLOCK), self._grid.N - k)
            self._first, self._limits = k, self._drive.limits(self._grid.between(k, k + count), k)
        return self._limits[k - self._first : k - self._first + steps]


class OverSpans:
    """The inputs of steps of any length between the points of a drive; ``at``: where a state has them."""

    def __init__(self, drive: Drive, at: slice, starter: Starter | None) -> None:
        self._drive, self._at, self._starter = drive, at, starter
        for name, signal in drive.signals.items():
            if signal.count is not None:
                raise UsageError(f"input '{name}': steps(...) has a row a step, and rtol chooses the steps; give table, or step=")

    @property
    def flat(self) -> bool:
        """Whether inputs are constant between the points: then the states of a span have them."""
        return all(signal.flat for signal in self._drive.signals.values())

    def begun(self, state: np.ndarray, t: float, length: float) -> np.ndarray:
        """The state at the begin of a span, its reaction found anew where an input jumps."""
        state = self._put(state, self._drive.limits(np.array([t, t + length]))[0])
        jumps = self._starter is not None and (np.abs(self._drive.jumps - t) <= SAME * t).any()
        return self._starter(t, length, state) if self._starter is not None and jumps else state

    def halves(self, state: np.ndarray, times: list[float]) -> tuple[np.ndarray, np.ndarray, Put]:
        """Of a step with begin, middle and end: the state for its first half, for all of it; what makes that for its second."""
        first, second = self._drive.limits(np.array(times))
        nu = first.size // 2
        whole = np.concatenate([first[:nu], second[nu:]])
        return self._put(state, first), self._put(state, whole), lambda middle: self._put(middle, second)

    def closing(self, state: np.ndarray) -> np.ndarray:
        """The state with u of the end of its step at both ends."""
        u = state[self._at]
        return self._put(state, np.tile(u[u.size // 2 :], 2))

    def _put(self, state: np.ndarray, limits: np.ndarray) -> np.ndarray:
        state = state.copy()
        state[self._at] = limits
        return state
