"""The ellipsoid {l'Q l <= 1}: anisotropic friction, l = -Q^-1 y / sqrt(y'Q^-1 y) where y != 0."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from math import isqrt, nextafter, sqrt
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from nsmodel._utils import EPS, checks_keywords, short_repr
from nsmodel.errors import ModelError
from nsmodel.modeling.laws.base import (
    STATE_UPPER,
    STATE_ZERO,
    CurvedSet,
    LatexNumberWriter,
    Law,
    LawFactor,
    RoundSet,
    StateNames,
    product_set,
    read_array,
    safe_norm,
)
from nsmodel.modeling.laws.box import make_box_law
from nsmodel.proof.verdict import not_none

MULTIPLIER_ITERATIONS = 100  # Of Newton's method for mu, which rises to it; a dozen are usual.


@dataclass(frozen=True, eq=False)
class EllipsoidSet(CurvedSet):
    """{sum d_i w_i^2 <= 1}, w = V'l: ``d`` (m,) > 0, ``V`` (m, m) orthogonal."""

    d: np.ndarray
    V: np.ndarray
    kind: ClassVar[str] = "ellipsoid"

    @property
    def radius(self) -> float:  # pyrefly: ignore[bad-override]
        """The longest half-axis."""
        return float(1 / np.sqrt(self.d.min()))

    def _multiplier(self, w: np.ndarray) -> float:
        """Mu >= 0 with w_i/(1 + mu d_i) on the boundary, 0 inside.

        Newton's method for 1/psi = 1, psi(mu) = |sqrt(d) w/(1 + mu d)|: 1/psi is concave, so that mu grows towards the solution
        (as in the trust-region problem; Conn, Gould and Toint 2000, section 7.3).
        """
        mu, root = 0.0, np.sqrt(self.d)
        for _ in range(MULTIPLIER_ITERATIONS):
            s = root * w / (1 + mu * self.d)
            psi = safe_norm(s)
            step = (psi - 1) / float((self.d / (1 + mu * self.d)) @ (s / psi) ** 2) if psi > 1 else 0.0
            if not step > 2 * EPS * mu:
                break
            mu += step
        return mu

    def project(self, u: np.ndarray) -> np.ndarray:
        """(I + mu Q)^-1 u, on the boundary."""
        w = self.V.T @ u
        mu = self._multiplier(w)
        return self.onto_boundary(self.V @ (w / (1 + mu * self.d))) if mu else u

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """A - A n n'A / (n'A n) with A = (I + mu Q)^-1, n = Q P_K(u), outside."""
        w = self.V.T @ u
        mu = self._multiplier(w)
        if not mu:
            return np.eye(u.size)
        a = 1 / (1 + mu * self.d)
        n = self.d * a * w
        n = n / safe_norm(n)
        an = a * n
        return self.V @ (np.diag(a) - np.outer(an, an) / (n @ an)) @ self.V.T

    def code(self, u: np.ndarray) -> int:
        """The code 0 of stick, 1 of slip."""
        return 1 if self._q_norm(u) > 1 else 0

    def onto_boundary(self, l: np.ndarray) -> np.ndarray:
        """The point of the boundary on the ray through l."""
        return l / self._q_norm(l)

    def support_point(self, y: np.ndarray) -> np.ndarray:
        """-Q^-1 y / sqrt(y'Q^-1 y)."""
        v = (self.V.T @ y) / np.sqrt(self.d)
        return -self.V @ (v / np.sqrt(self.d) / safe_norm(v))

    def complementarity(self, l: ca.SX, y: ca.SX, tiny: float) -> tuple[ca.SX, list[ca.SX]]:
        """<l, y> + sqrt(y'Q^-1 y), 1 - l'Q l."""
        w, v = ca.DM(self.V.T) @ l, ca.DM(self.V.T) @ y
        return ca.dot(l, y) + ca.sqrt(ca.dot(v, v / ca.DM(self.d)) + tiny), [1 - ca.dot(w, ca.DM(self.d) * w)]

    def slip(self, y: ca.SX) -> tuple[ca.SX, ca.SX]:
        """-Q^-1 y / size, size = sqrt(y'Q^-1 y)."""
        v = (ca.DM(self.V.T) @ y) / ca.DM(np.sqrt(self.d))
        size = ca.sqrt(ca.sumsqr(v))
        return -(ca.DM(self.V) @ (v / ca.DM(np.sqrt(self.d)))) / size, size

    def quadric(self, m: int) -> tuple[np.ndarray, float]:
        """The matrix S and the bound 1 of the set l'S l <= 1."""
        return self.V @ np.diag(self.d) @ self.V.T, 1.0

    def _q_norm(self, l: np.ndarray) -> float:
        return safe_norm(np.sqrt(self.d) * (self.V.T @ l))


