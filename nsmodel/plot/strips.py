"""The index set as a strip chart or a map; many quantities in a row, as in a chain, as a map of their number and time."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.errors import PlotError
from nsmodel.modeling import laws
from nsmodel.plot import style
from nsmodel.plot.style import LOWER, PALE, UPPER, ZERO
from nsmodel.simulation.run_data import model_type, multiplier_names, state_names

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from nsmodel.simulation.trajectory import Trajectory

    StateLabels = dict[int, tuple[str, str]]  # index-set code: (colour, words)

MAX_ROWS = 30  # Bands of a strip; of more rows, those that change most: a name each fits beside a picture.
MAX_BUCKETS = 800  # Columns of a map, each of some steps,
MAX_MAP_ROWS = 600  # and rows: about a pixel each.
NO_CODE = 127  # No code of an index set: the largest number of a signed byte.
CHATTER_LABEL = "split band: changes within a pixel"

ROLE_COLOURS = {"lower": LOWER, "zero": ZERO, "upper": UPPER, "nothing": PALE}


def _coloured_labels(labels: laws.StateNames) -> StateLabels:
    return {code: (ROLE_COLOURS[role], text) for code, (role, text) in labels.items()}


STATE_LABELS = {label.removeprefix("second-order "): labels for label, labels in laws.STATE_NAMES.items()}


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
    names, laws, codes = _index_set_rows(run)
    count = codes.shape[1]
    changes = np.count_nonzero(np.diff(codes[1:], axis=0), axis=0)
    drawn = np.sort(np.argsort(-changes, kind="stable")[:limit])
    ax = style.get_axes(ax, 8, 1.3 + 0.22 * len(drawn))
    split = [_draw_band(ax, run.t, codes[:, k], laws[k][1], place) for place, k in enumerate(drawn)]
    style.dress_over_time(
        ax, run, "Index set" + style.selection_note(len(drawn), count, "those that change most"), "", grid=False
    )
    size = min(8.0, max(5.0, 55 * style.size_in_inches(ax)[1] / len(drawn)))
    ax.set_yticks(range(len(drawn)), [style.safe_text(style.shorten(names[k], 18)) for k in drawn], fontsize=size)
    ax.set_ylim(len(drawn) - 0.5, -0.5)
    ax.tick_params(axis="y", length=0)
    _law_legend(ax, dict(laws[k] for k in drawn), chatter=max(split) > 0.05)
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
    names, laws, codes = _index_set_rows(run)
    drawn = style.evenly_spread(len(names), MAX_MAP_ROWS)
    codes = codes[:, drawn]
    kinds = dict(laws[k] for k in drawn)
    colours = dict.fromkeys(colour for labels in kinds.values() for colour, _ in labels.values())
    ax = style.get_axes(ax)
    if len(run.t) > 1:
        starts = buckets(len(run.t) - 1)
        counts = np.zeros((len(colours), len(starts), len(drawn)))
        for number, colour in enumerate(colours):
            own = np.array([[code for code, (one, _) in laws[k][1].items() if one == colour][:1] or [NO_CODE] for k in drawn])
            counts[number] = np.add.reduceat(codes == own.T, starts, axis=0, dtype=float)
        edges, places = np.append(run.t[starts - 1], run.t[-1]), np.linspace(-0.5, len(names) - 0.5, len(drawn) + 1)
        ax.pcolormesh(
            edges, places, counts.argmax(axis=0).T, cmap=ListedColormap(list(colours)), vmin=-0.5, vmax=len(colours) - 0.5,
            rasterized=True,
        )  # fmt: skip
    ends = f"rows {style.shorten(names[0], 16)} to {style.shorten(names[-1], 16)}"
    style.dress_over_time(ax, run, "Index set" + style.selection_note(len(drawn), len(names), "evenly spread"), ends, grid=False)
    ax.set_ylim(-0.5, len(names) - 0.5)
    _law_legend(ax, kinds, chatter=False)
    return ax


def buckets(n: int) -> np.ndarray:
    """The first row of each bucket of n steps."""
    return 1 + np.arange(min(n, MAX_BUCKETS)) * n // max(1, min(n, MAX_BUCKETS))


def _index_set_rows(run: Trajectory) -> tuple[list[str], list[tuple[str, StateLabels]], np.ndarray]:
    """Names, laws and codes of the rows of the index set; PlotError where there are none."""
    codes = style.array_columns(run, "index_set")
    if not codes.shape[1]:
        raise PlotError("this run has no index set: its model has no multipliers")
    names: list[str] = run.metadata.get("index_names") or [f"row {k}" for k in range(codes.shape[1])]
    return names, [(kind, _coloured_labels(labels)) for kind, labels in row_laws(run, names)], codes


def row_laws(run: Trajectory, names: Sequence[str]) -> list[tuple[str, laws.StateNames]]:
    """Kind and words of each row of the index set, see `laws.StateNames`."""
    kinds = [kind.removeprefix("second-order ") for kind in run.metadata.get("law_kinds") or ["complementarity"] * len(names)]
    if len(kinds) != len(names) or set(kinds) - set(STATE_LABELS):
        raise PlotError(f"law_kinds must name one of {', '.join(STATE_LABELS)} for each of {len(names)} rows, and is {kinds[:8]}")
    own = model_type(run).law_descriptions
    return [
        own[kind] if kind in own and not name.startswith("potential ") else (kind, STATE_LABELS[kind])
        for kind, name in zip(kinds, names, strict=True)
    ]


def _draw_band(ax: Axes, t: np.ndarray, column: np.ndarray, labels: StateLabels, place: int) -> float:
    """Draw one row of the index set. Returns the share of buckets that are split."""
    from matplotlib.collections import PolyCollection

    starts, shares = _code_shares(column, list(labels))
    changes = np.flatnonzero(np.r_[True, (shares[:, 1:] != shares[:, :-1]).any(axis=0)][: len(starts)])
    left, right = t[starts[changes] - 1], np.r_[t[starts[changes[1:]] - 1], t[-1:]]
    top = place + 0.38 - 0.76 * np.cumsum(shares[:, changes], axis=0)
    for k, (colour, _) in enumerate(labels.values()):
        keep = shares[k, changes] > 0
        high, low = top[k, keep], top[k, keep] + 0.76 * shares[k, changes[keep]]
        corners = [(left[keep], low), (right[keep], low), (right[keep], high), (left[keep], high)]
        if keep.any():
            boxes = np.stack([np.stack(corner, axis=1) for corner in corners], axis=1)
            ax.add_collection(PolyCollection(list(boxes), facecolor=colour, linewidth=0, snap=False))
    return float(((shares > 0).sum(axis=0) > 1).mean()) if len(starts) else 0.0


def _code_shares(column: np.ndarray, codes: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """First row of each bucket, and the share of each code in it (codes, buckets).

    A run has a bucket a row, a long run COLUMNS. There a bucket that the code leaves and enters once shows the code
    between, so that no event is lost; with more changes each code that occurs has a fourth of it at least.
    """
    n = len(column) - 1
    starts = buckets(n)
    ends = np.append(starts, n + 1)[1:]
    border = np.flatnonzero(np.r_[True, column[2:] != column[1:-1], True]) + 1  # rows where another code begins
    first, after = np.searchsorted(border, starts), np.searchsorted(border, ends, side="right")
    single_codes = column[np.where(after - first == 2, border[first], starts)]
    counts = np.array([np.add.reduceat(column == code, starts, dtype=float) for code in codes]) / (ends - starts)
    counts = np.where(counts > 0, np.maximum(np.round(4 * counts), 1) / 4, 0)  # fourths: like neighbours join
    return starts, np.where(after - first > 2, counts / counts.sum(axis=0).clip(0.25), single_codes == np.array(codes)[:, None])


def _law_legend(ax: Axes, laws: dict[str, StateLabels], *, chatter: bool) -> None:
    """Put the words of each kind of law in the legend; the kind is named where there are several."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = []
    for kind, labels in laws.items():
        prefix = f"{kind}: " if len(laws) > 1 and kind != "equality" else ""
        handles += [Patch(color=colour, label=prefix + word) for colour, word in labels.values()]
    style.legend(ax, handles + [Line2D([], [], linestyle="none", label=CHATTER_LABEL)] * chatter)


