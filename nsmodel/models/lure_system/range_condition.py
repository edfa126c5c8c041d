"""Is -C x in the range of D + dXi, and is that range large: Assumptions 3.1, 5.4 and 7.1 of a Lur'e system.

With S = D + D', V = {v ∈ ker S : v recedes in dom Xi, D v ∈ (dom Xi_inf)*} and Xi_inf the support function of -dom Phi,

    int dom Upsilon* = {q : Xi_inf(v) > <q, v> for v ∈ V, v != 0} = int(-dom Phi - V*),
    V* = cl(R(S) + (dom Xi_inf)'s dual cone + D'(dual cone)*),

which is not empty if and only if no line lies in V across dom Phi. Then, as V*'s other summands are absorbed by rint dom Phi and
by D' rint dom Xi, and as A + U = rint A + U for an open U,

    -C x ∈ -D'(dom dXi) + int dom Upsilon*    if and only if    C x = D'k + y + S v,  k ∈ rint dom Xi,  y ∈ rint dom Phi.

For a cone K and D = 0 this is C x ∈ int K*. A constant offset e of y is a part of the law, Xi + <e, .>, so that C x + e stands in
place of C x. It is decided in exact rational arithmetic, with a point or a separating vector w: C'w = 0 (5.4a), S w = 0,
w recedes in dom Xi and <D w, k> + <w, y> >= <w, C x> for all k and y.

What the range conditions rest on: matrices in Fractions, the domains of the law, a line in them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Finding, Hypothesis, make_finding
from nsmodel.modeling.laws import Law
from nsmodel.modeling.laws.base import ExactSet, Halfspaces, Intervals, RoundSet
from nsmodel.models.lure_system import domains
from nsmodel.models.lure_system.domains import (
    TAU_COLUMN,
    ConvexPotential,
    Domains,
    EmptyDomain,
    UndecidedDomain,
    interior_finding,
)
from nsmodel.models.lure_system.model import LureSystem
from nsmodel.models.lure_system.passivity import LURE_PAPER, decide_input_output
from nsmodel.models.lure_system.rest_point import rest_point_finding
from nsmodel.proof import conic, exact
from nsmodel.proof.storage_matrix import PASSIVITY_ROUNDING


@dataclass(frozen=True)
class RangeSetting:
    """What the findings share: matrices in Fractions, the domains, or why they are not known; e (m, 1) None where it moves."""

    model: LureSystem
    C: np.ndarray
    D: np.ndarray
    e: np.ndarray | None
    psd: bool
    rounded: bool
    kernel: int
    potential: ConvexPotential | None
    domains: Domains | None
    reason: str
    broken: bool
    line: np.ndarray | None

    @property
    def m(self) -> int:
        """Number of multipliers."""
        return len(self.D)

    @property
    def bounded(self) -> bool:
        """Whether the law's K is a product of bounded intervals and balls."""
        return self.model.law is not None and self.domains is not None and bool(self.domains.loose.all())

    @property
    def whole_space_reason(self) -> str:
        """Why int dom Upsilon* is the whole space; empty where that is not seen at once."""
        if self.broken:
            return ""
        if not self.kernel:
            return "ker(D + D') = {0} (exact), so that int dom Upsilon* is the whole space"
        if self.domains is not None and self.domains.loose.all():
            what = "K is bounded" if self.model.law is not None else "Phi is finite everywhere"
            return f"{what}, so that int dom Upsilon* is the whole space"
        return ""


def read_range_setting(model: LureSystem) -> RangeSetting:
    """Read the model."""
    C, D = (np.array(ca.DM(matrix)).reshape(matrix.shape) for matrix in (model.C, model.D))
    e = exact.rational(np.array(ca.DM(model.e))) if model.e.is_constant() else None
    S = exact.rational(D) + exact.rational(D).T
    kernel = len(S) - exact.rank(S)
    potential, own, reason, broken = None, None, "", False
    try:
        if model.law is not None:
            own = domains.domains_of_law(model.law, D)
        else:
            broken = True
            potential = domains.read_potential(model.phi, model.phi_split, model.y)
            broken = False
            own = domains.domains_of_potential(potential, len(D), bool(D.any()))
    except EmptyDomain as empty:
        reason, broken = f"{'K' if model.law is not None else 'the domain of phi'}: {empty}", True
    except UndecidedDomain as undecided:
        reason = str(undecided)
    line = None if own is None or own.loose.all() or not kernel else linearity_direction(own, exact.rational(D))
    psd = exact.definiteness(D).psd
    rounded = decide_input_output(D).verdict == SAMPLED or (psd and _floating_rank(D) < len(S) - kernel)
    return RangeSetting(
        model, exact.rational(C), exact.rational(D), e, psd or rounded, rounded, kernel, potential, own, reason, broken, line
    )


