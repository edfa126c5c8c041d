"""Lur'e systems with inputs, which stand in f, in the offset e of y or in the ends of the law; none but 7.1 asks for f.

x' + A(x) ∋ f(t) with A + omega maximal monotone has a solution for each integrable f, which in finite dimension is absolutely
continuous; two solutions of one f part as those without f do. Of an e that moves the theorems say nothing.

Where K(t) moves and stays bounded, B (D + N_K(t)^-1)^-1 is at each time maximal monotone (in the units of 5.1), defined
everywhere and bounded: a solution exists for ends that are measurable in t (Filippov 1988, Section 7), and two part as those
of one K do. An end of an interval [a(t), inf) adds B a to f and D a to e.

Hypotheses of a Lur'e system for all values of parameters in a box.

4.1, P B = C' and P J + J'P <= 2 omega P are convex in (D), (B, C), (P J, P): proved at the corners of a multi-affine map, they
hold for all values (quadratic stability of a polytope of systems). P is one for all values, or P(p) diagonal, an energy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, Consequence, Finding, IntervalBox, make_finding
from nsmodel.hypotheses.inputs import InputBounds, unknown_consequence
from nsmodel.hypotheses.moving_law import law_time_as_input
from nsmodel.hypotheses.region import (
    ParameterValues,
    Region,
    box_middle,
    depends_on_symbol,
    findings_for_box,
    parameter_roots,
    unaffected_findings,
)
from nsmodel.hypotheses.staying import StayTime, multiplier_hull, stay_by_rates, stay_in_ball
from nsmodel.models.lure_system import domains
from nsmodel.models.lure_system.check import check, lure_consequences
from nsmodel.models.lure_system.domains import interior_finding
from nsmodel.models.lure_system.hypomonotone import (
    HYPOMONOTONE,
    P_OMEGA,
    HypomonotoneBound,
    JacobianHull,
    bounded_hull,
    is_drift_affine,
    is_drift_continuous,
)
from nsmodel.models.lure_system.large_systems import is_large
from nsmodel.models.lure_system.model import LureSystem
from nsmodel.models.lure_system.passivity import D_PSD_HYPOTHESIS, LURE_PAPER, STORAGE_HYPOTHESIS
from nsmodel.models.lure_system.range_condition import H_5X0, H_31, H_54A, H_54B, H_54C, MOVING_OFFSET_NOTE
from nsmodel.models.lure_system.uniform_ranges import is_drift_zero_for_all, rest_point_for_all, uniform_range_findings
from nsmodel.proof import exact, extremum, interval_bounds, polynomial
from nsmodel.proof.dissipation import least_rate
from nsmodel.proof.expression_graph import stack_column
from nsmodel.proof.parameter_hull import matrix_corners, without_common_factor
from nsmodel.proof.storage_matrix import (
    Pairing,
    broken_conditions,
    condition_number,
    make_pairing,
    matrix_witness,
    well_conditioned_block,
)
from nsmodel.simulation.trajectory import Trajectory

LAW_FIELDS = ("law", "phi")
HYPOTHESIS_FIELDS = {
    "3.1": LAW_FIELDS, "4.1": ("D",), "5.1": ("B", "C"), "5.2": ("A", "B", "C"), "5.4a": ("C", "D", "e", *LAW_FIELDS),
    "5.4b": ("D", *LAW_FIELDS), "5.4c": ("D", *LAW_FIELDS), "5.x0": ("C", "D", "e", "x0", *LAW_FIELDS),
    "7.1": ("D", "e", "f", *LAW_FIELDS),
}  # fmt: skip
MAX_CORNER_COLUMNS = 64  # Columns of B at all corners together, for which one P is looked for; of more it is left open.
MAX_MINOR_SIZE = 6  # Rows of a leading minor that is written out for its roots: one of n rows has up to n! terms.
OMEGA_TRIES = 12  # Values of omega above the one in doubles, by 4^k 1e-15 of it, that are tried exactly: up to 4e-9 of it.


class EnergyMatrix(NamedTuple):
    """P with P B = C' for all values: one matrix with its pairing, or P(p) = diag(d(p)); None where it is not known."""

    pairing: Pairing | None = None
    diagonal: ca.SX | None = None


