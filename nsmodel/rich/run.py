"""A run: how it ended, its summary, a small picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nsmodel.plot.figures import thumbnail
from nsmodel.rich import page
from nsmodel.simulation import summary

if TYPE_CHECKING:
    from nsmodel.simulation.trajectory import Trajectory

RUN_DPI = 90
WARNINGS = 4  # More are folded.


def html(run: Trajectory) -> str:
    """The run as HTML."""
    from nsmodel.plot.shown import light_png

    lines = summary.summary_lines(run.summary())
    (ended,), warnings = lines.pop("status", [run.status]), lines.pop("warnings", [])
    word, _, why = ended.partition(": ") if ended.startswith(run.status) else (run.status, "", ended)
    warned = f"{len(warnings)} warning{'s' if len(warnings) > 1 else ''}" if warnings else ""
    status_cell = page.join_html([page.status_badge(word, "warned" if word == "done" and warnings else word), why or warned], " ")
    rows = [("status", status_cell), *lines.items(), ("warnings", warnings[:WARNINGS])]
    more = page.folded_section(f"{len(warnings) - WARNINGS} more warnings", page.facts_table([("", warnings[WARNINGS:])]))
    drawn = page.picture(lambda: light_png(thumbnail(run), RUN_DPI), f"states of {run.title} over time")
    return page.result_page(
        run.title, f"run, {len(run)} steps", page.facts_table(rows), more if warnings[WARNINGS:] else "", drawn
    )