def _floating_rank(D: np.ndarray) -> int:
    """Rank of D + D', D psd, scaled to a unit diagonal, where eigenvalues of the size of rounding count as 0."""
    root = np.sqrt(np.diagonal(D)[np.diagonal(D) > 0])
    S = (D + D.T)[np.ix_(np.diagonal(D) > 0, np.diagonal(D) > 0)] / 2 / root[:, None] / root
    return int((np.linalg.eigvalsh(S) > len(D) * PASSIVITY_ROUNDING).sum()) if len(S) else 0


def linearity_direction(own: Domains, D: np.ndarray) -> np.ndarray | None:
    """A direction v so that Upsilon is linear along v and -v; None where there is none."""
    rows = np.vstack([own.stack_matrices(own.across), D + D.T, exact.matrix_product(own.stack_matrices(own.flat), D)])
    lines = exact.nullspace(rows)
    return exact.doubles(lines[:, 0]) if lines.shape[1] else None


H_31 = Hypothesis("3.1", "Xi is continuous at some point: its domain has an interior", f"{LURE_PAPER}, Assumption 3.1")
H_54A = Hypothesis("5.4a", "R(C) meets -D'(rint dom dXi) + int dom Upsilon*", f"{LURE_PAPER}, Assumption 5.4 (a)")
H_54B = Hypothesis("5.4b", "dom dXi and R(D + dXi) are convex", f"{LURE_PAPER}, Assumption 5.4 (b)")
H_54C = Hypothesis(
    "5.4c", "-D'(dom dXi) + int dom Upsilon* and R(D + dXi) have the same affine hull", f"{LURE_PAPER}, Assumption 5.4 (c)"
)
H_5X0 = Hypothesis("5.x0", "-C x0 is in -D'(dom dXi) + int dom Upsilon*: the start is admissible", f"{LURE_PAPER}, Theorem 5.6")
H_71 = Hypothesis("7.1", "0 in X_0, A(0) = 0, 0 in (D + dXi)^-1(0), and f = 0", f"{LURE_PAPER}, Assumption 7.1")
MOVING_OFFSET_NOTE = "y has an offset e that moves with time: the theorems are about y = C x + D l, and a constant e"
RANGE_HYPOTHESES = (H_31, H_54A, H_54B, H_54C, H_5X0, H_71)


def range_findings(model: LureSystem, quick: bool) -> list[Finding]:
    """Decide 3.1, 5.4a, 5.4b, 5.4c, 5.x0 and 7.1, in this order; the model is bound. Nothing here is left out by ``quick``."""
    at = read_range_setting(model)
    x0 = np.array(ca.DM(model.x0)).ravel()
    start = _admissibility_finding(at, H_5X0, exact.matrix_product(at.C, exact.rational(x0)[:, None]))
    origin = start if not x0.any() else _admissibility_finding(at, H_5X0, exact.zeros(at.m, 1))
    own = [
        _weaken_rounded_finding(at, finding)
        for finding in (_range_intersection_finding(at), _convexity_finding(at), _affine_hull_finding(at), start)
    ]
    rest = rest_point_finding(H_71, model, at.potential, _weaken_rounded_finding(at, origin))
    return [interior_finding(H_31, model, at.potential, at.reason if at.broken else ""), *own, rest]


def _weaken_rounded_finding(at: RangeSetting, finding: Finding) -> Finding:
    """What rests on ker(D + D') is not proved where D is psd up to rounding only: that kernel is a matter of rounding, too."""
    if not at.rounded or (at.domains is not None and at.domains.loose.all()):
        return finding
    verdict = {HOLDS: SAMPLED, VIOLATED: UNKNOWN}.get(finding.verdict, finding.verdict)
    why = "D + D' is regular by rounding of D only" if exact.definiteness(at.D).psd else "D is psd up to rounding only (4.1)"
    return replace(finding, verdict=verdict, how=f"{finding.how} But {why}.")


