"""Many runs in a call: the steps of a model on a grid for many values of its parameters, in one library.

Each cell begins in cleared memory, so that its bits do not depend on the others, on threads, or on where a call ended; rows go
from C into the columns that are kept. A cell that C cannot verify has a status, and whoever asked may interpret it. No flag
lets a compiler contract sums. `simd_batch` takes the cells where it has no reason to refuse.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from nsmodel._utils import did_you_mean
from nsmodel.codegen import simd_batch, structs, varying_steps
from nsmodel.codegen.rollout import CALL_SECONDS, load_step_library
from nsmodel.codegen.step_spec import spec_for_all_values
from nsmodel.codegen.structs import BAD_ARITHMETIC, BAD_PARAMETER, NOT_SOLVED, STATUSES
from nsmodel.errors import CodegenError, UsageError
from nsmodel.modeling.base import Model
from nsmodel.modeling.time_grid import TimeGrid
from nsmodel.modeling.variants import initial_inputs
from nsmodel.solvers.initial_checks import admitted
from nsmodel.solvers.one_step_problem import symbolic_initial_rows
from nsmodel.solvers.step import INNER_COLUMNS, UNKNOWN_INDEX, VECTOR_COLUMNS

TO_DO = -1  # The status of a cell that was not reached; those of steps are >= 0.
LANES_NOTE = "in lanes, whose last bits are not those of a run alone"

_CellsStruct = structs.BATCH_CELLS.ctypes_structure()


@dataclass(frozen=True)
class BatchCells:
    """Runs at many values of the parameters, cell by cell.

    Attributes:
        arrays: {name: (cells, R) or (cells, R, k)} of what is kept: rows as those of a Trajectory, the start first; NaN, and in
            index sets -2, behind a failure. Columns that are kept together are views of one array.
        status: (cells,) of the library (see `statuses`): 0 done; -1 not reached. One that failed says only that C has no
            verified step: the interpreted solvers may have.
        steps: (cells,) that were taken and verified; worst_residual, index_set_changes, newton: of these, in all.
        failed_at: (cells,) the time from which a step failed; NaN where none did.
    """

    arrays: Mapping[str, np.ndarray]
    status: np.ndarray
    steps: np.ndarray
    worst_residual: np.ndarray
    index_set_changes: np.ndarray
    newton: np.ndarray
    failed_at: np.ndarray


class StepBatch:
    """The steps of a model on a grid for many values of its parameters, in one library; any number of threads may ``run`` it.

    Attributes:
        names: of the parameters, one a column of values.
        way: by what it is compiled, and whether many runs go in step (see `lanes`): then each is within rounding of the run
            alone, and its bits depend on nothing but its own parameters.

        level: of the processor that lanes make use of (see ``c/lanes.c``), -1: all of it; the bits are the same.

    Raises:
        CodegenError: the model has no C of this kind (no parameters, blocks, large sparse steps, many bodies, a set that a
            parameter moves under catching-up), or there is no compiler, or it fails.
    """

    level = -1

    def __init__(self, model: Model, grid: TimeGrid, tolerance: float, in_lanes: bool = True) -> None:
        """Build or load the library; ``in_lanes``: many runs in step, where the model has that."""
        self.names, self._grid, self._model = tuple(model.parameters), grid, model
        self._spec = spec_for_all_values(model, grid, tolerance)
        self._layout = varying_steps.packed_layout(self._spec)
        in_lanes = in_lanes and grid.steps is None and not simd_batch.lanes_obstacle(self._spec)
        try:
            library, self.way = load_step_library(model, grid, tolerance, for_all=True, in_lanes=in_lanes)
        except CodegenError:  # a compiler without what lanes ask for
            if not in_lanes:
                raise
            in_lanes, (library, self.way) = False, load_step_library(model, grid, tolerance, for_all=True)
        pointer, seconds = ctypes.c_void_p, ctypes.c_double
        memory = np.zeros(library.function("size", ctypes.c_long)() // 8 + 1)
        if library.function("init", ctypes.c_int, pointer)(memory.ctypes.data) == BAD_ARITHMETIC:
            raise CodegenError(f"{self.way}: {STATUSES[BAD_ARITHMETIC].text}")
        name, level = ("run_lanes", [ctypes.c_int]) if in_lanes else ("run_cells", [])
        run = library.function(name, ctypes.c_int, pointer, ctypes.POINTER(_CellsStruct), seconds, *level)
        self._run = lambda *at: run(*at, CALL_SECONDS, *([self.level] if in_lanes else []))
        self._size = library.function("lanes_size" if in_lanes else "size", ctypes.c_long)()
        self.way += f", {LANES_NOTE}" if in_lanes else ""
        rows = symbolic_initial_rows(model, self._spec.problem.h)
        self._known, row = len(rows), np.full((len(rows), self._layout.width), np.nan)
        row[:, self._layout.newton] = 0.0
        start = ca.SX(row)
        for k, (state, records) in enumerate(rows):
            start[k, : state.numel()] = state
            if self._spec.problem.inputs:
                start[k, self._layout.inputs] = np.tile(initial_inputs(model), 2)
            for name, value in records.items():
                start[k, self._layout.slices[name]] = ca.vec(value).T
        start = ca.substitute(start, self._spec.problem.h, grid.step(0))
        self._start = ca.Function("start", [model.p], [ca.vec(start.T), admitted(model), self._spec.problem.assumed])

    def kept_row_numbers(self, every: int) -> np.ndarray:
        """The numbers (R,) of the rows that are kept: those known before a step, every ``every``-th, the last."""
        if every < 1:
            raise UsageError(f"every = {every}; expected a whole number >= 1")
        N, known = self._grid.N, self._known
        computed = np.arange(every, N + 1, every)
        computed = computed[computed >= known]
        last = [N] if N >= known and N % every else []
        return np.concatenate([np.arange(known), computed, np.array(last, int)])

    def kept_times(self, every: int) -> np.ndarray:
        """The times (R,) of the rows that are kept: the start, every ``every``-th step, the last."""
        return np.array([self._grid.time(k) for k in self.kept_row_numbers(every).tolist()])

    def columns(self) -> Mapping[str, tuple[int, ...]]:
        """What can be kept, by the names that a Trajectory has, with the shape that one row has of it."""
        shapes = {name: () if isinstance(at, int) else (len(at),) for name, at in self._columns.items()}
        return shapes | {"index_set": (self._spec.structure.m,)}

    @cached_property
    def _columns(self) -> dict[str, int | list[int]]:
        """Where each stands in a packed row."""
        model, slices, problem = self._model, self._layout.slices, self._spec.problem
        found: dict[str, Any] = {"x": list(range(len(model.names))), "residual": self._layout.residual}
        for name, first, other in (("multipliers", "multipliers", "l"), ("y", "outputs", "y")):
            found[name] = _slice_indices(slices.get(first, slices[other]))
        if self._spec.path == "NEWTON":
            found["newton"] = self._layout.newton
        for name, at in slices.items():
            if name not in INNER_COLUMNS:
                found[name] = _slice_indices(at) if name in VECTOR_COLUMNS or at.stop - at.start != 1 else at.start
        of_states = {stem: list(at) if len(at) > 1 else at[0] for stem, at in model.stems.items()}
        of_states |= {name: i for i, name in enumerate(model.names)}
        of_rows = dict(zip(problem.multiplier_names, found["multipliers"], strict=True))
        of_inputs = dict(zip(model.input_names, found["inputs"], strict=True)) if problem.inputs else {}
        return of_inputs | of_rows | of_states | found  # an array comes before what has its name, as in a Trajectory

    def run(
        self, values: np.ndarray, keep: Sequence[str], every: int = 1, inputs: np.ndarray | None = None,
        stop: Callable[[], bool] = lambda: False,
    ) -> BatchCells:  # fmt: skip
        """Run all cells, each as if it were alone.

        Args:
            values: (cells, np) of the parameters, in the order of ``names``.
            keep: names out of ``columns``; every: which rows.
            inputs: (N, 2 nu) of all cells, u at the begin and at the end of each step; left out: what drives the grid.
            stop: asked about every SECONDS; where it says True the cells that are not done get the status -1.

        Raises:
            UsageError: a name that is not a column; another number of parameters or of steps.
        """
        given = checked_values(values, self.names, keep, self.columns())
        selected = {name: self._columns[name] for name in keep if name != "index_set"}
        m = self._spec.structure.m if "index_set" in keep else None
        work = _BatchArrays(selected, len(given), self.kept_row_numbers(every).size, m)
        self._initialise(work, given)
        control = self._control(work, given, every, self._input_values(inputs))
        memory = np.zeros(self._size // 8 + 1 + simd_batch.ALIGNMENT // 8)
        at = memory.ctypes.data + -memory.ctypes.data % simd_batch.ALIGNMENT
        while not self._run(at, ctypes.byref(control)):
            if stop():
                work.discard_from(control.cell)
                break
        return work.cells()

    def _initialise(self, work: _BatchArrays, given: np.ndarray) -> None:
        """The rows that are known before a step; cells that a run refuses, and those whose problem has another form."""
        if not len(given):
            return
        rows, conditions, assumed = (np.array(part).T.reshape(len(given), -1) for part in self._start(given.T))
        work.status[~(assumed > 0).all(axis=1)] = NOT_SOLVED
        work.status[~(np.isfinite(conditions) & (conditions >= 0)).all(axis=1)] = BAD_PARAMETER
        work.status[~np.isfinite(given).all(axis=1)] = TO_DO  # the library says what these are
        work.kept[:, : self._known] = rows.reshape(len(given), self._known, -1)[:, :, work.columns] + 0.0

    def _input_values(self, inputs: np.ndarray | None) -> np.ndarray | None:
        nu, N = self._spec.problem.inputs, self._grid.N
        if not nu:
            return None
        if inputs is None and self._grid.drive is not None:
            inputs = self._grid.drive.limits(self._grid.between(0, N))
        if inputs is None:
            raise UsageError("inputs: the grid has no input signals; give u at both ends of each step, or a grid with signals")
        found = np.ascontiguousarray(inputs, float)
        if found.shape != (N, 2 * nu):
            raise UsageError(f"inputs: shape {found.shape}; expected ({N}, {2 * nu}), both ends of each step")
        return found

    def _control(self, work: _BatchArrays, given: np.ndarray, every: int, inputs: np.ndarray | None) -> Any:
        """The record that the library reads and writes; it holds on to the arrays that it points to."""
        grid, known = self._grid, self._known
        jumps = grid.drive.jump_steps(grid.times) if grid.drive is not None and self._spec.finds_restart_reaction else []
        arrays = {
            "times": grid.times if grid.steps is not None else None, "lengths": grid.steps, "values": given, "inputs": inputs,
            "jumps": np.array(jumps, ctypes.c_long), "columns": work.columns.astype(ctypes.c_long),
            "whole": np.zeros(self._layout.width), **work.arrays,
        }  # fmt: skip
        held = {name: None if a is None else np.ascontiguousarray(a) for name, a in arrays.items()}
        pointers = {name: None if a is None else a.ctypes.data for name, a in held.items()}
        control = _CellsStruct(
            cells=len(given), steps=grid.N, every=every, rows=work.kept.shape[1], width=work.columns.size,
            last=grid.step(grid.N - 1), jumping=len(jumps), step=-1, first=known, **pointers,
        )  # fmt: skip
        control.held = held
        return control


def checked_values(
    values: np.ndarray, names: Sequence[str], keep: Sequence[str], columns: Mapping[str, tuple[int, ...]]
) -> np.ndarray:
    """The values (cells, np) as C reads them; UsageError for another number of parameters, or a name that is no column."""
    given = np.ascontiguousarray(values, float)
    if given.ndim != 2 or given.shape[1] != len(names):
        raise UsageError(f"values: shape {given.shape}; expected (cells, {len(names)}), a column for each parameter")
    if unknown := next((name for name in keep if name not in columns), None):
        raise UsageError(f"keep: '{unknown}' is not a column; there are {', '.join(columns)}{did_you_mean(unknown, columns)}")
    return given


class CellArrays:
    """What the cells of one call write: ``arrays`` by their names in C, of these ``kept``, ``index`` and ``status``.

    ``m``: codes of an index set, None where it is not kept; ``totals``: names of what is counted of each cell.
    """

    def __init__(self, cells: int, rows: int, width: int, m: int | None, totals: str) -> None:
        self.kept = np.full((cells, rows, width), np.nan)
        self.index: Any = None if m is None else np.full((cells, rows, m), UNKNOWN_INDEX, np.int8)
        self.status = np.full(cells, TO_DO, np.int8)
        self.totals = {name: np.zeros(cells) for name in totals.split()}
        own = {"kept": self.kept, "index": self.index, "status": self.status, "failed_at": np.full(cells, np.nan)}
        self.arrays: dict[str, Any] = own | self.totals

    def discard_from(self, cell: int) -> None:
        """Forget the rows of a cell that was left in the middle."""
        self.kept[cell:] = np.nan
        if self.index is not None:
            self.index[cell:] = UNKNOWN_INDEX
        for total in self.totals.values():
            total[cell:] = 0


class _BatchArrays(CellArrays):
    """Those of steps."""

    def __init__(self, picked: dict[str, int | list[int]], cells: int, rows: int, m: int | None) -> None:
        self._at, columns = {}, []
        for name, places in picked.items():
            own = [places] if isinstance(places, int) else places
            self._at[name] = len(columns) if isinstance(places, int) else slice(len(columns), len(columns) + len(own))
            columns += own
        self.columns = np.array(columns, int)
        super().__init__(cells, rows, len(columns), m, "taken worst changes newton")

    def cells(self) -> BatchCells:
        """What they found."""
        arrays: dict[str, np.ndarray] = {name: self.kept[:, :, at] for name, at in self._at.items()}
        if self.index is not None:
            arrays["index_set"] = self.index
        steps, changes, newton = (self.totals[name].astype(int) for name in ("taken", "changes", "newton"))
        return BatchCells(arrays, self.status, steps, self.totals["worst"], changes, newton, self.arrays["failed_at"])


def _slice_indices(at: slice) -> list[int]:
    return list(range(at.start, at.stop))
