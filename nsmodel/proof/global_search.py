"""Branch and bound: a rigorous upper bound of a maximum over a box under constraints, and better points on the way.

Searching a box for the largest value of an expression: sample points, local searches, branch and bound.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof.affine_reduction import ReducedExpression, reduce_coordinates
from nsmodel.proof.expression_graph import MAX_NUMBERS_AT_ONCE, Program, program, stack_column, symbol_hashes
from nsmodel.proof.interval_arithmetic import IntervalPair, add, mul, sub
from nsmodel.proof.interval_bounds import (
    MeanValueBounds,
    bisect_boxes,
    box_centre,
    cut_points,
    mean_value_form,
    natural_extension,
)
from nsmodel.proof.verdict import suppress_output

# Relative gap between value and bound that ends a search: more digits than reports show. Tighter ones cut more boxes.
RELATIVE_GAP = 1e-9
# Boxes cut at once: bounds of 512 take 1.7 times as long as those of one. Of more, a better point would make many needless.
BOXES_PER_STEP = 512
# A step counts as so many boxes at least: up to there it takes as long as with one, so that a count is about a time.
MIN_STEP_COUNT = 32
# A search is given up where twice the boxes leave more of the gap: five doublings, from 512 boxes to all, take a quarter off it.
GAP_SHRINK_FACTOR = 0.95
# So many constraints are bounded by their slopes too, a number for each row and coordinate; others by their values alone.
MAX_SLOPE_ROWS = 8


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
    count: int
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
    again = (to_upper | to_lower)[:, task.free].any(axis=1)  # The function does not feel the other coordinates.
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


QUICK_SAMPLES = 256  # Sample points of a quick search, which ends with them,
FULL_SAMPLES = 2048  # and of a full one, which searches on from the best of them; fewer where the expression is long.
MAX_LOCAL_SEARCHES = 4  # Sample points from which a local search starts: the best ones that are a tenth of the box apart.
# Boxes of a search; after them the bound is as wide as it is, and a hypothesis that needs a narrower one stays open.
MAX_SEARCH_BOXES = 20_000
MAX_SEARCH_WORK = 2_000_000  # Boxes times instructions: fewer boxes, but 400, where the expression is long.
# Constraints' own coordinates are cut too where there are no more than so many in all: halving each once makes 2^6 boxes.
MAX_JOINT_COORDINATES = 6
LOCAL_SEARCH_OPTIONS = {
    "print_time": False,
    "error_on_fail": False,
    "show_eval_warnings": False,
    "ipopt": {
        "print_level": 0, "sb": "yes", "tol": 1e-10, "max_iter": 100, "bound_relax_factor": 0.0, "honor_original_bounds": "yes",
    },
}  # fmt: skip


_QUICK: ContextVar[bool] = ContextVar("quick", default=False)


@contextmanager
def quick_searches() -> Iterator[None]:
    """Within, all searches are quick: they may find a witness, and seldom prove that there is none."""
    before = _QUICK.set(True)
    try:
        yield
    finally:
        _QUICK.reset(before)


def searches_are_quick() -> bool:
    """Whether all searches are quick here."""
    return _QUICK.get()


class Supremum(NamedTuple):
    """What is known of the largest value of f over {lower <= z <= upper, where >= 0}.

    Attributes:
        value: f at ``at``, the best point found; -inf where no feasible point was found. f > c somewhere if value > c.
        at: (n,) or None.
        bound: f <= bound at every feasible point where f is defined (inf: no bound is known). sup f <= c is proved if
            bound <= c.
        count: feasible points at which f was evaluated.
    """

    value: float
    at: np.ndarray | None
    bound: float
    count: int


class SearchSpace(NamedTuple):
    """Where to look: the arguments that all searches share; ``bound_alone``: of a quick search nothing else is asked."""

    z: ca.SX
    lower: np.ndarray
    upper: np.ndarray
    where: ca.SX
    points: np.ndarray
    quick: bool
    bound_to: float
    bound_alone: bool


class SearchGoal(NamedTuple):
    """What to maximise: a number that belongs to the entries of ``held``.

    Attributes:
        held: expression of any shape.
        values: its entries at points (k, numel) -> (k,).
        bounds: the program of ``held``, boxes -> bounds.
        cost: of a value, in operations.
        ascent: (objective, v, start): the value is the maximum of the objective over |v_i| = 1, start(entries) -> v.
    """

    held: ca.SX
    values: Callable[[np.ndarray], np.ndarray]
    bounds: Callable[[Program, np.ndarray, np.ndarray], BoxBounds]
    cost: int
    ascent: tuple[ca.SX, list[ca.SX], Callable[[np.ndarray], np.ndarray]]


def samples(lower: np.ndarray, upper: np.ndarray, count: int) -> np.ndarray:
    """Return points (count, n) spread evenly over a box; with heavy tails towards infinite ends.

    Kronecker's sequence of the roots of primes: the same points each time, the first of them the middle of the box.
    """
    lower, upper = np.asarray(lower, float), np.asarray(upper, float)
    u = (0.5 + np.arange(count)[:, None] * np.sqrt(_first_primes(lower.size))) % 1.0
    with np.errstate(all="ignore"):
        inside = lower * (1 - u) + upper * u
        right, left = lower + u / (1 - u), upper - (1 - u) / np.maximum(u, 1e-12)
        both = np.tan(np.pi * (u - 0.5))
    out = np.where(np.isfinite(upper), left, both)
    out = np.where(np.isfinite(lower), np.where(np.isfinite(upper), inside, right), out)
    return np.clip(out, lower, upper)


def _first_primes(count: int) -> np.ndarray:
    found: list[int] = []
    number = 2
    while len(found) < count:
        if all(number % p for p in found):
            found.append(number)
        number += 1
    return np.array(found, float)


class _GoalEvaluator:
    """Evaluates a goal at points, keeps those that are feasible and counts them."""

    def __init__(self, goal: SearchGoal, space: SearchSpace) -> None:
        self._goal = goal
        self._numel = goal.held.numel()
        self._constant = not ca.symvar(goal.held)
        both = ca.vertcat(ca.vec(goal.held), space.where)
        names = symbol_hashes(both)
        self.used = [i for i in range(space.z.numel()) if space.z[i].element_hash() in names]
        self._function = ca.Function("values", [space.z[self.used]], [ca.densify(both)])
        self.count = 0

    def at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the values (k,), -inf where not feasible or not finite, the entries, and the worst constraint (k,)."""
        if not len(points):
            return np.zeros(0), np.zeros((0, self._numel)), np.zeros(0)
        if self.used:
            both = np.array(self._function(points[:, self.used].T)).reshape(-1, len(points)).T
        else:
            both = np.tile(np.array(self._function(np.zeros(0))).reshape(1, -1), (len(points), 1))
        entries, rows = both[:, : self._numel], both[:, self._numel :]
        finite = np.isfinite(entries).all(axis=1)
        worst = np.where(np.isnan(rows), -np.inf, rows).min(axis=1, initial=np.inf)
        good = finite & (worst >= 0)
        self.count += int(good.sum())
        values = np.full(len(points), -np.inf)
        if good.any():
            values[good] = self._goal.values(entries[good][:1] if self._constant else entries[good])
        return values, entries, worst

    def best(self, points: np.ndarray) -> tuple[float, np.ndarray | None]:
        """Return the largest value and its point; -inf and None where no point is feasible."""
        values = self.at(points)[0]
        i = int(np.argmax(values)) if len(values) else -1
        return (-np.inf, None) if i < 0 or values[i] == -np.inf else (float(values[i]), points[i].copy())


