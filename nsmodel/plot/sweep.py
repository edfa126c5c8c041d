"""Sweeps as lines with bands, as histograms, and the picture that fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.errors import PlotError
from nsmodel.plot import cells, style
from nsmodel.plot.sweep_map import sweep_map
from nsmodel.proof.verdict import not_none
from nsmodel.sweep.statistics import statistics
from nsmodel.sweep.variable import TIME_DIM, Over, Variable, as_variable

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MAX_ERROR_BARS = 12  # So many points have error bars, more a band.
MAX_SWEEP_LINES = 60
MAX_LEGEND_LINES = 8
SPREAD_QUANTILES = (0.05, 0.5, 0.95)
SHOW_OPTIONS = ("mean", "median", "spread")
ATOM_SHARE = 0.02  # A value that this part of the cells has is drawn as one.
ATOM_TOLERANCE = 1e-9  # Values nearer than this part of their range are one value.
MAX_SPIKE_RATIO = 3.0  # Times the tallest bar: spikes above are cut, so that bars can be seen.
CUT_LABEL = " (cut)"
NAMED_ATOMS = 3  # Atoms whose value the legend says.


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
    along = cells.required_dim(whole, x, "x")
    if hue is not None and (hue not in whole.dims or hue == along or x in whole.along):
        others = [dim for dim in whole.dims if dim != along]
        raise PlotError(f"hue={hue!r} beside x={x!r}: expected {' or '.join(others) if x in whole.dims else 'none'}")
    ax = style.get_axes(ax)
    if x in whole.along:
        return _draw_line_dots(ax, whole, x, along)
    found, where = cells.last_rows(whole, (x, hue or x))
    lines, axis = _sweep_lines(found, x, hue, over, show, level), cells.coordinate(found, x)
    many = style.evenly_spread(1 if hue is None else found.sizes[hue], MAX_SWEEP_LINES)
    colours, names = (
        style.colours(len(many)),
        [lines.description] if hue is None else [cells.coordinate_value_text(found, hue, k) for k in many],
    )
    handles = [_draw_line(ax, axis, lines, k, colour, name) for k, colour, name in zip(many, colours, names, strict=True)]
    style.dress(ax, _line_title(found, where, lines, hue, len(many)), axis.name, cells.quantity_label(found))
    axis.on(ax.xaxis)
    if cells.spans_decades(lines.centre):
        ax.set_yscale("log", nonpositive="clip")
    if not np.isfinite(lines.centre).any():
        cells.write_note(ax, "no cell has a result" if not found.done.any() else "no value is finite")
    _sweep_legend(ax, found, hue, handles, axis, np.any(lines.failed, axis=0, keepdims=True)[0] if x in found.cell_dims else None)
    return ax


def _default_x(variable: Variable, hue: str | None) -> str:
    """The dim along the axis where none is given."""
    dims = [dim for dim in (TIME_DIM, *cells.parameter_dims(variable), *variable.dims) if dim in variable.dims and dim != hue]
    if not dims:
        raise PlotError(f"{variable.name} has no dim to draw it over; its dims are {', '.join(variable.dims) or 'none'}")
    return dims[0]


def _line_title(variable: Variable, where: str, lines: _SweepLines, hue: str | None, drawn: int) -> str:
    description = f": {lines.description}" if hue and lines.description else ""
    return (
        f"{style.shorten(variable.title, 32)}{where}{description}"
        f"{style.selection_note(drawn, variable.sizes[hue], 'evenly spread') if hue else ''}"
    )


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
    named = ", ".join(dims)
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


def _draw_line(ax: Axes, axis: cells.Coordinate, lines: _SweepLines, k: int, colour: Any, name: str) -> Any:
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
    ax: Axes, variable: Variable, hue: str | None, handles: Sequence[Any], axis: cells.Coordinate, failed: np.ndarray | None
) -> None:  # fmt: skip
    """Name the lines, by a colour bar where they are many; mark where cells failed."""
    if failed is not None and failed.any():
        x = axis.places[failed[axis.order]]
        look: dict[str, Any] = {"color": style.ALERT, "clip_on": False, "zorder": 5}
        ax.plot(x, np.zeros(len(x)), "x", transform=ax.get_xaxis_transform(), markersize=5, **look)
    gone = cells.missing_result_handles(variable, marker="" if failed is None else "x")
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
    bar = not_none(ax.get_figure()).colorbar(scale, ax=ax, pad=0.02)
    ticks = style.evenly_spread(count, 7)
    bar.set_ticks(list(ticks), labels=[f"{values[k]:.4g}" for k in ticks])
    bar.set_label(style.safe_text(cells.coordinate_label(variable, hue)), fontsize=9)
    bar.ax.tick_params(labelsize=8, length=0)


def _draw_line_dots(ax: Axes, variable: Variable, x: str, along: str) -> Axes:
    """A dot a cell, over a coordinate of samples."""
    found, where = cells.last_rows(variable, ())
    at = [found.sizes[dim] if dim == along else 1 for dim in found.dims]
    places = np.broadcast_to(found.coords[x].astype(float).reshape(at), found.values.shape).ravel()
    done = found.done.ravel()
    rows = np.flatnonzero(done)
    rows = rows[style.evenly_spread(len(rows), style.MAX_POINTS)]
    y = found.values.ravel()[rows]
    dense = len(rows) > 500
    look = {"markersize": 2 if dense else 4, "alpha": 0.35 if dense else 0.8, "markeredgewidth": 0}
    ax.plot(places[rows], y, "o", color=style.LINES[0], rasterized=True, **look)
    note = style.selection_note(len(rows), int(done.sum()), "evenly spread")
    style.dress(
        ax,
        f"{style.shorten(found.title, 32)}{where}, a dot a cell{note}",
        cells.coordinate_label(found, x),
        cells.quantity_label(found),
    )
    if cells.spans_decades(y):
        ax.set_yscale("log")
    if cells.spans_decades(places):
        ax.set_xscale("log")
    if not rows.size:
        cells.write_note(ax, "no cell has a result")
    axis = cells.Coordinate("", np.arange(len(places)), places, None, False)
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
    found, where = cells.last_rows(as_variable(variable, "sweep_histogram"), ())
    ax = style.get_axes(ax)
    done = found.values[found.done].astype(float)
    values = np.sort(done[np.isfinite(done)])
    count = f"{done.size} cell{'s' if done.size != 1 else ''}"
    style.dress(ax, f"{style.shorten(found.title, 40)}{where}: {count}", cells.quantity_label(found), "share of the cells done")
    handles = []
    if values.size:
        log = cells.spans_decades(values)
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
        cells.write_note(ax, "no cell has a result" if not done.size else "no value is finite")
    handles += cells.missing_result_handles(found, marker="") + _not_finite_handle(done.size - values.size)
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


def _not_finite_handle(count: int) -> list[Any]:
    from matplotlib.lines import Line2D

    return [Line2D([], [], linestyle="", label=f"{count} not finite")] if count else []


# -- the picture that fits ---------------------------------------------------------------------------------------------


def sweep_overview(variable: Any, *, ax: Axes | None = None) -> Axes:
    """Draw the picture that fits a sweep.

    Of two parameters or more a map; of one a line over it, or over time where its values are few; of samples or seeds alone a
    histogram, or over time their median and spread.

    Args:
        variable: of a sweep, or an xarray.DataArray.
        ax: where to draw; a new figure by default.
    """
    whole = as_variable(variable, "sweep_overview")
    laid = [dim for dim in cells.parameter_dims(whole) if whole.sizes[dim] > 1] or cells.parameter_dims(whole)
    if len(laid) > 1:
        return sweep_map(whole, laid[0], laid[1], ax=ax)
    if laid:
        few = TIME_DIM in whole.dims and whole.sizes[laid[0]] <= MAX_LEGEND_LINES
        return sweep_line(whole, TIME_DIM, laid[0], ax=ax) if few else sweep_line(whole, laid[0], ax=ax)
    return sweep_line(whole, TIME_DIM, show="spread", ax=ax) if TIME_DIM in whole.dims else sweep_histogram(whole, ax=ax)
