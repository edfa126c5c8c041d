"""How often something holds over the cells of a sweep, with what the failed cells leave open."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import stdtrit

from nsmodel.brief import short_repr
from nsmodel.errors import UsageError
from nsmodel.notebook import html_repr
from nsmodel.sweep.binomial import wilson_interval
from nsmodel.sweep.groups import Over, StatisticGroups, check_independent, check_level, group_cells, split_by_replicate
from nsmodel.sweep.variable import as_variable
from nsmodel.words import escape_invisible


@dataclass(frozen=True, eq=False)
class Share:
    """The share of cells in which a condition holds; arrays have an axis for each of `dims`.

    Attributes:
        title: the condition in words.
        over: the dims that the share is over.
        dims: the others.
        cell_dims: those of `dims` that tell cells apart.
        coords: of the others.
        cells: of a group, done or not.
        count: cells that are done.
        failed: cells that have no result.
        holds: cells that are done and in which it holds; NaN where the condition of a cell that is done is NaN.
        value: holds / count.
        low, high: Wilson interval of the probability, from the cells that are done.
        bounds: (least, most) share of all cells: no cell without a result counts, all of them do.
        widest: (low, high): ends of the Wilson intervals of these two.
        level: of the intervals; NaN where none was asked for.
        causes: {"failed": 2, ...} of all cells without a result.
        replicates: the dim over whose shares the interval was taken instead, by Student's t; None: Wilson.
    """

    title: str
    over: tuple[str, ...]
    dims: tuple[str, ...]
    cell_dims: tuple[str, ...]
    coords: Mapping[str, np.ndarray]
    cells: int
    count: np.ndarray
    failed: np.ndarray
    holds: np.ndarray
    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    bounds: tuple[np.ndarray, np.ndarray]
    widest: tuple[np.ndarray, np.ndarray]
    level: float
    causes: Mapping[str, int]
    replicates: str | None = None

    __repr__ = short_repr
    _repr_html_ = html_repr("statistics")

    @property
    def text(self) -> str:
        """A table with a row for each group, and what of it is to be known."""
        from nsmodel.sweep.table import share_text

        return escape_invisible(share_text(self))

    def __str__(self) -> str:
        return self.text


def share(condition: Any, over: Over = None, level: float | None = 0.95, replicates: str | None = None) -> Share:
    """Return the share of cells in which a condition holds, with its Wilson interval, and failed cells beside it.

    Args:
        condition: a variable (or xarray.DataArray) of 1 and 0 or true and false, such as `rest > 0.5`.
        over: dims of cells; left out: all of them.
        level: of the intervals; None for no intervals.
        replicates: of `over`, the dim of independent nets; the interval is then that over their shares.

    Raises:
        UsageError: a value that is neither 0 nor 1, unknown dims, an interval asked of points that are not independent.
    """
    found = as_variable(condition, "share")
    groups, level = group_cells(found, over), check_level(level)
    values = groups.values[groups.done & ~np.isnan(groups.values)]
    other = values[(values != 0) & (values != 1)]
    if other.size:
        raise UsageError(f"share of {found.name}: it is {other[0]:g} in a cell; expected a condition, such as {found.name} > 0.5")
    return group_shares(groups, groups.values, groups.done, found.title, level, replicates)


def failure_share(groups: StatisticGroups, level: float, replicates: str | None) -> Share:
    """The share of cells without a result; here each cell counts."""
    failed = 1.0 - groups.done
    everywhere = np.ones_like(groups.done)
    return group_shares(groups, failed, everywhere, "without a result", level, replicates)


def group_shares(
    groups: StatisticGroups, values: np.ndarray, done: np.ndarray, title: str, level: float, replicates: str | None
) -> Share:  # fmt: skip
    """The share of 1 among values (*shape, cells) where `done`, of groups; NaN where such a value is NaN."""
    check_independent(groups, level, replicates)
    count, holds = done.sum(axis=-1), np.where(done, values, 0).sum(axis=-1)
    failed, nothing = groups.cells - count, np.full(np.shape(holds), np.nan)
    value = holds / _count_or_nan(count)
    low, high = least, most = nothing, nothing
    if replicates is not None:
        parts, has_result = (split_by_replicate(groups, array, replicates) for array in (np.where(done, values, 0), done))
        value, _, low, high = student_interval(parts.sum(axis=-1) / _count_or_nan(has_result.sum(axis=-1)), level)
        low, high = np.clip(low, 0, 1), np.clip(high, 0, 1)
        ends = (student_interval((parts + extra).mean(axis=-1), level) for extra in (0, ~has_result))
        least, most = np.clip(next(ends)[2], 0, 1), np.clip(next(ends)[3], 0, 1)
    elif not np.isnan(level):
        low, high = wilson_interval(holds, count, level)
        every = np.full(np.shape(holds), groups.cells)
        least, most = wilson_interval(holds, every, level)[0], wilson_interval(holds + failed, every, level)[1]
        low, high, least, most = (np.where(np.isnan(holds), np.nan, end) for end in (low, high, least, most))
    return Share(
        title=title, over=groups.over, dims=groups.dims, cell_dims=groups.cell_dims, coords=groups.coords, cells=groups.cells,
        count=count, failed=failed, holds=holds, value=value, low=low, high=high,
        bounds=(holds / groups.cells, (holds + failed) / groups.cells), widest=(least, most), level=level,
        causes=groups.causes, replicates=replicates,
    )  # fmt: skip


def _count_or_nan(count: np.ndarray) -> np.ndarray:
    """A count, NaN for none."""
    return np.where(count, count, np.nan)


def student_interval(means: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Mean, standard error (ddof 1) and interval by Student's t of independent values along the last axis."""
    n = means.shape[-1]
    with np.errstate(invalid="ignore"):
        mean, error = means.mean(axis=-1), means.std(axis=-1, ddof=1) / np.sqrt(n)
        half = stdtrit(n - 1, (1 + level) / 2) * error
        return mean, error, mean - half, mean + half
