"""Escapes from tangent dissipativity (A3): directions of C along which the state is not drawn back."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.classes.inclusion.hypotheses.recession import recession_directions
from nsmodel.classes.inclusion.hypotheses.selected_field import SelectedField
from nsmodel.classes.inclusion.hypotheses.tangent_form import TangentForm, is_point_in_set
from nsmodel.hypotheses.findings import UNKNOWN, VIOLATED
from nsmodel.proof import exact, polynomial
from nsmodel.proof.convex import piecewise
from nsmodel.proof.verdict import HypothesisPart

ESCAPE_SIZES = (1e3, 1e6)  # Sizes at which an escape is looked for.


def escape_direction(field: SelectedField, form: TangentForm | None) -> HypothesisPart | None:
    """A direction d of a polyhedral C along which <x, w>/|x|^2 does not become negative.

    <x, n> stays below a constant times |v| on a polyhedron, so that the highest power of t in <t d, G(t d)> decides where it is
    above that of |G|: escape with a factor > 0, or, where G is affine, with a power below the second. Without constraints n = 0.
    """
    C = field.C
    if not C.is_polyhedron:
        return None
    if form is None or form.slope:
        return _escape_along_rays(field)
    vectors = np.linalg.eigh(exact.doubles(form.Q))[1].T[::-1]
    kernel = exact.doubles(exact.nullspace(form.Q)).T
    for d in recession_directions(C, np.vstack([vectors, kernel])):
        rates: dict[int, Fraction] = {}
        for monomial, number in form.whole.items():
            k = sum(power for _, power in monomial)
            rates[k] = rates.get(k, Fraction(0)) + polynomial.evaluate_polynomial({monomial: number}, d)
        rates = {k: number for k, number in rates.items() if number}
        power = max(rates, default=0)
        if _is_escape(power, rates.get(power, Fraction(0)), form.degree, not C.rows.numel()):
            return _escape_part(d, power, rates.get(power, Fraction(0)))
    return None


def _is_escape(power: int, rate: Fraction, degree: int, free: bool) -> bool:
    if power >= 2:
        return rate > 0 and (free or power > degree)
    return free or degree <= 1


def _escape_along_rays(field: SelectedField) -> HypothesisPart | None:
    """The same for a G that is a polynomial on pieces of each ray t d in C: the last piece decides."""
    C, t = field.C, ca.SX.sym("t")
    if field.jumps or not is_point_in_set(C, np.zeros(C.n)):
        return None
    shifted = field.rest + ca.DM(field.shift)
    for d in recession_directions(C):
        along = ca.substitute(shifted, field.x, ca.DM(exact.doubles(d)) * t)
        rows = [piecewise.polynomial_pieces(row, t) for row in ca.vertsplit(along)]
        if any(row is None for row in rows):
            return None
        last = [row[-1].c for row in rows if row]
        degree = max(_leading_degree(c) for c in last)
        rates = [sum((d[i] * c[k] for i, c in enumerate(last) if k < len(c)), Fraction(0)) for k in range(degree + 1)]
        power = max((k + 1 for k, rate in enumerate(rates) if rate), default=0)
        rate = rates[power - 1] if power else Fraction(0)
        if _is_escape(power, rate, degree, not C.rows.numel()):
            return _escape_part(d, power, rate)
    return None


def _leading_degree(c: list[Fraction]) -> int:
    return max((k for k, number in enumerate(c) if number), default=0)


def _escape_part(d: np.ndarray, power: int, rate: Fraction) -> HypothesisPart:
    direction = exact.doubles(d)
    size = float(np.linalg.norm(direction))
    direction = direction / size
    how = f"along d, a direction in which C is unbounded, <x, F - S> grows like |x|^{power}: no alpha > 0 bounds it (exact)"
    if power < 2:
        how = "along d, a direction in which C is unbounded, <x, F - S> has no part -alpha |x|^2, alpha > 0 (exact)"
    value: dict[str, float] = {
        "<d, A d>" if power <= 2 else f"rate of |x|^{power}": float(rate) / size**power if power >= 2 else 0.0
    }
    witness: dict[str, Any] = {"direction": direction}
    return HypothesisPart(VIOLATED, how, value, witness)


def sample_quotient(field: SelectedField) -> HypothesisPart:
    """No proof: the quotient <x, v>/|x|^2 far out in C."""
    C = field.C
    rng = np.random.default_rng(0)
    d = rng.normal(size=(256, C.n))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    low, high = C.bounding_box
    points = np.vstack([np.clip(size * d, low, high) for size in ESCAPE_SIZES])
    points = points[(C.values(points) >= 0).all(axis=1) & (np.linalg.norm(points, axis=1) >= ESCAPE_SIZES[0] / 2)]
    z, ends, _ = field.variables
    f = ca.Function("quotient", [z], [ca.dot(field.x, field.rest + ca.DM(field.shift)) / ca.sumsqr(field.x)])
    inputs = np.hstack([points, np.tile(ends[C.n :], (len(points), 1))])
    values = np.array(f(inputs.T)).ravel() if len(points) else np.zeros(0)
    kept = np.isfinite(values)
    if not kept.any():
        return HypothesisPart(UNKNOWN, "C is unbounded, and neither alpha and beta nor an escape were found", {}, {})
    k = int(np.argmax(np.where(kept, values, -np.inf)))
    worst = {"largest <x, v>/|x|^2 far out": float(values[k])}
    if values[k] < 0:
        how = (
            f"<x, v>/|x|^2 < 0 at {int(kept.sum())} points of C with |x| from {ESCAPE_SIZES[0]:g} to {ESCAPE_SIZES[1]:g}, "
            "but no alpha was proved"
        )
        return HypothesisPart(UNKNOWN, how, worst, {"x": points[k]})
    return HypothesisPart(
        UNKNOWN, "C is unbounded, and no alpha and beta were found; far out <x, v> is not negative", worst, {"x": points[k]}
    )
