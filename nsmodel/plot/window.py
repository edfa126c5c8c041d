"""A run over a window of time, for pictures."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.errors import PlotError
from nsmodel.files.archive import LIST_PREFIXES
from nsmodel.simulation import windows

if TYPE_CHECKING:
    from nsmodel.simulation.trajectory import Trajectory

Window = tuple[float | None, float | None]
WINDOW_POINTS = 2000  # Rows of an event-driven run, which are read off its polynomials.


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
        raise PlotError(f"window t = {begin:.6g} to {end:.6g} holds {stop - first} rows, and a picture needs 2: {rows}")
    return replace(kept, arrays=_cut_arrays(run, first, stop))


def _window_ends(t: Any) -> Window:
    """Both ends as numbers or None."""
    try:
        begin, end = (None if one is None else float(one) for one in t)
    except (TypeError, ValueError):
        raise PlotError(f"t = {t!r}; expected a window (t0, t1), two numbers, or None for an end of the run") from None
    if any(one is not None and math.isnan(one) for one in (begin, end)):
        raise PlotError(f"t = {t!r}: nan is no time; give None for an end of the run")
    return begin, end


def _cut_arrays(run: Trajectory, first: int, stop: int) -> dict[str, np.ndarray]:
    """The arrays of these rows; lists (see archive.LIST) of what belongs to them."""
    arrays = {name: array[first:stop] for name, array in run.arrays.items() if not name.startswith(LIST_PREFIXES)}
    if "contact_row" in run.arrays:
        part = slice(*np.searchsorted(run.arrays["contact_row"], [first, stop]))
        arrays |= {name: array[part] for name, array in run.arrays.items() if name.startswith("contact_")}
        arrays["contact_row"] = arrays["contact_row"] - first
    return arrays
