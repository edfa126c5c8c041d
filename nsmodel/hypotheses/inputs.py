"""What a check takes the inputs of a model for: all signals within bounds, given or read off the model's own.

What is said of a model at each time is decided at each constant value in the box of the inputs; what is said of how it moves in
time needs |u'|, or sees a jump. A class says in its module ``hypotheses/driven.py`` what is what.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.errors import UsageError
from nsmodel.hypotheses.findings import UNKNOWN, Consequence, IntervalBox
from nsmodel.hypotheses.region import Region, depends_on_symbol
from nsmodel.modeling.base import Model
from nsmodel.modeling.inputs import signal_label, signals_by_name
from nsmodel.modeling.signals.base import ConstantSignal, Signal, SignalJump, SizedBounds, Within
from nsmodel.simulation.trajectory import Trajectory

BOUNDS_ADVICE = "give bounds={{'{0}': within(low, high)}} or --bound {0}=LOW:HIGH"
UNUSED_SIGNAL = ConstantSignal(np.zeros(1))  # What an input of which nothing of a model depends is taken for.
# By which part of its bounds a run's signal may be beyond them: bounds
# are given in decimals, and signals are sums of a few terms.
BOUND_SLACK = 1e-9


class InputJump(NamedTuple):
    """A jump of one input: the values (k,) of all that a check takes for parameters before and after it."""

    name: str
    jump: SignalJump
    before: np.ndarray
    after: np.ndarray

    def at(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(x, t, p) before and after it."""
        before, after = (np.concatenate([x, [self.jump.t], p]) for p in (self.before, self.after))
        return before, after

    @property
    def witness(self) -> dict[str, Any]:
        """When, and from where to where."""
        return {"t": self.jump.t, f"{self.name}-": self.jump.before, f"{self.name}+": self.jump.after}

    @property
    def text(self) -> str:
        """The jump in words."""
        return f"'{self.name}' jumps at t = {self.jump.t:.6g}"


@dataclass(frozen=True, eq=False)
class InputBounds:
    """The inputs of a model as a check takes them.

    Attributes:
        u, v: symbols (k,) of the scalar inputs that are not constant, and of u'.
        names: of these; entries: the input that each is an entry of, and which.
        low, high, rate: (k,); a rate is inf where a signal may jump.
        start: {name: u(0+)}, where it is known.
        held: {name: value} of those that are constant.
        meant: {input: its bounds, (nu,) each}; given: the inputs of which they were given.
        jumps: {input: the largest jump of the model's own signal}.
        own: the inputs of which the model's own signal is meant, and is a polynomial of time between edges that end steps.
    """

    u: ca.SX
    v: ca.SX
    names: tuple[str, ...]
    entries: tuple[tuple[str, int], ...]
    low: np.ndarray
    high: np.ndarray
    rate: np.ndarray
    start: Mapping[str, float]
    held: Mapping[str, float]
    meant: Mapping[str, SizedBounds]
    given: frozenset[str]
    jumps: Mapping[str, SignalJump]
    own: frozenset[str]

    @property
    def box(self) -> IntervalBox:
        """{name: (low, high)}."""
        return dict(zip(self.names, zip(self.low.tolist(), self.high.tolist(), strict=True), strict=True))

    @property
    def rates(self) -> tuple[np.ndarray, np.ndarray]:
        """The ends of u' (k,)."""
        return -self.rate, self.rate

    def velocity(self, expression: ca.SX, t: ca.SX) -> ca.SX:
        """The derivative by time along a signal: by t, and by u times u'."""
        column = ca.densify(ca.vec(expression))
        return ca.densify(ca.jacobian(column, t) + ca.jacobian(column, self.u) @ self.v)

    def indices_read_by(self, *parts: Any) -> list[int]:
        """Which of the scalar inputs some parts of a model depend on."""
        return [k for k in range(len(self.names)) if any(depends_on_symbol(part, self.u[k]) for part in parts)]

    def jumping_indices(self, *parts: Any) -> list[int]:
        """Which of these have no rate."""
        return [k for k in self.indices_read_by(*parts) if not np.isfinite(self.rate[k])]

    def edges(self, which: Iterable[int], region: Region) -> list[InputJump]:
        """The jumps of the own signals of these; ``region`` has the boxes of all parameters, which else are in their middle."""
        names, (low, high) = list(region.parameters), region.parameter_bounds()
        found = []
        for name in dict.fromkeys(self.entries[k][0] for k in which):
            if (jump := self.jumps.get(name)) is not None:
                sides = [low + (high - low) / 2 for _ in range(2)]
                for k, (own, place) in enumerate(self.entries):
                    for side, u in zip(sides, (jump.before, jump.after), strict=True):
                        if own == name:
                            side[names.index(self.names[k])] = u[place]
                found.append(InputJump(name, jump, *sides))
        return found


