"""The domains of a convex potential and of its conjugate."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.classes.lure.hypotheses.domains import TAU_COLUMN, Domains, EmptyDomain, UndecidedDomain, add_slack_rows
from nsmodel.hypotheses.domain import domain_rows, potential_without_domain
from nsmodel.modeling.convex_split import ConvexSplit, ConvexTerm
from nsmodel.modeling.expressions import evaluate_at_samples, sample_points
from nsmodel.proof import conic, exact, interval_bounds, polynomial
from nsmodel.proof.convex import rules

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
        term.kind == "cone" and any(_is_equal_expression(term.u[0], s) for s in ca.vertsplit(tau))
    ):
        return True
    raise UndecidedDomain(f"the domain of phi has a nested bound, {term.u}: write it with separate conditions")


def _is_equal_expression(a: ca.SX, b: ca.SX) -> bool:
    return bool(ca.is_equal(a, b, 5))


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
