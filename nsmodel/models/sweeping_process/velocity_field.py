"""S-f: is the velocity field Lipschitz in the state, of linear growth, and Lipschitz in time.

The velocity field in blocks that share no states, each formula once.

Places of Q(t) where the velocity field jumps, or is infinitely steep.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED
from nsmodel.models.sweeping_process.admissible_points import PartialSweepingProcess, named_state
from nsmodel.models.sweeping_process.constraint_bounds import EVERYWHERE, ON_THE_BOX, HypothesisAnswer
from nsmodel.proof import extremum, interval_bounds
from nsmodel.proof.domain import DefinednessResult, check_defined_in_time
from nsmodel.proof.exact import ROUND_UP_FACTOR
from nsmodel.proof.expression_graph import (
    OpaqueExpression,
    apply_operation,
    numeric_constants,
    rewrite_nodes,
    stack_column,
    symbol_hashes,
)
from nsmodel.proof.jumps import SWITCH_OPERATIONS, jump_lower_bound, jump_nodes, jump_sizes, switching_point_pairs
from nsmodel.proof.ray_expansion import growth_exponent
from nsmodel.proof.verdict import overlapping_groups


class FieldBlock(NamedTuple):
    """Components of f that share states with each other only; blocks of one formula share ``f`` and ``q``.

    Attributes:
        f: SX (r, 1) in t, q and s.
        q: SX (k, 1).
        s, s_lower, s_upper: switches that depend on time alone, as symbols within bounds.
        members: (rows, columns) of each block with this formula, in the model.
        lower, upper: (1 + k,) bounds of (t, q) around all members.
    """

    f: ca.SX
    q: ca.SX
    t: ca.SX
    s: ca.SX
    s_lower: np.ndarray
    s_upper: np.ndarray
    members: list[tuple[list[int], list[int]]]
    lower: np.ndarray
    upper: np.ndarray

    @property
    def z(self) -> ca.SX:
        """The symbols (t, q, s) in one column."""
        return ca.vertcat(self.t, self.q, self.s)

    def box(self, everywhere: bool) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of z; of all states where ``everywhere``."""
        k = self.q.numel()
        lower = np.concatenate([self.lower[:1], np.full(k, -np.inf) if everywhere else self.lower[1:], self.s_lower])
        upper = np.concatenate([self.upper[:1], np.full(k, np.inf) if everywhere else self.upper[1:], self.s_upper])
        return lower, upper


def split_field_blocks(f: ca.SX, process: PartialSweepingProcess) -> list[FieldBlock]:
    """Split f where its components share no states, and put blocks of the same formula together."""
    rows, columns = _dependency_pattern(f, process.q)
    entries = sorted(set(rows))
    states = [{j for k, j in zip(rows, columns, strict=True) if k == i} for i in entries]
    found: dict[tuple, FieldBlock] = {}
    for group in overlapping_groups(states):
        r, j = [entries[k] for k in group], sorted(set().union(*(states[k] for k in group)))
        block = _field_block(f[r], process, r, j)
        first = found.setdefault(_formula_key(block), block)
        if first is not block:
            first.members.append((r, j))
            for least, other in ((first.lower, block.lower), (first.s_lower, block.s_lower)):
                np.minimum(least, other, out=least)
            for largest, other in ((first.upper, block.upper), (first.s_upper, block.s_upper)):
                np.maximum(largest, other, out=largest)
    return list(found.values())


def _formula_key(block: FieldBlock) -> tuple:
    """The operations of a block with all digits of their constants, whatever the symbols are called."""
    f = ca.Function("f", [block.t, block.q, block.s], [ca.densify(block.f)])
    steps = [(f.instruction_id(i), *f.instruction_input(i), -1, *f.instruction_output(i)) for i in range(f.n_instructions())]
    constants = [f.instruction_constant(i) for i, step in enumerate(steps) if step[0] == ca.OP_CONST]
    return tuple(steps), tuple(constants), block.q.numel(), block.s.numel()


def _dependency_pattern(f: ca.SX, q: ca.SX) -> tuple[list[int], list[int]]:
    """Which components depend on which states: a sign or a comparison counts, though its derivative is 0."""
    pattern = ca.Function("f", [q, stack_column(_other_symbols(f, q))], [ca.densify(f)]).jac_sparsity(0, 0)
    return pattern.get_triplet()


