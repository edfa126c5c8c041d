"""A study as a page: seconds over errors, and all points as a table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from nsmodel.plot.html.page import standalone_page, write_page
from nsmodel.study.lines import POINT_LEFT_OUT, Line, Point
from nsmodel.study.result import cost_text

if TYPE_CHECKING:
    from nsmodel.study.result import Study

STUDY_SCRIPTS = ("elements", "axes", "plane", "study")
AXES = ("largest relative error", "CPU time of the steps [s]")
LEGEND = (
    "Cheap and accurate is low and to the left. Dashed: other programs; dotted: one solver alone; pale marks: nearer to the "
    "reference than it is known. Failed runs have no mark: they stand in the table."
)
TABLE_HEADER = ("method", "run", "status", "largest error", "seconds", "set-up", "steps", "residual")


def write_study_page(study: Study, path: str | Path | None = None) -> Path:
    """Write the page of a study, and return its path; see `Study.view`."""
    return write_page(standalone_page(study.title, study_document(study), STUDY_SCRIPTS), path, study.title)


def study_document(study: Study) -> dict[str, Any]:
    """All that the page shows of a study, as plain data."""
    unit = f" {study.time_unit}" if study.time_unit else ""
    facts = {
        "model": [f"{study.model_class}, {study.states} states, until t = {study.t_end:g}{unit}"],
        "reference": [] if study.reference is None else [study.reference.text],
        "target": [] if study.target is None else [cost_text(study, study.target)],
        "status": [f"{study.status}, {study.seconds:.3g} s in all"],
        "no point": ["; ".join(line.name for line in study.lines if not _has_points(line))],
        "notes": study.notes,
    }
    return {
        "kind": "study",
        "title": study.title,
        "heading": "Error against run time",
        "axes": AXES,
        "legend": LEGEND,
        "facts": [[label, list(lines)] for label, lines in facts.items() if any(lines)],
        "lines": [
            {
                "name": line.name,
                "kind": line.kind,
                "aside": line.missing_text,
                "points": [_point_data(point) for point in line.points],
            }
            for line in study.lines
            if _has_points(line)
        ],
        "head": TABLE_HEADER,
        "rows": [_table_row(line, point) for line in study.lines for point in line.points if point.status != POINT_LEFT_OUT],
        "text": study.text(),
    }


def _has_points(line: Line) -> bool:
    return any(point.drawn for point in line.points)


def _point_data(point: Point) -> dict[str, Any]:
    if not point.drawn:
        return {"drawn": False}
    texts = [point.label, f"error {point.error:.3g}", f"{point.seconds:.3g} s"]
    return {"drawn": True, "error": point.error, "seconds": point.seconds, "resolved": point.resolved, "words": texts}


def _table_row(line: Line, point: Point) -> list[str]:
    known = [point.errors.get("max"), point.seconds, point.setup, point.steps, point.residual]
    numbers = ["" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value) for value in known]
    status = f"{point.status}: {point.message}" if point.message else point.status
    return [line.name, point.label, status, *numbers]
