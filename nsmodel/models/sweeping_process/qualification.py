"""A5 and A5': the Mangasarian-Fromowitz condition with its constant gamma, for near-active and for active constraints.

rho, within which a constraint counts as near-active, starts at a tenth of the least reach (of a distance its radius, of a plane
half the width of the box) and is divided by 4 until gamma(rho) is finite; where any rho will do it is inf.

A bound of gamma from one point that convex constraints all forbid.

Where g_i is convex and g_i(t, p) <= -m_i < 0, every admissible q has <grad g_i(t, q), q - p> >= g_i(t, q) - g_i(t, p) >= m_i: the
direction q - p leaves them all, whichever are active, and gamma <= |q - p| max b_i / m_i with |grad g_i| <= b_i. Bodies that
keep apart are blown up from one place by it, and with them what they lean on, if that place lies inside each of these.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import cache
from itertools import combinations, pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import sum_in_order
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED
from nsmodel.models.sweeping_process.admissible_points import PartialSweepingProcess, named_state
from nsmodel.models.sweeping_process.constraint_bounds import EVERYWHERE, ON_THE_BOX, Constraint
from nsmodel.models.sweeping_process.mfcq_constant import bound_gamma_on_box, mfcq_constant
from nsmodel.models.sweeping_process.qualification_bounds import GammaProof, body_pair_of, bound_gamma_everywhere
from nsmodel.models.sweeping_process.witnesses import attained_gamma_bound, fixed_ball, prove_opposition
from nsmodel.proof import extremum
from nsmodel.proof.convex import rules
from nsmodel.proof.exact import ROUND_UP_FACTOR
from nsmodel.proof.verdict import not_none, overlapping_groups, suppress_output

TIME_SLICES = (1, 8)  # Parts of the interval of time, each with a point of its own: one point need not be forbidden at all times.
MAX_AWAY_STATES = 60  # States up to which a point that all constraints forbid is looked for, by a search in all of them.


class ForbiddenPointBound(NamedTuple):
    """gamma <= ``gamma`` on the box, for every rho."""

    gamma: float
    how: str


def bound_by_forbidden_point(
    constraints: Sequence[Constraint], slope: np.ndarray, columns: Sequence[int], lower: np.ndarray, upper: np.ndarray
) -> ForbiddenPointBound | None:
    """Return a bound over the box (1 + n,) of (t, q), q the model's states ``columns``; ``slope`` bounds |grad g_i|."""
    if not np.isfinite(slope).all() or len(columns) > MAX_AWAY_STATES or not all(is_convex_in_state(c) for c in constraints):
        return None
    together = _shared_coordinates(constraints, columns)
    for count in TIME_SLICES if any(c.shape.time for c in constraints) and lower[0] < upper[0] else (1,):
        times = np.linspace(lower[0], upper[0], count + 1)
        worst = 0.0
        for a, b in pairwise(times):
            low, high = lower.copy(), upper.copy()
            low[0], high[0] = a, b
            worst = max(worst, _bound_on_interval(constraints, slope, columns, together, low, high))
            if np.isinf(worst):
                break
        if np.isfinite(worst):
            return ForbiddenPointBound(
                max(worst * ROUND_UP_FACTOR, 1.0),
                "convex constraints that forbid one and the same point: all of them are left by going away from it",
            )
    return None


def is_convex_in_state(c: Constraint) -> bool:
    """Whether g is convex in q at each time, for all q."""
    return c.shape.convex or (not c.shape.time and rules.global_curvatures(c.g, c.q)[0].convex)


def _shared_coordinates(constraints: Sequence[Constraint], columns: Sequence[int]) -> np.ndarray:
    """(n,) numbers of the coordinates of a point at which all bodies that keep apart are in one place."""
    place = {j: k for k, j in enumerate(columns)}
    name = np.arange(len(columns))
    for c in constraints:
        pair = body_pair_of(c)
        for i, j in zip(pair.first, pair.second, strict=True) if pair is not None else ():
            name[name == name[place[j]]] = name[place[i]]
    return np.unique(name, return_inverse=True)[1].ravel()


