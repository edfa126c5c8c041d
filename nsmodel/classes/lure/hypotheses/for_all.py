"""Hypotheses of a Lur'e system for all values of parameters in a box.

4.1, P B = C' and P J + J'P <= 2 omega P are convex in (D), (B, C), (P J, P): proved at the corners of a multi-affine map, they
hold for all values (quadratic stability of a polytope of systems). P is one for all values, or P(p) diagonal, an energy.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.classes.lure.hypotheses import domains
from nsmodel.classes.lure.hypotheses.check import check, consequences_of
from nsmodel.classes.lure.hypotheses.dissipation import least_rate
from nsmodel.classes.lure.hypotheses.hypomonotone import HYPOMONOTONE, NAME, Growth, is_continuous
from nsmodel.classes.lure.hypotheses.interior import interior
from nsmodel.classes.lure.hypotheses.jacobian_hull import Hull, bounded_hull
from nsmodel.classes.lure.hypotheses.large import is_large
from nsmodel.classes.lure.hypotheses.pairing import Pairing, condition, pairing_of, shown, well_conditioned
from nsmodel.classes.lure.hypotheses.passivity import D_PSD, STORAGE, broken
from nsmodel.classes.lure.hypotheses.range_condition import H_5X0, H_31, H_54A, H_54B, H_54C
from nsmodel.classes.lure.model import LureSystem
from nsmodel.hypotheses.findings import HOLDS, Consequence, Finding, found
from nsmodel.hypotheses.region import Region
from nsmodel.hypotheses.scope import Box
from nsmodel.hypotheses.uniform import Values, for_the_box, middle_of, reads, roots, untouched
from nsmodel.proof import exact, extremum, polynomial
from nsmodel.proof.jumps import jumps_in
from nsmodel.proof.multiaffine import corners

LAW = ("law", "phi")
READS = {
    "3.1": LAW, "4.1": ("D",), "5.1": ("B", "C"), "5.2": ("A", "B", "C"), "5.4a": ("C", "D", "e", *LAW), "5.4b": ("D", *LAW),
    "5.4c": ("D", *LAW), "5.x0": ("C", "D", "e", "x0", *LAW), "7.1": ("D", "e", "f", *LAW),
}  # fmt: skip
MOST_COLUMNS = 64  # Of all corners of B together.
MINORS, DIGITS = 6, 12


class Energy(NamedTuple):
    """P with P B = C' for all values: one matrix with its pairing, or P(p) = diag(d(p)); None where it is not known."""

    pairing: Pairing | None = None
    diagonal: ca.SX | None = None


def values(model: LureSystem, box: Box) -> list[Values]:
    """Values of a single parameter at which a leading minor of C B or of D + D' vanishes: there ranks change."""
    minors = (
        ca.det(ca.densify(matrix[:size, :size]))
        for matrix in (ca.mtimes(model.C, model.B), model.D + model.D.T)
        for size in range(1, min(matrix.shape[0], MINORS) + 1)
    )
    return roots(minors, model, box)


def findings(model: LureSystem, region: Region, quick: bool) -> list[Finding]:
    """What is decided for all values of the parameters, whose boxes are those of ``region``."""
    drifts = reads(ca.substitute(model.A, model.x, ca.DM.zeros(len(model.names))), model.p)  # A(0) = 0 is a part of 7.1.
    same = [finding for finding in untouched(check, model, region, quick, READS) if not (drifts and finding.id == "7.1")]
    energy, stored = (Energy(), None) if is_large(model) else _storage(model, region)
    least = _least_width(model, region, quick)
    own = [_interior(model, region, least), _input_output(model, region), stored, _growth(model, region, energy, quick)]
    own += _ranges(model, region, least)
    return for_the_box(own, same, region)


def consequences(model: LureSystem, region: Region, own: Sequence[Finding]) -> list[Consequence]:
    """What follows for all values of the parameters."""
    rate = next(finding for finding in own if finding.id == HYPOMONOTONE.id)
    known = rate.verdict == HOLDS
    P = exact.rational(np.array(rate.witness[NAME])) if known and NAME in rate.witness else None
    everywhere = rate.scope is None or not rate.scope.states
    return consequences_of(model, region, Growth(rate, P, rate.value["omega"] if known else np.inf, everywhere), own)


def _corners(matrices: Sequence[ca.SX], model: LureSystem, region: Region) -> list[list[np.ndarray]] | None:
    return corners(matrices, model.p, *region.of_parameters())


