"""What a signal is: right-continuous, smooth between its edges, where it jumps, and its kinks, where it bends.

What is known of a signal: between which values it stays, how fast it moves at most, and where it jumps.

Bounds of signals as a user gives them.

Signals whose numbers are expressions of a model's parameters, until these have values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Never, Self

import casadi as ca
import numpy as np

from nsmodel._utils import EPS, checks_keywords, describe_shortly, short_repr
from nsmodel.errors import ModelError, UsageError
from nsmodel.modeling.pickling import Picklable


@dataclass(frozen=True, eq=False)
class Within(Picklable):
    """What `within` makes: bounds of an input, each a number for all of its values, or one for each (nu,).

    Attributes:
        low, high: between which its values stay.
        rate: of which its slope is at most; None: not known, it may jump.
        start: its values at t = 0; None: not known.
    """

    low: np.ndarray
    high: np.ndarray
    rate: np.ndarray | None
    start: np.ndarray | None

    __repr__ = short_repr

    @property
    def sizes(self) -> set[int]:
        """The numbers of values that are given."""
        given = (getattr(self, end) for end in SizedBounds._fields)
        return {part.size for part in given if part is not None and part.ndim}

    def of_size(self, size: int) -> SizedBounds:
        """As (size,) of each."""
        rate, start = (missing if part is None else part for part, missing in ((self.rate, np.inf), (self.start, np.nan)))
        return SizedBounds(*(np.broadcast_to(np.asarray(part, float), (size,)) for part in (self.low, self.high, rate, start)))


class SizedBounds(NamedTuple):
    """Bounds of each of the values of an input (nu,): a rate that is not known is inf, a start NaN."""

    low: np.ndarray
    high: np.ndarray
    rate: np.ndarray
    start: np.ndarray


class SignalJump(NamedTuple):
    """u(t-) and u(t+), (nu,) each."""

    t: float
    before: np.ndarray
    after: np.ndarray


# Times that are nearer than this part of the larger are one: each is a product with a period and a few sums.
NEAR_TOLERANCE = 16 * EPS
SLOPE_ROUND_UP = 1 + 16 * EPS  # More than a quotient and a few sums lose.


class Signal(Picklable):
    """A known function u(t) of ``size`` values; a step from a to b sees u(a+) at its begin and u(b-) at its end."""

    @property
    def size(self) -> int:
        """The number of values."""
        return 1

    @property
    def flat(self) -> bool:
        """Whether it is constant between its edges."""
        return False

    @property
    def moving(self) -> int:
        """The most edges between two of its points that blocks place."""
        return 0

    @property
    def values_taken(self) -> int | None:
        """How many values it takes at most; None: any."""
        return None

    @property
    def count(self) -> int | None:
        """The number of steps that it is for; None: any."""
        return None

    @property
    def jump_steps(self) -> np.ndarray:
        """The numbers of the steps that begin with a jump, of a signal that is for so many steps."""
        return np.zeros(0, int)

    def holding(self, kept: Mapping[str, np.ndarray]) -> Signal:
        """The signal with what blocks of a model hold now: ``kept``, by name."""
        return self

    def in_time(self, tau: float) -> Signal:
        """The signal where times are tau times as large: u(t / tau)."""
        raise NotImplementedError

    def check_valid(self, label: str, t_end: float) -> None:
        """Raise ModelError, naming the input ``label``, where it is no such signal up to ``t_end``."""

    def edges(self, t_end: float) -> np.ndarray:
        """The times up to ``t_end`` at which it jumps, increasing."""
        return np.zeros(0)

    def kinks(self, t_end: float) -> np.ndarray:
        """The times up to ``t_end`` at which it bends."""
        return np.zeros(0)

    def after(self, t: np.ndarray) -> np.ndarray:
        """u(t+) at times (K,): (K, size)."""
        raise NotImplementedError

    def before(self, t: np.ndarray) -> np.ndarray:
        """u(t-) at times (K,): (K, size)."""
        raise NotImplementedError

    @property
    def degree(self) -> int | None:
        """Of the polynomials of time that it is between its ``joints``; None where it is none."""
        return 0 if self.flat else None

    def joints(self, t_end: float) -> np.ndarray:
        """The times up to ``t_end`` at which one polynomial follows another."""
        return np.union1d(self.edges(t_end), self.kinks(t_end))

    def derivatives(self, t: float) -> np.ndarray:
        """(degree + 1, size): u, u', ... just after t."""
        return self.after(np.array([t]))

    @property
    def numbers(self) -> dict[str, float]:
        """What runs can be differentiated by, as it is written behind the name of the input: ``.duty``, ``[3]``, ``.t[3]``."""
        return {}

    def with_number(self, number: str, value: Any) -> Signal:
        """The signal with ``value`` for the one of these that ``number`` names."""
        raise NotImplementedError

    @property
    def expressions(self) -> dict[str, Any]:
        """Those of its numbers, by the same names, that are expressions: of parameters of the model that reads it."""
        return {}

    @property
    def parameters(self) -> tuple[str, ...]:
        """The parameters whose values it needs to be a function of time."""
        return ()

    def wrong_number(self) -> tuple[str, str] | None:
        """The first number that no such signal has, and in words what it is and what is expected; None where all are right."""

    def with_values(self, symbols: ca.SX, values: ca.SX) -> Signal:
        """The signal with ``values`` in place of the ``symbols`` of parameters; UsageError where a number is then a wrong one."""
        return self

    def joint_slopes(self, t: float) -> dict[str, float]:
        """The derivatives of the time of the joint at t by those of these that move it."""
        return {}

    def derivative_slopes(self, t: float) -> dict[str, np.ndarray]:
        """Those of `derivatives` at t by those of these that act then, (degree + 1, size) each, of the polynomial after t."""
        raise NotImplementedError

    def within(self, t_end: float) -> Within | None:
        """Bounds of its values up to ``t_end``, with a rate where it has no jump there; None where they are not known."""
        return None

    def jump(self, t_end: float) -> SignalJump | None:
        """The largest of its jumps after 0 and before ``t_end``; None where none is known."""
        at = self.edges(t_end)
        at = at[(at > 0) & (at < just_before(np.array(t_end)))]
        before, after = self.before(at), self.after(at)
        size = np.abs(after - before).max(axis=1, initial=0.0)
        k = int(size.argmax()) if size.size else -1
        return SignalJump(float(at[k]), before[k], after[k]) if k >= 0 and size[k] > 0 else None

    def limits(self, t: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
        """u(a+) and u(b-) of the steps between times t (K + 1,), the first of which has this number: (K, size) each."""
        return self.after(t[:-1]), self.before(t[1:])


@dataclass(frozen=True, eq=False)
class ConstantSignal(Signal):
    """The same values (nu,) for ever."""

    values: np.ndarray

    __repr__ = short_repr

    @property
    def size(self) -> int:
        """The number of values given."""
        return self.values.size

    @property
    def flat(self) -> bool:
        """True: the signal never changes."""
        return True

    @property
    def values_taken(self) -> int | None:
        """One value, for all times."""
        return 1

    def in_time(self, tau: float) -> Self:
        """The same signal: it does not depend on time."""
        return self

    def after(self, t: np.ndarray) -> np.ndarray:
        """The values, at each of the times."""
        return np.tile(self.values, (t.size, 1))

    before = after

    @property
    def numbers(self) -> dict[str, float]:
        """The values, by their entries."""
        return {"": self.values[0]} if self.size == 1 else {f"[{i}]": v for i, v in enumerate(self.values.tolist())}

    def with_number(self, number: str, value: float) -> ConstantSignal:
        """With another value."""
        values = self.values.copy()
        values[[*self.numbers].index(number)] = value
        return replace(self, values=values)

    def derivative_slopes(self, t: float) -> dict[str, np.ndarray]:
        """1 for each value."""
        return {number: row[None] for number, row in zip(self.numbers, np.eye(self.size), strict=True)}

    def within(self, t_end: float) -> Within | None:
        """Bounds that are the values."""
        return constant_bounds(self.values)


def constant_bounds(values: np.ndarray) -> Within:
    """Bounds of a signal that does not move."""
    return Within(values, values, np.zeros(values.size), values)


@dataclass(frozen=True, eq=False)
class ParametricSignal(Signal):
    """A signal whose numbers are expressions of a model's parameters: `with_values` makes it a signal with numbers.

    Attributes:
        label: what messages call it, such as "input 'u'".
        written: the signal as it is written, with expressions for these numbers: what they do not change is asked of it.
    """

    label: str
    written: Signal

    def __repr__(self) -> str:
        """Return the signal as it is written."""
        return repr(self.written)

    @property
    def size(self) -> int:
        """The number of values, which parameters do not change."""
        return self.written.size

    @property
    def flat(self) -> bool:
        """Whether it is constant between its edges, wherever these are."""
        return self.written.flat

    @property
    def values_taken(self) -> int | None:
        """How many values it takes at most, whatever they are."""
        return self.written.values_taken

    @property
    def degree(self) -> int | None:
        """Of the polynomials between its joints, wherever these are."""
        return self.written.degree

    @property
    def numbers(self) -> dict[str, float]:
        """Those that are numbers: the others follow the parameters."""
        return {name: value for name, value in self.written.numbers.items() if name not in self.written.expressions}

    @property
    def parameters(self) -> tuple[str, ...]:
        """The parameters that its numbers are expressions of."""
        return tuple(symbol.name() for symbol in ca.symvar(ca.vertcat(*self.written.expressions.values())))

    def in_time(self, tau: float) -> ParametricSignal:
        """The signal where times are tau times as large, of the same parameters."""
        return replace(self, written=self.written.in_time(tau))

    def with_number(self, number: str, value: Any) -> ParametricSignal:
        """The signal with another value of a number that is not an expression."""
        return replace(self, written=self.written.with_number(number, value))

    def with_values(self, symbols: ca.SX, values: ca.SX) -> Signal:
        """The signal with values in place of these parameters: one with numbers where none is left."""
        found = self.written
        for number, expression in self.written.expressions.items():
            put = ca.substitute(expression, symbols, values)
            found = found.with_number(number, float(put) if put.is_constant() else put)
        if found.expressions:
            return replace(self, written=found)
        if (wrong := found.wrong_number()) is not None:
            number, why = wrong
            own = self.written.expressions[number]
            given = dict(zip(map(str, ca.vertsplit(symbols)), ca.vertsplit(values), strict=True))
            of = ", ".join(f"{name} = {describe_shortly(float(given[name]))}" for name in map(str, ca.symvar(own)))
            raise UsageError(f"{self.label}: {why}; it is {describe_shortly(own)}" + (f" with {of}" if of else ""))
        return found

    def number_slopes(self, symbols: ca.SX, values: np.ndarray, by: Sequence[int]) -> dict[str, np.ndarray]:
        """The derivatives (q,) of the numbers that are expressions by the entries ``by`` of all parameters, ``symbols``, at
        ``values`` of them.
        """
        own = self.written.expressions
        slopes = ca.jacobian(ca.vertcat(*own.values()), symbols[list(by)])
        rows = np.array(ca.Function("slopes", [symbols], [ca.densify(slopes)])(values)).reshape(len(own), len(by))
        return dict(zip(own, rows, strict=True))

    def within(self, t_end: float) -> Within | None:
        """Bounds that hold for all values of the parameters; None where its values move with them."""
        return self.written.within(t_end)

    def jump(self, t_end: float) -> SignalJump | None:
        """None: where it jumps is not known."""

    def check_valid(self, label: str, t_end: float) -> Never:
        """Refuse what needs numbers: as do the functions of time."""
        self._need_numbers()

    def edges(self, t_end: float) -> Never:
        """Refuse: where it jumps is not known."""
        self._need_numbers()

    def kinks(self, t_end: float) -> Never:
        """Refuse: where it bends is not known."""
        self._need_numbers()

    def after(self, t: np.ndarray) -> Never:
        """Refuse: what it is at a time is not known."""
        self._need_numbers()

    before = after

    def _need_numbers(self) -> Never:
        number, expression = next(iter(self.written.expressions.items()))
        raise UsageError(
            f"{self.label}: its {number[1:]} is {describe_shortly(expression)}: give the parameters {', '.join(self.parameters)} "
            "their values first, model.bind({...})"
        )


# Of a signal or a block in a run: all of its times are kept, some 8 numbers each, 3 GB; more are refused.
MAX_PERIODS = 50_000_000


def period_numbers(first: float, last: float, period: float) -> np.ndarray:
    """The numbers of periods from ``first`` to ``last``; UsageError where a run has too many of them."""
    if not last - first <= MAX_PERIODS:
        raise UsageError(
            f"t_end: up to t = {last * period:.3g} there are {last - first:.3g} periods of {period:g}, whose times are made"
            f" before the run begins (an event-driven one asks for twice its time); at most {MAX_PERIODS:,}"
        )
    return np.arange(first, last + 1)


def just_after(t: np.ndarray) -> np.ndarray:
    """Times after which what is one with t lies."""
    return t + NEAR_TOLERANCE * np.abs(t)


def just_before(t: np.ndarray) -> np.ndarray:
    """Times before which what is one with t lies."""
    return t - NEAR_TOLERANCE * np.abs(t)


def check_choice(label: str, name: str, value: Any, known: Sequence[str]) -> str:
    """A word among those known; else ModelError."""
    if value not in known:
        raise ModelError(f"{label}: {name} = {value!r}; expected one of {', '.join(known)}")
    return value


def check_increasing(label: str, what: str, t: np.ndarray, *, strictly: bool) -> None:
    """Refuse times that are out of order."""
    wrong = np.diff(t) <= 0 if strictly else np.diff(t) < 0
    for i in np.flatnonzero(wrong)[:1]:
        raise ModelError(f"{label}: {what}[{i + 1}] = {t[i + 1]:.10g} is not after {what}[{i}] = {t[i]:.10g}; give them in order")


def read_numbers(label: str, what: str, value: Any, *dimensions: int) -> np.ndarray:
    """An array of finite numbers with one of these numbers of dimensions; else ModelError."""
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        raise ModelError(f"{label}: {what} = {value!r:.60}; expected numbers") from None
    if array.ndim not in dimensions:
        shapes = {0: "one number", 1: "a list (N,)", 2: "an array (N, nu)"}
        raise ModelError(f"{label}: {what} has the shape {array.shape}; expected {' or '.join(shapes[d] for d in dimensions)}")
    for at in np.argwhere(~np.isfinite(array))[:1]:
        where = f"[{', '.join(map(str, at))}]" if at.size else ""
        raise ModelError(f"{label}: {what}{where} = {array[tuple(at)]:g}; expected finite numbers")
    return array


@checks_keywords
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
