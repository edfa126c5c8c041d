"""The domains of Xi and of Phi as rational cones, read off a law or a convex potential.

For a law, Xi is the indicator of K and Phi(y) the supremum of <-y, l> over K; for a potential, Xi(z) = Phi*(-z). Points of both
relative interiors are written as linear images of columns u that are free, > 0 or inside a second-order cone, homogenised by
tau > 0 and subject to linear rows: k = tau times a point of rint dom Xi, y = tau times a point of rint dom Phi. The relative
interior of an image is the image of the relative interior, and rint dom (f + g)* = rint dom f* + rint dom g*.

The domains of a convex potential and of its conjugate.

Assumption 3.1 of a Lur'e system: the domain of Xi has an interior, where Xi is then continuous.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, UNKNOWN, VIOLATED, Finding, Hypothesis, make_finding
from nsmodel.hypotheses.region import domain_rows, potential_without_domain
from nsmodel.modeling.convex_split import ConvexSplit, ConvexTerm
from nsmodel.modeling.expressions import evaluate_at_samples, sample_points
from nsmodel.modeling.laws import Law, LawFactor
from nsmodel.modeling.laws.base import ExactSet, Halfspaces, Intervals, RoundSet, SecondOrder
from nsmodel.models.lure_system.model import LureSystem
from nsmodel.proof import conic, exact, interval_bounds, polynomial
from nsmodel.proof.conic import ConicSystem
from nsmodel.proof.convex import rules

TAU_COLUMN = [0]  # The column of tau.
ColumnPart = tuple[list[int], Any]  # columns and the matrix (., columns) that they are multiplied with


class UndecidedDomain(Exception):
    """A domain that cannot be written with these cones; the message is the reason."""


class EmptyDomain(UndecidedDomain):
    """A domain without a point."""


@dataclass
class Domains:
    """rint dom Xi and rint dom Phi of m multipliers over a list of columns.

    Attributes:
        k, y: parts whose sums are k and y.
        loose: (m,) whether y_i may take any value whatever the other columns are.
        across: matrices (., m) whose common kernel is (dom Phi - dom Phi)^perp.
        flat: matrices (., m) whose common kernel is the lineality space of the dual of dom Xi_inf.
        kinds, groups, rows: of the columns: "free", "positive" or "cone"; the second-order cones; rows that are 0.
    """

    m: int
    k: list[ColumnPart] = field(default_factory=list)
    y: list[ColumnPart] = field(default_factory=list)
    loose: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    across: list[Any] = field(default_factory=list)
    flat: list[Any] = field(default_factory=list)
    kinds: list[str] = field(default_factory=lambda: ["positive"])
    groups: list[tuple[int, ...]] = field(default_factory=list)
    rows: list[list[ColumnPart]] = field(default_factory=list)

    def add(self, size: int, kind: str) -> list[int]:
        """Return the indices of ``size`` new columns; kind "cone" makes one second-order cone of them."""
        own = list(range(len(self.kinds), len(self.kinds) + size))
        self.kinds += [kind] * size
        if kind == "cone":
            self.groups.append(tuple(own))
        return own

    def between(self, direction: Any, low: Any, width: Any) -> None:
        """Add s direction to k, low < s < low + width."""
        above, below = self.add(1, "positive"), self.add(1, "positive")
        self.rows.append([(above, [[1.0]]), (below, [[1.0]]), (TAU_COLUMN, [[-Fraction(width)]])])
        column = exact.rational(direction).reshape(-1, 1)
        self.k += [(TAU_COLUMN, Fraction(low) * column), (above, column)]

    def system(self, equation: list[ColumnPart], more: int = 0) -> ConicSystem:
        """The rows of ``equation`` whose y is not loose, and all rows between columns; ``more`` free columns at the end."""
        n = len(self.kinds) + more
        keep = np.flatnonzero(~self.loose)
        blocks = [_assemble_rows([(own, exact.rational(M)[keep]) for own, M in equation], len(keep), n)]
        blocks += [_assemble_rows(parts, len(parts[0][1]), n) for parts in self.rows]
        positive = tuple(j for j, kind in enumerate(self.kinds) if kind == "positive")
        return ConicSystem(np.vstack(blocks), positive, tuple(self.groups))

    def stack_matrices(self, parts: list[Any]) -> np.ndarray:
        """Matrices (., m) as one."""
        return np.vstack([exact.zeros(0, self.m), *(exact.rational(part) for part in parts)])


def _assemble_rows(parts: list[ColumnPart], rows: int, columns: int) -> np.ndarray:
    A = exact.zeros(rows, columns)
    for own, matrix in parts:
        A[:, own] = A[:, own] + exact.rational(matrix)
    return A


def domains_of_law(law: Law, D: np.ndarray, changed: Callable[[ExactSet], ExactSet] = lambda shape: shape) -> Domains:
    """The domains for -y ∈ N_K(l): dom Xi = K, rint dom Phi = rint K_inf*.

    ``changed`` makes other sets of its blocks. l_i of boxes and balls is left out where it meets no row of D'l whose y is not
    loose: its interval is not empty.

    Raises:
        Empty: K is empty.
        Undecided: a block has no exact shape.
    """
    shapes = [changed(_exact_shape(block)) for block in law.blocks]
    found = Domains(law.size, loose=_unrestricted_flags(law, shapes))
    seen = (D[:, ~found.loose] != 0).any(axis=1)
    for (rows, block), shape in zip(law.parts(), shapes, strict=True):
        unit = np.eye(law.size)[:, rows]
        if isinstance(shape, Intervals):
            for i, low, up in zip(range(rows.start, rows.stop), *shape, strict=True):
                _add_interval_block(found, np.eye(law.size)[:, [i]], low, up, bool(seen[i]))
        elif isinstance(shape, RoundSet):
            _add_ball_block(found, unit, shape, bool(seen[rows].any()), block.label)
        elif isinstance(shape, SecondOrder):
            found.k.append((found.add(block.size, "cone"), unit))
            found.y.append((found.add(block.size, "cone"), unit))
            found.across.append(unit.T)
            found.flat.append(unit.T)
        else:
            _add_polyhedron_block(found, unit, shape.H, shape.K)
    return found


def _exact_shape(block: LawFactor) -> ExactSet:
    shape = block.shape()
    if shape is None:
        raise UndecidedDomain(f"the set of '{block.label}' has no exact form")
    return shape


def unrestricted_outputs(law: Law) -> np.ndarray:
    """(m,) whether l_i is bounded by its own box or ball, so that y_i may take any value."""
    return _unrestricted_flags(law, [_exact_shape(block) for block in law.blocks])


def _unrestricted_flags(law: Law, shapes: Sequence[ExactSet]) -> np.ndarray:
    flags = [
        np.isfinite(shape).all(axis=0) if isinstance(shape, Intervals) else np.full(block.size, isinstance(shape, RoundSet))
        for block, shape in zip(law.blocks, shapes, strict=True)
    ]
    return np.concatenate([np.zeros(0, bool), *flags])


def _add_interval_block(found: Domains, unit: np.ndarray, low: float, up: float, seen: bool) -> None:
    """low <= l_i <= up; K_inf* is R, a half-line or {0}."""
    if np.isinf(low) and np.isinf(up):
        found.flat.append(unit.T)
        if seen:
            found.k.append((found.add(1, "free"), unit))
        return
    found.across.append(unit.T)
    if np.isfinite(low) and np.isfinite(up):
        if seen and low < up:
            found.between(unit, low, Fraction(up) - Fraction(low))
        elif seen:
            found.k.append((TAU_COLUMN, low * unit))
        return
    sign, end = (1, low) if np.isfinite(low) else (-1, up)
    found.flat.append(unit.T)
    found.y.append((found.add(1, "positive"), sign * unit))
    if seen:
        found.k += [(TAU_COLUMN, end * unit), (found.add(1, "positive"), sign * unit)]


def _add_ball_block(found: Domains, unit: np.ndarray, shape: RoundSet, seen: bool, label: str) -> None:
    found.across.append(unit.T)
    if shape.radius and seen:
        if shape.A is None:
            raise UndecidedDomain(f"the set of '{label}' is no linear image of a ball in fractions")
        own = found.add(unit.shape[1] + 1, "cone")
        found.rows.append([(own[:1], [[1]]), (TAU_COLUMN, [[-shape.radius]])])
        found.k.append((own[1:], exact.matrix_product(exact.rational(unit), exact.rational(shape.A))))


def _add_polyhedron_block(found: Domains, unit: np.ndarray, H: np.ndarray, K: np.ndarray) -> None:
    """{l : H l >= K}: slacks > 0 but for the rows that are equalities on all of the set; K_inf* = H' R+^r."""
    own = found.add(H.shape[1], "free")
    add_slack_rows(found, own, H, K)
    found.k.append((own, unit))
    found.y.append((found.add(len(K), "positive"), unit @ H.T))
    found.across.append(H @ unit.T)
    receding = exact.nullspace(H[implicit_equalities(H, np.zeros(len(K)))])
    found.flat.append(exact.matrix_product(receding.T, unit.T))


