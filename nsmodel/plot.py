"""Pictures of a run: each function takes a run, an optional `ax` to draw on, and returns the `ax` it drew on.

Matplotlib is imported inside the functions only, and figures are built without pyplot: nothing global is left behind
and no display is needed. Long runs are thinned to the smallest and the largest value of each bucket of rows, so no
extremum is lost. Row k of the multipliers and of the index set belongs to the step that *ends* at t_k, and is drawn
from t_{k-1} to t_k.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.errors import PlotError
from nsmodel.trajectory import multiplier_names, state_names, units_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from nsmodel.trajectory import Trajectory

    Panels = list[tuple[float, Callable[[Axes], Any]]]  # height, what draws the panel

MAX_POINTS = 20_000
MAX_LINES = 12
MAX_ROWS = 30
STRIP_COLUMNS = 1_400  # about half a pixel each
GRID = 240

LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#5E4FA2", "#4D4D4D")
LOWER, ZERO, UPPER, PALE = "#9CC9E3", "#2F5D8A", "#E3A857", "#DDE1E6"
INK, FREE, ALERT = "#30363D", "#8F9BAA", "#C8501E"
FORBIDDEN, EDGE, EARLIER = "#EADDCF", "#9A7B5F", "#C9B5A2"

# kind of law: {index-set code: (colour, words)}
WORDS: dict[str, dict[int, tuple[str, str]]] = {
    "complementarity": {-1: (PALE, "open (l = 0)"), 0: (ZERO, "contact (y = 0)")},
    "relay": {-1: (LOWER, "l at lower"), 0: (ZERO, "sticking / sliding (y = 0)"), 1: (UPPER, "l at upper")},
    "box": {-1: (LOWER, "l at lower"), 0: (ZERO, "l between its bounds (y = 0)"), 1: (UPPER, "l at upper")},
    "equality": {0: (ZERO, "equality (y = 0)")},
    "ball": {0: (ZERO, "l inside the ball (y = 0)"), 1: (UPPER, "l on the sphere")},
    "cone": {-1: (PALE, "open (l = 0)"), 0: (ZERO, "l inside the cone (y = 0)"), 1: (UPPER, "l on the cone")},
}


# ---------------------------------------------------------------- names, units, thinning


def _text(text: str) -> str:
    """Make `text` safe to draw: broken mathtext is shown as typed, a leading underscore does not hide a label."""
    from matplotlib.mathtext import MathTextParser

    text = f" {text}" if text.startswith("_") else text
    if "$" in text:
        try:
            MathTextParser("path").parse(text)
        except ValueError:
            return text.replace("$", r"\$")
    return text


def _short(name: str, width: int = 22) -> str:
    return name if len(name) <= width else f"{name[: width // 2 - 1]}…{name[-(width // 2) :]}"


def _array(run: Trajectory, name: str) -> np.ndarray:
    """Array with a column a multiplier or row; no columns where the run does not hold it."""
    return run.arrays.get(name, np.empty((len(run.t), 0)))


def _unit(run: Trajectory, name: str) -> str:
    return units_of(run).get(name, "")


def _with_unit(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


def _time_label(run: Trajectory) -> str:
    return _with_unit("t", _unit(run, "t"))


def _at(run: Trajectory, row: int) -> str:
    return _text(f"t = {run.t[row]:.4g} {_unit(run, 't')}".rstrip())


def _keep(*columns: np.ndarray, limit: int = MAX_POINTS) -> np.ndarray:
    """Rows to draw: all, or the first, the last and each column's smallest and largest in each bucket (<= limit)."""
    n = len(columns[0])
    if n <= limit:
        return np.arange(n)
    width = -(-n // max(1, limit // (2 * len(columns)) - 1))
    buckets = -(-n // width)
    kept = [np.array([0, n - 1])]
    for column in columns:
        padded = np.full(buckets * width, np.nan)
        padded[:n] = column
        table, first = padded.reshape(buckets, width), np.arange(buckets) * width
        kept.append(first + np.argmin(np.where(np.isnan(table), np.inf, table), axis=1))
        kept.append(first + np.argmax(np.where(np.isnan(table), -np.inf, table), axis=1))
    return np.unique(np.minimum(np.concatenate(kept), n - 1))


def _spread(count: int, limit: int) -> np.ndarray:
    """At most `limit` of 0..count-1, evenly spread, both ends kept."""
    return np.arange(count) if count <= limit else np.unique(np.linspace(0, count - 1, limit).round().astype(int))


def _of(shown: int, count: int, why: str) -> str:
    """Bracket for the title where not everything is shown."""
    return f" ({shown} of {count} shown, {why})" if shown < count else ""


def _extra(run: Trajectory, key: str, what: str) -> np.ndarray:
    if key not in run.arrays:
        raise PlotError(f"this run holds no {what}: its arrays are {', '.join(sorted(run.arrays))}")
    return np.asarray(run.arrays[key], dtype=float)


# ---------------------------------------------------------------- axes, legends, lines


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.1, h_pad=0.1, hspace=0.02, wspace=0.02)
    return figure


def _axes(ax: Axes | None, width: float = 8.0, height: float = 4.5) -> Axes:
    return _figure(width, height).add_subplot() if ax is None else ax


def _dress(ax: Axes, title: str, xlabel: str, ylabel: str) -> None:
    ax.set_title(_text(title), loc="left", fontsize=10, fontweight="bold", color=INK)
    ax.set_xlabel(_text(xlabel), fontsize=9)
    ax.set_ylabel(_text(ylabel), fontsize=9)
    ax.tick_params(labelsize=8)
    ax.grid(True, color="#E6E8EB", linewidth=0.6)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)


def _size(ax: Axes) -> tuple[float, float]:
    """Width and height of the axes in inches, before the layout leaves room for labels."""
    box = ax.get_position()
    width, height = ax.get_figure(root=True).get_size_inches()
    return box.width * width, box.height * height


