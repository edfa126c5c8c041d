"""The affine problem y = W l + b, -y ∈ N_K(l): a chain of solvers, each answer polished and judged by the law's residual."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nsmodel.solve import active_set, cone, qp
from nsmodel.solve.certificate import NumericLaw, law_residual, output_scale

INDEX_SET, LEMKE, ENUMERATION, SEMISMOOTH = "index set", "lemke", "enumeration", "semismooth"


@dataclass(frozen=True)
class Solution:
    """l (m,), its index set (m,), the law's residual, and the solver that found it."""

    l: np.ndarray
    index: np.ndarray
    residual: float
    solver: str


def residual(W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray) -> np.ndarray:
    """Return the law's residual of each row at y = W l + b."""
    w_max = np.abs(W).max(axis=1, initial=0.0)
    return law_residual(law, l, W @ l + b, output_scale(b, np.abs(W) @ np.abs(l), w_max), w_max)


def solve(
    W: np.ndarray, b: np.ndarray, law: NumericLaw, warm: np.ndarray, index: np.ndarray, chain: Sequence[str], symmetric: bool,
    tolerance: float,
) -> Solution:  # fmt: skip
    """Try the solvers of ``chain`` in turn and return the first answer below ``tolerance``, else the best one.

    ``warm`` and ``index`` are the last multiplier and index set. An answer that no solver could give has residual inf.
    """
    best = Solution(np.full(law.size, np.nan), index, np.inf, "none")
    if not (np.isfinite(W).all() and np.isfinite(b).all()):
        return best
    for name in chain:
        for l, code in _candidates(name, W, b, law, warm, index, symmetric):
            worst = float(residual(W, b, law, l).max(initial=0.0))
            if worst < best.residual:
                best = Solution(l, code, worst, name)
            if worst <= tolerance:
                return best
    return best


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
    code = active_set.classify(l, W @ l + b, law, active_set.row_scale(W))
    polished = active_set.polish(W, b, law, code)
    if polished is not None:
        yield polished, code
    yield l, code
