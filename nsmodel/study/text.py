"""A study as text for the terminal, at most 100 columns wide."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

from nsmodel.study.lines import DONE, ERRORS, FAILED, LEFT_OUT, PEER, SOLVER, Line, Order, Point
from nsmodel.study.reference import CLEAR, ROUNDING, Reference

if TYPE_CHECKING:
    from nsmodel.study.result import Study

WIDTH = 100
COLUMNS = {
    "max": "largest", "end": "at end", "l2": "rms", "multipliers": "multipl.", "outputs": "outputs", "seconds": "seconds",
    "setup": "set-up", "residual": "residual", "violation": "violated", "energy": "energy",
}  # fmt: skip
MOST_COLUMNS = 9  # Of a table, in WIDTH.
ACROSS = 8  # Steps side by side in the table of solvers.
SAME = 1e-6  # Errors that differ by less than this part are those of the same steps.


def study_text(study: Study) -> str:
    """Return the study for a person."""
    unit = f" {study.time_unit}" if study.time_unit else ""
    size = f"{study.states} state{'' if study.states == 1 else 's'}"
    out = textwrap.wrap(study.title, WIDTH)
    out += _entry("model class", f"{study.model_class}, {size}, t = 0 to {study.t_end:.6g}{unit}")
    if study.status != DONE:
        out += _entry("status", f"{study.status}: what follows was measured before")
    if study.reference is not None:
        out += _about(study.reference)
    done = [point for line in study.lines for point in line.points if point.status == DONE]
    keys = [key for key in COLUMNS if any(_value(point, key) is not None for point in done)]
    keys = [key for key in keys if key != "setup"] if len(keys) > MOST_COLUMNS else keys
    means = "; outputs: of their means over the run, beside their largest values" if "outputs" in keys else ""
    out += _entry("errors", f"relative to each state's largest value: largest over the grid, at end, rms in time{means}")
    out += _entry("seconds", "CPU time of the steps, the least of several runs; set-up: wall time before them")
    for note in study.notes:
        out += _entry("note", note)
    for line in study.lines:
        if line.kind != SOLVER:
            out += ["", *_table(line, keys)]
    out += _solvers([line for line in study.lines if line.kind == SOLVER], study.lines)
    if any(point.unresolved for point in done):
        out += ["", f"* less than {CLEAR:g} times the reference's own error: takes no part in orders and costs"]
    if study.lines:
        out += ["", *_summary(study)]
    if study.target is not None:
        out += ["", *textwrap.wrap(price(study, study.target), WIDTH, subsequent_indent="  ")]
    return "\n".join(out)


def price(study: Study, target: float) -> str:
    """Return what the error ``target`` costs, in a line."""
    cost = study.cost(target)
    own = 0.0 if study.reference is None else study.reference.own["max"]
    if cost is None and target < CLEAR * own:
        return (
            f"error {number(target)} cannot be told from the reference's own error ({number(own)}): whether a line reaches it is "
            "not known; give smaller steps, which refine the reference too"
        )
    if cost is None:
        return f"error {number(target)} is not reached by any line; give smaller steps, or a larger budget"
    where = cost.label if cost.step is None else f"step <= {number(cost.step)}"
    aside = {"extrapolated": "; extrapolated, no run got there", "at the coarsest point": "; the coarsest run is already better"}
    return f"error {number(target)} needs {where} ({cost.line}): {number(cost.seconds)} s{aside.get(cost.how, '')}"


def number(value: float) -> str:
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


def _entry(label: str, text: str) -> list[str]:
    return textwrap.wrap(text, WIDTH, initial_indent=f"  {label:13}", subsequent_indent=" " * 15)


def _about(reference: Reference) -> list[str]:
    own = dict(reference.own)
    multipliers = own.pop("multipliers", None)
    exact = max(own.values()) <= ROUNDING
    error = "" if exact else "; its own error: " + ", ".join(f"{COLUMNS[key]} {number(value)}" for key, value in own.items())
    out = _entry("reference", reference.text + error)
    if reference.without_multipliers:
        return out + _entry("multipliers", f"not compared: {reference.without_multipliers}")
    if multipliers is None:
        return out
    same = reference.text == reference.run
    source = "own error of the reference: " if same else f"compared with {reference.run}; its own error: "
    return out + _entry("multipliers", f"mean over time, {source}{number(multipliers)}")


def _table(line: Line, keys: Sequence[str]) -> list[str]:
    done = [point for point in line.points if point.status == DONE]
    width = max([12, *(len(point.label) for point in done)]) + 1
    out = [line.name + (" (measured elsewhere)" if line.kind == PEER else "")]
    out += textwrap.wrap(line.note, WIDTH, initial_indent="  ", subsequent_indent="  ")
    if any(point.step for point in done):
        out.append(f"  {order_text(line.order())}")
    if done:
        out.append(f"  {'':{width}}" + "".join(f"{COLUMNS[key]:>9}" for key in keys))
    for point in done:
        cells = "".join(f"{_cell(point, key):>9}" for key in keys)
        out.append(f"  {point.label:{width}}{cells}")
    return out + _missing(line)


def _missing(line: Line) -> list[str]:
    """The points that are not there, and why; of failures the first one's message."""
    out = []
    for status in (FAILED, LEFT_OUT):
        points = [point for point in line.points if point.status == status]
        if points:
            labels, joint = ", ".join(point.label for point in points), " for " if status == LEFT_OUT else ": "
            text = f"{labels}: {status}{joint}{points[0].message}"
            out += textwrap.wrap(text, WIDTH, initial_indent="  ", subsequent_indent="    ")
    return out


