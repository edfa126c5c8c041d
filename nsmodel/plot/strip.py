"""The index set as a strip chart: one band a row of the law, a colour for each of its states."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel import laws
from nsmodel.columns import model_type
from nsmodel.errors import PlotError
from nsmodel.plot import style
from nsmodel.plot.style import LOWER, PALE, UPPER, ZERO

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from nsmodel.trajectory import Trajectory

    Words = dict[int, tuple[str, str]]  # index-set code: (colour, words)

MAX_ROWS = 30
COLUMNS, PLACES = 800, 600  # about a pixel each
UNSEEN = 127  # No code of an index set.
CHATTER = "split band: changes within a pixel"

COLOURS = {"lower": LOWER, "zero": ZERO, "upper": UPPER, "nothing": PALE}


def _coloured(words: laws.Words) -> Words:
    return {code: (COLOURS[role], text) for code, (role, text) in words.items()}


WORDS: dict[str, Words] = {label.removeprefix("second-order "): _coloured(words) for label, words in laws.WORDS.items()}


def index_strip(run: Trajectory, *, limit: int = MAX_ROWS, ax: Axes | None = None) -> Axes:
    """Draw the index set as a strip chart: one band a row, a colour for each of the law's states.

    Args:
        run: the run.
        limit: at most so many bands; beyond, those that change most are shown and the title says so.
        ax: where to draw; a new figure by default.

    Raises:
        PlotError: the run has no index set, or a kind of law is unknown.

    """
    run = run.smooth()
    names, laws, codes = _rows(run)
    count = codes.shape[1]
    changes = np.count_nonzero(np.diff(codes[1:], axis=0), axis=0)
    shown = np.sort(np.argsort(-changes, kind="stable")[:limit])
    ax = style.axes(ax, 8, 1.3 + 0.22 * len(shown))
    split = [_band(ax, run.t, codes[:, k], laws[k][1], place) for place, k in enumerate(shown)]
    style.over_time(ax, run, "Index set" + style.of(len(shown), count, "those that change most"), "", grid=False)
    size = min(8.0, max(5.0, 55 * style.inches(ax)[1] / len(shown)))
    ax.set_yticks(range(len(shown)), [style.text(style.short(names[k], 18)) for k in shown], fontsize=size)
    ax.set_ylim(len(shown) - 0.5, -0.5)
    ax.tick_params(axis="y", length=0)
    _legend(ax, dict(laws[k] for k in shown), chatter=max(split) > 0.05)
    return ax


def index_map(run: Trajectory, *, ax: Axes | None = None) -> Axes:
    """Draw the whole index set as a map: a line of pixels a row, a colour for each of the law's states.

    Of many rows of a run in a pixel that state is shown which is there the longest.

    Args:
        run: the run.
        ax: where to draw; a new figure by default.

    Raises:
        PlotError: as of `index_strip`.
    """
    from matplotlib.colors import ListedColormap

    run = run.smooth()
    names, laws, codes = _rows(run)
    shown = style.spread(len(names), PLACES)
    codes = codes[:, shown]
    kinds = dict(laws[k] for k in shown)
    colours = dict.fromkeys(colour for words in kinds.values() for colour, _ in words.values())
    ax = style.axes(ax)
    if len(run.t) > 1:
        starts = buckets(len(run.t) - 1)
        counts = np.zeros((len(colours), len(starts), len(shown)))
        for number, colour in enumerate(colours):
            own = np.array([[code for code, (one, _) in laws[k][1].items() if one == colour][:1] or [UNSEEN] for k in shown])
            counts[number] = np.add.reduceat(codes == own.T, starts, axis=0, dtype=float)
        edges, places = np.append(run.t[starts - 1], run.t[-1]), np.linspace(-0.5, len(names) - 0.5, len(shown) + 1)
        look: dict[str, Any] = {"cmap": ListedColormap(list(colours)), "vmin": -0.5, "vmax": len(colours) - 0.5}
        ax.pcolormesh(edges, places, counts.argmax(axis=0).T, rasterized=True, **look)
    ends = f"rows {style.short(names[0], 16)} to {style.short(names[-1], 16)}"
    style.over_time(ax, run, "Index set" + style.of(len(shown), len(names), "evenly spread"), ends, grid=False)
    ax.set_ylim(-0.5, len(names) - 0.5)
    _legend(ax, kinds, chatter=False)
    return ax


def buckets(n: int) -> np.ndarray:
    """The first row of each bucket of n steps."""
    return 1 + np.arange(min(n, COLUMNS)) * n // max(1, min(n, COLUMNS))


def _rows(run: Trajectory) -> tuple[list[str], list[tuple[str, Words]], np.ndarray]:
    """Names, laws and codes of the rows of the index set; PlotError where there are none."""
    codes = style.table(run, "index_set")
    if not codes.shape[1]:
        raise PlotError("this run has no index set: its model has no multipliers")
    names: list[str] = run.metadata.get("index_names") or [f"row {k}" for k in range(codes.shape[1])]
    return names, _laws(run, names), codes


def _laws(run: Trajectory, names: Sequence[str]) -> list[tuple[str, Words]]:
    """Kind and words of each row."""
    kinds = [kind.removeprefix("second-order ") for kind in run.metadata.get("law_kinds") or ["complementarity"] * len(names)]
    if len(kinds) != len(names) or set(kinds) - set(WORDS):
        raise PlotError(f"law_kinds must name one of {', '.join(WORDS)} for each of {len(names)} rows, and is {kinds[:8]}")
    own = {label: (name, _coloured(words)) for label, (name, words) in model_type(run).words.items()}
    return [
        own[kind] if kind in own and not name.startswith("potential ") else (kind, WORDS[kind])
        for kind, name in zip(kinds, names, strict=True)
    ]


def _band(ax: Axes, t: np.ndarray, column: np.ndarray, words: Words, place: int) -> float:
    """Draw one row of the index set. Returns the share of buckets that are split."""
    from matplotlib.collections import PolyCollection

    starts, shares = _shares(column, list(words))
    changes = np.flatnonzero(np.r_[True, (shares[:, 1:] != shares[:, :-1]).any(axis=0)][: len(starts)])
    left, right = t[starts[changes] - 1], np.r_[t[starts[changes[1:]] - 1], t[-1:]]
    top = place + 0.38 - 0.76 * np.cumsum(shares[:, changes], axis=0)
    for k, (colour, _) in enumerate(words.values()):
        keep = shares[k, changes] > 0
        high, low = top[k, keep], top[k, keep] + 0.76 * shares[k, changes[keep]]
        corners = [(left[keep], low), (right[keep], low), (right[keep], high), (left[keep], high)]
        if keep.any():
            boxes = np.stack([np.stack(corner, axis=1) for corner in corners], axis=1)
            ax.add_collection(PolyCollection(list(boxes), facecolor=colour, linewidth=0, snap=False))
    return float(((shares > 0).sum(axis=0) > 1).mean()) if len(starts) else 0.0


def _shares(column: np.ndarray, codes: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """First row of each bucket, and the share of each code in it (codes, buckets).

    A run has a bucket a row, a long run COLUMNS. There a bucket that the code leaves and enters once shows the code
    between, so that no event is lost; with more changes each code that occurs has a fourth of it at least.
    """
    n = len(column) - 1
    starts = buckets(n)
    ends = np.append(starts, n + 1)[1:]
    border = np.flatnonzero(np.r_[True, column[2:] != column[1:-1], True]) + 1  # rows where another code begins
    first, after = np.searchsorted(border, starts), np.searchsorted(border, ends, side="right")
    shown = column[np.where(after - first == 2, border[first], starts)]
    counts = np.array([np.add.reduceat(column == code, starts, dtype=float) for code in codes]) / (ends - starts)
    counts = np.where(counts > 0, np.maximum(np.round(4 * counts), 1) / 4, 0)  # fourths: like neighbours join
    return starts, np.where(after - first > 2, counts / counts.sum(axis=0).clip(0.25), shown == np.array(codes)[:, None])


def _legend(ax: Axes, laws: dict[str, Words], *, chatter: bool) -> None:
    """Put the words of each kind of law in the legend; the kind is named where there are several."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = []
    for kind, words in laws.items():
        prefix = f"{kind}: " if len(laws) > 1 and kind != "equality" else ""
        handles += [Patch(color=colour, label=prefix + word) for colour, word in words.values()]
    style.legend(ax, handles + [Line2D([], [], linestyle="none", label=CHATTER)] * chatter)
