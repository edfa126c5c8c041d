"""Linear growth of G = F - S: |G(x)| <= a_1 + a_2 |x| on C (A2)."""

from __future__ import annotations

from fractions import Fraction
from itertools import product
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.classes.inclusion.hypotheses import curves
from nsmodel.classes.inclusion.hypotheses.recession import recession_directions
from nsmodel.classes.inclusion.hypotheses.selected_field import SelectedField
from nsmodel.hypotheses.findings import HOLDS, UNKNOWN, VIOLATED
from nsmodel.proof import exact, extremum, interval_bounds, polynomial
from nsmodel.proof.affine_reduction import sector
from nsmodel.proof.convex.lower_bounds import additive_terms
from nsmodel.proof.convex.rules import find_ridges
from nsmodel.proof.expression_graph import program
from nsmodel.proof.growth import growth_bound, linear_growth_bound
from nsmodel.proof.verdict import HypothesisPart

NORM_ROUND_UP = 1 + 1e-12  # Norms and eigenvalues in doubles are enlarged by this where they are bounds.
MAX_MULTIPLIER_CORNERS = 12
SECTOR_START, TANGENT_SCALE = (
    8,
    64.0,
)  # Slopes at infinity are those beyond 2^8; powers of |x| below 1 are bounded by tangents at 64.


class AffineField(NamedTuple):
    """rest = A x + b + (columns of the jumps) l + terms of size at most more + slopes |x|.

    A (n, n), b (n, 1) and the columns (n, k) are Fractions.
    """

    A: np.ndarray
    b: np.ndarray
    jumps: np.ndarray
    more: np.ndarray
    slopes: np.ndarray

    @property
    def exact(self) -> bool:
        """Whether there are no terms but the affine ones."""
        return not (self.more.any() or self.slopes.any())


class FieldRowBound(NamedTuple):
    """A row of rest: a polynomial p, plus terms that are at most ``size`` + ``slope`` |x| on C; p is None where some is not."""

    p: polynomial.Polynomial | None
    size: float
    slope: float


def read_field_rows(field: SelectedField) -> list[FieldRowBound]:
    """Read the rows of rest, bounding the terms that are no polynomials."""
    z, low, high = field.variables
    return [_read_field_row(row, field, z, low, high) for row in ca.vertsplit(field.rest)]


def _read_field_row(row: ca.SX, field: SelectedField, z: ca.SX, low: np.ndarray, high: np.ndarray) -> FieldRowBound:
    (p,) = polynomial.read_polynomials(row, z)
    if p is not None:
        return FieldRowBound(p, 0.0, 0.0)
    total: polynomial.Polynomial = {}
    size = slope = 0.0
    for factor, term in additive_terms(row):
        (p,) = polynomial.read_polynomials(term, z)
        if p is not None:
            total = polynomial.add_multiple(total, p, factor)
            continue
        reach, steep = term_bound(term, field, z, low, high, None)
        if not np.isfinite(reach + steep):
            own = _sector_bound(term, field)
            if own is not None:
                total = polynomial.add_multiple(total, own[0], factor)
                reach, steep = own[1:]
            else:
                reach, steep = term_bound(term, field, z, low, high, TANGENT_SCALE)
        if not np.isfinite(reach + steep):
            return FieldRowBound(None, np.inf, np.inf)
        size += exact.round_up(abs(factor) * Fraction(reach)) * NORM_ROUND_UP
        slope += exact.round_up(abs(factor) * Fraction(steep)) * NORM_ROUND_UP
    return FieldRowBound(total, size, slope)


def term_bound(
    term: ca.SX, field: SelectedField, z: ca.SX, low: np.ndarray, high: np.ndarray, scale: float | None
) -> tuple[float, float]:
    """(a, b) with |term| <= a + b |x|: bounded, Lipschitz, or with a ``scale`` by the growth calculus; else inf."""
    reach = float(np.max(np.abs(interval_bounds.enclose(term, z, low, high))))
    if np.isfinite(reach):
        return reach, 0.0
    found = _lipschitz_term_bound(term, field, z, low, high)
    if scale is None:
        return found
    powers = growth_bound(term, z, low, high, field.x.numel())
    own = None if powers is None else linear_growth_bound(powers, scale)
    return found if own is None or own[1] >= found[1] else own


def _lipschitz_term_bound(term: ca.SX, field: SelectedField, z: ca.SX, low: np.ndarray, high: np.ndarray) -> tuple[float, float]:
    """(a, b) with |term| <= a + b |x|, where it is continuous with bounded slopes on the hull of C."""
    n = field.x.numel()
    if field.jumps or not interval_bounds.is_continuous(term, z, low, high):
        return np.inf, np.inf
    base = np.clip(np.zeros(n), low, high)
    code = program(term, z)
    with np.errstate(all="ignore"):
        ends = interval_bounds.reverse_slopes(code, interval_bounds.run_program(code, low[None, :], high[None, :]), (0,), 1)
    gradient = np.maximum(np.abs(ends[0]), np.abs(ends[1])).ravel()
    at = float(np.max(np.abs(interval_bounds.enclose(term, z, base, base))))
    steep = float(np.linalg.norm(gradient)) * NORM_ROUND_UP if np.isfinite(gradient).all() else np.inf
    return at + steep * float(np.linalg.norm(base)) * NORM_ROUND_UP if np.isfinite(steep) else np.inf, steep