def add_slack_rows(found: Domains, own: list[int], H: np.ndarray, K: np.ndarray) -> list[int]:
    """Rows H u >= tau K, strict where they can be; returns the indices of those that are equalities on all of the set."""
    implied = implicit_equalities(H, K)
    strict = [i for i in range(len(K)) if i not in implied]
    for rows in (implied, strict):
        if rows:
            parts = [(own, H[rows]), (TAU_COLUMN, -K[rows].reshape(-1, 1))]
            found.rows.append(parts if rows is implied else [*parts, (found.add(len(rows), "positive"), -np.eye(len(rows)))])
    return implied


def slack_system(H: np.ndarray, K: np.ndarray) -> ConicSystem:
    """H l - tau K - s = 0 with tau, s > 0: solvable if and only if some l has H l > K. Columns tau, l, s."""
    r, n = H.shape
    A = np.hstack([exact.rational(-K.reshape(-1, 1)), exact.rational(H), exact.rational(-np.eye(r))])
    return ConicSystem(A, (0, *range(1 + n, 1 + n + r)))


def implicit_equalities(H: np.ndarray, K: np.ndarray) -> list[int]:
    """Rows of H l >= K that are equalities on all of the set.

    Raises:
        Empty: no l has H l >= K.
    """
    zero = conic.implied_zeros(slack_system(H, K)) if len(K) else []
    if 0 in zero:
        raise EmptyDomain("it is empty: its conditions contradict each other")
    return [j - 1 - H.shape[1] for j in zero]