def special_values(model: LureSystem, box: IntervalBox) -> list[ParameterValues]:
    """Values of a single parameter at which a leading minor of C B or of D + D' vanishes: there ranks change."""
    minors = (
        ca.det(ca.densify(matrix[:size, :size]))
        for matrix in (ca.mtimes(model.C, model.B), model.D + model.D.T)
        for size in range(1, min(matrix.shape[0], MAX_MINOR_SIZE) + 1)
    )
    return parameter_roots(minors, model, box)


def uniform_findings(model: LureSystem, region: Region, quick: bool) -> list[Finding]:
    """What is decided for all values of the parameters, whose boxes are those of ``region``."""
    drifts = depends_on_symbol(model.A, model.p) and not is_drift_zero_for_all(model, region)  # A(0) = 0 is a part of 7.1.
    same = [
        finding
        for finding in unaffected_findings(check, model, region, quick, HYPOTHESIS_FIELDS)
        if not (drifts and finding.id == "7.1")
    ]
    energy, stored = (EnergyMatrix(), None) if is_large(model) else _storage_for_all(model, region)
    least = _law_width_bound(model, region, quick)
    own = [
        _interior_for_all(model, region, least),
        _input_output_for_all(model, region),
        stored,
        _growth_for_all(model, region, energy, quick),
    ]
    whole = _ranges_for_all(model, region, least)
    if whole:
        own += [*whole, *rest_point_for_all(model, region, True)]
    elif not is_large(model):
        own += uniform_range_findings(model, region)
    return findings_for_box(own, same, region)


def uniform_consequences(model: LureSystem, region: Region, own: Sequence[Finding]) -> list[Consequence]:
    """What follows for all values of the parameters."""
    rate = next(finding for finding in own if finding.id == HYPOMONOTONE.id)
    known = rate.verdict == HOLDS
    P = exact.rational(np.array(rate.witness[P_OMEGA])) if known and P_OMEGA in rate.witness else None
    everywhere = rate.scope is None or not rate.scope.states
    return lure_consequences(model, region, HypomonotoneBound(rate, P, rate.value["omega"] if known else np.inf, everywhere), own)


def _corner_matrices(matrices: Sequence[ca.SX], model: LureSystem, region: Region) -> list[list[np.ndarray]] | None:
    return matrix_corners(matrices, model.p, *region.parameter_bounds())


def _law_width_bound(model: LureSystem, region: Region, quick: bool) -> float:
    """A lower bound of the widths of what of K depends on the parameters, for all values; inf where nothing does."""
    ends, box = () if model.law is None else model.law.ends(model.multiplier_names, model.p), region.parameter_bounds()
    gaps = (end.lower - end.upper for end in ends if not end.has_infinite_end)
    return min((-extremum.supremum(gap, model.p, *box, quick=quick, bound_to=0.0).bound for gap in gaps), default=np.inf)


def _interior_for_all(model: LureSystem, region: Region, least: float) -> Finding | None:
    """3.1 where K depends on the parameters: no width, of which ``least`` is a bound, is 0."""
    if model.law is None or not depends_on_symbol(model.law, model.p) or not least > 0:
        return None
    still = interior_finding(H_31, model.bind(box_middle(region.parameters)), None, "")
    if still.verdict != HOLDS:
        return None
    width = min(least, still.value.get("width", np.inf))
    return make_finding(H_31, HOLDS, "K has an interior for all values: bounds of its widths", {"width": width})


def _input_output_for_all(model: LureSystem, region: Region) -> Finding | None:
    """4.1: D(p) + D(p)' is psd at all corners, or by bounds of its eigenvalues."""
    at = _corner_matrices([model.D + model.D.T], model, region)
    if at is not None and all(exact.is_psd(S) for (S,) in at):
        least = min(-exact.eigenvalue_upper_bound(-S) / 2 for (S,) in at)
        return make_finding(
            D_PSD_HYPOTHESIS, HOLDS, f"exact at {len(at)} corners, in whose hull D lies", {"least eigenvalue": max(least, 0.0)}
        )
    top = extremum.largest_eigenvalue(-(model.D + model.D.T) / 2, model.p, *region.parameter_bounds(), bound_to=0.0)
    if top.bound <= 0:
        return make_finding(
            D_PSD_HYPOTHESIS, HOLDS, "a bound of the eigenvalues of D + D' over the box", {"least eigenvalue": -top.bound}
        )
    return None


