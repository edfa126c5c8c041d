"""The largest ball in A(0) = sum_j H_j' B(0, r_j): its radius is the least sigma(d) = sum_j r_j |H_j d| over |d| = 1.

Bounds from below: sigma(d) >= g'd for each g = sum_j r_j H_j'u_j with |u_j| <= 1. On a cone of directions g'd/|d| is quasiconcave
where it is >= 0, and so least at one of the cone's edges. The cones over cells of the faces of a cube are cut until the bounds
meet a value that is attained. g is best with u_j = H_j d/|H_j d| at the middle d of the cell; where H_j d may vanish there, with
the u_j that leave g as parallel to d as they can: at a minimiser on the sphere some g is a multiple of d.

Where an oscillator under dry friction can come to rest: {x : 0 in A(0) + dg(x)} (Cabot 2004, Theorem 4.1 ii).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from fractions import Fraction
from itertools import compress, product
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import EPS, sum_in_order
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, Consequence, Finding, common_scope, make_consequence
from nsmodel.hypotheses.region import Region, box_middle, depends_on_symbol, potential_without_domain
from nsmodel.models.friction_oscillator import friction_law
from nsmodel.models.friction_oscillator.model import FrictionOscillator
from nsmodel.proof import exact, polynomial
from nsmodel.proof import interval_bounds as proof
from nsmodel.proof.convex.lower_bounds import LowerBoundResult, minimise_potential
from nsmodel.proof.convex.sets import ConvexSet, has_interior
from nsmodel.proof.expression_graph import stack_column
from nsmodel.proof.parameter_hull import mixture_corners

FrictionElements = Sequence[tuple[float, np.ndarray]]  # r_j > 0 and H_j
MAX_CELL_STATES = 4  # In more dimensions the least singular value bounds the radius: cells of the sphere are too many.
MAX_LOCAL_STARTS = 20  # Points from which a local search starts, those with the least values.
# Cells that are looked at; then the radius has the bounds found so far. Twenty pairs of rows in four states take 12 000, 0.5 s.
MAX_CELLS = 60_000
CELL_BATCH = 2048  # Cells that are cut at once, those with the least bounds: arrays pay, and few are cut in vain.
CELL_TOLERANCE = 1e-10  # Relative: the gap between bound and value that ends it, more digits than a report shows.


class RadiusBound(NamedTuple):
    """``low`` <= radius <= ``value`` = sigma(``at``)."""

    low: float
    value: float
    at: np.ndarray


def support_function(elements: FrictionElements, d: np.ndarray) -> float:
    """Return sigma(d) = sum_j r_j |H_j d|."""
    return sum_in_order(r * float(np.linalg.norm(H @ d)) for r, H in elements)


def friction_radius(elements: FrictionElements, n: int) -> RadiusBound:
    """Bound the radius; the H_j have full column rank together."""
    isotropic = [n == 1 or _is_isotropic(H) for _, H in elements]
    even = list(compress(elements, isotropic))  # their part of sigma is constant on the sphere
    rest = [element for element, same in zip(elements, isotropic, strict=True) if not same]
    low = _support_lower_bound(even)
    if not rest:
        return RadiusBound(min(low, support_function(even, np.eye(n)[0])), support_function(even, np.eye(n)[0]), np.eye(n)[0])
    free = exact.nullspace(np.vstack([H for _, H in rest]))
    if free.shape[1]:
        d = exact.doubles(free[:, 0])
        d = d / np.linalg.norm(d)
        return RadiusBound(low, max(low, support_function(elements, d)), d)
    own = _anisotropic_radius(rest, n)
    value = support_function(elements, own.at)
    return RadiusBound(min(float(np.nextafter(low + own.low, 0)) if even else own.low, value), value, own.at)


def _anisotropic_radius(elements: FrictionElements, n: int) -> RadiusBound:
    """The radius of elements of which none is isotropic."""
    stacked = np.vstack([r * H for r, H in elements])
    value, d = _minimise_support(elements, [*np.linalg.svd(stacked)[2], *np.eye(n)])
    low = _singular_value_bound(elements, n)
    if n <= MAX_CELL_STATES:
        found = _radius_by_cells(elements, n, value, d)
        low, value, d = max(low, found.low), found.value, found.at
    return RadiusBound(min(low, value), value, d)


def _is_isotropic(H: np.ndarray) -> bool:
    """Whether H'H = c^2 I, exactly; of fewer rows than columns only where H = 0."""
    if H.shape[0] < H.shape[1]:
        return not H.any()
    G = exact.matrix_product(H.T, H)
    return bool((G == G[0, 0] * exact.eye(len(G))).all())


