"""How fast many bodies together move on the box of one: as a sweeping process does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.classes.sweeping.hypotheses.pace import sweeping_speed_bound, velocity_norm_bound
from nsmodel.hypotheses.findings import Consequence, Finding
from nsmodel.hypotheses.framework import SpeedBound
from nsmodel.hypotheses.region import Region


def speed_bound(
    model: ManyBodies, region: Region, findings: Sequence[Finding], known: Mapping[str, Consequence], h: float
) -> SpeedBound | None:  # fmt: skip
    """The pace on the box; None where it has no bound, as of a function of numbers."""
    if not isinstance(model.f, ca.SX):
        return None
    numbers, table = model.me.symbols[model.bodies.d :], model.bodies.table[:, model.bodies.d :]
    z = ca.vertcat(model.t, model.me.q, numbers)
    start, end = region.bounds_with_time()
    low, high = np.append(start, table.min(axis=0)), np.append(end, table.max(axis=0))
    return sweeping_speed_bound(velocity_norm_bound(model.f, z, low, high, model.bodies.count), findings, known["K_L"], h)
