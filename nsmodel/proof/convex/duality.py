"""Whether a convex quadratic with kinks and logarithms of sums is bounded below on a polyhedron: by duality, exactly."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import exact, feasibility, interval, polynomial
from nsmodel.proof.convex.convex_sets import ConvexSet
from nsmodel.proof.convex.piecewise import polynomial_pieces
from nsmodel.proof.convex.ridges import find_ridges


class LogSumExpTerm(NamedTuple):
    """A term that stays above sum l_i a_i'x + a number for all l >= 0 with sum l_i = ``weight``; the a_i (n, 1) are rational."""

    a: list[np.ndarray]
    weight: Fraction


class KinkTerm(NamedTuple):
    """A term f(a'x) that stays above l a'x + a number for each l of [low, high] (None: infinite)."""

    a: np.ndarray
    low: Fraction | None
    high: Fraction | None


def additive_terms(expr: ca.SX) -> list[tuple[Fraction, ca.SX]]:
    """The expression as a sum of factor times term, as far as its graph shows one."""
    out, left = [], [(Fraction(1), expr)]
    while left:
        factor, term = left.pop()
        op = term.op() if not term.is_constant() and not term.is_symbolic() else None
        if op in (ca.OP_ADD, ca.OP_SUB):
            left += [(factor if op == ca.OP_ADD else -factor, term.dep(1)), (factor, term.dep(0))]
        elif op in (ca.OP_NEG, ca.OP_TWICE):
            left.append((factor * (-1 if op == ca.OP_NEG else 2), term.dep(0)))
        elif op == ca.OP_MUL and term.dep(0).is_constant():
            left.append((factor * Fraction(float(term.dep(0))), term.dep(1)))
        elif op in (ca.OP_MUL, ca.OP_DIV) and term.dep(1).is_constant() and float(term.dep(1)):
            number = Fraction(float(term.dep(1)))
            left.append((factor * (number if op == ca.OP_MUL else 1 / number), term.dep(0)))
        else:
            out.append((factor, term))
    return out


def decompose_potential(
    g: ca.SX, C: ConvexSet
) -> tuple[polynomial.Quadratic, list[KinkTerm], list[LogSumExpTerm], list[ca.SX]] | None:
    """g as a convex quadratic, kinks, logarithms of sums, and terms with a bound of their own; None where that does not work."""
    total: polynomial.Polynomial | None = {}
    kinks, largest, rest = [], [], []
    for factor, term in additive_terms(g):
        (p,) = polynomial.read_polynomials(term, C.x)
        if p is not None and polynomial.degree(p) <= 2:
            total = polynomial.add_multiple(total, p, factor)
            continue
        kink, tilt = _as_kink(factor, term, C)
        if kink is not None:
            kinks.append(kink)
            total = polynomial.add_multiple(total, tilt, factor)
            continue
        exponents = _log_sum_exp_slopes(term, C) if factor > 0 else None
        if exponents is not None:
            largest.append(LogSumExpTerm(exponents, factor))
            continue
        low, _ = interval.enclose(float(factor) * term, C.x, *C.bounding_box)
        if not np.isfinite(low).all():
            return None
        rest.append(term)
    P = polynomial.as_quadratic(total, C.n)
    return None if P is None or not exact.definiteness(P.H).psd else (P, kinks, largest, rest)


def _log_sum_exp_slopes(term: ca.SX, C: ConvexSet) -> list[np.ndarray] | None:
    """The slopes a_i (n, 1) of log(sum c_i exp(a_i'x + b_i)), c_i > 0: it is at least each a_i'x + b_i + log c_i."""
    if term.is_constant() or term.is_symbolic() or term.op() not in (ca.OP_LOG, ca.OP_LOG1P):
        return None
    slopes = [exact.zeros(C.n, 1)] if term.op() == ca.OP_LOG1P else []
    for factor, part in additive_terms(term.dep(0)):
        number = factor * Fraction(float(part)) if part.is_constant() else factor
        if number <= 0 or not (part.is_constant() or (not part.is_symbolic() and part.op() == ca.OP_EXP)):
            return None
        (p,) = polynomial.read_polynomials(ca.SX(0) if part.is_constant() else part.dep(0), C.x)
        P = polynomial.as_quadratic(p, C.n) if p is not None and polynomial.degree(p) <= 1 else None
        if P is None:
            return None
        slopes.append(P.q)
    return slopes


def _as_kink(factor: Fraction, term: ca.SX, C: ConvexSet) -> tuple[KinkTerm | None, polynomial.Polynomial]:
    """factor times a term as a kink, plus factor times a polynomial.

    max(u, v) = max(u - v, 0) + v with affine u and v; and a function of one direction that is a polynomial on pieces: its
    slopes at both ends, where they are finite.
    """
    if term.is_constant() or term.is_symbolic():
        return None, {}
    if term.op() in (ca.OP_FMAX, ca.OP_FMIN) and (factor > 0) == (term.op() == ca.OP_FMAX):
        u, v = polynomial.read_polynomials(ca.vertcat(term.dep(0), term.dep(1)), C.x)
        if u is not None and v is not None and max(polynomial.degree(u), polynomial.degree(v)) <= 1:
            sign = 1 if term.op() == ca.OP_FMAX else -1
            found = polynomial.as_quadratic(polynomial.add_multiple(u, v, Fraction(-1)), C.n)
            return (None, {}) if found is None else (KinkTerm(sign * found.q, Fraction(0), abs(factor)), v)
    split = find_ridges(term, C.x)
    if split is None or split.s.numel() != 1:
        return None, {}
    ends = []
    for sign in (-1, 1):
        found = polynomial_pieces(ca.substitute(split.h, split.s, sign * split.s), split.s)
        if found is None:
            return None, {}
        c = [factor * number for number in found[-1].c]
        power = max((k for k, number in enumerate(c) if number), default=0)
        if power > 1 and c[power] < 0:
            return None, {}
        ends.append(None if power > 1 else sign * (c[1] if len(c) > 1 else Fraction(0)))
    if None not in ends and ends[0] > ends[1]:
        return None, {}
    return KinkTerm(split.a.T, ends[0], ends[1]), {}


