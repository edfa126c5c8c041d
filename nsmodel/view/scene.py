"""Configurations over time, as a page draws them: discs in the plane with walls and exits; the set that a state may not enter."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel._utils import escape_invisible
from nsmodel.crowd.measure import positions, present
from nsmodel.plot import style
from nsmodel.plot.plane import class_plots
from nsmodel.simulation.run_data import state_names, units_of
from nsmodel.view.packed import pack_codes, pack_numbers

if TYPE_CHECKING:
    from nsmodel.simulation.trajectory import Trajectory

MAX_PLACES_BYTES = 4_000_000  # Bytes for the places; of a longer run some rows are drawn.
FORBIDDEN_GRID = 100  # Points of the forbidden set along each axis,
MAX_MOMENTS = 60  # at so many times at most.
COLOUR_PERCENTILE = 99.5  # The colour scale of pressure ends at this percentile of those pressed.


def disc_scene_data(run: Trajectory) -> dict[str, Any] | None:
    """The configuration as plain data; None of a run whose scene has no discs."""
    about = run.metadata.get("scene") or {}
    if "radii" not in about or run.x.shape[1] != 2 * len(about["radii"]) or not len(about["radii"]):
        return None
    rows = style.evenly_spread(len(run.t), max(2, MAX_PLACES_BYTES // (4 * run.x.shape[1])))
    pressure = _pressure_rows(run, rows, len(about["radii"]))
    pressed = np.zeros(0) if pressure is None else pressure[pressure > 0]
    lines = {key: [np.ravel(one).tolist() for one in about.get(key) or []] for key in ("walls", "exits")}
    unit = units_of(run).get(state_names(run)[0], "")
    return {
        **lines,
        "radii": [float(radius) for radius in about["radii"]],
        "window": _scene_window(run, about),
        "unit": escape_invisible(unit),
        "rows": [int(row) for row in rows],
        "of": len(run.t),
        "times": pack_numbers(run.t[rows]),
        "places": pack_numbers(run.x[rows].T.ravel(), exact=False),
        "pressure": None if pressure is None else pack_numbers(pressure.T.ravel(), exact=False),
        "top": float(np.percentile(pressed, COLOUR_PERCENTILE)) if pressed.size else 1.0,
        "pressure_unit": escape_invisible(units_of(run).get("pressure" if "pressure" in run.arrays else "reactions", "")),
    }


def _pressure_rows(run: Trajectory, rows: np.ndarray, bodies: int) -> np.ndarray | None:
    """The sum of the reactions on each body (rows, bodies); None where the run cannot tell."""
    if "pressure" in run.arrays:
        return run.arrays["pressure"][rows]
    owners, reactions = run.metadata.get("constraint_bodies"), run.arrays.get("reactions")
    if not owners or reactions is None:
        return None
    total = np.zeros((len(rows), bodies))
    for column, members in zip(reactions.T, owners, strict=True):
        total[:, members] += column[rows, None]
    return total


def _scene_window(run: Trajectory, about: dict[str, Any]) -> list[float]:
    """x0, x1, y0, y1 around walls, exits and where bodies start; without walls around wherever they are."""
    fixed = [np.reshape(about.get(key) or [], (-1, 2)) for key in ("walls", "exits")]
    q, here = positions(run), present(run)
    own = q[here.argmax(axis=0), np.arange(q.shape[1])] if any(map(len, fixed)) else q.reshape(-1, 2)
    points = np.concatenate([*fixed, own])
    points = points[np.isfinite(points).all(axis=1)]
    points = points if len(points) else np.array([[0.0, 0.0], [1.0, 1.0]])
    margin = 0.03 * float(np.ptp(points, axis=0).max()) + 1.5 * max(about["radii"])
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    return [float(low[0]), float(high[0]), float(low[1]), float(high[1])]


def forbidden_set_data(run: Trajectory, model: Any) -> dict[str, Any] | None:
    """Where a state of one or two components may not be, on a grid and at some times; None where the class knows no such set.

    Of one component over the plane (t, q), of two over their plane. ``inside`` is 1 where some constraint is negative.
    """
    own, n = class_plots(run), run.x.shape[1]
    if model is None or not hasattr(own, "gap") or run.metadata.get("scene") or n > 2 or len(run.t) < 2:
        return None
    gap, moving = own.gap(model, run)
    low, high = np.nanmin(run.x, axis=0), np.nanmax(run.x, axis=0)
    reach = np.maximum(high - low, 0.6 * ((high - low).max() or 1.0)) * 0.8
    limits = [(run.t[0], run.t[-1])] if n == 1 else []
    limits += [(c - r, c + r) for c, r in zip((low + high) / 2, reach, strict=True)]
    across, up = np.meshgrid(*(np.linspace(*limit, FORBIDDEN_GRID) for limit in limits))
    rows = style.evenly_spread(len(run.t), MAX_MOMENTS) if moving and n == 2 else np.zeros(1, int)
    shape = (len(rows), *up.shape)
    points = [np.broadcast_to(one, shape) for one in ((up,) if n == 1 else (across, up))]
    least = gap(across if n == 1 else run.t[rows][:, None, None], *points)
    return {
        "size": FORBIDDEN_GRID,
        "window": [float(end) for limit in limits for end in limit],
        "times": pack_numbers(run.t[rows]),
        "inside": pack_codes(np.ma.filled(least < 0, False).ravel()),
        "note": f"The set forbidden is drawn at {len(rows)} of {len(run.t)} rows." if 1 < len(rows) < len(run.t) else "",
    }
