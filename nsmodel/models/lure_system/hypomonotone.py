"""Assumption 5.2 of Brogliato and Goeleven (2013): R A(-R^{-1} .) + omega I is maximal monotone, R^2 = P.

For continuous A this is P J + J'P <= 2 omega P for the Jacobians J of A: with z = -R x the operator's monotonicity
constant is -omega. The Jacobians lie in the hull of finitely many matrices, plus a cone where an entry is unbounded.

Matrices whose convex hull, with a cone of directions where an entry is unbounded, holds a Jacobian over a box.
"""

from __future__ import annotations

from itertools import product
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Finding, Hypothesis, make_finding
from nsmodel.hypotheses.region import Region
from nsmodel.models.lure_system.model import LureSystem
from nsmodel.models.lure_system.passivity import LURE_PAPER, Passivity
from nsmodel.proof import exact, extremum, interval_bounds, polynomial
from nsmodel.proof.dissipation import ProvedRate, least_rate
from nsmodel.proof.domain import is_defined_on_box
from nsmodel.proof.exact import MACHINE_EPSILON
from nsmodel.proof.expression_graph import (
    CONTINUOUS_OPERATIONS,
    operation_codes,
    rewrite_nodes,
    stack_column,
    stored_entries,
    symbol_hashes,
)
from nsmodel.proof.jumps import find_jump, jump_nodes
from nsmodel.proof.storage_matrix import condition_number, matrix_witness, rational_cholesky, well_conditioned_block
from nsmodel.proof.verdict import not_none

MAX_VARYING_ENTRIES = 6  # Up to so many different varying entries, whose 2^6 corners are proved one by one,
MAX_HULL_STATES = 12  # and so many states, the size of each proof.


class JacobianHull(NamedTuple):
    """All J(x) lie in conv(vertices) + cone(cones); ``sure``: proved, not a sample."""

    vertices: list[np.ndarray]
    cones: list[np.ndarray]
    proved: bool


def bounded_hull(J: ca.SX, x: ca.SX, lower: np.ndarray, upper: np.ndarray) -> JacobianHull | None:
    """Return the hull from interval bounds over a box of x of the varying entries of J (n, n), +-equal entries together.

    None where there are more than MAX_VARYING_ENTRIES of them, or more than MAX_HULL_STATES states.
    """
    n = J.shape[0]
    if n > MAX_HULL_STATES:
        return None
    constant, groups = np.zeros((n, n)), []
    for i, j in np.ndindex(n, n):
        entry = J[int(i), int(j)]
        if not ca.depends_on(entry, x):
            constant[i, j] = float(entry)
            continue
        for expression, pattern in groups:
            sign = 1 if ca.is_equal(entry, expression, 20) else -1 if ca.is_equal(-entry, expression, 20) else 0
            if sign:
                pattern[i, j] = sign
                break
        else:
            pattern = np.zeros((n, n))
            pattern[i, j] = 1
            groups.append((entry, pattern))
    if len(groups) > MAX_VARYING_ENTRIES:
        return None
    ends, cones = [], []
    for entry, pattern in groups:
        low, high = (end.item() for end in interval_bounds.enclose(entry, x, lower, upper))
        finite = sorted({end for end in (low, high) if np.isfinite(end)}) or [0.0]
        ends.append([end * pattern for end in finite])
        cones += [sign * pattern for sign, end in ((-1, low), (1, high)) if not np.isfinite(end)]
    return JacobianHull([constant + sum(choice, start=np.zeros((n, n))) for choice in product(*ends)], cones, True)


def sampled_hull(J: ca.SX, x: ca.SX, lower: np.ndarray, upper: np.ndarray) -> JacobianHull:
    """Return a few values of J in the box: enough to choose a P from."""
    values = ca.Function("J", [x], [J])
    matrices = [np.array(values(point)) for point in extremum.samples(lower, upper, 5)]
    return JacobianHull([M for M in matrices if np.isfinite(M).all()] or [np.zeros(J.shape)], [], False)


