"""What runs are compared with: the closed form a model declares, or a refined run that shows its own error; and the errors.

A refined run between its rows: a straight line where that is as good as the run itself, else a step from the row before.

Where a state jumps (at the start of a circuit whose capacitors do not agree, at an impact) or bends, the line between two rows is
nothing that the run ever was. There the scheme takes one step from the row before to the very time that is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from nsmodel._utils import former_names, short_repr
from nsmodel.errors import StepError, UsageError
from nsmodel.modeling.base import Model
from nsmodel.modeling.time_grid import SAME_TIME_SHARE, input_schedule
from nsmodel.modeling.variants import block_input_entries
from nsmodel.proof.verdict import not_none
from nsmodel.simulation.fixed_grid import FixedGridPropagator, make_stepper
from nsmodel.simulation.run_data import output_names
from nsmodel.simulation.step_inputs import reinitialised_step_mask
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.solvers.active_set import equilibrate_problem
from nsmodel.solvers.newton import NewtonSolver
from nsmodel.solvers.one_step_problem import OneStepProblem
from nsmodel.solvers.residuals import NumericLaw, numeric_law
from nsmodel.solvers.structure import read_step_structure
from nsmodel.study.lines import Point
from nsmodel.study.reference_steps import REFERENCE_STEP

# Steps that are taken for one question, an interpreted step each; what is left stays on its line, or is not known.
MAX_SINGLE_STEPS = 300

StateAt = Callable[[int, float], np.ndarray]  # (row, h) -> what a step of h from there starts from
StepFromRow = Callable[
    [int, float], np.ndarray
]  # (row, h) -> the states (n,) a step of h after it; NaN where there is no such step


@dataclass(frozen=True)
class InterpolatedRun:
    """The states of a run at any time: t (N+1,) and x (N+1, n) its rows, ``step`` from a row; ``scale`` (n,) of the states.

    ``good`` is the error that a line may have beside ``scale``.
    """

    t: np.ndarray
    x: np.ndarray
    step: StepFromRow
    scale: np.ndarray
    good: float

    def interpolation_errors(self) -> np.ndarray:
        """How far each line is from the run at most, beside the scale (N,).

        An eighth of the second difference where the run is smooth; where it is not, neighbouring ones differ by the jump itself.
        """
        h = np.diff(self.t)[:, None]
        slope_changes = np.diff(np.diff(self.x, axis=0) / h, axis=0) / self.scale
        if not len(slope_changes):
            return np.zeros(len(h))
        before, after = (
            2 * slope_changes[[i]] - slope_changes[[j]]
            for i, j in ((0, min(1, len(slope_changes) - 1)), (-1, -min(2, len(slope_changes))))
        )
        slope_changes = np.concatenate([before, slope_changes, after])
        size = np.maximum(np.abs(slope_changes[:-1]), np.abs(slope_changes[1:])) / 8 + np.abs(np.diff(slope_changes, axis=0))
        return (h * size).max(axis=1)

    def __call__(self, times: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the states (k, n) at ``times``, and the largest error of the lines that are left."""
        x = _interpolate_columns(times, self.t, self.x)
        row = np.clip(np.searchsorted(self.t, times, side="right") - 1, 0, len(self.t) - 2)
        ahead = times - self.t[row]
        here = np.minimum(ahead, self.t[row + 1] - times) <= 1e-9 * (self.t[row + 1] - self.t[row])  # a row of the run
        bend = np.where(here, 0.0, self.interpolation_errors()[row])
        for k in np.argsort(-bend, kind="stable")[:MAX_SINGLE_STEPS]:
            if not bend[k] > self.good:
                break
            found = self.step(int(row[k]), float(ahead[k]))
            if np.isfinite(found).all():
                x[k], bend[k] = found, 0.0
        return x, float(bend.max(initial=0.0))


