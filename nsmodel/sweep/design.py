"""What a sweep varies: its dimensions, and the values of each cell."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np

from nsmodel import _utils
from nsmodel._utils import former_names
from nsmodel.errors import UsageError
from nsmodel.modeling.parameters import _scalar_names
from nsmodel.modeling.time_grid import is_number

SAMPLE, REPLICATE, SEED, STEP, INPUTS = "sample", "replicate", "seed", "step", "inputs"
MIN_CELL_BYTES = 32  # Bytes that a cell takes while a sweep is made, whatever is kept of it: its number, its places, its status.
RESERVED_DIMS = (SAMPLE, REPLICATE, SEED, STEP, INPUTS, "t", "cell")


@dataclass(frozen=True)
class DesignColumn:
    """One thing that varies.

    Attributes:
        kind: "value" (a parameter, or an argument of the model's function), "start", "step", "inputs" or "seed".
        name: of the parameter, argument or state.
        along: numbers of the dimensions along which it varies.
        values: (sizes of these dimensions, shape of one value), numbers or any objects.
    """

    kind: str
    name: str
    along: tuple[int, ...]
    values: np.ndarray

    def of(self, index: Sequence[np.ndarray]) -> np.ndarray:
        """The values (K, ...) of cells whose places along all dimensions are ``index``."""
        return self.values[tuple(index[axis] for axis in self.along)]

    @property
    def numeric(self) -> bool:
        """Whether it is numbers."""
        return self.values.dtype != object


@dataclass(frozen=True)
class SweepDesign:
    """The cells of a sweep, in the order of its dimensions, the last the fastest.

    Attributes:
        dims: names of the dimensions; coords: {dimension: its values}.
        columns: what varies.
        entropy: of the random numbers of starts, which are those of a cell's place alone.
    """

    dims: tuple[str, ...]
    coords: Mapping[str, np.ndarray]
    columns: tuple[DesignColumn, ...]
    entropy: int

    @property
    def shape(self) -> tuple[int, ...]:
        """The sizes of the dimensions."""
        return tuple(len(self.coords[dim]) for dim in self.dims)

    @property
    def size(self) -> int:
        """The number of cells."""
        return prod(self.shape)

    def places(self, cells: np.ndarray) -> tuple[np.ndarray, ...]:
        """Where cells (K,) stand along each dimension."""
        return np.unravel_index(cells, self.shape) if self.dims else ()

    def values(self, cells: np.ndarray) -> Iterator[tuple[DesignColumn, np.ndarray]]:
        """Each column with its values (K, ...) at cells (K,)."""
        places = self.places(cells)
        for column in self.columns:
            yield (
                column,
                column.of(places) if column.along else np.broadcast_to(column.values, (len(cells), *column.values.shape)),
            )

    def rng(self, cell: int) -> np.random.Generator:
        """The random numbers of a cell: the same whoever computes it, and whatever is added to the sweep."""
        key = tuple(int(place[0]) for place in self.places(np.array([cell])))
        return np.random.default_rng(np.random.SeedSequence(self.entropy, spawn_key=key))


def make_design(
    grid: Mapping[Any, Any] | None,
    samples: Mapping[Any, Any] | None,
    start: Mapping[Any, Any] | Callable[..., Any] | None,
    seeds: Sequence[int] | int | None,
    step: Any,
    inputs: Any,
    entropy: int | None,
    replicates: bool = False,
) -> SweepDesign:
    """Read what varies.

    Raises:
        UsageError: both grid and samples, empty or wrong values, a name that comes twice or is one of a dimension.
    """
    if grid is not None and samples is not None:
        raise UsageError("grid and samples are both given: a grid is a product of values, samples are points; keep one")
    made = _DesignBuilder()
    if grid is not None:
        for name, values in _read_items(grid, "grid", "{name: values}"):
            made.add_dimension(name, "value", name, values, f"grid: '{name}'")
    if samples is not None:
        made.add_samples(samples, bool(replicates))
    if isinstance(start, Mapping):
        for name, values in _read_items(start, "start", "{state: values}"):
            made.start(name, values)
    elif start is not None and not callable(start):
        raise UsageError(f"start = {start!r:.60}; expected {{state: values}}, or a function of a random generator")
    if step is not None and np.ndim(step):
        made.add_dimension(STEP, STEP, STEP, step, "step", positive=True)
    if isinstance(inputs, Sequence) and not isinstance(inputs, str):
        made.inputs({str(i): one for i, one in enumerate(inputs)})
    elif isinstance(inputs, Mapping) and inputs and all(isinstance(one, Mapping) for one in inputs.values()):
        made.inputs(inputs)
    if seeds is not None:
        made.add_dimension(SEED, SEED, SEED, _read_seeds(seeds), "seeds")
    if not made.dims:
        raise UsageError(
            "nothing varies: give grid={name: values}, samples={name: array}, start={state: values}, seeds=range(20), or several "
            "steps or inputs; for one run there is nsmodel.simulate"
        )
    design = SweepDesign(tuple(made.dims), made.coords, tuple(made.columns), _check_entropy(entropy))
    check_memory(design.dims, design.shape, MIN_CELL_BYTES)
    return design


def check_memory(dims: Sequence[str], shape: Sequence[int], each: float) -> None:
    """Raise UsageError for so many cells that their numbers, of ``each`` bytes a cell, are more than this machine has memory."""
    size, most = prod(shape), _utils.usable_memory()
    if most is not None and size * each > most:
        of = " x ".join(f"{dim} {count:,}" for dim, count in zip(dims, shape, strict=True))
        raise UsageError(
            f"{size:,} cells ({of}) take {_utils.format_bytes(size * each)} of memory, and there are "
            f"{_utils.format_bytes(most)}; give fewer values, or sweep them in parts"
        )


class _DesignBuilder:
    """Dimensions and columns, one after the other."""

    def __init__(self) -> None:
        self.dims: list[str] = []
        self.coords: dict[str, np.ndarray] = {}
        self.columns: list[DesignColumn] = []

    def add_dimension(self, dim: str, kind: str, name: str, values: Any, label: str, *, positive: bool = False) -> None:
        """A dimension of its own for one name."""
        array = _read_values(values, label)
        if not len(array):
            raise UsageError(f"{label}: no values; give at least one")
        if positive and not (array.dtype != object and array.ndim == 1 and (array > 0).all()):
            raise UsageError(f"{label} = {values!r:.60}; expected numbers > 0")
        if kind == "value" and name in RESERVED_DIMS:
            raise UsageError(
                f"{label}: '{name}' is the name of a dimension of its own; give {_alternative_argument(name)}, or rename it"
            )
        if dim in self.coords:
            raise UsageError(f"{label}: '{dim}' is given twice; keep one")
        self.columns.append(DesignColumn(kind, name, (len(self.dims),), array))
        self.dims.append(dim)
        scalar = array.ndim == 1 and (array.dtype != object or all(isinstance(one, str) for one in array))
        self.coords[dim] = (array.astype(str) if array.dtype == object else array) if scalar else np.arange(len(array))

    def add_samples(self, given: Any, replicates: bool) -> None:
        """Points that belong together: (N, ...) of each name, or (R, N, ...) for R replicates; names in a tuple share a table."""
        shapes: dict[str, tuple[int, ...]] = {}
        for key, values in _read_items(given, "samples", "{name: array}"):
            for name, array in _named_columns(key, values):
                label = f"samples: '{name}'"
                if name in shapes:
                    raise UsageError(f"{label} is given twice; keep one")
                if name in RESERVED_DIMS:
                    raise UsageError(f"{label} is the name of a dimension; give {_alternative_argument(name)}")
                self.columns.append(DesignColumn("value", name, (), array))
                shapes[name] = array.shape
        first, lead = next((name, shape[: 1 + replicates]) for name, shape in shapes.items())
        for name, shape in shapes.items():
            if len(shape) < 1 + replicates:
                raise UsageError(f"samples: '{name}' has shape {shape}; expected (replicates, points)")
            if shape[: 1 + replicates] != lead:
                raise UsageError(
                    f"samples: '{name}' has {_points_text(shape, lead)} and '{first}' {_points_text(lead, lead)}; give as many "
                    "of each"
                )
        if not prod(lead):
            raise UsageError("samples: no points; give at least one")
        self.dims = [REPLICATE, SAMPLE] if replicates else [SAMPLE]
        self.columns = [DesignColumn(c.kind, c.name, tuple(range(len(lead))), c.values) for c in self.columns]
        self.coords = {dim: np.arange(size) for dim, size in zip(self.dims, lead, strict=True)}

    def start(self, name: str, values: Any) -> None:
        """Starts of a state: along the samples where there are as many, else a dimension of their own."""
        if SAMPLE not in self.dims:
            self.add_dimension(f"{name}(0)", "start", name, values, f"start: '{name}'")
            return
        array, lead = _read_values(values, f"start: '{name}'"), tuple(len(self.coords[dim]) for dim in self.dims)
        if array.shape[: len(lead)] != lead:
            raise UsageError(f"start: '{name}' has {len(array)} values; expected {lead[-1]}, one for each sample")
        self.columns.append(DesignColumn("start", name, tuple(range(len(lead))), array))

    def inputs(self, given: Mapping[Any, Any]) -> None:
        """Several signals for the inputs, by labels."""
        values = np.empty(len(given), object)
        values[:] = list(given.values())
        if not len(values):
            raise UsageError("inputs: an empty list; give at least one {name: signal}")
        for label, one in given.items():
            if not isinstance(one, Mapping):
                raise UsageError(f"inputs: {label} is {one!r:.60}; expected {{name: signal}}")
        self.columns.append(DesignColumn(INPUTS, INPUTS, (len(self.dims),), values))
        self.dims.append(INPUTS)
        self.coords[INPUTS] = np.array([str(label) for label in given])


def _points_text(shape: tuple[int, ...], lead: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape[: len(lead)])) + " points"


def _alternative_argument(name: str) -> str:
    return {SEED: "seeds=", STEP: "step=", INPUTS: "inputs="}.get(name, "another name")


def _read_items(given: Any, label: str, expected: str) -> Iterator[tuple[Any, Any]]:
    """The pairs of a dictionary, symbols by their names."""
    if not isinstance(given, Mapping) or not given:
        raise UsageError(f"{label} = {given!r:.60}; expected a dictionary {expected}, not empty")
    for key, values in given.items():
        yield key if isinstance(key, str | tuple) else _symbol_name(key, label), values


def _symbol_name(key: Any, label: str) -> str:
    names = _scalar_names(key)
    if names.ndim:
        stem = str(names.ravel()[0]).rpartition("_")[0]
        return stem or str(names.ravel()[0])
    return str(names)


def _named_columns(key: Any, values: Any) -> Iterator[tuple[str, np.ndarray]]:
    """The names of a table's columns, each with its values; one name with its own."""
    if isinstance(key, str):
        yield key, _read_values(values, f"samples: '{key}'")
        return
    names = [one if isinstance(one, str) else _symbol_name(one, "samples") for one in key]
    table = _read_values(values, f"samples: {', '.join(names)}")
    if table.ndim < 2 or table.shape[-1] != len(names):
        raise UsageError(f"samples: a table of shape {table.shape} for {', '.join(names)}; expected (points, {len(names)})")
    for i, name in enumerate(names):
        yield name, table[..., i]


def _read_values(values: Any, label: str) -> np.ndarray:
    """Values along the first axis: finite numbers, or other things one by one."""
    if is_number(values) or isinstance(values, str | bytes):
        raise UsageError(f"{label} = {values!r:.60}; expected several values, a list or an array")
    try:
        listed = values if isinstance(values, np.ndarray) else list(values)
        array = np.asarray(listed)
        if array.dtype.kind == "U" and not all(isinstance(one, str) for one in listed):
            raise ValueError("numbers among texts stay numbers")
    except (TypeError, ValueError):
        try:
            array = np.empty(len(values), object)
            array[:] = list(values)
        except TypeError:
            raise UsageError(f"{label} = {values!r:.60}; expected several values, a list or an array") from None
    if array.ndim == 0:
        raise UsageError(f"{label} = {values!r:.60}; expected several values, a list or an array")
    if array.dtype.kind in "iu":
        return array
    if array.dtype.kind in "f":
        if not np.isfinite(array).all():
            raise UsageError(f"{label}: {array[~np.isfinite(array)][0]} is not a finite number")
        return array.astype(float)
    if array.dtype.kind == "b":
        array = array.astype(object)
    if array.dtype.kind not in "OU":
        raise UsageError(f"{label}: values of type {array.dtype}; expected numbers")
    return array.astype(object)


def _read_seeds(seeds: Any) -> np.ndarray:
    """Seeds: whole numbers >= 0; a number N stands for 0, ..., N-1."""
    given: Any = range(seeds) if isinstance(seeds, int | np.integer) and not isinstance(seeds, bool) else seeds
    try:
        array = np.asarray(list(given))
    except TypeError:
        array = np.zeros(0)
    whole = array.ndim == 1 and array.dtype.kind in "iu"
    if not (whole and array.size and array.min() >= 0 and len(np.unique(array)) == len(array)):
        raise UsageError(f"seeds = {seeds!r:.60}; expected different whole numbers >= 0, such as range(20)")
    return array


def _check_entropy(entropy: int | None) -> int:
    if entropy is None:
        return 0
    if not (isinstance(entropy, int | np.integer) and not isinstance(entropy, bool) and entropy >= 0):
        raise UsageError(f"entropy = {entropy!r:.60}; expected a whole number >= 0")
    return int(entropy)


__getattr__ = former_names(__name__, Column="DesignColumn", Design="SweepDesign")