def _solvers(lines: Sequence[Line], all_lines: Sequence[Line]) -> list[str]:
    """Seconds of each solver at each step: their errors are those of the scheme, and said where they are not."""
    if not lines:
        return []
    width = max(len(line.name) for line in lines) + 1
    labels = list(dict.fromkeys(point.label for line in lines for point in line.points))
    first = {point.label: point.error for point in all_lines[0].points if point.status == DONE}
    out = ["", "seconds with one solver alone, interpreted; + where the error is not that of the first line"]
    for start in range(0, len(labels), ACROSS):
        some = labels[start : start + ACROSS]
        out.append(f"  {'h =':>{width}}" + "".join(f"{label.removeprefix('h = '):>10}" for label in some))
        for line in lines:
            points = {point.label: point for point in line.points}
            cells = "".join(f"{_seconds(points.get(label), first.get(label)):>10}" for label in some)
            out.append(f"  {line.name:{width}}{cells}")
    for line in lines:
        failed = [point for point in line.points if point.status == FAILED]
        if failed:
            text = f"{line.name}, {failed[0].label}: {failed[0].message}"
            out += textwrap.wrap(text, WIDTH, initial_indent="  ", subsequent_indent="    ")
    return out


def _seconds(point: Point | None, expected: float | None) -> str:
    if point is None or point.status == LEFT_OUT:
        return "-"
    if point.status == FAILED:
        return "failed"
    differs = expected is None or abs(point.error - expected) > SAME * max(expected, ROUNDING)
    return _cell(point, "seconds") + ("+" if differs else "")


def _summary(study: Study) -> list[str]:
    """One row a line, solvers alone excepted: its order, its least error and what that took."""
    lines = [line for line in study.lines if line.kind != SOLVER]
    width = min(max(len(line.name) for line in lines), 54)
    out = [f"{'':{width}}  order least error  seconds us a step missing"]
    for line in lines:
        name = line.name if len(line.name) <= width else line.name[: width - 3] + "..."
        order, drawn = line.order().fit, [point for point in line.points if point.drawn]
        missing = sum(point.status != DONE for point in line.points)
        cells = ["-" if order is None else f"{order:.2f}", "-", "-", "-", str(missing or "")]
        if drawn:
            best = min(drawn, key=lambda point: point.error)
            each = 1e6 * (best.seconds or 0.0) / best.steps if best.steps else None
            cells[1:4] = [f"{best.error:.1e}", _cell(best, "seconds"), "-" if each is None else f"{each:.3g}"]
        row = "".join(f"{cell:>{size}}" for cell, size in zip(cells, (7, 12, 9, 10, 8), strict=True))
        out.append(f"{name:{width}}{row}".rstrip())
    return out


def _cell(point: Point, key: str) -> str:
    value = _value(point, key)
    if value is None:
        return "-"
    return ("0" if value == 0 else f"{value:.1e}") + ("*" if key in point.unresolved else "")


def _value(point: Point, key: str) -> float | None:
    return point.errors.get(key) if key in ERRORS else getattr(point, key)
