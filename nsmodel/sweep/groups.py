"""The cells of a sweep by their models: those that differ in the values of parameters alone share one.

Where the models of a sweep come from: one model, a file, or a function of what varies.
"""

from __future__ import annotations

import inspect
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.derivatives.quantities import read_directions
from nsmodel.errors import ModelError, NsmodelError, UsageError
from nsmodel.modeling.base import Model
from nsmodel.modeling.model_files import load, load_with_values, model_arguments
from nsmodel.modeling.parameters import describe_argument
from nsmodel.modeling.time_grid import is_number
from nsmodel.modeling.variants import start_entries, start_name, with_inputs, with_start_parameters
from nsmodel.sweep.cells import CellGroup, CellTask, check_columns
from nsmodel.sweep.design import INPUTS, SEED, STEP, DesignColumn, SweepDesign
from nsmodel.sweep.request import RowSelection, SweepRequest


class ModelSource:
    """A model, the path of a model file, or a function that returns a model.

    Raises:
        UsageError: it is none of them, or a file that is not there.
    """

    def __init__(self, given: Any) -> None:
        self._given = Path(given) if isinstance(given, str) else given
        if isinstance(self._given, Model):
            self._takes: tuple[str, ...] | None = ()
        elif isinstance(self._given, Path):
            self._takes = model_arguments(self._given)
        elif callable(given) and not isinstance(given, type):
            kinds = inspect.signature(given).parameters
            self._takes = None if any(p.kind is p.VAR_KEYWORD for p in kinds.values()) else tuple(kinds)
        else:
            raise UsageError(
                f"expected a model, the path of a model file, or a function that returns a model, not {describe_argument(given)}"
            )

    def has_argument(self, name: str) -> bool:
        """Whether its function has an argument of this name."""
        return self._takes is None or name in self._takes

    def model(self, arguments: Mapping[str, Any]) -> Model:
        """The model for values of arguments.

        Raises:
            ModelError, UsageError: there is none for these.
        """
        if isinstance(self._given, Model):
            return self._given
        if isinstance(self._given, Path):
            return load(self._given, **arguments)
        name = getattr(self._given, "__name__", "model")
        try:
            found = self._given(**arguments)
        except NsmodelError:
            raise
        except Exception as error:
            raise ModelError(f"{name}() raised {type(error).__name__}: {error}") from error
        if not isinstance(found, Model):
            raise ModelError(f"{name}() returned {describe_argument(found)}; expected one of nsmodel's models")
        return found

    def raise_unknown_name(self, name: str, model: Model) -> None:
        """Raise UsageError for a name that is neither an argument nor a parameter, and say how to make it one."""
        if isinstance(self._given, Path):
            load_with_values(self._given, {name: 0.0})
        model.values_of({name: 0.0})
        raise UsageError(f"'{name}' cannot be varied")


MAX_MODELS_TRIED = 1000  # Cells looked at for one that has a model: binding one takes some milliseconds,
MAX_STARTS_TRIED = 20  # and for one whose run can begin, which takes a plan of its steps, too.
# Groups of which the bytes are at hand, those used last: one group has cells in chunks that follow each other.
MAX_PACKED_GROUPS = 64
GroupKey = tuple[int, ...]
StartFunction = Callable[[np.random.Generator], Mapping[str, float]]


class IncompatibleRowsError(UsageError):
    """Models whose rows have no place in one array."""


