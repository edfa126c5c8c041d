"""Whether a step with contacts has one answer: W = G M^-1 G' at the start, where it is the same at all positions.

Without friction one, where W is definite. On lines with W definite one for every b where all determinants of the modes are > 0:
the map is piecewise linear with a piece for each choice of modes, rows of W for stick, P_T = -+ mu P_N for slip, and at most four
of them meet at a face of codimension 2 (Kuhn and Löwen, Linear Algebra and its Applications 97, 1987); for a single contact that
is mu < mu_c = W_NN/|W_NT|. Elsewhere there may be several (Painlevé; hyperstatic piles).
"""

from __future__ import annotations

from itertools import product

import casadi as ca
import numpy as np

from nsmodel.models.mechanical_system.model import MechanicalSystem

MAX_CONTACTS = 6  # With friction on lines, whose modes are looked at one by one, four each: 4^6 are 4096.
RANK_SHARE = 1e-10  # Singular values below this part of the largest are 0: far more than rounding leaves of them.


def uniqueness_doubt(model: MechanicalSystem) -> str:
    """Why a step may have several answers, in words; '' where it has one."""
    if not model.contact_rows:
        return ""
    W, constant = contact_matrix(model)
    if W is None:
        return "the numbers of the start give no W"
    values = np.linalg.svd(W, compute_uv=False)
    rank = int((values > RANK_SHARE * values.max(initial=0.0)).sum())
    friction = [one for one in model.contact_rows if one.slip.numel()]
    if rank < len(W):
        return f"W singular: rank {rank} of {len(W)}" if friction else ""
    if not friction:
        return ""
    if not constant:
        return f"W changes with positions; at the start rank {rank} of {len(W)}{_critical_text(model, W)}"
    if not all(one.mu.is_constant() for one in friction):
        return f"mu moves; rank {rank} of {len(W)}{_critical_text(model, W)}"
    if any(one.slip.numel() > 1 for one in friction):
        return f"friction in space: rank {rank} of {len(W)}{_critical_text(model, W)}"
    if len(model.contact_rows) > MAX_CONTACTS:
        return f"{len(model.contact_rows)} contacts, of which {MAX_CONTACTS} are looked at; rank {rank} of {len(W)}"
    return "" if has_positive_modes(model, W) else f"rank {rank} of {len(W)}{_critical_text(model, W)}"


def contact_matrix(model: MechanicalSystem) -> tuple[np.ndarray | None, bool]:
    """W of all contacts at the start, and whether it is the same everywhere."""
    T = ca.SX.eye(model.q.numel()) if model.kinematics is None else model.kinematics
    rows = []
    for one in model.contact_rows:
        rows.append(ca.jacobian(one.gap, model.q) @ T)
        rows.append(ca.jacobian(one.slip, model.v))
    G = ca.vertcat(*rows)
    symbols = ca.vertcat(model.t, model.x)
    both = ca.veccat(G, model.M)
    G_0, M_0 = (np.array(ca.DM(ca.substitute(part, symbols, ca.vertcat(0, model.x0)))) for part in (ca.densify(G), model.M))
    if not (np.isfinite(G_0).all() and np.isfinite(M_0).all()):
        return None, False
    return G_0 @ np.linalg.solve(M_0, G_0.T), not ca.depends_on(both, symbols)


def has_positive_modes(model: MechanicalSystem, W: np.ndarray) -> bool:
    """Whether the determinants of all modes of contacts on lines are > 0."""
    unit, at, choices = np.eye(len(W)), 0, []
    for one in model.contact_rows:
        own = [at, at + 1] if one.slip.numel() else [at]
        mu = float(one.mu)
        slips = [np.array([W[at], unit[at + 1] + e * mu * unit[at]]) for e in (1.0, -1.0)] if len(own) == 2 else []
        choices.append([unit[own], W[own], *slips])
        at += len(own)
    matrices = (np.vstack(rows) for rows in product(*choices))
    return all(np.linalg.det(A) > RANK_SHARE * np.prod(np.linalg.norm(A, axis=1)) for A in matrices)


def _critical_text(model: MechanicalSystem, W: np.ndarray) -> str:
    """The least mu_c of a single contact on a line, where one has friction."""
    at, least = 0, np.inf
    for one in model.contact_rows:
        if one.slip.numel():
            across = np.linalg.norm(W[at, at + 1 : at + 1 + one.slip.numel()])
            least = min(least, W[at, at] / across if across > 0 else np.inf)
        at += 1 + one.slip.numel()
    return f", mu_c = {least:.4g}" if np.isfinite(least) else ", mu_c = inf"