MIN_CHAIN_LENGTH = MAX_ROWS + 10  # Members from which on pictures of a whole run are maps: fewer have bands or lines.
MIN_PROFILE_LENGTH = 8  # Members, where there are no other states, from which on there is a profile: fewer show no shape;
PROFILE_TIMES = 6  # and times from the start to the end at which it is drawn: shades of one colour that can be told apart.
SIGNED, POSITIVE_COLOURS, STICK_COLOUR = "RdBu_r", "viridis", "#6B727B"


@dataclass(frozen=True, eq=False)
class QuantityChain:
    """Quantities called ``stem`` and a number, one after the other: ``values`` (N+1, K), their ``numbers``."""

    stem: str
    numbers: range
    values: np.ndarray
    unit: str
    columns: range

    @property
    def label(self) -> str:
        """Such as "v_0 ... v_199 [m/s]" without the numbers."""
        return style.with_unit(style.shorten(self.stem, 30), self.unit)


def find_numbered_names(names: Sequence[str]) -> list[tuple[str, range, range]]:
    """(stem, numbers, columns) of each run of at least two names that differ in a number which goes up by one."""
    read = [re.fullmatch(r"(.*?)[\[_ ]?(\d+)\]?", name) for name in names]
    keys = [(one[1], int(one[2])) if one else (name, -1) for one, name in zip(read, names, strict=True)]
    breaks = [k + 1 for k, (a, b) in enumerate(pairwise(keys)) if b != (a[0], a[1] + 1) or a[1] < 0]
    found = []
    for first, stop in pairwise([0, *breaks, len(names)]):
        if stop - first > 1:
            found.append((keys[first][0], range(keys[first][1], keys[first][1] + stop - first), range(first, stop)))
    return found


