"""Make the pictures and the table of docs/crowd.md: shortest ways, an evacuation by two exits, and its film.

Run it from anywhere; it writes docs/images/crowd_*.png and .gif, in less than a minute. With the argument 1000 it also runs and
draws a thousand people in front of one door, which takes longer.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from page import put, save

import nsmodel
from nsmodel import Trajectory, simulate
from nsmodel.crowd import DesiredVelocity, Room, crowd, desired_velocity, measure, place
from nsmodel.plot import animate
from nsmodel.plot import crowd as pictures

DOCS = Path(__file__).resolve().parents[1]
IMAGES = DOCS / "images"
INK, GREEN = "#30363D", "#009E73"
COLOURS = 96  # Of a picture.

sys.path.insert(0, str(DOCS.parent / "cases" / "crowds"))


def blank(width: float, height: float) -> Figure:
    """Return an empty figure that arranges its axes itself."""
    figure = Figure(figsize=(width, height), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.1, h_pad=0.1)
    return figure


def field(ax: Axes, room: Room, wanted: DesiredVelocity, title: str) -> None:
    """Lines of equal distance from the exits, and the directions."""
    distance, directions = wanted.distances[0], wanted.values[0]
    x, y = (wanted.origin[k] + wanted.spacing * np.arange(distance.shape[1 - k]) for k in (0, 1))
    ax.contour(x, y, distance, np.arange(0, 30), colors="#9CC9E3", linewidths=0.8)
    part = np.s_[4::5, 4::5]
    there = np.isfinite(distance[part])
    across, up = np.meshgrid(x, y)
    ax.quiver(
        across[part][there], up[part][there], *directions[part][there].T, color=INK, scale=45, width=0.0022, headwidth=4, zorder=3
    )
    for segments, colour in ((room.segments, INK), (room.doors, GREEN)):
        for ends in segments:
            ax.plot(*ends.T, color=colour, lw=2.2, solid_capstyle="round")
    ax.set(aspect="equal", xlim=(-0.4, 14.4), ylim=(-0.4, 9.4), xlabel="x [m]", ylabel="y [m]")
    ax.set_title(title, loc="left", fontsize=10, fontweight="bold", color=INK)
    ax.spines[["top", "right"]].set_visible(False)


def ways(room: Room) -> Figure:
    """The ways to the nearest exit, and to one of them."""
    figure = blank(10.5, 4.0)
    left, right = figure.subplots(1, 2)
    field(left, room, desired_velocity(room, 1), "To the nearest exit")
    field(right, room, desired_velocity(room, 1, to="east"), "To the east exit")
    return figure


def evacuation(run: Trajectory) -> Figure:
    """A moment, the curve, and two maps."""
    figure = blank(10.5, 7.0)
    grid = figure.subplots(2, 2)
    maps = measure.maps(run, end=float(np.nanmax(measure.evacuation_times(run))))
    pictures.frame(run, ax=grid[0, 0])
    pictures.evacuation(run, ax=grid[0, 1])
    pictures.density(maps, run, ax=grid[1, 0])
    pictures.pressure(maps, run, ax=grid[1, 1])
    return figure


def table(room: Room, run: Trajectory) -> str:
    """What passed each door."""
    lines = ["| exit | width | people | the last at | specific flow |", "| --- | --- | --- | --- | --- |"]
    for name in room.exits:
        out = measure.flow(run, room.way_out(name))
        times = out.times()
        lines.append(f"| {name} | {out.width:.1f} m | {len(times)} | {times[-1]:.1f} s | {out.specific():.1f} /(m s) |")
    return "\n".join(lines)


def thousand() -> None:
    """A thousand people in front of one door: three moments, and a film."""
    L, low, high = 19.2, 8.7, 10.5
    walls = [[(0, 0), (0, L)], [(0, 0), (L, 0)], [(0, L), (L, L)], [(L, 0), (L, low)], [(L, high), (L, L)]]
    room = Room(walls=walls, exits={"door": [(L, low), (L, high)]})
    run = simulate(crowd(room, place(room, 1000), t_end=84), save_every=5)
    figure = blank(11.5, 3.6)
    for ax, t in zip(figure.subplots(1, 3), (5, 30, 60), strict=True):
        pictures.frame(run, int(np.searchsorted(run.t, t - 1e-9)), ax=ax)
    save(figure, IMAGES / "crowd_1000.png", COLOURS, dpi=100)
    animate(run, IMAGES / "crowd_1000.gif", seconds=6, fps=8, size=(4.6, 3.9), dpi=72)


def main() -> None:
    """Write the pictures, the film and the table."""
    from evacuation import room

    run = simulate(nsmodel.load("evacuation"))
    save(ways(room), IMAGES / "crowd_ways.png", COLOURS)
    save(evacuation(run), IMAGES / "crowd_evacuation.png", COLOURS, dpi=90)
    animate(run, IMAGES / "crowd_evacuation.gif", seconds=9, fps=10, size=(5.4, 3.6), dpi=72)
    put("crowd.md", "doors", table(room, run))
    if "1000" in sys.argv[1:]:
        thousand()


if __name__ == "__main__":
    main()
