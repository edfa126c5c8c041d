"""The whole one-step problem as a nonlinear programme for IPOPT: the last resort, and a solver to compare with.

    min sum of gaps   s.t.  E(z, l) = 0,  y = Y(z, l),  l ∈ K

The gap of a box row is (l - lower) y+ + (upper - l) y-, with y = y+ - y-, y+, y- >= 0; of a ball l'y + radius |y|; of a cone
l'y with y ∈ K.
Its value is 0 iff (z, l) solves the step.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.proof.quiet import suppress_output
from nsmodel.scheme.problem import OneStepProblem
from nsmodel.solve.certificate import NumericLaw

ABS_SMOOTHING = 1e-30  # Keeps the derivative of |y| finite at 0.
IPOPT_OPTIONS = {
    "print_time": False,
    "error_on_fail": False,
    "show_eval_warnings": False,
    "ipopt": {
        "print_level": 0, "sb": "yes", "tol": 1e-12, "acceptable_tol": 1e-9, "max_iter": 500, "bound_relax_factor": 0.0,
        "mu_strategy": "adaptive", "honor_original_bounds": "yes",
    },
}  # fmt: skip


class NonlinearProgramme:
    """The programme of one problem, built once; a solve is a pure function of its arguments."""

    def __init__(self, problem: OneStepProblem, law: NumericLaw) -> None:
        p, m = problem, problem.l.numel()
        up, down = ca.SX.sym("y_up", m), ca.SX.sym("y_down", m)
        has_lo, has_up = np.isfinite(law.lower), np.isfinite(law.upper)
        curved = np.zeros(m, bool)
        for rows, _ in law.curved:
            curved[rows] = True
        gap, extra, y = ca.SX(0), [], up - down
        for i in np.flatnonzero(~curved).tolist():
            gap += (p.l[i] - law.lower[i]) * up[i] if has_lo[i] else 0
            gap += (law.upper[i] - p.l[i]) * down[i] if has_up[i] else 0
        for rows, K in law.curved:
            own, inequalities = K.complementarity(p.l[rows.start : rows.stop], y[rows.start : rows.stop], ABS_SMOOTHING)
            gap += own
            extra += inequalities
        unknowns = ca.vertcat(p.z, p.l, up, down)
        equations = ca.vertcat(p.E, p.Y - y)
        self._n, self._m, self._equations = p.z.numel(), m, equations.numel()
        self._inequalities = len(extra)
        self._lower = np.concatenate([np.full(self._n, -np.inf), law.lower, np.zeros(2 * m)])
        self._upper = np.concatenate([
            np.full(self._n, np.inf), law.upper,
            np.where(has_lo | curved, np.inf, 0.0), np.where(has_up | curved, np.inf, 0.0),
        ])  # fmt: skip
        nlp = {"x": unknowns, "f": gap, "g": ca.vertcat(equations, *extra), "p": ca.vertcat(p.t, p.h, p.state)}
        self._solver = ca.nlpsol("step", "ipopt", nlp, IPOPT_OPTIONS)
        self._Y = ca.Function("Y", [nlp["p"], p.z, p.l], [ca.densify(p.Y)])

    def solve(
        self, t: float, h: float, state: np.ndarray, z: np.ndarray, l: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Return (z, l, y) as IPOPT leaves them, unverified, from the start (z, l); None where they are not finite."""
        known = np.concatenate([[t, h], state])
        y = np.array(self._Y(known, z, l)).ravel()
        start = np.concatenate([z, l, np.maximum(y, 0), np.maximum(-y, 0)])
        zero = np.zeros(self._equations)
        try:
            with suppress_output():
                found = self._solver(
                    x0=start, p=known, lbx=self._lower, ubx=self._upper,
                    lbg=np.concatenate([zero, np.zeros(self._inequalities)]),
                    ubg=np.concatenate([zero, np.full(self._inequalities, np.inf)]),
                )  # fmt: skip
        except RuntimeError:
            return None
        x = np.array(found["x"]).ravel()
        if not np.isfinite(x).all():
            return None
        z, l = x[: self._n], x[self._n : self._n + self._m]
        return z, l, np.array(self._Y(known, z, l)).ravel()
