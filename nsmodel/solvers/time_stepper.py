"""The stepper of a one-step problem: attempts in order, the first certified one is the step.

The step of a problem whose matrices move with inputs that take few values: its matrices are kept for each of these.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.errors import StepError, UsageError
from nsmodel.proof.verdict import not_none
from nsmodel.solvers import active_set, mlcp
from nsmodel.solvers.constant_matrices import StepKernel
from nsmodel.solvers.diagnosis import describe_overreach, explain_step_failure, find_empty_law
from nsmodel.solvers.fallbacks import NonlinearProgramme, connected_parts, part_problem
from nsmodel.solvers.linearisation import ENOUGH, BufferedStepFunction, Iterate
from nsmodel.solvers.newton import MAX_GRAPH_UNKNOWNS, LastIndexSetStep, NewtonSolver
from nsmodel.solvers.one_step_problem import OneStepProblem
from nsmodel.solvers.plan import DUAL_ACTIVE_SET, choose_plan, is_sparse_step_faster
from nsmodel.solvers.residuals import REACH, STRICTER, numeric_law
from nsmodel.solvers.step import RowLayout, StepResult, WarmStart
from nsmodel.solvers.structure import MAX_DENSE_UNKNOWNS, read_step_structure

if TYPE_CHECKING:
    from nsmodel.solvers.sparse import FactoredJacobian, SparseStepSolver

# NEARBY_SETS: one of the last ways.
NEARBY_SETS = 400  # Index sets around the last one that are tried where Newton's method does not settle.
RANDOM_STARTS = 3  # Random starts of IPOPT, after the last multiplier and 0: each is a whole solve, when all else has failed.


class StepAttempt(NamedTuple):
    """What one way of computing the step gave."""

    residual: float
    row: np.ndarray
    warm: WarmStart
    solver: str
    worst_row: int | None = None


class Stepper:
    """The step of one bound model; see `stepper` for the contract."""

    def __init__(
        self, problem: OneStepProblem, solver: str, tolerance: float, *, h: float, state: np.ndarray, few_steps: bool = True
    ) -> None:
        """Prepare steps from ``state``; ``few_steps`` says that few step sizes will occur, so that each may be factored."""
        self.problem, self.structure = problem, read_step_structure(problem)
        self.law, self.layout, self.tolerance = numeric_law(problem.law), RowLayout.of(problem), tolerance
        self.rows = problem.rows
        self._velocity = self.layout.slices[problem.velocity] if problem.velocity and problem.difference else None
        self._kernels: dict[float, StepKernel] = {}
        self._programme: NonlinearProgramme | None = None
        self._built_at = h, state
        self._sparse: SparseStepSolver | None = None
        order = None
        if solver == "auto" and is_sparse_step_faster(self.structure, self.law):
            from nsmodel.solvers.sparse import SparseStepSolver

            self._sparse = SparseStepSolver(problem, self.structure, self.law, tolerance)
            at = _factored_jacobian(self._sparse, 0.0, h)
            start, order = at.W(), at.order
        else:
            zero = np.zeros(self.structure.m)
            start = self._newton.mlcp_matrix(0.0, h, state, self._newton.guess(0.0, h, state, zero), zero)
            start = self._newton.scale_to_law(start, 0.0, h, state)
        self.plan = choose_plan(self.structure, self.law, start, solver, few_steps, order)

    @cached_property
    def _newton(self) -> NewtonSolver:
        return NewtonSolver(self.problem, self.structure, self.law, self.tolerance)

    @cached_property
    def _last_index_set_step(self) -> LastIndexSetStep | None:
        """The step on the last index set of a problem whose matrices change, where it is small enough for one graph."""
        s = self.structure
        if self.plan.path != "newton" or not self.plan.use_last or self.law.curved or not 0 < s.n + s.m <= MAX_GRAPH_UNKNOWNS:
            return None
        found = LastIndexSetStep(self._newton, self.layout)
        return found if found.useful else None

    @property
    def repeats(self) -> bool:
        """Whether a step on the last index set costs little though the matrices change."""
        return self._last_index_set_step is not None

    @property
    def least_eigenvalue(self) -> float:
        """Least eigenvalue of the scaled W + W' met so far, at the start included."""
        return min(self.plan.least_eigenvalue, np.inf if self._sparse else self._newton.least_eigenvalue)

    def include_eigenvalue(self, least_eigenvalue: float) -> None:
        """Note what steps met that were computed elsewhere."""
        if self.problem.scale is not None:
            return
        self._newton.least_eigenvalue = min(self._newton.least_eigenvalue, least_eigenvalue)

    def cold_start(self) -> WarmStart:
        """The warm start of a first step: l = 0 moved into K, everything inactive that can be."""
        l = np.clip(np.zeros(self.law.size), self.law.lower, self.law.upper)
        return WarmStart(l, np.where(self.law.lower == 0, -1, 0).astype(np.int8))

    def __call__(self, t: float, h: float, state: np.ndarray, warm: WarmStart, k: int = 0) -> StepResult:
        """Advance ``state`` (packed) from t to t + h; the step's number ``k`` changes nothing.

        Raises:
            StepError: no solver reached the tolerance, or the velocity overflows.
        """
        found = self._step(t, h, state, warm)
        if self._velocity is not None and h < 1 and not np.isfinite(found.row[self._velocity]).all():
            raise StepError(f"no verified step from t = {t:.10g} to {t + h:.10g}: the velocity overflows; take a longer step")
        return found

    def _step(self, t: float, h: float, state: np.ndarray, warm: WarmStart) -> StepResult:
        if self._sparse is not None:
            return self._sparse_step(self._sparse, t, h, state, warm)
        kernel = self._kernels.get(h) or self._build_kernel(t, h)
        if kernel is not None and self.plan.use_last and (warm.index is kernel.loaded or kernel.load(warm.index)):
            out = kernel.evaluate(t, state)
            enough = self.tolerance * (ENOUGH if kernel.singular else 1.0)
            if kernel.consistent[0] and out[self.layout.residual] <= enough and not (self.law.curved or kernel.fragile):
                return StepResult(out + 0.0, warm, "last index set")  # + 0.0: a copy without -0
        if (
            self._last_index_set_step is not None
            and (again := self._last_index_set_step.call(t, h, state, warm.l, warm.index)) is not None
        ):
            row, reach = again
            if reach > REACH:
                self._check_linearisation_reach(t, h, state, row)
            return StepResult(row, WarmStart(row[self.layout.l], warm.index), mlcp.INDEX_SET if self.law.size else "none needed")
        best: StepAttempt | None = None
        for attempt in self._step_attempts(kernel, t, h, state, warm):
            if attempt.residual <= self.tolerance:
                self._check_linearisation_reach(t, h, state, attempt.row)
                return StepResult(attempt.row, attempt.warm, attempt.solver)
            if best is None or attempt.residual < best.residual:
                best = attempt
        raise self._step_error(t, h, state, warm, best)

    def _check_linearisation_reach(self, t: float, h: float, state: np.ndarray, row: np.ndarray) -> None:
        """Refuse a verified step of a linearisation that means nothing where it leads.

        Raises:
            StepError: a constraint that acts is far from its linearisation (`OneStepProblem.overreach`).
        """
        acts = row[self.layout.l] != 0
        if self.problem.overreach is None or not acts.any():
            return
        ratio = np.where(acts, self._overreach_function(t, h, state, row[: self.structure.n])[0], 0.0)
        worst = int(np.argmax(ratio))
        if ratio[worst] <= REACH:
            return
        raise StepError(
            f"no verified step from t = {t:.10g} to {t + h:.10g}: {describe_overreach(self.rows[worst], ratio[worst])}, or rtol",
            residual=float(ratio[worst]),
            component=self.rows[worst],
        )

    @cached_property
    def _overreach_function(self) -> BufferedStepFunction:
        p = self.problem
        return BufferedStepFunction("overreach", [p.t, p.h, p.state, p.z], [not_none(p.overreach)])

    def _sparse_step(self, sparse: SparseStepSolver, t: float, h: float, state: np.ndarray, warm: WarmStart) -> StepResult:
        """The step of a large scene; one that is small enough for dense matrices goes to the other solvers where that fails."""
        _factored_jacobian(sparse, t, h)
        found = sparse.solve(t, h, state, warm.index)
        if not found.residual <= self.tolerance and np.isfinite(state).all():
            chains = (("qpoases",) if self.plan.monotone else (mlcp.INDEX_SET,)), (mlcp.LEMKE,)
            for chain in chains:
                if not found.residual <= self.tolerance:
                    found = sparse.solve_by_parts(t, h, state, warm.l, warm.index, chain)
                    found.solver = chain[0]
        if not found.residual <= self.tolerance:
            if self.structure.n + self.structure.m > MAX_DENSE_UNKNOWNS or not np.isfinite(state).all():
                raise self._sparse_step_error(t, h, state, found)
            chain = (mlcp.INDEX_SET, *(("qpoases",) if self.plan.monotone else ()), mlcp.LEMKE)
            found = self._newton.solve(t, h, state, warm.l, warm.index, chain)
            if not found.residual <= self.tolerance and self._independent_parts:
                found = self._solve_by_parts(t, h, state, warm) or found
            if not found.residual <= self.tolerance:
                raise self._step_error(t, h, state, warm, self._pack_attempt(t, h, state, found))
        row = sparse.pack(t, h, state, found)
        same = np.array_equal(found.index, warm.index)
        return StepResult(row, warm if same else WarmStart(row[self.layout.l], found.index), found.solver)

    def _build_kernel(self, t: float, h: float) -> StepKernel | None:
        """The kernel of this h, built at its first use; None where a step is linearised instead."""
        if self.plan.path != "kernel":
            return None
        try:
            self._kernels[h] = StepKernel(self.problem, self.structure, self.law, h, self.tolerance)
        except np.linalg.LinAlgError:
            raise singular_matrix_error(t, h) from None
        return self._kernels[h]

    def _step_attempts(
        self, kernel: StepKernel | None, t: float, h: float, state: np.ndarray, warm: WarmStart
    ) -> Iterator[StepAttempt]:
        if self.plan.ipopt != "always":
            if kernel is not None:
                yield from self._kernel_attempts(kernel, t, state, warm)
            else:
                found = self._newton.solve(t, h, state, warm.l, warm.index, self.plan.chain)
                yield self._pack_attempt(t, h, state, found)
                if self.plan.use_last and self._independent_parts and (alone := self._solve_by_parts(t, h, state, warm)):
                    yield self._pack_attempt(t, h, state, alone)
                if self.plan.use_last and not self.law.curved:
                    yield from self._nearby_index_set_attempts(t, h, state, warm)
        if self.plan.dual:
            found = self._newton.solve_nearest_point(t, h, state)
            if found is not None:
                yield self._pack_attempt(t, h, state, replace(found, solver=DUAL_ACTIVE_SET))
        if self.plan.ipopt != "never":
            yield from self._ipopt_attempts(t, h, state, warm)

    def _kernel_attempts(self, kernel: StepKernel, t: float, state: np.ndarray, warm: WarmStart) -> Iterator[StepAttempt]:
        """Solve y = W l + b, then evaluate the step on the index set found, else at the multiplier found.

        An index set that the first solver finds, and that the step itself calls for, is not judged by W and b before.
        """
        chain, b = self.plan.chain, kernel.b(t, state)
        if chain[:1] == (mlcp.INDEX_SET,) and kernel.is_well_scaled:
            first = active_set.primal_dual_active_set(kernel.W, b, self.law, warm.index)
            if first is None:
                chain = chain[1:]
            elif kernel.load(first[1]) and not (kernel.fragile or kernel.singular):
                attempt = self._evaluate_kernel(kernel, t, state, first[1], mlcp.INDEX_SET)
                if kernel.consistent[0]:
                    yield attempt
        while chain:
            found = mlcp.solve_mlcp(
                kernel.W, b, self.law, warm.l, warm.index, chain, self.structure.symmetric, self.tolerance / STRICTER
            )
            if not np.isfinite(found.l).all():
                break
            yield from self._attempts_from_solution(found, kernel, b, t, state)
            tried = chain.index(found.solver) + 1 if found.solver in chain else len(chain)
            chain = chain[tried:]  # W may keep too little to tell what solves the step
        if self.law.curved or not self.plan.use_last:
            return
        for index in (warm.index, np.zeros_like(warm.index)):  # from the last one, and with all rows held
            whole = self._newton.solve_whole_system(t, kernel.h, state, warm.l, index)
            if whole is not None:
                yield self._pack_attempt(t, kernel.h, state, replace(whole, solver=mlcp.INDEX_SET))

    def _attempts_from_solution(
        self, found: mlcp.MlcpSolution, kernel: StepKernel, b: np.ndarray, t: float, state: np.ndarray
    ) -> Iterator[StepAttempt]:
        """The steps that a solution of y = W l + b makes."""
        if not self.law.curved and kernel.load(found.index):
            eliminated = self._evaluate_kernel(kernel, t, state, found.index, found.solver)
            if kernel.fragile or (kernel.singular and eliminated.residual > ENOUGH * self.tolerance):
                whole = self._newton.solve_whole_system(t, kernel.h, state, found.l, found.index)
                if whole is not None:
                    yield self._pack_attempt(t, kernel.h, state, replace(whole, solver=found.solver))
            yield eliminated
        kernel.load_multiplier(found.l, found.index)
        attempt = self._evaluate_kernel(kernel, t, state, found.index, found.solver)
        if self.law.curved:  # the kernel's own residual covers the boxes only
            by_row = mlcp.affine_law_residual(kernel.W, b, self.law, found.l)
            curved = max(float(by_row[rows].max()) for rows, _ in self.law.curved)
            attempt = attempt._replace(residual=max(attempt.residual, curved))
        attempt.row[self.layout.residual] = attempt.residual
        yield attempt
        polished = self._newton.polish_on_index_set(t, kernel.h, state, found.l, found.index)
        if polished is not None:
            yield self._pack_attempt(t, kernel.h, state, replace(polished, solver=found.solver))

    def _evaluate_kernel(self, kernel: StepKernel, t: float, state: np.ndarray, index: np.ndarray, solver: str) -> StepAttempt:
        row = kernel.evaluate(t, state) + 0.0
        return StepAttempt(float(row[self.layout.residual]), row, WarmStart(row[self.layout.l], index), solver)

    def _pack_attempt(self, t: float, h: float, state: np.ndarray, found: Iterate) -> StepAttempt:
        row = self._newton.pack(t, h, state, found)
        return StepAttempt(found.residual, row, WarmStart(found.l, found.index), found.solver, found.worst_row)

    def _nearby_index_set_attempts(self, t: float, h: float, state: np.ndarray, warm: WarmStart) -> Iterator[StepAttempt]:
        """At a switch Newton's index set may alternate: try those around the last one, each a smooth system."""
        z = self._newton.guess(t, h, state, warm.l)
        for count, index in enumerate(active_set.enumerate_index_sets(self.law, warm.index)):
            if count == NEARBY_SETS:
                return
            found = self._newton.solve_on_index_set(t, h, state, z, warm.l, index)
            if found is not None:
                yield self._pack_attempt(t, h, state, found)

    @cached_property
    def _independent_parts(self) -> list[tuple[np.ndarray, np.ndarray, Stepper]]:
        """The parts that do not touch, and their steps, prepared where this one was: no step depends on which came before."""
        problem, (h, state) = self.problem, self._built_at
        parts = connected_parts(problem) if self.law.size else []
        if len(parts) < 2:
            return []
        return [
            (z, l, Stepper(part_problem(problem, z, l), "auto", self.tolerance, h=h, state=state, few_steps=False))
            for z, l in parts
        ]

    def _solve_by_parts(self, t: float, h: float, state: np.ndarray, warm: WarmStart) -> Iterate | None:
        """The parts that do not touch, each alone: Newton's method on the whole is not that on its parts."""
        newton = self._newton
        z, l, index = np.zeros(self.structure.n), warm.l.copy(), warm.index.copy()
        for of_z, of_l, stepper in self._independent_parts:
            try:
                found = stepper(t, h, state, WarmStart(warm.l[of_l], warm.index[of_l]))
            except StepError:
                return None
            z[of_z], l[of_l], index[of_l] = found.row[stepper.layout.slices["z"]], found.row[stepper.layout.l], found.warm.index
        at = newton.linearise(t, h, state, z, l)
        return newton.evaluate_residual(newton.known(t, h, state), at, l, index, "by parts", 1)

    def _ipopt_attempts(self, t: float, h: float, state: np.ndarray, warm: WarmStart) -> Iterator[StepAttempt]:
        """IPOPT on the whole step from the last multiplier, from 0 and from a spread of starts; polished on its index set."""
        if self._programme is None:
            self._programme = NonlinearProgramme(self.problem, self.law)
        law, z = self.law, self._newton.guess(t, h, state, warm.l)
        inside = np.clip(np.zeros(law.size), law.lower, law.upper)
        span = np.where(np.isfinite(law.upper - law.lower), law.upper - law.lower, 1 + np.abs(warm.l))
        spread = np.random.default_rng(0).uniform(-1, 1, (RANDOM_STARTS, law.size))
        for start in (warm.l, inside, *np.clip(inside + span * spread, law.lower, law.upper)):
            found = self._programme.solve(t, h, state, z, start)
            polished = None if found is None else self._polish_ipopt_solution(t, h, state, *found)
            if polished is not None:
                polished.solver = "ipopt"
                yield self._pack_attempt(t, h, state, polished)

    def _polish_ipopt_solution(
        self, t: float, h: float, state: np.ndarray, z: np.ndarray, l: np.ndarray, y: np.ndarray
    ) -> Iterate | None:
        W = self._newton.mlcp_matrix(t, h, state, z, l)
        if W is None:
            return None
        if self.law.curved:
            index = mlcp.curved_index_set(self.law, l, y, mlcp.block_scale(W, self.law))
            return self._newton.solve(t, h, state, l, index, (mlcp.SEMISMOOTH if self.law.is_normal_cone else mlcp.NEARBY,))
        index = active_set.estimate_index_set(l, y, self.law, active_set.row_scale(W))
        return self._newton.solve_on_index_set(t, h, state, z, l, index)

    def _sparse_step_error(self, t: float, h: float, state: np.ndarray, found: Iterate) -> StepError:
        size = self.structure.n + self.structure.m
        if (empty := find_empty_law(self.problem, t, h, state)) is not None:
            return empty
        if not np.isfinite(state).all():
            reason = "the state is not finite"
        else:
            reason = (
                f"no index set was found that satisfies the law, by block principal pivoting from the last one ({size} unknowns "
                f"and multipliers; above {MAX_DENSE_UNKNOWNS} no dense solver is tried); try a smaller step"
            )
        component = None if found.worst_row is None else self.rows[found.worst_row]
        worst = "" if component is None else f", worst row '{component}'"
        return StepError(
            f"no verified step from t = {t:.10g} to {t + h:.10g}: {reason}. "
            f"Best residual {found.residual:.3g} (tolerance {self.tolerance:.3g}){worst}",
            residual=found.residual,
            component=component,
        )

    def _step_error(self, t: float, h: float, state: np.ndarray, warm: WarmStart, best: StepAttempt | None) -> StepError:
        if (empty := find_empty_law(self.problem, t, h, state)) is not None:
            return empty
        W, b = self._newton.affine_problem(t, h, state, warm.l)
        at = self._newton.linearise(t, h, state, self._newton.guess(t, h, state, warm.l), warm.l)
        finite = bool(np.isfinite(at.E).all())
        reason = explain_step_failure(
            self.problem, self.structure, self.law, self.plan, W, b, (t, h, state), finite, self._newton.least_eigenvalue
        )
        residual = np.inf if best is None else best.residual
        component = None if best is None or best.worst_row is None else self.rows[best.worst_row]
        worst = "" if component is None else f", worst row '{component}'"
        tried = ", ".join(self.plan.solvers) or (
            ", ".join(("block principal pivoting", mlcp.INDEX_SET, mlcp.LEMKE))
            if self.structure.m
            else "the linear system of the step"
            if self.structure.affine
            else "Newton's method"
        )
        start, end = f"{t:.10g}", f"{t + h:.10g}"
        span = f"from t = {start} to {end}" if start != end else f"of {h:.3g} from t = {start}"
        return StepError(
            f"no verified step {span}: {reason}. "
            f"Best residual {residual:.3g} (tolerance {self.tolerance:.3g}){worst}. Tried: {tried}",
            residual=residual,
            component=component,
        )


