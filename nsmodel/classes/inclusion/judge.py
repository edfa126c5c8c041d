"""The schemes of an inclusion by their definitions, in NumPy."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.units import potential
from nsmodel.stress.measures import (
    EQUATION,
    LAW,
    PROBES,
    PROJECTION,
    ROUNDING,
    Misfits,
    begins,
    ends,
    evaluated,
    known_to,
    majorant,
    subgradient_misfit,
    worst_of,
)
from nsmodel.trajectory import Trajectory


def misfits(model: MonotoneInclusion, run: Trajectory) -> Misfits:
    """What the model's scheme asks of each step."""
    return {"catching-up": _catching_up, "implicit": _resolvent}[model.scheme](model, run)


def _catching_up(model: MonotoneInclusion, run: Trajectory) -> Misfits:
    """y = x + mu v with v in F(x) - S(x); x+ in C, not farther from y than any other row in C (by eps at most)."""
    x, new, h, v = run.x[:-1], run.x[1:], run.step[1:, None], run.v[1:]
    size = np.abs(x).max(axis=1, keepdims=True) + h * np.abs(v).max(axis=1, keepdims=True)
    here, asked = [model.t, model.x, model.u], [model.field, _signed(model), majorant(model.field), majorant(_signed(model))]
    field, S, *sizes = evaluated(here, asked, *begins(run))
    field, S = field[:, :, 0], S[:, :, 0]
    kinks = evaluated(here, [model.sign_arguments], *begins(run))[0][:, :, 0] if model.sign_symbols.numel() else np.ones_like(h)
    smooth = (kinks != 0).all(axis=1)[:, None]
    if model.potential_split is not None:
        found = {"selection": subgradient_misfit(potential(model.potential_split), model.x, x, field - v, size)}
    else:
        misfit = np.where(smooth, np.abs(field - S - v), 0.0)
        found = {"selection": worst_of(misfit, EQUATION * (np.abs(field) + np.abs(S)) + known_to(*sizes))}
    t_end, _, u_end = ends(run)
    lower, upper = (bound[:, :, 0] for bound in evaluated([model.t, model.u], [model.lower, model.upper], t_end, u_end))
    y, eps = x + h * v, run.tolerance[1:]
    unseen = ROUNDING * (np.abs(x) + h * np.abs(v))
    if not model.constraints and model.tolerances is None:
        return found | {"clip": worst_of(np.abs(new - np.clip(y, lower, upper)), EQUATION * np.abs(new - x) + unseen)}
    distance = ((new - y) ** 2).sum(axis=1)
    nearest = np.min([np.where(there, ((x - y) ** 2).sum(axis=1), np.inf) for x, there in _rivals(model, run)], axis=0)
    allowed = (PROJECTION * np.linalg.norm(new - x, axis=1)) ** 2 + eps.ravel() + ROUNDING * (distance + (unseen**2).sum(axis=1))
    return found | {"nearest": worst_of(np.maximum(distance - nearest, 0), allowed)}


def _resolvent(model: MonotoneInclusion, run: Trajectory) -> Misfits:
    """w = (x + h F(x) - x+)/h in T(x+): <w - S(z), x+ - z> >= 0 for z in C, other rows and probes beside x+ (Minty)."""
    x, new, h, symbols = run.x[:-1], run.x[1:], run.step[1:, None], [model.t, model.x, model.u]
    t_end, _, u_end = ends(run)
    field, size = evaluated(symbols, [model.field, majorant(model.field)], *begins(run))
    w = field[:, :, 0] + (x - new) / h
    S = _signed(model) if model.potential_split is None else ca.gradient(potential(model.potential_split), model.x)
    place = ROUNDING * (np.abs(x) + np.abs(new) + h * np.abs(field[:, :, 0]))  # what x+ is known to, beside a jump of S too
    unseen = known_to(size) + place / h + LAW * np.abs(field[:, :, 0])
    worst, near = 0.0, np.maximum(np.abs(new), np.abs(x)).max(axis=1, keepdims=True)
    probes = [new + s * p * near * e for e in np.eye(new.shape[1]) for p in PROBES for s in (1, -1)]
    for z, there in [*_rivals(model, run), *((z, _inside(model, run, z)) for z in probes)]:
        z = np.broadcast_to(z, new.shape)
        at, rounding = evaluated(symbols, [S, majorant(S)], t_end, z, u_end)
        away, other = new - z, at[:, :, 0]
        there = there & np.all(np.isfinite(other), axis=1)
        gap = np.where(there, np.maximum(-((w - other) * away).sum(axis=1), 0), 0.0)
        allowed = (np.abs(away) * (unseen + known_to(rounding) + LAW * (np.abs(w) + np.abs(other)))).sum(axis=1)
        allowed += (np.abs(w - other) * place).sum(axis=1)
        worst = max(worst, worst_of(gap[there], allowed[there]))
    return {"resolvent": worst}


def _rivals(model: MonotoneInclusion, run: Trajectory) -> list[tuple[np.ndarray, np.ndarray]]:
    """The rows of a run (n,), and in the sets of which steps they are (N,): in all of them where C stands still."""
    sides, steps = ca.vertcat(model.lower, model.upper, *model.constraints.values()), len(run.t) - 1
    if not ca.depends_on(sides, ca.vertcat(model.t, model.u)):
        return [(z, np.ones(steps, bool)) for z in run.x]
    return [(z, _inside(model, run, np.broadcast_to(z, (steps, z.size)))) for z in run.x]


def _inside(model: MonotoneInclusion, run: Trajectory, z: np.ndarray) -> np.ndarray:
    """Whether z (N, n) are in C at the end of each step (N,)."""
    rows, (t, _, u) = ca.vertcat(model.x - model.lower, model.upper - model.x, *model.constraints.values()), ends(run)
    return np.all(evaluated([model.t, model.x, model.u], [rows], t, z, u)[0][:, :, 0] >= 0, axis=1)


def acting(model: MonotoneInclusion, run: Trajectory) -> np.ndarray:
    """|x+ - x| and h |v|."""
    return np.abs(run.x[1:] - run.x[:-1]) + run.step[1:, None] * np.abs(run.v[1:])


def _signed(model: MonotoneInclusion) -> ca.SX:
    """S with sign(u) in place of its elements."""
    if not model.sign_symbols.numel():
        return model.operator
    return ca.substitute([model.operator], [model.sign_symbols], [ca.sign(model.sign_arguments)])[0]
