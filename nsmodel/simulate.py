"""What users call to run a model."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from nsmodel import lock
from nsmodel.chunks import ChunkStore
from nsmodel.classes.registry import class_of
from nsmodel.defaults import TOLERANCE
from nsmodel.errors import UsageError
from nsmodel.grid import Grid, make_grid
from nsmodel.identity import WAY
from nsmodel.model.arguments import shown
from nsmodel.model.base import Model
from nsmodel.model.parameters import Values
from nsmodel.run.controlled import Controlled
from nsmodel.run.loop import Run, keep_unfinished
from nsmodel.run.on_grid import OnGrid
from nsmodel.run.options import Options
from nsmodel.run.walk import There
from nsmodel.trajectory import Trajectory


def simulate(
    model: Model,
    *,
    step: float | None = None,
    steps: Sequence[float] | None = None,
    t_end: float | None = None,
    parameters: Values | None = None,
    solver: str = "auto",
    tolerance: float = TOLERANCE,
    save_every: int = 1,
    out: str | Path | None = None,
    resume: bool = False,
    progress: bool = False,
    compiled: bool | str = "auto",
    rtol: float | None = None,
    atol: float | Sequence[float] | None = None,
) -> Trajectory:
    """Run a model and return its trajectory; every step in it was verified.

    Args:
        model: any of the six classes.
        step, steps, t_end: override the model's own grid.
        parameters: values of parameters, by name or symbol.
        solver: "auto", or one solver to use alone ("qpoases", "qrqp", "daqp", "ipopt", "lemke", ...).
        tolerance: largest accepted residual (relative, without unit).
        save_every: keep every n-th row, and the last (that of each part, where a run was resumed).
        out: folder for numbered chunks (constant memory while it runs), checkpoints and ``trajectory.npz``; for one run at a
            time.
        resume: continue the run found in ``out``.
        progress: show a progress bar where standard error is a terminal.
        compiled: True: step in C, built once for this model and kept in the user's cache folder (a step that C cannot certify
            is taken by the interpreted solvers); False: never; "auto": where building, or finding what was built before, takes
            less time than the interpreted steps, both estimated from the structure (see `solve.cost`). A run that is resumed
            goes on as it began.
        rtol: choose the steps by local error control (see `adaptive`), so that each state errs by about ``rtol`` of its largest
            value so far; ``step`` is then the first step.
        atol: an absolute error allowed besides, one for all states or one for each; 0 if left out.

    Raises:
        UsageError: a wrong argument, an unknown or inapplicable solver, a start outside the set, an unfinished run in ``out``.
        StepError: a step could not be verified; ``error.trajectory`` holds what was computed, saved in ``out`` if given.
        RunInterrupted: Ctrl-C or SIGTERM, noted between steps if this is the main thread; ``error.trajectory`` as above,
            ``error.signal`` which of them.
        StorageError: ``resume`` without a matching run, or after its files were changed; another run is at work in ``out``; or it
            cannot be written: then ``error.trajectory`` holds what was computed.
    """
    options = Options(step, steps, t_end, parameters, solver, tolerance, save_every, out, resume, compiled, rtol, atol)
    with contextlib.nullcontext() if options.folder is None else lock.held(options.folder):
        return arranged(model, options).go(progress)


def prepare(model: Model, **options: Any) -> Run:
    """Return a run that has all its set-up behind it: ``run.go()``, once, then ``run.cpu_seconds`` is what its steps took.

    The options are those of ``simulate`` but ``out``, ``resume`` and ``progress``.
    """
    run = arranged(model, Options(**options))
    run.walk.warm_up()
    return run


def explain(
    model: Model,
    *,
    step: float | None = None,
    t_end: float | None = None,
    parameters: Values | None = None,
    solver: str = "auto",
    tolerance: float = TOLERANCE,
    compiled: bool | str = "auto",
) -> str:
    """What a run with these arguments would use and what it leaves out, and why, as text."""
    options = Options(step=step, t_end=t_end, parameters=parameters, solver=solver, tolerance=tolerance, compiled=compiled)
    bound = _bound(model, options)
    walk = _on_grid(bound)(bound, options, make_grid(bound, step, None, t_end), lambda: None)
    return walk.plan.text(walk.problem)


def arranged(model: Model, options: Options) -> Run:
    """Return the run that these options ask for; see ``simulate``."""
    bound = _bound(model, options)
    if options.rtol is not None or options.atol is not None:
        return _controlled(bound, options)
    folder = _Folder(options)
    grid = make_grid(bound, options.step, options.steps, options.t_end)
    return Run(_on_grid(bound)(bound, options, grid, folder.way), options, folder.store())


class _Folder:
    """The folder of a run, opened when it is first asked for: a model that cannot be run leaves it as it was."""

    def __init__(self, options: Options) -> None:
        self._options = options
        self._store: ChunkStore | None = None

    def store(self) -> ChunkStore | None:
        """The folder of the run that is there, or a new one; a run that can be continued is not overwritten."""
        out, resume = self._options.folder, self._options.resume
        if self._store is None and out is not None:
            if not resume:
                keep_unfinished(out)
            self._store = ChunkStore.open(out) if resume else ChunkStore(out)
        return self._store

    def way(self) -> str | None:
        """How the run that is resumed was stepped; None for a new one."""
        store = self.store()
        return store.manifest["checkpoint"]["settings"].get(WAY) if store and store.manifest["chunks"] else None


def _controlled(model: Model, options: Options) -> Run:
    if _on_grid(model) is not OnGrid:
        raise UsageError("rtol and atol do not apply to many bodies, whose contacts change at nearly every step; give step=")
    if options.steps is not None or options.resume or options.save_every != 1:
        name = "steps" if options.steps is not None else "resume" if options.resume else "save_every"
        raise UsageError(f"{name} and rtol are both given: error control chooses the steps, and keeps them all; leave one out")
    if options.folder is not None:
        keep_unfinished(options.folder)
    return Run(Controlled(model, options), options, None)


def _bound(model: Any, options: Options) -> Model:
    if not isinstance(model, Model):
        raise UsageError(f"expected a model such as LureSystem(...), not {shown(model)}; a file is read with nsmodel.load(path)")
    return model.bind(options.parameters)


def _on_grid(model: Model) -> Callable[[Any, Options, Grid, There], Any]:
    """The walk of a model over a grid: its class's own, where it has one."""
    own = class_of(model).optional("walk")
    return OnGrid if own is None else own.OnGrid
