"""Bounds of signals as a user gives them."""

from __future__ import annotations

from typing import Any

import numpy as np

from nsmodel.errors import ModelError, UsageError
from nsmodel.signals.bounds import Within
from nsmodel.signals.signal import read_numbers


def within(low: Any, high: Any, rate: Any = None, *, start: Any = None) -> Within:
    """All signals u with low <= u(t) <= high; with ``rate`` those that are Lipschitz, |u(t) - u(s)| <= rate |t - s|.

    Args:
        low, high: finite, low <= high; a number, or (nu,) for an input of nu values.
        rate: > 0, in units of u over units of t; None: any measurable function, which may jump.
        start: u(0+), from low to high; None: any.

    Raises:
        UsageError: what is no such number.

    >>> within(-1, 1, rate=5).rate
    array(5.)
    """
    bounds = {name: None if value is None else _bound_numbers(name, value) for name, value in locals().items()}
    a, b, speed, first = (bounds[name] for name in ("low", "high", "rate", "start"))
    if a is None or b is None:
        raise UsageError(f"within: low = {low}, high = {high}; expected finite numbers, low <= high")
    try:
        a, b, *_ = np.broadcast_arrays(a, b, *(part for part in (speed, first) if part is not None))
    except ValueError:
        shapes = ", ".join(f"{name} {value.size}" for name, value in bounds.items() if value is not None)
        raise UsageError(f"within: {shapes} values; give as many of each, or one number for all") from None
    for x, y in zip(a.ravel(), b.ravel(), strict=True):
        if not x <= y:
            raise UsageError(f"within: low = {x:g} > high = {y:g}; expected low <= high")
    if speed is not None and not (speed > 0).all():
        raise UsageError(f"within: rate = {speed.min():g}; expected a number > 0, or None for signals that may jump")
    if first is not None and not ((first >= a) & (first <= b)).all():
        raise UsageError(f"within: start = {start}; expected u(0+) from low = {low} to high = {high}")
    return Within(a, b, speed, first)


def _bound_numbers(name: str, value: Any) -> np.ndarray:
    if isinstance(value, bool | str):
        raise UsageError(f"within: {name} = {value!r}; expected a number, or a list of them")
    try:
        return read_numbers("within", name, value, 0, 1)
    except ModelError as error:
        raise UsageError(str(error)) from None