def _bound_on_interval(
    constraints: Sequence[Constraint], slope: np.ndarray, columns: Sequence[int], together: np.ndarray, lower: np.ndarray,
    upper: np.ndarray,
) -> float:  # fmt: skip
    """The bound on a part of the interval of time; inf where no point was found."""
    y = ca.SX.sym("y", int(together.max()) + 1)
    place = {j: k for k, j in enumerate(columns)}
    rows, t = [], constraints[0].t
    for c in constraints:
        own = ca.vertcat(*(y[int(together[place[i]])] for i in c.shape.own))
        rows.append(ca.substitute(c.g, c.q, own))
    shared = [np.flatnonzero(together == k) for k in range(y.numel())]
    start = np.array([0.5 * (lower[1 + own].mean() + upper[1 + own].mean()) for own in shared])
    width = np.array([max(float((upper - lower)[1 + own].max()), 1e-300) for own in shared])
    for point in _forbidden_points(ca.vertcat(*rows), t, y, slope, start, width, (lower[0], (lower[0] + upper[0]) / 2, upper[0])):
        tops = [_row_supremum(ca.substitute(row, y, ca.DM(point)), t, lower[0], upper[0]) for row in rows]
        if max(tops) < 0:
            p = point[together]
            far = np.linalg.norm(np.maximum(np.abs(lower[1:] - p), np.abs(upper[1:] - p)))
            return float(far * max(b / -top for b, top in zip(slope, tops, strict=True)))
    return np.inf


def _row_supremum(row: ca.SX, t: ca.SX, a: float, b: float) -> float:
    return extremum.supremum(row, t, np.array([a]), np.array([b]), quick=True, bound_to=0.0).bound


def _forbidden_points(
    g: ca.SX, t: ca.SX, y: ca.SX, slope: np.ndarray, start: np.ndarray, width: np.ndarray, times: tuple[float, ...]
) -> list[np.ndarray]:  # fmt: skip
    """Points at which the largest g_i / b_i is small, the best first: by descent from several places."""
    scale = ca.DM(1 / np.maximum(slope, 1e-300) / float(width.max()))
    worst = ca.vertcat(*(ca.substitute(g * scale, t, time) for time in dict.fromkeys(times)))
    value = ca.Function("worst", [y], [ca.densify(worst), ca.densify(ca.jacobian(worst, y))])
    found = []
    for shift in np.vstack([np.zeros(width.size), extremum.samples(-np.ones(width.size), np.ones(width.size), 4)[1:]]):
        point, best = start + shift * width, (np.inf, start)
        for k in range(200):
            entries, J = (np.array(part) for part in value(point))
            entries = np.nan_to_num(entries.ravel(), nan=np.inf)
            i = int(np.argmax(entries))
            if entries[i] < best[0]:
                best = float(entries[i]), point
            slopes = np.nan_to_num(J[i]) * width
            size = np.linalg.norm(slopes)
            if not size:
                break
            point = point - width * slopes / size * 0.5 / (1 + 0.2 * k)
        found.append(best)
    found.sort(key=lambda item: item[0])
    return [point for worst_value, point in found[:2] if worst_value < 0]


# Of the reach: the rho that is tried first. Larger ones have larger gamma, smaller ones allow only shorter steps.
RHO_FRACTION = 0.1
# Values of rho that are tried, each a quarter of the last, a decision each; three times as many where rho = 0 is not violated.
RHO_TRIES = 3
# Powers of a quarter that are tried beyond, where rho = 0 is proved: some rho > 0 has then a bound too.
FINER_RHO_TRIES = (12, 16, 20)
MAX_BOX_STATES = 4  # States of a box that is cut into parts, and whose corners are looked for: with more, parts are too many.
MAX_SEARCH_STATES = 24  # Beyond, a local search by IPOPT takes too long; points that were found count as they are.
ACTIVE_TOLERANCE = 1e-9  # Constraints within this part of the box of 0 are active: ten times what they may be below 0.
CORNER_STARTS = 24  # Points from which corners are searched for, evenly chosen of those that are known,
CORNER_STEPS = 12  # Newton's steps from each, which square the error,
MAX_CORNER_PAIRS = 40  # and pairs of constraints whose corners are searched for.
MAX_TOUCHING_BALLS = 100  # Balls of which each pair is looked at, in rational numbers: 4950 pairs.
# A gamma above this is of normals that oppose each other, as far as a
# search tells: 0 is then within 1e-7 of the hull of unit normals.
OPPOSING_GAMMA = 1e7


class QualificationResult(NamedTuple):
    """gamma(rho) with a verdict, where it is true and how it was found; the worst point as a witness."""

    verdict: str
    gamma: float
    rho: float
    where: str
    how: str
    attained: float
    witness: dict[str, Any]


