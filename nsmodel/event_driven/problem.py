"""A model in continuous time: what event-driven integration takes, one form for the classes.

Inputs of a model in continuous time: between known times each is a polynomial of time, and that is a state.

u' = u_1, u_1' = u_2, ..., u_d' = 0 has the polynomials of degree d as its solutions. These states stand behind all others, and
are set at known times to what the signals are after them; expressions of time stand where the inputs stood. So series, pieces,
steps of stretches, checkpoints and C know inputs as states that nothing else acts on.

Known times: at each a piece ends, and what is held is another after it.

The known times of a model, and what its signals are after each.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, ClassVar, NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import EPS, cached_per_object, cached_per_object_and_key
from nsmodel.errors import EmptyLawError, UsageError
from nsmodel.modeling.base import Model
from nsmodel.modeling.blocks import model_ticks
from nsmodel.modeling.expressions import derivatives
from nsmodel.modeling.laws import Law
from nsmodel.modeling.laws.base import LawEnds, find_invalid_row
from nsmodel.modeling.outputs import Quantity
from nsmodel.modeling.parts import Part
from nsmodel.modeling.signals.base import Signal, just_after
from nsmodel.modeling.signals.function import Expression
from nsmodel.modeling.signals.pwm import Pwm
from nsmodel.modeling.signals.schedule import merge_near_times
from nsmodel.modeling.variants import block_input_entries, initial_inputs
from nsmodel.proof.verdict import connected_components, not_none

TINY_SPEED = 1e-150  # Beside a size, that its derivatives are numbers where it is 0; its square is one.


BLOCK = "block"  # Begins the names of those parts of the equations that are what blocks set.


class NotEventDriven(UsageError):
    """A model that event-driven integration cannot take; says what of it."""


class SlipGrowth(NamedTuple):
    """Where block ``first`` (its first row) slips, f + g has factor(s) l in place of its l, s = |y|; factor(0) = 1."""

    first: int
    s: ca.SX
    factor: ca.SX


@dataclass(frozen=True)
class ContinuousProblem:
    """x' = f(t, x) + g(t, x, l),   y = h(t, x, l),   -y ∈ N_K(l),   x(0) = x0.

    Attributes:
        t, x, l, p: symbols; ``p``: parameters still symbolic.
        f, g: (n, 1), with the mass matrix divided out; g is what depends on l, and 0 without it where that can be told.
        h: (m, 1).
        law: K, made of boxes and curved sets.
        rows: the user's name of each row of l and y; names: of the states in x.
        x0: the start (n, 1).
        states: number of the first entries of x that are the model's states; of an oscillator the others are velocities.
        multipliers, outputs: l and y as the user declared them, expressions of t, x and l, where they differ; else None.
        declared: the names of these multipliers.
        ends: of the rows whose law moves, the set, expressions of t and x.
        records: further columns of a trajectory, expressions of t, x and l.
        growths: of the blocks whose l pushes with another force the faster they slip.
        held: number of the last entries of x that are inputs (see `driven`), set at known times; nothing acts on them.
        updates: what blocks that act after each step set next, expressions of t and x; updated: numbers of the entries of x that
            they set; updaters: the names of these blocks.
        impulses: whether the class's multipliers are the integrals of l over steps; l itself is then called reactions.
    """

    scheme: ClassVar[str] = "event-driven integration"
    t: ca.SX
    x: ca.SX
    l: ca.SX
    p: ca.SX
    f: ca.SX
    g: ca.SX
    h: ca.SX
    law: Law
    rows: tuple[str, ...]
    names: tuple[str, ...]
    x0: ca.SX
    states: int
    multipliers: ca.SX | None = None
    outputs: ca.SX | None = None
    declared: tuple[str, ...] = ()
    ends: tuple[LawEnds, ...] = ()
    records: Mapping[str, ca.SX] = field(default_factory=dict)
    growths: tuple[SlipGrowth, ...] = ()
    impulses: bool = False
    held: int = 0
    updates: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    updated: tuple[int, ...] = ()
    updaters: tuple[str, ...] = ()

    @cached_property
    def block_parts(self) -> dict[str, list[int]]:
        """{name of a block that acts after each step, as a part of the equations: its rows of ``updates``}."""
        names = [f"{BLOCK} '{name}'" for name in self.updaters]
        return {name: [k for k, own in enumerate(names) if own == name] for name in dict.fromkeys(names)}

    @cached_property
    def block_reads(self) -> list[list[int]]:
        """Of each of these blocks the entries of x that are held and that no such block sets: inputs, and what ticks set."""
        held = [i for i in range(self.x.numel() - self.held, self.x.numel()) if i not in self.updated]
        return [[i for i in held if ca.depends_on(self.updates[rows], self.x[i])] for rows in self.block_parts.values()]

    @property
    def sliding_law_names(self) -> tuple[str, ...]:
        """The blocks whose l, or what stands for it, moves while they slip: by the names of their laws, or of their rows."""
        curved = tuple(block.label for _, block in self.law.parts() if not block.separable)
        return curved + tuple(self.rows[growth.first] for growth in self.growths)

    @property
    def slopes(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """g_l, h_l, and h_x by the states that can be moved."""
        C, free = derivatives(self.h, self.x), self.x.numel() - self.held
        if self.held:
            C = ca.horzcat(C[:, :free], ca.SX(C.shape[0], self.held))
        return derivatives(self.g, self.l), derivatives(self.h, self.l), C

    @cached_property
    def row_groups(self) -> list[list[int]]:
        """Of each row those that it is tied to: by l in y, or in y', of one or the other, or through further rows."""
        B, D, C = (ca.DM(matrix.sparsity(), 1) for matrix in self.slopes)
        tied = np.array(ca.densify(D + C @ B)).reshape(D.shape) != 0
        return [group for _, group in sorted((i, group) for group in connected_components(tied | tied.T) for i in group)]

    @property
    def coupled(self) -> np.ndarray:
        """Which pairs of multipliers are coupled (m, m): g and h are affine in those together of which no two are."""
        B, D, _ = self.slopes
        by_l, m = ca.vertcat(B, D), self.l.numel()
        if not m or not ca.depends_on(by_l, self.l):
            return np.zeros((m, m), bool)
        found = np.array([ca.which_depends(by_l[:, i], self.l, 1, False) for i in range(m)], bool)
        return found | found.T

    @property
    def rate(self) -> ca.SX:
        """F + g as expressions of t, x and l, with the factors of `growths` in."""
        whole, l = self.f + self.g, self.l
        starts = {rows.start: rows for rows, _ in self.law.parts()}
        for growth in self.growths:
            own = starts[growth.first]
            size = ca.sqrt(ca.sumsqr(self.h[own]) + TINY_SPEED**2)
            whole = ca.substitute(whole, l[own], ca.substitute(growth.factor, growth.s, size) * l[own])
        return whole

    def empty(self, t: float, x: Sequence[float], after: float) -> EmptyLawError | None:
        """That a law that moves is no set at t, or in a short time ``after``; None where each is one."""
        if not self.ends:
            return None
        known, here = ca.vertcat(self.t, self.x), np.array([t, *x])
        rate = ca.Function("rate", [known], [ca.vertcat(1, self.f)])  # of t and inputs, which alone move the ends
        ahead = here + after * np.array(rate(here)).ravel()
        for values in (here, ahead):
            if (found := find_invalid_row(self.ends, known, values, float(values[0]))) is not None:
                return EmptyLawError(found.text, component=found.name)
        return None

    @property
    def columns(self) -> dict[str, ca.SX]:
        """The columns of a trajectory that are expressions of t, x and l: y, and those of the class."""
        return {"y": self.h if self.outputs is None else self.outputs, **self.records}