def _sector_bound(term: ca.SX, field: SelectedField) -> tuple[polynomial.Polynomial, float, float] | None:
    """(p, a, b) with |term - p| <= a + b |x| and a linear p, where the term is a function of one direction between two lines."""
    split = find_ridges(term, field.x)
    if split is None or split.s.numel() != 1:
        return None
    low, high = split.box(field.x, *field.C.bounding_box)
    found = sector(split.h, split.s, low[0], high[0], SECTOR_START)
    if found is None or not found.bounded:
        return None
    middle = found.low + (found.high - found.low) / 2
    p = {((i, 1),): Fraction(middle) * number for i, number in enumerate(split.a[0]) if number}
    width = max(found.high - middle, middle - found.low) * rounded_norm(exact.doubles(split.a))
    return p if middle else {}, found.reach, width * NORM_ROUND_UP


def affine_field(field: SelectedField) -> AffineField | None:
    """The rest of G as an affine map but for bounded terms, where it is one."""
    n, z = field.x.numel(), field.variables[0]
    rows, read = [], read_field_rows(field)
    for p, _, _ in read:
        if p is None or polynomial.degree(p) > 1:
            return None
        found = polynomial.as_quadratic(p, z.numel())
        if found is None:
            return None
        rows.append((found.q.T[0], found.c))
    whole = np.array([row for row, _ in rows], dtype=object).reshape(n, z.numel())
    return AffineField(
        whole[:, :n],
        exact.rational([[c] for _, c in rows]),
        whole[:, n:],
        np.array([row.size for row in read]),
        np.array([row.slope for row in read]),
    )


def split_box(
    base: np.ndarray, half: float, low: np.ndarray, high: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], list[tuple[np.ndarray, np.ndarray]]]:
    """The part of a box within ``half`` of a point, and boxes that hold the rest of it (the whole where half is 0)."""
    inner = np.maximum(low, base - half), np.minimum(high, base + half)
    if not half:
        return inner, [(low, high)]
    outside = []
    for i in range(base.size):
        for end, side in ((base[i] + half, 0), (base[i] - half, 1)):
            part = low.copy(), high.copy()
            part[side][i] = end
            if part[0][i] < part[1][i]:
                outside.append(part)
    return inner, outside


def rounded_norm(matrix: np.ndarray) -> float:
    """|A|, enlarged by rounding; exact for one entry."""
    if matrix.size == 1:
        return abs(float(matrix[0, 0]))
    return float(np.linalg.norm(matrix, 2)) * NORM_ROUND_UP if matrix.any() else 0.0


def max_constant_part(field: SelectedField, b: np.ndarray, columns: np.ndarray) -> float:
    """The largest |b + sum of multipliers|: over the corners of their boxes where these are few."""
    terms = [(term.B, term.lower, term.upper) for term in field.aligned]
    terms += [(columns[:, [k]], jump.lower, jump.upper) for k, jump in enumerate(field.jumps)]
    if not terms:
        return float(np.linalg.norm(b)) if b.size > 1 else abs(float(b[0]))
    if len(terms) <= MAX_MULTIPLIER_CORNERS and all(B.shape[1] == 1 for B, _, _ in terms):
        corners = np.array(list(product(*((low, high) for _, low, high in terms))))
        return float(np.linalg.norm(b + corners @ np.hstack([B for B, _, _ in terms]).T, axis=1).max()) * NORM_ROUND_UP
    sizes = [float(np.linalg.norm(B, 2)) * max(abs(low), abs(high)) for B, low, high in terms]
    return float(np.linalg.norm(b) + sum(sizes)) * NORM_ROUND_UP


