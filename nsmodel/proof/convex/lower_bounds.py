"""Is a convex potential bounded below on its domain: proved term by term, by linear programming duality, or on a box's faces.

A quadratic plus weighted |a'x + c| and max(a'x + c, 0) on a polyhedron {N x + h >= 0} is bounded below if and only if its
stationarity system has a solution (Frank and Wolfe): H y + q + sum l_j a_j - N'n = 0, |l_j| <= w_j or 0 <= l_j <= w_j, n >= 0.
That is decided in rational arithmetic. The logarithm of a sum of exponentials differs from the largest exponent by no more than a
number, and counts as that. Polynomials are bounded by sums of squares. Other terms are left out where they have a lower bound of
their own.

Whether a convex quadratic with kinks and logarithms of sums is bounded below on a polyhedron: by duality, exactly.

The least value of a potential on a convex set: exactly for a quadratic, else by IPOPT with kinks as constraints.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import conic, exact, extremum, interval_bounds, polynomial, sum_of_squares, univariate
from nsmodel.proof.convex.directions import infimum_by_directions
from nsmodel.proof.convex.piecewise import polynomial_pieces, split_by_cases
from nsmodel.proof.convex.rules import find_ridges
from nsmodel.proof.convex.sets import ConvexSet
from nsmodel.proof.expression_graph import additive_terms, rewrite_nodes, stack_column
from nsmodel.proof.verdict import suppress_output


class LogSumExpTerm(NamedTuple):
    """A term that stays above sum l_i a_i'x + a number for all l >= 0 with sum l_i = ``weight``; the a_i (n, 1) are rational."""

    a: list[np.ndarray]
    weight: Fraction


class KinkTerm(NamedTuple):
    """A term f(a'x) that stays above l a'x + a number for each l of [low, high] (None: infinite)."""

    a: np.ndarray
    low: Fraction | None
    high: Fraction | None


def decompose_potential(
    g: ca.SX, C: ConvexSet
) -> tuple[polynomial.Quadratic, list[KinkTerm], list[LogSumExpTerm], list[ca.SX]] | None:
    """g as a convex quadratic, kinks, logarithms of sums, and terms with a bound of their own; None where that does not work."""
    total: polynomial.Polynomial = {}
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
        low, _ = interval_bounds.enclose(float(factor) * term, C.x, *C.bounding_box)
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
    ends: list[Any] = []
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
        part = conic.ConicSystem(A[:, left], tuple(own[j] for j in signed if j in own))
        answer = conic.decide_feasibility(part)
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


# Points of the box of a curved set at which g is looked at, all in one call: along its boundary IPOPT may run away.
BOUNDARY_SAMPLES = 512
MINIMISER_OPTIONS = {
    "print_time": False, "error_on_fail": False, "show_eval_warnings": False, "ipopt.print_level": 0, "ipopt.sb": "yes",
    "ipopt.max_iter": 200, "ipopt.tol": 1e-10, "ipopt.bound_relax_factor": 0.0,
}  # fmt: skip


def minimise_potential(g: ca.SX, C: ConvexSet, start: np.ndarray) -> tuple[np.ndarray, float]:
    """(a point of C, the least value of g met), in doubles: the exact minimum of a quadratic, else by IPOPT."""
    f = ca.Function("g", [C.x], [g])
    candidates = [start, np.zeros(C.n)]
    if C.rows.numel() > len(C.affine):  # Along a curved boundary IPOPT may run away; these show that g falls there.
        candidates += list(extremum.samples(*C.bounding_box, BOUNDARY_SAMPLES))
    P = polynomial.as_quadratic(polynomial.read_polynomials(g, C.x)[0], C.n)
    if P is not None:
        solved = exact.solve_linear_system(P.H, -P.q)
        candidates += [exact.doubles(solved).ravel()] if solved is not None else []
    if P is None or C.rows.numel():
        for point in _ipopt_candidates(g, C, start):
            candidates += [np.round(point, digits) for digits in (2, 4, 6, 8)] + [point]
    points = np.array(candidates)
    rows = C.values(points)
    inside = (rows >= -1e-12 * (1 + np.abs(points).max(axis=1, keepdims=True))).all(axis=1)
    values = np.array(f(points.T)).ravel()
    values = np.where(inside & np.isfinite(values), values, np.inf)
    k = int(np.argmin(values))
    return points[k], float(values[k])