class WorstGammaPoint(NamedTuple):
    """The largest gamma seen: at (t, q), of constraints ``rows`` with ``weights``; the number of points looked at."""

    gamma: float
    t: float
    q: np.ndarray | None
    rows: np.ndarray
    weights: np.ndarray
    looked: int


def decide_mfcq(
    constraints: Sequence[Constraint], process: PartialSweepingProcess, slope: np.ndarray, reach: float,
    points: list[tuple[float, np.ndarray]], names: Sequence[str], quick: bool,
) -> tuple[QualificationResult, QualificationResult]:  # fmt: skip
    """Return A5 (with the rho chosen) and A5'.

    Args:
        constraints: all of them.
        process: of the whole model.
        slope: (p,) upper bounds of |grad g_i|.
        reach: the least reach.
        points: (t, q) in Q(t).
        names: of the states.
        quick: no bounds over boxes and no local searches.
    """
    near, active = _decide_on_box(constraints, process, slope, reach, points, names, quick)
    touch = None if HOLDS == near.verdict == active.verdict else _touching_balls(constraints, process, names)
    return (near, active) if touch is None else (touch, touch)


def _touching_balls(
    constraints: Sequence[Constraint], process: PartialSweepingProcess, names: Sequence[str]
) -> QualificationResult | None:
    """Two fixed balls that touch from outside at an admissible point, wherever that lies."""
    balls = [(k, ball) for k, c in enumerate(constraints[:MAX_TOUCHING_BALLS]) if (ball := fixed_ball(c)) is not None]
    for (i, (a, r)), (j, (b, s)) in combinations(balls, 2):
        if a.keys() == b.keys() and sum(((a[k] - b[k]) ** 2 for k in a), Fraction(0)) == (r + s) ** 2:
            place = np.array([float(a[k] + (b[k] - a[k]) * r / (r + s)) if k in a else np.nan for k in process.columns])
            worst = WorstGammaPoint(np.inf, float(process.lower[0]), place, np.array([i, j]), np.array([0.5, 0.5]), 1)
            found = _violated_result(constraints, process, worst, names)
            if found is not None:
                return found._replace(where=EVERYWHERE)
    return None


def _decide_on_box(
    constraints: Sequence[Constraint], process: PartialSweepingProcess, slope: np.ndarray, reach: float,
    points: list[tuple[float, np.ndarray]], names: Sequence[str], quick: bool,
) -> tuple[QualificationResult, QualificationResult]:  # fmt: skip
    """A5 and A5' everywhere, or on the box looked at."""
    cut = len(process.columns) <= MAX_BOX_STATES and not quick  # Else a smaller rho proves no more.
    near = _decide_gamma(constraints, process, slope, RHO_FRACTION * reach, points, names, quick)
    for k in range(1, RHO_TRIES):
        if near.verdict in (HOLDS, VIOLATED) or (np.isfinite(near.gamma) and not cut):
            break
        near = _decide_gamma(constraints, process, slope, RHO_FRACTION * reach * 4.0**-k, points, names, quick, k)
    if near.verdict == VIOLATED:  # Opposing normals were proved in contact.
        return near._replace(rho=0.0), near._replace(rho=0.0)
    active = _decide_gamma(constraints, process, slope, 0.0, points, names, quick or near.verdict == HOLDS, 1)
    if near.verdict == HOLDS:
        if active.verdict != HOLDS or active.gamma > near.gamma:
            how = f"gamma(0) <= gamma(rho): {near.how}"
            active = near._replace(rho=0.0, attained=active.attained, witness=active.witness, how=how)
        return near, active
    if active.verdict == VIOLATED:
        return active, active
    finer = (*range(RHO_TRIES, 3 * RHO_TRIES), *FINER_RHO_TRIES) if active.verdict == HOLDS else range(RHO_TRIES, 3 * RHO_TRIES)
    for k in finer if active.verdict == HOLDS or np.isinf(near.gamma) else ():
        near = _decide_gamma(constraints, process, slope, RHO_FRACTION * reach * 4.0**-k, points, names, quick, k)
        if near.verdict == HOLDS or (active.verdict != HOLDS and np.isfinite(near.gamma)):
            return near, active
    if np.isinf(near.gamma):
        how = f"near-active constraints oppose each other, to rounding, for every rho tried, down to {near.rho:.2g}; "
        how += "active ones do not" if active.verdict == HOLDS else "active ones were not proved to"
        near = near._replace(verdict=UNKNOWN, how=how)
    return near, active


