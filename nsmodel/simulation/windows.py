"""Integrals, means, rms values and Fourier coefficients of quantities of a run over windows of time, as its scheme sees them.

A step of a scheme with weights theta and gamma adds to its states h times a rate at

    t + theta h,   x = theta x+ + (1 - theta) x,   u = theta u(b-) + (1 - theta) u(a+),   l = gamma l+ + (1 - gamma) l,

and there a quantity is taken for the whole step: so what an integral says of power is what the states of the run say of energy.
For theta = 1/2 and gamma = 1 the change of a quadratic energy is that integral exactly, to rounding, whatever the step. Schemes
without weights are implicit: 1, 1. Where gamma < 1 the reaction of the start, or one that is found anew after a jump of an input,
is in no row: l and y of such a step are those of its end. Within the pieces of an event-driven run everything is a polynomial of
time, and integrals are Gauss sums.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from nsmodel._utils import short_repr
from nsmodel.errors import UsageError
from nsmodel.event_driven import dense_output
from nsmodel.modeling.output_columns import evaluate_quantity
from nsmodel.modeling.outputs import Quantity
from nsmodel.simulation.columns import column_names, quantity_at_step_ends, read_quantity
from nsmodel.simulation.run_data import RunData

THETA_WEIGHTED = frozenset({"x", "y"})  # What is weighed by theta; t and inputs have their own ends.
WINDOW_TOLERANCE = 1e-12  # A window may end beyond the run by this part of it, 4500 EPS: rounding of sums of steps. (+)


class Spectrum(NamedTuple):
    """Fourier coefficients of a window of length T: q(t) ~ sum_k Re(c_k exp(2 pi i f_k (t - t0))).

    frequency (K+1,): k/T; coefficient (K+1,) or (K+1, size) complex: c_0 is the mean, |c_k| the amplitude at f_k.
    """

    frequency: np.ndarray
    coefficient: np.ndarray

    __repr__ = short_repr


class WeightedSamples(NamedTuple):
    """Weights (K,), of which the sum is the length of the window, and what a quantity is there: (K,) or (K, size)."""

    weights: np.ndarray
    values: np.ndarray


def window_samples(run: RunData, what: Any, t0: float | None, t1: float | None) -> WeightedSamples:
    """What integrals over a window are made of.

    Raises:
        UsageError: a window that is none or not in the run; a name that the run does not have; of an event-driven run one that is
            known at its rows alone, or a multiplier that has an impulse in the window.
    """
    begin, end = check_window(run, t0, t1)
    quantity, label = read_quantity(run, what)
    if run.is_event_driven and len(run.arrays["piece_start"]):
        t, number, weights = _gauss_nodes(run, begin, end, 0)
        return WeightedSamples(weights, _quantity_within_pieces(run, quantity, label, t, number))
    first, last = int(np.searchsorted(run.t, begin, "right")) - 1, int(np.searchsorted(run.t, end, "left"))
    t = np.clip(run.t[first : last + 1], begin, end)
    found = evaluate_quantity(quantity, column_names(run), _StepColumns(run, first, last), label)
    return WeightedSamples(np.diff(t), found)


def check_window(run: RunData, t0: float | None, t1: float | None) -> tuple[float, float]:
    """Both ends; left out they are those of the run."""
    first, last = float(run.t[0]), float(run.t[-1])
    begin, end = first if t0 is None else float(t0), last if t1 is None else float(t1)
    room = WINDOW_TOLERANCE * (last - first)
    if not first - room <= begin < end <= last + room:
        raise UsageError(f"window from t0 = {begin:.10g} to t1 = {end:.10g}: expected {first:.10g} <= t0 < t1 <= {last:.10g}")
    return max(begin, first), min(end, last)


def weighted_integral(found: WeightedSamples) -> np.ndarray:
    """The integral over the window, () or (size,)."""
    return found.weights @ found.values


def weighted_mean(found: WeightedSamples) -> np.ndarray:
    """The mean over the window, () or (size,)."""
    return weighted_integral(found) / found.weights.sum()


def weighted_rms(found: WeightedSamples) -> np.ndarray:
    """The root of the mean of the square."""
    return np.sqrt(weighted_mean(found._replace(values=found.values**2)))


class _StepColumns(Mapping[str, np.ndarray]):
    """The columns of a run as its scheme sees them in the steps that end at rows first + 1 to last."""

    def __init__(self, run: RunData, first: int, last: int) -> None:
        self._arrays, self._before, self._end = run.arrays, slice(first, last), slice(first + 1, last + 1)
        self._theta, self._gamma = run.metadata.get("weights", (1.0, 1.0))

    def __getitem__(self, name: str) -> np.ndarray:
        """A column, or columns, of steps."""
        end, theta = self._arrays[name][self._end], self._theta
        if name == "inputs":
            return theta * end + (1 - theta) * self._arrays["inputs_begin"][self._end]
        weight = self._gamma if name == "multipliers" else theta if name in THETA_WEIGHTED or name == "t" else 1.0
        if weight == 1:
            return end
        before = self._arrays[name][self._before]
        if name in ("multipliers", "y"):
            before = np.where(np.isnan(before) | self._jump_steps[:, None], end, before)
        return weight * end + (1 - weight) * before

    @property
    def _jump_steps(self) -> np.ndarray:
        """The steps that begin with a jump of an input: there the row before has what belongs to the old regime."""
        if "inputs" not in self._arrays:
            return np.zeros(self._end.stop - self._end.start, bool)
        return (self._arrays["inputs_begin"][self._end] != self._arrays["inputs"][self._before]).any(axis=1)

    def __iter__(self) -> Iterator[str]:
        """The names of the columns."""
        return iter(self._arrays)

    def __len__(self) -> int:
        """How many there are."""
        return len(self._arrays)


# -- event-driven runs ---------------------------------------------------------------------------------------------------


def _gauss_nodes(run: RunData, begin: float, end: float, harmonics: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, pieces and weights of Gauss sums, exact for the square of what a piece is; more where a harmonic is fast in it."""
    starts, order = run.arrays["piece_start"], run.arrays["piece_x"].shape[2]
    edges = np.concatenate([[begin], starts[(starts > begin) & (starts < end)], [end]])
    parts = np.maximum(np.ceil(harmonics * np.diff(edges) / (end - begin)), 1).astype(int)
    number = np.repeat(dense_output.piece_numbers_at(run.arrays, edges[:-1]), parts)
    part = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    length = np.repeat(np.diff(edges) / parts, parts)
    left = np.repeat(edges[:-1], parts) + part * length
    s, weights = np.polynomial.legendre.leggauss(order + 4 * bool(harmonics))
    t = left[:, None] + (s + 1) / 2 * length[:, None]
    return t.ravel(), np.repeat(number, len(s)), (length[:, None] * weights / 2).ravel()


