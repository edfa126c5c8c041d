"""The affine problem y = W l + b, -y ∈ N_K(l): a chain of solvers, each answer polished and judged by the law's residual.

y = W l + b, -y ∈ N_[lower, upper](l) with W psd as a quadratic programme for CasADi's conic solvers.

Symmetric W: the box QP min 1/2 l'W l + b'l. Otherwise the gap QP, whose value is 0 iff the problem is solvable:
min l'(W l + b) - lower'y+ + upper'y- over lower <= l <= upper, y+ - y- = W l + b, y+, y- >= 0.

y = W l + b, -y ∈ N_K(l) where K has curved sets: semismooth Newton, with block Gauss-Seidel behind it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from nsmodel._utils import EPS
from nsmodel.modeling.laws.base import CurvedSet, safe_norm
from nsmodel.proof.verdict import suppress_output
from nsmodel.solvers import active_set, friction_contacts
from nsmodel.solvers.active_set import equilibrate_problem, row_scale, solve_or_least_squares
from nsmodel.solvers.residuals import ROUNDING, NumericLaw, law_residual, output_scale
from nsmodel.solvers.rounding_errors import SUM_ERROR, UNIT_ROUND_OFF, dense_solution_errors, row_maxima

QP_OPTIONS = {
    "qpoases": {"printLevel": "none", "terminationTolerance": 1e-14, "boundTolerance": 1e-14},
    "qrqp": {"print_iter": False, "print_header": False, "constr_viol_tol": 1e-12, "dual_inf_tol": 1e-12},
    "daqp": {"daqp": {"eps_prox": 1e-6}},
    "osqp": {"osqp": {"verbose": False, "eps_abs": 1e-10, "eps_rel": 1e-10, "max_iter": 100000, "polish": True}},
    "highs": {"highs": {"output_flag": False}},
    "proxqp": {},
    "piqp": {},
    "ipqp": {"print_header": False, "print_iter": False, "print_info": False},
}
QP_SOLVERS = tuple(QP_OPTIONS)
# These keep a hot start between calls: built afresh each time, so that a step depends on its arguments alone.
HIDDEN_MEMORY = frozenset({"qpoases", "osqp", "proxqp", "piqp"})


def solve_qp(name: str, W: np.ndarray, b: np.ndarray, law: NumericLaw, symmetric: bool) -> np.ndarray | None:
    """Return l (m,) as the solver gives it, unverified; None where it gives nothing finite."""
    m = law.size
    # QP solvers have absolute tolerances, a model has units.
    W, b, law, s = equilibrate_problem(W, b, law)
    if symmetric:
        H, g, A, below, above = (W + W.T) / 2, b, np.zeros((0, m)), np.zeros(0), np.zeros(0)
        lower, upper = law.lower, law.upper
    else:
        H, g, A, below, above, lower, upper = _gap_programme(W, b, law)
    with suppress_output():
        try:
            solver = (_build_conic_solver.__wrapped__ if name in HIDDEN_MEMORY else _build_conic_solver)(name, g.size, below.size)
            found = np.array(solver(h=H, g=g, a=A, lba=below, uba=above, lbx=lower, ubx=upper)["x"]).ravel()[:m]
        except RuntimeError:
            return None
    return found * s if np.isfinite(found).all() else None


def _gap_programme(W: np.ndarray, b: np.ndarray, law: NumericLaw) -> tuple[np.ndarray, ...]:
    """The gap QP in (l, y-), y+ = W l + b + y- eliminated; y- only where upper is finite, y+ = 0 where lower is not."""
    m, has_lo, capped = law.size, np.isfinite(law.lower), np.flatnonzero(np.isfinite(law.upper))
    lo, k = np.where(has_lo, law.lower, 0.0), capped.size
    down = np.eye(m)[:, capped]
    H = np.zeros((m + k, m + k))
    H[:m, :m] = W + W.T
    g = np.concatenate([b - W.T @ lo, law.upper[capped] - lo[capped]])
    A = np.hstack([W, down])
    lower = np.concatenate([law.lower, np.zeros(k)])
    upper = np.concatenate([law.upper, np.full(k, np.inf)])
    return H, g, A, -b, np.where(has_lo, np.inf, -b), lower, upper


@lru_cache(maxsize=64)
def _build_conic_solver(name: str, n: int, rows: int) -> ca.Function:
    return ca.conic(
        "step", name, {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(rows, n)},
        {"error_on_fail": False, "print_problem": False, "verbose": False, **QP_OPTIONS[name]},
    )  # fmt: skip


SEMISMOOTH_ITERATIONS = 60  # Of Newton's method on curved sets, at most; then it starts from Gauss and Seidel's answer. (+)
GAUSS_SEIDEL_SWEEPS = 400  # Projected gradient sweeps that give Newton's method a start, at most.
SWEPT = 1e-10  # Part of l: changes below this end the sweeps: the start is as good as they make it. (+)
# CONVERGED: 450 EPS.
CONVERGED = 1e-13  # The natural map, beside its terms, from which on an iteration that gains no factor 2 is the last. (+)
ACCEPTED = 1e-11  # The same up to which the last iteration is an answer; the certificate judges it. (+)
REGULARISATIONS = 14  # Decades, to 1e-13, through which a multiple of the identity, added to a singular W of contacts, falls.
ARMIJO = 1e-4  # Part of the decrease that a step promises which it must bring; else it is halved. Any small part does. (+)
# MIN_DAMPED_STEP: then it is taken all the same.
MIN_DAMPED_STEP = 1e-4  # Part of a step on curved sets below which it is not halved any more. (+)


def block_scale(W: np.ndarray, law: NumericLaw) -> np.ndarray:
    """The factor c of the natural map l - P_K(l - c y): one value for each row, equal within a curved block."""
    c = row_scale(W)
    for rows, _ in law.curved:
        c[rows] = c[rows].min()
    return c


def project_on_law(law: NumericLaw, u: np.ndarray) -> np.ndarray:
    """The projection P_K(u) of u on the set of the law."""
    l = np.clip(u, law.lower, law.upper)
    for rows, K in law.curved:
        l[rows] = K.project(u[rows])
    return l


def shifted_output(law: NumericLaw, y: np.ndarray) -> np.ndarray:
    """ŷ(y) (m,): y itself where the law is a normal cone."""
    if law.is_normal_cone:
        return y
    y = y.copy()
    for rows, K in law.curved:
        y[rows] = K.shifted(y[rows])
    return y


def _times_shift_jacobian(law: NumericLaw, y: np.ndarray, W: np.ndarray) -> np.ndarray:
    """dŷ/dy W, (m, m)."""
    if law.is_normal_cone:
        return W
    W = W.copy()
    for rows, K in law.curved:
        W[rows] = K.shift_jacobian(y[rows]) @ W[rows]
    return W


def law_projection_jacobian(law: NumericLaw, u: np.ndarray) -> np.ndarray:
    """An element of the generalised Jacobian of P_K at u, (m, m)."""
    J = np.diag(((u > law.lower) & (u < law.upper)).astype(float))
    for rows, K in law.curved:
        J[rows, rows] = K.jacobian(u[rows])
    return J


def curved_index_set(law: NumericLaw, l: np.ndarray, y: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Codes of (l, y): rows of a block share one; 0 where y = 0, -1 where l = 0 (cone), +1 on the curved boundary."""
    u = l - c * shifted_output(law, y)
    code = np.where(u <= law.lower, -1, np.where(u >= law.upper, 1, 0)).astype(np.int8)
    for rows, K in law.curved:
        code[rows] = K.code(u[rows])
    return code


