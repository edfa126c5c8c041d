"""What a small state is measured beside under error control: states of one symbol, or those that one cone pushes.

A cone that acts on accelerations alone holds v by positions, in the mean of a step: along its surface, of curvature k, v is off
by the part theta = k |v| h of |v|, and by tolerance/theta, as y is by the tolerance. A v_i that begins at 0 is off by all of
itself in a first step of any length: what it is measured beside is the part sqrt(tolerance)/(2 rtol) of |v|, which asks for
steps of about theta = sqrt(tolerance), where both are least. |v| is the largest v_i/unit_i, unit_i how far an impulse moves
v_i.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nsmodel.hypotheses.impacts import ImpactRow

NEGLIGIBLE_STATE_SHARE = 1e-6  # A state that stays below this part of the largest of its symbol is measured beside that.


class ErrorScale(NamedTuple):
    """States ``at`` (k,), which are measured beside ``part`` of the largest of them, in ``unit`` (k,)."""

    at: np.ndarray
    part: float
    unit: np.ndarray

    def apply_floor(self, size: np.ndarray) -> np.ndarray:
        """The sizes (..., k) of its states, none below what it is measured beside."""
        return np.maximum(size, self.part * self.unit * (size / self.unit).max(axis=-1, keepdims=True))


def error_scale_groups(
    symbols: Sequence[np.ndarray], cones: Sequence[ImpactRow], tolerance: float, rtol: float
) -> list[ErrorScale]:
    """Return the groups of states, each state in one at most.

    Args:
        symbols: the states of each symbol.
        cones: those that call for impulses.
        tolerance: of a step; rtol: of the run.
    """
    part = max(NEGLIGIBLE_STATE_SHARE, min(1.0, math.sqrt(tolerance) / (2 * rtol)) if rtol else 1.0)
    found, taken = [], np.zeros(0, int)
    for cone in cones:
        at = np.setdiff1d(np.flatnonzero(cone.pushed), taken)
        found.append(ErrorScale(at, part, cone.pushed[at]))
        taken = np.append(taken, at)
    rest = [np.setdiff1d(symbol, taken) for symbol in symbols]
    return [
        group for group in (*found, *(ErrorScale(at, NEGLIGIBLE_STATE_SHARE, np.ones(at.size)) for at in rest)) if group.at.size
    ]
