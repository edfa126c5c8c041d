"""Signals that a Python function or an expression of time gives, with the edges that the user declares."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np

from nsmodel._utils import cached_per_object, checks_keywords, short_repr
from nsmodel.errors import ModelError
from nsmodel.modeling.signals.base import (
    SLOPE_ROUND_UP,
    Signal,
    SignalJump,
    Within,
    check_increasing,
    just_after,
    just_before,
    read_numbers,
)

# A change at an edge below this part of the values is none: a function that bends there changes by rounding.
JUMP_TOLERANCE = 1e-9

Edges = Sequence[float] | np.ndarray | Callable[[float, float], Sequence[float]]


@dataclass(frozen=True, eq=False)
class EdgeDeclaredSignal(Signal):
    """A function that is right-continuous at its edges; its left limit there is its value a rounding before.

    Where its edges are ``rounded``, as in another unit of time, both limits are its values beside them.
    """

    given: Edges  # What ``edges=`` is.
    label: str
    rounded: bool = field(default=False, kw_only=True)

    def edges(self, t_end: float) -> np.ndarray:
        """Those declared."""
        given = self.given(0.0, t_end) if callable(self.given) else self.given
        found = read_numbers(self.label, "edges", given, 1)
        check_increasing(self.label, "edges", found, strictly=True)
        return found[(found >= 0) & (found <= t_end)]

    def after(self, t: np.ndarray) -> np.ndarray:
        """The value of the function just after each time."""
        return self._values(np.where(self._at_edge(t), just_after(t), t) if self.rounded else t)

    def before(self, t: np.ndarray) -> np.ndarray:
        """The value, just before an edge where there is one."""
        return self._values(np.where(self._at_edge(t), just_before(t) if self.rounded else np.nextafter(t, -np.inf), t))

    def _at_edge(self, t: np.ndarray) -> np.ndarray:
        return np.isin(t, self.edges(float(t.max(initial=0.0))))

    def _edges_in_time(self, tau: float) -> Edges:
        given = self.given
        if callable(given):
            return lambda begin, end: [tau * edge for edge in given(begin / tau, end / tau)]
        return tau * np.asarray(given, float)

    def jump(self, t_end: float) -> SignalJump | None:
        """The largest at the edges, beyond what a function that bends there changes by in a rounding."""
        found = super().jump(t_end)
        seen = found is not None and np.abs(found.after - found.before).max() > JUMP_TOLERANCE * np.abs([*found[1:]]).max()
        return found if seen else None

    def _values(self, t: np.ndarray) -> np.ndarray:
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class Function(EdgeDeclaredSignal):
    """A signal by a Python function, see `signal`."""

    function: Callable[[Any], Any]
    width: int

    __repr__ = short_repr

    @property
    def size(self) -> int:
        """That of its value at t = 0."""
        return self.width

    def in_time(self, tau: float) -> Function:
        """The function of its own time."""
        own = self.function
        return replace(self, given=self._edges_in_time(tau), function=lambda t: own(t / tau), rounded=True)

    def _values(self, t: np.ndarray) -> np.ndarray:
        found = np.empty((t.size, self.width))
        for row, time in zip(found, t, strict=True):
            value = function_values(self.function, float(time), self.label)
            if value.size != self.width:
                raise ModelError(f"{self.label}: {value.size} values at t = {time:.10g}, but {self.width} at t = 0")
            row[:] = value
        return found


@dataclass(frozen=True, eq=False)
class Expression(EdgeDeclaredSignal):
    """Expressions (nu,) of the model's time."""

    time: ca.SX
    column: ca.SX

    __repr__ = short_repr

    @property
    def size(self) -> int:
        """The number of entries of the expression."""
        return self.column.numel()

    def in_time(self, tau: float) -> Expression:
        """With its own time in the expressions."""
        column = ca.substitute(self.column, self.time, self.time / tau)
        return replace(self, given=self._edges_in_time(tau), column=column, rounded=True)

    def within(self, t_end: float) -> Within | None:
        """Bounds by interval arithmetic, and those of its derivative where it is continuous."""
        from nsmodel.proof import extremum, interval_bounds

        ends = np.zeros(1), np.full(1, t_end)
        columns = ca.vertsplit(self.column)
        low, high = ([sign * extremum.supremum(sign * one, self.time, *ends).bound for one in columns] for sign in (-1, 1))
        if not (t_end > 0 and np.isfinite([*low, *high]).all()):
            return None
        rates = ca.vertsplit(ca.jacobian(self.column, self.time))
        fastest = (
            np.array([max(extremum.supremum(s * one, self.time, *ends).bound for s in (-1, 1)) for one in rates]) * SLOPE_ROUND_UP
        )
        smooth = interval_bounds.is_continuous(self.column, self.time, *ends) and bool(np.isfinite(fastest).all())
        return Within(np.array(low), np.array(high), np.maximum(fastest, 0.0) if smooth else None, self.after(np.zeros(1))[0])

    def jump(self, t_end: float) -> SignalJump | None:
        """One that is proved to be a jump."""
        from nsmodel.proof.jumps import prove_jump

        found = prove_jump(self.column, self.time, np.zeros(1), np.full(1, t_end)) if t_end > 0 else None
        if found is None:
            return None
        sides = self._values(np.append(just_before(found.at), just_after(found.at)))
        return SignalJump(float(found.at[0]), *sides)

    def _values(self, t: np.ndarray) -> np.ndarray:
        return np.array(_compile_expression(self).map(t.size)(t[None])).T if t.size else np.zeros((0, self.size))


@cached_per_object
def _compile_expression(expression: Expression) -> ca.Function:
    return ca.Function("signal", [expression.time], [expression.column])


def function_values(function: Callable[[Any], Any], t: float, label: str) -> np.ndarray:
    """The values (nu,) of a user's function; ModelError where it fails, or gives no finite numbers."""
    try:
        value = function(t)
    except Exception as error:
        raise ModelError(f"{label}: it raised {type(error).__name__} at t = {t:.10g}: {error}") from error
    return read_numbers(label, f"its value at t = {t:.10g}", value, 0, 1).ravel()


@checks_keywords
def signal(function: Any, *, edges: Edges = (), name: str | None = None) -> Signal:
    """A signal that a Python function t -> number or (nu,) gives, or an expression of the model's time.

    Args:
        function: right-continuous; a step sees it at both ends.
        edges: the times at which it jumps or bends, or a function (t_0, t_1) -> these: steps end there. A jump that is not
            declared is smeared over a step.
        name: of the function in messages and in files, which cannot hold it; left out: its own.

    Raises:
        ModelError: a value that is not a finite number; edges out of order.
    """
    label = f"signal '{name or getattr(function, '__name__', 'of an expression')}'"
    given = edges if callable(edges) else read_numbers(label, "edges", edges, 1)
    if isinstance(function, ca.SX):
        return expression_signal(function, given, label)
    if not callable(function):
        raise ModelError(f"{label}: {type(function).__name__} is neither a function of t nor an expression of it")
    return Function(given, label, function, function_values(function, 0.0, label).size)


def expression_signal(column: ca.SX, edges: Edges, label: str) -> Expression:
    """The signal of an expression of time; ModelError where it holds other symbols."""
    column = ca.densify(ca.vec(column))
    symbols = ca.symvar(column)
    if len(symbols) > 1:
        raise ModelError(f"{label}: {column} holds {', '.join(s.name() for s in symbols)}; expected time alone")
    return Expression(edges, label, symbols[0] if symbols else ca.SX.sym("t"), column)