def _support_lower_bound(elements: FrictionElements) -> float:
    """A lower bound of sigma(e_1), whole roots exactly."""
    total = 0.0
    for r, H in elements:
        square = exact.matrix_product(H[:, :1].T, H[:, :1])[0, 0] * Fraction(r) ** 2
        root = float(np.sqrt(float(square)))
        while Fraction(root) ** 2 > square:
            root = float(np.nextafter(root, 0))
        total = root if not total else float(np.nextafter(total + root, 0))
    return total


def _singular_value_bound(elements: FrictionElements, n: int) -> float:
    """The least singular value of the stacked r_j H_j, as sum |a_j| >= |(a_1, a_2, ...)|, by exact signs."""
    stacked = np.vstack([Fraction(r) * exact.rational(H) for r, H in elements])
    G = exact.matrix_product(stacked.T, stacked)
    near = float(np.linalg.eigvalsh(exact.doubles(G))[0])
    for guess in (
        near * (1 - 1e-12),
        near * (1 - 1e-6),
        near / 2,
        *(float(np.trace(exact.doubles(G))) * 10.0**-k for k in range(8, 40, 4)),
    ):
        if guess > 0 and exact.is_psd(G - Fraction(guess) * exact.eye(n)):
            return float(np.sqrt(guess)) * (1 - 2 * EPS)
    return 0.0


def _minimise_support(elements: FrictionElements, starts: Sequence[np.ndarray]) -> tuple[float, np.ndarray]:
    """Local minima of sigma on the sphere, by repeated least squares from the best starts."""
    ordered = sorted(((support_function(elements, d), d) for d in starts), key=lambda item: item[0])
    rows, count, best = np.vstack([H for _, H in elements]), [len(H) for _, H in elements], ordered[0]
    first, r = np.cumsum([0, *count[:-1]]), np.array([r for r, _ in elements])
    least = 1e-9 * np.sqrt(np.add.reduceat((rows**2).sum(axis=1), first))
    for _, d in ordered[:MAX_LOCAL_STARTS]:
        before = np.zeros(0)
        for _ in range(50):
            sizes = np.maximum(np.sqrt(np.add.reduceat((rows @ d) ** 2, first)), least)
            if np.array_equal(sizes, before):
                break  # d is what it was, but for its sign
            d, before = np.linalg.eigh(rows.T @ (np.repeat(r / sizes, count)[:, None] * rows))[1][:, 0], sizes
            best = min(best, (support_function(elements, d), d), key=lambda item: item[0])
        best = min(best, _support_in_kernel(elements, d), key=lambda item: item[0])
    return best


def _support_in_kernel(elements: FrictionElements, d: np.ndarray) -> tuple[float, np.ndarray]:
    """Where some terms of sigma vanish up to rounding: the same direction with these terms 0."""
    small = [H / np.linalg.norm(H) for _, H in elements if np.linalg.norm(H @ d) <= 1e-6 * np.linalg.norm(H)]
    if small:
        _, values, vectors = np.linalg.svd(np.vstack(small))
        free = vectors[np.count_nonzero(values > 1e-9) :]
        inner = free.T @ (free @ d)
        if np.linalg.norm(inner) > 0.5:
            d = inner / np.linalg.norm(inner)
    return support_function(elements, d), d


