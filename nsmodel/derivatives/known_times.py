"""What happens to derivatives at known times: by how much they move, and what is held after them.

At a joint of a signal, t_e(p), held states are data after it, whose derivatives are those of the signal at a fixed time. A block
that ticks sets what it holds to an expression of the state, inputs and parameters. An edge that a block places moves with what
that holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import casadi as ca
import numpy as np

from nsmodel.derivatives.tangent_equations import TRY_DIFFERENCES
from nsmodel.errors import UsageError
from nsmodel.event_driven.problem import AHEAD, SAME_TIME, ContinuousProblem, signal_degree, switch_times_of
from nsmodel.modeling.base import Model
from nsmodel.modeling.blocks import model_ticks
from nsmodel.modeling.signals.base import ParametricSignal, Signal
from nsmodel.modeling.signals.function import Expression
from nsmodel.modeling.signals.pwm import HeldSignal, Pwm
from nsmodel.proof.verdict import not_none


class SignalNumber(NamedTuple):
    """A number of a signal that a run is differentiated by: the column of S, the input, and its name there (".duty")."""

    column: int
    group: str
    number: str


class MovedTime(NamedTuple):
    """How a known time moves, dt = by_state S + own: (n,), (q,); what acts at it; whether edges of two inputs move apart.

    ``edges``: of each input that has an edge there the states that it is, and its own dt (n + q,).
    """

    by_state: np.ndarray
    own: np.ndarray
    names: tuple[str, ...]
    edges_differ: bool
    edges: tuple[tuple[list[int], np.ndarray], ...]


class HeldPlaces:
    """Where the inputs of a model stand among the states of its problem.

    Attributes:
        of: {input: the places of its values}, of those that are states; each is followed by its derivatives.
        entries: of each entry of u its place, None where it is an expression of time.
    """

    def __init__(self, model: Model, problem: ContinuousProblem) -> None:
        self.of: dict[str, list[int]] = {}
        self.entries: list[int | None] = []
        at = problem.x.numel() - problem.held
        for group, signal in model.inputs.items():
            names = model.input_groups[group]
            if isinstance(signal, Expression):
                self.entries += [None] * len(names)
                continue
            width = signal_degree(group, signal) + 1
            self.of[group] = [at + k * width for k in range(len(names))]
            self.entries += self.of[group]
            at += width * len(names)


class KnownTimes:
    """The known times of a model with numbers for its parameters."""

    def __init__(
        self,
        model: Model,
        free: Model,
        problem: ContinuousProblem,
        by: Sequence[int],
        numbers: Sequence[SignalNumber],
        t_end: float,
    ) -> None:
        """``free``: the same model with symbols, of which the entries ``by`` have the first columns of S; then ``numbers``."""
        self._model = model
        self._weights = _number_slopes(model, free, by, numbers)
        self._driven = {group for group, _ in self._weights}
        self._times = np.array(switch_times_of(model, t_end).times, float)
        self._places = HeldPlaces(model, problem)
        self._signals = {name: s for name, s in model.inputs.items() if isinstance(s, Signal) and not isinstance(s, HeldSignal)}
        self._joints = {name: signal.joints(AHEAD * t_end) for name, signal in self._signals.items()}
        self._ticks = _TickSlopes(model, free, self._places, by) if model.blocks else None

    def is_known(self, t: float, x: np.ndarray) -> bool:
        """Whether a known time is there, of signals, blocks or the model; ``x``: the state just before it."""
        return _is_among(t, self._times) or any(self._placed_slope(name, t, x) != 0 for name in self._placed_by_blocks)

    @property
    def _placed_by_blocks(self) -> list[str]:
        """The inputs that are PWMs whose duty a block holds."""
        return [name for name, signal in self._signals.items() if isinstance(signal, Pwm) and signal.moving]

    def _placed_slope(self, name: str, t: float, x: np.ndarray) -> float:
        """The derivative of an edge at t by the duty that is held."""
        found = self._signal(name, x)
        return found.held_duty_slope(t) if isinstance(found, Pwm) else 0.0

    def _signal(self, name: str, x: np.ndarray) -> Signal:
        """A signal, with the duty that is held where a block sets that."""
        signal: Any = self._signals[name]
        return signal.holding({signal.duty.name: x[self._places.of[signal.duty.name]]}) if signal.moving else signal

    def moving_edges(self, t: float) -> list[str]:
        """The signals with an edge at t that moves with what the run is differentiated by."""
        return [
            name
            for name, signal in self._signals.items()
            if _is_among(t, self._joints[name])
            and any(slope and (name, number) in self._weights for number, slope in signal.joint_slopes(t).items())
        ]

    def moved(self, t: float, x: np.ndarray, q: int) -> MovedTime:
        """How the known time t moves, where the state just before it is x."""
        rows, names = [], []
        for name, signal in self._signals.items():
            row = np.zeros(len(x) + q)
            if name in self._placed_by_blocks:
                row[self._places.of[cast("Any", self._signals[name]).duty.name][0]] = self._placed_slope(name, t, x)
                if not row.any():
                    continue
            elif not _is_among(t, self._joints[name]):
                continue
            for number, slope in signal.joint_slopes(t).items():
                if (weights := self._weights.get((name, number))) is not None:
                    row[len(x) : len(x) + weights.size] += slope * weights
            rows.append(row)
            names.append(name)
        whole = max(rows, key=lambda row: float(np.abs(row).max()), default=np.zeros(len(x) + q))
        ticks = model_ticks(self._model)
        blocks = [] if ticks is None else [self._model.blocks[i].name for i in ticks.due_blocks(t)]
        edges_differ = any((row != whole).any() for row in rows)
        edges = tuple(zip(map(self._rows, names), rows, strict=True))
        return MovedTime(whole[: len(x)], whole[len(x) :], (*names, *blocks), edges_differ, edges)

    def _rows(self, group: str) -> list[int]:
        """The states that an input is: all values, then all of their derivatives."""
        width = signal_degree(group, self._signals[group]) + 1
        return [place + k for k in range(width) for place in self._places.of.get(group, ())]

    def put_held(self, t: float, x: np.ndarray, by_state: np.ndarray, own: np.ndarray) -> None:
        """Put the derivatives of what is held just after t to the rows of the maps (n, n) and (n, q) of S.

        ``x``: the state just before. The maps have what S is just before what is held is set.
        """
        for group in self._signals:
            if group not in self._places.of:
                continue
            rows = self._rows(group)
            by_state[rows] = own[rows] = 0.0
            for number, slopes in self._signal(group, x).derivative_slopes(t).items() if group in self._driven else ():
                if (weights := self._weights.get((group, number))) is not None:
                    own[rows, : weights.size] += np.outer(slopes.ravel(), weights)
        if self._ticks is not None:
            u = np.array([0.0 if place is None else x[place] for place in self._places.entries])
            self._ticks.put(t, x, u, by_state, own)


def _number_slopes(
    model: Model, free: Model, by: Sequence[int], numbers: Sequence[SignalNumber]
) -> dict[tuple[str, str], np.ndarray]:
    """{(input, number of its signal): its derivatives by the columns of S}: 1 by itself, the chain rule by parameters.

    Raises:
        UsageError: a number moves that runs are not differentiated by.
    """
    width = len(by) + len(numbers)
    found = {(one.group, one.number): np.eye(width)[one.column] for one in numbers}
    values = np.array([model.bound_parameters.get(name, 0.0) for name in free.parameters], float)
    for group, signal in free.inputs.items():
        if not isinstance(signal, ParametricSignal):
            continue
        known = not_none(model.inputs[group]).numbers
        for number, slopes in signal.number_slopes(free.p, values, by).items():
            if number not in known and slopes.any():
                moving = list(free.parameters)[by[int(np.flatnonzero(slopes)[0])]]
                raise UsageError(
                    f"by: '{moving}' moves the {number[1:]} of input '{group}', whose duty is not a number; {TRY_DIFFERENCES}"
                )
            found[group, number] = np.pad(slopes, (0, len(numbers)))
    return found


def _is_among(t: float, times: np.ndarray) -> bool:
    """Whether a time is one of these, to rounding."""
    k = np.searchsorted(times, t - SAME_TIME * abs(t))
    return bool(k < len(times) and times[k] <= t + SAME_TIME * abs(t))


class _TickSlopes:
    """The derivatives of what blocks set at their ticks."""

    def __init__(self, model: Model, free: Model, places: HeldPlaces, by: Sequence[int]) -> None:
        self._model, self._ticks, self._places = model, not_none(model_ticks(model)), places
        self._values = np.array([model.bound_parameters.get(name, 0.0) for name in free.parameters], float)
        l, p = getattr(free, "lam", ca.SX(0, 1)), free.p[list(by)]
        self._functions = []
        for block in free.blocks:
            following = ca.substitute(block.next, l, ca.SX.zeros(l.shape)) if l.numel() else block.next
            slopes = [ca.densify(ca.jacobian(following, symbol)) for symbol in (free.state, free.u, p)]
            self._functions.append(ca.Function("tick", [free.t, free.state, free.u, free.p], slopes))

    def put(self, t: float, x: np.ndarray, u: np.ndarray, by_state: np.ndarray, own: np.ndarray) -> None:
        """See `KnownTimes.put_held`; ``u``: what was held."""
        due, places = self._ticks.due_blocks(t), self._places.entries
        u = _inputs_after(self._model, t, u)
        for latches in (False, True):
            seen = by_state.copy(), own.copy()
            for i in due:
                block = self._model.blocks[i]
                if block.latch is not latches:
                    continue
                of_x, of_u, of_p = (np.array(part) for part in self._functions[i](t, x[: self._ticks.states], u, self._values))
                rows = [not_none(places[entry]) for entry in block.at]
                for out, had in zip((by_state, own), seen, strict=True):
                    out[rows] = of_x @ had[: self._ticks.states]
                    for entry, place in enumerate(places):
                        if place is not None:
                            out[rows] += np.outer(of_u[:, entry], had[place])
                own[rows, : of_p.shape[1]] += of_p


def _inputs_after(model: Model, t: float, u: np.ndarray) -> np.ndarray:
    """The inputs (nu,) with what signals are just after t; what blocks hold stays."""
    u, at = u.copy(), 0
    for group, signal in model.inputs.items():
        size = len(model.input_groups[group])
        if isinstance(signal, Signal) and not isinstance(signal, HeldSignal) and not signal.moving:
            u[at : at + size] = signal.after(np.array([t]))[0]
        at += size
    return u
