"""Which way cells are run: many at once in C, or each alone, and why."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from nsmodel.classes.registry import class_of
from nsmodel.run.options import METHODS
from nsmodel.scheme import one_step_problem
from nsmodel.solve.cost import building, interpreted
from nsmodel.solve.structure import read
from nsmodel.sweep.asked import ALONE, BATCH, PIECES, Asked
from nsmodel.sweep.cells import Group, opened
from nsmodel.sweep.outputs import Reduction

SET_UP = 5e-3  # Seconds that a run takes beside its steps.
BUILDING_PIECES, A_PIECE, PIECES_OF_A_RUN = 1.5, 1e-3, 20  # Seconds for building event-driven runs; for a piece without; guessed.


class Choice(NamedTuple):
    """What is asked, with the way; how the cells are run, for settings and in words."""

    asked: Asked
    way: str
    words: str


def choose(asked: Asked, group: Group, cells: int, models: int, there: str | None = None) -> Choice:
    """Decide for all cells, by what the first group is; the same wherever it is asked.

    ``there``: the way of the sweep that is gone on with, which goes on as it began, unless ``compiled`` says otherwise.
    """
    goes_on = asked.options["compiled"] == "auto" and there is not None
    why = _alone_because(asked, group, cells / models, costs=not goes_on or there == ALONE)
    if goes_on and there == ALONE:
        why = why or "as it began"
    together = PIECES if asked.event_driven else BATCH
    if why is None:
        own = opened(replace(asked, way=together), group.packed())
        if own.batch is None:
            why = own.why
        else:
            unknown = [name for name in _names(asked) if name not in own.batch.columns()]
            if not unknown:
                each = ", for each model" if models > 1 else ""
                return Choice(replace(asked, way=together), own.batch.way, f"{own.batch.way}{each}")
            why = f"'{unknown[0]}' is a column of whole runs"
    return Choice(replace(asked, way=ALONE), ALONE, f"each cell by simulate: {why}")


def _names(asked: Asked) -> list[str]:
    """The columns that are read."""
    return [*asked.keep, *(one.name for one in asked.outputs.values() if isinstance(one, Reduction))]


def _alone_because(asked: Asked, group: Group, cells: float, *, costs: bool) -> str | None:
    """Why cells are not run together; None where they are, if there is a library."""
    options = asked.options
    if options["compiled"] is False:
        return "compiled=False"
    if options["solver"] != "auto":
        return f"the solver {options['solver']} is asked for"
    if not group.names:
        return "no parameter varies within a model"
    if class_of(group.model).optional("walk") is not None:
        return "many bodies"
    whole = [name for name, one in asked.outputs.items() if not (isinstance(one, Reduction) and one.needs_rows_alone)]
    if whole:
        return f"the output '{whole[0]}' is of a whole run"
    if asked.event_driven and options["method"] == METHODS[2]:
        return "the steps of each are chosen by error control"
    if options["compiled"] is True or not costs:
        return None
    took, build = _seconds(asked, group)
    return None if cells * took > build else "they take less time than building a library"


def _seconds(asked: Asked, group: Group) -> tuple[float, float]:
    """About how long a run takes alone, and a library."""
    if asked.event_driven:
        return SET_UP + A_PIECE * PIECES_OF_A_RUN, BUILDING_PIECES
    problem = one_step_problem(group.model)
    structure = read(problem) if problem.prediction is None else None
    path = "kernel" if structure is not None and structure.constant and structure.affine else "newton"
    return SET_UP + asked.grid(group.model, group.step).N * interpreted(path, structure), building("newton", structure, problem)
