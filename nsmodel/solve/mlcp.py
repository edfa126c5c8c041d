"""The affine problem y = W l + b, -y ∈ N_K(l): a chain of solvers, each answer polished and judged by the law's residual."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nsmodel.solve import active_set, curved, qp
from nsmodel.solve.certificate import EPS, ROUNDING, NumericLaw, law_residual, output_scale
from nsmodel.solve.rounding import UNIT_ROUND_OFF, dense_solution_errors, row_maxima

INDEX_SET, LEMKE, ENUMERATION, SEMISMOOTH = "index set", "lemke", "enumeration", "semismooth"


MAX_ENTRY_RATIO = 1e4  # Entries of W that differ by more are in units that pivoting feels.


@dataclass(frozen=True)
class MlcpSolution:
    """l (m,), its index set (m,), the law's residual, and the solver that found it."""

    l: np.ndarray
    index: np.ndarray
    residual: float
    solver: str


def affine_law_residual(W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray) -> np.ndarray:
    """Return the law's residual of each row at y = W l + b."""
    return _residual_given_rounding(W, b, law, l, 0.0)


def _residual_given_rounding(W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray, unseen: Any) -> np.ndarray:
    w_max = np.abs(W).max(axis=1, initial=0.0)
    return law_residual(law, l, W @ l + b, output_scale(b, np.abs(W) @ np.abs(l), w_max), w_max, unseen)


def _residual_with_rounding(
    W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray, index: np.ndarray, tolerance: float
) -> np.ndarray:
    """The residual where W and b, and by them l, are known to rounding only."""
    free = index == 0
    error, of = np.abs(W) @ np.abs(l) + np.abs(b), np.zeros(law.size)
    if free.any():
        of[free] = row_maxima(dense_solution_errors(W[np.ix_(free, free)], error[free]))
    c_u = ROUNDING * UNIT_ROUND_OFF / tolerance
    return _residual_given_rounding(W, b, law, l, c_u * (error + np.abs(W) @ of))


def solve_mlcp(
    W: np.ndarray, b: np.ndarray, law: NumericLaw, warm: np.ndarray, index: np.ndarray, chain: Sequence[str], symmetric: bool,
    tolerance: float,
) -> MlcpSolution:  # fmt: skip
    """Try the solvers of ``chain`` in turn and return the first answer below ``tolerance``, else the best one.

    ``warm`` and ``index`` are the last multiplier and index set. An answer that no solver could give has residual inf.
    """
    if not (np.isfinite(W).all() and np.isfinite(b).all()):
        return MlcpSolution(np.full(law.size, np.nan), index, np.inf, "none")
    units = _equilibrating_units(W, law)
    if units is None:
        return _solve_by_chain(W, b, law, warm, index, chain, symmetric, tolerance)
    of_y, of_l = units
    scaled = NumericLaw(law.lower / of_l, law.upper / of_l, ())
    found = _solve_by_chain(W * of_l / of_y[:, None], b / of_y, scaled, warm / of_l, index, chain, symmetric, tolerance)
    return MlcpSolution(of_l * found.l, found.index, found.residual, found.solver)


def _solve_by_chain(
    W: np.ndarray, b: np.ndarray, law: NumericLaw, warm: np.ndarray, index: np.ndarray, chain: Sequence[str], symmetric: bool,
    tolerance: float,
) -> MlcpSolution:  # fmt: skip
    best = MlcpSolution(np.full(law.size, np.nan), index, np.inf, "none")
    for name in chain:
        for l, code in _solver_candidates(name, W, b, law, warm, index, symmetric):
            worst = float(affine_law_residual(W, b, law, l).max(initial=0.0))
            if 0 < tolerance < worst < np.inf:
                excused = float(_residual_with_rounding(W, b, law, l, code, tolerance).max(initial=0.0))
                worst = excused if excused <= tolerance else worst
            if worst < best.residual:
                best = MlcpSolution(l, code, worst, name)
            if worst <= tolerance:
                return best
    return best


def _equilibrating_units(W: np.ndarray, law: NumericLaw) -> tuple[np.ndarray, np.ndarray] | None:
    """Powers of 2 as units (a, c) of y and l in a box, in which W is about as large as its transpose and its diagonal about 1.

    |W_ij c_j / a_i| = |W_ji c_i / a_j| asks for a_i c_i / (a_j c_j) = |W_ij / W_ji|, which is met in the sense of least squares.
    None where the user's units are nearly as good.
    """
    if law.curved:
        return None
    size = np.abs(W)
    row, column, diagonal = size.max(axis=1, initial=0.0), size.max(axis=0, initial=0.0), np.diag(size)
    if (
        _is_well_scaled(row[row > 0])
        and _is_well_scaled((row / np.where(column > 0, column, 1.0))[(row > 0) & (column > 0)])
        and _is_well_scaled(diagonal[diagonal > 0])
    ):
        return None
    both = (size > 0) & (size.T > 0)
    ratio = np.log2(np.where(both, size, 1.0)) - np.log2(np.where(both, size.T, 1.0))
    laplacian = np.diag(both.sum(axis=1)) - both.astype(float)
    product = np.linalg.lstsq(laplacian, ratio.sum(axis=1), rcond=1e-12)[0]
    even = size * np.exp2(-product / 2)[:, None] * np.exp2(product / 2)
    own = np.where(diagonal > 0, diagonal, even.max(axis=1, initial=0.0))
    own = np.log2(np.where(own > 0, own, 1.0))
    return np.exp2(np.round((product + own) / 2)), np.exp2(np.round((product - own) / 2))


def _is_well_scaled(sizes: np.ndarray) -> bool:
    return bool(sizes.max(initial=0.0) <= MAX_ENTRY_RATIO * sizes.min(initial=np.inf))


def _solver_candidates(name, W, b, law, warm, index, symmetric):
    """Yield (l, index set) of one solver: first polished, then as it came."""
    if name == INDEX_SET:
        found = active_set.primal_dual_active_set(W, b, law, index)
        if found is not None:
            yield found
        return
    if name == ENUMERATION:
        for code in active_set.enumerate_index_sets(law, index):
            l = active_set.solve_on_index_set(W, b, law, code)
            if l is not None:
                yield l, code
        return
    if name == SEMISMOOTH:
        for start in (warm, np.zeros_like(warm)):
            l = curved.semismooth_newton(W, b, law, start)
            if l is None:
                l = curved.semismooth_newton(W, b, law, curved.projected_gauss_seidel(W, b, law, start))
            if l is not None:
                yield curved.polish_curved_solution(W, b, law, l)
                yield l, curved.curved_index_set(law, l, W @ l + b, curved.block_scale(W, law))
        return
    l = active_set.lemke(W, b, law) if name == LEMKE else qp.solve_qp(name, W, b, law, symmetric)
    if l is None:
        return
    y = W @ l + b
    y[np.abs(y) <= 4 * EPS * (np.abs(W) @ np.abs(l) + np.abs(b))] = 0.0  # a tie: a row at its bound stays there
    code = active_set.estimate_index_set(l, y, law, active_set.row_scale(W))
    polished = active_set.solve_on_index_set(W, b, law, code)
    if polished is not None:
        yield polished, code
    yield l, code
    near = active_set.primal_dual_active_set(W, b, law, code)  # rows that are small beside others may be on the wrong side
    if near is not None:
        yield near