def find_chains(run: Trajectory, table: str, least: int = MIN_CHAIN_LENGTH) -> list[QuantityChain]:
    """The families of at least so many columns of "x", "v" (velocities of an oscillator), "multipliers" or "reactions"."""
    values, states = style.array_columns(run, table), state_names(run)
    names = states if table in ("x", "v") else multiplier_names(run)
    if len(names) != values.shape[1]:
        return []
    found = []
    for stem, numbers, columns in find_numbered_names(names):
        if len(columns) >= least:
            unit = style.quantity_unit(run, names[columns.start] if table in ("x", "multipliers") else table)
            label = {"v": f"velocity of {stem}", "x": stem}.get(table, f"{table} {stem}")
            found.append(QuantityChain(label, numbers, values[:, columns.start : columns.stop], unit, columns))
    return found


def state_chains(run: Trajectory, least: int = MIN_CHAIN_LENGTH) -> list[QuantityChain]:
    """What a space-time map of states can show: positions, velocities; none of discs in the plane, which have a picture."""
    if run.metadata.get("scene"):
        return []
    return find_chains(run, "x", least) + (find_chains(run, "v", least) if model_type(run).second_order else [])


def has_profile(run: Trajectory) -> bool:
    """Whether all states stand in one row that is too short for a map."""
    return [len(one.numbers) for one in state_chains(run, MIN_PROFILE_LENGTH)] == [run.x.shape[1]] and not state_chains(run)


def space_time(run: Trajectory, stem: str | None = None, *, ax: Axes | None = None) -> Axes:
    """Draw many states or multipliers as a map: their number upwards, time across, a colour for the value.

    Where a map of velocities stands beside as many multipliers with stick, the members that stick are grey. Of many rows in a
    cell the value farthest from 0 is shown.

    Args:
        run: the run.
        stem: name of the states or multipliers without the number: "v" of v_1, v_2, ...; of an oscillator also
            "velocity of x". Left out: the last of the states.
        ax: where to draw; a new figure by default.

    Raises:
        PlotError: no such names, or no two that differ in a number alone.
    """
    run = run.smooth()
    known = state_chains(run, 2) + find_chains(run, "multipliers", 2)
    return draw_chain(run, _chosen_chain(known, stem, state_chains(run, 2)[-1:]), ax=ax)


def profile(run: Trajectory, stem: str | None = None, *, ax: Axes | None = None) -> Axes:
    """Draw states in a row over their number, such as the heights of a pile, at six times from the start to the end.

    Args:
        run: the run.
        stem: name of the states without the number: "h" of h_0, h_1, ...; of an oscillator also "velocity of x". Left out: the
            first of them.
        ax: where to draw; a new figure by default.

    Raises:
        PlotError: no such names, or no two that differ in a number alone.
    """
    from matplotlib import colormaps

    run = run.smooth()
    known = state_chains(run, 2)
    chain = _chosen_chain(known, stem, known[:1])
    ax, unit = style.get_axes(ax), style.quantity_unit(run, "t")
    times = np.linspace(run.t[0], run.t[-1], PROFILE_TIMES) if len(run.t) > 1 else run.t
    rows = np.unique(np.abs(run.t[:, None] - times).argmin(axis=0))
    shades = colormaps[POSITIVE_COLOURS](np.linspace(0.92, 0.0, PROFILE_TIMES)[-len(rows) :])
    for row, shade in zip(rows, shades, strict=True):
        label = f"t = {run.t[row]:.4g} {unit}".rstrip()
        ax.plot(chain.numbers, chain.values[row], "o-", color=shade, markersize=3.5, linewidth=1.4, label=label)
    style.dress(ax, f"Profile of {style.shorten(chain.stem, 30)}", f"number of {style.shorten(chain.stem, 30)}", chain.label)
    style.legend(ax, ax.lines)
    return ax


