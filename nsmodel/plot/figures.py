"""Whole figures: the overview, and the files of a run; a run over a window of time for them."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel._utils import sum_in_order
from nsmodel.errors import PlotError
from nsmodel.files.archive import LIST_PREFIXES
from nsmodel.files.storage import replace_atomically
from nsmodel.plot import crowd, style
from nsmodel.plot.class_pictures import pictures_of
from nsmodel.plot.plane import phase
from nsmodel.plot.strips import MAX_ROWS, draw_chain, find_chains, has_profile, index_map, index_strip, profile, state_chains
from nsmodel.plot.time import MAX_LINES, energy, inputs, multipliers, outputs, residual, states
from nsmodel.proof.verdict import not_none
from nsmodel.simulation import windows
from nsmodel.simulation.run_data import model_type, output_names

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from nsmodel.simulation.trajectory import Trajectory

    FigurePanel = tuple[float, Callable[..., Axes]]  # height, what draws it on ax=

Window = tuple[float | None, float | None]
WINDOW_POINTS = 2000  # Rows of an event-driven run, which are read off its polynomials: more than a picture has pixels across.


def window(run: Trajectory, t: Window | None) -> Trajectory:
    """Return what pictures show of a run from t[0] to t[1]: its rows there; of an event-driven run, whose pieces may be long,
    about 2000 rows read off its polynomials.

    Args:
        run: the run.
        t: both ends; None for an end of the run. None: the whole run, as it is.

    Raises:
        PlotError: what is no pair of numbers; fewer than two rows between them.
        UsageError: a window outside the run, or one that ends before it begins.
    """
    if t is None:
        return run
    begin, end = windows.check_window(run, *_window_ends(t))
    kept = replace(run, metadata=run.metadata | {"window": [begin, end]})
    if "piece_x" in run.arrays and len(run.arrays["piece_start"]):
        return kept.smooth(WINDOW_POINTS, begin, end)
    first, stop = int(np.searchsorted(run.t, begin, "left")), int(np.searchsorted(run.t, end, "right"))
    if stop - first < 2:
        rows = f"the rows next to it are at t = {', '.join(f'{time:.6g}' for time in run.t[max(first - 1, 0) : stop + 1])}"
        raise PlotError(f"window t = {begin:.6g} to {end:.6g} holds {stop - first} rows, but a picture needs at least 2: {rows}")
    return replace(kept, arrays=_cut_arrays(run, first, stop))


def _window_ends(t: Any) -> Window:
    """Both ends as numbers or None."""
    try:
        begin, end = (None if one is None else float(one) for one in t)
    except (TypeError, ValueError):
        raise PlotError(f"t = {t!r}; expected a window (t0, t1), two numbers, or None for an end of the run") from None
    if any(one is not None and math.isnan(one) for one in (begin, end)):
        raise PlotError(f"t = {t!r}: nan is not a time; give None for an end of the run")
    return begin, end


def _cut_arrays(run: Trajectory, first: int, stop: int) -> dict[str, np.ndarray]:
    """The arrays of these rows; lists (see archive.LIST) of what belongs to them."""
    arrays = {name: array[first:stop] for name, array in run.arrays.items() if not name.startswith(LIST_PREFIXES)}
    if "contact_row" in run.arrays:
        part = slice(*np.searchsorted(run.arrays["contact_row"], [first, stop]))
        arrays |= {name: array[part] for name, array in run.arrays.items() if name.startswith("contact_")}
        arrays["contact_row"] = arrays["contact_row"] - first
    return arrays


TIME_PANELS = ("states", "outputs", "inputs", "index_strip", "multipliers", "reactions", "pressures")
CROWD_PANELS = (("frame", "evacuation"), ("density", "pressure", "pressures"))  # its overview, column by column
# file: (its panels, its width in inches, inches for a unit of height)
SHEETS = {
    "states": (("states", "index_strip"), 9, 1.2),
    "inputs": (("inputs",), 9, 1.9),
    "outputs": (("outputs",), 9, 1.9),
    "phase": (("phase",), 7, 1.75),
    "profile": (("profile",), 7, 1.75),
    "multipliers": (("multipliers", "reactions"), 9, 1.5),
    "energy": (("energy",), 9, 1.9),
    "configuration": (("configuration",), 8, 1.7),
    "frame": (("frame",), 8, 1.7),
    "evacuation": (("evacuation", "pressures"), 9, 1.5),
    "maps": (("density", "pressure", "velocity"), 8, 1.7),
    "paths": (("paths",), 8, 1.7),
}


def overview(run: Trajectory, model: Any = None, *, t: Window | None = None) -> Figure:
    """One figure of the whole run, 1400 x 900 pixels, composed of what the run holds.

    On the left, over a shared time axis: states, index set, multipliers, reactions. On the right: the configuration of
    a planar sweeping process (or else the profile of states in a row, or the phase portrait), the energy and the residual. Of
    many bodies in the plane: the moment of most pressure, how many are there, maps of density and pressure.

    Args:
        run: the run.
        model: its model, or None: then no configuration of one or two states.
        t: a window of time (t0, t1), None for an end of the run; left out: the whole run. See `window`.

    Raises:
        PlotError, UsageError: no such window.
    """
    run = window(run, t)
    figure, run = _titled_figure(run), run.smooth()
    panels = _panels(run, model, lines=8, rows=12)
    if "frame" in panels:
        return _crowd_overview(figure, panels)
    along = [name for name in panels if name.startswith("chain")]
    plane = [panels[name] for name in ("configuration", *reversed(along), "profile", "phase") if name in panels][:1]
    if len(along) > 1:
        panels["states"] = panels[along[0]]
    left = [panels[name] for name in TIME_PANELS if name in panels]
    checks = [panels[name] for name in ("energy", "residual") if name in panels]
    if plane:
        grid = figure.add_gridspec(1, 2, width_ratios=[1.15, 1])
        _stack_panels(figure, grid[0], left, shared=True)
        _stack_panels(figure, grid[1], plane + checks, shared=False)
    else:
        _stack_panels(figure, figure.add_gridspec(1, 1)[0], left + checks, shared=True)
    return figure


def thumbnail(run: Trajectory) -> Figure:
    """A figure of few lines: the states and the index set, or the moment of most pressure of many bodies."""
    panels = _panels(run.smooth(), None, lines=6, rows=4)
    names = ["frame"] if "frame" in panels else [name for name in ("states", "index_strip") if name in panels]
    figure = style.blank(5, 4.2) if "frame" in panels else style.blank(7, 2.4 + 0.8 * (len(names) - 1))
    _stack_panels(figure, figure.add_gridspec(1, 1)[0], [panels[name] for name in names], shared=True)
    return figure


def save_all(
    run: Trajectory, model: Any, directory: str | Path, prefix: str = "", *, t: Window | None = None
) -> list[Path]:  # fmt: skip
    """Write all pictures the run can give, each beside its place and then renamed; returns their paths.

    `states.png` (with the index set), `outputs.png`, `inputs.png`, `phase.png`, `multipliers.png`, `energy.png`,
    `configuration.png` (a planar sweeping process) and `overview.png`, each with `prefix` before its name; in place of
    `phase.png` it is `profile.png` where all states stand in a row, eight or more, and `space_time.png` where they are so many
    that they are a chain. Of many bodies in the plane `frame.png`, `evacuation.png`, `maps.png`, `paths.png` and
    `overview.png`.

    Args:
        run: the run.
        model: its model, or None: then no configuration of one or two states.
        directory: made where missing.
        prefix: put before each file name.
        t: a window of time, as in `overview`.

    """
    run = window(run, t)
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    smooth = run.smooth()
    panels = _panels(smooth, model, lines=MAX_LINES, rows=MAX_ROWS)
    draws: dict[str, Callable[[], Figure]] = {
        name: partial(_single_column_figure, smooth, [panels[part] for part in parts if part in panels], width, scale)
        for name, (parts, width, scale) in SHEETS.items()
        if parts[0] in panels or (name in TIME_PANELS and parts[-1] in panels)
    }
    if along := [panel for name, panel in panels.items() if name.startswith("chain")]:
        draws["space_time"] = partial(_single_column_figure, smooth, along, 9, 1.5)
    draws["overview"] = partial(overview, run, model)
    if "frame" in panels:  # Its maps are made but once.
        draws["overview"] = lambda: _crowd_overview(_titled_figure(run), panels)
    paths = []
    for name, draw in draws.items():
        paths.append(directory / f"{prefix}{name}.png")
        save(draw(), paths[-1])
    return paths


def save(figure: Figure, path: Path, dpi: int = 100) -> None:
    """Write a figure as PNG, beside its place and then renamed."""
    with replace_atomically(path) as part:
        figure.savefig(part, format="png", dpi=dpi)


def _panels(run: Trajectory, model: Any, *, lines: int, rows: int) -> dict[str, FigurePanel]:
    """What the run can give, with at most so many lines and rows of the index set."""
    plots = pictures_of(run)
    own = {} if plots is None else plots.panels(run, model)
    if "frame" in own:
        return own
    panels: dict[str, FigurePanel] = {"states": (2.6, partial(states, run, limit=lines, model=model)), **own}
    if "inputs" in run.arrays:
        panels["inputs"] = (1.4, partial(inputs, run, limit=lines))
    if output_names(run):
        panels["outputs"] = (2, partial(outputs, run, limit=lines))
    if bands := min(rows, style.array_columns(run, "index_set").shape[1]):
        panels["index_strip"] = (0.5 + 0.16 * bands, partial(index_strip, run, limit=rows))
        for name in ("reactions",) if run.is_event_driven and "reactions" in run.arrays else ("multipliers", "reactions"):
            if name in run.arrays:
                panels[name] = (2, partial(multipliers, run, which=name, limit=lines, model=model))
                if found := find_chains(run, name):
                    panels["index_strip"] = (2, partial(index_map, run))
                    panels[name] = (2, partial(draw_chain, run, found[0], heading=found[0].stem.capitalize()))
    if "pressure" in run.arrays:
        panels["pressures"] = (2, partial(crowd.pressures, run))
    if run.x.shape[1] > 1 or (model_type(run).second_order and "v" in run.arrays):
        panels["phase"] = (2.6, partial(phase, run, model=model))
    if has_profile(run):
        panels["profile"] = (2.6, partial(profile, run))
        del panels["phase"]
    if found := state_chains(run):
        del panels["phase"]
        panels |= {f"chain {k}": (2.2, partial(draw_chain, run, one)) for k, one in enumerate(found)}
    for name, draw in (("energy", partial(energy, model=model)), ("residual", residual)):
        if name in run.arrays:
            panels[name] = (1.6, partial(draw, run))
    return panels


def _titled_figure(run: Trajectory) -> Figure:
    """An empty overview."""
    figure = style.blank(14, 9)
    figure.suptitle(_wrapped_title(run, 110), fontsize=13, fontweight="bold", color=style.INK)
    figure.supxlabel(style.safe_text(_subtitle(run)), fontsize=9, color="#5B6570")
    return figure


def _crowd_overview(figure: Figure, panels: dict[str, FigurePanel]) -> Figure:
    """The overview of many bodies in the plane."""
    grid = figure.add_gridspec(1, 2, width_ratios=[1.15, 1])
    for k, names in enumerate(CROWD_PANELS):
        _stack_panels(figure, grid[k], [panels[name] for name in names if name in panels], shared=False)
    return figure


def _single_column_figure(run: Trajectory, panels: Sequence[FigurePanel], width: float, scale: float) -> Figure:
    """Build a titled figure of one column."""
    figure = style.blank(width, 1.5 + scale * sum_in_order(height for height, _ in panels))
    figure.suptitle(_wrapped_title(run, int(8 * width)), fontsize=12, fontweight="bold", color=style.INK)
    _stack_panels(figure, figure.add_gridspec(1, 1)[0], panels, shared=True)
    if any(ax.get_aspect() == 1 for ax in figure.axes):
        _fit_width(figure)
    return figure


def _fit_width(figure: Figure) -> None:
    """Make a figure no wider than what is on it: axes of one scale across and upwards leave room beside them."""
    figure.draw_without_rendering()
    boxes = [not_none(ax.get_tightbbox()) for ax in figure.axes]
    axes = max(box.x1 for box in boxes) - min(box.x0 for box in boxes)
    title = max(text.get_window_extent().width for text in figure.texts)
    margin = 0.35 * figure.dpi
    figure.set_figwidth(min(figure.get_figwidth(), (max(axes, title) + margin) / figure.dpi))


def _stack_panels(figure: Figure, spec: Any, panels: Sequence[FigurePanel], *, shared: bool) -> None:
    """Panels below each other; with a shared time axis only the lowest keeps its label."""
    grid = spec.subgridspec(len(panels), 1, height_ratios=[height for height, _ in panels])
    first: Axes | None = None
    for k, (_, draw) in enumerate(panels):
        ax = draw(ax=figure.add_subplot(grid[k], sharex=first if shared else None))
        first = first or ax
        if shared and k < len(panels) - 1:
            ax.set_xlabel("")
            ax.tick_params(labelbottom=False)


def _wrapped_title(run: Trajectory, width: int) -> str:
    """The title in at most two lines of so many letters."""
    title = str(run.metadata.get("title") or run.metadata.get("model_class") or run.title)
    return "\n".join(style.safe_text(line) for line in textwrap.wrap(title, width, max_lines=2, placeholder=" …"))


def _subtitle(run: Trajectory) -> str:
    """One line: the class, the number of steps or pieces, their lengths and how the run ended."""
    noun = "piece" if run.is_event_driven else "step"
    steps = run.arrays.get("step", np.zeros(0) if run.is_event_driven else np.diff(run.t, prepend=np.nan))
    steps, unit, size = steps[np.isfinite(steps)], style.quantity_unit(run, "t"), ""
    if len(steps):
        low, high = steps.min(), steps.max()
        ends = f"{low:.3g}", f"{high:.3g}"
        size = f"{high:.4g}" if high - low <= 1e-6 * high else "about " + ends[1] if ends[0] == ends[1] else " to ".join(ends)
        size = f"{noun} {size} {unit}".rstrip()
    status = f"status: {run.status}" if "status" in run.metadata else ""
    every = run.metadata.get("save_every", 1)
    kept = f"rows kept: one in {every}" if every > 1 else ""
    window = "t = {:.6g} to {:.6g}".format(*run.metadata["window"]) if "window" in run.metadata else ""
    window_note = f"shown: {window} {unit}".rstrip() if window else ""
    count = run.metadata.get("steps", len(run))
    parts = [run.metadata.get("model_class"), f"{count} {noun}{'s' * (count != 1)}", size, kept, window_note, status]
    return ", ".join(str(part) for part in parts if part)
