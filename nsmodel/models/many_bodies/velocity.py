"""S-f of many bodies: the velocity of one, with its numbers as symbols within their ranges.

The Jacobian of f by all states has one block a body, so that K_f is the largest over one body; |f|^2 and |f_t|^2 add up.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.errors import StepError
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED
from nsmodel.hypotheses.inputs import NO_INPUT_BOUNDS, InputBounds, missing_rate_reason
from nsmodel.hypotheses.region import Region
from nsmodel.models.many_bodies.contact_network import all_admissible, is_body_admissible
from nsmodel.models.many_bodies.model import ManyBodies
from nsmodel.models.many_bodies.schemes import BodiesProblem
from nsmodel.models.sweeping_process.admissible_points import unconstrained_process
from nsmodel.models.sweeping_process.constraint_bounds import EVERYWHERE, ON_THE_BOX, HypothesisAnswer
from nsmodel.models.sweeping_process.velocity_field import (
    FieldBlock,
    lipschitz_bound,
    lipschitz_proved_answer,
    replace_held_switches,
    steep_point,
    switch_jumps,
)
from nsmodel.proof import extremum, interval_bounds
from nsmodel.proof.domain import check_defined_in_time
from nsmodel.proof.exact import ROUND_UP_FACTOR
from nsmodel.proof.expression_graph import stack_column
from nsmodel.proof.jumps import jump_lower_bound, jump_nodes, jump_sizes

# Jumps that are to be proved, the nearest first; where none of them is, the finding is sampled, or open.
MAX_BODY_JUMP_PROOFS = 64
MAX_TRIED_BODIES = 8  # Bodies, of different numbers, whose velocity is searched for jumps, evenly chosen.
MAX_REST_CHECKS = 64  # Times, or bodies taken away, for which all others are looked at: each looks at all pairs that are near.
# Parts of the box by which a body is moved for a difference quotient: a jump shows at the least, slopes at the largest.
QUOTIENT_SHIFTS = 1e-1, 1e-4, 1e-7
TimedPositions = tuple[float, np.ndarray]
_BodyJump = tuple[float, dict[str, Any]]


def decide_bodies_velocity(
    problem: BodiesProblem, region: Region, points: Sequence[TimedPositions], quick: bool
) -> HypothesisAnswer:
    """Return K_f, L_f and L_t with the verdict on K_f and L_f.

    Args:
        problem: the model's expressions.
        region: the box of one body.
        points: (t, q (N, d)) in Q(t).
        quick: no jumps are looked for.
    """
    model = problem.model
    if not isinstance(model.f, ca.SX):
        return _sampled_function_answer(problem, region, points)
    z = model.me.symbols
    defined = check_defined_in_time(model.f, model.t, region.t0, region.t1, z, model.bodies.table[0])
    if defined.verdict == VIOLATED:
        return HypothesisAnswer(
            VIOLATED, {"L_f": np.inf}, EVERYWHERE, f"f has no finite value for all times: {defined.how}", {"t": defined.at}
        )
    block = _body_field_block(model, region, problem.numbers)
    verdict, K, where, count = lipschitz_bound(block, quick)
    rate, remark = _bodies_time_rate_bound(model, block, quick)
    if verdict == HOLDS:
        how = "f is continuous in q and |f_q| is bounded" if K else "f does not depend on the state"
        L_f = _bodies_growth_bound(model, block, K, where)
        return lipschitz_proved_answer(defined, {"K_f": K, "L_f": L_f} | rate, where, f"{how}, for one body and for all{remark}")
    L_f = _bodies_growth_bound(model, block, np.inf, ON_THE_BOX)
    if quick:
        able = jump_nodes(block.f, block.q)
        how = f"{count} points; neither jumps of f nor steep places were looked for (quick)"
        how = "f has operations that jump; " + how if able else how
        return HypothesisAnswer(UNKNOWN if able else SAMPLED, {"K_f": K, "L_f": L_f} | rate, ON_THE_BOX, how + remark)
    jump = _nearest_body_jump(problem, points, region)
    if jump is not None:
        size, witness = jump
        how = (
            "f jumps, by intervals on both sides, where a body can be, so it is not Lipschitz; the place nearest to one is shown"
        )
        return HypothesisAnswer(VIOLATED, {"K_f": np.inf, "jump": size, "L_f": L_f} | rate, ON_THE_BOX, how + remark, witness)
    point = _steep_body_point(problem, region, points)
    if point is not None:
        how = "an entry of f_q grows without bound towards this point, along a ray"
        return HypothesisAnswer(VIOLATED, {"K_f": np.inf, "L_f": L_f} | rate, ON_THE_BOX, how + remark, point)
    how = f"{count} points; f was not proved continuous with a bounded derivative, no jump was found inside Q(t)"
    return HypothesisAnswer(SAMPLED, {"K_f": K, "L_f": L_f} | rate, ON_THE_BOX, how + remark)


def uniform_velocity_answer(model: ManyBodies, region: Region, motion: InputBounds) -> HypothesisAnswer | None:
    """K_f, L_f and, where it is bounded, L_t for all values of the parameters in the box of ``region``, inputs among them.

    None where they are not proved.
    """
    if not isinstance(model.f, ca.SX):
        return None
    block = _body_field_block(model, region, model.bodies.table[:, model.bodies.d :])
    verdict, K, where, _ = lipschitz_bound(block, False)
    if verdict != HOLDS:
        return None
    L_f = _bodies_growth_bound(model, block, K, where)
    if not np.isfinite(L_f):
        return None
    rate, remark = _bodies_time_rate_bound(model, block, True, motion)
    value = {"K_f": K, "L_f": L_f} | {name: number for name, number in rate.items() if np.isfinite(number)}
    return HypothesisAnswer(HOLDS, value, where, f"bounds of f and of its derivative, for one body and for all{remark}")


def _used_numbers(model: ManyBodies) -> list[int]:
    """Which of the numbers of a body its velocity depends on."""
    d, symbols = model.bodies.d, model.me.symbols
    return [k for k in range(symbols.numel() - d) if ca.depends_on(model.f, symbols[d + k])]


def _body_field_block(model: ManyBodies, region: Region, table: np.ndarray) -> FieldBlock:
    """The velocity of one of the bodies with the numbers ``table`` (k, K).

    The numbers, parameters without value, and switches that depend on these and on time alone are symbols within bounds.
    """
    d = model.bodies.d
    used, numbers = _used_numbers(model), model.me.symbols[d:]
    plain = ca.SX.sym("q", d)
    chosen = ca.vertcat(stack_column(numbers[k] for k in used), model.p)
    z = ca.vertcat(model.t, chosen)
    f, nodes = replace_held_switches(ca.substitute(model.f, model.me.q, plain), plain, z)
    lower, upper = (
        np.concatenate([[time], end(table[:, used], axis=0), p])
        for time, end, p in zip((region.t0, region.t1), (np.min, np.max), region.parameter_bounds(), strict=True)
    )
    bounds = interval_bounds.enclose(stack_column(old for _, old in nodes), z, lower, upper) if nodes else (np.zeros(0),) * 2
    s = ca.vertcat(chosen, stack_column(symbol for symbol, _ in nodes))
    s_lower, s_upper = (np.concatenate([end[1:], np.ravel(more)]) for end, more in zip((lower, upper), bounds, strict=True))
    box = (np.concatenate([[time], end]) for time, end in zip((region.t0, region.t1), (region.lower, region.upper), strict=True))
    return FieldBlock(f, plain, model.t, s, s_lower, s_upper, [(list(range(d)), list(range(d)))], *box)


def _bodies_growth_bound(model: ManyBodies, block: FieldBlock, K: float, where: str) -> float:
    """L_f: max(K_f, sup |f(t, 0)|) where K_f holds everywhere, else sup |f| / (1 + |q|) on the box."""
    n = model.bodies.count
    lower, upper = block.box(False)
    if where == EVERYWHERE:
        at_zero = ca.substitute(ca.sumsqr(block.f), block.q, ca.DM.zeros(block.q.numel()))
        return max(K, float(np.sqrt(n * max(extremum.supremum(at_zero, block.z, lower, upper).bound, 0.0))) * ROUND_UP_FACTOR)
    top = extremum.supremum(ca.sumsqr(block.f), block.z, lower, upper, quick=True)
    total = n * (top.bound if np.isfinite(top.bound) else max(top.value, 0.0))
    nearest = np.clip(0.0, block.lower[1:], block.upper[1:])
    return float(np.sqrt(total) / (1 + np.sqrt(n) * np.linalg.norm(nearest))) * ROUND_UP_FACTOR


def _bodies_time_rate_bound(
    model: ManyBodies, block: FieldBlock, quick: bool, motion: InputBounds = NO_INPUT_BOUNDS
) -> tuple[dict[str, float], str]:
    """L_t where it is bounded, and a remark where it is not."""
    change = motion.velocity(model.f, model.t)
    if not ca.depends_on(model.f, ca.vertcat(model.t, motion.u)):
        return {"L_t": 0.0}, ""
    if loose := motion.jumping_indices(model.f):
        return {"L_t": np.inf}, f"; {missing_rate_reason(motion, loose)}: no L_t, and no order is proved"
    one = block.box(False)
    z = ca.vertcat(model.t, model.me.q, *(model.me.symbols[model.bodies.d + k] for k in _used_numbers(model)), model.p)
    lower, upper = (end[: z.numel()] for end in one)
    if not interval_bounds.is_continuous(model.f, z, lower, upper):
        return {"L_t": np.inf}, "; f was not proved continuous in t: no L_t, and no order is proved"
    lower, upper = (np.concatenate(ends) for ends in zip((lower, upper), motion.rates, strict=True))
    top = extremum.supremum(ca.norm_2(change), ca.vertcat(z, motion.v), lower, upper, quick=quick)
    if np.isfinite(top.bound):
        return {"L_t": float(np.sqrt(model.bodies.count) * top.bound) * ROUND_UP_FACTOR}, ""
    return {"L_t": np.inf, "largest |f_t| seen": float(top.value)}, "; |f_t| was not bounded: no L_t, and no order is proved"


def _distinct_bodies(model: ManyBodies, table: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Some bodies whose velocities differ by their numbers, and all bodies like each of them."""
    own = table[:, _used_numbers(model)]
    first, which = np.unique(own, axis=0, return_index=True, return_inverse=True)[1:] if own.size else (np.zeros(1, int), 0)
    some = np.unique(np.linspace(0, len(first) - 1, min(len(first), MAX_TRIED_BODIES), dtype=int))
    which = np.broadcast_to(np.ravel(which), len(table))
    return first[some], [np.flatnonzero(which == kind) for kind in some]


