"""Two runs of a Lur'e system with the same signals stay as near as they should: f cancels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nsmodel.classes.lure.hypotheses.check import compare_contraction
from nsmodel.classes.lure.hypotheses.hypomonotone import HYPOMONOTONE, P_OMEGA
from nsmodel.classes.lure.model import LureSystem
from nsmodel.hypotheses.findings import HOLDS, Finding
from nsmodel.simulation.trajectory import Trajectory


def compare_runs(model: LureSystem, findings: Sequence[Finding], runs: Sequence[Trajectory]) -> list[Finding]:
    """(40), with the P and omega of the findings, for two runs from different starts."""
    rate = next(finding for finding in findings if finding.id == HYPOMONOTONE.id)
    if len(runs) < 2 or rate.verdict != HOLDS or P_OMEGA not in rate.witness:
        return []
    return [compare_contraction(model, np.array(rate.witness[P_OMEGA]), rate.value["omega"], *runs[:2])]