def _legend(ax: Axes, handles: Sequence[Any], *, column: bool = False) -> None:
    """Put the legend beside the title where both fit, else in rows between title and axes; or outside on the right."""
    widths, (width, height) = [_entry(handle.get_label()) for handle in handles], _size(ax)
    style: dict[str, Any] = {"handles": handles, "fontsize": 8, "frameon": False, "borderaxespad": 0.2}
    title = ax.get_title(loc="left")
    if column:
        style |= {"fontsize": 7, "labelspacing": 0.3, "ncols": -(-len(handles) // max(1, int(height / 0.135)))}
        ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1), **style)
    elif 0.1 * len(title) + sum(widths) < width:
        ax.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=len(handles), columnspacing=1.2, **style)
    else:
        rows = next((n for n in range(1, len(widths)) if sum(_columns(widths, n)) < 1.15 * width), len(widths))
        ax.set_title(title, loc="left", fontsize=10, fontweight="bold", color=INK, pad=7 + 13 * rows)
        # the raised title already holds the room; a legend wider than the axes must not shrink them
        style |= {"ncols": len(_columns(widths, rows)), "columnspacing": 1.2}
        ax.legend(loc="lower left", bbox_to_anchor=(0, 1), **style).set_in_layout(False)


def _entry(label: str) -> float:
    """Width in inches of an entry of a legend, in letters of 8 points."""
    return 0.067 * (len(label) + 7)


