"""What the model in continuous time says of the rows of a run, where the model is at hand."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from nsmodel.columns import state_names
from nsmodel.errors import NsmodelError
from nsmodel.plot import style

if TYPE_CHECKING:
    from nsmodel.model.base import Model
    from nsmodel.scheme.continuous import ContinuousProblem
    from nsmodel.trajectory import Trajectory


def continuous(model: Model | None) -> ContinuousProblem | None:
    """The model in continuous time; None where it has no such form or parameters without numbers, or there is no model."""
    from nsmodel.run.event_driven import problem_of

    if model is None:
        return None
    with contextlib.suppress(NsmodelError):
        found = problem_of(model)
        rows = ca.Function("rows", [found.t, found.x, found.l], [found.rate, found.h], {"allow_free": True})
        return None if rows.get_free() else found
    return None


def state(run: Trajectory, problem: ContinuousProblem) -> np.ndarray | None:
    """The problem's x at all rows (N+1, n), NaN as 0: states, velocities, inputs; None where the run has others."""
    n = problem.states
    parts = [run.x, *([style.table(run, "v")] if problem.x.numel() - problem.held > n else [])]
    parts += [style.table(run, "inputs")] if problem.held else []
    if len(state_names(run)) != n or sum(part.shape[1] for part in parts) != problem.x.numel():
        return None
    return np.nan_to_num(np.hstack(parts))


def energy(run: Trajectory, model: Model | None) -> np.ndarray | None:
    """The energy at all rows (N+1,), from the states there; None where it is not known."""
    problem = continuous(model)
    if problem is None or "energy" not in problem.records or (x := state(run, problem)) is None:
        return None
    function = ca.Function("energy", [problem.t, problem.x], [problem.records["energy"]], {"allow_free": True})
    if function.get_free():
        return None
    return np.array(function.map(len(run.t))(run.t[None], x.T)).ravel()
