"""Configurations over time, as a page draws them: discs in the plane with walls and exits; the set that a state may not enter."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.columns import state_names, units_of
from nsmodel.crowd.measure import positions, present
from nsmodel.plot import style
from nsmodel.plot.plane import plots_of
from nsmodel.view.packed import codes, numbers
from nsmodel.words import shown

if TYPE_CHECKING:
    from nsmodel.trajectory import Trajectory

ROOM = 4_000_000  # Bytes for the places; of a longer run some rows are drawn.
GRID = 120  # Points of the forbidden set along each axis,
MOMENTS = 120  # at so many times at most.
TOP = 99.5  # The colour scale of pressure ends at this percentile of those pressed.


def scene(run: Trajectory) -> dict[str, Any] | None:
    """The configuration as plain data; None of a run whose scene has no discs."""
    about = run.metadata.get("scene") or {}
    if "radii" not in about or run.x.shape[1] != 2 * len(about["radii"]) or not len(about["radii"]):
        return None
    rows = style.spread(len(run.t), max(2, ROOM // (4 * run.x.shape[1])))
    pressure = _pressure(run, rows, len(about["radii"]))
    pressed = np.zeros(0) if pressure is None else pressure[pressure > 0]
    lines = {key: [np.ravel(one).tolist() for one in about.get(key) or []] for key in ("walls", "exits")}
    unit = units_of(run).get(state_names(run)[0], "")
    return {
        **lines,
        "radii": [float(radius) for radius in about["radii"]],
        "window": _window(run, about),
        "unit": shown(unit),
        "rows": [int(row) for row in rows],
        "of": len(run.t),
        "times": numbers(run.t[rows]),
        "places": numbers(run.x[rows].T.ravel(), exact=False),
        "pressure": None if pressure is None else numbers(pressure.T.ravel(), exact=False),
        "top": float(np.percentile(pressed, TOP)) if pressed.size else 1.0,
        "pressure_unit": shown(units_of(run).get("pressure" if "pressure" in run.arrays else "reactions", "")),
    }


def _pressure(run: Trajectory, rows: np.ndarray, bodies: int) -> np.ndarray | None:
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


def _window(run: Trajectory, about: dict[str, Any]) -> list[float]:
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


def forbidden(run: Trajectory, model: Any) -> dict[str, Any] | None:
    """Where a state of one or two components may not be, on a grid and at some times; None where the class knows no such set.

    Of one component over the plane (t, q), of two over their plane. ``inside`` is 1 where some constraint is negative.
    """
    own, n = plots_of(run), run.x.shape[1]
    if model is None or not hasattr(own, "gap") or run.metadata.get("scene") or n > 2 or len(run.t) < 2:
        return None
    gap, moving = own.gap(model, run)
    low, high = np.nanmin(run.x, axis=0), np.nanmax(run.x, axis=0)
    reach = np.maximum(high - low, 0.6 * ((high - low).max() or 1.0)) * 0.8
    limits = [(run.t[0], run.t[-1])] if n == 1 else []
    limits += [(c - r, c + r) for c, r in zip((low + high) / 2, reach, strict=True)]
    across, up = np.meshgrid(*(np.linspace(*limit, GRID) for limit in limits))
    rows = style.spread(len(run.t), MOMENTS) if moving and n == 2 else np.zeros(1, int)
    inside = [gap(across, up) if n == 1 else gap(run.t[row], across, up) for row in rows]
    return {
        "size": GRID,
        "window": [float(end) for limit in limits for end in limit],
        "times": numbers(run.t[rows]),
        "inside": codes(np.ravel([np.ma.filled(one < 0, False) for one in inside])),
        "note": f"The set forbidden is drawn at {len(rows)} of {len(run.t)} rows." if 1 < len(rows) < len(run.t) else "",
    }
