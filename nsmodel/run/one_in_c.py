"""Steps in C, taken one at a time."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.errors import CodegenError, UsageError
from nsmodel.grid import SAME_STEP_TOLERANCE, TimeGrid
from nsmodel.model.base import Model
from nsmodel.run.driven import StateInitialiser
from nsmodel.run.options import Options
from nsmodel.solve.layout import RowLayout
from nsmodel.solve.stepper import StepResult, WarmStart

if TYPE_CHECKING:
    from nsmodel.codegen.rollout import SingleStepper


class CompiledSteps:
    """The steps in C where they are wanted and there: those of length h by a library for h alone, others by one for any."""

    def __init__(self, model: Model, h: float, options: Options) -> None:
        self._model, self._h, self._tolerance = model, h, options.tolerance
        self._wanted = options.compiled is True or (options.compiled == "auto" and options.solver == "auto")
        if options.compiled is True and self._library_for_h is None:
            raise UsageError(f"compiled=True: {self._why}")

    def _load_library(self, grid: TimeGrid) -> Any:
        from nsmodel.codegen.rollout import Rollout

        try:
            return Rollout(self._model, grid, self._tolerance) if self._wanted else None
        except CodegenError as error:
            self._why = str(error)
            return None

    @cached_property
    def _library_for_h(self) -> Any:
        return self._load_library(TimeGrid(1, self._h, self._h))

    @cached_property
    def _library_for_any_step(self) -> Any:
        h = self._h
        return self._load_library(TimeGrid(1, h, h, np.array([h]), np.array([0.0, h]), any_step=True))

    def alone(self, layout: RowLayout, m: int) -> SingleStepper | None:
        """What takes steps of length h in C; None where there is none."""
        return None if self._library_for_h is None else self._library_for_h.alone(layout, m)

    def starter(self, otherwise: StateInitialiser) -> StateInitialiser:
        """What finds the reaction that a state carries anew."""
        return otherwise if self._library_for_h is None else self._library_for_h.starter(otherwise)

    def step(self, k: int, t: float, h: float, state: np.ndarray, warm: WarmStart, layout: RowLayout) -> StepResult | None:
        """One step; None where it is not certified, or there is no C."""
        if h == self._h and t == k * h:
            return None if self._library_for_h is None else self._library_for_h.one(k, state, warm, layout)
        library = self._library_for_h if abs(h - self._h) <= SAME_STEP_TOLERANCE * self._h else self._library_for_any_step
        return None if library is None else library.step(t, h, state, warm, layout)