def _ipopt_candidates(g: ca.SX, C: ConvexSet, start: np.ndarray) -> list[np.ndarray]:
    """Points of C where g may be least: |u| and max(u, v) replaced by levels above them, roots rounded off; and g as it is."""
    levels, rows = [], []
    softness = ca.SX.sym("softness")

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX:
        if op == ca.OP_SQRT:
            return ca.sqrt(args[0] + softness)
        level = ca.SX.sym(f"level{len(levels)}")
        rows.extend([level - args[0], level - (-args[0] if op == ca.OP_FABS else args[1])])
        levels.append((level, old))
        return level

    def concave_rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX:
        if op != ca.OP_FMIN:
            return rule(op, args, old)
        level = ca.SX.sym(f"level{len(levels)}")
        rows.extend([args[0] - level, args[1] - level])
        levels.append((level, old))
        return level

    smooth = rewrite_nodes(g, rule, (ca.OP_FABS, ca.OP_FMAX, ca.OP_SQRT), C.x, "potential")
    # Concave rows hold |u| and max with weights < 0, min with weights > 0; other points fail the test of the caller.
    domain = (
        rewrite_nodes(C.rows, concave_rule, (ca.OP_FABS, ca.OP_FMAX, ca.OP_FMIN), C.x, "domain") if C.rows.numel() else C.rows
    )
    symbols = stack_column(level for level, _ in levels)
    above = ca.Function("above", [C.x], [stack_column(old for _, old in levels)])
    problem = {"x": ca.vertcat(C.x, symbols), "f": smooth, "g": ca.vertcat(domain, *rows), "p": softness}
    point, found = start, []
    with suppress_output():
        solver = ca.nlpsol("least", "ipopt", problem, MINIMISER_OPTIONS)
        for soft in (1e-8, 1e-16) if ca.depends_on(smooth, softness) else (0.0,):
            answer = np.array(solver(x0=ca.vertcat(point, above(point)), lbg=0, p=soft)["x"]).ravel()[: C.n]
            point = answer if np.isfinite(answer).all() else point
        found.append(point)
        direct = ca.nlpsol("least", "ipopt", {"x": C.x, "f": g, "g": C.rows}, MINIMISER_OPTIONS)
        found.append(np.array(direct(x0=start, lbg=0)["x"]).ravel())
    return [point for point in found if np.isfinite(point).all()]


# A least value below minus this, beside the value at the start, is that
# of a search that ran away: its point is the direction tried.
UNBOUNDED_LEVEL = 1e12


class LowerBoundResult(NamedTuple):
    """What is known of inf g: ``bounded`` True or False where proved, None where not.

    ``bound`` is a rigorous lower bound where there is one (else -inf), ``value`` the least value met, at ``at``, or the bound
    itself where that is proved to be the infimum, but for rounding; ``direction`` is one of unbounded descent.
    """

    bounded: bool | None
    how: str
    bound: float
    value: float
    at: np.ndarray
    direction: np.ndarray | None = None


