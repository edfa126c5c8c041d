"""Whole runs in C: many steps of a model a call, compiled once (see `cache`)."""

from __future__ import annotations

import ctypes
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import cached_per_object
from nsmodel.codegen import structs
from nsmodel.codegen.library import (
    STEP_NAME,
    Library,
    cached_steps,
    required_compiler,
)
from nsmodel.codegen.structs import BAD_ARITHMETIC, NOT_SOLVED, SOLVER_NAMES, STATUSES
from nsmodel.errors import CodegenError
from nsmodel.modeling.base import Model
from nsmodel.modeling.fingerprint import ALL_VALUES_SUFFIX
from nsmodel.modeling.time_grid import TimeGrid
from nsmodel.solvers.one_step_problem import one_step_problem
from nsmodel.solvers.step import RowLayout, StepResult, WarmStart

NO_ENTRIES = slice(0, 0)
# Libraries that are kept loaded while no run has them, those used last:
# each takes memory, and is loaded again where it is asked for.
MAX_LOADED = 32
# A call takes about as long, and so late comes Ctrl-C: nobody notices, and the overhead of a call is nothing beside it.
CALL_SECONDS = 0.05

_TotalsStruct = structs.STEP_TOTALS.ctypes_structure()
RestartFunction = Callable[[float, float, np.ndarray], np.ndarray]


class StepBlock(NamedTuple):
    """Some steps, and what they add up to.

    Attributes:
        steps: how many were taken; stuck: whether the next one was not certified.
        state, warm: where the next one starts.
        worst, worst_step: the largest residual, and the number of the step that ended with it.
        newton, newton_max: Newton iterations in all, and most in a step.
        changes: how often the index set changed.
        least_eigenvalue: of the W + W' met, where one is below what was known.
        solvers: number of steps by the solver whose answer was accepted.
    """

    steps: int
    stuck: bool
    state: np.ndarray
    warm: WarmStart
    worst: float
    worst_step: int
    newton: float
    newton_max: float
    changes: int
    least_eigenvalue: float
    solvers: dict[str, int]


