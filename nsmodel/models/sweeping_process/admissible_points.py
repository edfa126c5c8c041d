"""Points of Q(t) where several constraints are active: rows of the runs, and points pushed against the constraints.

Whether Q(0) is empty: a point of it, proved by bounds, or constraints that no point satisfies together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.region import Region
from nsmodel.models.sweeping_process.model import SweepingProcess
from nsmodel.proof import extremum, interval_bounds
from nsmodel.proof.convex.sets import ConvexSet
from nsmodel.proof.verdict import HOLDS, UNKNOWN, VIOLATED, HypothesisPart, attach_buffers
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.solvers import mlcp
from nsmodel.solvers.residuals import NumericLaw

MAX_LINEARISATIONS = 12  # Linearisations before a projection counts as not found: they converge as Newton's method does.
MAX_NAMED_STATES = 12  # States that a witness names one by one, as many as a report shows entries of one,
MAX_NAMED_TOGETHER = 4  # and constraints that a sentence names.
# How deep points of Q(0) are looked for, relative to the gradients and
# the box: a deeper one is easier to prove, thin sets have none.
INNER_MARGINS = 1e-2, 1e-5, 1e-8
INNER_STARTS = 16  # Places of the box from which they are looked for: one that is proved is enough.
# A constraint may be this much below 0, relative to its gradient and the box: far more than formulas lose.
FEASIBILITY_TOLERANCE = 1e-10


class PartialSweepingProcess(NamedTuple):
    """A sweeping process, or a part of one whose states no other constraint touches.

    Attributes:
        g: SX (p, 1); q: SX (n, 1); t: SX.
        rows: the constraints' indices in the model.
        columns: the states' indices in the model.
        lower, upper: (1 + n,) the box of (t, q).
        known: points (t, q) of the start and of the runs.
        function: (t, q) -> values and gradients.
        evaluate: the same, quickly, for one point.
    """

    g: ca.SX
    q: ca.SX
    t: ca.SX
    rows: tuple[int, ...]
    columns: tuple[int, ...]
    lower: np.ndarray
    upper: np.ndarray
    known: tuple[tuple[float, np.ndarray], ...]
    function: ca.Function
    evaluate: Callable[[float, np.ndarray], tuple[np.ndarray, np.ndarray]]

    @property
    def z(self) -> ca.SX:
        """The symbols (t, q) in one column."""
        return ca.vertcat(self.t, self.q)

    @property
    def size(self) -> float:
        """The largest width of the box of states."""
        return float(np.max(self.upper[1:] - self.lower[1:], initial=0.0))

    def at(self, t: float, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (p,) and gradients (p, n)."""
        return self.evaluate(t, q)

    def admits(self, g: np.ndarray, G: np.ndarray) -> bool:
        """Whether a point with these values and gradients is in Q(t), to rounding."""
        return bool(np.isfinite(G).all() and (g >= -FEASIBILITY_TOLERANCE * self.size * np.linalg.norm(G, axis=1)).all())

    def part(self, rows: Sequence[int], columns: Sequence[int]) -> PartialSweepingProcess:
        """Return the process of some constraints and states, given by their places in this one."""
        ends = [0, *(1 + j for j in columns)]
        known = tuple((t, q[list(columns)]) for t, q in self.known)
        names = tuple(self.rows[i] for i in rows), tuple(self.columns[j] for j in columns)
        return _make_process(self.g[list(rows)], self.q[list(columns)], self.t, *names, self.lower[ends], self.upper[ends], known)


def build_process(model: SweepingProcess, region: Region, runs: Sequence[Trajectory], count: int) -> PartialSweepingProcess:
    """Return the process of a model, with up to ``count`` rows of each run."""
    known = [(0.0, np.array(ca.DM(model.q0)).ravel())]
    known += [(float(run.t[k]), run.x[k]) for run in runs for k in np.unique(np.linspace(0, len(run.t) - 1, count, dtype=int))]
    finite = tuple((t, q) for t, q in known if np.isfinite(q).all())
    names = tuple(range(model.g.numel())), tuple(range(len(model.names)))
    return _make_process(model.g, model.q, model.t, *names, *region.bounds_with_time(), finite)


def unconstrained_process(q: ca.SX, t: ca.SX, lower: np.ndarray, upper: np.ndarray) -> PartialSweepingProcess:
    """Return the process of some states alone, on the box (1 + n,) of (t, q)."""
    return _make_process(ca.SX(0, 1), q, t, (), tuple(range(q.numel())), lower, upper, ())


def _make_process(g, q, t, rows, columns, lower, upper, known) -> PartialSweepingProcess:
    function = ca.Function("g", [t, q], [ca.densify(g), ca.densify(ca.jacobian(g, q))])
    return PartialSweepingProcess(
        g, q, t, rows, columns, lower, upper, known, function, _evaluator(function, len(rows), len(columns))
    )


