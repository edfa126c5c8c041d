"""The catching-up scheme in NumPy."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.units import potential
from nsmodel.stress.measures import (
    EQUATION,
    PROJECTION,
    ROUNDING,
    Misfits,
    evaluated,
    known_to,
    majorant,
    subgradient_misfit,
    worst_of,
)
from nsmodel.trajectory import Trajectory


def misfits(model: MonotoneInclusion, run: Trajectory) -> Misfits:
    """y = x + mu v with v in F(x) - S(x); x+ in C, not farther from y than any other row of the run (by eps at most)."""
    x, new, h, v = run.x[:-1], run.x[1:], run.step[1:, None], run.v[1:]
    size = np.abs(x).max(axis=1, keepdims=True) + h * np.abs(v).max(axis=1, keepdims=True)
    asked = [model.field, _signed(model), majorant(model.field), majorant(_signed(model))]
    field, S, *sizes = evaluated([model.x], asked, x)
    field, S = field[:, :, 0], S[:, :, 0]
    kinks = evaluated([model.x], [model.sign_arguments], x)[0][:, :, 0] if model.sign_symbols.numel() else np.ones((len(x), 1))
    smooth = (kinks != 0).all(axis=1)[:, None]
    if model.potential_split is not None:
        found = {"selection": subgradient_misfit(potential(model.potential_split), model.x, x, field - v, size)}
    else:
        misfit = np.where(smooth, np.abs(field - S - v), 0.0)
        found = {"selection": worst_of(misfit, EQUATION * (np.abs(field) + np.abs(S)) + known_to(*sizes))}
    lower, upper = (np.array(ca.DM(b)).ravel() for b in (model.lower, model.upper))
    y, eps = x + h * v, run.tolerance[1:]
    unseen = ROUNDING * (np.abs(x) + h * np.abs(v))
    if not model.constraints and model.tolerances is None:
        return found | {"clip": worst_of(np.abs(new - np.clip(y, lower, upper)), EQUATION * np.abs(new - x) + unseen)}
    others = [run.x[k] for k in range(len(run.t))]
    distance = ((new - y) ** 2).sum(axis=1)
    nearest = np.min([((other - y) ** 2).sum(axis=1) for other in others], axis=0)
    allowed = (PROJECTION * np.linalg.norm(new - x, axis=1)) ** 2 + eps.ravel() + ROUNDING * (distance + (unseen**2).sum(axis=1))
    return found | {"nearest": worst_of(np.maximum(distance - nearest, 0), allowed)}


def acting(model: MonotoneInclusion, run: Trajectory) -> np.ndarray:
    """|x+ - x| and h |v|."""
    return np.abs(run.x[1:] - run.x[:-1]) + run.step[1:, None] * np.abs(run.v[1:])


def _signed(model: MonotoneInclusion) -> ca.SX:
    """S with sign(u) in place of its elements."""
    if not model.sign_symbols.numel():
        return model.operator
    return ca.substitute([model.operator], [model.sign_symbols], [ca.sign(model.sign_arguments)])[0]
