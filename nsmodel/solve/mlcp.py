"""The affine problem y = W l + b, -y ∈ N_K(l): a chain of solvers, each answer polished and judged by the law's residual."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nsmodel.solve import active_set, cone, qp
from nsmodel.solve.certificate import EPS, ROUNDING, NumericLaw, law_residual, output_scale
from nsmodel.solve.rounding import UNIT, felt_dense

INDEX_SET, LEMKE, ENUMERATION, SEMISMOOTH = "index set", "lemke", "enumeration", "semismooth"


FAR_APART = 1e4  # Entries W_ii that differ by more are in units that pivoting feels.


@dataclass(frozen=True)
class Solution:
    """l (m,), its index set (m,), the law's residual, and the solver that found it."""

    l: np.ndarray
    index: np.ndarray
    residual: float
    solver: str


def residual(W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray) -> np.ndarray:
    """Return the law's residual of each row at y = W l + b."""
    return _residual(W, b, law, l, 0.0, 0.0)


def _residual(W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray, unseen_y: Any, unseen_l: Any) -> np.ndarray:
    w_max = np.abs(W).max(axis=1, initial=0.0)
    return law_residual(law, l, W @ l + b, output_scale(b, np.abs(W) @ np.abs(l), w_max), w_max, unseen_y, unseen_l)


def _with_rounding(
    W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray, index: np.ndarray, tolerance: float
) -> np.ndarray:
    """The residual where W and b, and by them l, are known to rounding only."""
    free = index == 0
    error, of = np.abs(W) @ np.abs(l) + np.abs(b), np.zeros(law.size)
    if free.any():
        of[free] = felt_dense(W[np.ix_(free, free)], error[free])
    c_u = ROUNDING * UNIT / tolerance
    return _residual(W, b, law, l, c_u * (error + np.abs(W) @ of), c_u * of)


def solve(
    W: np.ndarray, b: np.ndarray, law: NumericLaw, warm: np.ndarray, index: np.ndarray, chain: Sequence[str], symmetric: bool,
    tolerance: float,
) -> Solution:  # fmt: skip
    """Try the solvers of ``chain`` in turn and return the first answer below ``tolerance``, else the best one.

    ``warm`` and ``index`` are the last multiplier and index set. An answer that no solver could give has residual inf.
    """
    if not (np.isfinite(W).all() and np.isfinite(b).all()):
        return Solution(np.full(law.size, np.nan), index, np.inf, "none")
    units = _units(W, law)
    if units is None:
        return _solve(W, b, law, warm, index, chain, symmetric, tolerance)
    scaled = NumericLaw(law.lower / units, law.upper / units, ())
    found = _solve(units[:, None] * W * units, units * b, scaled, warm / units, index, chain, symmetric, tolerance)
    return Solution(units * found.l, found.index, found.residual, found.solver)


def _solve(
    W: np.ndarray, b: np.ndarray, law: NumericLaw, warm: np.ndarray, index: np.ndarray, chain: Sequence[str], symmetric: bool,
    tolerance: float,
) -> Solution:  # fmt: skip
    best = Solution(np.full(law.size, np.nan), index, np.inf, "none")
    for name in chain:
        for l, code in _candidates(name, W, b, law, warm, index, symmetric):
            worst = float(residual(W, b, law, l).max(initial=0.0))
            if 0 < tolerance < worst < np.inf:
                excused = float(_with_rounding(W, b, law, l, code, tolerance).max(initial=0.0))
                worst = excused if excused <= tolerance else worst
            if worst < best.residual:
                best = Solution(l, code, worst, name)
            if worst <= tolerance:
                return best
    return best


def _units(W: np.ndarray, law: NumericLaw) -> np.ndarray | None:
    """Powers of 2 as units of the multipliers of a box in which W_ii is about 1; None where the user's are nearly as good."""
    size = np.abs(np.diag(W))
    size = np.where(size > 0, size, np.abs(W).max(axis=1, initial=0.0))
    if law.curved or size.max(initial=0.0) <= FAR_APART * size.min(initial=np.inf, where=size > 0):
        return None
    return np.exp2(-np.round(np.log2(np.where(size > 0, size, 1.0)) / 2))


def _candidates(name, W, b, law, warm, index, symmetric):
    """Yield (l, index set) of one solver: first polished, then as it came."""
    if name == INDEX_SET:
        found = active_set.primal_dual(W, b, law, index)
        if found is not None:
            yield found
        return
    if name == ENUMERATION:
        for code in active_set.index_sets(law, index):
            l = active_set.polish(W, b, law, code)
            if l is not None:
                yield l, code
        return
    if name == SEMISMOOTH:
        for start in (warm, np.zeros_like(warm)):
            l = cone.semismooth_newton(W, b, law, start)
            if l is None:
                l = cone.semismooth_newton(W, b, law, cone.gauss_seidel(W, b, law, start))
            if l is not None:
                yield cone.exact_zeros(W, b, law, l)
                yield l, cone.index_set(law, l, W @ l + b, cone.block_scale(W, law))
        return
    l = active_set.lemke(W, b, law) if name == LEMKE else qp.solve(name, W, b, law, symmetric)
    if l is None:
        return
    y = W @ l + b
    y[np.abs(y) <= 4 * EPS * (np.abs(W) @ np.abs(l) + np.abs(b))] = 0.0  # a tie: a row at its bound stays there
    code = active_set.classify(l, y, law, active_set.row_scale(W))
    polished = active_set.polish(W, b, law, code)
    if polished is not None:
        yield polished, code
    yield l, code
    near = active_set.primal_dual(W, b, law, code)  # rows that are small beside others may be on the wrong side
    if near is not None:
        yield near
