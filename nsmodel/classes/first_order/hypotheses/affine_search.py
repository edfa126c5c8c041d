"""A state of an affine system from which a step has two solutions, or none: looked for in doubles, decided exactly."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from itertools import combinations

import numpy as np

from nsmodel.classes.first_order.hypotheses.affine_step import (
    AffineStep,
    StepCounterexample,
    decide_state,
    gives_distinct_states,
    is_step_solution,
)
from nsmodel.proof import exact

STATE_SAMPLES = 3000  # States that floating point looks at, in each of two ways.
LOST_PART = 1e-6  # A b smaller than this part of its size is none that was asked for.
MAX_BLOCK_CONDITION = 1e8  # Condition beyond which a block of W is left to exact arithmetic.


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
    """States (n, SAMPLES): with a solution that was drawn, or with any b of that size."""
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
