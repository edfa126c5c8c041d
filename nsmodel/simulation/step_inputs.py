"""What steps are given of the inputs: their limits at both ends; after a jump a carried reaction of the new regime.

The inputs of steps that are given one by one: what each is given, signals, and what blocks set.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from nsmodel.errors import ModelError, UsageError
from nsmodel.modeling.base import Model
from nsmodel.modeling.blocks import BlockTicks, model_ticks
from nsmodel.modeling.inputs import signals_by_name
from nsmodel.modeling.signals.base import ConstantSignal, just_after, just_before
from nsmodel.modeling.signals.schedule import InputSchedule
from nsmodel.modeling.time_grid import SAME_STEP_TOLERANCE, TimeGrid, count_equal_steps, input_schedule, subdivide_intervals
from nsmodel.modeling.variants import block_input_entries, initial_inputs
from nsmodel.simulation.trajectory import Trajectory

# INPUT_BLOCK_STEPS: more cost less each, and memory.
INPUT_BLOCK_STEPS, MAX_INPUT_BLOCK_STEPS = 4096, 65536  # Steps whose inputs are computed at a time: one by one, and in C at most.

StateMap = Callable[[np.ndarray], np.ndarray]
StateInitialiser = Callable[
    [float, float, np.ndarray], np.ndarray
]  # (t, h, state) -> the state whose carried reaction is that at t.


def reinitialised_step_mask(model: Model, run: Trajectory) -> np.ndarray:
    """The steps (N,) of a run that begin with a jump of an input: with a reaction that is no row's."""
    jumps, at = InputSchedule.of(model.inputs, float(run.t[-1])).jumps, block_input_entries(model)
    changed = (run.inputs_begin[1:, at] != run.inputs[:-1, at]).any(axis=1)
    return changed | (np.abs(run.t[:-1, None] - jumps) <= SAME_STEP_TOLERANCE * jumps).any(axis=1)


