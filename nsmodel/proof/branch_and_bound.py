"""Branch and bound: a rigorous upper bound of a maximum over a box under constraints, and better points on the way."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from nsmodel.proof.interval import MeanValueBounds, bisect_boxes, box_centre, cut_points, mean_value_form, natural_extension
from nsmodel.proof.interval_arithmetic import IntervalPair, add, mul, sub
from nsmodel.proof.straight_line import Program

RELATIVE_GAP = 1e-9  # Relative gap between value and bound that ends a search.
BOXES_PER_STEP = 512  # Boxes cut at once.
MIN_STEP_COUNT = 32  # A step counts as so many boxes at least: small ones cost as much.
GAP_SHRINK_FACTOR = 0.95  # The gap must shrink at least so much while the number of boxes doubles.
MAX_SLOPE_ROWS = 8  # So many constraints are bounded by their slopes too.


class BoxBounds(NamedTuple):
    """What is known over boxes (k, n).

    Attributes:
        upper: (k,) bound of the function.
        rate: (k, n) bound of the rate of change by each coordinate.
        rising, falling: (k, n) whether the function is proved to be monotone in the coordinate over the box.
        slopes: bounds of the function by its slopes; None where it has none.
    """

    upper: np.ndarray
    rate: np.ndarray
    rising: np.ndarray
    falling: np.ndarray
    slopes: MeanValueBounds | None


class MaximisationTask(NamedTuple):
    """A function to be bounded from above over {lower <= z <= upper, rows >= 0}.

    Attributes:
        bounds: (lower, upper) -> Bounded.
        best: (points (k, n), best point so far) -> (value, point) of the best feasible one, -inf and None where there is none;
            points that are returned may be in other coordinates.
        rows: the constraints; None if there are none.
        lower, upper: (n,).
        free: coordinates that may be cut.
        bound_to: a search ends where the bound is at most this number, or the value is larger than it.
        enough: a search ends where the bound is at most this number.
        tolerance: absolute gap that ends a search.
    """

    bounds: Callable[[np.ndarray, np.ndarray], BoxBounds]
    best: Callable[[np.ndarray, np.ndarray | None], tuple[float, np.ndarray | None]]
    rows: Program | None
    lower: np.ndarray
    upper: np.ndarray
    free: np.ndarray
    bound_to: float
    enough: float
    tolerance: float


class OpenBoxes(NamedTuple):
    """Boxes (k, n) that may hold the maximum, with their bounds (k,) and the coordinate to cut next, -1 for none."""

    lower: np.ndarray
    upper: np.ndarray
    bound: np.ndarray
    next: np.ndarray
    age: np.ndarray

    def take(self, which: np.ndarray) -> OpenBoxes:
        """Return some of the boxes."""
        return OpenBoxes(*(part[which] for part in self))

    def join(self, other: OpenBoxes) -> OpenBoxes:
        """Return all boxes of both."""
        return OpenBoxes(*(np.concatenate(parts) for parts in zip(self, other, strict=True)))


class SearchState(NamedTuple):
    """How far a search has come: open boxes, best value and point, boxes seen, and (boxes seen, gap) at the last doubling."""

    boxes: OpenBoxes
    value: float
    at: np.ndarray | None
    count: int  # pyright: ignore[reportIncompatibleMethodOverride]
    mark: tuple[int, float]

    @property
    def bound(self) -> float:
        """The bound over everything."""
        return max(self.value, self.boxes.bound.max(initial=-np.inf))


def start_search(task: MaximisationTask) -> SearchState:
    """Return the state with the whole box open."""
    whole = _bound_boxes(task, task.lower[None], task.upper[None], np.full(1, np.inf), np.zeros(1, int))
    return SearchState(whole, -np.inf, None, 1, (64, np.inf))


def box_middles(state: SearchState) -> np.ndarray:
    """Return the middles (k, n) of the open boxes."""
    return box_centre(state.boxes.lower, state.boxes.upper)


def with_better_point(state: SearchState, value: float, at: np.ndarray | None) -> SearchState:
    """Return the state with a point, if it is better than the best so far."""
    return state if at is None or value <= state.value else state._replace(value=value, at=at)


def search_boxes(task: MaximisationTask, state: SearchState, budget: int) -> SearchState:
    """Cut boxes, those with the largest bound first, until the gap is closed, the question settled or the budget spent."""
    while state.count < budget and not is_search_finished(task, state):
        aim = max(state.value, task.bound_to if task.bound_to < np.inf else -np.inf)
        gap = state.bound - aim if state.bound < np.inf else np.inf
        count, old = state.mark
        if state.count >= 2 * count:
            if count >= 512 and not gap < GAP_SHRINK_FACTOR * old:
                break
            state = state._replace(mark=(state.count, gap))
        state = _cut_best_boxes(task, state, budget)
    return state


def is_search_finished(task: MaximisationTask, state: SearchState) -> bool:
    """Whether a search has come to its end: the gap is closed, the question settled, or nothing is left to cut."""
    boxes, bound, value = state.boxes, state.bound, state.value
    if not len(boxes.bound) or bound <= task.enough or value > task.bound_to:
        return True
    if bound <= task.bound_to < np.inf or boxes.next[np.argmax(boxes.bound)] < 0:
        return True
    close = task.bound_to == np.inf or bound - value <= 1e-3 * RELATIVE_GAP * abs(value)
    return close and bound - value <= max(RELATIVE_GAP * abs(value), task.tolerance)


def _cut_best_boxes(task: MaximisationTask, state: SearchState, budget: int) -> SearchState:
    """Cut the most promising boxes and look at the parts."""
    boxes = state.boxes
    number = min(BOXES_PER_STEP, max(8, len(boxes.bound) // 2), max(1, (budget - state.count) // 2))
    order = np.argsort(-np.where(boxes.next >= 0, boxes.bound, -np.inf), kind="stable")
    chosen = boxes.take(order[:number])
    chosen, rest = chosen.take(chosen.next >= 0), boxes.take(order[number:]).join(chosen.take(chosen.next < 0))
    lower, upper = bisect_boxes(chosen.lower, chosen.upper, chosen.next)
    parts = _bound_boxes(task, lower, upper, np.tile(chosen.bound, 2), np.tile(chosen.age + 1, 2))
    state = with_better_point(state, *task.best(box_centre(parts.lower, parts.upper), state.at))
    boxes = rest.join(parts)
    return state._replace(boxes=boxes.take(boxes.bound > state.value), count=state.count + max(len(lower), MIN_STEP_COUNT))


def _bound_boxes(task: MaximisationTask, lower: np.ndarray, upper: np.ndarray, known: np.ndarray, age: np.ndarray) -> OpenBoxes:
    """Return the boxes that may hold feasible points, shrunk where the function is monotone, with their bounds."""
    held, limits = np.zeros(lower.shape, bool), None
    if task.rows is not None:
        limits = _constraint_bounds(task.rows, lower, upper)
        possible = (limits.hi >= 0).all(axis=0)
        lower, upper, known, age = lower[possible], upper[possible], known[possible], age[possible]
        limits = MeanValueBounds(*(part[:, possible] for part in limits))
        held = (limits.lo < 0).T.astype(float) @ _constraint_coordinates(task.rows).astype(float) > 0
    seen = task.bounds(lower, upper)
    bound = np.minimum(known, seen.upper)
    if limits is not None and seen.slopes is not None and limits.slope_lo.shape[2]:
        bound = np.minimum(bound, _multiplier_bounds(seen.slopes, limits, lower, upper))
    to_upper = seen.rising & ~held & np.isfinite(upper) & (lower < upper)
    to_lower = seen.falling & ~held & np.isfinite(lower) & (lower < upper) & ~to_upper
    again = (to_upper | to_lower).any(axis=1)
    lower, upper = np.where(to_upper, upper, lower), np.where(to_lower, lower, upper)
    rate = seen.rate.copy()
    if again.any():
        more = task.bounds(lower[again], upper[again])
        bound[again], rate[again] = np.minimum(bound[again], more.upper), more.rate
    return OpenBoxes(lower, upper, bound, _choose_coordinate(task, lower, upper, rate, held, age), age)


def _constraint_coordinates(rows: Program) -> np.ndarray:
    """Return which coordinates each constraint holds, (rows, n)."""
    uses = np.zeros((len(rows.outputs), rows.inputs), bool)
    for row, index in enumerate(rows.outputs):
        uses[row, sorted(rows.uses[index])] = True
    return uses


def _constraint_bounds(rows: Program, lower: np.ndarray, upper: np.ndarray) -> MeanValueBounds:
    """Return bounds of the constraints; without slopes where they are many."""
    if len(rows.outputs) <= MAX_SLOPE_ROWS:
        return mean_value_form(rows, lower, upper)
    lo, hi = natural_extension(rows, lower, upper)
    none = np.zeros((len(lo), len(lower), 0))
    return MeanValueBounds(lo, hi, none, none, lo, hi)


def _multiplier_bounds(f: MeanValueBounds, limits: MeanValueBounds, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Bounds (k,) of f by those of f + l w for each constraint w >= 0 that is not settled: f is no larger where l >= 0.

    With the l that makes the slopes cancel best, the bound at an active constraint is as good as that in the interior.
    """
    best = np.full(len(lower), np.inf)
    width, middle = upper - lower, box_centre(lower, upper)
    for row in range(len(limits.lo)):
        which = np.flatnonzero((limits.lo[row] < 0) & np.isfinite(width).all(axis=1))
        own = (f.slope_lo[0, which], f.slope_hi[0, which])
        other = (limits.slope_lo[row, which], limits.slope_hi[row, which])
        with np.errstate(all="ignore"):
            g, w = ((side[0] + side[1]) / 2 * width[which] for side in (own, other))
            l = -(g * w).sum(axis=1) / (w * w).sum(axis=1)
            l = np.where(np.isfinite(l), np.maximum(l, 0), 0)
            total = add(
                (f.mid_lo[0, which], f.mid_hi[0, which]), mul((l, l), (limits.mid_lo[row, which], limits.mid_hi[row, which]))
            )
            for i in range(lower.shape[1]):
                slope = add(_interval_column(own, i), mul((l, l), _interval_column(other, i)))
                total = add(total, mul(slope, sub((lower[which, i], upper[which, i]), (middle[which, i], middle[which, i]))))
        best[which] = np.minimum(best[which], total[1])
    return best


