"""What a scene needs and what it does not: the choice of path and solvers, with reasons (`--explain`)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from nsmodel.errors import UsageError
from nsmodel.laws import CURVED_KINDS
from nsmodel.scheme.problem import OneStepProblem
from nsmodel.solve import mlcp, qp
from nsmodel.solve.certificate import NumericLaw
from nsmodel.solve.newton import uses_working_set
from nsmodel.solve.structure import StepStructure, is_eigenvalue_nonnegative, least_eigenvalue

if TYPE_CHECKING:  # SciPy is loaded by who uses it.
    from scipy.sparse.linalg import LinearOperator

    from nsmodel.solve.band import BandOrdering

DUAL_ACTIVE_SET, IPOPT_SOLVER = "dual active set", "ipopt"
INTERNAL_SOLVERS = {
    "active-set": mlcp.INDEX_SET,
    "lemke": mlcp.LEMKE,
    "enumeration": mlcp.ENUMERATION,
    "semismooth": mlcp.SEMISMOOTH,
}
STEP_SOLVERS = ("auto", *qp.QP_SOLVERS, IPOPT_SOLVER, *INTERNAL_SOLVERS)
MAX_ENUMERATED_ROWS = 10
MIN_SPARSE_SIZE = 120  # Unknowns and multipliers from which on a sparse step pays.
MAX_SPARSE_FILL = 0.1  # Part of its matrix that may be nonzero.


@dataclass(frozen=True)
class Plan:
    """How a step is computed.

    Attributes:
        path: "sparse" (large, constant, sparse matrices), "kernel" (constant matrices) or "newton".
        chain: solvers of the affine problem in the order in which they are tried.
        use_last: whether the last index set is tried before the chain.
        ipopt: whether the whole step goes to IPOPT, always ("always") or when the chain has failed ("last").
        monotone: whether W + W' is psd at the start; least_eigenvalue: its least eigenvalue, scaled by W's diagonal.
        used, left_out: lines for `--explain`.
        dual: whether the step is a nearest point that goes to the dual active set method when the chain has failed.
    """

    path: str
    chain: tuple[str, ...]
    use_last: bool
    ipopt: str
    monotone: bool
    least_eigenvalue: float
    used: tuple[str, ...]
    left_out: tuple[str, ...]
    dual: bool = False

    @property
    def solvers(self) -> tuple[str, ...]:
        """What is tried, in this order."""
        return (*self.chain, *((DUAL_ACTIVE_SET,) if self.dual else ()), *((IPOPT_SOLVER,) if self.ipopt != "never" else ()))

    def text(self, problem: OneStepProblem) -> str:
        """The plan for a person."""
        lines = [f"scheme    {problem.scheme}"]
        lines += [f"{'used' if i == 0 else '':9} {line}" for i, line in enumerate(self.used)]
        lines += [f"{'left out' if i == 0 else '':9} {line}" for i, line in enumerate(self.left_out)]
        return "\n".join(lines)


def is_sparse_step_faster(structure: StepStructure, law: NumericLaw) -> bool:
    """Whether a step is large, sparse and of constant matrices, and its law a box."""
    size = structure.n + structure.m
    sparse = size >= MIN_SPARSE_SIZE and structure.nonzeros <= MAX_SPARSE_FILL * size**2
    return sparse and structure.constant and not law.curved and not structure.projection


def choose_plan(
    structure: StepStructure, law: NumericLaw, W: np.ndarray | LinearOperator | None, solver: str, few_steps: bool = True,
    order: BandOrdering | None = None,
) -> Plan:  # fmt: skip
    """Decide, from the structure and from W at the start (None where it has none); ``order``: of a step that stays sparse.

    Raises:
        UsageError: ``solver`` is unknown, or does not apply to this problem.
    """
    if solver not in STEP_SOLVERS:
        raise UsageError(f"solver '{solver}' is unknown; choose one of {', '.join(STEP_SOLVERS)}")
    if structure.gram:
        least = 0.0  # W = Y_z Y_z' has no negative eigenvalue.
    else:
        least = least_eigenvalue(W) if W is not None else -np.inf
    monotone = is_eigenvalue_nonnegative(least, structure.m)
    path = "sparse" if order is not None else "kernel" if structure.constant and few_steps else "newton"
    used, left_out = _plan_lines(path, structure, law, monotone, least)
    if order is not None:
        used[1:1] = _sparse_plan_lines(order, structure)
        left_out.append("W, which is dense: each index set gives one sparse system for the unknowns and the multipliers")
        return Plan(path, (), True, "never", monotone, least, tuple(used), tuple(left_out))
    if solver == "auto":
        chain, dual = _solver_chain(structure, law, monotone), structure.nearest
        plan = Plan(path, chain, True, "last" if structure.m else "never", monotone, least, (), tuple(left_out), dual)
        if chain:
            first = () if law.curved or path == "newton" else ("last index set",)
            used.append("solvers, each answer polished and certified: " + ", ".join([*first, *plan.solvers]))
        return replace(plan, used=tuple(used))
    _check_solver_applies(solver, structure, law, monotone, least)
    used.append(f"solver {solver} alone (forced), its answer polished on the index set and certified")
    chain = () if solver == IPOPT_SOLVER else (INTERNAL_SOLVERS.get(solver, solver),)
    always = "always" if solver == IPOPT_SOLVER else "never"
    return Plan(path, chain, False, always, monotone, least, tuple(used), tuple(left_out))


def _sparse_plan_lines(order: BandOrdering, structure: StepStructure) -> list[str]:
    how = f"a band of {order.below} + 1 + {order.above} diagonals" if order.is_band else "sparse LU, the band being wide"
    lines = [f"sparse matrices, constant: {how}, factored again where the index set changes"]
    if structure.m:
        lines.append("index sets: the last one, then block principal pivoting from it; each answer certified")
    return lines


def _solver_chain(structure: StepStructure, law: NumericLaw, monotone: bool) -> tuple[str, ...]:
    if not structure.m:
        return ()
    if law.curved:
        return (mlcp.SEMISMOOTH,)
    enumeration = (mlcp.ENUMERATION,) if structure.m <= MAX_ENUMERATED_ROWS else ()
    return (mlcp.INDEX_SET, *(("qpoases",) if monotone else ()), mlcp.LEMKE, *enumeration)


def _check_solver_applies(solver: str, structure: StepStructure, law: NumericLaw, monotone: bool, least: float) -> None:
    if not structure.m:
        raise UsageError(f"solver '{solver}' does not apply: the model has no multipliers; leave --solver out")
    if law.curved and solver not in (IPOPT_SOLVER, "semismooth"):
        kinds = [f"{kind}s" for kind in CURVED_KINDS]
        either = f"{', '.join(kinds[:-1])} or {kinds[-1]}"
        raise UsageError(f"solver '{solver}' does not apply: the law has {either}; use semismooth or ipopt")
    if solver in qp.QP_SOLVERS and not monotone:
        raise UsageError(
            f"solver '{solver}' does not apply: the step is not a convex QP (least eigenvalue of W + W' {least:.3g}); "
            "use active-set, lemke, enumeration or ipopt"
        )


def _plan_lines(
    path: str, structure: StepStructure, law: NumericLaw, monotone: bool, least: float
) -> tuple[list[str], list[str]]:
    n, m = structure.n, structure.m
    size = f"{n} unknown{'s' * (n != 1)}, {m} multiplier{'s' * (m != 1)}"
    used, left_out = [f"{size}, {structure.nonzeros} nonzeros of {(n + m) ** 2}"], []
    if not m:
        left_out.append("multipliers and every solver: the model has no law")
    if path == "sparse":
        left_out.append("Newton iterations, Jacobian evaluations: E and Y are affine with constant coefficients")
    elif path == "kernel":
        used.append("constant matrices: factored once for each step size, one function call a step")
        left_out.append("Newton iterations, Jacobian evaluations: E and Y are affine with constant coefficients")
    elif structure.affine:
        used.append("one linearisation a step")
        left_out.append("Newton iterations: E and Y are affine in the unknowns")
    else:
        used.append("Newton's method with exact Jacobians: E or Y is not affine")
    if structure.identity and n:
        left_out.append("linear systems: E_z is the identity")
    if m and not law.curved:
        if monotone and structure.symmetric:
            used.append("W symmetric psd: a box QP")
        elif monotone:
            used.append("W psd: a gap QP" if m == 1 else "W psd, not known to be symmetric: a gap QP")
        else:
            used.append(f"W not psd (least eigenvalue {least:.3g}): complementarity conditions; uniqueness is not guaranteed")
            left_out.append("quadratic programmes: not convex here")
    if path == "newton" and uses_working_set(structure, law):
        left_out.append("rows that the prediction satisfies: they enter only if the solution violates them")
    return used, left_out