def decide_bounded_below(g: ca.SX, C: ConvexSet, start: np.ndarray, *, convex: bool) -> LowerBoundResult:
    """Decide inf g > -inf on C.

    Args:
        g: the potential without its domain, finite on C.
        C: the domain.
        start: a point to begin the search for the minimum at.
        convex: whether g is proved convex on all of C, not on a box only.
    """
    at, value = minimise_potential(g, C, start)
    exactly = _quadratic_minimum(g, C)
    if exactly is not None:
        return LowerBoundResult(True, "the minimum of a quadratic, exactly", exactly, max(value, exactly), at)
    alone = infimum_by_directions(g, C)
    if alone is not None:
        how = "a sum of functions of one direction each, bounded by the signs of their derivatives and their limits"
        return LowerBoundResult(True, how, alone.bound, alone.bound if alone.tight else max(value, alone.bound), at)
    low, _ = interval_bounds.enclose(g, C.x, *C.bounding_box)
    bound = float(np.min(low))
    if np.isfinite(bound):
        return LowerBoundResult(True, "bounds of g over its whole domain", bound, max(value, bound), at)
    separate = _separable_polynomial_bound(g, C)
    if separate is not None:
        return LowerBoundResult(
            True, "a sum of polynomials in one state each, bounded exactly", separate, max(value, separate), at
        )
    squares = _sum_of_squares_bound(g, C)
    if squares is not None:
        return LowerBoundResult(True, "a polynomial, bounded by sums of squares (exactly)", squares, max(value, squares), at)
    parts = decompose_potential(g, C)
    if parts is not None:
        P, kinks, largest, rest = parts
        duality = is_dual_feasible(P, kinks, largest, C.outer(at)[0])
        if duality:
            return LowerBoundResult(True, "the stationarity system has an exact solution", bound, value, at)
        if duality is False and not rest and C.is_polyhedron:
            direction = descent_direction(P, kinks, largest, C)
            if direction is not None:
                return LowerBoundResult(
                    False, "a direction of unbounded descent; no multipliers balance it", -np.inf, -np.inf, at, direction
                )
            return LowerBoundResult(None, "bounded below up to rounding only", -np.inf, value, at)
    if convex and np.isfinite(value):
        found = _bound_by_faces(g, C, at, value)
        if found is not None:
            return LowerBoundResult(True, "g is larger on the faces of a box around its minimum, and convex", found, value, at)
    direction = (
        _falling_direction(g, C, at) if value > -UNBOUNDED_LEVEL * (1 + abs(_finite_value(g, C, start))) else _unit_vector(at)
    )
    for ray in (direction, _falling_direction(g, C, start)):
        if ray is not None and _is_unbounded_along_ray(g, C, start, ray):
            return LowerBoundResult(
                False, "g falls without end along a ray (by its leading term there)", -np.inf, -np.inf, at, ray
            )
    if direction is not None:
        return LowerBoundResult(None, "g seems to fall without end", -np.inf, value, at, direction)
    return LowerBoundResult(None, "no lower bound was proved; the least value found is given", -np.inf, value, at)


def _quadratic_minimum(g: ca.SX, C: ConvexSet) -> float | None:
    """The least value of a convex quadratic without constraints, rounded down; None where it is not that."""
    P = polynomial.as_quadratic(polynomial.read_polynomials(g, C.x)[0], C.n)
    if P is None or C.rows.numel() or C.equalities.numel() or not exact.definiteness(P.H).psd:
        return None
    solved = exact.solve_linear_system(P.H, -P.q)
    return None if solved is None else exact.round_down(P.c + exact.matrix_product(P.q.T, solved)[0, 0] / 2)


def _unit_vector(v: np.ndarray) -> np.ndarray:
    """v / |v|, also where |v|^2 overflows."""
    v = v / np.abs(v).max()
    return v / np.linalg.norm(v)


def _finite_value(g: ca.SX, C: ConvexSet, point: np.ndarray) -> float:
    value = float(ca.Function("g", [C.x], [g])(point))
    return value if np.isfinite(value) else 0.0


def _separable_polynomial_bound(g: ca.SX, C: ConvexSet) -> float | None:
    """A lower bound of a sum of polynomials of degree > 2 in one state each, verified exactly; None where there is none."""
    (p,) = polynomial.read_polynomials(g, C.x)
    if p is None or polynomial.degree(p) <= 2 or any(len(monomial) > 1 for monomial in p):
        return None
    total = p.get((), Fraction(0))
    for i in polynomial.variables(p):
        c = polynomial.univariate_coefficients(
            {monomial: number for monomial, number in p.items() if monomial and monomial[0][0] == i}
        )
        a, b = (Fraction(float(end[i])) if np.isfinite(end[i]) else None for end in C.bounding_box)
        least = polynomial.approximate_minimum(c, a, b)
        levels = (
            [Fraction(least) - Fraction(less * (1 + abs(least))) for less in (1e-12, 1e-9, 1e-6)] if np.isfinite(least) else []
        )
        proved = [level for level in levels if polynomial.negative_point([c[0] - level, *c[1:]], a, b) is None]
        if not proved:
            return None
        total += proved[0]
    return exact.round_down(total)


