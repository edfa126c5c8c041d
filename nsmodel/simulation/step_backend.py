"""Whether a run's steps are taken in C: where that is asked for, or pays, or the run that is resumed had them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

from nsmodel.errors import CodegenError, StorageError
from nsmodel.modeling.fingerprint import ALL_VALUES_SUFFIX, INTERPRETED_BACKEND
from nsmodel.simulation.options import Options
from nsmodel.solvers.plan import CompilationCost, Plan

STEPS_IN_C = "steps in C, compiled for this model; a step that C cannot certify is taken as above"
STEPS_IN_C_FOR_ALL = "steps in C, compiled once for all values of the parameters; a step that C cannot certify is taken as above"


class StepBackend(NamedTuple):
    """The steps in C, None where they are interpreted; the plan, and a warning, that say so."""

    steps: Any
    plan: Plan
    warnings: list[str]

    @property
    def way(self) -> str:
        """How the run is stepped, a setting of it."""
        return INTERPRETED_BACKEND if self.steps is None else self.steps.way


def choose_step_backend(
    options: Options, plan: Plan, resumed_backend: str | None, N: int, cost: Callable[[], CompilationCost],
    build: Callable[[], Any], description: str = STEPS_IN_C, what: str = "steps",
) -> StepBackend:  # fmt: skip
    """Decide.

    Args:
        options: of the run.
        plan: of its interpreted steps.
        there: how the run that is resumed was stepped; None for a new one.
        N: number of its steps.
        cost: what an interpreted step takes, and building the compiled one.
        build: compiles the steps; CodegenError where that cannot be.
        words, what: of the plan, and what is called a step there.
    """
    wanted = options.compiled is True
    if options.compiled == "auto":
        pays = options.solver == "auto" and cost().pays(N)
        wanted = pays if resumed_backend is None else resumed_backend != INTERPRETED_BACKEND
        if options.solver == "auto" and not (pays or wanted):
            plan = replace(plan, left_out=(*plan.left_out, cost().text(N, what)))
    if not wanted:
        return StepBackend(None, plan, [])
    try:
        steps = build()
    except CodegenError as error:
        if resumed_backend not in (None, INTERPRETED_BACKEND):
            raise StorageError(
                f"{options.folder}: the run there is {resumed_backend}, which it cannot be here: {error}"
            ) from error
        plan = replace(plan, left_out=(*plan.left_out, f"{what} in C: {error}"))
        requested = options.compiled is True
        return StepBackend(None, plan, [f"not compiled, the {what} are interpreted: {error}"] if requested else [])
    description = STEPS_IN_C_FOR_ALL if steps.way.endswith(ALL_VALUES_SUFFIX) else description
    return StepBackend(steps, replace(plan, used=(*plan.used, description)), [])