def _quantity_within_pieces(run: RunData, quantity: Quantity, label: str, t: np.ndarray, number: np.ndarray) -> np.ndarray:
    """A quantity at times within pieces of these numbers."""
    names, found = column_names(run), dense_output.evaluate_pieces(run.arrays, t, number)
    arrays = {"t": t, "x": found.x, "multipliers": found.multipliers, "y": found.y}
    if found.v.shape[1]:
        arrays["v"] = found.v
    if "reactions" in run.arrays:  # There the multipliers of rows are impulses of the time between them.
        arrays["reactions"] = arrays.pop("multipliers")
    elif any(names.column(name, {"multipliers": found.multipliers}) is not None for name in quantity.of):
        _check_no_impulses(run, label, t)
    if (between := run.metadata.get("between_rows")) is not None:
        s = dense_output.local_times(run.arrays, number, t)
        x = dense_output.evaluate_polynomials(run.arrays["piece_x"], number, s)
        inputs = (between[name] for name in names.inputs)
        columns = [x[:, own] if isinstance(own, int) else _evaluate_at_times(Quantity.from_text(own), t) for own in inputs]
        arrays["inputs"] = np.stack(columns, axis=1)
    return evaluate_quantity(quantity, names, arrays, f"{label}, between the rows of an event-driven run")


