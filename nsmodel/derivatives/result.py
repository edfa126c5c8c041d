"""What differentiating a run gives: values and derivatives by name, the switches on the way, margins, an error estimate.

A run as a function of CasADi, with its exact Jacobian: for optimisers that call it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import casadi as ca
import numpy as np

from nsmodel._utils import display, escape_invisible, html_repr, import_extra, short_repr
from nsmodel.errors import UsageError
from nsmodel.files.storage import write_csv
from nsmodel.simulation.trajectory import Trajectory

MAX_SWITCHES = 12  # Switches that a summary names.


class Differentiable(Protocol):
    """A model with what it is differentiated by, which can be differentiated again."""

    @cached_property
    def start(self) -> np.ndarray:
        """The numbers ``by`` (q,)."""
        ...

    def at_values(self, numbers: np.ndarray | None = None) -> Sensitivity:
        """The derivatives at other numbers (q,)."""
        ...

    def at_times(self, t: np.ndarray) -> Sensitivity:
        """The derivatives at other times."""
        ...

    def refined(self) -> Sensitivity:
        """The same derivatives, found with another error."""
        ...


@dataclass(frozen=True)
class Switch:
    """What a run passes where its mode changes, and how the time of it moves.

    Attributes:
        t: its time.
        kind: "switch" (a condition becomes 0), "known time" (an edge, a tick), "impulse", "start".
        name: the row or input.
        dt: its derivatives (q,), by the names of ``by``.
        transversality: the rate of the condition along the flow; inf of a known time.
    """

    t: float
    kind: str
    name: str
    dt: np.ndarray
    transversality: float

    __repr__ = short_repr


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Derivatives of a run at times; see `sensitivity`.

    Attributes:
        t: (K,) the times.
        outputs: names of the r quantities; by: names of the q numbers that they are differentiated by.
        value: (K, r); jacobian: (K, r, q). At an event both are those after it.
        before: (K, r, q) just before each time; other than ``jacobian`` where ``t`` is on an event.
        switches: what the run passes up to the last time, in order.
        margins: {"transversality": the least rate of a condition at its switch, beside its size over the length of the piece
            before it; "graze": the least value at which a condition turns back before a switch, beside its largest, to about a
            percent; "at": the least distance of ``t`` to a switch whose time moves; "growth": the largest entry of S, each
            state and number in its own size}.
        warnings: what is one-sided, nearly grazing, or lost in rounding.
        run: the trajectory.
        method: "event-driven", or "differences".
        source: what makes the same derivatives at other numbers and times.
    """

    t: np.ndarray
    outputs: tuple[str, ...]
    by: tuple[str, ...]
    value: np.ndarray
    jacobian: np.ndarray
    before: np.ndarray
    switches: tuple[Switch, ...]
    margins: Mapping[str, float]
    warnings: tuple[str, ...]
    run: Trajectory
    method: str
    source: Differentiable = field(repr=False)

    _repr_html_ = html_repr("sensitivity_html")

    def of(self, output: str, by: str | None = None) -> np.ndarray:
        """The derivatives of one ``output`` (K, q), or of it ``by`` one number (K,).

        Raises:
            UsageError: a name that is none.
        """
        rows = self.jacobian[:, _place(output, self.outputs, "output")]
        return rows if by is None else rows[:, _place(by, self.by, "by")]

    @cached_property
    def error(self) -> np.ndarray:
        """An estimate of the error of ``jacobian`` (K, r, q), from further runs: at rtol/100, or of twice the width."""
        return np.abs(self.jacobian - self.source.refined().jacobian)

    def gradient(self, w: Any) -> np.ndarray:
        """Return w'J (q,), the derivatives of the sum of w times the outputs.

        Args:
            w: (K, r); or (r,), of the outputs at the last time.

        Raises:
            UsageError: another shape.
        """
        weights, shape = np.asarray(w, float), self.value.shape
        if weights.shape == shape[1:]:
            return weights @ self.jacobian[-1]
        if weights.shape != shape:
            raise UsageError(f"w has shape {weights.shape}; expected {shape}, or {shape[1:]} for the last time")
        return np.einsum("kr,krq->q", weights, self.jacobian)

    def as_function(self, name: str = "run") -> ca.Callback:
        """Return a CasADi function ``name`` of the numbers ``by`` (q,), with exact Jacobian: all outputs (K r,), time by time.

        Each call is a run. IPOPT takes it with ``hessian_approximation="limited-memory"``: there are no second derivatives.
        """
        return RunFunction(name, self.source)

    def over_time(self, points: int = 400) -> Sensitivity:
        """Return the same at so many ``points`` of time, from 0 to the last one."""
        return self.source.at_times(np.linspace(0.0, float(self.t[-1]), points))

    def plot(self, ax: Any = None, points: int = 400) -> Any:
        """Draw the derivatives at ``points`` of time on ``ax``, each divided by its largest, with the switches marked."""
        return display("sensitivity", self.over_time(points), ax=ax)

    def to_csv(self, path: str | Path) -> None:
        """Write to ``path`` t, the outputs, and ``d OUTPUT/d NAME`` a column each."""
        write_csv(path, self._columns())

    def _columns(self) -> dict[str, np.ndarray]:
        found = {"t": self.t} | {name: self.value[:, i] for i, name in enumerate(self.outputs)}
        pairs = [(i, j) for i in range(len(self.outputs)) for j in range(len(self.by))]
        return found | {f"d {self.outputs[i]}/d {self.by[j]}": self.jacobian[:, i, j] for i, j in pairs}

    def to_xarray(self) -> Any:
        """Return an ``xarray.Dataset``: ``value``, ``jacobian`` along ``time``, ``output`` and ``by``; ``dt`` along ``switch``.

        MissingExtraError where xarray is not installed.
        """
        xarray = import_extra("xarray")
        moved = np.array([switch.dt for switch in self.switches]).reshape(len(self.switches), len(self.by))
        return xarray.Dataset(
            {
                "value": (("time", "output"), self.value),
                "jacobian": (("time", "output", "by"), self.jacobian),
                "dt": (("switch", "by"), moved),
            },
            {
                "time": self.t, "output": list(self.outputs), "by": list(self.by),
                "t_switch": ("switch", [switch.t for switch in self.switches]),
                "switch_name": ("switch", [switch.name for switch in self.switches]),
            },
            {"title": self.run.title, "method": self.method},
        )  # fmt: skip

    def document(self) -> dict[str, Any]:
        """Return all of it as JSON can hold it, but for the run."""
        switches = [
            {"t": one.t, "kind": one.kind, "name": one.name, "dt": one.dt.tolist(), "transversality": one.transversality}
            for one in self.switches
        ]
        return {
            "title": self.run.title, "method": self.method, "t": self.t.tolist(), "outputs": list(self.outputs),
            "by": list(self.by), "value": self.value.tolist(), "jacobian": self.jacobian.tolist(), "switches": switches,
            "margins": dict(self.margins), "warnings": list(self.warnings),
        }  # fmt: skip

    def summary_text(self) -> str:
        """Return the last time's derivatives and the switches as tables."""
        lines = [f"{self.run.title}: derivatives at t = {self.t[-1]:.6g} ({self.method})", ""]
        rows = [["", "value", *(f"by {name}" for name in self.by)]]
        for i, name in enumerate(self.outputs):
            rows.append([name, *(f"{v:.8g}" for v in (self.value[-1, i], *self.jacobian[-1, i]))])
        lines += _table_lines(rows)
        if self.switches:
            listed = self.switches[:MAX_SWITCHES]
            rows = [["switch", "t", *(f"dt/d {name}" for name in self.by)]]
            rows += [[one.name, f"{one.t:.8g}", *(f"{v:.6g}" for v in one.dt)] for one in listed]
            lines += ["", *_table_lines(rows)]
            if len(self.switches) > len(listed):
                lines.append(f"... {len(self.switches)} in all")
        return escape_invisible("\n".join([*lines, *(f"warning: {text}" for text in self.warnings)]))