EMPTY_VECTOR = np.zeros(0)  # Of a model without inputs.
NO_INPUT_BOUNDS = InputBounds(  # Of a model without inputs.
    ca.SX(0, 1), ca.SX(0, 1), (), (), EMPTY_VECTOR, EMPTY_VECTOR, EMPTY_VECTOR, {}, {}, {}, frozenset(), {}, frozenset()
)  # fmt: skip


def input_bounds(model: Model, bounds: Any, t_end: float) -> InputBounds:
    """Read what is given, and of other inputs what their signals tell up to ``t_end``.

    Raises:
        UsageError: an unknown input, bounds that are none or of another size, an input of which nothing is known.
    """
    if bounds is not None and not isinstance(bounds, Mapping):
        raise UsageError(f"bounds: expected a dictionary {{input: within(low, high)}}, not a {type(bounds).__name__}")
    given = signals_by_name(bounds, model.input_groups)
    own = {name: model.u[[model.input_names.index(one) for one in names]] for name, names in model.input_groups.items()}
    parts = [part for name, part in vars(model).items() if name not in ("blocks", "inputs", "u")]
    meant = {
        name: _given_bounds(name, given[name], len(names))
        if name in given
        else _signal_bounds(name, model.inputs[name] if depends_on_symbol(parts, own[name]) else UNUSED_SIGNAL, len(names), t_end)
        for name, names in model.input_groups.items()
    }
    scalars = [(name, place) for name, names in model.input_groups.items() for place in range(len(names))]
    low, high, rate, start = (np.array([getattr(meant[name], end)[k] for name, k in scalars]) for end in SizedBounds._fields)
    moving, labels = np.flatnonzero(low < high), model.input_names
    jumps = {name: signal.jump(t_end) for name, signal in model.inputs.items() if signal is not None}
    return InputBounds(
        u=model.u[moving.tolist()],
        v=ca.vertcat(ca.SX(0, 1), *(ca.SX.sym(f"{labels[k]}'") for k in moving)),
        names=tuple(labels[k] for k in moving),
        entries=tuple(scalars[k] for k in moving),
        low=low[moving],
        high=high[moving],
        rate=rate[moving],
        start={labels[k]: float(start[k]) for k in moving if np.isfinite(start[k])},
        held={labels[k]: float(low[k]) for k in np.flatnonzero(low == high)},
        meant=meant,
        given=frozenset(given),
        jumps={name: jump for name, jump in jumps.items() if jump is not None},
        own=frozenset(name for name, signal in model.inputs.items() if name not in given and _is_piecewise_polynomial(signal)),
    )


def _given_bounds(name: str, bounds: Any, size: int) -> SizedBounds:
    if not isinstance(bounds, Within):
        raise UsageError(f"bounds of '{name}': {bounds!r:.60}; expected within(low, high), or within(low, high, rate=...)")
    if not bounds.sizes <= {size}:
        has = "one value" if size == 1 else f"{size} values"
        raise UsageError(f"bounds of '{name}': within(...) has {max(bounds.sizes)} values, and the input {has}; give as many")
    return bounds.of_size(size)


def _signal_bounds(name: str, signal: Signal | None, size: int, t_end: float) -> SizedBounds:
    fix = BOUNDS_ADVICE.format(name)
    if signal is None:
        raise UsageError(f"input '{name}' has neither a signal nor bounds; {fix}")
    found = signal.within(t_end)
    if found is None:
        raise UsageError(f"input '{name}': the bounds of its signal are not known; {fix}")
    return found.of_size(size)


def _is_piecewise_polynomial(signal: Signal | None) -> bool:
    return signal is not None and signal.degree is not None and signal.count is None


# -- words -------------------------------------------------------------------------------------------------------------