def semismooth_newton(W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray) -> np.ndarray | None:
    """Solve l = P_K(l - c ŷ(W l + b)) from ``l``; None if it does not converge."""
    c, eye = block_scale(W, law), np.eye(law.size)
    l = project_on_law(law, l)
    if not np.isfinite(l).all():
        return None

    def natural_map(l: np.ndarray) -> np.ndarray:
        return l - project_on_law(law, l - c * shifted_output(law, W @ l + b))

    F, best = natural_map(l), np.inf
    for _ in range(SEMISMOOTH_ITERATIONS):
        size, relative = safe_norm(F), _relative_natural_map(F, c, W, b, law, l)
        if relative <= SUM_ERROR * EPS or (relative <= CONVERGED and relative >= best / 2):
            return l
        best = min(best, relative)
        y = W @ l + b
        P = law_projection_jacobian(law, l - c * shifted_output(law, y))
        step = solve_or_least_squares(eye - P @ (eye - c[:, None] * _times_shift_jacobian(law, y, W)), -F)
        if not np.isfinite(step).all():
            return None
        t = 1.0
        while safe_norm(natural_map(l + t * step)) > (1 - ARMIJO * t) * size and t > MIN_DAMPED_STEP:
            t /= 2
        l = l + t * step
        F = natural_map(l)
    return l if _relative_natural_map(F, c, W, b, law, l) <= ACCEPTED else None


