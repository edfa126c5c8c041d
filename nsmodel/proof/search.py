"""Searching a box for the largest value of an expression: sample points, local searches, branch and bound."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import branch_and_bound
from nsmodel.proof.branch_and_bound import BoxBounds, MaximisationTask
from nsmodel.proof.directions import ReducedExpression, reduce_coordinates
from nsmodel.proof.graph import stack_column, symbol_hashes
from nsmodel.proof.interval import box_centre
from nsmodel.proof.quiet import suppress_output
from nsmodel.proof.straight_line import Program, program

QUICK_SAMPLES, FULL_SAMPLES = 256, 2048  # Sample points of a quick and of a full search.
MAX_LOCAL_SEARCHES = 4  # Local searches.
MAX_SEARCH_BOXES, MAX_SEARCH_WORK = (
    20_000,
    2_000_000,
)  # A search looks at so many boxes at most, fewer where the expression has many instructions.
MAX_JOINT_COORDINATES = 6  # Constraints' own coordinates are cut too where there are no more than so many in all.
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
    count: int  # pyright: ignore[reportIncompatibleMethodOverride]


class SearchSpace(NamedTuple):
    """Where to look: the arguments that all searches share."""

    z: ca.SX
    lower: np.ndarray
    upper: np.ndarray
    where: ca.SX
    points: np.ndarray
    quick: bool
    bound_to: float


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
        self._goal, self._space = goal, space
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
    state = branch_and_bound.start_search(task)
    if state.bound <= enough:
        return Supremum(-np.inf, None, float(state.bound), 0)
    state = branch_and_bound.with_better_point(state, *task.best(branch_and_bound.box_middles(state), None))
    if state.value > -np.inf and state.bound - state.value <= branch_and_bound.RELATIVE_GAP * abs(state.value):
        return Supremum(state.value, state.at, float(state.bound), evaluator.count)
    number = QUICK_SAMPLES if space.quick else int(np.clip(4e7 // (size + goal.cost), 64, FULL_SAMPLES))
    looked = np.vstack([space.points, *_initial_points(space, evaluator.used, number)])
    values, entries, worst = evaluator.at(looked)
    first = int(np.argmax(values))
    if values[first] > -np.inf:
        state = branch_and_bound.with_better_point(state, float(values[first]), looked[first].copy())
    state = branch_and_bound.with_better_point(state, *task.best(branch_and_bound.box_middles(state), state.at))
    if not space.quick:
        feasible = values[values > -np.inf]
        spread = float(np.median(np.abs(feasible - np.median(feasible)))) if feasible.size else 0.0
        task = task._replace(tolerance=branch_and_bound.RELATIVE_GAP * spread)
        budget = int(np.clip(MAX_SEARCH_WORK // (size + goal.cost), 400, MAX_SEARCH_BOXES))
        state = branch_and_bound.search_boxes(task, state, min(budget, 128))
        if not branch_and_bound.is_search_finished(task, state):
            for points in _local_search_points(goal, space, looked, values, entries, worst):
                state = branch_and_bound.with_better_point(state, *evaluator.best(points))
            state = branch_and_bound.search_boxes(task, state, budget)
    return Supremum(state.value, state.at, float(state.bound), evaluator.count)


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
    less = reduce_coordinates(whole, space.z, space.lower, space.upper)
    if less is None:
        symbols, lower, upper = space.z, space.lower, space.upper
    else:
        whole, symbols, lower, upper = less.expr, less.d, less.lower, less.upper
    held, limits = ca.reshape(whole[: goal.held.numel()], *goal.held.shape), whole[goal.held.numel() :]
    code = program(held, symbols)
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
