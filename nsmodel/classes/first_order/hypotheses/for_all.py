"""Hypotheses of a first-order system for all values of parameters in a box, where f, h and g are affine in x and l.

sym(M) > 0 and sym(M - h G) > 0, G = theta A + gamma K, keep M - s G regular for 0 <= s <= h: convex in (M, G), so that corners
of a multi-affine map decide. Then det W has the sign of det M, and W_mlcp is psd or a P-matrix as det(W) W_mlcp / det M is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from itertools import combinations
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.classes.first_order.hypotheses.check import (
    F_JACOBIANS,
    F_MLCP,
    F_STEP,
    F_UNIQUE,
    F_W,
    check,
    first_order_consequences,
)
from nsmodel.classes.first_order.hypotheses.linearised import step_lengths
from nsmodel.classes.first_order.model import FirstOrderSystem
from nsmodel.classes.lure.hypotheses import domains
from nsmodel.hypotheses.findings import HOLDS, Consequence, Finding, make_finding
from nsmodel.hypotheses.region import Region
from nsmodel.hypotheses.scope import IntervalBox, Scope, intersect_scopes
from nsmodel.hypotheses.uniform import ParameterValues, box_middle, depends_on_symbol, findings_for_box, sample_values
from nsmodel.proof import exact, extremum, interval_bounds
from nsmodel.proof.jumps import jump_nodes
from nsmodel.proof.parameter_hull import matrix_corners

FIELDS_OF_SYSTEM = ("M", "f", "h", "g", "law")
JACOBIAN_IDS = (F_JACOBIANS.id, F_W.id, F_MLCP.id, F_STEP.id)
MAX_CORNER_STEPS, MAX_MLCP_STATES, MAX_MLCP_ROWS = (
    5,
    6,
    6,
)  # Step lengths, states and multipliers up to which W_mlcp is written out.


class AffineSystem(NamedTuple):
    """The matrices of affine f, h, g as expressions of (p, h, theta, gamma), all exact, with the box of these.

    Attributes:
        M, G, B, C, D: G = theta A + gamma K.
        z, lower, upper: (p, h, theta, gamma) and its box but for h, whose place is ``at_h``.
    """

    M: ca.SX
    G: ca.SX
    B: ca.SX
    C: ca.SX
    D: ca.SX
    z: ca.SX
    lower: np.ndarray
    upper: np.ndarray

    @property
    def h(self) -> ca.SX:
        """The step length."""
        return self.z[-3]

    @property
    def gamma(self) -> ca.SX:
        """The weight of g."""
        return self.z[-1]

    def box(self, h: float) -> tuple[np.ndarray, np.ndarray]:
        """The box at one step length."""
        low, high = self.lower.copy(), self.upper.copy()
        low[-3] = high[-3] = h
        return low, high


def special_values(model: FirstOrderSystem, box: IntervalBox) -> list[ParameterValues]:
    """No values are special."""
    return []


def uniform_findings(model: FirstOrderSystem, region: Region, quick: bool) -> list[Finding]:
    """What is decided for all values of the parameters, whose boxes are those of ``region``."""
    if not any(depends_on_symbol(getattr(model, part), model.p) for part in FIELDS_OF_SYSTEM):
        return check(model.bind(sample_values(region.parameters)[0]), replace(region, parameters={}), (), quick)[0]
    steps, parts = step_lengths(model, ()), _affine_system(model, region)
    if parts is None or not 0 < steps.size <= MAX_CORNER_STEPS:
        return findings_for_box(_jacobian_findings(model, region, quick), [], region)
    timed = bool(ca.depends_on(ca.vertcat(model.f, model.h, model.g), model.t))
    scope = intersect_scopes(region.scope(timed=timed), Scope(parameters=region.parameters))
    count = {"step lengths": steps.size}
    own = [make_finding(F_JACOBIANS, HOLDS, "f, h and g are affine in x and l: one Newton iteration is exact.", count)]
    step = _step_limit_by_corners(parts, float(steps.max()))
    if step is not None:
        own += [step, make_finding(F_W, HOLDS, f"By F-step: {step.how}", count)]
        own += _mlcp_findings(model, parts, steps)
    return [replace(finding, scope=scope) for finding in own]


def uniform_consequences(model: FirstOrderSystem, region: Region, own: Sequence[Finding]) -> list[Consequence]:
    """What follows for all values of the parameters."""
    return first_order_consequences(model, _affine_system(model, region) is not None, own, ())


def _affine_system(model: FirstOrderSystem, region: Region) -> AffineSystem | None:
    """The matrices, where f, h and g are affine in x and l and finite for all times and values; None elsewhere."""
    inner, (low, high) = ca.vertcat(model.x, model.lam), region.parameter_bounds()
    stacked = ca.vertcat(model.f, model.h, model.g)
    A, C, D, K, B = (ca.densify(ca.jacobian(e, s)) for e, s in (
        (model.f, model.x), (model.h, model.x), (model.h, model.lam), (model.g, model.x), (model.g, model.lam),
    ))  # fmt: skip
    entries = ca.veccat(A, B, C, D, K)
    if jump_nodes(stacked, inner) or ca.depends_on(entries, ca.vertcat(model.t, inner)):
        return None
    offset, z = ca.substitute(stacked, inner, ca.DM.zeros(inner.numel())), ca.vertcat(model.t, model.p)
    ends = np.append(region.t0, low), np.append(region.t1, high)
    if not np.isfinite(interval_bounds.enclose(offset, z, *ends)).all():
        return None
    h, theta, gamma = (ca.SX.sym(name) for name in ("h", "theta", "gamma"))
    weights = [np.nan, model.theta, model.gamma]
    z = ca.vertcat(model.p, h, theta, gamma)
    M = ca.densify(model.M)
    return AffineSystem(M, theta * A + gamma * K, B, C, D, z, np.append(low, weights), np.append(high, weights))


def _jacobian_findings(model: FirstOrderSystem, region: Region, quick: bool) -> list[Finding]:
    """What asks for Jacobians alone, where parameters do not change these: they add terms free of x and l."""
    stacked, inner = ca.vertcat(model.f, model.h, model.g), ca.vertcat(model.x, model.lam)
    added, (low, high) = ca.jacobian(stacked, model.p), region.parameter_bounds()
    if (
        ca.depends_on(added, inner)
        or jump_nodes(stacked, model.p)
        or depends_on_symbol(model.M, model.p)
        or depends_on_symbol(model.law, model.p)
    ):
        return []
    ends = np.append(region.t0, low), np.append(region.t1, high)
    if not np.isfinite(interval_bounds.enclose(added, ca.vertcat(model.t, model.p), *ends)).all():
        return []
    found = check(model.bind(box_middle(region.parameters)), replace(region, parameters={}), (), quick)[0]
    return [finding for finding in found if finding.id in JACOBIAN_IDS and finding.verdict == HOLDS]


def _step_limit_by_corners(parts: AffineSystem, h: float) -> Finding | None:
    """F-step by sym(M - s G) > 0, or by a norm of M^-1 G where M is constant."""
    at = matrix_corners([parts.M, parts.G], parts.z, *parts.box(h))
    if at is None:
        return None
    if all(exact.definiteness(M - s * G).definite for M, G in at for s in (Fraction(0), Fraction(h))):
        how = (
            f"M and M - h (theta A + gamma K) have positive definite symmetric parts at {len(at)} corners of their hull (exact)."
        )
        return make_finding(F_STEP, HOLDS, how, {"h": h, "h* is at least": h})
    if ca.symvar(parts.M):
        return None
    solved = [exact.solve_linear_system(M, G) for M, G in at]
    if any(X is None for X in solved):
        return None
    norms = [min(_max_row_sum(X), _max_row_sum(X.T)) for X in solved if X is not None]
    if not Fraction(h) * max(norms) < 1:
        return None
    least = exact.round_down(1 / max(norms)) if max(norms) else np.inf
    size = exact.round_up(Fraction(h) * max(norms))
    how = f"h |M^-1 (theta A + gamma K)| <= {size:.3g} < 1 at {len(at)} corners of their hull (exact)."
    return make_finding(F_STEP, HOLDS, how, {"h": h, "h* is at least": least})


def _max_row_sum(X: np.ndarray) -> Fraction:
    return max((sum((abs(entry) for entry in row), Fraction(0)) for row in X), default=Fraction(0))


def _mlcp_findings(model: FirstOrderSystem, parts: AffineSystem, steps: np.ndarray) -> list[Finding]:
    """F-mlcp and F-unique from det(W) W_mlcp / det M at each step length."""
    n, m = len(model.names), model.law.size
    if not m:
        none = make_finding(F_MLCP, HOLDS, "There are no multipliers: no complementarity problem has to be solved.", {"rows": 0})
        return [none, make_finding(F_UNIQUE, HOLDS, "A linear system with a regular matrix.", {"solutions": 1})]
    if n > MAX_MLCP_STATES or m > MAX_MLCP_ROWS:
        return []
    W = parts.M - parts.h * parts.G
    adjugate = ca.SX(1) if n == 1 else ca.horzcat(*([ca.vertcat(*(_cofactor(W, i, j) for j in range(n))) for i in range(n)]))
    mlcp = ca.det(parts.M) * (ca.det(W) * parts.D + parts.h * parts.gamma * parts.C @ adjugate @ parts.B)
    each = [_matrix_kind(mlcp, parts, float(h)) for h in steps]
    if not all(each):
        return []
    kind = next((name for name in ("positive semidefinite", "a P-matrix", "positive definite") if name in each), "")
    solvable = make_finding(
        F_MLCP, HOLDS, f"W_mlcp is {kind} for all values (exact, or by bounds).", {"step lengths": steps.size}
    )
    boxes = model.law.is_box
    if "positive semidefinite" in each or ("a P-matrix" in each and not boxes) or depends_on_symbol(model.law, model.p):
        return [solvable]
    try:
        domains.domains_of_law(model.law, np.zeros((m, m)))
    except domains.EmptyDomain:
        return [solvable]
    why = (
        "W_mlcp is positive definite for all values"
        if boxes is False or kind != "a P-matrix"
        else "W_mlcp is a P-matrix, K a box"
    )
    return [solvable, make_finding(F_UNIQUE, HOLDS, f"{why}.", {"solutions": 1})]


def _cofactor(W: ca.SX, i: int, j: int) -> ca.SX:
    rest = [[k for k in range(W.shape[0]) if k != own] for own in (i, j)]
    return (-1) ** (i + j) * ca.det(W[rest[0], rest[1]])


def _matrix_kind(mlcp: ca.SX, parts: AffineSystem, h: float) -> str:
    """What the matrix is for all values; '' where it is not known."""
    low, high = parts.box(h)
    at = matrix_corners([mlcp], parts.z, low, high)
    if at is not None and all(exact.is_psd(S) for (S,) in at):
        return "positive definite" if all(exact.definiteness(S).definite for (S,) in at) else "positive semidefinite"
    if extremum.largest_eigenvalue(-(mlcp + mlcp.T), parts.z, low, high, bound_to=0.0).bound < 0:
        return "positive definite"
    rows = range(mlcp.shape[0])
    sets = [own for size in range(1, len(rows) + 1) for own in combinations(rows, size)]
    minors = (ca.det(mlcp[list(own), list(own)]) for own in sets)
    positive = all(extremum.supremum(-minor, parts.z, low, high, bound_to=0.0).bound < 0 for minor in minors)
    return "a P-matrix" if positive else ""