def linear_growth(field: SelectedField, region: tuple[np.ndarray, np.ndarray], *, quick: bool) -> HypothesisPart:
    """(A2) on C."""
    found = affine_field(field)
    if found is not None:
        share = max_constant_part(field, exact.doubles(found.b).ravel(), exact.doubles(found.jumps))
        values = {
            "a_1": share + rounded_norm(found.more[:, None]),
            "a_2": rounded_norm(exact.doubles(found.A)) + rounded_norm(found.slopes[:, None]),
        }
        parts = ["bounded multipliers"] * bool(field.l.numel()) + ["bounded terms"] * bool(found.more.any())
        parts += ["terms of linear growth"] * bool(found.slopes.any())
        how = "F - S is affine" + (f" but for {' and '.join(parts)}" if parts else "")
        return HypothesisPart(HOLDS, how, values, {})
    z, low, high = field.variables
    square = ca.sumsqr(field.rest)
    others = sum(term.size for term in field.aligned) * NORM_ROUND_UP
    if field.C.bounded:
        sup = extremum.supremum(square, z, low, high, quick=quick)
        if np.isfinite(sup.bound):
            a_1 = float(np.sqrt(max(sup.bound, 0.0))) * NORM_ROUND_UP + others
            return HypothesisPart(HOLDS, "C is bounded: the largest |F - S| on its box", {"a_1": a_1, "a_2": 0.0}, {})
    elif interval_bounds.is_continuous(field.rest, z, low, high):
        found_bound = _lipschitz_bound(field, others)
        if found_bound is not None:
            how = "F - S is Lipschitz on C but for a bounded part, by bounds of its Jacobian"
            return HypothesisPart(HOLDS, how, found_bound, {})
    top = velocity_bound(field, region)
    local = {} if top is None else {"largest |F - S| on the box": top}
    fast = _superlinear_direction(field)
    curved = None if fast is not None else curves.superlinear_curve(field)
    if curved is not None:
        witness = {**curved.witness, "power": curved.value["power"]}
        return HypothesisPart(VIOLATED, f"{curved.how}; the number is that of the box", local or {"a_2": np.inf}, witness)
    if fast is not None:
        d, power = fast
        how = f"|F - S| grows like t^{power} along a direction in which C is unbounded (exact); the number is that of the box"
        return HypothesisPart(VIOLATED, how, local or {"a_2": np.inf}, {"direction": d, "power": power})
    reach = "bounded, and no bound of F - S on it" if field.C.bounded else "unbounded, and no linear bound of F - S at infinity"
    how = f"C is {reach} was proved; the number is that of the box looked at"
    return HypothesisPart(UNKNOWN, how, local, {})


def _lipschitz_bound(field: SelectedField, others: float) -> dict[str, float] | None:
    """|rest(x)| <= M + a_2 |x - y| <= M + a_2 (|x| + D): a_2 bounds the Jacobian outside a box B, M bounds |rest| on B.

    y is where the segment from the middle of B to x leaves B, at a distance D from 0 at most: |x - y| <= |x - c| <= |x| + |c|.
    """
    z, low, high = field.variables
    n = field.x.numel()
    base = np.clip(np.zeros(n), *field.C.bounding_box)
    J = ca.jacobian(field.rest, field.x)
    for half in (0.0, 1.0):
        box, outside = split_box(base, half, low[:n], high[:n])
        ends = [(np.concatenate([a, low[n:]]), np.concatenate([b, high[n:]])) for a, b in (box, *outside)]
        slope = max((extremum.spectral_norm(J, z, *end, quick=True).bound for end in ends[1:]), default=0.0)
        _, top = interval_bounds.enclose(ca.sumsqr(field.rest), z, *ends[0])
        M = float(np.max(top))
        if np.isfinite(slope) and np.isfinite(M):
            return {
                "a_1": float(np.sqrt(max(M, 0.0))) * NORM_ROUND_UP + slope * float(np.linalg.norm(base)) * NORM_ROUND_UP + others,
                "a_2": slope,
            }
    return None


def velocity_bound(field: SelectedField, region: tuple[np.ndarray, np.ndarray]) -> float | None:
    """A bound of |F - S| on the part of C in a box; None where there is none."""
    z, low, high = field.variables
    n = field.x.numel()
    low[:n], high[:n] = np.maximum(low[:n], region[0]), np.minimum(high[:n], region[1])
    if (low > high).any():
        return None
    _, top = interval_bounds.enclose(ca.sumsqr(field.rest), z, low, high)
    value = float(np.max(top))
    return (
        float(np.sqrt(value)) * NORM_ROUND_UP + sum(term.size for term in field.aligned) * NORM_ROUND_UP
        if np.isfinite(value)
        else None
    )


def _superlinear_direction(field: SelectedField) -> tuple[np.ndarray, int] | None:
    """A direction d of C and k >= 2 with |G(c + t d)| growing like t^k, where a row is a polynomial but for slower terms."""
    if not field.C.is_polyhedron:
        return None
    n = field.x.numel()
    parts = [(row.p, {m for m in row.p if any(v >= n for v, _ in m)}) for row in read_field_rows(field) if row.p is not None]
    # The multipliers of jumps are bounded, and slower where they enter by themselves.
    rows = [{m: p[m] for m in p if m not in held} for p, held in parts if all(len(m) == 1 for m in held)]
    for d in recession_directions(field.C):
        power = max((_degree_along(p, d) for p in rows), default=0)
        if power >= 2:
            return exact.doubles(d), power
    return None


def _degree_along(p: polynomial.Polynomial, d: np.ndarray) -> int:
    """The degree of t -> p(t d), by its highest coefficient that is not 0."""
    by_power: dict[int, Fraction] = {}
    for monomial, number in p.items():
        k = sum(power for _, power in monomial)
        by_power[k] = by_power.get(k, Fraction(0)) + polynomial.evaluate_polynomial({monomial: number}, d)
    return max((k for k, number in by_power.items() if number), default=0)
