"""Pictures and films of people in the plane: who is where and pressed how much, who left when, maps, flow through a door."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.errors import PlotError
from nsmodel.models.crowd.measure import Flow, Maps, evacuation_times, maps, positions, present
from nsmodel.plot import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from nsmodel.simulation.trajectory import Trajectory

PRESSURE_COLOURS = "YlOrBr"
CALM_COLOUR = "#B9CDE0"  # A disc of a run that knows no pressure.
DOOR_COLOUR = "#009E73"
MAX_CONTACT_WIDTH = 4.0  # Line of a contact at the end of the scale, points: thick beside other lines, thin beside a person.


# -- one moment --------------------------------------------------------------------------------------------------------


def frame(run: Trajectory, row: int | None = None, *, scale: float | None = None, ax: Axes | None = None) -> Axes:
    """Draw the people of a row: each disc in the colour of the pressure on it, a line for each contact, as wide as its reaction.

    Args:
        run: a run of many bodies in the plane, whose scene has radii.
        row: of the run; by default the one with most pressure in all.
        scale: pressure at the end of the colour scale; by default such that 99.5 % of those pressed in the run are below.
        ax: where to draw; a new figure by default.

    Raises:
        PlotError: a run without radii, or no such row.
    """
    row = row_of_most_pressure(run) if row is None else row
    if not -len(run.t) <= row < len(run.t):
        raise PlotError(f"row {row} does not exist: this run has rows 0 to {len(run.t) - 1}")
    row = range(len(run.t))[row]
    ax = style.get_axes(ax, 7, 6.5)
    people = CrowdArtists(ax, run, scale)
    people.show(row)
    here = int(present(run)[row].sum())
    style.dress(ax, f"{style.time_text(run, row)}: {here} {_bodies_noun(run)}", *plane_axis_labels(run), grid=False)
    return ax


class CrowdArtists:
    """Everything that a frame shows, on axes; ``show`` moves it to a row."""

    def __init__(self, ax: Axes, run: Trajectory, scale: float | None) -> None:
        from matplotlib.collections import EllipseCollection, LineCollection

        scene = _run_disc_scene(run)
        self.run, self.q, self.pressure = run, positions(run), run.arrays.get("pressure")
        self.radii, self.walls = np.array(scene["radii"], float), np.reshape(scene.get("walls", []), (-1, 2, 2))
        draw_room(ax, run)
        ax.set(aspect="equal")
        _fit_limits(ax, run)
        size = 2 * self.radii
        look = {
            "edgecolor": style.INK,
            "linewidth": min(0.7, 10 / np.sqrt(1 + self.radii.size)),
            "facecolor": CALM_COLOUR,
            "zorder": 4,
        }
        self.discs = EllipseCollection(
            size, size, np.zeros(size.size), units="xy", offsets=self.q[0], offset_transform=ax.transData, **look
        )
        self.lines = LineCollection([], colors=style.INK, zorder=5, capstyle="round")
        self.scale = pressure_scale(self.pressure) if scale is None else scale
        if self.pressure is not None:
            self.discs.set(cmap=PRESSURE_COLOURS, clim=(0, self.scale))
            style.colour_bar(ax, self.discs, style.with_unit("pressure", _pressure_unit(run)), shrink=0.75, extend="max")
        ax.add_collection(self.discs)
        ax.add_collection(self.lines)

    def show(self, row: int) -> None:
        """Move everything to a row."""
        q = self.q[row]
        self.discs.set_offsets(np.ma.masked_invalid(q))
        if self.pressure is None:
            return
        self.discs.set_array(np.nan_to_num(self.pressure[row]))
        if "contact_row" in self.run.arrays:
            lines, reactions = self._contact_lines(row)
            self.lines.set_segments(list(lines))
            self.lines.set_linewidth(np.clip(MAX_CONTACT_WIDTH * reactions / self.scale, 0.2, MAX_CONTACT_WIDTH).tolist())

    def _contact_lines(self, row: int) -> tuple[np.ndarray, np.ndarray]:
        """The lines (K, 2, 2) between those that touch: two people, or one and the nearest point of a wall; their reactions."""
        from nsmodel.models.crowd.geometry import nearest_points

        q, contacts = self.q[row], self.run.contacts(row)
        i, j = contacts.first, contacts.second
        other = np.full((len(i), 2), np.nan)
        pairs = np.array(self.run.metadata["of_pairs"], bool)[contacts.family]
        other[pairs] = q[j[pairs]]
        walls = np.flatnonzero(~pairs & (j >= 0) & (j < len(self.walls)))
        if walls.size:
            at = nearest_points(q[i[walls]], self.walls)[np.arange(walls.size), j[walls]]
            touches = np.linalg.norm(at - q[i[walls]], axis=1) < 1.1 * self.radii[i[walls]]
            other[walls[touches]] = at[touches]
        return np.stack([q[i], other], axis=1), contacts.reaction


def row_of_most_pressure(run: Trajectory) -> int:
    """The row with most pressure in all; the first one where there is none."""
    pressure = run.arrays.get("pressure")
    return 0 if pressure is None else int(np.nansum(pressure, axis=1).argmax())


def pressure_scale(pressure: np.ndarray | None) -> float:
    """The pressure that 99.5 % of those pressed are below, over all rows; 1 where nobody ever is."""
    pressed = np.zeros(0) if pressure is None else pressure[pressure > 0]
    return float(np.percentile(pressed, style.PRESSURE_PERCENTILE)) if pressed.size else 1.0


def draw_room(ax: Axes, run: Trajectory) -> None:
    """Draw the walls and exits that the run knows."""
    from matplotlib.collections import LineCollection

    scene = _run_disc_scene(run)
    for key, colour, width, dash in (("walls", style.INK, 2.5, "-"), ("exits", DOOR_COLOUR, 2.0, (0, (2, 1.5)))):
        lines = list(np.reshape(scene.get(key, []), (-1, 2, 2)))
        ax.add_collection(LineCollection(lines, colors=colour, linewidths=width, linestyles=[dash], zorder=3))


# -- over time ---------------------------------------------------------------------------------------------------------


def _bodies_noun(run: Trajectory) -> str:
    """What the bodies are called: people where the scene has exits."""
    return "people" if "exits" in run.metadata.get("scene", {}) else "bodies"


def evacuation(run: Trajectory, *, ax: Axes | None = None) -> Axes:
    """Draw how many people are there, and how many have left, over time."""
    ax = style.get_axes(ax)
    here, gone = present(run), np.sort(evacuation_times(run))
    gone = gone[np.isfinite(gone)]
    kept = style.thin(run.t, here.sum(axis=1))
    lines = ax.step(run.t[kept], here[kept].sum(axis=1), where="post", color=style.LINES[0], linewidth=1.6, label="there")
    times = np.concatenate([run.t[:1], gone, run.t[-1:]])
    count = np.concatenate([[0], np.arange(1, len(gone) + 1), [len(gone)]])
    lines += ax.step(times, count, where="post", color=style.LINES[1], linewidth=1.6, label="left")
    title = f"{len(gone)} of {here.shape[1]} {_bodies_noun(run)} left"
    if "window" in run.metadata:  # Who left before is of no interest.
        title = f"{len(gone)} of {int(here.any(axis=0).sum())} {_bodies_noun(run)} left after t = {run.t[0]:.4g}"
    title += f", the last at {gone[-1]:.4g} {style.quantity_unit(run, 't')}".rstrip() if len(gone) else ""
    style.dress_over_time(ax, run, title, _bodies_noun(run))
    ax.set_ylim(bottom=0)
    style.legend(ax, lines)
    return ax


def pressure_over_time(run: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """The largest pressure on anybody, and the mean over all who are there, (N+1,) each."""
    pressure = style.required_array(run, "pressure")
    count = np.isfinite(pressure).sum(axis=1)
    return np.fmax.reduce(pressure, axis=1), np.nansum(pressure, axis=1) / np.where(count, count, np.nan)


def pressures(run: Trajectory, *, ax: Axes | None = None) -> Axes:
    """Draw the largest pressure on anybody, and the mean over all who are there, over time."""
    ax, (largest, mean) = style.get_axes(ax), pressure_over_time(run)
    kept = style.thin(run.t, np.nan_to_num(largest))
    lines = ax.plot(run.t[kept], largest[kept], color=style.LINES[1], linewidth=0.8, label="largest")
    lines += ax.plot(run.t[kept], mean[kept], color=style.INK, linewidth=1.4, label="mean of all")
    style.dress_over_time(ax, run, "Pressure", style.with_unit("sum of reactions", _pressure_unit(run)))
    ax.set_ylim(bottom=0)
    style.legend(ax, lines)
    return ax


def flow(found: Flow, *, unit: str = "s", ax: Axes | None = None) -> Axes:
    """Draw how many people have crossed a segment, in both directions, over time."""
    ax = style.get_axes(ax)
    lines: list[Any] = []
    for forward, colour, word in ((True, style.LINES[0], "forward"), (False, style.LINES[1], "back")):
        times = found.times(forward)
        if len(times) or forward:
            label = f"{word}: {len(times)}"
            lines += ax.step(times, np.arange(1, len(times) + 1), where="post", color=colour, linewidth=1.6, label=label)
    rate = found.specific()
    title = "Flow" if np.isnan(rate) else f"Flow: {rate:.3g} people a {unit} and m"
    style.dress(ax, title, style.with_unit("t", unit), "people")
    ax.set_ylim(bottom=0)
    style.legend(ax, lines)
    return ax


def paths(run: Trajectory, *, ax: Axes | None = None) -> Axes:
    """Draw the way of each person, from dark (starts far from its end) to light."""
    from matplotlib.collections import LineCollection

    ax, q = style.get_axes(ax, 7, 6.5), positions(run)
    limit = max(20, 10 * style.MAX_POINTS // q.shape[1])
    rows = style.evenly_spread(len(q), limit)
    length = np.nansum(np.linalg.norm(np.diff(q, axis=0), axis=2), axis=0)
    lines = LineCollection([q[rows, k] for k in range(q.shape[1])], cmap="viridis_r", linewidths=0.7, zorder=2)
    lines.set_array(length)
    ax.add_collection(lines)
    style.colour_bar(ax, lines, "length of the way [m]", shrink=0.75)
    draw_room(ax, run)
    _fit_limits(ax, run)
    ax.set(aspect="equal")
    style.dress(ax, "Ways", *plane_axis_labels(run), grid=False)
    return ax


# -- maps --------------------------------------------------------------------------------------------------------------


def density(found: Maps, run: Trajectory | None = None, *, ax: Axes | None = None) -> Axes:
    """Draw the mean density, with the walls of the run."""
    return _draw_map(found, found.density, "Mean density", "people a square metre", "viridis", run, ax)


def pressure(found: Maps, run: Trajectory | None = None, *, ax: Axes | None = None) -> Axes:
    """Draw the mean pressure on those who were there, with the walls of the run."""
    if found.pressure is None:
        raise PlotError("these maps have no pressure: their run has no reactions")
    unit = _pressure_unit(run) if run is not None else ""
    return _draw_map(found, found.pressure, "Mean pressure", style.with_unit("sum of reactions", unit), PRESSURE_COLOURS, run, ax)


def velocity(found: Maps, run: Trajectory | None = None, *, ax: Axes | None = None) -> Axes:
    """Draw the mean velocity: its size as colour, its direction as arrows, with the walls of the run."""
    size = np.linalg.norm(found.velocity, axis=2)
    ax = _draw_map(found, size, "Mean velocity", "m/s", "cividis", run, ax)
    every = max(1, max(size.shape) // 30)
    cells = np.s_[every // 2 :: every, every // 2 :: every]
    x, y = np.meshgrid((found.x[:-1] + found.x[1:]) / 2, (found.y[:-1] + found.y[1:]) / 2)
    arrows = found.velocity[cells] / np.maximum(size[cells], 1e-12)[..., None]
    ax.quiver(x[cells], y[cells], arrows[..., 0], arrows[..., 1], color="white", scale=45, width=0.002, zorder=2)
    return ax


def _draw_map(found: Maps, values: np.ndarray, title: str, label: str, colours: str, run: Any, ax: Axes | None) -> Axes:
    ax = style.get_axes(ax, 7, 5.5)
    known = values[np.isfinite(values)]
    top = float(np.percentile(known, style.PRESSURE_PERCENTILE)) if known.size and known.max() > 0 else 1.0
    image = ax.pcolormesh(found.x, found.y, values, cmap=colours, vmin=0, vmax=top or float(known.max()), rasterized=True)
    style.colour_bar(ax, image, label, shrink=0.85, extend="max")
    ax.set(aspect="equal")
    if run is not None:
        draw_room(ax, run)
        _fit_limits(ax, run)
    style.dress(ax, title, *(plane_axis_labels(run) if run is not None else ("x [m]", "y [m]")), grid=False)
    return ax


# -- small -------------------------------------------------------------------------------------------------------------


def _run_disc_scene(run: Trajectory) -> dict[str, Any]:
    return check_disc_scene(run.metadata.get("scene"), run.x.shape[1])


def check_disc_scene(scene: Mapping[str, Any] | None, states: int) -> dict[str, Any]:
    """The scene of discs in the plane; PlotError where it is none, or has not two states for each."""
    if not scene or "radii" not in scene or states != 2 * len(scene["radii"]):
        raise PlotError("a run without discs in the plane: give the model scene={'radii': ..., 'walls': ..., 'exits': ...}")
    return dict(scene)


def _fit_limits(ax: Axes, run: Trajectory) -> None:
    low, high = scene_corners(run)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))


def scene_corners(run: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """The corners of what holds walls, exits and starts, and a margin; without walls wherever bodies are."""
    scene, q, here = _run_disc_scene(run), positions(run), present(run)
    fixed = [np.reshape(scene.get(key) or [], (-1, 2)) for key in ("walls", "exits")]
    own = q[here.argmax(axis=0), np.arange(q.shape[1])] if any(map(len, fixed)) else q.reshape(-1, 2)
    points = np.concatenate([*fixed, own])
    points = points[np.isfinite(points).all(axis=1)]  # Who never came has no start.
    points = points if len(points) else np.array([[0.0, 0.0], [1.0, 1.0]])
    margin = 0.03 * float(np.ptp(points, axis=0).max()) + 2 * max(scene["radii"])
    return points.min(axis=0) - margin, points.max(axis=0) + margin


def plane_axis_labels(run: Trajectory) -> list[str]:
    """The labels of the plane."""
    unit = style.quantity_unit(run, "q") or style.quantity_unit(run, "q_0") or "m"
    return [style.with_unit(name, unit) for name in "xy"]


def _pressure_unit(run: Trajectory) -> str:
    """Reactions m/h have the unit of a velocity."""
    length, time = style.quantity_unit(run, "q") or "m", style.quantity_unit(run, "t")
    return style.quantity_unit(run, "pressure") or (f"{length}/{time}" if time else "")


def panels(run: Trajectory, model: Any) -> dict[str, tuple[float, Callable[..., Axes]]]:
    """What a run in the plane can give, instead of what all runs do; maps where it knows a room with exits."""
    if "radii" not in (run.metadata.get("scene") or {}):
        return {}
    found: dict[str, tuple[float, Callable[..., Axes]]] = {
        "frame": (3.6, partial(frame, run)),
        "evacuation": (1.8, partial(evacuation, run)),
        "paths": (3.6, partial(paths, run)),
    }
    if len(run.metadata["scene"].get("exits", ())):
        measured = maps(run)
        for draw in (density, pressure, velocity):
            found[draw.__name__] = (2.2, partial(draw, measured, run))
    found["pressures"] = (1.4, partial(pressures, run))
    return found