def _decide_gamma(
    constraints: Sequence[Constraint], process: PartialSweepingProcess, slope: np.ndarray, rho: float,
    points: list[tuple[float, np.ndarray]], names: Sequence[str], quick: bool, tries: int = 0,
) -> QualificationResult:  # fmt: skip
    """gamma(rho): proved, seen to be infinite in contact (then for every rho), or the largest that was seen."""
    proof = bound_gamma_everywhere(constraints, rho)
    if proof is not None and np.isfinite(proof.gamma):
        worst = _worst_gamma_point(process, points, rho)
        return _proved_result(
            constraints, process, worst, names, GammaProof(max(proof.gamma, 1.0), proof.rho, proof.how), EVERYWHERE, rho
        )
    if not quick and len(process.columns) <= MAX_BOX_STATES:
        points = [*points, *constraint_corners(process, points)]
    worst = _worst_gamma_point(process, points, rho)
    if proof is not None and proof.at is not None and len(proof.at) == 1 + len(process.columns):
        worst = worst._replace(
            gamma=np.inf, t=proof.at[0], q=proof.at[1:], rows=np.array(proof.opposed), weights=np.array(proof.weights)
        )
    if worst.gamma > OPPOSING_GAMMA and (found := _violated_result(constraints, process, worst, names)) is not None:
        return found
    if worst.gamma > OPPOSING_GAMMA and rho > 0:
        return _undecided_result(constraints, process, worst, names, rho)
    if len(groups := overlapping_groups([set(constraint.shape.own) for constraint in constraints])) > 1:
        return _combined_groups_result(constraints, process, slope, rho, points, names, quick, groups, worst)
    away_bound = bound_by_forbidden_point(constraints, slope, process.columns, process.lower, process.upper)
    cut = len(process.columns) <= MAX_BOX_STATES and not quick
    if away_bound is not None and not cut:
        return _proved_result(
            constraints, process, worst, names, GammaProof(away_bound.gamma, np.inf, away_bound.how), ON_THE_BOX, rho
        )
    if cut:
        at = np.append(worst.t, worst.q) if worst.q is not None and np.isfinite(worst.gamma) else None
        value = worst.gamma if np.isfinite(worst.gamma) else 1.0
        bound = bound_gamma_on_box(process, slope, rho, value, at, _known_gamma_bounds(constraints, rho, away_bound), tries)
        if bound.value > value:
            at = not_none(bound.at)
            worst = _worst_gamma_point(process, [(at[0], at[1:])], rho)
        if np.isfinite(bound.bound):
            how = f"one escape direction on each of {bound.looked} parts of the box"
            return _proved_result(constraints, process, worst, names, GammaProof(bound.bound, rho, how), ON_THE_BOX, rho)
        if bound.left is not None:
            rows = not_none(bound.rows)
            start = WorstGammaPoint(1.0, bound.left[0], bound.left[1:], rows, np.full(rows.size, 1 / rows.size), 1)
            for within in dict.fromkeys((0.0, rho)):
                further = _worst_gamma_point(process, [_maximise_gamma(process, start, within)], within)
                if (
                    further.gamma > OPPOSING_GAMMA
                    and (found := _violated_result(constraints, process, further, names)) is not None
                ):
                    return found
                worst = further._replace(looked=worst.looked) if further.gamma > worst.gamma else worst
    return _sampled_result(constraints, process, rho, points, names, quick, worst)


def _proved_result(
    constraints: Sequence[Constraint], process: PartialSweepingProcess, worst: WorstGammaPoint, names: Sequence[str],
    proof: GammaProof, where: str, rho: float
) -> QualificationResult:  # fmt: skip
    """The finding of a bound, with the largest gamma that is proved to be attained, and near where."""
    reached = 1.0
    if worst.q is not None:
        reached = attained_gamma_bound(process, worst.rows, worst.weights, np.append(worst.t, worst.q), min(rho, proof.rho))
    witness = _gamma_witness(constraints, process, worst, names) if reached > 1 else {}
    return QualificationResult(HOLDS, proof.gamma, proof.rho, where, proof.how, min(reached, proof.gamma), witness)