def _nearest_body_jump(problem: BodiesProblem, points: Sequence[TimedPositions], region: Region) -> _BodyJump | None:
    """(a lower bound of its size, the jump nearest to a body), one body moved to where its own velocity switches."""
    from scipy.spatial import KDTree

    model, d, table = problem.model, problem.d, problem.numbers
    f = ca.Function("f", [model.t, model.me.symbols], [ca.densify(model.f)])
    moves = ca.depends_on(model.f, model.t)
    rest = [_MovedBodyTest(problem, q) for _, q in points[:2]]
    found: list[tuple[float, float, dict[str, Any]]] = []
    for kind, alike in zip(*_distinct_bodies(model, table), strict=True):
        x, y, least = switch_jumps(_body_field_block(model, region, table[kind : kind + 1]))
        for (t, q), others in zip(points[:2], rest, strict=True):
            present = alike[np.isfinite(q[alike]).all(axis=1)]
            if not present.size or not len(x):
                continue
            far, nearest = map(np.asarray, KDTree(q[present], 16).query(x[:, 1 : 1 + d]))
            tried = 0
            for k in np.argsort(far, kind="stable"):
                if (found and far[k] >= min(item[0] for item in found)) or tried == MAX_BODY_JUMP_PROOFS:
                    break
                time, body = float(x[k, 0]) if moves else t, int(present[nearest[k]])
                ends = x[k, 1 : 1 + d], y[k, 1 : 1 + d]
                one, other = (np.array(f(time, np.concatenate([end, table[kind]]))).T for end in ends)
                if not jump_sizes(one, other, least[k : k + 1])[0] or not all(
                    others.admits_move(time, body, end) for end in ends
                ):
                    continue
                tried += 1
                size = _proved_jump_size(model, table[kind], time, *ends)
                if size > 0:
                    found.append((float(far[k]), size, {"t": time, "size": size, "moved": f"body {body}", "to": ends[0]}))
    if not found:
        return None
    _, size, witness = min(found, key=lambda item: item[0])
    return size, witness