def _relative_natural_map(F: np.ndarray, c: np.ndarray, W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray) -> float:
    """The largest part of the natural map beside what it consists of: |l|, c |W| |l|, and the radius of a bounded set, or c |b|
    for other rows, which at a bound have F = 0. A row far from its bound, or a ball that slides fast, says nothing about the size
    of the others.
    """
    size, extent = np.abs(F), c * np.abs(b)
    for rows, K in law.curved:
        if K.is_bounded:
            extent[rows] = K.radius
    scale = np.abs(l) + c * (np.abs(W) @ np.abs(l)) + extent
    for rows, _ in law.curved:
        size[rows], scale[rows] = size[rows].max(), scale[rows].max()
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(size == 0, 0.0, size / scale)
    return float(np.where(np.isnan(ratio), np.inf, ratio).max(initial=0.0))


def projected_gauss_seidel(W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray) -> np.ndarray:
    """Projected block gradient sweeps: slow, but convergent for symmetric psd W. Gives Newton a start near the solution."""
    l = project_on_law(law, l)
    start = l.copy()
    blocks: list[tuple[slice, CurvedSet | None]] = list(law.curved)
    in_block = np.zeros(law.size, bool)
    for rows, _ in blocks:
        in_block[rows] = True
    blocks += [(slice(i, i + 1), None) for i in np.flatnonzero(~in_block)]
    steps = [1 / max(np.linalg.norm(W[rows, rows], 2), np.finfo(float).tiny) for rows, _ in blocks]
    for _ in range(GAUSS_SEIDEL_SWEEPS):
        if not np.isfinite(l).all() or np.abs(l).max(initial=0.0) > 1e100:  # it diverges: W is not symmetric psd
            return start
        old = l.copy()
        for (rows, K), step in zip(blocks, steps, strict=True):
            y = W[rows] @ l + b[rows]
            if K is not None and (own := K.block_solution(W[rows, rows], y - W[rows, rows] @ l[rows])) is not None:
                l[rows] = own
                continue
            u = l[rows] - step * y
            l[rows] = np.clip(u, law.lower[rows], law.upper[rows]) if K is None else K.project(u)
        if np.abs(l - old).max(initial=0.0) <= SWEPT * np.abs(l).max(initial=0.0):
            break
    return l if np.isfinite(l).all() else start


