"""The contract of a step, shared by simulation, studies and generated code.

    step(t, h, state, warm, k) -> result

is a pure function of its arguments: the same arguments give the same bits, whatever was called before. It raises StepError,
and changes nothing, when no solver reaches the tolerance. What a state and a warm start are is the stepper's own: of a scheme's
problem the column that is carried and `WarmStart`, of many bodies (`many_bodies`) positions and the contacts that acted.

One row of a trajectory as one vector: [state | l | y | residual | newton | multipliers | outputs | records].

The state ends with the inputs that the step was given: "inputs_begin", u at its begin, and "inputs", at its end.

The rows of a run that are in memory, and their columns by name.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, Self, TypeVar

import casadi as ca
import numpy as np

from nsmodel._utils import short_repr
from nsmodel.errors import StepError
from nsmodel.modeling.base import Model
from nsmodel.solvers.one_step_problem import OneStepProblem, derived_columns


@dataclass(frozen=True)
class RowLayout:
    """Where each quantity of a step stands in its packed row."""

    slices: dict[str, slice]
    width: int
    state: slice
    l: slice
    y: slice
    residual: int
    newton: int
    inputs: slice  # Of the state: those of the step at its begin, then at its end.

    @classmethod
    def of(cls, problem: OneStepProblem, **records: int) -> Self:
        """Lay out a problem's row; ``records`` (name: size) come after the problem's own."""
        m = problem.l.numel()
        sizes = {"state": problem.state.numel(), "l": m, "y": m, "residual": 1, "newton": 1}
        sizes |= {name: e.numel() for name, e in extra_columns(problem).items()} | records
        slices, at = {}, 0
        for name, size in sizes.items():
            slices[name] = slice(at, at + size)
            at += size
        end, nu = slices["state"].stop, problem.inputs
        if nu:
            slices |= {"inputs_begin": slice(end - 2 * nu, end - nu), "inputs": slice(end - nu, end)}
        return cls(
            slices, at, slices["state"], slices["l"], slices["y"], slices["residual"].start, slices["newton"].start,
            slice(end - 2 * nu, end),
        )  # fmt: skip


def extra_columns(problem: OneStepProblem) -> dict[str, ca.SX]:
    """The user's multipliers and outputs where they differ from l and y, and the records."""
    out = {} if problem.multipliers is None else {"multipliers": problem.multipliers}
    out |= {} if problem.outputs is None else {"outputs": problem.outputs}
    return out | problem.records


@dataclass(frozen=True)
class WarmStart:
    """Where the next step starts to look: the last multiplier l (m,) and its index set (m,) int8."""

    l: np.ndarray
    index: np.ndarray

    __repr__ = short_repr


class StepResult(NamedTuple):
    """One verified step.

    Attributes:
        row: the packed row (see `layout`): state, l, y, residual, ...
        warm: for the next step.
        solver: name of the solver whose answer was accepted.
    """

    row: np.ndarray
    warm: WarmStart
    solver: str

    __repr__ = short_repr


State = TypeVar("State", contravariant=True)
Start = TypeVar("Start", contravariant=True)
Result = TypeVar("Result", covariant=True)


class Step(Protocol[State, Start, Result]):
    """What every stepper is; its results have ``warm`` for the next step and the ``solver`` whose answer was accepted."""

    def __call__(self, t: float, h: float, state: State, warm: Start, k: int = 0) -> Result:
        """Advance ``state`` from t to t + h; ``k`` is the number of the step, for tolerances that are a sequence."""
        ...


class PackedStep(Step[np.ndarray, WarmStart, StepResult], Protocol):
    """What every stepper of a scheme's problem is: it gives packed rows."""

    layout: RowLayout
    rows: tuple[str, ...]
    plan: Any  # A `plan.Plan`.

    def cold_start(self) -> WarmStart:
        """Return the warm start of a first step."""
        ...


def is_numerical_error(error: Exception) -> bool:
    """Whether an exception speaks of numbers, and not of a fault in the program: of CasADi, LAPACK, SuperLU, Python's own."""
    return isinstance(error, ArithmeticError | np.linalg.LinAlgError) or type(error) is RuntimeError


def unsolvable_step_error(span: str, error: Exception) -> StepError:
    """The error of a step whose numbers a library refuses."""
    return StepError(f"{span}: its numbers cannot be computed with ({type(error).__name__}: {error})")


def verified_step(step: PackedStep, t: float, h: float, state: np.ndarray, warm: WarmStart, k: int = 0) -> StepResult:
    """Take a step; what a library says of its numbers is a StepError too."""
    try:
        return step(t, h, state, warm, k)
    except Exception as error:
        if not is_numerical_error(error):
            raise
        raise unsolvable_step_error(f"no verified step from t = {t:.10g} to {t + h:.10g}", error) from error


