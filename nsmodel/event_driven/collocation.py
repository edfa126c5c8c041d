"""Radau IIA collocation on [0, 1]: its matrices, from nodes that are known to rounding, in exact arithmetic.

A polynomial z of degree s with z(0) = 0 and values Z at the nodes 0 < c_1 < ... < c_s = 1, the zeros of (P_s - P_(s-1))(2 c - 1),
has the derivatives A^-1 Z there, A the matrix of Butcher's table. The method has order 2 s - 1, is L-stable and stiffly accurate
(Hairer and Wanner, Solving Ordinary Differential Equations II, IV.5).

What a piece of collocation errs by inside: bounded by forms on discs that cover it.

Its defect is that of no series: it has zeros at the nodes, of which a bound on one disc around all of it knows nothing. So the
piece is halved, and its halves, until on a disc around each, COVER_RADIUS times as wide, the bound is small enough. There the
polynomials are forms about the centre, F of them is one (see `discs`), and so is the defect D = h (f + g) - x~'. What a stiff
mode leaves of it is P^-1 (D, -y_a), P = (1/kappa - h J) of the start (see `radau`): combined coefficient by coefficient, so that
what the equations cancel stays cancelled, and |P^-1| times what is no coefficient. Values count on the real part of the disc,
|w| <= 1/COVER_RADIUS.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache, cached_property
from math import comb
from typing import NamedTuple

import numpy as np

from nsmodel.event_driven.disc_arithmetic import EquationsOnDisc, TaylorForm

ExactPolynomial = list[Fraction]  # Coefficients, order 0 first.


@dataclass(frozen=True)
class Collocation:
    """Matrices of s stages; what is applied to values is applied to values less those at 0.

    Attributes:
        nodes: (s,) c.
        inverse: (s, s) A^-1.
        rates: (r,) the eigenvalues of A^-1 that are real, and one of each pair.
        left, right: (r, s), (s, r): A^-1 Z = Re(right rates left Z), and Z = Re(right left Z).
        powers: (s, s) coefficients 1, ..., s from values at the nodes.
        middle: (s + 1, s) coefficients 0, ..., s about 1/2.
        between: (s,) 0 and, between each two nodes, the place where M(c) = (c - c_1) ... (c - c_s) is largest.
        values, slopes: (s, s) of z there, from values at the nodes.
        weights: (s,) |M(0)/M| there.
        share: the largest |integral of M from 0|, beside |M(0)|.
    """

    nodes: np.ndarray
    inverse: np.ndarray
    rates: np.ndarray
    left: np.ndarray
    right: np.ndarray
    powers: np.ndarray
    middle: np.ndarray
    between: np.ndarray
    values: np.ndarray
    slopes: np.ndarray
    weights: np.ndarray
    share: float

    @property
    def stages(self) -> int:
        """The number of stages."""
        return len(self.nodes)

    @cached_property
    def at_0(self) -> np.ndarray:
        """(s,) of the polynomial through the nodes alone, at 0."""
        return np.linalg.solve(np.vander(self.nodes, increasing=True).T, np.eye(self.stages)[0])

    def coefficients(self, values: np.ndarray, start: np.ndarray) -> np.ndarray:
        """(q, s + 1) of the polynomials with these values (s, q) at the nodes and (q,) at 0; constants are so exactly.

        ``powers`` has large entries of both signs: what the first product misses at the nodes is put right by a second one.
        """
        Z, V = values - start, self.nodes[:, None] ** np.arange(1, self.stages + 1)
        c = self.powers @ Z
        c += self.powers @ (Z - V @ c)
        return np.vstack([start, c]).T

    def about_middle(self, values: np.ndarray, start: np.ndarray) -> np.ndarray:
        """(s + 1, q) of the same about 1/2, where they are far smaller, and rounding with them."""
        Z, V = values - start, (self.nodes[:, None] - 0.5) ** np.arange(self.stages + 1)
        c = self.middle @ Z
        c += self.middle @ (Z - V @ c)
        c[0] += start
        return c


@cache
def radau_collocation(s: int) -> Collocation:
    """Return the matrices of s stages."""
    nodes = _radau_nodes(s)
    basis = [_lagrange(nodes, i) for i in range(s)]
    M = _polynomial_from_roots(nodes)
    inner = np.sort(np.roots([float(v) for v in reversed(_polynomial_derivative(M))]).real)
    between = [Fraction(0), *(Fraction(float(v)) for v in inner)]

    def value_table(polynomials: list[ExactPolynomial], at: list[Fraction]) -> np.ndarray:
        return np.array([[float(_polynomial_value(p, t)) for p in polynomials] for t in at])

    slopes = [_polynomial_derivative(p) for p in basis]
    inverse, sizes = value_table(slopes, nodes), np.abs(value_table([M], between)[:, 0])
    integral = [Fraction(0), *(a / (k + 1) for k, a in enumerate(M))]
    rates, right = np.linalg.eig(inverse)
    left, kept = np.linalg.inv(right), np.flatnonzero(np.imag(rates) >= 0)
    twice = np.where(np.imag(rates[kept]) > 0, 2.0, 1.0)
    return Collocation(
        np.array([float(c) for c in nodes]), inverse, rates[kept], left[kept], right[:, kept] * twice,
        np.array([[float(p[k]) for p in basis] for k in range(1, s + 1)]), _shifted_coefficients(Fraction(1, 2), basis),
        np.array([float(v) for v in between]),
        value_table(basis, between), value_table(slopes, between), sizes[0] / sizes,
        float(np.abs(value_table([integral], nodes)).max() / sizes[0]),
    )  # fmt: skip


def _radau_nodes(s: int) -> list[Fraction]:
    """The zeros of (P_s - P_(s-1))(2 c - 1), as the doubles that are nearest."""
    legendre = [[Fraction((-1) ** (n + k) * comb(n, k) * comb(n + k, k)) for k in range(n + 1)] for n in (s, s - 1)]
    p = [a - b for a, b in zip(legendre[0], [*legendre[1], Fraction(0)], strict=True)]
    nodes = [Fraction(float(c)) for c in np.sort(np.roots([float(a) for a in reversed(p)]).real)]
    for _ in range(3):  # Newton's method, exactly.
        nodes = [Fraction(float(c - _polynomial_value(p, c) / _polynomial_value(_polynomial_derivative(p), c))) for c in nodes]
    return nodes


def _polynomial_from_roots(roots: list[Fraction]) -> ExactPolynomial:
    p = [Fraction(1)]
    for root in roots:
        p = [a - root * b for a, b in zip([Fraction(0), *p], [*p, Fraction(0)], strict=True)]
    return p


def _lagrange(nodes: list[Fraction], i: int) -> ExactPolynomial:
    """1 at node i, 0 at the others and at 0."""
    p = _polynomial_from_roots([Fraction(0), *nodes[:i], *nodes[i + 1 :]])
    return [a / _polynomial_value(p, nodes[i]) for a in p]


def _shifted_coefficients(centre: Fraction, of: list[ExactPolynomial]) -> np.ndarray:
    """A column a polynomial: its coefficients about another centre."""
    return np.array(
        [
            [float(sum((comb(m, k) * centre ** (m - k) * p[m] for m in range(k, len(p))), Fraction(0))) for p in of]
            for k in range(len(of[0]))
        ]
    )


def _polynomial_derivative(p: ExactPolynomial) -> ExactPolynomial:
    return [k * a for k, a in enumerate(p)][1:]


def _polynomial_value(p: ExactPolynomial, t: Fraction) -> Fraction:
    total = Fraction(0)
    for a in reversed(p):
        total = total * t + a
    return total


SMALLEST = 2.0**-6  # Of a piece: narrower parts, of which 64 cover it, are not tried: the piece itself is made shorter.
COVER_RADIUS = 1.5  # Of the disc around a part, in half widths of it: wide ones cut off less, and meet more singularities.
COVER_DEGREE = 10  # Of the polynomials on a disc, at least; of what is beyond, a number, the part feels 1.5^-11 = 1/86.


class PieceTolerances(NamedTuple):
    """What a piece may err by, and what of it is rounding.

    ``size``: of x; ``x``, ``l``, ``y``, ``watched``: what is allowed, of held rows l, of the others y. ``rounding``: that of
    (x, l of held rows) after ``inverse``, (q, q); ``rounding_l``, ``rounding_y`` and ``rounding_watched``: that of their sizes.
    """

    inverse: np.ndarray
    rounding: np.ndarray
    x: np.ndarray
    size: np.ndarray
    l: np.ndarray
    rounding_l: np.ndarray
    y: np.ndarray
    rounding_y: np.ndarray
    watched: np.ndarray
    rounding_watched: np.ndarray


class PiecePolynomials(NamedTuple):
    """Those of a piece about its middle, (s + 1, q), in its own length; where it begins, its length, and the rows it holds."""

    t: float
    h: float
    held: list[int]
    x: np.ndarray
    l: np.ndarray
    y: np.ndarray
    watched: np.ndarray


def piece_error_bound(on: EquationsOnDisc, of: PiecePolynomials, scales: PieceTolerances) -> float:
    """The largest bound in units of what is allowed; more than 1 where discs as small as SMALLEST of the piece prove no less."""
    worst, at, width = 0.0, 0.0, 1.0
    while at < 1:
        here = _bound_on_part(on, of, scales, at + width / 2, width / 2)
        if here <= 1:
            worst, at = max(worst, here), at + width
            while width < 1 and at % (2 * width) == 0:  # The other half of the next wider one is done.
                width *= 2
        elif width > SMALLEST:
            width /= 2
        else:
            return here
    return worst


def _bound_on_part(on: EquationsOnDisc, of: PiecePolynomials, scales: PieceTolerances, centre: float, half: float) -> float:
    degree, R = max(COVER_DEGREE, len(of.x) - 1), COVER_RADIUS * half
    about, powers = _recentring_matrix(degree, len(of.x) - 1, centre, R), _cover_radius_powers(degree + 2)
    x, l, y, watched = (about @ c for c in (of.x, of.l, of.y, of.watched))
    t = np.zeros(degree + 1)
    t[:2] = of.t + of.h * centre, of.h * R
    found = on(TaylorForm(t), _column_forms(x), _column_forms(l))
    orders = np.arange(1, degree + 1)[:, None] / R
    moved = np.vstack([x[1:] * orders, np.zeros((1, x.shape[1]))])
    missed = [_subtract_polynomial(one * of.h, c) for one, c in zip(found.rate, moved.T, strict=True)]
    missed += [_subtract_polynomial(found.y[i] * -1.0, np.zeros(degree + 1)) for i in of.held]
    coefficients, rests = np.array([c for c, _ in missed]), np.array([r for _, r in missed])
    if not np.isfinite(rests).all():
        return math.inf
    off = np.abs(scales.inverse @ coefficients) @ powers[:-1] + np.abs(scales.inverse) @ rests * powers[-1] - scales.rounding
    n = len(found.rate)
    worst = max(max_error_ratio(off[:n], scales.x), max_error_ratio(off[n:], scales.l[of.held]))
    free = [i for i in range(len(found.y)) if i not in of.held]
    off_y = np.array([_max_on_real_part(*_subtract_polynomial(found.y[i], y[:, i])) for i in free])
    off_watched = np.array(
        [_max_on_real_part(*_subtract_polynomial(one, c)) for one, c in zip(found.looked, watched.T, strict=True)]
    )
    worst = max(worst, max_error_ratio(off_y - scales.rounding_y[free], scales.y[free]))
    return max(worst, max_error_ratio(off_watched - scales.rounding_watched, scales.watched))


@cache
def _cover_radius_powers(count: int) -> np.ndarray:
    return COVER_RADIUS ** -np.arange(float(count))


@cache
def _recentring_matrix(rows: int, degree: int, centre: float, R: float) -> np.ndarray:
    """(rows + 1, degree + 1) coefficients of (z - centre)/R from those about 1/2."""
    out, by = np.zeros((rows + 1, degree + 1)), centre - 0.5
    for m in range(degree + 1):
        for k in range(m + 1):
            out[k, m] = math.comb(m, k) * by ** (m - k) * R**k
    return out


def _column_forms(c: np.ndarray) -> list[TaylorForm]:
    return [TaylorForm(column) for column in c.T]


def _subtract_polynomial(of: TaylorForm | float, c: np.ndarray) -> tuple[np.ndarray, float]:
    """Coefficients and rest of what it is beside a polynomial."""
    if isinstance(of, TaylorForm):
        return of.c - c, of.r
    out = -c
    out[0] += of
    return out, 0.0 if of == of else math.inf


def _max_on_real_part(c: np.ndarray, r: float) -> float:
    """The largest value on the real part of the disc."""
    powers = _cover_radius_powers(len(c) + 1)
    return float(np.abs(c) @ powers[:-1] + r * powers[-1])


def max_error_ratio(off: np.ndarray, allowed: np.ndarray) -> float:
    """The largest of errors, 0 or less where they are rounding, in units of what is allowed; inf where it is not a number."""
    with np.errstate(all="ignore"):
        shares = np.where(off <= 0, 0.0, off / allowed)
    return float(np.where(np.isnan(shares), np.inf, shares).max(initial=0.0))


def piece_polynomials(
    table: Collocation, t: float, h: float, held: list[int], start: Sequence[np.ndarray], values: Sequence[np.ndarray]
) -> PiecePolynomials:
    """Of x, l, y and what is watched: values at 0 and at the nodes."""
    return PiecePolynomials(t, h, held, *(table.about_middle(v, at_0) for v, at_0 in zip(values, start, strict=True)))