def _storage_for_all(model: LureSystem, region: Region) -> tuple[EnergyMatrix, Finding | None]:
    """5.1: one P for all corners of (B, C), P(p) diagonal, P up to a factor, or C B symmetric and definite at all corners.

    Of factors b(p), c(p) > 0 of B and C, (c/b) P is the matrix for B and C where P is that of the rest, and 5.2 is the same
    for both.
    """
    at = _corner_matrices([model.B, model.C], model, region)
    pairing = _pairing_of(at)
    if pairing is not None and at is not None:
        witness = matrix_witness("P", pairing.storage_matrix(well_conditioned_block(pairing)))
        how = f"exact: one P with P B = C' at {len(at)} corners, in whose hull (B, C) lies; cond P in floating point"
        return EnergyMatrix(pairing=pairing), make_finding(
            STORAGE_HYPOTHESIS, HOLDS, how, {"cond P": condition_number(witness["P"])}, witness
        )
    d = None if at is None else _diagonal_energy(model, region)
    if d is not None:
        entries = [f"{entry}" for entry in ca.vertsplit(d)]
        how = f"exact: P = diag({', '.join(entries)}) > 0 has P B = C' for all values"
        return EnergyMatrix(diagonal=d), make_finding(STORAGE_HYPOTHESIS, HOLDS, how, {"states": model.x.numel()})
    numbers = [own for matrix in (model.B, model.C) if (own := _numbers_up_to_factor(matrix, region, model.p)) is not None]
    pairing = _pairing_of([numbers]) if len(numbers) == 2 else None
    if pairing is not None:
        how = "exact: B and C are numbers up to factors > 0, with which P B = C'; cond P in floating point"
        value = {"cond P": condition_number(matrix_witness("P", pairing.storage_matrix(well_conditioned_block(pairing)))["P"])}
        return EnergyMatrix(pairing=pairing), make_finding(STORAGE_HYPOTHESIS, HOLDS, how, value)
    pairs = _corner_matrices([ca.mtimes(model.C, model.B)], model, region)
    if pairs is not None and all(exact.is_symmetric(G) and exact.definiteness(G).definite for (G,) in pairs):
        how = f"exact at {len(pairs)} corners, in whose hull C B lies: C B is symmetric and definite, so that B has full rank"
        return EnergyMatrix(), make_finding(STORAGE_HYPOTHESIS, HOLDS, how, {"corners": len(pairs)})
    return EnergyMatrix(), None


def _pairing_of(corners: Sequence[Sequence[np.ndarray]] | None) -> Pairing | None:
    """What one P with P B = C' at all corners (B, C) is made of; None where there is none, or there are too many."""
    if corners is None or len(corners) * corners[0][0].shape[1] > MAX_CORNER_COLUMNS:
        return None
    B, C = np.hstack([B for B, _ in corners]), np.vstack([C for _, C in corners])
    if broken_conditions(B, C, np.ones((len(C), B.shape[1]))):
        return None
    columns = exact.independent_columns(B) if B.shape[1] else []
    return make_pairing(B[:, columns], C[columns])


def _numbers_up_to_factor(matrix: ca.SX, region: Region, p: ca.SX) -> np.ndarray | None:
    """M where the matrix is c(p) M, c > 0."""
    if not ca.depends_on(matrix, p):
        return exact.rational(np.array(ca.DM(matrix)).reshape(matrix.shape))
    found = without_common_factor(matrix, p, *region.parameter_bounds())
    return None if found is None else found[1]


def _diagonal_energy(model: LureSystem, region: Region) -> ca.SX | None:
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
    ratios = [polynomial.read_quotient(entry, model.p) for entry in off]
    if ca.depends_on(rows, model.x) or any(ratio is None or ratio[0] for ratio in ratios) or not _are_numbers_paired(rows, B, C):
        return None
    if off and not np.isfinite(interval_bounds.enclose(stack_column(off), model.p, *region.parameter_bounds())).all():
        return None  # 0 but where a part of it has no value
    at = _corner_matrices([rows], model, region)
    return rows if at is not None and all(entry > 0 for (column,) in at for entry in column.ravel()) else None


