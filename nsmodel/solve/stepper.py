"""The contract of a step, shared by simulation, studies and generated code.

    step(t, h, state, warm, k) -> result

is a pure function of its arguments: the same arguments give the same bits, whatever was called before. It raises StepError,
and changes nothing, when no solver reaches the tolerance. What a state and a warm start are is the stepper's own: of a scheme's
problem the column that is carried and `WarmStart`, of many bodies (`many_bodies`) positions and the contacts that acted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from nsmodel.brief import short_repr
from nsmodel.solve.layout import RowLayout


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

    def cold_start(self) -> WarmStart:
        """Return the warm start of a first step."""
        ...
