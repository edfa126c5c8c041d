"""Many event-driven runs in a call: the pieces of a model for many values of its parameters, in one library.

C makes rows as `PieceRows` does, operation by operation, so that a cell is the bits of its single run, but for multipliers of
a rewritten law, which are of the state and not of their series. Each cell begins in a cleared solver: nothing of others is seen.
A call ends after SECONDS, in the middle of a cell or not, and goes on from its record.
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
from nsmodel.codegen.batch import BatchCells, CellArrays, checked_values
from nsmodel.codegen.event_driven_runs import PieceLibrary, RunRequest, piece_library_mark
from nsmodel.codegen.event_driven_spec import cached_symbolic_problem
from nsmodel.codegen.rollout import CALL_SECONDS
from nsmodel.codegen.structs import BAD_PARAMETER, NO_MODE, PIECE_BATCH_CELLS
from nsmodel.errors import CodegenError, UsageError
from nsmodel.event_driven.column_expressions import output_symbols
from nsmodel.event_driven.integrator import MAX_EVENT_DRIVEN_OPERATIONS, checked_row_times, checked_tolerances, operation_count
from nsmodel.event_driven.problem import switch_table, switch_times_of
from nsmodel.modeling.base import Model
from nsmodel.modeling.output_columns import OutputColumns
from nsmodel.modeling.time_grid import check_times, input_schedule
from nsmodel.solvers.initial_checks import admitted

MAX_PIECES = 1_000_000  # Pieces of a cell, and of a call in C: a run that takes more, as where switches accumulate, is given up.
MAX_TANGENT_ROWS = 32  # States and rows of runs that are differentiated: the matrices of a step are dense, and of up to 8 stages.
BY = " by "  # "x by k" is the column of dx/dk.

_PieceCellsStruct = PIECE_BATCH_CELLS.ctypes_structure()
_UNDEFINED_AT_START = {"multipliers", "y", "residual", "error_estimate", "reactions"}  # NaN: of the step that ends at a row.


@dataclass(frozen=True)
class PieceBatchCells(BatchCells):
    """Event-driven runs at many values of the parameters, cell by cell; of `BatchCells` beside that:

    Attributes:
        arrays: rows at the times that were asked for.
        status: 4: the values are none that the model accepts. Another one than 0 and 4 says only that C does not go on (no mode,
            an accumulation, no more pieces): `simulate` may.
        steps: rows that were reached, the start none of them; index_set_changes: events; newton: 0.
        pieces: (cells,) that were made; estimate: (cells,) the largest error of one, in units of rtol.
        failed_at: the time from which there is no piece.
    """

    pieces: np.ndarray
    estimate: np.ndarray


class PieceBatch:
    """The event-driven runs of a model for many values of its parameters, one library; any number of threads may ``run`` it.

    A cell is that of `simulate(model, parameters=..., rtol=..., times=..., compiled=True)` bit for bit, where that is in C from
    start to end and takes the library of all values; but multipliers of a law that is rewritten in others are computed of the
    state at a row, not of their series.

    With ``by``, names of parameters, it differentiates the runs by these through all switches (see `sensitivity`): the column
    "x by k" is dx/dk, of the shape of x, for every x that is an expression of states, multipliers, time and parameters. A cell
    whose run has no derivative that C can tell is not gone on with: where the state jumps, a switch is only touched, several
    switch at once whose order matters, or multipliers are not unique.

    Attributes:
        names: of the parameters, one a column of values.
        way: by what it is compiled.

    Raises:
        CodegenError: the model has no parameters, or no pieces in C that are those of all their values (blocks; a curved law;
            many bodies; more than LARGE operations; what time stepping alone takes), or there is no compiler, or it fails.
        UsageError: a time, rtol or atol that is none; ``by``: what is not a parameter.
    """

    def __init__(
        self, model: Model, t_end: float | None, rtol: float, atol: Any, given: Sequence[float], by: Sequence[str] = ()
    ) -> None:
        """``given``: the times (R,) of the rows, increasing, from 0 to t_end, 0 among them or not."""
        check_times(t_end=t_end)
        self.names, self._model = tuple(model.parameters), model
        self._T = float(model.t_end if t_end is None else t_end)
        self._times = np.array([*([0.0] if len(given) and given[0] == 0 else []), *checked_row_times(given, self._T)])
        self._p = problem = cached_symbolic_problem(model)
        if operation_count(problem) > MAX_EVENT_DRIVEN_OPERATIONS:
            raise CodegenError(
                f"f, g and h have {operation_count(problem)} operations, and each event ends a piece of all of them"
            )
        rtol, atol = checked_tolerances(problem, rtol, atol)
        known = switch_times_of(model, self._T)
        fixed = () if problem.held else known.times
        self._by = tuple(dict.fromkeys([by] if isinstance(by, str) else by))
        entries = self._differentiated_entries()
        compiled = PieceLibrary.of(problem, piece_library_mark(problem, fixed, entries), fixed, entries)
        self.way = f"{compiled.way}, one library for all values"
        self._request = RunRequest.made(rtol, atol, switch_table(model, self._T), residuals=False)
        library, pointer = compiled.library, ctypes.c_void_p
        self._size = library.function("size", ctypes.c_long)() // 8 + 1
        self._width = library.function("row_width", ctypes.c_long)()
        self._run = library.function(
            "run_cells", ctypes.c_int, pointer, pointer, ctypes.POINTER(_PieceCellsStruct), ctypes.c_double
        )
        self._tangents_size = library.function("tangents_size", ctypes.c_long)() // 8 + 1 if by else 0
        self._slopes: dict[str, ca.Function] = {}
        self._outputs = OutputColumns.of(model, self._multiplier_names)
        self._starts = ca.Function("starts", [problem.p], [ca.densify(ca.SX(problem.x0))])
        self._admitted = ca.Function("admitted", [model.p], [admitted(model)])
        self._mass = _mass_function(model)
        self._evaluate_outputs(
            _PieceBatchArrays(0, len(self._times), self._width, problem.l.numel()), np.zeros((0, len(self.names)))
        )

    def _differentiated_entries(self) -> list[int]:
        """The entries of p that runs are differentiated by."""
        if unknown := next((name for name in self._by if name not in self.names), None):
            near = did_you_mean(unknown, self.names)
            raise UsageError(f"by: '{unknown}' is not a parameter; there are {', '.join(self.names)}{near}")
        rows = max(self._p.x.numel(), self._p.l.numel())
        if self._by and rows > MAX_TANGENT_ROWS:
            raise CodegenError(f"{rows} states or rows are more than the {MAX_TANGENT_ROWS} for which derivatives in C have room")
        if self._by and (curved := next((block for _, block in self._p.law.parts() if not block.separable), None)):
            raise CodegenError(f"there are no derivatives in C for the law '{curved.label}', whose rows act together")
        return [self.names.index(name) for name in self._by]

    @property
    def _multiplier_names(self) -> tuple[str, ...]:
        return self._p.rows if self._p.multipliers is None else self._p.declared

    def kept_times(self) -> np.ndarray:
        """The times (R,) of the rows."""
        return self._times.copy()

    def columns(self) -> Mapping[str, tuple[int, ...]]:
        """What can be kept, by the names that a Trajectory has, with the shape that one row has of it."""
        shapes = {name: () if isinstance(at, int) else (len(at),) for name, at in self._columns.items()}
        shapes |= {"index_set": (self._p.l.numel(),)}
        shapes |= {name: rows.shape[1:] for name, rows in self._input_columns.items()}
        of_outputs = {name: () if own.size == 1 else (own.size,) for name, own in self._outputs.quantities.items()}
        found = of_outputs | shapes
        return found | {f"{name}{BY}{p}": found[name] for name in found if name in self._expressions for p in self._by}

    @cached_property
    def _columns(self) -> dict[str, int | list[int]]:
        """Where each stands in a row of C."""
        p, model = self._p, self._model
        n, m, own = p.x.numel(), p.l.numel(), len(self._multiplier_names)
        at, found = n + 2 * m, dict[str, Any](x=list(range(p.states)))
        for name, expression in p.columns.items():
            size = expression.numel()
            found[name] = at if name == "energy" else list(range(at, at + size))
            at += size
        if p.multipliers is not None and own:
            found["multipliers"] = list(range(at, at + own))
            at += own
        else:
            found["reactions" if p.impulses else "multipliers"] = list(range(n, n + m))
        if p.impulses:
            found["multipliers"] = list(range(at, at + m))
            at += m
        found |= {"error_estimate": at, "residual": at + 1}
        of_states = {stem: list(places) if len(places) > 1 else places[0] for stem, places in model.stems.items()}
        of_states |= {name: i for i, name in enumerate(model.names)}
        of_rows = dict(zip(self._multiplier_names, found["multipliers"], strict=True))
        return of_rows | of_states | found  # an array comes before what has its name, as in a Trajectory

    def run(self, values: np.ndarray, keep: Sequence[str], stop: Callable[[], bool] = lambda: False) -> PieceBatchCells:
        """Run all cells, each as if it were alone.

        Args:
            values: (cells, np) of the parameters, in the order of ``names``.
            keep: names out of ``columns``.
            stop: asked about every SECONDS; where it says True the cells that are not done get the status -1.

        Raises:
            UsageError: a name that is not a column; another number of parameters.
        """
        given = checked_values(values, self.names, keep, self.columns())
        work = _PieceBatchArrays(len(given), len(self._times), self._width, self._p.l.numel())
        if self._by:
            work.slopes = np.full((*work.kept.shape[:2], self._p.x.numel() + self._p.l.numel(), len(self._by)), np.nan)
            work.tangents = np.zeros(self._tangents_size)
        work.status[self._has_singular_mass(given)] = NO_MODE
        work.status[~self._are_admitted(given)] = BAD_PARAMETER
        plain = {"x", "error_estimate", *self._model.stems, *self._model.names}
        starts = np.ascontiguousarray(np.array(self._starts(given.T)).T)
        control = work.control(given, starts, self._times, self._T, more=not set(keep) <= plain)
        memory = np.zeros(self._size)
        while not self._run(memory.ctypes.data, ctypes.byref(self._request.of), ctypes.byref(control), CALL_SECONDS):
            if stop():
                work.discard_from(control.cell)
                break
        if self._times[0] == 0:
            for name in _UNDEFINED_AT_START & self._columns.keys():
                work.kept[:, 0, self._columns[name]] = np.nan
        return work.cells({name: self._kept_array(name, work, given) for name in keep})

    def _are_admitted(self, given: np.ndarray) -> np.ndarray:
        """Whether values are some that a run does not refuse; what the law says of them, C does."""
        conditions = np.array(self._admitted(given.T)).T.reshape(len(given), self._admitted.size1_out(0))
        return np.logical_and(np.isfinite(np.column_stack([given, conditions])).all(axis=1), (conditions >= 0).all(axis=1))

    def _has_singular_mass(self, given: np.ndarray) -> np.ndarray:
        """Whether M has no inverse, as a run has it."""
        if self._mass is None:
            return np.zeros(len(given), bool)
        n = round(self._mass.numel_out(0) ** 0.5)
        M = np.array(self._mass(given.T)).T.reshape(-1, n, n)
        return np.atleast_1d(np.linalg.matrix_rank(np.where(np.isfinite(M), M, 0)) < n)

    def _kept_array(self, name: str, work: _PieceBatchArrays, given: np.ndarray) -> np.ndarray:
        if name == "index_set":
            return work.index
        if BY in name:
            return self._slope_array(name, work, given)
        if name in self._input_columns:
            return np.repeat(self._input_columns[name][None], len(given), axis=0)
        if name in self._outputs.quantities and name not in self._columns:
            found = self._evaluate_outputs(work, given)[name]
            return found.reshape(len(given), len(self._times), *found.shape[1:])
        at = self._columns[name]
        return work.kept[:, :, at].copy() if isinstance(at, int) else work.kept[:, :, at]

    @cached_property
    def _expressions(self) -> dict[str, ca.SX]:
        """The columns that are expressions of t, x, l and p, of runs that are differentiated."""
        return {"x": self._p.x[: self._p.states]} | output_symbols(self._model, self._p, {}) if self._by else {}

    def _slope_array(self, name: str, work: _PieceBatchArrays, given: np.ndarray) -> np.ndarray:
        """A column's derivative by a parameter: of what it is of t, x, l and p."""
        column, _, parameter = name.rpartition(BY)
        p, n, m = self._p, self._p.x.numel(), self._p.l.numel()
        if name not in self._slopes:
            whole = ca.vec(self._expressions[column])
            of = ca.vertcat(p.x, p.l)
            dp, moved = p.p[self.names.index(parameter)], ca.SX.sym("moved", n + m)
            slope = ca.jacobian(whole, of) @ moved + ca.jacobian(whole, dp)
            self._slopes[name] = ca.Function("slope", [p.t, p.x, p.l, p.p, moved], [ca.densify(slope)])
        rows = len(self._times)
        x_l = work.kept[:, :, : n + m].reshape(-1, n + m).T
        moved = work.slopes[..., self._by.index(parameter)].reshape(-1, n + m).T
        if not given.size:
            return np.zeros((0, rows, *self.columns()[name]))
        found = self._slopes[name](
            np.tile(self._times, len(given))[None], x_l[:n], x_l[n:], np.repeat(given, rows, axis=0).T, moved
        )
        slopes = np.array(found).T.reshape(len(given), rows, *self.columns()[name])
        return np.where(np.isnan(self._kept_array(column, work, given)), np.nan, slopes)

    @cached_property
    def _input_columns(self) -> dict[str, np.ndarray]:
        """Columns of the inputs, which are those of all cells."""
        if not self._model.inputs:
            return {}
        t = self._times
        rows = input_schedule(self._model, self._T).rows(t, np.concatenate([[0.0], t[:-1]]))
        return {name: rows["inputs"][:, i] for i, name in enumerate(self._model.input_names)} | rows

    def _evaluate_outputs(self, work: _PieceBatchArrays, given: np.ndarray) -> dict[str, np.ndarray]:
        """The model's own outputs, all cells one after the other."""
        count = len(given) * len(self._times)
        flat = {name: work.kept[:, :, at].reshape(count, *np.shape(at)) for name, at in self._columns.items()}
        flat |= {name: np.tile(rows, (len(given), *[1] * (rows.ndim - 1))) for name, rows in self._input_columns.items()}
        flat |= {"t": np.tile(self._times, len(given)), "index_set": work.index.reshape(count, work.index.shape[2])}
        flat["step"] = np.tile(np.diff(self._times, prepend=np.nan if 0 in self._times else 0.0), len(given))
        parameters: Any = dict(zip(self.names, np.repeat(given, len(self._times), axis=0).T, strict=True))
        return OutputColumns(self._outputs.names._replace(parameters=parameters), self._outputs.quantities)(flat)