BOUNDING_TERMS = ("indicator", "equality", "cone")  # terms of a potential that bound its domain


class AffineTerm(NamedTuple):
    """A term of a potential with numbers: kind and weight as in :class:`Term`, u = J y + c."""

    kind: str
    weight: float
    J: np.ndarray
    c: np.ndarray


class ConvexPotential(NamedTuple):
    """What is known of Phi.

    Attributes:
        Q, b: of the smooth part y'Qy/2 + b'y + ..., rational; None where it is not quadratic, or nested terms hide it.
        terms: those whose argument is affine and holds no nested level; all of them where Q is given.
        finite: whether Phi is finite everywhere.
        unknown: why its domain is not known; empty where it is.
    """

    Q: np.ndarray | None
    b: np.ndarray | None
    terms: tuple[AffineTerm, ...]
    finite: bool
    unknown: str = ""

    @property
    def bounds(self) -> list[AffineTerm]:
        """The terms that bound the domain."""
        return [term for term in self.terms if term.kind in BOUNDING_TERMS]

    @property
    def piecewise(self) -> bool:
        """Whether Phi is piecewise linear-quadratic."""
        return self.Q is not None and all(term.kind not in ("norm", "cone") for term in self.terms)


def read_potential(phi: ca.SX, split: ConvexSplit, y: ca.SX) -> ConvexPotential:
    """Read a potential.

    Raises:
        Undecided: it is not proved to be convex.
    """
    m, z = y.numel(), ca.vertcat(y, split.tau)
    try:
        terms, unknown = _affine_terms(split, y), ""
    except UndecidedDomain as reason:
        terms, unknown = (), str(reason)
    form = None if unknown or split.tau.numel() else polynomial.as_quadratic(polynomial.read_polynomials(split.smooth, y)[0], m)
    if form is not None:
        if not exact.definiteness(form.H).psd:
            raise UndecidedDomain("phi is not convex: its smooth part has an indefinite Hessian")
        return ConvexPotential(form.H, form.q, terms, not any(term.kind in BOUNDING_TERMS for term in terms))
    if not rules.global_curvatures(potential_without_domain(phi, y, "phi"), y)[0].convex:
        raise UndecidedDomain("phi is not proved to be convex")
    finite = interval_bounds.is_continuous(phi, y, *_whole_space_bounds(m))
    if not (
        finite
        or unknown
        or interval_bounds.is_continuous(ca.vertcat(split.smooth, split.epigraph), z, *_whole_space_bounds(z.numel()))
    ):
        unknown = "the smooth part of phi is not proved to be finite everywhere: its domain is not known"
    if unknown and not finite and not _is_proper(phi, y):
        raise UndecidedDomain(f"{unknown}; nor is phi proved to be convex and finite somewhere")
    return ConvexPotential(None, None, terms, finite, unknown)


