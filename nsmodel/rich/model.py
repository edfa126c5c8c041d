"""A model: its equations, sizes, parameters with their units, inputs, blocks and law."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nsmodel._utils import join_within_width, truncate_text
from nsmodel.hypotheses.equations import model_equations
from nsmodel.modeling.description import model_facts
from nsmodel.rich import page

if TYPE_CHECKING:
    from nsmodel.modeling.base import Model

MAX_ROW_TEXT = 320  # Characters of a row.
MAX_FORMULA_LENGTH = 2500  # Characters of LaTeX in one formula.


def html(model: Model) -> str:
    """The model as HTML."""
    rows = []
    for label, entries in model_facts(model).items():
        count = f"{len(entries)}: " if len(entries) > 1 else ""
        rows.append(
            (label, page.escape_text(count + join_within_width(map(truncate_text, entries), MAX_ROW_TEXT), MAX_ROW_TEXT + 20))
        )
    formulas = [
        page.formula(line) if len(line) < MAX_FORMULA_LENGTH else page.aside_paragraph("a formula too long to be read")
        for line in model_equations(model)
    ]
    return page.result_page(model.title or "untitled", type(model).__name__, *formulas, page.facts_table(rows))
