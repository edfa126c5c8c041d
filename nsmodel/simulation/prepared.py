"""A model made ready to run, and run again with other parameters, from other starts, to other ends.

Where its event-driven runs are in C, a run is C and little else: what is read of it is made when somebody reads it, by what
`simulate` sets up at the same values, which takes over the pieces. What C does not carry to the end `simulate` runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from threading import Lock
from typing import Any, Unpack

import casadi as ca
import numpy as np

from nsmodel.codegen.event_driven_runs import CompiledPieceIntegrator
from nsmodel.codegen.event_driven_spec import cached_symbolic_problem
from nsmodel.errors import CodegenError, ModelError, UsageError
from nsmodel.event_driven.problem import ContinuousProblem, switch_table
from nsmodel.modeling.base import Model
from nsmodel.modeling.parameters import Values, finite_number
from nsmodel.modeling.time_grid import is_number
from nsmodel.modeling.variants import (
    parametric_inputs,
    start_entries,
    with_inputs,
    with_signals,
    with_signals_of,
    with_start,
    with_start_parameters,
)
from nsmodel.proof.verdict import attach_buffers, not_none
from nsmodel.simulation.event_driven import EventDrivenPropagator
from nsmodel.simulation.options import Options, PrepareKeywords, takes_options
from nsmodel.simulation.piece_sources import MAX_CALL_BYTES, MAX_PIECES_PER_CALL, CompiledPieces, PieceBuffer, PieceLayout
from nsmodel.simulation.run_data import Contents, deferred_run
from nsmodel.simulation.simulate import make_run
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.solvers.initial_checks import admitted


@takes_options(PrepareKeywords)
def prepare(model: Model, **options: Unpack[PrepareKeywords]) -> PreparedRun:
    """Make a model ready to run again and again: ``prepare(model, rtol=1e-8).run(parameters={"k": 2})``.

    All that a first run would build is built, and all that it would refuse is refused, now. With ``compiled="auto"`` event-driven
    runs are in C wherever that is possible, however short.

    Args:
        model: any of the seven classes.
        {entries}

    Returns:
        what ``run`` runs, each time as `simulate` would, to the last bit.

    Raises:
        UsageError: as `simulate`.
    """
    return PreparedRun(model, Options(**options))


def _first_run(model: Model, options: Options) -> tuple[Any, Options]:
    """A run, and the options that all have: "auto" means pieces in C, where there are some."""
    run = make_run(model, options)
    if options.compiled == "auto" and isinstance(run.propagator, EventDrivenPropagator):
        in_c = replace(options, compiled=True)
        faster = make_run(model, in_c)
        if isinstance(faster.propagator, EventDrivenPropagator) and isinstance(faster.propagator.maker, CompiledPieces):
            return faster, in_c
    return run, options


class PreparedRun:
    """A model that is ready to run: `prepare` makes it, of a model and of options that `simulate` has."""

    def __init__(self, model: Model, options: Options) -> None:
        """With all that a first run would build."""
        first, options = _first_run(model, options)
        first.propagator.warm_up()
        self._model, self._options = with_inputs(model, options.inputs), options
        self._values = {**model.parameters, **model.values_of(options.parameters)}
        self._runs_in_c = _RunsInC.of(self._model, options, first.propagator)

    def __repr__(self) -> str:
        """Return one line."""
        how = "pieces in C" if self._runs_in_c is not None else "as simulate"
        return f"PreparedRun({self._model.title or type(self._model).__name__!r}, {how})"

    def run(self, *, parameters: Values | None = None, x0: Any = None, t_end: float | None = None) -> Trajectory:
        """Run it.

        Args:
            parameters: values, by name or symbol; those left out are the ones that it was prepared with.
            x0: the start: (n,) numbers, or {state: number}, by name or symbol; a vector by its symbol has as many. States left
                out start as the model does. Velocities of an oscillator are called ``v``, or ``v_0``, ...
            t_end: the end; left out, the one that it was prepared with.

        Returns:
            the trajectory that `simulate` returns at these values, to the last bit.

        Raises:
            UsageError, StepError, RunInterrupted: as `simulate`; a name that is not a state, a start that is not a finite number.
            KeyboardInterrupt: Ctrl-C while a run is one call of C, of which nothing is kept.
        """
        values = self._values if parameters is None else {**self._values, **self._model.values_of(parameters)}
        starts = {} if x0 is None else _read_starts(self._model, x0)
        end = self._options.t_end if t_end is None else t_end
        rows_are_elsewhere = self._options.times is not None and t_end is not None
        done = None if self._runs_in_c is None or rows_are_elsewhere else self._runs_in_c.run(values, starts, end)
        if done is None:
            return self._loop(values, starts, end, self._options).go()

        def read() -> Contents:
            loop = self._loop(values, starts, end, replace(self._options, compiled=True))
            loop.propagator.take_over(*done)
            return loop.contents("done", "")

        return deferred_run(Trajectory, read)

    def _loop(
        self, values: Mapping[str, float | None], starts: Mapping[str, float], t_end: float | None, options: Options
    ) -> Any:
        given = {name: value for name, value in values.items() if value is not None} or None
        model = with_start(self._model, starts) if starts else self._model
        return make_run(model, replace(options, parameters=given, inputs=None, t_end=t_end))


def _read_starts(model: Model, given: Any) -> dict[str, float]:
    """{state: number} of what a user gives as a start."""
    if not isinstance(given, Mapping):
        values = np.asarray(given if not isinstance(given, ca.DM) else np.array(given), object).ravel()
        if values.size != len(model.names):
            raise UsageError(
                f"x0: expected {len(model.names)} numbers, of {_list_text(model.names)}, or {{state: number}}; got {values.size}"
            )
        return {name: _start_number(name, value) for name, value in zip(model.names, values, strict=True)}
    found: dict[str, float] = {}
    for key, value in given.items():
        names = [key] if isinstance(key, str) else [str(entry) for entry in ca.vertsplit(ca.vec(ca.SX(key)))]
        if len(names) == 1 and names[0] in model.stems and names[0] not in model.names:
            names = [model.names[i] for i in model.stems[names[0]]]
        values = np.asarray(value, object).ravel()
        if values.size != len(names):
            raise UsageError(f"x0: '{key}' has {len(names)} entries, {_list_text(names)}, and {values.size} numbers are given")
        found |= {name: _start_number(name, one) for name, one in zip(names, values, strict=True)}
    return found


def _list_text(names: Sequence[str]) -> str:
    return ", ".join(names if len(names) <= 6 else [*names[:3], "...", names[-1]])


def _start_number(name: str, value: Any) -> float:
    try:
        return finite_number(value, f"x0: the start of '{name}'")
    except ModelError as error:
        raise UsageError(str(error)) from None


class _RunsInC:
    """Event-driven runs of one model in C from start to end, where nothing asks for more than that."""

    def __init__(self, model: Model, propagator: EventDrivenPropagator, steps: CompiledPieceIntegrator) -> None:
        """``model``: with symbols for its parameters; ``propagator``: of it at some values, with ``steps`` in C."""
        self._bound, self._problem = propagator.model, propagator.problem
        self._model, self._moving = with_signals_of(model, self._bound), model.inputs if parametric_inputs(model) else {}
        self._T, self._steps, self._x0 = propagator.T, steps, np.array(ca.DM(propagator.problem.x0)).ravel()
        self._room = max(1, min(MAX_PIECES_PER_CALL, MAX_CALL_BYTES // (8 * steps.width)))
        self._layout = PieceLayout(self._problem.x.numel(), self._problem.l.numel(), steps.order + 1)
        self._is_short = True  # No run had more pieces than there is room for.

    @classmethod
    def of(cls, model: Model, options: Options, propagator: Any) -> _RunsInC | None:
        """Those of a model; None where its runs are not of this kind."""
        if options.certified or model.blocks or not isinstance(propagator, EventDrivenPropagator):
            return None
        steps = propagator.maker.steps if isinstance(propagator.maker, CompiledPieces) else None
        switches = steps is not None and any(part.stop > part.start for part in steps.branches.values())
        if steps is None or steps.values.size != model.p.numel() or (switches and steps.values.size):
            return None  # Values may take switches away, and have a library of their own then.
        return cls(model, propagator, steps)

    def run(
        self, values: Mapping[str, float | None], starts: Mapping[str, float], end: Any
    ) -> tuple[CompiledPieceIntegrator, PieceBuffer] | None:
        """All pieces up to an end, None: the model's, and what made them.

        None where it takes more than one call, or C does not go on.
        """
        end = self._T if end is None else end
        if not (self._is_short and is_number(end) and 0 < end < np.inf and None not in values.values()):
            return None
        p = np.array(list(values.values()), float)
        held = self._switch_table(p, float(end))
        x0 = self._x0
        if starts or p.tobytes() != self._steps.values.tobytes():
            if (conditions := self._conditions) is None:
                return None
            admitted, x0 = conditions(p, starts)
            if not admitted:
                return None
            if self._moving and held is not None:
                x0[x0.size - self._problem.held :] = held[1][0]
        steps = self._steps.again(p, held)
        for unique in (False, True):
            if not steps.begin(x0, unique=unique):
                return None
            rows, stuck = steps.advance(end, self._room)
            if steps.t < end:
                self._is_short = stuck
                return None
            if unique or steps.proved_unique or not steps.is_unique:
                return steps, PieceBuffer(rows, self._layout)
        return None

    def _switch_table(self, p: np.ndarray, end: float) -> tuple[np.ndarray, np.ndarray] | None:
        """When signals switch and what they are then, for these values up to an end; None: as in the run that was prepared."""
        if self._moving:
            signals = {name: not_none(one).with_values(self._model.p, ca.SX(p)) for name, one in self._moving.items()}
            return switch_table(with_signals(self._bound, signals), end)
        return None if end == self._T or not self._bound.inputs else switch_table(self._bound, end)

    @cached_property
    def _conditions(self) -> _StartConditions | None:
        return _StartConditions.of(self._model, self._problem)


class _StartConditions:
    """What `simulate` asks of parameters and starts before it runs, and the state that these are."""

    def __init__(self, model: Model, free: Model, problem: ContinuousProblem) -> None:
        """``free``: the model with its starts as further parameters; ``problem``: that in continuous time."""
        own = start_entries(model)
        self._places = {name: model.p.numel() + k for k, name in enumerate(own)}
        starts = ca.vertcat(ca.SX(0, 1), *(getattr(model, field)[entry] for field, entry in own.values()))
        finite, signed = _entries_of(free), admitted(free)
        self._lock, self._q, self._x0 = Lock(), np.zeros(free.p.numel()), np.zeros(problem.x.numel())
        self._own, self._finite, self._signed = (np.zeros(one.numel()) for one in (starts, finite, signed))
        self._p = np.zeros(model.p.numel())
        of_p = ca.Function("starts", [model.p], [ca.densify(starts)])
        of_q = ca.Function("conditions", [free.p], [ca.densify(one) for one in (finite, signed, problem.x0)])
        self._buffers = (
            attach_buffers(of_p, [self._p], [self._own]),
            attach_buffers(of_q, [self._q], [self._finite, self._signed, self._x0]),
        )

    @classmethod
    def of(cls, model: Model, problem: ContinuousProblem) -> _StartConditions | None:
        """Those of a model; None where its start is not a list of numbers, or its starts change what is computed."""
        try:
            free = with_start_parameters(model, list(start_entries(model)))
            symbolic = cached_symbolic_problem(free)
        except CodegenError:
            return None
        return cls(model, free, symbolic) if symbolic.names == problem.names and symbolic.rows == problem.rows else None

    def __call__(self, p: np.ndarray, starts: Mapping[str, float]) -> tuple[bool, np.ndarray]:
        """Whether they are met, and the start (n,)."""
        if not starts.keys() <= self._places.keys():
            return False, self._x0.copy()
        (_, evaluate_starts), (_, evaluate_conditions) = self._buffers
        with self._lock:
            self._p[:] = p
            evaluate_starts()
            self._q[: p.size], self._q[p.size :] = p, self._own
            for name, value in starts.items():
                self._q[self._places[name]] = value
            evaluate_conditions()
            met = np.isfinite(self._finite).all() and np.isfinite(self._signed).all() and (self._signed >= 0).all()
            return bool(met), self._x0.copy()


def _entries_of(model: Model) -> ca.SX:
    """The entries of all expressions of a model but bounds that read its parameters alone."""
    known = {str(symbol) for symbol in ca.symvar(model.p)}
    parts = [value for name, value in vars(model).items() if isinstance(value, ca.SX) and name not in ("p", "lower", "upper")]
    entries = [entry for part in parts for entry in ca.vertsplit(ca.vec(ca.densify(part))) if not entry.is_constant()]
    return ca.vertcat(ca.SX(0, 1), *(one for one in entries if {str(symbol) for symbol in ca.symvar(one)} <= known))