def describe_inputs(model: Model, motion: InputBounds, parts: Mapping[str, Sequence[str]] | None) -> tuple[str, ...]:
    """One line an input: where it stands, and which signals are meant; ``parts``: {word: names of the model's expressions}."""
    if parts is None:
        parts = {part.name: (part.name,) for part in fields(model) if part.init}
    lines = []
    for name, names in model.input_groups.items():
        own = model.u[[model.input_names.index(one) for one in names]]
        where = [word for word, of in parts.items() if any(depends_on_symbol(getattr(model, one), own) for one in of)]
        signals = "; ".join(_signal_text(motion, one, one if len(names) > 1 else "") for one in names)
        signal = model.inputs[name]
        source = "given" if name in motion.given or signal is None else f"read off its {signal_label(signal)}"
        lines.append(f"{name}: {f'in {_join_with_and(where)}' if where else 'stands nowhere'}; {signals} ({source})")
    return tuple(lines)


def _signal_text(motion: InputBounds, name: str, label: str) -> str:
    """The signals that are meant of a scalar input."""
    own = f"{label} " if label else ""
    if name in motion.held:
        return f"{own}constant, {motion.held[name]:.6g}"
    k = motion.names.index(name)
    kind = f"|{label or name}'| <= {motion.rate[k]:.6g}" if np.isfinite(motion.rate[k]) else "any measurable function"
    start = f", {motion.start[name]:.6g} at t = 0" if name in motion.start else ""
    return f"{own}within [{motion.low[k]:.6g}, {motion.high[k]:.6g}], {kind}{start}"


def _join_with_and(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def missing_rate_reason(motion: InputBounds, which: Iterable[int]) -> str:
    """Why nothing is known of how fast a model moves with these inputs."""
    names = ", ".join(f"'{motion.names[k]}'" for k in which)
    return f"no rate of {names} is known, and a signal that jumps would move the model at once; give within(..., rate=...)"


def out_of_bounds_reason(model: Model, motion: InputBounds, run: Trajectory) -> str:
    """Why the signals of a run are none of those of which bounds were given, as its rows show; "" where they are."""
    for name in sorted(motion.given if "inputs" in run.arrays else ()):
        at, meant = [model.input_names.index(one) for one in model.input_groups[name]], motion.meant[name]
        end, begin = (run.arrays[column][:, at] for column in ("inputs", "inputs_begin"))
        room = BOUND_SLACK * (1 + np.maximum(np.abs(meant.low), np.abs(meant.high)))
        seen = np.vstack([end, begin])
        if ((seen < meant.low - room) | (seen > meant.high + room)).any():
            return f"'{name}' of the run goes from {seen.min():.6g} to {seen.max():.6g}, beyond its bounds"
        u = np.stack([begin[1:], end[1:]], axis=1).reshape(-1, len(at))
        t = np.stack([run.t[1:] - run.step[1:], run.t[1:]], axis=1).ravel()
        limited = np.isfinite(meant.rate)
        most = (meant.rate * (1 + BOUND_SLACK))[limited] * np.diff(t)[:, None] + room[limited]
        fast = (np.abs(np.diff(u[:, limited], axis=0)) > most).any(axis=1)
        if fast.any():
            return f"'{name}' of the run changes faster at t = {t[int(fast.argmax())]:.6g} than its bounds allow"
    return ""


# -- what follows ------------------------------------------------------------------------------------------------------


def unknown_consequence(consequence: Consequence, reason: str) -> Consequence:
    """The consequence, which does not follow for a reason."""
    statement = f"{consequence.statement}; {reason}"
    return replace(consequence, verdict=UNKNOWN, statement=statement, value={}, clause="", until=None)


def mark_unknown_between_ticks(model: Model, made: Iterable[Consequence]) -> list[Consequence]:
    """What follows for given signals, where blocks make them of the state: unknown."""
    names = ", ".join(f"'{block.name}'" for block in model.blocks if not block.latch)
    reason = f"what holds between the ticks of {names} is not known across them: they act on what the state was"
    return [unknown_consequence(item, reason) if model.blocks else item for item in made]


def scheme_limit_consequence(
    consequence: Consequence, motion: InputBounds, read: Iterable[int], *, smooth: bool = False
) -> Consequence:
    """What is said of a scheme's limit, which knows a signal by its values at the ends of steps alone.

    Args:
        consequence: for signals that are continuous between edges that end steps, ``smooth``: that are smooth there.
        motion, read: the inputs, and those that matter.
        smooth: as said.
    """
    loose = [k for k in read if motion.entries[k][0] not in motion.own and (smooth or not np.isfinite(motion.rate[k]))]
    if not loose:
        return consequence
    kind = "smooth" if smooth else "continuous"
    names = ", ".join(f"'{motion.names[k]}'" for k in loose)
    reason = f"steps see {names} at their ends alone, and not each signal that is meant is {kind} between edges that end steps"
    return unknown_consequence(consequence, reason)