class ModelGroups:
    """What makes tasks of cells.

    Args:
        source: of the models; design: what varies; asked: of each cell.
        fixed: values of parameters and arguments that all cells share, by name; step, inputs: likewise.
        start: a function of a random generator that gives starts of states.

    Raises:
        UsageError: a name that the model does not have, seeds that nothing takes.
    """

    def __init__(
        self, source: ModelSource, design: SweepDesign, request: SweepRequest, fixed: Mapping[str, Any], step: float | None,
        inputs: Any, start: StartFunction | None,
    ) -> None:  # fmt: skip
        self.source, self.design, self._request, self._start = source, design, request, start
        self._fixed, self._step, self._inputs = dict(fixed), step, inputs
        self.seeded = any(column.kind == SEED for column in design.columns)
        if self.seeded and start is None and not source.has_argument("seed"):
            raise UsageError("seeds: def model(...) does not take seed=, and start is not a function of a random generator")
        self._shared = [column for column in design.columns if self._makes_models(column)]
        self._own = [column for column in design.columns if column.kind in ("value", "start") and column not in self._shared]
        steps = [column.values for column in design.columns if column.kind == STEP]
        self._longest = float(steps[0].max()) if steps else None
        self._packed: OrderedDict[GroupKey, tuple[bytes | str, CellGroup | None]] = OrderedDict()
        self._drawn = tuple(self._draw_starts(0)) if start is not None else ()
        self.rows: RowSelection | None = None
        self.first = self._first_group()
        if steps and request.keep:
            for own in steps[0].tolist():
                request.rows(self.first.model, own, self._longest)

    def _makes_models(self, column: DesignColumn) -> bool:
        if column.kind == SEED:
            return self.source.has_argument("seed")
        return column.kind in (STEP, INPUTS) or (column.kind == "value" and self.source.has_argument(column.name))

    @property
    def count(self) -> int:
        """How many models there are, at most."""
        along = {axis for column in self._shared for axis in column.along}
        return int(np.prod([self.design.shape[axis] for axis in along], dtype=int)) if along else 1

    def _first_group(self) -> CellGroup:
        """The first group that there is; what is wrong with the first cell's where there is none."""
        errors: list[NsmodelError] = []
        for cell in range(min(self.design.size, MAX_MODELS_TRIED)):
            try:
                return self._make_group(self._group_keys(np.array([cell]))[0])
            except ModelError as refused:
                errors.append(refused)
        raise errors[0]

    def check_columns(self) -> None:
        """Raise UsageError for a column that runs do not have, before any is made: those of the first cell that can begin."""
        if set(self._request.columns) <= {*self.first.model.names, *self.first.model.stems}:
            return
        for cell in range(min(self.design.size, MAX_STARTS_TRIED)):
            with suppress(ModelError):
                group, values = self.of(cell)
                if check_columns(self._request, group, dict(zip(group.names, values.tolist(), strict=True))):
                    return

    def of(self, cell: int) -> tuple[CellGroup, np.ndarray]:
        """The group of a cell, and the values of its parameters."""
        cells = np.array([cell])
        group = self._make_group(self._group_keys(cells)[0])
        return group, self._parameter_values(cells, group)[0]

    def tasks(self, cells: np.ndarray) -> list[CellTask]:
        """What is to be done for cells (K,), group by group."""
        at: dict[GroupKey, list[int]] = {}
        for i, key in enumerate(self._group_keys(cells)):
            at.setdefault(key, []).append(i)
        tasks = []
        for key, places in at.items():
            packed, group = self._packed_group(key)
            here = np.array(places)
            tasks.append(
                CellTask(packed, here, np.zeros((len(here), 0)) if group is None else self._parameter_values(cells[here], group))
            )
        return tasks

    def _group_keys(self, cells: np.ndarray) -> list[GroupKey]:
        """Which group each cell is of."""
        places = self.design.places(cells)
        of = [np.ravel_multi_index([places[a] for a in c.along], [self.design.shape[a] for a in c.along]) for c in self._shared]
        return list(zip(*(one.tolist() for one in of), strict=True)) if of else [()] * len(cells)

    def _packed_group(self, key: GroupKey) -> tuple[bytes | str, CellGroup | None]:
        """The bytes of a group; why there is none."""
        if key not in self._packed:
            try:
                group = self._make_group(key)
                self._packed[key] = group.packed(), group
            except IncompatibleRowsError:
                raise
            except (ModelError, UsageError) as error:
                self._packed[key] = str(error), None
            while len(self._packed) > MAX_PACKED_GROUPS:
                self._packed.popitem(last=False)
        self._packed.move_to_end(key)
        return self._packed[key]

    def _make_group(self, key: GroupKey) -> CellGroup:
        """The group of a key: its model with what varies left as parameters."""
        given: dict[str, Any] = {}
        step, inputs = self._step, self._inputs
        for column, place in zip(self._shared, key, strict=True):
            value = column.values.reshape(-1, *column.values.shape[len(column.along) :])[place]
            value = value.item() if isinstance(value, np.generic) else value
            if column.kind == STEP:
                step = float(value)
            elif column.kind == INPUTS:
                inputs = {**(self._inputs or {}), **value}
            else:
                given[column.name] = value
        own = {name: value for name, value in self._fixed.items() if self.source.has_argument(name) and name not in given}
        base = self.source.model({**own, **given})
        model = with_inputs(base, inputs)
        states = [
            *dict.fromkeys(state for column in self._own if column.kind == "start" for state in started_states(base, column))
        ]
        varied = [name for column in self._own if column.kind == "value" for name in self._parameter_names(base, column)]
        fixed = {name: value for name, value in self._fixed.items() if not self.source.has_argument(name)}
        own_names = [*varied, *(start_name(state) for state in (*states, *self._drawn))]
        steady = _SteadyDirections(model, self._request.by, own_names, model.values_of(fixed))
        left = dict.fromkeys([*own_names, *steady.names])
        free = with_start_parameters(model, [*states, *self._drawn, *steady.states])
        bound = free.bind({**free.values_of(fixed), **left}, partly=True)
        missing = [name for name in bound.parameters if name not in left]
        if missing:
            raise UsageError(f"parameter '{missing[0]}' has no value; give parameters={{'{missing[0]}': ...}}, or vary it")
        rows = self._request.rows(bound, step, self._longest if self._request.keep else None)
        if self.rows is None:
            self.rows = rows
        elif self._request.keep and not _are_same_times(rows.times, self.rows.times):
            raise IncompatibleRowsError(
                f"the rows of this model are at different times (0 to {rows.times[-1]:g} in {len(rows.times)} rows) than in "
                f"the first (0 to {self.rows.times[-1]:g} in {len(self.rows.times)}); use outputs= in place of keep="
            )
        names = [name for name in bound.parameters if name not in steady.names]
        return CellGroup(bound, tuple(bound.parameters), step, rows, (tuple(steady.names), steady.function(names)))

    def _parameter_names(self, model: Model, column: DesignColumn) -> list[str]:
        """The parameters that a column has the values of."""
        if not column.numeric and column.name in (*model.vectors, *model.parameters):
            wrong = next((one for one in column.values.ravel() if not is_number(one)), None)
            raise UsageError(f"'{column.name}' is a parameter of the model, a number; {wrong!r} is none")
        if column.name in model.vectors:
            names = model.vectors[column.name].ravel().tolist()
        elif column.name in model.parameters:
            names = [column.name]
        else:
            self.source.raise_unknown_name(column.name, model)
            names = []
        _check_column_shape(column, names)
        return names

    def _parameter_values(self, cells: np.ndarray, group: CellGroup) -> np.ndarray:
        """The values (K, p) of a group's parameters."""
        of: dict[str, np.ndarray] = {}
        places = self.design.places(cells)
        for column in self._own:
            if column.kind == "start":
                names = [start_name(state) for state in started_states(group.model, column)]
            else:
                names = list(group.model.vectors[column.name].ravel()) if column.name in group.model.vectors else [column.name]
            of |= dict(zip(names, column.of(places).reshape(len(cells), -1).T, strict=True))
        if self._start is not None:
            drawn = [self._draw_starts(int(cell)) for cell in cells]
            of |= {start_name(state): np.array([one[state] for one in drawn]) for state in self._drawn}
        names, steady = group.steady
        given = [np.asarray(of[name], float) for name in group.names if name not in names]
        if names:
            of |= dict(zip(names, np.array(steady(np.array(given).reshape(-1, len(cells)))), strict=True))
        return (
            np.column_stack([np.asarray(of[name], float) for name in group.names]) if group.names else np.zeros((len(cells), 0))
        )

    def _draw_starts(self, cell: int) -> dict[str, float]:
        """The starts of a cell that its random numbers give."""
        try:
            given = {} if self._start is None else self._start(self.design.rng(cell))
        except Exception as error:
            raise UsageError(f"start, called with a random generator: {type(error).__name__}: {error}") from error
        if not isinstance(given, Mapping):
            raise UsageError(f"start returned {given!r:.60}; expected {{state: value}}")
        for state, value in given.items():
            if np.ndim(value) or not np.isfinite(value):
                raise UsageError(f"start returned {state} = {value!r:.60}; expected a finite number for each state")
        found = {str(state): float(value) for state, value in given.items()}
        if cell and set(found) != set(self._drawn):
            raise UsageError(
                f"start returned {', '.join(found)}, and {', '.join(self._drawn)} before; give the same states each time"
            )
        return found


