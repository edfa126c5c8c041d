"""The result of a study: lines, reference, the cost of a target; as text for a terminal, JSON and CSV."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nsmodel._utils import TEXT_WIDTH, display, escape_invisible, html_repr, labelled_lines, one_line, wrap_lines
from nsmodel.errors import UsageError
from nsmodel.files.storage import write_csv
from nsmodel.modeling.pickling import Picklable
from nsmodel.study.lines import (
    ERROR_MEASURES,
    PEER_LINE,
    POINT_DONE,
    POINT_FAILED,
    POINT_LEFT_OUT,
    SOLVER_LINE,
    Cost,
    Line,
    Order,
    Point,
    least_cost,
)
from nsmodel.study.reference import CLOSED_FORM_ROUNDING, RESOLVED_FACTOR, Reference, ReferenceRows

POINT_NUMBERS = ("seconds", "setup", "residual", "violation", "energy")
COLUMN_HEADINGS = {
    "max": "largest", "end": "at end", "l2": "rms", "multipliers": "multipl.", "outputs": "outputs", "seconds": "seconds",
    "setup": "set-up", "residual": "residual", "violation": "violated", "energy": "energy",
}  # fmt: skip
MAX_TABLE_COLUMNS = 9  # Columns of a table that fit into a line of 100 letters; of more, that of the set-up is left out.
# Steps side by side in the table of solvers, ten letters each behind the solver's name: a line of 100 letters.
SOLVER_TABLE_STEPS = 8
EQUAL_ERROR_TOLERANCE = 1e-6  # Errors that differ by less than this part are those of the same steps, solved to a tolerance.


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

    _repr_html_ = html_repr("study_html")

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

        UsageError where the target is not a finite number > 0.
        """
        if not (np.isfinite(target) and target > 0):
            raise UsageError(f"target = {target}; expected a finite number > 0")
        return least_cost(self.lines, target, 0.0 if self.reference is None else self.reference.own["max"])

    def text(self) -> str:
        """The study for a person, at most 100 columns wide."""
        return escape_invisible(study_text(self))

    def document(self) -> dict[str, Any]:
        """The study as dictionaries and lists that JSON can hold."""
        reference = self.reference
        document = {
            "title": self.title,
            "model_class": self.model_class,
            "states": self.states,
            "t_end": self.t_end,
            "time_unit": self.time_unit,
            "status": self.status,
            "seconds": self.seconds,
            "notes": list(self.notes),
            "reference": None if reference is None else {
                "text": reference.text,
                "own_error": dict(reference.own),
                "scale": reference.scale.tolist(),
                "without_multipliers": reference.without_multipliers,
            },
            "lines": [_line_document(line) for line in self.lines],
        }  # fmt: skip
        if self.target is not None:
            cost = self.cost(self.target)
            document["target"] = {"error": self.target, "text": cost_text(self, self.target), "cost": cost and vars(cost)}
        return document

    def to_csv(self, path: str | Path) -> None:
        """Write one row a point to ``path``; empty cells are "nan". StorageError where that fails."""
        rows = [_point_row(line, point) for line in self.lines for point in line.points]
        names = list(_point_row(Line("", ()), Point("")))
        write_csv(path, {name: np.array([row[name] for row in rows]) for name in names})

    def plot(self, ax: Any = None) -> Any:
        """Draw errors and times on ``ax`` or a new figure; return the axes (see `nsmodel.plot.work_precision`)."""
        return display("work_precision", self, ax=ax)

    def view(self, path: str | Path | None = None) -> Path:
        """Write the study as one HTML file, and return its path; without a path a temporary file, opened in the browser.

        StorageError where it cannot be written.
        """
        return display("write_study_page", self, path)


class StudyInterrupted(KeyboardInterrupt):
    """Ctrl-C during a study; ``study`` holds what was measured."""

    def __init__(self, study: Study) -> None:
        super().__init__("the study was interrupted")
        self.study = study

    def __reduce__(self) -> tuple[type[StudyInterrupted], tuple[Study]]:
        """Pickle with the study."""
        return type(self), (self.study,)


# -- JSON and CSV ------------------------------------------------------------------------------------------------------


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


# -- text --------------------------------------------------------------------------------------------------------------