def _sum_of_squares_bound(g: ca.SX, C: ConvexSet) -> float | None:
    """A lower bound of a polynomial of degree > 2 plus terms with bounds of their own; None where there is none."""
    total: polynomial.Polynomial = {}
    rest = Fraction(0)
    for factor, term in additive_terms(g):
        (p,) = polynomial.read_polynomials(term, C.x)
        if p is not None:
            total = polynomial.add_multiple(total, p, factor)
            continue
        low, high = (float(np.ravel(end)[0]) for end in interval_bounds.enclose(term, C.x, *C.bounding_box))
        end = low if factor > 0 else high
        if not np.isfinite(end):
            return None
        rest += factor * Fraction(end)
    if polynomial.degree(total) <= 2:
        return None
    found = sum_of_squares.sos_lower_bound(total, C.n)
    return None if found is None else exact.round_down(found + rest)


# -- other convex functions --------------------------------------------------------------------------------------------


def _bound_by_faces(g: ca.SX, C: ConvexSet, at: np.ndarray, value: float) -> float | None:
    """A lower bound of a convex g on C: its bound on a box around ``at`` on whose faces it is larger than g(at).

    A convex function that is larger at every point of C on the box's boundary than at a point inside grows on along each ray.
    """
    scale = max(1.0, float(np.abs(at).max()))
    slack = float(np.max(interval_bounds.enclose(g, C.x, at, at)[1]))
    for size in (1.0, 10.0, 1000.0):
        low, high = np.maximum(at - size * scale, C.bounding_box[0]), np.minimum(at + size * scale, C.bounding_box[1])
        faces = [
            (i, end)
            for i in range(C.n)
            for end, hull in ((low[i], C.bounding_box[0][i]), (high[i], C.bounding_box[1][i]))
            if end != hull or not np.isfinite(hull)
        ]
        if all(_is_above_on_face(g, C, low, high, i, end, slack) for i, end in faces):
            found = extremum.supremum(-g, C.x, low, high, where=C.rows if C.rows.numel() else None, points=at[None, :])
            bound = -found.bound
            if np.isfinite(bound):
                return float(bound)
    return None


def _is_above_on_face(g: ca.SX, C: ConvexSet, low: np.ndarray, high: np.ndarray, i: int, end: float, level: float) -> bool:
    face_low, face_high = low.copy(), high.copy()
    face_low[i] = face_high[i] = end
    bound, _ = interval_bounds.enclose(g, C.x, face_low, face_high)
    if float(np.min(bound)) > level:
        return True
    found = extremum.supremum(-g, C.x, face_low, face_high, bound_to=-level)
    return bool(found.bound < -level)


def _falling_direction(g: ca.SX, C: ConvexSet, at: np.ndarray) -> np.ndarray | None:
    """A direction along which g keeps falling at three sizes, of the 2 n along the axes and the gradient's."""
    f = ca.Function("g", [C.x], [g, ca.gradient(g, C.x)])
    slope = np.array(f(at)[1]).ravel()
    directions = [*np.eye(C.n), *-np.eye(C.n)]
    if np.isfinite(slope).all() and np.linalg.norm(slope):
        directions.append(-slope / np.linalg.norm(slope))
    for d in directions:
        points = at + np.array([1.0, 1e3, 1e6])[:, None] * d
        values = np.array(f(points.T)[0]).ravel()
        if (C.values(points) >= 0).all() and np.isfinite(values).all() and (np.diff(values) < -1.0).all():
            return d
    return None


def _is_unbounded_along_ray(g: ca.SX, C: ConvexSet, start: np.ndarray, d: np.ndarray) -> bool:
    """Whether the ray start + t d stays in C, exactly, and g tends to -inf on it, by the leading term of its slope."""
    if C.rows.numel() and not (C.is_polyhedron and C.interior_margin(start) is not None):
        return False
    N, _ = C.half_spaces
    if any(number < 0 for number in exact.matrix_product(N, exact.rational(d[:, None])).ravel()):
        return False
    t = ca.SX.sym("t")
    terms = additive_terms(ca.substitute(g, C.x, ca.DM(start) + t * ca.DM(d)))
    found = split_by_cases(terms, t)
    if not found or not np.isfinite(float(ca.Function("g", [C.x], [g])(start))):
        return False
    return univariate.tends_to_minus_infinity(terms, t, found[-1].low[1], found[-1].cases)
