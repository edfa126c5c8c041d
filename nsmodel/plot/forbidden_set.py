"""Pictures of sweeping processes: where the state is, and where it may not be."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from nsmodel.errors import PlotError
from nsmodel.event_driven import dense_output
from nsmodel.plot import plane, style
from nsmodel.plot.plane import draw_discs
from nsmodel.simulation.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def panels(run: Trajectory, model: Any) -> dict[str, tuple[float, Callable[..., Axes]]]:
    """What its sheets have beside those of all runs: height, and what draws it."""
    known = run.metadata.get("scene") or (model is not None and run.x.shape[1] <= 2)
    return {"configuration": (3.6, partial(configuration, run, model))} if known else {}


def configuration(run: Trajectory, model: Any, row: int = -1, ax: Axes | None = None) -> Axes:
    """Draw the scene, or the forbidden set of one or two states."""
    n, rows, scene = run.x.shape[1], len(run.t), run.metadata.get("scene")
    if not -rows <= row < rows:
        raise PlotError(f"row {row} does not exist: this run has rows 0 to {rows - 1}")
    if not scene and n > 2:
        raise PlotError(f"a configuration needs one state, two states, or a scene of discs; this run has {n} and no scene")
    if not scene and model is None:
        raise PlotError("the forbidden set is drawn from the constraints: give the model as well")
    row %= rows
    if scene:
        return draw_discs(style.get_axes(ax, 7, 6.5), run, scene, row)
    least, moving = gap(model, run)
    if n == 1:
        return plane.draw_time_plane(style.get_axes(ax, 8, 5), run, least, row)
    return plane.draw_state_plane(style.get_axes(ax, 7, 6.5), run, least, row, moving=moving)


def gap(model: Any, run: Trajectory) -> tuple[plane.GapFunction, bool]:
    """min_i g_i(t, q, u(t)) on many points at once, negative where q is forbidden; and whether it moves with t."""
    n, stack = run.x.shape[1], ca.vertcat(ca.SX.inf(1), *model.constraints.values())
    if model.q.numel() != n:
        raise PlotError(f"the model has {model.q.numel()} states and the run {n}: they do not belong together")
    free = [s.name() for s in ca.symvar(stack) if not ca.depends_on(ca.vertcat(model.t, model.u, ca.vec(model.q)), s)]
    if free:
        raise PlotError(f"the constraints still hold {', '.join(free)}: bind the parameters to numbers first")
    function = ca.Function("g", [model.t, model.q, model.u], [ca.mmin(stack)])

    def least(t: np.ndarray | float, *q: np.ndarray) -> np.ndarray:
        times = np.broadcast_to(t, q[0].shape).reshape(1, -1)
        u = dense_output.inputs_at(run.arrays, times[0]).T if model.u.numel() else np.zeros((0, times.size))
        values = function.map(times.size)(times, np.stack([part.ravel() for part in q]), u)
        return np.ma.masked_invalid(np.array(values).reshape(q[0].shape))

    return least, ca.depends_on(stack, ca.vertcat(model.t, model.u))