class _SteadyDirections:
    """What runs are differentiated by and does not vary: parameters, which keep their values, and starts, which the model gives.

    ``names``: of both, in the order in which the model has them; ``states``: those of the starts.
    """

    def __init__(self, model: Model, by: Sequence[str], varied: Sequence[str], fixed: Mapping[str, float | None]) -> None:
        """``varied``: names of parameters and starts.

        Raises:
            UsageError: what runs of this model are not differentiated by, or what has no value.
        """
        directions = read_directions(model, list(by)) if by else None
        own = [name for name in directions.parameters if name not in varied] if directions else []
        self.states = [state for name, state in directions.starts.items() if name not in varied] if directions else []
        self.names = [*own, *(start_name(state) for state in self.states)]
        values = {**model.parameters, **fixed}
        if missing := next((name for name in own if values[name] is None), None):
            raise UsageError(f"parameter '{missing}' has no value; give parameters={{'{missing}': ...}}, or vary it")
        self._model = model
        self._values: dict[str, Any] = {name: value for name, value in values.items() if name not in varied}

    def function(self, varied: Sequence[str]) -> ca.Function:
        """Their values by those of the varied names, which the model has in this order."""
        model, places = self._model, start_entries(self._model)
        bound = model.bind(self._values, partly=True)
        symbols = dict(zip(bound.parameters, ca.vertsplit(bound.p), strict=True))
        given = ca.vertcat(ca.SX(0, 1), *(symbols.get(name, ca.SX.sym(name)) for name in varied))
        starts = [getattr(bound, places[state][0])[places[state][1]] for state in self.states]
        own = [ca.SX(self._values[name]) for name in self.names[: len(self.names) - len(starts)]]
        return ca.Function("steady", [given], [ca.densify(ca.vertcat(*own, *starts))])


def started_states(model: Model, column: DesignColumn) -> list[str]:
    """The states that a column has the starts of: one, or those of a vector of states."""
    known = start_entries(model)
    stem = model.stems.get(column.name)
    names = [column.name] if column.name in known or stem is None else [model.names[i] for i in stem]
    _check_column_shape(column, names)
    return names


def _check_column_shape(column: DesignColumn, names: list[str]) -> None:
    size = int(np.prod(column.values.shape[len(column.along) :], dtype=int))
    if size != len(names):
        what = (
            "one number"
            if len(names) == 1
            else f"{len(names)} numbers ({', '.join(names[:4])}{', ...' if len(names) > 4 else ''})"
        )
        raise UsageError(f"'{column.name}' has {size} numbers in each cell; expected {what}")


def _are_same_times(times: np.ndarray, others: np.ndarray) -> bool:
    return times.shape == others.shape and bool(np.allclose(times, others, rtol=1e-9, atol=1e-9 * others[-1]))