def _proved_jump_size(model: ManyBodies, numbers: np.ndarray, time: float, x: np.ndarray, y: np.ndarray) -> float:
    """A lower bound of the jump of a body's velocity between two places; 0 where none is proved."""
    q = ca.SX.sym("q", model.bodies.d)
    f = ca.substitute(ca.SX(model.f), model.me.symbols, ca.vertcat(q, ca.SX(ca.DM(numbers))))
    f = ca.substitute(f, model.t, time)
    return jump_lower_bound(ca.densify(f), q, x, y)


def _steep_body_point(problem: BodiesProblem, region: Region, points: Sequence[TimedPositions]) -> dict[str, Any] | None:
    """A place where difference quotients of a body's velocity keep growing, if the body nearest to it can be there."""
    model, table = problem.model, problem.numbers
    occupied = [(t, q) for t, q in points if np.all(np.isfinite(q), axis=1).any()]
    if not occupied:
        return None
    t, q = occupied[0]
    others = _MovedBodyTest(problem, q)
    for kind, alike in zip(*_distinct_bodies(model, table), strict=True):
        present = alike[np.isfinite(q[alike]).all(axis=1)]
        if not present.size:
            continue
        own = _body_field_block(model, region, table[kind : kind + 1])
        f = ca.substitute(model.f, model.me.symbols, ca.vertcat(own.q, ca.SX(ca.DM(table[kind]))))
        process = unconstrained_process(own.q, own.t, own.lower, own.upper)
        found = steep_point(f, [own], [(SAMPLED, 0.0, ON_THE_BOX, 0)], process, [(t, q[present[0]])], region.names)
        if found is None:
            continue
        at = np.array([found[name] for name in region.names])
        body = int(present[np.argmin(np.linalg.norm(q[present] - at, axis=1))])
        if others.admits_move(found["t"], body, at):
            return found | {"moved": f"body {body}"}
    return None


