"""The polynomials of an event-driven run: its values at any time, and its events."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from nsmodel._utils import short_repr
from nsmodel.errors import UsageError
from nsmodel.solvers.step import UNKNOWN_INDEX

RunArrays = Mapping[str, np.ndarray]


class At(NamedTuple):
    """A run at times t (k,): states (k, n), multipliers and outputs (k, m); velocities (k, n) of an oscillator, else (k, 0)."""

    t: np.ndarray
    x: np.ndarray
    v: np.ndarray
    multipliers: np.ndarray
    y: np.ndarray

    __repr__ = short_repr


class Event(NamedTuple):
    """A change of the mode at time t, before row ``row`` ends: index sets, and state, multipliers and outputs on both sides.

    ``width``: the time about t in which the sign of what changes there is not known; 0 where t is known as the state is.
    Where the state jumps, ``x_after`` is another than ``x_before``, by M^-1 g_l p with the ``impulse`` p (m,), one of each row of
    the law; it is 0 elsewhere.
    """

    t: float
    row: int
    before: np.ndarray
    after: np.ndarray
    x_before: np.ndarray
    x_after: np.ndarray
    multipliers_before: np.ndarray
    multipliers_after: np.ndarray
    y_before: np.ndarray
    y_after: np.ndarray
    impulse: np.ndarray
    width: float

    __repr__ = short_repr


def as_times(given: Any) -> np.ndarray:
    """Times (k,) from a number or k of them; UsageError for what is neither."""
    try:
        times = np.asarray(given, float)
    except (TypeError, ValueError):
        raise UsageError(f"t = {given!r}; expected a number, or a list of numbers") from None
    if times.ndim > 1:
        raise UsageError(f"t has shape {times.shape}; expected a number, or a list of numbers")
    return np.atleast_1d(times)


def evaluate_polynomials(coefficients: np.ndarray, number: np.ndarray, s: np.ndarray) -> np.ndarray:
    """sum_k c_k s^k for each row, of the piece of its number: coefficients (K, n, p + 1), number (k,), s (k,) -> (k, n)."""
    orders = np.ascontiguousarray(coefficients.transpose(2, 1, 0)).take(number, axis=2)
    total = orders[-1]
    for k in range(len(orders) - 2, -1, -1):
        total *= s
        total += orders[k]
    return total.T


def integrate_polynomials(coefficients: np.ndarray, number: np.ndarray, s: np.ndarray) -> np.ndarray:
    """The integrals of the same from 0 to s."""
    return s[:, None] * evaluate_polynomials(coefficients / np.arange(1, coefficients.shape[2] + 1), number, s)


def piece_numbers_at(arrays: RunArrays, t: np.ndarray) -> np.ndarray:
    """The number of the piece that each time is in; at an event that which begins there."""
    return np.clip(np.searchsorted(arrays["piece_start"], t, side="right") - 1, 0, None)


def local_times(arrays: RunArrays, number: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Times in the units of their pieces."""
    return (t - arrays["piece_start"][number]) / arrays["piece_unit"][number]


def evaluate_pieces(arrays: RunArrays, t: np.ndarray, number: np.ndarray | None = None) -> At:
    """The run at times t (k,), on the pieces of these numbers."""
    number = piece_numbers_at(arrays, t) if number is None else number
    s = local_times(arrays, number, t)
    x, l, y = (evaluate_polynomials(arrays[f"piece_{name}"], number, s) for name in ("x", "multipliers", "y"))
    n, v = arrays["x"].shape[1], arrays["v"].shape[1] if "v" in arrays else 0
    return At(t, x[:, :n], x[:, n : n + v], l, y)