def _place(name: str, known: Sequence[str], what: str) -> int:
    if name not in known:
        raise UsageError(f"{what}: '{name}' is none of {', '.join(known)}")
    return list(known).index(name)


def _table_lines(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return ["  ".join([row[0].ljust(widths[0]), *(v.rjust(w) for v, w in zip(row[1:], widths[1:], strict=True))]) for row in rows]


class _LastRun:
    """The run at the numbers that were asked for last: its values and its Jacobian are asked for one after the other."""

    def __init__(self, source: Differentiable) -> None:
        self._source, self._found = source, source.at_values()
        self._numbers = source.start

    def at(self, numbers: Any) -> Sensitivity:
        """The derivatives there."""
        values = np.array(numbers, float).ravel()
        if (values != self._numbers).any():
            self._numbers, self._found = values, self._source.at_values(values)
        return self._found


class _RunCallback(ca.Callback):
    """What is ``of`` a run, a dense matrix, as a function of dense columns of these sizes, the first of which are its numbers."""

    def __init__(
        self, name: str, run: _LastRun, inputs: Sequence[int], shape: tuple[int, int], of: Callable[[Sensitivity], np.ndarray],
        opts: Mapping[str, Any],
    ) -> None:  # fmt: skip
        ca.Callback.__init__(self)
        self._run, self._inputs, self._shape, self._of = run, inputs, shape, of
        self.construct(name, dict(opts))

    def get_n_in(self) -> int:
        """The number of columns."""
        return len(self._inputs)

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """A dense column."""
        return ca.Sparsity.dense(self._inputs[i], 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """A dense matrix."""
        del i
        return ca.Sparsity.dense(*self._shape)

    def eval(self, arg: Any) -> list[Any]:
        """The matrix of the run at these numbers."""
        return [self._of(self._run.at(arg[0])).reshape(self._shape)]


class RunFunction(_RunCallback):
    """The outputs at all times (K r,) as a function of the numbers (q,); see `Sensitivity.as_function`."""

    def __init__(self, name: str, source: Differentiable) -> None:
        run = _LastRun(source)
        self._sizes = source.start.size, run.at(source.start).value.size
        self._jacobians: list[ca.Callback] = []  # CasADi holds no reference to them.
        super().__init__(name, run, self._sizes[:1], (self._sizes[1], 1), lambda found: found.value, {})

    def has_jacobian(self) -> bool:
        """True: the Jacobian is exact."""
        return True

    def get_jacobian(self, name: str, inames: list[str], onames: list[str], opts: dict[str, Any]) -> ca.Callback:  # pyrefly: ignore[bad-override]
        """The Jacobian of the run at the same numbers."""
        del inames, onames
        own = _RunCallback(name, self._run, self._sizes, self._sizes[::-1], lambda found: found.jacobian, opts)
        self._jacobians.append(own)
        return own
