"""What users call to run a model."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from nsmodel import lock
from nsmodel.adaptive import AdaptiveRun
from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.defaults import TOLERANCE
from nsmodel.errors import UsageError
from nsmodel.grid import is_number, make_grid, written
from nsmodel.model.base import Model, shown
from nsmodel.model.parameters import Values
from nsmodel.run import Loop, Run
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
    with contextlib.nullcontext() if out is None else lock.held(Path(out)):
        run = _arranged(
            model, step=step, steps=steps, t_end=t_end, parameters=parameters, solver=solver, tolerance=tolerance,
            save_every=save_every, out=None if out is None else Path(out), resume=resume, compiled=compiled, rtol=rtol, atol=atol,
        )  # fmt: skip
        return run.go(progress)


def prepare(model: Model, **options: Any) -> Loop:
    """Return a run that has all its set-up behind it: ``run.go()``, once, then ``run.cpu_seconds`` is what its steps took.

    The options are those of ``simulate`` but ``out``, ``resume`` and ``progress``.
    """
    run = _arranged(model, **options)
    run.warm_up()
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
    _check(model, solver, tolerance, compiled)
    bound = model.bind(parameters)
    grid = make_grid(bound, step, None, t_end)
    run = _run_of(bound)(bound, grid, solver, float(tolerance), grid.N, None, False, compiled)
    return run.plan.text(run.problem)


def _arranged(
    model: Model,
    *,
    step: float | None = None,
    steps: Sequence[float] | None = None,
    t_end: float | None = None,
    parameters: Values | None = None,
    solver: str = "auto",
    tolerance: float = TOLERANCE,
    save_every: int = 1,
    out: Path | None = None,
    resume: bool = False,
    compiled: bool | str = "auto",
    rtol: float | None = None,
    atol: float | Sequence[float] | None = None,
) -> Loop:
    """The run that these arguments ask for; see ``simulate``."""
    _check(model, solver, tolerance, compiled)
    if not (is_number(save_every) and save_every >= 1 and float(save_every).is_integer()):
        raise UsageError(f"save_every = {written(save_every)}; expected a whole number >= 1")
    if resume and out is None:
        raise UsageError("resume needs out=, the folder of the run to continue")
    bound = model.bind(parameters)
    if rtol is None and atol is None:
        grid = make_grid(bound, step, steps, t_end)
        return _run_of(bound)(bound, grid, solver, float(tolerance), int(save_every), out, resume, compiled)
    if isinstance(bound, ManyBodies):
        raise UsageError("rtol and atol do not apply to many bodies, whose contacts change at nearly every step; give step=")
    if steps is not None or resume or save_every != 1:
        name = "steps" if steps is not None else "resume" if resume else "save_every"
        raise UsageError(f"{name} and rtol are both given: error control chooses the steps, and keeps them all; leave one out")
    return AdaptiveRun(bound, step, t_end, solver, float(tolerance), out, compiled, rtol, atol)


def _run_of(model: Model) -> Callable[..., Loop]:
    """The kind of run that a model takes."""
    if not isinstance(model, ManyBodies):
        return Run
    from nsmodel.bodies_run import BodiesRun

    return BodiesRun


def _check(model: Any, solver: str, tolerance: Any, compiled: Any) -> None:
    """Refuse what a run and its explanation cannot use."""
    if not isinstance(model, Model):
        raise UsageError(f"expected a model such as LureSystem(...), not {shown(model)}; a file is read with nsmodel.load(path)")
    if not (is_number(tolerance) and 0 < tolerance < 1):
        raise UsageError(f"tolerance = {written(tolerance)}; expected a number between 0 and 1")
    if not (isinstance(compiled, bool) or (isinstance(compiled, str) and compiled == "auto")):
        raise UsageError(f"compiled = {compiled!r}; expected True, False or 'auto'")
    if compiled is True and solver != "auto":
        raise UsageError(f"solver '{solver}' and compiled=True are both given: compiled steps bring their own solvers; keep one")
