"""What a run of many bodies looks at before it starts: of each family one member."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.classes.bodies.model import ManyBodies


def warnings(model: ManyBodies) -> list[str]:
    """Of each family one member where the bodies start: has its constraint a gradient, and is it convex there."""
    found = []
    for name, family in model.constraints.items():
        q = ca.vertcat(*(member.q for member in family.moving))
        H, slope = ca.hessian(family.g, q)
        f = ca.Function("H", [model.t, *(member.symbols for member in family.members)], [ca.densify(H), ca.densify(slope), q])
        i, j = (0, int(family.of_pairs)) if family.over is None else family.over[0] if len(family.over) else (0, -1)
        if family.of_pairs and j >= model.bodies.count:
            continue
        others = [] if family.second is None else [family.second.group.table[j]]
        H, slope, at = (np.array(value) for value in f(0, model.bodies.table[i], *others))
        label = f"constraint '{name} {i}'" if not others else f"constraint '{name} {i}-{j}'"
        if not slope.any():
            found.append(f"{label} has a zero gradient at q0: near there it acts on nothing")
        # A radius of curvature of 1e9 |q0| and more is round-off: a wall.
        bend = max(np.abs(H).max(), np.linalg.norm(slope) / np.linalg.norm(at) if at.any() else 0.0)
        if np.isfinite(H).all() and (least := np.linalg.eigvalsh(H)[0]) < -1e-9 * bend:
            found.append(f"{label} is not convex at q0 (least eigenvalue of its Hessian {least:.3g}): feasibility may be lost")
    return found
