"""What a sweep keeps of its cells, and how each is run.

Numbers of a run: functions of it, and reductions of a column that a text names, such as ``x1[-1]`` or ``max(x1)``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np

from nsmodel.codegen.event_driven_batch import BY
from nsmodel.errors import UsageError
from nsmodel.event_driven import integrator as pieces
from nsmodel.modeling.base import Model
from nsmodel.modeling.time_grid import TimeGrid, format_value, is_number, make_grid
from nsmodel.modeling.variants import parametric_inputs
from nsmodel.simulation.options import METHODS
from nsmodel.sweep.variable import CELL_NOT_RUN

_ROW_PATTERN = re.compile(r"\s*(?P<name>[^\[\]()]+(?:\(0\)|\[\d+\])?)\s*\[\s*(?P<row>[+-]?\d+)\s*\]\s*")
_REDUCTION_PATTERN = re.compile(r"\s*(?P<how>\w+)\s*\(\s*(?P<name>.+?)\s*\)\s*")
ROW_REDUCTIONS = {"max": np.fmax, "min": np.fmin}  # Of all rows that have a value: multipliers have none at the start.
WINDOW_REDUCTIONS = ("mean", "rms", "integral")  # Of the whole run, as `Trajectory.mean` has them.


@dataclass(frozen=True)
class Reduction:
    """A number of one column: at a row, or its max, min, mean, rms or integral over the run."""

    text: str
    name: str
    how: str
    row: int = 0

    @property
    def needed_rows(self) -> tuple[int, ...] | None:
        """The rows that it reads, 0 or -1; None: all."""
        return (self.row,) if self.how == "row" and self.row in (0, -1) else None

    @property
    def needs_rows_alone(self) -> bool:
        """Whether it is of rows, not of what a whole run knows."""
        return self.how not in WINDOW_REDUCTIONS

    def reduce_rows(self, values: np.ndarray) -> np.ndarray:
        """Of columns (K, R) or (K, R, n): (K,) or (K, n); NaN where a failed run has no such row."""
        if self.how != "row":
            found = ROW_REDUCTIONS[self.how].reduce(values, axis=1)
        elif -values.shape[1] <= self.row < values.shape[1]:
            found = values[:, self.row]
        else:
            raise UsageError(f"output '{self.text}': there is no row {self.row}; runs of this sweep have {values.shape[1]} rows")
        return found[:, 0] if found.ndim == 2 and found.shape[1] == 1 else found

    def __call__(self, run: Any) -> np.ndarray:
        """The reduced column of a run."""
        if self.how in WINDOW_REDUCTIONS:
            found = np.asarray(getattr(run, self.how)(self.name))
            return found[0] if found.shape == (1,) else found
        with np.errstate(invalid="ignore"):
            return self.reduce_rows(run_column(run, self.name)[None])[0]


def run_column(run: Any, name: str) -> np.ndarray:
    """A column of a run by its name, a derivative among them."""
    return np.asarray(run[name])


def read_outputs(given: Mapping[str, Any] | None) -> dict[str, Callable[[Any], Any]]:
    """Read ``outputs=``: functions of a run, texts as reductions.

    Raises:
        UsageError: no dictionary, what is neither, a text that is no reduction.
    """
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise UsageError(f"outputs = {given!r:.60}; expected {{name: function of a run, or a string such as 'x1[-1]'}}")
    return {str(name): _read_reduction(str(name), what) for name, what in given.items()}


def _read_reduction(name: str, what: Any) -> Callable[[Any], Any]:
    if not isinstance(what, str):
        if not callable(what):
            raise UsageError(f"output '{name}': {what!r:.60}; expected a function of a run, or a string such as 'x1[-1]'")
        return what
    if found := _REDUCTION_PATTERN.fullmatch(what):
        how = found["how"]
        if how not in (*ROW_REDUCTIONS, *WINDOW_REDUCTIONS):
            raise UsageError(
                f"output '{name}': '{how}' is unknown; there are {', '.join((*ROW_REDUCTIONS, *WINDOW_REDUCTIONS))}, and "
                "NAME[ROW]"
            )
        return Reduction(what, found["name"], how)
    if found := _ROW_PATTERN.fullmatch(what):
        return Reduction(what, found["name"].strip(), "row", int(found["row"]))
    raise UsageError(f"output '{name}': '{what}'; expected NAME[ROW], such as x1[-1] for the end, or max(NAME), mean(NAME), ...")


TARGET_ROWS = 200  # Rows that are kept of a run, where nothing else is asked for: a line of a picture needs no more.
CELL_FACTS: Mapping[
    str, tuple[str, Any]
] = {  # {name of what is kept of every cell: (data type, value of a cell that was not run)}
    "status": ("i1", CELL_NOT_RUN),
    "failed_at": ("f8", np.nan),
    "steps": ("i8", 0),
    "worst_residual": ("f8", np.nan),
    "index_set_changes": ("i8", 0),
    "way": ("i1", -1),
}
EVENT_DRIVEN_FACTS: Mapping[str, tuple[str, Any]] = {"pieces": ("i8", 0), "estimate": ("f8", np.nan)}  # And of event-driven runs.
BATCH_BACKEND, PIECES_BACKEND, ALONE_BACKEND = "batch", "pieces", "alone"
_NOT_IN_NAMES = set("/\\:\n\r\0")  # They mean something to files.
CELL_BACKENDS = (BATCH_BACKEND, PIECES_BACKEND, ALONE_BACKEND)  # Of a cell, by their numbers in ``way``.


@dataclass(frozen=True)
class SweepRequest:
    """What is asked of every cell.

    Attributes:
        keep: columns to keep over time; every: each how many steps, None: so that there are about TARGET_ROWS.
        outputs: numbers of a run by name.
        options: of `simulate`: solver, tolerance, compiled, rtol, atol, method, t_end, times.
        way: how cells are run: in C with others, by steps or by pieces, or each alone by `simulate`.
    """

    keep: tuple[str, ...]
    every: int | None
    outputs: Mapping[str, Callable[[Any], Any]]
    options: Mapping[str, Any]
    way: str = ALONE_BACKEND

    def __post_init__(self) -> None:
        """Refuse what no sweep has."""
        if self.every is not None and not (is_number(self.every) and self.every >= 1 and float(self.every).is_integer()):
            raise UsageError(f"every = {format_value(self.every)}; expected a whole number >= 1")
        if self.every is not None and self.is_event_driven:
            raise UsageError("every counts steps, which runs with rtol do not have; give times=, the times of the rows")
        if not self.keep and not self.outputs:
            raise UsageError(
                "nothing is kept of the cells: give keep=['x1'], columns to keep over time, or outputs={'end': 'x1[-1]'}"
            )
        taken = {*self.facts, "message", "t"}
        for name in (*self.keep, *self.outputs):
            if not isinstance(name, str) or not name.strip() or _NOT_IN_NAMES & set(name):
                raise UsageError(f"'{name}' cannot be the name of a quantity; expected a string without / \\ : and line ends")
            if name in taken:
                raise UsageError(f"'{name}' has its own place in every sweep; leave it out, or give the output another name")
            if name in self.keep and (self.keep.count(name) > 1 or name in self.outputs):
                raise UsageError(f"'{name}' is kept twice; keep one")
        if self.derivatives and (not self.is_event_driven or self.options.get("method") == METHODS[2]):
            raise UsageError(f"'{self.derivatives[0]}' is a derivative, which event-driven runs have: give rtol=1e-8")

    @property
    def labelled_columns(self) -> list[tuple[str, str]]:
        """The columns that are read, each with the argument that names it."""
        reduced = [(f"output '{name}'", one.name) for name, one in self.outputs.items() if isinstance(one, Reduction)]
        return [*(("keep", name) for name in self.keep), *reduced]

    @property
    def columns(self) -> list[str]:
        """The columns that are read."""
        return [name for _, name in self.labelled_columns]

    @property
    def derivatives(self) -> list[str]:
        """Those of them that are derivatives: "x by k"."""
        return list(dict.fromkeys(name for name in self.columns if BY in name))

    @property
    def by(self) -> list[str]:
        """What runs are differentiated by."""
        return list(dict.fromkeys(name.rpartition(BY)[2] for name in self.derivatives))

    @property
    def facts(self) -> Mapping[str, tuple[str, Any]]:
        """What is kept of every cell beside what is asked for: {name: (data type, value of a cell that was not run)}."""
        return {**CELL_FACTS, **EVENT_DRIVEN_FACTS} if self.is_event_driven else CELL_FACTS

    @property
    def names(self) -> tuple[str, ...]:
        """All quantities, in their order."""
        return (*self.keep, *self.outputs, *self.facts)

    def quantity_types(self, rows: int) -> dict[str, tuple[str, tuple[int, ...]]]:
        """{name: (data type, shape of a cell)} of all quantities, where no cell says it by what it gave."""
        kept = dict.fromkeys(self.keep, ("f8", (rows,)))
        return {**kept, **dict.fromkeys(self.outputs, ("f8", ())), **{name: (kind, ()) for name, (kind, _) in self.facts.items()}}

    def bytes_kept(self, rows: int) -> int:
        """At least the memory of what is kept of a cell."""
        return sum(np.dtype(kind).itemsize * prod(shape) for kind, shape in self.quantity_types(rows).values())

    @property
    def is_event_driven(self) -> bool:
        """Whether runs have a tolerance in place of steps."""
        return self.options.get("rtol") is not None

    def row_bytes(self, model: Model, step: float | None) -> int:
        """About the memory of a cell's rows while it is run with others."""
        whole = [one for one in self.outputs.values() if isinstance(one, Reduction) and one.needed_rows is None]
        rows = TARGET_ROWS if self.is_event_driven or not whole else self.grid(model, step).N
        return 8 * rows * (len(whole) + len(self.keep) * len(model.names) + 1)

    def grid(self, model: Model, step: float | None) -> TimeGrid:
        """The steps of a cell's run, but for the edges of signals that move with what varies."""
        driven = bool(model.inputs) and not parametric_inputs(model)
        return make_grid(model, step, None, self.options.get("t_end"), driven=driven)

    def rows(self, model: Model, step: float | None, longest: float | None = None) -> RowSelection:
        """The rows that are kept of a run; ``longest``: of the steps that the sweep has, whose rows all of them have."""
        if self.is_event_driven:
            T = float(self.options.get("t_end") or model.t_end)
            times = self.options.get("times")
            pieces.checked_rtol(self.options["rtol"])
            pieces.checked_atol(self.options.get("atol"), model.names)
            if times is not None:
                pieces.checked_row_times(times, T)
            ends = not self.keep and all(isinstance(one, Reduction) and one.needed_rows for one in self.outputs.values())
            evenly = np.array([0.0, T]) if ends else np.linspace(0.0, T, TARGET_ROWS + 1)
            return RowSelection(evenly if times is None else np.asarray(times, float), 0)
        grid = self.grid(model, step)
        first = grid if longest is None else self.grid(model, longest)
        every = self.every or max(1, -(-first.N // TARGET_ROWS))
        ratio = 1 if longest is None or step is None else longest / step
        if abs(ratio - round(ratio)) > 1e-9 * ratio:
            raise UsageError(
                f"steps {longest:g} and {step:g} have no common rows, as neither is a multiple of the other; give steps that "
                "are, or outputs= in place of keep="
            )
        every *= round(ratio)
        numbers = np.append(np.arange(0, grid.N, every), grid.N)
        times = np.array([grid.time(int(k)) for k in numbers])
        return RowSelection(times, 0 if parametric_inputs(model) else every)  # Edges of each cell put other steps beside these.


@dataclass(frozen=True)
class RowSelection:
    """The rows that are kept of each run: their times; ``every`` how many steps, 0 where they are asked for by time."""

    times: np.ndarray
    every: int


@dataclass(frozen=True)
class CellResults:
    """What cells gave: ``arrays`` {name: (K, ...)}, CELL_FACTS among them; ``messages`` of those that are not done."""

    arrays: Mapping[str, np.ndarray]
    messages: Mapping[int, str]

    @property
    def cells(self) -> int:
        """How many there are."""
        return len(self.arrays["status"])
