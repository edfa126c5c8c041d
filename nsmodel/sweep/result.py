"""The result of a sweep: every cell's rows and numbers, what failed and why; as variables, text, CSV, xarray, pictures.

A sweep as other programs read it: npz, a table of its cells, xarray and what that writes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from nsmodel._utils import did_you_mean, escape_invisible, former_names, html_repr, import_extra, labelled_lines
from nsmodel.errors import MissingExtraError, StepError, StorageError, UsageError
from nsmodel.files.archive import StoredArrays, map_archive, write_npz
from nsmodel.files.storage import dumps, replace_atomically, write_csv
from nsmodel.sweep.request import ALONE_BACKEND, CELL_BACKENDS
from nsmodel.sweep.statistics import wilson_interval
from nsmodel.sweep.store import (
    CODE_CHECKS,
    DIM_PREFIX,
    FILE_METADATA_KEYS,
    LABELS_KEY,
    SWEEP_FILE,
    VALUE_PREFIX,
    check_sweep_file,
)
from nsmodel.sweep.variable import CELL_DONE, CELL_FAILED, CELL_NOT_RUN, STATUS_NAMES, Variable


def design_arrays(sweep: Sweep) -> dict[str, np.ndarray]:
    """What varies, and the times of the rows, as files have them; texts are in the ``header``."""
    dims = {f"dim:{dim}": sweep.coords[dim] for dim in sweep.dims if sweep.coords[dim].dtype.kind != "U"}
    return dims | {f"value:{name}": values for name, (values, _) in sweep.varied.items()} | {"t": sweep.t}


def sweep_metadata(sweep: Sweep) -> dict[str, Any]:
    """The metadata of its file."""
    along = {name: list(axes) for name, (_, axes) in sweep.varied.items()}
    labels = {dim: sweep.coords[dim].tolist() for dim in sweep.dims if sweep.coords[dim].dtype.kind == "U"}
    texts = {"labels": labels} if labels else {}
    return {**sweep.metadata, "dims": list(sweep.dims), "along": along, "shape": list(sweep.shape), **texts}


def cell_table(sweep: Sweep) -> dict[str, np.ndarray]:
    """One row a cell: its number, what varies, outputs, facts, status in words and message."""
    places = np.unravel_index(np.arange(sweep.size), sweep.shape) if sweep.dims else ()
    found: dict[str, np.ndarray] = {"cell": np.arange(sweep.size)}
    found |= {dim: np.asarray(sweep.coords[dim])[place] for dim, place in zip(sweep.dims, places, strict=True)}
    numbers = {name: values[tuple(places[axis] for axis in axes)] for name, (values, axes) in sweep.varied.items()}
    numbers |= {name: sweep.cells[name] for name in sweep.cells if name not in (*sweep.metadata.get("keep", ()), "status")}
    for name, values in numbers.items():
        own = values.reshape(sweep.size, -1).T
        found |= {name if len(own) == 1 else f"{name}_{i}": column for i, column in enumerate(own)}
    found["way"] = np.array([CELL_BACKENDS[way] if way >= 0 else "" for way in sweep.cells["way"].tolist()])
    found["status"] = np.array([STATUS_NAMES[code] for code in sweep.cells["status"].tolist()])
    found["message"] = np.array([sweep.messages.get(cell, "") for cell in range(sweep.size)])
    return found


def sweep_dataset(sweep: Sweep) -> Any:
    """An ``xarray.Dataset``: quantities along the sweep's dimensions and their own, what varies as coordinates."""
    xarray = import_extra("xarray")
    units = {name: {"units": unit} for name, unit in sweep.units.items()}
    data: dict[str, Any] = {}
    for name in sweep.cells:
        if name != "status":
            variable = sweep[name]
            data[name] = (variable.dims, variable.values, units.get(name))
    coords: dict[str, Any] = {dim: (dim, np.asarray(sweep.coords[dim]), units.get(dim)) for dim in sweep.dims}
    coords["status"] = (sweep.dims, sweep.status)
    if sweep.metadata.get("keep"):
        coords["t"] = ("t", sweep.t, units.get("t"))
    for name, (values, axes) in sweep.varied.items():
        if name not in coords and values.ndim == len(axes):
            coords[name] = (tuple(sweep.dims[axis] for axis in axes), values, units.get(name))
    data["message"] = (sweep.dims, np.array([sweep.messages.get(cell, "") for cell in range(sweep.size)]).reshape(sweep.shape))
    plain = {key: value if type(value) in (str, int, float) else dumps(value) for key, value in sweep.metadata.items()}
    found = xarray.Dataset(data, coords, plain)
    if sweep.metadata.get("low_discrepancy"):
        for name in data:
            found[name].attrs["low_discrepancy"] = 1
    return found


