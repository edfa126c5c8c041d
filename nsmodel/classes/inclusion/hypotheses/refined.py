"""What runs of catching-up with the steps h, 2h, 4h show together: how fast the predictors reach C."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nsmodel.hypotheses.findings import Consequence, measured_consequence
from nsmodel.simulation.trajectory import Trajectory


def refinement_consequences(h: float, runs: Sequence[Trajectory]) -> list[Consequence]:
    """The time mean of d_C(y_k) at the steps h, 2h, 4h (Corollary 6.4: it tends to 0); nothing of a scheme without predictor."""
    return [_predictor_feasibility(runs)] if "predictor_distance" in runs[0].arrays else []


def _predictor_feasibility(runs: Sequence[Trajectory]) -> Consequence:
    means = [float(np.average(run.arrays["predictor_distance"][1:].ravel(), weights=run.step[1:])) for run in runs]
    value = {f"mean d_C at {name}": mean for name, mean in zip(("h", "2h", "4h"), means, strict=True)}
    if not means[0]:
        return measured_consequence("predictor feasibility", "the predictor never leaves C", value)
    rate = np.log2(means[2] / means[0]) / 2
    return measured_consequence(
        "predictor feasibility", "the mean distance of the predictor from C shrinks like h^rate", {"rate": rate, **value}
    )
