"""Whether a step of an affine system with numbers exists from every state, and never two: exact linear programs.

A state of an affine system from which a step has two solutions, or none: looked for in doubles, decided exactly.

A step with constant Jacobians and a box K, in rational arithmetic: its solutions from a state, states with two or none.

    y = W l + b,   b = N x_k + b_0,   x_{k+1} = X_x x_k + X_l l + x_0,   -y ∈ N_K(l),   K = [lower, upper]

The solutions from a state are found on the index sets: y = 0 on some rows, l at a bound on the others. Floating point suggests a
state, which counts when each index set is decided in fractions, with signs far beyond the rounding of the data.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from itertools import combinations, product

import casadi as ca
import numpy as np

from nsmodel.models.first_order_system.linearisation import SystemLinearisation, constant_matrix_values
from nsmodel.proof import conic, exact
from nsmodel.solvers.residuals import numeric_law

# Index sets that are all decided, by exact elimination each: 3^6 are 729; of more, samples of states tell.
MAX_STEP_INDEX_SETS = 750
# A sign counts where the number is more than this part of its terms, or exactly 0: numbers of a model are rounded by a few EPS.
SIGN_MARGIN = 1e-9


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
        """The state x_{k+1} after the step."""
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


MAX_SET_PAIRS = 800  # Pairs of index sets, times states, that are all decided, each by an exact linear program.


@dataclass(frozen=True)
class InfeasibleState:
    """From the state x (n, 1) no step exists: v'y < 0 for all l in K, while a solution has v'y >= 0."""

    x: np.ndarray
    v: np.ndarray


def decide_solvability(step: AffineStep) -> InfeasibleState | bool | None:
    """Whether every state has some l in K with y in (K_inf)*; for a psd W that is a solution, as K is a polyhedron.

    If not, some v in K_inf with W'v in -(K_inf)* has v'y <= sup_K v'W l + v'b_0 + v'N x < 0, while v'y >= 0 is asked for. Where
    N'v = 0 for all such v, all states have one or none has. None: undecided.
    """
    m = len(step.W)
    conditions = _recession_rows(step)
    positive = [k for k, (_, strict) in enumerate(conditions) if strict]
    A = np.hstack([np.array([row for row, _ in conditions], dtype=object), exact.zeros(len(conditions), len(positive))])
    for place, k in enumerate(positive):
        A[k, m + place] = Fraction(-1)
    zero = conic.implied_zeros(conic.ConicSystem(A, tuple(range(m, A.shape[1]))))
    left = [j for j in range(A.shape[1]) if j not in zero]
    inner = conic.decide_feasibility(conic.ConicSystem(A[:, left], tuple(range(m, len(left))))).point
    if inner is None:
        return None
    span = exact.nullspace(A[:, left])
    slopes = exact.matrix_product(step.N.T, span[:m])
    if not slopes.any():
        b = step.b(exact.zeros(step.N.shape[1], 1))
        return True if any(solve_affine_index_set(step, b, index).sign > 0 for index in step.sets) else None
    if not exact.matrix_product(step.N.T, inner[:m, None]).any():
        away = span[:, np.flatnonzero(slopes.any(axis=0))[0]]
        small = min((abs(inner[j] / away[j]) for j in range(m, len(left)) if away[j]), default=Fraction(1)) / 2
        inner = inner + small * away
    return _infeasible_state(step, inner[:m, None])


def _recession_rows(step: AffineStep) -> list[tuple[np.ndarray, bool]]:
    """Rows a with a v >= 0 (True) or a v = 0 for v in K_inf with W'v in -(K_inf)*."""
    rows, units = [], exact.eye(len(step.W))
    for unit, column, low, up in zip(units, step.W.T, np.isfinite(step.lower), np.isfinite(step.upper), strict=True):
        if low and up:
            rows.append((unit, False))
        elif low or up:
            rows += [(unit, True), (-column, True)] if low else [(-unit, True), (column, True)]
        else:
            rows.append((column, False))
    return rows


