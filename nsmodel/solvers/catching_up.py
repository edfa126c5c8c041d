"""The step of catching-up: choose a velocity, predict, project on C as well as the tolerance asks.

Exact (no tolerance): a clip where C is a box, else the projection problem with its certificate. With a tolerance eps_k the
point is wrong by what is allowed: for a box, moved towards the interior until 0.9 eps_k is used; for smooth constraints, the
first iterate of Newton's method whose pull-back into C is certified by the distance to a polyhedron that contains C.
The set is that of the end of the step, C(t + h), the velocity that of its beginning.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import casadi as ca
import numpy as np

from nsmodel._utils import EPS
from nsmodel.errors import ModelError, StepError
from nsmodel.solvers import mlcp
from nsmodel.solvers.one_step_problem import OneStepProblem, Prediction
from nsmodel.solvers.plan import Plan
from nsmodel.solvers.residuals import STRICTER, NumericLaw, law_residual, numeric_law
from nsmodel.solvers.rounding_errors import SUM_ERROR
from nsmodel.solvers.step import RowLayout, StepResult, WarmStart
from nsmodel.solvers.time_stepper import Stepper

USED = 0.9  # Part of eps_k that an approximate projection on a box uses up: what is left is for its rounding.
CUT_ITERATIONS = 60  # Outer polyhedra that are projected on, at most; then the step is refused, with its excess.
CUT_TOLERANCE = 1e-10  # Residual to which that is done: a tenth of the default tolerance of a step, to which it is held. (+)
ACTS = 1e-9  # A cut with |value| below this part of its size holds the foot; others are dropped, and come back if they act. (+)
BISECTIONS = 80  # On the way from that foot into C, at most: rounding ends them before, but on the first 2^-30 of the way.


class CatchingUpStepper:
    """The step of a problem that begins with a prediction; see `stepper` for the contract."""

    def __init__(
        self, problem: OneStepProblem, given: Prediction, solver: str, tolerance: float, *, h: float, state: np.ndarray
    ) -> None:
        self._nu = problem.inputs
        n, m = problem.state.numel() - 2 * self._nu, problem.l.numel()
        self.problem, self.tolerance, self.rows = problem, tolerance, problem.rows
        self.layout = catching_up_layout(problem, given)
        self._face, here = numeric_law(given.law), [problem.t, given.x, given.inputs]
        A = ca.densify(ca.jacobian(given.velocity, given.l))
        at_zero = ca.substitute([given.velocity], [given.l], [ca.SX.zeros(given.l.shape)])[0]
        self._velocity = ca.Function("velocity", here, [ca.densify(e) for e in (at_zero, A, given.u)])
        self._c = ca.Function("c", here, [ca.densify(given.c), ca.densify(ca.jacobian(given.c, given.x))])
        faces = ca.vertcat(given.u, given.c)
        self._faces = ca.Function("faces", here, [ca.densify(ca.jacobian(faces, s)) for s in (given.x, problem.t)])
        self._moving = ca.depends_on(faces, problem.t)
        self._box = given.box is not None
        self._bounds = box_bounds_function(given, problem.t)
        self._eps = tolerance_function(given.tolerances)
        self.exact = given.tolerances is None
        self._stepper = Stepper(problem, solver, tolerance, h=h, state=state)
        self._clip = self._box and solver == "auto"
        self.plan = self._stepper.plan if not self._clip else _clipping_plan(self._stepper.plan, self.exact)
        self._interior = _interior_finder(given, problem.t, h, state[:n]) if not (self.exact or self._box) else lambda t, y, u: y
        self._n, self._m = n, m

    @property
    def least_eigenvalue(self) -> float:
        """Least eigenvalue of the scaled W + W' of the projections so far."""
        return self._stepper.least_eigenvalue

    def include_eigenvalue(self, least_eigenvalue: float) -> None:
        """Note what steps met that were computed elsewhere."""
        self._stepper.include_eigenvalue(least_eigenvalue)

    def cold_start(self) -> WarmStart:
        """The warm start of a first step."""
        return self._stepper.cold_start()

    def __call__(self, t: float, h: float, state: np.ndarray, warm: WarmStart, k: int = 0) -> StepResult:
        """Advance ``state`` by mu_k = h; ``k`` picks eps_k where tolerances are a sequence.

        Raises:
            StepError: no selection or projection could be verified.
        """
        nu, given = self._nu, state[self._n :]
        state, begin, u = state[: self._n], given[:nu], given[nu:]
        v, selection, slack = self._select_velocity(t, state, begin)
        y = state + h * v
        eps, end = self._eps(k, h), t + h
        if self._clip:
            bounds = self._bounds(end, u)
            x, solver = np.clip(y, *bounds), "clip"
            d2 = float(np.sum((x - y) ** 2))
            l = self._box_multipliers(x - y, *bounds)
            index = np.where(l > 0, 0, -1).astype(np.int8)
            law = NumericLaw(*bounds, ())
            size = np.abs(y) + np.abs(x)
            clip_residual = law_residual(law, x, x - y, size, np.ones(x.size)).max(initial=0.0)
            residual, newton = max(slack, float(clip_residual)), 0
            if not residual <= self.tolerance:
                raise StepError(f"no verified projection at t = {t:.10g}: the predictor is {y}", residual=residual)
        elif eps > 0 and not self._box:
            x, l, d2, index, newton = self._approximate_projection(t, end, y, eps, u)
            residual, solver = slack, "outer approximation"
        else:
            found = self._stepper(t, h, np.concatenate([y, given]), warm)
            inner = self._stepper.layout
            x, l, index, solver = found.row[inner.state][: self._n], found.row[inner.l], found.warm.index, found.solver
            residual, newton = max(slack, found.row[inner.residual]), found.row[inner.newton]
            d2 = float(np.sum((x - y) ** 2))
        if eps > 0 and self._box:
            x = _move_inwards(x, y, eps, *self._bounds(end, u))
        e = x - y
        excess = max(float(e @ e) - d2, 0.0)
        c = np.array(self._c(end, x, u)[0]).ravel()
        row = np.concatenate([x, given, l, c, [residual, newton], v, selection, e, [np.sqrt(d2), excess, eps]])
        return StepResult(row, WarmStart(l, index), solver)

    def _select_velocity(self, t: float, x: np.ndarray, given: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """v ∈ F(x) - S(x) of least |P_{T_C(x)} v|, the element l of S that gives it, and the residual of that choice."""
        v_0, A, u = (np.array(part) for part in self._velocity(t, x, given))
        v_0, u = v_0.ravel(), u.ravel()
        if not (np.isfinite(v_0).all() and np.isfinite(u).all()):
            raise StepError(
                f"field - operator is not finite at t = {t:.10g}, x = {x}: a division by 0 or a root of a negative number?"
            )
        l, tied = self._determined_multipliers(u)
        if not tied.any():
            return v_0 + A @ l, l, 0.0
        c, J = (np.array(part) for part in self._c(t, x, given))
        acting = np.flatnonzero(c.ravel() <= 0)
        normals = J[acting]
        fixed = np.flatnonzero(~tied)
        base, free = v_0 + A[:, fixed] @ l[fixed], np.flatnonzero(tied)
        if self._moving:
            base = base - self._shared_velocity(t, x, given, np.concatenate([free, u.size + acting]))
        M = np.hstack([A[:, free], normals.T])
        W, b = M.T @ M, M.T @ base
        law = self._selection_law(tied, acting.size)
        chain = (mlcp.SEMISMOOTH,) if law.curved else (mlcp.INDEX_SET, "qpoases", mlcp.LEMKE)
        found = mlcp.solve_mlcp(W, b, law, np.zeros(b.size), np.zeros(b.size, np.int8), chain, True, self.tolerance / STRICTER)
        if found.residual > self.tolerance:
            raise StepError(f"no verified selection of the operator at t = {t:.10g}, x = {x}", residual=found.residual)
        l[free] = found.l[: free.size]
        return v_0 + A @ l, l, found.residual

    def _determined_multipliers(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The multipliers that u decides, 0 elsewhere, and which rows are left."""
        face, tied = self._face, u == 0
        l = np.where(tied, 0.0, np.where(u > 0, face.lower, face.upper))
        for rows, K in face.curved:
            tied[rows] = not u[rows].any()
            if u[rows].any():
                l[rows] = K.support_point(u[rows])
        return l, tied

    def _selection_law(self, tied: np.ndarray, k: int) -> NumericLaw:
        """The law of the rows that u leaves open, and of k constraints."""
        face, free = self._face, np.flatnonzero(tied)
        position = {int(i): j for j, i in enumerate(free)}
        curved = tuple(
            (slice(position[rows.start], position[rows.start] + rows.stop - rows.start), K)
            for rows, K in face.curved if tied[rows].all()
        )  # fmt: skip
        return NumericLaw(
            np.concatenate([face.lower[free], np.zeros(k)]), np.concatenate([face.upper[free], np.full(k, np.inf)]), curved
        )

    def _shared_velocity(self, t: float, x: np.ndarray, given: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """The least w with u_t + u_x w = 0, c_t + c_x w = 0 in the rows ``faces``: the velocity with which they move along."""
        slopes, rates = (np.array(part)[faces] for part in self._faces(t, x, given))
        return np.linalg.lstsq(slopes, -rates.ravel(), rcond=None)[0]

    def _box_multipliers(self, e: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        both = np.column_stack([e, -e])
        return np.where(both < 0, 0.0, both)[np.isfinite(np.column_stack([lower, upper]))]

    def _approximate_projection(
        self, t: float, end: float, y: np.ndarray, eps: float, u: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, float, np.ndarray, int]:
        """x ∈ C(end) with |x - y|^2 < d^2 + eps for a certified d <= d_C(y): (x, l, d^2, index set, iterations)."""
        inner = self._interior(end, y, u)
        c, J = self._constraint_values(end, y, u)
        if (c >= 0).all():
            return y.copy(), np.zeros(self._m), 0.0, np.full(self._m, -1, np.int8), 0
        z, best = y.copy(), np.inf
        cuts = [(J, c - J @ y, np.arange(self._m))]
        for iteration in range(1, CUT_ITERATIONS + 1):
            A, a = np.vstack([cut[0] for cut in cuts]), np.concatenate([cut[1] for cut in cuts])
            z, l = self._project_on_cuts(t, A, a, y)
            d2 = float(np.sum((z - y) ** 2))
            x = self._pull_back(end, z, inner, u)
            best = float(np.sum((x - y) ** 2)) - d2
            if best < eps:
                l = np.bincount(np.concatenate([cut[2] for cut in cuts]), l, self._m)  # the cuts of one constraint share it
                return x, l, d2, np.where(l > 0, 0, -1).astype(np.int8), iteration
            c, J = self._constraint_values(end, z, u)
            # C lies in every {c(z) + J(z)(x - z) >= 0}; those that no longer act are dropped.
            acts = [np.abs(Ai @ z + ai) <= ACTS * (1 + np.abs(ai)) for Ai, ai, _ in cuts]
            cuts = [tuple(part[keep] for part in cut) for cut, keep in zip(cuts, acts, strict=True) if keep.any()]
            cuts.append((J, c - J @ z, np.arange(self._m)))
        raise StepError(f"approximate projection at t = {t:.10g}: excess {best:.3g} stays above eps_k = {eps:.3g}", residual=best)

    def _project_on_cuts(self, t: float, A: np.ndarray, a: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        m = a.size
        law = NumericLaw(np.zeros(m), np.full(m, np.inf), ())
        W, b = A @ A.T, A @ y + a
        chain, index = (mlcp.INDEX_SET, "qpoases", mlcp.LEMKE), np.where(b < 0, 0, -1).astype(np.int8)
        found = mlcp.solve_mlcp(W, b, law, np.zeros(m), index, chain, True, CUT_TOLERANCE)
        if found.residual > self.tolerance:
            raise StepError(
                f"approximate projection at t = {t:.10g}: the projection on the linearised set was not found",
                residual=found.residual,
            )
        return y + A.T @ found.l, found.l

    def _pull_back(self, t: float, z: np.ndarray, inner: np.ndarray, u: np.ndarray) -> np.ndarray:
        """The first point of C from z towards an inner one (c concave: bisection on one crossing)."""
        if (self._constraint_values(t, z, u)[0] >= 0).all():
            return z
        low, high = 0.0, 1.0
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            if (self._constraint_values(t, z + middle * (inner - z), u)[0] >= 0).all():
                high = middle
            else:
                low = middle
            if high - low <= SUM_ERROR * EPS * high:
                break
        return z + high * (inner - z)

    def _constraint_values(self, t: float, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        c, J = self._c(t, x, u)
        return np.array(c).ravel(), np.array(J).reshape(-1, self._n)


def catching_up_layout(problem: OneStepProblem, given: Prediction) -> RowLayout:
    """A packed row: that of the projection problem, then what catching-up records."""
    n = problem.state.numel() - 2 * problem.inputs
    return RowLayout.of(problem, v=n, selection=given.l.numel(), defect=n, predictor_distance=1, excess=1, tolerance=1)


def tolerance_function(given: Any) -> Callable[[int, float], float]:
    """eps_k as a function of the step's number and length."""
    if given is None:
        return lambda k, h: 0.0
    if callable(given):
        return lambda k, h: float(cast(float, given(h)))
    values = np.atleast_1d(np.asarray(given, float))
    return lambda k, h: float(values[min(k, values.size - 1)])


def box_bounds_function(given: Prediction, t: ca.SX) -> Callable[[float, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """(lower, upper) of the box as a function of time and inputs."""
    if given.box is None:
        return lambda at, u: (np.zeros(0), np.zeros(0))
    f = ca.Function("box", [t, given.inputs], [ca.densify(bound) for bound in given.box])

    def at(time: float, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        lower, upper = f(time, u)
        return np.array(lower).ravel(), np.array(upper).ravel()

    def checked_bounds(time: float, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        lower, upper = at(time, u)
        for i in np.flatnonzero(lower > upper):
            raise StepError(f"C is empty at t = {time:.10g}: lower[{i}] = {lower[i]:.10g} > upper[{i}] = {upper[i]:.10g}")
        return lower, upper

    if ca.depends_on(ca.vertcat(*given.box), ca.vertcat(t, given.inputs)):
        return checked_bounds
    fixed = at(0.0, np.zeros(given.inputs.numel()))
    return lambda time, u: fixed


def _clipping_plan(plan: Plan, exact: bool) -> Plan:
    used = ("projection on bounds: a clip" + ("" if exact else ", then moved inwards by what eps_k allows"),)
    return replace(plan, path="clip", chain=(), ipopt="never", used=used, left_out=("every solver: C is a box",))


def _move_inwards(p: np.ndarray, y: np.ndarray, eps: float, lo: np.ndarray, up: np.ndarray) -> np.ndarray:
    """A point of C with |x - y|^2 <= d_C(y)^2 + 0.9 eps: from the projection p towards the middle of the box."""
    both = np.isfinite(lo) & np.isfinite(up)
    reach = 1 + np.abs(p)
    with np.errstate(invalid="ignore"):  # inf - inf where there is no bound
        middle = np.where(both, (lo + up) / 2, np.where(np.isfinite(lo), p + reach, np.where(np.isfinite(up), p - reach, p)))
    d = middle - p
    size, slope = float(d @ d), float((p - y) @ d)
    if size == 0:
        return p
    s = (-slope + np.sqrt(slope**2 + size * USED * eps)) / size
    return np.clip(p + min(s, 1.0) * d, lo, up)


InteriorPointFinder = Callable[[float, np.ndarray, np.ndarray], np.ndarray]  # (t, x0, u) -> x.


def _interior_finder(given: Prediction, t: ca.SX, h: float, x0: np.ndarray) -> InteriorPointFinder:
    """A point of the interior of C(t), as a function of t and of where the search begins; one for all t where C stands still."""
    find, driven = interior_point_search(given, t), ca.depends_on(given.c, given.inputs)
    if ca.depends_on(given.c, t) or driven:
        if not driven:
            find(h, x0, np.zeros(given.inputs.numel()))
        return find
    fixed = find(0.0, x0, np.zeros(given.inputs.numel()))
    return lambda time, start, u: fixed


def interior_point_search(given: Prediction, t: ca.SX) -> InteriorPointFinder:
    """Return what finds a point with c(t, x) > 0 (Slater), as deep as IPOPT finds within distance 1 of a start."""
    s = ca.SX.sym("s")
    solver = ca.nlpsol(
        "interior", "ipopt", {"x": ca.vertcat(given.x, s), "f": -s, "g": given.c - s, "p": ca.vertcat(t, given.inputs)},
        {"print_time": False, "error_on_fail": False, "ipopt": {"print_level": 0, "sb": "yes"}},
    )  # fmt: skip
    c = ca.Function("c", [t, given.x, given.inputs], [given.c])

    def find(time: float, x0: np.ndarray, u: np.ndarray) -> np.ndarray:
        top = np.append(np.full(x0.size, np.inf), 1.0)
        found = np.array(solver(x0=np.append(x0, 0.0), lbg=0, ubx=top, p=np.append(time, u))["x"]).ravel()[:-1]
        if not np.array(c(time, found, u)).min(initial=np.inf) > 0:
            raise ModelError(
                f"constraints: no point with all c(x) > 0 was found{_at_time_suffix(given, t, time)}; C needs an interior"
            )
        return found

    return find


def _at_time_suffix(given: Prediction, t: ca.SX, time: float) -> str:
    return f" at t = {time:.10g}" if ca.depends_on(given.c, t) else ""
