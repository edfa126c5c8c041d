"""The columns of a run: their names and units, and the tables that they make.

Quantities of a run: expressions of its columns, which stand in them by their names.
"""

from __future__ import annotations

import difflib
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from nsmodel._utils import import_extra
from nsmodel.errors import ModelError, UsageError
from nsmodel.files.archive import LIST_PREFIXES
from nsmodel.files.storage import dumps
from nsmodel.modeling.base import Model
from nsmodel.modeling.outputs import Quantity, SymbolsByName, check_output_name, parse_entry_name, read_column
from nsmodel.modeling.parameters import read_units
from nsmodel.modeling.parts import Part

if TYPE_CHECKING:
    from nsmodel.simulation.trajectory import Trajectory

DATASET_COORDINATES = ("time", "state", "multiplier", "input", "body")  # Of an xarray.Dataset.
# What its arrays have beside time.
COLUMN_AXES = {name: "multiplier" for name in ("multipliers", "y", "reactions", "gap")}
COLUMN_AXES |= {name: "state" for name in ("v", "selection", "defect")}
COLUMN_AXES |= {"inputs": "input", "inputs_begin": "input", "pressure": "body"}


MODEL_TYPE = Part[type[Model]]("model_type")


def model_type(run: Trajectory) -> type[Model]:
    """Return the class of the run's model; what all share where it is not known here."""
    return MODEL_TYPE.of_class_named(run.metadata.get("model_class")) or Model


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


ColumnArrays = Mapping[str, np.ndarray]


class ColumnNames(NamedTuple):
    """What the columns of a run are called; ``letter``: of its state; parameters have values."""

    states: Sequence[str]
    multipliers: Sequence[str]
    inputs: Sequence[str]
    parameters: Mapping[str, float]
    letter: str = "x"

    @classmethod
    def from_run(cls, run: Trajectory) -> Self:
        """Of a run."""
        parameters = run.metadata.get("parameters", {})
        return cls(state_names(run), multiplier_names(run), input_names(run), parameters, model_type(run).letter)

    @classmethod
    def from_model(cls, model: Model, multipliers: Sequence[str]) -> Self:
        """Of a bound model."""
        return cls(model.names, multipliers, model.input_names, model.bound_parameters, model.letter)

    def column(self, name: str, arrays: ColumnArrays) -> np.ndarray | float | None:
        """The column (K,) of ``arrays`` that a symbol of this name stands for; a parameter's value; None where there is none."""
        for known, array in ((self.states, "x"), (self.inputs, "inputs"), (self.multipliers, "multipliers")):
            if name in known and array in arrays:
                return arrays[array][:, list(known).index(name)]
        if name in self.parameters:
            return self.parameters[name]
        alias = {"l": "multipliers", self.letter: "x"}
        whole = arrays.get(alias.get(name, name))
        if whole is not None and whole.ndim == 1:
            return whole
        if whole is not None:
            return whole[:, 0] if whole.shape[1:] == (1,) else None
        if (entry := parse_entry_name(name)) is None:
            return None
        stem, i = entry
        if f"{stem}[{i}]" in self.multipliers and name != f"{stem}[{i}]":
            return self.column(f"{stem}[{i}]", arrays)
        vector = arrays.get(alias.get(stem, stem))
        return vector[:, i] if vector is not None and vector.ndim == 2 and i < vector.shape[1] else None


@dataclass(frozen=True)
class OutputColumns:
    """The further columns of runs of a model."""

    names: ColumnNames
    quantities: Mapping[str, Quantity] = field(default_factory=dict)

    @classmethod
    def of(cls, model: Model, multipliers: Sequence[str]) -> Self:
        """Those that a bound model declares."""
        return cls(ColumnNames.from_model(model, multipliers), {name: Quantity.made(e) for name, e in model.outputs.items()})

    def __call__(self, arrays: ColumnArrays) -> dict[str, np.ndarray]:
        """The columns, from those that are there; UsageError for one that is not."""
        return {name: evaluate_quantity(own, self.names, arrays, f"output '{name}'") for name, own in self.quantities.items()}


def evaluate_quantity(quantity: Quantity, names: ColumnNames, arrays: ColumnArrays, label: str) -> np.ndarray:
    """A quantity (K,) or (K, size) where its columns have the values in ``arrays``; UsageError for a column that is not there."""
    given = np.empty((len(arrays["t"]), len(quantity.of)))
    for k, name in enumerate(quantity.of):
        column = names.column(name, arrays)
        if column is None:
            known = ["t", *names.states, *names.multipliers, *names.inputs, *names.parameters]
            known += [name for name in arrays if name not in ("t", "x", "inputs") and not name.startswith("piece_")]
            hint = difflib.get_close_matches(name, known, 1)
            raise UsageError(
                f"{label}: '{name}' is not there; there are {', '.join(dict.fromkeys(known))}"
                + (f". Did you mean '{hint[0]}'?" if hint else "")
            )
        given[:, k] = column
    return quantity(given)


def quantity_at_step_ends(
    run: Trajectory, quantity: Quantity, label: str, first: int, last: int
) -> tuple[np.ndarray, np.ndarray]:
    """A quantity just after the begin and just before the end of the steps from row first to row last (K, ...) each.

    Both have what belongs to a step, its multipliers; states and inputs are those of either end.
    """
    at_end = {name: array[first + 1 : last + 1] for name, array in run.arrays.items() if len(array) == len(run.t)}
    at_begin = at_end | {name: run.arrays[name][first:last] for name in ("t", "x")}
    if "inputs" in at_end:
        at_begin["inputs"] = at_end["inputs_begin"]
    begin, end = (evaluate_quantity(quantity, ColumnNames.from_run(run), arrays, label) for arrays in (at_begin, at_end))
    return begin, end


def expression_at_rows(run: Trajectory, given: Any, units: Mapping[str, str] | None) -> Any:
    """The values of an expression at the rows; of {name: expression} the run with them as further columns."""
    names = ColumnNames.from_run(run)
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


def resampled_outputs(run: Trajectory, kept: ColumnArrays) -> dict[str, np.ndarray]:
    """The outputs of a run whose rows were drawn anew, from those of its columns that were; else from ``kept`` rows, on lines."""
    found: dict[str, np.ndarray] = {}
    for name, text in run.metadata.get("outputs", {}).items():
        try:
            found[name] = evaluate_quantity(Quantity.from_text(text), ColumnNames.from_run(run), run.arrays | found, name)
        except UsageError:
            flat = kept[name].reshape(len(kept[name]), -1)
            lines = np.stack([np.interp(run.t, kept["t"], column) for column in flat.T], axis=1)
            found[name] = lines.reshape(len(run.t), *kept[name].shape[1:])
    return found


def read_quantity(run: Trajectory, what: Any) -> tuple[Quantity, str]:
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