def _is_proper(phi: ca.SX, y: ca.SX) -> bool:
    """Whether the domain is proved to be convex, and phi is finite at a sample point."""
    rows, equal = domain_rows(phi, y, "phi")
    shapes = rules.global_curvatures(ca.vertcat(ca.SX(0, 1), *rows, *equal), y)
    bounds_good = all(shape.concave and (i < len(rows) or shape.convex) for i, shape in enumerate(shapes))
    return bounds_good and bool(
        np.isfinite(evaluate_at_samples(phi, y, np.vstack([np.zeros((1, y.numel())), sample_points(y.numel(), 200)]))).any()
    )


def _whole_space_bounds(n: int) -> tuple[np.ndarray, np.ndarray]:
    return np.full(n, -np.inf), np.full(n, np.inf)


def _affine_terms(split: ConvexSplit, y: ca.SX) -> tuple[AffineTerm, ...]:
    terms = [_affine_term(term, y) for term in split.terms if not _is_nested_level(term, split.tau)]
    return tuple(term for term in terms if term.weight)


def _is_nested_level(term: ConvexTerm, tau: ca.SX) -> bool:
    """Whether a term is part of a nested one and bounds no domain."""
    if not tau.numel() or not ca.depends_on(term.u, tau):
        return False
    if term.kind in ("abs", "max", "norm") or (
        term.kind == "cone" and any(bool(ca.is_equal(term.u[0], s, 5)) for s in ca.vertsplit(tau))
    ):
        return True
    raise UndecidedDomain(f"the domain of phi has a nested bound, {term.u}: write it with separate conditions")


def _affine_term(term: ConvexTerm, y: ca.SX) -> AffineTerm:
    m = y.numel()
    forms = [polynomial.as_quadratic(p, m) for p in polynomial.read_polynomials(term.u, y)]
    flat = [form for form in forms if form is not None and not form.H.any()]
    if len(flat) < len(forms):
        raise UndecidedDomain(f"phi holds {term.kind}({term.u}), which is curved inside: its domain is no polyhedron or cone")
    J = np.array([form.q.ravel() for form in flat], dtype=object).reshape(-1, m)
    weight = 1.0 if term.kind in BOUNDING_TERMS else float(ca.DM(term.weight))
    return AffineTerm(term.kind, weight, J, np.array([form.c for form in flat], dtype=object))


def domains_of_potential(p: ConvexPotential, m: int, coupled: bool) -> Domains:
    """The domains of Xi(z) = Phi*(-z) and of Phi; ``coupled`` says that k is needed (D is not 0).

    Raises:
        Empty: no point is seen inside all the sets that bound the domain of Phi.
        Undecided: that domain is not known; k is needed and the smooth part is not quadratic.
    """
    if p.unknown and not p.finite:
        raise UndecidedDomain(p.unknown)
    found = Domains(m, loose=np.full(m, p.finite))
    if p.finite:
        return found
    own = found.add(m, "free")
    found.y.append((own, np.eye(m)))
    normals = _add_bounding_rows(found, own, p.bounds)
    found.across.append(exact.nullspace(normals).T if len(normals) else exact.eye(m))
    found.flat += [term.J for term in p.bounds]
    if found.groups and conic.decide_feasibility(found.system([])).point is None:
        raise EmptyDomain("no point is seen inside all the cones that bound it")
    if coupled:
        if p.Q is None:
            raise UndecidedDomain("the smooth part of phi is not quadratic, and D is not 0: the domain of Xi is not known")
        found.k += [
            (TAU_COLUMN, exact.matrix_product(p.b, [[-1]])),
            (found.add(m, "free"), exact.matrix_product(p.Q, -np.eye(m))),
        ]
        for term in p.terms:
            _add_term_multipliers(found, term)
    return found


