"""Finite convergence of an oscillator's run (Cabot 2004, Theorem 4.1 and Corollary 4.2)."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from nsmodel._utils import EPS, cached_per_object
from nsmodel.models.friction_oscillator.model import FrictionOscillator
from nsmodel.models.friction_oscillator.schemes import slope_at_zero
from nsmodel.solvers import mlcp
from nsmodel.solvers.one_step_problem import subdifferential
from nsmodel.solvers.residuals import NumericLaw, numeric_law

# Times EPS and the forces: smaller margins are not told from 0, as forces come from some dozen operations.
REST_MARGIN_ROUNDING = 64


def finite_convergence(
    model: FrictionOscillator, x: np.ndarray, v: np.ndarray, rest_from: tuple[int, float] | None
) -> dict[str, Any]:
    """Say whether a run has come to rest for ever, and why.

    Args:
        model: bound.
        x: the last position (n,); v: the last two velocities (2, n).
        rest_from: (n_0, t_0), the first row from which v == 0 and its time; None where it still moves.

    Returns:
        finite: v = 0 twice in a row and the margin theta'(0) - d(0, dg(x)) exceeds the rounding bound; n_0, t_0 or None;
        margin = theta_prime_0 - distance, for one isotropic element theta'(0) and d(0, dg(x)); for several, those of the
        element that is nearest to sliding, and its name; reason in words. Where a force moves with time, all others are None.
    """
    if model.is_forced:
        reason = "a force that moves with time acts: it may start again, and no theorem says that it rests"
        return dict.fromkeys(["n_0", "t_0", "margin", "distance", "theta_prime_0", "element"]) | {
            "finite": False,
            "reason": reason,
        }
    radii = _friction_radii(model)
    force = least_norm_force(model, x)
    margin, bound, binding, part = _rest_margin(model, force, radii)
    still = bool((v == 0).all())
    n_0, t_0 = rest_from if still and rest_from is not None and margin > bound else (None, None)
    finite = n_0 is not None
    if not still:
        reason = "still moving at the end of the run"
    elif finite:
        reason = "v = 0 and 0 is interior to A(0) + dg(x): at rest for ever (Theorem 4.1 iii)"
    elif not np.isfinite(margin):
        reason = "v = 0, but the friction acts in some directions only: 0 is not interior to A(0)"
    else:
        reason = f"v rounds to 0, but the margin is not above its rounding bound {bound:.2g}: convergence need not be finite"
    return {
        "finite": finite,
        "n_0": n_0,
        "t_0": t_0,
        "margin": float(margin),
        "distance": part,
        "theta_prime_0": float(radii[binding]) if radii.size else 0.0,
        "element": model.elements[binding].name if radii.size else None,
        "reason": reason,
    }


def least_norm_force(model: FrictionOscillator, x: np.ndarray) -> np.ndarray:
    """The element of least norm of dg(x) (n,): smooth gradient, kinks and active constraints."""
    f, law, active = _force_function(model)
    lower = np.concatenate([law.lower, np.zeros(active)])
    upper = np.concatenate([law.upper, np.full(active, np.inf)])
    base, A, u_x = (np.array(value) for value in f(x, np.zeros(lower.size)))
    base, u_x = base.ravel(), u_x.ravel()
    # Rows with u != 0 have one multiplier; those with u = 0 any in their face.
    scale = 1e-12 * (1 + np.abs(x).max(initial=0.0))
    tied = np.abs(u_x) <= scale
    for rows, _ in law.curved:
        tied[rows] = bool((np.abs(u_x[rows]) <= scale).all())
    fixed = np.where(u_x > 0, lower, upper)
    for rows, K in law.curved:
        fixed[rows] = K.support_point(u_x[rows]) if u_x[rows].any() else 0.0
    fixed = np.where(tied, 0.0, fixed)
    base = base + A @ np.where(np.isfinite(fixed), fixed, 0.0)
    free = np.flatnonzero(tied)
    if not free.size:
        return base
    position = {int(i): j for j, i in enumerate(free)}
    curved = tuple(
        (slice(position[rows.start], position[rows.start] + rows.stop - rows.start), K)
        for rows, K in law.curved if tied[rows].all()
    )  # fmt: skip
    sub = type(law)(lower[free], upper[free], curved)
    M = A[:, free]
    chain = (mlcp.SEMISMOOTH,) if curved else (mlcp.INDEX_SET, mlcp.LEMKE, "qpoases")
    found = mlcp.solve_mlcp(M.T @ M, M.T @ base, sub, np.zeros(free.size), np.zeros(free.size, np.int8), chain, True, 1e-10)
    return base + M @ found.l


@cached_per_object
def _force_function(model: FrictionOscillator) -> tuple[ca.Function, NumericLaw, int]:
    """(x, l) to the force, its slope in l, and u, of dg(x) and the constraints; its law, and how many constraints there are."""
    g = subdifferential(model.potential_split, model.x, "potential")
    c = ca.vertcat(ca.SX(0, 1), *model.constraints.values())
    n = ca.SX.sym("n", c.numel())
    l, u = ca.vertcat(g.l, n), ca.vertcat(g.u, c)
    total = -g.force - ca.jacobian(c, model.x).T @ n
    f = ca.Function("force", [model.x, l], [ca.densify(total), ca.densify(ca.jacobian(total, l)), ca.densify(u)])
    return f, numeric_law(g.law), n.numel()


@cached_per_object
def _friction_radii(model: FrictionOscillator) -> np.ndarray:
    """theta'(0) of each element."""
    return np.array([float(ca.DM(slope_at_zero(e, model.s))) for e in model.elements])


def _rest_margin(model: FrictionOscillator, force: np.ndarray, radii: np.ndarray) -> tuple[float, float, int, float]:
    """(margin, rounding bound, element, its part of the force) of the element with the least margin theta_j'(0) - |xi_j|.

    For one isotropic element that is theta'(0) - d(0, dg(x)); for several the force is split among them with least norm.
    """
    size = float(np.linalg.norm(force))
    if not model.elements:
        return -np.inf, 0.0, 0, size
    H = np.vstack([np.array(ca.DM(e.H)) for e in model.elements])
    if np.linalg.matrix_rank(H) < H.shape[1]:
        return -np.inf, 0.0, 0, size
    parts = np.linalg.lstsq(H.T, force, rcond=None)[0]
    ends = np.cumsum([e.H.shape[0] for e in model.elements])
    sizes = np.array([np.linalg.norm(part) for part in np.split(parts, ends[:-1])])
    binding = int(np.argmin(radii - sizes))
    bound = REST_MARGIN_ROUNDING * EPS * float(max(radii.max(), np.abs(force).max(), sizes.max()))
    return float(radii[binding] - sizes[binding]), bound, binding, float(sizes[binding])
