"""Many quantities of one kind that stand in a row, as in a chain: a map of their number and time, a colour for the value."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.errors import PlotError
from nsmodel.plot import style
from nsmodel.plot.strip import MAX_MAP_ROWS, MAX_ROWS, buckets
from nsmodel.proof.verdict import not_none
from nsmodel.simulation.run_data import model_type, multiplier_names, state_names

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from nsmodel.simulation.trajectory import Trajectory

MIN_CHAIN_LENGTH = MAX_ROWS + 10  # Members from which on pictures of a whole run are maps.
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
    chosen = [one for one in known if one.stem == stem] if stem is not None else state_chains(run, 2)[-1:]
    if not chosen:
        names = ", ".join(dict.fromkeys(one.stem for one in known)) or "none: a map needs names such as x_0, x_1"
        raise PlotError(f"no chain is called {stem!r}; there are {names}" if stem else f"no chain of states; there are {names}")
    return draw_chain(run, chosen[0], ax=ax)


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
    look: dict[str, Any] = {"cmap": SIGNED if signed else POSITIVE_COLOURS, "norm": Normalize(-far if signed else 0, far)}
    places = _number_edges(np.array(chain.numbers)[drawn])
    mesh = ax.pcolormesh(edges, places, np.ma.masked_invalid(values.T), rasterized=True, **look)
    stuck = _sticking_members(run, chain)
    if stuck is not None:
        _overlay_sticking(ax, edges, places, stuck[:, drawn])
    title = (heading or f"{chain.stem} along the chain") + style.selection_note(len(drawn), len(chain.numbers), "evenly spread")
    style.dress_over_time(ax, run, title, "number in the chain", grid=False)
    ax.set_ylim(places[0], places[-1])
    bar = not_none(ax.get_figure()).colorbar(mesh, ax=ax, pad=0.02)
    bar.set_label(style.safe_text(chain.label), fontsize=9)
    bar.ax.tick_params(labelsize=8)
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
    if len(numbers) == 1:
        return np.array([numbers[0] - 0.5, numbers[0] + 0.5])
    middle = (numbers[1:] + numbers[:-1]) / 2
    return np.concatenate([[numbers[0] - 0.5], middle, [numbers[-1] + 0.5]])


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
