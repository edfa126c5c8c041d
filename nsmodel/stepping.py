"""A model advanced step by step, in somebody else's loop: a controller, a learning environment, hardware."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nsmodel.classes.registry import class_of
from nsmodel.defaults import TOLERANCE
from nsmodel.errors import ModelError, StepError, UsageError
from nsmodel.grid import SAME, driving, is_number, written
from nsmodel.hypotheses.quick import refuse_start
from nsmodel.model.base import Model
from nsmodel.model.driven import driven_by, inputs_at_start
from nsmodel.model.inputs import Signals, by_name
from nsmodel.model.parameters import Values
from nsmodel.model.ticks import ticks_of
from nsmodel.quantities import Outputs
from nsmodel.record import Record
from nsmodel.run.one_in_c import InC
from nsmodel.run.options import Options
from nsmodel.run.schemes import make_stepper
from nsmodel.run.told import of_model, of_scheme
from nsmodel.run.walk import is_numerical, unsolvable
from nsmodel.scheme import initial_rows, one_step_problem
from nsmodel.signals.drive import Drive
from nsmodel.signals.signal import Held, earlier, later
from nsmodel.solve.build import Starter, start_state
from nsmodel.solve.layout import Layout
from nsmodel.solve.stepper import StepResult, Warm
from nsmodel.trajectory import Trajectory

ROWS = 1024  # Of a record, at first.
AHEAD = 2.0  # Times as far as steps have come: signals are looked at up to there.


class Free(Held):
    """An input whose values each step is given."""

    @property
    def values_taken(self) -> None:
        """Any."""
        return


class Row:
    """Where a step has led: its time, and what is read off the row that it has made."""

    __slots__ = ("_layout", "_packed", "_states", "index_set", "t")

    def __init__(self, t: float, packed: np.ndarray, index_set: np.ndarray, layout: Layout, states: int) -> None:
        self.t, self.index_set = t, index_set
        self._packed, self._layout, self._states = packed, layout, states

    @property
    def x(self) -> np.ndarray:
        """The state (n,)."""
        return self._packed[: self._states]

    @property
    def multipliers(self) -> np.ndarray:
        """The multipliers (m,), as they are declared."""
        return self._of("multipliers", "l")

    @property
    def y(self) -> np.ndarray:
        """The outputs of the law (m,)."""
        return self._of("outputs", "y")

    @property
    def residual(self) -> float:
        """That of the step."""
        return float(self._packed[self._layout.residual])

    @property
    def inputs(self) -> np.ndarray:
        """The inputs (nu,) at the end of the step."""
        both = self._packed[self._layout.inputs]
        return both[both.size // 2 :]

    def _of(self, name: str, else_of: str) -> np.ndarray:
        slices = self._layout.slices
        return self._packed[slices.get(name, slices[else_of])]

    def __repr__(self) -> str:
        """The time, the state, the residual."""
        return f"Row(t={self.t:.10g}, x={self.x}, residual={self.residual:.2g})"


class ModelStepper:
    """A model at a time; see `stepper`. A step that fails, or is refused, leaves it as it was.

    Attributes:
        h: the time step; k: steps taken since the start or the last reset.
        free: names of the inputs that each step is given, in order.
    """

    def __init__(self, model: Model, options: Options, *, record: bool) -> None:
        given = {**model.inputs, **by_name(options.inputs, model.input_groups)}
        self.free = tuple(name for name, signal in given.items() if signal is None)
        zeros = {name: Free(np.zeros(len(model.input_groups[name]))) for name in self.free}
        self._model: Any = driven_by(model, {**(options.inputs or {}), **zeros}).bind(options.parameters)
        own: Any = self._model
        if class_of(own).optional("walk") is not None:
            raise UsageError("stepper: many bodies enter and leave as they go; take simulate")
        h = own.step if options.step is None else options.step
        if not (is_number(h) and 0 < h < np.inf):
            raise UsageError("stepper: no time step: give the model step=, or step=H here")
        self.h, self._tolerance, self._keeps = float(h), options.tolerance, record
        refuse_start(own)
        self._problem = one_step_problem(own)
        self._sizes = {name: len(own.input_groups[name]) for name in self.free}
        self._ticks = ticks_of(own)
        self._driven = bool(own.blocks) or any(not isinstance(signal, Held) for signal in own.inputs.values())
        self._drive: Drive | None = None  # The signals up to a time that is looked ahead to.
        self._ahead = 0.0
        entries = [name for name, names in own.input_groups.items() for _ in names]
        self._at = np.flatnonzero(np.isin(entries, self.free))  # Of the inputs that steps are given, among all.
        moving = [name for name, signal in own.inputs.items() if signal.moving]
        self._unforeseen = np.flatnonzero(np.isin(entries, [*self.free, *moving]))  # And of those whose jumps no signal tells.
        state = start_state(self._problem, initial_rows(own, self.h)[-1][0], self.h, options.tolerance)
        few = not any(signal.moving for signal in own.inputs.values())
        self._step = make_stepper(own, options.solver, options.tolerance, h=self.h, state=state, few_steps=few)
        start, self._in_c, self._n = self._problem.start, InC(own, self.h, options), len(own.names)
        self._starter = None
        if start is not None:
            self._starter = self._in_c.starter(Starter(start, options.tolerance, h=self.h, state=state))
        self._both = np.tile(inputs_at_start(own), 2)
        self.reset()

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
        if self._ticks is None:
            return {}
        u = self._state[self._step.layout.inputs][self._both.size // 2 :]
        return {name: values[0] if values.size == 1 else values.copy() for name, values in self._ticks.kept(u).items()}

    @property
    def next_tick(self) -> float:
        """The time of the next tick of a sampled block, that of now included; infinite where there is none."""
        blocks = () if self._ticks is None else self._ticks.blocks
        return min((block.next_tick(self.t) for block in blocks), default=np.inf)

    def reset(self, x0: Any = None, t: float = 0.0) -> None:
        """Begin anew, at the model's start or at ``x0``, at time t.

        Raises:
            UsageError: ``x0`` of another length, or no finite numbers.
        """
        rows = initial_rows(self._model, self.h)
        state, n = rows[-1][0].copy(), self._n
        if x0 is not None:
            own = _numbers("x0", x0, n)
            state[:n] = own
        if self._ticks is not None and len(rows) == 1:  # else the ticks at 0 lie behind
            at = self._step.layout.inputs
            state[at] = np.tile(self._ticks.before(state[:n], state[at][: self._both.size // 2]), 2)
        self._state = start_state(self._problem, state, self.h, self._tolerance)
        self._warm: Warm = self._step.cold()
        self._base, self._last, self.k = float(t), self.h, len(rows) - 1
        self._since = self.k
        self._record = Record(self._model, self._step.layout, self._warm.index.size, ROWS) if self._keeps else None
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
        """Take up what ``checkpoint`` gave; the rows recorded after it are forgotten."""
        self._base, self._since, self._last, self.k = saved["base"], saved["since"], saved["last"], saved["k"]
        self._state = np.array(saved["state"], float)
        self._warm = Warm(np.array(saved["l"], float), np.array(saved["index"], np.int8))
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
        if h is None:
            length = self.h
        elif is_number(h) and 0 < h < np.inf:
            length = float(h)
        else:
            raise UsageError(f"h = {written(h)}; expected a finite number > 0")
        begin = self._given(u)
        end = begin if u_end is None else self._given(u_end)
        if not self._driven:
            return self._one(begin, end, length)
        ends = self._points(length, begin)
        if len(ends) == 1:
            return self._one(begin, end, length)
        if not split:
            raise UsageError(
                f"an input jumps or bends, or a block ticks, at t = {ends[0]:.10g}: step at most {ends[0] - self.t:.10g}, "
                "or give split=True"
            )
        kept, t, rows = self.checkpoint(), self.t, []
        try:
            for at in ends:
                first, last = (begin + (time - t) / length * (end - begin) for time in (self.t, at))
                rows.append(self._one(first, last, at - self.t))
        except StepError:
            self.restore(kept)
            raise
        return rows[-1]

    def _points(self, h: float, begin: np.ndarray) -> list[float]:
        """Where the parts of a step end: at the points of signals within it, at edges that blocks place, and at its end."""
        t, end = self.t, self.t + h
        drive = self._seen(end)
        first, last = np.searchsorted(drive.points, [later(np.array(t)), earlier(np.array(end))])
        ends = [*drive.points[first:last].tolist(), end]
        if drive.moving and self._ticks is not None:
            u = self._limits(begin, begin, ends[0] - t)[0][: drive.size]
            return [*drive.holding(self._ticks.kept(u)).within(t, ends[0])[1:].tolist(), *ends[1:]]
        return ends

    def _seen(self, end: float) -> Drive:
        """The signals up to the end of a step, and ahead where they let; UsageError where one is none up to there."""
        inputs = self._model.inputs
        for name, signal in inputs.items():
            if signal.count is not None and self.k >= signal.count:
                raise UsageError(f"input '{name}': steps(...) has {signal.count} rows, and this would be step {self.k + 1}")
        if self._drive is None or end > self._ahead:
            try:
                self._drive, self._ahead = driving(self._model, AHEAD * end), AHEAD * end
            except ModelError:
                try:
                    self._drive, self._ahead = driving(self._model, end), end
                except ModelError as error:
                    raise UsageError(str(error)) from error
        return self._drive

    def _given(self, values: Any) -> np.ndarray:
        """The values of the free inputs, one after the other."""
        sizes = self._sizes
        if isinstance(values, Mapping):
            found = by_name(values, sizes)
            for name in sizes:
                if name not in found:
                    raise UsageError(f"input '{name}' has no value in this step; give it, or a signal to the stepper")
            return np.concatenate([np.zeros(0), *(_numbers(name, found[name], size) for name, size in sizes.items())])
        return _numbers("u", [] if values is None else values, self._at.size, self.free)

    def _limits(self, begin: np.ndarray, end: np.ndarray, h: float) -> tuple[np.ndarray, bool]:
        """U at the begin of a step, then at its end; whether it begins with a jump."""
        t, nu, jumps = self.t, self._both.size // 2, False
        both = self._both.copy()
        before = self._state[self._step.layout.inputs][nu:]
        drive = self._seen(t + h) if self._driven else None
        if drive is not None:
            both = self._by_signals(drive, before, h)
            jumps = any(self.k in signal.turns for signal in self._model.inputs.values())
            jumps = jumps or bool((np.abs(drive.jumps - t) <= SAME * t).any())
        both[self._at], both[self._at + nu] = begin, end
        if self._ticks is not None:
            u, at = both[:nu].copy(), self._ticks.at
            u[at] = before[at]
            due = [*self._ticks.due(t), *self._ticks.each_step]
            u = self._ticks.after(due, t, self._state[: self._n], self._warm.l, u)
            if drive is not None and drive.moving:
                both = self._by_signals(drive, u, h)
                both[self._at], both[self._at + nu] = begin, end
            both[at] = both[at + nu] = u[at]
            jumps = jumps or bool((u[at] != before[at]).any())
        return both, jumps or bool((before[self._unforeseen] != both[self._unforeseen]).any())

    def _by_signals(self, drive: Drive, u: np.ndarray, h: float) -> np.ndarray:
        """U at both ends of a step by signals alone, with what blocks hold in ``u``."""
        now = drive.holding(self._ticks.kept(u)) if drive.moving and self._ticks is not None else drive
        return now.limits(np.array([self.t, self.t + h]), self.k)[0]

    def _one(self, begin: np.ndarray, end: np.ndarray, h: float) -> Row:
        layout, state, k, t = self._step.layout, self._state.copy(), self.k, self.t
        if self._both.size:
            limits, jumps = self._limits(begin, end, h)
            state[layout.inputs] = limits
            if jumps and self._starter is not None:
                state = self._starter(t, h, state)
        found = self._in_c.step(k, t, h, state, self._warm, layout)
        if found is None:
            try:
                found = self._step(t, h, state, self._warm, k)
            except Exception as error:
                if not is_numerical(error):
                    raise
                raise unsolvable(f"no verified step from t = {t:.10g} to {t + h:.10g}", error) from error
        if h != self._last:
            self._base, self._since, self._last = t, 0, h
        self._since, self.k = self._since + 1, k + 1
        self._state, self._warm = found.row[layout.state], found.warm
        if self._record is not None:
            self._note(self._record, self.t, h, found)
        return Row(self.t, found.row, found.warm.index, layout, self._n)

    # -- a record

    def _note(self, record: Record, t: float, h: float, found: StepResult) -> None:
        if record.filled == 1 and self._both.size:  # at the start u is that of the first step
            at = self._step.layout.inputs
            record.rows[0, at] = np.tile(found.row[at][: self._both.size // 2], 2)
        record.h_next[record.filled - 1] = h
        if record.full:
            record.grow()
        record.add(self.k, t, h, h, found.row, found.warm.index)

    @property
    def trajectory(self) -> Trajectory:
        """The steps since the start or the last reset, as a run; UsageError where they are not recorded."""
        if self._record is None:
            raise UsageError("stepper: no rows are kept; give record=True")
        about = {"steps": self.k, "status": "done", "message": "", "warnings": [], **of_scheme(self._problem, self._tolerance)}
        metadata = of_model(self._model) | about
        arrays = self._record.columns(newton=False)
        return Trajectory(arrays | Outputs.of(self._model, self._problem.multiplier_names)(arrays), metadata)


def _numbers(label: str, values: Any, size: int, names: Sequence[str] = ()) -> np.ndarray:
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


def stepper(
    model: Model,
    *,
    step: float | None = None,
    parameters: Values | None = None,
    inputs: Signals | None = None,
    solver: str = "auto",
    tolerance: float = TOLERANCE,
    compiled: bool | str = "auto",
    record: bool = False,
) -> ModelStepper:
    """Return a model that is advanced step by step: ``s.step(u)`` takes a verified step and returns where it has led.

    Args:
        model: of any class but ManyBodies.
        step: the time step; left out: the model's.
        parameters: values of parameters.
        inputs: signals of inputs; what has none, or None, is given to each step.
        solver, tolerance: as in `simulate`.
        compiled: True: steps in C; False: never; "auto": in C where there is a compiler and the model has a C counterpart.
        record: keep the rows; ``s.trajectory`` is the run so far.

    The steps are those that `simulate` takes on the same grid, to the bit.

    Raises:
        UsageError: a wrong argument, many bodies, no time step; compiled=True where there is no C.
    """
    options = Options(
        step=step, parameters=parameters, solver=solver, tolerance=tolerance, compiled=compiled, inputs=inputs
    )  # fmt: skip
    return ModelStepper(model, options, record=record)
