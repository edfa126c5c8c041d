"""The prediction-correction scheme in NumPy."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.stress.measures import EQUATION, LAW, PROJECTION, ROUNDING, Misfits, apply, evaluated, known_to, majorant, worst_of
from nsmodel.trajectory import Trajectory


def misfits(model: SweepingProcess, run: Trajectory) -> Misfits:
    """q+ = P_Qt(q + h f): q+ - q - h f = G'm with m >= 0, q+ in Qt; the distance to the projection is sqrt(<m, y>) at most."""
    t, q, new, h, m = run.t[:-1], run.x[:-1], run.x[1:], run.step[1:, None], run.multipliers[1:]
    f = _mean(model, t, q, h) if model.mean_forcing else evaluated([model.t, model.q], [model.f], t, q)[0][:, :, 0]
    here = [model.g, ca.jacobian(model.g, model.q), majorant(model.g)]
    g, G, size_g = evaluated([model.t, model.q], here, t + h[:, 0], q)
    g, moved = g[:, :, 0], new - q
    push = np.einsum("kij,ki->kj", G, m)
    size = np.abs(moved) + h * np.abs(f) + np.einsum("kij,ki->kj", np.abs(G), np.abs(m))
    place = ROUNDING * (np.abs(q) + np.abs(new)) + h * known_to(*evaluated([model.t, model.q], [majorant(model.f)], t, q))
    y = g + apply(G, moved)
    unseen = known_to(size_g) + ROUNDING * apply(np.abs(G), np.abs(q) + np.abs(new) + size)
    reach = np.linalg.norm(moved, axis=1) + h[:, 0] * np.linalg.norm(f, axis=1)
    gap = (np.maximum(m, 0) * np.maximum(y, 0)).sum(axis=1)
    return {
        "equation": worst_of(np.abs(moved - h * f - push), EQUATION * size + place),
        "no pull": worst_of(np.maximum(-m, 0), LAW * np.abs(m).max(axis=1, initial=0.0)[:, None]),
        "no overlap": worst_of(np.maximum(-y, 0), LAW * apply(np.abs(G), size) + unseen),
        "projection": worst_of(gap, (PROJECTION * reach) ** 2 + (np.abs(m) * unseen).sum(axis=1)),
    }


def acting(model: SweepingProcess, run: Trajectory) -> np.ndarray:
    """|q+ - q|, h |f| and |G'm|."""
    h, moved = run.step[1:, None], np.abs(run.x[1:] - run.x[:-1])
    f, G = evaluated([model.t, model.q], [model.f, ca.jacobian(model.g, model.q)], run.t[:-1], run.x[:-1])
    return moved + h * np.abs(f[:, :, 0]) + np.einsum("kij,ki->kj", np.abs(G), np.abs(run.multipliers[1:]))


def _mean(model: SweepingProcess, t: np.ndarray, q: np.ndarray, h: np.ndarray) -> np.ndarray:
    nodes, weights = np.polynomial.legendre.leggauss(8)
    times = (t + h[:, 0] * (1 + x) / 2 for x in nodes)
    values = [evaluated([model.t, model.q], [model.f], s, q)[0][:, :, 0] for s in times]
    return np.einsum("i,ikj->kj", weights / 2, values)
