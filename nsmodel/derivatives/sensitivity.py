"""Derivatives of an event-driven run by parameters, starts and numbers of signals: exact but for the run's own error.

The run is made first, as `simulate` makes it. Then its pieces are differentiated (`piece_tangents`), and what happens between
them (`run_tangents`). See docs/derivatives.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple, cast

import casadi as ca
import numpy as np

from nsmodel._utils import EPS, cached_per_object_and_key, checks_keywords
from nsmodel.codegen.event_driven_spec import TANGENT_SAME
from nsmodel.derivatives.known_times import KnownTimes
from nsmodel.derivatives.piece_tangents import PieceTangents
from nsmodel.derivatives.quantities import read_directions, read_times
from nsmodel.derivatives.result import Sensitivity, Switch
from nsmodel.derivatives.run_tangents import START, RunTangents, Stop, SwitchJump, SwitchJumps
from nsmodel.derivatives.tangent_equations import TRY_DIFFERENCES, TangentEquations
from nsmodel.errors import NsmodelError, StepError, UsageError
from nsmodel.event_driven.column_expressions import read_outputs
from nsmodel.event_driven.integrator import MIN_RTOL
from nsmodel.event_driven.problem import CONTINUOUS_PROBLEM, SAME_TIME, ContinuousProblem
from nsmodel.modeling.base import Model
from nsmodel.modeling.inputs import Signals
from nsmodel.modeling.parameters import Values
from nsmodel.modeling.variants import start_entries, with_inputs, with_start, with_start_parameters, with_symbols
from nsmodel.proof.verdict import not_none
from nsmodel.simulation.event_driven import symbolic_event_driven_problem
from nsmodel.simulation.options import METHODS, Options
from nsmodel.simulation.piece_sources import PieceBuffer
from nsmodel.simulation.run_data import multiplier_names
from nsmodel.simulation.simulate import bound_model, make_run
from nsmodel.simulation.trajectory import Trajectory

# LARGE_GROWTH: three digits are left.
LARGE_GROWTH = 1e-3  # Rounding in S, beside the sizes of what it is between: from here on it is warned of.
# NEARLY_GRAZING: S is 1e4 times as large behind it.
NEARLY_GRAZING = 1e-4  # The rate of a guard beside its largest value on the piece over its length, below which that is said.


@checks_keywords
def sensitivity(
    model: Model,
    *,
    by: Any,
    at: Any = None,
    outputs: Any = None,
    integrals: Mapping[str, Any] | None = None,
    rtol: float | None = None,
    atol: Any = None,
    parameters: Values | None = None,
    inputs: Signals | None = None,
    t_end: float | None = None,
    compiled: bool | str = "auto",
    method: str = "event-driven",
    step: float | None = None,
    width: float | None = None,
) -> Sensitivity:
    """Differentiate a run: exactly through all of its switches, but for the run's own error.

    Args:
        model: of a class that has event-driven runs; with ``method="differences"`` of any.
        by: what by, one name or symbol or several: a parameter (``"k"``), the start of a state (``"x(0)"``), a number of a signal
            (``"u.duty"``, ``"u.period"``, ``"u.phase"``, ``"u.low"``, ``"u.high"``; of a table ``"u[3]"``, ``"u.t[3]"``). The
            derivative by a start leaves all parameters as they are, and one by a parameter the starts that are among ``by``.
        at: times, increasing; left out the end of the run.
        outputs: names of states, multipliers and columns, or expressions of these; left out all states. Of differences, names.
        integrals: {name: expression}, further outputs: the integral of each from 0 on.
        rtol, atol: of the run, see `simulate`; rtol is 1e-8 where no step is given. Derivatives are as accurate.
        parameters, inputs, t_end, compiled: see `simulate`.
        method: "event-driven"; "differences" takes central differences of runs, for what has no event-driven run.
        step: of differences, the step of runs by time stepping.
        width: of differences, relative to each number; left out rtol^(1/3), or the root of step/t_end.

    Returns:
        values and derivatives, and the switches that the run passes with the derivatives of their times.

    Raises:
        UsageError: a name that is none; no event-driven run is possible, with the reason.
        StepError: the run fails; or it has no derivative, as where it touches a switch.
    """
    run: dict[str, Any] = {
        "rtol": rtol,
        "atol": atol,
        "parameters": parameters,
        "inputs": inputs,
        "t_end": t_end,
        "compiled": compiled,
    }
    tolerance: dict[str, Any] = {"rtol": DEFAULT_RTOL if rtol is None else rtol}
    what = Request(by, at, outputs, integrals)
    if method == DERIVATIVE_METHODS[1]:
        options = Options(**run, step=step) if step is not None else Options(**run | tolerance)
        return DifferencedModel(model, what, options, width).at_values()
    if method != DERIVATIVE_METHODS[0]:
        raise UsageError(f"method = {method!r}; expected one of {', '.join(DERIVATIVE_METHODS)}")
    for name, value in (("step", step), ("width", width)):
        if value is not None:
            raise UsageError(f"{name} is of method='differences'; leave it out, or take that method")
    return DifferentiatedModel(model, what, Options(method=METHODS[1], **run | tolerance)).at_values()


DERIVATIVE_METHODS = ("event-driven", "differences")
DEFAULT_RTOL = 1e-8  # Of a run that is differentiated, where rtol is left out: eight digits of S, differences of runs have five.


class Request(NamedTuple):
    """What a user asks to differentiate, and by what; see `sensitivity`."""

    by: Any
    at: Any
    outputs: Any
    integrals: Mapping[str, Any] | None


class _Movable:
    """A model whose numbers ``by`` can be set."""

    def __init__(self, model: Model, what: Request, options: Options) -> None:
        self.what, self.options = what, options
        self.model = with_inputs(model, options.inputs)
        self._check_class()
        self.by = read_directions(self.model, what.by)
        self.t_end = float(not_none(model.t_end if options.t_end is None else options.t_end))
        self.t = read_times(what.at, self.t_end)
        self.integrals = dict(what.integrals or {})
        self._bound = bound_model(self.model, options.parameters)
        self._made: _EquationsByValue | None = None

    def _check_class(self) -> None:
        """Refuse a class that has no such runs."""

    @cached_property
    def start(self) -> np.ndarray:
        """The numbers ``by`` (q,) as they are declared, or among the options."""
        places, bound = start_entries(self._bound), self._bound
        signals = {group: not_none(self.model.inputs[group]).numbers for group in {n.group for n in self.by.numbers}}
        found = {name: bound.bound_parameters[name] for name in self.by.parameters}
        found |= {name: float(getattr(bound, places[s][0])[places[s][1]]) for name, s in self.by.starts.items()}
        found |= {f"{n.group}{n.number}": signals[n.group][n.number] for n in self.by.numbers}
        return np.array([found[name] for name in self.by.names], float)

    def moved(self, numbers: np.ndarray | None) -> tuple[Model, Options]:
        """The model and the options of a run at other numbers (q,)."""
        if numbers is None:
            return self.model, replace(self.options, inputs=None)
        values = dict(zip(self.by.names, np.asarray(numbers, float).tolist(), strict=True))
        model = with_start(self.model, {s: values[name] for name, s in self.by.starts.items()}) if self.by.starts else self.model
        signals: dict[str, Any] = {}
        for group, _, number in ((n.group, n.column, n.number) for n in self.by.numbers):
            signals[group] = (signals.get(group) or not_none(model.inputs[group])).with_number(number, values[f"{group}{number}"])
        model = with_inputs(model, signals) if signals else model
        given = {**(self.options.parameters or {}), **{name: values[name] for name in self.by.parameters}} or None
        return model, replace(self.options, inputs=None, parameters=given)


class DifferentiatedModel(_Movable):
    """A model whose event-driven runs are differentiated, at one set of numbers after the other."""

    def _check_class(self) -> None:
        """Refuse a class that has no event-driven runs."""
        self.model.check_allowed("rtol")
        if CONTINUOUS_PROBLEM.optional(self.model) is None:
            raise UsageError(f"{type(self.model).__name__} has no event-driven runs; {TRY_DIFFERENCES}")

    def refined(self) -> Sensitivity:
        """The same of a run at a hundredth of rtol."""
        return type(self)(
            self.model, self.what, replace(self.options, rtol=max(not_none(self.options.rtol) / 100, MIN_RTOL))
        ).at_values()

    def at_times(self, t: np.ndarray) -> Sensitivity:
        """The same at other times."""
        return type(self)(self.model, self.what._replace(at=t), self.options).at_values()

    def at_values(self, numbers: np.ndarray | None = None) -> Sensitivity:
        """The derivatives at these numbers (q,); left out those that stand."""
        model, options = self.moved(numbers)
        loop = make_run(model, options)
        run, propagator, rtol = loop.go(), cast("Any", loop.propagator), not_none(options.rtol)
        own, bound = self._equations(propagator), propagator.model
        starts = dict(zip(self.by.names, self.start if numbers is None else np.asarray(numbers, float), strict=True))
        values = [starts.get(name, bound.bound_parameters.get(name)) for name in own.free.parameters]
        equations = own.equations.at_values(values)
        known = KnownTimes(bound, own.free, own.problem, own.columns, self.by.numbers, propagator.T)
        along = _tangents_of_run(equations, known, propagator.record.buffer, run, self.t, len(self.by.names), rtol)
        reader, columns = _OutputSlopes(along, own.outputs), self.by.columns
        value, before, after = (np.array(part) for part in zip(*(reader(along.stop(t)) for t in self.t.tolist()), strict=True))
        for k, e in enumerate(self.integrals.values(), len(own.names) - len(self.integrals)):
            value[:, k] = [run.integral(e, 0.0, t) if t else 0.0 for t in self.t]
        switches, margins, warnings = _report(along, self.t, columns, np.abs(self.start), self.by.names)
        if self.t[-1] == self.t_end:
            warnings += tuple(
                f"t = {self.t_end:.10g}: the run ends on an edge of '{name}' that moves: the derivative there is that "
                "before the edge; give a later t_end for that after it"
                for name in known.moving_edges(self.t_end)
            )
        return Sensitivity(
            self.t, own.names, self.by.names, value, after[:, :, columns], before[:, :, columns], switches, margins, warnings,
            run, DERIVATIVE_METHODS[0], self,
        )  # fmt: skip

    def _equations(self, propagator: Any) -> _EquationsByValue:
        """What is the same at all numbers, for the problem of a run."""
        bound = propagator.problem
        if self._made is None or (self._made.problem.names, self._made.problem.rows) != (bound.names, bound.rows):
            kept = _kept_equations(self.model, key) if (key := self._equations_key(propagator)) is not None else []
            if not kept:
                kept.append(self._make_equations(propagator))
            self._made = kept[0]
        return self._made

    def _equations_key(self, propagator: Any) -> tuple[Any, ...] | None:
        """What equations depend on beside the model, all names and numbers; None where a user gives expressions."""
        outputs = self.what.outputs
        names = list(outputs) if isinstance(outputs, list | tuple) else [outputs]
        if self.integrals or not all(one is None or isinstance(one, str) for one in names):
            return None
        others = (item for item in propagator.model.bound_parameters.items() if item[0] not in self.by.parameters)
        return (*self.by.names, "", *names, "", *propagator.problem.names, "", *propagator.problem.rows, *others)

    def _make_equations(self, propagator: Any) -> _EquationsByValue:
        bound, model = propagator.model.bound_parameters, self.model
        try:
            free = with_start_parameters(with_symbols(model, bound, self.by.parameters), list(self.by.starts.values()))
            problem = symbolic_event_driven_problem(free, propagator.problem)
        except NsmodelError as error:
            raise UsageError(f"not with symbols for {', '.join(self.by.names)}: {error}; {TRY_DIFFERENCES}") from error
        if problem.names != propagator.problem.names or problem.rows != propagator.problem.rows:
            raise UsageError(f"the model has other rows at these values than with symbols; {TRY_DIFFERENCES}")
        outputs = read_outputs(model, problem, bound, self.what.outputs)
        integrands = read_outputs(model, problem, bound, self.integrals, "integrals") if self.integrals else {}
        if clash := next((name for name in integrands if name in outputs), None):
            raise UsageError(f"integrals: '{clash}' is an output already; take another name")
        whole = _with_integrals(problem, integrands)
        columns = range(len(self.by.parameters) + len(self.by.starts))
        given = ca.vertcat(whole.t, whole.x, whole.l, whole.p)
        column = ca.vertcat(*outputs.values(), *(whole.x[problem.x.numel() + k] for k in range(len(integrands))))
        slopes = [column, *(ca.jacobian(column, s) for s in (whole.x, whole.l, whole.p[list(columns)]))]
        function = ca.Function("outputs", [given], [ca.densify(part) for part in slopes])
        return _EquationsByValue(free, problem, TangentEquations(whole, columns), columns, (*outputs, *integrands), function)


@cached_per_object_and_key(most=4)
def _kept_equations(model: Model, key: tuple[Any, ...]) -> list[_EquationsByValue]:
    """Where those of a model are put, of the last questions that were asked: none, or one."""
    del model, key
    return []


class _EquationsByValue(NamedTuple):
    """A model with symbols for what it is differentiated by, what it is in continuous time, and its linearised equations.

    ``columns``: of S by its parameters; ``names``: of the outputs, integrals last; ``outputs``: their values and slopes.
    """

    free: Model
    problem: ContinuousProblem
    equations: TangentEquations
    columns: range
    names: tuple[str, ...]
    outputs: ca.Function


class DifferencedModel(_Movable):
    """A model whose runs are differenced, over a width far above what a run errs by, and a step.

    Over less, differences of time steps are those of the steps, which need not tend to the solution's (Stewart and Anitescu,
    Optimal control of systems with discontinuous differential equations, 2010).
    """

    def __init__(self, model: Model, what: Request, options: Options, width: float | None) -> None:
        """``width``: relative to each number."""
        super().__init__(model, what, options)
        self._width = width_of(options.rtol, options.step, self.t_end) if width is None else width
        names = [*self.model.names, *(name for name in start_entries(self.model) if name not in self.model.names)]
        given = names if what.outputs is None else [what.outputs] if isinstance(what.outputs, str) else list(what.outputs)
        wrong = next((one for one in given if not isinstance(one, str)), None)
        if wrong is not None:
            raise UsageError(f"outputs: {wrong!r:.60}; with method='differences' give names of columns, or integrals={{...}}")
        self._outputs = [name for name in given if isinstance(name, str)]

    def refined(self) -> Sensitivity:
        """The same over twice the width."""
        return DifferencedModel(self.model, self.what, self.options, 2 * self._width).at_values()

    def at_times(self, t: np.ndarray) -> Sensitivity:
        """The same at other times."""
        return DifferencedModel(self.model, self.what._replace(at=t), self.options, self._width).at_values()

    def at_values(self, numbers: np.ndarray | None = None) -> Sensitivity:
        """The differences about these numbers (q,); left out those that stand."""
        numbers = self.start if numbers is None else np.asarray(numbers, float)
        run = self._run_at(numbers)
        found = central_differences(self._run_at, self._values, numbers, self._width)
        names = (*self._outputs, *self.integrals)
        return Sensitivity(
            self.t, names, self.by.names, self._values(run), found, found, (), {}, (), run, DERIVATIVE_METHODS[1], self
        )

    def _run_at(self, numbers: np.ndarray) -> Trajectory:
        model, options = self.moved(numbers)
        return make_run(model, options).go()

    def _values(self, run: Trajectory) -> np.ndarray:
        at, names = run.at(self.t), list(self.model.names)
        columns = {name: at.x[:, i] for i, name in enumerate(names)}
        columns |= {name: at.v[:, i] for i, name in enumerate(n for n in start_entries(self.model) if n not in names)}
        for letter, part in (("l", at.multipliers), ("y", at.y)):
            columns |= {f"{letter}_{i}": column for i, column in enumerate(part.T)}
        columns |= {
            name: column for name, column in zip(multiplier_names(run), at.multipliers.T, strict=False) if name not in columns
        }
        for name in self._outputs:
            if name not in columns:
                raise UsageError(f"outputs: '{name}' is not a column of runs of this model; there are {', '.join(columns)}")
        integrals = [[run.integral(e, 0.0, t) if t else 0.0 for t in self.t] for e in self.integrals.values()]
        return np.column_stack([*(columns[name] for name in self._outputs), *integrals])


# MIN_WIDTH: EPS/1e-4 of S is rounding then.
MIN_WIDTH = 1e-4  # Relative: the least part of a number by which it is moved for a difference quotient.


def width_of(rtol: float | None, step: float | None, t_end: float) -> float:
    """The relative width at which the error of runs and the third derivative weigh about as much."""
    return max(rtol ** (1 / 3) if rtol is not None else (float(step or 0.0) / t_end) ** 0.5, MIN_WIDTH)


def central_differences(
    run_at: Callable[[np.ndarray], Trajectory], values: Callable[[Trajectory], np.ndarray], numbers: np.ndarray, width: float
) -> np.ndarray:
    """(K, r, q) of ``values`` (K, r) of runs about ``numbers`` (q,); the width is relative, of a number that is 0 absolute."""
    columns = []
    for j, number in enumerate(numbers):
        d = width * (abs(number) or 1.0)
        ends = []
        for sign in (1.0, -1.0):
            moved = numbers.copy()
            moved[j] = number + sign * d
            ends.append((moved[j], values(run_at(moved))))
        columns.append((ends[0][1] - ends[1][1]) / (ends[0][0] - ends[1][0]))
    return np.stack(columns, axis=2)


def _with_integrals(problem: ContinuousProblem, integrands: Mapping[str, ca.SX]) -> ContinuousProblem:
    """The problem with the integrals as further states, behind all others."""
    if not integrands:
        return problem
    more, zeros = ca.SX.sym("integral", len(integrands)), ca.SX.zeros(len(integrands))
    return replace(
        problem, x=ca.vertcat(problem.x, more), f=ca.vertcat(problem.f, *integrands.values()), g=ca.vertcat(problem.g, zeros),
        x0=ca.vertcat(problem.x0, zeros), names=(*problem.names, *integrands),
    )  # fmt: skip


def _tangents_of_run(
    equations: TangentEquations, known: KnownTimes, pieces: PieceBuffer, run: Trajectory, times: np.ndarray, q: int, rtol: float
) -> RunTangents:
    """S along the pieces of a run, with parts that end at these times."""
    _check_pieces(pieces, run)
    pieces, ends = _pieces_until(pieces, float(times[-1]))
    tangents = PieceTangents(equations, pieces, ends)
    jumps = SwitchJumps(tangents, known, q).all()
    start = np.zeros((equations.n, q))
    start[:, : equations.q] = equations.start_slopes
    known.put_held(0.0, tangents.values(np.zeros(1, int), np.zeros(1))[1][0], np.zeros((equations.n,) * 2), start)
    return RunTangents(tangents, jumps, start, times, rtol)


def _check_pieces(pieces: PieceBuffer, run: Trajectory) -> None:
    """Refuse runs of which a part is by time steps."""
    if pieces.stepped.any():
        t = float(pieces.t[int(pieces.stepped.argmax())])
        raise StepError(
            f"from t = {t:.10g} on the run goes by time steps, whose derivatives do not tend to those of the solution; "
            f"{TRY_DIFFERENCES}"
        )
    if not pieces.count:
        raise UsageError(f"the run has no pieces: {run.metadata.get('message', '')}")


def _pieces_until(pieces: PieceBuffer, t: float) -> tuple[PieceBuffer, np.ndarray]:
    """The pieces that begin before a time, and their ends in the unit of each."""
    count = max(1, int(np.searchsorted(pieces.t, t * (1 - SAME_TIME), side="left")))
    begins = np.append(pieces.t, np.inf)[1 : count + 1]
    pieces = pieces.cut(slice(0, count))
    stop = np.minimum(np.minimum(begins, pieces.end), max(t, 0.0) if t else np.inf)
    return pieces, (stop - pieces.t) / pieces.tau


class _OutputSlopes:
    """Values of expressions of t, x, l and p on pieces, and their derivatives."""

    def __init__(self, along: RunTangents, function: ca.Function) -> None:
        self._along, self._tangents, self._equations = along, along.tangents, along.tangents.equations
        self._function = function

    def __call__(self, stop: Stop) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The values just after a time (r,), and the derivatives (r, q) just before and just after it."""
        before, after = self._along.sides(stop)
        value, at_end = self._at(stop.piece, stop.s, after)
        if stop.s or not stop.piece:
            return value, at_end, at_end
        return value, self._at(stop.piece - 1, float(self._tangents.ends[stop.piece - 1]), before)[1], at_end

    def _at(self, piece: int, s: float, S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        where, at = np.array([piece]), np.array([s])
        t, x, l = self._tangents.values(where, at)
        _, of_state, own = self._tangents.linearised(where, at)
        value, by_x, by_l, by_p = map(np.array, self._function(np.concatenate([t, x[0], l[0], self._equations.values])))
        found = (by_x + by_l @ of_state[0]) @ S
        found[:, : by_p.shape[1]] += by_p + by_l @ own[0]
        return value.ravel(), found


def _report(
    along: RunTangents, times: np.ndarray, columns: Sequence[int], numbers: np.ndarray, names: Sequence[str]
) -> tuple[tuple[Switch, ...], dict[str, float], tuple[str, ...]]:
    """The switches, margins and warnings."""
    tangents, switches, warnings = along.tangents, [], []
    sizes, least, nearest = tangents.sizes[:, None], np.inf, np.inf
    for k, jump in along.jumps.items():
        if jump.kind == START:
            warnings += _start_warnings(along, jump, columns)
            continue
        S = along.sides(Stop(jump.t, k, 0.0))[0]
        moved = (jump.time_by_state @ S + jump.time_own)[columns]
        switches.append(Switch(jump.t, jump.kind, jump.name, moved, jump.transversality))
        nearest = min([nearest, *np.abs(times - jump.t).tolist()]) if moved.any() else nearest
        if np.isfinite(jump.transversality):
            least = min(least, jump.relative_rate)
            if jump.relative_rate < NEARLY_GRAZING:
                warnings.append(
                    f"t = {jump.t:.10g}: '{jump.name}' crosses 0 at {jump.relative_rate:.1g} of its mean rate: S grows like one "
                    "over that, and is as large as it says only as near to this run"
                )
        for name, by_state, own in jump.rivals:
            other = (by_state @ S + own)[columns]
            if np.abs(other - moved).max() > TANGENT_SAME * max(np.abs(moved).max(), np.abs(other).max()):
                warnings.append(
                    f"t = {jump.t:.10g}: '{jump.name}' and '{name}' switch at once, and their times move by {_list(moved)} and "
                    f"{_list(other)} by {', '.join(names)}: each order of the two has its own derivative; here both move "
                    f"with '{jump.name}'"
                )
    turn = tangents.nearest_turn()
    if turn is not None and turn.distance < NEARLY_GRAZING:
        warnings.append(
            f"t = {turn.t:.6g}: '{turn.name}' comes to {turn.distance:.1g} of its largest value from a switch, and turns back: a "
            "little further a switch comes, and derivatives are others"
        )
    growth = float((np.abs(along.at_begin[:, :, columns]) / sizes * np.where(numbers > 0, numbers, 1.0)).max(initial=0.0))
    if growth * EPS > LARGE_GROWTH:
        warnings.append(
            f"S is {growth:.2g} times as large as what it is between: rounding in it is {growth * EPS:.1g} of the run"
        )
    return (
        tuple(switches),
        {
            "transversality": least,
            "graze": np.inf if turn is None else turn.distance,
            "at": nearest,
            "growth": growth,
        },
        tuple(warnings),
    )


def _start_warnings(along: RunTangents, jump: SwitchJump, columns: Sequence[int]) -> list[str]:
    found = dict.fromkeys(
        name for name, by_state, own in jump.rivals if np.abs((by_state @ along.start + own)[columns]).max() > 0
    )
    return [f"the run starts on the switch of '{name}': the derivative is one-sided, that of the first mode" for name in found]


def _list(values: np.ndarray) -> str:
    return f"({', '.join(f'{v:.6g}' for v in values.tolist())})"