def _are_numbers_paired(d: ca.SX, B: ca.SX, C: ca.SX) -> bool:
    """Whether diag(d) B = C' in fractions where all three are numbers, of which CasADi rounds products and quotients."""
    triples = ((d[i], B[i, j], C[j, i]) for i in range(B.shape[0]) for j in range(B.shape[1]))
    numbers = ([Fraction(float(part)) for part in own] for own in triples if all(part.is_constant() for part in own))
    return all(p * b == c for p, b, c in numbers)


def _growth_for_all(model: LureSystem, region: Region, energy: EnergyMatrix, quick: bool) -> Finding | None:
    """5.2 with the P of 5.1, for the hull of the Jacobians of A over the box of the parameters, and of states where needed."""
    J, x, low, high = ca.densify(ca.jacobian(model.A, model.x)), model.x, *region.parameter_bounds()
    if energy.diagonal is not None and not ca.depends_on(J, x):
        return _diagonal_growth(model, region, J, energy.diagonal)
    if energy.pairing is None:
        return None
    if not ca.depends_on(J, x):
        at = _corner_matrices([J], model, region) if is_drift_affine(model.A, x) else None
        hull, local = (None if at is None else JacobianHull([M for (M,) in at], [], True)), False
    else:
        z, infinite = ca.vertcat(x, model.p), np.full(x.numel(), np.inf)
        ends = [(infinite * -1, infinite, False), (region.lower, region.upper, True)]
        boxes = [(np.append(a, low), np.append(b, high), local) for a, b, local in ends]
        hulls = [(bounded_hull(J, z, a, b), local) for a, b, local in boxes if is_drift_continuous(model.A, z, a, b)]
        hull, local = next(((hull, local) for hull, local in hulls if hull is not None and not hull.cones), (None, False))
    rate = None if hull is None else least_rate(energy.pairing, hull.vertices, quick=quick)
    if rate is None:
        return None
    witness = matrix_witness(P_OMEGA, energy.pairing.storage_matrix(rate.Y))
    how = (
        f"exact at {len(hull.vertices) if hull else 0} corners, in whose hull A' lies, for one {P_OMEGA}; "
        "its cond in floating point"
    )
    value = {"omega": rate.omega, "cond P": condition_number(witness[P_OMEGA])}
    return make_finding(HYPOMONOTONE, HOLDS, how, value, witness, region.scope(True) if local else None)


def _diagonal_growth(model: LureSystem, region: Region, J: ca.SX, d: ca.SX) -> Finding | None:
    """omega with 2 omega P - P J - J'P psd at all corners, P = diag(d)."""
    P = ca.diag(d)
    at = _corner_matrices([P @ J + J.T @ P, P], model, region)
    if at is None or not is_drift_affine(model.A, model.x):
        return None
    near = 0.0
    for S, own in at:
        root = 1 / np.sqrt(exact.doubles(np.diagonal(own)))
        near = max(near, float(np.linalg.eigvalsh(exact.doubles(S) * root[:, None] * root).max(initial=0.0)) / 2)
    for omega in (0.0, near, *(near * (1 + 4.0**k * 1e-15) for k in range(OMEGA_TRIES))):
        if omega >= near * (1 - 1e-9) and all(exact.is_psd(2 * Fraction(omega) * own - S) for S, own in at):
            how = f"exact at {len(at)} corners, in whose hull (P A, P) lies, for the P of 5.1"
            return make_finding(HYPOMONOTONE, HOLDS, how, {"omega": omega})
    return None


def _ranges_for_all(model: LureSystem, region: Region, least: float) -> list[Finding]:
    """5.4 and the start, where D + D' is definite for all values, or K bounded and D psd: the set is the whole space.

    ``least``: the least width of what of K depends on the parameters.
    """
    at, law = _corner_matrices([model.D + model.D.T], model, region), model.law
    if at is None or law is None or not all(exact.is_psd(S) for (S,) in at):
        return []
    definite = all(exact.definiteness(S).definite for (S,) in at)
    bounded = least >= 0 and bool(domains.domains_of_law(law.at_rest(model.p), np.zeros(model.D.shape)).loose.all())
    if not definite and not bounded:
        return []
    how = ("D + D' is definite for all values (exact)" if definite else "K is bounded") + ", so that the set is the whole space"
    return [make_finding(hypothesis, HOLDS, how, {"multipliers": law.size}) for hypothesis in (H_54A, H_54B, H_54C, H_5X0)]