CONTINUOUS_PROBLEM = Part[Callable[[Any], ContinuousProblem]]("schemes.continuous_problem")


def with_input_states(problem: ContinuousProblem, model: Model, start: Sequence[float] | None = None) -> ContinuousProblem:
    """The problem with the inputs of its model as states, or as what they are as expressions of time.

    ``start``: what these states are at t = 0; left out it is computed, of a model with blocks one with numbers for parameters.

    Raises:
        NotEventDriven: a signal that is not a polynomial between known times, by name.
    """
    if not model.u.numel():
        return problem
    symbols, values, chain, rate, names = [], [], [], [], []
    u = dict(zip(model.input_names, ca.vertsplit(model.u), strict=True))
    for group, signal in model.inputs.items():
        entries = model.input_groups[group]
        symbols += [u[name] for name in entries]
        if isinstance(signal, Expression):
            values += ca.vertsplit(ca.substitute(signal.column, signal.time, problem.t))
            continue
        for name in entries:
            own = [ca.SX.sym(name + "'" * k) for k in range(signal_degree(group, signal) + 1)]
            values.append(own[0])
            chain += own
            rate += [*own[1:], ca.SX(0)]
            names += [symbol.name() for symbol in own]
    held = ca.vertcat(ca.SX(0, 1), *chain)
    updates = [block for block in model.blocks if block.period is None]
    put = (ca.vertcat(*symbols), ca.vertcat(*values))
    parts = {
        name: ca.substitute(part, *put)
        for name in ("f", "g", "h", "multipliers", "outputs")
        if (part := getattr(problem, name)) is not None and part.numel()
    }
    first = {str(symbol): problem.x.numel() + i for i, symbol in enumerate(chain)}
    if start is None:
        start = input_states(model, 0.0, None)
        if updates:  # Their first action is that of the mode at the start.
            before = not_none(model_ticks(model)).before(np.array(ca.DM(model.start)).ravel(), initial_inputs(model))
            for place in (place for block in updates for place in block.at):
                start[first[model.input_names[place]] - problem.x.numel()] = float(before[place])
    for block in updates:
        if ca.depends_on(block.next, getattr(model, "lam", ca.SX(0, 1))):
            raise NotEventDriven(f"block '{block.name}' reads multipliers after each step")
    f, g = (
        ca.vertcat(parts.get(name, getattr(problem, name)), more) for name, more in (("f", ca.vertcat(*rate)), ("g", 0 * held))
    )
    return replace(
        problem, **parts | {"f": f, "g": ca.densify(g)}, x=ca.vertcat(problem.x, held), held=held.numel(),
        names=(*problem.names, *names), x0=ca.vertcat(problem.x0, ca.DM(start)),
        ends=tuple(LawEnds(end.name, *ca.substitute([end.lower, end.upper], *([part] for part in put))) for end in problem.ends),
        records={name: ca.substitute(record, *put) for name, record in problem.records.items()},
        updates=ca.substitute(ca.vertcat(ca.SX(0, 1), *(block.next for block in updates)), *put),
        updated=tuple(first[model.input_names[place]] for block in updates for place in block.at),
        updaters=tuple(block.name for block in updates for _ in block.at),
    )  # fmt: skip