def is_range_whole_space(law: Law, D: np.ndarray) -> bool:
    """Whether int dom Upsilon* is the whole space: R(D + N_K) is, then, for a psd D (rational).

    It is so if and only if 0 = D'k + y + S v with k in rint K_inf and y in rint K_inf*, and no line: a cone with 0 inside.
    """
    if len(D) == exact.rank(D + D.T):
        return True
    own = domains.domains_of_law(law, D, _recession_cone)
    own.loose = domains.unrestricted_outputs(law)
    if own.loose.all():
        return True
    return (
        linearity_direction(own, D) is None and conic.decide_feasibility(own.system(range_parts(D, own), own.m)).point is not None
    )


# -- 5.4a and 5.x0 --------------------------------------------------------------------------------------------------------


def _set_meaning_note(at: RangeSetting) -> str:
    return "" if at.psd else " D is not psd (4.1), so that Theorem 4.5 gives this set no meaning for R(D + dXi)."


def _immediate_finding(at: RangeSetting, hypothesis: Hypothesis) -> Finding | Domains:
    """A finding where no system has to be solved."""
    if at.whole_space_reason:
        return make_finding(hypothesis, HOLDS, f"{at.whole_space_reason}.{_set_meaning_note(at)}", {"restricting rows": 0})
    if at.domains is None or at.broken:
        return make_finding(hypothesis, UNKNOWN, at.reason)
    return make_finding(hypothesis, UNKNOWN, MOVING_OFFSET_NOTE) if at.e is None else at.domains


def _empty_interior_finding(
    at: RangeSetting, hypothesis: Hypothesis, line: np.ndarray, answer: conic.FeasibilityDecision
) -> Finding:
    """Upsilon is linear along ``line``: the hypothesis fails, though what the proof needs may hold."""
    how = "int dom Upsilon* is empty, as Upsilon is linear along v and -v (an equality row whose l D does not bound)."
    if answer.point is not None and at.psd:
        what = "R(C) meets" if hypothesis is H_54A else "-C x0 lies in"
        how += f" Yet {what} rint R(D + dXi) (exact), which is all that the proof of Proposition 5.5 uses."
    restricting = 0 if at.domains is None else int((~at.domains.loose).sum())
    return make_finding(
        hypothesis, VIOLATED, how, {"restricting rows": restricting}, {"v": line, **_nonzero_multipliers(at, line)}
    )


def _nonzero_multipliers(at: RangeSetting, w: np.ndarray) -> dict[str, list[str]]:
    return {"multipliers": [name for name, entry in zip(at.model.multiplier_names, w, strict=True) if entry]}


def _offset_column(at: RangeSetting) -> np.ndarray:
    return exact.zeros(at.m, 1) if at.e is None else at.e


def _offset_text(at: RangeSetting) -> str:
    return " + e" if at.e is None or at.e.any() else ""


def range_parts(D: np.ndarray, own: Domains) -> list[domains.ColumnPart]:
    """D'k + y + S v, with the columns of v behind the others."""
    transformed = [(columns, exact.matrix_product(D.T, matrix)) for columns, matrix in own.k]
    n = len(own.kinds)
    return [*transformed, *own.y, (list(range(n, n + own.m)), D + D.T)]


def _range_intersection_finding(at: RangeSetting) -> Finding:
    """5.4a: C x + e = D'k + y + S v for some x."""
    own = _immediate_finding(at, H_54A)
    if isinstance(own, Finding):
        return own
    n, states = len(own.kinds) + at.m, at.C.shape[1]
    system = own.system(
        [*range_parts(at.D, own), (list(range(n, n + states)), -at.C), (TAU_COLUMN, -_offset_column(at))], at.m + states
    )
    answer = conic.decide_feasibility(system)
    if at.line is not None:
        return _empty_interior_finding(at, H_54A, at.line, answer)
    value: dict[str, float] = {"restricting rows": int((~own.loose).sum())}
    if answer.point is not None:
        x = exact.doubles(answer.point[n:] / answer.point[0])
        how = (
            f"Decided exactly: for this state x, C x{_offset_text(at)} = D'k + y + S v with k in rint dom Xi "
            "and y in rint dom Phi." + _set_meaning_note(at)
        )
        return make_finding(H_54A, HOLDS, how, value, {"x": x})
    if answer.separator is None:
        return make_finding(H_54A, UNKNOWN, _undecided_margin_text(answer.margin), value)
    w = _separator_in_outputs(own, answer.separator)
    least = "<w, e>" if _offset_text(at) else "0"
    how = (
        f"Decided exactly: w separates R(C) from the set: C'w = 0, (D + D')w = 0, and <D w, k> + <w, y> >= {least} for all k in "
        "dom Xi and y in dom Phi." + _set_meaning_note(at)
    )
    return make_finding(H_54A, VIOLATED, how, value, {"w": w, **_nonzero_multipliers(at, w)})