# -- cells -------------------------------------------------------------------------------------------------------------


def _radius_by_cells(elements: FrictionElements, n: int, value: float, at: np.ndarray) -> RadiusBound:
    """The radius by cutting the faces of a cube; ``value`` is attained, ``at`` some direction."""
    middle, half = np.eye(n), 1.0 - np.eye(n)
    bound, count, low = _cell_bounds(elements, middle, half), n, np.inf
    while count < MAX_CELLS and len(bound):
        here = sum(r * np.linalg.norm(middle @ H.T, axis=1) for r, H in elements) / np.linalg.norm(middle, axis=1)
        d = middle[int(np.argmin(here))]
        d = d / np.linalg.norm(d)
        if support_function(elements, d) < value:
            value, at = min((value, at), _minimise_support(elements, [d]), key=lambda item: item[0])
        order = np.argsort(bound)
        middle, half, bound = middle[order], half[order], bound[order]
        worst = int(np.searchsorted(bound, value * (1 - CELL_TOLERANCE)))
        low = min(low, float(bound[worst:].min(initial=np.inf)))
        if not worst:
            bound = bound[:0]
            break
        number = min(worst, CELL_BATCH)
        axis = np.argmax(half[:number], axis=1)
        rows = np.arange(number)
        step = np.zeros((number, n))
        step[rows, axis] = half[rows, axis] / 2
        smaller = half[:number] - step
        parts = np.vstack([middle[:number] - step, middle[:number] + step])
        new = np.maximum(_cell_bounds(elements, parts, np.vstack([smaller, smaller])), np.tile(bound[:number], 2))
        middle, half = np.vstack([parts, middle[number:worst]]), np.vstack([smaller, smaller, half[number:worst]])
        bound = np.concatenate([new, bound[number:worst]])
        count += 2 * number
    return RadiusBound(float(min(value * (1 - CELL_TOLERANCE), low, bound.min(initial=np.inf))), value, at)