class _MovedBodyTest:
    """Bodies at ``q`` (N, d), one of which is moved, at any time."""

    def __init__(self, problem: BodiesProblem, q: np.ndarray) -> None:
        self.problem, self.q, self.known = problem, q, {}
        self.moves = any(ca.depends_on(ca.SX(family.g), problem.model.t) for family in problem.families)
        self.still = not self.moves and all_admissible(problem, 0.0, q)

    def admits_move(self, time: float, body: int, to: np.ndarray) -> bool:
        """Whether all constraints of all bodies are met, to rounding for those who stay."""
        moved = self.q.copy()
        moved[body] = to
        return is_body_admissible(self.problem, time, moved, body) and self._others_admissible(time, body)

    def _others_admissible(self, time: float, body: int) -> bool:
        key = time if self.moves else 0.0, body
        if self.still or (key not in self.known and len(self.known) >= MAX_REST_CHECKS):
            return self.still
        if key not in self.known:
            gone = self.q.copy()
            gone[body] = np.nan
            self.known[key] = all_admissible(self.problem, time, gone)
        return self.known[key]


def _sampled_function_answer(problem: BodiesProblem, region: Region, points: Sequence[TimedPositions]) -> HypothesisAnswer:
    """A function of numbers: difference quotients, which prove nothing."""
    K, L, looked = 0.0, 0.0, 0
    rng = np.random.default_rng(0)
    size = float(np.max(region.upper - region.lower))
    how = "f is a function of arrays: nothing is proved"
    for t, q in points[:4]:
        present = np.all(np.isfinite(q), axis=1)
        if not present.any():
            continue
        looked += 1
        try:
            value = problem.f(t, q, present)[present]
            L = max(L, float(np.linalg.norm(value) / (1 + np.linalg.norm(q[present]))))
            for shift in QUOTIENT_SHIFTS:
                other = q + shift * size * rng.standard_normal(q.shape) / np.sqrt(q.size)
                change = problem.f(t, other, present)[present] - value
                K = max(K, float(np.linalg.norm(change) / np.linalg.norm((other - q)[present])))
        except StepError as error:
            return HypothesisAnswer(UNKNOWN, {"K_f": np.inf, "L_f": np.inf, "L_t": np.inf}, ON_THE_BOX, f"{how}; {error}")
    if not looked:
        return HypothesisAnswer(UNKNOWN, {"K_f": np.inf, "L_f": np.inf, "L_t": np.inf}, ON_THE_BOX, f"{how}; nobody is there")
    how += f"; {len(QUOTIENT_SHIFTS)} difference quotients at {looked} row{'s' * (looked != 1)}"
    return HypothesisAnswer(SAMPLED, {"K_f": K, "L_f": L, "L_t": np.inf}, ON_THE_BOX, how)
