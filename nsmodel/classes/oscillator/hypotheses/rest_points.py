"""Where an oscillator under dry friction can come to rest: {x : 0 in A(0) + dg(x)} (Cabot 2004, Theorem 4.1 ii)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.classes.oscillator.hypotheses import friction_law
from nsmodel.classes.oscillator.model import FrictionOscillator
from nsmodel.hypotheses.domain import potential_without_domain
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, Consequence, Finding, make_consequence
from nsmodel.hypotheses.region import Region
from nsmodel.hypotheses.uniform import box_middle, depends_on_symbol
from nsmodel.proof import exact, polynomial
from nsmodel.proof import interval_bounds as proof
from nsmodel.proof.convex.lower_bounds import LowerBoundResult, minimise_potential
from nsmodel.proof.convex.sets import ConvexSet
from nsmodel.proof.expression_graph import stack_column
from nsmodel.proof.parameter_hull import mixture_corners

MAX_REST_DISTANCE = 1e12  # Beyond this, from the minimum, no end is looked for.
THIN_WIDTH = 1e-13  # Relative width of the intervals on which a slope is bounded.
SLOPE_MARGIN = 1e-9


class RestInterval(NamedTuple):
    """A set around the rest points of one state; ``strict``: 0 is interior to A(0) + dg at each of them, seen in doubles."""

    low: float
    high: float
    strict: bool


def rest_point_consequences(
    model: FrictionOscillator, findings: Sequence[Finding], every: Sequence[str], g: ca.SX, domain: ConvexSet,
    below: LowerBoundResult, source: str,
) -> list[Consequence]:  # fmt: skip
    """Sets that hold the limits: an interval for one state, an ellipsoid for a quadratic potential and isotropic friction."""
    radius = outer_radius(model)
    if domain.n == 1 and np.isfinite(radius):
        name = next(iter(model.names or ()))
        found = rest_interval(g, domain, below.at, radius)
        where = f"where d(0, dg({name})) <= {radius:.6g}"
        statement = (
            f"every limit {name}_inf lies in [{_round_outwards(found.low, -1)}, {_round_outwards(found.high, 1)}], {where}"
        )
        values = {f"least {name}_inf": found.low, f"largest {name}_inf": found.high}
        out = [make_consequence("rest points", statement, findings, every, source, values)]
        if found.strict:
            base = make_consequence("finite from every start", "", findings, every, source)
            statement = "0 is interior to A(0) + dg(x) at every rest point: each sequence stops in finitely many steps"
            verdict = SAMPLED if base.verdict == HOLDS else base.verdict
            out.append(replace(base, statement=statement, verdict=verdict, source=f"{source.split(' (')[0]} (iii)"))
        return out
    P = polynomial.as_quadratic(polynomial.read_polynomials(g, domain.x)[0], domain.n)
    ball = len(model.elements) == 1 and np.array_equal(np.array(ca.DM(model.elements[0].H)), np.eye(domain.n))
    if P is None or domain.rows.numel() or not ball or not np.isfinite(radius):
        return []
    values = _eigenvalue_lower_bounds(exact.doubles(P.H))
    axes = {
        f"semi-axis {i + 1}": float(np.nextafter(radius / value, np.inf)) if value > 0 else np.inf
        for i, value in enumerate(values[:6])
    }
    statement = f"every limit lies in the ellipsoid |K x - b| <= {radius:.6g}, K = D2 g, semi-axes theta'(0)/eigenvalue"
    return [make_consequence("rest points", statement, findings, every, source, axes)]


def rest_points_for_all(
    model: FrictionOscillator, region: Region, findings: Sequence[Finding], every: Sequence[str], domain: ConvexSet, source: str
) -> list[Consequence]:
    """An interval that holds the limits of one state for all values of parameters, on which the domain does not depend.

    Beyond the ends of all g_k, of which g is a convex combination, each |g_k'| exceeds its radius, and so do the sums.
    """
    found, x0 = [], np.array(ca.DM(model.bind(box_middle(region.parameters)).x0)).ravel()
    for one in _mixture_models(model, region):
        g, radius = potential_without_domain(one.potential, model.x, "potential"), outer_radius(one)
        if not np.isfinite(radius):
            return []
        found.append(rest_interval(g, domain, minimise_potential(g, domain, x0)[0], radius))
    if not found:
        return []
    low, high = min(part.low for part in found), max(part.high for part in found)
    name = next(iter(model.names))
    statement = f"every limit {name}_inf lies in [{_round_outwards(low, -1)}, {_round_outwards(high, 1)}]"
    values = {f"least {name}_inf": low, f"largest {name}_inf": high}
    return [make_consequence("rest points", statement, findings, every, source, values)]


def _mixture_models(model: FrictionOscillator, region: Region) -> list[FrictionOscillator]:
    """Models of whose laws and potential those of all values are convex combinations; none where H depends on the parameters."""
    g = potential_without_domain(model.potential, model.x, "potential")
    at = mixture_corners(stack_column([*(e.theta for e in model.elements), g]), model.p, *region.parameter_bounds())
    if at is None or any(depends_on_symbol(element.H, model.p) for element in model.elements):
        return []
    made = [copy(model) for _ in at]
    for one, rows in zip(made, at, strict=True):
        laws = zip(model.elements, ca.vertsplit(rows)[:-1], strict=True)
        one._set(elements=tuple(element._replace(theta=theta) for element, theta in laws), potential=rows[-1])
    return made


def outer_radius(model: FrictionOscillator) -> float:
    """A number that no |f| with f in A(0) exceeds: sum theta_j'(0) |H_j|, from upper bounds."""
    total = Fraction(0)
    for element in model.elements:
        high, H = friction_law.slope_at_zero_bounds(element, model.s)[1], exact.rational(np.array(ca.DM(element.H)))
        if not np.isfinite(high):
            return np.inf
        G = exact.matrix_product(H.T, H)
        square = G[0, 0] if (G == G[0, 0] * exact.eye(len(G))).all() else sum((entry * entry for entry in H.ravel()), Fraction(0))
        root = float(np.sqrt(float(square)))
        while Fraction(root) ** 2 < square:
            root = float(np.nextafter(root, np.inf))
        total += Fraction(max(high, 0.0)) * Fraction(root)
    return exact.round_up(total)


