"""Radau IIA collocation on [0, 1]: its matrices, from nodes that are known to rounding, in exact arithmetic.

A polynomial z of degree s with z(0) = 0 and values Z at the nodes 0 < c_1 < ... < c_s = 1, the zeros of (P_s - P_(s-1))(2 c - 1),
has the derivatives A^-1 Z there, A the matrix of Butcher's table. The method has order 2 s - 1, is L-stable and stiffly accurate
(Hairer and Wanner, Solving Ordinary Differential Equations II, IV.5).
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from math import comb

import numpy as np

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
        """S."""
        return len(self.nodes)

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
