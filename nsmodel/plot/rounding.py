"""Columns of a run that are 0 to rounding: their values say nothing, and get no axis of their own.

A value is rounding where it is below what the arithmetic that made it can see. Of an output this is the running error bound of
its expression. With the model at hand a state is compared with what its rate errs by in all N steps, which add up like a random
walk, h sqrt(N) |err(f + g)|, and a multiplier with what the rows that it enters err by: it is 0 where all it moves is below.
Both hold in any units. Without the model a state or multiplier is compared with the largest of the run, and called rounding only
if it is also as restless as rounding is: a small charge beside volts that moves smoothly is shown.

What the model in continuous time says of the rows of a run, where the model is at hand: its x, l and energy there.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.errors import NsmodelError
from nsmodel.modeling.output_columns import evaluate_quantity
from nsmodel.modeling.outputs import Quantity
from nsmodel.plot import style
from nsmodel.proof.expression_graph import stack_column
from nsmodel.simulation.columns import column_names, read_quantity
from nsmodel.simulation.run_data import multiplier_names, state_names
from nsmodel.solvers.rounding_errors import UNIT_ROUND_OFF, rounding_error_bound

if TYPE_CHECKING:
    from nsmodel.event_driven.problem import ContinuousProblem
    from nsmodel.modeling.base import Model
    from nsmodel.simulation.trajectory import Trajectory

ENERGY_ON_LINES = "on lines between the ends of pieces"  # Of an energy between them, where the model is not at hand.


def continuous_problem_of_run(run: Trajectory, model: Model | None) -> ContinuousProblem | None:
    """The model of a run in continuous time; None where it has no such form, or there is no model."""
    from nsmodel.modeling.base import Model
    from nsmodel.simulation.event_driven import event_driven_problem

    if not isinstance(model, Model):
        return None
    with contextlib.suppress(NsmodelError):
        used = run.metadata.get("parameters", {})
        found = event_driven_problem(model.bind({name: used[name] for name in model.parameters if name in used}))
        rows = ca.Function("rows", [found.t, found.x, found.l], [found.rate, found.h], {"allow_free": True})
        return None if rows.get_free() else found
    return None


def continuous_states(run: Trajectory, problem: ContinuousProblem) -> np.ndarray | None:
    """The problem's x at all rows (N+1, n), NaN as 0: states, velocities, inputs; None where the run has others."""
    n = problem.states
    parts = [run.x, *([style.array_columns(run, "v")] if problem.x.numel() - problem.held > n else [])]
    parts += [style.array_columns(run, "inputs")] if problem.held else []
    if len(state_names(run)) != n or sum(part.shape[1] for part in parts) != problem.x.numel():
        return None
    return np.nan_to_num(np.hstack(parts))


def smooth_with_energy(run: Trajectory, model: Model | None, points: int = 2000) -> tuple[Trajectory, bool]:
    """The run read off its polynomials, see `Trajectory.smooth`; whether its energy is on lines, for want of the ``model``."""
    run = run.smooth(points)
    if not run.is_event_driven or "energy" not in run.arrays:
        return run, False
    values = _energy(run, model)
    return (run, True) if values is None else (replace(run, arrays=run.arrays | {"energy": values}), False)


def _energy(run: Trajectory, model: Model | None) -> np.ndarray | None:
    """The energy at all rows (N+1,), from the states there; None where it is not known."""
    problem = continuous_problem_of_run(run, model)
    if problem is None or "energy" not in problem.records or (x := continuous_states(run, problem)) is None:
        return None
    function = ca.Function("energy", [problem.t, problem.x], [problem.records["energy"]], {"allow_free": True})
    if function.get_free():
        return None
    return np.array(function.map(len(run.t))(run.t[None], x.T)).ravel()


ROUNDING_FACTOR = 64  # Times the unit round-off: rounding of some dozen operations, and what a run makes of it.
SAMPLED_ROWS = 200  # Rows at which rows are evaluated, evenly spread: the largest rounding of a run shows on some of them.
# States or multipliers up to which the model is asked, whose Jacobian is then small enough; of more the columns alone tell.
MAX_MODEL_SIZE = 200
OSCILLATING_SHARE = 0.2  # Share of the changes that turn back: rounding turns back at two of three, solutions seldom do,
MIN_CHANGES = 8  # of so many changes at least: of fewer the share says nothing.


class RoundingFloors(NamedTuple):
    """What is rounding of each state (n,), velocity (n,) or (0,), and multiplier (m,)."""

    states: np.ndarray
    velocities: np.ndarray
    multipliers: np.ndarray