def polish_curved_solution(W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Polish: keep the curved rows' smooth branch, put l = 0 and l = bound exactly where the index set says so."""
    y = W @ l + b
    code = curved_index_set(law, l, y, block_scale(W, law))
    return friction_contacts.solve_on_modes(W, b, law, l, y, code), code


INDEX_SET, LEMKE, ENUMERATION, SEMISMOOTH = "index set", "lemke", "enumeration", "semismooth"
NEARBY = "semismooth nearby"  # Newton's method from the last multiplier alone: what polishes an answer of another solver.


MAX_ENTRY_RATIO = 1e4  # Entries of W that differ by more are in units that pivoting feels: four digits of 16 are lost. (~)


@dataclass(frozen=True)
class MlcpSolution:
    """l (m,), its index set (m,), the law's residual, and the solver that found it."""

    l: np.ndarray
    index: np.ndarray
    residual: float
    solver: str


def affine_law_residual(W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray, unseen: Any = 0.0) -> np.ndarray:
    """Return the law's residual of each row at y = W l + b; ``unseen``: of y, see `law_residual`."""
    size = np.abs(W)
    w_max = size.max(axis=1, initial=0.0)
    return law_residual(law, l, W @ l + b, output_scale(b, size @ np.abs(l), w_max), w_max, unseen)


def _residual_with_rounding(
    W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray, index: np.ndarray, tolerance: float
) -> np.ndarray:
    """The residual where W and b, and by them l, are known to rounding only."""
    free = index == 0
    error, of = np.abs(W) @ np.abs(l) + np.abs(b), np.zeros(law.size)
    if free.any():
        of[free] = row_maxima(dense_solution_errors(W[np.ix_(free, free)], error[free]))
    c_u = ROUNDING * UNIT_ROUND_OFF / tolerance
    return affine_law_residual(W, b, law, l, c_u * (error + np.abs(W) @ of))


def solve_mlcp(
    W: np.ndarray, b: np.ndarray, law: NumericLaw, warm: np.ndarray, index: np.ndarray, chain: Sequence[str], symmetric: bool,
    tolerance: float,
) -> MlcpSolution:  # fmt: skip
    """Try the solvers of ``chain`` in turn and return the first answer below ``tolerance``, else the best one.

    ``warm`` and ``index`` are the last multiplier and index set. An answer that no solver could give has residual inf.
    """
    if not (np.isfinite(W).all() and np.isfinite(b).all()):
        return MlcpSolution(np.full(law.size, np.nan), index, np.inf, "none")
    units = equilibrating_units(W, law)
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


def equilibrating_units(W: np.ndarray, law: NumericLaw) -> tuple[np.ndarray, np.ndarray] | None:
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
        if (found := active_set.primal_dual_active_set(W, b, law, index)) is not None:
            yield found
        return
    if name == ENUMERATION:
        for code in active_set.enumerate_index_sets(law, index):
            if (l := active_set.solve_on_index_set(W, b, law, code)) is not None:
                yield l, code
        return
    if name == NEARBY:
        if (l := semismooth_newton(W, b, law, warm)) is not None:
            yield from _curved_candidates(W, b, law, l)
        return
    if name == SEMISMOOTH and law.is_normal_cone:
        for start in (warm, np.zeros_like(warm)):
            l = semismooth_newton(W, b, law, start)
            if l is None:
                l = semismooth_newton(W, b, law, projected_gauss_seidel(W, b, law, start))
            if l is not None:
                yield from _curved_candidates(W, b, law, l)
        return
    if name == SEMISMOOTH:
        for l, code in _friction_candidates(W, b, law, warm, index):
            if (np.abs(W) @ np.abs(l)).max() <= active_set.CANCELLED * np.abs(b).max():  # else W l + b is lost in rounding
                yield l, code
        return
    l = active_set.lemke(W, b, law) if name == LEMKE else solve_qp(name, W, b, law, symmetric)
    if l is None:
        return
    y = W @ l + b
    y[np.abs(y) <= SUM_ERROR * EPS * (np.abs(W) @ np.abs(l) + np.abs(b))] = 0.0  # a tie: a row at its bound stays there
    code = active_set.estimate_index_set(l, y, law, active_set.row_scale(W))
    if (polished := active_set.solve_on_index_set(W, b, law, code)) is not None:
        yield polished, code
    yield l, code
    # Rows that are small beside others may be on the wrong side.
    if (near := active_set.primal_dual_active_set(W, b, law, code)) is not None:
        yield near


def _curved_candidates(W: np.ndarray, b: np.ndarray, law: NumericLaw, l: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    yield polish_curved_solution(W, b, law, l)
    yield l, curved_index_set(law, l, W @ l + b, block_scale(W, law))


def _friction_candidates(
    W: np.ndarray, b: np.ndarray, law: NumericLaw, warm: np.ndarray, index: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Of several answers the first in a fixed order: the last modes, from the last multiplier, all that close stuck, from 0.

    Where the last multiplier is 0 it says nothing, and contacts that close stick first.
    """
    if all((index[rows] == index[rows][0]).all() for rows, _ in law.curved):  # Every contact has a mode.
        yield friction_contacts.solve_on_modes(W, b, law, warm, W @ warm + b, index), index
    starts = [warm] if warm.any() else []
    associated = friction_contacts.associated_law(law)
    stuck = semismooth_newton(W, b, associated, np.zeros_like(warm))
    if stuck is None:
        swept = projected_gauss_seidel(W, b, associated, np.zeros_like(warm))
        stuck = semismooth_newton(W, b, associated, swept)
        stuck = swept if stuck is None else stuck
    for start in (*starts, stuck, np.zeros_like(warm)):
        if (l := semismooth_newton(W, b, law, start)) is not None:
            yield from _curved_candidates(W, b, law, l)
    for start in (warm, np.zeros_like(warm)):
        swept = projected_gauss_seidel(W, b, law, start)
        if (l := semismooth_newton(W, b, law, swept)) is not None:
            yield from _curved_candidates(W, b, law, l)
        yield from _curved_candidates(W, b, law, swept)
    if (l := _continued(W, b, law)) is not None:
        yield from _curved_candidates(W, b, law, l)
    if friction_contacts.is_in_the_plane(law):
        yield from friction_contacts.solutions_on_all_modes(W, b, law)
        if (l := friction_contacts.solve_by_lemke(W, b, law)) is not None:
            yield from _curved_candidates(W, b, law, l)


def _continued(W: np.ndarray, b: np.ndarray, law: NumericLaw) -> np.ndarray | None:
    """The l of W + delta max |W_ij| I from 0, each from the last one, as delta falls from 1 by tens; then of W itself."""
    l, size = np.zeros(law.size), np.abs(W).max(initial=0.0)
    for decade in range(REGULARISATIONS):
        found = semismooth_newton(W + 10.0**-decade * size * np.eye(law.size), b, law, l)
        l = l if found is None else found
    return semismooth_newton(W, b, law, l)