def _infeasible_state(step: AffineStep, v: np.ndarray) -> InfeasibleState | None:
    """A state from which v'y < 0 for all l in K, beyond rounding of W."""
    image, size = exact.matrix_product(step.W.T, v), step.size.T @ np.abs(exact.doubles(v))
    if any(entry and abs(float(entry)) <= SIGN_MARGIN * terms for entry, terms in zip(image.ravel(), size.ravel(), strict=True)):
        return None
    top = exact.matrix_product(v.T, step.b_0)[0, 0]
    for entry, low, up in zip(image.ravel(), step.lower, step.upper, strict=True):
        top += entry * Fraction(float(up if entry > 0 else low)) if entry else 0
    slope = exact.matrix_product(step.N.T, v)
    reach = 2 * (abs(top) + sum(abs(entry) for entry in slope.ravel())) / exact.matrix_product(slope.T, slope)[0, 0]
    x = exact.rational(exact.doubles(-reach * slope))
    return InfeasibleState(x, v) if top + exact.matrix_product(slope.T, x)[0, 0] < 0 else None


def is_solution_unique(step: AffineStep) -> bool:
    """Whether no state has two solutions with different x, by exact linear programs on all pairs of index sets."""
    if not step.is_exact or len(step.sets) ** 2 * len(step.X_l) > MAX_SET_PAIRS:
        return False
    return all(_gives_same_state(step, pair, row) for pair in product(step.sets, repeat=2) for row in step.X_l if row.any())


def _gives_same_state(step: AffineStep, pair: tuple[np.ndarray, ...], row: np.ndarray) -> bool:
    """Whether row (l - l') > 0 for no l, l' of these index sets and one x_k; homogeneous in (tau, x_k, l, l')."""
    m, n = step.N.shape
    places = [range(1 + n, 1 + n + m), range(1 + n + m, 1 + n + 2 * m)]
    columns, total, rows = [0], 1 + n + 2 * m, []

    def equation(entries: dict[int, Fraction], slack: int) -> None:
        rows.append((entries, slack))

    for index, l in zip(pair, places, strict=True):
        for i, code in enumerate(index):
            y = {l[j]: step.W[i, j] for j in range(m)}
            y |= {1 + j: step.N[i, j] for j in range(n)} | {0: step.b_0[i, 0]}
            ends = {sign: Fraction(float(end)) for sign, end in ((1, step.lower[i]), (-1, step.upper[i])) if np.isfinite(end)}
            if code == 0:
                equation(y, 0)
                for sign, end in ends.items():
                    equation({l[i]: Fraction(sign), 0: -sign * end}, 1)
            else:
                equation({l[i]: Fraction(1), 0: -ends[-int(code)]}, 0)
                if step.lower[i] < step.upper[i]:
                    equation({place: -int(code) * entry for place, entry in y.items()}, 1)
    difference = {
        place: sign * entry for l, sign in zip(places, (1, -1), strict=True) for place, entry in zip(l, row, strict=True)
    }
    equation(difference, 1)
    A = exact.zeros(len(rows), total + sum(slack for _, slack in rows))
    for k, (entries, slack) in enumerate(rows):
        for place, entry in entries.items():
            A[k, place] += entry
        if slack:
            A[k, total] = Fraction(-1)
            columns.append(total)
            total += 1
    return columns[-1] in conic.implied_zeros(conic.ConicSystem(A, tuple(columns)))


# States at which signs are looked at in doubles, drawn in each of two ways; one that seems to fail is decided exactly.
STATE_SAMPLES = 3000
LOST_PART = 1e-6  # A b smaller than this part of its size is none that was asked for: what is left of it is rounding.
# Condition beyond which a block of W is left to exact arithmetic: half of the digits of doubles are lost.
MAX_BLOCK_CONDITION = 1e8


def find_counterexample(step: AffineStep) -> StepCounterexample | None:
    """A state with two solutions or none, verified; None where none is found."""
    for x in (*_states_from_minors(step), *_states_from_samples(step)):
        counterexample = decide_state(step, x)
        if counterexample is not None:
            return counterexample
    return _counterexample_in_kernel(step)


def _state_for_b(step: AffineStep, b: np.ndarray) -> np.ndarray | None:
    """A state (n, 1) with this b; in doubles where that may do."""
    x = exact.solve_linear_system(step.N, b - step.b_0)
    return None if x is None else exact.rational(exact.doubles(x))


def _finite_bounds(step: AffineStep) -> np.ndarray:
    """Bounds at which rows are held, 0 where there is none."""
    return np.where(np.isfinite(step.lower), step.lower, np.where(np.isfinite(step.upper), step.upper, 0.0))


def _multiplier_widths(step: AffineStep) -> np.ndarray:
    """How far l may go from its bound."""
    width = step.upper - step.lower
    typical = np.median(width[np.isfinite(width)]) if np.isfinite(width).any() else 1.0
    return np.where(np.isfinite(width), width, typical or 1.0)


