"""Conic programs, solved by Clarabel without a word."""

from __future__ import annotations

from typing import Any

import numpy as np


def zero_cone(size: int) -> Any:
    """The cone {0}."""
    return _import_clarabel().ZeroConeT(size)


def nonnegative_cone(size: int) -> Any:
    """The cone of vectors >= 0."""
    return _import_clarabel().NonnegativeConeT(size)


def lorentz_cone(size: int) -> Any:
    """The cone of vectors (s, v) with |v| <= s."""
    return _import_clarabel().SecondOrderConeT(size)


def semidefinite_cone(order: int) -> Any:
    """The cone of symmetric matrices >= 0, as the scaled columns of their upper triangles."""
    return _import_clarabel().PSDTriangleConeT(order)


def solve_conic_program(
    cost: np.ndarray, A: Any, b: np.ndarray, cones: list[Any], P: Any = None, tolerance: float | None = None
) -> Any:
    """Return Clarabel's solution of min x'Px/2 + cost'x with b - A x in the cones, in their order; the caller verifies it."""
    from scipy import sparse

    clarabel = _import_clarabel()
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    if tolerance is not None:
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    quadratic = sparse.csc_matrix((cost.size, cost.size)) if P is None else P
    return clarabel.DefaultSolver(quadratic, cost, sparse.csc_matrix(A), b, cones, settings).solve()


def _import_clarabel() -> Any:
    """The module, whose names pyright does not see; loaded where it is used."""
    import clarabel

    return clarabel