def simplify_factors(expr: ca.SX, x: ca.SX) -> ca.SX:
    """Return a scalar expression with fewer repeated factors: x (x + x) as 2 x^2, x sign(x) as |x|; exactly equal to it."""
    if not ca.depends_on(expr, x):
        return expr
    (terms,) = polynomial.read_polynomials(expr, x)
    if terms is not None and all(float(factor) == factor for factor in terms.values()):
        return sum((float(factor) * _monomial(powers, x) for powers, factor in terms.items()), start=ca.SX(0))

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX | None:
        if op == ca.OP_DIV:
            return _half_sign(*args)
        for a, b in (args, args[::-1]):
            if b.op() == ca.OP_SIGN and ca.is_equal(b.dep(0), a, 20):
                return ca.fabs(a)
        return None

    return rewrite_nodes(expr, rule, (ca.OP_MUL, ca.OP_DIV), x, "A")


def _half_sign(top: ca.SX, bottom: ca.SX) -> ca.SX | None:
    """CasADi's derivative of fmax, (a <= b) / ((a <= b) + (b <= a)), as (1 + sign(b - a)) / 2."""
    if top.op() != ca.OP_LE or bottom.op() != ca.OP_ADD:
        return None
    a, b = top.dep(0), top.dep(1)
    for one, other in ((0, 1), (1, 0)):
        if ca.is_equal(bottom.dep(one), top, 20) and ca.is_equal(bottom.dep(other), b <= a, 20):
            return (1 + ca.sign(b - a)) / 2
    return None


