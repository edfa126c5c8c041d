"""The prediction-correction scheme in NumPy.

The class in other units.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from nsmodel.models.sweeping_process.model import SweepingProcess
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.study.reference_steps import (
    EQUATION_TOLERANCE,
    EVALUATION_ROUNDING,
    LAW_TOLERANCE,
    PROJECTION_TOLERANCE,
    ReferenceStep,
    StepResiduals,
    apply_matrices,
    evaluate_at_rows,
    majorant,
    rounding_allowance,
    step_begins,
    step_ends,
    worst_ratio,
)
from nsmodel.study.units import substitute_pairs


def residuals(model: SweepingProcess, run: Trajectory) -> StepResiduals:
    """q+ = P_Qt(q + h f): q+ - q - h f = G'm with m >= 0, q+ in Qt; the distance to the projection is sqrt(<m, y>) at most."""
    here, new, h, m = step_begins(run), run.x[1:], run.step[1:, None], run.multipliers[1:]
    (t, q, _), (*_, u_end), symbols = here, step_ends(run), [model.t, model.q, model.u]
    f = _mean_velocity_of_steps(model, run) if model.mean_forcing else evaluate_at_rows(symbols, [model.f], *here)[0][:, :, 0]
    requested = [model.g, ca.jacobian(model.g, model.q), majorant(model.g)]
    g, G, size_g = evaluate_at_rows(symbols, requested, t + h[:, 0], q, u_end)
    g, moved = g[:, :, 0], new - q
    push = np.einsum("kij,ki->kj", G, m)
    size = np.abs(moved) + h * np.abs(f) + np.einsum("kij,ki->kj", np.abs(G), np.abs(m))
    place = EVALUATION_ROUNDING * (np.abs(q) + np.abs(new)) + h * rounding_allowance(
        *evaluate_at_rows(symbols, [majorant(model.f)], *here)
    )
    y = g + apply_matrices(G, moved)
    unseen = rounding_allowance(size_g) + EVALUATION_ROUNDING * apply_matrices(np.abs(G), np.abs(q) + np.abs(new) + size)
    reach = np.linalg.norm(moved, axis=1) + h[:, 0] * np.linalg.norm(f, axis=1)
    gap = (np.maximum(m, 0) * np.maximum(y, 0)).sum(axis=1)
    return {
        "equation": worst_ratio(np.abs(moved - h * f - push), EQUATION_TOLERANCE * size + place),
        "no pull": worst_ratio(np.maximum(-m, 0), LAW_TOLERANCE * np.abs(m).max(axis=1, initial=0.0)[:, None]),
        "no overlap": worst_ratio(np.maximum(-y, 0), LAW_TOLERANCE * apply_matrices(np.abs(G), size) + unseen),
        "projection": worst_ratio(gap, (PROJECTION_TOLERANCE * reach) ** 2 + (np.abs(m) * unseen).sum(axis=1)),
    }


def acting(model: SweepingProcess, run: Trajectory) -> np.ndarray:
    """|q+ - q|, h |f| and |G'm|."""
    h, moved = run.step[1:, None], np.abs(run.x[1:] - run.x[:-1])
    f, G = evaluate_at_rows([model.t, model.q, model.u], [model.f, ca.jacobian(model.g, model.q)], *step_begins(run))
    return moved + h * np.abs(f[:, :, 0]) + np.einsum("kij,ki->kj", np.abs(G), np.abs(run.multipliers[1:]))


def _mean_velocity_of_steps(model: SweepingProcess, run: Trajectory) -> np.ndarray:
    """Of f over each step, its inputs on straight lines."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    (t, q, u), (*_, u_end), h = step_begins(run), step_ends(run), run.step[1:]
    places = ((t + h * part, q, u + part * (u_end - u)) for part in (1 + nodes) / 2)
    values = [evaluate_at_rows([model.t, model.q, model.u], [model.f], *place)[0][:, :, 0] for place in places]
    return np.einsum("i,ikj->kj", weights / 2, values)


def in_units(model: SweepingProcess, u: float, tau: float, common: dict[str, Any]) -> SweepingProcess:
    """States u times and times tau times as large."""
    t, q = (model.t, model.t / tau), (model.q, model.q / u)
    constraints = {name: u * substitute_pairs(g, t, q) for name, g in model.constraints.items()}
    return SweepingProcess(
        q=model.q, f=u / tau * substitute_pairs(model.f, t, q), constraints=constraints, q0=u * ca.DM(model.q0),
        mean_forcing=model.mean_forcing, **common,
    )  # fmt: skip


REFERENCE_STEP = ReferenceStep(residuals=residuals, acting=acting, in_units=in_units)
