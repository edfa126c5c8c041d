"""A5 and A5' of many bodies: a bound for all states where the families are discs, else gamma on the contact graph of rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from nsmodel.classes.bodies.hypotheses.families import Kind
from nsmodel.classes.bodies.hypotheses.near import named, sizes, within
from nsmodel.classes.bodies.hypotheses.network import LARGE, Network, network_of
from nsmodel.classes.bodies.schemes.prediction_correction import BodiesProblem, ContactRows
from nsmodel.classes.sweeping.hypotheses.admissible import FEASIBLE
from nsmodel.classes.sweeping.hypotheses.constraint import EVERYWHERE, ON_THE_BOX
from nsmodel.classes.sweeping.hypotheses.qualification import FRACTION, TOUCHING, TRIES, Qualified
from nsmodel.classes.sweeping.hypotheses.qualification_proofs import Proof, discs, tied
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN

ROWS = 32  # Rows of the runs that are looked at, at most;
BODY_ROWS = 20_000, 2_000  # and so many bodies in them (quick: the second).
MOST_NAMED = 12
Point = tuple[float, np.ndarray]


def qualification(
    problem: BodiesProblem,
    kinds: Sequence[Kind],
    proved: bool,
    points: Sequence[Point],
    reach: float,
    slope: float,
    size: float,
    quick: bool,
) -> tuple[Qualified, Qualified]:
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
        none = Qualified(HOLDS, 1.0, np.inf, EVERYWHERE, "no constraint", 1.0, {})
        return none, none
    near = _decide(problem, kinds, proved, points, FRACTION * reach, slope, size, quick)
    for k in range(1, TRIES):
        if np.isfinite(near.gamma):
            break
        near = _decide(problem, kinds, proved, points, FRACTION * reach * 4.0**-k, slope, size, quick)
    active = _decide(problem, kinds, proved, points, 0.0, slope, size, quick)
    if np.isinf(near.attained) and not np.isinf(active.attained):
        how = (
            f"near-active constraints oppose each other for every rho tried, down to {near.rho:.2g}; active ones were not seen to"
        )
        near = near._replace(how=how)
    return near, active


def _decide(
    problem: BodiesProblem,
    kinds: Sequence[Kind],
    proved: bool,
    points: Sequence[Point],
    rho: float,
    slope: float,
    size: float,
    quick: bool,
) -> Qualified:
    worst, at, looked, left_out, true = Network(1.0, 1.0, np.zeros(0, int), np.zeros(0)), None, 0, 0, False
    for t, q in points:
        rows = within(problem, t, q, rho + TOUCHING * size * slope)
        if not (rows.g >= -FEASIBLE * size * rows.size).all():
            continue
        rows = rows.at(rows.g <= rho + TOUCHING * size * rows.size)
        network = network_of(rows, quick)
        if network is None:
            left_out += 1
            continue
        looked += 1
        if network.attained > worst.attained or at is None or (np.isinf(network.attained) and not true):
            worst, at, true = network, (t, rows), _sure(problem, t, q, rows, network, rho)
        if np.isinf(worst.attained) and true:
            break
    witness = opposed(problem, worst, at[1]) | ({"t": at[0]} if len(worst.rows) else {}) if at is not None else {}
    proof = _discs(kinds, rho, problem) if proved else None
    if proof is not None and worst.attained <= proof.gamma * (1 + 1e-9):
        return Qualified(HOLDS, proof.gamma, proof.rho, EVERYWHERE, proof.how, worst.attained, witness)
    if np.isinf(worst.attained) and true:
        how = "opposing normals at a point that is admissible to rounding; that one is so exactly is not proved"
        return Qualified(UNKNOWN, np.inf, rho, ON_THE_BOX, how, np.inf, witness)
    if np.isinf(worst.gamma):
        lost = "constraints oppose each other that are active to the rounding of the whole scene, not to their own"
        lost = lost if np.isinf(worst.attained) else "whether normals oppose each other is lost in rounding"
        return Qualified(UNKNOWN, np.inf, rho, ON_THE_BOX, lost, worst.attained, witness)
    how = f"the contact graph of {looked} row{'s' * (looked != 1)}, of the start and the runs; others were not looked for"
    if proof is not None:
        how += f"; more than the {proof.gamma:.6g} that discs have, so that this bound is not used"
    if left_out:
        how += f"; {left_out} with groups of more than {LARGE[quick]} near constraints were left out"
    if not looked and points:
        return Qualified(UNKNOWN, np.inf, rho, ON_THE_BOX, how, np.nan, {})
    return Qualified(SAMPLED, worst.gamma, rho, ON_THE_BOX, how, worst.attained, witness)


def _discs(kinds: Sequence[Kind], rho: float, problem: BodiesProblem) -> Proof | None:
    """The bound for discs, where each distance is one of the same states of two bodies."""
    constraints = [c for kind in kinds for c in (kind.worst, kind.deepest)]
    return discs(constraints, rho, problem.count) if tied(constraints, problem.d) else None


def _sure(problem: BodiesProblem, t: float, q: np.ndarray, rows: ContactRows, network: Network, rho: float) -> bool:
    """Whether those that weigh in are within rho, and all are met, to the rounding of their own terms."""
    unseen = TOUCHING * sizes(problem, t, q, rows)
    used = network.rows[network.weights > 0]
    return bool((rows.g >= -unseen).all() and (rows.g[used] <= rho + unseen[used]).all())


def opposed(problem: BodiesProblem, network: Network, rows: ContactRows) -> dict[str, Any]:
    """The constraints of the group with the largest gamma and their weights, the largest first."""
    used = [k for k in np.argsort(-network.weights, kind="stable") if network.weights[k] > 0]
    if not used:
        return {}
    some = used[:MOST_NAMED]
    found = {"constraints": [named(problem, rows, int(network.rows[k])) for k in some],
             "weights": [float(network.weights[k]) for k in some]}  # fmt: skip
    return found | ({"of": len(used)} if len(used) > len(some) else {})