def _evaluator(function: ca.Function, p: int, n: int) -> Callable[[float, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Call a function through its buffer: many times as fast as with CasADi's own matrices."""
    if not p or not n:
        return lambda t, q: (np.array(function(t, q)[0]).ravel(), np.zeros((p, n)))
    time, state, g, G = np.zeros(1), np.zeros(n), np.zeros(p), np.zeros(n * p)
    buffer, call = attach_buffers(function, (time, state), (g, G))

    def evaluate(t: float, q: np.ndarray, keep: object = buffer) -> tuple[np.ndarray, np.ndarray]:
        time[0], state[:] = t, q  # ``keep``: the call lives as long as its buffer.
        call()
        return g.copy(), G.reshape(n, p).T.copy()

    return evaluate


def named_state(names: Sequence[str], q: np.ndarray) -> dict[str, Any]:
    """A state in a witness: by name where there are few, else as the list q."""
    return dict(zip(names, q.tolist(), strict=True)) if len(names) <= MAX_NAMED_STATES else {"q": q.tolist()}


def admissible_points(process: PartialSweepingProcess, count: int) -> list[tuple[float, np.ndarray]]:
    """Return points (t, q) of Q(t): those known, ``count`` of the box, and of each known one a point pushed on from it."""
    rows = [(t, q) for t, q in process.known if process.admits(*process.at(t, q))]
    found = list(rows)
    for k, goal in enumerate(extremum.samples(process.lower, process.upper, count)):
        t, y = float(goal[0]), goal[1:]
        point = project_to_admissible(process, t, y, y)
        if point is None and rows:
            t, start = rows[k % len(rows)]
            point = project_to_admissible(process, t, start, start + 0.5 * (y - start))
        if point is not None:
            found.append((t, point))
    for (t, start), y in zip(rows, extremum.samples(process.lower, process.upper, len(rows) + 1)[1:, 1:], strict=True):
        point = project_to_admissible(process, t, start, start + 0.3 * (y - start))
        if point is not None:
            found.append((t, point))
    return found


def point_of_start_set(model: SweepingProcess, region: Region, process: PartialSweepingProcess) -> HypothesisPart:
    """Say whether Q(0) is not empty, for all values of the parameters that stayed symbols.

    Args:
        model: with or without values of its parameters.
        region: with the boxes of those without.
        process: of the model, at some values of these; its known points are tried first.
    """
    if not model.g.numel():
        return HypothesisPart(HOLDS, "no constraint", {}, {})
    at_start, (low, high) = ca.substitute(model.g, model.t, 0), region.parameter_bounds()
    z = ca.vertcat(model.p, model.q)
    for q in _inner_candidates(process):
        if (interval_bounds.enclose(at_start, z, np.append(low, q), np.append(high, q))[0] >= 0).all():
            return HypothesisPart(HOLDS, "a point of Q(0), by bounds", {}, {"q": q})
    together = () if model.p.numel() else ConvexSet(model.q, at_start, model.multiplier_names).empty
    if together:
        named = ", ".join(together[:MAX_NAMED_TOGETHER]) + ", ..." * (len(together) > MAX_NAMED_TOGETHER)
        how = f"Q(0) is empty: no point satisfies {named}{' together' * (len(together) > 1)}"
        return HypothesisPart(VIOLATED, how, {}, {"constraints": list(together)})
    return HypothesisPart(UNKNOWN, "no point of Q(0) is known, which may be empty", {}, {})


def _inner_candidates(process: PartialSweepingProcess) -> Iterator[np.ndarray]:
    """The known points at t = 0, and points that linearised constraints push from them, or from the box, into the inside."""
    known = [q for t, q in process.known if t == 0]
    yield from known
    for margin in INNER_MARGINS:
        for q in (*known, *extremum.samples(process.lower, process.upper, INNER_STARTS)[:, 1:]):
            found = _point_inside(process, q, margin * process.size)
            if found is not None:
                yield found


def _point_inside(process: PartialSweepingProcess, q: np.ndarray, depth: float) -> np.ndarray | None:
    """A point with g_i >= depth |grad g_i| / 2 at t = 0, reached from q by projections on linearised constraints."""
    for _ in range(MAX_LINEARISATIONS):
        g, G = process.at(0.0, q)
        inner = depth * np.linalg.norm(G, axis=1)
        if not (np.isfinite(g).all() and np.isfinite(G).all()):
            return None
        if (g >= inner / 2).all():
            return q
        new = _project_on_linearisation(g - inner, G, q, q)
        if new is None:
            return None
        q = new
    return None


def project_to_admissible(process: PartialSweepingProcess, t: float, start: np.ndarray, goal: np.ndarray) -> np.ndarray | None:
    """Return a point of Q(t) near ``goal``: projections on the linearised constraints, from ``start``, until they agree."""
    q, best = start, None
    for _ in range(MAX_LINEARISATIONS):
        g, G = process.at(t, q)
        if not (np.isfinite(g).all() and np.isfinite(G).all()):
            return best
        new = _project_on_linearisation(g, G, q, goal)
        if new is None:
            return best
        value, slope = process.at(t, new)
        if process.admits(value, slope):
            best = new
            if np.linalg.norm(new - q) <= 1e-11 * process.size:
                return best
        q = new
    return best


def _project_on_linearisation(g: np.ndarray, G: np.ndarray, q: np.ndarray, goal: np.ndarray) -> np.ndarray | None:
    """The point nearest to ``goal`` where g + G (x - q) >= 0; rows join as they are violated."""
    b = g + G @ (goal - q)
    size = np.linalg.norm(G, axis=1)
    slack = 1e-12 * (np.abs(b) + size * np.linalg.norm(goal - q))
    rows = np.flatnonzero(b < -slack)
    x = goal
    for _ in range(20):
        if not rows.size:
            return x
        part = G[rows]
        law = NumericLaw(np.zeros(rows.size), np.full(rows.size, np.inf), ())
        start = np.zeros(rows.size), np.full(rows.size, -1, np.int8)
        found = mlcp.solve_mlcp(part @ part.T, b[rows], law, *start, (mlcp.INDEX_SET, mlcp.LEMKE), True, 1e-9)
        if not found.residual <= 1e-9:
            return None
        x = goal + part.T @ found.l
        left = np.flatnonzero(g + G @ (x - q) < -slack - 1e-12 * size * np.linalg.norm(x - q))
        new = np.union1d(rows, left)
        if new.size == rows.size:
            return x
        rows = new
    return None
