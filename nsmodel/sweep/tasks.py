"""The cells of a sweep by their models: those that differ in the values of parameters alone share one."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from nsmodel.errors import ModelError, NsmodelError, UsageError
from nsmodel.grid import is_number
from nsmodel.model.base import Model
from nsmodel.model.driven import driven_by
from nsmodel.model.started import start_name, started, starts_of
from nsmodel.sweep.asked import Asked, Rows
from nsmodel.sweep.cells import Group, Task
from nsmodel.sweep.design import INPUTS, SEED, STEP, Column, Design
from nsmodel.sweep.source import Source

KEPT = 64  # Groups of which the bytes are at hand.
Key = tuple[int, ...]
Start = Callable[[np.random.Generator], Mapping[str, float]]


class OtherRows(UsageError):
    """Models whose rows have no place in one array."""


class Groups:
    """What makes tasks of cells.

    Args:
        source: of the models; design: what varies; asked: of each cell.
        fixed: values of parameters and arguments that all cells share, by name; step, inputs: likewise.
        start: a function of a random generator that gives starts of states.

    Raises:
        UsageError: a name that the model does not have, seeds that nothing takes.
    """

    def __init__(
        self, source: Source, design: Design, asked: Asked, fixed: Mapping[str, Any], step: float | None, inputs: Any,
        start: Start | None,
    ) -> None:  # fmt: skip
        self.source, self.design, self._asked, self._start = source, design, asked, start
        self._fixed, self._step, self._inputs = dict(fixed), step, inputs
        self.seeded = any(column.kind == SEED for column in design.columns)
        if self.seeded and start is None and not source.takes("seed"):
            raise UsageError("seeds: neither does def model(seed=...) take them, nor is start a function of a random generator")
        self._shared = [column for column in design.columns if self._makes_models(column)]
        self._own = [column for column in design.columns if column.kind in ("value", "start") and column not in self._shared]
        steps = [column.values for column in design.columns if column.kind == STEP]
        self._longest = float(steps[0].max()) if steps else None
        self._packed: OrderedDict[Key, tuple[bytes | str, Group | None]] = OrderedDict()
        self._drawn = tuple(self._draw(0)) if start is not None else ()
        self.rows: Rows | None = None
        self.first = self._first()
        if steps and asked.keep:
            for own in steps[0].tolist():
                asked.rows(self.first.model, own, self._longest)

    def _makes_models(self, column: Column) -> bool:
        if column.kind == SEED:
            return self.source.takes("seed")
        return column.kind in (STEP, INPUTS) or (column.kind == "value" and self.source.takes(column.name))

    @property
    def count(self) -> int:
        """How many models there are, at most."""
        along = {axis for column in self._shared for axis in column.along}
        return int(np.prod([self.design.shape[axis] for axis in along], dtype=int)) if along else 1

    def _first(self) -> Group:
        """The first group that there is; what is wrong with the first cell's where there is none."""
        errors: list[NsmodelError] = []
        for cell in range(min(self.design.size, 1000)):
            try:
                return self._made(self._keys(np.array([cell]))[0])
            except ModelError as refused:
                errors.append(refused)
        raise errors[0]

    def of(self, cell: int) -> tuple[Group, np.ndarray]:
        """The group of a cell, and the values of its parameters."""
        cells = np.array([cell])
        group = self._made(self._keys(cells)[0])
        return group, self._values(cells, group)[0]

    def tasks(self, cells: np.ndarray) -> list[Task]:
        """What is to be done for cells (K,), group by group."""
        at: dict[Key, list[int]] = {}
        for i, key in enumerate(self._keys(cells)):
            at.setdefault(key, []).append(i)
        tasks = []
        for key, places in at.items():
            packed, group = self._of(key)
            here = np.array(places)
            tasks.append(Task(packed, here, np.zeros((len(here), 0)) if group is None else self._values(cells[here], group)))
        return tasks

    def _keys(self, cells: np.ndarray) -> list[Key]:
        """Which group each cell is of."""
        places = self.design.places(cells)
        of = [np.ravel_multi_index([places[a] for a in c.along], [self.design.shape[a] for a in c.along]) for c in self._shared]
        return list(zip(*(one.tolist() for one in of), strict=True)) if of else [()] * len(cells)

    def _of(self, key: Key) -> tuple[bytes | str, Group | None]:
        """The bytes of a group; why there is none."""
        if key not in self._packed:
            try:
                group = self._made(key)
                self._packed[key] = group.packed(), group
            except OtherRows:
                raise
            except (ModelError, UsageError) as error:
                self._packed[key] = str(error), None
            while len(self._packed) > KEPT:
                self._packed.popitem(last=False)
        self._packed.move_to_end(key)
        return self._packed[key]

    def _made(self, key: Key) -> Group:
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
        own = {name: value for name, value in self._fixed.items() if self.source.takes(name) and name not in given}
        base = self.source.model({**own, **given})
        model = driven_by(base, inputs)
        states = [*dict.fromkeys(state for column in self._own if column.kind == "start" for state in states_of(base, column))]
        varied = [name for column in self._own if column.kind == "value" for name in self._names(base, column)]
        left = dict.fromkeys([*varied, *(start_name(state) for state in (*states, *self._drawn))])
        fixed = {name: value for name, value in self._fixed.items() if not self.source.takes(name)}
        free = started(model, [*states, *self._drawn])
        bound = free.bind({**free.values_of(fixed), **left}, partly=True)
        missing = [name for name in bound.parameters if name not in left]
        if missing:
            raise UsageError(f"parameter '{missing[0]}' has no value; give parameters={{'{missing[0]}': ...}}, or vary it")
        rows = self._asked.rows(bound, step, self._longest if self._asked.keep else None)
        if self.rows is None:
            self.rows = rows
        elif self._asked.keep and not _same(rows.times, self.rows.times):
            raise OtherRows(
                f"the rows of this model are at other times (0 to {rows.times[-1]:g} in {len(rows.times)} rows) than those of "
                f"the first (0 to {self.rows.times[-1]:g} in {len(self.rows.times)}); keep numbers with outputs= in place of rows"
            )
        return Group(bound, tuple(bound.parameters), step, rows)

    def _names(self, model: Model, column: Column) -> list[str]:
        """The parameters that a column has the values of."""
        if not column.numeric and column.name in (*model.vectors, *model.parameters):
            wrong = next((one for one in column.values.ravel() if not is_number(one)), None)
            raise UsageError(f"'{column.name}' is a parameter of the model, a number; {wrong!r} is none")
        if column.name in model.vectors:
            names = model.vectors[column.name].ravel().tolist()
        elif column.name in model.parameters:
            names = [column.name]
        else:
            self.source.refuse(column.name, model)
            names = []
        _refuse_shape(column, names)
        return names

    def _values(self, cells: np.ndarray, group: Group) -> np.ndarray:
        """The values (K, p) of a group's parameters."""
        of: dict[str, np.ndarray] = {}
        places = self.design.places(cells)
        for column in self._own:
            if column.kind == "start":
                names = [start_name(state) for state in states_of(group.model, column)]
            else:
                names = list(group.model.vectors[column.name].ravel()) if column.name in group.model.vectors else [column.name]
            of |= dict(zip(names, column.of(places).reshape(len(cells), -1).T, strict=True))
        if self._start is not None:
            drawn = [self._draw(int(cell)) for cell in cells]
            of |= {start_name(state): np.array([one[state] for one in drawn]) for state in self._drawn}
        return (
            np.column_stack([np.asarray(of[name], float) for name in group.names]) if group.names else np.zeros((len(cells), 0))
        )

    def _draw(self, cell: int) -> dict[str, float]:
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


def states_of(model: Model, column: Column) -> list[str]:
    """The states that a column has the starts of: one, or those of a vector of states."""
    known = starts_of(model)
    stem = model.stems.get(column.name)
    names = [column.name] if column.name in known or stem is None else [model.names[i] for i in stem]
    _refuse_shape(column, names)
    return names


def _refuse_shape(column: Column, names: list[str]) -> None:
    size = int(np.prod(column.values.shape[len(column.along) :], dtype=int))
    if size != len(names):
        what = (
            "one number"
            if len(names) == 1
            else f"{len(names)} numbers ({', '.join(names[:4])}{', ...' if len(names) > 4 else ''})"
        )
        raise UsageError(f"'{column.name}' has {size} numbers in each cell; expected {what}")


def _same(times: np.ndarray, others: np.ndarray) -> bool:
    return times.shape == others.shape and bool(np.allclose(times, others, rtol=1e-9, atol=1e-9 * others[-1]))
