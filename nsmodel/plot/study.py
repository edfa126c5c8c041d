"""Figures of studies: what an error costs, method by method; heat maps of stress tests, a row a variant, a column a step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.errors import PlotError
from nsmodel.plot import style
from nsmodel.proof.verdict import not_none
from nsmodel.study.result import short_number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from nsmodel.study.lines import Point
    from nsmodel.study.result import Study
    from nsmodel.study.stress_result import Stress

MARKERS = "osD^vP*X<>hd"
METHOD_COLOURS = (*style.LINES, "#A05A2C", "#8A9A00", "#B03A48", "#2E8B8B")
SOLVER_COLOUR = "#A9B1BA"


def work_precision(study: Study, *, ax: Axes | None = None) -> Axes:
    """Draw seconds over error, both logarithmic, one line a method: cheap and accurate is low and to the left.

    Solvers alone are thin and grey, other programs dashed. Steps stand at the markers; hollow ones are not resolved by the
    reference. Runs that failed have no error: a cross at the right edge says whose and how many they are.

    Raises:
        PlotError: no point has an error and a time.

    """
    from matplotlib.lines import Line2D

    if not any(point.drawn for line in study.lines for point in line.points):
        raise PlotError("this study has no point with an error and a time; run it with a larger budget")
    ax = style.get_axes(ax, 9.5, 5.5)
    coloured = [line for line in study.lines if line.kind != "solver"]
    colours = {line.name: METHOD_COLOURS[k % len(METHOD_COLOURS)] for k, line in enumerate(coloured)}
    handles, failures, labelled = [], 0, []
    for k, line in enumerate(study.lines):
        points, solver = [point for point in line.points if point.drawn], line.kind == "solver"
        look: dict[str, Any] = {"color": colours.get(line.name, SOLVER_COLOUR), "linestyle": "--" if line.kind == "peer" else "-"}
        look |= {"linewidth": 0.7 if solver else 1.4, "zorder": 2 if solver else 3}
        mark = {"marker": MARKERS[k % len(MARKERS)], "markersize": 3.5 if solver else 5}
        ax.plot([point.error for point in points], [not_none(point.seconds) for point in points], **look)
        for point in points:
            face = look["color"] if point.resolved else "white"
            ax.plot(not_none(point.error), not_none(point.seconds), **look, **mark, markerfacecolor=face)
        if not solver:
            labelled += [(point, look["color"]) for point in points]
        count = sum(point.status == "failed" for point in line.points)
        if count:
            note, place = f"{line.name}: {count} failed ×", (0.995, 0.985 - 0.045 * failures)
            ax.text(*place, style.safe_text(note), color=look["color"], fontsize=8, ha="right", va="top", transform=ax.transAxes)
            failures += 1
        if points:
            label = f"{line.name} ({line.missing_text})" if line.missing_text else line.name
            handles.append(Line2D([], [], **look, **mark, label=style.safe_text(label)))
    if missing := len(study.lines) - len(handles):
        handles.append(Line2D([], [], linestyle="", label=f"{missing} more without a point: left out or failed"))
    ax.set(xscale="log", yscale="log")
    ax.margins(0.08)
    style.dress(
        ax, study.title, "largest relative error over the grid (at the markers: step, or rtol)", "CPU time of the steps [s]"
    )
    style.legend(ax, handles, column=True)
    _annotate_steps(ax, labelled)
    return ax


def _annotate_steps(ax: Axes, points: Sequence[tuple[Point, str]]) -> None:
    """Write the steps above the points, those left out that would lie over an earlier one."""
    (left, right), (low, high), (width, height) = np.log(ax.get_xlim()), np.log(ax.get_ylim()), style.size_in_inches(ax)
    taken: list[tuple[float, float]] = []
    for point, colour in points:
        x = width * (np.log(not_none(point.error)) - left) / (right - left)
        y = height * (np.log(not_none(point.seconds)) - low) / (high - low)
        if all(abs(x - u) > 0.35 or abs(y - v) > 0.13 for u, v in taken):
            step_text = short_number(point.step) if point.step else point.label.removeprefix("rtol = ")
            ax.annotate(step_text, (point.error, point.seconds), (4, 3), textcoords="offset points", fontsize=6.5, color=colour)
            taken.append((x, y))


VERDICT_COLOURS = {"right": style.LOWER, "stopped": style.UPPER, "wrong": style.ALERT}
VERDICT_LABELS = {"right": "right", "stopped": "stopped, with the reason", "wrong": "wrong"}
DIGITS_LABEL = "right, by so many digits"


def stress(result: Stress, *, ax: Axes | None = None) -> Axes:
    """Draw the cells of a model that was pushed: a row for each unit and value, a column for each step.

    A cell that is right says how many decimal digits it has to spare: 3 where the worst misfit is a thousandth of what is
    allowed.

    Args:
        result: what `nsmodel.stress` returned.
        ax: where to draw; a new figure by default.
    """
    cells = {
        (cell.row, cell.factor): (cell.verdict, _spare_digits(cell.worst[1]))
        for cell in result.cells
        if cell.verdict in VERDICT_COLOURS
    }
    rows, factors = result.rows, result.factors
    table = {(rows.index(row), factors.index(factor)): value for (row, factor), value in cells.items()}
    ax = style.get_axes(ax, 3.6 + 0.55 * len(factors), 1.5 + 0.3 * len(rows))
    unit = f" {result.time_unit}" if result.time_unit else ""
    columns, labels = [f"{f:g}" for f in factors], VERDICT_LABELS | {"right": DIGITS_LABEL}
    return heat_map(ax, rows, columns, table, result.title, f"step, in units of {result.step:g}{unit}", labels=labels)


def heat_map(
    ax: Axes, rows: Sequence[str], columns: Sequence[str], cells: Mapping[tuple[int, int], tuple[str, str]], title: str,
    xlabel: str, *, labels: Mapping[str, str] = VERDICT_LABELS,
) -> Axes:  # fmt: skip
    """Draw coloured cells: {(row, column): (verdict, text)}; what is not there stays empty."""
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    image = np.ones((len(rows), len(columns), 3))
    for (i, j), (verdict, text) in cells.items():
        image[i, j] = to_rgb(VERDICT_COLOURS[verdict])
        ax.text(j, i, text, ha="center", va="center", fontsize=7, color="white" if verdict == "wrong" else style.INK)
    ax.imshow(image, aspect="auto", interpolation="nearest")
    style.dress(ax, title, xlabel, "", grid=False)
    ax.set_xticks(range(len(columns)), columns)
    ax.set_yticks(range(len(rows)), [style.safe_text(style.shorten(row, 40)) for row in rows])
    ax.set_xticks(np.arange(-0.5, len(columns)), minor=True)
    ax.set_yticks(np.arange(-0.5, len(rows)), minor=True)
    ax.grid(True, which="minor", color="white", linewidth=1.5)
    ax.tick_params(which="both", length=0)
    ax.spines[:].set_visible(False)
    style.legend(ax, [Patch(color=VERDICT_COLOURS[verdict], label=labels[verdict]) for verdict in VERDICT_COLOURS])
    return ax


def _spare_digits(ratio: float) -> str:
    """The digits between the worst misfit and what is allowed; nothing where it is not right."""
    if not ratio <= 1:
        return ""
    return f"{min(-np.log10(ratio), 9):.0f}" if ratio > 0 else "9"
