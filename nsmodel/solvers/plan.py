"""What a scene needs and what it does not: the choice of path and solvers, with reasons (`--explain`).

What interpreted steps and compilers take, and when compiling pays: seconds as functions of the structure, never of a clock.

A run is compiled where building, or loading what was built before, takes less than its interpreted steps; compiled ones take
1 % to 5 % of these. The numbers were fitted to the CPU time of generating, compiling and stepping the cases, chains of 8 to 300
masses with friction, and random Lur'e systems of up to 25 states and 20 rows, with GCC on a busy machine, and brought to an idle
one by known times (a relay's step 4 us, a step by Newton's method 0.35 ms, building a relay 0.4 s). How many iterations a step
takes is not known beforehand: index sets changed at one step in ten.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.errors import UsageError
from nsmodel.modeling.laws import Law
from nsmodel.solvers import mlcp
from nsmodel.solvers.newton import uses_working_set
from nsmodel.solvers.one_step_problem import OneStepProblem
from nsmodel.solvers.residuals import NumericLaw
from nsmodel.solvers.structure import StepStructure, is_eigenvalue_nonnegative, least_eigenvalue

if TYPE_CHECKING:
    from scipy.sparse.linalg import LinearOperator

    from nsmodel.solvers.sparse import BandOrdering

DUAL_ACTIVE_SET, IPOPT_SOLVER = "dual active set", "ipopt"
INTERNAL_SOLVERS = {
    "active-set": mlcp.INDEX_SET,
    "lemke": mlcp.LEMKE,
    "enumeration": mlcp.ENUMERATION,
    "semismooth": mlcp.SEMISMOOTH,
}
STEP_SOLVERS = ("auto", *mlcp.QP_SOLVERS, IPOPT_SOLVER, *INTERNAL_SOLVERS)
MAX_ENUMERATED_ROWS = 10  # Rows up to which all index sets are tried where the other solvers find none: 1024 take 0.15 s.
MIN_SPARSE_SIZE = 120  # Unknowns and multipliers of a sparse step: of a chain it takes as long as a dense one, preparing it half.
MAX_SPARSE_FILL = 0.1  # Part of its matrix that may be nonzero: factors of fuller ones fill in.


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
        kinds = " and ".join(dict.fromkeys(K.plural for _, K in law.curved))
        raise UsageError(f"solver '{solver}' does not apply: the law has {kinds}; use semismooth or ipopt")
    if solver in mlcp.QP_SOLVERS and not monotone:
        raise UsageError(
            f"solver '{solver}' does not apply: the step is not a convex QP (least eigenvalue of W + W' {least:.3g}); "
            "use active-set, lemke, enumeration or ipopt"
        )


def _plan_lines(
    path: str, structure: StepStructure, law: NumericLaw, monotone: bool, least: float
) -> tuple[list[str], list[str]]:
    """What is used and what is left out."""
    n, m = structure.n, structure.m
    size = f"{n} unknown{'s' * (n != 1)}, {m} multiplier{'s' * (m != 1)}"
    newton, affine, box = path == "newton", structure.affine, m > 0 and not law.curved
    not_psd = box and not monotone
    used = {
        f"{size}, {structure.nonzeros} nonzeros of {(n + m) ** 2}": True,
        "constant matrices: factored once for each step size, one function call a step": path == "kernel",
        "one linearisation a step": newton and affine,
        "Newton's method with exact Jacobians: E or Y is not affine": newton and not affine,
        "W symmetric psd: a box QP": box and monotone and structure.symmetric,
        f"W psd{', not known to be symmetric' * (m != 1)}: a gap QP": box and monotone and not structure.symmetric,
        f"W not psd (least eigenvalue {least:.3g}): complementarity conditions; uniqueness is not guaranteed": not_psd,
    }
    left_out = {
        "multipliers and every solver: the model has no law": not m,
        "Newton iterations, Jacobian evaluations: E and Y are affine with constant coefficients": not newton,
        "Newton iterations: E and Y are affine in the unknowns": newton and affine,
        "linear systems: E_z is the identity": structure.identity and n > 0,
        "quadratic programmes: not convex here": not_psd,
        "rows that the prediction satisfies: they enter only if the solution violates them": newton
        and uses_working_set(structure, law),
    }
    return [line for line, holds in used.items() if holds], [line for line, holds in left_out.items() if holds]


REPEATED_PATH = "repeated"  # The path "newton" where most steps are those of `repeated`.
LOADING_SECONDS = 0.05  # Seconds for finding a library that was built before, its hash, and loading it.


class CompilationCost(NamedTuple):
    """Seconds of one interpreted step, and of building the compiled one: 0 where it is there."""

    step: float
    building: Callable[[], float]

    def pays(self, steps: int) -> bool:
        """Whether compiling takes less time than so many steps."""
        saved = steps * self.step - LOADING_SECONDS
        return saved > 0 and saved > self.building()

    def text(self, steps: int, what: str = "steps") -> str:
        """Why it does not, as a line of what is left out."""
        return f"{what} in C: {steps:,} interpreted {what} take about {steps * self.step:.2g} s, building them would take longer"


def interpreted_step_seconds(path: str, structure: StepStructure | None, law: Law) -> float:
    """Seconds of a step on a path of a `Plan`, or REPEATED_PATH; None: the structure of a projection on given sets.

    Of a law with curved sets Newton's method takes most of it: fitted to scenes of 2 to 36 rows, with friction and with balls.
    """
    if structure is None:
        return 2.5e-4
    curved, size = any(block.kind != "box" for block in law.blocks), structure.n + structure.m
    if path == "kernel":
        return 4.5e-4 if curved else 4.5e-6 + 2.5e-7 * structure.m**2
    if curved and path == "newton":
        return 3.7e-4 + 4e-6 * size**2
    if path == REPEATED_PATH:
        return 3e-5 + 1e-6 * size**2
    return 1.3e-4 + 2.8e-7 * size if path == "sparse" else 3.2e-4 + 4.4e-6 * size


def build_seconds(path: str, structure: StepStructure | None, problem: OneStepProblem) -> float:
    """Seconds for building the steps of a path: C for its graph, tables for its matrices."""
    if structure is None:
        return 1.6
    size = structure.n + structure.m
    if path == "sparse":
        return 1.0 + 1.0e-3 * size
    graph = ca.densify(ca.vertcat(problem.E, problem.Y))
    nodes = ca.Function("step", [ca.vertcat(*ca.symvar(graph))], [graph]).n_instructions()
    return 0.45 + 1.0e-3 * size**2 + 8.5e-4 * nodes if path == "kernel" else 1.2 + 8e-4 * nodes


def is_fixed_code_faster(path: str, structure: StepStructure | None, problem: OneStepProblem, steps: int) -> bool:
    """Whether so many steps pay for code of the values at hand alone, where there may be one library for all of them.

    That has the matrices of "kernel" as numbers: by what a step of it is faster was fitted to 1 + 1 to 25 + 20 unknowns and
    multipliers, C against C. Other paths have the same code either way, but for large sparse matrices, which must be numbers.
    """
    if path != "kernel" or structure is None:
        return path == "sparse"
    size = structure.n + structure.m
    return steps * (2e-8 + 5e-9 * size + 1.7e-9 * size**2) > build_seconds(path, structure, problem)


def bodies_cost(count: int, solver: Callable[[], bool], own: Callable[[], bool]) -> CompilationCost:
    """The cost of many bodies; whether the solver, which all models share, and the model's own functions are built."""
    return CompilationCost(1.4e-3 + 5e-6 * count, lambda: 4.5 * (not solver()) + 0.15 * (not own()))


def pieces_cost(size: int, rows: int, built: Callable[[], bool]) -> CompilationCost:
    """The cost of event-driven pieces: ``size`` states and rows, operations of f, g and h besides; whether they are built."""
    return CompilationCost(1e-3 + 1e-4 * size + 2e-5 * rows, lambda: 0.0 if built() else 1.0 + 2e-4 * rows + 2e-3 * size)