def signal_degree(group: str, signal: Any) -> int:
    """The degree of a signal between known times; NotEventDriven where it has none."""
    degree = signal.degree if isinstance(signal, Signal) else None
    if degree is None:
        raise NotEventDriven(f"input '{group}' is not a polynomial between known times ({type(signal).__name__.lower()})")
    return degree


def input_states(model: Model, t: float, x: Sequence[float] | None) -> list[float]:
    """What the states of the inputs are just after time t, where the state is x; at the start it is None."""
    ticks = model_ticks(model)
    if ticks is None:
        return _derivative_values(model.inputs, t)
    if x is None:
        u = initial_inputs(model)
    else:
        u = np.zeros(model.u.numel())
        u[ticks.at] = block_held_values(model, x)
        kept = ticks.kept(u)
        u = np.concatenate([signal.holding(kept).after(np.array([t]))[0] for signal in _plain_signals(model.inputs).values()])
        u = ticks.after(ticks.due_blocks(t), t, np.array(x[: ticks.states]), np.zeros(ticks.multipliers), u)
    kept = ticks.kept(u)
    return _derivative_values({name: s.holding(kept) for name, s in _plain_signals(model.inputs).items()}, t)


def block_held_values(model: Model, x: Sequence[float]) -> np.ndarray:
    """What blocks hold, of a state in continuous time, in the order in which they set it."""
    ticks, places = model_ticks(model), _input_places(model)
    return np.array([x[len(x) - places[None] + places[place]] for place in ([] if ticks is None else ticks.at.tolist())])


