"""What a run of a sweeping process looks at before it starts: q0 in Q(0), gradients and curvature of the constraints there."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.solvers.initial_checks import check_start_inside, start_margin


def check_start(model: SweepingProcess) -> None:
    """Refuse q0 outside Q(0)."""
    check_start_inside(model.g, model.multiplier_names, model, "q0")


def admitted(model: SweepingProcess) -> list[ca.SX]:
    """That, of all values of the parameters."""
    return [start_margin(model.g, model, "q0")]


def warnings(model: SweepingProcess) -> list[str]:
    """Constraints that act on nothing at q0, and those that are not convex there."""
    return _zero_gradient_warnings(model) + _nonconvexity_warnings(model)


def _zero_gradient_warnings(model: SweepingProcess) -> list[str]:
    """Constraints without gradient at q0: their linearisation is a number, and the scheme cannot use them."""
    gradient = ca.Function("G", [model.t, model.q], [ca.densify(ca.jacobian(model.g, model.q))])
    G = np.array(gradient(0, np.array(ca.DM(model.q0)).ravel())).reshape(len(model.multiplier_names), len(model.names))
    flat = [name for name, row in zip(model.multiplier_names, G, strict=True) if not row.any()]
    return [f"constraint '{name}' has a zero gradient at q0: near there it acts on nothing" for name in flat[:5]]


def _nonconvexity_warnings(model: SweepingProcess) -> list[str]:
    """Constraints whose Hessian at q0 has a negative eigenvalue: the scheme's feasibility rests on convexity (S-convex)."""
    found, q0 = [], np.array(ca.DM(model.q0)).ravel()
    rows, columns = map(np.array, ca.jacobian_sparsity(model.g, model.q).get_triplet())
    for k, name in enumerate(model.multiplier_names):
        g, own = model.g[k], columns[rows == k].tolist()
        gradient = ca.gradient(g, model.q[own]) if own else ca.SX(0, 1)
        if not own or not ca.depends_on(gradient, model.q[own]):
            continue
        f = ca.Function("H", [model.t, model.q], [ca.densify(ca.jacobian(gradient, model.q[own])), gradient])
        H, slope = (np.array(v) for v in f(0, q0))
        if not np.isfinite(H).all():
            continue
        least, distance = np.linalg.eigvalsh(H)[0], np.linalg.norm(q0)
        # A radius of curvature of 1e9 |q0| and more is round-off: a plane.
        if least < -1e-9 * max(np.abs(H).max(), np.linalg.norm(slope) / distance if distance else 0.0):
            found.append(
                f"constraint '{name}' is not convex at q0 (least eigenvalue of its Hessian {least:.3g}): feasibility may be lost"
            )
        if len(found) == 5:
            break
    return found
