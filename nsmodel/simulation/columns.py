"""The columns of a run as tables, and quantities: expressions of its columns, which stand in them by their names."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from nsmodel._utils import import_extra
from nsmodel.errors import ModelError, UsageError
from nsmodel.files.archive import LIST_PREFIXES
from nsmodel.files.storage import dumps
from nsmodel.modeling.output_columns import ColumnArrays, ColumnNames, evaluate_quantity
from nsmodel.modeling.outputs import Quantity, SymbolsByName, check_output_name, read_column
from nsmodel.modeling.parameters import read_units
from nsmodel.simulation.run_data import CONTACT_AXES, RunData, input_names, model_type, multiplier_names, state_names, units_of

DATASET_COORDINATES = ("time", "state", "multiplier", "input", "body", *CONTACT_AXES)  # Of an xarray.Dataset.
# What its arrays have beside time; the first of these axes that a run has.
COLUMN_AXES = {name: ("multiplier",) for name in ("multipliers", "y", "reactions")}
COLUMN_AXES |= {name: ("state",) for name in ("v", "selection", "defect", "halving")}
COLUMN_AXES |= {"inputs": ("input",), "inputs_begin": ("input",), "pressure": ("body",)}
COLUMN_AXES |= {name: (axis,) for axis, names in CONTACT_AXES.items() for name in names} | {"gap": ("contact", "multiplier")}


def _unused_name(name: str, taken: Container[str], prefix: str) -> str:
    return f"{prefix}:{name}" if name in taken else name


def csv_columns(run: RunData) -> Iterator[tuple[str, np.ndarray]]:
    """Yield (name, column) of the CSV file; no name comes twice."""
    multipliers = multiplier_names(run)
    named = {"x": state_names(run), "multipliers": [f"multiplier:{name}" for name in multipliers]}
    if "y" in run.arrays and run.y.shape[1:] == (len(multipliers),):
        named["y"] = [f"y:{name}" for name in multipliers]
    named["halving"] = [f"halving:{name}" for name in state_names(run)]
    for name, prefix in (("inputs", "input"), ("inputs_begin", "input after the row before")):
        named[name] = [f"{prefix}:{one}" for one in input_names(run)]
    axes = run.metadata.get("axes", {})
    named |= {name: [f"{name}:{one}" for one in axes[own]] for name, (own, *_) in COLUMN_AXES.items() if own in axes}
    first = [name for name in ("t", "x", "multipliers", "y", "residual") if name in run.arrays]
    taken: set[str] = set()
    for name in dict.fromkeys([*first, *(name for name in run.arrays if not name.startswith(LIST_PREFIXES))]):
        array = run.arrays[name]
        indices = np.ndindex(array.shape[1:])
        titles = named.get(name) or [name + "".join(f"_{i}" for i in index) for index in indices]
        for title, column in zip(titles, array.reshape(len(array), len(titles)).T, strict=True):
            yield (free := _unused_name(title, taken, "array")), column
            taken.add(free)


def run_dataset(run: RunData) -> Any:
    """The run as an ``xarray.Dataset``; MissingExtraError where xarray is not installed."""
    xarray = import_extra("xarray")
    units = {name: {"units": unit} for name, unit in units_of(run).items()}
    coords = {"state": state_names(run), "multiplier": multiplier_names(run), "input": input_names(run)}
    coords |= run.metadata.get("axes", {})
    sizes, data = {name: len(names) for name, names in coords.items()}, {}
    for name, column in zip(state_names(run), run.x.T, strict=True):
        data[_unused_name(name, {*run.arrays, *DATASET_COORDINATES}, "state")] = ("time", column, units.get(name))
    for name, array in run.arrays.items():
        if name not in ("t", "x"):
            own = next((axis for axis in COLUMN_AXES.get(name, ()) if axis in coords or axis == "body"), "")
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


def run_frame(run: RunData) -> Any:
    """The table of the CSV file as a ``pandas.DataFrame`` by time; MissingExtraError where pandas is not installed."""
    pandas = import_extra("pandas")
    columns, units = dict(csv_columns(run)), units_of(run)
    own = {name: units.get(name) or units.get(name.partition(":")[2]) for name in columns}
    found = pandas.DataFrame(columns).set_index("t")
    found.attrs = {"title": run.title, "units": {name: unit for name, unit in own.items() if unit}}
    return found


def column_names(run: RunData) -> ColumnNames:
    """Return what the columns of a run are called."""
    parameters = run.metadata.get("parameters", {})
    return ColumnNames(state_names(run), multiplier_names(run), input_names(run), parameters, model_type(run).letter)


def quantity_at_step_ends(run: RunData, quantity: Quantity, label: str, first: int, last: int) -> tuple[np.ndarray, np.ndarray]:
    """A quantity just after the begin and just before the end of the steps from row first to row last (K, ...) each.

    Both have what belongs to a step, its multipliers; states and inputs are those of either end.
    """
    at_end = {name: array[first + 1 : last + 1] for name, array in run.arrays.items() if len(array) == len(run.t)}
    at_begin = at_end | {name: run.arrays[name][first:last] for name in ("t", "x")}
    if "inputs" in at_end:
        at_begin["inputs"] = at_end["inputs_begin"]
    begin, end = (evaluate_quantity(quantity, column_names(run), arrays, label) for arrays in (at_begin, at_end))
    return begin, end


def expression_at_rows(run: RunData, given: Any, units: Mapping[str, str] | None) -> Any:
    """The values of an expression at the rows; of {name: expression} the run with them as further columns."""
    names = column_names(run)
    if not isinstance(given, Mapping):
        quantity, label = read_quantity(run, given)
        return evaluate_quantity(quantity, names, run.arrays, label)
    arrays, outputs = dict(run.arrays), dict(run.metadata.get("outputs", {}))
    taken = {*run.arrays, *run.metadata.get("stems", ()), *names.states, *names.inputs, *names.multipliers, *names.parameters}
    for name, value in given.items():
        try:
            check_output_name(name, (taken | {*run.metadata.get("input_groups", ())}) - {*outputs})
        except ModelError as error:
            raise UsageError(str(error)) from None
        label = f"output '{name}'"
        quantity = Quantity.made(read_column(value, label, SymbolsByName({}), UsageError))
        arrays[name], outputs[name] = evaluate_quantity(quantity, names, arrays, label), quantity.text
    try:
        units = read_units(units)
    except ModelError as error:
        raise UsageError(str(error)) from None
    metadata = run.metadata | {"outputs": outputs, "units": run.metadata.get("units", {}) | units}
    return replace(run, arrays=arrays, metadata=metadata)


def resampled_outputs(run: RunData, kept: ColumnArrays) -> dict[str, np.ndarray]:
    """The outputs of a run whose rows were drawn anew, from those of its columns that were; else from ``kept`` rows, on lines."""
    found: dict[str, np.ndarray] = {}
    for name, text in run.metadata.get("outputs", {}).items():
        try:
            found[name] = evaluate_quantity(Quantity.from_text(text), column_names(run), run.arrays | found, name)
        except UsageError:
            flat = kept[name].reshape(len(kept[name]), -1)
            lines = np.stack([np.interp(run.t, kept["t"], column) for column in flat.T], axis=1)
            found[name] = lines.reshape(len(run.t), *kept[name].shape[1:])
    return found


def read_quantity(run: RunData, what: Any) -> tuple[Quantity, str]:
    """What a user means by a name or an expression, and a label of it for messages.

    A name is that of an output, of a column, or of a vector; a symbol in an expression stands for the column of its name.
    """
    if not isinstance(what, str):
        return Quantity.made(read_column(what, "the expression", SymbolsByName({}), UsageError)), "the expression"
    if (text := run.metadata.get("outputs", {}).get(what)) is not None:
        return Quantity.from_text(text), f"output '{what}'"
    stems, groups = run.metadata.get("stems", {}), run.metadata.get("input_groups", {})
    own = run.arrays.get(what)
    if what in stems:
        names = tuple(state_names(run)[i] for i in stems[what])
    elif what in groups:
        names = tuple(groups[what])
    elif own is not None and own.ndim == 2:
        names = tuple(f"{what}_{i}" for i in range(own.shape[1]))
    else:
        names = tuple(name for name in multiplier_names(run) if name.startswith(f"{what}[")) or (what,)
    return Quantity.named(names), f"'{what}'"
