"""Where a statement was decided: a box of states, an interval of time, boxes of parameters; None where it is everywhere."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from nsmodel._utils import short_repr
from nsmodel.modeling.pickling import Picklable

IntervalBox = Mapping[str, tuple[float, float]]
MAX_WRITTEN_INTERVALS = 6  # Intervals that are written out.


@dataclass(frozen=True)
class Scope(Picklable):
    """The set that a verdict speaks of; what is not named is not restricted.

    Attributes:
        states: {name: (low, high)} of states, and of multipliers where their box enters.
        time: (t0, t1); None: all times.
        parameters: {name: (low, high)}.
    """

    states: IntervalBox = field(default_factory=lambda: MappingProxyType({}))
    time: tuple[float, float] | None = None
    parameters: IntervalBox = field(default_factory=lambda: MappingProxyType({}))

    __repr__ = short_repr

    @property
    def text(self) -> str:
        """In words: "everywhere", "t in [0, 2]", "on the box", "on the box, t in [0, 2]"."""
        parts = ["on the box"] if self.states else []
        parts += [f"t in [{self.time[0]:.5g}, {self.time[1]:.5g}]"] if self.time is not None else []
        parts += [f"{name} in [{low:.5g}, {high:.5g}]" for name, (low, high) in self.parameters.items()]
        return ", ".join(parts) or "everywhere"

    def document(self) -> dict[str, object]:
        """As data; an entry is None where nothing is restricted."""
        return {
            "states": {name: list(ends) for name, ends in self.states.items()} or None,
            "time": None if self.time is None else list(self.time),
            "parameters": {name: list(ends) for name, ends in self.parameters.items()} or None,
        }


def intersect_scopes(*scopes: Scope | None) -> Scope | None:
    """The intersection.

    >>> intersect_scopes(Scope(time=(0.0, 2.0)), None, Scope({"x": (0.0, 1.0)}, (0.0, 1.0))).text
    'on the box, t in [0, 1]'
    """
    states: dict[str, tuple[float, float]] = {}
    parameters: dict[str, tuple[float, float]] = {}
    time = None
    for scope in scopes:
        if scope is None:
            continue
        for boxes, own in ((states, scope.states), (parameters, scope.parameters)):
            for name, ends in own.items():
                boxes[name] = _intersect_intervals(boxes.get(name), ends)
        time = _intersect_intervals(time, scope.time) if scope.time is not None else time
    return Scope(states, time, parameters) if states or parameters or time is not None else None


def _intersect_intervals(one: tuple[float, float] | None, other: tuple[float, float]) -> tuple[float, float]:
    return other if one is None else (max(one[0], other[0]), min(one[1], other[1]))


def scope_text(scope: Scope | None) -> str:
    """Where, in words."""
    return "everywhere" if scope is None else scope.text