def _add_bounding_rows(found: Domains, own: list[int], bounds: list[AffineTerm]) -> np.ndarray:
    """Rows for y in rint dom Phi; returns the normals of its affine hull (., m)."""
    m = len(own)
    planes = [(term.J, -term.c) for term in bounds if term.kind == "indicator"]
    planes += [(sign * term.J, -sign * term.c) for term in bounds if term.kind == "equality" for sign in (1, -1)]
    H = np.vstack([exact.zeros(0, m), *(J for J, _ in planes)])
    K = np.concatenate([exact.zeros(0, 1).ravel(), *(c for _, c in planes)])
    implied = add_slack_rows(found, own, H, K)
    for term in bounds:
        if term.kind == "cone":
            inside = found.add(len(term.c), "cone")
            found.rows.append([(own, term.J), (TAU_COLUMN, term.c.reshape(-1, 1)), (inside, -np.eye(len(term.c)))])
    return H[implied]


def _add_term_multipliers(found: Domains, term: AffineTerm) -> None:
    """J' l' with l' in the relative interior of the term's own set of multipliers."""
    w = Fraction(term.weight)
    if term.kind in ("abs", "max"):
        for row in term.J:
            found.between(row, -w, w if term.kind == "max" else 2 * w)
    elif term.kind == "norm":
        own = found.add(len(term.J) + 1, "cone")
        found.rows.append([(own[:1], [[1.0]]), (TAU_COLUMN, [[-w]])])
        found.k.append((own[1:], term.J.T))
    else:
        kind = {"indicator": "positive", "equality": "free", "cone": "cone"}[term.kind]
        found.k.append((found.add(len(term.J), kind), term.J.T))


def interior_finding(hypothesis: Hypothesis, model: LureSystem, potential: ConvexPotential | None, broken: str) -> Finding:
    """Decide 3.1; ``broken`` says why a potential is not understood."""
    if model.law is not None:
        return _law_interior(hypothesis, model.law, model.multiplier_names)
    if potential is None or broken or (potential.unknown and not potential.finite):
        return make_finding(hypothesis, UNKNOWN, broken or (potential.unknown if potential else "phi is not understood"))
    return _potential_interior(hypothesis, model, potential)


def _law_interior(hypothesis: Hypothesis, law: Law, names: tuple[str, ...]) -> Finding:
    """Block by block; the width is that of the narrowest interval, ball or polyhedron."""
    width = np.inf
    for rows, block in law.parts():
        own, shape = names[rows], block.shape()
        if shape is None:
            return make_finding(hypothesis, UNKNOWN, f"the set of {', '.join(own)} ({block.label}) has no exact form")
        if isinstance(shape, Halfspaces):
            H, K = _drop_trivial_rows(shape)
            answer = conic.decide_feasibility(slack_system(H, K))
            if answer.point is None and answer.separator is None:
                return make_finding(
                    hypothesis, UNKNOWN, f"the polyhedron of {', '.join(own)} is too close to a flat one for its size"
                )
            if answer.separator is not None:
                return _flat_polyhedron_finding(hypothesis, own, H, K, answer.separator)
            width = min(width, 2 * _inradius(H, K))
            continue
        for name, low, up in zip(own, *shape, strict=True) if isinstance(shape, Intervals) else ():
            if low == up:
                how = f"The interval of {name} is the single point {low:g}, so that K has no interior; replace it by its value."
                return make_finding(hypothesis, VIOLATED, how, {"width": 0.0}, {"multiplier": name, "lower = upper": low})
            width = min(width, up - low)
        if isinstance(shape, RoundSet):
            if not shape.radius:
                how = f"The {block.label} of {', '.join(own)} has the radius 0, so that K has no interior."
                return make_finding(hypothesis, VIOLATED, how, {"width": 0.0}, {"multipliers": list(own), "radius": 0.0})
            width = min(width, block.width)
    return make_finding(
        hypothesis,
        HOLDS,
        "Xi is the indicator of K, and K has an interior (exact); width is its narrowest part.",
        {"width": width},
    )


