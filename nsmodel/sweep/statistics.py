"""Statistics over the cells of a sweep: means with their errors, quantiles with intervals that hold for every distribution."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import stdtrit

from nsmodel.brief import short_repr
from nsmodel.errors import UsageError
from nsmodel.notebook import html_repr
from nsmodel.sweep.binomial import median_ranks, quantile_interval_ranks
from nsmodel.sweep.groups import Over, check_independent, check_level, evenly_spaced_dims, group_cells, split_by_replicate
from nsmodel.sweep.shares import Share, failure_share, student_interval
from nsmodel.sweep.variable import as_variable, combine_variables
from nsmodel.words import escape_invisible


@dataclass(frozen=True, eq=False)
class Quantile:
    """A quantile of each group, between two of its values that hold it with the probability `reached` or more.

    Attributes:
        q: in (0, 1).
        value: the estimate: one of the values, or the mean of two neighbours where q count is whole.
        low, high: ends of the interval; -inf, inf where the cells are too few for this end at the level.
        reached: the level that the interval reaches: exact for continuous distributions, at least this for all others (atoms).
    """

    q: float
    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    reached: np.ndarray

    __repr__ = short_repr


@dataclass(frozen=True, eq=False)
class Statistics:
    """Statistics of one quantity over cells of a sweep; arrays have an axis for each of `dims`.

    Of cells that are done; `failed` says how many are missing from them. Where a cell that is done has NaN, they are NaN.

    Attributes:
        title: of the quantity.
        unit: of the values.
        over: the dims that the statistics are over.
        dims: the others ("t" among them).
        cell_dims: those of `dims` that tell cells apart.
        coords: {name: values} of the others.
        cells: of a group, done or not.
        count: cells that are done, of each group.
        failed: cells that have no result: failed, interrupted, no model, not run.
        failed_share: their share, with its interval.
        mean: of the cells that are done.
        error: standard error of the mean: std / sqrt(count), or that over the means of the replicates.
        low, high: interval of the mean by Student's t: for independent cells of a distribution near the normal, or many of them.
        std: standard deviation (ddof 1); NaN of one value.
        least, largest: of the values.
        quantiles: one `Quantile` for each q.
        level: of the intervals; NaN where none was asked for.
        replicates: the dim over whose means the errors are; None: over all cells.
        causes: {"failed": 2, ...} of all cells without a result.
        even: those of `over` whose coordinates are laid out evenly, as no draws are.
    """

    title: str
    unit: str
    over: tuple[str, ...]
    dims: tuple[str, ...]
    cell_dims: tuple[str, ...]
    coords: Mapping[str, np.ndarray]
    cells: int
    count: np.ndarray
    failed: np.ndarray
    failed_share: Share
    mean: np.ndarray
    error: np.ndarray
    low: np.ndarray
    high: np.ndarray
    std: np.ndarray
    least: np.ndarray
    largest: np.ndarray
    quantiles: tuple[Quantile, ...]
    level: float
    causes: Mapping[str, int]
    replicates: str | None = None
    even: tuple[str, ...] = ()

    __repr__ = short_repr
    _repr_html_ = html_repr("statistics")

    def quantile(self, q: float) -> Quantile:
        """Return the quantile that was asked for with this q; UsageError where it was not."""
        for one in self.quantiles:
            if one.q == q:
                return one
        known = ", ".join(f"{one.q:g}" for one in self.quantiles) or "none"
        raise UsageError(f"quantile {q!r} was not asked for; there are {known}")

    @property
    def text(self) -> str:
        """A table with a row for each group, and what of it is to be known."""
        from nsmodel.sweep.table import statistics_text

        return escape_invisible(statistics_text(self))

    def __str__(self) -> str:
        return self.text


def statistics(
    variable: Any, over: Over = None, quantiles: Sequence[float] = (0.05, 0.5, 0.95), level: float | None = 0.95,
    replicates: str | None = None,
) -> Statistics:  # fmt: skip
    """Return mean, standard error, quantiles and their intervals over cells of a sweep; failed cells are counted beside.

    The intervals of quantiles are between order statistics whose ranks are binomial: exact for every distribution, atoms
    included, and of any number of cells (David and Nagaraja, Order Statistics, 2003, section 7.1).

    Args:
        variable: of a sweep, or an xarray.DataArray; a coordinate `status` of it says which cells are done.
        over: a dim of cells, or several; left out: all of them. The other dims stay.
        quantiles: each in (0, 1).
        level: of the intervals; None for no errors and no intervals.
        replicates: of `over`, the dim of independent scrambled nets: errors and intervals are then those over their means and
            quantiles, by Student's t. Samples of a low-discrepancy net have no other.

    Raises:
        UsageError: unknown dims, an axis within a cell ("t"), quantiles or a level out of range, an error asked of a single net.
    """
    groups, level = group_cells(as_variable(variable), over), check_level(level)
    requested = _check_quantiles(quantiles)
    check_independent(groups, level, replicates)
    count = groups.count
    numbers = _moments(groups.values, groups.done)
    inside = _group_quantiles(groups.values, groups.done, requested, np.nan if replicates else level)
    if replicates is not None:
        values, done = (split_by_replicate(groups, array, replicates) for array in (groups.values, groups.done))
        numbers["mean"], numbers["error"], low, high = student_interval(_moments(values, done)["mean"], level)
        inside = tuple(_quantile_over_replicates(part, level) for part in _group_quantiles(values, done, requested, np.nan))
    else:
        half = stdtrit(np.maximum(count - 1, 1), (1 + level) / 2) * numbers["error"]
        with np.errstate(invalid="ignore"):
            low, high = numbers["mean"] - half, numbers["mean"] + half
        if np.isnan(level):
            numbers["error"] = np.full(groups.shape, np.nan)
    return Statistics(
        title=groups.variable.title, unit=groups.variable.unit, over=groups.over, dims=groups.dims, cell_dims=groups.cell_dims,
        coords=groups.coords, cells=groups.cells, count=count, failed=groups.cells - count,
        failed_share=failure_share(groups, level, replicates), low=low, high=high, quantiles=inside, level=level,
        causes=groups.causes, replicates=replicates, even=tuple(evenly_spaced_dims(groups)), **numbers,
    )  # fmt: skip


def difference(
    a: Any, b: Any, over: Over = None, quantiles: Sequence[float] = (0.05, 0.5, 0.95), level: float | None = 0.95,
    replicates: str | None = None,
) -> Statistics:  # fmt: skip
    """Return the statistics of a - b, cell by cell: of two sweeps over the same seeds the error is that of the difference.

    Scenes that see the same random numbers err together, so that their difference is known better than either. A cell without a
    result in either counts as failed.

    Args:
        a, b: two variables (or xarray.DataArrays) of the same dims, coordinates and unit.
        over, quantiles, level, replicates: as for `statistics`.

    Raises:
        UsageError: they do not belong together; and as `statistics` does.
    """
    first, second = as_variable(a, "difference"), as_variable(b, "difference")
    if first.unit != second.unit:
        units = [one.unit or "no unit" for one in (first, second)]
        raise UsageError(f"{first.name} is in {units[0]}, {second.name} is in {units[1]}; expected the same unit")
    return statistics(combine_variables(first, second, _subtract, "-"), over, quantiles, level, replicates)


def _subtract(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(a, dtype=float) - b


def _moments(values: np.ndarray, done: np.ndarray) -> dict[str, np.ndarray]:
    """Mean, std, error, least and largest along the last axis, each in a unit in which 1e300 has a square."""
    count = done.sum(axis=-1)
    some = np.where(count, count, np.nan)
    least = np.where(done, values, np.inf).min(axis=-1, initial=np.inf)
    largest = np.where(done, values, -np.inf).max(axis=-1, initial=-np.inf)
    least, largest = (np.where(count > 0, end, np.nan) for end in (least, largest))
    with np.errstate(invalid="ignore", over="ignore"):
        size = np.maximum(np.abs(least), np.abs(largest))
        size = np.where(np.isfinite(size) & (size > 0), size, 1.0)
        unit = np.ldexp(1.0, np.frexp(size)[1] - 1)  # a power of 2: nothing is rounded by it
        parts = np.where(done, values / unit[..., None], 0.0)
        mean = np.clip(parts.sum(axis=-1) / some * unit, least, largest)
        from_mean = np.where(done, parts - (mean / unit)[..., None], 0.0)
        std = np.sqrt((from_mean**2).sum(axis=-1) / np.where(count > 1, count - 1, np.nan)) * unit
    return {"mean": mean, "std": std, "error": std / np.sqrt(some), "least": least, "largest": largest}


def _group_quantiles(values: np.ndarray, done: np.ndarray, requested: Sequence[float], level: float) -> tuple[Quantile, ...]:
    """Quantiles along the last axis, with their intervals by rank."""
    count, holes = done.sum(axis=-1), (np.isnan(values) & done).any(axis=-1)
    ordered = np.concatenate([np.full((*count.shape, 1), -np.inf), np.sort(values, axis=-1)], axis=-1)  # rank 0: no lower end
    found = []
    for q in requested:
        parts = {name: np.full(count.shape, np.nan) for name in ("value", "low", "high", "reached")}
        for n in np.unique(count):
            here = (count == n) & ~holes
            rows = ordered[here]
            if n:
                parts["value"][here] = _mean_of_two(*(rows[:, k] for k in median_ranks(int(n), q)))
            if not np.isnan(level):
                r, s, reached = quantile_interval_ranks(int(n), q, level)
                parts["low"][here], parts["reached"][here] = rows[:, r], reached
                parts["high"][here] = rows[:, s] if s <= n else np.inf
        found.append(Quantile(q, **parts))
    return tuple(found)


def _quantile_over_replicates(part: Quantile, level: float) -> Quantile:
    value, _, low, high = student_interval(part.value, level)
    return Quantile(part.q, value, low, high, np.where(np.isnan(value), np.nan, level))


def _mean_of_two(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.where(a == b, a, a / 2 + b / 2)


def _check_quantiles(quantiles: Sequence[float]) -> tuple[float, ...]:
    requested = tuple(quantiles) if isinstance(quantiles, Iterable) else (quantiles,)
    for q in requested:
        if not (isinstance(q, float | np.floating) and 0 < q < 1):
            raise UsageError(f"quantiles={quantiles!r}: {q!r} is not between 0 and 1")
    return tuple(float(q) for q in requested)
