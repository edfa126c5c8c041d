"""Which constraints are near 0 where the bodies are: rows of `solvers.contact_search`, those that matter to a hypothesis.

gamma of a network of near constraints: the constant of (A5) from the gradients of one or two bodies each.

With unit normals n_i as the rows of N, gamma = min |v| over N v >= 1: the escape velocity with the least length. Groups without
common bodies are independent and their gamma^2 add up; the dual l >= 0 has N'l = v, 1'l = |v|^2, and any l gives the lower
bound 1'l / |N'l|, any v the upper bound |v| / min N v.

A5 and A5' of many bodies: a bound for all states where the families are discs, else gamma on the contact graph of rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import EPS
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN
from nsmodel.models.many_bodies.contact_search import least_gap, near_contact_rows
from nsmodel.models.many_bodies.families import Family
from nsmodel.models.many_bodies.representatives import RepresentativeConstraints
from nsmodel.models.many_bodies.schemes import BodiesProblem, ContactRows, uses_neighbour_search
from nsmodel.models.sweeping_process.admissible_points import FEASIBILITY_TOLERANCE
from nsmodel.models.sweeping_process.constraint_bounds import EVERYWHERE, ON_THE_BOX
from nsmodel.models.sweeping_process.mfcq_constant import mfcq_constant
from nsmodel.models.sweeping_process.qualification import (
    ACTIVE_TOLERANCE,
    OPPOSING_GAMMA,
    RHO_FRACTION,
    RHO_TRIES,
    QualificationResult,
)
from nsmodel.models.sweeping_process.qualification_bounds import GammaProof, discs_proof, has_aligned_pairs
from nsmodel.proof import interval_bounds
from nsmodel.proof.verdict import not_none

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

# A deficit below this part of the terms of a constraint counts as rounding:
# far more than formulas lose, less than a step's tolerance.
CONSTRAINT_ROUNDING = 1e-10
BOUNDS_PER_CALL = 1 << 18  # Constraints that are bounded in one go: some arrays of 2 MB for each instruction.
# Constraints above a margin by this part of the positions are looked at too: their value is rounded, by far less.
GAP_MARGIN_ROUNDING = 1e-9


def constraints_within(problem: BodiesProblem, t: float, q: np.ndarray, margin: float) -> ContactRows:
    """Return the constraints with g <= margin at the states q (N, d), NaN where a body is absent."""
    rows = near_contact_rows(problem, t, q, _present_mask(q), float(np.nextafter(margin, np.inf)))
    return rows.at(~(rows.g > margin))


def nearest_constraints(problem: BodiesProblem, t: float, q: np.ndarray) -> ContactRows:
    """Return the constraints with the least g, and all whose g may be below 0."""
    least = least_gap(problem, t, q, _present_mask(q))
    if not np.isfinite(least):
        return constraints_within(problem, t, q, 0.0)
    return constraints_within(problem, t, q, _rounded_margin(least, q))


def undecided_constraints(problem: BodiesProblem, t: float, q: np.ndarray) -> tuple[ContactRows, np.ndarray, np.ndarray]:
    """Return the constraints with the least g and all whose g may be below 0, rounding included, with rigorous bounds (R,)."""
    least = least_gap(problem, t, q, _present_mask(q))
    margin = _rounded_margin(least, q) if np.isfinite(least) else 0.0
    reach = max(
        (_reach_rounding(problem, t, family) for family in problem.families if uses_neighbour_search(family)), default=0.0
    )
    rows = near_contact_rows(problem, t, q, _present_mask(q), float(np.nextafter(margin + reach, np.inf)))
    parts = [
        gap_bounds(problem, t, q, rows.at(some))
        for some in np.array_split(np.arange(len(rows.g)), 1 + len(rows.g) // BOUNDS_PER_CALL)
    ]
    low, high = (np.concatenate(ends) for ends in zip(*parts, strict=True))
    kept = np.flatnonzero(~(rows.g > margin) | ~(low >= 0))
    return rows.at(kept), low[kept], high[kept]


def _rounded_margin(least: float, q: np.ndarray) -> float:
    return max(least, 0.0) + GAP_MARGIN_ROUNDING * (1.0 + float(np.abs(q[_present_mask(q)]).max(initial=0.0)))


def _reach_rounding(problem: BodiesProblem, t: float, family: Family) -> float:
    """How much the reach of a pair is rounded, from that of two bodies with the numbers of each."""
    d, numbers = problem.d, np.unique(problem.numbers, axis=0)
    z = ca.vertcat(problem.model.t, *(member.symbols[d:] for member in family.moving))
    points = np.hstack([np.full((len(numbers), 1), t), numbers, numbers])
    low, high = interval_bounds.enclose(not_none(family.reach), z, points, points)
    return 4 * float(np.nan_to_num(high - low, posinf=0.0).max(initial=0.0))


def row_constraint_name(problem: BodiesProblem, rows: ContactRows, k: int) -> str:
    """The constraint of one row."""
    return problem.name(int(rows.family[k]), int(rows.first[k]), int(rows.second[k]))


def is_body_admissible(problem: BodiesProblem, t: float, q: np.ndarray, body: int) -> bool:
    """Whether every constraint on one body is >= 0."""
    others = np.flatnonzero(_present_mask(q) & (np.arange(len(q)) != body))
    for k, family in enumerate(problem.families):
        if family.over is not None:
            own = (family.over == body).any(axis=1) if family.of_pairs else family.over[:, 0] == body
            first, second = family.over[own].T
        elif family.of_pairs:
            first, second = np.minimum(others, body), np.maximum(others, body)
        else:
            second = np.arange(family.second.group.count) if family.second is not None else np.array([-1])
            first = np.full(second.size, body)
        if not (problem.gap(k, t, q, first, second) >= 0).all():
            return False
    return True


def term_sizes(problem: BodiesProblem, t: float, q: np.ndarray, rows: ContactRows) -> np.ndarray:
    """Return how large (R,) the terms are that g is added up from: its states, each by its slope, and what its bounds show."""
    low, high = gap_bounds(problem, t, q, rows)
    with np.errstate(all="ignore"):
        moved = np.abs(rows.G * q[rows.first]).sum(axis=1) + np.where(rows.pair, np.abs(rows.H * q[rows.other]).sum(axis=1), 0.0)
        return np.nan_to_num(moved, nan=0.0, posinf=0.0) + np.nan_to_num((high - low) / EPS, nan=0.0, posinf=0.0)


def all_admissible(problem: BodiesProblem, t: float, q: np.ndarray) -> bool:
    """Whether every constraint is >= 0, to the rounding of its own terms."""
    rows = constraints_within(problem, t, q, 0.0)
    return bool((rows.g >= -CONSTRAINT_ROUNDING * term_sizes(problem, t, q, rows)).all())


def gap_bounds(problem: BodiesProblem, t: float, q: np.ndarray, rows: ContactRows) -> tuple[np.ndarray, np.ndarray]:
    """Return rigorous bounds (R,) of g, rounding included."""
    low, high = np.full(len(rows.g), -np.inf), np.full(len(rows.g), np.inf)
    for k, family in enumerate(problem.families):
        own = np.flatnonzero(rows.family == k)
        if not own.size:
            continue
        first, second = rows.first[own], rows.second[own]
        columns, values = [problem.model.t, family.first.symbols], [np.full((own.size, 1), t), q[first], problem.numbers[first]]
        if family.second is not None:
            columns.append(family.second.symbols)
            values += [q[second], problem.numbers[second]] if family.of_pairs else [family.second.group.table[second]]
        points = np.hstack(values)
        low[own], high[own] = (
            np.ravel(end) for end in interval_bounds.enclose(ca.SX(family.g), ca.vertcat(*columns), points, points)
        )
    return low, high


def _present_mask(q: np.ndarray) -> np.ndarray:
    return np.all(np.isfinite(q), axis=1)


# Groups of so many constraints are solved by Wolfe's method, exactly but for
# rounding; of more its time grows faster than the interior method's.
MAX_WOLFE_GROUP = 40
# Of the interior method, at most, which closes the gap by a factor in each; then gamma has the bounds found so far.
INTERIOR_ITERATIONS = 60
DUALITY_GAP = 1e-7  # Relative: between the two bounds of gamma, which ends it: more digits than a report shows.
# Constraints of a group beyond which its gamma takes too long (quick: the second), and is not looked at.
MAX_GROUP_SIZE = 20_000, 2_000
CORE_SIZE = 200  # Constraints of a group with such a bound, those with the largest weights, by which opposing normals are shown.


class NetworkGamma(NamedTuple):
    """gamma <= ``gamma``; some weights attain ``attained``: inf where normals oppose each other.

    The group with the largest part: its rows and their weights.
    """

    gamma: float
    attained: float
    rows: np.ndarray
    weights: np.ndarray


def network_gamma(rows: ContactRows, quick: bool = False) -> NetworkGamma | None:
    """Return gamma over some constraints where the bodies are; None where one of their groups is too large."""
    second = np.where(rows.pair, rows.second, -1)
    if len(rows.g) and np.bincount(connected_groups(rows.first, second)).max() > MAX_GROUP_SIZE[quick]:
        return None
    return network_constant((rows.G, rows.H), rows.first, second)


def network_constant(slopes: tuple[np.ndarray, np.ndarray], first: np.ndarray, second: np.ndarray) -> NetworkGamma:
    """Return gamma of constraints on bodies.

    Args:
        slopes: gradients (K, d) by the first and by the second body's state.
        first, second: (K,) numbers of bodies; -1: there is no second.
    """
    size = np.sqrt((slopes[0] ** 2).sum(axis=1) + (slopes[1] ** 2).sum(axis=1))
    if not len(size):
        return NetworkGamma(1.0, 1.0, np.zeros(0, int), np.zeros(0))
    if not (size > 0).all():
        flat = np.flatnonzero(~(size > 0))
        return NetworkGamma(np.inf, np.inf, flat, np.full(flat.size, 1 / flat.size))
    normals = np.hstack(slopes) / size[:, None]
    group = connected_groups(first, second)
    order = np.argsort(group, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(group[order])) + 1)
    low = high = float(sum(len(rows) == 1 for rows in parts))
    worst, rows, weights = (1.0, parts[0][:1], np.ones(1)) if low else (0.0, np.zeros(0, int), np.zeros(0))
    for part in parts:
        if len(part) == 1:
            continue
        N = _normals_matrix(normals[part], first[part], second[part])
        if len(part) <= MAX_WOLFE_GROUP:
            gamma, own = mfcq_constant(N.toarray())
            least = gamma
        else:
            least, gamma, own = interior_gamma_bounds(N)
            if least > OPPOSING_GAMMA:
                least, gamma, own = _opposing_bounds(N, least, own)
        if least > worst:
            worst, rows, weights = least, part, own
        low, high = low + least**2, high + gamma**2
    return NetworkGamma(float(np.sqrt(high)), float(np.sqrt(low)), rows, weights)


def connected_groups(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return a number (K,) for each constraint, the same for those that share bodies, directly or through others."""
    count = int(max(first.max(initial=-1), second.max(initial=-1))) + 1
    pairs = second >= 0
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    graph = csr_matrix((np.ones(int(pairs.sum())), (first[pairs], second[pairs])), (count, count))
    return connected_components(graph, directed=False)[1][first]


