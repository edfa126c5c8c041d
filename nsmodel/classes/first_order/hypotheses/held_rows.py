"""Multipliers that are at a bound in every step from a state of the region, as their y has one sign there and where it leads."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from nsmodel.classes.first_order.hypotheses.linearised import SystemLinearisation, system_jacobians
from nsmodel.modeling.laws import Law, box, product
from nsmodel.modeling.laws.base import Intervals, SecondOrder
from nsmodel.proof import exact, interval_bounds

HELD_ROUNDS = 3  # With fewer multipliers more signs show.


def substitute_held_rows(at: SystemLinearisation) -> SystemLinearisation:
    """The system with the held multipliers put in; all of them held: x' = theta f + gamma g with theta = 1."""
    for _ in range(HELD_ROUNDS):
        held = _held_values(at)
        if np.isnan(held).all():
            break
        at = _substitute_held(at, held)
    return at


def _held_values(at: SystemLinearisation) -> np.ndarray:
    """The values (m,) of the held multipliers, NaN of the others."""
    out, place, around = np.full(at.model.law.size, np.nan), 0, _reachable_box(at)
    if around is None:
        return out
    low, high = (end.ravel() for end in interval_bounds.enclose(at.model.h, at.z, *around))
    for block in at.model.law.blocks:
        own = slice(place, place + block.size)
        place += block.size
        shape = block.shape()
        if isinstance(shape, Intervals):
            bottom, top = shape
            value = np.where(low[own] > 0, bottom, np.where(high[own] < 0, top, np.nan))
            out[own] = np.where(np.isfinite(value), value, np.nan)
        elif isinstance(shape, SecondOrder):
            across = np.maximum(np.abs(low[own]), np.abs(high[own]))[1:]
            if low[own][0] > 1.001 * np.linalg.norm(across):
                out[own] = 0.0
    return out


def _reachable_box(at: SystemLinearisation) -> tuple[np.ndarray, np.ndarray] | None:
    """A box of (t, x, l) into which each step from a state of the region leads, f and g being continued beyond it."""
    n, h, inverse = len(at.model.names), float(at.steps.max()), exact.inverse_matrix(at.M)
    if inverse is None:
        return None
    lower, upper = at.lower.copy(), at.upper.copy()
    lower[0] = min(lower[0] + at.steps.min(), at.upper[0])
    for widening in (2.0, 1.0):
        force = [np.abs(end).ravel() for e in (at.model.f, at.model.g) for end in interval_bounds.enclose(e, at.z, lower, upper)]
        if not np.isfinite(force).all():
            return None
        reach = 1.001 * widening * h * np.abs(exact.doubles(inverse)) @ (np.maximum(*force[:2]) + np.maximum(*force[2:]))
        low, high = at.lower[1 : n + 1] - reach, at.upper[1 : n + 1] + reach
        if widening == 1 and ((low < lower[1 : n + 1]) | (high > upper[1 : n + 1])).any():
            return None
        if widening > 1:
            lower[1 : n + 1], upper[1 : n + 1] = low, high
    return lower, upper


def _substitute_held(at: SystemLinearisation, held: np.ndarray) -> SystemLinearisation:
    model, n, left = at.model, len(at.model.names), np.isnan(held)
    lam = ca.vertsplit(model.lam)
    known = [lam[i] for i in np.flatnonzero(~left)], [ca.SX(float(held[i])) for i in np.flatnonzero(~left)]
    h, g = ca.substitute([model.h, model.g], *known)
    kept, place = [], 0
    for block in model.law.blocks:
        own = np.flatnonzero(left[place : place + block.size])
        place += block.size
        shape = block.shape()
        if isinstance(shape, Intervals) and own.size:
            bottom, top = shape
            kept.append(box(bottom[own], top[own]))
        elif own.size:
            kept.append(Law((block,)))
    rows = [int(i) for i in np.flatnonzero(left)]
    given = {"lam": ca.vertcat(*(lam[i] for i in rows)), "h": h[rows], "g": g, "law": product(*kept), "lam0": model.lam0[rows]}
    if not rows:
        given = dict.fromkeys(given) | {"f": model.theta * model.f + model.gamma * g, "theta": 1.0}
    model = replace(model, **given)
    columns = [*range(1 + n), *(1 + n + i for i in rows)]
    names = tuple(at.names[i] for i in columns)
    return replace(
        at, model=model, jacobians=system_jacobians(model), z=ca.vertcat(model.t, model.x, model.lam), names=names,
        lower=at.lower[columns], upper=at.upper[columns], points=at.points[:, columns],
        boxed=tuple(name for name in at.boxed if name in names),
    )  # fmt: skip
