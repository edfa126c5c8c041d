"""Hypotheses of an inclusion: as it stands where nothing depends on time, else at each time and of how its set moves."""

from __future__ import annotations

from collections.abc import Sequence

from nsmodel.classes.inclusion.hypotheses import autonomous, moving
from nsmodel.classes.inclusion.hypotheses.autonomous import HYPOTHESES
from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.hypotheses.findings import Consequence, Finding
from nsmodel.hypotheses.region import Region
from nsmodel.simulation.trajectory import Trajectory

__all__ = ["HYPOTHESES", "check"]


def check(
    model: MonotoneInclusion, region: Region, runs: Sequence[Trajectory], quick: bool
) -> tuple[list[Finding], list[Consequence]]:
    """Return one finding a hypothesis, and what follows.

    Args:
        model: bound.
        region: the box in which what is not settled everywhere is looked at.
        runs: of this model; their steps enter the tolerances.
        quick: skip global searches.
    """
    decide = moving.check_moving if model.moves else autonomous.check_autonomous
    return decide(model, region, runs, quick)
