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

from nsmodel.classes.first_order.hypotheses.linearised import Linearised, numbers
from nsmodel.proof import exact
from nsmodel.solve.certificate import numeric_law

MOST_SETS = 750  # Index sets that are all decided.
CLEAR = 1e-9  # A sign counts where the number is this part of its terms, or exactly 0.


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
    sharp: bool
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
        return bool(np.prod(np.where(self.lower < self.upper, rows, 1.0)) <= MOST_SETS)

    def b(self, x: np.ndarray) -> np.ndarray:
        """B of a state x_k (n, 1)."""
        return exact.product(self.N, x) + self.b_0

    def next(self, x: np.ndarray, l: np.ndarray) -> np.ndarray:
        """x_{k+1}."""
        return exact.product(self.X_x, x) + exact.product(self.X_l, l) + self.x_0

    def bounds(self, index: np.ndarray) -> np.ndarray:
        """L (m, 1) at its bounds, 0 on the rows where y = 0."""
        return exact.rational(np.where(index < 0, self.lower, np.where(index > 0, self.upper, 0.0)))[:, None]


def affine_step(at: Linearised, h: float) -> AffineStep | None:
    """The step of length h from t = t_0, of a model with constant Jacobians and a box; None where W is singular."""
    model, J = at.model, at.jacobians
    theta, gamma, step = (Fraction(number) for number in (model.theta, model.gamma, h))
    A, B, C, D, K = (exact.rational(numbers(matrix)) for matrix in (J.A, J.B, J.C, J.D, J.K))
    inverse = exact.inverse(at.exact_W(h))
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
    r_x, r_0 = K, exact.product(B, l_k) + g_k
    X_x = exact.product(inverse, at.M + step * (1 - theta) * A + step * (1 - gamma) * r_x)
    X_l = exact.product(inverse, step * gamma * B)
    x_0 = exact.product(inverse, step * (theta * f + (1 - theta) * f_k + gamma * g + (1 - gamma) * r_0))
    size = [np.abs(exact.doubles(matrix)) for matrix in (D, C, inverse, B)]
    return AffineStep(
        W=D + exact.product(C, X_l),
        size=size[0] + h * float(gamma) * size[1] @ size[2] @ size[3],
        N=exact.product(C, X_x), b_0=exact.product(C, x_0) + y, X_x=X_x, X_l=X_l, x_0=x_0,
        lower=law.lower, upper=law.upper, h=h, t=t, sharp=not at.timed, r=None if gamma == 1 else (r_x, r_0),
    )  # fmt: skip


@dataclass(frozen=True)
class OnSet:
    """What an index set gives: l (m, 1), or None where its equations contradict each other; ``sign`` 1: a solution, -1: none,
    0: not clear.
    """

    l: np.ndarray | None
    sign: int


def on_set(step: AffineStep, b: np.ndarray, index: np.ndarray) -> OnSet:
    """Decide one index set for b (m, 1), exactly."""
    free, l = np.flatnonzero(index == 0), step.bounds(index)
    if free.size:
        block, right = step.W[np.ix_(free, free)], -(b + exact.product(step.W, l))[free]
        own = exact.solve(block, right)
        if own is None:
            return OnSet(None, -1 if _contradicts(block, right) else 0)
        if exact.rank(block) < len(free):
            return OnSet(None, 0)
        l[free] = own
    y = exact.product(step.W, l) + b
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
                _sign(l[i, 0] - Fraction(end), of_l[i] + abs(end), step.sharp, way)
                for end, way in ((step.lower[i], 1), (step.upper[i], -1))
                if np.isfinite(end)
            ]
        elif step.lower[i] < step.upper[i]:
            signs.append(_sign(y[i, 0], of_y[i], step.sharp, -int(code)))
    return OnSet(l, min(signs, default=1))


def _sign(number: Fraction, size: float, sharp: bool, way: int) -> int:
    """1 where ``way`` times the number is >= 0 beyond rounding, -1 where it is < 0 beyond it."""
    if abs(float(number)) <= CLEAR * size:
        return 1 if sharp and number == 0 else 0
    return 1 if number * way > 0 else -1


def _contradicts(block: np.ndarray, right: np.ndarray) -> bool:
    """Whether a left null vector of the block shows, beyond rounding, that block l = right has no solution."""
    for u in exact.nullspace(block.T).T:
        terms = np.abs(exact.doubles(u * right.ravel())).sum()
        if abs(float(sum(u * right.ravel()))) > CLEAR * terms:
            return True
    return False


@dataclass(frozen=True)
class Shown:
    """A state x_k (n, 1) with two solutions l (m, 1) that move x apart, or with none; ``count`` of the x_{k+1} found."""

    x: np.ndarray
    pair: tuple[np.ndarray, ...]
    count: int


def decided(step: AffineStep, x: np.ndarray) -> Shown | None:
    """Two solutions from the state x (n, 1) of Fractions, or that there is none; None where there is one, or it is not clear."""
    b = step.b(x)
    cases = [on_set(step, b, index) for index in step.sets]
    if all(case.sign < 0 for case in cases):
        return Shown(x, (), 0)
    kept: list[np.ndarray] = []
    for case in cases:
        if case.sign > 0 and case.l is not None and all(apart(step, x, case.l, other) for other in kept):
            kept.append(case.l)
    return Shown(x, tuple(kept[:2]), len(kept)) if len(kept) > 1 else None


def apart(step: AffineStep, x: np.ndarray, l: np.ndarray, other: np.ndarray) -> bool:
    """Whether two multipliers give different x_{k+1}, beyond rounding of their terms."""
    moved = np.abs(exact.doubles(exact.product(step.X_l, l - other))).ravel()
    both = np.abs(exact.doubles(l)) + np.abs(exact.doubles(other))
    terms = np.abs(exact.doubles(step.X_l)) @ both + np.abs(exact.doubles(step.X_x)) @ np.abs(exact.doubles(x))
    return bool((moved > CLEAR * (terms.ravel() + np.abs(exact.doubles(step.x_0)).ravel())).any())


def is_solution(step: AffineStep, b: np.ndarray, l: np.ndarray) -> bool:
    """Whether -y ∈ N_K(l), exactly."""
    y = exact.product(step.W, l) + b
    for i in range(len(l)):
        low, up = step.lower[i], step.upper[i]
        if l[i, 0] < low or l[i, 0] > up or (y[i, 0] > 0 and l[i, 0] != low) or (y[i, 0] < 0 and l[i, 0] != up):
            return False
    return True
