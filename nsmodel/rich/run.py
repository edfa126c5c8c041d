"""A run: how it ended, its summary, a small picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nsmodel import summary
from nsmodel.plot.figures import small
from nsmodel.rich import page

if TYPE_CHECKING:
    from nsmodel.trajectory import Trajectory

DPI = 90
WARNINGS = 4  # More are folded.


def html(run: Trajectory) -> str:
    """The run as HTML."""
    from nsmodel.plot.shown import light_png

    lines = summary.lines(run.summary())
    (ended,), warnings = lines.pop("status", [run.status]), lines.pop("warnings", [])
    word, _, why = ended.partition(": ") if ended.startswith(run.status) else (run.status, "", ended)
    warned = f"{len(warnings)} warning{'s' if len(warnings) > 1 else ''}" if warnings else ""
    told = page.joined([page.status(word, "warned" if word == "done" and warnings else word), why or warned], " ")
    rows = [("status", told), *lines.items(), ("warnings", warnings[:WARNINGS])]
    more = page.folded(f"{len(warnings) - WARNINGS} more warnings", page.facts([("", warnings[WARNINGS:])]))
    drawn = page.picture(lambda: light_png(small(run), DPI), f"states of {run.title} over time")
    return page.page(run.title, f"run, {len(run)} steps", page.facts(rows), more if warnings[WARNINGS:] else "", drawn)