DRIVEN_FIELDS = {"f": ("f",), "e": ("e",), "law": ("law",)}
INTEGRABLE_SOURCE = f"{LURE_PAPER}, Corollary 5.7; for integrable f Brezis 1973, Chapter III"
BOUNDED_SOURCE = f"{LURE_PAPER}, Section 5, at each time; for K(t) bounded and measurable Filippov 1988, Section 7"
STABILITY_NAMES = ("Lyapunov stable", "globally asymptotically stable")
SIGNAL_PHRASES = {
    "one and only one solution starts": "for each signal one and only one absolutely continuous solution starts",
    "any two solutions": "any two solutions of one signal",
}


def driven_consequences(
    model: LureSystem, region: Region, motion: InputBounds, own: Sequence[Finding], runs: Sequence[Trajectory]
) -> list[Consequence]:  # fmt: skip
    """What follows for each signal; nothing is at rest that a signal drives."""
    made = [item for item in uniform_consequences(model, region, own) if item.name not in STABILITY_NAMES]
    for few, whole in SIGNAL_PHRASES.items():
        made = [replace(item, statement=item.statement.replace(few, whole)) for item in made]
    made = [replace(item, source=INTEGRABLE_SOURCE) if item.name == "well posed" else item for item in made]
    if motion.indices_read_by(model.e) or _has_moving_half_line(model, motion):
        return [unknown_consequence(item, MOVING_OFFSET_NOTE) for item in made]
    if motion.indices_read_by(model.law):
        made = [replace(item, source=BOUNDED_SOURCE) if item.name == "well posed" else item for item in made]
    low, high = region.parameter_bounds()
    last = max(region.t1, float(model.t_end or 0.0))
    bounded = interval_bounds.enclose(model.f, ca.vertcat(model.t, model.p), np.append(region.t0, low), np.append(last, high))
    return made if np.isfinite(bounded).all() else [unknown_consequence(item, "f is not seen to be bounded") for item in made]


def freeze_law(model: LureSystem) -> LureSystem:
    """The system with time in its law as an input: at each time K has numbers."""
    return law_time_as_input(model)


def _has_moving_half_line(model: LureSystem, motion: InputBounds) -> bool:
    """Whether the finite end of an interval without end moves, and D hands it on to y."""
    if model.law is None:
        return False
    moves = model.law.moves(motion.u)
    ends = zip(ca.vertsplit(model.law.lower), ca.vertsplit(model.law.upper), strict=True)
    endless = [any(side.is_constant() and not np.isfinite(float(side)) for side in pair) for pair in ends]
    boxes = [block.separable for block in model.law.blocks for _ in range(block.size)]
    rows = [i for i, both in enumerate(zip(moves, endless, boxes, strict=True)) if all(both)]
    return any(not model.D[:, i].is_zero() for i in rows)


# Relative: far more than a norm loses where P in doubles is well conditioned; what else it loses is in `unit_ball_box`.
STAY_ROUNDING = 1e-9


def stay_times(
    model: LureSystem, region: Region, findings: Sequence[Finding], start: tuple[np.ndarray, np.ndarray]
) -> list[StayTime]:  # fmt: skip
    """By the rates of x' = A + f + B l, l anywhere in K, and by (40) in the norm of P_omega from 0 and from x0.

    With l_z at z on the graph of the law, |x - z|_P' <= omega |x - z|_P + |A(z) + f + B l_z|_P by 4.1, 5.1 and 5.2.
    """
    law, (low, high) = model.law, region.parameter_bounds()
    hull = None if law is None else multiplier_hull(law, model.p, low, high)
    if hull is None or ca.depends_on(model.e, model.t):
        return []
    l, timed = ca.SX.sym("l", model.B.shape[1]), bool(ca.depends_on(model.f, model.t))
    others = ca.vertcat(model.t, l, model.p)
    ends = np.concatenate([[region.t0], hull[0], low]), np.concatenate([[region.t1], hull[1], high])
    found = [
        StayTime(
            stay_by_rates(model.A + model.f + model.B @ l, model.x, others, ends, region, start),
            "by bounds of x' between nested boxes",
        )
    ]
    found += _stay_in_norm(model, region, findings, start, hull)
    return [item._replace(until=min(item.until, region.t1)) for item in found] if timed else found