def singular_matrix_error(t: float, h: float) -> StepError:
    """The error where E_z is singular."""
    return StepError(f"the step's matrix is singular at h = {h:g} (t = {t:g}): change the step a little, or check M, A and K")


def _factored_jacobian(sparse: SparseStepSolver, t: float, h: float) -> FactoredJacobian:
    """The matrices of a large scene at this h."""
    try:
        return sparse.at(h)
    except np.linalg.LinAlgError:
        raise singular_matrix_error(t, h) from None


class ReactionInitialiser:
    """Completes a state by the multiplier that solves the law there, for schemes that carry what it pushes (gamma < 1)."""

    def __init__(self, problem: OneStepProblem, tolerance: float, *, h: float, state: np.ndarray) -> None:
        self._stepper = Stepper(problem, "auto", tolerance, h=h, state=state)

    def __call__(self, t: float, h: float, state: np.ndarray) -> np.ndarray:
        """The state with what l pushes it by at time t; StepError where the law has no multiplier there."""
        try:
            return self._stepper(t, h, state, self._stepper.cold_start()).row[self._stepper.layout.state]
        except StepError as error:
            where = f"t = {t:.10g}" if t else "the start"
            message = f"gamma < 1 needs a multiplier at {where}, and the law has none there: {error}"
            raise StepError(message, residual=error.residual, component=error.component) from None


