"""A step with constant Jacobians and a box K, in rational arithmetic: its solutions from a state, states with two or none.

    y = W l + b,   b = N x_k + b_0,   x_{k+1} = X_x x_k + X_l l + x_0,   -y ∈ N_K(l),   K = [lower, upper]

The solutions from a state are found on the index sets: y = 0 on some rows, l at a bound on the others. Floating point suggests a
state, which counts when each index set is decided in fractions, with signs far beyond the rounding of the data.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from itertools import product

import casadi as ca
import numpy as np

from nsmodel.classes.first_order.hypotheses.linearised import SystemLinearisation, constant_matrix_values
from nsmodel.proof import exact
from nsmodel.solvers.residuals import numeric_law

MAX_STEP_INDEX_SETS = 750  # Index sets that are all decided.
SIGN_MARGIN = 1e-9  # A sign counts where the number is this part of its terms, or exactly 0.


@dataclass(frozen=True)
class AffineStep:
    """The step; entries are Fractions.

    Attributes:
        W, N, b_0, X_x, X_l, x_0: as above, vectors as columns.
        size: (m, m) doubles, the sums of the absolute values of what W is made of.
        lower, upper: (m,) doubles.
        h, t: step length and time of x_k.
        sharp: whether b_0 and x_0 are exact, not values of functions of time.
        r: r_k = r_x x_k + r_0 where gamma < 1.
    """

    W: np.ndarray
    size: np.ndarray
    N: np.ndarray
    b_0: np.ndarray
    X_x: np.ndarray
    X_l: np.ndarray
    x_0: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    h: float
    t: float
    is_exact: bool
    r: tuple[np.ndarray, np.ndarray] | None

    @cached_property
    def sets(self) -> list[np.ndarray]:
        """All index sets: 0 where y = 0, -1 and 1 where l is at its lower and upper bound."""
        codes = [
            [code for code, end in ((0, 0.0), (-1, low), (1, up)) if np.isfinite(end)] if low < up else [-1]
            for low, up in zip(self.lower, self.upper, strict=True)
        ]
        return [np.array(choice, np.int8) for choice in product(*codes)]

    @property
    def few(self) -> bool:
        """Whether all index sets can be decided."""
        rows = np.isfinite(self.lower).astype(int) + np.isfinite(self.upper) + 1
        return bool(np.prod(np.where(self.lower < self.upper, rows, 1.0)) <= MAX_STEP_INDEX_SETS)

    def b(self, x: np.ndarray) -> np.ndarray:
        """B of a state x_k (n, 1)."""
        return exact.matrix_product(self.N, x) + self.b_0

    def next(self, x: np.ndarray, l: np.ndarray) -> np.ndarray:
        """x_{k+1}."""
        return exact.matrix_product(self.X_x, x) + exact.matrix_product(self.X_l, l) + self.x_0

    def bounds(self, index: np.ndarray) -> np.ndarray:
        """L (m, 1) at its bounds, 0 on the rows where y = 0."""
        return exact.rational(np.where(index < 0, self.lower, np.where(index > 0, self.upper, 0.0)))[:, None]


def affine_step(at: SystemLinearisation, h: float) -> AffineStep | None:
    """The step of length h from t = t_0, of a model with constant Jacobians and a box; None where W is singular."""
    model, J = at.model, at.jacobians
    theta, gamma, step = (Fraction(number) for number in (model.theta, model.gamma, h))
    A, B, C, D, K = (exact.rational(constant_matrix_values(matrix)) for matrix in (J.A, J.B, J.C, J.D, J.K))
    inverse = exact.inverse_matrix(at.exact_W(h))
    if inverse is None:
        return None
    law = numeric_law(model.law)
    t, n, m = float(at.lower[0]), len(A), len(D)
    values = ca.Function("values", [at.z], [model.f, model.g, model.h])

    def at_zero(time: float) -> list[np.ndarray]:
        return [
            exact.rational(np.array(ca.DM(part)).reshape(-1, 1)) for part in values(np.concatenate([[time], np.zeros(n + m)]))
        ]

    (f_k, g_k, _), (f, g, y) = at_zero(t), at_zero(t + h)
    l_k = exact.rational(np.clip(np.zeros(m), law.lower, law.upper))[:, None]
    r_x, r_0 = K, exact.matrix_product(B, l_k) + g_k
    X_x = exact.matrix_product(inverse, at.M + step * (1 - theta) * A + step * (1 - gamma) * r_x)
    X_l = exact.matrix_product(inverse, step * gamma * B)
    x_0 = exact.matrix_product(inverse, step * (theta * f + (1 - theta) * f_k + gamma * g + (1 - gamma) * r_0))
    size = [np.abs(exact.doubles(matrix)) for matrix in (D, C, inverse, B)]
    return AffineStep(
        W=D + exact.matrix_product(C, X_l),
        size=size[0] + h * float(gamma) * size[1] @ size[2] @ size[3],
        N=exact.matrix_product(C, X_x), b_0=exact.matrix_product(C, x_0) + y, X_x=X_x, X_l=X_l, x_0=x_0,
        lower=law.lower, upper=law.upper, h=h, t=t, is_exact=not at.timed, r=None if gamma == 1 else (r_x, r_0),
    )  # fmt: skip


@dataclass(frozen=True)
class IndexSetSolution:
    """What an index set gives: l (m, 1), or None where its equations contradict each other; ``sign`` 1: a solution, -1: none,
    0: not clear.
    """

    l: np.ndarray | None
    sign: int


def solve_affine_index_set(step: AffineStep, b: np.ndarray, index: np.ndarray) -> IndexSetSolution:
    """Decide one index set for b (m, 1), exactly."""
    free, l = np.flatnonzero(index == 0), step.bounds(index)
    if free.size:
        block, right = step.W[np.ix_(free, free)], -(b + exact.matrix_product(step.W, l))[free]
        own = exact.solve_linear_system(block, right)
        if own is None:
            return IndexSetSolution(None, -1 if _is_contradictory(block, right) else 0)
        if exact.rank(block) < len(free):
            return IndexSetSolution(None, 0)
        l[free] = own
    y = exact.matrix_product(step.W, l) + b
    inverse = np.abs(np.linalg.pinv(exact.doubles(step.W[np.ix_(free, free)]))) if free.size else np.zeros((0, 0))
    size = step.size @ np.abs(exact.doubles(l)).ravel() + np.abs(exact.doubles(b)).ravel()
    of_l = np.zeros(len(l))
    if free.size:
        of_l[free] = inverse @ size[free]
    of_y = size + step.size @ of_l
    signs = []
    for i, code in enumerate(index):
        if code == 0:
            signs += [
                _clear_sign(l[i, 0] - Fraction(end), of_l[i] + abs(end), step.is_exact, way)
                for end, way in ((step.lower[i], 1), (step.upper[i], -1))
                if np.isfinite(end)
            ]
        elif step.lower[i] < step.upper[i]:
            signs.append(_clear_sign(y[i, 0], of_y[i], step.is_exact, -int(code)))
    return IndexSetSolution(l, min(signs, default=1))


def _clear_sign(number: Fraction, size: float, sharp: bool, way: int) -> int:
    """1 where ``way`` times the number is >= 0 beyond rounding, -1 where it is < 0 beyond it."""
    if abs(float(number)) <= SIGN_MARGIN * size:
        return 1 if sharp and number == 0 else 0
    return 1 if number * way > 0 else -1


def _is_contradictory(block: np.ndarray, right: np.ndarray) -> bool:
    """Whether a left null vector of the block shows, beyond rounding, that block l = right has no solution."""
    for u in exact.nullspace(block.T).T:
        terms = np.abs(exact.doubles(u * right.ravel())).sum()
        if abs(float(sum(u * right.ravel()))) > SIGN_MARGIN * terms:
            return True
    return False


@dataclass(frozen=True)
class StepCounterexample:
    """A state x_k (n, 1) with two solutions l (m, 1) that move x apart, or with none; ``count`` of the x_{k+1} found."""

    x: np.ndarray
    pair: tuple[np.ndarray, ...]
    count: int


def decide_state(step: AffineStep, x: np.ndarray) -> StepCounterexample | None:
    """Two solutions from the state x (n, 1) of Fractions, or that there is none; None where there is one, or it is not clear."""
    b = step.b(x)
    cases = [solve_affine_index_set(step, b, index) for index in step.sets]
    if all(case.sign < 0 for case in cases):
        return StepCounterexample(x, (), 0)
    kept: list[np.ndarray] = []
    for case in cases:
        if case.sign > 0 and case.l is not None and all(gives_distinct_states(step, x, case.l, other) for other in kept):
            kept.append(case.l)
    return StepCounterexample(x, tuple(kept[:2]), len(kept)) if len(kept) > 1 else None


def gives_distinct_states(step: AffineStep, x: np.ndarray, l: np.ndarray, other: np.ndarray) -> bool:
    """Whether two multipliers give different x_{k+1}, beyond rounding of their terms."""
    moved = np.abs(exact.doubles(exact.matrix_product(step.X_l, l - other))).ravel()
    both = np.abs(exact.doubles(l)) + np.abs(exact.doubles(other))
    terms = np.abs(exact.doubles(step.X_l)) @ both + np.abs(exact.doubles(step.X_x)) @ np.abs(exact.doubles(x))
    return bool((moved > SIGN_MARGIN * (terms.ravel() + np.abs(exact.doubles(step.x_0)).ravel())).any())


def is_step_solution(step: AffineStep, b: np.ndarray, l: np.ndarray) -> bool:
    """Whether -y ∈ N_K(l), exactly."""
    y = exact.matrix_product(step.W, l) + b
    for i in range(len(l)):
        low, up = step.lower[i], step.upper[i]
        if l[i, 0] < low or l[i, 0] > up or (y[i, 0] > 0 and l[i, 0] != low) or (y[i, 0] < 0 and l[i, 0] != up):
            return False
    return True
