"""A scheme's steps over a grid that is known beforehand: interpreted one by one, or many at once in C."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from nsmodel.grid import TimeGrid
from nsmodel.model.base import Model
from nsmodel.model.ticks import model_ticks
from nsmodel.run.driven import GridInputs
from nsmodel.run.options import Options
from nsmodel.run.schemes import SchemePropagator
from nsmodel.run.walk import GridProgress, ResumedBackend, buffered_row_count
from nsmodel.scheme import state_before_short_step


class FixedGridPropagator(GridProgress, SchemePropagator):
    """The walk over a grid; see `walk.Propagator`."""

    def __init__(
        self, model: Model, options: Options, grid: TimeGrid, resumed_backend: ResumedBackend, symbolic_model: Model | None = None
    ) -> None:
        super().__init__(model, options, grid, grid, resumed_backend, symbolic_model)
        self.grid, self.N, self.every = grid, grid.N, options.save_every
        self.driven = None if grid.drive is None else GridInputs(grid, grid.drive, self.starter, model_ticks(model))
        row = 8 * (self.stepper.layout.width + 5) + self.warm.index.size
        self.record = self.start(grid, buffered_row_count(grid.N, options, row, len(self.known)))

    def advance(self, steps: int, stop: Sequence[float]) -> None:
        """Go on: a step that C cannot certify, or a shortened one, is interpreted."""
        if self.rollout is None:
            self._advance_interpreted(min(self.k + steps, self.N), stop)
            return
        grid = self.grid
        end = grid.N - 1 if grid.steps is None and grid.last != grid.h else grid.N
        if (self.k == end or self._advance_in_c(end)) and not (self.record.full or stop):
            self._advance_interpreted(self.k + 1, stop)

    def _advance_in_c(self, end: int) -> bool:
        """Take compiled steps and record them, as many as there is time and room for; whether then one was not certified."""
        grid, every, record, totals, k = self.grid, self.every, self.record, self.totals, self.k
        free = slice(record.filled, None)
        room = (len(record.t) - record.filled) * every - k % every
        steps = 1 if self.last_index is None else min(end - k, room)  # the first alone: no index set has changed before it
        state, given = (self.state, None) if self.driven is None else self.driven.block(self.state, k, steps, self.warm.l)
        steps = steps if given is None else len(given)
        done = self.rollout.advance(
            k, steps, state, self.warm, self._known_least_eigenvalue(), every, record.rows[free], record.index[free], given
        )  # fmt: skip
        if done.steps:
            last = k + done.steps
            numbers = np.arange(k - k % every + every, last + 1, every)
            if last == grid.N and last % every:
                numbers = np.append(numbers, last)
            record.extend(numbers, *grid.around(numbers))
            self.counts.update(done.solvers)
            if self.counts_iterations:
                self.stepper.include_eigenvalue(done.least_eigenvalue)
            worst_t = grid.time(done.worst_step) if done.worst > totals["worst_residual"] else None
            newton = (done.newton, done.newton_max) if self.counts_iterations else (0.0, 0.0)
            changes = 0 if self.last_index is None else done.changes
            self._update_state(last, done.state, done.warm, done.warm.index, done.worst, worst_t, *newton, changes)
        return done.stuck

    def _advance_interpreted(self, end: int, stop: Sequence[float]) -> None:
        """Steps up to number ``end``. Attributes are local here and written back when it ends, however it ends."""
        grid, step, every, counts, record = self.grid, self.stepper, self.every, self.counts, self.record
        k, state, warm, last = self.k, self.state, self.warm, self.last_index
        layout, constant, h, N = self.stepper.layout, grid.steps is None, grid.h, grid.N
        state_at, residual_at, newton_at = layout.state, layout.residual, layout.newton
        worst, worst_k, newton, newton_max, changes = self.totals["worst_residual"], None, 0.0, 0.0, 0
        counting, seen, driven = self.counts_iterations, None if last is None else warm, self.driven
        try:
            while k < end and not (stop or record.full):
                start = state if driven is None else driven.state(state, k, warm.l)
                if constant:
                    t, h_k = k * h, h if k < N - 1 else grid.last
                    start = start if h_k == h or k == 0 else state_before_short_step(self.model, start, h_k / h)
                else:
                    t, h_k = grid.time(k), grid.step(k)
                row, warm, solver = step(t, h_k, start, warm, k)
                state = row[state_at]
                counts[solver] += 1
                if row[residual_at] > worst:
                    worst, worst_k = row[residual_at], k + 1
                if warm is not seen:  # the same object as long as the last index set holds
                    changes += last is not None and not np.array_equal(warm.index, last)
                    seen, last = warm, warm.index
                    if counting:
                        newton += row[newton_at]
                        newton_max = max(newton_max, row[newton_at])
                k += 1
                if k % every == 0 or k == N:
                    record.add(k, grid.time(k), h_k, h_k if constant or k == N else grid.step(k), row, warm.index)
        finally:
            worst_t = None if worst_k is None else grid.time(worst_k)
            self._update_state(k, state, warm, last, worst, worst_t, newton, newton_max, changes)

    def restore(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        super().restore(saved)
        if self.driven is not None:
            self.driven.seek(self.state, self.k)
