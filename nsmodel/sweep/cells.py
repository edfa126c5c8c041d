"""Cells are run: many at once in C, or each by `simulate`.

Which way cells are run: many at once in C, or each alone, and why.
"""

from __future__ import annotations

import hashlib
import pickle
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import former_names
from nsmodel.codegen.event_driven_batch import BY
from nsmodel.derivatives.sensitivity import sensitivity
from nsmodel.errors import CodegenError, ModelError, StepError, UsageError
from nsmodel.event_driven.problem import NotEventDriven
from nsmodel.modeling.base import Model
from nsmodel.modeling.variants import parametric_inputs
from nsmodel.proof.expression_graph import OpaqueExpression
from nsmodel.simulation.options import METHODS, Options
from nsmodel.simulation.propagator import GRID_PROPAGATOR
from nsmodel.simulation.simulate import make_run, simulate
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.solvers.one_step_problem import one_step_problem
from nsmodel.solvers.plan import build_seconds, interpreted_step_seconds
from nsmodel.solvers.step import UNKNOWN_INDEX
from nsmodel.solvers.structure import read_step_structure
from nsmodel.sweep.request import (
    ALONE_BACKEND,
    BATCH_BACKEND,
    CELL_BACKENDS,
    CELL_FACTS,
    EVENT_DRIVEN_FACTS,
    PIECES_BACKEND,
    CellResults,
    Reduction,
    RowSelection,
    SweepRequest,
    run_column,
)
from nsmodel.sweep.variable import CELL_DONE, CELL_FAILED, CELL_NOT_RUN, CELL_REFUSED

MAX_OPEN_GROUPS = 8  # Models that a process keeps ready, those used last: others are opened again, which takes as long as a bind.
StopCheck = Callable[[], bool]


@dataclass(frozen=True)
class CellGroup:
    """Cells of one model: ``names`` of the parameters that vary; ``step`` where it is not the model's.

    ``steady``: names of these that runs are differentiated by, and which do not vary, and their values by those of the others.
    """

    model: Model
    names: tuple[str, ...]
    step: float | None
    rows: RowSelection
    steady: tuple[tuple[str, ...], ca.Function]

    def packed(self) -> bytes:
        """It as bytes, for another process."""
        return pickle.dumps(self)


@dataclass(frozen=True)
class CellTask:
    """Cells of one group: ``at``, their places in the chunk, and the values (K, p) of their parameters.

    In place of a packed group there may be why there is none: the model was refused.
    """

    group: bytes | str
    at: np.ndarray
    values: np.ndarray


def never_stop() -> bool:
    """False: no run is asked to stop."""
    return False


def run_chunk(request: SweepRequest, tasks: Sequence[CellTask], stop: StopCheck = never_stop) -> CellResults:
    """Run the cells of a chunk; those that were not reached when ``stop`` said so have the status CELL_NOT_RUN."""
    parts = [(task.at, _run_task(request, task, stop)) for task in tasks]
    size = sum(len(at) for at, _ in parts)
    arrays: dict[str, np.ndarray] = {}
    messages: dict[int, str] = {}
    for at, found in parts:
        put_cells(arrays, size, at, found.arrays)
        messages |= {int(at[i]): text for i, text in found.messages.items()}
    return CellResults(arrays, messages)


def put_cells(into: dict[str, np.ndarray], size: int, at: Any, found: Mapping[str, np.ndarray]) -> None:
    """Put what cells found into arrays of so many cells, at their places; UsageError for another shape than in other cells."""
    into |= unrun_arrays(size, {name: values for name, values in found.items() if name not in into})
    for name, values in found.items():
        check_same_shape(name, values.shape[1:], into[name].shape[1:])
        into[name][at] = values


def check_same_shape(name: str, now: tuple[int, ...], before: tuple[int, ...]) -> None:
    """Raise UsageError for a quantity that is of another shape in another cell."""
    if now != before:
        raise UsageError(f"'{name}' has shape {now} in one cell and {before} in another; give numbers, or arrays of one shape")


