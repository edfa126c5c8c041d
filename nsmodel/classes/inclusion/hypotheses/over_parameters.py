"""(5), (A1)-(A3), (24) from bounds of Jacobians over states and parameters together: F - S = G(x, p) - B(p) Sgn(u(x))."""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.classes.inclusion.hypotheses.growth import UP
from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.hypotheses.domain import without_domain
from nsmodel.proof import extremum, interval
from nsmodel.proof.convex import convexity
from nsmodel.proof.convex.convex_sets import ConvexSet
from nsmodel.proof.convex.moving_sets import MovingSet
from nsmodel.proof.jumps import jumps_in
from nsmodel.proof.verdict import HOLDS, Part

LEAST, HOW = "least eigenvalue of sym S'", "bounds over states and parameters together"


class Grounds(NamedTuple):
    """What all decisions rest on: C(p), a set that holds them all, the part of it that is looked at.

    Each C(p) has a point no farther than ``reach`` from 0.
    """

    model: MonotoneInclusion
    moving: MovingSet
    C: ConvexSet
    box: tuple[np.ndarray, np.ndarray]
    reach: float
    quick: bool


class Switching(NamedTuple):
    """What is known of B(p) Sgn(u(x)): whether it is monotone for all p, and a bound of its size."""

    monotone: bool
    size: float


def switching_part(model: MonotoneInclusion) -> ca.SX | None:
    """B(p) times the symbols of the signs, where S is affine in these with factors of p alone."""
    symbols = model.sign_symbols
    B = ca.jacobian(model.operator, symbols)
    return None if ca.depends_on(B, ca.vertcat(model.x, symbols)) or jumps_in(model.operator, symbols) else B @ symbols


def over_parameters(grounds: Grounds, switching: Switching) -> dict[str, Part]:
    """What is proved, first on a box that holds C for all p, then on the box looked at."""
    model, C, moving, found = grounds.model, grounds.C, grounds.moving, dict[str, Part]()
    z, n = ca.vertcat(C.x, model.p), C.n
    phi = None if model.phi is None else without_domain(model.phi, model.x, "phi")
    S = ca.gradient(phi, C.x) if phi is not None else ca.substitute(model.operator, model.sign_symbols, 0 * model.sign_symbols)
    for (own_low, own_high), local in ((C.hull, False), (grounds.box, True)):
        low, high = np.append(own_low, moving.lower), np.append(own_high, moving.upper)

        def put(id: str, how: str, value: dict[str, float], local: bool = local) -> None:
            found.setdefault(id, Part(HOLDS, f"{how}: {HOW}", value, {}, local))

        if interval.is_continuous(model.field, z, low, high):
            put("M-A1", "no operation of F jumps or has a pole", {"kinks": 0})
        if phi is not None and convexity.shapes(phi, z, low, high, of=C.x)[0].convex:
            put("M-T", "T = dphi, phi convex by the rules of convex functions", {LEAST: 0.0})
        if not interval.is_continuous(ca.vertcat(model.field, S), z, low, high):
            continue
        J, slope = ca.jacobian(model.field - S, C.x), ca.jacobian(S, C.x)
        if switching.monotone and "M-T" not in found:
            top = extremum.largest_eigenvalue(-(slope + slope.T) / 2, z, low, high, bound_to=0.0, quick=grounds.quick).bound
            if top <= 0:
                put("M-T", "the symmetric Jacobian of S is psd", {LEAST: max(-top, 0.0)})
        L = extremum.largest_eigenvalue((J + J.T) / 2, z, low, high, quick=grounds.quick).bound
        if switching.monotone and np.isfinite(L):
            put("M-24", "eigenvalues of the symmetric Jacobian", {"L": L + 0.0})
        steep = extremum.spectral_norm(J, z, low, high, quick=True).bound
        base = np.clip(np.zeros(n), own_low, own_high)
        ends = np.append(base, moving.lower), np.append(base, moving.upper)
        at = np.max(np.abs(interval.enclose(model.field - S, z, *ends)), axis=0)
        M = float(np.linalg.norm(at)) * UP + switching.size
        if local or not np.isfinite(M + L):
            continue
        if np.isfinite(steep):
            put("M-A2", "|F - S| <= |F - S|(c) + |(F - S)'| |x - c|", {"a_1": M + steep * _size(base), "a_2": steep})
        a = found["M-A2"].value if "M-A2" in found else None
        if a is None and grounds.reach:
            continue
        # <x, w> <= <x, v> + reach |v|, |v| <= a_1 + a_2 |x|
        p, q = (M + grounds.reach * a["a_2"], grounds.reach * a["a_1"]) if a is not None and grounds.reach else (M, 0.0)
        if L < 0 and not base.any():
            beta = (p**2 / (-2 * L) + q) * UP
            put("M-A3", "<x, F - S> <= L |x|^2 + |F - S|(0) |x|, L < 0", {"alpha": -L / 2, "beta": beta})
        elif C.bounded and a is not None:
            R = _size(np.maximum(np.abs(own_low), np.abs(own_high)))
            beta = ((R + grounds.reach) * (a["a_1"] + a["a_2"] * R) + R**2) * UP
            put("M-A3", f"C is bounded (|x| <= {R:.4g}): any alpha will do, here 1", {"alpha": 1.0, "beta": beta})
    return found


def _size(v: np.ndarray) -> float:
    return float(np.linalg.norm(v)) * UP
