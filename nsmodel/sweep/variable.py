"""One quantity over the cells of a sweep: its values, what its axes are, and what came of each cell.

The cells that a statistic is over, brought to the last axis; what is refused of them.

``status`` travels with the values through `take`, `map`, comparisons and differences: a failed cell is data. Who reduces over
cells goes through the groups here, which leave out what is not done and keep the count. xarray is known by its attributes
(`as_variable`), never imported.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from nsmodel._utils import did_you_mean, display, one_line
from nsmodel.errors import UsageError
from nsmodel.files.archive import ArrayPartOnDisk

# Statuses of a cell, as files have them.
CELL_NOT_RUN, CELL_DONE, CELL_FAILED, CELL_INTERRUPTED, CELL_REFUSED = -1, 0, 1, 2, 3
STATUS_NAMES = {
    CELL_DONE: "done",
    CELL_FAILED: "failed",
    CELL_INTERRUPTED: "interrupted",
    CELL_REFUSED: "no model",
    CELL_NOT_RUN: "not run",
}
DRAWN_DIMS = ("seed", "sample", "replicate", "start")  # Dims along which cells are draws, not values that were laid out.
TIME_DIM = "t"


@dataclass(frozen=True, eq=False, repr=False)
class Variable:
    """Values of one quantity over the cells of a sweep.

    Comparisons with a number (`rest > 0.5`) give a variable of 1 and 0, and NaN where the value is: a condition for `share`.
    `&`, `|` and `~` join them.

    Attributes:
        name: of the quantity, as the user wrote it.
        values: array with an axis for each of `dims`; those of a file are read, and verified, when they are asked for.
        dims: names of the axes, such as ("mu1", "k", "seed", "t").
        coords: {name: values along its dim}; each of `dims` has one. Others, such as the parameters of samples, are in `along`.
        status: int8, over `cell_dims`: 0 done, 1 failed, 2 interrupted, 3 no model, -1 not run.
        cell_dims: those of `dims` that tell cells apart, in their order; the others ("t") are axes within a cell.
        unit: of the values.
        label: in words; empty: the name.
        low_discrepancy: whether the samples are a Sobol, Halton or Latin hypercube net, whose points are not independent.
        units: {name of a coordinate: its unit}.
        along: {name of a coordinate that is not a dim: its dim}.

    Raises:
        UsageError: shapes, dims and coordinates that do not belong together.
    """

    name: str
    values: np.ndarray
    dims: tuple[str, ...]
    coords: Mapping[str, np.ndarray]
    status: np.ndarray
    cell_dims: tuple[str, ...]
    unit: str = ""
    label: str = ""
    low_discrepancy: bool = False
    units: Mapping[str, str] = field(default_factory=dict)
    along: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        values = self.values if isinstance(self.values, ArrayPartOnDisk) else _read_only(np.asarray(self.values))
        if values.dtype.kind not in "biuf":
            raise UsageError(f"{self.name}: values of type {values.dtype}; expected real numbers")
        object.__setattr__(self, "_given", values)
        if isinstance(values, ArrayPartOnDisk):
            object.__delattr__(self, "values")
        checked = {
            **({} if isinstance(values, ArrayPartOnDisk) else {"values": values}),
            "status": _read_only(np.asarray(self.status, dtype=np.int8)),
            "dims": tuple(self.dims), "cell_dims": tuple(self.cell_dims),
            "coords": {name: _read_only(np.asarray(of)) for name, of in self.coords.items()},
            "units": dict(self.units), "along": dict(self.along),
        }  # fmt: skip
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        _check_shapes(self)

    def __getattr__(self, name: str) -> Any:
        """Read the values of a file when they are first asked for."""
        if name != "values" or "_given" not in vars(self):
            raise AttributeError(f"a variable has no '{name}'{did_you_mean(name, dir(type(self)))}")
        given = vars(self)["_given"]
        values = _read_only(given.values if isinstance(given, ArrayPartOnDisk) else given)
        object.__setattr__(self, "values", values)
        return values

    @property
    def _shape(self) -> tuple[int, ...]:
        return vars(self)["_given"].shape

    @classmethod
    def of(
        cls, name: str, values: Any, dims: str | Sequence[str], coords: Mapping[str, Any] | None = None, *, status: Any = None,
        cell_dims: Sequence[str] | None = None, **more: Any,
    ) -> Variable:  # fmt: skip
        """Make a variable, and fill in what is left out.

        Args:
            name: of the quantity.
            values: array with an axis for each of `dims`.
            dims: names of the axes; a single one may be a string.
            coords: {name: values}; left out for a dim: 0, 1, ...
            status: of the cells; left out: all are done.
            cell_dims: left out: all dims but "t".
            more: the other attributes.
        """
        dims = (dims,) if isinstance(dims, str) else tuple(dims)
        cells = tuple(dim for dim in dims if dim != TIME_DIM) if cell_dims is None else tuple(cell_dims)
        shape = dict(zip(dims, np.shape(values), strict=False))
        known = {**{dim: np.arange(n) for dim, n in shape.items()}, **(coords or {})}
        if status is None:
            status = np.zeros([shape.get(dim, 0) for dim in cells], dtype=np.int8)
        return cls(name, np.asarray(values), dims, known, status, cells, **more)

    def __repr__(self) -> str:
        """Return one line: name, unit, dims with their lengths, range of the values, what came of the cells."""
        of = " x ".join(f"{dim} {size}" for dim, size in self.sizes.items()) or "one value"
        finite = self.values[np.isfinite(self.values)]
        span = f", {finite.min():.6g} to {finite.max():.6g}" if finite.size else ""
        missing = "".join(f", {count} {word}" for word, count in self.causes.items())
        return one_line(f"Variable({self.name!r}, {of}{span}{f' {self.unit}' if self.unit else ''}{missing})")

    @property
    def sizes(self) -> dict[str, int]:
        """{dim: its length}."""
        return dict(zip(self.dims, self._shape, strict=True))

    @property
    def everywhere(self) -> np.ndarray:
        """The status of the cell of each of the values: their shape."""
        within = tuple(k for k, dim in enumerate(self.dims) if dim not in self.cell_dims)
        return np.broadcast_to(np.expand_dims(self.status, within), self._shape)

    @property
    def done(self) -> np.ndarray:
        """Of each of the values whether its cell is done, bool."""
        return self.everywhere == CELL_DONE

    @property
    def title(self) -> str:
        """The label in words, or else the name."""
        return self.label or self.name

    @property
    def causes(self) -> dict[str, int]:
        """{"failed": 2, ...}: of the cells that have no result, how many came to what; empty where all are done."""
        return failure_counts(self.status)

    def take(self, dim: str, index: int) -> Variable:
        """Return the variable at one index of a dim, which is gone then."""
        if dim not in self.dims:
            raise UsageError(f"{self.name} has no dim {dim!r}; its dims are {', '.join(self.dims) or 'none'}")
        axis, gone = self.dims.index(dim), {dim, *(name for name, of in self.along.items() if of == dim)}
        status, cells = self.status, self.cell_dims
        if dim in cells:
            status = status.take(index, axis=cells.index(dim))
        return replace(
            self, values=vars(self)["_given"].take(index, axis=axis), dims=_dims_without(self.dims, dim), status=status,
            cell_dims=_dims_without(cells, dim), coords={name: of for name, of in self.coords.items() if name not in gone},
            along={name: of for name, of in self.along.items() if of != dim},
        )  # fmt: skip

    def at(self, **where: Any) -> Variable:
        """Return the variable where dims have these coordinates: of numbers the nearest, `x.at(t=2.5, k=10)`."""
        found = self
        for dim, value in where.items():
            if dim not in found.dims:
                raise UsageError(f"{self.name} has no dim {dim!r}; its dims are {', '.join(found.dims) or 'none'}")
            found = found.take(dim, _nearest_index(found.coords[dim], dim, value))
        return found

    def map(self, function: Callable[[np.ndarray], Any], label: str = "", unit: str = "") -> Variable:
        """Return the variable whose values are function(values), an array of the same shape."""
        values = np.asarray(function(self.values))
        if values.shape != self.values.shape:
            raise UsageError(f"map of {self.name}: the function returns shape {values.shape}; expected {self.values.shape}")
        return replace(self, values=values, label=label, unit=unit)

    def plot(self, **options: Any) -> Any:
        """Draw the quantity over what varies, and return the axes.

        Without options it is the picture that fits (``nsmodel.plot.sweep_overview``): a line over one parameter, a map of two,
        a histogram of samples. With ``x`` and ``y`` it is that of ``nsmodel.plot.sweep_map``, with other options (x, hue, over,
        show, level) that of ``nsmodel.plot.sweep_line``; ``ax`` is where to draw.

        Raises:
            PlotError: no such dims.
        """
        return display("draw_variable", self, **options)

    def _holds(self, sign: str, compare: Callable[[Any, Any], Any], other: Any) -> Variable:
        if np.ndim(other) or np.asarray(other).dtype.kind not in "biuf":
            what = f"an array of shape {np.shape(other)}" if np.ndim(other) else repr(other)
            raise UsageError(f"{self.name} {sign} {what}; expected a number")
        holds = np.where(np.isnan(self.values), np.nan, compare(self.values, other))
        return self.map(lambda _: holds, f"{self.title} {sign} {other:g}")

    def __lt__(self, other: float) -> Variable:
        return self._holds("<", np.less, other)

    def __le__(self, other: float) -> Variable:
        return self._holds("<=", np.less_equal, other)

    def __gt__(self, other: float) -> Variable:
        return self._holds(">", np.greater, other)

    def __ge__(self, other: float) -> Variable:
        return self._holds(">=", np.greater_equal, other)

    def __and__(self, other: Variable) -> Variable:
        return combine_variables(self, other, np.minimum, "and")

    def __or__(self, other: Variable) -> Variable:
        return combine_variables(self, other, np.maximum, "or")

    def __invert__(self) -> Variable:
        return self.map(lambda values: 1.0 - values, f"not ({self.title})")


def combine_variables(a: Variable, b: Variable, operation: Callable[[Any, Any], Any], word: str) -> Variable:
    """Return operation(a, b), cell by cell; a cell is done where it is in both.

    Raises:
        UsageError: they have not the same dims and coordinates.
    """
    if not isinstance(b, Variable):
        raise UsageError(f"{a.name} {word} {b!r}; expected another variable of the same cells")
    check_same_cells(a, b)
    status = np.where(a.status != CELL_DONE, a.status, b.status)
    return replace(
        a, name=f"{a.name} {word} {b.name}", label=f"{a.title} {word} {b.title}", values=operation(a.values, b.values),
        status=status, unit=a.unit if a.unit == b.unit else "", low_discrepancy=a.low_discrepancy or b.low_discrepancy,
    )  # fmt: skip


def check_same_cells(a: Variable, b: Variable) -> None:
    """Refuse two variables whose values do not belong to the same cells: UsageError names the first that differs."""
    if a.dims != b.dims or a.cell_dims != b.cell_dims:
        raise UsageError(f"{a.name} has the dims {a.dims}, {b.name} has {b.dims}; expected the same")
    for name, here in a.coords.items():
        other = b.coords.get(name, here[:0])
        if here.shape != other.shape:
            raise UsageError(f"{name} has {len(here)} values of {a.name} and {len(other)} of {b.name}; expected the same values")
        differs = np.flatnonzero(here != other)
        if differs.size:
            k = differs[0]
            raise UsageError(
                f"{name}[{k}] is {here[k]} of {a.name} and {other[k]} of {b.name}; expected the same values in the same order"
            )


def as_variable(found: Any, what: str = "statistics") -> Variable:
    """Return a variable as it is, an `xarray.DataArray` as one.

    Of a DataArray the dims of its coordinate `status` are the cells; without one all dims but "t" are, and all cells are done.
    Units are `attrs["units"]`, the label is `attrs["long_name"]`, samples of a net have `attrs["low_discrepancy"]`.
    """
    if isinstance(found, Variable):
        return found
    if not all(hasattr(found, part) for part in ("dims", "values", "coords")) or callable(found.values):
        raise UsageError(f"{what}: expected a variable of a sweep or an xarray.DataArray, not {type(found).__name__}")
    dims, attrs = tuple(map(str, found.dims)), getattr(found, "attrs", {})
    coords = {str(name): of for name, of in found.coords.items() if np.ndim(of.values) == 1 and str(name) != "status"}
    status = found.coords["status"] if "status" in found.coords else None
    more: dict[str, Any] = {}
    if status is not None:
        cells = tuple(dim for dim in dims if dim in status.dims)
        more = {"status": np.transpose(status.values, [status.dims.index(dim) for dim in cells]), "cell_dims": cells}
    return Variable.of(
        str(getattr(found, "name", None) or "value"), found.values, dims, {name: of.values for name, of in coords.items()},
        unit=str(attrs.get("units", "")), label=str(attrs.get("long_name", "")),
        low_discrepancy=bool(attrs.get("low_discrepancy", False)),
        units={name: str(of.attrs["units"]) for name, of in coords.items() if getattr(of, "attrs", {}).get("units")},
        along={name: str(of.dims[0]) for name, of in coords.items() if name not in dims}, **more,
    )  # fmt: skip


def failure_counts(status: np.ndarray) -> dict[str, int]:
    """{"failed": 2, ...} of the cells that are not done, by what came of them."""
    counts = Counter(np.asarray(status).ravel().tolist())
    return {STATUS_NAMES[code]: counts[code] for code in STATUS_NAMES if code != CELL_DONE and counts[code]}


def _check_shapes(self: Variable) -> None:
    if len(set(self.dims)) < len(self.dims) or len(self.dims) != len(self._shape):
        raise UsageError(f"{self.name}: values of shape {self._shape} with dims {self.dims}; expected a name for each axis")
    if self.cell_dims != tuple(dim for dim in self.dims if dim in self.cell_dims):
        raise UsageError(f"{self.name}: cell_dims {self.cell_dims}; expected some of {self.dims}, in that order")
    sizes = self.sizes
    cells = tuple(sizes[dim] for dim in self.cell_dims)
    if self.status.shape != cells:
        raise UsageError(f"{self.name}: status of shape {self.status.shape}; expected {cells}, over {self.cell_dims}")
    unknown = np.setdiff1d(self.status, list(STATUS_NAMES))
    if unknown.size:
        raise UsageError(f"{self.name}: status {unknown[0]}; expected one of {', '.join(map(str, STATUS_NAMES))}")
    for name in (*self.dims, *self.coords):
        dim = name if name in sizes else self.along.get(name)
        if dim not in sizes or name not in self.coords:
            raise UsageError(
                f"{self.name}: {name} is not a dim of {self.dims}; along={{{name!r}: DIM}} says along which dim it lies"
            )
        if self.coords[name].shape != (sizes[dim],):
            raise UsageError(f"{self.name}: {name} of shape {self.coords[name].shape}; expected ({sizes[dim]},), along {dim}")


def _nearest_index(coordinate: np.ndarray, dim: str, value: Any) -> int:
    if coordinate.dtype.kind in "biuf" and np.asarray(value).dtype.kind in "biuf":
        return int(np.abs(coordinate - value).argmin())
    equal = np.flatnonzero(coordinate == value)
    if not equal.size:
        few = f"{', '.join(map(str, coordinate[:8]))}{', ...' if len(coordinate) > 8 else ''}"
        raise UsageError(f"{dim} is never {value!r}; its values are {few}")
    return int(equal[0])


def _read_only(array: np.ndarray) -> np.ndarray:
    view = array.view()
    view.flags.writeable = False
    return view


def _dims_without(dims: tuple[str, ...], dim: str) -> tuple[str, ...]:
    return tuple(name for name in dims if name != dim)


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
                f"over={dim!r}: {dim} is an axis within each cell, whose values are not independent draws; over= takes "
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
            raise UsageError(f"{replicates} has {variable.sizes[replicates]} value; a standard error takes 2 replicates or more")
    elif variable.low_discrepancy and not np.isnan(level) and ("sample" in over or "sample" not in variable.cell_dims):
        raise UsageError(
            f"{variable.name}: points of a low-discrepancy net are not independent, so a mean over them has no standard error; "
            "sweep several independent scrambled nets along a dim, 8 for example, and name it: replicates='replicate'; or leave "
            "the error out: level=None"
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
