"""The result of a study: lines, reference, the cost of a target; as text, JSON, CSV and a figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from nsmodel._utils import escape_invisible, html_repr, one_line, wrap_lines
from nsmodel.errors import UsageError
from nsmodel.files.storage import write_csv
from nsmodel.modeling.pickling import Picklable
from nsmodel.study.lines import ERROR_MEASURES, POINT_DONE, Cost, Line, Point, least_cost
from nsmodel.study.reference import Reference, ReferenceRows
from nsmodel.study.text import cost_text, study_text

POINT_NUMBERS = ("seconds", "setup", "residual", "violation", "energy")


@dataclass(frozen=True, repr=False)
class Study(Picklable):
    """What was measured of one model.

    Attributes:
        title, model_class, states, t_end, time_unit: of the model.
        lines: one a method.
        reference: what errors are measured against; None where the study was interrupted before it was known.
        target: the relative error whose price was asked for; None where none was.
        status: "done" or "interrupted".
        notes: methods that do not apply, and what was dropped for the budget.
        seconds: wall time of the whole study.
    """

    title: str
    model_class: str
    states: int
    t_end: float
    time_unit: str
    lines: tuple[Line, ...]
    reference: Reference | None
    target: float | None = None
    status: str = POINT_DONE
    notes: tuple[str, ...] = ()
    seconds: float = 0.0

    _repr_html_ = html_repr("study")

    def __repr__(self) -> str:
        """Return a few lines: title, class, how much was measured, against what."""
        points = sum(len(line.points) for line in self.lines)
        against = "" if self.reference is None else f", against {self.reference.text}"
        measured = f"{len(self.lines)} lines, {points} points{against}, {self.status}"
        return "\n".join(wrap_lines(f"Study({one_line(self.title)!r}, {self.model_class}: {measured})"))

    def line(self, name: str) -> Line:
        """Return the line of that name; else UsageError."""
        for line in self.lines:
            if line.name == name:
                return line
        raise UsageError(f"no line is called '{name}'; this study has {', '.join(line.name for line in self.lines) or 'none'}")

    def with_lines(self, lines: Sequence[Line]) -> Study:
        """Return the study with further lines, measured elsewhere: see `Line.measured` and `point`."""
        return replace(self, lines=(*self.lines, *lines))

    def point(
        self, label: str, t: Any, x: Any, seconds: float | None, *, step: float | None = None, multipliers: Any = None
    ) -> Point:
        """Return the run of another program as a point, its errors measured like those of the study.

        Args:
            label: what tells the run from the others of its line.
            t: increasing times from 0 to the end (N+1,).
            x: states at these times (N+1, n), in the order of the model's.
            seconds: CPU time of its steps.
            step: its step, where constant.
            multipliers: (N+1, m), where they have the same meaning as the model's.

        Raises:
            UsageError: wrong shapes, other times, values that are not finite.
        """
        if self.reference is None:
            raise UsageError("point: the study was interrupted before its reference was known; run it again")
        times, states = np.asarray(t, float), np.asarray(x, float)
        states = states[:, None] if states.ndim == 1 else states
        if times.ndim != 1 or states.shape != (times.size, self.states) or times.size < 2:
            shapes = f"t of shape {times.shape} and x of shape {states.shape}; expected (N+1,) and (N+1, {self.states})"
            raise UsageError(f"point '{label}': {shapes}")
        if not (np.isfinite(states).all() and (np.diff(times) > 0).all()):
            raise UsageError(f"point '{label}': t must increase and x be finite; for a run that failed take Point.failed")
        if abs(times[0]) > 1e-9 * self.t_end or abs(times[-1] - self.t_end) > 1e-6 * self.t_end:
            raise UsageError(f"point '{label}': t goes from {times[0]:g} to {times[-1]:g}; expected 0 to {self.t_end:g}")
        l = None if multipliers is None else np.asarray(multipliers, float)
        return self.reference.point(label, ReferenceRows(times, states, l), seconds, step)

    def cost(self, target: float) -> Cost | None:
        """Return what the relative error ``target`` costs with the quickest method; None where none would reach it.

        UsageError where the target is no finite number > 0.
        """
        if not (np.isfinite(target) and target > 0):
            raise UsageError(f"target = {target}; expected a finite number > 0")
        return least_cost(self.lines, target, 0.0 if self.reference is None else self.reference.own["max"])

    def text(self) -> str:
        """The study for a person, at most 100 columns wide."""
        return escape_invisible(study_text(self))

    def document(self) -> dict[str, Any]:
        """The study as dictionaries and lists that JSON can hold."""
        return _study_data(self)

    def to_csv(self, path: str | Path) -> None:
        """Write one row a point to ``path``; empty cells are "nan". StorageError where that fails."""
        rows = [_point_row(line, point) for line in self.lines for point in line.points]
        names = list(_point_row(Line("", ()), Point("")))
        write_csv(path, {name: np.array([row[name] for row in rows]) for name in names})

    def plot(self, ax: Any = None) -> Any:
        """Draw errors and times on ``ax`` or a new figure; return the axes (see `nsmodel.plot.work_precision`)."""
        from nsmodel.plot.study import work_precision

        return work_precision(self, ax=ax)

    def view(self, path: str | Path | None = None) -> Path:
        """Write the study as one HTML file, and return its path; without a path a temporary file, opened in the browser.

        StorageError where it cannot be written.
        """
        from nsmodel.view.study import view_study

        return view_study(self, path)


class StudyInterrupted(KeyboardInterrupt):
    """Ctrl-C during a study; ``study`` holds what was measured."""

    def __init__(self, study: Study) -> None:
        super().__init__("the study was interrupted")
        self.study = study

    def __reduce__(self) -> tuple[type[StudyInterrupted], tuple[Study]]:
        """Pickle with the study."""
        return type(self), (self.study,)


# -- JSON and CSV ------------------------------------------------------------------------------------------------------


def _study_data(study: Study) -> dict[str, Any]:
    reference = study.reference
    document = {
        "title": study.title,
        "model_class": study.model_class,
        "states": study.states,
        "t_end": study.t_end,
        "time_unit": study.time_unit,
        "status": study.status,
        "seconds": study.seconds,
        "notes": list(study.notes),
        "reference": None if reference is None else {
            "text": reference.text,
            "own_error": dict(reference.own),
            "scale": reference.scale.tolist(),
            "without_multipliers": reference.without_multipliers,
        },
        "lines": [_line_document(line) for line in study.lines],
    }  # fmt: skip
    if study.target is not None:
        cost = study.cost(study.target)
        document["target"] = {"error": study.target, "text": cost_text(study, study.target), "cost": cost and vars(cost)}
    return document


def _line_document(line: Line) -> dict[str, Any]:
    points = [{**vars(point), "errors": dict(point.errors)} for point in line.points]
    orders = {
        measure: vars(line.order(measure)) for measure in ERROR_MEASURES if any(measure in point.errors for point in line.points)
    }
    return {"name": line.name, "kind": line.kind, "note": line.note, "orders": orders, "points": points}


def _point_row(line: Line, point: Point) -> dict[str, Any]:
    """A point as a row of the table; what is not known is nan."""
    known = {"step": point.step, "steps": point.steps, **{f"error_{key}": point.errors.get(key) for key in ERROR_MEASURES}}
    known |= {key: getattr(point, key) for key in POINT_NUMBERS}
    numbers = {key: np.nan if value is None else value for key, value in known.items()}
    texts = {"status": point.status, "message": point.message, "unresolved": " ".join(point.unresolved)}
    return {"line": line.name, "kind": line.kind, "label": point.label, **numbers, **texts}
