"""What users give to the crowd tools, checked: numbers, points, radii, seeds."""

from __future__ import annotations

from typing import Any

import numpy as np

from nsmodel.errors import ModelError, NsmodelError
from nsmodel.model.arguments import shown


def numbers(value: Any, label: str, expected: str, kind: type[NsmodelError] = ModelError) -> np.ndarray:
    """An array of finite numbers, not to be written to."""
    try:
        array = None if value is None else np.array(value, float)
    except (TypeError, ValueError):
        array = None
    if array is None:
        raise kind(f"{label}: {shown(value)}; expected {expected}")
    if not np.isfinite(array).all():
        raise kind(f"{label}: {array[~np.isfinite(array)].flat[0]} is not a finite number; expected {expected}")
    array.setflags(write=False)
    return array


def number(
    value: Any, label: str, expected: str = "a number > 0, in metres", *, zero: bool = False,
    kind: type[NsmodelError] = ModelError,
) -> float:  # fmt: skip
    """One finite number > 0, or with ``zero`` >= 0."""
    array = numbers(value, label, expected, kind)
    if array.ndim or not (array > 0 or (zero and array == 0)):
        raise kind(f"{label}: {shown(value)}; expected {expected}")
    return float(array)


def of_each(value: Any, label: str, count: int, unit: str, *, zero: bool = False) -> np.ndarray:
    """Numbers (count,) > 0, or with ``zero`` >= 0, one for each person, from these or from one for all."""
    expected = f"one number {'>=' if zero else '>'} 0 or ({count},), one for each person, in {unit}"
    array = numbers(value, label, expected)
    if array.shape not in ((), (count,)) or (array < 0).any() or (not zero and (array == 0).any()):
        raise ModelError(f"{label}: {shown(value)}, shape {array.shape}; expected {expected}")
    return np.broadcast_to(array, count).copy()


def radii_between(radii: Any) -> tuple[float, float]:
    """The least and the largest radius."""
    expected = "one radius > 0, or (least, largest), in metres"
    array = numbers(radii, "radii", expected)
    if array.shape not in ((), (2,)) or not (array > 0).all() or array.flat[0] > array.flat[-1]:
        raise ModelError(f"radii: {shown(radii)}; expected {expected}")
    return float(array.flat[0]), float(array.flat[-1])


def generator(seed: Any) -> np.random.Generator:
    """Random numbers from a seed."""
    try:
        return np.random.default_rng(seed)
    except (TypeError, ValueError):
        raise ModelError(f"seed: {shown(seed)}; expected a whole number >= 0") from None
