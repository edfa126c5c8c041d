"""The contract of a step, shared by simulation, studies and generated code.

    step(t, h, state, warm, k) -> StepResult

is a pure function of its arguments: the same arguments give the same bits, whatever was called before. It raises StepError,
and changes nothing, when no solver reaches the tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from nsmodel.solve.layout import Layout


@dataclass(frozen=True)
class Warm:
    """Where the next step starts to look: the last multiplier l (m,) and its index set (m,) int8."""

    l: np.ndarray
    index: np.ndarray


class StepResult(NamedTuple):
    """One verified step.

    Attributes:
        row: the packed row (see `layout`): state, l, y, residual, ...
        warm: for the next step.
        solver: name of the solver whose answer was accepted.
    """

    row: np.ndarray
    warm: Warm
    solver: str


class Step(Protocol):
    """What every stepper is."""

    layout: Layout
    rows: tuple[str, ...]

    def __call__(self, t: float, h: float, state: np.ndarray, warm: Warm, k: int = 0) -> StepResult:
        """Advance ``state`` from t to t + h; ``k`` is the number of the step, for tolerances that are a sequence."""
        ...

    def cold(self) -> Warm:
        """Return the warm start of a first step."""
        ...
