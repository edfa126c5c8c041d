"""Two solutions of one step from one state, for any law: suggested by Newton's method, proved by the operator of Krawczyk.

    E = M (x - x_k) - h theta f(t + h, x) - h (1 - theta) f(t, x_k) - h gamma g(t + h, x, l) - h (1 - gamma) r_k = 0
    y = h(t + h, x, l),   -y ∈ N_K(l),   r_k = g(t, x_k, l_k)

On a mode (which rows are at which bound, which balls and cones are touched) this is a square system in x, l and the normal forces
s of what is touched, with strict inequalities. A point (x, l) of a mode, with the x_k that it comes from, has an orientation, the
sign of the determinant of its system. Where the sign is the same everywhere nothing is sought; where both signs occur all modes
are tried at the states of the rarer one.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import EPS
from nsmodel.models.first_order_system.linearisation import SystemLinearisation
from nsmodel.models.first_order_system.step_modes import StepMode, StepModes
from nsmodel.proof import interval_bounds, krawczyk

# Modes of a step that are tried at one state, with Newton's method on each: 3^7 are 2187; of more none is looked for.
MAX_STEP_MODES = 2500
# Points of modes that are drawn: those with the rarer sign of the determinant come from states with a second solution.
MODE_SAMPLES = 300
TRIED_STATES = 12  # Of them, states at which all modes are tried,
TRIED_ROWS = 4  # and of the runs.
# Of Newton's method on a mode where a ball or a cone is touched: its equations are not affine, and have several roots.
NEWTON_STARTS = 6
# Runs of Newton's method, in all, about as many as one state with MAX_STEP_MODES modes takes; after them none is begun.
MAX_NEWTON_RUNS = 2500
MAX_MODE_ITERATIONS = 14  # Of Newton's method on a mode: it squares the error, and a start that needs more is dropped.
MODE_NEWTON_TOLERANCE = 1e-11  # Relative: its last step, whose square is below rounding.
INEQUALITY_SLACK = 1e-7  # An inequality counts where it holds by this part of its size,
DATA_MARGIN = 1e-9  # for all data this near to the model's: far more than these are rounded by, far less than the slack.
# Two solutions are one if they differ by less than this part of what x moves in a step: Newton's method is nearer by far.
SAME_SOLUTION = 1e-6
SINGULAR_DETERMINANT = 1e-10  # Of a matrix whose rows have a largest entry of 1: below it its sign is not told from rounding.
UNDERFLOW_LIMIT = np.finfo(float).tiny / EPS  # Below it products with h underflow.


class TwoSolutions(NamedTuple):
    """States x_k, r_k (None where gamma = 1) at time t and two solutions (x, l)."""

    t: float
    x_k: np.ndarray
    r_k: np.ndarray | None
    first: tuple[np.ndarray, np.ndarray]
    other: tuple[np.ndarray, np.ndarray]


class SolutionSearchResult(NamedTuple):
    """Two solutions, or None; how many points of modes were looked at, and whether their orientations differ."""

    two: TwoSolutions | None
    points: int
    orientations_differ: bool


class _ModePoint(NamedTuple):
    """Unknowns u = (x, l, s) of a mode, the state they come from, and the orientation."""

    mode: StepMode
    u: np.ndarray
    t: float
    x_k: np.ndarray
    sign: float


def search_two_solutions(at: SystemLinearisation, h: float, seed: int = 0) -> SolutionSearchResult | None:
    """Look for two solutions of a step of length h; None where there are too many modes."""
    step = _TwoSolutionSearch(at, h)
    if step.count > MAX_STEP_MODES:
        return None
    rng = np.random.default_rng(seed)
    points = [point for _ in range(MODE_SAMPLES) if (point := step.draw(rng)) is not None]
    ahead, back = ([point for point in points if point.sign == sign] for sign in (1.0, -1.0))
    rarer = min(ahead, back, key=len)
    rows = at.points[np.unique(np.linspace(0, len(at.points) - 1, TRIED_ROWS).astype(int))]
    seen = [
        _ModePoint((), np.concatenate([row[1 : step.n + 1], np.zeros(0)]), float(row[0]), row[1 : step.n + 1], 0.0)
        for row in rows
    ]
    for point in [*rarer[:TRIED_STATES], *seen]:
        two = step.two(point, rng)
        if two is not None or step.tries > MAX_NEWTON_RUNS:
            return SolutionSearchResult(two, len(points), bool(rarer))
    return SolutionSearchResult(None, len(points), bool(rarer))


class _TwoSolutionSearch(StepModes):
    """The step with the points of its modes, and what was tried from them."""

    def __init__(self, at: SystemLinearisation, h: float) -> None:
        super().__init__(at, h)
        self.tries = 0

    def draw(self, rng: np.random.Generator) -> _ModePoint | None:
        """A point of a mode, with the state it comes from; None where the draw does not satisfy the law."""
        at, n = self.at, self.n
        t = float(at.lower[0] if not at.timed or rng.random() < 0.5 else rng.uniform(at.lower[0], at.upper[0] - self.h))
        wide = 10.0 ** rng.uniform(-1, 2) if self.everywhere else 1.0
        x = (
            rng.uniform(self.low, self.up)
            if wide <= 1
            else rng.uniform(-0.5, 0.5, n) * wide * self.span + (self.low + self.up) / 2
        )
        mode = tuple(modes[int(rng.integers(len(modes)))] for modes in self.modes)
        u = np.concatenate([x, self.start(mode, rng)])
        scale = np.concatenate([10 * max(wide, 1.0) * self.span if self.everywhere else self.span, self.width, self.size_s])
        for _ in range(6):
            value, J = self.residual_and_jacobian(u[:n], u[n : n + self.m], t, u[:n])
            F, D, slack = self.system(mode, u, value, J)
            if not (np.isfinite(F).all() and np.isfinite(D).all()):
                return None
            weight = 1 / np.maximum(np.abs(D[n:] * scale).max(axis=1), np.finfo(float).tiny)
            if np.abs(weight * F[n:]).max(initial=0.0) < 1e-12:
                break
            u = u - scale * np.linalg.lstsq(weight[:, None] * D[n:] * scale, weight * F[n:], rcond=1e-9)[0]
            mode = self._switch_bounds(mode, value[n:])
            for (_, rows), how in zip(self.blocks, mode, strict=True):
                if how in ("lower", "upper"):
                    u[n + rows[0]] = (self.lower if how == "lower" else self.upper)[rows[0]]
        else:
            return None
        if slack.min(initial=1.0) < 1e-4:
            return None
        x_k = self._preceding_state(u, t)
        if x_k is None or not (self.everywhere or ((x_k >= self.low) & (x_k <= self.up)).all()):
            return None
        value, J = self.residual_and_jacobian(u[:n], u[n : n + self.m], t, x_k)
        D = self.system(mode, u, value, J)[1] * scale
        sign, size = np.linalg.slogdet(D / np.maximum(np.abs(D).max(axis=1, keepdims=True), np.finfo(float).tiny))
        return _ModePoint(mode, u, t, x_k, sign) if size > np.log(SINGULAR_DETERMINANT) else None

    def _switch_bounds(self, mode: StepMode, y: np.ndarray) -> StepMode:
        """The mode with rows at the other bound where the sign of y asks for it."""
        other = list(mode)
        for k, ((_, rows), how) in enumerate(zip(self.blocks, mode, strict=True)):
            if how == "lower" and y[rows[0]] < 0 and np.isfinite(self.upper[rows[0]]):
                other[k] = "upper"
            elif how == "upper" and y[rows[0]] > 0 and np.isfinite(self.lower[rows[0]]):
                other[k] = "lower"
        return tuple(other)

    def _preceding_state(self, u: np.ndarray, t: float) -> np.ndarray | None:
        """The x_k from which E = 0."""
        x_k = u[: self.n].copy()
        for _ in range(8):
            point = u[: self.n], u[self.n : self.n + self.m], t, x_k
            value, J_k = self.residual_and_jacobian(*point)[0], self.in_x_k(*point, self.h).full()
            if not (np.isfinite(value).all() and np.isfinite(J_k).all()):
                return None
            step = np.linalg.lstsq(J_k, -value[: self.n], rcond=None)[0]
            x_k = x_k + step
            if np.abs(step).max() <= 1e-13 * np.abs(x_k).max() + UNDERFLOW_LIMIT:
                return x_k
        return None

    def two(self, point: _ModePoint, rng: np.random.Generator) -> TwoSolutions | None:
        """Two solutions from the state of a point, both proved."""
        kept = [(point.mode, point.u)] if point.mode else []
        for mode, u in self._solutions(point, rng):
            for case in kept:
                if not self._are_distinct(u, case[1], point.x_k):
                    break
            else:
                kept.append((mode, u))
        proved: list[krawczyk.ZeroEnclosure] = []
        changes: list[np.ndarray] = []
        for case in kept if len(kept) > 1 else []:
            change = self._data_sensitivity(case[0], point._replace(u=case[1]))
            zero = None if change is None else self._prove_zero(*case, point)
            if zero is None or change is None:
                continue
            proved.append(zero)
            changes.append(change)
            if len(proved) > 1 and self._are_disjoint(proved[0], proved[1], changes[0] + changes[-1]):
                first, other = ((zero.middle[: self.n], self._declared_multipliers(zero.middle)) for zero in proved)
                r_k = None if self.r_k is None else np.array(self.r_k(point.t, point.x_k)).ravel()
                return TwoSolutions(point.t, point.x_k, r_k, first, other)
            proved = proved[:1]
        return None

    def _declared_multipliers(self, u: np.ndarray) -> np.ndarray:
        return np.array(self.user(u[self.n : self.n + self.m])).ravel()

    def _solutions(self, point: _ModePoint, rng: np.random.Generator) -> Iterator[tuple[StepMode, np.ndarray]]:
        curved = any(K is not None for K, _ in self.blocks)
        for mode in product(*self.modes):
            for _ in range(NEWTON_STARTS if curved and "touched" in mode else 1):
                self.tries += 1
                u = self._newton(mode, np.concatenate([point.u[: self.n], self.start(mode, rng)]), point)
                if u is not None:
                    yield mode, u

    def _newton(self, mode: StepMode, u: np.ndarray, point: _ModePoint) -> np.ndarray | None:
        n, m = self.n, self.m
        for _ in range(MAX_MODE_ITERATIONS):
            value, J = self.residual_and_jacobian(u[:n], u[n : n + m], point.t, point.x_k)
            F, D, slack = self.system(mode, u, value, J)
            if not (np.isfinite(F).all() and np.isfinite(D).all()):
                return None
            try:
                step = np.linalg.solve(D, -F)
            except np.linalg.LinAlgError:
                return None
            u = u + step
            if (np.abs(step) <= MODE_NEWTON_TOLERANCE * (np.abs(u) + np.abs(step))).all() or np.abs(step).max() < UNDERFLOW_LIMIT:
                return u if slack.min(initial=1.0) > INEQUALITY_SLACK else None
        return None

    def _are_distinct(self, u: np.ndarray, v: np.ndarray, x_k: np.ndarray) -> bool:
        """Whether two x_{k+1} differ by more than the step's tolerance leaves open."""
        a, b = u[: self.n], v[: self.n]
        moved = max(np.abs(a - x_k).max(), np.abs(b - x_k).max())
        return bool(np.abs(a - b).max() > max(SAME_SOLUTION * moved, 1e-9 * np.abs(x_k).max(), UNDERFLOW_LIMIT))

    def _data_sensitivity(self, mode: StepMode, point: _ModePoint) -> np.ndarray | None:
        """By how much x (n,) changes where the data do by CLEAR of themselves; None where an inequality may then fail."""
        n, m, u = self.n, self.m, point.u
        state = u[:n], u[n : n + m], point.t, point.x_k
        (value, J), J_k = self.residual_and_jacobian(*state), self.in_x_k(*state, self.h).full()
        D = self.system(mode, u, value, J)[1]
        terms = np.abs(D) @ np.abs(u)
        terms[:n] += np.abs(J_k) @ np.abs(point.x_k)
        try:
            change = DATA_MARGIN * np.abs(np.linalg.inv(D)) @ terms
        except np.linalg.LinAlgError:
            return None
        of_l, of_s = change[n : n + m], change[n + m :]
        of_y = DATA_MARGIN * np.abs(J[n:]) @ np.abs(u[: n + m]) + np.abs(J[n:]) @ change[: n + m]
        l, y = u[n : n + m], value[n:]
        for k, ((K, rows), how) in enumerate(zip(self.blocks, mode, strict=True)):
            own = list(rows)
            least, of_it = np.inf, 0.0
            if how == "free":
                least, of_it = min(l[own[0]] - self.lower[own[0]], self.upper[own[0]] - l[own[0]]), of_l[own[0]]
            elif how in ("lower", "upper") and self.lower[own[0]] < self.upper[own[0]]:
                least, of_it = np.abs(y[own[0]]), of_y[own[0]]
            elif how == "touched":
                least, of_it = u[n + m + k], of_s[k]
            elif K is not None and K.is_cone:
                part, of_it = (l[own], of_l[own].sum()) if how == "inside" else (y[own], of_y[own].sum())
                least = part[0] - np.linalg.norm(part[1:])
            elif K is not None:
                S, c = K.quadric(len(own))
                least, of_it = np.sqrt(c) - np.sqrt(l[own] @ S @ l[own]), np.sqrt(of_l[own] @ np.abs(S) @ of_l[own])
            if not least > of_it:
                return None
        return change[:n]

    def _prove_zero(self, mode: StepMode, u: np.ndarray, point: _ModePoint) -> krawczyk.ZeroEnclosure | None:
        F, conditions = self.expressions(mode)
        z = ca.vertcat(self.x, self.l, self.s, self.t, self.x_k, self.step)
        start = np.concatenate([u, [point.t], point.x_k, [self.h]])
        size = np.concatenate([np.where(np.abs(u) > 0, np.abs(u), 1.0), np.full(len(start) - len(u), 1e-200)])
        zero = krawczyk.enclose_zero(F, z, start, size)
        if zero is None or (zero.lower[len(u) :] != start[len(u) :]).any() or (zero.upper[len(u) :] != start[len(u) :]).any():
            return None
        low, _ = interval_bounds.enclose(conditions, z, zero.lower, zero.upper) if conditions.numel() else (np.ones(1), None)
        return zero if (low > 0).all() else None

    def _are_disjoint(self, a: krawczyk.ZeroEnclosure, b: krawczyk.ZeroEnclosure, change: np.ndarray) -> bool:
        """Whether some x_i differ, by more than ``change`` (n,)."""
        n = self.n
        return bool((np.maximum(b.lower[:n] - a.upper[:n], a.lower[:n] - b.upper[:n]) > change).any())
