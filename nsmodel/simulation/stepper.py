"""A model advanced step by step, in somebody else's loop: a controller, a learning environment, hardware.

Steps in C, taken one at a time.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self, Unpack

import numpy as np

from nsmodel._utils import describe_shortly, format_number
from nsmodel.errors import CodegenError, StepError, UsageError
from nsmodel.modeling.base import Model
from nsmodel.modeling.inputs import signals_by_name
from nsmodel.modeling.output_columns import OutputColumns
from nsmodel.modeling.time_grid import SAME_STEP_TOLERANCE, TimeGrid, format_value, is_number
from nsmodel.modeling.variants import with_inputs
from nsmodel.simulation.fixed_grid import make_stepper
from nsmodel.simulation.options import Options, StepperKeywords, takes_options
from nsmodel.simulation.propagator import GRID_PROPAGATOR, Row, model_metadata, scheme_metadata
from nsmodel.simulation.step_inputs import FreeInput, StateInitialiser, StepInputs, finite_numbers
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.solvers.initial_checks import check_start
from nsmodel.solvers.one_step_problem import initial_rows, one_step_problem
from nsmodel.solvers.step import RowLayout, RowRecord, StepResult, WarmStart, verified_step
from nsmodel.solvers.time_stepper import ReactionInitialiser, completed_start_state

if TYPE_CHECKING:
    from nsmodel.codegen.rollout import SingleStepper


class CompiledSteps:
    """The steps in C where they are wanted and there: those of length h by a library for h alone, others by one for any."""

    def __init__(self, model: Model, h: float, options: Options) -> None:
        self._model, self._h, self._tolerance = model, h, options.tolerance
        self._wanted = options.compiled is True or (options.compiled == "auto" and options.solver == "auto")
        if options.compiled is True and self._library_for_h is None:
            raise UsageError(f"compiled=True: {self._why}")

    def _load_library(self, grid: TimeGrid) -> Any:
        from nsmodel.codegen.rollout import Rollout

        try:
            return Rollout(self._model, grid, self._tolerance) if self._wanted else None
        except CodegenError as error:
            self._why = str(error)
            return None

    @cached_property
    def _library_for_h(self) -> Any:
        return self._load_library(TimeGrid(1, self._h, self._h))

    @cached_property
    def _library_for_any_step(self) -> Any:
        h = self._h
        return self._load_library(TimeGrid(1, h, h, np.array([h]), np.array([0.0, h]), any_step=True))

    def alone(self, layout: RowLayout, m: int) -> SingleStepper | None:
        """What takes steps of length h in C; None where there is none."""
        return None if self._library_for_h is None else self._library_for_h.alone(layout, m)

    def starter(self, otherwise: StateInitialiser) -> StateInitialiser:
        """What finds the reaction that a state carries anew."""
        return otherwise if self._library_for_h is None else self._library_for_h.starter(otherwise)

    def step(self, k: int, t: float, h: float, state: np.ndarray, warm: WarmStart, layout: RowLayout) -> StepResult | None:
        """One step; None where it is not certified, or there is no C."""
        if h == self._h and t == k * h:
            return None if self._library_for_h is None else self._library_for_h.one(k, state, warm, layout)
        library = self._library_for_h if abs(h - self._h) <= SAME_STEP_TOLERANCE * self._h else self._library_for_any_step
        return None if library is None else library.step(t, h, state, warm, layout)


INITIAL_RECORD_ROWS = 1024  # Rows for which a record has memory at first; it is doubled where it is full.
INF = np.inf


class ModelStepper:
    """A model at a time, made by `stepper` of the ``model``, its ``options`` and whether it keeps a ``record``.

    A step that fails, or is refused, leaves it as it was. ``copy.copy`` and ``copy.deepcopy`` give another one at the same place,
    with rows of its own; they share the model and what steps it, so that they are stepped by turns, not in two threads at once.
    One that is pickled is built anew where it arrives: a UsageError says which function of its model no other process finds.

    Attributes:
        h: the time step; k: steps taken since the start or the last reset.
        free: names of the inputs that each step is given, in order.
    """

    def __init__(self, model: Model, options: Options, *, record: bool) -> None:
        given = {**model.inputs, **signals_by_name(options.inputs, model.input_groups)}
        self.free = tuple(name for name, signal in given.items() if signal is None)
        zeros = {name: FreeInput(np.zeros(len(model.input_groups[name]))) for name in self.free}
        bound = with_inputs(model, {**(options.inputs or {}), **zeros}).bind(options.parameters)
        self._build(bound, replace(options, inputs=None, parameters=None), record=record)

    def _build(self, model: Any, options: Options, *, record: bool) -> None:
        """Make what steps a bound model, of which ``free`` is known."""
        own = self._model = model
        self._options = options
        if GRID_PROPAGATOR.optional(own) is not None:
            raise UsageError("stepper: many bodies enter and leave during a run; take simulate")
        h = own.step if options.step is None else options.step
        if not (is_number(h) and 0 < h < np.inf):
            raise UsageError("stepper: no time step: give the model step=, or step=H here")
        self.h, self._tolerance, self._keeps = float(h), options.tolerance, record
        check_start(own)
        self._problem = one_step_problem(own)
        self._inputs = StepInputs(own, self.free)
        state = completed_start_state(self._problem, initial_rows(own, self.h)[-1][0], self.h, options.tolerance)
        few = not any(signal.moving for signal in own.inputs.values())
        self._step = make_stepper(own, options.solver, options.tolerance, h=self.h, state=state, few_steps=few)
        start, self._in_c, self._n = self._problem.start, CompiledSteps(own, self.h, options), len(own.names)
        self._starter = None
        if start is not None:
            self._starter = self._in_c.starter(ReactionInitialiser(start, options.tolerance, h=self.h, state=state))
        one = own.u.numel() == self._inputs.at.size == 1 and start is None and not (self._inputs.driven or record)
        self._alone = self._in_c.alone(self._step.layout, self._step.cold_start().index.size) if one else None
        self.reset()

    def __copy__(self) -> Self:
        """Another stepper at this place."""
        other = object.__new__(type(self))
        vars(other).update(vars(self), _inputs=copy(self._inputs), _record=copy(self._record))
        return other

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """The same: what both share does not change."""
        return copy(self)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what it is made of, and its place."""
        return _rebuilt_stepper, (self._model, self.free, self._options, self.checkpoint(), self._record)

    def __repr__(self) -> str:
        """Return one line: title, time, steps, states."""
        title = self._model.title or "untitled"
        return (
            f"ModelStepper({title!r}, t = {format_number(self.t)}, {self.k} steps of {format_number(self.h)}, "
            f"x = {describe_shortly(self.x)})"
        )

    # -- where it is

    @property
    def t(self) -> float:
        """The time: that of the last change of the step, and whole steps from there."""
        return self._base + self._since * self._last

    @property
    def x(self) -> np.ndarray:
        """The state (n,), a copy."""
        return self._state[: self._n].copy()

    @property
    def held(self) -> dict[str, Any]:
        """What blocks hold, by name: their memory and outputs, in the step that has led here."""
        return self._inputs.kept(self._current_values[2])

    @property
    def next_tick(self) -> float:
        """The time of the next tick of a sampled block, that of now included; infinite where there is none."""
        return self._inputs.next_tick(self.t)

    @property
    def _current_values(self) -> tuple[np.ndarray, ...]:
        """States, multipliers and inputs of the step that has led here."""
        both = self._state[self._step.layout.inputs]
        return self._state[: self._n], self._warm.l, both[both.size // 2 :]

    def reset(self, x0: Any = None, t: float = 0.0) -> None:
        """Begin anew, at the model's start or at ``x0``, at time t.

        Raises:
            UsageError: ``x0`` of another length, or no finite numbers.
        """
        rows = initial_rows(self._model, self.h)
        state, n = rows[-1][0].copy(), self._n
        if x0 is not None:
            state[:n] = finite_numbers("x0", x0, n)
        if (ticks := self._inputs.ticks) is not None and len(rows) == 1:  # else the ticks at 0 lie behind
            at = self._step.layout.inputs
            state[at] = np.tile(ticks.before(state[:n], self._inputs.both[: self._inputs.both.size // 2]), 2)
        self._state = completed_start_state(self._problem, state, self.h, self._tolerance)
        self._warm: WarmStart = self._step.cold_start()
        self._base, self._last, self.k = float(t), self.h, len(rows) - 1
        self._since = self.k
        self._record = (
            RowRecord(self._model, self._step.layout, self._warm.index.size, INITIAL_RECORD_ROWS) if self._keeps else None
        )
        if self._record is not None:
            rows[-1] = self._state, rows[-1][1] if x0 is None else {}
            for k, (known, records) in enumerate(rows):
                self._record.known(k, self._base + k * self.h, self.h, known, records)

    def checkpoint(self) -> dict[str, Any]:
        """What to go on from, as lists and numbers; of a record nothing."""
        return {
            "base": self._base, "since": self._since, "last": self._last, "k": self.k, "state": self._state.tolist(),
            "l": self._warm.l.tolist(), "index": self._warm.index.tolist(),
        }  # fmt: skip

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Take up what ``checkpoint`` gave, ``saved``; the rows recorded after it are forgotten."""
        self._base, self._since, self._last, self.k = saved["base"], saved["since"], saved["last"], saved["k"]
        self._state = np.array(saved["state"], float)
        self._warm = WarmStart(np.array(saved["l"], float), np.array(saved["index"], np.int8))
        if self._record is not None:
            self._record.filled = int(np.searchsorted(self._record.number[: self._record.filled], self.k, side="right"))

    # -- steps

    def step(self, u: Any = None, u_end: Any = None, *, h: float | None = None, split: bool = False) -> Row:
        """Take a step of length h, the stepper's own where it is left out.

        Args:
            u: the inputs that no signal drives, held over the step: a number, a list in the order of ``free``, or {name: value}.
            u_end: their values at its end, where they are others.
            h: > 0.
            split: take several steps where a signal jumps or bends within this one; else that is refused.

        Raises:
            UsageError: values of another shape or no finite numbers, a signal that jumps within the step.
            StepError: no solver reached the tolerance.
        """
        if self._alone is not None and type(u) is float and u_end is None and h is None and -INF < u < INF:
            row = self._step_in_c(self._alone, u)
            if row is not None:
                return row
        if h is None:
            length = self.h
        elif is_number(h) and 0 < h < np.inf:
            length = float(h)
        else:
            raise UsageError(f"h = {format_value(h)}; expected a finite number > 0")
        begin = self._inputs.given(u)
        end = begin if u_end is None else self._inputs.given(u_end)
        if not self._inputs.driven:
            return self._take_step(begin, end, length)
        ends = self._inputs.ends(self.k, self.t, length, begin, self._current_values)
        if len(ends) == 1:
            return self._take_step(begin, end, length)
        if not split:
            raise UsageError(
                f"an input jumps or bends, or a block ticks, at t = {ends[0]:.10g}: step at most {ends[0] - self.t:.10g}, "
                "or give split=True"
            )
        kept, t = self.checkpoint(), self.t
        try:
            while True:  # A tick may place edges in what is left.
                first, last = (begin + (time - t) / length * (end - begin) for time in (self.t, ends[0]))
                row = self._take_step(first, last, ends[0] - self.t)
                if len(ends) == 1:
                    return row
                ends = self._inputs.ends(self.k, self.t, ends[-1] - self.t, begin, self._current_values)
        except StepError:
            self.restore(kept)
            raise

    def _step_in_c(self, alone: SingleStepper, u: float) -> Row | None:
        """A step on the grid of the model's one input, in C; None where it is off the grid or not certified."""
        layout, k, warm = self._step.layout, self.k, self._warm
        if self._since != k or self._base or self._last != self.h:
            return None
        found = alone(k, self._state, warm.l, warm.index, layout.inputs, u)
        if found is None:
            return None
        packed, index, _ = found
        self._since = self.k = k + 1
        self._state, self._warm = packed[layout.state], WarmStart(packed[layout.l], index)
        return Row((k + 1) * self.h, packed, index, layout, self._n)

    def _take_step(self, begin: np.ndarray, end: np.ndarray, h: float) -> Row:
        layout, state, k, t = self._step.layout, self._state.copy(), self.k, self.t
        if self._inputs.both.size:
            limits, jumps = self._inputs.limits(k, t, h, begin, end, self._current_values)
            state[layout.inputs] = limits
            if jumps and self._starter is not None:
                state = self._starter(t, h, state)
        found = self._in_c.step(k, t, h, state, self._warm, layout)
        if found is None:
            found = verified_step(self._step, t, h, state, self._warm, k)
        if h != self._last:
            self._base, self._since, self._last = t, 0, h
        self._since, self.k = self._since + 1, k + 1
        self._state, self._warm = found.row[layout.state], found.warm
        if self._record is not None:
            self._record_step(self._record, self.t, h, found)
        return Row(self.t, found.row, found.warm.index, layout, self._n)

    # -- a record

    def _record_step(self, record: RowRecord, t: float, h: float, found: StepResult) -> None:
        if record.filled == 1 and (size := self._inputs.both.size):  # at the start u is that of the first step
            at = self._step.layout.inputs
            record.rows[0, at] = np.tile(found.row[at][: size // 2], 2)
        record.h_next[record.filled - 1] = h
        if record.full:
            record.grow()
        record.add(self.k, t, h, h, found.row, found.warm.index)

    @property
    def trajectory(self) -> Trajectory:
        """The steps since the start or the last reset, as a run; UsageError where they are not recorded."""
        if self._record is None:
            raise UsageError("stepper: no rows are kept; give record=True")
        about = {
            "steps": self.k,
            "status": "done",
            "message": "",
            "warnings": [],
            **scheme_metadata(self._problem, self._tolerance),
        }
        metadata = model_metadata(self._model) | about
        arrays = self._record.columns(newton=False)
        return Trajectory(arrays | OutputColumns.of(self._model, self._problem.multiplier_names)(arrays), metadata)


def _rebuilt_stepper(
    model: Model, free: tuple[str, ...], options: Options, place: Mapping[str, Any], record: RowRecord | None
) -> ModelStepper:
    """The stepper that was pickled."""
    other = object.__new__(ModelStepper)
    other.free = free
    other._build(model, options, record=record is not None)
    other._record = record
    other.restore(place)
    return other


@takes_options(StepperKeywords, before="record")
def stepper(model: Model, *, record: bool = False, **options: Unpack[StepperKeywords]) -> ModelStepper:
    """Return a model that is advanced step by step: ``s.step(u)`` takes a verified step and returns where it has led.

    Args:
        model: of any class but ManyBodies.
        step: the time step; left out: the model's.
        parameters: values of parameters.
        inputs: signals of inputs; what has none, or None, is given to each step.
        {names}: as in `simulate`.
        compiled: True: steps in C; False: never; "auto": in C where there is a compiler and the model has a C counterpart.
        record: keep the rows; ``s.trajectory`` is the run so far.

    The steps are those that `simulate` takes on the same grid, to the bit.

    Raises:
        UsageError: a wrong argument, many bodies, no time step; compiled=True where there is no C.
    """
    return ModelStepper(model, Options(**options), record=record)
