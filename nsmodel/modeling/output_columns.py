"""The columns that the outputs of a model give a run, and what quantities are where columns have values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Self

import numpy as np

from nsmodel._utils import did_you_mean
from nsmodel.errors import UsageError
from nsmodel.modeling.base import Model
from nsmodel.modeling.outputs import Quantity, parse_entry_name

ColumnArrays = Mapping[str, np.ndarray]


class ColumnNames(NamedTuple):
    """What the columns of a run are called; ``letter``: of its state; parameters have values."""

    states: Sequence[str]
    multipliers: Sequence[str]
    inputs: Sequence[str]
    parameters: Mapping[str, float]
    letter: str = "x"

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
            what = label if label == f"'{name}'" else f"{label}: '{name}'"
            raise UsageError(f"{what} is not there; there are {', '.join(dict.fromkeys(known))}" + did_you_mean(name, known))
        given[:, k] = column
    return quantity(given)
