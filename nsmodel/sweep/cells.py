"""Cells are run: many at once in C, or each by `simulate`."""

from __future__ import annotations

import hashlib
import pickle
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nsmodel.errors import CodegenError, ModelError, StepError, UsageError
from nsmodel.model.base import Model
from nsmodel.proof.graph import OpaqueExpression
from nsmodel.scheme.continuous import NotEventDriven
from nsmodel.simulate import simulate
from nsmodel.sweep.asked import ALONE, BATCH, FACTS, OF_PIECES, PIECES, WAYS, Asked, Found, Rows
from nsmodel.sweep.outputs import Reduction, column
from nsmodel.sweep.variable import DONE, FAILED, NO_MODEL, NOT_RUN
from nsmodel.trajectory import Trajectory

UNKNOWN = -2  # Index set of a row that is not there.
KEPT_MODELS = 8  # Models that a process keeps ready.
Stop = Callable[[], bool]


@dataclass(frozen=True)
class Group:
    """Cells of one model: ``names`` of the parameters that vary; ``step`` where it is not the model's."""

    model: Model
    names: tuple[str, ...]
    step: float | None
    rows: Rows

    def packed(self) -> bytes:
        """It as bytes, for another process."""
        return pickle.dumps(self)


@dataclass(frozen=True)
class Task:
    """Cells of one group: ``at``, their places in the chunk, and the values (K, p) of their parameters.

    In place of a packed group there may be why there is none: the model was refused.
    """

    group: bytes | str
    at: np.ndarray
    values: np.ndarray


def never() -> bool:
    """Go on."""
    return False


def run_chunk(asked: Asked, tasks: Sequence[Task], stop: Stop = never) -> Found:
    """Run the cells of a chunk; those that were not reached when ``stop`` said so have the status NOT_RUN."""
    parts = [(task.at, _run(asked, task, stop)) for task in tasks]
    size = sum(len(at) for at, _ in parts)
    arrays = blank(size, parts[0][1].arrays)
    messages: dict[int, str] = {}
    for at, found in parts:
        for name, values in found.arrays.items():
            if name not in arrays:
                arrays |= blank(size, {name: values})
            refuse_other_shape(name, values.shape[1:], arrays[name].shape[1:])
            arrays[name][at] = values
        messages |= {int(at[i]): text for i, text in found.messages.items()}
    return Found(arrays, messages)


def refuse_other_shape(name: str, now: tuple[int, ...], before: tuple[int, ...]) -> None:
    """Raise UsageError for a quantity that is of another shape in another cell."""
    if now != before:
        raise UsageError(f"'{name}' has shape {now} in one cell and {before} in another; give numbers, or arrays of one shape")