def _least_width(model: LureSystem, region: Region, quick: bool) -> float:
    """A lower bound of the widths of what of K depends on the parameters, for all values; inf where nothing does."""
    ends, box = () if model.law is None else model.law.ends(model.multiplier_names, model.p), region.of_parameters()
    gaps = (end.lower - end.upper for end in ends if not end.endless)
    return min((-extremum.supremum(gap, model.p, *box, quick=quick, bound_to=0.0).bound for gap in gaps), default=np.inf)


def _interior(model: LureSystem, region: Region, least: float) -> Finding | None:
    """3.1 where K depends on the parameters: no width, of which ``least`` is a bound, is 0."""
    if model.law is None or not reads(model.law, model.p) or not least > 0:
        return None
    still = interior(H_31, model.bind(middle_of(region.parameters)), None, "")
    if still.verdict != HOLDS:
        return None
    width = min(least, still.value.get("width", np.inf))
    return found(H_31, HOLDS, "K has an interior for all values: bounds of its widths", {"width": width})


def _input_output(model: LureSystem, region: Region) -> Finding | None:
    """4.1: D(p) + D(p)' is psd at all corners, or by bounds of its eigenvalues."""
    at = _corners([model.D + model.D.T], model, region)
    if at is not None and all(exact.is_psd(S) for (S,) in at):
        least = min(-exact.eigenvalue_above(-S) / 2 for (S,) in at)
        return found(D_PSD, HOLDS, f"exact at {len(at)} corners, in whose hull D lies", {"least eigenvalue": max(least, 0.0)})
    top = extremum.largest_eigenvalue(-(model.D + model.D.T) / 2, model.p, *region.of_parameters(), bound_to=0.0)
    if top.bound <= 0:
        return found(D_PSD, HOLDS, "a bound of the eigenvalues of D + D' over the box", {"least eigenvalue": -top.bound})
    return None


def _storage(model: LureSystem, region: Region) -> tuple[Energy, Finding | None]:
    """5.1: one P for all corners of (B, C), P(p) diagonal, or C B symmetric and definite at all corners."""
    at = _corners([model.B, model.C], model, region)
    if at is not None and len(at) * model.B.shape[1] <= MOST_COLUMNS:
        B, C = np.hstack([B for B, _ in at]), np.vstack([C for _, C in at])
        if not broken(B, C, np.ones((len(C), B.shape[1]))):
            columns = exact.independent_columns(B) if B.shape[1] else []
            pairing = pairing_of(B[:, columns], C[columns])
            witness = shown("P", pairing.storage(well_conditioned(pairing)))
            how = f"exact: one P with P B = C' at {len(at)} corners, in whose hull (B, C) lies; cond P in floating point"
            return Energy(pairing=pairing), found(STORAGE, HOLDS, how, {"cond P": condition(witness["P"])}, witness)
    d = None if at is None else _diagonal(model, region)
    if d is not None:
        entries = [f"{entry}" for entry in ca.vertsplit(d)]
        how = f"exact: P = diag({', '.join(entries)}) > 0 has P B = C' for all values"
        return Energy(diagonal=d), found(STORAGE, HOLDS, how, {"states": model.x.numel()})
    pairs = _corners([ca.mtimes(model.C, model.B)], model, region)
    if pairs is not None and all(exact.is_symmetric(G) and exact.psd(G).definite for (G,) in pairs):
        how = f"exact at {len(pairs)} corners, in whose hull C B lies: C B is symmetric and definite, so that B has full rank"
        return Energy(), found(STORAGE, HOLDS, how, {"corners": len(pairs)})
    return Energy(), None


def _diagonal(model: LureSystem, region: Region) -> ca.SX | None:
    """d(p) > 0 with diag(d) B = C' for all values; what B leaves free cancels A_ik against A_ki, as energies do."""
    A, B, C = ca.densify(ca.jacobian(model.A, model.x)), ca.densify(model.B), ca.densify(model.C)
    n, d = len(model.names), {}
    for i in range(n):
        j = next((j for j in range(B.shape[1]) if not B[i, j].is_zero()), None)
        if j is not None:
            d[i] = C[j, i] / B[i, j]
    while len(d) < n:
        step = next(((i, k) for i in d for k in range(n) if k not in d and not (A[i, k].is_zero() or A[k, i].is_zero())), None)
        if step is None:
            d[next(k for k in range(n) if k not in d)] = ca.SX(1)
        else:
            i, k = step
            d[k] = -d[i] * A[i, k] / A[k, i]
    rows = ca.vertcat(*(d[i] for i in range(n)))
    off = ca.vertsplit(ca.vec(ca.diag(rows) @ B - C.T)) if B.shape[1] else []
    ratios = [polynomial.ratio(entry, model.p) for entry in off]
    if ca.depends_on(rows, model.x) or any(ratio is None or ratio[0] for ratio in ratios):
        return None
    at = _corners([rows], model, region)
    return rows if at is not None and all(entry > 0 for (column,) in at for entry in column.ravel()) else None