def _stay_in_norm(
    model: LureSystem, region: Region, findings: Sequence[Finding], start: tuple[np.ndarray, np.ndarray],
    hull: tuple[np.ndarray, np.ndarray],
) -> list[StayTime]:  # fmt: skip
    """The ball about 0, where 0 is in K and e is 0, and about x0, where l = 0 belongs to y there: each l is 0 at z."""
    number = {finding.id: finding for finding in findings if finding.verdict == HOLDS}
    rate = number.get(HYPOMONOTONE.id)
    if model.law is None or not model.law.is_box or depends_on_symbol(model.law, model.p):
        return []  # the hull of K would not be K
    if rate is None or P_OMEGA not in rate.witness or not {D_PSD_HYPOTHESIS.id, STORAGE_HYPOTHESIS.id} <= set(number):
        return []
    P = np.array(rate.witness[P_OMEGA], float)
    reach, room = unit_ball_box(P)
    if room == np.inf:
        return []
    x, p, zero = model.x, model.p, np.zeros(len(model.names))
    y = ca.densify(model.C @ x + model.e)
    made = []
    for z, what in (((zero, zero), "0"), (start, "x0")):
        lower, upper = (np.append(own, own_p) for own, own_p in zip(z, region.parameter_bounds(), strict=True))
        low_y, high_y = (np.ravel(end) for end in interval_bounds.enclose(y, ca.vertcat(x, p), lower, upper))
        up, down = hull[1] > 0, hull[0] < 0  # -y in N_K(0): y >= 0 where l may rise, y <= 0 where it may fall
        if not (hull[0] <= 0).all() or not (hull[1] >= 0).all() or (up & (low_y < 0)).any() or (down & (high_y > 0)).any():
            continue
        moved, f = ca.vertcat(x, model.t, p), model.A + model.f
        ends = (
            np.concatenate([z[0], [region.t0], region.parameter_bounds()[0]]),
            np.concatenate([z[1], [region.t1], region.parameter_bounds()[1]]),
        )
        top = extremum.supremum(ca.bilin(ca.SX(ca.DM(P)), f, f), moved, *ends, quick=True).bound
        drive = float(np.sqrt(max(top, 0.0))) * room
        far = np.maximum(np.abs(start[0]), np.abs(start[1])) if what == "0" else zero
        distance = float(np.sqrt(far @ np.abs(P) @ far)) * room
        radius = float(np.min(np.minimum(z[0] - region.lower, region.upper - z[1]) / reach, initial=np.inf))
        until = stay_in_ball(distance, rate.value["omega"], drive, radius)
        made.append(
            StayTime(until, f"as |x - {what}|_P' <= {rate.value['omega']:.5g} |x - {what}|_P + {drive:.5g}, P the P_omega of 5.2")
        )
    return made


def unit_ball_box(P: np.ndarray) -> tuple[np.ndarray, float]:
    """Bounds (n,) of |x_i| where |x|_P <= 1, and a factor > 1 that such norms may err by: entries of P are rounded.

    Scaled to a unit diagonal, P + E with |E_ij| <= EPS has a relative error of the norm of n EPS / least eigenvalue at most.
    Both are infinite where the least eigenvalue is no more than rounding: nothing is known then of a rational P.
    """
    unit, n = 1 / np.sqrt(np.diagonal(P)), len(P)
    scaled = P * np.outer(unit, unit)
    least, rounding = float(np.linalg.eigvalsh(scaled)[0]), 16 * n**2 * exact.MACHINE_EPSILON
    if not least > rounding:
        return np.full(n, np.inf), np.inf
    room = 1 + STAY_ROUNDING + rounding / least
    return unit * np.sqrt(np.abs(np.diagonal(np.linalg.inv(scaled)))) * room, room
