"""A5 and A5' of many bodies: a bound for all states where the families are discs, else gamma on the contact graph of rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from nsmodel.classes.bodies.hypotheses.families import RepresentativeConstraints
from nsmodel.classes.bodies.hypotheses.near import constraints_within, row_constraint_name, term_sizes
from nsmodel.classes.bodies.hypotheses.network import MAX_GROUP_SIZE, NetworkGamma, network_gamma
from nsmodel.classes.bodies.schemes.prediction_correction import BodiesProblem, ContactRows
from nsmodel.classes.sweeping.hypotheses.admissible import FEASIBILITY_TOLERANCE
from nsmodel.classes.sweeping.hypotheses.constraint import EVERYWHERE, ON_THE_BOX
from nsmodel.classes.sweeping.hypotheses.qualification import ACTIVE_TOLERANCE, RHO_FRACTION, RHO_TRIES, QualificationResult
from nsmodel.classes.sweeping.hypotheses.qualification_proofs import GammaProof, discs_proof, has_aligned_pairs
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN

MAX_RUN_ROWS = 32  # Rows of the runs that are looked at, at most;
MAX_BODY_ROWS = 20_000, 2_000  # and so many bodies in them (quick: the second).
MAX_NAMED_CONSTRAINTS = 12
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
