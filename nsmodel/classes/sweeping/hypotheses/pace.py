"""How fast a sweeping process moves on a box.

q' = f - n with n normal to Q(t), and the set of velocities that stay in Q(t) holds some v_0, |v_0| <= K_L;
q' is the one nearest to f, so that <f - q', v_0 - q'> <= 0, which is |q'|^2 <= |f|^2 + K_L^2. A step of the scheme projects
q + h f on a polyhedron that holds a point within h K_L of q: the same, where rho is above what a constraint can close in it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.hypotheses.findings import HOLDS, Consequence, Finding
from nsmodel.hypotheses.framework import SpeedBound
from nsmodel.hypotheses.region import Region
from nsmodel.hypotheses.stay import ROUND_UP_FACTOR
from nsmodel.proof import extremum


def speed_bound(
    model: SweepingProcess, region: Region, findings: Sequence[Finding], known: Mapping[str, Consequence], h: float
) -> SpeedBound | None:  # fmt: skip
    """The pace on the box; None where it has no bound."""
    z = ca.vertcat(model.t, model.q)
    return sweeping_speed_bound(velocity_norm_bound(model.f, z, *region.bounds_with_time()), findings, known["K_L"], h)


def sweeping_speed_bound(f: float, findings: Sequence[Finding], moves: Consequence, h: float) -> SpeedBound | None:
    """The pace where |f| is at most ``f``."""
    number = {(finding.id, name): value for finding in findings for name, value in finding.value.items()}
    holds = {finding.id for finding in findings if finding.verdict == HOLDS}
    if not np.isfinite(f) or not {"S-convex", "S-start"} <= holds:
        return None
    rate = number.get(("A2", "b"), 0.0) if "A2" in holds else np.inf
    if not rate:
        return SpeedBound(f, h * f)
    K_L, b, rho = moves.value.get("K_L", np.inf), number.get(("A1", "b"), np.inf), number.get(("A5", "rho"), np.inf)
    if moves.verdict != HOLDS or not h * (rate + b * K_L) <= rho:
        return None
    return SpeedBound(float(np.hypot(f, K_L)) * ROUND_UP_FACTOR, h * f * ROUND_UP_FACTOR)


def velocity_norm_bound(f: ca.SX, z: ca.SX, lower: np.ndarray, upper: np.ndarray, count: int = 1) -> float:
    """A bound of |f| over a box of z, of so many bodies together."""
    top = extremum.supremum(ca.sumsqr(f), z, lower, upper, quick=True).bound
    return float(np.sqrt(count * max(top, 0.0))) * ROUND_UP_FACTOR
