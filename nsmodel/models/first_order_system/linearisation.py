"""The matrices of Newton's linearisation of a first-order system, exactly where they are constant, and where to look at them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from itertools import combinations
from math import comb
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import Scope
from nsmodel.hypotheses.region import BOX_GROWTH, Region
from nsmodel.modeling.laws import Law
from nsmodel.modeling.laws.base import Halfspaces
from nsmodel.models.first_order_system.model import FirstOrderSystem
from nsmodel.models.first_order_system.step_matrix import MlcpOfStep
from nsmodel.proof import conic, exact
from nsmodel.proof.domain import DefinednessResult, check_defined_in_time, is_defined_on_box
from nsmodel.proof.extremum import samples
from nsmodel.proof.jumps import ExpressionJump, find_jump, jump_nodes
from nsmodel.proof.verdict import HOLDS, UNKNOWN
from nsmodel.simulation.trajectory import Trajectory

# Rows of the runs that are looked at, evenly spread: each is differentiated, and its matrices are decided.
MAX_SAMPLED_RUN_ROWS = 100
# Sets of faces of a polyhedron that are looked at for corners, each by exact elimination; of more no corners are known.
MAX_FACE_SETS = 500
MIN_ENCLOSED_STATES = 64  # From so many states on W^{-1} is enclosed, where rational numbers get long,
MAX_ENCLOSED_CONDITION = 1e12  # if its condition is below: else the enclosure is too wide to show a sign.
REGION_SAMPLES = 32  # Points of the region that are looked at where there is no run; each is differentiated, as rows of runs are.


class Jacobians(NamedTuple):
    """A = f_x, C = h_x, D = h_l, K = g_x, B = g_l as expressions of (t, x, l)."""

    A: ca.SX
    C: ca.SX
    D: ca.SX
    K: ca.SX
    B: ca.SX


@dataclass(frozen=True)
class SystemLinearisation:
    """What the findings share.

    Attributes:
        model, jacobians: as they are.
        z: (t, x, l), with ``names``.
        lower, upper: the box of z: the region, and K or the box around the run's multipliers; ``where`` says so.
        points: (k, 1 + n + m) rows of the runs, or samples of the box.
        along: what the points are, in words.
        steps: the step lengths that occur, increasing.
        boxed: names of the multipliers whose box is that around the run.
    """

    model: FirstOrderSystem
    jacobians: Jacobians
    z: ca.SX
    names: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray
    where: str
    points: np.ndarray
    along: str
    steps: np.ndarray
    boxed: tuple[str, ...] = ()

    @property
    def timed(self) -> bool:
        """Whether f, h or g depends on t."""
        return bool(ca.depends_on(ca.vertcat(self.model.f, self.model.h, self.model.g), self.model.t))

    def scope(self, *, local: bool = True, timed: bool | None = None) -> Scope | None:
        """The box of z, of what is looked at for all states (``local`` False) its interval of time alone."""
        n = len(self.model.names)
        own = [i for i, name in enumerate(self.names) if 0 < i <= n or name in self.boxed] if local else []
        states = {self.names[i]: (float(self.lower[i]), float(self.upper[i])) for i in own}
        time = (float(self.lower[0]), float(self.upper[0])) if (self.timed if timed is None else timed) else None
        return Scope(states, time) if states or time else None

    @property
    def affine(self) -> bool:
        """Whether f, h and g are affine in x and l: then one Newton iteration is exact."""
        return self.defined_everywhere and not self.switches and not any(
            ca.depends_on(J, self.z[1:]) for J in self.jacobians if J.numel()
        )  # fmt: skip

    @cached_property
    def defined_everywhere(self) -> bool:
        """Whether no x or l leaves f, h or g without a value where their derivatives do not show that."""
        return self._is_defined(np.full(self.z.numel() - 1, -np.inf), np.full(self.z.numel() - 1, np.inf))

    def _is_defined(self, lower: np.ndarray, upper: np.ndarray) -> bool:
        stacked = ca.vertcat(self.model.f, self.model.h, self.model.g)
        ends = np.append(self.lower[:1], lower), np.append(self.upper[:1], upper)
        return is_defined_on_box(stacked, self.z[1:], self.z, *ends, bounded=ca.veccat(*self.jacobians))

    @cached_property
    def defined(self) -> DefinednessResult:
        """Whether f, h and g are finite at all times of the region, and on its box as far as their derivatives do not show."""
        stacked = ca.vertcat(self.model.f, self.model.h, self.model.g)
        in_time = check_defined_in_time(
            stacked, self.model.t, float(self.lower[0]), float(self.upper[0]), self.z[1:], self.points[0][1:]
        )
        if in_time.verdict != HOLDS or self.defined_everywhere or self._is_defined(self.lower[1:], self.upper[1:]):
            return in_time
        return DefinednessResult(UNKNOWN, f"an operation of them may have no value on {self.where}")

    @cached_property
    def switches(self) -> bool:
        """Whether f, h or g has an operation that can jump with x or l; its derivative, 0, does not show that."""
        return bool(jump_nodes(ca.vertcat(self.model.f, self.model.h, self.model.g), self.z[1:]))

    @cached_property
    def jump(self) -> ExpressionJump | None:
        """A point of the box where f, h or g jumps; None where none is found."""
        if not self.switches:
            return None
        stacked = ca.vertcat(self.model.f, self.model.h, self.model.g)
        return find_jump(stacked, self.z, self.lower, self.upper, lambda points: np.full(len(points), True))

    @property
    def constant(self) -> bool:
        """Whether all Jacobians are numbers."""
        return self.defined_everywhere and not any(ca.symvar(J) for J in self.jacobians)

    @cached_property
    def G(self) -> ca.SX:
        """Theta A + gamma K: W = M - h G."""
        return ca.simplify(self.model.theta * self.jacobians.A + self.model.gamma * self.jacobians.K)

    @property
    def is_W_constant(self) -> bool:
        """Whether W does not change with t, x and l."""
        return (
            self.defined_everywhere
            and not ca.symvar(self.jacobians.A if self.model.theta else ca.SX(1))
            and not ca.symvar(self.jacobians.K if self.model.gamma else ca.SX(1))
        )

    @cached_property
    def M(self) -> np.ndarray:
        """The mass matrix in Fractions."""
        return exact.rational(constant_matrix_values(self.model.M))

    def exact_G(self) -> np.ndarray:
        """Theta A + gamma K in Fractions, where it is constant."""
        return self._exact_G

    @cached_property
    def _exact_G(self) -> np.ndarray:
        theta, gamma = exact.rational([self.model.theta, self.model.gamma])
        n = len(self.M)
        A = exact.rational(constant_matrix_values(self.jacobians.A)) if theta else exact.zeros(n, n)
        K = exact.rational(constant_matrix_values(self.jacobians.K)) if gamma else exact.zeros(n, n)
        return theta * A + gamma * K

    def exact_W(self, h: float) -> np.ndarray:
        """M - h (theta A + gamma K) in Fractions, where it is constant."""
        return self.M - exact.rational([h])[0] * self.exact_G()

    @cached_property
    def mlcp_kind(self) -> str:
        """What W_mlcp is at all step lengths from the least to the largest that occur, where all is constant; '' elsewhere."""
        gamma, low, high = exact.rational([self.model.gamma, self.steps.min(), self.steps.max()])
        B, C, D = (exact.rational(constant_matrix_values(J)) for J in (self.jacobians.B, self.jacobians.C, self.jacobians.D))
        return MlcpOfStep(self.M, self.exact_G(), B, gamma * C, D).kind_for_all(low, high)

    def exact_mlcp(self, h: float) -> np.ndarray | None:
        """W_mlcp in Fractions, where all is constant; None where W is singular."""
        return self._once(self._exact_mlcp, h)

    @cached_property
    def _known(self) -> dict[tuple[str, float], np.ndarray | None]:
        return {}

    def _once(self, decide: Callable[[float], np.ndarray | None], h: float) -> np.ndarray | None:
        """What a method gives at a step length, computed at the first call."""
        if (key := (decide.__name__, h)) not in self._known:
            self._known[key] = decide(h)
        return self._known[key]

    def _exact_mlcp(self, h: float) -> np.ndarray | None:
        B, C, D = (exact.rational(constant_matrix_values(J)) for J in (self.jacobians.B, self.jacobians.C, self.jacobians.D))
        step, gamma = exact.rational([h, self.model.gamma])
        through = exact.solve_regular_system(self.exact_W(h), B)
        return None if through is None else D + exact.matrix_product(step * gamma * C, through)

    def definite_mlcp(self, h: float) -> np.ndarray | None:
        """W_mlcp in doubles, where it is proved positive definite; None elsewhere, and where W is small (see ``exact_mlcp``).

        With doubles R near W^{-1} and X near W^{-1} B, e = |I - R W| < 1 and F = B - W X: |W^{-1} B - X| <= |R| |F| / (1 - e) in
        each column, in the norm of the largest entry. All of this is rational arithmetic on short numbers, where the entries of
        W^{-1} have as many digits as det W.
        """
        return self._once(self._definite_mlcp, h)

    def _definite_mlcp(self, h: float) -> np.ndarray | None:
        if len(self.M) < MIN_ENCLOSED_STATES:
            return None
        B, C, D = (exact.rational(constant_matrix_values(J)) for J in (self.jacobians.B, self.jacobians.C, self.jacobians.D))
        W, (step, gamma) = self.exact_W(h), exact.rational([h, self.model.gamma])
        near = exact.doubles(W)
        if not np.linalg.cond(near) < MAX_ENCLOSED_CONDITION:
            return None
        inverse = np.linalg.inv(near)
        e = _row_sums(exact.scalar_minus(1, exact.matrix_product(inverse, W))).max()
        if e >= 1:
            return None
        X = exact.rational(inverse @ exact.doubles(B))
        columns = abs(B - exact.matrix_product(W, X)).max(axis=0) * _row_sums(exact.rational(inverse)).max() / (1 - e)
        errors = step * gamma * _row_sums(C)[:, None] * columns
        middle = D + exact.matrix_product(step * gamma * C, X)
        error = max(_row_sums(errors).max(), _row_sums(errors.T).max())  # Of the symmetric part, in the spectral norm.
        return exact.doubles(middle) if exact.definiteness(-exact.scalar_minus(error, middle)).definite else None

    def values(self, matrix: ca.SX) -> np.ndarray:
        """A matrix at all points, (k, rows, columns)."""
        f = ca.Function("values", [self.z], [ca.densify(matrix)])
        return np.array([np.array(f(point)).reshape(matrix.shape) for point in self.points])

    def mlcp_values(self, h: float) -> np.ndarray:
        """W_mlcp at all points (k, m, m), NaN where W is singular."""
        W = constant_matrix_values(self.model.M) - h * self.values(self.G)
        B, C, D = (self.values(J) for J in (self.jacobians.B, self.jacobians.C, self.jacobians.D))
        out = np.full(D.shape, np.nan)
        for k in range(len(W)):
            if np.isfinite(W[k]).all() and np.linalg.cond(W[k]) < 1e15:
                out[k] = D[k] + h * self.model.gamma * C[k] @ np.linalg.solve(W[k], B[k])
        return out

    def at(self, point: np.ndarray) -> dict[str, object]:
        """A point as a witness."""
        n = len(self.model.names)
        witness = {"t": point[0], "x": point[1 : n + 1]}
        return {**witness, "l": point[n + 1 :]} if len(point) > n + 1 else witness


def _row_sums(matrix: np.ndarray) -> np.ndarray:
    """The sums of the absolute values of each row, exactly."""
    return np.array([sum((abs(entry) for entry in row if entry), Fraction(0)) for row in matrix] or [Fraction(0)], dtype=object)


def constant_matrix_values(matrix: ca.SX) -> np.ndarray:
    """A constant matrix as doubles."""
    return np.array(ca.DM(ca.densify(matrix))).reshape(matrix.shape)


def system_jacobians(model: FirstOrderSystem) -> Jacobians:
    """The Jacobians of f, h and g by x and lambda."""
    return Jacobians(*(ca.simplify(ca.jacobian(e, s)) for e, s in (
        (model.f, model.x), (model.h, model.x), (model.h, model.lam), (model.g, model.x), (model.g, model.lam),
    )))  # fmt: skip


def linearise_system(model: FirstOrderSystem, region: Region, runs: Sequence[Trajectory]) -> SystemLinearisation:
    """Differentiate the model, and choose the box and the points."""
    J = system_jacobians(model)
    points = _run_points(runs)
    low_l, high_l, where = _multiplier_box(model.law, points[:, 1 + len(model.names) :])
    steps = step_lengths(model, runs)
    end = region.t1 + steps.max(initial=0.0)
    lower = np.concatenate([[region.t0], region.lower, low_l])
    upper = np.concatenate([[end], region.upper, high_l])
    along = f"{len(points)} rows of the run"
    if not len(points):
        start = [
            0.0,
            *constant_matrix_values(model.x0).ravel(),
            *np.clip(constant_matrix_values(model.lam0).ravel(), low_l, high_l),
        ]
        points = np.vstack([start, samples(lower, upper, REGION_SAMPLES)])
        along = f"{len(points)} points of the region"
    names = ("t", *region.names, *model.multiplier_names)
    z = ca.vertcat(model.t, model.x, model.lam)
    boxed = names[1 + len(region.names) :] if "along the run" in where else ()
    return SystemLinearisation(model, J, z, names, lower, upper, where, points, along, steps, tuple(boxed))


def _run_points(runs: Sequence[Trajectory]) -> np.ndarray:
    """Rows (t, x, l) of the runs, evenly spread."""
    rows = []
    for run in runs:
        parts = [run.t[1:, None], run.x[1:], *([run.multipliers[1:]] if "multipliers" in run.arrays else [])]
        table = np.hstack(parts)
        rows.append(table[np.isfinite(table).all(axis=1)])
    if not rows:
        return np.zeros((0, 0))
    table = np.vstack(rows)
    return (
        table[np.unique(np.linspace(0, len(table) - 1, min(MAX_SAMPLED_RUN_ROWS, len(table))).astype(int))]
        if len(table)
        else table
    )


def _multiplier_box(law: Law, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray, str]:
    """The box of l: K where it is bounded, else the box around the run, else the whole line."""
    low, high = [], []
    for block in law.blocks:
        ends_low, ends_high = block.bounding_box()
        shape = block.shape()
        if isinstance(shape, Halfspaces) and len(corners := _polyhedron_corners(shape)):
            ends_low, ends_high = (
                np.array([rounded(end) for end in ends])
                for rounded, ends in ((exact.round_down, corners.min(axis=0)), (exact.round_up, corners.max(axis=0)))
            )
        low.append(ends_low)
        high.append(ends_high)
    lower, upper = np.concatenate([np.zeros(0), *low]), np.concatenate([np.zeros(0), *high])
    if np.isfinite(lower).all() and np.isfinite(upper).all():
        return lower, upper, "the region, all times and all l in K" if lower.size else "the region and all times"
    if not len(seen):
        return lower, upper, "the region, all times and all l in K"
    middle, half = (seen.max(axis=0) + seen.min(axis=0)) / 2, BOX_GROWTH * (seen.max(axis=0) - seen.min(axis=0)) / 2
    lower = np.where(np.isfinite(lower), lower, middle - half)
    upper = np.where(np.isfinite(upper), upper, middle + half)
    return lower, upper, f"the region, all times, and l within {BOX_GROWTH:g} times its range along the run"


def _polyhedron_corners(shape: Halfspaces) -> np.ndarray:
    """The corners (k, m) of a bounded polyhedron, exactly; none where it is not bounded, or has too many faces."""
    H, K, m = exact.rational(shape.H), exact.rational(shape.K), shape.H.shape[1]
    none = exact.zeros(0, m)
    if comb(len(K), m) > MAX_FACE_SETS or exact.rank(H) < m:
        return none
    if conic.decide_feasibility(conic.ConicSystem(H.T, tuple(range(len(K))))).point is None:  # some H d >= 0, d != 0
        return none
    found = []
    for chosen in combinations(range(len(K)), m):
        rows = np.array(chosen, int)
        inverse = exact.inverse_matrix(H[rows])
        if inverse is None:
            continue
        corner = exact.matrix_product(inverse, K[rows][:, None])
        if (exact.matrix_product(H, corner) >= K[:, None]).all():
            found.append(corner.ravel())
    return np.array(found, dtype=object).reshape(-1, m)


def step_lengths(model: FirstOrderSystem, runs: Sequence[Trajectory]) -> np.ndarray:
    """Step lengths of the runs, or the model's own, increasing."""
    parts = [run.step[1:] for run in runs if "step" in run.arrays]
    if not parts:
        parts = [model.steps if model.steps is not None else [] if model.step is None else [model.step]]
    steps = np.unique(np.concatenate([np.asarray(part, float) for part in parts]))
    return steps[np.isfinite(steps) & (steps > 0)]