def is_rounding(run: Trajectory, table: str, model: Model | None = None) -> np.ndarray:
    """Which columns (k,) of "x", "v", "multipliers" or "reactions" are not 0, and rounding in all rows."""
    found = style.array_columns(run, "reactions" if table == "multipliers" and "reactions" in run.arrays else table)
    size = style.largest_magnitudes(found)
    floors = None if model is None else _rounding_floors(run, model)
    if floors is not None:
        floor = {"x": floors.states, "v": floors.velocities}.get(table, floors.multipliers)
        if floor.shape == size.shape:
            return (size > 0) & (size <= floor)
    largest = max(abs(end) for one in ("x", "v", "multipliers", "inputs") for end in style.extent(style.array_columns(run, one)))
    small = (size > 0) & (size <= ROUNDING_FACTOR * UNIT_ROUND_OFF * largest)
    return np.array([own and _oscillates(column) for own, column in zip(small, found.T, strict=True)], bool)


def output_is_rounding(run: Trajectory, name: str, found: np.ndarray) -> np.ndarray:
    """Which entries (k,) of an output, whose values are (K, k), are not 0, and rounding in all rows."""
    own, label = read_quantity(run, name)
    symbols = [ca.SX.sym(one) for one in own.of]
    expression: Any = ca.Function.deserialize(own.code)(stack_column(symbols))
    bound = Quantity.made(rounding_error_bound(expression, stack_column(symbols)))
    rows = style.evenly_spread(len(run.t), SAMPLED_ROWS)
    arrays = {key: array[rows] for key, array in run.arrays.items() if len(array) == len(run.t)}
    size = style.largest_magnitudes(found)
    floor = style.largest_magnitudes(evaluate_quantity(bound, column_names(run), arrays, label).reshape(len(rows), -1))
    return (size > 0) & (size <= ROUNDING_FACTOR * UNIT_ROUND_OFF * floor)


def _oscillates(values: np.ndarray) -> bool:
    """Whether values go up and down from row to row, as rounding does."""
    changes = np.diff(values[np.isfinite(values)])
    changes = changes[changes != 0]
    return len(changes) >= MIN_CHANGES and float((changes[1:] * np.sign(changes[:-1]) < 0).mean()) >= OSCILLATING_SHARE


def _rounding_floors(run: Trajectory, model: Model) -> RoundingFloors | None:
    """From the model in continuous time; None where it has none, where the run has other columns, or where it is large."""
    problem = continuous_problem_of_run(run, model)
    if (
        problem is None
        or max(problem.states, problem.l.numel()) > MAX_MODEL_SIZE
        or (given := _problem_columns(run, problem)) is None
    ):
        return None
    state, moved = _floor_function(problem)(*given)
    n, free = problem.states, problem.x.numel() - problem.held
    floor, moved = ROUNDING_FACTOR * UNIT_ROUND_OFF * state.max(axis=0), moved.max(axis=0)
    own = np.divide(floor[:, None], moved, out=np.full(moved.shape, np.inf), where=moved > 0).min(axis=0, initial=np.inf)
    added = float(run.t[-1] - run.t[0]) / len(run) ** 0.5 * floor[:free]
    return RoundingFloors(added[:n], added[n:], np.where(np.isfinite(own), own, 0.0))


def _problem_columns(run: Trajectory, problem: ContinuousProblem) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """t, x and l of the problem at some rows; None where the run does not have them."""
    m = len(multiplier_names(run))
    if (
        problem.multipliers is not None
        or problem.l.numel() != m
        or len(run.t) < 2
        or (x := continuous_states(run, problem)) is None
    ):
        return None
    rows = 1 + style.evenly_spread(len(run.t) - 1, SAMPLED_ROWS)
    l = style.array_columns(run, "reactions" if problem.impulses else "multipliers")
    return run.t[rows], x[rows], np.nan_to_num(l[rows])


def _floor_function(problem: ContinuousProblem) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """(t, x, l) -> what the rows of f + g and h err by (K, n + m), in units of u; how multipliers move them (K, n + m, m)."""
    rows, unknown = ca.vertcat(problem.rate, problem.h), ca.vertcat(problem.x, problem.l)
    own = (problem.t, problem.x, problem.l)
    function = ca.Function(
        "floors", own, [rounding_error_bound(rows, unknown), ca.densify(ca.fabs(ca.jacobian(rows, problem.l)))]
    )

    def evaluated(t: np.ndarray, x: np.ndarray, l: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        bound, moved = function.map(len(t))(t[None], x.T, l.T)
        shape = len(t), problem.l.numel(), rows.numel()
        return np.nan_to_num(np.array(bound).T), np.nan_to_num(np.array(moved).T.reshape(shape).transpose(0, 2, 1))

    return evaluated
