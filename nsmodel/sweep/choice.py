"""Which way cells are run: many at once in C, or each alone, and why."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from nsmodel.classes.registry import class_of
from nsmodel.later import former_names
from nsmodel.run.options import METHODS
from nsmodel.scheme import one_step_problem
from nsmodel.solve.cost import build_seconds, interpreted_step_seconds
from nsmodel.solve.structure import read_step_structure
from nsmodel.sweep.asked import ALONE_BACKEND, BATCH_BACKEND, PIECES_BACKEND, SweepRequest
from nsmodel.sweep.cells import CellGroup, open_group
from nsmodel.sweep.outputs import Reduction

RUN_SETUP_SECONDS = 5e-3  # Seconds that a run takes beside its steps.
PIECES_BUILD_SECONDS, PIECE_SECONDS, PIECES_PER_RUN = (
    1.5,
    1e-3,
    20,
)  # Seconds for building event-driven runs; for a piece without; guessed.


class BackendChoice(NamedTuple):
    """What is asked, with the way; how the cells are run, for settings and in words."""

    request: SweepRequest
    way: str
    description: str


def choose_backend(
    request: SweepRequest, group: CellGroup, cells: int, models: int, resumed_backend: str | None = None
) -> BackendChoice:
    """Decide for all cells, by what the first group is; the same wherever it is asked.

    ``there``: the way of the sweep that is gone on with, which goes on as it began, unless ``compiled`` says otherwise.
    """
    goes_on = request.options["compiled"] == "auto" and resumed_backend is not None
    why = _reason_to_run_alone(request, group, cells / models, costs=not goes_on or resumed_backend == ALONE_BACKEND)
    if goes_on and resumed_backend == ALONE_BACKEND:
        why = why or "as it began"
    together = PIECES_BACKEND if request.is_event_driven else BATCH_BACKEND
    if why is None:
        own = open_group(replace(request, way=together), group.packed())
        if own.batch is None:
            why = own.why
        else:
            unknown = [name for name in _read_columns(request) if name not in own.batch.columns()]
            if not unknown:
                each = ", for each model" if models > 1 else ""
                return BackendChoice(replace(request, way=together), own.batch.way, f"{own.batch.way}{each}")
            why = f"'{unknown[0]}' is a column of whole runs"
    return BackendChoice(replace(request, way=ALONE_BACKEND), ALONE_BACKEND, f"each cell by simulate: {why}")


def _read_columns(request: SweepRequest) -> list[str]:
    """The columns that are read."""
    return [*request.keep, *(one.name for one in request.outputs.values() if isinstance(one, Reduction))]


def _reason_to_run_alone(request: SweepRequest, group: CellGroup, cells: float, *, costs: bool) -> str | None:
    """Why cells are not run together; None where they are, if there is a library."""
    options = request.options
    if options["compiled"] is False:
        return "compiled=False"
    if options["solver"] != "auto":
        return f"the solver {options['solver']} is asked for"
    if not group.names:
        return "no parameter varies within a model"
    if class_of(group.model).optional("walk") is not None:
        return "many bodies"
    whole = [name for name, one in request.outputs.items() if not (isinstance(one, Reduction) and one.needs_rows_alone)]
    if whole:
        return f"the output '{whole[0]}' is of a whole run"
    if request.is_event_driven and options["method"] == METHODS[2]:
        return "the steps of each are chosen by error control"
    if options["compiled"] is True or not costs:
        return None
    took, build = _estimate_seconds(request, group)
    return None if cells * took > build else "they take less time than building a library"


def _estimate_seconds(request: SweepRequest, group: CellGroup) -> tuple[float, float]:
    """About how long a run takes alone, and a library."""
    if request.is_event_driven:
        return RUN_SETUP_SECONDS + PIECE_SECONDS * PIECES_PER_RUN, PIECES_BUILD_SECONDS
    problem = one_step_problem(group.model)
    structure = read_step_structure(problem) if problem.prediction is None else None
    path = "kernel" if structure is not None and structure.constant and structure.affine else "newton"
    return RUN_SETUP_SECONDS + request.grid(group.model, group.step).N * interpreted_step_seconds(path, structure), build_seconds(
        "newton", structure, problem
    )


__getattr__ = former_names(__name__, Choice="BackendChoice")
