"""Where an oscillator under dry friction can come to rest: {x : 0 in A(0) + dg(x)} (Cabot 2004, Theorem 4.1 ii)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, SAMPLED, Consequence, Finding, follows
from nsmodel.model.oscillator import FrictionOscillator
from nsmodel.proof import exact, polynomial
from nsmodel.proof.convex.convex_sets import ConvexSet
from nsmodel.proof.convex.lower_bound import Below

FAR = 1e12  # Beyond this, from the minimum, an interval of rest points is taken as infinite.
MARGIN = 1e-9


class Interval(NamedTuple):
    """Rest points [low, high] of one state; ``strict``: 0 is interior to A(0) + dg at each of them, seen in doubles."""

    low: float
    high: float
    strict: bool


def consequences(
    model: FrictionOscillator, findings: Sequence[Finding], every: Sequence[str], g: ca.SX, domain: ConvexSet, below: Below,
    radius: float, source: str,
) -> list[Consequence]:  # fmt: skip
    """The predicted set of limits: an interval for one state, an ellipsoid for a quadratic potential and isotropic friction."""
    if domain.n == 1:
        name = next(iter(model.names or ()))
        found = interval(g, domain, below.at, radius)
        where = f"where d(0, dg({name})) <= {radius:.6g}"
        statement = f"every limit {name}_inf lies in [{found.low:.6g}, {found.high:.6g}], {where}"
        values = {f"least {name}_inf": found.low, f"largest {name}_inf": found.high}
        out = [follows("rest points", statement, findings, every, source, values)]
        if found.strict:
            base = follows("finite from every start", "", findings, every, source)
            statement = "0 is interior to A(0) + dg(x) at every rest point: each sequence stops in finitely many steps"
            verdict = SAMPLED if base.verdict == HOLDS else base.verdict
            out.append(replace(base, statement=statement, verdict=verdict, source=f"{source.split(' (')[0]} (iii)"))
        return out
    P = polynomial.quadratic(polynomial.read(g, domain.x)[0], domain.n)
    ball = len(model.elements) == 1 and np.array_equal(np.array(ca.DM(model.elements[0].H)), np.eye(domain.n))
    if P is None or domain.rows.numel() or not ball:
        return []
    values = np.linalg.eigvalsh(exact.doubles(P.H))[::-1]
    axes = {f"semi-axis {i + 1}": radius / value if value > 0 else np.inf for i, value in enumerate(values[:6])}
    statement = f"every limit lies in the ellipsoid |K x - b| <= {radius:.6g}, K = D2 g, semi-axes theta'(0)/eigenvalue"
    return [follows("rest points", statement, findings, every, source, axes)]


def interval(g: ca.SX, domain: ConvexSet, minimum: np.ndarray, radius: float) -> Interval:
    """Rest points of one state: {x in dom g : g'(x-) <= radius, g'(x+) >= -radius}, around a minimum of g.

    The slope is monotone: its ends are exact for a quadratic, else found by bisection.
    """
    P = polynomial.quadratic(polynomial.read(g, domain.x)[0], 1)
    low, high = (float(end[0]) for end in domain.hull)
    if P is not None and P.H[0, 0] > 0 and len(domain.affine) == domain.rows.numel():
        ends = [(-P.q[0, 0] + sign * Fraction(radius)) / P.H[0, 0] for sign in (-1, 1)]
        left, right = max(low, float(ends[0])), min(high, float(ends[1]))
        return Interval(left, right, left > float(ends[0]) and right < float(ends[1]))
    f = ca.Function("slope", [domain.x], [ca.gradient(g, domain.x)])

    def slope(x: float) -> float:
        """The slope at x, 0 where it has none; infinite outside of the domain."""
        if (domain.values(np.array([[x]])) < 0).any():
            return np.inf if x > minimum[0] else -np.inf
        value = float(f(x))
        return value if np.isfinite(value) else float(f(np.nextafter(x, np.inf)))

    right, under = _end(lambda d: slope(minimum[0] + d), radius)
    left, over = _end(lambda d: -slope(minimum[0] - d), radius)
    scale = MARGIN * (1 + radius)
    return Interval(minimum[0] - left, minimum[0] + right, bool(under < radius - scale and over < radius - scale))


def _end(slope: Callable[[float], float], radius: float) -> tuple[float, float]:
    """(the largest d >= 0 with slope <= radius before it, the slope just before)."""
    low, high = 0.0, 1e-300
    step = 1e-9
    while slope(step) <= radius:
        low, step = step, 2 * step
        if step > FAR:
            return np.inf, slope(low)
    high = step
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if slope(middle) <= radius else (low, middle)
    return (low if low > 1e-12 else 0.0), slope(low) if low > 0 else -np.inf
