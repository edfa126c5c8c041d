"""A model that was pushed: a table of what came of each cell, why some stopped, what is wrong."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nsmodel.rich import page
from nsmodel.study.stress_result import STOPPED, WRONG

if TYPE_CHECKING:
    from nsmodel.study.stress_result import Cell, Stress

STRESS_ROWS = 24  # More are folded.


def html(stress: Stress) -> str:
    """The result as HTML."""
    counts = page.verdict_counts({verdict: stress.count(verdict) for verdict in stress.verdicts})
    unit = f" {stress.time_unit}" if stress.time_unit else ""
    verdicts = {(cell.row, cell.factor): cell.verdict for cell in stress.cells}
    factors = stress.factors
    rows = [[row, *(_verdict_cell(verdicts.get((row, factor))) for factor in factors)] for row in stress.rows]
    header = ["", *(f"{factor:g}" for factor in factors)]
    facts = page.facts_table([("cells", counts), ("columns", f"step, in units of {stress.step:g}{unit}")])
    parts = [facts, page.first_rows_table(rows, STRESS_ROWS, "rows", header)]
    for word, what in ((WRONG, "misfit"), (STOPPED, "why")):
        cells = [cell for cell in stress.cells if cell.verdict == word]
        if cells:
            cell_table = page.html_table(("where", what), [_cell_row(cell) for cell in cells])
            parts.append(page.folded_section(f"{len(cells)} {word}", cell_table) if word == STOPPED else cell_table)
    return page.result_page(stress.title, f"stress of a {stress.model_class}", *parts)


def _verdict_cell(verdict: str | None) -> str:
    return "" if verdict is None else page.status_badge(verdict)


def _cell_row(cell: Cell) -> list[str]:
    name, ratio = cell.worst
    what = f"{name}: {ratio:.3g} times what is allowed" if cell.verdict == WRONG else cell.message
    return [f"{cell.row}, step x {cell.factor:g}", what]
