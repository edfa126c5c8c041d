"""Assumption 3.1 of a Lur'e system: the domain of Xi has an interior, where Xi is then continuous."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from nsmodel.classes.lure.hypotheses import domains
from nsmodel.classes.lure.hypotheses.domains import EmptyDomain
from nsmodel.classes.lure.hypotheses.potential_domains import ConvexPotential
from nsmodel.classes.lure.model import LureSystem
from nsmodel.hypotheses.findings import HOLDS, UNKNOWN, VIOLATED, Finding, Hypothesis, make_finding
from nsmodel.modeling.laws import Law
from nsmodel.modeling.laws.base import Halfspaces, Intervals, RoundSet
from nsmodel.proof import conic, exact, interval_bounds


def interior_finding(hypothesis: Hypothesis, model: LureSystem, potential: ConvexPotential | None, broken: str) -> Finding:
    """Decide 3.1; ``broken`` says why a potential is not understood."""
    if model.law is not None:
        return _law_interior(hypothesis, model.law, model.multiplier_names)
    if potential is None or broken or (potential.unknown and not potential.finite):
        return make_finding(hypothesis, UNKNOWN, broken or (potential.unknown if potential else "phi is not understood"))
    return _potential_interior(hypothesis, model, potential)


def _law_interior(hypothesis: Hypothesis, law: Law, names: tuple[str, ...]) -> Finding:
    """Block by block; the width is that of the narrowest interval, ball or polyhedron."""
    width = np.inf
    for rows, block in law.parts():
        own, shape = names[rows], block.shape()
        if shape is None:
            return make_finding(hypothesis, UNKNOWN, f"the set of {', '.join(own)} ({block.label}) has no exact form")
        if isinstance(shape, Halfspaces):
            H, K = _drop_trivial_rows(shape)
            answer = conic.decide_feasibility(domains.slack_system(H, K))
            if answer.point is None and answer.separator is None:
                return make_finding(
                    hypothesis, UNKNOWN, f"the polyhedron of {', '.join(own)} is too close to a flat one for its size"
                )
            if answer.separator is not None:
                return _flat_polyhedron_finding(hypothesis, own, H, K, answer.separator)
            width = min(width, 2 * _inradius(H, K))
            continue
        for name, low, up in zip(own, *shape, strict=True) if isinstance(shape, Intervals) else ():
            if low == up:
                how = f"The interval of {name} is the single point {low:g}, so that K has no interior; replace it by its value."
                return make_finding(hypothesis, VIOLATED, how, {"width": 0.0}, {"multiplier": name, "lower = upper": low})
            width = min(width, up - low)
        if isinstance(shape, RoundSet):
            if not shape.radius:
                how = f"The {block.label} of {', '.join(own)} has the radius 0, so that K has no interior."
                return make_finding(hypothesis, VIOLATED, how, {"width": 0.0}, {"multipliers": list(own), "radius": 0.0})
            width = min(width, block.width)
    return make_finding(
        hypothesis,
        HOLDS,
        "Xi is the indicator of K, and K has an interior (exact); width is its narrowest part.",
        {"width": width},
    )


def _drop_trivial_rows(shape: Halfspaces) -> tuple[np.ndarray, np.ndarray]:
    """H, K without rows 0 >= K_i that always hold."""
    H, K = shape
    needed = H.any(axis=1) | (K > 0)
    return H[needed], K[needed]


def _flat_polyhedron_finding(
    hypothesis: Hypothesis, own: tuple[str, ...], H: np.ndarray, K: np.ndarray, separator: np.ndarray
) -> Finding:
    weights = -separator / max(abs(entry) for entry in separator)
    try:
        row = domains.implicit_equalities(H, K)[0]
        how = f"Row {row} of the polyhedron of {', '.join(own)} is an equality on all of K: K has no interior."
        witness: dict[str, Any] = {"row": row, "normal": H[row]}
    except EmptyDomain:
        how, witness = f"The polyhedron of {', '.join(own)} is empty: its rows, so weighted, contradict each other.", {}
    return make_finding(hypothesis, VIOLATED, how, {"width": 0.0}, {**witness, "weights": exact.doubles(weights)})


def _inradius(H: np.ndarray, K: np.ndarray) -> float:
    """Radius of the largest ball in {H l >= K}, by a linear program; inf where there is none."""
    from scipy.optimize import linprog

    norms = np.linalg.norm(H, axis=1, keepdims=True)
    cost = np.append(np.zeros(H.shape[1]), -1.0)
    best = (
        linprog(cost, np.hstack([-H / norms, np.ones_like(norms)]), -K / norms.ravel(), bounds=(None, None)) if len(K) else None
    )
    return float(best.x[-1]) if best is not None and best.status == 0 else np.inf


def _potential_interior(hypothesis: Hypothesis, model: LureSystem, p: ConvexPotential) -> Finding:
    """Dom Xi has an interior if and only if Phi is affine along no direction."""
    rows = np.vstack([exact.zeros(0, model.y.numel()), *(term.J for term in p.terms)])
    if p.Q is not None:
        flat = exact.nullspace(np.vstack([p.Q, rows]))
        value = {"directions along which Phi is affine": flat.shape[1]}
        if not flat.shape[1]:
            return make_finding(
                hypothesis, HOLDS, "Phi is affine along no direction (exact), so that dom Phi* has an interior.", value
            )
        how = "Phi is affine along this direction of y, so that dom Phi* lies in a hyperplane."
        return make_finding(hypothesis, VIOLATED, how, value, {"direction": exact.doubles(flat[:, 0])})
    ones = np.ones(model.y.numel())
    for place, name in ((0 * ones, "y = 0"), *((ones, "y = (1, ..., 1)"),) * p.finite):
        least = _curvature_bound(model, rows, place)
        if least > 0:
            how = f"The Hessian of Phi's smooth part at {name}, with the normals of the other terms, is definite"
            return make_finding(hypothesis, HOLDS, f"{how} (interval arithmetic).", {"least eigenvalue": least})
    return make_finding(
        hypothesis, UNKNOWN, "the smooth part of phi is not quadratic, and its Hessian at y = 0 leaves a direction open"
    )


def _curvature_bound(model: LureSystem, rows: np.ndarray, place: np.ndarray) -> float:
    """A lower bound of the least eigenvalue of the Hessian at ``place``, plus the terms' normals; <= 0 where none is proved."""
    if model.phi_split.tau.numel():
        return 0.0
    hessian = ca.hessian(model.phi_split.smooth, model.y)[0]
    low, high = interval_bounds.enclose(hessian, model.y, place, place)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return 0.0
    J = exact.doubles(rows)
    J = J / np.maximum(np.linalg.norm(J, axis=1, keepdims=True), 1e-300)
    middle, scale = (low + high) / 2 + J.T @ J, max(np.abs(low).max(), np.abs(high).max(), 1.0)
    return float(np.linalg.eigvalsh((middle + middle.T) / 2)[0] - np.linalg.norm(high - low) - 1e-12 * len(place) * scale)
