"""A model: its equations, sizes, parameters with their units, inputs, blocks and law."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nsmodel.brief import cut, listed
from nsmodel.hypotheses.report.typeset import equations
from nsmodel.model.facts import facts
from nsmodel.rich import page

if TYPE_CHECKING:
    from nsmodel.model.base import Model

ENTRIES = 320  # Characters of a row.
LONG = 2500  # Characters of LaTeX in one formula.


def html(model: Model) -> str:
    """The model as HTML."""
    rows = []
    for label, entries in facts(model).items():
        count = f"{len(entries)}: " if len(entries) > 1 else ""
        rows.append((label, page.escaped(count + listed(map(cut, entries), ENTRIES), ENTRIES + 20)))
    shown = [page.formula(line) if len(line) < LONG else page.aside("a formula too long to be read") for line in equations(model)]
    return page.page(model.title or "untitled", type(model).__name__, *shown, page.facts(rows))
