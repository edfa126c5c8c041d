"""Hypotheses of catching-up for maximal monotone inclusions (2026 paper, Section 3 and (24)), and what follows from them.

x'(t) ∈ F(x(t)) - S(x(t)) - N_C(x(t)),   T = S + N_C,   G = F - S
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import (
    HOLDS,
    SAMPLED,
    UNKNOWN,
    VIOLATED,
    Consequence,
    Finding,
    Hypothesis,
    common_scope,
    make_consequence,
    make_finding,
)
from nsmodel.hypotheses.region import Region, potential_without_domain
from nsmodel.models.monotone_inclusion.along_run import CATCHING_UP_PAPER, scheme_convergence
from nsmodel.models.monotone_inclusion.field import (
    SelectedField,
    boundary_jump,
    constraint_set,
    decompose_field,
    monotone_part,
    nonmonotone_pair,
)
from nsmodel.models.monotone_inclusion.growth import linear_growth
from nsmodel.models.monotone_inclusion.model import MonotoneInclusion
from nsmodel.models.monotone_inclusion.one_sided_lipschitz import field_continuity, one_sided_lipschitz
from nsmodel.models.monotone_inclusion.tangent import dissipativity
from nsmodel.proof import exact, extremum, interval_bounds, polynomial
from nsmodel.proof.convex import potentials
from nsmodel.proof.convex.sets import ConvexSet, has_interior, is_convex_set
from nsmodel.proof.exact import ROUND_UP_FACTOR
from nsmodel.proof.expression_graph import symbol_hashes
from nsmodel.proof.global_search import searches_are_quick
from nsmodel.proof.jumps import find_jump
from nsmodel.proof.verdict import HypothesisPart
from nsmodel.simulation.trajectory import Trajectory

M_T = Hypothesis("M-T", "T = S + N_C is maximal monotone", f"{CATCHING_UP_PAPER}, Section 2, (5)")
M_C = Hypothesis("M-C", "C = cl dom T is closed and convex, with interior", f"{CATCHING_UP_PAPER}, Section 2")
M_A1 = Hypothesis("M-A1", "F is continuous and locally bounded", f"{CATCHING_UP_PAPER}, (A1)")
M_A2 = Hypothesis("M-A2", "|F(x) - S(x)| <= a_1 + a_2 |x| on C", f"{CATCHING_UP_PAPER}, (A2)")
M_A3 = Hypothesis("M-A3", "<x, w> <= -alpha |x|^2 + beta for w in P_{T_C(x)}(F(x) - S(x)), x in C", f"{CATCHING_UP_PAPER}, (A3)")
M_24 = Hypothesis("M-24", "<G(x) - G(y), x - y> <= L |x - y|^2, G = F - S", f"{CATCHING_UP_PAPER}, (24)")
HYPOTHESES = (M_T, M_C, M_A1, M_A2, M_A3, M_24)
MIN_EIGENVALUE_SAMPLES = 64  # Points of a sample, at least: fewer, where few lie in C, say nothing and leave the question open.
CONTRACTION_IDS = ("M-T", "M-C", "M-A1", "M-24")


def check_autonomous(
    model: MonotoneInclusion, region: Region, runs: Sequence[Trajectory], quick: bool
) -> tuple[list[Finding], list[Consequence]]:
    """Return one finding a hypothesis, and what follows; see `check.check`."""
    C = constraint_set(model)
    x0 = np.array(ca.DM(model.x0)).ravel()
    if C.empty:
        return _check_empty_set(model, C, x0, runs)
    field = decompose_field(model, C)
    box = C.part(region.lower, region.upper)
    a, T = linear_growth(field, box, quick=quick), operator_monotonicity(model, C, box, quick)
    monotone = T.verdict == HOLDS and not T.local
    parts = (
        (M_T, T),
        (M_C, _check_constraint_set(C, box, x0, quick)),
        (M_A1, field_continuity(model, C, box)),
        (M_A2, a),
        (
            M_A3,
            HypothesisPart(UNKNOWN, "not of the box", {}, {}) if searches_are_quick() else dissipativity(field, a, quick=quick),
        ),
        (M_24, one_sided_lipschitz(field, box, quick=quick, alone=model.field if monotone else None)),
    )
    findings = [
        make_finding(which, part.verdict, part.how, part.value, part.witness, region.scope(part.local)) for which, part in parts
    ]
    return findings, autonomous_consequences(model, findings, x0, runs)


def _check_empty_set(
    model: MonotoneInclusion, C: ConvexSet, x0: np.ndarray, runs: Sequence[Trajectory]
) -> tuple[list[Finding], list[Consequence]]:
    nothing = HypothesisPart(UNKNOWN, "C is empty: there is no state to speak of", {}, {})
    parts = [(which, has_interior(C, x0) if which is M_C else nothing) for which in HYPOTHESES]
    findings = [make_finding(which, part.verdict, part.how, part.value, part.witness) for which, part in parts]
    return findings, autonomous_consequences(model, findings, x0, runs)


# -- M-C ---------------------------------------------------------------------------------------------------------------


def _check_constraint_set(C: ConvexSet, box: tuple[np.ndarray, np.ndarray], x0: np.ndarray, quick: bool) -> HypothesisPart:
    convex, interior = is_convex_set(C, *box, quick=quick), has_interior(C, x0)
    order = (VIOLATED, UNKNOWN, SAMPLED, HOLDS)
    verdict = min(convex.verdict, interior.verdict, key=order.index)
    deciding_parts = [part for part in (convex, interior) if part.verdict == verdict]
    values = {**convex.value, **interior.value} or {"constraints": 0}
    witness = {k: w for part in deciding_parts for k, w in part.witness.items()}
    return HypothesisPart(
        verdict, "; ".join(part.how for part in deciding_parts), values, witness, any(part.local for part in deciding_parts)
    )


# -- M-T ---------------------------------------------------------------------------------------------------------------


def operator_monotonicity(
    model: MonotoneInclusion, C: ConvexSet, box: tuple[np.ndarray, np.ndarray], quick: bool
) -> HypothesisPart:
    """T = S + N_C is maximal monotone."""
    if model.potential_split is not None:
        part = potentials.is_convex_potential(potential_without_domain(model.phi, model.x, "phi"), C, *box, quick=quick)
        value = (
            {"least eigenvalue of sym S'": part.value[potentials.MIN_EIGENVALUE_KEY]}
            if potentials.MIN_EIGENVALUE_KEY in part.value
            else part.value
        )
        return part._replace(how=f"T = dphi, phi convex: {part.how}", value=value or {"terms": len(model.potential_split.terms)})
    field = decompose_field(_without_field(model), C)
    aligned, x = bool(field.aligned), model.x
    signed_operator = (
        ca.substitute(model.operator, model.sign_symbols, ca.sign(model.sign_arguments)) if field.l.numel() else model.operator
    )
    S = -field.rest
    if field.jumps or not interval_bounds.is_continuous(S, x, *C.bounding_box):
        if field.jumps and not _has_separate_switches(model):
            return _jump_monotonicity(field)
        full = signed_operator if field.jumps else S
        split = monotone_part(full, C)
        found = _remainder_monotonicity(split.rest, C, box, quick, aligned=aligned and not split.ridges)
        if found.verdict == HOLDS and split.open:
            return _unfilled_jump(model, C)
        if found.verdict == HOLDS and not found.local:
            return found._replace(how=_mention_ridges(found.how, split.ridges))
        broken = _jump_monotonicity(field) if field.jumps else found
        broken = broken if broken.verdict == VIOLATED else _monotonicity_counterexample(full, C, C.bounding_box) or broken
        return broken if broken.verdict == VIOLATED or found.verdict != HOLDS else found
    return _remainder_monotonicity(S, C, box, quick, aligned=aligned)


def _mention_ridges(how: str, count: int) -> str:
    ridges = "nondecreasing functions of one direction, their jumps upwards filled in"
    if not count:
        return how
    return f"a sum of {ridges}" if how.startswith("S = 0") else f"{how}; beside {ridges}"


def _remainder_monotonicity(
    S: ca.SX, C: ConvexSet, box: tuple[np.ndarray, np.ndarray], quick: bool, *, aligned: bool
) -> HypothesisPart:
    entries = polynomial.read_polynomials(S, C.x)
    if all(p is not None and polynomial.degree(p) <= 1 for p in entries):
        return _linear_monotonicity(entries, C.n, aligned)
    return _smooth_monotonicity(S, C, box, quick)


def _has_separate_switches(model: MonotoneInclusion) -> bool:
    """Whether S is affine in its signs, and no two of them switch on one hyperplane: then its values there are all that fill."""
    n, symbols = model.x.numel(), model.sign_symbols
    slopes = ca.jacobian(model.operator, symbols)
    if symbol_hashes(slopes) & symbol_hashes(symbols):
        return False
    rows = []
    for p in polynomial.read_polynomials(model.sign_arguments, model.x):
        read = polynomial.as_quadratic(p, n) if p is not None and polynomial.degree(p) <= 1 else None
        if read is None or not read.q.any():
            return False
        first = next(number for number in read.q.ravel() if number)
        rows.append((*(number / first for number in read.q.ravel()), read.c / first))
    return len(set(rows)) == len(rows)


def _unfilled_jump(model: MonotoneInclusion, C: ConvexSet) -> HypothesisPart:
    """S is monotone, but steps of if_else, floor or ceil are no sets: with one inside C, or on its boundary, it is not maximal.

    On the boundary N_C fills in what points out of C, and a step upwards points into it.
    """
    S = ca.substitute(model.operator, model.sign_symbols, ca.SX.zeros(model.sign_symbols.shape))
    low, high = (np.clip(end, -1e3, 1e3) for end in C.bounding_box)
    jump = find_jump(S, C.x, low, high, C.contains) or boundary_jump(S, C)
    if jump is None:
        return HypothesisPart(
            UNKNOWN, "S is monotone, but it may jump in C where it is not filled in; only sign stands for a set", {}, {}
        )
    how = "S jumps and is single-valued there: monotone, but not maximal; write the jump with sign, which stands for all between"
    return HypothesisPart(VIOLATED, how, {"jump": jump.size}, {"x": jump.at, "below": jump.below, "above": jump.above})


def _monotonicity_counterexample(S: ca.SX, C: ConvexSet, box: tuple[np.ndarray, np.ndarray]) -> HypothesisPart | None:
    pair = nonmonotone_pair(S, C, box)
    if pair is None:
        return None
    f = ca.Function("S", [C.x], [S])
    x, y = pair["x"], pair["y"]
    rate = float((np.array(f(x)) - np.array(f(y))).ravel() @ (x - y) / ((x - y) @ (x - y)))
    how = "S is not monotone: <S(x) - S(y), x - y> < 0 at two points of C (bounds)"
    return HypothesisPart(VIOLATED, how, {"<S(x) - S(y), x - y>/|x - y|^2": rate}, pair)


def _without_field(model: MonotoneInclusion) -> MonotoneInclusion:
    """The same operator without F."""
    alone = copy(model)
    alone._set(field=ca.SX.zeros(model.x.numel()))
    return alone


def _linear_monotonicity(entries: Sequence[polynomial.Polynomial | None], n: int, switches: bool) -> HypothesisPart:
    rows = [polynomial.as_quadratic(p, n) for p in entries]
    A = np.hstack([row.q for row in rows if row is not None]).T
    decided, M = exact.definiteness(A), exact.doubles(A)
    values, vectors = np.linalg.eigh((M + M.T) / 2)
    least, rounding = float(values[0]), potentials.EIGENVALUE_ROUNDING * float(np.abs(values).max(initial=0.0))
    label = "least eigenvalue of sym S'"
    if decided.psd:
        how = "S = 0" if not any(entries) else "S is monotone in exact arithmetic"
        how += ", and its switches are subdifferentials of weighted |a'x + c|" if switches else ""
        return HypothesisPart(HOLDS, how, {label: max(least, 0.0)}, {})
    witness = {"direction": vectors[:, 0]}
    if least >= -rounding:
        return HypothesisPart(SAMPLED, "S is monotone up to rounding only", {label: least, "rounding bound": rounding}, witness)
    return HypothesisPart(VIOLATED, "S is not monotone: <S(x) - S(y), x - y> < 0 along the direction", {label: least}, witness)


def _smooth_monotonicity(S: ca.SX, C: ConvexSet, box: tuple[np.ndarray, np.ndarray], quick: bool) -> HypothesisPart:
    J = ca.jacobian(S, C.x)
    symmetric = (J + J.T) / 2
    label = "least eigenvalue of sym S'"
    where = C.rows if C.rows.numel() else None
    low, high = np.maximum(C.bounding_box[0], box[0]), np.minimum(C.bounding_box[1], box[1])
    for local, ends, fast in ((False, C.bounding_box, True), (True, (low, high), quick)):
        if not interval_bounds.is_continuous(S, C.x, *ends):
            continue
        sup = extremum.largest_eigenvalue(-symmetric, C.x, *ends, where=where, bound_to=0.0, quick=fast)
        if sup.bound <= 0:
            value = {label: -sup.value if sup.at is not None else -sup.bound}
            return HypothesisPart(HOLDS, "bounds of the eigenvalues of the symmetric Jacobian of S", value, {}, local)
        down = potentials.find_negative_curvature(S, ca.densify(symmetric), C, sup.at)
        if down:
            how = "the symmetric Jacobian of S has a negative eigenvalue: S is not monotone"
            return HypothesisPart(VIOLATED, how, {label: -sup.value}, down)
    pair = _monotonicity_counterexample(S, C, (low, high))
    if pair is not None:
        return pair
    sup = extremum.largest_eigenvalue(-symmetric, C.x, low, high, where=where, quick=True)
    if sup.at is None or sup.count < MIN_EIGENVALUE_SAMPLES or not interval_bounds.is_continuous(S, C.x, low, high):
        return HypothesisPart(UNKNOWN, "S is not proved continuous on the box, and its Jacobian could not be looked at", {}, {})
    how = f"no negative eigenvalue of the symmetric Jacobian of S at {sup.count} points of the box"
    return HypothesisPart(SAMPLED, how, {label: -sup.value}, {"x": sup.at}, True)


def _jump_monotonicity(field: SelectedField) -> HypothesisPart:
    part = one_sided_lipschitz(field, field.C.bounding_box, quick=True)
    if part.verdict == VIOLATED:
        return HypothesisPart(
            VIOLATED, "S jumps downwards across a switching surface: it is not monotone", part.value, part.witness
        )
    return HypothesisPart(UNKNOWN, f"the switches of S are not seen to be monotone: {part.how}", {}, {})


# -- consequences ------------------------------------------------------------------------------------------------------


def autonomous_consequences(
    model: MonotoneInclusion, findings: Sequence[Finding], x0: np.ndarray, runs: Sequence[Trajectory]
) -> list[Consequence]:
    """What follows from the findings, for starts of the size of x0."""
    numbers = {finding.id: finding.value for finding in findings}
    base = ["M-T", "M-C", "M-A1", "M-A2", "M-A3"]
    local = _is_local(findings, [*base, "M-24"])
    starts = "from x0 one and only one solution starts" if local else "one and only one solution for each start in C, for all t"
    out = [make_consequence("well posed", starts, findings, [*base, "M-24"], f"{CATCHING_UP_PAPER}, Theorem 5.6, Theorem 7.3")]
    alpha, beta = numbers["M-A3"].get("alpha", np.nan), numbers["M-A3"].get("beta", np.nan)
    if np.isfinite(alpha + beta):
        radius, absorbing = (float(np.sqrt(square)) * ROUND_UP_FACTOR for square in (max(x0 @ x0, beta / alpha), beta / alpha))
        every = "" if _is_local(findings, ["M-C", "M-A3"]) else (
            f" for all t, and the part of C in any ball about 0 of radius >= {absorbing:.6g} is invariant"
        )  # fmt: skip
        statement = f"|x(t)|^2 <= e^(-2 alpha t) |x_0|^2 + (beta/alpha)(1 - e^(-2 alpha t)): |x| <= {radius:.6g}{every}"
        values = {"alpha": alpha, "beta": beta, "radius": radius, "absorbing radius": absorbing}
        out.append(
            make_consequence("bounded", statement, findings, ["M-C", "M-A3"], f"{CATCHING_UP_PAPER}, Proposition 4.1", values)
        )
    L = numbers["M-24"].get("L", np.nan)
    if np.isfinite(L):
        word = "contraction" if L < 0 else "stability"
        alone = _is_local(findings, CONTRACTION_IDS)
        end = " while both stay inside the box" if alone else ": all solutions approach each other" if L < 0 else ""
        statement = f"|x(t) - y(t)| <= e^({L:.6g} t) |x_0 - y_0|{end}"
        out.append(make_consequence(word, statement, findings, CONTRACTION_IDS, f"{CATCHING_UP_PAPER}, Theorem 7.3", {"L": L}))
    span = "" if local else ", uniformly on every finite interval"
    return [*out, *scheme_convergence(model, findings, [*base, "M-24"], span, runs)]


def _is_local(findings: Sequence[Finding], ids: Sequence[str]) -> bool:
    scope = common_scope(findings, ids)
    return scope is not None and bool(scope.states)
