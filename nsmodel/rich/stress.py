"""A model that was pushed: a table of what came of each cell, why some stopped, what is wrong."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nsmodel.rich import page
from nsmodel.stress.result import STOPPED, WRONG

if TYPE_CHECKING:
    from nsmodel.stress.result import Cell, Stress

ROWS = 24  # More are folded.


def html(stress: Stress) -> str:
    """The result as HTML."""
    counts = page.counted({verdict: stress.count(verdict) for verdict in stress.verdicts})
    unit = f" {stress.time_unit}" if stress.time_unit else ""
    verdicts = {(cell.row, cell.factor): cell.verdict for cell in stress.cells}
    factors = stress.factors
    rows = [[row, *(_mark(verdicts.get((row, factor))) for factor in factors)] for row in stress.rows]
    header = ["", *(f"{factor:g}" for factor in factors)]
    facts = page.facts([("cells", counts), ("columns", f"step, in units of {stress.step:g}{unit}")])
    parts = [facts, page.first(rows, ROWS, "rows", header)]
    for word, what in ((WRONG, "misfit"), (STOPPED, "why")):
        cells = [cell for cell in stress.cells if cell.verdict == word]
        if cells:
            told = page.table(("where", what), [_told(cell) for cell in cells])
            parts.append(page.folded(f"{len(cells)} {word}", told) if word == STOPPED else told)
    return page.page(stress.title, f"stress of a {stress.model_class}", *parts)


def _mark(verdict: str | None) -> str:
    return "" if verdict is None else page.status(verdict)


def _told(cell: Cell) -> list[str]:
    name, ratio = cell.worst
    what = f"{name}: {ratio:.3g} times what is allowed" if cell.verdict == WRONG else cell.message
    return [f"{cell.row}, step x {cell.factor:g}", what]
