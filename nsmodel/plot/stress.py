"""Heat maps of what came of pushing a model: a row a variant, a column a step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.plot import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from nsmodel.study.stress_result import Stress

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
    edges: dict[str, Any] = {"which": "minor", "color": "white", "linewidth": 1.5}
    ax.set_xticks(np.arange(-0.5, len(columns)), minor=True)
    ax.set_yticks(np.arange(-0.5, len(rows)), minor=True)
    ax.grid(True, **edges)
    ax.tick_params(which="both", length=0)
    ax.spines[:].set_visible(False)
    style.legend(ax, [Patch(color=VERDICT_COLOURS[verdict], label=labels[verdict]) for verdict in VERDICT_COLOURS])
    return ax


def _spare_digits(ratio: float) -> str:
    """The digits between the worst misfit and what is allowed; nothing where it is not right."""
    if not ratio <= 1:
        return ""
    return f"{min(-np.log10(ratio), 9):.0f}" if ratio > 0 else "9"