def _chosen_chain(known: Sequence[QuantityChain], stem: str | None, usual: Sequence[QuantityChain]) -> QuantityChain:
    """The chain of this name, without a name the usual one; PlotError lists what there is."""
    chosen = [one for one in known if one.stem == stem] if stem is not None else usual
    if not chosen:
        names = ", ".join(dict.fromkeys(one.stem for one in known)) or "none: a map needs names such as x_0, x_1"
        raise PlotError(f"no chain is called {stem!r}; there are {names}" if stem else f"no chain of states; there are {names}")
    return chosen[0]


def draw_chain(run: Trajectory, chain: QuantityChain, *, heading: str = "", ax: Axes | None = None) -> Axes:
    """Draw the map of a family."""
    from matplotlib.colors import Normalize
    from matplotlib.patches import Patch

    ax = style.get_axes(ax)
    drawn = style.evenly_spread(len(chain.numbers), MAX_MAP_ROWS)
    values, edges = _time_cells(run.t, chain.values[:, drawn])
    low, high = style.extent(values)
    signed = low < 0
    far = max(-low, high, 0.0) or 1.0
    places = _number_edges(np.array(chain.numbers)[drawn])
    mesh = ax.pcolormesh(
        edges, places, np.ma.masked_invalid(values.T), cmap=SIGNED if signed else POSITIVE_COLOURS,
        norm=Normalize(-far if signed else 0, far), rasterized=True,
    )  # fmt: skip
    stuck = _sticking_members(run, chain)
    if stuck is not None:
        _overlay_sticking(ax, edges, places, stuck[:, drawn])
    title = (heading or f"{chain.stem} along the chain") + style.selection_note(len(drawn), len(chain.numbers), "evenly spread")
    style.dress_over_time(ax, run, title, "number in the chain", grid=False)
    ax.set_ylim(places[0], places[-1])
    style.colour_bar(ax, mesh, chain.label)
    if stuck is not None:
        style.legend(ax, [Patch(color=STICK_COLOUR, label="stick (y = 0)")])
    return ax


def _time_cells(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(cells, K) the value farthest from 0 of the rows of each cell, and the edges in time (cells + 1,)."""
    if len(t) < 2:
        return values, np.array([t[0], t[0] + 1.0])
    starts = buckets(len(t) - 1)
    low = np.fmin.reduceat(values, starts, axis=0)
    high = np.fmax.reduceat(values, starts, axis=0)
    return np.where(-low > high, low, high), np.append(t[starts - 1], t[-1])


def _number_edges(numbers: np.ndarray) -> np.ndarray:
    """The edges between numbers (K + 1,)."""
    return np.concatenate([[numbers[0] - 0.5], (numbers[1:] + numbers[:-1]) / 2, [numbers[-1] + 0.5]])


def _sticking_members(run: Trajectory, chain: QuantityChain) -> np.ndarray | None:
    """Which members (cells, K) stick; None where no law has an index set beside these velocities."""
    codes, kinds = style.array_columns(run, "index_set"), run.metadata.get("law_kinds") or []
    if codes.shape[1] != len(chain.numbers) or set(kinds) != {"relay"} or len(run.t) < 2 or chain.values.shape[1] < 2:
        return None
    starts = buckets(len(run.t) - 1)
    share = np.add.reduceat(codes == 0, starts, axis=0, dtype=float) / np.diff(np.append(starts, len(run.t)))[:, None]
    still = _time_cells(run.t, chain.values)[0]
    stuck = share > 0.5
    moving = np.abs(still[stuck]).max(initial=0.0) > 1e-6 * np.abs(still).max(initial=0.0)
    return None if moving else stuck  # positions are held where they are, velocities at 0


def _overlay_sticking(ax: Axes, edges: np.ndarray, places: np.ndarray, stuck: np.ndarray) -> None:
    from matplotlib.colors import ListedColormap

    mask = np.ma.masked_where(~stuck.T, np.ones(stuck.T.shape))
    ax.pcolormesh(edges, places, mask, cmap=ListedColormap([STICK_COLOUR]), rasterized=True)
