"""Pictures of sweeps: lines with bands, histograms, maps over two parameters, and the picture that fits."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.errors import PlotError
from nsmodel.plot import style
from nsmodel.proof.verdict import not_none
from nsmodel.sweep.statistics import statistics
from nsmodel.sweep.variable import (
    CELL_DONE,
    CELL_FAILED,
    CELL_INTERRUPTED,
    CELL_NOT_RUN,
    CELL_REFUSED,
    DRAWN_DIMS,
    STATUS_NAMES,
    TIME_DIM,
    Over,
    Variable,
    as_variable,
    is_evenly_spaced,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

# So few values, none nearer to the next than a tenth of their range, are themselves the ticks: labels do not touch.
MAX_TICK_VALUES = 10
# Positive values whose largest is so many times the smallest have a logarithmic axis: on another most are at 0.
LOG_SCALE_RATIO = 1e3


@dataclass(frozen=True, eq=False)
class Coordinate:
    """An axis of a picture: where the values of a coordinate are on it, in increasing order.

    Attributes:
        name: of the coordinate, with its unit.
        order: indices of the values, such that `places` increase.
        places: on the axis.
        words: at these places; None of numbers.
        log: whether the axis is logarithmic.
    """

    name: str
    order: np.ndarray
    places: np.ndarray
    labels: list[str] | None
    log: bool

    def on(self, axis: Any) -> None:
        """Give a matplotlib axis these ticks and this scale."""
        if self.labels is not None:
            labelled = style.evenly_spread(len(self.labels), 24)
            axis.set_ticks(self.places[labelled], [self.labels[k] for k in labelled])
        elif self.log:
            axis.axes.set(**{f"{axis.axis_name}scale": "log"})
        elif len(self.places) <= MAX_TICK_VALUES and np.diff(self.places).min(initial=np.inf) * MAX_TICK_VALUES >= np.ptp(
            self.places
        ):
            axis.set_ticks(self.places, [f"{place:.5g}" for place in self.places])


def coordinate(variable: Variable, name: str) -> Coordinate:
    """Return the axis of a coordinate: numbers in order, words one after the other, a geometric series on a logarithmic one."""
    values = variable.coords[name]
    label = coordinate_label(variable, name)
    if values.dtype.kind not in "biuf" or not np.isfinite(values).all() or len(np.unique(values)) < len(values):
        places = np.arange(len(values), dtype=float)
        return Coordinate(
            label, np.arange(len(values)), places, [style.safe_text(style.shorten(str(one), 18)) for one in values], False
        )
    order = np.argsort(values, kind="stable")
    places = values[order].astype(float)
    return Coordinate(
        label, order, places, None, places[0] > 0 and places[-1] > 20 * places[0] and is_evenly_spaced(places, geometric=True)
    )


def coordinate_label(variable: Variable, name: str) -> str:
    """A coordinate with its unit."""
    return style.with_unit(style.shorten(name, 40), variable.units.get(name, ""))


def quantity_label(variable: Variable) -> str:
    """The quantity with its unit."""
    return style.with_unit(style.shorten(variable.title, 48), variable.unit)


def coordinate_value_text(variable: Variable, name: str, index: int) -> str:
    """A coordinate as in "k = 5 N/m"; words as they are."""
    value, unit = variable.coords[name][index], variable.units.get(name, "")
    number = f"{value:.4g}" if variable.coords[name].dtype.kind in "biuf" else style.shorten(str(value))
    return f"{style.shorten(name)} = {number} {unit}".rstrip()


def required_dim(variable: Variable, name: str, what: str) -> str:
    """The dim that a coordinate is along; PlotError where there is none of this name."""
    if name in variable.dims:
        return name
    if name in variable.along:
        return variable.along[name]
    raise PlotError(f"{what}={name!r}: {variable.name} has {', '.join((*variable.dims, *variable.along)) or 'no dims'}")


def cells_text(variable: Variable, dims: Iterable[str]) -> str:
    """How many cells are taken together, as in "20 seeds" and "3 values of k"."""
    texts = []
    for dim in dims:
        one, of = (dim, "") if dim in DRAWN_DIMS else ("value", f" of {style.shorten(dim)}")
        texts.append(f"{variable.sizes[dim]} {one}{'s' if variable.sizes[dim] != 1 else ''}{of}")
    return ", ".join(texts)


def last_rows(variable: Variable, kept: Sequence[str]) -> tuple[Variable, str]:
    """The variable at the end of those axes within a cell that are not drawn, and words for it."""
    texts = []
    for dim in variable.dims:
        if dim not in variable.cell_dims and dim not in kept:
            texts += [coordinate_value_text(variable, dim, -1)] if variable.sizes[dim] > 1 else []
            variable = variable.take(dim, -1)
    return variable, f" at {', '.join(texts)}" if texts else ""


def parameter_dims(variable: Variable) -> list[str]:
    """The dims of cells along which values were laid out, the longest first."""
    laid = [dim for dim in variable.cell_dims if dim not in DRAWN_DIMS]
    return sorted(laid, key=lambda dim: -variable.sizes[dim])


def spans_decades(values: np.ndarray) -> bool:
    """Whether finite values are all positive and spread over three decades or more."""
    some = values[np.isfinite(values)]
    return bool(some.size and some.min() > 0 and some.max() >= LOG_SCALE_RATIO * some.min())


def missing_result_text(variable: Variable) -> str:
    """Such as "3 of 820 cells without a result: 2 failed, 1 not run"; empty where all have one."""
    causes = variable.causes
    if list(causes) == [STATUS_NAMES[CELL_FAILED]]:
        return f"{causes[STATUS_NAMES[CELL_FAILED]]} of {variable.status.size} cells failed"
    reasons = ", ".join(f"{n} {word}" for word, n in causes.items())
    return f"{sum(causes.values())} of {variable.status.size} cells without a result: {reasons}" if causes else ""


def missing_result_handles(variable: Variable, *, marker: str = "x") -> list[Line2D]:
    """Of `missing_result_text` an entry of a legend, or none."""
    from matplotlib.lines import Line2D

    label = missing_result_text(variable)
    return [Line2D([], [], color=style.ALERT, marker=marker, linestyle="", markersize=5, label=label)] if label else []


def write_note(ax: Axes, note: str) -> None:
    """Write words in the middle of axes on which there is nothing to draw."""
    ax.text(
        0.5, 0.5, note, transform=ax.transAxes, ha="center", va="center", fontsize=10, color=style.ALERT,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 4},
    )  # fmt: skip


MAP_COLOURS = "viridis"
HATCHES = {
    CELL_FAILED: ("#BFC3C8", "////"),
    CELL_INTERRUPTED: ("#D5D8DC", "\\\\\\\\"),
    CELL_REFUSED: ("#BFC3C8", "xxxx"),
    CELL_NOT_RUN: ("#F1F2F4", "...."),
}
HATCH_COLOUR = "#6B727B"
PARTIAL_LABEL = "some of its cells without a result"


def sweep_map(variable: Any, x: str | None = None, y: str | None = None, *, ax: Axes | None = None) -> Axes:
    """Draw a quantity over two parameters of a sweep as colours; cells without a result are grey, hatched, and named.

    Over other dims of cells it is the mean of those that are done; a dot marks where some of them are missing. An axis within a
    cell ("t") is at its end. Two coordinates along samples give a dot a sample.

    Args:
        variable: of a sweep, or an xarray.DataArray.
        x, y: dims along the axes; left out: the two longest dims of parameters.
        ax: where to draw; a new figure by default.

    Raises:
        PlotError: no such dims.
    """
    found, where = last_rows(as_variable(variable, "sweep_map"), (x or "", y or ""))
    laid = [dim for dim in (*parameter_dims(found), *found.dims) if dim not in (x, y)]
    if len(laid) < (x is None) + (y is None):
        raise PlotError(f"{found.name} has the dims {', '.join(found.dims) or 'none'}; a map takes two, sweep_line one")
    x = laid.pop(0) if x is None else x
    y = next(dim for dim in laid if dim != x) if y is None else y
    along = [required_dim(found, name, axis) for name, axis in ((x, "x"), (y, "y"))]
    ax = style.get_axes(ax, 7.0, 5.0)
    if along[0] == along[1] and x != y:
        return _draw_map_dots(ax, found, x, y, where)
    if along[0] == along[1] or x in found.along or y in found.along:
        raise PlotError(
            f"x={x!r}, y={y!r}: both lie along {' and '.join(along)}; expected two dims, or two coordinates of samples"
        )
    values, status, part, description = _map_cells(found, x, y)
    axes = [coordinate(found, name) for name in (x, y)]
    rows = np.ix_(axes[1].order, axes[0].order)
    values, status, part = values[rows], status[rows], part[rows]
    edges = [_cell_edges(axis) for axis in axes]
    mesh = ax.pcolormesh(*edges, np.ma.masked_invalid(values), cmap=MAP_COLOURS, norm=_colour_norm(values), rasterized=True)
    style.dress(ax, f"{style.shorten(found.title, 32)}{where}{description}", axes[0].name, axes[1].name, grid=False)
    for axis, on in zip(axes, (ax.xaxis, ax.yaxis), strict=True):
        axis.on(on)
    handles = _hatch(ax, edges, status, values)
    if part.any():
        i, j = np.nonzero(part)
        handles += ax.plot(
            axes[0].places[j], axes[1].places[i], "o", color=style.ALERT, markeredgecolor="white", markersize=5,
            label=PARTIAL_LABEL,
        )  # fmt: skip
    _map_colour_bar(ax, mesh, found, values)
    if handles:
        style.legend(ax, handles)
    return ax


def _map_cells(variable: Variable, x: str, y: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, str]:
    """Values (y, x), the status where none of the cells has a result, where a part of them has none, words for what is shown."""
    over = tuple(dim for dim in variable.cell_dims if dim not in (x, y))
    order = [variable.dims.index(dim) for dim in (*over, y, x)]
    status = variable.everywhere.transpose(order).reshape(-1, variable.sizes[y], variable.sizes[x])
    gone = status != CELL_DONE
    first = np.take_along_axis(status, np.argmax(status == CELL_FAILED, axis=0)[None], axis=0)[0]  # failed where one is
    if over:
        of = statistics(variable, over, (), None)
        values = of.mean.transpose([of.dims.index(dim) for dim in (y, x)])
        description = f", mean over {cells_text(variable, over)}"
    else:
        values, description = np.where(variable.done, variable.values, np.nan).transpose(order), ""
    return values, np.where(gone.all(axis=0), first, CELL_DONE), gone.any(axis=0) & ~gone.all(axis=0), description


def _cell_edges(axis: Coordinate) -> np.ndarray:
    """The edges between places: midpoints, on a logarithmic axis geometric ones."""
    places = np.log(axis.places) if axis.log else axis.places
    if len(places) == 1:
        half = 0.5 if axis.labels is not None else 0.05 * (abs(places[0]) or 1)
        return np.array([places[0] - half, places[0] + half])
    middle = (places[1:] + places[:-1]) / 2
    edges = np.r_[2 * places[0] - middle[0], middle, 2 * places[-1] - middle[-1]]
    return np.exp(edges) if axis.log else edges


def _colour_norm(values: np.ndarray) -> Any:
    """Colours by values, by their logarithm where they span decades; one value has the middle of the scale."""
    from matplotlib.colors import LogNorm, Normalize

    some = values[np.isfinite(values)]
    if not some.size:
        return Normalize(0, 1)
    low, high = float(some.min()), float(some.max())
    if low == high:
        half = 0.05 * (abs(low) or 1)
        return Normalize(low - half, high + half)
    return LogNorm(low, high) if spans_decades(values) else Normalize(low, high)


def _hatch(ax: Axes, edges: list[np.ndarray], status: np.ndarray, values: np.ndarray) -> list[Any]:
    """Hatch the cells without a result, each kind its own way; grey where one that is done has no finite value."""
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import Patch

    kinds = [(code, f"{STATUS_NAMES[code]} ({{}})", HATCHES[code]) for code in HATCHES]
    where = {code: status == code for code in HATCHES}
    where[CELL_DONE] = (status == CELL_DONE) & ~np.isfinite(values)
    kinds.append((CELL_DONE, "not finite ({})", ("white", "")))
    handles, (x, y) = [], edges
    for code, label, (colour, hatch) in kinds:
        i, j = np.nonzero(where[code])
        if i.size:
            corners = np.stack([np.stack([x[j + a], y[i + b]], axis=1) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))], axis=1)
            look: dict[str, Any] = {
                "facecolor": colour,
                "edgecolor": HATCH_COLOUR if hatch else colour,
                "hatch": hatch,
                "linewidth": 0,
            }
            ax.add_collection(PolyCollection(list(corners), **look), autolim=False)
            look |= {"edgecolor": HATCH_COLOUR, "linewidth": 0.5}
            handles.append(Patch(**look, label=label.format(i.size)))
    return handles


def _map_colour_bar(ax: Axes, mesh: Any, variable: Variable, values: np.ndarray) -> None:
    """The scale of colours; none where there is nothing to read on it."""
    if np.isfinite(values).any():
        style.colour_bar(ax, mesh, quantity_label(variable))
    else:
        write_note(ax, "no cell has a result" if not variable.done.any() else "no value is finite")


def _cell_places(variable: Variable, name: str) -> np.ndarray:
    """The coordinate of each of the values, one after the other."""
    along = variable.along.get(name, name)
    at = [variable.sizes[dim] if dim == along else 1 for dim in variable.dims]
    return np.broadcast_to(variable.coords[name].astype(float).reshape(at), variable.values.shape).ravel()


def _drawn_cells(variable: Variable) -> tuple[np.ndarray, np.ndarray, str]:
    """Which of the values are there, the numbers of those that are drawn, and a note where these are not all."""
    done = variable.done.ravel()
    rows = np.flatnonzero(done)
    drawn = rows[style.evenly_spread(len(rows), style.MAX_POINTS)]
    return done, drawn, style.selection_note(len(drawn), len(rows), "evenly spread")


def _draw_map_dots(ax: Axes, variable: Variable, x: str, y: str, where: str) -> Axes:
    """A dot a sample, over two coordinates of samples; crosses where there is no result."""
    place = [_cell_places(variable, name) for name in (x, y)]
    values = variable.values.ravel().astype(float)
    done, rows, note = _drawn_cells(variable)
    dots = ax.scatter(
        place[0][rows], place[1][rows], c=values[rows], cmap=MAP_COLOURS, norm=_colour_norm(values[done]),
        s=18 if len(rows) < 1000 else 6, linewidths=0, rasterized=True,
    )  # fmt: skip
    gone = np.flatnonzero(~done)
    gone = gone[
        style.evenly_spread(len(gone), -(-len(gone) * len(rows) // max(1, int(done.sum()))) if rows.size else style.MAX_POINTS)
    ]
    ax.plot(place[0][gone], place[1][gone], "x", color=style.ALERT, markersize=4 if len(gone) < 500 else 1.5, rasterized=True)
    names = [coordinate_label(variable, name) for name in (x, y)]
    style.dress(ax, f"{style.shorten(variable.title, 32)}{where}, a dot a cell{note}", *names)
    for axis, places in ((ax.set_xscale, place[0]), (ax.set_yscale, place[1])):
        if spans_decades(places):
            axis("log")
    _map_colour_bar(ax, dots, variable, values[rows])
    if handles := missing_result_handles(variable):
        style.legend(ax, handles)
    return ax


MAX_ERROR_BARS = 12  # So many points have error bars, more a band: bars would touch.
MAX_SWEEP_LINES = 60  # Lines of a picture; of more values, so many, evenly spread: more cannot be told apart.
# Lines that a legend names one by one; numbers of more are a colour bar: colours in order are told apart up to here.
MAX_LEGEND_LINES = 8
SPREAD_QUANTILES = (0.05, 0.5, 0.95)  # The band, in which nine of ten values are, and the line in it.
SHOW_OPTIONS = ("mean", "median", "spread")
ATOM_SHARE = 0.02  # A value that this part of the cells has is drawn as one: a bar would show it as many values.
ATOM_TOLERANCE = 1e-9  # Values nearer than this part of their range are one value: they differ by the tolerance of steps.
MAX_SPIKE_RATIO = 3.0  # Times the tallest bar: spikes above are cut, so that bars can be seen.
CUT_LABEL = " (cut)"
NAMED_ATOMS = 3  # Atoms whose value the legend says, the largest: a line each.


# -- lines -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _SweepLines:
    """Values (lines, points), the ends of their bands, how many cells failed there, and words for what they are."""

    centre: np.ndarray
    low: np.ndarray | None
    high: np.ndarray | None
    failed: np.ndarray
    description: str


def sweep_line(
    variable: Any, x: str | None = None, hue: str | None = None, over: Over = None, *, show: str = "mean", level: float = 0.95,
    ax: Axes | None = None,
) -> Axes:  # fmt: skip
    """Draw a quantity over one coordinate of a sweep: a line for each value of another, with a band, or bars if points are few.

    Where cells failed there are crosses at the lower edge, and the legend counts them. An axis within a cell ("t") that is not
    drawn is at its end.

    Args:
        variable: of a sweep, or an xarray.DataArray.
        x: dim along the axis; left out: "t" where there is one, else the longest dim of parameters. A coordinate along samples
            gives a dot a sample.
        hue: dim with a line for each value; left out: one line.
        over: dims of cells that each point is over; left out: all others.
        show: "mean" with its standard error, "median" with the interval that holds it at `level` for every distribution, or
            "spread", the median and the range from the 5 % to the 95 % quantile.
        level: of the interval of the median.
        ax: where to draw; a new figure by default.

    Raises:
        PlotError: no such dim, or one that is left over.
    """
    whole = as_variable(variable, "sweep_line")
    if show not in SHOW_OPTIONS:
        raise PlotError(f"show={show!r}; expected one of {', '.join(SHOW_OPTIONS)}")
    x = _default_x(whole, hue) if x is None else x
    along = required_dim(whole, x, "x")
    if hue is not None and (hue not in whole.dims or hue == along or x in whole.along):
        others = [dim for dim in whole.dims if dim != along]
        raise PlotError(f"hue={hue!r} beside x={x!r}: expected {' or '.join(others) if x in whole.dims else 'none'}")
    ax = style.get_axes(ax)
    if x in whole.along:
        return _draw_line_dots(ax, whole, x)
    found, where = last_rows(whole, (x, hue or x))
    lines, axis = _sweep_lines(found, x, hue, over, show, level), coordinate(found, x)
    many = style.evenly_spread(1 if hue is None else found.sizes[hue], MAX_SWEEP_LINES)
    colours, names = (
        style.colours(len(many)),
        [lines.description] if hue is None else [coordinate_value_text(found, hue, k) for k in many],
    )
    handles = [_draw_line(ax, axis, lines, k, colour, name) for k, colour, name in zip(many, colours, names, strict=True)]
    note = style.selection_note(len(many), found.sizes[hue], "evenly spread") if hue else ""
    description = f": {lines.description}" if hue and lines.description else ""
    style.dress(ax, f"{style.shorten(found.title, 32)}{where}{description}{note}", axis.name, quantity_label(found))
    axis.on(ax.xaxis)
    if spans_decades(lines.centre):
        ax.set_yscale("log", nonpositive="clip")
    if not np.isfinite(lines.centre).any():
        write_note(ax, "no cell has a result" if not found.done.any() else "no value is finite")
    _sweep_legend(ax, found, hue, handles, axis, np.any(lines.failed, axis=0, keepdims=True)[0] if x in found.cell_dims else None)
    return ax


def _default_x(variable: Variable, hue: str | None) -> str:
    """The dim along the axis where none is given."""
    dims = [dim for dim in (TIME_DIM, *parameter_dims(variable), *variable.dims) if dim in variable.dims and dim != hue]
    if not dims:
        raise PlotError(f"{variable.name} has no dim to draw it over; its dims are {', '.join(variable.dims) or 'none'}")
    return dims[0]


def _sweep_lines(variable: Variable, x: str, hue: str | None, over: Over, show: str, level: float) -> _SweepLines:
    """The values of each line, and what they are."""
    kept = [dim for dim in (hue, x) if dim]
    rest = tuple(dim for dim in variable.cell_dims if dim not in kept)
    dims = rest if over is None else (over,) if isinstance(over, str) else tuple(over)
    if set(dims) != set(rest):
        raise PlotError(
            f"over={over!r}: beside {' and '.join(kept)} there are {', '.join(rest) or 'no dims'}; expected all of them"
        )

    def as_lines(array: np.ndarray, names: Sequence[str]) -> np.ndarray:
        array = np.asarray(array).transpose([names.index(dim) for dim in kept])
        return array if hue else array[None]

    if not dims:
        values = np.where(variable.done, variable.values, np.nan)
        return _SweepLines(as_lines(values, variable.dims), None, None, as_lines(~variable.done, variable.dims), "")
    replicates = "replicate" if variable.low_discrepancy and "replicate" in dims else None
    net = variable.low_discrepancy and not replicates
    of = statistics(variable, dims, SPREAD_QUANTILES, None if net else level, replicates)
    low, median, high = of.quantiles
    named = cells_text(variable, dims)
    if show == "mean":
        description, centre, ends = f"mean ± standard error over {named}", of.mean, (of.mean - of.error, of.mean + of.error)
    elif show == "median":
        description, centre, ends = f"median over {named}, {100 * level:g} % interval", median.value, (median.low, median.high)
    else:
        description, centre, ends = f"median over {named}, 5 % to 95 % quantile", median.value, (low.value, high.value)
    if show != "spread" and (net or of.even):
        why = "a net" if net else f"{', '.join(of.even)} evenly laid out"
        return _SweepLines(
            as_lines(centre, of.dims), None, None, as_lines(of.failed, of.dims), f"{show} over {named} ({why}: no error)"
        )
    description += ", open where cells are too few" if np.isinf(ends).any() and np.isfinite(centre).any() else ""
    low, high = (as_lines(np.where(np.isinf(end), np.nan, end), of.dims) for end in ends)
    return _SweepLines(as_lines(centre, of.dims), low, high, as_lines(of.failed, of.dims), description)


def _draw_line(ax: Axes, axis: Coordinate, lines: _SweepLines, k: int, colour: Any, name: str) -> Any:
    """Draw one line, and return what the legend shows of it."""
    parts = [None if part is None else part[k][axis.order] for part in (lines.centre, lines.low, lines.high)]
    rows = style.thin(*(part for part in parts if part is not None))
    x, (y, low, high) = axis.places[rows], (None if part is None else part[rows] for part in parts)
    look: dict[str, Any] = {"color": colour, "linewidth": 1.4, "label": style.safe_text(name or "value")}
    if len(x) > MAX_ERROR_BARS:
        line = ax.plot(x, not_none(y), **look)[0]
        if low is not None and high is not None:
            ax.fill_between(x, low, high, color=colour, alpha=0.2, linewidth=0)
        return line
    look |= {"marker": "o", "markersize": 4, "linestyle": "" if axis.labels else "-"}
    if low is None or high is None:
        return ax.plot(x, not_none(y), **look)[0]
    ax.errorbar(x, not_none(y), [not_none(y) - low, high - not_none(y)], capsize=3, elinewidth=1.1, **look)
    return ax.plot([], [], **look)[0]


def _sweep_legend(
    ax: Axes, variable: Variable, hue: str | None, handles: Sequence[Any], axis: Coordinate, failed: np.ndarray | None
) -> None:  # fmt: skip
    """Name the lines, by a colour bar where they are many; mark where cells failed."""
    if failed is not None and failed.any():
        x = axis.places[failed[axis.order]]
        ax.plot(
            x, np.zeros(len(x)), "x", transform=ax.get_xaxis_transform(), markersize=5, color=style.ALERT, clip_on=False, zorder=5
        )
    gone = missing_result_handles(variable, marker="" if failed is None else "x")
    if hue is not None and len(handles) > MAX_LEGEND_LINES and variable.coords[hue].dtype.kind in "biuf":
        _line_colour_bar(ax, variable, hue, [handle.get_color() for handle in handles])
        handles = []
    handles = [*(handle for handle in handles if handle.get_label() != "value"), *gone]
    if handles:
        style.legend(ax, handles, column=len(handles) > MAX_LEGEND_LINES + 1)


def _line_colour_bar(ax: Axes, variable: Variable, hue: str, colours: Sequence[Any]) -> None:
    """A colour bar with a colour for each line."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    count, values = len(colours), variable.coords[hue][style.evenly_spread(variable.sizes[hue], MAX_SWEEP_LINES)]
    scale = ScalarMappable(Normalize(-0.5, count - 0.5), ListedColormap(colours))
    bar, ticks = style.colour_bar(ax, scale, coordinate_label(variable, hue)), style.evenly_spread(count, 7)
    bar.set_ticks(list(ticks), labels=[f"{values[k]:.4g}" for k in ticks])
    bar.ax.tick_params(length=0)


