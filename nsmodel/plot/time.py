"""Pictures over time: states, multipliers, inputs, outputs, residual, energy.

What goes up and down too often to be a line is drawn as a band of its extremes with its local mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from nsmodel._utils import DEFAULT_TOLERANCE
from nsmodel.errors import PlotError
from nsmodel.plot import rounding, style
from nsmodel.plot.rounding import is_rounding, output_is_rounding
from nsmodel.simulation.columns import quantity_at_step_ends, read_quantity
from nsmodel.simulation.run_data import input_names, multiplier_names, output_names, state_names

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

    from nsmodel.modeling.base import Model
    from nsmodel.simulation.trajectory import Trajectory

MAX_SWINGS = 150  # Ways from bottom to top that can be told apart beside each other: some four pixels each.
BAND_POINTS = 400  # Points of the band between lows and highs: every other pixel, so that its edge is no line of ink.
MEAN_POINTS = 8 * BAND_POINTS  # Of means, of which means are taken.
EXTREMA_PER_MEAN = 6  # A mean is over so many turns, twice: about a hundredth is left of what goes up and down.
EXTREMA_PER_BAND = 2.5  # Lows and highs in the time that one point of the band looks at: at least one of each.


def swing_count(values: np.ndarray) -> float:
    """How often values go from one end of their range to the other, in all; NaN left out."""
    known = _finite_values(values)
    span = np.ptp(known) if known.size else 0.0
    return float(np.abs(np.diff(known)).sum() / span) if span > 0 else 0.0


def turning_point_count(values: np.ndarray) -> int:
    """How often values go up after they went down, or down after up."""
    changes = np.diff(_finite_values(values))
    up = changes[changes != 0] > 0
    return int(np.count_nonzero(up[1:] != up[:-1]))


def _finite_values(values: np.ndarray) -> np.ndarray:
    finite = np.isfinite(values)
    return values if finite.all() else values[finite]


def draw_curve(ax: Axes, t: np.ndarray, values: np.ndarray, **look: Any) -> tuple[Line2D, float | None]:
    """Draw values over time: a thinned line; or a band and the mean, where a line would be a block of ink.

    Args:
        ax: where to draw.
        t: times (K,), not decreasing.
        values: (K,); with ``drawstyle="steps-pre"`` in ``look`` each holds from the time before to its own.
        look: of the line.

    Returns:
        The line, and the length of time that its means are over; None where it is the values themselves.
    """
    if swing_count(values) <= MAX_SWINGS or not t[-1] > t[0]:
        kept = style.thin(values)
        look |= {} if len(t) > 1 else {"marker": "o", "markersize": 4}
        return ax.plot(t[kept], values[kept], **look)[0], None
    count, length = turning_point_count(values), t[-1] - t[0]
    width = max(EXTREMA_PER_MEAN / count, 1 / BAND_POINTS) * length
    at, fine = (np.linspace(t[0], t[-1], n) for n in (BAND_POINTS, MEAN_POINTS))
    low, high = _windowed_extremes(t, values, at, max(EXTREMA_PER_BAND / count, 1 / BAND_POINTS) * length)
    ax.fill_between(at, low, high, color=look.get("color"), alpha=0.22, linewidth=0)
    held = look.pop("drawstyle", None) is not None
    middle = _windowed_mean(fine, _windowed_mean(t, values, fine, width, held=held), at, width, held=False)
    return ax.plot(at, middle, **look)[0], width


def means_note(widths: Sequence[float | None], unit: str) -> str:
    """What a title says of curves that are bands, of which `curve` returned these lengths; empty where there are none."""
    means = [width for width in widths if width is not None]
    if not means:
        return ""
    span = f"{min(means):.2g}" if max(means) < 1.1 * min(means) else f"{min(means):.2g} to {max(means):.2g}"
    return f": means over {span} {unit}".rstrip() + ", bands of extremes"


def _windowed_extremes(t: np.ndarray, values: np.ndarray, at: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """The smallest and the largest value around each time, the rows on both sides included."""
    first = np.maximum(np.searchsorted(t, at - width / 2) - 1, 0)
    stop = np.minimum(np.searchsorted(t, at + width / 2, side="right") + 1, len(t))
    bounds = np.stack([first, stop], axis=1).ravel()
    low = np.minimum.reduceat(np.append(np.nan_to_num(values, nan=np.inf), np.inf), bounds)[::2]
    high = np.maximum.reduceat(np.append(np.nan_to_num(values, nan=-np.inf), -np.inf), bounds)[::2]
    return np.where(np.isfinite(low), low, np.nan), np.where(np.isfinite(high), high, np.nan)


def _windowed_mean(t: np.ndarray, values: np.ndarray, at: np.ndarray, width: float, *, held: bool) -> np.ndarray:
    """The mean in time over ``width`` around each time, of what is there of it; ``held``: values hold from the time before."""
    middle = values[1:] if held else (values[1:] + values[:-1]) / 2
    known = np.isfinite(middle)
    length = np.where(known, np.diff(t), 0)
    left, right = np.maximum(at - width / 2, t[0]), np.minimum(at + width / 2, t[-1])

    def window_integral(part: np.ndarray) -> np.ndarray:
        total = np.concatenate([[0.0], np.cumsum(part)])
        return np.interp(right, t, total) - np.interp(left, t, total)

    known_length, whole = window_integral(length), window_integral(length * np.where(known, middle, 0))
    return np.divide(whole, known_length, out=np.full(len(at), np.nan), where=known_length > 0)


MAX_LINES = 12  # Lines of a picture; of more columns some, evenly spread: colours and styles that can be told apart.
MIN_RESIDUAL = 1e-20  # Residuals below are as good as 0: they would stretch the axis over empty decades.
# Each dash over the one before: lines that coincide stay visible.
DASHES: tuple[tuple[float, Any], ...] = ((2.4, "-"), (1.6, (0, (7, 3))), (1.6, (0, (3.5, 3.5))), (1.4, (0, (1.5, 1.5))))


def states(
    run: Trajectory, names: Sequence[str] | None = None, *, limit: int = MAX_LINES, model: Model | None = None,
    ax: Axes | None = None,
) -> Axes:  # fmt: skip
    """Draw the states over time.

    A run with more than `limit` states shows some, evenly spread, and the title says so; `names` may ask for more.
    Where two units are mixed (or, no units given, two very different sizes), the second has its axis on the right. What is 0
    to rounding is drawn as 0, and named so.

    Args:
        run: the run.
        names: names of states (`"q_0"`) or stems (`"q"`).
        limit: at most so many lines where `names` is left out.
        model: the run's, or None; with it what is rounding is told in any units (see `plot.rounding`).
        ax: where to draw; a new figure by default.

    Raises:
        PlotError: no state has that name.

    """
    run = run.smooth()
    known, note = state_names(run), ""
    discs = names is None and bool(run.metadata.get("scene"))
    if names is not None:
        picks = _state_columns(run, names)
    elif discs:  # x and y of a disc: one colour, two dashes
        bodies = style.evenly_spread(len(known) // 2, max(1, limit // 2))
        picks = np.stack([2 * bodies, 2 * bodies + 1], axis=1).ravel().tolist()
        note = style.selection_note(len(picks), len(known), "bodies evenly spread")
    else:
        picks = style.evenly_spread(len(known), limit).tolist()
        note = style.selection_note(len(picks), len(known), "evenly spread")
    paint = [colour for colour in style.colours(len(picks) // 2) for _ in "xy"] if discs else style.colours(len(picks))
    looks = [{"color": c, "linewidth": 1.5, "linestyle": "--" if discs and k % 2 else "-"} for k, c in enumerate(paint)]
    chosen = [known[k] for k in picks]
    units, still, off = [style.quantity_unit(run, name) for name in chosen], is_rounding(run, "x", model)[picks], None
    if "halving" in run.arrays:
        off, note = np.abs(run.arrays["halving"][:, picks]), f"{note}, bands: the difference from halved steps"
    return _draw_series(ax, run, f"States{note}", "state", _PlotColumns(run.x[:, picks], chosen, units, still, off), looks)


def _state_columns(run: Trajectory, wanted: Sequence[str]) -> list[int]:
    """Columns of the states and stems with these names."""
    names, stems = state_names(run), run.metadata.get("stems") or {}
    picks: list[int] = []
    for name in [wanted] if isinstance(wanted, str) else wanted:
        if name not in names and name not in stems:
            known = [*names[:20], *(["..."] if len(names) > 20 else []), *stems]
            raise PlotError(f"no state is called {name!r}; the states are {', '.join(known)}")
        picks += [names.index(name)] if name in names else list(stems[name])
    if not picks:
        raise PlotError("names is empty: give at least one state, or leave names out to see them all")
    return picks


def multipliers(
    run: Trajectory, *, which: str = "multipliers", limit: int = MAX_LINES, model: Model | None = None, ax: Axes | None = None
) -> Axes:  # fmt: skip
    """Draw the multipliers over time, each over the step it belongs to.

    Args:
        run: the run.
        which: "multipliers", or "reactions" (multipliers divided by the step).
        limit: at most so many lines; beyond, those that reach the most are shown and the title says so.
        model: the run's, or None; with it what is rounding is told in any units (see `plot.rounding`).
        ax: where to draw; a new figure by default.

    Raises:
        PlotError: the run has none.

    """
    if which not in ("multipliers", "reactions"):
        raise PlotError(f"which is {which!r}: give 'multipliers' or 'reactions'")
    run = run.smooth()
    values = style.array_columns(run, which) if which == "multipliers" else style.required_array(run, which)
    if not values.shape[1]:
        raise PlotError("this run has no multipliers: its model has no law")
    picks = _largest_positions(style.largest_magnitudes(values), limit)
    looks = [
        {"color": c, "drawstyle": "steps-pre", "linewidth": DASHES[k % 4][0], "linestyle": DASHES[k % 4][1]}
        for k, c in enumerate(style.colours(len(picks)))
    ]
    title = "Multipliers" if which == "multipliers" else "Reactions" if run.is_event_driven else "Reactions (multipliers / step)"
    title += style.selection_note(len(picks), values.shape[1], "the largest")
    names = [multiplier_names(run)[k] for k in picks]
    units = [style.quantity_unit(run, which if which == "reactions" else name) for name in names]
    drawn = _PlotColumns(values[:, picks], names, units, is_rounding(run, which, model)[picks])
    return _draw_series(ax, run, title, which[:-1], drawn, looks)


def inputs(run: Trajectory, *, limit: int = MAX_LINES, ax: Axes | None = None) -> Axes:
    """Draw the inputs over time, as each step sees them: from its begin to its end, with a jump where one follows another.

    Raises:
        PlotError: the run has none.

    """
    begin, end = style.required_array(run, "inputs_begin"), style.required_array(run, "inputs")
    known = input_names(run)
    picks = style.evenly_spread(len(known), limit).tolist()
    t = np.repeat(run.t, 2)[1:-1]
    values = np.stack([begin[1:], end[1:]], axis=1).reshape(t.size, -1)[:, picks]
    drawn = replace(run, arrays={**run.arrays, "t": t})
    names = [known[k] for k in picks]
    title = f"Inputs{style.selection_note(len(picks), len(known), 'evenly spread')}"
    units = [style.quantity_unit(run, name) for name in names]
    return _draw_series(ax, drawn, title, "input", _PlotColumns(values, names, units, np.zeros(len(names), bool)))


def outputs(run: Trajectory, names: Sequence[str] | None = None, *, limit: int = MAX_LINES, ax: Axes | None = None) -> Axes:
    """Draw the outputs of the model, and those that `run.evaluate` has added, over time: each step from its begin to its end.

    Args:
        run: the run.
        names: of outputs; left out: all.
        limit: at most so many lines where `names` is left out; beyond, those that reach the most are shown.
        ax: where to draw; a new figure by default.

    Raises:
        PlotError: the run has none, or none of that name.

    """
    known = output_names(run)
    wanted = list(known) if names is None else [names] if isinstance(names, str) else list(names)
    if unknown := [name for name in wanted if name not in known] or not wanted:
        what = f"no output is called {unknown[0]!r}" if isinstance(unknown, list) else "this run has no outputs"
        raise PlotError(f"{what}; give outputs={{name: expression}} to the model, or run.evaluate({{name: expression}})")
    entries, whole = [(name, entry) for name in wanted for entry in known[name]], run
    if run.is_event_driven or not len(run):
        run = run.smooth()
        values = np.column_stack([run.arrays[name].reshape(len(run.t), -1) for name in wanted])
    else:
        ends = [np.stack(quantity_at_step_ends(run, *read_quantity(run, name), 0, len(run)), axis=1) for name in wanted]
        values = np.column_stack([pair.reshape(2 * len(run), -1) for pair in ends])
        run = replace(run, arrays={**run.arrays, "t": np.repeat(run.t, 2)[1:-1]})
    picks = _largest_positions(style.largest_magnitudes(values), limit if names is None else len(entries)).tolist()
    units = [style.quantity_unit(run, entries[k][0]) for k in picks]
    title = f"Outputs{style.selection_note(len(picks), len(entries), 'the largest')}"
    tables = [(name, whole.arrays[name].reshape(len(whole.t), -1)) for name in wanted]
    still = np.concatenate([output_is_rounding(whole, name, table) for name, table in tables])
    drawn = _PlotColumns(values[:, picks], [entries[k][1] for k in picks], units, still[picks])
    return _draw_series(ax, run, title, "output", drawn)


def _largest_positions(size: np.ndarray, limit: int) -> np.ndarray:
    """Positions, in their order, of the largest sizes; of those that tie for the last places, some evenly spread."""
    cut = np.sort(size)[-min(limit, len(size))]
    above, ties = np.flatnonzero(size > cut), np.flatnonzero(size == cut)
    return np.sort(np.concatenate([above, ties[style.evenly_spread(len(ties), limit - len(above))]]))


class _PlotColumns(NamedTuple):
    """Columns (K, k) over time, their names and units, and which of them are rounding; half the width of a band about each."""

    values: np.ndarray
    names: Sequence[str]
    units: Sequence[str]
    still: np.ndarray
    off: np.ndarray | None = None


def _draw_series(
    ax: Axes | None,
    run: Trajectory,
    title: str,
    word: str,
    columns: _PlotColumns,
    looks: Sequence[dict[str, Any]] | None = None,
) -> Axes:
    """Draw columns over time, with units, with a second axis on the right where two units or sizes are mixed."""
    ax = style.get_axes(ax)
    looks = looks or [{"color": colour, "linewidth": 1.5} for colour in style.colours(len(columns.names))]
    names, units, values = columns.names, columns.units, columns.values
    values = np.where(columns.still, 0 * values, values) if columns.still.any() else values
    labels = [style.mark_rounding(style.shorten(name), own) for name, own in zip(names, columns.still, strict=True)]
    second = _second_axis_columns(values, units, columns.still)
    first, right = [k for k in range(len(names)) if k not in second], ax.twinx() if second else ax
    lines, widths = [], []
    for k, label in enumerate(labels):
        side, where = (right, " (right axis)") if k in second else (ax, "")
        label = style.with_unit(label, units[k]) if second or len(set(units)) > 1 else label
        line, width = draw_curve(side, run.t, values[:, k], label=style.safe_text(label + where), **looks[k])
        lines.append(line)
        widths.append(width)
        if columns.off is not None:
            low, high = values[:, k] - columns.off[:, k], values[:, k] + columns.off[:, k]
            side.fill_between(run.t, low, high, color=line.get_color(), alpha=0.22, linewidth=0)
    title += means_note(widths, style.quantity_unit(run, "t"))
    for side, group, heading in ((ax, first, title), (right, second, ""))[: 2 if second else 1]:
        few = ", ".join(labels[k] for k in group)
        few = few if len(few) <= 30 else f"{word}s"
        few = f"{word} of {few}" if len(names) == 1 and word not in ("state", "input", "output") else few
        unit = ", ".join(dict.fromkeys(units[k] for k in group if units[k]))
        style.dress_over_time(side, run, heading, style.with_unit(few, unit), grid=group is first)
        style.set_steady_limits(side, values if len(group) == len(names) else values[:, group])
        if second and len(group) == 1:
            side.yaxis.label.set_color(lines[group[0]].get_color())
    if second:
        right.spines["right"].set_visible(True)
    if len(names) > 1:
        style.legend(ax, lines, column=len(names) > 6)
    return ax


def _second_axis_columns(values: np.ndarray, units: Sequence[str], still: np.ndarray) -> list[int]:
    """Columns for an axis of their own: those in the second of two units; or, no units given, of a size 20 apart.

    What is ``still`` has none: it is 0 on any.
    """
    moving = np.flatnonzero(~still).tolist()
    kinds = list(dict.fromkeys(units[k] for k in moving))
    if not 2 <= len(moving) <= len(units) <= 6 or len(kinds) > 2:
        return []
    if len(kinds) == 2:
        return [k for k in moving if units[k] == kinds[1]]
    if kinds != [""]:
        return []
    size = style.largest_magnitudes(values[:, moving])
    small = (0 < size) & (20 * size <= size.max())
    return [k for k, other in zip(moving, small != small[0], strict=True) if other]


def residual(run: Trajectory, *, ax: Axes | None = None) -> Axes:
    """Draw the residual of each step on a logarithmic scale, with the tolerance it was accepted at.

    A residual of exactly 0 has no place on this scale, and one below 1e-20 says no more: they are drawn at the bottom, and an
    unknown one (inf) at the top; the legend counts them.
    """
    ax = style.get_axes(ax)
    t, values, tolerance = run.t[1:], style.required_array(run, "residual")[1:], run.metadata.get("tolerance")
    usual = np.isfinite(values) & (values > MIN_RESIDUAL)
    none = f"below {MIN_RESIDUAL:g}" if ((values > 0) & (values <= MIN_RESIDUAL)).any() else "exactly 0"
    marks = np.append(values[usual], tolerance or DEFAULT_TOLERANCE)
    low, high = min(marks.min(), 1e-15) / 30, marks.max() * 10
    handles = []
    for mask, drawn, marker, colour, label_format in (
        (usual, values, ".", style.LINES[0], "steps"),
        (values <= MIN_RESIDUAL, np.full(len(t), low * 1.6), "v", style.FREE, none + ": {}, at the bottom"),
        (np.isposinf(values), np.full(len(t), high / 1.6), "^", style.ALERT, "unknown: {}, at the top"),
    ):
        if mask.any():
            kept = np.flatnonzero(mask)[style.thin(drawn[mask])]
            label = label_format.format(f"{mask.sum()} of {len(t)}")
            handles += ax.plot(t[kept], drawn[kept], marker, color=colour, markersize=4, label=label)
    ax.set_yscale("log")
    ax.set_ylim(low, high)
    if tolerance:
        handles.append(ax.axhline(tolerance, color=style.ALERT, linewidth=1.2, label=f"tolerance {tolerance:.3g}"))
    style.dress_over_time(ax, run, "Residual", "residual, no unit")
    style.legend(ax, handles)
    return ax


def energy(run: Trajectory, *, model: Model | None = None, ax: Axes | None = None) -> Axes:
    """Draw the energy over time; of an event-driven run, with its ``model``, also between its rows, else on lines.

    Raises:
        PlotError: the run holds no energy.

    """
    style.required_array(run, "energy")
    run, lines = rounding.smooth_with_energy(run, model)
    values, ax = run.arrays["energy"], style.get_axes(ax)
    _, width = draw_curve(ax, run.t, values, color=style.LINES[0], linewidth=1.6)
    title = "Energy" + (f" ({rounding.ENERGY_ON_LINES})" if lines else "") + means_note([width], style.quantity_unit(run, "t"))
    style.dress_over_time(ax, run, title, style.label_with_unit(run, "energy"))
    style.set_steady_limits(ax, values)
    return ax
