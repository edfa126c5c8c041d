"""What pictures of sweeps share: names with units, axes of coordinates, the last row in time, cells without a result in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.errors import PlotError
from nsmodel.plot import style
from nsmodel.sweep.variable import CELL_FAILED, DRAWN_DIMS, STATUS_NAMES, Variable, is_evenly_spaced

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

MAX_TICK_VALUES = 10  # So few values, and no nearer than this part of their range, are themselves the ticks.
LOG_SCALE_RATIO = 1e3  # Positive values whose largest is so many times the smallest have a logarithmic axis.


@dataclass(frozen=True, eq=False)
class Coordinate:
    """An axis of a picture: where the values of a coordinate are on it, in increasing order.

    Attributes:
        name: of the coordinate, with its unit.
        order: indices of the values, such that `places` increase.
        places: on the axis.
        words: at these places; None of numbers.
        log: whether the axis is logarithmic.
    """

    name: str
    order: np.ndarray
    places: np.ndarray
    labels: list[str] | None
    log: bool

    def on(self, axis: Any) -> None:
        """Give a matplotlib axis these ticks and this scale."""
        if self.labels is not None:
            labelled = style.evenly_spread(len(self.labels), 24)
            axis.set_ticks(self.places[labelled], [self.labels[k] for k in labelled])
        elif self.log:
            axis.axes.set(**{f"{axis.axis_name}scale": "log"})
        elif len(self.places) <= MAX_TICK_VALUES and np.diff(self.places).min(initial=np.inf) * MAX_TICK_VALUES >= np.ptp(
            self.places
        ):
            axis.set_ticks(self.places, [f"{place:.5g}" for place in self.places])


def coordinate(variable: Variable, name: str) -> Coordinate:
    """Return the axis of a coordinate: numbers in order, words one after the other, a geometric series on a logarithmic one."""
    values = variable.coords[name]
    label = coordinate_label(variable, name)
    if values.dtype.kind not in "biuf" or not np.isfinite(values).all() or len(np.unique(values)) < len(values):
        places = np.arange(len(values), dtype=float)
        return Coordinate(
            label, np.arange(len(values)), places, [style.safe_text(style.shorten(str(one), 18)) for one in values], False
        )
    order = np.argsort(values, kind="stable")
    places = values[order].astype(float)
    return Coordinate(
        label, order, places, None, places[0] > 0 and places[-1] > 20 * places[0] and is_evenly_spaced(places, geometric=True)
    )


def coordinate_label(variable: Variable, name: str) -> str:
    """A coordinate with its unit."""
    return style.with_unit(style.shorten(name, 40), variable.units.get(name, ""))


def quantity_label(variable: Variable) -> str:
    """The quantity with its unit."""
    return style.with_unit(style.shorten(variable.title, 48), variable.unit)


def coordinate_value_text(variable: Variable, name: str, index: int) -> str:
    """A coordinate as in "k = 5 N/m"; words as they are."""
    value, unit = variable.coords[name][index], variable.units.get(name, "")
    number = f"{value:.4g}" if variable.coords[name].dtype.kind in "biuf" else style.shorten(str(value))
    return f"{style.shorten(name)} = {number} {unit}".rstrip()


def required_dim(variable: Variable, name: str, what: str) -> str:
    """The dim that a coordinate is along; PlotError where there is none of this name."""
    if name in variable.dims:
        return name
    if name in variable.along:
        return variable.along[name]
    raise PlotError(f"{what}={name!r}: {variable.name} has {', '.join((*variable.dims, *variable.along)) or 'no dims'}")


def last_rows(variable: Variable, kept: Sequence[str]) -> tuple[Variable, str]:
    """The variable at the end of those axes within a cell that are not drawn, and words for it."""
    texts = []
    for dim in variable.dims:
        if dim not in variable.cell_dims and dim not in kept:
            texts += [coordinate_value_text(variable, dim, -1)] if variable.sizes[dim] > 1 else []
            variable = variable.take(dim, -1)
    return variable, f" at {', '.join(texts)}" if texts else ""


def parameter_dims(variable: Variable) -> list[str]:
    """The dims of cells along which values were laid out, the longest first."""
    laid = [dim for dim in variable.cell_dims if dim not in DRAWN_DIMS]
    return sorted(laid, key=lambda dim: -variable.sizes[dim])


def spans_decades(values: np.ndarray) -> bool:
    """Whether finite values are all positive and spread over three decades or more."""
    some = values[np.isfinite(values)]
    return bool(some.size and some.min() > 0 and some.max() >= LOG_SCALE_RATIO * some.min())


def missing_result_text(variable: Variable) -> str:
    """Such as "3 of 820 cells without a result: 2 failed, 1 not run"; empty where all have one."""
    causes = variable.causes
    if list(causes) == [STATUS_NAMES[CELL_FAILED]]:
        return f"{causes[STATUS_NAMES[CELL_FAILED]]} of {variable.status.size} cells failed"
    reasons = ", ".join(f"{n} {word}" for word, n in causes.items())
    return f"{sum(causes.values())} of {variable.status.size} cells without a result: {reasons}" if causes else ""


def missing_result_handles(variable: Variable, *, marker: str = "x") -> list[Line2D]:
    """Of `missing_result_text` an entry of a legend, or none."""
    from matplotlib.lines import Line2D

    label = missing_result_text(variable)
    return [Line2D([], [], color=style.ALERT, marker=marker, linestyle="", markersize=5, label=label)] if label else []


def write_note(ax: Axes, note: str) -> None:
    """Write words in the middle of axes on which there is nothing to draw."""
    box: dict[str, Any] = {"facecolor": "white", "edgecolor": "none", "pad": 4}
    ax.text(0.5, 0.5, note, transform=ax.transAxes, ha="center", va="center", fontsize=10, color=style.ALERT, bbox=box)