def _other_symbols(f: ca.SX, q: ca.SX) -> list[ca.SX]:
    own = symbol_hashes(q)
    return [symbol for symbol in ca.symvar(f) if symbol.element_hash() not in own]


def replace_held_switches(f: ca.SX, q: ca.SX, z: ca.SX) -> tuple[ca.SX, list[tuple[ca.SX, ca.SX]]]:
    """Return f, of q and z, with symbols in place of the switches that do not depend on q, and (symbol, switch) of each."""
    nodes: list[tuple[ca.SX, ca.SX]] = []

    def replace_switch(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX | None:
        if ca.depends_on(old, q):
            return None
        nodes.append((ca.SX.sym(f"s{len(nodes)}"), old))
        return nodes[-1][0]

    return rewrite_nodes(f, replace_switch, SWITCH_OPERATIONS, z, "f"), nodes


def _field_block(f: ca.SX, process: PartialSweepingProcess, rows: list[int], columns: list[int]) -> FieldBlock:
    own = process.q[columns]
    plain = ca.SX.sym("q", len(columns))
    formula, nodes = replace_held_switches(ca.substitute(f, own, plain), plain, process.t)
    ends = [0, *(1 + j for j in columns)]
    lower, upper = process.lower[ends].copy(), process.upper[ends].copy()
    bounds = (
        interval_bounds.enclose(stack_column(old for _, old in nodes), process.t, lower[:1], upper[:1])
        if nodes
        else (np.zeros(0),) * 2
    )
    s = stack_column(symbol for symbol, _ in nodes)
    return FieldBlock(formula, plain, process.t, s, np.ravel(bounds[0]), np.ravel(bounds[1]), [(rows, columns)], lower, upper)


MAX_BASE_STATES = 4  # Admissible states from which jumps are looked for, evenly chosen,
MAX_SWITCH_POINTS = 256  # and switching points tried; one jump that is proved is enough.
MAX_QUOTIENT_POINTS = 32  # Points between all pairs of which difference quotients are formed, 496.
MAX_PROVED_JUMPS = 16  # Jumps that are to be proved, the nearest to admissible states first,
# and entries of a derivative that are followed along a ray; where nothing is proved the finding stays open.
MAX_DERIVATIVE_ENTRIES = 16
RAY_LENGTH = 1e-6  # How long a ray is: a derivative that grows without bound at its start is large on all of it,
SNAP_DISTANCE = 1e-3  # and how far a point is moved to a number of the formula, beside the box: where derivatives are infinite.
PROBE_STEP = 1e-3  # The part of the box that a point is moved by to see how large f is around it, and so what rounding is there.
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


MAX_CONTINUATION_STATES = 6  # With more, where Q(t) keeps away from is not looked for: the box of all of them is cut.


def decide_velocity(
    f: ca.SX, process: PartialSweepingProcess, points: Sequence[tuple[float, np.ndarray]], names: Sequence[str], quick: bool
) -> HypothesisAnswer:
    """Return K_f, L_f and L_t with the verdict on K_f and L_f; ``points`` (t, q) are in Q(t).

    L_t is infinite where it is not bounded: "largest |f_t| seen" stands beside it.
    """
    start = points[0][1] if len(points) else (process.lower[1:] + process.upper[1:]) / 2
    defined = check_defined_in_time(f, process.t, float(process.lower[0]), float(process.upper[0]), process.q, start)
    if defined.verdict == VIOLATED:
        return HypothesisAnswer(
            VIOLATED, {"L_f": np.inf}, EVERYWHERE, f"f has no finite value for all times: {defined.how}", {"t": defined.at}
        )
    blocks = split_field_blocks(f, process)
    rate, steady = _time_rate_bound(f, process, quick)
    norms = [lipschitz_bound(block, quick) for block in blocks]
    worst = max((K for _, K, _, _ in norms), default=0.0)
    if all(verdict == HOLDS for verdict, *_ in norms):
        where = ON_THE_BOX if any(place == ON_THE_BOX for *_, place, _ in norms) else EVERYWHERE
        L_f = _growth_bound(f, process, blocks, worst, where, quick)
        how = "f is continuous in q and |f_q| is bounded" if worst else "f does not depend on the state"
        return lipschitz_proved_answer(defined, {"K_f": worst, "L_f": L_f} | rate, where, how + steady)
    kept = None if quick or defined.verdict != HOLDS else continue_beyond_singularity(f, process)
    if kept is not None:
        L_f = _growth_bound(kept, process, split_field_blocks(kept, process), np.inf, ON_THE_BOX, quick)
        own = [lipschitz_bound(block, quick) for block in split_field_blocks(kept, process)]
        if all(verdict == HOLDS for verdict, *_ in own):
            how = "Q(t) keeps away from where f is singular: there f is continued to the whole box with a bounded f_q"
            return lipschitz_proved_answer(
                defined, {"K_f": max(K for _, K, _, _ in own), "L_f": L_f} | rate, ON_THE_BOX, how + steady
            )
    known = {"L_f": _growth_bound(f, process, blocks, np.inf, ON_THE_BOX, quick)} | rate
    broken = None if quick else _velocity_violation(f, process, points, names, blocks, norms, known, steady)
    return _sampled_velocity_answer(f, process, points, blocks, norms, known, steady, quick) if broken is None else broken


def _velocity_violation(
    f: ca.SX, process: PartialSweepingProcess, points: Sequence[tuple[float, np.ndarray]], names: Sequence[str],
    blocks: list[FieldBlock], norms: list[LipschitzBound], known: dict[str, float], steady: str,
) -> HypothesisAnswer | None:  # fmt: skip
    """That f jumps, or is infinitely steep somewhere in Q(t); None where neither is found."""
    jump = nearest_proved_jump(f, blocks, process, points, names)
    if jump is not None:
        size, witness = jump
        how = "f jumps inside Q(t), by intervals on both sides, so it is not Lipschitz; the place nearest to the runs is shown"
        return HypothesisAnswer(VIOLATED, {"K_f": np.inf, "jump": size} | known, ON_THE_BOX, how + steady, witness)
    point = steep_point(f, blocks, norms, process, points, names)
    if point is None:
        return None
    how = "an entry of f_q grows without bound towards this point, along a ray in Q(t)"
    return HypothesisAnswer(VIOLATED, {"K_f": np.inf} | known, ON_THE_BOX, how, point)


def _sampled_velocity_answer(
    f: ca.SX, process: PartialSweepingProcess, points: Sequence[tuple[float, np.ndarray]], blocks: list[FieldBlock],
    norms: list[LipschitzBound], known: dict[str, float], steady: str, quick: bool,
) -> HypothesisAnswer:  # fmt: skip
    """The largest slope that was seen."""
    worst = max((K for _, K, _, _ in norms), default=0.0)
    value = {"K_f": max(worst, max_difference_quotient(f, process, points))} | known
    how, verdict = f"{sum(number for *_, number in norms)} points; ", SAMPLED
    if not quick:
        how += "f was not proved continuous with a bounded derivative, no jump was found inside Q(t)"
    elif any(jump_nodes(block.f, block.q) for block in blocks):
        how, verdict = f"f has operations that jump; {how}neither jumps of f nor steep places were looked for (quick)", UNKNOWN
    else:
        how += "neither jumps of f nor steep places were looked for (quick)"
    return HypothesisAnswer(verdict, value, ON_THE_BOX, how + steady)


def lipschitz_proved_answer(defined: DefinednessResult, value: dict[str, float], where: str, how: str) -> HypothesisAnswer:
    """S-f once K_f is proved: it holds where f is defined at all times, and L_f is finite; L_t may be missing."""
    if defined.verdict != HOLDS:
        return HypothesisAnswer(
            UNKNOWN, value, where, f"f is not seen to be finite at all times: {defined.how}; {how}", {"t": defined.at}
        )
    if not np.isfinite(value["L_f"]):
        return HypothesisAnswer(UNKNOWN, value, where, f"no finite bound L_f of |f| was found; {how}")
    return HypothesisAnswer(HOLDS, {name: number for name, number in value.items() if np.isfinite(number)}, where, how)


def lipschitz_bound(block: FieldBlock, quick: bool) -> LipschitzBound:
    """(verdict, K, where, points): proved for all states, else on the box, else the largest |f_q| seen."""
    J = ca.jacobian(block.f, block.q)
    for everywhere in (True, False):
        lower, upper = block.box(everywhere)
        if interval_bounds.is_continuous(block.f, block.z, lower, upper):
            top = extremum.spectral_norm(J, block.z, lower, upper, quick=quick)
            if np.isfinite(top.bound):
                return HOLDS, max(top.bound, 0.0), EVERYWHERE if everywhere else ON_THE_BOX, top.count
    top = extremum.spectral_norm(J, block.z, *block.box(False), quick=True)
    return SAMPLED, top.value, ON_THE_BOX, top.count


def continue_beyond_singularity(f: ca.SX, process: PartialSweepingProcess) -> ca.SX | None:
    """A function that agrees with f on Q(t) in the box, with arguments of roots and divisors kept where they are there.

    Where u >= m > 0 on Q(t), u and max(u, m) are the same there; beyond, max(u, m) stays away from the singularity of sqrt u and
    1 / u. None where no argument is kept away from 0 by Q(t).
    """
    if not process.rows or len(process.columns) > MAX_CONTINUATION_STATES:
        return None
    known: list[tuple[ca.SX, float]] = []

    def least(u: ca.SX) -> float:
        for other, value in known:
            if ca.is_equal(u, other, 6):
                return value
        around = interval_bounds.enclose(u, process.z, process.lower, process.upper)
        value = -np.inf
        if float(around[0].item()) <= 0 < float(around[1].item()):
            value = -extremum.supremum(-u, process.z, process.lower, process.upper, where=process.g).bound
        known.append((u, value))
        return value

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX | None:
        place = 1 if op == ca.OP_DIV else 0
        low = least(old.dep(place))
        if not low > 0:
            return None
        # The larger of u and m, written so that its derivative has bounds.
        return apply_operation(op, [(arg + low + ca.fabs(arg - low)) / 2 if k == place else arg for k, arg in enumerate(args)])

    try:
        found = rewrite_nodes(f, rule, (ca.OP_SQRT, ca.OP_DIV, ca.OP_INV), process.q, "f")
    except OpaqueExpression:
        return None
    return found if any(value > 0 for _, value in known) else None


def _growth_bound(
    f: ca.SX, process: PartialSweepingProcess, blocks: list[FieldBlock], K: float, where: str, quick: bool
) -> float:
    """L_f: max(K_f, sup |f(t, 0)|) where K_f holds everywhere; on the box sup |f| / (1 + |q|), bounded block by block."""
    if where == EVERYWHERE:
        at_zero = ca.sumsqr(ca.substitute(f, process.q, ca.DM.zeros(process.q.numel())))
        return max(K, float(np.sqrt(max(_time_supremum(at_zero, process).bound, 0.0))) * ROUND_UP_FACTOR)
    total = 0.0
    for block in blocks:
        top = extremum.supremum(ca.sumsqr(block.f), block.z, *block.box(False), quick=True)
        total += len(block.members) * (top.bound if np.isfinite(top.bound) else max(top.value, 0.0))
    rest = [i for i in range(f.numel()) if not any(i in rows for block in blocks for rows, _ in block.members)]
    if rest:
        total += max(_time_supremum(ca.sumsqr(f[rest]), process).bound, 0.0)
    nearest = np.clip(0.0, process.lower[1:], process.upper[1:])
    return float(np.sqrt(total) / (1 + np.linalg.norm(nearest))) * ROUND_UP_FACTOR


def _time_supremum(expr: ca.SX, process: PartialSweepingProcess) -> extremum.Supremum:
    return extremum.supremum(expr, process.t, process.lower[:1], process.upper[:1])


def _time_rate_bound(f: ca.SX, process: PartialSweepingProcess, quick: bool) -> tuple[dict[str, float], str]:
    """L_t where it is bounded, and a remark where it is not."""
    if not ca.depends_on(f, process.t):
        return {"L_t": 0.0}, ""
    rate = ca.jacobian(f, process.t)
    if not interval_bounds.is_continuous(f, process.z, process.lower, process.upper):
        return {"L_t": np.inf}, "; f was not proved continuous in t: no L_t, and no order is proved"
    top = extremum.supremum(ca.norm_2(rate), process.z, process.lower, process.upper, quick=quick)
    if np.isfinite(top.bound):
        return {"L_t": float(top.bound)}, ""
    return {"L_t": np.inf, "largest |f_t| seen": float(top.value)}, "; |f_t| was not bounded: no L_t, and no order is proved"