def _violated_result(
    constraints: Sequence[Constraint], process: PartialSweepingProcess, worst: WorstGammaPoint, names: Sequence[str]
) -> QualificationResult | None:
    """The violation, if an admissible point where these constraints are active and oppose each other is proved to exist."""
    found = prove_opposition(constraints, process, worst.rows, worst.weights, np.append(worst.t, not_none(worst.q)))
    if found is None:
        return None
    at = WorstGammaPoint(np.inf, float(found.at[0]), found.at[1:], np.array(found.rows), np.array(found.weights), worst.looked)
    how = f"opposing normals in contact, at an admissible point: {found.how}"
    return QualificationResult(VIOLATED, np.inf, 0.0, ON_THE_BOX, how, np.inf, _gamma_witness(constraints, process, at, names))


def constraint_corners(
    process: PartialSweepingProcess, points: Sequence[tuple[float, np.ndarray]]
) -> list[tuple[float, np.ndarray]]:
    """Points of Q(t) where two constraints meet: from each of some points by the steps of Gauss and Newton."""
    n, p = len(process.columns), len(process.rows)
    if n < 2 or p < 2 or not points:
        return []
    some = [points[k] for k in np.unique(np.linspace(0, len(points) - 1, CORNER_STARTS, dtype=int))]
    t, start = np.array([time for time, _ in some]), np.array([q for _, q in some])
    found: list[tuple[float, np.ndarray]] = []
    for rows in list(combinations(range(p), 2))[:MAX_CORNER_PAIRS]:
        q = start.copy()
        for _ in range(CORNER_STEPS):
            g, G = (np.array(part) for part in process.function.map(len(t))(t[None], q.T))
            J = G.reshape(p, len(t), n).transpose(1, 0, 2)[:, list(rows)]
            ok = np.all(np.isfinite(J), axis=(1, 2)) & np.all(np.isfinite(g[list(rows)]), axis=0)
            J, value = np.where(ok[:, None, None], J, 0.0), np.where(ok[:, None], g[list(rows)].T, 0.0)
            q = q - (np.linalg.pinv(J, rcond=1e-9) @ value[:, :, None])[:, :, 0]
        near = np.isfinite(q).all(axis=1) & (q >= process.lower[1:]).all(axis=1) & (q <= process.upper[1:]).all(axis=1)
        found += [(float(t[k]), q[k]) for k in np.flatnonzero(near)]
    return found


def _known_gamma_bounds(
    constraints: Sequence[Constraint], rho: float, away_bound: ForbiddenPointBound | None
) -> Callable[[tuple[int, ...]], float]:
    """Bounds of gamma that hold on the box, for sets of the constraints."""
    any_set = np.inf if away_bound is None else away_bound.gamma

    @cache
    def known(rows: tuple[int, ...]) -> float:
        proof = bound_gamma_everywhere([constraints[k] for k in rows], rho)
        return any_set if proof is None else min(proof.gamma, any_set)

    return known


def _sampled_result(
    constraints: Sequence[Constraint], process: PartialSweepingProcess, rho: float, points: list[tuple[float, np.ndarray]],
    names: Sequence[str], quick: bool, worst: WorstGammaPoint,
) -> QualificationResult:  # fmt: skip
    """The worst point, made worse by a local search."""
    how = f"{worst.looked} admissible points"
    if len(process.columns) > MAX_SEARCH_STATES:
        how += f", no local search ({len(process.columns)} states)"
    elif quick:
        how += ", no local search (quick)"
    elif worst.q is not None and 1 < len(worst.rows) <= 12:
        further = _worst_gamma_point(process, [_maximise_gamma(process, worst, rho)], rho)
        how += ", one local search"
        if further.gamma > worst.gamma:
            worst = further._replace(looked=worst.looked)
    if worst.gamma > OPPOSING_GAMMA:
        return _violated_result(constraints, process, worst, names) or _undecided_result(constraints, process, worst, names, rho)
    witness = _gamma_witness(constraints, process, worst, names)
    return QualificationResult(SAMPLED, worst.gamma, rho, ON_THE_BOX, how, worst.gamma, witness)


def _undecided_result(
    constraints: Sequence[Constraint], process: PartialSweepingProcess, worst: WorstGammaPoint, names: Sequence[str], rho: float
) -> QualificationResult:
    """Neither a bound nor a violation: normals oppose each other to rounding at a point that is admissible to rounding."""
    how = "constraints oppose each other, to rounding, near a point that was not proved admissible"
    return QualificationResult(
        UNKNOWN, np.inf, rho, ON_THE_BOX, how, worst.gamma, _gamma_witness(constraints, process, worst, names)
    )


