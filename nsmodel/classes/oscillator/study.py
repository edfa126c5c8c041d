"""What a step of an oscillator starts from, at any row of a run."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nsmodel.classes.oscillator.model import FrictionOscillator
from nsmodel.simulation.trajectory import Trajectory


def states(model: FrictionOscillator, run: Trajectory, start: np.ndarray) -> Callable[[int, float], np.ndarray]:
    """(row, h) -> x and the difference h v, the older position that the velocity gives for this step; with a force x and v."""
    return lambda row, h: np.concatenate([run.x[row], (1.0 if model.keeps_velocity else h) * run.v[row]])
