"""The arguments of laws: counts, columns, arrays of numbers."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError


def check_count(label: str, m: Any) -> int:
    """A number of components."""
    if isinstance(m, bool) or not isinstance(m, int | np.integer) or m < 0:
        raise ModelError(f"{label}: the number of components must be a whole number >= 0, not {m!r}")
    return int(m)


def read_entries(label: str, name: str, value: Any) -> ca.SX:
    """The numbers or expressions in ``value`` as a column."""
    try:
        if isinstance(value, ca.MX):
            raise TypeError
        column = ca.SX(value) if isinstance(value, ca.SX | ca.DM) else ca.vertcat(ca.SX(0, 1), *map(ca.SX, np.ravel(value)))
    except (NotImplementedError, OverflowError, TypeError, ValueError, RuntimeError):
        raise ModelError(f"{label}: {name} = {value!r}; expected a number, a list of numbers or a CasADi SX") from None
    return ca.densify(ca.vec(column))


def read_law_column(label: str, name: str, value: Any, m: int) -> ca.SX:
    """The same, m of them, or one for all; no NaN."""
    found = read_entries(label, name, value)
    if found.numel() == 1 and m != 1:
        found = ca.repmat(found, m, 1)
    if found.numel() != m:
        raise ModelError(f"{label}: {name} has {found.numel()} values; expected {'1' if m == 1 else f'1 or {m}'}")
    for i in range(m):
        if found[i].is_constant() and np.isnan(float(found[i])):
            raise ModelError(f"{label}: {name}[{i}] is NaN; give a number or +-inf")
    return found


def read_array(label: str, name: str, value: Any) -> np.ndarray:
    """An array of real numbers, not of expressions."""
    try:
        if isinstance(value, ca.SX | ca.MX):
            raise TypeError
        found = np.asarray(value)
        if found.dtype.kind not in "biuf":
            raise TypeError
        return found.astype(float)
    except (TypeError, ValueError, RuntimeError):
        raise ModelError(f"{label}: {name} = {value!r}; expected numbers") from None
