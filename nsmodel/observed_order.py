"""What runs with steps 4h, 2h and h show together: the order that is seen, at the times that all of them have."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from nsmodel.errors import StepError, UsageError
from nsmodel.hypotheses.findings import Consequence, measured_consequence
from nsmodel.hypotheses.framework import HYPOTHESIS_CHECKS
from nsmodel.modeling.base import Model
from nsmodel.simulation.simulate import simulate
from nsmodel.simulation.trajectory import Trajectory

ORDER_ROUND_OFF = 1e-11  # Differences of runs below this part of the state are not told from rounding.
ASYMPTOTIC_ORDERS = 0.3, 2.5  # Orders seen outside of this range are chance.
SAME_TIME_SHARE = 1e-12  # Of the run: rows nearer than this are at one time.
ROW_RATIO_RANGE = 1.8, 2.2  # Rows of a run beside those with steps twice as long.


def refined_run_consequences(model: Model, run: Trajectory, effort: Any) -> list[Consequence]:
    """What runs with the steps 4h, 2h, h show together: the order, and what the class looks at; ``effort``: of a check of it."""
    h, N = model.step, len(run.t) - 1
    if h is None or N < 16 or run.status != "done" or model.tied_to_step:
        return []
    if effort and not effort.is_refined(model, N):
        return []
    try:
        runs = [run, *(simulate(model, step=factor * h, t_end=float(run.t[-1])) for factor in (2, 4))]
    except (StepError, UsageError):
        return []
    if model.u.numel() and not all(
        ROW_RATIO_RANGE[0] <= len(fine.t) / len(wide.t) <= ROW_RATIO_RANGE[1] for fine, wide in pairwise(runs)
    ):
        return []  # edges ask for steps of their own
    refined_runs = HYPOTHESIS_CHECKS.of(model).refined_runs
    return [_observed_order(h, runs), *([] if refined_runs is None else refined_runs(h, runs))]


def _states_at_common_times(runs: Sequence[Trajectory]) -> Iterator[np.ndarray]:
    """The states of runs with the steps h, 2h, 4h at the times that all have."""
    N = len(runs[0].t) - 1
    if "inputs" not in runs[0].arrays:
        rows = N // 4 - (1 if N % 4 else 0)  # the last row of a coarse run may be a shortened step
        return (other.x[: factor * rows + 1 : factor] for factor, other in zip((4, 2, 1), runs, strict=True))
    t, near = runs[-1].t, SAME_TIME_SHARE * float(runs[-1].t[-1])
    at = [np.abs(run.t[:, None] - t).argmin(axis=0) for run in runs]
    common = np.all([np.abs(run.t[rows] - t) <= near for run, rows in zip(runs, at, strict=True)], axis=0)
    return (run.x[rows[common]] for run, rows in zip(runs, at, strict=True))


def _observed_order(h: float, runs: Sequence[Trajectory]) -> Consequence:
    """log2 of the ratio of the differences between neighbouring runs, at common times."""
    fine, medium, wide = _states_at_common_times(runs)
    near, far = np.nanmax(np.abs(medium - fine)), np.nanmax(np.abs(wide - medium))  # NaN: bodies that are absent in one of two.
    value = {"difference h, 2h": near, "difference 2h, 4h": far, "h": h}
    error = runs[0].metadata["totals"].get("largest_error")
    if error is not None:
        value["largest error"] = error
    if near <= ORDER_ROUND_OFF * max(np.nanmax(np.abs(runs[0].x)), np.finfo(float).tiny):
        return measured_consequence(
            "observed order", "runs with steps 4h, 2h, h agree to rounding: no order is seen, and no error of the step", value
        )
    order = np.log2(far / near) if far else 0.0
    if not ASYMPTOTIC_ORDERS[0] <= order <= ASYMPTOTIC_ORDERS[1]:
        why = "no order is seen at steps 4h, 2h, h: they are too large, or switches fall between rows differently"
        return measured_consequence("observed order", why, value)
    return measured_consequence(
        "observed order", "the error shrinks like h^order, seen at steps 4h, 2h, h", {"order": order, **value}
    )