def _states_from_minors(step: AffineStep) -> Iterator[np.ndarray]:
    """States from the least principal minors < 0 (Samelson, Thrall and Wesler).

    With all proper minors of the rows a > 0 and det W_aa < 0, d = -W_aa^{-1} e_k has d_k > 0: row k leaves its bound with y_k = 0
    on one side, stays there with y_k > 0 on the other, while y = 0 on the rest of a, and all other rows stay at their bounds.
    """
    m = len(step.W)
    if not np.isfinite(_finite_bounds(step)).all() or m > 6:
        return
    held, width = _finite_bounds(step), _multiplier_widths(step)
    side = np.where(np.isfinite(step.lower), 1.0, -1.0)  # into K, from the bound
    for count in range(1, m + 1):
        for rows in map(list, combinations(range(m), count)):
            if exact.determinant(step.W[np.ix_(rows, rows)]) >= 0:
                continue
            inverse = exact.inverse_matrix(step.W[np.ix_(rows, rows)])
            for place, k in enumerate(rows):
                if inverse is None or inverse[place, place] >= 0:
                    continue
                d = -side[k] * exact.doubles(inverse[:, place])  # W_aa d = -side_k e_k, side_k d_k > 0
                far = 0.3 * (width[rows] / np.where(d != 0, np.abs(d), np.inf)).min()
                l = held + 0.5 * side * np.where(np.isin(np.arange(m), rows), width, 0.0)
                l[k] = held[k]
                y = side * 10 * step.size @ (np.abs(l) + width)
                y[rows] = 0.0
                y[k] = side[k] * 0.5 * far
                b = exact.rational(y)[:, None] - exact.matrix_product(step.W, exact.rational(l)[:, None])
                x = _state_for_b(step, b)
                if x is not None:
                    yield x


def _states_from_samples(step: AffineStep, seed: int = 0) -> Iterator[np.ndarray]:
    """States at which floating point finds two solutions or none: first those with the clearest signs."""
    rng, m = np.random.default_rng(seed), len(step.W)
    W, N, b_0 = exact.doubles(step.W), exact.doubles(step.N), exact.doubles(step.b_0)
    states = np.hstack([_sample_states(step, rng, W, N, b_0, graph) for graph in (True, False)])
    b = N @ states + b_0
    solved, clearest = np.zeros(b.shape[1], int), np.full(b.shape[1], np.inf)
    first = np.full((m, b.shape[1]), np.nan)
    two = np.zeros(b.shape[1], bool)
    X_l = exact.doubles(step.X_l)
    for index in step.sets:
        free, l = np.flatnonzero(index == 0), exact.doubles(step.bounds(index)) + np.zeros((m, b.shape[1]))
        of_l = np.zeros_like(l)
        if free.size:
            block = W[np.ix_(free, free)]
            scale = np.abs(block).max(axis=1, keepdims=True)
            if not scale.all() or np.linalg.cond(block / scale) > MAX_BLOCK_CONDITION:
                continue
            inverse = np.linalg.inv(block)
            right = b[free] + W[free] @ l
            l[free] = -inverse @ right
            of_l[free] = np.abs(inverse) @ (np.abs(b[free]) + step.size[free] @ np.abs(l))
        slack = _law_slack(step, index, l, of_l, W @ l + b, step.size @ (np.abs(l) + of_l) + np.abs(b))
        good = slack > 1e-7
        clearest = np.minimum(clearest, np.abs(slack))
        fresh = good & (solved == 0)
        change = np.abs(X_l @ (l - np.where(np.isnan(first), l, first))).max(axis=0, initial=0.0)
        size = (np.abs(X_l) @ np.abs(l)).max(axis=0, initial=0.0)
        two |= good & (solved > 0) & (change > 1e-6 * size)
        first[:, fresh] = l[:, fresh]
        solved += good
    order = np.argsort(-clearest)
    for chosen in (order[two[order]], order[(solved == 0)[order]]):
        for k in chosen[:3]:
            yield exact.rational(states[:, k])[:, None]


def _law_slack(
    step: AffineStep, index: np.ndarray, l: np.ndarray, of_l: np.ndarray, y: np.ndarray, of_y: np.ndarray
) -> np.ndarray:
    """How far l, y on an index set are from breaking the law, relative to the sizes of their terms; < 0: they break it."""
    slack = np.full(l.shape[1], np.inf)
    with np.errstate(all="ignore"):
        for i, code in enumerate(index):
            if code == 0:
                for end, way in ((step.lower[i], 1), (step.upper[i], -1)):
                    if np.isfinite(end):
                        slack = np.fmin(slack, way * (l[i] - end) / (of_l[i] + abs(end)))
            elif step.lower[i] < step.upper[i]:
                slack = np.fmin(slack, -code * y[i] / of_y[i])
    return slack


