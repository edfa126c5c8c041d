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
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from nsmodel.classes.lure.hypotheses import domains
from nsmodel.classes.lure.hypotheses.domains import TAU, Domains
from nsmodel.classes.lure.hypotheses.interior import interior
from nsmodel.classes.lure.hypotheses.passivity import PAPER
from nsmodel.classes.lure.hypotheses.range_setting import Setting, line_of, setting_of
from nsmodel.classes.lure.hypotheses.rest_point import rest_point
from nsmodel.classes.lure.model import LureSystem
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Finding, Hypothesis, found
from nsmodel.laws import Law
from nsmodel.laws.block import Halfspaces, Intervals, Round, Shape
from nsmodel.proof import exact, feasibility

H_31 = Hypothesis("3.1", "Xi is continuous at some point: its domain has an interior", f"{PAPER}, Assumption 3.1")
H_54A = Hypothesis("5.4a", "R(C) meets -D'(rint dom dXi) + int dom Upsilon*", f"{PAPER}, Assumption 5.4 (a)")
H_54B = Hypothesis("5.4b", "dom dXi and R(D + dXi) are convex", f"{PAPER}, Assumption 5.4 (b)")
H_54C = Hypothesis(
    "5.4c", "-D'(dom dXi) + int dom Upsilon* and R(D + dXi) have the same affine hull", f"{PAPER}, Assumption 5.4 (c)"
)
H_5X0 = Hypothesis("5.x0", "-C x0 is in -D'(dom dXi) + int dom Upsilon*: the start is admissible", f"{PAPER}, Theorem 5.6")
H_71 = Hypothesis("7.1", "0 in X_0, A(0) = 0, 0 in (D + dXi)^-1(0), and f = 0", f"{PAPER}, Assumption 7.1")
MOVING = "y has an offset e that moves with time: the theorems are about y = C x + D l, and a constant e"
HYPOTHESES = (H_31, H_54A, H_54B, H_54C, H_5X0, H_71)


def range_findings(model: LureSystem, quick: bool) -> list[Finding]:
    """Decide 3.1, 5.4a, 5.4b, 5.4c, 5.x0 and 7.1, in this order; the model is bound. Nothing here is left out by ``quick``."""
    at = setting_of(model)
    x0 = np.array(ca.DM(model.x0)).ravel()
    start = _admissible(at, H_5X0, exact.product(at.C, exact.rational(x0)[:, None]))
    origin = start if not x0.any() else _admissible(at, H_5X0, exact.zeros(at.m, 1))
    own = [_softened(at, finding) for finding in (_meets(at), _convex(at), _hulls(at), start)]
    rest = rest_point(H_71, model, at.potential, _softened(at, origin))
    return [interior(H_31, model, at.potential, at.reason if at.broken else ""), *own, rest]


def _softened(at: Setting, finding: Finding) -> Finding:
    """What rests on ker(D + D') is not proved where D is psd up to rounding only: that kernel is a matter of rounding, too."""
    if not at.rounded or (at.domains is not None and at.domains.loose.all()):
        return finding
    verdict = {HOLDS: SAMPLED, VIOLATED: UNKNOWN}.get(finding.verdict, finding.verdict)
    why = "D + D' is regular by rounding of D only" if exact.psd(at.D).psd else "D is psd up to rounding only (4.1)"
    return replace(finding, verdict=verdict, how=f"{finding.how} But {why}.")


def covers_everything(law: Law, D: np.ndarray) -> bool:
    """Whether int dom Upsilon* is the whole space: R(D + N_K) is, then, for a psd D (rational).

    It is so if and only if 0 = D'k + y + S v with k in rint K_inf and y in rint K_inf*, and no line: a cone with 0 inside.
    """
    if len(D) == exact.rank(D + D.T):
        return True
    own = domains.of_law(law, D, _recession)
    own.loose = domains.loose(law)
    if own.loose.all():
        return True
    return line_of(own, D) is None and feasibility.decide(own.system(_parts(D, own), own.m)).point is not None


# -- 5.4a and 5.x0 --------------------------------------------------------------------------------------------------------


def _literal(at: Setting) -> str:
    return "" if at.psd else " D is not psd (4.1), so that Theorem 4.5 gives this set no meaning for R(D + dXi)."


def _prepared(at: Setting, hypothesis: Hypothesis) -> Finding | Domains:
    """A finding where no system has to be solved."""
    if at.everything:
        return found(hypothesis, HOLDS, f"{at.everything}.{_literal(at)}", {"restricting rows": 0})
    if at.domains is None or at.broken:
        return found(hypothesis, UNKNOWN, at.reason)
    return found(hypothesis, UNKNOWN, MOVING) if at.e is None else at.domains