def _monomial(powers: polynomial.Monomial, x: ca.SX) -> ca.SX:
    result = ca.SX(1)
    for variable, power in powers:
        result *= (x[variable] ** (power // 2)) ** 2 * (x[variable] if power % 2 else 1)
    return result


HYPOMONOTONE = Hypothesis(
    "5.2", "R A(-R^{-1} .) + omega I is maximal monotone for some omega, R^2 = P", f"{LURE_PAPER}, Assumption 5.2"
)
P_OMEGA = "P_omega"  # of the P of this assumption; 5.1 has another one


class HypomonotoneBound(NamedTuple):
    """What 5.2 gives.

    Attributes:
        finding: the verdict.
        P: (n, n) of Fractions, the P of ``omega``; None where there is none.
        omega: |x(t) - y(t)|_P <= e^{omega t} |x_0 - y_0|_P; inf where none is known.
        everywhere: whether this is for all states, not on the box alone.
        accuracy: an omega below this may be 0 in truth.
    """

    finding: Finding
    P: np.ndarray | None = None
    omega: float = np.inf
    everywhere: bool = True
    accuracy: float = 0.0


def hypomonotone(model: LureSystem, passivity: Passivity, region: Region, quick: bool) -> HypomonotoneBound:
    """Decide 5.2 with an omega as small as can be found.

    Args:
        model: bound.
        passivity: the decision on 5.1.
        region: where A' is bounded if it is not bounded everywhere.
        quick: no semidefinite programs, no searches.
    """
    A, x = model.A, model.x
    J = ca.densify(ca.jacobian(A, x))
    if passivity.pairing is None:
        numbers = {}
        if not ca.depends_on(J, x):
            M = _dense_numbers(J)
            numbers = {"omega for P = I": np.linalg.eigvalsh((M + M.T) / 2)[-1]}
        why = "no P > 0 with P B = C' exists" if passivity.finding.verdict == VIOLATED else "no P with P B = C' is known"
        return HypomonotoneBound(
            make_finding(HYPOMONOTONE, UNKNOWN, f"{why} (5.1), and R is the square root of such a P", numbers)
        )
    if not ca.depends_on(J, x) and not np.isfinite(_dense_numbers(J)).all():
        return HypomonotoneBound(make_finding(HYPOMONOTONE, UNKNOWN, "A has a coefficient that is not finite"))
    if not ca.depends_on(J, x) and is_drift_affine(A, x):
        rate = least_rate(not_none(passivity.pairing), [_dense_numbers(J)], quick=quick)
        return _growth_finding(passivity, rate, quick, "A is linear; proved in rational arithmetic", linear=True)
    return _nonlinear_growth(J, model, passivity, region, quick)


def is_drift_affine(A: ca.SX, x: ca.SX) -> bool:
    """Whether A, whose Jacobian in x is constant, is affine: it does not jump, and has a value everywhere."""
    z = ca.vertcat(x, *(symbol for symbol in ca.symvar(A) if symbol.element_hash() not in symbol_hashes(x)))
    everywhere = np.full(z.numel(), np.inf)
    return not jump_nodes(A, x) and is_defined_on_box(A, x, z, -everywhere, everywhere)


def _nonlinear_growth(J: ca.SX, model: LureSystem, passivity: Passivity, region: Region, quick: bool) -> HypomonotoneBound:
    A, x, n = model.A, model.x, model.x.numel()
    filled = ca.sparsify(J)
    J = ca.densify(ca.SX(filled.sparsity(), stack_column(simplify_factors(entry, x) for entry in stored_entries(filled))))
    infinite = np.full(n, np.inf)
    jump = _jump_finding(A, x)
    if jump is not None:
        return HypomonotoneBound(jump)
    if is_drift_continuous(A, x, -infinite, infinite):
        hull = bounded_hull(J, x, -infinite, infinite)
        rate = least_rate(not_none(passivity.pairing), hull.vertices, hull.cones, quick=quick) if hull is not None else None
        if rate is not None:
            return _growth_finding(passivity, rate, quick, "proved in rational arithmetic, from bounds of the entries of A'")
    if not is_drift_continuous(A, x, region.lower, region.upper):
        how = "A is not seen to be continuous on the box, though no jump was found"
        return HypomonotoneBound(make_finding(HYPOMONOTONE, UNKNOWN, how))
    hull = bounded_hull(J, x, region.lower, region.upper) or sampled_hull(J, x, region.lower, region.upper)
    rate = least_rate(not_none(passivity.pairing), hull.vertices, hull.cones, quick=quick)
    if rate is None:
        return HypomonotoneBound(
            make_finding(HYPOMONOTONE, UNKNOWN, "A' is not bounded on the box, and no P is found that allows for it")
        )
    if not hull.proved or not quick:
        rate = _rate_on_box(J, x, not_none(passivity.pairing).storage_matrix(rate.Y), region, rate, hull.proved, quick)
    if rate is None:
        return HypomonotoneBound(
            make_finding(HYPOMONOTONE, UNKNOWN, "no bound of the largest eigenvalue of sym(R A' R^{-1}) on the box is found")
        )
    return _growth_finding(passivity, rate, quick, "proved by bounds over the whole box", region)


def _rate_on_box(
    J: ca.SX, x: ca.SX, P: np.ndarray, region: Region, rate: ProvedRate, certain: bool, quick: bool
) -> ProvedRate | None:
    """The rate of the same P from the largest eigenvalue over the box, where that is known to be smaller.

    With doubles S for which S'P S = I + E, |E| <= e < 1, and sym(S'P J S) <= mu I: omega P - sym(P J) is psd as soon as
    omega (1 + e) >= mu, omega < 0, or omega (1 - e) >= mu, omega >= 0. S'P is rounded to doubles, and CasADi rounds what is
    constant in the product: both are bounded by means of |J| on the box.
    """
    n = len(P)
    try:
        S = np.linalg.inv(rational_cholesky(P)).T
    except np.linalg.LinAlgError:
        return rate if certain else None
    exactly = exact.matrix_product(exact.rational(S).T, P)
    left, E = exact.doubles(exactly), exact.matrix_product(exactly, S) - exact.eye(n)
    e = _slightly_above(sum(abs(entry) for entry in E.ravel()))
    size = np.abs(interval_bounds.enclose(J, x, region.lower, region.upper)).max(axis=0).reshape(n, n)
    if not (e < 0.5 and np.isfinite(size).all()):
        return rate if certain else None
    similar = ca.DM(left) @ J @ ca.DM(S)
    top = extremum.largest_eigenvalue(similar, x, region.lower, region.upper, quick=quick, bound_alone=True)
    unseen = 8 * n * MACHINE_EPSILON * float((np.abs(left) @ size @ np.abs(S)).sum())
    mu = top.bound + unseen
    bound = _slightly_above(mu / (1 + e) if mu < 0 else mu / (1 - e))
    if certain and rate.omega <= bound:
        return rate
    return rate._replace(omega=bound) if np.isfinite(bound) else None


def _slightly_above(number: Any) -> float:
    """A double a little above."""
    near = float(number)
    return near + 4 * MACHINE_EPSILON * abs(near)


def _growth_finding(
    passivity: Passivity, rate: ProvedRate | None, quick: bool, proof: str, region: Region | None = None, linear: bool = False
) -> HypomonotoneBound:
    """The finding for a rate, on a region or everywhere; the verdict is no better than that on 5.1, whose P it needs."""
    verdict = HOLDS if passivity.finding.verdict == HOLDS else SAMPLED
    if rate is None:  # A linear, ill conditioned beyond the last rounding: Remark 5.3 iii).
        P = not_none(passivity.pairing).storage_matrix(well_conditioned_block(not_none(passivity.pairing)))
        how = "A is linear, and Lipschitz (Remark 5.3); no useful omega is found"
        witness = matrix_witness(P_OMEGA, P)
        return HypomonotoneBound(
            make_finding(HYPOMONOTONE, verdict, how, {"cond P": condition_number(witness[P_OMEGA])}, witness), P
        )
    P = not_none(passivity.pairing).storage_matrix(rate.Y)
    witness = matrix_witness(P_OMEGA, P)
    texts = [f"{proof} for {P_OMEGA}" + ("" if len(witness) == 1 else " as fractions, which are in the data; doubles are shown")]
    if verdict == SAMPLED:
        texts.append("which solves P B = C' up to rounding")
    if abs(rate.omega) <= rate.rounding and rate.omega:
        texts.append("omega is zero up to rounding of A")
    elif 0 < rate.omega <= rate.accuracy:
        texts.append("omega is zero up to the accuracy of the search for P")
    elif linear and rate.omega <= rate.least + 1e-6 * abs(rate.least):
        texts.append(f"no P gives less (floating point): {P_OMEGA} attains the infimum")
    elif linear:
        texts.append(f"no P gives less than {rate.least:.4g} (floating point), which {P_OMEGA} does not attain")
        texts.append("a smaller omega was not looked for" if quick else "a smaller omega may need a worse conditioned P")
    texts.append(f"cond P, in floating point, is that of {P_OMEGA}")
    value = {"omega": rate.omega, "cond P": condition_number(witness[P_OMEGA])}
    scope = None if region is None else region.scope(True)
    finding = make_finding(HYPOMONOTONE, verdict, "; ".join(texts), value, witness, scope)
    return HypomonotoneBound(finding, P, rate.omega, region is None, rate.accuracy)


def _jump_finding(A: ca.SX, x: ca.SX) -> Finding | None:
    """A jump of A: a single-valued maximal monotone operator on all of R^n is continuous."""
    infinite = np.full(x.numel(), np.inf)
    jump = find_jump(A, x, -infinite, infinite, lambda points: np.full(len(points), True))
    values = np.array(ca.Function("A", [x], [A])(extremum.samples(-np.ones(x.numel()), np.ones(x.numel()), 256).T))
    if jump is None or jump.size <= 1e-6 * np.abs(values[np.isfinite(values)]).max(initial=0.0):
        return None
    how = "A jumps, and no single-valued operator that jumps is maximal monotone; write the jump as a relay law"
    witness = {"x": jump.at, "A on one side": jump.below, "A on the other": jump.above}
    return make_finding(HYPOMONOTONE, VIOLATED, how, {"jump": jump.size}, witness)


def is_drift_continuous(A: ca.SX, x: ca.SX, lower: np.ndarray, upper: np.ndarray) -> bool:
    """Whether A is proved continuous: read off its operations, or by interval bounds."""
    return operation_codes(A) <= CONTINUOUS_OPERATIONS or interval_bounds.is_continuous(A, x, lower, upper)


def _dense_numbers(matrix: ca.SX) -> np.ndarray:
    return np.array(ca.DM(matrix)).reshape(matrix.shape)
