"""Whether a run's steps are taken in C: where that is asked for, or pays, or the run that is resumed had them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

from nsmodel.errors import CodegenError, StorageError
from nsmodel.identity import FOR_ALL, INTERPRETED
from nsmodel.run.options import Options
from nsmodel.solve.choose import Plan
from nsmodel.solve.cost import Cost

IN_C = "steps in C, compiled for this model; a step that C cannot certify is taken as above"
IN_C_FOR_ALL = "steps in C, compiled once for all values of the parameters; a step that C cannot certify is taken as above"


class Chosen(NamedTuple):
    """The steps in C, None where they are interpreted; the plan, and a warning, that say so."""

    steps: Any
    plan: Plan
    warnings: list[str]

    @property
    def way(self) -> str:
        """How the run is stepped, a setting of it."""
        return INTERPRETED if self.steps is None else self.steps.way


def chosen(
    options: Options, plan: Plan, there: str | None, N: int, cost: Callable[[], Cost], build: Callable[[], Any],
    words: str = IN_C, what: str = "steps",
) -> Chosen:  # fmt: skip
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
        wanted = pays if there is None else there != INTERPRETED
        if options.solver == "auto" and not (pays or wanted):
            plan = replace(plan, left_out=(*plan.left_out, cost().text(N, what)))
    if not wanted:
        return Chosen(None, plan, [])
    try:
        steps = build()
    except CodegenError as error:
        if there not in (None, INTERPRETED):
            raise StorageError(f"{options.folder}: the run there is {there}, which it cannot be here: {error}") from error
        plan = replace(plan, left_out=(*plan.left_out, f"{what} in C: {error}"))
        asked = options.compiled is True
        return Chosen(None, plan, [f"not compiled, the {what} are interpreted: {error}"] if asked else [])
    words = IN_C_FOR_ALL if steps.way.endswith(FOR_ALL) else words
    return Chosen(steps, replace(plan, used=(*plan.used, words)), [])