def _empty(at: Setting, hypothesis: Hypothesis, line: np.ndarray, answer: feasibility.Decision) -> Finding:
    """Upsilon is linear along ``line``: the hypothesis fails, though what the proof needs may hold."""
    how = "int dom Upsilon* is empty, as Upsilon is linear along v and -v (an equality row whose l D does not bound)."
    if answer.point is not None and at.psd:
        what = "R(C) meets" if hypothesis is H_54A else "-C x0 lies in"
        how += f" Yet {what} rint R(D + dXi) (exact), which is all that the proof of Proposition 5.5 uses."
    restricting = 0 if at.domains is None else int((~at.domains.loose).sum())
    return found(hypothesis, VIOLATED, how, {"restricting rows": restricting}, {"v": line, **_named(at, line)})


def _named(at: Setting, w: np.ndarray) -> dict[str, list[str]]:
    return {"multipliers": [name for name, entry in zip(at.model.multiplier_names, w, strict=True) if entry]}


def _offset(at: Setting) -> np.ndarray:
    return exact.zeros(at.m, 1) if at.e is None else at.e


def _e(at: Setting) -> str:
    return " + e" if at.e is None or at.e.any() else ""


def _parts(D: np.ndarray, own: Domains) -> list[domains.Part]:
    """D'k + y + S v, with the columns of v behind the others."""
    turned = [(columns, exact.product(D.T, matrix)) for columns, matrix in own.k]
    n = len(own.kinds)
    return [*turned, *own.y, (list(range(n, n + own.m)), D + D.T)]


def _meets(at: Setting) -> Finding:
    """5.4a: C x + e = D'k + y + S v for some x."""
    own = _prepared(at, H_54A)
    if isinstance(own, Finding):
        return own
    n, states = len(own.kinds) + at.m, at.C.shape[1]
    system = own.system([*_parts(at.D, own), (list(range(n, n + states)), -at.C), (TAU, -_offset(at))], at.m + states)
    answer = feasibility.decide(system)
    if at.line is not None:
        return _empty(at, H_54A, at.line, answer)
    value: dict[str, float] = {"restricting rows": int((~own.loose).sum())}
    if answer.point is not None:
        x = exact.doubles(answer.point[n:] / answer.point[0])
        how = (
            f"Decided exactly: for this state x, C x{_e(at)} = D'k + y + S v with k in rint dom Xi and y in rint dom Phi."
            + _literal(at)
        )
        return found(H_54A, HOLDS, how, value, {"x": x})
    if answer.separator is None:
        return found(H_54A, UNKNOWN, _close(answer.margin), value)
    w = _spread(own, answer.separator)
    least = "<w, e>" if _e(at) else "0"
    how = (
        f"Decided exactly: w separates R(C) from the set: C'w = 0, (D + D')w = 0, and <D w, k> + <w, y> >= {least} for all k in "
        "dom Xi and y in dom Phi." + _literal(at)
    )
    return found(H_54A, VIOLATED, how, value, {"w": w, **_named(at, w)})


def _admissible(at: Setting, hypothesis: Hypothesis, output: np.ndarray) -> Finding:
    """5.x0: C x0 + e = D'k + y + S v; ``output`` (m, 1) is C x0."""
    own = _prepared(at, hypothesis)
    if isinstance(own, Finding):
        return own
    output, name = output + _offset(at), f"(C x0{_e(at)})" if _e(at) else "C x0"
    system = own.system([*_parts(at.D, own), (TAU, -output)], at.m)
    answer = feasibility.decide(system)
    if at.line is not None:
        return _empty(at, hypothesis, at.line, answer)
    if answer.point is not None:
        how = f"Decided exactly: {name} = D'k + y + S v with k in rint dom Xi and y in rint dom Phi." + _literal(at)
        margin = _margin(at, own, output, answer.point)
        value = {"restricting rows": int((~own.loose).sum())} if margin is None else {"margin": margin}
        return found(hypothesis, HOLDS, how, value, {name: exact.doubles(output.ravel())})
    if answer.separator is None:
        return found(hypothesis, UNKNOWN, _close(answer.margin))
    w = _spread(own, answer.separator)
    gap = float(exact.product(answer.separator[None, :], system.A[:, TAU])[0, 0] / max(map(abs, answer.separator)))
    where = "outside the closure of the set" if gap > 0 else "on the boundary of the set, where the theorem says nothing"
    how = (
        f"Decided exactly: -{name} is {where}: <D w, k> + <w, y> - <w, {name}> >= gap for all k in dom Xi and y in dom Phi. "
        f"A start with <w, C x0> larger, or a little resistance in D, changes this.{_literal(at)}"
    )
    return found(hypothesis, VIOLATED, how, {"gap": gap}, {"w": w, **_named(at, w), name: exact.doubles(output.ravel())})


def _spread(own: Domains, separator: np.ndarray) -> np.ndarray:
    """The separator's part in the rows of y, largest entry 1, with 0 in the loose rows."""
    w = np.zeros(own.m)
    kept = separator[: int((~own.loose).sum())]
    w[~own.loose] = exact.doubles(kept / max([abs(entry) for entry in kept if entry], default=1))
    return w


def _close(margin: float) -> str:
    return (
        f"the second-order cones are touched to within rounding (margin {margin:.2g}): neither a point inside nor a separating "
        "vector could be made exact"
    )


