"""Range conditions of a Lur'e system for all values of parameters in a box, of a law with numbers.

With D and the law as they are, the outputs D'k + y + S v of 5.4a and 5.x0 (see `range_condition`) are a convex set: where C x + e
lies in it at all corners of a multi-affine map, for one and the same x, it does for all values. Where D moves, one k and v are
kept, and C x + e - D'k - S v has to lie in rint dom Phi, which is convex, at all corners. v in ker S(p), S(p) = sum w_c S_c
psd, is in ker S_c for each corner c that has a weight: no line lies in V at any value where none does at a corner.

R(C) is that of c(p) C for c != 0; for a cone K, dom Xi and R(S) that of c(p) D are those of D for c > 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, Finding, make_finding
from nsmodel.hypotheses.region import Region, depends_on_symbol
from nsmodel.modeling.laws import Law
from nsmodel.modeling.laws.base import Halfspaces, Intervals, SecondOrder
from nsmodel.models.lure_system import domains
from nsmodel.models.lure_system.domains import TAU_COLUMN, Domains
from nsmodel.models.lure_system.model import LureSystem
from nsmodel.models.lure_system.range_condition import (
    H_5X0,
    H_54A,
    H_54B,
    H_54C,
    H_71,
    is_polyhedral_law,
    linearity_direction,
    range_parts,
)
from nsmodel.proof import conic, exact, interval_bounds
from nsmodel.proof.parameter_hull import matrix_corners, without_common_factor


class RangeCorners(NamedTuple):
    """The domains, and the matrices at corners in whose hull those of all values lie: outputs are C x0 + e (m, 1)."""

    own: Domains
    D: Sequence[np.ndarray]
    C: Sequence[np.ndarray]
    e: Sequence[np.ndarray]
    outputs: Sequence[np.ndarray]

    @property
    def is_D_constant(self) -> bool:
        """Whether D is the same at all corners."""
        return all((D == self.D[0]).all() for D in self.D)


def uniform_range_findings(model: LureSystem, region: Region) -> list[Finding]:
    """5.4a to 5.4c, the start, and 7.1, where they are proved for all values of the parameters."""
    at = read_range_corners(model, region)
    if at is None:
        return []
    value, count = {"restricting rows": float((~at.own.loose).sum())}, len(at.D)
    how = (
        f"exact at {count} corners, in whose hull the outputs lie: each is D'k + y + S v with k in rint dom Xi, y in rint dom Phi"
    )
    found = []
    if _states_of_one_point(at) is not None:
        found.append(make_finding(H_54A, HOLDS, f"{how}, for one state x", value))
    if _are_admissible(at, at.outputs):
        found.append(make_finding(H_5X0, HOLDS, how, value))
    if model.law is not None and (is_polyhedral_law(model.law) or not any(D.any() for D in at.D)):
        why = "D is psd for all values and the law polyhedral, or D = 0: dom dXi = K and R(D + dXi) are convex"
        found.append(make_finding(H_54B, HOLDS, why, {"multipliers": at.own.m}))
    why = "int dom Upsilon* is open and not empty for all values, and (24) places the set inside R(D + dXi)"
    found.append(make_finding(H_54C, HOLDS, why, {"dimension": at.own.m}))
    return [*found, *rest_point_for_all(model, region, _are_admissible(at, at.e))]


def rest_point_for_all(model: LureSystem, region: Region, origin: bool) -> list[Finding]:
    """7.1 for all values: 0 is in the set (``origin``), A(0) = 0, y = 0 and l = 0 are on the graph of K, and f = 0."""
    law, p, (low, high) = model.law, model.p, region.parameter_bounds()
    if not origin or law is None or not (model.f.is_zero() and model.e.is_zero()) or not is_drift_zero_for_all(model, region):
        return []
    ends = [stack for block in law.blocks if block.separable for stack in (block.lower, -block.upper)]
    if any(not block.separable and depends_on_symbol(block, p) for block in law.blocks) or not _admit_zero(law):
        return []
    inside = all(
        (entry.is_constant() and float(entry) <= 0) or float(interval_bounds.enclose(entry, p, low, high)[1].item()) <= 0
        for end in ends
        for entry in ca.vertsplit(end)
    )
    how = "for all values 0 is admissible, A(0) = 0 and 0 in K (exact, or by bounds), f = 0 and y has no offset"
    return [make_finding(H_71, HOLDS, how, {"|A(0)|": 0.0, "sup |f|": 0.0})] if inside else []


def is_drift_zero_for_all(model: LureSystem, region: Region) -> bool:
    """Whether A(0) is defined, and 0, for all values of the parameters; 0 times what may have no value is not."""
    z, nothing = ca.vertcat(model.x, model.p), np.zeros(len(model.names))
    ends = [np.append(nothing, end) for end in region.parameter_bounds()]
    rate = interval_bounds.enclose(model.A, z, *ends)
    return not any(end.any() for end in rate) and interval_bounds.is_continuous(model.A, z, *ends)


def _admit_zero(law: Law) -> bool:
    """Whether the blocks that are no intervals, and have numbers, have 0 in them."""
    shapes = [block.shape() for block in law.blocks if not block.separable]
    return all(shape is not None and not (isinstance(shape, Halfspaces) and max(shape.K, default=0) > 0) for shape in shapes)


def read_range_corners(model: LureSystem, region: Region) -> RangeCorners | None:
    """The corners, where D is psd at all of them, no line lies in V, and the law has numbers and an exact shape."""
    law, p, box = model.law, model.p, region.parameter_bounds()
    if law is None or depends_on_symbol(law, p) or ca.depends_on(model.e, ca.vertcat(model.t, model.u)):
        return None
    C, D = (ca.densify(matrix) for matrix in (model.C, model.D))
    outputs = C @ model.x0 + model.e
    C = _without_factor(C, p, *box)
    D = _without_factor(D, p, *box) if is_cone(law) else D
    at = matrix_corners([C, D, model.e, outputs], p, *box)
    if at is None or not all(exact.is_psd(D + D.T) for _, D, *_ in at):
        return None
    C_all, D_all, e, made = (list(parts) for parts in zip(*at, strict=True))
    try:
        own = domains.domains_of_law(law, sum((abs(D) for D in D_all), exact.zeros(*D_all[0].shape)))
    except domains.UndecidedDomain:
        return None
    found = RangeCorners(own, D_all, C_all, e, made)
    if own.loose.all():
        return found
    if found.is_D_constant:
        return found if linearity_direction(own, D_all[0]) is None else None
    across = own.stack_matrices(own.across)
    return found if not any(exact.nullspace(np.vstack([across, D + D.T])).shape[1] for D in D_all) else None


def is_cone(law: Law) -> bool:
    """Whether K is a cone."""
    shapes = [block.shape() for block in law.blocks]
    return all(
        isinstance(shape, SecondOrder)
        or (isinstance(shape, Intervals) and all(x in (0, -np.inf, np.inf) for end in shape for x in end))
        or (isinstance(shape, Halfspaces) and not np.any(shape.K))
        for shape in shapes
    )


def _without_factor(matrix: ca.SX, p: ca.SX, low: np.ndarray, high: np.ndarray) -> ca.SX:
    """The matrix without a factor > 0, where what is left are doubles; else as it is."""
    found = without_common_factor(matrix, p, low, high)
    if found is None or any(Fraction(float(entry)) != entry for entry in found[1].ravel()):
        return matrix
    return ca.SX(ca.DM(exact.doubles(found[1])))


def _mean(matrices: Sequence[np.ndarray]) -> np.ndarray:
    return sum(matrices[1:], matrices[0]) / Fraction(len(matrices))


def _states_of_one_point(at: RangeCorners) -> np.ndarray | None:
    """A state x (n, 1) with C x + e in the set for all values; None where none was found."""
    own = at.own
    n, states = len(own.kinds) + own.m, at.C[0].shape[1]
    for C, D, e in _candidates(at, lambda k: (at.C[k], at.D[k], at.e[k]), (_mean(at.C), _mean(at.D), _mean(at.e))):
        parts = [*range_parts(D, own), (list(range(n, n + states)), -C), (TAU_COLUMN, -e)]
        point = conic.decide_feasibility(own.system(parts, own.m + states)).point
        if point is not None:
            x = (point[n:] / point[0]).reshape(-1, 1)
            outputs = [exact.matrix_product(C, x) + e for C, e in zip(at.C, at.e, strict=True)]
            if _are_admissible(at, outputs):
                return x
    return None


def _candidates(
    at: RangeCorners, corner: Callable[[int], tuple[np.ndarray, ...]], mean: tuple[np.ndarray, ...]
) -> Iterator[tuple[np.ndarray, ...]]:
    """The mean of the corners, and each of them."""
    yield mean
    yield from (corner(k) for k in range(len(at.D)))


def _are_admissible(at: RangeCorners, outputs: Sequence[np.ndarray]) -> bool:
    """Whether outputs in the hull of these, one a corner, are in the set that belongs to the same values of the parameters."""
    own = at.own
    if own.loose.all():
        return True
    if at.is_D_constant:
        parts = range_parts(at.D[0], own)
        distinct = {tuple(q.ravel()): q for q in outputs}.values()
        systems = (own.system([*parts, (TAU_COLUMN, -q)], own.m) for q in distinct)
        return all(conic.decide_feasibility(system).point is not None for system in systems)
    return any(
        all(_is_in_y(own, q - kept(D)) for D, q in zip(at.D, outputs, strict=True))
        for D, q in _candidates(at, lambda k: (at.D[k], outputs[k]), (_mean(at.D), _mean(outputs)))
        if (kept := _kept_part(own, D, q)) is not None
    )


def _kept_part(own: Domains, D: np.ndarray, output: np.ndarray) -> Callable[[np.ndarray], np.ndarray] | None:
    """D -> D'k + S v with k and v of a point of the set that belongs to one D; None where the output is not in it."""
    n = len(own.kinds)
    point = conic.decide_feasibility(own.system([*range_parts(D, own), (TAU_COLUMN, -output)], own.m)).point
    if point is None:
        return None
    u = (point / point[0]).reshape(-1, 1)
    k = sum((exact.matrix_product(exact.rational(M), u[columns]) for columns, M in own.k), exact.zeros(own.m, 1))
    v = u[n:]
    return lambda other: exact.matrix_product(other.T, k) + exact.matrix_product(other + other.T, v)


def _is_in_y(own: Domains, y: np.ndarray) -> bool:
    """Whether y is in rint dom Phi, but for its loose rows."""
    return conic.decide_feasibility(own.system([*own.y, (TAU_COLUMN, -y)])).point is not None
