"""S-f: is the velocity field Lipschitz in the state, of linear growth, and Lipschitz in time."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from nsmodel.classes.sweeping.hypotheses.admissible import PartialSweepingProcess
from nsmodel.classes.sweeping.hypotheses.constraint import EVERYWHERE, ON_THE_BOX, HypothesisAnswer
from nsmodel.classes.sweeping.hypotheses.velocity_blocks import FieldBlock, split_field_blocks
from nsmodel.classes.sweeping.hypotheses.velocity_jumps import (
    LipschitzBound,
    max_difference_quotient,
    nearest_proved_jump,
    steep_point,
)
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED
from nsmodel.proof import extremum, interval_bounds
from nsmodel.proof.domain import DefinednessResult, check_defined_in_time
from nsmodel.proof.expression_graph import OpaqueExpression, apply_operation, rewrite_nodes
from nsmodel.proof.jumps import jump_nodes

MAX_CONTINUATION_STATES = 6  # With more, where Q(t) keeps away from is not looked for.


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
        return max(K, float(np.sqrt(max(_time_supremum(at_zero, process).bound, 0.0))))
    total = 0.0
    for block in blocks:
        top = extremum.supremum(ca.sumsqr(block.f), block.z, *block.box(False), quick=True)
        total += len(block.members) * (top.bound if np.isfinite(top.bound) else max(top.value, 0.0))
    rest = [i for i in range(f.numel()) if not any(i in rows for block in blocks for rows, _ in block.members)]
    if rest:
        total += max(_time_supremum(ca.sumsqr(f[rest]), process).bound, 0.0)
    nearest = np.clip(0.0, process.lower[1:], process.upper[1:])
    return float(np.sqrt(total) / (1 + np.linalg.norm(nearest)))


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
