"""A study: what errors are measured against, a row a method, the figure of errors and times."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nsmodel.rich import page
from nsmodel.study.lines import POINT_DONE, SOLVER_LINE
from nsmodel.study.text import cost_text, short_number

if TYPE_CHECKING:
    from nsmodel.study.lines import Line
    from nsmodel.study.result import Study

STUDY_HEADER = ("method", "points done", "order", "largest errors", "seconds")
STUDY_ROWS = 12  # More are folded.
STUDY_DPI = 75


def html(study: Study) -> str:
    """The study as HTML."""
    from nsmodel.plot.shown import light_png

    reference = None if study.reference is None else study.reference.text
    rows = [
        ("status", page.status_badge(study.status)),
        ("reference", reference or ""),
        ("target", cost_text(study, study.target) if study.target is not None else ""),
        ("notes", list(study.notes)),
    ]
    lines = [_method_row(line) for line in study.lines if line.kind != SOLVER_LINE]
    alone = [_method_row(line) for line in study.lines if line.kind == SOLVER_LINE]
    parts = [page.facts_table(rows), page.first_rows_table(lines, STUDY_ROWS, "methods", STUDY_HEADER)]
    if alone:
        parts.append(page.folded_section(f"{len(alone)} solvers alone", page.html_table(STUDY_HEADER, alone)))
    drawn = page.picture(lambda: light_png(study.plot(), STUDY_DPI), f"error against run time of {study.title}")
    return page.result_page(study.title, f"study of a {study.model_class}", *parts, drawn)


def _method_row(line: Line) -> list[str]:
    """A method: how many points, its order, the largest and least error and what they cost."""
    done = [point for point in line.points if point.status == POINT_DONE and point.error == point.error]
    gone = len(line.points) - sum(point.status == POINT_DONE for point in line.points)
    fit = line.order().fit if any(point.step for point in done) else None
    errors, seconds = [point.error for point in done], [point.seconds for point in done if point.seconds]
    counted = f"{len(line.points) - gone} of {len(line.points)}" if gone else f"{len(line.points)}"
    return [line.name, counted, "" if fit is None else f"{fit:.2f}", _range_text(errors), _range_text(seconds)]


def _range_text(values: list[float]) -> str:
    if not values:
        return ""
    low, high = short_number(min(values)), short_number(max(values))
    return low if low == high else f"{low} to {high}"