class GridInputs:
    """The inputs of the steps of a grid; ``starter``: None where no reaction is carried, ``ticks``: no blocks."""

    def __init__(self, grid: TimeGrid, drive: InputSchedule, starter: StateInitialiser | None, ticks: BlockTicks | None) -> None:
        self._grid, self._drive, self._starter = grid, drive, starter
        self._first, self._limits = 0, np.zeros((0, 2 * drive.size))
        self._jumps = [] if starter is None else drive.jump_steps(grid.times)
        self._blocks = None if ticks is None else TickingBlocks(grid, drive, ticks)

    def state(self, state: np.ndarray, k: int, l: np.ndarray) -> np.ndarray:
        """The state that step k starts from; ``l``: of the step before."""
        jumps = self._tick_blocks(self._blocks, state, k, l) if self._blocks is not None else False
        limits = self._step_limits(k, 1)[0]
        started = np.concatenate([state[: state.size - limits.size], limits])
        if self._starter is None or not (jumps or self._next_jump(k - 1) == k):
            return started
        return self._starter(self._grid.time(k), self._grid.step(k), started)

    def block(self, state: np.ndarray, k: int, steps: int, l: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The state that step k starts from, and the limits (K, 2 nu) of at most so many steps that need no other start."""
        started, end = self.state(state, k, l), self._next_jump(k)
        end = end if self._blocks is None else min(end, self._blocks.next(k))
        return started, self._step_limits(k, min(steps, MAX_INPUT_BLOCK_STEPS, end - k))

    def seek(self, state: np.ndarray, k: int) -> None:
        """Take up a run before step k."""
        if self._blocks is not None:
            self._blocks.seek(state, k)

    def _tick_blocks(self, blocks: TickingBlocks, state: np.ndarray, k: int, l: np.ndarray) -> bool:
        """Let the blocks tick that do before step k; whether it begins with another value or edge of theirs."""
        signals = self._step_limits(k, 1)[0, : self._drive.size] if blocks.due_blocks(k) else None
        jumps, planned = blocks.before(state, k, l, signals)
        if planned:  # with other times, from k on
            self._first, self._limits = k, self._limits[:0]
        return jumps

    def _next_jump(self, k: int) -> int:
        """The number of the first step after step k that begins with a jump; that of all where there is none."""
        at = bisect_right(self._jumps, k)
        return self._jumps[at] if at < len(self._jumps) else self._grid.N

    def _step_limits(self, k: int, steps: int) -> np.ndarray:
        """u(a+), u(b-) side by side (K, 2 nu) of ``steps`` steps from number k."""
        first, count = self._first, len(self._limits)
        if not first <= k <= k + steps <= first + count:
            drive, end = (self._drive, self._grid.N) if self._blocks is None else self._blocks.planned_signals(k)
            count = min(max(steps, INPUT_BLOCK_STEPS), end - k)
            self._first, self._limits = k, drive.limits(self._grid.between(k, k + count), k)
        found = self._limits[k - self._first : k - self._first + steps]
        if self._blocks is not None:
            self._blocks.put(found)
        return found


class TickingBlocks:
    """Blocks along a grid: what they hold, and the times between its points that they place."""

    def __init__(self, grid: TimeGrid, drive: InputSchedule, ticks: BlockTicks) -> None:
        self._grid, self._drive, self._ticks, self._now = grid, drive, ticks, drive
        times = np.zeros(1) if grid.times is None else grid.times
        self._due = [set(numbers.tolist()) - {0} for numbers in ticks.tick_rows(times)]  # Of each block, numbers of steps.
        self._at = np.concatenate([ticks.at, ticks.at + drive.size])
        points = [] if grid.times is None else np.searchsorted(times, just_before(drive.points)).tolist()
        self._spans = [0, *points, grid.N] if drive.moving else [0, grid.N]  # Numbers of the steps between which edges move.
        self._begins = set(self._spans)
        self._stops = [*sorted(set().union(*self._due, self._spans if drive.moving else ())), grid.N]
        self._edges: set[int] = set()
        self._held = np.zeros(ticks.at.size)

    def due_blocks(self, k: int) -> list[int]:
        """The blocks that tick before step k."""
        return [i for i, numbers in enumerate(self._due) if k in numbers or (k and i in self._ticks.each_step)]

    def next(self, k: int) -> int:
        """The number of the first step after step k before which something may change."""
        return k + 1 if self._ticks.each_step else self._stops[bisect_right(self._stops, k)]

    def before(self, state: np.ndarray, k: int, l: np.ndarray, signals: np.ndarray | None) -> tuple[bool, bool]:
        """Tick, where something is due before step k: whether it begins with a jump, whether times were placed.

        Args:
            state: at the end of the step before; l: its multipliers.
            k: the number of the step.
            signals: u(t_k+) where something is due.
        """
        held = state[-self._drive.size :][self._ticks.at]
        was, self._held = held, held
        if signals is not None:
            u = signals.copy()
            u[self._ticks.at] = held
            u = self._ticks.after(self.due_blocks(k), self._grid.time(k), state[: self._ticks.states], l, u)
            self._held = u[self._ticks.at]
        placed = bool(self._drive.moving) and k in self._begins
        if placed:
            self._place_edges(k)
        return bool((self._held != was).any()) or k in self._edges, placed

    def seek(self, state: np.ndarray, k: int) -> None:
        """Take up a run before step k, in the middle of what was placed."""
        self._held = state[-self._drive.size :][self._ticks.at]
        if self._drive.moving and k not in self._begins:
            self._place_edges(k)

    def planned_signals(self, k: int) -> tuple[InputSchedule, int]:
        """The signals with what blocks hold, and the number of the step up to which these are known."""
        return self._now, self._spans[bisect_right(self._spans, k)]

    def put(self, limits: np.ndarray) -> None:
        """Write what is held into the limits (K, 2 nu) of steps."""
        limits[:, self._at] = np.concatenate([self._held, self._held])

    def _place_edges(self, k: int) -> None:
        """Place the times of the span of step k: a step ends at each edge, and there are as many steps as the grid has."""
        i = bisect_right(self._spans, k) - 1
        first, last = self._spans[i], self._spans[i + 1]
        grid: Any = self._grid  # One that was made for edges.
        times, steps, h = grid.times, grid.steps, grid.requested_step
        u = np.zeros(self._drive.size)
        u[self._ticks.at] = self._held
        self._now = self._drive.holding(self._ticks.kept(u))
        ends = self._now.within(times[first], times[last])
        counts = count_equal_steps(np.diff(ends), h)
        for _ in range(last - first - counts.sum()):
            longest = np.diff(ends) / counts
            counts[np.argmax(longest > longest.max() * (1 - 1e-9))] += 1  # The first of those that rounding tells apart.
        times[first:last], steps[first:last] = subdivide_intervals(ends, counts, h)
        self._edges = set((first + np.cumsum(counts)[:-1]).tolist())


class SpanInputs:
    """The inputs of steps of any length between the points of a drive; ``at``: where a state has them.

    Raises:
        UsageError: a signal, or a block, of steps that are known beforehand.
    """

    def __init__(self, drive: InputSchedule, at: slice, starter: StateInitialiser | None, ticks: BlockTicks | None) -> None:
        self._drive, self._now, self._at, self._starter, self._ticks = drive, drive, at, starter, ticks
        for name, signal in drive.signals.items():
            if signal.count is not None:
                raise UsageError(
                    f"input '{name}': steps(...) has one row for each step, but rtol chooses the steps; give table, or step="
                )
        for block in () if ticks is None else ticks.blocks:
            if block.period is None:
                raise UsageError(
                    f"block '{block.name}' acts after each step, but rtol chooses the steps: take event-driven integration "
                    "(method='event-driven'), which finds when it acts, or step="
                )
        self._kept = np.zeros(0, int) if ticks is None else np.concatenate([ticks.at, ticks.at + drive.size])

    @property
    def flat(self) -> bool:
        """Whether inputs are constant between the points: then the states of a span have them."""
        return all(signal.flat for signal in self._drive.signals.values())

    def begin_span(self, state: np.ndarray, t: float, length: float, l: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The state at the begin of a span, its reaction found anew where an input jumps; the span's ends, and edges in it.

        ``l``: multipliers of the step before.
        """
        ticks, was, ends = self._ticks, state[self._at], np.array([t, t + length])
        if ticks is not None:
            nu = self._drive.size
            u = self._input_limits(state, ends)[0, :nu]
            u = ticks.after(ticks.due_blocks(t) if t else [], t, state[: ticks.states], l, u)
            state = self._set_inputs(state, np.tile(u, 2))
            self._now = self._drive.holding(ticks.kept(u))
            ends = self._now.within(*ends)
        state = self._set_inputs(state, self._input_limits(state, ends[:2])[0])
        jumps = bool(
            (np.abs(self._drive.jumps - t) <= SAME_STEP_TOLERANCE * t).any()
            or (state[self._at][self._kept] != was[self._kept]).any()
        )
        return (self._starter(t, length, state) if self._starter is not None and jumps else state), ends

    def halves(self, state: np.ndarray, times: list[float]) -> tuple[np.ndarray, np.ndarray, StateMap]:
        """Of a step with begin, middle and end: the state for its first half, for all of it; what makes that for its second."""
        first, second = self._input_limits(state, np.array(times))
        nu = first.size // 2
        whole = np.concatenate([first[:nu], second[nu:]])
        return self._set_inputs(state, first), self._set_inputs(state, whole), lambda middle: self._set_inputs(middle, second)

    def state_at_end(self, state: np.ndarray) -> np.ndarray:
        """The state with u of the end of its step at both ends."""
        u = state[self._at]
        return self._set_inputs(state, np.tile(u[u.size // 2 :], 2))

    def _input_limits(self, state: np.ndarray, times: np.ndarray) -> np.ndarray:
        """u(a+), u(b-) side by side (K, 2 nu) between times (K + 1,), with what blocks hold in a state."""
        limits = self._now.limits(times)
        limits[:, self._kept] = state[self._at][self._kept]
        return limits

    def _set_inputs(self, state: np.ndarray, limits: np.ndarray) -> np.ndarray:
        state = state.copy()
        state[self._at] = limits
        return state


# LOOK_AHEAD_FACTOR: so that a stepper asks log2(steps) times.
LOOK_AHEAD_FACTOR = 2.0  # Times as far as steps have come: signals are looked at up to there. (+)


class FreeInput(ConstantSignal):
    """An input whose values each step is given."""

    @property
    def values_taken(self) -> None:
        """None: any value may be given."""
        return


class StepInputs:
    """Of a bound model whose ``free`` inputs each step is given.

    Attributes:
        free: their names; at: where they are among all inputs; both: u at both ends of a step, as it is at the start.
        ticks: the model's blocks, or None; driven: whether anything but what steps are given moves.
    """

    def __init__(self, model: Any, free: Sequence[str]) -> None:
        self._model, self.free, self.ticks = model, tuple(free), model_ticks(model)
        self._sizes = {name: len(model.input_groups[name]) for name in free}
        entries = [name for name, names in model.input_groups.items() for _ in names]
        self.at = np.flatnonzero(np.isin(entries, self.free))
        moving = [name for name, signal in model.inputs.items() if signal.moving]
        self._unforeseen = np.flatnonzero(np.isin(entries, [*free, *moving]))  # And of those whose jumps no signal tells.
        self.driven = bool(model.blocks) or any(not isinstance(signal, ConstantSignal) for signal in model.inputs.values())
        self.both = np.tile(initial_inputs(model), 2)
        self._drive: InputSchedule | None = None  # The signals up to a time that is looked ahead to.
        self._ahead = 0.0

    def given(self, values: Any) -> np.ndarray:
        """The values of the free inputs, one after the other.

        Raises:
            UsageError: another number of them, or of a name; no finite numbers.
        """
        sizes = self._sizes
        if isinstance(values, Mapping):
            found = signals_by_name(values, sizes)
            for name in sizes:
                if name not in found:
                    raise UsageError(f"input '{name}' has no value in this step; give it, or a signal to the stepper")
            return np.concatenate([np.zeros(0), *(finite_numbers(name, found[name], size) for name, size in sizes.items())])
        return finite_numbers("u", [] if values is None else values, self.at.size, self.free)

    def kept(self, before: np.ndarray) -> dict[str, Any]:
        """What blocks hold, by name, where the inputs are ``before``."""
        kept = {} if self.ticks is None else self.ticks.kept(before)
        return {name: values[0] if values.size == 1 else values.copy() for name, values in kept.items()}

    def next_tick(self, t: float) -> float:
        """The first tick that is not before a time; infinite where there is none."""
        return min((block.next_tick(t) for block in self._model.blocks), default=np.inf)

    def ends(self, k: int, t: float, h: float, begin: np.ndarray, place: tuple[np.ndarray, ...]) -> list[float]:
        """Where the parts of step k end: at the points of signals within it, at edges that blocks place, and at its end."""
        drive = self._signals_until(k, t + h)
        first, last = np.searchsorted(drive.points, [just_after(np.array(t)), just_before(np.array(t + h))])
        ends = [*drive.points[first:last].tolist(), t + h]
        if drive.moving and self.ticks is not None:
            u = self.limits(k, t, ends[0] - t, begin, begin, place)[0][: drive.size]
            return [*drive.holding(self.ticks.kept(u)).within(t, ends[0])[1:].tolist(), *ends[1:]]
        return ends

    def limits(
        self, k: int, t: float, h: float, begin: np.ndarray, end: np.ndarray, place: tuple[np.ndarray, ...]
    ) -> tuple[np.ndarray, bool]:
        """U at the begin of step k, then at its end; whether it begins with a jump.

        Args:
            k, t, h: its number, time and length.
            begin, end: what it is given.
            place: states, multipliers and inputs of the step before.
        """
        both, nu, jumps = self.both.copy(), self.both.size // 2, False
        x, l, before = place
        drive = self._signals_until(k, t + h) if self.driven else None
        if drive is not None:
            both = self._signal_limits(drive, before, k, t, h)
            jumps = any(k in signal.jump_steps for signal in self._model.inputs.values())
            jumps = jumps or bool((np.abs(drive.jumps - t) <= SAME_STEP_TOLERANCE * t).any())
        both[self.at], both[self.at + nu] = begin, end
        if self.ticks is not None:
            u, at = both[:nu].copy(), self.ticks.at
            u[at] = before[at]
            u = self.ticks.after([*self.ticks.due_blocks(t), *self.ticks.each_step], t, x, l, u)
            if drive is not None and drive.moving:
                both = self._signal_limits(drive, u, k, t, h)
                both[self.at], both[self.at + nu] = begin, end
            both[at] = both[at + nu] = u[at]
            jumps = jumps or bool((u[at] != before[at]).any())
        return both, jumps or bool((before[self._unforeseen] != both[self._unforeseen]).any())

    def _signal_limits(self, drive: InputSchedule, u: np.ndarray, k: int, t: float, h: float) -> np.ndarray:
        """U at both ends of step k by signals alone, with what blocks hold in ``u``."""
        now = drive.holding(self.ticks.kept(u)) if drive.moving and self.ticks is not None else drive
        return now.limits(np.array([t, t + h]), k)[0]

    def _signals_until(self, k: int, end: float) -> InputSchedule:
        """The signals up to the end of a step, and ahead where they let; UsageError where one is none up to there."""
        for name, signal in self._model.inputs.items():
            if signal.count is not None and k >= signal.count:
                raise UsageError(f"input '{name}': steps(...) has {signal.count} rows, but this would be step {k + 1}")
        if self._drive is None or end > self._ahead:
            try:
                self._drive, self._ahead = input_schedule(self._model, LOOK_AHEAD_FACTOR * end), LOOK_AHEAD_FACTOR * end
            except ModelError:
                try:
                    self._drive, self._ahead = input_schedule(self._model, end), end
                except ModelError as error:
                    raise UsageError(str(error)) from error
        return self._drive


def finite_numbers(label: str, values: Any, size: int, names: Sequence[str] = ()) -> np.ndarray:
    """Finite numbers (size,); UsageError, naming ``label`` and what they are of, where a user gave something else."""
    if type(values) is float and size == 1 and -np.inf < values < np.inf:
        return np.array([values])
    try:
        found = np.atleast_1d(np.asarray(values, float)).ravel()
    except (TypeError, ValueError):
        raise UsageError(f"{label} = {values!r:.60}; expected numbers") from None
    if found.size != size:
        of = f" ({', '.join(names)})" if names else ""
        raise UsageError(f"{label}: {found.size} values; expected {size}{of}")
    if not np.isfinite(found).all():
        raise UsageError(f"{label} = {found.tolist()}; expected finite numbers")
    return found