def _normals_matrix(normals: np.ndarray, first: np.ndarray, second: np.ndarray) -> csr_matrix:
    """The unit normals as rows over the states of the bodies in this group."""
    d, pair = normals.shape[1] // 2, second >= 0
    bodies, place = np.unique(np.concatenate([first, second[pair]]), return_inverse=True)
    rows = np.concatenate([np.arange(len(first)), np.flatnonzero(pair)])
    values = np.vstack([normals[:, :d], normals[pair, d:]])
    columns = place.ravel()[:, None] * d + np.arange(d)
    from scipy.sparse import csr_matrix

    return csr_matrix((values.ravel(), (np.repeat(rows, d), columns.ravel())), (len(first), len(bodies) * d))


def interior_gamma_bounds(N: csr_matrix) -> tuple[float, float, np.ndarray]:
    """Return a lower and an upper bound of gamma and the weights (sum 1) of the lower one, by a primal-dual interior method.

    min |v|^2/2 over N v - s = 1, s >= 0: v = N'l, l >= 0, l s = 0; each step solves (I + N' (l/s) N) dv = r, sparse.
    """
    from scipy.sparse import diags, identity
    from scipy.sparse.linalg import splu

    k, n = map(int, not_none(N.shape))
    v, s, l = np.zeros(n), np.ones(k), np.ones(k)
    low, high, best = 0.0, np.inf, np.full(k, 1 / k)
    for _ in range(INTERIOR_ITERATIONS):
        W = l / s
        try:
            matrix = (identity(n) + N.T @ diags(W) @ N).tocsc()
            solve = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}).solve
        except RuntimeError:  # Singular to rounding: the bounds stand.
            break
        r_d, r_p, mu = v - N.T @ l, N @ v - s - 1, float(s @ l) / k

        rest = -r_d - N.T @ (l + W * r_p)
        dv = solve(rest)
        ds = N @ dv + r_p
        dl = -l - W * ds
        step = min(_max_positive_step(s, ds), _max_positive_step(l, dl))
        centring = (float((s + step * ds) @ (l + step * dl)) / k / mu) ** 3
        target = (centring * mu - ds * dl) / s
        dv = solve(rest + N.T @ target)
        ds = N @ dv + r_p
        dl = target - l - W * ds
        step = 0.995 * min(_max_positive_step(s, ds), _max_positive_step(l, dl))
        v, s, l = v + step * dv, s + step * ds, l + step * dl
        if not (np.isfinite(l).all() and np.isfinite(v).all()):
            break
        attained = float(l.sum() / max(np.linalg.norm(N.T @ l), 1e-300))
        if attained > low:
            low, best = attained, l / l.sum()
        least = float((N @ v).min())
        high = min(high, float(np.linalg.norm(v)) / least) if least > 0 else high
        if high <= low * (1 + DUALITY_GAP) or low > OPPOSING_GAMMA:
            break
    return low, max(high, low), best


