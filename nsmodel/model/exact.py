"""The exact state of a model, where its user knows it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.later import former_names
from nsmodel.pickled import Picklable


@dataclass(frozen=True, eq=False)
class SampledExactState(Picklable):
    """Expressions of t (n, 1) as a function of times: (N,) -> (N, n)."""

    t: ca.SX
    column: ca.SX

    def __call__(self, t: Any) -> np.ndarray:
        """Return the values at the times."""
        times = np.atleast_1d(np.asarray(t, float))
        values = ca.Function("exact", [self.t], [self.column]).map(len(times))(times[None, :])
        return np.array(values).reshape(self.column.numel(), -1).T


__getattr__ = former_names(__name__, Sampled="SampledExactState")
