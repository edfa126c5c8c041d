"""The cells that a statistic is over, brought to the last axis; what is refused of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from nsmodel.errors import UsageError
from nsmodel.sweep.variable import DRAWN_DIMS, Variable, failure_counts

Over = str | Sequence[str] | None


@dataclass(frozen=True, eq=False)
class StatisticGroups:
    """Cells by group: those of one group are along the last axis.

    Attributes:
        variable: what they are cells of.
        over: the dims within a group.
        dims: the others.
        shape: of the others.
        values: (*shape, cells of a group), NaN where a cell is not done.
        done: the same shape, bool.
    """

    variable: Variable
    over: tuple[str, ...]
    dims: tuple[str, ...]
    shape: tuple[int, ...]
    values: np.ndarray
    done: np.ndarray

    @property
    def cells(self) -> int:
        """Cells of a group."""
        return self.values.shape[-1]

    @property
    def count(self) -> np.ndarray:
        """Cells of each group that are done."""
        return self.done.sum(axis=-1)

    @property
    def causes(self) -> dict[str, int]:
        """Of all cells that have no result, how many came to what."""
        return failure_counts(self.variable.status)

    @property
    def coords(self) -> dict[str, np.ndarray]:
        """Coordinates of what is left."""
        return {name: of for name, of in self.variable.coords.items() if self.variable.along.get(name, name) in self.dims}

    @property
    def cell_dims(self) -> tuple[str, ...]:
        """Those dims that are left and tell cells apart."""
        return tuple(dim for dim in self.dims if dim in self.variable.cell_dims)


def group_cells(variable: Variable, over: Over) -> StatisticGroups:
    """Return the cells of a variable, grouped by the dims that are not in `over`.

    Raises:
        UsageError: a dim that is not there, is named twice, or is an axis within a cell.
    """
    if not (over is None or isinstance(over, Iterable)):
        raise UsageError(f"over={over!r}: expected a dim, several, or None for all of {', '.join(variable.cell_dims)}")
    dims = variable.cell_dims if over is None else (over,) if isinstance(over, str) else tuple(over)
    for dim in dims:
        if dim not in variable.dims:
            raise UsageError(f"over={dim!r}: {variable.name} has the dims {', '.join(variable.dims) or 'none'}")
        if dim not in variable.cell_dims:
            raise UsageError(
                f"over={dim!r}: {dim} is an axis within each cell, whose values are no independent draws; over= takes "
                f"{', '.join(variable.cell_dims) or 'none of the dims'}; a mean over time is run.mean, an output of the sweep"
            )
    if not dims or len(set(dims)) < len(dims):
        raise UsageError(f"over={over!r}: expected dims of cells, each once: {', '.join(variable.cell_dims) or 'there are none'}")
    empty = [dim for dim in dims if not variable.sizes[dim]]
    if empty:
        raise UsageError(f"over={over!r}: {variable.name} has no cells along {empty[0]}")
    kept = tuple(dim for dim in variable.dims if dim not in dims)
    order = [variable.dims.index(dim) for dim in (*kept, *dims)]
    shape = tuple(variable.sizes[dim] for dim in kept)
    cells = int(np.prod([variable.sizes[dim] for dim in dims]))
    done = variable.done.transpose(order).reshape(*shape, cells)
    values = variable.values.astype(float).transpose(order).reshape(*shape, cells)
    return StatisticGroups(variable, dims, kept, shape, np.where(done, values, np.nan), done)


def check_level(level: float | None) -> float:
    """The level, NaN where none is asked for; UsageError where it is not in (0, 1)."""
    if level is None:
        return np.nan
    if not (isinstance(level, int | float) and 0 < level < 1):
        raise UsageError(f"level = {level!r}; expected a number between 0 and 1, such as 0.95, or None for no intervals")
    return float(level)


def check_independent(groups: StatisticGroups, level: float, replicates: str | None) -> None:
    """Refuse an interval asked of points that are not independent, and replicates that are none.

    Raises:
        UsageError: also over less than two replicates.
    """
    variable, over = groups.variable, groups.over
    if replicates is not None:
        if replicates not in over:
            raise UsageError(f"replicates={replicates!r} is not among over={over}; expected one of its dims")
        if variable.sizes[replicates] < 2:
            raise UsageError(f"{replicates} has {variable.sizes[replicates]} value; an error takes 2 replicates or more")
    elif variable.low_discrepancy and not np.isnan(level) and ("sample" in over or "sample" not in variable.cell_dims):
        raise UsageError(
            f"{variable.name}: points of a low-discrepancy net are not independent, so a mean over them has no standard error; "
            "sweep independent scrambled nets along a dim, 8 are good, and name it, replicates='replicate'; or ask for no error, "
            "level=None"
        )


def split_by_replicate(groups: StatisticGroups, values: np.ndarray, replicates: str) -> np.ndarray:
    """Values (*shape, cells) as (*shape, replicates, cells of one)."""
    sizes, at = [groups.variable.sizes[dim] for dim in groups.over], groups.over.index(replicates)
    separated = np.moveaxis(values.reshape(*groups.shape, *sizes), len(groups.shape) + at, len(groups.shape))
    return separated.reshape(*groups.shape, sizes[at], -1)


def evenly_spaced_dims(groups: StatisticGroups) -> list[str]:
    """Those dims within a group whose values look like a grid, not like draws: evenly spaced, or in a geometric series."""
    return [dim for dim in groups.over if dim not in DRAWN_DIMS and is_evenly_spaced(groups.variable.coords[dim])]


def is_evenly_spaced(values: np.ndarray, *, geometric: bool | None = None) -> bool:
    """Whether three or more numbers have equal steps or ratios (`geometric`: ratios alone); 0, 1, 2, ... just count."""
    if values.dtype.kind not in "iuf" or len(values) < 3 or not np.isfinite(values).all():
        return False
    steps = np.diff(values.astype(float))
    linear = np.allclose(steps, steps[0], rtol=1e-6, atol=0) and steps[0] != 0
    if linear and not geometric:
        return bool(not np.array_equal(values, np.arange(len(values)) + values[0]))
    if geometric is False or values.min() <= 0:
        return False
    ratios = np.diff(np.log(values.astype(float)))
    return bool(np.allclose(ratios, ratios[0], rtol=1e-6, atol=0) and ratios[0] != 0)