def unrun_arrays(size: int, like: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays for so many cells that were not run."""
    made = {}
    for name, array in like.items():
        kind = {**CELL_FACTS, **EVENT_DRIVEN_FACTS}.get(name, (array.dtype,))[0]
        made[name] = np.full((size, *array.shape[1:]), missing_value(name, np.dtype(kind)), kind)
    return made


def unrun_facts(size: int, facts: Mapping[str, tuple[str, Any]] = CELL_FACTS) -> dict[str, np.ndarray]:
    """What is kept of every cell, of so many that were not run."""
    return unrun_arrays(size, {name: np.zeros(1, kind) for name, (kind, _) in facts.items()})


def missing_value(name: str, kind: np.dtype) -> Any:
    """The value of a quantity where a cell has none."""
    facts = {**CELL_FACTS, **EVENT_DRIVEN_FACTS}
    return facts[name][1] if name in facts else np.nan if kind.kind == "f" else UNKNOWN_INDEX


def _run_task(request: SweepRequest, task: CellTask, stop: StopCheck) -> CellResults:
    """The cells of one group; of those that are run together, what C does not go on with has the status CELL_NOT_RUN."""
    if isinstance(task.group, str):
        return failed_cells(len(task.at), CELL_REFUSED, task.group)
    group = open_group(request, task.group)
    if request.way == ALONE_BACKEND:
        return run_alone(request, group.group, task.values, stop)
    if group.batch is None:
        return CellResults(unrun_facts(len(task.at), request.facts), {})
    return group.together(request, task.values, stop)


class OpenGroup:
    """A group in this process, with its library, or why it has none."""

    def __init__(self, request: SweepRequest, group: CellGroup) -> None:
        self.group, found = group, _make_library(request, group)
        self.batch: Any = None if isinstance(found, str) else found
        self.why = found if isinstance(found, str) else ""

    def together(self, request: SweepRequest, values: np.ndarray, stop: StopCheck) -> CellResults:
        """Cells in C; what C does not go on with has the status CELL_NOT_RUN."""
        rows, number = self.group.rows, CELL_BACKENDS.index(request.way)
        reduced = {name: one for name, one in request.outputs.items() if isinstance(one, Reduction)}
        all_rows = any(one.needed_rows is None for one in reduced.values())
        names = list(dict.fromkeys([*request.keep, *(one.name for one in reduced.values())]))
        if rows.every:
            every = 1 if all_rows else rows.every
            cells = self.batch.run(values, names, every, stop=stop)
            kept = np.isin(self.batch.kept_times(every), rows.times)
        else:
            cells, kept = self.batch.run(values, names, stop=stop), slice(None)
        arrays = dict(cells.arrays)
        out = {name: arrays[name][:, kept] for name in request.keep}
        with np.errstate(invalid="ignore"):
            out |= {name: np.asarray(one.reduce_rows(arrays[one.name]), float) for name, one in reduced.items()}
        done = cells.status == 0
        facts = {
            "status": np.where(done, CELL_DONE, CELL_NOT_RUN), "failed_at": cells.failed_at,
            "steps": cells.steps, "worst_residual": cells.worst_residual, "index_set_changes": cells.index_set_changes,
            "way": np.where(done, number, -1),
        }  # fmt: skip
        if request.is_event_driven:
            facts |= {"pieces": cells.pieces, "estimate": cells.estimate}
        return CellResults(out | {name: np.asarray(values, request.facts[name][0]) for name, values in facts.items()}, {})


def _make_library(request: SweepRequest, group: CellGroup) -> Any:
    """The library of a group's cells; why there is none."""
    try:
        if request.way == BATCH_BACKEND:
            from nsmodel.codegen.batch import StepBatch

            return StepBatch(group.model, request.grid(group.model, group.step), request.options["tolerance"])
        if request.way == PIECES_BACKEND:
            from nsmodel.codegen.event_driven_batch import PieceBatch

            times = group.rows.times.tolist()
            return PieceBatch(group.model, times[-1], request.options["rtol"], request.options.get("atol"), times, request.by)
    except (CodegenError, NotEventDriven) as error:
        return str(error)
    return "each is run alone"


_open_groups: OrderedDict[str, OpenGroup] = OrderedDict()
_groups_lock = threading.RLock()


def open_group(request: SweepRequest, packed: bytes) -> OpenGroup:
    """The group of these bytes, opened once in a process."""
    key = hashlib.sha256(pickle.dumps((request.way, request.by, dict(request.options))) + packed).hexdigest()
    with _groups_lock:
        if key not in _open_groups:
            _open_groups[key] = OpenGroup(request, pickle.loads(packed))  # Bytes of this sweep's own: no file is read so.
            while len(_open_groups) > MAX_OPEN_GROUPS:
                _open_groups.popitem(last=False)
        _open_groups.move_to_end(key)
        return _open_groups[key]


def run_alone(request: SweepRequest, group: CellGroup, given: np.ndarray, stop: StopCheck = never_stop) -> CellResults:
    """Cells one by one, each by `simulate`; ``given``: values (K, p) of their parameters."""
    found: dict[str, np.ndarray] = {}
    messages: dict[int, str] = {}
    for i, own in enumerate(given):
        if stop():
            break
        values = dict(zip(group.names, own.tolist(), strict=True))
        status, failed_at, message, run = _simulate_cell(request, group, values)
        try:
            whole: Any = run
            if request.derivatives and run is not None and status == CELL_DONE:
                whole = _DifferentiatedRun(run, request, group.model, values)
            row = _kept_values(request, group.rows, whole, done=status == CELL_DONE) if run is not None else {}
        except StepError as error:  # An output says that this run has no result.
            status, failed_at, message = CELL_FAILED, np.nan, str(error)
            row = _kept_values(request, group.rows, run, done=False) if run is not None else {}
        totals = {} if run is None else run.metadata.get("totals", {})
        row |= {
            "status": status, "failed_at": failed_at, "steps": totals.get("steps", 0), "way": CELL_BACKENDS.index(ALONE_BACKEND),
            "worst_residual": totals.get("worst_residual", np.nan) if run is not None else np.nan,
            "index_set_changes": totals.get("index_set_changes", totals.get("events", 0)),
        }  # fmt: skip
        if request.is_event_driven:
            row |= {"pieces": totals.get("pieces", 0), "estimate": totals.get("worst_estimate") or np.nan}
        if status != CELL_DONE:
            messages[i] = message
        put_cells(found, len(given), [i], {name: np.asarray(value)[None] for name, value in row.items()})
    return CellResults(found or unrun_facts(len(given)), messages)


class _DifferentiatedRun:
    """A run with its derivatives as further columns."""

    def __init__(self, run: Trajectory, request: SweepRequest, model: Model, values: Mapping[str, float]) -> None:
        """``values``: of the model's parameters.

        Raises:
            StepError: the run has no derivative.
        """
        self._run, self._columns = run, dict[str, np.ndarray]()
        whole = "x" not in (*model.names, *model.stems)  # "x" stands for all states
        outputs = dict.fromkeys(name.rpartition(BY)[0] for name in request.derivatives)
        names = [part for name in outputs for part in (model.names if name == "x" and whole else [name])]
        options: dict[str, Any] = {key: request.options.get(key) for key in ("rtol", "atol", "t_end")}
        found = sensitivity(model, by=request.by, at=run.t, outputs=names, parameters=dict(values), **options)
        for name in request.derivatives:
            column, _, by = name.rpartition(BY)
            like = run_column(run, column)
            parts = list(model.names) if column == "x" and whole else [f"{column}_{i}" for i in range(like[0].size)]
            places = [found.outputs.index(part) for part in (parts if like[0].size > 1 else [column])]
            slopes = found.before[:, places, found.by.index(by)].reshape(like.shape)  # A row has the values before its time.
            self._columns[name] = np.where(np.isnan(like), np.nan, slopes)

    def __getitem__(self, name: str) -> np.ndarray:
        """A derivative, or a column of the run."""
        return self._columns[name] if name in self._columns else self._run[name]

    def __getattr__(self, name: str) -> Any:
        """What the run has."""
        return getattr(self._run, name)


def check_columns(request: SweepRequest, group: CellGroup, values: Mapping[str, float]) -> bool:
    """Whether runs of these values begin at all: then the columns that are read of runs are there.

    A run of no step has them all.

    Raises:
        UsageError: they have no column of this name, with those that there are.
    """
    options: dict[str, Any] = {**_run_options(request, group), "compiled": False, "parameters": dict(values) or None}
    try:
        run = Trajectory(*make_run(group.model, Options(**options)).contents("running", ""))
    except (UsageError, ModelError, StepError):
        return False  # A cell of its own status.
    for label, name in request.labelled_columns:
        try:
            run_column(run, name.rpartition(BY)[0] or name)
        except UsageError as error:
            raise UsageError(f"{label}: {error}") from None
    return True


def _run_options(request: SweepRequest, group: CellGroup) -> dict[str, Any]:
    """Those of `simulate` for a run of the group, but the times of its rows."""
    options = {name: value for name, value in request.options.items() if value is not None and name != "times"}
    return options if group.step is None else options | {"step": group.step}


def _simulate_cell(
    request: SweepRequest, group: CellGroup, values: dict[str, float]
) -> tuple[int, float, str, Trajectory | None]:
    """A run: its status, when it failed, why, and what there is of it."""
    options = _run_options(request, group)
    if request.is_event_driven:
        rows = options.get("method") != METHODS[2] and (
            request.keep or any(isinstance(one, Reduction) for one in request.outputs.values())
        )
        options["times"] = group.rows.times if rows else None
    elif group.rows.every and all(isinstance(one, Reduction) and one.needed_rows for one in request.outputs.values()):
        options["save_every"] = group.rows.every
    try:
        return CELL_DONE, np.nan, "", _simulate_with_times(group.model, values, options)
    except StepError as error:
        return CELL_FAILED, np.nan if error.time is None else error.time, str(error), error.trajectory
    except (UsageError, ModelError) as error:
        return CELL_REFUSED, np.nan, str(error), None


def _simulate_with_times(model: Model, values: dict[str, float], options: dict[str, Any]) -> Trajectory:
    try:
        return simulate(model, parameters=values or None, **options)
    except UsageError as error:
        no_pieces = isinstance(error.__cause__, NotEventDriven | OpaqueExpression)
        if options.get("times") is None or options.get("method", "auto") != "auto" or not no_pieces:
            raise
    options = {name: value for name, value in options.items() if name != "times"}
    return simulate(model, parameters=values or None, **options)


def _kept_values(request: SweepRequest, rows: RowSelection, run: Trajectory, *, done: bool) -> dict[str, Any]:
    """The rows that are kept, and the outputs; of a failed run the rows up to its end."""
    kept = {name: _column_at_rows(run, name, rows, done=done) for name in request.keep if done or BY not in name}
    return kept | {name: np.asarray(_evaluate_output(name, one, run), float) for name, one in request.outputs.items() if done}


def _evaluate_output(name: str, function: Callable[[Any], Any], run: Trajectory) -> Any:
    try:
        value = np.asarray(function(run))
    except StepError:
        raise
    except UsageError as error:
        raise error if str(error).startswith("output") else UsageError(f"output '{name}': {error}") from error
    except Exception as error:
        raise UsageError(f"output '{name}': {type(error).__name__}: {error}") from error
    if value.dtype.kind not in "fiub":
        raise UsageError(
            f"output '{name}': {value!r:.60} is not a number; a function of a run returns a number or an array of them"
        )
    return value


def _column_at_rows(run: Trajectory, name: str, rows: RowSelection, *, done: bool) -> np.ndarray:
    """A column at the rows that are kept."""
    values, t, times = run_column(run, name), run.t, rows.times
    room = 1e-9 * max(times[-1], 1e-300) / max(len(times), 2)
    at = np.clip(np.searchsorted(t, times - room), 0, len(t) - 1)
    is_found = np.abs(t[at] - times) <= room
    if done and not is_found.all():
        if rows.every == 0:
            return _column_at_times(run, name, np.where(is_found, t[at], times))
        is_found |= times > t[-1]  # It ended early, as nothing changes any more.
    out = np.full((len(times), *values.shape[1:]), np.nan if values.dtype.kind == "f" else UNKNOWN_INDEX, values.dtype)
    out[is_found] = values[at[is_found]]
    return out


INTERPOLATED = ("t", "x", "v", "multipliers", "y")  # Columns that `Trajectory.at` gives at any time.


def _column_at_times(run: Trajectory, name: str, times: np.ndarray) -> np.ndarray:
    """A column at any times: states, multipliers and what is made of these; of other columns that of the step there."""
    at = run.at(times)
    held = Trajectory({key: getattr(at, key) for key in INTERPOLATED}, run.metadata)
    if name in INTERPOLATED or name not in run.arrays:
        with suppress(AttributeError, KeyError, UsageError):
            return run_column(held, name)
    return run_column(run, name)[np.minimum(np.searchsorted(run.t, times), len(run.t) - 1)]


def failed_cells(cells: int, status: int, why: str) -> CellResults:
    """So many cells with a status, and why they have no result."""
    found = unrun_facts(cells)
    found["status"][:], found["way"][:] = status, CELL_BACKENDS.index(ALONE_BACKEND)
    return CellResults(found, dict.fromkeys(range(cells), why))


RUN_SETUP_SECONDS = 2e-2  # Seconds that a run takes beside its steps: 12 to 45 ms in cases of 1 to 9 states.
PIECES_BUILD_SECONDS = 1.5  # Seconds for building event-driven runs in C, of a small model;
PIECE_SECONDS = 1e-3  # for a piece without, 0.9 ms for two masses;
PIECES_PER_RUN = 20  # pieces of a run, a guess: before a run nothing tells.


class BackendChoice(NamedTuple):
    """What is asked, with the way; how the cells are run, for settings and in words."""

    request: SweepRequest
    way: str
    description: str


def choose_backend(
    request: SweepRequest, group: CellGroup, cells: int, models: int, resumed_backend: str | None = None
) -> BackendChoice:
    """Decide for all cells, by what the first group is; the same wherever it is asked.

    ``there``: the way of the sweep that is gone on with, which goes on as it began, unless ``compiled`` says otherwise.
    """
    goes_on = request.options["compiled"] == "auto" and resumed_backend is not None
    why = _reason_to_run_alone(request, group, cells / models, costs=not goes_on or resumed_backend == ALONE_BACKEND)
    if goes_on and resumed_backend == ALONE_BACKEND:
        why = why or "as it began"
    together = PIECES_BACKEND if request.is_event_driven else BATCH_BACKEND
    if why is None:
        own = open_group(replace(request, way=together), group.packed())
        if own.batch is None:
            why = own.why
        else:
            unknown = [name for name in request.columns if name not in own.batch.columns()]
            if not unknown:
                each = ", for each model" if models > 1 else ""
                return BackendChoice(replace(request, way=together), own.batch.way, f"{own.batch.way}{each}")
            why = f"'{unknown[0]}' is a column of whole runs"
    return BackendChoice(replace(request, way=ALONE_BACKEND), ALONE_BACKEND, f"each cell by simulate: {why}")


def _reason_to_run_alone(request: SweepRequest, group: CellGroup, cells: float, *, costs: bool) -> str | None:
    """Why cells are not run together; None where they are, if there is a library."""
    options = request.options
    if options["compiled"] is False:
        return "compiled=False"
    if options["solver"] != "auto":
        return f"the solver {options['solver']} is asked for"
    if not group.names:
        return "no parameter varies within a model"
    if GRID_PROPAGATOR.optional(group.model) is not None:
        return "many bodies"
    if signal := next((name for name in request.by if name not in group.names), None):
        return f"'{signal}' is a number of a signal, and no library gives derivatives with respect to it"
    if moved := next(iter(parametric_inputs(group.model)), None):
        return f"the edges of '{moved}' move with its parameters"
    whole = [name for name, one in request.outputs.items() if not (isinstance(one, Reduction) and one.needs_rows_alone)]
    if whole:
        return f"the output '{whole[0]}' needs the whole run"
    if request.is_event_driven and options["method"] == METHODS[2]:
        return "the steps of each are chosen by error control"
    if options["compiled"] is True or not costs:
        return None
    took, build = _estimate_seconds(request, group)
    return None if cells * took > build else "they take less time than building a library"


def _estimate_seconds(request: SweepRequest, group: CellGroup) -> tuple[float, float]:
    """About how long a run takes alone, and a library."""
    if request.is_event_driven:
        return RUN_SETUP_SECONDS + PIECE_SECONDS * PIECES_PER_RUN, PIECES_BUILD_SECONDS
    problem = one_step_problem(group.model)
    structure = read_step_structure(problem) if problem.prediction is None else None
    path = "kernel" if structure is not None and structure.constant and structure.affine else "newton"
    return RUN_SETUP_SECONDS + request.grid(group.model, group.step).N * interpreted_step_seconds(
        path, structure, problem.law
    ), build_seconds("newton", structure, problem)


__getattr__ = former_names(__name__, Group="CellGroup")