def completed_start_state(problem: OneStepProblem, state: np.ndarray, h: float, tolerance: float) -> np.ndarray:
    """What a run starts from: ``state``, completed by the multiplier that solves the law there where the scheme needs one.

    Raises:
        UsageError: the law has no multiplier at the start.
    """
    if problem.start is None:
        return state
    try:
        return ReactionInitialiser(problem.start, tolerance, h=h, state=state)(0.0, h, state)
    except StepError as error:
        raise UsageError(str(error)) from None


MAX_KEPT_MODES = 16  # Modes whose matrices are kept; where inputs have more the step is linearised each time.


class ModewiseStepper:
    """A stepper for each mode, made where it is first met; what is asked of it but a step is that of the first.

    ``at``: where the state has the values that make a mode; ``names``: of the inputs.
    """

    def __init__(
        self, problem: OneStepProblem, at: Sequence[int], names: Sequence[str], solver: str, tolerance: float,
        *, h: float, state: np.ndarray, few_steps: bool = True,
    ) -> None:  # fmt: skip
        """Prepare the modes, see `Stepper`."""
        self.problem, self._at, self._how = problem, np.array(at), (solver, tolerance)
        self._options: dict[str, Any] = {"h": h, "few_steps": few_steps}
        self._steppers: dict[bytes, Stepper] = {}
        first = self._stepper_for(state)
        self.plan = replace(first.plan, used=(*first.plan.used, f"matrices are kept for each mode of {', '.join(names)}"))
        self.layout, self.rows, self.structure, self.tolerance = first.layout, first.rows, first.structure, tolerance
        self.repeats, self.cold_start, self.include_eigenvalue = first.repeats, first.cold_start, first.include_eigenvalue

    @property
    def least_eigenvalue(self) -> float:
        """The least of those met in all modes."""
        return min(stepper.least_eigenvalue for stepper in self._steppers.values())

    def __call__(self, t: float, h: float, state: np.ndarray, warm: WarmStart, k: int = 0) -> StepResult:
        """Take the step of the mode that the state is in."""
        try:
            return self._stepper_for(state)(t, h, state, warm, k)
        except np.linalg.LinAlgError as error:
            raise find_empty_law(self.problem, t, h, state) or error from None

    def _stepper_for(self, state: np.ndarray) -> Stepper:
        key = state[self._at].tobytes()
        if key not in self._steppers:
            if len(self._steppers) >= MAX_KEPT_MODES:
                self._steppers.clear()
            mode = substitute_mode(self.problem, self._at, state)
            self._steppers[key] = Stepper(mode, *self._how, state=state, **self._options)
        return self._steppers[key]