@dataclass(frozen=True, eq=False)
class Ellipsoid(LawFactor):
    """{l'Q l <= 1}; ``Q`` (m, m), numbers, symmetric and positive definite."""

    kind: ClassVar[str] = "ellipsoid"
    STATE_NAMES: ClassVar[Mapping[str, StateNames]] = {
        "ellipsoid": {0: (STATE_ZERO, "l inside the ellipsoid (y = 0)"), 1: (STATE_UPPER, "l on the ellipsoid")}
    }
    Q: np.ndarray

    __repr__ = short_repr

    @cached_property
    def _eigen_axes(self) -> EllipsoidSet:
        return EllipsoidSet(*np.linalg.eigh(self.Q))

    def scaled(self, u: float) -> Ellipsoid:
        """The ellipsoid with Q / u^2 in place of Q."""
        return replace(self, Q=self.Q / u**2)

    def curved(self) -> EllipsoidSet:
        """The ellipsoid in its eigenvector axes."""
        return self._eigen_axes

    def c_numbers(self) -> ca.SX:
        """The eigenvalues, then the eigenvectors row by row."""
        return ca.SX(ca.DM(np.concatenate([self._eigen_axes.d, self._eigen_axes.V.ravel()])))

    def shape(self) -> RoundSet:
        """The image of a ball by R^-1, Q = R'R, where the pivots of Q have rational roots."""
        from nsmodel.proof import exact

        L, D = _ldl_factors(exact.rational(self.Q))
        roots = [_rational_root(pivot) for pivot in D]
        if any(root is None for root in roots):
            return RoundSet(None, Fraction(1))
        R = np.array([[root * entry for entry in column] for root, column in zip(roots, L.T, strict=True)], dtype=object)
        return RoundSet(exact.inverse_matrix(R), Fraction(1))

    @property
    def width(self) -> float:
        """The shortest axis."""
        return float(2 / np.sqrt(self._eigen_axes.d.max()))

    def bounding_box(self) -> tuple[np.ndarray, np.ndarray]:
        """Sqrt((Q^-1)_ii) each way."""
        from nsmodel.proof import exact

        inverse = not_none(exact.inverse_matrix(exact.rational(self.Q)))
        half = np.array([nextafter(sqrt(exact.round_up(entry)), np.inf) for entry in np.diag(inverse)])
        return -half, half

    def excess(self, l: np.ndarray) -> np.ndarray:
        """(|R l|^2 - 1) / (2 |Q l|), Q = R'R: the distance to first order."""
        inner = ((l @ np.linalg.cholesky(self.Q)) ** 2).sum(axis=1, keepdims=True)
        slope = 2 * np.linalg.norm(l @ self.Q, axis=1, keepdims=True)
        return np.maximum(inner - 1, 0) / np.where(slope > 0, slope, 1)

    def rivals(self, l: np.ndarray, y: np.ndarray) -> np.ndarray:
        """-Q^-1 y / sqrt(y'Q^-1 y), and 0."""
        v = np.linalg.solve(np.linalg.cholesky(self.Q), y.T)
        size = np.linalg.norm(v, axis=0)
        least = -np.linalg.solve(np.linalg.cholesky(self.Q).T, v / np.where(size > 0, size, 1)).T
        return np.stack([least, np.zeros_like(l)])

    @property
    def extent(self) -> float:
        """The longest half-axis."""
        return self._eigen_axes.radius

    def latex(self, write: LatexNumberWriter) -> list[str]:
        """lambda' Q lambda <= 1."""
        return [product_set(write, self.size, rf"\lambda^{{\mathsf{{T}}}} {write.matrix(self.Q)} \lambda \leq 1")]

    def data(self) -> dict[str, Any]:
        """The matrix Q for reports."""
        return {"Q": self.Q}


def _ldl_factors(Q: np.ndarray) -> tuple[np.ndarray, list[Fraction]]:
    """L and the diagonal of D with Q = L D L', L unit lower triangular; Q rational and definite."""
    m, rest = len(Q), Q.copy()
    L, D = np.array([[Fraction(int(i == j)) for j in range(m)] for i in range(m)], dtype=object), []
    for j in range(m):
        D.append(rest[j, j])
        L[j + 1 :, j] = rest[j + 1 :, j] / rest[j, j]
        rest[j + 1 :, j + 1 :] = rest[j + 1 :, j + 1 :] - np.outer(L[j + 1 :, j], rest[j, j + 1 :])
    return L, D


def _rational_root(number: Fraction) -> Fraction | None:
    over, under = isqrt(number.numerator), isqrt(number.denominator)
    return Fraction(over, under) if (over**2, under**2) == (number.numerator, number.denominator) else None


@checks_keywords
def ellipsoid(Q: Any) -> Law:
    """-y ∈ N(l) for {l : l'Q l <= 1}, anisotropic Coulomb friction; l = -Q^-1 y / sqrt(y'Q^-1 y) where y != 0.

    Friction of coefficients mu_1 and mu_2 along two axes and the normal force N has Q = diag(1/(mu_1 N)^2, 1/(mu_2 N)^2)
    (the ellipse of friction, with the rule of maximal dissipation; Goyal, Ruina and Papadopoulos 1991, Wear 143, 307-330).

    Args:
        Q: (m, m), numbers, symmetric and positive definite; a condition number up to 1e8 is tested.

    Raises:
        ModelError: Q is no such matrix.
    """
    matrix = np.atleast_2d(read_array("ellipsoid", "Q", Q))
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or not matrix.size:
        raise ModelError(f"ellipsoid: Q has the shape {np.shape(Q)}; expected (m, m), m >= 1")
    if not np.isfinite(matrix).all():
        raise ModelError("ellipsoid: Q must be finite")
    size = np.abs(matrix).max()
    if np.abs(matrix - matrix.T).max() > 8 * EPS * size:
        i, j = np.unravel_index(np.argmax(np.abs(matrix - matrix.T)), matrix.shape)
        raise ModelError(f"ellipsoid: Q is not symmetric: Q[{i}, {j}] = {matrix[i, j]:g}, Q[{j}, {i}] = {matrix[j, i]:g}")
    matrix = (matrix + matrix.T) / 2
    least = float(np.linalg.eigvalsh(matrix)[0])
    if not least > len(matrix) * EPS * size:
        raise ModelError(f"ellipsoid: Q is not positive definite: its least eigenvalue is {least:g}, its largest entry {size:g}")
    if len(matrix) == 1:
        return make_box_law("relay", 1, -1 / np.sqrt(least), 1 / np.sqrt(least))
    return Law((Ellipsoid("ellipsoid", len(matrix), matrix),))
