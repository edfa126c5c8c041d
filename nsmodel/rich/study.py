"""A study: what errors are measured against, a row a method, the figure of errors and times."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nsmodel.rich import page
from nsmodel.study.lines import DONE, SOLVER
from nsmodel.study.text import number, price

if TYPE_CHECKING:
    from nsmodel.study.lines import Line
    from nsmodel.study.result import Study

HEADER = ("method", "points done", "order", "largest errors", "seconds")
LINES = 12  # More are folded.
DPI = 75


def html(study: Study) -> str:
    """The study as HTML."""
    from nsmodel.plot.shown import light_png

    reference = None if study.reference is None else study.reference.text
    rows = [
        ("status", page.status(study.status)),
        ("reference", reference or ""),
        ("target", price(study, study.target) if study.target is not None else ""),
        ("notes", list(study.notes)),
    ]
    lines = [_line(line) for line in study.lines if line.kind != SOLVER]
    alone = [_line(line) for line in study.lines if line.kind == SOLVER]
    parts = [page.facts(rows), page.first(lines, LINES, "methods", HEADER)]
    if alone:
        parts.append(page.folded(f"{len(alone)} solvers alone", page.table(HEADER, alone)))
    drawn = page.picture(lambda: light_png(study.plot(), DPI), f"error against run time of {study.title}")
    return page.page(study.title, f"study of a {study.model_class}", *parts, drawn)


def _line(line: Line) -> list[str]:
    """A method: how many points, its order, the largest and least error and what they cost."""
    done = [point for point in line.points if point.status == DONE and point.error == point.error]
    gone = len(line.points) - sum(point.status == DONE for point in line.points)
    fit = line.order().fit if any(point.step for point in done) else None
    errors, seconds = [point.error for point in done], [point.seconds for point in done if point.seconds]
    counted = f"{len(line.points) - gone} of {len(line.points)}" if gone else f"{len(line.points)}"
    return [line.name, counted, "" if fit is None else f"{fit:.2f}", _range(errors), _range(seconds)]


def _range(values: list[float]) -> str:
    if not values:
        return ""
    low, high = number(min(values)), number(max(values))
    return low if low == high else f"{low} to {high}"
