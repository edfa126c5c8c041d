"""From a one-step problem to a stepper: the kernel or Newton path, with the fallbacks and the errors."""

from __future__ import annotations

import numpy as np

from nsmodel.errors import StepError
from nsmodel.scheme.problem import OneStepProblem
from nsmodel.solve import active_set, cone, diagnose, mlcp
from nsmodel.solve.certificate import NumericLaw, law_residual, numeric_law
from nsmodel.solve.choose import Plan, choose
from nsmodel.solve.kernel import Kernel
from nsmodel.solve.layout import Layout
from nsmodel.solve.newton import Iterate, Newton
from nsmodel.solve.nlp import Programme
from nsmodel.solve.stepper import StepResult, Warm
from nsmodel.solve.structure import read

KERNELS = 8  # Step sizes for which constant matrices are kept factored; beyond, one linearisation a step is cheaper.


class Stepper:
    """The step of one bound model; see `stepper` for the contract."""

    def __init__(
        self, problem: OneStepProblem, solver: str = "auto", tolerance: float = 1e-9, *, t: float = 0.0, h: float, state: np.ndarray
    ) -> None:
        self.problem, self.structure = problem, read(problem)
        self.law, self.layout, self.tolerance = numeric_law(problem.law), Layout.of(problem), tolerance
        self.rows = problem.rows
        self._kernels: dict[float, Kernel] = {}
        self._programme: Programme | None = None
        self._newton = Newton(problem, self.structure, self.law, self.layout, (), tolerance)
        zero = np.zeros(self.structure.m)
        start = self._newton.matrix_at(t, h, state, self._newton.guess(t, h, state, zero), zero)
        self.plan: Plan = choose(problem, self.structure, self.law, start, solver)
        self._newton.chain = self.plan.chain

    def cold(self) -> Warm:
        """The warm start of a first step: l = 0 moved into K, everything inactive that can be."""
        law = self.law
        l = np.clip(np.zeros(law.size), law.lower, law.upper)
        index = np.where(law.lower == 0, -1, 0).astype(np.int8)
        return Warm(l, index)

    def __call__(self, t: float, h: float, state: np.ndarray, warm: Warm) -> StepResult:
        """Advance ``state`` (packed) from t to t + h.

        Raises:
            StepError: no solver reached the tolerance.
        """
        kernel = self._kernels.get(h) if self.plan.path == "kernel" else None
        if kernel is None:
            kernel = self._kernel(h, t)
            if kernel is None:
                return self._newton_step(t, h, state, warm)
        if self.plan.use_last:
            if warm.index is kernel.loaded or kernel.load(warm.index):
                out = kernel.evaluate(t, state)
                if kernel.settled[0] and out[self.layout.residual] <= self.tolerance and not self.law.curved:
                    return StepResult(out.copy(), warm, "last index set")
        return self._kernel_step(kernel, t, h, state, warm)

    def _kernel(self, h: float, t: float) -> Kernel | None:
        if self.plan.path != "kernel" or len(self._kernels) >= KERNELS:
            return None
        try:
            self._kernels[h] = Kernel(self.problem, self.structure, self.law, self.layout, h, self.tolerance)
        except np.linalg.LinAlgError:
            raise StepError(
                f"the step's matrix is singular at h = {h:g} (t = {t:g}): change the step a little, or check M, A and K"
            ) from None
        return self._kernels[h]

    def _kernel_step(self, kernel: Kernel, t: float, h: float, state: np.ndarray, warm: Warm) -> StepResult:
        best_row, best_index, best_residual, best_solver = None, warm.index, np.inf, "none"
        if self.plan.ipopt != "always":
            b = kernel.b(t, state)
            found = mlcp.solve(
                kernel.W, b, self.law, warm.l, warm.index, self.plan.chain, self.structure.symmetric, self.tolerance / 10
            ) if self.structure.m else mlcp.Solution(np.zeros(0), warm.index, 0.0, "none needed")  # fmt: skip
            if np.isfinite(found.l).all():
                for way in ("map", "multiplier"):
                    if way == "map" and (self.law.curved or not kernel.load(found.index)):
                        continue
                    if way == "multiplier":
                        kernel.load_multiplier(found.l, found.index)
                    out = kernel.evaluate(t, state)
                    residual = self._with_curved(kernel, out, b)
                    if residual < best_residual:
                        out[self.layout.residual] = residual
                        best_row, best_index, best_residual, best_solver = out.copy(), found.index, residual, found.solver
                    if best_residual <= self.tolerance:
                        return StepResult(best_row, Warm(best_row[self.layout.l], best_index), best_solver)
        if self.plan.ipopt != "never":
            iterate = self._ipopt(t, h, state, warm)
            if iterate is not None and iterate.residual <= self.tolerance:
                row = self._newton.pack(t, h, state, iterate)
                return StepResult(row, Warm(iterate.l, iterate.index), iterate.solver)
            if iterate is not None and iterate.residual < best_residual:
                best_residual = iterate.residual
        raise self._failure(t, h, state, best_residual, kernel.W, kernel.b(t, state), None)

    def _with_curved(self, kernel: Kernel, out: np.ndarray, b: np.ndarray) -> float:
        """The kernel's residual, with the curved blocks' own: they are not in its expressions."""
        residual = float(out[self.layout.residual])
        if self.law.curved:
            l, y = out[self.layout.l], kernel.W @ out[self.layout.l] + b
            s_y = np.abs(b) + np.abs(kernel.W) @ np.abs(l)
            all_rows = law_residual(self.law, l, y, s_y, kernel.w_max)
            residual = max(residual, *(float(all_rows[rows].max()) for _, rows, _ in self.law.curved))
        return residual if np.isfinite(residual) else np.inf

    def _newton_step(self, t: float, h: float, state: np.ndarray, warm: Warm) -> StepResult:
        best: Iterate | None = None
        if self.plan.ipopt != "always":
            best = self._newton.solve(t, h, state, warm.l, warm.index)
            if best.residual > self.tolerance and self.plan.use_last:
                best = min(best, self._nearby_index_sets(t, h, state, warm) or best, key=lambda i: i.residual)
        if (best is None or best.residual > self.tolerance) and self.plan.ipopt != "never":
            found = self._ipopt(t, h, state, warm)
            best = min((i for i in (best, found) if i is not None), key=lambda i: i.residual, default=None)
        if best is None or not best.residual <= self.tolerance:
            residual = np.inf if best is None else best.residual
            W, b = self._newton.affine_problem(t, h, state, warm.l)
            raise self._failure(t, h, state, residual, W, b, None if best is None else best.worst_row)
        return StepResult(self._newton.pack(t, h, state, best), Warm(best.l, best.index), best.solver)

    def _nearby_index_sets(self, t: float, h: float, state: np.ndarray, warm: Warm) -> Iterate | None:
        """At a switch Newton's index set may alternate: try the index sets around the last one, each a smooth system."""
        best = None
        if self.law.curved:
            return None
        z = self._newton.guess(t, h, state, warm.l)
        for count, index in enumerate(active_set.index_sets(self.law, warm.index)):
            if count >= 400:
                break
            found = self._newton.on_index_set(t, h, state, z, warm.l, index)
            if found is not None and (best is None or found.residual < best.residual):
                best = found
            if best is not None and best.residual <= self.tolerance:
                return best
        return best

    def _ipopt(self, t: float, h: float, state: np.ndarray, warm: Warm) -> Iterate | None:
        """IPOPT on the whole step from the last multiplier, from 0 and from a spread of starts; polished on its index set."""
        if self._programme is None:
            self._programme = Programme(self.problem, self.law)
        best, z0 = None, self._newton.guess(t, h, state, warm.l)
        rng = np.random.default_rng(0)
        inside = np.clip(np.zeros(self.law.size), self.law.lower, self.law.upper)
        span = np.where(np.isfinite(self.law.upper - self.law.lower), self.law.upper - self.law.lower, 1 + np.abs(warm.l))
        starts = [warm.l, inside, *(np.clip(inside + span * rng.uniform(-1, 1, inside.size), self.law.lower, self.law.upper) for _ in range(3))]
        for start in starts:
            found = self._programme.solve(t, h, state, z0, start)
            if found is None:
                continue
            iterate = self._polish_ipopt(t, h, state, *found)
            if iterate is not None and (best is None or iterate.residual < best.residual):
                best = iterate
            if best is not None and best.residual <= self.tolerance:
                break
        return best

    def _polish_ipopt(self, t: float, h: float, state: np.ndarray, z: np.ndarray, l: np.ndarray, y: np.ndarray) -> Iterate | None:
        W = self._newton.matrix_at(t, h, state, z, l)
        if W is None:
            return None
        if self.law.curved:
            index = cone.index_set(self.law, l, y, cone.block_scale(W, self.law))
            chain, self._newton.chain = self._newton.chain, (mlcp.SEMISMOOTH,)
            try:
                found = self._newton.solve(t, h, state, l, index)
            finally:
                self._newton.chain = chain
        else:
            index = active_set.classify(l, y, self.law, active_set.row_scale(W))
            found = self._newton.on_index_set(t, h, state, z, l, index)
        if found is not None:
            found.solver = "ipopt"
        return found

    def _failure(
        self, t: float, h: float, state: np.ndarray, residual: float, W: np.ndarray | None, b: np.ndarray | None, row: int | None
    ) -> StepError:
        reason = diagnose.why(self.problem, self.law, self.plan, W, b, state)
        worst = "" if row is None else f"; worst row: '{self.rows[row]}'"
        tried = ", ".join([*self.plan.chain, *(["ipopt"] if self.plan.ipopt != "never" else [])]) or "a linear solve"
        return StepError(
            f"no verified step from t = {t:.10g} to {t + h:.10g}: {reason}. Best residual {residual:.3g} (tolerance {self.tolerance:.3g})"
            f"{worst}. Tried: {tried}",
            residual=residual,
            component=None if row is None else self.rows[row],
        )
