"""What the model in continuous time says of the rows of a run, where the model is at hand."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from nsmodel.errors import NsmodelError
from nsmodel.plot import style
from nsmodel.simulation.run_data import state_names

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
