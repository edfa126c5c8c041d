"""The schemes of an inclusion by their definitions, in NumPy.

The class in other units.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from nsmodel.models.monotone_inclusion.model import MonotoneInclusion
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.study.reference_steps import (
    EQUATION_TOLERANCE,
    EVALUATION_ROUNDING,
    LAW_TOLERANCE,
    PROBE_LENGTHS,
    PROJECTION_TOLERANCE,
    ReferenceStep,
    StepResiduals,
    evaluate_at_rows,
    majorant,
    rounding_allowance,
    step_begins,
    step_ends,
    subgradient_residual,
    worst_ratio,
)
from nsmodel.study.units import potential_expression, scaled_tolerances, substitute_pairs


def residuals(model: MonotoneInclusion, run: Trajectory) -> StepResiduals:
    """What the model's scheme asks of each step."""
    return {"catching-up": _catching_up_residuals, "implicit": _resolvent_residuals}[model.scheme](model, run)


def _catching_up_residuals(model: MonotoneInclusion, run: Trajectory) -> StepResiduals:
    """y = x + mu v with v in F(x) - S(x); x+ in C, not farther from y than any other row in C (by eps at most)."""
    x, new, h, v = run.x[:-1], run.x[1:], run.step[1:, None], run.v[1:]
    size = np.abs(x).max(axis=1, keepdims=True) + h * np.abs(v).max(axis=1, keepdims=True)
    here, expressions = (
        [model.t, model.x, model.u],
        [model.field, _operator_with_signs(model), majorant(model.field), majorant(_operator_with_signs(model))],
    )
    field, S, *sizes = evaluate_at_rows(here, expressions, *step_begins(run))
    field, S = field[:, :, 0], S[:, :, 0]
    kinks = (
        evaluate_at_rows(here, [model.sign_arguments], *step_begins(run))[0][:, :, 0]
        if model.sign_symbols.numel()
        else np.ones_like(h)
    )
    smooth = (kinks != 0).all(axis=1)[:, None]
    if model.potential_split is not None:
        found = {"selection": subgradient_residual(potential_expression(model.potential_split), model.x, x, field - v, size)}
    else:
        residual = np.where(smooth, np.abs(field - S - v), 0.0)
        found = {
            "selection": worst_ratio(residual, EQUATION_TOLERANCE * (np.abs(field) + np.abs(S)) + rounding_allowance(*sizes))
        }
    t_end, _, u_end = step_ends(run)
    lower, upper = (bound[:, :, 0] for bound in evaluate_at_rows([model.t, model.u], [model.lower, model.upper], t_end, u_end))
    y, eps = x + h * v, run.tolerance[1:]
    unseen = EVALUATION_ROUNDING * (np.abs(x) + h * np.abs(v))
    if not model.constraints and model.tolerances is None:
        return found | {
            "clip": worst_ratio(np.abs(new - np.clip(y, lower, upper)), EQUATION_TOLERANCE * np.abs(new - x) + unseen)
        }
    distance = ((new - y) ** 2).sum(axis=1)
    nearest = np.min(
        [np.where(in_set, ((x - y) ** 2).sum(axis=1), np.inf) for x, in_set in _comparison_points(model, run)], axis=0
    )
    allowed = (
        (PROJECTION_TOLERANCE * np.linalg.norm(new - x, axis=1)) ** 2
        + eps.ravel()
        + EVALUATION_ROUNDING * (distance + (unseen**2).sum(axis=1))
    )
    return found | {"nearest": worst_ratio(np.maximum(distance - nearest, 0), allowed)}


