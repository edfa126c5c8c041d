"""What users call to run a model."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Unpack

import numpy as np

from nsmodel._utils import cached_per_object_and_key
from nsmodel.errors import StepError, UnrecoverableStepError, UsageError
from nsmodel.event_driven.problem import NotEventDriven
from nsmodel.modeling.base import Model
from nsmodel.modeling.fingerprint import BACKEND_SETTING
from nsmodel.modeling.parameters import Values, describe_argument
from nsmodel.modeling.time_grid import TimeGrid, make_grid
from nsmodel.modeling.variants import with_inputs, with_signals_of
from nsmodel.proof.expression_graph import OpaqueExpression
from nsmodel.simulation import run_folder
from nsmodel.simulation.error_control import ErrorControlledPropagator, check_no_fixed_steps
from nsmodel.simulation.event_driven import EventDrivenPropagator, event_driven_problem, plan_with_reason
from nsmodel.simulation.fixed_grid import FixedGridPropagator
from nsmodel.simulation.loop import RunInterrupted, RunLoop, check_not_unfinished
from nsmodel.simulation.options import METHODS, ExplainKeywords, OptionKeywords, Options, takes_options
from nsmodel.simulation.propagator import GRID_PROPAGATOR, ResumedBackend, plan_with_inputs, plan_with_known_times
from nsmodel.simulation.run_folder import ChunkStore
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.solvers import impacts


@takes_options(OptionKeywords)
def simulate(model: Model, **options: Unpack[OptionKeywords]) -> Trajectory:
    """Run a model and return its trajectory; every step in it was verified.

    Args:
        model: any of the seven classes.
        {entries}

    Raises:
        UsageError: a wrong argument, an unknown or inapplicable solver, a start outside the set, an unfinished run in ``out``.
        StepError: a step could not be verified; ``error.trajectory`` holds what was computed, saved in ``out`` if given.
        RunInterrupted: Ctrl-C or SIGTERM, noted between steps if this is the main thread; ``error.trajectory`` as above,
            ``error.signal`` which of them.
        StorageError: ``resume`` without a matching run, or after its files were changed; another run is at work in ``out``; or it
            cannot be written: then ``error.trajectory`` holds what was computed.
    """
    requested = Options(**options)
    with contextlib.nullcontext() if requested.folder is None else run_folder.hold_folder(requested.folder):
        run = make_run(model, requested)
        halved = _run_with_halved_steps(model, requested) if requested.halve else None
        done = run.go()
        return done if halved is None else _with_halving(done, halved, run.store)


def prepared_loop(model: Model, **options: Any) -> RunLoop:
    """Return a run that has all its set-up behind it: ``run.go()``, once, then ``run.cpu_seconds`` is what its steps took.

    The options are those of ``simulate`` but ``out``, ``resume`` and ``progress``.
    """
    run = make_run(model, Options(**options))
    run.propagator.warm_up()
    return run


@takes_options(ExplainKeywords)
def explain(model: Model, **options: Unpack[ExplainKeywords]) -> str:
    """What a run would use and what it leaves out, and why, as text.

    The arguments are those of `simulate`, with the same meaning: model, {names}.

    Raises:
        UsageError: as in `simulate`.
    """
    requested = Options(**options)
    symbolic_model, bound = _driven_and_bound(model, requested)
    if requested.rtol is not None:
        controlled: Any = _run_with_rtol(bound, requested, symbolic_model).propagator
        return controlled.plan.text(controlled.problem)
    propagator = _fixed_grid_propagator(bound, requested, _make_run_grid(bound, requested), lambda: None, symbolic_model)
    return propagator.plan.text(propagator.problem)


def _run_with_halved_steps(model: Model, options: Options) -> RunLoop:
    """The run of these options with each step halved, in memory."""
    symbolic_model, bound = _driven_and_bound(model, options)
    grid = _make_run_grid(bound, options)
    check_no_fixed_steps(bound, "halve")
    for name, signal in bound.inputs.items():
        if signal.count is not None:
            raise UsageError(
                f"input '{name}': steps(...) has one row for each step, but halve takes twice as many steps; give table(...)"
            )
    nested = not (options.resume or (grid.drive is not None and grid.drive.moving))
    own = replace(options, out=None, resume=False, halve=False, save_every=2 * options.save_every if nested else 1)
    return RunLoop(_fixed_grid_propagator(bound, own, grid.halved(), lambda: None, symbolic_model), own, None)


def _with_halving(run: Trajectory, halved: RunLoop, store: ChunkStore | None) -> Trajectory:
    """The run with the states of the other less its own, in its folder too; NaN from where the other stopped.

    Between the rows of the other, where blocks place edges, its states are on straight lines.
    """
    warnings = list(run.metadata["warnings"])
    try:
        fine = halved.go()
    except RunInterrupted as stop:
        why = "the run is done; the one with halved steps was interrupted"
        raise RunInterrupted(replace(run, metadata=run.metadata | {"message": why}), stop.signal) from None
    except StepError as error:
        if error.trajectory is None:
            raise
        fine = error.trajectory
        warnings.append(f"halve: with halved steps the run stops, and the error is not estimated from there on: {error}")
    x = fine.at(np.minimum(run.t, fine.t[-1])).x
    if fine.status != "done":
        x[run.t > fine.t[-1]] = np.nan
    compared = Trajectory(run.arrays | {"halving": x - run.x}, run.metadata | {"warnings": warnings})
    if store is not None:
        store.rewrite(compared.arrays, compared.metadata)
    return compared


def make_run(model: Model, options: Options) -> RunLoop:
    """Return the run that these options ask for; see ``simulate``."""
    symbolic_model, bound = _driven_and_bound(model, options)
    if options.rtol is not None:
        return _run_with_rtol(bound, options, symbolic_model)
    if options.atol is not None:
        return _error_controlled_run(bound, options)
    folder = _RunFolder(options)
    grid = _make_run_grid(bound, options)
    return RunLoop(_fixed_grid_propagator(bound, options, grid, folder.way, symbolic_model), options, folder.store())


class _RunFolder:
    """The folder of a run, opened when it is first asked for: a model that cannot be run leaves it as it was."""

    def __init__(self, options: Options) -> None:
        self._options = options
        self._store: ChunkStore | None = None

    def store(self) -> ChunkStore | None:
        """The folder of the run that is there, or a new one; a run that can be continued is not overwritten."""
        out, resume = self._options.folder, self._options.resume
        if self._store is None and out is not None:
            if not resume:
                check_not_unfinished(out)
            self._store = ChunkStore.open(out) if resume else ChunkStore(out)
        return self._store

    def way(self) -> str | None:
        """How the run that is resumed was stepped; None for a new one."""
        store = self.store()
        return store.manifest["checkpoint"]["settings"].get(BACKEND_SETTING) if store and store.manifest["chunks"] else None


class _RunWithFallback(RunLoop):
    """An event-driven run that, where it stops, is made anew by time stepping, with a warning that says why."""

    def go(self) -> Trajectory:
        """Run to the end, one way or the other."""
        try:
            return super().go()
        except StepError as error:
            if self.options.times is not None or isinstance(error, UnrecoverableStepError):
                raise
            reason, stopped = f"it stopped: {error}", error
        try:
            other = _time_stepping_run(self.propagator.model, replace(self.options, resume=False), reason)
        except UsageError:  # what is asked for is not for time stepping
            raise stopped from None
        if self.store is not None:
            self.store.discard()
        other.propagator.warnings.append(f"event-driven integration: {reason}; all rows are by time stepping")
        run = other.go()
        self.cpu_seconds += other.cpu_seconds
        return run


def _run_with_rtol(model: Model, options: Options, symbolic_model: Model) -> RunLoop:
    """An event-driven run where it applies and ``method`` lets it; ``whole``: the model with its parameters as symbols."""
    model.check_allowed("rtol")
    if options.method == METHODS[2]:
        return _error_controlled_run(model, options)
    try:
        problem = event_driven_problem(model)
        _check_no_step_options(options)
        folder = _RunFolder(options)
        resumed = options.resume and not options.certified
        propagator = EventDrivenPropagator(model, options, problem, lambda: folder.way() if resumed else None, symbolic_model)
    except (NotEventDriven, OpaqueExpression, StepError) as error:
        if options.method == METHODS[1] or options.times is not None or options.certified:
            if not isinstance(error, StepError):
                raise UsageError(f"not event-driven: {error}") from error
            error.args = (f"{error}{impacts.anti_friction_hint(model)}",)
            raise
        run = _time_stepping_run(model, options, str(error))
        if isinstance(error, StepError):
            run.propagator.warnings.append(f"event-driven integration does not start: {error}; all rows are by time stepping")
        return run
    if options.certified:  # of all pieces at once
        if options.folder is not None:
            check_not_unfinished(options.folder)
        return RunLoop(propagator, options, None)
    return (RunLoop if options.method == METHODS[1] else _RunWithFallback)(propagator, options, folder.store())


def _check_no_step_options(options: Options) -> None:
    """Refuse what belongs to time stepping."""
    given = {
        "step": options.step is not None, "steps": options.steps is not None,
        f"solver '{options.solver}'": options.solver != "auto",
    }  # fmt: skip
    name = next((name for name, is_given in given.items() if is_given), None)
    if name is not None:
        raise UsageError(
            f"{name} and rtol are both given: an event-driven run has no time steps; leave {name} out, or take "
            "method='time-stepping' (--method time-stepping)"
        )


def _time_stepping_run(model: Model, options: Options, reason: str) -> RunLoop:
    """Time stepping under error control, and why it is not event-driven."""
    run = _error_controlled_run(model, options)
    run.propagator.plan = plan_with_reason(run.propagator.plan, reason)
    return run


def _error_controlled_run(model: Model, options: Options) -> RunLoop:
    if _propagator_factory(model) is not FixedGridPropagator:
        raise UsageError("rtol and atol do not apply to many bodies, whose contacts change at nearly every step; give step=")
    if options.steps is not None or options.resume or options.save_every != 1:
        name = "steps" if options.steps is not None else "resume" if options.resume else "save_every"
        raise UsageError(f"{name} and rtol are both given: error control chooses the steps, and keeps them all; leave one out")
    if options.folder is not None:
        check_not_unfinished(options.folder)
    return RunLoop(ErrorControlledPropagator(model, options), options, None)


def _driven_and_bound(model: Any, options: Options) -> tuple[Model, Model]:
    """The model as it is driven, with symbols for its parameters but in signals, and with numbers for all."""
    if not isinstance(model, Model):
        raise UsageError(
            f"expected a model such as LureSystem(...), not {describe_argument(model)}; a file is read with nsmodel.load(path)"
        )
    driven = with_inputs(model, options.inputs)
    bound = bound_model(driven, options.parameters)
    return with_signals_of(driven, bound), bound


def bound_model(model: Model, parameters: Values | None) -> Model:
    """The model with numbers for its parameters, the same object for the same numbers: what is made of it is made once."""
    numbers = {**model.parameters, **model.values_of(parameters)}
    if not numbers or None in numbers.values():
        return model.bind(parameters)  # Which says what is missing.
    return _model_bound_to(model, np.array(list(numbers.values()), float).tobytes())


@cached_per_object_and_key(most=4)
def _model_bound_to(model: Model, numbers: bytes) -> Model:
    return model.bind(dict(zip(model.parameters, np.frombuffer(numbers).tolist(), strict=True)))


def _make_run_grid(model: Model, options: Options) -> TimeGrid:
    return make_grid(model, options.step, options.steps, options.t_end, driven=bool(model.inputs))


def _fixed_grid_propagator(
    model: Model, options: Options, grid: TimeGrid, resumed_backend: ResumedBackend, symbolic_model: Model
) -> Any:
    """The walk over a grid; ``whole``: the model with its parameters as symbols."""
    own: Any = _propagator_factory(model)
    propagator = own(
        model,
        options,
        grid,
        resumed_backend,
        *([symbolic_model] if own is FixedGridPropagator and symbolic_model.p.numel() else []),
    )
    propagator.plan = plan_with_inputs(plan_with_known_times(propagator.plan, model, ends=False), grid.drive)
    return propagator


def _propagator_factory(model: Model) -> Callable[[Any, Options, TimeGrid, ResumedBackend], Any]:
    """The walk of a model over a grid: its class's own, where it has one."""
    return GRID_PROPAGATOR.optional(model) or FixedGridPropagator
