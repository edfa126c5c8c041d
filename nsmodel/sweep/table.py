"""Statistics of a sweep as text: a row for each group, and below it what a reader of the numbers has to know."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.sweep.binomial import wilson_interval
from nsmodel.words import one_line

if TYPE_CHECKING:
    from nsmodel.sweep.shares import Share
    from nsmodel.sweep.statistics import Statistics

MAX_TABLE_ROWS = 24  # Of a table; more are thinned.
MAX_WORD_WIDTH = 16  # Of a coordinate that is a word.
_Column = Callable[[np.ndarray], list[str]]  # rows -> their text


def statistics_text(of: Statistics) -> str:
    """Statistics as a table."""
    columns = {"count": _number_column(of.count)} | ({"failed": _number_column(of.failed)} if of.failed.any() else {})
    columns |= {"mean": _number_column(of.mean), "error": _number_column(of.error), "std": _number_column(of.std)}
    for part in of.quantiles:
        bare = np.isnan(of.level)
        columns[f"quantile {part.q:g}"] = (
            _number_column(part.value) if bare else _interval_column(part.low, part.high, part.value)
        )
    columns |= {"least": _number_column(of.least), "largest": _number_column(of.largest)}
    unit = f" [{of.unit}]" if of.unit else ""
    return "\n".join([f"{one_line(of.title)}{unit} over {_cells_text(of)}", *_aligned_table(of, columns), *_statistics_notes(of)])


def share_text(of: Share) -> str:
    """A share as a table."""
    columns = {"count": _number_column(of.count)} | ({"failed": _number_column(of.failed)} if of.failed.any() else {})
    columns |= {"holds": _number_column(of.holds), "share": _number_column(of.value)}
    if not np.isnan(of.level):
        columns[f"{100 * of.level:g} % interval"] = _interval_column(of.low, of.high)
    if of.failed.any():
        columns["if all failed ones are against, for"] = _interval_column(*of.bounds)
    lines = _missing_result_notes(of, "the share")
    if of.replicates:
        lines.append(f"The interval is that over the shares of {of.replicates}, by Student's t.")
    elif not np.isnan(of.level):
        lines.append("Intervals: Wilson's.")
    return "\n".join([f"{one_line(of.title)}: share over {_cells_text(of)}", *_aligned_table(of, columns), *lines])


def _statistics_notes(of: Statistics) -> list[str]:
    lines = _missing_result_notes(of, "a mean")
    holes = int((np.isnan(of.mean) & (of.count > 0)).sum())
    if holes:
        why = "a cell that is done has NaN there, or cells have infinities of both signs"
        lines.append(f"{_rows_text(holes)} NaN: {why}{', or no cell of a replicate is done' if of.replicates else ''}.")
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
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  " + "  ".join(word.rjust(width) for word, width in zip(row, widths, strict=True)) for row in rows]
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


def _rows_text(count: int) -> str:
    return "1 row is" if count == 1 else f"{count} rows are"