class _PieceBatchArrays(CellArrays):
    """Those of event-driven runs."""

    def __init__(self, cells: int, rows: int, width: int, m: int) -> None:
        super().__init__(cells, rows, width, m, "taken pieces events estimate worst")
        self.slopes: np.ndarray = np.zeros((cells, rows, 0, 0))  # Of cells that are differentiated.
        self.tangents = np.zeros(0)

    def control(self, given: np.ndarray, starts: np.ndarray, times: np.ndarray, t_end: float, *, more: bool) -> Any:
        """The record that the library reads and writes; it holds on to the arrays that it points to."""
        arrays = {
            "times": times, "values": given, "starts": starts, "until": np.zeros(self.index.shape[2]),
            "told": np.zeros(self.index.shape[2]), "slopes": self.slopes, "tangents": self.tangents, **self.arrays,
        }  # fmt: skip
        control = _PieceCellsStruct(
            cells=len(given), rows=len(times), more=more, most=MAX_PIECES, t_end=t_end,
            **{name: array.ctypes.data for name, array in arrays.items()},
        )  # fmt: skip
        control.held = arrays
        return control

    def discard_from(self, cell: int) -> None:
        """Forget the rows of a cell that was left in the middle."""
        super().discard_from(cell)
        self.slopes[cell:] = np.nan

    def cells(self, arrays: Mapping[str, np.ndarray]) -> PieceBatchCells:
        """What they found."""
        steps, pieces, events = (self.totals[name].astype(int) for name in ("taken", "pieces", "events"))
        none, failed_at = np.zeros(len(steps), int), self.arrays["failed_at"]
        return PieceBatchCells(
            arrays, self.status, steps, self.totals["worst"], events, none, failed_at, pieces, self.totals["estimate"]
        )


def _mass_function(model: Model) -> ca.Function | None:
    """M, row by row, where it depends on the parameters."""
    M = getattr(model, "M", None)
    if not isinstance(M, ca.SX) or not ca.depends_on(M, model.p):
        return None
    return ca.Function("mass", [model.p], [ca.vec(ca.densify(M).T)])
