"""S-f of many bodies: the velocity of one, with its numbers as symbols within their ranges.

The Jacobian of f by all states has one block a body, so that K_f is the largest over one body; |f|^2 and |f_t|^2 add up.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.hypotheses.bodies.near import admits
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED
from nsmodel.hypotheses.proof import extremum, interval
from nsmodel.hypotheses.proof.jumps import SWITCHES, jumps_in
from nsmodel.hypotheses.region import Region
from nsmodel.hypotheses.sweeping.admissible import part_without_constraints
from nsmodel.hypotheses.sweeping.constraint import EVERYWHERE, ON_THE_BOX, Answer
from nsmodel.hypotheses.sweeping.velocity import Block, differ, jumps, lipschitz, steep
from nsmodel.model.bodies import ManyBodies
from nsmodel.model.convex_read import replay
from nsmodel.model.expressions import column
from nsmodel.scheme.many_bodies import BodiesProblem

TRIED = 8  # Bodies, of different numbers, whose velocity is searched for jumps.
SHIFTS = 1e-1, 1e-4, 1e-7  # Parts of the box by which a body is moved for a difference quotient.
Point = tuple[float, np.ndarray]


def velocity(problem: BodiesProblem, region: Region, points: Sequence[Point], quick: bool) -> Answer:
    """Return K_f, L_f and L_t with the verdict on K_f and L_f.

    Args:
        problem: the model's expressions.
        region: the box of one body.
        points: (t, q (N, d)) in Q(t).
        quick: no jumps are looked for.
    """
    model = problem.model
    if not isinstance(model.f, ca.SX):
        return _called(model, region, points)
    block = _block(model, region)
    verdict, K, where, count = lipschitz(block, quick)
    rate, remark = _in_time(model, block, quick)
    if verdict == HOLDS:
        how = "f is continuous and |f_q| is bounded" if K else "f does not depend on the state"
        L_f = _growth(model, block, K, where)
        return Answer(HOLDS, {"K_f": K, "L_f": L_f} | rate, where, f"{how}, for one body and for all{remark}")
    L_f = _growth(model, block, np.inf, ON_THE_BOX)
    if quick:
        able = jumps_in(block.f, block.q)
        how = f"{count} points; neither jumps of f nor steep places were looked for (quick)"
        how = "f has operations that jump; " + how if able else how
        return Answer(UNKNOWN if able else SAMPLED, {"K_f": K, "L_f": L_f} | rate, ON_THE_BOX, how + remark)
    jump = _jump(problem, block, points)
    if jump is not None:
        number, size, witness = jump
        how = f"f jumps at {number} points found inside Q(t), so it is not Lipschitz there; the one nearest to a body is shown"
        return Answer(VIOLATED, {"K_f": np.inf, "jump": size, "L_f": L_f} | rate, ON_THE_BOX, how + remark, witness)
    if points:
        point = _steep(problem, block, region, (verdict, K, where, count), points[0])
        if point is not None:
            how = "difference quotients grow without bound near this point"
            return Answer(VIOLATED, {"K_f": np.inf, "L_f": L_f} | rate, ON_THE_BOX, how + remark, point)
    how = f"{count} points; f was not proved continuous with a bounded derivative, no jump was found inside Q(t)"
    return Answer(SAMPLED, {"K_f": K, "L_f": L_f} | rate, ON_THE_BOX, how + remark)


def _block(model: ManyBodies, region: Region) -> Block:
    """The velocity of one body: its numbers, and switches that depend on them and on time alone, as symbols within bounds."""
    d, nodes = model.bodies.d, []
    numbers, table = model.me.symbols[d:], model.bodies.table[:, d:]
    used = [k for k in range(numbers.numel()) if ca.depends_on(model.f, numbers[k])]
    plain = ca.SX.sym("q", d)
    chosen = column(numbers[k] for k in used)
    z = ca.vertcat(model.t, chosen)

    def switch(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX | None:
        if ca.depends_on(old, plain):
            return None
        nodes.append((ca.SX.sym(f"s{len(nodes)}"), old))
        return nodes[-1][0]

    f = replay(ca.substitute(model.f, model.me.q, plain), switch, SWITCHES, z, "f")
    lower, upper = (np.concatenate([[time], end(table[:, used], axis=0)])
                    for time, end in ((region.t0, np.min), (region.t1, np.max)))  # fmt: skip
    bounds = interval.enclose(column(old for _, old in nodes), z, lower, upper) if nodes else (np.zeros(0),) * 2
    s = ca.vertcat(chosen, column(symbol for symbol, _ in nodes))
    s_lower, s_upper = (np.concatenate([end[1:], np.ravel(more)]) for end, more in zip((lower, upper), bounds, strict=True))
    box = (np.concatenate([[time], end]) for time, end in zip((region.t0, region.t1), (region.lower, region.upper), strict=True))
    return Block(f, plain, model.t, s, s_lower, s_upper, [(list(range(d)), list(range(d)))], *box)


def _growth(model: ManyBodies, block: Block, K: float, where: str) -> float:
    """L_f: max(K_f, sup |f(t, 0)|) where K_f holds everywhere, else sup |f| / (1 + |q|) on the box."""
    n = model.bodies.count
    lower, upper = block.box(False)
    if where == EVERYWHERE:
        at_zero = ca.substitute(ca.sumsqr(block.f), block.q, ca.DM.zeros(block.q.numel()))
        return max(K, float(np.sqrt(n * max(extremum.supremum(at_zero, block.z, lower, upper).bound, 0.0))))
    top = extremum.supremum(ca.sumsqr(block.f), block.z, lower, upper, quick=True)
    total = n * (top.bound if np.isfinite(top.bound) else max(top.value, 0.0))
    nearest = np.clip(0.0, block.lower[1:], block.upper[1:])
    return float(np.sqrt(total) / (1 + np.sqrt(n) * np.linalg.norm(nearest)))


def _in_time(model: ManyBodies, block: Block, quick: bool) -> tuple[dict[str, float], str]:
    """L_t where it is bounded, and a remark where it is not."""
    if not ca.depends_on(model.f, model.t):
        return {"L_t": 0.0}, ""
    one = block.box(False)
    used = ca.symvar(model.f)
    numbers = [s for s in ca.vertsplit(model.me.symbols[model.bodies.d :]) if any(ca.is_equal(s, other) for other in used)]
    z = ca.vertcat(model.t, model.me.q, *numbers)
    lower, upper = (end[: z.numel()] for end in one)
    if not interval.is_continuous(model.f, z, lower, upper):
        return {"L_t": np.inf}, "; f was not proved continuous in t: no L_t, and no order is proved"
    top = extremum.supremum(ca.norm_2(ca.jacobian(model.f, model.t)), z, lower, upper, quick=quick)
    if np.isfinite(top.bound):
        return {"L_t": float(np.sqrt(model.bodies.count) * top.bound)}, ""
    return {"L_t": np.inf, "largest |f_t| seen": float(top.value)}, "; |f_t| was not bounded: no L_t, and no order is proved"


def _jump(problem: BodiesProblem, block: Block, points: Sequence[Point]) -> tuple[int, float, dict[str, Any]] | None:
    """(number of jumps found, the largest, the one nearest to a body), one body moved to where its own velocity switches."""
    model, d = problem.model, problem.model.bodies.d
    table = problem.numbers
    f = ca.Function("f", [model.t, model.me.symbols], [ca.densify(model.f)])
    own = [k for k in range(table.shape[1]) if ca.depends_on(model.f, model.me.symbols[d + k])]
    kinds = np.unique(table[:, own], axis=0, return_index=True)[1] if own else np.zeros(1, int)
    found: list[tuple[float, float, dict[str, Any]]] = []
    for kind in kinds[np.unique(np.linspace(0, len(kinds) - 1, min(len(kinds), TRIED), dtype=int))]:
        numbers = table[kind]
        fixed = block._replace(s=ca.SX(0, 1), s_lower=np.zeros(0), s_upper=np.zeros(0),
                               f=f(model.t, ca.vertcat(block.q, ca.SX(ca.DM(numbers)))))  # fmt: skip
        alike = np.flatnonzero((table[:, own] == numbers[own]).all(axis=1))
        x, y = jumps(fixed)
        for t, q in points[:2]:
            there = alike[np.isfinite(q[alike]).all(axis=1)]
            for a, b in zip(x, y, strict=True) if there.size else ():
                time = a[0] if ca.depends_on(fixed.f, model.t) else t
                far = np.linalg.norm(q[there] - a[1:], axis=1)
                body = int(there[np.argmin(far)])
                size = float(differ(*(np.array(f(time, np.concatenate([side[1:], numbers]))).T for side in (a, b)))[0])
                if size and all(admits(problem, time, _moved(q, body, side[1:]), body) for side in (a, b)):
                    found.append((float(far.min()), size, {"t": time, "size": size, "moved": f"body {body}", "to": a[1:]}))
    if not found:
        return None
    return len(found), max(size for _, size, _ in found), min(found, key=lambda item: item[0])[2]


def _steep(
    problem: BodiesProblem, block: Block, region: Region, norm: tuple[str, float, str, int], point: Point
) -> dict[str, Any] | None:
    """A place where difference quotients keep growing, if the body nearest to it can be there."""
    t, q = point
    scene = part_without_constraints(block.q, block.t, block.lower, block.upper)
    found = steep([block], [norm], scene, [(t, q[np.isfinite(q).all(axis=1)][0])], region.names)
    if found is None:
        return None
    at = np.array([found[name] for name in region.names])
    body = int(np.nanargmin(np.linalg.norm(q - at, axis=1)))
    return found | {"moved": f"body {body}"} if admits(problem, t, _moved(q, body, at), body) else None


def _moved(q: np.ndarray, body: int, to: np.ndarray) -> np.ndarray:
    other = q.copy()
    other[body] = to
    return other


def _called(model: ManyBodies, region: Region, points: Sequence[Point]) -> Answer:
    """A function of numbers: difference quotients, which prove nothing."""
    K, L = 0.0, 0.0
    rng = np.random.default_rng(0)
    size = float(np.max(region.upper - region.lower))
    for t, q in points[:4]:
        there = np.isfinite(q).all(axis=1)
        value = np.asarray(model.f(t, q), float)[there]
        L = max(L, float(np.linalg.norm(value) / (1 + np.linalg.norm(q[there]))))
        for shift in SHIFTS:
            other = q + shift * size * rng.standard_normal(q.shape) / np.sqrt(q.size)
            change = np.asarray(model.f(t, other), float)[there] - value
            K = max(K, float(np.linalg.norm(change) / np.linalg.norm((other - q)[there])))
    how = f"f is a function of arrays: nothing is proved; {len(SHIFTS)} difference quotients at {min(len(points), 4)} rows"
    value = {"K_f": K, "L_f": L, "L_t": np.inf}
    if not np.isfinite(K + L):
        return Answer(UNKNOWN, value, ON_THE_BOX, how + "; it returned what is no finite number")
    return Answer(SAMPLED, value, ON_THE_BOX, how)