def interpolate_rows(arrays: RunArrays, t: np.ndarray) -> At:
    """A run by time stepping at times t (k,): x on straight lines between rows, the others those of the step.

    At a row it is that row, bit for bit; what the row of the start does not know (NaN) is that of the first step.
    """
    rows, x = arrays["t"], arrays["x"]
    k = np.searchsorted(rows, t, side="left")
    left, right = np.maximum(k - 1, 0), k
    share = np.divide(t - rows[left], rows[right] - rows[left], out=np.ones_like(t), where=right > left)[:, None]
    line = np.where(share == 1, x[right], x[left] + share * (x[right] - x[left]))
    first = min(1, len(rows) - 1)

    def step_values(array: np.ndarray) -> np.ndarray:
        return np.where((k == 0)[:, None] & np.isnan(array[k]), array[first], array[k])

    v, l, y = (step_values(arrays[name]) if name in arrays else np.zeros((len(t), 0)) for name in ("v", "multipliers", "y"))
    return At(t, line, v, l, y)


def inputs_at(arrays: RunArrays, t: np.ndarray, *, after: bool = False) -> np.ndarray:
    """Inputs (k, nu) just before times, or just ``after``: on lines between what the step that ends at a row saw at both ends."""
    rows = arrays["t"]
    k = np.clip(np.searchsorted(rows, t, side="right" if after else "left"), min(1, len(rows) - 1), len(rows) - 1)
    length = rows[k] - rows[k - 1]
    share = np.divide(t - rows[k - 1], length, out=np.zeros_like(t), where=length > 0)[:, None]
    return arrays["inputs_begin"][k] + share * (arrays["inputs"][k] - arrays["inputs_begin"][k])


def find_mode_changes(arrays: RunArrays) -> tuple[Event, ...]:
    """All changes of the mode up to the last row, in order."""
    starts, codes = arrays["piece_start"], arrays["piece_codes"]
    numbers = np.flatnonzero(arrays["piece_event"] & (starts <= arrays["t"][-1]))
    t, last = starts[numbers], np.maximum(numbers - 1, 0)
    after, before = evaluate_pieces(arrays, t, numbers), evaluate_pieces(arrays, t, last)
    index = codes[last]
    if numbers.size and numbers[0] == 0:
        before.x[0], index[0] = arrays["x"][0], UNKNOWN_INDEX
    widths = arrays.get("piece_event_width", np.zeros(len(starts)))[numbers]
    both = (part for name in ("x", "multipliers", "y") for part in (getattr(before, name), getattr(after, name)))
    rows = np.searchsorted(arrays["t"], t).tolist()
    columns = (t.tolist(), rows, index, codes[numbers], *both, arrays["piece_impulse"][numbers], widths.tolist())
    return tuple(Event(*entries) for entries in zip(*columns, strict=True))


def sample_pieces(arrays: RunArrays, points: int, begin: float, end: float) -> dict[str, np.ndarray]:
    """About so many rows from ``begin`` to ``end`` for a picture: each piece from end to end, so that what jumps is there twice.

    The energy is on lines between its rows.
    """
    starts = arrays["piece_start"]
    stops = np.append(starts[1:], np.inf)
    inside = np.flatnonzero((starts < end) & (stops > begin))
    left, right = np.maximum(starts[inside], begin), np.minimum(stops[inside], end)
    counts = np.maximum(2, np.ceil(points * (right - left) / (end - begin))).astype(int)
    t = np.concatenate([np.linspace(a, b, n) for a, b, n in zip(left, right, counts, strict=True)])
    number = np.repeat(inside, counts)
    found = evaluate_pieces(arrays, t, number)
    own = {"piece_start": starts, "t": t, "x": found.x, "y": found.y, "index_set": arrays["piece_codes"][number]}
    own |= {name: found.multipliers for name in ("multipliers", "reactions") if name == "multipliers" or name in arrays}
    own |= {"v": found.v} if found.v.shape[1] else {}
    if "inputs" in arrays:
        own |= {"inputs": inputs_at(arrays, t), "inputs_begin": inputs_at(arrays, np.concatenate([t[:1], t[:-1]]), after=True)}
    if (energy := arrays.get("energy")) is not None:
        flat = energy.reshape(len(energy), -1).astype(float)
        own["energy"] = np.stack([np.interp(t, arrays["t"], c) for c in flat.T], axis=1).reshape(len(t), *energy.shape[1:])
    return own