def _evaluate_at_times(quantity: Quantity, t: np.ndarray) -> np.ndarray:
    return quantity(np.repeat(t[:, None], len(quantity.of), axis=1))


def _check_no_impulses(run: RunData, label: str, t: np.ndarray) -> None:
    starts = run.arrays["piece_start"]
    inside = (starts > t[0]) & (starts < t[-1]) & (run.arrays["piece_impulse"] != 0).any(axis=1)
    if inside.any():
        raise UsageError(
            f"{label}: at t = {starts[inside][0]:.10g} a multiplier is an impulse, which no such integral has: see run.events"
        )


# -- Fourier coefficients ------------------------------------------------------------------------------------------------


def spectrum(run: RunData, what: Any, t0: float | None, t1: float | None, harmonics: int) -> Spectrum:
    """Fourier coefficients over a window, of as many harmonics of its length.

    They are integrals and no sums over samples, so that steps of different lengths and edges within the window are as they are:
    of an event-driven run of what it is, else of straight lines from the begin of each step to its end, with the inputs of both.
    """
    begin, end = check_window(run, t0, t1)
    if isinstance(harmonics, bool) or not isinstance(harmonics, int | np.integer) or harmonics < 1:
        raise UsageError(f"harmonics = {harmonics!r}; expected a whole number > 0")
    quantity, label = read_quantity(run, what)
    frequency = np.arange(harmonics + 1) / (end - begin)
    if run.is_event_driven and len(run.arrays["piece_start"]):
        t, number, weights = _gauss_nodes(run, begin, end, int(harmonics))
        q = _quantity_within_pieces(run, quantity, label, t, number)
        weighted = (weights * q.T).T
        coefficient = np.array([np.exp(-2j * math.pi * f * (t - begin)) @ weighted for f in frequency])
    else:
        coefficient = _fourier_of_segments(*_step_segments(run, quantity, label, begin, end), frequency, begin)
    coefficient = 2 * coefficient / (end - begin)
    coefficient[0] /= 2
    return Spectrum(frequency, coefficient)


def _step_segments(
    run: RunData, quantity: Quantity, label: str, begin: float, end: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Begins and ends of the steps in a window, and the quantity just after the one and just before the other."""
    first, last = int(np.searchsorted(run.t, begin, "right")) - 1, int(np.searchsorted(run.t, end, "left"))
    t, (first, last) = run.t[first : last + 1], quantity_at_step_ends(run, quantity, label, first, last)
    left, right = np.clip(t[:-1], begin, end), np.clip(t[1:], begin, end)
    share = [((own - t[:-1]) / np.diff(t)).reshape(-1, *[1] * (first.ndim - 1)) for own in (left, right)]
    return left, right, first + share[0] * (last - first), first + share[1] * (last - first)


def _fourier_of_segments(
    a: np.ndarray, b: np.ndarray, q_a: np.ndarray, q_b: np.ndarray, frequency: np.ndarray, begin: float
) -> np.ndarray:  # fmt: skip
    """The integrals of q exp(-2 pi i f (t - begin)) over lines from a to b, in closed form, f by f."""
    shape = (-1, *[1] * (q_a.ndim - 1))
    middle, half, length = (a + b) / 2 - begin, (b - a) / 2, b - a
    found = []
    for f in frequency:
        z = 2 * math.pi * f * half
        even, odd = np.sinc(z / math.pi), _odd_moment(z)
        phasor = length * np.exp(-2j * math.pi * f * middle)
        found.append(
            ((phasor * even).reshape(shape) * (q_a + q_b) / 2 - 1j * (phasor * odd).reshape(shape) * (q_b - q_a) / 2).sum(0)
        )
    return np.array(found)


def _odd_moment(z: np.ndarray) -> np.ndarray:
    """The mean of s sin(z s) over -1 <= s <= 1: (sin z - z cos z)/z^2."""
    small = np.abs(z) < 1e-2
    safe = np.where(small, 1.0, z)
    return np.where(small, z / 3 - z**3 / 30, (np.sin(safe) - safe * np.cos(safe)) / safe**2)