def _combined_groups_result(constraints, process, slope, rho, points, names, quick, groups, worst) -> QualificationResult:
    """Groups without common states have orthogonal gradients: gamma^2 is the sum of theirs."""
    own = {j: k for k, j in enumerate(process.columns)}
    found = []
    for rows in groups:
        columns = sorted({own[i] for k in rows for i in constraints[k].shape.own})
        part = process.part(rows, columns)
        some = [(t, q[columns]) for t, q in points]
        found.append(_decide_gamma([constraints[k] for k in rows], part, slope[rows], rho, some, names, quick))
    gamma = float(np.sqrt(sum_in_order(item.gamma**2 for item in found)))
    least = min(found, key=lambda item: (VIOLATED, UNKNOWN, SAMPLED, HOLDS).index(item.verdict))
    if least.verdict in (VIOLATED, UNKNOWN):
        return least
    gamma *= ROUND_UP_FACTOR
    where = ON_THE_BOX if any(item.where == ON_THE_BOX for item in found) else EVERYWHERE
    reached = min(item.rho for item in found)
    how = f"{len(groups)} groups of constraints without common states; " + "; ".join(sorted({item.how for item in found}))
    if least.verdict == HOLDS:
        return _proved_result(constraints, process, worst, names, GammaProof(gamma, reached, how), where, rho)
    return QualificationResult(
        least.verdict, gamma, reached, where, how, worst.gamma, _gamma_witness(constraints, process, worst, names)
    )


def _worst_gamma_point(
    process: PartialSweepingProcess, points: Sequence[tuple[float, np.ndarray]], rho: float
) -> WorstGammaPoint:
    worst = WorstGammaPoint(1.0, 0.0, None, np.zeros(0, int), np.zeros(0), len(points))
    for t, q in points:
        g, G = process.at(t, q)
        if not process.admits(g, G):
            continue
        rows = np.flatnonzero(g <= rho + ACTIVE_TOLERANCE * process.size * np.linalg.norm(G, axis=1))
        gamma, weights = mfcq_constant(G[rows])
        if gamma > worst.gamma or (worst.q is None and rows.size):
            worst = WorstGammaPoint(gamma, t, q, rows, weights, len(points))
    return worst


def _maximise_gamma(process: PartialSweepingProcess, worst: WorstGammaPoint, rho: float) -> tuple[float, np.ndarray]:
    """Minimise |sum u_i n_i(t, q)|^2 over u, t and q with the same constraints within rho; the end, or the start again."""
    J, start = [int(i) for i in worst.rows], not_none(worst.q)
    u = ca.SX.sym("u", len(J))
    slopes = ca.jacobian(process.g[J], process.q)
    hull = sum((u[k] * slopes[k, :] / ca.norm_2(slopes[k, :]) for k in range(len(J))), ca.SX(0))
    free = rho + ACTIVE_TOLERANCE * process.size
    nlp = {"x": ca.vertcat(process.z, u), "f": ca.sumsqr(hull), "g": ca.vertcat(process.g, process.g[J], ca.sum1(u) - 1)}
    options = {"print_time": False, "error_on_fail": False, "show_eval_warnings": False,
               "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 100, "tol": 1e-12}}  # fmt: skip
    p, k = len(process.rows), len(J)
    try:
        with suppress_output():
            answer = ca.nlpsol("worsened", "ipopt", nlp, options)(
                x0=np.concatenate([[worst.t], start, worst.weights]),
                lbx=np.concatenate([process.lower, np.zeros(k)]), ubx=np.concatenate([process.upper, np.ones(k)]),
                lbg=np.concatenate([np.zeros(p), np.full(k, -np.inf), [0]]),
                ubg=np.concatenate([np.full(p, np.inf), np.full(k, free), [0]]),
            )  # fmt: skip
        end = np.array(answer["x"]).ravel()
    except RuntimeError:
        return worst.t, start
    return (float(end[0]), end[1 : 1 + len(process.columns)]) if np.isfinite(end).all() else (worst.t, start)


def _gamma_witness(
    constraints: Sequence[Constraint], process: PartialSweepingProcess, worst: WorstGammaPoint, names: Sequence[str]
) -> dict[str, Any]:
    if worst.q is None:
        return {}
    used = [int(k) for k in np.argsort(-worst.weights, kind="stable") if worst.weights[k] > 0]
    rows = [constraints[worst.rows[k]] for k in used]
    found: dict[str, Any] = {"constraints": [row.name for row in rows], "weights": [float(worst.weights[k]) for k in used]}
    return found | {"t": worst.t} | named_state([names[j] for j in process.columns], worst.q)
