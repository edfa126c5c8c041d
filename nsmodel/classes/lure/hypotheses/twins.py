"""Two runs of a Lur'e system with the same signals stay as near as they should: f cancels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nsmodel.classes.lure.hypotheses.check import contraction
from nsmodel.classes.lure.hypotheses.hypomonotone import HYPOMONOTONE, NAME
from nsmodel.classes.lure.model import LureSystem
from nsmodel.hypotheses.findings import HOLDS, Finding
from nsmodel.trajectory import Trajectory


def compared(model: LureSystem, findings: Sequence[Finding], runs: Sequence[Trajectory]) -> list[Finding]:
    """(40), with the P and omega of the findings, for two runs from different starts."""
    rate = next(finding for finding in findings if finding.id == HYPOMONOTONE.id)
    if len(runs) < 2 or rate.verdict != HOLDS or NAME not in rate.witness:
        return []
    return [contraction(model, np.array(rate.witness[NAME]), rate.value["omega"], *runs[:2])]
