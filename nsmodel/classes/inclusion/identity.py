"""What the functions of an inclusion give: they are known by that."""

from __future__ import annotations

from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.modeling.time_grid import TimeGrid


def values_of_functions(model: MonotoneInclusion, grid: TimeGrid) -> list[list[float]]:
    """The tolerances at the steps of the run, where they are a function."""
    if not callable(model.tolerances):
        return []
    return [[float(model.tolerances(h)) for h in ([grid.h, grid.last] if grid.steps is None else grid.steps.tolist())]]
