"""A set {x : c(x) >= 0} given by concave rows: is it convex, has it interior, in which box does it lie.

C(p) = {x : c(x, p) >= 0} for all p of a box: is each convex, has each interior, and a set that holds them all.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof import conic, exact, extremum, interval_bounds, polynomial
from nsmodel.proof.convex import rules
from nsmodel.proof.convex.quasiconcave import has_convex_superlevel_set
from nsmodel.proof.domain import NONZERO, domain_conditions
from nsmodel.proof.expression_graph import operation_codes, stack_column
from nsmodel.proof.parameter_hull import mixture_corners
from nsmodel.proof.verdict import HOLDS, SAMPLED, UNKNOWN, VIOLATED, HypothesisPart, not_none, suppress_output

# Points of the box among which two of a set are looked for whose middle is outside: one call of a vector function.
PAIR_SAMPLES = 512


class ConvexSet:
    """{x : rows >= 0, equalities = 0}; ``names`` has one name for each row."""

    def __init__(self, x: ca.SX, rows: ca.SX, names: Sequence[str], equalities: ca.SX | None = None) -> None:
        self.x, self.rows, self.names, self.n = x, rows, tuple(names), x.numel()
        self.equalities = ca.SX(0, 1) if equalities is None else equalities

    @cached_property
    def polynomials(self) -> list[polynomial.Polynomial | None]:
        """Each row as an exact polynomial where it is one."""
        return polynomial.read_polynomials(self.rows, self.x)

    @cached_property
    def affine(self) -> list[int]:
        """The rows that are affine, exactly."""
        return [i for i, p in enumerate(self.polynomials) if p is not None and polynomial.degree(p) <= 1]

    @cached_property
    def half_spaces(self) -> tuple[np.ndarray, np.ndarray]:
        """N (k, n) and h (k, 1), rational: the affine rows are N x + h >= 0."""
        parts = [polynomial.as_quadratic(self.polynomials[i], self.n) for i in self.affine]
        kept = [part for part in parts if part is not None]
        if not kept:
            return exact.zeros(0, self.n), exact.zeros(0, 1)
        return np.hstack([part.q for part in kept]).T, exact.rational([[part.c] for part in kept])

    @property
    def is_polyhedron(self) -> bool:
        """Whether every row is affine."""
        return len(self.affine) == self.rows.numel() and not self.equalities.numel()

    @cached_property
    def bounding_box(self) -> tuple[np.ndarray, np.ndarray]:
        """A box (lower, upper) that holds the set, with infinite ends where no row bounds a state by itself."""
        lower, upper = np.full(self.n, -np.inf), np.full(self.n, np.inf)
        N, h = self.half_spaces
        for row, (number,) in zip(N, h, strict=True):
            used = np.flatnonzero(row.astype(bool))
            if used.size == 1:
                j, end = int(used[0]), -number / row[used[0]]
                if row[j] > 0:
                    lower[j] = max(lower[j], exact.round_down(end))
                else:
                    upper[j] = min(upper[j], exact.round_up(end))
        for p in self.polynomials:
            _narrow_by_ellipsoid(p, self.n, lower, upper)
        _narrow_by_half_spaces(N, h, lower, upper)
        return lower, upper

    def part(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The part of the box that holds the set in another box; the whole side where these do not meet."""
        low, high = np.maximum(self.bounding_box[0], lower), np.minimum(self.bounding_box[1], upper)
        disjoint = low > high
        return np.where(disjoint, self.bounding_box[0], low), np.where(disjoint, self.bounding_box[1], high)

    def outer(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """N, h, rational, of a polyhedron that holds the set: its affine rows and tangents of its concave polynomial rows.

        The tangents touch at the point and one unit along each axis from it.
        """
        N, h = self.half_spaces
        left = [i for i, p in enumerate(self.polynomials) if p is not None and polynomial.degree(p) > 1]
        if not left:
            return N, h
        proved = [i for i, s in zip(left, rules.global_curvatures(self.rows[left], self.x), strict=True) if s.concave]
        base = [Fraction(round(float(entry) * 2**20), 2**20) for entry in point]
        touched = [base, *([b + (sign if j == i else 0) for j, b in enumerate(base)] for i in range(self.n) for sign in (1, -1))]
        for p in (not_none(self.polynomials[i]) for i in proved):
            for x in touched:
                slope = [polynomial.evaluate_polynomial(polynomial.partial_derivative(p, j), x) for j in range(self.n)]
                N = np.vstack([N, exact.rational([slope])])
                offset = polynomial.evaluate_polynomial(p, x) - sum((a * b for a, b in zip(slope, x, strict=True)), Fraction(0))
                h = np.vstack([h, exact.rational([[offset]])])
        return N, h

    @cached_property
    def empty(self) -> tuple[str, ...]:
        """Names of constraints that no point satisfies together, where that is proved; () where it is not.

        By the largest value of a concave quadratic, bounds of a row, on the box that holds the set, or linear programming.
        """
        low, high = self.bounding_box
        for name, p in zip(self.names, self.polynomials, strict=True):
            top = quadratic_maximum(p, self.n)
            if top is not None and top < 0:
                return (name,)
        if (low > high).any():
            return self.names
        for box, alone in (((np.full(self.n, -np.inf), np.full(self.n, np.inf)), True), ((low, high), False)):
            above = np.asarray(interval_bounds.enclose(self.rows, self.x, *box)[1]).ravel() if self.rows.numel() else np.zeros(0)
            if (above < 0).any():
                return (self.names[int(np.argmin(above))],) if alone else self.names
        if self.affine and self.n in conic.implied_zeros(_strict_feasibility_system(self)):
            return tuple(self.names[i] for i in self.affine)
        return ()

    @property
    def bounded(self) -> bool:
        """Whether the box that holds the set is bounded."""
        return bool(np.isfinite(self.bounding_box).all())

    def values(self, points: np.ndarray) -> np.ndarray:
        """The rows (k, m) at points (k, n)."""
        if not self.rows.numel():
            return np.zeros((len(points), 0))
        return np.array(ca.Function("rows", [self.x], [ca.densify(self.rows)])(points.T)).T

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Whether points (k, n) are proved to lie in the set, rounding included."""
        if self.equalities.numel() or not self.rows.numel():
            return np.full(len(points), not self.equalities.numel())
        low, _ = interval_bounds.enclose(self.rows, self.x, points, points)
        return np.all(low.reshape(len(points), -1) >= 0, axis=1)

    def interior_margin(self, point: np.ndarray) -> float | None:
        """A lower bound > 0 of every row at the point, rounding included; None where there is none."""
        if self.equalities.numel():
            return None
        if not self.rows.numel():
            return np.inf
        low, _ = interval_bounds.enclose(self.rows, self.x, point, point)
        least = float(np.min(low))
        return least if least > 0 else None


def natural_domain(g: ca.SX, x: ca.SX) -> ca.SX:
    """Rows u(x) with g finite only where u >= 0: concave arguments of the logarithms and roots that it always evaluates."""
    if ca.OP_CALL in operation_codes(g):  # what cannot be looked into
        return ca.SX(0, 1)
    arguments = [one.u for one in domain_conditions(g) if one.relation != NONZERO and not one.guards and ca.depends_on(one.u, x)]
    return stack_column(u for u in arguments if rules.global_curvatures(u, x)[0].concave)


def is_convex_set(C: ConvexSet, lower: np.ndarray, upper: np.ndarray, *, quick: bool) -> HypothesisPart:
    """Whether every row is concave: by exact arithmetic or the rules of convex functions, else by its Hessian on the box."""
    if not C.rows.numel():
        return HypothesisPart(HOLDS, "no constraint", {}, {})
    left = [i for i in range(C.rows.numel()) if i not in set(C.affine)]
    if left:
        proved = rules.global_curvatures(C.rows[left], C.x)
        left = [i for i, shape in zip(left, proved, strict=True) if not shape.concave]
    if not left:
        return HypothesisPart(HOLDS, "every constraint is concave (affine, or by the rules of convex functions)", {}, {})
    branches = [i for i in left if _is_hyperboloid_branch(C, i)]
    left = [i for i in left if i not in branches]
    if not left:
        how = "every constraint is concave, or keeps one branch of a hyperboloid that an affine one cuts off (exact)"
        return HypothesisPart(HOLDS, how, {}, {})
    left = [i for i in left if not _keeps_convex_set(C, i)]
    if not left:
        how = "each constraint keeps a convex set: concave, a branch of a hyperboloid, or by the rules of quasi-concave functions"
        return HypothesisPart(HOLDS, how, {}, {})
    if C.empty:
        return HypothesisPart(HOLDS, "the set is empty", {}, {})
    low, high = C.part(lower, upper)
    inside = bool((C.bounding_box[0] >= lower).all() and (C.bounding_box[1] <= upper).all())
    for i in left:
        H, slope = ca.hessian(C.rows[i], C.x)
        smooth = interval_bounds.is_continuous(ca.vertcat(C.rows[i], slope), C.x, low, high)
        if not smooth or not extremum.largest_eigenvalue(H, C.x, low, high, bound_to=0.0, quick=quick).bound <= 0:
            return _find_nonconvex_pair(C, i, low, high)
    where = " on the box that holds the set" if inside else ""
    return HypothesisPart(HOLDS, f"every constraint is concave{where}: bounds of its Hessian", {}, {}, not inside)


def _keeps_convex_set(C: ConvexSet, i: int) -> bool:
    """Whether row i keeps a convex part of the box that holds C, which lies where the row has values."""
    own = set_from_rows(C.x, natural_domain(C.rows[i], C.x)).bounding_box
    return has_convex_superlevel_set(C.rows[i], C.x, *C.part(*own)) if (own[0] <= own[1]).all() else True


def quadratic_maximum(p: polynomial.Polynomial | None, n: int) -> Fraction | None:
    """The largest value of a polynomial of degree <= 2 on R^n, exactly; None where it has none, or is of higher degree."""
    found = polynomial.as_quadratic(p, n)
    if found is not None and not found.H.any():
        return None if found.q.any() else found.c
    if found is None or not exact.definiteness(-found.H).psd:
        return None
    at = exact.solve_linear_system(-found.H, found.q)
    return None if at is None else found.c + exact.matrix_product(found.q.T, at)[0, 0] / 2


def has_interior(C: ConvexSet, start: np.ndarray) -> HypothesisPart:
    """Whether there is a strictly feasible point: verified with interval arithmetic; its absence by exact multipliers."""
    if C.empty:
        return HypothesisPart(
            VIOLATED, "C is empty: no point satisfies these constraints", {"points": 0}, {"constraints": list(C.empty)}
        )
    if C.equalities.numel():
        return HypothesisPart(VIOLATED, "an equality leaves no interior", {}, {"equality": str(C.equalities[0])})
    if not C.rows.numel():
        return HypothesisPart(HOLDS, "the whole space", {}, {})
    best: tuple[float, np.ndarray] | None = None
    for point in (_deepest_point(C, start), start):
        margin = None if point is None else C.interior_margin(point)
        if point is not None and margin is not None and (best is None or margin > best[0]):
            best = margin, point
    if best is not None:
        return HypothesisPart(HOLDS, "a strictly feasible point", {"interior margin": best[0]}, {"interior point": best[1]})
    opposed = _affine_infeasibility_weights(C) or (None if C.is_polyhedron else _infeasibility_weights(C, start))
    if opposed is not None:
        how = "no point satisfies these constraints strictly: their weighted sum is never > 0 (exact multipliers)"
        return HypothesisPart(VIOLATED, how, {"interior margin": 0.0}, opposed)
    if C.is_polyhedron:
        point = _exact_interior_point(C)
        if point is not None:
            margin = max(float(C.values(point[None, :]).min()), np.finfo(float).tiny)
            how = "a strictly feasible point, in exact arithmetic; nearer to the boundary than rounding"
            return HypothesisPart(HOLDS, how, {"interior margin": margin}, {"interior point": point})
    return HypothesisPart(UNKNOWN, "no strictly feasible point was found, and no proof that there is none", {}, {})


# -- parts -------------------------------------------------------------------------------------------------------------


def _narrow_by_ellipsoid(p: polynomial.Polynomial | None, n: int, lower: np.ndarray, upper: np.ndarray) -> None:
    """Narrow the box by a row c - x'Px/2 + q'x >= 0 with P definite on the variables that it holds."""
    if p is None or polynomial.degree(p) != 2:
        return
    used = polynomial.variables(p)
    found = polynomial.as_quadratic(p, n)
    if found is None or len(used) > 12:
        return
    P, q = -found.H[np.ix_(used, used)], found.q[used]
    if not exact.definiteness(P).definite:
        return
    inverse = exact.inverse_matrix(P)
    if inverse is None:
        return
    # max of x_i on {x : c + q'x - x'Px/2 >= 0} is m_i + sqrt(2 r (P^-1)_ii), m = P^-1 q, r = c + q'm/2.
    centre = exact.matrix_product(inverse, q)
    r = found.c + exact.matrix_product(q.T, centre)[0, 0] / 2
    for k, i in enumerate(used):
        reach = exact.root_rounded_up(max(2 * r * inverse[k, k], Fraction(0)))
        lower[i] = max(lower[i], exact.round_down(centre[k, 0] - Fraction(reach)))
        upper[i] = min(upper[i], exact.round_up(centre[k, 0] + Fraction(reach)))


def _narrow_by_half_spaces(N: np.ndarray, h: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
    """Give infinite ends of the box a bound, by rows a'x + c >= 0 of which a_j x_j is bounded above for all j but one."""
    rows = [(row, number, np.flatnonzero(row.astype(bool))) for row, (number,) in zip(N, h, strict=True)]
    left = [(row, number, used) for row, number, used in rows if used.size > 1]
    for _ in range(2 * lower.size):
        before = np.isfinite([lower, upper]).sum()
        for row, number, used in left:
            ends = {int(j): upper[j] if row[j] > 0 else lower[j] for j in used}
            free = [j for j, end in ends.items() if not np.isfinite(end)]
            rest = number + sum((row[j] * Fraction(float(end)) for j, end in ends.items() if np.isfinite(end)), Fraction(0))
            for i in free if len(free) == 1 else list(ends) if not free else []:
                bound = -(rest - (Fraction(0) if free else row[i] * Fraction(float(ends[i])))) / row[i]
                if row[i] > 0 and not np.isfinite(lower[i]):
                    lower[i] = exact.round_down(bound)
                elif row[i] < 0 and not np.isfinite(upper[i]):
                    upper[i] = exact.round_up(bound)
        if np.isfinite([lower, upper]).sum() == before:
            return


def _is_hyperboloid_branch(C: ConvexSet, i: int) -> bool:
    """Whether row i and an affine row bound one branch of a hyperboloid: {y'Py/2 + c >= 0, n'y >= 0}, y = x - m, is convex.

    P has one positive eigenvalue, so that {y'Py >= 0} is a convex cone K and -K, and sqrt(y'Py) is concave on K. With P <= 0 on
    the plane n'y = 0 that plane does not meet the interior of K: n'y >= 0 keeps K and, of -K, points with y'Py = 0 alone, which
    c < 0 excludes.
    """
    P = polynomial.as_quadratic(C.polynomials[i], C.n)
    m = None if P is None else exact.solve_linear_system(P.H, -P.q)
    if P is None or m is None or P.c + exact.matrix_product(P.q.T, m)[0, 0] / 2 >= 0:
        return False
    for n, (h,) in zip(*C.half_spaces, strict=True):
        plane = exact.nullspace(n[None, :])
        above = exact.matrix_product(n[None, :], m)[0, 0] + h <= 0
        if above and n.any() and (not plane.size or exact.definiteness(-exact.matrix_product(plane.T, P.H, plane)).psd):
            return True
    return False


def _find_nonconvex_pair(C: ConvexSet, i: int, lower: np.ndarray, upper: np.ndarray) -> HypothesisPart:
    """Row i is not proved concave: look for two points of the set whose middle lies outside."""
    pairs = 0
    for box in ((lower, upper), C.bounding_box):
        points = extremum.samples(*box, PAIR_SAMPLES)
        values = C.values(points)
        inside = points[np.isfinite(values).all(axis=1) & (values >= 0).all(axis=1)]
        half = len(inside) // 2
        a, b = inside[:half], inside[half : 2 * half]
        middle = C.values((a + b) / 2)
        if not half:
            continue
        holes = [k for k in np.flatnonzero(np.isnan(middle[:, i])) if _has_no_value(C.rows[i], C.x, (a[k] + b[k]) / 2)]
        if holes:
            k = holes[0]
            witness = {"constraint": C.names[i], "x": a[k], "y": b[k], "middle": (a[k] + b[k]) / 2}
            how = "two points of the set in whose middle the constraint has no value: the set is not convex"
            return HypothesisPart(VIOLATED, how, {}, witness)
        if not np.isfinite(middle).all():
            continue
        pairs += half
        scaled = middle / (1 + np.abs(C.values(a)) + np.abs(C.values(b)))
        k, row = np.unravel_index(np.argmin(scaled), scaled.shape)
        if scaled[k, row] < -1e-9:
            witness = {"constraint": C.names[row], "x": a[k], "y": b[k], "middle": (a[k] + b[k]) / 2}
            how = "two points of the set whose middle is not in it: the set is not convex"
            return HypothesisPart(VIOLATED, how, {"least value at the middle": float(middle[k, row])}, witness)
    how = f"constraint '{C.names[i]}' is not proved concave; {pairs} pairs of points in the set had their middle in it"
    return HypothesisPart(SAMPLED if pairs else UNKNOWN, how, {"pairs": pairs}, {})


def _has_no_value(row: ca.SX, x: ca.SX, at: np.ndarray) -> bool:
    """Whether a root or a logarithm that is always evaluated is proved to have no value at a point."""
    arguments = [condition.u for condition in domain_conditions(row) if condition.relation != NONZERO and not condition.guards]
    return any(float(np.max(interval_bounds.enclose(u, x, at, at)[1])) < 0 for u in arguments)


def _deepest_point(C: ConvexSet, start: np.ndarray) -> np.ndarray | None:
    """A point of the largest margin (up to 1, rows scaled where they are affine), in doubles."""
    if C.is_polyhedron:
        from scipy.optimize import linprog

        N, h = (exact.doubles(part) for part in C.half_spaces)
        size = np.linalg.norm(N, axis=1)
        cost = np.append(np.zeros(C.n), -1.0)
        A = np.column_stack([-N, size])
        found = linprog(cost, A_ub=A, b_ub=h.ravel(), bounds=[(None, None)] * C.n + [(None, 1.0)], method="highs")
        return found.x[: C.n] if found.status == 0 else None
    return _deepest_point_and_multipliers(C, start)[0]


def _deepest_point_and_multipliers(C: ConvexSet, start: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
    """The point that maximises t subject to c_i(x) >= t and t <= 1, and the multipliers of the rows; None where not finite."""
    t = ca.SX.sym("t")
    problem = {"x": ca.vertcat(C.x, t), "f": -t, "g": C.rows - t}
    options = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "error_on_fail": False, "ipopt.max_iter": 200}
    with suppress_output():
        solver = ca.nlpsol("interior", "ipopt", problem, options)
        least = C.values(start[None, :]).min()
        found = solver(x0=np.append(start, least if np.isfinite(least) else 0.0), lbg=0, ubx=[*[np.inf] * C.n, 1.0])
    point, weights = np.array(found["x"]).ravel()[: C.n], np.abs(np.array(found["lam_g"]).ravel())
    return (point if np.isfinite(point).all() else None), (weights if np.isfinite(weights).all() else None)


def _strict_feasibility_system(C: ConvexSet) -> conic.ConicSystem:
    """N x + h tau = s with tau > 0, s > 0: columns x, tau, s."""
    N, h = C.half_spaces
    A = np.hstack([N, h, -exact.eye(len(N))]) if len(N) else exact.zeros(0, C.n + 1)
    return conic.ConicSystem(A, tuple(range(C.n, A.shape[1])))


def _affine_infeasibility_weights(C: ConvexSet) -> dict[str, Any] | None:
    """Weights >= 0 of affine rows whose sum is never > 0, exactly; None where they have a common interior point."""
    if not C.affine:
        return None
    separator = conic.decide_feasibility(_strict_feasibility_system(C)).separator
    if separator is None:
        return None
    weights = -separator.ravel()  # w'(N, h, -I) = (0, >= 0, >= 0), so that -w >= 0 weighs the rows.
    used = [i for i in range(len(weights)) if weights[i]]
    return {"constraints": [C.names[C.affine[i]] for i in used], "weights": [float(weights[i]) for i in used]}


def _infeasibility_weights(C: ConvexSet, start: np.ndarray) -> dict[str, Any] | None:
    """Weights w >= 0 of rows whose sum w'c is never > 0: of one row by its bounds, of quadratic ones by their largest value.

    The multipliers of max {t : c_i(x) >= t} are such weights where the maximum is not above 0; they are found in doubles, and
    tried as fractions.
    """
    top = np.asarray(interval_bounds.enclose(C.rows, C.x, *C.bounding_box)[1]).ravel()
    if (top <= 0).any():
        i = int(np.argmin(top))
        return {"constraints": [C.names[i]], "weights": [1.0]}
    own = [(i, p) for i, p in enumerate(C.polynomials) if p is not None and polynomial.degree(p) <= 2]
    weights = _deepest_point_and_multipliers(C, start)[1]
    if len(own) < 2 or weights is None:
        return None
    total = sum(weights[i] for i, _ in own)
    for most in (8, 64, 1024, 10**6):
        tried = {i: Fraction(float(weights[i] / total)).limit_denominator(most) if total > 0 else Fraction(0) for i, _ in own}
        combined: polynomial.Polynomial = {}
        for i, p in own:
            combined = polynomial.add_multiple(combined, p, max(tried[i], Fraction(0)))
        sup = quadratic_maximum(combined, C.n)
        if any(number > 0 for number in tried.values()) and sup is not None and sup <= 0:
            used = [i for i, number in tried.items() if number > 0]
            return {"constraints": [C.names[i] for i in used], "weights": [float(tried[i]) for i in used]}
    return None


def _exact_interior_point(C: ConvexSet) -> np.ndarray | None:
    point = conic.decide_feasibility(_strict_feasibility_system(C)).point
    return None if point is None else np.array([float(entry / point[C.n]) for entry in point[: C.n]])


# Parts of the box of parameters that are looked at, each by a search for an inner point; more are left open.
MAX_PARAMETER_CELLS = 128
INTERIOR_MARGIN = "interior margin"


class InteriorProof(NamedTuple):
    """The proof, and a number such that each C(p) has a point no farther from 0."""

    part: HypothesisPart
    reach: float


class MovingSet(NamedTuple):
    """C(p): its rows in x and p, and the box of p."""

    x: ca.SX
    p: ca.SX
    rows: ca.SX
    lower: np.ndarray
    upper: np.ndarray

    @property
    def fixed(self) -> list[int]:
        """The rows that do not depend on p."""
        return [i for i, row in enumerate(ca.vertsplit(self.rows)) if not ca.depends_on(row, self.p)]

    @property
    def moving(self) -> list[int]:
        """The rows that do."""
        return [i for i in range(self.rows.numel()) if i not in self.fixed]

    def at(self, row: int) -> list[ca.SX] | None:
        """Rows free of p, of which this one is a convex combination for each p; None where it is none of such."""
        return mixture_corners(self.rows[row], self.p, self.lower, self.upper)


def set_from_rows(x: ca.SX, rows: ca.SX) -> ConvexSet:
    """{x : rows >= 0}, its rows named by themselves."""
    return ConvexSet(x, rows, [str(row) for row in ca.vertsplit(rows)] if rows.numel() else [])


def outer_set(C: MovingSet) -> ConvexSet:
    """A set that holds C(p) for all p: the rows that do not move, and a box around each of the others.

    Where sum w_k c_k(x) >= 0 some c_k(x) >= 0, so that x lies in the box of one of the {c_k >= 0}.
    """
    rows = [C.rows[i] for i in C.fixed]
    for at in (C.at(i) for i in C.moving):
        hulls = [set_from_rows(C.x, row).bounding_box for row in at or ()]
        for j in range(C.x.numel() if hulls else 0):
            low, high = min(hull[0][j] for hull in hulls), max(hull[1][j] for hull in hulls)
            rows += [C.x[j] - low] * bool(np.isfinite(low)) + [high - C.x[j]] * bool(np.isfinite(high))
    return set_from_rows(C.x, stack_column(rows))


def is_convex_for_all(C: MovingSet, lower: np.ndarray, upper: np.ndarray, *, quick: bool) -> HypothesisPart | None:
    """Whether C(p) is convex for all p: every row is concave in x; None where that is not proved."""
    whole = outer_set(C)
    part = is_convex_set(whole, lower, upper, quick=quick)
    if part.verdict != HOLDS:
        return None
    z, low, high, local = ca.vertcat(C.x, C.p), *whole.bounding_box, part.local
    for i in C.moving:
        at = C.at(i)
        if at is not None and all(shape.concave for shape in rules.global_curvatures(stack_column(at), C.x)):
            continue
        ends = np.append(low, C.lower), np.append(high, C.upper)
        if rules.curvatures(C.rows[i], z, *ends, of=C.x)[0].concave:
            continue
        H = ca.hessian(C.rows[i], C.x)[0]
        inside = whole.part(lower, upper)
        for box, own in ((whole.bounding_box, False), (inside, True)):
            ends = np.append(box[0], C.lower), np.append(box[1], C.upper)
            smooth = interval_bounds.is_continuous(ca.vertcat(C.rows[i], ca.gradient(C.rows[i], C.x)), z, *ends)
            if smooth and extremum.largest_eigenvalue(H, z, *ends, bound_to=0.0, quick=quick).bound <= 0:
                local = local or own
                break
        else:
            return None
    return HypothesisPart(HOLDS, "every constraint is concave in the states for all values", {}, {}, local)


def has_interior_for_all(C: MovingSet, start: np.ndarray) -> InteriorProof | None:
    """Whether each C(p) has a strictly feasible point: one for each cell of p, by bounds of the rows; None: not proved.

    Args:
        C: the sets.
        start: a point to look from.
    """
    if not C.rows.numel():
        return InteriorProof(HypothesisPart(HOLDS, "the whole space", {}, {}), 0.0)
    if not C.moving:
        part = has_interior(set_from_rows(C.x, C.rows), start)
        return InteriorProof(part, _rounded_up_norm(part.witness["interior point"])) if part.verdict == HOLDS else None
    z = ca.vertcat(C.x, C.p)
    left, points, margin, count = [(C.lower, C.upper)], [np.zeros(C.x.numel()), start], np.inf, 0
    used: list[np.ndarray] = []
    while left:
        low, high = left.pop()
        middle, count = low + (high - low) / 2, count + 1
        found = has_interior(set_from_rows(C.x, ca.substitute(C.rows, C.p, ca.DM(middle))), points[-1])
        if found.verdict != HOLDS or count > MAX_PARAMETER_CELLS:
            return None
        own = [*points, *used[-1:], np.asarray(found.witness["interior point"])]
        least = [float(np.min(interval_bounds.enclose(C.rows, z, np.append(x, low), np.append(x, high))[0])) for x in own]
        best = int(np.argmax(least))
        if least[best] > 0:
            margin = min(margin, least[best])
            used.append(own[best])
            continue
        i = int(np.argmax((high - low) / (C.upper - C.lower)))
        if not low[i] < middle[i] < high[i]:
            return None
        cut = np.arange(low.size) == i
        left += [(low, np.where(cut, middle, high)), (np.where(cut, middle, low), high)]
    one = len(used) == 1
    how = f"a strictly feasible point {'for all values' if one else f'in each of {len(used)} cells of the parameters'} (bounds)"
    part = HypothesisPart(HOLDS, how, {INTERIOR_MARGIN: margin}, {"interior point": used[0]} if one else {})
    return InteriorProof(part, max(_rounded_up_norm(point) for point in used))


def _rounded_up_norm(point: np.ndarray) -> float:
    return float(np.linalg.norm(point)) * (1 + 1e-12)
