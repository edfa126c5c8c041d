"""Pictures in the plane: the phase portrait; where a sweeping process is and may not be; a scene of discs and walls."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.errors import PlotError
from nsmodel.plot import style
from nsmodel.plot.rounding import is_rounding
from nsmodel.plot.time import MAX_SWINGS, swing_count
from nsmodel.simulation.run_data import model_type, state_names

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from nsmodel.modeling.base import Model
    from nsmodel.simulation.trajectory import Trajectory

    GapFunction = Callable[..., np.ndarray]

# Points along each axis at which a set is looked at, in the plane of two states or over time: edges are smooth to the eye.
PLANE_GRID = 240


# -- phase portrait ----------------------------------------------------------------------------------------------------


def phase(
    run: Trajectory, i: int = 0, j: int | None = None, *, model: Model | None = None, ax: Axes | None = None
) -> Axes:  # fmt: skip
    """Draw the phase portrait of states i and j, with its start and its end.

    Args:
        run: the run.
        i: the state across.
        j: the state up; by default the velocity of i for an oscillator, else the next state that has another unit
            than i, or the next one.
        model: the run's, or None; with it what is 0 to rounding is told in any units (see `plot.rounding`).
        ax: where to draw; a new figure by default.

    Raises:
        PlotError: there is no such state, or only one.

    """
    run = run.smooth()
    x, (y, up, own) = run.x[:, _check_state(run, i)], _second_column(run, i, j)
    across, still = style.label_with_unit(run, state_names(run)[i]), is_rounding(run, "x", model)[i]
    x, across = (0 * x, style.mark_rounding(across, True)) if still else (x, across)
    if is_rounding(run, own[0], model)[own[1]]:
        y, up = 0 * y, style.mark_rounding(up, True)
    ax = style.get_axes(ax, 6, 5)
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y))  # a velocity may start a row later
    if not known.size:
        style.dress(ax, "Phase portrait: no row has finite values", across, up)
        return ax
    kept = known[style.thin(x[known], y[known])]
    crowded = max(swing_count(x), swing_count(y)) > MAX_SWINGS
    ax.plot(x[kept], y[kept], color=style.LINES[0], linewidth=0.4 if crowded else 1.2)
    style.dress(ax, "Phase portrait", across, up)
    style.set_steady_limits(ax, y[kept])
    style.set_steady_limits(ax, x[kept], axis="x")
    if y[kept].min() < 0 < y[kept].max():
        ax.axhline(0, color="#C4C9D0", linewidth=0.8, zorder=1)
    style.legend(ax, _draw_end_markers(ax, run, x, y, kept[0], kept[-1]))
    return ax


def _second_column(run: Trajectory, i: int, j: int | None) -> tuple[np.ndarray, str, tuple[str, int]]:
    """What a phase portrait has upwards, its label, and which column of which array it is."""
    n, names = run.x.shape[1], state_names(run)
    if j is None and model_type(run).second_order and "v" in run.arrays:
        length, time = style.quantity_unit(run, names[i]), style.quantity_unit(run, "t")
        unit = f"{length}/{time}" if length and time else ""
        return run.arrays["v"][:, i], style.with_unit(f"velocity of {style.shorten(names[i])}", unit), ("v", i)
    if n < 2:
        raise PlotError(f"a phase portrait needs two states, or a velocity; this run has only the state {names[0]}")
    if j is None:
        others = [(i + k) % n for k in range(1, n)]
        chosen = next((k for k in others if style.quantity_unit(run, names[k]) != style.quantity_unit(run, names[i])), others[0])
    else:
        chosen = _check_state(run, j)
    return run.x[:, chosen], style.label_with_unit(run, names[chosen]), ("x", chosen)


def _check_state(run: Trajectory, state: int) -> int:
    n = run.x.shape[1]
    if not 0 <= state < n:
        raise PlotError(f"state {state} does not exist: states are numbered 0 to {n - 1}")
    return state


def _draw_end_markers(ax: Axes, run: Trajectory, x: np.ndarray, y: np.ndarray, first: int, last: int) -> list[Any]:
    """Markers of the start and of the end, with their times."""
    end = "end" if last == len(run.t) - 1 else "now"
    handles: list[Any] = []
    for row, marker, fill, size, word in ((first, "o", "white", 7, "start"), (last, "s", style.INK, 5, end)):
        handles += ax.plot(
            x[row], y[row], marker, label=f"{word} ({style.time_text(run, row)})", markeredgecolor=style.INK,
            markerfacecolor=fill, markersize=size, zorder=5, clip_on=False,
        )  # fmt: skip
    return handles


# -- configuration -----------------------------------------------------------------------------------------------------


def draw_time_plane(ax: Axes, run: Trajectory, gap: GapFunction, row: int) -> Axes:
    """One state: the plane (t, q)."""
    ((low, high),) = margin_limits(run.x[:, 0], margin=0.25)
    times, values = np.meshgrid(np.linspace(run.t[0], run.t[-1], PLANE_GRID), np.linspace(low, high, PLANE_GRID))
    shade = _shade_forbidden(ax, times, values, gap(times, values), "forbidden (g < 0)")
    path = _draw_path(ax, run, run.t[: row + 1], run.x[: row + 1, 0])
    ax.set_ylim(low, high)
    style.dress_over_time(ax, run, "Configuration", style.label_with_unit(run, state_names(run)[0]), grid=False)
    style.legend(ax, [*path, *shade])
    return ax


def draw_state_plane(ax: Axes, run: Trajectory, gap: GapFunction, row: int, *, moving: bool) -> Axes:
    """Two states: the plane."""
    for margin in (0.25, 0.5, 1.0):  # far enough to see some of the forbidden set
        limits = style.fill_panel(ax, *margin_limits(*run.x.T, margin=margin))
        if (gap(run.t[row], *np.meshgrid(*(np.linspace(*limit, 40) for limit in limits))) < 0).mean() > 0.05:
            break
    across, up = np.meshgrid(*(np.linspace(*limit, PLANE_GRID) for limit in limits))
    shade = _shade_forbidden(ax, across, up, gap(run.t[row], across, up), f"forbidden at {style.time_text(run, row)}")
    if moving and row:
        earlier = style.evenly_spread(row + 1, 5)[:-1]
        for k in earlier:
            _draw_edge(ax, across, up, gap(run.t[k], across, up), colors=style.EARLIER, linewidths=0.9, linestyles="--")
        times = ", ".join(f"{run.t[k]:.3g}" for k in earlier)
        label = f"its edge at t = {times} {style.quantity_unit(run, 't')}".rstrip()
        shade += ax.plot([], [], "--", color=style.EARLIER, linewidth=0.9, label=label)
    path = _draw_path(ax, run, *run.x[: row + 1].T)
    ax.set(xlim=limits[0], ylim=limits[1], aspect="equal")
    style.dress(
        ax,
        f"Configuration at {style.time_text(run, row)}",
        *(style.label_with_unit(run, name) for name in state_names(run)),
        grid=False,
    )
    style.legend(ax, [*path, *shade])
    return ax


def margin_limits(*columns: np.ndarray, margin: float) -> list[tuple[float, float]]:
    """Limits around each column with a margin on both sides, none far narrower than the widest."""
    low, high = np.nanmin(columns, axis=1), np.nanmax(columns, axis=1)
    widest = (high - low).max() or 1.0
    reach = np.maximum(high - low, 0.6 * widest) * (0.5 + margin)
    return [(c - r, c + r) for c, r in zip((low + high) / 2, reach, strict=True)]


def _draw_path(ax: Axes, run: Trajectory, x: np.ndarray, y: np.ndarray) -> list[Any]:
    """Draw the path so far, coloured by contact, and its two ends."""
    from matplotlib.collections import LineCollection

    kept = style.thin(x, y)
    points, touching = np.stack([x[kept], y[kept]], axis=1), (style.array_columns(run, "index_set")[kept[1:]] == 0).any(axis=1)
    pieces = np.stack([points[:-1], points[1:]], axis=1)
    handles: list[Any] = []
    for mask, colour, width, label in ((~touching, style.FREE, 1.6, "free"), (touching, style.ZERO, 2.6, "in contact")):
        if mask.any():
            handles += ax.plot([], [], color=colour, linewidth=width, label=label)
            ax.add_collection(LineCollection(list(pieces[mask]), colors=colour, linewidths=width, capstyle="round"))
    return [*handles, *_draw_end_markers(ax, run, x, y, 0, len(x) - 1)]


def _shade_forbidden(ax: Axes, across: np.ndarray, up: np.ndarray, gap: np.ndarray, label: str) -> list[Any]:
    """Shades gap < 0 and draws its edge; the handle of the legend."""
    from matplotlib.patches import Patch

    if (gap < 0).any():
        ax.contourf(across, up, gap, levels=[float(gap.min()) - 1, 0], colors=[style.FORBIDDEN], zorder=0)
    _draw_edge(ax, across, up, gap, colors=style.EDGE, linewidths=1.4)
    return [Patch(facecolor=style.FORBIDDEN, edgecolor=style.EDGE, label=label)]


def _draw_edge(ax: Axes, across: np.ndarray, up: np.ndarray, gap: np.ndarray, **style: Any) -> None:
    if (gap < 0).any() and (gap > 0).any():
        ax.contour(across, up, gap, levels=[0], zorder=1, **style)


def draw_discs(ax: Axes, run: Trajectory, scene: dict[str, Any], row: int) -> Axes:
    """Draw the discs, walls and paths so far of a row; each disc in the colour of the reactions on it."""
    from matplotlib.collections import EllipseCollection

    radii = np.array(scene["radii"], dtype=float)
    if run.x.shape[1] != 2 * len(radii):
        raise PlotError(
            f"the scene has {len(radii)} discs and the run {run.x.shape[1]} states; expected two states for each disc"
        )
    centres = run.x[row].reshape(-1, 2)
    present, pressure = np.isfinite(centres).all(axis=1), body_pressures(run, np.array([row]), len(radii))
    handles = _draw_surroundings(ax, run, scene, row)
    width = 2 * radii[present]
    circles = EllipseCollection(
        width, width, np.zeros(len(width)), units="xy", offsets=centres[present], offset_transform=ax.transData,
        edgecolor=style.INK, linewidth=0.7, facecolor="#B9CDE0", zorder=4,
    )  # fmt: skip
    if pressure is not None and np.isfinite(pressure).all():
        circles.set(array=pressure[0, present], cmap="YlOrBr", clim=(0, float(pressure.max()) or 1.0))
        label = style.with_unit("sum of reactions on a disc", style.quantity_unit(run, "reactions"))
        style.colour_bar(ax, circles, label, shrink=0.75)
    ax.add_collection(circles)
    outside = _fit_window(ax, run, scene, centres)
    gone = f" ({outside} of {len(radii)} discs outside the picture)" if outside else ""
    unit = style.quantity_unit(run, state_names(run)[0])
    axes = [style.with_unit(name, unit) for name in "xy"]
    style.dress(ax, f"Configuration at {style.time_text(run, row)}{gone}", *axes, grid=False)
    style.legend(ax, handles)
    return ax


def body_pressures(run: Trajectory, rows: np.ndarray, bodies: int) -> np.ndarray | None:
    """The sum of the reactions on each body (rows, bodies); None where the run cannot tell."""
    if "pressure" in run.arrays:
        return run.arrays["pressure"][rows]
    owners, reactions = run.metadata.get("constraint_bodies"), run.arrays.get("reactions")
    if not owners or reactions is None:
        return None
    total = np.zeros((len(rows), bodies))
    for column, members in zip(reactions.T, owners, strict=True):
        total[:, members] += column[rows, None]
    return total


def _draw_surroundings(ax: Axes, run: Trajectory, scene: dict[str, Any], row: int) -> list[Any]:
    """Paths so far, starting points, walls and, where the scene names them, exits; the handles of the legend."""
    from matplotlib.collections import LineCollection

    paths, limit = run.x[: row + 1].reshape(row + 1, -1, 2), max(200, 10 * style.MAX_POINTS // run.x.shape[1])
    kept = [path[style.thin(*path.T, limit=limit)] for path in paths.transpose(1, 0, 2)]
    ax.add_collection(LineCollection(kept, colors=style.FREE, linewidths=0.7, alpha=0.8, zorder=1))
    handles = ax.plot([], [], color=style.FREE, linewidth=0.7, label="paths so far")
    handles += ax.plot(*paths[0].T, ".", color=style.FREE, markersize=3, zorder=2, label="starts")
    for key, colour, width, dash, word in (("walls", style.INK, 3.0, "-", "walls"), ("exits", "#009E73", 2.0, "--", "exit")):
        lines = [
            line
            for ends in scene.get(key, [])
            for line in ax.plot(
                *np.transpose(ends), dash, color=colour, linewidth=width, zorder=3, label=word, solid_capstyle="round"
            )
        ]
        handles += lines[:1]
    return handles


def _fit_window(ax: Axes, run: Trajectory, scene: dict[str, Any], now: np.ndarray) -> int:
    """Limits that hold the walls, all starts and the discs near them; the number of discs left outside."""
    radius, held = max(scene["radii"]), np.concatenate([run.x[0].reshape(-1, 2), np.reshape(scene.get("walls", []), (-1, 2))])
    low, high = np.nanmin(held, axis=0), np.nanmax(held, axis=0)
    far = max(0.5 * float((high - low).max()), 10 * radius)
    held = np.concatenate([held, now[((now >= low - far) & (now <= high + far)).all(axis=1)]])
    low, high = np.nanmin(held, axis=0) - 2 * radius, np.nanmax(held, axis=0) + 2 * radius
    limits = np.array(style.fill_panel(ax, *zip(low, high, strict=True)))
    ax.set(xlim=limits[0], ylim=limits[1], aspect="equal")
    return int(((now < limits[:, 0]) | (now > limits[:, 1])).any(axis=1).sum())
