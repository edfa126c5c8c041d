"""What runs are differentiated by, and at which times: read from names of the user's.

By: a parameter ("a", or its symbol), a start ("x(0)"), a number of a signal ("u.duty", "u[3]", "u.t[3]").
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from nsmodel._utils import did_you_mean
from nsmodel.derivatives.known_times import SignalNumber
from nsmodel.errors import UsageError
from nsmodel.modeling.base import Model
from nsmodel.modeling.signals.base import Signal
from nsmodel.modeling.variants import start_entries, start_name


@dataclass(frozen=True)
class Directions:
    """What a run is differentiated by.

    Attributes:
        names: as the user gave them, in order.
        parameters: among these, the parameters; starts: {name: state}; numbers: of signals, by column.
    """

    names: tuple[str, ...]
    parameters: tuple[str, ...]
    starts: Mapping[str, str]
    numbers: tuple[SignalNumber, ...]

    @property
    def columns(self) -> list[int]:
        """The column that each name has: parameters and starts come first, in the order of the problem's own symbols."""
        first = [*self.parameters, *self.starts]
        at = {name: k for k, name in enumerate(first)} | {f"{n.group}{n.number}": n.column for n in self.numbers}
        return [at[name] for name in self.names]


def read_directions(model: Model, by: Any) -> Directions:
    """Read ``by``, one name or symbol or several.

    Raises:
        UsageError: none, one that is given twice, one that the model does not have, with those that it has.
    """
    given = [by] if isinstance(by, str | ca.SX) else list(by) if isinstance(by, Iterable) else None
    if not given:
        raise UsageError(f"by = {by!r}; expected names of parameters, starts or numbers of signals, such as by=['k', 'x(0)']")
    names = [name for one in given for name in _names_of(one)]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UsageError(f"by: '{twice}' is given twice; leave one out")
    starts = {name: state for state in start_entries(model) if (name := start_name(state)) not in model.parameters}
    numbers = {
        f"{group}{number}": (group, number)
        for group, signal in model.inputs.items() if isinstance(signal, Signal) for number in signal.numbers
    }  # fmt: skip
    for name in names:
        if name not in model.parameters and name not in starts and name not in numbers:
            raise UsageError(_unknown_direction(name, [*model.parameters, *starts, *numbers]))
    parameters = tuple(name for name in model.parameters if name in names)
    own_starts = {name: state for name, state in starts.items() if name in names}
    first = len(parameters) + len(own_starts)
    own = [numbers[name] for name in names if name in numbers and name not in parameters and name not in own_starts]
    return Directions(tuple(names), parameters, own_starts, tuple(SignalNumber(first + k, *one) for k, one in enumerate(own)))


def _names_of(one: Any) -> list[str]:
    if isinstance(one, str):
        return [one.strip()]
    if isinstance(one, ca.SX) and all(entry.is_symbolic() for entry in ca.vertsplit(ca.vec(one))):
        return [str(entry) for entry in ca.vertsplit(ca.vec(one))]
    raise UsageError(f"by: {one!r:.60}; expected the name of a parameter, a start such as 'x(0)', or a number such as 'u.duty'")


def _unknown_direction(name: str, known: Sequence[str]) -> str:
    listed = ", ".join(known[:12]) + (", ..." if len(known) > 12 else "")
    start = start_name(name)
    hint = f". Did you mean '{start}'?" if start in known else did_you_mean(name, known)
    return (
        f"by: '{name}' is not a parameter, start or number of a signal of this model; there are {listed or 'none'}{hint or '.'} "
        "A constant of the model file becomes a parameter by a symbol: k = ca.SX.sym('k'), and parameters={k: 2.0} in the model"
    )


def read_times(at: Any, t_end: float) -> np.ndarray:
    """The times (K,) that are asked for, increasing; left out the end of the run.

    Raises:
        UsageError: what is not a number, or outside the run.
    """
    try:
        times = np.atleast_1d(np.asarray(t_end if at is None else at, float)).ravel()
    except (TypeError, ValueError):
        raise UsageError(f"at = {at!r}; expected a time, or a list of times") from None
    wrong = times[~((times >= 0) & (times <= t_end))]
    if wrong.size or not times.size:
        raise UsageError(f"at = {wrong[0] if wrong.size else at}: expected times from 0 to t_end = {t_end:g}")
    if (np.diff(times) <= 0).any():
        raise UsageError("at: expected increasing times")
    return times
