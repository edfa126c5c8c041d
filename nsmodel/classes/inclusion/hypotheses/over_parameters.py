"""(5), (A1)-(A3), (24) from bounds of Jacobians over states and parameters together: F - S = G(x, p) - B(p) Sgn(u(x))."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.classes.inclusion.hypotheses.growth import NORM_ROUND_UP
from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.hypotheses.domain import potential_without_domain
from nsmodel.proof import extremum, interval_bounds
from nsmodel.proof.convex import rules
from nsmodel.proof.convex.sets import ConvexSet, MovingSet
from nsmodel.proof.jumps import jump_nodes
from nsmodel.proof.verdict import HOLDS, HypothesisPart

EIGENVALUE_LABEL, JACOBIAN_BOUNDS_TEXT = "least eigenvalue of sym S'", "bounds over states and parameters together"


class InclusionCheckContext(NamedTuple):
    """What all decisions rest on: C(p), a set that holds them all, the part of it that is looked at.

    Each C(p) has a point no farther than ``reach`` from 0.
    """

    model: MonotoneInclusion
    moving: MovingSet
    C: ConvexSet
    box: tuple[np.ndarray, np.ndarray]
    reach: float
    quick: bool


class SwitchingBounds(NamedTuple):
    """What is known of B(p) Sgn(u(x)): whether it is monotone for all p, and a bound of its size."""

    monotone: bool
    size: float


def switching_part(model: MonotoneInclusion) -> ca.SX | None:
    """B(p) times the symbols of the signs, where S is affine in these with factors of p alone."""
    symbols = model.sign_symbols
    B = ca.jacobian(model.operator, symbols)
    return None if ca.depends_on(B, ca.vertcat(model.x, symbols)) or jump_nodes(model.operator, symbols) else B @ symbols


class _JacobianDomain(NamedTuple):
    """F = (F - S) + S, S the gradient of phi where there is one, over the states of a box and all parameters."""

    grounds: InclusionCheckContext
    phi: ca.SX | None
    S: ca.SX
    states: tuple[np.ndarray, np.ndarray]

    @property
    def box(self) -> tuple[ca.SX, np.ndarray, np.ndarray]:
        """(x, p) and its bounds."""
        (low, high), moving = self.states, self.grounds.moving
        return ca.vertcat(self.grounds.C.x, self.grounds.model.p), np.append(low, moving.lower), np.append(high, moving.upper)


def prove_over_parameters(grounds: InclusionCheckContext, switching: SwitchingBounds) -> dict[str, HypothesisPart]:
    """What is proved, first on a box that holds C for all p, then on the box looked at."""
    model, C, found = grounds.model, grounds.C, dict[str, HypothesisPart]()
    phi = None if model.phi is None else potential_without_domain(model.phi, model.x, "phi")
    S = ca.gradient(phi, C.x) if phi is not None else ca.substitute(model.operator, model.sign_symbols, 0 * model.sign_symbols)
    for states, local in ((C.bounding_box, False), (grounds.box, True)):
        for id, how, value in _proved_parts(_JacobianDomain(grounds, phi, S, states), switching, "M-T" in found, local):
            found.setdefault(id, HypothesisPart(HOLDS, f"{how}: {JACOBIAN_BOUNDS_TEXT}", value, {}, local))
    return found


def _proved_parts(
    on: _JacobianDomain, switching: SwitchingBounds, monotone: bool, local: bool
) -> Iterator[tuple[str, str, dict[str, float]]]:
    """(id, how, values) of what is proved there; ``monotone``: S is known to be."""
    model, C, phi, S, quick = on.grounds.model, on.grounds.C, on.phi, on.S, on.grounds.quick
    z, low, high = on.box
    if interval_bounds.is_continuous(model.field, z, low, high):
        yield "M-A1", "no operation of F jumps or has a pole", {"kinks": 0}
    if phi is not None and rules.curvatures(phi, z, low, high, of=C.x)[0].convex:
        monotone = True
        yield "M-T", "T = dphi, phi convex by the rules of convex functions", {EIGENVALUE_LABEL: 0.0}
    if not interval_bounds.is_continuous(ca.vertcat(model.field, S), z, low, high):
        return
    J, slope = ca.jacobian(model.field - S, C.x), ca.jacobian(S, C.x)
    if switching.monotone and not monotone:
        top = extremum.largest_eigenvalue(-(slope + slope.T) / 2, z, low, high, bound_to=0.0, quick=quick).bound
        if top <= 0:
            yield "M-T", "the symmetric Jacobian of S is psd", {EIGENVALUE_LABEL: max(-top, 0.0)}
    L = extremum.largest_eigenvalue((J + J.T) / 2, z, low, high, quick=quick).bound
    if switching.monotone and np.isfinite(L):
        yield "M-24", "eigenvalues of the symmetric Jacobian", {"L": L + 0.0}
    if not local:
        yield from _proved_growth(on, J, L, switching.size)


def _proved_growth(on: _JacobianDomain, J: ca.SX, L: float, jump: float) -> Iterator[tuple[str, str, dict[str, float]]]:
    """(A2) and (A3), where J = (F - S)', L bounds the eigenvalues of sym J, ``jump`` the size of what jumps."""
    model, C, reach, moving = on.grounds.model, on.grounds.C, on.grounds.reach, on.grounds.moving
    z, low, high = on.box
    steep = extremum.spectral_norm(J, z, low, high, quick=True).bound
    base = np.clip(np.zeros(C.n), *on.states)
    ends = np.append(base, moving.lower), np.append(base, moving.upper)
    at = np.max(np.abs(interval_bounds.enclose(model.field - on.S, z, *ends)), axis=0)
    M = float(np.linalg.norm(at)) * NORM_ROUND_UP + jump
    if not np.isfinite(M + L):
        return
    a = {"a_1": M + steep * _vector_norm(base), "a_2": steep} if np.isfinite(steep) else None
    if a is not None:
        yield "M-A2", "|F - S| <= |F - S|(c) + |(F - S)'| |x - c|", a
    elif reach:
        return
    # <x, w> <= <x, v> + reach |v|, |v| <= a_1 + a_2 |x|
    p, q = (M + reach * a["a_2"], reach * a["a_1"]) if a is not None and reach else (M, 0.0)
    if L < 0 and not base.any():
        beta = (p**2 / (-2 * L) + q) * NORM_ROUND_UP
        yield "M-A3", "<x, F - S> <= L |x|^2 + |F - S|(0) |x|, L < 0", {"alpha": -L / 2, "beta": beta}
    elif C.bounded and a is not None:
        R = _vector_norm(np.maximum(*np.abs(on.states)))
        beta = ((R + reach) * (a["a_1"] + a["a_2"] * R) + R**2) * NORM_ROUND_UP
        yield "M-A3", f"C is bounded (|x| <= {R:.4g}): any alpha will do, here 1", {"alpha": 1.0, "beta": beta}


def _vector_norm(v: np.ndarray) -> float:
    return float(np.linalg.norm(v)) * NORM_ROUND_UP
