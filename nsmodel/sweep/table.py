"""Statistics of a sweep as text: a row for each group, and below it what a reader of the numbers has to know."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.sweep.binomial import wilson
from nsmodel.words import one_line

if TYPE_CHECKING:
    from nsmodel.sweep.shares import Share
    from nsmodel.sweep.statistics import Statistics

ROWS = 24  # Of a table; more are thinned.
WIDEST = 16  # Of a coordinate that is a word.


def statistics_text(of: Statistics) -> str:
    """Statistics as a table."""
    columns = {"count": of.count, "mean": of.mean, "error": of.error, "std": of.std}
    cells = {name: _numbers(array) for name, array in columns.items()}
    for part in of.quantiles:
        value = _numbers(part.value)
        if not np.isnan(of.level):
            value = [f"{v} ({a} to {b})" for v, a, b in zip(value, _numbers(part.low), _numbers(part.high), strict=True)]
        cells[f"quantile {part.q:g}"] = value
    cells |= {"least": _numbers(of.least), "largest": _numbers(of.largest)}
    if of.failed.any():
        cells = {"count": cells.pop("count"), "failed": _numbers(of.failed), **cells}
    unit = f" [{of.unit}]" if of.unit else ""
    return "\n".join([f"{one_line(of.title)}{unit} over {_cells(of)}", *_table(of, cells), *_about_statistics(of)])


def share_text(of: Share) -> str:
    """A share as a table."""
    interval = [f"{a} to {b}" for a, b in zip(_numbers(of.low), _numbers(of.high), strict=True)]
    cells = {"count": _numbers(of.count), "holds": _numbers(of.holds), "share": _numbers(of.value)}
    if not np.isnan(of.level):
        cells[f"{100 * of.level:g} % interval"] = interval
    if of.failed.any():
        cells = {"count": cells.pop("count"), "failed": _numbers(of.failed), **cells}
        pairs = zip(_numbers(of.bounds[0]), _numbers(of.bounds[1]), strict=True)
        cells["if all failed ones are against, for"] = [f"{a} to {b}" for a, b in pairs]
    lines = _without_result(of, "the share")
    if of.replicates:
        lines.append(f"The interval is that over the shares of {of.replicates}, by Student's t.")
    elif not np.isnan(of.level):
        lines.append("Intervals: Wilson's.")
    return "\n".join([f"{one_line(of.title)}: share over {_cells(of)}", *_table(of, cells), *lines])


def _about_statistics(of: Statistics) -> list[str]:
    lines = _without_result(of, "a mean")
    holes = int((np.isnan(of.mean) & (of.count > 0)).sum())
    if holes:
        lines.append(f"{_rows(holes)} NaN: a cell that is done has NaN there.")
    if np.isnan(of.level):
        lines.append("No errors and no intervals were asked for.")
    elif of.replicates:
        lines.append(f"Errors and intervals are those over the means and quantiles of {of.replicates}, by Student's t.")
    else:
        if (of.count == 1).any():
            lines.append("One cell has no standard error.")
        lines += _of_quantiles(of)
    for dim in of.even:
        lines.append(f"{dim} is evenly laid out: where its values are no random draws, error and intervals say nothing.")
    return lines


def _of_quantiles(of: Statistics) -> list[str]:
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


def _without_result(of: Statistics | Share, what: str) -> list[str]:
    """How many of all cells have no result, why, their share, and what is meant by the numbers; empty where all have one."""
    gone, total = sum(of.causes.values()), of.cells * _groups(of)
    if not gone:
        return []
    share = f"a share of {gone / total:.4g}"
    if not np.isnan(of.level) and of.replicates is None:
        low, high = wilson(np.array(gone), np.array(total), of.level)
        share += f", {100 * of.level:g} % interval {low:.3g} to {high:.3g}"
    reasons = ", ".join(f"{n} {word}" for word, n in of.causes.items())
    return [f"{gone} of {total} cells without a result ({reasons}): {share}; {what} is of the other cells alone."]


def _cells(of: Statistics | Share) -> str:
    """Over what, of how many cells."""
    groups = _groups(of)
    many = f"{of.cells * groups} cells in {groups} groups" if groups > 1 else f"{of.cells} cells"
    return f"{', '.join(of.over)}: {many}"


def _groups(of: Statistics | Share) -> int:
    """How many groups of cells: axes within a cell make no more of them."""
    return int(np.prod([len(of.coords[dim]) for dim in of.dims if dim in of.cell_dims]))


def _table(of: Statistics | Share, cells: Mapping[str, Sequence[str]]) -> list[str]:
    """Aligned columns: the coordinates of the groups, then `cells`; thinned where there are many rows."""
    shape = tuple(len(of.coords[dim]) for dim in of.dims)
    count = int(np.prod(shape))
    index = np.indices(shape).reshape(len(shape), count)
    coords = {dim: [_coordinate(of.coords[dim][k]) for k in places] for dim, places in zip(of.dims, index, strict=True)}
    columns = {**coords, **cells}
    shown = np.unique(np.linspace(0, count - 1, min(count, ROWS)).round().astype(int)) if count else []
    rows = [list(columns), *([column[k] for column in columns.values()] for k in shown)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  " + "  ".join(word.rjust(width) for word, width in zip(row, widths, strict=True)) for row in rows]
    return lines + ([f"  {len(shown)} of {count} rows, evenly spread"] if len(shown) < count else [])


def _coordinate(value: Any) -> str:
    if isinstance(value, float | np.floating):
        return f"{value:.6g}"
    words = one_line(str(value))
    return words if len(words) <= WIDEST else f"{words[: WIDEST - 1]}…"


def _numbers(array: np.ndarray) -> list[str]:
    """Of all groups in a row, to 5 digits; counts whole."""
    whole = np.asarray(array).dtype.kind in "iu"
    return [f"{value}" if whole else f"{value:.5g}" for value in np.ravel(array)]


def _rows(count: int) -> str:
    return "1 row is" if count == 1 else f"{count} rows are"
