"""What all pictures share: colours, labels, thinning, axes and legends."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel._utils import sum_in_order
from nsmodel.errors import PlotError
from nsmodel.proof.verdict import not_none
from nsmodel.simulation.run_data import units_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from nsmodel.simulation.trajectory import Trajectory

# Points of a picture, some tens for each pixel across; of more, some are left out, never the largest and least.
MAX_POINTS = 20_000
# The colour scale of pressure ends at this percentile of those pressed: a few peaks would leave all others pale.
PRESSURE_PERCENTILE = 99.5
STEADY_TOLERANCE = 1e-13  # The part of themselves by which values change that stand still: 450 EPS, rounding.

LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#5E4FA2", "#4D4D4D")
LOWER, ZERO, UPPER, PALE = "#9CC9E3", "#2F5D8A", "#E3A857", "#DDE1E6"
INK, FREE, ALERT = "#30363D", "#8F9BAA", "#C8501E"
FORBIDDEN, EDGE, EARLIER = "#EADDCF", "#9A7B5F", "#C9B5A2"
TITLE: dict[str, Any] = {"loc": "left", "fontsize": 10, "fontweight": "bold", "color": INK}


# -- labels ------------------------------------------------------------------------------------------------------------


def safe_text(label: str) -> str:
    """Make words safe to draw: broken mathtext is shown as typed, a leading underscore does not hide a label."""
    from matplotlib.mathtext import MathTextParser

    label = f" {label}" if label.startswith("_") else label
    try:
        MathTextParser("path").parse(label)
    except ValueError:
        return label.replace("$", r"\$")
    return label


def shorten(name: str, width: int = 22) -> str:
    """Cut the middle out of a long name."""
    return name if len(name) <= width else f"{name[: width // 2 - 1]}…{name[-(width // 2) :]}"


def quantity_unit(run: Trajectory, name: str) -> str:
    """Return the unit of a state, multiplier or array; empty where there is none."""
    return units_of(run).get(name, "")


def with_unit(name: str, unit: str) -> str:
    """Return "name [unit]"."""
    return f"{name} [{shorten(unit)}]" if unit else name


def mark_rounding(name: str, rounding: bool) -> str:
    """Return the name, and of what is rounding that it is 0."""
    return f"{name} = 0 to rounding" if rounding else name


def label_with_unit(run: Trajectory, name: str) -> str:
    """Return "name [unit]" of a state, an array or the time."""
    return with_unit(shorten(name, 40), quantity_unit(run, name))


def time_text(run: Trajectory, row: int) -> str:
    """Return "t = ..." of a row, with its unit."""
    return safe_text(f"t = {run.t[row]:.4g} {quantity_unit(run, 't')}".rstrip())


def selection_note(drawn: int, count: int, why: str) -> str:
    """Return the bracket for the title where not everything is shown."""
    return f" ({drawn} of {count} shown, {why})" if drawn < count else ""


# -- arrays ------------------------------------------------------------------------------------------------------------


def array_columns(run: Trajectory, name: str) -> np.ndarray:
    """Return an array with a column a multiplier or row; no columns where the run does not hold it."""
    return run.arrays.get(name, np.empty((len(run.t), 0)))


def required_array(run: Trajectory, name: str) -> np.ndarray:
    """Return an array that must be there; else PlotError."""
    if name not in run.arrays:
        raise PlotError(f"this run holds no {name}: its arrays are {', '.join(sorted(run.arrays))}")
    return run.arrays[name]


def largest_magnitudes(values: np.ndarray) -> np.ndarray:
    """Return the largest absolute value of each column, what is not finite left out; 0 of no rows."""
    if not np.isfinite(values).all():
        values = np.where(np.isfinite(values), values, 0)
    return np.maximum(values.max(axis=0, initial=0), -values.min(axis=0, initial=0))


def extent(values: np.ndarray) -> tuple[float, float]:
    """Return the smallest and the largest value, what is not finite left out; 0, 0 of none."""
    finite = np.isfinite(values)
    known = values if finite.all() else values[finite]
    return (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)


def evenly_spread(count: int, limit: int) -> np.ndarray:
    """Return at most `limit` of 0..count-1, evenly spread, both ends kept."""
    return np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(int))


def thin(*columns: np.ndarray, limit: int = MAX_POINTS) -> np.ndarray:
    """Return the rows to draw: all, or the first, the last and each column's smallest and largest in each bucket (<= limit)."""
    n = len(columns[0])
    if n <= limit:
        return np.arange(n)
    width = -(-n // (limit // (2 * len(columns)) - 1))
    first = np.arange(0, n, width)
    kept = [np.array([0, n - 1])]
    for column in columns:
        buckets = np.full((len(first), width), np.nan)
        buckets.flat[:n] = column
        kept.append(first + np.nan_to_num(buckets, nan=np.inf).argmin(axis=1))
        kept.append(first + np.nan_to_num(buckets, nan=-np.inf).argmax(axis=1))
    return np.unique(np.concatenate(kept))


# -- axes --------------------------------------------------------------------------------------------------------------


def blank(width: float, height: float) -> Figure:
    """Return an empty figure that arranges its axes itself."""
    from nsmodel.plot.notebook_figures import NotebookFigure

    figure = NotebookFigure(figsize=(width, height))
    figure.set_layout_engine("constrained", w_pad=0.1, h_pad=0.1, hspace=0.02, wspace=0.02)
    return figure


def get_axes(ax: Axes | None, width: float = 8.0, height: float = 4.5) -> Axes:
    """Return the axes given, or those of a new figure, which show it in a notebook."""
    from nsmodel.plot.notebook_figures import NotebookAxes

    return blank(width, height).add_subplot(axes_class=NotebookAxes) if ax is None else ax


def dress(ax: Axes, title: str, xlabel: str, ylabel: str, *, grid: bool = True) -> None:
    """Give the axes their words and the look of all pictures."""
    ax.set_title(safe_text(title), **TITLE)
    ax.set_xlabel(safe_text(xlabel), fontsize=9)
    ax.set_ylabel(safe_text(shorten(ylabel, max(20, int(size_in_inches(ax)[1] / 0.065)))), fontsize=9)
    ax.tick_params(labelsize=8)
    look: dict[str, Any] = {"color": "#E6E8EB", "linewidth": 0.6} if grid else {}
    ax.grid(grid, **look)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)


