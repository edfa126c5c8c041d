"""Columns of a run that are 0 to rounding: their values say nothing, and get no axis of their own.

A value is rounding where it is below what the arithmetic that made it can see. Of an output this is the running error bound of
its expression. With the model at hand a state is compared with what its rate errs by in all N steps, which add up like a random
walk, h sqrt(N) |err(f + g)|, and a multiplier with what the rows that it enters err by: it is 0 where all it moves is below.
Both hold in any units. Without
the model a state or multiplier is compared with the largest of the run, and called rounding only if it is also as restless
as rounding is: a small charge beside volts that moves smoothly is shown.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.columns import multiplier_names, state_names
from nsmodel.errors import NsmodelError
from nsmodel.model.quantity import Quantity
from nsmodel.plot import style
from nsmodel.proof.graph import column
from nsmodel.quantities import Names, quantity_of, values
from nsmodel.solve.rounding import UNIT, error_bound

if TYPE_CHECKING:
    from nsmodel.model.base import Model
    from nsmodel.scheme.continuous import ContinuousProblem
    from nsmodel.trajectory import Trajectory

BESIDE = 64  # Times UNIT: rounding, and what a run makes of it.
SAMPLES = 200  # Rows at which rows are evaluated.
LARGE = 200  # States or multipliers up to which the model is asked.
RESTLESS, CHANGES = 0.2, 8  # Share of the changes that turn back, of so many at least.


class Floors(NamedTuple):
    """What is rounding of each state (n,), velocity (n,) or (0,), and multiplier (m,)."""

    states: np.ndarray
    velocities: np.ndarray
    multipliers: np.ndarray


def is_rounding(run: Trajectory, table: str, model: Model | None = None) -> np.ndarray:
    """Which columns (k,) of "x", "v", "multipliers" or "reactions" are not 0, and rounding in all rows."""
    found = style.table(run, "reactions" if table == "multipliers" and "reactions" in run.arrays else table)
    size = style.sizes(found) if len(found) else np.zeros(found.shape[1])
    floors = None if model is None else _floors(run, model)
    if floors is not None:
        floor = {"x": floors.states, "v": floors.velocities}.get(table, floors.multipliers)
        if floor.shape == size.shape:
            return (size > 0) & (size <= floor)
    largest = max(style.sizes(style.table(run, one)).max(initial=0.0) for one in ("x", "v", "multipliers", "inputs"))
    small = (size > 0) & (size <= BESIDE * UNIT * largest)
    return np.array([own and _restless(column) for own, column in zip(small, found.T, strict=True)], bool)


def output_is_rounding(run: Trajectory, name: str, found: np.ndarray) -> np.ndarray:
    """Which entries (k,) of an output, whose values are (K, k), are not 0, and rounding in all rows."""
    own, label = quantity_of(run, name)
    symbols = [ca.SX.sym(one) for one in own.of]
    expression: Any = ca.Function.deserialize(own.code)(column(symbols))
    bound = Quantity.made(error_bound(expression, column(symbols)))
    rows = style.spread(len(run.t), SAMPLES)
    arrays = {key: array[rows] for key, array in run.arrays.items() if len(array) == len(run.t)}
    size = style.sizes(found)
    floor = style.sizes(values(bound, Names.of_run(run), arrays, label).reshape(len(rows), -1))
    return (size > 0) & (size <= BESIDE * UNIT * floor)


def _restless(values: np.ndarray) -> bool:
    """Whether values go up and down from row to row, as rounding does."""
    changes = np.diff(values[np.isfinite(values)])
    changes = changes[changes != 0]
    return len(changes) >= CHANGES and float((changes[1:] * np.sign(changes[:-1]) < 0).mean()) >= RESTLESS


def _floors(run: Trajectory, model: Model) -> Floors | None:
    """From the model in continuous time; None where it has none, where the run has other columns, or where it is large."""
    from nsmodel.run.event_driven import problem_of

    with contextlib.suppress(NsmodelError):
        used = run.metadata.get("parameters", {})
        problem = problem_of(model.bind({name: used[name] for name in model.parameters if name in used}))
        n, m, given = problem.states, problem.l.numel(), _columns(run, problem)
        if given is None or max(n, m) > LARGE:
            return None
        state, moved = _evaluated(run, problem)(*given)
        span = float(run.t[-1] - run.t[0]) / len(run) ** 0.5
        free = problem.x.numel() - problem.held
        rate, rows = state[:, :free].max(axis=0), state.max(axis=0)
        bound = BESIDE * UNIT * rows
        own = np.divide(bound[:, None], moved.max(axis=0), out=np.full(moved.shape[1:], np.inf), where=moved.max(axis=0) > 0)
        least = own.min(axis=0, initial=np.inf)
        floor = BESIDE * UNIT * span * rate
        return Floors(floor[:n], floor[n:free], np.where(np.isfinite(least), least, 0.0))
    return None


def _columns(run: Trajectory, problem: ContinuousProblem) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """t, x and l of the problem at some rows; None where the run does not have them."""
    n, m = len(state_names(run)), len(multiplier_names(run))
    if problem.states != n or problem.multipliers is not None or problem.l.numel() != m or len(run.t) < 2:
        return None
    parts = [run.x]
    if problem.x.numel() - problem.held > n:
        parts.append(style.table(run, "v"))
    if problem.held:
        parts.append(style.table(run, "inputs"))
    if sum(part.shape[1] for part in parts) != problem.x.numel():
        return None
    rows = 1 + style.spread(len(run.t) - 1, SAMPLES)
    l = style.table(run, "reactions" if problem.impulses else "multipliers")
    return run.t[rows], *(np.nan_to_num(part[rows]) for part in (np.hstack(parts), l))  # type: ignore[return-value]


def _evaluated(run: Trajectory, problem: ContinuousProblem) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """(t, x, l) -> what the rows of f + g and h err by (K, n + m), in units of u; how multipliers move them (K, n + m, m)."""
    rows, unknown = ca.vertcat(problem.rate, problem.h), ca.vertcat(problem.x, problem.l)
    own = (problem.t, problem.x, problem.l)
    function = ca.Function("floors", own, [error_bound(rows, unknown), ca.densify(ca.fabs(ca.jacobian(rows, problem.l)))])

    def evaluated(t: np.ndarray, x: np.ndarray, l: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        bound, moved = function.map(len(t))(t[None], x.T, l.T)
        shape = len(t), problem.l.numel(), rows.numel()
        return np.nan_to_num(np.array(bound).T), np.nan_to_num(np.array(moved).T.reshape(shape).transpose(0, 2, 1))

    return evaluated