def is_dual_feasible(P: polynomial.Quadratic, kinks: list[KinkTerm], largest: list[LogSumExpTerm], N: np.ndarray) -> bool | None:
    """Whether H y + q + sum l_j a_j - N'n = 0 can be solved with multipliers in their bounds, exactly; None: undecided."""
    n, m, k = len(P.H), len(kinks), len(N)
    # Columns: y, l (free), tau, n, slacks of the upper and lower bounds of l, shares (all >= 0, tau > 0 wanted).
    first = n + m + 1 + k + 2 * m
    A = exact.zeros(n + 2 * m + len(largest), first + sum(len(part.a) for part in largest))
    column = first
    for i, part in enumerate(largest):  # the shares of one term sum up to its weight
        A[n + 2 * m + i, n + m] = -part.weight
        for a in part.a:
            A[:n, column], A[n + 2 * m + i, column] = a.ravel(), Fraction(1)
            column += 1
    A[:n, :n], A[:n, n + m] = P.H, P.q.ravel()
    if k:
        A[:n, n + m + 1 : n + m + 1 + k] = -N.T
    for j, kink in enumerate(kinks):
        A[:n, n + j] = kink.a.ravel()
        for row, sign, end in ((n + 2 * j, Fraction(-1), kink.high), (n + 2 * j + 1, Fraction(1), kink.low)):
            if end is not None:  # end tau - l = s, or l - end tau = s
                A[row, n + j], A[row, n + m] = sign, -sign * end
                A[row, n + m + 1 + k + row - n] = Fraction(-1)
    return _is_system_solvable(A, list(range(n + m, A.shape[1])), n + m)


def _is_system_solvable(A: np.ndarray, signed: list[int], column: int) -> bool | None:
    """Whether A u = 0 has a solution with u >= 0 on the ``signed`` columns and u > 0 on one of them; None: undecided.

    Columns that a separator shows to be 0 at every solution are left out, until the rest is solved strictly.
    """
    left = list(range(A.shape[1]))
    while column in left:
        own = {j: i for i, j in enumerate(left)}
        part = feasibility.ConicSystem(A[:, left], tuple(own[j] for j in signed if j in own))
        answer = feasibility.decide_feasibility(part)
        if answer.point is not None:
            return True
        if answer.separator is None:
            return None
        z = exact.matrix_product(answer.separator[None, :], part.A).ravel()
        left = [j for j in left if j not in signed or not z[own[j]]]
    return False


def descent_direction(
    P: polynomial.Quadratic, kinks: list[KinkTerm], largest: list[LogSumExpTerm], C: ConvexSet
) -> np.ndarray | None:
    """A direction d of C with H d = 0 along which g falls at a rate clear of rounding, by linear programming."""
    from scipy.optimize import linprog

    n, m = C.n, len(kinks) + len(largest)
    N, _ = (exact.doubles(part) for part in C.half_spaces)
    H, q = exact.doubles(P.H), exact.doubles(P.q).ravel()
    # A kink's rate along d is s >= high a'd, s >= low a'd; a side where it grows faster than linearly is closed.
    rows = [np.hstack([-N, np.zeros((len(N), m))])]
    sizes = [0.0]
    for j, kink in enumerate(kinks):
        a, unit = exact.doubles(kink.a).ravel(), np.eye(m)[j]
        for sign, end in ((1.0, kink.high), (-1.0, kink.low)):
            row = np.append(sign * a, np.zeros(m)) if end is None else np.append(float(end) * a, -unit)
            rows.append(row[None, :])
            sizes.append(0.0 if end is None else abs(float(end)) * float(np.abs(a).max()))
    for j, part in enumerate(largest, len(kinks)):
        for a in (float(part.weight) * exact.doubles(slope).ravel() for slope in part.a):
            rows.append(np.append(a, -np.eye(m)[j])[None, :])
            sizes.append(float(np.abs(a).max()))
    w = np.ones(m)
    bounds = [(-1, 1)] * n + [(None, None)] * m
    A_ub = np.vstack(rows)
    scale = max(np.abs(H).max(initial=0.0), np.finfo(float).tiny)
    kernel = {"A_eq": np.hstack([H / scale, np.zeros((n, m))]), "b_eq": np.zeros(n)} if np.abs(H).any() else {}
    found = linprog(np.append(q, w), A_ub=A_ub, b_ub=np.zeros(len(A_ub)), bounds=bounds, method="highs", **kernel)
    size = np.abs(q).max(initial=0.0) + max(sizes)
    if found.status != 0 or not found.fun < -1e-9 * max(size, np.finfo(float).tiny):
        return None
    return found.x[:n]