def block_set_entries(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """The entries of the inputs that blocks set, or whose edges they place, and their places among held states."""
    entries, places = block_input_entries(model), _input_places(model)
    return entries, np.array([places[entry] for entry in entries.tolist()], int)


def next_moving_edge(model: Model, t: float, x: Sequence[float]) -> float:
    """The first edge after t of PWMs whose duty blocks hold, in the periods of t."""
    ticks = model_ticks(model)
    if ticks is None:
        return math.inf
    u = np.zeros(model.u.numel())
    u[ticks.at] = block_held_values(model, x)
    kept = ticks.kept(u)
    pwms = [signal.holding(kept) for signal in _plain_signals(model.inputs).values() if signal.moving]
    found = [pwm.pulse(t) for pwm in pwms if isinstance(pwm, Pwm)]
    times = np.concatenate([np.zeros(0), *found])
    return float(times[times > just_after(np.array(t))].min(initial=math.inf))


def _plain_signals(inputs: Mapping[str, Any]) -> dict[str, Signal]:
    return {name: signal for name, signal in inputs.items() if isinstance(signal, Signal)}


@cached_per_object
def _input_places(model: Model) -> dict[int | None, int]:
    """Where the value of each entry of u stands among the states of the inputs; under None how many there are."""
    found: dict[int | None, int] = {}
    entry = at = 0
    for group, signal in model.inputs.items():
        for _ in model.input_groups[group]:
            if not isinstance(signal, Expression):
                found[entry] = at
                at += signal_degree(group, signal) + 1
            entry += 1
    return {**found, None: at}


def inputs_between_rows(problem: ContinuousProblem, model: Model) -> dict[str, Any]:
    """Of each scalar input what it is within a piece: a column of the pieces' states, or a quantity of t, as JSON can hold it."""
    found: dict[str, Any] = {}
    for group, signal in model.inputs.items():
        for k, name in enumerate(model.input_groups[group]):
            if isinstance(signal, Expression):
                found[name] = Quantity.made(ca.substitute(signal.column[k], signal.time, ca.SX.sym("t"))).text
            else:
                found[name] = problem.x.numel() - problem.held + problem.names[-problem.held :].index(name)
    return found


def _derivative_values(inputs: Mapping[str, Any], t: float) -> list[float]:
    """Of each value of each signal its derivatives, as the states of the inputs are."""
    signals = [signal for signal in inputs.values() if isinstance(signal, Signal) and not isinstance(signal, Expression)]
    return [v for signal in signals for column in np.asarray(signal.derivatives(t)).T.tolist() for v in column]


SAME_TIME = 4 * EPS  # Of a known time: an event that is as near is at it: both are rounded as what is added to a time.


@dataclass(frozen=True)
class SwitchTimes:
    """Times, increasing.

    ``data``: what the held states of the problem are just after one of them, of the state there; None where none is held.
    ``moving``: the first time after t that what is held places, of t and the state.
    """

    times: Sequence[float] = ()
    data: Callable[[float, list[float] | None], list[float]] | None = None
    moving: Callable[[float, list[float]], float] | None = None

    def next(self, t: float, x: list[float]) -> float:
        """The first of the times after t, where the state is x; infinite where there is none."""
        k = bisect_right(self.times, t)
        first = self.times[k] if k < len(self.times) else math.inf
        moved = math.inf if self.moving is None else self.moving(t, x)
        return moved if moved < first * (1 - SAME_TIME) else first

    def after(self, t: float, x: list[float]) -> list[float]:
        """The state x at t with what is held after it, where t is one of the times, or may be."""
        if self.data is None or (self.moving is None and self.next(np.nextafter(t, -math.inf), x) != t):
            return x
        held = self.data(t, x)
        return [*x[: len(x) - len(held)], *held]


def reaches_time(t: float, known: float) -> bool:
    """Whether t is at a known time, to rounding, or beyond."""
    return known < math.inf and t >= known * (1 - SAME_TIME)


AHEAD = 2.0  # Times of the run up to which times of signals are known: pieces are made beyond its end.


def switch_times_of(model: Model, t_end: float) -> SwitchTimes:
    """The known times of a model, and of the signals of a run also those beyond its end: pieces go beyond it."""
    if not model.inputs:
        return SwitchTimes(model.switch_times)
    moves = any(signal.moving for signal in model.inputs.values())
    data, moving = partial(input_states, model), partial(next_moving_edge, model) if moves else None
    return SwitchTimes(_times_of_signals(model, AHEAD * t_end), data, moving)


@cached_per_object_and_key(most=4)
def _times_of_signals(model: Model, ahead: float) -> tuple[float, ...]:
    joints = [signal.joints(ahead) for signal in model.inputs.values() if isinstance(signal, Signal)]
    ticks = [block.ticks(ahead) for block in model.blocks]
    return tuple(merge_near_times(np.concatenate([np.array(model.switch_times, float), *joints, *ticks])).tolist())


@cached_per_object_and_key(most=4)
def switch_table(model: Model, t_end: float) -> tuple[np.ndarray, np.ndarray]:
    """0 and the known times of a model after it (K,), and what is held after each (K, held)."""
    known = switch_times_of(model, t_end)
    times = [0.0, *(t for t in known.times if t > 0)]
    return np.array(times), np.array([[] if known.data is None else known.data(t, None) for t in times])
