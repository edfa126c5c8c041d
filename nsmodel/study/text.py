"""A study as text for the terminal, at most 100 columns wide."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

from nsmodel.study.lines import (
    ERROR_MEASURES,
    PEER_LINE,
    POINT_DONE,
    POINT_FAILED,
    POINT_LEFT_OUT,
    SOLVER_LINE,
    Line,
    Order,
    Point,
)
from nsmodel.study.reference import CLOSED_FORM_ROUNDING, RESOLVED_FACTOR, Reference

if TYPE_CHECKING:
    from nsmodel.study.result import Study

STUDY_TEXT_WIDTH = 100
COLUMN_HEADINGS = {
    "max": "largest", "end": "at end", "l2": "rms", "multipliers": "multipl.", "outputs": "outputs", "seconds": "seconds",
    "setup": "set-up", "residual": "residual", "violation": "violated", "energy": "energy",
}  # fmt: skip
MAX_TABLE_COLUMNS = 9  # Of a table, in WIDTH.
SOLVER_TABLE_STEPS = 8  # Steps side by side in the table of solvers.
EQUAL_ERROR_TOLERANCE = 1e-6  # Errors that differ by less than this part are those of the same steps.


def study_text(study: Study) -> str:
    """Return the study for a person."""
    unit = f" {study.time_unit}" if study.time_unit else ""
    size = f"{study.states} state{'' if study.states == 1 else 's'}"
    out = textwrap.wrap(study.title, STUDY_TEXT_WIDTH)
    out += _wrapped_entry("model class", f"{study.model_class}, {size}, t = 0 to {study.t_end:.6g}{unit}")
    if study.status != POINT_DONE:
        out += _wrapped_entry("status", f"{study.status}: what follows was measured before")
    if study.reference is not None:
        out += _reference_lines(study.reference)
    done = [point for line in study.lines for point in line.points if point.status == POINT_DONE]
    keys = [key for key in COLUMN_HEADINGS if any(_point_value(point, key) is not None for point in done)]
    keys = [key for key in keys if key != "setup"] if len(keys) > MAX_TABLE_COLUMNS else keys
    means = "; outputs: of their means over the run, beside their largest values" if "outputs" in keys else ""
    out += _wrapped_entry("errors", f"relative to each state's largest value: largest over the grid, at end, rms in time{means}")
    out += _wrapped_entry("seconds", "CPU time of the steps, the least of several runs; set-up: wall time before them")
    for note in study.notes:
        out += _wrapped_entry("note", note)
    for line in study.lines:
        if line.kind != SOLVER_LINE:
            out += ["", *_line_table(line, keys)]
    out += _solver_table([line for line in study.lines if line.kind == SOLVER_LINE], study.lines)
    if any(point.unresolved for point in done):
        out += ["", f"* less than {RESOLVED_FACTOR:g} times the reference's own error: takes no part in orders and costs"]
    if study.lines:
        out += ["", *_summary_table(study)]
    if study.target is not None:
        out += ["", *textwrap.wrap(cost_text(study, study.target), STUDY_TEXT_WIDTH, subsequent_indent="  ")]
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


def _wrapped_entry(label: str, text: str) -> list[str]:
    return textwrap.wrap(text, STUDY_TEXT_WIDTH, initial_indent=f"  {label:13}", subsequent_indent=" " * 15)


def _reference_lines(reference: Reference) -> list[str]:
    own = dict(reference.own)
    multipliers = own.pop("multipliers", None)
    exact = max(own.values()) <= CLOSED_FORM_ROUNDING
    error = (
        ""
        if exact
        else "; its own error: " + ", ".join(f"{COLUMN_HEADINGS[key]} {short_number(value)}" for key, value in own.items())
    )
    out = _wrapped_entry("reference", reference.text + error)
    if reference.without_multipliers:
        return out + _wrapped_entry("multipliers", f"not compared: {reference.without_multipliers}")
    if multipliers is None:
        return out
    same = reference.text == reference.run
    source = "own error of the reference: " if same else f"compared with {reference.run}; its own error: "
    return out + _wrapped_entry("multipliers", f"mean over time, {source}{short_number(multipliers)}")


def _line_table(line: Line, keys: Sequence[str]) -> list[str]:
    done = [point for point in line.points if point.status == POINT_DONE]
    width = max([12, *(len(point.label) for point in done)]) + 1
    out = [line.name + (" (measured elsewhere)" if line.kind == PEER_LINE else "")]
    out += textwrap.wrap(line.note, STUDY_TEXT_WIDTH, initial_indent="  ", subsequent_indent="  ")
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
            out += textwrap.wrap(text, STUDY_TEXT_WIDTH, initial_indent="  ", subsequent_indent="    ")
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
            out += textwrap.wrap(text, STUDY_TEXT_WIDTH, initial_indent="  ", subsequent_indent="    ")
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