def _eigenvalue_lower_bounds(H: np.ndarray) -> np.ndarray:
    """Lower bounds of the eigenvalues, the largest first; those of a diagonal matrix are its entries."""
    if not np.any(H - np.diag(np.diag(H))):
        return np.sort(np.diag(H))[::-1]
    values = np.linalg.eigvalsh(H)[::-1]
    return values - 16 * len(H) * np.finfo(float).eps * np.abs(values).max(initial=0.0)


def _round_outwards(end: float, sign: int) -> str:
    """Six digits, rounded outwards."""
    text = f"{end:.6g}"
    if np.isfinite(end) and (float(text) - end) * sign < 0:
        text = f"{float(text) + sign * 10.0 ** (np.floor(np.log10(abs(end))) - 5):.6g}"
    return text


def rest_interval(g: ca.SX, domain: ConvexSet, minimum: np.ndarray, radius: float) -> RestInterval:
    """A set that holds the rest points of one state: {x in dom g : g'(x-) <= radius, g'(x+) >= -radius}, around a minimum of g.

    It is exact for a quadratic. Else an end is a point before which the slope is proved to exceed the radius, somewhere: being
    monotone, it does so from there on. Without such a point the end is infinite, or that of the domain.
    """
    P = polynomial.as_quadratic(polynomial.read_polynomials(g, domain.x)[0], 1)
    low, high = (float(end[0]) for end in domain.bounding_box)
    if P is not None and P.H[0, 0] > 0 and len(domain.affine) == domain.rows.numel():
        ends = [(-P.q[0, 0] + sign * Fraction(radius)) / P.H[0, 0] for sign in (-1, 1)]
        left, right = max(low, exact.round_down(ends[0])), min(high, exact.round_up(ends[1]))
        return RestInterval(left, right, left > float(ends[0]) and right < float(ends[1]))
    slope = ca.gradient(g, domain.x)
    centre = float(minimum[0])
    ends, strict = [], True
    for sign, hull in ((-1.0, low), (1.0, high)):
        end = _bisect_end(lambda d, sign=sign: _proved_end(slope, domain, centre, sign, d, radius), sign, centre)
        ends.append(max(end, hull) if sign < 0 else min(end, hull))
        strict = strict and _has_slack(slope, domain, centre, sign, ends[-1], radius)
    return RestInterval(ends[0], ends[1], strict)


def _proved_end(slope: ca.SX, domain: ConvexSet, centre: float, sign: float, d: float, radius: float) -> float | None:
    """An end proved close to centre + sign d: the slope exceeds the radius there, or the domain has ended; else None."""
    near = centre + sign * d
    far = near + sign * max(THIN_WIDTH * abs(near), np.finfo(float).tiny)
    box = np.array([min(near, far)]), np.array([max(near, far)])
    low, high = (float(np.ravel(end)[0]) for end in proof.enclose(slope, domain.x, *box))
    outside = domain.rows.numel() and float(np.min(proof.enclose(domain.rows, domain.x, *box)[1])) < 0
    return far if (low > radius if sign > 0 else high < -radius) or outside else None


def _bisect_end(proved: Callable[[float], float | None], sign: float, centre: float) -> float:
    """The nearest end that is proved, by bisection."""
    if (end := proved(0.0)) is not None:
        return end
    low, high = 0.0, 1e-12 * (1 + abs(centre))
    while (end := proved(high)) is None:
        low, high = high, 2 * high
        if high > MAX_REST_DISTANCE * (1 + abs(centre)):
            return sign * np.inf
    for _ in range(100):
        middle = (low + high) / 2
        if not low < middle < high:
            break
        nearer = proved(middle)
        low, high, end = (middle, high, end) if nearer is None else (low, middle, nearer)
    return end


def _has_slack(slope: ca.SX, domain: ConvexSet, centre: float, sign: float, end: float, radius: float) -> bool:
    """Whether the slope, seen just before an end, is below the radius by more than rounding: it jumps beyond it there."""
    if not np.isfinite(end):
        return _far_slope(slope, domain, sign, centre) < radius - SLOPE_MARGIN * (1 + radius)
    inside = end - sign * 1e-9 * (1 + abs(end))
    if (inside - centre) * sign <= 0:
        return True
    value = float(ca.Function("slope", [domain.x], [slope])(inside)) * sign
    return bool(value < radius - SLOPE_MARGIN * (1 + radius))


def _far_slope(slope: ca.SX, domain: ConvexSet, sign: float, centre: float) -> float:
    value = float(ca.Function("slope", [domain.x], [slope])(centre + sign * MAX_REST_DISTANCE)) * sign
    return value if np.isfinite(value) else np.inf
