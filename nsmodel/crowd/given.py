"""What users give to the crowd tools, checked: numbers, points, radii, seeds."""

from __future__ import annotations

from typing import Any

import numpy as np

from nsmodel.errors import ModelError, NsmodelError
from nsmodel.modeling.parameters import describe_argument


def checked_array(value: Any, label: str, expected: str, kind: type[NsmodelError] = ModelError) -> np.ndarray:
    """An array of finite numbers, not to be written to."""
    try:
        array = None if value is None else np.array(value, float)
    except (TypeError, ValueError):
        array = None
    if array is None:
        raise kind(f"{label}: {describe_argument(value)}; expected {expected}")
    if not np.isfinite(array).all():
        raise kind(f"{label}: {array[~np.isfinite(array)].flat[0]} is not a finite number; expected {expected}")
    array.setflags(write=False)
    return array


def checked_number(
    value: Any, label: str, expected: str = "a number > 0, in metres", *, zero: bool = False,
    kind: type[NsmodelError] = ModelError,
) -> float:  # fmt: skip
    """One finite number > 0, or with ``zero`` >= 0."""
    array = checked_array(value, label, expected, kind)
    if array.ndim or not (array > 0 or (zero and array == 0)):
        raise kind(f"{label}: {describe_argument(value)}; expected {expected}")
    return float(array)


def per_person_values(value: Any, label: str, count: int, unit: str, *, zero: bool = False) -> np.ndarray:
    """Numbers (count,) > 0, or with ``zero`` >= 0, one for each person, from these or from one for all."""
    expected = f"one number {'>=' if zero else '>'} 0 or ({count},), one for each person, in {unit}"
    array = checked_array(value, label, expected)
    if array.shape not in ((), (count,)) or (array < 0).any() or (not zero and (array == 0).any()):
        raise ModelError(f"{label}: {describe_argument(value)}, shape {array.shape}; expected {expected}")
    return np.broadcast_to(array, count).copy()


def radius_range(radii: Any) -> tuple[float, float]:
    """The least and the largest radius."""
    expected = "one radius > 0, or (least, largest), in metres"
    array = checked_array(radii, "radii", expected)
    if array.shape not in ((), (2,)) or not (array > 0).all() or array.flat[0] > array.flat[-1]:
        raise ModelError(f"radii: {describe_argument(radii)}; expected {expected}")
    return float(array.flat[0]), float(array.flat[-1])


def random_generator(seed: Any) -> np.random.Generator:
    """Random numbers from a seed."""
    try:
        return np.random.default_rng(seed)
    except (TypeError, ValueError):
        raise ModelError(f"seed: {describe_argument(seed)}; expected a whole number >= 0") from None