def study_text(study: Study) -> str:
    """Return the study for a person."""
    unit = f" {study.time_unit}" if study.time_unit else ""
    size = f"{study.states} state{'' if study.states == 1 else 's'}"
    out = textwrap.wrap(study.title, TEXT_WIDTH)
    out += _entry_lines("model class", f"{study.model_class}, {size}, t = 0 to {study.t_end:.6g}{unit}")
    if study.status != POINT_DONE:
        out += _entry_lines("status", f"{study.status}: what follows was measured before")
    if study.reference is not None:
        out += _reference_lines(study.reference)
    done = [point for line in study.lines for point in line.points if point.status == POINT_DONE]
    keys = [key for key in COLUMN_HEADINGS if any(_point_value(point, key) is not None for point in done)]
    keys = [key for key in keys if key != "setup"] if len(keys) > MAX_TABLE_COLUMNS else keys
    means = "; outputs: of their means over the run, beside their largest values" if "outputs" in keys else ""
    out += _entry_lines("errors", f"relative to each state's largest value: largest over the grid, at end, rms in time{means}")
    out += _entry_lines("seconds", "CPU time of the steps, the least of several runs; set-up: wall time before them")
    for note in study.notes:
        out += _entry_lines("note", note)
    for line in study.lines:
        if line.kind != SOLVER_LINE:
            out += ["", *_line_table(line, keys)]
    out += _solver_table([line for line in study.lines if line.kind == SOLVER_LINE], study.lines)
    if any(point.unresolved for point in done):
        out += ["", f"* less than {RESOLVED_FACTOR:g} times the reference's own error: takes no part in orders and costs"]
    if study.lines:
        out += ["", *_summary_table(study)]
    if study.target is not None:
        out += ["", *textwrap.wrap(cost_text(study, study.target), TEXT_WIDTH, subsequent_indent="  ")]
    return "\n".join(out)


def cost_text(study: Study, target: float) -> str:
    """Return what the error ``target`` costs, in a line."""
    cost = study.cost(target)
    own = 0.0 if study.reference is None else study.reference.own["max"]
    if cost is None and target < RESOLVED_FACTOR * own:
        return (
            f"error {short_number(target)} cannot be told from the reference's own error ({short_number(own)}): whether a line "
            "reaches it is not known; give smaller steps, which refine the reference too"
        )
    if cost is None:
        return f"error {short_number(target)} is not reached by any line; give smaller steps, or a larger budget"
    where = cost.label if cost.step is None else f"step <= {short_number(cost.step)}"
    aside = {"extrapolated": "; extrapolated, no run got there", "at the coarsest point": "; the coarsest run is already better"}
    return f"error {short_number(target)} needs {where} ({cost.line}): {short_number(cost.seconds)} s{aside.get(cost.how, '')}"


def short_number(value: float) -> str:
    """Return a number with two digits, as a person writes it: 0.012, 1e-4, 2.3e-7."""
    if value == 0 or 1e-3 <= abs(value) < 1e4:
        return f"{value:.2g}" if abs(value) < 100 else f"{value:.0f}"
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa.removesuffix('.0')}e{int(exponent)}"


def order_text(order: Order) -> str:
    """Return an order with its band and its floor."""
    text = "order not seen: fewer than two resolved points"
    if order.exact:
        return "no order to see: the error is rounding at every step"
    if order.fit is not None:
        band = f"{order.least:.2f} to {order.greatest:.2f} between neighbours"
        text = f"order {order.fit:.2f} ({band}, {order.points} points)"
    return text if order.floor is None else f"{text}; from h = {order.floor:.3g} on the error no longer falls"


_entry_lines = partial(labelled_lines, width=13)


def _reference_lines(reference: Reference) -> list[str]:
    own = dict(reference.own)
    multipliers = own.pop("multipliers", None)
    exact = max(own.values()) <= CLOSED_FORM_ROUNDING
    error = (
        ""
        if exact
        else "; its own error: " + ", ".join(f"{COLUMN_HEADINGS[key]} {short_number(value)}" for key, value in own.items())
    )
    out = _entry_lines("reference", reference.text + error)
    if reference.without_multipliers:
        return out + _entry_lines("multipliers", f"not compared: {reference.without_multipliers}")
    if multipliers is None:
        return out
    same = reference.text == reference.run
    source = "own error of the reference: " if same else f"compared with {reference.run}; its own error: "
    return out + _entry_lines("multipliers", f"mean over time, {source}{short_number(multipliers)}")