def _admissibility_finding(at: RangeSetting, hypothesis: Hypothesis, output: np.ndarray) -> Finding:
    """5.x0: C x0 + e = D'k + y + S v; ``output`` (m, 1) is C x0."""
    own = _immediate_finding(at, hypothesis)
    if isinstance(own, Finding):
        return own
    output, name = output + _offset_column(at), f"(C x0{_offset_text(at)})" if _offset_text(at) else "C x0"
    system = own.system([*range_parts(at.D, own), (TAU_COLUMN, -output)], at.m)
    answer = conic.decide_feasibility(system)
    if at.line is not None:
        return _empty_interior_finding(at, hypothesis, at.line, answer)
    if answer.point is not None:
        how = f"Decided exactly: {name} = D'k + y + S v with k in rint dom Xi and y in rint dom Phi." + _set_meaning_note(at)
        margin = _admissibility_margin(at, own, output, answer.point)
        value = {"restricting rows": int((~own.loose).sum())} if margin is None else {"margin": margin}
        return make_finding(hypothesis, HOLDS, how, value, {name: exact.doubles(output.ravel())})
    if answer.separator is None:
        return make_finding(hypothesis, UNKNOWN, _undecided_margin_text(answer.margin))
    w = _separator_in_outputs(own, answer.separator)
    gap = float(exact.matrix_product(answer.separator[None, :], system.A[:, TAU_COLUMN])[0, 0] / max(map(abs, answer.separator)))
    where = "outside the closure of the set" if gap > 0 else "on the boundary of the set, where the theorem says nothing"
    how = (
        f"Decided exactly: -{name} is {where}: <D w, k> + <w, y> - <w, {name}> >= gap for all k in dom Xi and y in dom Phi. "
        f"A start with <w, C x0> larger, or a little resistance in D, changes this.{_set_meaning_note(at)}"
    )
    return make_finding(
        hypothesis, VIOLATED, how, {"gap": gap}, {"w": w, **_nonzero_multipliers(at, w), name: exact.doubles(output.ravel())}
    )


def _separator_in_outputs(own: Domains, separator: np.ndarray) -> np.ndarray:
    """The separator's part in the rows of y, largest entry 1, with 0 in the loose rows."""
    w = np.zeros(own.m)
    kept = separator[: int((~own.loose).sum())]
    w[~own.loose] = exact.doubles(kept / max([abs(entry) for entry in kept if entry], default=1))
    return w


def _undecided_margin_text(margin: float) -> str:
    return (
        f"the second-order cones are touched to within rounding (margin {margin:.2g}): neither a point inside nor a separating "
        "vector could be made exact"
    )


def _admissibility_margin(at: RangeSetting, own: Domains, output: np.ndarray, point: np.ndarray) -> float | None:
    """Largest t so that C x0 stays admissible when each restricting y_i loses t; None where y has other rows than half-lines."""
    from scipy.optimize import linprog

    lines = [columns[0] for columns, matrix in own.y if len(columns) == 1 and np.count_nonzero(matrix) == 1]
    if own.groups or len(lines) < int((~own.loose).sum()):
        return None
    exactly = float(min(point[lines]) / point[0])  # What linear programming cannot resolve.
    A = exact.doubles(own.system([*range_parts(at.D, own), (TAU_COLUMN, -output)], at.m).A)
    n = A.shape[1]
    rows = np.zeros((len(lines), n + 1))
    rows[range(len(lines)), lines], rows[:, n] = -1, 1
    limits = [(0.0, None) if kind == "positive" else (None, None) for kind in own.kinds]
    limits += [(None, None)] * (n - len(limits)) + [(0.0, None)]
    limits[0] = (1.0, 1.0)
    equations = np.column_stack([A, np.zeros(len(A))])
    best = linprog(np.append(np.zeros(n), -1.0), rows, np.zeros(len(lines)), equations, np.zeros(len(A)), bounds=limits)
    return max(exactly, float(best.x[-1])) if best.status == 0 else np.inf if best.status == 3 else exactly


# -- 5.4b and 5.4c --------------------------------------------------------------------------------------------------------