class Rollout:
    """The steps of one bound model on one grid, compiled; ``way``: by what.

    ``whole``: the model with its parameters as symbols, whose library for all values is taken; left out: code of the numbers.

    Raises:
        CodegenError: the model has no C counterpart, or none for all values, or there is no compiler, or it fails.
    """

    def __init__(self, model: Model, grid: TimeGrid, tolerance: float, symbolic_model: Model | None = None) -> None:
        self.grid = grid
        whole, for_all = (model, False) if symbolic_model is None else (symbolic_model, True)
        library, self.way = load_step_library(whole, grid, tolerance, for_all=for_all)
        pointer, number, count = ctypes.c_void_p, ctypes.c_double, ctypes.c_long
        self._set_state = library.function("place", None, pointer, number, number, pointer, pointer, pointer)
        self._fetch = library.function("fetch", None, pointer, pointer, pointer, pointer)
        self._rollout = library.function(
            "rollout", count, pointer, number, count, number, count, number, pointer, pointer, pointer, pointer, pointer,
            ctypes.POINTER(_TotalsStruct),
        )  # fmt: skip
        self._single = library.function("single", ctypes.c_int, pointer, number, number, pointer, pointer)
        self._restart = _optional_function(library, "restart", ctypes.c_int, pointer, number, pointer)
        self._steps = np.zeros(2)
        self._single_stepper: SingleStepper | None = None
        self._adapt = _optional_function(
            library, "adapt", count, pointer, pointer, count, number, number, pointer, pointer, pointer, pointer, pointer,
            ctypes.POINTER(_TotalsStruct),
        )  # fmt: skip
        self._memory = np.zeros(library.function("size", count)() // 8 + 1)
        self._solver = self._memory.ctypes.data
        status = library.function("init", ctypes.c_int, pointer)(self._solver)
        if status == BAD_ARITHMETIC:
            raise CodegenError(f"{self.way}: {STATUSES[status].text}")
        if symbolic_model is not None:
            self._set_parameters(symbolic_model, model, library)

    def _set_parameters(self, symbolic_model: Model, model: Model, library: Library) -> None:
        """Set the parameters to the numbers that the bound model has."""
        values = np.array([model.bound_parameters[name] for name in symbolic_model.parameters], float)
        assumed = np.array(ca.Function("assumed", [symbolic_model.p], [one_step_problem(symbolic_model).assumed])(values))
        status = library.function("set_parameters", ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)(
            self._solver, values.ctypes.data
        )
        if status or not (assumed > 0).all():
            raise CodegenError(
                f"the library for all parameter values does not apply to these: {STATUSES[status or NOT_SOLVED].text}"
            )

    def advance(
        self, k: int, steps: int, state: np.ndarray, warm: WarmStart, least: float, every: int, rows: np.ndarray,
        index: np.ndarray, inputs: np.ndarray | None = None,
    ) -> StepBlock:  # fmt: skip
        """Take up to ``steps`` steps from number k, for about SECONDS, until one is not certified.

        ``rows`` and ``index`` are filled with every ``every``-th row and the grid's last; ``least`` is the least eigenvalue
        known of W + W', -inf where none is looked for; ``inputs``: u at both ends of each step (steps, 2 nu).
        """
        grid, totals = self.grid, _TotalsStruct(least=least)
        x, l, codes = np.array(state, float), np.array(warm.l, float), np.array(warm.index, np.int8)
        times = lengths = None
        if grid.steps is not None and grid.times is not None:
            times, lengths = grid.times[k : k + steps].ctypes.data, grid.steps[k : k + steps].ctypes.data
        at = x.ctypes.data, l.ctypes.data, codes.ctypes.data
        self._set_state(self._solver, k, grid.h, *at)
        done = self._rollout(
            self._solver, k, steps, grid.N, every, CALL_SECONDS, times, lengths,
            None if inputs is None else inputs.ctypes.data, rows.ctypes.data, index.ctypes.data, ctypes.byref(totals),
        )  # fmt: skip
        self._fetch(self._solver, *at)
        return _make_step_block(done, totals, x, WarmStart(l, codes))

    def starter(self, otherwise: RestartFunction) -> RestartFunction:
        """What finds the reaction that a state carries anew, for (t, h, state): in C, where that certifies it."""

        def restart(t: float, h: float, state: np.ndarray) -> np.ndarray:
            x = np.array(state, float)
            return x if self._restart(self._solver, t, x.ctypes.data) == 0 else otherwise(t, h, state)

        return restart

    @property
    def adaptive(self) -> bool:
        """Whether steps under error control can be taken here."""
        return self._adapt is not None

    @staticmethod
    def control(state: int, m: int, watched: int) -> np.ndarray:
        """``model_control`` in C, by name: numbers, then the state, the multipliers and what is watched of the state."""
        return np.zeros((), structs.ADAPTIVE_CONTROL.ctypes_structure(STATES=state, ROWS=max(m, 1), WATCHED=watched))

    def advance_adaptively(
        self, control: np.ndarray, number: int, least: float, rows: np.ndarray, index: np.ndarray, columns: np.ndarray
    ) -> StepBlock:
        """Take steps under error control for about SECONDS, until there is no more room or one is not certified.

        Args:
            control: a record laid out by ``control``, which is brought up to date.
            number: of the row where they start; least: as in ``advance``.
            rows, index: filled with two rows a step; columns (3, rows): with the times, the lengths of their half steps, and how
                far extrapolation has moved their states.
        """
        totals = _TotalsStruct(least=least)
        at = (part.ctypes.data for part in (rows, index, *columns))
        done = self._adapt(self._solver, control.ctypes.data, len(rows), number, CALL_SECONDS, *at, ctypes.byref(totals))
        return _make_step_block(
            done, totals, control["x"].copy(), WarmStart(control["l"].copy(), control["index"].astype(np.int8))
        )

    def one(self, k: int, state: np.ndarray, warm: WarmStart, layout: RowLayout) -> StepResult | None:
        """Step number k alone; None where it is not certified."""
        found = self.alone(layout, warm.index.size)(k, state, warm.l, warm.index)
        if found is None:
            return None
        row, index, solver = found
        return StepResult(row, WarmStart(row[layout.l], index), SOLVER_NAMES[solver])

    def alone(self, layout: RowLayout, m: int) -> SingleStepper:
        """What takes single steps of the grid's length."""
        if self._single_stepper is None:
            self._single_stepper = SingleStepper(self._single, self._solver, self.grid.h, layout, m)
        return self._single_stepper

    def step(self, t: float, h: float, state: np.ndarray, warm: WarmStart, layout: RowLayout) -> StepResult | None:
        """One step as the contract of `solvers.step` has it; None where it is not certified. The grid must have given steps."""
        totals, row, codes = _TotalsStruct(least=-np.inf), np.empty(layout.width), np.empty(warm.index.size, np.int8)
        x, l, index = (np.ascontiguousarray(part) for part in (state, warm.l, warm.index))
        inputs = x[layout.inputs]
        self._steps[:] = t, h
        at = self._steps.ctypes.data
        self._set_state(self._solver, 0, h, x.ctypes.data, l.ctypes.data, index.ctypes.data)
        done = self._rollout(
            self._solver, 0, 1, 1, 1, CALL_SECONDS, at, at + self._steps.itemsize, inputs.ctypes.data,
            row.ctypes.data, codes.ctypes.data, ctypes.byref(totals),
        )  # fmt: skip
        if not done:
            return None
        return StepResult(
            row, WarmStart(row[layout.l], codes), SOLVER_NAMES[next(i for i, count in enumerate(totals.counts) if count)]
        )


class SingleStepper:
    """One step a call, with memory that is kept from call to call."""

    def __init__(self, single: Any, solver: int, h: float, layout: RowLayout, m: int) -> None:
        self._single, self._solver, self._h, self._m = single, solver, h, m
        n = layout.state.stop
        values, self._index = np.empty(n + m + layout.width), np.empty(2 * m, np.int8)
        self._state, self._l, self._row = values[:n], values[n : n + m], values[n + m :]
        self._before = self._index[:m]
        self._at = values.ctypes.data, self._index.ctypes.data

    def __call__(
        self, k: int, state: np.ndarray, l: np.ndarray, index: np.ndarray, at: slice = NO_ENTRIES, u: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray, int] | None:
        """The packed row, the index set, the same object as long as it holds, and the solver; None where it is not certified.

        ``u`` takes the place of what the state has ``at`` some places.
        """
        self._state[:], self._l[:], self._before[:] = state, l, index
        self._state[at] = u
        done = self._single(self._solver, k, self._h, *self._at)
        if not done:
            return None
        return self._row.copy(), index if done & 1 == 0 else self._index[self._m :].copy(), (done - 1) >> 1


def _optional_function(library: Library, name: str, *kinds: Any) -> Any:
    """A function of a library, or None where its model has no use for it."""
    try:
        return library.function(name, *kinds)
    except CodegenError:
        return None


def load_step_library(
    model: Model, grid: TimeGrid, tolerance: float, *, for_all: bool = False, in_lanes: bool = False
) -> tuple[Library, str]:
    """The steps of a model on a grid, and by what they are compiled; see `cached_steps`.

    Raises:
        CodegenError: the model has no such code; there is no compiler, or it fails.
    """
    name = required_compiler()
    path = cached_steps(model, grid, tolerance, name, for_all=for_all, in_lanes=in_lanes)
    way = f"compiled by {name}, {ALL_VALUES_SUFFIX}" if for_all else f"compiled by {name}"
    return _loaded_step_libraries(model).library(path), way


class _LibraryPool(dict[Path, Library]):
    """Libraries by their paths, which name their content; the MAX_LOADED used last, of all models, are held on to."""

    recent: ClassVar[OrderedDict[tuple[int, Path], weakref.ref[_LibraryPool]]] = OrderedDict()
    lock: ClassVar[threading.RLock] = threading.RLock()

    def library(self, path: Path) -> Library:
        """The library of a path; what has not been used for long is unloaded, once no run has it."""
        with self.lock:
            found = self[path] = self.get(path) or Library(path, {"name": STEP_NAME})
            self.recent.pop((id(self), path), None)
            self.recent[id(self), path] = weakref.ref(self)
            while len(self.recent) > MAX_LOADED:
                (_, old), owner = self.recent.popitem(last=False)
                if (libraries := owner()) is not None:
                    libraries.pop(old, None)
        return found


@cached_per_object
def _loaded_step_libraries(model: Model) -> _LibraryPool:
    """The libraries that runs of the model have loaded: they go with the model."""
    return _LibraryPool()


def _make_step_block(done: int, totals: Any, state: np.ndarray, warm: WarmStart) -> StepBlock:
    return StepBlock(
        done, totals.status != 0, state, warm, totals.worst, int(totals.worst_step), totals.newton, totals.newton_max,
        int(totals.changes), totals.least, {SOLVER_NAMES[i]: int(count) for i, count in enumerate(totals.counts) if count},
    )  # fmt: skip
