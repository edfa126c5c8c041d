"""Sweep a door's width for docs/sweeps.md, draw the times at which a room is empty, and write their table.

The model is the file ``room.py`` of the page. Run it from anywhere; it writes docs/images/sweeps_door.png. A minute on two cores.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from page import DOCS, model_file, put, save

import nsmodel
from nsmodel import StepError, Trajectory, statistics
from nsmodel.crowd import measure
from nsmodel.plot.style import LINES, blank, dress
from nsmodel.sweep import Sweep, Variable

WIDTHS = [0.6, 0.7, 0.8, 1.0, 1.2, 1.6]
SEEDS = 10


def empty(run: Trajectory) -> float:
    """When the last one has left."""
    times = measure.evacuation_times(run)
    if np.isnan(times).any():
        raise StepError(f"{np.isnan(times).sum()} people are still there at {run.t[-1]:g} s")
    return float(times.max())


def table(time: Variable) -> str:
    """A line for each width."""
    found = statistics(time, over="seed", quantiles=[])
    last = np.median(np.where(time.done, time.values, np.inf), axis=time.dims.index("seed"))
    lines = ["| door | empty in 30 s | their mean | standard error | median of all |", "| ---: | ---: | ---: | ---: | ---: |"]
    for i, width in enumerate(time.coords["width"]):
        count = f"{found.count[i]} of {SEEDS}"
        median = f"{last[i]:.1f} s" if np.isfinite(last[i]) else "later than 30 s"
        lines.append(f"| {width:g} m | {count} | {found.mean[i]:.1f} s | {found.error[i]:.1f} s | {median} |")
    return "\n".join(lines)


def picture(time: Variable, path: Path) -> None:
    """Each cell as a dot, means with their standard errors, failed cells at the upper edge."""
    figure = blank(7.2, 4.2)
    ax = figure.subplots()
    found = statistics(time, over="seed", quantiles=[])
    widths = time.coords["width"]
    rng = np.random.default_rng(0)
    spread = rng.uniform(-0.012, 0.012, time.values.shape)
    ax.plot(widths[:, None] + spread, time.values, ".", color=LINES[0], markersize=5, alpha=0.45)
    ax.errorbar(widths, found.mean, found.error, color=LINES[0], linewidth=1.4, capsize=4, marker="o", markersize=5)
    for width, failed in zip(widths, found.failed, strict=True):
        if failed:
            ax.annotate(
                f"{failed} of {SEEDS} not empty after 30 s", (width, 30), (6, -2), textcoords="offset points", color=LINES[1],
                fontsize=9, va="top",
            )  # fmt: skip
            ax.plot(width - 0.018 * np.arange(failed), np.full(failed, 30.0), "x", color=LINES[1], markersize=6, clip_on=False)
    dress(ax, "30 people leave a room: mean and standard error over 10 seeds", "width of the door [m]", "empty after [s]")
    ax.set(ylim=(0, 32), xlim=(0.5, 1.7))
    save(figure, path, 64)


def swept(place: Path) -> Sweep:
    """The sweep of the page's model."""
    path = place / "room.py"
    path.write_text(model_file("sweeps.md", path.name), encoding="utf-8")
    return nsmodel.sweep(path, grid={"width": WIDTHS}, seeds=SEEDS, outputs={"empty": empty}, progress=True)


def main() -> None:
    """Sweep, draw, write the table."""
    with tempfile.TemporaryDirectory() as place:
        found = swept(Path(place))
    print(found.summary_text())
    picture(found["empty"], DOCS / "images" / "sweeps_door.png")
    put("sweeps.md", "door", table(found["empty"]))


if __name__ == "__main__":
    main()