# Kinds of failures that a summary counts, the most frequent first: failures are few kinds, and all are in the result.
MAX_FAILURE_KINDS = 4


@dataclass(frozen=True, eq=False, repr=False)
class Sweep:
    """What became of the cells of a sweep, in the order of its dimensions.

    A quantity is an item, or an attribute where its name allows it: ``result["x1"]``, ``result.x1`` is a `Variable`
    (mu1, k, seed, t). Every sweep has ``status`` (0 done, 1 failed, 2 interrupted, 3 refused, -1 not run), ``failed_at``,
    ``steps``, ``worst_residual``, ``index_set_changes`` and ``way``.

    Attributes:
        dims: names of the dimensions of its cells; coords: {dimension: its values}.
        varied: {name: (values, numbers of the dimensions along which they vary)}, of parameters, starts and arguments.
        t: times (R,) of the rows that are kept.
        cells: {name: (size, ...)}, cell after cell; files hold these.
        messages: {cell: why it is not done}.
        metadata: title, units, settings, how it was run.
        engine: who computed, where that is known.
    """

    dims: tuple[str, ...]
    coords: Mapping[str, np.ndarray]
    varied: Mapping[str, tuple[np.ndarray, tuple[int, ...]]]
    t: np.ndarray
    cells: Mapping[str, np.ndarray]
    messages: Mapping[int, str]
    metadata: Mapping[str, Any]
    engine: str = ""
    _again: Callable[..., Any] | None = field(default=None)

    _repr_html_ = html_repr("sweep_html")

    @property
    def shape(self) -> tuple[int, ...]:
        """How many cells there are along each dimension."""
        return tuple(len(self.coords[dim]) for dim in self.dims)

    @property
    def size(self) -> int:
        """How many cells there are."""
        return int(np.prod(self.shape, dtype=int))

    @property
    def title(self) -> str:
        """The model's title."""
        return self.metadata.get("title") or "untitled"

    @property
    def status(self) -> np.ndarray:
        """What came of each cell, int8 in the sweep's shape: 0 done, 1 failed, 2 interrupted, 3 refused, -1 not run."""
        return self.cells["status"].reshape(self.shape)

    @property
    def plan(self) -> str:
        """How the cells were run, in words."""
        return self.metadata["plan"] + (f"; {self.engine}" if self.engine else "")

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """{name: array} of all quantities, each in the sweep's shape with its own axes behind."""
        return {name: values.reshape(*self.shape, *values.shape[1:]) for name, values in self.cells.items()}

    @cached_property
    def units(self) -> dict[str, str]:
        """{name: unit}, as far as they are known."""
        return dict(self.metadata.get("units", {}))

    def __getitem__(self, name: str) -> Variable:
        """Return a quantity as a variable; KeyError lists what there is."""
        if name not in self.cells:
            raise KeyError(f"this sweep has no '{name}'; it has {', '.join(self.cells)}")
        values: Any = self.cells.part(name) if isinstance(self.cells, StoredArrays) else self.cells[name]
        own = self._own_axes(name, values.shape[1:])
        coords = dict(self.coords) | {axis: at for axis, at in own.items()}
        along = {key: self.dims[axes[0]] for key, (of, axes) in self.varied.items() if self._is_coordinate(key)}
        coords |= {key: self.varied[key][0] for key in along}
        return Variable(
            name, values.reshape(*self.shape, *values.shape[1:]), (*self.dims, *own), coords, self.status, self.dims,
            unit=self.units.get(name, ""), low_discrepancy=bool(self.metadata.get("low_discrepancy")), along=along,
            units={key: self.units[key] for key in coords if key in self.units},
        )  # fmt: skip

    def __getattr__(self, name: str) -> Variable:
        """Find a quantity by its name."""
        if name.startswith("_") or "cells" not in vars(self) or name not in self.cells:
            known = vars(self).get("cells", ())
            near = did_you_mean(name, [*known, *dir(type(self))])
            raise AttributeError(f"this sweep has no '{name}'; it has {', '.join(known)}{near}")
        return self[name]

    def __dir__(self) -> list[str]:
        """List the quantities among the attributes."""
        return sorted({*super().__dir__(), *self.cells})

    def _is_coordinate(self, name: str) -> bool:
        """Whether what varies is a coordinate along one dimension that is not its own."""
        values, axes = self.varied[name]
        return len(axes) == 1 and self.dims[axes[0]] != name and name not in self.dims and values.ndim == 1

    def _own_axes(self, name: str, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
        """The axes of a quantity behind those of the cells."""
        if not shape:
            return {}
        kept = name in self.metadata.get("keep", ())
        axes = {"t": self.t} if kept else {}
        rest = shape[1:] if kept else shape
        return axes | {f"{name}_{i}" if len(rest) > 1 else f"{name}_entry": np.arange(size) for i, size in enumerate(rest)}

    def at(self, cell: int) -> dict[str, Any]:
        """Return what varies, by name, and its values at a cell: ``result.at(7)``.

        UsageError where there is no such cell.
        """
        if not -self.size <= cell < self.size:
            raise UsageError(f"cell {cell}: the sweep has the cells 0 to {self.size - 1}")
        place = np.unravel_index(cell % self.size, self.shape) if self.dims else ()
        found: dict[str, Any] = {dim: self.coords[dim][i] for dim, i in zip(self.dims, place, strict=True)}
        found |= {name: values[tuple(place[axis] for axis in axes)] for name, (values, axes) in self.varied.items()}
        return {name: value.item() if isinstance(value, np.generic) else value for name, value in found.items()}

    def simulate(self, cell: int, **options: Any) -> Any:
        """Run a cell once more, alone, and return its whole trajectory; ``options`` are those of `nsmodel.simulate`.

        Raises:
            UsageError: the sweep was read from a file, which holds no model; no such cell.
            StepError: as the cell's message says.
        """
        self.at(cell)
        if self._again is None:
            raise UsageError(
                "a sweep that was read from a file has no model; sweep again with resume=True, which runs no cell again"
            )
        return self._again(cell % self.size, options)

    @property
    def failures(self) -> list[tuple[int, str]]:
        """(cell, why) of those that were run and are not done."""
        return [(cell, self.messages.get(cell, "")) for cell in np.flatnonzero(self.cells["status"] > CELL_DONE).tolist()]

    def raise_failed(self) -> None:
        """Raise StepError with the first failure where a cell has failed or was refused."""
        if self.failures:
            cell, why = self.failures[0]
            raise StepError(
                f"{len(self.failures)} of {self.size} cells are not done; cell {cell} ({self._describe_cell(cell)}): {why}"
            )

    def save(self, path: str | Path) -> None:
        """Write one npz file at ``path``; ``Sweep.load`` reads it, and ``numpy.load``. StorageError where that fails."""
        messages = {str(cell): self.messages[cell] for cell in sorted(self.messages)}
        write_npz(path, {**design_arrays(self), **self.cells}, {**sweep_metadata(self), "messages": messages})

    @classmethod
    def load(cls, path: str | Path) -> Sweep:
        """Read at ``path`` a file of ``save``, or the folder of a sweep that is done; arrays stay there until they are used.

        What is used is compared with its digest then: a StorageError where it was changed. Of a file of an older version, which
        has no digests, an ``UnverifiedWarning`` says so.

        Raises:
            StorageError: missing, damaged, foreign, or a sweep that is not done: go on with it by ``resume=True``.
        """
        path = Path(path)
        if path.is_dir():
            if not (path / SWEEP_FILE).exists():
                raise StorageError(
                    f"{path} holds no {SWEEP_FILE}: no sweep, or an unfinished one; continue it with resume=True (--resume)"
                )
            path = path / SWEEP_FILE
        archive, arrays = map_archive(path)
        check_sweep_file(archive, arrays)
        archive.warn_unverified(stacklevel=2)
        return make_sweep(arrays, archive.metadata)

    def to_csv(self, path: str | Path) -> None:
        """Write to ``path`` a row a cell: what varies, numbers of each run, how it went, why not; no rows over time."""
        write_csv(path, cell_table(self))

    def to_pandas(self) -> Any:
        """Return the table of ``to_csv`` as a ``pandas.DataFrame`` by cell, units in its ``attrs``.

        MissingExtraError where pandas is not installed.
        """
        found = import_extra("pandas").DataFrame(cell_table(self)).set_index("cell")
        found.attrs = {"title": self.title, "units": {name: unit for name, unit in self.units.items() if name in found}}
        return found

    def to_xarray(self) -> Any:
        """Return an ``xarray.Dataset``: quantities along what varies, which has its values as coordinates.

        MissingExtraError where xarray is not installed.
        """
        return sweep_dataset(self)

    @property
    def data(self) -> Any:
        """The sweep as ``to_xarray`` returns it."""
        return self.to_xarray()

    def to_netcdf(self, path: str | Path) -> None:
        """Write ``data`` to ``path`` as netCDF; MissingExtraError where xarray, or what it writes that with, is not installed."""
        found = self.to_xarray()
        if not any(map(find_spec, ("netCDF4", "h5netcdf"))):
            raise MissingExtraError("netCDF files need netCDF4 or h5netcdf; pip install netCDF4, or keep the npz file")
        with replace_atomically(Path(path)) as part:
            found.to_netcdf(part)

    def to_zarr(self, path: str | Path) -> None:
        """Write ``data`` to ``path`` as a zarr store.

        Raises:
            MissingExtraError: xarray or zarr is not installed.
            StorageError: the store cannot be written there.
        """
        import_extra("zarr")
        try:
            self.to_xarray().to_zarr(path, mode="w", zarr_format=2)
        except OSError as error:
            raise StorageError(f"cannot write {path}: {error}; take a folder that is writable and has room") from error

    def plot(self, name: str, **options: Any) -> Any:
        """Draw the quantity ``name`` as `Variable.plot` does, with its ``options``, and return the axes."""
        return self[name].plot(**options)

    def summary(self) -> dict[str, Any]:
        """Return the sweep in short, as numbers, strings, lists and dictionaries."""
        status = Counter(self.cells["status"].tolist())
        ran = self.cells["status"] != CELL_NOT_RUN
        worst = self.cells["worst_residual"][self.cells["status"] == CELL_DONE]
        pieces = self.cells.get("pieces")
        estimates = self.cells["estimate"][np.isfinite(self.cells["estimate"])] if pieces is not None else np.zeros(0)
        ways = Counter(self.cells["way"][ran].tolist())
        return {
            "title": self.title,
            "model_class": self.metadata.get("model_class"),
            "dims": dict(zip(self.dims, self.shape, strict=True)),
            "cells": self.size,
            "status": {word: status[code] for code, word in STATUS_NAMES.items() if status[code]},
            "failures": [{"cell": cell, "at": self.at(cell), "message": why} for cell, why in self.failures],
            "keep": list(self.metadata.get("keep", ())),
            "outputs": dict(self.metadata.get("outputs", {})),
            "rows": len(self.t),
            "t": {"start": float(self.t[0]), "end": float(self.t[-1]), "unit": self.units.get("t", "")},
            "steps": int(self.cells["steps"].sum()),
            "worst_residual": float(np.max(worst)) if worst.size else None,
            "pieces": None if pieces is None else int(pieces.sum()),
            "estimate": float(estimates.max()) if estimates.size else None,
            "ways": {CELL_BACKENDS[way]: count for way, count in sorted(ways.items())},
            "plan": self.plan,
        }

    def summary_text(self) -> str:
        """Return the sweep in short as a table of at most 100 columns."""
        s = self.summary()
        of = " x ".join(f"{dim} {size}" for dim, size in s["dims"].items())
        done = s["status"].get(STATUS_NAMES[CELL_DONE], 0)
        entries = [("cells", f"{s['cells']}: {of}"), ("done", f"{done} of {s['cells']}")]
        for word, count in s["status"].items():
            if word != STATUS_NAMES[CELL_DONE]:
                low, high = (float(end) for end in wilson_interval(np.array(count), np.array(s["cells"]), 0.95))
                share = f" ({count / s['cells']:.2g} of all; 95 % interval {low:.2g} to {high:.2g})"
                entries.append((word, f"{count}{share if word == STATUS_NAMES[CELL_FAILED] else ''}"))
        for kind, count in Counter(_without_numbers(why) for _, why in self.failures).most_common(MAX_FAILURE_KINDS):
            cell, why = next((cell, why) for cell, why in self.failures if _without_numbers(why) == kind)
            times = f"{count} times, the first" if count > 1 else "once,"
            entries.append(("", f"{times} at {self._describe_cell(cell)}: {why}"))
        if s["keep"]:
            span = f"t = {s['t']['start']:.6g} to {s['t']['end']:.6g} {s['t']['unit']}".rstrip()
            entries.append(("kept", f"{', '.join(s['keep'])}: {s['rows']} rows, {span}"))
        entries += [("outputs" if i == 0 else "", f"{name}: {text}") for i, (name, text) in enumerate(s["outputs"].items())]
        if s["pieces"] is not None:
            entries.append(("pieces", f"{s['pieces']:,} in all"))
            if s["estimate"] is not None:
                entries.append(("worst estimate", f"{s['estimate']:.2g} of rtol, of the error of a piece"))
        else:
            entries.append(("steps", f"{s['steps']:,} in all, each verified"))
            if s["worst_residual"] is not None:
                entries.append(("worst residual", f"{s['worst_residual']:.2e}"))
        entries.append(("way", self.plan))
        alone = s["ways"].get(ALONE_BACKEND, 0)
        if alone and len(s["ways"]) > 1:
            entries.append(("", f"{alone} cells, which C did not go on with, by simulate"))
        return escape_invisible("\n".join([s["title"], *(line for entry in entries for line in labelled_lines(*entry))]))

    def _describe_cell(self, cell: int) -> str:
        """What varies at a cell, in words."""
        at = self.at(cell)
        numbers = {name: value for name, value in at.items() if isinstance(value, int | float | str)}
        return ", ".join(
            f"{name} = {value:.6g}" if isinstance(value, float) else f"{name} = {value}" for name, value in numbers.items()
        )

    def __len__(self) -> int:
        """Return the number of cells."""
        return self.size

    def __repr__(self) -> str:
        """Return one line: title, dimensions, what came of the cells."""
        of = " x ".join(f"{dim} {size}" for dim, size in zip(self.dims, self.shape, strict=True))
        status = Counter(self.cells["status"].tolist())
        went = ", ".join(f"{status[code]} {word}" for code, word in STATUS_NAMES.items() if status[code])
        return f"Sweep({self.title!r}, {of}: {went})"


def make_sweep(arrays: Mapping[str, np.ndarray], metadata: Mapping[str, Any], again: Callable[..., Any] | None = None) -> Sweep:
    """The sweep of arrays as files have them, which are not read before they are used where they lie in one."""
    dims, along = tuple(metadata["dims"]), metadata["along"]
    about = {key: value for key, value in metadata.items() if key not in FILE_METADATA_KEYS}
    labels = {dim: np.array(texts) for dim, texts in metadata.get(LABELS_KEY, {}).items()}
    coords = LazyMapping({dim: partial(_read_coordinate, arrays, labels, dim) for dim in dims})
    varied = LazyMapping({name: partial(_read_varied, arrays, name, tuple(axes)) for name, axes in along.items()})
    names = [name for name in arrays if not name.startswith((DIM_PREFIX, VALUE_PREFIX)) and name != "t"]
    cells = arrays.only(names, CODE_CHECKS) if isinstance(arrays, StoredArrays) else {name: arrays[name] for name in names}
    messages = {int(cell): text for cell, text in metadata.get("messages", {}).items()}
    return Sweep(dims, coords, varied, np.asarray(arrays["t"]), cells, messages, about, _again=again)


def _read_coordinate(arrays: Mapping[str, np.ndarray], labels: Mapping[str, np.ndarray], dim: str) -> np.ndarray:
    return labels[dim] if dim in labels else np.asarray(arrays[f"{DIM_PREFIX}{dim}"])


def _read_varied(arrays: Mapping[str, np.ndarray], name: str, axes: tuple[int, ...]) -> tuple[np.ndarray, tuple[int, ...]]:
    return np.asarray(arrays[f"{VALUE_PREFIX}{name}"]), axes


class LazyMapping(Mapping[str, Any]):
    """Values that are computed when they are asked for."""

    def __init__(self, make: Mapping[str, Callable[[], Any]]) -> None:
        self._make = make

    def __getitem__(self, name: str) -> Any:
        return self._make[name]()

    def __contains__(self, name: object) -> bool:
        return name in self._make

    def __iter__(self) -> Iterator[str]:
        return iter(self._make)

    def __len__(self) -> int:
        return len(self._make)


def _without_numbers(message: str) -> str:
    """A message without its numbers: what failures have in common."""
    return "".join(character for character in message if not character.isdigit() and character not in ".e+-")


__getattr__ = former_names(__name__, Lazily="LazyMapping", _coordinate="_read_coordinate")