def blank(size: int, like: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays for so many cells that were not run."""
    made = {}
    for name, array in like.items():
        kind = {**FACTS, **OF_PIECES}.get(name, (array.dtype,))[0]
        made[name] = np.full((size, *array.shape[1:]), nothing(name, np.dtype(kind)), kind)
    return made


def not_run(size: int, facts: Mapping[str, tuple[str, Any]] = FACTS) -> dict[str, np.ndarray]:
    """What is kept of every cell, of so many that were not run."""
    return blank(size, {name: np.zeros(1, kind) for name, (kind, _) in facts.items()})


def nothing(name: str, kind: np.dtype) -> Any:
    """The value of a quantity where a cell has none."""
    facts = {**FACTS, **OF_PIECES}
    return facts[name][1] if name in facts else np.nan if kind.kind == "f" else UNKNOWN


def _run(asked: Asked, task: Task, stop: Stop) -> Found:
    """The cells of one group; of those that are run together, what C does not go on with has the status NOT_RUN."""
    if isinstance(task.group, str):
        return _refused(len(task.at), task.group)
    group = opened(asked, task.group)
    if asked.way == ALONE:
        return alone(asked, group.group, task.values, stop)
    if group.batch is None:
        return Found(not_run(len(task.at), asked.facts), {})
    return group.together(asked, task.values, stop)


class Opened:
    """A group in this process, with its library, or why it has none."""

    def __init__(self, asked: Asked, group: Group) -> None:
        self.group, found = group, _library(asked, group)
        self.batch: Any = None if isinstance(found, str) else found
        self.why = found if isinstance(found, str) else ""

    def together(self, asked: Asked, values: np.ndarray, stop: Stop) -> Found:
        """Cells in C; what C does not go on with has the status NOT_RUN."""
        rows, number = self.group.rows, WAYS.index(asked.way)
        reduced = {name: one for name, one in asked.outputs.items() if isinstance(one, Reduction)}
        all_rows = any(one.needs is None for one in reduced.values())
        names = list(dict.fromkeys([*asked.keep, *(one.name for one in reduced.values())]))
        if rows.every:
            every = 1 if all_rows else rows.every
            cells = self.batch.run(values, names, every, stop=stop)
            kept = np.isin(self.batch.rows_kept(every), rows.times)
        else:
            cells, kept = self.batch.run(values, names, stop=stop), slice(None)
        arrays = dict(cells.arrays)
        out = {name: arrays[name][:, kept] for name in asked.keep}
        with np.errstate(invalid="ignore"):
            out |= {name: np.asarray(one.of_rows(arrays[one.name]), float) for name, one in reduced.items()}
        done = cells.status == 0
        facts = {
            "status": np.where(done, DONE, NOT_RUN), "failed_at": cells.failed_at,
            "steps": cells.steps, "worst_residual": cells.worst_residual, "index_set_changes": cells.index_set_changes,
            "way": np.where(done, number, -1),
        }  # fmt: skip
        if asked.event_driven:
            facts |= {"pieces": cells.pieces, "estimate": cells.estimate}
        return Found(out | {name: np.asarray(values, asked.facts[name][0]) for name, values in facts.items()}, {})


def _library(asked: Asked, group: Group) -> Any:
    """The library of a group's cells; why there is none."""
    try:
        if asked.way == BATCH:
            from nsmodel.codegen.batch import Batch

            return Batch(group.model, asked.grid(group.model, group.step), asked.options["tolerance"])
        if asked.way == PIECES:
            from nsmodel.codegen.piece_batch import PieceBatch

            T = float(group.rows.times[-1])
            return PieceBatch(group.model, T, asked.options["rtol"], asked.options.get("atol"), group.rows.times.tolist())
    except (CodegenError, NotEventDriven) as error:
        return str(error)
    return "each is run alone"


_models: OrderedDict[str, Opened] = OrderedDict()
_one_at_a_time = threading.RLock()


def opened(asked: Asked, packed: bytes) -> Opened:
    """The group of these bytes, opened once in a process."""
    key = hashlib.sha256(pickle.dumps((asked.way, dict(asked.options))) + packed).hexdigest()
    with _one_at_a_time:
        if key not in _models:
            _models[key] = Opened(asked, pickle.loads(packed))  # Bytes of this sweep's own: no file is read so.
            while len(_models) > KEPT_MODELS:
                _models.popitem(last=False)
        _models.move_to_end(key)
        return _models[key]


def alone(asked: Asked, group: Group, values: np.ndarray, stop: Stop = never) -> Found:
    """Cells one by one, each by `simulate`."""
    found: dict[str, np.ndarray] = {}
    messages: dict[int, str] = {}
    for i, own in enumerate(values):
        if stop():
            break
        status, failed_at, message, run = _simulated(asked, group, dict(zip(group.names, own.tolist(), strict=True)))
        try:
            row = _kept(asked, group.rows, run, done=status == DONE) if run is not None else {}
        except StepError as error:  # An output says that this run has no result.
            status, failed_at, message = FAILED, np.nan, str(error)
            row = _kept(asked, group.rows, run, done=False) if run is not None else {}
        totals = {} if run is None else run.metadata.get("totals", {})
        row |= {
            "status": status, "failed_at": failed_at, "steps": totals.get("steps", 0), "way": WAYS.index(ALONE),
            "worst_residual": totals.get("worst_residual", np.nan) if run is not None else np.nan,
            "index_set_changes": totals.get("index_set_changes", totals.get("events", 0)),
        }  # fmt: skip
        if asked.event_driven:
            row |= {"pieces": totals.get("pieces", 0), "estimate": totals.get("worst_estimate") or np.nan}
        if status != DONE:
            messages[i] = message
        for name, value in row.items():
            array = np.asarray(value)
            if name not in found:
                found |= blank(len(values), {name: array[None]})
            refuse_other_shape(name, array.shape, found[name].shape[1:])
            found[name][i] = array
    return Found(found or not_run(len(values)), messages)


def _simulated(asked: Asked, group: Group, values: dict[str, float]) -> tuple[int, float, str, Trajectory | None]:
    """A run: its status, when it failed, why, and what there is of it."""
    options: dict[str, Any] = {name: value for name, value in asked.options.items() if value is not None and name != "times"}
    if group.step is not None:
        options["step"] = group.step
    if asked.event_driven:
        rows = asked.keep or any(isinstance(one, Reduction) for one in asked.outputs.values())
        options["times"] = group.rows.times if rows else None
    elif all(isinstance(one, Reduction) and one.needs for one in asked.outputs.values()):
        options["save_every"] = group.rows.every
    try:
        return DONE, np.nan, "", _ran(group.model, values, options)
    except StepError as error:
        return FAILED, np.nan if error.time is None else error.time, str(error), error.trajectory
    except (UsageError, ModelError) as error:
        return NO_MODEL, np.nan, str(error), None


def _ran(model: Model, values: dict[str, float], options: dict[str, Any]) -> Trajectory:
    try:
        return simulate(model, parameters=values or None, **options)
    except UsageError as error:
        no_pieces = isinstance(error.__cause__, NotEventDriven | OpaqueExpression)
        if options.get("times") is None or options.get("method", "auto") != "auto" or not no_pieces:
            raise
    options = {name: value for name, value in options.items() if name != "times"}
    return simulate(model, parameters=values or None, **options)


def _kept(asked: Asked, rows: Rows, run: Trajectory, *, done: bool) -> dict[str, Any]:
    """The rows that are kept, and the outputs; of a failed run the rows up to its end."""
    kept = {name: _at_rows(run, name, rows, done=done) for name in asked.keep}
    return kept | {name: np.asarray(_output(name, one, run), float) for name, one in asked.outputs.items() if done}


def _output(name: str, function: Callable[[Any], Any], run: Trajectory) -> Any:
    try:
        value = np.asarray(function(run))
    except StepError:
        raise
    except UsageError as error:
        raise error if str(error).startswith("output") else UsageError(f"output '{name}': {error}") from error
    except Exception as error:
        raise UsageError(f"output '{name}': {type(error).__name__}: {error}") from error
    if value.dtype.kind not in "fiub":
        raise UsageError(f"output '{name}': {value!r:.60} is no number; a function of a run returns a number or an array of them")
    return value


def _at_rows(run: Trajectory, name: str, rows: Rows, *, done: bool) -> np.ndarray:
    """A column at the rows that are kept."""
    values, t, times = column(run, name), run.t, rows.times
    room = 1e-9 * max(times[-1], 1e-300) / max(len(times), 2)
    at = np.clip(np.searchsorted(t, times - room), 0, len(t) - 1)
    there = np.abs(t[at] - times) <= room
    if done and not there.all():
        if rows.every == 0:
            return _between(run, name, times)
        there |= times > t[-1]  # It ended early, as nothing changes any more.
    out = np.full((len(times), *values.shape[1:]), np.nan if values.dtype.kind == "f" else UNKNOWN, values.dtype)
    out[there] = values[at[there]]
    return out


def _between(run: Trajectory, name: str, times: np.ndarray) -> np.ndarray:
    """A column of states, multipliers or outputs at any times."""
    at = run.at(times)
    held = Trajectory({key: getattr(at, key) for key in ("t", "x", "v", "multipliers", "y")}, run.metadata)
    return column(held, name)


def _refused(cells: int, why: str) -> Found:
    found = not_run(cells)
    found["status"][:], found["way"][:] = NO_MODEL, WAYS.index(ALONE)
    return Found(found, dict.fromkeys(range(cells), why))
