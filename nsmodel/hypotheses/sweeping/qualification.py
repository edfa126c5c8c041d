"""A5 and A5': the Mangasarian-Fromowitz condition with its constant gamma, for near-active and for active constraints.

rho, within which a constraint counts as near-active, starts at a tenth of the least reach (of a distance its radius, of a plane
half the width of the box) and is divided by 4 until gamma(rho) is finite; where any rho will do it is inf.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED
from nsmodel.hypotheses.sweeping.admissible import Scene, named
from nsmodel.hypotheses.sweeping.constraint import EVERYWHERE, ON_THE_BOX, Constraint
from nsmodel.hypotheses.sweeping.geometry import mfcq_constant
from nsmodel.hypotheses.sweeping.qualification_box import over_box
from nsmodel.hypotheses.sweeping.qualification_proofs import everywhere
from nsmodel.proof.components import sharing
from nsmodel.proof.quiet import quiet

FRACTION, TRIES = 0.1, 3
FEW_STATES = 4
MOST_STATES = 24  # Beyond, a local search takes too long.
TOUCHING = 1e-9  # Constraints within this part of the box of 0 are active.
LOST = 1e7  # A local search that ends above this has found opposing normals, to rounding.


class Qualified(NamedTuple):
    """gamma(rho) with a verdict, where it is true and how it was found; the worst point as a witness."""

    verdict: str
    gamma: float
    rho: float
    where: str
    how: str
    attained: float
    witness: dict[str, Any]


class Worst(NamedTuple):
    """The largest gamma seen: at (t, q), of constraints ``rows`` with ``weights``; the number of points looked at."""

    gamma: float
    t: float
    q: np.ndarray | None
    rows: np.ndarray
    weights: np.ndarray
    looked: int


def qualification(
    constraints: Sequence[Constraint], scene: Scene, slope: np.ndarray, reach: float, points: list[tuple[float, np.ndarray]],
    names: Sequence[str], quick: bool,
) -> tuple[Qualified, Qualified]:  # fmt: skip
    """Return A5 (with the rho chosen) and A5'.

    Args:
        constraints: all of them.
        scene: of the whole model.
        slope: (p,) upper bounds of |grad g_i|.
        reach: the least reach.
        points: (t, q) in Q(t).
        names: of the states.
        quick: no bounds over boxes and no local searches.
    """
    cut = len(scene.columns) <= FEW_STATES and not quick  # Else a smaller rho proves no more.
    near = _decide(constraints, scene, slope, FRACTION * reach, points, names, quick)
    for k in range(1, TRIES):
        if near.verdict == HOLDS or near.rho == 0 or (np.isfinite(near.gamma) and not cut):
            break
        near = _decide(constraints, scene, slope, FRACTION * reach * 4.0**-k, points, names, quick, k)
    if near.rho == 0:  # Opposing normals were found in contact.
        return near, near
    active = _decide(constraints, scene, slope, 0.0, points, names, quick or near.verdict == HOLDS, 1)
    if near.verdict == HOLDS:
        if active.verdict != HOLDS:
            how = f"gamma(0) <= gamma(rho): {near.how}"
            active = near._replace(rho=0.0, attained=active.attained, witness=active.witness, how=how)
        return near, active
    if active.verdict == VIOLATED:
        return active, active
    for k in range(TRIES, 3 * TRIES if active.verdict == HOLDS or np.isinf(near.gamma) else TRIES):
        near = _decide(constraints, scene, slope, FRACTION * reach * 4.0**-k, points, names, quick, k)
        if near.verdict == HOLDS or (active.verdict != HOLDS and np.isfinite(near.gamma)):
            return near, active
    if near.verdict == VIOLATED:
        how = (
            f"near-active constraints oppose each other for every rho tried, down to {near.rho:.2g}; active ones were not seen to"
        )
        near = near._replace(verdict=UNKNOWN, how=how)
    return near, active


def _decide(
    constraints: Sequence[Constraint], scene: Scene, slope: np.ndarray, rho: float, points: list[tuple[float, np.ndarray]],
    names: Sequence[str], quick: bool, tries: int = 0,
) -> Qualified:  # fmt: skip
    worst = _worst(scene, points, rho)
    witness = _witness(constraints, scene, worst, names)
    proof = everywhere(constraints, rho)
    if proof is not None:
        if np.isfinite(proof.gamma):
            how = proof.how
            if worst.gamma > proof.gamma * (1 + 1e-9):
                how += (
                    f"; {worst.gamma:.6g} was seen of constraints that are active to rounding, which the proof excludes exactly"
                )
            return Qualified(HOLDS, proof.gamma, proof.rho, EVERYWHERE, how, min(worst.gamma, proof.gamma), witness)
        own = sorted({i for constraint in constraints for i in constraint.shape.own})
        opposed = {"constraints": [constraints[i].name for i in proof.opposed], "weights": list(proof.weights)}
        where = {"t": proof.at[0]} | named([names[i] for i in own], proof.at[1:]) if proof.at is not None else {}
        how = "these planes oppose each other, and can be near active together (decided exactly, loosened by 1e-9)"
        return Qualified(VIOLATED, np.inf, rho, EVERYWHERE, how, np.inf, opposed | where)
    if np.isinf(worst.gamma):
        return Qualified(VIOLATED, np.inf, rho, ON_THE_BOX, "opposing normals at an admissible point", np.inf, witness)
    groups = sharing([set(constraint.shape.own) for constraint in constraints])
    if len(groups) > 1:
        return _together(constraints, scene, slope, rho, points, names, quick, groups, worst, witness)
    if len(scene.columns) <= FEW_STATES and not quick:
        at = np.append(worst.t, worst.q) if worst.q is not None else None
        bound = over_box(scene, slope, rho, worst.gamma, at, _known(constraints, rho), tries)
        if bound.value > worst.gamma:
            worst = _worst(scene, [(bound.at[0], bound.at[1:])], rho)
            witness = _witness(constraints, scene, worst, names)
        if np.isfinite(bound.bound):
            how = f"one escape direction on each of {bound.looked} parts of the box"
            return Qualified(HOLDS, bound.bound, rho, ON_THE_BOX, how, worst.gamma, witness)
        if bound.left is not None:
            start = Worst(1.0, bound.left[0], bound.left[1:], bound.rows, np.full(bound.rows.size, 1 / bound.rows.size), 1)
            for within in dict.fromkeys((0.0, rho)):
                further = _worst(scene, [_worsened(scene, start, within)], within)
                if further.gamma > LOST:
                    how = "opposing normals, to rounding, found from a part of the box without bound"
                    return Qualified(
                        VIOLATED, np.inf, within, ON_THE_BOX, how, np.inf, _witness(constraints, scene, further, names)
                    )
                worst = further._replace(looked=worst.looked) if further.gamma > worst.gamma else worst
    return _sampled(constraints, scene, rho, points, names, quick, worst)


def _known(constraints: Sequence[Constraint], rho: float) -> Callable[[tuple[int, ...]], float]:
    """Bounds of gamma that hold everywhere, for sets of the constraints."""

    @cache
    def known(rows: tuple[int, ...]) -> float:
        proof = everywhere([constraints[k] for k in rows], rho)
        return np.inf if proof is None else proof.gamma

    return known


def _sampled(
    constraints: Sequence[Constraint], scene: Scene, rho: float, points: list[tuple[float, np.ndarray]], names: Sequence[str],
    quick: bool, worst: Worst,
) -> Qualified:  # fmt: skip
    """The worst point, made worse by a local search."""
    how = f"{worst.looked} admissible points"
    if len(scene.columns) > MOST_STATES:
        how += f", no local search ({len(scene.columns)} states)"
    elif quick:
        how += ", no local search (quick)"
    elif worst.q is not None and 1 < len(worst.rows) <= 12:
        further = _worst(scene, [_worsened(scene, worst, rho)], rho)
        how += ", one local search"
        if further.gamma > worst.gamma:
            worst = further._replace(looked=worst.looked)
    witness = _witness(constraints, scene, worst, names)
    if worst.gamma > LOST:
        return Qualified(VIOLATED, np.inf, rho, ON_THE_BOX, how + ": opposing normals, to rounding", worst.gamma, witness)
    return Qualified(SAMPLED, worst.gamma, rho, ON_THE_BOX, how, worst.gamma, witness)


def _together(constraints, scene, slope, rho, points, names, quick, groups, worst, witness) -> Qualified:
    """Groups without common states have orthogonal gradients: gamma^2 is the sum of theirs."""
    own = {j: k for k, j in enumerate(scene.columns)}
    found = []
    for rows in groups:
        columns = sorted({own[i] for k in rows for i in constraints[k].shape.own})
        part = scene.part(rows, columns)
        some = [(t, q[columns]) for t, q in points]
        found.append(_decide([constraints[k] for k in rows], part, slope[rows], rho, some, names, quick))
    gamma = float(np.sqrt(sum(item.gamma**2 for item in found)))
    least = min(found, key=lambda item: (VIOLATED, SAMPLED, HOLDS).index(item.verdict))
    if least.verdict == VIOLATED:
        return least
    where = ON_THE_BOX if any(item.where == ON_THE_BOX for item in found) else EVERYWHERE
    reached = min(item.rho for item in found)
    how = f"{len(groups)} groups of constraints without common states; " + "; ".join(sorted({item.how for item in found}))
    return Qualified(least.verdict, gamma, reached, where, how, worst.gamma, witness)


def _worst(scene: Scene, points: Sequence[tuple[float, np.ndarray]], rho: float) -> Worst:
    worst = Worst(1.0, 0.0, None, np.zeros(0, int), np.zeros(0), len(points))
    for t, q in points:
        g, G = scene.at(t, q)
        if not scene.admits(g, G):
            continue
        rows = np.flatnonzero(g <= rho + TOUCHING * scene.size * np.linalg.norm(G, axis=1))
        gamma, weights = mfcq_constant(G[rows])
        if gamma > worst.gamma or (worst.q is None and rows.size):
            worst = Worst(gamma, t, q, rows, weights, len(points))
    return worst


def _worsened(scene: Scene, worst: Worst, rho: float) -> tuple[float, np.ndarray]:
    """Minimise |sum u_i n_i(t, q)|^2 over u, t and q with the same constraints within rho; the end, or the start again."""
    J = [int(i) for i in worst.rows]
    u = ca.SX.sym("u", len(J))
    slopes = ca.jacobian(scene.g[J], scene.q)
    hull = sum((u[k] * slopes[k, :] / ca.norm_2(slopes[k, :]) for k in range(len(J))), ca.SX(0))
    free = rho + TOUCHING * scene.size
    nlp = {"x": ca.vertcat(scene.z, u), "f": ca.sumsqr(hull), "g": ca.vertcat(scene.g, scene.g[J], ca.sum1(u) - 1)}
    options = {"print_time": False, "error_on_fail": False, "show_eval_warnings": False,
               "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 100, "tol": 1e-12}}  # fmt: skip
    p, k = len(scene.rows), len(J)
    try:
        with quiet():
            answer = ca.nlpsol("worsened", "ipopt", nlp, options)(
                x0=np.concatenate([[worst.t], worst.q, worst.weights]),
                lbx=np.concatenate([scene.lower, np.zeros(k)]), ubx=np.concatenate([scene.upper, np.ones(k)]),
                lbg=np.concatenate([np.zeros(p), np.full(k, -np.inf), [0]]),
                ubg=np.concatenate([np.full(p, np.inf), np.full(k, free), [0]]),
            )  # fmt: skip
        end = np.array(answer["x"]).ravel()
    except RuntimeError:
        return worst.t, worst.q
    return (float(end[0]), end[1 : 1 + len(scene.columns)]) if np.isfinite(end).all() else (worst.t, worst.q)


def _witness(constraints: Sequence[Constraint], scene: Scene, worst: Worst, names: Sequence[str]) -> dict[str, Any]:
    if worst.q is None:
        return {}
    used = [k for k in np.argsort(-worst.weights, kind="stable") if worst.weights[k] > 0]
    rows = [constraints[worst.rows[k]] for k in used]
    found: dict[str, Any] = {"constraints": [row.name for row in rows], "weights": [float(worst.weights[k]) for k in used]}
    return found | {"t": worst.t} | named([names[j] for j in scene.columns], worst.q)