def _cell_bounds(elements: FrictionElements, middle: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Lower bounds (k,) of sigma(d) / |d| on the cells middle +- half, rounding included."""
    n = middle.shape[1]
    size = sum_in_order(r * float(np.linalg.norm(H)) for r, H in elements)
    rows = sum(len(H) for _, H in elements)
    corners = middle[:, None, :] + half[:, None, :] * np.array(list(product([-1.0, 1.0], repeat=n)))[None]
    lengths = np.linalg.norm(corners, axis=2)
    unit = middle / np.linalg.norm(middle, axis=1)[:, None]
    reach = np.linalg.norm(half, axis=1)
    plain, firm = np.zeros(middle.shape), np.zeros(middle.shape)
    columns, scale = [], []
    for r, H in elements:
        image = middle @ H.T
        length = np.linalg.norm(image, axis=1)
        u = image / np.where(length > 0, length, 1.0)[:, None]
        loose = length <= np.linalg.norm(H) * reach
        plain += r * u @ H
        firm += np.where(loose[:, None], 0.0, r * u @ H)
        columns.append(np.where(loose[:, None, None], (r * H.T)[None], 0.0))
        scale.append(len(H))
    S = np.concatenate(columns, axis=2)
    across = S - unit[:, :, None] * (unit[:, None, :] @ S)
    wanted = firm - unit * (unit * firm).sum(axis=1)[:, None]
    u = -(np.linalg.pinv(across, rcond=1e-10) @ wanted[:, :, None])[:, :, 0]
    at = 0
    for m in scale:
        part = u[:, at : at + m]
        u[:, at : at + m] = part / np.maximum(1.0, np.linalg.norm(part, axis=1))[:, None]
        at += m
    found = np.full(len(middle), -np.inf)
    for g in (plain, firm + (S @ u[:, :, None])[:, :, 0]):
        found = np.maximum(found, ((corners @ g[:, :, None])[:, :, 0] / lengths).min(axis=1))
    return np.maximum(found, 0.0) - (64 + 8 * (n + rows)) * EPS * size


# No end is looked for farther from the minimum, beside 1 and its place: beyond, a slope is taken to stay as it is there.
MAX_REST_DISTANCE = 1e12
# Relative width of the intervals on which a slope is bounded: some 450 doubles, so that a kink is on one side.
THIN_WIDTH = 1e-13
SLACK_DISTANCE = 1e-12  # Before an end, beside 1 and its place, where the slope is looked at: ends are rounded by a tenth of it.
# Beside 1 and the radius: a slope that is below the radius by more is so beyond rounding, of which a formula makes far less.
SLOPE_MARGIN = 1e-9
REAL_LINE = -np.inf, np.inf  # A box without bounds.


class RestInterval(NamedTuple):
    """A set around the rest points of one state; ``strict``: 0 is interior to A(0) + dg at each of them, seen in doubles."""

    low: float
    high: float
    strict: bool


def rest_point_consequences(
    model: FrictionOscillator, findings: Sequence[Finding], every: Sequence[str], g: ca.SX, domain: ConvexSet,
    below: LowerBoundResult, source: str,
) -> list[Consequence]:  # fmt: skip
    """Sets that hold the limits: an interval for one state, an ellipsoid for a quadratic potential and isotropic friction.

    Where g is convex on a box alone, the interval is its part in this box, around a minimum there.
    """
    radius = outer_radius(model)
    if domain.n == 1 and np.isfinite(radius):
        name = next(iter(model.names or ()))
        scope = common_scope(findings, every)
        found = rest_interval(g, domain, below.at, radius, (scope.states if scope else {}).get(name, REAL_LINE))
        if found is None:
            return []
        out = _interval_consequences(found, name, f", where d(0, dg({name})) <= {radius:.6g}", findings, every, source)
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
    if not np.isfinite(list(axes.values())).any():
        return []
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
    known = [part for part in found if part is not None]
    if not known or len(known) < len(found):
        return []
    hull = RestInterval(min(part.low for part in known), max(part.high for part in known), False)
    return _interval_consequences(hull, next(iter(model.names)), "", findings, every, source)


def _interval_consequences(
    found: RestInterval, name: str, where: str, findings: Sequence[Finding], every: Sequence[str], source: str
) -> list[Consequence]:
    """The interval in words; nothing where it is the whole line."""
    low, high = _round_outwards(found.low, -1), _round_outwards(found.high, 1)
    if np.isinf(found.low) and np.isinf(found.high):
        return []
    if np.isinf(found.low) or np.isinf(found.high):
        place = f"{name}_inf <= {high}" if np.isinf(found.low) else f"{name}_inf >= {low}"
        statement = f"every limit has {place}{where}"
    else:
        statement = f"every limit {name}_inf lies in [{low}, {high}]{where}"
    values = {f"least {name}_inf": found.low, f"largest {name}_inf": found.high}
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
        alike = H[:, :1] if _is_isotropic(H) else H
        square = sum((entry * entry for entry in alike.ravel() if entry), Fraction(0))
        total += Fraction(max(high, 0.0)) * Fraction(exact.root_rounded_up(square))
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


def rest_interval(
    g: ca.SX, domain: ConvexSet, minimum: np.ndarray, radius: float, box: tuple[float, float] = REAL_LINE
) -> RestInterval | None:
    """A set that holds the rest points of one state in a box, where g is convex; None where no minimum in the box is known.

    They are the x of dom g with 0 in dg(x) + [-radius, radius]. At the left end of dom g the normal cone makes dg(x) unbounded
    below, so that no slope is too large there, and no slope at the right end too small. It is exact for a quadratic. Else an end
    is a point after which the slope is proved to exceed the radius, somewhere: being monotone, it does so from there on, and the
    search begins in dom g, beyond whose wall nothing is looked at. Without such a point the end is infinite, or that of dom g.
    """
    centre = _minimum_inside(domain, float(minimum[0]))
    if centre is None or not box[0] <= centre <= box[1]:
        return None
    low, high = (float(end[0]) for end in domain.bounding_box)
    P = polynomial.as_quadratic(polynomial.read_polynomials(g, domain.x)[0], 1)
    if P is not None and P.H[0, 0] > 0 and domain.is_polyhedron:
        free = [(-P.q[0, 0] + sign * Fraction(radius)) / P.H[0, 0] for sign in (-1, 1)]
        left, right = exact.round_down(free[0]), exact.round_up(free[1])
        left = _last_inside(domain, centre, left) if left > centre else left
        right = _last_inside(domain, centre, right) if right < centre else right
        strict = all(end < low or end > high for end in free)
    else:
        slope, ends, strict = ca.gradient(g, domain.x), [], True
        for sign, walls in ((-1.0, (high, low)), (1.0, (low, high))):
            end = _bisect_end(lambda d, sign=sign: _proved_end(slope, domain, centre, sign, d, radius), sign, centre)
            ends.append(end)
            strict = strict and _has_slack(slope, domain.x, sign, centre, end, walls, radius)
        left, right = ends
    return RestInterval(max(left, low, box[0]), min(right, high, box[1]), strict)


def _minimum_inside(domain: ConvexSet, minimum: float) -> float | None:
    """The minimum, met in doubles, or the nearest double towards a strictly feasible point that is proved to lie in the set."""
    if _is_inside(domain, minimum):
        return minimum
    start = np.array([minimum])
    point = has_interior(domain, start).witness.get("interior point")
    return None if point is None else _last_inside(domain, float(np.ravel(point)[0]), minimum)


def _is_inside(domain: ConvexSet, x: float) -> bool:
    """Whether a point is proved to satisfy every row: polynomials exactly, others by intervals."""
    if not np.isfinite(x) or domain.equalities.numel():
        return False
    if not domain.rows.numel():
        return True
    low = np.ravel(proof.enclose(domain.rows, domain.x, np.array([x]), np.array([x]))[0])
    exactly = (p is not None and polynomial.evaluate_polynomial(p, [Fraction(x)]) >= 0 for p in domain.polynomials)
    return all(own or bound >= 0 for own, bound in zip(exactly, low, strict=True))


def _last_inside(domain: ConvexSet, inside: float, towards: float) -> float:
    """The last double on the way from a point of the set that is proved to lie in it, by bisection."""
    if _is_inside(domain, towards):
        return towards
    while inside != (middle := inside + (towards - inside) / 2) != towards:
        inside, towards = (middle, towards) if _is_inside(domain, middle) else (inside, middle)
    return inside


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


def _has_slack(slope: ca.SX, x: ca.SX, sign: float, centre: float, end: float, walls: tuple[float, float], radius: float) -> bool:
    """Whether the slope, seen just before an end, is below the radius by more than rounding: it jumps beyond it there.

    ``walls``: where dom g begins and ends on the way outwards, where its normal cone makes dg unbounded.
    """
    start, wall = walls
    last = sign * min(sign * end, sign * wall)
    if not np.isfinite(last):
        return _far_slope(slope, x, sign, centre) < radius - SLOPE_MARGIN * (1 + radius)
    f = ca.Function("slope", [x], [slope])
    before = last - sign * SLACK_DISTANCE * (1 + abs(last))
    if sign * (before - start) <= 0:
        return sign * float(f(start)) > radius + SLOPE_MARGIN * (1 + radius)
    if sign * end < sign * wall and proof.is_continuous(slope, x, *np.sort([[before], [last]], axis=0)):
        return False
    return sign * float(f(before)) < radius - SLOPE_MARGIN * (1 + radius)


def _far_slope(slope: ca.SX, x: ca.SX, sign: float, centre: float) -> float:
    value = float(ca.Function("slope", [x], [slope])(centre + sign * MAX_REST_DISTANCE)) * sign
    return value if np.isfinite(value) else np.inf