def _draw_line_dots(ax: Axes, variable: Variable, x: str) -> Axes:
    """A dot a cell, over a coordinate of samples."""
    found, where = last_rows(variable, ())
    places, (done, rows, note) = _cell_places(found, x), _drawn_cells(found)
    y = found.values.ravel()[rows]
    size, alpha = (2, 0.35) if len(rows) > 500 else (4, 0.8)
    ax.plot(places[rows], y, "o", color=style.LINES[0], markersize=size, alpha=alpha, markeredgewidth=0, rasterized=True)
    title = f"{style.shorten(found.title, 32)}{where}, a dot a cell{note}"
    style.dress(ax, title, coordinate_label(found, x), quantity_label(found))
    if spans_decades(y):
        ax.set_yscale("log")
    if spans_decades(places):
        ax.set_xscale("log")
    if not rows.size:
        write_note(ax, "no cell has a result")
    axis = Coordinate("", np.arange(len(places)), places, None, False)
    _sweep_legend(ax, found, None, [], axis, ~done)
    return ax


# -- histograms --------------------------------------------------------------------------------------------------------


def sweep_histogram(variable: Any, *, ax: Axes | None = None) -> Axes:
    """Draw how the values of all cells are distributed; one that many cells have (an atom, such as a place of rest) as a spike.

    Heights are shares of the cells that are done: of a bar those within it. Where positive values spread over three decades the
    axis is logarithmic. An axis within a cell ("t") is at its end.

    Args:
        variable: of a sweep, or an xarray.DataArray.
        ax: where to draw; a new figure by default.
    """
    from matplotlib.lines import Line2D

    found, where = last_rows(as_variable(variable, "sweep_histogram"), ())
    ax = style.get_axes(ax)
    done = found.values[found.done].astype(float)
    values = np.sort(done[np.isfinite(done)])
    cells = f"{done.size} cell{'s' if done.size != 1 else ''}"
    style.dress(ax, f"{style.shorten(found.title, 40)}{where}: {cells}", quantity_label(found), "share of the cells done")
    handles = []
    if values.size:
        log = spans_decades(values)
        atoms, rest = _split_atoms(values)
        top = np.inf
        if rest.size:
            edges = _bin_edges(rest, log)
            heights = np.histogram(rest, edges)[0] / done.size
            ax.bar(edges[:-1], heights, np.diff(edges), align="edge", color=style.LOWER, edgecolor="white", linewidth=0.5)
            top = MAX_SPIKE_RATIO * heights.max()
        handles += _draw_atoms(ax, atoms, done.size, top, found.unit)
        handles += _draw_averages(ax, values, found.unit) if len(atoms) != 1 or rest.size else []
        if log:
            ax.set_xscale("log")
        ax.set_ylim(0, top if any(size > top * done.size for _, size in atoms) else None)
    else:
        write_note(ax, "no cell has a result" if not done.size else "no value is finite")
    handles += missing_result_handles(found, marker="")
    handles += [Line2D([], [], linestyle="", label=f"{count} not finite")] if (count := done.size - values.size) else []
    if handles:
        style.legend(ax, handles)
    return ax


