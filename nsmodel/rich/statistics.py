"""Statistics of a sweep, and shares: the table that they print."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nsmodel.rich import page

if TYPE_CHECKING:
    from nsmodel.sweep.statistics import Share, Statistics


def html(found: Statistics | Share) -> str:
    """The table as HTML."""
    head, _, rest = found.text.partition("\n")
    return page.result_page(head, type(found).__name__.lower(), page.verbatim_text(rest))
