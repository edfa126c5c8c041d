"""Sweeps over two parameters as maps."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.errors import PlotError
from nsmodel.plot import cells, style
from nsmodel.proof.verdict import not_none
from nsmodel.sweep.statistics import statistics
from nsmodel.sweep.variable import (
    CELL_DONE,
    CELL_FAILED,
    CELL_INTERRUPTED,
    CELL_NOT_RUN,
    CELL_REFUSED,
    STATUS_NAMES,
    Variable,
    as_variable,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
    found, where = cells.last_rows(as_variable(variable, "sweep_map"), (x or "", y or ""))
    laid = [dim for dim in (*cells.parameter_dims(found), *found.dims) if dim not in (x, y)]
    if len(laid) < (x is None) + (y is None):
        raise PlotError(f"{found.name} has the dims {', '.join(found.dims) or 'none'}; a map takes two, sweep_line one")
    x = laid.pop(0) if x is None else x
    y = next(dim for dim in laid if dim != x) if y is None else y
    along = [cells.required_dim(found, name, axis) for name, axis in ((x, "x"), (y, "y"))]
    ax = style.get_axes(ax, 7.0, 5.0)
    if along[0] == along[1] and x != y:
        return _draw_map_dots(ax, found, x, y, where)
    if along[0] == along[1] or x in found.along or y in found.along:
        raise PlotError(
            f"x={x!r}, y={y!r}: both lie along {' and '.join(along)}; expected two dims, or two coordinates of samples"
        )
    values, status, part, description = _map_cells(found, x, y)
    axes = [cells.coordinate(found, name) for name in (x, y)]
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
        look: dict[str, Any] = {"color": style.ALERT, "markeredgecolor": "white", "markersize": 5, "label": PARTIAL_LABEL}
        handles += ax.plot(axes[0].places[j], axes[1].places[i], "o", **look)
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
        values, description = of.mean.transpose([of.dims.index(dim) for dim in (y, x)]), f", mean over {', '.join(over)}"
    else:
        values, description = np.where(variable.done, variable.values, np.nan).transpose(order), ""
    return values, np.where(gone.all(axis=0), first, CELL_DONE), gone.any(axis=0) & ~gone.all(axis=0), description


def _cell_edges(axis: cells.Coordinate) -> np.ndarray:
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
    return LogNorm(low, high) if cells.spans_decades(values) else Normalize(low, high)


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
            handles.append(Patch(**{**look, "edgecolor": HATCH_COLOUR, "linewidth": 0.5}, label=label.format(i.size)))
    return handles


def _map_colour_bar(ax: Axes, mesh: Any, variable: Variable, values: np.ndarray) -> None:
    """The scale of colours; none where there is nothing to read on it."""
    if np.isfinite(values).any():
        bar = not_none(ax.get_figure()).colorbar(mesh, ax=ax, pad=0.02)
        bar.set_label(style.safe_text(cells.quantity_label(variable)), fontsize=9)
        bar.ax.tick_params(labelsize=8)
    else:
        cells.write_note(ax, "no cell has a result" if not variable.done.any() else "no value is finite")


def _draw_map_dots(ax: Axes, variable: Variable, x: str, y: str, where: str) -> Axes:
    """A dot a sample, over two coordinates of samples; crosses where there is no result."""
    along = variable.along.get(x, x)
    at = [variable.sizes[dim] if dim == along else 1 for dim in variable.dims]
    shape = variable.values.shape
    place = [np.broadcast_to(variable.coords[name].astype(float).reshape(at), shape).ravel() for name in (x, y)]
    done, values = variable.done.ravel(), variable.values.ravel().astype(float)
    rows = np.flatnonzero(done)
    rows = rows[style.evenly_spread(len(rows), style.MAX_POINTS)]
    look: dict[str, Any] = {
        "cmap": MAP_COLOURS,
        "norm": _colour_norm(values[done]),
        "s": 18 if len(rows) < 1000 else 6,
        "linewidths": 0,
    }
    dots = ax.scatter(place[0][rows], place[1][rows], c=values[rows], rasterized=True, **look)
    gone = np.flatnonzero(~done)
    gone = gone[
        style.evenly_spread(len(gone), -(-len(gone) * len(rows) // max(1, int(done.sum()))) if rows.size else style.MAX_POINTS)
    ]
    ax.plot(place[0][gone], place[1][gone], "x", color=style.ALERT, markersize=4 if len(gone) < 500 else 1.5, rasterized=True)
    note = style.selection_note(len(rows), int(done.sum()), "evenly spread")
    names = [cells.coordinate_label(variable, name) for name in (x, y)]
    style.dress(ax, f"{style.shorten(variable.title, 32)}{where}, a dot a cell{note}", *names)
    for axis, places in ((ax.set_xscale, place[0]), (ax.set_yscale, place[1])):
        if cells.spans_decades(places):
            axis("log")
    _map_colour_bar(ax, dots, variable, values[rows])
    if handles := cells.missing_result_handles(variable):
        style.legend(ax, handles)
    return ax
