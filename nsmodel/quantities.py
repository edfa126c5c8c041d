"""Quantities of a run: expressions of its columns, which stand in them by their names."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from nsmodel.columns import input_names, model_type, multiplier_names, state_names
from nsmodel.errors import ModelError, UsageError
from nsmodel.model.arguments import read_units
from nsmodel.model.base import Model
from nsmodel.model.outputs import check_output_name
from nsmodel.model.quantity import Quantity, SymbolsByName, parse_entry_name, read_column

if TYPE_CHECKING:
    from nsmodel.trajectory import Trajectory

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
