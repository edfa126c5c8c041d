"""The step of a problem whose matrices move with inputs that take few values: its matrices are kept for each of these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.scheme.problem import OneStepProblem
from nsmodel.solve.build import Stepper
from nsmodel.solve.diagnose import find_empty_law
from nsmodel.solve.stepper import StepResult, WarmStart
from nsmodel.solve.structure import read_step_structure

MAX_KEPT_MODES = 16  # Modes whose matrices are kept.


class ModewiseStepper:
    """A stepper for each mode, made where it is first met; what is asked of it but a step is that of the first.

    ``at``: where the state has the values that make a mode; ``names``: of the inputs.
    """

    def __init__(
        self, problem: OneStepProblem, at: Sequence[int], names: Sequence[str], solver: str, tolerance: float,
        *, h: float, state: np.ndarray, few_steps: bool = True,
    ) -> None:  # fmt: skip
        """As `Stepper`."""
        self.problem, self._at, self._how = problem, np.array(at), (solver, tolerance)
        self._options: dict[str, Any] = {"h": h, "few_steps": few_steps}
        self._steppers: dict[bytes, Stepper] = {}
        first = self._stepper_for(state)
        self.plan = replace(first.plan, used=(*first.plan.used, f"matrices are kept for each mode of {', '.join(names)}"))
        self.layout, self.rows, self.structure, self.tolerance = first.layout, first.rows, first.structure, tolerance
        self.repeats, self.cold_start, self.include_eigenvalue = first.repeats, first.cold_start, first.include_eigenvalue

    @property
    def least_eigenvalue(self) -> float:
        """The least of those met in all modes."""
        return min(stepper.least_eigenvalue for stepper in self._steppers.values())

    def __call__(self, t: float, h: float, state: np.ndarray, warm: WarmStart, k: int = 0) -> StepResult:
        """Take the step of the mode that the state is in."""
        try:
            return self._stepper_for(state)(t, h, state, warm, k)
        except np.linalg.LinAlgError as error:
            raise find_empty_law(self.problem, t, h, state) or error from None

    def _stepper_for(self, state: np.ndarray) -> Stepper:
        key = state[self._at].tobytes()
        if key not in self._steppers:
            if len(self._steppers) >= MAX_KEPT_MODES:
                self._steppers.clear()
            mode = substitute_mode(self.problem, self._at, state)
            self._steppers[key] = Stepper(mode, *self._how, state=state, **self._options)
        return self._steppers[key]


def substitute_mode(problem: OneStepProblem, at: Sequence[int] | np.ndarray, state: np.ndarray) -> OneStepProblem:
    """The problem with the numbers that a state has in some places; what a step passes on stays as it is."""
    symbols, values = problem.state[list(at)], ca.SX(state[list(at)].tolist())

    def substituted(part: ca.SX | None) -> Any:
        return None if part is None else ca.substitute(part, symbols, values)

    names = ("E", "Y", "guess", "multipliers", "outputs", "overreach")
    return replace(
        problem, **{name: substituted(getattr(problem, name)) for name in names},
        records={name: substituted(record) for name, record in problem.records.items()},
    )  # fmt: skip


def mode_state_indices(problem: OneStepProblem, few: Sequence[int | None], state: np.ndarray) -> list[int]:
    """Where the state has inputs of few values that the matrices move with; empty where these are not constant without them.

    ``few``: of each input how many values it takes, None: any.
    """
    nu, end = problem.inputs, problem.state.numel()
    if not nu or read_step_structure(problem).constant or not any(few):
        return []
    matrices = ca.veccat(*problem.jacobians)
    found, modes = [], 1
    for i, count in enumerate(few):
        places = [place for place in (end - 2 * nu + i, end - nu + i) if ca.depends_on(matrices, problem.state[place])]
        if places and count is not None:
            found += places
            modes *= count
    return (
        found
        if found and modes <= MAX_KEPT_MODES and read_step_structure(substitute_mode(problem, found, state)).constant
        else []
    )