def _interval_column(x: IntervalPair, i: int) -> IntervalPair:
    return x[0][:, i], x[1][:, i]


def _choose_coordinate(
    task: MaximisationTask, lower: np.ndarray, upper: np.ndarray, rate: np.ndarray, held: np.ndarray, age: np.ndarray
) -> np.ndarray:
    """Choose the coordinate that the function feels most, each third time the widest; -1 where none can be cut."""
    with np.errstate(all="ignore"):
        width, size = upper - lower, task.upper - task.lower
        relative = np.where(
            np.isfinite(size), width / np.where(size > 0, size, 1.0), width / (1 + np.abs(box_centre(lower, upper)))
        )
        where = cut_points(lower, upper)
        mask = np.zeros(lower.shape, bool)
        mask[:, task.free] = True
        mask &= (lower < where) & (where < upper) & ((rate > 0) | held)
        effect = np.where(rate > 0, rate * np.where(np.isfinite(width), width, np.inf), 0.0)
        plain = (
            (age % 3 == 2)
            | ~np.isfinite(np.where(mask, effect, 0.0)).all(axis=1)
            | ~(np.where(mask, effect, 0.0) > 0).any(axis=1)
        )
        score = np.where(mask, np.where(plain[:, None], relative, effect), -1.0)
    best = np.argmax(score, axis=1) if score.shape[1] else np.full(len(score), -1)
    return np.where(mask.any(axis=1), best, -1)
