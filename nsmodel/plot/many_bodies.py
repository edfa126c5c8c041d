"""Pictures of many bodies in the plane."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from nsmodel.models.crowd.measure import maps
from nsmodel.plot import crowd
from nsmodel.simulation.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def panels(run: Trajectory, model: Any) -> dict[str, tuple[float, Callable[..., Axes]]]:
    """What a run in the plane can give, instead of what all runs do; maps where it knows a room with exits."""
    if "radii" not in (run.metadata.get("scene") or {}):
        return {}
    found: dict[str, tuple[float, Callable[..., Axes]]] = {
        "frame": (3.6, partial(crowd.frame, run)),
        "evacuation": (1.8, partial(crowd.evacuation, run)),
        "paths": (3.6, partial(crowd.paths, run)),
    }
    if len(run.metadata["scene"].get("exits", ())):
        measured = maps(run)
        for draw in (crowd.density, crowd.pressure, crowd.velocity):
            found[draw.__name__] = (2.2, partial(draw, measured, run))
    found["pressures"] = (1.4, partial(crowd.pressures, run))
    return found


def configuration(run: Trajectory, model: Any, row: int, ax: Axes | None) -> Axes:
    """Draw the bodies, the walls and the pressures of a row."""
    return crowd.frame(run, row, ax=ax)