ROWS_PER_BLOCK = 4096  # Rows that are taken apart at a time: of 16 columns half a megabyte, which a cache holds.
RUNAWAY_LIMIT = 1e100  # A state beyond this has diverged: squares of it, and of what grows with it, soon overflow.
UNKNOWN_INDEX = -2  # Index-set code, else -1, 0 or 1, of a row that no step and no piece has computed.
INNER_COLUMNS = frozenset({"state", "l", "y", "residual", "newton", "multipliers", "outputs"})
VECTOR_COLUMNS = frozenset(
    "v gap defect selection inputs inputs_begin".split()
)  # Two-dimensional even where they have one column.


class RowRecord:
    """Packed rows (see `solvers.step`), index sets and times; ``capacity`` rows, then it is ``full`` and must be cleared."""

    def __init__(self, model: Model, layout: RowLayout, m: int, capacity: int) -> None:
        self.model, self.layout = model, layout
        self.rows, self.index = np.empty((capacity, layout.width)), np.empty((capacity, m), np.int8)
        self.t, self.h, self.h_next = (np.empty(capacity) for _ in range(3))
        self.number = np.empty(capacity, int)
        self.clear()

    def __copy__(self) -> Self:
        """Copy the rows, so that each of the two can grow."""
        other = object.__new__(type(self))
        vars(other).update((name, v.copy() if isinstance(v, np.ndarray) else v) for name, v in vars(self).items())
        return other

    def grow(self) -> None:
        """Make room for as many rows again."""
        for name in ("rows", "index", "t", "h", "h_next", "number"):
            array = getattr(self, name)
            setattr(self, name, np.concatenate([array, np.empty_like(array)]))
        self.full = False

    def clear(self) -> None:
        """Forget the rows."""
        self.filled, self.full = 0, False

    def known(self, k: int, t: float, h_next: float, state: np.ndarray, records: dict[str, np.ndarray]) -> None:
        """Add a row that no step computed: the start."""
        r = self.filled
        self.rows[r], self.index[r] = np.nan, UNKNOWN_INDEX
        self.rows[r, self.layout.newton] = 0.0
        self.rows[r, : state.size] = state
        for name, value in records.items():
            self.rows[r, self.layout.slices[name]] = value
        self._finish_row(k, t, np.nan, h_next)

    def add(self, k: int, t: float, h: float, h_next: float, row: np.ndarray, index: np.ndarray) -> None:
        """Add the row k that the step h has reached at t; ``h_next`` starts there."""
        self.rows[self.filled] = row
        self.index[self.filled] = index
        self._finish_row(k, t, h, h_next)

    def extend(self, numbers: np.ndarray, t: Any, h: Any, h_next: Any) -> None:
        """Take up the rows of these numbers, which were written into ``rows`` and ``index`` from ``filled`` on."""
        r = slice(self.filled, self.filled + numbers.size)
        self.number[r], self.t[r], self.h[r], self.h_next[r] = numbers, t, h, h_next
        self.filled = r.stop
        self.full = self.filled == len(self.t)

    def _finish_row(self, k: int, t: float, h: float, h_next: float) -> None:
        r = self.filled
        self.t[r], self.h[r], self.h_next[r], self.number[r] = t, h, h_next, k
        self.filled = r + 1
        self.full = self.filled == len(self.t)

    @property
    def states(self) -> np.ndarray:
        """The model's state in each row (rows, n)."""
        return self.rows[: self.filled, : len(self.model.names)]

    def column(self, name: str) -> np.ndarray:
        """One quantity of the layout in each row (rows, size)."""
        return self.rows[: self.filled, self.layout.slices[name]]

    def columns(self, newton: bool) -> dict[str, np.ndarray]:
        """The rows as the arrays of a trajectory, until ``clear``; ``newton``: with the iterations of each step."""
        r, slices = slice(0, self.filled), self.layout.slices
        own = {name: at for name, at in slices.items() if name not in INNER_COLUMNS}
        copied = self._copy_columns({
            "x": slice(0, len(self.model.names)),
            "multipliers": slices.get("multipliers", slices["l"]),
            "y": slices.get("outputs", slices["y"]),
            "residual": self.layout.residual,
            **({"newton": self.layout.newton} if newton else {}),
            **{name: at if name in VECTOR_COLUMNS or at.stop - at.start != 1 else at.start for name, at in own.items()},
        })  # fmt: skip
        arrays = {
            "t": self.t[r], "x": copied["x"], "multipliers": copied["multipliers"], "y": copied["y"],
            "index_set": self.index[r], "residual": copied["residual"], "step": self.h[r],
        } | copied  # fmt: skip
        return arrays | derived_columns(self.model, arrays, self.h_next[r])

    def _copy_columns(self, columns: dict[str, slice | int]) -> dict[str, np.ndarray]:
        """Columns of the packed rows, each in memory of its own; copied by blocks of rows that a processor's cache holds."""
        rows = self.rows[: self.filled]
        out = {name: np.empty_like(rows[:, at], order="C") for name, at in columns.items()}
        for start in range(0, self.filled, ROWS_PER_BLOCK):
            block = slice(start, start + ROWS_PER_BLOCK)
            for name, at in columns.items():
                out[name][block] = rows[block, at]
        return out
