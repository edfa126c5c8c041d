"""How fast an inclusion moves on a box.

x' is the element of F - S - N_C of least length, not longer than F - S; projections on C do not stretch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from nsmodel.classes.inclusion.hypotheses.growth import on_region
from nsmodel.classes.inclusion.hypotheses.selected_field import field_of, set_of
from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.hypotheses.findings import Consequence, Finding
from nsmodel.hypotheses.region import Region
from nsmodel.hypotheses.stay import Pace


def pace(
    model: MonotoneInclusion, region: Region, findings: Sequence[Finding], known: Mapping[str, Consequence], h: float
) -> Pace | None:  # fmt: skip
    """The pace on the box, a step ahead of it by its predictor; None where it has no bound, or projections are approximate."""
    if callable(model.tolerances) or (model.tolerances is not None and np.any(np.asarray(model.tolerances, float))):
        return None
    if model.moves:
        return None
    top = on_region(field_of(model, set_of(model)), (region.lower, region.upper))
    return None if top is None else Pace(top, h * top)