def _split_atoms(values: np.ndarray) -> tuple[list[tuple[float, int]], np.ndarray]:
    """Values that many cells have, with how many, and the others; of sorted values."""
    near = max(ATOM_TOLERANCE * (values[-1] - values[0]), 1e-13 * np.abs(values).max())
    starts = np.flatnonzero(np.r_[True, np.diff(values) > near])
    sizes = np.diff(np.r_[starts, len(values)])
    many = sizes >= max(3, ATOM_SHARE * len(values)) if len(starts) > 1 else np.ones(1, dtype=bool)
    atoms = [(float(values[start + size // 2]), int(size)) for start, size in zip(starts[many], sizes[many], strict=True)]
    return atoms, values[~np.repeat(many, sizes)]


def _bin_edges(values: np.ndarray, log: bool) -> np.ndarray:
    """Edges of bars of one width, 2 n^(1/3) of them (Rice's rule), between 8 and 80."""
    low, high = values[0], values[-1]
    count = int(np.clip(2 * np.cbrt(len(values)), 8, 80))
    if not high - low > 1e-12 * max(abs(low), abs(high)):
        low, high, count = low - 0.05 * (abs(low) or 1), high + 0.05 * (abs(high) or 1), 1
    return np.geomspace(low, high, count + 1) if log and low > 0 else np.linspace(low, high, count + 1)


def _draw_atoms(ax: Axes, atoms: Sequence[tuple[float, int]], count: int, top: float, unit: str) -> list[Any]:
    """Draw the atoms, and name the largest; those above the top of the axes end there in an arrow."""
    from matplotlib.lines import Line2D

    if not atoms:
        return []
    x, shares = np.array([value for value, _ in atoms]), np.array([size / count for _, size in atoms])
    cut = shares > top
    ax.vlines(x, 0, np.minimum(shares, top), color=style.LINES[1], linewidth=2.2, zorder=3)
    ax.plot(x[~cut], shares[~cut], "o", color=style.LINES[1], markersize=5)
    ax.plot(x[cut], np.full(cut.sum(), top), "^", color=style.LINES[1], markersize=9, clip_on=False)
    largest = np.argsort(-shares, kind="stable")[:NAMED_ATOMS]
    named = [f"{100 * shares[k]:.3g} % at {x[k]:.5g} {unit}".rstrip() + CUT_LABEL * bool(cut[k]) for k in largest]
    named += [f"{len(atoms) - NAMED_ATOMS} more such values"] if len(atoms) > NAMED_ATOMS else []
    return [Line2D([], [], color=style.LINES[1], marker="o", markersize=4, label=style.safe_text(label)) for label in named]


def _draw_averages(ax: Axes, values: np.ndarray, unit: str) -> list[Any]:
    """Draw the median and the mean."""
    found = (("median", float(np.median(values)), "-"), ("mean", float(values.mean()), (0, (4, 2))))
    return [
        ax.axvline(at, color=style.INK, linestyle=dash, linewidth=1, label=f"{name} {at:.4g} {unit}".rstrip())
        for name, at, dash in found
    ]  # fmt: skip


# -- the picture that fits ---------------------------------------------------------------------------------------------


def draw_variable(variable: Any, **options: Any) -> Axes:
    """Draw what `Variable.plot` draws: a map, lines, or the picture that fits, as the options ask."""
    draw = sweep_map if "y" in options else sweep_line if options.keys() - {"ax"} else sweep_overview
    return draw(variable, **options)


def sweep_overview(variable: Any, *, ax: Axes | None = None) -> Axes:
    """Draw the picture that fits a sweep.

    Of two parameters or more a map; of one a line over it, or over time where its values are few; of samples or seeds alone a
    histogram, or over time their median and spread.

    Args:
        variable: of a sweep, or an xarray.DataArray.
        ax: where to draw; a new figure by default.
    """
    whole = as_variable(variable, "sweep_overview")
    laid = [dim for dim in parameter_dims(whole) if whole.sizes[dim] > 1] or parameter_dims(whole)
    if len(laid) > 1:
        return sweep_map(whole, laid[0], laid[1], ax=ax)
    if laid:
        few = TIME_DIM in whole.dims and whole.sizes[laid[0]] <= MAX_LEGEND_LINES
        return sweep_line(whole, TIME_DIM, laid[0], ax=ax) if few else sweep_line(whole, laid[0], ax=ax)
    return sweep_line(whole, TIME_DIM, show="spread", ax=ax) if TIME_DIM in whole.dims else sweep_histogram(whole, ax=ax)
