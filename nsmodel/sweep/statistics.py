"""Statistics over the cells of a sweep: means with their errors, quantiles with intervals that hold for every distribution.

How often something holds over the cells of a sweep, with what the failed cells leave open.

Statistics of a sweep as text: a row for each group, and below it what a reader of the numbers has to know.

What counts say of a probability, and ranks of a quantile, whatever the distribution: by the binomial law.
"""

from __future__ import annotations

import functools
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import bdtr, ndtri, stdtrit

from nsmodel._utils import align_columns, checks_keywords, escape_invisible, html_repr, one_line, short_repr
from nsmodel.errors import UsageError
from nsmodel.sweep.variable import (
    Over,
    StatisticGroups,
    as_variable,
    check_independent,
    check_level,
    combine_variables,
    evenly_spaced_dims,
    group_cells,
    split_by_replicate,
)


def wilson_interval(holds: np.ndarray, count: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Interval of a probability of which `holds` of `count` independent draws show: (low, high), both in [0, 1].

    The set of p with |holds/count - p| <= z sqrt(p (1 - p) / count) (Wilson 1927). Its coverage is near the level for p away
    from 0 and 1, above and below by turns (Brown, Cai and DasGupta 2001, section 3.1.1). Of no draws: (0, 1).
    """
    holds, n = np.asarray(holds, dtype=float), np.asarray(count, dtype=float)
    z2 = float(ndtri((1 + level) / 2)) ** 2
    centre = (holds + z2 / 2) / (n + z2)
    half = np.sqrt(z2 * (holds * (n - holds) / np.maximum(n, 1) + z2 / 4)) / (n + z2)
    low, high = np.clip(centre - half, 0, 1), np.clip(centre + half, 0, 1)
    return np.where(holds == 0, 0.0, low), np.where(holds == n, 1.0, high)


@functools.lru_cache(maxsize=4096)
def quantile_interval_ranks(count: int, q: float, level: float) -> tuple[int, int, float]:
    """Ranks r, s whose values X_(r) <= X_(s) hold the quantile q of any distribution between them, and how surely.

    With B ~ Bin(count, q): r is the largest with P(B < r) <= (1 - level)/2, s the smallest with P(B >= s) <= (1 - level)/2, and
    P(X_(r) <= x_q <= X_(s)) >= P(r <= B < s), with equality where the distribution is continuous (David and Nagaraja,
    Order Statistics, 2003, section 7.1). r = 0 and s = count + 1 stand for -inf and inf: count is too small for this end.

    >>> low, high, reached = quantile_interval_ranks(20, 0.5, 0.95)
    >>> low, high, round(reached, 4)
    (6, 15, 0.9586)
    >>> quantile_interval_ranks(20, 0.05, 0.95)[:2]
    (0, 4)
    """

    def below(k: int) -> float:
        return float(bdtr(k, count, q))

    if count == 0:
        return 0, 1, 1.0
    tail = (1 - level) / 2
    r = bisect_right(range(count + 1), tail, key=below)
    s = bisect_left(range(count + 1), 1 - tail, key=below) + 1
    return r, s, below(s - 1) - (below(r - 1) if r else 0.0)


def median_ranks(count: int, q: float) -> tuple[int, int]:
    """Ranks whose mean estimates the quantile q: one value, two where q count is whole (Hyndman and Fan 1996, definition 2)."""
    place = q * count
    whole = round(place)
    if abs(place - whole) <= 1e-12 * count:
        return max(whole, 1), min(whole + 1, count)
    return int(np.ceil(place)), int(np.ceil(place))


@dataclass(frozen=True, eq=False, kw_only=True)
class CellStatistics:
    """What is known of groups of cells of a sweep, and of which cells: `Share` and `Statistics` say what it is."""

    title: str
    over: tuple[str, ...]
    dims: tuple[str, ...]
    cell_dims: tuple[str, ...]
    coords: Mapping[str, np.ndarray]
    cells: int
    count: np.ndarray
    failed: np.ndarray
    level: float
    causes: Mapping[str, int]
    replicates: str | None = None

    __repr__ = short_repr
    _repr_html_ = html_repr("statistics_html")

    @property
    def text(self) -> str:
        """A table with a row for each group, and what of it is to be known."""
        return escape_invisible(self._table())

    def _table(self) -> str:
        raise NotImplementedError

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Share(CellStatistics):
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

    holds: np.ndarray
    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    bounds: tuple[np.ndarray, np.ndarray]
    widest: tuple[np.ndarray, np.ndarray]

    def _table(self) -> str:
        columns = {"count": _number_column(self.count)} | ({"failed": _number_column(self.failed)} if self.failed.any() else {})
        columns |= {"holds": _number_column(self.holds), "share": _number_column(self.value)}
        if not np.isnan(self.level):
            columns[f"{100 * self.level:g} % interval"] = _interval_column(self.low, self.high)
        if self.failed.any():
            columns["if all failed ones are against, for"] = _interval_column(*self.bounds)
        lines = _missing_result_notes(self, "the share")
        if self.replicates:
            lines.append(f"The interval is that over the shares of {self.replicates}, by Student's t.")
        elif not np.isnan(self.level):
            lines.append("Intervals: Wilson's.")
        return "\n".join([f"{one_line(self.title)}: share over {_cells_text(self)}", *_aligned_table(self, columns), *lines])


@checks_keywords
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


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Statistics(CellStatistics):
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

    unit: str
    failed_share: Share
    mean: np.ndarray
    error: np.ndarray
    low: np.ndarray
    high: np.ndarray
    std: np.ndarray
    least: np.ndarray
    largest: np.ndarray
    quantiles: tuple[Quantile, ...]
    even: tuple[str, ...] = ()

    def quantile(self, q: float) -> Quantile:
        """Return the quantile that was asked for with this q; UsageError where it was not."""
        for one in self.quantiles:
            if one.q == q:
                return one
        known = ", ".join(f"{one.q:g}" for one in self.quantiles) or "none"
        raise UsageError(f"quantile {q!r} was not asked for; there are {known}")

    def _table(self) -> str:
        columns = {"count": _number_column(self.count)} | ({"failed": _number_column(self.failed)} if self.failed.any() else {})
        columns |= {"mean": _number_column(self.mean), "error": _number_column(self.error), "std": _number_column(self.std)}
        for part in self.quantiles:
            bare = np.isnan(self.level)
            columns[f"quantile {part.q:g}"] = (
                _number_column(part.value) if bare else _interval_column(part.low, part.high, part.value)
            )
        columns |= {"least": _number_column(self.least), "largest": _number_column(self.largest)}
        unit = f" [{self.unit}]" if self.unit else ""
        head = f"{one_line(self.title)}{unit} over {_cells_text(self)}"
        return "\n".join([head, *_aligned_table(self, columns), *_statistics_notes(self)])


@checks_keywords
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
    both = combine_variables(first, second, lambda a, b: np.asarray(a, float) - b, "-")
    return statistics(both, over, quantiles, level, replicates)


def _moments(values: np.ndarray, done: np.ndarray) -> dict[str, np.ndarray]:
    """Mean, std, error, least and largest along the last axis, each in a unit in which 1e300 has a square."""
    count = done.sum(axis=-1)
    some = _count_or_nan(count)
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


MAX_TABLE_ROWS = 24  # Rows of a table, which fit on a screen; of more, some are left out.
MAX_WORD_WIDTH = 16  # Characters of a coordinate that is a word, so that some columns fit into a line.
_Column = Callable[[np.ndarray], list[str]]  # rows -> their text


def _statistics_notes(of: Statistics) -> list[str]:
    lines = _missing_result_notes(of, "a mean")
    holes = int((np.isnan(of.mean) & (of.count > 0)).sum())
    if holes:
        why = "a cell that is done has NaN there, or cells have infinities of both signs"
        rows = "1 row is" if holes == 1 else f"{holes} rows are"
        lines.append(f"{rows} NaN: {why}{', or no cell of a replicate is done' if of.replicates else ''}.")
    if np.isnan(of.level):
        lines.append("No errors and no intervals were asked for.")
    elif of.replicates:
        lines.append(f"Errors and intervals are those over the means and quantiles of {of.replicates}, by Student's t.")
    else:
        if (of.count == 1).any():
            lines.append("One cell has no standard error.")
        lines += _quantile_notes(of)
    for dim in of.even:
        lines.append(f"{dim} is evenly laid out: where its values are no random draws, error and intervals say nothing.")
    return lines


def _quantile_notes(of: Statistics) -> list[str]:
    """The level that their intervals reach, and the ends that are not there."""
    some, lines, reached = of.count > 0, [], {}
    for part in of.quantiles:
        levels = part.reached[np.isfinite(part.reached) & some]
        if levels.size:
            reached[f"{part.q:g}"] = f"{100 * levels.min():.4g}"
        for word, end, extreme in (("lower", part.low, of.least), ("upper", part.high, of.largest)):
            without = np.isinf(end) & some & ~np.isinf(extreme)
            if without.any():
                few = of.count[without].max()
                lines.append(
                    f"Of {few} cells{' or less' if few > 1 else ''} quantile {part.q:g} has no {word} end: they are too few."
                )
    if reached:
        lines.insert(0, f"Intervals of quantiles {', '.join(reached)} reach {', '.join(reached.values())} %, or more.")
    return lines


def _missing_result_notes(of: Statistics | Share, what: str) -> list[str]:
    """How many of all cells have no result, why, their share, and what is meant by the numbers; empty where all have one."""
    gone, total = sum(of.causes.values()), of.cells * _group_count(of)
    if not gone:
        return []
    share = f"a share of {gone / total:.4g}"
    if not np.isnan(of.level) and of.replicates is None:
        low, high = wilson_interval(np.array(gone), np.array(total), of.level)
        share += f", {100 * of.level:g} % interval {low:.3g} to {high:.3g}"
    reasons = ", ".join(f"{n} {word}" for word, n in of.causes.items())
    return [f"{gone} of {total} cells without a result ({reasons}): {share}; {what} is of the other cells alone."]


def _cells_text(of: Statistics | Share) -> str:
    """Over what, of how many cells."""
    groups = _group_count(of)
    many = f"{of.cells * groups} cells in {groups} groups" if groups > 1 else f"{of.cells} cells"
    return f"{one_line(', '.join(of.over))}: {many}"


def _group_count(of: Statistics | Share) -> int:
    """How many groups of cells: axes within a cell make no more of them."""
    return int(np.prod([len(of.coords[dim]) for dim in of.dims if dim in of.cell_dims]))


def _aligned_table(of: Statistics | Share, columns: Mapping[str, _Column]) -> list[str]:
    """Aligned columns: the coordinates of the groups, then others, each of the rows it is given; many rows are thinned."""
    shape = tuple(len(of.coords[dim]) for dim in of.dims)
    count = int(np.prod(shape))
    selected = (
        np.unique(np.linspace(0, count - 1, min(count, MAX_TABLE_ROWS)).round().astype(int)) if count else np.zeros(0, dtype=int)
    )
    index = np.unravel_index(selected, shape) if shape else ()
    table = {dim: [_format_coordinate(of.coords[dim][k]) for k in places] for dim, places in zip(of.dims, index, strict=True)}
    table |= {name: column(selected) for name, column in columns.items()}
    rows = [list(map(one_line, table)), *zip(*table.values(), strict=True)]
    lines = [f"  {line}" for line in align_columns(rows)]
    return lines + ([f"  {len(selected)} of {count} rows, evenly spread"] if len(selected) < count else [])


def _format_coordinate(value: Any) -> str:
    if isinstance(value, float | np.floating):
        return f"{value:.6g}"
    text = one_line(str(value))
    return text if len(text) <= MAX_WORD_WIDTH else f"{text[: MAX_WORD_WIDTH - 1]}…"


def _format_numbers(array: np.ndarray, rows: np.ndarray) -> list[str]:
    """Of these groups, to 5 digits; counts whole."""
    whole = np.asarray(array).dtype.kind in "iu"
    return [f"{value}" if whole else f"{value:.5g}" for value in np.ravel(array)[rows]]


def _number_column(array: np.ndarray) -> _Column:
    """A column of numbers."""
    return lambda rows: _format_numbers(array, rows)


def _interval_column(low: np.ndarray, high: np.ndarray, value: np.ndarray | None = None) -> _Column:
    """A column of intervals, behind a value where there is one."""

    def column(rows: np.ndarray) -> list[str]:
        intervals = [f"{a} to {b}" for a, b in zip(_format_numbers(low, rows), _format_numbers(high, rows), strict=True)]
        return (
            intervals if value is None else [f"{v} ({w})" for v, w in zip(_format_numbers(value, rows), intervals, strict=True)]
        )

    return column