def search_supremum(goal: SearchGoal, space: SearchSpace, enough: float) -> Supremum:
    """Look at points, bound the box, and where that does not settle it climb from the best points and cut the box.

    Args:
        goal: what to maximise.
        space: where.
        enough: a value that is known elsewhere: bounds below it are of no use.
    """
    space = space._replace(quick=space.quick or searches_are_quick())
    evaluator = _GoalEvaluator(goal, space)
    task, size = _branch_and_bound_task(goal, space, evaluator, enough)
    state = start_search(task)
    if state.bound <= enough or (space.quick and space.bound_alone):
        return Supremum(-np.inf, None, float(state.bound), 0)
    state = with_better_point(state, *task.best(box_middles(state), None))
    if state.value > -np.inf and state.bound - state.value <= RELATIVE_GAP * abs(state.value):
        return Supremum(state.value, state.at, float(state.bound), evaluator.count)
    number = QUICK_SAMPLES if space.quick else int(np.clip(4e7 // (size + goal.cost), 64, FULL_SAMPLES))
    looked = np.vstack([space.points, *_initial_points(space, evaluator.used, number)])
    values, entries, worst = evaluator.at(looked)
    first = int(np.argmax(values))
    if values[first] > -np.inf:
        state = with_better_point(state, float(values[first]), looked[first].copy())
    state = with_better_point(state, *task.best(box_middles(state), state.at))
    if not space.quick:
        feasible = values[values > -np.inf]
        spread = float(np.median(np.abs(feasible - np.median(feasible)))) if feasible.size else 0.0
        task = task._replace(tolerance=RELATIVE_GAP * spread)
        budget = int(np.clip(MAX_SEARCH_WORK // (size + goal.cost), 400, MAX_SEARCH_BOXES))
        state = search_boxes(task, state, min(budget, 128))
        if not is_search_finished(task, state):
            for points in _local_search_points(goal, space, looked, values, entries, worst):
                state = with_better_point(state, *evaluator.best(points))
            state = search_boxes(task, state, budget)
    return Supremum(state.value, state.at, float(state.bound), evaluator.count)


def bound_without_search(goal: SearchGoal, z: ca.SX, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return a rigorous bound (k,) of a goal over each of several boxes (k, n) as a whole: what a quick search bounds it by."""
    code, at_once = program(goal.held, z), max(1, MAX_NUMBERS_AT_ONCE // goal.held.numel())
    less = reduce_coordinates(code, z, lower, upper)
    if less is not None:
        code, lower, upper = program(ca.reshape(less.expr, *goal.held.shape), less.d), less.lower, less.upper
    task = MaximisationTask(
        lambda low, high: goal.bounds(code, low, high), lambda points, at: (-np.inf, None), None, lower.min(axis=0),
        upper.max(axis=0), np.arange(lower.shape[1]), np.inf, -np.inf, 0.0,
    )  # fmt: skip
    parts = (slice(i, i + at_once) for i in range(0, len(lower), at_once))
    bounds = (_bound_boxes(task, lower[p], upper[p], np.full(len(lower[p]), np.inf), np.zeros(len(lower[p]), int)) for p in parts)
    return np.concatenate([part.bound for part in bounds])


def _initial_points(space: SearchSpace, used: list[int], number: int) -> list[np.ndarray]:
    """Return corners of the box (not those at infinity, 64 at most) and sample points, in the coordinates that matter."""
    free = np.array([i for i in used if space.lower[i] < space.upper[i]], int)
    inner = box_centre(space.lower, space.upper)
    spread = np.tile(inner, (number, 1))
    spread[:, used] = samples(space.lower[used], space.upper[used], number)
    if not free.size or not np.isfinite([space.lower[free], space.upper[free]]).all():
        return [spread]
    corners = np.tile(inner, (2 ** min(free.size, 6), 1))
    bits = (np.arange(len(corners))[:, None] >> (np.arange(free.size) % 6)) & 1
    corners[:, free] = np.where(bits, space.upper[free], space.lower[free])
    return [corners, spread]


def _branch_and_bound_task(
    goal: SearchGoal, space: SearchSpace, evaluator: _GoalEvaluator, enough: float
) -> tuple[MaximisationTask, int]:
    """Return what is left to branch and bound, in as few coordinates as the goal needs, and the number of its instructions."""
    own = symbol_hashes(goal.held)
    rows = (
        [row for row in ca.vertsplit(space.where) if symbol_hashes(row) & own or not ca.symvar(row)]
        if space.where.numel()
        else []
    )
    whole = ca.vertcat(ca.vec(ca.densify(goal.held)), *rows)
    code = program(whole, space.z)
    less = reduce_coordinates(code, space.z, space.lower, space.upper)
    if less is None:
        symbols, lower, upper = space.z, space.lower, space.upper
    else:
        whole, symbols, lower, upper = less.expr, less.d, less.lower, less.upper
    held, limits = ca.reshape(whole[: goal.held.numel()], *goal.held.shape), whole[goal.held.numel() :]
    code = program(held, symbols) if rows or less else replace(code, shape=held.shape)
    free = _coordinates_to_cut(held, limits, symbols, lower, upper)

    def best(points: np.ndarray, at: np.ndarray | None) -> tuple[float, np.ndarray | None]:
        return evaluator.best(
            _fill_fixed_coordinates(points, at, free, space) if less is None else _lift_points(points, at, less, space)
        )

    return MaximisationTask(
        lambda low, high: goal.bounds(code, low, high), best, program(limits, symbols) if rows else None, lower, upper, free,
        space.bound_to, enough, 0.0,
    ), len(code.steps)  # fmt: skip


def _coordinates_to_cut(held: ca.SX, limits: ca.SX, symbols: ca.SX, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the coordinates to cut: those of the goal and, if they are few, of its constraints."""
    joint = symbol_hashes(ca.vertcat(ca.vec(held), limits))
    wanted = joint if len(joint) <= MAX_JOINT_COORDINATES else symbol_hashes(held)
    names = [symbol.element_hash() for symbol in ca.vertsplit(symbols)] if symbols.numel() else []
    return np.array([i for i, name in enumerate(names) if name in wanted and lower[i] < upper[i]], int)


def _fill_fixed_coordinates(points: np.ndarray, at: np.ndarray | None, free: np.ndarray, space: SearchSpace) -> np.ndarray:
    """Return the points with the coordinates that are not cut taken from the best point."""
    if at is not None:
        fixed = np.setdiff1d(np.flatnonzero(space.lower < space.upper), free)
        points[:, fixed] = at[fixed]
    return points


def _lift_points(points: np.ndarray, at: np.ndarray | None, less: ReducedExpression, space: SearchSpace) -> np.ndarray:
    """Return points z (k, n) of the box with d = points, as far as there are any; the nearest to the best point."""
    base = box_centre(space.lower, space.upper) if at is None else at
    inverse = np.linalg.pinv(less.matrix)
    z = np.tile(base, (len(points), 1))
    for _ in range(3):  # Clipping to the box moves d; what is left over goes to the coordinates that are free.
        z = np.clip(z + (points - z @ less.matrix.T - less.constant) @ inverse.T, space.lower, space.upper)
    return z


def _local_search_points(
    goal: SearchGoal, space: SearchSpace, looked: np.ndarray, values: np.ndarray, entries: np.ndarray, worst: np.ndarray
) -> list[np.ndarray]:
    """Return points (k, n) on the way to local maxima, from the best points looked at; not all of them are feasible."""
    objective, extra, begin = goal.ascent
    order = np.lexsort((-worst, -values))
    order = order[np.isfinite(entries[order]).all(axis=1)][:64]
    if not order.size or not ca.symvar(goal.held):
        return []
    v, unit = stack_column(extra), stack_column(ca.sumsqr(part) - 1 for part in extra)
    nlp = {"x": ca.vertcat(space.z, v), "f": -objective, "g": ca.vertcat(space.where, unit)}
    large = {"hessian_approximation": "limited-memory"} if ca.n_nodes(objective) > 3000 or space.z.numel() > 30 else {}
    found = []
    with suppress_output():
        try:
            solver = ca.nlpsol(
                "climb", "ipopt", nlp, {**LOCAL_SEARCH_OPTIONS, "ipopt": {**LOCAL_SEARCH_OPTIONS["ipopt"], **large}}
            )
            for i in _separated_points(looked[order], space):
                initial = looked[order[i]]
                answer = solver(
                    x0=np.concatenate([initial, begin(entries[order[i]])]),
                    lbx=np.concatenate([space.lower, np.full(v.numel(), -1.5)]),
                    ubx=np.concatenate([space.upper, np.full(v.numel(), 1.5)]),
                    lbg=np.zeros(nlp["g"].numel()),
                    ubg=np.concatenate([np.full(space.where.numel(), np.inf), np.zeros(unit.numel())]),
                )  # fmt: skip
                end = np.clip(np.array(answer["x"]).ravel()[: initial.size], space.lower, space.upper)
                if np.isfinite(end).all():
                    back = np.concatenate([[0.0], 2.0 ** -np.arange(50.0, 0, -2)])[:, None]
                    found.append(end + back * (initial - end))
        except RuntimeError:  # CasADi gives up where derivatives are not defined
            return found
    return found


def _separated_points(points: np.ndarray, space: SearchSpace) -> list[int]:
    """Return indices of the first points that lie apart from each other."""
    size = np.where(np.isfinite(space.upper - space.lower), space.upper - space.lower, 1.0)
    scaled = points / np.where(size > 0, size, 1.0)
    kept: list[int] = []
    for i, point in enumerate(scaled):
        if all(np.abs(point - scaled[j]).max(initial=0.0) > 0.1 for j in kept):
            kept.append(i)
        if len(kept) == MAX_LOCAL_SEARCHES:
            break
    return kept
