"""How fast an inclusion moves on a box.

x' is the element of F - S - N_C of least length, not longer than F - S; projections on C do not stretch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from nsmodel.classes.inclusion.hypotheses.growth import velocity_bound
from nsmodel.classes.inclusion.hypotheses.selected_field import constraint_set, decompose_field
from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.hypotheses.findings import Consequence, Finding
from nsmodel.hypotheses.framework import SpeedBound
from nsmodel.hypotheses.region import Region


def speed_bound(
    model: MonotoneInclusion, region: Region, findings: Sequence[Finding], known: Mapping[str, Consequence], h: float
) -> SpeedBound | None:  # fmt: skip
    """The pace on the box, a step ahead of it by its predictor; None where it has no bound, or projections are approximate."""
    if callable(model.tolerances) or (model.tolerances is not None and np.any(np.asarray(model.tolerances, float))):
        return None
    if model.moves:
        return None
    top = velocity_bound(decompose_field(model, constraint_set(model)), (region.lower, region.upper))
    return None if top is None else SpeedBound(top, h * top)