def _line_table(line: Line, keys: Sequence[str]) -> list[str]:
    done = [point for point in line.points if point.status == POINT_DONE]
    width = max([12, *(len(point.label) for point in done)]) + 1
    out = [line.name + (" (measured elsewhere)" if line.kind == PEER_LINE else "")]
    out += textwrap.wrap(line.note, TEXT_WIDTH, initial_indent="  ", subsequent_indent="  ")
    if any(point.step for point in done):
        out.append(f"  {order_text(line.order())}")
    if done:
        out.append(f"  {'':{width}}" + "".join(f"{COLUMN_HEADINGS[key]:>9}" for key in keys))
    for point in done:
        cells = "".join(f"{_point_cell(point, key):>9}" for key in keys)
        out.append(f"  {point.label:{width}}{cells}")
    return out + _missing_point_lines(line)


def _missing_point_lines(line: Line) -> list[str]:
    """The points that are not there, and why; of failures the first one's message."""
    out = []
    for status in (POINT_FAILED, POINT_LEFT_OUT):
        points = [point for point in line.points if point.status == status]
        if points:
            labels, joint = ", ".join(point.label for point in points), " for " if status == POINT_LEFT_OUT else ": "
            text = f"{labels}: {status}{joint}{points[0].message}"
            out += textwrap.wrap(text, TEXT_WIDTH, initial_indent="  ", subsequent_indent="    ")
    return out


def _solver_table(lines: Sequence[Line], all_lines: Sequence[Line]) -> list[str]:
    """Seconds of each solver at each step: their errors are those of the scheme, and said where they are not."""
    if not lines:
        return []
    width = max(len(line.name) for line in lines) + 1
    labels = list(dict.fromkeys(point.label for line in lines for point in line.points))
    first = {point.label: point.error for point in all_lines[0].points if point.status == POINT_DONE}
    out = ["", "seconds with one solver alone, interpreted; + where the error is not that of the first line"]
    for start in range(0, len(labels), SOLVER_TABLE_STEPS):
        some = labels[start : start + SOLVER_TABLE_STEPS]
        out.append(f"  {'h =':>{width}}" + "".join(f"{label.removeprefix('h = '):>10}" for label in some))
        for line in lines:
            points = {point.label: point for point in line.points}
            cells = "".join(f"{_seconds_cell(points.get(label), first.get(label)):>10}" for label in some)
            out.append(f"  {line.name:{width}}{cells}")
    for line in lines:
        failed = [point for point in line.points if point.status == POINT_FAILED]
        if failed:
            text = f"{line.name}, {failed[0].label}: {failed[0].message}"
            out += textwrap.wrap(text, TEXT_WIDTH, initial_indent="  ", subsequent_indent="    ")
    return out


def _seconds_cell(point: Point | None, expected: float | None) -> str:
    if point is None or point.status == POINT_LEFT_OUT:
        return "-"
    if point.status == POINT_FAILED:
        return "failed"
    differs = expected is None or abs(point.error - expected) > EQUAL_ERROR_TOLERANCE * max(expected, CLOSED_FORM_ROUNDING)
    return _point_cell(point, "seconds") + ("+" if differs else "")


def _summary_table(study: Study) -> list[str]:
    """One row a line, solvers alone excepted: its order, its least error and what that took."""
    lines = [line for line in study.lines if line.kind != SOLVER_LINE]
    width = min(max(len(line.name) for line in lines), 54)
    out = [f"{'':{width}}  order least error  seconds us a step missing"]
    for line in lines:
        name = line.name if len(line.name) <= width else line.name[: width - 3] + "..."
        order, drawn = line.order().fit, [point for point in line.points if point.drawn]
        missing = sum(point.status != POINT_DONE for point in line.points)
        cells = ["-" if order is None else f"{order:.2f}", "-", "-", "-", str(missing or "")]
        if drawn:
            best = min(drawn, key=lambda point: point.error)
            each = 1e6 * (best.seconds or 0.0) / best.steps if best.steps else None
            cells[1:4] = [f"{best.error:.1e}", _point_cell(best, "seconds"), "-" if each is None else f"{each:.3g}"]
        row = "".join(f"{cell:>{size}}" for cell, size in zip(cells, (7, 12, 9, 10, 8), strict=True))
        out.append(f"{name:{width}}{row}".rstrip())
    return out


def _point_cell(point: Point, key: str) -> str:
    value = _point_value(point, key)
    if value is None:
        return "-"
    return ("0" if value == 0 else f"{value:.1e}") + ("*" if key in point.unresolved else "")


def _point_value(point: Point, key: str) -> float | None:
    return point.errors.get(key) if key in ERROR_MEASURES else getattr(point, key)