@dataclass(frozen=True)
class RunAtRows:
    """The states of a run with inputs: t (N+1,) and x (N+1, n) its rows, ``step`` from a row.

    At an edge it bends, and no line from row to row tells by how much: at times that are no rows it is known by steps alone.
    """

    t: np.ndarray
    x: np.ndarray
    step: StepFromRow

    def __call__(self, times: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the states (k, n) at ``times``, NaN where they are not known, and what they err by besides the run."""
        near = SAME_TIME_SHARE * self.t[-1]
        row = np.searchsorted(self.t, times + near, side="right") - 1
        x, ahead = self.x[row].copy(), times - self.t[row]
        between = np.flatnonzero(ahead > near)
        x[between] = np.nan
        for k in between[np.linspace(0, between.size - 1, min(MAX_SINGLE_STEPS, between.size)).astype(int)]:
            x[k] = self.step(int(row[k]), float(ahead[k]))
        return x, 0.0


def make_row_stepper(run: FixedGridPropagator, start: np.ndarray, made: Trajectory) -> StepFromRow:
    """Return the step from the rows of a run that was ``made`` by ``run``, whose packed state at the start was ``start``."""
    model, n = run.model, len(run.model.names)
    states_before_step = REFERENCE_STEP.of(model).states_before_step
    own = start[: start.size - 2 * model.u.numel()]
    state_at = states_before_step(model, made, own) if states_before_step else lambda row, h: made.x[row]
    state_at = _states_with_inputs(run, made, state_at) if model.u.numel() else state_at
    stepper = make_stepper(run.model, "auto", run.stepper.tolerance, h=run.grid.step(0), state=start, few_steps=False)

    def step(row: int, h: float) -> np.ndarray:
        try:
            return stepper(float(made.t[row]), h, state_at(row, h), stepper.cold_start(), row).row[stepper.layout.state][:n]
        except StepError:
            return np.full(n, np.nan)

    return step


def _states_with_inputs(run: FixedGridPropagator, made: Trajectory, state_at: StateAt) -> StateAt:
    """The states with the inputs at both ends of the step behind them; after a jump with the reaction of the law there."""
    model, reinitialised, held = run.model, reinitialised_step_mask(run.model, made), block_input_entries(run.model)
    drive = input_schedule(model, float(made.t[-1]))

    def state(row: int, h: float) -> np.ndarray:
        t, begin = float(made.t[row]), made.inputs_begin[row + 1]
        end = drive.limits(np.array([t, min(t + h, made.t[row + 1])]))[0, begin.size :]
        end[held] = begin[held]
        given = np.concatenate([state_at(row, h), begin, end])
        return given if run.starter is None or not reinitialised[row] else run.starter(t, h, given)

    return state


GRID_MEASURES = ("max", "l2")  # Measures that look at the states at all times.
# A point is resolved where its error is so many times the reference's own: that changes it by a fifth, at most.
RESOLVED_FACTOR = 5.0
CLOSED_FORM_ROUNDING = 1e-14  # What a closed form is known to, relative: 45 EPS, a few functions of the library.
# A state smaller than this part of its group is no more than rounding: its errors are measured by the group.
NEGLIGIBLE_STATE_SIZE = 1e-9
ORDER_RANGE = 0.5, 2.0  # The schemes' orders, 1/2 with impulses, 1 and 2; outside of them an order seen on three runs is chance.
# Least singular value, relative to the largest, of a balanced matrix that determines its multipliers: others lose ten digits.
REGULARITY_TOLERANCE = 1e-10
PIECE_SUBDIVISIONS = 8  # Parts in which a piece is compared: errors between its ends are as large as there, or larger.
# So many different index sets of a run are looked at, the first: each takes a matrix and its singular values.
MAX_CHECKED_INDEX_SETS = 60


@dataclass(frozen=True)
class ReferenceRows:
    """What is compared of a run: times (N+1,), states (N+1, n), and multipliers (N+1, m) where they are unique; of declared
    outputs the means over the run and the largest values.
    """

    t: np.ndarray
    x: np.ndarray
    multipliers: np.ndarray | None = None
    outputs: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)

    __repr__ = short_repr

    @classmethod
    def of(cls, run: Trajectory) -> ReferenceRows:
        """Return the rows of a run; the multipliers of a sweeping process are its reactions.

        Of an event-driven run also times between its rows, where it is its polynomials and no straight lines, and no multipliers:
        those that are compared are constant between rows.
        """
        if not run.is_event_driven:
            return cls(run.t, run.x, run.arrays.get("reactions", run.arrays.get("multipliers")), _output_means(run))
        inside = (run.t[:-1, None] + np.diff(run.t)[:, None] * np.arange(1, PIECE_SUBDIVISIONS) / PIECE_SUBDIVISIONS).ravel()
        t, x = np.concatenate([run.t, inside]), np.concatenate([run.x, run.at(inside).x])
        order = np.argsort(t, kind="stable")
        return cls(t[order], x[order], outputs=_output_means(run))


@dataclass(frozen=True)
class Reference:
    """The state that counts as right.

    Attributes:
        text: what it is, in a line; run: what the refined run is, empty where there was none.
        state: times (N,) -> states (N, n), and what they may err by because the times are none of the reference's own.
        scale: what an error of each state is divided by (n,).
        rows: the refined run, None where there was none.
        own: its own error by measure, of the same kind as the errors measured with it.
        without_multipliers: why multipliers are not compared, empty where they are.
    """

    text: str
    run: str
    state: Callable[[np.ndarray], tuple[np.ndarray, float]]
    scale: np.ndarray
    rows: ReferenceRows | None
    own: Mapping[str, float]
    without_multipliers: str = ""

    __repr__ = short_repr

    def errors(self, rows: ReferenceRows) -> dict[str, float]:
        """Return the errors of a run: "max", "end", "l2", and "multipliers" where both have them."""
        return self._measure_errors(rows)[0]

    def _measure_errors(self, rows: ReferenceRows) -> tuple[dict[str, float], float]:
        """The errors, and what the reference may err by at these rows besides its own."""
        right, more = self.state(rows.t)
        found = _state_errors(rows, right, self.scale)
        if self.rows is not None and not self.without_multipliers:
            error = _multiplier_error(rows, self.rows)
            if error is not None:
                found["multipliers"] = error
        if self.rows is not None and (shared := self.rows.outputs.keys() & rows.outputs.keys()):
            found["outputs"] = max(_mean_error(rows.outputs[name], self.rows.outputs[name]) for name in shared)
        return found, more

    def point(self, label: str, rows: ReferenceRows, seconds: float | None, step: float | None = None) -> Point:
        """Return a run as a point, with its errors; those that are not clear of the reference's own are unresolved."""
        errors, more = self._measure_errors(rows)
        known = {key: own + (more if key in GRID_MEASURES else 0.0) for key, own in self.own.items()}
        unresolved = tuple(key for key, error in errors.items() if error < RESOLVED_FACTOR * known.get(key, 0.0))
        return Point(label, seconds, errors, step=step, steps=len(rows.t) - 1, unresolved=unresolved)


@dataclass(frozen=True)
class ClosedForm:
    """The user's function of times (N,) -> (N, n), what it returns checked."""

    exact: Callable[[np.ndarray], np.ndarray]
    n: int

    def __call__(self, times: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the states, which err by 0.

        Raises:
            UsageError: the function raises, or gives another shape or what is not finite.
        """
        try:
            found = np.asarray(self.exact(times), float)
        except Exception as error:
            raise UsageError(f"exact: it raised {type(error).__name__}: {error}") from error
        if found.shape != (len(times), self.n) or not np.isfinite(found).all():
            size = f"shape {found.shape} for {len(times)} times; expected {(len(times), self.n)}, all finite"
            raise UsageError(f"exact: it returned {size}")
        return found, 0.0


def closed_form_reference(
    exact: Callable[[np.ndarray], np.ndarray],
    model: Model,
    t: np.ndarray,
    refined: Reference | None,
    without_multipliers: str = "",
) -> Reference:
    """Return the closed form as reference, with the multipliers of a refined run where there is one.

    Raises:
        UsageError: it raises, gives another shape, or what is not finite.
    """
    state = ClosedForm(exact, len(model.names))
    own: dict[str, float] = dict.fromkeys(("max", "end", "l2"), CLOSED_FORM_ROUNDING)
    scale = state_scales(model, state(t)[0])
    text = "the closed form that the model declares"
    if refined is None:
        return Reference(text, "", state, scale, None, own, without_multipliers or "there is no refined run")
    own |= {key: value for key, value in refined.own.items() if key not in own}
    return Reference(text, refined.run, state, scale, refined.rows, own)


def refined_run_reference(
    model: Model, run: str, runs: list[ReferenceRows], without_multipliers: str, step: StepFromRow
) -> Reference:
    """Return the last of three runs, each with half the step of the one before, as reference with an estimate of its error.

    Between its rows ``step`` takes a step from the row before, wherever a line would add to that error.

    The order p is read off the three (within ORDERS), and the error is |x_h - x_2h|/(2^p - 1), measure by measure.
    """
    wide, medium, fine = runs
    scale = state_scales(model, fine.x)
    state = RunAtRows(fine.t, fine.x, step) if model.u.numel() else InterpolatedRun(fine.t, fine.x, step, scale, np.inf)
    reference = Reference(run, run, state, scale, fine, {}, without_multipliers)
    far, near = reference.errors(wide), reference.errors(medium)
    own = {measure: _estimate_own_error(far[measure], near[measure]) for measure in near}
    return replace(reference, own=own, state=replace(state, good=own["max"]) if isinstance(state, InterpolatedRun) else state)


@dataclass(frozen=True)
class EventDrivenSolution:
    """An event-driven run as a function of times (N,) -> (N, n); at the start the state before a jump."""

    run: Trajectory

    def __call__(self, times: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the states, which err by no more between rows than at them."""
        return np.where((times <= 0)[:, None], self.run.x[0], self.run.at(np.minimum(times, self.run.t[-1])).x), 0.0


def event_driven_reference(
    model: Model, rtol: float, rough: Trajectory, fine: Trajectory, refined: Reference
) -> tuple[Reference, str]:
    """Return an event-driven run as reference, whose own error is how far a rougher one is from it.

    The multipliers are those of the refined run, which it must agree with to the errors of both; where it does not, that run
    is the reference, what they differ by its own error, and a note says so.
    """
    scale = state_scales(model, fine.smooth().x)
    means, known = _output_means(fine), not_none(refined.rows).outputs
    outputs = {name: (means[name][0], size) for name, (_, size) in known.items() if name in means}
    rows = replace(not_none(refined.rows), outputs=outputs)
    new = replace(refined, text=f"an event-driven run, rtol = {rtol:g}", state=EventDrivenSolution(fine), scale=scale, rows=rows)
    states = {measure: max(error, CLOSED_FORM_ROUNDING) for measure, error in new.errors(ReferenceRows.of(rough)).items()}
    difference = new.errors(not_none(refined.rows))
    if difference["max"] > RESOLVED_FACTOR * (refined.own["max"] + states["max"]):
        own = {measure: max(error, difference.get(measure, 0.0)) for measure, error in refined.own.items()}
        return replace(refined, own=own), (
            f"an event-driven run and {refined.text} differ by {difference['max']:.1e}, more than their own errors tell; this "
            "counts as the error of the reference"
        )
    return replace(new, own={**refined.own, **states}), ""


def state_scales(model: Model, x: np.ndarray) -> np.ndarray:
    """Return the largest value of each state; of its symbol's group where it is zero all the time, 1 where all of that is."""
    sizes = np.abs(x).max(axis=0)
    scale = sizes.copy()
    for columns in model.stems.values():
        group = sizes[columns].max()
        scale[columns] = np.where(sizes[columns] > NEGLIGIBLE_STATE_SIZE * group, sizes[columns], group if group > 0 else 1.0)
    return scale


def _output_means(run: Trajectory) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """{name: (mean over the run, largest value)} of declared outputs, (k,) each; of those that have a mean."""
    found = {}
    for name in output_names(run):
        with suppress(UsageError):
            mean, size = np.atleast_1d(run.mean(name)), np.nanmax(np.abs(run.arrays[name]), axis=0)
            found[name] = mean, np.atleast_1d(size)
    return found


def _mean_error(one: tuple[np.ndarray, np.ndarray], right: tuple[np.ndarray, np.ndarray]) -> float:
    """How far a mean is from the right one, beside the largest value."""
    size = np.where(right[1] > 0, right[1], 1.0)
    return float((np.abs(one[0] - right[0]) / size).max())


def _estimate_own_error(far: float, near: float) -> float:
    p = np.log2(max(far / near - 1, 1e-3)) if near > 0 else ORDER_RANGE[1]
    return max(near / (2 ** np.clip(p, *ORDER_RANGE) - 1), CLOSED_FORM_ROUNDING)


def _state_errors(rows: ReferenceRows, right: np.ndarray, scale: np.ndarray) -> dict[str, float]:
    known = ~np.isnan(right).any(axis=1)
    error = np.abs(rows.x - right)[known] / scale
    steps = np.diff(rows.t[known])
    square = (steps[:, None] * error[1:] ** 2).sum(axis=0) / steps.sum()
    return {"max": float(error.max()), "end": float(error[-1].max()), "l2": float(np.sqrt(square.max()))}


def _multiplier_error(rows: ReferenceRows, right: ReferenceRows) -> float | None:
    """The integral of sum |l - l_ref| over that of sum |l_ref|; None where a run has none."""
    if rows.multipliers is None or right.multipliers is None or not rows.multipliers.size:
        return None
    (t, steps, l), (times, lengths, expected) = _rows_with_multipliers(rows), _rows_with_multipliers(right)
    size = lengths @ np.abs(expected).sum(axis=1)
    error = steps @ np.abs(l - _interpolate_columns(t, times, expected)).sum(axis=1)
    return float(error / size) if size > 0 else None


def _rows_with_multipliers(rows: ReferenceRows) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, steps and multipliers of the rows that have multipliers: not the start."""
    l = not_none(rows.multipliers)
    known = np.all(np.isfinite(l), axis=1)
    return rows.t[known], np.diff(rows.t, prepend=rows.t[0])[known], l[known]


def _interpolate_columns(t: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.column_stack([np.interp(t, times, column) for column in values.T])


def nonuniqueness_reason(model: Model, problem: OneStepProblem, run: Trajectory) -> str:
    """Say why the multipliers of a run are not unique, as its index sets show; empty where they are.

    They are where the rows and columns of W with y_i = 0 are a regular matrix: y = W l + b then has one solution with this
    index set.
    """
    if problem.prediction is not None:
        return "catching-up has no multipliers: it projects"
    if not problem.l.numel():
        return "the model has none"
    law = numeric_law(problem.law)
    newton = NewtonSolver(problem, read_step_structure(problem), law, run.metadata["tolerance"])
    n, m, codes = len(model.names), law.size, run.index_set
    _, rows = np.unique(codes, axis=0, return_index=True)
    for k in [k for k in np.sort(rows) if codes[k].min() >= -1][:MAX_CHECKED_INDEX_SETS]:
        held = np.flatnonzero(codes[k] == 0)
        state = np.zeros(problem.state.numel())
        state[:n] = run.x[k - 1]
        if "inputs" in run.arrays:
            state[-2 * run.inputs.shape[1] :] = np.concatenate([run.inputs_begin[k], run.inputs[k]])
        l = run.multipliers[k] if run.multipliers.shape[1] == m else np.zeros(m)
        W, _ = newton.affine_problem(float(run.t[k - 1]), float(run.step[k]), state, l)
        if W is None:
            return f"not known to be unique: the step's matrix is singular at t = {run.t[k]:.4g}"
        if held.size and not _is_regular_matrix(W[np.ix_(held, held)]):
            names = [problem.rows[i] for i in held[:4]] + (["..."] if held.size > 4 else [])
            return f"not unique: the matrix of the active rows ({', '.join(names)}) is singular at t = {run.t[k]:.4g}"
    return ""


def _is_regular_matrix(W: np.ndarray) -> bool:
    free = NumericLaw(np.full(len(W), -np.inf), np.full(len(W), np.inf), ())
    values = np.linalg.svd(equilibrate_problem(W, np.zeros(len(W)), free)[0], compute_uv=False)
    return bool(values[-1] > REGULARITY_TOLERANCE * values[0])


__getattr__ = former_names(__name__, Rows="ReferenceRows")