def _opposing_bounds(N: csr_matrix, least: float, weights: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Bounds of gamma and weights where it is above OPPOSING_GAMMA: is 0 in the hull of the normals that weigh most."""
    core = np.argsort(-weights, kind="stable")[:CORE_SIZE]
    normals: Any = N[core]
    gamma, own = mfcq_constant(normals.toarray())
    if not np.isinf(gamma):
        return least, np.inf, weights
    found = np.zeros(len(weights))
    found[core] = own
    return np.inf, np.inf, found


def _max_positive_step(x: np.ndarray, dx: np.ndarray) -> float:
    """The largest step in [0, 1] that keeps x >= 0."""
    falls = dx < 0
    return min(1.0, float(np.min(-x[falls] / dx[falls]))) if falls.any() else 1.0


# Rows of the runs that are looked at, at most, evenly spread: gamma is sampled, and more rows may show a larger one;
MAX_RUN_ROWS = 32
# and so many bodies in them (quick: the second), as the pairs near each body are formed in each row.
MAX_BODY_ROWS = 20_000, 2_000
MAX_NAMED_CONSTRAINTS = 12  # Constraints that a finding names: as many as a report shows entries of a witness.
TimedBodies = tuple[float, np.ndarray]


def decide_bodies_mfcq(
    problem: BodiesProblem,
    kinds: Sequence[RepresentativeConstraints],
    proved: bool,
    points: Sequence[TimedBodies],
    reach: float,
    slope: float,
    size: float,
    quick: bool,
) -> tuple[QualificationResult, QualificationResult]:
    """Return A5 (with the rho chosen) and A5'.

    Args:
        problem: the model's expressions.
        kinds: what stands for its constraints; ``proved``: for all of them.
        points: (t, q (N, d)) in Q(t), absent bodies NaN.
        reach: the least reach; rho is a tenth of it at first, then four times smaller.
        slope: a bound of |grad g|; size: of the box of one body.
        quick: less is looked at.
    """
    if not kinds:
        none = QualificationResult(HOLDS, 1.0, np.inf, EVERYWHERE, "no constraint", 1.0, {})
        return none, none
    near = _decide_bodies_gamma(problem, kinds, proved, points, RHO_FRACTION * reach, slope, size, quick)
    for k in range(1, RHO_TRIES):
        if np.isfinite(near.gamma):
            break
        near = _decide_bodies_gamma(problem, kinds, proved, points, RHO_FRACTION * reach * 4.0**-k, slope, size, quick)
    active = _decide_bodies_gamma(problem, kinds, proved, points, 0.0, slope, size, quick)
    if np.isinf(near.attained) and not np.isinf(active.attained):
        how = (
            f"near-active constraints oppose each other for every rho tried, down to {near.rho:.2g}; active ones were not seen to"
        )
        near = near._replace(how=how)
    return near, active


def _decide_bodies_gamma(
    problem: BodiesProblem,
    kinds: Sequence[RepresentativeConstraints],
    proved: bool,
    points: Sequence[TimedBodies],
    rho: float,
    slope: float,
    size: float,
    quick: bool,
) -> QualificationResult:
    worst, at, looked, left_out, true = NetworkGamma(1.0, 1.0, np.zeros(0, int), np.zeros(0)), None, 0, 0, False
    for t, q in points:
        rows = constraints_within(problem, t, q, rho + ACTIVE_TOLERANCE * size * slope)
        if not (rows.g >= -FEASIBILITY_TOLERANCE * size * rows.size).all():
            continue
        rows = rows.at(rows.g <= rho + ACTIVE_TOLERANCE * size * rows.size)
        network = network_gamma(rows, quick)
        if network is None:
            left_out += 1
            continue
        looked += 1
        if network.attained > worst.attained or at is None or (np.isinf(network.attained) and not true):
            worst, at, true = network, (t, rows), _is_active_to_rounding(problem, t, q, rows, network, rho)
        if np.isinf(worst.attained) and true:
            break
    witness = opposing_witness(problem, worst, at[1]) | ({"t": at[0]} if len(worst.rows) else {}) if at is not None else {}
    proof = _discs_bound(kinds, rho, problem) if proved else None
    if proof is not None and worst.attained <= proof.gamma * (1 + 1e-9):
        return QualificationResult(HOLDS, proof.gamma, proof.rho, EVERYWHERE, proof.how, worst.attained, witness)
    if np.isinf(worst.attained) and true:
        how = "opposing normals at a point that is admissible to rounding; that one is so exactly is not proved"
        return QualificationResult(UNKNOWN, np.inf, rho, ON_THE_BOX, how, np.inf, witness)
    if np.isinf(worst.gamma):
        lost = "constraints oppose each other that are active to the rounding of the whole scene, not to their own"
        lost = lost if np.isinf(worst.attained) else "whether normals oppose each other is lost in rounding"
        return QualificationResult(UNKNOWN, np.inf, rho, ON_THE_BOX, lost, worst.attained, witness)
    how = f"the contact graph of {looked} row{'s' * (looked != 1)}, of the start and the runs; others were not looked for"
    if proof is not None:
        how += f"; more than the {proof.gamma:.6g} that discs have, so that this bound is not used"
    if left_out:
        how += f"; {left_out} with groups of more than {MAX_GROUP_SIZE[quick]} near constraints were left out"
    if not looked and points:
        return QualificationResult(UNKNOWN, np.inf, rho, ON_THE_BOX, how, np.nan, {})
    return QualificationResult(SAMPLED, worst.gamma, rho, ON_THE_BOX, how, worst.attained, witness)


def _discs_bound(kinds: Sequence[RepresentativeConstraints], rho: float, problem: BodiesProblem) -> GammaProof | None:
    """The bound for discs, where each distance is one of the same states of two bodies."""
    constraints = [c for kind in kinds for c in (kind.worst, kind.deepest)]
    return discs_proof(constraints, rho, problem.count) if has_aligned_pairs(constraints, problem.d) else None


def _is_active_to_rounding(
    problem: BodiesProblem, t: float, q: np.ndarray, rows: ContactRows, network: NetworkGamma, rho: float
) -> bool:
    """Whether those that weigh in are within rho, and all are met, to the rounding of their own terms."""
    unseen = ACTIVE_TOLERANCE * term_sizes(problem, t, q, rows)
    used = network.rows[network.weights > 0]
    return bool((rows.g >= -unseen).all() and (rows.g[used] <= rho + unseen[used]).all())


def opposing_witness(problem: BodiesProblem, network: NetworkGamma, rows: ContactRows) -> dict[str, Any]:
    """The constraints of the group with the largest gamma and their weights, the largest first."""
    used = [k for k in np.argsort(-network.weights, kind="stable") if network.weights[k] > 0]
    if not used:
        return {}
    some = used[:MAX_NAMED_CONSTRAINTS]
    found = {"constraints": [row_constraint_name(problem, rows, int(network.rows[k])) for k in some],
             "weights": [float(network.weights[k]) for k in some]}  # fmt: skip
    return found | ({"of": len(used)} if len(used) > len(some) else {})