def _convexity_finding(at: RangeSetting) -> Finding:
    """dom dXi and R(D + dXi), each by a theorem about the law."""
    if at.broken:
        return make_finding(H_54B, UNKNOWN, at.reason)
    domain, image = _domain_convexity_reason(at), _range_convexity_reason(at)
    if domain and image:
        return make_finding(H_54B, HOLDS, f"By the law: {domain}; {image}.", {"multipliers": at.m})
    if not at.psd:
        return make_finding(H_54B, UNKNOWN, "D is not psd (4.1): R(D + dXi) need not be convex")
    missing = "dom dXi" if not domain else "R(D + dXi)"
    return make_finding(
        H_54B, UNKNOWN, f"{missing} lies between a convex set and its closure; which boundary points belong to it is not decided"
    )


def _domain_convexity_reason(at: RangeSetting) -> str:
    """Why dom dXi is convex; empty where it is not known to be."""
    p = at.potential
    if p is None:
        return "dom dXi = K"
    if p.piecewise:
        return "Phi is piecewise linear-quadratic, and so is Xi: dom dXi = dom Xi"
    if at.m == 1 or _is_separable_potential(at):
        return "dom dXi is a product of intervals"
    if p.Q is not None and exact.definiteness(p.Q).definite:
        return "Phi is strongly convex: dom dXi is the whole space"
    if p.Q is not None and not p.Q.any() and not any(term.c.any() for term in p.terms):
        return "Phi is affine plus sublinear: dom dXi = -dPhi(0)"
    return ""


def _is_separable_potential(at: RangeSetting) -> bool:
    """Whether Phi is a sum of functions of one y_i each."""
    split, y = at.model.phi_split, at.model.y
    if split.tau.numel():
        return False
    rows = [ca.jacobian(term.u, y) for term in split.terms]
    alone = all(len({j for _, j in zip(*J.sparsity().get_triplet(), strict=True)}) <= 1 for J in rows)
    hessian = ca.jacobian(ca.gradient(split.smooth, y), y)
    return alone and all(i == j for i, j in zip(*hessian.sparsity().get_triplet(), strict=True))


def _range_convexity_reason(at: RangeSetting) -> str:
    """Why R(D + dXi) is convex; empty where it is not known to be."""
    if at.bounded:
        return "K is bounded, so that R(D + dXi) is the whole space (Hartman and Stampacchia)"
    if not at.psd:
        return ""
    if at.whole_space_reason:
        return "R(D + dXi) is the whole space, by (24)"
    if not at.D.any():
        return "D = 0 and R(dXi) = -dom dPhi = -dom Phi" if at.model.law is None else "D = 0 and R(dXi) is the barrier cone of K"
    law = at.model.law
    if (law is None and at.potential is not None and at.potential.piecewise) or (law is not None and is_polyhedral_law(law)):
        # Cottle's argument: the gap of the monotone complementarity system is a convex quadratic, bounded below by 0 on a
        # polyhedron, hence attained (Frank and Wolfe), and 0 at a minimum: solvable wherever feasible.
        return "D is psd and the law polyhedral: q is in R(D + dXi) wherever the complementarity system is feasible, a polyhedron"
    if law is not None and is_range_whole_space(law, at.D):
        return "R(D + dXi) is the whole space, by (24): no direction of ker(D + D') recedes"
    return ""


def is_polyhedral_law(law: Law) -> bool:
    """Whether K is a polyhedron."""
    return all(isinstance(block.shape(), Intervals | Halfspaces) for block in law.blocks)


def _recession_cone(shape: ExactSet) -> ExactSet:
    """The recession cone K_inf of a set."""
    if isinstance(shape, Intervals):
        return Intervals(*(np.where(np.isfinite(end), 0.0, end) for end in shape))
    if isinstance(shape, RoundSet):
        return shape._replace(radius=0)
    return shape._replace(K=np.zeros(len(shape.K))) if isinstance(shape, Halfspaces) else shape


def _affine_hull_finding(at: RangeSetting) -> Finding:
    if at.broken:
        return make_finding(H_54C, UNKNOWN, at.reason)
    if at.line is not None:
        how = "int dom Upsilon* is empty (5.4a), R(D + dXi) is not: their affine hulls differ."
        return make_finding(H_54C, VIOLATED, how, {"dimension": 0}, {"v": at.line, **_nonzero_multipliers(at, at.line)})
    if at.domains is None and not at.whole_space_reason:
        return make_finding(H_54C, UNKNOWN, at.reason)
    if not (at.psd or at.bounded):
        return make_finding(H_54C, UNKNOWN, "D is not psd (4.1), so that (24) does not place the set inside R(D + dXi)")
    how = "int dom Upsilon* is not empty, hence open, and (24) places the set inside R(D + dXi): both hulls are the whole space."
    return make_finding(H_54C, HOLDS, how, {"dimension": at.m})