def _growth(model: LureSystem, region: Region, energy: Energy, quick: bool) -> Finding | None:
    """5.2 with the P of 5.1, for the hull of the Jacobians of A over the box of the parameters, and of states where needed."""
    J, x, low, high = ca.densify(ca.jacobian(model.A, model.x)), model.x, *region.of_parameters()
    if energy.diagonal is not None and not ca.depends_on(J, x):
        return _of_diagonal(model, region, J, energy.diagonal)
    if energy.pairing is None:
        return None
    if not ca.depends_on(J, x):
        at = None if jumps_in(model.A, x) else _corners([J], model, region)
        hull, local = (None if at is None else Hull([M for (M,) in at], [], True)), False
    else:
        z, infinite = ca.vertcat(x, model.p), np.full(x.numel(), np.inf)
        ends = [(infinite * -1, infinite, False), (region.lower, region.upper, True)]
        boxes = [(np.append(a, low), np.append(b, high), local) for a, b, local in ends]
        hulls = [(bounded_hull(J, z, a, b), local) for a, b, local in boxes if is_continuous(model.A, z, a, b)]
        hull, local = next(((hull, local) for hull, local in hulls if hull is not None and not hull.cones), (None, False))
    rate = None if hull is None else least_rate(energy.pairing, hull.vertices, quick=quick)
    if rate is None:
        return None
    witness = shown(NAME, energy.pairing.storage(rate.Y))
    how = (
        f"exact at {len(hull.vertices) if hull else 0} corners, in whose hull A' lies, for one {NAME}; its cond in floating point"
    )
    value = {"omega": rate.omega, "cond P": condition(witness[NAME])}
    return found(HYPOMONOTONE, HOLDS, how, value, witness, region.scope(True) if local else None)


def _of_diagonal(model: LureSystem, region: Region, J: ca.SX, d: ca.SX) -> Finding | None:
    """omega with 2 omega P - P J - J'P psd at all corners, P = diag(d)."""
    P = ca.diag(d)
    at = _corners([P @ J + J.T @ P, P], model, region)
    if at is None or jumps_in(model.A, model.x):
        return None
    near = 0.0
    for S, own in at:
        root = 1 / np.sqrt(exact.doubles(np.diagonal(own)))
        near = max(near, float(np.linalg.eigvalsh(exact.doubles(S) * root[:, None] * root).max(initial=0.0)) / 2)
    for omega in (0.0, near, *(near * (1 + 4.0**k * 1e-15) for k in range(DIGITS))):
        if omega >= near * (1 - 1e-9) and all(exact.is_psd(2 * Fraction(omega) * own - S) for S, own in at):
            how = f"exact at {len(at)} corners, in whose hull (P A, P) lies, for the P of 5.1"
            return found(HYPOMONOTONE, HOLDS, how, {"omega": omega})
    return None


def _ranges(model: LureSystem, region: Region, least: float) -> list[Finding]:
    """5.4 and the start, where D + D' is definite for all values, or K bounded and D psd: the set is the whole space.

    ``least``: the least width of what of K depends on the parameters.
    """
    at, law = _corners([model.D + model.D.T], model, region), model.law
    if at is None or law is None or not all(exact.is_psd(S) for (S,) in at):
        return []
    definite = all(exact.psd(S).definite for (S,) in at)
    bounded = least >= 0 and bool(domains.of_law(law.at_rest(model.p), np.zeros(model.D.shape)).loose.all())
    if not definite and not bounded:
        return []
    how = ("D + D' is definite for all values (exact)" if definite else "K is bounded") + ", so that the set is the whole space"
    return [found(hypothesis, HOLDS, how, {"multipliers": law.size}) for hypothesis in (H_54A, H_54B, H_54C, H_5X0)]