def _columns(widths: Sequence[float], rows: int) -> list[float]:
    """Widths of the columns of a legend with so many rows, filled as matplotlib does: column by column."""
    columns = -(-len(widths) // rows)
    return [max(part) for part in np.array_split(widths, columns)]


def _colours(count: int) -> list[Any]:
    """Distinct colours for a few lines; a scale from dark to light for many, which are ordered (a chain, a crowd)."""
    if count <= len(LINES):
        return list(LINES[:count])
    from matplotlib import colormaps

    return [colormaps["viridis"](s) for s in np.linspace(0, 0.9, count)]


def _draw(ax: Axes, t: np.ndarray, column: np.ndarray, label: str, **style: Any) -> Any:
    """Draw one thinned line; a lone value becomes a dot."""
    kept = _keep(column)
    marker = "o" if np.isfinite(column).sum() == 1 else None
    return ax.plot(t[kept], column[kept], label=_text(label), marker=marker, markersize=4, **style)[0]


def _span(run: Trajectory, ax: Axes) -> None:
    """Set the time axis to the whole run and no more, the same for all its pictures."""
    if run.t[-1] > run.t[0]:
        ax.set_xlim(run.t[0], run.t[-1])


# ---------------------------------------------------------------- states


def _pick_states(run: Trajectory, wanted: Sequence[str] | None, limit: int) -> tuple[np.ndarray, str]:
    """Columns of the states to draw, and the words to add to the title when some are left out."""
    names, stems = state_names(run), run.metadata.get("stems") or {}
    if wanted is None:
        if run.metadata.get("scene"):
            bodies = _spread(len(names) // 2, max(1, limit // 2))
            picks = np.stack([2 * bodies, 2 * bodies + 1], axis=1).ravel()
            return picks, _of(len(picks), len(names), "bodies evenly spread")
        picks = _spread(len(names), limit)
        return picks, _of(len(picks), len(names), "evenly spread")
    picks = []
    for name in [wanted] if isinstance(wanted, str) else wanted:
        if name not in names and name not in stems:
            known = ", ".join([*names[:20], *(["..."] if len(names) > 20 else []), *stems])
            raise PlotError(f"no state is called {name!r}; the states are {known}")
        picks += [names.index(name)] if name in names else list(stems[name])
    if not picks:
        raise PlotError("names is empty: give at least one state, or leave names out to see them all")
    return np.array(picks), ""


def _second_axis(values: np.ndarray, units: Sequence[str]) -> list[int]:
    """Columns for an axis of their own: those in the second of two units; or, no units given, of a size 20 apart."""
    kinds = list(dict.fromkeys(units))
    if not 2 <= len(units) <= 6 or len(kinds) > 2:
        return []
    if len(kinds) == 2:
        return [k for k, unit in enumerate(units) if unit == kinds[1]]
    sizes = np.max(np.abs(np.nan_to_num(values, posinf=np.inf)), axis=0)
    if kinds != [""] or not np.all(np.isfinite(sizes)) or sizes.min() == 0:
        return []
    order = np.argsort(sizes)[::-1]
    drops = sizes[order[:-1]] / sizes[order[1:]]
    small = set(order[int(np.argmax(drops)) + 1 :].tolist()) if drops.max() >= 20 else set()
    return [k for k in range(len(units)) if (k in small) != (0 in small)]


def _series(
    run: Trajectory, ax: Axes, title: str, word: str, table: np.ndarray, names: Sequence[str], units: Sequence[str],
    looks: Sequence[dict[str, Any]],
) -> None:  # fmt: skip
    """Draw columns over time, with units, with a second axis on the right where two units or sizes are mixed."""
    labels, second = [_short(name) for name in names], _second_axis(table, units)
    mixed = bool(second) or len(set(units)) > 1  # then the legend says whose unit it is
    sides = [(ax, [k for k in range(len(names)) if k not in second], "")]
    sides += [(ax.twinx(), second, " (right axis)")] if second else []
    lines: dict[int, Any] = {}
    for side, group, where in sides:
        for k in group:
            label = (_with_unit(labels[k], units[k]) if mixed else labels[k]) + where
            lines[k] = _draw(side, run.t, table[:, k], label, **looks[k])
        known = ", ".join(dict.fromkeys(units[k] for k in group if units[k]))
        few = ", ".join(labels[k] for k in group) if len(group) <= 3 else f"{word}s"
        few = f"{word} of {few}" if len(names) == 1 and word != "state" else few
        _dress(side, "" if where else title, _time_label(run), _with_unit(few, known))
        if second and len(group) == 1:
            side.yaxis.label.set_color(lines[group[0]].get_color())
    if second:
        sides[1][0].grid(False)
        sides[1][0].spines["right"].set_visible(True)
    _span(run, ax)
    if len(names) > 1:
        _legend(ax, [lines[k] for k in range(len(names))], column=len(names) > 6)


def states(
    run: Trajectory, names: Sequence[str] | None = None, *, limit: int = MAX_LINES, ax: Axes | None = None
) -> Axes:
    """Draw the states over time.

    A run with more than `limit` states shows some, evenly spread, and the title says so; `names` may ask for more.
    Where two units are mixed (or, no units given, two very different sizes), the second has its axis on the right.

    Args:
        run: the run.
        names: names of states (`"q_0"`) or stems (`"q"`).
        limit: at most so many lines where `names` is left out.
        ax: where to draw; a new figure by default.

    Raises:
        PlotError: no state has that name.

    """
    picks, note = _pick_states(run, names, limit)
    paired = bool(run.metadata.get("scene")) and names is None  # x and y of a disc: one colour, two dashes
    colours = [c for c in _colours(len(picks) // 2) for _ in "xy"] if paired else _colours(len(picks))
    dashes = ["-", "--" if paired else "-"]
    looks = [{"color": c, "linewidth": 1.5, "linestyle": dashes[k % 2]} for k, c in enumerate(colours)]
    ax, chosen = _axes(ax), [state_names(run)[k] for k in picks]
    _series(run, ax, f"States{note}", "state", run.x[:, picks], chosen, [_unit(run, n) for n in chosen], looks)
    return ax


# ---------------------------------------------------------------- index set


def _most_changing(codes: np.ndarray, limit: int) -> np.ndarray:
    """Columns, in their order, with the most changes; ties go to those with most rows off their commonest code."""
    if codes.shape[1] <= limit:
        return np.arange(codes.shape[1])
    changes = np.count_nonzero(np.diff(codes, axis=0), axis=0)
    rare = len(codes) - np.max([np.count_nonzero(codes == c, axis=0) for c in (-2, -1, 0, 1)], axis=0)
    return np.sort(np.lexsort((np.arange(codes.shape[1]), -rare, -changes))[:limit])


def _shares(column: np.ndarray, codes: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """First row of each bucket, and the share of each code in it (codes, buckets).

    A run has a bucket a row, a long run at most STRIP_COLUMNS. There a code that occurs has a fourth of a bucket at
    least, so that no event is lost.
    """
    n = len(column) - 1
    starts = 1 + np.arange(min(n, STRIP_COLUMNS)) * n // max(1, min(n, STRIP_COLUMNS))
    if not n:
        return starts, np.zeros((len(codes), 0))
    shares = np.stack([np.add.reduceat((column == code).astype(float), starts) for code in codes])
    shares /= np.diff(np.r_[starts, n + 1])
    shares = np.where(shares > 0, np.maximum(shares, 0.25), 0)
    return starts, shares / np.maximum(1, shares.sum(axis=0))


def _band(ax: Axes, t: np.ndarray, column: np.ndarray, words: dict[int, tuple[str, str]], place: int) -> float:
    """Draw one row of the index set; a bucket that holds several codes is split. Returns the share of such buckets."""
    from matplotlib.collections import PolyCollection

    starts, shares = _shares(column, list(words))
    changes = np.flatnonzero(np.r_[True, (shares[:, 1:] != shares[:, :-1]).any(axis=0)]) if len(starts) else starts
    left, right = t[starts[changes] - 1], np.r_[t[starts[changes[1:]] - 1], t[-1:]]
    top = place + 0.38 - 0.76 * np.cumsum(shares[:, changes], axis=0)
    for k, (colour, _) in enumerate(words.values()):
        keep = shares[k, changes] > 0
        high, low = top[k, keep], top[k, keep] + 0.76 * shares[k, changes[keep]]
        corners = [(left[keep], low), (right[keep], low), (right[keep], high), (left[keep], high)]
        if keep.any():
            boxes = np.stack([np.stack(corner, axis=1) for corner in corners], axis=1)
            ax.add_collection(PolyCollection(list(boxes), facecolor=colour, linewidth=0, antialiased=False))
    return float(((shares > 0).sum(axis=0) > 1).mean()) if len(starts) else 0.0


def _strip_legend(ax: Axes, kinds: Sequence[str], *, split: bool) -> None:
    """Put the words of each kind of law present in the legend; the kind is named where there are several."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    present = list(dict.fromkeys(kinds))
    prefix = {kind: f"{kind}: " if len(present) > 1 and kind != "equality" else "" for kind in present}
    entries = [(c, prefix[kind] + words) for kind in present for c, words in WORDS[kind].values()]
    handles: list[Any] = [Patch(color=colour, label=label) for colour, label in entries]
    _legend(ax, handles + [Line2D([], [], linestyle="none", label="split band: changes within a pixel")] * split)


def index_strip(run: Trajectory, *, limit: int = MAX_ROWS, ax: Axes | None = None) -> Axes:
    """Draw the index set as a strip chart: one band a row, a colour for each of the law's states.

    Args:
        run: the run.
        limit: at most so many bands; beyond, those that change most are shown and the title says so.
        ax: where to draw; a new figure by default.

    Raises:
        PlotError: the run has no index set, or a kind of law is unknown.

    """
    codes = _array(run, "index_set")
    count = codes.shape[1]
    if not count:
        raise PlotError("this run has no index set: its model has no multipliers")
    kinds = list(run.metadata.get("law_kinds") or ["complementarity"] * count)
    if len(kinds) != count or set(kinds) - set(WORDS):
        raise PlotError(f"law_kinds must name one of {', '.join(WORDS)} for each of {count} rows, and is {kinds[:8]}")
    shown = _most_changing(codes[1:], limit)
    ax = _axes(ax, 8, 1.3 + 0.22 * len(shown))
    split = [_band(ax, run.t, codes[:, k], WORDS[kinds[k]], band) for band, k in enumerate(shown)]
    given = list(run.metadata.get("index_names") or [])
    names = given if len(given) == count else [f"row {k}" for k in range(count)]
    _dress(ax, "Index set" + _of(len(shown), count, "those that change most"), _time_label(run), "")
    size = min(8.0, max(5.0, 55 * _size(ax)[1] / len(shown)))
    ax.set_yticks(range(len(shown)), [_text(_short(names[k], 18)) for k in shown], fontsize=size)
    ax.set_ylim(len(shown) - 0.5, -0.5)
    ax.grid(False)
    ax.tick_params(axis="y", length=0)
    _span(run, ax)
    _strip_legend(ax, [kinds[k] for k in shown], split=max(split) > 0.05)
    return ax


# ---------------------------------------------------------------- phase, multipliers, residual, energy


def _ends(ax: Axes, run: Trajectory, row: int, first: Sequence[float], last: Sequence[float]) -> list[Any]:
    """Markers of the start and of the end, with their times."""
    end = "end" if row == len(run.t) - 1 else "now"
    handles: list[Any] = []
    for point, marker, fill, size, label in (
        (first, "o", "white", 7, f"start ({_at(run, 0)})"),
        (last, "s", INK, 5, f"{end} ({_at(run, row)})"),
    ):
        style = {"markerfacecolor": fill, "markeredgecolor": INK, "markersize": size, "linestyle": "none"}
        handles += ax.plot([point[0]], [point[1]], marker, label=label, zorder=5, clip_on=False, **style)
    return handles


def _phase_columns(run: Trajectory, i: int, j: int | None) -> tuple[np.ndarray, str, np.ndarray, str]:
    """Columns of a phase portrait, each with its axis label."""
    n, names = run.x.shape[1], state_names(run)
    speed = run.arrays.get("v") if j is None and run.metadata.get("model_class") == "FrictionOscillator" else None
    if speed is None and n < 2:
        raise PlotError(f"a phase portrait needs two states, or a velocity; this run has the state {names[0]} alone")
    second = i if speed is not None else (i + 1) % n if j is None else j
    for value in (i, second):
        if not 0 <= value < n:
            raise PlotError(f"state {value} does not exist: states are numbered 0 to {n - 1}")
    across = _with_unit(_short(names[i], 40), _unit(run, names[i]))
    if speed is None:
        up = _with_unit(_short(names[second], 40), _unit(run, names[second]))
        return run.x[:, i], across, run.x[:, second], up
    length, time = _unit(run, names[i]), _unit(run, "t")
    unit = _unit(run, "v") or (f"{length}/{time}" if length and time else "")
    return run.x[:, i], across, np.asarray(speed)[:, i], _with_unit(f"velocity of {_short(names[i])}", unit)


def phase(run: Trajectory, i: int = 0, j: int | None = None, *, ax: Axes | None = None) -> Axes:
    """Draw the phase portrait of states i and j, with its start and its end.

    Args:
        run: the run.
        i: the state across.
        j: the state up; by default the velocity of i for an oscillator, else the state after i.
        ax: where to draw; a new figure by default.

    Raises:
        PlotError: there is no such state, or only one.

    """
    x, across, y, up = _phase_columns(run, i, j)
    ax = _axes(ax, 6, 5)
    kept = _keep(x, y)
    ax.plot(x[kept], y[kept], color=LINES[0], linewidth=1.2)
    _dress(ax, "Phase portrait", across, up)
    ax.axhline(0, color="#C4C9D0", linewidth=0.8, zorder=1)
    _legend(ax, _ends(ax, run, len(x) - 1, (x[0], y[0]), (x[-1], y[-1])))
    return ax


def _largest(size: np.ndarray, limit: int) -> np.ndarray:
    """Positions, in their order, of the largest sizes; of those that tie for the last places, some evenly spread."""
    cut = np.sort(size)[-min(limit, len(size))]
    above, ties = np.flatnonzero(size > cut), np.flatnonzero(size == cut)
    return np.sort(np.concatenate([above, ties[_spread(len(ties), limit - len(above))]]))


def multipliers(run: Trajectory, *, which: str = "multipliers", limit: int = MAX_LINES, ax: Axes | None = None) -> Axes:
    """Draw the multipliers over time, each over the step it belongs to.

    Args:
        run: the run.
        which: "multipliers", or "reactions" (multipliers divided by the step).
        limit: at most so many lines; beyond, those that reach the most are shown and the title says so.
        ax: where to draw; a new figure by default.

    Raises:
        PlotError: the run has none.

    """
    if which not in ("multipliers", "reactions"):
        raise PlotError(f"which is {which!r}: give 'multipliers' or 'reactions'")
    values = _array(run, "multipliers") if which == "multipliers" else _extra(run, which, which)
    if not values.shape[1]:
        raise PlotError("this run has no multipliers: its model has no law")
    size = np.abs(np.nan_to_num(values)).max(axis=0)
    picks = _largest(size, limit)
    # thin dashes over thick lines: equal multipliers stay visible
    shapes = [{"linewidth": 2.2, "zorder": 2}, {"linewidth": 1.3, "zorder": 3, "linestyle": (0, (4, 2))}]
    looks = [{"color": c, "drawstyle": "steps-pre", **shapes[k % 2]} for k, c in enumerate(_colours(len(picks)))]
    title = "Multipliers" if which == "multipliers" else "Reactions (multipliers / step)"
    title += _of(len(picks), values.shape[1], "the largest")
    ax, names = _axes(ax), [multiplier_names(run)[k] for k in picks]
    units = [_unit(run, which if which == "reactions" else name) for name in names]
    _series(run, ax, title, which[:-1], values[:, picks], names, units, looks)
    return ax


def residual(run: Trajectory, *, ax: Axes | None = None) -> Axes:
    """Draw the residual of each step on a logarithmic scale, with the tolerance it was accepted at.

    A residual of exactly 0 has no place on this scale: it is drawn at the bottom, and an unknown one (inf) at the top;
    the legend counts them.
    """
    ax = _axes(ax)
    values, tolerance = _extra(run, "residual", "residual").copy(), run.metadata.get("tolerance")
    values[0] = np.nan
    usual = np.isfinite(values) & (values > 0)
    marks = np.append(values[usual], tolerance or [])
    low, high = (min(marks.min(), 1e-15) / 30, marks.max() * 10) if len(marks) else (1e-16, 1)
    handles = []
    for mask, place, marker, colour, words in (
        (usual, None, ".", LINES[0], "steps"),
        (values == 0, low * 1.6, "v", FREE, "exactly 0: {}, at the bottom"),
        (np.isposinf(values), high / 1.6, "^", ALERT, "unknown: {}, at the top"),
    ):
        if mask.any():
            t, v = run.t[mask], values[mask] if place is None else np.full(mask.sum(), place)
            kept = _keep(v)
            marker = "-" if len(kept) < len(v) and place is None else marker  # thinned: from least to largest
            label = words.format(f"{mask.sum()} of {max(1, len(values) - 1)}")
            handles += ax.plot(t[kept], v[kept], marker, color=colour, markersize=4, linewidth=0.7, label=label)
    ax.set_yscale("log")
    ax.set_ylim(low, high)
    if tolerance:
        handles.append(ax.axhline(tolerance, color=ALERT, linewidth=1.2, label=f"tolerance {tolerance:.3g}"))
    _dress(ax, "Residual", _time_label(run), "residual, no unit")
    _span(run, ax)
    _legend(ax, handles)
    return ax


def energy(run: Trajectory, *, ax: Axes | None = None) -> Axes:
    """Draw the energy over time.

    Raises:
        PlotError: the run holds no energy.

    """
    values = _extra(run, "energy", "energy")
    ax = _axes(ax)
    _draw(ax, run.t, values, "energy", color=LINES[0], linewidth=1.6)
    _dress(ax, "Energy", _time_label(run), _with_unit("energy", _unit(run, "energy")))
    _span(run, ax)
    return ax


# ---------------------------------------------------------------- configuration


def configuration(run: Trajectory, model: Any = None, row: int = -1, *, ax: Axes | None = None) -> Axes:
    """Draw where a sweeping process is, and where it may not be.

    One state: the plane (t, q) with the forbidden set shaded. Two: the plane with the forbidden set at the time of
    `row`, its boundary at some earlier times, and the path so far. A scene of discs: the discs, walls and paths so far.

    Args:
        run: the run of a `SweepingProcess`.
        model: its model with numbers for all parameters: `t`, `q` (CasADi SX) and `constraints`, each >= 0. A scene
            can do without.
        row: the row of the run shown; the last by default.
        ax: where to draw; a new figure by default.

    Raises:
        PlotError: another class of model, more than two states and no scene, no model, or no such row.

    """
    n, rows, scene = run.x.shape[1], len(run.t), run.metadata.get("scene")
    kind = run.metadata.get("model_class")
    if kind != "SweepingProcess":
        raise PlotError(f"a configuration is drawn for a SweepingProcess, and this run is of a {kind}")
    if not -rows <= row < rows:
        raise PlotError(f"row {row} does not exist: this run has rows 0 to {rows - 1}")
    if not scene and n > 2:
        raise PlotError(f"a configuration needs one state, two, or a scene of discs; this run has {n} and no scene")
    if not scene and model is None:
        raise PlotError("the forbidden set is drawn from the constraints: give the model as well")
    row %= rows
    if scene:
        return _discs(_axes(ax, 7, 6.5), run, scene, row)
    gap = _Gap(model, n)
    if n == 1:
        return _line_set(_axes(ax, 8, 5), run, gap, row)
    return _plane_set(_axes(ax, 7, 6.5), run, gap, row)


class _Gap:
    """min_i g_i(t, q) on many points at once: negative where q is forbidden."""

    def __init__(self, model: Any, n: int) -> None:
        import casadi as ca

        stack = ca.vertcat(*model.constraints.values()) if model.constraints else ca.SX(np.inf)
        if model.q.numel() != n:
            raise PlotError(f"the model has {model.q.numel()} states and the run {n}: they do not belong together")
        free = [s.name() for s in ca.symvar(stack) if not ca.depends_on(ca.vertcat(model.t, ca.vec(model.q)), s)]
        if free:
            raise PlotError(f"the constraints still hold {', '.join(free)}: bind the parameters to numbers first")
        self.moving = ca.depends_on(stack, model.t)
        self._function = ca.Function("g", [model.t, model.q], [ca.mmin(stack)])

    def __call__(self, t: np.ndarray | float, *q: np.ndarray) -> np.ndarray:
        points = np.stack([part.ravel() for part in q])
        times = np.broadcast_to(np.asarray(t, dtype=float), q[0].shape).reshape(1, -1)
        values = np.asarray(self._function.map(points.shape[1])(times, points))
        return np.ma.masked_invalid(values.reshape(q[0].shape))


def _window(*columns: np.ndarray, share: float = 0.25, slim: float = 0.0) -> list[tuple[float, float]]:
    """Limits around the finite values of each column, widened by a share; none below `slim` times the widest."""
    ends = [(np.nanmin(c), np.nanmax(c)) if np.isfinite(c).any() else (0.0, 1.0) for c in columns]
    widest = max(b - a for a, b in ends) or max(1.0, *(abs(a) for a, _ in ends))
    halves = [max((b - a) / 2, slim * widest / 2) or widest / 2 for a, b in ends]
    reach = [half * (1 + 2 * share) for half in halves]
    return [((a + b) / 2 - r, (a + b) / 2 + r) for (a, b), r in zip(ends, reach, strict=True)]


def _fill(ax: Axes, *limits: tuple[float, float]) -> list[tuple[float, float]]:
    """Widen one of two limits, so that a picture of equal scales fills its panel."""
    spans, panel = [b - a for a, b in limits], np.array([1.1, 0.9]) * _size(ax)
    scale = max(span / max(size, 0.5) for span, size in zip(spans, panel, strict=True))
    more = [max(0.0, min(scale * size, 2 * span) - span) / 2 for span, size in zip(spans, panel, strict=True)]
    return [(a - m, b + m) for (a, b), m in zip(limits, more, strict=True)]


def _touching(run: Trajectory) -> np.ndarray:
    """Rows whose step ended with an inequality in contact."""
    codes = _array(run, "index_set")
    kinds = list(run.metadata.get("law_kinds") or ["complementarity"] * codes.shape[1])
    columns = [k for k, kind in enumerate(kinds) if kind != "equality"]
    return (codes[:, columns] == 0).any(axis=1)


def _path(ax: Axes, run: Trajectory, x: np.ndarray, y: np.ndarray) -> list[Any]:
    """Draw the path so far, coloured by contact, and its two ends."""
    from matplotlib.collections import LineCollection

    kept = _keep(x, y)
    points, touching = np.stack([x[kept], y[kept]], axis=1), _touching(run)[kept[1:]]
    pieces = np.stack([points[:-1], points[1:]], axis=1)
    handles: list[Any] = []
    for mask, colour, width, words in ((~touching, FREE, 1.6, "free"), (touching, ZERO, 2.6, "in contact")):
        if mask.any():
            handles += ax.plot([], [], color=colour, linewidth=width, label=words)
            ax.add_collection(LineCollection(list(pieces[mask]), colors=colour, linewidths=width, capstyle="round"))
    return [*handles, *_ends(ax, run, len(x) - 1, points[0], points[-1])]


def _shade(ax: Axes, across: np.ndarray, up: np.ndarray, gap: np.ndarray, label: str) -> list[Any]:
    """Shades gap < 0 and draws its edge; the handle of the legend."""
    from matplotlib.patches import Patch

    if (gap < 0).any():
        ax.contourf(across, up, gap, levels=[float(gap.min()) - 1, 0], colors=[FORBIDDEN], zorder=0)
    _edge(ax, across, up, gap, colors=EDGE, linewidths=1.4)
    return [Patch(facecolor=FORBIDDEN, edgecolor=EDGE, label=label)]


def _edge(ax: Axes, across: np.ndarray, up: np.ndarray, gap: np.ndarray, **style: Any) -> None:
    if (gap < 0).any() and (gap > 0).any():
        ax.contour(across, up, gap, levels=[0], zorder=1, **style)


def _line_set(ax: Axes, run: Trajectory, gap: Callable[..., np.ndarray], row: int) -> Axes:
    """One state: the plane (t, q)."""
    name = state_names(run)[0]
    (low, high), end = _window(run.x[:, 0])[0], max(run.t[-1], run.t[0] + 1e-300)
    times, values = np.meshgrid(np.linspace(run.t[0], end, GRID), np.linspace(low, high, GRID))
    shade = _shade(ax, times, values, gap(times, values), "forbidden (g < 0)")
    path = _path(ax, run, run.t[: row + 1], run.x[: row + 1, 0])
    ax.set_ylim(low, high)
    _dress(ax, "Configuration", _time_label(run), _with_unit(_short(name, 40), _unit(run, name)))
    ax.grid(False)
    _span(run, ax)
    _legend(ax, [*path, *shade])
    return ax


def _plane_set(ax: Axes, run: Trajectory, gap: Any, row: int) -> Axes:
    """Two states: the plane."""
    names, x, y = state_names(run), run.x[: row + 1, 0], run.x[: row + 1, 1]
    xlim, ylim = _plane_window(ax, run, gap, row)
    across, up = np.meshgrid(np.linspace(*xlim, GRID), np.linspace(*ylim, GRID))
    handles = _shade(ax, across, up, gap(run.t[row], across, up), f"forbidden at {_at(run, row)}")
    if gap.moving and row:
        earlier = _spread(row + 1, 5)[:-1]
        for k in earlier:
            _edge(ax, across, up, gap(run.t[k], across, up), colors=EARLIER, linewidths=0.9, linestyles="--")
        times = ", ".join(f"{run.t[k]:.3g}" for k in earlier)
        label = f"its edge at t = {times} {_unit(run, 't')}".rstrip()
        handles += ax.plot([], [], "--", color=EARLIER, linewidth=0.9, label=label)
    handles = [*_path(ax, run, x, y), *handles]
    ax.set_xlim(xlim)
    ax.set_ylim(ylim)
    ax.set_aspect("equal")
    labels = [_with_unit(_short(name, 40), _unit(run, name)) for name in names]
    _dress(ax, f"Configuration at {_at(run, row)}", *labels)
    ax.grid(False)
    _legend(ax, handles)
    return ax


def _plane_window(ax: Axes, run: Trajectory, gap: Any, row: int) -> list[tuple[float, float]]:
    """Limits around the path, wide enough to see some of the forbidden set where it is near."""
    for share in (0.25, 0.5, 1.0, 0.25):
        limits = _fill(ax, *_window(run.x[:, 0], run.x[:, 1], share=share, slim=0.6))
        if (gap(run.t[row], *np.meshgrid(*(np.linspace(a, b, 40) for a, b in limits))) < 0).mean() > 0.05:
            break
    return limits


def _pressure(run: Trajectory, bodies: int, row: int) -> tuple[np.ndarray | None, str]:
    """Sum of the reactions on each body, and its label; None where the run cannot tell."""
    which = "reactions" if "reactions" in run.arrays else "multipliers"
    owners, values = run.metadata.get("constraint_bodies"), _array(run, which)[row].astype(float)
    if not owners or len(owners) != len(values) or np.isnan(values).all():
        return None, ""
    total = np.zeros(bodies)
    for value, members in zip(np.nan_to_num(values), owners, strict=True):
        total[list(members)] += value
    return total, _with_unit(f"sum of {which} on a disc", _unit(run, which))


def _discs(ax: Axes, run: Trajectory, scene: dict[str, Any], row: int) -> Axes:
    """Draw a scene of discs and walls."""
    from matplotlib.collections import EllipseCollection

    radii = np.asarray(scene["radii"], dtype=float)
    if run.x.shape[1] != 2 * len(radii):
        raise PlotError(f"the scene has {len(radii)} discs and the run {run.x.shape[1]} states: two a disc are needed")
    centres, present = run.x[row].reshape(-1, 2), np.isfinite(run.x[row].reshape(-1, 2)).all(axis=1)
    handles = _surroundings(ax, run, scene, row)
    pressure, label = _pressure(run, len(radii), row)
    width = 2 * radii[present]
    look = {"edgecolor": INK, "linewidth": 0.7, "facecolor": "#B9CDE0", "zorder": 4}
    place = {"units": "xy", "offsets": centres[present], "offset_transform": ax.transData}
    discs = EllipseCollection(width, width, np.zeros(len(width)), **place, **look)
    if pressure is not None:
        discs.set(array=pressure[present], cmap="YlOrBr", clim=(0, float(pressure.max()) or 1.0))
        bar = ax.figure.colorbar(discs, ax=ax, shrink=0.75, pad=0.02)
        bar.set_label(label, fontsize=9)
        bar.ax.tick_params(labelsize=8)
    ax.add_collection(discs)
    outside = _scene_window(ax, run, scene, row)
    gone = f" ({outside} of {len(radii)} discs outside the picture)" if outside else ""
    unit = _unit(run, state_names(run)[0])
    _dress(ax, f"Configuration at {_at(run, row)}{gone}", _with_unit("x", unit), _with_unit("y", unit))
    ax.grid(False)
    ax.set_aspect("equal")
    _legend(ax, handles)
    return ax


def _surroundings(ax: Axes, run: Trajectory, scene: dict[str, Any], row: int) -> list[Any]:
    """Paths so far, starting points, walls and, where the scene names them, exits; the handles of the legend."""
    from matplotlib.collections import LineCollection

    paths, limit = run.x[: row + 1].reshape(row + 1, -1, 2), max(200, 10 * MAX_POINTS // max(1, run.x.shape[1]))
    kept = [path[_keep(path[:, 0], path[:, 1], limit=limit)] for path in paths.transpose(1, 0, 2)]
    ax.add_collection(LineCollection(kept, colors=FREE, linewidths=0.7, alpha=0.8, zorder=1))
    handles = ax.plot([], [], color=FREE, linewidth=0.7, label="paths so far")
    handles += ax.plot(*run.x[0].reshape(-1, 2).T, ".", color=FREE, markersize=3, zorder=2, label="starts")
    for key, colour, width, dash, word in (("walls", INK, 3.0, "-", "walls"), ("exits", "#009E73", 2.0, "--", "exit")):
        for k, (begin, end) in enumerate(scene.get(key) or []):
            line = ax.plot([begin[0], end[0]], [begin[1], end[1]], dash, color=colour, linewidth=width, zorder=3)
            handles += line if not k else []
            line[0].set(label=word, solid_capstyle="round")
    return handles


def _scene_window(ax: Axes, run: Trajectory, scene: dict[str, Any], row: int) -> int:
    """Limits that hold the walls, the exit's surroundings and all starts; the number of discs left outside."""
    radius, start, now = max(scene["radii"]), run.x[0].reshape(-1, 2), run.x[row].reshape(-1, 2)
    held = np.concatenate([start, np.array(scene.get("walls") or []).reshape(-1, 2)])
    low, high = np.nanmin(held, axis=0), np.nanmax(held, axis=0)
    far = max(0.5 * float((high - low).max()), 10 * radius)
    held = np.concatenate([held, now[((now >= low - far) & (now <= high + far)).all(axis=1)]])
    low, high = np.nanmin(held, axis=0) - 2 * radius, np.nanmax(held, axis=0) + 2 * radius
    limits = _fill(ax, *zip(low, high, strict=True))
    ax.set_xlim(limits[0])
    ax.set_ylim(limits[1])
    low, high = np.array(limits).T
    return int(((now < low) | (now > high)).any(axis=1).sum())


# ---------------------------------------------------------------- whole figures


def _can_configure(run: Trajectory, model: Any) -> bool:
    planar = run.metadata.get("scene") or (model is not None and run.x.shape[1] <= 2)
    return run.metadata.get("model_class") == "SweepingProcess" and bool(planar)


def _can_phase(run: Trajectory) -> bool:
    return run.x.shape[1] > 1 or (run.metadata.get("model_class") == "FrictionOscillator" and "v" in run.arrays)


def _has_multipliers(run: Trajectory) -> bool:
    return _array(run, "multipliers").shape[1] > 0 and _array(run, "index_set").shape[1] > 0


def _title(run: Trajectory) -> str:
    return _text(run.metadata.get("title") or run.metadata.get("model_class") or run.title)


def _subtitle(run: Trajectory) -> str:
    """One line: the class, the number of steps, the step and how the run ended."""
    steps, unit = np.asarray(run.arrays.get("step", np.diff(run.t, prepend=np.nan)))[1:], _unit(run, "t")
    size = ""
    if len(steps):
        low, high = steps.min(), steps.max()
        size = f"{high:.4g}" if high - low <= 1e-6 * high else f"{low:.3g} to {high:.4g}"
        size = f"step {size} {unit}".rstrip()
    status = f"status: {run.status}" if "status" in run.metadata else ""
    every = run.metadata.get("save_every", 1)
    kept = f"rows kept: one in {every}" if every > 1 else ""
    parts = [run.metadata.get("model_class"), f"{run.metadata.get('steps', len(run.t) - 1)} steps", size, kept, status]
    return ", ".join(str(part) for part in parts if part)


def _stack(figure: Any, spec: Any, panels: Panels, *, shared: bool) -> None:
    """Panels below each other; with a shared time axis only the lowest keeps its label."""
    grid = spec.subgridspec(len(panels), 1, height_ratios=[height for height, _ in panels])
    first: Axes | None = None
    for k, (_, draw) in enumerate(panels):
        ax = figure.add_subplot(grid[k], sharex=first if shared else None)
        draw(ax)
        first = first or ax
        if shared and k < len(panels) - 1:
            ax.set_xlabel("")
            ax.tick_params(labelbottom=False)


def _time_panels(run: Trajectory, lines: int, rows: int) -> Panels:
    """States, index set, multipliers and reactions: what shares the time axis."""
    panels: Panels = [(2.6, lambda ax: states(run, limit=lines, ax=ax))]
    if _has_multipliers(run):
        bands = min(rows, run.index_set.shape[1])
        panels.append((0.5 + 0.16 * bands, lambda ax: index_strip(run, limit=rows, ax=ax)))
        panels.append((2, lambda ax: multipliers(run, limit=lines, ax=ax)))
        if "reactions" in run.arrays:
            panels.append((2, lambda ax: multipliers(run, which="reactions", limit=lines, ax=ax)))
    return panels


def overview(run: Trajectory, model: Any = None) -> Figure:
    """One figure of the whole run, 1400 x 900 pixels, composed of what the run holds.

    On the left, over a shared time axis: states, index set, multipliers, reactions. On the right: the configuration of
    a planar sweeping process (or else the phase portrait), the energy and the residual.
    """
    figure = _figure(14, 9)
    figure.suptitle(_title(run), fontsize=13, fontweight="bold", color=INK)
    figure.supxlabel(_text(_subtitle(run)), fontsize=9, color="#5B6570")
    left: Panels = _time_panels(run, 8, 12)
    right: Panels = [(1.6, lambda ax: residual(run, ax=ax))] if "residual" in run.arrays else []
    if "energy" in run.arrays:
        right.insert(0, (1.6, lambda ax: energy(run, ax=ax)))
    if _can_configure(run, model):
        right.insert(0, (3.6, lambda ax: configuration(run, model, ax=ax)))
    elif _can_phase(run):
        right.insert(0, (2.6, lambda ax: phase(run, ax=ax)))
    else:
        left, right = left + right, []
    grid = figure.add_gridspec(1, 2 if right else 1, width_ratios=[1.15, 1] if right else [1])
    _stack(figure, grid[0], left, shared=True)
    if right:
        _stack(figure, grid[1], right, shared=False)
    return figure


def _sheet(run: Trajectory, width: float, height: float, panels: Panels) -> Figure:
    """Build a titled figure of one column."""
    figure = _figure(width, height)
    figure.suptitle(_title(run), fontsize=12, fontweight="bold", color=INK)
    _stack(figure, figure.add_gridspec(1, 1)[0], panels, shared=True)
    return figure


def _sheets(run: Trajectory, model: Any) -> dict[str, Callable[[], Figure]]:
    """{file name: the figure, drawn when called} of all pictures that the run can give."""
    sheets: dict[str, Callable[[], Figure]] = {}
    bands = min(MAX_ROWS, run.index_set.shape[1]) if _has_multipliers(run) else 0
    upper = _time_panels(run, MAX_LINES, MAX_ROWS)
    strip = [(0.5 + 0.22 * bands, upper[1][1])] if bands else []
    sheets["states.png"] = lambda: _sheet(run, 9, 4.5 + 0.24 * bands, [(3.2, upper[0][1]), *strip])
    if _can_phase(run):
        sheets["phase.png"] = lambda: _sheet(run, 7, 6, [(1, lambda ax: phase(run, ax=ax))])
    if bands:
        sheets["multipliers.png"] = lambda: _sheet(run, 9, 1.5 + 3 * len(upper[2:]), upper[2:])
    if "energy" in run.arrays:
        sheets["energy.png"] = lambda: _sheet(run, 9, 4.5, [(1, lambda ax: energy(run, ax=ax))])
    if _can_configure(run, model):
        sheets["configuration.png"] = lambda: _sheet(run, 8, 7.5, [(1, lambda ax: configuration(run, model, ax=ax))])
    sheets["overview.png"] = lambda: overview(run, model)
    return sheets


def save_all(run: Trajectory, model: Any, directory: str | Path, prefix: str = "") -> list[Path]:
    """Write all pictures the run can give, each beside its place and then renamed; returns their paths.

    `states.png` (with the index set), `phase.png`, `multipliers.png`, `energy.png`, `configuration.png` (a planar
    sweeping process) and `overview.png`, each with `prefix` before its name.

    Args:
        run: the run.
        model: its model, or None: then no configuration of one or two states.
        directory: made where missing.
        prefix: put before each file name.

    """
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, draw in _sheets(run, model).items():
        path = directory / f"{prefix}{name}"
        part = path.with_name(f".{path.name}.part")
        try:
            draw().savefig(part, format="png", dpi=100)
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
        paths.append(path)
    return paths
