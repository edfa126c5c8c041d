"""Conic programs, solved by Clarabel without a word."""

from __future__ import annotations

from typing import Any

import numpy as np


def minimise(cost: np.ndarray, A: np.ndarray, b: np.ndarray, cones: list[Any]) -> Any:
    """Return Clarabel's solution of min cost'x with b - A x in the cones, in their order; it is for the caller to verify."""
    import clarabel
    from scipy import sparse

    settings = clarabel.DefaultSettings()
    settings.verbose = False
    quadratic = sparse.csc_matrix((cost.size, cost.size))
    return clarabel.DefaultSolver(quadratic, cost, sparse.csc_matrix(A), b, cones, settings).solve()
