"""What users call to run a model."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from nsmodel._utils import DEFAULT_TOLERANCE
from nsmodel.errors import StepError, UnrecoverableStepError, UsageError
from nsmodel.event_driven.problem import NotEventDriven
from nsmodel.modeling.base import Model
from nsmodel.modeling.fingerprint import BACKEND_SETTING
from nsmodel.modeling.inputs import Signals
from nsmodel.modeling.parameters import Values, describe_argument
from nsmodel.modeling.time_grid import TimeGrid, make_grid
from nsmodel.modeling.variants import with_inputs
from nsmodel.proof.expression_graph import OpaqueExpression
from nsmodel.simulation import run_folder
from nsmodel.simulation.error_control import ErrorControlledPropagator
from nsmodel.simulation.event_driven import EventDrivenPropagator, event_driven_problem, plan_with_reason
from nsmodel.simulation.fixed_grid import FixedGridPropagator
from nsmodel.simulation.loop import RunLoop, check_not_unfinished
from nsmodel.simulation.options import METHODS, Options
from nsmodel.simulation.propagator import GRID_PROPAGATOR, ResumedBackend, plan_with_inputs, plan_with_known_times
from nsmodel.simulation.run_folder import ChunkStore
from nsmodel.simulation.trajectory import Trajectory


def simulate(
    model: Model,
    *,
    step: float | None = None,
    steps: Sequence[float] | None = None,
    t_end: float | None = None,
    parameters: Values | None = None,
    inputs: Signals | None = None,
    solver: str = "auto",
    tolerance: float = DEFAULT_TOLERANCE,
    save_every: int = 1,
    out: str | Path | None = None,
    resume: bool = False,
    progress: bool = False,
    compiled: bool | str = "auto",
    rtol: float | None = None,
    atol: float | Sequence[float] | None = None,
    method: str = "auto",
    times: Sequence[float] | None = None,
    certify: str = "estimate",
) -> Trajectory:
    """Run a model and return its trajectory; every step in it was verified.

    Args:
        model: any of the six classes.
        step, steps, t_end: override the model's own grid.
        parameters: values of parameters, by name or symbol.
        inputs: signals of inputs, by name or symbol, in place of those declared: steps end at their edges (see `docs/inputs.md`).
        solver: "auto", or one solver to use alone ("qpoases", "qrqp", "daqp", "ipopt", "lemke", ...).
        tolerance: largest accepted residual (relative, without unit).
        save_every: keep every n-th row, and the last (that of each part, where a run was resumed).
        out: folder for numbered chunks (constant memory while it runs), checkpoints and ``trajectory.npz``; for one run at a
            time.
        resume: continue the run found in ``out``.
        progress: show a progress bar at a terminal, or in a notebook.
        compiled: True: step in C, built once for this model and kept in the user's cache folder (a step that C cannot certify
            is taken by the interpreted solvers); False: never; "auto": where building, or finding what was built before, takes
            less time than the interpreted steps, both estimated from the structure (see `solvers.plan`). Where parameters are
            declared the library is that of all their values, and other values build nothing, but for runs so long that code of
            the numbers alone pays: that is decided by the model and the number of steps, not by what was built before. A run
            that is resumed goes on as it began.
        rtol: the error allowed of each state, beside its largest value so far, >= 1e-14. The run is event-driven where that
            applies: one smooth piece after another, switches found exactly (see `docs/events.md`); rows are the ends of pieces,
            ``run.at(t)`` gives any time, ``run.events`` the switches.
        atol: an absolute error allowed besides, one for all states or one for each; 0 if left out.
        method: with ``rtol``: "event-driven" refuses what it cannot take, or cannot go on with; "time-stepping" chooses the
            steps by local error control (see `simulation.error_control`; rtol >= 1e-12, ``step`` is the first step); "auto" is
            event-driven, and takes time stepping, with a warning, where that does not apply, and for a stretch where it stops.
        times: the rows of an event-driven run, increasing, from 0 to t_end; left out: the ends of its pieces.
        certify: "interval": prove of each piece of an event-driven run, by interval arithmetic, a bound of its defect and the
            signs of its conditions, and of the run a bound of its error where the model is monotone (see `docs/events.md`); what
            is not proved is named, and the run is one all the same. "estimate": do not.

    Raises:
        UsageError: a wrong argument, an unknown or inapplicable solver, a start outside the set, an unfinished run in ``out``.
        StepError: a step could not be verified; ``error.trajectory`` holds what was computed, saved in ``out`` if given.
        RunInterrupted: Ctrl-C or SIGTERM, noted between steps if this is the main thread; ``error.trajectory`` as above,
            ``error.signal`` which of them.
        StorageError: ``resume`` without a matching run, or after its files were changed; another run is at work in ``out``; or it
            cannot be written: then ``error.trajectory`` holds what was computed.
    """
    options = Options(
        step, steps, t_end, parameters, solver, tolerance, save_every, out, resume, compiled, rtol, atol, method, times, certify,
        inputs,
    )  # fmt: skip
    with contextlib.nullcontext() if options.folder is None else run_folder.hold_folder(options.folder):
        return make_run(model, options).go(progress)


def prepare(model: Model, **options: Any) -> RunLoop:
    """Return a run that has all its set-up behind it: ``run.go()``, once, then ``run.cpu_seconds`` is what its steps took.

    The options are those of ``simulate`` but ``out``, ``resume`` and ``progress``.
    """
    run = make_run(model, Options(**options))
    run.propagator.warm_up()
    return run


def explain(
    model: Model,
    *,
    step: float | None = None,
    t_end: float | None = None,
    parameters: Values | None = None,
    inputs: Signals | None = None,
    solver: str = "auto",
    tolerance: float = DEFAULT_TOLERANCE,
    compiled: bool | str = "auto",
    rtol: float | None = None,
    method: str = "auto",
    certify: str = "estimate",
) -> str:
    """What a run would use and what it leaves out, and why, as text.

    The arguments are those of `simulate`, with the same meaning: model, step, t_end, parameters, inputs, solver, tolerance,
    compiled, rtol, method, certify.

    Raises:
        UsageError: as in `simulate`.
    """
    requested: dict[str, Any] = {"step": step, "t_end": t_end, "parameters": parameters, "solver": solver, "tolerance": tolerance}
    options = Options(**requested, compiled=compiled, rtol=rtol, method=method, certify=certify, inputs=inputs)
    symbolic_model, bound = _driven_and_bound(model, options)
    if rtol is not None:
        controlled: Any = _run_with_rtol(bound, options, symbolic_model).propagator
        return controlled.plan.text(controlled.problem)
    propagator = _fixed_grid_propagator(bound, options, _make_run_grid(bound, options), lambda: None, symbolic_model)
    return propagator.plan.text(propagator.problem)


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

    def go(self, progress: bool = False) -> Trajectory:
        """Run to the end, one way or the other."""
        try:
            return super().go(progress)
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
        run = other.go(progress)
        self.cpu_seconds += other.cpu_seconds
        return run


def _run_with_rtol(model: Model, options: Options, symbolic_model: Model) -> RunLoop:
    """An event-driven run where it applies and ``method`` lets it; ``whole``: the model with its parameters as symbols."""
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
            raise error if isinstance(error, StepError) else UsageError(f"not event-driven: {error}") from error
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
    """The model as it is driven, and with numbers for its parameters."""
    if not isinstance(model, Model):
        raise UsageError(
            f"expected a model such as LureSystem(...), not {describe_argument(model)}; a file is read with nsmodel.load(path)"
        )
    driven = with_inputs(model, options.inputs)
    return driven, driven.bind(options.parameters)


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
    if options.step is not None and options.step > (end := grid.time(grid.N)):
        propagator.warnings.append(f"step = {options.step:g} is longer than the whole run, {end:g}: no step has that length")
    propagator.plan = plan_with_inputs(plan_with_known_times(propagator.plan, model, ends=False), grid.drive)
    return propagator


def _propagator_factory(model: Model) -> Callable[[Any, Options, TimeGrid, ResumedBackend], Any]:
    """The walk of a model over a grid: its class's own, where it has one."""
    return GRID_PROPAGATOR.optional(model) or FixedGridPropagator