def _drop_trivial_rows(shape: Halfspaces) -> tuple[np.ndarray, np.ndarray]:
    """H, K without rows 0 >= K_i that always hold."""
    H, K = shape
    needed = H.any(axis=1) | (K > 0)
    return H[needed], K[needed]


def _flat_polyhedron_finding(
    hypothesis: Hypothesis, own: tuple[str, ...], H: np.ndarray, K: np.ndarray, separator: np.ndarray
) -> Finding:
    weights = -separator / max(abs(entry) for entry in separator)
    try:
        row = implicit_equalities(H, K)[0]
        how = f"Row {row} of the polyhedron of {', '.join(own)} is an equality on all of K: K has no interior."
        witness: dict[str, Any] = {"row": row, "normal": H[row]}
    except EmptyDomain:
        how, witness = f"The polyhedron of {', '.join(own)} is empty: its rows, so weighted, contradict each other.", {}
    return make_finding(hypothesis, VIOLATED, how, {"width": 0.0}, {**witness, "weights": exact.doubles(weights)})


def _inradius(H: np.ndarray, K: np.ndarray) -> float:
    """Radius of the largest ball in {H l >= K}, by a linear program; inf where there is none."""
    from scipy.optimize import linprog

    norms = np.linalg.norm(H, axis=1, keepdims=True)
    cost = np.append(np.zeros(H.shape[1]), -1.0)
    best = (
        linprog(cost, np.hstack([-H / norms, np.ones_like(norms)]), -K / norms.ravel(), bounds=(None, None)) if len(K) else None
    )
    return float(best.x[-1]) if best is not None and best.status == 0 else np.inf


def _potential_interior(hypothesis: Hypothesis, model: LureSystem, p: ConvexPotential) -> Finding:
    """Dom Xi has an interior if and only if Phi is affine along no direction."""
    rows = np.vstack([exact.zeros(0, model.y.numel()), *(term.J for term in p.terms)])
    if p.Q is not None:
        flat = exact.nullspace(np.vstack([p.Q, rows]))
        value = {"directions along which Phi is affine": flat.shape[1]}
        if not flat.shape[1]:
            return make_finding(
                hypothesis, HOLDS, "Phi is affine along no direction (exact), so that dom Phi* has an interior.", value
            )
        how = "Phi is affine along this direction of y, so that dom Phi* lies in a hyperplane."
        return make_finding(hypothesis, VIOLATED, how, value, {"direction": exact.doubles(flat[:, 0])})
    ones = np.ones(model.y.numel())
    for place, name in ((0 * ones, "y = 0"), *((ones, "y = (1, ..., 1)"),) * p.finite):
        least = _curvature_bound(model, rows, place)
        if least > 0:
            how = f"The Hessian of Phi's smooth part at {name}, with the normals of the other terms, is definite"
            return make_finding(hypothesis, HOLDS, f"{how} (interval arithmetic).", {"least eigenvalue": least})
    return make_finding(
        hypothesis, UNKNOWN, "the smooth part of phi is not quadratic, and its Hessian at y = 0 leaves a direction open"
    )


def _curvature_bound(model: LureSystem, rows: np.ndarray, place: np.ndarray) -> float:
    """A lower bound of the least eigenvalue of the Hessian at ``place``, plus the terms' normals; <= 0 where none is proved."""
    if model.phi_split.tau.numel():
        return 0.0
    hessian = ca.hessian(model.phi_split.smooth, model.y)[0]
    low, high = interval_bounds.enclose(hessian, model.y, place, place)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return 0.0
    J = exact.doubles(rows)
    J = J / np.maximum(np.linalg.norm(J, axis=1, keepdims=True), 1e-300)
    middle, scale = (low + high) / 2 + J.T @ J, max(np.abs(low).max(), np.abs(high).max(), 1.0)
    return float(np.linalg.eigvalsh((middle + middle.T) / 2)[0] - np.linalg.norm(high - low) - 1e-12 * len(place) * scale)
