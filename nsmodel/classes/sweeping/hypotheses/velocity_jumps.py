"""Places of Q(t) where the velocity field jumps, or is infinitely steep."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.classes.sweeping.hypotheses.admissible import PartialSweepingProcess, named_state
from nsmodel.classes.sweeping.hypotheses.velocity_blocks import FieldBlock
from nsmodel.hypotheses.findings import HOLDS
from nsmodel.proof import extremum, interval_bounds
from nsmodel.proof.expression_graph import numeric_constants
from nsmodel.proof.jumps import jump_lower_bound, switching_point_pairs
from nsmodel.proof.ray_expansion import growth_exponent

MAX_BASE_STATES, MAX_SWITCH_POINTS = 4, 256  # Admissible states from which jumps are looked for, and switching points tried.
MAX_QUOTIENT_POINTS = 32
MAX_PROVED_JUMPS, MAX_DERIVATIVE_ENTRIES = (
    16,
    16,
)  # Jumps that are to be proved, and entries of a derivative that are followed along a ray.
RAY_LENGTH, SNAP_DISTANCE = (
    1e-6,
    1e-3,
)  # How long a ray is, and how far a point is moved to a number of the formula, beside the box.
PROBE_STEP = 1e-3  # The part of the box that a point is moved by to see how large f is around it.
LipschitzBound = tuple[str, float, str, int]  # (verdict, K, where, points)


def nearest_proved_jump(
    f: ca.SX,
    blocks: list[FieldBlock],
    process: PartialSweepingProcess,
    points_of_Q: Sequence[tuple[float, np.ndarray]],
    names: Sequence[str],
) -> tuple[float, dict[str, Any]] | None:
    """(a lower bound of its size, the jump nearest to the known states) at states of Q(t), proved.

    From an admissible state only the states of one block are moved, to a point where its formula switches.
    """
    found: list[tuple[float, list[int], tuple[np.ndarray, np.ndarray], dict[str, Any]]] = []
    bases = [
        points_of_Q[k] for k in np.unique(np.linspace(0, len(points_of_Q) - 1, MAX_BASE_STATES, dtype=int)) if len(points_of_Q)
    ]
    touched = _constraint_states(process)
    for block in blocks:
        x, y, least = switch_jumps(block)
        if not len(x):
            continue
        own, moves = slice(1, 1 + block.q.numel()), bool(ca.depends_on(block.f, ca.vertcat(block.t, block.s)))
        for rows, columns in block.members:
            sides = _jump_size_function(f[rows], process, touched, columns)
            for t, q in bases:
                times = x[:, 0] if moves else np.full(len(x), t)
                size = sides(times, x[:, own], y[:, own], least, q)
                far = np.linalg.norm(x[:, own] - q[columns], axis=1)
                for k in np.flatnonzero(size):
                    point = q.copy()
                    point[columns] = x[k, own]
                    other = point.copy()
                    other[columns] = y[k, own]
                    witness = {"t": times[k], "moved": [names[j] for j in columns], "to": x[k, own]}
                    ends = np.append(times[k], point), np.append(times[k], other)
                    found.append((far[k], rows, ends, witness | named_state(names, point)))
    for _, rows, ends, witness in sorted(found, key=lambda item: item[0])[:MAX_PROVED_JUMPS]:
        size = jump_lower_bound(ca.densify(f[rows]), process.z, *ends, process.g, process.lower, process.upper)
        if size > 0:
            return size, witness | {"size": size}
    return None


def switch_jumps(block: FieldBlock) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (k, n) on both sides of switches of a block, where its value jumps, and what is rounding there (k,)."""
    lower, upper = block.box(False)
    x, y = switching_point_pairs(block.f, block.z, lower, upper)
    if not len(x):
        return x, y, np.zeros(0)
    f = ca.Function("f", [block.z], [ca.densify(block.f)])
    least = _jump_rounding(f, x, PROBE_STEP * (upper - lower))
    some = np.flatnonzero(jump_sizes(np.array(f(x.T)).T, np.array(f(y.T)).T, least))
    some = some[:: max(1, some.size // MAX_SWITCH_POINTS)]
    return x[some], y[some], least[some]


def _jump_rounding(f: ca.Function, x: np.ndarray, step: np.ndarray) -> np.ndarray:
    """How much of a change of f beside x (k, n) the rounding of f and of x explains (k,), from the values around x."""
    around = np.zeros(len(x))
    for direction in np.random.default_rng(0).uniform(-1, 1, (4, step.size)):
        for sign in (1, -1):
            size = np.linalg.norm(np.array(f((x + sign * step * direction).T)), axis=0)
            around = np.fmax(around, np.where(np.isfinite(size), size, 0.0))
    far = np.max(np.abs(x) / np.where(step > 0, step, np.inf), axis=1, initial=0.0)
    return 1e-12 * around * (1 + far)


def jump_sizes(below: np.ndarray, above: np.ndarray, least: np.ndarray) -> np.ndarray:
    """The size (k,) of the jumps between values (k, r); 0 where rounding explains it, which ``least`` (k,) is known to."""
    with np.errstate(all="ignore"):
        size = np.linalg.norm(above - below, axis=1)
        scale = np.linalg.norm(below, axis=1) + np.linalg.norm(above, axis=1)
        return np.where(np.isfinite(size) & (size > 1e-7 * scale) & (size > least), size, 0.0)


def _constraint_states(process: PartialSweepingProcess) -> list[set[int]]:
    """The states that each constraint depends on."""
    pattern = ca.Function("g", [process.q, process.t], [ca.densify(process.g)]).jac_sparsity(0, 0)
    found: list[set[int]] = [set() for _ in range(process.g.numel())]
    for i, j in zip(*pattern.get_triplet(), strict=True):
        found[i].add(j)
    return found


def _jump_size_function(
    f: ca.SX, process: PartialSweepingProcess, touched: list[set[int]], columns: list[int]
) -> Callable[..., np.ndarray]:
    """Return sides(times (k,), x (k, c), y (k, c), least (k,), q): how far f jumps (k,) from x to y, both in Q(t), else 0."""
    rows = [i for i, states in enumerate(touched) if states & set(columns)]
    others = [j for j in range(process.q.numel()) if j not in set(columns)]
    together = ca.vertcat(process.t, process.q[columns])
    r, value = f.numel(), ca.densify(ca.vertcat(f, process.g[rows]))
    function = ca.Function("sides", [together, process.q[others]], [value])

    def jump_sizes_at(times: np.ndarray, x: np.ndarray, y: np.ndarray, least: np.ndarray, q: np.ndarray) -> np.ndarray:
        # The other states are one column: CasADi repeats it.
        both = np.hstack([np.vstack([times, side.T]) for side in (x, y)])
        values = np.array(function(both, q[others])).T.reshape(2, len(x), -1)
        inside = (values[:, :, r:] >= 0).all(axis=(0, 2))
        return np.where(inside, jump_sizes(values[0, :, :r], values[1, :, :r], least), 0.0)

    return jump_sizes_at


def max_difference_quotient(f: ca.SX, process: PartialSweepingProcess, points: Sequence[tuple[float, np.ndarray]]) -> float:
    """The largest |f(t, q) - f(t, q')| / |q - q'| over pairs of admissible points."""
    value, worst = ca.Function("f", [process.t, process.q], [ca.densify(f)]), 0.0
    some = [points[k] for k in np.unique(np.linspace(0, len(points) - 1, MAX_QUOTIENT_POINTS, dtype=int))] if points else []
    for k, (t, q) in enumerate(some):
        for _, other in some[:k]:
            far = np.linalg.norm(q - other)
            if far > 0 and (not process.rows or process.admits(*process.at(t, other))):
                worst = max(worst, float(np.linalg.norm(np.array(value(t, q) - value(t, other))) / far))
    return worst


def steep_point(
    f: ca.SX, blocks: list[FieldBlock], norms: list[LipschitzBound], process: PartialSweepingProcess,
    points: Sequence[tuple[float, np.ndarray]], names: Sequence[str],
) -> dict[str, Any] | None:  # fmt: skip
    """A point of Q(t) near which difference quotients of f, a function of the process's t and q, keep growing.

    From an admissible state only the states of one block are moved, to where its derivative is largest or to numbers of its
    formula near to that; along a ray from there that stays in Q(t) an entry of the derivative is shown to grow as a power < 0 of
    the distance.
    """
    if not points:
        return None
    base_t, base = points[0]
    for block, (verdict, *_) in zip(blocks, norms, strict=True):
        if verdict == HOLDS:
            continue
        rows, columns = block.members[0]
        top = extremum.supremum(ca.sumsqr(ca.jacobian(block.f, block.q)), block.z, *block.box(False))
        if top.at is None:
            continue
        J = ca.jacobian(f[rows], process.q[columns])
        entries = [entry for entry in ca.vertsplit(ca.vec(J)) if not entry.is_constant()][:MAX_DERIVATIVE_ENTRIES]
        time = float(top.at[0]) if ca.depends_on(block.f, ca.vertcat(block.t, block.s)) else base_t
        numbers = numeric_constants(f[rows])
        for own in _snap_to_constants(
            top.at[1 : 1 + len(columns)], numbers, process.lower[1:][columns], process.upper[1:][columns]
        ):
            point = base.copy()
            point[columns] = own
            z, width = np.append(time, point), float(np.max((process.upper - process.lower)[1:][columns]))
            h = RAY_LENGTH * min(width, 1.0)
            for direction in [sign * row for row in np.eye(z.size)[1:][columns] for sign in (1.0, -1.0)]:
                if not _is_box_admissible(process, z, z + h * direction):
                    continue
                if any(growth_exponent(entry, process.z, z, direction, h) is not None for entry in entries):
                    return {"t": time} | named_state(names, point)
    return None


def _snap_to_constants(at: np.ndarray, numbers: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> list[np.ndarray]:
    """A point, and it with each coordinate replaced by a number (or 0, or an end of the box) that is near to it."""
    width = np.where(upper > lower, upper - lower, 1.0)
    found = at.copy()
    for k, x in enumerate(at):
        near = np.concatenate([numbers, -numbers, [0.0, lower[k], upper[k]]])
        best = near[np.argmin(np.abs(near - x))]
        found[k] = best if abs(best - x) <= SNAP_DISTANCE * width[k] else x
    return [found, at]


def _is_box_admissible(process: PartialSweepingProcess, *corners: np.ndarray) -> bool:
    """Whether all constraints are >= 0 on the box between two points (t, q), which lies inside the process's."""
    low, high = np.minimum(*corners), np.maximum(*corners)
    if (low < process.lower).any() or (high > process.upper).any():
        return False
    return not process.rows or bool((interval_bounds.enclose(process.g, process.z, low, high)[0] >= 0).all())
