"""Steps in C, taken one at a time."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.errors import CodegenError, UsageError
from nsmodel.grid import SAME, Grid
from nsmodel.model.base import Model
from nsmodel.run.driven import Starter
from nsmodel.run.options import Options
from nsmodel.solve.layout import Layout
from nsmodel.solve.stepper import StepResult, Warm

if TYPE_CHECKING:
    from nsmodel.codegen.rollout import Alone


class InC:
    """The steps in C where they are wanted and there: those of length h by a library for h alone, others by one for any."""

    def __init__(self, model: Model, h: float, options: Options) -> None:
        self._model, self._h, self._tolerance = model, h, options.tolerance
        self._wanted = options.compiled is True or (options.compiled == "auto" and options.solver == "auto")
        if options.compiled is True and self._own is None:
            raise UsageError(f"compiled=True: {self._why}")

    def _load(self, grid: Grid) -> Any:
        from nsmodel.codegen.rollout import Rollout

        try:
            return Rollout(self._model, grid, self._tolerance) if self._wanted else None
        except CodegenError as error:
            self._why = str(error)
            return None

    @cached_property
    def _own(self) -> Any:
        return self._load(Grid(1, self._h, self._h))

    @cached_property
    def _any(self) -> Any:
        h = self._h
        return self._load(Grid(1, h, h, np.array([h]), np.array([0.0, h]), any_step=True))

    def alone(self, layout: Layout, m: int) -> Alone | None:
        """What takes steps of length h in C; None where there is none."""
        return None if self._own is None else self._own.alone(layout, m)

    def starter(self, otherwise: Starter) -> Starter:
        """What finds the reaction that a state carries anew."""
        return otherwise if self._own is None else self._own.starter(otherwise)

    def step(self, k: int, t: float, h: float, state: np.ndarray, warm: Warm, layout: Layout) -> StepResult | None:
        """One step; None where it is not certified, or there is no C."""
        if h == self._h and t == k * h:
            return None if self._own is None else self._own.one(k, state, warm, layout)
        library = self._own if abs(h - self._h) <= SAME * self._h else self._any
        return None if library is None else library.step(t, h, state, warm, layout)