def _resolvent_residuals(model: MonotoneInclusion, run: Trajectory) -> StepResiduals:
    """w = (x + h F(x) - x+)/h in T(x+): <w - S(z), x+ - z> >= 0 for z in C, other rows and probes beside x+ (Minty)."""
    x, new, h, symbols = run.x[:-1], run.x[1:], run.step[1:, None], [model.t, model.x, model.u]
    t_end, _, u_end = step_ends(run)
    field, size = evaluate_at_rows(symbols, [model.field, majorant(model.field)], *step_begins(run))
    w = field[:, :, 0] + (x - new) / h
    S = (
        _operator_with_signs(model)
        if model.potential_split is None
        else ca.gradient(potential_expression(model.potential_split), model.x)
    )
    place = EVALUATION_ROUNDING * (
        np.abs(x) + np.abs(new) + h * np.abs(field[:, :, 0])
    )  # what x+ is known to, beside a jump of S too
    unseen = rounding_allowance(size) + place / h + LAW_TOLERANCE * np.abs(field[:, :, 0])
    worst, near = 0.0, np.maximum(np.abs(new), np.abs(x)).max(axis=1, keepdims=True)
    probes = [new + s * p * near * e for e in np.eye(new.shape[1]) for p in PROBE_LENGTHS for s in (1, -1)]
    for z, in_set in [*_comparison_points(model, run), *((z, _points_in_set(model, run, z)) for z in probes)]:
        z = np.broadcast_to(z, new.shape)
        at, rounding = evaluate_at_rows(symbols, [S, majorant(S)], t_end, z, u_end)
        away, other = new - z, at[:, :, 0]
        in_set = in_set & np.all(np.isfinite(other), axis=1)
        gap = np.where(in_set, np.maximum(-((w - other) * away).sum(axis=1), 0), 0.0)
        allowed = (np.abs(away) * (unseen + rounding_allowance(rounding) + LAW_TOLERANCE * (np.abs(w) + np.abs(other)))).sum(
            axis=1
        )
        allowed += (np.abs(w - other) * place).sum(axis=1)
        worst = max(worst, worst_ratio(gap[in_set], allowed[in_set]))
    return {"resolvent": worst}


def _comparison_points(model: MonotoneInclusion, run: Trajectory) -> list[tuple[np.ndarray, np.ndarray]]:
    """The rows of a run (n,), and in the sets of which steps they are (N,): in all of them where C stands still."""
    sides, steps = ca.vertcat(model.lower, model.upper, *model.constraints.values()), len(run.t) - 1
    if not ca.depends_on(sides, ca.vertcat(model.t, model.u)):
        return [(z, np.ones(steps, bool)) for z in run.x]
    return [(z, _points_in_set(model, run, np.broadcast_to(z, (steps, z.size)))) for z in run.x]


def _points_in_set(model: MonotoneInclusion, run: Trajectory, z: np.ndarray) -> np.ndarray:
    """Whether z (N, n) are in C at the end of each step (N,)."""
    rows, (t, _, u) = ca.vertcat(model.x - model.lower, model.upper - model.x, *model.constraints.values()), step_ends(run)
    return np.all(evaluate_at_rows([model.t, model.x, model.u], [rows], t, z, u)[0][:, :, 0] >= 0, axis=1)


def acting(model: MonotoneInclusion, run: Trajectory) -> np.ndarray:
    """|x+ - x| and h |v|."""
    return np.abs(run.x[1:] - run.x[:-1]) + run.step[1:, None] * np.abs(run.v[1:])


def _operator_with_signs(model: MonotoneInclusion) -> ca.SX:
    """S with sign(u) in place of its elements."""
    if not model.sign_symbols.numel():
        return model.operator
    return ca.substitute([model.operator], [model.sign_symbols], [ca.sign(model.sign_arguments)])[0]


def in_units(model: MonotoneInclusion, u: float, tau: float, common: dict[str, Any]) -> MonotoneInclusion:
    """States u times and times tau times as large."""
    x = (model.x, model.x / u), (model.t, model.t / tau)
    if model.potential_split is None:
        signs = ca.substitute([model.operator], [model.sign_symbols], [ca.sign(model.sign_arguments)])[0]
        nonlinear: dict[str, Any] = {
            "operator": u / tau * substitute_pairs(signs if model.sign_symbols.numel() else model.operator, *x)
        }
    else:
        nonlinear = {"phi": u**2 / tau * substitute_pairs(potential_expression(model.potential_split), *x)}
    return MonotoneInclusion(
        x=model.x, x0=u * ca.DM(model.x0), field=u / tau * substitute_pairs(model.field, *x),
        lower=u * substitute_pairs(model.lower, *x), upper=u * substitute_pairs(model.upper, *x),
        constraints={name: u * substitute_pairs(c, *x) for name, c in model.constraints.items()},
        tolerances=scaled_tolerances(model.tolerances, u, tau), **nonlinear, **common,
    )  # fmt: skip


REFERENCE_STEP = ReferenceStep(residuals=residuals, acting=acting, in_units=in_units)
