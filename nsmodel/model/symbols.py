"""Symbols that a user declares, of CasADi or SymPy, by their names."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError

_Named = tuple[str, ca.SX, Any]


def read_symbols(value: Any, label: str) -> list[_Named]:
    """List (scalar name, SX symbol, the user's object)."""
    if isinstance(value, str):
        return [(value, ca.SX.sym(value), value)]
    if isinstance(value, ca.SX) and value.is_dense() and value.is_valid_input():
        return [(s.name(), s, s) for s in ca.vertsplit(ca.vec(value))]
    if isinstance(value, ca.MX) and value.is_dense() and value.is_valid_input():
        return [(name, ca.SX.sym(name), mx) for mx in value.primitives() for name in entry_names(mx.name(), mx.numel())]
    if isinstance(value, np.ndarray) and value.dtype == object:
        return read_symbols(value.ravel().tolist(), label)
    if isinstance(value, list | tuple):
        return [pair for item in value for pair in read_symbols(item, label)]
    found = _sympy_symbols(value, label) if is_sympy(value) else None
    if found is not None:
        return found
    raise ModelError(
        f"{label}: {describe_value(value)} is not a symbol; expected symbols only, such as ca.SX.sym('{_example_name(label)}', "
        "2), a list of scalar symbols, or SymPy symbols"
    )


def _sympy_symbols(value: Any, label: str) -> list[_Named] | None:
    if type(value).__name__ == "MatrixSymbol":
        return [(name, ca.SX.sym(name), value) for name in entry_names(value.name, int(value.rows * value.cols))]
    if hasattr(value, "tolist"):
        return read_symbols(flatten_lists(value.tolist()), label)
    scalar = getattr(value, "is_Symbol", False) and not hasattr(value, "shape")
    return [(value.name, ca.SX.sym(value.name), value)] if scalar else None


def entry_names(name: str, size: int) -> list[str]:
    """Name the scalars of a symbol as SX.sym does, column by column."""
    return [name] if size == 1 else [f"{name}_{i}" for i in range(size)]


def common_stem(names: Sequence[str]) -> str | None:
    """The name q of q_0, q_1, ...; None where there is none."""
    if len(names) == 1:
        return names[0]
    stem = names[0].removesuffix("_0") if names else ""
    return stem if stem and list(names) == [f"{stem}_{i}" for i in range(len(names))] else None


def check_distinct_names(names: Sequence[str], label: str) -> None:
    """Refuse names that stand there twice."""
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise ModelError(f"{label}: the symbol '{repeated[0]}' is declared twice; give each symbol its own name")


def check_declared(names: Any, symbols: Mapping[str, ca.SX], label: str) -> None:
    """Refuse a symbol that was not declared."""
    for name in names:
        if name not in symbols:
            whole = name.rpartition("_")[0]
            fix = (
                f"'{whole}' is declared as one number; give parameters={{'{whole}': [...]}} as many as it has entries"
                if whole in symbols
                else "add it to parameters={...} or declare it as x=, t="
            )
            raise ModelError(
                f"{label} uses the symbol '{name}', which is not declared: {fix}; declared are {', '.join(symbols) or 'none'}"
            )


def is_sympy(value: Any) -> bool:
    """Whether a value is of SymPy."""
    return any(str(base.__module__).partition(".")[0] == "sympy" for base in type(value).__mro__)


def is_casadi(value: Any) -> bool:
    """Whether a value is an expression of CasADi or of SymPy."""
    return isinstance(value, ca.SX | ca.MX | ca.DM) or is_sympy(value)


def flatten_lists(rows: Any) -> list[Any]:
    """The entries of nested lists."""
    return [item for row in rows for item in flatten_lists(row)] if isinstance(rows, list) else [rows]


def describe_value(value: Any) -> str:
    """A value in a message, cut short."""
    text = str(value)
    return f"{text if len(text) <= 60 else text[:57] + '...'} (a {type(value).__name__})"


def _example_name(label: str) -> str:
    return label if label.isidentifier() else "x"
