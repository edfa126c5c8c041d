"""How much a check of many bodies computes, and what it says of that."""

from __future__ import annotations

from collections.abc import Sequence

from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.simulation.trajectory import Trajectory

MAX_BODY_STEPS = 100_000, 20_000  # Bodies times steps of a run that is made; up to the second, also with the steps 2h and 4h.


def most_steps(model: ManyBodies) -> int:
    """Steps of a run that is made."""
    return max(MAX_BODY_STEPS[0] // model.bodies.count, 1)


def is_refined(model: ManyBodies, steps: int) -> bool:
    """Whether a run of so many steps is made with the steps 2h and 4h too."""
    return model.bodies.count * steps <= MAX_BODY_STEPS[1]


def effort_notes(model: ManyBodies, runs: Sequence[Trajectory]) -> list[str]:
    """What the reader of a report on many bodies should know beside."""
    changing = model.leave is not None or model.enter.any()
    found = ["bodies leave or enter: the theory speaks of each interval between such times"] if changing else []
    n, steps = model.bodies.count, len(runs[0].t) - 1 if runs else 0
    if not is_refined(model, steps):
        found.append(f"no runs with the steps 2h and 4h: {n} bodies times {steps} steps are too many")
    return found