def _sample_states(step: AffineStep, rng: np.random.Generator, W, N, b_0, graph: bool) -> np.ndarray:
    """States (n, STATE_SAMPLES): with a solution that was drawn, or with any b of that size."""
    m, n = N.shape
    width, held = _multiplier_widths(step), _finite_bounds(step)
    side = np.where(np.isfinite(step.lower), 1.0, -1.0)
    spread = 10.0 ** rng.uniform(-1, 1, (1, STATE_SAMPLES))
    of_y = step.size @ (width + np.abs(held))
    of_y = np.where(of_y > 0, of_y, of_y.max(initial=0.0) or 1.0)[:, None]
    if graph:
        code = rng.integers(0, 3, (m, STATE_SAMPLES))
        inside = held[:, None] + side[:, None] * width[:, None] * np.where(
            np.isfinite(step.upper - step.lower)[:, None],
            rng.random((m, STATE_SAMPLES)),
            rng.exponential(1, (m, STATE_SAMPLES)) * spread,
        )
        up = np.where(np.isfinite(step.upper), step.upper, held)[:, None]
        low = np.where(np.isfinite(step.lower), step.lower, held)[:, None]
        l = np.where(code == 0, inside, np.where(code == 1, low, up))
        away = of_y * rng.exponential(1, (m, STATE_SAMPLES)) * spread
        at_low = np.isfinite(step.lower)[:, None] & (code == 1)
        at_up = np.isfinite(step.upper)[:, None] & (code == 2)
        b = np.where(at_low, away, np.where(at_up, -away, 0.0)) - W @ l
    else:
        b = of_y * rng.normal(size=(m, STATE_SAMPLES)) * spread * 10
    weight = 1 / of_y
    x = np.linalg.pinv(weight * N) @ (weight * (b - b_0))
    lost = np.abs(weight * (N @ x)).max(axis=0, initial=0.0) < LOST_PART  # b is out of reach, what is left of x rounding
    away = rng.normal(size=x.shape) * spread
    largest = np.abs(weight * (N @ away)).max(axis=0, initial=0.0)
    x = np.where(lost, away / np.where(largest > 0, largest, 1.0), x)
    size = np.abs(x).max(axis=0, initial=0.0)
    kernel = np.linalg.svd(weight * N)[2][np.linalg.matrix_rank(weight * N) :].T if n else np.zeros((0, 0))
    return x + kernel @ rng.normal(size=(kernel.shape[1], STATE_SAMPLES)) * np.where(size > 0, size, 1.0)


def _counterexample_in_kernel(step: AffineStep) -> StepCounterexample | None:
    """Two solutions l, l + s d with W_a d_a = 0 on the rows a, where both have y = 0, and the other rows at their bounds."""
    m = len(step.W)
    if not step.is_exact or m > 6:
        return None
    width, held = _multiplier_widths(step), _finite_bounds(step)
    side = np.where(np.isfinite(step.lower), 1.0, -1.0)
    free_rows = [i for i in range(m) if not np.isfinite(step.lower[i]) and not np.isfinite(step.upper[i])]
    for count in range(1, m + 1):
        for rows in map(list, combinations(range(m), count)):
            if not set(free_rows) <= set(rows) or (step.lower[rows] == step.upper[rows]).any():
                continue
            for own in exact.nullspace(step.W[np.ix_(rows, rows)]).T:
                d = exact.zeros(m, 1)
                d[rows, 0] = own
                if not exact.matrix_product(step.X_l, d).any():
                    continue
                near = np.abs(exact.doubles(d)).ravel()
                far = Fraction(float(0.25 * (width / np.where(near > 0, near, np.inf)).min()))
                l = exact.rational(held + 0.5 * side * np.where(np.isin(np.arange(m), rows), width, 0.0))[:, None]
                y = side * 10 * step.size @ (np.abs(exact.doubles(l)).ravel() + width)
                y[rows] = 0.0
                b = exact.rational(y)[:, None] - exact.matrix_product(step.W, l)
                x = exact.solve_linear_system(step.N, b - step.b_0)
                if x is None:
                    continue
                b, pair = step.b(x), (l, l + far * d)
                if all(is_step_solution(step, b, one) for one in pair) and gives_distinct_states(step, x, *pair):
                    return StepCounterexample(x, pair, 2)
    return None
