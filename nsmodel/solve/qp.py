"""y = W l + b, -y ∈ N_[lower, upper](l) with W psd as a quadratic programme for CasADi's conic solvers.

Symmetric W: the box QP min 1/2 l'W l + b'l. Otherwise the gap QP, whose value is 0 iff the problem is solvable:
min l'(W l + b) - lower'y+ + upper'y- over lower <= l <= upper, y+ - y- = W l + b, y+, y- >= 0.
"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from nsmodel.proof.quiet import suppress_output
from nsmodel.solve.active_set import equilibrate_problem
from nsmodel.solve.certificate import NumericLaw

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