def substitute_mode(problem: OneStepProblem, at: Sequence[int] | np.ndarray, state: np.ndarray) -> OneStepProblem:
    """The problem with the numbers that a state has in some places; what a step passes on stays as it is."""
    symbols, values = problem.state[list(at)], ca.SX(state[list(at)].tolist())

    def substituted(part: ca.SX | None) -> Any:
        return None if part is None else ca.substitute(part, symbols, values)

    names = ("E", "Y", "guess", "multipliers", "outputs", "overreach")
    return replace(
        problem, **{name: substituted(getattr(problem, name)) for name in names},
        records={name: substituted(record) for name, record in problem.records.items()},
    )  # fmt: skip


def mode_state_indices(problem: OneStepProblem, few: Sequence[int | None], state: np.ndarray) -> list[int]:
    """Where the state has inputs of few values that the matrices move with; empty where these are not constant without them.

    ``few``: of each input how many values it takes, None: any.
    """
    nu, end = problem.inputs, problem.state.numel()
    if not nu or read_step_structure(problem).constant or not any(few):
        return []
    matrices = ca.veccat(*problem.jacobians)
    found, modes = [], 1
    for i, count in enumerate(few):
        places = [place for place in (end - 2 * nu + i, end - nu + i) if ca.depends_on(matrices, problem.state[place])]
        if places and count is not None:
            found += places
            modes *= count
    return (
        found
        if found and modes <= MAX_KEPT_MODES and read_step_structure(substitute_mode(problem, found, state)).constant
        else []
    )
