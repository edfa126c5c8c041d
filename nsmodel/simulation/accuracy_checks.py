"""What a small state is measured beside under error control: states of one symbol, or those that one cone pushes.

A cone that acts on accelerations alone holds v by positions, in the mean of a step: along its surface, of curvature k, v is off
by the part theta = k |v| h of |v|, and by tolerance/theta, as y is by the tolerance. A v_i that begins at 0 is off by all of
itself in a first step of any length: what it is measured beside is the part sqrt(tolerance)/(2 rtol) of |v|, which asks for
steps of about theta = sqrt(tolerance), where both are least. |v| is the largest v_i/unit_i, unit_i how far an impulse moves
v_i.

What whole and half steps do not see: a path that turns back inside a step whose index set stays; both agree, and err alike.

A row that is held, and does not depend on a held l directly, has in l_i the mean of a half step (with a theta, its value
there), where nothing is carried (gamma = 1). On the line through both l_i leaves K before the step ends by a part o of
their difference d: it should have let go. What has bent the path by b, |x_fine - 2 x_half + x| in units of what is
allowed, has moved it o^2 b/2 too far, and so has l_i, too large by o d/2 in the mean for the part o of a half step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.modeling.base import Model
from nsmodel.modeling.expressions import derivatives
from nsmodel.solvers.impacts import ImpactRow
from nsmodel.solvers.one_step_problem import OneStepProblem
from nsmodel.solvers.residuals import numeric_law
from nsmodel.solvers.step import UNSET_INDEX, RowRecord

NEGLIGIBLE_STATE_SHARE = 1e-6  # A state that stays below this part of the largest of its symbol is measured beside that.


class ErrorScale(NamedTuple):
    """States ``at`` (k,), which are measured beside ``part`` of the largest of them, in ``unit`` (k,)."""

    at: np.ndarray
    part: float
    unit: np.ndarray

    def apply_floor(self, size: np.ndarray) -> np.ndarray:
        """The sizes (..., k) of its states, none below what it is measured beside."""
        return np.maximum(size, self.part * self.unit * (size / self.unit).max(axis=-1, keepdims=True))


def error_scale_groups(
    symbols: Sequence[np.ndarray], cones: Sequence[ImpactRow], tolerance: float, rtol: float
) -> list[ErrorScale]:
    """Return the groups of states, each state in one at most.

    Args:
        symbols: the states of each symbol.
        cones: those that call for impulses.
        tolerance: of a step; rtol: of the run.
    """
    part = max(NEGLIGIBLE_STATE_SHARE, min(1.0, math.sqrt(tolerance) / (2 * rtol)) if rtol else 1.0)
    found, taken = [], np.zeros(0, int)
    for cone in cones:
        at = np.setdiff1d(np.flatnonzero(cone.pushed), taken)
        found.append(ErrorScale(at, part, cone.pushed[at]))
        taken = np.append(taken, at)
    rest = [np.setdiff1d(symbol, taken) for symbol in symbols]
    return [
        group for group in (*found, *(ErrorScale(at, NEGLIGIBLE_STATE_SHARE, np.ones(at.size)) for at in rest)) if group.at.size
    ]


def turning_point_warnings(
    problem: OneStepProblem, model: Model, record: RowRecord, watched: np.ndarray, allowed: Callable[[np.ndarray], np.ndarray]
) -> list[str]:
    """A warning where the state of such a step is off by more than is allowed; ``allowed``: of each x_i, by its largest size."""
    layout, filled, law = record.layout, record.filled, numeric_law(problem.law)
    if problem.start is not None or not law.size or filled < 3:
        return []
    rows, index = record.rows[:filled], record.index[:filled, : law.size]
    start, half, fine = slice(0, -2, 2), slice(1, -1, 2), slice(2, None, 2)
    held = (index[half] == 0) & (index[fine] == 0) & np.isin(index[start], (0, UNSET_INDEX))
    free = held.copy()
    for i, j in zip(*problem.jacobians[3].sparsity().get_triplet(), strict=True):
        free[:, i] &= ~held[:, j]
    step = rows[fine, layout.l] - rows[half, layout.l]
    theta = (model.weights or (0.5, 1.0))[0]
    end = rows[fine, layout.l] + (1 - theta) * step
    outside = np.maximum(law.lower - end, end - law.upper)
    part = np.divide(outside, np.abs(step), out=np.zeros_like(step), where=free & (outside > 0))
    at = np.flatnonzero(part.any(axis=1))
    if not at.size:
        return []
    x = rows[:, watched]
    most = allowed(np.abs(x).max(axis=0))
    off = part[at].max(axis=1, keepdims=True) ** 2 / 2 * np.abs(x[fine] - 2 * x[half] + x[start])[at]
    n, late = len(model.names), part[at] ** 2 / 2 * np.abs(step[at])
    off[:, :n] = np.maximum(off[:, :n], _multiplier_displacement(problem, model, record, 2 * at + 1, late))
    error = np.divide(off, most, out=np.zeros_like(off), where=most > 0).max(axis=1)
    found = np.flatnonzero(error > 1)
    if not found.size:
        return []
    return [
        f"the path turned back inside {found.size} step{'s' if found.size > 1 else ''}, first before "
        f"t = {record.t[2 * at[found[0]] + 2]:.6g}, unseen by whole and half steps: off by about {error.max():.2g} "
        "times what rtol allows; compare with constant steps"
    ]


def _multiplier_displacement(
    problem: OneStepProblem, model: Model, record: RowRecord, at: np.ndarray, l: np.ndarray
) -> np.ndarray:
    """How far multipliers l (k, m) >= 0 move the model's state (k, n) at the end of the step from each of k rows."""
    p, layout, x = problem, record.layout, problem.next_state[: len(model.names)]
    parts = [*p.jacobians[:2], derivatives(x, p.z), derivatives(x, p.l)]
    of = ca.Function("push", [p.t, p.h, p.state, p.l], ca.substitute(parts, [p.z], [p.guess]))
    moved, h = np.zeros((len(at), x.numel())), np.diff(record.t[: record.filled])
    for row, k, own in zip(moved, at, l, strict=True):
        E_z, E_l, x_z, x_l = of(record.t[k], h[k], record.rows[k, layout.state], record.rows[k + 1, layout.l])
        some = np.flatnonzero(own).tolist()
        push = x_l[:, some] - x_z @ ca.solve(E_z, E_l[:, some])
        row[:] = np.abs(np.array(ca.densify(push))) @ own[some]
    return moved