def _margin(at: Setting, own: Domains, output: np.ndarray, point: np.ndarray) -> float | None:
    """Largest t so that C x0 stays admissible when each restricting y_i loses t; None where y has other rows than half-lines."""
    from scipy.optimize import linprog

    lines = [columns[0] for columns, matrix in own.y if len(columns) == 1 and np.count_nonzero(matrix) == 1]
    if own.groups or len(lines) < int((~own.loose).sum()):
        return None
    exactly = float(min(point[lines]) / point[0])  # What linear programming cannot resolve.
    A = exact.doubles(own.system([*_parts(at.D, own), (TAU, -output)], at.m).A)
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


def _convex(at: Setting) -> Finding:
    """dom dXi and R(D + dXi), each by a theorem about the law."""
    if at.broken:
        return found(H_54B, UNKNOWN, at.reason)
    domain, image = _domain_convex(at), _range_convex(at)
    if domain and image:
        return found(H_54B, HOLDS, f"By the law: {domain}; {image}.", {"multipliers": at.m})
    if not at.psd:
        return found(H_54B, UNKNOWN, "D is not psd (4.1): R(D + dXi) need not be convex")
    missing = "dom dXi" if not domain else "R(D + dXi)"
    return found(
        H_54B, UNKNOWN, f"{missing} lies between a convex set and its closure; which boundary points belong to it is not decided"
    )


def _domain_convex(at: Setting) -> str:
    """Why dom dXi is convex; empty where it is not known to be."""
    p = at.potential
    if p is None:
        return "dom dXi = K"
    if p.piecewise:
        return "Phi is piecewise linear-quadratic, and so is Xi: dom dXi = dom Xi"
    if at.m == 1 or _separable(at):
        return "dom dXi is a product of intervals"
    if p.Q is not None and exact.psd(p.Q).definite:
        return "Phi is strongly convex: dom dXi is the whole space"
    if p.Q is not None and not p.Q.any() and not any(term.c.any() for term in p.terms):
        return "Phi is affine plus sublinear: dom dXi = -dPhi(0)"
    return ""


def _separable(at: Setting) -> bool:
    """Whether Phi is a sum of functions of one y_i each."""
    split, y = at.model.phi_split, at.model.y
    if split.tau.numel():
        return False
    rows = [ca.jacobian(term.u, y) for term in split.terms]
    alone = all(len({j for _, j in zip(*J.sparsity().get_triplet(), strict=True)}) <= 1 for J in rows)
    hessian = ca.jacobian(ca.gradient(split.smooth, y), y)
    return alone and all(i == j for i, j in zip(*hessian.sparsity().get_triplet(), strict=True))


def _range_convex(at: Setting) -> str:
    """Why R(D + dXi) is convex; empty where it is not known to be."""
    if at.bounded:
        return "K is bounded, so that R(D + dXi) is the whole space (Hartman and Stampacchia)"
    if not at.psd:
        return ""
    if at.everything:
        return "R(D + dXi) is the whole space, by (24)"
    if not at.D.any():
        return "D = 0 and R(dXi) = -dom dPhi = -dom Phi" if at.model.law is None else "D = 0 and R(dXi) is the barrier cone of K"
    law = at.model.law
    if (law is None and at.potential is not None and at.potential.piecewise) or (law is not None and _polyhedral(law)):
        # Cottle's argument: the gap of the monotone complementarity system is a convex quadratic, bounded below by 0 on a
        # polyhedron, hence attained (Frank and Wolfe), and 0 at a minimum: solvable wherever feasible.
        return "D is psd and the law polyhedral: q is in R(D + dXi) wherever the complementarity system is feasible, a polyhedron"
    if law is not None and covers_everything(law, at.D):
        return "R(D + dXi) is the whole space, by (24): no direction of ker(D + D') recedes"
    return ""


def _polyhedral(law: Law) -> bool:
    return all(isinstance(block.shape(), Intervals | Halfspaces) for block in law.blocks)


def _recession(shape: Shape) -> Shape:
    """K_inf."""
    if isinstance(shape, Intervals):
        return Intervals(*(np.where(np.isfinite(end), 0.0, end) for end in shape))
    if isinstance(shape, Round):
        return shape._replace(radius=0)
    return shape._replace(K=np.zeros(len(shape.K))) if isinstance(shape, Halfspaces) else shape


def _hulls(at: Setting) -> Finding:
    if at.broken:
        return found(H_54C, UNKNOWN, at.reason)
    if at.line is not None:
        how = "int dom Upsilon* is empty (5.4a), R(D + dXi) is not: their affine hulls differ."
        return found(H_54C, VIOLATED, how, {"dimension": 0}, {"v": at.line, **_named(at, at.line)})
    if at.domains is None and not at.everything:
        return found(H_54C, UNKNOWN, at.reason)
    if not (at.psd or at.bounded):
        return found(H_54C, UNKNOWN, "D is not psd (4.1), so that (24) does not place the set inside R(D + dXi)")
    how = "int dom Upsilon* is not empty, hence open, and (24) places the set inside R(D + dXi): both hulls are the whole space."
    return found(H_54C, HOLDS, how, {"dimension": at.m})
