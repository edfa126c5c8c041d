"""The columns of a run: their names and units, and the tables that they make."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.archive import LIST_PREFIXES
from nsmodel.classes.registry import class_named
from nsmodel.extras import import_extra
from nsmodel.model.base import Model
from nsmodel.storage import dumps

if TYPE_CHECKING:
    from nsmodel.trajectory import Trajectory


DATASET_COORDINATES = ("time", "state", "multiplier", "input", "body")  # Of an xarray.Dataset.
# What its arrays have beside time.
COLUMN_AXES = {name: "multiplier" for name in ("multipliers", "y", "reactions", "gap")}
COLUMN_AXES |= {name: "state" for name in ("v", "selection", "defect")}
COLUMN_AXES |= {"inputs": "input", "inputs_begin": "input", "pressure": "body"}


def model_type(run: Trajectory) -> type[Model]:
    """Return the class of the run's model; what all share where it is not known here."""
    found = class_named(run.metadata.get("model_class"))
    return Model if found is None else found.type


def state_names(run: Trajectory) -> list[str]:
    """Return one name for each column of ``run.x``."""
    return _names_or_numbered(run.metadata.get("state_names"), "x", run.x.shape[1])


def multiplier_names(run: Trajectory) -> list[str]:
    """Return one name for each column of ``run.multipliers``; none where the run has no multipliers."""
    width = run.multipliers.shape[1] if "multipliers" in run.arrays else 0
    return _names_or_numbered(run.metadata.get("multiplier_names"), "l", width)


def input_names(run: Trajectory) -> list[str]:
    """Return one name for each column of ``run.inputs``; none where the run has no inputs."""
    return list(run.metadata.get("input_names", ()))


def output_names(run: Trajectory) -> dict[str, list[str]]:
    """Return {name of an output: names of its columns}, in the order in which they were declared."""
    sizes = {name: text["size"] for name, text in run.metadata.get("outputs", {}).items() if name in run.arrays}
    return {name: [name] if size == 1 else [f"{name}_{i}" for i in range(size)] for name, size in sizes.items()}


def units_of(run: Trajectory) -> dict[str, str]:
    """Return {name: unit} as declared, with the unit of a symbol or group handed on to each of its members."""
    units, names = dict(run.metadata.get("units", {})), state_names(run)
    for stem, columns in run.metadata.get("stems", {}).items():
        if stem in units:
            units |= {names[i]: units.get(names[i], units[stem]) for i in columns}
    for stem, entries in run.metadata.get("input_groups", {}).items():
        units |= {name: units.get(name, units[stem]) for name in entries if stem in units}
    for name in multiplier_names(run):
        if (group := name.split("[")[0]) in units:
            units.setdefault(name, units[group])
    return units


def extrapolated_rows(run: Trajectory) -> np.ndarray:
    """Return, for each row (N+1,), whether error control has moved its state off what its step gave."""
    return run.arrays.get("correction", np.zeros(len(run.t))) > 0


def _names_or_numbered(given: Sequence[str] | None, stem: str, width: int) -> list[str]:
    return list(given) if given is not None and len(given) == width else [f"{stem}_{i}" for i in range(width)]


def _unused_name(name: str, taken: Container[str], prefix: str) -> str:
    return f"{prefix}:{name}" if name in taken else name


def csv_columns(run: Trajectory) -> Iterator[tuple[str, np.ndarray]]:
    """Yield (name, column) of the CSV file; no name comes twice."""
    multipliers = multiplier_names(run)
    named = {"x": state_names(run), "multipliers": [f"multiplier:{name}" for name in multipliers]}
    if "y" in run.arrays and run.y.shape[1:] == (len(multipliers),):
        named["y"] = [f"y:{name}" for name in multipliers]
    for name, prefix in (("inputs", "input"), ("inputs_begin", "input after the row before")):
        named[name] = [f"{prefix}:{one}" for one in input_names(run)]
    first = [name for name in ("t", "x", "multipliers", "y", "residual") if name in run.arrays]
    taken: set[str] = set()
    for name in dict.fromkeys([*first, *(name for name in run.arrays if not name.startswith(LIST_PREFIXES))]):
        array = run.arrays[name]
        indices = np.ndindex(array.shape[1:])
        titles = named.get(name) or [name + "".join(f"_{i}" for i in index) for index in indices]
        for title, column in zip(titles, array.reshape(len(array), len(titles)).T, strict=True):
            yield (free := _unused_name(title, taken, "array")), column
            taken.add(free)


def run_dataset(run: Trajectory) -> Any:
    """The run as an ``xarray.Dataset``; MissingExtraError where xarray is not installed."""
    xarray = import_extra("xarray")
    units = {name: {"units": unit} for name, unit in units_of(run).items()}
    coords = {"state": state_names(run), "multiplier": multiplier_names(run), "input": input_names(run)}
    sizes, data = {name: len(names) for name, names in coords.items()}, {}
    for name, column in zip(state_names(run), run.x.T, strict=True):
        data[_unused_name(name, {*run.arrays, *DATASET_COORDINATES}, "state")] = ("time", column, units.get(name))
    for name, array in run.arrays.items():
        if name not in ("t", "x"):
            own = COLUMN_AXES.get(name, "")
            shared = array.ndim == 2 and bool(own) and array.shape[1] == sizes.get(own, array.shape[1])
            along = next((stem.rstrip("_") for stem in LIST_PREFIXES if name.startswith(stem)), "time")
            rest = [own] if shared else [f"{name}_dim_{axis}" for axis in range(1, array.ndim)]
            data[_unused_name(name, DATASET_COORDINATES, "array")] = ((along, *rest), array, units.get(name))
    used = {dim for dims, *_ in data.values() for dim in dims}
    known = {"time": ("time", run.t, units.get("t"))} | {dim: names for dim, names in coords.items() if dim in used and names}
    # netCDF has no attribute that is true, None or nested.
    plain = {key: type(value) in (str, int, float) for key, value in run.metadata.items()}
    attrs = {key: value if plain[key] else dumps(value) for key, value in run.metadata.items()}
    return xarray.Dataset(data, known, attrs)


def run_frame(run: Trajectory) -> Any:
    """The table of the CSV file as a ``pandas.DataFrame`` by time; MissingExtraError where pandas is not installed."""
    pandas = import_extra("pandas")
    columns, units = dict(csv_columns(run)), units_of(run)
    own = {name: units.get(name) or units.get(name.partition(":")[2]) for name in columns}
    found = pandas.DataFrame(columns).set_index("t")
    found.attrs = {"title": run.title, "units": {name: unit for name, unit in own.items() if unit}}
    return found
