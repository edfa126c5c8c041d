"""The inertial proximal scheme in NumPy: a step is a minimum.

The class in other units.

What a step of an oscillator starts from, at any row of a run.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.models.friction_oscillator.model import FrictionOscillator
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.study.reference_steps import (
    EQUATION_TOLERANCE,
    EVALUATION_ROUNDING,
    PROBE_LENGTHS,
    ReferenceStep,
    StepResiduals,
    evaluate_at_rows,
    majorant,
    rounding_allowance,
    step_ends,
    worst_ratio,
)
from nsmodel.study.units import substitute_pairs


def residuals(model: FrictionOscillator, run: Trajectory) -> StepResiduals:
    """v+ minimises J(v) = |v - w|^2/2 + h (Phi(v) + <v, M v>/2 - <v, f>) + g(x + h v), M symmetric, w the last velocity.

    f is the force at the end of the step. Of a matrix M the skew part enters as the constant force M v+ that it is at the answer.
    """
    first = 1 if model.x1 is not None else 0
    x, w, v, h = run.x[first:-1], run.v[first:-1], run.v[first + 1 :], run.step[first + 1 :]
    if first and len(h):
        w = np.concatenate([(run.x[1:2] - run.x[:1]) / h[0], run.v[2:-1]])
    V = ca.SX.sym("V", x.shape[1])
    phi = sum((ca.substitute(e.theta, model.s, ca.norm_2(e.H @ V)) for e in model.elements), ca.SX(0))
    M = np.zeros((x.shape[1],) * 2) if model.damping is None else np.array(ca.DM(model.damping))
    even, odd = (M + M.T) / 2, (M - M.T) / 2
    c = ca.vertcat(ca.SX(0, 1), *model.constraints.values())

    sizes, (t, _, inputs) = majorant(model.potential), (column[first:] for column in step_ends(run))
    force = _end_force(model, run)[first:]

    def terms(V_: np.ndarray) -> np.ndarray:
        place = x + h[:, None] * V_
        friction, g, rows = evaluate_at_rows([V, model.x, model.t, model.u], [phi, model.potential, c], V_, place, t, inputs)
        friction = np.where((V_ == 0).all(axis=1), 0.0, friction[:, 0, 0]) - at_rest
        linear = h * (
            0.5 * np.einsum("ki,ij,kj->k", V_, even, V_) + np.einsum("ki,ij,kj->k", V_, odd, v) - (V_ * force).sum(axis=1)
        )
        seen = np.where((rows[:, :, 0] < 0).any(axis=1), np.inf, g[:, 0, 0])
        return np.stack([0.5 * ((V_ - w) ** 2).sum(axis=1), h * friction, linear, seen])

    still = sum((ca.substitute(e.theta, model.s, 0) for e in model.elements), ca.SX(0))
    at_rest = evaluate_at_rows([model.t, model.u], [still], t, inputs)[0][:, 0, 0]
    J = terms(v)
    J[3] = evaluate_at_rows([model.x], [model.potential], x + h[:, None] * v)[0][:, 0, 0]  # constraints may be met up to rounding
    speed = np.maximum(np.linalg.norm(v, axis=1), np.linalg.norm(w, axis=1))[:, None]
    probes = [
        np.zeros_like(v),
        w,
        *(v + s * size * speed * e for e in np.eye(v.shape[1]) for size in PROBE_LENGTHS for s in (1, -1)),
    ]
    worst = 0.0
    for probe in probes:
        other = terms(probe)
        # J is strongly convex: another velocity costs |probe - v|^2/2 more.
        better = J.sum(axis=0) - other.sum(axis=0) + 0.5 * (1 - 1e-6) * ((probe - v) ** 2).sum(axis=1)
        size = np.abs(J).sum(axis=0) + np.where(np.isfinite(other), np.abs(other), 0).sum(axis=0)
        inside = rounding_allowance(*(evaluate_at_rows([model.x], [sizes], x + h[:, None] * V_)[0] for V_ in (v, probe)))[:, 0]
        worst = max(worst, worst_ratio(np.maximum(better, 0), EVALUATION_ROUNDING * size + inside))
    moved = np.abs(run.x[first + 1 :] - x - h[:, None] * v)
    place = EQUATION_TOLERANCE * h[:, None] * np.abs(v) + EVALUATION_ROUNDING * (np.abs(x) + np.abs(run.x[first + 1 :]))
    return {"equation": worst_ratio(moved, place), "minimum": worst}


def acting(model: FrictionOscillator, run: Trajectory) -> np.ndarray:
    """|x+ - x| and h^2 (|grad g| + |f|)."""
    h, moved = run.step[1:, None], np.abs(run.x[1:] - run.x[:-1])
    (force,) = evaluate_at_rows([model.x], [ca.gradient(model.potential, model.x)], run.x[1:])
    return moved + h**2 * (np.nan_to_num(np.abs(force[:, :, 0]), posinf=0.0) + np.abs(_end_force(model, run)))


def _end_force(model: FrictionOscillator, run: Trajectory) -> np.ndarray:
    """The force at the end of each step (N, n)."""
    t, _, u = step_ends(run)
    return evaluate_at_rows([model.t, model.u], [model.force], t, u)[0][:, :, 0]


def in_units(model: FrictionOscillator, u: float, tau: float, common: dict[str, Any]) -> FrictionOscillator:
    """States u times and times tau times as large."""
    t, x = (model.t, model.t / tau), (model.x, model.x / u)
    friction = {e.name: (e.H, u**2 / tau**3 * substitute_pairs(e.theta, (model.s, model.s * tau / u), t)) for e in model.elements}
    start: dict[str, Any] = {"v0": u / tau * ca.DM(model.v0)} if model.x1 is None else {"x1": u * ca.DM(model.x1)}
    return FrictionOscillator(
        x=model.x, x0=u * ca.DM(model.x0), potential=(u / tau) ** 2 * substitute_pairs(model.potential, x), friction=friction,
        s=model.s,
        damping=None if model.damping is None else model.damping / tau, force=u / tau**2 * substitute_pairs(model.force, t),
        constraints={name: u * substitute_pairs(c, x) for name, c in model.constraints.items()}, **start, **common,
    )  # fmt: skip


def states(model: FrictionOscillator, run: Trajectory, start: np.ndarray) -> Callable[[int, float], np.ndarray]:
    """(row, h) -> x and the difference h v, the older position that the velocity gives for this step; with a force x and v."""
    return lambda row, h: np.concatenate([run.x[row], (1.0 if model.keeps_velocity else h) * run.v[row]])


REFERENCE_STEP = ReferenceStep(
    residuals=residuals,
    acting=acting,
    in_units=in_units,
    states_before_step=states,
)
