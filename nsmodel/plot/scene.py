"""A scene of discs and walls, with the pressure on each disc."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.errors import PlotError
from nsmodel.plot import style
from nsmodel.simulation.run_data import state_names

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from nsmodel.simulation.trajectory import Trajectory


def draw_discs(ax: Axes, run: Trajectory, scene: dict[str, Any], row: int) -> Axes:
    """Draw the discs, walls and paths so far of a row; each disc in the colour of the reactions on it."""
    from matplotlib.collections import EllipseCollection

    radii = np.array(scene["radii"], dtype=float)
    if run.x.shape[1] != 2 * len(radii):
        raise PlotError(f"the scene has {len(radii)} discs and the run {run.x.shape[1]} states: two a disc are needed")
    centres = run.x[row].reshape(-1, 2)
    present, pressure = np.isfinite(centres).all(axis=1), _body_pressures(run, len(radii), row)
    handles = _draw_surroundings(ax, run, scene, row)
    width = 2 * radii[present]
    look = {"edgecolor": style.INK, "linewidth": 0.7, "facecolor": "#B9CDE0", "zorder": 4}
    place = {"units": "xy", "offsets": centres[present], "offset_transform": ax.transData}
    circles = EllipseCollection(width, width, np.zeros(len(width)), **place, **look)
    if pressure is not None:
        circles.set(array=pressure[present], cmap="YlOrBr", clim=(0, float(pressure.max()) or 1.0))
        bar = ax.figure.colorbar(circles, ax=ax, shrink=0.75, pad=0.02)
        bar.set_label(style.with_unit("sum of reactions on a disc", style.quantity_unit(run, "reactions")), fontsize=9)
        bar.ax.tick_params(labelsize=8)
    ax.add_collection(circles)
    outside = _fit_window(ax, run, scene, centres)
    gone = f" ({outside} of {len(radii)} discs outside the picture)" if outside else ""
    unit = style.quantity_unit(run, state_names(run)[0])
    axes = [style.with_unit(name, unit) for name in "xy"]
    style.dress(ax, f"Configuration at {style.time_text(run, row)}{gone}", *axes, grid=False)
    style.legend(ax, handles)
    return ax


def _body_pressures(run: Trajectory, bodies: int, row: int) -> np.ndarray | None:
    """Sum of the reactions on each body; None where the run cannot tell."""
    owners, reactions = run.metadata.get("constraint_bodies"), run.arrays.get("reactions")
    if not owners or reactions is None or np.isnan(reactions[row]).any():
        return None
    total = np.zeros(bodies)
    for value, members in zip(reactions[row], owners, strict=True):
        total[members] += value
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
        look = {"color": colour, "linewidth": width, "zorder": 3, "label": word, "solid_capstyle": "round"}
        lines = [line for ends in scene.get(key, []) for line in ax.plot(*np.transpose(ends), dash, **look)]
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