def dress_over_time(ax: Axes, run: Trajectory, title: str, ylabel: str, *, grid: bool = True) -> None:
    """Dress axes over time: from the start to the end of the run and no more, the same for all its pictures."""
    dress(ax, title, label_with_unit(run, "t"), ylabel, grid=grid)
    for one in (run.metadata.get("totals") or {}).get("stretches", ()) if grid else ():
        ax.axvspan(one["start"], min(one["until"], run.t[-1]), color=FREE, alpha=0.15, linewidth=0.8, zorder=0)  # by time steps
    if run.t[-1] > run.t[0]:
        ax.set_xlim(run.t[0], run.t[-1])


def set_steady_limits(ax: Axes, values: np.ndarray, axis: str = "y") -> None:
    """Give an axis on which nothing moves but by rounding limits that do not show it."""
    low, high = extent(values)
    if high - low <= STEADY_TOLERANCE * max(abs(low), abs(high)):
        far = 0.05 * abs(low) or 1.0
        ax.set(**{f"{axis}lim": (low - far, high + far)})


def size_in_inches(ax: Axes) -> tuple[float, float]:
    """Return the width and height of the axes, before the layout leaves room for labels."""
    box = ax.get_position()
    width, height = not_none(ax.get_figure(root=True)).get_size_inches()
    return box.width * width, box.height * height


def fill_panel(ax: Axes, *limits: tuple[float, float]) -> list[tuple[float, float]]:
    """Widen one of two limits, so that a picture of equal scales fills its panel."""
    spans, panel = np.array([b - a for a, b in limits]), np.maximum(np.array([1.1, 0.9]) * size_in_inches(ax), 0.5)
    more = np.clip(max(spans / panel) * panel, spans, 2 * spans) - spans
    return [(a - m / 2, b + m / 2) for (a, b), m in zip(limits, more, strict=True)]


def legend(ax: Axes, handles: Sequence[Any], *, column: bool = False) -> None:
    """Put the legend beside the title where both fit, else in rows between title and axes; or outside on the right."""
    widths, (width, height) = [0.067 * (len(handle.get_label()) + 7) for handle in handles], size_in_inches(ax)
    style: dict[str, Any] = {"handles": handles, "fontsize": 8, "frameon": False, "borderaxespad": 0.2}
    title = ax.get_title(loc="left")
    if column:
        style |= {"fontsize": 7, "labelspacing": 0.3, "ncols": -(-len(handles) // max(1, int(height / 0.135)))}
        ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1), **style)
    elif 0.1 * len(title) + sum_in_order(widths) < width:
        ax.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=len(handles), columnspacing=1.2, **style)
    else:
        count = len(widths)
        tries = (-(-count // rows) for rows in range(1, count))  # matplotlib fills columns one by one
        columns = next((n for n in tries if sum(map(max, np.array_split(widths, n))) < 1.15 * width), 1)
        ax.set_title(title, pad=7 + 13 * -(-count // columns), **TITLE)
        # The raised title already holds the room; a legend wider than the axes must not shrink them.
        style |= {"ncols": columns, "columnspacing": 1.2}
        offset = 0.4 / width if _has_exponent(ax) else 0  # which stands above the axis
        ax.legend(loc="lower left", bbox_to_anchor=(offset, 1), **style).set_in_layout(False)


def colour_bar(ax: Axes, drawn: Any, label: str, **look: Any) -> Any:
    """Put the scale of the colours of what was drawn beside the axes."""
    given: dict[str, Any] = {"pad": 0.02, **look}
    bar = not_none(ax.get_figure()).colorbar(drawn, ax=ax, **given)
    bar.set_label(safe_text(label), fontsize=9)
    bar.ax.tick_params(labelsize=8)
    return bar


def _has_exponent(ax: Axes) -> bool:
    """Whether ticks upwards have a factor of their own, such as 1e-9."""
    low, high = ax.get_ylim()
    largest = max(abs(low), abs(high))
    return ax.get_yscale() == "linear" and not 1e-4 < largest < 1e6


def colours(count: int) -> list[Any]:
    """Return distinct colours for a few lines; a scale from dark to light for many, which are ordered (a chain, a crowd)."""
    if count <= len(LINES):
        return list(LINES[:count])
    from matplotlib import colormaps

    return [colormaps["viridis"](s) for s in np.linspace(0, 0.9, count)]
